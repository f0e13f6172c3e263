"""The loop: simulate, compare, step, until the twin answers as the real scene did."""

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from invertwin.capture.capture import Capture
from invertwin.channel import (
    Grid,
    RoughPaths,
    RoughPoints,
    Sampling,
    draw_speckle,
    use_backend,
)
from invertwin.errors import InputError
from invertwin.inversion.gauss_newton import GaussNewton, without_effect
from invertwin.inversion.loss import SpectrumLoss
from invertwin.inversion.optimizer import Optimizer
from invertwin.inversion.regularization import Regularizer
from invertwin.radar.parameters import ClockOffset, RadarPose, RangeBias
from invertwin.radar.radar import Radar
from invertwin.radar.surrogate import Surrogate, chosen_surrogate, surrogate_spectrum
from invertwin.scene.scene import Scene
from invertwin.simulation import simulate

Status = Literal["converged", "budget", "diverged"]

_CHAINS = 200_000  # of each length, where the exact chain is fitted
OF_RADARS = (ClockOffset, RadarPose, RangeBias)  # modules Radar → Radar; others map scenes
_DIVERGED = 1e3  # times the first loss
_WORSE = 1.1  # times the loss of the first parameters, all widths at their end: more than noise
_WINDOW = 20  # steps over which convergence is judged


@dataclass(frozen=True)
class Reconstruction:
    """The outcome of :func:`reconstruct`.

    Attributes:
        scene: The twin.
        radar: The radar with the poses of the fit.
        parameters: The fitted modules.
        history: One row a step: ``step``, ``loss``, ``values`` (parameters by name).
        status: ``converged`` (the loss no longer falls), ``budget`` (all steps done), or
            ``diverged`` (not finite, or worse than the start; then the best state is kept).
        steps: Steps done.
        loss: Of the state returned, at the widths of the last step; of the best state of a fit
            that has diverged, without extra widths.
    """

    scene: Scene
    radar: Radar
    parameters: nn.ModuleList
    history: list[dict[str, Any]]
    status: Status
    steps: int
    loss: float


