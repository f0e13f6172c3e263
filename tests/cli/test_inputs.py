"""Refusals of the command line: one line of all that is missing, before torch is imported."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from cli.small import RUN, call
from invertwin.cli.inputs import find_viewed_file, require_recording
from invertwin.cli.options import LookOptions
from invertwin.errors import InputError
from invertwin.radar.boards import BOARDS

RUN_FILE_COMMANDS = ("simulate", "dataset", "reconstruct", "plan", "check", "gradcheck", "rcs")
RECORDING_COMMANDS = ("look", "twin")
WRONG_BOARD = """
task = "simulate"
frame = 2
radar = { board = { name = "xWR9999", elevation = 1 } }
"""
# Modules that a command has imported when it ends, as one line of JSON.
CALL = """
import atexit, json, sys
from invertwin.cli.app import main
heavy = {"torch", "mitsuba", "drjit", "matplotlib", "scipy"}
atexit.register(lambda: print(json.dumps(sorted(heavy & set(sys.modules)))))
main()
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "wrong.toml").write_text(WRONG_BOARD)
    (tmp_path / "raw.bin").write_bytes(b"\0\0")
    (tmp_path / "raw.cfg").write_text("% of a board\n")
    (tmp_path / "empty").mkdir()
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        *(([command, "none.toml"], "got no file none.toml") for command in RUN_FILE_COMMANDS),
        *(([command, "empty"], "got a folder, empty") for command in RUN_FILE_COMMANDS),
        *(([command, "wrong.toml"], "expected one of xWR1443, ") for command in RUN_FILE_COMMANDS),
        *(([command, "none.nc"], "got no file none.nc") for command in RECORDING_COMMANDS),
        *(([command, "empty"], "got empty; name the file") for command in RECORDING_COMMANDS),
        *(
            ([command, "raw.bin", "-c", "raw.cfg", "-b", "xWR9999"], "IWR6843AOP, ")
            for command in RECORDING_COMMANDS
        ),
        (["convert", "none.toml"], "got no file none.toml"),
        (["view", "none.nc"], "got no file none.nc"),
        (["view", "empty"], "got empty without any"),
        (["view", "picture.png"], "invertwin look"),
        (["view", "wrong.toml", "--record", "raw.bin"], "expected a new file for --record"),
    ],
)
def test_a_refusal_imports_nothing_that_computes(folder, arguments, said):
    call = [sys.executable, "-c", CALL, *arguments]
    done = subprocess.run(call, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 2
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
    assert json.loads(done.stdout) == []
    assert not (folder / "out").exists()


def test_several_run_files_that_are_missing_are_one_line(folder):
    call = [sys.executable, "-c", CALL, "rcs", "first.toml", "wrong.toml", "second.toml"]
    done = subprocess.run(call, cwd=folder, capture_output=True, text=True)
    assert done.stderr.count("got no file") == 2
    assert done.stderr.count("\n") == 1


def _refusal(**given) -> str:
    with pytest.raises(InputError) as refused:
        require_recording(LookOptions(**given))
    return str(refused.value)


def test_all_that_a_raw_file_lacks_is_said_at_once():
    said = _refusal(recording=Path("none.bin"), channels=Path("none.json")).split(" — also ")
    assert [part.split(";")[0].split(", got")[0] for part in said[:3]] == [
        "expected a recording",
        "expected a channel calibration",
        "expected --config",
    ]
    assert all(name in said[3] for name in BOARDS)
    assert len(said) == 4


@pytest.mark.parametrize("name", sorted(BOARDS))
def test_boards_with_rows_need_the_sign_of_elevation(folder, name):
    raw = {"recording": folder / "raw.bin", "config": folder / "raw.cfg", "board": name}
    if BOARDS[name].has_rows:
        assert f"expected --elevation 1 or -1 for {name}" in _refusal(**raw)
    require_recording(LookOptions(**raw, elevation=-1))


def test_a_folder_shows_its_run_before_its_capture(tmp_path):
    (tmp_path / "capture.nc").write_text("")
    assert find_viewed_file(tmp_path) == tmp_path / "capture.nc"
    (tmp_path / "run.toml").write_text("")
    assert find_viewed_file(tmp_path) == tmp_path / "run.toml"


@pytest.mark.parametrize(
    "words", [["view", "{}"], ["look", "{}"], ["view", "s.toml", "--record", "{}"]]
)
def test_names_that_cannot_be_are_told(tmp_path, monkeypatch, capsys, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.toml").write_text(RUN)
    assert call(monkeypatch, *(word.format("a" * 300) for word in words)) == 2
    assert "File name too long" in capsys.readouterr().err


def test_a_link_in_a_circle_is_not_replaced_by_a_page(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.toml").write_text(RUN)
    (tmp_path / "p.html").symlink_to("p.html")
    assert call(monkeypatch, "view", "s.toml", "--record", "p.html") == 2
    assert "got p.html, which exists" in capsys.readouterr().err
    assert (tmp_path / "p.html").is_symlink()
