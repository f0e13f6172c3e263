"""`invertwin look`: pictures of a recording as it is, and the recording as a capture."""

import json
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from invertwin.capture import (
    Capture,
    ChannelCalibration,
    ChirpCapture,
    estimate_channels,
    faults_of,
    is_sweeps,
    read,
    shown_ranges,
    ti,
)
from invertwin.capture.readers import described_arrays
from invertwin.channel import Grid
from invertwin.cli.options import Look, Recorded
from invertwin.cli.report import Table, finish, picture, quantities, texts
from invertwin.errors import InputError, PhysicsWarning
from invertwin.plotting import Panel, direction_panels, doppler_panels, panels
from invertwin.radar import (
    SampledWaveform,
    doppler_maps,
    peak_of,
    points_csv,
    points_of,
    range_profile,
    save_points,
    sharp_map,
    snapshots_of,
    velocity_span,
)
from invertwin.radar.boards import Mounting
from invertwin.registry.kinds import load_plugins, registry
from invertwin.storage.run_folder import RunFolder

Recording = Capture | ChirpCapture
_ENDINGS = ".bin, .setup.json, .toml, .s1p, .s2p, .nc or .npz"


def run_look(look: Look, folder: RunFolder) -> list[Table]:
    """Read a recording, write capture, pictures and numbers, return the tables to print.

    Raises:
        InputError: A recording or options that do not fit each other; nothing has been written.
    """
    said: list[str] = []
    with _kept(said):
        reader, recording = read_recording(look)
    as_recorded = recording
    recording, metrics = _calibrated(look, recording, folder)
    capture, chirps = _capture(look, recording), None
    if isinstance(recording, ChirpCapture) and recording.chirps.count > 1:
        chirps = recording
    radar = capture.radar()
    if not 0 <= look.frame < radar.frame_count:
        raise InputError(
            f"expected a --frame from 0 to {radar.frame_count - 1}, got {look.frame}; choose one "
            "of the recording"
        )
    grid = _grid(look, capture, recording)
    said += map(str, faults_of(as_recorded, look.range_min, look.range_max))
    metrics |= {
        "task": "look",
        "reader": reader,
        "frames": radar.frame_count,
        "channels": len(radar.virtual_positions),
        "frequency_ghz": radar.waveform.center_frequency / 1e9,
        "range_cell_m": radar.waveform.range_resolution,
    }
    if isinstance(radar.waveform, SampledWaveform):
        metrics |= {"samples": radar.waveform.samples, "max_range_m": recording.max_range}
    if radar.range_origin is not None:
        metrics["range_origin_m"] = float(radar.range_origin.mean())
    shown, found = _maps(capture, chirps, grid, look.frame)
    metrics |= found
    if look.method != "bartlett":
        shown |= _sharper(look, capture, chirps, grid)
    points = None
    if chirps is not None:
        points = points_of(chirps.beat, radar, grid, chirps.chirps, look.frame)
    elif "beat" in capture.dataset:
        points = points_of(capture.beat[:, None], radar, grid, None, look.frame)
    if radar.frame_count > 1:
        profiles = capture.spectrum(replace(grid, u_count=1, v_count=1))
        times = torch.arange(radar.frame_count)
        shown["all frames"] = Panel(profiles[:, :, 0, 0].T.double(), grid.ranges, times, "frame")
    metrics["warnings"] = said
    capture.save(folder.file("capture.nc"))
    if points is not None:
        metrics["points"] = len(points)
        folder.write_text("points.csv", points_csv(points))
        for suffix in ("ply", "pcd"):
            save_points(folder.file(f"points.{suffix}"), points)
    title = look.recording.name
    return finish(
        folder,
        metrics,
        title,
        f"{radar.frame_count} frames, read as {reader}.",
        [
            quantities(title, metrics),
            *([Table("Warnings", ["fault", "evidence"], _rows(said))] if said else []),
            picture(folder, "look", panels(shown), f"Frame {look.frame}", "doppler"),
        ],
        again="look capture.nc",
        note=texts("notes")["look"],
    )


