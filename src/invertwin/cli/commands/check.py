"""`invertwin check`: what a run file needs, memory and time, before anything is done."""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace

import torch

from invertwin.channel import Sampling, densities_of
from invertwin.cli.estimate import Estimate, Sensor, estimate_of, of_sensor, of_signature
from invertwin.cli.exact_signals import chirp_train, exact
from invertwin.cli.fits.problem import FULL, sensors_of, settings_of, stages_of, varied_run
from invertwin.cli.report import Table, texts
from invertwin.cli.schema import RunFile, SimulatedData, build
from invertwin.cli.schema.recordings import chirp_capture
from invertwin.cli.schema.run_file import about, need
from invertwin.cli.schema.shape_tables import Mover
from invertwin.models.radar import SurrogateMap
from invertwin.runtime.memory import free_memory, gigabytes
from invertwin.runtime.progress import time_left
from invertwin.scene import Scene, Translation

_FRAMES = 4  # of the radar, or aspects, in the probe
_FEW, _MANY = 10_000, 100_000  # rays or paths that are timed: less than a second of work
_DERIVATIVES = 4  # times the work of a map: a step of a fit with one or several derivatives
_FITS = ("reconstruct", "demo")
_SIMULATED = ("simulate", "dataset")


def run_check(run: RunFile) -> tuple[list[Table], str]:
    """Tables of what a run needs and of its meshes, and a line with its time.

    Raises:
        InputError: What the run's own command refuses before it begins.
    """
    if run.rcs is not None:
        return _of_signature(run)
    if run.map is not None:
        return _of_radio_map(run)
    if run.placement is not None:
        return _of_placement(run)
    if run.image is not None and run.task == "gradcheck":
        return _of_image(run)
    truth, sensors = build.true_scene(run), _sensors(run)
    build.parameters(
        [table for table in run.parameters if not isinstance(table, Mover)],
        build.scene(run),
        run.scene,
    )
    found = estimate_of(run, truth, sensors)
    found.require()
    seconds = _seconds(run, found, truth, sensors)
    return _tables(found, truth, seconds, f"{found.rays:.2g} rays and {found.rows:.2g} paths")


def _tables(found: Estimate, scene: Scene, seconds: float, work: str) -> tuple[list[Table], str]:
    rows = [[part.name, part.count, part.memory / 1e9, part.key] for part in found.parts]
    heads = ("needs", "how many", "GB", "key")
    line = (
        f"about {gigabytes(found.memory)} of {gigabytes(free_memory())} free, and "
        f"{time_left(seconds)} for {work}"
    )
    return [Table("Estimate", heads, rows, texts("notes")["estimate"]), _meshes(scene)], line


def _of_placement(run: RunFile) -> tuple[list[Table], str]:
    """The same of `[placement]`: its time is that of one evaluation, and of one derivative."""
    placing, module = build.placing(run, build.scene(run))
    table = need(run, "placement", run.task)
    settings = table.descent.build()
    once = _timed(lambda: placing.level(module))
    step = _timed(lambda: placing.descend(module, 1, settings, width=0.0))
    steps = settings.tracks * settings.track_steps + settings.steps
    grid = table.grid.places * table.grid.yaws * len(table.grid.spread_deg) ** 2
    levels = grid + 2 * table.starts * settings.scouts
    annealed = min(table.starts, table.annealed_starts)
    levels += annealed * table.annealing * settings.evaluations
    descents = (2 * table.starts + 1) * steps
    count = table.panel.counts[0] * table.panel.counts[1]
    rows = [
        ["receivers", table.receivers.count + table.receivers.scored, "placement.receivers"],
        ["elements", count, "placement.panel.counts"],
        ["evaluations", levels, "placement.annealing, placement.grid"],
        ["derivatives", descents, "placement.descent"],
    ]
    seconds = levels * once + descents * step
    if run.task == "gradcheck":
        seconds = 10 * once
    line = f"about {time_left(seconds)} for {levels} evaluations and {descents} derivatives"
    heads = ("needs", "how many", "key")
    return [Table("Estimate", heads, rows), _meshes(build.scene(run))], line


