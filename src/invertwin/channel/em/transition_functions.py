"""Transition functions of edge diffraction near shadow and reflection boundaries.

With s² the phase by which the diffracted path is longer than the direct one, an infinite edge
diffracts the field g(s) = 2j exp(js²) ∫ exp(−jt²) dt from s to ∞; t² is the same phase for other
points of the edge. The transition function of Kouyoumjian and Pathak is F(x) = √x g(√x). Convention
exp(+jωt).

Source: derivations §9; Weideman, "Computation of the complex error function", SIAM J. Numer. Anal.
31, 1994; Owen, "Tables for computing bivariate normal probabilities", Ann. Math. Stat. 27, 1956.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

from invertwin.channel.em.plane_waves import phasor

_Values = Complex128[Tensor, "*row"]
_Parameters = Float64[Tensor, "*#row"]
_WEIDEMAN_TERMS = 40  # of Weideman's sum: error 1e-14
_QUADRATURE_POINTS = 24  # of either quadrature: error 1e-14
_CHAIN_POINTS = 48  # of the quadrature over a third edge
_NEAR_LIMIT = 16.0  # s² + t² above which the far quadrature is used
EXP_J_PI_4 = complex(math.sqrt(0.5), math.sqrt(0.5))  # exp(jπ/4)
_SQRT_PI = math.sqrt(math.pi)
_DECAY_LIMIT = 6.0  # upper limit of integrals: exp(−36) of the largest value
_Slopes = Callable[..., tuple[Tensor, ...]]
_ROWS_AT_ONCE = 1 << 13  # chunks that fit into the processor's cache: ten times as fast


def _weideman_coefficients(terms: int) -> tuple[float, list[float]]:
    """Scale and coefficients of Weideman's rational sum for w(z) = exp(−z²) erfc(−jz)."""
    count = 2 * terms
    scale = math.sqrt(terms / math.sqrt(2))
    node = scale * np.tan(np.arange(-count + 1, count) * math.pi / count / 2)
    sampled = np.concatenate([[0.0], np.exp(-(node**2)) * (scale**2 + node**2)])
    return scale, (np.fft.fft(np.fft.fftshift(sampled)).real / (2 * count))[terms:0:-1].tolist()


