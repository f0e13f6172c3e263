"""The benchmark of verdicts in small: errors know symmetries, and rows are counted and kept."""

import json
import math

import pytest
import torch

from invertwin.inversion import displace


def test_a_turn_that_brings_an_object_back_is_no_error(verdicts):
    none = torch.zeros(3, dtype=torch.float64)
    for number, wrong in ((0, math.pi), (1, 0.0), (2, 0.0), (3, math.pi)):
        trial = verdicts.Trial.draw(number)
        item = displace(trial.truth["object"], none, math.pi * verdicts.UP)
        distance, angle = trial.error(trial.truth.replace("object", pose=item.pose))
        assert distance == pytest.approx(0.0, abs=1e-9)
        assert angle == pytest.approx(wrong, abs=1e-6), trial.kind


def test_starts_are_up_to_a_metre_off(verdicts):
    trials = [verdicts.Trial.draw(number) for number in range(40)]
    away = [float((t.start.center - t.truth["object"].center).norm()) for t in trials]
    assert 0.0 < min(away) < 0.2
    assert 0.8 < max(away) <= 1.0
    assert {t.kind for t in trials} == set(verdicts.KINDS)


def row(number, right, word, first):
    return {
        "number": number,
        "fit": {"right": right, "word": word},
        "search": {"right": first, "word": word},
        "seconds": 1.0,
    }


def test_shares_are_those_of_right_and_of_wrong_ends(verdicts):
    found = [
        row(0, True, "consistent", True),
        row(1, True, "inconsistent", True),
        row(2, False, "ambiguous", False),
        row(3, False, "consistent", True),
        row(4, False, "inconsistent", True),
    ]
    metrics = verdicts.measure(found)
    assert metrics["right_called_consistent"] == pytest.approx(1 / 2)
    assert metrics["wrong_called_consistent"] == pytest.approx(1 / 3)
    assert metrics["right_first_with_starts"] == pytest.approx(4 / 5)


def test_rows_that_are_kept_are_not_done_again(verdicts, tmp_path, monkeypatch):
    kept = row(0, True, "consistent", True) | {"settings": verdicts.SETTINGS}
    other = row(1, True, "consistent", True) | {"settings": "of another code"}
    lines = [json.dumps(kept), json.dumps(other), '{"number": 2, "broken']
    (tmp_path / "rows.jsonl").write_text("\n".join(lines) + "\n")
    done = []

    def new(trial):
        done.append(trial.number)
        ends = {"error": (0.0, 0.0)}
        made = row(trial.number, True, "consistent", True)
        made = {k: {**v, **ends} if isinstance(v, dict) else v for k, v in made.items()}
        return made | {"kind": trial.kind, "settings": verdicts.SETTINGS}

    monkeypatch.setattr(verdicts.Trial, "row", new)
    assert len(list(verdicts.rows(tmp_path, 3))) == 3
    assert done == [1, 2]
    assert len(list(verdicts.rows(tmp_path, 3))) == 3
    assert done == [1, 2]
