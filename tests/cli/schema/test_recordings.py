"""Boards, waveforms, front ends, chirp trains and raw files of run files, and data made of them."""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from cli.schema.test_build import RADAR, read
from cli.small import RUN, call, read_metrics
from invertwin.capture import Capture, ChannelCalibration, ChirpData
from invertwin.capture.readers import described_arrays
from invertwin.capture.ti import read_cfg, read_recording, read_settings
from invertwin.cli import schema
from invertwin.cli.commands.simulate import make_chirp_settings
from invertwin.cli.run_file import to_toml, validate_run
from invertwin.cli.schema import build, sensors
from invertwin.cli.schema.recordings import build_capture
from invertwin.errors import InputError
from invertwin.radar import FMCW, OFDM, Impulse, SteppedFrequency
from invertwin.radar.boards import board

BOARD = {"name": "xWR1843", "elevation": -1, "transmitters": [1, 3, 2]}
WAVE = RADAR["waveform"]
MEASURED = RUN[: RUN.index("[radar]")] + RUN[RUN.index("[grid]") :]
SIMULATED = 'kind = "simulated"\ndepth = 1\npoints_per_m2 = 2e3\nsnr_db = 20.0\n'
# The plate in front of the wall, seen by a board with two transmitters.
TRAIN = (
    (
        RUN[: RUN.index("[radar]")].replace(
            "position = [1.2, 0.0, 0.0]", "position = [1.2, 0.2, 0]\n"
        )
        + """
[radar]
board = { name = "xWR1642", transmitters = [2, 1], pattern = { kind = "cosine", exponent = 1.0 } }
positions = [[0.0, 0.0, 0.0], [0.0, 0.1, 0.0]]

[radar.waveform]
kind = "fmcw"
start_frequency = 77.25e9
bandwidth = 2e9
duration = 32e-6
samples = 64

[grid]
range_min = 0.8
range_max = 1.8

[chirps]
count = 8
interval = 40e-6

[raw]
frame_period = 0.1
adc_start_time = 4e-6

[data]
kind = "simulated"
points_per_m2 = 300.0
snr_db = 20.0
"""
    )
    .replace("[truth.plate]\nposition = [1.2, 0.02, 0.01]\n", "")
    .replace('task = "reconstruct"', 'task = "simulate"')
)


def radar_of(table):
    run = read(radar=table)
    assert run.radar is not None
    return build.radar(run.radar)


def test_a_board_by_its_name():
    radar = radar_of({"waveform": WAVE, "board": BOARD})
    tx, rx = board("xWR1843").arrays(elevation=-1, transmitters=[1, 3, 2])
    assert torch.equal(radar.transmitters.positions, tx.positions)
    assert torch.equal(radar.receivers.positions, rx.positions)


def test_a_board_of_ones_own():
    table = {
        "tx_places": [[0, 0], [4, 1]],
        "rx_places": [[0, 0], [1, 0], [2, 0], [3, 0]],
        "design_frequency": 77e9,
        "elevation": 1,
        "pattern": {"kind": "cosine", "exponent": 2.0},
    }
    radar = radar_of({"waveform": WAVE, "board": table})
    half = 299792458.0 / 77e9 / 2
    steps = radar.transmitters.positions.diff(dim=0)[0]
    torch.testing.assert_close(steps, torch.tensor([0, 4 * half, half], dtype=torch.float64))
    assert len(radar.virtual_positions) == 8


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"board": BOARD | {"elevation": 2}}, "expected one of -1, 1"),
        ({"board": {"name": "xWR1834", "elevation": 1}}, "did you mean `xWR18.3`"),
        ({"board": {"nam": "xWR1843"}}, "did you mean `name`"),
        ({"board": BOARD, "receivers": RADAR["receivers"]}, "no `receivers` with `board`"),
        ({"transmitters": RADAR["transmitters"]}, "`receivers` without `board`"),
        ({"board": {"name": "xWR1843"}}, r"radar\.board: .*elevation=\+1 or -1"),
        ({"board": BOARD | {"transmitters": [4]}}, r"radar\.board: .*TX numbers"),
    ],
)
def test_boards_that_are_none_are_refused(table, message):
    with pytest.raises(InputError, match=message):
        radar_of({"waveform": WAVE} | table)


