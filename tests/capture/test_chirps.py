"""Chirp-resolved samples: their settings, and how they become a capture."""

from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch

from invertwin.capture import ChirpData, ChirpSettings, adc_counts, make_settings
from invertwin.capture.chirps import shortest_loop
from invertwin.errors import InputError
from invertwin.radar.boards import board
from invertwin.radar.signal.chirps import Chirps
from invertwin.radar.waveform import FMCW, PhysicsWarning

SETTINGS = ChirpSettings(
    start_frequency=77e9,
    slope=60e12,
    sample_rate=5e6,
    samples=32,
    transmit_order=(1, 3, 2),
    receivers=(1, 2, 3, 4),
    loops=4,
    frame_period=0.05,
    idle_time=10e-6,
    adc_start_time=6e-6,
    ramp_end_time=20e-6,
)
ARRAYS = board("xWR1843").arrays(elevation=1)


def samples(frames=2, settings=SETTINGS):
    generator = torch.Generator().manual_seed(1)
    shape = (frames, settings.loops, 3, 4, settings.samples)
    return torch.randn(shape, dtype=torch.complex64, generator=generator)


def test_the_waveform_is_the_sampled_part_of_the_ramp():
    waveform = SETTINGS.waveform
    assert waveform.start_frequency == pytest.approx(77e9 + 60e12 * 6e-6)
    assert waveform.bandwidth == pytest.approx(60e12 * 6.4e-6)
    assert waveform.duration == pytest.approx(6.4e-6)
    assert waveform.slope == pytest.approx(60e12)
    assert SETTINGS.chirps.count == 4
    assert SETTINGS.chirps.interval == pytest.approx(30e-6)
    assert replace(SETTINGS, ramp_end_time=None).chirps.interval == pytest.approx(22.4e-6)


def test_settings_of_a_waveform_record_it():
    chirp = FMCW(77e9, 1.2e9, 40e-6, 200)
    settings = make_settings(chirp, 2, 4, loops=8, frames=3)
    assert settings.waveform.start_frequency == chirp.start_frequency
    assert settings.waveform.bandwidth == pytest.approx(chirp.bandwidth, rel=1e-12)
    assert settings.sample_rate == 5e6
    assert (settings.transmit_order, settings.receivers) == ((1, 2), (1, 2, 3, 4))


def test_turns_of_a_simulation_become_the_order_of_sending():
    """Elements in the board's order, sent as TX3, TX1, TX2: files have them as they were sent."""
    turns = Chirps(4, 50e-6, order=(2, 0, 1))
    chirp = FMCW(77e9, 1.2e9, 40e-6, 16)
    settings = make_settings(chirp, 3, 2, loops=4, idle_time=10e-6, order=turns.order)
    assert settings.transmit_order == (3, 1, 2)
    beat = torch.randn(1, 4, 3, 2, 16, dtype=torch.complex128)
    data = adc_counts(beat, settings, full_scale=10.0, order=turns.order)
    plain = adc_counts(beat, settings, full_scale=10.0)
    for slot, element in enumerate((2, 0, 1)):
        assert torch.equal(data.samples[:, :, slot], plain.samples[:, :, element])
        sent = settings.chirps.times(3)[:, slot]
        torch.testing.assert_close(sent, turns.times(3)[:, element])
    for order in ((0, 1), (0, 1, 3), (0, 0, 1)):
        with pytest.raises(InputError, match="names each of 3 transmitters once"):
            adc_counts(beat, settings, 10.0, order)
        with pytest.raises(InputError, match="names each of 3 transmitters once"):
            make_settings(chirp, 3, 2, order=order)


def test_repeated_orders_are_loops():
    assert shortest_loop((1, 2, 1, 2), 3) == ((1, 2), 6)
    assert shortest_loop((1, 1, 1), 5) == ((1,), 15)
    assert shortest_loop((1, 2, 3), 5) == ((1, 2, 3), 5)


def test_a_capture_is_the_mean_or_one_chirp():
    data = ChirpData(samples(), SETTINGS)
    mean = data.to_chirp_capture(ARRAYS).to_capture("mean")
    torch.testing.assert_close(mean.beat, data.samples.mean(1))
    assert mean.times.tolist() == [0.0, 0.05]
    one = data.to_chirp_capture(ARRAYS, torch.ones(2, 3, dtype=torch.float64)).to_capture(2)
    assert torch.equal(one.beat, data.samples[:, 2])
    assert float(one.radar().positions.sum()) == 6
    assert one.radar().waveform == SETTINGS.waveform


