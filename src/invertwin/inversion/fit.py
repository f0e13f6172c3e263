"""One stage of a fit: predict maps, compare them by a loss, update the parameters."""

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from typing import Any, Literal

import numpy as np
import torch
from pydantic import ConfigDict, TypeAdapter
from torch import Tensor, nn

from invertwin.errors import InputError
from invertwin.forward_model import Realisations
from invertwin.inversion.fingerprint import Fingerprint
from invertwin.inversion.gauss_newton import GaussNewton, no_effect_error
from invertwin.inversion.loss import MapPairs, Objective, resolve_loss
from invertwin.inversion.observation import Observation
from invertwin.inversion.optimizer import Optimizer
from invertwin.inversion.regularization import Regularizer
from invertwin.inversion.schedule import Stage
from invertwin.runtime.concurrency import torch_threads
from invertwin.scene.scene import Scene
from invertwin.seeds import derive_seed

Status = Literal["converged", "budget", "diverged"]

_MAX_RELATIVE_LOSS = 1e3  # times the first loss
_MAX_LOSS_INCREASE = 1.1  # final over initial loss, both without blur: more than noise
_CONVERGENCE_WINDOW = 20  # steps over which convergence is judged
_FRAME_SEED_KEY = 2**16  # seed keys that select frames, beyond those of observations
# State that an optimiser stores for a parameter.
_OPTIMIZER_STATE_KEYS: dict[type[torch.optim.Optimizer], set[str]] = {
    torch.optim.Adam: {"step", "exp_avg", "exp_avg_sq"},
    torch.optim.SGD: {"momentum_buffer"},
}
_UNBLURRED_SEED_KEY, _REALISATION_SEED_KEY = 2**17, 2**17 + 1  # seed keys beyond those of stages


@dataclass(frozen=True)
class FitProgress:
    """Progress of a fit: the content of a checkpoint besides parameters and optimiser.

    Attributes:
        first: initial parameters by name.
        step: number of completed steps.
        history: one row per step.
        best: step, loss and parameters of the lowest loss.
        ended: final status, once the fit has ended.
    """

    __pydantic_config__ = ConfigDict(arbitrary_types_allowed=True)

    first: dict[str, Tensor]
    step: int = 0
    history: list[dict[str, Any]] = field(default_factory=list)
    best: tuple[int, float, dict[str, Tensor]] | None = None
    ended: Status | None = None


_PROGRESS_ADAPTER = TypeAdapter(FitProgress)


class Callback:
    """Observer of a fit. Every method does nothing unless overridden."""

    def begin(self, fit: "Fit") -> None:
        """Called before the first step of every stage."""

    def annotate(self, fit: "Fit") -> dict[str, Any]:
        """Return values to add to the row of the completed step."""
        return {}

    def step(self, fit: "Fit", row: dict[str, Any]) -> None:
        """Called after every step.

        Args:
            fit: the running stage.
            row: complete row of the step.
        """

    def end(self, fit: "Fit") -> None:
        """Called when a stage has ended."""


