"""The tables of the data and of what is sought in them."""

from typing import Annotated, Any, Literal

from pydantic import Field, Tag, model_validator

from invertwin.cli.schema.mover import OpenRadarData
from invertwin.cli.schema.parameters import Counts, MaterialValue
from invertwin.cli.schema.recording import ArraysData, Dca1000Data
from invertwin.cli.schema.section import (
    TAG_MARK,
    Count,
    Depth,
    InputPath,
    Interval,
    NonNegative,
    Positive,
    Section,
    Seed,
    Vector,
    WorldAxes,
    check_presence,
    fail,
    tag_by,
)
from invertwin.errors import InputError
from invertwin.radar.surrogate import chosen_surrogate


class SimulatedData(Section):
    """Exact signals of the true scene, with noise."""

    kind: Literal["simulated"]
    density: Positive
    """rough points per m²"""
    samples: Count = 200_000
    """coherent paths"""
    depth: Depth = 3
    """most bounces of a path; with [chirps] it is one"""
    chains: Count = 200_000
    """paths of two bounces to draw, and of each number above"""
    snr_db: float | None = None
    """signal to noise per sample; without it no noise"""
    noise_figure_db: float | None = None
    """thermal noise of a receiver instead of snr_db"""
    seed: Seed | None = None
    """without it the run's"""

    @model_validator(mode="after")
    def _one_noise_level(self) -> "SimulatedData":
        if self.snr_db is not None and self.noise_figure_db is not None:
            fail("expected snr_db or noise_figure_db, got both; remove one")
        return self


class CaptureData(Section):
    """A capture saved by the library (NetCDF)."""

    kind: Literal["capture"]
    file: InputPath
    """path, from the run file's folder"""
    channels: InputPath | None = None
    """channel calibration that `invertwin look --reflector` wrote; divided out"""


class RailSarData(Section):
    """The public recording of an ultra-wideband radar on a rail."""

    kind: Literal["rail_sar"]
    folder: InputPath
    """path, from the run file's folder, then from INVERTWIN_DATA"""


MeasuredData = CaptureData | Dca1000Data | ArraysData | RailSarData

Data = Annotated[
    Annotated[SimulatedData, Tag(TAG_MARK + "simulated")]
    | Annotated[CaptureData, Tag(TAG_MARK + "capture")]
    | Annotated[Dca1000Data, Tag(TAG_MARK + "dca1000")]
    | Annotated[ArraysData, Tag(TAG_MARK + "arrays")]
    | Annotated[RailSarData, Tag(TAG_MARK + "rail_sar")]
    | Annotated[OpenRadarData, Tag(TAG_MARK + "openradar")],
    tag_by("kind"),
]


class Starts(Section):
    """Random starting poses about the true pose of one object."""

    object: str
    """name in the scene"""
    count: Count = 1
    """of starts"""
    distance: Interval
    """m, least and most"""
    angle_deg: Interval = [0.0, 0.0]
    """least and most"""
    axes: WorldAxes = ["x", "y", "z"]
    """of the offset"""
    rotation_axis: Vector | None = None
    """without it any axis"""
    joint_deg: NonNegative = 0.0
    """turn of each sought joint of a body, about a random axis among its own"""
    seed: Seed | None = None
    """without it the run's"""


