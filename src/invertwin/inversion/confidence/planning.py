"""What a radar will tell about the parameters, before it has recorded anything."""

import math
from dataclasses import dataclass

import torch

from invertwin.errors import InputError
from invertwin.inversion.confidence.realisations import FitResult
from invertwin.inversion.confidence.uncertainty import (
    CovarianceEstimator,
    Uncertainty,
    iterate_coordinates,
)
from invertwin.inversion.fit import Fit
from invertwin.inversion.gauss_newton import GaussNewton
from invertwin.runtime.progress import track

_DESCENT_STEPS, _TRUST_RADIUS = 5, 0.1  # of a fit that begins at the truth


@dataclass(frozen=True)
class CandidatePosition:
    """What one more position of the radar would tell.

    Attributes:
        frame: Number of its frame.
        deviation_ratio: Its standard deviations over those without it, geometric mean over all
            directions of
            the parameters.
        error_bars: Error bars with it.
    """

    frame: int
    deviation_ratio: float
    error_bars: Uncertainty


def plan_error_bars(fit: Fit, candidates: int = 0) -> tuple[Uncertainty, list[CandidatePosition]]:
    """Error bars of a fit that ends at the truth, and what further frames would add.

    Args:
        fit: It stands at the truth; its data are one simulated recording, which tells gain and
            noise. See ``prepare_fit``.
        candidates: The last frames of its only observation, so many, are not there yet: each is
            tried by itself.

    Returns:
        Error bars without the candidates, and the candidates, the best first.

    Raises:
        InputError: Candidates for several observations; see ``Evidence``.
    """
    end = FitResult(fit)
    evidence = CovarianceEstimator(end)
    if not candidates:
        return evidence.error_bars(), []
    if len(end.maps) > 1:
        raise InputError(
            f"expected one sensor with positions to add, got {len(end.maps)}; plan each by itself"
        )
    every, looks = len(end.maps[0][0]), list(end.realisations())
    known = list(range(every - candidates))
    bars = evidence.error_bars(known, looks)
    added = []
    for frame in track(range(every - candidates, every), "positions to add"):
        more = evidence.error_bars([*known, frame], looks)
        change = torch.linalg.slogdet(more.covariance)[1] - torch.linalg.slogdet(bars.covariance)[1]
        added.append(
            CandidatePosition(frame, math.exp(0.5 * float(change) / len(bars.names)), more)
        )
    return bars, sorted(added, key=lambda one: one.deviation_ratio)


def fit_errors(fit: Fit) -> dict[str, float]:
    """How far a fit that begins at the truth leaves it, by the names of error bars.

    It descends without extra widths; so the spread over recordings is that of the nearest
    minimum, which error bars state.

    Args:
        fit: It stands at the truth, and does not any more afterwards.
    """
    found = list(iterate_coordinates(fit.modules))
    before = {name: p.detach().clone() for name, p in fit.modules.named_parameters()}
    descent = GaussNewton(
        fit.modules, fit.objective, trust_radius=_TRUST_RADIUS, curvature_every=_DESCENT_STEPS
    )
    for step in range(_DESCENT_STEPS):
        fit.gauss_newton_step(descent, fit.stage.steps + step)
    moved = {name: p.detach() - before[name] for name, p in fit.modules.named_parameters()}
    return {
        c.name: sum(float((moved[n] * t).sum()) for n, t in c.tangents.items())
        / sum(float(t.square().sum()) for t in c.tangents.values())
        for c in found
    }
