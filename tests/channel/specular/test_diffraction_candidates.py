"""Diffracted paths with mirrors and sheets before and after the edge, seams, motion."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.func import jvp

from invertwin.channel import RayPaths, trace_paths
from invertwin.scene import (
    Material,
    Mesh,
    Object,
    PerfectConductor,
    Scene,
    Slab,
    box,
    merge_meshes,
    plate,
    rigid,
    rotation_from_vector,
)
from invertwin.scene.mesh import concatenate_meshes
from scenes import float64, level_plate

FREQUENCY = 5.8e9
METAL = PerfectConductor()
CONCRETE, GLASS = Slab.itu("concrete", thickness=0.1), Slab.itu("glass", thickness=0.02)
ACROSS_Y = rotation_from_vector(float64([0.0, 0.0, -math.pi / 2]))
TX, RX = float64([0.4, -4.0, 1.5]), float64([-0.3, 5.0, 0.8])
MIRROR = float64([1.0, 1.0, -1.0])
NAMES = {"": 0, "R": 1, "T": 2, "D": 3}


def scene(wall: Material = METAL, floor: Material = METAL, **others: Object) -> Scene:
    """An upright wall above a floor."""
    objects = {
        "floor": Object(level_plate(60.0, 60.0), floor),
        "wall": Object(plate(2.0, 3.0), wall, rigid(ACROSS_Y, float64([0.3, 0.2, 2.0]))),
    }
    return Scene(objects | others)


def pane(material: Material = CONCRETE, size: float = 40.0) -> Object:
    return Object(plate(size, size), material, rigid(ACROSS_Y, float64([0.0, -2.0, 2.0])))


def trace(around: Scene, tx: Tensor = TX, rx: Tensor = RX, **options: Any) -> RayPaths:
    given: dict[str, Any] = {"rays": 20_000, "depth": 2, "edges": 1} | options
    return trace_paths(around, tx, rx, FREQUENCY, **given)


def response(paths: RayPaths) -> Tensor:
    """Field of all paths by receiver, 2 × 2."""
    turn = torch.polar(torch.ones_like(paths.delay), -2 * math.pi * FREQUENCY * paths.delay)
    total = torch.zeros(paths.counts[1], 2, 2, dtype=torch.complex128)
    return total.index_add(0, paths.rx, paths.coefficient * turn[:, None, None])


def of_kind(paths: RayPaths, steps: str, edge_of: str = "wall") -> RayPaths:
    """Paths of these steps round edges of an object, by delay."""
    kinds = torch.tensor([NAMES[step] for step in steps] + [0] * 6)[: paths.kinds.shape[1]]
    good = (paths.kinds == kinds).all(1)
    if "D" in steps:
        good &= paths.objects[:, steps.index("D")] == paths.names.index(edge_of)
    return paths.select(good)


@pytest.mark.parametrize(
    ("steps", "floor"), [("D", ""), ("RD", "tx"), ("DR", "rx"), ("RDR", "both")]
)
def test_beside_a_mirror_edges_are_seen_from_images(steps, floor):
    """By a conductor V of the image is V, and H turns round."""
    paths = of_kind(trace(scene(), depth=3), steps)
    tx = TX * MIRROR if floor in ("tx", "both") else TX
    rx = RX * MIRROR if floor in ("rx", "both") else RX
    alone = Scene({"wall": scene().objects["wall"]})
    images = of_kind(trace(alone, tx, rx, depth=1), "D")
    assert len(paths) == len(images) == 4
    torch.testing.assert_close(paths.delay, images.delay, rtol=1e-15, atol=0)
    turned = torch.diag(float64([1.0, -1.0])).to(torch.complex128)
    same = torch.eye(2, dtype=torch.complex128)
    expected = images.coefficient @ (turned if floor in ("tx", "both") else same)
    expected = (turned if floor in ("rx", "both") else same) @ expected
    scale = float(expected.abs().max())
    torch.testing.assert_close(paths.coefficient, expected, rtol=0, atol=1e-13 * scale)


def step_at(
    around: Scene, line: tuple[Tensor, Tensor], steps: str, depth: int = 2
) -> tuple[float, float]:
    """Jumps of all paths and of those without edges, over the field, where one comes or goes."""
    start, way = line

    def there(share: float) -> int:
        return len(of_kind(trace(around, rx=start + share * way, edges=0), steps))

    low, high = 0.0, 1.0
    first = there(low)
    assert first != there(high)
    for _ in range(44):
        middle = (low + high) / 2
        low, high = (middle, high) if there(middle) == first else (low, middle)
    # What changes beside the jump is taken off.
    shares = float64([-2e-7, -1e-7, 1e-7, 2e-7]) + low
    places = start + shares[:, None] * way
    found, scale = [], 0.0
    every: tuple[dict[str, Any], ...] = ({"depth": depth}, {"edges": 0})
    for options in every:
        field = response(trace(around, rx=places, **options))
        scale = scale or float(field[1].norm())
        jump = (2 * field[2] - field[3]) - (2 * field[1] - field[0])
        found.append(float(jump.norm()) / scale)
    return found[0], found[1]


LOW, UP = float64([0.5, 5.3, 2.5]), float64([0.02, 0.05, 0.9])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("around", "steps"),
    [
        (scene(), "R"),
        (scene(CONCRETE, CONCRETE), "R"),
        pytest.param(scene(METAL, GLASS, pane=pane()), "TR", marks=pytest.mark.claim),
    ],
)
def test_mirrored_waves_end_at_edges_without_a_jump(around, steps):
    whole, optics = step_at(around, (LOW, UP), steps)
    assert optics > 0.5
    assert whole < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("depth", [1, 2])
def test_what_is_mirrored_once_more_ends_at_edges_without_a_jump(depth):
    """From the floor by the wall; with one surface, edges behind the floor mirror nothing."""
    line = float64([0.2, -3.5, 1.8]), float64([0.02, 0.05, 0.9])
    whole, optics = step_at(scene(), line, "RR", depth)
    assert optics > 0.1
    assert whole < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize(("steps", "depth"), [("T", 0), ("TR", 1)])
def test_what_passes_a_sheet_ends_at_its_rim_without_a_jump(steps, depth):
    """Without reflections that are left, edges of a sheet still transmit."""
    line = float64([0.5, 5.3, 1.2]), float64([5.0, 0.05, 0.1])
    whole, optics = step_at(scene(GLASS), line, steps, depth)
    assert optics > 0.1
    assert whole < 1e-6


def test_sheets_before_an_edge_are_those_of_the_straight_path():
    """Through a large pane, every diffracted wave keeps what the pane lets through."""
    air = Slab(1.0, 0.0, thickness=0.05)
    plain, through = trace(scene(), depth=3), trace(scene(pane=pane(air, 60.0)), depth=3)
    first, second = of_kind(plain, "D"), of_kind(through, "TD")
    assert len(first) == len(second) == 4
    torch.testing.assert_close(first.delay, second.delay, rtol=1e-14, atol=0)
    torch.testing.assert_close(first.coefficient, second.coefficient, rtol=1e-9, atol=1e-16)
    glass = of_kind(trace(scene(pane=pane(GLASS, 60.0)), depth=3), "TD")
    share = glass.coefficient.abs().sum((1, 2)) / second.coefficient.abs().sum((1, 2))
    assert bool(((share > 0.1) & (share < 0.99)).all())


def test_the_way_back_is_the_way_forth():
    around = scene(CONCRETE, GLASS, pane=pane(size=1.5))
    rx = torch.stack([RX, float64([1.2, 4.0, 2.0])])
    forth, back = trace(around, TX, rx), trace(around, rx, TX).reverse()
    met = {"".join("-RTD"[kind] for kind in row if kind) for row in forth.kinds.tolist()}
    assert {"RD", "DR", "TD", "DT"} <= met
    assert len(forth) == len(back)
    there, again = response(forth), response(back)
    assert float((there - again).norm() / there.norm()) < 1e-9
    torch.testing.assert_close(forth.delay, back.delay, rtol=1e-12, atol=0)


def test_all_sequences_are_those_that_rays_find():
    around = scene(CONCRETE, GLASS, pane=pane(size=1.5))
    found = trace(around, rays=300_000), trace(around, rays=None)
    # From the far ends of the floor, the wall and the pane behind one another are small.
    at_floor = [((paths.kinds == 3) & (paths.objects == 0)).any(1) for paths in found]
    shot, tried = (
        paths.select(~rows).sort_rows() for paths, rows in zip(found, at_floor, strict=True)
    )
    assert len(shot) == len(tried) > 20
    torch.testing.assert_close(shot.delay, tried.delay)
    torch.testing.assert_close(shot.coefficient, tried.coefficient)


def test_a_lost_link_gives_zeros_and_zero_gradients():
    room = scene(pane=Object(box((1.0, 1.0, 1.0)), METAL, rigid(translation=[0.4, -4.0, 1.5])))
    rx = RX.clone().requires_grad_()
    paths = trace(room, TX, rx)
    assert len(paths) == 0
    power = response(paths).abs().square().sum()
    power.backward()
    assert power.item() == 0
    assert rx.grad is not None
    assert not rx.grad.any()


@pytest.mark.slow
def test_gradients_are_differences():
    """By the wall's place and turn, its size, the floor's height and the antennas."""
    base, ground = plate(2.0, 3.0), level_plate(60.0, 60.0)

    def value(change: Tensor) -> Tensor:
        size = torch.stack([change[2], 1 + change[0], 1 - change[1]])
        pose = rigid(
            rotation_from_vector(float64([0.0, 0.0, -math.pi / 2]) + change[3:6]),
            float64([0.3, 0.2, 2.0]) + change[6:9],
        )
        height = torch.stack([0 * change[9], 0 * change[9], change[9]])
        around = Scene(
            {
                "floor": Object(Mesh(ground.vertices + height, ground.faces), GLASS),
                "wall": Object(Mesh(base.vertices * size, base.faces), CONCRETE, pose),
                "pane": pane(),
            }
        )
        field = response(trace(around, TX + change[10:13], RX + change[13:16]))
        return torch.view_as_real(field).flatten()

    zero = torch.zeros(16, dtype=torch.float64)
    found: Any = torch.autograd.functional.jacobian(value, zero)
    for index in range(16):
        step = torch.zeros(16, dtype=torch.float64)
        step[index] = 1e-6
        truth = (value(zero + step) - value(zero - step)) / 2e-6
        assert float((found[:, index] - truth).norm()) < 1e-5 * float(found.norm(dim=0).max())


def test_forward_mode_of_torch_func_agrees_with_reverse_mode():
    def value(shift: Tensor) -> Tensor:
        wall = scene().replace("wall", pose=rigid(ACROSS_Y, float64([0.3, 0.2, 2.0]) + shift))
        return torch.view_as_real(response(trace(wall, depth=1))).square().sum()

    zero, way = torch.zeros(3, dtype=torch.float64), float64([0.6, -0.3, 0.5])
    (reverse,) = torch.autograd.grad(value(leaf := zero.requires_grad_()), leaf)
    forward = jvp(value, (zero.detach(),), (way,))[1]
    assert float(forward) == pytest.approx(float(reverse @ way), rel=1e-9)
    assert float(reverse @ way) != 0


def test_doppler_is_that_of_moved_geometry():
    angular = float64([0.3, -0.4, 0.5])
    turned = plate(2.0, 3.0).vertices @ ACROSS_Y.T
    velocity = torch.linalg.cross(angular.expand(4, 3), turned) + float64([0.5, 2.0, -1.0])
    down = float64([0.0, 0.0, -3.0])
    moving = Scene(
        {
            "floor": Object(level_plate(60.0, 60.0), METAL, velocity=down),
            "wall": Object(
                plate(2.0, 3.0), METAL, rigid(ACROSS_Y, float64([0.3, 0.2, 2.0])), velocity
            ),
        }
    )
    moves = float64([1.0, 2.0, 3.0]), float64([-3.0, 0.5, 1.0])

    def at(time: float) -> RayPaths:
        return trace(moving.advance(time), TX + moves[0] * time, RX + moves[1] * time)

    paths = trace(moving, tx_velocity=moves[0], rx_velocity=moves[1])
    later, earlier = at(1e-6), at(-1e-6)
    assert len(paths) > 10
    assert torch.equal(paths.kinds, later.kinds)
    expected = -FREQUENCY * (later.delay - earlier.delay) / 2e-6
    torch.testing.assert_close(paths.doppler, expected, rtol=1e-6, atol=1e-2)


def test_seams_do_not_diffract():
    """Two plates side by side are one; so are they with their vertices in common."""
    left = Object(plate(2.0, 2.0), METAL, rigid(ACROSS_Y, float64([-1.0, 0.2, 2.0])))
    right = Object(plate(2.0, 2.0), METAL, rigid(ACROSS_Y, float64([1.0, 0.2, 2.0])))
    both = trace(Scene({"left": left, "right": right}), depth=1)
    whole = Object(plate(4.0, 2.0), METAL, rigid(ACROSS_Y, float64([0.0, 0.2, 2.0])))
    one = trace(Scene({"whole": whole}), depth=1)
    assert not bool((both.vertices[:, 0, 0].abs() < 1e-6).any())
    torch.testing.assert_close(response(both), response(one), rtol=1e-2, atol=0)


def test_a_box_on_the_floor_has_no_edges_there():
    body = Object(box((1.0, 1.0, 1.0)), METAL, rigid(translation=[0.0, 0.0, 0.5]))
    around = Scene({"floor": scene().objects["floor"], "box": body})
    paths = trace(around, rx=float64([2.0, 5.0, 1.6]))
    edge = (paths.kinds == 3) & (paths.objects == 1)
    heights = paths.vertices[edge][:, 2]
    assert len(heights) > 2
    # Points of upright edges may be their feet; floor edges of the box would lie between.
    flat = paths.vertices[edge][heights.abs() < 1e-9]
    torch.testing.assert_close(flat[:, :2].abs(), torch.full_like(flat[:, :2], 0.5))


def test_a_leak_between_coplanar_faces_is_none():
    """Behind a wall in many pieces, nothing passes along its mesh_topology."""
    around = Scene({"wall": Object(plate(3.0, 3.0, divisions=8), METAL)})
    tx = float64([-3.0, 0.0, 0.0])
    share = torch.linspace(-1.0, 1.0, 101, dtype=torch.float64)
    seams = torch.stack([torch.full((101,), 3.0).double(), share, torch.zeros(101).double()], 1)
    paths = trace(around, tx, seams, depth=1)
    outside = paths.vertices[:, 0, 1:].abs().amax(1)
    assert len(paths) == 4 * 101
    torch.testing.assert_close(outside, torch.full_like(outside, 1.5))
    assert float(paths.length.min()) > 6.0


def diffracted_power(parts: list[Mesh], move: Tensor, order: int = 1) -> Tensor:
    """Sum of the diffracted fields at places behind bodies that move and turn together."""
    turn = rotation_from_vector(move[0] * float64([0.3, 0.2, -0.1]) + float64([0.1, 0.15, 0.5]))
    pose = rigid(turn, float64([1.4, 0.0, 0.0]) + move[0] * float64([-0.4, 0.3, 0.2]))
    bodies = Scene({str(n): Object(part, METAL, pose) for n, part in enumerate(parts)})
    rx = float64([[2.2, 0.1, 0.05], [2.3, -0.1, 0.1], [2.0, 0.35, -0.1]])
    found = trace_paths(
        bodies, float64([0.0, 0.03, 0.02]), rx, 3.5e9, depth=0, edges=order, rays=None
    )
    phase = -2 * math.pi * 3.5e9 * found.delay
    field = found.coefficient[:, 0, 0] * torch.polar(torch.ones_like(phase), phase)
    return torch.zeros(3, dtype=torch.complex128).index_add(0, found.rx, field).abs().square()


@pytest.mark.parametrize("turned", [0.0, 0.3])
def test_bodies_that_cross_diffract_as_their_united_surface_does(turned):
    """Edges end where they enter the other body, with the waves of these corners."""
    turn = rotation_from_vector(turned * float64([0.7, 1.0, 1.3]))
    bar = Mesh(box((0.3, 0.18, 0.5)).vertices @ turn.T, box((0.3, 0.18, 0.5)).faces)
    parts = [box((0.18, 0.5, 0.18)), bar]
    zero, one = torch.zeros(1).double(), torch.ones(1).double()
    clean = merge_meshes(parts)
    expected = jvp(lambda move: diffracted_power([clean], move), (zero,), (one,))
    for found in (parts, [concatenate_meshes(parts)]):
        pair = jvp(lambda move: diffracted_power(found, move), (zero,), (one,))  # noqa: B023
        for value, clean in zip(pair, expected, strict=True):
            assert float((value - clean).norm() / clean.norm()) < 5e-3


def test_a_plate_on_the_whole_face_of_a_box_changes_no_diffraction():
    body, zero = box((0.25, 0.4, 0.5)), torch.zeros(1).double()
    front = plate(0.4, 0.5)
    cover = Mesh(front.vertices - float64([0.125, 0.0, 0.0]), front.faces)
    both, alone = diffracted_power([body, cover], zero), diffracted_power([body], zero)
    torch.testing.assert_close(both, alone, rtol=1e-9, atol=0.0)
    assert (alone > 0).any()