class Fit:
    """One stage of a fit and its state.

    Attributes:
        scene: the scene before any module is applied.
        observations: observations with prepared models.
        unknowns: modules of the scene, applied in order.
        sensor_unknowns: modules of the sensor of each observation.
        stage: schedule of the stage.
        number: number of the stage, from 0.
        is_last: whether it is the last stage.
        progress: progress so far.
    """

    def __init__(
        self,
        scene: Scene,
        observations: Sequence[Observation],
        unknowns: Sequence[nn.Module],
        sensor_unknowns: Sequence[Sequence[nn.Module]],
        *,
        stage: Stage,
        settings: "FitSettings",
        rates: Mapping[nn.Parameter, float],
        stage_position: tuple[int, int, bool],
    ) -> None:
        """Prepare a stage.

        Args:
            scene, observations, unknowns, sensor_unknowns, stage: as the attributes.
            settings: settings common to all stages.
            rates: learning rates of single parameters.
            stage_position: number of the stage, number of steps before it, whether it is the last
                one.
        """
        self.scene, self.stage = scene, stage
        self.number, self._before, self.is_last = stage_position
        self.unknowns, self.sensor_unknowns = list(unknowns), [list(m) for m in sensor_unknowns]
        listed = [*self.unknowns, *(m for modules in self.sensor_unknowns for m in modules)]
        self.modules = nn.ModuleList(dict.fromkeys(listed))
        self._settings = settings
        self.observations = list(observations)
        self._observed = [observation.observed_map().detach() for observation in observations]
        losses = tuple(
            resolve_loss(o.model, o.loss or settings.loss, observed)
            for o, observed in zip(observations, self._observed, strict=True)
        )
        self.objective = Objective(losses, tuple(o.weight for o in observations))
        free = [p for p in self.modules.parameters() if p.requires_grad]
        if not free or stage.steps < 1:
            raise InputError(
                f"expected parameters to fit and steps >= 1, got {len(free)} and "
                f"{stage.steps}; give modules such as Pose('object')"
            )
        few = min(len(observed) for observed in self._observed)
        if stage.held_out is not None and few < stage.held_out:
            raise InputError(
                f"expected at least {stage.held_out} frames in every observation with held_out = "
                f"{stage.held_out}, got {few}; hold out none, or a larger share"
            )
        method = stage.optimizer or settings.optimizer
        not_smooth = [o.model for o in observations if not o.model.is_smooth]
        if not_smooth and method.kind == "gauss_newton":
            raise InputError(
                "expected smooth models such as SurrogateMap with kind 'gauss_newton', got "
                f"{type(not_smooth[0]).__name__}; use 'adam'"
            )
        # Before models draw random numbers, which follow from the rest.
        self.fingerprint = Fingerprint(
            (stage_position, stage, settings, self.modules, scene),
            [
                (o.model, o.sensor, o.weight, o.loss, observed)
                for o, observed in zip(observations, self._observed, strict=True)
            ],
        )
        self._models = [
            o.model.prepare(scene, o.sensor, derive_seed(settings.seed, k))
            for k, o in enumerate(observations)
        ]
        self._method, self.optimizer = method, method.build(self.modules, self.objective, rates)
        self.progress = FitProgress(self.parameters())

    def run(self, callbacks: Sequence[Callback]) -> Status:
        """Run all steps with the callbacks, and return the final status."""
        for callback in callbacks:
            callback.begin(self)
        if self.progress.ended is None:
            with torch_threads(max(1, torch.get_num_threads() // 2)):
                status = self._run_steps(callbacks)
            ended = self._select_best(status)
            self.progress = replace(self.progress, ended=ended)
        for callback in callbacks:
            callback.end(self)
        assert self.progress.ended is not None
        return self.progress.ended

    def apply_modules(self) -> tuple[Scene, list[Any]]:
        """Return the scene and all sensors under the present parameters."""
        targets = [self.scene, *(observation.sensor for observation in self.observations)]
        every = zip(targets, [self.unknowns, *self.sensor_unknowns], strict=True)
        scene, *sensors = (reduce(lambda x, module: module(x), own, x) for x, own in every)
        return scene, sensors

    def twin(self) -> Scene:
        """Return the scene under the present parameters, without derivatives."""
        with torch.no_grad():
            return self.apply_modules()[0]

    def maps(self, step: int) -> MapPairs:
        """Return the predicted and the observed map of every observation, equally blurred.

        Equal step numbers use equal random numbers.
        """
        scene, sensors = self.apply_modules()
        share = max(0.0, 1 - step / self.stage.blur_end)
        pairs = []
        every = zip(self._models, sensors, self._observed, strict=True)
        for k, (model, sensor, observed) in enumerate(every):
            sensor, observed = self._select_frames(k, step, sensor, observed)
            model = model.scale_blur(share)
            key = (self.number, step, k) if model.redraws else (k,)
            seed = derive_seed(self._settings.seed, *key)
            # On a core that is idle while the kernels of the prediction are compiled.
            with ThreadPoolExecutor(1) as beside:
                blurred = beside.submit(model.blur_observed, observed, sensor)
                predicted = model.predict(scene, sensor, seed)
                pairs.append((predicted, blurred.result().to(predicted.device)))
        return pairs

    def unblurred_maps(self, seed_number: int, **sampling_changes: Any) -> MapPairs:
        """Return predicted and observed maps with all frames and without blur.

        Args:
            seed_number: index of the random numbers.
            sampling_changes: fields of the models' ``sampling`` to replace.
        """
        scene, sensors = self.apply_modules()
        pairs = []
        for k, (model, sensor) in enumerate(zip(self._models, sensors, strict=True)):
            key = derive_seed(self._settings.seed, _UNBLURRED_SEED_KEY, seed_number, k)
            model = model.with_sampling(**sampling_changes) if sampling_changes else model
            predicted = model.scale_blur(0.0).predict(scene, sensor, key)
            pairs.append((predicted, self._observed[k].to(predicted.device)))
        return pairs

    def loss_at_start(self) -> float:
        """Return the loss without blur at the initial parameters of the stage."""
        own = self.copy()
        first = own.progress.first
        return own._loss_at(first, lambda: float(own.objective(own.unblurred_maps(0))))

    def realisations(self, seed_number: int) -> list[Realisations | None]:
        """Return functions that simulate recordings of the twin, see ``ForwardModel.realisations``.

        Args:
            seed_number: index of the random points on surfaces.
        """
        with torch.no_grad():
            scene, sensors = self.apply_modules()
            key = (self._settings.seed, _REALISATION_SEED_KEY, seed_number)
            return [
                model.realisations(scene, sensor, derive_seed(*key, k))
                for k, (model, sensor) in enumerate(zip(self._models, sensors, strict=True))
            ]

    def penalty(self) -> Tensor:
        """Return the sum of the regularisers."""
        scene = self.apply_modules()[0]
        terms = (term(scene) for term in self._settings.regularizers)
        return sum(terms, start=torch.zeros((), dtype=torch.float64))

    def evaluate(self, step: int) -> Tensor:
        """Return the loss with the random numbers of a step."""
        value = self.objective(self.maps(step))
        return value + self.penalty() if self._settings.regularizers else value

    def parameters(self) -> dict[str, Tensor]:
        """Return a copy of the present parameters."""
        return {k: v.detach().clone() for k, v in self.modules.state_dict().items()}

    def copy(self, *unknowns: nn.Module) -> "Fit":
        """Return a copy of the fit with its own parameters, at their present values.

        Args:
            unknowns: further modules of the scene, applied after the others.
        """
        other = copy.copy(self)
        own = (self.unknowns, self.sensor_unknowns, self.modules)
        other.unknowns, other.sensor_unknowns, other.modules = copy.deepcopy(own)
        other.unknowns += unknowns
        other.modules.extend(unknowns)
        return other

    def gauss_newton_step(self, optimizer: GaussNewton, step: int) -> float:
        """Take a Gauss–Newton step with the random numbers of a step, and return the loss before
        it.

        Args:
            optimizer: Gauss–Newton optimiser of this fit's modules.
            step: number of the step.
        """
        penalty = self.penalty if self._settings.regularizers else None
        return optimizer.step(partial(self.maps, step), penalty)

    def state(self) -> dict[str, Any]:
        """Return the state of the fit for a checkpoint."""
        return {
            "modules": self.modules.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "progress": vars(self.progress),
            "fingerprint": self.fingerprint.content(),
        }

    def restore(self, state: dict[str, Any]) -> bool:
        """Restore a ``state`` of this fit; for a state of another fit, change nothing and return
        False.

        A state with a matching fingerprint and corrupt content raises an error.
        """
        if not self.fingerprint.matches(state.get("fingerprint")):
            return False
        progress = _PROGRESS_ADAPTER.validate_python(state["progress"])
        kept = [state["modules"], progress.first, *(progress.best or ())[2:]]
        own = {name: value.shape for name, value in self.parameters().items()}
        if any({name: v.shape for name, v in values.items()} != own for values in kept):
            raise ValueError("parameters of another fit")
        if not all({"step", "stage", "loss", "values"} <= row.keys() for row in progress.history):
            raise ValueError("rows of another fit")
        self.modules.load_state_dict(state["modules"])
        _restore_optimizer(self.optimizer, state["optimizer"])
        self.progress = progress
        return True

    def is_unblurred(self, step: int) -> bool:
        """Return whether the added blur is zero from this step on."""
        return step >= self.stage.blur_end or not any(m.has_blur for m in self._models)

    def _select_frames(
        self, number: int, step: int, sensor: Any, observed: Tensor
    ) -> tuple[Any, Tensor]:
        """Select the frames of one observation that a step compares."""
        fitted = np.setdiff1d(np.arange(len(observed)), self._held_out_frames(len(observed)))
        count = min(self.stage.frames_per_step or len(fitted), len(fitted))
        if count == len(observed):
            return sensor, observed
        key = (self.number, step, _FRAME_SEED_KEY + number)
        rng = np.random.default_rng(derive_seed(self._settings.seed, *key))
        chosen = np.sort(rng.choice(fitted, count, replace=False))
        return sensor.frames(chosen.tolist()), observed.index_select(0, torch.from_numpy(chosen))

    def _held_out_frames(self, count: int) -> range:
        """Return the indices of the held-out frames among ``count`` frames."""
        every = self.stage.held_out
        return range(0) if every is None else range(every - 1, count, every)

    def _loss_at(self, parameters: dict[str, Tensor], loss: Callable[[], float]) -> float:
        """Load parameters, and return their loss: infinite where they are out of bounds."""
        self.modules.load_state_dict(parameters)
        try:
            with torch.no_grad():
                return loss()
        except InputError:
            return math.inf

    def _selection_loss(self) -> float:
        """Return the loss that decides whether the fit is better than its start."""
        if self.stage.held_out is None:
            return float(self.evaluate(self.stage.steps))
        held = [(self._held_out_frames(len(b)), a, b) for a, b in self.unblurred_maps(0)]
        return float(self.objective([(a[list(k)], b[list(k)]) for k, a, b in held]))

    def _run_steps(self, callbacks: Sequence[Callback]) -> Status:
        stage = self.stage
        while (step := self.progress.step) < stage.steps:
            self._method.set_rates(self.optimizer, step / stage.steps)
            before = self.parameters()
            try:
                number = self._take_step(step)
            except InputError:
                if self.progress.best is None:  # the initial parameters are invalid
                    raise
                number = math.nan
            if _has_diverged(number, self.progress.history):
                if self.progress.best is None:
                    raise InputError(
                        f"expected a finite loss at the start, got {number}; check the data and "
                        "the initial parameters"
                    )
                self.modules.load_state_dict(self.progress.best[2])
                return "diverged"
            self._keep_if_better(number, before)
            row: dict[str, Any] = {"step": self._before + step, "stage": self.number}
            row |= {"loss": number, "values": parameter_values(self.modules)}
            self.progress = replace(self.progress, step=step + 1)
            for callback in callbacks:
                row |= callback.annotate(self)
            self.progress.history.append(row)
            for callback in callbacks:
                callback.step(self, row)
            if stage.tolerance > 0 and self._has_converged(stage.tolerance):
                return "converged"
        return "converged" if self._has_converged(max(stage.tolerance, 1e-3)) else "budget"

    def _take_step(self, step: int) -> float:
        """Take one step, and return the loss before it."""
        if isinstance(self.optimizer, GaussNewton):
            return self.gauss_newton_step(self.optimizer, step)
        self.optimizer.zero_grad()
        value = self.evaluate(step)
        number = float(value.detach())
        if not _has_diverged(number, self.progress.history):
            if value.requires_grad:
                value.backward()
            _require_all_used(self.modules)
            self.optimizer.step()
        return number

    def _keep_if_better(self, loss: float, parameters: dict[str, Tensor]) -> None:
        """Keep the best parameters; a loss without blur takes precedence over one with blur."""
        best, step = self.progress.best, self.progress.step
        rank = (not self.is_unblurred(step), loss)
        if best is None or rank < (not self.is_unblurred(best[0]), best[1]):
            self.progress = replace(self.progress, best=(step, loss, parameters))

    def _select_best(self, status: Status) -> Status:
        """Load the best parameters, and return ``diverged`` if the fit ends worse than it began.

        If all steps have compared the same maps, these are the parameters of the lowest loss; else
        a step may owe its loss to its random numbers, and the last parameters are kept.
        """
        best = self.progress.best
        if best is None:
            return status
        ends = {"best": best[2], "first": self.progress.first}
        if status != "diverged":
            ends["last"] = self.parameters()
        losses = {name: self._loss_at(own, self._selection_loss) for name, own in ends.items()}
        last = losses.get("last", math.inf)
        rises = not math.isfinite(last) or last > _MAX_LOSS_INCREASE * losses["first"]
        redraws = self.stage.frames_per_step or any(model.redraws for model in self._models)
        kept = "last"
        if rises or (self.is_unblurred(0) and not redraws):
            # Losses of steps are of the fitted frames only; those here are of the selection frames.
            kept = min(losses, key=losses.__getitem__)
            chosen = (self.progress.step, losses[kept], ends[kept])
            self.progress = replace(self.progress, best=chosen)
        self.modules.load_state_dict(ends[kept])
        return "diverged" if rises else status

    def _has_converged(self, tolerance: float) -> bool:
        """Return whether the unblurred loss, averaged over two windows, no longer falls."""
        count = 2 * _CONVERGENCE_WINDOW
        rows = [row["loss"] for row in self.progress.history[-count:]]
        if len(rows) < count or not self.is_unblurred(self.progress.step - count):
            return False
        before, after = np.mean(rows[:_CONVERGENCE_WINDOW]), np.mean(rows[_CONVERGENCE_WINDOW:])
        return bool(before - after < tolerance * before)


@dataclass(frozen=True)
class FitSettings:
    """Settings common to all stages of a fit. See :func:`invertwin.reconstruct`."""

    loss: Callable[[Tensor, Tensor], Tensor] | None  # (predicted map, observed map) → number
    optimizer: Optimizer  # default optimiser of stages
    regularizers: tuple[Regularizer, ...]  # terms of the loss, besides those of the unknowns
    seed: int  # seed of all random numbers


def _restore_optimizer(
    optimizer: torch.optim.Optimizer | GaussNewton, state: dict[str, Any]
) -> None:
    """Restore the state of an optimiser for every parameter; its settings are those of the fit."""
    if isinstance(optimizer, GaussNewton):
        optimizer.load_state_dict(state)
        return
    if any(value.is_complex() for known in state["state"].values() for value in known.values()):
        raise ValueError("an optimiser of another fit")
    optimizer.load_state_dict({**optimizer.state_dict(), "state": state["state"]})
    names = _OPTIMIZER_STATE_KEYS[type(optimizer)]
    for parameter, known in optimizer.state.items():
        step = known.get("step", torch.zeros(()))
        counted = step.shape == () and step.is_floating_point() and 0 <= float(step) < math.inf
        alike = [
            value.shape == parameter.shape and value.dtype == parameter.dtype
            for name, value in known.items()
            if name != "step"
        ]
        if known.keys() != names or not (counted and all(alike)):
            raise ValueError("an optimiser of another fit")


def _require_all_used(modules: nn.ModuleList) -> None:
    for module in modules:
        for name, parameter in module.named_parameters():
            if parameter.requires_grad and parameter.grad is None:
                raise no_effect_error(module, name)


def _has_diverged(loss: float, history: list[dict[str, Any]]) -> bool:
    most = _MAX_RELATIVE_LOSS * history[0]["loss"] if history else math.inf
    return not math.isfinite(loss) or loss > most


def parameter_values(modules: nn.ModuleList) -> dict[str, Any]:
    """Return the named parameters as plain numbers; long ones (vertices) are in the checkpoint
    only.
    """
    named = (item for module in modules for item in getattr(module, "values", dict)().items())
    return {name: value.tolist() for name, value in named if value.numel() <= 16}
