"""Where shadows end: points on edges, what falls behind them, and how fast it moves.

Family 1 looks from an antenna past its silhouettes; family 2 starts at an edge and looks both
ways along a direction that is tangential there, so that no silhouette is ever searched per vertex
(derivations §3). Places are detached, ``shadow_speed`` is attached.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from invertwin.channel.power import integrand
from invertwin.channel.power.folds import folded
from invertwin.channel.power.integrand import Inputs
from invertwin.channel.power.passage import Hit, land, passage
from invertwin.channel.rays.arrays import between, point_at, scrambled, uniform_pair
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.contacts import IN_PLANE
from invertwin.channel.rays.movers import NO_PLACE, Movers
from invertwin.channel.rays.scene import NEAR, RayScene

_GRAZING = 1e-5  # least cosine between a boundary ray and the normal of the shadowed surface
_RESOLVED = 5e-5  # chance of an edge from which float32 resolves a sample's place within it
# Boundary rays start beside the edge, by this much (two roundings) of its distance from the origin
# and its length: its own triangles, nearly edge-on, would else lie in their way.
_BESIDE = 1e-7
_MISSED = 2 * NEAR  # how far off an edge, of its distance, rays may miss what they meet
_BEFORE = 3e-5  # how much before an edge, of its distance, such rays start among close surfaces
_LAST_BELOW_ONE = 1 - 2.0**-24
_FLAT = 1e-6  # least opening [rad] of an edge that can hide something


@dataclass(frozen=True)
class EdgePoints:
    """Points on edges and the triangle on which their shadow falls (Dr.Jit arrays).

    ``open`` and ``covered`` are the transmittances of the edge's own triangles: 1 where there is
    none, 0 where it is opaque. The covered side is that of the triangle that leaves the plane
    through edge and ray most.
    """

    index: Any  # of the sample
    receiver: Any  # whether it is the receiver's silhouette; False where one serves both antennas
    frame: Any  # radar pose
    first: Any  # vertices at the ends of the edge
    second: Any
    side: Any  # ±1: whether ray × edge points to the covered side
    along: Any  # place from the first end to the second, 0 to 1
    face: Any  # triangle on which the shadow falls
    weight: Any  # one over (samples × probability per ``along``)
    transmittance: Any  # of all other sheets on the way, and the length [m] that these add
    extra: Any
    open: Any  # beside the edge, on the other side
    open_extra: Any
    covered: Any  # on the covered side
    covered_extra: Any

    @property
    def size(self) -> int:
        """How many there are."""
        return dr.width(self.face)

    def sides(self, inputs: Inputs) -> list[tuple[float, Any, Any]]:
        """Sign, transmittance and extra length of either side of the shadow's edge."""
        lit = (1.0, self.transmittance * self.open, self.extra + self.open_extra)
        if not inputs.surfaces.sheets:
            return [lit]
        return [lit, (-1.0, self.transmittance * self.covered, self.extra + self.covered_extra)]


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


@dataclass(frozen=True)
class Shadow:
    """A point on a shadow's edge."""

    b1: Any  # barycentric coordinates, detached
    b2: Any
    speed: Any  # area newly lit per unit of θ, attached


@dataclass(frozen=True)
class Drawn:
    """Edge points of which some are void: recorded, and executed when asked for."""

    valid: Any  # which are not void
    groups: tuple[Any, ...]  # dataclasses of arrays
    kind: Callable[..., Any]  # makes the points of them

    def launch(self) -> None:
        """Start the execution, without waiting for it."""
        dr.eval(self.valid, *self.groups)

    def kept(self) -> Any:
        """The points that are not void."""
        self.launch()
        lanes: Any = dr.compress(self.valid)
        return self.kind(
            *(
                type(group)(
                    *(
                        c if c is False else dr.gather(type(c), c, lanes)
                        for c in vars(group).values()
                    )
                )
                for group in self.groups
            )
        )


