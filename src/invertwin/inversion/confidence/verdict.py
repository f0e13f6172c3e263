"""Whether a fit is to be believed: apart from why it stopped."""

import contextlib
import math
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
"""Of the observed power: a twin that explains less shows nothing."""
_INCONSISTENT_ZSCORE = 3.5  # standard deviations of the loss on looks at the twin
_MARKED_BIN_ZSCORE = 5.0  # the same of a coarse bin
_DEPTH_ZSCORE = 3.0  # standard deviations by which more bounces must lower the loss to be named
_MAX_LOSS_RATIO = 1.02  # times the loss of the start: more than the noise of samples


@dataclass(frozen=True, eq=False)
class Verdict:
    """Whether the data look like recordings of the twin.

    A wrong minimum may look right by itself, such as a letter that is turned by half a turn. So
    the twin is turned in all ways that leave it much the same, fitted again and compared. Other
    minima are found from several starts (``search``).

    Attributes:
        word: ``consistent``: nothing speaks against the twin. ``inconsistent``: the data do not
            look like recordings of it. ``ambiguous``: another end explains them as well.
            ``at a bound``: a value is at the end of its range.
            ``worse``: the fit is worse than its start. ``lost``: the twin shows next to nothing of
            what was observed, so nothing tells the fit where to go. ``make_shape_model``: the
            model gives no
            looks to compare with.
        excess: The loss of the data above the mean of that of looks at the twin, in their standard
            deviations; None where there are none.
        structure: The same of the mean square of ``residuals``, which speckle hardly moves.
        reasons: What speaks against the twin, in sentences.
        residuals: For every observation how far its coarse map, summed over frames, is from that
            of looks, in their standard deviations; beyond 5 is marked in the report.
        ambiguities: Ends that look much like this one, with how far the data speak against them.
    """

    word: VerdictWord
    excess: float | None = None
    structure: float | None = None
    reasons: tuple[str, ...] = ()
    residuals: list[Tensor] = field(default_factory=list)
    ambiguities: tuple[Ambiguity, ...] = ()

    @property
    def is_consistent(self) -> bool:
        """Whether nothing speaks against the twin."""
        return self.word == "consistent"


def judge_fit(result: FitResult) -> Verdict:
    """Judge the end of a fit.

    Args:
        result: Of the fit.
    """
    fit, explained = result.fit, explained_fractions(result)
    if min(explained) < MIN_EXPLAINED_FRACTION:
        shown = (
            f"{100 * min(explained):.2g} % of the power of observation "
            f"{_smallest_number(explained)}"
        )
        return Verdict("lost", reasons=(f"the twin explains {shown}; start nearer to the truth",))
    loss = float(fit.objective(result.maps))
    begun = fit.loss_at_start()
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
        mean = sum(result.realisation_statistics.losses) / len(result.realisation_statistics.losses)
        reasons = [f"the loss is {loss:.4g}, on recordings of the twin itself {mean:.4g}", *bounds]
        marked = enumerate(zip(residuals, fit.observations, strict=True))
        reasons += [
            text
            for k, (map_, o) in marked
            if (text := _describe_residual(k, map_, o.model.holds_fields))
        ]
        reasons += _test_deeper_paths(
            result,
            loss - _DEPTH_ZSCORE * float(torch.tensor(result.realisation_statistics.losses).std()),
        )
        return Verdict("inconsistent", excess, structure, tuple(reasons), residuals)
    others = tuple(find_ambiguities(result))
    open_ = [
        f"{rival.description} explains the data as well{_format_score(rival)}" for rival in others
    ]
    open_ = [text for text, rival in zip(open_, others, strict=True) if not rival.is_rejected]
    word: VerdictWord = "at a bound" if bounds else "ambiguous" if open_ else "consistent"
    return Verdict(word, excess, structure, (*bounds, *open_), residuals, others)


def explained_fractions(result: FitResult) -> list[float]:
    """For every observation, how much of its power the twin explains.

    Args:
        result: Of the fit.
    """
    return [
        gain * float(a.abs().mean()) / max(float(b.abs().mean()), 1e-300)
        for gain, (a, b) in zip(result.gains, result.maps, strict=True)
    ]


def _format_score(ambiguity: Ambiguity) -> str:
    return "" if ambiguity.score is None else f": z = {ambiguity.score:.1f}"


def _test_deeper_paths(result: FitResult, limit: float) -> Iterator[str]:
    """Says so if one bounce more explains the data better."""
    sampling = getattr(result.fit.observations[0].model, "sampling", None)
    if isinstance(sampling, Sampling):
        depth = sampling.depth + 1
        with contextlib.suppress(InputError), torch.no_grad():
            loss = float(result.fit.objective(result.fit.unblurred_maps(0, depth=depth)))
            if loss < limit:
                yield f"with depth = {depth} its loss is {loss:.4g}: the fit leaves out bounces"


def _smallest_number(values: list[float]) -> int:
    return min(range(len(values)), key=values.__getitem__) + 1


def _coarse_residuals(result: FitResult) -> tuple[list[Tensor], float]:
    """For every observation, coarse bins in standard deviations of looks; how large they are."""
    assert result.realisation_statistics is not None
    found, squares = [], []
    looks = zip(*result.realisation_statistics.coarse_maps, strict=True)
    for maps, (_, observed), gain in zip(looks, result.maps, result.gains, strict=True):
        drawn = torch.stack(maps)
        mean, spread = drawn.mean(0), drawn.std(0).clamp_min(1e-30)
        found.append((coarsen_map(observed) / gain - mean) / spread)
        # A look is part of its own mean, the data are not.
        count = len(drawn)
        own = ((drawn - mean) / spread).square() * ((count + 1) / (count - 1))
        squares.append((found[-1].square().mean(), own.flatten(1).mean(1)))
    data, drawn = (torch.stack(list(part)).sum(0) for part in zip(*squares, strict=True))
    return found, zscore(float(data), drawn.tolist())


def _describe_residual(number: int, residual: Tensor, holds_fields: bool) -> str:
    """What a residual map shows."""
    more, less = (
        int((residual > _MARKED_BIN_ZSCORE).sum()),
        int((residual < -_MARKED_BIN_ZSCORE).sum()),
    )
    if not more + less:
        return ""
    if holds_fields:
        off, count = more + less, residual.numel()
        return f"observation {number + 1}: {off} of {count} coarse bins are not those of the twin"
    return (
        f"observation {number + 1}: {more} of {math.prod(residual.shape)} coarse bins hold more "
        f"power than the twin explains, {less} less"
    )
