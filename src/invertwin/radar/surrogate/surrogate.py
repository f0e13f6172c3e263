"""Smooth surrogate of exact signals: deposited power, convolved with the point spread."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType
from typing import Any, Literal

import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor

from invertwin import channel
from invertwin.checks import CheckedFields, check_choice, check_shape, checked_number
from invertwin.errors import InputError
from invertwin.limits import NonNegative, Positive
from invertwin.radar.aperture import Aperture, aperture
from invertwin.radar.radar import Radar
from invertwin.radar.surrogate import point_spread
from invertwin.radar.waveform import PhysicsWarning, Waveform
from invertwin.runtime.memory import require_memory
from invertwin.scene.material.fresnel import safe_root
from invertwin.scene.scene import Scene

# Minimum extent of tabulated kernels, so that short grids do not truncate them.
_MIN_EXTENT = 64
_DEFAULT_ANGLE_WIDTH = 1.5  # beamwidths of blur for an initial direction of unknown error
_Values = Float64[Tensor, " point"]  # one at every point
_Maps = Float[Tensor, "frame range u v"]  # power of every frame


@dataclass(frozen=True)
class Surrogate(CheckedFields):
    """Power point spread of one path over the bins of a spectrum.

    "response" kernels are those of exact signals: the power response of the sample window in range,
    of the weighted virtual array in direction. For random phases the mean of the exact spectrum is
    therefore the surrogate's. The added widths blur both the simulated and the measured map;
    annealing them to zero widens the basin of attraction.

    Source: §3.4 of the paper; derivations §5.
    Differs from the source: power is spread, not a field with random phases, whose boundary
    gradient has mean zero (docs/limitations.md); the Airy argument is k r |Δ(u, v)|, which is shift
    invariant, not k r sin ψ; the Gaussian has peak 1, which inside a grid is
    ``normalized_gaussian`` times a constant.

    Attributes:
        range_kernel: "response"; "gaussian" with a full width at half maximum of one range cell
            c/2B; or "dirichlet", the response without a window. For an ``Impulse`` radar the first
            two are equal.
        angle_kernel: "response", or "airy" (a uniformly illuminated ellipse that fills the
            aperture).
        range_width: standard deviation of the added Gaussian [range cells].
        angle_width: standard deviation of the added Gaussian in u and v [beamwidths λ/D].
        aperture_radius: radius for "airy" [m]; None = half the virtual aperture along y and z.

    Raises:
        InputError: An unknown kernel, a negative width, or a radius that is not positive.
    """

    range_kernel: Literal["response", "gaussian", "dirichlet"] = "response"
    angle_kernel: Literal["response", "airy"] = "response"
    range_width: NonNegative = 0.0
    angle_width: NonNegative = 0.0
    aperture_radius: Positive | None = None

    @classmethod
    def for_start_error(
        cls,
        error: float,
        radar: Radar,
        *,
        distance: float | None = None,
        degrees: float | None = None,
        **kernels: Any,
    ) -> "Surrogate":
        """Return a surrogate whose blur is as wide as the error of an initial estimate.

        A fit finds an object from further away the wider the blur is, and takes longer. A
        standard deviation equal to the error suffices.

        Args:
            error: Distance of the initial position from the true one [m].
            radar: The radar, whose range cells and beamwidths the widths are counted in.
            distance: Distance of the object from the radar [m], at which the error is seen under
                an angle.
            degrees: Error in direction [°], in place of the angle at that distance. Where neither
                is given, directions are blurred by 1.5 beamwidths.
            kernels: Kernels, as for ``Surrogate``.

        Raises:
            InputError: A negative error, a distance or a direction out of range, or both.
        """
        checked_number(error, "error of the start [m]", 0.0)
        if distance is not None and degrees is not None:
            raise InputError(
                "expected a distance or an error in degrees, got both; the distance gives the "
                "angle of the error"
            )
        angle_width = _DEFAULT_ANGLE_WIDTH
        if distance is not None:
            far = checked_number(distance, "distance [m]", 0.0, open_low=True)
            degrees = math.degrees(math.atan2(error, far))
        if degrees is not None:
            angle = math.radians(checked_number(degrees, "error in direction [°]", 0.0, 90))
            angle_width = math.sin(angle) / min(radar.beamwidth)
        range_width = error / radar.waveform.range_resolution
        return cls(range_width=range_width, angle_width=angle_width, **kernels)

    @property
    def has_blur(self) -> bool:
        """True if there is an added blur."""
        return self.range_width > 0 or self.angle_width > 0

    def scale_blur(self, share: float) -> "Surrogate":
        """Return the surrogate with scaled added widths.

        Args:
            share: scale factor; 0 removes the blur.
        """
        widths = {"range_width": self.range_width * share, "angle_width": self.angle_width * share}
        return replace(self, **widths)

    def shape(self, deposit: _Maps, radar: Radar, grid: channel.Grid) -> _Maps:
        """Convolve deposited power with the point spread: the radar's mean over random phases.

        The convolution (peak 1) is divided in the Fourier domain by the transform sinc³ of the
        deposit's quadratic B-spline, so that the deposit adds no blur. It is zero-padded, so power
        outside the grid is lost, and linear, so derivatives are convolved equally. The division
        causes negative bins: with two bins per cell 4e-5 of the peak for single points and 1.4e-3
        for a small plate. On a coarser grid it is 3 % of the peak, and maps are not the mean of
        exact spectra; a warning is issued.

        Args:
            deposit: deposited power from ``deposit_power`` on the same grid.
            radar: radar with its window, arrays, waveform and range bias.
            grid: Bins.

        Raises:
            InputError: A map of another shape than the grid.
        """
        _check_map(deposit, grid)
        sigmas = self._blur_sigmas(radar, grid)
        _warn_if_coarse(radar, grid, sigmas)
        for kernel in self._kernels(radar, grid):
            offset = None
            if kernel.dims == (1,) and radar.has_range_bias:
                offset = torch.as_tensor(radar.range_bias) / grid.range_step
            deposit = kernel.apply(deposit, [sigmas[dim] for dim in kernel.dims], offset)
        return deposit

    def blur(self, power: _Maps, radar: Radar, grid: channel.Grid) -> _Maps:
        """Blur a measured spectrum with the added Gaussian widths only.

        Args:
            power: measured spectrum.
            radar: radar with its range and angle cells.
            grid: Bins.

        Raises:
            InputError: A map of another shape than the grid.
        """
        _check_map(power, grid)
        for dim, sigma in self._blur_sigmas(radar, grid).items():
            if (count := grid.shape[dim - 1]) > 1 and sigma > 0:
                flat = torch.ones_like(_frequencies((count,))[0])
                power = _SurrogateKernel((dim,), (count,), flat).apply(power, [sigma])
        return power

    def spread(
        self, radar: Radar, grid: channel.Grid, ranges: _Values, u: _Values, v: _Values
    ) -> _Values:
        """Return the point spread at offsets from its peak of 1, without added widths.

        Args:
            radar: radar with its window, arrays and waveform.
            grid: grid whose axes of one bin have no spread.
            ranges: offsets in range [m].
            u, v: offsets in direction.
        """

        waveform, kernel = radar.waveform, self.range_kernel

        def range_spread(places: Tensor) -> Tensor:
            return point_spread.range_point_spread(waveform, places, radar.window, kernel)

        power = point_spread.interpolate_response(ranges, waveform.range_resolution, range_spread)
        u, v = u * (grid.u_count > 1), v * (grid.v_count > 1)
        if grid.u_count == grid.v_count == 1:
            return power
        array = aperture(radar)
        if self.angle_kernel == "airy":
            across, up = point_spread.airy_radii(radar, self.aperture_radius)
            away = safe_root((across * u).square() + (up * v).square(), 0.0)
            return power * point_spread.airy(2 * math.pi / array.wavelength * away)
        return power * point_spread.paired_array_spread(array, u, v)

    def _kernels(self, radar: Radar, grid: channel.Grid) -> "tuple[_SurrogateKernel, ...]":
        array = aperture(radar) if grid.u_count > 1 or grid.v_count > 1 else None
        radii, sharp = point_spread.airy_radii(radar, self.aperture_radius), self.scale_blur(0.0)
        return _kernels(sharp, radii, radar.waveform, radar.window, array, grid)

    def _blur_sigmas(self, radar: Radar, grid: channel.Grid) -> dict[int, float]:
        """Return the standard deviation of the added Gaussian along each map dimension, in bins."""
        u, v = radar.beamwidth
        return {
            1: self.range_width * radar.waveform.range_resolution / grid.range_step,
            2: self.angle_width * u / grid.u_step,
            3: self.angle_width * v / grid.v_step,
        }


SURROGATES = MappingProxyType(
    {
        "exact": None,
        "response": Surrogate(),
        "annealed": Surrogate(range_width=3.0, angle_width=1.5),
        "gaussian": Surrogate(range_kernel="gaussian", angle_kernel="airy"),
        "dirichlet": Surrogate(range_kernel="dirichlet"),
    }
)
"""Names of surrogates; "exact" means exact signals, as None does."""


def resolve_surrogate(surrogate: Surrogate | str | None) -> Surrogate | None:
    """Return the surrogate of a ``surrogate`` argument; None = exact signals.

    Raises:
        InputError: A name that is not in ``SURROGATES``.
    """
    if not isinstance(surrogate, str):
        return surrogate
    do = 'surrogate="exact" means exact signals'
    check_choice(surrogate, SURROGATES, "a Surrogate or one of", do)
    return SURROGATES[surrogate]


def surrogate_spectrum(
    scene: Scene,
    radar: Radar,
    grid: channel.Grid,
    surrogate: Surrogate,
    *,
    sampling: channel.Sampling,
    seed: int,
    reference: tuple[Scene, channel.Link, Literal["rays", "area"]] | None = None,
    coherent: Sequence[str] = (),
    stretch: float = 1.0,
    mirrors: Sequence[str] = (),
) -> _Maps:
    """Compute the power spectrum of a scene, differentiable: deposit, then shape.

    Negative bins after shaping are set to zero. Coherent targets are deposited in addition to the
    rough power: all bounces of one target in one cell add coherently, and targets add in power. For
    the rest of the scene they only cast shadows, and mirrors show no images of them.

    Args:
        scene: scene to simulate.
        radar: radar with arrays, waveform and poses.
        grid: Bins, see ``Radar.grid``.
        surrogate: kernels and their added widths.
        sampling: numbers of sampled paths.
        seed: seed of the samples.
        reference: scene and link that define the sampling densities, and the scheme of
            ``deposit_power``.
        coherent: names of coherent targets, see ``trace_target``.
        stretch: wavelength of their phases in wavelengths of the radar.
        mirrors: names of smooth flat objects, see ``deposit_mirrored_power``.

    Raises:
        InputError: See ``deposit_power``, ``deposit_mirrored_power`` and ``trace_target``.
    """
    link = radar.link()
    parts = deposit_targets(scene, radar, grid, surrogate, sampling, coherent, stretch)
    if set(scene.objects) - set(coherent):
        rest = channel.as_absorbers(scene, coherent)
        drawn: dict[str, Any] = {"sampling": sampling, "seed": seed}
        fixed: dict[str, Any] = {}
        if reference is not None:
            densities = channel.as_absorbers(reference[0], coherent), reference[1]
            fixed = {"reference": densities, "scheme": reference[2]}
        bare = channel.without_specular(rest, mirrors)
        parts.append(channel.deposit_power(bare, link, grid, **drawn, **fixed))
        if mirrors:
            parts.append(channel.deposit_mirrored_power(rest, link, grid, mirrors, **drawn))
    return surrogate.shape(torch.stack(parts).sum(0), radar, grid).clamp_min(0.0)


def deposit_targets(
    scene: Scene,
    radar: Radar,
    grid: channel.Grid,
    surrogate: Surrogate,
    sampling: channel.Sampling,
    names: Sequence[str],
    stretch: float,
) -> list[Float32[Tensor, "frame range u v"]]:
    """Deposit coherent targets, one map each.

    Args:
        scene: scene to simulate.
        radar: arrays, waveform and poses.
        grid: bins, see ``Radar.grid``.
        surrogate: kernels, which say how far echoes overlap.
        sampling: numbers of sampled paths.
        names: objects whose echoes add coherently.
        stretch: as in ``surrogate_spectrum``.

    Raises:
        InputError: see ``trace_target``.
    """
    link, deposits = radar.link(), []

    def overlap(*gaps: Tensor) -> Tensor:
        return surrogate.spread(radar, grid, *(0.5 * gap for gap in gaps))

    with channel.use_backend(sampling.backend):
        for name in names:
            fields = channel.trace_target(scene, name, link, sampling=sampling, stretch=stretch)
            powers = channel.combine_coherently(fields, link, overlap, stretch=stretch)
            deposits.append(channel.deposit_paths(powers, link, grid))
    return deposits


@dataclass(frozen=True, eq=False)
class _SurrogateKernel:
    """Convolution along one map dimension, or two at once, as its transfer function.

    Attributes:
        dims: dimensions of the map [frame, range, u, v].
        counts: number of bins along them.
        transfer: transfer function over the frequencies of a real FFT (the last dimension halved);
            real, since every point spread is symmetric.
    """

    dims: tuple[int, ...]
    counts: tuple[int, ...]
    transfer: Float64[Tensor, "..."]

    def apply(self, power: Tensor, sigmas: list[float], offset: Tensor | None = None) -> Tensor:
        """Convolve the map, with added Gaussian widths and a shift, both in bins."""
        transfer = self.transfer
        for frequency, sigma in zip(_frequencies(self.counts), sigmas, strict=True):
            if sigma > 0:
                transfer = transfer * torch.exp(-2 * (math.pi * sigma * frequency).square())
        if len(self.dims) > 1:
            size = [_fft_length(count) for count in self.counts]
            spectrum = torch.fft.rfftn(power, size, self.dims)
            full = torch.fft.irfftn(spectrum * transfer.to(spectrum.real), size, self.dims)
            return full[..., : self.counts[0], : self.counts[1]]
        if offset is not None:
            ramp = _frequencies(self.counts)[0] * (-2 * math.pi * offset.cpu().double())
            transfer = transfer * torch.polar(torch.ones_like(ramp), ramp)
        return self._apply_by_matrix(power, transfer)

    def _apply_by_matrix(self, power: Tensor, transfer: Tensor) -> Tensor:
        # At these sizes a Toeplitz matrix per axis is about 30 times faster than a padded FFT.
        (dim,), (count,) = self.dims, self.counts
        taps = torch.fft.irfft(transfer, _fft_length(count)).to(power)
        matrix = taps.roll(count - 1)[: 2 * count - 1].flip(0).unfold(0, count, 1).flip(0)
        if dim == power.ndim - 1:
            return power @ matrix.T
        first = power.transpose(1, dim)  # one large product per frame, not one per row
        return (matrix @ first.flatten(2)).reshape(first.shape).transpose(1, dim)


@lru_cache(maxsize=16)
def _kernels(
    surrogate: Surrogate,
    radii: tuple[float, float],
    waveform: Waveform,
    window: str,
    array: Aperture | None,
    grid: channel.Grid,
) -> tuple[_SurrogateKernel, ...]:
    """Return the kernels without added widths, cached for the steps of a fit."""
    angle_kernel = surrogate.angle_kernel
    lags = _lags(grid.range_count) * grid.range_step
    spread = point_spread.range_point_spread(waveform, lags, window, surrogate.range_kernel)
    kernels = [_compensate_spline((1,), (grid.range_count,), spread)]
    needed = 8.0 * max(grid.shape) ** 2  # of the largest matrix of `_apply_by_matrix`
    require_memory(needed, "a map of that many bins", "narrow the grid, or check units", "grid")
    if array is None:
        return tuple(kernels)
    array.check_resolved(grid)
    du, dv = _lags(grid.u_count) * grid.u_step, _lags(grid.v_count) * grid.v_step
    zero = torch.zeros(1, dtype=torch.float64)
    counts = grid.u_count, grid.v_count
    if grid.u_count > 1 and grid.v_count > 1 and (angle_kernel == "airy" or not array.is_separable):
        spread = _angle_spread(angle_kernel, radii, array, du, dv)
        return (*kernels, _compensate_spline((2, 3), counts, spread))
    for dim, count, lags in ((2, grid.u_count, (du, zero)), (3, grid.v_count, (zero, dv))):
        if count > 1:
            spread = _angle_spread(angle_kernel, radii, array, *lags).flatten()
            kernels.append(_compensate_spline((dim,), (count,), spread))
    return tuple(kernels)


def _angle_spread(
    kernel: str, radii: tuple[float, float], array: Aperture, du: Tensor, dv: Tensor
) -> Tensor:
    if kernel == "response":
        return point_spread.array_point_spread(array, du, dv)
    wavenumber = 2 * math.pi / array.wavelength
    return point_spread.airy(wavenumber * torch.hypot(radii[0] * du[:, None], radii[1] * dv[None]))


def _compensate_spline(
    dims: tuple[int, ...], counts: tuple[int, ...], spread: Tensor
) -> _SurrogateKernel:
    """Build the kernel of a tabulated point spread divided by the blur of the quadratic B-spline.

    At the highest frequency the B-spline's transform is sinc³(1/2) = 0.26, so the division is
    bounded.
    """
    transfer = torch.fft.rfftn(spread).real
    for frequency in _frequencies(counts):
        transfer = transfer / torch.sinc(frequency) ** 3
    return _SurrogateKernel(dims, counts, transfer)


def _fft_length(count: int) -> int:
    """Return a fast FFT length for all lags between ``count`` bins, without wrap-around."""
    need = 2 * max(count, _MIN_EXTENT)
    octave = 1 << (need - 1).bit_length() - 4
    return next(m * octave for m in (9, 10, 12, 16) if m * octave >= need)


def _lags(count: int) -> Float64[Tensor, " lag"]:
    """Return offsets in bins, in FFT order."""
    return torch.fft.fftfreq(_fft_length(count), d=1 / _fft_length(count), dtype=torch.float64)


def _frequencies(counts: tuple[int, ...]) -> list[Tensor]:
    """Return cycles per bin of a real FFT, shaped to broadcast along each dimension."""
    *full, half = (_fft_length(count) for count in counts)
    axes = [torch.fft.fftfreq(size, dtype=torch.float64)[:, None] for size in full]
    return [*axes, torch.fft.rfftfreq(half, dtype=torch.float64)]


def _warn_if_coarse(radar: Radar, grid: channel.Grid, sigmas: dict[int, float]) -> None:
    """Warn about axes with less than two bins per cell and without an added width of a bin."""
    cells = radar.waveform.range_resolution, *(0.5 * width for width in radar.beamwidth)
    steps = grid.range_step, grid.u_step, grid.v_step
    axes = zip(("range", "u", "v"), cells, steps, grid.shape, sigmas.values(), strict=True)
    coarse = [
        f"{name} ({cell / step:.2g})"
        for name, cell, step, count, sigma in axes
        if count > 1 and step > 0.51 * cell and sigma < 1
    ]
    if coarse:
        warnings.warn(
            f"less than 2 bins per cell along {', '.join(coarse)}: the surrogate is not the mean "
            "of exact spectra there, and a fit may end a little off; use oversample=2",
            PhysicsWarning,
            stacklevel=2,
        )


def _check_map(power: Tensor, grid: channel.Grid) -> None:
    check_shape(power, (None, *grid.shape), "a map", "use the grid that it was made on")
