"""Virtual array of a radar on the distinct positions along its axes."""

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Complex, Float64, Int64
from torch import Tensor

from invertwin.channel import Grid
from invertwin.errors import InputError
from invertwin.radar.radar import Radar
from invertwin.radar.waveform import taper

_FLATNESS = 0.05


@dataclass(frozen=True, eq=False)
class Aperture:
    """Virtual array on the grid of its distinct x and y positions.

    Attributes:
        x: distinct x positions [m].
        y: distinct y positions [m].
        column: index into ``x`` of each virtual element, TX-major.
        row: index into ``y`` of each virtual element.
        x_taper: Window along x.
        y_taper: Window along y.
        counts: number of virtual elements at each position of the grid.
        wavelength: wavelength [m].
    """

    x: Float64[Tensor, " x"]
    y: Float64[Tensor, " y"]
    column: Int64[Tensor, " virtual"]
    row: Int64[Tensor, " virtual"]
    x_taper: Float64[Tensor, " x"]
    y_taper: Float64[Tensor, " y"]
    counts: Float64[Tensor, "x y"]
    wavelength: float

    @property
    def is_separable(self) -> bool:
        """True if the array, and so its response, is the product of a row and a column."""
        counts = self.counts
        return torch.equal(counts * counts.sum(), counts.sum(1)[:, None] * counts.sum(0)[None])

    def check_resolved(self, grid: Grid) -> None:
        """Raise if the grid resolves only one axis of a non-separable array."""
        if not self.is_separable and (grid.u_count == 1 or grid.v_count == 1):
            raise InputError(
                f"expected a grid that resolves u and v, got {grid.u_count} × {grid.v_count} bins; "
                "this array is not the product of a row and a column, so resolve both axes"
            )

    def check_directions(self, grid: Grid) -> None:
        """Raise if the grid does not resolve an axis along which the array extends."""
        for name, places, bins in (("u", self.x, grid.u_count), ("v", self.y, grid.v_count)):
            if len(places) > 1 and bins == 1:
                raise InputError(
                    f"expected a grid that resolves {name}, got 1 bin; the array extends along "
                    "that axis, so give the grid its directions"
                )

    @property
    def weight(self) -> Float64[Tensor, " virtual"]:
        """Taper of the virtual elements, with a sum of 1."""
        weight = self.x_taper[self.column] * self.y_taper[self.row]
        return weight / weight.sum()

    def plane(self, channels: Complex[Tensor, "*batch virtual"]) -> Complex[Tensor, "*batch x y"]:
        """Return channels on the grid of positions; co-located ones are averaged, empty positions
        are 0.
        """
        index = (self.column * len(self.y) + self.row).to(channels.device)
        plane = channels.new_zeros(*channels.shape[:-1], self.counts.numel())
        plane = plane.index_add(-1, index, channels).unflatten(-1, self.counts.shape)
        return plane / self.counts.clamp_min(1).to(plane.device, plane.real.dtype)

    def steering(
        self, cosines: Float64[Tensor, " node"], positions: Float64[Tensor, " place"]
    ) -> Complex[Tensor, "node place"]:
        """Return phasors exp(+jk u x) that compensate the beat phase of an element at x for a
        source at u.

        Args:
            cosines: direction cosines u.
            positions: positions x of the elements [m].
        """
        phase = 2 * math.pi / self.wavelength * cosines[:, None] * positions[None]
        return torch.polar(torch.ones_like(phase), phase)

    def beams(
        self,
        u: Float64[Tensor, " u"],
        v: Float64[Tensor, " v"],
        x: Float64[Tensor, " element"],
        y: Float64[Tensor, " element"],
    ) -> Complex[Tensor, "direction element"]:
        """Return ``steering`` of planar elements towards all pairs of direction cosines, u slowest.

        Args:
            u: direction cosines along x.
            v: direction cosines along y.
            x: positions of the elements along x [m].
            y: positions of the elements along y [m].
        """
        return (self.steering(u, x)[:, None] * self.steering(v, y)).flatten(0, 1)


def aperture(radar: Radar) -> Aperture:
    """Return the radar's virtual array on its distinct positions.

    Raises:
        InputError: The array is not planar in the radar's x-y plane, so that u and v do not
            determine its response.
    """
    key = tuple(tuple(place) for place in radar.virtual_positions.cpu().tolist())
    return _aperture(key, radar.waveform.wavelength, radar.array_window)


@lru_cache(maxsize=8)
def _aperture(key: tuple[tuple[float, ...], ...], wavelength: float, window: str) -> Aperture:
    places = torch.tensor(key, dtype=torch.float64)
    depth = float(places[:, 2].max() - places[:, 2].min()) / wavelength
    if depth > _FLATNESS:
        raise InputError(
            f"expected a virtual array in the radar's x-y plane, got one {depth:.2g} wavelengths "
            "deep along z; turn the radar's rotation instead of its elements"
        )
    x, column = _distinct_positions(places[:, 0], wavelength)
    y, row = _distinct_positions(places[:, 1], wavelength)
    counts = torch.zeros(len(x), len(y), dtype=torch.float64)
    counts.index_put_((column, row), torch.ones(len(places), dtype=torch.float64), accumulate=True)
    tapers = _position_taper(window, x), _position_taper(window, y)
    return Aperture(x, y, column, row, *tapers, counts, wavelength)


# Depth of an array along boresight, in wavelengths, that (u, v) steering may neglect.


def _distinct_positions(
    positions: Float64[Tensor, " virtual"], wavelength: float
) -> tuple[Float64[Tensor, " place"], Int64[Tensor, " virtual"]]:
    """Return distinct positions to a thousandth of a wavelength, and the index of each element."""
    ordered, order = positions.sort()
    groups = torch.cat([torch.zeros(1), (ordered.diff() > 1e-3 * wavelength)]).cumsum(0).long()
    index = torch.empty_like(groups)
    index[order] = groups
    sums = torch.zeros(int(groups[-1]) + 1, dtype=torch.float64).index_add_(0, index, positions)
    return sums / torch.bincount(index), index


def _position_taper(window: str, positions: Float64[Tensor, " place"]) -> Float64[Tensor, " place"]:
    extent = positions[-1] - positions[0] if len(positions) > 1 else 1.0
    return taper(window, (positions - positions[0]) / extent, len(positions))
