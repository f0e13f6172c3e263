"""Solids of few triangles: slabs, blocks on metal, prisms, derivatives, refusals."""

import cmath
import math

import pytest
import torch
from torch import Tensor

import invertwin as iw
from invertwin.channel.beams.beam_tracing import build_facets, trace_beams
from invertwin.channel.em.dielectric_solids import group_solids
from invertwin.channel.em.plane_waves import area_vector, dot
from invertwin.channel.rays.topology import topology_of
from invertwin.channel.rcs import far_field as signature
from invertwin.channel.rcs.dielectric_interfaces import scatter_at_interfaces
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError, PhysicsWarning
from invertwin.scene import (
    Dielectric,
    Material,
    Mesh,
    Object,
    PerfectConductor,
    RefractingBody,
    RoughConductor,
    Scene,
    Slab,
    box,
    rigid,
    rotation_from_vector,
)
from invertwin.scene.material.slab import slab_coefficients
from scenes import complex128, float64, level_plate

METAL = PerfectConductor()
SIDE, THICKNESS = 0.1, 0.03
BROADSIDE = [[0.0, 0.0, 1.0]]
BAND = torch.linspace(27e9, 33e9, 7, dtype=torch.float64)


def block(material: Material, height: float = 0.0, thickness: float = THICKNESS) -> Object:
    """A block above a height."""
    place = rigid(translation=float64([0.0, 0.0, height + thickness / 2]))
    return Object(box((SIDE, SIDE, thickness)), material, place)


def alone(material: Material, **place: float) -> Scene:
    return Scene({"block": block(material, **place)})


def on_metal(material: Material, gap: float = 0.0) -> Scene:
    return Scene({"block": block(material, gap), "floor": Object(level_plate(SIDE, SIDE), METAL)})


def far(scene: Scene, frequencies: object = 30e9, **options: object) -> Tensor:
    """S of the first polarisation at broadside, without edges of conductors."""
    given: dict = {"edges": 0, "depth": 5} | options
    return iw.rcs(scene, BROADSIDE, frequencies, **given).matrix[:, 0, 0, 0]


def layers(
    epsilon: complex, frequency: float, gap: float | None = None, terms: int = 200
) -> complex:
    """S of a layer, or of one above metal, from ``terms`` inner bounces: jA/λ times r."""
    k, index = 2 * math.pi * frequency / SPEED_OF_LIGHT, cmath.sqrt(epsilon)
    r, once = (1 - index) / (1 + index), cmath.exp(-1j * k * index * THICKNESS)
    top = cmath.exp(2j * k * (THICKNESS + (gap or 0.0)))
    far_side = -1.0 if gap == 0.0 else -r
    back = far_side * once**2
    total = r + (1 - r**2) * back * sum((-r * back) ** n for n in range(terms))
    if gap:
        through = (1 - r**2) * once / (1 - r**2 * once**2)
        metal = -cmath.exp(-2j * k * gap)
        total += through**2 * metal / (1 - total * metal)
    return 1j * SIDE**2 * k / (2 * math.pi) * total * top


@pytest.mark.parametrize(
    "kind", [RefractingBody, lambda *a, **v: Dielectric(*a, **v, scattering=0)]
)
@pytest.mark.parametrize("loss", [0.0, 0.02])
def test_a_block_is_the_airy_sum_of_its_orders(kind, loss):
    """Front, back and inner bounces at all fringes; what ``depth`` leaves out is of a series."""
    epsilon = 2.5 * (1 - 1j * loss)
    scene = alone(kind(2.5, loss_tangent=loss))
    for depth, terms in ((1, 0), (2, 0), (3, 1), (5, 2), (9, 4), (25, 12)):
        found = far(scene, BAND, depth=depth)
        for value, frequency in zip(found.tolist(), BAND.tolist(), strict=True):
            expected = layers(epsilon, frequency, terms=terms)
            assert abs(value - expected) < 1e-12 * abs(expected)
    whole = complex128([layers(epsilon, f) for f in BAND.tolist()])
    assert float((found - whole).abs().max()) < 1e-12
    assert float(whole.abs().max() / whole.abs().min()) > 1.5  # fringes


def test_a_block_agrees_with_a_sheet_of_its_coefficients():
    """The same closed form as `Slab` has, referred from the middle to the front."""
    material = Slab(2.5, loss_tangent=0.01, thickness=THICKNESS)
    found = far(alone(RefractingBody(2.5, loss_tangent=0.01)), BAND, depth=31)
    for value, frequency in zip(found.tolist(), BAND.tolist(), strict=True):
        sheet = slab_coefficients([material.sheet(frequency)], float64([1.0]), frequency)
        k = 2 * math.pi * frequency / SPEED_OF_LIGHT
        front = cmath.exp(2j * k * THICKNESS)
        expected = 1j * SIDE**2 * k / (2 * math.pi) * complex(sheet.reflection_s) * front
        assert abs(value - expected) < 1e-10 * abs(expected)


