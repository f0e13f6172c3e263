"""Tubes inside of solids: against clipped beams, the Mie series, and optics of single spheres."""

import math

import pytest
import torch
from torch import Tensor

import invertwin as iw
from invertwin.channel import SphereSection
from invertwin.channel.beams.beam_tracing import build_facets
from invertwin.channel.rays.topology import topology_of
from invertwin.channel.rcs import far_field as signature
from invertwin.channel.rcs.rays_in_dielectrics import (
    _fit_wave_vector,
    _spreading_factor,
    group_smooth_faces,
)
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError, PhysicsWarning
from invertwin.scene import (
    Mesh,
    Object,
    PerfectConductor,
    RefractingBody,
    Scene,
    box,
    plate,
    rigid,
    rotation_from_vector,
    sphere,
)
from invertwin.scene.shapes import cylinder
from invertwin.signatures import Signature
from scenes import complex128, float64

METAL = PerfectConductor()
RADIUS = 0.1


def turned(place: object, angle: object = (0.0, 0.0, 0.0)) -> Tensor:
    return rigid(rotation_from_vector(float64(angle)), float64(place))


def before_metal(loss: float) -> Scene:
    block = box((0.02, 0.03, 0.03))
    body = RefractingBody(2.5, loss_tangent=loss)
    return Scene(
        {
            "block": Object(block, body, turned((0.0, 0.0, 0.0), (0.1, 0.3, 0.2))),
            "wall": Object(plate(0.05, 0.05), METAL, turned((-0.03, 0.0, 0.0))),
        }
    )


@pytest.mark.parametrize("loss", [0.0, 0.02])
def test_tubes_agree_with_beams(loss, monkeypatch):
    """One meaning, two ways: through a block to metal behind it and back, at peaks and aside."""
    given = {
        "directions": [[1.0, 0.0, 0.0], [1.0, 0.3, 0.2]],
        "frequencies": 30e9,
        "edges": 0,
        "depth": 4,
    }
    exact = iw.rcs(before_metal(loss), **given).parts
    monkeypatch.setattr(signature, "MAX_FACETS_BEAM_TRACING", 0)
    found = iw.rcs(before_metal(loss), **given).parts
    for order, tolerance in ((1, 0.01), (2, 0.1), (3, 0.02), (4, 0.1)):
        part = exact[f"order {order}"]
        error = (found[f"order {order}"] - part).norm() / part.norm()
        assert float(error) < tolerance, order


@pytest.mark.parametrize("divisions", [2, 3])
def test_a_block_of_many_triangles_is_the_slab_of_few(divisions):
    given = {"directions": [[1.0, 0.0, 0.0]], "frequencies": [29e9, 30e9], "edges": 0}
    few, many = (
        iw.rcs(
            Scene({"block": Object(box((0.02, 0.05, 0.05), n), RefractingBody(2.5))}), **given
        ).parts
        for n in (1, divisions)
    )
    for order in (1, 3, 5):
        exact, found = (parts[f"order {order}"][:, 0, 0, 0] for parts in (few, many))
        assert torch.allclose(found, exact, rtol=2e-4)


def test_the_back_of_a_sphere_is_that_of_mie():
    """Echoes of front and back: the range profile, where no caustic and no glory is near."""
    sizes = torch.linspace(30.0, 50.0, 31, dtype=torch.float64)
    frequencies = sizes / RADIUS * SPEED_OF_LIGHT / (2 * math.pi)
    ball = Scene({"ball": Object(sphere(RADIUS, 4), RefractingBody(1.2, loss_tangent=0.002))})
    found = iw.rcs(ball, [[1.0, 0.3, 0.2]], frequencies, depth=3, edges=0, tubes_per_wavelength=2)
    exact = SphereSection(RADIUS, 1.2, 0.002).amplitude(frequencies)[:, None, None, None]
    truth = Signature(
        {"mie": exact.expand(-1, 1, 2, 2)}, frequencies, found.directions, found.receivers
    )
    ranges, profile = found.range_profile(padding=8)
    level, expected = (p[:, 0, 0, 0].abs() for p in (profile, truth.range_profile(padding=8)[1]))
    back = -RADIUS + 2 * math.sqrt(1.2) * RADIUS
    for place, worst in ((-RADIUS, 0.15), (back, 1.0)):
        near = (ranges - place).abs() < 0.005
        error = 20 * torch.log10(level[near].max() / expected[near].max())
        assert abs(float(error)) < worst
        peak = ranges[(ranges - place).abs() < 0.015]
        at = peak[level[(ranges - place).abs() < 0.015].argmax()]
        assert float(at) == pytest.approx(place, abs=0.005)


# Parts.


