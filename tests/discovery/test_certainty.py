"""Error bars and kinds."""

import math

import pytest
import torch

from discovery.test_recordings import around, thing
from discovery.test_search import search_of
from invertwin.discovery.certainty import Rival, kind_probabilities, rivals, widened
from invertwin.discovery.shapes.primitives import Figure
from invertwin.scene import Scene, box


def test_a_rival_widens_the_place_and_shares_the_kinds():
    """Half a chance to be 6 cm away is a deviation of 6 cm times the root of a half."""
    search = search_of(Scene({"box": thing(box((0.3, 0.5, 0.3)), (0.0, 0.0), 0.25)}), around(4))
    one = search.fitted
    figure = Figure("person", (0.1, 0.2), 0.0, 0.66, 0.32, 1.7)
    turned = Figure("person", (0.16, 0.2), math.pi, 0.66, 0.32, 1.7)
    among = [Rival(figure, 0.5), Rival(turned, 0.5)]
    own = {"x": 0.004, "z": 0.003, "height": 0.3}
    found = widened(one, own, among)
    assert found["x"] == pytest.approx(math.hypot(0.004, 0.06 * math.sqrt(0.5)))
    assert found["z"] == pytest.approx(0.003)
    assert kind_probabilities(among) == {"person": 1.0}
    box_too = [*among, Rival(Figure("box", (0.1, 0.2)), 0.25)]
    assert kind_probabilities(box_too) == {"person": 1.0, "box": 0.25}
    # What hangs at the radar's height has its range to first order at any height.
    ball = Figure("sphere", (0.0, 0.0), 0.0, 0.3, 0.3, 0.6)
    hung = widened(one, own, [Rival(ball, 1.0)])
    assert hung["z"] == pytest.approx(math.hypot(0.003, 0.3**2 / (2 * 1.8)))


@pytest.mark.slow
def test_a_box_is_surely_a_box():
    search = search_of(Scene({"box": thing(box((0.5, 0.8, 0.3)), (0.0, 0.1), 0.4, 0.4)}))
    shapes = search.settled([Figure("box", (0.0, 0.1), 0.4, 0.5, 0.3, 0.8, 0.1)])
    (among,) = rivals(search.fitted, shapes)
    assert among[0].figure is shapes[0]
    assert sum(rival.weight for rival in among) == pytest.approx(1.0)
    assert among[0].weight > 0.9
    assert {rival.figure.kind for rival in among} == {"box", "cylinder", "sphere", "person"}
    assert torch.tensor([rival.weight for rival in among]).min() > 0
