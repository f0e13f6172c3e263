"""Results of fits, and realisations of the data under the hypothesis that the twin is true."""

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

_NOISE_BIN_FRACTION = 0.2  # weakest fraction of bins, in which noise is estimated
_POOLING_LEVELS = 2  # halvings of the resolution for residuals
_Looks = Sequence[list[Tensor]]  # a map of every observation each


@dataclass(frozen=True, eq=False)
class RealisationStatistics:
    """Losses, gradients and coarse maps of simulated realisations of a twin.

    Attributes:
        losses: loss of each realisation.
        gradients: for each realisation, derivatives of the loss with respect to the map of each
            observation.
        coarse_maps: for each realisation, the coarse map of each observation, see ``coarsen_map``.
    """

    losses: list[float]
    gradients: list[list[Tensor]]
    coarse_maps: list[list[Tensor]]


class FitResult:
    """Predicted and observed maps of a finished fit, and simulated realisations of them.

    Args:
        fit: a finished fit.
        maps, realisations: maps and realisations of selected frames, in place of the fit's own.
    """

    def __init__(
        self, fit: Fit, maps: MapPairs | None = None, realisations: _Looks | None = None
    ) -> None:
        self.fit, self._maps, self._looks = fit, maps, realisations

    def select_frames(self, indices: Sequence[int], realisations: _Looks) -> "FitResult":
        """Return the result for selected frames of every observation.

        Args:
            indices: indices of the frames.
            realisations: realisations of all frames.
        """
        maps = [(a[indices], b[indices]) for a, b in self.maps]
        looks = [[power[indices] for power in look] for look in realisations]
        return FitResult(self.fit, maps, looks)

    @cached_property
    def maps(self) -> MapPairs:
        """Predicted and observed map of every observation, unblurred and with all frames."""
        if self._maps is not None:
            return self._maps
        with torch.no_grad():
            ends = [self.fit.unblurred_maps(number) for number in (0, 1)]
        return [((a + c) / 2, b) for (a, b), (c, _) in zip(*ends, strict=True)]

    @cached_property
    def gains(self) -> list[float]:
        """Gain of every predicted map; zero if it predicts almost none of the power."""
        found = []
        for loss, (predicted, observed) in zip(self.fit.objective.losses, self.maps, strict=True):
            law = loss if isinstance(loss, SpectrumLoss) else SpectrumLoss("likelihood")
            found.append(law.fitted_gain(predicted, observed) if bool(predicted.any()) else 0.0)
        return found

    @cached_property
    def realisation_statistics(self) -> RealisationStatistics | None:
        """Statistics of realisations; None for models without them, or if a gain is zero."""
        found = RealisationStatistics([], [], [])
        for seen in self.realisations():
            pairs = [(a, look) for (a, _), look in zip(self.maps, seen, strict=True)]
            loss, slopes = self.loss_gradients(pairs)
            found.losses.append(loss)
            found.gradients.append(slopes)
            found.coarse_maps.append([coarsen_map(look) for look in seen])
        return found if found.losses else None

    def realisations(self) -> Iterator[list[Tensor]]:
        """Simulate maps of every observation as recordings of the twin, with noise."""
        if self._looks is not None:
            yield from self._looks
            return
        looks = [look for look in self.fit.realisations(0) if look is not None]
        if not min(self.gains) > 0 or len(looks) < len(self.maps):
            return
        models = [observation.model for observation in self.fit.observations]
        every = zip(self.maps, self.gains, models, strict=True)
        noises = [_estimate_noise(*pair, gain, model.holds_fields) for pair, gain, model in every]
        count = min(model.realisation_count for model in models)
        for number in track(range(count), "realisations of the twin"):
            yield [
                look(derive_seed(number, k), noise).to(pair[0].device)
                for k, (look, noise, pair) in enumerate(zip(looks, noises, self.maps, strict=True))
            ]

    def loss_gradients(self, maps: MapPairs) -> tuple[float, list[Tensor]]:
        """Compute the loss and its derivative with respect to every predicted map.

        Args:
            maps: predicted and observed maps.
        """
        with torch.enable_grad():
            attached = [(a.detach().requires_grad_(), b) for a, b in maps]
            loss = self.fit.objective(attached)
            return float(loss.detach()), list(torch.autograd.grad(loss, [a for a, _ in attached]))


def coarsen_map(power: Tensor) -> Tensor:
    """Average a map over blocks of four bins along every axis and over frames.

    Args:
        power: map [frame, …].
    """
    for _ in range(_POOLING_LEVELS):
        power = halve_resolution(power)
    return power.mean(0)


def zscore(value: float, samples: Sequence[float]) -> float:
    """Compute the deviation of a value from the mean of samples in their standard deviations.

    Args:
        value: the value.
        samples: the samples.
    """
    others = torch.tensor(samples, dtype=torch.float64)
    return (value - float(others.mean())) / max(float(others.std()), 1e-30)


def _estimate_noise(predicted: Tensor, observed: Tensor, gain: float, holds_fields: bool) -> float:
    """Estimate the mean noise per bin from the weakest bins, in units of the predicted map."""
    flat: Any = predicted.flatten()
    dark = flat.abs().argsort()[: max(1, math.ceil(_NOISE_BIN_FRACTION * len(flat)))]
    rest = observed.flatten()[dark] / gain - flat[dark]
    return max(0.0, float((rest.square() if holds_fields else rest).mean()))
