"""Conventional guesses of pose, size and density, on points whose origin is known and on echoes."""

import math

import pytest
import torch
from torch import Tensor

from invertwin.capture import Capture
from invertwin.channel import Grid, Sampling
from invertwin.errors import InputError
from invertwin.inversion.initialisation.detections import (
    backproject_power,
    candidate_poses,
    detect_echoes,
    estimate_density,
    estimate_position,
    estimate_scale,
    find_bright_nodes,
    find_largest_group,
    fit_rectangle,
    principal_rectangle,
    select_pose,
    yaw_rotation,
)
from invertwin.inversion.loss import SpectrumLoss
from invertwin.radar import FMCW, Radar, Surrogate
from invertwin.scene import (
    Isotropic,
    Mesh,
    Object,
    RoughDielectric,
    Scene,
    box,
    linear_array,
    merge_meshes,
    rigid,
    rotation_angle,
)
from invertwin.scene.antenna import AntennaArray
from invertwin.simulation import simulate
from scenes import float64

LOW, HIGH = [3.0, -3.0, -1.0], [9.0, 3.0, 1.0]
PLACE = (6.0, 0.4, 0.0)
SPACING = 0.5 * 3.8e-3


def radar_along(count: int = 10, width: float = 4.0) -> Radar:
    """Poses along y that look along x, with a row of 24 receivers."""
    single = AntennaArray(float64([[0.0, 0.0, 0.0]]), Isotropic())
    places = torch.zeros(count, 3, dtype=torch.float64)
    places[:, 1] = torch.linspace(-width, width, count)
    waveform = FMCW(77e9, 1e9, 50e-6, 96)
    return Radar(single, linear_array(24, SPACING), waveform, places)


def truck() -> Mesh:
    """A wide cab before a narrow bed: front and back differ from above."""
    cab, bed = box((1.0, 0.8, 0.6), 2), box((0.6, 1.4, 0.4), 2)
    return merge_meshes(
        [
            Mesh(cab.vertices + float64([0.0, 0.7, 0.0]), cab.faces),
            Mesh(bed.vertices - float64([0.0, 0.4, 0.0]), bed.faces),
        ]
    )


def parked(yaw_deg: float) -> Scene:
    turn = yaw_rotation(math.radians(yaw_deg))
    return Scene({"truck": Object(truck(), RoughDielectric(4.0), rigid(turn, PLACE))})


@pytest.fixture(scope="module")
def seen() -> tuple[Scene, Capture, Grid]:
    scene, radar = parked(30.0), radar_along()
    grid = radar.grid(2.0, 10.0)
    sampling = Sampling(depth=1, samples=1000, points_per_m2=1500.0)
    found = simulate(scene, radar, grid, sampling=sampling, snr_db=10, seed=3)
    assert found.beat is not None
    return scene, Capture.from_beat(found.beat, radar), grid


def sides(yaw_deg: float, length: float = 4.0, width: float = 1.8) -> Tensor:
    """Points on the two sides of a rectangle at PLACE that face the origin, with 2 cm of noise."""
    generator = torch.Generator().manual_seed(1)
    axes = yaw_rotation(math.radians(yaw_deg))[:, :2]
    center = float64(PLACE)
    half = float64([length, width]) / 2
    facing = -torch.sign(center @ axes)
    along = 2 * torch.rand(400, 2, generator=generator, dtype=torch.float64) - 1
    places = torch.cat(
        [
            torch.stack([facing[0].expand(150), along[:150, 1]], dim=1),
            torch.stack([along[150:, 0], facing[1].expand(250)], dim=1),
        ]
    )
    noise = 0.02 * torch.randn(400, 3, generator=generator, dtype=torch.float64)
    return center + (places * half) @ axes.T + noise


@pytest.mark.parametrize("yaw", [10.0, 35.0, 70.0])
def test_a_rectangle_is_found_by_its_near_sides(yaw: float) -> None:
    found = fit_rectangle(sides(yaw), radar_along(), resolution=0.05)
    assert math.degrees(found.yaw) == pytest.approx(yaw, abs=1.01)
    assert found.size == pytest.approx((4.0, 1.8), abs=0.25)


@pytest.mark.parametrize("yaw", [-100.0, -30.0, 20.0, 65.0])
def test_one_of_four_poses_is_the_true_one(yaw: float) -> None:
    points, radar = sides(yaw), radar_along()
    mesh = box((4.0, 1.8, 1.5))
    item = Object(mesh, RoughDielectric(4.0), rigid(translation=[-4.0, 20.0, 0.3]))
    found = fit_rectangle(points, radar, resolution=0.05)
    turn = yaw_rotation(math.radians(yaw))
    errors = [
        (
            float((pose[:2, 3] - float64(PLACE)[:2]).norm()),
            math.degrees(rotation_angle(pose[:3, :3] @ turn.T)),
        )
        for pose in candidate_poses(item, found, radar)
    ]
    distance, angle = min(errors, key=lambda error: error[1])
    assert distance < 0.12
    assert angle < 1.5
    assert all(
        float(pose[2, 3]) == pytest.approx(0.3) for pose in candidate_poses(item, found, radar)
    )
    assert estimate_scale(item, found) == pytest.approx(1.0, abs=0.06)


