"""`invertwin look`: pictures of a recording as it is, and the recording as a capture."""

import json
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import torch

from invertwin import capture as captures
from invertwin import plotting
from invertwin import radar as radars
from invertwin.capture.readers import described_arrays
from invertwin.channel import Grid
from invertwin.checks import checked_number
from invertwin.cli import report
from invertwin.cli.inputs import find_plugin_recording
from invertwin.cli.options import LookOptions, RecordingOptions
from invertwin.cli.report import ReportPicture, ReportTable, quantity_table, save_picture
from invertwin.errors import InputError, PhysicsWarning
from invertwin.plotting import MapPanel
from invertwin.radar.boards import Mounting
from invertwin.refusals import refusal
from invertwin.registry.kinds import registry
from invertwin.storage.run_folder import RunFolder

AnyRecording = captures.Capture | captures.ChirpCapture


def run_look(options: LookOptions, folder: RunFolder) -> tuple[list[ReportTable], str]:
    """Read a recording, write capture, pictures and numbers, return tables and a sentence to print.

    Raises:
        InputError: A recording or options that do not fit each other; nothing has been written.
    """
    said: list[str] = []
    with _collect_warnings(said):
        reader, given = read_recording(options)
    as_recorded = given
    if isinstance(given, captures.ChirpCapture):
        as_recorded = given.merge_single_ramps()
        if as_recorded is not given:
            count = as_recorded.chirps.count
            said.append(f"reading: {count} frames of one ramp are shown as one train")
    recording, metrics = _calibrate_channels(options, as_recorded, folder)
    capture, chirps = _to_capture(options, recording), None
    if isinstance(recording, captures.ChirpCapture) and recording.chirps.count > 1:
        chirps = recording
    radar = capture.radar()
    checked_number(options.frame, "--frame", 0, radar.frame_count - 1)
    grid = _make_grid(options, capture, recording)
    said += map(str, captures.find_faults(as_recorded, options.range_min, options.range_max))
    metrics |= {
        "task": "look",
        "reader": reader,
        "frames": radar.frame_count,
        "channels": len(radar.virtual_positions),
        "frequency_ghz": radar.waveform.center_frequency / 1e9,
        "range_cell_m": radar.waveform.range_resolution,
    }
    if isinstance(radar.waveform, radars.SampledWaveform):
        metrics |= {"samples": radar.waveform.samples, "max_range_m": recording.max_range}
    if radar.range_origin is not None:
        metrics["range_origin_m"] = float(radar.range_origin.mean())
    shown, found, power, maps = _make_panels(capture, chirps, grid, options.frame)
    if maps is not None and maps.is_aliased:
        said.append(report.load_texts("notes")["aliased"].format(found["velocity_span_m_s"]))
    if capture.dataset.get("beat", capture.dataset).attrs.get("units") == "count":
        found["peak_counts_db"] = found.pop("peak_power_db")
    metrics |= found
    if options.method != "bartlett":
        shown |= _high_resolution_panels(options, capture, chirps, grid)
    points = None
    if chirps is not None:
        points = radars.detect_points(chirps.beat, radar, grid, chirps.chirps, options.frame)
    elif "beat" in capture.dataset:
        points = radars.detect_points(capture.beat[:, None], radar, grid, None, options.frame)
    if points is not None and options.range_min is None and is_far_only(points, recording):
        said.append("reading: " + report.load_texts("notes")["far_only"])
    if radar.frame_count > 1:
        profiles = capture.spectrum(replace(grid, u_count=1, v_count=1))
        times = torch.arange(radar.frame_count)
        shown["all frames"] = MapPanel(profiles[:, :, 0, 0].T.double(), grid.ranges, times, "frame")
    answer = describe_peak(metrics)
    metrics |= {"warnings": said, "answer": answer}
    capture.save(folder.file("capture.nc"))
    if points is not None:
        metrics["points"] = len(points)
        folder.write_text("points.csv", radars.format_points_csv(points))
        for suffix in ("ply", "pcd"):
            radars.save_points(folder.file(f"points.{suffix}"), points)
    title, notes = options.recording.name, report.load_texts("notes")
    kind = "directions" if chirps is None else "doppler"
    view = save_picture(folder, "look", plotting.panels(shown), f"Frame {options.frame}", kind)
    status = f"{answer}; frames: {radar.frame_count}, read as {reader}."
    texts = {"again": options.command("look", folder.path), "note": notes["look"]}
    parts = [view, *draw_spectrogram(maps, folder), quantity_table(title, metrics)]
    parts += warning_tables(said)
    if grid.u_count > 1 and points is not None and len(points):
        of_frame, one = {f"frame {options.frame}": power[None]}, radar.frames([options.frame])
        above = plotting.from_above(of_frame, grid, one, {"detections": points.position})
        parts.insert(1, save_picture(folder, "above", above, "From above", "above"))
    return report.write_report(folder, metrics, title, status, parts, **texts), answer