def _of_radio_map(run: RunFile) -> tuple[list[Table], str]:
    """The same of `[map]`, whose memory does not grow: the time of one map of each stage."""
    scene = build.true_scene(run)
    with about("transmitter"):
        sensor = need(run, "transmitter", "[map]").build()

    def once(own: RunFile) -> float:
        with about("map"), torch.no_grad():
            model = need(own, "map", run.task).build()
            return _timed(lambda: model.predict(scene, sensor, 0))

    starts = 1 if run.transmitter_starts is None else run.transmitter_starts.count
    rows: list[list[object]] = [["starts", starts, "transmitter_starts.count"]]
    if run.task == "reconstruct":
        seconds = 0.0
        for mode in (FULL, *run.variants):
            for number, (_, own) in enumerate(stages_of(varied_run(run, mode)), 1):
                steps = settings_of(own).steps
                rows.append([f"steps, {mode}, stage {number}", steps, "reconstruct.steps"])
                seconds += starts * steps * _DERIVATIVES * once(own)
    else:
        check = need(run, "gradcheck", run.task)
        count = 4 * (check.repeats + check.max_pairs)
        rows.append(["maps", count, "gradcheck.repeats, gradcheck.max_pairs"])
        seconds = count * once(run)
    line = f"about {time_left(seconds)} for {len(sensor.positions)} transmitters"
    return [Table("Estimate", ("needs", "how many", "key"), rows), _meshes(scene)], line


def _of_image(run: RunFile) -> tuple[list[Table], str]:
    """The same of `[image]`, whose memory does not grow: the time of one image."""
    scene, check = build.scene(run), need(run, "gradcheck", run.task)
    model, camera = build.made(run, "image"), build.made(run, "camera")
    rays = len(camera.positions) * camera.width * camera.height * model.sampling.samples
    ends, slopes = 4 * check.max_pairs, 4 * check.repeats
    with torch.no_grad():
        ray = _timed(lambda: model.predict(scene, camera, 0)) / rays
    count = ends * max(rays, check.difference_samples) + _DERIVATIVES * slopes * rays
    rows: list[list[object]] = [
        ["images", ends + slopes, "gradcheck.max_pairs, gradcheck.repeats"],
        ["rays", count, "gradcheck.difference_samples"],
    ]
    line = f"about {time_left(count * ray)} for {count:.2g} rays"
    return [Table("Estimate", ("needs", "how many", "key"), rows), _meshes(scene)], line


def _timed(work: Callable[[], object]) -> float:
    """Seconds of some work, once it has been compiled."""
    work()
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def _of_signature(run: RunFile) -> tuple[list[Table], str]:
    """The same of `[rcs]`: its time is that of one aspect and of a few more, carried on."""
    table, scene = need(run, "rcs", run.task), build.scene(run)
    found = of_signature(run, scene)
    found.require()
    count = table.aspect_count

    def traced(aspects: int) -> float:
        chosen = torch.linspace(0, count - 1, aspects).round().long().tolist()
        begin = time.perf_counter()
        with about("rcs"), torch.no_grad():
            table.at(chosen).build({Scene: scene})
        return time.perf_counter() - begin

    traced(1)  # compiled now
    one, few = traced(1), traced(min(count, _FRAMES))
    slope = max(0.0, few - one) / max(1, min(count, _FRAMES) - 1)
    check = run.gradcheck if run.task == "gradcheck" else None
    times = 1 if check is None else 4 * (check.repeats + check.max_pairs)
    seconds = times * (one + slope * (count - 1))
    again = "" if times == 1 else f", {times} times"
    return _tables(found, scene, seconds, f"{count} aspects{again}")


