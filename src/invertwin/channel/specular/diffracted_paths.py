"""Fields of diffracted paths of a scene, differentiable.

Which paths there are is found by rays and is detached (``bends``). What they are worth is computed
here from the vertices of the edges and of the triangles that they meet: diffraction between the
images of the antennas, and the field, turned at every surface before and after.

Source: derivations §9 and §10.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Complex128, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.em.plane_waves import cross, dot, plane_of_incidence, reflect_vectors
from invertwin.channel.em.wedges import edge_axis
from invertwin.channel.specular.corner_diffraction import diffract_round_corner
from invertwin.channel.specular.diffraction_candidates import (
    Corner,
    DiffractionCandidates,
    PathLegs,
    face_azimuths,
)
from invertwin.channel.specular.edge_path_geometry import EdgePaths, PathEdge, diffract_over_edges
from invertwin.channel.specular.image_method import image_positions, interaction_points
from invertwin.channel.specular.ray_paths import DIFFRACTION
from invertwin.channel.specular.wedge_scene import WedgeScene, clamp_to_edge


@dataclass(frozen=True)
class DiffractedPaths:
    """Diffracted paths with the same number of vertices, one row each.

    Attributes:
        tx, rx: numbers of the antennas.
        edge: numbers of the edges, from the transmitter on.
        points: where paths meet surfaces and edges: a point of the edge, its end where they turn
            past it [m].
        kinds: what happens there, by ``KINDS``.
        faces: triangles; of an edge, that of its first face.
        directions: unit vectors of the legs, from the transmitter on.
        length: of the path by these points [m].
        transfer: E at the receiver of E at 1 m from the transmitter, without the phase of
            ``length`` [1/m]; world coordinates, receive × transmit.
        slopes: as ``transfer``, of derivatives of the transmitter's and of the receiver's field by
            angles [rad] about ``axes``; zero of paths over more edges.
        axes: unit vectors about which these angles turn, of transmitter and receiver.
        corner: whether the first or the last edge is met in a corner, where its neighbour ends.
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
    corner: Corner = None


def evaluate_diffracted_paths(
    wedge_scene: WedgeScene,
    candidates: DiffractionCandidates,
    tx: Float64[Tensor, "tx 3"],
    rx: Float64[Tensor, "rx 3"],
    wave_number: float,
) -> DiffractedPaths:
    """What paths round edges are worth.

    Args:
        wedge_scene: the scene.
        candidates: the paths, see ``find_diffraction_candidates``.
        tx, rx: antennas [m].
        wave_number: k [1/m].
    """
    source, target = tx[candidates.tx], rx[candidates.rx]
    legs = [
        _AntennaLeg(wedge_scene, candidates.before, source),
        _AntennaLeg(wedge_scene, _reverse_legs(candidates.after), target),
    ]
    angles = face_azimuths(wedge_scene, candidates)
    arrive, leave = ([None, *angles[..., 1].T], [*angles[..., 0].T, None])
    edges = [
        wedge_scene.path_edge(row, pair, absorbing=candidates.absorbing)
        for row, pair in zip(candidates.edge.T, zip(arrive, leave, strict=True), strict=True)
    ]
    sent = _edge_fields(candidates, edges, legs[0].image, legs[1].image, wave_number)
    places = [clamp_to_edge(edge.wedges, sent.points[:, n]) for n, edge in enumerate(edges)]
    stops = torch.stack([legs[0].image, *places, legs[1].image], 1)
    pieces = stops[:, 1:] - stops[:, :-1]
    length = pieces.norm(dim=2).sum(1)
    # What the end of an edge sends has the delay of the path over that end.
    later = wave_number * (length - sent.length)
    turn = torch.polar(torch.ones_like(later), later)[:, None, None]
    arriving = legs[0].dyad(sent.points[:, 0])
    # Reciprocity: on its way out a wave is turned as one that comes in.
    leaving = legs[1].dyad(sent.points[:, -1]).mT
    slopes = torch.zeros_like(sent.transfer).expand(2, -1, -1, -1)
    if sent.slopes is not None:
        slopes = leaving @ (sent.slopes * turn) @ arriving
    axes = [
        leg.rotate_axis(-edge_axis(edges[n].wedges)) for leg, n in zip(legs, (0, -1), strict=True)
    ]
    ways = [normalize(pieces, dim=2)[:, 1:-1]]
    ways.insert(0, torch.stack(legs[0].directions(places[0]), 1))
    ways.append(-torch.stack(legs[1].directions(places[-1]), 1).flip(1))
    points = [legs[0].interaction_points(places[0]), torch.stack(places, 1)]
    points.append(legs[1].interaction_points(places[-1]).flip(1))
    kinds = [
        candidates.before.kinds,
        torch.full_like(candidates.edge, DIFFRACTION),
        candidates.after.kinds,
    ]
    first = wedge_scene.detached_wedges.faces[candidates.edge, 0]
    return DiffractedPaths(
        candidates.tx,
        candidates.rx,
        candidates.edge,
        torch.cat(points, 1),
        torch.cat(kinds, 1),
        torch.cat([candidates.before.faces, first, candidates.after.faces], 1),
        torch.cat(ways, 1),
        length,
        leaving @ (sent.transfer * turn) @ arriving,
        slopes.transpose(0, 1),
        torch.stack(axes, 1),
        candidates.corner,
    )


