"""How sure a fit is: error bars from the statistics of the data, and what is not observed."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
import torch.autograd.forward_ad as forward_ad
from jaxtyping import Float64
from scipy import stats
from torch import Tensor, nn

from invertwin.errors import InputError
from invertwin.inversion.confidence.realisations import FitResult
from invertwin.inversion.fit import Fit
from invertwin.inversion.gauss_newton import dual_parameters, penalty_curvature
from invertwin.inversion.loss import SpectrumLoss
from invertwin.runtime.progress import track
from invertwin.scene.parameters import Coordinate, Entries

_MAX_COORDINATES = 64  # coordinates; each costs derivatives of the map
_MIN_INFORMATION_FRACTION = 0.5  # of the information that the noise of the derivatives feigns
_UNOBSERVED_VARIANCE_RATIO = (
    20.0  # times the variance of the best known coordinate, in spans: not observed
)
_UNOBSERVED_VARIANCE = 25.0  # spans squared: not observed, however the others are
_MIN_NAMED_COMPONENT = 0.3  # of a direction: smaller components are not named
_WEAK_VARIANCE = 1 / 16  # spans squared: worse known, a direction is looked at where errors matter
_PROFILE_DISTANCE = 2.0  # spans: where
_PROFILE_REFITS = 3  # Gauss–Newton steps of the others there
_MIN_LOSS_RISE = 1e-3  # of the rise: so much at least


@dataclass(frozen=True)
class Uncertainty:
    """The error bars of a fit.

    They hold what speckle and noise do to the estimate, near the minimum that was found. A wrong
    minimum, a wrong model or a wrong start are the matter of the verdict. A direction that is known
    to a quarter of its span at best has the error bar of the loss two spans away, where this rises
    less than the curvature at the minimum says.

    Attributes:
        names: Of the coordinates, such as "letter.x".
        units: Of the coordinates: "m", "rad", or empty.
        covariance: Of the estimates. What is not observed has a large variance, not an infinite
            one: at least as large as it says.
        unobserved: A sentence for every direction that the data do not tell. It begins with the
            names of its coordinates.
        count: Of the looks, or of the frames, from whose scatter the covariance is estimated.
        source: Whether these are ``looks`` at the twin or ``frames`` of the data.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    covariance: Float64[Tensor, "p p"]
    unobserved: tuple[str, ...]
    count: int
    source: Literal["looks", "frames"]

    @property
    def deviations(self) -> dict[str, float]:
        """One standard deviation of every coordinate, in its unit."""
        return dict(zip(self.names, self.covariance.diagonal().sqrt().tolist(), strict=True))

    @property
    def correlations(self) -> Float64[Tensor, "p p"]:
        """Correlations of the errors."""
        scale = self.covariance.diagonal().rsqrt()
        return self.covariance * scale * scale[:, None]

    def interval(self, level: float = 0.95) -> dict[str, float]:
        """How far the truth is from the estimate at most, with this probability.

        Args:
            level: The probability.
        """
        # Student's law, since the variance is itself an estimate.
        factor = float(stats.t.ppf(0.5 + 0.5 * level, self.count - 1))
        return {name: factor * value for name, value in self.deviations.items()}


