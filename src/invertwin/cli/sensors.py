"""Radars of run files: waveforms, antennas, boards, tracks, grids, chirp trains, front ends."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal

import torch
from annotated_types import Ge, Gt, Le, Len, MinLen
from pydantic import Tag, model_validator
from torch import Tensor

from invertwin.capture.radar_fields import WAVEFORMS
from invertwin.channel import Grid
from invertwin.cli.registry import Group, OneOf, Registry, Table
from invertwin.cli.section import (
    TAG_MARK,
    Among,
    Section,
    Vector,
    about,
    check_presence,
    key,
    tag_by,
)
from invertwin.errors import InputError
from invertwin.limits import RADIANS, Angle, Count, NonNegative, Positive
from invertwin.radar import boards, motion
from invertwin.radar.impairments import Impairments
from invertwin.radar.radar import Radar
from invertwin.radar.waveform import (
    FMCW,
    OFDM,
    WINDOWS,
    Impulse,
    SampledWaveform,
    SteppedFrequency,
)
from invertwin.scene import (
    AntennaArray,
    Cosine,
    Isotropic,
    Pattern,
    linear_array,
    look_at,
    planar_array,
    rotation_from_vector,
)
from invertwin.scene import Table as PatternTable

_MOST_BINS = 1e9  # 4 GB a map
Numbers = Annotated[list[Count], MinLen(1)]
Window = Annotated[str, Among(tuple(WINDOWS))]
Elements = tuple[AntennaArray, AntennaArray]


class ArrayTable(Table):
    """Antenna elements in the radar frame (x right, y up, z boresight)."""

    center: Vector = key("m, in the radar frame", [0.0, 0.0, 0.0])

    def build(self, given: Any = None, /, **more: Any) -> AntennaArray:
        """The elements about their centre."""
        array = super().build(given, **more)
        return replace(array, positions=array.positions + _float64(self.center))


class BoardTable(Table):
    """Elements on a board's grid of half wavelengths."""

    elevation: Literal[-1, 1] | None = key(
        "1 = rows grow upwards, -1 = downwards; required where there are several rows", None
    )
    azimuth: Literal[-1, 1] = key("1 = columns grow to the right, -1 = to the left", 1)
    transmitters: Numbers | None = key(
        "numbers from 1 in the order of sending; without it all, or those of the recording", None
    )
    receivers: Numbers | None = key(
        "numbers from 1, ascending; without it all, or those of the recording", None
    )
    pattern: Annotated[Any, OneOf("pattern")] | None = key("of every element; else isotropic", None)

    def board(self) -> boards.Board:
        """The board."""
        return super().build()

    def build(self, given: Any = None, /, **more: Any) -> "BoardTable":
        """Itself: which of its elements are in use may be up to a recording."""
        return self


class LookAt(Section):
    look_at: Vector = key("m, the point that boresight is turned to")


class Turned(Section):
    rotation_deg: Vector = key("rotation vector, the same at every position")


Track = Annotated[Any, OneOf("track")]
Orientation = Annotated[
    Annotated[LookAt, Tag(TAG_MARK + "look_at")]
    | Annotated[Turned, Tag(TAG_MARK + "rotation_deg")],
    tag_by(("look_at", "rotation_deg")),
]


class RadarTable(Section):
    """Arrays, waveform and poses; one frame per position."""

    waveform: Annotated[Any, OneOf("waveform")] = key("what is sent")
    board: Annotated[Any, OneOf("board")] | None = key("antenna elements of a board, or:", None)
    transmitters: Annotated[Any, OneOf("array")] | None = key("antenna elements", None)
    receivers: Annotated[Any, OneOf("array")] | None = key("antenna elements", None)
    window: Window = key("over the samples of a ramp", "hamming")
    array_window: Window = key("over the elements", "hamming")
    positions: Track = key("m, one frame each: a list of points or a track", [[0.0, 0.0, 0.0]])
    orientation: Orientation = key("look_at or rotation_deg", Turned(rotation_deg=[0.0, 0.0, 0.0]))
    shared_visibility: bool | None = key(
        "what the transmitter sees, the receiver sees; default: when both are within 0.1 m", None
    )

    @model_validator(mode="after")
    def _elements(self) -> "RadarTable":
        arrays = self.board is None
        wanted = {"transmitters": arrays, "receivers": arrays}
        check_presence(self, wanted, f"with{'out' if arrays else ''} `board`")
        return self


class GridTable(Section):
    """The map that is compared: metres of range, direction cosines."""

    range_min: NonNegative = key("m")
    range_max: Positive = key("m")
    u_max: Annotated[float, Gt(0), Le(1)] = key("direction cosine to the right", 1.0)
    v_max: Annotated[float, Gt(0), Le(1)] = key("direction cosine up", 1.0)
    oversample: Positive = key("bins per resolution cell", 2.0)