@contextmanager
def _kept(said: list[str]) -> Iterator[None]:
    """Warnings of a reader go on, and into a list."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", PhysicsWarning)
        yield
    for one in caught:
        warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
        if issubclass(one.category, PhysicsWarning):
            said.append(f"reading: {one.message}")


def _rows(said: list[str]) -> list[list[str]]:
    """Names and evidence of warnings."""
    return [list(line.split(": ", 1)) for line in said]


def read_recording(look: Recorded) -> tuple[str, Recording]:
    """The name of the reader, and what it has read."""
    path, ending = look.recording, look.recording.suffix.lower()
    if not path.exists():
        raise InputError(f"expected a recording, got no file {path}; check the path")
    if path.is_dir() or ending == ".npz":
        return _read_public(look, path if path.is_dir() else path.parent)
    if is_sweeps(path):
        return "sweeps", read(path)
    readers = {".nc": "netcdf", ".toml": "arrays", ".bin": "dca1000", ".json": "dca1000"}
    if ending not in readers:
        raise InputError(
            f"expected a recording that ends in {_ENDINGS}, got {path.name}; convert it"
        )
    board = None
    if ending == ".toml":
        board = described_arrays.described_board(path, look.board, look.elevation, look.azimuth)
    elif ending != ".nc":
        board = _board(look, look.board)
    settings = look.config
    if look.change:
        if readers[ending] != "dca1000":
            raise InputError(
                f"expected --set with a .bin or .setup.json, got {path.name}; correct its own file"
            )
        settings = ti.changed(ti.read_settings(look.config or path), _changes(look.change))
    return readers[ending], read(path, settings, board=board, lanes=look.lanes)


def _changes(given: list[str]) -> dict[str, Any]:
    """Values by name, as NAME=NUMBER or real=True."""
    found: dict[str, Any] = {}
    for text in given:
        name, _, value = text.partition("=")
        try:
            found[name.strip()] = json.loads(value.strip().lower())
        except json.JSONDecodeError:
            raise InputError(
                f"expected --set NAME=NUMBER, such as samples=128, or real=true, got {text!r}; "
                "write it so"
            ) from None
    return found


def _read_public(look: Recorded, folder: Path) -> tuple[str, Recording]:
    known = load_plugins().recordings
    for file, (kind, board) in known.items():
        if (folder / file).is_file() and look.recording.name in (file, folder.name):
            more = {} if board is None else {"board": _board(look, look.board or board)}
            return kind, registry.table("data", kind).made_by(str(folder), **more)
    raise InputError(
        f"expected a folder with {' or '.join(known) or 'a recording that a plugin reads'}, got "
        f"{look.recording}; of other arrays name the TOML description"
    )


def _board(look: Recorded, board: str | None) -> Mounting:
    if board is None:
        raise InputError(
            "expected a --board, got none; name the preset that recorded, and its --elevation"
        )
    return Mounting(board, look.elevation, 1 if look.azimuth is None else look.azimuth)


def _capture(look: Look, recording: Recording) -> Capture:
    """One signal a frame."""
    if isinstance(recording, Capture):
        return recording
    return replace(recording, moving=False).capture("mean" if look.chirp is None else look.chirp)


def _calibrated(
    look: Look, recording: Recording, folder: RunFolder
) -> tuple[Recording, dict[str, Any]]:
    """The recording with its channels calibrated, and how far they were apart."""
    if look.channels is not None and look.reflector is not None:
        raise InputError("expected --channels or --reflector, got both; choose one")
    if look.channels is not None:
        calibration = ChannelCalibration.load(look.channels)
    elif look.reflector is not None:
        calibration = estimate_channels(_capture(look, recording), list(look.reflector))
        calibration.save(folder.file("channels.json"))
    else:
        return recording, {}
    gains = calibration.gains.abs()
    spread = 20 * torch.log10(gains.max() / gains.min())
    return calibration.apply(recording), {"channel_spread_db": float(spread)}


def _grid(look: Look, capture: Capture, recording: Recording) -> Grid:
    radar, profiles = capture.radar(), "range_profile" in capture.dataset
    cell, farthest = radar.waveform.range_resolution, recording.max_range
    if profiles:
        low = float(capture.ranges[0]) if look.range_min is None else look.range_min
        high = farthest if look.range_max is None else look.range_max
    else:
        low, high = shown_ranges(recording, look.range_min, look.range_max)
    if high > farthest * (1 + 1e-9):
        raise InputError(
            f"expected a --range-max within {farthest:.4g} m, got {high:g}; samples "
            "do not tell ranges beyond it"
        )
    if profiles:
        step = cell / 2  # inside the first and last samples
        return Grid(low, step, max(int((high - low) / step), 1))
    return radar.grid(low, high)


def _sharper(
    look: Look, capture: Capture, chirps: ChirpCapture | None, grid: Grid
) -> dict[str, Panel]:
    """Directions by another method than Bartlett's."""
    radar = capture.radar()
    if "range_profile" in capture.dataset:
        raise InputError(
            f"expected --method bartlett, got {look.method}; this recording has one channel"
        )
    if chirps is None:
        one = capture.frames([look.frame])
        profile = range_profile(one.beat, one.radar(), grid)
    else:
        profile = snapshots_of(chirps.beat, radar, grid, chirps.chirps, look.frame)
    power = sharp_map(profile, radar, grid, look.method, look.sources)
    return direction_panels(f"everything, {look.method}", power, grid)


def _maps(
    capture: Capture, chirps: ChirpCapture | None, grid: Grid, frame: int
) -> tuple[dict[str, Panel], dict[str, Any]]:
    """Pictures and numbers of one frame."""
    if chirps is not None:
        maps = doppler_maps(chirps.beat, chirps.device, grid, chirps.chirps, frame)
        return doppler_panels(maps), {
            "chirps": chirps.chirps.count,
            "velocity_span_m_s": velocity_span(chirps.device, chirps.chirps),
            **maps.strongest.metrics("peak"),
            "moves": maps.mover is not None,
            **({} if maps.mover is None else maps.mover.metrics("mover")),
        }
    spectrum = capture.frames([frame]).spectrum(grid)[0].double()
    shown = direction_panels("range and direction", spectrum, grid)
    numbers = peak_of(spectrum, grid).metrics("peak")
    del numbers["peak_velocity_m_s"]
    if not shown:
        del numbers["peak_azimuth_deg"]
        shown["range"] = Panel(spectrum[:, :, 0], grid.ranges, torch.zeros(1), "one channel")
    return shown, numbers
