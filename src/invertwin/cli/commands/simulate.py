"""`invertwin simulate`: exact radar signals of a scene, saved as a capture.

And as the files that boards and their tools write.
"""

import math
import time
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Complex
from torch import Tensor

from invertwin import plotting
from invertwin.capture import Capture, ChirpData, ChirpSettings, adc_counts, make_settings, ti
from invertwin.capture.readers import described_arrays
from invertwin.channel import Grid, Sampling
from invertwin.cli import report
from invertwin.cli.commands.look import describe_frame, describe_peak, draw_spectrogram
from invertwin.cli.estimate import SensorSetup, require_resources
from invertwin.cli.exact_signals import require_simulated_data, simulate_chirp_beats, simulate_exact
from invertwin.cli.report import ReportPicture, ReportTable, quantity_table, save_picture
from invertwin.cli.run_file import prefix_errors, require_section
from invertwin.cli.schema import RawTable, RunFile, build
from invertwin.models.radar import SurrogateMap, surrogate_correlation
from invertwin.radar import FMCW, doppler_maps
from invertwin.radar.processing.doppler_maps import find_peak
from invertwin.radar.radar import Radar
from invertwin.refusals import refusal
from invertwin.scene import Scene
from invertwin.scene.files import save_mesh
from invertwin.storage.run_folder import RunFolder

_SURROGATE_SAMPLES = 2_000_000
# Signals, metrics, pictures, power [frame, range, u, v] by title.
_SimulationOutcome = tuple[torch.Tensor, dict[str, Any], list[ReportPicture], dict[str, Tensor]]


def run_simulate(run: RunFile, folder: RunFolder) -> tuple[list[ReportTable], str]:
    """Simulate the true scene of a run file, write the folder, return tables and a sentence."""
    scene = build.true_scene(run)
    radar = build.radar(require_section(run, "radar", "simulate"))
    grid = build.grid(require_section(run, "grid", "simulate"), radar)
    if run.raw is not None:
        make_chirp_settings(run, radar)  # its errors come before any work
    require_resources(run, scene, {"": SensorSetup(run, radar, grid)})
    simulated = _simulate_frames if run.chirps is None else _simulate_moving_frames
    beat, found, pictures, maps = simulated(run, folder, scene, radar, grid)
    counts = {"frames": radar.frame_count, "channels": len(radar.virtual_positions)}
    answer, counts = describe_peak(found), counts | {"bins": list(grid.shape)}
    metrics = {"task": "simulate", **counts, **found, "answer": answer}
    if run.raw is not None:
        metrics |= write_raw_files(run, radar, beat, folder)
    save_mesh(folder.file("twin.ply"), scene)
    view = plotting.scene(scene, radar, highlight=list(run.truth) or None)
    view = save_picture(folder, "scene", view)
    parts = [view, quantity_table("Simulation", metrics), *pictures]
    seen = radar if run.chirps is None else radar.frames([0])
    if grid.u_count > 1 or seen.frame_count > 1:
        above = plotting.from_above(maps, grid, seen, {"scene": scene})
        parts.append(save_picture(folder, "above", above, "From above", "above"))
    count = f"{found['chirps']} chirps a frame" if run.chirps else f"{found['paths']} paths"
    title, status = run.title or "Simulation", f"{answer}; {count}, frames: {radar.frame_count}."
    notes = {"again": "simulate", "note": run.note}
    return report.write_report(folder, metrics, title, status, parts, **notes), answer


def _simulate_frames(
    run: RunFile, folder: RunFolder, scene: Scene, radar: Radar, grid: Grid
) -> _SimulationOutcome:
    """Simulate one ramp a frame, beside the surrogate's map of the scene."""
    begin = time.perf_counter()
    found = simulate_exact(run, scene, radar, grid)
    seconds = time.perf_counter() - begin
    data = require_simulated_data(run)
    drawn = Sampling(depth=data.depth, samples=_SURROGATE_SAMPLES)
    model = SurrogateMap(grid, sampling=drawn, mirrors=data.mirrors)
    with torch.no_grad():
        smooth = model.predict(scene, radar, run.seed)
    Capture.from_beat(found.beat, radar).save(folder.file("capture.nc"))
    drawn = Sampling(1, points_per_m2=data.points_per_m2)
    one_bounce = SurrogateMap(grid, sampling=drawn)
    alike = surrogate_correlation(scene, radar.frames([0]), one_bounce, seed=run.seed)
    peak, power = find_peak(found.spectrum.sum(0), grid), float(found.spectrum.max())
    hidden = ("peak_velocity_m_s", "peak_azimuth_deg" if grid.u_count == 1 else "")
    metrics = {
        "paths": len(found.paths),
        **{name: value for name, value in peak.metrics("peak").items() if name not in hidden},
        "peak_power_db": 10 * math.log10(power) if power > 0 else None,  # of a single frame
        "surrogate_correlation": alike,
        "wall_seconds": seconds,
    }
    maps = {"exact signal": found.spectrum, "surrogate": smooth}
    figure = plotting.spectrum(maps, grid)
    return found.beat, metrics, [save_picture(folder, "spectra", figure, note="surrogate")], maps


