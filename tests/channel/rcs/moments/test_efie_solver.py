"""Small conductors whose currents are solved on triangles, with derivatives."""

import math
import warnings

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from invertwin import Object, Scene, rcs
from invertwin.channel import SphereSection
from invertwin.channel.rcs.moments import efie_solver as meshed
from invertwin.channel.rcs.moments.solver import Refusal
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError, PhysicsWarning
from invertwin.scene import (
    Mesh,
    PerfectConductor,
    box,
    dihedral,
    merge_meshes,
    plate,
    rigid,
    sphere,
)
from invertwin.signatures import aspect_directions
from scenes import float64

METAL = PerfectConductor()


def from_front(theta: float | list[float], phi: float) -> Tensor:
    """Directions at angles θ to x, which plates are square to, and φ about it."""
    return aspect_directions(theta, phi)[:, [2, 0, 1]]


TOWARDS = from_front([0.4, 2.5], 0.3)


def metal(mesh: Mesh) -> Scene:
    return Scene({"target": Object(mesh, METAL)})


def test_a_coarse_ball_is_that_of_mie():

    ball = sphere(0.5, 3)
    target = meshed.EFIESolver(
        ball.vertices, ball.faces, torch.ones(len(ball.faces), dtype=torch.bool), TOWARDS[0]
    )
    k = 4.0
    found = target.solve_scattering(k, [(TOWARDS, TOWARDS)])
    assert not isinstance(found, Refusal)
    frequency = float64([k * SPEED_OF_LIGHT / (2 * math.pi)])
    truth = SphereSection(0.5).section(frequency, TOWARDS)[0]
    error = 10 * torch.log10(
        4 * math.pi * found[0].diagonal(dim1=1, dim2=2).abs() ** 2 / truth[:, None]
    )
    assert float(error.abs().max()) < 0.3


@pytest.mark.parametrize("mesh", [plate(1.1, 0.8), dihedral(0.9, 1.4), box((0.8, 0.9, 1.0))])
@pytest.mark.filterwarnings("ignore::invertwin.errors.PhysicsWarning")
def test_derivatives_are_those_of_the_solution(mesh):
    """Forward and reverse mode against differences, with separate antennas; a wavelength is 1 m."""
    move = (
        torch.randn(mesh.vertices.shape, generator=torch.Generator().manual_seed(3)).double() / 10
    )

    def power(vertices: Tensor) -> Tensor:
        scene = metal(Mesh(vertices, mesh.faces))
        received = from_front([1.4, 2.0], 1.3)
        found = rcs(scene, TOWARDS, SPEED_OF_LIGHT, receivers=received)
        assert "rest" in found.parts
        return found.matrix.abs().square().flatten()

    start = mesh.vertices.clone()
    step = 1e-5
    difference = (power(start + step * move) - power(start - step * move)) / (2 * step)
    with forward_ad.dual_level():
        value, forward = forward_ad.unpack_dual(power(forward_ad.make_dual(start, move)))
    assert torch.equal(value, power(start))
    torch.testing.assert_close(forward, difference, rtol=1e-6, atol=1e-7)
    assert forward is not None
    weight = torch.linspace(1, 2, len(forward)).double()
    start.requires_grad_()
    (gradient,) = torch.autograd.grad((weight * power(start)).sum(), start)
    assert float((gradient * move).sum()) == pytest.approx(
        float((weight * forward).sum()), rel=1e-9
    )


@pytest.mark.filterwarnings("ignore::invertwin.errors.PhysicsWarning")
def test_antennas_may_be_exchanged():
    bent = metal(dihedral(0.8, 1.4))
    received = from_front([1.4, 2.0], 1.3)
    there = rcs(bent, TOWARDS, SPEED_OF_LIGHT, receivers=received).matrix
    back = rcs(bent, received, SPEED_OF_LIGHT, receivers=TOWARDS).matrix
    assert float((there - back.mT).abs().max()) < 1e-6 * float(there.abs().max())


def test_a_box_at_a_resonance_of_its_inside(monkeypatch):
    """At a side of √5/2 wavelengths the equation alone says nothing about some currents."""
    side = math.sqrt(5) / 2
    changes = []
    for places in (160, 0):
        monkeypatch.setattr(meshed, "_MAX_INTERIOR_POINTS", places or 160)
        cube = box((side,) * 3)
        solid = torch.full((12,), places > 0)
        target = meshed.EFIESolver(cube.vertices, cube.faces, solid, float64([0.0, 0.0, 1.0]))
        mesh = target.elements(2 * math.pi)
        assert not isinstance(mesh, Refusal)
        equations = [meshed._EFIEEquation(target, mesh, 2 * math.pi * f) for f in (0.999, 1.0)]
        first, second = (equation.solve_currents(TOWARDS) for equation in equations)
        changes.append(float((second - first).abs().max() / first.abs().max()))
    assert changes[0] < 0.1 * changes[1]


def test_what_crosses_is_left_to_bounces():
    crossing = merge_meshes(
        [plate(0.8, 0.8), Mesh(plate(0.8, 0.8).vertices[:, [2, 1, 0]], plate(0.8, 0.8).faces)]
    )
    for mesh, edges, reasons in (
        (crossing, 2, ["no valid triangles, as surfaces cross or touch"]),
        (crossing, 0, []),
        (plate(9.0, 9.0), 2, []),
    ):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            assert "rest" not in rcs(metal(mesh), TOWARDS, SPEED_OF_LIGHT, edges=edges).parts
        texts = [str(w.message) for w in caught if "currents not solved" in str(w.message)]
        assert [text.partition("because ")[2].partition(":")[0] for text in texts] == reasons


@pytest.mark.filterwarnings("ignore::invertwin.errors.PhysicsWarning")
def test_derivatives_of_seams_are_refused():
    beside = Scene(
        {
            "right": Object(plate(0.8, 0.8), METAL),
            "left": Object(plate(0.8, 0.8), METAL, rigid(translation=float64([0.0, 0.8, 0.0]))),
        }
    )
    found = rcs(beside, TOWARDS, SPEED_OF_LIGHT)
    assert "rest" in found.parts
    leaf = plate(0.8, 0.8)
    every = torch.cat([leaf.vertices, leaf.vertices + float64([0.0, 0.8, 0.0])])
    faces = torch.cat([leaf.faces, leaf.faces + len(leaf.vertices)])
    places, index = every.round(decimals=9).unique(dim=0, return_inverse=True)
    assert len(places) == 6
    whole = rcs(metal(Mesh(places, index[faces])), TOWARDS, SPEED_OF_LIGHT).matrix
    assert float((found.matrix - whole).abs().max()) < 1e-6 * float(whole.abs().max())
    place = float64([0.0, 0.8, 0.0]).requires_grad_()
    moved = Scene(
        dict(beside.objects) | {"left": Object(plate(0.8, 0.8), METAL, rigid(translation=place))}
    )
    with pytest.raises(InputError, match="merge the vertices, or give edges=0"):
        rcs(moved, TOWARDS, SPEED_OF_LIGHT)


def test_currents_that_do_not_keep_the_power_are_not_used(monkeypatch):
    monkeypatch.setattr(meshed, "power_error", lambda *_: 0.3)
    reason = (
        r"at 0\.2998 GHz currents not solved, because power balance off by 30\.0% on triangles:"
    )
    with pytest.warns(PhysicsWarning, match=reason):
        found = rcs(metal(plate(0.8, 0.8)), from_front(0.4, 0.3), SPEED_OF_LIGHT)
    assert "rest" not in found.parts
