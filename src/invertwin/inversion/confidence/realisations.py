"""How the data of a fit would scatter if its twin were right: looks at the twin itself."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from invertwin.inversion.fit import Fit
from invertwin.inversion.loss import Maps, SpectrumLoss, pooled
from invertwin.runtime.progress import told
from invertwin.seeds import derived_seed

_LOOKS = 64  # they tell a standard deviation to 9 %
_DARK = 0.2  # the share of bins, the darkest, in which noise is measured
_COARSE = 2  # times that bins are joined in pairs where residuals are looked at


@dataclass(frozen=True, eq=False)
class Draws:
    """What the loss of a fit is on looks at its own twin.

    Attributes:
        losses: Of every look.
        slopes: For every look, the derivatives of the loss by the map of every observation.
        coarse: For every look, the coarse map of every observation, see ``coarse``.
    """

    losses: list[float]
    slopes: list[list[Tensor]]
    coarse: list[list[Tensor]]


class End:
    """The end of a fit: its maps, and looks at its twin.

    Args:
        fit: A fit that has ended.
        maps, looks: Those of some frames only, in place of its own.
    """

    def __init__(
        self, fit: Fit, maps: Maps | None = None, looks: Sequence[list[Tensor]] | None = None
    ) -> None:
        self.fit, self._maps, self._looks = fit, maps, looks

    def frames(self, chosen: Sequence[int], looks: Sequence[list[Tensor]]) -> "End":
        """The same for some frames of every observation.

        Args:
            chosen: Their numbers.
            looks: Those of all frames.
        """
        maps = [(a[chosen], b[chosen]) for a, b in self.maps]
        return End(self.fit, maps, [[power[chosen] for power in look] for look in looks])

    @cached_property
    def maps(self) -> Maps:
        """The predicted and the observed map of every observation, sharp and with all frames."""
        if self._maps is not None:
            return self._maps
        with torch.no_grad():
            ends = [self.fit.sharp_maps(number) for number in (0, 1)]
        return [((a + c) / 2, b) for (a, b), (c, _) in zip(*ends, strict=True)]

    @cached_property
    def gains(self) -> list[float]:
        """What every predicted map is multiplied by; zero where it shows next to nothing."""
        found = []
        for loss, (predicted, observed) in zip(self.fit.objective.losses, self.maps, strict=True):
            law = loss if isinstance(loss, SpectrumLoss) else SpectrumLoss("likelihood")
            lit = bool(predicted.any())
            found.append(law.fitted_gain(predicted, observed) if lit else 0.0)
        return found

    @cached_property
    def draws(self) -> Draws | None:
        """Looks at the twin; None where a model gives none, or a gain is zero."""
        found = Draws([], [], [])
        for seen in self.looks():
            loss, slopes = self.slopes(
                [(a, look) for (a, _), look in zip(self.maps, seen, strict=True)]
            )
            found.losses.append(loss)
            found.slopes.append(slopes)
            found.coarse.append([coarse(look) for look in seen])
        return found if found.losses else None

    def looks(self) -> Iterator[list[Tensor]]:
        """Maps of every observation as recordings of the twin would show them, with noise."""
        if self._looks is not None:
            yield from self._looks
            return
        looks = [look for look in self.fit.looks(0) if look is not None]
        if not min(self.gains) > 0 or len(looks) < len(self.maps):
            return
        models = [observation.model for observation in self.fit.observations]
        every = zip(self.maps, self.gains, models, strict=True)
        noises = [_noise(*pair, gain, model.fields) for pair, gain, model in every]
        for number in told(range(_LOOKS), "looks at the twin"):
            yield [
                look(derived_seed(number, k), noise)
                for k, (look, noise) in enumerate(zip(looks, noises, strict=True))
            ]

    def slopes(self, maps: Maps) -> tuple[float, list[Tensor]]:
        """The loss, and its derivative by every predicted map.

        Args:
            maps: Predicted and observed.
        """
        with torch.enable_grad():
            attached = [(a.detach().requires_grad_(), b) for a, b in maps]
            loss = self.fit.objective(attached)
            return float(loss.detach()), list(torch.autograd.grad(loss, [a for a, _ in attached]))


def coarse(power: Tensor) -> Tensor:
    """A map with bins joined four by four along every axis, its mean over frames.

    Args:
        power: [frame, …].
    """
    for _ in range(_COARSE):
        power = pooled(power)
    return power.mean(0)


def zscore(value: float, drawn: Sequence[float]) -> float:
    """How many standard deviations a number is above the mean of others.

    Args:
        value: The number.
        drawn: The others.
    """
    others = torch.tensor(drawn, dtype=torch.float64)
    return (value - float(others.mean())) / max(float(others.std()), 1e-30)


def _noise(predicted: Tensor, observed: Tensor, gain: float, fields: bool) -> float:
    """Mean noise in a bin, in units of the predicted map: what its darkest bins hold beyond it."""
    flat: Any = predicted.flatten()
    dark = flat.abs().argsort()[: max(1, math.ceil(_DARK * len(flat)))]
    rest = observed.flatten()[dark] / gain - flat[dark]
    return max(0.0, float((rest.square() if fields else rest).mean()))
