"""Signatures: laws of waves first, then targets that are known."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

import invertwin as iw
from invertwin.channel import SphereSection, trace_far_field
from invertwin.channel.beams.beam_tracing import clip
from invertwin.channel.em.plane_waves import (
    SmoothInterfaces,
    area_vector,
    dot,
    polarisations,
    polygon_integral,
    radiate_field,
    reflect_field,
    reflect_vectors,
)
from invertwin.channel.em.wedges import Wedges, find_wedges, fringe_field, select_body_edges
from invertwin.channel.rays.topology import topology_of
from invertwin.channel.rcs import far_field as signature
from invertwin.channel.rcs.moments import efie_solver as meshed
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError, PhysicsWarning
from invertwin.scene import (
    Cloud,
    Dielectric,
    Mesh,
    Object,
    PerfectConductor,
    RoughDielectric,
    Scene,
    Slab,
    box,
    dihedral,
    plate,
    rigid,
    rotation_from_vector,
    sphere,
    trihedral,
)
from invertwin.scene.material.fresnel import fresnel_coefficients
from invertwin.scene.material.slab import slab_coefficients
from invertwin.scene.mesh import concatenate_meshes
from invertwin_studies.dihedral_moments import strip_section_te, strip_section_tm
from scenes import float64

METAL = PerfectConductor()
WAVELENGTH = 0.01
FREQUENCY = SPEED_OF_LIGHT / WAVELENGTH
K = 2 * math.pi / WAVELENGTH
UP = float64([0.0, 0.0, 1.0])


@pytest.fixture(autouse=True)
def bounces_and_edges_alone(monkeypatch):
    """What is solved instead where targets are small has tests of its own."""
    monkeypatch.setattr(meshed, "MAX_UNKNOWNS", 0)


def traced(scene: Scene, directions: object, receivers: Tensor | None = None, **options) -> dict:
    """All parts of S at one frequency, [aspect, 2, 2] each."""
    given: dict[str, Any] = {
        "depth": 3,
        "edges": 0,
        "tubes_per_wavelength": 8.0,
        "up": UP,
    } | options
    frequencies = float64([given.pop("frequency", FREQUENCY)])
    toward = normalize(torch.as_tensor(directions, dtype=torch.float64), dim=1)
    found = trace_far_field(scene, toward, receivers, frequencies, **given)
    return {name: part[0] for name, part in found.items()}


def total(*arguments, **options) -> Tensor:
    return torch.stack([*traced(*arguments, **options).values()]).sum(0)


def metal(mesh: Mesh, pose: Tensor | None = None) -> Scene:
    return Scene({"target": Object(mesh, METAL, pose)})


def turned(x: float, y: float, z: float, place: object = (0.0, 0.0, 0.0)) -> Tensor:
    return rigid(rotation_from_vector(float64([x, y, z])), float64(place))


def random_directions(count: int, seed: int = 0) -> Tensor:
    drawn = torch.from_numpy(np.random.default_rng(seed).normal(size=(count, 3)))
    return normalize(drawn[:, [2, 0, 1]], dim=1)  # y, z and x are drawn in this order


def dbsm(amplitude: Tensor) -> Tensor:
    return 10 * torch.log10(4 * math.pi * amplitude.abs() ** 2)


def crowd(kind: str) -> Scene:
    """Small scenes with shadows and several bounces."""
    leaf = turned(0.1, 0.3, 0.2, (-0.06, 0.02, 0.01))
    if kind == "metal":
        return Scene(
            {
                "corner": Object(trihedral(0.05), METAL),
                "leaf": Object(plate(0.02, 0.03), METAL, leaf),
            }
        )
    if kind == "solid":
        return Scene(
            {"floor": Object(plate(0.08, 0.08), METAL), "box": Object(box(0.03), METAL, leaf)}
        )
    return Scene(
        {
            "corner": Object(dihedral(0.04), Dielectric(4.0, 0.1, rms_height=3e-4)),
            "leaf": Object(plate(0.02, 0.03), Slab(3.0, thickness=2e-3), leaf),
        }
    )


# Integrals and clipping.


def test_polygon_integral_agrees_with_a_fine_sum():
    corners = float64([[0, 0, 0], [1, 0.2, 0.1], [1.2, 1.1, 0.5], [0.1, 0.9, 0.4]])
    middle, u, v = corners[0], corners[1], corners[3]
    quad = torch.stack([middle, u, u + v, v])[None]  # a flat parallelogram
    steps = (torch.arange(400, dtype=torch.float64) + 0.5) / 400
    s, t = torch.meshgrid(steps, steps, indexing="ij")
    points = s[..., None] * u + t[..., None] * v
    for wave in ([3.0, -2.0, 1.0], [0.0, 0.0, 0.0], [40.0, 10.0, -5.0]):
        w = float64([wave])
        sum_ = torch.exp(1j * (points @ w[0])).mean() * torch.linalg.cross(u, v).norm()
        assert abs(complex(polygon_integral(quad, w)(1.0)[0] - sum_)) < 2e-4


def test_polygon_integral_is_smooth_where_the_wave_is_broadside():
    triangle = float64([[[0, 0, 0], [1, 0, 0], [0, 2, 0]]])
    values = [
        complex(polygon_integral(triangle, float64([[x, 0.4 * x, 7.0]]))(1.0)[0])
        for x in (9.0e-4, 9.6e-4, 1e-3)
    ]
    slope = (values[2] - values[0]) / 1e-4
    assert abs(values[1] - values[0] - 0.6e-4 * slope) < 1e-9


def test_clipping_keeps_what_is_in_front():
    square = float64([[[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]]).repeat(3, 1, 1)
    normal = float64([[1, 0, 0]]).repeat(3, 1)
    part = clip(square, normal, float64([0.25, -1.0, 2.0]))
    assert torch.allclose(area_vector(part).norm(dim=1), float64([0.75, 1.0, 0.0]))


# The laws at a surface.


def skins(**values: object) -> SmoothInterfaces:
    given = {
        "conducting": False,
        "permittivity": 1 + 0j,
        "thickness": math.inf,
        "coherent": 1.0,
        "rms_height": 0.0,
    } | values
    kinds = [torch.bool, torch.complex128, *[torch.float64] * 3]
    columns = zip(given.values(), kinds, strict=True)
    return SmoothInterfaces(*(torch.tensor([value], dtype=kind) for value, kind in columns))


def incident(angle: float) -> tuple[Tensor, Tensor, Tensor]:
    """Normal, direction, and the fields across and in the plane of incidence."""
    direction = float64([[math.sin(angle), 0, -math.cos(angle)]])
    fields = torch.stack([float64([0, 1, 0]), float64([math.cos(angle), 0, math.sin(angle)])])
    return float64([[0, 0, 1]]), direction, fields[None].to(torch.complex128)


@pytest.mark.parametrize("angle", [0.0, 0.4, 1.2])
@pytest.mark.parametrize("kind", ["metal", "body", "sheet"])
def test_what_a_surface_sends_to_its_mirror_direction_is_its_reflection(kind, angle):
    """(jk/2π) cosθ per m² of the reflected field: a patch in the far field of an endless plane."""
    normal, direction, field = incident(angle)
    own = {
        "metal": skins(conducting=True),
        "body": skins(permittivity=4 - 0.5j),
        "sheet": skins(permittivity=3 - 0.1j, thickness=2.3e-3),
    }[kind]
    onwards = reflect_vectors(direction, normal)
    sent = radiate_field(own, K, normal, direction, field, onwards)
    back = reflect_field(own, K, normal, direction, field)
    expected = 1j * K / (2 * math.pi) * math.cos(angle) * back
    assert torch.allclose(sent, expected, atol=1e-9 * K)


@pytest.mark.parametrize("angle", [0.0, 0.4, 1.2])
def test_reflection_coefficients_are_those_of_the_materials(angle):
    normal, direction, field = incident(angle)
    cosine = float64([math.cos(angle)])
    half = fresnel_coefficients(torch.tensor([4 - 0.5j], dtype=torch.complex128), cosine)
    layer = Slab(3.0, 0.05, thickness=2.3e-3)
    sheet = slab_coefficients([layer.sheet(FREQUENCY)], cosine, FREQUENCY)
    epsilon = complex(layer.complex_permittivity(FREQUENCY))
    front = np.exp(1j * K * math.cos(angle) * 2.3e-3)  # from the middle to the face
    for own, found, turn in (
        (skins(permittivity=4 - 0.5j), half, 1.0),
        (skins(permittivity=epsilon, thickness=2.3e-3), sheet, front),
    ):
        back = reflect_field(own, K, normal, direction, field)
        assert abs(complex(back[0, 0, 1]) - complex(found.reflection_s) * turn) < 1e-9
        # A conductor has r_p = 1, which turns the part along the surface over.
        after = float64([-math.cos(angle), 0, math.sin(angle)])
        assert abs(complex(dot(back[0, 1], after)) - complex(found.reflection_p) * turn) < 1e-9


def test_a_sheet_takes_from_the_wave_behind_it_what_does_not_pass():
    """Forward, the polarisation current sends (jk/2π) cosθ (T − 1): an endless sheet's shadow."""
    angle, thickness = 0.5, 2.3e-3
    normal, direction, field = incident(angle)
    layer = Slab(3.0, 0.05, thickness=thickness)
    passed = slab_coefficients([layer.sheet(FREQUENCY)], float64([math.cos(angle)]), FREQUENCY)
    epsilon = complex(layer.complex_permittivity(FREQUENCY))
    own = skins(permittivity=epsilon, thickness=thickness)
    sent = radiate_field(own, K, normal, direction, field, direction)
    through = np.exp(1j * K * math.cos(angle) * thickness)
    for number, t in enumerate((passed.transmission_s, passed.transmission_p)):
        lost = complex(t) * through - 1
        expected = 1j * K / (2 * math.pi) * math.cos(angle) * lost * field[0, number]
        assert torch.allclose(sent[0, number], expected, atol=1e-9 * K)


