"""How far a simulated power map is from a measured one."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool3d

from invertwin.errors import InputError

BACKGROUNDS = ("none", "level", "static")


@dataclass(frozen=True)
class SpectrumLoss:
    """Multiscale mean squared error of power maps.

    ``(1/levels) Σ_l mean((g a_l − b_l)²) / mean(b_l²)``, where a, b are the simulated and the
    measured map and each level pools the bins of the one before in pairs. The unknown overall
    gain g ≥ 0 minimises the sum in closed form; being a minimiser, it needs no derivative.

    Attributes:
        levels: Number of resolutions.
        gain: ``fitted``, or ``one`` for calibrated data.
        background: What is taken out of both maps first, again in closed form: nothing, one
            common ``level``, or the ``static`` part, the mean over frames of every bin (what
            clutter removal did to the data).

    Source: §4.2 of the paper (multiscale MSE).
    Differs from the source: the gain and the background are not parameters of the descent.

    Raises:
        InputError: No levels, an unknown choice.
    """

    levels: int = 3
    gain: Literal["fitted", "one"] = "fitted"
    background: Literal["none", "level", "static"] = "none"

    def __post_init__(self) -> None:
        if self.levels < 1 or self.gain not in ("fitted", "one"):
            raise InputError(
                f"expected levels >= 1 and gain 'fitted' or 'one', got {self.levels} and "
                f"{self.gain!r}; 3 levels and a fitted gain suit uncalibrated radars"
            )
        if self.background not in BACKGROUNDS:
            raise InputError(
                f"expected background among {', '.join(BACKGROUNDS)}, got {self.background!r}; "
                "choose one"
            )

    def __call__(
        self,
        simulated: Float[Tensor, "frame range u v"],
        measured: Float[Tensor, "frame range u v"],
    ) -> Float[Tensor, ""]:
        """The loss: 0 for equal maps, 1 for an empty simulated map.

        Raises:
            InputError: Different shapes, or a measured map that is zero everywhere.
        """
        if simulated.shape != measured.shape:
            raise InputError(
                f"expected maps of one shape, got {tuple(simulated.shape)} and "
                f"{tuple(measured.shape)}; use one grid for both"
            )
        scale = measured.detach().abs().max()
        if not scale > 0:
            raise InputError("expected a measured map with power in it, got zeros; check the grid")
        unit = simulated.detach().abs().max()
        unit = torch.where(unit > 0, unit, 1.0) if self.gain == "fitted" else scale
        pairs = []
        a, b = simulated / unit, measured.to(simulated) / scale
        for level in range(self.levels):
            if level:
                a, b = _pooled(a), _pooled(b)
            pairs.append((self._cleared(a), self._cleared(b)))
        norms = [y.detach().square().mean().clamp_min(1e-30) for _, y in pairs]
        gain = self._gain(pairs, norms)
        terms = [(gain * x - y).square().mean() / n for (x, y), n in zip(pairs, norms, strict=True)]
        return torch.stack(terms).mean()

    def _gain(self, pairs: list[tuple[Tensor, Tensor]], norms: list[Tensor]) -> Tensor:
        if self.gain == "one":
            return torch.ones(())
        with torch.no_grad():
            both = zip(pairs, norms, strict=True)
            terms = torch.stack(
                [torch.stack([(x * y).mean() / n, (x * x).mean() / n]) for (x, y), n in both]
            ).sum(0)
            return (terms[0] / terms[1].clamp_min(1e-30)).clamp_min(0.0)

    def _cleared(self, power: Tensor) -> Tensor:
        if self.background == "level":
            return power - power.mean()
        if self.background == "static":
            return power - power.mean(0, keepdim=True)
        return power


def _pooled(power: Tensor) -> Tensor:
    """Half the resolution along every axis that has two bins or more."""
    window = tuple(2 if count > 1 else 1 for count in power.shape[1:])
    return avg_pool3d(power[:, None], window)[:, 0]
