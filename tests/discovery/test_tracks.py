"""What moves is followed from frame to frame."""

import pytest
import torch

import invertwin as iw
from invertwin.capture import ChirpCapture
from invertwin.discovery import average_chirps
from invertwin.discovery.tracks import track_moving_targets
from invertwin.radar import Chirps, add_noise
from invertwin.scene import AntennaArray, RoughDielectric, linear_array, rigid, sphere

CHIRP = iw.FMCW(start_frequency=77e9, bandwidth=2e9, duration=40e-6, samples=128)
PERIOD, FRAMES = 0.15, 8
STARTS = torch.tensor([[2.0, -0.8, 0.0], [3.2, 0.9, 0.0]], dtype=torch.float64)
RATES = torch.tensor([[1.0, 0.8, 0.0], [-1.4, -0.7, 0.0]], dtype=torch.float64)


def recorded(rates: torch.Tensor, own: torch.Tensor) -> ChirpCapture:
    """Two balls before a board that moves; each frame is made where the board rests."""
    still = torch.zeros(1, 3, dtype=torch.float64)
    chirps = Chirps(32, 300e-6)
    sampling = iw.Sampling(depth=1, points_per_m2=800.0, boundary=False)
    places = PERIOD * torch.arange(FRAMES, dtype=torch.float64)[:, None] * own
    radar = iw.Radar(AntennaArray(still), linear_array(8, CHIRP.wavelength / 2), CHIRP, still)
    beats = []
    for frame in range(FRAMES):
        scene = iw.Scene(
            {
                f"ball_{k}": iw.Object(
                    sphere(0.06, 2),
                    RoughDielectric(permittivity=5.0),
                    rigid(translation=start + frame * PERIOD * rate - places[frame]),
                    velocity=rate - own,
                )
                for k, (start, rate) in enumerate(zip(STARTS, rates, strict=True))
            }
        )
        beat = iw.simulate_chirps(scene, radar, chirps, seed=frame, sampling=sampling)
        beats.append(add_noise(beat, snr_db=10.0, seed=frame))
    radar = iw.Radar(radar.transmitters, radar.receivers, CHIRP, places)
    return ChirpCapture(torch.cat(beats), radar, chirps, frame_period=PERIOD)


def test_two_movers_are_followed():
    recording = recorded(RATES, torch.zeros(3, dtype=torch.float64))
    found = track_moving_targets(recording, recording.radar().grid(0.3, 6.0))
    assert len(found) == 2
    for one in found:
        assert one.track is not None
        assert one.velocity is not None
        assert len(one.track.times) == FRAMES
        assert float(one.track.times[-1]) == pytest.approx(PERIOD * (FRAMES - 1))
        away = [float((one.track.positions[0] - start).norm()) for start in STARTS]
        number = away.index(min(away))
        rate, start = RATES[number], STARTS[number]
        assert (one.velocity - rate).norm() < 0.3
        for k, time in enumerate(one.track.times):
            true = start + time * rate
            # The nearest echo of a ball is its front.
            true = true * (1 - 0.06 / true.norm())
            for number, axis in enumerate("xy"):
                off = float(one.track.positions[k, number] - true[number])
                assert abs(off) < 3 * float(one.track.deviations[axis][k])
        assert torch.equal(one.position, one.track.positions[-1])
        assert one.to_metrics()["track"]["times_s"][0] == 0.0


def test_what_only_the_radar_moves_past_is_at_rest():
    """A drive: the far ball rests, the near one moves; its velocity is that along the ground."""
    rates = RATES.clone()
    rates[1] = 0.0
    own = torch.tensor([1.2, 0.0, 0.0], dtype=torch.float64)
    recording = recorded(rates, own)
    (found,) = track_moving_targets(recording, recording.radar().grid(0.3, 6.0))
    assert found.velocity is not None
    assert (found.velocity - rates[0]).norm() < 0.4
    end = STARTS[0] + PERIOD * (FRAMES - 1) * rates[0]
    assert (found.position - end).norm() < 0.2
    # The mean of its chirps would lose what rests.
    still = average_chirps(recording)
    assert torch.equal(still.beat, recording.beat[:, 16])
