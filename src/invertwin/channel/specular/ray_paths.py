"""Table of ray paths between point antennas, the result of ``trace_paths``."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Complex128, Float64, Int64
from torch import Tensor

from invertwin.channel.rows import Rows, concatenate_rows
from invertwin.constants import SPEED_OF_LIGHT

KINDS = ("", "reflection", "transmission", "diffraction", "metasurface")
"""Interaction types by their number in ``RayPaths.kinds``."""
REFLECTION, TRANSMISSION, DIFFRACTION, METASURFACE = 1, 2, 3, 4


@dataclass(frozen=True, eq=False)
class RayPaths(Rows):
    """Ray paths between antennas: line of sight, reflected, transmitted and diffracted.

    Rows are sorted by transmitter, receiver and delay; a link may have any number, also none.
    ``pad_links`` gives row numbers in a table with one row per link. Vertices are padded after the
    last one: with zeros, kind 0 and triangle −1.

    The field at the receiver is ``coefficient`` times that of the transmitter, without the
    propagation phase: ``H(f) = Σ a exp(−j2πfτ)``. Rows and columns are V and H, the unit vectors of
    θ and φ about the world's z axis: columns for the field radiated along ``departure``, rows for
    the field received from ``arrival``. The factor λ/4πL is included, antenna patterns are not.

    Attributes:
        counts: number of transmitters and of receivers.
        frequency: carrier frequency of the coefficients [Hz].
        tx, rx: antenna numbers of each path.
        delay: length over c [s].
        coefficient: complex amplitudes a, receive × transmit polarisation.
        departure, arrival: unit vectors in world axes away from the antennas, along the path.
        vertices: interaction points with surfaces and edges, from the transmitter on [m].
        kinds: interaction types, numbers of ``KINDS``.
        faces: triangles of the interactions, numbered through all objects.
        objects: objects of the interactions, numbers of ``names``.
        names: names of the scene's objects.
        doppler: Doppler shift due to motion of antennas and objects [Hz]; positive for decreasing
            length.
        slopes: slope amplitudes of paths over one edge [1/rad]: a for the derivatives of the
            transmitter's and of the receiver's field with respect to a rotation about ``axes``, in
            which the fields rotate with the directions; zero for other paths. None = no such path.
        axes: unit vectors of these rotations, at the transmitter and at the receiver.
        missed_fraction: estimated fraction of ray directions whose sequences of surfaces no ray has
            followed; None for an exhaustive search.
    """

    counts: tuple[int, int]
    frequency: float
    tx: Int64[Tensor, " path"]
    rx: Int64[Tensor, " path"]
    delay: Float64[Tensor, " path"]
    coefficient: Complex128[Tensor, "path 2 2"]
    departure: Float64[Tensor, "path 3"]
    arrival: Float64[Tensor, "path 3"]
    vertices: Float64[Tensor, "path vertex 3"]
    kinds: Int64[Tensor, "path vertex"]
    faces: Int64[Tensor, "path vertex"]
    objects: Int64[Tensor, "path vertex"]
    names: tuple[str, ...]
    doppler: Float64[Tensor, " path"]
    slopes: Complex128[Tensor, "path 2 2 2"] | None = None
    axes: Float64[Tensor, "path 2 3"] | None = None
    missed_fraction: float | None = None

    def __len__(self) -> int:
        return self.delay.shape[0]

    @property
    def length(self) -> Float64[Tensor, " path"]:
        """Path lengths [m]."""
        return SPEED_OF_LIGHT * self.delay

    @property
    def interaction_count(self) -> Int64[Tensor, " path"]:
        """Number of interactions of each path; 0 = line of sight."""
        return (self.kinds > 0).sum(1)

    @property
    def link(self) -> Int64[Tensor, " path"]:
        """Number of the antenna pair; receivers vary fastest."""
        return self.tx * self.counts[1] + self.rx

    def select_link(self, tx: int, rx: int) -> "RayPaths":
        """Select the paths of one link.

        Args:
            tx: number of the transmitter.
            rx: number of the receiver.
        """
        return self.select((self.tx == tx) & (self.rx == rx))

    def sort_rows(self) -> "RayPaths":
        """Sort the paths by transmitter, receiver and delay."""
        by_delay = self.delay.detach().argsort(stable=True)
        return self.select(by_delay[self.link[by_delay].argsort(stable=True)])

    def pad_links(self) -> tuple[Int64[Tensor, "tx rx place"], Bool[Tensor, "tx rx place"]]:
        """Row numbers by link, padded with zeros, and the mask of actual paths.

        ``paths.delay[row]`` is then a table of delays; multiply by the mask to clear the padding.
        """
        count = torch.bincount(self.link, minlength=self.counts[0] * self.counts[1])
        width = int(count.max()) if len(count) else 0
        filled = torch.arange(width, device=count.device) < count[:, None]
        row = torch.zeros_like(filled, dtype=torch.int64)
        row[filled] = self.link.argsort(stable=True)
        return row.unflatten(0, self.counts), filled.unflatten(0, self.counts)

    def reverse(self) -> "RayPaths":
        """Return the reciprocal paths, with transmitters and receivers exchanged."""
        depth = self.interaction_count[:, None]
        width = torch.arange(self.kinds.shape[1], device=depth.device)
        back = torch.where(width < depth, depth - 1 - width, width)
        rows = torch.arange(len(self), device=depth.device)[:, None]
        names = ("vertices", "kinds", "faces", "objects")
        reversed_columns = {name: getattr(self, name)[rows, back] for name in names}
        if self.slopes is not None and self.axes is not None:
            reversed_columns |= {"slopes": self.slopes.mT.flip(1), "axes": self.axes.flip(1)}
        reversed_columns |= {"tx": self.rx, "rx": self.tx, "coefficient": self.coefficient.mT}
        reversed_columns |= {"departure": self.arrival, "arrival": self.departure}
        return replace(self, counts=self.counts[::-1], **reversed_columns).sort_rows()

    def __add__(self, other: "RayPaths") -> "RayPaths":
        return join_ray_paths([self, other])


def join_ray_paths(parts: Sequence[RayPaths]) -> RayPaths:
    """Concatenate paths of the same antennas and scene, sorted as ``RayPaths``.

    Args:
        parts: at least one table; numbers of vertices may differ.
    """
    if any(part.slopes is not None for part in parts):
        parts = [_add_slopes(part) for part in parts]
    width = max((part.kinds.shape[1] for part in parts if len(part)), default=0)
    fill = {"vertices": 0.0, "kinds": 0, "faces": -1, "objects": -1}
    padded = {
        name: torch.cat([_pad_columns(getattr(part, name), width, value) for part in parts])
        for name, value in fill.items()
    }
    return concatenate_rows(parts, **padded).sort_rows()


def _add_slopes(paths: RayPaths) -> RayPaths:
    """Return paths with slopes, zero where there are none."""
    if paths.slopes is not None:
        return paths
    slopes = paths.coefficient.new_zeros(len(paths), 2, 2, 2)
    return replace(paths, slopes=slopes, axes=paths.delay.new_zeros(len(paths), 2, 3))


def _pad_columns(value: Tensor, width: int, fill: float) -> Tensor:
    more = (0, 0) * (value.ndim - 2) + (0, width - value.shape[1])
    return torch.nn.functional.pad(value, more, value=fill)


def match_rows(
    first: Int64[Tensor, " n"], second: Int64[Tensor, " m"], count: int
) -> tuple[Int64[Tensor, " pair"], Int64[Tensor, " pair"]]:
    """Row pairs with equal numbers, in the order of the first table (inner join).

    Args:
        first, second: numbers below ``count``.
        count: upper bound of the numbers.
    """
    order = second.argsort(stable=True)
    many = torch.bincount(second, minlength=count)
    begin = many.cumsum(0) - many
    times = many[first]
    row = torch.arange(len(first), device=times.device).repeat_interleave(times)
    number = torch.arange(len(row), device=times.device)
    return row, order[begin[first[row]] + (number - (times.cumsum(0) - times)[row])]
