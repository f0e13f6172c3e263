"""Channel calibration: estimated from a reflector, kept in a file, taken out."""

from dataclasses import replace

import pytest
import torch

from invertwin.capture import (
    Capture,
    ChannelCalibration,
    ChirpData,
    estimate_channels,
    make_settings,
)
from invertwin.errors import InputError
from invertwin.radar.boards import board
from invertwin.radar.radar import Radar
from invertwin.radar.waveform import FMCW, Impulse
from invertwin.scene.antenna import AntennaArray

CHIRP = FMCW(77e9, 2e9, 50e-6, 128)
PLACE = torch.tensor([1.5, 0.3, -0.1], dtype=torch.float64)


def radar(frames=2):
    tx, rx = board("xWR1843").arrays(elevation=1)
    positions = torch.arange(3.0 * frames, dtype=torch.float64).reshape(frames, 3) / 100
    return Radar(tx, rx, CHIRP, positions)


def echo(place, frames=2):
    """Beat signal of a point of amplitude 1, by the formula of the derivations."""
    ends = [(element - place).norm(dim=-1) for element in radar(frames).elements()]
    delay = (ends[0][:, :, None] + ends[1][:, None])[..., None] / 299792458.0
    cycles = CHIRP.start_frequency * delay + CHIRP.slope * delay * CHIRP.sample_times
    return torch.exp(2j * torch.pi * (cycles - 0.5 * CHIRP.slope * delay**2))


def errors():
    generator = torch.Generator().manual_seed(4)
    return torch.exp(0.3 * torch.randn(3, 4, dtype=torch.complex128, generator=generator))


def recorded(frames=2):
    clutter = 0.5 * echo(torch.tensor([4.0, 0.0, 0.0]).double(), frames)
    phases = torch.exp(1j * torch.arange(frames, dtype=torch.float64))[:, None, None, None]
    beat = errors()[:, :, None] * (phases * echo(PLACE, frames) + clutter)
    return Capture.from_beat(beat, radar(frames))


@pytest.mark.parametrize("frames", [1, 3])
def test_gains_are_found_beside_clutter_and_taken_out(frames):
    estimated = estimate_channels(recorded(frames), PLACE)
    torch.testing.assert_close(
        estimated.gains, ChannelCalibration(errors()).gains, atol=3e-3, rtol=0
    )
    clean = estimated.apply(recorded(frames))
    again = estimate_channels(clean, PLACE)
    torch.testing.assert_close(
        again.gains, torch.ones(3, 4, dtype=torch.complex128), atol=1e-6, rtol=0
    )
    assert clean.radar().waveform == CHIRP


def test_gains_are_found_in_data_with_an_origin():
    """A ramp whose reference is 1 m late: the same gains, of delays that are 2 m/c less."""
    origin = torch.ones(2, dtype=torch.float64)
    centered = replace(radar(), range_origin=origin)
    ends = [(element - PLACE).norm(dim=-1) for element in radar().elements()]
    delay = ((ends[0][:, :, None] + ends[1][:, None])[..., None] - 2.0) / 299792458.0
    cycles = CHIRP.start_frequency * delay + CHIRP.slope * delay * CHIRP.sample_times
    ideal = torch.exp(2j * torch.pi * (cycles - 0.5 * CHIRP.slope * delay**2))
    estimated = estimate_channels(Capture.from_beat(errors()[..., None] * ideal, centered), PLACE)
    expected = ChannelCalibration(errors()).gains
    torch.testing.assert_close(estimated.gains, expected, atol=1e-6, rtol=0)


def test_common_power_and_phase_are_left_alone():
    gains = ChannelCalibration(errors()).gains
    assert float(gains.abs().square().mean()) == pytest.approx(1)
    assert float(gains.sum().angle()) == pytest.approx(0, abs=1e-12)
    torch.testing.assert_close(ChannelCalibration(3j * errors()).gains, gains)


def test_chirps_are_calibrated_alike():
    beat = recorded().beat
    settings = make_settings(CHIRP, 3, 4, loops=2)
    data = ChirpData(beat[:, None].expand(-1, 2, -1, -1, -1), settings)
    calibration = ChannelCalibration(errors())
    device = recorded().radar()
    arrays = (device.transmitters, device.receivers)
    corrected = calibration.apply(data.to_chirp_capture(arrays))
    torch.testing.assert_close(corrected.beat[:, 1], calibration.apply(recorded()).beat)
    real = ChirpData(data.samples.real + 0j, replace(settings, real=True)).to_chirp_capture(arrays)
    clean = calibration.apply(real)
    torch.testing.assert_close(clean.beat * calibration.gains[..., None], real.beat)
    assert clean.max_range == CHIRP.max_range / 2


def test_a_file_keeps_every_bit(tmp_path):
    calibration = ChannelCalibration(errors())
    calibration.save(tmp_path / "board.json")
    loaded = ChannelCalibration.load(tmp_path / "board.json")
    assert torch.equal(loaded.gains, calibration.gains)
    assert [path.name for path in tmp_path.iterdir()] == ["board.json"]


def test_files_that_are_none_are_refused(tmp_path):
    with pytest.raises(InputError, match="no file"):
        ChannelCalibration.load(tmp_path / "missing.json")
    with pytest.raises(InputError, match="existing folder"):
        ChannelCalibration(errors()).save(tmp_path / "nowhere" / "board.json")
    path = tmp_path / "board.json"
    for content in ("", "[]", "{}", '{"gains": [[1, 2]]}', '{"gains": "many"}'):
        path.write_text(content)
        with pytest.raises(InputError, match=r"damaged|an empty file"):
            ChannelCalibration.load(path)


def test_channels_that_cannot_be_calibrated_are_refused(unchecked):
    dead = errors()
    dead[1, 2] = 0
    with pytest.raises(InputError, match="TX element 1 to RX element 2"):
        ChannelCalibration(dead)
    with pytest.raises(InputError, match="finite gains"):
        ChannelCalibration(errors() * torch.nan)
    with pytest.raises(InputError, match="finite gains"):
        ChannelCalibration(errors()[0])
    with pytest.raises(InputError, match=r"data .* of shape \[any, 2, 4, any\]"):
        ChannelCalibration(errors()[:2]).apply(recorded())


def test_a_reflector_must_be_where_the_radar_measures(unchecked):
    with pytest.raises(InputError, match="reflector within"):
        estimate_channels(recorded(), [50.0, 0.0, 0.0])
    with pytest.raises(InputError, match="world position of the reflector"):
        estimate_channels(recorded(), [0.0, 1.0])
    silent = Capture.from_beat(recorded().beat * 0, radar())
    with pytest.raises(InputError, match="samples of zero"):
        estimate_channels(silent, PLACE)
    antenna = AntennaArray(torch.zeros(1, 3, dtype=torch.float64))
    origin = torch.zeros(1, 3, dtype=torch.float64)
    profile = Capture.from_range_profile(
        torch.ones(1, 8, dtype=torch.complex128),
        torch.arange(8, dtype=torch.float64),
        Radar(antenna, antenna, Impulse(4e9, 1e9), origin),
    )
    with pytest.raises(InputError):
        estimate_channels(profile, PLACE)
