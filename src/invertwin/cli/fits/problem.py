"""A fit of a run file: scene, observations, unknowns and stages, of any kind of data."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

import torch
from rich.console import Console
from torch import Tensor, nn

from invertwin.cli.report import ReportPicture, ReportTable
from invertwin.cli.run_file import prefix_errors, require_section
from invertwin.cli.schema import RunFile, SamplingBase, SimulatedData, StageTable, build
from invertwin.cli.schema.fits import MeasuresTable
from invertwin.cli.schema.shape_tables import shape_regularizers
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel
from invertwin.inversion import Observation, Reconstruction, Stage, Unknown, remesh
from invertwin.inversion.initialisation.multi_start import Candidate
from invertwin.scene import Object, Scene, rigid
from invertwin.seeds import derive_seed
from invertwin.storage.run_folder import RunFolder

OWN_METHOD, INTERIOR_ONLY = "full", "interior_only"
AMONG_CLUTTER, FROM_IMAGE = "among_clutter", "from_image"
WITH_PERMITTIVITIES, WITH_LOBES = "with_permittivities", "with_permittivities_and_lobes"
OF_SENSORS = ("radar_pose", "radar_path", "transmitter", "reverberation", "panel", "panel_phases")
"""Kinds of parameters that belong to a sensor."""
HISTORIES = ("losses", "curve", "checkpoint", "screened")
"""Keys of rows that metrics.json leaves out."""
Row = dict[str, Any]
"""Numbers of one fit."""


@dataclass(frozen=True)
class SensorData:
    """Data of one sensor.

    Attributes:
        recording: As the forward model observes it.
        sensor: Sensor that recorded it.
        grid: Bins of its maps; None where the model needs none.
        weight: Weight of its loss in the mean.
    """

    recording: Any
    sensor: Any
    grid: Any = None
    weight: float = 1.0


@dataclass(frozen=True)
class Start:
    """Initial values of one fit.

    Attributes:
        scene: Initial scene.
        transmitter: Initial position of the first transmitter [3] [m]; None where none is fitted.
    """

    scene: Scene
    transmitter: Tensor | None = None


@dataclass(frozen=True)
class Problem:
    """Everything a fit needs, built from the run file.

    Attributes:
        run: The run file.
        scene: As known.
        truth: As it is, where the run file knows it.
        known_objects: Objects whose true pose is known.
        sensor_data: Data by the sensor's name.
        scored_object: The object that is scored.
        kind: Kind of the data.
        reference: Further references of the scores: true transmitters, other receivers.
        notes: Numbers of what came before the fits, for metrics.json.
    """

    run: RunFile
    scene: Scene
    truth: Scene
    known_objects: frozenset[str]
    sensor_data: Mapping[str, SensorData]
    scored_object: str | None
    kind: "DataKind"
    reference: Any = None
    notes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def first_sensor(self) -> SensorData:
        """The only sensor, or the first one."""
        return next(iter(self.sensor_data.values()))

    @property
    def measures(self) -> MeasuresTable | None:
        """Scores of the shape, where the true one is known."""
        table = self.run.measures
        return table if table is not None and table.object in self.known_objects else None

    @property
    def methods(self) -> list[str]:
        """Names of the ways to fit: the run's own, its variants, and those of the data."""
        return [OWN_METHOD, *self.run.variants, *self.kind.methods]

    @property
    def work(self) -> list[tuple[str, int]]:
        """Method and number of the start of every fit."""
        return [(method, k) for method in self.methods for k in range(len(self.starts(method)))]

    def starts(self, method: str = OWN_METHOD) -> list[Start]:
        """Starts of the fits of a method, in order."""
        variant = self.run.variants.get(method)
        return self.kind.starts(self)[: variant.first_starts if variant else None]