def _meshes(scene: Scene) -> Table:
    heads = ("object", "size [m]", "triangles", "open edges", "non-manifold edges")
    rows = []
    for name, item in scene.objects.items():
        found = item.mesh.summary()
        edges = found.open_edges, found.nonmanifold_edges
        rows.append([name, list(found.extent), found.triangles, *edges])
    return Table("Meshes", heads, rows)


def _sensors(run: RunFile) -> Mapping[str, Sensor]:
    mover = isinstance(next(iter(run.parameters), None), Mover)
    measured = run.data is not None and not isinstance(run.data, SimulatedData)
    if run.task in _FITS and not mover:
        return sensors_of(run)
    table = need(run, "grid", run.task)
    radar = (
        chirp_capture(run.data).device if measured else build.radar(need(run, "radar", run.task))
    )
    return {"": Sensor(run, radar, build.grid(table, radar))}


def _seconds(run: RunFile, found: Estimate, truth: Scene, sensors: Mapping[str, Sensor]) -> float:
    """Time of the run, from the time of a few rays and a few paths on this machine."""
    whole, settings = next(iter(sensors.values())), run.gradcheck or run.reconstruct
    depth = settings.depth if settings else run.data.depth if run.data else 1
    frames = whole.radar.frame_count
    sensor = replace(whole, radar=whole.radar.frames(range(min(_FRAMES, frames))))
    still = Scene({name: replace(item, velocity=None) for name, item in truth.objects.items()})
    each, ray = _line(lambda count: _map(sensor, still, depth, count, run.task not in _SIMULATED))
    used = min(getattr(settings, "frames_per_step", None) or frames, frames)
    seconds = found.maps * each * used / sensor.radar.frame_count + found.rays * ray
    if found.rows:
        each, row = _line(lambda count: _signals(sensor, truth, count))
        each *= frames / sensor.radar.frame_count
        seconds += found.recordings * each + found.rows * row
    return seconds


def _line(work: Callable[[int], float]) -> tuple[float, float]:
    """Seconds that work takes at least, and more of them for each ray or path."""
    work(_FEW)  # compiled now
    times, counts = [time.perf_counter()], []
    for count in (_FEW, _MANY):
        counts.append(work(count))
        times.append(time.perf_counter())
    first, last = times[1] - times[0], times[2] - times[1]
    slope = max(0.0, last - first) / max(1.0, counts[1] - counts[0])
    return max(0.0, first - slope * counts[0]), slope


def _map(sensor: Sensor, truth: Scene, depth: int, count: int, fitted: bool) -> float:
    """Predict a smooth map, with its derivative where it is fitted; return the number of rays."""
    rays, edges = round(0.8 * count), round(0.2 * count)
    sampling = Sampling(depth=depth, samples=rays, boundary_samples=edges, boundary=fitted)
    model = SurrogateMap(sensor.grid, build.made(sensor.run, "surrogate"), sampling)
    module = Translation(truth.names[0])
    with torch.set_grad_enabled(fitted):
        found = model.predict(module(truth) if fitted else truth, sensor.radar, 0)
        if found.requires_grad:
            found.sum().backward()
    return count


def _signals(sensor: Sensor, truth: Scene, count: int) -> float:
    """Simulate exact signals of about so many paths; return their number."""
    data, whole = need(sensor.run, "data", "a simulation"), of_sensor(sensor, truth)[1]
    share = min(1.0, count / whole)
    fewer = {
        "points_per_m2": {
            name: density * share
            for name, density in densities_of(truth, data.points_per_m2).items()
        },
        "samples": max(1, round(data.samples * share)),
        "rough_paths": max(1, round(data.rough_paths * share)),
        "every_start": False,
    }
    run = sensor.run.model_copy(update={"data": data.model_copy(update=fewer)})
    if run.chirps is None:
        exact(run, truth, sensor.radar, sensor.grid)
    else:
        chirp_train(run, truth, sensor.radar, run.chirps.build())
    return whole * share
