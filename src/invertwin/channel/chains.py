"""Chains of surface points in torch, float64: the slow twin of the walk, and what data are made of.

A chain is a row of material points. Its power is the radar equation of the chain; as a field it is
the square root of that, with a phase of its own (derivations §4). Nothing here draws anew what it
has drawn: chains are fixed, so that a realisation stays while radar and scene move.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from invertwin.channel import kernel, walk
from invertwin.channel.bridge import (
    Geometry,
    flatten,
    opaque,
    to_float,
    to_index,
    to_torch,
    tracer,
)
from invertwin.channel.paths import Link
from invertwin.channel.rays import Shot, face_areas, next_surface, scrambled, uniform_pair, visible
from invertwin.scene.scene import Scene

_MOST_SHEETS = 8  # that a segment of an explicit path may pass

# How rough chains are drawn.
_LANES = 1 << 18  # walked at a time
_KEPT = 0.25  # of the chains that are drawn; the others carry little
_REFERENCES = 8  # frames that say how much a chain carries
_ALIKE = 0.5  # share of the draws that goes to all sequences of objects alike
_BLIND = 0.1  # share that goes to chains whatever the reference frames see of them
_AWAY = 0.125  # share of the first points that are lit from the side the antennas do not see


@dataclass(frozen=True)
class Chain:
    """Chains of one length: material points in order from the transmitter, one row a chain.

    Attributes:
        face, b1, b2: Places, per vertex.
        weight: One over (chains × density per area of all vertices).
        phase: Of the chain's field [rad].
    """

    face: Int64[Tensor, "n k"]
    b1: Float64[Tensor, "n k"]
    b2: Float64[Tensor, "n k"]
    weight: Float64[Tensor, " n"]
    phase: Float64[Tensor, " n"]

    def keep(self, mask: Bool[Tensor, " n"]) -> "Chain":
        """Some of the rows."""
        return Chain(*(column[mask] for column in vars(self).values()))


@dataclass(frozen=True)
class ChainView:
    """What chains carry from the transmitter to the receiver, attached.

    Attributes:
        power: Received over transmitted power per m² of every vertex; Jacobians included.
        ending: The factor of the last point and its leg to the receiver, detached.
        length: From antenna to antenna [m].
        first, last: World positions of the ends [m].
    """

    power: Float64[Tensor, " n"]
    ending: Float64[Tensor, " n"]
    length: Float64[Tensor, " n"]
    first: Float64[Tensor, "n 3"]
    last: Float64[Tensor, "n 3"]


def chain_view(
    geometry: Geometry, link: Link, shot: Shot, frame: Int64[Tensor, " n"], chain: Chain
) -> ChainView:
    """Evaluate the radar equation along chains; those that are blocked carry nothing."""
    places = [_place(geometry, chain, k) for k in range(chain.face.shape[1])]
    rows = [geometry.face_surface[column] for column in chain.face.T]
    stops = [link.tx[frame], *(p for p, _, _ in places), link.rx[frame]]
    power = torch.full_like(chain.weight, (link.wavelength / (4 * torch.pi)) ** 2)
    length, ending = torch.zeros_like(power), torch.ones_like(power)
    for number, (start, end) in enumerate(pairwise(stops)):
        distance = (end - start).norm(dim=1)
        last = number == len(places)
        if last and link.shared_visibility and len(places) == 1:
            share, excess = passed(geometry, shot, end, start) if geometry.sheets else (1.0, 0.0)
        else:
            share, excess = passed(geometry, shot, start, end)
        index = 1.0
        if geometry.bodies and 0 < number < len(places):
            normals = places[number - 1][1], places[number][1]
            towards = (end - start) / distance[:, None]
            index, attenuation = _medium(
                geometry, (rows[number - 1], rows[number]), normals, towards
            )
            power = power * torch.exp(-attenuation * distance)
        power = power * share / distance**2
        length = length + index * distance + excess
        ending = share / distance**2
    for number, (position, normal, jacobian) in enumerate(places):
        row = rows[number]
        back, on = (
            torch.nn.functional.normalize(stop - position, dim=1)
            for stop in (stops[number], stops[number + 2])
        )
        scattered = _scattered(geometry, row, normal, back, on)
        power = power * jacobian * scattered
    for antenna, pattern, stop in (
        (link.tx[frame], link.tx_pattern, stops[1]),
        (link.rx[frame], link.rx_pattern, stops[-2]),
    ):
        direction = torch.nn.functional.normalize(stop - antenna, dim=1)
        seen = torch.einsum("nij,ni->nj", link.rotations[frame], direction)
        gain = pattern.gain(seen)
        power = power * gain
    ending = (ending * scattered * gain).detach()
    return ChainView(power, ending, length, stops[1], stops[-2])


def _place(geometry: Geometry, chain: Chain, number: int) -> tuple[Tensor, Tensor, Tensor]:
    """Attached position, unit normal, and Jacobian of the area."""
    p0, p1, p2 = geometry.corners(chain.face[:, number])
    b1, b2 = chain.b1[:, number, None], chain.b2[:, number, None]
    normal = torch.linalg.cross(p1 - p0, p2 - p0)
    double_area = normal.norm(dim=1)
    jacobian = double_area / double_area.detach()
    return p0 * (1 - b1 - b2) + p1 * b1 + p2 * b2, normal / double_area[:, None], jacobian


def _scattered(geometry: Geometry, row: Tensor, normal: Tensor, back: Tensor, on: Tensor) -> Tensor:
    """``f |cosθ| |cosθ'|`` on one side, or through the skin of a body (see ``kernel``)."""
    first, second, between = ((a * b).sum(1) for a, b in ((normal, back), (normal, on), (back, on)))
    product = first * second
    shape = geometry.diffuse[row] / torch.pi
    for number, cosine in enumerate((2 * product - between, 2 * product - between, between)):
        half = (0.5 * (1 + cosine)).clamp_min(1e-7)
        lobe = half ** geometry.exponents[row, number]
        shape = shape + geometry.lobes[row, number] * lobe
    outer = [_outside(geometry, row, cosine) for cosine in (first, second)]
    reflectance = torch.ones_like(product)
    for cosine, total in outer:
        amplitude = tabulated(geometry.amplitude, row, cosine)
        reflectance = reflectance * torch.where(total, 1.0, amplitude)
    value = torch.where(product > 0, reflectance * shape * product, 0.0)
    if not geometry.bodies:
        return value
    variance = 2 / geometry.exponents[row, 0].clamp_min(1.0)
    share, index = torch.ones_like(product), torch.ones_like(product)
    mismatch = torch.zeros_like(normal)
    for (cosine, total), direction, tilt in zip(outer, (back, on), (first, second), strict=True):
        passing = tabulated(geometry.refraction, row, cosine)
        open_ = ~total & (passing > 0)
        share = share * torch.where(open_, torch.where(open_, passing, 1.0).sqrt(), 0.0)
        index = torch.where(tilt < 0, geometry.index[row], 1.0)
        mismatch = mismatch + index[:, None] * (direction - normal * tilt[:, None])
    lobe = torch.exp(-mismatch.square().sum(1) / (2 * variance)) / (2 * torch.pi * variance)
    through = share * index**2 * lobe * product.abs()
    return torch.where(product < 0, through, value)


