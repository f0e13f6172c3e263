"""Uniform nodes in an axis-aligned box, and values between them."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from invertwin.errors import InputError
from invertwin.scene.checks import ArrayLike, checked_count, checked_tensor

_DO = "give x, y, z of the box's corners"


@dataclass(frozen=True, eq=False)
class Lattice:
    """Nodes of a box, corners included.

    Attributes:
        low, high: corners of the box in the object's frame [m].
        counts: nodes along x, y and z.

    Raises:
        InputError: a box without volume, or fewer than two nodes along an axis.
    """

    low: Float64[Tensor, "3"]
    high: Float64[Tensor, "3"]
    counts: tuple[int, int, int]

    @classmethod
    def between(cls, low: ArrayLike, high: ArrayLike, counts: Sequence[int]) -> "Lattice":
        """The lattice between two corners, given as any numbers.

        Raises:
            InputError: as above, wrong shapes, or NaN.
        """
        if len(counts) != 3:
            raise InputError(f"expected three counts, got {counts!r}; give those of x, y, z")
        corners = [
            checked_tensor(corner, (3,), f"{name} corner of the box [m]", _DO).detach().clone()
            for name, corner in (("low", low), ("high", high))
        ]
        x, y, z = (checked_count(count, "nodes along an axis", 2) for count in counts)
        return cls(corners[0], corners[1], (x, y, z))

    def __post_init__(self) -> None:
        if not bool((self.high > self.low).all()):
            raise InputError(
                "expected a box with low < high, "
                f"got {self.low.tolist()} and {self.high.tolist()}; {_DO}"
            )
        for count in self.counts:
            checked_count(count, "nodes along an axis", 2)

    @property
    def spacing(self) -> Float64[Tensor, "3"]:
        """Distance of neighbouring nodes [m] along each axis."""
        return (self.high - self.low) / (self.low.new_tensor(self.counts) - 1)

    @property
    def nodes(self) -> Float64[Tensor, "x y z 3"]:
        """Places of all nodes [m]."""
        axes = [
            torch.linspace(float(a), float(b), n, dtype=torch.float64)
            for a, b, n in zip(self.low, self.high, self.counts, strict=True)
        ]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)

    def cell(self, points: Float64[Tensor, "p 3"]) -> tuple[Tensor, Tensor]:
        """Cell of each point [p, 3], outside the nearest one, and the place in it in cells."""
        place = (points - self.low) / self.spacing
        last = torch.tensor(self.counts) - 2
        index = place.detach().floor().long().clamp_min(0).minimum(last)
        return index, place - index


def tensor_product(
    values: Float64[Tensor, "x y z *rest"],
    index: Int64[Tensor, "p 3"],
    weights: Float64[Tensor, "p 3 4"],
) -> Float64[Tensor, "p *rest"]:
    """Σ weights of the 4 × 4 × 4 nodes that begin at `index`, times their values."""
    steps = torch.arange(4)
    x, y, z = (index[:, k, None] + steps for k in range(3))
    near = values[x[:, :, None, None], y[:, None, :, None], z[:, None, None, :]]
    return torch.einsum("pi,pj,pk,pijk...->p...", weights[:, 0], weights[:, 1], weights[:, 2], near)
