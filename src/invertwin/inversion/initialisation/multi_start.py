"""Multi-start fits, and ambiguities among their results."""

import copy
import math
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice, product
from typing import Any, TypeVar

import torch
from torch import Tensor

from invertwin.channel import Sampling
from invertwin.checks import Point
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel
from invertwin.inversion.confidence import ambiguities as equivalents
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
from invertwin.runtime.progress import track
from invertwin.scene.scene import Object, Scene, displace
from invertwin.seeds import derive_seed

_MAX_POSES = 1e4
_SCREENING_DIVISOR = 8  # samples of a fit over those of a screened start
_SAME_START_DISTANCE, _SAME_START_ANGLE = 0.1, 0.35  # m and rad: closer starts are fitted once

_Item = TypeVar("_Item")


@dataclass(frozen=True)
class Candidate:
    """A start among those that a search compares.

    Attributes:
        scene: initial scene.
        observations: observations with sensors and unknowns that begin there.
        group: only the best candidate of a group is fitted; None = no group.
    """

    scene: Scene
    observations: Sequence[Observation]
    group: Hashable = None


@dataclass(frozen=True)
class Screening:
    """Starts of a search, and the number of them that are fitted.

    Attributes:
        starts: poses in which objects may begin, by name: given ones, random ones from
            ``sample_nearby_poses``, or those of ``pose_grid``. Or candidates, whose sensors
            differ, too.
        fits: number of the best starts that are fitted.
        shortlist: whether these are fitted in the first stage only, and the best of them in all.
    """

    starts: Mapping[str, Sequence[Object]] | Sequence[Candidate]
    fits: Count = 4
    shortlist: bool = False

    def candidates(self, scene: Scene, observations: Sequence[Observation]) -> list[Candidate]:
        """The starts as candidates.

        Args:
            scene: scene as known.
            observations: recordings with their models, where starts are poses.

        Raises:
            InputError: There are none.
        """
        found = self.starts
        if isinstance(found, Mapping):
            poses = [(name, item) for name, items in found.items() for item in items]
            scenes = [scene.replace(name, pose=item.transform) for name, item in poses]
            found = [Candidate(begun, observations) for begun in scenes]
        if not found:
            raise InputError("expected at least one start, got none; give poses of an object")
        return list(found)


@dataclass(frozen=True)
class Search:
    """Result of a multi-start fit.

    Attributes:
        best: fit with the lowest loss.
        minima: all ends that differ, the best first.
        scores: z-score of every end: the difference of its loss and the best one's, in standard
            deviations over realisations of its own twin. None where there are no realisations.
        ambiguities: a sentence for every end that the data do not reject.
        best_number: number of the best fit, as ``callbacks`` got it.
        objects: names of the objects with several starts.
        losses: losses of all candidates at the widest blur, in their order.
    """

    best: Reconstruction
    minima: list[Reconstruction]
    scores: list[float | None]
    ambiguities: tuple[str, ...]
    best_number: int
    objects: tuple[str, ...]
    losses: tuple[float, ...]

    def to_metrics(self) -> dict[str, Any]:
        """Return the other results as numbers: pose difference, loss, score."""
        best, ends = self.best.scene, []
        for end, score in zip(self.minima[1:], self.scores[1:], strict=True):
            pose = equivalents.describe_difference(best, end.scene, self.objects)
            ends.append({"pose": pose, "loss": end.loss, "score": score})
        found = {"other_ends": ends, "ambiguities": list(self.ambiguities)}
        return found | {"screened": list(self.losses)}


