"""Error bars of a fit from the statistics of its data, and unobserved parameters."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch
from jaxtyping import Float64
from scipy import stats
from torch import Tensor, nn

from invertwin.errors import InputError
from invertwin.inversion.confidence.realisations import FitResult
from invertwin.inversion.fit import Fit
from invertwin.inversion.forward_mode import map_tangents
from invertwin.inversion.gauss_newton import penalty_curvature
from invertwin.inversion.loss import CURVED
from invertwin.runtime.progress import track
from invertwin.scene import Object
from invertwin.scene.parameters import Coordinate, Entries, MaterialValues, Scale

_MAX_COORDINATES = 64  # each coordinate costs derivatives of the map
# Relative to the apparent information due to noise of the derivatives.
_MIN_INFORMATION_FRACTION = 0.5
_UNOBSERVED_VARIANCE_RATIO = 20.0  # times the smallest variance in spans: not observed
_UNOBSERVED_VARIANCE = 25.0  # spans squared: not observed in any case
_MIN_NAMED_COMPONENT = 0.3  # smaller components of a direction are not named
_WEAK_VARIANCE = 1 / 16  # spans squared: directions with more variance are profiled
_PROFILE_DISTANCE = 2.0  # spans: displacement of a profiled direction
_PROFILE_REFITS = 3  # Gauss–Newton steps of the other coordinates
_MIN_LOSS_RISE = 1e-3  # lower limit of the rise of the loss, relative to the quadratic model
_SIZE_DEVIATION = 0.1  # of the sizes of objects whose pose alone is fitted, before the data
_BRIGHTNESS_DEVIATION = 0.7  # of ln(permittivity - 1), before the data: about 3 dB
_CONTRADICTED = 2.0  # standard deviations of a held value from the one that the data determine


@dataclass(frozen=True)
class Uncertainty:
    """Error bars of a fit.

    They state the effect of speckle and noise on the estimate near its minimum, and of errors of
    sizes and permittivities that the fit holds. The verdict assesses wrong minima, models and
    starts. A direction that is known to a quarter of its span at best has the error bar of the loss
    profile two spans away, if the profile rises less than the curvature at the minimum predicts.

    Attributes:
        names: names of the coordinates, such as "letter.x".
        units: units of the coordinates: "m", "rad", or empty.
        covariance: covariance of the estimates. An unobserved direction has a large, finite
            variance: a lower bound.
        unobserved: a sentence for every unobserved direction. It begins with the names of its
            coordinates.
        count: number of realisations, or of frames, from whose scatter the covariance is estimated.
        source: ``looks`` (realisations of the twin) or ``frames`` of the data.
        size_errors: root mean square error of the size of every object whose pose alone is fitted,
            relative, given the data and a deviation of a tenth before them.
        contradicted: held sizes and permittivities, such as "letter.permittivity", that the data
            contradict by more than two standard deviations.
        newton_step: distance of every coordinate from the minimum of the loss, in its unit; empty
            if unknown. It is part of the covariance.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    covariance: Float64[Tensor, "p p"]
    unobserved: tuple[str, ...]
    count: int
    source: Literal["looks", "frames"]
    size_errors: Mapping[str, float] = field(default_factory=dict)
    contradicted: tuple[str, ...] = ()
    newton_step: tuple[float, ...] = ()

    @property
    def deviations(self) -> dict[str, float]:
        """Standard deviation of every coordinate, in its unit."""
        return dict(zip(self.names, self.covariance.diagonal().sqrt().tolist(), strict=True))

    @property
    def early_stops(self) -> tuple[str, ...]:
        """A sentence for every coordinate that is farther from the minimum than its uncertainty."""
        rows = zip(self.names, self.units, self.newton_step, self.deviations.values(), strict=False)
        return tuple(
            f"{name}: the fit stopped {step:.2g} {unit} before its minimum; give it more steps"
            for name, unit, step, deviation in rows
            if step > 0.7 * deviation  # half of the variance
        )

    @property
    def correlations(self) -> Float64[Tensor, "p p"]:
        """Correlations of the errors."""
        scale = self.covariance.diagonal().rsqrt()
        return self.covariance * scale * scale[:, None]

    def interval(self, level: float = 0.95) -> dict[str, float]:
        """Return the half width of the confidence interval of every coordinate, in its unit.

        Args:
            level: confidence level.
        """
        # Student's t distribution, since the variance is an estimate.
        factor = float(stats.t.ppf(0.5 + 0.5 * level, self.count - 1))
        return {name: factor * value for name, value in self.deviations.items()}