def reconstruct(
    scene: Scene,
    radar: Radar,
    capture: Capture,
    parameters: nn.Module | Sequence[nn.Module],
    *,
    grid: Grid,
    loss: Callable[[Tensor, Tensor], Tensor] | None = None,
    optimizer: Optimizer | None = None,
    surrogate: Surrogate | str | None = "annealed",
    steps: int = 200,
    annealing: float = 0.7,
    seed: int = 0,
    depth: int = 3,
    samples: int = 400_000,
    boundary_samples: int = 50_000,
    boundary: bool = True,
    density: float = 20_000.0,
    points: RoughPoints | None = None,
    frames_per_step: int | None = None,
    nuisances: Sequence[nn.Module] = (),
    regularizers: Sequence[Regularizer] = (),
    tolerance: float = 0.0,
    checkpoint: str | Path | None = None,
    checkpoint_every: int = 10,
    resume: bool = False,
    backend: str | None = None,
    watch: Callable[[Scene], dict[str, float]] | None = None,
    watch_every: int = 10,
    progress: Callable[[dict[str, Any]], None] | None = None,
) -> Reconstruction:
    """Find the parameters of a scene whose simulated spectrum equals a measured one.

    Every step draws new samples, deposits power paths, shapes them with the surrogate, and
    follows the gradient of the loss, silhouettes included. Surrogate and data are blurred by the
    same extra widths, which fall to zero over the first ``annealing`` of the steps.

    Args:
        scene: Starting scene.
        radar: The radar of the capture.
        capture: Measured data.
        parameters: One or more modules Scene → Scene or Radar → Radar, applied in order
            (``scene.parameters``).
        grid: Bins that are compared.
        loss: How maps are compared: (simulated, measured) → a number.
        optimizer: Kind and rates.
        surrogate: Kernels, and the extra widths at the first step; or a name among
            ``SURROGATES``. None, "exact" = the exact chain, whose loss has a minimum every half
            wavelength and whose rough surfaces need ``boundary=False``: for comparison.
        steps: Budget.
        annealing: Share of the steps with extra widths.
        seed: Of all samples; the same seed gives the same fit.
        depth: Most bounces of a path.
        samples: Interior samples a step, over the frames of the step.
        boundary_samples: Silhouette samples a step.
        boundary: Off for ablation.
        density: Points per m² of rough surfaces (exact).
        points: Rough points with their phases, which a twin does not know; None = drawn (exact).
        frames_per_step: Random subset of frames a step (None = all).
        nuisances: ``RangeBias``, ``ClockOffset``.
        regularizers: Added to the loss, functions of the scene.
        tolerance: Once the widths are zero, stop when the loss has fallen by less than this
            share over 20 steps (0 = use the whole budget).
        checkpoint: File that is written atomically every ``checkpoint_every`` steps.
        checkpoint_every: [steps].
        resume: Go on from ``checkpoint`` if it is there.
        backend: See ``deposit_power``.
        watch: Numbers about the twin, such as its distance from a known truth, which join the
            row of every ``watch_every``-th step; they do not change the fit.
        watch_every: [steps].
        progress: Called with every row of the history.

    Source: §4.2 of the paper.
    Differs from the source: Adam and Gauss–Newton beside SGD; annealed widths.

    Raises:
        InputError: Nothing to fit, a map of zeros, a checkpoint of another fit; a range bias
            with the exact chain.
    """
    smooth = chosen_surrogate(surrogate)
    chains = None
    if smooth is None:
        drawn = Sampling(depth=depth, points_per_m2=density, rough_paths=_CHAINS)
        speckle = draw_speckle(scene, radar.link(), drawn, seed)
        points, chains = points or speckle.points, speckle.paths
    rates = optimizer or Optimizer()
    listed = [parameters] if isinstance(parameters, nn.Module) else list(parameters)
    fit = _Fit(
        scene=scene,
        radar=radar,
        modules=nn.ModuleList([*listed, *nuisances]),
        measured=capture.spectrum(grid).to(torch.float32),
        grid=grid,
        loss=loss or SpectrumLoss(),
        optimizer=rates,
        surrogate=smooth,
        points=points,
        chains=chains,
        annealing=annealing,
        seed=seed,
        depth=depth,
        samples=samples,
        boundary_samples=boundary_samples,
        boundary=boundary,
        frames_per_step=frames_per_step,
        regularizers=tuple(regularizers),
        steps=steps,
        watch=watch,
        watch_every=watch_every,
    )
    sought = [p for p in fit.modules.parameters() if p.requires_grad]
    if not sought or steps < 1:
        raise InputError(
            f"expected parameters to fit and steps >= 1, got {len(sought)} and {steps}; "
            "give modules such as Pose('object')"
        )
    if smooth is None and rates.kind == "gauss_newton":
        raise InputError(
            "expected a surrogate with kind 'gauss_newton', got the exact chain; use 'adam'"
        )
    state = _State(rates.build(fit.modules, fit.loss), fit.parameters())
    path = Path(checkpoint) if checkpoint is not None else None
    if resume and path is not None and path.exists():
        state.load(path, fit)
    if state.ended is None:
        with use_backend(backend):
            status = _descend(fit, state, rates, tolerance, path, checkpoint_every, progress)
            state.ended = _judged(fit, state, status)
        if path is not None:
            state.save(path, fit)
    status = state.ended
    with torch.no_grad():
        moved, seen = fit.applied()
    loss_then = state.history[-1]["loss"]
    if status == "diverged" and state.best is not None:
        loss_then = state.best[1]
    return Reconstruction(moved, seen, fit.modules, state.history, status, state.step, loss_then)


@dataclass
class _State:
    """What a checkpoint holds besides the parameters."""

    optimizer: torch.optim.Optimizer | GaussNewton
    first: dict[str, Tensor]
    step: int = 0
    history: list[dict[str, Any]] = field(default_factory=list)
    best: tuple[int, float, dict[str, Tensor]] | None = None
    ended: Status | None = None

    def keep_if_better(self, loss: float, fit: "_Fit", parameters: dict[str, Tensor]) -> None:
        """Remember the parameters of the lowest loss; without extra widths beats with."""
        if self.best is not None:
            first = fit.annealed(self.step) and not fit.annealed(self.best[0])
            if not first and loss >= self.best[1]:
                return
        self.best = (self.step, loss, parameters)

    def save(self, path: Path, fit: "_Fit") -> None:
        """Write atomically: a kill leaves the last whole file."""
        part = path.with_suffix(path.suffix + ".part")
        content = {
            "modules": fit.modules.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "first": self.first,
            "step": self.step,
            "history": self.history,
            "best": self.best,
            "ended": self.ended,
            "key": fit.key(),
        }
        torch.save(content, part)
        os.replace(part, path)

    def load(self, path: Path, fit: "_Fit") -> None:
        """Restore from a file of the same fit."""
        try:
            content = torch.load(path, weights_only=True)
        except Exception as error:
            raise InputError(
                f"expected a checkpoint in {path}, got a file that cannot be read "
                f"({type(error).__name__}); delete it or start without resume"
            ) from None
        if not isinstance(content, dict) or not _same(content.get("key"), fit.key()):
            raise InputError(
                f"expected a checkpoint of this fit in {path}, got one of another (steps, seed, "
                "grid, loss, optimizer, surrogate, parameters, start or data differ); start "
                "without resume"
            )
        fit.modules.load_state_dict(content["modules"])
        self.optimizer.load_state_dict(content["optimizer"])
        self.first, self.best = content["first"], content["best"]
        self.step, self.history = content["step"], content["history"]
        self.ended = content["ended"]


