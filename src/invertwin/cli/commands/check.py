"""`invertwin check`: memory and time that a run file needs, before it runs."""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from rich.console import Console

from invertwin.channel import Sampling
from invertwin.channel.sampling import resolve_densities
from invertwin.cli import estimate
from invertwin.cli.commands.gradcheck import checked_map
from invertwin.cli.estimate import ResourceEstimate, Sensors, SensorSetup
from invertwin.cli.exact_signals import simulate_chirp_beats, simulate_exact
from invertwin.cli.fits.kinds import build_problem
from invertwin.cli.fits.problem import make_observations, make_schedule
from invertwin.cli.fits.radar_models import build_sensors
from invertwin.cli.report import ReportTable, load_texts
from invertwin.cli.run_file import prefix_errors, require_section
from invertwin.cli.schema import RunFile, SimulatedData, build
from invertwin.cli.schema.radio_tables import ReceivedData
from invertwin.cli.schema.recordings import build_chirp_capture
from invertwin.cli.schema.shape_tables import MovingTargetParameter
from invertwin.models.radar import SurrogateMap
from invertwin.runtime.memory import format_gigabytes, free_memory
from invertwin.runtime.progress import format_duration
from invertwin.scene import Scene, Translation
from invertwin.scene.mesh_defects import find_defects

_PROBE_FRAMES = 4  # of the radar, or aspects, in the probe
# Rays or paths that are timed: less than a second of work.
_SMALL_PROBE, _LARGE_PROBE = 10_000, 100_000
_DERIVATIVE_COST = 4  # times the work of a map: a step of a fit with one or several derivatives
_FIT_TASKS = ("reconstruct", "demo")
_SIMULATION_TASKS = ("simulate", "dataset")
_STEPS, _STARTS = "reconstruct.steps", ("transmitter_starts.count", "placement.starts")
_COUNT_HEADS = ("needs", "how many", "key")
_Needs = tuple[list[ReportTable], str]  # resources and meshes, and a line with the time


def run_check(run: RunFile) -> tuple[list[ReportTable], str]:
    """Build tables of a run's resources and meshes, and a line with its time.

    Raises:
        InputError: An input that the run's own command refuses before it begins.
    """
    if run.rcs is not None:
        return _check_rcs(run)
    if run.map is not None or run.placement is not None:
        return (_check_other_data if run.task in _FIT_TASKS else _check_checked_map)(run)
    if run.image is not None and run.task == "gradcheck":
        return _check_image(run)
    truth, sensors = build.true_scene(run), _build_sensors(run)
    tables = [table for table in run.parameters if not isinstance(table, MovingTargetParameter)]
    build.parameters(tables, build.scene(run), run.scene)
    found = estimate.estimate_resources(run, truth, sensors)
    found.require_available()
    seconds = _estimate_seconds(run, found, truth, sensors)
    work = f"{found.ray_count:.2g} rays and {found.path_count:.2g} paths"
    return _make_tables(found, truth, seconds, work)


def _make_tables(found: ResourceEstimate, scene: Scene, seconds: float, work: str) -> _Needs:
    rows = [[part.name, part.count, part.memory / 1e9, part.key] for part in found.memory_items]
    heads = ("needs", "how many", "GB", "key")
    room = f"{format_gigabytes(found.memory)} of {format_gigabytes(free_memory())} free"
    line = f"about {room}, and {format_duration(seconds)} for {work}"
    needs = ReportTable("Estimate", heads, rows, load_texts("notes")["estimate"])
    return [needs, _mesh_table(scene)], line


