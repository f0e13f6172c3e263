"""Uniform nodes in an axis-aligned box, and interpolation between them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from invertwin.checks import ArrayLike, checked_count, checked_tensor
from invertwin.deprecation import rename_members
from invertwin.errors import InputError
from invertwin.runtime.memory import require_at_most

_MAX_NODES, _MAX_NODES_PER_AXIS = 2e7, 2000
_DO = "give x, y, z of the box's corners"


@dataclass(frozen=True, eq=False)
class Lattice:
    """Nodes of a box, corners included, see `from_bounds`.

    Attributes:
        low, high: corners of the box in the object's frame [m].
        counts: number of nodes along x, y and z.
    """

    low: Float64[Tensor, "3"]
    high: Float64[Tensor, "3"]
    counts: tuple[int, int, int]

    @classmethod
    def from_bounds(
        cls, low: ArrayLike, high: ArrayLike, counts: Sequence[int], *, sliced: bool = False
    ) -> "Lattice":
        """Build the lattice between two corners.

        Args:
            low, high: opposite corners of the box [m].
            counts: number of nodes along x, y and z.
            sliced: whether nodes are processed in slices, without a limit of their number.

        Raises:
            InputError: a box without volume, fewer than two nodes along an axis, wrong shapes, or
                NaN.
        """
        if len(counts) != 3:
            raise InputError(f"expected three counts, got {counts!r}; give those of x, y, z")
        first, last = (
            checked_tensor(corner, (3,), f"{name} corner of the box [m]", _DO).detach().clone()
            for name, corner in (("low", low), ("high", high))
        )
        if not bool((last > first).all()):
            raise InputError(
                f"expected a box with low < high, got {first.tolist()} and {last.tolist()}; {_DO}"
            )
        x, y, z = (checked_count(count, "nodes along an axis", 2) for count in counts)
        for count, most, where in (
            (max(x, y, z), _MAX_NODES_PER_AXIS, " along an axis"),
            (0 if sliced else x * y * z, _MAX_NODES, ""),
        ):
            do = "take fewer, wider apart"
            require_at_most(count, most, f"nodes of a grid{where}", do, "counts")
        return cls(first, last, (x, y, z))

    @property
    def spacing(self) -> Float64[Tensor, "3"]:
        """Distance of neighbouring nodes [m] along each axis."""
        return (self.high - self.low) / (self.low.new_tensor(self.counts) - 1)

    @property
    def nodes(self) -> Float64[Tensor, "x y z 3"]:
        """Positions of all nodes [m]."""
        return torch.stack(torch.meshgrid(*self.axes, indexing="ij"), dim=-1)

    @property
    def axes(self) -> list[Tensor]:
        """Positions of the nodes [m] along x, y and z."""
        return [
            torch.linspace(float(a), float(b), n, dtype=torch.float64)
            for a, b, n in zip(self.low, self.high, self.counts, strict=True)
        ]

    def cell(self, points: Float64[Tensor, "p 3"]) -> tuple[Tensor, Tensor]:
        """Return the cell of each point [p, 3], clamped, and the position within it in cells."""
        place = (points - self.low) / self.spacing
        index = place.detach().floor().long().clamp_min(0).minimum(torch.tensor(self.counts) - 2)
        return index, place - index


def tensor_product(
    values: Float64[Tensor, "x y z *rest"],
    index: Int64[Tensor, "p 3"],
    weights: Float64[Tensor, "p 3 4"],
) -> Float64[Tensor, "p *rest"]:
    """Sum the 4 × 4 × 4 nodes from `index` with separable weights.

    Args:
        values: values at the nodes.
        index: first node of each point along every axis.
        weights: weights of four nodes along every axis.
    """
    x, y, z = (index[:, k, None] + torch.arange(4) for k in range(3))
    near = values[x[:, :, None, None], y[:, None, :, None], z[:, None, None, :]]
    return torch.einsum("pi,pj,pk,pijk...->p...", weights[:, 0], weights[:, 1], weights[:, 2], near)


def interpolate_cubic(
    values: Float64[Tensor, "x y z"], lattice: Lattice, points: Float64[Tensor, "p 3"]
) -> Float64[Tensor, " p"]:
    """Interpolate at points by cubic convolution (Catmull–Rom), also outside the lattice.

    Args:
        values: values at the nodes.
        lattice: lattice of the nodes.
        points: positions [p, 3] [m].
    """
    index, t = lattice.cell(points)
    return tensor_product(_extrapolate_boundary(values), index, _cubic_convolution(t))


def interpolate_cubic_slices(
    values: Float64[Tensor, "x y z"], lattice: Lattice, target: Lattice
) -> Iterator[Float64[Tensor, "y z"]]:
    """Interpolate at the nodes of another lattice by cubic convolution, one plane of x at a time.

    Only one plane is in memory; weights are applied axis by axis.

    Args:
        values: values at the nodes.
        lattice: lattice of the nodes.
        target: lattice of the result.
    """
    extended = _extrapolate_boundary(values)
    x, y, z = (
        _interpolation_matrix(lattice, axis, places) for axis, places in enumerate(target.axes)
    )
    for weights in x:
        yield y @ torch.tensordot(weights, extended, dims=1) @ z.T


def _interpolation_matrix(lattice: Lattice, axis: int, positions: Tensor) -> Tensor:
    """Return weights [position, extended node] of a cubic convolution along one axis."""
    count = lattice.counts[axis]
    place = (positions - lattice.low[axis]) / lattice.spacing[axis]
    index = place.floor().long().clamp(0, count - 2)
    matrix = torch.zeros(len(positions), count + 2, dtype=torch.float64)
    return matrix.scatter(1, index[:, None] + torch.arange(4), _cubic_convolution(place - index))


def _extrapolate_boundary(values: Tensor) -> Tensor:
    """Extend by one node on every side, linearly from the last two."""
    for axis in range(3):
        first, second = values.narrow(axis, 0, 2).split(1, axis)
        before, last = values.narrow(axis, -2, 2).split(1, axis)
        values = torch.cat([2 * first - second, values, 2 * last - before], dim=axis)
    return values


def _cubic_convolution(t: Tensor) -> Tensor:
    """Return weights of four nodes around positions t in [0, 1]; 0, 1, 0, 0 at t = 0."""
    r = 1 - t
    inner = 2 - 5 * t**2 + 3 * t**3, 2 - 5 * r**2 + 3 * r**3
    return 0.5 * torch.stack([-t * r**2, *inner, -r * t**2], dim=-1)


rename_members(Lattice, between="from_bounds")
