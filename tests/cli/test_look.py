"""`invertwin look`: recordings of every kind as pictures, numbers and captures; bad ones."""

import html
import re
import shlex
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from cli.small import call, read_metrics
from invertwin.capture import Capture, ChannelCalibration, ChirpData, ChirpSettings, adc_counts
from invertwin.capture.readers import described_arrays
from invertwin.capture.ti import write_cfg, write_samples, write_setup, write_studio
from invertwin.radar import Chirps, Radar, doppler_snapshots, high_resolution_map, velocity_span
from invertwin.radar.boards import board
from oracles.moving_point import moving_point

SETTINGS = ChirpSettings(
    start_frequency=60e9,
    slope=40e12,
    sample_rate=2e6,
    samples=64,
    transmit_order=(1, 3, 2),
    receivers=(1, 2, 3, 4),
    loops=16,
    frames=2,
    frame_period=0.05,
    idle_time=8e-6,
    adc_start_time=0.0,
    ramp_end_time=32e-6,
    lanes=2,
)
ARRAYS = board("IWR6843ISK").arrays(elevation=1, transmitters=[1, 3, 2])
RADAR = Radar(*ARRAYS, SETTINGS.waveform, torch.zeros(2, 3, dtype=torch.float64))
CHIRPS = Chirps(SETTINGS.loops, SETTINGS.idle_time + SETTINGS.ramp_time)
RATE = 0.25 * velocity_span(RADAR, CHIRPS)
BOARD = ("--board", "IWR6843ISK", "--elevation", "1")


def mover(settings: ChirpSettings = SETTINGS, full_scale: float = 1.5) -> ChirpData:
    """A point at 3 m, u = 0.3, that moves away, in counts of a 16-bit ADC."""
    beat = moving_point(RADAR, CHIRPS, 3.0, RATE, 0.3, 0.0)
    return adc_counts(beat, settings, full_scale)


@pytest.fixture
def recording(tmp_path, monkeypatch):
    """The raw files of a bench, as the tools of the board write them."""
    monkeypatch.chdir(tmp_path)
    data = mover()
    write_samples("adc.bin", data)
    write_cfg("bench.cfg", SETTINGS)
    write_studio("bench.mmwave.json", SETTINGS)
    write_setup("bench.setup.json", "bench.mmwave.json", ["adc.bin"])
    described_arrays.write_chirps("adc.toml", data, "adc.h5", ARRAYS)
    return tmp_path


@pytest.mark.parametrize("turned", [False, True])
def test_echoes_in_the_farther_half_only_may_be_mirrored(recording, monkeypatch, turned):
    description = (recording / "adc.toml").read_text()
    if turned:
        description = description.replace("[data]", "[data]\nconjugate = true")
    (recording / "turned.toml").write_text(description)
    assert call(monkeypatch, "look", "turned.toml") == 0
    said = read_metrics(recording / "out" / "turned")["warnings"]
    assert any("I and Q are exchanged; say conjugate = true" in line for line in said) == turned


def test_the_command_of_the_start_page(recording, monkeypatch, repository):
    page = (repository / "docs" / "start.md").read_text()
    (line,) = re.findall(r"^    \.venv/bin/invertwin (look .*)$", page, re.MULTILINE)
    assert call(monkeypatch, *line.split()) == 0
    assert read_metrics(recording / "out" / "adc")["mover_range_m"] == pytest.approx(3.0, abs=0.06)


