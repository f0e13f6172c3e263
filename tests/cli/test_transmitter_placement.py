"""`[aim]` in run files: a transmitter is placed in a small room, and what is refused."""

import re

import pytest
import torch

from cli.small import ROOM, call, read_metrics
from invertwin.cli.run_file import load_run
from invertwin.cli.schema import build
from invertwin.errors import InputError
from invertwin.inversion.fit import Fit
from invertwin.links import TransmitterPosition, Transmitters
from invertwin.scene import Mesh, signed_distance

# Receivers nearer to the shelf, whose front is at x = 0.2 m, than a transmitter may be.
RUN = (
    ROOM
    + """
[scene.shelf]
shape = "box"
size = [0.4, 2.0, 2.0]
material = { kind = "perfect_conductor" }

[transmitter]
positions = [[1.2, 0.3, 0.2]]
power_dbm = 10.0

[map]
places = { kind = "random", low = [0.3, -0.1, -0.1], high = [0.5, 0.1, 0.1], count = 10 }
frequency = 2.4e9
depth = 0
rays = 1000

[aim]
measure = "mean"

[[parameters]]
kind = "transmitter"
low = [-2.4, -1.9, -1.4]
high = [2.4, 1.9, 1.4]
clear = 0.4

[optimizer]
kind = "adam"
rate = 0.15

[reconstruct]
steps = 8
checkpoint_every = 1
"""
)
STARTS = """
[transmitter_starts]
low = [-2.0, -1.5, -1.0]
high = [2.0, 1.5, 1.0]
count = 6
"""


def place(monkeypatch, folder, text=RUN):
    """Metrics of a run in a folder."""
    file, out = folder / "room.toml", folder / "out"
    file.write_text(text, encoding="utf-8")
    assert call(monkeypatch, "reconstruct", file, "-o", out, "--overwrite") == 0
    return read_metrics(out)


def shelf_distance(run, position):
    item = build.scene(run)["shelf"]
    skin = Mesh(item.vertices, item.mesh.faces)
    return float(signed_distance(skin, torch.tensor([position], dtype=torch.float64)))


@pytest.mark.parametrize(
    ("aim", "words"),
    [
        ('measure = "mean"', r"mean -\d+\.\d dBm, \+\d+\.\d dB over the best of 6 random places"),
        ('measure = "worst_tenth"', r"worst tenth -\d+\.\d dBm, \+\d+\.\d dB over the best of 6"),
        (
            'measure = "coverage"\nlevel = -33.0',
            r"share of receivers above -33 dBm \d+ %, [+-]\d+ points over the best of 6",
        ),
    ],
)
def test_each_aim_is_raised_and_said(aim, words, tmp_path, monkeypatch, capsys):
    text = RUN.replace('measure = "mean"', aim).replace("[1.2, 0.3, 0.2]", "[-1.2, 0.3, 0.2]")
    found = place(monkeypatch, tmp_path, text + STARTS)
    given, *tried = found["tried"]
    assert found["aim_before"] == max(tried) >= given
    assert len(tried) == 6
    assert found["aim_after"] > found["aim_before"]
    assert re.search(rf"Transmitter at \([^)]+\) m: {words}", found["answer"])
    gain = found["aim_after"] - given
    over = f"{100 * gain:+.0f} points" if "coverage" in aim else f"{gain:+.1f} dB"
    assert found["answer"].endswith(f" and {over} over the given place")
    assert found["answer"] in " ".join(capsys.readouterr().out.split())
    # An aim has no noise.
    assert found["verdict"] in ("unknown", "at a bound")
    assert "standard_deviations" not in found
    run = load_run(tmp_path / "room.toml")
    position = torch.tensor([found["parameters"]["transmitter.position"]], dtype=torch.float64)
    level = run.map.build().predict(build.scene(run), Transmitters(position, power_dbm=10.0), 0)
    expected = {
        "mean": level.mean(),
        "worst_tenth": level.flatten().quantile(0.1),
        "coverage": (level > -33.0).double().mean(),
    }
    assert found["aim_after"] == pytest.approx(float(expected[run.aim.measure]), abs=1e-6)
    for name in ("report.html", "plan.png", "coverage.png", "loss.png"):
        assert (tmp_path / "out" / name).stat().st_size > 1000


@pytest.mark.parametrize("aim", ['"mean"', '"worst_tenth"', '"coverage"\nlevel = -30.0'])
def test_steps_too_long_end_no_worse_than_the_best_place(aim, tmp_path, monkeypatch):
    """The given place counts among the starts, the start and every step among the ends."""
    rate = ("rate = 0.15", "rate = 0.4\nfinal_rate = 0.4")
    text = RUN.replace('"mean"', aim).replace(*rate) + STARTS
    found = place(monkeypatch, tmp_path, text)
    assert found["aim_before"] == max(found["tried"]) == found["tried"][0]
    assert found["aim_after"] >= found["aim_before"]
    rows = torch.load(tmp_path / "out" / "checkpoint.pt")["progress"]["history"]
    if aim == '"mean"':  # the loss is the ratio of powers
        reached = 10 ** ((found["aim_before"] - found["aim_after"]) / 10)
        assert reached <= min(row["loss"] for row in rows) + 1e-9


