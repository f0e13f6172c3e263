"""Whether a fit is to be believed: apart from why it stopped."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from invertwin.inversion.draws import End, coarse, zscore

Word = Literal["consistent", "inconsistent", "at a bound", "worse", "lost", "unknown"]

_DOUBT = 3.5  # standard deviations of the loss on looks at the twin
_MARKED = 5.0  # the same of a coarse bin
_EMPTY = 1e-3  # of the observed power: a twin that explains less shows nothing
_WORSE = 1.02  # times the loss of the start: more than the noise of samples


@dataclass(frozen=True, eq=False)
class Verdict:
    """Whether the data look like recordings of the twin.

    A wrong minimum may look right, such as a letter that is turned by half a turn: fit from
    several starts (``starts``).

    Attributes:
        word: ``consistent``: nothing speaks against the twin. ``inconsistent``: the data do not
            look like recordings of it. ``at a bound``: a value is at the end of its range.
            ``worse``: the fit is worse than its start. ``lost``: the twin shows next to nothing of
            what was observed, so nothing tells the fit where to go. ``unknown``: the model gives no
            looks to compare with.
        excess: The loss of the data above the mean of that of looks at the twin, in their standard
            deviations; None where there are none.
        reasons: What speaks against the twin, in sentences.
        residuals: For every observation how far its coarse map, summed over frames, is from that
            of looks, in their standard deviations; beyond 5 is marked in the report.
    """

    word: Word
    excess: float | None = None
    reasons: tuple[str, ...] = ()
    residuals: list[Tensor] = field(default_factory=list)

    @property
    def consistent(self) -> bool:
        """Whether nothing speaks against the twin."""
        return self.word == "consistent"


def verdict(end: End) -> Verdict:
    """Judge the end of a fit.

    Args:
        end: Of the fit.
    """
    fit = end.fit
    explained = [
        gain * float(a.mean()) / max(float(b.mean()), 1e-300)
        for gain, (a, b) in zip(end.gains, end.maps, strict=True)
    ]
    if min(explained) < _EMPTY:
        shown = f"{100 * min(explained):.2g} % of the power of observation {_least(explained)}"
        return Verdict("lost", None, (f"the twin explains {shown}; start nearer to the truth",))
    loss = float(fit.objective(end.maps))
    begun = fit.loss_at_start()
    if loss > _WORSE * begun:
        return Verdict("worse", None, (f"the loss is {loss:.4g}, at the start {begun:.4g}",))
    bounds = tuple(
        f"{name} is at the end of its range"
        for module in fit.modules.modules()
        for name in getattr(module, "at_bounds", list)()
    )
    if end.draws is None:
        return Verdict("at a bound" if bounds else "unknown", None, bounds)
    excess = zscore(loss, end.draws.losses)
    residuals = list(_residuals(end))
    reasons = list(bounds)
    if excess > _DOUBT:
        mean = sum(end.draws.losses) / len(end.draws.losses)
        reasons.append(f"the loss is {loss:.4g}, on recordings of the twin itself {mean:.4g}")
        reasons += [text for map_ in enumerate(residuals) if (text := _marked(*map_))]
    word: Word = "inconsistent" if excess > _DOUBT else "at a bound" if bounds else "consistent"
    return Verdict(word, excess, tuple(reasons), residuals)


def _least(values: list[float]) -> int:
    return min(range(len(values)), key=values.__getitem__) + 1


def _residuals(end: End) -> Iterator[Tensor]:
    """For every observation, coarse bins in standard deviations of looks."""
    assert end.draws is not None
    looks = zip(*end.draws.coarse, strict=True)
    for maps, (_, observed), gain in zip(looks, end.maps, end.gains, strict=True):
        drawn = torch.stack(maps)
        yield (coarse(observed) / gain - drawn.mean(0)) / drawn.std(0).clamp_min(1e-30)


def _marked(number: int, residual: Tensor) -> str:
    """What a residual map shows."""
    more, less = int((residual > _MARKED).sum()), int((residual < -_MARKED).sum())
    if not more + less:
        return ""
    return (
        f"observation {number + 1}: {more} of {math.prod(residual.shape)} coarse bins hold more "
        f"power than the twin explains, {less} less"
    )