def test_a_thin_sheet_of_high_permittivity_reflects_like_its_impedance():
    """h → 0 with (ε−1)h fixed: r_s = −x/(cosθ + x), x = jk(ε−1)h/2."""
    normal, direction, field = incident(0.6)
    load, thickness = 0.8j, 1e-9
    own = skins(permittivity=1 + load / (0.5j * K * thickness), thickness=thickness)
    back = reflect_field(own, K, normal, direction, field)
    assert abs(complex(back[0, 0, 1]) + load / (math.cos(0.6) + load)) < 1e-4


def test_roughness_takes_its_share_of_the_coherent_power():
    normal, direction, field = incident(0.5)
    own = skins(conducting=True, rms_height=5e-4, coherent=0.8)
    power = reflect_field(own, K, normal, direction, field).abs().square().sum(2) / 0.64
    expected = math.exp(-((2 * K * 5e-4 * math.cos(0.5)) ** 2))
    assert torch.allclose(power, torch.full_like(power, expected))


@pytest.mark.parametrize("kind", ["metal", "sheet"])
def test_roughness_leaves_the_shadow_and_takes_from_the_flash(kind):
    normal, direction, field = incident(0.5)
    own = {"conducting": True} if kind == "metal" else {"permittivity": 3, "thickness": 2e-3}
    smooth, rough = skins(**own), skins(**own, rms_height=5e-4)
    lost = math.exp(-0.5 * (2 * K * 5e-4 * math.cos(0.5)) ** 2)
    for towards, expected in ((direction, 1.0), (reflect_vectors(direction, normal), lost)):
        sent = [radiate_field(s, K, normal, direction, field, towards) for s in (smooth, rough)]
        assert torch.allclose(sent[1], sent[0] * expected)