class ChirpsTable(Table):
    """Several ramps a frame: objects move between them, and range rates are resolved."""

    count: Annotated[int, Ge(2)] = key("ramps of each transmitter in a frame (loops)")
    retrace: bool = key(
        "trace rays anew at every ramp, instead of moving what is seen at the start of the frame",
        False,
    )


def register(registry: Registry) -> None:
    """Adds waveforms, antennas, boards and tracks."""
    registry.groups["pattern"] = Group(product=Pattern)
    registry.groups["waveform"] = Group()
    registry.groups["array"] = Group(base=ArrayTable)
    registry.groups["board"] = Group(base=BoardTable)
    registry.groups["track"] = Group(points=Annotated[list[Vector], MinLen(1)])
    waveforms = {"fmcw": FMCW, "stepped": SteppedFrequency, "ofdm": OFDM, "impulse": Impulse}
    for name, waveform in waveforms.items():
        registry.add("waveform", name, waveform)
    registry.add("pattern", "isotropic", Isotropic)
    registry.add("pattern", "cosine", Cosine)
    registry.add("pattern", "table", measured_pattern, checked=True)
    registry.add("array", "planar", planar)
    registry.add("array", "linear", linear_array)
    registry.add("array", "positions", AntennaArray)
    registry.add("board", "name", preset, untagged=True)
    registry.add("board", "tx_places", own_board, untagged=True)
    for track_kind in (line, arc, grid_track):
        registry.add("track", track_kind.__name__.removesuffix("_track"), track_kind)


def measured_pattern(
    theta: Annotated[Sequence[float], MinLen(2), RADIANS],
    gain_db: Sequence[Sequence[float]],
    phi: Annotated[Sequence[float], MinLen(1), RADIANS] = (0.0,),
) -> PatternTable:
    """A measured power pattern: one row per theta, from 0 at boresight, one column per phi.

    Args:
        theta: from 0 at boresight.
        gain_db: one row per theta, one column per phi.
        phi: one: symmetric about boresight.
    """
    rows, columns = len(theta), len(phi)
    if len(gain_db) != rows or any(len(row) != columns for row in gain_db):
        lengths = sorted({len(row) for row in gain_db})
        raise InputError(
            f"expected gain_db with {rows} rows of {columns}, got {len(gain_db)} rows of "
            f"{' or '.join(map(str, lengths))}; give one row per theta and one column per phi"
        )
    return PatternTable(_float64(theta), _float64(phi), 10 ** (_float64(gain_db) / 10))


def planar(
    count: tuple[Count, Count], spacing: tuple[Positive, Positive], pattern: Pattern | None = None
) -> AntennaArray:
    """Elements on a grid, y runs fastest.

    Args:
        count: elements along x, y.
        spacing: m, along x, y.
        pattern: of every element, isotropic by default.
    """
    return planar_array(*count, *spacing, pattern=pattern)


def preset(
    name: Annotated[str, Among(tuple(boards.BOARDS))],
    design_frequency: Positive | None = None,
) -> boards.Board:
    """A board that the library knows.

    Args:
        name: of a preset; xWR serves AWR and IWR.
        design_frequency: Hz, whose half wavelength is the unit; without it the preset's.
    """
    found = boards.board(name)
    return found if design_frequency is None else replace(found, design_frequency=design_frequency)


_Places = Annotated[Sequence[Annotated[Sequence[float], Len(2, 2)]], MinLen(1)]


def own_board(tx_places: _Places, rx_places: _Places, design_frequency: Positive) -> boards.Board:
    """A board of one's own: a table of places.

    Args:
        tx_places: column, row of TX1, TX2, … in half wavelengths.
        rx_places: column, row of RX1, RX2, … in half wavelengths.
        design_frequency: Hz, whose half wavelength is the unit.
    """
    tx, rx = (tuple((x, y) for x, y in places) for places in (tx_places, rx_places))
    return boards.Board("the board", tx, rx, design_frequency)


def line(start: Vector, stop: Vector, count: Count) -> Tensor:
    """Positions at even distances on a line.

    Args:
        start: m.
        stop: m.
        count: positions.
    """
    first, last = _float64(start), _float64(stop)
    return first + torch.linspace(0, 1, count, dtype=torch.float64)[:, None] * (last - first)


def arc(center: Vector, radius: Positive, start: Angle, stop: Angle, count: Count) -> Tensor:
    """A level arc about `center`; 0° is on its −z side, 90° on its +x side.

    Args:
        center: m.
        radius: m.
        start: 0 is on the −z side of the centre.
        stop: 90 is on its +x side.
        count: positions.
    """
    angle = torch.linspace(start, stop, count, dtype=torch.float64)
    around = torch.stack([angle.sin(), 0 * angle, -angle.cos()], dim=1)
    return _float64(center) + radius * around


