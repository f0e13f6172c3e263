"""`invertwin reconstruct` of received levels, in small."""

import gzip
import os
import re
import tomllib

import pytest
import torch

from cli.small import ROOM, call, read_metrics
from invertwin.cli.fits.received_levels import spread_of_ends
from invertwin.cli.fits.scores import error_bar_table
from invertwin.cli.run_file import to_toml, validate_run
from invertwin.cli.schema import build
from invertwin.cli.schema.radio_tables import points_file
from invertwin.errors import InputError
from invertwin.inversion import SpectrumLoss
from invertwin.links import ReceiverPoints

RUN = (
    ROOM
    + """
[scene.pillar]
shape = "box"
size = [0.4, 0.4, 2.0]
material = { kind = "perfect_conductor" }

[transmitter]
positions = [[1.0, 0.8, 0.2]]
power_dbm = 10.0

[map]
places = { kind = "random", low = [-2.3, -1.8, -1.2], high = [2.3, 1.8, 1.2], count = 20 }
frequency = 2.4e9
depth = 1
scatter = 0.5

[data]
kind = "received"
positions = [[1.5, -0.9, 0.3]]
noise = 0.5
depth = 2
rays = 200_000
seed = 9

[[parameters]]
kind = "transmitter"
low = [-2.4, -1.9, -1.4]
high = [2.4, 1.9, 1.4]

[optimizer]
kind = "gauss_newton"
rate = 0.5

[reconstruct]
steps = 6
position_limit = 0.5

[variants.bare]
map = { without = ["pillar"] }
"""
)
STARTS = """
[transmitter_starts]
low = [-2.2, -1.7, -1.0]
high = [2.2, 1.7, 1.0]
count = 2
"""


def file_of(folder, text):
    file = folder / "small.toml"
    file.write_text(text, encoding="utf-8")
    return file


def loaded(folder, text):
    return validate_run(tomllib.loads(text), folder / "small.toml")


def test_a_transmitter_is_located(tmp_path, monkeypatch):
    file, out = file_of(tmp_path, RUN + STARTS), tmp_path / "found"
    assert call(monkeypatch, "reconstruct", file, "--out", out) == 0
    found = read_metrics(out)
    assert found["starts_count"] == 2
    assert len(found["errors_m"]) == len(found["errors_m_bare"]) == 2
    assert found["successes"] == sum(error <= 0.5 for error in found["errors_m"])
    assert found["position_error_m"] < 0.5
    assert found["position_error_m"] == min(found["errors_m"])
    assert set(found["standard_deviations"]) == {f"transmitter.{axis}" for axis in "xyz"}
    assert found["verdict"] in ("consistent", "inconsistent", "ambiguous")
    assert 0 < found["blocked_share"] < 1
    for name in ("report.html", "loss.png", "plan.png", "metrics.json"):
        assert (out / name).stat().st_size > 0


def test_levels_of_a_file(tmp_path, monkeypatch):
    run = loaded(tmp_path, RUN)
    model, scene = run.map.build(), build.scene(run)
    sensor = run.transmitter.build()
    assert isinstance(model.places, ReceiverPoints)
    level = model.predict(scene, sensor, 0)
    rows = torch.cat([model.places.positions, level.T], 1)
    lines = ["x,y,z,dBm", *(",".join(str(x) for x in row) for row in rows.tolist())]
    (tmp_path / "powers.csv").write_text("\n".join(lines))
    start = RUN.index("[data]"), RUN.index("[[parameters]]")
    data = '[data]\nkind = "received_file"\nfile = "powers.csv"\n\n'
    text = RUN[: start[0]] + data + RUN[start[1] : RUN.index("[variants")]
    text = text.replace("positions = [[1.0, 0.8, 0.2]]", "positions = [[1.1, 0.7, 0.25]]")
    out = tmp_path / "found"
    assert call(monkeypatch, "reconstruct", file_of(tmp_path, text), "--out", out) == 0
    found = read_metrics(out)
    assert "errors_m" not in found
    place = found["parameters"]["transmitter.position"]
    assert place == pytest.approx([1.0, 0.8, 0.2], abs=0.02)


