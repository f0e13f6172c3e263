"""Batches of scenes in one launch: maps and derivatives of each are those of the scene alone."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from invertwin.channel import Grid, Link, Sampling, deposit_batch, deposit_power
from invertwin.channel.power.integrand import Inputs
from invertwin.channel.power.interior_silhouettes import InteriorSilhouetteSampler
from invertwin.channel.power.silhouettes import SilhouetteSampler
from invertwin.channel.rays.arrays import to_torch
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.batching import arrange_scenes
from invertwin.channel.rays.ray_scene import RayScene
from invertwin.channel.rays.scene_tables import flatten
from invertwin.errors import InputError
from invertwin.scene import (
    Cloud,
    Mesh,
    Object,
    PerfectConductor,
    RoughDielectric,
    Scene,
    Slab,
    box,
    compose,
    plate,
    rigid,
    sphere,
)
from scenes import float64, link, thing

RANGES = Grid(0.4, 0.15, 24)
BLOCK, WALL = box((0.2, 0.3, 0.4)), plate(2.0, 2.0)
PLACES = (0.0, 0.3, -0.2)
BISTATIC = link(((-0.2, 0, 0), (0, 0.3, 0)), rx=((-0.2, 0.17, 0.2), (0, 0.41, 0.1)))
Make = Callable[[Tensor], Scene]


def before_a_wall(x: Tensor) -> Scene:
    block = thing(BLOCK, (1.0, 0.0, 0.1), (0.1, 0.2, 0.3))
    pose = compose(block.transform, rigid(translation=x * float64([0.5, 1, 0.3])))
    return Scene({"block": Object(BLOCK, block.material, pose), "wall": thing(WALL, (2, 0, 0))})


def sunk_into_the_floor(x: Tensor) -> Scene:
    """A block that slides through the floor: what moves is the curve in which they meet."""
    block = thing(BLOCK, (1.2, 0.0, -0.4), (0.05, 0.1, 0.5))
    pose = compose(block.transform, rigid(translation=x * float64([0.4, 1, 0.3])))
    floor = thing(WALL, (1.4, 0, -0.5), (0, 1.4, 0))
    return Scene({"block": Object(BLOCK, block.material, pose), "floor": floor})


def behind_a_sheet(x: Tensor) -> Scene:
    pane = thing(
        plate(0.5, 0.6), (0.45, 0.05, 0.0), (0, 0.1, 0.3), Slab(2.7, 0.05, thickness=0.0125)
    )
    return Scene({**before_a_wall(x).objects, "pane": pane})


def many_blocks(x: Tensor) -> Scene:
    """More objects than a group holds, and of every scene another number of them."""
    spots = [(0.4 * (n % 4) - 0.6, 0.4 * (n // 4) - 0.5) for n in range(9 + int(10 * x.abs()))]
    small = box((0.15, 0.15, 0.15))
    blocks = {
        str(n): thing(small, (1.4, a, b), (0.1 * n, 0.3, 0.2)) for n, (a, b) in enumerate(spots)
    }
    return Scene({**before_a_wall(x).objects, **blocks})


def weighted(maps: Tensor) -> Tensor:
    """One number of each scene: a sum over the bins, of which no two count alike."""
    return (
        (maps * torch.linspace(0.5, 1.5, maps[0].numel()).reshape(maps[0].shape)).flatten(1).sum(1)
    )


def estimates(
    make: Make, around: Link, sampling: Sampling, seeds: Sequence[int], *, at_once: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Per seed: maps, their weighted sums, and the derivatives of these by each scene's place."""
    found = []
    for seed in seeds:
        x = float64(PLACES).requires_grad_()
        scenes = [make(place) for place in x]
        maps = (
            deposit_batch(scenes, around, RANGES, sampling=sampling, seed=seed)
            if at_once
            else torch.stack(
                [deposit_power(s, around, RANGES, sampling=sampling, seed=seed) for s in scenes]
            )
        )
        sums = weighted(maps)
        sums.sum().backward()
        assert x.grad is not None
        found.append((maps.detach(), sums.detach(), x.grad))
    return tuple(map(torch.stack, zip(*found, strict=True)))  # type: ignore[return-value]


def spread(values: Tensor) -> float:
    return float(values.std(0).sum() / values.mean(0).abs().sum())


CASES = {
    "one_bounce": (before_a_wall, link(((-0.2, 0, 0),)), 1),
    "bistatic_poses": (before_a_wall, BISTATIC, 2),
    "contact": (sunk_into_the_floor, link(((-0.2, 0.2, 0.3),)), 1),
    "sheet": (behind_a_sheet, link(((-0.2, 0, 0), (0, 0.3, 0))), 2),
    "groups": (many_blocks, link(((-0.2, 0, 0),)), 2),
}