def test_the_back_face_is_at_its_optical_depth():
    band = torch.linspace(26e9, 34e9, 129, dtype=torch.float64)
    found = iw.rcs(alone(RefractingBody(4.0)), BROADSIDE, band, edges=0, depth=3)
    ranges, profile = found.range_profile(padding=8)
    level = profile[:, 0, 0, 0].abs()
    front, back = -THICKNESS, -THICKNESS + 2.0 * THICKNESS
    for place, strength in ((front, 1 / 3), (back, (1 - 1 / 9) / 3)):
        near = (ranges - place).abs() < 0.015
        assert float(ranges[near][level[near].argmax()]) == pytest.approx(place, abs=0.002)
        peak = strength * SIDE**2 * 30e9 / SPEED_OF_LIGHT
        assert float(level[near].max()) == pytest.approx(peak, rel=0.03)


@pytest.mark.parametrize("loss", [0.0, 0.03])
@pytest.mark.parametrize("gap", [0.0, 0.013])
def test_metal_against_a_block_and_behind_one(loss, gap):
    """Every bounce between front, back and metal; in contact, no film of air is left."""
    expected = layers(2.5 * (1 - 1j * loss), 30e9, gap)
    found = complex(far(on_metal(RefractingBody(2.5, loss_tangent=loss), gap), depth=29)[0])
    assert abs(found - expected) < (1e-5 if gap == 0 else 1e-3) * abs(expected)


def test_metal_inside_a_block_hides_what_is_behind():
    """A plate at half the depth of a lossless block of ε = 4: r = (r₁ − e)/(1 − r₁ e)."""
    place = rigid(translation=float64([0.0, 0.0, THICKNESS / 2]))
    inside = Object(level_plate(SIDE, SIDE), METAL, place)
    scene = Scene({"block": block(RefractingBody(4.0)), "plate": inside})
    k = 2 * math.pi * 30e9 / SPEED_OF_LIGHT
    back = cmath.exp(-2j * k * 2.0 * THICKNESS / 2)
    expected = (-1 / 3 - back) / (1 + back / 3)
    expected *= 1j * SIDE**2 * k / (2 * math.pi) * cmath.exp(2j * k * THICKNESS)
    assert abs(complex(far(scene, depth=41)[0]) - expected) < 1e-6 * abs(expected)


def test_a_lossy_block_shows_its_front_less_what_comes_back():
    for loss, close in ((0.3, 5e-3), (1.0, 1e-9)):
        material = RefractingBody(2.5, loss_tangent=loss)
        epsilon = complex(material.complex_permittivity(30e9))
        front = layers(epsilon, 30e9, terms=0)
        once = cmath.exp(
            -2j * 2 * math.pi * 30e9 / SPEED_OF_LIGHT * cmath.sqrt(epsilon) * THICKNESS
        )
        assert abs(once) < close
        found = complex(far(alone(material))[0])
        assert abs(found - front) < close * abs(front) * 5
        inner = iw.rcs(alone(material), BROADSIDE, 30e9, edges=0).parts["order 3"]
        assert (float(inner.abs().max()) > 0) == (loss < 1)  # beyond 80 dB nothing is followed


def half_opened(name: str) -> Mesh:
    """A box with a hole, or a wall across its middle; a plate or a corner of mixed winding."""
    whole = box((SIDE, SIDE, THICKNESS))
    if name == "hole":
        return Mesh(whole.vertices, whole.faces[:-2])
    if name == "partition":
        middle = float64([0.0, 1.0, 1.0]) * whole.vertices[[0, 4, 6, 2]]
        wall = torch.tensor([[8, 9, 10], [8, 10, 11]])
        return Mesh(torch.cat([whole.vertices, middle]), torch.cat([whole.faces, wall]))
    faces = whole.faces[:2] if name == "plate" else whole.faces[[0, 1, 4, 5]]
    return Mesh(whole.vertices, torch.cat([faces[:1].flip(1), faces[1:]]))


@pytest.mark.parametrize("name", ["hole", "partition", "plate", "corner"])
def test_a_solid_whose_mesh_is_open_is_named(name, recwarn):
    scene = Scene({"block": Object(half_opened(name), RefractingBody(4.0))})
    iw.rcs(scene, BROADSIDE, 30e9, edges=0)
    named = [w for w in recwarn if "mesh of block is open, though it almost" in str(w.message)]
    assert len(named) == (name in ("hole", "partition"))


