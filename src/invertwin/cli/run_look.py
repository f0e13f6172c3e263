"""`invertwin look`: pictures of a recording as it is, and the recording as a capture."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from invertwin.capture import (
    Capture,
    ChannelCalibration,
    ChirpData,
    described_arrays,
    estimate_channels,
    ti,
)
from invertwin.capture.elements import elements
from invertwin.channel import Grid
from invertwin.cli.options import Look
from invertwin.cli.registry import load_plugins, registry
from invertwin.cli.report import Table, finish, picture, quantities, texts
from invertwin.cli.runs import RunFolder
from invertwin.errors import InputError
from invertwin.plotting import Panel, direction_panels, doppler_panels, panels
from invertwin.radar import (
    Radar,
    SampledWaveform,
    doppler_maps,
    points_csv,
    points_of,
    range_profile,
    sharp_map,
    snapshots_of,
    still_peak,
    velocity_span,
)
from invertwin.scene import AntennaArray

_ENDINGS = ".bin, .setup.json, .toml, .nc or .npz"
# Leakage from transmitters to receivers outshines what is nearer than this many range cells.
_NEAREST_CELLS = 3


@dataclass(frozen=True)
class _Recording:
    """A recording that has been read."""

    reader: str
    capture: Capture
    chirps: ChirpData | None  # complex, where there are several
    farthest: float  # range up to which samples mean something [m]

    @property
    def has_profiles(self) -> bool:
        """Whether it holds range profiles in place of beat signals."""
        return "range_profile" in self.capture.dataset


def run_look(look: Look, folder: RunFolder) -> list[Table]:
    """Reads a recording, writes capture, pictures and numbers, returns the tables to print.

    Raises:
        InputError: A recording or options that do not fit each other; nothing has been written.
    """
    recording, metrics = _calibrated(look, _read(look), folder)
    radar, chirps = recording.capture.radar(), recording.chirps
    if not 0 <= look.frame < radar.frame_count:
        raise InputError(
            f"expected a --frame from 0 to {radar.frame_count - 1}, got {look.frame}; choose one "
            "of the recording"
        )
    grid = _grid(look, radar, recording)
    metrics |= {
        "task": "look",
        "reader": recording.reader,
        "frames": radar.frame_count,
        "channels": len(radar.virtual_positions),
        "frequency_ghz": radar.waveform.center_frequency / 1e9,
        "range_cell_m": radar.waveform.range_resolution,
    }
    if isinstance(radar.waveform, SampledWaveform):
        metrics |= {"samples": radar.waveform.samples, "max_range_m": recording.farthest}
    shown, found = _maps(recording, radar, grid, look.frame)
    metrics |= found
    if look.method != "bartlett":
        shown |= _sharper(look, recording, radar, grid)
    points = None
    if chirps is not None:
        points = points_of(chirps.beat, radar, grid, chirps.settings.chirps, look.frame)
    if radar.frame_count > 1:
        profiles = recording.capture.spectrum(replace(grid, u_count=1, v_count=1))
        times = torch.arange(radar.frame_count)
        shown["all frames"] = Panel(profiles[:, :, 0, 0].T.double(), grid.ranges, times, "frame")
    recording.capture.save(folder.file("capture.nc"))
    if points is not None:
        metrics["points"] = len(points)
        folder.write_text("points.csv", points_csv(points))
    title = look.recording.name
    return finish(
        folder,
        metrics,
        title,
        f"{radar.frame_count} frames, read as {recording.reader}.",
        [
            quantities(title, metrics),
            picture(folder, "look", panels(shown), f"Frame {look.frame}", "doppler"),
        ],
        again="look capture.nc",
        note=texts("notes")["look"],
    )


def _read(look: Look) -> _Recording:
    path = look.recording
    if not path.exists():
        raise InputError(f"expected a recording, got no file {path}; check the path")
    ending = path.suffix.lower()
    if path.is_dir() or ending == ".npz":
        return _read_public(look, path if path.is_dir() else path.parent)
    if ending == ".nc":
        return _whole("netcdf", Capture.load(path))
    if ending == ".toml":
        data = described_arrays.read_chirps(path)
        arrays = described_arrays.described_elements(
            path, data.settings, look.board, look.elevation, look.azimuth
        )
        return _of_chirps("arrays", data, arrays, look)
    if ending in (".bin", ".json"):
        data = ti.read_recording(path, look.config, look.lanes)
        return _of_chirps("dca1000", data, _preset(look, data, look.board), look)
    raise InputError(f"expected a recording that ends in {_ENDINGS}, got {path.name}; convert it")


def _read_public(look: Look, folder: Path) -> _Recording:
    known = load_plugins().recordings
    for file, (kind, board) in known.items():
        if (folder / file).is_file() and look.recording.name in (file, folder.name):
            found = registry.table("data", kind).made_by(str(folder))
            if isinstance(found, Capture):
                return _whole(kind, found)
            arrays = _preset(look, found.chirps, look.board or board)
            return _of_chirps(kind, found.chirps, arrays, look)
    raise InputError(
        f"expected a folder with {' or '.join(known) or 'a recording that a plugin reads'}, got "
        f"{look.recording}; of other arrays name the TOML description"
    )


def _preset(look: Look, data: ChirpData, board: str | None) -> tuple[AntennaArray, AntennaArray]:
    if board is None:
        raise InputError(
            "expected a --board, got none; name the preset that recorded, and its --elevation"
        )
    azimuth = 1 if look.azimuth is None else look.azimuth
    return elements(data.settings, board, look.elevation, azimuth, None)


def _of_chirps(
    reader: str, data: ChirpData, arrays: tuple[AntennaArray, AntennaArray], look: Look
) -> _Recording:
    capture = data.capture(*arrays, chirps="mean" if look.chirp is None else look.chirp)
    waveform = data.settings.waveform
    # The analytic signal of real samples holds up to half of the range.
    farthest = waveform.max_range / (2 if data.settings.real else 1)
    chirps = None
    if data.settings.loops > 1:
        chirps = ChirpData(data.beat, replace(data.settings, real=False))
    return _Recording(reader, capture, chirps, farthest)


def _whole(reader: str, capture: Capture) -> _Recording:
    if "beat" not in capture.dataset:
        return _Recording(reader, capture, None, float(capture.ranges[-1]))
    waveform = capture.radar().waveform
    assert isinstance(waveform, SampledWaveform)
    return _Recording(reader, capture, None, waveform.max_range)


def _calibrated(
    look: Look, recording: _Recording, folder: RunFolder
) -> tuple[_Recording, dict[str, Any]]:
    """The recording with its channels calibrated, and how far they were apart."""
    if look.channels is not None and look.reflector is not None:
        raise InputError("expected --channels or --reflector, got both; choose one")
    if look.channels is not None:
        calibration = ChannelCalibration.load(look.channels)
    elif look.reflector is not None:
        calibration = estimate_channels(recording.capture, list(look.reflector))
        calibration.save(folder.file("channels.json"))
    else:
        return recording, {}
    chirps = recording.chirps
    gains = calibration.gains.abs()
    spread = 20 * torch.log10(gains.max() / gains.min())
    return replace(
        recording,
        capture=calibration.apply(recording.capture),
        chirps=None if chirps is None else calibration.apply_to_chirps(chirps),
    ), {"channel_spread_db": float(spread)}


def _grid(look: Look, radar: Radar, recording: _Recording) -> Grid:
    cell = radar.waveform.range_resolution
    nearest = _NEAREST_CELLS * cell
    if recording.has_profiles:
        nearest = float(recording.capture.ranges[0])
    low = nearest if look.range_min is None else look.range_min
    high = recording.farthest if look.range_max is None else look.range_max
    if high > recording.farthest * (1 + 1e-9):
        raise InputError(
            f"expected a --range-max within {recording.farthest:.4g} m, got {high:g}; samples "
            "do not tell ranges beyond it"
        )
    if recording.has_profiles:
        step = cell / 2  # inside the first and last samples
        return Grid(low, step, max(int((high - low) / step), 1))
    return radar.grid(low, high)


def _sharper(look: Look, recording: _Recording, radar: Radar, grid: Grid) -> dict[str, Panel]:
    """Directions by another method than Bartlett's."""
    if recording.has_profiles:
        raise InputError(
            f"expected --method bartlett, got {look.method}; this recording has one channel"
        )
    if recording.chirps is None:
        one = radar.frames([look.frame])
        beat = recording.capture.beat[look.frame : look.frame + 1]
        profile = range_profile(beat, one, grid)
    else:
        timing = recording.chirps.settings.chirps
        profile = snapshots_of(recording.chirps.beat, radar, grid, timing, look.frame)
    power = sharp_map(profile, radar, grid, look.method, look.sources)
    return direction_panels(f"everything, {look.method}", power, grid)


def _maps(
    recording: _Recording, radar: Radar, grid: Grid, frame: int
) -> tuple[dict[str, Panel], dict[str, Any]]:
    """Pictures and numbers of one frame."""
    if recording.chirps is not None:
        chirps = recording.chirps.settings.chirps
        maps = doppler_maps(recording.chirps.beat, radar, grid, chirps, frame)
        return doppler_panels(maps), {
            "chirps": chirps.count,
            "velocity_span_m_s": velocity_span(radar, chirps),
            **maps.strongest.metrics("peak"),
            **({} if maps.mover is None else maps.mover.metrics("mover")),
        }
    spectrum = recording.capture.frames([frame]).spectrum(grid)[0].double()
    shown = direction_panels("range and direction", spectrum, grid)
    numbers = still_peak(spectrum, grid).metrics("peak")
    del numbers["peak_velocity_m_s"]
    if not shown:
        del numbers["peak_azimuth_deg"]
        shown["range"] = Panel(spectrum[:, :, 0], grid.ranges, torch.zeros(1), "one channel")
    return shown, numbers
