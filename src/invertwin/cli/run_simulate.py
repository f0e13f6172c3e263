"""`invertwin simulate`: exact radar signals of a scene, saved as a capture."""

import math
import time
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from invertwin import plotting
from invertwin.capture import Capture, described_arrays
from invertwin.channel import Grid, Sampling
from invertwin.cli import build, sensors
from invertwin.cli.raw_files import chirp_data, settings_of_run, write_raw
from invertwin.cli.report import DOPPLER_NOTE, Again, Picture, Table, report_html
from invertwin.cli.run_file import about, need, to_toml
from invertwin.cli.runs import RunFolder
from invertwin.cli.schema import RunFile, SimulatedData
from invertwin.errors import InputError
from invertwin.models import SurrogateMap, surrogate_correlation
from invertwin.radar import FMCW, doppler_maps, velocity_span
from invertwin.radar.motion import Chirps
from invertwin.radar.radar import Radar
from invertwin.scene import Scene
from invertwin.scene.files import save_mesh
from invertwin.simulation import Simulation, simulate, simulate_chirps

_SURROGATE_SAMPLES = 2_000_000
_LABELS = {
    "frames": "frames",
    "channels": "virtual channels",
    "chirps": "chirps of each transmitter in a frame",
    "paths": "paths",
    "bins": "bins of range, u, v",
    "peak_power_db": "strongest bin of a frame, received over sent [dB]",
    "peak_range_m": "strongest bin over all frames, range [m]",
    "peak_u": "strongest bin over all frames, u",
    "peak_v": "strongest bin over all frames, v",
    "peak_velocity_m_s": "strongest bin, range rate, away > 0 [m/s]",
    "mover_range_m": "strongest bin that moves, range [m]",
    "mover_velocity_m_s": "strongest bin that moves, range rate [m/s]",
    "mover_azimuth_deg": "strongest bin that moves, azimuth [°]",
    "raw_bytes": "raw samples [bytes]",
    "surrogate_correlation": "correlation of the surrogate with the mean of 16 exact looks",
    "wall_seconds": "time of the exact simulation [s]",
}


def exact(run: RunFile, scene: Scene, radar: Radar, grid: Grid) -> Simulation:
    """The exact chain with the settings of the `[data]` table.

    Raises:
        InputError: The run file's data are measured, not simulated.
    """
    data = _simulated(run)
    seed = run.seed if data.seed is None else data.seed
    front = None if run.impairments is None else sensors.impairments(run.impairments, data)
    with torch.no_grad():
        return simulate(
            scene,
            radar,
            grid,
            seed=seed,
            sampling=_sampling(data, data.depth),
            snr_db=None if front else data.snr_db,
            noise_figure_db=None if front else data.noise_figure_db,
            impairments=front,
        )


def _sampling(data: SimulatedData, depth: int) -> Sampling:
    return Sampling(
        depth=depth,
        samples=data.samples,
        boundary_samples=0,
        boundary=False,
        points_per_m2=data.density,
        rough_paths=data.chains,
    )


def _simulated(run: RunFile) -> SimulatedData:
    data = need(run, "data", "a simulation")
    if not isinstance(data, SimulatedData):
        raise InputError(
            f'data.kind: expected "simulated" to simulate a scene, got "{data.kind}"; '
            "give density and snr_db instead of a capture"
        )
    return data


def run_simulate(run: RunFile, folder: RunFolder) -> list[Table]:
    """Simulates the true scene of a run file, writes the folder, returns the tables to print."""
    scene = build.true_scene(run)
    radar = build.radar(need(run, "radar", "simulate"))
    grid = build.grid(need(run, "grid", "simulate"), radar)
    if run.raw is not None:
        settings_of_run(run, radar)  # its errors come before any work
    if run.chirps is not None:
        return _chirp_train(run, folder, scene, radar, grid, run.chirps)
    begin = time.perf_counter()
    found = exact(run, scene, radar, grid)
    seconds = time.perf_counter() - begin
    with torch.no_grad():
        depth = _simulated(run).depth
        model = SurrogateMap(grid, sampling=Sampling(depth=depth, samples=_SURROGATE_SAMPLES))
        smooth = model.predict(scene, radar, run.seed)
    Capture.from_beat(found.beat, radar).save(folder.file("capture.nc"))
    metrics = {
        "task": "simulate",
        "frames": radar.frame_count,
        "channels": len(radar.virtual_positions),
        "paths": len(found.paths),
        "bins": list(grid.shape),
        **_peak(found.spectrum, grid),
        "surrogate_correlation": surrogate_correlation(
            scene,
            radar.frames([0]),
            replace(model, sampling=Sampling(1, points_per_m2=_simulated(run).density)),
            seed=run.seed,
        ),
        "wall_seconds": seconds,
    }
    if run.raw is not None:
        metrics |= write_raw(run, radar, found.beat, folder)
    maps = {"exact signal": found.spectrum, "surrogate": smooth}
    shown = Picture(
        "Spectra",
        folder.write_figure("spectra.png", plotting.spectrum(maps, grid)),
        note="The surrogate is the mean of the exact spectrum over random phases.",
    )
    status = f"{len(found.paths)} paths, {radar.frame_count} frames."
    return _finish(run, folder, scene, radar, metrics, shown, status)


