"""Specular paths: closed forms, laws, odd places, derivatives."""

import cmath
import itertools
import math
from typing import Any

import pytest
import scipy.special
import torch
from torch import Tensor

from invertwin.channel import KINDS, RayPaths, trace_paths
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.scene import (
    Dielectric,
    Layer,
    Mesh,
    Multilayer,
    Object,
    PerfectConductor,
    RoughDielectric,
    Scene,
    Slab,
    box,
    dihedral,
    fresnel_coefficients,
    merge_meshes,
    rigid,
    rotation_from_vector,
    slab_coefficients,
    sphere,
    trihedral,
)
from scenes import float64, level_plate, thing

FREQUENCY = 5.8e9
WAVELENGTH = SPEED_OF_LIGHT / FREQUENCY
METAL = PerfectConductor()
GROUND = Scene({"ground": Object(level_plate(200.0, 200.0), METAL)})
HEIGHTS = ([-25.0, 0.0, 2.0], [25.0, 0.0, 1.5])


def trace(scene: Scene, tx: object, rx: object, **options: object) -> RayPaths:
    given = {"rays": 20_000, "depth": 2} | options
    return trace_paths(scene, tx, rx, FREQUENCY, **given)  # type: ignore[arg-type]


def response(paths: RayPaths, frequency: float = FREQUENCY) -> Tensor:
    """Field of all paths of one link, 2 × 2."""
    turn = torch.polar(torch.ones_like(paths.delay), -2 * math.pi * frequency * paths.delay)
    return (paths.coefficient * turn[:, None, None]).sum(0)


def room(material: object = METAL, size: tuple[float, float, float] = (5.0, 4.0, 3.0)) -> Scene:
    return Scene({"room": Object(box(size), material)})  # type: ignore[arg-type]


@pytest.mark.parametrize("rays", [20_000, None])
def test_two_rays_over_a_conducting_ground(rays):
    paths = trace(GROUND, *HEIGHTS, rays=rays)
    assert paths.interaction_count.tolist() == [0, 1]
    free = WAVELENGTH / (4 * math.pi * math.hypot(50, 0.5))
    ratio = (response(paths) / free).abs().diagonal()
    # Two-ray formula |1 + R (d0/d1) exp(−jk(d1 − d0))| with R = +1 in the plane of incidence (V).
    direct, mirrored = math.hypot(50, 0.5), math.hypot(50, 3.5)
    turn = complex(0, -2 * math.pi / WAVELENGTH * (mirrored - direct))
    expected = [abs(1 + r * direct / mirrored * cmath.exp(turn)) for r in (1, -1)]
    assert abs(float(expected[0]) - 1.077195) < 1e-6
    assert abs(float(expected[1]) - 1.682290) < 1e-6
    torch.testing.assert_close(ratio, float64(expected), rtol=1e-9, atol=0)


def test_two_rays_over_earth():
    earth = Dielectric(15.0, 0.01, scattering=0.0)
    scene = Scene({"ground": Object(level_plate(200.0, 200.0), earth)})
    paths = trace(scene, *HEIGHTS)
    sine = 3.5 / math.hypot(50, 3.5)
    r = fresnel_coefficients(earth.complex_permittivity(FREQUENCY), float64([sine]))
    strength = WAVELENGTH / (4 * math.pi * math.hypot(50, 3.5))
    found = paths.coefficient[1] / strength
    torch.testing.assert_close(found[0, 0], r.reflection_p[0], rtol=1e-9, atol=0)
    # φ of waves along x points the other way than of those that come from there.
    torch.testing.assert_close(found[1, 1], -r.reflection_s[0], rtol=1e-9, atol=0)


def test_line_of_sight_is_friis():
    paths = trace(GROUND, [0.0, 0.0, 1.0], [3.0, 4.0, 1.0], depth=0)
    assert len(paths) == 1
    assert float(paths.delay[0]) * SPEED_OF_LIGHT == pytest.approx(5, rel=1e-15)
    power = paths.coefficient[0].abs().square()
    assert float(power[0, 0]) == pytest.approx((WAVELENGTH / (4 * math.pi * 5)) ** 2, rel=1e-12)
    assert float(power[0, 1]) < 1e-30
    torch.testing.assert_close(paths.departure[0], float64([0.6, 0.8, 0.0]))
    torch.testing.assert_close(paths.arrival, -paths.departure)


