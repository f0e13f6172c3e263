"""Run files: what is accepted, and what the errors say."""

import os
import tomllib
from pathlib import Path

import pytest

from cli.small import RUN
from invertwin.cli.run_file import is_run_file, load_run, to_minimal_toml, validate_run
from invertwin.cli.schema import RunFile
from invertwin.errors import InputError

REPOSITORY = Path(__file__).parents[2]
STUDIES = REPOSITORY / "experiments" / "studies" / "pyproject.toml"
RECORDING = REPOSITORY / "experiments" / "mover_arrays" / "chirps.toml"
ROUGH = {"kind": "rough_dielectric", "permittivity": 4.0}
SCALE = {"kind": "scale", "object": "letter"}
MOVER = {"kind": "mover", "object": "letter"}
SIZE = {"log_scale": 1.0}


def letter(**changes):
    return {"shape": "text", "text": "A", "material": ROUGH} | changes


def run(**changes):
    return {"task": "reconstruct", "frame": 2, "scene": {"letter": letter()}} | changes


def error_of(raw) -> str:
    with pytest.raises(InputError) as caught:
        validate_run(raw, Path("run.toml"))
    message = str(caught.value)
    assert "\n" not in message
    return message.removeprefix("run.toml: ")


def radar(**changes):
    element = {"kind": "positions", "positions": [[0, 0, 0]]}
    waveform = {
        "kind": "fmcw",
        "start_frequency": 77e9,
        "bandwidth": 2e9,
        "duration": 5e-5,
        "samples": 128,
    }
    return {"waveform": waveform, "transmitters": element, "receivers": element} | changes