@dataclass(frozen=True)
class _Fit:
    """The forward model and the loss of one step; pure in (parameters, step)."""

    scene: Scene
    radar: Radar
    modules: nn.ModuleList
    measured: Float[Tensor, "frame range u v"]
    grid: Grid
    loss: Callable[[Tensor, Tensor], Tensor]
    optimizer: Optimizer
    surrogate: Surrogate | None
    points: RoughPoints | None
    chains: RoughPaths | None
    annealing: float
    seed: int
    depth: int
    samples: int
    boundary_samples: int
    boundary: bool
    frames_per_step: int | None
    regularizers: tuple[Regularizer, ...]
    steps: int
    watch: Callable[[Scene], dict[str, float]] | None
    watch_every: int

    def key(self) -> list[Any]:
        """What must be equal for a checkpoint to be of this fit."""
        shapes = [[n, list(p.shape)] for n, p in self.modules.named_parameters()]
        settings = [self.annealing, self.samples, self.boundary_samples, self.frames_per_step]
        settings += [self.depth, str(self.loss), str(self.surrogate), str(self.optimizer)]
        sizes = [float(self.measured.double().norm())]
        sizes += [float(item.vertices.detach().norm()) for item in self.scene.objects.values()]
        return [
            self.steps,
            self.seed,
            list(self.grid.shape),
            self.boundary,
            settings,
            shapes,
            sizes,
        ]

    def applied(self) -> tuple[Scene, Radar]:
        """Scene and radar under the present parameters."""
        scene, radar = self.scene, self.radar
        for module in self.modules:
            if isinstance(module, OF_RADARS):
                radar = module(radar)
            else:
                scene = module(scene)
        return scene, radar

    def watched(self, step: int) -> dict[str, float]:
        """What is watched of the twin after so many steps."""
        if self.watch is None or step % self.watch_every:
            return {}
        try:
            with torch.no_grad():
                return self.watch(self.applied()[0])
        except InputError:  # parameters out of bounds, as the next step will find
            return {}

    def parameters(self) -> dict[str, Tensor]:
        """A copy of the present parameters."""
        return {k: v.detach().clone() for k, v in self.modules.state_dict().items()}

    def widths(self, step: int) -> Surrogate | None:
        """The surrogate with the extra widths of a step; None for the exact chain."""
        if self.surrogate is None:
            return None
        left = max(0.0, 1 - step / self.widths_end)
        return replace(
            self.surrogate,
            range_width=self.surrogate.range_width * left,
            angle_width=self.surrogate.angle_width * left,
        )

    @property
    def widths_end(self) -> float:
        """The step from which there are no extra widths: the last one at the latest."""
        return max(1.0, min(self.annealing * self.steps, self.steps - 1))

    def annealed(self, step: int) -> bool:
        """Whether the extra widths are zero from this step on."""
        return self.surrogate is None or step >= self.widths_end

    def maps(self, step: int) -> tuple[Tensor, Tensor]:
        """Simulated and measured map of a step, blurred alike."""
        scene, radar = self.applied()
        measured, kernels = self.measured, self.widths(step)
        if self.frames_per_step is not None and self.frames_per_step < radar.frame_count:
            rng = np.random.default_rng([self.seed, step])
            chosen = np.sort(rng.choice(radar.frame_count, self.frames_per_step, replace=False))
            radar, measured = radar.frames(chosen.tolist()), measured[torch.from_numpy(chosen)]
        if kernels is None:
            return self._exact(scene, radar), measured
        simulated = surrogate_spectrum(
            scene,
            radar,
            self.grid,
            kernels,
            sampling=Sampling(
                depth=self.depth,
                samples=self.samples,
                boundary_samples=self.boundary_samples,
                boundary=self.boundary,
            ),
            seed=self.seed * 1_000_003 + step,
        )
        return simulated, kernels.blur(measured, radar, self.grid)

    def penalty(self) -> Tensor:
        """What the regularisers add to the loss."""
        scene, total = self.applied()[0], torch.zeros((), dtype=torch.float64)
        for term in self.regularizers:
            total = total + term(scene)
        return total

    def evaluate(self, step: int) -> Tensor:
        """The loss of a step."""
        value = self.loss(*self.maps(step))
        return value + self.penalty() if self.regularizers else value

    def _exact(self, scene: Scene, radar: Radar) -> Tensor:
        """The exact chain's map; the same samples and phases every step."""
        found = simulate(
            scene,
            radar,
            self.grid,
            seed=self.seed,
            depth=self.depth,
            samples=self.samples,
            boundary_samples=self.boundary_samples,
            boundary=self.boundary,
            points=self.points,
            chains=self.chains,
        )
        return found.spectrum.to(torch.float32)


