"""Captures: what they hold, their files, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import xarray as xr

from invertwin.capture import Capture, Track, read
from invertwin.capture.readers.radar_fields import write_dataset
from invertwin.channel import Grid
from invertwin.errors import InputError
from invertwin.radar.processing.beamforming import exact_spectrum
from invertwin.radar.radar import Radar
from invertwin.radar.waveform import FMCW, Impulse
from invertwin.scene.antenna import AntennaArray, Cosine, Isotropic, TabulatedPattern, linear_array
from invertwin.scene.pose import rotation_from_vector

FRAMES = 3


def fmcw_radar(pattern=None, **changes) -> Radar:
    vectors = torch.tensor([[0.0, 0.1, 0.2], [0.3, 0.0, 0.0], [0.1, -0.2, 0.5]]).double()
    settings: dict[str, Any] = {
        "transmitters": linear_array(2, 0.0078, pattern=pattern),
        "receivers": linear_array(4, 0.0019, pattern=Cosine(1.5)),
        "waveform": FMCW(76e9, 1e9, 40e-6, 32),
        "positions": torch.arange(3.0 * FRAMES).double().reshape(FRAMES, 3) / 7,
        "rotations": torch.stack([rotation_from_vector(vector) for vector in vectors]),
        "window": "hann",
        "array_window": "rectangular",
    }
    return Radar(**(settings | changes))


def beat_capture(dtype=torch.complex128, **changes) -> Capture:
    generator = torch.Generator().manual_seed(3)
    beat = torch.randn(FRAMES, 2, 4, 32, dtype=dtype, generator=generator)
    beat[0, 0, 0, :2] = torch.tensor([complex(-0.0, -0.0), complex(0.0, -0.0)])
    return Capture.from_beat(beat, fmcw_radar(**changes), torch.tensor([0.0, 0.125, 0.25]).double())


def profile_capture(**options) -> Capture:
    ranges = 2 + 0.05 * torch.arange(60, dtype=torch.float64)
    positions = torch.zeros(FRAMES, 3, dtype=torch.float64)
    antenna = AntennaArray(torch.zeros(1, 3, dtype=torch.float64))
    radar = Radar(antenna, antenna, Impulse(4e9, 1.5e9), positions)
    profile = torch.randn(
        FRAMES, 60, dtype=torch.complex128, generator=torch.Generator().manual_seed(5)
    )
    times = torch.arange(FRAMES, dtype=torch.float64)
    return Capture.from_range_profile(profile, ranges, radar, times, **options)


def assert_same_radar(one: Radar, other: Radar) -> None:
    assert one.waveform == other.waveform
    assert (one.window, one.array_window) == (other.window, other.array_window)
    assert one.shared_visibility == other.shared_visibility
    assert torch.equal(one.positions, other.positions)
    assert torch.equal(one.link().rotations, other.link().rotations)
    for mine, its in ((one.transmitters, other.transmitters), (one.receivers, other.receivers)):
        assert torch.equal(mine.positions, its.positions)
        assert type(mine.pattern) is type(its.pattern)
        assert torch.equal(mine.pattern.table(), its.pattern.table())


@pytest.mark.parametrize("dtype", [torch.complex128, torch.complex64])
@pytest.mark.parametrize(
    "pattern",
    [
        Isotropic(),
        Cosine(2.0),
        TabulatedPattern(
            torch.linspace(0, 3, 9).double(), torch.arange(4.0).double(), torch.rand(9, 4).double()
        ),
    ],
)
def test_beat_samples_round_trip_bit_for_bit(tmp_path, dtype, pattern):
    capture = beat_capture(dtype, pattern=pattern)
    capture.save(tmp_path / "capture.nc")
    loaded = Capture.load(tmp_path / "capture.nc")
    assert loaded.beat.dtype == dtype
    bits = torch.view_as_real(capture.beat).numpy().tobytes()
    assert torch.view_as_real(loaded.beat).numpy().tobytes() == bits
    assert torch.equal(loaded.times, capture.times)
    assert_same_radar(loaded.radar(), capture.radar())
    xr.testing.assert_identical(loaded.dataset, capture.dataset)


@pytest.mark.parametrize("shared", [True, False, None])
def test_visibility_round_trips(tmp_path, shared):
    one = linear_array(1, 0.002)
    capture = beat_capture(shared_visibility=True)
    if shared is not True:
        radar = fmcw_radar(transmitters=one, shared_visibility=shared)
        capture = Capture.from_beat(capture.beat[:, :1], radar)
    capture.save(tmp_path / "capture.nc")
    assert Capture.load(tmp_path / "capture.nc").radar().shared_visibility is shared


def test_range_profiles_round_trip_with_track_and_survey(tmp_path):
    track = Track(torch.arange(9).double() - 2, torch.rand(9, 3).double())
    survey = torch.tensor([[1.0, 2.0, 0.5]]).double()
    capture = profile_capture(track=track, clock_offset=0.25, range_bias=0.4, survey=survey)
    capture.save(tmp_path / "capture.nc")
    loaded = Capture.load(tmp_path / "capture.nc")
    xr.testing.assert_identical(loaded.dataset, capture.dataset)
    assert loaded.track is not None
    assert torch.equal(loaded.track.positions, track.positions)
    assert (loaded.clock_offset, loaded.range_bias) == (0.25, 0.4)
    assert loaded.survey is not None
    assert torch.equal(loaded.survey, survey)
    assert loaded.dataset["range"].attrs["units"] == "m"


def test_an_old_file_of_beat_samples_is_turned(tmp_path):
    """A radar at 3 m ahead, 1 m to the left, 2 m up, turned to the left by 90°."""
    turn = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
    beat = np.arange(8.0).reshape(1, 2, 1, 4)
    variables = {
        "beat_real": (("frame", "tx", "rx", "sample"), beat),
        "beat_imag": (("frame", "tx", "rx", "sample"), -beat),
        "position": (("frame", "axis"), [[1.0, 2.0, 3.0]]),
        "rotation": (("frame", "axis", "radar_axis"), [turn]),
        "tx_position": (("tx", "radar_axis"), [[5e-4, 2e-4, 1e-4], [0.0, 0.0, 0.0]]),
        "rx_position": (("rx", "radar_axis"), [[-5e-4, 0.0, 0.0]]),
    }
    attributes = {
        **{"waveform": "FMCW", "start_frequency": 76e9, "bandwidth": 1e9, "duration": 40e-6},
        **{"samples": 4, "window": "hann", "array_window": "hann", "visibility": "shared"},
        **{"tx_pattern": "isotropic", "rx_pattern": "isotropic"},
    }
    old = xr.Dataset(variables, attrs=attributes)
    old.to_netcdf(tmp_path / "old.nc", engine="h5netcdf")
    capture = Capture.load(tmp_path / "old.nc")
    radar = capture.radar()
    assert radar.positions.tolist() == [[3.0, 1.0, 2.0]]
    ahead, left, up = radar.link().rotations[0].mT.tolist()
    assert ahead == [0.0, 1.0, 0.0]
    assert left == [-1.0, 0.0, 0.0]
    assert up == [0.0, 0.0, 1.0]
    assert radar.transmitters.positions.tolist() == [[1e-4, 5e-4, 2e-4], [0.0, 0.0, 0.0]]
    assert radar.receivers.positions.tolist() == [[0.0, -5e-4, 0.0]]
    assert torch.equal(capture.beat, torch.from_numpy(beat * (1 - 1j)))
    capture.save(tmp_path / "new.nc")
    again = Capture.load(tmp_path / "new.nc")
    assert again.dataset.attrs["axes"] == "x forward, y left, z up"
    xr.testing.assert_identical(again.dataset, capture.dataset)


def test_an_old_file_of_range_profiles_is_turned(tmp_path):
    track = torch.tensor([[1.0, 2.0, 3.0], [1.5, 2.5, 3.5]]).double()
    survey = torch.tensor([[4.0, 5.0, 6.0]]).double()
    path = Track(torch.tensor([-1.0, 5.0]).double(), track)
    new = profile_capture(track=path, survey=survey).dataset
    dims = ("track_time", "axis")
    old = new.assign(
        position=(("frame", "axis"), [[7.0, 8.0, 9.0]] * FRAMES),
        track_position=(dims, [[2.0, 3.0, 1.0], [2.5, 3.5, 1.5]]),
        survey=(("target", "axis"), [[5.0, 6.0, 4.0]]),
    )
    del old.attrs["axes"]
    write_dataset(old, tmp_path / "old.nc")
    found = Capture.load(tmp_path / "old.nc")
    assert found.track is not None
    assert torch.equal(found.track.positions, track)
    assert found.survey is not None
    assert torch.equal(found.survey, survey)
    assert found.radar().positions.tolist() == [[9.0, 7.0, 8.0]] * FRAMES
    assert torch.equal(found.range_profile, profile_capture().range_profile)


def test_the_file_of_an_earlier_version_is_turned():
    """``two_frames.nc`` is from before 0.4: its arrays lie along x, along which the radar moves."""
    radar = Capture.load(Path(__file__).with_name("two_frames.nc")).radar()
    assert radar.positions.tolist() == [[0.0, 0.0, 0.0], [0.0, 0.1, 0.0]]
    assert radar.transmitters.positions.tolist() == [[0.0, -0.001, 0.0], [0.0, 0.001, 0.0]]
    assert radar.receivers.positions[:, 1].tolist() == [-0.002, 0.0, 0.002]
    assert not radar.receivers.positions[:, [0, 2]].any()
    assert torch.equal(radar.link().rotations, torch.eye(3).double().expand(2, 3, 3))


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "capture.nc"
    beat_capture().save(path)
    before = path.read_bytes()

    def fail(self, data):
        with self.open("wb") as file:
            file.write(data[: len(data) // 2])
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(KeyboardInterrupt):
        beat_capture().save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_the_spectrum_of_beat_samples_is_the_exact_one():
    capture = beat_capture()
    grid = capture.radar().grid(0.5, 3.0)
    expected = exact_spectrum(capture.beat, capture.radar(), grid)
    assert torch.equal(capture.spectrum(grid), expected)


def test_the_spectrum_of_range_profiles_is_their_power():
    capture = profile_capture()
    on_samples = Grid(2.5, 0.1, 10)
    power = capture.spectrum(on_samples)
    assert tuple(power.shape) == (FRAMES, 10, 1, 1)
    expected = capture.range_profile[:, 10:30:2].abs().square()
    torch.testing.assert_close(power[..., 0, 0], expected)


def test_interpolation_between_samples_is_band_limited():
    # An echo at 4.013 m with a Gaussian envelope, sampled at 2.3 times the Nyquist step.
    ranges = 2 + 0.03 * torch.arange(128, dtype=torch.float64)
    wavenumber = 4 * torch.pi * 4e9 / 299792458.0

    def echo(r):
        offset = r - 4.013
        return torch.exp(-((offset / 0.08) ** 2)) * torch.exp(1j * wavenumber * offset)

    antenna = AntennaArray(torch.zeros(1, 3, dtype=torch.float64))
    radar = Radar(antenna, antenna, Impulse(4e9, 1.5e9), torch.zeros(1, 3, dtype=torch.float64))
    capture = Capture.from_range_profile(echo(ranges)[None], ranges, radar)
    between = torch.linspace(3.8, 4.2, 101, dtype=torch.float64)
    error = capture.interpolator()(between[None])[0] - echo(between)
    assert error.abs().max() < 2e-3


def test_frames_select_data_and_poses():
    capture = beat_capture()
    some = capture.frames([2, 0])
    assert torch.equal(some.beat, capture.beat[[2, 0]])
    assert_same_radar(some.radar(), capture.radar().frames([2, 0]))
    assert some.times.tolist() == [0.25, 0.0]


def test_recalibration_moves_ranges_and_positions():
    times = torch.linspace(-1, 5, 13, dtype=torch.float64)
    line = torch.stack([times * 0.5, times * 0, times * 0 + 1], dim=1)
    capture = profile_capture(track=Track(times, line), clock_offset=0.1, range_bias=0.4)
    moved = capture.recalibrate(clock_offset=0.3, range_bias=0.5)
    torch.testing.assert_close(moved.ranges, capture.ranges - 0.1)
    assert torch.equal(moved.range_profile, capture.range_profile)
    torch.testing.assert_close(moved.radar().positions[:, 0], 0.5 * (capture.times + 0.3))
    assert (moved.clock_offset, moved.range_bias) == (0.3, 0.5)


def test_positions_are_differentiable_in_the_clock():
    times = torch.linspace(-1, 5, 13, dtype=torch.float64)
    speed = torch.tensor([0.5, -2.0, 0.0]).double()
    capture = profile_capture(track=Track(times, times[:, None] * speed), clock_offset=0.1)
    shift = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)
    positions = capture.positions(shift)
    torch.testing.assert_close(positions.detach(), (capture.times + 0.3)[:, None] * speed)
    (gradient,) = torch.autograd.grad(positions[:, 1].sum(), shift)
    assert gradient.item() == pytest.approx(-2.0 * FRAMES)


def test_a_shift_beyond_the_track_is_refused():
    track = Track(torch.arange(4).double(), torch.rand(4, 3).double())
    with pytest.raises(InputError, match="check the clock offset"):
        profile_capture(track=track).positions(torch.tensor(1.5).double())
    with pytest.raises(InputError, match="track of the radar"):
        profile_capture().positions(torch.tensor(0.0).double())


@pytest.mark.parametrize(
    ("times", "positions", "message"),
    [
        ([0.0, 1.0], [[0.0, 0, 0]], "one position per time"),
        ([0.0, 0.0], [[0.0, 0, 0], [1, 1, 1]], "ascending"),
        ([0.0, 1.0], [[0.0, 0, 0], [1, 1, float("nan")]], "finite track"),
    ],
)
def test_bad_tracks_are_refused(unchecked, times, positions, message):
    with pytest.raises(InputError, match=message):
        Track(torch.tensor(times).double(), torch.tensor(positions).double())


def test_nan_is_refused():
    beat = beat_capture().beat
    beat.imag[1, 0, 2, 7] = float("nan")
    with pytest.raises(InputError, match=r"finite beat, got 1 NaN, .* of 768"):
        Capture.from_beat(beat, fmcw_radar())


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ((slice(2),), "expected 2 along frame in position as in beat, got 3"),
        ((slice(None), slice(1)), "along tx"),
        ((slice(None), slice(None), slice(3)), "along rx"),
        ((..., slice(16)), "expected 32 samples per ramp"),
    ],
)
def test_wrong_shapes_are_refused(part, message):
    with pytest.raises(InputError, match=message):
        Capture.from_beat(beat_capture().beat[part], fmcw_radar())


def test_wrong_dimensions_are_refused(unchecked):
    with pytest.raises(InputError, match="expected dimensions frame, tx, rx, sample of shape"):
        Capture.from_beat(beat_capture().beat[:, 0], fmcw_radar())


def test_beat_samples_need_a_waveform_that_has_them():
    radar = fmcw_radar(waveform=Impulse(76e9, 1e9))
    with pytest.raises(InputError, match="FMCW waveform"):
        Capture.from_beat(beat_capture().beat, radar)


def test_range_profiles_must_be_uniform_and_of_one_channel():
    capture = profile_capture()
    with pytest.raises(InputError, match="uniform"):
        Capture.from_range_profile(capture.range_profile, capture.ranges**2, capture.radar())
    with pytest.raises(InputError, match="one tx element"):
        Capture.from_range_profile(capture.range_profile, capture.ranges, fmcw_radar())


def test_the_other_kind_of_data_is_refused():
    with pytest.raises(InputError, match="capture of beat, got one of range_profile"):
        _ = profile_capture().beat
    with pytest.raises(InputError, match="capture of range_profile, got one of beat"):
        _ = beat_capture().ranges


def test_grids_that_the_profiles_cannot_fill_are_refused():
    with pytest.raises(InputError, match="ranges within the profile"):
        profile_capture().spectrum(Grid(1.0, 0.1, 20))
    with pytest.raises(InputError, match="do not resolve directions"):
        profile_capture().spectrum(Grid(2.5, 0.1, 10, u_count=3))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.assign_attrs(waveform="chirp"), "waveform to be one of FMCW, Impulse"),
        (lambda d: d.assign_attrs(axes="x left"), "axes to be one of x forward, y left, z up, got"),
        (lambda d: d.assign_attrs(bandwidth=1.0), "in Hz"),
        (lambda d: d.drop_vars("beat"), "either beat or range_profile"),
        (lambda d: d.drop_vars("rotation"), "a variable 'rotation'"),
        (lambda d: d.drop_attrs(), "an attribute"),
        (lambda d: d.assign_attrs(tx_pattern="odd"), "tx_pattern to be one of"),
        (lambda d: d.assign(beat=d["beat"].real), "complex beat with dimensions"),
        (lambda d: d.transpose("sample", ...), "complex beat with dimensions"),
    ],
)
def test_datasets_that_are_no_captures_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        Capture(change(beat_capture().dataset))


def test_files_that_cannot_be_read_are_refused(tmp_path):
    with pytest.raises(InputError, match="no file"):
        Capture.load(tmp_path / "missing.nc")
    path = tmp_path / "capture.nc"
    beat_capture().save(path)
    whole = path.read_bytes()
    for size in (0, 7, len(whole) // 2, len(whole) - 100):
        path.write_bytes(whole[:size])
        with pytest.raises(InputError, match=r"damaged or of another kind|an empty file"):
            Capture.load(path)
    with pytest.raises(InputError, match="existing folder"):
        beat_capture().save(tmp_path / "nowhere" / "capture.nc")


def test_half_a_complex_variable_is_refused(tmp_path):
    path = tmp_path / "capture.nc"
    beat = beat_capture().dataset["beat"]
    xr.Dataset({"beat_real": beat.real}).to_netcdf(path, engine="h5netcdf")
    with pytest.raises(InputError, match="expected beat_imag"):
        Capture.load(path)


def test_recordings_are_told_by_their_ending(tmp_path):
    beat_capture().save(tmp_path / "capture.nc")
    assert read(tmp_path / "capture.nc").frame_count == FRAMES
    with pytest.raises(
        InputError, match=r"ends in .bin, .setup.json, .toml, .s1p, .s2p or .nc, got .*x.wav"
    ):
        read(tmp_path / "x.wav")


def test_numpy_samples_are_welcome_and_real_ones_are_named():
    beat, radar = beat_capture().beat, beat_capture().radar()
    assert torch.equal(Capture.from_beat(beat.numpy(), radar).beat, beat)
    with pytest.raises(InputError, match="expected complex"):
        Capture.from_beat(beat.real.numpy(), radar)
