"""Echoes of targets over a floor: ranges, levels, arrays, Doppler, against closed forms."""

import cmath
import math
from typing import Any

import pytest
import torch

from invertwin.channel import trace_point_targets
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.radar import FMCW, Radar, beat_signal
from invertwin.scene import (
    Cosine,
    Dielectric,
    Object,
    PerfectConductor,
    Scene,
    linear_array,
    plate,
    rigid,
)
from scenes import float64, level_plate

FREQUENCY, BANDWIDTH, DURATION = 77e9, 1e9, 32e-6
WAVELENGTH = SPEED_OF_LIGHT / (FREQUENCY + BANDWIDTH / 2)
FLOOR = Scene({"floor": Object(level_plate(60.0, 60.0), PerfectConductor())})
HEIGHT = 1.2
TARGET = [8.0, 0.0, 0.7]
DIRECT = math.dist([0.0, 0.0, HEIGHT], TARGET)
MIRRORED = math.dist([0.0, 0.0, HEIGHT], [8.0, 0.0, -0.7])


def device(polarisation: str = "V", count: int = 1, **more: Any) -> Radar:
    """At (0, 0, 1.2), looks along x."""
    array = linear_array(count, WAVELENGTH / 2, polarisation=polarisation, **more)
    return Radar(
        array,
        array,
        FMCW(FREQUENCY, BANDWIDTH, DURATION, 64),
        float64([[0.0, 0.0, HEIGHT]]),
    )


@pytest.mark.parametrize("polarisation", ["V", "H"])
def test_a_floor_shows_a_target_three_times(polarisation):
    radar = device(polarisation)
    paths = trace_point_targets(FLOOR, radar.link(), [TARGET], [0.5])
    # Direct, mixed (both ways round), double mirror.
    expected = [DIRECT, (DIRECT + MIRRORED) / 2, (DIRECT + MIRRORED) / 2, MIRRORED]
    order = paths.range.argsort()
    torch.testing.assert_close(paths.range[order], float64(expected), rtol=1e-12, atol=0)
    legs = [(DIRECT, DIRECT), (DIRECT, MIRRORED), (DIRECT, MIRRORED), (MIRRORED, MIRRORED)]
    level = [0.5 * WAVELENGTH**2 / ((4 * math.pi) ** 3 * (a * b) ** 2) for a, b in legs]
    power = paths.coefficient.abs().square()[order]
    if polarisation == "H":
        torch.testing.assert_close(power, float64(level), rtol=1e-9, atol=0)
        # A conductor turns the sign of H: once for mixed ways, twice for the double one.
        signs = (paths.coefficient / paths.coefficient[order[0]]).real.sign()[order]
        assert signs.tolist() == [1.0, -1.0, -1.0, 1.0]
    else:
        # V of the antenna is across the legs only straight ahead.
        torch.testing.assert_close(power[0], float64(level[0]), rtol=0.02, atol=0)
        torch.testing.assert_close(power, float64(level), rtol=0.25, atol=0)


def test_levels_follow_the_floor_and_the_pattern():
    earth = Dielectric(4.0, 0.05, scattering=0.0)
    radar = device("H", pattern=Cosine(2.0))
    scene = FLOOR.replace("floor", material=earth)
    found = trace_point_targets(scene, radar.link(), [TARGET], [1.0])
    order = found.range.argsort()
    ratio = (found.coefficient[order][3] / found.coefficient[order][0]).abs()
    sine = (HEIGHT + 0.7) / MIRRORED
    index = cmath.sqrt(earth.complex_permittivity(FREQUENCY + BANDWIDTH / 2) - 1 + sine**2)
    reflection = abs((sine - index) / (sine + index))
    gains = (8.0 / MIRRORED) ** 2 / (8.0 / DIRECT) ** 2  # cos² of the pattern, there and back
    expected = reflection**2 * gains * (DIRECT / MIRRORED) ** 2
    assert float(ratio) == pytest.approx(expected, rel=1e-6)


