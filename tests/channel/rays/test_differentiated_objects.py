"""Shadows that a derivative can move, where a part of the scene stands still."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from invertwin.channel import Sampling, deposit_power
from invertwin.channel.power.integrand import Inputs
from invertwin.channel.power.interior_silhouettes import InteriorSilhouetteSampler
from invertwin.channel.power.silhouettes import SilhouetteSampler
from invertwin.channel.rays import ray_scene
from invertwin.channel.rays.arrays import to_torch
from invertwin.channel.rays.backend import dr, mi, tracing
from invertwin.channel.rays.ray_scene import NO_TARGET, RayScene
from invertwin.channel.rays.scene_tables import flatten
from invertwin.scene import Mesh, Object, RoughDielectric, Scene, box, plate, rigid, sphere
from scenes import GRID, WAVELENGTH, float64, link, thing

OBJECTS = {
    "wall": thing(plate(2.0, 2.0), (2.4, 0.0, 0.0)),
    "screen": thing(plate(0.5, 0.4), (1.5, 0.1, 0.05), (0.0, 0.1, 0.2)),
    "aside": thing(plate(2.0, 3.0), (2.0, 1.4, 0.0), (0.0, 0.0, 1.3)),
    "before": thing(box(0.2), (0.9, -0.1, 0.1), (0.1, 0.3, 0.2)),
}


def slope(moved: str, depth: int, seed: int) -> Tensor:
    """Derivative of a map while one object moves obliquely and all others are at rest."""
    with forward_ad.dual_level():
        shift = forward_ad.make_dual(float64([0.0, 0.0, 0.0]), float64([0.3, 1.0, 0.5]))
        item = OBJECTS[moved]
        mesh = Mesh(item.mesh.vertices + shift, item.mesh.faces)
        scene = Scene(OBJECTS | {moved: Object(mesh, item.material, item.pose)})
        sampling = Sampling(depth=depth, samples=2000, boundary_samples=100_000)
        out = deposit_power(scene, link(), GRID, sampling=sampling, seed=seed)
        tangent = forward_ad.unpack_dual(out).tangent
        assert tangent is not None
        return tangent.double()


@pytest.mark.parametrize("depth", [1, 2])
@pytest.mark.parametrize("moved", list(OBJECTS))
def test_only_shadows_that_cannot_move_are_left_out(moved, depth, monkeypatch):
    """Whatever moves: also a wall on which things at rest cast shadows."""
    seeds = range(4)
    chosen = torch.stack([slope(moved, depth, seed) for seed in seeds])
    monkeypatch.setattr(ray_scene, "DifferentiatedObjects", lambda *_: None)
    every = torch.stack([slope(moved, depth, seed) for seed in seeds])
    gap = (chosen.mean(0) - every.mean(0)).abs().sum() / every.mean(0).abs().sum()
    assert float(gap) < 0.02


def drawn(scene: Scene, samples: int = 4000) -> tuple[Tensor, Tensor]:
    """Per boundary sample, the object of its edge and of the triangle in its shadow."""
    with tracing():
        geometry = flatten(scene, WAVELENGTH)
        rays = RayScene(geometry, link(), differentiate_antennas=False)
        sampler = SilhouetteSampler(Inputs.from_rays(rays), ("tx",), samples, 1)
        points = sampler.draw(dr.arange(mi.UInt32, samples)).compress()
        edge, face = to_torch(mi.Int32(points.edge)), to_torch(mi.Int32(points.face))
        owner = geometry.topology.vertex_object[geometry.topology.edges[:, 0]]
        return owner[edge.long()], geometry.face_object[face.long()]


def test_samples_go_where_something_moves():
    """Outlines of a wall and of a ball at rest take none of what a small ball in motion needs."""
    place = float64([2.0, 0.3, 0.0]).requires_grad_()
    matt = RoughDielectric(4.0)
    scene = Scene(
        {
            "wall": thing(plate(4.0, 4.0), (3.0, 0.0, 0.0)),
            "still": thing(sphere(0.3, 3), (2.0, -0.6, 0.0)),
            "moving": Object(sphere(0.05, 3), matt, rigid(translation=place)),
        }
    )
    edges, _ = drawn(scene)
    assert len(edges) > 3500
    assert bool((edges == 2).all())


def test_a_thing_at_rest_before_one_that_moves_is_sampled():
    place = float64([2.0, 0.0, 0.0]).requires_grad_()
    scene = Scene(
        {
            "moving": Object(plate(2.0, 2.0), RoughDielectric(4.0), rigid(translation=place)),
            "still": thing(plate(0.3, 0.3), (1.0, 0.1, 0.0)),
            "behind": thing(plate(6.0, 6.0), (4.0, 0.0, 0.0)),
        }
    )
    edges, shadows = drawn(scene)
    assert bool((edges == 1).any())
    assert bool((shadows[edges == 1] == 0).all())
    assert bool((shadows[edges == 0] == 2).all())
    assert not bool((edges == 2).any())


def reach(offset: Callable[[float], list[float]]) -> list[bool]:
    """Whether an edge along z at a distance of one is asked for a ball in some places."""
    found = []
    for at in (0.0, 0.05, 0.15, 0.4):
        place = float64(offset(at)).requires_grad_()
        ball = Object(sphere(0.1, 2), RoughDielectric(4.0), rigid(translation=place))
        scene = Scene({"edge": thing(plate(0.5, 0.5), (1.0, 0.25, 0.0)), "ball": ball})
        with tracing():
            rays = RayScene(flatten(scene, WAVELENGTH), link(), differentiate_antennas=False)
            assert rays.differentiated_objects is not None
            edge = dr.arange(mi.UInt32, 5)  # those of the plate
            y0, y1 = rays.exact_ends(edge)
            asked = to_torch(
                rays.differentiated_objects.may_receive_shadow(edge, mi.Point3f(0.0), y0, y1)
            ).bool()
            ends = rays.geometry.vertices.detach()[rays.topology.edges[:5]]
            upright = (ends[..., 1].abs() < 1e-9).all(1)
            assert int(upright.sum()) == 1
            found.append(bool(asked[upright]))
    return found


def test_a_ball_is_asked_for_where_a_shadow_may_reach_it():
    """Beside the sector of directions through an edge, beyond its end, and before it."""
    assert reach(lambda at: [2.0, at, 0.0]) == [True, True, False, False]
    assert reach(lambda at: [2.0, 0.0, 0.5 + at]) == [True, True, False, False]
    assert reach(lambda at: [1.0 - at, 0.0, 0.0]) == [True, True, False, False]


@pytest.mark.parametrize("moves", [False, True])
def test_antennas_that_move_move_all_shadows(moves, monkeypatch):
    asked = []

    class Seen(ray_scene.DifferentiatedObjects):
        def __init__(self, *given):
            super().__init__(*given)
            asked.append(self)

    monkeypatch.setattr(ray_scene, "DifferentiatedObjects", Seen)
    item = OBJECTS["screen"]
    vertices = item.mesh.vertices.clone().requires_grad_()
    scene = Scene(OBJECTS).replace("screen", mesh=Mesh(vertices, item.mesh.faces))
    antennas = link()
    antennas = replace(antennas, tx=antennas.tx.clone().requires_grad_(moves))
    sampling = Sampling(depth=1, samples=2000, boundary_samples=2000)
    deposit_power(scene, antennas, GRID, sampling=sampling, seed=1)
    assert len(asked) == (not moves)


def test_a_scene_of_which_nothing_or_all_moves_asks_nobody():
    still = flatten(Scene(OBJECTS), WAVELENGTH)
    with tracing():
        for flags in ((False,) * 4, (True,) * 4):
            rays = RayScene(
                replace(still, differentiated=flags), link(), differentiate_antennas=False
            )
            assert rays.differentiated_objects is None


@pytest.mark.parametrize("at", [(0.0, 0.0, 0.0), (2.05, 0.5, 0.0)])
def test_lines_towards_what_moves_are_as_likely_as_said(at):
    """From afar, and from within one of the spheres."""
    matt, count = RoughDielectric(4.0), 4_000_000
    balls = {
        f"ball {k}": Object(sphere(size, 2), matt, rigid(translation=place.requires_grad_()))
        for k, (size, place) in enumerate(
            [(0.3, float64([2.0, 0.5, 0.0])), (0.5, float64([1.5, -0.2, 0.1]))]
        )
    }
    scene = Scene({"wall": thing(plate(4.0, 4.0), (3.0, 0.0, 0.0)), **balls})
    with tracing():
        movers = RayScene(
            flatten(scene, WAVELENGTH), link(), differentiate_antennas=False
        ).differentiated_objects
        assert movers is not None
        sampler = mi.PCG32(count)
        place = mi.Point3f(*at)
        every = mi.warp.square_to_uniform_sphere(
            mi.Point2f(sampler.next_float32(), sampler.next_float32())
        )
        evenly = to_torch(movers.line_density(place, mi.Vector3f(every), NO_TARGET)).double()
        drawn, ball = movers.sample_direction(place, [sampler.next_float32() for _ in range(3)])
        aimed = to_torch(movers.line_density(place, drawn, ball)).double()
    sphere_area = 4 * torch.pi
    assert float(evenly.mean()) * sphere_area == pytest.approx(1.0, rel=0.02)
    assert float(aimed.min()) > 0
    # Both say how much of the sphere such lines fill, and the mean square of the density.
    filled = float((evenly > 0).double().mean()) * sphere_area
    assert float((1 / aimed).mean()) == pytest.approx(filled, rel=0.02)
    square = float(evenly.square().mean()) * sphere_area
    assert float(aimed.mean()) == pytest.approx(square, rel=0.02)


def test_shadows_of_things_at_rest_on_what_moves_are_found_more_often(monkeypatch):
    """A small ball behind a screen's edge, which only a wall shows: fewer samples are void."""

    def kept() -> int:
        place = float64([1.35, 0.25, 0.0]).requires_grad_()
        scene = Scene(
            {
                "wall": thing(plate(2.0, 1.2), (1.4, -1.0, 0.0), (0.0, 0.0, -1.57)),
                "screen": thing(plate(1.0, 1.2), (1.0, 0.3, 0.0)),
                "ball": Object(sphere(0.05, 2), RoughDielectric(4.0), rigid(translation=place)),
            }
        )
        with tracing():
            geometry = flatten(scene, WAVELENGTH)
            rays = RayScene(geometry, link(), differentiate_antennas=False)
            sampler = InteriorSilhouetteSampler(Inputs.from_rays(rays), 100_000, 1)
            points = sampler.draw(dr.arange(mi.UInt32, sampler.size)).compress()
            owner = geometry.topology.vertex_object[geometry.topology.edges[:, 0]]
            owner = owner[to_torch(mi.Int32(points.edge)).long()]
            return int((owner != 2).sum())

    aimed = kept()
    monkeypatch.setattr(
        InteriorSilhouetteSampler, "_aim_at_differentiated", lambda *given: given[-2:]
    )
    assert aimed > 3 * kept() > 0


def test_directions_to_something_small_and_far_are_as_likely_as_said():
    """A ball of 5 cm at 200 m, whose cap is lower than a float32 near one resolves."""
    place = float64([200.0, 0.0, 0.0]).requires_grad_()
    ball = Object(sphere(0.05, 2), RoughDielectric(4.0), rigid(translation=place))
    scene = Scene({"wall": thing(plate(4.0, 4.0), (3.0, 0.0, 0.0)), "ball": ball})
    with tracing():
        movers = RayScene(
            flatten(scene, WAVELENGTH), link(), differentiate_antennas=False
        ).differentiated_objects
        assert movers is not None
        sampler, at = mi.PCG32(10_000), mi.Point3f(0.0)
        drawn, aimed = movers.sample_direction(at, [sampler.next_float32() for _ in range(3)])
        density = to_torch(movers.line_density(at, drawn, aimed)).double()
    area = torch.pi * (0.05 / 200) ** 2
    assert float((density * 2 * area - 1).abs().max()) < 0.01
