"""The tables of the scene: materials, shapes, where they stand."""

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, model_validator

from invertwin.cli.schema.section import (
    TAG_MARK,
    Count,
    InputPath,
    NonNegative,
    Positive,
    Section,
    Vector,
    fail,
    tag_by,
)


class TextureFile(Section):
    """Values from an image, laid over the object as seen along its own z axis."""

    image: InputPath
    """NumPy file (.npy) of rows of pixels, top row first, read at the middle of each triangle"""


def _form(value: Any) -> str:
    """Which form a material value has in the run file."""
    form = "list" if isinstance(value, list) else "table"
    return TAG_MARK + (form if isinstance(value, list | dict | TextureFile) else "number")


_FORM = Discriminator(_form)
_Above1 = Annotated[float, Field(ge=1)]
_Share = Annotated[float, Field(ge=0, le=1)]
_Slope = Annotated[float, Field(gt=0, le=1)]


def _listed(number: Any) -> Any:
    """One number, a list of one number per triangle, or a texture."""
    return Annotated[
        Annotated[number, Tag(TAG_MARK + "number")]
        | Annotated[list[number], Field(min_length=1), Tag(TAG_MARK + "list")]
        | Annotated[TextureFile, Tag(TAG_MARK + "table")],
        _FORM,
    ]


if TYPE_CHECKING:
    Permittivity = ZeroOrMore = AboveZero = Share = Slope = float | list[float] | TextureFile
else:
    Permittivity, ZeroOrMore, AboveZero, Share, Slope = map(
        _listed, (_Above1, NonNegative, Positive, _Share, _Slope)
    )


class Medium(Section):
    """A dielectric, by numbers or from the ITU table."""

    itu: Annotated[str, Field(min_length=1)] | None = None
    """material of ITU-R P.2040, e.g. "concrete", at the radar's frequency"""
    permittivity: Permittivity | None = None
    """relative, real part; needed without `itu`"""
    conductivity: ZeroOrMore | None = None
    """S/m; 0 without `itu`"""
    loss_tangent: ZeroOrMore = 0.0
    """of other losses"""

    @model_validator(mode="after")
    def _known(self) -> "Medium":
        if self.itu is None and self.permittivity is None:
            fail("expected `permittivity`, or `itu` with a name of its table, got neither; add one")
        return self


class Roughness(Section):
    """Effective roughness of a surface."""

    scattering: Share = 0.0
    """coefficient S; the share S² of the reflected power is scattered"""
    rms_slope: Slope = 0.1
    """of the surface; makes the width of the lobe that holds the rest"""
    lambertian: Share = 1.0
    """share of the scattered power that goes in all directions alike"""
    directive: Share = 1.0
    """share of what is left that goes about the mirror direction, the rest goes back"""
    directive_exponent: ZeroOrMore = 4.0
    """of the lobe about the mirror direction"""
    backscatter_exponent: ZeroOrMore = 4.0
    """of the lobe back to the source"""


class RoughDielectric(Medium):
    """A rough surface of a dielectric, in two values."""

    kind: Literal["rough_dielectric"]
    diffuse: Share = 1.0
    """share of the reflected power that is scattered evenly"""
    lobe_width_deg: AboveZero | None = None
    """full width at half power of the rest"""


class PerfectConductor(Section):
    """A smooth perfect conductor."""

    kind: Literal["perfect_conductor"]
    lobe_width_deg: AboveZero | None = None
    """full width at half power of the mirror lobe"""


class RoughConductor(Roughness):
    """A perfect conductor with a rough surface."""

    kind: Literal["rough_conductor"]


class Dielectric(Medium, Roughness):
    """A half space: what enters it does not come back."""

    kind: Literal["dielectric"]


class RefractingBody(Medium, Roughness):
    """A solid body with a closed mesh, which rays enter and leave by Snell's law."""

    kind: Literal["refracting_body"]


class Layer(Medium):
    """One layer of a sheet."""

    thickness: ZeroOrMore
    """m"""