# Energy and reciprocity.


def prism(side: float) -> Mesh:
    """A right-angled prism: its legs in the planes x = 0 and z = 0."""
    corners = [[0, 0, 0], [1, 0, 0], [0, 0, 1], [0, 1, 0], [1, 1, 0], [0, 1, 1]]
    faces = [[0, 2, 1], [3, 4, 5], [0, 1, 4], [0, 4, 3], [0, 3, 5], [0, 5, 2], [1, 2, 5], [1, 5, 4]]
    vertices = side * float64(corners)
    mesh = Mesh(vertices, torch.tensor(faces))
    a, b, c = vertices[mesh.faces].unbind(1)
    outwards = float((a * torch.linalg.cross(b, c)).sum()) > 0
    return mesh if outwards else Mesh(vertices, mesh.faces.flip(1))


def test_a_prism_sends_all_back_that_it_lets_in():
    """Two total reflections: 1 − r² of a plate of the hypotenuse's area, less nothing."""
    side, index = 0.06, math.sqrt(2.5)
    scene = Scene({"prism": Object(prism(side), RefractingBody(2.5))})
    found = iw.rcs(scene, [[1.0, 0.0, 1.0]], 30e9, edges=0)
    flat = side**2 * math.sqrt(2) * 30e9 / SPEED_OF_LIGHT
    r = (index - 1) / (index + 1)
    assert float(found.parts["order 1"][0, 0, 0, 0].abs()) == pytest.approx(r * flat, rel=0.02)
    for channel in (0, 1):
        back = float(found.parts["order 4"][0, 0, channel, channel].abs())
        assert back == pytest.approx((1 - r**2) * flat, rel=1e-3)


@pytest.mark.parametrize("angle", [0.0, 0.3])
def test_power_that_enters_a_clear_block_leaves_it(angle):
    """Σ of power through all faces over many orders, by the polygons of the beams."""
    scene = Scene({"block": Object(box((0.03, 0.03, 0.02)), RefractingBody(4.0))})
    item = scene.objects["block"]
    topology = topology_of([item.mesh])
    facets = build_facets(item.vertices, topology)
    incident = float64([[math.sin(angle), 0.0, -math.cos(angle)]])
    k = 2 * math.pi / 0.01
    skins = signature._smooth_interfaces(scene, 30e9)
    entered = group_solids(
        [skins], [k], facets.corners, facets.solid, topology.face_object, ["block"]
    )
    solids = entered[0][0]
    assert solids is not None
    unit = torch.eye(3, dtype=torch.complex128)[1:2].repeat(2, 1)[None]  # E along y, twice
    again = passed = torch.zeros(0)
    came = out = 0.0
    for number, bounce in enumerate(trace_beams(facets, incident, 24, solids=solids)):
        field = unit.expand(len(bounce.aspect), 2, 3)
        if number:
            through = bounce.transmitted[:, None, None]
            field = torch.where(through, passed[bounce.parent], again[bounce.parent])
        met = scatter_at_interfaces(
            solids, skins.rows(bounce.facet), k, bounce, field, incident[bounce.aspect]
        )
        area = area_vector(bounce.polygon).norm(dim=1)
        flow = -dot(bounce.normal, bounce.wave_vector.real) * area
        if not number:
            came += float((flow * field[:, 0].abs().square().sum(1)).sum())
            out += float((flow * met.reflected[:, 0].abs().square().sum(1)).sum())
        else:
            rest = field[:, 0].abs().square().sum(1) - met.reflected[:, 0].abs().square().sum(1)
            out += float((flow * rest).sum())
        again, passed = met.reflected, met.transmitted
    if angle == 0.0:
        assert out == pytest.approx(came, rel=1e-9)
    else:
        # Beams that met the sides go on by total reflection and leave by back and front.
        assert out == pytest.approx(came, rel=1e-3)


@pytest.mark.parametrize("few", [24, 0])
def test_reciprocity(few, monkeypatch):
    monkeypatch.setattr(signature, "MAX_FACETS_BEAM_TRACING", few)
    turn = rigid(rotation_from_vector(float64([0.4, 0.3, 0.2])), float64([0.0, 0.0, 0.03]))
    scene = Scene(
        {
            "block": Object(box((0.03, 0.02, 0.02)), RefractingBody(2.5, loss_tangent=0.01), turn),
            "floor": Object(level_plate(0.04, 0.04), METAL),
        }
    )
    sent, received = [[0.3, 0.1, 1.0]], [[-0.5, 0.2, 0.8]]
    there = iw.rcs(scene, sent, 30e9, receivers=received, edges=0, depth=4).matrix
    back = iw.rcs(scene, received, 30e9, receivers=sent, edges=0, depth=4).matrix
    assert torch.allclose(there, back.mT, rtol=1e-6, atol=1e-9 * float(there.abs().max()))


