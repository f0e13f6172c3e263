"""Scene for diffraction: its sharp edges, and the points on them that rays can reach.

Source: derivations §9.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.em import wedges as sharp_edges
from invertwin.channel.em.plane_waves import dot
from invertwin.channel.em.wedges import Wedges, edge_axis, has_open_exterior
from invertwin.channel.rays.edge_crossings import find_crossings, split_at_crossings
from invertwin.channel.rays.topology import Topology
from invertwin.channel.rows import strip_rows
from invertwin.channel.specular.edge_path_geometry import PathEdge
from invertwin.channel.specular.image_method import CandidateSurfaces, is_unobstructed
from invertwin.checks import strip_derivatives
from invertwin.scene.material.fresnel import FieldCoefficients

TriangleCoefficients = Callable[[Int64[Tensor, " n"], Float64[Tensor, " n"]], FieldCoefficients]
"""Field coefficients of triangles at cosines of the angle of incidence, referred to the mesh."""

_OFFSET_MARGINS = 10.0  # margins of the ray scene: distance of rays' ends from an edge
_GRAZING_TOLERANCE = 1e-9  # rad
_EDGE_PIECES = 16  # pieces of an edge, each open or covered as a whole


@dataclass(frozen=True)
class WedgeScene:
    """Scene with sharp edges for diffraction.

    Attributes:
        vertices: vertex positions of all objects [m].
        topology: triangles of the vertices.
        surfaces: occluders and their planes.
        coefficients: field coefficients of the triangles.
    """

    vertices: Float64[Tensor, "v 3"]
    topology: Topology
    surfaces: CandidateSurfaces
    coefficients: TriangleCoefficients

    @cached_property
    def wedges(self) -> Wedges:
        """Sharp edges: collinear ones merged, and split where they pass through surfaces."""
        corners = self.vertices[self.topology.faces]
        ends = self.vertices[self.topology.edges]
        wedges = sharp_edges.merge_collinear_wedges(
            sharp_edges.find_wedges(corners, ends, self.topology.edge_faces)
        )
        crossings = find_crossings(self.surfaces, wedges, self.ray_offset)
        return split_at_crossings(wedges, crossings, corners)

    @cached_property
    def detached_wedges(self) -> Wedges:
        """Detached sharp edges."""
        return strip_rows(self.wedges)

    @property
    def ray_offset(self) -> float:
        """Distance of rays' ends from edges [m]."""
        return _OFFSET_MARGINS * self.surfaces.margin

    def path_edge(
        self,
        row: Tensor,
        known_azimuths: tuple[Tensor | None, Tensor | None] = (None, None),
        *,
        reflects: bool = True,
    ) -> PathEdge:
        """Return edges for the evaluation of paths.

        Args:
            row: numbers of wedges.
            known_azimuths: azimuths of incidence and of diffraction, where a path runs along a
                face.
            reflects: False for faces that do not reflect.
        """
        wedges = self.wedges.select(row)

        def faces(face: int, cosine: Tensor) -> FieldCoefficients:
            return self.coefficients(wedges.faces[:, face], cosine)

        return PathEdge(wedges, faces, *known_azimuths, reflects=reflects)

    def offset_points(
        self, row: Tensor, points: Float64[Tensor, "row 3"]
    ) -> Float64[Tensor, "row 3"]:
        """Offset points from edges and their ends, as targets of rays; detached.

        Args:
            row: numbers of wedges.
            points: points on the lines of the edges [m].
        """
        wedges = self.detached_wedges.select(row)
        side = wedges.end - wedges.start
        fraction = _edge_fractions(wedges, strip_derivatives(points))
        inset = (self.ray_offset / side.norm(dim=1)).clamp(max=0.25)
        fraction = torch.minimum(torch.maximum(fraction, inset), 1 - inset)
        outward = normalize((wedges.normals - wedges.face_tangents).sum(1), dim=1)
        return wedges.start + fraction[:, None] * side + self.ray_offset * outward

    def is_diffracting(self, row: Tensor, points: Float64[Tensor, "row 3"]) -> Bool[Tensor, " row"]:
        """Test if an edge diffracts at a point: no other surface fills part of its exterior.

        Args:
            row: numbers of wedges.
            points: points on the lines of the edges [m].
        """
        fraction = _edge_fractions(self.detached_wedges.select(row), strip_derivatives(points))
        return self._is_piece_open[row, (fraction * _EDGE_PIECES).long().clamp(0, _EDGE_PIECES - 1)]

    @cached_property
    def _is_piece_open(self) -> Bool[Tensor, "edge piece"]:
        """Mask of edge pieces with an unobstructed detour round their middle."""
        wedges = self.detached_wedges
        share = (torch.arange(_EDGE_PIECES, dtype=torch.float64) + 0.5) / _EDGE_PIECES
        points = wedges.start[:, None] + share[:, None] * (wedges.end - wedges.start)[:, None]
        rows = wedges.select(torch.arange(len(points)).repeat_interleave(_EDGE_PIECES))
        is_clear = partial(is_unobstructed, self.surfaces)
        clear = has_open_exterior(rows, points.reshape(-1, 3), self.ray_offset, is_clear)
        return clear.reshape(-1, _EDGE_PIECES)


def is_exterior(wedges: Wedges, points: Float64[Tensor, "row 3"]) -> Bool[Tensor, " row"]:
    """Mask of points in the exterior of infinite wedges, faces included.

    Args:
        wedges: sharp edges, one row each.
        points: positions, [row, 3] [m].
    """
    offset = (points - wedges.start).detach()
    angle = sharp_edges.azimuth(wedges, offset, 0).detach()
    inside = (angle > wedges.opening.detach() * torch.pi + _GRAZING_TOLERANCE) & (
        angle < 2 * torch.pi - _GRAZING_TOLERANCE
    )
    axis = edge_axis(wedges).detach()
    return ~inside & ((offset - dot(offset, axis)[:, None] * axis).norm(dim=1) > 0)


def clamp_to_edge(wedges: Wedges, points: Float64[Tensor, "row 3"]) -> Float64[Tensor, "row 3"]:
    """Clamp points on the lines of edges to the edges.

    Args:
        wedges: sharp edges, one row each.
        points: positions, [row, 3] [m].
    """
    fraction = _edge_fractions(wedges, points).clamp(0, 1)
    return wedges.start + fraction[:, None] * (wedges.end - wedges.start)


def _edge_fractions(wedges: Wedges, points: Tensor) -> Float64[Tensor, " row"]:
    """Positions of points along edges, from 0 at the start to 1 at the end."""
    side = wedges.end - wedges.start
    return dot(points - wedges.start, side) / dot(side, side)
