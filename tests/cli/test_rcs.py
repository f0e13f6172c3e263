"""`invertwin rcs`: run files of signatures."""

import json
import math
import tomllib

import pytest

from invertwin.cli.app import app
from invertwin.cli.run_file import load_run, validate_run
from invertwin.errors import InputError

PLATE = """
task = "rcs"
frame = 2
[scene.plate]
shape = "plate"
width = 0.05
height = 0.05
material = { kind = "perfect_conductor" }
[rcs]
frequencies = { start = 29e9, stop = 31e9, count = 5 }
phi_deg = { start = 170.0, stop = 190.0, count = 21 }
profile = true
edges = 0
image = { extent = 0.2, pixels = 16 }
[rcs.cases.pattern]
reference = { kind = "plate", width = 0.05, height = 0.05 }
channel = "HH"
"""


def metrics(folder):
    return json.loads((folder / "metrics.json").read_text())


def run(*arguments):
    app([*map(str, arguments)], standalone_mode=False)


def test_a_target_is_compared_and_drawn(tmp_path):
    (tmp_path / "plate.toml").write_text(PLATE)
    run("rcs", tmp_path / "plate.toml", "-o", tmp_path / "out")
    found = metrics(tmp_path / "out")
    assert found["task"] == "rcs"
    # Of a flat plate at the highest frequency.
    most = 10 * math.log10(4 * math.pi * (0.05**2 / (299792458.0 / 31e9)) ** 2)
    assert found["answer"] == f"plate: peak {most:.1f} dBsm"
    assert found["error_db"]["pattern"] < 0.05
    assert found["scenes"]["plate"]["error_db"] == found["error_db"]
    for name in ("plate.png", "plate_profile.png", "plate_image.png", "report.html", "plate.csv"):
        assert (tmp_path / "out" / name).stat().st_size > 0
    rows = (tmp_path / "out" / "plate.csv").read_text().splitlines()
    assert len(rows) == 1 + 5 * 21
    assert len(rows[1].split(",")) == len(rows[0].split(",")) == 12


def test_check_says_what_a_signature_needs(tmp_path, capsys):
    (tmp_path / "plate.toml").write_text(PLATE)
    run("check", tmp_path / "plate.toml")
    said = capsys.readouterr().out
    assert "values of the field" in said
    assert "for 21 aspects" in said
    assert [path.name for path in tmp_path.iterdir()] == ["plate.toml"]


@pytest.mark.parametrize("command", ["rcs", "check"])
@pytest.mark.parametrize(
    ("change", "key"),
    [
        (("count = 5", "count = 2_000_000_000"), "rcs.frequencies"),
        (("count = 21", "count = 900_000_000"), "rcs.phi_deg"),
        (("pixels = 16", "pixels = 90_000"), "rcs.image.pixels"),
    ],
)
def test_what_no_memory_holds_is_refused_before_work(tmp_path, command, change, key):
    (tmp_path / "plate.toml").write_text(PLATE.replace(*change))
    with pytest.raises(InputError, match=rf"{key}: expected a run within .* lower {key}"):
        run(command, tmp_path / "plate.toml")


@pytest.mark.parametrize("name", ["dihedral", "dihedral_rolled", "trihedral", "trihedral_square"])
def test_corners_are_what_they_should_be(repository, tmp_path, name):
    run("rcs", repository / "experiments" / "rcs" / f"{name}.toml", "-o", tmp_path / "out")
    limits = {"dihedral": 0.1, "dihedral_rolled": 0.05, "trihedral": 0.02, "trihedral_square": 0.05}
    assert max(metrics(tmp_path / "out")["error_db"].values()) <= limits[name]


def test_several_targets_have_a_table_each(repository, tmp_path):
    folder = repository / "experiments" / "rcs"
    files = [folder / "plate.toml", folder / "dihedral.toml"]
    run("rcs", *files, "-o", tmp_path / "out")
    found = metrics(tmp_path / "out")
    assert set(found["scenes"]) == {"plate", "dihedral"}
    assert found["plate"]["error_db"]["vertical"] < 0.05
    run("rcs", *files, "-o", tmp_path / "out", "--overwrite")


@pytest.mark.claim
@pytest.mark.slow
def test_the_measured_plate(repository, tmp_path, data_folder):
    run("rcs", repository / "experiments" / "rcs" / "austin_plate.toml", "-o", tmp_path / "out")
    found = metrics(tmp_path / "out")
    for key, error in found["mean_db"].items():
        assert error <= (1.5 if key.endswith("V") else 2.0), key
        assert found["mean_db_optics"][key] > 4
    assert len(found["mean_db"]) == 8


