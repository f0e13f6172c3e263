"""How the data of a fit would scatter if its twin were right: looks at the twin itself."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from invertwin.inversion.fit import Fit
from invertwin.inversion.loss import MapPairs, SpectrumLoss, halve_resolution
from invertwin.runtime.progress import track
from invertwin.seeds import derive_seed

_REALISATION_COUNT = 64  # they tell a standard deviation to 9 %
_NOISE_BIN_FRACTION = 0.2  # the share of bins, the darkest, in which noise is measured
_POOLING_LEVELS = 2  # times that bins are joined in pairs where residuals are looked at


@dataclass(frozen=True, eq=False)
class RealisationStatistics:
    """What the loss of a fit is on looks at its own twin.

    Attributes:
        losses: Of every look.
        gradients: For every look, the derivatives of the loss by the map of every observation.
        coarse_maps: For every look, the coarse map of every observation, see ``coarse_maps``.
    """

    losses: list[float]
    gradients: list[list[Tensor]]
    coarse_maps: list[list[Tensor]]


class FitResult:
    """The end of a fit: its maps, and looks at its twin.

    Args:
        fit: A fit that has ended.
        maps, realisations: Those of some frames only, in place of its own.
    """

    def __init__(
        self,
        fit: Fit,
        maps: MapPairs | None = None,
        realisations: Sequence[list[Tensor]] | None = None,
    ) -> None:
        self.fit, self._maps, self._looks = fit, maps, realisations

    def select_frames(
        self, indices: Sequence[int], realisations: Sequence[list[Tensor]]
    ) -> "FitResult":
        """The same for some frames of every observation.

        Args:
            indices: Their numbers.
            realisations: Those of all frames.
        """
        maps = [(a[indices], b[indices]) for a, b in self.maps]
        return FitResult(
            self.fit, maps, [[power[indices] for power in look] for look in realisations]
        )

    @cached_property
    def maps(self) -> MapPairs:
        """The predicted and the observed map of every observation, sharp and with all frames."""
        if self._maps is not None:
            return self._maps
        with torch.no_grad():
            ends = [self.fit.unblurred_maps(number) for number in (0, 1)]
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
    def realisation_statistics(self) -> RealisationStatistics | None:
        """Looks at the twin; None where a model gives none, or a gain is zero."""
        found = RealisationStatistics([], [], [])
        for seen in self.realisations():
            loss, slopes = self.loss_gradients(
                [(a, look) for (a, _), look in zip(self.maps, seen, strict=True)]
            )
            found.losses.append(loss)
            found.gradients.append(slopes)
            found.coarse_maps.append([coarsen_map(look) for look in seen])
        return found if found.losses else None

    def realisations(self) -> Iterator[list[Tensor]]:
        """Maps of every observation as recordings of the twin would show them, with noise."""
        if self._looks is not None:
            yield from self._looks
            return
        looks = [look for look in self.fit.realisations(0) if look is not None]
        if not min(self.gains) > 0 or len(looks) < len(self.maps):
            return
        models = [observation.model for observation in self.fit.observations]
        every = zip(self.maps, self.gains, models, strict=True)
        noises = [_estimate_noise(*pair, gain, model.holds_fields) for pair, gain, model in every]
        for number in track(range(_REALISATION_COUNT), "looks at the twin"):
            yield [
                look(derive_seed(number, k), noise)
                for k, (look, noise) in enumerate(zip(looks, noises, strict=True))
            ]

    def loss_gradients(self, maps: MapPairs) -> tuple[float, list[Tensor]]:
        """The loss, and its derivative by every predicted map.

        Args:
            maps: Predicted and observed.
        """
        with torch.enable_grad():
            attached = [(a.detach().requires_grad_(), b) for a, b in maps]
            loss = self.fit.objective(attached)
            return float(loss.detach()), list(torch.autograd.grad(loss, [a for a, _ in attached]))


def coarsen_map(power: Tensor) -> Tensor:
    """A map with bins joined four by four along every axis, its mean over frames.

    Args:
        power: [frame, …].
    """
    for _ in range(_POOLING_LEVELS):
        power = halve_resolution(power)
    return power.mean(0)


def zscore(value: float, samples: Sequence[float]) -> float:
    """How many standard deviations a number is above the mean of others.

    Args:
        value: The number.
        samples: The others.
    """
    others = torch.tensor(samples, dtype=torch.float64)
    return (value - float(others.mean())) / max(float(others.std()), 1e-30)


def _estimate_noise(predicted: Tensor, observed: Tensor, gain: float, holds_fields: bool) -> float:
    """Mean noise in a bin, in units of the predicted map: what its darkest bins hold beyond it."""
    flat: Any = predicted.flatten()
    dark = flat.abs().argsort()[: max(1, math.ceil(_NOISE_BIN_FRACTION * len(flat)))]
    rest = observed.flatten()[dark] / gain - flat[dark]
    return max(0.0, float((rest.square() if holds_fields else rest).mean()))
