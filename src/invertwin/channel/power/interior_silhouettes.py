"""Silhouette sampling between surfaces: edges that shadow one surface point from another."""

from dataclasses import dataclass
from typing import Any

from invertwin.channel.power.discrete import Proportional, by_scene, place_along
from invertwin.channel.power.integrand import Inputs
from invertwin.channel.power.mesh_folds import folded
from invertwin.channel.power.silhouettes import (
    _BESIDE,
    _FLAT,
    _MISSED,
    Drawn,
    EdgePoints,
    _ahead,
    _not_grazing,
    _sides,
)
from invertwin.channel.rays.arrays import between, point_at, scrambled, uniform_pair
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.differentiated_objects import NO_PLACE, Movers
from invertwin.channel.rays.ray_scene import RayScene


@dataclass(frozen=True)
class Behind:
    """A point from which a shadow is cast."""

    face: Any  # triangle
    b1: Any  # barycentric coordinates
    b2: Any


@dataclass(frozen=True)
class TwoSided:
    """Points on edges with what lies on both sides of a tangential direction."""

    edge: EdgePoints  # its weight holds the change of measure from directions to area
    behind: Behind  # where the shadow is cast from

    @property
    def size(self) -> int:
        """How many there are."""
        return self.edge.size


class InteriorEdgeSampler:
    """Points and tangential directions on all edges that can hide one surface from another.

    Edges are weighted by their length, by the angle under which they hide (the opening between
    their triangles' planes) and by how near they are to both antennas; directions are uniform
    over those that are tangential.

    Args:
        rays: The scene and its antennas.
        inputs: Detached tables.
        samples: Points over all frames and scenes.
        seed: Of the points.
        weighted: False takes edges by length alone and directions from the whole sphere: what the
            benchmark compares with.
        close: Whether other surfaces may be close to edges.
    """

    def __init__(
        self,
        rays: RayScene,
        inputs: Inputs,
        samples: int,
        seed: int,
        *,
        weighted: bool = True,
        close: bool = False,
    ) -> None:
        topology = rays.topology
        self.rays, self.inputs, self.weighted, self.close = rays, inputs, weighted, close
        edge = dr.arange(mi.UInt32, len(topology.edges))
        y0, y1 = rays.exact_ends(edge)
        length = mi.Float(dr.norm(y1 - y0))
        _, span = self._opening(edge, y0, y1)
        weight = dr.select(span > _FLAT, length, 0.0)
        if weighted:
            middle = mi.Point3f(0.5 * (y0 + y1))
            near, first = mi.Float(0.0), rays.edge_scene(edge) * rays.looks
            for look in range(min(rays.looks, 8)):
                at = first + look * rays.looks // min(rays.looks, 8)
                legs = [dr.norm(middle - point_at(t, at)) + length for t in (rays.tx, rays.rx)]
                near += 1 / (legs[0] * legs[1])
            weight *= span * near
        # Poses of the same number in all scenes share one choice of edges.
        self.per_look = max(1, samples // rays.looks)
        self.size = self.per_look * rays.looks if len(topology.edges) else 0
        if self.size:
            self.choice = Proportional(by_scene(rays, rays.edge_scene(edge), weight))
        self.seeds = scrambled(seed, 4), scrambled(seed, 5)
        self.dice = scrambled(seed, 10), scrambled(seed, 11)
        self.aims = scrambled(seed, 12), scrambled(seed, 13)

    def _opening(self, edge: Any, y0: Any, y1: Any) -> tuple[Any, Any]:
        """Start and span of the tangential directions' azimuth about the edge, up to sign.

        Azimuths count from the first triangle of the edge. Two triangles at azimuths 0 and α
        leave (α, π); one triangle leaves all; more are left to the test of sides.
        """
        topology = self.rays.topology
        along = dr.normalize(y1 - y0)
        start, span = mi.Float(0.0), mi.Float(dr.pi)
        if len(topology.device_opposite) < 2:
            return start, span
        x, y = self._azimuth_axes(edge, y0, along)
        apex = dr.gather(mi.Int32, topology.device_opposite[1], edge)
        offset = self.rays.exact(mi.UInt32(dr.maximum(apex, 0))) - y0
        angle = mi.Float(dr.atan2(dr.dot(offset, y), dr.dot(offset, x)))
        turn = dr.abs(angle)
        # Behind a fold the free azimuths are those beyond the second triangle, up to π.
        start = dr.select(apex >= 0, dr.select(angle > 0, turn, 0.0), start)
        span = dr.select(apex >= 0, dr.pi - turn, span)
        unsure = mi.Bool(False)
        for column in topology.device_opposite[2:]:
            unsure |= dr.gather(mi.Int32, column, edge) >= 0
        if self.inputs.surfaces.sheets:
            unsure |= self._sheet(edge) & (span > _FLAT)
        return dr.select(unsure, 0.0, start), dr.select(unsure, dr.pi, span)

    def _sheet(self, edge: Any) -> Any:
        """Whether any triangle of an edge lets something through."""
        inputs, found = self.inputs, mi.Bool(False)
        for column in self.rays.topology.device_beside:
            face = dr.gather(mi.UInt32, column, edge)
            row = dr.gather(mi.UInt32, inputs.face_surface, face)
            found |= inputs.surfaces.tabulated("transmittance", row, mi.Float(1.0)) > 0
        return found

    def _azimuth_axes(self, edge: Any, y0: Any, along: Any) -> tuple[Any, Any]:
        topology = self.rays.topology
        apex = mi.UInt32(dr.maximum(dr.gather(mi.Int32, topology.device_opposite[0], edge), 0))
        offset = self.rays.exact(apex) - y0
        x = dr.normalize(offset - along * dr.dot(along, offset))
        return x, dr.cross(along, x)

    def draw(self, index: Any) -> Drawn:
        """The samples of the given indices below ``size``; those that hide nothing are void."""
        rays, topology = self.rays, self.rays.topology
        look, within = index // self.per_look, index % self.per_look
        edge, along, pmf = place_along(self.choice, within, self.per_look, self.seeds[0], index)
        frame = rays.edge_scene(edge) * rays.looks + look
        first, second = (dr.gather(mi.UInt32, ends, edge) for ends in topology.device_edges)
        y0, y1 = rays.exact_ends(edge)
        place = y0 + (y1 - y0) * mi.Float64(along)
        omega, density = self._direction(index, edge, y0, y1)
        if self.weighted and rays.differentiated_objects is not None and rays.scenes == 1:
            omega, density = self._aimed(
                rays.differentiated_objects, index, edge, place, omega, density
            )
        exact = mi.Vector3d(omega)
        sides = _sides(rays, self.inputs, edge, exact)
        aside = _BESIDE * (dr.norm(place) + dr.norm(y1 - y0))
        y, beside = mi.Point3f(place), mi.Point3f(place + sides.outwards * aside)
        valid = (pmf > 0) & sides.unlike
        hits = []
        for sign, dice in zip((-1.0, 1.0), self.dice, strict=True):
            hit = _ahead(
                rays, self.inputs, (edge, along), beside, omega * (sign * dr.norm(y)), valid,
                (index, dice), close=self.close and sign > 0,
            )  # fmt: skip
            valid &= hit.valid & _not_grazing(rays, hit.face, omega, hit.valid)
            valid &= rays.in_scene(frame, hit.face, hit.valid)
            hits.append(hit)
        if rays.differentiated_objects is not None:
            moves = rays.differentiated_objects.has_edge(edge)
            for hit in hits:
                moves |= rays.differentiated_objects.has_face(hit.face, hit.valid)
            valid &= moves
        near = _MISSED * dr.norm(place)
        valid &= ~folded(rays, edge, place, exact, sides.outwards, aside, near, valid)
        behind, ahead = hits
        triangle = p0, p1, p2 = rays.corners(behind.face, valid)
        b1, b2 = behind.b1, behind.b2
        point = between(triangle, b1, b2)
        cosine = dr.abs(dr.dot(dr.normalize(dr.cross(p1 - p0, p2 - p0)), omega))
        measure = dr.squared_norm(point - y) / cosine
        chance = behind.chance * ahead.chance
        points = EdgePoints(
            index, False, frame, first, second, sides.side, along, ahead.face,
            weight=measure / (pmf * density * self.per_look * chance),
            transmittance=behind.transmittance * ahead.transmittance,
            extra=behind.extra + ahead.extra,
            open=sides.open, open_extra=sides.open_extra,
            covered=sides.covered, covered_extra=sides.covered_extra,
        )  # fmt: skip
        return Drawn(valid, (points, Behind(behind.face, b1, b2)), TwoSided)

    def _aimed(
        self, movers: Movers, index: Any, edge: Any, place: Any, omega: Any, density: Any
    ) -> tuple[Any, Any]:
        """Half of the directions through edges at rest go where something moves."""
        still = ~movers.has_edge(edge)
        (coin, first), (second, third) = (uniform_pair(index, seed) for seed in self.aims)
        chosen, turned = still & (coin < 0.5), coin < 0.25
        at = mi.Point3f(place)
        towards, aimed = movers.towards(at, [first, second, third])
        line, aimed = dr.select(chosen, towards, omega), dr.select(chosen, aimed, NO_PLACE)
        mixed = 0.5 * (density + movers.line_density(at, line, aimed))
        return dr.select(chosen & turned, -line, line), dr.select(still, mixed, density)

    def _direction(self, index: Any, edge: Any, y0: Any, y1: Any) -> tuple[Any, Any]:
        """A tangential direction and its probability per solid angle."""
        first, second = uniform_pair(index, self.seeds[1])
        if not self.weighted:
            sphere = mi.warp.square_to_uniform_sphere(mi.Point2f(first, second))
            return sphere, mi.Float(1 / (4 * dr.pi))
        along = dr.normalize(y1 - y0)
        x, y = self._azimuth_axes(edge, y0, along)
        start, span = self._opening(edge, y0, y1)
        sign = dr.select(second < 0.5, 1.0, -1.0)
        azimuth = start + span * (2 * second - dr.select(second < 0.5, 0.0, 1.0))
        s, c = dr.sincos(azimuth)
        height = 2 * first - 1
        across = sign * dr.sqrt(dr.maximum(1 - height * height, 0.0))
        omega = along * height + (x * c + y * s) * across
        return mi.Vector3f(dr.normalize(omega)), 1 / (4 * span)
