"""Shapes that can be fitted: modules that map a scene to a scene with another mesh."""

from invertwin.scene.geometry.anny_body import load_anny
from invertwin.scene.geometry.body import (
    BodyTemplate,
    SkinnedBody,
    articulated_template,
    load_smpl,
)
from invertwin.scene.geometry.deformation import LatticeDeformation
from invertwin.scene.geometry.density import DensityGrid, cloud_surface, without_clouds
from invertwin.scene.geometry.distance import DistanceGrid, NeuralDistance
from invertwin.scene.geometry.iso_surface import iso_surface
from invertwin.scene.geometry.lattice import Lattice
from invertwin.scene.geometry.person import person
from invertwin.scene.geometry.prior import PriorShape, ShapePrior, load_prior
from invertwin.scene.geometry.shape_space import LinearShape, ShapeSpace, load_vehicle_space
from invertwin.scene.geometry.smooth_vertices import SmoothVertices

__all__ = [
    "BodyTemplate",
    "DensityGrid",
    "DistanceGrid",
    "Lattice",
    "LatticeDeformation",
    "LinearShape",
    "NeuralDistance",
    "PriorShape",
    "ShapePrior",
    "ShapeSpace",
    "SkinnedBody",
    "SmoothVertices",
    "articulated_template",
    "cloud_surface",
    "iso_surface",
    "load_anny",
    "load_prior",
    "load_smpl",
    "load_vehicle_space",
    "person",
    "without_clouds",
]
