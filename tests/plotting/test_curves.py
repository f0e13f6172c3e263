"""Figures of curves show the numbers of fits and lines."""

import numpy as np
import pytest

from invertwin import plotting

LOSSES = {"full": [[1.0, 0.5], [0.9, 0.4]], "interior": [[1.0, 0.01]]}


def data(axes):
    return [line.get_ydata().tolist() for line in axes.lines]


def legend(axes):
    return [text.get_text() for text in axes.get_legend().get_texts()]


def test_every_fit_is_a_line_and_every_way_a_colour():
    (axes,) = plotting.convergence(LOSSES, annealed=1.0, before=0.7).axes
    assert data(axes) == [[1.0, 0.5], [0.9, 0.4], [1.0, 0.01], [0.7]]
    first, second, third, _ = axes.lines
    assert first.get_color() == second.get_color() == plotting.PALETTE[0]
    assert third.get_color() == plotting.PALETTE[1]
    assert axes.get_yscale() == "log"
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("step", "loss")
    (shade,) = axes.patches
    assert shade.get_extents().transformed(axes.transData.inverted()).width == pytest.approx(1.0)
    assert legend(axes) == [
        *("full (2)", "interior (1)", "blur is reduced to 0: losses not comparable"),
        "start, without blur",
    ]


def test_losses_of_one_fit_need_no_name():
    (axes,) = plotting.convergence([0.5, 0.4, 0.3]).axes
    assert data(axes) == [[0.5, 0.4, 0.3]]
    assert axes.get_yscale() == "linear"
    (axes,) = plotting.convergence({}).axes
    assert data(axes) == []
    assert axes.get_legend() is None


def test_errors_stand_beside_the_losses():
    errors = {"full": [[[0, 0.2], [10, 0.1]], []], "interior": [[[0, 0.4]]]}
    left, right = plotting.convergence(LOSSES, errors, error_label="error [m]").axes
    assert data(left) == [[1.0, 0.5], [0.9, 0.4], [1.0, 0.01]]
    assert [line.get_xydata().tolist() for line in right.lines] == [
        [[0, 0.2], [10, 0.1]],
        [],
        [[0, 0.4]],
    ]
    assert right.get_ylim() == pytest.approx((0, 0.42))
    assert right.get_ylabel() == "error [m]"
    assert legend(right) == ["full", "interior"]


def test_a_landscape_counts_its_minima():
    x = np.linspace(-1, 1, 201)
    ripples = 1 - np.cos(20 * np.pi * x)
    figure = plotting.landscape((x, ripples), {"wide": (x, x**2)}, "plate along z")
    left, right = figure.axes
    for axes, places, losses in ((left, 1e3 * x, ripples), (right, x, x**2)):
        drawn = np.asarray(axes.lines[0].get_xydata())
        np.testing.assert_allclose(drawn, np.stack([places, losses], 1))
    assert left.get_title() == "exact signal: 19 local minima"
    assert legend(right) == ["wide (1)"]
    assert "plate along z" in left.get_xlabel()
    assert "[mm]" in left.get_xlabel()


@pytest.mark.parametrize(
    ("values", "count"), [([0, 1, 2], 0), ([1, 0, 1], 1), ([2, 0, 1, 0, 2], 2), ([1, 0, 0, 1], 0)]
)
def test_a_minimum_is_lower_than_both_neighbours(values, count):
    assert plotting.count_minima(np.array(values)) == count


def test_figures_repeat_byte_for_byte():
    first, second = (plotting.png_bytes(plotting.convergence({"a": [[1.0]]})) for _ in range(2))
    assert first == second
    assert first[:8] == b"\x89PNG\r\n\x1a\n"