def test_elements_of_an_array_see_the_image():
    """Each pair of elements as a radar of its own."""
    radar = device("H", count=3)
    paths = trace_point_targets(FLOOR, radar.link(), [TARGET], [1.0])
    whole = beat_signal(paths, radar)
    tx, rx = radar.elements()
    mixed = paths.select((paths.range - (DIRECT + MIRRORED) / 2).abs() < 1e-9)
    for number in range(3):
        place = tx[0, number]
        direct = float((place - float64(TARGET)).norm())
        mirrored = float((place - float64([8.0, 0.0, -0.7])).norm())
        ways = [
            float((mixed.first[k] - place).norm() + (mixed.last[k] - rx[0, number]).norm())
            for k in range(2)
        ]
        assert ways == pytest.approx([direct + mirrored] * 2, rel=1e-12)
    assert whole.shape == (1, 3, 3, 64)


def test_beat_signals_have_the_ranges():
    radar = device("H")
    paths = trace_point_targets(FLOOR, radar.link(), [TARGET], [1.0])
    signal = beat_signal(paths, radar)[0, 0, 0]
    time = torch.arange(64).double() * DURATION / 64
    slope = BANDWIDTH / DURATION
    total = torch.zeros(64, dtype=torch.complex128)
    for value, delay in zip(paths.coefficient, paths.delay, strict=True):
        cycles = (FREQUENCY + slope * time) * delay - slope * delay**2 / 2
        total += value.conj() * torch.polar(torch.ones(64).double(), 2 * math.pi * cycles)
    torch.testing.assert_close(signal, total, rtol=1e-6, atol=1e-12)


def test_a_moving_target_turns_the_phase():
    """A step of the target changes the delays of all ways as their images say."""
    radar, step = device("H"), 1e-4
    first, second = (
        trace_point_targets(FLOOR, radar.link(), [[8.0 + x, 0.0, 0.7]], [1.0]) for x in (0.0, step)
    )
    rates = (second.range - first.range)[first.range.argsort()] / step
    expected = [8 / DIRECT, 4 / DIRECT + 4 / MIRRORED, 4 / DIRECT + 4 / MIRRORED, 8 / MIRRORED]
    torch.testing.assert_close(rates, float64(expected), rtol=1e-4, atol=0)


def test_derivatives_are_differences():
    radar = device("H")

    def power(height: torch.Tensor) -> torch.Tensor:
        place = torch.stack([float64(8.0), float64(0.0), height])[None]
        paths = trace_point_targets(FLOOR, radar.link(), place, [1.0])
        turn = torch.polar(torch.ones(4).double(), -2 * math.pi * FREQUENCY * paths.delay)
        return (paths.coefficient * turn).sum().abs().square().log()

    height = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(power(height), height)
    step = 1e-6
    expected = (power(float64(0.7 + step)) - power(float64(0.7 - step))) / (2 * step)
    torch.testing.assert_close(slope, expected, rtol=1e-4, atol=0)


def test_a_wall_hides_a_target_but_not_its_image():
    # 0.5 m high about the direct line; the mirrored way passes below.
    wall = Object(plate(2.4, 0.5), PerfectConductor(), rigid(translation=[4.0, 0.0, 1.0]))
    scene = Scene({**FLOOR.objects, "wall": wall})
    found = trace_point_targets(scene, device().link(), [TARGET], [1.0])
    assert found.range.tolist() == pytest.approx([MIRRORED], rel=1e-12)


def test_wrong_targets_are_refused():
    link = device().link()
    with pytest.raises(InputError, match="targets"):
        trace_point_targets(FLOOR, link, [[1.0, 2.0]], [1.0])
    with pytest.raises(InputError, match="cross-sections >= 0"):
        trace_point_targets(FLOOR, link, [TARGET], [-1.0])
    with pytest.raises(InputError, match="cross-sections"):
        trace_point_targets(FLOOR, link, [TARGET], [1.0, 2.0])
