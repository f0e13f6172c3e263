"""`invertwin gradcheck`: the derivative of a map against central differences, scene by scene."""

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from matplotlib.figure import Figure
from torch import Tensor

from invertwin import plotting
from invertwin.channel import Grid, Sampling
from invertwin.cli.estimate import SensorSetup, estimate_rcs_resources, require_resources
from invertwin.cli.report import ReportPicture, ReportTable, load_texts, save_picture, write_report
from invertwin.cli.run_file import prefix_errors, require_section
from invertwin.cli.schema import RunFile, build
from invertwin.cli.schema.gradcheck import GradcheckTable
from invertwin.cli.schema.signature import expand_values
from invertwin.cli.terminal import RunBatch
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel
from invertwin.inversion.gradcheck.gradcheck import GradientAgreement, GradientReport, gradcheck
from invertwin.inversion.gradcheck.lines import make_line
from invertwin.links import MapPlane, ReceiverPoints
from invertwin.models import PanelMap, RcsMap, SurrogateMap
from invertwin.radar.radar import Radar
from invertwin.refusals import refusal
from invertwin.scene import Scene
from invertwin.signatures import Signature
from invertwin.storage.run_folder import RunFolder

_TABLE_COLUMNS = ("scene", "L1 full", "L1 interior", "L1 no interior edges", "L1 no contact")
_TABLE_COLUMNS += ("ratio", "L2 full", "correlation", "noise", "steps differ", "order", "pairs")
_REPORT_FIELDS = ("full", "interior", "no_interior_edges", "no_contact")
_REPORT_FIELDS += ("difference_noise", "step_agreement", "pairs")
# Units of a derivative with respect to θ, by the value that θ changes; angles have their own.
_DERIVATIVE_UNITS = {
    **dict.fromkeys(("translation", "offsets", "value", "place"), "1/m"),
    "log_scale": "per relative size",
    "log_density": "per relative density",
}
# Kinds whose objects keep their triangles.
_FIXED_TRIANGLE_KINDS = ("translation", "pose", "scale", "material", "radar_pose", "radar_path")


@dataclass(frozen=True)
class GradcheckOutcome:
    """Finished gradient check, for the studies that compare something with it."""

    run: RunFile
    scene: Scene  # at θ = 0, as the radar
    radar: Radar
    grid: Grid
    step: float  # ε of the differences
    report: GradientReport
    say: Callable[[str], None]  # takes a line of progress

    def apply_theta(self, scene: Scene, radar: Radar, theta: Tensor) -> tuple[Scene, Radar]:
        """Scene and radar, moved by θ."""
        module, tangent = build.tangent(self.run, scene)
        if require_section(self.run, "gradcheck", "gradcheck").acts_on == "sensor":
            return scene, make_line(module, tangent, radar).evaluate(theta)
        return make_line(module, tangent, scene).evaluate(theta), radar


@runtime_checkable
class GradcheckStudy(Protocol):
    """A run-file section of a plugin that compares something with a gradient check.

    The section's name is the key of its results in metrics.json.
    """

    picture_note: str

    def compare(self, checked: GradcheckOutcome) -> tuple[dict[str, Any], Figure]:
        """Results for metrics.json, and a figure."""
        ...

    def table(self, name: str, found: Mapping[str, Any]) -> ReportTable:
        """The table of those results.

        Args:
            name: Name of the gradient check.
            found: Result of `compare`, possibly read back from JSON.
        """
        ...


def run_gradcheck(batch: RunBatch, say: Callable[[str], None]) -> tuple[list[ReportTable], str]:
    """Check every run file, write the folder, return tables and a sentence."""
    begin, folder = time.perf_counter(), batch.folder
    scenes: dict[str, Any] = {}
    compared: dict[str, Any] = {}
    studies: list[ReportTable] = []
    pictures: list[ReportPicture] = []

    def check(name: str, run: RunFile) -> dict[str, Any]:
        return _run_check(name, run, folder, lambda line: say(f"{name}: {line}"))

    for name, run, found in batch.results(check):
        scenes[name] = found
        shown = {f"{name}_scene": (run.title or name, ""), name: (name, _picture_note(run, found))}
        for key, study in _find_studies(run).items():
            compared[key] = found[key]
            studies.append(study.table(name, found[key]))
            shown[f"{name}_{key}"] = studies[-1].title, study.picture_note
        for file, (title, note) in shown.items():
            pictures.append(ReportPicture(title, folder.file(f"{file}.png").read_bytes(), note))
    metrics = {"task": "gradcheck", "scenes": scenes, "wall_seconds": time.perf_counter() - begin}
    if len(scenes) == 1:
        metrics |= compared
    rows = [_table_row(*item) for item in scenes.items()]
    legend = load_texts("notes")["gradcheck"]
    # Omit columns that are empty for all scenes, such as contacts: they would narrow the others.
    used = [k for k in range(len(_TABLE_COLUMNS)) if any(row[k] is not None for row in rows)]
    columns, rows = [_TABLE_COLUMNS[k] for k in used], [[row[k] for k in used] for row in rows]
    table = ReportTable("Agreement with central differences", columns, rows, legend)
    status = "1 scene checked." if len(scenes) == 1 else f"{len(scenes)} scenes checked."
    parts = [table, *studies, *pictures]
    return write_report(folder, metrics, "Gradient check", status, parts, again="gradcheck"), status