def _graded_quadrature(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights on [0, 1], denser near 0: Gauss-Legendre in the cube root."""
    node, weight = np.polynomial.legendre.leggauss(count)
    root = (node + 1) / 2
    return root**3, 1.5 * weight * root**2


_SCALE, _COEFFICIENTS = _weideman_coefficients(_WEIDEMAN_TERMS)
_LEGENDRE_RULE = tuple(zip(*np.polynomial.legendre.leggauss(_QUADRATURE_POINTS), strict=True))
_GRADED_RULE = tuple(values.tolist() for values in _graded_quadrature(_CHAIN_POINTS))
_LAGUERRE_RULE = tuple(zip(*np.polynomial.laguerre.laggauss(_QUADRATURE_POINTS), strict=True))


def transition(s: Float64[Tensor, "*row"]) -> _Values:
    """Transition function g(s) = 2j exp(js²) ∫ exp(−jt²) dt from s to ∞ for s ≥ 0, odd in s.

    At zero it jumps by 2√π exp(jπ/4), as the direct wave does; asymptotically it is 1/s. Its
    derivative is g′ = 2jsg − 2j on either side.

    Args:
        s: signed square root of the phase difference [√rad].
    """
    return _WithSlopes.apply(_infinite_transition, _infinite_slopes, s)  # type: ignore[return-value]


def end_transition(s: _Parameters, t: _Parameters) -> _Values:
    """Part of g(s) due to the edge beyond t: exp(jπ/4)/√π ∫ s exp(−jτ²)/(s² + τ²) dτ.

    The field of an edge whose ends are t₁ and t₂ away from the diffraction point, positive
    outwards, is g(s) less the part beyond either end; t < 0 if the point lies beyond the end. Sums
    over the edges of a plate have no jump, not even at its corners: they are the Fresnel integral
    over it.

    Args:
        s: as in ``transition``.
        t: lower limit τ = t of the integral; its upper limit is ∞.
    """
    beyond = _WithSlopes.apply(_truncated_transition, _truncated_slopes, s, t.abs())
    return torch.where(t < 0, transition(s) - beyond, beyond)  # type: ignore[operator]


def edge_transition(s: _Parameters, ends: Float64[Tensor, "*#row 2"] | None) -> _Values:
    """Transition function of a finite edge.

    Args:
        s: as in ``transition``.
        ends: t of both ends, as in ``end_transition``; None = infinite edge.
    """
    infinite = transition(s)
    if ends is None:
        return infinite
    return infinite - end_transition(s, ends[..., 0]) - end_transition(s, ends[..., 1])


def edge_transition_slope(
    s: _Parameters, ends: Float64[Tensor, "*#row 2"] | None, value: _Values
) -> _Values:
    """Derivative of ``edge_transition`` with respect to s.

    Args:
        s, ends: as in ``edge_transition``.
        value: value of ``edge_transition``.
    """
    slope = 2j * s * value - 2j
    for t in () if ends is None else ends.unbind(-1):
        size = _half_erfc(t.abs())
        fraction = torch.where(t < 0, 1 - size, size)
        square = (s * s + t * t).clamp_min(1e-300)
        slope = slope + 2j * fraction - EXP_J_PI_4 / _SQRT_PI * phasor(-t * t) / square * t
    return slope


def corner_transition(s: _Parameters, t: _Parameters, coupling: _Parameters) -> _Values:
    """Double-diffraction transition function −4 ∫∫ exp(−j(2sx + 2ty + x² + y² − 2wxy)) dx dy.

    Both integrals go from 0 to ∞, for s and t ≥ 0; otherwise, the function is −1 times that of −s,
    t and −w. Without coupling it is g(s) g(t); asymptotically it is 1/st.

    Args:
        s, t: arguments of ``transition`` at either edge, for the path over both.
        coupling: w in [−1, 1], the correlation of the two aperture integrals.

    Source: Capolino, Albani, Maci and Tiberio, "Double diffraction at a pair of coplanar skew
    edges", IEEE TAP 45, 1997, T(s, t, w)/st.
    """
    signs = torch.where(s < 0, -1.0, 1.0), torch.where(t < 0, -1.0, 1.0)
    s, t, sign = s.abs(), t.abs(), signs[0] * signs[1]
    s, t, _ = torch.broadcast_tensors(s, t, coupling)
    w = sign * coupling
    root = torch.sqrt((1 - w) * (1 + w))
    parts = [
        phasor(own * own) * end_transition((other + w * own) / root, own)
        for own, other in ((s, t), (t, s))
    ]
    return (2j * _SQRT_PI * EXP_J_PI_4.conjugate() * sign / root) * (parts[0] + parts[1])


def chain_transition(
    middle: Float64[Tensor, "term row"],
    outer: Sequence[Float64[Tensor, "term row"]],
    coupling: Sequence[Float64[Tensor, " row"]],
) -> Complex128[Tensor, "parity parity term term term row"]:
    """Triple-diffraction transition function, in parts by parity in the couplings.

    One edge is coupled to both others. The whole is −8j ∫∫∫ exp(−j(x² + y² + z² + 2rx + 2sy + 2tz −
    2vxy − 2wxz)) from 0 to ∞, with y and z of the outer edges. For each x, the integrals over y and
    z have closed forms, and the contour of x is rotated below the real axis. Parts even (0) and odd
    (1) in v and w add up to the whole; terms are in the order of the arguments. Without coupling it
    is g(r) g(s) g(t). The relative error is 3e-5 for arguments up to 30, and 1e-10 for arguments up
    to 3.

    Args:
        middle: r ≥ 0, as in ``transition``.
        outer: s and t ≥ 0, of the outer edges.
        coupling: v and w, with v² + w² < 1.
    """
    remainder = (1 - coupling[0] ** 2 - coupling[1] ** 2).clamp_min(1e-9)
    node, weight = (torch.tensor(values, dtype=torch.float64) for values in _GRADED_RULE)
    limit = _DECAY_LIMIT / remainder.detach().sqrt()
    x, step = limit[:, None] * node, limit[:, None] * weight
    sides = []
    shifted = partial(_WithSlopes.apply, _shifted_transition, _shifted_slopes)
    for values, w in zip(outer, coupling, strict=True):
        up, down = (shifted(values[..., None], sign * w[:, None], x) for sign in (1, -1))
        sides.append(torch.stack([up + down, up - down]) / 2)
    decay = remainder[:, None] * x**2 + math.sqrt(2) * middle[..., None] * x
    phase = -math.sqrt(2) * middle[..., None] * x
    kernel = torch.polar(2 * step * (-decay).exp(), phase) * EXP_J_PI_4
    return torch.einsum("crx,parx,qbrx->pqcabr", kernel, sides[0], sides[1])


def _apply_in_chunks(function: Callable[..., Tensor], *given: Tensor) -> Tensor:
    """Evaluate an element-wise function in chunks."""
    pieces = zip(*(values.reshape(-1).split(_ROWS_AT_ONCE) for values in given), strict=True)
    return torch.cat([function(*piece) for piece in pieces]).reshape(given[0].shape)


def _scaled_erfc(x: Tensor) -> Tensor:
    """Scaled erfc exp(jx²) erfc(exp(jπ/4) x) for x ≥ 0: w(exp(j3π/4) x) by Weideman's sum."""
    rotated = x * complex(-EXP_J_PI_4.imag, -EXP_J_PI_4.real)  # j exp(j3π/4) x
    denominator = _SCALE - rotated
    ratio = (_SCALE + rotated) / denominator
    total = torch.zeros_like(ratio) + _COEFFICIENTS[0]
    for coefficient in _COEFFICIENTS[1:]:
        total = total * ratio + coefficient
    return (2 * total / denominator + 1 / _SQRT_PI) / denominator


class _WithSlopes(torch.autograd.Function):
    """Complex function of real tensors with written first derivatives, in both modes.

    It takes the function, a function of its arguments and value that returns the derivatives with
    respect to the first arguments, and the arguments. The others have no derivatives.
    """

    @staticmethod
    def forward(evaluate: Callable[..., Tensor], _: _Slopes, *given: Tensor) -> Tensor:  # type: ignore[override]
        return evaluate(*given)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:  # type: ignore[override]
        _, ctx.slopes, *given = inputs
        ctx.save_for_backward(*given, output)
        ctx.save_for_forward(*given, output)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        *given, found = ctx.saved_tensors
        pairs = list(zip(ctx.slopes(*given, found), given, strict=False))
        gradients = [(grad.conj() * slope).real.sum_to_size(x.shape) for slope, x in pairs]
        return None, None, *gradients, *[None] * (len(given) - len(pairs))

    @staticmethod
    def jvp(ctx: Any, _: None, __: None, *tangents: Tensor | None) -> Tensor:  # type: ignore[override]
        pairs = zip(ctx.slopes(*ctx.saved_tensors), tangents, strict=False)
        return torch.stack([slope * rate for slope, rate in pairs if rate is not None]).sum(0)


def _shifted_transition(s: Tensor, w: Tensor, x: Tensor) -> Tensor:
    """exp(−w²x²) g(s − exp(−jπ/4) w x), with g continued analytically from s ≥ 0."""
    s, shift = torch.broadcast_tensors(s, w * x)
    return _apply_in_chunks(_evaluate_shifted, s, shift)


def _evaluate_shifted(s: Tensor, shift: Tensor) -> Tensor:
    """Evaluate 1D arrays; beyond s = √2 shift through the function of −s."""
    argument = s - EXP_J_PI_4.conjugate() * shift
    beyond = shift * math.sqrt(2) > s
    size = _scaled_erfc(torch.where(beyond, -argument, argument)) * torch.exp(-shift * shift)
    phase = s * s - math.sqrt(2) * shift * s
    direct = torch.exp(torch.complex(-math.sqrt(2) * shift * s * beyond, phase))
    return _SQRT_PI * EXP_J_PI_4 * torch.where(beyond, 2 * direct - size, size)


def _shifted_slopes(s: Tensor, w: Tensor, x: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
    by_s = 2j * (s - EXP_J_PI_4.conjugate() * w * x) * value - 2j * torch.exp(-((w * x) ** 2))
    return by_s, -EXP_J_PI_4.conjugate() * x * by_s - 2 * w * x * x * value


def _half_erfc(x: Tensor) -> Tensor:
    """½ erfc(exp(jπ/4) x) for x ≥ 0: fraction of a direct wave beyond a half plane."""
    return 0.5 * phasor(-x * x) * _scaled_erfc(x)


def _infinite_transition(s: Tensor) -> Tensor:
    size = _SQRT_PI * EXP_J_PI_4 * _apply_in_chunks(_scaled_erfc, s.abs())
    return torch.where(s < 0, -size, size)


def _infinite_slopes(s: Tensor, value: Tensor) -> tuple[Tensor]:
    return (2j * s * value - 2j,)


def _truncated_transition(s: Tensor, t: Tensor) -> Tensor:
    """Part of g(s) beyond t ≥ 0, odd in s."""
    s, t = torch.broadcast_tensors(s, t)
    found = _apply_in_chunks(_evaluate_truncated, s.abs(), t)
    return torch.where(s < 0, -found, found)


def _truncated_slopes(s: Tensor, t: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives with respect to s and t of the part beyond t; finite at s = t = 0."""
    square = (s * s + t * t).clamp_min(1e-300)
    half = _apply_in_chunks(_half_erfc, t)
    front = EXP_J_PI_4 / _SQRT_PI * phasor(-t * t) / square
    return 2j * s * value - 2j * half + front * t, -front * s


def _evaluate_truncated(s: Tensor, t: Tensor) -> Tensor:
    """Part of g(s) beyond t ≥ 0 for s ≥ 0, of 1D arrays."""
    found = torch.empty(s.shape, dtype=torch.complex128)
    square = s * s + t * t
    for rule, rows in (
        (_near_quadrature, square < _NEAR_LIMIT),
        (_far_quadrature, square >= _NEAR_LIMIT),
    ):
        at = torch.nonzero(rows)[:, 0]
        found[at] = rule(s[at], t[at])
    return EXP_J_PI_4 / _SQRT_PI * found


def _near_quadrature(s: Tensor, t: Tensor) -> Tensor:
    """exp(js²) [atan(s/t) − √π exp(jπ/4) s ∫ exp(−js²x²) erfc(exp(jπ/4) t x) dx], x from 0 to 1."""
    total = torch.zeros(s.shape, dtype=torch.complex128)
    square = s * s + t * t
    for node, weight in _LEGENDRE_RULE:
        x = (node + 1) / 2
        total = total + weight / 2 * phasor(-x * x * square) * _scaled_erfc(x * t)
    return phasor(s * s) * (torch.atan2(s, t) - _SQRT_PI * EXP_J_PI_4 * s * total)


def _far_quadrature(s: Tensor, t: Tensor) -> Tensor:
    """Integrate along the steepest-descent path τ² = t² − jv, with s and t exchanged for s > t.

    The parts beyond (s, t) and (t, s) add up to those of a right angle: a product of two edges.
    """
    low, high = torch.minimum(s, t), torch.maximum(s, t)
    total = torch.zeros(s.shape, dtype=torch.complex128)
    square = high * high
    for node, weight in _LAGUERRE_RULE:
        lower = torch.complex(square, torch.full_like(square, -node))
        total = total + weight / (torch.sqrt(lower) * (lower + low * low))
    truncated = -0.5j * low * total * phasor(-high * high)
    product = 0.5 * math.pi * _scaled_erfc(s) * _scaled_erfc(t) * phasor(-t * t)
    return torch.where(s > t, product - truncated * phasor(s * s - low * low), truncated)
