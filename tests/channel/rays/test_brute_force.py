"""Few triangles, tested one by one, against the tree."""

import pytest
import torch
from torch import Tensor

from invertwin.channel import Grid, Sampling, deposit_power
from invertwin.channel.rays.arrays import to_torch
from invertwin.channel.rays.backend import dr, mi, tracing
from invertwin.channel.rays.brute_force import MAX_TESTS, BruteForceIntersector
from invertwin.scene import Mesh, Scene, box, plate
from scenes import link, relative, thing

RAYS = 20_000
RANGES = Grid(1.0, 0.05, 80)


def moved_box(shift: Tensor) -> Mesh:
    mesh = box((0.3, 0.4, 0.5))
    return Mesh(mesh.vertices + shift, mesh.faces)


def corners(count: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    centres = 3 * torch.rand(count, 1, 3, generator=generator, dtype=torch.float64)
    return centres + torch.rand(count, 3, 3, generator=generator, dtype=torch.float64)


def met_first(triangles: Tensor, start: Tensor, way: Tensor) -> tuple[Tensor, Tensor]:
    """The first triangle on each ray (−1: none) and its distance, in float64."""
    p0, p1, p2 = triangles.unbind(1)
    matrix = torch.stack([p1 - p0, p2 - p0], dim=2)[None].expand(len(start), -1, -1, -1)
    matrix = torch.cat([matrix, -way[:, None, :, None].expand(-1, len(p0), -1, -1)], dim=3)
    b1, b2, along = torch.linalg.solve(matrix, start[:, None] - p0).unbind(2)
    inside = (b1 >= 0) & (b2 >= 0) & (b1 + b2 <= 1) & (along > 0)
    nearest = torch.where(inside, along, torch.inf).min(1)
    return torch.where(nearest.values < torch.inf, nearest.indices, -1), nearest.values


def rays(seed: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    start, end = 4 * torch.rand(2, RAYS, 3, generator=generator, dtype=torch.float64)
    return start, end - start


def device(start: Tensor, way: Tensor) -> tuple[object, object]:
    return tuple(  # type: ignore[return-value]
        kind(*(mi.Float(column.float().numpy()) for column in values.T))
        for kind, values in ((mi.Point3f, start), (mi.Vector3f, way))
    )


@pytest.mark.parametrize("count", [1, 12, MAX_TESTS])
def test_rays_meet_what_they_meet_in_float64(count):
    triangles, (start, way) = corners(count, 1), rays(2)
    faces = torch.arange(3 * count).reshape(-1, 3)
    truth, distance = met_first(triangles, start, way)
    with tracing("cpu"):
        few = BruteForceIntersector(triangles.reshape(-1, 3), faces)
        origin, direction = device(start, way)
        valid, face, b1, b2, along = few.find_nearest(mi.Ray3f(origin, direction), mi.Bool(True))
        blocked = few.is_blocked(mi.Ray3f(origin, direction, 1.0, 0.0, []), mi.Bool(True))
        found = to_torch(dr.select(valid, mi.Int32(face), -1)).long()
        same = found == truth
        assert int((~same).sum()) <= 3  # at rims
        hit = same & (truth >= 0)
        assert int(hit.sum()) > 20
        weights = torch.stack([to_torch(b1), to_torch(b2)], 1).double()[hit]
        p0, p1, p2 = triangles[truth[hit]].unbind(1)
        place = p0 + weights[:, :1] * (p1 - p0) + weights[:, 1:] * (p2 - p0)
        # Rays that graze a plane tell badly where they meet it, but not that they do.
        reached = start[hit] + way[hit] * to_torch(along).double()[hit, None]
        assert (place - reached).norm(dim=1).max() < 1e-4
        normal = torch.linalg.cross(p1 - p0, p2 - p0)
        height = ((reached - p0) * normal).sum(1) / normal.norm(dim=1)
        assert height.abs().max() < 1e-5
        assert int((to_torch(blocked).bool() != (distance < 1)).sum()) <= 3


def test_halves_of_a_parallelogram_are_told_apart():
    """Boxes whose triangles begin with any corner, and share vertices or do not."""
    turns = torch.tensor([0, 1, 2, 0, 2, 1, 1, 0, 2, 2, 1, 0])
    mesh = box((0.8, 1.1, 0.7))
    order = (torch.arange(3) + turns[:, None]) % 3
    faces = mesh.faces.gather(1, order)
    leaning = torch.tensor([[1.0, 0.3, 0.1], [0.0, 1.0, 0.2], [0.1, 0.0, 1.0]]).double()
    vertices = mesh.vertices @ leaning + 2
    start, way = rays(3)
    for points, corners_of in (
        (vertices, faces),
        (vertices[faces].flatten(0, 1), torch.arange(36).reshape(-1, 3)),
    ):
        truth, _ = met_first(points[corners_of], start, way)
        with tracing("cpu"):
            few = BruteForceIntersector(points, corners_of)
            assert few.test_count == 6
            origin, direction = device(start, way)
            valid, face, b1, b2, along = few.find_nearest(
                mi.Ray3f(origin, direction), mi.Bool(True)
            )
            same = to_torch(dr.select(valid, mi.Int32(face), -1)).long() == truth
            assert int((~same).sum()) <= 3
            hit = same & (truth >= 0)
            assert len(truth[hit].unique()) == 12
            weights = torch.stack([to_torch(b1), to_torch(b2)], 1).double()[hit]
            reached = start[hit] + way[hit] * to_torch(along).double()[hit, None]
        p0, p1, p2 = points[corners_of[truth[hit]]].unbind(1)
        place = p0 + weights[:, :1] * (p1 - p0) + weights[:, 1:] * (p2 - p0)
        assert (place - reached).norm(dim=1).max() < 1e-4
        assert float(weights.min()) > -1e-6
        assert float(weights.sum(1).max()) < 1 + 1e-6


def test_only_parallelograms_are_one_test():
    """Not a trapezoid, not two sides of a roof, not two triangles wound against each other."""
    square = torch.tensor([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1.0]]).double()
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    bent, wide = square.clone(), square.clone()
    bent[3, 2] += 1e-6
    wide[3, 0] -= 1e-6
    with tracing("cpu"):
        assert BruteForceIntersector(square, faces).test_count == 1
        assert (
            BruteForceIntersector(bent, faces).test_count
            == BruteForceIntersector(wide, faces).test_count
            == 2
        )
        assert BruteForceIntersector(square, torch.tensor([[0, 1, 2], [0, 3, 2]])).test_count == 2
        strip = plate(1.0, 1.0, divisions=5)
        few = BruteForceIntersector.build(strip.vertices, strip.faces)
        assert few is None  # 50 triangles, 25 squares
        strip = plate(1.0, 1.0, divisions=4)
        few = BruteForceIntersector.build(strip.vertices, strip.faces)
        assert few is not None
        assert few.test_count >= 16


def test_inactive_rays_and_triangles_without_area_meet_nothing():
    flat = torch.tensor([[0, 0, 1], [1, 0, 1], [2, 0, 1.0]], dtype=torch.float64)
    whole = torch.tensor([[-1, -1, 1], [1, -1, 1], [0, 1, 1.0]], dtype=torch.float64)
    with tracing("cpu"):
        ray = mi.Ray3f(mi.Point3f(0, 0, 0), mi.Vector3f(0, 0, 1))
        for triangle, active, met in (
            (flat, True, False),
            (whole, True, True),
            (whole, False, False),
        ):
            few = BruteForceIntersector(triangle, torch.tensor([[0, 1, 2]]))
            valid = few.find_nearest(ray, mi.Bool(active))[0]
            assert bool(to_torch(valid)[0]) == met
            assert bool(to_torch(few.is_blocked(ray, mi.Bool(active)))[0]) == met


@pytest.mark.parametrize("divisions", [1, 3])
def test_maps_and_derivatives_are_those_of_the_tree(divisions, monkeypatch):
    """A box before a wall: 14 triangles, and 30 where the wall is divided."""

    def result() -> tuple[Tensor, Tensor]:
        wall = thing(plate(2.0, 2.0, divisions=divisions), (3.0, 0.0, 0.0))
        shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
        front = thing(moved_box(shift), (2.0, 0.1, 0.0))
        scene = Scene({"wall": wall, "front": front})
        sampling = Sampling(depth=2, samples=100_000, boundary_samples=50_000)
        out = deposit_power(scene, link(), RANGES, sampling=sampling, seed=1)
        (out / out.detach().mean()).square().mean().backward()
        assert shift.grad is not None
        return out.detach(), shift.grad

    asked = []
    true = BruteForceIntersector.build
    monkeypatch.setattr(
        BruteForceIntersector, "build", lambda *given: asked.append(true(*given)) or asked[-1]
    )
    first = result()
    assert asked[-1] is not None
    monkeypatch.setattr(BruteForceIntersector, "build", lambda *_: None)
    second = result()
    for one, other in zip(first, second, strict=True):
        assert relative(one, other) < 1e-3
