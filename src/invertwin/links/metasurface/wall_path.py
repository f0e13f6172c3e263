"""Positions of a metasurface: on a path along the walls, rotated about the vertical."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64
from torch import Tensor, nn

from invertwin.checks import ArrayLike, checked_count, checked_number, checked_point, checked_tensor
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.links.metasurface.panel import Metasurface

_CORNERS_ADVICE = "give x, y of at least two corners, the room on the left"
_MAX_ELEMENTS = 10_000  # of a panel along an axis
_UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


@dataclass(frozen=True)
class _PathSegment:
    """A straight or round piece of a path: where it begins, and its bend [1/m], left positive."""

    offset: float
    length: float
    start: Tensor
    direction: Tensor
    curvature: float


class WallPath:
    """Horizontal path along walls, with the room on its left and rounded corners.

    Args:
        corners: Corners of the path [corner, 2], at the distance from the walls that a panel
            requires [m].
        height: z of the path [m].
        radius: Radius of the rounded corners [m].
        closed: True if the last corner is connected to the first.

    Attributes:
        length: Length of the path [m].
        closed: See Args.

    Raises:
        InputError: Fewer than two corners, or a wall that is too short for the rounded corners.
    """

    def __init__(
        self,
        corners: Sequence[Sequence[float]],
        height: float,
        radius: float = 0.2,
        closed: bool = False,
    ) -> None:
        what = "corners of a path along walls [m]"
        flat = checked_tensor(corners, (None, 2), what, _CORNERS_ADVICE)
        if len(flat) < 2 + closed:
            raise InputError(
                f"expected more corners of a path along walls, got {len(flat)}; {_CORNERS_ADVICE}"
            )
        level = checked_number(height, "height of a path [m]", -math.inf)
        bow = checked_number(radius, "radius of corners [m]", 0.0, open_low=True)
        points = torch.cat([flat, torch.full((len(flat), 1), level, dtype=torch.float64)], 1)
        self.closed = closed
        self._pieces = _build_segments(points, bow, closed)
        self.length = self._pieces[-1].offset + self._pieces[-1].length

    def locate(
        self, distance: Float64[Tensor, ""]
    ) -> tuple[Float64[Tensor, "3"], Float64[Tensor, "3"]]:
        """Compute the position [m] at a path length, and the unit vector into the room.

        Args:
            distance: Path length from the start [m]; an open path is extended straight beyond its
                ends, a closed path is periodic.
        """
        if self.closed:
            distance = distance - self.length * math.floor(float(distance.detach()) / self.length)
        here = float(distance.detach())
        piece = next((p for p in self._pieces if here < p.offset + p.length), self._pieces[-1])
        inward = torch.linalg.cross(_UP, piece.direction)
        rest = distance - piece.offset
        if not piece.curvature:
            return piece.start + rest * piece.direction, inward
        turn = rest * piece.curvature
        normal = inward * turn.cos() - piece.direction * turn.sin()
        return piece.start + (inward - normal) / piece.curvature, normal


def _build_segments(points: Tensor, radius: float, closed: bool) -> list[_PathSegment]:
    ends = torch.cat([points, points[:1]]) if closed else points
    sides = ends[1:] - ends[:-1]
    lengths = sides.norm(dim=1)
    if float(lengths.min()) <= 0:
        raise InputError("expected corners of a path apart from each other, got two at one place")
    units = sides / lengths[:, None]
    count = len(sides)
    turns = [0.0] * (count + 1)  # at the end of each side; the first is before the first side
    for n in range(count):
        after = (n + 1) % count
        if closed or after:
            cross = float(torch.linalg.cross(units[n], units[after])[2])
            turns[n + 1] = math.atan2(cross, float(units[n] @ units[after]))
    turns[0] = turns[count] if closed else 0.0
    cuts = [radius * math.tan(abs(turn) / 2) for turn in turns]
    found: list[_PathSegment] = []
    begin = 0.0
    for n in range(count):
        left = float(lengths[n]) - cuts[n] - cuts[n + 1]
        if left <= 0:
            raise InputError(
                f"expected walls longer than their round corners, got one of {lengths[n]:.3g} m "
                f"with a radius of {radius:g} m; lower the radius"
            )
        start = ends[n] + cuts[n] * units[n]
        found.append(_PathSegment(begin, left, start, units[n], 0.0))
        begin += left
        if turns[n + 1]:
            bend = math.copysign(1 / radius, turns[n + 1])
            round_ = radius * abs(turns[n + 1])
            found.append(_PathSegment(begin, round_, start + left * units[n], units[n], bend))
            begin += round_
    return found


class PanelPlacement(nn.Module):
    """Module Metasurface → Metasurface: position along walls, yaw and focus of a panel.

    Phases are the sum of a focus that stays in place as the panel moves, a quadratic term that
    widens the beam, and a shift of each element. The derivative with respect to the position
    includes the phases of the focus. Values that leave their ranges in a step are clamped to the
    limits.

    Args:
        path: Path along the walls.
        tx: Position of the focused transmitter [3] [m].
        target: Focal point [3] [m].
        frequency: [Hz].
        counts: Numbers of elements along y and z whose phases are fitted; None = no element phases,
            see ``ElementPhases``.
        along: Initial position along the path [m].
        yaw: Initial rotation about the vertical, from the wall's normal [rad].
        spread: Initial half widths of the beam, horizontal and vertical [rad].
        yaw_limit: Maximum rotation from the wall's normal [rad].
        spread_limit: Maximum half width of the beam [rad].

    Attributes:
        along, yaw, spread: Parameters.
        shift: Parameter [y, z], phases of the elements [rad], if ``counts`` are given.

    Raises:
        InputError: Wrong shapes or numbers.
    """

    def __init__(
        self,
        path: WallPath,
        tx: ArrayLike,
        target: ArrayLike,
        frequency: float,
        counts: Sequence[int] | None = None,
        *,
        along: float = 0.0,
        yaw: float = 0.0,
        spread: ArrayLike = (0.0, 0.0),
        yaw_limit: float = math.inf,
        spread_limit: float = math.inf,
    ) -> None:
        super().__init__()
        self.path = path
        self._limits = {"yaw": yaw_limit, "spread": spread_limit}
        self._tx = checked_point(tx, "place of a transmitter [m]")
        self._target = checked_point(target, "target of a focus [m]")
        self._frequency = checked_number(frequency, "frequency [Hz]", 0.0, open_low=True)
        place = checked_number(along, "place of a panel [m]", -math.inf)
        turn = checked_number(yaw, "yaw of a panel [rad]", -math.inf)
        self.along = nn.Parameter(torch.tensor(place, dtype=torch.float64))
        self.yaw = nn.Parameter(torch.tensor(turn, dtype=torch.float64))
        widths = checked_tensor(spread, (2,), "spread of a beam [rad]", "give two half widths")
        self.spread = nn.Parameter(widths.clone())
        if counts is not None:
            self.shift = _zero_phases(counts)

    def forward(self, panel: Metasurface) -> Metasurface:
        """Return the panel at its position, with its phases."""
        with torch.no_grad():
            for name, limit in self._limits.items():
                getattr(self, name).data.clamp_(-limit, limit)
            if not self.path.closed:
                self.along.data.clamp_(0.0, self.path.length)
        place, normal = self.path.locate(self.along)
        turned = normal * self.yaw.cos() + torch.linalg.cross(_UP, normal) * self.yaw.sin()
        axes = torch.stack([turned, torch.linalg.cross(_UP, turned), _UP], 1)
        offsets = panel.cells.offsets
        half = 0.5 * panel.spacing * torch.tensor(panel.phase.shape, dtype=torch.float64)
        wave_number = 2 * math.pi * self._frequency / SPEED_OF_LIGHT
        bowed = 0.5 * wave_number * (offsets.square() / half) @ self.spread
        phase = panel.phase + bowed.view(panel.phase.shape)
        if hasattr(self, "shift"):
            phase = phase + self.shift
        placed = replace(panel, position=place, axes=axes, phase=phase)
        return placed.focus(self._tx, self._target, self._frequency)

    def values(self) -> dict[str, Tensor]:
        """Position [m], yaw and spread [rad] by name, for progress and reports."""
        named = {"along": self.along, "yaw": self.yaw, "spread": self.spread}
        return {f"panel.{name}": value.detach().clone() for name, value in named.items()}


def _zero_phases(counts: Sequence[int]) -> nn.Parameter:
    sizes = [checked_count(count, "elements along y and z", 1, _MAX_ELEMENTS) for count in counts]
    return nn.Parameter(torch.zeros(sizes, dtype=torch.float64))


class ElementPhases(nn.Module):
    """Module Metasurface → Metasurface that adds a phase to each element.

    Args:
        counts: Numbers of elements along y and z.

    Attributes:
        shift: Parameter [y, z], phases of the elements [rad].
    """

    def __init__(self, counts: Sequence[int]) -> None:
        super().__init__()
        self.shift = _zero_phases(counts)

    def forward(self, panel: Metasurface) -> Metasurface:
        """Return the panel with shifted phases."""
        return replace(panel, phase=panel.phase + self.shift)
