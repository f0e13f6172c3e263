"""Free outlines in place of simple shapes."""

import math
from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch

import invertwin as iw
from discovery.test_recordings import around
from discovery.test_search import search_of
from invertwin.discovery.search import ShapeSearch
from invertwin.discovery.shapes.outlines import fit_outlines
from invertwin.discovery.shapes.primitives import ShapeParameters
from invertwin.discovery.shapes.prisms import PrismParameters, prism_contour
from invertwin.scene import Mesh, RoughDielectric, box

CORNERS = ((-0.3, -0.4), (-0.2, 0.5), (0.5, -0.1))


def wedge(corners: Sequence[tuple[float, float]], height: float) -> Mesh:
    """A prism over a convex polygon on the ground that runs from y towards x."""
    n = len(corners)
    rows = [(x, y, z) for z in (0.0, height) for x, y in corners]
    faces = [[0, k, k + 1] for k in range(1, n - 1)]
    faces += [[n, n + k + 1, n + k] for k in range(1, n - 1)]
    for k in range(n):
        a, b = k, (k + 1) % n
        faces += [[b, a, a + n], [b + n, b, a + n]]
    return Mesh(torch.tensor(rows, dtype=torch.float64), torch.tensor(faces))


def search_for(mesh: Mesh, count: int) -> ShapeSearch:
    """A search of one thing, from places around it."""
    things = {"thing": iw.Object(mesh, RoughDielectric(permittivity=4.0))}
    return search_of(iw.Scene(things), around(count))


def overlap(prism: PrismParameters, corners: Sequence[tuple[float, float]]) -> float:
    """Intersection over union of the outline with a convex polygon."""
    line = torch.linspace(-0.8, 0.8, 161, dtype=torch.float64)
    places = torch.cartesian_prod(line, line)

    def inside(polygon: torch.Tensor) -> torch.Tensor:
        angle = torch.atan2(*(polygon - places[:, None]).unbind(2)[::-1])
        turn = (angle.roll(-1, 1) - angle + math.pi).remainder(2 * math.pi) - math.pi
        return turn.sum(1).abs() > math.pi

    first = inside(prism_contour(prism))
    second = inside(torch.tensor(corners, dtype=torch.float64))
    return float((first & second).sum()) / float((first | second).sum())


@pytest.mark.slow
def test_a_triangle_in_four_pieces_becomes_one_prism():
    search = search_for(wedge(CORNERS, 0.8), 24)
    assert search.held_out_frames is not None
    pieces = [
        ShapeParameters("box", (-0.1, 0.0), 0.0, 0.28, 0.65, 0.8, 0.05),
        ShapeParameters("box", (0.2, -0.07), 0.0, 0.3, 0.23, 0.8, 0.05),
        ShapeParameters("cylinder", (-0.17, 0.42), 0.0, 0.12, 0.12, 0.8, 0.05),
        ShapeParameters("corner", (0.48, -0.1), 1.2, height=0.8, brightness=2.0),
    ]
    # After 20 steps the corner lies 2.0 range cells off: rounding decides whether it touches.
    pieces, _ = search.fitted_frames.fit(pieces, 15)
    (found,) = fit_outlines(search.fitted_frames, search.held_out_frames, pieces)
    assert isinstance(found, PrismParameters)
    assert overlap(found, CORNERS) > 0.85
    middle = [0.5 * (min(row) + max(row)) for row in zip(*CORNERS, strict=True)]
    assert math.dist(found.position, middle) < 0.03
    gains = [
        float(search.held_out_frames.log_likelihood_gains(shapes).sum())
        for shapes in ([found], pieces)
    ]
    assert gains[0] > gains[1] + 5


@pytest.mark.slow
def test_a_box_stays_a_box_and_others_are_left_alone():
    search = search_for(box((0.4, 0.7, 1.2)), 12)
    assert search.held_out_frames is not None
    true = ShapeParameters("box", (0.0, 0.0), 0.0, 0.4, 0.7, 0.6, 0.05)
    (settled,) = search.refine([true])
    assert fit_outlines(search.fitted_frames, search.held_out_frames, [settled]) == [settled]
    # Too small for an outline, thin, or a person: nothing is tried.
    for other in (
        replace(true, length=0.2, width=0.2),
        replace(true, kind="wall", length=0.02),
        replace(true, kind="person"),
    ):
        assert fit_outlines(search.fitted_frames, search.held_out_frames, [other]) == [other]
