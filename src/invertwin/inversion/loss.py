"""How far a simulated power map is from a measured one."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool3d

from invertwin.errors import InputError

_GAIN_STEPS = 8  # of the fixed point; from the second on the gain moves by parts in a thousand

BACKGROUNDS = ("none", "level", "static")


@dataclass(frozen=True)
class SpectrumLoss:
    """Multiscale difference of power maps.

    a, b are the simulated and the measured map; each level pools the bins of the one before in
    pairs, and the loss is the mean over levels. The unknown overall gain g ≥ 0 minimises the loss
    in closed form (``mse``) or by a short fixed-point iteration (``likelihood``); being a
    minimiser, it needs no derivative.

    Attributes:
        kind: ``mse``: ``mean((g a − b)²) / mean(b²)``. ``likelihood``: the Itakura–Saito
            divergence ``mean(q − log q − 1)``, ``q = (b + n) / (g a + n)``, which is the
            likelihood of fully developed speckle (power with an exponential distribution, or
            gamma after averaging). It weighs weak and strong echoes by what they tell, so that
            the speckle of a bright wall does not drown a dim object.
        levels: Number of resolutions.
        gain: ``fitted``, or ``one`` for calibrated data.
        background: ``mse`` only. What is taken out of both maps first, again in closed form:
            nothing, one common ``level``, or the ``static`` part, the mean over frames of every
            bin (what clutter removal did to the data).
        floor: ``likelihood`` only. n over the mean of b: noise and sidelobes below this do not
            count.

    Source: §4.2 of the paper (multiscale MSE).
    Differs from the source: the gain and the background are not parameters of the descent; the
    likelihood is ours.

    Raises:
        InputError: No levels, an unknown choice, or a background with ``likelihood``.
    """

    kind: Literal["mse", "likelihood"] = "mse"
    levels: int = 3
    gain: Literal["fitted", "one"] = "fitted"
    background: Literal["none", "level", "static"] = "none"
    floor: float = 0.01

    def __post_init__(self) -> None:
        if self.kind not in ("mse", "likelihood"):
            raise InputError(f"expected kind 'mse' or 'likelihood', got {self.kind!r}; choose one")
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
        if self.kind == "likelihood" and (self.background != "none" or not self.floor > 0):
            raise InputError(
                f"expected no background and floor > 0 with kind 'likelihood', got "
                f"{self.background!r} and {self.floor}; the floor stands for a background"
            )

    def __call__(
        self,
        simulated: Float[Tensor, "frame range u v"],
        measured: Float[Tensor, "frame range u v"],
    ) -> Float[Tensor, ""]:
        """The loss: 0 for equal maps, 1 for an empty simulated map under ``mse``.

        Raises:
            InputError: Different shapes, or a measured map that is zero everywhere.
        """
        if simulated.shape != measured.shape:
            raise InputError(
                f"expected maps of one shape, got {tuple(simulated.shape)} and "
                f"{tuple(measured.shape)}; use one grid for both"
            )
        scale = measured.detach().abs().mean()
        if not scale > 0:
            raise InputError("expected a measured map with power in it, got zeros; check the grid")
        unit = simulated.detach().abs().mean()
        unit = torch.where(unit > 0, unit, 1.0) if self.gain == "fitted" else scale
        pairs = []
        a, b = simulated / unit, measured.to(simulated) / scale
        for level in range(self.levels):
            if level:
                a, b = _pooled(a), _pooled(b)
            pairs.append((a, b))
        if self.kind == "likelihood":
            return self._divergence(pairs)
        return self._error([(self._cleared(a), self._cleared(b)) for a, b in pairs])

    def _error(self, pairs: list[tuple[Tensor, Tensor]]) -> Tensor:
        norms = [b.detach().square().mean().clamp_min(1e-30) for _, b in pairs]
        gain = 1.0
        if self.gain == "fitted":
            with torch.no_grad():
                both = list(zip(pairs, norms, strict=True))
                mixed = sum((a * b).mean() / n for (a, b), n in both)
                power = sum((a * a).mean() / n for (a, _), n in both)
                gain = (mixed / power.clamp_min(1e-30)).clamp_min(0.0)  # type: ignore[union-attr]
        terms = [(gain * a - b).square().mean() / n for (a, b), n in zip(pairs, norms, strict=True)]
        return torch.stack(terms).mean()

    def _divergence(self, pairs: list[tuple[Tensor, Tensor]]) -> Tensor:
        positive = [(a.clamp_min(0.0), b.clamp_min(0.0) + self.floor) for a, b in pairs]
        gain = torch.ones(())
        if self.gain == "fitted":
            with torch.no_grad():
                for _ in range(_GAIN_STEPS):
                    up, down = torch.zeros(()), torch.zeros(())
                    for a, b in positive:
                        model = gain * a + self.floor
                        up = up + (a * b / model.square()).mean()
                        down = down + (a / model).mean()
                    gain = gain * (up / down.clamp_min(1e-30))
        terms = []
        for a, b in positive:
            ratio = b / (gain * a + self.floor)
            terms.append((ratio - ratio.log() - 1).mean())
        return torch.stack(terms).mean()

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