def test_normals_are_those_of_the_smooth_surface_and_of_flat_faces():
    ball = sphere(RADIUS, 3)
    shape = topology_of([ball])
    surface = group_smooth_faces(build_facets(ball.vertices, shape), shape.edge_faces)
    assert int(surface.face.max()) == 0
    exact = ball.vertices[shape.faces] / RADIUS
    assert float((surface.normals - exact).norm(dim=2).max()) < 0.02
    drum = cylinder(0.03, 0.05)
    shape = topology_of([drum])
    surface = group_smooth_faces(build_facets(drum.vertices, shape), shape.edge_faces)
    assert int(surface.face.max()) == 2  # the round side and both ends
    normals = [surface.facets.normal[surface.face == number] for number in range(3)]
    flat = [number for number in range(3) if float(normals[number].std(0).max()) < 1e-9]
    assert len(flat) == 2
    for number in flat:
        ends = surface.normals[surface.face == number] - normals[number][:, None]
        assert float(ends.abs().max()) < 1e-12


@pytest.mark.parametrize(
    ("along", "aside", "expected"), [(2.0, 2.0, 0.5), (-0.5, 1.0, 2**0.5 * 1j), (-1.0, -4.0, -0.5)]
)
def test_a_tube_keeps_its_power_and_turns_by_a_quarter_at_each_line_of_a_focus(
    along, aside, expected
):
    start = float64([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    end = start * float64([along, aside, 1.0]) + float64([0.3, 0.2, -5.0])
    found = complex(_spreading_factor(float64([[0.0, 0.0, -1.0]]), start, end)[0])
    assert found == pytest.approx(expected, abs=1e-12)


def test_the_phase_of_a_tube_is_that_of_its_corners():
    corners = float64([[[0, 0, 0.1], [1, 0, 0.3], [0.2, 1, 0]]])
    phases = complex128([[0.3, 0.5 - 0.1j, -0.2]])
    k = _fit_wave_vector(complex128([[0.0, 0.1, -1.0]]), corners, phases)
    met = (k[:, None] * corners).sum(2)
    assert torch.allclose(met - met[:, :1], phases - phases[:, :1])


# Refusals and warnings.


def test_derivatives_by_what_bends_tubes_are_refused():
    epsilon = float64(2.5).requires_grad_()
    scene = Scene({"block": Object(box(0.03, divisions=2), RefractingBody(epsilon))})
    with pytest.raises(InputError, match="expected permittivities of block without derivatives"):
        iw.rcs(scene, [[1.0, 0.0, 0.0]], 30e9, edges=0)
    lossy = Scene({"block": Object(box(0.03, divisions=2), RefractingBody(epsilon, 30.0))})
    found = iw.rcs(lossy, [[1.0, 0.0, 0.0]], 30e9, edges=0).matrix.abs().square().sum()
    assert float(torch.autograd.grad(found, epsilon)[0]) != 0


def test_metal_in_the_face_of_a_solid_of_many_triangles_is_refused():
    def scene(place: float, mesh: Mesh | None = None) -> Scene:
        block = Object(box(0.03, divisions=2), RefractingBody(2.5), turned((0.015, 0.0, 0.0)))
        wall = Object(mesh or plate(0.05, 0.05), METAL, turned((place, 0.0, 0.0)))
        return Scene({"block": block, "wall": wall})

    with pytest.raises(InputError, match=r"do not touch block .* got wall in the plane"):
        iw.rcs(scene(0.0), [[1.0, 0.0, 0.0]], 30e9, edges=0)
    # Sunk by a thousandth of a wavelength, a smaller plate is what waves inside meet.
    small = plate(0.03, 0.03)
    found = iw.rcs(scene(1e-5, small), [[1.0, 0.0, 0.0]], 30e9, edges=0, depth=9)
    k = 2 * math.pi * 30e9 / SPEED_OF_LIGHT
    index = math.sqrt(2.5)
    r = (1 - index) / (1 + index)
    once = complex(torch.exp(torch.tensor(-2j * k * index * 0.03)))
    expected = 0.03**2 * k / (2 * math.pi) * abs((r - once) / (1 - r * once))
    assert abs(complex(found.matrix[0, 0, 0, 0])) == pytest.approx(expected, rel=0.01)


def test_facets_are_judged_by_the_wave_inside():
    """Fine enough in air, not at n = 3."""
    scenes = [Scene({"ball": Object(sphere(0.05, 3), m)}) for m in (METAL, RefractingBody(9.0))]
    given = {"directions": [[1.0, 0.0, 0.0]], "frequencies": 30e9, "edges": 0, "depth": 1}
    iw.rcs(scenes[0], **given)
    with pytest.warns(PhysicsWarning, match="facets of ball are .* wavelengths off"):
        iw.rcs(scenes[1], **given)
