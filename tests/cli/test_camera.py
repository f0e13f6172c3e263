"""`[camera]` and `[image]` in run files: a small check from end to end, and errors."""

import json
from pathlib import Path

import pytest

from invertwin.cli.app import app
from invertwin.cli.run_file import load_run
from invertwin.errors import InputError

CHECK = """
task = "gradcheck"
frame = 2

[scene.box]
shape = "box"
size = [0.6, 0.4, 0.5]
position = [0.05, 0.1, 0.2]
rotation_deg = [6.0, 11.0, 23.0]
material = { kind = "perfect_conductor" }

[camera]
positions = [[2.5, 1.0, 1.4]]
look_at = [0.0, 0.0, 0.1]
width = 6
height = 5
field_of_view_deg = 29.0

[image]
kind = "silhouette"
objects = ["box"]

[gradcheck]
parameter = { kind = "translation", object = "box" }
tangent = { translation = [0.3, 0.8, -0.5] }
step = 0.01
repeats = 1
max_pairs = 2
difference_samples = 20_000
"""


def run(*arguments: object) -> None:
    app([str(argument) for argument in arguments], standalone_mode=False)


def written(folder: Path, text: str) -> Path:
    file = folder / "mask.toml"
    file.write_text(text, encoding="utf-8")
    return file


def test_a_mask_is_checked_and_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file, out = written(tmp_path, CHECK), tmp_path / "out"
    run("check", file)
    assert "rays" in capsys.readouterr().out
    run("gradcheck", file, "-o", out)
    found = json.loads((out / "metrics.json").read_text(encoding="utf-8"))["scenes"]["mask"]
    assert found["full"]["relative_l1"] < 0.15
    assert found["interior"]["relative_l1"] == pytest.approx(1.0)
    assert {file.name for file in out.glob("*.png")} >= {"mask.png", "mask_scene.png"}


def test_depths_and_the_camera_itself(tmp_path: Path):
    text = CHECK.replace('kind = "silhouette"\nobjects = ["box"]', 'kind = "depth"\nfar = 6.0')
    text = text.replace('{ kind = "translation", object = "box" }', '{ kind = "camera_pose" }')
    out = tmp_path / "out"
    run("gradcheck", written(tmp_path, text), "-o", out)
    found = json.loads((out / "metrics.json").read_text(encoding="utf-8"))["scenes"]["mask"]
    assert found["full"]["relative_l1"] < 0.15


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('objects = ["box"]', 'objects = ["post"]', "image.objects: .*post"),
        ("field_of_view_deg = 29.0", "field_of_view_deg = 190.0", "field of view"),
        ("repeats = 1", "samples = 7", r"gradcheck.samples: expected nothing with \[image\]"),
        ("height = 5", "", "camera.height"),
        ("look_at = [0.0, 0.0, 0.1]", "look_at = [2.5, 1.0, 0.0]", "look along up"),
    ],
)
def test_what_makes_no_sense_is_refused(tmp_path: Path, old: str, new: str, message: str):
    assert old in CHECK
    with pytest.raises(InputError, match=message):
        load_run(written(tmp_path, CHECK.replace(old, new)))


def test_an_image_needs_its_camera(tmp_path: Path):
    begin, end = CHECK.index("[camera]"), CHECK.index("[image]")
    with pytest.raises(InputError, match=r"expected a section \[camera\]"):
        run("gradcheck", written(tmp_path, CHECK[:begin] + CHECK[end:]), "-o", tmp_path / "out")
