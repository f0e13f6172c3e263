"""The tables of the scene: materials, shapes, where they stand."""

from typing import Annotated, Literal

from pydantic import Field, Tag

from invertwin.cli.schema.section import (
    TAG_MARK,
    Count,
    InputPath,
    NonNegative,
    Positive,
    Section,
    Vector,
    tag_by,
)


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
    """Where an object really is: replaces the placement of its scene table, key by key."""

    position: Vector | None = None
    """m"""
    rotation_deg: Vector | None = None
    """rotation vector"""
    scale: Positive | None = None
    """factor"""
