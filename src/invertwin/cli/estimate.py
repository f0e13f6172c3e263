"""Resources of a run, before it begins: memory by part, and numbers of rays and paths."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch

from invertwin.capture import Capture
from invertwin.channel import Grid
from invertwin.channel.sampling import resolve_densities
from invertwin.cli.run_file import prefix_errors, require_section
from invertwin.cli.schema import RunFile, SimulatedData
from invertwin.cli.schema.signature import count_values
from invertwin.inversion import require_edge_length
from invertwin.radar import Radar, SampledWaveform
from invertwin.radar.signal.range_profile import fft_bins
from invertwin.refusals import refusal
from invertwin.runtime.memory import format_gigabytes, free_memory, require_at_most
from invertwin.scene import Object, Scene
from invertwin.scene.scene import warn_if_purely_specular

# Bytes, measured as peaks of whole runs (benchmarks are in docs/limitations.md).
_PROGRAM_BYTES = 0.8e9  # the library, compiled kernels and the rays that are alive at a time
_TRIANGLE_BYTES = 700
_POINT_BYTES, _PATH_BYTES = 250, 300  # of a rough surface; of a path in one frame
_SAMPLE_BYTES = 64  # of a beat signal
_BIN_BYTES, _FITTED_BIN_BYTES = 60, 100  # of a recorded spectrum; of a map with its derivative
_PHASOR_BYTES = 32
_MATRIX_BYTES = 200  # of 2 × 2 amplitudes, with what is made of them
_START_BYTES = 10_000  # of an object at another place
_SIMULATED_RAYS = 2e6  # of the smooth map beside a simulation
_MAX_RAYS = 1e13  # twelve days at 10⁷ a second
_SIZE_KEYS = ("max_edge", "divisions", "subdivisions", "spacing", "file", "parts", "shape")


@dataclass(frozen=True)
class MemoryItem:
    """One item of the memory of a run.

    Attributes:
        name: Name of the item.
        count: Number of equal items.
        size: Bytes of each.
        key: Run-file key to lower.
    """

    name: str
    count: float
    size: float
    key: str

    @property
    def memory(self) -> float:
        """Bytes of all of them."""
        return self.count * self.size


@dataclass(frozen=True)
class ResourceEstimate:
    """Resource estimate of a run: memory, rays, paths.

    Attributes:
        memory_items: Items of memory, the largest first.
        map_count: Smooth maps that are predicted.
        ray_count: Samples of all of them.
        rays_key: Run-file key that determines most of their number.
        recording_count: Exact signals that are simulated.
        path_count: Paths of all of them, times frames.
    """

    memory_items: tuple[MemoryItem, ...]
    map_count: float
    ray_count: float
    rays_key: str
    recording_count: float
    path_count: float

    @property
    def memory(self) -> float:
        """Peak memory in bytes."""
        return _PROGRAM_BYTES + sum(part.memory for part in self.memory_items)

    def require_available(self) -> None:
        """Refuse a run that this machine cannot do.

        Raises:
            InputError: More memory than is free, or more rays than can be traced.
        """
        free = free_memory()
        if not self.memory <= free:
            most = self.memory_items[0]
            room, needed = format_gigabytes(free), format_gigabytes(self.memory)
            raise refusal("estimate.memory", most, room, needed, min(most.count, 1e300))
        if not self.ray_count <= _MAX_RAYS:
            raise refusal("estimate.rays", self.rays_key, _MAX_RAYS, min(self.ray_count, 1e300))


@dataclass(frozen=True)
class SensorSetup:
    """Sensor of a run, with its own tables and data.

    Attributes:
        run: The run file as it is for this sensor.
        radar, grid: Radar and bins of its tables.
        capture: Its recording; None where data are simulated.
    """

    run: RunFile
    radar: Radar
    grid: Grid
    capture: Capture | None = None


Sensors = Mapping[str, SensorSetup]
"""Sensors by name; a run without `[observations]` has one without a name."""


def estimate_resources(run: RunFile, truth: Scene, sensors: Sensors) -> ResourceEstimate:
    """Estimate the resources of a run from its tables and their objects, without tracing.

    Args:
        run: The run file.
        truth: Its true scene.
        sensors: What records it.

    Raises:
        InputError: Too many starts, or a stage that makes too many triangles.
    """
    _check_starts_and_stages(run, truth, sensors)
    parts, rows, one_channel = [_triangle_item(run, truth)], 0.0, 0.0
    for name, sensor in sensors.items():
        found, traced = estimate_sensor_resources(sensor, truth)
        path = f"observations.{name}." if name else ""
        parts += [replace(part, key=path + part.key) for part in found]
        rows += traced
        one_channel += traced / math.prod(sensor.radar.shape)
    parts += _fit_items(run, sensors)
    again = _count_recordings(run)
    recordings, rows = again * len(sensors), rows * again
    if run.landscape is not None:
        rows += run.landscape.exact_points * one_channel
    kept = tuple(part for part in sorted(parts, key=lambda part: -part.memory) if part.memory)
    return ResourceEstimate(kept, *_count_rays(run), recordings, rows)


def estimate_rcs_resources(run: RunFile, scene: Scene) -> ResourceEstimate:
    """Estimate the resources of `[rcs]`.

    Args:
        run: The run file.
        scene: Its scene.
    """
    table = require_section(run, "rcs", run.task)
    sizes = {n: count_values(getattr(table, n)) for n in ("frequencies", "theta_deg", "phi_deg")}
    values = sizes["frequencies"] * table.aspect_count
    largest = max(sizes, key=lambda name: sizes[name])
    size = _MATRIX_BYTES * (table.depth + 2)
    parts = [_triangle_item(run, scene)]
    parts.append(MemoryItem("values of the field", values, size, f"rcs.{largest}"))
    if table.image is not None:
        parts.append(MemoryItem("pixels", table.image.pixels**2, _MATRIX_BYTES, "rcs.image.pixels"))
    ordered = tuple(sorted(parts, key=lambda part: -part.memory))
    return ResourceEstimate(ordered, 0, 0, "rcs.frequencies", 0, 0)


def require_resources(run: RunFile, truth: Scene, sensors: Sensors) -> None:
    """Refuse a run that this machine cannot do; arguments and errors as of `estimate_resources`."""
    for sensor in sensors.values():
        warn_if_purely_specular(truth, sensor.radar.waveform.center_frequency)
    estimate_resources(run, truth, sensors).require_available()


def _triangle_item(run: RunFile, scene: Scene) -> MemoryItem:
    counts = {name: len(item.mesh.faces) for name, item in scene.objects.items()}
    name = max(counts, key=lambda name: counts[name])
    key = "room.furniture" if run.scene_file is None else "scene_file.file"
    if name in run.scene:
        size = next(size for size in _SIZE_KEYS if hasattr(run.scene[name], size))
        key = f"scene.{name}.{size}"
    return MemoryItem("triangles", sum(counts.values()), _TRIANGLE_BYTES, key)


def estimate_sensor_resources(sensor: SensorSetup, scene: Scene) -> tuple[list[MemoryItem], float]:
    """Estimate the memory of one sensor's data, and their number of paths over all frames.

    Args:
        sensor: Sensor of the data.
        scene: Measured scene.
    """
    run, radar, grid = sensor.run, sensor.radar, sensor.grid
    frames, senders, receivers = radar.shape
    channels, chirps = senders * receivers, run.chirps.count if run.chirps else 1
    across, bins = grid.u_count + grid.v_count, math.prod(grid.shape)
    # Beams are separable where the virtual array is a product of a row and a column.
    places = (radar.virtual_positions / (1e-3 * radar.waveform.wavelength)).round()
    y, z, both = (len(part.unique(dim=0)) for part in (places[:, 1:2], places[:, 2:], places))
    beams = across if y * z == both else bins // grid.range_count
    counts = {"radar.positions": frames, "grid.range_max": grid.range_count}
    counts |= {"grid.u_max": grid.u_count, "grid.v_max": grid.v_count}
    largest = max(counts, key=lambda name: counts[name])
    parts = [
        MemoryItem("bins of a map over all frames", bins * frames, _BIN_BYTES, largest),
        MemoryItem("phases of beams and antennas", beams * channels, _PHASOR_BYTES, "grid.u_max"),
    ]
    rows = 0.0
    if isinstance(radar.waveform, SampledWaveform):
        samples = radar.waveform.samples
        taken = {"chirps.count": chirps, "radar.positions": frames, "radar.receivers": channels}
        taken["radar.waveform"] = samples
        beat = math.prod(taken.values())
        most = max(taken, key=lambda name: taken[name])
        parts.append(MemoryItem("samples of beat signals", beat, _SAMPLE_BYTES, most))
        if fft_bins(radar.waveform, grid) is None:
            name, count = "phases of samples and ranges", samples * grid.range_count
            parts.append(MemoryItem(name, count, _PHASOR_BYTES, "grid.range_max"))
    if isinstance(run.data, SimulatedData):
        again, moves = 1, any(item.motion for item in run.scene.values())
        if run.chirps is not None and (run.chirps.retrace or moves):
            again = -(-chirps // run.chirps.visibility_every)
        for part, traced in _simulation_items(run.data, scene, frames):
            parts.append(part)
            rows += traced * again
    return parts, rows


def _simulation_items(
    data: SimulatedData, scene: Scene, frames: int
) -> Iterator[tuple[MemoryItem, float]]:
    """Return the memory of exact signals' paths, and their number over all frames."""
    with prefix_errors("data.points_per_m2"):
        rough = resolve_densities(scene, data.points_per_m2)
    areas = {name: scene[name].world_mesh.area for name in rough}
    area = sum(areas.values())
    points = sum(areas[name] * density for name, density in rough.items())
    each = _POINT_BYTES + frames * _PATH_BYTES
    name = f"points on {area:.3g} m² of rough surfaces"
    yield MemoryItem(name, points, each, "data.points_per_m2"), points * frames
    if len(rough) < len(scene.objects):
        each, name = frames * _PATH_BYTES, "points on conductors"
        yield MemoryItem(name, data.samples, each, "data.samples"), data.samples * frames
    if data.depth > 1:
        drawn, kept = data.rough_paths * (data.depth - 1), frames / 4  # of each
        each, name = _POINT_BYTES + kept * _PATH_BYTES, "paths of several bounces"
        yield MemoryItem(name, drawn, each, "data.rough_paths"), drawn * (1 + kept)