def is_far_only(points: radars.PointCloud, recording: AnyRecording) -> bool:
    """Return True for I and Q of echoes that all lie beyond half of the unambiguous range.

    Args:
        points: Points of a frame.
        recording: The recording.
    """
    real = isinstance(recording, captures.ChirpCapture) and recording.real
    near = points.range <= 0.5 * recording.max_range
    return bool(len(points)) and not (real or near.any() or recording.radar().origins.any())


def describe_peak(metrics: dict[str, Any]) -> str:
    """State the place of the strongest echo in a sentence."""
    answer = f"Strongest echo {metrics['peak_range_m']:.2f} m away"
    if "peak_azimuth_deg" in metrics:
        answer += f", azimuth {metrics['peak_azimuth_deg']:.1f}° (left > 0)"
    return answer


def describe_frame(
    maps: radars.DopplerMaps, radar: radars.Radar, chirps: radars.Chirps
) -> dict[str, Any]:
    """Numbers of the maps of a frame of chirps, and of what moves."""
    found: dict[str, Any] = {"velocity_span_m_s": radars.velocity_span(radar, chirps)}
    found |= maps.strongest_peak.metrics("peak")
    found |= {"chirps": chirps.count, "moves": maps.moving_peak is not None}
    if maps.moving_peak is None:
        return found
    return {**found, **maps.moving_peak.metrics("mover"), "mover_rates_m_s": maps.moving_rates}


def draw_spectrogram(maps: radars.DopplerMaps | None, folder: RunFolder) -> list[ReportPicture]:
    """The picture of the micro-Doppler of a frame; none if nothing moves."""
    if maps is None or maps.spectrogram is None:
        return []
    figure = plotting.spectrogram(maps.spectrogram)
    return [save_picture(folder, "micro_doppler", figure, "Micro-Doppler", "micro_doppler")]


def warning_tables(said: Sequence[str]) -> list[ReportTable]:
    """The table of faults of a recording; none without faults."""
    rows = [line.split(": ", 1) for line in said]
    return [ReportTable("Warnings", ["fault", "evidence"], rows)] if rows else []


