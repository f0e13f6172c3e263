"""Multi-start fits, and ambiguities among their results."""

import copy
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import torch
from torch import Tensor

from invertwin.channel import Sampling
from invertwin.checks import Point
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel
from invertwin.inversion.confidence.ambiguities import (
    REJECTION_ZSCORE,
    are_same_poses,
    candidate_rotations,
    describe_difference,
    difference_score,
)
from invertwin.inversion.fit import Callback
from invertwin.inversion.loss import Objective, resolve_loss
from invertwin.inversion.metrics import pose_error
from invertwin.inversion.observation import Observation, Unknowns
from invertwin.inversion.optimizer import Optimizer
from invertwin.inversion.reconstruction import Reconstruction, reconstruct
from invertwin.inversion.regularization import Regularizer
from invertwin.inversion.schedule import Schedule
from invertwin.limits import Count, Positive
from invertwin.runtime.memory import require_at_most
from invertwin.scene.scene import Object, Scene, displace
from invertwin.seeds import derive_seed

_MAX_POSES = 1e4
_FULL_FIT_COUNT = 4  # number of full fits from the best starts
_SCREENING_DIVISOR = 8  # samples of a fit over those of a screened start
_SAME_START_DISTANCE, _SAME_START_ANGLE = 0.1, 0.35  # m and rad: closer starts are fitted once


@dataclass(frozen=True)
class Search:
    """Result of a multi-start fit.

    Attributes:
        best: fit with the lowest loss.
        minima: all distinct results, the best first.
        scores: for every result the significance of its difference in loss from the best, assuming
            that it is true, in standard deviations over its realisations; None without
            realisations.
        ambiguities: a sentence for every result that the data do not reject.
        best_number: index of the best fit, as passed to ``callbacks``.
        objects: names of the objects with several starts.
    """

    best: Reconstruction
    minima: list[Reconstruction]
    scores: list[float | None]
    ambiguities: tuple[str, ...]
    best_number: int
    objects: tuple[str, ...]

    def to_metrics(self) -> dict[str, Any]:
        """Return the other results as numbers: pose difference, loss, score."""
        best = self.best.scene
        ends = [
            {
                "pose": describe_difference(best, end.scene, self.objects),
                "loss": end.loss,
                "score": score,
            }
            for end, score in zip(self.minima[1:], self.scores[1:], strict=True)
        ]
        return {"other_ends": ends, "ambiguities": list(self.ambiguities)}


def pose_grid(
    item: Object,
    low: Point,
    high: Point,
    step: Positive,
    turns: Count = 4,
    axis: Point = (0.0, 1.0, 0.0),
) -> Iterator[Object]:
    """Yield copies of an object on a grid over a box of poses.

    Args:
        item: object to copy.
        low: corner of the box of its centre [m]
        high: opposite corner [m]
        step: maximum spacing of positions [m]
        turns: number of rotations per position, evenly spaced over a full turn
        axis: axis of the rotations in world axes
    """
    if not all(a <= b for a, b in zip(low, high, strict=True)):
        raise InputError(
            f"expected a box with low <= high, got {list(low)} and {list(high)}; exchange them"
        )
    total = math.prod(1 + float(b - a) / step for a, b in zip(low, high, strict=True)) * turns
    require_at_most(
        total, _MAX_POSES, "poses", "give metres, a larger step, or fewer turns", "step"
    )
    axes = [
        torch.linspace(a, b, 1 + math.ceil((b - a) / step - 1e-9), dtype=torch.float64)
        for a, b in zip(low, high, strict=True)
    ]
    about = 2 * math.pi / turns * torch.tensor(axis, dtype=torch.float64)
    for place, turn in product(torch.cartesian_prod(*axes), range(turns)):
        yield displace(item, place - item.center.detach(), turn * about)


