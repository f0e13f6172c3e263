"""Transition functions against integrals in 30 digits, and their derivatives."""

import math

import mpmath
import numpy as np
import pytest
import torch

from invertwin.channel.em.transition_functions import (
    chain_transition,
    corner_transition,
    end_transition,
    transition,
)

RADII = (0.01, 1.0, 3.9, 4.1, 20.0)
ANGLES = (0.02, 0.78, 1.2)


def number(value):
    return torch.tensor(value, dtype=torch.float64)


def whole(s):
    """g(s) of s > 0."""
    with mpmath.workdps(30):
        s, turn = mpmath.mpf(s), mpmath.expjpi(0.25)
        return complex(mpmath.sqrt(mpmath.pi) * turn * mpmath.expj(s * s) * mpmath.erfc(turn * s))


def beyond(s, t):
    """The part of it beyond t > 0, on a path in the complex plane on which it decays."""
    with mpmath.workdps(30):
        s, t, turn = mpmath.mpf(s), mpmath.mpf(t), mpmath.expjpi(0.25)

        def integrand(w):
            place = t + w / turn
            return s * mpmath.expj(-(place**2)) / (s * s + place**2) / turn

        total = mpmath.quad(integrand, [0, 0.02, 0.05, 0.2, 0.5, 1, 2, 4, 9])
        return complex(turn / mpmath.sqrt(mpmath.pi) * total)


@pytest.mark.parametrize(
    ("x", "expected"),
    [(0.3, 0.571713 + 0.272992j), (1, 0.809525 + 0.232199j), (10, 0.993041 + 0.048351j)],
)
def test_transition_function_of_kouyoumjian_and_pathak(x, expected):
    assert abs(math.sqrt(x) * transition(number(x).sqrt()).item() - expected) < 1e-6


def test_transition_to_rounding():
    for s in (1e-9, 1e-3, 0.1, 0.5, 1.0, 2.0, 5.0, 10.0, 100.0):
        assert abs(transition(number(s)).item() / whole(s) - 1) < 1e-14
        assert transition(number(-s)) == -transition(number(s))


def test_part_beyond_an_end_to_rounding():
    for radius in RADII:
        for angle in ANGLES:
            s, t = radius * math.sin(angle), radius * math.cos(angle)
            assert abs(end_transition(number(s), number(t)).item() / beyond(s, t) - 1) < 1e-13
            rest = end_transition(number(-s), number(-t)).item()
            assert abs(rest + whole(s) - beyond(s, t)) < 1e-14 * abs(whole(s)) + 1e-15


@pytest.mark.parametrize(("s", "t", "w"), [(0.3, 0.5, 0.6), (1.2, 0.1, -0.9), (4.0, 2.0, 0.3)])
def test_corner_to_rounding(s, t, w):
    # Both ways are turned to where the integrand decays.
    turn = complex(math.sqrt(0.5), -math.sqrt(0.5))
    node, weight = np.polynomial.legendre.leggauss(200)
    x, part = 7.5 * (node + 1), 7.5 * weight
    form = x[:, None] ** 2 + x**2 - 2 * w * x[:, None] * x
    wave = np.exp(-2j * turn * (s * x[:, None] + t * x) - form)
    truth = -4 * turn**2 * (part @ wave @ part)
    found = corner_transition(number([s]), number([t]), number([w]))
    assert abs(found.item() - truth) < 1e-9 * abs(truth)


def test_corner_without_coupling_is_a_product():
    s, t = number([-0.7, 2.0]), number([0.4, -0.1])
    torch.testing.assert_close(corner_transition(s, t, 0 * s), transition(s) * transition(t))


def chained(r, s, t, v, w):
    """Of one term each."""
    return chain_transition(r[None], [s[None], t[None]], [v, w]).sum((0, 1))[0, 0, 0]


@pytest.mark.parametrize(
    ("r", "s", "t", "v", "w"), [(0.3, 0.2, 0.5, 0.4, -0.6), (0.1, 1.0, 0.5, 0.5, 0.6)]
)
def test_chain_of_three_to_rounding(r, s, t, v, w):
    turn = complex(math.sqrt(0.5), -math.sqrt(0.5))
    node, weight = np.polynomial.legendre.leggauss(60)
    x, part = 4.5 * (node + 1), 4.5 * weight * turn
    form = x**2 + 2j * turn * r * x
    inner = [
        np.exp(2 * c * x[:, None] * x - x**2 - 2j * turn * z * x) @ part
        for z, c in ((s, v), (t, w))
    ]
    truth = -8j * (part @ (np.exp(-form) * inner[0] * inner[1]))
    found = chained(*(number([value]) for value in (r, s, t, v, w)))
    assert abs(found.item() - truth) < 1e-11 * abs(truth)


def test_chain_of_a_pair_and_a_lone_edge_is_a_product():
    r, s, t = (number(values) for values in ([0.1, 9.0, 0.7], [30.0, 2.0, 0.0], [4.0, 0.1, 12.0]))
    w, none = number([0.9, -0.7, 0.3]), number([0.0, 0.0, 0.0])
    truth = corner_transition(r, s, w) * transition(t)
    for found in (chained(r, s, t, w, none), chained(s, r, t, w, none), chained(r, t, s, none, w)):
        assert ((found - truth).abs() / truth.abs()).max() < 1e-5


def test_rectangle_is_a_product_of_fresnel_integrals():
    """The straight wave and what the four edges send add up to the integral over the rectangle."""

    def strip(low, high):
        with mpmath.workdps(30):
            turn = mpmath.expjpi(0.25)
            return complex((mpmath.erfc(turn * low) - mpmath.erfc(turn * high)) / 2)

    left, right, low, high = -0.4, 2.3, -1.1, 0.7
    sides = {(right, high, -low), (-left, high, -low), (high, right, -left), (-low, right, -left)}
    total = 2 * math.sqrt(math.pi) * complex(math.sqrt(0.5), math.sqrt(0.5)) + 0j
    size = total
    for distance, first, second in sides:
        s = number(distance)
        sent = transition(s) - end_transition(s, number(first)) - end_transition(s, number(second))
        total -= (sent * torch.exp(-1j * s * s)).item()
    assert total / size == pytest.approx(strip(left, right) * strip(low, high), abs=1e-14)


def test_derivatives():
    torch.manual_seed(1)
    s = number([0.3, -1.0, 2.0, 5.0, -7.0]).requires_grad_()
    t = number([0.2, 1.0, -3.0, -0.1, 4.0]).requires_grad_()
    assert torch.autograd.gradcheck(transition, s, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(transition, s)
    assert torch.autograd.gradcheck(end_transition, (s, t), check_forward_ad=True)
    three = tuple(torch.rand(3, 2).double().requires_grad_() for _ in range(3))
    w = tuple(number(values).requires_grad_() for values in ([0.3, -0.5], [0.6, 0.2]))

    def chain(r, s, t, v, w):
        return chain_transition(r, [s, t], [v, w])

    assert torch.autograd.gradcheck(chain, (*three, *w), check_forward_ad=True)
    # One value for several ends.
    assert torch.autograd.gradcheck(end_transition, (s, t[:1]))


def test_at_a_corner_values_and_derivatives_are_finite():
    s, t = number(0.0).requires_grad_(), number(0.0).requires_grad_()
    for found in (transition(s), end_transition(s, t)):
        slopes = torch.autograd.grad(found.abs(), (s, t), allow_unused=True)
        assert all(bool(torch.isfinite(slope)) for slope in slopes if slope is not None)
