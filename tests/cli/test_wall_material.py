"""The run file of a wall's permittivity, in small."""

import pytest

from cli.small import call, read_metrics


@pytest.mark.claim
@pytest.mark.slow
def test_permittivity_of_a_wall_beside_a_panel(repository, tmp_path, monkeypatch):
    text = (repository / "experiments" / "wall_material.toml").read_text(encoding="utf-8")
    for whole, part in (
        ("count = [8, 4]", "count = [4, 2]"),
        ("count = [16, 8]", "count = [8, 4]"),
        ("points_per_m2 = 4e3", "points_per_m2 = 2e3"),
        ("steps = 50", "steps = 30"),
    ):
        assert whole in text
        text = text.replace(whole, part)
    file = tmp_path / "small.toml"
    file.write_text(text, encoding="utf-8")
    assert call(monkeypatch, "reconstruct", file, "--out", tmp_path / "found") == 0
    # It starts 0.79 off, and has a quarter of the looks.
    assert read_metrics(tmp_path / "found")["permittivity_error"] < 0.25
