"""Reconstruction: estimate scene parameters from observations of one or several sensors."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor, nn

from invertwin.errors import InputError
from invertwin.inversion.confidence import verdict as verdicts
from invertwin.inversion.confidence.realisations import FitResult
from invertwin.inversion.confidence.uncertainty import CovarianceEstimator, Uncertainty
from invertwin.inversion.fit import Callback, Fit, FitSettings, Status
from invertwin.inversion.observation import Observation, Unknown, Unknowns, name_unknowns
from invertwin.inversion.optimizer import Optimizer
from invertwin.inversion.regularization import Regularizer
from invertwin.inversion.schedule import Schedule, Stage, make_stages
from invertwin.scene.scene import Scene
from invertwin.scene.shape_models.density import replace_clouds


@dataclass(frozen=True)
class Reconstruction:
    """Result of :func:`reconstruct`.

    Attributes:
        scene: the fitted scene (twin).
        sensors: sensors of all observations with their fitted parameters.
        parameters: fitted modules: those of the scene, then those of the sensors.
        history: one row per step: ``step``, ``stage``, ``loss``, ``values`` (parameters by name).
        status: ``converged`` (the loss no longer falls), ``budget`` (all steps done), or
            ``diverged`` (not finite, or worse than the start; then the better of the best state and
            the start is kept). It states why the fit stopped; ``verdict`` assesses whether it is
            right.
        steps: number of completed steps.
        loss: loss of the state that is kept, if the fit compared states at its end; else that of
            the last step.
        result: final maps and simulated realisations of them.
        doubts: evidence against the twin that its maps do not show.
    """

    scene: Scene
    sensors: list[Any]
    parameters: nn.ModuleList
    history: list[dict[str, Any]]
    status: Status
    steps: int
    loss: float
    result: FitResult = field(repr=False)
    doubts: tuple[str, ...] = ()

    @cached_property
    def is_uninformative(self) -> bool:
        """True if the twin predicts almost none of the observed power, as in ``judge_fit``.

        A fitted gain of zero has no gradient, so such a fit stays at its start.
        """
        return min(verdicts.explained_fractions(self.result)) < verdicts.MIN_EXPLAINED_FRACTION

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Error bars of the parameters, computed at first access.

        Raises:
            InputError: See :class:`invertwin.inversion.confidence.uncertainty.CovarianceEstimator`.
        """
        return CovarianceEstimator(self.result, is_fitted=True).error_bars()

    @cached_property
    def verdict(self) -> verdicts.Verdict:
        """Goodness of fit and ambiguities, computed at first access."""
        found = verdicts.judge_fit(self.result)
        if not self.doubts:
            return found
        word = "ambiguous" if found.is_consistent else found.word
        return replace(found, word=word, reasons=(*found.reasons, *self.doubts))


def reconstruct(
    scene: Scene,
    observations: Observation | Sequence[Observation],
    parameters: Unknowns,
    *,
    loss: Callable[[Tensor, Tensor], Tensor] | None = None,
    optimizer: Optimizer | None = None,
    schedule: Schedule | Sequence[Schedule] | None = None,
    regularizers: Sequence[Regularizer] = (),
    callbacks: Sequence[Callback] = (),
    seed: int = 0,
) -> Reconstruction:
    """Find the parameters of a scene whose predicted maps match the observed ones.

    In every step the models predict maps of the present scene, the loss compares them with the
    observed maps, and the optimiser follows its gradient, silhouettes included. The models may blur
    both maps; the blur is annealed to zero over the first part of a stage.

    Args:
        scene: initial scene.
        observations: data of one or several sensors, with their forward models.
        parameters: modules Scene → Scene, applied in order; an :class:`Unknown` has its own rate
            and regularisers. Pass a mapping by name if stages select among them.
        loss: (predicted, observed) → number. None = ``SpectrumLoss()``, and
            ``SpectrumLoss("mse", levels=1, gain="one")`` for levels and fields.
        optimizer: kind of optimiser and rates.
        schedule: a ``Schedule``, or consecutive stages.
        regularizers: functions Scene → number, added to the loss.
        callbacks: observers of the fit: ``Report``, ``Watch``, ``Checkpoint``.
        seed: seed of all random numbers; equal seeds give equal fits.

    Source: §4.2 of the paper.
    Differs from the source: Adam and Gauss–Newton beside SGD; annealed blur; several sensors.

    Raises:
        InputError: Nothing to fit, a map of zeros, an unknown name in a stage, a checkpoint of
            another fit.
    """
    observations = [observations] if isinstance(observations, Observation) else list(observations)
    if not observations:
        raise InputError("expected at least one observation, got none; give Observation(...)")
    unknowns = name_unknowns(parameters)
    groups = [name_unknowns(o.parameters, f"sensor{k}.") for k, o in enumerate(observations)]
    named = dict(item for group in (unknowns, *groups) for item in group.items())
    stages = make_stages(schedule, [*named])
    built = [_build_modules(o.sensor, group) for o, group in zip(observations, groups, strict=True)]
    sensor_modules = [group for group, _ in built]
    penalties = [term for _, sensor_terms in built for term in sensor_terms]
    settings = FitSettings(loss, optimizer or Optimizer(), (*regularizers, *penalties), seed)
    fit, status = None, "budget"
    history: list[dict[str, Any]] = []
    modules, terms = _build_modules(scene, unknowns)
    free = _FreeParameters([modules, *sensor_modules])
    for number, stage in enumerate(stages):
        if fit is not None and stage.rebuilds_modules:
            scene, modules, terms = _rebuild_modules(fit.twin(), unknowns, stage)
            free = _FreeParameters([modules, *sensor_modules])
        free.apply(stage)
        fit = Fit(
            scene,
            _stage_observations(stage, observations),
            list(modules.values()),
            [list(group.values()) for group in sensor_modules],
            stage=stage,
            settings=replace(settings, regularizers=(*settings.regularizers, *terms)),
            rates=free.learning_rates(named),
            stage_position=(number, len(history), number == len(stages) - 1),
        )
        status = fit.run(callbacks)
        history += fit.progress.history
    assert fit is not None
    with torch.no_grad():
        twin, sensors = fit.apply_modules()
    best = fit.progress.best  # of the present step if the fit has ended there
    final = best[1] if best and best[0] == fit.progress.step else history[-1]["loss"]
    return Reconstruction(
        twin, sensors, fit.modules, history, status, len(history), final, FitResult(fit)
    )