@pytest.mark.parametrize("case", CASES)
def test_maps_and_derivatives_are_those_of_the_scenes_alone(case):
    make, around, depth = CASES[case]
    drawn = Sampling(depth=depth, samples=20_000, boundary_samples=20_000)
    alone = estimates(make, around, drawn, range(16), at_once=False)
    batch = estimates(make, around, drawn, range(100, 116), at_once=True)
    assert batch[0].shape == alone[0].shape
    assert spread(batch[0]) < 1.3 * spread(alone[0])
    for one, all_ in zip(alone[1:], batch[1:], strict=True):
        error = ((one.var(0) + all_.var(0)) / len(one)).sqrt()
        assert ((one.mean(0) - all_.mean(0)).abs() < 4.5 * error).all()
        assert (error < 0.02 * one.mean(0).abs().amax()).all()
        # Of 16 draws: chance alone takes the ratio of a single value to 1.7 now and then.
        assert all_.var(0).sum() < 1.7**2 * one.var(0).sum()


@pytest.mark.parametrize("field", ["boundary", "contacts"])
def test_boundary_terms_are_what_makes_derivatives_right(field):
    """Without silhouettes, or without the curves where surfaces meet, they are others."""
    around = link(((-0.2, 0.2, 0.3),))
    whole = Sampling(depth=1, samples=40_000, boundary_samples=40_000)
    part = replace(whole, **{field: False})
    slopes = [
        estimates(sunk_into_the_floor, around, drawn, [1], at_once=True)[2][0]
        for drawn in (whole, part)
    ]
    assert ((slopes[0] - slopes[1]).abs() > 0.05 * slopes[0].abs().amax()).any()


def test_forward_mode_agrees_with_reverse_mode():
    drawn = Sampling(depth=2, samples=10_000, boundary_samples=10_000)
    around, along = link(((-0.2, 0, 0),)), float64([2.0, 1.0, -0.5])

    def maps(x: Tensor) -> Tensor:
        scenes = [before_a_wall(place) for place in x]
        return deposit_batch(scenes, around, RANGES, sampling=drawn, seed=3)

    x = float64(PLACES).requires_grad_()
    weighted(maps(x)).sum().backward()
    assert x.grad is not None
    with forward_ad.dual_level():
        pushed = forward_ad.unpack_dual(maps(forward_ad.make_dual(float64(PLACES), along))).tangent
    assert pushed is not None
    torch.testing.assert_close(weighted(pushed), (x.grad * along).float(), rtol=2e-3, atol=0)
    columns = torch.func.jvp(maps, (float64(PLACES),), (along,))[1]
    torch.testing.assert_close(columns, pushed, rtol=1e-3, atol=1e-4 * float(pushed.abs().max()))


def test_poses_of_the_antennas_have_the_gradient_of_all_scenes():
    drawn = Sampling(depth=1, samples=50_000, boundary_samples=50_000)
    slopes = []
    for at_once in (False, True):
        tx = float64([[-0.2, 0.03, 0.0]]).requires_grad_()
        around = link(tx)
        scenes = [before_a_wall(place) for place in float64(PLACES)]
        if at_once:
            maps = deposit_batch(scenes, around, RANGES, sampling=drawn, seed=1)
        else:
            alone = [deposit_power(s, around, RANGES, sampling=drawn, seed=1) for s in scenes]
            maps = torch.stack(alone)
        weighted(maps).sum().backward()
        assert tx.grad is not None
        slopes.append(tx.grad)
    torch.testing.assert_close(slopes[1], slopes[0], rtol=0, atol=0.02 * float(slopes[0].norm()))


def test_no_path_comes_from_another_scene():
    """Plates around nothing: rays that pass them meet other scenes only, far on the range axis."""
    grid, drawn = Grid(0.5, 0.25, 400), Sampling(depth=3, samples=40_000, boundary_samples=10_000)
    scenes = []
    for place in torch.linspace(0.5, 0.8, 12, dtype=torch.float64).requires_grad_():
        plates = {
            str(n): Object(plate(0.5, 0.5), RoughDielectric(4.0), rigid(translation=at))
            for n, at in enumerate(
                (torch.stack([place * 0 + 1.0, place, place * 0]), float64([1.2, 0.0, 0.6]))
            )
        }
        scenes.append(Scene(plates))
    maps = deposit_batch(scenes, link(((0, 0, 0),)), grid, sampling=drawn, seed=1)
    far = grid.ranges > 4.0  # three bounces within a scene are shorter
    assert (maps.flatten(1).sum(1) > 0).all()
    assert maps[:, :, far].abs().max() == 0


