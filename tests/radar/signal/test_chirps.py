import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from invertwin.channel import Sampling, draw_speckle, trace_field
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.radar import (
    FMCW,
    OFDM,
    Chirps,
    Impairments,
    PhaseNoise,
    PhysicsWarning,
    Radar,
    SteppedFrequency,
    beat_signal,
    compensate_tdm,
    moving_beat,
    range_doppler,
    range_rate,
)
from invertwin.scene import (
    AntennaArray,
    Isotropic,
    Object,
    PerfectConductor,
    RoughDielectric,
    Scene,
    linear_array,
    plate,
    rigid,
    sphere,
)
from invertwin.simulation import simulate, simulate_chirps
from oracles import moving_point as oracle

FEW = Sampling(depth=1, points_per_m2=3e3)
WAVE = FMCW(start_frequency=77e9, bandwidth=1e9, duration=50e-6, samples=32)
HALF = WAVE.wavelength / 2
RADAR = Radar(
    linear_array(2, 2 * HALF), linear_array(2, HALF), WAVE, torch.zeros(1, 3, dtype=torch.float64)
)
CHIRPS = Chirps(count=5, interval=80e-6)


def moving(velocity, material=None):
    ball = Object(
        sphere(0.1, subdivisions=2),
        material or RoughDielectric(4.0),
        rigid(translation=[3.0, 0.2, 0.1]),
        torch.tensor(velocity, dtype=torch.float64),
    )
    return Scene({"ball": ball})


def relative(a, b):
    return float((a - b).abs().max() / b.abs().max())


@pytest.mark.filterwarnings("ignore:the triangles of ball turn")
@pytest.mark.parametrize("tdm", [True, False])
@pytest.mark.parametrize("material", [RoughDielectric(4.0), PerfectConductor()])
def test_doppler_equals_moved_geometry(tdm, material):
    """The same cube, whether the points move or the whole scene is traced anew."""
    chirps = Chirps(count=4, interval=80e-6, tdm=tdm)
    # Sideways little enough that no point crosses the terminator.
    scene = moving([-3.0, 0.0, 0.0], material)
    options: dict[str, Any] = {"seed": 1, "sampling": replace(FEW, conductor_samples=4000)}
    moved = simulate_chirps(scene, RADAR, chirps, **options)
    traced = simulate_chirps(scene, RADAR, chirps, retrace=True, **options)
    assert moved.shape == (1, 4, 2, 2, 32)
    assert relative(moved, traced) < 2e-3  # amplitudes change with range, by 2 v T / R
    still = simulate_chirps(scene.replace("ball", velocity=None), RADAR, chirps, **options)
    assert relative(still, traced) > 0.5  # so the test would see a missing Doppler


def test_a_rotating_body_has_a_velocity_per_vertex():
    spin = torch.tensor([0.0, 0.0, 20.0], dtype=torch.float64)  # rad/s
    scene = moving([0.0, 0.0, 0.0])
    arms = scene["ball"].vertices - scene["ball"].center
    turning = scene.replace("ball", velocity=torch.linalg.cross(spin.expand_as(arms), arms))
    options: dict[str, Any] = {"seed": 2, "sampling": FEW}
    moved = simulate_chirps(turning, RADAR, CHIRPS, **options)
    traced = simulate_chirps(turning, RADAR, CHIRPS, retrace=True, **options)
    assert relative(moved, traced) < 0.1  # points that turn into or out of view
    still = simulate_chirps(scene.replace("ball", velocity=None), RADAR, CHIRPS, **options)
    assert relative(still, traced) > 0.3


