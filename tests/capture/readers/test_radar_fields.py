"""Every waveform survives the way into a file and back."""

from dataclasses import dataclass
from typing import Any

import pytest
import torch

from invertwin.capture import Capture
from invertwin.errors import InputError
from invertwin.radar import FMCW, OFDM, Impulse, Radar, SteppedFrequency
from invertwin.scene import JonesTable, linear_array


def radar(waveform) -> Radar:
    one = linear_array(1, 1.0)
    return Radar(one, one, waveform, torch.zeros(2, 3, dtype=torch.float64))


@pytest.mark.parametrize(
    "waveform",
    [FMCW(76e9, 1e9, 40e-6, 16), SteppedFrequency(3e9, 5e6, 16, 1e-4), OFDM(76e9, 2e6, 16)],
)
def test_beat_samples_of_every_waveform(waveform, tmp_path):
    beat = torch.randn(
        2, 1, 1, 16, dtype=torch.complex128, generator=torch.Generator().manual_seed(0)
    )
    Capture.from_beat(beat, radar(waveform)).save(tmp_path / "capture.nc")
    loaded = Capture.load(tmp_path / "capture.nc")
    assert loaded.radar().waveform == waveform
    assert torch.equal(loaded.beat, beat)
    with pytest.raises(InputError, match="expected 16 samples"):
        Capture.from_beat(beat[..., :15], radar(waveform))


def test_range_profiles_of_an_impulse_radar(tmp_path):
    profile = torch.ones(2, 8, dtype=torch.complex128)
    ranges = torch.arange(1.0, 9.0, dtype=torch.float64)
    capture = Capture.from_range_profile(profile, ranges, radar(Impulse(4e9, 1e9)))
    capture.save(tmp_path / "capture.nc")
    assert Capture.load(tmp_path / "capture.nc").radar().waveform == Impulse(4e9, 1e9)


def test_polarisations(tmp_path):
    vectors = torch.tensor([[[1, 0]], [[0.6, 0.8j]]], dtype=torch.complex128)
    table = JonesTable(torch.tensor([0.0, 1.0]).double(), torch.zeros(1).double(), vectors)
    there = torch.tensor([[0.3, 0.2, 0.9]], dtype=torch.float64)
    cases: list[dict[str, Any]] = [
        {"polarisation": "H", "leakage": [0.0, 0.3]},
        {"polarisation": "circular"},
        {"polarisation": table},
        {"polarisation": table, "leakage": 0.2},
    ]
    for options in cases:
        arrays = linear_array(1, 1.0), linear_array(2, 1e-3, **options)
        radar = Radar(*arrays, FMCW(76e9, 1e9, 40e-6, 16), torch.zeros(1, 3, dtype=torch.float64))
        beat = torch.ones(1, 1, 2, 16, dtype=torch.complex128)
        Capture.from_beat(beat, radar).save(tmp_path / "capture.nc")
        loaded = Capture.load(tmp_path / "capture.nc").radar()
        assert loaded.transmitters.jones.equals(radar.transmitters.jones)
        one, other = (r.receivers.jones for r in (radar, loaded))
        assert torch.allclose(
            one.mixtures @ one.evaluate(there), other.mixtures @ other.evaluate(there)
        )


def test_waveforms_of_ones_own_are_refused():
    @dataclass(frozen=True)
    class Chirp(FMCW):
        pass

    with pytest.raises(InputError, match="got Chirp; use those"):
        Capture.from_beat(
            torch.zeros(2, 1, 1, 16, dtype=torch.complex128), radar(Chirp(76e9, 1e9, 40e-6, 16))
        )