@pytest.mark.parametrize(("plates", "depth"), [(2, 2), (3, 3)])
def test_corners_send_back_what_comes(plates, depth):
    """Image theory: a corner of plates acts as the point-mirrored source, exactly."""
    shape = dihedral(2.0) if plates == 2 else trihedral(2.0)
    turned = rigid(rotation_from_vector(float64([0.1, 0.02, 0.2])), float64([4.0, 0.2, 0.1]))
    corner = Object(shape, METAL, turned)
    scene = Scene({"corner": corner})
    tx, rx = [0.0, 0.1, 0.0], [0.05, -0.1, 0.1]
    paths = trace(scene, tx, rx, depth=depth)
    last = paths.select(paths.interaction_count == plates)
    faces = corner.vertices[corner.mesh.faces]
    normal = torch.linalg.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    normal = normal / normal.norm(dim=1, keepdim=True)
    one = [normal[0]]
    for n in normal[1:]:
        if all(abs(float(n @ m)) < 0.5 for m in one):
            one.append(n)
    assert len(one) == plates
    apex = _meeting(faces, one)
    turn = torch.eye(3, dtype=torch.float64)
    for n in one:
        turn = turn - 2 * n[:, None] * (n @ turn)[None]
    image = apex + turn @ (float64(tx) - apex)
    length = float((float64(rx) - image).norm())
    assert len(last) == 1
    assert float(last.delay[0]) * SPEED_OF_LIGHT == pytest.approx(length, rel=1e-14)
    # A conductor mirrors E to −(E − 2(n·E)n): the field is that of the turned dipole.
    sent = _basis(last.departure[0])
    field = (sent @ turn.T) * (-1) ** plates
    expected = _basis(last.arrival[0]) @ field.T * WAVELENGTH / (4 * math.pi * length)
    torch.testing.assert_close(last.coefficient[0].real, expected, rtol=0, atol=1e-15)
    assert float(last.coefficient.imag.abs().max()) == 0


def _meeting(faces: Tensor, normals: list[Tensor]) -> Tensor:
    """A point on all planes."""
    offsets = []
    for n in normals:
        area = torch.linalg.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
        row = ((area / area.norm(dim=1, keepdim=True)) @ n).abs().argmax()
        offsets.append(n @ faces[row, 0])
    return torch.linalg.lstsq(torch.stack(normals), torch.stack(offsets)[:, None]).solution[:, 0]


def _basis(direction: Tensor) -> Tensor:
    """Unit vectors of θ and φ."""
    x, y, z = direction.tolist()
    ring = math.hypot(x, y)
    cp, sp = x / ring, y / ring
    return float64([[z * cp, z * sp, -ring], [-sp, cp, 0.0]])


@pytest.mark.parametrize("depth", [3, 5])
def test_a_shoebox_has_the_paths_of_its_images(depth):
    """All images of a rectangular room up to an order, each once, with exact lengths."""
    size = (5.0, 4.0, 3.0)
    tx, rx = [1.3, -1.1, 0.7], [-1.4, 0.9, -0.6]
    paths = trace(room(size=size), tx, rx, depth=depth, rays=200_000)
    lengths = []
    reach = range(-depth, depth + 1)
    for i in reach:
        for j in reach:
            for k in reach:
                if abs(i) + abs(j) + abs(k) <= depth:
                    place = [
                        n * s + (p if n % 2 == 0 else -p)
                        for n, s, p in zip((i, j, k), size, tx, strict=True)
                    ]
                    lengths.append(math.dist(place, rx))
    found = paths.delay * SPEED_OF_LIGHT
    torch.testing.assert_close(found, float64(sorted(lengths)), rtol=1e-13, atol=0)


def test_all_sequences_are_those_that_rays_find():
    scene = room(Dielectric(5.0, 0.1, scattering=0.0))
    ends = [[1.3, -1.1, 0.7], [0.2, 1.0, -0.3]], [[-1.4, 0.9, -0.6], [2.0, -1.5, 1.0]]
    shot, tried = (trace(scene, *ends, depth=3, rays=rays) for rays in (100_000, None))
    assert tried.missed_fraction is None
    assert shot.missed_fraction is not None
    assert 0 <= shot.missed_fraction < 1e-3
    for name in ("delay", "tx", "rx", "kinds", "faces", "coefficient"):
        torch.testing.assert_close(getattr(shot, name), getattr(tried, name))


