"""The reader of the rail recording, on a small imitation and on the recording itself."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from invertwin.capture import Capture, backproject, calibrate, locate
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.radar import SteppedFrequency
from invertwin_studies.recordings.rail_sar import FILE, read

META = {"align_time_offset_s": 0.5, "align_range_bias_m": 0.2, "valid_scan_time_s": [0.1, 0.9]}


def imitation() -> dict[str, np.ndarray]:
    """One echo that moves with the radar and one, much stronger, that does not."""
    clock = np.arange(51) * 0.02
    ranges = 2 + 0.01 * np.arange(200)
    track_times = np.arange(0, 3, 0.05)
    track = np.stack([track_times * 0, -track_times, track_times * 0], axis=1)
    moving = 3 + 0.3 * clock[:, None] - ranges
    still = 2.5 - ranges
    wave = np.exp(-((moving / 0.1) ** 2)) * np.cos(160 * moving)
    wave = wave + 20 * np.exp(-((still / 0.1) ** 2)) * np.cos(160 * still)
    return {
        "scan_data": np.round(1e4 * wave).astype(np.int32),
        "scan_timestamps": np.round(7000 + 1e3 * clock).astype(np.uint32),
        "range_bins": ranges,
        "motion_timestamps": track_times,
        "platform_pos": track,
        "corner_reflector_pos": np.array([[3.0, 0, 0], [3, 1, 0]]),
        "meta": np.array(json.dumps(META)),
    }


@pytest.fixture
def write(tmp_path):
    def write(**changes):
        arrays = imitation() | changes
        given = {name: array for name, array in arrays.items() if array is not None}
        np.savez(tmp_path / FILE, allow_pickle=False, **given)
        return tmp_path

    return write


def test_scans_become_labelled_range_profiles(write):
    capture = read(write())
    assert capture.frame_count == 41
    torch.testing.assert_close(capture.times, torch.arange(5, 46).double() * 0.02)
    torch.testing.assert_close(capture.ranges, 1.8 + 0.01 * torch.arange(200).double())
    torch.testing.assert_close(capture.radar().positions[:, 1], -(capture.times + 0.5))
    assert capture.survey is not None
    assert tuple(capture.survey.shape) == (2, 3)


def test_profiles_are_analytic_and_without_what_stands_still(write):
    capture = read(write())
    spectrum = torch.fft.fft(capture.range_profile, dim=1).abs()
    assert spectrum[:, 101:].max() < 1e-6 * spectrum.max()
    power = capture.range_profile.abs().square()
    bin_of_the_still_echo = int((2.5 - 2) / 0.01)
    assert power[:, bin_of_the_still_echo].max() < 0.01 * power.max()
    measured = capture.ranges[power.argmax(dim=1)]
    assert (measured - (3 + 0.3 * capture.times - 0.2)).abs().max() < 0.05


def test_clock_and_bias_can_be_given(write):
    capture = read(write(), clock_offset=0.7, range_bias=0.1)
    torch.testing.assert_close(capture.radar().positions[:, 1], -(capture.times + 0.7))
    assert capture.ranges[0].item() == pytest.approx(1.9)
    assert (capture.clock_offset, capture.range_bias) == (0.7, 0.1)


def test_the_recording_survives_a_file_of_our_own(write, tmp_path):
    capture = read(write())
    capture.save(tmp_path / "rail.nc")
    assert torch.equal(Capture.load(tmp_path / "rail.nc").range_profile, capture.range_profile)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"meta": None}, "array meta"),
        ({"range_bins": np.ones((2, 2))}, "range_bins with 1 dimensions"),
        ({"scan_data": np.ones((51, 199))}, "scan_data of shape"),
        ({"platform_pos": np.ones((5, 3))}, "platform_pos of shape"),
        ({"meta": np.array("{}")}, "clock offset, range bias"),
        ({"meta": np.array(json.dumps(META | {"valid_scan_time_s": [8, 9]}))}, "got none"),
        ({"meta": np.array(json.dumps(META | {"align_time_offset_s": 9}))}, "clock offset"),
        ({"scan_data": np.full((51, 200), np.nan)}, "finite range_profile"),
    ],
)
def test_recordings_that_are_wrong_are_refused(write, changes, message):
    with pytest.raises(InputError, match=message):
        read(write(**changes))


def test_missing_and_truncated_recordings_are_refused(write, tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read(tmp_path)
    path = write() / FILE
    whole = path.read_bytes()
    for size in (0, 10, len(whole) // 2):
        path.write_bytes(whole[:size])
        with pytest.raises(InputError, match="damaged or truncated"):
            read(tmp_path)


def test_the_recording_calibrated_on_one_reflector(data_folder):
    capture = read(data_folder / "rail_sar")
    assert capture.frame_count == 237
    assert capture.survey is not None
    first, second = capture.survey
    calibrated = calibrate(capture, first)
    assert calibrated.clock_offset == pytest.approx(9.216, abs=2e-3)
    assert calibrated.range_bias == pytest.approx(0.4626, abs=2e-3)
    assert (locate(calibrated, first) - first).norm() == pytest.approx(0.020, abs=2e-3)
    assert (locate(calibrated, second) - second).norm() == pytest.approx(0.177, abs=2e-3)


def test_a_measured_pass_is_centred_beyond_its_unambiguous_range(data_folder):
    """As sweeps of 5 m of ambiguity, centred between reflectors 7 and 8 m away: the same image."""
    capture = read(data_folder / "rail_sar")
    survey = capture.survey
    assert survey is not None
    capture = calibrate(capture, survey[0])
    center = survey.mean(0)
    for max_range, centered in ((12.0, False), (5.0, True)):
        step = SPEED_OF_LIGHT / 2 / max_range
        sweep = SteppedFrequency(3.1e9, step, int(1.7e9 / step), 1e-6)
        radar = replace(capture.radar(), waveform=sweep)
        radar = radar.center_on(center) if centered else radar
        shown = capture.ranges[:, None] * sweep.frequencies
        response = capture.range_profile.to(torch.complex128) @ torch.exp(
            -4j * torch.pi * shown / SPEED_OF_LIGHT
        )
        back = radar.origins[:, None] * sweep.frequencies
        beat = response.conj() * torch.exp(-4j * torch.pi * back / SPEED_OF_LIGHT)
        swept = Capture.from_beat(beat[:, None, None], radar)
        for target, error in zip(survey, (0.02, 0.17), strict=True):
            line = torch.linspace(-0.3, 0.3, 121, dtype=torch.float64)
            offset = torch.nn.functional.pad(torch.cartesian_prod(line, line), (0, 1))
            image = backproject(swept, target + offset).abs()
            assert float(offset[image.argmax()].norm()) == pytest.approx(error, abs=0.005)
