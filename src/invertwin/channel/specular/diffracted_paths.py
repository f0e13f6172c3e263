"""Fields of diffracted paths of a scene, differentiable.

The search for paths uses rays and is detached (``diffraction_candidates``). Their fields are
computed here from the vertices of the edges and triangles that they meet: diffraction between the
images of the antennas, and a dyad for every surface before and after.

Source: derivations §9 and §10.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Complex128, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.em.plane_waves import dot, phasor, plane_of_incidence, reflect_vectors
from invertwin.channel.em.utd import outer_product
from invertwin.channel.em.wedges import edge_axis
from invertwin.channel.specular import diffraction_candidates
from invertwin.channel.specular.corner_diffraction import diffract_round_corner
from invertwin.channel.specular.diffraction_candidates import DiffractionCandidates, PathLegs
from invertwin.channel.specular.edge_path_geometry import EdgePaths, PathEdge, diffract_over_edges
from invertwin.channel.specular.image_method import UnfoldedPaths
from invertwin.channel.specular.ray_paths import DIFFRACTION
from invertwin.channel.specular.wedge_scene import WedgeScene, clamp_to_edge


@dataclass(frozen=True)
class DiffractedPaths:
    """Fields of diffracted paths with equal numbers of vertices, one row each.

    Attributes:
        tx, rx: antenna numbers.
        edge: edge numbers, from the transmitter on.
        points: interaction points with surfaces and edges; diffraction points are clamped to the
            edge [m].
        kinds: interaction types, numbers of ``KINDS``.
        faces: triangles; for an edge, that of its first face.
        directions: unit vectors of the legs, from the transmitter on.
        length: path length through these points [m].
        transfer: E at the receiver over E at 1 m from the transmitter, without the phase of
            ``length`` [1/m]; world axes, receive × transmit.
        slopes: as ``transfer``, for derivatives of the transmitter's and the receiver's field with
            respect to rotations about ``axes`` [rad]; zero for paths over several edges.
        axes: unit vectors of these rotations, at transmitter and receiver.
        corner: "first" or "last" if that edge is met in a corner, where its neighbour ends.
    """

    tx: Int64[Tensor, " row"]
    rx: Int64[Tensor, " row"]
    edge: Int64[Tensor, "row order"]
    points: Float64[Tensor, "row vertex 3"]
    kinds: Int64[Tensor, "row vertex"]
    faces: Int64[Tensor, "row vertex"]
    directions: Float64[Tensor, "row leg 3"]
    length: Float64[Tensor, " row"]
    transfer: Complex128[Tensor, "row 3 3"]
    slopes: Complex128[Tensor, "row 2 3 3"]
    axes: Float64[Tensor, "row 2 3"]
    corner: diffraction_candidates.Corner = None


def evaluate_diffracted_paths(
    wedge_scene: WedgeScene,
    candidates: DiffractionCandidates,
    tx: Float64[Tensor, "tx 3"],
    rx: Float64[Tensor, "rx 3"],
    wave_number: float,
) -> DiffractedPaths:
    """Evaluate the fields of diffracted paths.

    Args:
        wedge_scene: scene with sharp edges.
        candidates: result of ``find_diffraction_candidates``.
        tx, rx: antenna positions [m].
        wave_number: wave number k [1/m].
    """
    source, target = tx[candidates.tx], rx[candidates.rx]
    sides = (candidates.before, source), (candidates.after.reverse(), target)
    legs = [_AntennaLeg(wedge_scene, *side) for side in sides]
    angles = diffraction_candidates.face_azimuths(wedge_scene, candidates)
    incidence, departure = [None, *angles[..., 1].T], [*angles[..., 0].T, None]
    edges = [
        wedge_scene.path_edge(row, pair, reflects=candidates.reflects)
        for row, pair in zip(candidates.edge.T, zip(incidence, departure, strict=True), strict=True)
    ]
    found = _edge_fields(candidates, edges, legs[0].image, legs[1].image, wave_number)
    edge_points = [clamp_to_edge(edge.wedges, found.points[:, n]) for n, edge in enumerate(edges)]
    nodes = torch.stack([legs[0].image, *edge_points, legs[1].image], 1)
    segments = nodes[:, 1:] - nodes[:, :-1]
    length = segments.norm(dim=2).sum(1)
    # The field of the end of an edge has the delay of the path over that end.
    delay_phasor = phasor(wave_number * (length - found.length))[:, None, None]
    arriving = legs[0].dyad(found.points[:, 0])
    # Reciprocity: the dyad after the edges is the transpose of that towards them.
    leaving = legs[1].dyad(found.points[:, -1]).mT
    slopes = torch.zeros_like(found.transfer).expand(2, -1, -1, -1)
    if found.slopes is not None:
        slopes = leaving @ (found.slopes * delay_phasor) @ arriving
    ends = zip(legs, (edges[0], edges[-1]), strict=True)
    axes = [leg.rotate_axis(-edge_axis(edge.wedges)) for leg, edge in ends]
    directions = [normalize(segments, dim=2)[:, 1:-1]]
    directions.insert(0, torch.stack(legs[0].directions(edge_points[0]), 1))
    directions.append(-torch.stack(legs[1].directions(edge_points[-1]), 1).flip(1))
    points = [legs[0].interaction_points(edge_points[0]), torch.stack(edge_points, 1)]
    points.append(legs[1].interaction_points(edge_points[-1]).flip(1))
    bends = torch.full_like(candidates.edge, DIFFRACTION)
    kinds = [candidates.before.kinds, bends, candidates.after.kinds]
    first = wedge_scene.detached_wedges.faces[candidates.edge, 0]
    faces = [candidates.before.faces, first, candidates.after.faces]
    numbers = candidates.tx, candidates.rx, candidates.edge
    vertices = torch.cat(points, 1), torch.cat(kinds, 1), torch.cat(faces, 1)
    ways = torch.cat(directions, 1)
    transfer = leaving @ (found.transfer * delay_phasor) @ arriving
    fields = transfer, slopes.transpose(0, 1), torch.stack(axes, 1)
    return DiffractedPaths(*numbers, *vertices, ways, length, *fields, candidates.corner)


def _edge_fields(
    candidates: DiffractionCandidates, edges: list[PathEdge], tx: Tensor, rx: Tensor, k: float
) -> EdgePaths:
    if candidates.end is None:
        return diffract_over_edges(edges, tx, rx, k, slopes=len(edges) == 1)
    if candidates.corner == "last":
        return diffract_round_corner(edges, candidates.end, candidates.between[:, -1], tx, rx, k)
    # Reciprocity: the reverse path ends in the corner.
    back = [replace(e, azimuth_in=e.azimuth, azimuth=e.azimuth_in) for e in reversed(edges)]
    found = diffract_round_corner(back, candidates.end, candidates.between[:, 0].flip(1), rx, tx, k)
    return replace(found, points=found.points.flip(1), transfer=found.transfer.mT)


class _AntennaLeg(UnfoldedPaths):
    """Unfolded legs between an antenna and an edge."""

    def __init__(self, wedge_scene: WedgeScene, legs: PathLegs, position: Tensor) -> None:
        moving = wedge_scene.vertices, wedge_scene.topology
        super().__init__(*moving, legs.faces, legs.transmitted, position)
        self.coefficients = wedge_scene.coefficients

    def rotate_axis(self, axis: Tensor) -> Tensor:
        """Transform an axis of rotation at the edge to the antenna."""
        for step in reversed(range(self.normal.shape[1])):
            back = -reflect_vectors(axis, self.normal[:, step])
            axis = torch.where(self.transmitted[:, step, None], axis, back)
        return axis

    def dyad(self, point: Tensor) -> Complex128[Tensor, "row 3 3"]:
        """Dyads from E at the antenna to E at a point, without spreading."""
        ways = self.directions(point)
        total = torch.eye(3, dtype=torch.complex128).expand(len(point), 3, 3)
        for step, through in enumerate(self.transmitted.unbind(1)):
            normal, way = self.normal[:, step], ways[step]
            law = self.coefficients(self.faces[:, step], dot(normal, way).abs())
            s, before, after = (v[:, 0] for v in plane_of_incidence(normal, way))
            both = torch.where(through[:, None], before, after)
            across = torch.where(through, law.transmission_s, law.reflection_s)
            inside = torch.where(through, law.transmission_p, law.reflection_p)
            total = (outer_product(across, s, s) + outer_product(inside, both, before)) @ total
        return total
