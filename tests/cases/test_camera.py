"""The case of a camera beside a radar: its summary, its start, and one short fit."""

import json
from pathlib import Path
from types import ModuleType

import pytest

from cases.loading import loaded


@pytest.fixture(scope="module")
def case() -> ModuleType:
    return loaded("camera", "run")


def row(position: float, yaw: float, scale: float) -> dict[str, float]:
    return {"position": position, "yaw": yaw, "scale": scale}


def test_ratios_are_of_medians_by_the_better_sensor(case: ModuleType):
    rows = [
        {"start": row(1, 9, 1), "camera": row(c, 4, 0.1), "radar": row(r, 2, 0.4), "both": both}
        for c, r, both in (
            (0.1, 0.2, row(0.01, 1, 0.05)),
            (0.3, 0.5, row(0.06, 3, 0.02)),
            (0.4, 0.2, row(0.09, 1, 0.03)),
        )
    ]
    found = case.summary(rows)
    assert found["error_ratio"] == pytest.approx(0.06 / 0.2)
    assert found["yaw_ratio"] == pytest.approx(1 / 2)
    assert found["scale_ratio"] == pytest.approx(0.03 / 0.1)


def test_scenes_repeat_and_starts_are_off(case: ModuleType):
    first, again = case.view(3), case.view(3)
    start = case.errors(first.start, first)
    assert 0.02 < start["position"] < 0.6
    assert start == case.errors(again.start, again)
    assert case.errors(first.truth, first) == {"position": 0.0, "yaw": pytest.approx(0, abs=1e-4)}
    assert bool((first.picture.labels == again.picture.labels).all())


@pytest.mark.slow
def test_both_sensors_bring_a_crate_nearer(case: ModuleType, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(case, "STEPS", 60)
    seen = case.view(1000)
    found = case.fit(seen, "both", 0)
    assert found["position"] < 0.06
    assert found["scale"] < 0.05


def test_an_interrupted_run_goes_on(case: ModuleType, tmp_path: Path, monkeypatch):
    done: list[int] = []

    def trial(seed: int) -> dict[str, int]:
        done.append(seed)
        return {"seed": seed}

    monkeypatch.setattr(case, "trial", trial)
    file = tmp_path / "scenes.jsonl"
    file.write_text(json.dumps({"seed": 0}) + "\n", encoding="utf-8")
    assert case.trials(3, file) == [{"seed": 0}, {"seed": 1}, {"seed": 2}]
    assert done == [1, 2]
    assert len(file.read_text(encoding="utf-8").splitlines()) == 3
