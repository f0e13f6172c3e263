"""Waveforms and their range response."""

# Fields of the base class may be properties of a waveform.
# pyright: reportIncompatibleVariableOverride=false

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Complex, Float, Float64
from torch import Tensor

from invertwin import limits
from invertwin.checks import CheckedFields, check_choice
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.errors import PhysicsWarning as PhysicsWarning

WINDOWS = ("hamming", "hann", "blackman", "rectangular")

SIGMA_PER_FWHM = 1 / math.sqrt(8 * math.log(2))
_Samples = Complex[Tensor, "*batch sample"]  # beat or symbols
_Symbols = Complex[Tensor, "*#batch sample"]
_Values = Float64[Tensor, " point"]  # one at every point


class Waveform(CheckedFields, ABC):
    """Base class of waveforms. Waveforms are hashable, so that kernels are cached.

    Attributes:
        center_frequency, bandwidth: centre frequency and bandwidth [Hz].

    Raises:
        InputError: A value that is not positive, or of an implausible unit.
    """

    center_frequency: float
    bandwidth: float

    @property
    def wavelength(self) -> float:
        """Wavelength at the centre frequency [m]."""
        return SPEED_OF_LIGHT / self.center_frequency

    @property
    def range_resolution(self) -> float:
        """Range resolution, c/2B [m]."""
        return SPEED_OF_LIGHT / (2 * self.bandwidth)

    @abstractmethod
    def range_response(self, distance: _Values, window: str) -> _Values:
        """Return the power of a point target at a distance from its range, peak 1.

        Args:
            distance: distance from the target's range [m].
            window: taper of the samples.
        """


class SampledWaveform(Waveform):
    """One complex sample per frequency ``f_n = start_frequency + n · step``.

    A path of delay τ gives the sample n the phase ``2π (f_n τ − residual_slope τ²/2)``; the
    range transform, its windows and the surrogate's response follow from that alone.

    Attributes:
        start_frequency: Frequency of the first sample [Hz].
        samples: Number of frequencies.
        step: Frequency step from one sample to the next [Hz].
        noise_bandwidth: bandwidth B of the thermal noise in a sample, of power kT₀F · B over the
            transmit power [Hz].
    """

    start_frequency: float
    samples: int
    step: float
    noise_bandwidth: float

    @property
    def residual_slope(self) -> float:
        """Slope of the residual video phase [Hz/s]; 0 for constant-frequency samples."""
        return 0.0

    @property
    def frequencies(self) -> Float64[Tensor, " sample"]:
        """Frequencies f_n of the samples [Hz]."""
        return self.start_frequency + torch.arange(self.samples, dtype=torch.float64) * self.step

    @property
    def max_range(self) -> float:
        """Unambiguous range of complex samples, N c/2B = c/(2 step) [m]."""
        return self.samples * self.range_resolution

    def range_response(self, distance: _Values, window: str) -> _Values:
        """Return |Σ w_n exp(2πj n d/R_max) / Σ w_n|², the power of a point target at range offset
        d.

        Args:
            distance: distance d from the target's range [m].
            window: taper w of the samples.
        """
        weight = unit_window(window, self.samples).to(distance.device, torch.complex128)
        cycles = distance[:, None] / self.max_range * torch.arange(self.samples).to(distance)
        return (torch.exp(2j * math.pi * cycles) @ weight).abs().square()


@dataclass(frozen=True)
class FMCW(SampledWaveform):
    """Linear frequency ramp; samples at ``t_n = n · duration / samples``.

    The beat signal is complex (I/Q), so the unambiguous range is ``samples`` range cells.

    Attributes:
        start_frequency: Frequency at t = 0 [Hz].
        bandwidth: bandwidth swept during ``duration`` [Hz].
        duration: sampled part of the ramp [s].
        samples: Samples per ramp.
    """

    start_frequency: limits.Frequency
    bandwidth: limits.Bandwidth
    duration: limits.Duration
    samples: limits.CountOfTwo

    @property
    def center_frequency(self) -> float:
        """Middle of the sweep [Hz]."""
        return self.start_frequency + 0.5 * self.bandwidth

    @property
    def slope(self) -> float:
        """Slope of the ramp, S = B/T [Hz/s]."""
        return self.bandwidth / self.duration

    @property
    def residual_slope(self) -> float:
        """Slope S of the ramp, which continues during the echo delay [Hz/s]."""
        return self.slope

    @property
    def step(self) -> float:
        """Frequency step of the samples, B/N [Hz]."""
        return self.bandwidth / self.samples

    @property
    def noise_bandwidth(self) -> float:
        """Sampling rate N/T [Hz]."""
        return self.samples / self.duration

    @property
    def sample_times(self) -> Float64[Tensor, " sample"]:
        """Times of the samples, t_n = n T/N [s]."""
        return torch.arange(self.samples, dtype=torch.float64) * (self.duration / self.samples)


class _Tones(SampledWaveform):
    """Tones at equal frequency steps; the band ends half a step beyond the outer ones."""

    @property
    def bandwidth(self) -> float:
        """Bandwidth, N · step [Hz]."""
        return self.samples * self.step

    @property
    def center_frequency(self) -> float:
        """Mean of the tones [Hz]."""
        return self.start_frequency + 0.5 * (self.samples - 1) * self.step