class CovarianceEstimator:
    """What the maps at the end of a fit, and looks at its twin, tell about its parameters.

    ``Cov θ = H⁻¹ Cov(g) H⁻¹``: H the Gauss–Newton matrix of the loss, g its gradient on looks at
    the twin with other speckle and noise, both with a gain fitted anew. Derivatives of the map are
    taken in forward mode at the end of the fit, twice with other samples: their noise would feign
    information. Where a model gives no looks, Cov(g) is the scatter of the frames of the data,
    as if no two frames shared speckle.

    Source: the sandwich covariance of estimators; derivations §16.
    Differs from the source: Cov(g) by draws, so that correlated bins and frames count rightly.

    Args:
        result: Of the fit.

    Raises:
        InputError: More than 64 coordinates, or a loss that is no ``SpectrumLoss``.
    """

    def __init__(self, result: FitResult) -> None:
        fit = result.fit
        found = list(iterate_coordinates(fit.modules))
        others = [x for x in fit.objective.losses if not isinstance(x, SpectrumLoss)]
        if len(found) > _MAX_COORDINATES or others:
            raise InputError(
                f"expected a SpectrumLoss and at most {_MAX_COORDINATES} parameters for error "
                f"bars, got "
                f"{type(others[0]).__name__ if others else len(found)}; they are not known for "
                "this fit"
            )
        self._end = result
        first, second = (map_derivatives(fit, found, number) for number in (0, 1))
        # What nothing depends on is held fixed, unless it has a meaning of its own.
        moves = [any(bool(rows[k].any()) for rows in first) for k in range(len(found))]
        kept = [k for k, c in enumerate(found) if moves[k] or math.isfinite(c.span)]
        self._kept, self._found = kept, [found[k] for k in kept]
        first, second = ([rows[kept] for rows in side] for side in (first, second))
        # J₁J₂ᵀ + J₂J₁ᵀ = 2 (mean mean − half half), with half the difference of J₁ and J₂.
        pairs = list(zip(first, second, strict=True))
        self._rows = [(a + b) / 2 for a, b in pairs], [(a - b) / 2 for a, b in pairs]

    def error_bars(
        self, frames: Sequence[int] | None = None, realisations: Sequence[Any] = ()
    ) -> Uncertainty:
        """The error bars.

        Args:
            frames: Numbers of those that count; None = all.
            realisations: At all frames, where only some count.

        Raises:
            InputError: A single frame of a model without looks.
        """
        end, found, rows = self._end, self._found, self._rows
        if frames is not None:
            end = end.select_frames(frames, realisations)
            rows = [[part[:, frames] for part in side] for side in rows]
        objective = end.fit.objective
        curvature, feigned = (objective.curvature(end.maps, some) for some in rows)
        if end.realisation_statistics is not None:
            count, by = len(end.realisation_statistics.losses), "looks"
            scatter, chance = (
                _gradient_covariance(end.realisation_statistics.gradients, some) for some in rows
            )
        else:
            count, by = min(len(b) for _, b in end.maps), "frames"
            if count < 2:
                raise InputError(
                    "expected looks at the twin or several frames for error bars, got one frame "
                    "of a model without looks; they are not known for this fit"
                )
            scatter, chance = (
                _frame_covariance(end.loss_gradients(end.maps)[1], some) for some in rows
            )
        curvature = curvature - feigned + _penalty_curvature(end.fit, found)
        spans = torch.tensor([c.span for c in found], dtype=torch.float64)
        own = curvature.diagonal().clamp_min(1e-30).rsqrt()
        spans = torch.where(spans.isinf(), own, spans)
        square = spans * spans[:, None]
        covariance = _sandwich_covariance(
            *(m * square for m in (curvature, feigned, scatter, chance))
        )
        if frames is None:
            covariance = self._widen_covariance(covariance, spans)
        return Uncertainty(
            tuple(c.name for c in found),
            tuple(c.unit for c in found),
            covariance * square,
            tuple(_describe_unobserved(found, covariance)),
            count,
            by,
        )

    def _widen_covariance(self, covariance: Tensor, spans: Tensor) -> Tensor:
        """The covariance, in units of the spans, with what the loss says far off in weak ways."""
        fit, known = self._end.fit, torch.tensor([math.isfinite(c.span) for c in self._found])
        pairs = zip(*_eigen_rows(covariance[known][:, known]), strict=True)
        weak = [(float(error), axis) for error, axis in pairs if _WEAK_VARIANCE < error < 1]
        if not weak or bool(_penalty_curvature(fit, self._found).any()):
            return covariance
        with torch.no_grad():
            target = [predicted for predicted, _ in fit.unblurred_maps(0)]
        own = fit.objective.curvature([(a, a) for a in target], self._rows[0])
        inverse = torch.linalg.pinv(own * spans * spans[:, None], hermitian=True)
        for error, axis in weak:
            way = torch.zeros(len(spans), dtype=torch.float64)
            way[known] = axis
            said = 0.5 * _PROFILE_DISTANCE**2 / float(way @ inverse @ way)
            rise = min(
                self._profile_loss(far * way, spans, target)
                for far in (_PROFILE_DISTANCE, -_PROFILE_DISTANCE)
            )
            more = error * (said / max(rise, _MIN_LOSS_RISE * said) - 1)
            covariance = covariance + max(more, 0.0) * way * way[:, None]
        return covariance

    def _profile_loss(self, displacement: Tensor, spans: Tensor, target: list[Tensor]) -> float:
        """The loss where the twin is moved and all other coordinates make the best of it.

        It is infinite where the scene refuses the move.

        Args:
            displacement: In units of the spans.
            spans: Of the coordinates.
            target: What stands for the data: the twin's own maps.
        """
        fit, least = self._end.fit.copy(), math.inf

        def here() -> list[Coordinate]:
            every = list(iterate_coordinates(fit.modules))
            return [every[k] for k in self._kept]

        across = torch.linalg.svd(displacement[None])[2][
            1:
        ]  # the ways that are perpendicular to the move
        for step in range(_PROFILE_REFITS + 1):
            with torch.no_grad():
                for change, coordinate in zip((displacement * spans).tolist(), here(), strict=True):
                    for name, tangent in coordinate.tangents.items():
                        fit.modules.get_parameter(name).add_(tangent, alpha=change)
                try:
                    maps = [(a, b) for (a, _), b in zip(fit.unblurred_maps(0), target, strict=True)]
                except InputError:
                    return least
            loss, slopes = self._end.loss_gradients(maps)
            least = min(least, loss)
            if step < _PROFILE_REFITS:
                rows = map_derivatives(fit, here(), 0)
                parts = zip(rows, slopes, strict=True)
                slope = torch.stack([a.flatten(1) @ b.flatten() for a, b in parts]).sum(0)
                own = fit.objective.curvature(maps, rows) * spans * spans[:, None]
                own, slope = across @ own @ across.T, across @ (slope.double() * spans)
                displacement = -across.T @ torch.linalg.pinv(own, hermitian=True) @ slope
        return least