def _outside(geometry: Geometry, row: Tensor, cosine: Tensor) -> tuple[Tensor, Tensor]:
    """Cosine on the outer side of a skin (Snell), and whether there is none."""
    if not geometry.bodies:
        return cosine, torch.zeros_like(cosine, dtype=torch.bool)
    inside = cosine < 0
    square = 1 - geometry.index[row] ** 2 * (1 - cosine**2)
    total = inside & (square <= 1e-6)
    refracted = torch.where(inside & ~total, square, 1.0).sqrt()
    return torch.where(inside, refracted, cosine), total


def _medium(
    geometry: Geometry, rows: tuple[Tensor, Tensor], normals: tuple[Tensor, Tensor], towards: Tensor
) -> tuple[Tensor, Tensor]:
    """Refractive index and attenuation of what lies between two points."""
    index, attenuation = torch.ones(len(towards)).double(), torch.zeros(len(towards)).double()
    for row, normal, sign in zip(rows, normals, (1.0, -1.0), strict=True):
        inside = ((normal * towards).sum(1) * sign < 0) & (geometry.refraction[row, -1] > 0)
        index = torch.where(inside, geometry.index[row], index)
        attenuation = torch.where(inside, geometry.attenuation[row], attenuation)
    return index, attenuation


def tabulated(
    table: Float64[Tensor, "row cos"], row: Int64[Tensor, " n"], cosine: Float64[Tensor, " n"]
) -> Float64[Tensor, " n"]:
    """A table over |cosθ|, linear between its entries."""
    entries = table.shape[1]
    t = cosine.abs().clamp_max(1.0) * (entries - 1)
    low = t.detach().long().clamp_max(entries - 2)
    first, second = table[row, low], table[row, low + 1]
    return first + (second - first) * (t - low)


