"""The corner reflector of `experiments/corner_pose.toml`: power first, then phase, by an axis."""

import pytest

from cli.small import call, read_metrics


@pytest.mark.slow
def test_a_corner_is_found_but_for_its_roll(repository, tmp_path, monkeypatch):
    text = (repository / "experiments" / "corner_pose.toml").read_text(encoding="utf-8")
    file = tmp_path / "corner.toml"
    file.write_text(text.replace("count = 10", "count = 1"), encoding="utf-8")
    assert call(monkeypatch, "reconstruct", file, "-o", tmp_path / "out") == 0
    metrics = read_metrics(tmp_path / "out")
    assert metrics["start_distance_m"] > 0.03
    assert metrics["success"]
    assert metrics["position_error_m"] < 1e-4
    assert metrics["rotation_error_deg"] < 0.5
    assert metrics["verdict"] == "consistent"
    # The whole turn is another matter: its roll is not observed.
    (row,) = metrics["starts"]
    assert row["turn_error_deg"] > metrics["rotation_error_deg"]
    (told,) = metrics["unobserved"]
    assert told.startswith("corner.roll: not observed")


@pytest.mark.slow
def test_a_plan_takes_the_model_of_the_last_stage(repository, tmp_path, monkeypatch):
    file = repository / "experiments" / "corner_pose.toml"
    assert call(monkeypatch, "plan", file, "-o", tmp_path / "out") == 0
    metrics = read_metrics(tmp_path / "out")
    # Powers tell the place to a millimetre, phases to less than a tenth.
    assert metrics["standard_deviations"]["corner.z"] < 2e-4
    assert metrics["unobserved"][0].startswith("corner.roll")
