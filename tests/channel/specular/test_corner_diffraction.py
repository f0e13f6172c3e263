"""Waves that go on round corners: no step where an end is hidden, reciprocity, derivatives."""

import math

import pytest
import torch

from invertwin.channel.em.utd import conductor_coefficients
from invertwin.channel.em.wedges import Wedges
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.topology import topology_of
from invertwin.channel.specular.corner_diffraction import diffract_round_corner
from invertwin.channel.specular.diffracted_paths import evaluate_diffracted_paths
from invertwin.channel.specular.diffraction_candidates import find_diffraction_candidates
from invertwin.channel.specular.edge_path_geometry import PathEdge, diffract_over_edges
from invertwin.channel.specular.image_method import CandidateSurfaces, FaceInteractions
from invertwin.channel.specular.wedge_scene import WedgeScene
from invertwin.scene import box

K = 2 * math.pi


def number(value):
    return torch.tensor(value, dtype=torch.float64)


def wedge(start, end, first, second):
    """An edge of a box between faces that go into two directions from it."""
    inwards = number([first, second])
    normals = torch.stack([-inwards[1], -inwards[0]])
    columns = (number([start]), number([end]), inwards[None], normals[None], number([1.5]))
    return Wedges(*columns, faces=torch.zeros(1, 2, dtype=torch.int64))


# Two edges of the side z = 0 of a box in x < 0, y < 0, z < 0, which meet in the origin.
SENDS = wedge([-4.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0])
NEXT = wedge([0.0, 0.0, 0.0], [0.0, -4.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0])
END, FACES = torch.tensor([1]), torch.tensor([[0, 1]])


def both(rx, tx):
    """The first edge alone, and on round the next."""
    zero, last = number([0.0]), number([1.5 * math.pi])
    alone = diffract_over_edges([PathEdge(SENDS)], tx, rx, K)
    edges = [PathEdge(SENDS, azimuth=zero), PathEdge(NEXT, azimuth_in=last)]
    return alone, diffract_round_corner(edges, END, FACES, tx, rx, K)


@pytest.mark.parametrize(("aside", "most"), [(-10.0, 0.1), (0.5, 1e-5), (3.0, 1e-5)])
def test_hidden_end_leaves_no_step(aside, most):
    """The ray of the first edge turns before or past its end; the side's plane is crossed there.

    Before the end, a path over both edges has the rest.
    """
    tx = number([[aside, 9.0, 5.0]])
    above, below = number([[7.0, -8.0, 1e-7]]), number([[7.0, -8.0, -1e-7]])
    alone, onwards = both(above, tx)
    before = float(alone.points[0, 0, 0]) < 0
    assert before == (aside < 0)
    lost = alone.transfer
    assert lost.abs().max() > 1e-4
    step = lost + onwards.transfer - both(below, tx)[1].transfer
    if before:
        assert step.abs().max() > 0.2 * lost.abs().max()
        edges = [
            PathEdge(SENDS, azimuth=number([0.0])),
            PathEdge(NEXT, azimuth_in=number([1.5 * math.pi])),
        ]
        over = [diffract_over_edges(edges, tx, rx, K).transfer for rx in (above, below)]
        step = step + over[0] - over[1]
    assert step.abs().max() < most * lost.abs().max()


def test_waves_far_from_the_corner_or_off_the_side_do_not_meet_it():
    tx = number([[-9.0, 9.0, 5.0]])
    alone, onwards = both(number([[1.0, -8.0, -0.5]]), tx)
    assert onwards.transfer.abs().max() < 1e-2 * alone.transfer.abs().max()
    # Straight down from the corner: a right angle off the side.
    assert both(number([[0.0, 0.0, -5.0]]), tx)[1].transfer.abs().max() == 0


def test_derivatives():
    def value(tx, rx, end):
        sends = Wedges(**(vars(SENDS) | {"end": end}))
        edges = [
            PathEdge(sends, azimuth=number([0.0])),
            PathEdge(NEXT, azimuth_in=number([1.5 * math.pi])),
        ]
        return torch.view_as_real(diffract_round_corner(edges, END, FACES, tx, rx, K).transfer)

    given = number([[0.5, 9.0, 5.0]]), number([[7.0, -8.0, -2.0]]), SENDS.end.clone()
    assert torch.autograd.gradcheck(value, tuple(v.requires_grad_() for v in given))


def whole(tx, rx, order, *, corners=True):
    """What the edges of a box send."""
    mesh = box((5.0, 3.0, 4.0))
    topology = topology_of([mesh])
    none = FaceInteractions(*torch.zeros(2, len(topology.faces), dtype=torch.bool))
    walls = CandidateSurfaces(mesh.vertices, topology, tx, none)
    around = WedgeScene(
        mesh.vertices, topology, walls, lambda _, cosine: conductor_coefficients(0, cosine)
    )
    total = torch.zeros(len(rx), 3, 3, dtype=torch.complex128)
    with tracing():
        for bends in find_diffraction_candidates(around, tx, rx, order, 0, None, 0):
            if corners or bends.corner is None:
                sent = evaluate_diffracted_paths(around, bends, tx, rx, K)
                turn = torch.polar(torch.ones_like(sent.length), -K * sent.length)
                total = total.index_add(0, sent.rx, sent.transfer * turn[:, None, None])
    return total


def test_field_behind_a_box_has_no_step_in_the_plane_of_a_side():
    tx = number([[9.0, 5.3, 1.1]])
    rx = number([[-5.5, -1.5 - 1e-7, 0.7], [-5.5, -1.5 + 1e-7, 0.7]])

    def step(order, corners):
        field = whole(tx, rx, order, corners=corners)
        return float((field[1] - field[0]).norm() / field[0].norm())

    steps = [step(2, corners=False), step(3, corners=False), step(3, corners=True)]
    assert steps[0] > 0.1
    assert steps[2] < 0.03
    assert steps[2] < 0.5 * steps[1]


def test_reciprocity():
    tx, rx = number([[9.0, 5.3, 3.1]]), number([[-6.0, -2.1, 0.7]])
    there, back = whole(tx, rx, 3), whole(rx, tx, 3)
    assert (whole(tx, rx, 3, corners=False) - there).norm() > 1e-3 * there.norm()
    assert (there - back.mT).norm() < 1e-9 * there.norm()