def test_a_description_as_the_docs_have_it(recording, monkeypatch, repository):
    page = (repository / "docs" / "measured_data.md").read_text()
    (text,) = re.findall(r"^```ini\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    samples = mover().samples[:, :, :2].flatten(2, 3).numpy()
    with h5py.File("adc.h5", "w") as file:
        file["adc"] = samples
    (recording / "own.toml").write_text(text)
    assert call(monkeypatch, "look", "own.toml") == 0
    assert read_metrics(recording / "out" / "own")["channels"] == 8


@pytest.mark.parametrize(
    "arguments",
    [
        ["adc.bin", "--config", "bench.cfg", *BOARD],
        ["bench.setup.json", *BOARD, "--set", "frames=2", "--set", "loops=16"],
    ],
    ids=["cfg", "changed"],
)
def test_the_command_of_the_report_is_the_same_run(recording, monkeypatch, arguments):
    """It has range rates, too, which the capture in the folder has not."""
    (recording / "some folder").mkdir()
    folder = recording / "some folder" / "seen"
    more = ["--range-max", "5", "--method", "capon"]
    assert call(monkeypatch, "look", *arguments, *more, "-o", str(folder)) == 0
    text = html.unescape((folder / "report.html").read_text())
    (line,) = re.findall(r"<pre>invertwin (look .*)</pre>", text)
    monkeypatch.chdir(folder)
    assert call(monkeypatch, *shlex.split(line)) == 0
    first, second = (read_metrics(path) for path in (folder, folder / "again"))
    assert first == second


@pytest.mark.parametrize(
    "arguments",
    [
        ["adc.bin", "--config", "bench.cfg", *BOARD],
        ["adc.bin", "-c", "bench.mmwave.json", *BOARD],
        ["bench.setup.json", *BOARD],
        ["adc.toml"],
    ],
    ids=["cfg", "studio", "setup", "described arrays"],
)
def test_a_mover_is_where_it_is(recording, monkeypatch, capsys, arguments):
    assert call(monkeypatch, "look", *arguments, "-o", "seen", "--frame", "1") == 0
    found = read_metrics(recording / "seen")
    span = velocity_span(RADAR, CHIRPS)
    assert found["frames"] == 2
    assert found["velocity_span_m_s"] == pytest.approx(span)
    for kind in ("peak", "mover"):
        assert found[f"{kind}_range_m"] == pytest.approx(3.0, abs=0.06)
        assert found[f"{kind}_velocity_m_s"] == pytest.approx(RATE, abs=span / 16)
        assert found[f"{kind}_u"] == pytest.approx(0.3, abs=0.07)
    names = {path.name for path in (recording / "seen").iterdir()}
    assert names >= {"capture.nc", "look.png", "metrics.json", "report.html"}
    assert "range rate" in capsys.readouterr().out


def test_the_capture_that_it_writes_is_looked_at_again(recording, monkeypatch):
    """One chirp keeps a mover, whose range is then found without Doppler."""
    assert call(monkeypatch, "look", "adc.toml", "--chirp", "3") == 0
    capture = Capture.load("out/adc/capture.nc")
    assert torch.equal(capture.beat, mover().samples[:, 3])
    assert capture.dataset["beat"].attrs["units"] == "count"
    assert call(monkeypatch, "look", "out/adc/capture.nc", "-o", "again") == 0
    found = read_metrics(recording / "again")
    assert found["peak_range_m"] == pytest.approx(3.0, abs=0.06)
    assert found["peak_counts_db"] > 20  # over one count, not over what was sent
    assert "peak_power_db" not in found
    assert "mover_range_m" not in found


def test_results_are_kept_unless_overwritten(recording, monkeypatch, capfd):
    assert call(monkeypatch, "look", "adc.toml", "-o", "seen") == 0
    before = (recording / "seen" / "look.png").read_bytes()
    assert call(monkeypatch, "look", "adc.toml", "-o", "seen") == 2
    assert "--overwrite" in capfd.readouterr().err
    assert call(monkeypatch, "look", "adc.toml", "-o", "seen", "--overwrite") == 0
    assert (recording / "seen" / "look.png").read_bytes() == before


@pytest.mark.parametrize("method", ["capon", "music"])
def test_finer_directions_and_points(recording, monkeypatch, method):
    """Beside Bartlett's; the mover is the strongest point of the CFAR."""
    arguments = ["look", "adc.toml", "--range-min", "2", "--range-max", "4"]
    assert call(monkeypatch, *arguments, "--method", method) == 0
    plain = recording / "out" / "adc" / "look.png"
    assert call(monkeypatch, *arguments, "-o", "plain") == 0
    assert len(plain.read_bytes()) > len((recording / "plain" / "look.png").read_bytes())
    head, first, *_ = (recording / "plain" / "points.csv").read_text().splitlines()
    point = dict(zip(head.split(","), map(float, first.split(",")), strict=True))
    assert point["range_m"] == pytest.approx(3.0, abs=0.03)
    assert point["velocity_m_s"] == pytest.approx(RATE, abs=0.05 * velocity_span(RADAR, CHIRPS))
    assert point["u"] == pytest.approx(0.3, abs=0.03)
    assert point["y_m"] == pytest.approx(0.9, abs=0.1)
    assert read_metrics(recording / "plain")["points"] >= 1


def test_sharp_maps_peak_at_the_mover():
    beat, grid = mover().samples, RADAR.grid(2.8, 3.2)
    snapshots = doppler_snapshots(beat, RADAR, grid, CHIRPS, 0)
    for method, sources in (("capon", None), ("music", None), ("music", 1)):
        power = high_resolution_map(snapshots, RADAR, grid, method, sources)
        _, u, v = np.unravel_index(int(power.argmax()), power.shape)
        assert grid.u[int(u)] == pytest.approx(0.3, abs=0.07)
        assert abs(grid.v[int(v)]) < 0.3


def test_real_samples_serve_half_the_range(recording, monkeypatch, capfd):
    settings = replace(SETTINGS, real=True)
    write_samples("real.bin", mover(settings))
    write_cfg("real.cfg", settings)
    arguments = ["look", "real.bin", "-c", "real.cfg", *BOARD]
    assert call(monkeypatch, *arguments, "-o", "seen") == 0
    found = read_metrics(recording / "seen")
    assert found["max_range_m"] == pytest.approx(SETTINGS.waveform.max_range / 2)
    assert found["mover_range_m"] == pytest.approx(3.0, abs=0.06)
    assert call(monkeypatch, *arguments, "-o", "far", "--range-max", "7") == 2
    assert "--range-max within" in capfd.readouterr().err


def test_channels_are_calibrated_on_a_reflector(recording, monkeypatch):
    """What one recording says of the channels is taken out of another."""
    generator = torch.Generator().manual_seed(1)
    gains = torch.randn(3, 4, dtype=torch.complex128, generator=generator) * 0.3 + 1
    ideal = moving_point(RADAR, CHIRPS, 2.5, 0.0, 0.0)
    data = ChirpData((ideal * gains[..., None]).to(torch.complex64), SETTINGS)
    described_arrays.write_chirps("reflector.toml", data, "reflector.npy", ARRAYS)
    moving = mover().samples * gains[..., None]
    other = ChirpData(moving.to(torch.complex64), SETTINGS)
    described_arrays.write_chirps("other.toml", other, "other.npy", ARRAYS)

    reflector = ["--reflector", "2.5", "0", "0"]
    assert call(monkeypatch, "look", "reflector.toml", *reflector, "-o", "bench") == 0
    found = ChannelCalibration.load("bench/channels.json").gains
    torch.testing.assert_close(found, ChannelCalibration(gains).gains, atol=2e-3, rtol=0)
    spread = 20 * torch.log10(gains.abs().max() / gains.abs().min())
    assert read_metrics(recording / "bench")["channel_spread_db"] == pytest.approx(
        float(spread), abs=0.1
    )
    used = ["--channels", "bench/channels.json", "--chirp", "0"]
    assert call(monkeypatch, "look", "other.toml", *used, "-o", "other") == 0
    beat = Capture.load("other/capture.nc").beat
    scale = (beat / mover().samples[:, 0]).mean()
    torch.testing.assert_close(beat / scale, mover().samples[:, 0], atol=200, rtol=0)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["none.bin"], ["none.bin", "check the path"]),
        (["notes.txt"], ["notes.txt", ".setup.json"]),
        (["adc.bin", *BOARD], ["expected --config, got none; name the .cfg"]),
        (["adc.bin", "-c", "bench.cfg"], ["--board", "preset"]),
        (["adc.bin", "-c", "bench.cfg", "-b", "xWR9999"], ["xWR9999", "IWR6843ISK"]),
        (
            ["adc.bin", "-c", "bench.cfg", "-b", "IWR6843ISK"],
            ["--elevation 1 or -1 for IWR6843ISK"],
        ),
        (["adc.bin", "-c", "bench.cfg", "-b", "xWR1642"], ["TX numbers of xWR1642 from 1 to 2"]),
        (["odd.bin", "-c", "bench.cfg", *BOARD], ["odd number of bytes"]),
        (
            ["adc.bin", "-c", "three.cfg", *BOARD],
            ["what fits: ", "receivers=4", "--set receivers=4"],
        ),
        (["adc.bin", "-c", "long.cfg", *BOARD], ["what fits: samples=64 (", "--set samples=64"]),
        (["adc.bin", "-c", "bench.cfg", *BOARD, "--lanes", "4"], ["2 LVDS lanes", "lanes=4"]),
        (["adc.bin", "-c", "bench.cfg", *BOARD, "--lanes", "3"], ["lanes=3"]),
        (
            ["adc.bin", "-c", "plain.cfg", *BOARD, "--lanes", "3"],
            ["lanes to be one of 2, 4, got 3"],
        ),
        (["adc.bin", "-c", "plain.cfg", *BOARD], ["2 or 4 LVDS lanes", "set lanes"]),
        (["adc.bin", "-c", "bench.cfg", *BOARD, "--set", "samples"], ["NAME=NUMBER", "'samples'"]),
        (["adc.bin", "-c", "bench.cfg", *BOARD, "--set", "x=1"], ["lanes, real,", "'x'"]),
        (["adc.bin", "-c", "bench.cfg", *BOARD, "--set", "receivers=[]"], ["NAME=NUMBER"]),
        (["adc.bin", "-c", "bench.cfg", *BOARD, "--set", "receivers=1.5"], ["receivers"]),
        (["adc.bin", "-c", "bench.cfg", *BOARD, "--set", f"lanes={'9' * 5000}"], ["NAME=NUMBER"]),
        (["adc.bin", "-c", "bench.cfg", *BOARD, "--set", f"lanes={'[' * 5000}"], ["NAME=NUMBER"]),
        (["adc.toml", "--set", "samples=64"], ["--set with a .bin", "adc.toml"]),
        (["adc.toml", "--frame", "2"], ["--frame in [0, 1]"]),
        (["adc.toml", "--chirp", "16"], ["number from 0 to 15"]),
        (["adc.toml", "--range-max", "900"], ["--range-max within"]),
        (["adc.toml", "--channels", "bench.cfg"], ["expected a calibration", "bench.cfg"]),
        (["adc.toml", "--reflector", "90", "0", "0"], ["reflector within"]),
        (["adc.toml", "--method", "music", "--sources", "12"], ["fewer than the 12 elements"]),
        (["."], ["openradar.npz"]),
    ],
)
def test_bad_input_is_one_line_and_code_2(recording, monkeypatch, capfd, arguments, said):
    (recording / "notes.txt").write_text("a note")
    raw = (recording / "adc.bin").read_bytes()
    (recording / "odd.bin").write_bytes(raw[:-1])
    write_cfg("three.cfg", replace(SETTINGS, receivers=(1, 2, 3)))
    write_cfg("long.cfg", replace(SETTINGS, samples=63 + 3, ramp_end_time=40e-6))
    write_cfg("plain.cfg", replace(SETTINGS, lanes=None))
    assert call(monkeypatch, "look", *arguments, "-o", "seen") == 2
    error = capfd.readouterr().err
    assert error.startswith("invertwin: ")
    assert error.count("\n") == 1
    for part in said:
        assert part in error
    assert not (recording / "seen").exists()


