"""Growth in small: exponents of known powers, and points of fresh processes."""

import json

import pytest


def test_exponents_of_known_powers(growth):
    sizes = [10, 40, 160]
    assert growth.exponent(sizes, [3.0 * size**1.5 for size in sizes]) == pytest.approx(1.5)
    assert growth.exponent(sizes, [7.0] * 3) == pytest.approx(0.0)


def test_table_shows_sizes_and_limits(growth):
    found = {"sizes": [80_000, 320_000], "seconds": [1.0, 8.0], "memory_mb": [10.0, 40.0]}
    found |= {"time_exponent": 1.5, "memory_exponent": 1.0}
    metrics = {"backend": "cpu", "load_average": 0.0, "growth": {"triangles": found}}
    grid = growth.table(metrics).grid
    columns = [list(column.cells) for column in grid.columns]
    assert columns[0] == ["triangles.time_exponent", "triangles.memory_exponent"]
    assert columns[2] == ["<= 1.1 NO", "<= 1.1 yes"]
    assert columns[3][0] == "1, 8 s at 80 000, 320 000"


@pytest.mark.slow
def test_points_of_fresh_processes(growth, tmp_path):
    metrics = growth.measure(axes=("receivers",), shrink=100)
    found = metrics["growth"]["receivers"]
    assert found["sizes"] == [80, 320, 1280]
    assert all(0 < seconds < 60 for seconds in found["seconds"])
    assert min(found["memory_mb"]) >= 1.0
    growth.write(metrics, growth.table(metrics).grid, tmp_path)
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