def _fit_items(run: RunFile, sensors: Sensors) -> Iterator[MemoryItem]:
    """Return the memory of fits and derivative checks, beside the data."""
    copies = (run.starts.count if run.starts else 1) * (1 + len(run.variants))
    key = "starts.count" if run.starts else "variants"
    yield MemoryItem("starts", copies, _START_BYTES, key)
    if run.landscape is not None:
        points = run.landscape.points + run.landscape.exact_points
        yield MemoryItem("points of a landscape", points, 100, "landscape.exact_points")
    for name, sensor in sensors.items():
        bins, frames = math.prod(sensor.grid.shape), sensor.radar.frame_count
        path = f"observations.{name}." if name else ""
        if run.gradcheck is not None:
            maps = 4 * run.gradcheck.repeats + run.gradcheck.max_pairs
            most = max(("repeats", "max_pairs"), key=lambda key: getattr(run.gradcheck, key))
            count = maps * bins * frames
            yield MemoryItem("bins of maps to compare", count, 8, f"gradcheck.{most}")
        if run.reconstruct is not None:
            used = max(min(own.frames_per_step or frames, frames) for own in _fit_budgets(run))
            key = f"{path}grid.range_max"
            yield MemoryItem("bins of a fitted map", bins * used, _FITTED_BIN_BYTES, key)