def test_phase_of_an_approaching_mirror_falls_by_4_pi_v_t_over_lambda():
    speed = 2.0
    mirror = Object(
        plate(0.05, 0.05),
        PerfectConductor(),
        rigid(translation=[3.0, 0.0, 0.0]),
        torch.tensor([-speed, 0.0, 0.0], dtype=torch.float64),
    )
    alone = AntennaArray(torch.zeros(1, 3, dtype=torch.float64), Isotropic())
    radar = Radar(alone, alone, WAVE, torch.zeros(1, 3, dtype=torch.float64))
    cube = simulate_chirps(
        Scene({"mirror": mirror}),
        radar,
        CHIRPS,
        seed=1,
        sampling=Sampling(depth=1, conductor_samples=2000),
    )[0]
    steps = torch.angle(cube[1:, 0, 0] / cube[:-1, 0, 0])
    frequency = WAVE.start_frequency + WAVE.slope * WAVE.sample_times
    expected = -4 * math.pi * speed * CHIRPS.interval * frequency / SPEED_OF_LIGHT
    assert torch.allclose(steps, expected.expand_as(steps), atol=2e-3)


def test_transmitters_that_take_turns_see_the_scene_at_their_own_times():
    scene = moving([-3.0, 0.0, 0.0])
    turns = simulate_chirps(scene, RADAR, Chirps(3, 80e-6), seed=1, sampling=FEW)
    together = simulate_chirps(scene, RADAR, Chirps(5, 80e-6, tdm=False), seed=1, sampling=FEW)
    # Slot 2k of the turns is TX 0 in loop k, slot 2k + 1 is TX 1.
    for loop in range(2):
        assert relative(turns[:, loop, 0], together[:, 2 * loop, 0]) < 1e-7
        assert relative(turns[:, loop, 1], together[:, 2 * loop + 1, 1]) < 1e-7


def test_a_scene_at_rest_gives_the_same_beat_in_every_chirp():
    scene = moving([0.0, 0.0, 0.0]).replace("ball", velocity=None)
    grid = RADAR.grid(2.0, 4.0)
    beat = simulate(scene, RADAR, grid, seed=1, sampling=FEW).beat  # as chirps have it
    cube = simulate_chirps(scene, RADAR, CHIRPS, seed=1, sampling=FEW)
    assert beat is not None
    for chirp in range(CHIRPS.count):
        assert relative(cube[:, chirp], beat) < 1e-7


def ball_on(way):
    """A small rough ball about ``way(time)``, without turning."""
    ball = Object(sphere(0.02, subdivisions=2), RoughDielectric(4.0))

    def scene(time):
        place = way(torch.tensor(time, dtype=torch.float64))
        return Scene({"ball": replace(ball, pose=rigid(translation=place))})

    return scene


@pytest.mark.parametrize("name", ["accelerating", "rotating"])
def test_any_motion_as_a_function_of_time(name):
    """Against the oracle, with the amplitudes of the start."""

    def way(times):
        t = times[..., None]
        if name == "accelerating":
            return torch.tensor([4.5, 0.2, 0.1]) + t * torch.tensor([-30, 5.0, 0]) + 25 * t**2
        angle = 700 * t
        return torch.cat([4.4 + 0.15 * angle.cos(), 0.3 + 0.15 * angle.sin(), 0 * t], dim=-1)

    scene = ball_on(way)
    drawn = Sampling(depth=1, conductor_samples=100_000, boundary_samples=0)
    speckle = draw_speckle(scene(0.0), RADAR.link(), drawn, seed=3)
    paths = trace_field(
        scene(0.0),
        RADAR.link(),
        sampling=drawn,
        seed=3,
        speckle=speckle,
    )
    offsets = paths.first - way(torch.zeros((), dtype=torch.float64))
    chirps = Chirps(2, 80e-6)
    expected = oracle.moving_beat(
        RADAR, chirps, lambda times: way(times) + offsets, paths.coefficient
    )
    found = simulate_chirps(scene, RADAR, chirps, sampling=drawn, speckle=speckle, seed=3)
    # Amplitudes change a little while the ball moves by up to 3 cm.
    assert relative(found, expected) < 0.02
    listed = moving_beat(
        paths,
        RADAR,
        chirps,
        trajectory=lambda time: way(torch.tensor(time, dtype=torch.float64)) + offsets,
    )
    assert relative(listed, expected) < 1e-6


