"""Conversion to the frames of other programs: known axes, poses, windings, whole scenes."""

import math
from typing import Any, get_args

import numpy as np
import pytest
import torch

from invertwin.errors import InputError
from invertwin.scene import (
    AntennaArray,
    Cloud,
    Cosine,
    Mesh,
    Object,
    PerfectConductor,
    RoughDielectric,
    Scene,
    box,
    from_frame,
    person,
    plate,
    rigid,
    rotation_from_vector,
    text,
    to_frame,
)
from invertwin.scene.pose import FrameName
from scenes import float64

FRAMES = get_args(FrameName)
FORWARD, LEFT, UP = (1, 0, 0), (0, 1, 0), (0, 0, 1)


def signed_volume(mesh: Mesh) -> float:
    """Positive for normals (v1 − v0) × (v2 − v0) that point outwards."""
    a, b, c = mesh.vertices[mesh.faces].unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum() / 6)


def scene() -> Scene:
    turned = rigid(rotation_from_vector(float64([0.3, -0.2, 0.5])), float64([2.0, 1.0, 0.5]))
    per_triangle = RoughDielectric(torch.linspace(2.0, 4.0, 12, dtype=torch.float64))
    density = torch.arange(24, dtype=torch.float64).reshape(2, 3, 4)
    low, high = torch.tensor([[0.0, 1.0, 2.0], [1.0, 3.0, 5.0]], dtype=torch.float64)
    fog = Cloud(low, high, density, 0.5)
    return Scene(
        {
            "box": Object(box([0.2, 0.4, 0.6]), per_triangle, turned, float64([1.0, 0.0, -3.0])),
            "bending": Object(
                plate(1.0, 1.0), PerfectConductor(), None, torch.rand(4, 3, dtype=torch.float64)
            ),
            "fog": Object(box(1.0), RoughDielectric(2.0), turned, cloud=fog),
        }
    )


@pytest.mark.parametrize(
    ("frame", "forward", "left", "up"),
    [
        ("ti", (0, 1, 0), (-1, 0, 0), (0, 0, 1)),
        ("opencv", (0, 0, 1), (-1, 0, 0), (0, -1, 0)),
        ("smpl", (0, 0, -1), (-1, 0, 0), (0, 1, 0)),
        ("unity", (0, 0, 1), (-1, 0, 0), (0, 1, 0)),
    ],
)
def test_known_axes(frame, forward, left, up):
    axes = to_frame([FORWARD, LEFT, UP], frame)
    assert axes.tolist() == [list(forward), list(left), list(up)]
    handedness = float(torch.linalg.det(axes))
    assert handedness == (-1.0 if frame == "unity" else 1.0)


def test_a_point_by_value():
    point = [10.0, 2.0, 1.0]  # 10 m ahead, 2 m to the left, 1 m up
    assert to_frame(point, "ti").tolist() == [-2.0, 10.0, 1.0]
    assert to_frame(point, "opencv").tolist() == [-2.0, -1.0, 10.0]
    assert to_frame(point, "smpl").tolist() == [-2.0, 1.0, -10.0]
    assert to_frame(point, "unity").tolist() == [-2.0, 1.0, 10.0]
    assert from_frame([-2.0, 10.0, 1.0], "ti").tolist() == point
    assert from_frame(np.array([[-2.0, -1.0, 10.0]]), "opencv").tolist() == [point]


