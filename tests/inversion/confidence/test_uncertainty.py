"""Error bars: against the Cramér–Rao bound of a model without rays, and what is not observed."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import nn

from blobs import LAW, Blob, Faces, Ripple, deviation, scene
from invertwin.errors import InputError
from invertwin.inversion import (
    Observation,
    Optimizer,
    Reconstruction,
    Schedule,
    reconstruct,
)
from invertwin.inversion.confidence.uncertainty import CovarianceEstimator, iterate_coordinates
from invertwin.radar.parameters import RadarPose, RangeBias
from invertwin.scene import Pose, Scale, Scene, Translation
from invertwin.scene.parameters import Coordinate
from scenes import float64


def fitted(
    model: Blob,
    seed: int = 0,
    axes: str = "y",
    loss: Any = LAW,
    seen: Blob | None = None,
    rate: float = 0.1,
) -> Reconstruction:
    """A fit of one look at a ball at y = 0.1, as another model sees it."""
    look = replace(seen or model, known=True).realisations(scene(0.1), None, 0)
    assert look is not None
    return reconstruct(
        scene(0.05),
        Observation(model, look(seed, 0.0), sensor=None),
        Translation("ball", axes=axes),
        loss=loss,
        optimizer=Optimizer("gauss_newton", rate=rate),
        schedule=Schedule(8),
    )


def test_errors_are_those_that_speckle_allows():
    found = fitted(Blob()).uncertainty
    assert found.names == ("ball.y",)
    assert found.units == ("m",)
    assert found.unobserved == ()
    # 64 looks tell it to 9 %.
    assert found.deviations["ball.y"] == pytest.approx(deviation(0.1, 4), rel=0.25)
    # Student's law with 63 degrees of freedom.
    assert found.interval(0.95)["ball.y"] == pytest.approx(1.998 * found.deviations["ball.y"], 1e-3)
    assert (found.count, found.source) == (64, "looks")


@pytest.mark.claim
@pytest.mark.slow
def test_stated_errors_hold():
    """Over 60 recordings: 95 % of errors within the intervals, and as wide as stated."""
    fits = [fitted(Blob(), seed) for seed in range(60)]
    errors = [float(fit.scene["ball"].center[1].detach()) - 0.1 for fit in fits]
    inside = [
        abs(e) <= fit.uncertainty.interval()["ball.y"] for e, fit in zip(errors, fits, strict=True)
    ]
    assert sum(inside) >= 53
    spread = float(torch.tensor(errors).std())
    assert fits[0].uncertainty.deviations["ball.y"] == pytest.approx(spread, rel=0.3)


def test_a_fit_that_stops_early_says_how_far_from_its_minimum():
    early, done = fitted(Blob(), rate=1e-4), fitted(Blob())
    ways = [float(done.scene["ball"].center[1] - early.scene["ball"].center[1]), 0.0]
    alone = CovarianceEstimator(early.result).error_bars().deviations["ball.y"]
    assert ways[0] > 3 * alone
    for fit, way in zip((early, done), ways, strict=True):
        (step,) = fit.uncertainty.newton_step
        assert fit.uncertainty.deviations["ball.y"] > step
        assert step == pytest.approx(way, rel=0.3, abs=0.1 * alone)
    assert done.uncertainty.early_stops == ()
    (sentence,) = early.uncertainty.early_stops
    assert sentence.startswith("ball.y: the fit stopped 0.0")
    assert "before its minimum; give it more steps" in sentence


def half_size() -> float:
    y = scene()["ball"].vertices[:, 1]
    return 0.5 * float(y.max() - y.min())


def test_a_size_that_nothing_tells_displaces_by_its_own_deviation():
    """Of a ball of which one face shows, a size 10 % off moves the centre by as much."""
    found = fitted(Faces())
    bars = found.uncertainty
    alone = CovarianceEstimator(found.result).error_bars().deviations["ball.y"]
    assert bars.size_errors["ball"] == pytest.approx(0.1, rel=0.02)
    assert bars.deviations["ball.y"] == pytest.approx(math.hypot(alone, 0.1 * half_size()), 0.02)


def test_a_size_that_the_data_contradict_is_in_the_error_bars():
    """The data show a ball a quarter smaller: its far face is dim and yields to the near one."""
    kind = Faces(frames=400, share=0.02)
    found = fitted(kind, seen=replace(kind, size=0.75))
    error = float(found.scene["ball"].center[1].detach()) - 0.1
    alone = CovarianceEstimator(found.result).error_bars().deviations["ball.y"]
    assert abs(error) > 5 * alone
    assert abs(error) < 3 * found.uncertainty.deviations["ball.y"]
    assert found.uncertainty.size_errors["ball"] > 0.1


def test_a_size_that_the_data_confirm_hardly_widens_error_bars():
    kind = Faces(frames=400, share=1.0)
    found = fitted(kind)
    alone = CovarianceEstimator(found.result).error_bars().deviations["ball.y"]
    assert found.uncertainty.deviations["ball.y"] == pytest.approx(alone, rel=0.1)
    assert found.uncertainty.size_errors["ball"] < 0.03


def test_a_fitted_size_and_a_size_without_effect_change_nothing():
    bars = fitted(Blob()).uncertainty
    alone = CovarianceEstimator(fitted(Blob()).result).error_bars()
    torch.testing.assert_close(bars.covariance, alone.covariance, rtol=1e-12, atol=0.0)
    assert bars.size_errors["ball"] == pytest.approx(0.1)
    observation = Observation(Faces(), Faces().predict(scene(0.1), None, 0), sensor=None)
    both = [Translation("ball", axes="y"), Scale("ball")]
    schedule = Schedule(1)
    assert reconstruct(scene(), observation, both, schedule=schedule).uncertainty.size_errors == {}


def test_without_looks_the_frames_tell():
    found = fitted(Blob(frames=40, known=False)).uncertainty
    assert (found.count, found.source) == (40, "frames")
    assert found.deviations["ball.y"] == pytest.approx(deviation(0.1, 40), rel=0.35)
    assert found.interval()["ball.y"] > 2.02 * found.deviations["ball.y"]


def test_what_has_no_effect_is_not_observed_and_named():
    found = fitted(Blob(), axes="xy").uncertainty
    (told,) = found.unobserved
    assert told.startswith("ball.x: not observed; ")
    assert told.endswith(" of the information of ball.y")
    assert found.deviations["ball.x"] >= 0.5
    assert found.deviations["ball.y"] == pytest.approx(deviation(0.1, 4), rel=0.25)
    assert abs(float(found.correlations[0, 1])) < 0.1


def test_a_direction_whose_loss_falls_again_is_not_observed():
    """Two spans away, 0.2 m, lies the next of many equal minima, or the slope of one."""
    steady = fitted(Ripple(period=2.0)).uncertainty
    assert steady.unobserved == ()
    assert 0.025 < steady.deviations["ball.y"] < 0.1
    repeated = fitted(Ripple(period=0.2)).uncertainty
    assert repeated.unobserved == ("ball.y: not observed",)
    assert repeated.deviations["ball.y"] > 1.0


class Mixed(nn.Module):
    """An unknown of one's own: of its three numbers only the sum of two moves the ball."""

    def __init__(self) -> None:
        super().__init__()
        self.shares = nn.Parameter(float64([0.0, 0.0, 0.0]))

    def coordinates(self) -> list[Coordinate]:
        axes = torch.eye(3, dtype=torch.float64)[:2]
        return [Coordinate(f"share {k}", "m", {"shares": row}, 0.1) for k, row in enumerate(axes)]

    def forward(self, scene: Scene) -> Scene:
        way = self.shares[0] + self.shares[1]
        zero = torch.zeros_like(way)
        moved = {"translation": torch.stack([zero, way, zero])}
        return torch.func.functional_call(Translation("ball"), moved, (scene,))