def chirp_train(run: RunFile, scene: Scene, radar: Radar, chirps: Chirps) -> torch.Tensor:
    """Exact beat signals of every chirp with the settings of `[data]` and `[chirps]`.

    Args:
        run: The run file.
        scene: With moving objects.
        radar: What records.
        chirps: Timing.
    """
    data = _simulated(run)
    front = sensors.impairments(run.impairments, data)
    with about("chirps"), torch.no_grad():
        return simulate_chirps(
            scene,
            radar,
            chirps,
            seed=run.seed if data.seed is None else data.seed,
            sampling=_sampling(data, 1),
            retrace=need(run, "chirps", "several ramps a frame").retrace,
            impairments=front,
        )


def _chirp_train(
    run: RunFile, folder: RunFolder, scene: Scene, radar: Radar, grid: Grid, table: Any
) -> list[Table]:
    """Simulate several ramps a frame, between which objects move."""
    begin = time.perf_counter()
    chirps = sensors.chirps(table)
    beat = chirp_train(run, scene, radar, chirps)
    seconds = time.perf_counter() - begin
    maps = doppler_maps(beat, radar, grid, chirps)
    if table.tdm and isinstance(radar.waveform, FMCW):
        arrays = (radar.transmitters, radar.receivers)
        folder.file("chirps.npy")
        with about("chirps"):
            described_arrays.write_chirps(
                folder.file("chirps.toml"), chirp_data(run, radar, beat), "chirps.npy", arrays
            )
    metrics = {
        "task": "simulate",
        "frames": radar.frame_count,
        "channels": len(radar.virtual_positions),
        "chirps": chirps.count,
        "bins": list(grid.shape),
        "velocity_span_m_s": velocity_span(radar, chirps),
        **maps.strongest.metrics("peak"),
        **({} if maps.mover is None else maps.mover.metrics("mover")),
        "wall_seconds": seconds,
    }
    if run.raw is not None:
        metrics |= write_raw(run, radar, beat, folder)
    png = folder.write_figure("doppler.png", plotting.range_doppler(maps))
    shown = Picture("First frame", png, note=DOPPLER_NOTE)
    status = f"{chirps.count} chirps a frame, {radar.frame_count} frames."
    return _finish(run, folder, scene, radar, metrics, shown, status)


def _finish(
    run: RunFile,
    folder: RunFolder,
    scene: Scene,
    radar: Radar,
    metrics: dict[str, Any],
    shown: Picture,
    status: str,
) -> list[Table]:
    """Numbers, scene and report of either kind of simulation."""
    save_mesh(folder.file("twin.ply"), scene)
    folder.write_json("metrics.json", metrics)
    rows = [[label, metrics[key]] for key, label in _LABELS.items() if key in metrics]
    table = Table("Simulation", ["quantity", "value"], rows)
    figure = plotting.scene(scene, radar, highlight=list(run.truth))
    seen = Picture("Scene", folder.write_figure("scene.png", figure))
    again = Again("simulate run.toml", {"run.toml": to_toml(run)})
    title = run.title or "Simulation"
    parts = [table, seen, shown]
    folder.write_text("report.html", report_html(title, status, run.note, parts, again))
    return [table]


def _peak(spectrum: torch.Tensor, grid: Grid) -> dict[str, float | None]:
    """Where the power, summed over frames, is largest, and the largest of one frame in dB."""
    total = spectrum.sum(0)
    r, u, v = np.unravel_index(int(total.argmax()), total.shape)
    peak = float(spectrum.max())
    return {
        "peak_power_db": 10 * math.log10(peak) if peak > 0 else None,
        "peak_range_m": float(grid.ranges[r]),
        "peak_u": float(grid.u[u]),
        "peak_v": float(grid.v[v]),
    }
