"""A package of its own adds kinds, a section and a command; here it is installed and used."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from invertwin.capture import Capture

pytestmark = pytest.mark.docs

PLUGIN = Path(__file__).with_name("example_plugin")
SCENE = """
[scene.hedge]
shape = "bush"
radius = 0.15
lean_deg = 10.0
position = [1.2, 0.0, 0.0]
material = { kind = "foliage", share = 0.2 }
"""
RUN = f"""
task = "reconstruct"
frame = 2
survey = {{ count = 12, area = 4.0 }}
{SCENE}
[truth.hedge]
material = {{ kind = "foliage", share = 0.9 }}

[radar]
waveform = {{ kind = "falling_ramp", start_frequency = 76e9, bandwidth = 2e9, duration = 5e-5, \
samples = 64 }}
transmitters = {{ kind = "positions", positions = [[0.0, 0.0, 0.0]] }}
receivers = {{ kind = "planar", count = [4, 4], spacing = [1.9e-3, 1.9e-3] }}

[grid]
range_min = 0.6
range_max = 1.8

[data]
kind = "simulated"
points_per_m2 = 1e3

[[parameters]]
kind = "thickness"
object = "hedge"

[loss]
kind = "log"
floor = 0.1

[reconstruct]
depth = 1
steps = 2
samples = 5000
boundary_samples = 1000
"""
MEASURED = f"""
task = "reconstruct"
frame = 2
{SCENE}
[data]
kind = "npy"
file = "samples.npy"
bandwidth = 2e9

[grid]
range_min = 0.6
range_max = 1.8

[[parameters]]
kind = "thickness"
object = "hedge"

[reconstruct]
depth = 1
steps = 2
samples = 5000
boundary_samples = 1000
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """The plugin, installed as pip installs it, without network and apart from this environment."""
    folder = tmp_path_factory.mktemp("site")
    options = ("--quiet", "--no-deps", "--no-build-isolation", "--no-index")
    copy = tmp_path_factory.mktemp("source") / "plugin"  # the build leaves files in the source
    subprocess.run(["cp", "-r", str(PLUGIN), str(copy)], check=True)
    line = [sys.executable, "-m", "pip", "install", *options, "--target", str(folder), str(copy)]
    subprocess.run(line, check=True, capture_output=True)
    return folder


@pytest.fixture
def call(installed, tmp_path):
    """The command line with the plugin beside it."""

    def call(*arguments: str, code: int = 0) -> str:
        here = [str(installed), str(Path(__file__).parents[2] / "src")]
        known = {**os.environ, "PYTHONPATH": os.pathsep.join(here)}
        start = "from invertwin.cli.app import main; main()"
        line = [sys.executable, "-c", start, *arguments]
        done = subprocess.run(line, cwd=tmp_path, env=known, capture_output=True, text=True)
        assert done.returncode == code, done.stderr
        return done.stderr if code else done.stdout

    return call


@pytest.mark.slow
def test_a_run_file_with_kinds_of_a_plugin_is_simulated_and_fitted(call, tmp_path):
    (tmp_path / "run.toml").write_text(RUN)
    assert "3 plants per m²" in call("plants", "run.toml")
    call("reconstruct", "run.toml")
    metrics = json.loads((tmp_path / "out" / "run" / "metrics.json").read_text())
    assert 0.2 < metrics["parameters"]["hedge.share"] < 0.9
    call("reconstruct", "out/run/run.toml", "-o", "again")
    again = json.loads((tmp_path / "again" / "metrics.json").read_text())
    assert again["parameters"] == metrics["parameters"]


@pytest.mark.slow
def test_a_reader_of_a_plugin_is_data(call, tmp_path):
    text = RUN.replace("count = [4, 4]", "count = [1, 1]").replace("falling_ramp", "fmcw")
    (tmp_path / "run.toml").write_text(text)
    call("simulate", "run.toml")
    beat = Capture.load(tmp_path / "out" / "run" / "capture.nc").beat
    np.save(tmp_path / "samples.npy", beat[:, 0, 0].numpy())
    (tmp_path / "measured.toml").write_text(MEASURED)
    call("reconstruct", "measured.toml")
    metrics = json.loads((tmp_path / "out" / "measured" / "metrics.json").read_text())
    assert set(metrics["parameters"]) == {"hedge.share"}


@pytest.mark.slow
def test_a_capture_keeps_the_waveform_of_a_plugin(call, tmp_path):
    (tmp_path / "run.toml").write_text(RUN)
    call("simulate", "run.toml")
    data = 'kind = "npy"\nfile = "samples.npy"\nbandwidth = 2e9\n'
    assert data in MEASURED
    saved = 'kind = "capture"\nfile = "out/run/capture.nc"\n'
    (tmp_path / "measured.toml").write_text(MEASURED.replace(data, saved))
    call("reconstruct", "measured.toml")
    metrics = json.loads((tmp_path / "out" / "measured" / "metrics.json").read_text())
    assert metrics["steps"] == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('kind = "foliage", share = 0.2', 'kind = "folage"', "did you mean `foliage`?"),
        (
            "share = 0.2",
            "share = 1.2",
            "material.share: expected less than or equal to 1, got 1.2",
        ),
        ("share = 0.2", "shar = 0.2", "scene.hedge.material.shar: expected one of the keys kind"),
        ("lean_deg", "lean", "scene.hedge.lean: expected one of the keys"),
        ("survey =", "surwey =", "surwey: expected one of the keys"),
        ("count = 12", "count = 1.5", "survey.count: expected an integer, got 1.5"),
        ("floor = 0.1", "floor = 0.0", "loss.floor: expected greater than 0, got 0.0"),
    ],
)
def test_errors_know_what_a_plugin_adds(call, tmp_path, old, new, said):
    assert old in RUN
    (tmp_path / "run.toml").write_text(RUN.replace(old, new, 1))
    error = call("reconstruct", "run.toml", code=2)
    assert said in error
    assert error.count("\n") == 1


@pytest.mark.slow
def test_keys_and_schema_list_what_a_plugin_adds(call):
    assert "lean_deg" in call("keys", "scene")
    assert "m², that they stand on" in call("keys", "survey")
    schema = json.loads(call("keys", "--json-schema"))
    assert "survey" in schema["properties"]
    kinds = [
        found["properties"].get("kind", {}).get("const")
        for found in schema["$defs"].values()
        if "properties" in found
    ]
    assert {"foliage", "thickness", "falling_ramp", "npy", "log"} <= set(kinds)