class Proportional:
    """Draws entries in proportion to weights, without reading any back."""

    def __init__(self, weights: Any) -> None:
        self.weights, self.sums = weights, dr.cumsum(weights)
        self.entries = dr.width(weights)
        self.total = dr.gather(mi.Float, self.sums, self.entries - 1)

    def draw(self, spread: Any) -> tuple[Any, Any, Any]:
        """Entry, the rest of the number within it, and probability: zero if there is no entry."""
        target = spread * self.total

        def below(at: Any) -> Any:
            return dr.gather(mi.Float, self.sums, at) <= target

        place: Any = dr.binary_search(0, self.entries - 1, below)
        weight = dr.gather(mi.Float, self.weights, place)
        last = dr.gather(mi.Float, self.sums, place) - weight
        rest = dr.clip((target - last) / weight, 0.0, _LAST_BELOW_ONE)
        return place, rest, dr.select(weight > 0, weight / self.total, 0.0)


def by_object(rays: RayScene, edge: Any, weight: Any, receiver: Any, centres: int) -> Any:
    """Weights of edges by which no object drowns another.

    An object gets the square root of the sum of its edges' weights, which is between a share by
    size and one share for each. Both antennas get the same sum, and so do all scenes.

    Args:
        rays: The scene.
        edge: Edges.
        weight: Of each, by itself.
        receiver: Whether it is the receiver's silhouette.
        centres: 2 if there are silhouettes of a receiver, else 1.
    """
    objects = len(rays.geometry.names)
    antenna = dr.select(receiver, mi.UInt32(1), 0)
    row = dr.gather(mi.UInt32, rays.topology.device_edge_object, edge) + antenna * objects
    totals, sums = dr.zeros(mi.Float, centres * objects), dr.zeros(mi.Float, centres * rays.scenes)
    dr.scatter_add(totals, weight, row)
    roots, rows = dr.sqrt(totals), dr.arange(mi.UInt32, centres * objects)
    scene = rays.object_scene(rows % objects)
    dr.scatter_add(sums, roots, rows // objects * rays.scenes + scene)
    part = antenna * rays.scenes + rays.edge_scene(edge)
    share: Any = weight / (dr.gather(mi.Float, roots, row) * dr.gather(mi.Float, sums, part))
    return dr.select(weight > 0, share, 0.0)


def by_scene(rays: RayScene, scene: Any, weight: Any) -> Any:
    """Weights of which all scenes have the same sum, if they have any.

    Args:
        rays: The scenes.
        scene: Of each weight.
        weight: The weights.
    """
    if rays.scenes == 1:
        return weight
    totals = dr.zeros(mi.Float, rays.scenes)
    dr.scatter_add(totals, weight, scene)
    return dr.select(weight > 0, weight / dr.gather(mi.Float, totals, scene), 0.0)


class EdgeSampler:
    """Points on the silhouettes seen from one antenna or both, and where their shadows fall.

    An edge is a silhouette if all its triangles lie, as seen from the antenna, on one side of
    it: one triangle for an open edge, two for a fold, any number for a non-manifold edge. The
    rule needs no consistent winding. Of sheets, every edge counts at which they let through
    more on one side than on the other.

    Args:
        rays: The scene and its antennas.
        inputs: Detached tables.
        centres: Antennas whose silhouettes count: ``tx``, ``rx`` or both.
        samples: Points over all frames and scenes.
        seed: Of the points.
        close: Whether other surfaces may be close to edges.
    """

    def __init__(
        self,
        rays: RayScene,
        inputs: Inputs,
        centres: Sequence[str],
        samples: int,
        seed: int,
        *,
        close: bool = False,
    ) -> None:
        topology = rays.topology
        self.rays, self.inputs, self.centres, self.close = rays, inputs, centres, close
        entries = len(centres) * rays.looks * len(topology.edges)
        edge, _, receiver, origin = self._seen(dr.arange(mi.UInt32, entries))
        y0, y1 = rays.exact_ends(edge)
        ends = [mi.Vector3d(y - mi.Vector3d(origin)) for y in (y0, y1)]
        sides = _sides(rays, inputs, edge, 0.5 * (ends[0] + ends[1]))
        self.size = samples if entries else 0
        if self.size:
            seen = mi.Float(dr.atan2(dr.norm(dr.cross(*ends)), dr.dot(*ends)))
            counts = sides.unlike
            if rays.movers is not None:
                counts &= rays.movers.has_edge(edge) | rays.movers.beyond(edge, origin, y0, y1)
            weight = dr.select(counts, seen * sides.step, 0.0)
            self.choice = Proportional(by_object(rays, edge, weight, receiver, len(centres)))
        self.seed, self.dice = scrambled(seed, 3), scrambled(seed, 9)

    def _seen(self, entry: Any) -> tuple[Any, Any, Any, Any]:
        """Edge, frame, whether the antenna is the receiver of two, and its place."""
        rays, edges = self.rays, len(self.rays.topology.edges)
        look, edge = entry // edges, entry % edges
        first = rays.edge_scene(edge) * rays.looks
        if len(self.centres) == 1:
            frame = first + look
            return edge, frame, False, point_at(getattr(rays, self.centres[0]), frame)
        receiver = look >= rays.looks
        frame = first + dr.select(receiver, look - rays.looks, look)
        origin = dr.select(receiver, point_at(rays.rx, frame), point_at(rays.tx, frame))
        return edge, frame, receiver, origin

    def draw(self, index: Any) -> Drawn:
        """The samples of the given indices below ``size``; those without a shadow are void."""
        rays, topology = self.rays, self.rays.topology
        place, along, pmf = place_along(self.choice, index, self.size, self.seed)
        edge, frame, receiver, origin = self._seen(place)
        first, second = (dr.gather(mi.UInt32, ends, edge) for ends in topology.device_edges)
        y0, y1 = rays.exact_ends(edge)
        y = y0 + (y1 - y0) * mi.Float64(along)
        exact = y - mi.Vector3d(origin)
        sides = _sides(rays, self.inputs, edge, exact)
        aside = _BESIDE * (dr.norm(y) + dr.norm(y1 - y0))
        beside, away = mi.Point3f(y + sides.outwards * aside), mi.Vector3f(exact)
        reach = beside - away * _BEFORE if self.close else beside
        before = passage(rays, self.inputs, reach, origin, pmf > 0)
        valid = (pmf > 0) & (before.transmittance > 0) & sides.unlike
        key = index, self.dice
        hit = _ahead(
            rays, self.inputs, (edge, along), beside, away, valid, key, close=self.close,
            dealt=index,
        )  # fmt: skip
        valid &= hit.valid & _not_grazing(rays, hit.face, away, hit.valid)
        valid &= rays.in_scene(frame, hit.face, hit.valid)
        if rays.movers is not None:
            valid &= rays.movers.has_edge(edge) | rays.movers.has_face(hit.face, hit.valid)
        # Last, since it takes longest: packets without a shadow spare it.
        near = _MISSED * dr.norm(exact)
        valid &= ~folded(rays, edge, y, exact, sides.outwards, aside, near, valid)
        found = EdgePoints(
            index, receiver, frame, first, second, sides.side, along, hit.face,
            weight=1 / (pmf * self.size * hit.chance),
            transmittance=before.transmittance * hit.transmittance,
            extra=before.extra + hit.extra,
            open=sides.open, open_extra=sides.open_extra,
            covered=sides.covered, covered_extra=sides.covered_extra,
        )  # fmt: skip
        return Drawn(valid, (found,), lambda points: points)


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
        if self.weighted and rays.movers is not None and rays.scenes == 1:
            omega, density = self._aimed(rays.movers, index, edge, place, omega, density)
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
        if rays.movers is not None:
            moves = rays.movers.has_edge(edge)
            for hit in hits:
                moves |= rays.movers.has_face(hit.face, hit.valid)
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


def place_along(
    choice: Proportional, index: Any, count: int, seed: Any, key: Any = None
) -> tuple[Any, Any, Any]:
    """Entry of the choice, place along its edge and probability, stratified over count.

    Args:
        choice: Of edges.
        index: Number of the sample.
        count: Of samples.
        seed: Of the numbers.
        key: What the numbers belong to, if not the index.
    """
    jitter, along = uniform_pair(index if key is None else key, seed)
    place, rest, chance = choice.draw((mi.Float(index) + jitter) / count)
    return place, dr.select(chance > _RESOLVED, rest, along), chance


@dataclass(frozen=True)
class _Sides:
    """What an edge's triangles let through on either side of a direction; see ``EdgePoints``."""

    side: Any
    open: Any
    open_extra: Any
    covered: Any
    covered_extra: Any
    outwards: Any  # unit direction off the covered side; zero where there is something on both

    @property
    def step(self) -> Any:
        """How much of what passes changes from side to side; little where only its length does."""
        return dr.abs(self.open - self.covered) + 0.05 * (self.open + self.covered)

    @property
    def unlike(self) -> Any:
        """Whether the sides differ by more than rounding."""
        same_length = dr.abs(self.open_extra - self.covered_extra) <= 1e-7
        return ~((dr.abs(self.open - self.covered) <= 1e-6) & same_length)


def _sides(rays: RayScene, inputs: Inputs, edge: Any, direction: Any) -> _Sides:
    """Sort an edge's triangles by the side of the plane through edge and direction they lie on.

    An opaque edge is a silhouette if nothing is on one side. In float64: the triangles of a fine
    mesh are nearly edge-on where they end a shadow.
    """
    topology = rays.topology
    y0, y1 = rays.exact_ends(edge)
    plane = dr.cross(direction, y1 - y0)
    offsets, heights = [], []
    most = mi.Float64(0.0)
    for column in topology.device_opposite:
        apex = dr.gather(mi.Int32, column, edge)
        offset = rays.exact(mi.UInt32(dr.maximum(apex, 0))) - y0
        height = dr.select(apex >= 0, dr.dot(plane, offset), 0.0)
        # Squares, since Dr.Jit 1.5 drops the abs of a select on an abs.
        most = dr.select(dr.square(height) > dr.square(most), height, most)
        offsets.append(offset)
        heights.append(height)
    transmittances, lengths = [mi.Float(1.0), mi.Float(1.0)], [mi.Float(0.0), mi.Float(0.0)]
    for number, (offset, height) in enumerate(zip(offsets, heights, strict=True)):
        transmittance, extra = mi.Float(0.0), mi.Float(0.0)
        if inputs.surfaces.sheets:
            face = dr.gather(mi.UInt32, topology.device_beside[number], edge)
            row = dr.gather(mi.UInt32, inputs.face_surface, face)
            normal = dr.cross(y1 - y0, offset)
            cosine = dr.abs(dr.dot(normal, direction)) / (dr.norm(normal) * dr.norm(direction))
            transmittance, extra = inputs.surfaces.through(row, mi.Float(cosine), height != 0)
        for index, on in enumerate((height * most < 0, height * most > 0)):
            transmittances[index] = dr.select(
                on, transmittances[index] * transmittance, transmittances[index]
            )
            lengths[index] = dr.select(on, lengths[index] + extra, lengths[index])
    free = (transmittances[0] == 1) & (lengths[0] == 0)
    outwards = dr.select(free, -dr.mulsign(dr.normalize(plane), most), 0.0)
    return _Sides(
        mi.Float(dr.sign(most)),
        transmittances[0],
        lengths[0],
        transmittances[1],
        lengths[1],
        mi.Vector3d(outwards),
    )


def _ahead(
    rays: RayScene,
    inputs: Inputs,
    place: tuple[Any, Any],
    beside: Any,
    way: Any,
    active: Any,
    key: tuple[Any, Any],
    *,
    close: bool,
    dealt: Any = None,
) -> Hit:
    """What lies behind points on edges.

    Where surfaces are close the ray starts before the edge, so that it meets those in which the
    edge lies; whether the edge is before them is decided in float64. In one that it has crossed, it
    hides nothing: there the curve of the crossing counts. Rays are traced one by one, since Embree
    loses some of those of a bundle that start close to a surface.

    Args:
        rays: Rays.
        inputs: Detached.
        place: Edges, and where along them.
        beside: From where rays start, off the edge.
        way: Their directions, as long as the edge is far away.
        active: Lanes.
        key: See ``land``.
        close: Whether other surfaces may be close to edges.
        dealt: See ``land``.
    """
    towards, distance = dr.normalize(way), dr.norm(way)
    past = mi.Ray3f(mi.Point3f(beside + way * NEAR), mi.Vector3f(towards))
    if not close:
        return land(rays, inputs, past, active, key, coherent=False, dealt=dealt)
    early = mi.Ray3f(mi.Point3f(beside - way * _BEFORE), mi.Vector3f(towards))
    hit = land(rays, inputs, early, active, key, coherent=False, dealt=dealt)
    point = between(rays.corners(hit.face, hit.valid), hit.b1, hit.b2)
    near = hit.valid & (dr.norm(point - beside) < 2 * _BEFORE * distance)
    edge, along = place
    own = mi.Bool(False)
    for beside_edge, apex in zip(
        rays.topology.device_beside, rays.topology.device_opposite, strict=True
    ):
        is_there = dr.gather(mi.Int32, apex, edge) >= 0
        own |= is_there & (dr.gather(mi.UInt32, beside_edge, edge) == hit.face)
    own &= near
    y0, y1 = rays.exact_ends(edge)
    p0, p1, p2 = map(rays.exact, dr.gather(mi.Vector3u, rays.topology.device_faces, hit.face))
    normal = dr.normalize(dr.cross(p1 - p0, p2 - p0))
    height = dr.dot(normal, y0 + (y1 - y0) * mi.Float64(along) - p0)
    crossed = -dr.mulsign(height, dr.dot(normal, mi.Vector3d(way))) < -IN_PLANE
    again = land(rays, inputs, past, active & own, key, coherent=False, dealt=dealt)
    pairs = zip(vars(again).values(), vars(hit).values(), strict=True)
    hit = Hit(*(dr.select(own, second, first) for second, first in pairs))
    return replace(hit, valid=hit.valid & ~(near & ~own & crossed))


def _not_grazing(rays: RayScene, face: Any, direction: Any, active: Any) -> Any:
    """A ray in the plane of the triangle it meets has no shadow point there."""
    p0, p1, p2 = rays.corners(face, active)
    normal = dr.normalize(dr.cross(p1 - p0, p2 - p0))
    return active & (dr.abs(dr.dot(normal, direction)) > _GRAZING * dr.norm(direction))


def shadow_speed(inputs: Inputs, points: EdgePoints, centre: Any) -> Shadow:
    """How fast the shadow that an edge casts from an attached centre sweeps a surface.

    ``T · (x_c − x_m)``: x_c is where the attached ray meets the attached plane behind the edge,
    x_m the material point under it; T is the edge's image turned to the shadowed side.
    Source: derivations §3.

    Args:
        inputs: Attached tables.
        points: On edges.
        centre: From where the shadow is cast, attached.
    """
    c, fixed = centre, inputs.detached()
    y0, y1 = integrand.edge_ends(inputs, points.first, points.second)
    y = y0 + (y1 - y0) * points.along
    triangle = p0, p1, p2 = integrand.corners(inputs, points.face)
    plane = dr.cross(p1 - p0, p2 - p0)
    moving = c + (y - c) * (dr.dot(plane, p0 - c) / dr.dot(plane, y - c))

    f0, f1, f2 = integrand.corners(fixed, points.face)
    shadow, normal = dr.detach(moving), dr.normalize(dr.cross(f1 - f0, f2 - f0))
    b1, b2 = barycentric(shadow, f0, f1, f2)
    material = between(triangle, b1, b2)

    ray, edge = dr.detach(y - c), dr.detach(y1 - y0)
    stretch = dr.norm(shadow - dr.detach(c)) / dr.norm(ray)
    slope = 1 / dr.dot(normal, ray)

    def projected(vector: Any) -> Any:
        return stretch * (vector - ray * (dr.dot(normal, vector) * slope))

    tangent = dr.mulsign(dr.cross(normal, projected(edge)), points.side * slope)
    return Shadow(b1, b2, dr.dot(tangent, moving - material) * points.weight)


def barycentric(point: Any, p0: Any, p1: Any, p2: Any) -> tuple[Any, Any]:
    """Coordinates b1 and b2 of a point in the plane of a triangle.

    Args:
        point: The point.
        p0, p1, p2: Corners.
    """
    a, b, r = p1 - p0, p2 - p0, point - p0
    aa, ab, bb, ra, rb = dr.dot(a, a), dr.dot(a, b), dr.dot(b, b), dr.dot(r, a), dr.dot(r, b)
    determinant = dr.fma(aa, bb, -ab * ab)
    return (bb * ra - ab * rb) / determinant, (aa * rb - ab * ra) / determinant
