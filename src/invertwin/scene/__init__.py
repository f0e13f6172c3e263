"""Scenes as torch values: meshes, materials, antennas, and fitted parameters."""

from invertwin.deprecation import rename_attributes, rename_members
from invertwin.scene.antenna import AntennaArray as AntennaArray
from invertwin.scene.antenna import Cosine as Cosine
from invertwin.scene.antenna import Isotropic as Isotropic
from invertwin.scene.antenna import Pattern as Pattern
from invertwin.scene.antenna import TabulatedPattern as TabulatedPattern
from invertwin.scene.antenna import linear_array as linear_array
from invertwin.scene.antenna import planar_array as planar_array
from invertwin.scene.cloud import Cloud as Cloud
from invertwin.scene.files import load_mesh as load_mesh
from invertwin.scene.files import load_parts as load_parts
from invertwin.scene.files import load_scene_xml as load_scene_xml
from invertwin.scene.files import save_mesh as save_mesh
from invertwin.scene.files import save_scene_xml as save_scene_xml
from invertwin.scene.material.fresnel import FieldCoefficients as FieldCoefficients
from invertwin.scene.material.fresnel import complex_permittivity as complex_permittivity
from invertwin.scene.material.fresnel import fresnel_amplitude as fresnel_amplitude
from invertwin.scene.material.fresnel import fresnel_coefficients as fresnel_coefficients
from invertwin.scene.material.fresnel import fresnel_reflectance as fresnel_reflectance
from invertwin.scene.material.fresnel import fresnel_transmittance as fresnel_transmittance
from invertwin.scene.material.itu import ITU_MATERIALS as ITU_MATERIALS
from invertwin.scene.material.itu import Itu as Itu
from invertwin.scene.material.itu import OutsideTableWarning as OutsideTableWarning
from invertwin.scene.material.materials import Dielectric as Dielectric
from invertwin.scene.material.materials import Layer as Layer
from invertwin.scene.material.materials import Multilayer as Multilayer
from invertwin.scene.material.materials import PerfectConductor as PerfectConductor
from invertwin.scene.material.materials import RefractingBody as RefractingBody
from invertwin.scene.material.materials import RoughConductor as RoughConductor
from invertwin.scene.material.materials import RoughDielectric as RoughDielectric
from invertwin.scene.material.materials import Slab as Slab
from invertwin.scene.material.roughness import lobe_exponent as lobe_exponent
from invertwin.scene.material.roughness import lobe_integral as lobe_integral
from invertwin.scene.material.roughness import slope_exponent as slope_exponent
from invertwin.scene.material.slab import slab_coefficients as slab_coefficients
from invertwin.scene.material.surface import Material as Material
from invertwin.scene.material.surface import ScatteringLaw as ScatteringLaw
from invertwin.scene.material.values import Texture as Texture
from invertwin.scene.mesh import Mesh as Mesh
from invertwin.scene.mesh import MeshSummary as MeshSummary
from invertwin.scene.mesh_union import merge_meshes as merge_meshes
from invertwin.scene.parameters import Compose as Compose
from invertwin.scene.parameters import MaterialValues as MaterialValues
from invertwin.scene.parameters import Pose as Pose
from invertwin.scene.parameters import Scale as Scale
from invertwin.scene.parameters import Translation as Translation
from invertwin.scene.parameters import Vertices as Vertices
from invertwin.scene.people.body import BodyTemplate as BodyTemplate
from invertwin.scene.people.body import SkinnedBody as SkinnedBody
from invertwin.scene.people.body import articulated_template as articulated_template
from invertwin.scene.people.body import load_smpl as load_smpl
from invertwin.scene.people.body_models import load_anny as load_anny
from invertwin.scene.people.body_models import person as person
from invertwin.scene.people.gait import Walking as Walking
from invertwin.scene.people.gait import standing_height as standing_height
from invertwin.scene.people.gestures import Sitting as Sitting
from invertwin.scene.people.gestures import Waving as Waving
from invertwin.scene.people.motion import AxisRotation as AxisRotation
from invertwin.scene.people.motion import MovingScene as MovingScene
from invertwin.scene.people.motion import ObjectMotion as ObjectMotion
from invertwin.scene.people.motion import SplineTrajectory as SplineTrajectory
from invertwin.scene.people.motion import TrajectoryMotion as TrajectoryMotion
from invertwin.scene.polarisation import JonesTable as JonesTable
from invertwin.scene.pose import compose as compose
from invertwin.scene.pose import from_frame as from_frame
from invertwin.scene.pose import look_at as look_at
from invertwin.scene.pose import quaternion_from_vector as quaternion_from_vector
from invertwin.scene.pose import rigid as rigid
from invertwin.scene.pose import rotation_angle as rotation_angle
from invertwin.scene.pose import rotation_from_quaternion as rotation_from_quaternion
from invertwin.scene.pose import rotation_from_vector as rotation_from_vector
from invertwin.scene.pose import to_frame as to_frame
from invertwin.scene.pose import vector_from_quaternion as vector_from_quaternion
from invertwin.scene.rooms import room as room
from invertwin.scene.scene import Object as Object
from invertwin.scene.scene import Scene as Scene
from invertwin.scene.shape_models.density import DensityGrid as DensityGrid
from invertwin.scene.shape_models.distance import DistanceGrid as DistanceGrid
from invertwin.scene.shape_models.distance import NeuralDistance as NeuralDistance
from invertwin.scene.shape_models.distance import signed_distance as signed_distance
from invertwin.scene.shape_models.iso_surface import iso_surface as iso_surface
from invertwin.scene.shape_models.prior import PriorShape as PriorShape
from invertwin.scene.shape_models.prior import ShapePrior as ShapePrior
from invertwin.scene.shape_models.prior import load_prior as load_prior
from invertwin.scene.shape_models.shape_space import LinearShape as LinearShape
from invertwin.scene.shape_models.shape_space import ShapeSpace as ShapeSpace
from invertwin.scene.shape_models.smooth_vertices import LatticeDeformation as LatticeDeformation
from invertwin.scene.shape_models.smooth_vertices import SmoothVertices as SmoothVertices
from invertwin.scene.shapes import box as box
from invertwin.scene.shapes import cylinder as cylinder
from invertwin.scene.shapes import dihedral as dihedral
from invertwin.scene.shapes import plate as plate
from invertwin.scene.shapes import sphere as sphere
from invertwin.scene.shapes import text as text
from invertwin.scene.shapes import trihedral as trihedral

rename_attributes(__name__)
rename_members(BodyTemplate, posed="apply_pose", rotations_of="estimate_rotations", scaled="scale")
rename_members(DensityGrid, even="from_optical_depth", of_object="from_object")
rename_members(DistanceGrid, of_mesh="from_mesh", sampled="from_function")
rename_members(FieldCoefficients, mirroring="scale_reflection")
rename_members(
    Material, incoherent="incoherent_law", skin="smooth_interface", surface="scattering_law"
)
rename_members(MaterialValues, of="from_object")
rename_members(MovingScene, movers="motions")
rename_members(Object, at="advance")
rename_members(ScatteringLaw, less_mirror="without_specular", scaled="scale")
rename_members(Scene, at="advance", show="viewer.show")
rename_members(SkinnedBody, of="from_mesh", turned="perturb_joints")
rename_members(SplineTrajectory, places="positions")
rename_members(TabulatedPattern, of_decibels="from_decibels")
rename_members(Texture, over="from_projection")
rename_members(TrajectoryMotion, path="trajectory")
rename_members(Walking, shift="pelvis_offset")
