"""Samples in the order of other programs: every sample is where their documentation says."""

import pytest
import torch

from invertwin import InputError
from invertwin.capture import from_openradar, from_radarsimpy, to_openradar, to_radarsimpy

FRAMES, LOOPS, TX, RX, SAMPLES = 2, 5, 3, 4, 6


@pytest.fixture
def beat():
    """Each sample tells its own place."""
    axes = torch.meshgrid(
        *(torch.arange(size) for size in (FRAMES, LOOPS, TX, RX, SAMPLES)), indexing="ij"
    )
    number = (torch.stack(axes, -1) * 10.0 ** torch.arange(5).flip(0)).sum(-1).double()
    return torch.complex(number, -number)


def test_radarsimpy_has_frames_transmitters_receivers_in_one_axis(beat):
    baseband = to_radarsimpy(beat)
    assert baseband.shape == (FRAMES * TX * RX, LOOPS, SAMPLES)
    for frame, tx, rx in ((0, 0, 1), (0, 1, 0), (1, 2, 3)):
        row = (frame * TX + tx) * RX + rx
        assert torch.equal(baseband[row], beat[frame, :, tx, rx])
    assert torch.equal(from_radarsimpy(baseband, TX, RX), beat)


def separated(signal, transmitters):
    """OpenRadar's documented order of virtual antennas: transmitters, then receivers."""
    return torch.cat([signal[tx::transmitters] for tx in range(transmitters)], dim=1)


def test_openradar_interleaves_transmitters(beat):
    adc = to_openradar(beat)
    assert adc.shape == (FRAMES, LOOPS * TX, RX, SAMPLES)
    assert torch.equal(adc[1, 2 * TX + 1], beat[1, 2, 1])
    virtual = separated(adc[0], TX)
    assert torch.equal(virtual[3, 2 * RX + 1], beat[0, 3, 2, 1])
    assert torch.equal(from_openradar(adc, TX), beat)


def test_openradar_keeps_the_order_of_turns(beat):
    order = (0, 2, 1)
    adc = to_openradar(beat, order)
    assert torch.equal(adc[0, TX + 1], beat[0, 1, 2])  # the second turn is of transmitter 2
    assert torch.equal(from_openradar(adc, TX, order), beat)
    cycle = (1, 2, 0)  # is not its own inverse
    assert torch.equal(from_openradar(to_openradar(beat, cycle), TX, cycle), beat)


def test_wrong_numbers_of_antennas_are_refused(beat):
    with pytest.raises(InputError, match="multiple of 10 channels along channels/frames, got 24"):
        from_radarsimpy(to_radarsimpy(beat), 2, 5)
    with pytest.raises(InputError, match="multiple of 2 transmitters along chirps, got 15"):
        from_openradar(to_openradar(beat), 2)
    with pytest.raises(
        InputError, match=r"names each of 3 transmitters once, from 0, got \[1, 2, 3\]"
    ):
        to_openradar(beat, (1, 2, 3))
