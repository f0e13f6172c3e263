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
from invertwin.scene.files import load_mesh, load_scene_xml, save_mesh
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
from invertwin.scene.parameters import (
    Compose,
    MaterialValues,
    Pose,
    RadarPose,
    Scale,
    Translation,
    Vertices,
)
from invertwin.scene.pose import (
    compose,
    look_at,
    quaternion_from_vector,
    rigid,
    rotation_angle,
    rotation_from_quaternion,
    rotation_from_vector,
    vector_from_quaternion,
)
from invertwin.scene.scene import Object, Scene
from invertwin.scene.shapes import box, dihedral, plate, sphere, text, trihedral

__all__ = [
    "AntennaArray",
    "Compose",
    "Cosine",
    "Isotropic",
    "Material",
    "MaterialValues",
    "Mesh",
    "Object",
    "Pattern",
    "PerfectConductor",
    "Pose",
    "RadarPose",
    "RoughDielectric",
    "Scale",
    "Scene",
    "Surface",
    "Table",
    "Translation",
    "Vertices",
    "box",
    "complex_permittivity",
    "compose",
    "dihedral",
    "fresnel_amplitude",
    "fresnel_reflectance",
    "linear_array",
    "load_mesh",
    "load_scene_xml",
    "look_at",
    "planar_array",
    "plate",
    "quaternion_from_vector",
    "rigid",
    "rotation_angle",
    "rotation_from_quaternion",
    "rotation_from_vector",
    "save_mesh",
    "sphere",
    "text",
    "trihedral",
    "vector_from_quaternion",
]
