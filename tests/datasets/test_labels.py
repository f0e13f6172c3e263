"""Labels are where things are, and how much of them is seen."""

import math

import pytest
import torch

from invertwin.datasets import object_labels, radar_labels, triangle_visibility
from invertwin.radar.radar import Radar
from invertwin.scene import Object, RoughDielectric, Scene, box, plate, rigid
from scenes import radar as any_radar

PAINT = RoughDielectric(permittivity=4.0)


def looks_from(*positions) -> Radar:
    found = any_radar()
    places = torch.tensor(positions, dtype=torch.float64)
    return Radar(found.transmitters, found.receivers, found.waveform, positions=places)


def turned(angle: float, position) -> torch.Tensor:
    c, s = math.cos(angle), math.sin(angle)
    rotation = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return rigid(rotation, torch.tensor(position, dtype=torch.float64))


def scene() -> Scene:
    speed = torch.tensor([-1.5, 0.0, 0.0], dtype=torch.float64)
    crate = Object(box([0.6, 0.4, 0.2]), PAINT, turned(math.pi / 4, [3.0, 0.5, 0.0]), speed)
    wall = Object(plate(2.0, 2.0, 4), PAINT, turned(0.0, [5.0, 0.0, 0.0]))
    return Scene({"crate": crate, "wall": wall})


def test_boxes_poses_and_velocities():
    device = looks_from([0.0, 0.0, 0.0])
    crate, wall = object_labels(scene(), triangle_visibility(scene(), device), {"crate": "box"}, {})
    assert (crate["name"], crate["class"], wall["class"]) == ("crate", "box", "wall")
    half = (0.2 + 0.3) * math.sqrt(0.5)
    assert crate["box"]["low"] == pytest.approx([3.0 - half, 0.5 - half, -0.1])
    assert crate["box"]["high"] == pytest.approx([3.0 + half, 0.5 + half, 0.1])
    own = crate["oriented_box"]
    assert own["size"] == pytest.approx([0.6, 0.4, 0.2])
    assert own["center"] == pytest.approx([3.0, 0.5, 0.0])
    # Corners of the oriented box are those of the object.
    signs = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5], dtype=torch.float64)] * 3)
    size, axes, center = (
        torch.tensor(own[key], dtype=torch.float64) for key in ("size", "rotation", "center")
    )
    corners, there = signs * size @ axes.mT, scene()["crate"].vertices - center
    assert torch.cdist(corners, there).amin(1).max() < 1e-6
    assert crate["velocity"] == [-1.5, 0.0, 0.0]
    assert wall["velocity"] == [0.0, 0.0, 0.0]
    assert (wall["triangles"]["first"], wall["triangles"]["count"]) == (12, 32)
    assert crate["pose"][1][3] == 0.5


def test_a_box_hides_its_back_and_a_part_of_the_wall():
    facing = Object(box([0.6, 0.4, 0.2]), PAINT, turned(0.0, [3.0, 0.0, 0.0]))
    wall = Object(plate(2.0, 2.0, 4), PAINT, turned(0.0, [5.0, 0.0, 0.0]))
    pair = Scene({"crate": facing, "wall": wall})
    device = looks_from([0.0, 0.0, 0.0], [3.0, 10.0, 0.0])
    crate, screen = object_labels(pair, triangle_visibility(pair, device), {}, {})
    areas = {"front": 0.4 * 0.2, "side": 0.6 * 0.2, "top": 0.4 * 0.6}
    whole = 2 * sum(areas.values())
    assert crate["seen"] == pytest.approx([areas["front"] / whole, areas["side"] / whole], abs=0.01)
    # The shadow on the wall of a front at 2.7 m: 5/2.7 times its sides.
    shadow = (0.4 * 5 / 2.7) * (0.2 * 5 / 2.7) / 4.0
    assert screen["seen"][0] == pytest.approx(1 - shadow, abs=0.01)
    # Both sides of an open sheet are seen.
    assert screen["seen"][1] == pytest.approx(1.0, abs=0.01)


def test_masks_say_which_triangles():
    facing = Scene({"crate": Object(box(1.0), PAINT, turned(0.0, [3.0, 0.0, 0.0]))})
    masks = triangle_visibility(facing, looks_from([0.0, 0.0, 0.0]))["crate"]
    mesh = facing["crate"].mesh
    a, b, c = mesh.vertices[mesh.faces].unbind(1)
    normals = torch.linalg.cross(b - a, c - a)
    front = normals[:, 0] < -0.5
    assert masks.shape == (1, 12)
    assert torch.equal(masks[0], front.float())


def test_radar_labels_are_its_poses():
    found = radar_labels(looks_from([0.0, 1.0, 2.0]))
    assert found["positions"] == [[0.0, 1.0, 2.0]]
    assert found["rotations"] == [torch.eye(3).tolist()]
