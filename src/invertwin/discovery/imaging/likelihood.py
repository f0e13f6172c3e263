"""Likelihood of echo power under an approximate model, and the effective number of bins."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from invertwin.channel import Grid
from invertwin.inversion import speckle_divergence
from invertwin.radar import Radar
from invertwin.radar.aperture import aperture
from invertwin.radar.radar import require_sampled_waveform
from invertwin.radar.waveform import unit_window

TAIL_DEGREES = 4.0
"""Degrees of freedom of the heavy-tailed speckle."""
_MIN_POWER = 1e-30  # lower limit of power in logarithms
_BACKGROUND_QUANTILE = 0.25  # quantile of a range bin that estimates the background
_BACKGROUND_DRAWS = 32  # least number of independent draws of a quartile
_Maps = Float[Tensor, "frame range u v"]  # power of every frame


def estimate_background(
    power: _Maps, directions_per_draw: float = 0.0
) -> Float64[Tensor, " range"]:
    """Estimate the level of noise and unmodelled clutter of every range bin.

    The lower quartile of exponentially distributed power is 0.288 of its mean. Objects that fill
    less than three quarters of a range bin's directions, over all frames, hardly raise it. The beam
    of a few receivers fills more; the quartile then is over the ranges around, too, so that it is
    of 32 independent draws at least.

    Args:
        power: measured maps [frame, range, u, v].
        directions_per_draw: number of correlated directions per independent draw; 0 = each range
            alone.
    """
    flat = power.detach().double().movedim(1, 0).flatten(1)
    count = min(math.ceil(_BACKGROUND_DRAWS * directions_per_draw / flat.shape[1]), len(flat))
    if count > 1:
        first = (torch.arange(len(flat)) - count // 2).clamp(0, len(flat) - count)
        flat = flat[first[:, None] + torch.arange(count)].flatten(1)
    level = torch.quantile(flat, _BACKGROUND_QUANTILE, dim=1) / -math.log(1 - _BACKGROUND_QUANTILE)
    return level.clamp_min(1e-12 * float(power.max()))


def count_bins_per_draw(axes: Sequence["MapAxis"]) -> float:
    """Compute the number of correlated bins per independent draw of a map.

    Noise fields in bins of lag l are correlated by the windows; powers by the square. The sum over
    all lags is the number of bins that share one draw.

    Args:
        axes: axes of the map.
    """
    total = 1.0
    for axis in axes:
        if axis.count > 1:
            lags = torch.arange(-axis.count + 1, axis.count, dtype=torch.float64)
            # Fraction of the pairs of bins of the axis with this lag.
            share = 1 - lags.abs() / axis.count
            # Noise has equal power in all samples, so that its weights are squared.
            power = replace(axis, weight=axis.weight.square()).response(lags)
            total *= float((share * power).sum())
    return total


@dataclass(frozen=True, eq=False)
class MapAxis:
    """One axis of a map: the sum that forms its bins.

    Attributes:
        weight: window over samples, or over virtual elements.
        cycles: cycles of each sample per metre of range, or per unit of a direction cosine.
        start, step, count: bins of the axis.
    """

    weight: Float64[Tensor, " sample"]
    cycles: Float64[Tensor, " sample"]
    start: float
    step: float
    count: int

    def response(self, lags: Float64[Tensor, " lag"]) -> Float64[Tensor, " lag"]:
        """Return the power of a unit point target at given lags.

        Args:
            lags: lags from its position, in bins.
        """
        phase = 2 * math.pi * lags[:, None] * self.step * self.cycles
        field = torch.polar(self.weight.expand(len(lags), -1), phase).sum(1) / self.weight.sum()
        return field.abs().square()


def map_axes(radar: Radar, grid: Grid) -> list[MapAxis]:
    """Return the axes of a map: range, u and v.

    Args:
        radar: radar with its windows and its array.
        grid: bins of the map.

    Raises:
        InputError: A radar that does not sample its echoes.
    """
    waveform = require_sampled_waveform(radar)
    window = unit_window(radar.window, waveform.samples)
    sample = torch.arange(waveform.samples, dtype=torch.float64) / waveform.max_range
    along = MapAxis(window, sample, grid.range_start, grid.range_step, grid.range_count)
    return [along, *direction_axes(radar, grid)]


def direction_axes(radar: Radar, grid: Grid) -> list[MapAxis]:
    """Return the axes of the directions of a map: u and v.

    Args:
        radar: radar with its array and its window.
        grid: bins of the map.
    """
    array, wavelength = aperture(radar), radar.waveform.wavelength
    y, z = array.y[array.column] / wavelength, array.z[array.row] / wavelength
    return [
        MapAxis(array.weight, y, grid.u_start, grid.u_step, grid.u_count),
        MapAxis(array.weight, z, grid.v_start, grid.v_step, grid.v_count),
    ]


def find_grating_lobes(radar: Radar, grid: Grid) -> list[float]:
    """Find the offsets of u at which the array responds as to the true direction, within 3 dB.

    Args:
        radar: radar with its array and its window.
        grid: bins of the map.
    """
    axis = direction_axes(radar, grid)[0]
    lags = torch.arange(-2.0, 2.0, 1e-3, dtype=torch.float64)
    power = axis.response(lags / axis.step)
    top = (power[1:-1] > power[:-2]) & (power[1:-1] >= power[2:]) & (power[1:-1] > 0.5)
    found = lags[1:-1][top]
    return found[found.abs() > 2e-3].tolist()


@dataclass(frozen=True, eq=False)
class HeavyTailedLoss:
    """Negative log-likelihood of maps with heavy-tailed speckle.

    The ``speckle_divergence`` of echoes with an uncertain mean, with a separate background in every
    range bin.

    Attributes:
        level: background of every range bin, added to predicted maps.
        degrees: degrees of freedom of the mean.
    """

    level: Float64[Tensor, " range"]
    degrees: float = TAIL_DEGREES

    def __call__(self, predicted: _Maps, observed: _Maps) -> Float[Tensor, ""]:
        """Return the mean of ``bin_losses`` over all bins."""
        return self.bin_losses(predicted, observed).mean()

    def bin_losses(self, predicted: _Maps, observed: _Maps) -> _Maps:
        """Compute the divergence of every bin from its predicted mean.

        Args:
            predicted: predicted power without background.
            observed: measured power.
        """
        # Predicted power is positive up to rounding.
        mean = predicted.clamp_min(0.0) + self.level.to(predicted)[:, None, None]
        return speckle_divergence(observed.to(predicted).clamp_min(_MIN_POWER) / mean, self.degrees)
