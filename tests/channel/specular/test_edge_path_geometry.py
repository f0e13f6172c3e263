"""Paths over edges: where they turn, their derivatives, reciprocity, and edges in pieces."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from invertwin.channel.em.utd import conductor_coefficients
from invertwin.channel.em.wedges import Wedges, merge_collinear_wedges
from invertwin.channel.specular.edge_path_geometry import (
    PathEdge,
    diffract_over_edges,
    multiple_diffraction_points,
)
from invertwin.scene.material.fresnel import FieldCoefficients, fresnel_coefficients

K = 2 * math.pi


def number(value):
    return torch.tensor(value, dtype=torch.float64)


def wedge(start, end, into, opening=1.5):
    """One edge whose first face goes into a direction, with its outward normal axis × into."""
    start, end, into, angle = number(start), number(end), number(into), opening * math.pi
    axis = torch.nn.functional.normalize(end - start, dim=0)
    x = torch.nn.functional.normalize(into - (into @ axis) * axis, dim=0)
    y = torch.linalg.cross(axis, x)
    inwards = torch.stack([x, math.cos(angle) * x + math.sin(angle) * y])
    normals = torch.stack([y, math.sin(angle) * x - math.cos(angle) * y])
    faces = torch.zeros(1, 2, dtype=torch.int64)
    return Wedges(start[None], end[None], inwards[None], normals[None], number([opening]), faces)


# Two upright edges of a side y = 0 of a box, and the edge of a sheet that leans.
FIRST = wedge([0.0, 0.0, 3.0], [0.0, 0.0, -2.0], [-1.0, 0.0, 0.0])
SECOND = wedge([-4.0, 0.0, -2.0], [-4.0, 0.0, 3.0], [1.0, 0.0, 0.0])
LEANS = wedge([-4.0, 1.0, -2.0], [-4.4, 1.3, 3.0], [0.0, -1.0, 0.0], 2.0)
SKEW = wedge([-5.0, -1.0, -1.0], [-6.0, 0.5, 2.0], [1.0, 1.0, 0.0])
TX, RX = number([[3.0, -2.0, 0.4]]), number([[-7.0, -3.0, 1.1]])


def lossy(face, cosine):
    found = fresnel_coefficients(number(5.0) - 0.3j, cosine)
    none = torch.zeros_like(found.reflection_s)
    return found._replace(transmission_s=none, transmission_p=none)


def grazing():
    """The two edges of the box's side, which is the first face of both, in the wave's order."""
    zero = number([0.0])
    return [PathEdge(FIRST, azimuth=zero), PathEdge(SECOND, azimuth_in=zero)]


def test_one_edge_is_met_at_equal_angles():
    found = diffract_over_edges([PathEdge(FIRST)], TX, RX, K)
    point = found.points[0, 0]
    before, after = (
        torch.nn.functional.normalize(p, dim=-1) for p in (point - TX[0], RX[0] - point)
    )
    assert abs(before[2] - after[2]) < 1e-14


def test_path_over_two_edges_is_the_shortest():
    found = diffract_over_edges([PathEdge(FIRST), PathEdge(LEANS)], TX, RX, K)
    assert bool(found.stationary)

    def length(first, second):
        points = [
            TX[0],
            FIRST.start[0] + first * (FIRST.end - FIRST.start)[0],
            LEANS.start[0] + second * (LEANS.end - LEANS.start)[0],
            RX[0],
        ]
        return sum((b - a).norm() for a, b in pairwise(points))

    grid = torch.linspace(0, 1, 41, dtype=torch.float64)
    least = min(length(a, b) for a in grid for b in grid)
    assert found.length <= least
    assert least - found.length < 5e-3


def test_paths_back_are_the_same():
    edges = grazing()
    cases = {
        "one": ([PathEdge(FIRST, lossy)], [PathEdge(FIRST, lossy)]),
        "free": ([PathEdge(FIRST), PathEdge(LEANS)], [PathEdge(LEANS), PathEdge(FIRST)]),
        "three": (
            [PathEdge(FIRST, lossy), PathEdge(LEANS), PathEdge(SKEW)],
            [PathEdge(SKEW), PathEdge(LEANS), PathEdge(FIRST, lossy)],
        ),
        "lossy": (
            [PathEdge(FIRST, lossy), PathEdge(LEANS)],
            [PathEdge(LEANS), PathEdge(FIRST, lossy)],
        ),
        "face": (
            edges,
            [
                PathEdge(SECOND, azimuth=edges[0].azimuth),
                PathEdge(FIRST, azimuth_in=edges[0].azimuth),
            ],
        ),
    }
    for name, (there, back) in cases.items():
        sent, returned = diffract_over_edges(there, TX, RX, K), diffract_over_edges(back, RX, TX, K)
        scale = sent.transfer.abs().max()
        assert scale > 1e-6, name
        assert (sent.transfer - returned.transfer.mT).abs().max() < 1e-12 * scale, name


@pytest.mark.parametrize(
    ("off", "endless", "most"),
    # Endless edges, the transmitter's wave grazing or not, and edges with ends.
    [(-2.0, True, 0.005), (-0.2, True, 0.005), (-2.0, False, 0.03)],
)
def test_second_edge_takes_over_where_the_first_one_hides(off, endless, most):
    """Behind the plane of the side the wave of the first edge ends; both together do not jump."""
    tx = number([[3.0, off, 0.4]])
    edges = [replace(edge, infinite=endless) for edge in grazing()]

    def field(height):
        rx = number([[-9.0, height, 0.9]])
        sent = diffract_over_edges(edges, tx, rx, K)
        total = sent.transfer * torch.exp(-1j * K * sent.length)
        if height > 0:
            once = diffract_over_edges([PathEdge(FIRST, infinite=endless)], tx, rx, K)
            total = total + once.transfer * torch.exp(-1j * K * once.length)
        return total[0], sent.transfer[0]

    above, alone_above = field(1e-7)
    below, alone_below = field(-1e-7)
    assert (alone_above - alone_below).norm() > 10 * (above - below).norm()
    assert (above - below).norm() < most * below.norm()


def test_third_edge_takes_over_where_the_second_one_hides():
    """Behind the plane of the next side; with a wave that grazes the first side or does not."""
    third = wedge([-4.0, -4.0, -2.0], [-4.0, -4.0, 3.0], [0.0, 1.0, 0.0])
    zero, last = number([0.0]), number([1.5 * math.pi])
    for off in (-2.0, -0.2):
        tx = number([[3.0, off, 0.4]])
        first, second = (replace(edge, infinite=True) for edge in grazing())
        edges = [
            first,
            replace(second, azimuth=last),
            PathEdge(third, azimuth_in=zero, infinite=True),
        ]
        fields = []
        for aside in (-1e-7, 1e-7):
            rx = number([[-4.0 + aside, -9.0, 0.9]])
            sent, twice = (
                diffract_over_edges(some, tx, rx, K) for some in (edges, [first, second])
            )
            fields.append([s.transfer * torch.exp(-1j * K * s.length) for s in (sent, twice)])
        (before, lost), (after, _) = fields
        assert (after - before - lost).norm() < 0.005 * lost.norm()
        back = [
            PathEdge(third, azimuth=zero, infinite=True),
            PathEdge(SECOND, azimuth_in=last, azimuth=zero, infinite=True),
            PathEdge(FIRST, azimuth_in=zero, infinite=True),
        ]
        returned = diffract_over_edges(back, rx, tx, K).transfer.mT
        assert (sent.transfer - returned).abs().max() < 1e-12 * returned.abs().max()


def test_path_over_edges_that_meet_is_found():
    """Both edges begin in the corner; the path touches them beside it."""
    corner, along, down = (number(p) for p in ([0.0, 0, 0], [4.0, 0, 0], [0, -4.0, 0]))
    edges = [wedge(corner.tolist(), end.tolist(), [1.0, -1.0, 0.0]) for end in (along, down)]
    tx, rx = number([[9.0, 4.0, 0.8]]), number([[-3.0, -2.0, -1.0]])
    points, stationary = multiple_diffraction_points(edges, tx, rx)
    assert bool(stationary)
    assert points[0, 0, 0] > 0.5
    assert points[0, 1, 1] < -0.2


def test_edge_in_pieces_is_the_whole_edge():
    lower = Wedges(**(vars(FIRST) | {"start": number([[0.0, 0.0, 0.5]])}))
    upper = Wedges(**(vars(FIRST) | {"end": number([[0.0, 0.0, 0.5]])}))
    whole = diffract_over_edges([PathEdge(FIRST)], TX, RX, K).transfer
    parts = [diffract_over_edges([PathEdge(piece)], TX, RX, K).transfer for piece in (lower, upper)]
    assert (whole - sum(parts)).abs().max() < 1e-14
    both = Wedges(
        *(
            torch.cat(column)
            for column in zip(vars(upper).values(), vars(lower).values(), strict=True)
        )
    )
    joined = merge_collinear_wedges(both)
    assert len(joined.start) == 1
    assert (diffract_over_edges([PathEdge(joined)], TX, RX, K).transfer - whole).abs().max() < 1e-14


def test_edges_of_other_planes_stay_apart():
    both = Wedges(
        *(
            torch.cat(column)
            for column in zip(vars(FIRST).values(), vars(LEANS).values(), strict=True)
        )
    )
    assert len(merge_collinear_wedges(both).start) == 2


def test_long_edge_is_endless():
    long = Wedges(
        **(vars(FIRST) | {"start": number([[0.0, 0.0, 1e6]]), "end": number([[0.0, 0.0, -1e6]])})
    )
    ended = diffract_over_edges([PathEdge(long)], TX, RX, K).transfer
    endless = diffract_over_edges([PathEdge(FIRST, infinite=True)], TX, RX, K).transfer
    # What the ends send falls with the root of the distance of waves in phase.
    assert (ended - endless).norm() < 1e-3 * endless.norm()
    assert (
        diffract_over_edges([PathEdge(FIRST)], TX, RX, K).transfer - endless
    ).norm() > 0.02 * endless.norm()


@pytest.mark.slow
def test_derivatives():
    edges = grazing()

    def whole(tx, rx, end):
        at = Wedges(**(vars(FIRST) | {"end": end}))
        once = diffract_over_edges([PathEdge(at, lossy)], tx, rx, K)
        twice = diffract_over_edges([PathEdge(at), PathEdge(LEANS)], tx, rx, K)
        along = diffract_over_edges([PathEdge(at, azimuth=edges[0].azimuth), edges[1]], tx, rx, K)
        thrice = diffract_over_edges([PathEdge(at), PathEdge(LEANS), PathEdge(SKEW)], tx, rx, K)
        sloped = diffract_over_edges([PathEdge(at)], tx, rx, K, slopes=True).slopes
        assert sloped is not None
        fields = (once.transfer, twice.transfer, along.transfer, thrice.transfer, *sloped)
        sent = torch.stack(fields)
        return torch.view_as_real(sent.sum((1, 2, 3)))

    values = tuple(value.clone().requires_grad_() for value in (TX, RX, FIRST.end))
    found = torch.autograd.functional.jacobian(whole, values)
    with torch.no_grad():
        for index, slopes in enumerate(found):
            for axis in range(3):
                step = torch.zeros(1, 3, dtype=torch.float64)
                step[0, axis] = 1e-5
                ends = [
                    whole(*(v + sign * step * (n == index) for n, v in enumerate(values)))
                    for sign in (1.0, -1.0)
                ]
                truth = (ends[0] - ends[1]) / 2e-5
                torch.testing.assert_close(slopes[..., 0, axis], truth, rtol=1e-6, atol=1e-8)


def test_a_body_of_air_does_not_diffract():
    def air(face, cosine):
        one = torch.ones_like(cosine).to(torch.complex128)
        return FieldCoefficients(0 * one, 0 * one, one, one)

    sheet = Wedges(**(vars(LEANS)))
    sent = diffract_over_edges([PathEdge(sheet, air)], TX, RX, K).transfer
    assert sent.abs().max() < 1e-15
    assert (
        diffract_over_edges([PathEdge(sheet, conductor_coefficients)], TX, RX, K)
        .transfer.abs()
        .max()
        > 1e-4
    )
