"""The tables of fits: starts, budget, stages, variants, scores."""

from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, Lt, MinLen
from pydantic import model_validator

from invertwin.cli.registry import NameOf
from invertwin.cli.section import (
    Depth,
    Interval,
    Section,
    Seed,
    Vector,
    WorldAxes,
    check_presence,
    key,
)
from invertwin.limits import Count, NonNegative, Positive

Names = Annotated[list[str], MinLen(1)]
_Rate = NonNegative | None
_WholeOr = "; without it that of the main fit"


class Starts(Section):
    """Random starting poses about the true pose of one object."""

    object: str = key("name in the scene")
    count: Count = key("of starts", 1)
    distance: Interval = key("m, least and most")
    angle_deg: Interval = key("least and most", [0.0, 0.0])
    axes: WorldAxes = key("of the offset", ["x", "y", "z"])
    rotation_axis: Vector | None = key("without it any axis", None)
    joint_deg: NonNegative = key(
        "turn of each sought joint of a body, about a random axis among its own", 0.0
    )
    seed: Seed | None = key("without it the run's", None)


class Initial(Section):
    """Where an object stands by conventional processing: the fit starts there, not where the
    scene has it."""

    object: str = key("name in the scene")
    low: Vector | None = key(
        "m, corner of the box of the world that is searched; needed unless the pose is known", None
    )
    high: Vector | None = key("m, its opposite corner", None)
    method: Literal["points", "image"] = key(
        "points = of a CFAR detector; image = backprojected power", "points"
    )
    pose: Literal["rectangle", "axes", "position", "known"] = key(
        "how it stands: the near sides of a rectangle, principal axes, no turn, or as the scene "
        "says: then its density alone is guessed",
        "rectangle",
    )
    scale: bool = key("size from the rectangle, too", False)
    up: Literal["y", "z"] = key("world axis of heights", "y")
    false_alarm: Annotated[float, Gt(0), Lt(1)] = key("of a cell of noise, for points", 1e-6)
    step: Positive = key("m, of the image", 0.1)
    gap: Positive = key("m; echoes with wider gaps between them are not of one object", 1.0)

    @model_validator(mode="after")
    def _complete(self) -> "Initial":
        needed = self.pose != "known"
        check_presence(self, {"low": needed, "high": needed}, f'with pose = "{self.pose}"')
        return self


class Reconstruct(Section):
    """The fit: its budget, and what counts as a success."""

    steps: Count = key("budget")
    parameters: list[str] = key(
        "names of what is sought, where variants seek other things; empty = all", []
    )
    depth: Depth = key("most bounces of a path", 3)
    samples: Count = key("rays a step", 400_000)
    boundary_samples: Count = key("silhouette samples a step", 50_000)
    annealing: Annotated[float, Gt(0), Le(1)] = key("share of the steps with extra width", 0.7)
    frames_per_step: Count | None = key("random frames a step; without it all", None)
    tolerance: NonNegative = key(
        "stop when the loss falls by less than this share; 0 = use all steps", 0.0
    )
    checkpoint_every: Count = key("steps", 10)
    nuisances: list[Literal["range_bias", "clock_offset"]] = key("fitted along", [])
    boundary: bool = key("with boundary terms (silhouettes)", True)
    also_interior_only: bool = key("fit again without boundary terms, to compare", False)
    position_limit: Positive = key("m, of a success", 0.03)
    rotation_limit_deg: Positive = key("of a success", 3.0)
    joint_limit_deg: Positive = key("of a success, mean over the sought joints of a body", 5.0)


class Settings(Section):
    """What a part of a fit may do otherwise; without a key as in the tables of the whole."""

    steps: Count | None = key("budget", None)
    optimizer: Annotated[str, NameOf("optimizer")] | None = key(
        "how a gradient becomes a step: its `kind`", None
    )
    rate: Positive | None = key("of the optimizer", None)
    final_rate: _Rate = key("of the optimizer", None)
    samples: Count | None = key("rays a step", None)
    boundary_samples: Count | None = key("silhouette samples a step", None)
    frames_per_step: Count | None = key("random frames a step", None)
    range_width: _Rate = key("of the surrogate at the first step, in range cells", None)
    angle_width: _Rate = key("of the surrogate at the first step, in beamwidths", None)
    annealing: Annotated[float, Gt(0), Le(1)] | None = key(
        "share of these steps with extra width", None
    )


class Stage(Settings):
    """A part of a fit, from where the one before has ended."""

    parameters: list[str] = key(
        "names of what is free; the others keep their values; empty = all", []
    )
    rebuild: bool = key(
        "these parameters begin anew on the twin so far, the others are dropped", False
    )
    remesh: Positive | None = key(
        "m, edge length of the new triangles of objects with free vertices; rebuilds them", None
    )


class Variant(Settings):
    """The same data and start, fitted otherwise, to compare."""

    parameters: Names | None = key("names of what is sought; without it all", None)
    observations: Names | None = key("names of the sensors that are fitted; without it all", None)
    boundary: bool | None = key("with boundary terms", None)
    smooth: _Rate = key("of free vertices", None)
    stages: list[Stage] | None = key("in place of [[stages]]", None)


class Measures(Section):
    """How near the found shape is to the true one, in numbers and pictures."""

    object: str = key("name in the scene")
    thresholds: Annotated[list[Positive], MinLen(1)] = key("m, of the F-score", [0.02])
    voxel: Positive = key("m, for the shared volume", 0.02)
    seen: bool = key("score what some radar position sees; both are written", False)
    every: Count = key("steps between two points of the curve", 10)


class Calibration(Section):
    """Range bias and clock offset from one object whose place is known, before the fit.

    With `method = "fit"` by a reconstruction of these two numbers, all else as in the main fit;
    with `"backprojection"` by what focuses the object best.
    """

    object: str = key("name of the known object")
    method: Literal["fit", "backprojection"] = key(
        "a fit of the two numbers, or what focuses the object best", "fit"
    )
    steps: Count | None = key("without it those of the main fit", None)
    rate: Positive | None = key("without it that of the main fit", None)


class Landscape(Section):
    """Losses along a line through the truth: exact signal beside surrogate."""

    object: str = key("name in the scene")
    axis: Vector = key("direction of the line")
    span: Positive = key("m on either side, surrogate", 0.4)
    points: Annotated[int, Ge(3)] = key("on the line, surrogate", 41)
    exact_span: Positive = key("m on either side, exact signal", 0.01)
    exact_points: Annotated[int, Ge(3)] = key("on the line", 201)
