"""Transition functions of diffraction: what an edge sends near the shadow of a straight wave.

With s² the phase by which the path over the edge is longer than the straight one, an endless edge
sends g(s) = 2j exp(js²) ∫ exp(−jt²) dt from s to ∞; t² is the same phase of other points of the
edge. The transition function of Kouyoumjian and Pathak is F(x) = √x g(√x). Convention exp(+jωt).

Source: derivations §9; Weideman, "Computation of the complex error function", SIAM J. Numer. Anal.
31, 1994; Owen, "Tables for computing bivariate normal probabilities", Ann. Math. Stat. 27, 1956.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

_WEIDEMAN_TERMS = 40  # of Weideman's sum: 1e-14
_QUADRATURE_POINTS = 24  # of either quadrature: 1e-14
_CHAIN_POINTS = 48  # of that over a third edge
_NEAR_LIMIT = 16.0  # s² + t² from which on the far quadrature serves
_EXP_J_PI_4 = complex(math.sqrt(0.5), math.sqrt(0.5))  # exp(jπ/4)
_SQRT_PI = math.sqrt(math.pi)
_DECAY_LIMIT = 6.0  # exp(−36) of the largest value, where an integral ends
_ROWS_AT_ONCE = 1 << 13  # such pieces stay in the processor's cache: ten times as fast


def _weideman_coefficients(terms: int) -> tuple[float, list[float]]:
    """Scale and coefficients of the rational sum of w(z) = exp(−z²) erfc(−jz)."""
    count = 2 * terms
    scale = math.sqrt(terms / math.sqrt(2))
    node = scale * np.tan(np.arange(-count + 1, count) * math.pi / count / 2)
    sampled = np.concatenate([[0.0], np.exp(-(node**2)) * (scale**2 + node**2)])
    found = np.fft.fft(np.fft.fftshift(sampled)).real / (2 * count)
    return scale, found[terms:0:-1].tolist()


def _graded_quadrature(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights from 0 to 1, closer together near 0: Gauss's of the cube root."""
    node, weight = np.polynomial.legendre.leggauss(count)
    root = (node + 1) / 2
    return root**3, 1.5 * weight * root**2


_SCALE, _COEFFICIENTS = _weideman_coefficients(_WEIDEMAN_TERMS)
_LEGENDRE_RULE = tuple(zip(*np.polynomial.legendre.leggauss(_QUADRATURE_POINTS), strict=True))
_GRADED_RULE = tuple(values.tolist() for values in _graded_quadrature(_CHAIN_POINTS))
_LAGUERRE_RULE = tuple(zip(*np.polynomial.laguerre.laggauss(_QUADRATURE_POINTS), strict=True))


def transition(s: Float64[Tensor, "*row"]) -> Complex128[Tensor, "*row"]:
    """g(s) = 2j exp(js²) ∫ exp(−jt²) dt from s to ∞ for s ≥ 0, and g(−s) = −g(s).

    Near zero it jumps by 2√π exp(jπ/4), as the straight wave does; far away it is 1/s. Its
    derivative is g′ = 2jsg − 2j on either side.

    Args:
        s: any finite numbers.
    """
    return _TransitionFunction.apply(s)  # type: ignore[return-value]


def end_transition(
    s: Float64[Tensor, "*#row"], t: Float64[Tensor, "*#row"]
) -> Complex128[Tensor, "*row"]:
    """The part of g(s) that an edge beyond t sends: exp(jπ/4)/√π ∫ s exp(−jτ²)/(s² + τ²) dτ.

    An edge whose ends are t₁ and t₂ away from the point of diffraction, counted outwards, sends
    g(s) less the part beyond either end; t < 0 where that point lies beyond the end. Sums over the
    edges of a plate have no jump, at its corners either: they are the Fresnel integral over it.

    Args:
        s: as in ``transition``.
        t: lower limit τ = t of the integral; its upper limit is ∞.
    """
    beyond = _TruncatedTransition.apply(s, t.abs())
    return torch.where(t < 0, transition(s) - beyond, beyond)  # type: ignore[operator]


