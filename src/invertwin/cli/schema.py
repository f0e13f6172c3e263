"""The one schema of TOML run files: SI units, names as in the library, angles in `_deg` keys.

Nothing here imports torch or Mitsuba: a wrong key is reported before anything heavy loads.
"""

import os
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    model_validator,
)
from pydantic_core import PydanticCustomError

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(ge=1)]
Seed = Annotated[int, Field(ge=0, lt=2**31)]
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]


# Beside the checkout; for an installed package this is a folder that does not exist.
_DATA_BESIDE_CHECKOUT = Path(__file__).resolve().parents[4] / "shared" / "data"


def _beside_run_file(name: str, info: Any) -> str:
    """Relative paths start at the run file's folder, then at the data folder."""
    folders = [
        (info.context or {}).get("folder", Path()),
        os.environ.get("INVERTWIN_DATA", _DATA_BESIDE_CHECKOUT),
    ]
    paths = [Path(folder, name).absolute() for folder in folders]
    return str(next((path for path in paths if path.exists()), paths[0]))


InputPath = Annotated[str, Field(min_length=1), AfterValidator(_beside_run_file)]
Interval = Annotated[list[NonNegative], Field(min_length=2, max_length=2)]


# Pydantic puts the tag of a union into an error's location; the mark tells it from a key.
TAG_MARK = "→"


def _tag_by(*keys: str) -> Discriminator:
    """A union's member by the first of `keys` that is present: its value if it is `kind` or
    `shape`, else the key itself."""

    def tag(value: Any) -> str | None:
        if isinstance(value, list):
            return TAG_MARK + "points"
        for key in keys:
            found = value.get(key) if isinstance(value, dict) else getattr(value, key, None)
            if found is not None:
                return TAG_MARK + (str(found) if key in ("kind", "shape") else key)
        return None

    tag.__name__ = ",".join(keys)  # pydantic quotes it in its errors, and run_file reads it
    return Discriminator(tag)


WorldAxes = Annotated[list[Literal["x", "y", "z"]], Field(min_length=1)]


