"""Measured or simulated radar data with everything needed to model it.

Complex range profiles are interpolated between their samples.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import xarray as xr
from jaxtyping import Complex, Complex128, Float, Float64, Int64
from torch import Tensor

from invertwin.capture.readers.radar_fields import (
    convert_old_axes,
    radar_fields,
    radar_from_fields,
    read_dataset,
    read_tensor,
    to_data_array,
    write_dataset,
)
from invertwin.capture.track import Track
from invertwin.channel import Grid
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.limits import MAX_NUMBER
from invertwin.radar.processing.backprojection import UPSAMPLING, interpolate_samples
from invertwin.radar.processing.beamforming import exact_spectrum
from invertwin.radar.radar import Radar
from invertwin.radar.waveform import SampledWaveform
from invertwin.refusals import refusal
from invertwin.storage.untrusted import convert_read_errors

_Profiles = Complex[Tensor, "frame range"]
BeatUnit = Literal["1", "count"]


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
        self, profile: _Profiles, ranges: Float64[Tensor, " range"], center_frequency: float
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
            raise refusal("capture.profile_limits", self._first, self._last, low, high)
        offset = ranges - self._first
        value = interpolate_samples(self._samples, offset / self._step)
        return value * torch.polar(torch.ones_like(offset), self._wavenumber * offset)


BEAT_DIMS = ("frame", "tx", "rx", "sample")
PROFILE_DIMS = ("frame", "range")


@dataclass(frozen=True, eq=False)
class Capture:
    """Radar data as labelled arrays, in an `xarray.Dataset` that has been checked.

    It holds either ``beat`` (frame, tx, rx, sample), the raw samples of an FMCW radar, or
    ``range_profile`` (frame, range), analytic signals at radio frequency; beside it the radar's
    pose in every frame, its arrays and waveform. Where known, it also holds the time of each frame
    on the radar's clock, the track of the radar, and surveyed positions of targets. Every variable
    carries its unit. Axes of the radar are x forward, y left, z up; the attribute ``axes`` says so.

    Attributes:
        dataset: the labelled arrays. Not to be changed in place.

    Raises:
        InputError: missing variables or attributes, wrong dimensions or shapes, NaN, an unknown
            waveform, ranges that are not uniform.
    """

    dataset: xr.Dataset
    _radar: Radar = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_radar", _check_dataset(self.dataset))

    @classmethod
    def from_beat(
        cls,
        beat: Complex[Tensor, "frame tx rx sample"] | np.ndarray,
        radar: Radar,
        times: Float64[Tensor, " frame"] | None = None,
        *,
        unit: BeatUnit = "1",
    ) -> "Capture":
        """Make a capture of the raw samples of an FMCW radar.

        Args:
            beat: complex (I/Q) samples of every virtual channel; dtype and bits are kept.
            radar: radar that measured them.
            times: time of each frame [s].
            unit: unit of the samples: "1", received over sent, or "count", of a file.

        Raises:
            InputError: real samples, or a shape that the radar does not have.
        """
        samples = torch.from_numpy(beat) if isinstance(beat, np.ndarray) else beat
        if not isinstance(samples, Tensor) or not samples.is_complex():
            got = samples.dtype if isinstance(samples, Tensor) else type(samples).__name__
            raise refusal("capture.real_samples", got)
        return cls._assemble({"beat": to_data_array(BEAT_DIMS, samples, unit)}, radar, times)

    @classmethod
    def from_range_profile(
        cls,
        profile: _Profiles,
        ranges: Float64[Tensor, " range"],
        radar: Radar,
        times: Float64[Tensor, " frame"] | None = None,
        *,
        track: Track | None = None,
        clock_offset: float = 0.0,
        range_bias: float = 0.0,
        survey: Float64[Tensor, "target 3"] | None = None,
    ) -> "Capture":
        """Make a capture of the range profiles of one channel.

        Args:
            profile: analytic signal at radio frequency: an echo from R turns by 4π f/c (r − R).
            ranges: R = L/2 of its samples, uniform, less bias and range origin [m].
            radar: radar that measured them.
            times: time of each frame on the radar's clock [s].
            track: from which the radar's positions are read, at ``times + clock_offset``.
            clock_offset: clock of the track minus clock of the radar [s].
            range_bias: bias that was subtracted from the radar's own ranges [m].
            survey: known positions of targets [m].
        """
        variables = {"range_profile": to_data_array(PROFILE_DIMS, profile, "1")}
        variables["range"] = to_data_array(("range",), ranges, "m")
        if track is not None:
            variables["track_time"] = to_data_array(("track_time",), track.times, "s")
            dims = ("track_time", "axis")
            variables["track_position"] = to_data_array(dims, track.positions, "m")
        if survey is not None:
            variables["survey"] = to_data_array(("target", "axis"), survey, "m")
        capture = cls._assemble(variables, radar, times)
        named = {"clock_offset": clock_offset, "range_bias": range_bias}
        return cls(capture.dataset.assign_attrs(named))

    @classmethod
    def _assemble(
        cls, variables: dict[str, xr.DataArray], radar: Radar, times: Tensor | None
    ) -> "Capture":
        described, attributes = radar_fields(radar)
        variables |= described
        if times is not None:
            variables["time"] = to_data_array(("frame",), times, "s")
        _check_sizes(variables)
        return cls(xr.Dataset(variables, attrs=attributes))

    @classmethod
    def load(cls, path: str | Path, *, trusted: bool = False) -> "Capture":
        """Read a capture that `save` wrote.

        A damaged file can hang or crash the libraries that read it. So a child process tries it
        first, within limits of time and memory; that takes about a second. Files of versions whose
        axes were x left, y up, z ahead name none; they are turned to x forward, y left, z up.

        Args:
            path: file.
            trusted: read it in this process, not in a child process.

        Raises:
            InputError: no such file, a truncated file, or one that holds no capture.
        """
        with convert_read_errors(path, "a capture", "record or save it again"):
            return cls(convert_old_axes(read_dataset(Path(path), trusted=trusted)))

    def save(self, path: str | Path) -> None:
        """Write NetCDF (HDF5), bit for bit; an interrupted write leaves an old file as it was.

        Raises:
            InputError: the folder does not exist.
        """
        write_dataset(self.dataset, Path(path))

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return self.dataset.sizes["frame"]

    @property
    def beat(self) -> Complex[Tensor, "frame tx rx sample"]:
        """Raw samples.

        Raises:
            InputError: the capture holds range profiles.
        """
        return self._read_data("beat")

    @property
    def range_profile(self) -> _Profiles:
        """Complex profiles.

        Raises:
            InputError: the capture holds beat samples.
        """
        return self._read_data("range_profile")

    @property
    def ranges(self) -> Float64[Tensor, " range"]:
        """R = L/2 of the samples of the range profile [m]."""
        self._read_data("range_profile")
        return read_tensor(self.dataset, "range")

    @property
    def times(self) -> Float64[Tensor, " frame"]:
        """Time of each frame on the radar's clock [s].

        Raises:
            InputError: the capture has no times.
        """
        return read_tensor(self.dataset, "time")

    @property
    def track(self) -> Track | None:
        """The track that the positions were read from; None where it is not known."""
        if "track_time" not in self.dataset.variables:
            return None
        names = ("track_time", "track_position")
        return Track(*(read_tensor(self.dataset, name) for name in names))

    @property
    def clock_offset(self) -> float:
        """Time by which the track's clock is ahead of the radar's [s]."""
        return float(self.dataset.attrs.get("clock_offset", 0.0))

    @property
    def range_bias(self) -> float:
        """Range that has been subtracted from the radar's own ranges [m]."""
        return float(self.dataset.attrs.get("range_bias", 0.0))

    @property
    def survey(self) -> Float64[Tensor, "target 3"] | None:
        """Known positions of targets [m]."""
        return read_tensor(self.dataset, "survey") if "survey" in self.dataset.variables else None

    @property
    def max_range(self) -> float:
        """Range up to which the data mean something [m]."""
        if "range_profile" in self.dataset:
            return float(self.ranges[-1])
        return self._radar.range_limits[1]

    def radar(self) -> Radar:
        """The radar at the poses of the frames."""
        return self._radar

    def positions(self, clock_shift: Float64[Tensor, ""]) -> Float64[Tensor, "frame 3"]:
        """The radar's positions for a clock offset that is larger by ``clock_shift`` [s].

        Differentiable, so that a clock offset can be fitted.

        Raises:
            InputError: the capture has no track, or the shift leads outside it.
        """
        track = self.track
        if track is None:
            raise refusal("capture.no_track")
        return track.interpolate(self.times + (self.clock_offset + clock_shift))

    def recalibrate(self, clock_offset: float, range_bias: float) -> "Capture":
        """A capture of the same data with another clock offset and range bias.

        Args:
            clock_offset: clock of the track minus clock of the radar [s].
            range_bias: bias to subtract from the radar's own ranges [m].

        Raises:
            InputError: the capture has no track, or holds beat samples.
        """
        shift = torch.tensor(clock_offset - self.clock_offset, dtype=torch.float64)
        ranges = self.ranges + (self.range_bias - range_bias)
        position = to_data_array(("frame", "axis"), self.positions(shift), "m")
        shifted = to_data_array(("range",), ranges, "m")
        dataset = self.dataset.assign(position=position, range=shifted)
        named = {"clock_offset": clock_offset, "range_bias": range_bias}
        return Capture(dataset.assign_attrs(named))

    def frames(self, indices: Sequence[int] | Int64[Tensor, " chosen"]) -> "Capture":
        """Only these frames, in this order."""
        return Capture(self.dataset.isel(frame=torch.as_tensor(indices).tolist()))

    def spectrum(self, grid: Grid) -> Float[Tensor, "frame range u v"]:
        """Measured power in the bins of a grid.

        Beat samples are processed exactly (window, range transform, beamforming); range
        profiles are interpolated, band-limited, and squared.

        Raises:
            InputError: a grid beyond the measured ranges, or one that resolves directions which
                range profiles do not.
        """
        if "beat" in self.dataset:
            return exact_spectrum(self.beat, self._radar, grid)
        if grid.shape[1:] != (1, 1):
            raise refusal("capture.directions", grid.u_count, grid.v_count)
        profile = self.interpolator()(grid.ranges.expand(self.frame_count, -1))
        return profile.abs().square()[..., None, None]

    def interpolator(self) -> RangeInterpolator:
        """The range profiles as functions of range."""
        frequency = self._radar.waveform.center_frequency
        return RangeInterpolator(self.range_profile, self.ranges, frequency)

    def _read_data(self, name: str) -> Tensor:
        if name not in self.dataset:
            held = "beat" if "beat" in self.dataset else "range_profile"
            raise refusal("capture.other_data", name, held)
        return read_tensor(self.dataset, name)