def test_a_function_of_time_is_what_velocities_are():
    scene = moving([-3.0, 1.0, 0.0])
    options: dict[str, Any] = {"seed": 1, "sampling": FEW}
    by_velocity = simulate_chirps(scene, RADAR, CHIRPS, retrace=True, **options)
    by_function = simulate_chirps(scene.advance, RADAR, CHIRPS, **options)
    assert relative(by_function, by_velocity) < 1e-9


def test_impairments_of_moving_scenes():
    """The front end's own numbers on top; phase noise follows the paths of the frame's start."""
    scene = moving([-3.0, 0.0, 0.0])
    options: dict[str, Any] = {"seed": 1, "sampling": FEW}
    front = Impairments(snr_db=20, gain_std_db=1.0)
    for retrace in (False, True):
        clean = simulate_chirps(scene, RADAR, CHIRPS, retrace=retrace, **options)
        found = simulate_chirps(scene, RADAR, CHIRPS, retrace=retrace, impairments=front, **options)
        assert torch.equal(found, front.apply(clean, RADAR, seed=1))
        assert relative(found, clean) > 0.01
    noisy = replace(front, phase_noise=PhaseNoise((1e5,), (-80.0,)))
    assert simulate_chirps(scene, RADAR, CHIRPS, impairments=noisy, **options).shape == clean.shape
    with pytest.raises(InputError, match="without retracing"):
        simulate_chirps(scene.advance, RADAR, CHIRPS, impairments=noisy, **options)


def test_objects_and_triangles_stay():
    scene = moving([0.0, 0.0, 0.0])
    other = Scene({"other": scene["ball"]})
    finer = scene.replace("ball", mesh=sphere(0.1, subdivisions=3))
    for late, message in ((other, "same objects"), (finer, "same triangles")):
        with pytest.raises(InputError, match=message):
            simulate_chirps(
                lambda time, late=late: scene if time < 1e-4 else late, RADAR, CHIRPS, seed=1
            )


@pytest.mark.parametrize(
    "waveform", [WAVE, FMCW(77e9, 1e9, 50e-6, 33), SteppedFrequency(77e9, 3e7, 32, 2e-6)]
)
def test_every_sample_has_its_own_delay(waveform, point_paths):
    """A point at 40 m/s in all waveforms whose samples are taken in time."""
    radar = replace(RADAR, waveform=waveform)
    start = torch.tensor([[1.9, 0.5, -0.2]], dtype=torch.float64)
    velocity = torch.tensor([[-38.0, 10.0, 5.0]], dtype=torch.float64)
    paths = replace(point_paths(radar, start, torch.tensor([1 - 2j])), velocity=velocity)
    found = moving_beat(paths, radar, CHIRPS)
    for chirp, starts in enumerate(CHIRPS.times(2).tolist()):
        for tx, begin in enumerate(starts):
            for sample in range(0, waveform.samples, 5):
                time = begin + float(waveform.sample_times[sample])
                # Where it was when it scattered what arrives now.
                lag = (start + velocity * time).norm(dim=1) / SPEED_OF_LIGHT
                there = point_paths(radar, start + velocity * (time - lag), torch.tensor([1 - 2j]))
                expected = beat_signal(there, radar)[:, tx, :, sample]
                assert relative(found[:, chirp, tx, :, sample], expected) < 2e-5


def test_ofdm_sees_where_its_symbols_start(point_paths):
    radar = replace(RADAR, waveform=OFDM(77e9, 3e7, 32))
    start = torch.tensor([[1.9, 0.5, -0.2]], dtype=torch.float64)
    velocity = torch.tensor([[-38.0, 0.0, 5.0]], dtype=torch.float64)
    paths = point_paths(radar, start, torch.ones(1))
    chirps = Chirps(3, 1e-4, tdm=False)
    found = moving_beat(replace(paths, velocity=velocity), radar, chirps)
    for chirp in range(3):
        there = point_paths(radar, start + velocity * 1e-4 * chirp, torch.ones(1))
        assert relative(found[:, chirp], beat_signal(there, radar)) < 1e-7


