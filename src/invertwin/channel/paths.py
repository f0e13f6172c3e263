"""Frozen values that enter or leave the channel: bins, antenna poses, and paths."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Complex128, Float, Float64, Int64
from torch import Tensor

from invertwin.channel.rows import Rows
from invertwin.checks import check_fields
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.limits import Count, Positive
from invertwin.scene.polarisation import VERTICAL, Polarisation


@runtime_checkable
class GainPattern(Protocol):
    """Antenna pattern as the channel uses it (see ``invertwin.scene.antenna``)."""

    def gain(self, direction: Float[Tensor, "*point 3"]) -> Float[Tensor, "*point"]:
        """Linear power gain for unit directions in the radar frame."""
        ...

    def table(self) -> Float[Tensor, "cos phi"]:
        """Power gain on a grid uniform in cosθ in [-1, 1] and periodic in φ in [-π, π)."""
        ...


@dataclass(frozen=True)
class Grid:
    """Bins of a map: range R = L/2 [m] × direction cosines u, v of the radar frame.

    Attributes:
        range_start, u_start, v_start: Centre of the first bin.
        range_step, u_step, v_step: Distance of neighbouring centres.
        range_count, u_count, v_count: Number of bins. Of ``u`` or ``v``, 1 means that the axis is
            not resolved: every direction falls into that one bin.
    """

    range_start: float
    range_step: Positive
    range_count: Count
    u_start: float = 0.0
    u_step: Positive = 1.0
    u_count: Count = 1
    v_start: float = 0.0
    v_step: Positive = 1.0
    v_count: Count = 1

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Bins along range, u and v."""
        return self.range_count, self.u_count, self.v_count

    @property
    def ranges(self) -> Float64[Tensor, " range"]:
        """Bin centres [m]."""
        return self._axis(self.range_start, self.range_step, self.range_count)

    @property
    def u(self) -> Float64[Tensor, " u"]:
        """Bin centres of the first direction cosine (along y, to the left)."""
        return self._axis(self.u_start, self.u_step, self.u_count)

    @property
    def v(self) -> Float64[Tensor, " v"]:
        """Bin centres of the second direction cosine (along z, up)."""
        return self._axis(self.v_start, self.v_step, self.v_count)

    @property
    def in_visible_region(self) -> Bool[Tensor, "u v"]:
        """True for the bins of directions that exist: u² + v² ≤ 1."""
        return self.u[:, None].square() + self.v.square() <= 1

    @staticmethod
    def _axis(start: float, step: float, count: int) -> Float64[Tensor, " n"]:
        return start + step * torch.arange(count, dtype=torch.float64)


@dataclass(frozen=True)
class Link:
    """Poses, patterns and polarisations of the antennas in each frame.

    Attributes:
        tx: Phase centre of the transmitters, world coordinates [m].
        rx: Phase centre of the receivers [m]. Where it equals ``tx`` in every frame and both carry
            gradients, they count as one antenna, and ``tx`` gets the whole gradient.
        rotations: Columns are the radar's x (boresight), y (left), z (up) axes in the world.
        tx_pattern: Power pattern of one transmitter in the radar frame.
        rx_pattern: Power pattern of one receiver.
        wavelength: [m].
        shared_visibility: One visibility test from ``tx`` serves both antennas (V·V = V); the
            boundary then has one term instead of two (derivations §3).
        tx_jones: Polarisation of the transmitters, about the radar's z axis.
        rx_jones: Jones vectors of the receivers.
        range_origin: Range from which each frame counts that of its maps [m]; None = 0.
    """

    tx: Float64[Tensor, "frame 3"]
    rx: Float64[Tensor, "frame 3"]
    rotations: Float64[Tensor, "frame 3 3"]
    tx_pattern: GainPattern
    rx_pattern: GainPattern
    wavelength: float
    shared_visibility: bool
    tx_jones: Polarisation = VERTICAL
    rx_jones: Polarisation = VERTICAL
    range_origin: Float64[Tensor, " frame"] | None = None

    def __post_init__(self) -> None:
        frames = self.tx.shape[0]
        shapes = {"tx": (frames, 3), "rx": (frames, 3), "rotations": (frames, 3, 3)}
        for name, shape in shapes.items():
            value = getattr(self, name)
            if tuple(value.shape) != shape or not torch.isfinite(value).all():
                raise InputError(
                    f"expected finite {name} of shape {shape}, got {tuple(value.shape)}; "
                    "give one position and rotation per frame"
                )

    @property
    def frame_count(self) -> int:
        """Number of radar poses."""
        return self.tx.shape[0]