def prepare_fit(
    scene: Scene,
    observations: Sequence[Observation],
    parameters: Unknowns,
    *,
    loss: Callable[[Tensor, Tensor], Tensor] | None = None,
    regularizers: Sequence[Regularizer] = (),
    seed: int = 0,
) -> Fit:
    """Prepare a fit without running it, to evaluate its maps and loss. See `reconstruct`.

    Args:
        scene: scene at which the fit stands.
        observations: data with their forward models.
        parameters: modules Scene → Scene.
        loss: (predicted, observed) → number.
        regularizers: functions Scene → number, added to the loss.
        seed: seed of all random numbers.
    """
    modules, terms = _build_modules(scene, name_unknowns(parameters))
    built = [_build_modules(o.sensor, name_unknowns(o.parameters)) for o in observations]
    terms += [term for _, sensor_terms in built for term in sensor_terms]
    return Fit(
        scene, observations, list(modules.values()), [list(group.values()) for group, _ in built],
        stage=Stage(), settings=FitSettings(loss, Optimizer(), (*regularizers, *terms), seed),
        rates={}, stage_position=(0, 0, True),
    )  # fmt: skip


def _stage_observations(stage: Stage, observations: Sequence[Observation]) -> Sequence[Observation]:
    """Return the observations with their forward models of a stage."""
    if not stage.models:
        return observations
    if len(stage.models) != len(observations):
        raise InputError(
            f"expected a model for each of {len(observations)} observations in a stage, got "
            f"{len(stage.models)}; give one each, or none"
        )
    return [replace(o, model=m) for o, m in zip(observations, stage.models, strict=True)]


def _build_modules(
    target: Any, unknowns: Mapping[str, Unknown]
) -> tuple[dict[str, nn.Module], list[Any]]:
    """Build the modules of a scene or a sensor by name, each for the result of its predecessors."""
    modules: dict[str, nn.Module] = {}
    terms: list[Regularizer] = []
    last = max((k for k, item in enumerate(unknowns.values()) if item.depends_on_target), default=0)
    for number, (name, unknown) in enumerate(unknowns.items()):
        modules[name] = unknown.build_module(target)
        if unknown.regularize is not None:
            terms += unknown.regularize(modules[name], target)
        if number < last:
            with torch.no_grad():
                target = modules[name](target)
    return modules, terms


def _rebuild_modules(
    twin: Scene, unknowns: Mapping[str, Unknown], stage: Stage
) -> tuple[Scene, dict[str, nn.Module], list[Any]]:
    """Rebuild the modules of a stage for the twin of the previous stage, remeshed."""
    scene = replace_clouds(twin)
    for name, change in stage.remesh.items():
        scene = scene.replace(name, mesh=change(scene[name].mesh))
    current = {n: u for n, u in unknowns.items() if not stage.unknowns or n in stage.unknowns}
    fixed = [n for n, u in current.items() if isinstance(u.module, nn.Module)]
    if fixed:
        raise InputError(
            f"expected functions that make the modules of a stage that rebuilds, got a module for "
            f"{fixed[0]!r}; give Unknown(lambda scene: ...)"
        )
    return scene, *_build_modules(scene, current)


class _FreeParameters:
    """Free parameters of each stage, among those that initially require a gradient."""

    def __init__(self, groups: Sequence[Mapping[str, nn.Module]]) -> None:
        self._modules = {name: module for group in groups for name, module in group.items()}
        every = nn.ModuleList(self._modules.values()).parameters()
        self._first = {parameter: parameter.requires_grad for parameter in every}

    def apply(self, stage: Stage) -> None:
        """Free the unknowns of a stage, and freeze the others."""
        for name, module in self._modules.items():
            for parameter in module.parameters():
                wanted = not stage.unknowns or name in stage.unknowns
                parameter.requires_grad_(self._first[parameter] and wanted)

    def learning_rates(self, unknowns: Mapping[str, Unknown]) -> dict[nn.Parameter, float]:
        """Return the learning rates of single parameters."""
        rated = ((unknowns[name].rate, module) for name, module in self._modules.items())
        return {p: rate for rate, module in rated if rate is not None for p in module.parameters()}