@pytest.mark.filterwarnings("always")
def test_what_is_cut_or_saturated_is_warned_of(recording, monkeypatch, capfd):
    write_samples("loud.bin", _saturated())
    raw = np.fromfile("loud.bin", "<i2")
    raw[:-100].tofile("cut.bin")
    assert call(monkeypatch, "look", "cut.bin", "-c", "bench.cfg", *BOARD, "-o", "seen") == 0
    error = capfd.readouterr().err
    assert "cut.bin ends within a frame: 1 whole frames are read" in error
    assert error.count("saturated") == 1
    found = read_metrics(recording / "seen")
    assert found["frames"] == 1
    assert [said.split()[0] for said in found["warnings"]] == ["reading:", "reading:"]


def _saturated() -> ChirpData:
    samples = mover().samples.clone()
    samples[0, 0, 0, 0, :5] = 32767
    return ChirpData(samples, SETTINGS)


def test_a_setting_is_corrected(recording, monkeypatch):
    """As the refusal says to do."""
    write_cfg("long.cfg", replace(SETTINGS, samples=66, ramp_end_time=40e-6))
    arguments = ["look", "adc.bin", "-c", "long.cfg", *BOARD, "--set", "samples=64", "-o", "seen"]
    assert call(monkeypatch, *arguments) == 0
    found = read_metrics(recording / "seen")
    assert found["samples"] == 64
    assert found["mover_range_m"] == pytest.approx(3.0, abs=0.06)
    assert found["warnings"] == []


