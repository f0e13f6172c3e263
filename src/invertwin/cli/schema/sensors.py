"""Radars of run files: waveforms, antennas, boards, tracks, poses, grids."""

from dataclasses import replace
from typing import Annotated, Any, Literal

import torch
from annotated_types import Ge, MinLen
from pydantic import Tag, model_validator
from torch import Tensor

from invertwin import scene
from invertwin.capture.readers.radar_fields import WAVEFORMS
from invertwin.channel import Grid
from invertwin.limits import Count, Positive
from invertwin.radar import boards, tracks
from invertwin.radar.radar import Radar
from invertwin.radar.signal.chirps import Chirps
from invertwin.radar.signal.impairments import Impairments
from invertwin.radar.waveform import FMCW, OFDM, Impulse, SteppedFrequency, Waveform
from invertwin.registry import section
from invertwin.registry.kinds import ConstructorTable, FormOf, KindGroup, OneOf, Registry, TableOf
from invertwin.scene import TabulatedPattern as PatternTable

ElementNumbers = Annotated[list[Count], MinLen(1)]


_NumberOrEach = Annotated[Any, FormOf((float, list[float]))]
PolarisationValue = Annotated[Any, FormOf((Literal["V", "H", "circular"], list[_NumberOrEach]))]


class ArrayTable(ConstructorTable):
    """Antenna elements in the radar frame (x boresight, y left, z up).

    Attributes:
        center: m, in the radar frame
        polarisation: "V", "H", "circular" (right-hand) or two numbers (V, H), of all elements or of
            each
        leakage: field of the orthogonal polarisation over that of the wanted one, of all elements
            or of each
    """

    center: section.Vector = [0.0, 0.0, 0.0]
    polarisation: PolarisationValue = "V"
    leakage: _NumberOrEach = 0.0

    def build(self, given: Any = None, /, **more: Any) -> scene.AntennaArray:
        """The elements about their centre."""
        array = super().build(given, **more)
        return replace(array, positions=array.positions + _float64(self.center))


class BoardTable(ConstructorTable):
    """Elements on a board's grid of half wavelengths.

    Attributes:
        elevation: 1 = rows grow upwards, -1 = downwards; required where there are several rows
        azimuth: 1 = columns grow to the left of the radar (y), the right of who faces it, -1 = to
            its right
        transmitters: numbers from 1 in the order of sending; without it all, or those of the
            recording
        receivers: numbers from 1, ascending; without it all, or those of the recording
        pattern: pattern of every element; else isotropic
        polarisation: "V", "H", "circular" (right-hand) or two numbers (V, H), of all elements or of
            each; without it the board's
        leakage: field of the orthogonal polarisation over that of the wanted one
    """

    elevation: Literal[-1, 1] | None = None
    azimuth: Literal[-1, 1] = 1
    transmitters: ElementNumbers | None = None
    receivers: ElementNumbers | None = None
    pattern: Annotated[Any, OneOf("pattern")] | None = None
    polarisation: PolarisationValue | None = None
    leakage: float = 0.0

    def build(self, given: Any = None, /, **more: Any) -> boards.Mounting:
        """The board as it is mounted."""
        own = ("elevation", "azimuth", "transmitters", "receivers", "polarisation", "leakage")
        stated = {name: getattr(self, name) for name in own}
        pattern = None if self.pattern is None else self.pattern.build()
        return boards.Mounting(super().build(given, **more), pattern=pattern, **stated)


class LookAtOrientation(section.Section):
    """Boresight towards a point.

    Attributes:
        look_at: m, the point that boresight is turned to
    """

    look_at: section.Vector

    def rotations(self, places: Tensor) -> Tensor:
        """Axes [place, 3, 3] at places [place, 3] [m]."""
        with section.prefix_errors("orientation.look_at"):
            return scene.look_at(places, self.look_at)


class RotatedOrientation(section.Section):
    """The same axes at every position.

    Attributes:
        rotation_deg: rotation vector, the same at every position
    """

    rotation_deg: section.Vector

    def rotations(self, places: Tensor) -> Tensor:
        """Axes [3, 3], the same at all places."""
        return scene.rotation_from_vector(_float64(self.rotation_deg).deg2rad())


TrackValue = Annotated[Any, OneOf("track")]
Orientation = Annotated[
    Annotated[LookAtOrientation, Tag(section.TAG_MARK + "look_at")]
    | Annotated[RotatedOrientation, Tag(section.TAG_MARK + "rotation_deg")],
    section.tag_by(("look_at", "rotation_deg")),
]


class RadarPoseTable(ConstructorTable):
    """Pose of a radar in every frame.

    Attributes:
        positions: m, one for each frame: a list of points or a track; for a recording also one for
            all
        orientation: look_at or rotation_deg
        range_center: m, a point in the world that has range 0 in every frame, as in data that are
            motion compensated to a scene; without it ranges count from the radar
    """

    positions: TrackValue = [[0.0, 0.0, 0.0]]
    orientation: Orientation = RotatedOrientation(rotation_deg=[0.0, 0.0, 0.0])
    range_center: section.Vector | None = None

    def poses(self, frames: int) -> tuple[Tensor, Tensor]:
        """Positions [frame, 3]; columns are the radar's boresight, left and up axes [frame, 3, 3].

        Args:
            frames: Number of frames, where one position holds for all.

        Raises:
            InputError: A target straight above a position.
        """
        listed = isinstance(self.positions, list)
        places = _float64(self.positions) if listed else self.positions.build()
        if len(places) == 1:
            places = places.expand(frames, 3).clone()
        return places, self.orientation.rotations(places).expand(len(places), 3, 3).clone()

    def apply_range_center(self, radar: Radar) -> Radar:
        """The radar with the range origin of its data.

        Args:
            radar: Radar at the poses.
        """
        return radar if self.range_center is None else radar.center_on(_float64(self.range_center))


