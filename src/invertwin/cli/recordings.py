"""Measured data of run files: captures, raw chirps with their elements and poses."""

from pathlib import Path

import torch
from torch import Tensor

from invertwin.capture import (
    Capture,
    ChannelCalibration,
    ChirpCapture,
    ChirpData,
    described_arrays,
    openradar,
    rail_sar,
    ti,
)
from invertwin.cli import schema
from invertwin.cli.run_file import about
from invertwin.cli.sensors import board_elements, rotations_of, track
from invertwin.errors import InputError
from invertwin.scene import AntennaArray

_OPENRADAR_ORIGINAL = "github.com/PreSenseRadar/OpenRadar"
_RAIL_SAR_ORIGINAL = "github.com/jjimmykang/bwsi-backprojection, trial 6"


def measured(data: schema.MeasuredData) -> Capture:
    """The capture of a `[data]` table that names a recording.

    Raises:
        InputError: Files that are missing, damaged or contradict each other.
    """
    match data:
        case schema.CaptureData():
            with about("data.file"):
                capture = Capture.load(data.file)
            return _calibrated(capture, data.channels)
        case schema.RailSarData():
            with about("data.folder"):
                return _rail_sar(Path(data.folder))
    return _of_chirps(data)


def chirp_capture(data: schema.Data) -> ChirpCapture:
    """The recording of a `[data]` table with every chirp of its frames.

    Raises:
        InputError: Data without chirps, or files that are missing or damaged.
    """
    if isinstance(data, schema.OpenRadarData):
        with about("data.folder"):
            chirps = _openradar(Path(data.folder))
        with about("data.board"):
            device = chirps.radar(*board_elements(data.board))
    elif isinstance(data, schema.Dca1000Data | schema.ArraysData):
        with about("data.file"):
            chirps = _chirps(data)
        with about("data.board"):
            elements = _elements(data, chirps)
        with about("data.positions"):
            device = chirps.radar(*elements, *_poses(data, chirps.frame_count))
    else:
        raise InputError(
            f'data.kind: expected data with chirps, got "{data.kind}"; give dca1000, arrays, or '
            "simulated with [chirps]"
        )
    return ChirpCapture(chirps.beat, device, chirps.settings.chirps)


def _openradar(folder: Path) -> ChirpData:
    if not (folder / openradar.FILE).is_file():
        raise InputError(
            f"expected {openradar.FILE} in {folder}, got no such file; it is made from the public "
            f"recording of {_OPENRADAR_ORIGINAL}: set INVERTWIN_DATA to the folder that holds "
            f"{folder.name}/"
        )
    return openradar.read_chirps(folder)


def _rail_sar(folder: Path) -> Capture:
    if not (folder / rail_sar.FILE).is_file():
        raise InputError(
            f"expected {rail_sar.FILE} in {folder}, got no such file; it is made from the public "
            f"recording {_RAIL_SAR_ORIGINAL}: set INVERTWIN_DATA to the folder that holds "
            f"{folder.name}/"
        )
    return rail_sar.read(folder)


def _of_chirps(data: schema.Dca1000Data | schema.ArraysData) -> Capture:
    with about("data.file"):
        chirps = _chirps(data)
    with about("data.board"):
        transmitters, receivers = _elements(data, chirps)
    with about("data.positions"):
        positions, rotations = _poses(data, chirps.frame_count)
    with about("data"):
        capture = chirps.capture(
            transmitters,
            receivers,
            chirps="mean" if data.chirp is None else data.chirp,
            positions=positions,
            rotations=rotations,
        )
    return _calibrated(capture, data.channels)


def _calibrated(capture: Capture, file: str | None) -> Capture:
    """The capture with a channel calibration divided out, where a file names one."""
    if file is None:
        return capture
    with about("data.channels"):
        return ChannelCalibration.load(file).apply(capture)


def _chirps(data: schema.Dca1000Data | schema.ArraysData) -> ChirpData:
    if isinstance(data, schema.ArraysData):
        return described_arrays.read_chirps(data.file)
    return ti.read_recording(data.file, data.settings, data.lanes)


def _elements(
    data: schema.Dca1000Data | schema.ArraysData, chirps: ChirpData
) -> tuple[AntennaArray, AntennaArray]:
    settings = chirps.settings
    if data.board is None:
        return described_arrays.described_elements(data.file, settings)
    return board_elements(data.board, settings.transmit_order, settings.receivers)


def _poses(data: schema.Recording, frames: int) -> tuple[Tensor | None, Tensor | None]:
    """Positions and rotations of every frame; a single position is that of all frames."""
    if data.positions is None and data.orientation is None:
        return None, None
    positions = torch.zeros(1, 3, dtype=torch.float64)
    if data.positions is not None:
        positions = track(data.positions)
    if len(positions) == 1:
        positions = positions.expand(frames, 3).clone()
    if data.orientation is None:
        return positions, None
    return positions, rotations_of(data.orientation, positions)