@pytest.mark.parametrize("frame", FRAMES)
def test_points_come_back_with_their_type_and_gradient(frame):
    points = torch.randn(4, 5, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    there = to_frame(points, frame)
    assert there.dtype == torch.float32
    assert torch.equal(from_frame(there, frame), points)
    (slope,) = torch.autograd.grad(there[..., 2].sum(), points)
    assert torch.equal(slope.abs().sum(-1), torch.ones(4, 5))


def test_missing_points_stay_missing_alone():
    assert to_frame([[1.0, math.nan, 2.0]], "opencv")[0, 1:].tolist() == [-2.0, 1.0]


@pytest.mark.parametrize("frame", FRAMES)
def test_poses_place_converted_points(frame):
    pose = rigid(rotation_from_vector(float64([0.3, -1.0, 0.7])), float64([1.0, 2.0, 3.0]))
    point = float64([0.5, -0.4, 0.2])
    moved = pose[:3, :3] @ point + pose[:3, 3]
    there = to_frame(pose, frame)
    found = there[:3, :3] @ to_frame(point, frame) + there[:3, 3]
    assert torch.allclose(found, to_frame(moved, frame), atol=1e-15)
    assert float(torch.linalg.det(there[:3, :3])) == pytest.approx(1.0)
    many = torch.stack([pose, torch.linalg.inv(pose)])
    assert torch.equal(from_frame(to_frame(many, frame), frame), many)


def test_a_turn_to_the_left_by_value():
    left = rigid(rotation_from_vector(float64([0.0, 0.0, math.pi / 2])))
    # OpenCV: about −y, from z (forward) to −x (left). Unity: about −y of a left-handed frame.
    expected = float64([[0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    assert torch.allclose(to_frame(left, "opencv"), expected, atol=1e-15)
    assert torch.allclose(to_frame(left, "unity"), expected, atol=1e-15)


@pytest.mark.parametrize("frame", FRAMES)
def test_normals_of_meshes_point_outwards(frame):
    mesh = text("F", 0.3, 0.05, 0.1)
    there = to_frame(mesh, frame)
    # (v1 − v0) × (v2 − v0) in numbers, which a left-handed frame reads by the left hand.
    assert signed_volume(there) == pytest.approx(signed_volume(mesh))
    assert signed_volume(mesh) > 0
    assert torch.equal(there.faces, mesh.faces.flip(1) if frame == "unity" else mesh.faces)
    back = from_frame(there, frame)
    assert torch.equal(back.vertices, mesh.vertices)
    assert torch.equal(back.faces, mesh.faces)


@pytest.mark.parametrize("frame", FRAMES)
def test_scenes_come_back(frame):
    before = scene()
    there = before.to_frame(frame)
    for name in before.names:
        was, item = before[name], there[name]
        assert torch.allclose(item.vertices, to_frame(was.vertices, frame), atol=1e-15)
        assert item.material is was.material
        moved = item.advance(0.5).vertices
        assert torch.allclose(moved, to_frame(was.advance(0.5).vertices, frame), atol=1e-15)
        back = there.from_frame(frame)[name]
        assert torch.equal(back.vertices, was.vertices)
        assert torch.equal(back.mesh.faces, was.mesh.faces)
        assert (back.pose is None) == (was.pose is None)
    assert torch.equal(from_frame(there, frame)["box"].transform, before["box"].transform)


def test_triangles_keep_their_material_in_a_left_handed_frame():
    before, there = scene()["box"], scene().to_frame("unity")["box"]
    middle = before.vertices[before.mesh.faces].mean(1)
    found = there.vertices[there.mesh.faces].mean(1)
    assert torch.allclose(found, to_frame(middle, "unity"), atol=1e-15)


@pytest.mark.parametrize("frame", FRAMES)
def test_clouds_keep_the_density_of_each_point(frame):
    cloud = scene()["fog"].cloud
    there = to_frame(scene(), frame)["fog"].cloud
    assert cloud is not None
    assert there is not None
    assert there.albedo == 0.5
    for index in ((0, 0, 0), (1, 2, 3), (1, 0, 2)):
        node = cloud.low + cloud.spacing * float64(index)
        place = (to_frame(node, frame) - there.low) / there.spacing
        column = tuple(round(n) for n in place.tolist())
        assert place.tolist() == pytest.approx(column)
        assert float(there.density[column]) == float(cloud.density[index])


def test_a_person_faces_z_in_the_frame_of_smpl():
    body = person(spacing=0.05)
    joints = dict(zip(body.names, to_frame(body.joints, "smpl"), strict=True))
    assert joints["left_shoulder"][0] > 0.1
    assert joints["neck"][1] > joints["pelvis"][1] + 0.3
    skin = to_frame(Mesh(body.vertices, body.faces), "smpl").vertices
    feet = skin[skin[:, 1] < skin[:, 1].min() + 0.05]
    assert float(feet[:, 2].max()) > -float(feet[:, 2].min())


def test_arrays_keep_their_pattern():
    array = AntennaArray(
        float64([[0.0, 1e-3, 0.0], [0.0, 0.0, 2e-3]]), Cosine(2.0), "H", [0.0, 0.1]
    )
    there = to_frame(array, "ti")
    assert there.positions.tolist() == [[-1e-3, 0.0, 0.0], [0.0, 0.0, 2e-3]]
    assert there.pattern == Cosine(2.0)
    assert torch.equal(there.jones.vectors, array.jones.vectors)
    assert torch.equal(from_frame(there, "ti").positions, array.positions)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("value", "frame", "message"),
    [
        ([0.0, 0.0, 1.0], "ros", r"a frame among ti, opencv, smpl, unity, got 'ros'; .*ROS.* ours"),
        ([0.0, 1.0], "ti", r"shape \[\*, 3\] or \[\*, 4, 4\], got \[2\]"),
        (1.0, "ti", r"got \[\]"),
        ("ahead", "ti", "expected coordinates, got str; give points"),
    ],
)
def test_what_has_no_frame_is_refused(value: Any, frame: Any, message):
    for convert in (to_frame, from_frame):
        with pytest.raises(InputError, match=message):
            convert(value, frame)