class CovarianceEstimator:
    """Covariance of the fitted parameters from the final maps and simulated realisations.

    ``Cov θ = H⁻¹ Cov(g) H⁻¹``: H the Gauss–Newton matrix of the loss, g its gradient on
    realisations of the twin with independent speckle and noise, both with a refitted gain.
    Derivatives of the map are taken in forward mode at the end of the fit, twice with independent
    samples, to remove the apparent information of their noise. For models without realisations,
    Cov(g) is the scatter over frames of the data, assuming independent speckle in each frame.

    An object whose pose alone is fitted has a size n of deviation σ = 0.1, and a permittivity n,
    which determines its brightness, of deviation 0.7 (ε − 1). The gradient of the loss with respect
    to n, at coordinates that follow, is a linear measurement of it. By the mean square of n given
    this measurement the coordinates are displaced, ``H_θθ⁻¹ H_θn n`` (consider parameters). So they
    are by the Newton step, ``−H⁻¹ g``, from the estimate to the minimum.

    Source: the sandwich covariance of estimators, derivations §16; Schmidt, "Application of
    state-space methods to navigation problems", Advances in Control Systems 3, 1966.
    Differs from the source: Cov(g) from realisations, which accounts for correlated bins and
    frames. The mean square of a considered value is that given the data.

    Args:
        result: result of the fit.
        is_fitted: whether the estimate comes from a fit: sizes and permittivities that it holds are
            uncertain, and it may have stopped before the minimum (without regularisers only).

    Raises:
        InputError: More than 64 coordinates, or a loss without a curvature.
    """

    def __init__(self, result: FitResult, *, is_fitted: bool = False) -> None:
        with torch.enable_grad():
            self._may_move = is_fitted and not result.fit.penalty().requires_grad
        held = list(_find_held_values(result.fit)) if is_fitted else []
        fit = result.fit.copy(*(module for module, _ in held))
        found = list(iterate_coordinates(fit.modules))
        others = [x for x in fit.objective.losses if not isinstance(x, CURVED)]
        if len(found) > _MAX_COORDINATES or others:
            raise InputError(
                f"expected a SpectrumLoss and at most {_MAX_COORDINATES} parameters for error "
                f"bars, got {type(others[0]).__name__ if others else len(found)}; error bars are "
                "not available"
            )
        self._end = result
        rows = _mean_derivatives(fit, found)
        # Coordinates without effect are dropped, unless they have a span.
        moves = [any(bool(part[k].any()) for part in rows[0]) for k in range(len(found))]
        kept = [k for k, c in enumerate(found) if moves[k] or math.isfinite(c.span)]
        own = len(found) - len(held)
        self._kept = [k for k in kept if k < own]
        self._found = [found[k] for k in self._kept]
        self._held = [found[k] for k in kept if k >= own]
        scale = torch.ones(len(found)).double()
        scale[own:] = torch.tensor([deviation for _, deviation in held])
        self._rows = [[_scale_rows(part, scale)[kept] for part in side] for side in rows]

    def error_bars(
        self, frames: Sequence[int] | None = None, realisations: Sequence[Any] = ()
    ) -> Uncertainty:
        """Compute the error bars.

        Args:
            frames: indices of the frames to use; None = all.
            realisations: realisations of all frames, if ``frames`` selects some.

        Raises:
            InputError: A single frame of a model without realisations.
        """
        end, found, rows, held = self._end, self._found, self._rows, self._held
        if frames is not None:
            end = end.select_frames(frames, realisations)
            rows = [[part[:, frames] for part in side] for side in rows]
        objective = end.fit.objective
        curvature, feigned = (objective.curvature(end.maps, some) for some in rows)
        slopes = end.loss_gradients(end.maps)[1]
        if end.realisation_statistics is not None:
            count, by = len(end.realisation_statistics.losses), "looks"
            looks = end.realisation_statistics.gradients
            scatter, chance = (torch.cov(_project(looks, r).T).reshape_as(curvature) for r in rows)
        else:
            count, by = min(len(b) for _, b in end.maps), "frames"
            if count < 2:
                raise InputError(
                    "expected a model with realisations or several frames for error bars, got one "
                    "frame of a model without realisations; error bars are not available"
                )
            scatter, chance = (_frame_covariance(slopes, some) for some in rows)
        curvature, own = curvature - feigned, slice(len(found))
        curvature[own, own] += _penalty_curvature(end.fit, found)
        spans = torch.tensor([c.span for c in found], dtype=torch.float64)
        spans = spans.where(spans.isfinite(), curvature.diagonal()[own].clamp_min(1e-30).rsqrt())
        square = spans * spans[:, None]
        parts = (curvature, feigned, scatter, chance)
        covariance, inverse = _sandwich_covariance(*(m[own, own] * square for m in parts))
        if frames is None:
            covariance = self._widen_covariance(covariance, spans)
        blind = tuple(_describe_unobserved(found, covariance))
        names, units = tuple(c.name for c in found), tuple(c.unit for c in found)
        bars = Uncertainty(names, units, covariance * square, blind, count, by)
        if self._may_move:
            step = -(inverse * square) @ _project([slopes], rows[0])[0, own]
            moved = bars.covariance + torch.outer(step, step)
            bars = replace(bars, covariance=moved, newton_step=tuple(step.abs().tolist()))
        if not held:
            return bars
        shift = (inverse * square) @ curvature[own, len(found) :]
        follow = torch.cat([-shift, torch.eye(len(held))]).T.double()
        slope, noise = (follow @ part @ follow.T for part in (curvature, scatter))
        mean, variance = _held_posterior(slope, noise, -follow @ _project([slopes], rows[0])[0])
        square = variance + torch.outer(mean, mean)
        names = [coordinate.name for coordinate in held]
        errors = zip(names, (_SIZE_DEVIATION * square.diagonal().sqrt()).tolist(), strict=True)
        far = (mean.abs() > _CONTRADICTED * variance.diagonal().sqrt()).tolist()
        return replace(
            bars,
            covariance=bars.covariance + shift @ square @ shift.T,
            size_errors={n.removesuffix(".scale"): e for n, e in errors if n.endswith(".scale")},
            contradicted=tuple(name for name, is_far in zip(names, far, strict=True) if is_far),
        )

    def _widen_covariance(self, covariance: Tensor, spans: Tensor) -> Tensor:
        """Widen weak directions of the covariance (in spans) by profiles of the loss."""
        fit, known = self._end.fit, torch.tensor([math.isfinite(c.span) for c in self._found])
        errors, axes = torch.linalg.eigh(covariance[known][:, known])
        pairs = zip(errors.tolist(), axes.T, strict=True)
        weak = [(error, axis) for error, axis in pairs if _WEAK_VARIANCE < error < 1]
        if not weak or bool(_penalty_curvature(fit, self._found).any()):
            return covariance
        with torch.no_grad():
            target = [predicted for predicted, _ in fit.unblurred_maps(0)]
        rows = [part[: len(spans)] for part in self._rows[0]]
        own = fit.objective.curvature([(a, a) for a in target], rows)
        inverse = torch.linalg.pinv(own * spans * spans[:, None], hermitian=True)
        for error, axis in weak:
            vector = torch.zeros(len(spans), dtype=torch.float64)
            vector[known] = axis
            predicted = 0.5 * _PROFILE_DISTANCE**2 / float(vector @ inverse @ vector)
            ends = (_PROFILE_DISTANCE, -_PROFILE_DISTANCE)
            rise = min(self._profile_loss(far * vector, spans, target) for far in ends)
            more = error * (predicted / max(rise, _MIN_LOSS_RISE * predicted) - 1)
            covariance = covariance + max(more, 0.0) * vector * vector[:, None]
        return covariance

    def _profile_loss(self, displacement: Tensor, spans: Tensor, target: list[Tensor]) -> float:
        """Minimise the loss over all other coordinates at a displacement of the twin.

        It is infinite for displacements out of bounds.

        Args:
            displacement: displacement in units of the spans [p].
            spans: spans of the coordinates [p].
            target: maps that stand for the data: those of the twin itself.
        """
        fit, least = self._end.fit.copy(), math.inf

        def here() -> list[Coordinate]:
            every = list(iterate_coordinates(fit.modules))
            return [every[k] for k in self._kept]

        across = torch.linalg.svd(displacement[None])[2][1:]  # perpendicular to the displacement
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
    """Yield the coordinates of a module and its children, with qualified parameter names.

    Args:
        module: module to fit.
        path: qualified name of the module, with a trailing dot.
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
            unit = torch.zeros_like(part)
            unit.view(-1)[number] = 1.0
            tangent = torch.zeros_like(parameter.detach())
            tangent[entry.index] = unit / entry.slope
            label = prefix + name + (f"[{number}]" if part.numel() > 1 else "")
            yield Coordinate(label, "", {path + entry.parameter: tangent})
    for name, child in module.named_children():
        if not any(whole.startswith(f"{name}.") for whole in held):
            yield from iterate_coordinates(child, f"{path}{name}.")


def map_derivatives(fit: Fit, coordinates: Sequence[Coordinate], seed_number: int) -> list[Tensor]:
    """Compute derivatives of each predicted map with respect to coordinates [coordinate, …].

    Args:
        fit: fit at its end.
        coordinates: coordinates to differentiate with respect to.
        seed_number: index of the random numbers.
    """

    def predict() -> list[Tensor]:
        return [predicted for predicted, _ in fit.unblurred_maps(seed_number)]

    rows = [
        map_tangents(fit.modules, predict, coordinate.tangents)
        for coordinate in track(coordinates, "derivatives")
    ]
    return [torch.stack(column) for column in zip(*rows, strict=True)]


def _mean_derivatives(fit: Fit, coordinates: Sequence[Coordinate]) -> list[list[Tensor]]:
    """Return the means and the half differences of independent derivatives of each map.

    J₁J₂ᵀ + J₂J₁ᵀ = 2 (mean mean − half half) is free of the noise of both.
    """
    first, second = (map_derivatives(fit, coordinates, number) for number in (0, 1))
    pairs = list(zip(first, second, strict=True))
    return [[(a + b) / 2 for a, b in pairs], [(a - b) / 2 for a, b in pairs]]


def find_known_permittivities(objects: Mapping[str, Object]) -> dict[str, float]:
    """Return the permittivities of the objects that move, as far as they are known.

    There is none if all objects move: only others determine the gain of the data, and with it how
    bright an object is.

    Args:
        objects: objects of a scene to which the parameters of a fit are applied.
    """
    moved = {name: item for name, item in objects.items() if item.vertices.requires_grad}
    found = {name: vars(item.material).get("permittivity") for name, item in moved.items()}
    known = {n: value for n, value in found.items() if isinstance(value, float) and value > 1}
    return known if len(moved) < len(objects) else {}


def _find_held_values(fit: Fit) -> Iterator[tuple[nn.Module, float]]:
    """Yield sizes and permittivities that a fit of a pose holds, with their deviations."""
    with torch.enable_grad():
        objects = fit.apply_modules()[0].objects
    meshes = {name: item for name, item in objects.items() if item.cloud is None}
    moved = {name: item.mesh for name, item in meshes.items() if item.transform.requires_grad}
    held = [name for name, mesh in moved.items() if not mesh.vertices.requires_grad]
    for name in held:
        yield Scale(name), _SIZE_DEVIATION
    for name, value in find_known_permittivities(objects).items():
        if name in held:
            deviation = _BRIGHTNESS_DEVIATION * (value - 1)
            yield MaterialValues(name, permittivity=value), deviation


def _held_posterior(slope: Tensor, noise: Tensor, score: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and covariance of held values, of unit deviation before the data, given minus a
    gradient: slope · values, and noise.
    """
    gain = slope.T @ torch.linalg.pinv(slope @ slope.T + noise, hermitian=True)
    return gain @ score, torch.eye(len(slope), dtype=torch.float64) - gain @ slope