def test_frames_and_empty_frames(point_paths):
    """Every frame sees its own paths from its own place."""
    places = torch.tensor([[0.0, 0, 0], [-0.2, 0.3, 0.1], [0, 0, 0]], dtype=torch.float64)
    radar = replace(RADAR, positions=places)
    points = torch.tensor([[1.9, 0.5, -0.2], [2.5, 0.1, 0.3]], dtype=torch.float64)
    paths = point_paths(radar, points, torch.ones(2), torch.tensor([1, 0]))
    paths = replace(paths, velocity=torch.tensor([[3.0, 1, 2]]).double().expand(2, 3))
    found = moving_beat(paths, radar, CHIRPS)
    for frame, row in ((0, 1), (1, 0)):
        alone = radar.frames([frame])
        one = replace(
            point_paths(alone, points[row], torch.ones(1)), velocity=paths.velocity[row : row + 1]
        )
        assert relative(found[frame : frame + 1], moving_beat(one, alone, CHIRPS)) < 1e-9
    assert not found[2].any()
    none = point_paths(radar, torch.zeros(0, 3), torch.zeros(0))
    assert not moving_beat(replace(none, velocity=none.first), radar, CHIRPS).any()


@pytest.mark.claim
@pytest.mark.slow
def test_gradients_of_moving_points(point_paths):
    """In places, velocities and coefficients, at a low carrier where differences are accurate."""
    radar = replace(RADAR, waveform=FMCW(1e9, 0.2e9, 50e-6, 12))
    paths = point_paths(
        radar, torch.tensor([[1.9, 0.5, -0.2], [2.5, 0.1, 0.3]]), torch.tensor([1.0, 2 - 1j])
    )

    def signal(coefficient, first, velocity):
        link = radar.link()
        length = (first - link.tx).norm(dim=1) + (first - link.rx).norm(dim=1)
        moved = replace(
            paths,
            coefficient=coefficient,
            delay=length / SPEED_OF_LIGHT,
            first=first,
            last=first,
            velocity=velocity * 1e2,
        )
        return moving_beat(moved, radar, Chirps(2, 80e-6), tolerance=1e-13)

    velocity = torch.tensor([[-0.03, 0.01, 0.0], [0.0, 0.02, 0.01]], dtype=torch.float64)
    inputs = [paths.coefficient.clone(), paths.first.clone(), velocity]
    inputs = [value.requires_grad_() for value in inputs]
    assert torch.autograd.gradcheck(
        signal, inputs, eps=1e-5, atol=1e-4, rtol=1e-4, check_forward_ad=True
    )


def test_motion_that_no_ramp_follows_is_refused(point_paths):
    paths = point_paths(RADAR, torch.tensor([[2.0, 0.0, 0.0]]), torch.ones(1))
    wild = replace(paths, velocity=torch.tensor([[0.0, 3e5, 0.0]], dtype=torch.float64))
    with pytest.raises(InputError, match="near to a line over a ramp"):
        moving_beat(wild, RADAR, CHIRPS)


def test_range_is_warned_of_once(point_paths):
    paths = point_paths(RADAR, torch.tensor([[20.0, 0.0, 0.0]]), torch.ones(1))
    paths = replace(paths, velocity=torch.ones_like(paths.first))
    with pytest.warns(PhysicsWarning, match="1 of 1 paths") as caught:
        moving_beat(paths, RADAR, CHIRPS)
    assert len(caught) == 1


def test_range_rate_is_the_derivative_of_the_range(point_paths):
    """By forward mode, against differences; bistatic paths too."""
    far = AntennaArray(torch.tensor([[0.5, 2.0, 0.0]], dtype=torch.float64), Isotropic())
    radar = replace(RADAR, transmitters=far)
    points = torch.tensor([[1.9, 0.5, -0.2], [2.5, 0.1, 0.3]], dtype=torch.float64)
    velocity = torch.tensor([[3.0, 1.0, -2.0], [-40.0, 0.0, 5.0]], dtype=torch.float64)
    coefficient = torch.ones(2)
    assert not range_rate(point_paths(radar, points, coefficient), radar).any()
    found = range_rate(replace(point_paths(radar, points, coefficient), velocity=velocity), radar)
    ends = [point_paths(radar, points + velocity * t, coefficient).range for t in (1e-5, -1e-5)]
    assert torch.allclose(found, (ends[0] - ends[1]) / 2e-5, rtol=1e-6)


