"""Verdicts: on right and wrong ends of a model without rays, whose looks are known."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from blobs import BINS, LAW, Blob, scene
from invertwin.inversion import (
    Observation,
    Optimizer,
    Reconstruction,
    Schedule,
    SpectrumLoss,
    reconstruct,
)
from invertwin.scene import MaterialValues, RoughDielectric, Scene, Translation, sphere
from scenes import thing


def fitted(
    data: Tensor, start: float = 0.05, model: Blob | None = None, loss: SpectrumLoss = LAW
) -> Reconstruction:
    return reconstruct(
        scene(start),
        Observation(model or Blob(), data, sensor=None),
        Translation("ball", axes="y"),
        loss=loss,
        optimizer=Optimizer("gauss_newton", rate=0.1),
        schedule=Schedule(8),
    )


def look(seed: int, y: float = 0.1) -> Tensor:
    drawn = Blob().realisations(scene(y), None, 0)
    assert drawn is not None
    return drawn(seed, 0.0)


def test_right_ends_are_consistent():
    found = [fitted(look(seed)).verdict for seed in range(20)]
    assert sum(verdict.is_consistent for verdict in found) >= 19
    excess = torch.tensor([verdict.excess for verdict in found], dtype=torch.float64)
    assert abs(float(excess.mean())) < 0.8
    assert 0.6 < float(excess.std()) < 1.5


def test_a_wrong_minimum_is_not():
    """The blob is out of reach: the fit ends where it began, and says so."""
    noisy = fitted(look(0, y=1.4), start=-1.0, loss=replace(LAW, background="level"))
    assert noisy.verdict.word == "lost"  # noise explains it as well
    found = fitted(look(0, y=1.4), start=-1.0)
    assert found.status != "diverged"
    verdict = found.verdict
    assert verdict.word == "inconsistent"
    assert verdict.excess is not None
    assert verdict.excess > 10
    assert "on recordings of the twin itself" in verdict.reasons[0]
    # Where the power is that the twin does not explain.
    marked = verdict.residuals[0].flatten() > 5
    assert BINS[2::4][marked].tolist() == pytest.approx([1.4] * int(marked.sum()), abs=0.5)
    assert "hold more power than the twin predicts" in verdict.reasons[1]


class Dark(Blob):
    """Shows nothing left of a border."""

    def predict(self, scene: Scene, sensor: Any, seed: int) -> Tensor:
        power = super().predict(scene, sensor, seed)
        return power * (scene["ball"].center[1] < 0).to(power)


def test_a_start_that_shows_nothing_is_lost():
    found = fitted(look(0), start=0.2, model=Dark())
    assert found.status == "budget"
    assert found.is_uninformative
    assert found.verdict.word == "lost"
    assert "0 % of the power of observation 1" in found.verdict.reasons[0]


def test_without_looks_it_is_not_known():
    found = fitted(look(0), model=Blob(known=False))
    assert not found.is_uninformative
    verdict = found.verdict
    assert verdict.word == "unknown"
    assert verdict.excess is None


def test_an_end_worse_than_its_start_says_so():
    found = fitted(look(0), start=0.1)
    with torch.no_grad():
        next(found.parameters.parameters())[1] += 0.5
    assert found.verdict.word == "worse"


@pytest.mark.parametrize(("diffuse", "near"), [(0.5, []), (0.995, ["ball.diffuse"])])
def test_values_next_to_the_end_of_their_range_are_named(diffuse, near):
    assert MaterialValues("ball", diffuse=diffuse).at_bounds() == near
    item = thing(sphere(0.1, 1), material=RoughDielectric(4.0))
    thin = MaterialValues("ball", permittivity=1.00005).from_object("ball", ["permittivity"], item)
    assert thin.at_bounds() == []