def search(
    scene: Scene,
    observations: Observation | Sequence[Observation],
    parameters: Unknowns,
    starts: Mapping[str, Sequence[Object]],
    *,
    loss: Callable[[Tensor, Tensor], Tensor] | None = None,
    optimizer: Optimizer | None = None,
    schedule: Schedule | Sequence[Schedule] | None = None,
    regularizers: Sequence[Regularizer] = (),
    callbacks: Callable[[int], Sequence[Callback]] = lambda _: (),
    seed: int = 0,
) -> Search:
    """Fit from many starts, and report the results that the data do not distinguish.

    All starts are screened at the initial, widest blur; the best four are fitted. Then the best
    result is rotated by ``candidate_rotations``, half turns first, and refitted. Distinct results
    are compared in pairs with realisations of the worse one: common speckle cancels in the
    difference of the losses.

    Args:
        scene: known scene. The other arguments are those of ``reconstruct``.
        observations: data with their forward models.
        parameters: unknowns of the scene; every fit takes a copy.
        starts: initial poses by object name, for example from ``sample_nearby_poses`` or
            ``pose_grid``.
        loss: (predicted, observed) → number.
        optimizer: kind of optimiser and rates.
        schedule: schedule of every fit.
        regularizers: functions Scene → number, added to the loss.
        callbacks: maps the index of a fit, from 0, to its callbacks.
        seed: seed of all random numbers.

    Raises:
        InputError: No starts; see ``reconstruct``.
    """
    names = list(starts)
    begun = [scene.replace(name, pose=o.transform) for name, all_ in starts.items() for o in all_]
    if not begun:
        raise InputError("expected at least one start, got none; give poses of an object")
    watched = [observations] if isinstance(observations, Observation) else list(observations)
    screened = sorted(begun, key=_make_screening_loss(watched, loss, seed))

    def fit(start: Scene, number: int) -> Reconstruction:
        return reconstruct(
            start,
            [replace(o, parameters=copy.deepcopy(o.parameters)) for o in watched],
            copy.deepcopy(parameters),
            loss=loss,
            optimizer=optimizer,
            schedule=schedule,
            regularizers=regularizers,
            callbacks=callbacks(number),
            seed=derive_seed(seed, number),
        )

    found = [
        fit(start, number) for number, start in enumerate(_select_distinct_starts(screened, names))
    ]
    best = min(found, key=_unblurred_loss)
    for start in _rotated_starts(best):
        found.append(fit(start, len(found)))
    ends: list[Reconstruction] = []
    for end in sorted(found, key=_unblurred_loss):
        if not any(are_same_poses(end.scene, other.scene, names) for other in ends):
            ends.append(end)
    scores = [
        None if k == 0 else difference_score(ends[0].result, end.result)
        for k, end in enumerate(ends)
    ]
    texts = tuple(
        f"{describe_difference(ends[0].scene, end.scene, names)} explains the data nearly as "
        f"well: z = {z:.1f}"
        for end, z in zip(ends, scores, strict=True)
        if z is not None and z < REJECTION_ZSCORE
    )
    return Search(ends[0], ends, scores, texts, found.index(ends[0]), tuple(names))


def _make_screening_loss(
    observations: Sequence[Observation], loss: Callable[[Tensor, Tensor], Tensor] | None, seed: int
) -> Callable[[Scene], float]:
    """Return the function that computes the loss of a scene at the widest blur."""
    objective = Objective(
        tuple(resolve_loss(o.model, o.loss or loss) for o in observations),
        tuple(o.weight for o in observations),
    )
    blurred = [o.model.blur_observed(o.observed_map(), o.sensor) for o in observations]
    models = [_reduce_samples(o.model) for o in observations]

    def score(scene: Scene) -> float:
        with torch.no_grad():
            drawn = zip(models, observations, strict=True)
            maps = [model.predict(scene, o.sensor, seed) for model, o in drawn]
            visible = all(bool(power.any()) for power in maps)
            pairs = list(zip(maps, blurred, strict=True))
            return float(objective(pairs)) if visible else math.inf

    return score


def _reduce_samples(model: ForwardModel) -> ForwardModel:
    """Return the model with the reduced samples of a blurred map."""
    sampling = getattr(model, "sampling", None)
    if not isinstance(sampling, Sampling):
        return model
    return model.with_sampling(
        samples=max(1, sampling.samples // _SCREENING_DIVISOR), boundary=False
    )


def _unblurred_loss(found: Reconstruction) -> float:
    return float(found.result.fit.objective(found.result.maps))


def _rotated_starts(found: Reconstruction) -> Iterator[Scene]:
    """Yield the twin with an object rotated by a near symmetry."""
    none = torch.zeros(3, dtype=torch.float64)
    for module in found.parameters:
        for turn in candidate_rotations(module, found.scene):
            moved = displace(found.scene[str(module.object)], none, turn)
            yield found.scene.replace(str(module.object), pose=moved.transform.detach())


def _select_distinct_starts(scenes: Sequence[Scene], names: Sequence[str]) -> list[Scene]:
    """Return the first scenes, without those near a better one."""
    kept: list[Scene] = []
    for scene in scenes:
        if len(kept) == _FULL_FIT_COUNT:
            break
        if not any(_are_near(scene, other, names) for other in kept):
            kept.append(scene)
    return kept


def _are_near(first: Scene, second: Scene, names: Sequence[str]) -> bool:
    """Return whether two starts are close enough to fit once."""
    offs = [pose_error(first[name], second[name]) for name in names]
    return all(
        o and o.distance < _SAME_START_DISTANCE and o.angle < _SAME_START_ANGLE for o in offs
    )