@pytest.mark.parametrize(
    ("raw", "parts"),
    [
        (run(sede=1), ["sede: ", "task, frame, title, note, seed", "did you mean `seed`?"]),
        (
            run(scene={"letter": {"shape": "text", "text": "A", "materail": ROUGH}}),
            [
                "scene.letter.materail: ",
                "material, velocity, motion, position",
                "did you mean `material`?",
            ],
        ),
        (
            run(scene={"letter": letter(shape="txet")}),
            ["scene.letter.shape: ", "plate, box, sphere", 'got "txet"', "did you mean `text`?"],
        ),
        (
            run(scene={"letter": {"sahpe": "text", "material": ROUGH}}),
            ["scene.letter: ", "shape or parts or file", "did you mean `shape`?"],
        ),
        (run(scene={"letter": letter(size="big")}), ["scene.letter.size: ", "number", '"big"']),
        (run(scene={"letter": letter(size=True)}), ["scene.letter.size: ", "number", "true"]),
        (run(scene={"letter": letter(size=-1.0)}), ["scene.letter.size: ", "greater than 0"]),
        (run(scene={"letter": letter(size=float("nan"))}), ["scene.letter.size: ", "finite"]),
        (
            run(scene={"letter": letter(position=[0, 1])}),
            ["scene.letter.position: ", "at least 3", "[0, 1]"],
        ),
        (
            run(
                scene={"letter": letter(material={"kind": "rough_dielectric", "permitivity": 2.0})}
            ),
            ["scene.letter.material.permitivity: ", "did you mean `permittivity`?"],
        ),
        (
            run(scene={"letter": letter(material={"kind": "rough"})}),
            ["scene.letter.material.kind: ", "rough_dielectric, perfect_conductor"],
        ),
        (
            run(scene={"slits": {"parts": [{"shape": "plate", "width": 1}], "material": ROUGH}}),
            ["scene.slits.parts[0].height: ", "add the key `height`"],
        ),
        (run(scene={}), ["scene: ", "at least 1 object"]),
        (run(radar=radar(window="haming")), ["radar.window: ", "did you mean `hamming`?"]),
        (run(radar=radar(positions=[[0, 0, 0], [1, 0]])), ["radar.positions[1]: ", "at least 3"]),
        (
            run(radar=radar(positions={"kind": "line", "start": [0, 0, 0]})),
            ["radar.positions.stop: ", "add the key `stop`"],
        ),
        (
            run(radar=radar(orientation={"look_to": [0, 0, 1]})),
            ["radar.orientation: ", "did you mean `look_at`?"],
        ),
        (
            run(parameters=[{"kind": "pose", "object": "leter"}]),
            ["parameters[0].object: ", "(letter)", "did you mean `letter`?"],
        ),
        (run(truth={"wall": {"scale": 2.0}}), ["truth.wall: ", "letter", "add it to the scene"]),
        (
            run(
                data={"kind": "simulated", "points_per_m2": 1e3, "snr_db": 3, "noise_figure_db": 4}
            ),
            ["data: ", "got both"],
        ),
        (
            run(gradcheck={"parameter": {"kind": "scale", "object": "letter"}, "step": 1e-3}),
            ["gradcheck.tangent: ", "expected a value, got nothing", "add the key `tangent`"],
        ),
        (
            run(gradcheck={"parameter": SCALE, "tangent": SIZE, "step_deg": 1.0}),
            ["gradcheck: ", "no `step_deg` with kind = scale", "remove it"],
        ),
        (
            run(gradcheck={"parameter": MOVER, "tangent": {"place": 1.0}, "step": 1e-3}),
            ["gradcheck: ", "got kind mover", "choose another"],
        ),
        (
            run(reconstruct={"steps": 3, "depth": 0}),
            ["reconstruct.depth: ", "greater than or equal to 1", "got 0"],
        ),
        (
            run(data={"kind": "simulated", "points_per_m2": {"leter": 1e3, "*": 1e2}}),
            ["data.points_per_m2.leter: ", "(letter)", "did you mean `letter`?"],
        ),
        (
            run(data={"kind": "simulated", "points_per_m2": {"letter": 0.0}}),
            ["data.points_per_m2.letter: ", "greater than 0"],
        ),
        (
            run(data={"kind": "simulated", "points_per_m2": [1e3]}),
            ["data.points_per_m2: ", "expected a number", "got [1000.0]"],
        ),
        (
            run(data={"kind": "simulated", "points_per_m2": 1e3, "depth": 17}),
            ["data.depth: ", "less than or equal to 16", "got 17"],
        ),
        (
            run(gradcheck={"parameter": SCALE, "tangent": SIZE, "step": 1e-3, "depth": 2.5}),
            ["gradcheck.depth: ", "an integer", "got 2.5"],
        ),
        (
            run(task="reconstrct"),
            ["task: ", "simulate, reconstruct", "did you mean `reconstruct`?"],
        ),
    ],
)
def test_errors_name_path_allowed_values_and_nearest_match(raw, parts):
    message = error_of(raw)
    assert message.startswith(parts[0])
    for part in parts[1:]:
        assert part in message


def test_further_errors_are_said_too_but_not_without_end():
    message = error_of(run(radar=radar(window="x", array_window="y")))
    first, second = message.split(" — also ")
    assert first.startswith("radar.window: ")
    assert second.startswith("radar.array_window: ")
    assert error_of(run(radar=radar(positions=[["x"] * 3] * 9))).count(" — also ") == 19


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ("x", 'expected an integer, got "x"'),
        (2.5, "expected an integer, got 2.5; correct"),
    ],
)
def test_integers_are_asked_for_in_good_english(value, said):
    assert said in error_of(run(seed=value))


def test_a_section_that_is_no_table_says_so():
    assert "grid: expected a table, got 3" in error_of(run(grid=3))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('task = "demo"\nseed = = 3\n', 'line 2: expected TOML, got "seed = = 3" (Invalid value)'),
        ('task = "demo"\na = [1,', "line 2: expected TOML"),
        ("a = 1\na = 2\n", "line 2: expected TOML"),
        ("[", "line 1: expected TOML"),
    ],
)
def test_a_syntax_error_names_the_line(tmp_path, text, said):
    file = tmp_path / "bad.toml"
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        load_run(file)
    assert str(caught.value).startswith(f"{file}: {said}")
    assert "\n" not in str(caught.value)