class Section(BaseModel):
    """A table of the run file; keys it does not know are errors that name the nearest match."""

    model_config = ConfigDict(
        extra="forbid", strict=True, frozen=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

    @model_validator(mode="before")
    @classmethod
    def _known_keys_only(cls, data: Any) -> Any:
        # Pydantic's own error for an extra key does not carry the keys that are allowed.
        if isinstance(data, dict):
            for key in data:
                if key not in cls.model_fields:
                    raise PydanticCustomError(
                        "unknown_key",
                        "unknown key",
                        {"key": key, "allowed": list(cls.model_fields)},
                    )
        return data


# ---------------------------------------------------------------------------------- materials


class RoughDielectric(Section):
    """A rough surface of a dielectric."""

    kind: Literal["rough_dielectric"]
    permittivity: Annotated[float, Field(ge=1)]
    """relative, real part"""
    conductivity: NonNegative = 0.0
    """S/m"""
    diffuse: Annotated[float, Field(ge=0, le=1)] = 1.0
    """share of the reflected power that is scattered evenly"""
    lobe_width_deg: Positive | None = None
    """full width at half power of the rest"""


class PerfectConductor(Section):
    """A smooth perfect conductor."""

    kind: Literal["perfect_conductor"]
    lobe_width_deg: Positive | None = None
    """full width at half power of the mirror lobe"""


Material = Annotated[
    Annotated[RoughDielectric, Tag(TAG_MARK + "rough_dielectric")]
    | Annotated[PerfectConductor, Tag(TAG_MARK + "perfect_conductor")],
    _tag_by("kind"),
]


# -------------------------------------------------------------------------------------- scene


class Placement(Section):
    """Where a shape stands: scaled, then rotated about its own origin, then moved."""

    position: Vector = [0.0, 0.0, 0.0]
    """m"""
    rotation_deg: Vector = [0.0, 0.0, 0.0]
    """rotation vector"""
    scale: Positive = 1.0
    """factor"""


class Plate(Placement):
    shape: Literal["plate"]
    width: Positive
    """m, along x"""
    height: Positive
    """m, along y"""
    divisions: Count = 1
    """cells along each side"""


class Box(Placement):
    shape: Literal["box"]
    size: Annotated[list[Positive], Field(min_length=3, max_length=3)]
    """m, along x, y, z"""
    divisions: Count = 1
    """cells along each side"""


class Sphere(Placement):
    shape: Literal["sphere"]
    radius: Positive
    """m"""
    subdivisions: Annotated[int, Field(ge=0, le=8)] = 4
    """each one divides every triangle in four"""


class Dihedral(Placement):
    shape: Literal["dihedral"]
    edge: Positive
    """m; two squares, open to −z"""


class Trihedral(Placement):
    shape: Literal["trihedral"]
    edge: Positive
    """m; three triangles, open to −z"""


class Text(Placement):
    shape: Literal["text"]
    text: Annotated[str, Field(min_length=1)]
    """letters"""
    size: Positive = 0.6
    """m, height of the text"""
    depth: Positive = 0.12
    """m"""
    max_edge: Positive = 0.06
    """m, longest edge of the mesh"""


class File(Placement):
    """A mesh file: OBJ, PLY, STL or glTF."""

    file: InputPath
    """path, from the run file's folder"""


Part = Annotated[
    Annotated[Plate, Tag(TAG_MARK + "plate")]
    | Annotated[Box, Tag(TAG_MARK + "box")]
    | Annotated[Sphere, Tag(TAG_MARK + "sphere")]
    | Annotated[Dihedral, Tag(TAG_MARK + "dihedral")]
    | Annotated[Trihedral, Tag(TAG_MARK + "trihedral")]
    | Annotated[Text, Tag(TAG_MARK + "text")]
    | Annotated[File, Tag(TAG_MARK + "file")],
    _tag_by("shape", "parts", "file"),
]


class Parts(Placement):
    """Several shapes as one rigid object of one material."""

    parts: Annotated[list[Part], Field(min_length=1)]
    """shapes, each placed within the object"""


class Body(Section):
    """What makes a shape an object of the scene."""

    material: Material
    """what it is made of"""
    velocity: Vector | None = None
    """m/s"""


class PlateObject(Plate, Body):
    pass


class BoxObject(Box, Body):
    pass


class SphereObject(Sphere, Body):
    pass


class DihedralObject(Dihedral, Body):
    pass


class TrihedralObject(Trihedral, Body):
    pass


class TextObject(Text, Body):
    pass


class FileObject(File, Body):
    pass


class PartsObject(Parts, Body):
    pass


SceneObject = Annotated[
    Annotated[PlateObject, Tag(TAG_MARK + "plate")]
    | Annotated[BoxObject, Tag(TAG_MARK + "box")]
    | Annotated[SphereObject, Tag(TAG_MARK + "sphere")]
    | Annotated[DihedralObject, Tag(TAG_MARK + "dihedral")]
    | Annotated[TrihedralObject, Tag(TAG_MARK + "trihedral")]
    | Annotated[TextObject, Tag(TAG_MARK + "text")]
    | Annotated[FileObject, Tag(TAG_MARK + "file")]
    | Annotated[PartsObject, Tag(TAG_MARK + "parts")],
    _tag_by("shape", "parts", "file"),
]


class SceneFile(Section):
    """Objects from the geometry of a Mitsuba or Sionna scene file (XML), named as in the file."""

    file: InputPath
    """path, from the run file's folder"""
    materials: dict[str, Material] = {}
    """by the file's material ids"""
    material: Material | None = None
    """of all other objects; without it concrete"""


class Truth(Section):
    """Where an object really is: replaces the placement of its scene table, key by key."""

    position: Vector | None = None
    """m"""
    rotation_deg: Vector | None = None
    """rotation vector"""
    scale: Positive | None = None
    """factor"""


# -------------------------------------------------------------------------------------- radar


class Fmcw(Section):
    kind: Literal["fmcw"]
    start_frequency: Positive
    """Hz"""
    bandwidth: Positive
    """Hz"""
    duration: Positive
    """s, of one ramp"""
    samples: Count
    """of one ramp"""


class Impulse(Section):
    kind: Literal["impulse"]
    center_frequency: Positive
    """Hz"""
    bandwidth: Positive
    """Hz"""


Waveform = Annotated[
    Annotated[Fmcw, Tag(TAG_MARK + "fmcw")] | Annotated[Impulse, Tag(TAG_MARK + "impulse")],
    _tag_by("kind"),
]


class Isotropic(Section):
    kind: Literal["isotropic"]


class Cosine(Section):
    """Power pattern cosⁿ of the angle from boresight."""

    kind: Literal["cosine"]
    exponent: NonNegative
    """n"""


class TablePattern(Section):
    """A measured power pattern: one row per theta, from 0 at boresight, one column per phi."""

    kind: Literal["table"]
    theta_deg: Annotated[list[float], Field(min_length=2)]
    """from 0 at boresight"""
    phi_deg: Annotated[list[float], Field(min_length=1)] = [0.0]
    """one: symmetric about boresight"""
    gain_db: list[list[float]]
    """one row per theta, one column per phi"""

    @model_validator(mode="after")
    def _rectangular(self) -> "TablePattern":
        rows, columns = len(self.theta_deg), len(self.phi_deg)
        if len(self.gain_db) != rows or any(len(row) != columns for row in self.gain_db):
            lengths = sorted({len(row) for row in self.gain_db})
            _fail(
                f"expected gain_db with {rows} rows of {columns}, got {len(self.gain_db)} rows of "
                f"{' or '.join(map(str, lengths))}; give one row per theta and one column per phi"
            )
        return self


Pattern = Annotated[
    Annotated[Isotropic, Tag(TAG_MARK + "isotropic")]
    | Annotated[Cosine, Tag(TAG_MARK + "cosine")]
    | Annotated[TablePattern, Tag(TAG_MARK + "table")],
    _tag_by("kind"),
]


class ArraySection(Section):
    """Antenna elements in the radar frame (x right, y up, z boresight)."""

    center: Vector = [0.0, 0.0, 0.0]
    """m, in the radar frame"""
    pattern: Pattern = Isotropic(kind="isotropic")
    """of every element"""


class PlanarArray(ArraySection):
    kind: Literal["planar"]
    count: Annotated[list[Count], Field(min_length=2, max_length=2)]
    """elements along x, y"""
    spacing: Annotated[list[Positive], Field(min_length=2, max_length=2)]
    """m, along x, y"""


class LinearArray(ArraySection):
    kind: Literal["linear"]
    count: Count
    """elements"""
    spacing: Positive
    """m"""
    axis: Literal["x", "y"] = "x"
    """of the radar frame"""


class PositionArray(ArraySection):
    kind: Literal["positions"]
    positions: Annotated[list[Vector], Field(min_length=1)]
    """m, in the radar frame"""


Array = Annotated[
    Annotated[PlanarArray, Tag(TAG_MARK + "planar")]
    | Annotated[LinearArray, Tag(TAG_MARK + "linear")]
    | Annotated[PositionArray, Tag(TAG_MARK + "positions")],
    _tag_by("kind"),
]


class LineTrack(Section):
    kind: Literal["line"]
    start: Vector
    """m"""
    stop: Vector
    """m"""
    count: Count
    """positions"""


class ArcTrack(Section):
    """A level arc about `center`; 0° is on its −z side, 90° on its +x side."""

    kind: Literal["arc"]
    center: Vector
    """m"""
    radius: Positive
    """m"""
    start_deg: float
    """0 is on the −z side of the centre"""
    stop_deg: float
    """90 is on its +x side"""
    count: Count
    """positions"""


class GridTrack(Section):
    """An upright rectangle of positions in the x-y plane through `center`."""

    kind: Literal["grid"]
    center: Vector
    """m"""
    size: Annotated[list[NonNegative], Field(min_length=2, max_length=2)]
    """m along x, y"""
    count: Annotated[list[Count], Field(min_length=2, max_length=2)]
    """positions along x, y"""


Track = Annotated[
    Annotated[Annotated[list[Vector], Field(min_length=1)], Tag(TAG_MARK + "points")]
    | Annotated[LineTrack, Tag(TAG_MARK + "line")]
    | Annotated[ArcTrack, Tag(TAG_MARK + "arc")]
    | Annotated[GridTrack, Tag(TAG_MARK + "grid")],
    _tag_by("kind"),
]


class LookAt(Section):
    look_at: Vector
    """m, the point that boresight is turned to"""


class Turned(Section):
    rotation_deg: Vector
    """rotation vector, the same at every position"""


Orientation = Annotated[
    Annotated[LookAt, Tag(TAG_MARK + "look_at")]
    | Annotated[Turned, Tag(TAG_MARK + "rotation_deg")],
    _tag_by("look_at", "rotation_deg"),
]

Window = Literal["hamming", "hann", "blackman", "rectangular"]


class Radar(Section):
    """Arrays, waveform and poses; one frame per position."""

    waveform: Waveform
    """what is sent"""
    transmitters: Array
    """antenna elements"""
    receivers: Array
    """antenna elements"""
    window: Window = "hamming"
    """over the samples of a ramp"""
    array_window: Window = "hamming"
    """over the elements"""
    positions: Track = [[0.0, 0.0, 0.0]]
    """m, one frame each: a list of points or a track"""
    orientation: Orientation = Turned(rotation_deg=[0.0, 0.0, 0.0])
    """look_at or rotation_deg"""
    shared_visibility: bool | None = None
    """what the transmitter sees, the receiver sees; default: when both are within 0.1 m"""


class Grid(Section):
    """The map that is compared: metres of range, direction cosines."""

    range_min: NonNegative
    """m"""
    range_max: Positive
    """m"""
    u_max: Annotated[float, Field(gt=0, le=1)] = 1.0
    """direction cosine to the right"""
    v_max: Annotated[float, Field(gt=0, le=1)] = 1.0
    """direction cosine up"""
    oversample: Positive = 2.0
    """bins per resolution cell"""


# --------------------------------------------------------------------------------------- data


class SimulatedData(Section):
    """Exact signals of the true scene, with noise."""

    kind: Literal["simulated"]
    density: Positive
    """rough points per m²"""
    samples: Count = 200_000
    """coherent paths"""
    snr_db: float | None = None
    """signal to noise per sample; without it no noise"""
    noise_figure_db: float | None = None
    """thermal noise of a receiver instead of snr_db"""
    seed: Seed | None = None
    """without it the run's"""

    @model_validator(mode="after")
    def _one_noise_level(self) -> "SimulatedData":
        if self.snr_db is not None and self.noise_figure_db is not None:
            _fail("expected snr_db or noise_figure_db, got both; remove one")
        return self


class CaptureData(Section):
    """A capture saved by the library (NetCDF)."""

    kind: Literal["capture"]
    file: InputPath
    """path, from the run file's folder"""


class RailSarData(Section):
    """The public recording of an ultra-wideband radar on a rail."""

    kind: Literal["rail_sar"]
    folder: InputPath
    """path, from the run file's folder, then from INVERTWIN_DATA"""


Data = Annotated[
    Annotated[SimulatedData, Tag(TAG_MARK + "simulated")]
    | Annotated[CaptureData, Tag(TAG_MARK + "capture")]
    | Annotated[RailSarData, Tag(TAG_MARK + "rail_sar")],
    _tag_by("kind"),
]


# ---------------------------------------------------------------------------------- inversion


class TranslationParameter(Section):
    """Moves an object along the given world axes."""

    kind: Literal["translation"]
    object: str
    """name in the scene"""
    axes: WorldAxes = ["x", "y", "z"]
    """of the world"""


class PoseParameter(Section):
    """Moves an object and turns it about its centre, along and about the given world axes."""

    kind: Literal["pose"]
    object: str
    """name in the scene"""
    axes: WorldAxes = ["x", "y", "z"]
    """of the world"""
    rotation_axes: WorldAxes = ["x", "y", "z"]
    """of the world"""


class ScaleParameter(Section):
    kind: Literal["scale"]
    object: str
    """name in the scene"""


class VerticesParameter(Section):
    """Free vertices, held together by a Laplacian term of this weight."""

    kind: Literal["vertices"]
    object: str
    """name in the scene"""
    laplacian: NonNegative = 0.0
    """weight; 0 = free"""


class MaterialParameter(Section):
    """Material values that are sought, from the values of the scene table."""

    kind: Literal["material"]
    object: str
    """name in the scene"""
    values: Annotated[list[Literal["permittivity", "conductivity", "diffuse"]], Field(min_length=1)]
    """which are sought"""


class RadarParameter(Section):
    kind: Literal["radar_pose"]


Parameter = Annotated[
    Annotated[TranslationParameter, Tag(TAG_MARK + "translation")]
    | Annotated[PoseParameter, Tag(TAG_MARK + "pose")]
    | Annotated[ScaleParameter, Tag(TAG_MARK + "scale")]
    | Annotated[VerticesParameter, Tag(TAG_MARK + "vertices")]
    | Annotated[MaterialParameter, Tag(TAG_MARK + "material")]
    | Annotated[RadarParameter, Tag(TAG_MARK + "radar_pose")],
    _tag_by("kind"),
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
    seed: Seed | None = None
    """without it the run's"""


class Surrogate(Section):
    """Kernels of the smooth model; the extra widths anneal to zero, in cells."""

    range_kernel: Literal["response", "gaussian"] = "response"
    """response = that of waveform and window"""
    angle_kernel: Literal["response", "airy"] = "response"
    """response = that of arrays and window"""
    range_width: NonNegative = 0.0
    """extra blur at the first step, in range cells; falls to 0"""
    angle_width: NonNegative = 0.0
    """extra blur at the first step, in beamwidths; falls to 0"""


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
            _fail(
                f'expected background = "none" with kind = "likelihood", got "{self.background}"; '
                "the floor stands for a background"
            )
        if self.kind == "mse" and self.floor is not None:
            _fail('expected no `floor` with kind = "mse", got one; remove it')
        return self


class Optimizer(Section):
    kind: Literal["adam", "sgd"] = "adam"
    """how a gradient becomes a step"""
    rate: Positive = 0.03
    """m, and rad without rotation_rate"""
    rotation_rate: Positive | None = None
    """rad"""
    final_rate: NonNegative | None = None
    """on the last step; without it rate / 20"""
    momentum: Annotated[float, Field(ge=0, lt=1)] = 0.9
    """of sgd"""


class Reconstruct(Section):
    steps: Count
    """budget"""
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
        "translation", "rotation", "scale", "material", "radar_translation", "radar_rotation"
    ]
    object: str | None = None
    """name in the scene; none for the radar's"""
    axis: Vector | None = None
    """direction, or axis of the turn"""
    value: Literal["permittivity", "conductivity", "diffuse"] | None = None
    """for kind material"""

    @model_validator(mode="after")
    def _complete(self) -> "GradientParameter":
        wanted = {
            "object": not self.kind.startswith("radar"),
            "axis": self.kind.endswith(("translation", "rotation")),
            "value": self.kind == "material",
        }
        _check_presence(self, wanted, f"with kind = {self.kind}")
        return self


class Gradcheck(Section):
    """Derivative of the map against central differences."""

    parameter: GradientParameter
    """the scalar θ"""
    step: Positive | None = None
    """of the differences: m, or relative for scale"""
    step_deg: Positive | None = None
    """the same for rotations"""
    noise: Positive = 0.007
    """‖standard error‖₁/‖g_FD‖₁ at which repeating stops"""
    max_pairs: Count = 64
    """of differences, at most"""
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
        turns = self.parameter.kind.endswith("rotation")
        wanted = {"step_deg": turns, "step": not turns}
        _check_presence(self, wanted, f"with kind = {self.parameter.kind}")
        return self


def _check_presence(section: Section, wanted: dict[str, bool], when: str) -> None:
    """Keys that one kind needs and the others must not have."""
    for key, needed in wanted.items():
        if needed != (getattr(section, key) is not None):
            verb, do = ("", "add it") if needed else ("no ", "remove it")
            _fail(f"expected {verb}`{key}` {when}; {do}")


def _fail(text: str, path: str = "") -> NoReturn:
    """An error of a whole section, or of the key `path` of the run file."""
    raise PydanticCustomError("section", "{text}", {"text": text, "path": path})


# ----------------------------------------------------------------------------------- run file


class RunFile(Section):
    """A whole run file; which sections a command needs is checked by the command."""

    task: Literal["simulate", "reconstruct", "gradcheck", "demo"]
    """what the file is for"""
    title: str = ""
    """heading of the report"""
    note: str = ""
    """shown in the report"""
    seed: Seed = 0
    """of everything random"""
    scene: dict[str, SceneObject] = {}
    """[scene.<name>]: an object each"""
    scene_file: SceneFile | None = None
    """objects from a file"""
    truth: dict[str, Truth] = {}
    """[truth.<name>]: where an object really is"""
    radar: Radar | None = None
    """what measures; not with a capture"""
    grid: Grid | None = None
    """the map that is compared"""
    data: Data | None = None
    """what is fitted"""
    parameters: list[Parameter] = []
    """[[parameters]]: what is sought"""
    starts: Starts | None = None
    """where fits start; without it where the scene says"""
    surrogate: Surrogate = Surrogate()
    """kernels of the smooth model"""
    loss: Loss = Loss()
    """how maps are compared"""
    optimizer: Optimizer = Optimizer()
    """how a gradient becomes a step"""
    reconstruct: Reconstruct | None = None
    """the fit"""
    calibration: Calibration | None = None
    """before the fit"""
    landscape: Landscape | None = None
    """losses along a line"""
    gradcheck: Gradcheck | None = None
    """the gradient check"""

    @model_validator(mode="after")
    def _names_exist(self) -> "RunFile":
        if self.scene_file is None:
            if not self.scene:
                _fail("expected at least 1 object, got none; add [scene.<name>]", "scene")
            # The names of a scene file are known once it is read.
            for path, name in self.references():
                if name not in self.scene:
                    raise PydanticCustomError(
                        "unknown_object", "unknown object", {"path": path, "name": name}
                    )
        return self

    def references(self) -> list[tuple[str, str]]:
        """Where the run file names an object of the scene: path and name."""
        used = [(f"truth.{name}", name) for name in self.truth]
        for i, parameter in enumerate(self.parameters):
            if not isinstance(parameter, RadarParameter):
                used.append((f"parameters[{i}].object", parameter.object))
        for section in ("starts", "landscape", "calibration"):
            if getattr(self, section) is not None:
                used.append((f"{section}.object", getattr(self, section).object))
        if self.gradcheck is not None and self.gradcheck.parameter.object is not None:
            used.append(("gradcheck.parameter.object", self.gradcheck.parameter.object))
        return used
