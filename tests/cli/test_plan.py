"""Plans: what a run file's radar would tell, and which position to add, before any recording."""

import pytest

from cli.small import RUN, call, read_metrics

PLANE = RUN.replace('object = "plate"\n', 'object = "plate"\naxes = ["x", "y"]\n', 1)
PLAN = """
[plan]
fits = 3
candidates = [[0.0, 0.1, 0.0], [0.0, -0.2, 0.1]]

[loss]
kind = "likelihood"
"""


@pytest.mark.claim
@pytest.mark.slow
def test_a_plan_states_error_bars_and_ranks_positions(run_file, monkeypatch, capsys):
    run_file.write_text(PLANE + PLAN)
    assert call(monkeypatch, "plan", run_file, "-o", "out") == 0
    metrics = read_metrics(run_file.parent / "out")
    names = ["plate.x", "plate.y"]
    assert list(metrics["standard_deviations"]) == names
    assert metrics["units"] == {"plate.x": "m", "plate.y": "m"}
    # Range cells of 75 mm: range is told to a fraction of them, the place across less well.
    assert 1e-4 < metrics["standard_deviations"]["plate.x"] < 0.03
    assert metrics["standard_deviations"]["plate.y"] > metrics["standard_deviations"]["plate.x"]
    first, second = metrics["candidates"]
    # A position that is there already shares its speckle; one elsewhere is new.
    assert first["position"] == pytest.approx([0.0, -0.2, 0.1])
    assert first["share"] < second["share"]
    assert metrics["simulated_fits"] == 3
    for name in names:
        ratio = metrics["standard_deviations"][name] / metrics["observed_deviations"][name]
        assert metrics["predicted_over_observed"][name] == pytest.approx(ratio)
    said = capsys.readouterr().out
    assert "Expected error bars" in said
    assert "Positions to add" in said
    ends = f"times {first['share']:.2f}; 2 parameters, 0 directions not observed"
    assert (
        metrics["answer"]
        == f"Best position to add (0.00, -0.20, 0.10) m: standard deviations {ends}"
    )
    assert metrics["answer"] in said


def test_a_plan_of_measured_data_is_refused(run_file, monkeypatch, capsys):
    text = RUN.split("[data]")[0] + '[data]\nkind = "capture"\nfile = "none.nc"\n'
    run_file.write_text(text + "[[parameters]]" + RUN.split("[[parameters]]")[1])
    assert call(monkeypatch, "plan", run_file) == 2
    assert 'expected "simulated" for a plan' in capsys.readouterr().err