def passed(
    geometry: Geometry, shot: Shot, start: Float64[Tensor, "n 3"], end: Float64[Tensor, "n 3"]
) -> tuple[Float64[Tensor, " n"], Float64[Tensor, " n"]]:
    """Share of the power that gets from point to point, and the length that sheets add [m]."""
    if not geometry.sheets:
        clear = visible(shot, start, end).to(start)
        return clear, torch.zeros_like(clear)
    share = torch.ones(len(start), dtype=torch.float64)
    excess = torch.zeros_like(share)
    at = torch.zeros_like(share)
    rows = torch.arange(len(start))
    offset = end - start
    for _ in range(_MOST_SHEETS + 1):
        if not len(rows):
            break
        fixed = start.detach()[rows] + offset.detach()[rows] * at[rows, None]
        hit, step = next_surface(shot, fixed, end.detach()[rows])
        rows, hit, step = rows[hit >= 0], hit[hit >= 0], step[hit >= 0]
        at = at.index_add(0, rows, step * (1 - at[rows]))
        row = geometry.face_surface[hit]
        p0, p1, p2 = geometry.corners(hit)
        normal = torch.nn.functional.normalize(torch.linalg.cross(p1 - p0, p2 - p0), dim=1)
        cosine = (normal * torch.nn.functional.normalize(offset[rows], dim=1)).sum(1)
        factor = torch.ones_like(share).index_copy(
            0, rows, tabulated(geometry.transmittance, row, cosine)
        )
        share = share * factor
        excess = excess.index_add(0, rows, tabulated(geometry.excess, row, cosine))
        rows = rows[share.detach()[rows] > 0]
    return share * torch.ones_like(share).index_fill(0, rows, 0.0), excess


@dataclass(frozen=True)
class RoughPaths:
    """The fixed chains of rough multiple scattering, from two points up.

    Attributes:
        chains: By number of points, starting with two.
    """

    chains: tuple[Chain, ...]


