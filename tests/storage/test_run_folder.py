"""Run folders: nothing is lost, half a file never appears, run files come back as they were."""

import errno
import json
import os
import tomllib
from pathlib import Path

import numpy as np
import pytest

from invertwin.cli.run_file import to_toml, validate_run
from invertwin.cli.schema import RunFile
from invertwin.errors import InputError
from invertwin.storage.folders import LOCK, MANIFEST, PARTS, UNFINISHED
from invertwin.storage.run_folder import open_run, to_json_value


def make_run(**changes) -> RunFile:
    material = {"kind": "rough_dielectric", "permittivity": 4.0}
    raw = {
        "task": "reconstruct",
        "frame": 2,
        "title": 'A "quoted" title \\ with ✓ and ü',
        "scene": {
            "letter one": {"shape": "text", "text": "A", "material": material},
            "slits": {
                "parts": [{"shape": "plate", "width": 1, "height": 2.5e-3}],
                "material": {"kind": "perfect_conductor"},
            },
        },
        "truth": {"letter one": {"position": [2, 0.1, 0]}},
        "parameters": [{"kind": "pose", "object": "letter one"}],
        "radar": {
            "waveform": {"kind": "impulse", "center_frequency": 4e9, "bandwidth": 1.4e9},
            "transmitters": {"kind": "positions", "positions": [[0, 0, 0]]},
            "receivers": {"kind": "linear", "count": 16, "spacing": 1.9e-3},
            "positions": {"kind": "line", "start": [0, 0, 0], "stop": [0, 1, 0], "count": 3},
            "orientation": {"look_at": [2.5, 0, 0]},
        },
    }
    return validate_run(raw | changes, Path("run.toml"))


def broken_run(path, error, files, **flags):
    """A run that writes some files and then ends with an error."""
    with open_run(path, {"a": to_toml(make_run())}, **flags) as folder:
        for name, text in files.items():
            folder.write_text(name, text)
        raise error("broken")


def whole_run(path, files, at_the_end=lambda: None, **flags):
    """A run that writes some files; then something happens before it ends."""
    with open_run(path, {"a": to_toml(make_run())}, **flags) as folder:
        for name, text in files.items():
            folder.write_text(name, text)
        at_the_end()


def test_run_file_as_used_reads_back_equal():
    run = make_run(seed=7)
    assert validate_run(tomllib.loads(to_toml(run)), Path("elsewhere/run.toml")) == run


def test_a_complete_folder_is_refused_without_a_flag(tmp_path):
    out = tmp_path / "deep" / "out"
    with open_run(out, {"a": to_toml(make_run())}) as folder:
        folder.write_json("metrics.json", {"x": 1.0})
    assert sorted(p.name for p in out.iterdir()) == [".invertwin.json", "metrics.json", "run.toml"]
    with pytest.raises(InputError, match="--overwrite"):
        open_run(out, {"a": to_toml(make_run())})


def test_results_without_a_manifest_are_refused_too(tmp_path):
    (tmp_path / "metrics.json").write_text("{}")
    with pytest.raises(InputError, match=r"metrics\.json"):
        open_run(tmp_path, {"a": to_toml(make_run())})