def test_missing_measurements_are_skipped_visibly(tmp_path):
    text = PLATE + '[[rcs.measured]]\nfile = "nowhere.txt"\nchannel = "VV"\n'
    (tmp_path / "plate.toml").write_text(text)
    with pytest.warns(UserWarning, match="skipped a comparison: 1 measured files are not there"):
        run("rcs", tmp_path / "plate.toml", "-o", tmp_path / "out")
    found = metrics(tmp_path / "out")
    assert len(found["skipped"]) == 1
    assert "mean_db" not in found
    assert "Skipped a comparison" in (tmp_path / "out" / "report.html").read_text()


def test_measurements_of_other_angles_are_refused(tmp_path):
    (tmp_path / "data.txt").write_text("29e9 90.0 12.3 -3.0\n")
    text = PLATE + '[[rcs.measured]]\nfile = "data.txt"\nchannel = "VV"\n'
    (tmp_path / "plate.toml").write_text(text)
    with pytest.raises(InputError, match=r"rcs\.measured\[0\]\.file.*swept angles and frequencies"):
        run("rcs", tmp_path / "plate.toml", "-o", tmp_path / "out")


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ('channel = "HH"', 'channel = "RL"', "rcs.cases.pattern.channel: expected a channel of"),
        ('kind = "plate", width', 'kind = "cone", width', "reference.kind: expected one of"),
        ("edges = 0", "edges = 0\ntheta_deg = [0.0, 1.0]", "rcs.phi_deg: expected one angle or as"),
        ("edges = 0", "edge = 0", "did you mean `edges`"),
        ("frequencies = {", "frequency = {", "did you mean `frequencies`"),
    ],
)
def test_mistakes_are_named(tmp_path, old, new, text):
    assert old in PLATE
    with pytest.raises(InputError, match=text):
        validate_run(tomllib.loads(PLATE.replace(old, new)), tmp_path / "plate.toml")


def test_an_unknown_part_is_named(tmp_path):
    (tmp_path / "plate.toml").write_text(PLATE + 'part = "order 9"\n')
    with pytest.raises(InputError, match=r"rcs\.cases\.pattern\.part.*expected a part"):
        run("rcs", tmp_path / "plate.toml", "-o", tmp_path / "out")


def test_a_run_file_without_the_section_is_refused(tmp_path):
    (tmp_path / "plate.toml").write_text(PLATE.split("[rcs]")[0])
    with pytest.raises(InputError, match=r"section \[rcs\]"):
        run("rcs", tmp_path / "plate.toml", "-o", tmp_path / "out")


def test_sweeps_survive_a_run(tmp_path):
    (tmp_path / "plate.toml").write_text(PLATE)
    run("rcs", tmp_path / "plate.toml", "-o", tmp_path / "out")
    assert load_run(tmp_path / "out" / "run.toml") == load_run(tmp_path / "plate.toml")


SLOPES = (
    PLATE.replace("rcs", "gradcheck", 1).replace("count = 21", "count = 4")
    + """
[gradcheck]
parameter = { kind = "scale", object = "plate" }
tangent = { log_scale = 1.0 }
step = 1e-5
"""
)


@pytest.mark.parametrize("across", ["phi_deg = {", "phi_deg = 175.0 # {"])
def test_derivatives_of_a_signature_are_checked(tmp_path, across):
    (tmp_path / "slopes.toml").write_text(SLOPES.replace("phi_deg = {", across))
    run("gradcheck", tmp_path / "slopes.toml", "-o", tmp_path / "out")
    found = metrics(tmp_path / "out")["scenes"]["slopes"]
    assert found["full"]["relative_l1"] < 1e-6
    assert found["pairs"] == 1
    for name in ("slopes.png", "slopes_scene.png", "report.html"):
        assert (tmp_path / "out" / name).stat().st_size > 0


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("step = 1e-5", "step = 1e-5\nsamples = 10", "gradcheck.samples: expected nothing with"),
        (
            'kind = "scale", object = "plate" }\ntangent = { log_scale = 1.0 }',
            'kind = "radar_pose" }\ntangent = { translation = 1.0 }',
            "gradcheck.parameter.kind: expected a parameter of the scene",
        ),
        ("[rcs]", "[grid]\nrange_min = 1.0\nrange_max = 2.0\n[rcs]", "grid: expected nothing with"),
    ],
)
def test_what_a_derivative_of_a_signature_does_not_take(tmp_path, old, new, message):
    with pytest.raises(InputError, match=message):
        validate_run(tomllib.loads(SLOPES.replace(old, new)), tmp_path / "run.toml")
