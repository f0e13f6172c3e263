"""Recordings of boards: raw files of any reader to chirps, elements and captures."""

import torch
from torch import Tensor

from invertwin.capture import Capture, ChannelCalibration, ChirpData, described_arrays, ti
from invertwin.cli import schema
from invertwin.cli.run_file import about
from invertwin.cli.sensors import board_elements, rotations_of, track
from invertwin.scene import AntennaArray


def measured(data: schema.Dca1000Data | schema.ArraysData) -> Capture:
    """The capture of a `[data]` table that names raw chirps.

    Raises:
        InputError: Files that are missing, damaged or contradict each other.
    """
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
    return calibrated(capture, data.channels)


def calibrated(capture: Capture, file: str | None) -> Capture:
    """The capture with a channel calibration divided out, where a file names one.

    Raises:
        InputError: A file that is none, or one of other channels.
    """
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
