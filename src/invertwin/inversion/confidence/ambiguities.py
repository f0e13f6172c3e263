"""Ambiguities of a fit: rotated poses of an object that fit the data nearly equally well."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor, nn

from invertwin.deprecation import rename_members
from invertwin.errors import InputError
from invertwin.inversion.confidence.realisations import FitResult, zscore
from invertwin.inversion.fit import Fit
from invertwin.inversion.gauss_newton import GaussNewton
from invertwin.inversion.metrics import pose_error, sample_surface
from invertwin.scene import Mesh, Pose
from invertwin.scene.remeshing import closest_points
from invertwin.scene.scene import Scene, displace

REJECTION_ZSCORE = 2.33  # standard deviations: one true ambiguity in a hundred is rejected
SAME_POSE_DISTANCE, SAME_POSE_ANGLE = 0.03, 0.1  # m and rad: closer results are one
_SYMMETRY_ORDERS = 4, 3  # rotational symmetries in the order of testing
_SIMILAR_DISTANCE, _EQUAL_DISTANCE = 0.07, 0.002  # surface distances relative to the diagonal
_CLEAR_ZSCORE = 5.0  # standard deviations of a loss: a larger difference needs no realisations
_SURFACE_POINT_COUNT = 1_000  # points on each surface
_REFIT_STEPS, _REFIT_TRUST_RADIUS = 6, 0.1  # Gauss–Newton from a rotated pose
_REFIT_BLUR = 0.4  # initial fraction of the blur


@dataclass(frozen=True, eq=False)
class Ambiguity:
    """Another result of a fit that the data may not distinguish from the first.

    Attributes:
        result: maps and realisations of the other result.
        score: significance of the difference of both losses under the hypothesis that the other
            result is true, in standard deviations over its realisations; None without realisations.
        has_lower_loss: whether its loss is the lower one.
        description: difference in words.
    """

    result: FitResult
    score: float | None
    has_lower_loss: bool
    description: str

    @property
    def is_rejected(self) -> bool:
        """True if the data reject the other result."""
        return not self.has_lower_loss and self.score is not None and self.score >= REJECTION_ZSCORE


def find_ambiguities(result: FitResult) -> Iterator[Ambiguity]:
    """Refit the twin from rotated poses of each object, and return the results at other poses.

    Args:
        result: result of the fit.
    """
    twin = result.fit.twin()
    for number, module in enumerate(result.fit.unknowns):
        for turn in candidate_rotations(module, twin):
            found, names = _refit(result.fit, number, turn), [str(module.object)]
            if found is not None and not are_same_poses(found.twin(), twin, names):
                other = FitResult(found)
                better = found.objective(other.maps) < result.fit.objective(result.maps)
                text = describe_difference(twin, found.twin(), names)
                yield Ambiguity(other, difference_score(result, other), bool(better), text)


def candidate_rotations(module: nn.Module, twin: Scene) -> Iterator[Float64[Tensor, "3"]]:
    """Return rotation vectors under which an object keeps a similar shape, within its free
    rotations.

    They always include half turns, and quarter or third turns if the object nearly keeps its shape.
    Exact symmetries are excluded.

    Args:
        module: pose that is fitted to the object.
        twin: scene with the fitted pose.
    """
    if not isinstance(module, Pose) or not module.rotation.requires_grad:
        return
    free = [c.name.split(".")[-1] for c in module.coordinates() if c.unit == "rad"]
    item = twin[module.object]
    world = torch.eye(3, dtype=torch.float64)
    own = item.transform.detach()[:3, :3].T if len(free) == 3 else world
    kept = [item.world_mesh]

    def rotate_object(vector: Tensor) -> Mesh:
        return displace(item, torch.zeros(3, dtype=torch.float64), vector).world_mesh

    for axis, name in zip(own[[1, 2, 0]], ("pitch", "yaw", "roll"), strict=True):
        if name not in free:
            continue
        meshes = ((order, rotate_object(2 * math.pi / order * axis)) for order in _SYMMETRY_ORDERS)
        alike = (k for k, mesh in meshes if _surface_distance(mesh, kept[0]) < _SIMILAR_DISTANCE)
        parts = next(alike, 1)
        for share in (0.5, *(k / parts for k in range(1, parts))):
            vector = 2 * math.pi * (share - (share > 0.5)) * axis
            found = rotate_object(vector)
            if all(_surface_distance(found, other) > _EQUAL_DISTANCE for other in kept):
                kept.append(found)
                yield vector


def difference_score(best: FitResult, other: FitResult) -> float | None:
    """Compute the significance of the difference of two losses, assuming that the other result is
    true.

    Common speckle cancels in the difference of the losses.

    Args:
        best: result with the lower loss.
        other: another result of the same data.

    Returns:
        Standard deviations over realisations of the other result, or a lower bound if it is large;
        None without realisations.
    """

    def difference(observed: Sequence[Tensor]) -> float:
        pairs = (
            [(a, b) for (a, _), b in zip(end.maps, observed, strict=True)] for end in (other, best)
        )
        first, second = (float(best.fit.objective(maps)) for maps in pairs)
        return first - second

    found = difference([b for _, b in best.maps])
    if best.realisation_statistics is not None:
        # The difference of realisations is negative, and scatters less than a loss.
        least = found / float(torch.tensor(best.realisation_statistics.losses).std())
        if least > _CLEAR_ZSCORE:
            return least
    drawn = [difference(sample) for sample in other.realisations()]
    return zscore(found, drawn) if drawn else None


def are_same_poses(first: Scene, second: Scene, names: Sequence[str]) -> bool:
    """Return whether objects have equal poses, or poses related by a symmetry.

    Args:
        first, second: the scenes.
        names: names of the objects.
    """
    for name in names:
        a, b = first[name], second[name]
        off = pose_error(a, b)
        if off is None or off.distance >= SAME_POSE_DISTANCE:
            return False
        if off.angle >= SAME_POSE_ANGLE:
            # Displacement of points by the largest rotation that counts as none.
            most, moved = 0.13 * SAME_POSE_ANGLE, b.center.detach() - a.center.detach()
            placed = Mesh(a.vertices.detach() + moved, a.mesh.faces)
            if not _surface_distance(placed, b.world_mesh) < most:
                return False
    return True


def describe_difference(best: Scene, other: Scene, names: Sequence[str]) -> str:
    """Describe the pose difference of two results in words.

    Args:
        best: scene of the first result.
        other: scene of the other result.
        names: names of the objects that may differ.
    """
    texts = []
    for name in names:
        off = pose_error(other[name], best[name])
        if off is not None:
            axis = "xyz"[int(off.rotation.abs().argmax())]
            turned = f"turned by {math.degrees(off.angle):.1f}° about {axis}, "
            turned = turned if off.angle > SAME_POSE_ANGLE else ""
            texts.append(f"{name} {turned}moved by {off.distance:.3f} m")
    return ", ".join(texts) or "another shape"


def _refit(fit: Fit, number: int, rotation: Tensor) -> Fit | None:
    """Refit from a rotated pose of an object; None if Gauss–Newton does not apply."""
    found = fit.copy()
    module = found.unknowns[number]
    assert isinstance(module, Pose)
    # About the object's own centre, before the fitted rotation.
    turn = module.rotation_matrix.detach().T @ rotation
    moved = displace(fit.scene[module.object], torch.zeros_like(turn), turn)
    found.scene = fit.scene.replace(module.object, pose=moved.transform)
    first, last = (1 - _REFIT_BLUR) * fit.stage.blur_end, fit.stage.steps
    try:
        descent = GaussNewton(found.modules, found.objective, trust_radius=_REFIT_TRUST_RADIUS)
        for step in torch.linspace(first, last, _REFIT_STEPS).round().int().tolist():
            found.gauss_newton_step(descent, step)
    except InputError:  # many parameters, another loss, out of bounds
        return None
    return found


def _surface_distance(first: Mesh, second: Mesh) -> float:
    """Compute the root mean square distance of two surfaces relative to the diagonal."""
    squares = [
        np.square(points - closest_points(other, points)).sum(1).mean()
        for own, other in ((first, second), (second, first))
        for points in [sample_surface(own, _SURFACE_POINT_COUNT, 0, 0)[0].numpy()]
    ]
    extent = first.vertices.amax(0) - first.vertices.amin(0)
    return math.sqrt(sum(squares) / 2) / float(extent.norm())


rename_members(Ambiguity, better="has_lower_loss", end="result", told="description")
