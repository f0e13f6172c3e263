"""The tables of fits: starts, budget, stages, variants, scores."""

from collections.abc import Callable
from typing import Annotated, Any, Literal

from annotated_types import Ge, MinLen
from pydantic import PlainSerializer, WrapValidator

from invertwin.channel import Sampling
from invertwin.cli.schema.fit_tables import SurrogateTable
from invertwin.inversion import InitialPoseEstimator, Schedule, sample_nearby_poses
from invertwin.limits import Count, NonNegative, Positive
from invertwin.radar.surrogate.surrogate import Surrogate
from invertwin.registry.kinds import ConstructorTable, OneOf, TableOf, registry
from invertwin.registry.section import Section, Seed, Vector


class _StartsTable(ConstructorTable):
    """Random starting poses about the true pose of one object.

    Attributes:
        object: name in the scene
        joint_deg: turn of each free joint of a body, about a random axis among its own
        seed: without it the run's
    """

    object: str
    joint_deg: NonNegative = 0.0
    seed: Seed | None = None


class _InitialTable(ConstructorTable):
    """Initial pose of an object from conventional processing.

    Attributes:
        object: name in the scene; with [map] none: it is the first transmitter, at the centroid of
            power
    """

    object: str | None = None


AnyStarts = Annotated[Any, TableOf(sample_nearby_poses, _StartsTable, ("generator",))]
AnyInitial = Annotated[Any, TableOf(InitialPoseEstimator, _InitialTable)]

_NO_KEYS = ("interior_edges", "points_per_m2", "rough_paths", "memory_budget", "backend")
_NO_KEYS += ("conductor_samples",)  # as many as samples
SamplingBase = registry.constructor_table(Sampling, "SamplingTable", without=_NO_KEYS)


class Budget(registry.constructor_table(Schedule, "Schedule", SamplingBase)):
    """Budget of a fit: steps and samples."""


class ReconstructTable(Budget):
    """The fit: its budget, and what counts as a success.

    Attributes:
        parameters: names of the parameters that are fitted; empty = all
        observations: names of the sensors that are fitted; empty = all
        checkpoint_every: steps from one checkpoint to the next
        nuisances: unknowns of the radar, fitted too
        clutter: echoes that the scene does not explain count as background, about which the best
            fit is made again: auto = where the data are inconsistent with it; with the likelihood
            only
        position_limit: m, largest error of a success
        rotation_limit_deg: largest error of a success
        axis: in the object's frame: success is judged by its origin and by this axis, turns about
            which do not count
        joint_limit_deg: largest mean error over the free joints of a body
    """

    parameters: list[str] = []
    observations: list[str] = []
    checkpoint_every: Count = 10
    nuisances: list[Literal["range_bias", "clock_offset"]] = []
    clutter: Literal["auto", "always", "never"] = "auto"
    position_limit: Positive = 0.03
    rotation_limit_deg: Positive = 3.0
    axis: Vector | None = None
    joint_limit_deg: Positive = 5.0


def _validate_unchanged(value: Any, check: Callable[[Any], Any]) -> Any:
    check(value)
    return value


# A table of a part stays as given. What must be complete to be right is checked once it is merged.
_KEEP_AS_GIVEN = WrapValidator(lambda value, _: value), PlainSerializer(lambda value: value)
_VALIDATE_AS_GIVEN = WrapValidator(_validate_unchanged), _KEEP_AS_GIVEN[1]
TomlTable = dict[str, Any]


class RunOverrides(Section):
    """A part of a run: its sections hold only what differs from the run.

    Attributes:
        reconstruct: what differs from [reconstruct]
        optimizer: what differs from [optimizer]; another `kind` replaces it
        surrogate: what differs from [surrogate], or a name that replaces it
        model: what differs from [model]; another `kind` replaces it
        map: what differs from [map]
        placement: what differs from [placement]
    """

    reconstruct: Annotated[Budget | None, *_VALIDATE_AS_GIVEN] = None
    optimizer: Annotated[Any, OneOf("optimizer"), *_KEEP_AS_GIVEN] = None
    surrogate: Annotated[Any, TableOf(Surrogate, SurrogateTable), *_KEEP_AS_GIVEN] = None
    model: TomlTable | None = None
    map: TomlTable | None = None
    placement: TomlTable | None = None

    def overrides(self) -> dict[str, Any]:
        """Tables merged over the run; a part has no stages."""
        own = set(RunOverrides.model_fields)
        return self.model_dump(include=own, exclude_none=True) | {"stages": []}


class StageTable(RunOverrides):
    """A part of a fit, from where the one before has ended.

    Attributes:
        parameters: names of those that are free; the others keep their values; empty = all
        rebuild: new modules of these parameters start from the twin so far; the others are dropped
        remesh: m, edge length of the new triangles of objects with free vertices; rebuilds them
    """

    parameters: list[str] = []
    rebuild: bool = False
    remesh: Positive | None = None


class VariantTable(RunOverrides):
    """The same data and starts, fitted in another way, to compare.

    Attributes:
        reconstruct: what differs from [reconstruct]
        loss: what differs from [loss]
        parameters: in place of [[parameters]]
        search: what differs from [search]; another `kind` replaces it
        stages: in place of [[stages]]
        first_starts: so many of the starts; without it all
    """

    reconstruct: Annotated[ReconstructTable | None, *_VALIDATE_AS_GIVEN] = None  # type: ignore[override]
    loss: TomlTable | None = None
    parameters: list[Annotated[Any, OneOf("parameter")]] | None = None
    search: TomlTable | None = None
    stages: list[StageTable] | None = None
    first_starts: Count | None = None

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
    """Range bias and clock offset from one object whose place is known, before the fit.

    Attributes:
        object: name of the known object
        method: fit the two numbers, or focus the object best
    """

    object: str
    method: Literal["fit", "backprojection"] = "fit"


class MeasuresTable(Section):
    """Measures of shape error against the truth, in numbers and pictures.

    Attributes:
        object: name in the scene
        thresholds: m, thresholds of the F-score
        voxel: m, edge of voxels for the shared volume
        seen: score only what some radar position sees; both are written
        every: steps between two points of the curve
    """

    object: str
    thresholds: Annotated[list[Positive], MinLen(1)] = [0.02]
    voxel: Positive = 0.02
    seen: bool = False
    every: Count = 10


class PlanTable(Section):
    """Settings of a plan: comparisons and candidate positions.

    Attributes:
        fits: simulated fits whose spread it is compared with
        candidates: m, positions that may be added
    """

    fits: Annotated[int, Ge(0)] = 0
    candidates: Annotated[Any, OneOf("track")] | None = None


class LandscapeTable(Section):
    """Losses along a line through the truth: exact signal beside surrogate.

    Attributes:
        object: name in the scene
        axis: direction of the line
        span: m on either side, surrogate
        points: points on the line, surrogate
        exact_span: m on either side, exact signal
        exact_points: points on the line, exact signal
    """

    object: str
    axis: Vector
    span: Positive = 0.4
    points: Annotated[int, Ge(3)] = 41
    exact_span: Positive = 0.01
    exact_points: Annotated[int, Ge(3)] = 201