def _simulate_moving_frames(
    run: RunFile, folder: RunFolder, scene: Scene, radar: Radar, grid: Grid
) -> _SimulationOutcome:
    """Simulate several ramps a frame, between which objects move."""
    table = require_section(run, "chirps", "several ramps a frame")
    begin = time.perf_counter()
    chirps = table.build()
    beat = simulate_chirp_beats(run, scene, radar, chirps)
    seconds = time.perf_counter() - begin
    maps = doppler_maps(beat, radar, grid, chirps)
    if table.tdm and isinstance(radar.waveform, FMCW):
        arrays = (radar.transmitters, radar.receivers)
        folder.file("chirps.npy")
        with prefix_errors("chirps"):
            data = ChirpData(beat, replace(make_chirp_settings(run, radar), real=False))
            described_arrays.write_chirps(folder.file("chirps.toml"), data, "chirps.npy", arrays)
    metrics = {"wall_seconds": seconds, **describe_frame(maps, radar, chirps)}
    first = {"first frame": maps.total_power[None]}
    view = save_picture(folder, "doppler", plotting.range_doppler(maps), "First frame", "doppler")
    return beat, metrics, [view, *draw_spectrogram(maps, folder)], first


_IDLE_TIME = 13e-6  # s, of single ramps: with the ADC start time that a board takes from it
# A largest sample at this part of the full scale leaves room for those of other seeds.
_FULL_SCALE_MARGIN = 1.25


def make_chirp_settings(run: RunFile, radar: Radar) -> ChirpSettings:
    """Return the board settings that would record the simulated data of the run file.

    Raises:
        InputError: A radar without ramps, simultaneous transmitters, or ramps that
            do not fit their interval.
    """
    if not isinstance(radar.waveform, FMCW):
        raise refusal("simulate.other_waveform", type(radar.waveform).__name__)
    raw = run.raw or RawTable()
    ramp = raw.adc_start_time + radar.waveform.duration
    idle = _IDLE_TIME
    if run.chirps is not None:
        if not run.chirps.tdm:
            raise refusal("simulate.simultaneous")
        idle = run.chirps.interval - ramp
        if idle < -1e-12:
            raise refusal("simulate.short_interval", ramp, run.chirps.interval)
    board = None if run.radar is None else run.radar.board
    with prefix_errors("raw"):
        settings = make_settings(
            radar.waveform,
            (board and board.transmitters) or len(radar.transmitters.positions),
            (board and board.receivers) or len(radar.receivers.positions),
            loops=1 if run.chirps is None else run.chirps.count,
            frames=radar.frame_count,
            # To the nanosecond, as settings files have it.
            idle_time=round(max(idle, 0.0), 9),
            **raw.model_dump(exclude={"full_scale"}),
        )
        return ti.add_demo_times(settings, _board_name(run)) if run.raw else settings


def _board_name(run: RunFile) -> str:
    return (run.radar and run.radar.board and run.radar.board.name) or ""


def write_raw_files(
    run: RunFile,
    radar: Radar,
    beat: Complex[Tensor, "frame chirp tx rx sample"] | Complex[Tensor, "frame tx rx sample"],
    folder: RunFolder,
) -> dict[str, float]:
    """Write raw/capture.bin and its settings files; return numbers for metrics.json.

    Raises:
        InputError: Data that no such file can hold.
    """
    assert run.raw is not None
    settings = make_chirp_settings(run, radar)
    full_scale = run.raw.full_scale
    if full_scale is None:
        largest = float(torch.view_as_real(beat.resolve_conj()).abs().max())
        full_scale = _FULL_SCALE_MARGIN * largest if largest > 0 else 1.0
    with prefix_errors("raw"):
        data = adc_counts(beat, settings, full_scale)
        samples = folder.file("raw/capture.bin")
        ti.write_samples(samples, data)
        ti.write_cfg(folder.file("raw/capture.cfg"), settings, _board_name(run))
        studio = folder.file("raw/capture.mmwave.json")
        ti.write_studio(studio, settings)
        ti.write_setup(folder.file("raw/capture.setup.json"), studio, [samples])
    return {"raw_full_scale": full_scale, "raw_bytes": samples.stat().st_size}