@pytest.mark.parametrize(
    ("table", "waveform"),
    [
        (WAVE, FMCW(76e9, 2e9, 5e-5, 64)),
        (
            {"kind": "stepped", "start_frequency": 3e9, "step": 5e6, "samples": 101, "dwell": 1e-4},
            SteppedFrequency(3e9, 5e6, 101, 1e-4),
        ),
        (
            {"kind": "ofdm", "start_frequency": 28e9, "spacing": 120e3, "subcarriers": 792},
            OFDM(28e9, 120e3, 792),
        ),
        ({"kind": "impulse", "center_frequency": 4e9, "bandwidth": 1e9}, Impulse(4e9, 1e9)),
    ],
)
def test_every_waveform_of_the_library(table, waveform):
    assert radar_of(RADAR | {"waveform": table}).waveform == waveform


def test_what_a_run_file_says_is_written_back():
    sections = {
        "radar": {"waveform": WAVE, "board": BOARD},
        "chirps": {"count": 16, "interval": 6e-5},
        "raw": {"lanes": 4, "real": True, "bits": 14},
        "impairments": {
            "phase_noise": {"offsets": [1e5, 1e6], "levels": [-80.0, -95.0]},
            "leakage": {"delay": 1e-10, "level_db": -40.0},
            "adc": {"bits": 12, "full_scale": 0.1},
            "gain_std_db": 1.0,
        },
        "data": {"kind": "dca1000", "file": "/x.bin", "settings": "/x.cfg", "board": BOARD},
    }
    run = read(**sections)
    assert validate_run(tomllib.loads(to_toml(run)), Path("run.toml")) == run


def test_impairments_reach_the_front_end():
    run = read(
        impairments={"phase_noise": {"offsets": [1e6], "levels": [-90]}, "phase_std_deg": 90},
        data={"kind": "simulated", "points_per_m2": 1.0, "noise_figure_db": 12.0},
    )
    assert run.impairments is not None
    assert isinstance(run.data, schema.SimulatedData)
    found = sensors.impairments(run.impairments, run.data)
    assert found.phase_noise is not None
    assert found.phase_noise.levels == (-90.0,)
    assert found.phase_std == pytest.approx(torch.pi / 2)
    assert (found.noise_figure_db, found.adc, found.leakage) == (12.0, None, None)
    with pytest.raises(InputError, match=r"impairments\.phase_noise: expected 1 levels"):
        read(impairments={"phase_noise": {"offsets": [1e6], "levels": [-90, -95]}})


@pytest.mark.slow
def test_impairments_are_in_simulated_data(run_file, monkeypatch):
    """Channel errors alone: every channel keeps its signal but for one factor."""
    text = RUN.replace("snr_db = 20.0\n", "")
    text = text.replace("count = [6, 4]", "count = [3, 1]")
    errors = "[impairments]\ngain_std_db = 2.0\nphase_std_deg = 40.0\n"
    beats = []
    for name, part in (("plain", ""), ("impaired", errors)):
        run_file.write_text(text + part)
        assert call(monkeypatch, "simulate", run_file, "-o", name) == 0
        beats.append(Capture.load(f"{name}/capture.nc").beat)
    factors = beats[1] / beats[0]
    assert torch.allclose(factors, factors[:1, :, :, :1].expand_as(factors), rtol=1e-6)
    assert factors[0, 0, :, 0].abs().std() > 0.05


@pytest.fixture(scope="module")
def train(tmp_path_factory):
    """What `simulate` writes of a chirp train with raw files."""
    folder = tmp_path_factory.mktemp("train")
    (folder / "train.toml").write_text(TRAIN)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert call(patch, "simulate", "train.toml") == 0
    return folder / "out" / "train"


