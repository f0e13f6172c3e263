"""Recordings with every chirp: what belongs together, and parts of them."""

import pytest
import torch

from invertwin.capture import ChirpCapture
from invertwin.errors import InputError
from invertwin.radar import Chirps
from scenes import radar

CHIRPS = Chirps(6, 60e-6)
DEVICE = radar([[0.0, 0.0, 0.0], [0.0, 0.1, 0.0]])


def beat() -> torch.Tensor:
    return torch.randn(
        2, 6, 1, 16, 64, dtype=torch.complex128, generator=torch.Generator().manual_seed(1)
    )


def test_a_part_of_the_chirps_keeps_radar_and_timing():
    whole = ChirpCapture(beat(), DEVICE, CHIRPS)
    part = whole.select_chirps(2, 3)
    assert torch.equal(part.beat, whole.beat[:, 2:5])
    assert (part.chirps.count, part.chirps.interval) == (3, 60e-6)
    assert part.radar() is DEVICE


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: (beat().real, DEVICE, CHIRPS),
        lambda: (beat()[:1], DEVICE, CHIRPS),
        lambda: (beat(), DEVICE, Chirps(5, 60e-6)),
        lambda: (beat(), radar(DEVICE.positions, receivers=8), CHIRPS),
    ],
    ids=["real", "frames", "chirps", "receivers"],
)
def test_what_does_not_belong_together_is_refused(wrong, unchecked):
    with pytest.raises(InputError, match="expected complex beat samples of shape"):
        ChirpCapture(*wrong())


def test_more_chirps_than_there_are_is_refused():
    with pytest.raises(InputError, match=r"shape \(2, 4, 1, 16\)"):
        ChirpCapture(beat(), DEVICE, CHIRPS).select_chirps(4, 4)


def test_frames_of_one_ramp_are_one_train():
    still = radar([[0.0, 0.0, 0.0]] * 6)
    ramps = beat()[:1].movedim(0, 1)
    whole = ChirpCapture(ramps, still, Chirps(1, 60e-6), frame_period=1e-3)
    merged = whole.merge_single_ramps()
    assert merged.beat.shape == (1, 6, 1, 16, 64)
    assert torch.equal(merged.beat[0], ramps[:, 0])
    assert merged.chirps.times(1)[:, 0].tolist() == pytest.approx([k * 1e-3 for k in range(6)])
    assert merged.merge_single_ramps() is merged


@pytest.mark.parametrize(
    ("device", "chirps", "period"),
    [
        (radar([[0.0, 0.0, 0.0], [0.0, 0.1, 0.0]]), Chirps(1, 60e-6), 1e-3),
        (radar([[0.0, 0.0, 0.0]] * 2), Chirps(1, 60e-6), None),
        (radar([[0.0, 0.0, 0.0]] * 2), Chirps(6, 60e-6), 1e-3),
    ],
    ids=["moves", "no period", "trains"],
)
def test_other_frames_stay_apart(device, chirps, period):
    whole = ChirpCapture(beat()[:, : chirps.count], device, chirps, frame_period=period)
    assert whole.merge_single_ramps() is whole
