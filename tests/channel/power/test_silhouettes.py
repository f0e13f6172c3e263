"""How edges are chosen, and which of them a shadow ends at."""

import math

import numpy as np
import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from invertwin.channel import Grid, Sampling, deposit_power, use_backend
from invertwin.channel.power.discrete import DiscreteSampler
from invertwin.channel.rays.backend import mi
from invertwin.scene import (
    Mesh,
    Object,
    RoughDielectric,
    Scene,
    plate,
    rigid,
    rotation_from_vector,
    sphere,
)
from scenes import float64, link, noise, thing


def growth(bodies: list[Object], rest: Object, grid: Grid, sampling: Sampling, seed: int) -> Tensor:
    """∂map/∂size of bodies in front of something else."""
    with forward_ad.dual_level():
        size = torch.ones((), dtype=torch.float64)
        size = forward_ad.make_dual(size, torch.ones_like(size))
        objects = {"rest": rest}
        for number, body in enumerate(bodies):
            mesh = Mesh(body.mesh.vertices * size, body.mesh.faces)
            objects[f"body {number}"] = Object(mesh, body.material, body.pose)
        scene = Scene(objects)
        out = deposit_power(scene, link(), grid, sampling=sampling, seed=seed)
        found = forward_ad.unpack_dual(out.double()).tangent
    assert found is not None
    return found


def drawn(weights, count):
    """Entries, rests and probabilities of numbers spread evenly over [0, 1)."""
    spread = (np.arange(count, dtype=np.float32) + 0.5) / count
    with use_backend("cpu"):
        return tuple(np.array(c) for c in DiscreteSampler(mi.Float(weights)).draw(mi.Float(spread)))


def test_entries_are_drawn_in_proportion():
    weights = [0.0, 3.0, 0.0, 0.0, 1.0, 4.0, 0.0]
    place, rest, chance = drawn(weights, 8000)
    assert np.bincount(place, minlength=7) / 8000 == pytest.approx(np.array(weights) / 8)
    assert chance == pytest.approx(np.array(weights)[place] / 8)
    for entry in (1, 4, 5):  # evenly within each
        own = np.sort(rest[place == entry])
        assert own == pytest.approx((np.arange(len(own)) + 0.5) / len(own), abs=1e-3)


def test_where_there_is_nothing_no_entry_has_a_chance():
    assert not drawn([0.0, 0.0, 0.0], 10)[2].any()
    place, rest, chance = drawn([0.0, 2.0], 10)
    assert (place == 1).all()
    assert (chance == 1).all()
    assert ((rest >= 0) & (rest < 1)).all()


def ridges(*tops: tuple[float, float]) -> Mesh:
    """A strip folded up and down: ridges at (depth, height), with valleys of a millimetre."""
    line = [(tops[0][0], -0.2)]
    for number, (depth, height) in enumerate(tops):
        if number:
            line.append((0.5 * (depth + tops[number - 1][0]), -1e-3))
        line.append((depth, height))
    line.append((tops[-1][0], -0.2))
    return strip(line)


def strip(line: list[tuple[float, float]]) -> Mesh:
    """A strip 0.4 m wide over a line of (depth, height)."""
    vertices = float64([(depth, y, height) for depth, height in line for y in (-0.2, 0.2)])
    faces = [
        f
        for k in range(0, len(line) * 2 - 2, 2)
        for f in ((k, k + 1, k + 2), (k + 1, k + 3, k + 2))
    ]
    return Mesh(vertices, torch.tensor(faces))


@pytest.mark.parametrize("depths", [(0.0, 0.1), (0.1, 0.0)], ids=["hidden behind", "hidden before"])
def test_of_two_ridges_a_micrometre_apart_one_casts_the_shadow(depths):
    """Thirty metres away; both would count where rays that pass above one miss the other."""
    wall = thing(plate(2.0, 2.0), (32.0, 0.0, 0.0))
    lower, higher = ((depth, height) for depth, height in zip(depths, (0.0, 1e-6), strict=True))
    both, one = (
        thing(ridges(*sorted(tops)), (30.0, 0.0, 0.0)) for tops in ([lower, higher], [higher])
    )
    behind, sampling = Grid(31.5, 0.1, 20), Sampling(depth=1, samples=4, boundary_samples=20_000)
    found, truth = (growth([body], wall, behind, sampling, 1).sum() for body in (both, one))
    assert float(truth) < 0
    assert float(found / truth) == pytest.approx(1.0, abs=0.02)


