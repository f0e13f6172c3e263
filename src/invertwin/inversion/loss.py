"""Losses between predicted and observed power maps."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Float64
from numpy.typing import NDArray
from torch import Tensor

from invertwin.checks import check_choice
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel
from invertwin.limits import Count, Positive

_MIN_POSITIVE = 1e-38  # lower limit of logarithms
_GAIN_STEPS = 8  # maximum number of iterations; three or four suffice
# Relative step of the gain at which the iteration ends; the remaining error is below 1e-5.
_GAIN_TOLERANCE = 1e-3
_MAX_NEGATIVE = 0.1  # of the peak: less is rounding or interpolation of power
_BINS_PER_BLOCK = 2**16  # bins per block, so that the working set fits a core's cache

LOSS_KINDS = ("mse", "likelihood", "heavy_tailed")
BACKGROUNDS = ("none", "level", "static")
PowerArray = TypeVar("PowerArray", Tensor, NDArray[np.float32])
_PowerBlock = tuple[Tensor, Tensor, Tensor]  # simulated map, its positive part, measured power
MapPairs = Sequence[tuple[Tensor, Tensor]]
"""The predicted and the observed map of every observation."""


def relative_error(simulated: Tensor, measured: Tensor) -> Tensor:
    """Return ``mean|a − b|² / mean|b|²`` of maps of any shape, also of complex signals.

    Args:
        simulated: a [*].
        measured: b [*].
    """
    return (simulated - measured).abs().square().mean() / measured.abs().square().mean()


def speckle_divergence(ratio: Tensor, degrees: float = math.inf) -> Tensor:
    """Compute the negative log-likelihood of speckle power relative to that of its mean.

    Power q μ is exponentially distributed, and its mean is μ times an inverse gamma variable of ν
    degrees of freedom: the negative log density is log μ + (ν + 1) log(1 + q / ν) up to a constant.
    For ν → ∞ it is that of fully developed speckle, log μ + q, under which a few unmodelled echoes
    outweigh all others: they contribute q, and for finite ν its logarithm.

    Args:
        ratio: q, power over its mean.
        degrees: ν, degrees of freedom.

    Returns:
        The divergence: 0 for q = 1, positive elsewhere.

    Source: Conte and Longo, "Characterisation of radar clutter as a spherically invariant random
    process", IEE Proceedings F 134, 1987.
    Differs from the source: the texture has ν degrees of freedom about a modelled mean; no K
    distribution is fitted.
    """
    if math.isinf(degrees):
        return ratio - ratio.log() - 1
    tail = torch.log1p(ratio / degrees) - math.log1p(1 / degrees)
    return (degrees + 1) * tail - ratio.log()


def speckle_weight(ratio: PowerArray, degrees: float) -> PowerArray:
    """Compute the weight of a bin in gradients relative to plain speckle: (ν + 1) / (ν + q).

    Args:
        ratio: q, power over its mean.
        degrees: ν, degrees of freedom.
    """
    return (degrees + 1) / (degrees + ratio)


@dataclass(frozen=True)
class SpectrumLoss:
    """Multiscale difference of power maps.

    a, b are the simulated and the measured map; each level pools pairs of bins of the previous one,
    and the loss is the mean over levels. The unknown overall gain g ≥ 0 minimises the loss in
    closed form (``mse``) or by a short fixed-point iteration (the others); as a minimiser, it needs
    no derivative.

    Attributes:
        kind: ``likelihood``: the Itakura–Saito divergence ``mean(q − log q − 1)``,
            ``q = (b + n) / (g a + n)``, which is the likelihood of fully developed speckle (power
            with an exponential distribution, or gamma after averaging). It weighs weak and strong
            echoes by their information, so that the speckle of a strong reflector does not mask a
            weak one. ``heavy_tailed``: the same for speckle with an uncertain mean
            (``speckle_divergence``), so that unmodelled echoes contribute the logarithm of q, not
            q. It suits measured data. ``mse``: ``mean((g a − b)²) / mean(b²)``, also for maps that
            are not power.
        levels: number of resolutions.
        gain: ``fitted``, or ``one`` for calibrated data.
        background: ``mse`` only. Background to remove from both maps first, in closed form:
            nothing, one common ``level``, or the ``static`` part, the mean over frames of every bin
            (as clutter removal does).
        floor: not for ``mse``. n over the mean of b: noise and sidelobes below it have little
            weight.
        degrees: ``heavy_tailed`` only. ν: equivalent number of looks that determine the mean of a
            bin.

    Source: §4.2 of the paper (multiscale MSE).
    Differs from the source: the gain and the background are not parameters of the descent; the
    likelihoods are ours.

    Raises:
        InputError: No levels, an unknown choice, or a background with a likelihood.
    """

    kind: Literal["mse", "likelihood", "heavy_tailed"] = "likelihood"
    levels: Count = 3
    gain: Literal["fitted", "one"] = "fitted"
    background: Literal["none", "level", "static"] = "none"
    floor: Positive = 0.01
    degrees: Positive = 4.0

    def __post_init__(self) -> None:
        check_choice(self.kind, LOSS_KINDS, "kind among")
        if self.levels < 1 or self.gain not in ("fitted", "one"):
            raise InputError(
                f"expected levels >= 1 and gain 'fitted' or 'one', got {self.levels} and "
                f"{self.gain!r}; 3 levels and a fitted gain suit uncalibrated radars"
            )
        check_choice(self.background, BACKGROUNDS, "background among")
        if self.kind != "mse" and (self.background != "none" or not self.floor > 0):
            raise InputError(
                f"expected no background and floor > 0 with kind {self.kind!r}, got "
                f"{self.background!r} and {self.floor}; the floor stands for a background, or give "
                'kind="mse"'
            )
        if not self.degrees > 0:
            raise InputError(
                f"expected degrees > 0, got {self.degrees}; 4 suits data with unmodelled echoes"
            )

    @property
    def _tail_degrees(self) -> float:
        """Degrees of freedom ν of the speckle."""
        return self.degrees if self.kind == "heavy_tailed" else math.inf

    def _weight_power(self, power: Tensor, inverse: Tensor | float = 1.0) -> Tensor:
        """Weight power for gradients, see ``speckle_weight``; plain speckle has weight one.

        Args:
            power: measured power.
            inverse: one over its mean.
        """
        if self.kind == "likelihood":
            return power
        return power * speckle_weight(power * inverse, self.degrees)

    def __call__(
        self, simulated: Float[Tensor, "frame *map"], measured: Float[Tensor, "frame *map"]
    ) -> Float[Tensor, ""]:
        """Return the loss: 0 for equal maps, 1 for an empty simulated map under ``mse``.

        Raises:
            InputError: Different shapes, or a measured map that is zero everywhere.
        """
        _check_shapes(simulated, measured)
        if self.kind != "mse":
            return self._divergence(simulated, measured)
        return self._squared_error(self._pyramid(simulated, measured))

    def curvature(
        self,
        simulated: Float[Tensor, "frame *map"],
        measured: Float[Tensor, "frame *map"],
        tangents: Float[Tensor, "p frame *map"],
    ) -> Float[Tensor, "p p"]:
        """Compute the Gauss–Newton matrix of the loss: its Hessian without second derivatives of
        the map.

        Under ``mse`` it is twice the matrix of squared residuals, else the Fisher information of
        the speckle. A fitted gain is eliminated by a Schur complement.

        Args:
            simulated, measured: maps [frame, *map].
            tangents: derivatives of the simulated map with respect to p parameters [p, frame,
                *map].
        """
        pairs = self._pyramid(simulated.detach(), measured)
        # The derivative of a map with respect to the logarithm of its gain is the map.
        rows = torch.cat([tangents, simulated.detach()[None].to(tangents)])
        rows = rows / self._normalisations(simulated, measured)[0]
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
                inverse = (a > 0) * gain / (gain * a.clamp_min(0.0) + self.floor)
                weighed = (rows * inverse).flatten(1)
            product = (weighed @ weighed.T).double()
            total = total + weight * product / (weighed.shape[1] * len(pairs))
        own, mixed = total[:-1, :-1], total[:-1, -1:]
        if self.gain == "fitted" and float(total[-1, -1]) > 0:
            own = own - mixed @ mixed.T / total[-1, -1]
        return own

    def fitted_gain(self, simulated: Tensor, measured: Tensor) -> float:
        """Return the gain of the simulated map that minimises the loss.

        Args:
            simulated: power [frame, *map].
            measured: power [frame, *map].
        """
        unit, scale = self._normalisations(simulated, measured)
        pairs = self._pyramid(simulated.detach(), measured)
        return float(self._optimal_gain(pairs) * scale / unit)

    def _normalisations(self, simulated: Tensor, measured: Tensor) -> tuple[Tensor, Tensor]:
        """Return the divisors of the simulated and the measured map."""
        scale = _mean_magnitude(measured)
        if not scale > 0:
            raise InputError("expected a measured map with power in it, got zeros; check the grid")
        unit = _mean_magnitude(simulated) if self.gain == "fitted" else scale
        return torch.where(unit > 0, unit, 1.0), scale

    def _resolutions(self, power: Tensor) -> list[Tensor]:
        """Return a map at all resolutions."""
        found = [power]
        while len(found) < self.levels:
            found.append(halve_resolution(found[-1]))
        return found

    def _pyramid(self, simulated: Tensor, measured: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return both maps at all resolutions, in units near one."""
        unit, scale = self._normalisations(simulated, measured)
        levels = [self._resolutions(m) for m in (simulated / unit, measured.to(simulated) / scale)]
        if self.kind == "mse":
            levels = [[self._subtract_background(m) for m in own] for own in levels]
        return list(zip(*levels, strict=True))

    def _optimal_gain(self, pairs: list[tuple[Tensor, Tensor]]) -> Tensor:
        """Return the gain that minimises the loss."""
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
        """Return the positive parts of both maps in blocks, the measured one scaled and with the
        floor added.
        """
        columns = (x.detach().flatten().split(_BINS_PER_BLOCK) for x in (a, b))
        return [
            (x, x.clamp_min(0.0), (y.to(x) / scale).clamp_min_(0.0).add_(self.floor))
            for x, y in zip(*columns, strict=True)
        ]

    def _likelihood_gain(self, levels: list[list[_PowerBlock]], unit: float = 1.0) -> float:
        """Return the gain of a likelihood in units of ``unit``, by a secant method on its
        logarithm.
        """
        if self.gain == "one":
            return 1.0 / unit
        floor = torch.as_tensor(self.floor).to(levels[0][0][0])
        counts = [sum(len(a) for a, *_ in blocks) for blocks in levels]
        log_gain, slope = -math.log(unit), 1.0
        # Start with the coarse maps, which are fast and have nearly the final gain.
        for first in (1, 0):
            step, before = 0.0, 0.0
            for _ in range(_GAIN_STEPS):
                up, down = 0.0, 0.0
                for blocks, count in zip(levels[first:], counts[first:], strict=True):
                    for _, a, b in blocks:
                        inverse = torch.add(floor, a, alpha=math.exp(log_gain)).reciprocal_()
                        down += float(a @ inverse) / count
                        data = self._weight_power(b, inverse)
                        up += float(data @ inverse.square_().mul_(a)) / count
                move = math.log(max(up, _MIN_POSITIVE) / max(down, _MIN_POSITIVE))
                if step != 0:
                    slope = min(max((before - move) / step, 0.1), 1.0)
                before, step = move, move / slope
                log_gain += step
                if abs(step) < _GAIN_TOLERANCE:
                    break
        return math.exp(log_gain)

    def _squared_error(self, pairs: list[tuple[Tensor, Tensor]]) -> Tensor:
        gain = self._optimal_gain(pairs)
        norms = [b.detach().square().mean().clamp_min(1e-30) for _, b in pairs]
        terms = [(gain * a - b).square().mean() / n for (a, b), n in zip(pairs, norms, strict=True)]
        return torch.stack(terms).mean()

    def _divergence(self, simulated: Tensor, measured: Tensor) -> Tensor:
        # torch has no public function for this.
        transformed = torch._C._are_functorch_transforms_active()  # pyright: ignore[reportPrivateUsage]
        if not transformed:
            value, slope = self._divergence_and_gradient(simulated, measured)
            return _ScalarWithGradient.apply(simulated, value, slope)
        # For example a second derivative.
        pairs = self._pyramid(simulated, measured)
        gain = self._optimal_gain(pairs)
        ratios = [
            (b.clamp_min(0.0) + self.floor) / (gain * a.clamp_min(0.0) + self.floor)
            for a, b in pairs
        ]
        terms = [speckle_divergence(q, self._tail_degrees).mean() for q in ratios]
        return torch.stack(terms).mean()

    @torch.no_grad()
    def _divergence_and_gradient(
        self, simulated: Tensor, measured: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Compute the divergence and its derivative with respect to the simulated map.

        The maps are large, and autograd would store and read each of them several times.
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
            for (a, predicted, data), out in zip(blocks, slopes, strict=True):
                inverse = predicted.mul_(gain).add_(self.floor).reciprocal_()
                ratio = data.mul_(inverse)
                value += float(speckle_divergence(ratio, self._tail_degrees).sum()) / power.numel()
                inverse.addcmul_(inverse, self._weight_power(ratio), value=-1).mul_(factor)
                # Negative bins count as zero without a derivative; a bin of zero power has one.
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
    """Scalar with a precomputed derivative with respect to a map."""

    @staticmethod
    def forward(ctx: Any, power: Tensor, value: Tensor, gradient: Tensor) -> Tensor:
        """Return the value."""
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


def resolve_loss(
    model: ForwardModel,
    loss: Callable[[Tensor, Tensor], Tensor] | None,
    observed: Tensor | None = None,
) -> Callable[[Tensor, Tensor], Tensor]:
    """Return the loss for the maps of a model: the given one, or the default.

    The default is the likelihood of speckle for power, and squares of levels or fields as they
    are, of one resolution, for models with ``holds_fields``.

    Args:
        model: Forward model whose maps are compared.
        loss: The given loss; None = the default.
        observed: Observed map, which a likelihood expects to be power.

    Raises:
        InputError: A likelihood of maps that do not hold power.
    """
    if loss is None:
        loss = SpectrumLoss("mse", levels=1, gain="one") if model.holds_fields else SpectrumLoss()
    if isinstance(loss, SpectrumLoss) and loss.kind != "mse":
        expected = f"expected power for a SpectrumLoss of kind {loss.kind!r}"
        if model.holds_fields:
            raise InputError(
                f"{expected}, got the fields or levels of a {type(model).__name__}; give "
                'SpectrumLoss("mse", levels=1, gain="one")'
            )
        if observed is not None and (
            observed.is_complex() or float(observed.min()) < -_MAX_NEGATIVE * float(observed.max())
        ):
            raise InputError(
                f'{expected}, got a map of complex or negative values; give SpectrumLoss("mse"), '
                "or a loss that suits them"
            )
    return loss


CorrelationScale = Literal["magnitude", "power", "level"]


@dataclass(frozen=True)
class CorrelationLoss:
    """One minus Pearson's correlation of two power maps; no gain or offset changes it.

    Attributes:
        scale: ``magnitude`` (square root of power), ``power``, or ``level`` (dB, clipped 40 dB
            below the peak of each map).

    Raises:
        InputError: An unknown scale.
    """

    scale: CorrelationScale = "magnitude"

    def __post_init__(self) -> None:
        check_choice(self.scale, _SCALE_TRANSFORMS, "a scale of")

    def __call__(
        self, simulated: Float[Tensor, "*map"], measured: Float[Tensor, "*map"]
    ) -> Float64[Tensor, ""]:
        """Return the loss: 0 for proportional maps, 1 for uncorrelated ones.

        Args:
            simulated, measured: power [*map].

        Raises:
            InputError: Maps of different shapes.
        """
        _check_shapes(simulated, measured)
        return 1 - self._unit_row(simulated) @ self._unit_row(measured)

    def curvature(
        self,
        simulated: Float[Tensor, "*map"],
        measured: Float[Tensor, "*map"],
        tangents: Float[Tensor, "p *map"],
    ) -> Float64[Tensor, "p p"]:
        """The Gauss–Newton matrix: the loss is half the squared distance of two unit vectors.

        Args:
            simulated, measured: The maps.
            tangents: Derivatives of the simulated map with respect to p parameters.
        """
        power = simulated.detach()
        rows = [torch.func.jvp(self._unit_row, (power,), (t.to(power),))[1] for t in tangents]
        found = torch.stack(rows) if rows else power.new_zeros(0, power.numel())
        return found @ found.T

    def _unit_row(self, power: Tensor) -> Tensor:
        """A map at the scale of the loss, without its mean, of length one."""
        share = power.to(torch.float64) / power.detach().max()
        row = _SCALE_TRANSFORMS[self.scale](share).flatten()
        row = row - row.mean()
        return row / row.norm()


_MIN_RELATIVE_POWER = 1e-4  # relative to the peak: lower levels are noise
_SQRT_OFFSET = 1e-12  # relative to the peak: keeps the derivative of a magnitude finite
_SCALE_TRANSFORMS: dict[str, Callable[[Tensor], Tensor]] = {
    # An interpolated response may be slightly negative.
    "magnitude": lambda share: (share.clamp(min=0) + _SQRT_OFFSET).sqrt(),
    "power": lambda share: share,
    "level": lambda share: share.clamp(min=_MIN_RELATIVE_POWER).log(),
}


@dataclass(frozen=True)
class RatioLoss:
    """Mean of the predicted over that of the observed map: an aim to be lowered.

    It serves designs, which have no data to be met.
    """

    def __call__(self, simulated: Tensor, measured: Tensor) -> Tensor:
        """The ratio."""
        return simulated.mean() / measured.mean()


CURVED = (SpectrumLoss, CorrelationLoss)
"""Losses with a curvature, which Gauss–Newton and error bars need."""


@dataclass(frozen=True)
class Objective:
    """Weighted mean of the losses of all observations.

    Attributes:
        losses, weights: one per observation.
    """

    losses: tuple[Callable[[Tensor, Tensor], Tensor], ...]
    weights: tuple[float, ...]

    def __call__(self, maps: MapPairs) -> Float[Tensor, ""]:
        """Return the loss of the maps of all observations."""
        terms = [
            weight * loss(*pair)
            for loss, weight, pair in zip(self.losses, self.weights, maps, strict=True)
        ]
        return torch.stack(terms).sum() / sum(self.weights)

    def curvature(
        self, maps: MapPairs, tangents: Sequence[Float[Tensor, "p *map"]]
    ) -> Float[Tensor, "p p"]:
        """Compute the Gauss–Newton matrix of the weighted mean.

        Args:
            maps: predicted and observed maps.
            tangents: derivatives of each predicted map with respect to p parameters [p, *map].
        """
        total = torch.zeros((), dtype=torch.float64)
        for loss, weight, pair, rows in zip(self.losses, self.weights, maps, tangents, strict=True):
            assert isinstance(loss, CURVED)
            total = total + weight * loss.curvature(*pair, rows)
        return total / sum(self.weights)


def _check_shapes(simulated: Tensor, measured: Tensor) -> None:
    if simulated.shape != measured.shape:
        raise InputError(
            f"expected maps of one shape, got {tuple(simulated.shape)} and "
            f"{tuple(measured.shape)}; use one grid for both"
        )


def _mean_magnitude(power: Tensor) -> Tensor:
    """Return the mean of the absolute values, detached."""
    return power.detach().abs().mean()


def halve_resolution(power: Tensor) -> Tensor:
    """Average pairs of bins along every axis of at least two bins.

    Args:
        power: map [frame, …].
    """
    # Axis by axis: adding whole rows takes half the time of ``avg_pool3d``.
    share = 1.0
    for dim in range(1, power.ndim):
        if half := power.shape[dim] // 2:
            first, second = power.narrow(dim, 0, 2 * half).unflatten(dim, (half, 2)).unbind(dim + 1)
            power, share = first + second, 0.5 * share
    return share * power


def _add_pooling_adjoint(coarse: Tensor, power: Tensor) -> Tensor:
    """Add the adjoint of pooling to a map of twice the resolution."""
    for dim in reversed(range(2, power.ndim)):
        if power.shape[dim] > 1:
            coarse = (0.5 * coarse).repeat_interleave(2, dim)
    target = power[(slice(None), slice(None), *map(slice, coarse.shape[2:]))]
    if half := power.shape[1] // 2:
        target, coarse = target[:, : 2 * half].unflatten(1, (half, 2)), 0.5 * coarse[:, :, None]
    target += coarse
    return power
