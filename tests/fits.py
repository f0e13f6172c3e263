"""A fit by flat keywords: what most tests of fits change is one setting."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from invertwin.capture import Capture
from invertwin.channel import Grid, Sampling
from invertwin.forward_model import ForwardModel
from invertwin.inversion import (
    Checkpoint,
    Observation,
    Reconstruction,
    Report,
    Schedule,
    SpectrumLoss,
    Watch,
    reconstruct,
)
from invertwin.inversion.fit import Callback
from invertwin.models.radar import ExactMap, SurrogateMap
from invertwin.radar import Radar, Surrogate
from invertwin.scene import Scene

_SAMPLING = {"depth", "samples", "boundary_samples", "boundary", "points_per_m2"}
_SCHEDULE = {"steps", "annealing", "frames_per_step", "held_out", "tolerance"}


def fit(
    scene: Scene,
    radar: Radar,
    capture: Capture,
    parameters: Any,
    *,
    grid: Grid,
    surrogate: Surrogate | str = "response",
    of_radar: Any = (),
    stages: Sequence[Schedule] | None = None,
    checkpoint: Path | None = None,
    checkpoint_every: int = 10,
    resume: bool = False,
    progress: Callable[[dict[str, Any]], None] | None = None,
    watch: Callable[[Scene], dict[str, float]] | None = None,
    watch_every: int = 10,
    **others: Any,
) -> Reconstruction:
    """``reconstruct`` from one radar.

    Args:
        scene: Starting scene.
        radar: Of the capture.
        capture: What was recorded.
        parameters: Unknowns of the scene.
        grid: Bins that are compared.
        surrogate: A surrogate or its name; "exact" = the exact simulation.
        of_radar: Unknowns of the radar.
        stages: In place of the settings of one schedule.
        checkpoint: File of the checkpoints; None = none.
        checkpoint_every: [steps].
        resume: Go on from it.
        progress: Called with every row.
        watch: See ``Watch``.
        watch_every: [steps].
        others: Settings of ``Sampling`` and ``Schedule``, and keywords of ``reconstruct``; without
            a loss it is ``SpectrumLoss("mse")``.
    """
    # The bounds of these fits are those of squares: single realisations, in few bins.
    others.setdefault("loss", SpectrumLoss("mse"))
    drawn = Sampling(**{name: others.pop(name) for name in _SAMPLING & others.keys()})
    schedule = Schedule(**{name: others.pop(name) for name in _SCHEDULE & others.keys()})
    model: ForwardModel = (
        ExactMap(grid, drawn) if surrogate == "exact" else SurrogateMap(grid, surrogate, drawn)
    )
    callbacks: list[Callback] = []
    if watch is not None:
        callbacks.append(Watch(watch, watch_every))
    if progress is not None:
        callbacks.append(Report(progress))
    if checkpoint is not None:
        callbacks.append(Checkpoint(checkpoint, checkpoint_every, resume))
    return reconstruct(
        scene,
        Observation(model, capture, sensor=radar, parameters=of_radar),
        parameters,
        schedule=schedule if stages is None else stages,
        callbacks=callbacks,
        **others,
    )
