"""Complex range profiles between their samples."""

import math

import torch
from jaxtyping import Complex, Complex128, Float64
from torch import Tensor

from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.radar.processing.backprojection import UPSAMPLING, interpolate_samples


class RangeInterpolator:
    """A profile as a function of range, band-limited between its samples.

    The profile is an analytic signal at radio frequency: an echo from R turns by
    ``4π f/c · (r − R)`` along range r. It is moved to frequency zero, upsampled through its
    Fourier transform, interpolated linearly, and moved back.

    Args:
        profile: complex amplitude at ``ranges``.
        ranges: uniform, ascending [m].
        center_frequency: centre frequency of the radar [Hz].
    """

    def __init__(
        self,
        profile: Complex[Tensor, "frame range"],
        ranges: Float64[Tensor, " range"],
        center_frequency: float,
    ) -> None:
        count = len(ranges)
        step = float(ranges[-1] - ranges[0]) / (count - 1)
        # The nearest frequency of the transform, so that moving the band is a plain shift of it.
        shift = round(2 * center_frequency / SPEED_OF_LIGHT * count * step)
        self._wavenumber = 2 * math.pi * shift / (count * step)
        self._first = float(ranges[0])
        self._last = float(ranges[-1])
        self._step = step / UPSAMPLING
        band = torch.fft.fft(profile.to(torch.complex128), dim=1).roll(-shift, dims=1)
        padded = band.new_zeros(len(profile), count * UPSAMPLING)
        half = (count + 1) // 2
        padded[:, :half] = band[:, :half]
        padded[:, half - count :] = band[:, half:]
        self._samples = torch.fft.ifft(padded, dim=1) * UPSAMPLING

    def __call__(self, ranges: Float64[Tensor, "frame point"]) -> Complex128[Tensor, "frame point"]:
        """Amplitude of every frame at its own ranges [m]; not differentiable.

        Raises:
            InputError: a range before the first or after the last sample.
        """
        low, high = float(ranges.min()), float(ranges.max())
        if low < self._first - 1e-9 or high > self._last + 1e-9:
            raise InputError(
                f"expected ranges within the profile, {self._first:g} to {self._last:g} m, got "
                f"{low:g} to {high:g} m; choose a smaller grid or nearer points"
            )
        offset = ranges - self._first
        value = interpolate_samples(self._samples, offset / self._step)
        return value * torch.polar(torch.ones_like(offset), self._wavenumber * offset)
