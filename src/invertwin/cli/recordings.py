"""Data of run files: simulated, captures, and raw chirps with their elements and poses."""

from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

from annotated_types import Ge
from pydantic import model_validator
from torch import Tensor, float64, zeros

from invertwin.capture import (
    Capture,
    ChannelCalibration,
    ChirpCapture,
    ChirpData,
    described_arrays,
    ti,
)
from invertwin.capture.radar_fields import WAVEFORMS
from invertwin.cli.registry import Group, OneOf, Registry, Table, registry
from invertwin.cli.section import Depth, InputPath, Section, Seed, about, fail, key
from invertwin.cli.sensors import (
    BoardTable,
    Elements,
    Orientation,
    Track,
    board_elements,
    rotations_of,
    track,
)
from invertwin.errors import InputError
from invertwin.limits import Count, Positive
from invertwin.radar.radar import Radar

_Board = Annotated[Any, OneOf("board")]


class SimulatedData(Section):
    """Exact signals of the true scene, with noise."""

    kind: Literal["simulated"]
    density: Positive = key("rough points per m²")
    samples: Count = key("coherent paths", 200_000)
    depth: Depth = key("most bounces of a path; with [chirps] it is one", 3)
    chains: Count = key("paths of two bounces to draw, and of each number above", 200_000)
    snr_db: float | None = key("signal to noise per sample; without it no noise", None)
    noise_figure_db: float | None = key("thermal noise of a receiver instead of snr_db", None)
    seed: Seed | None = key("without it the run's", None)

    @model_validator(mode="after")
    def _one_noise_level(self) -> "SimulatedData":
        if self.snr_db is not None and self.noise_figure_db is not None:
            fail("expected snr_db or noise_figure_db, got both; remove one")
        return self


@dataclass(frozen=True)
class Recording:
    """Every chirp of a recording, and what recorded it. Readers return it, or a `Capture`."""

    chirps: ChirpData
    elements: Elements  # of TX in the order of sending, of RX
    positions: Tensor | None = None  # of the radar in every frame [m]; None = the origin
    rotations: Tensor | None = None  # None = axes of the world
    moving: bool = False  # what it shows moves, and fades in the mean of a frame's chirps

    def radar(self) -> Radar:
        """What recorded it, one frame per position."""
        return self.chirps.radar(*self.elements, self.positions, self.rotations)

    def capture(self, chirp: int | None = None) -> Capture:
        """One signal per frame and channel: of one chirp, counted from 0, or the mean.

        Raises:
            InputError: The mean of a recording of movers.
        """
        if self.moving and chirp is None:
            raise InputError(
                "expected a parameter of kind mover, since the recording has chirps and movers, "
                "which fade in the mean of the chirps; seek a mover, or choose one `chirp`"
            )
        return self.chirps.capture(
            *self.elements,
            chirps="mean" if chirp is None else chirp,
            positions=self.positions,
            rotations=self.rotations,
        )


class DataTable(Table):
    """Measured data."""

    channels: InputPath | None = key(
        "channel calibration that `invertwin look --reflector` wrote; divided out", None
    )


class ChirpTable(DataTable):
    """Raw chirps of a board, made one signal per frame."""

    chirp: Annotated[int, Ge(0)] | None = key(
        "number from 0 of one; without it the mean of a frame's, in which movers fade", None
    )
    frame: Annotated[int, Ge(0)] | None = key(
        "number from 0 of the only one that is used; without it all", None
    )
    positions: Track | None = key(
        "m, of the radar in every frame, or one for all; without it the origin", None
    )
    orientation: Orientation | None = key(
        "look_at or rotation_deg; without it the axes of the world", None
    )

    def build(self, given: Any = None, /, **more: Any) -> Recording:
        """The recording with its poses."""
        found: Recording = super().build(given, **more)
        if self.frame is not None:
            with about("frame"):
                found = replace(found, chirps=_frame(found.chirps, self.frame))
        if self.positions is None and self.orientation is None:
            return found
        with about("positions"):
            positions = zeros(1, 3, dtype=float64)
            positions = positions if self.positions is None else track(self.positions)
            if len(positions) == 1:
                positions = positions.expand(found.chirps.frame_count, 3).clone()
            rotations = self.orientation and rotations_of(self.orientation, positions)
        return replace(found, positions=positions, rotations=rotations)


