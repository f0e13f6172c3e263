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