def test_a_train_is_written_as_arrays_and_as_raw_files(train):
    names = {str(path.relative_to(train)) for path in train.rglob("*")}
    raw = {f"raw/capture.{end}" for end in ("bin", "cfg", "mmwave.json", "setup.json")}
    assert names >= raw | {"chirps.npy", "chirps.toml", "doppler.png", "report.html"}
    exact = described_arrays.read_chirps(train / "chirps.toml")
    counts = read_recording(train / "raw" / "capture.setup.json")
    assert exact.samples.shape == counts.samples.shape == (2, 8, 2, 4, 64)
    full_scale = read_metrics(train)["raw_full_scale"]
    scaled = counts.samples * full_scale / 32767
    torch.testing.assert_close(
        scaled.to(torch.complex128), exact.samples, atol=full_scale / 32767, rtol=0
    )
    assert exact.settings.transmit_order == counts.settings.transmit_order == (2, 1)
    cfg = read_cfg(train / "raw" / "capture.cfg")
    assert cfg == read_settings(train / "raw" / "capture.mmwave.json")
    assert replace(counts.settings, frames=2) == cfg
    first = (train / "raw" / "capture.cfg").read_text().splitlines()[0]
    assert first == "% Platform:xWR16xx"
    assert cfg.chirps.interval == pytest.approx(40e-6)
    assert cfg.frame_period == 0.1
    assert (cfg.start_frequency, cfg.adc_start_time) == (77e9, 4e-6)
    assert cfg.idle_time == pytest.approx(4e-6)
    assert cfg.waveform == FMCW(77.25e9, 2e9, 32e-6, 64)


@pytest.mark.slow
def test_trains_are_impaired(train, tmp_path, monkeypatch):
    """Channel errors alone: every channel keeps its signal but for one factor."""
    monkeypatch.chdir(tmp_path)
    silent = TRAIN.replace("snr_db = 20.0\n", "")
    errors = "[impairments]\ngain_std_db = 2.0\nphase_std_deg = 40.0\n"
    beats = []
    for name, part in (("plain", ""), ("impaired", errors)):
        Path(f"{name}.toml").write_text(silent + part)
        assert call(monkeypatch, "simulate", f"{name}.toml") == 0
        beats.append(described_arrays.read_chirps(f"out/{name}/chirps.toml").samples)
    factors = beats[1] / beats[0]
    assert torch.allclose(factors, factors[:1, :1, ..., :1].expand_as(factors), rtol=1e-6)
    assert factors[0, 0, :, :, 0].abs().std() > 0.05


def test_raw_files_show_what_was_simulated(train, monkeypatch):
    monkeypatch.chdir(train)
    given = ["--board", "xWR1642", "--range-min", "0.8", "--range-max", "1.8"]
    assert call(monkeypatch, "look", "raw/capture.setup.json", *given) == 0
    seen, simulated = read_metrics(train / "out" / "capture"), read_metrics(train)
    for key in ("peak_range_m", "peak_azimuth_deg", "peak_velocity_m_s", "velocity_span_m_s"):
        assert seen[key] == pytest.approx(simulated[key], abs=1e-6)


@pytest.mark.slow
def test_raw_files_are_data_of_a_fit(train, run_file, monkeypatch):
    monkeypatch.chdir(train)
    table = f'kind = "dca1000"\nfile = "{train}/raw/capture.bin"\n'
    table += f'settings = "{train}/raw/capture.cfg"\nboard = {{ name = "xWR1642" }}\n'
    table += "positions = [[0.0, 0.0, 0.0], [0.0, 0.1, 0.0]]\n"
    run_file.write_text(MEASURED.replace(SIMULATED, table).replace("steps = 8", "steps = 2"))
    assert call(monkeypatch, "reconstruct", run_file, "-o", "fit") == 0
    assert read_metrics(Path("fit"))["loss"] < 1


def data_table(**changes):
    data = read(data=changes).data
    assert data is not None
    return data