def test_more_rays_miss_less():
    ball = Scene({"ball": Object(sphere(0.5, 4), METAL, rigid(translation=[0.0, 0.0, 2.0]))})
    few, many = (
        float(trace(ball, [0, 0, 0], [0.3, 0, 0], rays=n).missed_fraction or 0.0)
        for n in (2_000, 200_000)
    )
    assert 0 < many < few


def test_the_way_back_is_the_way_forth():
    panel = thing(
        level_plate(1.0, 1.5), (0.2, 0.1, 0.3), (0.4, 0.3, 0.2), Slab(3.0, 0.02, thickness=0.02)
    )
    scene = Scene({"panel": panel, "room": Object(box((5.0, 4.0, 3.0)), Dielectric(5.0, 0.1))})
    tx, rx = [1.3, -1.1, 0.7], [[-1.4, 0.9, -0.6], [0.4, 1.2, -1.0]]
    forth, back = trace(scene, tx, rx, depth=3), trace(scene, rx, tx, depth=3)
    assert len(forth) > 20
    again = back.reverse()
    for name in ("delay", "coefficient", "departure", "arrival", "vertices"):
        torch.testing.assert_close(
            getattr(forth, name), getattr(again, name), rtol=1e-9, atol=1e-13
        )
    assert torch.equal(forth.kinds, again.kinds)
    assert again.counts == forth.counts


def test_inside_of_a_wall_nothing_gets_out():
    wall = Scene({"wall": Object(box((2.0, 0.2, 2.0)), Dielectric(5.0, 0.1))})
    paths = trace(wall, [0.0, 0.0, 0.0], [[0.3, 2.0, 0.4], [0.3, 0.05, 0.4]], depth=3)
    assert not len(paths.select_link(0, 0))
    assert len(paths.select_link(0, 1)) > 0
    assert float(response(paths.select_link(0, 0)).abs().sum()) == 0


def test_a_lost_link_gives_zeros_and_zero_gradients():
    wall = Scene({"wall": Object(level_plate(50.0, 50.0), METAL)})
    rx = float64([0.3, 0.2, -2.0]).requires_grad_()
    paths = trace(wall, [0.0, 0.0, 2.0], rx, depth=2)
    assert len(paths) == 0
    power = response(paths).abs().square().sum()
    power.backward()
    assert power.item() == 0
    assert rx.grad is not None
    assert not rx.grad.any()


def test_on_a_plate_the_field_is_that_of_a_conductor():
    """E along a conductor vanishes on it, E across doubles."""
    turn = rotation_from_vector(float64([0.3, 0.7, 0.2]))
    wall = Scene(
        {"wall": Object(level_plate(3.0, 3.0), METAL, rigid(turn, float64([0.1, 0.2, 0.3])))}
    )
    place = turn @ float64([0.4, -0.3, 0.0]) + float64([0.1, 0.2, 0.3])
    paths = trace(wall, [1.0, 0.5, 4.0], place, depth=2)
    assert paths.interaction_count.tolist() == [0, 1]
    assert paths.delay.isfinite().all()
    total = torch.zeros(3, 2, dtype=torch.complex128)
    for row in range(2):
        basis = _basis(paths.arrival[row]).to(torch.complex128)
        total = total + basis.T @ paths.coefficient[row]
    normal = turn[:, 2].to(torch.complex128)
    strength = float(paths.coefficient.abs().max())
    along = total - normal[:, None] * (normal @ total)[None]
    assert float(along.abs().max()) < 1e-12 * strength
    direct = _basis(paths.arrival[0]).to(torch.complex128).T @ paths.coefficient[0]
    torch.testing.assert_close(normal @ total, 2 * (normal @ direct))


