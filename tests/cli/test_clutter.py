"""Fits of run files beside things that the scene lacks."""

import pytest

from cli.small import call, read_metrics

RUN = """
task = "reconstruct"
frame = 2
seed = 5

[scene.letter]
shape = "text"
text = "L"
size = 0.6
depth = 0.12
position = [2.16, -0.05, 0.0]
rotation_deg = [0.0, 0.0, 17.0]
material = { kind = "rough_dielectric", permittivity = 4.0 }

[scene.wall]
shape = "plate"
width = 3.6
height = 1.6
position = [3.9, 0.0, 0.0]
material = { kind = "rough_dielectric", permittivity = 4.0 }

# Behind the radar and the map, as far as the model knows.
[scene.stranger]
shape = "box"
size = [0.25, 0.25, 0.4]
position = [-4.95, 0.0, 0.0]
material = { kind = "rough_dielectric", permittivity = 4.0 }

[truth.letter]
position = [2.1, 0.0, 0.0]
rotation_deg = [0.0, 0.0, 11.5]

[truth.stranger]
position = [2.2, 0.65, 0.0]

[radar]
transmitters = { kind = "positions", positions = [[0.0, 0.0, 0.0]] }
receivers = { kind = "linear", count = 8, spacing = 1.9e-3 }
positions = { kind = "line", start = [0.0, -1.1, 0.0], stop = [0.0, 1.1, 0.0], count = 8 }

[radar.waveform]
kind = "fmcw"
start_frequency = 77e9
bandwidth = 3.6e9
duration = 50e-6
samples = 128

[grid]
range_min = 0.8
range_max = 4.6
u_max = 0.75

[data]
kind = "simulated"
depth = 1
points_per_m2 = 4e3
snr_db = 20.0

[[parameters]]
kind = "pose"
object = "letter"
axes = ["x", "y"]
rotation_axes = ["z"]

[loss]
kind = "likelihood"
floor = 0.02

[surrogate]
range_width = 8.0
angle_width = 1.0

[optimizer]
kind = "gauss_newton"
rate = 0.3

[reconstruct]
depth = 1
steps = 10
annealing = 0.6
samples = 30_000
boundary_samples = 6_000
"""


@pytest.mark.slow
def test_a_stranger_counts_as_clutter_where_the_fit_without_is_inconsistent(
    tmp_path, monkeypatch, capsys
):
    (tmp_path / "run.toml").write_text(RUN)
    run = ["reconstruct", str(tmp_path / "run.toml"), "-o", str(tmp_path / "out")]
    assert call(monkeypatch, *run) == 0, capsys.readouterr().err
    found = read_metrics(tmp_path / "out")
    (plain,), (among,) = found["starts"], found["starts_among_clutter"]
    assert plain["position_error_m"] > 0.1
    assert among["position_error_m"] < 0.04
    assert found["position_error_m"] == among["position_error_m"]
    assert found["clutter"]["kept"]
    assert found["clutter"]["strongest_m"][:2] == pytest.approx([2.1, 0.65], abs=0.2)
    assert "echoes that the scene lacks" in capsys.readouterr().out


@pytest.mark.slow
def test_a_darker_object_gets_its_permittivity_before_clutter(tmp_path, monkeypatch, capsys):
    """It would otherwise rotate its faces away from the radar."""
    dark = '[truth.letter]\nmaterial = { kind = "rough_dielectric", permittivity = 1.8 }\n'
    text = RUN.replace("position = [2.2, 0.65, 0.0]", "position = [-4.9, 0.0, 0.0]")
    text = text.replace("steps = 10", "steps = 20")
    (tmp_path / "run.toml").write_text(text.replace("[truth.letter]\n", dark))
    run = ["reconstruct", str(tmp_path / "run.toml"), "-o", str(tmp_path / "out")]
    assert call(monkeypatch, *run) == 0, capsys.readouterr().err
    found = read_metrics(tmp_path / "out")
    (plain,), (bright,) = found["starts"], found["starts_with_permittivities"]
    assert found["verdict"] == "consistent"
    assert found["position_error_m"] == bright["position_error_m"] < plain["position_error_m"]
    deviation = found["standard_deviations"]["letter.permittivity"]
    assert abs(bright["values"]["letter.permittivity"] - 1.8) < 3 * deviation < 1.5
    assert "starts_among_clutter" not in found


@pytest.mark.slow
def test_without_clutter_on_request(tmp_path, monkeypatch, capsys):
    (tmp_path / "run.toml").write_text(RUN + 'clutter = "never"\n')
    run = ["reconstruct", str(tmp_path / "run.toml"), "-o", str(tmp_path / "out")]
    assert call(monkeypatch, *run) == 0, capsys.readouterr().err
    found = read_metrics(tmp_path / "out")
    assert found["position_error_m"] > 0.1
    assert "clutter" not in found


@pytest.mark.slow
def test_a_run_interrupted_while_it_writes_goes_on(tmp_path, monkeypatch, capsys):
    short = RUN.replace("steps = 10", "steps = 2").replace("samples = 30_000", "samples = 3000")
    (tmp_path / "run.toml").write_text(short + 'clutter = "always"\n')
    run = ["reconstruct", str(tmp_path / "run.toml"), "-o", str(tmp_path / "out")]

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("invertwin.cli.commands.reconstruct.write_report", interrupt)
        assert call(patch, *run) != 0
    capsys.readouterr()
    # The copy of the best fit's checkpoint is of another fit than the first one.
    assert call(monkeypatch, *run, "--resume") == 0, capsys.readouterr().err
    assert read_metrics(tmp_path / "out")["clutter"]["kept"]