def edge_transition(
    s: Float64[Tensor, "*#row"], ends: Float64[Tensor, "*#row 2"] | None
) -> Complex128[Tensor, "*row"]:
    """g(s) of an edge with two ends.

    Args:
        s: as in ``transition``.
        ends: t of both ends, as in ``end_transition``; None of an endless edge.
    """
    sent = transition(s)
    if ends is None:
        return sent
    return sent - end_transition(s, ends[..., 0]) - end_transition(s, ends[..., 1])


def edge_transition_slope(
    s: Float64[Tensor, "*#row"],
    ends: Float64[Tensor, "*#row 2"] | None,
    value: Complex128[Tensor, "*row"],
) -> Complex128[Tensor, "*row"]:
    """Derivative of ``edge_transition`` by s.

    Args:
        s, ends: as there.
        value: its value.
    """
    slope = 2j * s * value - 2j
    for t in () if ends is None else ends.unbind(-1):
        size = _half_erfc(t.abs())
        share = torch.where(t < 0, 1 - size, size)
        square = (s * s + t * t).clamp_min(1e-300)
        slope = slope + 2j * share - _EXP_J_PI_4 / _SQRT_PI * _phasor(-t * t) / square * t
    return slope


def corner_transition(
    s: Float64[Tensor, "*#row"], t: Float64[Tensor, "*#row"], coupling: Float64[Tensor, "*#row"]
) -> Complex128[Tensor, "*row"]:
    """What two edges one after the other send: −4 ∫∫ exp(−j(2sx + 2ty + x² + y² − 2wxy)) dx dy.

    Both integrals go from 0 to ∞, for s and t ≥ 0; for others, the function is −1 times that of
    −s, t and −w. Without coupling it is g(s) g(t); far away it is 1/st.

    Args:
        s, t: as in ``transition``, of the path over both edges at either of them.
        coupling: w, of −1 to 1: how much the way through one opening moves that through the other.

    Source: Capolino, Albani, Maci and Tiberio, "Double diffraction at a pair of coplanar skew
    edges", IEEE TAP 45, 1997, T(s, t, w)/st.
    """
    sides = torch.where(s < 0, -1.0, 1.0), torch.where(t < 0, -1.0, 1.0)
    s, t, side = s.abs(), t.abs(), sides[0] * sides[1]
    s, t, _ = torch.broadcast_tensors(s, t, coupling)
    w = side * coupling
    root = torch.sqrt((1 - w) * (1 + w))
    parts = [
        _phasor(own * own) * end_transition((other + w * own) / root, own)
        for own, other in ((s, t), (t, s))
    ]
    return (2j * _SQRT_PI * _EXP_J_PI_4.conjugate() * side / root) * (parts[0] + parts[1])


def chain_transition(
    middle: Float64[Tensor, "term row"],
    outer: Sequence[Float64[Tensor, "term row"]],
    coupling: Sequence[Float64[Tensor, " row"]],
) -> Complex128[Tensor, "parity parity term term term row"]:
    """What three edges send, of which one is coupled to both others: parts by parity in couplings.

    The whole is −8j ∫∫∫ exp(−j(x² + y² + z² + 2rx + 2sy + 2tz − 2vxy − 2wxz)) from 0 to ∞, with
    y and z of the outer edges. For every x, the integrals over y and z are functions of their own,
    and that over x goes down from the real axis. Parts even (0) and odd (1) in v and w add up to
    the whole; terms are in the order of the arguments. Without coupling it is g(r) g(s) g(t). Of
    arguments up to 30 it is exact to 3e-5 of it, of arguments up to 3 to 1e-10.

    Args:
        middle: r ≥ 0, as in ``transition``.
        outer: s and t ≥ 0.
        coupling: v and w, v² + w² < 1.
    """
    left = (1 - coupling[0] ** 2 - coupling[1] ** 2).clamp_min(1e-9)
    node, weight = (torch.tensor(values, dtype=torch.float64) for values in _GRADED_RULE)
    reach = _DECAY_LIMIT / left.detach().sqrt()
    x, step = reach[:, None] * node, reach[:, None] * weight
    sides = []
    for values, w in zip(outer, coupling, strict=True):
        up, down = (
            _ShiftedTransition.apply(values[..., None], sign * w[:, None], x) for sign in (1, -1)
        )
        sides.append(torch.stack([up + down, up - down]) / 2)
    falls = left[:, None] * x**2 + math.sqrt(2) * middle[..., None] * x
    turns = -math.sqrt(2) * middle[..., None] * x
    kernel = torch.polar(2 * step * (-falls).exp(), turns) * _EXP_J_PI_4
    return torch.einsum("crx,parx,qbrx->pqcabr", kernel, sides[0], sides[1])