def test_clear_keeps_the_transmitter_off_the_furniture(tmp_path, monkeypatch):
    kept = place(monkeypatch, tmp_path)
    run = load_run(tmp_path / "room.toml")
    assert shelf_distance(run, kept["parameters"]["transmitter.position"]) >= 0.4
    # It slides along the shelf to the middle of the receivers: only the way to the shelf is barred.
    assert abs(kept["parameters"]["transmitter.position"][1]) < 0.25
    free = place(monkeypatch, tmp_path, RUN.replace("clear = 0.4\n", ""))
    assert shelf_distance(run, free["parameters"]["transmitter.position"]) < 0.35
    assert free["aim_after"] > kept["aim_after"]


def test_an_interrupted_placement_goes_on_as_if_nothing_had_been(tmp_path, monkeypatch):
    """Ended while it slides along the shelf: where it was free goes with the checkpoint."""
    whole = place(monkeypatch, tmp_path)
    steps, take = [], Fit._take_step  # pyright: ignore[reportPrivateUsage]

    def end_early(fit, step):
        if len(steps) == 6:
            raise KeyboardInterrupt
        steps.append(step)
        return take(fit, step)

    line = ("reconstruct", tmp_path / "room.toml", "-o", tmp_path / "cut")
    with monkeypatch.context() as patch:
        patch.setattr(Fit, "_take_step", end_early)
        assert call(monkeypatch, *line) == 130
    assert not (tmp_path / "cut" / "metrics.json").exists()
    assert call(monkeypatch, *line, "--resume") == 0
    again = read_metrics(tmp_path / "cut")
    assert again["parameters"] == whole["parameters"]
    assert again["aim_after"] == whole["aim_after"]
    assert again["steps"] == whole["steps"]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"mean"', '"coverage"', 'aim.level: expected a level with "coverage", got none; add it'),
        (
            '"mean"',
            '"mean"\nlevel = -60.0',
            'aim.level: expected none with "mean", got -60; remove',
        ),
        ('"mean"', '"median"', "aim.measure: "),
        ("depth = 0", 'depth = 0\nquantity = "gain"', "map.quantity: expected received_power"),
        ('kind = "transmitter"\nlow', 'kind = "transmitters"\nlow', "parameters[0].kind: "),
        ("[1.2, 0.3, 0.2]", "[0.1, 0.0, 0.0]", "at least 0.4 m off all surfaces, got one that"),
        ("low = [-2.4, -1.9, -1.4]\nhigh = [2.4, 1.9, 1.4]\n", "", "low and high with clear, got"),
        ("[optimizer]", '[data]\nkind = "received"\n[optimizer]', "data: expected no such section"),
        ("[map]", "[map_]", "map"),
    ],
)
def test_mistakes_are_one_line(old, new, words, tmp_path, monkeypatch, capsys):
    file = tmp_path / "room.toml"
    assert old in RUN
    file.write_text(RUN.replace(old, new), encoding="utf-8")
    assert call(monkeypatch, "reconstruct", file, "-o", tmp_path / "out") == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert words in line


def test_keys_and_check_know_an_aim(tmp_path, monkeypatch, capsys):
    assert call(monkeypatch, "keys", "aim") == 0
    said = capsys.readouterr().out
    assert "measure" in said
    assert "level" in said
    (tmp_path / "room.toml").write_text(RUN + STARTS)
    assert call(monkeypatch, "check", tmp_path / "room.toml") == 0
    assert re.search(r"about .+ for 8 steps", capsys.readouterr().out)


def test_a_step_into_furniture_loses_the_axes_that_lead_there(tmp_path):
    (tmp_path / "room.toml").write_text(RUN)
    scene = build.scene(load_run(tmp_path / "room.toml"))
    box = {"low": [-2.4, -1.9, -1.4], "high": [2.4, 1.9, 1.4]}
    module = TransmitterPosition([0.7, 0.3, 0.0], **box, clear=0.4, scene=scene)
    module.raw_position.data += torch.tensor([-0.3, -0.2, 0.1])
    assert module.position.tolist() == pytest.approx([0.7, 0.1, 0.1])
    # Straight through the shelf: the other side is free, and the step may end there.
    module.raw_position.data += torch.tensor([-1.5, 0.0, 0.0])
    assert module.position.tolist() == pytest.approx([-0.8, 0.1, 0.1])
    with pytest.raises(InputError, match="a scene, low and high with clear"):
        TransmitterPosition([0.7, 0.3, 0.0], **box, clear=0.4)