def test_coplanar_and_doubled_faces_count_once():
    one = Scene({"wall": Object(level_plate(3.0, 3.0), METAL)})
    many = level_plate(3.0, 3.0, divisions=6)
    twice = Mesh(many.vertices, torch.cat([many.faces, many.faces.flip(1)]))
    halves = [
        Object(level_plate(1.5, 3.0), METAL, rigid(translation=[x, 0.0, 0.0]))
        for x in (-0.75, 0.75)
    ]
    ends = [0.5, 0.5, 2.0], [[-0.5, -0.5, 2.0], [0.2, 0.4, 1.0], [0.3, 0.1, 3.0]]
    expected = trace(one, *ends)
    for scene in (
        Scene({"wall": Object(many, METAL)}),
        Scene({"wall": Object(twice, METAL)}),
        Scene({"wall": Object(merge_meshes([twice, level_plate(3.0, 3.0)]), METAL)}),
        Scene({"left": halves[0], "right": halves[1]}),
    ):
        found = trace(scene, *ends)
        torch.testing.assert_close(found.delay, expected.delay, rtol=1e-13, atol=0)
        torch.testing.assert_close(found.coefficient, expected.coefficient, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.3, 0.2, 0.5)])
def test_the_seam_of_two_triangles_is_tight(turn):
    """Paths that meet the diagonal of a plate exactly: none is lost, none slips through."""
    rotation = rotation_from_vector(float64(turn))
    pose = rigid(rotation, float64([0.3, 0.2, 0.7]))
    wall = Scene({"wall": Object(level_plate(2.0, 2.0), METAL, pose)})
    share = torch.linspace(-0.9, 0.9, 200, dtype=torch.float64)
    corners = wall["wall"].vertices
    faces = wall["wall"].mesh.faces
    first, second = (corners[v] for v in sorted(set(faces[0].tolist()) & set(faces[1].tolist())))
    seam = (first + second) / 2 + share[:, None] * (second - first) / 2
    normal = rotation[:, 2]
    tx = float64([0.3, 0.2, 0.7]) + 1.5 * normal
    offset = seam - tx
    away = offset - 2 * (offset @ normal)[:, None] * normal
    mirrored, behind = trace(wall, tx, seam + away), trace(wall, tx, seam + offset)
    assert torch.equal(
        mirrored.interaction_count.view(200, 2).sort(1).values, torch.tensor([[0, 1]] * 200)
    )
    assert len(behind) == 0


def test_rough_surfaces_mirror_nothing():
    scene = Scene({"ground": Object(level_plate(200.0, 200.0), RoughDielectric(4.0))})
    assert trace(scene, *HEIGHTS).interaction_count.tolist() == [0]
    share = Dielectric(15.0, 0.01, scattering=0.6)
    whole = Dielectric(15.0, 0.01, scattering=0.0)
    both = [trace(GROUND.replace("ground", material=m), *HEIGHTS) for m in (share, whole)]
    torch.testing.assert_close(both[0].coefficient[1], 0.8 * both[1].coefficient[1])


def slab(thickness: float = 0.05) -> Slab:
    return Slab(4.0, 0.05, thickness=thickness)


@pytest.mark.parametrize("angle", [0.0, 0.6, 1.2])
def test_a_slab_lets_through_what_it_should(angle):
    """Both polarisations, and the phase: that of the slab less that of as much air."""
    board = Scene(
        {"board": thing(level_plate(60.0, 60.0), turn=(0.0, angle, 0.0), material=slab())}
    )
    paths = trace(board, [0.1, 0.0, -1.5], [0.1, 0.0, 2.0], depth=2)
    assert paths.interaction_count.tolist() == [1]
    assert paths.kinds.tolist() == [[2]]
    cosine = float64([math.cos(angle)])
    t = slab_coefficients([slab().sheet(FREQUENCY)], cosine[:, None], FREQUENCY)
    k = 2 * math.pi / WAVELENGTH
    air = cmath.exp(1j * k * 0.05 * math.cos(angle))
    strength = WAVELENGTH / (4 * math.pi * 3.5)
    found = paths.coefficient[0] / strength
    # The plane of incidence is x–z; along the z axis V is −x or x and H is y.
    assert abs(complex(found[1, 1]) - complex(t.transmission_s) * air) < 1e-12
    assert abs(complex(found[0, 0]) + complex(t.transmission_p) * air) < 1e-12
    assert float(found[0, 1].abs() + found[1, 0].abs()) < 1e-12


