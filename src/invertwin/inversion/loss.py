"""Losses between predicted and observed power maps."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Float64
from numpy.typing import NDArray
from torch import Tensor

from invertwin.checks import CheckedFields, check_fields, check_shape
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel
from invertwin.limits import Count, Positive

_Bins: TypeAlias = Float[Tensor, "*map"]
_MIN_POSITIVE = 1e-38  # lower limit of divisors, and noise as good as none
_GAIN_STEPS = 30  # maximum number of iterations at a resolution; three or four suffice
_GAIN_CHANGES = -0.8, 2.0  # limits of a relative step
# Relative step of gain and noise at which the iteration ends; the remaining error is its square.
_GAIN_TOLERANCE = 1e-3
_LITTLE_NOISE, _MIN_NOISE = 0.1, 5e-3  # of the floor: near zero, and none
_INITIAL_NOISE = 0.1  # of the mean power
_MAX_NEGATIVE = 0.1  # of the peak: less is rounding or interpolation of power
_BINS_PER_BLOCK = 2**16  # bins per block, so that the working set fits a core's cache

PowerArray = TypeVar("PowerArray", Tensor, NDArray[np.float32])
_PowerBlock = tuple[Tensor, Tensor, Tensor]  # simulated map, its positive part, measured power
_Map = Float[Tensor, "frame *map"]  # of one observation
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
    return (degrees + 1) * (torch.log1p(ratio / degrees) - math.log1p(1 / degrees)) - ratio.log()


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
    and the loss is the mean over levels. The unknown overall gain g ≥ 0 and, of the likelihoods,
    the unknown mean power n ≥ 0 of noise in a bin minimise the loss, in closed form (``mse``) or by
    Newton's method (the others); as minimisers, they need no derivative.

    Attributes:
        kind: ``likelihood``: the Itakura–Saito divergence ``mean(q − log q − 1)``,
            ``q = b / (g a + n)``, which is the likelihood of fully developed speckle (power
            with an exponential distribution, or gamma after averaging). It weighs weak and strong
            echoes by their information, so that the speckle of a strong reflector does not mask a
            weak one. ``heavy_tailed``: the same for speckle with an uncertain mean
            (``speckle_divergence``), so that unmodelled echoes contribute the logarithm of q, not
            q. It suits measured data. ``mse``: ``mean((g a − b)²) / mean(b²)``, also for maps that
            are not power.
        levels: number of resolutions.
        gain: ``fitted``, or ``one`` for calibrated data.
        background: ``none``, one common ``level``, or ``mse`` only the ``static`` part, the mean
            over frames of every bin (as clutter removal does). Under ``mse`` it is removed from
            both maps; the level of the likelihoods is n. ``auto``: ``level`` for the likelihoods,
            else ``none``.
        floor: not for ``mse``. Power over the mean of b that is added to b and to n: sidelobes
            below it have little weight.
        degrees: ``heavy_tailed`` only. ν: equivalent number of looks that determine the mean of a
            bin.

    Source: §4.2 of the paper (multiscale MSE).
    Differs from the source: the gain and the background are not parameters of the descent; the
    likelihoods are ours.

    Raises:
        InputError: No levels, an unknown choice, or a static background with a likelihood.
    """

    kind: Literal["mse", "likelihood", "heavy_tailed"] = "likelihood"
    levels: Count = 3
    gain: Literal["fitted", "one"] = "fitted"
    background: Literal["auto", "none", "level", "static"] = "auto"
    floor: Positive = 0.01
    degrees: Positive = 4.0

    def __post_init__(self) -> None:
        check_fields(self)
        if self.kind != "mse" and self.background == "static":
            raise InputError(
                f"expected one level as the background with kind {self.kind!r}, got 'static'; give "
                'kind="mse", or remove what stands still from the data'
            )

    @property
    def _has_level(self) -> bool:
        """True if noise is fitted."""
        return self.kind != "mse" and self.background != "none"

    @property
    def _tail_degrees(self) -> float:
        """Degrees of freedom ν of the speckle."""
        return self.degrees if self.kind == "heavy_tailed" else math.inf

    def _weight_power(self, ratio: Tensor) -> Tensor:
        """Weight power over its mean for gradients; plain speckle has weight one."""
        return ratio if self.kind == "likelihood" else ratio * speckle_weight(ratio, self.degrees)

    def __call__(self, simulated: _Map, measured: _Map) -> Float[Tensor, ""]:
        """Return the loss: 0 for equal maps, 1 for an empty simulated map under ``mse``.

        Raises:
            InputError: Different shapes, or a measured map that is zero everywhere.
        """
        _check_shapes(simulated, measured)
        if self.kind != "mse":
            return self._divergence(simulated, measured)
        return self._squared_error(self._pyramid(simulated, measured))

    def curvature(
        self, simulated: _Map, measured: _Map, tangents: Float[Tensor, "p frame *map"]
    ) -> Float[Tensor, "p p"]:
        """Compute the Gauss–Newton matrix of the loss: its Hessian without second derivatives of
        the map.

        Under ``mse`` it is twice the matrix of squared residuals, else the Fisher information of
        the speckle. Fitted gain and noise are eliminated by a Schur complement.

        Args:
            simulated, measured: maps [frame, *map].
            tangents: derivatives of the simulated map with respect to p parameters [p, frame,
                *map].
        """
        pairs = self._pyramid(simulated.detach(), measured)
        # The derivative of a map with respect to the logarithm of its gain is the map.
        rows = torch.cat([tangents, simulated.detach()[None].to(tangents)])
        rows = rows / self._normalisations(simulated, measured)[0]
        gain, noise = self._fit_gain(pairs)
        count, total = len(tangents), torch.zeros((), dtype=torch.float64)
        for level, (a, b) in enumerate(pairs):
            if level > 0:
                rows = halve_resolution(rows.flatten(0, 1)).unflatten(0, (len(rows), -1))
            if self.kind == "mse":
                weight = 2 * gain**2 / b.square().mean().clamp_min(1e-30)
                weighed = torch.stack([self._subtract_background(row) for row in rows]).flatten(1)
            else:
                weight = 1.0 / (1.0 + 2.0 / self._tail_degrees)
                inverse = gain / (gain * a.clamp_min(0.0) + noise + self.floor)
                weighed = torch.cat([rows * (a > 0), torch.ones_like(rows[:1])]) * inverse
                weighed = weighed.flatten(1)
            product = (weighed @ weighed.T).double()
            total = total + weight * product / (weighed.shape[1] * len(pairs))
        fitted = [count] * (self.gain == "fitted")
        # Less noise is near its limit of zero, which keeps it from moving freely.
        fitted += [count + 1] * (noise > _LITTLE_NOISE * self.floor)
        inverse = torch.linalg.pinv(total[fitted][:, fitted], hermitian=True)
        mixed = total[:count, fitted]
        return total[:count, :count] - mixed @ inverse @ mixed.T

    def fitted_gain(self, simulated: Tensor, measured: Tensor) -> float:
        """Return the gain of the simulated map that minimises the loss.

        Args:
            simulated: power [frame, *map].
            measured: power [frame, *map].
        """
        unit, scale = self._normalisations(simulated, measured)
        gain, _ = self._fit_gain(self._pyramid(simulated.detach(), measured))
        return float(gain * scale / unit)

    def _normalisations(self, simulated: Tensor, measured: Tensor) -> tuple[Tensor, Tensor]:
        """Return the divisors of the simulated and the measured map."""
        scale = measured.detach().abs().mean()
        if not scale > 0:
            raise InputError("expected a measured map with power in it, got zeros; check the grid")
        unit = simulated.detach().abs().mean() if self.gain == "fitted" else scale
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

    def _fit_gain(self, pairs: list[tuple[Tensor, Tensor]]) -> tuple[float, float]:
        """Return the gain and the noise that minimise the loss."""
        if self.kind != "mse":
            return self._fit_likelihood([self._split_blocks(*pair) for pair in pairs])
        if self.gain == "one":
            return 1.0, 0.0
        with torch.no_grad():
            norms = [b.square().mean().clamp_min(1e-30) for _, b in pairs]
            both = list(zip(pairs, norms, strict=True))
            mixed = torch.stack([(a * b).mean() / n for (a, b), n in both]).sum()
            power = torch.stack([(a * a).mean() / n for (a, _), n in both]).sum()
            return float((mixed / power.clamp_min(1e-30)).clamp_min(0.0)), 0.0

    def _split_blocks(self, a: Tensor, b: Tensor, scale: Any = 1.0) -> list[_PowerBlock]:
        """Return the positive parts of both maps in blocks, the measured one scaled and with the
        floor added.
        """
        columns = (x.detach().flatten().split(_BINS_PER_BLOCK) for x in (a, b))
        return [
            (x, x.clamp_min(0.0), (y.to(x) / scale).clamp_min_(0.0).add_(self.floor))
            for x, y in zip(*columns, strict=True)
        ]

    def _fit_likelihood(
        self, levels: list[list[_PowerBlock]], unit: float = 1.0
    ) -> tuple[float, float]:
        """Return the gain, in units of ``unit``, and the noise of a likelihood by Newton's method.

        Both are fitted first to the coarse maps, which are fast and nearly do.
        """
        values = torch.tensor([1 / unit, _INITIAL_NOISE * self._has_level], dtype=torch.float64)
        fitted = [0] * (self.gain == "fitted") + [1] * self._has_level
        for part in (levels[1:], levels):
            for _ in range(_GAIN_STEPS if fitted and part else 0):
                slope, hessian = self._differentiate_gain(part, *values.tolist())
                # A loss is nearly quadratic in values that are too large, and in the logarithms of
                # those that are too small. Absolute eigenvalues lead downhill from everywhere.
                hessian = hessian - torch.diag(slope.clamp_min(0))
                sizes, axes = torch.linalg.eigh(hessian[fitted][:, fitted])
                step = axes @ (axes.T @ slope[fitted] / sizes.abs().clamp_min(_MIN_POSITIVE))
                change = torch.zeros_like(values)
                change[fitted] = step.clamp(*_GAIN_CHANGES)
                values = values * torch.where(change > 0, change.exp(), 1 + change)
                # Noise far below the floor does not matter.
                change[1] *= values[1] / (values[1] + self.floor)
                if float(change.abs().max()) < _GAIN_TOLERANCE:
                    break
        gain, noise = values.tolist()
        if noise <= _MIN_NOISE * self.floor:
            return gain, 0.0
        if noise < _LITTLE_NOISE * self.floor:
            # Perhaps on its way to zero, which a relative step never reaches.
            slope, _ = self._differentiate_gain(levels, gain, _MIN_POSITIVE)
            noise = noise if float(slope[1]) > 0 else 0.0
        return gain, noise

    def _differentiate_gain(
        self, levels: list[list[_PowerBlock]], gain: float, noise: float
    ) -> tuple[Tensor, Tensor]:
        """Derivatives of the negative loss and Hessian of the loss by relative gain and noise."""
        like = levels[0][0][0].new_zeros(0, dtype=torch.float64)
        slope, hessian = like.new_zeros(2), like.new_zeros(2, 2)
        for blocks in levels:
            count = sum(len(a) for a, *_ in blocks)
            for _, a, data in blocks:
                inverse = (gain * a).add_(noise + self.floor).reciprocal_()
                ratio = data * inverse
                weighed = growth = self._weight_power(ratio)
                if self.kind == "heavy_tailed":
                    growth = weighed * (self.degrees / (self.degrees + ratio))
                shares = torch.stack([a * inverse, inverse])
                curved = shares * (growth + weighed).sub_(1)
                slope += (shares @ weighed.sub(1)).double() / count
                hessian += (curved @ shares.T).double() / count
        scale = torch.tensor([gain, noise], dtype=torch.float64)
        slope = slope.cpu() * scale
        return slope, hessian.cpu() * scale * scale[:, None]

    def _squared_error(self, pairs: list[tuple[Tensor, Tensor]]) -> Tensor:
        gain, _ = self._fit_gain(pairs)
        norms = [b.detach().square().mean().clamp_min(1e-30) for _, b in pairs]
        terms = [(gain * a - b).square().mean() / n for (a, b), n in zip(pairs, norms, strict=True)]
        return torch.stack(terms).mean()

    def _divergence(self, simulated: Tensor, measured: Tensor) -> Tensor:
        # torch has no public function for this.
        if not torch._C._are_functorch_transforms_active():  # pyright: ignore[reportPrivateUsage]
            value, slope = self._divergence_and_gradient(simulated, measured)
            return _ScalarWithGradient.apply(simulated, value, slope)
        # For example a second derivative.
        pairs = self._pyramid(simulated, measured)
        gain, noise = self._fit_gain(pairs)
        ratios = [
            (b.clamp_min(0.0) + self.floor) / (gain * a.clamp_min(0.0) + noise + self.floor)
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
        gain, noise = self._fit_likelihood(levels, float(unit))
        value, slope = 0.0, None
        for power, blocks in zip(reversed(maps[0]), reversed(levels), strict=True):
            factor = gain / (power.numel() * self.levels)
            own = torch.empty_like(power, memory_format=torch.contiguous_format)
            slopes = own.flatten().split(_BINS_PER_BLOCK)
            for (a, predicted, data), out in zip(blocks, slopes, strict=True):
                inverse = predicted.mul_(gain).add_(noise + self.floor).reciprocal_()
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
        return power - power.mean(0, keepdim=True) if self.background == "static" else power


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
        model: forward model whose maps are compared.
        loss: the given loss; None = the default.
        observed: observed map, which a likelihood expects to be power.

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
class CorrelationLoss(CheckedFields):
    """One minus Pearson's correlation of two power maps; no gain or offset changes it.

    Attributes:
        scale: ``magnitude`` (square root of power), ``power``, or ``level`` (dB, clipped 40 dB
            below the peak of each map).

    Raises:
        InputError: An unknown scale.
    """

    scale: CorrelationScale = "magnitude"

    def __call__(self, simulated: _Bins, measured: _Bins) -> Float64[Tensor, ""]:
        """Return the loss: 0 for proportional maps, 1 for uncorrelated ones.

        Args:
            simulated, measured: power [*map].

        Raises:
            InputError: Maps of different shapes.
        """
        _check_shapes(simulated, measured)
        return 1 - self._unit_row(simulated) @ self._unit_row(measured.to(simulated.device))

    def curvature(
        self, simulated: _Bins, measured: _Bins, tangents: Float[Tensor, "p *map"]
    ) -> Float64[Tensor, "p p"]:
        """The Gauss–Newton matrix: the loss is half the squared distance of two unit vectors.

        Args:
            simulated, measured: the maps.
            tangents: derivatives of the simulated map with respect to p parameters.
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
        return torch.stack([term.to(terms[0].device) for term in terms]).sum() / sum(self.weights)

    def curvature(
        self, maps: MapPairs, tangents: Sequence[Float[Tensor, "p *map"]]
    ) -> Float[Tensor, "p p"]:
        """Compute the Gauss–Newton matrix of the weighted mean, on the CPU as the parameters are.

        Args:
            maps: predicted and observed maps.
            tangents: derivatives of each predicted map with respect to p parameters [p, *map].
        """
        total = torch.zeros((), dtype=torch.float64)
        for loss, weight, pair, rows in zip(self.losses, self.weights, maps, tangents, strict=True):
            assert isinstance(loss, CURVED)
            total = total + weight * loss.curvature(*pair, rows).cpu()
        return total / sum(self.weights)


def _check_shapes(simulated: Tensor, measured: Tensor) -> None:
    check_shape(simulated, measured.shape, "a map like the measured one", "use one grid for both")


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
