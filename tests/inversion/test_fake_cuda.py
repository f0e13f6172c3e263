"""Fits of maps on a GPU: parameters and scenes are on the CPU, maps claim to be on a GPU."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

import invertwin.inversion as inv
from blobs import LAW, Blob, scene
from claimed_tensors import Case, DeviceTests, Move
from invertwin.inversion.gauss_newton import GaussNewton
from invertwin.scene import Scene, Translation, sphere
from scenes import thing

pytestmark = pytest.mark.fake_cuda


@dataclass(frozen=True, eq=False)
class There(Blob):
    """A blob on a device, as a map of the ray tracer is.

    Attributes:
        move: to the device.
    """

    move: Move = lambda value: value
    realisation_count = 8

    def predict(self, scene: Scene, sensor: Any, seed: int) -> Tensor:
        return self.move(super().predict(scene, sensor, seed))

    def realisations(
        self, scene: Scene, sensor: Any, seed: int
    ) -> Callable[[int, float], Tensor] | None:
        look = Blob(self.frames).realisations(scene, sensor, seed)
        assert look is not None
        return lambda number, noise: self.move(look(number, noise))


def shift() -> Translation:
    return Translation("ball", (0.0, 0.1, 0.0), axes="y")


def observation(move: Move, **changes: Any) -> inv.Observation:
    data = Blob().predict(scene(0.3), None, 0)
    return inv.Observation(There(move=move), data, sensor=None, **changes)


def prepare(move: Move) -> inv.Fit:
    return inv.prepare_fit(scene(), [observation(move)], [shift()], loss=LAW, seed=1)


def gauss_newton_step(move: Move) -> Tensor:
    found = prepare(move)
    optimizer = inv.Optimizer("gauss_newton").build(found.modules, found.objective)
    assert isinstance(optimizer, GaussNewton)
    loss = found.gauss_newton_step(optimizer, 0)
    return torch.tensor([loss, *(p.norm().item() for p in found.modules.parameters())])


def fit(move: Move, kind: str, loss: Any = LAW) -> list[Tensor]:
    """The parameters at the end of a fit, and its error bars."""
    found = inv.reconstruct(
        scene(),
        observation(move),
        [shift()],
        loss=loss,
        optimizer=inv.Optimizer(kind),
        schedule=inv.Schedule(steps=3),
        seed=1,
    )
    rows = torch.tensor([row["loss"] for row in found.history], dtype=torch.float64)
    bars = [found.uncertainty.covariance] if isinstance(loss, inv.SpectrumLoss) else []
    return [found.scene["ball"].center.detach(), rows, *bars]


def maps(move: Move) -> tuple[Tensor, Tensor]:
    one, other = (Blob().predict(scene(y), None, 0).contiguous() for y in (0.1, 0.3))
    return move(one), move(other)


def rates(move: Move) -> Tensor:
    return move(torch.linspace(0, 1, 3 * 800).double().reshape(3, 4, 200, 1, 1))


def starts(move: Move) -> Tensor:
    candidates = [[thing(sphere(0.1, 1), (1.0, y, 0.0))] for y in (0.0, 0.25)]
    found = inv.search(
        scene(),
        observation(move),
        [shift()],
        {"ball": [item for (item,) in candidates]},
        loss=LAW,
        schedule=inv.Schedule(steps=2),
        seed=1,
    )
    return found.best.scene["ball"].center.detach()


LOSSES = [
    inv.SpectrumLoss(kind, background="none" if kind == "mse" else "auto")
    for kind in ("mse", "likelihood", "heavy_tailed")
]


def spectrum_loss(move: Move) -> list[Tensor]:
    found: list[Tensor] = []
    for loss in LOSSES:
        simulated, measured = maps(move)
        simulated.requires_grad_()
        value = loss(simulated, measured)
        value.backward()
        assert simulated.grad is not None
        found += [value.detach(), simulated.grad]
    return found


def mean_of_views(move: Move) -> Tensor:
    module = shift()

    def loss(place: float) -> Tensor:
        return (There(move=move).predict(module(scene(place)), None, 0) - 1).square().sum()

    mean = inv.mean_over_views(loss, [0.1, 0.2], module)
    (parameter,) = module.parameters()
    assert parameter.grad is not None
    return torch.cat([parameter.grad, parameter.grad.new_tensor([mean])])


CASES: dict[str, Case] = {
    "CorrelationLoss.__call__": lambda move: [
        inv.CorrelationLoss(scale)(*maps(move)) for scale in ("magnitude", "power", "level")
    ],
    "CorrelationLoss.curvature": lambda move: inv.CorrelationLoss().curvature(
        *maps(move), rates(move)
    ),
    "SpectrumLoss.__call__": spectrum_loss,
    "SpectrumLoss.curvature": lambda move: [
        loss.curvature(*maps(move), rates(move)) for loss in LOSSES
    ],
    "SpectrumLoss.fitted_gain": lambda move: torch.tensor(
        [loss.fitted_gain(*maps(move)) for loss in LOSSES]
    ),
    "speckle_divergence": lambda move: inv.speckle_divergence(maps(move)[0], 4.0),
    "speckle_weight": lambda move: inv.speckle_weight(maps(move)[0], 4.0),
    "Fit.evaluate": lambda move: prepare(move).evaluate(0).detach(),
    "Fit.maps": lambda move: prepare(move).maps(0),
    "Fit.unblurred_maps": lambda move: prepare(move).unblurred_maps(0),
    "Fit.loss_at_start": lambda move: torch.tensor(prepare(move).loss_at_start()),
    "Fit.gauss_newton_step": gauss_newton_step,
    "Fit.realisations": lambda move: [
        look(0, 0.0) for look in prepare(move).realisations(0) if look is not None
    ],
    "Observation.observed_map": lambda move: inv.Observation(
        Blob(), maps(move)[1], sensor=None
    ).observed_map(),
    "evaluate_losses": lambda move: inv.evaluate_losses(
        inv.make_line(shift(), {"translation": [0.0, 1.0, 0.0]}, scene()),
        (0.0, 0.1),
        observation(move, loss=LAW),
    ),
    "mean_over_views": mean_of_views,
    "plan_error_bars": lambda move: inv.plan_error_bars(prepare(move))[0].covariance,
    "reconstruct": lambda move: [
        *fit(move, "adam"),
        *fit(move, "gauss_newton"),
        *fit(move, "adam", inv.CorrelationLoss()),
    ],
    "search": starts,
}

ON_CPU = {
    "Fit.gauss_newton_step": "parameters",
    "Fit.loss_at_start": "a number",
    "SpectrumLoss.fitted_gain": "a number",
    "mean_over_views": "a number, and gradients of parameters",
    "plan_error_bars": "error bars of parameters",
    "reconstruct": "parameters",
    "search": "parameters",
}
PARAMETERS = "parameters, scenes and the state of fits, which are on the CPU"
NO_CASE = {
    **dict.fromkeys(
        (
            *("Callback.annotate", "Callback.begin", "Callback.end", "Callback.step"),
            *("Checkpoint.begin", "Checkpoint.end", "Checkpoint.step", "Fit.apply_modules"),
            *("Fit.copy", "Fit.is_unblurred", "Fit.parameters", "Fit.penalty", "Fit.restore"),
            *("Fit.state", "Fit.twin", "GaussianBump.evaluate", "LatentNorm.__call__"),
            *("Observation.initial_sensor", "Optimizer.build", "Optimizer.set_rates"),
            *("Report.step", "Screening.candidates", "Search.to_metrics", "Uncertainty.interval"),
            *("Unknown.build_module", "Watch.annotate", "make_line", "place_at_poses"),
            *("pose_grid", "prepare_fit", "report_progress", "sample_nearby_poses"),
        ),
        PARAMETERS,
    ),
    **dict.fromkeys(
        (
            *("Laplacian.__call__", "compare_shapes", "count_topology", "displace"),
            *("pose_error", "remesh", "require_edge_length", "volume_iou"),
        ),
        "meshes, whose geometry is on the CPU",
    ),
    "Fit.run": "run by reconstruct",
    "InitialPoseEstimator.estimate": "a recording: its signals are tested in radar/",
}


class TestDevices(DeviceTests):
    room, cases, no_case, on_cpu = "invertwin.inversion", CASES, NO_CASE, ON_CPU
