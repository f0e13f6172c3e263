"""The command for the day of a GPU: what it says without one, and parts that fail."""

import json
import subprocess
import sys

import pytest


def test_without_a_gpu_it_says_what_it_would_do(gpu, monkeypatch, capsys):
    monkeypatch.setattr(gpu.doctor, "gpu_name", lambda: None)
    monkeypatch.setattr(sys, "argv", ["gpu.py"])
    assert gpu.main() == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("expected an NVIDIA GPU, got no CUDA device")
    assert all(part in line for part in gpu.PARTS)
    assert "480 s" in line


def test_a_part_that_fails_leaves_the_others(gpu, monkeypatch, tmp_path, capsys):
    given = {}

    def run_part(name, device, seconds):
        given[name] = seconds
        return {"map": 2e-3} if name == "agreement" else "stopped after 7 s"

    monkeypatch.setattr(gpu, "run_part", run_part)
    monkeypatch.setattr(gpu.doctor, "gpu_name", lambda: "A GPU")
    monkeypatch.setattr(sys, "argv", ["gpu.py", "-o", str(tmp_path)])
    assert gpu.main() == 1
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["device"] == "A GPU"
    assert metrics["agreement"] == {"map": 2e-3}
    assert metrics["failed"] == dict.fromkeys(list(gpu.PARTS)[1:], "stopped after 7 s")
    assert 0 < given["tests"] <= given["agreement"] <= gpu.LIMIT
    shown = capsys.readouterr().out
    assert "<= 0.001 NO" in shown
    assert "stopped after 7 s" in shown


@pytest.mark.parametrize(
    ("outcome", "expected"),
    [
        (subprocess.CompletedProcess([], 0, 'progress\n{"seconds": 1.5}\n', ""), {"seconds": 1.5}),
        (subprocess.CompletedProcess([], 1, "", "Traceback\nInputError: no"), "InputError: no"),
        (subprocess.TimeoutExpired("gpu.py", 7.0), "stopped after 7 s"),
    ],
)
def test_a_part_runs_on_the_device_and_tells_why_it_failed(gpu, monkeypatch, outcome, expected):
    def run(command, env, timeout, **_):
        assert command[-4:] == ["--part", "rcs", "--device", "cuda"]
        assert env["INVERTWIN_BACKEND"] == "cuda"
        assert timeout == 7.0
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    monkeypatch.setattr(gpu.subprocess, "run", run)
    assert gpu.run_part("rcs", "cuda", 7.0) == expected


@pytest.mark.slow
def test_two_backends_that_are_one_agree(gpu):
    found = gpu.agreement("cpu", small=True)
    assert set(found) == {"map", "gradient", "two_bounce_map", "two_bounce_gradient", "rcs", "fit"}
    assert max(found.values()) < 1e-3
