"""The tables of the radar: waveform, antennas, track, and the bins of the map."""

from typing import Annotated, Literal

from pydantic import Field, Tag, model_validator

from invertwin.cli.schema.section import (
    TAG_MARK,
    Count,
    NonNegative,
    Positive,
    Section,
    Vector,
    check_presence,
    fail,
    tag_by,
)


class Fmcw(Section):
    kind: Literal["fmcw"]
    start_frequency: Positive
    """Hz"""
    bandwidth: Positive
    """Hz"""
    duration: Positive
    """s, of one ramp"""
    samples: Count
    """of one ramp"""


class SteppedFrequency(Section):
    """Tones one after the other."""

    kind: Literal["stepped"]
    start_frequency: Positive
    """Hz, of the first tone"""
    step: Positive
    """Hz, from tone to tone"""
    samples: Count
    """tones"""
    dwell: Positive
    """s, on each tone"""


class Ofdm(Section):
    """Subcarriers sent at once."""

    kind: Literal["ofdm"]
    start_frequency: Positive
    """Hz, of the lowest subcarrier"""
    spacing: Positive
    """Hz, between subcarriers"""
    subcarriers: Count
    """how many"""


class Impulse(Section):
    """A pulse; its range profile is measured directly, so only the surrogate models it."""

    kind: Literal["impulse"]
    center_frequency: Positive
    """Hz"""
    bandwidth: Positive
    """Hz"""


Waveform = Annotated[
    Annotated[Fmcw, Tag(TAG_MARK + "fmcw")]
    | Annotated[SteppedFrequency, Tag(TAG_MARK + "stepped")]
    | Annotated[Ofdm, Tag(TAG_MARK + "ofdm")]
    | Annotated[Impulse, Tag(TAG_MARK + "impulse")],
    tag_by("kind"),
]


class Isotropic(Section):
    kind: Literal["isotropic"]


class Cosine(Section):
    """Power pattern cosⁿ of the angle from boresight."""

    kind: Literal["cosine"]
    exponent: NonNegative
    """n"""


class TablePattern(Section):
    """A measured power pattern: one row per theta, from 0 at boresight, one column per phi."""

    kind: Literal["table"]
    theta_deg: Annotated[list[float], Field(min_length=2)]
    """from 0 at boresight"""
    phi_deg: Annotated[list[float], Field(min_length=1)] = [0.0]
    """one: symmetric about boresight"""
    gain_db: list[list[float]]
    """one row per theta, one column per phi"""

    @model_validator(mode="after")
    def _rectangular(self) -> "TablePattern":
        rows, columns = len(self.theta_deg), len(self.phi_deg)
        if len(self.gain_db) != rows or any(len(row) != columns for row in self.gain_db):
            lengths = sorted({len(row) for row in self.gain_db})
            fail(
                f"expected gain_db with {rows} rows of {columns}, got {len(self.gain_db)} rows of "
                f"{' or '.join(map(str, lengths))}; give one row per theta and one column per phi"
            )
        return self


Pattern = Annotated[
    Annotated[Isotropic, Tag(TAG_MARK + "isotropic")]
    | Annotated[Cosine, Tag(TAG_MARK + "cosine")]
    | Annotated[TablePattern, Tag(TAG_MARK + "table")],
    tag_by("kind"),
]


class ArraySection(Section):
    """Antenna elements in the radar frame (x right, y up, z boresight)."""

    center: Vector = [0.0, 0.0, 0.0]
    """m, in the radar frame"""
    pattern: Pattern = Isotropic(kind="isotropic")
    """of every element"""


class PlanarArray(ArraySection):
    kind: Literal["planar"]
    count: Annotated[list[Count], Field(min_length=2, max_length=2)]
    """elements along x, y"""
    spacing: Annotated[list[Positive], Field(min_length=2, max_length=2)]
    """m, along x, y"""


class LinearArray(ArraySection):
    kind: Literal["linear"]
    count: Count
    """elements"""
    spacing: Positive
    """m"""
    axis: Literal["x", "y"] = "x"
    """of the radar frame"""


class PositionArray(ArraySection):
    kind: Literal["positions"]
    positions: Annotated[list[Vector], Field(min_length=1)]
    """m, in the radar frame"""


Array = Annotated[
    Annotated[PlanarArray, Tag(TAG_MARK + "planar")]
    | Annotated[LinearArray, Tag(TAG_MARK + "linear")]
    | Annotated[PositionArray, Tag(TAG_MARK + "positions")],
    tag_by("kind"),
]


Sign = Literal[-1, 1]
Numbers = Annotated[list[Count], Field(min_length=1)]
Places = Annotated[
    list[Annotated[list[float], Field(min_length=2, max_length=2)]], Field(min_length=1)
]