@contextmanager
def _collect_warnings(messages: list[str]) -> Iterator[None]:
    """Collect the warnings of a reader in a list, and pass them on."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", PhysicsWarning)
        yield
    for one in caught:
        warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
        if issubclass(one.category, PhysicsWarning):
            messages.append(f"reading: {one.message}")


def read_recording(options: RecordingOptions) -> tuple[str, AnyRecording]:
    """Return the name of the reader, and the recording."""
    path, ending = options.recording, options.recording.suffix.lower()
    if path.is_dir() or ending == ".npz":
        folder, kind, preset = find_plugin_recording(path)
        more = {} if preset is None else {"board": _mount_board(options, options.board or preset)}
        return kind, registry.kind_table("data", kind).made_by(str(folder), **more)
    if captures.is_sweeps(path):
        return "sweeps", captures.read(path)
    raw, board, settings = ending in (".bin", ".json"), None, options.config
    if ending == ".toml":
        stated = options.board, options.elevation, options.azimuth
        board = described_arrays.load_described_board(path, *stated)
    elif raw:
        board = _mount_board(options, options.board or "")
    if options.change:
        if not raw:
            raise refusal("look.change_of_other_file", path.name)
        known = captures.ti.read_settings(options.config or path)
        settings = captures.ti.change_settings(known, _parse_changes(options.change))
    found = captures.read(path, settings, board=board, lanes=options.lanes)
    return {".nc": "netcdf", ".toml": "arrays"}.get(ending, "dca1000"), found


def _parse_changes(given: list[str]) -> dict[str, Any]:
    """Parse values by name, given as NAME=NUMBER or real=True."""
    found: dict[str, Any] = {}
    for text in given:
        name, _, value = text.partition("=")
        try:
            found[name.strip()] = number = json.loads(value.strip().lower())
            if not isinstance(number, int | float):
                raise ValueError
        except (ValueError, RecursionError):  # also of thousands of digits or levels
            raise refusal("look.change", text[:60]) from None
    return found


def _mount_board(options: RecordingOptions, board: str) -> Mounting:
    return Mounting(board, options.elevation, 1 if options.azimuth is None else options.azimuth)


def _to_capture(options: LookOptions, recording: AnyRecording) -> captures.Capture:
    """Return the capture with one signal a frame."""
    if isinstance(recording, captures.Capture):
        return recording
    chirp = "mean" if options.chirp is None else options.chirp
    return replace(recording, moving=False).to_capture(chirp)


def _calibrate_channels(
    options: LookOptions, recording: AnyRecording, folder: RunFolder
) -> tuple[AnyRecording, dict[str, Any]]:
    """Calibrate the channels of a recording; return also their spread before."""
    if options.channels is not None and options.reflector is not None:
        raise InputError("expected --channels or --reflector, got both; choose one")
    if options.channels is not None:
        calibration = captures.ChannelCalibration.load(options.channels)
    elif options.reflector is not None:
        signals = _to_capture(options, recording)
        calibration = captures.estimate_channels(signals, list(options.reflector))
        calibration.save(folder.file("channels.json"))
    else:
        return recording, {}
    gains = calibration.gains.abs()
    spread = 20 * torch.log10(gains.max() / gains.min())
    return calibration.apply(recording), {"channel_spread_db": float(spread)}


def _make_grid(options: LookOptions, capture: captures.Capture, recording: AnyRecording) -> Grid:
    radar, profiles = capture.radar(), "range_profile" in capture.dataset
    cell, farthest = radar.waveform.range_resolution, recording.max_range
    if profiles:
        low = float(capture.ranges[0]) if options.range_min is None else options.range_min
        high = farthest if options.range_max is None else options.range_max
    else:
        low, high = captures.search_ranges(recording, options.range_min, options.range_max)
    if high > farthest * (1 + 1e-9):
        raise refusal("look.far_range", farthest, high)
    if profiles:
        step = cell / 2  # inside the first and last samples
        return Grid(low, step, max(int((high - low) / step), 1))
    return radar.grid(low, high)


def _high_resolution_panels(
    options: LookOptions,
    capture: captures.Capture,
    chirps: captures.ChirpCapture | None,
    grid: Grid,
) -> dict[str, MapPanel]:
    """Draw direction spectra by a method other than Bartlett's."""
    radar = capture.radar()
    if "range_profile" in capture.dataset:
        raise refusal("look.method", options.method)
    if chirps is None:
        one = capture.frames([options.frame])
        profile = radars.range_profile(one.beat, one.radar(), grid)
    else:
        profile = radars.doppler_snapshots(chirps.beat, radar, grid, chirps.chirps, options.frame)
    power = radars.high_resolution_map(profile, radar, grid, options.method, options.sources)
    return plotting.direction_panels(f"everything, {options.method}", power, grid)


def _make_panels(
    capture: captures.Capture, chirps: captures.ChirpCapture | None, grid: Grid, frame: int
) -> tuple[dict[str, MapPanel], dict[str, Any], torch.Tensor, radars.DopplerMaps | None]:
    """Make the pictures and numbers of one frame; return also its power [range, u, v], and maps."""
    if chirps is not None:
        maps = radars.doppler_maps(chirps.beat, chirps.device, grid, chirps.chirps, frame)
        numbers = describe_frame(maps, chirps.device, chirps.chirps)
        return plotting.doppler_panels(maps), numbers, maps.total_power, maps
    spectrum = capture.frames([frame]).spectrum(grid)[0].double()
    shown = plotting.direction_panels("range and direction", spectrum, grid)
    numbers = radars.find_peak(spectrum, grid).metrics("peak")
    del numbers["peak_velocity_m_s"]
    if not shown:
        del numbers["peak_azimuth_deg"]
        shown["range"] = MapPanel(spectrum[:, :, 0], grid.ranges, torch.zeros(1), "one channel")
    return shown, numbers, spectrum, None