def _check_sizes(variables: dict[str, xr.DataArray]) -> None:
    """xarray's own message for this does not say what to do."""
    sizes: dict[str, tuple[str, int]] = {}
    for name, variable in variables.items():
        for dim, size in zip(variable.dims, variable.shape, strict=True):
            other, expected = sizes.setdefault(str(dim), (name, size))
            if size != expected:
                raise refusal("capture.sizes", expected, dim, name, other, size)


def _check_dataset(dataset: xr.Dataset) -> Radar:
    """Check a dataset, and return its radar."""
    held = [name for name in ("beat", "range_profile") if name in dataset]
    if len(held) != 1:
        raise refusal("capture.no_data", held or "neither")
    data, dims = dataset[held[0]], BEAT_DIMS if "beat" in held else PROFILE_DIMS
    if data.dims != dims or data.dtype.kind != "c":
        raise refusal("capture.kind", held[0], dims, data.dtype, data.dims)
    for name, variable in dataset.variables.items():
        bad = int((~(np.abs(variable.values) <= MAX_NUMBER)).sum())
        if bad:
            raise refusal("capture.not_finite", name, bad, variable.size)
    radar = radar_from_fields(dataset)
    if "beat" in held:
        _check_beat(dataset, radar)
    else:
        _check_profile(dataset)
    return radar


def _check_beat(dataset: xr.Dataset, radar: Radar) -> None:
    waveform, got = radar.waveform, dataset.sizes["sample"]
    expected = waveform.samples if isinstance(waveform, SampledWaveform) else None
    if expected != got:
        raise refusal("capture.samples", expected, type(waveform).__name__, got)


def _check_profile(dataset: xr.Dataset) -> None:
    steps = read_tensor(dataset, "range").diff()
    if not len(steps) or not ((steps / steps.mean() - 1).abs() <= 1e-3).all() or steps[0] <= 0:
        raise refusal("capture.ranges")
    for end in ("tx", "rx"):
        if dataset.sizes[end] != 1:
            raise refusal("capture.elements", end, dataset.sizes[end])