@dataclass(frozen=True)
class _GradcheckTarget:
    """Differentiated quantity of a gradient check."""

    model: ForwardModel
    sensor: Any
    device: tuple[Radar, Grid] | None
    draw: Callable[[GradientReport], Figure]


def _rcs_target(run: RunFile, settings: GradcheckTable, scene: Scene) -> _GradcheckTarget:
    """The signature of `[rcs]`."""
    table = require_section(run, "rcs", "gradcheck")
    estimate_rcs_resources(run, scene).require_available()

    def compute_rcs(scene: Scene, **more: Any) -> Signature:
        with prefix_errors("rcs"):
            return table.build({Scene: scene}, **more)

    def draw(report: GradientReport) -> Figure:
        (angles, label), frequencies = table.swept_angles, expand_values(table.frequencies) / 1e9
        size = report.difference.abs().sum((0, 1))
        channel = max(table.channels.values(), key=lambda at: float(size[at]))
        if len(angles) > 1:
            at, places = (0, slice(None), *channel), (angles, label)
        else:
            at, places = (slice(None), 0, *channel), (frequencies, "frequency [GHz]")
        curves, unit = _derivative_maps(report, at), _derivative_unit(settings)
        return plotting.rcs_derivatives(curves, *places, f"∂σ, σ in m² [{unit}]")

    return _GradcheckTarget(RcsMap(compute=compute_rcs), None, None, draw)


def _radio_map_target(run: RunFile, settings: GradcheckTable, scene: Scene) -> _GradcheckTarget:
    """The gain at the points or over the cells of `[map]`."""
    with prefix_errors("map"):
        model = require_section(run, "map", "gradcheck").build()
    sensor = require_section(run, "transmitter", "gradcheck").build()
    places = model.places
    drawn = isinstance(places, MapPlane | ReceiverPoints)
    if not drawn or len(sensor.positions) > 1 or model.quantity != "gain":
        raise refusal("gradcheck.undrawn_map")
    label = f"∂ gain [peaks, {_derivative_unit(settings)}]"

    def draw(report: GradientReport) -> Figure:
        peak = float(report.value.max())
        rates = {name: values / peak for name, values in _derivative_maps(report, 0).items()}
        if isinstance(places, ReceiverPoints):
            number = torch.arange(len(places.positions), dtype=torch.float64)
            return plotting.rcs_derivatives(rates, number, "receiver", label)
        return plotting.coverage(
            {}, places, derivatives=rates, scene=scene, transmitters=sensor, derivative_label=label
        )

    return _GradcheckTarget(model, sensor, None, draw)


def _image_target(run: RunFile, settings: GradcheckTable, scene: Scene) -> _GradcheckTarget:
    """Camera image of `[camera]` and `[image]`."""
    require_section(run, "camera", "an image")
    kind = require_section(run, "image", "gradcheck").kind
    model, camera = build.build_section(run, "image"), build.build_section(run, "camera")
    unit = "" if kind == "silhouette" else "m · "

    def draw(report: GradientReport) -> Figure:
        label = f"∂ {kind} [{unit}{_derivative_unit(settings)}]"
        return plotting.images({kind: report.value[0]}, _derivative_maps(report, 0), label)

    return _GradcheckTarget(model, camera, None, draw)


def _radar_map_target(run: RunFile, settings: GradcheckTable, scene: Scene) -> _GradcheckTarget:
    """The smooth map of `[radar]`, `[grid]` and `[surrogate]`."""
    if run.surrogate.exact:
        raise refusal("gradcheck.exact_signals")
    radar = build.radar(require_section(run, "radar", "gradcheck"))
    grid = build.grid(require_section(run, "grid", "gradcheck"), radar)
    require_resources(run, scene, {"": SensorSetup(run, radar, grid)})
    drawn = {key: getattr(settings, key) for key in ("depth", "samples", "boundary_samples")}
    model = SurrogateMap(grid, build.build_section(run, "surrogate"), Sampling(**drawn))
    label = f"∂ power (received/sent) [{_derivative_unit(settings)}]"

    def draw(report: GradientReport) -> Figure:
        error = {"full − differences, own scale": report.gradient - report.difference}
        return plotting.gradient(_derivative_maps(report), grid, label=label, own_scale=error)

    return _GradcheckTarget(model, radar, (radar, grid), draw)


