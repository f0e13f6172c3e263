"""Scenes as plain torch values: meshes, materials, antennas, and what can be fitted in them."""

from invertwin.scene.antenna import (
    AntennaArray,
    Cosine,
    Isotropic,
    Pattern,
    Table,
    linear_array,
    planar_array,
)
from invertwin.scene.material import (
    Material,
    PerfectConductor,
    RoughDielectric,
    Surface,
    complex_permittivity,
    fresnel_amplitude,
    fresnel_reflectance,
)
from invertwin.scene.mesh import Mesh
from invertwin.scene.pose import (
    compose,
    quaternion_from_vector,
    rigid,
    rotation_angle,
    rotation_from_quaternion,
    rotation_from_vector,
)
from invertwin.scene.scene import Object, Scene
from invertwin.scene.shapes import box, dihedral, plate, sphere, text, trihedral

__all__ = [
    "AntennaArray",
    "Cosine",
    "Isotropic",
    "Material",
    "Mesh",
    "Object",
    "Pattern",
    "PerfectConductor",
    "RoughDielectric",
    "Scene",
    "Surface",
    "Table",
    "box",
    "complex_permittivity",
    "compose",
    "dihedral",
    "fresnel_amplitude",
    "fresnel_reflectance",
    "linear_array",
    "planar_array",
    "plate",
    "quaternion_from_vector",
    "rigid",
    "rotation_angle",
    "rotation_from_quaternion",
    "rotation_from_vector",
    "sphere",
    "text",
    "trihedral",
]