@dataclass(frozen=True)
class Fits:
    """All fits of a run.

    Attributes:
        problem: Problem with the data of the best fit.
        rows: Rows of every fit, by method.
        outcome: Outcome of a fit that is no variant, by method and number of its start.
        best: Row of the best one, of the run's own method.
        start: Start of the best fit.
        found: Result of the best fit.
        maps: Maps of every sensor, by "measured", "start" and "twin"; empty where none is shown.
    """

    problem: Problem
    rows: Mapping[str, list[Row]]
    outcome: Callable[[str, int], Reconstruction]
    best: Row
    start: Start
    found: Reconstruction
    maps: Mapping[str, list[Tensor]] = field(default_factory=dict)

    @property
    def methods(self) -> list[str]:
        """The run's own method and its variants."""
        return [OWN_METHOD, *self.problem.run.variants]

    @property
    def losses(self) -> dict[str, list[list[float]]]:
        """Losses over the steps of every fit, by method."""
        return {method: [row["losses"] for row in rows] for method, rows in self.rows.items()}

    def best_of(self, method: str) -> Row:
        """Row of the best fit of a method."""
        return min(self.rows[method], key=rank)


@dataclass(frozen=True)
class Summary:
    """A part of the report that depends on the kind of data.

    Attributes:
        outcome: Outcome in a sentence or two.
        result: Table of the result.
        pictures: Below it.
        tables: Tables at the end of the report.
    """

    outcome: str
    result: ReportTable
    pictures: Sequence[ReportPicture]
    tables: Sequence[ReportTable]


def rank(row: Row) -> tuple[bool, float]:
    """Order of fits, the best first; a loss that is not a number comes last."""
    loss: float | None = row["loss"]
    value = math.inf if loss is None or not math.isfinite(loss) else loss
    return row["status"] == "diverged", value


class DataKind(ABC):
    """A kind of data: how it is read, modelled, scored and shown. All else is the same for all.

    Attributes:
        title: Title of a report without one.
        unused: Sections that have no meaning for such data.
        methods: Further fits beside those of the run and its variants.
        histories: Keys of rows that metrics.json leaves out.
    """

    title: ClassVar[str] = "Reconstruction"
    unused: ClassVar[tuple[str, ...]] = ()
    methods: ClassVar[tuple[str, ...]] = ()
    histories: ClassVar[tuple[str, ...]] = HISTORIES

    @abstractmethod
    def read_problem(self, run: RunFile, scene: Scene, truth: Scene, console: Console) -> Problem:
        """Read the data, or simulate them.

        Args:
            run: The run file.
            scene: As known.
            truth: As it is.
            console: Shows progress.
        """

    @abstractmethod
    def models(self, problem: Problem) -> list[ForwardModel]:
        """Forward models of all sensors, for the problem of a method or a stage."""

    def with_method(self, problem: Problem, method: str) -> Problem:
        """The problem of a method, with the sensors of this fit only."""
        run = method_run(problem.run, method)
        chosen = run.fit_settings.observations or problem.sensor_data
        data = {name: item for name, item in problem.sensor_data.items() if name in chosen}
        return replace(problem, run=run, sensor_data=data)

    def prepare(self, problem: Problem, folder: RunFolder, console: Console) -> Problem:
        """The problem after the steps before all fits: calibration, an initial estimate."""
        return problem

    def with_recording_of_start(self, problem: Problem, number: int, console: Console) -> Problem:
        """The problem with the data of a start: the same for all, unless each has its own."""
        return problem

    def allows_clutter(self, problem: Problem) -> bool:
        """True if what the scene lacks can count as background."""
        return False

    def starts(self, problem: Problem) -> list[Start]:
        """Starts of the fits: about the truth as ``[starts]`` says, or where the scene is."""
        return [Start(scene) for scene in initial_scenes(problem)]

    def recorded_values(self, item: SensorData) -> Any:
        """Data as the forward model observes them."""
        return item.recording

    def initial_sensor(self, item: SensorData, start: Start) -> Any:
        """The sensor of some data at the start of a fit."""
        return item.sensor

    def sensor_unknowns(self, problem: Problem, name: str) -> dict[str, nn.Module | Unknown]:
        """Unknowns of a sensor beside the parameters of the run file."""
        return {}

    def make_unknown(self, problem: Problem, name: str, table: Any, start: Start) -> Unknown:
        """One parameter of the run file.

        Args:
            problem: Problem of the fit.
            name: Name of the parameter.
            table: Table of the parameter.
            start: Initial values.
        """
        make = build.module_builders(problem.run.parameters, problem.run.scene)[name]
        return Unknown(make, getattr(table, "rate", None), partial(shape_regularizers, table))

    def make_candidates(
        self, problem: Problem, start: Start, generator: torch.Generator
    ) -> Mapping[str, Sequence[Object]] | Sequence[Candidate]:
        """Starts that ``[search]`` compares about the start of a fit."""
        name = require_section(problem.run, "search", "several starts").object
        given = {Object: start.scene[name], torch.Generator: generator}
        return {name: [start.scene[name], *build.build_section(problem.run, "search", given)]}

    def score_fit(self, problem: Problem, start: Start, found: Reconstruction) -> Row:
        """Numbers of a fit beside its loss: distances to the truth."""
        return {}

    def revise_confidence(self, fits: Fits, believed: Row) -> Row:
        """Verdict and error bars of the best fit, with what the other fits say of them."""
        return believed

    @abstractmethod
    def metrics(self, fits: Fits) -> Row:
        """Numbers of a run that depend on the kind of data."""

    @abstractmethod
    def summary(self, fits: Fits, metrics: Row, folder: RunFolder) -> Summary:
        """Tables and pictures; the pictures are written, too."""

    def measured_maps(self, problem: Problem) -> list[Tensor]:
        """Measured maps of all sensors for the viewer; none where it cannot show them."""
        return []

    def predict_maps(self, problem: Problem, scene: Scene, sensors: Sequence[Any]) -> list[Tensor]:
        """The same as predicted of a scene."""
        return []


