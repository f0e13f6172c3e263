"""What a fit leaves to be seen in three dimensions: its steps, its twin, the truth, error bars."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from invertwin.cli.fits.problem import Problem, fitted_objects
from invertwin.errors import InputError
from invertwin.inversion import Callback
from invertwin.inversion.fit import Fit
from invertwin.scene import Scene
from invertwin.scene.shape_models.density import without_clouds
from invertwin.storage.folders import PARTS
from invertwin.viewer import (
    MEASURED,
    SIMULATED,
    Body,
    Display,
    Maps,
    Step,
    body_of,
    display_of,
    ellipsoid_layers,
    scene_layers,
)

VIEW = "view.npz"
"""The file of a run folder that `invertwin view` shows."""
_MOST_STEPS = 24  # of a fit, that are kept


class KeptSteps(Callback):
    """Keeps where a fit stood, in a file beside its checkpoint.

    Args:
        file: The file.
        names: Objects that are kept.
        total: Steps of all stages.
        every: Steps between checkpoints: what is kept goes on with these.
        show: Is told of every step that is kept.
    """

    def __init__(
        self,
        file: Path,
        names: Collection[str],
        total: int,
        every: int,
        show: Callable[[Fit, Step], None] | None,
    ) -> None:
        self._file, self._names, self._show = file, names, show
        self._apart, self._every = math.ceil(total / _MOST_STEPS), every
        self._steps: list[Step] = []
        self._written = 0

    def begin(self, fit: Fit) -> None:
        """Note the start, or read what an interrupted run has kept."""
        if not self._steps:
            self._steps = steps_in(self._file)
        if not self._steps:
            self._keep(fit, Step(0, "start", self._bodies(fit.twin())))

    def step(self, fit: Fit, row: dict[str, Any]) -> None:
        """Keep some of the steps."""
        number = row["step"] + 1
        # Steps after the checkpoint from which the fit goes on are done again.
        self._steps = [step for step in self._steps if step.number < number]
        if number % self._apart == 0:
            label = f"step {number}, loss {row['loss']:.4g}"
            # Parameters that the scene refuses have no picture; the fit ends as diverged.
            with suppress(InputError):
                self._keep(fit, Step(number, label, self._bodies(fit.twin())))
        if fit.progress.step % self._every == 0:
            self._write()

    def end(self, fit: Fit) -> None:
        """Write what is kept."""
        self._write()

    def _keep(self, fit: Fit, step: Step) -> None:
        self._steps.append(step)
        if self._show is not None:
            self._show(fit, step)

    def _write(self) -> None:
        if self._written != self._steps[-1].number or not self._file.exists():
            self._written = self._steps[-1].number
            Display("", [], self._steps).save(self._file)

    def _bodies(self, scene: Scene) -> dict[str, Body]:
        scene = without_clouds(scene)
        before = self._steps[-1].bodies if self._steps else {}
        found = {}
        for name in self._names:
            body = body_of(scene[name])
            if name in before and np.array_equal(body.faces, before[name].faces):
                body = Body(body.vertices, before[name].faces)  # kept once
            found[name] = body
        return found


def steps_file(checkpoint: str) -> str:
    """Where the steps of a fit are kept, as a path in the run's folder.

    Args:
        checkpoint: That of the fit.
    """
    return f"{PARTS}/{Path(checkpoint).stem}_steps.npz"


def steps_in(file: Path) -> list[Step]:
    """The steps that a fit has kept.

    Args:
        file: Of `KeptSteps`.
    """
    return list(Display.load(file).steps) if file.exists() else []


def display_of_fit(
    problem: Problem,
    start: Scene,
    twin: Scene,
    maps: Mapping[str, Sequence[Tensor]],
    metrics: Mapping[str, Any],
    steps: Sequence[Step],
) -> Display:
    """A display of a fit that has ended.

    Args:
        problem: What was fitted.
        start: From where.
        twin: What was found.
        maps: "measured" and "twin" of every sensor.
        metrics: Its error bars.
        steps: Those that were kept.
    """
    display = display_of_problem(problem, twin)
    names = [name for name in fitted_objects(problem.run) if name in start.names]
    more = scene_layers(start, "start", fitted=names, only=True)
    return replace(
        display,
        layers=[*display.layers, *more, *ellipsoid_layers(twin, metrics)],
        steps=steps,
        maps=maps_of_sensors(problem, {MEASURED: maps["measured"], SIMULATED: maps["twin"]}),
    )


def maps_of_sensors(
    problem: Problem, spectra: Mapping[str, Sequence[Tensor]], most: int | None = None
) -> dict[str, Maps]:
    """What the sensors of a fit see, by their names.

    Args:
        problem: What is fitted.
        spectra: Power [frame, range, u, v] of every sensor, by what is shown.
        most: Values that are kept of a sensor, about; None = of a few megabytes.
    """
    limit = {} if most is None else {"most": most}
    return {
        name: Maps.of({what: own[k] for what, own in spectra.items()}, sight.grid, **limit)
        for k, (name, sight) in enumerate(problem.sights.items())
    }


def display_of_problem(problem: Problem, scene: Scene) -> Display:
    """A display of a fit: its objects, the truth where it is known, the radars.

    Args:
        problem: What is fitted.
        scene: The start or the twin.
    """
    names = [name for name in fitted_objects(problem.run) if name in scene.names]
    known = any(name in problem.known for name in names)
    sights = {name: (sight.radar, sight.grid) for name, sight in problem.sights.items()}
    title = problem.run.title or "Reconstruction"
    return display_of(scene, sights, title, truth=problem.truth if known else None, fitted=names)