def _edge_fields(
    candidates: DiffractionCandidates, edges: list[PathEdge], tx: Tensor, rx: Tensor, k: float
) -> EdgePaths:
    if candidates.end is None:
        return diffract_over_edges(edges, tx, rx, k, slopes=len(edges) == 1)
    if candidates.corner == "last":
        return diffract_round_corner(edges, candidates.end, candidates.between[:, -1], tx, rx, k)
    # Reciprocity: the way back ends in the corner.
    back = [replace(e, azimuth_in=e.azimuth, azimuth=e.azimuth_in) for e in reversed(edges)]
    found = diffract_round_corner(back, candidates.end, candidates.between[:, 0].flip(1), rx, tx, k)
    return replace(found, points=found.points.flip(1), transfer=found.transfer.mT)


def _reverse_legs(legs: PathLegs) -> PathLegs:
    return PathLegs(legs.faces.flip(1), legs.transmitted.flip(1))


class _AntennaLeg:
    """Surfaces between an antenna and an edge, in this order, differentiable."""

    def __init__(self, wedge_scene: WedgeScene, legs: PathLegs, position: Tensor) -> None:
        corners = wedge_scene.vertices[wedge_scene.topology.faces[legs.faces]]
        self.wedge_scene = wedge_scene
        self.legs = legs
        self.normal = normalize(
            cross(corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]),
            dim=-1,
        )
        self.point = corners[..., 0, :]
        self.images = image_positions(position, self.point, self.normal, legs.transmitted)

    @property
    def image(self) -> Float64[Tensor, "row 3"]:
        """Of the antenna, as the edge sees it."""
        return self.images[-1]

    def interaction_points(self, point: Tensor) -> Float64[Tensor, "row step 3"]:
        """Where the way to a point meets the surfaces."""
        found = interaction_points(point, self.images, self.point, self.normal)
        return torch.stack(found, 1) if found else self.point

    def directions(self, point: Tensor) -> list[Tensor]:
        """Unit vectors of the way to a point, from the antenna on."""
        found = [normalize(point - self.image, dim=1)]
        for step in reversed(range(self.normal.shape[1])):
            turned = reflect_vectors(found[0], self.normal[:, step])
            found.insert(0, torch.where(self.legs.transmitted[:, step, None], found[0], turned))
        return found

    def rotate_axis(self, axis: Tensor) -> Tensor:
        """An axis of rotation near the edge, as it is near the antenna."""
        for step in reversed(range(self.normal.shape[1])):
            back = -reflect_vectors(axis, self.normal[:, step])
            axis = torch.where(self.legs.transmitted[:, step, None], axis, back)
        return axis

    def dyad(self, point: Tensor) -> Complex128[Tensor, "row 3 3"]:
        """E that arrives at a point, of E that leaves the antenna."""
        ways = self.directions(point)
        total = torch.eye(3, dtype=torch.complex128).expand(len(point), 3, 3)
        for step, through in enumerate(self.legs.transmitted.unbind(1)):
            normal, way = self.normal[:, step], ways[step]
            law = self.wedge_scene.coefficients(self.legs.faces[:, step], dot(normal, way).abs())
            s, before, after = (v[:, 0] for v in plane_of_incidence(normal, way))
            passing = through[:, None]
            both = torch.where(passing, before, after)
            strength_s = torch.where(through, law.transmission_s, law.reflection_s)
            strength_p = torch.where(through, law.transmission_p, law.reflection_p)
            across = s[:, :, None] * s[:, None]
            inside = both[:, :, None] * before[:, None]
            step_dyad = strength_s[:, None, None] * across + strength_p[:, None, None] * inside
            total = step_dyad @ total
        return total
