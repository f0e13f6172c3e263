"""How much work a trace does: one value that travels from the user to the kernels."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Le

from invertwin.errors import InputError
from invertwin.limits import MAX_COUNT, Count

_MAX_DEPTH = 16

ALL_OTHERS = "*"
"""In densities by object: all objects that are not named."""

Densities = float | Mapping[str, float]
"""Points per m² of all objects, or of each by its name."""


@dataclass(frozen=True)
class Sampling:
    """How many paths are drawn, of how many bounces, and where.

    Attributes:
        depth: Most bounces of a path.
        samples: Power: rays over all frames. Fields: samples per frame on conductors.
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
    samples: Count = 400_000
    boundary_samples: Annotated[int, Ge(0), Le(MAX_COUNT)] = 50_000
    boundary: bool = True
    interior_edges: bool = True
    contacts: bool = True
    points_per_m2: Densities = 20_000.0
    rough_paths: int = 200_000
    memory_budget: float = 0.25e9
    backend: str | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.depth <= _MAX_DEPTH:
            raise InputError(
                f"expected a depth from 1 to {_MAX_DEPTH}, got {self.depth}; give the most bounces "
                "of a path"
            )
        if not (1 <= self.samples <= MAX_COUNT and 0 <= self.boundary_samples <= MAX_COUNT):
            raise InputError(
                f"expected samples from 1 and boundary_samples from 0 to {MAX_COUNT}, got "
                f"{self.samples} and {self.boundary_samples}; give the number of rays over all "
                "frames"
            )
        if isinstance(self.points_per_m2, Mapping):
            object.__setattr__(self, "points_per_m2", dict(self.points_per_m2))
            densities = list(self.points_per_m2.values())
        else:
            densities = [self.points_per_m2]
        if not all(density > 0 for density in densities) or self.rough_paths < 1:
            raise InputError(
                "expected points_per_m2 > 0 and rough_paths >= 1, got "
                f"{self.points_per_m2} and {self.rough_paths}; try 2e4 points per m²"
            )
