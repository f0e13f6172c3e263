"""Verdict of a fit: goodness of fit and ambiguities, independent of the stopping reason."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from invertwin.channel import Sampling
from invertwin.errors import InputError
from invertwin.inversion.confidence.ambiguities import Ambiguity, find_ambiguities
from invertwin.inversion.confidence.realisations import FitResult, coarsen_map, zscore

VerdictWord = Literal[
    "consistent", "inconsistent", "ambiguous", "at a bound", "worse", "lost", "unknown"
]

MIN_EXPLAINED_FRACTION = 1e-3
"""Minimum predicted fraction of the observed power; a smaller one is uninformative."""
_INCONSISTENT_ZSCORE = 3.5  # standard deviations of the loss over realisations
_MARKED_BIN_ZSCORE = 5.0  # standard deviations of a coarse bin
_DEPTH_ZSCORE = 3.0  # standard deviations by which more bounces must lower the loss
_MAX_LOSS_RATIO = 1.02  # final over initial loss: more than the noise of samples


@dataclass(frozen=True, eq=False)
class Verdict:
    """Goodness of fit, and ambiguous results.

    A wrong minimum may fit well, such as a letter rotated by half a turn. So the twin is rotated by
    all near symmetries, refitted and compared. Multi-start fits find other minima (``search``).

    Attributes:
        word: ``consistent``: no evidence against the twin. ``inconsistent``: the data differ from
            realisations of the twin. ``ambiguous``: another result fits them equally well. ``at a
            bound``: a value is at the end of its range. ``worse``: the fit is worse than its start.
            ``lost``: uninformative start; the twin predicts almost none of the observed power.
            ``unknown``: the model has no realisations to compare with.
        excess: loss of the data above the mean loss of realisations, in their standard deviations;
            None without realisations.
        structure: the same for the mean square of ``residuals``, which is robust to speckle.
        reasons: evidence against the twin, in sentences.
        residuals: for every observation the deviation of its coarse map, summed over frames, from
            realisations, in their standard deviations; the report marks values beyond 5.
        ambiguities: similar results, with their significance.
    """

    word: VerdictWord
    excess: float | None = None
    structure: float | None = None
    reasons: tuple[str, ...] = ()
    residuals: list[Tensor] = field(default_factory=list)
    ambiguities: tuple[Ambiguity, ...] = ()

    @property
    def is_consistent(self) -> bool:
        """True if there is no evidence against the twin."""
        return self.word == "consistent"


def judge_fit(result: FitResult) -> Verdict:
    """Assess the result of a fit.

    Args:
        result: result of the fit.
    """
    fit, explained = result.fit, explained_fractions(result)
    if min(explained) < MIN_EXPLAINED_FRACTION:
        number = explained.index(min(explained)) + 1
        shown = f"{100 * min(explained):.2g} % of the power of observation {number}"
        return Verdict("lost", reasons=(f"the twin predicts {shown}; start nearer to the truth",))
    loss, begun = float(fit.objective(result.maps)), fit.loss_at_start()
    if loss > _MAX_LOSS_RATIO * begun:
        return Verdict("worse", reasons=(f"the loss is {loss:.4g}, at the start {begun:.4g}",))
    bounds = tuple(
        f"{name} is at the end of its range"
        for module in fit.modules.modules()
        for name in getattr(module, "at_bounds", list)()
    )
    if result.realisation_statistics is None:
        return Verdict("at a bound" if bounds else "unknown", reasons=bounds)
    excess = zscore(loss, result.realisation_statistics.losses)
    residuals, structure = _coarse_residuals(result)
    if max(excess, structure) > _INCONSISTENT_ZSCORE:
        drawn = result.realisation_statistics.losses
        mean, deviation = sum(drawn) / len(drawn), float(torch.tensor(drawn).std())
        reasons = [f"the loss is {loss:.4g}, on recordings of the twin itself {mean:.4g}", *bounds]
        for k, (residual, o) in enumerate(zip(residuals, fit.observations, strict=True)):
            reasons += _describe_residual(k, residual, o.model.holds_fields)
        reasons += _test_deeper_paths(result, loss - _DEPTH_ZSCORE * deviation)
        return Verdict("inconsistent", excess, structure, tuple(reasons), residuals)
    others = tuple(find_ambiguities(result))
    open_ = [
        f"{other.description} fits the data equally well"
        + ("" if other.score is None else f": z = {other.score:.1f}")
        for other in others
        if not other.is_rejected
    ]
    word: VerdictWord = "at a bound" if bounds else "ambiguous" if open_ else "consistent"
    return Verdict(word, excess, structure, (*bounds, *open_), residuals, others)


def explained_fractions(result: FitResult) -> list[float]:
    """Return the predicted fraction of the observed power of every observation.

    Args:
        result: result of the fit.
    """
    return [
        gain * float(a.abs().mean()) / max(float(b.abs().mean()), 1e-300)
        for gain, (a, b) in zip(result.gains, result.maps, strict=True)
    ]


def _test_deeper_paths(result: FitResult, limit: float) -> Iterator[str]:
    """Yield a sentence if one more bounce fits the data better."""
    sampling = getattr(result.fit.observations[0].model, "sampling", None)
    if isinstance(sampling, Sampling):
        depth = sampling.depth + 1
        with contextlib.suppress(InputError), torch.no_grad():
            loss = float(result.fit.objective(result.fit.unblurred_maps(0, depth=depth)))
            if loss < limit:
                yield f"with depth = {depth} its loss is {loss:.4g}: the fit leaves out bounces"


def _coarse_residuals(result: FitResult) -> tuple[list[Tensor], float]:
    """Compute coarse residuals in standard deviations, and their significance."""
    assert result.realisation_statistics is not None
    found, squares = [], []
    looks = zip(*result.realisation_statistics.coarse_maps, strict=True)
    for maps, (_, observed), gain in zip(looks, result.maps, result.gains, strict=True):
        drawn = torch.stack(maps)
        mean, spread = drawn.mean(0), drawn.std(0).clamp_min(1e-30)
        found.append((coarsen_map(observed) / gain - mean) / spread)
        # A realisation is part of its own mean, the data are not.
        count = len(drawn)
        own = ((drawn - mean) / spread).square() * ((count + 1) / (count - 1))
        squares.append((found[-1].square().mean(), own.flatten(1).mean(1)))
    data, drawn = (torch.stack(list(part)).sum(0) for part in zip(*squares, strict=True))
    return found, zscore(float(data), drawn.tolist())


def _describe_residual(number: int, residual: Tensor, holds_fields: bool) -> Iterator[str]:
    """Describe a residual map in words, if some bins are marked."""
    more = int((residual > _MARKED_BIN_ZSCORE).sum())
    less = int((residual < -_MARKED_BIN_ZSCORE).sum())
    start, count = f"observation {number + 1}:", residual.numel()
    if more + less and holds_fields:
        yield f"{start} {more + less} of {count} coarse bins are not those of the twin"
    elif more + less:
        bins = f"{more} of {count} coarse bins"
        yield f"{start} {bins} hold more power than the twin predicts, {less} less"