def _descend(
    fit: _Fit,
    state: _State,
    rates: Optimizer,
    tolerance: float,
    checkpoint: Path | None,
    every: int,
    progress: Callable[[dict[str, Any]], None] | None,
) -> Status:
    while state.step < fit.steps:
        rates.apply(state.optimizer, state.step / fit.steps)
        before = fit.parameters()
        try:
            number = _stepped(fit, state)
        except InputError:
            if state.best is None:  # not lost on the way, but wrong from the start
                raise
            number = math.nan
        if _lost(number, state.history):
            if state.best is None:
                raise InputError(
                    f"expected a finite loss at the start, got {number}; check the capture and "
                    "the initial parameters"
                )
            fit.modules.load_state_dict(state.best[2])
            return "diverged"
        state.keep_if_better(number, fit, before)
        row = {"step": state.step, "loss": number, "values": _values(fit.modules)}
        state.step += 1
        state.history.append(row | fit.watched(state.step))
        if progress:
            progress(state.history[-1])
        if checkpoint is not None and state.step % every == 0:
            state.save(checkpoint, fit)
        if tolerance > 0 and _settled(fit, state, tolerance):
            return "converged"
    return "converged" if _settled(fit, state, max(tolerance, 1e-3)) else "budget"


def _stepped(fit: _Fit, state: _State) -> float:
    """The loss of the present parameters, which then take a step down."""
    if isinstance(state.optimizer, GaussNewton):
        maps = partial(fit.maps, state.step)
        return state.optimizer.step(maps, fit.penalty if fit.regularizers else None)
    state.optimizer.zero_grad()
    value = fit.evaluate(state.step)
    number = float(value.detach())
    if not _lost(number, state.history):
        if value.requires_grad:
            value.backward()
        _require_all_used(fit.modules)
        state.optimizer.step()
    return number


def _require_all_used(modules: nn.ModuleList) -> None:
    for module in modules:
        for name, parameter in module.named_parameters():
            if parameter.requires_grad and parameter.grad is None:
                raise without_effect(module, name)


def _judged(fit: _Fit, state: _State, status: Status) -> Status:
    """The status, or ``diverged`` for a fit that ends worse than it started; the best is kept."""
    if state.best is None:
        return status
    ends = {"first": state.first, "best": state.best[2]}
    if status != "diverged":
        ends["last"] = fit.parameters()
    losses = {}
    with torch.no_grad():
        for name, parameters in ends.items():
            fit.modules.load_state_dict(parameters)
            try:
                losses[name] = float(fit.evaluate(fit.steps))
            except InputError:  # out of bounds
                losses[name] = math.inf
    last = losses.get("last", math.inf)
    if math.isfinite(last) and last <= _WORSE * losses["first"]:
        fit.modules.load_state_dict(ends["last"])
        return status
    kept = min(("first", "best"), key=lambda name: losses[name])
    fit.modules.load_state_dict(ends[kept])
    state.best = (state.step, losses[kept], ends[kept])
    return "diverged"


def _same(kept: Any, own: list[Any]) -> bool:
    """Whether two keys of fits are one, but for the rounding of the sizes."""
    return (
        isinstance(kept, list)
        and kept[:-1] == own[:-1]
        and len(kept[-1]) == len(own[-1])
        and all(math.isclose(a, b, rel_tol=1e-3) for a, b in zip(kept[-1], own[-1], strict=True))
    )


def _lost(loss: float, history: list[dict[str, Any]]) -> bool:
    return not math.isfinite(loss) or bool(history and loss > _DIVERGED * history[0]["loss"])


def _settled(fit: _Fit, state: _State, tolerance: float) -> bool:
    """Whether the loss, averaged over two windows without extra widths, no longer falls."""
    rows = [row["loss"] for row in state.history[-2 * _WINDOW :]]
    if len(rows) < 2 * _WINDOW or not fit.annealed(state.step - 2 * _WINDOW):
        return False
    before, after = np.mean(rows[:_WINDOW]), np.mean(rows[_WINDOW:])
    return bool(before - after < tolerance * before)


def _values(modules: nn.ModuleList) -> dict[str, Any]:
    """Parameters by name as plain numbers; long ones (vertices) are left to the checkpoint."""
    rows: dict[str, Any] = {}
    for module in modules:
        for name, value in getattr(module, "values", dict)().items():
            if value.numel() <= 16:
                rows[name] = value.tolist()
    return rows