def test_the_tail_of_a_room_is_found(tmp_path, monkeypatch):
    tail = "reverberation = { gain_db = -48.0, decay = 15e-9 }"
    own = '[[parameters]]\nkind = "reverberation"\ngain_db = -58.0\ndecay = 30e-9\n\n'
    begin, end = RUN.index("[[parameters]]"), RUN.index("[optimizer]")
    text = RUN[:begin] + own + RUN[end : RUN.index("[variants")]
    text = text.replace("[map]\n", f"{tail}\n\n[map]\n").replace("noise = 0.5", "noise = 0.1")
    text = text.replace("scatter = 0.5", "scatter = 0.1")
    text = text.replace("positions = [[1.5, -0.9, 0.3]]\n", "").replace("depth = 2\nrays", "rays")
    out = tmp_path / "found"
    assert call(monkeypatch, "reconstruct", file_of(tmp_path, text), "--out", out) == 0
    found = read_metrics(out)
    values, bars = found["parameters"], found["standard_deviations"]
    assert abs(values["reverberation.gain"] + 48.0) < 4 * bars["reverberation.gain"]
    assert abs(values["reverberation.decay"] - 15e-9) < 4 * bars["reverberation.decay"]
    assert 0 < bars["reverberation.decay"] < 5e-9


def test_a_run_file_as_used_compares_levels_as_the_first_one_did(tmp_path):
    run = loaded(tmp_path, RUN)
    again = loaded(tmp_path, to_toml(run))
    assert (
        build.build_loss(again)
        == build.build_loss(run)
        == SpectrumLoss("mse", levels=1, gain="one")
    )


def test_check_says_how_long_a_fit_takes(tmp_path, monkeypatch, capsys):
    shown = call(monkeypatch, "check", file_of(tmp_path, RUN + STARTS))
    said = capsys.readouterr().out
    assert shown == 0
    assert re.search(r"about .+ for \d+ steps", said)
    assert "transmitter_starts.count" in said


def test_a_map_may_hold_scattered_power(tmp_path):
    text = RUN.replace(
        "depth = 1\nscatter", "depth = 1\nrough = { depth = 1, samples = 5000 }\nscatter"
    )
    rough = loaded(tmp_path, text).map.build().propagation.rough
    assert (rough.depth, rough.samples) == (1, 5000)
    assert loaded(tmp_path, RUN).map.build().propagation.rough is None


def test_starts_are_in_free_space(tmp_path):
    wide = STARTS.replace("count = 2", "count = 200\nclear = 0.2")
    run = loaded(tmp_path, RUN + wide)
    places = run.transmitter_starts.sample_positions(build.scene(run), 0)
    assert places.shape == (200, 3)
    off = places.abs() - torch.tensor([0.2, 0.2, 1.0])
    assert float(off.amax(1).min()) > 0.1  # outside the pillar
    narrow = wide.replace("[-2.2, -1.7, -1.0]", "[-0.1, -0.1, -0.1]")
    narrow = narrow.replace("[2.2, 1.7, 1.0]", "[0.1, 0.1, 0.1]")
    run, scene = loaded(tmp_path, RUN + narrow), build.scene(run)
    with pytest.raises(InputError, match="expected room for 200 starts in the box"):
        run.transmitter_starts.sample_positions(scene, 0)


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ("[data]", "[radar]\nboard = { name = 'IWR1443' }\n[data]", "radar"),
        ('kind = "received"', 'kind = "capture"\nfile = "x.nc"', "data"),
        ("[[1.5, -0.9, 0.3]]", "[[1.5, -0.9, 0.3], [0.0, 0.0, 0.0]]", "data.positions"),
        ('"pillar"]', '"pilar"]', "without"),
        ("frequency = 2.4e9", "frequency = 2.4e9\nedges = 1", "map"),
    ],
)
def test_what_does_not_fit_is_told(tmp_path, monkeypatch, capsys, before, after, said):
    assert before in RUN
    file = file_of(tmp_path, RUN.replace(before, after, 1))
    assert call(monkeypatch, "reconstruct", file, "--out", tmp_path / "found") == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert said in lines[-1]
    assert len(lines) == 1