def test_polarisations_are_right_handed_and_of_unit_length():
    directions = torch.cat([random_directions(20), UP[None], -UP[None]])
    v, h = polarisations(directions, UP).unbind(1)
    assert torch.allclose(torch.linalg.cross(v, h), directions)
    assert torch.allclose(dot(h, UP.expand_as(h)), torch.zeros(22, dtype=torch.float64))


# Edges.


def half_plane(angle: float) -> tuple[Wedges, Tensor, Tensor, Tensor]:
    """A metre of edge along y of the half plane z = 0, x > 0, seen from an angle off the plane."""
    ends = float64([[0, -0.5, 0]]), float64([[0, 0.5, 0]])
    inwards = float64([[[1, 0, 0], [1, 0, 0]]])
    normals = float64([[[0, 0, 1], [0, 0, -1]]])
    wedge = Wedges(*ends, inwards, normals, float64([2.0]), torch.tensor([[0, 0]]))
    towards = float64([[math.cos(angle), 0, math.sin(angle)]])
    fields = torch.stack([float64([0, 1, 0]), torch.linalg.cross(float64([0, 1, 0]), towards[0])])
    return wedge, -towards, fields[None], towards


@pytest.mark.parametrize("angle", [math.pi / 2, math.pi / 4, 2.0, 2.8])
def test_fringe_of_a_half_plane_is_keller_less_physical_optics(angle):
    """Back to the source, f = ½(1/cosφ − 1) and g = ½(−1/cosφ − 1), optics ±½ tanφ (Ufimtsev)."""
    wedge, direction, fields, towards = half_plane(angle)
    sent = fringe_field(wedge, K, direction, fields, towards, torch.ones(1, 2).double())
    soft, hard = (complex(dot(sent[0, i], fields[0, i])) * 2 * math.pi for i in (0, 1))
    # E of the hard wave turns over on its way back.
    assert soft - hard == pytest.approx(-1, abs=1e-5)
    if angle != math.pi / 2:
        expected = 0.5 * (1 / math.cos(angle) - 1 - math.tan(angle))
        assert soft == pytest.approx(expected, abs=1e-5)


