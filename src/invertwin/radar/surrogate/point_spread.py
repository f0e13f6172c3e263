"""Point spreads: power of one path over range and direction, peak 1."""

import math
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from invertwin.errors import InputError
from invertwin.radar.aperture import Aperture
from invertwin.radar.radar import Radar
from invertwin.radar.waveform import SampledWaveform, Waveform, gaussian_response

_TABLE = 32  # table entries per cell of a response
_Values = Float64[Tensor, " point"]  # one at every point


def range_point_spread(
    waveform: Waveform, distance: _Values, window: str = "hamming", kernel: str = "response"
) -> _Values:
    """Return the power of a point target at a distance from its range, peak 1.

    Args:
        waveform: waveform of the radar.
        distance: distance from the target's range [m].
        window: taper of the samples.
        kernel: "response", "gaussian" or "dirichlet", see ``Surrogate.range_kernel``.
    """
    if kernel == "gaussian":
        return gaussian_response(waveform, distance)
    if kernel == "dirichlet":
        return dirichlet(waveform, distance)
    return waveform.range_response(distance, window)


def interpolate_response(
    offsets: Float64[Tensor, "*point"],
    cell: float,
    response: Callable[[Float64[Tensor, " entry"]], Float64[Tensor, " entry"]],
) -> Float64[Tensor, "*point"]:
    """Interpolate a response at many offsets from a table: cubic, with a smooth derivative.

    A third of a path's bins lie in the main lobe; a direct evaluation costs a whole sum over
    samples each. The error is below 1e-5 of the peak.

    Args:
        offsets: offsets from the peak.
        cell: width of a cell.
        response: symmetric function of offsets.
    """
    step = cell / _TABLE
    distance = offsets.abs() / step
    last = int(distance.detach().max()) + 3 if distance.numel() else 3
    table = response(torch.arange(-1, last + 1, dtype=torch.float64, device=offsets.device) * step)
    index = distance.detach().floor().to(torch.int64)
    before, here, after, beyond = (table[index + k] for k in range(4))
    t = distance - index
    slope, next_slope = 0.5 * (after - before), 0.5 * (beyond - here)
    rise = after - here
    return here + t * (
        slope + t * (3 * rise - 2 * slope - next_slope + t * (slope + next_slope - 2 * rise))
    )


def dirichlet(waveform: Waveform, distance: _Values) -> _Values:
    """Return the range response without a window, |sin(Nx) / (N sin x)|² with x = π d / R_max; peak
    1.

    Its period is the unambiguous range.

    Args:
        waveform: waveform with samples.
        distance: distance from the target's range [m].

    Raises:
        InputError: A waveform without samples.
    """
    if not isinstance(waveform, SampledWaveform):
        raise InputError(
            f"expected a sampled waveform for the Dirichlet kernel, got {type(waveform).__name__}; "
            'use range_kernel="response", which is its pulse'
        )
    x = math.pi * distance / waveform.max_range
    below = waveform.samples * torch.sin(x)
    peak = below.abs() < 1e-9
    ratio = torch.sin(waveform.samples * x) / torch.where(peak, torch.ones_like(x), below)
    return torch.where(peak, torch.ones_like(x), ratio.square())


def array_point_spread(
    array: Aperture, du: Float64[Tensor, " u"], dv: Float64[Tensor, " v"]
) -> Float64[Tensor, "u v"]:
    """Return the power of a point target at offsets in u and v from its direction, peak 1.

    Args:
        array: virtual array.
        du: offsets in u.
        dv: offsets in v.
    """
    response = array.steering(du, array.y) @ _array_weights(array) @ array.steering(dv, array.z).T
    return response.abs().square()


def paired_array_spread(array: Aperture, du: _Values, dv: _Values) -> _Values:
    """Return the power of a point target at pairs of offsets in u and v from its direction, peak 1.

    Args:
        array: virtual array.
        du: offset in u of each point.
        dv: offset in v of each point.
    """
    along, up = array.steering(du, array.y), array.steering(dv, array.z)
    response = ((along @ _array_weights(array).to(along)) * up).sum(1)
    return response.real.square() + response.imag.square()


def _array_weights(array: Aperture) -> Tensor:
    """Return weights of the grid positions, with a sum of 1."""
    weight = array.counts * array.y_taper[:, None] * array.z_taper[None]
    return (weight / weight.sum()).to(torch.complex128)


def airy_radii(radar: Radar, radius: float | None) -> tuple[float, float]:
    """Return the half axes of the ellipse of the Airy lobe [m].

    Args:
        radar: radar with its aperture.
        radius: radius of a disc instead [m]; None = the ellipse fills the aperture.
    """
    if radius is not None:
        return radius, radius
    return 0.5 * radar.aperture[0], 0.5 * radar.aperture[1]


def airy(z: Float[Tensor, "*point"]) -> Float[Tensor, "*point"]:
    """Return the power pattern of a uniformly illuminated disc, (2 J1(z)/z)² with z = k r |Δ(u,
    v)|; differentiable.

    Source: the spatial spectrum surrogate of the paper (§3.4.2); derivations §5.
    """
    return airy_field(z).square()


def airy_field(z: Float[Tensor, "*point"]) -> Float[Tensor, "*point"]:
    """Return the field pattern of the same disc, 2 J1(z)/z; differentiable."""
    near = z.abs() < 1e-3
    away = torch.where(near, torch.ones_like(z), z)
    return torch.where(near, 1 - z.square() / 8 + z**4 / 192, 2 * bessel_j1(away) / away)


def bessel_j1(z: Float[Tensor, "*point"]) -> Float[Tensor, "*point"]:
    """Return the Bessel function of the first kind and order one, with the gradient J0 − J1/z.

    ``torch.special.bessel_j1`` silently has none.
    """
    return _BesselJ1.apply(z)  # type: ignore[no-any-return]


def normalized_gaussian(
    ranges: Float[Tensor, " path"], bins: Float[Tensor, " bin"], sigma: float
) -> Float[Tensor, "path bin"]:
    """Evaluate the paper's range kernel: a Gaussian around each path, normalised over the bins.

        G_f(R) = exp(−(R − D_f)²/2σ²) / Σ_j exp(−(R − D_j)²/2σ²)

    Its derivative, which automatic differentiation gives, is
    ``∂G_f/∂R = G_f [(D_f − R)/σ² − Σ_j G_j (D_j − R)/σ²]``.

    Source: §3.4.1 of the paper; derivations §5.
    Differs from the source: the printed derivative ``G (D − τ)/σ² (1 − G)`` belongs to another
    normalisation (4–28 % off here), and the delay there denotes the range R.

    Args:
        ranges: range R of each path [m].
        bins: centres D_f of the bins [m].
        sigma: standard deviation σ [m].
    """
    return torch.softmax(-0.5 * ((ranges[:, None] - bins[None]) / sigma).square(), dim=1)


class _BesselJ1(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, z: Tensor) -> Tensor:
        value = torch.special.bessel_j1(z)
        ctx.save_for_backward(z, value)
        return value

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        z, value = ctx.saved_tensors
        ratio = torch.where(z == 0, 0.5 * torch.ones_like(z), value / z)
        return grad_outputs[0] * (torch.special.bessel_j0(z) - ratio)