def test_one_chirp_has_points_of_several_reflectors(recording, monkeypatch):
    """Two at one range and one farther away; range rates are not known."""
    parts = ((3.0, 0.3, 1.0), (3.0, -0.4, 0.7), (4.5, 0.1, 0.5))
    one = Chirps(1, CHIRPS.interval)
    beat = sum(moving_point(RADAR, one, r, 0.0, u, amplitude=a) for r, u, a in parts)
    noise = torch.randn(beat.shape, generator=torch.Generator().manual_seed(1), dtype=beat.dtype)
    Capture.from_beat((beat + 0.1 * noise)[:, 0], RADAR).save("one.nc")
    assert call(monkeypatch, "look", "one.nc", "-o", "seen") == 0
    head, *lines = (recording / "seen" / "points.csv").read_text().splitlines()
    for suffix in ("ply", "pcd"):
        count = f" {len(lines)}\n".encode()
        assert count in (recording / "seen" / f"points.{suffix}").read_bytes()
    rows = [dict(zip(head.split(","), map(float, line.split(",")), strict=True)) for line in lines]
    assert len(rows) == 3
    for row, (distance, u, amplitude) in zip(rows, parts, strict=True):
        assert row["range_m"] == pytest.approx(distance, abs=0.03)
        assert row["u"] == pytest.approx(u, abs=0.03)
        assert row["power_db"] == pytest.approx(20 * np.log10(amplitude), abs=1)
        assert np.isnan(row["velocity_m_s"])
    assert read_metrics(recording / "seen")["warnings"] == []