def test_recordings_get_poses_and_calibrated_channels(train, tmp_path):
    table = {"kind": "arrays", "file": str(train / "chirps.toml")}
    plain = build_capture(data_table(**table))
    chirps = described_arrays.read_chirps(train / "chirps.toml")
    assert torch.equal(plain.beat, chirps.samples.mean(1))
    gains = torch.polar(torch.ones(2, 4), torch.arange(8.0).reshape(2, 4)).to(torch.complex128)
    ChannelCalibration(gains).save(tmp_path / "channels.json")
    changes = {
        "channels": str(tmp_path / "channels.json"),
        "chirp": 2,
        "positions": [[-1, 0, 0]],
        "orientation": {"rotation_deg": [0, 0, 90]},
    }
    second = build_capture(data_table(**table, frame=1))
    assert torch.equal(second.beat, plain.beat[1:])
    placed = build_capture(data_table(**table, **changes))
    expected = chirps.samples[:, 2] / ChannelCalibration(gains).gains[..., None]
    torch.testing.assert_close(placed.beat, expected)
    assert placed.radar().positions.tolist() == [[-1, 0, 0], [-1, 0, 0]]
    assert placed.radar().range_origin is None
    far = build_capture(data_table(**table, **changes, range_center=[3.0, 0.0, 3.0]))
    assert far.radar().origins.tolist() == pytest.approx([5.0, 5.0], abs=0.01)  # of a wide board
    rotations = placed.radar().rotations
    assert rotations is not None
    assert rotations[1, :, 0].tolist() == pytest.approx([0, 1, 0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"file": "none.toml"}, r"data\.file: .*none\.toml"),
        ({"positions": [[0, 0, 0]] * 3}, "data: expected .* along frame"),
        ({"chirp": 8}, "data: .*number from 0 to 7"),
        ({"frame": 2}, r"data\.frame: expected a number below 2, got 2"),
        ({"channels": "none.json"}, r"data\.channels: .*none\.json"),
        ({"board": {"name": "xWR1642", "transmitters": [1]}}, r"data\.board: .*remove the key"),
        ({"orientation": {"look_at": [0, 0, 1]}}, r"data\.orientation\.look_at: "),
    ],
)
def test_recordings_that_do_not_fit_are_refused(train, changes, message):
    table = {"kind": "arrays", "file": str(train / "chirps.toml")} | changes
    with pytest.raises(InputError, match=message):
        build_capture(data_table(**table))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("interval = 40e-6", "interval = 40e-6\ntdm = false", "raw: expected transmitters that"),
        ("interval = 40e-6", "interval = 20e-6", "chirps.interval: expected at least the ramp's"),
        (
            "interval = 40e-6",
            "interval = 40e-6\nretrace = true\n"
            "[impairments]\nphase_noise = { offsets = [1e6], levels = [-90.0] }",
            "chirps: expected",
        ),
        ("[raw]", "[raw]\nfull_scale = -1.0", "raw.full_scale"),
        (
            'kind = "fmcw"\nstart_frequency = 77.25e9\nbandwidth = 2e9\nduration = 32e-6',
            'kind = "stepped"\nstart_frequency = 77e9\nstep = 30e6\ndwell = 1e-6',
            'raw: expected radar.waveform.kind = "fmcw"',
        ),
    ],
)
def test_trains_that_cannot_be_are_refused(run_file, monkeypatch, capfd, old, new, said):
    assert old in TRAIN
    run_file.write_text(TRAIN.replace(old, new))
    assert call(monkeypatch, "simulate", run_file) == 2
    error = capfd.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def test_samples_are_kept_as_they_are(tmp_path):
    """Elements beside samples: a description that needs no board."""
    table = {"waveform": WAVE, "board": BOARD | {"elevation": 1}}
    radar = radar_of(table)
    run = read(radar=table, chirps={"count": 2, "interval": 6e-5})
    beat = torch.randn(1, 2, 3, 4, 64, dtype=torch.complex128, generator=torch.Generator())
    data = ChirpData(beat, replace(make_chirp_settings(run, radar), real=False))
    assert isinstance(data, ChirpData)
    arrays = (radar.transmitters, radar.receivers)
    described_arrays.write_chirps(tmp_path / "a.toml", data, "a.npy", arrays)
    described = described_arrays.load_described_board(tmp_path / "a.toml")
    assert isinstance(described, tuple)
    tx, rx = described
    assert torch.equal(tx.positions, radar.transmitters.positions)
    assert torch.equal(rx.positions, radar.receivers.positions)
    assert torch.equal(described_arrays.read_chirps(tmp_path / "a.toml").samples, beat)


