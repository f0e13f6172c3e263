"""Frames of which rays are traced now and then, against those traced at every ramp."""

import math

import pytest
import torch
from torch import Tensor

from invertwin import channel
from invertwin.channel import Sampling
from invertwin.errors import InputError
from invertwin.radar import FMCW, Radar
from invertwin.radar.signal.chirps import Chirps
from invertwin.scene import (
    Object,
    PerfectConductor,
    RoughDielectric,
    Scene,
    box,
    linear_array,
    plate,
    rigid,
    rotation_from_vector,
)
from invertwin.simulation import simulate_chirps
from scenes import float64

PAINT = RoughDielectric(4.0)
WALL = Object(plate(2.0, 2.0), PAINT, rigid(translation=[3.0, 0.0, 0.0]))
FEW = Sampling(depth=1, points_per_m2=300.0, conductor_samples=3_000)
CHIRPS = Chirps(8, 60e-6)


def radar() -> Radar:
    chirp = FMCW(77e9, 1e9, 40e-6, 64)
    half = chirp.wavelength / 2
    return Radar(linear_array(2, 4 * half), linear_array(4, half), chirp, float64([[0.0, 0, 0]]))


def rotor(time: float, material: object = PAINT) -> Scene:
    """A blade that turns 30 times a second before a wall, 0.2 m off its axis at most."""
    turn = rotation_from_vector(float64([2 * math.pi * 30 * time + 0.3, 0.0, 0.0]))
    blade = Object(box((0.02, 0.4, 0.05)), material, rigid(turn, [1.5, 0.1, 0.1]))  # type: ignore[arg-type]
    return Scene({"wall": WALL, "blade": blade})


def off(found: Tensor, truth: Tensor) -> float:
    return float((found - truth).norm() / truth.norm())


def test_a_rotor_is_that_of_rays_at_every_ramp():
    """Only its shadow on the wall is late, by 11° at most within the frame."""
    truth = simulate_chirps(rotor, radar(), CHIRPS, seed=1, sampling=FEW)
    for loops, limit in ((2, 0.05), (8, 0.1)):
        found = simulate_chirps(
            rotor, radar(), CHIRPS, seed=1, sampling=FEW, visibility_every=loops
        )
        assert off(found, truth) < limit
    still = simulate_chirps(lambda _: rotor(0.0), radar(), CHIRPS, seed=1, sampling=FEW)
    assert off(still, truth) > 0.3


def test_where_nothing_is_hidden_delays_are_exact():
    """A plate that turns and comes nearer, alone: its amplitudes hardly change."""

    def falling(time: float) -> Scene:
        turn = rotation_from_vector(float64([0.0, 0.1, 40.0 * time]))
        pose = rigid(turn, [2.0 - 5.0 * time + 300 * time**2, 0.1, 0.0])
        return Scene({"plate": Object(plate(0.3, 0.3), PAINT, pose)})

    truth = simulate_chirps(falling, radar(), CHIRPS, seed=1, sampling=FEW)
    found = simulate_chirps(falling, radar(), CHIRPS, seed=1, sampling=FEW, visibility_every=8)
    assert off(found, truth) < 0.01
    angles = (found * truth.conj()).sum((0, 2, 3, 4)).angle()
    assert float(angles.abs().max()) < 5e-3


def test_conductors_and_velocities_are_followed_too():
    moving = Scene(
        {
            "wall": WALL,
            "post": Object(
                box((0.2, 0.2, 0.5)),
                PerfectConductor(),
                rigid(translation=[1.2, 0.2, 0.0]),
                velocity=float64([-3.0, 0.0, 0.0]),
            ),
        }
    )
    truth = simulate_chirps(moving, radar(), CHIRPS, seed=1, sampling=FEW, retrace=True)
    found = simulate_chirps(
        moving, radar(), CHIRPS, seed=1, sampling=FEW, retrace=True, visibility_every=4
    )
    assert off(found, truth) < 0.03


def test_rays_are_traced_once_for_several_loops(monkeypatch):
    times, trace = [], channel.trace_field_with_mirrors

    def counted(*given, **options):
        times.append(1)
        return trace(*given, **options)

    monkeypatch.setattr(channel, "trace_field_with_mirrors", counted)
    simulate_chirps(rotor, radar(), CHIRPS, seed=1, sampling=FEW, visibility_every=3)
    assert len(times) == 3


def test_a_scene_at_rest_needs_no_ramp():
    still = simulate_chirps(
        lambda _: rotor(0.0), radar(), CHIRPS, seed=1, sampling=FEW, visibility_every=8
    )
    assert torch.equal(still[:, :1].expand_as(still), still)


@pytest.mark.parametrize(
    ("scene", "more", "message"),
    [
        (rotor, {"visibility_every": 0}, "visibility_every"),
        (rotor, {"visibility_every": 2, "sampling": Sampling(depth=2)}, "one bounce"),
        (rotor(0.0), {"visibility_every": 2}, "function of time"),
        (
            lambda time: rotor(0.51 if (time // 17e-6) % 2 else 0.0),
            {"visibility_every": 8},
            "smooth over",
        ),
    ],
)
def test_what_cannot_be_followed_is_refused(scene, more, message):
    given = {"seed": 1, "sampling": FEW} | more
    with pytest.raises(InputError, match=message):
        simulate_chirps(scene, radar(), CHIRPS, **given)
