import math
from dataclasses import replace

import pytest
import torch

from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.radar import FMCW, Chirps, Radar, moving_beat
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
        rigid(translation=[0.2, 0.1, 3.0]),
        torch.tensor(velocity, dtype=torch.float64),
    )
    return Scene({"ball": ball})


def relative(a, b):
    return float((a - b).abs().max() / b.abs().max())


@pytest.mark.parametrize("tdm", [True, False])
@pytest.mark.parametrize("material", [RoughDielectric(4.0), PerfectConductor()])
def test_doppler_equals_moved_geometry(tdm, material):
    """The same cube, whether the points move or the whole scene is traced anew."""
    chirps = Chirps(count=4, interval=80e-6, tdm=tdm)
    # Sideways little enough that no point crosses the terminator.
    scene = moving([0.0, 0.0, -3.0], material)
    options = {"seed": 1, "density": 3e3, "samples": 4000}
    moved = simulate_chirps(scene, RADAR, chirps, **options)
    traced = simulate_chirps(scene, RADAR, chirps, retrace=True, **options)
    assert moved.shape == (1, 4, 2, 2, 32)
    assert relative(moved, traced) < 2e-3  # amplitudes change with range, by 2 v T / R
    still = simulate_chirps(scene.replace("ball", velocity=None), RADAR, chirps, **options)
    assert relative(still, traced) > 0.5  # so the test would see a missing Doppler


def test_a_rotating_body_has_a_velocity_per_vertex():
    spin = torch.tensor([0.0, 20.0, 0.0], dtype=torch.float64)  # rad/s
    scene = moving([0.0, 0.0, 0.0])
    arms = scene["ball"].vertices - scene["ball"].center
    turning = scene.replace("ball", velocity=torch.linalg.cross(spin.expand_as(arms), arms))
    options = {"seed": 2, "density": 3e3}
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
        rigid(translation=[0.0, 0.0, 3.0]),
        torch.tensor([0.0, 0.0, -speed], dtype=torch.float64),
    )
    alone = AntennaArray(torch.zeros(1, 3, dtype=torch.float64), Isotropic())
    radar = Radar(alone, alone, WAVE, torch.zeros(1, 3, dtype=torch.float64))
    cube = simulate_chirps(Scene({"mirror": mirror}), radar, CHIRPS, seed=1, samples=2000)[0]
    steps = torch.angle(cube[1:, 0, 0] / cube[:-1, 0, 0])
    frequency = WAVE.start_frequency + WAVE.slope * WAVE.sample_times
    expected = -4 * math.pi * speed * CHIRPS.interval * frequency / SPEED_OF_LIGHT
    assert torch.allclose(steps, expected.expand_as(steps), atol=2e-3)


def test_transmitters_that_take_turns_see_the_scene_at_their_own_times():
    scene = moving([0.0, 0.0, -3.0])
    turns = simulate_chirps(scene, RADAR, Chirps(3, 80e-6), seed=1, density=3e3)
    together = simulate_chirps(scene, RADAR, Chirps(5, 80e-6, tdm=False), seed=1, density=3e3)
    # Slot 2k of the turns is TX 0 in loop k, slot 2k + 1 is TX 1.
    for loop in range(2):
        assert relative(turns[:, loop, 0], together[:, 2 * loop, 0]) < 1e-7
        assert relative(turns[:, loop, 1], together[:, 2 * loop + 1, 1]) < 1e-7


def test_a_scene_at_rest_gives_the_same_beat_in_every_chirp():
    scene = moving([0.0, 0.0, 0.0]).replace("ball", velocity=None)
    grid = RADAR.grid(2.0, 4.0)
    beat = simulate(scene, RADAR, grid, seed=1, density=3e3).beat
    cube = simulate_chirps(scene, RADAR, CHIRPS, seed=1, density=3e3)
    assert beat is not None
    for chirp in range(CHIRPS.count):
        assert relative(cube[:, chirp], beat) < 1e-7


def test_timing():
    assert torch.allclose(
        Chirps(2, 1e-4).times(3), torch.tensor([[0.0, 1, 2], [3, 4, 5]]).double() * 1e-4
    )
    assert Chirps(8, 1e-4).max_speed(4e-3, 2) == pytest.approx(5.0)
    assert Chirps(8, 1e-4, tdm=False).max_speed(4e-3, 2) == pytest.approx(10.0)


def test_bad_timing_and_static_simulation_are_refused():
    with pytest.raises(InputError, match="chirp"):
        Chirps(0, 1e-4)
    with pytest.raises(InputError, match="interval"):
        Chirps(4, 0.0)
    with pytest.raises(InputError, match="simulate_chirps"):
        simulate(moving([0.0, 0.0, 1.0]), RADAR, RADAR.grid(2.0, 4.0), seed=1)


def test_paths_of_several_bounces_are_refused(point_paths):
    paths = point_paths(RADAR, torch.tensor([[0.0, 0.0, 2.0]]), torch.ones(1))
    bent = replace(paths, last=paths.last + 1.0)
    with pytest.raises(InputError, match="one bounce"):
        moving_beat(bent, RADAR, CHIRPS)