def test_a_wave_along_the_face_of_a_wedge_is_no_pole():
    wedge, _, fields, _ = half_plane(math.pi / 2)
    for angle in (math.pi / 2 - 1e-7, math.pi / 2, math.pi / 2 + 1e-7):
        towards = half_plane(angle)[3]
        sent = fringe_field(wedge, K, -towards, fields, towards, torch.ones(1, 2).double())
        assert torch.isfinite(sent).all()
        assert sent.abs().max() < 1.0


@pytest.mark.parametrize("channel", [0, 1])
def test_edges_bring_a_plate_to_the_method_of_moments(channel):
    """A strip of 4 wavelengths, 15 long, 20° to 60° off its flash: with E and H along it."""
    width, height = 4 * WAVELENGTH, 15 * WAVELENGTH
    angles = torch.deg2rad(torch.linspace(20, 60, 41, dtype=torch.float64))
    directions = torch.stack([-angles.cos(), angles.sin(), torch.zeros_like(angles)], 1)
    line = np.linspace(-0.5, 0.5, 97)[:, None] * [0.0, width]
    solve = (strip_section_tm, strip_section_te)[channel]
    exact = torch.from_numpy(solve(line, K, directions[:, :2].numpy()))
    exact = 10 * torch.log10(2 * height**2 / WAVELENGTH * exact)
    parts = traced(metal(plate(width, height)), directions, depth=1, edges=2)
    strength = [parts["order 1"], parts["order 1"] + parts["edges 1"]]
    strength.append(torch.stack([*parts.values()]).sum(0))
    errors = [float((dbsm(s[:, channel, channel]) - exact).abs().mean()) for s in strength]
    assert errors[0] > 3
    assert errors[1] < (0.6, 2.5)[channel]
    assert errors[2] < (0.6, 1.0)[channel]


@pytest.mark.slow
def test_creases_between_facets_of_a_flat_or_smooth_surface_are_no_edges():
    ball = traced(metal(sphere(0.03, 4)), random_directions(3), depth=1, edges=1)
    assert float(ball["edges 1"].abs().max()) == 0
    fine, coarse = (
        total(metal(plate(0.05, 0.05, divisions=n)), [[-1.0, 0.3, 0.1]], depth=1, edges=2)
        for n in (1, 3)
    )
    assert torch.allclose(fine, coarse, rtol=1e-6)


@pytest.mark.parametrize("corner", [0.0, 0.02], ids=["across a face", "along two edges"])
def test_partitions_in_a_body_do_not_diffract(corner):
    """Their own edges lie on its faces, and edges of three faces diffract as those of two."""
    body = box((0.04, 0.06, 0.05))
    ends = [[-corner, -0.03], [corner, 0.03]]
    rectangle = float64(
        [[*ends[k], z] for k, z in ((0, -0.025), (1, -0.025), (1, 0.025), (0, 0.025))]
    )
    partition = Mesh(rectangle, torch.tensor([[0, 1, 2], [0, 2, 3]]))
    ways = [[-1.0, 0.2, 0.1], [-1.0, -0.3, 0.4], [1.0, -0.5, -0.4]]
    empty, divided = (
        traced(metal(mesh), ways, depth=1, edges=2)
        for mesh in (body, concatenate_meshes([body, partition]))
    )
    assert float(empty["edges 1"].abs().max()) > 1e-3
    for name, part in empty.items():
        assert torch.allclose(divided[name], part, rtol=1e-4, atol=1e-6), name


def test_waves_pass_a_slit_far_narrower_than_a_wavelength_as_if_it_were_closed():
    slit = 1e-3 * WAVELENGTH
    half = box((0.04, 0.03 - slit / 2, 0.05))
    offset = float64([0.0, 0.015 + slit / 4, 0.0])
    halves = {
        name: Object(Mesh(half.vertices + side * offset, half.faces), METAL)
        for name, side in (("left", -1), ("right", 1))
    }
    ways = [[-1.0, 0.2, 0.1], [-1.0, -0.3, 0.4], [1.0, -0.5, -0.4]]
    whole, divided = (
        traced(scene, ways, depth=1, edges=2)
        for scene in (metal(box((0.04, 0.06, 0.05))), Scene(halves))
    )
    difference = divided["edges 1"] - whole["edges 1"]
    # Strips across the faces end at the slit; with four edges along it the difference is 0.6.
    assert float(difference.abs().max()) < 0.15 * float(whole["edges 1"].abs().max())