def _panel_target(run: RunFile, settings: GradcheckTable, scene: Scene) -> _GradcheckTarget:
    """Gain at the receivers through the metasurface of `[placement]`."""
    table = require_section(run, "placement", "gradcheck")
    aim, panel = table.coverage(scene, run.seed), table.metasurface()
    if settings.parameter.kind != "panel":
        with torch.no_grad():
            panel = table.place(aim, table.initial)(panel)

    def draw(report: GradientReport) -> Figure:
        order = report.difference[0].argsort()
        curves = _derivative_maps(report, (0, order))
        number = torch.arange(len(order), dtype=torch.float64)
        label = f"∂ path gain [{_derivative_unit(settings)}]"
        return plotting.rcs_derivatives(curves, number, "receiver", label)

    return _GradcheckTarget(PanelMap(aim.tx, aim.receivers, aim.frequency), panel, None, draw)


def _run_check(
    name: str, run: RunFile, folder: RunFolder, say: Callable[[str], None]
) -> dict[str, Any]:
    begin = time.perf_counter()
    settings = require_section(run, "gradcheck", "gradcheck")
    scene = build.scene(run)
    seen = _select_target(run)(run, settings, scene)
    module, tangent = build.tangent(run, scene)
    for key in _find_studies(run):
        if seen.device is None:
            raise InputError(f"{key}: expected [radar] and [grid] with it, got none; remove it")
        if settings.parameter.kind not in _FIXED_TRIANGLE_KINDS:
            raise refusal("gradcheck.shape_parameter", key)
    check = settings.build()
    radar = seen.device[0] if seen.device else None
    report = gradcheck(
        seen.model, module, tangent, scene=scene, sensor=seen.sensor, acts_on=settings.acts_on,
        settings=check, seed=run.seed, progress=say,
    )  # fmt: skip
    save_picture(folder, f"{name}", seen.draw(report))
    moved = filter(None, [getattr(settings.parameter, "object", None)])
    save_picture(folder, f"{name}_scene", plotting.scene(scene, radar, highlight=[*moved]))
    kept = {key: value for key in _REPORT_FIELDS if (value := getattr(report, key)) is not None}
    found = {k: asdict(v) if isinstance(v, GradientAgreement) else v for k, v in kept.items()}
    if seen.device is not None:
        checked = GradcheckOutcome(run, scene, *seen.device, check.step, report, say)
        for key, study in _find_studies(run).items():
            found[key], figure = study.compare(checked)
            save_picture(folder, f"{name}_{key}", figure)
    return found | {"seconds": time.perf_counter() - begin}


def _select_target(run: RunFile) -> Callable[[RunFile, GradcheckTable, Scene], _GradcheckTarget]:
    """Return the builder of the gradient check, by the sections of the run file."""
    if run.placement is not None:
        return _panel_target
    if run.image is not None:
        return _image_target
    if run.map is not None:
        return _radio_map_target
    return _radar_map_target if run.rcs is None else _rcs_target


def checked_map(run: RunFile, scene: Scene) -> tuple[ForwardModel, Any]:
    """The model and the sensor of a gradient check.

    Args:
        run: The run file.
        scene: Scene at θ = 0.
    """
    seen = _select_target(run)(run, require_section(run, "gradcheck", "gradcheck"), scene)
    return seen.model, seen.sensor


def _find_studies(run: RunFile) -> dict[str, GradcheckStudy]:
    """The sections that compare something with the gradient check."""
    values = {key: getattr(run, key) for key in type(run).model_fields}
    return {key: value for key, value in values.items() if isinstance(value, GradcheckStudy)}


def _derivative_maps(report: GradientReport, at: Any = ...) -> dict[str, Tensor]:
    """Derivatives at an index of the maps, by the terms that they have."""
    found = {"differences": report.difference, "full": report.gradient}
    found["interior only"] = report.interior_gradient
    return {name: values[at] for name, values in found.items()}


def _derivative_unit(settings: GradcheckTable) -> str:
    """Return the unit of a number's derivative with respect to θ."""
    name = next(iter(settings.tangent))
    return "1/rad" if settings.changes_angle else _DERIVATIVE_UNITS.get(name, f"per unit of {name}")


def _table_row(name: str, found: Mapping[str, Any]) -> list[Any]:
    full, interior = found["full"], found["interior"]["relative_l1"]
    less = [found.get(key, {}).get("relative_l1") for key in ("no_interior_edges", "no_contact")]
    ratio = interior / full["relative_l1"] if full["relative_l1"] else None
    errors = [full["relative_l1"], interior, *less, ratio, full["relative_l2"]]
    differences = [found["difference_noise"], found["step_agreement"], full["order"]]
    return [name, *errors, full["correlation"], *differences, found["pairs"]]


def _picture_note(run: RunFile, found: Mapping[str, Any]) -> str:
    settings = require_section(run, "gradcheck", "gradcheck")
    names = ", ".join(name.replace("_", " ") for name in settings.tangent)
    of = getattr(settings.parameter, "object", "the radar")
    return f"Derivative with respect to the {names} of {of}; {found['seconds']:.0f} s. {run.note}"