class Slab(Layer, Roughness):
    """A thin sheet in air, meshed as an open surface: it reflects and lets through."""

    kind: Literal["slab"]


class Multilayer(Roughness):
    """A thin sheet of several layers, meshed as an open surface."""

    kind: Literal["multilayer"]
    layers: Annotated[list[Layer], Field(min_length=1)]
    """from the first face to the last"""


Material = Annotated[
    Annotated[RoughDielectric, Tag(TAG_MARK + "rough_dielectric")]
    | Annotated[PerfectConductor, Tag(TAG_MARK + "perfect_conductor")]
    | Annotated[RoughConductor, Tag(TAG_MARK + "rough_conductor")]
    | Annotated[Dielectric, Tag(TAG_MARK + "dielectric")]
    | Annotated[RefractingBody, Tag(TAG_MARK + "refracting_body")]
    | Annotated[Slab, Tag(TAG_MARK + "slab")]
    | Annotated[Multilayer, Tag(TAG_MARK + "multilayer")],
    tag_by("kind"),
]


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


class Vehicle(Placement):
    """The body of a car of the public learned space: x ahead, y to the left, z up."""

    shape: Literal["vehicle"]
    folder: InputPath = Field("vehicle_prior", validate_default=True)
    """path, from the run file's folder, then from INVERTWIN_DATA"""
    level: Literal["coarse", "fine"] = "fine"
    """of detail"""
    coefficients: list[float] = []
    """of the first modes, in standard deviations; the others are 0"""
    max_edge: Positive | None = None
    """m, longest edge of the mesh; without it as in the file"""


class Learned(Placement):
    """A car of the learned prior: x ahead, y to the left, z up, on the ground z = 0."""

    shape: Literal["prior"]
    latent: list[float] | None = None
    """coordinates; without them the mean car"""
    prior: InputPath | None = None
    """file that `invertwin train-prior` wrote; without it the prior of the package"""


class BodyShape(Placement):
    """A body with joints and one skin, y up, facing −z, in the frame of its model."""

    shape: Literal["body"]
    model: Literal["person", "anny"] = "person"
    """person = made of formulas, arms held out at rest; anny = of the optional extra `anny`"""
    file: InputPath | None = None
    """SMPL's layout (.npz), from the run file's folder; in place of a model"""
    height: Positive = 1.75
    """m, of `person`"""
    spacing: Positive = 0.03
    """m, of the corners of its triangles"""
    angles_deg: dict[str, Vector] = {}
    """rotation vectors of joints by name, each in the frame of the joint before; others at rest"""


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
    | Annotated[Vehicle, Tag(TAG_MARK + "vehicle")]
    | Annotated[Learned, Tag(TAG_MARK + "prior")]
    | Annotated[BodyShape, Tag(TAG_MARK + "body")]
    | Annotated[File, Tag(TAG_MARK + "file")],
    tag_by("shape", "parts", "file"),
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


class VehicleObject(Vehicle, Body):
    pass


class LearnedObject(Learned, Body):
    pass


class BodyObject(BodyShape, Body):
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
    | Annotated[VehicleObject, Tag(TAG_MARK + "vehicle")]
    | Annotated[LearnedObject, Tag(TAG_MARK + "prior")]
    | Annotated[BodyObject, Tag(TAG_MARK + "body")]
    | Annotated[FileObject, Tag(TAG_MARK + "file")]
    | Annotated[PartsObject, Tag(TAG_MARK + "parts")],
    tag_by("shape", "parts", "file"),
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
    """What an object really is: replaces values of its scene table, key by key."""

    position: Vector | None = None
    """m"""
    rotation_deg: Vector | None = None
    """rotation vector"""
    scale: Positive | None = None
    """factor"""
    material: Material | None = None
    """what it is really made of"""
    velocity: Vector | None = None
    """m/s"""
    angles_deg: dict[str, Vector] | None = None
    """of a body, all of its joints that are not at rest"""
    parts: Annotated[list[Part], Field(min_length=1)] | None = None
    """its real shape, in place of the scene's and in the same frame"""
