"""The benchmark of starting measures processor time, and its load ends with it."""

import os
import sys
import time
import tomllib

import pytest


def test_the_demo_has_the_steps_asked_for(starting, tmp_path):
    run = tomllib.loads(starting.demo(tmp_path, 7).read_text())
    assert run["reconstruct"]["steps"] == 7
    assert run["task"] == "demo"


def test_the_load_is_there_and_gone_afterwards(starting, monkeypatch):
    monkeypatch.setattr(starting.shutil, "which", lambda _: None)
    begun = os.times()
    with starting.busy(2) as kind:
        time.sleep(1.0)
    used = os.times().children_user - begun.children_user
    assert kind == "python"
    assert used > 0.1


@pytest.mark.slow
def test_the_version_costs_little_processor_time(starting, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    wall, used = starting.taken(["--version"])
    assert 0 < used <= 1.0  # `benchmarks/starting.py` has the limit, on a machine of its own
    assert wall > 0


def test_every_command_with_a_file_is_refused_in_every_way(starting, tmp_path):
    from invertwin.cli.app import app

    cases = starting.refusals(tmp_path)
    commands = {getattr(one.callback, "__name__", "") for one in app.registered_commands}
    assert {case.split()[0] for case in cases} == commands - {"new", "demo", "keys", "doctor"}
    assert len(cases) == 3 * 10 + 2 - 1  # `view` has no board, `convert` reads none
    assert (tmp_path / "empty").is_dir()


@pytest.mark.slow
@pytest.mark.parametrize("case", ["convert folder", "view missing", "twin board"])
def test_a_refusal_ends_with_code_2(starting, monkeypatch, tmp_path, case):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    assert starting.taken(starting.refusals(tmp_path)[case], code=2)[1] > 0