# Derivatives.


def power(theta: Tensor) -> Tensor:
    """|S|² of a turned block above metal, by ε′, thickness, angle, place and conductivity."""
    zero = theta.new_zeros(())
    epsilon, thickness, angle, place, sigma = theta.unbind()
    size = torch.stack([zero + 0.03, zero + 0.03, 0.012 + thickness])
    pose = rigid(
        rotation_from_vector(torch.stack([0.2 + angle, zero + 0.1, zero])),
        torch.stack([place, zero, zero + 0.01]),
    )
    mesh = box(1.0)
    body = Object(
        Mesh(mesh.vertices * size, mesh.faces),
        RefractingBody(2.5 + epsilon, 0.05 + sigma, loss_tangent=0.01),
        pose,
    )
    floor = Object(level_plate(0.05, 0.05), METAL, rigid(translation=float64([0.0, 0.0, -0.02])))
    scene = Scene({"block": body, "floor": floor})
    found = iw.rcs(scene, [[0.25, 0.1, 1.0]], 31e9, depth=3, edges=0)
    return found.matrix.abs().square().sum()


def test_derivatives_are_those_of_differences():
    start = torch.zeros(5, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(power(start), start)
    for number, step in enumerate((1e-5, 1e-7, 1e-6, 1e-7, 1e-5)):
        change = torch.zeros(5, dtype=torch.float64)
        change[number] = step
        with torch.no_grad():
            difference = float(power(change) - power(-change)) / (2 * step)
        assert float(gradient[number]) == pytest.approx(difference, rel=1e-4)


def test_derivatives_by_conductivity_differ_between_frequencies_of_one_permittivity():
    """At σ = 0 permittivities are equal, slopes of ε = ε′ − jσ/ωε₀ are not."""

    def level(sigma: Tensor, frequencies: list[float]) -> Tensor:
        return far(alone(RefractingBody(2.5, sigma)), frequencies).abs().square()[-1]

    both, single = (
        torch.autograd.functional.jacobian(lambda s, f=f: level(s, f), float64(0.0))
        for f in ([20e9, 30e9], [30e9])
    )
    assert float(both) == pytest.approx(float(single), rel=1e-9)


# Refusals and warnings.


@pytest.mark.parametrize("inner", [RefractingBody(4.0), Slab(3.0, thickness=1e-3)])
def test_dielectrics_inside_a_clear_solid_are_refused(inner):
    mesh = level_plate(0.01, 0.01) if isinstance(inner, Slab) else box(0.01)
    place = rigid(translation=float64([0.0, 0.0, THICKNESS / 2]))
    scene = Scene({"block": block(RefractingBody(2.5)), "core": Object(mesh, inner, place)})
    with pytest.raises(InputError, match="against block, got the dielectric core; leave a gap"):
        far(scene)


def test_blocks_in_touch_are_refused_where_waves_pass_between_them():
    clear, lossy = RefractingBody(2.5), RefractingBody(2.5, loss_tangent=3.0)
    for first, second in ((clear, clear), (clear, lossy)):
        scene = Scene({"top": block(first, THICKNESS), "under": block(second)})
        with pytest.raises(InputError, match="against top, got the dielectric under"):
            far(scene)
    far(Scene({"top": block(lossy, THICKNESS), "under": block(lossy)}))


def test_values_per_triangle_show_the_front_alone():
    values = torch.linspace(2.5, 3.0, 12, dtype=torch.float64)
    with pytest.warns(PhysicsWarning, match="block is closed and its permittivity differs"):
        found = iw.rcs(alone(RefractingBody(values)), BROADSIDE, 30e9, edges=0)
    assert float(found.parts["order 2"].abs().max()) == 0


def test_open_meshes_and_conductors_have_no_inside():
    """A half space, and metal to 1e-12 as before solids were entered (commit 5b65aad)."""
    half = Object(level_plate(SIDE, SIDE), RefractingBody(2.5))
    found = iw.rcs(Scene({"half": half}), BROADSIDE, 30e9, edges=0)
    assert set(found.parts) == {f"order {n}" for n in range(1, 6)}
    assert float(found.parts["order 3"].abs().max()) == 0
    metal = alone(RoughConductor(scattering=0.0))
    assert torch.equal(far(metal), far(alone(METAL)))