def test_files_are_looked_for_beside_the_run_file_then_in_the_data_folder(tmp_path, monkeypatch):
    data = tmp_path / "data"
    (data / "recording").mkdir(parents=True)
    monkeypatch.setenv("INVERTWIN_DATA", str(data))
    source = tmp_path / "runs" / "run.toml"
    raw = run(
        scene={"mesh": {"file": "mesh.obj", "material": ROUGH}},
        data={"kind": "rail_sar", "folder": "recording"},
    )
    read = validate_run(raw, source)
    assert read.scene["mesh"].model_dump()["file"] == str(tmp_path / "runs" / "mesh.obj")
    assert read.data is not None
    assert read.data.model_dump()["folder"] == str(data / "recording")


def test_missing_file_folder_and_broken_toml_are_input_errors(tmp_path):
    broken = tmp_path / "broken.toml"
    broken.write_text("task = \n")
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    for path in (tmp_path / "none.toml", tmp_path, broken, binary):
        with pytest.raises(InputError) as caught:
            load_run(path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)
    os.mkfifo(tmp_path / "pipe.toml")
    for path, got in ((tmp_path, "a folder"), (tmp_path / "pipe.toml", "a pipe or a device")):
        with pytest.raises(InputError, match=f"expected a run file, got {got}, .*; name a file"):
            load_run(path)


@pytest.mark.parametrize(
    "value", ["0x" + "f" * 5_000, "[" * 300 + "]" * 300, '"' + "a" * 10_000 + '"']
)
def test_values_that_cannot_be_shown_are_one_short_line(tmp_path, value):
    file = tmp_path / "long.toml"
    file.write_text(f'task = "simulate"\nframe = 2\nseed = {value}\n')
    with pytest.raises(InputError, match="seed: expected") as caught:
        load_run(file)
    assert len(str(caught.value)) < 400 + len(str(file))


@pytest.mark.parametrize(
    "path",
    sorted({*(REPOSITORY / "experiments").rglob("*.toml")} - {STUDIES, RECORDING}),
    ids=lambda path: path.stem,
)
def test_every_run_file_of_the_repository_is_valid(path):
    assert isinstance(load_run(path), RunFile)


def test_all_typos_are_told_at_once_beside_wrong_values(tmp_path):
    text = RUN.replace("permittivity = 4.0", "permitivity = 4.0", 1)
    text = text.replace("divisions = 3", "divisions = 0\nwidht = 1.0")
    text = text.replace("steps = 8", "stepz = 8\nsamplez = 3").replace("range_max", "range_mx")
    with pytest.raises(InputError) as found:
        validate_run(tomllib.loads(text), tmp_path / "run.toml")
    said = str(found.value).split(" — also ")
    paths = {line.removeprefix(f"{tmp_path}/run.toml: ").split(":")[0] for line in said}
    assert paths == {
        "scene.plate.widht",
        "scene.plate.divisions",
        "scene.plate.material.permitivity",
        "grid.range_mx",
        "reconstruct.stepz",
        "reconstruct.samplez",
    }
    # A key that is misspelt is not missing, too.
    assert "got nothing" not in str(found.value)


def test_what_is_stated_stays_apart_from_defaults():
    read = validate_run(run(seed=4), Path("run.toml"))
    again = validate_run(tomllib.loads(to_minimal_toml(read)), Path("run.toml"))
    assert again == read
    assert again.model_fields_set == read.model_fields_set
    assert "loss" not in again.model_fields_set
    other = validate_run(
        tomllib.loads(to_minimal_toml(read.model_copy(update={"seed": 5}))), Path("run.toml")
    )
    assert other.seed == 5


def test_keys_of_thousands_of_parts_are_one_line(tmp_path):
    path = tmp_path / "deep.toml"
    path.write_text('task = "simulate"\nframe = 2\nradar' + ".a" * 5_000 + " = 1\n")
    with pytest.raises(InputError, match=r"deep\.toml: ") as caught:
        load_run(path)
    assert "\n" not in str(caught.value)


def test_a_pipe_is_no_run_file(tmp_path):
    os.mkfifo(tmp_path / "pipe.toml")
    assert not is_run_file(tmp_path / "pipe.toml")  # and nothing waits for it
    (tmp_path / "deep.toml").write_text("x = " + "[" * 20_000)
    assert not is_run_file(tmp_path / "deep.toml")
