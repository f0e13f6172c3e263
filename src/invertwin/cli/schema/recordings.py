"""Data of run files: simulated, captures, and recordings with every chirp."""

from dataclasses import replace
from typing import Annotated, Any, Literal

from annotated_types import Ge
from pydantic import model_validator

from invertwin.capture import Capture, ChannelCalibration, ChirpCapture, ChirpData, ti
from invertwin.capture.readers import described_arrays, described_sweeps
from invertwin.capture.readers.radar_fields import WAVEFORMS
from invertwin.cli.schema.sensors import RadarPoseTable
from invertwin.limits import Count, Decibels, Positive
from invertwin.radar.boards import Mounting
from invertwin.refusals import refusal
from invertwin.registry import section
from invertwin.registry.kinds import ConstructorTable, FormOf, KindGroup, Registry, registry
from invertwin.registry.section import InputPath, prefix_errors

DEFAULT_POINTS_PER_M2 = 2_000.0
"""Rough points of exact signals: enough for a fit; figures take more."""


class SimulatedData(section.Section):
    """Exact signals of the true scene, with noise.

    Attributes:
        points_per_m2: rough points per m²: a number, or a table by object, "*" for all others
        samples: coherent paths
        depth: most bounces of a path; with [chirps] one, unless it has mirrors
        mirrors: names of smooth flat objects that show the rest again (ghosts)
        rough_paths: paths to draw of two bounces, and of each larger number
        snr_db: signal-to-noise ratio per sample; without it no noise
        noise_figure_db: thermal noise of a receiver instead of snr_db
        seed: without it the run's
        every_start: a recording of its own for every start: coverage of error bars
    """

    kind: Literal["simulated"]
    points_per_m2: Annotated[Any, FormOf((Positive, dict[str, Positive]))] = DEFAULT_POINTS_PER_M2
    samples: Count = 200_000
    depth: section.Depth = 3
    mirrors: list[str] = []
    rough_paths: Count = 200_000
    snr_db: Decibels | None = None
    noise_figure_db: Decibels | None = None
    seed: section.Seed | None = None
    every_start: bool = False

    @model_validator(mode="after")
    def _one_noise_level(self) -> "SimulatedData":
        if self.snr_db is not None and self.noise_figure_db is not None:
            section.raise_key_error("expected snr_db or noise_figure_db, got both; remove one")
        return self


class RecordingTable(ConstructorTable):
    """Measured data.

    Attributes:
        channels: channel calibration that `invertwin look --reflector` wrote; divided out
    """

    channels: InputPath | None = None

    def build(self, given: Any = None, /, **more: Any) -> Capture | ChirpCapture:
        """The recording with its channels calibrated."""
        found = super().build(given, **more)
        if self.channels is None:
            return found
        with prefix_errors("channels"):
            return ChannelCalibration.load(self.channels).apply(found)


class ChirpRecordingTable(RecordingTable, RadarPoseTable):
    """Raw chirps of a board, made one signal per frame.

    Attributes:
        chirp: number of one chirp, from 0; default: mean over the frame, in which targets fade
        frame: number of the only frame to use, from 0; default: all
    """

    chirp: Annotated[int, Ge(0)] | None = None
    frame: Annotated[int, Ge(0)] | None = None

    def build(self, given: Any = None, /, **more: Any) -> ChirpCapture:
        """The recording with its poses."""
        found = super().build(given, **more)
        assert isinstance(found, ChirpCapture)
        if self.frame is not None:
            with prefix_errors("frame"):
                found = found.frames([self.frame])
        found = found.with_poses(*self.poses(found.frame_count))
        return replace(found, device=self.apply_range_center(found.device))


def register(kinds: Registry) -> None:
    """Add the readers; what one returns says which keys it has beside its own."""
    kinds.groups["data"] = KindGroup()
    kinds.bases[Capture] = RecordingTable
    kinds.bases[ChirpCapture] = ChirpRecordingTable
    kinds.add("data", "simulated", SimulatedData)
    kinds.add("data", "capture", load_capture)
    kinds.add("data", "dca1000", read_dca1000)
    kinds.add("data", "arrays", read_arrays)
    kinds.add("data", "sweeps", read_sweep_files)


def load_capture(file: InputPath, trusted: bool = False) -> Capture:
    """A capture saved by the library (NetCDF).

    Args:
        file: path, from the run file's folder.
        trusted: true reads it in this process, not in a child process.
    """
    for name in registry.names("waveform"):
        kind = registry.kind_table("waveform", name).made_by
        if isinstance(kind, type):  # a file of a plugin's radar names its waveform
            WAVEFORMS.setdefault(kind.__name__, kind)
    with prefix_errors("file"):
        return Capture.load(file, trusted=trusted)


def read_dca1000(
    file: InputPath,
    board: Mounting,
    settings: InputPath | None = None,
    lanes: Literal[2, 4] | None = None,
) -> ChirpCapture:
    """A recording of a TI board through the DCA1000.

    Args:
        file: .bin, or the .setup.json that names the files.
        board: board of the elements; the settings say which are in use.
        settings: .cfg or .mmwave.json; without it the file that .setup.json names.
        lanes: number of LVDS lanes, where the settings do not state it.
    """
    with prefix_errors("file"):
        chirps = ti.read_recording(file, settings, lanes)
    return assign_board(chirps, board)


def read_arrays(
    file: InputPath, board: Mounting | None = None, trusted: bool = False
) -> ChirpCapture:
    """Samples in a NumPy, HDF5 or MATLAB file with a TOML description beside it.

    Args:
        file: the description.
        board: board of the elements; without it that of the description.
        trusted: true reads it in this process, not in a child process.
    """
    with prefix_errors("file"):
        chirps = described_arrays.read_chirps(file, trusted=trusted)
    with prefix_errors("board"):
        return chirps.to_chirp_capture(board or described_arrays.load_described_board(file))


def read_sweep_files(file: InputPath, trusted: bool = False) -> Capture:
    """Sweeps over frequency: a Touchstone file, or a TOML description of files or of arrays.

    Args:
        file: the description, or one Touchstone file.
        trusted: true reads it in this process, not in a child process.
    """
    with prefix_errors("file"):
        return described_sweeps.read_sweeps(file, trusted=trusted)


def assign_board(chirps: ChirpData, board: Mounting) -> ChirpCapture:
    """Chirps that the elements of a board have recorded, those that the settings name."""
    with prefix_errors("board"):
        return chirps.to_chirp_capture(board)


def build_capture(data: Any) -> Capture:
    """The capture of a `[data]` table that names a recording.

    Raises:
        InputError: Files that are missing, damaged or contradict each other.
    """
    with prefix_errors("data"):
        found = data.build()
        if isinstance(found, Capture):
            return found
        return found.to_capture("mean" if data.chirp is None else data.chirp)


def build_chirp_capture(data: Any) -> ChirpCapture:
    """The recording of a `[data]` table with every chirp of its frames.

    Raises:
        InputError: Data without chirps, or files that are missing or damaged.
    """
    with prefix_errors("data"):
        found = None if data.kind == "simulated" else data.build()
    if not isinstance(found, ChirpCapture):
        raise refusal("recordings.no_chirps", data.kind)
    return found
