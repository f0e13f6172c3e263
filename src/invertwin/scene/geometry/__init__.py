"""Shapes that can be fitted: modules that map a scene to a scene with another mesh."""

from invertwin.scene.geometry.anny_body import load_anny as load_anny
from invertwin.scene.geometry.body import BodyTemplate as BodyTemplate
from invertwin.scene.geometry.body import SkinnedBody as SkinnedBody
from invertwin.scene.geometry.body import articulated_template as articulated_template
from invertwin.scene.geometry.body import load_smpl as load_smpl
from invertwin.scene.geometry.deformation import LatticeDeformation as LatticeDeformation
from invertwin.scene.geometry.density import DensityGrid as DensityGrid
from invertwin.scene.geometry.density import cloud_surface as cloud_surface
from invertwin.scene.geometry.density import without_clouds as without_clouds
from invertwin.scene.geometry.distance import DistanceGrid as DistanceGrid
from invertwin.scene.geometry.distance import NeuralDistance as NeuralDistance
from invertwin.scene.geometry.iso_surface import iso_surface as iso_surface
from invertwin.scene.geometry.lattice import Lattice as Lattice
from invertwin.scene.geometry.person import person as person
from invertwin.scene.geometry.prior import PriorShape as PriorShape
from invertwin.scene.geometry.prior import ShapePrior as ShapePrior
from invertwin.scene.geometry.prior import load_prior as load_prior
from invertwin.scene.geometry.shape_space import LinearShape as LinearShape
from invertwin.scene.geometry.shape_space import ShapeSpace as ShapeSpace
from invertwin.scene.geometry.smooth_vertices import SmoothVertices as SmoothVertices
