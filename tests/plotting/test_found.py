"""The picture of a twin shows things, blind places and movers."""

import numpy as np
import torch

from invertwin.discovery import DetectedObject, GroundImage, ShapeParameters, Twin
from invertwin.plotting import found


def test_the_ground_shows_things_movers_and_blind_places():
    places = torch.cartesian_prod(*[torch.arange(3, dtype=torch.float64)] * 2)
    views = torch.tensor([0, 1, 2, 3, 0, 1, 2, 3, 4])
    picture = GroundImage(places, torch.arange(9, dtype=torch.float64), views)
    still = torch.tensor([1.5, 0.5, 0.4], dtype=torch.float64)
    figure = ShapeParameters("box", (0.5, 1.5), 0.2, 0.6, 0.3, 0.8, 0.1)
    spread = {"x": 0.2, "y": 0.1}
    box = DetectedObject("object_1", "box", {"box": 1.0}, still, figure, spread, 0.99)
    moved = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    mover = DetectedObject(
        "mover_1", "point", {"point": 1.0}, 2 * moved, None, {"range": 0.1}, 0.4, moved
    )
    drawn = found.ground(Twin((box, mover), 0.0, picture))
    axes = drawn.axes[0]
    texts = [text.get_text() for text in axes.texts]
    assert "object_1: box" in texts
    assert "mover_1: point" in texts
    seen, blind = axes.collections
    assert len(np.asarray(seen.get_offsets())) == 7
    assert len(np.asarray(blind.get_offsets())) == 2
    (ellipse,) = axes.patches
    assert (ellipse.width, ellipse.height) == (0.4, 0.8)
    outline = np.asarray(axes.lines[0].get_xydata())
    assert len(outline) == 5
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("y [m], to the left", "x [m]")
    left, right = axes.get_xlim()
    assert left > right


def test_a_place_that_is_unknown_does_not_stretch_the_ground():
    places = torch.cartesian_prod(*[torch.arange(3, dtype=torch.float64)] * 2)
    picture = GroundImage(places, torch.ones(9, dtype=torch.float64), torch.ones(9).long())
    at = torch.tensor([1.0, 1.0, 0.4], dtype=torch.float64)
    lost = DetectedObject("object_1", "point", {"point": 1.0}, at, None, {"x": 20.0, "y": 20.0}, 1)
    axes = found.ground(Twin((lost,), 0.0, picture)).axes[0]
    (ellipse,) = axes.patches or axes.artists
    assert ellipse.width == 80.0
    for low, high in (sorted(axes.get_xlim()), axes.get_ylim()):
        assert -1.0 < low < 0.0
        assert 2.0 < high < 3.0
