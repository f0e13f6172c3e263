"""Callbacks: rows are complete, watching changes nothing, a fit goes on in a new process."""

import math
import os
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from fits import fit
from invertwin.channel import Sampling
from invertwin.errors import InputError
from invertwin.inversion import (
    Checkpoint,
    Observation,
    Report,
    Schedule,
    SpectrumLoss,
    Watch,
    reconstruct,
)
from invertwin.inversion.fit import _restore_optimizer
from invertwin.inversion.regularization import Laplacian
from invertwin.models.radar import SurrogateMap
from invertwin.scene import RoughDielectric
from invertwin.scene.parameters import Vertices

FAST: dict[str, Any] = {"steps": 4, "samples": 2_000, "boundary_samples": 500}
FEW = Sampling(depth=1, samples=2_000, boundary_samples=500)


def test_a_report_gets_complete_rows_whatever_the_order(case):
    rows: list[dict[str, Any]] = []
    settings = case.settings(**FAST)
    found = reconstruct(
        case.scene,
        Observation(
            SurrogateMap(case.grid, sampling=Sampling(1, 2_000, 500)),
            case.capture,
            sensor=case.radar,
        ),
        case.parameters(),
        optimizer=settings["optimizer"],
        schedule=Schedule(4),
        callbacks=[Report(rows.append), Watch(lambda scene: {"x": 1.0}, every=2)],
        seed=1,
    )
    assert rows == found.history
    assert [row.get("x") for row in rows] == [None, 1.0, None, 1.0]


def test_watching_changes_nothing(case):
    problem = (case.scene, case.radar, case.capture)
    plain = fit(*problem, case.parameters(), **case.settings(**FAST))
    watched = fit(
        *problem,
        case.parameters(),
        **case.settings(**FAST),
        watch=lambda scene: {"x": float(torch.rand(()))},
        watch_every=1,
    )
    for one, other in zip(plain.history, watched.history, strict=True):
        assert other["values"]["plate.translation"] == pytest.approx(
            one["values"]["plate.translation"], rel=1e-3, abs=1e-6
        )


def test_files_are_written_every_few_steps_and_at_the_end(case, tmp_path):
    file, times = tmp_path / "fit.pt", []

    def look(row: dict[str, Any]) -> None:
        if file.exists():
            times.append(torch.load(file, weights_only=True)["progress"]["step"])

    fit(
        case.scene,
        case.radar,
        case.capture,
        case.parameters(),
        **case.settings(**FAST | {"steps": 7}),
        checkpoint=file,
        checkpoint_every=3,
        progress=look,
    )
    assert times == [3, 3, 3, 6]  # before the file of its own step
    content = torch.load(file, weights_only=True)
    assert content["progress"]["step"] == 7
    assert content["progress"]["ended"] == "budget"
    assert [path.name for path in tmp_path.iterdir()] == ["fit.pt"]


