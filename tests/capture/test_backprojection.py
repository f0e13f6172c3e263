"""Images and calibration of synthetic point targets, whose places are known."""

from dataclasses import replace

import pytest
import torch

from invertwin.capture import Capture, Track, backproject, calibrate, locate
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.radar.radar import Radar
from invertwin.radar.waveform import Impulse
from invertwin.scene.antenna import AntennaArray

TARGET = torch.tensor([7.0, 0.4, 0.1], dtype=torch.float64)
OTHER = torch.tensor([7.4, -1.7, 0.1], dtype=torch.float64)
CLOCK, BIAS = 3.2, 0.3


def capture(*targets: torch.Tensor, clock_error: float = 0.0, bias_error: float = 0.0) -> Capture:
    """A radar on a rail, not at constant speed, with errors in what is said of clock and bias."""
    track_times = torch.linspace(0, 12, 2401, dtype=torch.float64)
    along = 0.8 * (track_times - 6) + 0.15 * torch.sin(track_times)
    track = Track(track_times, torch.nn.functional.pad(along[:, None], (1, 1)))
    times = torch.linspace(1, 5, 81, dtype=torch.float64)
    positions = track.interpolate(times + CLOCK)
    ranges = 5 + 0.02 * torch.arange(250, dtype=torch.float64)
    waveform = Impulse(4e9, 1.5e9)
    profile = torch.zeros(81, 250, dtype=torch.complex128)
    for target in targets:
        offset = ranges - (positions - target).norm(dim=1, keepdim=True)
        phase = 4 * torch.pi * waveform.center_frequency / SPEED_OF_LIGHT * offset
        profile += torch.exp(-((offset / 0.085) ** 2)) * torch.exp(1j * phase)
    antenna = AntennaArray(torch.zeros(1, 3, dtype=torch.float64))
    return Capture.from_range_profile(
        profile,
        ranges + BIAS - (BIAS + bias_error),
        Radar(antenna, antenna, waveform, track.interpolate(times + CLOCK + clock_error)),
        times,
        track=track,
        clock_offset=CLOCK + clock_error,
        range_bias=BIAS + bias_error,
    )


def test_the_image_of_a_point_target_is_one_at_its_place():
    away = TARGET + torch.tensor([0.0, 0.4, 0.0], dtype=torch.float64)
    points = torch.stack([TARGET, away]).reshape(2, 1, 3)
    image = backproject(capture(TARGET), points)
    assert tuple(image.shape) == (2, 1)
    assert abs(image[0, 0] - 1) < 5e-3
    assert abs(image[1, 0]) < 0.1


def test_a_target_is_located_beside_another():
    start = TARGET + torch.tensor([0.3, -0.4, 0.0], dtype=torch.float64)
    found = locate(capture(TARGET, OTHER), start)
    assert (found - TARGET).norm() < 3e-3


def test_calibration_on_one_target_locates_the_other():
    wrong = capture(TARGET, OTHER, clock_error=0.06, bias_error=-0.05)
    assert (locate(wrong, OTHER) - OTHER).norm() > 0.03
    right = calibrate(wrong, TARGET)
    assert right.clock_offset == pytest.approx(CLOCK, abs=3e-3)
    assert right.range_bias == pytest.approx(BIAS, abs=5e-3)
    assert (locate(right, OTHER) - OTHER).norm() < 0.01


def test_bad_searches_are_refused():
    with pytest.raises(InputError, match="0 < step < radius"):
        locate(capture(TARGET), TARGET, radius=0.1, step=0.2)
    with pytest.raises(InputError, match="ranges within the profile"):
        locate(capture(TARGET), TARGET + 10)


def test_range_profiles_that_count_from_an_origin():
    """The same data with ranges and origins less 5 m of every frame: image, place, calibration."""
    plain = capture(TARGET, OTHER)
    radar = replace(plain.radar(), range_origin=torch.full((81,), 5.0, dtype=torch.float64))
    centered = Capture.from_range_profile(
        plain.range_profile,
        plain.ranges - 5.0,
        radar,
        plain.times,
        track=plain.track,
        clock_offset=CLOCK,
        range_bias=BIAS,
    )
    points = torch.stack([TARGET, OTHER, TARGET + 0.1])
    assert torch.allclose(backproject(centered, points), backproject(plain, points), atol=1e-9)
    assert torch.allclose(locate(centered, TARGET), locate(plain, TARGET), atol=1e-6)
    found, expected = calibrate(centered, TARGET), calibrate(plain, TARGET)
    assert found.clock_offset == pytest.approx(expected.clock_offset, abs=1e-5)
    assert found.range_bias == pytest.approx(expected.range_bias, abs=1e-5)
    assert found.radar().origins[0] == 5.0