def grid_track(
    center: Vector, size: tuple[NonNegative, NonNegative], count: tuple[Count, Count]
) -> Tensor:
    """An upright rectangle of positions in the x-y plane through `center`.

    Args:
        center: m.
        size: m along x, y.
        count: positions along x, y.
    """
    x, y = (
        (torch.linspace(-0.5, 0.5, n, dtype=torch.float64) if n > 1 else torch.zeros(1)) * length
        for n, length in zip(count, size, strict=True)
    )
    across, up = torch.meshgrid(x.double(), y.double(), indexing="ij")
    offsets = torch.stack([across, up, torch.zeros_like(up)], dim=-1)
    return _float64(center) + offsets.reshape(-1, 3)


def radar(table: RadarTable) -> Radar:
    """The radar of a `[radar]` table, one frame per position.

    Raises:
        InputError: Values the radar refuses, or a target straight above a position.
    """
    with about("radar"):
        with about("waveform"):
            waveform = table.waveform.build()
        WAVEFORMS.setdefault(type(waveform).__name__, type(waveform))
        if table.board is not None:
            with about("board"):
                arrays = board_elements(table.board)
        else:
            arrays = (_elements(table, "transmitters"), _elements(table, "receivers"))
        positions = track(table.positions)
        with about("orientation.look_at"):
            rotations = rotations_of(table.orientation, positions)
        return Radar(
            *arrays,
            waveform,
            positions,
            rotations,
            window=table.window,
            array_window=table.array_window,
            shared_visibility=table.shared_visibility,
        )


def _elements(table: RadarTable, name: str) -> AntennaArray:
    with about(name):
        return getattr(table, name).build()


def board_elements(
    table: BoardTable,
    transmitters: Sequence[int] | None = None,
    receivers: Sequence[int] | None = None,
) -> Elements:
    """TX (in the order of sending) and RX of a `board` table: its own, or those that recorded.

    Raises:
        InputError: A missing sign, an element that the board does not have, or a choice of
            elements both in the table and by a recording.
    """
    for name, recorded in (("transmitters", transmitters), ("receivers", receivers)):
        given = getattr(table, name)
        if recorded is not None and given is not None:
            raise InputError(
                f"expected no `{name}` with a recording, got {given}; remove the key: the "
                f"recording's settings say {list(recorded)}"
            )
    return table.board().arrays(
        elevation=table.elevation,
        azimuth=table.azimuth,
        transmitters=transmitters or table.transmitters,
        receivers=receivers or table.receivers,
        pattern=None if table.pattern is None else table.pattern.build(),
    )


def track(table: Any) -> Tensor:
    """Positions [frame, 3] of a track or of a list of points."""
    return _float64(table) if isinstance(table, list) else table.build()


def rotations_of(table: Any, positions: Tensor) -> Tensor:
    """Columns are the radar's right, up and boresight axes in the world [frame, 3, 3].

    Raises:
        InputError: A target straight above a position.
    """
    if isinstance(table, Turned):
        turn = rotation_from_vector(torch.deg2rad(_float64(table.rotation_deg)))
        return turn.expand(len(positions), 3, 3).clone()
    return look_at(positions, table.look_at)


def grid(table: GridTable, radar: Radar) -> Grid:
    """The bins of a `[grid]` table for a radar.

    Raises:
        InputError: Limits that the radar refuses or does not reach, or a map of a size that only
            a wrong unit explains.
    """
    wave = radar.waveform
    if isinstance(wave, SampledWaveform) and table.range_max > wave.max_range:
        raise InputError(
            f"grid.range_max: expected at most the waveform's unambiguous range, "
            f"{wave.max_range:.4g} m, got {table.range_max:g}; give metres, or more samples"
        )
    with about("grid"):
        found = radar.grid(
            table.range_min, table.range_max, table.u_max, table.v_max, oversample=table.oversample
        )
    bins = math.prod(found.shape) * radar.frame_count
    if bins > _MOST_BINS:
        raise InputError(
            f"grid: expected a map of at most {_MOST_BINS:g} bins over all frames, got {bins:.3g}; "
            "give limits in metres and direction cosines, or less oversampling"
        )
    return found


def chirps(table: ChirpsTable) -> motion.Chirps:
    """Timing of the `[chirps]` table."""
    return table.build()


def impairments(table: Any, data: Any) -> Impairments:
    """The front end of the `[impairments]` table, if any, with the noise of simulated `[data]`."""
    noise = {"snr_db": data.snr_db, "noise_figure_db": data.noise_figure_db}
    with about("impairments"):
        return Impairments(**noise) if table is None else table.build(**noise)


def _float64(values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)