def test_antennas_are_turned(tmp_path):
    antenna = (
        "\npattern = { kind = 'cosine', exponent = 2.0 }\norientation = { look_at = [0, 0, 0] }"
    )
    antenna = antenna.replace("[0, 0, 0]", "[0.0, 0.0, 0.0]")
    text = RUN.replace("power_dbm = 10.0", "power_dbm = 10.0" + antenna)
    sensor = loaded(tmp_path, text).transmitter.build()
    ahead = -sensor.positions[0] / sensor.positions[0].norm()
    torch.testing.assert_close(sensor.mount.rotations[0, :, 0], ahead)
    assert sensor.powers.tolist() == [10.0]


@pytest.mark.parametrize(
    ("ends", "near", "inside"),
    [
        ([[1.0, 0.8, 0.2], [1.001, 0.8, 0.2], [0.999, 0.8, 0.2], [-1.0, 0.8, 0.2]], 2, 2),
        ([[1.0, 0.8, 0.2], [1.1, 0.8, 0.2], [0.9, 0.8, 0.2]], 2, 0),
        ([[1.0, 0.8, 0.2], [1.1, 0.8, 0.2]], None, None),
    ],
    ids=["reproduced", "scattered", "too few"],
)
def test_ends_that_scatter_beyond_the_bars_are_told(tmp_path, ends, near, inside):
    run = loaded(tmp_path, RUN + STARTS)
    rows = [
        {"start": k, "status": "budget", "values": {"transmitter.position": end}}
        for k, end in enumerate(ends)
    ]
    bars = {f"transmitter.{axis}": 0.005 for axis in "xyz"}
    found = spread_of_ends(run, rows, rows[0], bars)
    if near is None:
        assert found == {}
        return
    assert (found["ends_near"], found["ends_within_bars"]) == (near, inside)
    expected = 0.001 if inside else 0.1
    assert found["spread_of_ends"]["transmitter.x"] == pytest.approx(expected)
    assert found["spread_of_ends"]["transmitter.z"] == 0.0
    assert ("spread_note" in found) == (inside == 0)
    shown = error_bar_table(
        found | {"standard_deviations": bars, "within_95": bars, "units": dict.fromkeys(bars, "m")}
    )
    assert "spread of other ends" in shown.columns
    assert ("take the spread" in shown.note) == (inside == 0)


@pytest.mark.parametrize(("word", "hold"), [("consistent", True), ("inconsistent", False)])
def test_bars_of_a_fit_that_the_data_speak_against_are_not_stated_as_if_they_held(word, hold):
    bars = {"standard_deviations": {"x": 0.01}, "within_95": {"x": 0.02}, "units": {"x": "m"}}
    note = error_bar_table({**bars, "verdict": word}).note
    assert ("only as valid as the model" in note) != hold
    assert ("near the minimum that was found" in note) == hold


@pytest.mark.filterwarnings("ignore:loadtxt")  # of a file without rows
@pytest.mark.parametrize("attack", ["pipe", "address", "archive", "words", "no rows"])
def test_rows_come_from_a_text_file_only(tmp_path, attack):
    file = tmp_path / "rows.csv"
    match attack:
        case "pipe":
            os.mkfifo(file)
        case "address":
            file = "http://127.0.0.1:9/rows.csv"
        case "archive":  # NumPy would expand it
            file = tmp_path / "rows.csv.gz"
            file.write_bytes(gzip.compress(b"x,y,z\n" + b"0,0,0\n" * 10))
        case _:
            file.write_text("x,y,z\n" + "a,b,c\n" * (attack == "words"))
    said = {"pipe": "a pipe or a device", "address": "no file http:"}.get(attack, "apart by commas")
    with pytest.raises(InputError, match=said):
        points_file(str(file))