def test_a_mixed_direction_is_named_with_its_parts():
    look = Blob().realisations(scene(0.1), None, 0)
    assert look is not None
    found = reconstruct(
        scene(),
        Observation(Blob(), look(0, 0.0), sensor=None),
        Mixed(),
        loss=LAW,
        optimizer=Optimizer("gauss_newton", rate=0.1),
        schedule=Schedule(5),
    ).uncertainty
    (told,) = found.unobserved
    assert told.startswith(("share 0 and share 1: not", "share 1 and share 0: not"))
    assert "0.71 share 0" in told
    # What is known, their sum, is as certain as a single number would be.
    both = float(torch.tensor([1.0, 1.0], dtype=torch.float64) @ found.covariance.sum(1))
    assert both**0.5 == pytest.approx(deviation(0.1, 4), rel=0.25)


def test_modules_name_theircoordinates():
    named = nn.ModuleList(
        [
            Pose("ball", rotation=[0.0, 0.0, 0.4], axes="y", rotation_axes="z"),
            Scale("ball", 2.0),
            RangeBias(),
            nn.Linear(1, 2, bias=False),
            Translation("ball").requires_grad_(False),
        ]
    )
    found = {c.name: c for c in iterate_coordinates(named)}
    assert list(found) == [
        *("ball.y", "ball.yaw", "ball.scale", "range_bias", "3.weight[0]", "3.weight[1]")
    ]
    assert found["ball.yaw"].unit == "rad"
    # A factor of 2 grows by 1 where its logarithm grows by a half.
    assert float(found["ball.scale"].tangents["1.log_scale"]) == pytest.approx(0.5)
    assert [c.name for c in RadarPose(axes="", rotation_axes="x").coordinates()] == ["radar.roll"]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_turn_is_about_the_axes_of_the_world(axis):
    """The tangent of a coordinate, followed a little, turns by as much about that axis."""
    pose = Pose("ball", rotation=[0.3, -0.5, 0.8])
    coordinate = pose.coordinates()[3 + axis]
    before = pose.rotation_matrix.detach()
    with torch.no_grad():
        pose.rotation += 1e-5 * coordinate.tangents["rotation"]
    turn = (pose.rotation_matrix.detach() @ before.T - torch.eye(3, dtype=torch.float64)) / 1e-5
    vector = torch.stack([turn[2, 1], turn[0, 2], turn[1, 0]])
    assert vector.tolist() == pytest.approx([float(k == axis) for k in range(3)], abs=1e-4)


def test_fits_without_error_bars_say_so():
    fit = fitted(Blob(frames=1, known=False))
    with pytest.raises(InputError, match="got one frame of a model without realisations"):
        _ = fit.uncertainty