def test_the_widest_region_between_faces_is_the_exterior_of_an_edge():
    angles = torch.deg2rad(float64([0.0, 40.0, 100.0]))
    fans = torch.stack([angles.cos(), angles.sin(), torch.zeros(3)], 1).double()
    axis = float64([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    corners = torch.cat([axis.expand(3, 2, 3), fans[:, None]], 1)
    wedges = find_wedges(corners, axis[None], torch.tensor([[0, 1, 2]]))
    assert wedges.opening.tolist() == pytest.approx([260 / 180])
    place = [wedges.faces[0].tolist().index(n) for n in (0, 2)]
    assert torch.allclose(wedges.face_tangents[0, place], fans[[0, 2]])
    outward = float64([0.0, -1.0, 0.0])  # of the first face, away from the others
    assert torch.allclose(wedges.normals[0, place[0]], outward, atol=1e-12)


def edges_of(mesh: Mesh) -> tuple[int, int]:
    """How many sharp edges a mesh has, and how many of them are edges of the body."""
    shape = topology_of([mesh])
    corners = mesh.vertices[shape.faces]
    wedges = find_wedges(corners, mesh.vertices[shape.edges], shape.edge_faces)
    return len(wedges.start), int(select_body_edges(wedges, 2 * WAVELENGTH).sum())


def spindle(length: float, radius: float, step: float, base: bool) -> Mesh:
    """A body of revolution with a tip, round or cut off at the other end."""
    places = np.linspace(0, 1, round(length / step) + 1)
    outline = radius * (np.sin(math.pi * places) if not base else places)
    points, faces = [[0.0, 0.0, 0.0]], []
    rings = [[0]]
    for place, r in zip(places[1:-1] if not base else places[1:], outline[1:], strict=False):
        count = max(6, round(2 * math.pi * r / step))
        turns = 2 * math.pi * np.arange(count) / count
        rings.append(list(range(len(points), len(points) + count)))
        points += [[r * math.cos(t), r * math.sin(t), length * place] for t in turns]
    rings.append([len(points)])
    points.append([0.0, 0.0, length])
    for low, high in pairwise(rings):
        i = j = 0
        m, n = (len(ring) if len(ring) > 1 else 0 for ring in (low, high))
        while i < m or j < n:
            a, b = low[i % len(low)], high[j % len(high)]
            i, j = (i + 1, j) if j == n or (i < m and (i + 1) * n <= (j + 1) * m) else (i, j + 1)
            last = low[i % len(low)] if low[i % len(low)] != a else high[j % len(high)]
            faces.append([a, last, b])
    return Mesh(float64(points), torch.tensor(faces))


def test_facets_about_a_tip_are_no_edges():
    found, kept = edges_of(spindle(5 * WAVELENGTH, WAVELENGTH, WAVELENGTH / 16, base=False))
    assert found > 20
    assert kept == 0
    found, kept = edges_of(spindle(5 * WAVELENGTH, WAVELENGTH, WAVELENGTH / 16, base=True))
    assert found > kept
    assert kept == round(2 * math.pi * 16)  # the rim of a cone


@pytest.mark.parametrize("size", [0.2, 1.0, 3.0])
def test_edges_of_bodies_stay(size):
    a = size * WAVELENGTH
    thin = box((a, a, 0.1 * a))
    assert edges_of(thin) == (12, 12)
    assert edges_of(plate(a, a)) == (4, 4)
    assert edges_of(plate(3 * a, a, divisions=5)) == (20, 20)
    pyramid = Mesh(
        float64([[0, 0, a], [a, 0, 0], [0, a, 0], [-a, 0, 0], [0, -a, 0]]),
        torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1], [1, 4, 3], [1, 3, 2]]),
    )
    assert edges_of(pyramid) == (8, 8)


# Every bounce.


def test_closed_forms_at_boresight():
    ahead = [[-1.0, 0.0, 0.0]]
    a = 0.1
    for scene, expected, tolerance in (
        (metal(plate(a, a)), 4 * math.pi * a**4 / WAVELENGTH**2, 1e-6),
        (metal(dihedral(a)), 8 * math.pi * a**4 / WAVELENGTH**2, 0.1),
        (metal(trihedral(a)), 4 * math.pi * a**4 / 3 / WAVELENGTH**2, 0.13),
    ):
        found = dbsm(total(scene, ahead)[0].diagonal())
        assert float((found - 10 * math.log10(expected)).abs().max()) < tolerance


