"""Schedules of a fit: number of steps, blur, and free unknowns of each stage."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Annotated

from annotated_types import Ge, Gt, Le

from invertwin.checks import check_choice
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel
from invertwin.inversion.optimizer import Optimizer
from invertwin.limits import Count, NonNegative
from invertwin.scene.mesh import Mesh


@dataclass(frozen=True)
class Schedule:
    """Number of steps of a fit, and its annealing.

    Attributes:
        steps: budget of steps.
        annealing: fraction of the steps with blur.
        frames_per_step: number of random frames of every observation in a step; None = all.
        held_out: every n-th frame of every observation is held out for validation. A fit that
            explains these frames worse than its start has diverged, and keeps the start. None = no
            frame.
        tolerance: without blur, the fit stops when the loss has fallen by less than this fraction
            over 20 steps; 0 = use the whole budget.
    """

    steps: Count = 200
    _: KW_ONLY
    annealing: Annotated[float, Gt(0), Le(1)] = 0.7
    frames_per_step: Count | None = None
    held_out: Annotated[int, Ge(2)] | None = None
    tolerance: NonNegative = 0.0

    @property
    def blur_end(self) -> float:
        """First step without blur: the last step at the latest."""
        return max(1.0, min(self.annealing * self.steps, self.steps - 1))


@dataclass(frozen=True, kw_only=True)
class Stage(Schedule):
    """Part of a fit. It continues from the end of the previous stage.

    Attributes:
        unknowns: names of the free unknowns; the others keep their values. Empty = all.
        rebuild: start from the twin of the previous stage with new modules of these unknowns only:
            for another shape model, or a finer mesh.
        remesh: for every object named here, a function of its mesh that is applied before modules
            are rebuilt.
        optimizer: optimiser of this stage; None = that of the whole fit.
        models: forward models of the observations in this stage, in their order; empty = their own.
    """

    unknowns: tuple[str, ...] = ()
    rebuild: bool = False
    remesh: Mapping[str, Callable[[Mesh], Mesh]] = field(default_factory=dict)
    optimizer: Optimizer | None = None
    models: Sequence[ForwardModel] = ()

    @property
    def rebuilds_modules(self) -> bool:
        """True if modules are rebuilt."""
        return self.rebuild or bool(self.remesh)


def make_stages(
    schedule: Schedule | Sequence[Schedule] | None, names: Sequence[str]
) -> list[Stage]:
    """Convert a schedule to stages.

    Args:
        schedule: one part or several; None = one with the defaults.
        names: names of all unknowns of the scene.

    Raises:
        InputError: No stages, an unknown name, or an unknown that an earlier stage has dropped.
    """
    parts = [schedule or Schedule()] if isinstance(schedule, Schedule | None) else list(schedule)
    if not parts:
        raise InputError("expected at least one stage, got none; give Stage(steps)")
    stages = [part if isinstance(part, Stage) else Stage(**vars(part)) for part in parts]
    kept = set(names)
    for number, stage in enumerate(stages):
        for name in stage.unknowns:
            check_choice(name, names, f"names of parameters in stage {number + 1}:", "correct it")
        if number and stage.rebuilds_modules:
            kept = set(stage.unknowns or names)
        gone = [name for name in stage.unknowns if name not in kept]
        if gone:
            raise InputError(
                f"expected parameters that the previous stage has kept, got {gone[0]!r} in stage "
                f"{number + 1}; rebuild it there"
            )
    return stages
