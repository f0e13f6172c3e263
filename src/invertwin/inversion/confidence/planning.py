"""Planned error bars: uncertainty of a fit before a measurement."""

import math
from dataclasses import dataclass

import torch

from invertwin.errors import InputError
from invertwin.inversion.confidence import uncertainty
from invertwin.inversion.confidence.realisations import FitResult
from invertwin.inversion.fit import Fit
from invertwin.inversion.gauss_newton import GaussNewton
from invertwin.runtime.progress import track

_DESCENT_STEPS, _TRUST_RADIUS = 5, 0.1  # descent from the truth


@dataclass(frozen=True)
class CandidatePosition:
    """Information gained by one more position of the radar.

    Attributes:
        frame: index of its frame.
        deviation_ratio: standard deviations with it over those without, geometric mean over all
            directions of the parameters.
        error_bars: error bars with it.
    """

    frame: int
    deviation_ratio: float
    error_bars: uncertainty.Uncertainty


def plan_error_bars(
    fit: Fit, candidates: int = 0
) -> tuple[uncertainty.Uncertainty, list[CandidatePosition]]:
    """Compute error bars of a fit that ends at the truth, and the gain of further frames.

    Args:
        fit: fit at the truth, see ``prepare_fit``; its data are one simulated recording, which
            determines gain and noise.
        candidates: number of final frames of its only observation that are candidates, each
            evaluated alone.

    Returns:
        Error bars without the candidates, and the candidates, the best first.

    Raises:
        InputError: Candidates for several observations; see ``CovarianceEstimator``.
    """
    end = FitResult(fit)
    evidence = uncertainty.CovarianceEstimator(end)
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
        ratio = math.exp(0.5 * float(change) / len(bars.names))
        added.append(CandidatePosition(frame, ratio, more))
    return bars, sorted(added, key=lambda one: one.deviation_ratio)


def fit_errors(fit: Fit) -> dict[str, float]:
    """Compute the errors of a fit that starts at the truth, by the names of error bars.

    The descent is unblurred, so that the spread over recordings is that of the nearest minimum, as
    error bars state it.

    Args:
        fit: fit at the truth; its parameters change.
    """
    found = list(uncertainty.iterate_coordinates(fit.modules))
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
