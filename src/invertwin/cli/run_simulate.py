"""`invertwin simulate`: exact radar signals of a scene, saved as a capture."""

import math
import time
from typing import Any

import numpy as np
import torch

from invertwin.capture import Capture, described_arrays
from invertwin.channel import Grid
from invertwin.cli import build, pictures, sensors
from invertwin.cli.doppler_maps import DOPPLER_NOTE, doppler_maps, panels, panels_picture
from invertwin.cli.raw_files import chirp_data, settings_of_run, write_raw
from invertwin.cli.report import Again, Picture, Table, report_html
from invertwin.cli.run_file import about, need, to_toml
from invertwin.cli.runs import RunFolder
from invertwin.cli.schema import RunFile, SimulatedData
from invertwin.errors import InputError
from invertwin.radar import FMCW, exact_spectrum, velocity_span
from invertwin.radar.radar import Radar
from invertwin.radar.surrogate import Surrogate
from invertwin.scene import Scene
from invertwin.scene.files import save_mesh
from invertwin.simulation import (
    Simulation,
    simulate,
    simulate_chirps,
    surrogate_correlation,
)

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
        found = simulate(
            scene,
            radar,
            grid,
            seed=seed,
            samples=data.samples,
            depth=data.depth,
            density=data.density,
            chain_count=data.chains,
            snr_db=None if front else data.snr_db,
            noise_figure_db=None if front else data.noise_figure_db,
        )
        if front is None:
            return found
        assert found.paths is not None
        beat = front.record(found.paths, radar, seed=seed)
        return Simulation(exact_spectrum(beat, radar, grid), found.paths, beat)


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
    assert found.beat is not None
    assert found.paths is not None
    with torch.no_grad():
        smooth = simulate(
            scene,
            radar,
            grid,
            seed=run.seed,
            surrogate=Surrogate(),
            samples=_SURROGATE_SAMPLES,
            depth=_simulated(run).depth,
        ).spectrum
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
            grid,
            seed=run.seed,
            depth=1,
            density=_simulated(run).density,
        ),
        "wall_seconds": seconds,
    }
    if run.raw is not None:
        metrics |= write_raw(run, radar, found.beat, folder)
    axes = pictures.Axes(grid.ranges.numpy(), grid.u.numpy(), grid.v.numpy())
    maps = {"exact signal": found.spectrum.numpy(), "surrogate": smooth.numpy()}
    folder.write_bytes("spectra.png", pictures.spectra_picture(maps, axes))
    shown = Picture(
        "Spectra",
        (folder.path / "spectra.png").read_bytes(),
        note="The surrogate is the mean of the exact spectrum over random phases.",
    )
    status = f"{len(found.paths)} paths, {radar.frame_count} frames."
    return _finish(run, folder, scene, radar, metrics, shown, status)


def _chirp_train(
    run: RunFile, folder: RunFolder, scene: Scene, radar: Radar, grid: Grid, table: Any
) -> list[Table]:
    """The same for several ramps a frame, between which objects move."""
    data, chirps = _simulated(run), sensors.chirps(table)
    seed = run.seed if data.seed is None else data.seed
    begin = time.perf_counter()
    with about("chirps"), torch.no_grad():
        beat = simulate_chirps(
            scene,
            radar,
            chirps,
            seed=seed,
            retrace=table.retrace,
            samples=data.samples,
            density=data.density,
            impairments=sensors.impairments(run.impairments, data),
        )
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
    folder.write_bytes("doppler.png", panels_picture(panels(maps)))
    shown = Picture(
        "First frame",
        (folder.path / "doppler.png").read_bytes(),
        note=DOPPLER_NOTE,
    )
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
    drawing = pictures.Drawing(
        pictures.meshes_of(scene), sought=list(run.truth), radar=radar.positions.numpy()
    )
    folder.write_bytes(
        "scene.png", pictures.scene_picture({"scene": drawing}, pictures.frame_of(radar))
    )
    seen = Picture("Scene", (folder.path / "scene.png").read_bytes())
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