def test_a_rolled_dihedral_turns_the_polarisation():
    found = total(metal(dihedral(0.1), turned(math.pi / 4, 0, 0)), [[-1.0, 0.0, 0.0]])[0]
    expected = 10 * math.log10(8 * math.pi * 0.1**4 / WAVELENGTH**2)
    assert float(dbsm(found[0, 1])) == pytest.approx(expected, abs=0.01)
    assert float(dbsm(found[0, 0])) < expected - 35


def test_sphere_is_that_of_mie():
    ka, radius = 10.0, 0.05
    frequency = ka / radius * SPEED_OF_LIGHT / (2 * math.pi)
    direction = random_directions(1)
    found = total(metal(sphere(radius, 5)), direction, depth=1, frequency=frequency)[0]
    exact = SphereSection(radius).section(float64([frequency]), direction)
    error = dbsm(found.diagonal()) - 10 * torch.log10(exact[0])
    assert float(error.abs().max()) < 0.1
    assert float(found[0, 1].abs() / found[0, 0].abs()) < 1e-3


@pytest.mark.parametrize("kind", ["metal", "solid", "dielectric"])
def test_tubes_agree_with_beams(kind, monkeypatch):
    """One meaning, two ways, in shadows and with separate antennas."""
    sent, received = random_directions(8, 1), random_directions(8, 2)
    exact = traced(crowd(kind), sent, received)
    monkeypatch.setattr(signature, "MAX_FACETS_BEAM_TRACING", 0)
    found = traced(crowd(kind), sent, received, tubes_per_wavelength=8.0)
    # At random angles the fields of later orders are sidelobes, small beside what cancels.
    for name, tolerance in (("order 1", 0.01), ("order 2", 0.1), ("order 3", 0.15)):
        error = (found[name] - exact[name]).norm() / exact[name].norm().clamp_min(1e-12)
        assert float(error) < tolerance, name


@pytest.mark.filterwarnings("ignore:edges of sheets")
@pytest.mark.parametrize("kind", ["metal", "solid", "dielectric"])
@pytest.mark.parametrize("few", [24, 0])
def test_reciprocity(kind, few, monkeypatch):
    monkeypatch.setattr(signature, "MAX_FACETS_BEAM_TRACING", few)
    sent, received = random_directions(6, 3), random_directions(6, 4)
    there = total(crowd(kind), sent, received, edges=2)
    back = total(crowd(kind), received, sent, edges=2)
    assert torch.allclose(there, back.mT, rtol=1e-6, atol=1e-9 * float(there.abs().max()))


@pytest.mark.parametrize(
    ("few", "kind"), [(24, "metal"), (0, "metal"), (24, "solid"), (0, "solid")]
)
def test_solids_of_dielectric_have_not_changed_what_metal_sends(few, kind, monkeypatch):
    """The values of commit 0fafbd84, and of tubes with finer cuts, nearer to the beams."""
    monkeypatch.setattr(signature, "MAX_FACETS_BEAM_TRACING", few)
    found = total(crowd(kind), random_directions(2, 11), random_directions(2, 12), edges=0)
    before = {
        ("metal", 24): (
            -0.0005159514255812497 + 0.0005679292225726728j,
            1.8592467036649454e-05 - 1.8813513921306767e-05j,
            0.013249431870969938 - 0.010458528599738117j,
        ),
        ("metal", 0): (
            -0.0005159514094484262 + 0.0005679292039047223j,
            1.8592466085690544e-05 - 1.881351281776631e-05j,
            0.013244443960332312 - 0.010465453241894584j,
        ),
        ("solid", 24): (
            -0.006015759253535819 - 0.01445751905047728j,
            0.00016367861149587003 + 0.00028151626231030596j,
            0.017748065253464736 - 0.01646118188754777j,
        ),
        ("solid", 0): (
            -0.006015759253535851 - 0.01445751905047724j,
            0.0001636786114958714 + 0.0002815162623103053j,
            0.017735496425285727 - 0.01639651212468371j,
        ),
    }[kind, few]
    for value, expected in zip(found.flatten()[[0, 1, 6]].tolist(), before, strict=True):
        # Tubes are cut by a ray tracer in float32.
        assert abs(value - expected) < (1e-12 if few else 1e-9) * float(found.abs().max())