def _check_other_data(run: RunFile) -> _Needs:
    """Check fits to other data than radar maps: the time of one map of each stage."""
    if isinstance(run.data, ReceivedData):
        # Data that know no more than the fit are simulated in the time of one map.
        known: dict[str, None] = dict.fromkeys(("bandwidth", "depth", "edges", "rays"))
        run = run.model_copy(update={"data": run.data.model_copy(update=known)})
    problem = build_problem(run, Console(quiet=True))
    sensor = make_observations(problem, problem.starts()[0])[0].initial_sensor()
    rows: list[list[object]] = []
    seconds, maps = 0.0, 0.0
    for method in problem.methods:
        own, starts = problem.kind.with_method(problem, method), len(problem.starts(method))
        for number, stage in enumerate(make_schedule(own), 1):
            rows.append([f"steps, {method}, stage {number}", starts * stage.steps, _STEPS])
            work = partial(stage.models[0].predict, problem.scene, sensor, 0)
            with torch.no_grad():
                seconds += starts * stage.steps * _DERIVATIVE_COST * _time_call(work)
            maps += starts * stage.steps
    rows.append(["starts", len(problem.starts()), _STARTS[run.map is None]])
    line = f"about {format_duration(seconds)} for {maps:.4g} steps, without searches"
    return [ReportTable("Estimate", _COUNT_HEADS, rows), _mesh_table(problem.scene)], line


def _check_checked_map(run: RunFile) -> _Needs:
    """Check a gradient check of `[map]` or `[placement]`, whose memory is constant."""
    scene, check = build.scene(run), require_section(run, "gradcheck", run.task)
    model, sensor = checked_map(run, scene)
    count = 4 * (check.repeats + check.max_pairs)
    rows: list[list[object]] = [["maps", count, "gradcheck.repeats, gradcheck.max_pairs"]]
    with torch.no_grad():
        seconds = count * _time_call(lambda: model.predict(scene, sensor, 0))
    line = f"about {format_duration(seconds)} for {count} maps"
    return [ReportTable("Estimate", _COUNT_HEADS, rows), _mesh_table(scene)], line


def _check_image(run: RunFile) -> _Needs:
    """Check `[image]`, whose memory is constant: the time of one image."""
    scene, check = build.scene(run), require_section(run, "gradcheck", run.task)
    require_section(run, "camera", "an image")
    model, camera = build.build_section(run, "image"), build.build_section(run, "camera")
    rays = len(camera.positions) * camera.width * camera.height * model.sampling.samples
    ends, slopes = 4 * check.max_pairs, 4 * check.repeats
    with torch.no_grad():
        ray = _time_call(lambda: model.predict(scene, camera, 0)) / rays
    count = ends * max(rays, check.difference_samples) + _DERIVATIVE_COST * slopes * rays
    rows: list[list[object]] = [["images", ends + slopes, "gradcheck.max_pairs, gradcheck.repeats"]]
    rows.append(["rays", count, "gradcheck.difference_samples"])
    line = f"about {format_duration(count * ray)} for {count:.2g} rays"
    return [ReportTable("Estimate", _COUNT_HEADS, rows), _mesh_table(scene)], line


def _time_call(work: Callable[[], object]) -> float:
    """Return the seconds of a call, once it has been compiled."""
    work()
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def _check_rcs(run: RunFile) -> _Needs:
    """Check `[rcs]`: extrapolate its time from one aspect and a few more."""
    table, scene = require_section(run, "rcs", run.task), build.scene(run)
    found = estimate.estimate_rcs_resources(run, scene)
    found.require_available()
    count = table.aspect_count

    def time_aspects(aspects: int) -> float:
        chosen = torch.linspace(0, count - 1, aspects).round().long().tolist()
        begin = time.perf_counter()
        with prefix_errors("rcs"), torch.no_grad():
            # Without edges no currents are solved, which may take longer than all else.
            table.select_aspects(chosen).model_copy(update={"edges": 0}).build({Scene: scene})
        return time.perf_counter() - begin

    time_aspects(1)  # compiled now
    one, few = time_aspects(1), time_aspects(min(count, _PROBE_FRAMES))
    slope = max(0.0, few - one) / max(1, min(count, _PROBE_FRAMES) - 1)
    check = run.gradcheck if run.task == "gradcheck" else None
    times = 1 if check is None else 4 * (check.repeats + check.max_pairs)
    seconds = times * (one + slope * (count - 1))
    again = "" if times == 1 else f", {times} times"
    again += "" if table.edges == 0 else ", without edges and currents"
    return _make_tables(found, scene, seconds, f"{count} aspects{again}")


