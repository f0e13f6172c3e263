"""Where fits start: random poses about a known one, and poses by conventional processing."""

import math
from typing import Any

import pytest
import torch

from invertwin.errors import InputError
from invertwin.inversion import InitialPoseEstimator, displace, pose_error, sample_nearby_poses
from invertwin.scene import PerfectConductor, box, rigid
from invertwin.scene.scene import Object

ITEM = Object(box([0.2, 0.3, 0.4]), PerfectConductor(), rigid(translation=[1.0, 2.0, 3.0]))


def drawn(seed: int = 0, **changes):
    settings: dict[str, Any] = {"distance": (0.3, 0.4), "angle": (0.2, 0.5)} | changes
    generator = torch.Generator().manual_seed(seed)
    return list(sample_nearby_poses(ITEM, 5, **settings, generator=generator))


def test_poses_are_as_far_off_as_asked_and_repeat():
    for copy, same in zip(drawn(), drawn(), strict=True):
        rest = pose_error(copy, ITEM)
        assert rest is not None
        assert 0.3 <= rest.distance <= 0.4
        assert 0.2 - 1e-9 <= rest.angle <= 0.5 + 1e-9
        assert torch.equal(copy.vertices, same.vertices)
    assert not torch.equal(drawn()[0].vertices, drawn(1)[0].vertices)


def test_offsets_keep_to_their_axes_and_turns_to_theirs():
    up = torch.tensor([0.0, 0.0, 3.0], dtype=torch.float64)
    for copy in drawn(axes="xy", rotation_axis=up):
        assert float(copy.center[2]) == pytest.approx(3.0, abs=1e-12)
        torch.testing.assert_close(copy.transform[2, :3], ITEM.transform[2, :3])


def test_a_displaced_object_turns_about_its_centre():
    offset = torch.tensor([0.1, 0.0, -0.2], dtype=torch.float64)
    moved = displace(ITEM, offset)
    torch.testing.assert_close(moved.vertices, ITEM.vertices + offset)
    half_turn = torch.tensor([0.0, math.pi, 0.0], dtype=torch.float64)
    turned = displace(ITEM, 0 * offset, half_turn)
    mirrored = 2 * ITEM.center - ITEM.vertices
    torch.testing.assert_close(turned.vertices[:, [0, 2]], mirrored[:, [0, 2]])


@pytest.mark.parametrize(
    ("pose", "box", "said"),
    [("rectangle", None, "expected `low` with"), ("known", [0.0] * 3, "expected no `low` with")],
)
def test_a_first_pose_is_looked_for_in_a_box_unless_it_is_known(pose, box, said):
    corner = None if box is None else torch.tensor(box, dtype=torch.float64)
    with pytest.raises(InputError, match=said):
        InitialPoseEstimator(corner, corner, pose=pose)
