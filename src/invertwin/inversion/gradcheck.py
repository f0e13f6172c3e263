"""Is the gradient right? Automatic derivatives of a whole map against central differences."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
import torch.autograd.forward_ad as forward_ad
from jaxtyping import Float64
from torch import Tensor

from invertwin.channel import Grid, Link, Sampling, deposit_power
from invertwin.errors import InputError
from invertwin.radar.radar import Radar
from invertwin.radar.surrogate import Surrogate
from invertwin.scene.mesh import Mesh
from invertwin.scene.pose import rigid, rotation_from_vector
from invertwin.scene.scene import Scene

KINDS = ("translation", "rotation", "scale", "material", "radar_translation", "radar_rotation")
_LEAST_PAIRS = 4


@dataclass(frozen=True)
class Direction:
    """One scalar θ that moves a scene or a radar away from θ = 0.

    Attributes:
        kind: ``translation`` [m], ``rotation`` [rad, about the object's centre], ``scale``
            [relative], ``material`` [unit of the value], ``radar_translation`` [m] or
            ``radar_rotation`` [rad].
        object: The object it moves (none for the radar's).
        axis: Unit direction of a translation, or axis of a rotation.
        value: Name of the material value.
    """

    kind: str
    object: str = ""
    axis: tuple[float, float, float] = (1.0, 0.0, 0.0)
    value: str = ""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(
                f"expected a parameter kind among {', '.join(KINDS)}, got {self.kind!r}; "
                "gradcheck differentiates with respect to one of these"
            )

    def __call__(self, scene: Scene, radar: Radar, theta: Tensor) -> tuple[Scene, Radar]:
        """The scene and the radar at θ."""
        axis = torch.tensor(self.axis, dtype=torch.float64)
        axis = axis / axis.norm()
        if self.kind == "radar_translation":
            return scene, radar.moved(torch.eye(3, dtype=torch.float64), axis * theta)
        if self.kind == "radar_rotation":
            return scene, radar.moved(rotation_from_vector(axis * theta), axis * 0)
        item = scene[self.object]
        if self.kind == "material":
            material: Any = item.material
            if self.value not in vars(material):
                raise InputError(
                    f"expected a value of {self.object}'s material ({', '.join(vars(material))}), "
                    f"got {self.value!r}; choose one"
                )
            moved = replace(material, **{self.value: getattr(material, self.value) + theta})
            return scene.replace(self.object, material=moved), radar
        if self.kind == "scale":
            # About the centre of the bounding box, in the object's own frame.
            vertices = item.mesh.vertices
            centre = item.mesh.center.detach()
            mesh = Mesh(centre + (vertices - centre) * (1 + theta), item.mesh.faces)
            return scene.replace(self.object, mesh=mesh), radar
        pose = item.transform
        if self.kind == "translation":
            shift = rigid(translation=axis * theta)
        else:
            turn, centre = rotation_from_vector(axis * theta), item.center.detach()
            shift = rigid(turn, centre - turn @ centre)
        return scene.replace(self.object, pose=shift @ pose), radar


@dataclass(frozen=True)
class Agreement:
    """How close a gradient map is to the differences.

    Attributes:
        relative_l1: ‖g − g_FD‖₁ / ‖g_FD‖₁.
        relative_l2: ‖g − g_FD‖₂ / ‖g_FD‖₂.
        correlation: Pearson, over bins.
        order: Observed order of ‖FD(ε) − g‖ in ε, from the two large steps: 2 for a right
            gradient, 0 for a wrong one.
    """

    relative_l1: float
    relative_l2: float
    correlation: float
    order: float


@dataclass(frozen=True)
class GradientReport:
    """The outcome of :func:`gradcheck`.

    Attributes:
        full, interior: Agreement with and without boundary paths.
        no_interior_edges: With boundary paths, but without those of the shadows that surfaces
            cast on each other; None for paths of one bounce, which have none.
        difference_noise: ‖standard error‖₁ / ‖g_FD‖₁.
        step_agreement: ‖FD(ε) − FD(ε/2)‖₁ / ‖FD(ε)‖₁ (holds the noise of both).
        pairs: Number of independent difference pairs.
        value, gradient, interior_gradient, difference: The map and its derivatives.
    """

    full: Agreement
    interior: Agreement
    no_interior_edges: Agreement | None
    difference_noise: float
    step_agreement: float
    pairs: int
    value: Float64[Tensor, "frame range u v"]
    gradient: Float64[Tensor, "frame range u v"]
    interior_gradient: Float64[Tensor, "frame range u v"]
    difference: Float64[Tensor, "frame range u v"]


def gradcheck(
    scene: Scene,
    radar: Radar,
    grid: Grid,
    direction: Callable[[Scene, Radar, Tensor], tuple[Scene, Radar]],
    *,
    surrogate: Surrogate,
    depth: int = 3,
    samples: int = 4_000_000,
    boundary_samples: int = 1_000_000,
    repeats: int = 4,
    step: float = 4e-3,
    difference_samples: int = 8_000_000,
    noise: float = 0.007,
    max_pairs: int = 64,
    sampling: Literal["rays", "area"] = "rays",
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> GradientReport:
    """Compare the derivative of a power map with central differences that have converged.

    The differences use common random numbers: both ends of a pair draw the same numbers from a
    density fixed at θ = 0, and every pair is scrambled anew. Pairs are added until the standard
    error of their mean is below ``noise``.

    Args:
        scene: The scene at θ = 0.
        radar: Its radar.
        grid: Bins of the map.
        direction: θ → scene and radar, e.g. :class:`Direction`.
        surrogate: Point spread of the map.
        depth: Most bounces of a path.
        samples: Interior samples of one derivative.
        boundary_samples: Silhouette samples of one derivative.
        repeats: Derivatives averaged, with different seeds.
        step: ε of the differences; ε/2 is evaluated too, 4ε and 8ε for the order.
        difference_samples: Samples of one end of a pair.
        noise: Stop when the relative standard error (L1) is below.
        max_pairs: Stop here in any case; the report says what was reached.
        sampling: Sampler of the differences.
        seed: Of everything.
        progress: Called with one line now and then.

    Raises:
        InputError: The map does not depend on θ (all differences are zero).
    """

    def map_at(
        theta: Tensor,
        drawn: Sampling,
        key: int,
        reference: tuple[Scene, Link] | None = None,
    ) -> Tensor:
        moved, seen = direction(scene, radar, theta)
        deposit = deposit_power(
            moved,
            seen.link(),
            grid,
            sampling=drawn,
            seed=key,
            scheme="rays" if reference is None else sampling,
            reference=reference,
        )
        return surrogate.shape(deposit.double(), seen, grid)

    def derivative(boundary: bool, interior_edges: bool = True) -> tuple[Tensor, Tensor]:
        primals, tangents = [], []
        for k in range(repeats):
            with forward_ad.dual_level():
                theta = forward_ad.make_dual(
                    torch.zeros((), dtype=torch.float64), torch.ones((), dtype=torch.float64)
                )
                drawn = Sampling(
                    depth=depth,
                    samples=samples,
                    boundary_samples=boundary_samples if boundary else 0,
                    boundary=boundary,
                    interior_edges=interior_edges,
                )
                out = map_at(theta, drawn, seed + k)
                primal, tangent = forward_ad.unpack_dual(out)
                primals.append(primal)
                tangents.append(torch.zeros_like(primal) if tangent is None else tangent)
        return torch.stack(primals).mean(0), torch.stack(tangents).mean(0)

    def difference(epsilon: float, key: int) -> Tensor:
        ends = [
            map_at(
                torch.tensor(sign * epsilon, dtype=torch.float64),
                Sampling(depth=depth, samples=difference_samples, boundary_samples=0),
                key,
                reference=(scene, radar.link()),
            )
            for sign in (1.0, -1.0)
        ]
        return (ends[0] - ends[1]) / (2 * epsilon)

    with torch.no_grad():
        value, gradient = derivative(boundary=True)
        _, interior_gradient = derivative(boundary=False)
        outer_gradient = derivative(True, interior_edges=False)[1] if depth > 1 else None
        pairs: list[Tensor] = []
        reached = math.inf
        while len(pairs) < max_pairs and (len(pairs) < _LEAST_PAIRS or reached > noise):
            pairs.append(difference(step, seed + 1_000_003 * (len(pairs) + 1)))
            if len(pairs) >= 2:
                reached = _noise(torch.stack(pairs))
                if progress:
                    progress(f"{len(pairs)} pairs, difference noise {reached:.4f}")
        stacked = torch.stack(pairs)
        truth = stacked.mean(0)
        size = truth.abs().sum()
        if not size > 0:
            raise InputError(
                "expected a map that depends on θ, got differences that are all zero; "
                "check the grid and what the parameter moves"
            )
        keys = [seed + 1_000_003 * (k + 1) for k in range(_LEAST_PAIRS)]
        half, far, farther = (
            torch.stack([difference(factor * step, key) for key in keys]).mean(0)
            for factor in (0.5, 4.0, 8.0)
        )
        same = stacked[:_LEAST_PAIRS].mean(0)
    return GradientReport(
        full=_agreement(gradient, truth, far, farther),
        interior=_agreement(interior_gradient, truth, far, farther),
        no_interior_edges=(
            None if outer_gradient is None else _agreement(outer_gradient, truth, far, farther)
        ),
        difference_noise=reached,
        step_agreement=float((same - half).abs().sum() / same.abs().sum()),
        pairs=len(pairs),
        value=value,
        gradient=gradient,
        interior_gradient=interior_gradient,
        difference=truth,
    )


def _noise(pairs: Tensor) -> float:
    """‖standard error of the mean‖₁ / ‖mean‖₁."""
    mean = pairs.mean(0)
    error = pairs.std(0) / math.sqrt(len(pairs))
    return float(error.abs().sum() / mean.abs().sum().clamp_min(1e-300))


def _agreement(gradient: Tensor, truth: Tensor, far: Tensor, farther: Tensor) -> Agreement:
    miss = gradient - truth
    both = torch.stack([gradient.flatten(), truth.flatten()])
    errors = [float((d - gradient).norm()) for d in (far, farther)]
    return Agreement(
        relative_l1=float(miss.abs().sum() / truth.abs().sum()),
        relative_l2=float(miss.norm() / truth.norm()),
        correlation=float(torch.corrcoef(both)[0, 1]),
        order=math.log2(errors[1] / errors[0]) if min(errors) > 0 else math.nan,
    )
