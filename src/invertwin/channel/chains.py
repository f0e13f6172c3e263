"""Chains of surface points in torch, float64: the slow twin of the walk, and what data are made of.

A chain is a row of material points. Its power is the radar equation of the chain; as a field it is
the square root of that, with a phase of its own (derivations §4). Nothing here draws anew what it
has drawn: chains are fixed, so that a realisation stays while radar and scene move.
"""

from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from invertwin.channel import kernel, walk
from invertwin.channel.bridge import Geometry, flatten, to_float, to_torch, tracer, use_backend
from invertwin.channel.paths import Link
from invertwin.channel.rays import Shot, face_areas, next_surface, scrambled, uniform_pair, visible
from invertwin.scene.scene import Scene

_MOST_SHEETS = 8  # that a segment of an explicit path may pass


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
class RoughChains:
    """The fixed chains of rough multiple scattering, from two points up.

    Attributes:
        chains: By number of points, starting with two.
    """

    chains: tuple[Chain, ...]


def rough_chains(
    scene: Scene, link: Link, *, count: int, depth: int, seed: int, backend: str | None = None
) -> RoughChains:
    """Draw the chains that rough surfaces scatter along, once for all frames.

    The first point is spread over the surfaces, every object alike; the next ones follow the
    lobes and aim at other objects. The antennas only suggest directions: nothing is lost that
    another pose could see.

    Args:
        scene: Surfaces.
        link: Antennas, whose mean place is where lobes are taken to be lit from.
        count: Chains to draw, of each length.
        depth: Most points of a chain.
        seed: Of places and phases.
        backend: See ``deposit_power``.

    Source: derivations §4 (one independent phase per ordered chain).
    """
    import drjit as dr

    if depth < 2:
        return RoughChains(())
    with use_backend(backend):
        mi = tracer()
        geometry = flatten(scene, link.wavelength, in_motion=True)
        shot = Shot(geometry, link)
        inputs = kernel.Inputs.of(geometry, link, shot, monostatic=False)
        areas = face_areas(geometry)
        owners = torch.zeros(len(geometry.coherent), dtype=torch.float64)
        owners = owners.index_add(0, geometry.face_object, areas)
        share = areas / owners[geometry.face_object] / len(owners)
        index = dr.arange(mi.UInt32, count)
        place, side = uniform_pair(index, scrambled(seed, 12))
        spread = (mi.Float(index) + place) / count
        face, pmf = mi.DiscreteDistribution(to_float(share)).sample_pmf(spread)
        b = mi.warp.square_to_uniform_triangle(
            mi.Point2f(*uniform_pair(index, scrambled(seed, 13)))
        )
        point = kernel.place(inputs, face, b.x, b.y)
        back, distance = kernel.leg(point.position, mi.Point3f(0.0))
        turned = back - 2 * dr.dot(back, point.normal) * point.normal
        back = dr.select(side < 0.5, back, turned)
        area = dr.gather(mi.Float, to_float(areas), face)
        state = walk.start(
            index, mi.UInt32(0) * index, face, b.x, b.y, back, dr.ones(mi.Float, count), distance
        )
        state["weight"] = 2 * area / (pmf * count)
        columns: list[list[Tensor]] = []
        chain = walk.Walk(shot, inputs, seed)
        for number in range(1, depth + 1):
            names = ("face", "b1", "b2", "weight", "active")
            dr.eval(*(state[name] for name in names))
            columns.append([to_torch(state[name]) for name in names])
            if number < depth:
                state = chain.step(state)
        generator = torch.Generator().manual_seed(seed)
        chains = []
        for number in range(2, depth + 1):
            alive = columns[number - 1][4].bool()
            faces, b1, b2 = (
                torch.stack([columns[k][c] for k in range(number)], dim=1)[alive] for c in range(3)
            )
            phase = 2 * torch.pi * torch.rand(count, generator=generator, dtype=torch.float64)
            weight = columns[number - 1][3].double()[alive]
            chains.append(Chain(faces.long(), b1.double(), b2.double(), weight, phase[alive]))
        return RoughChains(tuple(chains))