def register(kinds: Registry) -> None:
    """Adds the readers; what one returns says which keys it has beside its own."""
    kinds.groups["data"] = Group()
    kinds.bases[Capture] = DataTable
    kinds.bases[Recording] = ChirpTable
    kinds.add("data", "simulated", SimulatedData)
    kinds.add("data", "capture", saved)
    kinds.add("data", "dca1000", dca1000)
    kinds.add("data", "arrays", arrays)


def saved(file: InputPath) -> Capture:
    """A capture saved by the library (NetCDF).

    Args:
        file: path, from the run file's folder.
    """
    for name in registry.names("waveform"):
        kind = registry.table("waveform", name).made_by
        if isinstance(kind, type):  # a file of a plugin's radar names its waveform
            WAVEFORMS.setdefault(kind.__name__, kind)
    with about("file"):
        return Capture.load(file)


def dca1000(
    file: InputPath,
    board: _Board,
    settings: InputPath | None = None,
    lanes: Literal[2, 4] | None = None,
) -> Recording:
    """A recording of a TI board through the DCA1000.

    Args:
        file: .bin, or the .setup.json that names the files.
        board: whose elements recorded; those in use are what the settings say.
        settings: .cfg or .mmwave.json; without it what the .setup.json names.
        lanes: of the LVDS link, where the settings do not say.
    """
    with about("file"):
        chirps = ti.read_recording(file, settings, lanes)
    return recorded(chirps, board)


def arrays(file: InputPath, board: _Board | None = None) -> Recording:
    """Samples in a NumPy, HDF5 or MATLAB file with a TOML description beside it.

    Args:
        file: the description.
        board: whose elements recorded; without it what the description says.
    """
    with about("file"):
        chirps = described_arrays.read_chirps(file)
    if board is not None:
        return recorded(chirps, board)
    with about("board"):
        return Recording(chirps, described_arrays.described_elements(file, chirps.settings))


def recorded(chirps: ChirpData, board: BoardTable) -> Recording:
    """Chirps and the elements of the board that were in use."""
    settings = chirps.settings
    with about("board"):
        elements = board_elements(board, settings.transmit_order, settings.receivers)
    return Recording(chirps, elements)


def _frame(chirps: ChirpData, number: int) -> ChirpData:
    if number >= chirps.frame_count:
        raise InputError(
            f"expected a number below {chirps.frame_count}, got {number}; count frames from 0"
        )
    one = replace(chirps.settings, frames=1)
    return ChirpData(chirps.samples[number : number + 1], one)


def measured(data: Any, path: str = "data") -> Capture:
    """The capture of a `[data]` table that names a recording.

    Raises:
        InputError: Files that are missing, damaged or contradict each other.
    """
    found = _built(data, path)
    with about(path):
        capture = found.capture(data.chirp) if isinstance(found, Recording) else found
        if data.channels is None:
            return capture
        with about("channels"):
            return ChannelCalibration.load(data.channels).apply(capture)


def chirp_capture(data: Any, path: str = "data") -> ChirpCapture:
    """The recording of a `[data]` table with every chirp of its frames.

    Raises:
        InputError: Data without chirps, or files that are missing or damaged.
    """
    found = None if data.kind == "simulated" else _built(data, path)
    if not isinstance(found, Recording):
        raise InputError(
            f'{path}.kind: expected data with chirps, got "{data.kind}"; give dca1000, arrays, or '
            "simulated with [chirps]"
        )
    with about(path):
        radar, chirps = found.radar(), found.chirps
        if data.channels is not None:
            with about("channels"):
                chirps = ChannelCalibration.load(data.channels).apply_to_chirps(chirps)
    return ChirpCapture(chirps.beat, radar, chirps.settings.chirps)


def _built(data: Any, path: str) -> Capture | Recording:
    with about(path):
        return data.build()