def test_frames_of_one_ramp_show_what_shakes(recording, monkeypatch):
    """A plate at 3 m that shakes at 37 Hz by 0.2 mm: side lines at ± 37 λ/2 m/s."""
    frames, one = 256, replace(SETTINGS, loops=1, frames=256, frame_period=1e-3)
    times = torch.arange(frames, dtype=torch.float64) * 1e-3
    ranges = 3.0 + 0.2e-3 * torch.sin(2 * np.pi * 37.0 * times)
    beat = torch.cat([moving_point(RADAR, Chirps(1, 1e-6), float(r), 0.0, 0.3) for r in ranges])
    noise = torch.randn(beat.shape, generator=torch.Generator().manual_seed(2), dtype=beat.dtype)
    data = ChirpData((beat[::2] + 0.1 * noise[::2]).to(torch.complex64), one)
    described_arrays.write_chirps("plate.toml", data, "plate.npy", ARRAYS)
    assert call(monkeypatch, "look", "plate.toml", "-o", "seen") == 0
    found = read_metrics(recording / "seen")
    assert (found["frames"], found["chirps"]) == (1, frames)
    assert found["warnings"] == ["reading: 256 frames of one ramp are shown as one train"]
    assert found["moves"] is True
    line = 37.0 * SETTINGS.waveform.wavelength / 2
    assert abs(found["mover_velocity_m_s"]) == pytest.approx(line, rel=0.05)
    assert found["mover_range_m"] == pytest.approx(3.0, abs=0.06)


def test_nothing_moves_in_noise(recording, monkeypatch, capsys):
    still = moving_point(RADAR, CHIRPS, 3.0, 0.0, 0.3)
    noise = torch.randn(still.shape, generator=torch.Generator().manual_seed(2), dtype=still.dtype)
    data = ChirpData((still + 0.3 * noise).to(torch.complex64), SETTINGS)
    described_arrays.write_chirps("still.toml", data, "still.npy", ARRAYS)
    assert call(monkeypatch, "look", "still.toml", "-o", "seen") == 0
    found = read_metrics(recording / "seen")
    assert found["moves"] is False
    assert "mover_range_m" not in found
    assert found["peak_range_m"] == pytest.approx(3.0, abs=0.06)
    assert "moving target, above noise and drift" in capsys.readouterr().out