def test_a_shadow_falls_on_what_its_own_mesh_rises_to_behind_the_edge():
    """A ridge before a slope, as one mesh and cut where neither antenna sees it."""
    wall = thing(plate(2.0, 2.0), (5.0, 0.0, 0.0))
    line = [(0.0, -0.2), (0.0, 0.0), (0.05, -0.1), (0.3, 0.1), (0.3, -0.2)]
    whole, first, last = (
        thing(strip(part), (3.0, 0.0, 0.0)) for part in (line, line[:3], line[2:])
    )
    slope, sampling = Grid(3.1, 0.02, 10), Sampling(depth=1, samples=4, boundary_samples=20_000)
    found, truth = (
        growth(bodies, wall, slope, sampling, 1).sum() for bodies in ([whole], [first, last])
    )
    assert float(truth) < 0
    assert float(found / truth) == pytest.approx(1.0, abs=0.02)


def test_a_large_object_does_not_drown_a_small_one():
    """A ball of 5 cm at 200 m, before 500 m of ground."""
    ground = thing(plate(100.0, 500.0), (250.0, 0.0, -1.0), (0.0, -math.pi / 2, 0.0))
    ball = thing(sphere(0.05, subdivisions=3), (200.0, 0.0, -0.5))
    grid = Grid(150.0, 2.0, 180)
    sampling = Sampling(depth=1, samples=50_000, boundary_samples=50_000)
    derivatives = [growth([ball], ground, grid, sampling, seed) for seed in range(8)]
    assert noise(derivatives) < 0.002  # without shares for objects: 0.02


def floor_and_fin(conforming: bool) -> Mesh:
    """A panel on the middle of a floor; its lower edge lies within the floor's triangles."""
    x, y = (torch.tensor(v).double() for v in ([-0.5, 0.1, 0.5], [-0.6, -0.2, 0.3, 0.6]))
    if not conforming:
        x, y = x[[0, 2]], y[[0, 3]]
    floor = torch.cartesian_prod(x, y)
    corner = torch.arange(len(floor)).reshape(len(x), len(y))
    quads = torch.stack([corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]], -1)
    fin = float64([[0.1, -0.2, 0.0], [0.1, 0.3, 0.0], [0.1, 0.3, 0.4], [0.1, -0.2, 0.4]])
    vertices = torch.cat([torch.nn.functional.pad(floor, (0, 1)), fin])
    quads = torch.cat([quads.reshape(-1, 4), len(floor) + torch.arange(4)[None]])
    return Mesh(vertices, torch.cat([quads[:, :3], quads[:, [0, 2, 3]]]))


@pytest.mark.parametrize("depth", [1, 2])
def test_an_edge_within_another_triangle_of_its_mesh_casts_no_shadow_beneath(depth):
    """The wall below the floor must not show through where the panel stands."""
    sampling, grid = Sampling(depth, 200_000, 200_000), Grid(0.5, 0.1, 40)
    found = []
    for conforming in (True, False):
        with forward_ad.dual_level():
            shift = forward_ad.make_dual(float64(0.0), float64(1.0))
            turn = rotation_from_vector(float64([0.2, 0.3, 0.4]))
            moved = rigid(turn, float64([1.5, 0, 0]) + shift * float64([-0.4, 0.3, 0.2]))
            body = Object(floor_and_fin(conforming), RoughDielectric(4.0), moved)
            wall = Object(
                plate(4.0, 4.0), RoughDielectric(4.0), rigid(translation=float64([2.6, 0, 0]))
            )
            power = deposit_power(
                Scene({"body": body, "wall": wall}), link(), grid, sampling=sampling, seed=1
            )
            found.append(forward_ad.unpack_dual(power.double()).tangent)
    conforming, other = found
    assert float((other - conforming).norm() / conforming.norm()) < 2e-3
