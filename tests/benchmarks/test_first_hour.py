"""The benchmark of the first hour: it edits files as a newcomer does, and counts what fails."""

import os
import sys

import pytest


@pytest.fixture
def user(first_hour, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    return first_hour.Newcomer(tmp_path)


def test_an_edit_replaces_lines_that_begin_so(user):
    (user.folder / "old.toml").write_text("a = 1\nb = 2\n# c\n")
    user.edits("old.toml", "new.toml", {"b = ": "b = 3", "# c": "c = 4"})
    assert user.reads("new.toml") == "a = 1\nb = 3\nc = 4\n"
    with pytest.raises(AssertionError, match=r"no line of old\.toml begins with d"):
        user.edits("old.toml", "new.toml", {"d": ""})


def test_a_command_that_ends_otherwise_fails(user):
    assert "invertwin" in user.types("--version")
    with pytest.raises(AssertionError, match=r"no file none\.toml"):
        user.types("simulate", "none.toml")
    assert "no file" in user.types("simulate", "none.toml", code=2)


def test_steps_that_fail_are_counted_and_the_others_go_on(first_hour, monkeypatch):
    def fails(user) -> None:
        assert user.found.get("twin_error_m") == 0.25, "not found"

    def finds(user) -> None:
        user.found["twin_error_m"] = 0.5

    monkeypatch.setattr(first_hour, "STEPS", {"fails": fails, "finds": finds})
    found = first_hour.measure(["fails", "finds"])
    assert found["failed_steps"] == 1
    assert found["failures"]["fails"].startswith("AssertionError: not found")
    assert found["twin_error_m"] == 0.5
    assert found["headline_over_bar"] is None


@pytest.mark.slow
def test_the_files_of_new_take_a_mesh_and_a_board(first_hour, user):
    for step in ("writes_files", "draws_mesh", "misspells", "simulates", "looks"):
        first_hour.STEPS[step](user)
    assert user.found["look_error_m"] < 0.05