# -------------------------------------------------------------------------------------- timing


def test_order_of_transmitters():
    chirps = Chirps(2, 1e-4, order=(2, 0, 1))
    expected = torch.tensor([[1.0, 2, 0], [4, 5, 3]]).double() * 1e-4
    assert torch.allclose(chirps.times(3), expected)
    assert torch.equal(Chirps(2, 1e-4, order=(0, 1)).times(2), Chirps(2, 1e-4).times(2))


def test_order_reaches_signals_and_compensation(point_paths):
    """TX 1 first: its columns are those of one slot earlier, and TDM compensation knows it."""
    start = torch.tensor([[1.9, 0.5, -0.2]], dtype=torch.float64)
    velocity = torch.tensor([[-6.0, 0.0, 0.0]], dtype=torch.float64)
    paths = replace(point_paths(RADAR, start, torch.ones(1)), velocity=velocity)
    turned = Chirps(8, 80e-6, order=(1, 0))
    plain = moving_beat(paths, RADAR, Chirps(16, 80e-6, tdm=False))
    found = moving_beat(paths, RADAR, turned)
    assert relative(found[:, :, 1], plain[:, 0::2, 1]) < 1e-9
    assert relative(found[:, :, 0], plain[:, 1::2, 0]) < 1e-9
    grid = RADAR.grid(1.5, 2.5)
    steps = []
    for chirps in (turned, replace(turned, order=None)):
        cube = range_doppler(found, RADAR, grid, chirps, bins=64)[0]
        peak = int(cube.abs().square().sum((1, 2, 3)).argmax())
        whole = compensate_tdm(cube[None], RADAR, chirps)[0, peak]
        place = int(whole.abs().sum((0, 1)).argmax())
        steps.append(whole[1, 0, place] * whole[0, 0, place].conj())
    still = range_doppler(
        moving_beat(replace(paths, velocity=None), RADAR, turned), RADAR, grid, turned
    )[0, 4]
    place = int(still.abs().sum((0, 1)).argmax())
    truth = still[1, 0, place] * still[0, 0, place].conj()
    assert abs(float((steps[0] / truth).angle())) < 0.1
    assert abs(float((steps[1] / truth).angle())) > 1.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Chirps(2, 1e-4, order=(0, 2)), "each of 2 transmitters once, from 0"),
        (lambda: Chirps(2, 1e-4, order=(1, 1)), "each of 2 transmitters once, from 0"),
        (lambda: Chirps(2, 1e-4, tdm=False, order=(1, 0)), "send at once"),
        (lambda: Chirps(2, 1e-4, order=(1, 0)).times(3), "order of 3 transmitters"),
    ],
)
def test_orders_that_fit_no_radar(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_timing():
    assert torch.allclose(
        Chirps(2, 1e-4).times(3), torch.tensor([[0.0, 1, 2], [3, 4, 5]]).double() * 1e-4
    )
    assert Chirps(8, 1e-4).max_speed(4e-3, 2) == pytest.approx(5.0)
    assert Chirps(8, 1e-4, tdm=False).max_speed(4e-3, 2) == pytest.approx(10.0)


def test_bad_timing_and_static_simulation_are_refused():
    with pytest.raises(InputError, match="count of at least 1, got 0"):
        Chirps(0, 1e-4)
    with pytest.raises(InputError, match="interval above 0, got 0"):
        Chirps(4, 0.0)
    with pytest.raises(InputError, match="simulate_chirps"):
        simulate(moving([1.0, 0.0, 0.0]), RADAR, RADAR.grid(2.0, 4.0), seed=1)


def test_paths_of_several_bounces_are_refused(point_paths):
    paths = point_paths(RADAR, torch.tensor([[2.0, 0.0, 0.0]]), torch.ones(1))
    bent = replace(paths, last=paths.last + 1.0, velocity=torch.ones_like(paths.last))
    with pytest.raises(InputError, match="one bounce"):
        moving_beat(bent, RADAR, CHIRPS)