def test_one_antenna_sees_equal_cross_polar_terms():
    found = total(crowd("metal"), random_directions(6, 5))
    assert torch.allclose(found, found.mT)


def test_two_runs_are_equal():
    for kind, few in (("metal", 24), ("solid", 0)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(signature, "MAX_FACETS_BEAM_TRACING", few)
            runs = [total(crowd(kind), random_directions(4)) for _ in range(2)]
        assert torch.equal(*runs)


def test_a_large_plate_scatters_twice_what_it_meets():
    """Its mirror image and its shadow: ∫|S|² dω over all directions is 2A cosθ."""
    side, towards = 8 * WAVELENGTH, float64([[-1.0, 0.3, 0.1]])
    towards = towards / towards.norm()
    n = 160
    x = (torch.arange(n, dtype=torch.float64) + 0.5) / n * 2 - 1
    phi = (torch.arange(2 * n, dtype=torch.float64) + 0.5) / n * math.pi
    xx, pp = torch.meshgrid(x, phi, indexing="ij")
    rho = (1 - xx**2).sqrt()
    out = torch.stack([xx, rho * pp.cos(), rho * pp.sin()], -1).reshape(-1, 3)
    found = total(metal(plate(side, side)), towards.expand(len(out), 3), out, depth=1)
    power = float(found[:, :, 0].abs().square().sum(1).mean() * 4 * math.pi)
    assert power == pytest.approx(2 * side**2 * abs(float(towards[0, 0])), rel=0.05)


def test_triple_bounces_of_a_corner_grow_with_the_square_of_the_frequency():
    direction = float64([[-1.0, 0.1, 0.15]])
    found = [
        traced(metal(trihedral(0.1)), direction, frequency=f * FREQUENCY)["order 3"][0, 0, 0]
        for f in (1.0, 2.0)
    ]
    assert abs(complex(found[1] / found[0]) - 2) < 1e-6


@pytest.mark.parametrize(
    ("mesh", "order"), [(plate(0.1, 0.1), 1), (dihedral(0.1), 2), (trihedral(0.1), 3)]
)
def test_each_order_has_the_delay_of_its_vertex(mesh, order):
    """The phase of plate, crease and apex, moved by 0.3 m: exp(−2jk·0.3) at every frequency."""
    for place, scale in (((0.3, 0, 0), 2 * 0.3), ((-0.2, 0.0, 0.0), -2 * 0.2)):
        for frequency in (FREQUENCY, 1.13 * FREQUENCY):
            here, there = (
                traced(metal(mesh, pose), [[-1.0, 0.0, 0.0]], frequency=frequency)[f"order {order}"]
                for pose in (None, turned(0, 0, 0, place))
            )
            k = 2 * math.pi * frequency / SPEED_OF_LIGHT
            assert torch.allclose(there, here * np.exp(-1j * k * scale), atol=1e-9)


def test_a_large_mirror_turns_the_field_over():
    """Γ = −1: S = −jA/λ, of which the image source sends −1."""
    found = total(metal(plate(0.1, 0.1)), [[-1.0, 0.0, 0.0]])[0]
    assert torch.allclose(found.diagonal(), torch.full_like(found[0], -1j * 0.01 / WAVELENGTH))


def test_what_is_behind_does_not_count():
    front = Object(plate(0.1, 0.1), METAL)
    small = Object(plate(0.03, 0.03), METAL, turned(0, 0.2, 0.1, (0.05, 0, 0)))
    alone = total(Scene({"front": front}), [[-1.0, 0.0, 0.0]])
    both = total(Scene({"front": front, "behind": small}), [[-1.0, 0.0, 0.0]])
    assert torch.allclose(both, alone, atol=1e-12)


def test_an_array_of_few_facets_is_differentiable():
    """d|S|² by the opening of a dihedral, by where a plate stands before another, by size."""

    def power(theta: Tensor) -> Tensor:
        angle = math.pi / 4 + theta[0]
        first = torch.stack([-angle.cos(), angle.sin(), angle.new_zeros(())]) * (0.05 + theta[2])
        second = float64([-(0.5**0.5), -(0.5**0.5), 0.0]) * 0.05
        up = float64([0.0, 0.0, 0.05])
        corners = torch.stack([0 * up, up, second, second + up, first, first + up])
        mesh = Mesh(corners, torch.tensor([(0, 2, 3), (0, 3, 1), (0, 1, 5), (0, 5, 4)]))
        shift = torch.stack([theta[1] * 0 - 0.08, theta[1] + 0.01, theta[1]])
        leaf = plate(0.02, 0.02)
        scene = Scene(
            {
                "dihedral": Object(mesh, METAL),
                "leaf": Object(Mesh(leaf.vertices + shift, leaf.faces), METAL),
            }
        )
        return total(scene, [[-1.0, 0.08, 0.1]])[0, 0, 0].abs().square()

    start = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(power(start), start)
    for i in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[i] = 1e-6
        difference = float(power(step) - power(-step)) / 2e-6
        assert float(gradient[i]) == pytest.approx(difference, rel=1e-5)


# Where the physics ends, and what is refused.


@pytest.mark.parametrize(
    ("scene", "options", "text"),
    [
        (metal(sphere(0.05, 2)), {}, "facets of target are .* wavelengths off"),
        (metal(plate(0.002, 0.002)), {}, "target is 0.28 wavelengths large"),
        (metal(box(0.05, divisions=3)), {"tubes_per_wavelength": 0.5}, "0.5 tubes per wavelength"),
        (metal(plate(0.1, 0.1)), {"edges": 1}, "within 10° of grazing are left out"),
    ],
)
def test_warnings_where_the_physics_ends(scene, options, text):
    with pytest.warns(PhysicsWarning, match=text):
        total(scene, [[-0.1, 1.0, 0.0]], depth=1, **options)


def test_rough_surfaces_and_clouds_are_refused():
    with pytest.raises(
        InputError, match="smooth surfaces in a signature, got RoughDielectric for a"
    ):
        total(Scene({"a": Object(plate(1, 1), RoughDielectric(4.0))}), [[-1.0, 0.0, 0.0]])
    cloud = Cloud(float64([-1, -1, -1]), float64([1, 1, 1]), torch.ones(2, 2, 2).double())
    with pytest.raises(InputError, match="got clouds for a"):
        total(Scene({"a": Object(box(1.0), METAL, cloud=cloud)}), [[-1.0, 0.0, 0.0]])


def test_derivatives_of_many_facets_are_refused():
    ball = sphere(0.05, 3)
    mesh = Mesh(ball.vertices.clone().requires_grad_(), ball.faces)
    with pytest.raises(InputError, match="at most 24 triangles for derivatives of a signature"):
        total(metal(mesh), [[-1.0, 0.0, 0.0]])


def test_triangles_without_area_and_empty_views_give_zeros():
    flat = Mesh(
        float64([[0, 0, 0], [0, 0.1, 0], [0, 0, 0.1], [0, 0.05, 0]]),
        torch.tensor([[0, 2, 1], [0, 1, 3]]),
    )
    lone = Mesh(flat.vertices[:3], flat.faces[:1])
    found = [total(metal(mesh), [[-1.0, 0.1, 0.2]], edges=0) for mesh in (flat, lone)]
    assert torch.allclose(found[0], found[1])
    assert torch.isfinite(total(metal(flat), [[-1.0, 0.1, 0.2]], edges=2)).all()
    edge_on = total(metal(lone), [[0.0, 1.0, 0.0]])
    assert float(edge_on.abs().max()) == 0


def test_triangles_without_area_among_others_change_nothing():
    """A mesh program divides a face at the middle of its diagonal, on one side alone."""
    plain = box([0.3, 0.5, 0.4])
    vertices, faces = [*plain.vertices], []
    for one, other in plain.faces.view(-1, 2, 3).tolist():
        first, last = (corner for corner in one if corner in other)
        (apex,) = (corner for corner in one if corner not in other)
        middle = len(vertices)
        vertices.append((plain.vertices[first] + plain.vertices[last]) / 2)
        parts = [[middle if c == old else c for c in one] for old in (first, last, apex)]
        faces += [other, *parts]  # the last one has its corners on a line
    divided = Mesh(torch.stack(vertices), torch.tensor(faces))
    ways = normalize(float64([[-1.0, 0.2, 0.1], [-1.0, -0.3, 0.4], [1.0, -0.5, -0.4]]))
    # Turned, so that rounding gives these triangles areas of 1e-17 and normals of any direction.
    pose = rigid(rotation_from_vector(float64([0.1, 0.2, 0.3])))
    for edges in (0, 1):
        found, expected = (
            iw.rcs(Scene({"box": Object(mesh, PerfectConductor(), pose)}), ways, [9e9], edges=edges)
            for mesh in (divided, plain)
        )
        gap = (found.cross_section - expected.cross_section).abs().max()
        assert float(gap) < 1e-9 * float(expected.cross_section.abs().max())
