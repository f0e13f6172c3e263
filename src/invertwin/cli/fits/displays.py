"""Displays of a fit in three dimensions: its steps, its twin, the truth, error bars."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from invertwin import viewer
from invertwin.cli.fits.problem import Fits, Problem, SensorData, Start
from invertwin.errors import InputError
from invertwin.inversion import Callback, Fit
from invertwin.links import Metasurface, PropagationSettings, ReceiverPoints, Transmitters
from invertwin.links.metasurface.coverage import Coverage
from invertwin.models.radio import CoverageMap, RadioMap
from invertwin.scene import Scene
from invertwin.scene.shape_models.density import replace_clouds
from invertwin.storage.folders import PARTS

VIEW_FILE = "view.npz"
"""The file of a run folder that `invertwin view` shows."""
_MAX_STEPS = 24  # of a fit, that are kept


@dataclass
class StepRecorder(Callback):
    """Record of where a fit stood, in a file beside its checkpoint.

    Attributes:
        file: The file.
        names: Objects that are kept.
        total: Steps of all stages.
        every: Steps between checkpoints: what is kept goes on with these.
        show: Observer of every step that is kept.
    """

    file: Path
    names: Collection[str]
    total: int
    every: int
    show: Callable[[Fit, viewer.DisplayStep], None] | None
    _steps: list[viewer.DisplayStep] = field(default_factory=list)
    _written: int = 0

    def begin(self, fit: Fit) -> None:
        """Note the start, or read what an interrupted run has kept."""
        self._steps = self._steps or load_steps(self.file)
        if not self._steps:
            self._keep(fit, 0, "start")

    def step(self, fit: Fit, row: dict[str, Any]) -> None:
        """Keep some of the steps."""
        number = row["step"] + 1
        # Steps after the checkpoint from which the fit goes on are done again.
        self._steps = [step for step in self._steps if step.number < number]
        if number % math.ceil(self.total / _MAX_STEPS) == 0:
            # Parameters that the scene refuses have no picture; the fit ends as diverged.
            with suppress(InputError):
                self._keep(fit, number, f"step {number}, loss {row['loss']:.4g}")
        if fit.progress.step % self.every == 0:
            self._write()

    def end(self, fit: Fit) -> None:
        """Write what is kept."""
        self._write()

    def _keep(self, fit: Fit, number: int, label: str) -> None:
        self._steps.append(viewer.DisplayStep(number, label, self._display_meshes(fit.twin())))
        if self.show is not None:
            self.show(fit, self._steps[-1])

    def _write(self) -> None:
        if self._written != self._steps[-1].number or not self.file.exists():
            self._written = self._steps[-1].number
            viewer.Display("", [], self._steps).save(self.file)

    def _display_meshes(self, scene: Scene) -> dict[str, viewer.DisplayMesh]:
        scene = replace_clouds(scene)
        before = self._steps[-1].bodies if self._steps else {}
        found = {}
        for name in self.names:
            body = viewer.display_mesh(scene[name])
            if name in before and np.array_equal(body.faces, before[name].faces):
                body = viewer.DisplayMesh(body.vertices, before[name].faces)  # kept once
            found[name] = body
        return found


def steps_path(checkpoint: str) -> str:
    """The path in the run's folder at which the steps of a fit are kept.

    Args:
        checkpoint: Checkpoint of the fit.
    """
    return f"{PARTS}/{Path(checkpoint).stem}_steps.npz"


def load_steps(file: Path) -> list[viewer.DisplayStep]:
    """The steps that a fit has kept.

    Args:
        file: File of `StepRecorder`.
    """
    return list(viewer.Display.load(file).steps) if file.is_file() else []


def make_fit_display(
    fits: Fits, metrics: Mapping[str, Any], steps: Sequence[viewer.DisplayStep]
) -> viewer.Display:
    """Make the display of the best fit.

    Args:
        fits: all fits, with maps by "measured" and "twin".
        metrics: error bars of the best one.
        steps: its steps that were kept.
    """
    start, twin = replace_clouds(fits.start.scene), replace_clouds(fits.found.scene)
    display = make_problem_display(fits.problem, twin)
    names = [name for name in fits.problem.run.fitted_objects if name in start.names]
    more = viewer.scene_layers(start, "start", fitted=names, fitted_only=True)
    layers = [*display.layers, *more, *viewer.ellipsoid_layers(twin, metrics)]
    for sensor, own in zip(fits.found.sensors, fits.found.result.fit.observations, strict=True):
        if isinstance(own.model, CoverageMap):
            layers += placement_layers(own.model.coverage, sensor)
        if isinstance(own.model, RadioMap):
            layers += viewer.link_layers(twin, sensor, own.model)
    spectra = {viewer.MEASURED: fits.maps["measured"], viewer.SIMULATED: fits.maps["twin"]}
    seen = make_sensor_maps(fits.problem, spectra)
    return replace(display, layers=layers, steps=steps if names else (), maps=seen)


def placement_layers(coverage: Coverage, panel: Metasurface) -> list[viewer.DisplayLayer]:
    """Layers of a metasurface that is placed: antennas, cells, and paths to some receivers.

    Args:
        coverage: Coverage of the receivers.
        panel: The metasurface where it stands.
    """
    settings = PropagationSettings(coverage.frequency, 0.0, depth=1, panels=[panel])
    model = RadioMap(ReceiverPoints(coverage.receivers), settings)
    return viewer.link_layers(coverage.scene, Transmitters(coverage.tx[None]), model)


def make_sensor_maps(
    problem: Problem, spectra: Mapping[str, Sequence[Tensor]], max_values: int | None = None
) -> dict[str, viewer.DisplayMaps]:
    """Maps of the sensors of a fit, by their names.

    Args:
        problem: Problem to fit.
        spectra: Power [frame, range, u, v] of every sensor, by what is shown.
        max_values: Values that are kept of a sensor, about; None = of a few megabytes.
    """
    found = {}
    for k, (name, item) in enumerate(problem.sensor_data.items()):
        if item.grid is not None and all(spectra.values()):
            own = {what: maps[k] for what, maps in spectra.items()}
            found[name] = viewer.DisplayMaps.from_spectra(own, item.grid, max_values)
    return found


def make_start_display(problem: Problem, start: Start) -> viewer.Display:
    """A display of a fit that has not begun, with the measured maps and those of the start.

    Args:
        problem: Problem to fit.
        start: Start of the first fit.
    """
    display = make_problem_display(problem, start.scene)
    sensors = [item.sensor for item in problem.sensor_data.values()]
    predicted = problem.kind.predict_maps(problem, start.scene, sensors)
    spectra = {viewer.MEASURED: problem.kind.measured_maps(problem), viewer.SIMULATED: predicted}
    return replace(display, maps=make_sensor_maps(problem, spectra))


def make_problem_display(problem: Problem, scene: Scene) -> viewer.Display:
    """A display of a fit: its objects, the truth where it is known, the radars.

    Args:
        problem: Problem to fit.
        scene: The start or the twin.
    """
    names = [name for name in problem.run.fitted_objects if name in scene.names]
    truth = problem.truth if any(name in problem.known_objects for name in names) else None
    radars = {name: (item.sensor, item.grid) for name, item in radar_data(problem).items()}
    title = problem.run.title or problem.kind.title
    return viewer.build_display(scene, radars, title, truth=truth, fitted=names)


def radar_data(problem: Problem) -> dict[str, SensorData]:
    """The data of radars, which a viewer can show, by the sensor's name.

    Args:
        problem: Problem to fit.
    """
    return {name: item for name, item in problem.sensor_data.items() if item.grid is not None}
