"""The tables of what is sought: places, sizes, shapes, materials."""

from typing import Annotated, Literal

from pydantic import Field, Tag

from invertwin.cli.schema.mover import MoverParameter
from invertwin.cli.schema.section import (
    TAG_MARK,
    Count,
    InputPath,
    NonNegative,
    Positive,
    Section,
    Vector,
    WorldAxes,
    tag_by,
)

Counts = Annotated[list[Annotated[int, Field(ge=2)]], Field(min_length=3, max_length=3)]


class Named(Section):
    """What every parameter may have."""

    name: str | None = None
    """by which stages and variants call it; without it its kind"""
    rate: Positive | None = None
    """of its own; without it the optimizer's"""


class ObjectParameter(Named):
    object: str
    """name in the scene"""


class TranslationParameter(ObjectParameter):
    """Moves an object along the given world axes."""

    kind: Literal["translation"]
    axes: WorldAxes = ["x", "y", "z"]
    """of the world"""


class PoseParameter(ObjectParameter):
    """Moves an object and turns it about its centre, along and about the given world axes."""

    kind: Literal["pose"]
    axes: WorldAxes = ["x", "y", "z"]
    """of the world"""
    rotation_axes: WorldAxes = ["x", "y", "z"]
    """of the world"""


class ScaleParameter(ObjectParameter):
    kind: Literal["scale"]


class VerticesParameter(ObjectParameter):
    """Free vertices, held together by a Laplacian term, or moved in smooth steps."""

    kind: Literal["vertices"]
    laplacian: NonNegative = 0.0
    """weight of the term; 0 = none"""
    smooth: NonNegative = 0.0
    """λ of steps preconditioned by (I + λL)⁻²; 0 = none"""


class _BoxParameter(ObjectParameter):
    low: Vector
    """corner of the box, in the object's frame [m]"""
    high: Vector
    """the opposite corner [m]"""
    counts: Counts
    """nodes along x, y and z"""


class LatticeParameter(_BoxParameter):
    """Smooth deformation by the control points of a lattice."""

    kind: Literal["lattice"]


class DistanceGridParameter(_BoxParameter):
    """A signed distance on a grid, whose zero is the surface; starts as the object's mesh."""

    kind: Literal["distance_grid"]
    smooth: NonNegative = 0.0
    """λ of steps preconditioned by (I + λL)⁻²; 0 = none"""


class NeuralDistanceParameter(_BoxParameter):
    """A signed distance as a network of sines, whose zero is the surface; starts as a ball."""

    kind: Literal["neural_distance"]
    radius: Positive
    """m, of the ball"""
    width: Count = 32
    """sines of a layer"""
    depth: Count = 2
    """layers of sines"""
    frequency: Positive = 8.0
    """of the first layer, radians over the box's half diagonal"""


class DensityParameter(_BoxParameter):
    """A cloud of soft scatterers; starts as the echoes of [initial] for its object, else faint and
    even. Rates of about 0.1 suit it; measures and pictures show the surface of its usual level."""

    kind: Literal["density"]


class ShapeSpaceParameter(ObjectParameter):
    """Coordinates of the public space of vehicles, from those of its object, else the mean."""

    kind: Literal["shape_space"]
    folder: InputPath = Field("vehicle_prior", validate_default=True)
    """path, from the run file's folder, then from INVERTWIN_DATA"""
    level: Literal["coarse", "fine"] = "fine"
    """of detail"""
    modes: Count = 10
    """coordinates that are sought"""
    weight: NonNegative = 0.0
    """of ½ Σ z²"""


class BodyParameter(ObjectParameter):
    """Joint angles of an object with shape = "body", from those it has."""

    kind: Literal["body"]
    joints: Annotated[dict[str, WorldAxes], Field(min_length=1)]
    """by name: the components of the rotation vector that are sought, such as ["y"]"""


MaterialValue = Literal[
    "permittivity",
    "conductivity",
    "loss_tangent",
    "thickness",
    "diffuse",
    "lobe_width",
    "scattering",
    "rms_slope",
    "lambertian",
    "directive",
    "directive_exponent",
    "backscatter_exponent",
]


class PriorParameter(ObjectParameter):
    """Coordinates of the learned prior of vehicles, from those of its object, else the mean car."""

    kind: Literal["prior"]
    weight: NonNegative = 0.0
    """of ½ Σ z²"""
    file: InputPath | None = None
    """that `invertwin train-prior` wrote; without it the prior of the package"""
    counts: Counts | None = None
    """nodes along x, y and z at which it is meshed; without it every 0.1 m or so"""


class MaterialParameter(ObjectParameter):
    """Material values that are sought, from the values of the scene table."""

    kind: Literal["material"]
    values: Annotated[list[MaterialValue], Field(min_length=1)]
    """which are sought"""
    layer: Annotated[int, Field(ge=0)] | None = None
    """of a multilayer, from 0: the layer whose values they are"""


class RadarParameter(Named):
    kind: Literal["radar_pose"]


Parameter = Annotated[
    Annotated[TranslationParameter, Tag(TAG_MARK + "translation")]
    | Annotated[PoseParameter, Tag(TAG_MARK + "pose")]
    | Annotated[ScaleParameter, Tag(TAG_MARK + "scale")]
    | Annotated[VerticesParameter, Tag(TAG_MARK + "vertices")]
    | Annotated[LatticeParameter, Tag(TAG_MARK + "lattice")]
    | Annotated[DistanceGridParameter, Tag(TAG_MARK + "distance_grid")]
    | Annotated[NeuralDistanceParameter, Tag(TAG_MARK + "neural_distance")]
    | Annotated[DensityParameter, Tag(TAG_MARK + "density")]
    | Annotated[PriorParameter, Tag(TAG_MARK + "prior")]
    | Annotated[ShapeSpaceParameter, Tag(TAG_MARK + "shape_space")]
    | Annotated[BodyParameter, Tag(TAG_MARK + "body")]
    | Annotated[MaterialParameter, Tag(TAG_MARK + "material")]
    | Annotated[RadarParameter, Tag(TAG_MARK + "radar_pose")]
    | Annotated[MoverParameter, Tag(TAG_MARK + "mover")],
    tag_by("kind"),
]
