"""The loop: it finds a small displacement, can be interrupted, and says why it stopped."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from fits import fit
from invertwin.capture import Capture
from invertwin.channel import Sampling, draw_speckle
from invertwin.errors import InputError
from invertwin.inversion import (
    Observation,
    Optimizer,
    Reconstruction,
    Schedule,
    SpectrumLoss,
    reconstruct,
)
from invertwin.inversion.regularization import Laplacian
from invertwin.models.radar import ExactMap
from invertwin.radar import Surrogate
from invertwin.radar.parameters import RadarPose, RangeBias
from invertwin.radar.surrogate import surrogate as surrogates
from invertwin.scene import Scene
from invertwin.scene.parameters import Translation, Vertices
from invertwin.seeds import derive_seed
from invertwin.simulation import simulate
from scenes import float64

FAST: dict[str, Any] = {"steps": 4, "samples": 2_000, "boundary_samples": 500}
EXACT = Sampling(depth=1, points_per_m2=3_000.0)  # of what the cases record


def moved(fit: Reconstruction) -> torch.Tensor:
    """The translation that was found."""
    return fit.parameters.state_dict()["0.translation"]


def traced(monkeypatch) -> list[list[float]]:
    """Where the radar stands, along y, in every map that is predicted from now on."""
    seen: list[list[float]] = []
    true = surrogates.surrogate_spectrum

    def spy(scene, radar, *rest, **options):
        seen.append(radar.positions[:, 1].tolist())
        return true(scene, radar, *rest, **options)

    monkeypatch.setattr(surrogates, "surrogate_spectrum", spy)
    return seen


class InterruptError(Exception):
    """Stands for whatever ends a run."""


# Speckle of the one recording moves the minima by 19 and 11 mm, whatever the paths drawn.
@pytest.mark.parametrize(("kind", "bound"), [("mse", 0.022), ("likelihood", 0.015)])
def test_a_displaced_plate_is_found(case, kind, bound):
    settings = case.settings(steps=60, grid=case.radar.grid(1.0, 2.4, 0.5, oversample=2))
    found = fit(
        case.scene,
        case.radar,
        case.capture,
        case.parameters(),
        loss=SpectrumLoss(kind=kind),
        **settings,
    )
    assert found.status in ("budget", "converged")
    error = case.error(found.scene)
    assert float(case.error(case.scene).norm()) > 0.1
    assert float(error[:2].norm()) < bound
    assert len(found.history) == found.steps == 60
    assert set(found.history[0]) >= {"step", "loss", "values"}
    assert found.history[-1]["values"].keys() == {"plate.translation"}


@pytest.mark.slow
def test_momentum_finds_it_too(case):
    found = fit(
        case.scene,
        case.radar,
        case.capture,
        case.parameters(),
        **case.settings(steps=60, optimizer=Optimizer("sgd", rate=2e-3, momentum=0.8)),
    )
    assert float(case.error(found.scene)[0].abs()) < 0.03


def test_the_radar_is_found_as_well(case):
    """A radar off its place before a scene as known. Its line of receivers does not tell height."""
    away = float64([-0.09, 0.06, 0.0])
    there = replace(case.radar, positions=case.radar.positions + away)
    drawn = Sampling(depth=1, points_per_m2=3_000.0)
    with torch.no_grad():
        beat = simulate(case.scene, there, case.grid, sampling=drawn, seed=7).beat
    capture = Capture.from_beat(beat, case.radar)
    place = RadarPose(axes="xy", rotation_axes="")
    found = fit(
        case.scene,
        case.radar,
        capture,
        [],
        of_radar=[place],
        loss=SpectrumLoss("mse"),
        **case.settings(steps=40),
    )
    error = found.sensors[0].positions - there.positions
    assert float(error[:, :2].norm(dim=1).max()) < 0.02
    assert float(error[:, 2].abs().max()) == 0.0
    assert found.scene["plate"].center.equal(case.scene["plate"].center)


def test_same_seed_same_fit(case):
    fits = [
        fit(case.scene, case.radar, case.capture, case.parameters(), **case.settings(**FAST))
        for _ in range(2)
    ]
    first, second = (moved(fit) for fit in fits)
    assert torch.allclose(first, second, rtol=1e-4)


def test_an_interrupted_run_resumes_to_the_same_result(case, tmp_path):
    whole = fit(case.scene, case.radar, case.capture, case.parameters(), **case.settings(steps=12))

    def stop(row):
        if row["step"] == 7:
            raise InterruptError

    settings = case.settings(steps=12, checkpoint=tmp_path / "fit.pt", checkpoint_every=3)
    with pytest.raises(InterruptError):
        fit(case.scene, case.radar, case.capture, case.parameters(), progress=stop, **settings)
    resumed = fit(case.scene, case.radar, case.capture, case.parameters(), resume=True, **settings)
    assert [row["step"] for row in resumed.history] == list(range(12))
    assert torch.allclose(moved(resumed), moved(whole), rtol=1e-4, atol=0)
    # A finished run has nothing left to do.
    again = fit(case.scene, case.radar, case.capture, case.parameters(), resume=True, **settings)
    assert torch.equal(moved(again), moved(resumed))
    assert again.steps == 12


SCRIPT = """
import sys, time, torch
from invertwin.capture import Capture
from fits import fit
from invertwin.inversion import Optimizer
from invertwin.radar import Surrogate
from invertwin.scene.parameters import Translation
from scenes import thing
from invertwin.scene import Scene, plate