def _scale_rows(rows: Tensor, factors: Tensor) -> Tensor:
    """Multiply each derivative of a map by a factor of its coordinate."""
    return rows * factors.to(rows).reshape(-1, *[1] * (rows.dim() - 1))


def _project(loss_gradients: Sequence[Sequence[Tensor]], rows: Sequence[Tensor]) -> Tensor:
    """Return gradients by coordinates, on the CPU, from gradients by maps: a row for each."""
    flat = [part.flatten(1) for part in rows]
    terms = ([f @ s.flatten() for f, s in zip(flat, own, strict=True)] for own in loss_gradients)
    return torch.stack([torch.stack(own).sum(0) for own in terms]).double().cpu()


def _frame_covariance(
    loss_gradients: Sequence[Tensor], map_derivatives: Sequence[Tensor]
) -> Tensor:
    """Estimate the covariance of the gradient from the scatter of the terms of single frames."""
    total = torch.zeros((), dtype=torch.float64)
    for slope, own in zip(loss_gradients, map_derivatives, strict=True):
        scores = torch.einsum("pfn,fn->pf", own.flatten(2), slope.flatten(1)).double().cpu()
        total = total + len(slope) * torch.cov(scores).reshape(len(own), -1)
    return total


def _penalty_curvature(fit: Fit, coordinates: Sequence[Coordinate]) -> Tensor:
    """Compute second derivatives of the regularisers along the coordinates."""
    free = {n: p for n, p in fit.modules.named_parameters() if p.requires_grad}
    rows = [
        torch.cat([c.tangents.get(n, torch.zeros_like(p)).flatten() for n, p in free.items()])
        for c in coordinates
    ]
    tangents = torch.stack(rows).detach().double()
    every = torch.ones(tangents.shape[1], dtype=torch.bool)
    with torch.enable_grad():
        own = penalty_curvature(fit.penalty, list(free.values()), every)
    return tangents @ own @ tangents.T


