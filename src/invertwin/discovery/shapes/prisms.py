"""Prisms with a free outline on the ground."""

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float64
from skimage.measure import find_contours
from torch import Tensor, nn

from invertwin.discovery.shapes import primitives
from invertwin.scene import DistanceGrid, Mesh, iso_surface, signed_distance
from invertwin.scene.parameters import Coordinate
from invertwin.scene.shape_models.lattice import Lattice

_SMOOTHING = 20.0  # smoothing of signed distances, see ``DistanceGrid``
_MARGIN_NODES = 6  # nodes around the initial outline
_MAX_NODES = 60  # maximum number of nodes along a side


@dataclass(frozen=True, eq=False, kw_only=True)
class PrismParameters(primitives.ShapeParameters):
    """Shape with vertical sides and any outline, without a yaw.

    Attributes:
        distances: signed distances to the outline at nodes along x and y, negative inside [m].
        spacing: node spacing [m].
        middle: x and y of the centre of the nodes [m].
    """

    distances: Float64[Tensor, "x y"]
    spacing: float
    middle: tuple[float, float]


def merge_into_prism(shapes: primitives.Shapes, level: float, spacing: float) -> PrismParameters:
    """Merge shapes into one prism: their union, with the height of the largest.

    Args:
        shapes: shapes to merge.
        level: height of the ground [m].
        spacing: minimum node spacing [m].
    """
    with torch.no_grad():
        meshes = [make_shape_model("", one, level).item.mesh for one in shapes]
    points = torch.cat([mesh.vertices for mesh in meshes])[:, :2]
    low, high = points.amin(0), points.amax(0)
    step = max(spacing, float((high - low).max()) / (_MAX_NODES - 2 * _MARGIN_NODES))
    counts = [math.ceil(float(side) / step) + 2 * _MARGIN_NODES + 1 for side in high - low]
    middle = 0.5 * (low + high)
    lines = [
        float(m) + step * (torch.arange(n, dtype=torch.float64) - 0.5 * (n - 1))
        for m, n in zip(middle, counts, strict=True)
    ]
    nodes = nn.functional.pad(torch.cartesian_prod(*lines), (0, 1))
    parts: list[Tensor] = []
    for mesh in meshes:
        nodes[:, 2] = 0.5 * (mesh.vertices[:, 2].amin() + mesh.vertices[:, 2].amax())
        parts.append(signed_distance(mesh, nodes))
    largest = max(shapes, key=lambda one: one.length * one.width)
    x, y = middle.tolist()
    shape: dict[str, Any] = {"height": largest.height, "brightness": largest.brightness}
    found = torch.stack(parts).amin(0).reshape(counts)
    # A wall that is thinner than the spacing may lie between nodes.
    shape |= {"distances": found - (found.amin() + 0.5 * step).clamp_min(0.0), "spacing": step}
    return PrismParameters("prism", (x, y), middle=(x, y), **shape)


class OutlineModel(primitives.UnknownShape):
    """Prism as an unknown: outline, position, height and brightness.

    Args:
        name: name of the object.
        start: initial shape parameters.
        level: height of the ground [m].

    Attributes:
        sides: signed distances to the outline.
        place: parameter [2], centre of their nodes [m].
        size: parameter, a third of the logarithm of the height.
    """

    def __init__(self, name: str, start: PrismParameters, level: float = 0.0) -> None:
        super().__init__(name, level, start.middle, start.brightness)
        self.start = start
        counts = torch.tensor(start.distances.shape, dtype=torch.float64)
        half = torch.ones(3, dtype=torch.float64)
        half[:2] = 0.5 * start.spacing * (counts - 1)
        # Equal distances at two heights keep the sides vertical.
        same = torch.stack([start.distances] * 2, dim=2)
        self.sides = DistanceGrid(name, (-half).tolist(), half.tolist(), same, _SMOOTHING)
        size = math.log(start.height) / self.SIZE_SCALE
        self.size = nn.Parameter(torch.tensor(size, dtype=torch.float64))

    @property
    def height(self) -> Float64[Tensor, ""]:
        """Height of the prism [m]."""
        return (self.SIZE_SCALE * self.size).exp()

    @property
    def shape(self) -> PrismParameters:
        """Return its present shape parameters."""
        with torch.no_grad():
            sides = self.mesh().vertices[:, :2]
            low, high = sides.amin(0), sides.amax(0)
            x, y = (0.5 * (low + high)).tolist()
            length, width = (high - low).tolist()
            a, b = self.place.tolist()
            distances = self.sides.distances[:, :, 0].clone()
            height, brightness = float(self.height), float(self.brightness)
        outline = {"position": (x, y), "middle": (a, b), "distances": distances}
        sizes = {"length": length, "width": width, "height": height}
        return replace(self.start, brightness=brightness, **outline, **sizes)

    def mesh(self) -> Mesh:
        """Return the surface in the world, differentiable with respect to all parameters."""
        grid = self.sides.lattice
        low, high, counts = grid.low.clone(), grid.high.clone(), list(grid.counts)
        place = torch.cat([self.place, self.place.new_tensor([self.level])])
        step, tall = self.start.spacing, float(self.height.detach())
        counts[2] = math.ceil(tall / step) + 4
        low[2], high[2] = -2 * step, tall + 2 * step

        def signed_distance_field(points: Tensor) -> Tensor:
            local = points - place
            beside = local.index_fill(1, torch.tensor([2]), 0.0)
            half = 0.5 * self.height
            return torch.maximum(self.sides.distance(beside), (local[:, 2] - half).abs() - half)

        at = place.detach()
        return iso_surface(signed_distance_field, Lattice.from_bounds(at + low, at + high, counts))

    def values(self) -> dict[str, Tensor]:
        """Return the fitted values by name, in SI units."""
        found = {"place": self.place, "height": self.height, "brightness": self.brightness}
        return {f"{self.object}.{name}": value.detach().clone() for name, value in found.items()}

    def coordinates(self) -> list[Coordinate]:
        """Return position, height and brightness; the outline moves as a whole."""
        height = float(self.height.detach())
        slope = torch.tensor(1 / (self.SIZE_SCALE * height), dtype=torch.float64)
        tall = Coordinate(f"{self.object}.height", "m", {"size": slope}, 0.1)
        return [*self.position_coordinates(), tall, self.brightness_coordinate()]


def make_shape_model(
    name: str, shape: primitives.ShapeParameters, level: float
) -> primitives.PrimitiveModel | OutlineModel:
    """Build the module of an unknown shape.

    Args:
        name: name of the object.
        shape: initial shape parameters.
        level: height of the ground [m].
    """
    if isinstance(shape, PrismParameters):
        return OutlineModel(name, shape, level)
    return primitives.PrimitiveModel(name, shape, level)


def prism_contour(prism: PrismParameters) -> Float64[Tensor, "corner 2"]:
    """Return the longest closed contour of a prism's outline on the ground [m].

    Args:
        prism: prism parameters.
    """
    lines = find_contours(prism.distances.numpy(), 0.0)
    longest = torch.from_numpy(max(lines, key=len)[:-1].copy())
    counts = torch.tensor(prism.distances.shape, dtype=torch.float64)
    middle = torch.tensor(prism.middle, dtype=torch.float64)
    return middle + prism.spacing * (longest - 0.5 * (counts - 1))
