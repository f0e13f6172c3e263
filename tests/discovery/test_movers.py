"""The moving twin: detection, the body, and its fit to the exact simulation."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from invertwin.capture import ChirpCapture
from invertwin.channel import Sampling
from invertwin.discovery.movers import MovingBody, detect_strongest_target, point_response
from invertwin.errors import InputError
from invertwin.inversion import CorrelationLoss, Observation, Optimizer, Schedule, reconstruct
from invertwin.models.doppler import RangeDopplerMap
from invertwin.radar.boards import board
from invertwin.radar.radar import Radar
from invertwin.radar.signal.chirps import Chirps, moving_beat
from invertwin.radar.signal.range_profile import beat_signal
from invertwin.radar.waveform import FMCW
from invertwin.scene import Object, PerfectConductor, RoughDielectric, Scene, rigid, shapes
from invertwin.simulation import simulate_chirps
from radar.surrogate.test_range_doppler import paths_of

CHIRPS = Chirps(32, 60e-6)
RADAR = Radar(
    *board("xWR1642").arrays(),
    FMCW(77e9, 1.5e9, 40e-6, 64),
    torch.zeros(1, 3, dtype=torch.float64),
)
GRID = RADAR.grid(1.0, 4.0)
GLOSSY = RoughDielectric(5.0, diffuse=0.3, lobe_width=0.5)


def float64(*values):
    return torch.tensor(values, dtype=torch.float64)


def recorded(place, velocity, radius, seed):
    """One look at a rough ball in motion, without noise."""
    start = float64(*place) - float64(*velocity) * 0.5 * float(CHIRPS.times(2)[-1, 0])
    ball = Object(
        shapes.sphere(radius, 2), GLOSSY, rigid(translation=start), velocity=float64(*velocity)
    )
    scene = Scene({"ball": ball})
    drawn = Sampling(depth=1, points_per_m2=1e3)
    return simulate_chirps(scene, RADAR, CHIRPS, seed=seed, sampling=drawn)


@pytest.fixture(scope="module")
def frame():
    """A point in motion and a stronger one at rest."""
    velocity = float64(2.0, 0.0, 0.0)
    start = float64(2.8, -0.5, 0.0) - velocity * 0.5 * float(CHIRPS.times(2)[-1, 0])
    places = torch.stack([start, float64(1.6, 0.8, 0.0)])
    paths = paths_of(RADAR, places, float64(1.0, 50.0))
    motion = torch.stack([velocity, 0 * velocity])
    return noisy(moving_beat(replace(paths, velocity=motion), RADAR, CHIRPS))


def noisy(beat):
    noise = torch.randn(beat.shape, dtype=beat.dtype, generator=torch.Generator().manual_seed(3))
    return ChirpCapture(beat + 0.1 * noise, RADAR, CHIRPS)


def correlation(one, other, scale: Any = "magnitude"):
    return 1 - float(CorrelationLoss(scale)(one, other))


WHOLE = RangeDopplerMap.from_chirps(RADAR, GRID, CHIRPS)


def test_the_strongest_mover_is_found_beside_what_stands_still(frame):
    echo = detect_strongest_target(frame, WHOLE)
    away = math.hypot(0.5, 2.8)
    assert echo.range == pytest.approx(away, abs=0.02)
    assert echo.range_rate == pytest.approx(2.0 * 2.8 / away, abs=0.1)
    assert echo.u == pytest.approx(-0.5 / away, abs=0.03)
    assert echo.coherence > 0.99
    torch.testing.assert_close(
        echo.position, echo.range * float64(math.sqrt(1 - echo.u**2), echo.u, 0.0)
    )
    near = WHOLE.crop_around(echo.range, echo.range_rate, 4, RADAR)
    power = near.observe(frame)
    assert power.shape[1] in (16, 17)
    assert power.shape[2] in (16, 17)
    assert float(power.max()) == pytest.approx(float(WHOLE.observe(frame).max()), rel=1e-9)
    assert correlation(point_response(near, RADAR, echo), power, "power") > 0.97


def test_a_point_that_moves_on_is_where_its_rate_takes_it(frame):
    echo = detect_strongest_target(frame, WHOLE)
    later = WHOLE.crop_around(echo.range + 0.1 * echo.range_rate, echo.range_rate, 4, RADAR)
    middle = later.grid.ranges.mean()
    assert float(middle) == pytest.approx(echo.range + 0.1 * echo.range_rate, abs=0.03)
    ranges = point_response(later, RADAR, echo, time=0.1).amax((0, 1, 3, 4))
    assert float(later.grid.ranges[ranges.argmax()]) == pytest.approx(float(middle), abs=0.06)


def test_without_a_mover_there_is_nothing_to_fit():
    beat = beat_signal(paths_of(RADAR, float64(2.0, 0.0, 0.0)[None], float64(1.0)), RADAR)
    still = noisy(beat[:, None].repeat(1, CHIRPS.count, 1, 1, 1))
    with pytest.raises(InputError, match="no echo above the noise"):
        detect_strongest_target(still, WHOLE)


def test_correlation_ignores_gain_and_knows_three_scales(unchecked):
    one = torch.rand(5, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    other = one.flip(0)
    for scale in ("magnitude", "power", "level"):
        assert correlation(7 * one, one, scale) == pytest.approx(1)
        assert correlation(one, other, scale) < 0.9
    root = torch.corrcoef(torch.stack([one.sqrt().flatten(), other.sqrt().flatten()]))[0, 1]
    assert correlation(one, other) == pytest.approx(float(root), abs=1e-6)
    with pytest.raises(InputError, match="expected a map like the measured one"):
        CorrelationLoss()(one, other[1:])
    with pytest.raises(InputError, match="'volts'"):
        correlation(one, other, "volts")


def start(echo, **changes):
    scene = Scene({"ball": Object(shapes.sphere(0.1, 3), GLOSSY)})
    return scene, MovingBody("ball", scene, RADAR, echo, **changes)


def test_the_body_starts_with_its_front_at_the_echo_and_moves_rigidly(frame):
    echo = detect_strongest_target(frame, WHOLE)
    scene, body = start(echo)
    vertices = body(scene)["ball"].vertices.detach()
    assert float(vertices.norm(dim=1).min()) == pytest.approx(echo.range, abs=1e-3)
    with torch.no_grad():
        body.spin.add_(3.0)
        body.velocity.add_(float64(0.0, 0.7))
        body.size.add_(float64(-0.2, 0.5, 0.1))
    with torch.no_grad():
        twin = body(scene)["ball"]
    assert twin.velocity is not None
    step = 1e-6
    later = twin.vertices + twin.velocity * step
    before, after = (v.diff(dim=0).norm(dim=1) for v in (twin.vertices, later))
    torch.testing.assert_close(after, before, rtol=0, atol=1e-10)
    moved = body(scene, time=0.5)["ball"].center.detach() - twin.center
    torch.testing.assert_close(moved, 0.5 * twin.velocity.mean(0), rtol=0, atol=1e-6)
    # One row of antennas: nothing moves upwards, and the body turns about the axis up.
    assert not twin.velocity[:, 2].any()
    extent = body.values()["extent_m"].tolist()
    assert extent == pytest.approx([0.2 * math.exp(x) for x in (-0.2, 0.5, 0.1)], rel=1e-6)


def test_materials_without_a_diffuse_share_are_refused(frame):
    echo = detect_strongest_target(frame, WHOLE)
    for material, message in (
        (PerfectConductor(), "rough_dielectric"),
        (replace(GLOSSY, diffuse=1.0), "between 0 and 1"),
    ):
        scene = Scene({"ball": Object(shapes.sphere(0.1, 2), material)})
        with pytest.raises(InputError, match=message):
            MovingBody("ball", scene, RADAR, echo)


@pytest.mark.filterwarnings("ignore:the triangles of ball turn")
@pytest.mark.claim
@pytest.mark.slow
def test_a_twin_finds_place_and_motion_in_exact_signals():
    """A ball that fills several range cells, at mean power: 12 looks of other phases."""
    place, velocity, radius = (2.6, -0.4, 0.0), (1.6, 0.0, 0.0), 0.3
    frames = [recorded(place, velocity, radius, seed) for seed in range(12)]
    records = [ChirpCapture(beat, RADAR, CHIRPS) for beat in frames]
    echo = detect_strongest_target(records[0], WHOLE)
    scene, body = start(echo)
    near = replace(
        WHOLE.crop_around(echo.range, echo.range_rate, 6, RADAR),
        sampling=Sampling(depth=1, boundary=False, samples=1500),
    )
    mean = torch.stack([near.observe(record) for record in records]).mean(0)
    fit = reconstruct(
        scene,
        Observation(near, mean, sensor=RADAR),
        body,
        loss=CorrelationLoss(),
        optimizer=Optimizer(rate=0.05),
        schedule=Schedule(80),
        seed=1,
    )
    losses = [row["loss"] for row in fit.history]
    assert losses[-1] < 0.5 * losses[0]
    found = body.values()
    front = math.hypot(*place) - radius
    nearest = body(scene)["ball"].vertices.detach().norm(dim=1).min()
    assert float(nearest) == pytest.approx(front, abs=0.03)
    # Along the line of sight; a row of antennas hardly sees motion across it.
    center, motion = found["position_m"], found["velocity_m_s"]
    assert float(center @ motion / center.norm()) == pytest.approx(1.6 * 2.6 / 2.63, abs=0.05)
    assert found["extent_m"][0] > 0.3
    many = replace(near, sampling=replace(near.sampling, samples=20_000))
    with torch.no_grad():
        shown = many.predict(body(scene), RADAR, 5)
    twin, point = (correlation(p, mean) for p in (shown, point_response(near, RADAR, echo)))
    assert twin > 0.97
    assert twin > point + 0.02


def test_a_body_that_leaves_the_view_is_an_error(frame):
    echo = detect_strongest_target(frame, WHOLE)
    scene, body = start(echo)
    with torch.no_grad():
        body.size.add_(float64(math.nan, 0.0, 0.0))
    near = WHOLE.crop_around(echo.range, echo.range_rate, 4, RADAR)
    with pytest.raises(InputError):
        reconstruct(scene, Observation(near, frame, sensor=RADAR), body, schedule=Schedule(1))