def make_observations(problem: Problem, start: Start | None = None) -> list[Observation]:
    """Observations of a fit: data, model, and unknowns of the sensor.

    Args:
        problem: Problem of a mode.
        start: Initial values; None = the scene as known.
    """
    kind, begun = problem.kind, start or Start(problem.scene)
    own = _build_unknowns(problem, begun, of_sensors=True)
    sensors = zip(problem.kind.models(problem), problem.sensor_data.items(), strict=True)
    return [
        Observation(
            model,
            kind.recorded_values(item),
            sensor=kind.initial_sensor(item, begun),
            weight=item.weight,
            parameters={**own, **kind.sensor_unknowns(problem, name)},
        )
        for model, (name, item) in sensors
    ]


def make_unknowns(problem: Problem, start: Start | None = None) -> dict[str, Unknown]:
    """Unknowns of the scene, by name.

    Args:
        problem: Problem of a mode.
        start: Initial values; None = the scene as known.
    """
    return _build_unknowns(problem, start or Start(problem.scene), of_sensors=False)


def _build_unknowns(problem: Problem, start: Start, *, of_sensors: bool) -> dict[str, Unknown]:
    return {
        name: problem.kind.make_unknown(problem, name, table, start)
        for name, table in fitted_tables(problem.run).items()
        if (table.kind in OF_SENSORS) == of_sensors
    }


def make_schedule(problem: Problem) -> list[Stage]:
    """The stages of a fit, as the library takes them."""
    fitted, found = fitted_tables(problem.run), []
    for table, run in stage_runs(problem.run):
        names = [name for name in table.parameters if name in fitted]
        free = [fitted[name] for name in names or fitted]
        finer = partial(remesh, edge_length=table.remesh or 0.0)
        counts = {k: v for k, v in (table.reconstruct or {}).items() if k in SamplingBase.made_from}
        models = problem.kind.models(replace(problem, run=run))
        if counts:
            models = [m.with_sampling(**counts) if hasattr(m, "sampling") else m for m in models]
        stage = Stage(
            **vars(run.fit_settings.build()),
            unknowns=tuple(names),
            rebuild=table.rebuild,
            remesh={t.object: finer for t in free if table.remesh and t.kind == "vertices"},
            optimizer=build.build_section(run, "optimizer"),
            models=models,
        )
        found.append(stage)
    return found


