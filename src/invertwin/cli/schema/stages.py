"""The tables of fits in stages, of their variants, and of how shapes are scored."""

from typing import Annotated, Literal

from pydantic import Field

from invertwin.cli.schema.section import Count, NonNegative, Positive, Section


class Settings(Section):
    """What a part of a fit may do otherwise; without a key as in the tables of the whole."""

    steps: Count | None = None
    """budget"""
    optimizer: Literal["adam", "sgd", "gauss_newton"] | None = None
    """how a gradient becomes a step: its `kind`"""
    rate: Positive | None = None
    """of the optimizer"""
    final_rate: NonNegative | None = None
    """of the optimizer"""
    samples: Count | None = None
    """rays a step"""
    boundary_samples: Count | None = None
    """silhouette samples a step"""
    frames_per_step: Count | None = None
    """random frames a step"""
    range_width: NonNegative | None = None
    """of the surrogate at the first step, in range cells"""
    angle_width: NonNegative | None = None
    """of the surrogate at the first step, in beamwidths"""
    annealing: Annotated[float, Field(gt=0, le=1)] | None = None
    """share of these steps with extra width"""


class Stage(Settings):
    """A part of a fit, from where the one before has ended."""

    parameters: list[str] = []
    """names of what is free; the others keep their values; empty = all"""
    rebuild: bool = False
    """these parameters begin anew on the twin so far, the others are dropped"""
    remesh: Positive | None = None
    """m, edge length of the new triangles of objects with free vertices; rebuilds them"""


class Variant(Settings):
    """The same data and start, fitted otherwise, to compare."""

    parameters: Annotated[list[str], Field(min_length=1)] | None = None
    """names of what is sought; without it all"""
    observations: Annotated[list[str], Field(min_length=1)] | None = None
    """names of the sensors that are fitted; without it all"""
    boundary: bool | None = None
    """with boundary terms"""
    smooth: NonNegative | None = None
    """of free vertices"""
    stages: list[Stage] | None = None
    """in place of [[stages]]"""


class Measures(Section):
    """How near the found shape is to the true one, in numbers and pictures."""

    object: str
    """name in the scene"""
    thresholds: Annotated[list[Positive], Field(min_length=1)] = [0.02]
    """m, of the F-score"""
    voxel: Positive = 0.02
    """m, for the shared volume"""
    seen: bool = False
    """score what some radar position sees; both are written"""
    every: Count = 10
    """steps between two points of the curve"""
