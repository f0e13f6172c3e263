"""Power that is mirrored and scattered: how it is drawn and summed."""

import math

import torch
from torch import Tensor

from invertwin.channel import RayPaths, Sampling, trace_single_scattering
from invertwin.channel.coverage import single_scattering as module
from invertwin.scene import Dielectric, PerfectConductor, RoughConductor, Scene, box, plate
from scenes import float64, level_plate, thing

FLOOR = thing(level_plate(4.0, 4.0), material=RoughConductor(scattering=1.0, rms_slope=0.5))
WALL = thing(plate(9.0, 9.0), (3.0, 0, 0), material=PerfectConductor(math.pi))
SCENE = Scene({"floor": FLOOR, "wall": WALL})
TX = float64([[0.5, 0.3, 2.0], [0.0, 0.0, 1.0]])
PLACES = float64([[1.0, -0.5, 1.5], [-1.0, 0.0, 1.0], [0.2, 0.9, 0.7]])


def strength(out: RayPaths, home: RayPaths, *_: Tensor) -> Tensor:
    """Power, and how many surfaces the ways meet."""
    ways = [way.coefficient.abs().square().sum((1, 2)) for way in (out, home)]
    power = ways[0] * ways[1]
    return torch.stack([power, power * (out.interaction_count + home.interaction_count)], 1)


def summed(scene: Scene = SCENE, depth: int = 2, rays: int | None = None) -> Tensor:
    rough = scene
    for name in set(scene.names) - {"floor"}:
        rough = rough.replace(name, material=Dielectric(1.0))
    sampling = Sampling(depth, 96_000)
    return trace_single_scattering(
        scene, rough, TX, PLACES, 3e9, strength, 2, rays=rays, sampling=sampling, seed=4
    )


def test_chunks_of_points_add_up(monkeypatch):
    whole = summed()
    assert bool((whole > 0).all())
    monkeypatch.setattr(module, "POINTS_AT_ONCE", 700)
    torch.testing.assert_close(summed(), whole, rtol=1e-12, atol=0)


def test_rays_find_what_all_sequences_hold():
    torch.testing.assert_close(summed(rays=4000), summed(), rtol=1e-12, atol=0)


def test_a_path_with_a_mirror_meets_two_surfaces():
    assert not summed(depth=1).any()
    both = summed(depth=2)
    torch.testing.assert_close(both[..., 1], both[..., 0], rtol=1e-12, atol=0)


def test_what_is_hidden_from_the_mirror_brings_nothing():
    boxes = [thing(box(0.4), place, material=PerfectConductor()) for place in TX.tolist()]
    hidden = Scene({**SCENE.objects, "first": boxes[0], "second": boxes[1]})
    assert not summed(hidden).any()
