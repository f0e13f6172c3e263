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
_Elements = Float64[Tensor, " element"]  # coordinates [m]


@dataclass(frozen=True, eq=False)
class Aperture:
    """Virtual array on the grid of its distinct y and z positions.

    Attributes:
        y: distinct y positions [m].
        z: distinct z positions [m].
        column: index into ``y`` of each virtual element, TX-major.
        row: index into ``z`` of each virtual element.
        y_taper: Window along y.
        z_taper: Window along z.
        counts: number of virtual elements at each position of the grid.
        wavelength: wavelength [m].
    """

    y: Float64[Tensor, " y"]
    z: Float64[Tensor, " z"]
    column: Int64[Tensor, " virtual"]
    row: Int64[Tensor, " virtual"]
    y_taper: Float64[Tensor, " y"]
    z_taper: Float64[Tensor, " z"]
    counts: Float64[Tensor, "y z"]
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
        for name, places, bins in (("u", self.y, grid.u_count), ("v", self.z, grid.v_count)):
            if len(places) > 1 and bins == 1:
                raise InputError(
                    f"expected a grid that resolves {name}, got 1 bin; the array extends along "
                    "that axis, so give the grid its directions"
                )

    @property
    def weight(self) -> Float64[Tensor, " virtual"]:
        """Taper of the virtual elements, with a sum of 1."""
        weight = self.y_taper[self.column] * self.z_taper[self.row]
        return weight / weight.sum()

    def plane(self, channels: Complex[Tensor, "*batch virtual"]) -> Complex[Tensor, "*batch y z"]:
        """Return channels on the grid of positions; co-located ones are averaged, empty positions
        are 0.
        """
        index = (self.column * len(self.z) + self.row).to(channels.device)
        plane = channels.new_zeros(*channels.shape[:-1], self.counts.numel())
        plane = plane.index_add(-1, index, channels).unflatten(-1, self.counts.shape)
        return plane / self.counts.clamp_min(1).to(plane.device, plane.real.dtype)

    def steering(
        self, cosines: Float64[Tensor, " node"], positions: Float64[Tensor, " place"]
    ) -> Complex[Tensor, "node place"]:
        """Return phasors exp(+jk u y) that compensate the beat phase of an element at y for a
        source at u.

        Args:
            cosines: direction cosines u.
            positions: positions y of the elements [m].
        """
        phase = 2 * math.pi / self.wavelength * cosines[:, None] * positions.to(cosines.device)
        return torch.polar(torch.ones_like(phase), phase)

    def beams(
        self, u: Float64[Tensor, " u"], v: Float64[Tensor, " v"], y: _Elements, z: _Elements
    ) -> Complex[Tensor, "direction element"]:
        """Return ``steering`` of planar elements towards all pairs of direction cosines, u slowest.

        Args:
            u: direction cosines along y.
            v: direction cosines along z.
            y: positions of the elements along y [m].
            z: positions of the elements along z [m].
        """
        return (self.steering(u, y)[:, None] * self.steering(v, z)).flatten(0, 1)


def aperture(radar: Radar) -> Aperture:
    """Return the radar's virtual array on its distinct positions.

    Raises:
        InputError: The array is not planar in the radar's y-z plane, so that u and v do not
            determine its response.
    """
    key = tuple(tuple(place) for place in radar.virtual_positions.cpu().tolist())
    return _aperture(key, radar.waveform.wavelength, radar.array_window)


@lru_cache(maxsize=8)
def _aperture(key: tuple[tuple[float, ...], ...], wavelength: float, window: str) -> Aperture:
    places = torch.tensor(key, dtype=torch.float64)
    depth = float(places[:, 0].max() - places[:, 0].min()) / wavelength
    if depth > _FLATNESS:
        raise InputError(
            f"expected a virtual array in the radar's y-z plane, got one {depth:.2g} wavelengths "
            "deep along x; turn the radar's rotation instead of its elements"
        )
    y, column = _distinct_positions(places[:, 1], wavelength)
    z, row = _distinct_positions(places[:, 2], wavelength)
    counts = torch.zeros(len(y), len(z), dtype=torch.float64)
    counts.index_put_((column, row), torch.ones(len(places), dtype=torch.float64), accumulate=True)
    tapers = _position_taper(window, y), _position_taper(window, z)
    return Aperture(y, z, column, row, *tapers, counts, wavelength)


# Depth of an array along boresight, in wavelengths, that (u, v) steering may neglect.


def _distinct_positions(positions: Tensor, wavelength: float) -> tuple[Tensor, Tensor]:
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