folder, resume = sys.argv[1], sys.argv[2] == "resume"
capture = Capture.load(folder + "/data.nc")
radar = capture.radar()
scene = Scene({
    "plate": thing(plate(0.3, 0.3), (1.5, 0.0, 0.0), (0.0, 0.0, 0.1)),
    "wall": thing(plate(1.6, 1.2), (2.1, 0.0, 0.0)),
})

def slowly(row):
    print(row["step"], flush=True)
    if not resume:
        time.sleep(0.2)

found = fit(
    scene, radar, capture, [Translation("plate")], grid=radar.grid(1.0, 2.4, 0.5, oversample=1),
    depth=1, steps=12, samples=8_000, boundary_samples=2_000, optimizer=Optimizer(rate=0.02),
    surrogate=Surrogate(range_width=2.0, angle_width=1.0), seed=1,
    checkpoint=folder + "/fit.pt", checkpoint_every=2, resume=resume, progress=slowly,
)
torch.save(found.parameters[0].translation.detach(), folder + "/result.pt")
"""


@pytest.mark.slow
def test_a_killed_process_resumes_to_the_same_result(case, tmp_path):
    case.capture.save(tmp_path / "data.nc")
    tests = Path(__file__).resolve().parents[1]
    environment = os.environ | {"PYTHONPATH": f"{tests}{os.pathsep}{tests.parent / 'src'}"}
    command = [sys.executable, "-c", SCRIPT, str(tmp_path)]
    with subprocess.Popen(
        [*command, "first"], env=environment, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.strip() == "6":
                time.sleep(0.05)
                process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    assert not (tmp_path / "result.pt").exists()
    subprocess.run([*command, "resume"], env=environment, check=True, capture_output=True)
    whole = fit(case.scene, case.radar, case.capture, case.parameters(), **case.settings(steps=12))
    found = torch.load(tmp_path / "result.pt", weights_only=True)
    assert torch.allclose(found, moved(whole), rtol=1e-4, atol=0)


def test_checkpoints_of_other_fits_and_broken_ones_are_refused(case, tmp_path):
    path = tmp_path / "fit.pt"
    settings = case.settings(**FAST, checkpoint=path)
    fit(case.scene, case.radar, case.capture, case.parameters(), **settings)
    others: tuple[dict[str, Any], ...] = (
        {"seed": 2},
        {"steps": 5},
        {"loss": SpectrumLoss("likelihood")},
        {"optimizer": Optimizer("sgd")},
        {"optimizer": Optimizer(rate=0.5)},
    )
    for changes in others:
        with pytest.raises(InputError, match=r"expected a checkpoint of this fit in .*fit\.pt"):
            fit(
                case.scene,
                case.radar,
                case.capture,
                case.parameters(),
                **{**settings, **changes},
                resume=True,
            )
    with pytest.raises(InputError, match="one of another"):
        fit(
            case.scene,
            case.radar,
            case.capture,
            case.parameters(),
            of_radar=[RadarPose()],
            **settings,
            resume=True,
        )
    away = Translation("plate", [0.0, 0.1, 0.0])(case.scene)
    with pytest.raises(InputError, match="one of another"):
        fit(away, case.radar, case.capture, case.parameters(), **settings, resume=True)
    torch.save(torch.zeros(3), path)
    with pytest.raises(InputError, match="one of another"):
        fit(case.scene, case.radar, case.capture, case.parameters(), **settings, resume=True)
    path.write_bytes(b"not a checkpoint")
    with pytest.raises(InputError, match="expected a whole checkpoint"):
        fit(case.scene, case.radar, case.capture, case.parameters(), **settings, resume=True)


class Breaks(nn.Module):
    """A translation that breaks the scene, or its gradient, after some steps."""

    def __init__(self, how: str, after: int) -> None:
        super().__init__()
        self.inner, self.how, self.left = Translation("plate"), how, after

    def forward(self, scene: Scene) -> Scene:
        self.left -= 1
        if self.left == -1 and self.how == "scene":
            return scene.replace("plate", pose=torch.full((4, 4), torch.nan, dtype=torch.float64))
        if self.left == -1:
            self.inner.translation.data.fill_(torch.nan)
        return self.inner(scene)


@pytest.mark.parametrize("how", ["scene", "parameter"])
def test_a_step_that_breaks_is_divergence_and_the_best_state_stays(case, how):
    module = Breaks(how, after=5)
    settings = case.settings(**FAST | {"steps": 9})
    module_scene = module.inner
    found = fit(case.scene, case.radar, case.capture, [module], **settings)
    assert found.status == "diverged"
    assert found.steps == len(found.history) == 5
    assert torch.isfinite(module_scene.translation).all()
    # The loss of the kept state without extra widths, to be compared with fits that end well.
    kept = [Translation("plate", module_scene.translation.detach())]
    sharp = settings | {"surrogate": "response", "steps": 1, "samples": 20_000}
    plain = fit(case.scene, case.radar, case.capture, kept, **sharp).history[0]["loss"]
    assert found.loss == pytest.approx(plain, rel=0.1)
    assert found.loss > 1.3 * min(row["loss"] for row in found.history)
    whole = fit(case.scene, case.radar, case.capture, [Translation("plate")], **settings)
    assert 0.3 * whole.loss < found.loss < 30 * whole.loss


class Bounded(nn.Module):
    """A translation that is refused beyond a distance."""

    def __init__(self, most: float) -> None:
        super().__init__()
        self.inner, self.most = Translation("plate"), most

    def forward(self, scene: Scene) -> Scene:
        if float(self.inner.translation.detach().norm()) > self.most:
            raise InputError("expected a plate that is nearer")
        return self.inner(scene)


def test_a_last_step_that_is_refused_is_divergence(case):
    module = Bounded(0.05)
    settings = case.settings(steps=1, optimizer=Optimizer(rate=0.2))
    found = fit(
        case.scene,
        case.radar,
        case.capture,
        [module],
        watch=lambda scene: {"x": float(scene["plate"].center[0])},
        watch_every=1,
        **settings,
    )
    assert found.status == "diverged"
    assert not module.inner.translation.any()
    assert "x" not in found.history[0]  # that state has none


def test_gauss_newton_takes_back_what_is_refused(case):
    module = Bounded(0.03)
    settings = case.settings(steps=3, optimizer=Optimizer("gauss_newton", rate=0.05))
    found = fit(case.scene, case.radar, case.capture, [module], **settings)
    assert found.status != "diverged"
    assert 0 < float(module.inner.translation.detach().norm()) <= 0.03


def test_a_rate_far_too_large_diverges_to_the_best_state(case):
    found = fit(
        case.scene,
        case.radar,
        case.capture,
        [Vertices("plate", 4)],
        regularizers=[Laplacian(case.scene, "plate", 1.0)],
        **case.settings(steps=8, optimizer=Optimizer(rate=50.0), boundary_samples=500),
    )
    assert found.status == "diverged"
    assert found.steps < 8
    assert not found.parameters.state_dict()["0.offsets"].any()
    assert found.loss > found.history[0]["loss"]  # without extra widths


def test_a_loss_that_settles_is_convergence(case):
    """Started at the truth, with nothing to gain: it stops long before the budget."""
    found = fit(
        case.scene,
        case.radar,
        case.capture,
        [Translation("plate", case.offset)],
        tolerance=0.05,
        annealing=0.0,
        **case.settings(steps=200, samples=4_000, optimizer=Optimizer(rate=1e-4)),
    )
    assert found.status == "converged"
    assert found.steps < 200


def test_few_steps_are_a_spent_budget(case):
    found = fit(case.scene, case.radar, case.capture, case.parameters(), **case.settings(**FAST))
    assert found.status == "budget"
    assert found.steps == 4


def test_subsets_of_frames(case, monkeypatch):
    """Every step takes another few frames; over the steps all have their turn."""
    seen = traced(monkeypatch)
    fit(
        case.scene,
        case.radar,
        case.capture,
        case.parameters(),
        frames_per_step=2,
        **case.settings(**FAST | {"steps": 8}),
    )
    assert all(len(frames) == 2 for frames in seen)
    assert {y for frames in seen for y in frames} == set(case.radar.positions[:, 1].tolist())


def test_frames_that_are_held_out_are_not_fitted_but_judge(case, monkeypatch):
    """What fitted frames show has moved, what the held out one shows has not: the start wins."""
    with torch.no_grad():
        still = simulate(case.scene, case.radar, case.grid, sampling=EXACT, seed=7).beat
    mixed = case.capture.beat.clone()
    mixed[3] = still[3]
    capture = Capture.from_beat(mixed, case.radar)
    settings = case.settings(steps=60)
    free = fit(case.scene, case.radar, capture, case.parameters(), **settings)
    seen = traced(monkeypatch)
    judged = fit(case.scene, case.radar, capture, case.parameters(), held_out=4, **settings)
    assert free.status != "diverged"
    assert float(moved(free).norm()) > 0.02
    assert judged.status == "diverged"
    assert not moved(judged).any()
    fitted = case.radar.positions[:3, 1].tolist()
    assert seen[:60] == [fitted] * 60
    assert case.radar.positions[:, 1].tolist() in seen[60:]


def test_a_fit_that_explains_held_out_frames_goes_on(case):
    settings = case.settings(steps=60, held_out=4)
    found = fit(case.scene, case.radar, case.capture, case.parameters(), **settings)
    assert found.status != "diverged"
    assert float(case.error(found.scene)[:2].norm()) < 0.03 < 0.5 * float(case.offset.norm())


def test_too_few_frames_to_hold_some_out(case):
    with pytest.raises(InputError, match="expected at least 5 frames in every observation"):
        fit(
            case.scene,
            case.radar,
            case.capture,
            case.parameters(),
            held_out=5,
            **case.settings(**FAST),
        )


def test_without_boundary_the_steps_differ(case):
    fits = [
        fit(
            case.scene,
            case.radar,
            case.capture,
            case.parameters(),
            boundary=boundary,
            **case.settings(**FAST),
        )
        for boundary in (True, False)
    ]
    first, second = (moved(fit) for fit in fits)
    assert not torch.allclose(first, second, rtol=1e-3)


def test_nothing_to_fit_is_refused(case):
    frozen = Translation("plate").requires_grad_(False)
    for modules, changes in (([], {}), ([frozen], {}), (case.parameters(), {"steps": 0})):
        with pytest.raises(InputError, match="expected parameters to fit and steps >= 1"):
            fit(case.scene, case.radar, case.capture, modules, **case.settings(**changes))


def test_an_unknown_object_is_the_users_mistake_not_divergence(case):
    with pytest.raises(InputError, match="got 'plane'"):
        fit(case.scene, case.radar, case.capture, [Translation("plane")], **case.settings())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kind": "lbfgs"}, "kind to be one of adam, sgd, gauss_newton, got 'lbfgs'"),
        ({"rate": 0.0}, "rate above 0, got 0.0"),
        ({"momentum": 1.0}, "momentum below 1, got 1.0"),
    ],
)
def test_bad_optimizers_are_named(options, message, unchecked):
    with pytest.raises(InputError, match=message):
        Optimizer(**options)


@pytest.mark.parametrize("annealing", [0.5, 1.0])
def test_widths_fall_to_the_exact_response(case, annealing, monkeypatch):
    """The last step has none of the extra width, even if all steps anneal."""
    kernels = []
    original = surrogates.surrogate_spectrum

    def spied(scene, device, grid, kernel, **options):
        kernels.append(kernel)
        return original(scene, device, grid, kernel, **options)

    monkeypatch.setattr(surrogates, "surrogate_spectrum", spied)
    fit(
        case.scene,
        case.radar,
        case.capture,
        case.parameters(),
        **case.settings(**FAST, annealing=annealing, surrogate="annealed"),
    )
    widths = [(kernel.range_width, kernel.angle_width) for kernel in kernels[: FAST["steps"]]]
    assert widths[0] == (3.0, 1.5)
    assert widths == sorted(widths, reverse=True)
    assert kernels[FAST["steps"] - 1] == Surrogate()


def test_exact_signals_as_the_model(case):
    """By the same switch; it fits a realisation, and holds visibility fixed."""
    settings = case.settings(**FAST, depth=1, surrogate="exact", points_per_m2=300.0, seed=3)
    with pytest.raises(InputError, match="boundary=False for fixed visibility"):
        fit(case.scene, case.radar, case.capture, case.parameters(), **settings)
    settings["boundary"] = False
    first = fit(case.scene, case.radar, case.capture, case.parameters(), **settings)
    drawn = Sampling(
        depth=1, samples=2_000, boundary_samples=500, points_per_m2=300.0, boundary=False
    )
    speckle = draw_speckle(case.scene, case.radar.link(), drawn, derive_seed(3, 0))
    second = reconstruct(
        case.scene,
        Observation(ExactMap(case.grid, drawn, speckle), case.capture, sensor=case.radar),
        case.parameters(),
        loss=SpectrumLoss("mse"),
        optimizer=settings["optimizer"],
        schedule=Schedule(FAST["steps"]),
        seed=3,
    )
    assert float(moved(first).norm()) > 0
    assert torch.allclose(moved(first), moved(second), rtol=1e-3)
    with pytest.raises(InputError, match="expected range_bias 0 for exact signals"):
        fit(case.scene, case.radar, case.capture, [], of_radar=[RangeBias(0.01)], **settings)


def test_gauss_newton_finds_the_plate_in_few_steps(case, tmp_path):
    settings = case.settings(steps=8, optimizer=Optimizer("gauss_newton", rate=0.05))
    file = tmp_path / "fit.pt"
    found = fit(
        case.scene,
        case.radar,
        case.capture,
        [Translation("plate", axes="xy")],
        checkpoint=file,
        **settings,
    )
    assert float(case.error(found.scene).norm()) < 0.025
    assert float(case.error(case.scene).norm()) > 0.1
    again = fit(
        case.scene,
        case.radar,
        case.capture,
        [Translation("plate", axes="xy")],
        checkpoint=file,
        resume=True,
        **settings,
    )
    assert torch.equal(again.scene["plate"].vertices, found.scene["plate"].vertices)


def test_gauss_newton_needs_a_loss_whose_curvature_it_knows(case):
    settings = case.settings(steps=1, optimizer=Optimizer("gauss_newton"))
    settings["loss"] = lambda a, b: (a - b).square().mean()
    with pytest.raises(InputError, match="SpectrumLoss for Gauss–Newton, got function"):
        fit(case.scene, case.radar, case.capture, case.parameters(), **settings)
