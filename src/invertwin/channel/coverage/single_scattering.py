"""Power that a rough surface scatters once, on ways that smooth surfaces mirror.

A path is mirrored, or passes sheets, on its way to a point of a rough surface, and again on its way
from there. With one coefficient for each way,

    P = ∫ (4π/λ)² |a_out|² |a_home|² f |cosθ| |cosθ'| dA,

summed over all pairs of ways that have a mirror among them. Those without one are power paths of
one bounce (``channel.power``). Points are material points, so what moves adds boundary paths: a
region that one way lights ends at the rims of ``shadow_edges``, and there the integrand jumps.

Source: derivations §3, §10 and §11.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor
from torch._C import _DisableFuncTorch
from torch.nn.functional import normalize
from torch.utils.checkpoint import checkpoint

from invertwin.channel.coherent.radar_equation import Place, SurfacePaths, scattered
from invertwin.channel.coverage.shadow_boundaries import OwnSurfaces, rim_points, rims
from invertwin.channel.em.plane_waves import dot
from invertwin.channel.paths import Link
from invertwin.channel.rays.backend import torch_threads, tracing
from invertwin.channel.rays.intersections import contacts_of
from invertwin.channel.rays.ray_scene import RayScene, face_areas
from invertwin.channel.rays.scene_tables import Geometry, flatten
from invertwin.channel.sampling import Sampling
from invertwin.channel.specular.candidates import every_sequence, sequences_from_edges
from invertwin.channel.specular.image_method import Chains, Walls, chains_from
from invertwin.channel.specular.ray_paths import REFLECTION, RayPaths, joined, joint
from invertwin.channel.specular.trace_paths import Stage, paths_of, powers_of, staged
from invertwin.checks import ArrayLike, differentiated, plain
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.scene import Isotropic
from invertwin.scene.scene import Scene

_AT_ONCE = 1 << 14  # points
_SAMPLES = 16  # rays of power paths that cost as much as a point here
_PLASTIC = (0.754_877_666_246_692_8, 0.569_840_290_998_053_3)  # steps of an even plane sequence

#: Takes ways from transmitters and from receivers to the same points, the share of power that
#: changes its polarisation there, and the places of transmitters and receivers; returns what each
#: pair adds, ``[pair, amount]``.
Measure = Callable[[RayPaths, RayPaths, Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class _Points:
    """Points on rough surfaces, one row each; detached.

    Attributes:
        place: Number of the receiver that each is for.
        points: Their places, and the area that each stands for.
    """

    place: Int64[Tensor, " row"]
    points: SurfacePaths

    def rows(self, rows: Tensor) -> "_Points":
        return _Points(self.place[rows], self.points.keep(rows))


#: Which ways lead to some points: from transmitters, and from receivers; detached.
_Ways = tuple[list[Chains], list[Chains]]


def trace_scattered(
    scene: Scene,
    rough: Scene,
    tx: ArrayLike,
    rx: ArrayLike,
    frequency: float,
    measure: Measure,
    width: int,
    *,
    rays: int | None,
    sampling: Sampling,
    seed: int,
) -> Float64[Tensor, "tx rx amount"]:
    """Sums over paths that are scattered once, and mirrored at least once before or after.

    One point is drawn for every 16 of ``sampling.samples``, shared by all receivers.

    Args:
        scene: What mirrors, lets through and hides.
        rough: The same objects, as they scatter.
        tx: Transmitters [tx, 3] in the world [m].
        rx: Receivers [rx, 3] [m].
        frequency: Of the coefficients [Hz].
        measure: What a pair of ways adds, over the area and the scattering of its point.
        width: Numbers that it adds.
        rays: Shot from all transmitters together, and from all receivers, to find sequences of
            surfaces; None tries every one.
        sampling: How many points and, for derivatives, edge points; whether boundary paths and
            contacts count; ``depth``: most surfaces that a path meets, the rough one included.
        seed: Of all that is drawn.

    Raises:
        InputError: A derivative by what moves where a surface touches or cuts one that scatters.
    """
    still = (0.0, 0.0, 0.0)
    stage = replace(staged(scene, tx, rx, frequency, still, still), velocities=None)
    with tracing(sampling.backend), torch_threads(1):
        geometry = flatten(rough, SPEED_OF_LIGHT / frequency)
        trace = _Trace(stage, geometry, measure, width, rays, sampling, seed)
        if not trace.lit.any() or not any(map(len, trace.sequences[0] + trace.sequences[1])):
            return torch.zeros(len(stage.tx), len(stage.rx), width, dtype=torch.float64)
        total = trace.interior(stage, geometry)
        shapes = differentiated(stage.vertices)
        moved = shapes or differentiated(stage.tx) or differentiated(stage.rx)
        if sampling.boundary and sampling.boundary_samples and moved:
            if shapes and sampling.contacts:
                _require_apart(geometry, stage, trace.lit)
            total = total + trace.boundary(stage, geometry)
    return total


class _Trace:
    """Which paths there are, and what they are worth."""

    def __init__(
        self,
        stage: Stage,
        geometry: Geometry,
        measure: Measure,
        width: int,
        rays: int | None,
        sampling: Sampling,
        seed: int,
    ) -> None:
        self.measure, self.width, self.depth = measure, width, sampling.depth
        self.sampling, self.seed = sampling, seed
        self.ends = plain(stage.tx), plain(stage.rx)
        self.powers = powers_of(stage)
        # Discrete: to `torch.func`, tensors made on the way would be its own.
        with _DisableFuncTorch():
            rows = plain(geometry.surfaces.diffuse) > 0
            rows |= (plain(geometry.surfaces.lobes) > 0).any(1)
            rows &= (plain(geometry.surfaces.amplitude) > 0).any(1)
            self.lit: Bool[Tensor, " f"] = rows[geometry.face_surface]
            self.walls = Walls(plain(stage.vertices), stage.topology, torch.cat(self.ends))
            self.sequences = tuple(self._sequences(number, rays) for number in range(2))

    def _sequences(self, end: int, rays: int | None) -> tuple[Tensor, ...]:
        """What may lie between antennas of one end and rough points, by length from 1."""
        planes, most = self.walls.planes, self.depth - 1
        if most < 1 or not bool(self.powers.reflect.any()):
            return ()
        if rays is None:
            found = every_sequence(planes, self.powers, most).steps
            return tuple(steps for steps in found if len(steps))
        starts = self.ends[end][torch.arange(rays) % len(self.ends[end])]
        alike = torch.zeros(rays, dtype=torch.int64)
        drawn = sequences_from_edges(
            self.walls, planes, self.powers, starts, alike, most, self.seed + end
        )
        return tuple(steps[:, 1:] for steps in drawn if len(steps))

    def interior(self, stage: Stage, geometry: Geometry) -> Float64[Tensor, "tx rx amount"]:
        """At fixed visibility; a derivative computes the paths again, and keeps none."""
        with _DisableFuncTorch():
            drawn = self._drawn(replace(geometry, vertices=plain(geometry.vertices)))
        again = any(t.requires_grad for t in (stage.vertices, stage.tx, stage.rx))
        total = torch.zeros(len(stage.tx), len(stage.rx), self.width, dtype=torch.float64)
        for rows in torch.arange(len(drawn.place)).split(_AT_ONCE):
            part = drawn.rows(rows)
            places = plain(part.points.places(geometry)[0].position)
            face = part.points.face[:, 0]
            with _DisableFuncTorch():
                chains = self._ways(0, places, None, face), self._ways(1, places, part.place, face)

            def found(part: _Points = part, chains: _Ways = chains) -> Tensor:
                point = part.points.places(geometry)[0]
                area = part.points.weight * point.jacobian
                return self._added(self._pairs(stage, geometry, chains, point, area))

            total = total + (checkpoint(found, use_reentrant=False) if again else found())
        return total

    def boundary(self, stage: Stage, geometry: Geometry) -> Float64[Tensor, "tx rx amount"]:
        """What the moving rims of all regions add that ways light; zero in value."""
        samples, receivers = self.sampling.boundary_samples, len(stage.rx)
        total = torch.zeros(len(stage.tx), receivers, self.width, dtype=torch.float64)
        still = replace(
            stage, vertices=plain(stage.vertices), tx=plain(stage.tx), rx=plain(stage.rx)
        )
        corners = stage.vertices[stage.topology.faces]
        for end, count in enumerate((samples, -(-samples // receivers))):
            with _DisableFuncTorch():
                met = rim_points(
                    self.walls, OwnSurfaces(self.lit), self.ends[end], self.sequences[end],
                    self.powers, depth=self.depth - 1, samples=count, seed=self.seed + 2 + end,
                )  # fmt: skip
            for some in met:
                found = rims(self.walls, corners, some, (stage.tx, stage.rx)[end], stage.vertices)
                if not len(found.face):
                    continue
                with _DisableFuncTorch():
                    # Rims of a transmitter's regions serve the receivers in turn.
                    place = None if end else found.edge_point % receivers
                    others = self._ways(1 - end, found.place, place, found.face)
                chains = (others, [found.chains]) if end else ([found.chains], others)
                with torch.no_grad():
                    point = _place_at(geometry, found.place, found.face)
                    share = torch.full((len(found.face),), 1.0 if end else receivers).double()
                    jumps = self._pairs(still, geometry, chains, point, share)
                amount = plain(jumps.amount) * found.rate[jumps.row, None]
                total = total + self._added(replace(jumps, amount=amount))
        return total

    def _drawn(self, geometry: Geometry) -> _Points:
        """As many points for each receiver, spread evenly over all that scatters."""
        receivers = len(self.ends[1])
        count = max(1, self.sampling.samples // (_SAMPLES * receivers))
        reached = (face_areas(geometry) * self.lit).cumsum(0)
        numbers = np.random.default_rng(np.random.SeedSequence([self.seed, 4]))
        shift, jitter = (torch.from_numpy(numbers.random((k, receivers, 1))) for k in (2, 1))
        index = torch.arange(count)
        spot = ((index + jitter[0]) / count * reached[-1]).flatten()
        face = torch.searchsorted(reached, spot, right=True)
        face = face.clamp_max(int(torch.nonzero(self.lit)[-1]))
        b1, b2 = (
            ((start + index * step) % 1).flatten()
            for start, step in zip(shift, _PLASTIC, strict=True)
        )
        fold = b1 + b2 > 1
        b1, b2 = torch.where(fold, 1 - b1, b1), torch.where(fold, 1 - b2, b2)
        weight = torch.full_like(spot, float(reached[-1]) / count)
        points = SurfacePaths(face[:, None], b1[:, None], b2[:, None], weight, 0 * weight)
        return _Points(torch.arange(receivers).repeat_interleave(count), points)

    def _ways(
        self, end: int, points: Tensor, place: Int64[Tensor, " row"] | None, face: Tensor
    ) -> list[Chains]:
        """From all antennas of one end to points, or to each point from that of its number."""
        plane, sources = self.walls.planes.face_plane, self.ends[end]
        every = torch.ones(len(points), dtype=torch.int64)
        numbers = [place] if place is not None else [every * k for k in range(len(sources))]
        found: list[Chains] = []
        for steps in (torch.zeros(1, 0, dtype=torch.int64), *self.sequences[end]):
            for own in numbers:
                used, number = own.unique(return_inverse=True)
                for some in chains_from(
                    self.walls, steps, sources[used], number, points, plane[face]
                ):
                    # A point has no image in its own plane.
                    kept = torch.ones(len(some.target), dtype=torch.bool)
                    if steps.shape[1]:
                        kept = plane[some.faces[:, -1]] != plane[face[some.target]]
                    source, target, faces, through = (c[kept] for c in vars(some).values())
                    found.append(Chains(used[source], target, faces, through))
        return found

    def _pairs(
        self,
        stage: Stage,
        geometry: Geometry,
        chains: _Ways,
        point: Place,
        area: Float64[Tensor, " row"],
    ) -> "_Pairs":
        """What all pairs of ways to the same points bring, times an area of each point."""
        out, home = (
            joined([part for some in legs for part in paths_of(here, some)])
            for here, legs in zip(
                [_between(stage, end, point.position) for end in (stage.tx, stage.rx)],
                chains,
                strict=True,
            )
        )
        first, second = joint(out.rx, home.rx, len(area))
        mirrors, steps, side = (
            (values[0][first], values[1][second])
            for values in (
                [(leg.kinds == REFLECTION).any(1) for leg in (out, home)],
                [leg.depth for leg in (out, home)],
                [dot(plain(point.normal)[leg.rx], plain(leg.arrival)) > 0 for leg in (out, home)],
            )
        )
        kept = (mirrors[0] | mirrors[1]) & (steps[0] + steps[1] < self.depth)
        rows = torch.nonzero(kept & (side[0] == side[1]))[:, 0]
        out, home = out.chosen(first[rows]), home.chosen(second[rows])
        at = out.rx
        here = Place(point.position[at], point.normal[at], point.jacobian[at], point.row[at])
        k = 4 * math.pi * stage.frequency / SPEED_OF_LIGHT
        law = k**2 * area[at] * scattered(geometry, here, out.arrival, home.arrival)
        turned = geometry.surfaces.depolarisation[here.row]
        amount = law[:, None] * self.measure(out, home, turned, stage.tx, stage.rx)
        return _Pairs(out.tx, home.tx, at, amount)

    def _added(self, pairs: "_Pairs") -> Float64[Tensor, "tx rx amount"]:
        """Sums over the pairs of each link."""
        counts = [len(places) for places in self.ends]
        total = torch.zeros(counts[0] * counts[1], self.width, dtype=torch.float64)
        total = total.index_add(0, pairs.tx * counts[1] + pairs.rx, pairs.amount)
        return total.unflatten(0, counts)


@dataclass(frozen=True)
class _Pairs:
    """Pairs of ways to one point, one row each.

    Attributes:
        tx, rx: Antennas.
        row: Of the point.
        amount: What the pair adds.
    """

    tx: Int64[Tensor, " pair"]
    rx: Int64[Tensor, " pair"]
    row: Int64[Tensor, " pair"]
    amount: Float64[Tensor, "pair amount"]


def _between(stage: Stage, first: Tensor, second: Tensor) -> Stage:
    """The stage with antennas at other places, at rest."""
    still = torch.zeros_like(plain(first)), torch.zeros_like(plain(second))
    return replace(stage, tx=first, rx=second, tx_velocity=still[0], rx_velocity=still[1])


def _place_at(geometry: Geometry, place: Float64[Tensor, "row 3"], face: Tensor) -> Place:
    """Points of triangles as the law of scattering takes them; at rest."""
    a, b, c = plain(geometry.vertices)[geometry.faces[face]].unbind(1)
    normal = normalize(torch.linalg.cross(b - a, c - a), dim=1)
    return Place(place, normal, torch.ones_like(place[:, 0]), geometry.face_surface[face])


def _require_apart(geometry: Geometry, stage: Stage, lit: Bool[Tensor, " f"]) -> None:
    """Refuse derivatives where a surface moves along one that scatters, and touches or cuts it."""
    axes = torch.eye(3, dtype=torch.float64)[None]
    wavelength = SPEED_OF_LIGHT / stage.frequency
    ends = plain(stage.tx)[:1], plain(stage.rx)[:1]
    link = Link(*ends, axes, Isotropic(), Isotropic(), wavelength, shared_visibility=False)
    with _DisableFuncTorch():
        met = contacts_of(RayScene(geometry, link))
    if met is None:
        return
    rows = torch.nonzero(lit[met.first] | lit[met.second])[:, 0]
    if len(rows):
        pair = (int(geometry.face_object[side[rows[0]]]) for side in (met.first, met.second))
        names = " and ".join(geometry.names[number] for number in pair)
        raise InputError(
            "expected a gap between surfaces that move past each other where one scatters what "
            f"mirrors bring, got {names} that meet; leave a gap of a millimetre, or give "
            "contacts=False in the rough Sampling, which leaves out what moves there"
        )
