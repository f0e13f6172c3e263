"""Speckle realisations: recordings of one scene with other phases of its rough surfaces."""

import math

import torch
from jaxtyping import Complex64, Float, Float64
from torch import Tensor

from invertwin.channel import Paths
from invertwin.radar.aperture import aperture
from invertwin.radar.radar import Radar, require_sampled_waveform

# Per resolution cell and axis: less than a tenth of a percent of the power is lost.
_CELLS_PER_RESOLUTION = 4
_POINT_TOLERANCE = 1e-7  # points closer than this are one [m]


class SpeckleRealisations:
    """Fast simulation of speckle realisations of a scene: a few matrix products each.

    Every point of a rough surface has a random circular Gaussian amplitude, equal in all frames, so
    that frames of close poses have correlated speckle. Points are grouped in cells of range and
    direction, a quarter of the radar's own, with their exact phases.

    Args:
        paths: field paths of rough surfaces, from ``trace_field``.
        radar: radar that records them. Its range bias is added, ranges count from its origin.
    """

    def __init__(self, paths: Paths, radar: Radar) -> None:
        waveform, array, link = require_sampled_waveform(radar), aperture(radar), radar.link()
        self._shape, self._array = radar.shape, array
        places = torch.cat([paths.first, paths.last], dim=1)
        # Independent weights tell points apart; another order would draw other amplitudes.
        mixed = places @ torch.sqrt(torch.tensor([5.0, 2, 3, 13, 7, 11], dtype=torch.float64))
        points, self._point = torch.unique((mixed / _POINT_TOLERANCE).round(), return_inverse=True)
        self._count = len(points)
        u, v = paths.direction_cosines(link).unbind(1)
        bias = torch.as_tensor(radar.range_bias).detach()
        ranges = paths.range - radar.origins[paths.frame] + bias
        steps = (waveform.range_resolution, *radar.beamwidth)
        (ranges, rows), (u, columns), (v, layers) = [
            _bin_axis(x, step / _CELLS_PER_RESOLUTION)
            for x, step in zip((ranges, u, v), steps, strict=True)
        ]
        self._cells = len(ranges), len(u), len(v)
        self._cell = (rows * len(u) + columns) * len(v) + layers
        delay = paths.delay - radar.origin_delays[paths.frame]
        turn = 2 * math.pi * waveform.center_frequency * delay - paths.coefficient.angle()
        self._field = torch.polar(paths.coefficient.abs(), turn).to(torch.complex64)
        order = torch.argsort(paths.frame, stable=True)
        counts = torch.bincount(paths.frame, minlength=self._shape[0]).tolist()
        self._frames = torch.split(order, counts)
        cycles = torch.arange(waveform.samples) - 0.5 * (waveform.samples - 1)
        phase = 2 * math.pi * cycles[:, None] * (ranges / waveform.max_range)
        self._ramp = torch.polar(torch.ones_like(phase), phase).to(torch.complex64)
        self._across = array.steering(u, array.y).conj().to(torch.complex64)
        self._up = array.steering(v, array.z).conj().to(torch.complex64)

    def beat(self, seed: int) -> Complex64[Tensor, "frame tx rx sample"]:
        """Return the beat signals of one realisation, without noise.

        Args:
            seed: seed of the realisation.
        """
        generator = torch.Generator().manual_seed(seed)
        drawn = torch.randn(self._count, dtype=torch.complex64, generator=generator)
        frames = []
        for rows in self._frames:
            cells = torch.zeros(math.prod(self._cells), dtype=torch.complex64)
            cells.index_add_(0, self._cell[rows], self._field[rows] * drawn[self._point[rows]])
            plane = torch.einsum("ruz,uy->yzr", cells.view(self._cells) @ self._up, self._across)
            frames.append(plane[self._array.column, self._array.row] @ self._ramp.T)
        return torch.stack(frames).unflatten(1, self._shape[1:])


def _bin_axis(values: Float64[Tensor, " n"], step: float) -> tuple[Float[Tensor, " cell"], Tensor]:
    """Return the centres of occupied cells, and the cell index of each value."""
    number = (values / step).round().long()
    least = number.min() if len(values) else number.new_zeros(())
    count = int(number.max() - least) + 1 if len(values) else 1
    return step * (least + torch.arange(count, dtype=torch.float64)), number - least
