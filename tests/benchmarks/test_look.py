"""The benchmark of faulty recordings: what it draws has the faults it says."""

import json
import sys

import numpy as np
import pytest
import torch


def test_a_short_run_is_written(look, tmp_path, monkeypatch, capsys):
    arguments = ["look.py", "-o", str(tmp_path), "--recordings", "7", "--seed", "5"]
    monkeypatch.setattr(sys, "argv", arguments)
    look.main()
    found = json.loads((tmp_path / "metrics.json").read_text())
    assert found["recordings"] == 7
    assert set(found["detected_by"]) == set(look.FAULTS)
    assert found["detected"] >= 6 / 7
    assert found["false_alarms"] <= 1 / 7
    assert "detected" in capsys.readouterr().out


@pytest.mark.parametrize("scene", ["one", "movers", "objects"])
def test_recordings_are_their_seeds(look, scene):
    cases = [look.drawn(scene, np.random.default_rng(3), sound=True) for _ in range(2)]
    assert torch.equal(cases[0].beat, cases[1].beat)
    settings = cases[0].settings
    assert cases[0].beat.shape[-1] == settings.samples
    assert cases[0].beat.shape[1] == settings.loops


def test_faults_are_what_they_say(look):
    case = look.drawn("one", np.random.default_rng(3), sound=False)
    before = case.beat.clone()
    assert look.broken(case, np.random.default_rng(1))
    turned = (case.beat / before).angle().abs()
    assert 45 - 1e-6 <= float(torch.rad2deg(turned.max())) <= 180 + 1e-6
    case.beat = before
    assert look.clipped(case, np.random.default_rng(1))
    assert case.headroom < 1
    data = look.digitised(case)
    top = 2 ** (case.settings.bits - 1) - 1
    assert float((data.samples.real >= top).double().mean()) > 0.002