def test_principal_axes_turn_with_the_points() -> None:
    generator = torch.Generator().manual_seed(0)
    axes = yaw_rotation(math.radians(25))[:, :2]
    spread = torch.randn(500, 2, generator=generator, dtype=torch.float64) * float64([2.0, 0.3])
    found = principal_rectangle(spread @ axes.T + 1.0)
    assert math.degrees(found.yaw) % 180 == pytest.approx(25, abs=2)
    assert found.size[0] > 4 * found.size[1]


def test_the_largest_group_and_its_middle() -> None:
    generator = torch.Generator().manual_seed(0)
    many, few = torch.randn(2, 60, 3, generator=generator, dtype=torch.float64) * 0.1
    points = torch.cat([many, many[:3], few[:20] + 5.0])
    group = find_largest_group(points, 0.5)
    assert len(group) == 63
    torch.testing.assert_close(
        estimate_position(group), torch.zeros(3).double(), atol=0.05, rtol=0.0
    )


def test_detections_lie_on_the_object(seen: tuple[Scene, Capture, Grid]) -> None:
    scene, capture, grid = seen
    points = detect_echoes(capture, grid, LOW, HIGH)
    assert len(points) > 20
    reach = (points - scene["truck"].center)[:, :2].norm(dim=1)
    assert float(reach.median()) < 1.0
    with pytest.raises(InputError, match="enlarge the box"):
        detect_echoes(capture, grid, [8.8, -3.0, -1.0], [9.0, -2.8, 1.0])


def test_the_image_shows_what_faces_the_radar(seen: tuple[Scene, Capture, Grid]) -> None:
    scene, capture, grid = seen
    points = find_bright_nodes(capture, grid, LOW, HIGH, step=0.1)
    offset = points.mean(0) - scene["truck"].center
    assert float(offset[:2].norm()) < 0.7
    assert float(offset[0]) < 0.1
    behind = backproject_power(capture, grid, float64([[6.0, 0.4, 0.0], [-6.0, 0.4, 0.0]]))
    assert float(behind[1]) == 0


def test_single_channels_are_summed_coherently() -> None:
    radar = Radar(
        AntennaArray(float64([[0.0, 0.0, 0.0]]), Isotropic()),
        AntennaArray(float64([[0.0, 0.0, 0.0]]), Isotropic()),
        FMCW(5e9, 2e9, 50e-6, 96),
        torch.stack([torch.zeros(40), torch.linspace(-1, 1, 40), torch.zeros(40)], 1).double(),
    )
    grid = radar.grid(1.0, 4.0)
    place = float64([2.5, 0.2, 0.0])
    ball = Object(box((0.03, 0.03, 0.03)), RoughDielectric(4.0), rigid(translation=place))
    sampling = Sampling(depth=1, samples=1000, points_per_m2=1e5)
    found = simulate(Scene({"ball": ball}), radar, grid, sampling=sampling, seed=0)
    assert found.beat is not None
    capture = Capture.from_beat(found.beat, radar)
    points = find_bright_nodes(
        capture, grid, [2.0, -0.5, -0.01], [3.0, 0.5, 0.01], step=0.02, fraction=0.7
    )
    assert float((estimate_position(points) - place)[:2].norm()) < 0.05


def test_the_loss_tells_front_from_back(seen: tuple[Scene, Capture, Grid]) -> None:
    scene, capture, grid = seen
    radar = capture.radar()
    rectangle = fit_rectangle(
        find_largest_group(detect_echoes(capture, grid, LOW, HIGH), 1.0), radar, resolution=0.15
    )
    anywhere = scene.replace("truck", pose=None)
    poses = candidate_poses(anywhere["truck"], rectangle, radar)
    chosen, losses = select_pose(
        anywhere,
        "truck",
        poses,
        radar,
        capture,
        grid,
        loss=SpectrumLoss(kind="likelihood", floor=0.1),
        surrogate=Surrogate(range_width=1.0, angle_width=0.5),
        samples=50_000,
    )
    assert len(losses) == 4
    turn = chosen["truck"].transform[:3, :3] @ scene["truck"].transform[:3, :3].T
    assert math.degrees(rotation_angle(turn)) < 12
    assert float((chosen["truck"].center - scene["truck"].center).norm()) < 0.25


def test_the_density_is_where_the_echoes_are(seen: tuple[Scene, Capture, Grid]) -> None:
    scene, capture, grid = seen
    item = scene["truck"]
    found = estimate_density(
        capture, grid, item, "truck", [-1.5, -1.5, -0.3], [1.5, 1.5, 0.3], (21, 21, 3)
    )
    assert found(scene)["truck"].cloud is not None
    density = found.density.detach()
    assert float(density.max()) == pytest.approx(1 / float(found.lattice.spacing.mean()))
    nodes = found.lattice.nodes
    middle = (density[..., None] * nodes).sum((0, 1, 2)) / density.sum()
    world = item.transform[:3, :3] @ middle
    assert float(world[0]) < 0.1  # nearer than the middle: the near sides
    assert float(middle[:2].norm()) < 0.7


def test_bad_input_is_refused() -> None:
    radar = radar_along()
    with pytest.raises(InputError, match="3 points"):
        fit_rectangle(torch.zeros(2, 3).double(), radar)