def iterate_coordinates(module: nn.Module, path: str = "") -> Iterator[Coordinate]:
    """What a module and its parts find, with parameters by their whole name.

    Args:
        module: What is fitted.
        path: Name of the module, with a dot at its end.
    """
    if hasattr(module, "coordinates"):
        for own in module.coordinates():  # type: ignore[operator]
            if all(module.get_parameter(name).requires_grad for name in own.tangents):
                tangents = {path + name: tangent for name, tangent in own.tangents.items()}
                yield Coordinate(own.name, own.unit, tangents, own.span)
        return
    known: dict[str, Entries] = getattr(module, "entries", dict)()
    held = {entry.parameter for entry in known.values()}
    known |= {n: Entries(n) for n, _ in module.named_parameters(recurse=False) if n not in held}
    prefix = f"{module.object}." if hasattr(module, "object") else path
    for name, entry in known.items():
        parameter = module.get_parameter(entry.parameter)
        part = parameter.detach()[entry.index]
        for number in range(part.numel() if parameter.requires_grad else 0):
            one = torch.zeros_like(part)
            one.view(-1)[number] = 1.0
            tangent = torch.zeros_like(parameter.detach())
            tangent[entry.index] = one / entry.slope
            shown = prefix + name + (f"[{number}]" if part.numel() > 1 else "")
            yield Coordinate(shown, "", {path + entry.parameter: tangent})
    for name, child in module.named_children():
        if not any(whole.startswith(f"{name}.") for whole in held):
            yield from iterate_coordinates(child, f"{path}{name}.")


def map_derivatives(fit: Fit, coordinates: Sequence[Coordinate], seed_number: int) -> list[Tensor]:
    """For every observation the derivatives of its predicted map [coordinate, …].

    Args:
        fit: At its end.
        found: What the maps are derived by.
        seed_number: Other numbers have other random numbers.
    """
    rows: list[list[Tensor]] = []
    for coordinate in track(coordinates, "derivatives"):
        with forward_ad.dual_level(), dual_parameters(fit.modules, coordinate.tangents):
            duals = [
                forward_ad.unpack_dual(predicted)
                for predicted, _ in fit.unblurred_maps(seed_number)
            ]
            rows.append([torch.zeros_like(p) if t is None else t for p, t in duals])
    return [torch.stack(column) for column in zip(*rows, strict=True)]