def weighted(factor: float, power: int = 2) -> Callable[..., Any]:
    """A loss of one's own with a closure."""

    def loss(simulated: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
        floor = factor * measured.mean()
        lit = simulated.clamp_min(0.0) + floor
        return (lit.log() - (measured + floor).log()).abs().pow(power).mean()

    return loss


def squared(simulated: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
    return (simulated / simulated.mean() - measured / measured.mean()).square().mean()


def test_a_fit_of_anything_else_is_not_gone_on_with(case, tmp_path):
    """One change each of what the fit is; the same again is accepted."""
    file = tmp_path / "fit.pt"
    smooth = Laplacian(case.scene, "plate", 0.1)
    wall = case.scene["wall"]
    same: dict[str, Any] = {
        "scene": case.scene,
        "model": SurrogateMap(case.grid, sampling=FEW),
        "capture": case.capture,
        "loss": weighted(0.01),
        "regularizers": [smooth],
        "weight": 1.0,
        "frames": None,
    }

    def go(resume: bool = True, **changes: Any) -> Any:
        now = same | changes
        return reconstruct(
            now["scene"],
            Observation(now["model"], now["capture"], sensor=case.radar, weight=now["weight"]),
            Vertices("plate", 4),
            loss=now["loss"],
            regularizers=now["regularizers"],
            schedule=Schedule(2, frames_per_step=now["frames"]),
            callbacks=[Checkpoint(file, resume=resume)],
            seed=1,
        )

    first = go(resume=False)
    again = go(loss=weighted(0.01), regularizers=[Laplacian(case.scene, "plate", 0.1)])
    assert torch.equal(again.scene["plate"].vertices, first.scene["plate"].vertices)
    spoilt = case.capture.beat.clone()
    spoilt[1, 0, 3, 20] *= 3
    changes: dict[str, dict[str, Any]] = {
        "weight of a regulariser": {"regularizers": [Laplacian(case.scene, "plate", 0.2)]},
        "no regulariser": {"regularizers": []},
        "another scene": {"scene": case.scene.replace("wall", mesh=case.scene["plate"].mesh)},
        "material": {
            "scene": case.scene.replace("wall", material=replace(wall.material, lobe_width=0.31))
        },
        "permittivity": {"scene": case.scene.replace("wall", material=RoughDielectric(4.1))},
        "one datum": {"capture": type(case.capture).from_beat(spoilt, case.radar)},
        "samples": {"model": SurrogateMap(case.grid, sampling=replace(FEW, samples=2_001))},
        "depth": {"model": SurrogateMap(case.grid, sampling=replace(FEW, depth=2))},
        "kernels": {"model": SurrogateMap(case.grid, "gaussian", FEW)},
        "factor of the loss": {"loss": weighted(0.02)},
        "power of the loss": {"loss": weighted(0.01, 1)},
        "code of the loss": {"loss": squared},
        "loss of the package": {"loss": SpectrumLoss()},
        "weight": {"weight": 2.0},
        "frames": {"frames": 2},
    }
    for change in changes.values():
        with pytest.raises(InputError, match="got one of another"):
            go(**change)


SCRIPT = """
import sys
import torch
from fits import fit
from invertwin.capture import Capture
from invertwin.inversion import Optimizer
from invertwin.radar import Surrogate
from invertwin.scene import Scene, plate
from invertwin.scene.parameters import Translation
from scenes import thing

folder, end = sys.argv[1], int(sys.argv[2])

def log_loss(share):
    seen = []  # what the closure keeps does not matter to the fit, only what it starts with

    def loss(simulated, measured):
        floor = share * measured.mean()
        lit = simulated.clamp_min(0.0)
        a, b = lit / lit.mean() * measured.mean() + floor, measured.clamp_min(0.0) + floor
        return (a.log() - b.log()).square().mean()

    return loss

capture = Capture.load(folder + "/data.nc")
radar = capture.radar()
scene = Scene({
    "plate": thing(plate(0.3, 0.3), (1.5, 0.0, 0.0), (0.0, 0.0, 0.1)),
    "wall": thing(plate(1.6, 1.2), (2.1, 0.0, 0.0)),
})

def stop(row):
    if row["step"] == end:
        sys.exit(7)

found = fit(
    scene, radar, capture, [Translation("plate")], grid=radar.grid(1.0, 2.4, 0.5, oversample=1),
    loss=log_loss(0.02), depth=1, steps=8, samples=8_000, boundary_samples=2_000,
    optimizer=Optimizer(rate=0.02), surrogate=Surrogate(range_width=2.0), seed=1,
    checkpoint=folder + sys.argv[3], checkpoint_every=2, resume=True, progress=stop,
)
print(len(found.history))
torch.save(found.parameters[0].translation.detach(), folder + sys.argv[3] + ".result")
"""


@pytest.mark.slow
def test_a_loss_of_ones_own_goes_on_in_a_new_process(case, tmp_path):
    case.capture.save(tmp_path / "data.nc")
    tests = Path(__file__).resolve().parents[1]
    paths = f"{tests}{os.pathsep}{tests.parent / 'src'}"

    def run(end: int, name: str) -> int:
        command = [sys.executable, "-c", SCRIPT, str(tmp_path), str(end), name]
        environment = os.environ | {"PYTHONPATH": paths}
        ended = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert "Error" not in ended.stderr
        return ended.returncode

    assert run(5, "/cut.pt") == 7
    assert torch.load(tmp_path / "cut.pt", weights_only=True)["progress"]["step"] == 4
    assert run(-1, "/cut.pt") == 0
    assert run(-1, "/whole.pt") == 0
    cut, whole = (
        torch.load(tmp_path / f"{name}.pt.result", weights_only=True) for name in ("cut", "whole")
    )
    assert float(whole.norm()) > 0.02
    assert torch.allclose(cut, whole, rtol=1e-4, atol=0)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("step", torch.tensor(-1.0)),
        ("step", torch.tensor(math.inf)),
        ("step", torch.tensor(True)),
        ("step", torch.ones(3)),
        ("exp_avg", torch.tensor(0.0, dtype=torch.float64)),
        ("exp_avg", torch.zeros(3, dtype=torch.complex128)),
    ],
)
def test_what_no_optimizer_has_left_is_not_taken_for_its_state(name, value):
    parameter = torch.nn.Parameter(torch.zeros(3, dtype=torch.float64))
    optimizer = torch.optim.Adam([parameter])
    parameter.grad = torch.ones(3, dtype=torch.float64)
    optimizer.step()
    state = optimizer.state_dict()
    _restore_optimizer(torch.optim.Adam([parameter]), state)
    state["state"][0][name] = value
    with pytest.raises(ValueError, match="optimiser of another fit"):
        _restore_optimizer(torch.optim.Adam([parameter]), state)


def test_a_checkpoint_with_a_name_of_a_million_letters_is_refused_at_once(case, tmp_path):
    """torch's own message about it takes minutes: it searches it for patterns."""
    file = tmp_path / "fit.pt"
    name = b"c" + b"a" * 1_000_000 + b"\n" + b"b\n"
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("archive/data.pkl", b"\x80\x02" + name + b".")
        archive.writestr("archive/version", "3\n")
    begin = time.process_time()
    with pytest.raises(InputError, match="expected a whole checkpoint, got"):
        reconstruct(
            case.scene,
            Observation(SurrogateMap(case.grid, sampling=FEW), case.capture),
            Vertices("plate", 4),
            schedule=Schedule(1),
            callbacks=[Checkpoint(file, resume=True)],
            seed=1,
        )
    assert time.process_time() - begin < 20