class BoardSection(Section):
    """Elements on a board's grid of half wavelengths."""

    elevation: Sign | None = None
    """1 = rows grow upwards, -1 = downwards; required where there are several rows"""
    azimuth: Sign = 1
    """1 = columns grow to the right, -1 = to the left"""
    transmitters: Numbers | None = None
    """numbers from 1 in the order of sending; without it all, or those of the recording"""
    receivers: Numbers | None = None
    """numbers from 1, ascending; without it all, or those of the recording"""
    pattern: Pattern = Isotropic(kind="isotropic")
    """of every element"""


class PresetBoard(BoardSection):
    name: Literal[
        "xWR1443", "xWR1642", "xWR1843", "IWR6843ISK", "IWR6843AOP", "AWR2944", "MMWCAS-RF"
    ]
    """of a preset; xWR serves AWR and IWR"""
    design_frequency: Positive | None = None
    """Hz, whose half wavelength is the unit; without it the preset's"""


class OwnBoard(BoardSection):
    """A board of one's own: a table of places."""

    tx_places: Places
    """column, row of TX1, TX2, … in half wavelengths"""
    rx_places: Places
    """column, row of RX1, RX2, … in half wavelengths"""
    design_frequency: Positive
    """Hz, whose half wavelength is the unit"""


Board = Annotated[
    Annotated[PresetBoard, Tag(TAG_MARK + "name")]
    | Annotated[OwnBoard, Tag(TAG_MARK + "tx_places")],
    tag_by("name", "tx_places"),
]


class LineTrack(Section):
    kind: Literal["line"]
    start: Vector
    """m"""
    stop: Vector
    """m"""
    count: Count
    """positions"""


class ArcTrack(Section):
    """A level arc about `center`; 0° is on its −z side, 90° on its +x side."""

    kind: Literal["arc"]
    center: Vector
    """m"""
    radius: Positive
    """m"""
    start_deg: float
    """0 is on the −z side of the centre"""
    stop_deg: float
    """90 is on its +x side"""
    count: Count
    """positions"""


class GridTrack(Section):
    """An upright rectangle of positions in the x-y plane through `center`."""

    kind: Literal["grid"]
    center: Vector
    """m"""
    size: Annotated[list[NonNegative], Field(min_length=2, max_length=2)]
    """m along x, y"""
    count: Annotated[list[Count], Field(min_length=2, max_length=2)]
    """positions along x, y"""


Track = Annotated[
    Annotated[Annotated[list[Vector], Field(min_length=1)], Tag(TAG_MARK + "points")]
    | Annotated[LineTrack, Tag(TAG_MARK + "line")]
    | Annotated[ArcTrack, Tag(TAG_MARK + "arc")]
    | Annotated[GridTrack, Tag(TAG_MARK + "grid")],
    tag_by("kind"),
]


class LookAt(Section):
    look_at: Vector
    """m, the point that boresight is turned to"""


class Turned(Section):
    rotation_deg: Vector
    """rotation vector, the same at every position"""


Orientation = Annotated[
    Annotated[LookAt, Tag(TAG_MARK + "look_at")]
    | Annotated[Turned, Tag(TAG_MARK + "rotation_deg")],
    tag_by("look_at", "rotation_deg"),
]

Window = Literal["hamming", "hann", "blackman", "rectangular"]


class Radar(Section):
    """Arrays, waveform and poses; one frame per position."""

    waveform: Waveform
    """what is sent"""
    board: Board | None = None
    """antenna elements of a board, or:"""
    transmitters: Array | None = None
    """antenna elements"""
    receivers: Array | None = None
    """antenna elements"""
    window: Window = "hamming"
    """over the samples of a ramp"""
    array_window: Window = "hamming"
    """over the elements"""
    positions: Track = [[0.0, 0.0, 0.0]]
    """m, one frame each: a list of points or a track"""
    orientation: Orientation = Turned(rotation_deg=[0.0, 0.0, 0.0])
    """look_at or rotation_deg"""
    shared_visibility: bool | None = None
    """what the transmitter sees, the receiver sees; default: when both are within 0.1 m"""

    @model_validator(mode="after")
    def _elements(self) -> "Radar":
        arrays = self.board is None
        wanted = {"transmitters": arrays, "receivers": arrays}
        check_presence(self, wanted, f"with{'out' if arrays else ''} `board`")
        return self


class Grid(Section):
    """The map that is compared: metres of range, direction cosines."""

    range_min: NonNegative
    """m"""
    range_max: Positive
    """m"""
    u_max: Annotated[float, Field(gt=0, le=1)] = 1.0
    """direction cosine to the right"""
    v_max: Annotated[float, Field(gt=0, le=1)] = 1.0
    """direction cosine up"""
    oversample: Positive = 2.0
    """bins per resolution cell"""