@dataclass(frozen=True)
class SteppedFrequency(_Tones):
    """Consecutive tones, each measured after its echoes have settled.

    Attributes:
        start_frequency: Frequency of the first tone [Hz].
        step: Frequency step from one tone to the next [Hz].
        samples: Number of tones.
        dwell: duration of each tone, over which its sample is averaged [s].
    """

    start_frequency: limits.SweptFrequency
    step: limits.FrequencyStep
    samples: limits.CountOfTwo
    dwell: limits.Duration

    @property
    def noise_bandwidth(self) -> float:
        """Noise bandwidth, 1 / dwell [Hz]."""
        return 1 / self.dwell

    @property
    def sample_times(self) -> Float64[Tensor, " sample"]:
        """Times of the samples, t_n = n · dwell [s]."""
        return torch.arange(self.samples, dtype=torch.float64) * self.dwell


@dataclass(frozen=True)
class OFDM(_Tones):
    """Simultaneous subcarriers; known symbols are divided out, one sample per subcarrier.

    On every subcarrier ``Y = H X``, since the cyclic prefix is assumed longer than the largest
    delay. All subcarriers have the same mean power, ``|X|² = 1``. In the library's sign the beat
    signal is ``conj(H)``, so that ``range_profile`` forms the usual inverse FFT of ``Y/X``.

    Attributes:
        start_frequency: Frequency of the lowest subcarrier [Hz].
        spacing: Frequency step between neighbouring subcarriers [Hz].
        subcarriers: Number of subcarriers.
    """

    start_frequency: limits.Frequency
    spacing: limits.FrequencyStep
    subcarriers: limits.CountOfTwo

    @property
    def samples(self) -> int:
        """Number of samples, one per subcarrier."""
        return self.subcarriers

    @property
    def step(self) -> float:
        """Frequency step of the samples: the spacing [Hz]."""
        return self.spacing

    @property
    def noise_bandwidth(self) -> float:
        """N · spacing [Hz]: a subcarrier has 1/N of the noise, and 1/N of the transmit power."""
        return self.bandwidth

    def receive_symbols(self, beat: _Samples, symbols: _Symbols) -> _Samples:
        """Return Y = H X, the receiver's FFT output for these symbols.

        Args:
            beat: signals from ``beat_signal``.
            symbols: transmitted symbols X of each subcarrier.

        Raises:
            InputError: Another number of symbols than subcarriers.
        """
        return beat.conj() * self._check_symbols(symbols)

    def beat(self, received_symbols: _Samples, symbols: _Symbols) -> _Samples:
        """Return conj(Y / X), the samples of ``range_profile``.

        Args:
            received_symbols: receiver's FFT output Y.
            symbols: transmitted symbols X of each subcarrier.

        Raises:
            InputError: Another number of symbols than subcarriers, or one that is zero.
        """
        silent = int((self._check_symbols(symbols) == 0).sum())
        if silent:
            raise InputError(
                f"expected symbols other than zero, got {silent} zeros of {symbols.numel()}; "
                "nothing can be measured on silent subcarriers: keep to those in use"
            )
        return (received_symbols / symbols).conj()

    def _check_symbols(self, symbols: Tensor) -> Tensor:
        if symbols.shape[-1] != self.subcarriers:
            raise InputError(
                f"expected {self.subcarriers} symbols, got {symbols.shape[-1]}; "
                "give one per subcarrier"
            )
        return symbols


@dataclass(frozen=True)
class Impulse(Waveform):
    """Pulsed radar with a directly measured range profile.

    The power of its pulse is a Gaussian whose full width at half maximum is one range cell c/2B. It
    has no beat signal, so only the surrogate can model it.

    Attributes:
        center_frequency, bandwidth: centre frequency and bandwidth [Hz].
    """

    center_frequency: limits.Frequency
    bandwidth: limits.Bandwidth

    def range_response(self, distance: _Values, window: str) -> _Values:
        """Return the power of the pulse beside the target's range, peak 1.

        Args:
            distance: distance from the target's range [m].
            window: ignored, since a pulse has no samples to taper.
        """
        return gaussian_response(self, distance)


def taper(name: str, position: Float[Tensor, " element"], count: int) -> Float[Tensor, " element"]:
    """Return the weights of a window by position, for samples and for arrays.

    At ``count`` uniform positions "hamming" is the usual symmetric window; "hann" and "blackman"
    omit their zero end points, which would disable the outermost elements.

    Args:
        name: one of ``WINDOWS``.
        position: 0 at the first and 1 at the last position.
        count: number of distinct positions.

    Raises:
        InputError: An unknown window.
    """
    check_choice(name, WINDOWS, "a window of", "choose one of them")
    if name == "rectangular" or count < 2:
        return torch.ones_like(position)
    if name == "hamming":
        return 0.54 - 0.46 * torch.cos(2 * math.pi * position)
    angle = 2 * math.pi * (position * (count - 1) + 1) / (count + 1)
    if name == "hann":
        return 0.5 - 0.5 * torch.cos(angle)
    return 0.42 - 0.5 * torch.cos(angle) + 0.08 * torch.cos(2 * angle)


def unit_window(name: str, count: int) -> Float64[Tensor, " sample"]:
    """Return the taper of equally spaced samples or chirps, with a sum of 1.

    Args:
        name: one of ``WINDOWS``.
        count: number of samples or chirps.

    Raises:
        InputError: An unknown window.
    """
    weight = taper(name, torch.linspace(0, 1, count, dtype=torch.float64), count)
    return weight / weight.sum()


def gaussian_response(waveform: Waveform, distance: _Values) -> _Values:
    """Return a Gaussian whose full width at half maximum is one range cell, peak 1.

    Args:
        waveform: waveform with the range cell.
        distance: distance from the peak [m].
    """
    return torch.exp(-0.5 * (distance / (SIGMA_PER_FWHM * waveform.range_resolution)).square())