def test_a_slab_of_air_is_not_there():
    scene = room(Dielectric(5.0, 0.1))
    ends = [1.3, -1.1, 0.7], [-1.4, 0.9, -0.6]
    air = thing(level_plate(20.0, 20.0), (0.2, 0.1, 0.3), (0.4, 0.3, 0.2), Slab(1.0, thickness=0.2))
    with_air = trace(Scene({**scene.objects, "air": air}), *ends, depth=3)
    through = with_air.select((with_air.kinds == 2).any(1))
    assert len(through) > 3
    bare = trace(scene, *ends, depth=3)
    assert len(bare) == len(with_air)  # a passage uses up nothing of the depth
    for row in range(len(through)):
        same = (bare.departure - through.departure[row]).norm(dim=1) < 1e-9
        same &= (bare.delay - through.delay[row]).abs() < 1e-18
        assert int(same.sum()) == 1
        torch.testing.assert_close(
            bare.coefficient[same][0], through.coefficient[row], rtol=1e-12, atol=1e-18
        )


def test_two_boards_multiply_and_a_wall_between_them_mirrors():
    boards = {
        name: thing(level_plate(3.0, 3.0), (0.0, 0.0, z), material=slab())
        for name, z in (("near", 1.0), ("far", 2.0))
    }
    paths = trace(Scene(boards), [0.0, 0.0, 0.0], [0.0, 0.0, 3.0], depth=2)
    # Straight through both, and with two mirrors between them.
    assert [[k for k in row if k] for row in paths.kinds.tolist()] == [[2, 2], [2, 1, 1, 2]]
    assert paths.length[1] == pytest.approx(5.0)
    one = trace(Scene({"near": boards["near"]}), [0.0, 0.0, 0.0], [0.0, 0.0, 3.0])
    share = one.coefficient[0, 1, 1] * 4 * math.pi * 3 / WAVELENGTH
    whole = paths.coefficient[0, 1, 1] * 4 * math.pi * 3 / WAVELENGTH
    torch.testing.assert_close(whole, share**2)


@pytest.mark.parametrize("rays", [20_000, None])
def test_sheets_on_the_way_use_up_no_depth(rays: int | None):
    """Five boards and a floor: the straight path, and that by way of the floor."""
    boards = {
        f"board {k}": thing(level_plate(4.0, 4.0), (float(k), 0.0, 0.0), (0.0, 1.5, 0.0), slab())
        for k in range(1, 6)
    }
    floor = thing(level_plate(40.0, 40.0), (0.0, 0.0, -1.9), material=METAL)
    scene = Scene(boards | {"floor": floor})
    ends = [0.0, 0.1, 0.3], [6.0, 0.2, -0.4]
    straight = trace(scene, *ends, depth=0, rays=rays)
    assert straight.kinds.tolist() == [[2] * 5]
    found = trace(scene, *ends, depth=1, rays=rays)
    on_floor = found.select((found.objects == found.names.index("floor")).any(1))
    assert [row.count(2) for row in on_floor.kinds.tolist()] == [5]
    back = trace(scene, ends[1], ends[0], depth=1, rays=rays)
    assert back.delay.sort().values.tolist() == pytest.approx(found.delay.sort().values.tolist())


def test_layers_of_one_material_are_one_slab():
    two = Multilayer([Layer(4.0, 0.05, thickness=0.02), Layer(4.0, 0.05, thickness=0.03)])
    found = [
        trace(
            Scene({"board": thing(level_plate(9.0, 9.0), turn=(0.3, 0.2, 0.0), material=material)}),
            [0.0, 0.0, -1.5],
            [[0.1, 0.4, 2.0], [0.3, 0.1, -1.0]],
        )
        for material in (slab(), two)
    ]
    assert found[0].kinds.sum() == 3  # once through, once mirrored, and the line of sight
    torch.testing.assert_close(found[0].coefficient, found[1].coefficient)


def test_values_of_each_triangle_count():
    """Two halves of one wall, dry and wet."""
    wall = level_plate(2.0, 2.0, divisions=2)
    left = wall.vertices[wall.faces].mean(1)[:, 0] < 0
    mixed = Dielectric(torch.where(left, 4.0, 25.0).double(), scattering=0.0)
    dry, wet = Dielectric(4.0, scattering=0.0), Dielectric(25.0, scattering=0.0)
    tx, rx = [0.0, 0.0, 2.0], [[-0.6, 0.0, 2.0], [0.6, 0.0, 2.0]]
    found, low, high = (
        trace(Scene({"wall": Object(wall, material)}), tx, rx).coefficient.view(2, 2, 2, 2)[:, 1]
        for material in (mixed, dry, wet)
    )
    torch.testing.assert_close(found, torch.stack([low[0], high[1]]))
    assert float((low[0] - high[0]).abs().max()) > 1e-4