def _sandwich_covariance(
    curvature: Tensor, curvature_bias: Tensor, scatter: Tensor, scatter_bias: Tensor
) -> tuple[Tensor, Tensor]:
    """Compute the sandwich covariance in units of the spans; uninformed directions get large
    errors. Return it, and the inverse curvature without these directions.
    """
    values, axes = torch.linalg.eigh(curvature)
    least = _MIN_INFORMATION_FRACTION * (axes.T @ curvature_bias @ axes).diagonal().clamp_min(1e-30)
    seen, values = values > least, values.clamp_min(least)
    inverse = (axes * (seen / values)) @ axes.T
    inner = axes.T @ (scatter - scatter_bias) @ axes * (seen * seen[:, None])
    noise = (axes.T @ scatter_bias @ axes).diagonal()
    blind = torch.maximum(noise, 2 * _UNOBSERVED_VARIANCE * values.square())
    inner += torch.diag(torch.where(seen, 0.0, blind))
    powers, turned = torch.linalg.eigh(inner / (values * values[:, None]))
    axes = axes @ turned
    return axes @ torch.diag(powers.clamp_min(1e-30)) @ axes.T, inverse


def _describe_unobserved(coordinates: Sequence[Coordinate], covariance: Tensor) -> Iterator[str]:
    """Yield sentences about directions that are more uncertain than their spans and the best
    direction.
    """
    known = [k for k, c in enumerate(coordinates) if math.isfinite(c.span)]
    own = covariance[known][:, known]
    most = _UNOBSERVED_VARIANCE_RATIO * float(own.diagonal().min()) if known else math.inf
    errors, axes = torch.linalg.eigh(own)
    for error, axis in zip(errors, axes.T, strict=True):
        if not error > max(1.0, min(most, _UNOBSERVED_VARIANCE)):
            continue
        order = axis.abs().argsort(descending=True).tolist()
        parts = [k for k in order if abs(axis[k]) > _MIN_NAMED_COMPONENT]
        names = " and ".join(coordinates[known[k]].name for k in parts)
        if len(parts) > 1:
            mixed = " ".join(f"{float(axis[k]):+.2f} {coordinates[known[k]].name}" for k in parts)
            yield f"{names}: not observed along {mixed}, in units of their spans"
            continue
        single = coordinates[known[parts[0]]]
        shares = {
            coordinates[k].name: float(
                error * single.span**2 / (covariance[k, k] * coordinates[k].span ** 2)
            )
            for k in known
            if coordinates[k].unit == single.unit and coordinates[k].name != single.name
        }
        best = max(shares, key=lambda name: shares[name], default=None)
        ending = "" if best is None else f"; {1 / shares[best]:.1g} of the information of {best}"
        yield f"{names}: not observed{ending}"