class Surrogate(Section):
    """Kernels of the smooth model; the extra widths anneal to zero, in cells.

    A name may stand for the table: surrogate = "exact", "response", "annealed", "gaussian",
    "dirichlet" or "random_phase", before the first table.
    """

    range_kernel: Literal["response", "gaussian", "dirichlet"] = "response"
    """response = that of waveform and window; dirichlet = without a window"""
    angle_kernel: Literal["response", "airy"] = "response"
    """response = that of arrays and window"""
    range_width: NonNegative = 0.0
    """extra blur at the first step, in range cells; falls to 0"""
    angle_width: NonNegative = 0.0
    """extra blur at the first step, in beamwidths; falls to 0"""
    phases: Literal["mean", "random"] = "mean"
    """random = the paper's field (gaussian, airy), blind to silhouettes on average"""
    exact: bool = False
    """fit the exact chain instead; rough surfaces need boundary = false"""

    @model_validator(mode="before")
    @classmethod
    def _by_name(cls, data: Any) -> Any:
        if not isinstance(data, str):
            return data
        try:
            chosen = chosen_surrogate(data)
        except InputError as error:
            fail(str(error))
        if chosen is None:
            return {"exact": True}
        return {k: v for k, v in vars(chosen).items() if k in cls.model_fields}

    @model_validator(mode="after")
    def _fits_together(self) -> "Surrogate":
        kernels = (self.range_kernel, self.angle_kernel)
        if self.phases == "random" and (kernels != ("gaussian", "airy") or self.angle_width > 0):
            fail(
                'expected range_kernel = "gaussian", angle_kernel = "airy" and no angle_width with '
                f'phases = "random", got "{kernels[0]}", "{kernels[1]}" and {self.angle_width:g}; '
                'write surrogate = "random_phase"'
            )
        return self


class Loss(Section):
    """How measured and simulated maps are compared."""

    kind: Literal["mse", "likelihood"] = "mse"
    """mse = squared difference; likelihood = of speckle, for a dim object before a bright wall"""
    levels: Count = 3
    """resolutions that are compared"""
    gain: Literal["fitted", "one"] = "fitted"
    """fitted = the unknown overall gain is divided out"""
    background: Literal["none", "level", "static"] = "none"
    """taken out of both, mse only"""
    floor: Positive | None = None
    """over the mean measured power, likelihood only"""

    @model_validator(mode="after")
    def _fits_the_kind(self) -> "Loss":
        if self.kind == "likelihood" and self.background != "none":
            fail(
                f'expected background = "none" with kind = "likelihood", got "{self.background}"; '
                "the floor stands for a background"
            )
        if self.kind == "mse" and self.floor is not None:
            fail('expected no `floor` with kind = "mse", got one; remove it')
        return self


class Optimizer(Section):
    kind: Literal["adam", "sgd", "gauss_newton"] = "adam"
    """how a gradient becomes a step; gauss_newton for at most 64 parameters"""
    rate: Positive = 0.03
    """m, and rad without rotation_rate; of gauss_newton the longest change in a step"""
    rotation_rate: Positive | None = None
    """rad"""
    final_rate: NonNegative | None = None
    """on the last step; without it rate / 20"""
    momentum: Annotated[float, Field(ge=0, lt=1)] = 0.9
    """of sgd"""
    curvature_every: Count = 1
    """steps from one curvature of gauss_newton to the next"""


class Reconstruct(Section):
    steps: Count
    """budget"""
    parameters: list[str] = []
    """names of what is sought, where variants seek other things; empty = all"""
    depth: Depth = 3
    """most bounces of a path"""
    samples: Count = 400_000
    """rays a step"""
    boundary_samples: Count = 50_000
    """silhouette samples a step"""
    annealing: Annotated[float, Field(gt=0, le=1)] = 0.7
    """share of the steps with extra width"""
    frames_per_step: Count | None = None
    """random frames a step; without it all"""
    tolerance: NonNegative = 0.0
    """stop when the loss falls by less than this share; 0 = use all steps"""
    checkpoint_every: Count = 10
    """steps"""
    nuisances: list[Literal["range_bias", "clock_offset"]] = []
    """fitted along"""
    boundary: bool = True
    """with boundary terms (silhouettes)"""
    also_interior_only: bool = False
    """fit again without boundary terms, to compare"""
    position_limit: Positive = 0.03
    """m, of a success"""
    rotation_limit_deg: Positive = 3.0
    """of a success"""
    joint_limit_deg: Positive = 5.0
    """of a success, mean over the sought joints of a body"""


