"""The tables of fits: starts, budget, stages, variants, scores."""

from collections.abc import Callable
from typing import Annotated, Any, Literal

from annotated_types import Ge, MinLen
from pydantic import PlainSerializer, WrapValidator

from invertwin.channel import Sampling
from invertwin.cli.schema.fit_tables import SurrogateTable
from invertwin.inversion.initialisation.initial_pose import InitialPoseEstimator
from invertwin.inversion.initialisation.starts import sample_nearby_poses
from invertwin.inversion.schedule import Schedule
from invertwin.limits import Count, NonNegative, Positive
from invertwin.radar.surrogate.surrogate import Surrogate
from invertwin.registry.kinds import ConstructorTable, OneOf, TableOf, registry
from invertwin.registry.section import Section, Seed, Vector, key


class _StartsTable(ConstructorTable):
    """Random starting poses about the true pose of one object."""

    object: str = key("name in the scene")
    joint_deg: NonNegative = key(
        "turn of each free joint of a body, about a random axis among its own", 0.0
    )
    seed: Seed | None = key("without it the run's", None)


class _InitialTable(ConstructorTable):
    """Initial pose of an object from conventional processing."""

    object: str | None = key(
        "name in the scene; with [map] none: it is the first transmitter, at the centroid of power",
        None,
    )


AnyStarts = Annotated[Any, TableOf(sample_nearby_poses, _StartsTable, ("generator",))]
AnyInitial = Annotated[Any, TableOf(InitialPoseEstimator, _InitialTable)]

SamplingBase = registry.constructor_table(
    Sampling,
    "SamplingTable",
    without=(
        *("interior_edges", "points_per_m2", "rough_paths", "memory_budget", "backend"),
        "conductor_samples",  # as many as samples
    ),
)


class Budget(registry.constructor_table(Schedule, "Schedule", SamplingBase)):
    """Budget of a fit: steps and samples."""


class ReconstructTable(Budget):
    """The fit: its budget, and what counts as a success."""

    parameters: list[str] = key("names of the parameters that are fitted; empty = all", [])
    observations: list[str] = key("names of the sensors that are fitted; empty = all", [])
    checkpoint_every: Count = key("steps from one checkpoint to the next", 10)
    nuisances: list[Literal["range_bias", "clock_offset"]] = key(
        "unknowns of the radar, fitted too", []
    )
    clutter: Literal["auto", "always", "never"] = key(
        "echoes that the scene does not explain count as background, about which the best fit is "
        "made again: auto = where the data are inconsistent with it; with the likelihood only",
        "auto",
    )
    position_limit: Positive = key("m, largest error of a success", 0.03)
    rotation_limit_deg: Positive = key("largest error of a success", 3.0)
    axis: Vector | None = key(
        "in the object's frame: success is judged by its origin and by this axis, turns about "
        "which do not count",
        None,
    )
    joint_limit_deg: Positive = key("largest mean error over the free joints of a body", 5.0)


def _validate_unchanged(value: Any, check: Callable[[Any], Any]) -> Any:
    check(value)
    return value


# A table of a part stays as given. What must be complete to be right is checked once it is merged.
_KEEP_AS_GIVEN = WrapValidator(lambda value, _: value), PlainSerializer(lambda value: value)
_VALIDATE_AS_GIVEN = WrapValidator(_validate_unchanged), _KEEP_AS_GIVEN[1]
TomlTable = dict[str, Any]


class RunOverrides(Section):
    """A part of a run: its sections hold only what differs from the run."""

    reconstruct: Annotated[Budget, *_VALIDATE_AS_GIVEN] = key(
        "what differs from [reconstruct]", None
    )
    optimizer: Annotated[Any, OneOf("optimizer"), *_KEEP_AS_GIVEN] = key(
        "what differs from [optimizer]; another `kind` replaces it", None
    )
    surrogate: Annotated[Any, TableOf(Surrogate, SurrogateTable), *_KEEP_AS_GIVEN] = key(
        "what differs from [surrogate], or a name that replaces it", None
    )
    model: TomlTable | None = key("what differs from [model]; another `kind` replaces it", None)
    map: TomlTable | None = key("what differs from [map]", None)
    placement: TomlTable | None = key("what differs from [placement]", None)

    def overrides(self) -> dict[str, Any]:
        """Tables merged over the run; a part has no stages."""
        own = set(RunOverrides.model_fields)
        return self.model_dump(include=own, exclude_none=True) | {"stages": []}


class StageTable(RunOverrides):
    """A part of a fit, from where the one before has ended."""

    parameters: list[str] = key(
        "names of those that are free; the others keep their values; empty = all", []
    )
    rebuild: bool = key(
        "new modules of these parameters start from the twin so far; the others are dropped", False
    )
    remesh: Positive | None = key(
        "m, edge length of the new triangles of objects with free vertices; rebuilds them", None
    )


class VariantTable(RunOverrides):
    """The same data and starts, fitted in another way, to compare."""

    reconstruct: Annotated[ReconstructTable, *_VALIDATE_AS_GIVEN] = key(  # type: ignore[override]
        "what differs from [reconstruct]", None
    )
    loss: TomlTable | None = key("what differs from [loss]", None)
    parameters: list[Annotated[Any, OneOf("parameter")]] | None = key(
        "in place of [[parameters]]", None
    )
    search: TomlTable | None = key("what differs from [search]; another `kind` replaces it", None)
    stages: list[StageTable] | None = key("in place of [[stages]]", None)
    first_starts: Count | None = key("so many of the starts; without it all", None)

    def overrides(self) -> dict[str, Any]:
        """Tables merged over the run."""
        return self.model_dump(exclude_unset=True, exclude_none=True, exclude={"first_starts"})

    def with_resolved_paths(self, run: Any) -> "VariantTable":
        """The variant with paths of files as the run that it makes has found them."""
        found: dict[str, Any] = {}
        for name, change in self.overrides().items():
            value = run.model_dump(include={name}, exclude_unset=True)[name]
            found[name] = {k: value[k] for k in change} if isinstance(change, dict) else value
        first = {} if self.first_starts is None else {"first_starts": self.first_starts}
        return VariantTable.model_validate(found | first)


class CalibrationTable(RunOverrides):
    """Range bias and clock offset from one object whose place is known, before the fit."""

    object: str = key("name of the known object")
    method: Literal["fit", "backprojection"] = key(
        "fit the two numbers, or focus the object best", "fit"
    )


class MeasuresTable(Section):
    """Measures of shape error against the truth, in numbers and pictures."""

    object: str = key("name in the scene")
    thresholds: Annotated[list[Positive], MinLen(1)] = key("m, thresholds of the F-score", [0.02])
    voxel: Positive = key("m, edge of voxels for the shared volume", 0.02)
    seen: bool = key("score only what some radar position sees; both are written", False)
    every: Count = key("steps between two points of the curve", 10)


class PlanTable(Section):
    """Settings of a plan: comparisons and candidate positions."""

    fits: Annotated[int, Ge(0)] = key("simulated fits whose spread it is compared with", 0)
    candidates: Annotated[Any, OneOf("track")] | None = key("m, positions that may be added", None)


class LandscapeTable(Section):
    """Losses along a line through the truth: exact signal beside surrogate."""

    object: str = key("name in the scene")
    axis: Vector = key("direction of the line")
    span: Positive = key("m on either side, surrogate", 0.4)
    points: Annotated[int, Ge(3)] = key("points on the line, surrogate", 41)
    exact_span: Positive = key("m on either side, exact signal", 0.01)
    exact_points: Annotated[int, Ge(3)] = key("points on the line, exact signal", 201)