def test_overwrite_replaces_own_files_and_leaves_the_users(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with open_run(tmp_path, {"a": to_toml(make_run())}) as folder:
        folder.write_json("metrics.json", {"x": 1})
        folder.write_bytes("old.png", b"old")
    with open_run(tmp_path, {"a": to_toml(make_run())}, overwrite=True) as folder:
        folder.write_json("metrics.json", {"x": 2})
    assert json.loads((tmp_path / "metrics.json").read_text()) == {"x": 2}
    assert not (tmp_path / "old.png").exists()
    assert not (tmp_path / UNFINISHED).exists()
    assert (tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("error", [InputError, KeyboardInterrupt, RuntimeError])
def test_failed_overwrite_puts_the_results_back(tmp_path, error):
    with open_run(tmp_path, {"a": to_toml(make_run())}) as folder:
        folder.write_json("metrics.json", {"x": 1})
        folder.write_bytes("pictures/old.png", b"old")
    with pytest.raises(error):
        broken_run(tmp_path, error, {"metrics.json": "{}"}, overwrite=True)
    assert json.loads((tmp_path / "metrics.json").read_text()) == {"x": 1}
    assert (tmp_path / "pictures" / "old.png").read_bytes() == b"old"
    assert not (tmp_path / UNFINISHED).exists()
    with pytest.raises(InputError, match="--overwrite"):
        open_run(tmp_path, {"a": to_toml(make_run())})


def test_failed_first_run_leaves_no_folder(tmp_path):
    with pytest.raises(InputError):
        broken_run(tmp_path / "out" / "deep", InputError, {"metrics.json": "{}"})
    assert not (tmp_path / "out").exists()
    (tmp_path / "out" / "other").mkdir(parents=True)
    with pytest.raises(InputError):
        broken_run(tmp_path / "out" / "deep", InputError, {"metrics.json": "{}"})
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["other"]


def test_interrupted_run_resumes_with_the_same_run_file_only(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        broken_run(tmp_path, KeyboardInterrupt, {"checkpoint.pt": "s", "parts/starts.json": "[1]"})
    with pytest.raises(InputError, match=r"run\.toml"):
        open_run(tmp_path, {"a": to_toml(make_run(seed=3))}, resume=True)
    with open_run(tmp_path, {"a": to_toml(make_run())}, resume=True) as folder:
        assert not folder.complete
        assert folder.read_json("parts/starts.json") == [1]
        assert folder.read_json("metrics.json") is None
    assert sorted(p.name for p in tmp_path.iterdir()) == [MANIFEST, "checkpoint.pt", "run.toml"]
    with open_run(tmp_path, {"a": to_toml(make_run())}, resume=True) as folder:
        assert folder.complete


def test_interrupted_overwrite_keeps_both_until_it_ends(tmp_path):
    with open_run(tmp_path, {"a": to_toml(make_run())}) as folder:
        folder.write_json("metrics.json", {"x": 1})
    with pytest.raises(KeyboardInterrupt):
        broken_run(tmp_path, KeyboardInterrupt, {"checkpoint.pt": "state"}, overwrite=True)
    assert json.loads((tmp_path / "metrics.json").read_text()) == {"x": 1}
    assert (tmp_path / UNFINISHED / "checkpoint.pt").read_text() == "state"
    with pytest.raises(RuntimeError):
        broken_run(tmp_path, RuntimeError, {}, overwrite=True)
    assert json.loads((tmp_path / "metrics.json").read_text()) == {"x": 1}
    assert sorted(p.name for p in tmp_path.iterdir()) == [MANIFEST, "metrics.json", "run.toml"]


def test_nothing_to_resume_both_flags_and_a_file_in_the_way_are_input_errors(tmp_path):
    taken = tmp_path / "file"
    taken.write_text("")
    run = {"a": to_toml(make_run())}
    with pytest.raises(InputError, match="interrupted"):
        open_run(tmp_path / "none", run, resume=True)
    with pytest.raises(InputError, match="both"):
        open_run(tmp_path / "none", run, resume=True, overwrite=True)
    with pytest.raises(InputError, match="File exists"):
        open_run(taken, run)
    with pytest.raises(InputError, match="Not a directory"):
        open_run(taken / "below", run)
    with pytest.raises(InputError, match="NUL"):
        open_run(tmp_path / "a\0b", run)
    with pytest.raises(InputError, match="too long"):
        open_run(tmp_path / ("x" * 300), run)


@pytest.mark.parametrize(
    "name", ["metrics.json", "capture.nc", "spectra.png", "a_scene.png", "run.toml", "unfinished"]
)
def test_files_of_others_are_refused_before_a_run_starts(tmp_path, name):
    (tmp_path / name).write_text("mine")
    (tmp_path / "notes.txt").write_text("mine")
    for overwrite in (False, True):
        with pytest.raises(InputError, match=name):
            open_run(tmp_path, {"a": to_toml(make_run())}, overwrite=overwrite)
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {
        name: "mine",
        "notes.txt": "mine",
    }


def test_a_folder_or_a_link_in_the_place_of_a_result_stays(tmp_path):
    out, victim = tmp_path / "out", tmp_path / "victim"
    victim.write_text("mine")
    with open_run(out, {"a": to_toml(make_run())}) as folder:
        folder.write_bytes("raw/capture.bin", b"1")
    for place in (out / "metrics.json", out / "raw" / "capture.bin"):
        place.unlink(missing_ok=True)
        place.mkdir()
        with pytest.raises(InputError, match="which no run has written"):
            whole_run(out, {"raw/capture.bin": "2"}, overwrite=True)
        place.rmdir()
    (out / "raw").rmdir()
    (out / "raw").symlink_to(tmp_path)
    with pytest.raises(InputError, match="raw"):
        open_run(out, {"a": to_toml(make_run())}, overwrite=True)
    assert victim.read_text() == "mine"


def test_a_file_that_appears_during_a_run_stays_and_the_run_too(tmp_path):
    with pytest.raises(InputError, match=r"own\.txt"):
        whole_run(
            tmp_path, {"own.txt": "result"}, lambda: (tmp_path / "own.txt").write_text("mine")
        )
    assert (tmp_path / "own.txt").read_text() == "mine"
    (tmp_path / "own.txt").unlink()
    with open_run(tmp_path, {"a": to_toml(make_run())}, resume=True) as folder:
        assert folder.complete
    assert (tmp_path / "own.txt").read_text() == "result"


@pytest.mark.parametrize(
    "name",
    [
        *("../victim", "/victim", "a/../../victim", "", "link/victim"),
        *("parts/start0.json" + "n" * 300, "\ud800"),
    ],
)
@pytest.mark.parametrize("where", ["files", "unfinished"])
def test_a_manifest_of_strangers_reaches_nothing_outside(tmp_path, name, where):
    victim, out = tmp_path / "victim", tmp_path / "out"
    victim.write_text("mine")
    out.mkdir()
    for folder in (out, out / UNFINISHED):
        folder.mkdir(exist_ok=True)
        (folder / "link").symlink_to(tmp_path)
    name = f"/{victim}" if name == "/victim" else name
    work = {"digest": "", "owner": "", "files": [name], "complete": True}
    manifest = {"files": [name]} if where == "files" else {"unfinished": work}
    (out / MANIFEST).write_text(json.dumps(manifest))
    for flags in ({"overwrite": True}, {"resume": True}, {}):
        with pytest.raises(InputError):
            open_run(out, {"a": to_toml(make_run())}, **flags)
    assert victim.read_text() == "mine"


@pytest.mark.parametrize("text", ["[" * 100_000, '{"files": [1]}', "1" * 5000, "\0", '{"files": 3'])
def test_a_damaged_manifest_is_an_input_error(tmp_path, text):
    (tmp_path / MANIFEST).write_text(text)
    with pytest.raises(InputError, match="damaged"):
        open_run(tmp_path, {"a": to_toml(make_run())}, overwrite=True)


def test_a_second_run_is_refused_with_the_first_ones_process(tmp_path):
    with open_run(tmp_path, {"a": to_toml(make_run())}) as folder:
        folder.write_json("metrics.json", {"x": 1})
        for flags in ({"overwrite": True}, {"resume": True}, {}):
            with pytest.raises(InputError, match=f"process {os.getpid()} on "):
                open_run(tmp_path, {"a": to_toml(make_run())}, **flags)
    assert sorted(p.name for p in tmp_path.iterdir()) == [MANIFEST, "metrics.json", "run.toml"]
    (tmp_path / LOCK).write_text("mine")
    with pytest.raises(InputError, match=LOCK):
        open_run(tmp_path, {"a": to_toml(make_run())}, overwrite=True)
    assert (tmp_path / LOCK).read_text() == "mine"


def test_a_run_that_died_while_its_files_moved_is_finished_by_the_next(tmp_path, monkeypatch):
    with open_run(tmp_path, {"a": to_toml(make_run())}) as folder:
        folder.write_text("old.txt", "old")
        folder.write_text("metrics.json", "old")
    moves, replace = [], os.replace

    def dying(source, target):
        if UNFINISHED in str(source) and ".part" not in str(source):
            moves.append(target)
            if len(moves) > 1:
                raise KeyboardInterrupt
        replace(source, target)

    files = {"metrics.json": "new", "report.html": "new"}
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        whole_run(tmp_path, files, lambda: patched.setattr(os, "replace", dying), overwrite=True)
    assert (tmp_path / UNFINISHED / "report.html").exists()
    with pytest.raises(InputError, match="without results"):
        open_run(tmp_path, {"a": to_toml(make_run())})
    found = {p.name: p.read_text() for p in tmp_path.glob("[!.]*")}
    assert found.pop("run.toml").startswith("task")
    assert found == files


def test_a_full_disk_is_one_line_and_leaves_what_was_there(tmp_path, monkeypatch):
    with open_run(tmp_path, {"a": to_toml(make_run())}) as folder:
        folder.write_text("metrics.json", "old")
    before = {p.name: p.read_text() for p in tmp_path.iterdir()}
    full = OSError(errno.ENOSPC, "No space left on device", "report.html")
    with pytest.raises(InputError, match="No space left") as caught:
        broken_run(tmp_path, lambda _: full, {"metrics.json": "new"}, overwrite=True)
    assert "--resume" not in str(caught.value)
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == before
    with pytest.raises(InputError, match="--resume goes on"):
        broken_run(tmp_path, lambda _: full, {"checkpoint.pt": "half"}, overwrite=True)
    assert (tmp_path / "metrics.json").read_text() == "old"
    with open_run(tmp_path, {"a": to_toml(make_run())}, resume=True) as folder:
        assert folder.file("checkpoint.pt").read_text() == "half"
    assert (tmp_path / "checkpoint.pt").read_text() == "half"
    assert not (tmp_path / "metrics.json").exists()


def test_several_run_files_are_kept_by_stem(tmp_path):
    with open_run(tmp_path, {"a": to_toml(make_run()), "b": to_toml(make_run(seed=1))}):
        pass
    assert sorted(p.name for p in (tmp_path / "runs").iterdir()) == ["a.toml", "b.toml"]


def test_metrics_are_plain_json(tmp_path):
    value = {"a": np.float64(1.5), "b": [np.int64(2), float("nan")], "c": np.eye(2), "d": tmp_path}
    assert to_json_value(value) == {
        "a": 1.5,
        "b": [2, None],
        "c": [[1.0, 0.0], [0.0, 1.0]],
        "d": str(tmp_path),
    }


def test_a_part_that_was_never_written_leaves_no_folder(tmp_path):
    """A search that is not interrupted writes no checkpoint; the folder may be overwritten."""
    out = tmp_path / "out"
    for flags in ({}, {"overwrite": True}):
        with open_run(out, {"a": to_toml(make_run())}, **flags) as folder:
            assert not folder.file(f"{PARTS}/search.json").exists()
            folder.write_bytes("metrics.json", b"{}")
        assert not (out / UNFINISHED).exists()
