"""Silhouettes and depth: closed forms, and derivatives against differences."""

import math
from collections.abc import Callable

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from invertwin.camera import Camera, CameraPose, ImageSampling, depths, silhouettes
from invertwin.channel import ViewpointScene
from invertwin.errors import InputError
from invertwin.inversion.gradcheck.gradcheck import GradcheckSettings, gradcheck
from invertwin.models.camera import DepthMap, SilhouetteMap
from invertwin.scene import (
    Object,
    PerfectConductor,
    Scene,
    box,
    plate,
    rigid,
    rotation_from_vector,
    sphere,
)
from invertwin.scene.parameters import Pose
from scenes import float64, level_plate

METAL = PerfectConductor()
RADIUS = 0.4
BALL = sphere(RADIUS, 4)
# Looks along x: −y is on its right, −z down.
AXES = float64([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
AHEAD = Camera(torch.zeros(3).double(), AXES, 40, 30, 60.0)
FINE = ImageSampling(samples=64)
NEAR_BOX = Camera.look_at([2.5, 1.0, 1.4], [0.0, 0.0, 0.1], width=12, height=9, field_of_view=0.5)
CROWD = Scene(
    {
        "box": Object(
            box((0.6, 0.4, 0.5)),
            METAL,
            rigid(rotation_from_vector(float64([0.1, 0.2, 0.4])), [0.05, 0.1, 0.2]),
        ),
        "post": Object(box((0.1, 0.1, 0.8)), METAL, rigid(translation=[0.6, 0.1, 0.25])),
        "floor": Object(level_plate(6.0, 6.0), METAL, rigid(translation=[0.0, 0.0, -0.15])),
    }
)


def ball_at(distance: Tensor) -> Scene:
    place = torch.stack([distance, 0 * distance, 0 * distance])
    return Scene({"ball": Object(BALL, METAL, rigid(translation=place))})


def disc(distance: float) -> float:
    """Area of the image of the ball in the middle [pixel]."""
    return math.pi * (60.0 * RADIUS) ** 2 / (distance**2 - RADIUS**2)


def forward(value: Callable[[Tensor], Tensor], at: float) -> Tensor:
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(float64(at), float64(1.0))
        slope = forward_ad.unpack_dual(value(dual)).tangent
    assert slope is not None
    return slope


def test_a_ball_is_a_disc_that_shrinks_as_it_goes_away():
    def area(distance: Tensor, boundary: bool = True) -> Tensor:
        sampling = ImageSampling(64, boundary=boundary)
        return silhouettes(ball_at(distance), AHEAD, ["ball"], sampling, 0).sum()

    distance = float64(2.0).requires_grad_()
    found = area(distance)
    assert float(found.detach()) == pytest.approx(disc(2.0), rel=3e-3)
    found.backward()
    slope = (disc(2.0 + 1e-5) - disc(2.0 - 1e-5)) / 2e-5
    assert distance.grad is not None
    assert float(distance.grad) == pytest.approx(slope, rel=5e-3)
    torch.testing.assert_close(forward(area, 2.0), distance.grad)
    # Without outlines a mask has no derivative at all.
    assert not area(distance, boundary=False).requires_grad


def test_the_focal_length_scales_the_disc():
    focal = float64(60.0).requires_grad_()
    camera = Camera(torch.zeros(3).double(), AXES, 40, 30, focal)
    silhouettes(ball_at(float64(2.0)), camera, ["ball"], FINE, 0).sum().backward()
    assert focal.grad is not None
    assert float(focal.grad) == pytest.approx(2 * disc(2.0) / 60.0, rel=5e-3)


def test_depth_of_a_plane_is_linear_over_its_inverse():
    tilt = rotation_from_vector(float64([0.0, 0.1, 0.2]))
    wall = Scene({"wall": Object(plate(9.0, 9.0), METAL, rigid(tilt, [3.0, 0.0, 0.0]))})
    found = depths(wall, AHEAD, 50.0, ImageSampling(256), 0)[0]
    normal = tilt[:, 0]
    v, u = torch.meshgrid(torch.arange(30.0) + 0.5, torch.arange(40.0) + 0.5, indexing="ij")
    ways = torch.stack([torch.ones_like(u), (20 - u) / 60, (15 - v) / 60], 2).double()
    torch.testing.assert_close(found, 3 * normal[0] / (ways @ normal), rtol=2e-4, atol=0)


def test_nothing_is_as_deep_as_far():
    found = depths(ball_at(float64(2.0)), AHEAD, 7.0, FINE, 0)
    assert float(found.max()) == 7.0
    assert float(found.min()) == pytest.approx(2.0 - RADIUS, abs=2e-3)


def test_what_stands_before_hides():
    mask = silhouettes(CROWD, NEAR_BOX, ["box"], FINE, 0)
    alone = silhouettes(Scene({"box": CROWD.objects["box"]}), NEAR_BOX, ["box"], FINE, 0)
    both = silhouettes(CROWD, NEAR_BOX, ["box", "post"], FINE, 0)
    post = silhouettes(CROWD, NEAR_BOX, ["post"], FINE, 0)
    assert float(alone.sum() - mask.sum()) > 1
    torch.testing.assert_close(mask + post, both)


def test_seeds_move_rays_and_nothing_else():
    first, again, other = (
        silhouettes(CROWD, NEAR_BOX, ["box"], ImageSampling(8), seed) for seed in (0, 0, 1)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert float((first - other).abs().max()) < 0.5


CHECK = GradcheckSettings(step=2e-3, difference_samples=2_000_000, max_pairs=24, noise=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "tangent", "still"),
    [
        (SilhouetteMap(("box",), FINE), {"translation": [1.0, 0.5, 0.3]}, 1.0),
        (SilhouetteMap(("box",), FINE), {"rotation": [0.3, 0.2, 1.0]}, 1.0),
        (DepthMap(8.0, FINE), {"translation": [1.0, 0.5, 0.3]}, 0.3),
    ],
    ids=["mask, moved", "mask, turned", "depth, moved"],
)
def test_images_of_a_box_behind_a_post(model, tangent, still):
    report = gradcheck(
        model, Pose("box"), tangent, scene=CROWD, sensor=NEAR_BOX, settings=CHECK, seed=1
    )
    assert report.full.relative_l1 <= 0.02 + report.difference_noise
    assert report.interior.relative_l1 >= still


@pytest.mark.slow
def test_images_of_a_camera_that_moves():
    tangent = {"translation": [1.0, 0.5, 0.3], "rotation": [0.1, 0.2, 0.3]}
    report = gradcheck(
        DepthMap(8.0, FINE),
        CameraPose(),
        tangent,
        scene=CROWD,
        sensor=NEAR_BOX,
        acts_on="sensor",
        settings=CHECK,
        seed=1,
    )
    assert report.full.relative_l1 <= 0.02 + report.difference_noise
    assert report.interior.relative_l1 >= 0.3


def test_a_mask_ends_where_objects_cross(monkeypatch):
    """A ball that rises out of a floor: what is seen of it grows also where the floor cuts it."""
    camera = Camera.look_at(
        [2.5, 0.0, 1.2], [0.0, 0.0, 0.0], width=16, height=12, field_of_view=0.5
    )

    def area(height: Tensor, samples: int = 64) -> Tensor:
        place = torch.stack([0 * height, 0 * height, height])
        floor = Object(level_plate(6.0, 6.0), METAL)
        scene = Scene({"ball": Object(BALL, METAL, rigid(translation=place)), "floor": floor})
        return silhouettes(scene, camera, ["ball"], ImageSampling(samples), 0).sum()

    found = float(forward(area, 0.1))
    with torch.no_grad():
        ends = [float(area(float64(0.1 + step), 4096)) for step in (-0.02, 0.02)]
    assert found == pytest.approx((ends[1] - ends[0]) / 0.04, rel=0.02)
    # The outline alone, without the curve in which the floor cuts the ball, says something else.
    monkeypatch.setattr(ViewpointScene, "find_intersections", ViewpointScene.find_silhouettes)
    assert float(forward(area, 0.1)) != pytest.approx(found, rel=0.2)


@pytest.mark.parametrize("angle", [2e-3, 0.1])
def test_a_strip_of_floor_behind_a_slanted_plate_that_slides_aside(angle):
    """Seen 2 m away at small angles [rad]: what appears is a small part of a pixel high."""
    camera = Camera(float64([0.0, 0.0, 2.0 * angle]), AXES, 40, 30, 60.0)
    floor = Object(level_plate(6.0, 6.0), METAL, rigid(translation=[2.0, 0.0, 0.0]))

    def area(side: Tensor) -> Tensor:
        place = torch.stack([0 * side + 2.0, side + 3.0 / math.cos(0.6), 0 * side])
        pose = rigid(rotation_from_vector(float64([0.6, 0.0, 0.0])), place)
        scene = Scene({"plate": Object(plate(6.0, 6.0), METAL, pose), "floor": floor})
        return silhouettes(scene, camera, ["floor"], ImageSampling(4, 4000), 0).sum()

    height = 60.0 * 2.0 * angle * (1 / 2 - 1 / 5)
    assert float(forward(area, 0.0)) == pytest.approx(60.0 / 2 * height, rel=0.02)


def test_other_names_are_refused():
    with pytest.raises(InputError, match="tower"):
        silhouettes(CROWD, NEAR_BOX, ["tower"], FINE, 0)
    with pytest.raises(InputError, match="got none"):
        silhouettes(CROWD, NEAR_BOX, [], FINE, 0)
