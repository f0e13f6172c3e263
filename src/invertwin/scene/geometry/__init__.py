"""Shapes that can be fitted: modules that map a scene to a scene with another mesh."""

from invertwin.scene.geometry.body import (
    BodyTemplate,
    SkinnedBody,
    articulated_template,
    load_smpl,
)
from invertwin.scene.geometry.deformation import LatticeDeformation
from invertwin.scene.geometry.density import DensityGrid
from invertwin.scene.geometry.distance import DistanceGrid, NeuralDistance
from invertwin.scene.geometry.iso_surface import iso_surface
from invertwin.scene.geometry.lattice import Lattice
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
    "ShapeSpace",
    "SkinnedBody",
    "SmoothVertices",
    "articulated_template",
    "iso_surface",
    "load_smpl",
    "load_vehicle_space",
]