def test_gradients_are_differences():
    """Response of a room by every vertex, both antennas and the material."""
    walls, base = (box((5.0, 4.0, 3.0)), box((0.6, 0.7, 0.8)))

    def value(change: Tensor) -> Tensor:
        offsets = change[:48].view(16, 3)
        wall = Dielectric(4.0 + change[54], 0.1 + change[55], scattering=0.0)
        outer = Mesh(walls.vertices + offsets[:8], walls.faces)
        inner = Mesh(base.vertices + float64([1.0, 0.4, -0.6]) + offsets[8:], base.faces)
        board = Slab(3.0 + change[56], 0.02, thickness=0.02 + change[57])
        scene = Scene(
            {
                "room": Object(outer, wall),
                "box": Object(inner, METAL),
                "board": thing(level_plate(1.5, 1.5), (-0.3, 0.1, 0.2), (0.3, 1.2, 0.0), board),
            }
        )
        tx = float64([1.3, -1.1, 0.7]) + change[48:51]
        rx = float64([-1.4, 0.9, -0.6]) + change[51:54]
        found = trace_paths(scene, tx, rx, 3e8, depth=3, rays=20_000)
        return torch.view_as_real(response(found, 3e8)).flatten()

    zero = torch.zeros(58, dtype=torch.float64)
    tangent = torch.randn(4, 58, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(value, zero)
    for direction in tangent:
        step = 1e-6 * direction
        truth = (value(zero + step) - value(zero - step)) / 2e-6
        found = jacobian @ direction
        assert float((found - truth).norm() / truth.norm()) < 1e-6


def test_forward_mode_agrees():
    scene = room(Dielectric(4.0, 0.1))

    def value(rx: Tensor) -> Tensor:
        paths = trace(scene, [1.3, -1.1, 0.7], rx)
        return torch.view_as_real(response(paths)).flatten()

    place = float64([-1.4, 0.9, -0.6])
    forward = torch.func.jacfwd(value)(place)
    torch.testing.assert_close(forward, torch.autograd.functional.jacobian(value, place))


def test_doppler_is_that_of_moved_geometry():
    spinning = level_plate(2.0, 2.0)
    angular = float64([0.3, -0.4, 0.5])
    velocity = torch.linalg.cross(angular.expand(4, 3), spinning.vertices) + float64([0.5, 2, -1])
    panel = Object(spinning, METAL, rigid(translation=[0.0, 0.0, 3.0]), velocity)
    wall = Object(
        level_plate(9.0, 9.0), METAL, rigid(translation=[0.0, 0.0, -2.0]), float64([0.0, 0.0, -3.0])
    )
    scene = Scene({"panel": panel, "wall": wall})
    tx, rx = float64([0.2, 0.1, 0.5]), float64([-0.3, 0.2, 0.1])
    moves = float64([1.0, 2.0, 3.0]), float64([-3.0, 0.5, 1.0])

    def at(time: float) -> RayPaths:
        return trace(scene.advance(time), tx + moves[0] * time, rx + moves[1] * time, depth=4)

    paths = trace(scene, tx, rx, depth=4, tx_velocity=moves[0], rx_velocity=moves[1])
    later, earlier = at(1e-5), at(-1e-5)
    assert len(paths) > 5
    assert torch.equal(paths.kinds, later.kinds)
    expected = -FREQUENCY * (later.delay - earlier.delay) / 2e-5
    torch.testing.assert_close(paths.doppler, expected, rtol=1e-6, atol=1e-3)


def test_ten_thousand_receivers():
    places = torch.rand(10_000, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    rx = (places - 0.5) * float64([4.9, 3.9, 2.9])
    paths = trace(room(), [1.3, -1.1, 0.7], rx, depth=2, rays=10_000)
    row, filled = paths.pad_links()
    assert row.shape == (1, 10_000, 25)  # 1, 6 and 18 images
    assert filled.all()
    assert torch.equal(paths.rx[row[0]], torch.arange(10_000)[:, None].expand(-1, 25))


def test_pieces_add_up(monkeypatch):
    """Many paths are computed piece by piece, and again for their derivatives."""
    rx = [[-1.4, 0.9, -0.6], [0.4, 1.2, -1.0], [2.0, -1.5, 1.0]]
    found = []
    for rows in (1 << 15, 7):
        monkeypatch.setattr("invertwin.channel.specular.trace_paths._ROWS_AT_ONCE", rows)
        walls = box((5.0, 4.0, 3.0))
        vertices = walls.vertices.clone().requires_grad_()
        scene = room(Dielectric(4.0, 0.1)).replace("room", mesh=Mesh(vertices, walls.faces))
        paths = trace(scene, [1.3, -1.1, 0.7], rx, depth=3)
        response(paths).abs().square().sum().backward()
        found.append((paths.delay.detach(), paths.coefficient.detach(), vertices.grad))
    for whole, pieces in zip(*found, strict=True):
        torch.testing.assert_close(pieces, whole)


def test_a_scene_of_20_000_triangles():
    """Every path obeys the laws: lengths are those of its pieces, angles at mirrors are equal."""
    ball = Object(sphere(0.5, 5), METAL, rigid(translation=[0.0, 0.0, 2.0]))
    scene = Scene({**room(size=(6.0, 6.0, 6.0)).objects, "ball": ball})
    places = torch.rand(60, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    tx, rx = float64([0.3, 0.0, 0.0]), places * float64([2.0, 2.0, 1.0])
    rx[0] = float64([0.0, 0.0, 2.9])
    paths = trace(scene, tx, rx, rays=100_000)
    assert len(ball.mesh.faces) == 20_480
    met = paths.objects == paths.names.index("ball")
    assert int(met.any(1).sum()) >= 3
    assert not bool((paths.select_link(0, 0).interaction_count == 0).any())  # in its shadow
    radius = (paths.vertices[met] - float64([0.0, 0.0, 2.0])).norm(dim=1)
    assert float((radius - 0.5).abs().max()) < 1e-3
    vertices = torch.cat([item.vertices for item in scene.objects.values()])
    room_faces = scene["room"].mesh.faces
    faces = torch.cat([room_faces, ball.mesh.faces + len(scene["room"].mesh.vertices)])
    for row in torch.nonzero(met.any(1))[:20, 0].tolist():
        depth = int(paths.interaction_count[row])
        points = [tx, *paths.vertices[row, :depth], rx[paths.rx[row]]]
        pieces = [b - a for a, b in itertools.pairwise(points)]
        total = sum(float(piece.norm()) for piece in pieces)
        assert paths.length[row].item() == pytest.approx(total, rel=1e-12)
        for before, after, face in zip(pieces, pieces[1:], paths.faces[row], strict=False):
            a, b, c = vertices[faces[face]]
            normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=0)
            change = after / after.norm() - before / before.norm()
            along = change - (change @ normal) * normal
            assert float(along.norm()) < 1e-9


def walk(places: Tensor, plane: Scene, edges: int) -> Tensor:
    """Field over that of free space along a walk behind a plate."""
    paths = trace(plane, [0.0, 0.0, -8.0], places, edges=edges, depth=1)
    fields = [response(paths.select_link(0, n))[0, 0].abs() for n in range(len(places))]
    free = WAVELENGTH / (4 * math.pi * (places - float64([0.0, 0.0, -8.0])).norm(dim=1))
    return torch.stack(fields) / free


def test_shadows_have_no_edge_with_diffraction():
    """Half of the field on the boundary of a half plane, and no jump there."""
    half = Scene(
        {"half": Object(level_plate(60.0, 60.0), METAL, rigid(translation=[-30.0, 0.0, 0.0]))}
    )
    x = torch.linspace(-0.5, 0.5, 41, dtype=torch.float64) + 1e-4
    places = torch.stack([x, torch.zeros(41).double(), torch.full((41,), 6.0).double()], 1)
    optics, whole = walk(places, half, 0), walk(places, half, 1)
    assert float(optics.diff().abs().max()) == pytest.approx(1.0, abs=1e-6)
    assert float(whole.diff().abs().max()) < 0.15
    assert whole[20].item() == pytest.approx(0.5, abs=0.01)
    # Kirchhoff's integral of a straight edge, a few wavelengths off the boundary and more.
    v = x * math.sqrt(2 / WAVELENGTH * (8 + 6) / (8 * 6)) * 8 / 14
    s, c = (torch.from_numpy(f) for f in scipy.special.fresnel((-v).numpy()))
    knife = ((0.5 - c) ** 2 + (0.5 - s) ** 2).sqrt() / math.sqrt(2)
    torch.testing.assert_close(whole, knife, rtol=0, atol=0.02)


def test_the_size_of_a_plate_has_a_derivative_with_diffraction():
    def value(size: Tensor, edges: int) -> Tensor:
        base = level_plate(1.0, 1.0)
        mesh = Mesh(base.vertices * (1 + size), base.faces)
        scene = Scene({"plate": Object(mesh, METAL, rigid(translation=[0.05, 0.02, 0.0]))})
        found = trace(scene, [0.1, 0.2, 2.0], [0.3, -0.1, 1.5], edges=edges)
        return torch.view_as_real(response(found)).flatten()

    zero = torch.zeros((), dtype=torch.float64)
    for edges in (1, 2, 3):
        found: Any = torch.autograd.functional.jacobian(lambda t, n=edges: value(t, n), zero)
        truth = (value(zero + 1e-5, edges) - value(zero - 1e-5, edges)) / 2e-5
        assert float((found - truth).norm() / truth.norm()) < 1e-4
    assert not (value(zero + 1e-3, 0) - value(zero, 0)).any()


def test_paths_over_three_edges_reach_the_side_of_a_box_away_from_the_transmitter():
    """Round three edges of a tall box, and back the same way."""
    scene = Scene({"tower": Object(box((2.0, 40.0, 2.0)), METAL)})
    ends = [4.0, 0.2, 0.5], [1.9, -0.3, -6.0]
    deep = [trace(scene, *ends, edges=edges, depth=1) for edges in (2, 3)]
    three = (deep[1].kinds == KINDS.index("diffraction")).sum(1) == 3
    assert int(three.sum()) >= 4
    assert len(deep[0]) == int((~three).sum())
    back = trace(scene, *reversed(ends), edges=3, depth=1)
    torch.testing.assert_close(response(deep[1]), response(back).mT, rtol=1e-9, atol=1e-16)


def test_four_edges_are_too_many():
    with pytest.raises(InputError, match="at most 3 edges"):
        trace(GROUND, *HEIGHTS, edges=4)


def test_padded_links_may_be_empty():
    wall = Scene({"wall": Object(level_plate(50.0, 50.0), METAL)})
    paths = trace(wall, [[0, 0, 2.0], [0, 0, 1.0]], [[1, 0, -1.0], [1, 0, 1.0], [0, 1, 1.0]])
    row, filled = paths.pad_links()
    assert row.shape == (2, 3, 2)
    assert filled.sum(2).tolist() == [[0, 2, 2], [0, 2, 2]]
    assert paths.delay[row][filled].min() > 0


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tx": [1.0, 2.0]}, "tx positions"),
        ({"rx": []}, "rx"),
        ({"tx": [float("nan"), 0.0, 0.0]}, "finite tx positions"),
        ({"frequency": -1.0}, "frequency"),
        ({"depth": 7}, r"at most 6 reflections \(depth\), got 7"),
        ({"rays": 0}, "rays"),
        ({"rx_velocity": [[1.0, 2.0, 3.0]] * 2}, "rx velocities"),
    ],
)
def test_bad_input_is_told(options, message):
    given = {"tx": [0.0, 0.0, 1.0], "rx": [1.0, 0.0, 1.0], "frequency": FREQUENCY} | options
    ends = [given.pop(name) for name in ("tx", "rx", "frequency")]
    with pytest.raises(InputError, match=message):
        trace_paths(GROUND, *ends, **given)


def test_too_many_sequences_are_refused():
    ball = Scene({"ball": Object(sphere(0.5, 3), METAL)})
    with pytest.raises(InputError, match="sequences to test one by one"):
        trace(ball, [0, 0, 2], [0, 2, 0], depth=3, rays=None)
