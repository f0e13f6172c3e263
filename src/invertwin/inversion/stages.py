"""Fits in stages: which parameters are free when, coarse before fine, one shape after another."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path, PurePath
from typing import Any

import torch
from torch import nn

from invertwin.capture.capture import Capture
from invertwin.errors import InputError
from invertwin.inversion.reconstruction import OF_RADARS, Optimizer, Reconstruction, reconstruct
from invertwin.inversion.regularization import Regularizer
from invertwin.radar.radar import Radar
from invertwin.scene.geometry.density import without_clouds
from invertwin.scene.mesh import Mesh
from invertwin.scene.scene import Scene

Build = Callable[[Scene], nn.Module]
Regularize = Callable[[Mapping[str, nn.Module], Mapping[str, Scene]], Sequence[Regularizer]]


@dataclass(frozen=True)
class Stage:
    """A part of a fit.

    Attributes:
        steps: Budget.
        sought: Names of the parameters that are free; the others keep their values. Empty = all.
        rebuild: Begin from the twin of the stage before, with new modules of the sought
            parameters only: for another kind of shape, or a finer mesh.
        remesh: Of every object that it names, what to do with its mesh before modules are built.
        options: Of :func:`reconstruct`, in place of those of the whole fit.
    """

    steps: int
    sought: tuple[str, ...] = ()
    rebuild: bool = False
    remesh: Mapping[str, Callable[[Mesh], Mesh]] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)


def reconstruct_in_stages(
    scene: Scene,
    radar: Radar,
    capture: Capture,
    builders: Mapping[str, Build],
    stages: Sequence[Stage],
    *,
    rates: Mapping[str, float] | None = None,
    regularize: Regularize | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    seed: int = 0,
    progress: Callable[[dict[str, Any]], None] | None = None,
    **options: Any,
) -> Reconstruction:
    """Fit in stages, each a :func:`reconstruct` that goes on from the one before.

    One that diverges keeps its best state, from which the next goes on.

    Args:
        scene: Starting scene.
        radar: The radar of the capture.
        capture: Measured data.
        builders: By name, what makes the module of a parameter for a scene; they are applied in
            this order.
        stages: One after another.
        rates: Learning rates of parameters by name, in place of the optimizer's.
        regularize: Terms of the loss, for the modules of a stage and, by the same names, the
            scenes that they were built for.
        checkpoint: File of the last stage's state; those before have its name and their number.
        resume: Go on from the checkpoints that are there.
        seed: Of the first stage; each later one has the next.
        progress: Called with every row of the history.
        options: Of every stage's :func:`reconstruct`.

    Returns:
        The last stage's outcome, with the history of all: its rows have ``stage``, from 0, and
        ``step`` counts through.

    Raises:
        InputError: No stages, an unknown name, or what :func:`reconstruct` refuses.
    """
    if not stages:
        raise InputError("expected at least one stage, got none; give Stage(steps)")
    _require_kept(builders, stages)
    modules: dict[str, nn.Module] = {}
    seen: dict[str, Scene] = {}
    history: list[dict[str, Any]] = []
    found: Reconstruction | None = None
    free: dict[nn.Parameter, bool] = {}
    last = len(stages) - 1
    for k, stage in enumerate(stages):
        if found is None or stage.rebuild or stage.remesh:
            if found is not None:
                # What was a cloud goes on as a mesh.
                scene = without_clouds(found.scene)
                # Modules of the sensor that stay add the bias again.
                radar = replace(found.radar, range_bias=radar.range_bias)
            for name, change in stage.remesh.items():
                scene = scene.replace(name, mesh=change(scene[name].mesh))
            # Modules are built in order, each for the scene as those before it leave it.
            modules, seen, before = {}, {}, scene
            for name in builders:
                if found is None or not stage.sought or name in stage.sought:
                    modules[name], seen[name] = builders[name](before), before
                    if not isinstance(modules[name], OF_RADARS):
                        with torch.no_grad():
                            before = modules[name](before)
            free = {p: p.requires_grad for m in modules.values() for p in m.parameters()}
        sought = stage.sought or tuple(modules)
        for name, module in modules.items():
            for parameter in module.parameters():
                parameter.requires_grad_(free[parameter] and name in sought)
        terms = regularize(modules, seen) if regularize else ()
        file = (
            checkpoint if k == last or checkpoint is None else stage_checkpoint(str(checkpoint), k)
        )
        settings = {**options, **stage.options}
        own = tuple((rates or {}).get(name) for name in modules)
        optimizer = replace(settings.pop("optimizer", None) or Optimizer(), module_rates=own)
        counted = partial(_counted, len(history), k)
        found = reconstruct(
            scene,
            radar,
            capture,
            list(modules.values()),
            **{
                **settings,
                "optimizer": optimizer,
                "steps": stage.steps,
                "seed": seed + k,
                "regularizers": terms,
                "checkpoint": file,
                "resume": resume,
                "progress": progress and (lambda row, of=counted: progress(of(row))),
            },
        )
        history += [counted(row) for row in found.history]
    assert found is not None
    return replace(found, history=history, steps=len(history))


def _require_kept(builders: Mapping[str, Build], stages: Sequence[Stage]) -> None:
    """Refuse stages that seek what is not there, before any step is taken."""
    kept = set(builders)
    for k, stage in enumerate(stages):
        for name in stage.sought:
            if name not in builders:
                raise InputError(
                    f"expected names of parameters in stage {k + 1} ({', '.join(builders)}), got "
                    f"{name!r}; correct it"
                )
        if k == 0 or stage.rebuild or stage.remesh:
            kept = set(stage.sought or builders) if k else set(builders)
        gone = [name for name in stage.sought if name not in kept]
        if gone:
            raise InputError(
                f"expected parameters that a stage before has kept, got {gone[0]!r} in stage "
                f"{k + 1}; rebuild it there"
            )


def _counted(before: int, stage: int, row: dict[str, Any]) -> dict[str, Any]:
    """A row of a stage as one of the whole fit."""
    return {**row, "step": before + row["step"], "stage": stage}


def stage_checkpoint(checkpoint: str, stage: int) -> str:
    """The file of a stage that is not the last."""
    path = PurePath(checkpoint)
    return str(path.with_name(f"{path.stem}_stage{stage}{path.suffix}"))
