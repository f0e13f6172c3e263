"""The benchmark of searches measures processor time of every row once."""

import pytest


def test_rows_in_common_are_measured_once(twin_cost, monkeypatch):
    calls = []

    def run(call, **_):
        row = [int(number) for number in call[3:]]
        calls.append(row)
        text = f'progress\n{{"seconds": {row[0] ** 1.5 * row[1]}, "found": 1, "memory_gb": 0.5}}\n'
        return type("Finished", (), {"stdout": text})

    monkeypatch.setattr(twin_cost.subprocess, "run", run)
    metrics = twin_cost.measure([8, 16], [64, 128], [2, 3])
    assert calls == [[8, 128, 2], [16, 128, 2], [16, 64, 2], [16, 128, 3]]
    assert metrics["positions_exponent"] == pytest.approx(1.5)
    assert metrics["samples_exponent"] == pytest.approx(1.0)
    assert metrics["positions_16_seconds"] == metrics["samples_128_seconds"]
    assert metrics["found_share"] == 4 / 9
    assert metrics["memory_gb"] == 0.5


@pytest.mark.slow
def test_a_box_in_front_of_six_positions_is_found(twin_cost):
    found = twin_cost.search(6, 128, 1)
    assert found["found"] == 1
    assert 1.0 < found["seconds"] < 600.0
    assert 0.1 < found["memory_gb"] < 8.0