class Calibration(Section):
    """Range bias and clock offset from one object whose place is known, before the fit.

    With `method = "fit"` by a reconstruction of these two numbers, all else as in the main fit;
    with `"backprojection"` by what focuses the object best.
    """

    object: str
    """name of the known object"""
    method: Literal["fit", "backprojection"] = "fit"
    """a fit of the two numbers, or what focuses the object best"""
    steps: Count | None = None
    """without it those of the main fit"""
    rate: Positive | None = None
    """without it that of the main fit"""


class Landscape(Section):
    """Losses along a line through the truth: exact signal beside surrogate."""

    object: str
    """name in the scene"""
    axis: Vector
    """direction of the line"""
    span: Positive = 0.4
    """m on either side, surrogate"""
    points: Annotated[int, Field(ge=3)] = 41
    """on the line"""
    exact_span: Positive = 0.01
    """m on either side, exact signal"""
    exact_points: Annotated[int, Field(ge=3)] = 201
    """on the line"""


class GradientParameter(Section):
    """The scalar θ of a gradient check; θ = 0 is the scene as written."""

    kind: Literal[
        "translation",
        "rotation",
        "scale",
        "material",
        "radar_translation",
        "radar_rotation",
        "joint",
        "latent",
        "distance",
        "density",
    ]
    """joint = turns one of a body; latent = a coordinate of a vehicle or prior; distance = moves \
the surface of a signed distance outwards, density = thickens a cloud in the object's place, both \
in a round bump"""
    object: str | None = None
    """name in the scene; none for the radar's"""
    axis: Vector | None = None
    """direction, or axis of the turn"""
    value: MaterialValue | None = None
    """for kind material"""
    joint: str | None = None
    """name, for kind joint"""
    index: Annotated[int, Field(ge=0)] | None = None
    """from 0, for kind latent"""
    center: Vector | None = None
    """of the bump, in the object's frame [m]"""
    width: Positive | None = None
    """standard deviation of the bump [m]"""
    low: Vector | None = None
    """corner of the nodes of distance or density, in the object's frame [m]"""
    high: Vector | None = None
    """the opposite corner [m]"""
    counts: Counts | None = None
    """nodes along x, y and z"""
    extinction: Positive | None = None
    """of the cloud [1/m], for kind density"""

    @model_validator(mode="after")
    def _complete(self) -> "GradientParameter":
        grid = self.kind in ("distance", "density")
        wanted = {
            "object": not self.kind.startswith("radar"),
            "axis": self.kind.endswith(("translation", "rotation")) or self.kind == "joint",
            "value": self.kind == "material",
            "joint": self.kind == "joint",
            "index": self.kind == "latent",
            **dict.fromkeys(("center", "width", "low", "high", "counts"), grid),
            "extinction": self.kind == "density",
        }
        check_presence(self, wanted, f"with kind = {self.kind}")
        return self


class Gradcheck(Section):
    """Derivative of the map against central differences."""

    parameter: GradientParameter
    """the scalar θ"""
    step: Positive | None = None
    """of the differences: m, relative for scale and density, standard deviations for latent"""
    step_deg: Positive | None = None
    """the same for rotations and joints"""
    noise: Positive = 0.007
    """‖standard error‖₁/‖g_FD‖₁ at which repeating stops"""
    max_pairs: Count = 64
    """of differences, at most"""
    depth: Depth = 3
    """most bounces of a path"""
    samples: Count = 4_000_000
    """rays of one derivative"""
    boundary_samples: Count = 1_000_000
    """silhouette samples of one derivative"""
    repeats: Count = 4
    """derivatives averaged"""
    difference_samples: Count = 8_000_000
    """samples of one end of a pair"""
    sampling: Literal["rays", "area"] = "rays"
    """of the differences"""

    @model_validator(mode="after")
    def _complete(self) -> "Gradcheck":
        turns = self.parameter.kind.endswith("rotation") or self.parameter.kind == "joint"
        wanted = {"step_deg": turns, "step": not turns}
        check_presence(self, wanted, f"with kind = {self.parameter.kind}")
        return self
