"""Numbers of paths to sample: one value that travels from the user to the kernels."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Le

from invertwin.checks import check_fields, checked_number
from invertwin.deprecation import warn_renamed
from invertwin.errors import InputError
from invertwin.limits import MAX_COUNT, Count
from invertwin.scene.scene import Scene

_MAX_DEPTH = 16
_DEFAULT_SAMPLES = 400_000

ALL_OTHERS = "*"
"""In densities by object: all objects that are not named."""

Densities = float | Mapping[str, float]
"""Points per m² of all objects, or of each by its name."""


def resolve_densities(scene: Scene, points_per_m2: Densities) -> dict[str, float]:
    """Return the points per m² of every rough object.

    Args:
        scene: Surfaces.
        points_per_m2: One number, or numbers by name.

    Raises:
        InputError: A name that the scene does not have, or a rough object without a number.
    """
    rough = [name for name, item in scene.objects.items() if not item.material.coherent]
    if not isinstance(points_per_m2, Mapping):
        return dict.fromkeys(rough, points_per_m2)
    unknown = [name for name in points_per_m2 if name not in (*scene.names, ALL_OTHERS)]
    if unknown:
        raise InputError(
            f"expected points_per_m2 of objects of the scene ({', '.join(scene.names)}), or of "
            f'"{ALL_OTHERS}" for all others, got {unknown[0]!r}; use one of these names'
        )
    found = {name: points_per_m2.get(name, points_per_m2.get(ALL_OTHERS)) for name in rough}
    missing = [name for name, density in found.items() if density is None]
    if missing:
        raise InputError(
            f"expected points_per_m2 of every rough object, got none of {', '.join(missing)}; "
            f'add them, or "{ALL_OTHERS}" for all that are not named'
        )
    return {name: density for name, density in found.items() if density is not None}


@dataclass(frozen=True)
class Sampling:
    """Numbers of sampled paths, of bounces, and of points on surfaces.

    ``samples`` belongs to expected power (``SurrogateMap``, ``RangeDopplerMap``);
    ``conductor_samples``, ``points_per_m2`` and ``rough_paths`` to fields (``simulate``,
    ``ExactMap``).

    Attributes:
        depth: Most bounces of a path.
        samples: Rays of expected power, over all frames.
        conductor_samples: Points per frame on smooth conductors, which carry fields; None =
            400 000.
        boundary_samples: Silhouette samples over all frames. Only derivatives use them, since
            boundary paths are zero in value.
        boundary: False leaves the boundary paths out: derivatives at fixed visibility, for
            ablation.
        interior_edges: False leaves out the shadows that surfaces cast on each other, for
            ablation.
        contacts: False leaves out what moves where surfaces cross or touch, for ablation.
        points_per_m2: Fixed points on rough surfaces, which carry fields of one bounce: one
            number, or numbers by the names of objects, such as ``{"person": 4000.0, "*": 200.0}``;
            ``"*"`` is for all others. The expected power is the same for all of them.
        rough_paths: Fixed rough paths of several bounces that are drawn of each length; at most a
            quarter of them are kept.
        memory_budget: Bytes of power samples alive at a time. More samples go in chunks, and the
            derivative traces them again instead of keeping them.
        backend: ``cpu``, ``cuda`` or ``auto``; None is the one in force.

    Raises:
        InputError: A number out of range.
    """

    depth: Annotated[int, Ge(1), Le(_MAX_DEPTH)] = 3
    samples: Count = _DEFAULT_SAMPLES
    boundary_samples: Annotated[int, Ge(0), Le(MAX_COUNT)] = 50_000
    boundary: bool = True
    interior_edges: bool = True
    contacts: bool = True
    points_per_m2: Densities = 20_000.0
    rough_paths: Annotated[int, Ge(1)] = 200_000
    memory_budget: float = 0.25e9
    backend: str | None = None
    conductor_samples: Count | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        if isinstance(self.points_per_m2, Mapping):
            object.__setattr__(self, "points_per_m2", dict(self.points_per_m2))
            densities = list(self.points_per_m2.values())
        else:
            densities = [self.points_per_m2]
        for density in densities:
            checked_number(density, "points_per_m2", 0.0, open_low=True)

    def count_conductor_samples(self) -> int:
        """Return the number of points per frame on smooth conductors.

        Until version 0.5, ``samples`` stands for it where it is given alone, with a warning.
        """
        if self.conductor_samples is not None:
            return self.conductor_samples
        if self.samples != _DEFAULT_SAMPLES:
            warn_renamed(
                "Sampling(samples=...) for fields of conductors", "Sampling(conductor_samples=...)"
            )
        return self.samples