def test_real_samples_become_analytic():
    settings = replace(SETTINGS, real=True, samples=64)
    time = torch.arange(64, dtype=torch.float64) / 64
    echo = torch.exp(2j * torch.pi * (8 * time + 0.2))
    recorded = torch.zeros(2, 4, 3, 4, 64, dtype=torch.complex64) + echo.real
    data = ChirpData(recorded, settings)
    torch.testing.assert_close(data.beat[:, 0], data.to_chirp_capture(ARRAYS).to_capture(0).beat)
    beat = data.to_chirp_capture(ARRAYS).to_capture("mean").beat
    torch.testing.assert_close(beat[1, 2, 3].to(torch.complex128), echo, atol=1e-6, rtol=0)


def test_an_analytic_signal_needs_memory(monkeypatch):
    settings = replace(SETTINGS, real=True, samples=64)
    data = ChirpData(torch.ones(2, 4, 3, 4, 64, dtype=torch.complex64), settings)
    for free, fits in ((56.0 * data.samples.numel(), True), (55.0 * data.samples.numel(), False)):
        monkeypatch.setattr("invertwin.runtime.memory.free_memory", lambda free=free: free)
        with nullcontext() if fits else pytest.raises(InputError, match="give fewer frames"):
            assert data.beat.shape == data.samples.shape


def test_counts_are_scaled_rounded_and_clipped():
    beat = samples()[:, 0] / 100
    counts = adc_counts(beat, SETTINGS, full_scale=0.1)
    assert counts.samples.shape == (2, 4, 3, 4, 32)
    torch.testing.assert_close(counts.samples[:, 3] / 32767 * 0.1, beat, atol=0.1 / 32767, rtol=0)
    assert torch.equal(counts.samples.real, counts.samples.real.round())
    with pytest.warns(PhysicsWarning, match="saturated"):
        clipped = adc_counts(beat, SETTINGS, full_scale=0.01)
    assert torch.view_as_real(clipped.samples).abs().max() <= 32768
    real = adc_counts(beat, replace(SETTINGS, real=True), full_scale=0.1)
    assert not real.samples.imag.any()


def test_the_range_of_the_adc_is_that_of_its_bits():
    data = ChirpData(samples(), replace(SETTINGS, bits=12))
    data.samples[0, 0, 0, 0, 0] = 2047
    data.samples.imag[1, 0, 0, 0, 0] = -2048
    with pytest.warns(PhysicsWarning, match=r"^2 of 3072 samples .* \(±2047\)"):
        data.warn_if_saturated()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"transmit_order": (1, 2, 1)}, "once per loop"),
        ({"transmit_order": ()}, "once per loop"),
        ({"receivers": (2, 1)}, "ascending receiver"),
        ({"receivers": ()}, "ascending receiver"),
        ({"lanes": 3}, "lanes to be one of 2, 4, got 3"),
        ({"bits": 10}, "bits to be one of 12, 14, 16, got 10"),
        ({"samples": 1}, "samples of at least 2, got 1"),
        ({"loops": 0}, "loops of at least 1, got 0"),
        ({"frames": 0}, "frames of at least 1, got 0"),
        ({"start_frequency": 77.0}, "start_frequency in Hz, got 77; did you mean 77e9"),
        ({"slope": 0.0}, "slope above 0, got 0"),
        ({"idle_time": 10.0}, "idle_time in seconds, got 10; did you mean 10e-6"),
        ({"ramp_end_time": 12e-6}, "ramp of at least 1.24e-05 s"),
    ],
)
def test_settings_that_cannot_be_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        replace(SETTINGS, **change)


def test_data_must_fit_the_settings(unchecked):
    with pytest.raises(
        InputError, match=r"shape \[any, 4, 3, 4, 32\], got shape \[2, 4, 3, 4, 31\]"
    ):
        ChirpData(samples()[..., 1:], SETTINGS)
    bad = samples()
    bad[0, 0, 0, 0, 0] = torch.nan
    with pytest.raises(InputError, match="finite samples"):
        ChirpData(bad, SETTINGS)
    with pytest.raises(InputError, match="full scale"):
        adc_counts(samples(), SETTINGS, 0.0)


def test_a_capture_needs_a_choice_and_its_elements():
    data = ChirpData(samples(), SETTINGS)
    for chirps in (4, -1, "all", True):
        with pytest.raises(InputError, match='"mean" or a number from 0 to 3'):
            data.to_chirp_capture(ARRAYS).to_capture(chirps)
    two = board("xWR1642").arrays()
    with pytest.raises(InputError, match="expected 3 TX elements"):
        data.to_chirp_capture(two)
    with pytest.raises(InputError, match="expected 4 RX elements"):
        data.to_chirp_capture((ARRAYS[0], two[0]))
