"""Rivals of a twin: the same object turned so that it looks much the same."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor, nn

from invertwin.errors import InputError
from invertwin.inversion.confidence.realisations import End, zscore
from invertwin.inversion.fit import Fit
from invertwin.inversion.gauss_newton import GaussNewton
from invertwin.inversion.metrics import residual, surface_points
from invertwin.scene.mesh import Mesh
from invertwin.scene.parameters import Pose
from invertwin.scene.pose import quaternion_from_vector
from invertwin.scene.remeshing import closest_points
from invertwin.scene.scene import Object, Scene, displaced

REJECTED = 2.33  # standard deviations: one right rival in a hundred is rejected
SAME_PLACE, SAME_TURN = 0.03, 0.1  # m and rad: ends as near are one
_PARTS = (4, 3)  # of a whole turn: the first after which the object nearly keeps its shape
_NEARLY, _EQUAL = 0.07, 0.002  # of the diagonal: distance of surfaces much alike, of one surface
_CLEAR = 5.0  # standard deviations of a loss: so large a difference needs no looks
_POINTS = 1_000  # of each surface
_STEPS, _REACH, _BLUR = 6, 0.1, 0.4  # of a rival's fit: Gauss–Newton, its first share of widths


@dataclass(frozen=True, eq=False)
class Rival:
    """Another end that the data may or may not tell from that of a fit.

    Attributes:
        end: With the rival's own maps and looks.
        score: How unlikely the difference of both losses is, were the rival right, in standard
            deviations over looks at it; None where there are no looks.
        better: Whether its loss is the lower one.
        told: How it differs, in words.
    """

    end: End
    score: float | None
    better: bool
    told: str

    @property
    def rejected(self) -> bool:
        """Whether the data speak against the rival."""
        return not self.better and self.score is not None and self.score >= REJECTED


def rivals(end: End) -> Iterator[Rival]:
    """The twin with an object turned, fitted again, unless that leads back to the same place.

    Args:
        end: Of a fit.
    """
    twin = end.fit.twin()
    for number, module in enumerate(end.fit.unknowns):
        for turn in turns(module, twin):
            found = _refitted(end.fit, number, turn)
            if found is not None and not same(found.twin(), twin, [_name(module)]):
                other = End(found)
                better = found.objective(other.maps) < end.fit.objective(end.maps)
                told = way(twin, found.twin(), [_name(module)])
                yield Rival(other, score(end, other), bool(better), told)


def turns(module: nn.Module, twin: Scene) -> Iterator[Float64[Tensor, "3"]]:
    """Rotation vectors after which an object may look much the same, as far as it may turn.

    Half turns are always among them; quarters or thirds if the object nearly keeps its shape.
    What brings it back exactly is not.

    Args:
        module: What is fitted of the object.
        twin: The scene that it makes.
    """
    if not isinstance(module, Pose) or not module.rotation.requires_grad:
        return
    free = [c.name.split(".")[-1] for c in module.coordinates() if c.unit == "rad"]
    item = twin[module.object]
    world = torch.eye(3, dtype=torch.float64)
    own = item.transform.detach()[:3, :3].T if len(free) == 3 else world
    kept = [_placed(item)]

    def turned(vector: Tensor) -> Mesh:
        return _placed(displaced(item, torch.zeros(3, dtype=torch.float64), vector))

    for axis, name in zip(own, ("pitch", "yaw", "roll"), strict=True):
        if name not in free:
            continue
        near = (_apart(turned(2 * math.pi / n * axis), kept[0]) for n in _PARTS)
        parts = next((n for n, far in zip(_PARTS, near, strict=True) if far < _NEARLY), None)
        for share in (0.5, *((k / parts for k in range(1, parts)) if parts else ())):
            vector = 2 * math.pi * (share - (share > 0.5)) * axis
            found = turned(vector)
            if all(_apart(found, other) > _EQUAL for other in kept):
                kept.append(found)
                yield vector


def score(best: End, other: End) -> float | None:
    """How unlikely the difference of two losses is, were the other end right.

    Speckle that both losses share cancels in their difference.

    Args:
        best: The end with the lower loss.
        other: Another end of the same data.

    Returns:
        Standard deviations over looks at the twin of the other end, or a lower bound of them
        where they are many; None where there are no looks.
    """

    def difference(observed: Sequence[Tensor]) -> float:
        pairs = (
            [(a, b) for (a, _), b in zip(end.maps, observed, strict=True)] for end in (other, best)
        )
        first, second = (float(best.fit.objective(maps)) for maps in pairs)
        return first - second

    found = difference([b for _, b in best.maps])
    if best.draws is not None:
        # Of looks the difference is below zero, and it scatters less than a loss does.
        least = found / float(torch.tensor(best.draws.losses).std())
        if least > _CLEAR:
            return least
    drawn = [difference(look) for look in other.looks()]
    return zscore(found, drawn) if drawn else None


def same(first: Scene, second: Scene, names: Sequence[str]) -> bool:
    """Whether objects stand alike: in one pose, or in poses that look alike.

    Args:
        first, second: The scenes.
        names: Of the objects.
    """
    for name in names:
        a, b = first[name], second[name]
        off = residual(a, b)
        if off is None or off.distance >= SAME_PLACE:
            return False
        if off.angle >= SAME_TURN and not _equal_after(a, b):
            return False
    return True


def way(best: Scene, other: Scene, names: Sequence[str]) -> str:
    """How one end differs from another, in words.

    Args:
        best: The one.
        other: The other.
        names: Of the objects that may differ.
    """
    told = []
    for name in names:
        off = residual(other[name], best[name])
        if off is not None:
            axis = "xyz"[int(off.turn.abs().argmax())]
            turned = f"turned by {math.degrees(off.angle):.1f}° about {axis}, "
            far = f"{name} {turned if off.angle > SAME_TURN else ''}moved by {off.distance:.3f} m"
            told.append(far)
    return ", ".join(told) or "another shape"


def _equal_after(first: Object, second: Object) -> bool:
    """Whether two objects with nearly one centre have one surface."""
    a, b = _placed(first), _placed(second)
    a = Mesh(a.vertices - first.center.detach() + second.center.detach(), a.faces)
    # A turn that counts as none moves points so far.
    return _apart(a, b) < 0.13 * SAME_TURN


def _refitted(fit: Fit, number: int, turn: Tensor) -> Fit | None:
    """A fit that goes on from where an object is turned; None where Gauss–Newton cannot."""
    found = fit.copied()
    _turn(found.unknowns[number], turn)
    first, last = (1 - _BLUR) * fit.stage.widths_end, fit.stage.steps
    try:
        descent = GaussNewton(found.modules, found.objective, reach=_REACH)
        for step in torch.linspace(first, last, _STEPS).round().int().tolist():
            found.descended(descent, step)
    except InputError:  # many parameters, another loss, out of bounds
        return None
    return found


@torch.no_grad()
def _turn(module: nn.Module, turn: Tensor) -> None:
    """Turn what a pose has placed about its own centre."""
    assert isinstance(module, Pose)
    halves = module.rotation.new_tensor([1.0, 0.5, 0.5, 0.5])
    (w, *_), (a, *_) = (q := quaternion_from_vector(turn)), (p := module.rotation * halves)
    product = torch.cat(
        [(w * a - q[1:] @ p[1:])[None], w * p[1:] + a * q[1:] + q[1:].cross(p[1:], 0)]
    )
    module.rotation.copy_(product / halves)


def _placed(item: Object) -> Mesh:
    """The object's mesh in the world."""
    return Mesh(item.vertices.detach(), item.mesh.faces)


def _apart(first: Mesh, second: Mesh) -> float:
    """Root mean square distance of points of each surface from the other, over the diagonal."""
    squares = [
        np.square(points - closest_points(other, points)).sum(1).mean()
        for own, other in ((first, second), (second, first))
        for points in [surface_points(own, _POINTS, 0, 0)[0].numpy()]
    ]
    extent = first.vertices.amax(0) - first.vertices.amin(0)
    return math.sqrt(sum(squares) / 2) / float(extent.norm())


def _name(module: nn.Module) -> str:
    assert isinstance(module, Pose)
    return module.object