def test_boundary_terms_are_right_in_large_batches_of_small_distant_things():
    """Coordinates count from the middle of all boxes, here a kilometre away from some."""
    around, far = link(((0, 0, 0),)), Grid(140.0, 4.0, 60)
    ball, ground = sphere(0.05, 4), thing(plate(500, 500), (210, 0, 0))

    def slopes(count: int, seed: int, *, boundary: bool) -> Tensor:
        size = torch.ones(count, dtype=torch.float64).requires_grad_()
        drawn = Sampling(depth=1, samples=10_000, boundary_samples=10_000, boundary=boundary)
        pose = rigid(translation=float64([200, 0, 2]))
        scenes = [
            Scene(
                {
                    "ball": Object(Mesh(ball.vertices * s, ball.faces), RoughDielectric(4.0), pose),
                    "ground": ground,
                }
            )
            for s in size
        ]
        deposit_batch(scenes, around, far, sampling=drawn, seed=seed).sum().backward()
        assert size.grad is not None
        return size.grad

    means = []
    for calls in ([(32, 99)], [(1, seed) for seed in range(16)]):
        whole, smooth = (
            torch.cat([slopes(*call, boundary=on) for call in calls]) for on in (True, False)
        )
        means.append((whole.mean(), (whole - smooth).mean()))
    for one, many in zip(means[1], means[0], strict=True):
        assert abs(many / one - 1) < 5e-3


def test_scenes_far_and_near_get_as_many_boundary_samples():
    near, around = before_a_wall(float64(0.0)), link(((-0.2, 0, 0),), rx=((-0.2, 0.17, 0.2),))
    away = rigid(translation=float64([20.0, 0.0, 0.0]))
    far = {
        f"far {name}": Object(item.mesh, item.material, compose(item.transform, away))
        for name, item in near.objects.items()
    }
    both = flatten(Scene({**near.objects, **far}), around.wavelength)
    with tracing():
        rays = RayScene(*arrange_scenes(both, around, torch.tensor([0, 0, 1, 1])))
        inputs = Inputs.from_rays(rays)
        edges = rays.topology.edges
        scene = rays.topology.vertex_object[edges[:, 0]] // 2
        samplers = (
            SilhouetteSampler(inputs, ("tx", "rx"), 100, 1),
            InteriorSilhouetteSampler(inputs, 100, 1),
        )
        for sampler in samplers:
            weights = to_torch(sampler.choice.weights).reshape(-1, len(edges)).sum(0)
            shares = torch.zeros(2).scatter_add(0, scene, weights) / weights.sum()
            torch.testing.assert_close(shares, torch.tensor([0.5, 0.5]))


def test_one_scene_is_a_batch():
    drawn = Sampling(depth=2, samples=20_000, boundary=False)
    scene, around = before_a_wall(float64(0.1)), link(((-0.2, 0, 0),))
    (one,) = deposit_batch([scene], around, RANGES, sampling=drawn, seed=1)
    alone = deposit_power(scene, around, RANGES, sampling=drawn, seed=1)
    torch.testing.assert_close(one, alone, rtol=1e-2, atol=1e-4 * float(alone.max()))


def test_what_a_batch_cannot_do_is_refused():
    around, few = link(((0, 0, 0),)), Sampling(depth=1, samples=2_000, boundary_samples=500)
    scene = before_a_wall(float64(0.0))
    with pytest.raises(InputError, match="at least one scene"):
        deposit_batch([], around, RANGES, sampling=few, seed=1)
    ones = torch.ones(2, 2, 2, dtype=torch.float64)
    fog = Cloud(float64([-0.1] * 3), float64([0.1] * 3), ones)
    clouded = Scene({**scene.objects, "fog": Object(BLOCK, RoughDielectric(4.0), cloud=fog)})
    with pytest.raises(InputError, match="'fog' in scene 1"):
        deposit_batch([scene, clouded], around, RANGES, sampling=few, seed=1)
    many = Sampling(depth=1, samples=2**30)
    with pytest.raises(InputError, match="fewer scenes or"):
        deposit_batch([scene] * 3, around, RANGES, sampling=many, seed=1)
    moving = scene.replace("block", velocity=float64([0.0, 1.0, 0.0]))
    with pytest.raises(InputError, match="block of scene 1"):
        deposit_batch([scene, moving], around, RANGES, sampling=few, seed=1)
    sunk = [sunk_into_the_floor(place) for place in float64(PLACES).requires_grad_()]
    deep = Sampling(depth=2, samples=2_000, boundary_samples=500)
    with pytest.raises(InputError, match="and floor of scene"):
        deposit_batch(sunk, around, RANGES, sampling=deep, seed=1)
    mirror = scene.replace("wall", material=PerfectConductor())
    assert deposit_batch([mirror], around, RANGES, sampling=few, seed=1).shape[0] == 1