def _count_rays(run: RunFile) -> tuple[float, float, str]:
    """Count smooth maps and their samples, and return the key that determines most of these."""
    if run.task == "gradcheck" and run.gradcheck is not None:
        table = run.gradcheck
        ends, slopes = 4 * table.max_pairs, 4 * table.repeats
        far = ends * table.difference_samples
        near = slopes * (table.samples + table.boundary_samples)
        key = "difference_samples" if far > near else "samples"
        return ends + slopes, far + near, f"gradcheck.{key}"
    own = run.reconstruct
    if run.task == "simulate" or own is None:
        return 1, _SIMULATED_RAYS, "data.samples"
    each = (run.starts.count if run.starts else 1) * max(1, len(run.observations))
    parts = _fit_budgets(run)
    maps = each * sum(part.steps for part in parts)
    rays = each * sum(part.steps * (part.samples + part.boundary_samples) for part in parts)
    if run.landscape is not None:
        maps += 2 * run.landscape.points
        rays += 2 * run.landscape.points * own.samples
    counts = {"starts.count": each, "reconstruct.steps": own.steps}
    counts |= {"reconstruct.samples": own.samples / 1000}  # a thousand rays are no step
    return maps, rays, max(counts, key=lambda name: counts[name])


def _fit_budgets(run: RunFile) -> list[Any]:
    """Return the `[reconstruct]` table of every stage of every variant."""
    ways = [run, *(run.apply_overrides(variant) for variant in run.variants.values())]
    runs = ([run.apply_overrides(stage) for stage in way.stages] or [way] for way in ways)
    return [own.reconstruct for parts in runs for own in parts if own.reconstruct is not None]


def _count_recordings(run: RunFile) -> int:
    """Count the simulations of data."""
    if not isinstance(run.data, SimulatedData):
        return 1
    if run.task == "dataset" and run.dataset is not None:
        return run.dataset.samples
    anew = run.starts.count if run.data.every_start and run.starts is not None else 1
    return anew + (run.plan.fits if run.plan is not None else 0)


def _farthest_range(sensor: SensorSetup) -> float:
    """The range of the last bin from the middle of the radar's positions [m]."""
    places, origin = sensor.radar.positions.detach(), sensor.radar.range_origin
    shift = 0.0 if origin is None else float(origin.abs().max())
    spread = float((places.amax(0) - places.amin(0)).norm())
    return float(sensor.grid.ranges.abs().max()) + shift + spread / 2


def _check_starts_and_stages(run: RunFile, scene: Scene, sensors: Sensors) -> None:
    """Refuse starts and stages beyond the limits of what makes them, before any of them begins."""
    chance = torch.Generator()
    for section, more in (("starts", {"generator": chance}), ("search", {})):
        table = getattr(run, section)
        if table is not None:
            given = {Object: scene[table.object], torch.Generator: chance}
            with prefix_errors(section):
                next(iter(table.build(given, **more)), None)
    if run.starts is not None:
        # The truth and the start are both within the range of the map from a position.
        most = max(2 * _farthest_range(sensor) for sensor in sensors.values())
        what, do = "m from the truth to a start, which the maps can show", "start nearer to it"
        with prefix_errors("starts"):
            require_at_most(run.starts.distance[1], most, what, do, "distance")
    free = [table.object for table in run.parameters if table.kind == "vertices"]
    for i, stage in enumerate(run.stages):
        for name in free if stage.remesh else ():
            with prefix_errors(f"stages[{i}].remesh"):
                require_edge_length(scene[name].mesh, stage.remesh or 0.0)
