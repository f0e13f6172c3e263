"""Visibility from one viewpoint: the first surface along rays, and silhouettes.

Along a ray, what is seen jumps at two kinds of curves: outlines, where a surface turns away or
ends, and curves in which two objects cross. Both move with the scene and with the place from which
they are seen; derivatives of images need them.

Source: derivations §3 and §15.
"""

import itertools
from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.em.plane_waves import cross, dot
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.intersections import find_overlapping_pairs, intersect_triangles
from invertwin.channel.rays.ray_scene import Occluders
from invertwin.channel.rays.scene_tables import connect_surfaces
from invertwin.channel.rows import concatenate_rows
from invertwin.checks import is_differentiated, strip_derivatives
from invertwin.scene.scene import Scene

_Fractions = Float64[Tensor, " n"]
_Numbers = Int64[Tensor, " n"]


@dataclass(frozen=True)
class DiscontinuityCurves:
    """Straight pieces of the curves at which visibility may jump; detached.

    Attributes:
        start, end: Start and end of the pieces [m].
        first, second: Edges: vertices at the ends. Crossings: the two triangles.
        is_intersection: Whether it is a crossing.
    """

    start: Float64[Tensor, "piece 3"]
    end: Float64[Tensor, "piece 3"]
    first: Int64[Tensor, " piece"]
    second: Int64[Tensor, " piece"]
    is_intersection: bool


class ViewpointScene:
    """A scene as one place sees it.

    Args:
        scene: Surfaces only.
        viewpoint: [3] in the world [m].

    Attributes:
        names: Names of the objects.
        face_object: Number of the object of each triangle.

    Raises:
        InputError: A cloud in the scene.
    """

    def __init__(self, scene: Scene, viewpoint: Float64[Tensor, "3"]) -> None:
        self.names = tuple(scene.objects)
        self._viewpoint = viewpoint
        with tracing():
            self._topology, self._vertices = connect_surfaces(scene)
            fixed, origin = strip_derivatives(self._vertices), strip_derivatives(viewpoint)
            self._occluders = Occluders(fixed, self._topology, origin)
        self.face_object = self._topology.face_object

    @property
    def is_differentiated(self) -> bool:
        """True if derivatives flow to the vertices or to the viewpoint."""
        return is_differentiated(self._vertices) or is_differentiated(self._viewpoint)

    def find_first_faces(self, directions: Float64[Tensor, "n 3"]) -> _Numbers:
        """The triangle that each ray from the place meets first (−1: none).

        Args:
            directions: Directions in the world, of any length.
        """
        way = normalize(strip_derivatives(directions), dim=1).to(torch.float32)
        with tracing():
            return self._occluders.find_first_hits(torch.zeros_like(way), way)[0]

    def plane_distances(self, face: _Numbers, directions: Float64[Tensor, "n 3"]) -> _Fractions:
        """Compute distances to the planes of triangles, in lengths of the directions; attached.

        Args:
            face: triangle indices [n]; −1 is infinitely far.
            directions: directions in the world [n, 3].
        """
        hit = torch.nonzero(face >= 0)[:, 0]
        a, b, c = self._vertices[self._topology.faces[face[hit]]].unbind(1)
        normal = cross(b - a, c - a)
        distance = dot(a - self._viewpoint, normal) / dot(directions[hit], normal)
        return distance.new_full((len(face),), torch.inf).index_put((hit,), distance)

    def find_silhouettes(self) -> DiscontinuityCurves:
        """Edges where surfaces end, or turn away from the place."""
        topology, points = self._topology, strip_derivatives(self._vertices)
        # Triangles may be wound either way, so that normals say nothing: both neighbours lie on one
        # side of the plane through the edge and the place.
        beside, apex = topology.edge_faces, topology.edge_apexes
        alone = (beside >= 0).sum(1) != 2
        ends = points[topology.edges]
        across = cross(ends[:, 1] - ends[:, 0], ends[:, 0] - strip_derivatives(self._viewpoint))
        one, other = (dot(points[apex[:, k].clamp_min(0)] - ends[:, 0], across) for k in range(2))
        first, second = topology.edges[torch.nonzero(alone | (one * other >= 0))[:, 0]].unbind(1)
        ends = points[first], points[second]
        return DiscontinuityCurves(*ends, first, second, is_intersection=False)

    def find_intersections(self) -> DiscontinuityCurves:
        """Curves in which two objects cross."""
        points, topology = strip_derivatives(self._vertices), self._topology
        corners = points[topology.faces]
        none = topology.edges[:0, 0]
        parts = [intersect_triangles(points, topology, none, none)]
        for one, other in itertools.combinations(range(len(self.names)), 2):
            own = [torch.nonzero(self.face_object == number)[:, 0] for number in (one, other)]
            here, there = find_overlapping_pairs(corners[own[0]], corners[own[1]])
            if len(here):
                met = intersect_triangles(points, topology, own[0][here], own[1][there])
                parts.append(met.select(~met.touching))
        found = concatenate_rows(parts)
        ends = found.start, found.end
        return DiscontinuityCurves(*ends, found.first, found.second, is_intersection=True)

    def points_on_curves(
        self, curves: DiscontinuityCurves, piece: _Numbers, fraction: _Fractions
    ) -> Float64[Tensor, "n 3"]:
        """Points of curves, attached: they move with the edge, or with the planes that cross.

        Args:
            curves: Curves from ``outlines`` or ``crossings``.
            piece: Index of a piece of the curves.
            fraction: Place from the start to the end of the piece, 0 to 1.
        """
        first, second = curves.first[piece], curves.second[piece]
        if not curves.is_intersection:
            return torch.lerp(self._vertices[first], self._vertices[second], fraction[:, None])
        at = torch.lerp(curves.start[piece], curves.end[piece], fraction[:, None])
        rows, heights = [], []
        for face in (first, second):
            a, b, c = self._vertices[self._topology.faces[face]].unbind(1)
            normal = normalize(cross(b - a, c - a), dim=1)
            rows.append(normal)
            heights.append(dot(a - at, normal))
        rows.append(strip_derivatives(cross(rows[0], rows[1])))
        heights.append(torch.zeros_like(fraction))
        shift = torch.linalg.solve(torch.stack(rows, 1), torch.stack(heights, 1)[..., None])
        return at + shift[..., 0]
