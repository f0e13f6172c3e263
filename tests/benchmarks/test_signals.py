"""The signals benchmark in small: the library's sums are right, and the oracle finds wrong ones."""

import json
from dataclasses import replace

import pytest
import torch
from rich.console import Console

from invertwin.radar import beat_signal, moving_beat


def test_every_metric_is_there_and_holds(signals):
    metrics = signals.measure(paths=2_000, chirps=2, points=5, repeats=1)
    json.dumps(metrics)
    for name, (_, limit) in signals.REQUIRED.items():
        group, key = name.split(".")
        assert 0 < metrics[group][key] <= limit
    assert metrics["nufft"]["time_ratio"] > 1
    console = Console(width=200, record=True)
    console.print(signals.table(metrics))
    assert "NO" not in console.export_text()


@pytest.mark.parametrize("name", ["accelerating", "rotating"])
def test_the_oracle_sees_motion_that_is_left_out(signals, name):
    """Points that keep their first velocity, or stand still over each ramp, fail by far."""
    case = signals.case(name, chirps=3, points=5)
    expected = case.oracle()

    def error(signal):
        return float((signal - expected).norm() / expected.norm())

    assert error(case.signal()) < 1e-6
    start = case._at(0.0)
    paths = signals.point_paths(case.radar, start, case.coefficient)
    velocity = (case._at(1e-7) - case._at(-1e-7)) / 2e-7
    uniform = moving_beat(replace(paths, velocity=velocity), case.radar, case.chirps)
    assert error(uniform) > 0.003
    stepped = torch.zeros_like(expected)
    for chirp, starts in enumerate(case.chirps.times(3).tolist()):
        for tx, time in enumerate(starts):
            there = signals.point_paths(case.radar, case._at(time), case.coefficient)
            stepped[:, chirp, tx] = beat_signal(there, case.radar)[:, tx]
    assert error(stepped) > 0.1
