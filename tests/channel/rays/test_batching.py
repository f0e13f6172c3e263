"""Scenes side by side: boxes of their own, moved as a whole."""

import torch

from invertwin.channel.rays.batching import arrange_scenes
from invertwin.channel.rays.scene_tables import flatten
from invertwin.scene import Scene, box
from scenes import WAVELENGTH, float64, link, thing

WIDE, SMALL = box((0.2, 4.0, 0.1)), box((0.1, 0.1, 0.1))


def apart(count: int, tx: object = ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))):
    objects, owners = {}, []
    for number in range(count):
        objects[f"a{number}"] = thing(WIDE, (2, 0.1 * number, 0))
        objects[f"b{number}"] = thing(SMALL, (1 + 0.3 * number, 0, 0.2))
        owners += [number, number]
    given, around = flatten(Scene(objects), WAVELENGTH), link(tx)
    return given, around, *arrange_scenes(given, around, torch.tensor(owners))


def test_every_scene_has_a_box_of_its_own_with_its_antennas():
    count = 11
    _, around, geometry, links = apart(count)
    points = torch.cat([geometry.vertices.reshape(count, -1, 3), links.tx.reshape(count, 2, 3)], 1)
    low, high = points.amin(1), points.amax(1)
    parted = ((low[:, None] > high) | (low > high[:, None])).any(2)
    assert parted[~torch.eye(count, dtype=torch.bool)].all()
    # As compact as may be: the long side is not the one in which they are lined up.
    assert (points.flatten(0, 1).amax(0) - points.flatten(0, 1).amin(0)).max() < 11
    assert links.frame_count == count * around.frame_count
    assert geometry.object_scene is not None
    assert geometry.object_scene.tolist() == [n for n in range(count) for _ in range(2)]


def test_scenes_and_antennas_move_as_a_whole():
    given, around, geometry, links = apart(3)
    moves = (geometry.vertices - given.vertices).reshape(3, -1, 3)
    torch.testing.assert_close(moves, moves[:, :1].expand_as(moves))
    for places, before in ((links.tx, around.tx), (links.rx, around.rx)):
        torch.testing.assert_close(places.reshape(3, 2, 3) - before, moves[:, :2])
    assert torch.equal(links.rotations, around.rotations.repeat(3, 1, 1))


def test_derivatives_pass():
    tx = float64([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]).requires_grad_()
    _, _, _, links = apart(3, tx)
    links.tx.sum().backward()
    assert tx.grad is not None
    assert torch.equal(tx.grad, torch.full_like(tx, 3.0))