def _mesh_table(scene: Scene) -> ReportTable:
    heads = ("object", "size [m]", "triangles", "open edges", "non-manifold edges", "defects")
    rows = []
    for name, item in scene.objects.items():
        found = item.mesh.summary()
        edges = found.open_edges, found.nonmanifold_edges
        defects = ", ".join(find_defects(item.mesh).in_words()) or "none"
        rows.append([name, list(found.extent), found.triangles, *edges, defects])
    return ReportTable("Meshes", heads, rows)


def _build_sensors(run: RunFile) -> Sensors:
    mover = isinstance(next(iter(run.parameters), None), MovingTargetParameter)
    if run.task in _FIT_TASKS and not mover:
        return build_sensors(run)
    table = require_section(run, "grid", run.task)
    if run.data is None or isinstance(run.data, SimulatedData):
        radar = build.radar(require_section(run, "radar", run.task))
    else:
        radar = build_chirp_capture(run.data).device
    return {"": SensorSetup(run, radar, build.grid(table, radar))}


def _estimate_seconds(
    run: RunFile, found: ResourceEstimate, truth: Scene, sensors: Sensors
) -> float:
    """Estimate the time of the run from a few rays and a few paths on this machine."""
    whole, settings = next(iter(sensors.values())), run.gradcheck or run.reconstruct
    depth = settings.depth if settings else run.data.depth if run.data else 1
    frames = whole.radar.frame_count
    sensor = replace(whole, radar=whole.radar.frames(range(min(_PROBE_FRAMES, frames))))
    still = Scene({name: replace(item, velocity=None) for name, item in truth.objects.items()})
    fitted = run.task not in _SIMULATION_TASKS
    each, ray = _fit_cost(lambda count: _predict_map(sensor, still, depth, count, fitted))
    used = min(getattr(settings, "frames_per_step", None) or frames, frames)
    seconds = found.map_count * each * used / sensor.radar.frame_count + found.ray_count * ray
    if found.path_count:
        each, row = _fit_cost(lambda count: _simulate_signals(sensor, truth, count))
        each *= frames / sensor.radar.frame_count
        seconds += found.recording_count * each + found.path_count * row
    return seconds


def _fit_cost(work: Callable[[int], float]) -> tuple[float, float]:
    """Fit the fixed seconds of a call, and the seconds per ray or path."""
    work(_SMALL_PROBE)  # compiled now
    times, counts = [time.perf_counter()], []
    for count in (_SMALL_PROBE, _LARGE_PROBE):
        counts.append(work(count))
        times.append(time.perf_counter())
    first, last = times[1] - times[0], times[2] - times[1]
    slope = max(0.0, last - first) / max(1.0, counts[1] - counts[0])
    return max(0.0, first - slope * counts[0]), slope


def _predict_map(sensor: SensorSetup, truth: Scene, depth: int, count: int, fitted: bool) -> float:
    """Predict a smooth map, with its derivative where it is fitted; return the number of rays."""
    rays, edges = round(0.8 * count), round(0.2 * count)
    sampling = Sampling(depth=depth, samples=rays, boundary_samples=edges, boundary=fitted)
    model = SurrogateMap(sensor.grid, build.build_section(sensor.run, "surrogate"), sampling)
    module = Translation(truth.names[0])
    with torch.set_grad_enabled(fitted):
        found = model.predict(module(truth) if fitted else truth, sensor.radar, 0)
        if found.requires_grad:
            found.sum().backward()
    return count


def _simulate_signals(sensor: SensorSetup, truth: Scene, count: int) -> float:
    """Simulate exact signals of about so many paths; return their number."""
    data = require_section(sensor.run, "data", "a simulation")
    whole = estimate.estimate_sensor_resources(sensor, truth)[1]
    share, rough = min(1.0, count / whole), resolve_densities(truth, data.points_per_m2)
    fewer = {
        "points_per_m2": {name: density * share for name, density in rough.items()},
        "samples": max(1, round(data.samples * share)),
        "rough_paths": max(1, round(data.rough_paths * share)),
        "every_start": False,
    }
    run = sensor.run.model_copy(update={"data": data.model_copy(update=fewer)})
    if run.chirps is None:
        simulate_exact(run, truth, sensor.radar, sensor.grid)
    else:
        simulate_chirp_beats(run, truth, sensor.radar, run.chirps.build())
    return whole * share