def rough_chains(scene: Scene, link: Link, *, count: int, depth: int, seed: int) -> RoughPaths:
    """Draw the chains that rough surfaces scatter along, once for all frames.

    The first point is spread over the surfaces, every object alike; the next ones follow the
    lobes and aim at other objects. After every point, chains that bring much to their last
    point go on several times and others by chance; of whole chains, the strong ones are kept.
    Every sequence of objects gets its share, so that a weak echo that takes a narrow way, by a
    wall to a hidden object and back, is made of many chains, too. One over the chance goes into
    the weight: the expected power is that of all chains. The antennas only suggest what is worth
    while: nothing is lost that another pose could see.

    Args:
        scene: Surfaces.
        link: Antennas, of which a few frames say what a chain is worth.
        count: Chains to draw, of each length; at most a quarter of them are kept.
        depth: Most points of a chain.
        seed: Of places and phases.

    Source: derivations §4 (one independent phase per ordered chain).
    """
    if depth < 2:
        return RoughPaths(())
    with torch.no_grad():
        drawer = _Drawer(flatten(scene, link.wavelength, in_motion=True), link, seed)
        rounds = -(-count // _LANES)
        parts = [drawer.draw(turn, count // rounds, depth) for turn in range(rounds)]
        return RoughPaths(tuple(map(drawer.joined, zip(*parts, strict=True))))


class _Drawer:
    """Walks chains, and draws again from them where they carry power (splitting and roulette)."""

    def __init__(self, geometry: Geometry, link: Link, seed: int) -> None:
        self.geometry, self.link = geometry, link
        self.shot = Shot(geometry, link)
        self.inputs = kernel.Inputs.of(geometry, link, self.shot, monostatic=False)
        self.walk = walk.Walk(self.shot, self.inputs, seed)
        self.seeds = scrambled(seed, 12), scrambled(seed, 13)
        self.generator = torch.Generator().manual_seed(seed)
        areas = face_areas(geometry)
        owners = torch.zeros(len(geometry.coherent), dtype=torch.float64)
        owners = owners.index_add(0, geometry.face_object, areas)
        share = areas / owners[geometry.face_object] / len(owners)
        self.areas = to_float(areas)
        self.faces = tracer().DiscreteDistribution(to_float(share))
        frames = torch.linspace(0, link.frame_count - 1, min(link.frame_count, _REFERENCES))
        self.frames = frames.round().long()

    def draw(self, turn: int, lanes: int, depth: int) -> list[Chain]:
        """Chains of two points and more, without phases, of one of the rounds."""
        state = self._started(turn * lanes, lanes)
        places: list[Tensor] = []
        found = []
        for number in range(1, depth + 1):
            if number > 1:
                state = self.walk.step(state)
            places, alive, chain = self._walked(state, places)
            if number > 1:
                chance = self._shares(chain, received=True) * (lanes * _KEPT)
                chance = chance.clamp_max(1.0)
                found.append(
                    replace(chain, weight=chain.weight / chance).keep(
                        self._random(len(chance)) < chance
                    )
                )
            if number < depth and len(alive):
                shares = self._shares(chain, received=False)
                drawn = (torch.arange(lanes) + self._random(1)) / lanes
                row = torch.searchsorted(shares.cumsum(0), drawn).clamp_max(len(alive) - 1)
                weight = chain.weight[row] / (shares[row] * lanes)
                places = [column[row] for column in (chain.face, chain.b1, chain.b2)]
                state = self._again(state, alive[row], weight)
        return found

    def joined(self, parts: tuple[Chain, ...]) -> Chain:
        """Chains of one length from all rounds, each with a phase."""
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        face, b1, b2, weight, _ = (torch.cat(column) for column in columns)
        phase = 2 * torch.pi * self._random(len(weight))
        return Chain(face, b1, b2, weight / len(parts), phase)

    def _random(self, count: int) -> Tensor:
        return torch.rand(count, generator=self.generator, dtype=torch.float64)

    def _started(self, start: int, lanes: int) -> walk.State:
        """First points, and for each a reference frame that lights it, or its mirror image."""
        import drjit as dr

        mi = tracer()
        lane = dr.arange(mi.UInt32, lanes)
        index = lane + opaque(start)
        place, side = uniform_pair(index, self.seeds[0])
        face, pmf = self.faces.sample_pmf((mi.Float(lane) + place) / lanes)
        b = mi.warp.square_to_uniform_triangle(mi.Point2f(*uniform_pair(index, self.seeds[1])))
        point = kernel.place(self.inputs, face, b.x, b.y)
        frame = dr.gather(mi.UInt32, to_index(self.frames), index % opaque(len(self.frames)))
        back, distance = kernel.leg(point.position, self.inputs.antenna(frame, False))
        turned = back - 2 * dr.dot(back, point.normal) * point.normal
        back = dr.select(side < _AWAY, turned, back)
        state = walk.start(index, frame, face, b.x, b.y, back, dr.ones(mi.Float, lanes), distance)
        area = dr.gather(mi.Float, self.areas, face)
        state["weight"] = area / (pmf * lanes * dr.select(side < _AWAY, _AWAY, 1 - _AWAY))
        return state

    def _walked(
        self, state: walk.State, before: list[Tensor]
    ) -> tuple[list[Tensor], Tensor, Chain]:
        """Places of all lanes' points, the lanes that are alive, and their chains."""
        import drjit as dr

        names = ("face", "b1", "b2", "weight", "active")
        dr.eval(*(state[name] for name in names))
        *latest, weight, active = (to_torch(state[name]) for name in names)
        places = [latest[0].long()[:, None], *(b.double()[:, None] for b in latest[1:])]
        if before:
            places = [torch.cat(pair, dim=1) for pair in zip(before, places, strict=True)]
        alive = active.bool().nonzero()[:, 0]
        face, b1, b2 = (column[alive] for column in places)
        weight = weight.double()[alive]
        return places, alive, Chain(face, b1, b2, weight, torch.zeros_like(weight))

    def _again(self, state: walk.State, parent: Tensor, weight: Tensor) -> walk.State:
        """Lanes that go on from others; each has its own number, and so its own way."""
        import drjit as dr

        mi = tracer()
        at = to_index(parent)
        columns = {
            name: dr.gather(type(column), column, at)
            if name != "back"
            else mi.Vector3f(*(dr.gather(mi.Float, column[k], at) for k in range(3)))
            for name, column in state.items()
            if name in ("face", "b1", "b2", "back", "number")
        }
        return {
            **state,
            **columns,
            "weight": to_float(weight),
            "active": dr.full(mi.Bool, True, len(parent)),
        }

    def _shares(self, chain: Chain, *, received: bool) -> Tensor:
        """How the draws are shared among chains: by their power, and by sequences of objects."""
        if not len(chain.weight):
            return chain.weight
        power = chain.weight * self._power(chain, received=received)
        blind = chain.weight / chain.weight.sum()
        total = power.sum()
        if not total > 0:
            return blind
        objects = self.geometry.face_object[chain.face]
        base = len(self.geometry.coherent) ** torch.arange(objects.shape[1])
        _, family = (objects * base).sum(1).unique(return_inverse=True)
        sums = torch.zeros(int(family.max()) + 1, dtype=torch.float64).index_add(0, family, power)
        seen = int((sums > 0).sum())
        alike = power / sums.clamp_min(1e-300)[family] / seen
        return _BLIND * blind + (1 - _BLIND) * (_ALIKE * alike + (1 - _ALIKE) * power / total)

    def _power(self, chain: Chain, *, received: bool) -> Tensor:
        """Power at the receiver or the last point, the mean of the reference frames.

        What lies between points is left out: it only makes the draw less good.
        """
        places = [_place(self.geometry, chain, k) for k in range(chain.face.shape[1])]
        rows = [self.geometry.face_surface[column] for column in chain.face.T]
        points, normals = [p for p, _, _ in places], [n for _, n, _ in places]
        legs = [end - start for start, end in pairwise(points)]
        middle = torch.ones_like(chain.weight)
        for leg in legs:
            middle = middle / leg.square().sum(1)
        ways = [leg / leg.norm(dim=1, keepdim=True) for leg in legs]
        for k in range(1, len(points) - 1):
            middle = middle * _scattered(self.geometry, rows[k], normals[k], -ways[k - 1], ways[k])
        if legs and not received:
            middle = middle * (normals[-1] * ways[-1]).sum(1).abs()
        total = torch.zeros_like(middle)
        link = self.link
        for number in self.frames.tolist():
            value = middle
            tx, rx = link.tx[number].detach(), link.rx[number].detach()
            to_tx = torch.nn.functional.normalize(tx - points[0], dim=1)
            if legs:
                value = value * _scattered(self.geometry, rows[0], normals[0], to_tx, ways[0])
            else:
                value = value * (normals[0] * to_tx).sum(1).abs()
            ends = [(tx, points[0], link.tx_pattern)]
            if received:
                to_rx = torch.nn.functional.normalize(rx - points[-1], dim=1)
                value = value * _scattered(self.geometry, rows[-1], normals[-1], -ways[-1], to_rx)
                ends.append((rx, points[-1], link.rx_pattern))
            for antenna, point, pattern in ends:
                offset = point - antenna
                distance = offset.norm(dim=1)
                gain = pattern.gain(offset / distance[:, None] @ link.rotations[number].detach())
                value = value * gain / distance**2
                lit = value > 0
                share, _ = passed(
                    self.geometry, self.shot, antenna.expand(int(lit.sum()), 3), point[lit]
                )
                value = value.masked_scatter(lit, value[lit] * share)
            total = total + value
        return total / len(self.frames)