def initial_scenes(problem: Problem) -> list[Scene]:
    """Scenes where fits start: about the truth as ``[starts]`` says, or the scene as known."""
    run, scene, table = problem.run, problem.scene, problem.run.starts
    if table is None:
        return [scene]
    body = build.fitted_body(run, scene, table.object)
    name, truth, found = table.object, problem.truth[table.object], []
    generator = torch.Generator().manual_seed(run.seed if table.seed is None else table.seed)
    for moved in table.build({Object: truth}, generator=generator):
        # The object as known may have another size: it is its centre that is placed.
        turn = moved.transform[:3, :3]
        begun = scene.replace(name, pose=rigid(turn, moved.center - turn @ scene[name].mesh.center))
        if body is not None and table.joint_deg > 0:
            mesh = body.perturb_joints(truth.mesh, math.radians(table.joint_deg), generator)
            begun = begun.replace(name, mesh=mesh, pose=moved.transform)
        found.append(begun)
    return found


def require_sections(kind: DataKind, run: RunFile, because: str) -> None:
    """Refuse sections that have no meaning for a kind of data.

    Args:
        kind: The kind.
        run: The run file.
        because: The section that makes the data such.

    Raises:
        InputError: One of them is there, or those of every fit are not.
    """
    require_section(run, "reconstruct", "reconstruct")
    require_section(run, "parameters", "reconstruct")
    for name in kind.unused:
        if getattr(run, name):
            raise InputError(f"{name}: expected no such section with {because}, got one; remove it")


def sensor_runs(run: RunFile) -> dict[str, RunFile]:
    """The run file with the sections of every sensor, by the sensor's name.

    The only sensor of a run file without `[observations]` has an empty name.
    """
    if not run.observations:
        return {"": run}
    found = {}
    for number, (name, table) in enumerate(run.observations.items()):
        own = {key: value for key, value in table if key != "weight" and value is not None}
        if "data" not in own and isinstance(run.data, SimulatedData):
            # The noise of one radar is not that of another.
            seed = derive_seed(run.seed if run.data.seed is None else run.data.seed, number)
            own["data"] = run.data.model_copy(update={"seed": seed})
        found[name] = run.model_copy(update={**own, "observations": {}})
    return found


def about_sensor(name: str) -> AbstractContextManager[None]:
    """Add the table of a sensor to errors; the only sensor has none."""
    return prefix_errors(f"observations.{name}") if name else nullcontext()


def known_truth(problem: Problem) -> dict[str, Object]:
    """The object that is scored as it really is, where that is known."""
    name = problem.scored_object
    return {name: problem.truth[name]} if name is not None and name in problem.known_objects else {}


def method_run(run: RunFile, method: str) -> RunFile:
    """The run file of a method: the run's own, or a variant."""
    return run.apply_overrides(run.variants[method]) if method in run.variants else run


def fitted_tables(run: RunFile) -> dict[str, Any]:
    """The tables of the fitted parameters, by name."""
    tables = build.tables_by_name(run.parameters)
    names = set(run.fit_settings.parameters or tables)
    if run.stages and all(stage.parameters for stage in run.stages):
        names &= {name for stage in run.stages for name in stage.parameters}
    return {name: table for name, table in tables.items() if name in names}


def stage_runs(run: RunFile) -> list[tuple[StageTable, RunFile]]:
    """The stages of a fit, each with its run file; one that fits nothing falls out."""
    fitted = fitted_tables(run)
    found = [
        (stage, run.apply_overrides(stage))
        for stage in run.stages
        if not stage.parameters or fitted.keys() & set(stage.parameters)
    ]
    return found or [(StageTable(), run)]