def _gradient_covariance(
    loss_gradients: Sequence[Sequence[Tensor]], map_derivatives: Sequence[Tensor]
) -> Tensor:
    """Covariance of the gradient over draws."""
    flat = [part.flatten(1) for part in map_derivatives]
    scores = torch.stack(
        [
            torch.stack([f @ s.flatten() for f, s in zip(flat, own, strict=True)]).sum(0)
            for own in loss_gradients
        ]
    )
    return torch.cov(scores.T.double()).reshape(len(flat[0]), -1)


def _frame_covariance(
    loss_gradients: Sequence[Tensor], map_derivatives: Sequence[Tensor]
) -> Tensor:
    """Covariance of the gradient from the scatter of the terms of single frames."""
    total = torch.zeros((), dtype=torch.float64)
    for slope, own in zip(loss_gradients, map_derivatives, strict=True):
        scores = torch.einsum("pfn,fn->pf", own.flatten(2), slope.flatten(1)).double()
        total = total + len(slope) * torch.cov(scores).reshape(len(own), -1)
    return total


def _penalty_curvature(fit: Fit, coordinates: Sequence[Coordinate]) -> Tensor:
    """Second derivatives of the regularisers along the coordinates."""
    free = {n: p for n, p in fit.modules.named_parameters() if p.requires_grad}
    tangents = (
        torch.stack(
            [
                torch.cat(
                    [c.tangents.get(n, torch.zeros_like(p)).flatten() for n, p in free.items()]
                )
                for c in coordinates
            ]
        )
        .detach()
        .double()
    )
    every = torch.ones(tangents.shape[1], dtype=torch.bool)
    with torch.enable_grad():
        own = penalty_curvature(fit.penalty, list(free.values()), every)
    return tangents @ own @ tangents.T


def _sandwich_covariance(
    curvature: Tensor, curvature_bias: Tensor, scatter: Tensor, scatter_bias: Tensor
) -> Tensor:
    """The sandwich, in units of the spans; directions without information get large errors."""
    values, axes = torch.linalg.eigh(curvature)
    least = _MIN_INFORMATION_FRACTION * (axes.T @ curvature_bias @ axes).diagonal().clamp_min(1e-30)
    seen = values > least
    values = values.clamp_min(least)
    inner = axes.T @ (scatter - scatter_bias) @ axes * (seen * seen[:, None])
    noise = (axes.T @ scatter_bias @ axes).diagonal()
    blind = torch.maximum(noise, 2 * _UNOBSERVED_VARIANCE * values.square())
    inner += torch.diag(torch.where(seen, 0.0, blind))
    powers, turned = torch.linalg.eigh(inner / (values * values[:, None]))
    axes = axes @ turned
    return axes @ torch.diag(powers.clamp_min(1e-30)) @ axes.T


def _describe_unobserved(coordinates: Sequence[Coordinate], covariance: Tensor) -> Iterator[str]:
    """Says which directions are more uncertain than their spans, and far more than the best."""
    known = [k for k, c in enumerate(coordinates) if math.isfinite(c.span)]
    own = covariance[known][:, known]
    for error, axis in zip(*_eigen_rows(own), strict=True):
        if not error > max(
            1.0, min(_UNOBSERVED_VARIANCE_RATIO * float(own.diagonal().min()), _UNOBSERVED_VARIANCE)
        ):
            continue
        parts = [
            k
            for k in axis.abs().argsort(descending=True).tolist()
            if abs(axis[k]) > _MIN_NAMED_COMPONENT
        ]
        names = " and ".join(coordinates[known[k]].name for k in parts)
        if len(parts) > 1:
            mixed = " ".join(f"{float(axis[k]):+.2f} {coordinates[known[k]].name}" for k in parts)
            yield f"{names}: not observed along {mixed}, in units of their spans"
            continue
        alone = coordinates[known[parts[0]]]
        shares = {
            coordinates[k].name: float(
                error * alone.span**2 / (covariance[k, k] * coordinates[k].span ** 2)
            )
            for k in known
            if coordinates[k].unit == alone.unit and coordinates[k].name != alone.name
        }
        best = max(shares, key=lambda name: shares[name], default=None)
        told = "" if best is None else f"; {1 / shares[best]:.1g} of the information of {best}"
        yield f"{names}: not observed{told}"


def _eigen_rows(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvalues, and eigenvectors as rows."""
    values, vectors = torch.linalg.eigh(matrix)
    return values, vectors.T
