"""Error bars and kinds."""

import math

import pytest
import torch

from discovery.test_recordings import around, thing
from discovery.test_search import search_of
from invertwin.discovery.certainty import (
    ShapeHypothesis,
    find_hypotheses,
    kind_probabilities,
    widen_deviations,
)
from invertwin.discovery.shapes.primitives import ShapeParameters
from invertwin.scene import Scene, box


def test_a_rival_widens_the_place_and_shares_the_kinds():
    """Half a chance to be 6 cm away is a deviation of 6 cm times the root of a half."""
    search = search_of(Scene({"box": thing(box((0.3, 0.3, 0.5)), (0.0, 0.0), 0.25)}), around(4))
    one = search.fitted_frames
    figure = ShapeParameters("person", (0.1, 0.2), 0.0, 0.32, 0.66, 1.7)
    turned = ShapeParameters("person", (0.16, 0.2), math.pi, 0.32, 0.66, 1.7)
    among = [ShapeHypothesis(figure, 0.5), ShapeHypothesis(turned, 0.5)]
    own = {"x": 0.004, "y": 0.003, "height": 0.3}
    found = widen_deviations(one, own, among)
    assert found["x"] == pytest.approx(math.hypot(0.004, 0.06 * math.sqrt(0.5)))
    assert found["y"] == pytest.approx(0.003)
    assert kind_probabilities(among) == {"person": 1.0}
    box_too = [*among, ShapeHypothesis(ShapeParameters("box", (0.1, 0.2)), 0.25)]
    assert kind_probabilities(box_too) == {"person": 1.0, "box": 0.25}
    # What hangs at the radar's height has its range to first order at any height.
    ball = ShapeParameters("sphere", (0.0, 0.0), 0.0, 0.3, 0.3, 0.6)
    hung = widen_deviations(one, own, [ShapeHypothesis(ball, 1.0)])
    assert hung["y"] == pytest.approx(math.hypot(0.003, 0.3**2 / (2 * 1.8)))


@pytest.mark.claim
@pytest.mark.slow
def test_a_box_is_surely_a_box():
    search = search_of(Scene({"box": thing(box((0.3, 0.5, 0.8)), (0.1, 0.0), 0.4, 0.4)}))
    shapes = search.refine([ShapeParameters("box", (0.1, 0.0), 0.4, 0.3, 0.5, 0.8, 0.1)])
    (among,) = find_hypotheses(search.fitted_frames, shapes)
    assert among[0].shape is shapes[0]
    assert sum(rival.probability for rival in among) == pytest.approx(1.0)
    assert among[0].probability > 0.9
    assert {rival.shape.kind for rival in among} == {"box", "cylinder", "sphere", "person"}
    assert torch.tensor([rival.probability for rival in among]).min() > 0