class RadarTable(RadarPoseTable):
    """Arrays, waveform and poses; one frame per position.

    Attributes:
        board: antenna elements of a board, or:
        transmitters: antenna elements
        receivers: antenna elements
    """

    board: Annotated[Any, OneOf("board")] | None = None
    transmitters: Annotated[Any, OneOf("array")] | None = None
    receivers: Annotated[Any, OneOf("array")] | None = None

    @model_validator(mode="after")
    def _check_elements(self) -> "RadarTable":
        arrays = self.board is None
        wanted = {"transmitters": arrays, "receivers": arrays}
        section.check_presence(self, wanted, f"with{'out' if arrays else ''} `board`")
        return self

    def build(self, given: Any = None, /, **more: Any) -> Radar:
        """The radar, one frame per position."""
        if self.board is not None:
            with section.prefix_errors("board"):
                more["transmitters"], more["receivers"] = self.board.build().arrays()
        more["positions"], more["rotations"] = self.poses(1)
        found = self.apply_range_center(super().build(given, **more))
        WAVEFORMS.setdefault(type(found.waveform).__name__, type(found.waveform))
        return found


class ChirpsTable(ConstructorTable):
    """Several ramps a frame: objects move between them, and range rates are resolved.

    Attributes:
        count: ramps of each transmitter in a frame (loops)
        retrace: trace rays anew at every ramp, instead of moving what is seen at the start of the
            frame; always where something has a motion
        visibility_every: with `retrace` or a motion: loops for which one trace serves; points
            follow their surfaces meanwhile
    """

    count: Annotated[int, Ge(2)]
    retrace: bool = False
    visibility_every: Count = 1


_RADAR_GIVEN = ("rotations", "range_bias", "range_origin")
AnyRadar = Annotated[Any, TableOf(Radar, RadarTable, _RADAR_GIVEN, checked=False)]
AnyGrid = Annotated[Any, TableOf(Radar.grid, without=("self",))]
AnyChirps = Annotated[Any, TableOf(Chirps, ChirpsTable, ("order",))]
AnyImpairments = Annotated[Any, TableOf(Impairments, without=("snr_db", "noise_figure_db"))]


def register(registry: Registry) -> None:
    """Add waveforms, antennas, boards and tracks."""
    registry.groups["pattern"] = KindGroup(product=scene.Pattern)
    registry.groups["waveform"] = KindGroup(product=Waveform)
    registry.groups["array"] = KindGroup(base=ArrayTable, product=scene.AntennaArray)
    registry.groups["board"] = KindGroup(base=BoardTable, product=boards.Mounting)
    registry.groups["track"] = KindGroup(points=Annotated[list[section.Vector], MinLen(1)])
    waveforms = {"fmcw": FMCW, "stepped": SteppedFrequency, "ofdm": OFDM, "impulse": Impulse}
    for name, waveform in waveforms.items():
        registry.add("waveform", name, waveform)
    registry.add("pattern", "isotropic", scene.Isotropic)
    registry.add("pattern", "cosine", scene.Cosine)
    registry.add("pattern", "table", PatternTable.from_decibels, checked=True)
    registry.add("array", "planar", scene.planar_array)
    registry.add("array", "linear", scene.linear_array)
    registry.add("array", "positions", scene.AntennaArray)
    registry.add("board", "name", boards.board, untagged=True)
    registry.add("board", "tx_places", custom_board, untagged=True)
    for curve in (tracks.line, tracks.arc, tracks.grid):
        registry.add("track", curve.__name__, curve)


def custom_board(
    tx_places: boards.ElementGrid, rx_places: boards.ElementGrid, design_frequency: Positive
) -> boards.Board:
    """Custom board: element positions on its grid.

    Args:
        tx_places: column, row of TX1, TX2, … in half wavelengths.
        rx_places: column, row of RX1, RX2, … in half wavelengths.
        design_frequency: Hz, whose half wavelength is the unit.
    """
    return boards.Board("the board", tx_places, rx_places, design_frequency)


def radar(table: Any) -> Radar:
    """The radar of a `[radar]` table, one frame per position.

    Raises:
        InputError: Values the radar refuses, or a target straight above a position.
    """
    with section.prefix_errors("radar"):
        return table.build()


def grid(table: Any, radar: Radar) -> Grid:
    """The bins of a `[grid]` table for a radar.

    Raises:
        InputError: Limits that the radar refuses or does not reach.
    """
    with section.prefix_errors("grid"):
        return table.build(self=radar)


def impairments(table: Any, data: Any) -> Impairments:
    """The front end of the `[impairments]` table, if any, with the noise of simulated `[data]`."""
    noise = {"snr_db": data.snr_db, "noise_figure_db": data.noise_figure_db}
    with section.prefix_errors("impairments"):
        return Impairments(**noise) if table is None else table.build(**noise)


def _float64(values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)