@dataclass(frozen=True)
class Paths(Rows):
    """Propagation paths, one row each.

    ``coefficient`` leaves out the propagation phase: the channel response is
    ``H(f) = Σ a exp(-j 2π f τ)`` (derivations §1 and §4).

    Attributes:
        frame: Radar pose that sees the path.
        delay: One-way total length over c, to the phase centres [s].
        coefficient: Field coefficient a, |a|² = received over transmitted power; zero for
            power paths.
        power: Expected received over transmitted power of the sample; zero for field paths.
        first: World position of the first scattering point [m].
        last: World position of the last point [m]; equal to ``first`` for one bounce.
        kind: ``power``, ``coherent``, ``rough`` or ``field`` (a mixture of the last two).
        boundary: Mask of boundary paths: zero in value, with the derivative of a moving
            shadow edge (derivations §3).
        velocity: World velocity of the last point [m/s]; None = at rest.
        first_velocity: That of the first one, where a mirror shows another; None = the same.
        matrix: Field coefficients between the polarisations that the elements of the arrays mix,
            receive × transmit; None where all elements are alike. ``coefficient`` is that of the
            mean elements.
        face: Triangle of the scattering point, counted through all objects of the scene in order;
            −1 of paths of several bounces. None where paths are not bound to a surface.
        barycentric: Its barycentric coordinates, the second's and the third's corner; with
            ``face``.
    """

    frame: Int64[Tensor, " path"]
    delay: Float64[Tensor, " path"]
    coefficient: Complex128[Tensor, " path"]
    power: Float64[Tensor, " path"]
    first: Float64[Tensor, "path 3"]
    last: Float64[Tensor, "path 3"]
    kind: str
    boundary: Bool[Tensor, " path"]
    velocity: Float64[Tensor, "path 3"] | None = None
    first_velocity: Float64[Tensor, "path 3"] | None = None
    matrix: Complex128[Tensor, "path r t"] | None = None
    face: Int64[Tensor, " path"] | None = None
    barycentric: Float64[Tensor, "path 2"] | None = None

    def __len__(self) -> int:
        return self.delay.shape[0]

    @property
    def range(self) -> Float64[Tensor, " path"]:
        """Half the path length [m]."""
        return 0.5 * SPEED_OF_LIGHT * self.delay

    def direction_cosines(self, link: "Link") -> Float64[Tensor, "path 2"]:
        """Direction cosines u and v in which the receiver sees the last points.

        Args:
            link: The antennas that the paths belong to.
        """
        way = self.last - link.rx[self.frame]
        local = torch.einsum("nij,ni->nj", link.rotations[self.frame], way)
        return local[:, 1:] / way.norm(dim=1, keepdim=True)

    @property
    def has_field(self) -> Bool[Tensor, " path"]:
        """Mask of paths with a field between any of the elements."""
        own = self.coefficient != 0
        return own if self.matrix is None else own | (self.matrix != 0).flatten(1).any(1)

    def scale_fields(self, weight: float | Float64[Tensor, " path"]) -> "Paths":
        """The paths with fields of other strength.

        Args:
            weight: Factor of the fields.
        """
        factor = torch.as_tensor(weight, dtype=torch.float64).reshape(-1)
        matrix = None if self.matrix is None else self.matrix * factor[:, None, None]
        return replace(self, coefficient=self.coefficient * factor, matrix=matrix)

    def __add__(self, other: "Paths") -> "Paths":
        return concatenate_paths([self, other])


def make_paths(
    frame: Int64[Tensor, " path"],
    delay: Tensor,
    first: Tensor,
    last: Tensor,
    kind: str,
    **given: Any,
) -> Paths:
    """Paths of one kind; power or coefficient that are not given are zero.

    Args:
        frame, delay, first, last, kind: Columns of ``Paths``.
        given: Other columns; ``boundary`` is True if all of them are boundary paths.
    """
    zero, boundary = torch.zeros_like(delay), given.pop("boundary", False)
    columns = {"coefficient": zero.to(torch.complex128), "power": zero} | given
    ends = {"first": first, "last": last, "boundary": torch.full_like(frame, boundary).bool()}
    return Paths(frame, delay, kind=kind, **ends, **columns)


def concatenate_paths(parts: Sequence[Paths]) -> Paths:
    """All paths in order."""
    joined: dict[str, Any] = {}
    for field in fields(Paths):
        columns = [getattr(part, field.name) for part in parts]
        if "velocity" in field.name and any(column is not None for column in columns):
            own = [torch.zeros_like(p.last) if p.velocity is None else p.velocity for p in parts]
            columns = [v if c is None else c for c, v in zip(columns, own, strict=True)]
        if field.name != "kind":
            joined[field.name] = None if any(c is None for c in columns) else torch.cat(columns)
    kinds = {part.kind for part in parts}
    return Paths(**joined, kind=kinds.pop() if len(kinds) == 1 else "field")
