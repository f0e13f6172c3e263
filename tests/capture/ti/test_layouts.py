"""Settings that contradict a raw file: the right ones are found by the samples, or none is."""

from dataclasses import replace

import pytest
import torch

from invertwin.capture import ChirpSettings, adc_counts
from invertwin.capture.ti import change_settings, read_samples, write_samples
from invertwin.capture.ti.layouts import MIN_BORDER_RATIO, find_candidates, measure_evidence
from invertwin.errors import InputError
from invertwin.radar import Radar
from invertwin.radar.boards import board
from invertwin.radar.waveform import PhysicsWarning
from oracles.moving_point import moving_point

SETTINGS = ChirpSettings(
    start_frequency=77e9,
    slope=40e12,
    sample_rate=5e6,
    samples=64,
    transmit_order=(1, 2),
    receivers=(1, 2, 3, 4),
    loops=4,
    frames=2,
    frame_period=0.05,
    idle_time=5e-6,
    ramp_end_time=60e-6,
    lanes=2,
)


def recorded(path, settings: ChirpSettings = SETTINGS, noise: float = 0.03):
    """The raw file of two echoes."""
    elements = board("xWR1642").arrays(transmitters=[1, 2])
    radar = Radar(*elements, settings.waveform, torch.zeros(2, 3, dtype=torch.float64))
    echoes = [
        moving_point(radar, settings.chirps, r, 0.0, u, amplitude=a)
        for r, u, a in ((3.1, 0.3, 1.0), (5.37, -0.5, 0.6))
    ]
    beat = echoes[0] + echoes[1]
    white = torch.randn(beat.shape, generator=torch.Generator().manual_seed(1), dtype=beat.dtype)
    write_samples(path, adc_counts(beat + noise * white, settings, full_scale=3.0 + 6 * noise))
    return path


@pytest.mark.parametrize("kind", [{}, {"lanes": 4}, {"real": True}], ids=str)
@pytest.mark.parametrize(
    ("wrong", "right"),
    [
        ({"samples": 100}, "samples=64"),
        ({"samples": 96, "receivers": 3}, "receivers=4, samples=64"),
        ({"samples": 128, "loops": 2}, ".*samples=64, loops=4.*"),
        ({"samples": 32, "loops": 8}, ".*samples=64, loops=4.*"),
    ],
)
def test_the_samples_tell(tmp_path, kind, wrong, right):
    """Two changes too, and where the stated size is the file's.

    Whether other numbers are of loops, transmitters or frames they do not tell.
    """
    settings = replace(SETTINGS, **kind)
    path = recorded(tmp_path / "adc.bin", settings)
    if kind == {"lanes": 4} and "receivers" in wrong:
        right = "receivers=4, samples=64"
    with pytest.raises(InputError, match=rf"what fits: {right} \(prediction fails .* more"):
        read_samples(path, change_settings(settings, wrong))
    assert read_samples(path, settings).frame_count == 2


def test_lanes_that_are_wrong_are_seen_in_files_of_the_same_size(tmp_path):
    path = recorded(tmp_path / "adc.bin")
    with pytest.raises(InputError, match=r"break elsewhere; what fits: lanes=2 \("):
        read_samples(path, change_settings(SETTINGS, {"lanes": 4}))


def test_what_no_sample_tells_is_refused(tmp_path):
    """Loops or frames: the same blocks."""
    path = recorded(tmp_path / "adc.bin")
    with pytest.raises(InputError, match=r"loops=4 .*frames=|frames=.* loops=4 .*do not tell"):
        read_samples(path, change_settings(SETTINGS, {"loops": 2}))
    with pytest.raises(InputError, match="the samples do not tell these apart"):
        read_samples(path, change_settings(SETTINGS, {"loops": 8}))


def test_a_stopped_recording_is_read_where_samples_agree(tmp_path):
    """Seven frames were to come; no number of loops fits two frames of the seven."""
    path = recorded(tmp_path / "adc.bin")
    with pytest.warns(PhysicsWarning, match="holds 2 of the 7 frames"):
        assert read_samples(path, replace(SETTINGS, frames=7)).frame_count == 2


def test_without_a_number_of_frames_samples_still_contradict(tmp_path):
    path = recorded(tmp_path / "adc.bin")
    endless = replace(SETTINGS, frames=None)
    assert read_samples(path, endless).frame_count == 2
    with pytest.raises(InputError, match=r"what fits: .*receivers=4"):
        read_samples(path, change_settings(endless, {"receivers": 2, "lanes": 4}))


def test_a_ramp_holds_its_samples(tmp_path):
    """Of 64 × 8 blocks, 512 samples would need 102 µs; more loops than a period holds are none."""
    words = torch.from_file(
        str(recorded(tmp_path / "adc.bin")), dtype=torch.int16, size=2 * 2 * 4 * 64 * 8
    ).numpy()
    found = find_candidates(words, replace(SETTINGS, samples=50, frame_period=2e-3))
    assert {one.changes.get("samples") for one in found} >= {64, 128}
    for one in found:
        s = one.settings
        assert s.samples / s.sample_rate <= s.ramp_time
        assert s.loops * len(s.transmit_order) * 65e-6 <= 2e-3
    (alone,) = [one for one in found if one.changes == {"samples": 64}]
    assert alone.evidence.border_ratio > 10 * MIN_BORDER_RATIO
    assert measure_evidence(words, replace(SETTINGS, samples=128)).border_ratio < 1
    assert measure_evidence(words, replace(SETTINGS, samples=32)).border_ratio < MIN_BORDER_RATIO


def test_noise_tells_nothing(tmp_path):
    path = recorded(tmp_path / "adc.bin", noise=100.0)
    assert read_samples(path, SETTINGS).frame_count == 2
    with pytest.raises(InputError, match="do not tell where blocks end"):
        read_samples(path, change_settings(SETTINGS, {"samples": 100}))


def test_only_known_settings_are_changed():
    assert change_settings(SETTINGS, {"receivers": 2}).receivers == (1, 2)
    with pytest.raises(InputError, match="changes of lanes, real"):
        change_settings(SETTINGS, {"slope": 1e12})
