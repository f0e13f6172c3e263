"""Power of echoes that nobody has modelled exactly: its likelihood, and how many bins count."""

import math
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
"""Of the heavy-tailed speckle."""
_MIN_POWER = 1e-30  # of power, to keep logarithms finite
_BACKGROUND_QUANTILE = 0.25  # quantile of a range bin that is taken for background


def estimate_background(power: Float[Tensor, "frame range u v"]) -> Float64[Tensor, " range"]:
    """The level of noise and of clutter that nothing explains, of every range bin.

    The lower quartile of exponentially distributed power is 0.288 of its mean. Objects that fill
    less than three quarters of a range bin's directions, over all frames, do not raise it much.

    Args:
        power: Measured maps.
    """
    flat = power.detach().double().movedim(1, 0).flatten(1)
    level = torch.quantile(flat, _BACKGROUND_QUANTILE, dim=1) / -math.log(1 - _BACKGROUND_QUANTILE)
    floor = 1e-12 * float(power.max())
    return level.clamp_min(floor)


def count_bins_per_draw(radar: Radar, grid: Grid) -> float:
    """How many bins of a map are worth one that is independent of all others.

    Fields of noise in bins that are l apart correlate as the windows do; powers correlate as the
    square. The sum over all lags is the number of bins that share one draw.

    Args:
        radar: Its windows count.
        grid: Bins.
    """
    total = 1.0
    for axis in map_axes(radar, grid):
        if axis.count > 1:
            lags = torch.arange(-axis.count + 1, axis.count, dtype=torch.float64)
            # Of all pairs of bins of the axis, this share is so far apart.
            share = 1 - lags.abs() / axis.count
            # Noise is as strong in all samples, so that its field has the squares for weights.
            power = replace(axis, weight=axis.weight.square()).response(lags)
            total *= float((share * power).sum())
    return total


@dataclass(frozen=True, eq=False)
class MapAxis:
    """One axis of a map: what is summed to make its bins.

    Attributes:
        weight: The window over samples, or over virtual elements.
        cycles: Turns of each per metre of range, or per unit of a direction cosine.
        start, step, count: Of its bins.
    """

    weight: Float64[Tensor, " sample"]
    cycles: Float64[Tensor, " sample"]
    start: float
    step: float
    count: int

    def response(self, lags: Float64[Tensor, " lag"]) -> Float64[Tensor, " lag"]:
        """Power of a point of power one, some bins away from its place.

        Args:
            lags: In bins.
        """
        phase = 2 * math.pi * lags[:, None] * self.step * self.cycles
        field = torch.polar(self.weight.expand(len(lags), -1), phase).sum(1) / self.weight.sum()
        return field.abs().square()


def map_axes(radar: Radar, grid: Grid) -> list[MapAxis]:
    """The axes of a map: range, u and v.

    Args:
        radar: Its windows and its array count.
        grid: Bins.

    Raises:
        InputError: A radar that does not sample its echoes.
    """
    waveform, array = require_sampled_waveform(radar), aperture(radar)
    window = unit_window(radar.window, waveform.samples)
    sample = torch.arange(waveform.samples, dtype=torch.float64) / waveform.max_range
    x, y = array.x[array.column] / waveform.wavelength, array.y[array.row] / waveform.wavelength
    return [
        MapAxis(window, sample, grid.range_start, grid.range_step, grid.range_count),
        MapAxis(array.weight, x, grid.u_start, grid.u_step, grid.u_count),
        MapAxis(array.weight, y, grid.v_start, grid.v_step, grid.v_count),
    ]


@dataclass(frozen=True, eq=False)
class HeavyTailedLoss:
    """How unlikely maps are, where single bins may be much brighter or dimmer than predicted.

    The ``speckle_divergence`` of echoes whose mean is itself uncertain, with a background of its
    own for every range bin.

    Attributes:
        level: Background of every range bin, added to predicted maps.
        degrees: Those of the mean.
    """

    level: Float64[Tensor, " range"]
    degrees: float = TAIL_DEGREES

    def __call__(
        self,
        predicted: Float[Tensor, "frame range u v"],
        observed: Float[Tensor, "frame range u v"],
    ) -> Float[Tensor, ""]:
        """The mean of ``rows`` over all bins."""
        return self.bin_losses(predicted, observed).mean()

    def bin_losses(
        self,
        predicted: Float[Tensor, "frame range u v"],
        observed: Float[Tensor, "frame range u v"],
    ) -> Float[Tensor, "frame range u v"]:
        """How much less likely the power of every bin is than if it were its predicted mean.

        Args:
            predicted: Power without background.
            observed: Measured power.
        """
        # Power that is predicted is positive but for rounding.
        mean = predicted.clamp_min(0.0) + self.level.to(predicted)[:, None, None]
        return speckle_divergence(observed.to(predicted).clamp_min(_MIN_POWER) / mean, self.degrees)
