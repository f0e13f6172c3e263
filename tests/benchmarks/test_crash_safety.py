"""The benchmark of kills sees what is lost."""

import json
import math

import numpy as np
import pytest


def test_results_are_what_is_not_in_progress(crash_safety, tmp_path):
    for name in ("metrics.json", "runs/a.toml", "unfinished/metrics.json", ".invertwin.json"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    assert set(crash_safety.results(tmp_path)) == {"metrics.json", "runs/a.toml"}


def test_difference_is_the_largest_of_a_number(crash_safety, tmp_path):
    rows = [{"values": {"ball.translation": [0.1, 0.2]}}, {"values": {"ball.translation": [0, 1]}}]
    (tmp_path / "metrics.json").write_text(json.dumps({"starts": rows}))
    whole = [np.array([0.1, 0.2]), np.array([0.0, 1.5])]
    assert crash_safety.difference(tmp_path, whole) == pytest.approx(0.5)
    assert crash_safety.difference(tmp_path, whole[:1]) == math.inf


@pytest.mark.slow
def test_a_killed_fit_goes_on_and_two_at_once_do_not_mix(crash_safety, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", crash_safety.os.pathsep.join(crash_safety.sys.path))
    case = crash_safety.Case("stages", tmp_path)
    # On a busy machine the fit may end before it is killed.
    for share in (0.8, 0.5, 0.3):
        killed, lost, apart = case.killed(share)
        if killed:
            break
    assert killed
    assert not lost
    assert apart <= 1e-6
    assert not case.together(0.5)