def _apply_in_chunks(function: Callable[..., Tensor], *given: Tensor) -> Tensor:
    """A function of numbers of one shape, some rows at a time."""
    pieces = zip(*(values.reshape(-1).split(_ROWS_AT_ONCE) for values in given), strict=True)
    return torch.cat([function(*piece) for piece in pieces]).reshape(given[0].shape)


def _scaled_erfc(x: Tensor) -> Tensor:
    """exp(jx²) erfc(exp(jπ/4) x) of x ≥ 0: w(exp(j3π/4) x) by Weideman's sum."""
    turned = x * complex(-_EXP_J_PI_4.imag, -_EXP_J_PI_4.real)  # j exp(j3π/4) x
    below = _SCALE - turned
    ratio = (_SCALE + turned) / below
    total = torch.zeros_like(ratio) + _COEFFICIENTS[0]
    for coefficient in _COEFFICIENTS[1:]:
        total = total * ratio + coefficient
    return (2 * total / below + 1 / _SQRT_PI) / below


class _ShiftedTransition(torch.autograd.Function):
    """exp(−w²x²) g(s − exp(−jπ/4) w x), where g is that of s ≥ 0 for all complex numbers."""

    @staticmethod
    def forward(s: Tensor, w: Tensor, x: Tensor) -> Tensor:  # type: ignore[override]
        s, shift = torch.broadcast_tensors(s, w * x)
        return _apply_in_chunks(_evaluate_shifted, s, shift)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:  # type: ignore[override]
        ctx.save_for_backward(*inputs, output)
        ctx.save_for_forward(*inputs, output)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None]:  # type: ignore[override]
        s, w, x, found = ctx.saved_tensors
        by_s, by_w = ((grad.conj() * slope).real for slope in _shifted_derivatives(s, w, x, found))
        return by_s.sum_to_size(s.shape), by_w.sum_to_size(w.shape), None

    @staticmethod
    def jvp(ctx: Any, tangent_s: Any, tangent_w: Any, _: Any) -> Tensor:  # type: ignore[override]
        s, w, x, found = ctx.saved_tensors
        by_s, by_w = _shifted_derivatives(s, w, x, found)
        return by_s * (torch.zeros_like(s) if tangent_s is None else tangent_s) + by_w * (
            torch.zeros_like(w) if tangent_w is None else tangent_w
        )


def _evaluate_shifted(s: Tensor, shift: Tensor) -> Tensor:
    """One-dimensional; beyond s = √2 shift by way of the function of −s."""
    way = s - _EXP_J_PI_4.conjugate() * shift
    over = shift * math.sqrt(2) > s
    size = _scaled_erfc(torch.where(over, -way, way)) * torch.exp(-shift * shift)
    turn = s * s - math.sqrt(2) * shift * s
    straight = torch.exp(torch.complex(-math.sqrt(2) * shift * s * over, turn))
    return _SQRT_PI * _EXP_J_PI_4 * torch.where(over, 2 * straight - size, size)


def _shifted_derivatives(s: Tensor, w: Tensor, x: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
    way = s - _EXP_J_PI_4.conjugate() * w * x
    by_s = 2j * way * value - 2j * torch.exp(-((w * x) ** 2))
    return by_s, -_EXP_J_PI_4.conjugate() * x * by_s - 2 * w * x * x * value


def _phasor(phase: Tensor) -> Tensor:
    """exp(j phase)."""
    return torch.complex(phase.cos(), phase.sin())


def _half_erfc(x: Tensor) -> Tensor:
    """½ erfc(exp(jπ/4) x) of x ≥ 0: the part of a straight wave that passes an edge."""
    return 0.5 * _phasor(-x * x) * _scaled_erfc(x)


class _TransitionFunction(torch.autograd.Function):
    """g(s)."""

    @staticmethod
    def forward(s: Tensor) -> Tensor:  # type: ignore[override]
        size = _SQRT_PI * _EXP_J_PI_4 * _apply_in_chunks(_scaled_erfc, s.abs())
        return torch.where(s < 0, -size, size)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:  # type: ignore[override]
        ctx.save_for_backward(*inputs, output)
        ctx.save_for_forward(*inputs, output)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:  # type: ignore[override]
        s, g = ctx.saved_tensors
        return (grad.conj() * (2j * s * g - 2j)).real

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor) -> Tensor:  # type: ignore[override]
        s, g = ctx.saved_tensors
        return tangent * (2j * s * g - 2j)


