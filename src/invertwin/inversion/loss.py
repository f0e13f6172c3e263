"""How far a predicted power map is from an observed one."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Float64
from numpy.typing import NDArray
from torch import Tensor

from invertwin.errors import InputError
from invertwin.limits import Count, Positive

_MIN_POSITIVE = 1e-38  # keeps logarithms finite
_GAIN_STEPS = 8  # at most; three or four do
_GAIN_TOLERANCE = 1e-3  # of the gain: a step this small is the last, and leaves less than 1e-5
_BINS_PER_BLOCK = 2**16  # bins that are worked on at a time: what they need stays in a core's cache

LOSS_KINDS = ("mse", "likelihood", "heavy_tailed")
BACKGROUNDS = ("none", "level", "static")
PowerArray = TypeVar("Power", Tensor, NDArray[np.float32])
_PowerBlock = tuple[
    Tensor, Tensor, Tensor
]  # of a simulated map, what it holds of power, the measured
MapPairs = Sequence[tuple[Tensor, Tensor]]
"""The predicted and the observed map of every observation."""


def relative_error(simulated: Tensor, measured: Tensor) -> Tensor:
    """``mean|a − b|² / mean|b|²`` of maps of any form, also of complex signals.

    Args:
        simulated: a.
        measured: b.
    """
    return (simulated - measured).abs().square().mean() / measured.abs().square().mean()


def speckle_divergence(ratio: Tensor, degrees: float = math.inf) -> Tensor:
    """How much less likely the power of speckle is than if it were its mean.

    Exponential power whose mean is μ times an inverse gamma variable of ν degrees, q times its
    μ: the negative logarithm of the density is log μ + (ν + 1) log(1 + q / ν) but for a constant.
    For ν → ∞ it is that of fully developed speckle, log μ + q, under which a few echoes that the
    model does not hold outweigh all others: they count by q; else they count by its logarithm.

    Args:
        ratio: q, power over its mean.
        degrees: ν.

    Returns:
        The divergence: 0 for q = 1, positive elsewhere.

    Source: Conte and Longo, "Characterisation of radar clutter as a spherically invariant random
    process", IEE Proceedings F 134, 1987.
    Differs from the source: the mean over textures is that of ν degrees about a mean that is
    modelled, not of a fitted K distribution.
    """
    if math.isinf(degrees):
        return ratio - ratio.log() - 1
    tail = torch.log1p(ratio / degrees) - math.log1p(1 / degrees)
    return (degrees + 1) * tail - ratio.log()


def speckle_weight(ratio: PowerArray, degrees: float) -> PowerArray:
    """By how much less a bin counts in slopes than under plain speckle: (ν + 1) / (ν + q).

    Args:
        ratio: q, power over its mean.
        degrees: ν.
    """
    return (degrees + 1) / (degrees + ratio)


@dataclass(frozen=True)
class SpectrumLoss:
    """Multiscale difference of power maps.

    a, b are the simulated and the measured map; each level pools the bins of the one before in
    pairs, and the loss is the mean over levels. The unknown overall gain g ≥ 0 minimises the loss
    in closed form (``mse``) or by a short fixed-point iteration (the others); being a
    minimiser, it needs no derivative.

    Attributes:
        kind: ``mse``: ``mean((g a − b)²) / mean(b²)``. ``likelihood``: the Itakura–Saito
            divergence ``mean(q − log q − 1)``, ``q = (b + n) / (g a + n)``, which is the
            likelihood of fully developed speckle (power with an exponential distribution, or
            gamma after averaging). It weighs weak and strong echoes by their information, so that
            the speckle of a bright wall does not drown a dim object. ``heavy_tailed``: the same
            for speckle whose mean is itself uncertain (``speckle_divergence``), so that echoes
            that the scene does not hold count by the logarithm of q, not by q. It suits measured
            data.
        levels: Number of resolutions.
        gain: ``fitted``, or ``one`` for calibrated data.
        background: ``mse`` only. What is taken out of both maps first, again in closed form:
            nothing, one common ``level``, or the ``static`` part, the mean over frames of every
            bin (what clutter removal did to the data).
        floor: Not for ``mse``. n over the mean of b: noise and sidelobes below this do not
            count.
        degrees: ``heavy_tailed`` only. ν: about how many looks the mean of a bin is known by.

    Source: §4.2 of the paper (multiscale MSE).
    Differs from the source: the gain and the background are not parameters of the descent; the
    likelihoods are ours.

    Raises:
        InputError: No levels, an unknown choice, or a background with a likelihood.
    """

    kind: Literal["mse", "likelihood", "heavy_tailed"] = "mse"
    levels: Count = 3
    gain: Literal["fitted", "one"] = "fitted"
    background: Literal["none", "level", "static"] = "none"
    floor: Positive = 0.01
    degrees: Positive = 4.0

    def __post_init__(self) -> None:
        if self.kind not in LOSS_KINDS:
            raise InputError(
                f"expected kind among {', '.join(LOSS_KINDS)}, got {self.kind!r}; choose one"
            )
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
        if self.kind != "mse" and (self.background != "none" or not self.floor > 0):
            raise InputError(
                f"expected no background and floor > 0 with kind {self.kind!r}, got "
                f"{self.background!r} and {self.floor}; the floor stands for a background"
            )
        if not self.degrees > 0:
            raise InputError(
                f"expected degrees > 0, got {self.degrees}; 4 suits echoes that are not all known"
            )

    @property
    def _tail_degrees(self) -> float:
        """ν of the speckle."""
        return self.degrees if self.kind == "heavy_tailed" else math.inf

    def _weight_power(self, power: Tensor, inverse: Tensor | float = 1.0) -> Tensor:
        """Power as it counts in slopes, see ``speckle_weight``; all of it under plain speckle.

        Args:
            power: Measured.
            inverse: One over its mean.
        """
        if self.kind == "likelihood":
            return power
        return power * speckle_weight(power * inverse, self.degrees)

    def __call__(
        self,
        simulated: Float[Tensor, "frame *map"],
        measured: Float[Tensor, "frame *map"],
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
        if self.kind != "mse":
            return self._divergence(simulated, measured)
        pairs = self._pyramid(simulated, measured)
        return self._squared_error(
            [(self._subtract_background(a), self._subtract_background(b)) for a, b in pairs]
        )

    def curvature(
        self,
        simulated: Float[Tensor, "frame *map"],
        measured: Float[Tensor, "frame *map"],
        tangents: Float[Tensor, "p frame *map"],
    ) -> Float[Tensor, "p p"]:
        """The Gauss–Newton matrix of the loss: its second derivatives but for those of the map.

        Under ``mse`` it is twice the matrix of squared residuals, else the Fisher information of
        the speckle. A fitted gain is eliminated: what it can explain tells nothing
        about the parameters.

        Args:
            simulated, measured: The maps.
            tangents: Derivatives of the simulated map with respect to p parameters.
        """
        pairs = self._pyramid(simulated.detach(), measured)
        # The derivative of a map with respect to the logarithm of its gain is the map.
        rows = torch.cat([tangents, simulated.detach()[None].to(tangents)])
        rows = rows / self._normalisations(simulated, measured)[0]
        if self.kind == "mse":
            pairs = [(self._subtract_background(a), self._subtract_background(b)) for a, b in pairs]
        gain = self._optimal_gain(pairs)
        total = rows.new_zeros(len(rows), len(rows), dtype=torch.float64)
        for level, (a, b) in enumerate(pairs):
            if level > 0:
                rows = halve_resolution(rows.flatten(0, 1)).unflatten(0, (len(rows), -1))
            if self.kind == "mse":
                weight = 2 * gain**2 / b.square().mean().clamp_min(1e-30)
                weighed = torch.stack([self._subtract_background(row) for row in rows]).flatten(1)
            else:
                weight = 1.0 / (1.0 + 2.0 / self._tail_degrees)
                weighed = (
                    rows * ((a > 0) * gain / (gain * a.clamp_min(0.0) + self.floor))
                ).flatten(1)
            product = (weighed @ weighed.T).double()
            total = total + weight * product / (weighed.shape[1] * len(pairs))
        own, mixed = total[:-1, :-1], total[:-1, -1:]
        if self.gain == "fitted" and float(total[-1, -1]) > 0:
            own = own - mixed @ mixed.T / total[-1, -1]
        return own

    def fitted_gain(self, simulated: Tensor, measured: Tensor) -> float:
        """What the simulated map is multiplied by to be nearest to the measured one.

        Args:
            simulated: Power.
            measured: Power.
        """
        unit, scale = self._normalisations(simulated, measured)
        pairs = self._pyramid(simulated.detach(), measured)
        if self.kind == "mse":
            pairs = [(self._subtract_background(a), self._subtract_background(b)) for a, b in pairs]
        return float(self._optimal_gain(pairs) * scale / unit)

    def _normalisations(self, simulated: Tensor, measured: Tensor) -> tuple[Tensor, Tensor]:
        """What the simulated and the measured map are divided by."""
        scale = _mean_magnitude(measured)
        if not scale > 0:
            raise InputError("expected a measured map with power in it, got zeros; check the grid")
        unit = _mean_magnitude(simulated) if self.gain == "fitted" else scale
        return torch.where(unit > 0, unit, 1.0), scale

    def _resolutions(self, power: Tensor) -> list[Tensor]:
        """A map at all resolutions."""
        found = [power]
        while len(found) < self.levels:
            found.append(halve_resolution(found[-1]))
        return found

    def _pyramid(self, simulated: Tensor, measured: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Both maps at all resolutions, in units near one."""
        unit, scale = self._normalisations(simulated, measured)
        both = (
            self._resolutions(simulated / unit),
            self._resolutions(measured.to(simulated) / scale),
        )
        return list(zip(*both, strict=True))

    def _optimal_gain(self, pairs: list[tuple[Tensor, Tensor]]) -> Tensor:
        """The gain that minimises the loss."""
        gain = torch.ones(())
        if self.gain == "one":
            return gain
        with torch.no_grad():
            if self.kind == "mse":
                norms = [b.square().mean().clamp_min(1e-30) for _, b in pairs]
                both = list(zip(pairs, norms, strict=True))
                mixed = torch.stack([(a * b).mean() / n for (a, b), n in both]).sum()
                power = torch.stack([(a * a).mean() / n for (a, _), n in both]).sum()
                return (mixed / power.clamp_min(1e-30)).clamp_min(0.0)
            return gain * self._likelihood_gain([self._split_blocks(*pair) for pair in pairs])

    def _split_blocks(self, a: Tensor, b: Tensor, scale: Any = 1.0) -> list[_PowerBlock]:
        """What both maps hold of power, the measured one in its unit with the floor added."""
        columns = (x.detach().flatten().split(_BINS_PER_BLOCK) for x in (a, b))
        return [
            (x, x.clamp_min(0.0), (y.to(x) / scale).clamp_min_(0.0).add_(self.floor))
            for x, y in zip(*columns, strict=True)
        ]

    def _likelihood_gain(self, levels: list[list[_PowerBlock]], unit: float = 1.0) -> float:
        """The gain of a likelihood over the unit, by a secant on its logarithm."""
        if self.gain == "one":
            return 1.0 / unit
        floor = torch.as_tensor(self.floor).to(levels[0][0][0])
        counts = [sum(len(a) for a, *_ in blocks) for blocks in levels]
        place, slope = -math.log(unit), 1.0
        # The coarse maps are quick, and their gain is nearly that of all.
        for first in (1, 0):
            step, before = 0.0, 0.0
            for _ in range(_GAIN_STEPS):
                up, down = 0.0, 0.0
                for blocks, count in zip(levels[first:], counts[first:], strict=True):
                    for _, a, b in blocks:
                        inverse = torch.add(floor, a, alpha=math.exp(place)).reciprocal_()
                        down += float(a @ inverse) / count
                        up += (
                            float(self._weight_power(b, inverse) @ inverse.square_().mul_(a))
                            / count
                        )
                move = math.log(max(up, _MIN_POSITIVE) / max(down, _MIN_POSITIVE))
                if step != 0:
                    slope = min(max((before - move) / step, 0.1), 1.0)
                before, step = move, move / slope
                place += step
                if abs(step) < _GAIN_TOLERANCE:
                    break
        return math.exp(place)

    def _squared_error(self, pairs: list[tuple[Tensor, Tensor]]) -> Tensor:
        gain = self._optimal_gain(pairs)
        norms = [b.detach().square().mean().clamp_min(1e-30) for _, b in pairs]
        terms = [(gain * a - b).square().mean() / n for (a, b), n in zip(pairs, norms, strict=True)]
        return torch.stack(terms).mean()

    def _divergence(self, simulated: Tensor, measured: Tensor) -> Tensor:
        # torch has no public name for this question.
        transformed = torch._C._are_functorch_transforms_active()  # pyright: ignore[reportPrivateUsage]
        if not transformed:
            return _ScalarWithGradient.apply(
                simulated, *self._divergence_and_gradient(simulated, measured)
            )
        # Such as a second derivative.
        pairs = self._pyramid(simulated, measured)
        gain = self._optimal_gain(pairs)
        ratios = [
            (b.clamp_min(0.0) + self.floor) / (gain * a.clamp_min(0.0) + self.floor)
            for a, b in pairs
        ]
        return torch.stack(
            [speckle_divergence(q, self._tail_degrees).mean() for q in ratios]
        ).mean()

    @torch.no_grad()
    def _divergence_and_gradient(
        self, simulated: Tensor, measured: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The divergence, and its derivative with respect to the simulated map.

        The maps are large, and torch's own derivative keeps and reads each of them several times.
        """
        unit, scale = self._normalisations(simulated, measured)
        maps = [self._resolutions(power) for power in (simulated.detach(), measured)]
        levels = [self._split_blocks(a, b, scale) for a, b in zip(*maps, strict=True)]
        gain = self._likelihood_gain(levels, float(unit))
        value, slope = 0.0, None
        for power, blocks in zip(reversed(maps[0]), reversed(levels), strict=True):
            factor = gain / (power.numel() * self.levels)
            own = torch.empty_like(power, memory_format=torch.contiguous_format)
            slopes = own.flatten().split(_BINS_PER_BLOCK)
            for (a, lit, data), out in zip(blocks, slopes, strict=True):
                inverse = lit.mul_(gain).add_(self.floor).reciprocal_()
                ratio = data.mul_(inverse)
                value += float(speckle_divergence(ratio, self._tail_degrees).sum()) / power.numel()
                inverse.addcmul_(inverse, self._weight_power(ratio), value=-1).mul_(factor)
                # What is below zero counts as zero, and has no derivative; a dark bin has one.
                least = -torch.finfo(a.dtype).tiny
                torch.ops.aten.threshold_backward(inverse, a, least, grad_input=out)
            slope = own if slope is None else _add_pooling_adjoint(slope, own)
        assert slope is not None
        return slope.new_tensor(value / self.levels), slope

    def _subtract_background(self, power: Tensor) -> Tensor:
        if self.background == "level":
            return power - power.mean()
        if self.background == "static":
            return power - power.mean(0, keepdim=True)
        return power


class _ScalarWithGradient(torch.autograd.Function):
    """A number whose derivative with respect to a map is known."""

    @staticmethod
    def forward(ctx: Any, power: Tensor, value: Tensor, gradient: Tensor) -> Tensor:
        """The number, of a map."""
        ctx.save_for_backward(gradient)
        ctx.save_for_forward(gradient)
        return value.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        (slope,) = ctx.saved_tensors
        return slope * grads[0], None, None

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Tensor:  # type: ignore[override]
        (slope,) = ctx.saved_tensors
        return (slope * tangents[0]).sum()


CorrelationScale = Literal["magnitude", "power", "level"]


@dataclass(frozen=True)
class CorrelationLoss:
    """One minus Pearson's correlation of two power maps; no gain or offset changes it.

    Attributes:
        scale: ``magnitude`` (square root of power), ``power``, or ``level`` (dB, no lower than
            40 dB below the map's own peak).

    Raises:
        InputError: An unknown scale.
    """

    scale: CorrelationScale = "magnitude"

    def __post_init__(self) -> None:
        if self.scale not in _SCALE_TRANSFORMS:
            raise InputError(
                f"expected a scale of {', '.join(_SCALE_TRANSFORMS)}, got {self.scale!r}; choose "
                f"one"
            )

    def __call__(
        self, simulated: Float[Tensor, "*map"], measured: Float[Tensor, "*map"]
    ) -> Float64[Tensor, ""]:
        """The loss: 0 for maps of one pattern, 1 for unrelated ones.

        Args:
            simulated, measured: Power.

        Raises:
            InputError: Maps of different shapes.
        """
        if simulated.shape != measured.shape:
            raise InputError(
                f"expected maps of one shape, got {tuple(simulated.shape)} and "
                f"{tuple(measured.shape)}; use one grid for both"
            )
        rows = []
        for power in (simulated, measured):
            row = _SCALE_TRANSFORMS[self.scale](
                power.to(torch.float64) / power.detach().max()
            ).flatten()
            row = row - row.mean()
            rows.append(row / row.norm())
        return 1 - rows[0] @ rows[1]


_MIN_RELATIVE_POWER = 1e-4  # of the peak: below it levels are noise
_SQRT_OFFSET = 1e-12  # of the peak: keeps the derivative of a magnitude finite
_SCALE_TRANSFORMS: dict[str, Callable[[Tensor], Tensor]] = {
    # An interpolated response may fall a little below zero.
    "magnitude": lambda share: (share.clamp(min=0) + _SQRT_OFFSET).sqrt(),
    "power": lambda share: share,
    "level": lambda share: share.clamp(min=_MIN_RELATIVE_POWER).log(),
}


@dataclass(frozen=True)
class Objective:
    """The weighted mean of the losses of all observations.

    Attributes:
        losses, weights: One per observation.
    """

    losses: tuple[Callable[[Tensor, Tensor], Tensor], ...]
    weights: tuple[float, ...]

    def __call__(self, maps: MapPairs) -> Float[Tensor, ""]:
        """The loss of the maps of all observations."""
        terms = [
            weight * loss(*pair)
            for loss, weight, pair in zip(self.losses, self.weights, maps, strict=True)
        ]
        return torch.stack(terms).sum() / sum(self.weights)

    def curvature(
        self, maps: MapPairs, tangents: Sequence[Float[Tensor, "p *map"]]
    ) -> Float[Tensor, "p p"]:
        """The Gauss–Newton matrix of the mean.

        Args:
            maps: Predicted and observed maps.
            tangents: For every observation, derivatives of its predicted map with respect to p
                parameters.
        """
        total = torch.zeros((), dtype=torch.float64)
        for loss, weight, pair, rows in zip(self.losses, self.weights, maps, tangents, strict=True):
            assert isinstance(loss, SpectrumLoss)
            total = total + weight * loss.curvature(*pair, rows)
        return total / sum(self.weights)


def _mean_magnitude(power: Tensor) -> Tensor:
    """The mean of the absolute values, detached."""
    return power.detach().abs().mean()


def halve_resolution(power: Tensor) -> Tensor:
    """Half the resolution along every axis that has two bins or more.

    Args:
        power: [frame, …].
    """
    # Axis by axis, since whole rows are added quickly: half the time of ``avg_pool3d``.
    share = 1.0
    for dim in range(1, power.ndim):
        if half := power.shape[dim] // 2:
            first, second = power.narrow(dim, 0, 2 * half).unflatten(dim, (half, 2)).unbind(dim + 1)
            power, share = first + second, 0.5 * share
    return share * power


def _add_pooling_adjoint(coarse: Tensor, power: Tensor) -> Tensor:
    """The adjoint of pooling, added to a map of twice the resolution."""
    for dim in reversed(range(2, power.ndim)):
        if power.shape[dim] > 1:
            coarse = (0.5 * coarse).repeat_interleave(2, dim)
    target = power[(slice(None), slice(None), *map(slice, coarse.shape[2:]))]
    if half := power.shape[1] // 2:
        target, coarse = target[:, : 2 * half].unflatten(1, (half, 2)), 0.5 * coarse[:, :, None]
    target += coarse
    return power