def test_faults_are_warned_of(recording, monkeypatch, capsys):
    """In the metrics, on the terminal and in the report."""
    data = mover()
    samples = data.samples.real.to(torch.complex64)
    described_arrays.write_chirps("i.toml", ChirpData(samples, SETTINGS), "i.npy", ARRAYS)
    assert call(monkeypatch, "look", "i.toml", "-o", "seen") == 0
    (said,) = read_metrics(recording / "seen")["warnings"]
    assert said.startswith("complex only by type: ")
    assert "complex only by type" in capsys.readouterr().out
    assert "mirror image" in (recording / "seen" / "report.html").read_text()


@pytest.mark.parametrize(
    ("folder", "key", "value", "within"),
    [("openradar", "mover_range_m", 2.93, 0.05), ("rail_sar", "frames", 237, 0)],
)
def test_public_recordings(data_folder, tmp_path, monkeypatch, folder, key, value, within):
    monkeypatch.chdir(tmp_path)
    assert call(monkeypatch, "look", data_folder / folder) == 0
    assert abs(read_metrics(tmp_path / "out" / folder)[key] - value) <= within


def swept(frames: int = 3) -> None:
    """Writes sweeps of a point at 3 m, less 0.2 m a frame, and their description."""
    frequencies = 4e9 + 10e6 * np.arange(101)
    for frame in range(frames):
        response = np.exp(-4j * np.pi * frequencies * (3.0 - 0.2 * frame) / 299_792_458)
        rows = zip(frequencies / 1e9, response.real, response.imag, strict=True)
        lines = [f"{f:.9f} {a:.9e} {b:.9e}" for f, a, b in rows]
        Path(f"at_{frame}.s1p").write_text("\n".join(["# GHz S RI R 50", *lines]))
    places = [[0.2 * frame, 0.0, 0.0] for frame in range(frames)]
    Path("rail.toml").write_text(
        f'frame = 2\n[data]\nfiles = "at_*.s1p"\n[sweep]\n[radar]\npositions = {places}\n'
    )


def test_sweeps_of_an_analyser(tmp_path, monkeypatch):
    """One file as it is, and several with their places; centred on what is far away."""
    monkeypatch.chdir(tmp_path)
    swept()
    assert call(monkeypatch, "look", "at_1.s1p") == 0
    found = read_metrics(tmp_path / "out" / "at_1")
    assert (found["reader"], found["frames"], found["samples"]) == ("sweeps", 1, 101)
    assert found["peak_range_m"] == pytest.approx(2.8, abs=0.04)
    assert found["max_range_m"] == pytest.approx(14.99, abs=0.01)
    assert call(monkeypatch, "look", "rail.toml", "--frame", "2") == 0
    found = read_metrics(tmp_path / "out" / "rail")
    assert (found["frames"], found["channels"]) == (3, 1)
    assert found["peak_range_m"] == pytest.approx(2.6, abs=0.04)
    with Path("rail.toml").open("a") as file:
        file.write("range_center = [103.0, 0.0, 0.0]\n")
    assert call(monkeypatch, "look", "rail.toml", "-o", "far") == 0
    found = read_metrics(tmp_path / "far")
    assert found["peak_range_m"] == pytest.approx(3.0, abs=0.04)  # as the samples say
    assert found["max_range_m"] == pytest.approx(14.99 / 2, abs=0.01)
    assert found["range_origin_m"] == pytest.approx(102.8)
    assert Capture.load("far/capture.nc").radar().origins.tolist() == pytest.approx(
        [103, 102.8, 102.6]
    )


def test_sweeps_that_do_not_fit_are_one_line(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    swept()
    text = Path("at_1.s1p").read_text()
    Path("at_1.s1p").write_text(text.replace("4.010000000", "4.011000000"))
    assert call(monkeypatch, "look", "rail.toml") == 2
    error = capfd.readouterr().err
    assert "at_1.s1p" in error
    assert "Traceback" not in error
