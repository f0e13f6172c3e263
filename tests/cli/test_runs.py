"""Run folders: nothing is lost, half a file never appears, run files come back as they were."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

from invertwin.cli.run_file import to_toml, validate
from invertwin.cli.runs import PREVIOUS, open_run, plain
from invertwin.cli.schema import RunFile
from invertwin.errors import InputError


def make_run(**changes) -> RunFile:
    material = {"kind": "rough_dielectric", "permittivity": 4.0}
    raw = {
        "task": "reconstruct",
        "title": 'A "quoted" title \\ with ✓ and \u007f',
        "scene": {
            "letter one": {"shape": "text", "text": "A", "material": material},
            "slits": {
                "parts": [{"shape": "plate", "width": 1, "height": 2.5e-3}],
                "material": {"kind": "perfect_conductor"},
            },
        },
        "truth": {"letter one": {"position": [0.1, 0, 2]}},
        "parameters": [{"kind": "pose", "object": "letter one"}],
        "radar": {
            "waveform": {"kind": "impulse", "center_frequency": 4e9, "bandwidth": 1.4e9},
            "transmitters": {"kind": "positions", "positions": [[0, 0, 0]]},
            "receivers": {"kind": "linear", "count": 16, "spacing": 1.9e-3},
            "positions": {"kind": "line", "start": [0, 0, 0], "stop": [1, 0, 0], "count": 3},
            "orientation": {"look_at": [0, 0, 2.5]},
        },
    }
    return validate(raw | changes, Path("run.toml"))


def broken_run(path, error, files, **flags):
    """A run that writes some files and then ends with an error."""
    with open_run(path, {"a": make_run()}, **flags) as folder:
        for name, text in files.items():
            folder.write_text(name, text)
        raise error("broken")


def test_run_file_as_used_reads_back_equal():
    run = make_run(seed=7)
    assert validate(tomllib.loads(to_toml(run)), Path("elsewhere/run.toml")) == run


def test_a_complete_folder_is_refused_without_a_flag(tmp_path):
    out = tmp_path / "deep" / "out"
    with open_run(out, {"a": make_run()}) as folder:
        folder.write_json("metrics.json", {"x": 1.0})
    assert sorted(p.name for p in out.iterdir()) == [".invertwin.json", "metrics.json", "run.toml"]
    with pytest.raises(InputError, match="--overwrite"):
        open_run(out, {"a": make_run()})


def test_results_without_a_manifest_are_refused_too(tmp_path):
    (tmp_path / "metrics.json").write_text("{}")
    with pytest.raises(InputError, match=r"metrics\.json"):
        open_run(tmp_path, {"a": make_run()})


def test_overwrite_replaces_own_files_and_leaves_the_users(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with open_run(tmp_path, {"a": make_run()}) as folder:
        folder.write_json("metrics.json", {"x": 1})
        folder.write_bytes("old.png", b"old")
    with open_run(tmp_path, {"a": make_run()}, overwrite=True) as folder:
        folder.write_json("metrics.json", {"x": 2})
    assert json.loads((tmp_path / "metrics.json").read_text()) == {"x": 2}
    assert not (tmp_path / "old.png").exists()
    assert not (tmp_path / PREVIOUS).exists()
    assert (tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("error", [InputError, KeyboardInterrupt, RuntimeError])
def test_failed_overwrite_puts_the_results_back(tmp_path, error):
    with open_run(tmp_path, {"a": make_run()}) as folder:
        folder.write_json("metrics.json", {"x": 1})
        folder.write_bytes("pictures/old.png", b"old")
    with pytest.raises(error):
        broken_run(tmp_path, error, {"metrics.json": "{}"}, overwrite=True)
    assert json.loads((tmp_path / "metrics.json").read_text()) == {"x": 1}
    assert (tmp_path / "pictures" / "old.png").read_bytes() == b"old"
    assert not (tmp_path / PREVIOUS).exists()
    with pytest.raises(InputError, match="--overwrite"):
        open_run(tmp_path, {"a": make_run()})


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
        broken_run(tmp_path, KeyboardInterrupt, {"checkpoint.pt": "state", "starts.json": "[1]"})
    with pytest.raises(InputError, match=r"run\.toml"):
        open_run(tmp_path, {"a": make_run(seed=3)}, resume=True)
    with open_run(tmp_path, {"a": make_run()}, resume=True) as folder:
        assert folder.resumed
        assert folder.read_json("starts.json") == [1]
        assert folder.read_json("metrics.json") is None
        folder.remove(["starts.json"])
    assert not (tmp_path / "starts.json").exists()


def test_interrupted_overwrite_keeps_both_until_it_ends(tmp_path):
    with open_run(tmp_path, {"a": make_run()}) as folder:
        folder.write_json("metrics.json", {"x": 1})
    with pytest.raises(KeyboardInterrupt):
        broken_run(tmp_path, KeyboardInterrupt, {"checkpoint.pt": "state"}, overwrite=True)
    assert json.loads((tmp_path / PREVIOUS / "metrics.json").read_text()) == {"x": 1}
    with pytest.raises(RuntimeError):
        broken_run(tmp_path, RuntimeError, {}, overwrite=True)
    assert json.loads((tmp_path / "metrics.json").read_text()) == {"x": 1}


def test_nothing_to_resume_both_flags_and_a_file_in_the_way_are_input_errors(tmp_path):
    taken = tmp_path / "file"
    taken.write_text("")
    run = {"a": make_run()}
    with pytest.raises(InputError, match="interrupted"):
        open_run(tmp_path / "none", run, resume=True)
    with pytest.raises(InputError, match="both"):
        open_run(tmp_path / "none", run, resume=True, overwrite=True)
    with pytest.raises(InputError, match="file"):
        open_run(taken, run)
    with pytest.raises(InputError, match="can be made"):
        open_run(taken / "below", run)


def test_several_run_files_are_kept_by_stem(tmp_path):
    with open_run(tmp_path, {"a": make_run(), "b": make_run(seed=1)}):
        pass
    assert sorted(p.name for p in (tmp_path / "runs").iterdir()) == ["a.toml", "b.toml"]


def test_metrics_are_plain_json(tmp_path):
    value = {"a": np.float64(1.5), "b": [np.int64(2), float("nan")], "c": np.eye(2), "d": tmp_path}
    assert plain(value) == {
        "a": 1.5,
        "b": [2, None],
        "c": [[1.0, 0.0], [0.0, 1.0]],
        "d": str(tmp_path),
    }