# A plate 100 m away, of which the data are centred on its first place.
FAR = """
task = "reconstruct"
frame = 2

[scene.plate]
shape = "plate"
width = 1.0
height = 0.8
divisions = 3
position = [99.4, 0.0, 0.0]
material = { kind = "rough_dielectric", permittivity = 4.0 }

[truth.plate]
position = [100.1, 0.0, 0.0]

[grid]
range_min = -8.0
range_max = 8.0

[[parameters]]
kind = "translation"
object = "plate"
axes = ["x"]

[surrogate]
range_width = 2.0

[reconstruct]
steps = 40
samples = 3000
"""
FAR_RADAR = """
[radar]
waveform = { kind = "stepped", start_frequency = 9.7e9, step = 3e6, samples = 100, dwell = 1e-6 }
transmitters = { kind = "linear", count = 1, spacing = 1.0 }
receivers = { kind = "linear", count = 1, spacing = 1.0 }
positions = [[0.0, -3.0, 0.0], [0.0, 0.0, 0.0], [1.0, 3.0, 0.0]]
range_center = [100.0, 0.0, 0.0]
"""


def test_a_far_scene_is_fitted_by_sweeps_that_are_centred_on_it(tmp_path, monkeypatch):
    """Unambiguous over 50 m, 100 m away: simulated, written as arrays, read and fitted."""
    monkeypatch.chdir(tmp_path)
    simulated = '[data]\nkind = "simulated"\ndepth = 1\npoints_per_m2 = 2e3\nsnr_db = 20.0\n'
    text = FAR.replace('task = "reconstruct"', 'task = "simulate"')
    text = text[: text.index("[[parameters]]")]
    Path("far.toml").write_text(text + FAR_RADAR + simulated)
    assert call(monkeypatch, "simulate", "far.toml", "-o", "seen") == 0
    capture = Capture.load(next(Path("seen").glob("*.nc")))
    radar = capture.radar()
    assert radar.origins[1] == pytest.approx(100.0)
    np.savez(
        "pass.npz",
        fp=capture.beat[:, 0, 0].numpy().conj(),
        places=radar.positions.numpy(),
        r0=radar.origins.numpy(),
    )
    Path("pass.toml").write_text(
        'frame = 2\n[data]\nfile = "pass.npz"\nvariable = "fp"\ndimensions = ["frame", "sample"]\n'
        "conjugate = true\n[sweep]\nstart_frequency = 9.7e9\nstep = 3e6\n"
        '[radar]\npositions = "places"\nrange_origin = "r0"\n'
    )
    Path("fit.toml").write_text(FAR + '[data]\nkind = "sweeps"\nfile = "pass.toml"\n')
    assert call(monkeypatch, "check", "fit.toml") == 0
    assert call(monkeypatch, "reconstruct", "fit.toml", "-o", "fitted") == 0
    found = read_metrics(tmp_path / "fitted")
    assert found["position_error_m"] < 0.1  # from 0.7 m; a cell is 0.5 m
    assert found["verdict"] == "consistent"


def test_the_path_of_the_radar_is_refined_along(tmp_path, monkeypatch):
    """Beside the plate, with an error bar of its own, and held by a heavy odometry."""
    monkeypatch.chdir(tmp_path)
    path = '[[parameters]]\nkind = "radar_path"\nsteps = 1\ndrift = 0.02\naxes = ["x"]\n'
    short = RUN.replace("steps = 8\n", "steps = 4\n").replace("samples = 20_000", "samples = 4_000")
    for name, more in (("free", ""), ("held", "weight = 1e3\n")):
        Path(f"{name}.toml").write_text(short + path + more)
        assert call(monkeypatch, "reconstruct", f"{name}.toml", "-o", name) == 0
    free, held = (read_metrics(tmp_path / name) for name in ("free", "held"))
    assert free["standard_deviations"]["radar.step1.x"] > 0
    moved = [row["parameters"]["radar.displacements"] for row in (free, held)]
    assert abs(moved[1][0][0]) < abs(moved[0][0][0])
    assert moved[0][0][1:] == [0.0, 0.0]