class _TruncatedTransition(torch.autograd.Function):
    """The part beyond t ≥ 0, odd in s."""

    @staticmethod
    def forward(s: Tensor, t: Tensor) -> Tensor:  # type: ignore[override]
        s, t = torch.broadcast_tensors(s, t)
        found = _apply_in_chunks(_evaluate_truncated, s.abs(), t)
        return torch.where(s < 0, -found, found)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:  # type: ignore[override]
        ctx.save_for_backward(*inputs, output)
        ctx.save_for_forward(*inputs, output)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        s, t, found = ctx.saved_tensors
        by_s, by_t = ((grad.conj() * slope).real for slope in _truncated_derivatives(s, t, found))
        return by_s.sum_to_size(s.shape), by_t.sum_to_size(t.shape)

    @staticmethod
    def jvp(ctx: Any, tangent_s: Tensor | None, tangent_t: Tensor | None) -> Tensor:  # type: ignore[override]
        s, t, found = ctx.saved_tensors
        by_s, by_t = _truncated_derivatives(s, t, found)
        zero = torch.zeros_like(s)
        return by_s * (zero if tangent_s is None else tangent_s) + by_t * (
            torch.zeros_like(t) if tangent_t is None else tangent_t
        )


def _truncated_derivatives(s: Tensor, t: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of the part beyond t by s and by t; finite at s = t = 0, where there are none."""
    square = (s * s + t * t).clamp_min(1e-300)
    half = _apply_in_chunks(_half_erfc, t)
    front = _EXP_J_PI_4 / _SQRT_PI * _phasor(-t * t) / square
    return 2j * s * value - 2j * half + front * t, -front * s


def _evaluate_truncated(s: Tensor, t: Tensor) -> Tensor:
    """The part beyond t ≥ 0 of s ≥ 0, in one dimension."""
    found = torch.empty(s.shape, dtype=torch.complex128)
    square = s * s + t * t
    for rule, rows in (
        (_near_quadrature, square < _NEAR_LIMIT),
        (_far_quadrature, square >= _NEAR_LIMIT),
    ):
        at = torch.nonzero(rows)[:, 0]
        found[at] = rule(s[at], t[at])
    return _EXP_J_PI_4 / _SQRT_PI * found


def _near_quadrature(s: Tensor, t: Tensor) -> Tensor:
    """exp(js²) [atan(s/t) − √π exp(jπ/4) s ∫ exp(−js²x²) erfc(exp(jπ/4) t x) dx], x from 0 to 1."""
    total = torch.zeros(s.shape, dtype=torch.complex128)
    square = s * s + t * t
    for node, weight in _LEGENDRE_RULE:
        x = (node + 1) / 2
        total = total + weight / 2 * _phasor(-x * x * square) * _scaled_erfc(x * t)
    return _phasor(s * s) * (torch.atan2(s, t) - _SQRT_PI * _EXP_J_PI_4 * s * total)


def _far_quadrature(s: Tensor, t: Tensor) -> Tensor:
    """Down the steepest path, τ² = t² − jv; where s > t by way of the part with both exchanged.

    The parts beyond (s, t) and (t, s) are those of a right angle: a product of two edges.
    """
    low, high = torch.minimum(s, t), torch.maximum(s, t)
    total = torch.zeros(s.shape, dtype=torch.complex128)
    square = high * high
    for node, weight in _LAGUERRE_RULE:
        lower = torch.complex(square, torch.full_like(square, -node))
        total = total + weight / (torch.sqrt(lower) * (lower + low * low))
    part = -0.5j * low * total * _phasor(-high * high)
    both = 0.5 * math.pi * _scaled_erfc(s) * _scaled_erfc(t) * _phasor(-t * t)
    return torch.where(s > t, both - part * _phasor(s * s - low * low), part)