def pose_grid(
    item: Object,
    low: Point,
    high: Point,
    step: Positive,
    turns: Count = 4,
    axis: Point = (0.0, 0.0, 1.0),
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
    do = "give metres, a larger step, or fewer turns"
    require_at_most(total, _MAX_POSES, "poses", do, "step")
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
    starts: Mapping[str, Sequence[Object]] | Sequence[Candidate] | Screening,
    *,
    loss: Callable[[Tensor, Tensor], Tensor] | None = None,
    optimizer: Optimizer | None = None,
    schedule: Schedule | Sequence[Schedule] | None = None,
    regularizers: Sequence[Regularizer] = (),
    callbacks: Callable[[int], Sequence[Callback]] = lambda _: (),
    seed: int = 0,
) -> Search:
    """Fit from many starts, and report the results that the data do not distinguish.

    All starts are compared at the first, widest blur; the best few are fitted. Then the best end
    is rotated by half a turn and the other symmetries of its objects, and fitted again. Ends that
    differ are compared in pairs with realisations of the twin of the worse one: speckle that both
    losses share cancels in their difference.

    Args:
        scene: scene as known; the other arguments are those of ``reconstruct``.
        observations: recordings with their models.
        parameters: unknowns of the scene; every fit takes a copy.
        starts: poses by name of an object, candidates, or a ``Screening`` of either.
        loss: comparison of two maps.
        optimizer: kind and rates.
        schedule: stages of every fit.
        regularizers: terms added to the loss.
        callbacks: function of the number of a fit, from 0, that returns its callbacks.
        seed: seed of all random numbers.

    Raises:
        InputError: No starts; see ``reconstruct``.
    """
    watched = [observations] if isinstance(observations, Observation) else list(observations)
    screening = starts if isinstance(starts, Screening) else Screening(starts)
    names = list(screening.starts) if isinstance(screening.starts, Mapping) else []
    begun = screening.candidates(scene, watched)
    stages = [*schedule] if isinstance(schedule, Sequence) else [schedule or Schedule()]
    score_start = _make_screening_loss(watched, loss, seed)
    losses = [score_start(candidate) for candidate in track(begun, "starts")]
    order = sorted(range(len(begun)), key=losses.__getitem__)
    distinct = _drop_repeats((begun[k] for k in order), partial(_are_near, names=names))
    kept = list(islice(distinct, screening.fits))

    def fit(start: Candidate, number: int, parts: Sequence[Schedule]) -> Reconstruction:
        own = [replace(o, parameters=copy.deepcopy(o.parameters)) for o in start.observations]
        how: dict[str, Any] = {"loss": loss, "optimizer": optimizer, "regularizers": regularizers}
        how |= {"callbacks": callbacks(number), "seed": derive_seed(seed, number)}
        return reconstruct(start.scene, own, copy.deepcopy(parameters), schedule=parts, **how)

    if screening.shortlist and len(stages) > 1 and len(kept) > 1:
        tried = [fit(start, number, stages[:1]) for number, start in enumerate(kept)]
        first = tried.index(min(tried, key=_unblurred_loss))
        # Numbers of files go on after those of the trials.
        found, offset = [fit(kept[first], len(kept), stages)], len(kept)
    else:
        found, offset = [fit(start, number, stages) for number, start in enumerate(kept)], 0
    for start in _rotated_starts(min(found, key=_unblurred_loss)):
        found.append(fit(Candidate(start, watched), offset + len(found), stages))
    return _compare_ends(found, offset, names, losses)


def _compare_ends(
    found: Sequence[Reconstruction], offset: int, names: Sequence[str], losses: Sequence[float]
) -> Search:
    """Keep the ends that differ, the best first, and test which of them the data reject."""
    ordered = sorted(found, key=_unblurred_loss)
    ends = list(
        _drop_repeats(ordered, lambda a, b: equivalents.are_same_poses(a.scene, b.scene, names))
    )
    scores = [None, *(equivalents.difference_score(ends[0].result, end.result) for end in ends[1:])]
    texts = tuple(
        f"{equivalents.describe_difference(ends[0].scene, end.scene, names)} fits the data "
        f"nearly equally well: z = {z:.1f}"
        for end, z in zip(ends, scores, strict=True)
        if z is not None and z < equivalents.REJECTION_ZSCORE
    )
    number = offset + list(found).index(ends[0])
    return Search(ends[0], ends, scores, texts, number, tuple(names), tuple(losses))


def _make_screening_loss(
    observations: Sequence[Observation], loss: Callable[[Tensor, Tensor], Tensor] | None, seed: int
) -> Callable[[Candidate], float]:
    """The loss of a candidate at the widest blur."""
    losses = tuple(resolve_loss(o.model, o.loss or loss) for o in observations)
    objective = Objective(losses, tuple(o.weight for o in observations))
    blurred = [o.model.blur_observed(o.observed_map(), o.sensor) for o in observations]
    models = [_reduce_samples(o.model) for o in observations]

    def score(candidate: Candidate) -> float:
        with torch.no_grad():
            drawn = zip(models, candidate.observations, strict=True)
            maps = [model.predict(candidate.scene, o.initial_sensor(), seed) for model, o in drawn]
            visible = all(bool(power.any()) for power in maps)
            return float(objective(list(zip(maps, blurred, strict=True)))) if visible else math.inf

    return score


def _reduce_samples(model: ForwardModel) -> ForwardModel:
    """Return the model with the reduced samples of a blurred map."""
    sampling = getattr(model, "sampling", None)
    if not isinstance(sampling, Sampling):
        return model
    samples = max(1, sampling.samples // _SCREENING_DIVISOR)
    return model.with_sampling(samples=samples, boundary=False)


def _unblurred_loss(found: Reconstruction) -> float:
    return float(found.result.fit.objective(found.result.maps))


def _rotated_starts(found: Reconstruction) -> Iterator[Scene]:
    """Yield the twin with an object rotated by a near symmetry."""
    none = torch.zeros(3, dtype=torch.float64)
    for module in found.parameters:
        for turn in equivalents.candidate_rotations(module, found.scene):
            moved = displace(found.scene[str(module.object)], none, turn)
            yield found.scene.replace(str(module.object), pose=moved.transform.detach())


def _drop_repeats(items: Iterable[_Item], alike: Callable[[_Item, _Item], bool]) -> Iterator[_Item]:
    """Yield items, without those that an earlier one stands for."""
    kept: list[_Item] = []
    for item in items:
        if not any(alike(item, other) for other in kept):
            kept.append(item)
            yield item


def _are_near(first: Candidate, second: Candidate, names: Sequence[str]) -> bool:
    """Return whether one start stands for another."""
    if not names:
        return first.group is not None and first.group == second.group
    offs = [pose_error(first.scene[name], second.scene[name]) for name in names]
    near = (o and o.distance < _SAME_START_DISTANCE and o.angle < _SAME_START_ANGLE for o in offs)
    return all(near)
