"""Rough points: fixed material points whose phases give a rough surface its speckle.

Rough paths are the fixed paths of several bounces that rough surfaces scatter along. The power of a
path is its radar equation; as a field it is the square root of that, with a phase of its own
(derivations §4). These paths are drawn once: a realisation stays while radar and scene move.
"""

import zlib
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.coherent import radar_equation
from invertwin.channel.coherent.radar_equation import SurfacePaths, trace_transmittance
from invertwin.channel.paths import Link
from invertwin.channel.power import integrand
from invertwin.channel.power import random_walk as walk
from invertwin.channel.rays import arrays
from invertwin.channel.rays.backend import dr, mi, tracing
from invertwin.channel.rays.ray_scene import RayScene, face_areas
from invertwin.channel.rays.scene_tables import Geometry, flatten
from invertwin.channel.rays.surface_point import SurfacePoint
from invertwin.channel.rows import concatenate_rows
from invertwin.channel.sampling import Densities, Sampling, resolve_densities
from invertwin.runtime.progress import track
from invertwin.scene.scene import Scene

_LANES = 1 << 18  # walked at a time
_KEPT_SHARE = 0.25  # of the paths that are drawn; the others carry little
_REFERENCE_FRAMES = 8  # frames that say how much a path carries
_STRATIFIED_SHARE = 0.5  # share of the draws that goes to all sequences of objects alike
_UNIFORM_SHARE = 0.1  # share that goes to paths whatever the reference frames see of them
_BACKSIDE_SHARE = 0.125  # share of first points lit from the side that the antennas do not see


def draw_rough_paths(
    scene: Scene, link: Link, *, count: int, depth: int, seed: int
) -> tuple[SurfacePaths, ...]:
    """Draw the paths that rough surfaces scatter along, once for all frames.

    The first point is spread over the surfaces, every object alike; the next ones follow the
    lobes and aim at other objects. After every point, paths that bring much to their last
    point go on several times and others by chance; of whole paths, the strong ones are kept.
    Every sequence of objects gets its share, so that a weak echo along a narrow way, by a wall
    to a hidden object and back, consists of many paths, too. One over the chance goes into
    the weight: the expected power is that of all paths. The antennas only suggest which paths are
    worth drawing: nothing is lost that another pose could see. The result is paths of two points,
    of three points, and so on.

    Args:
        scene: Surfaces.
        link: Antennas, a few frames of which tell how much a path contributes.
        count: Paths to draw, of each length; at most a quarter of them are kept.
        depth: Most points of a path.
        seed: Seed of places and phases.

    Source: derivations §4 (one independent phase per ordered path).
    """
    if depth < 2:
        return ()
    with torch.no_grad():
        drawer = _RoughPathSampler(flatten(scene, link.wavelength, motion="fixed"), link, seed)
        rounds = -(-count // _LANES)
        turns = track(range(rounds), "paths")
        parts = [drawer.draw(turn, count // rounds, depth) for turn in turns]
        return tuple(map(drawer.merge_rounds, zip(*parts, strict=True)))


class _RoughPathSampler:
    """Walks paths, and draws again from them where they carry power (splitting and roulette)."""

    def __init__(self, geometry: Geometry, link: Link, seed: int) -> None:
        self.geometry, self.link = geometry, link
        self.rays = RayScene(geometry, link)
        self.inputs = integrand.Inputs.from_rays(self.rays)
        self.walk = walk.RandomWalk(self.inputs, seed)
        self.seeds = arrays.scramble_seed(seed, 12), arrays.scramble_seed(seed, 13)
        self.generator = torch.Generator().manual_seed(seed)
        areas = face_areas(geometry)
        owners = torch.zeros(len(geometry.coherent), dtype=torch.float64)
        owners = owners.index_add(0, geometry.face_object, areas)
        share = areas / owners[geometry.face_object] / len(owners)
        self.areas = arrays.to_float(areas)
        self.faces = mi.DiscreteDistribution(arrays.to_float(share))
        frames = torch.linspace(0, link.frame_count - 1, min(link.frame_count, _REFERENCE_FRAMES))
        self.frames = frames.round().long()

    def draw(self, round_number: int, lanes: int, depth: int) -> list[SurfacePaths]:
        """Paths of two points and more, without phases, of one of the rounds."""
        state = self._start_paths(round_number * lanes, lanes)
        places: list[Tensor] = []
        found = []
        for number in range(1, depth + 1):
            if number > 1:
                state = self.walk.step(state)
            places, alive, paths = self._read_points(state, places)
            if number > 1:
                chance = self._selection_shares(paths, received=True) * (lanes * _KEPT_SHARE)
                chance = chance.clamp_max(1.0)
                kept = self._draw_uniform(len(chance)) < chance
                found.append(replace(paths, weight=paths.weight / chance).select(kept))
            if number < depth and len(alive):
                shares = self._selection_shares(paths, received=False)
                drawn = (torch.arange(lanes) + self._draw_uniform(1)) / lanes
                row = torch.searchsorted(shares.cumsum(0), drawn).clamp_max(len(alive) - 1)
                weight = paths.weight[row] / (shares[row] * lanes)
                places = [column[row] for column in (paths.face, paths.b1, paths.b2)]
                state = self._resample_lanes(state, alive[row], weight)
        return found

    def merge_rounds(self, parts: tuple[SurfacePaths, ...]) -> SurfacePaths:
        """Paths of one length from all rounds, each with a phase."""
        whole = concatenate_rows(parts)
        phase = 2 * torch.pi * self._draw_uniform(len(whole.weight))
        return replace(whole, weight=whole.weight / len(parts), phase=phase)

    def _draw_uniform(self, count: int) -> Tensor:
        return torch.rand(count, generator=self.generator, dtype=torch.float64)

    def _start_paths(self, start: int, lanes: int) -> walk.PathState:
        """First points, and for each a reference frame that lights it, or its mirror image."""
        lane = dr.arange(mi.UInt32, lanes)
        index = lane + arrays.opaque(start)
        place, side = arrays.uniform_pair(index, self.seeds[0])
        face, pmf = self.faces.sample_pmf((mi.Float(lane) + place) / lanes)
        b = mi.warp.square_to_uniform_triangle(
            mi.Point2f(*arrays.uniform_pair(index, self.seeds[1]))
        )
        vertex = SurfacePoint(face, b.x, b.y)
        point = integrand.compute_interaction(self.inputs, vertex)
        frame = dr.gather(
            mi.UInt32, arrays.to_index(self.frames), index % arrays.opaque(len(self.frames))
        )
        tx = self.inputs.antenna_position(frame, False)
        back, distance = integrand.direction_and_distance(point.position, tx)
        turned = back - 2 * dr.dot(back, point.normal) * point.normal
        back = dr.select(side < _BACKSIDE_SHARE, turned, back)
        state = walk.initial_state(index, frame, vertex, back, dr.ones(mi.Float, lanes), distance)
        state["weight"] = dr.gather(mi.Float, self.areas, face) / (
            pmf * lanes * dr.select(side < _BACKSIDE_SHARE, _BACKSIDE_SHARE, 1 - _BACKSIDE_SHARE)
        )
        return state

    def _read_points(
        self, state: walk.PathState, previous: list[Tensor]
    ) -> tuple[list[Tensor], Tensor, SurfacePaths]:
        """Places of all lanes' points, the lanes that are alive, and their paths."""
        names = ("face", "b1", "b2", "weight", "active")
        dr.eval(*(state[name] for name in names))
        *latest, weight, active = (arrays.to_torch(state[name]) for name in names)
        places = [latest[0].long()[:, None], *(b.double()[:, None] for b in latest[1:])]
        if previous:
            places = [torch.cat(pair, dim=1) for pair in zip(previous, places, strict=True)]
        alive = active.bool().nonzero()[:, 0]
        face, b1, b2 = (column[alive] for column in places)
        weight = weight.double()[alive]
        return places, alive, SurfacePaths(face, b1, b2, weight, torch.zeros_like(weight))

    def _resample_lanes(
        self, state: walk.PathState, parent: Tensor, weight: Tensor
    ) -> walk.PathState:
        """Resample lanes; each has its own index, and so its own random numbers."""
        at = arrays.to_index(parent)
        incident = [dr.gather(mi.Float, state["incident"][k], at) for k in range(3)]
        return walk.update_state(
            state,
            **{n: dr.gather(type(state[n]), state[n], at) for n in ("face", "b1", "b2", "number")},
            incident=mi.Vector3f(*incident),
            weight=arrays.to_float(weight),
            active=dr.full(mi.Bool, True, len(parent)),
        )

    def _selection_shares(self, paths: SurfacePaths, *, received: bool) -> Tensor:
        """Compute the selection probabilities of paths, by power and by sequence of objects."""
        if not len(paths.weight):
            return paths.weight
        power = paths.weight * self._estimate_power(paths, received=received)
        blind = paths.weight / paths.weight.sum()
        total = power.sum()
        if not total > 0:
            return blind
        objects = self.geometry.face_object[paths.face]
        base = len(self.geometry.coherent) ** torch.arange(objects.shape[1])
        _, family = (objects * base).sum(1).unique(return_inverse=True)
        sums = torch.zeros(int(family.max()) + 1, dtype=torch.float64).index_add(0, family, power)
        alike = power / sums.clamp_min(1e-300)[family] / int((sums > 0).sum())
        return _UNIFORM_SHARE * blind + (1 - _UNIFORM_SHARE) * (
            _STRATIFIED_SHARE * alike + (1 - _STRATIFIED_SHARE) * power / total
        )

    def _estimate_power(self, paths: SurfacePaths, *, received: bool) -> Tensor:
        """Power at the receiver or the last point, the mean of the reference frames.

        What lies between points is left out: this changes only how well paths are chosen.
        """
        link, places = self.link, paths.material_points(self.geometry)
        last, total = places[-1], torch.zeros_like(paths.weight)
        for number in self.frames.tolist():
            frame = torch.full((len(total),), number)
            echo = radar_equation.radar_equation(self.geometry, link, frame, places)
            ends = [(link.tx, places[0])]
            if received:
                power = echo.power
                ends.append((link.rx, last))
            else:
                before = places[-2].position if len(places) > 1 else link.tx[frame]
                back = normalize(before - last.position, dim=1)
                power = echo.incident_power * (last.normal * back).sum(1).abs()
            for antenna, point in ends:
                lit = power > 0
                transmittance, _ = trace_transmittance(
                    self.rays, antenna[frame[lit]], point.position[lit]
                )
                power = power.masked_scatter(lit, power[lit] * transmittance)
            total = total + power
        return total / len(self.frames)


def draw_rough_points(scene: Scene, points_per_m2: Densities, seed: int) -> SurfacePaths:
    """Draw the material points of all rough objects, as paths of one point.

    They belong to the surfaces: never drawn again between chirps, poses, looks or iterations. The
    phase is uniform in [0, 2π), a hash of object, triangle, number of the point and seed.

    Args:
        scene: Surfaces to cover.
        points_per_m2: Their number per m², of all objects or by name.
        seed: Hash key.

    Raises:
        InputError: See ``resolve_densities``.
    """
    densities = resolve_densities(scene, points_per_m2)
    found: list[np.ndarray] = [np.zeros((5, 0))]
    offset = 0
    for name, item in scene.objects.items():
        triangles = item.vertices.detach()[item.mesh.faces]
        edges = triangles[:, 1:] - triangles[:, :1]
        area = 0.5 * torch.linalg.cross(edges[:, 0], edges[:, 1]).norm(dim=1).numpy()
        if name in densities:
            key = np.uint64(zlib.crc32(name.encode()) ^ (seed * 0x9E3779B97F4A7C15 & (2**64 - 1)))
            face = np.arange(len(area), dtype=np.uint64)
            expected = area * densities[name]
            count = np.floor(expected + _hash_uniform(key, face, face * 0, 0)).astype(np.int64)
            face = np.repeat(face, count)
            number = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
            b1, b2, turn = (
                _hash_uniform(key, face, number.astype(np.uint64), k) for k in (1, 2, 3)
            )
            fold = b1 + b2 > 1
            b1, b2 = np.where(fold, 1 - b1, b1), np.where(fold, 1 - b2, b2)
            # A point stands for the area that is its own at the density of its object.
            weight = np.full(len(face), 1 / densities[name])
            phase = 2 * np.pi * turn
            found.append(np.stack([face.astype(np.int64) + offset, b1, b2, weight, phase]))
        offset += len(area)
    face, b1, b2, weight, phase = torch.from_numpy(np.concatenate(found, axis=1))
    return SurfacePaths(face.long()[:, None], b1[:, None], b2[:, None], weight, phase)


def _hash_uniform(key: np.uint64, first: np.ndarray, second: np.ndarray, stream: int) -> np.ndarray:
    """Uniform numbers in [0, 1): SplitMix64 over the words of the key."""
    with np.errstate(over="ignore"):
        state = np.full(first.shape, key, dtype=np.uint64)
        for word in (first, second, np.full(first.shape, stream, dtype=np.uint64)):
            state = state + np.uint64(0x9E3779B97F4A7C15) + word
            state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            state = state ^ (state >> np.uint64(31))
    return (state >> np.uint64(11)).astype(np.float64) * 2.0**-53


@dataclass(frozen=True)
class Speckle:
    """The fixed random parts of fields: they stay while radar and scene move.

    Attributes:
        points: Points of rough surfaces: paths of one bounce.
        paths: Rough paths of two points, of three points, and so on.
    """

    points: SurfacePaths
    paths: tuple[SurfacePaths, ...] = ()


def draw_speckle(scene: Scene, link: Link, sampling: Sampling, seed: int) -> Speckle:
    """Draw the fixed points and paths that give rough surfaces their speckle.

    Args:
        scene: Surfaces.
        link: Antennas, which suggest what rough paths are worth drawing.
        sampling: Points per m², number and depth of rough paths.
        seed: Seed of places and phases.

    Raises:
        InputError: Points per m² of what is not in the scene, or not of all its rough objects.
    """
    with tracing(sampling.backend):
        count, depth = sampling.rough_paths, sampling.depth
        paths = draw_rough_paths(scene, link, count=count, depth=depth, seed=seed)
    return Speckle(draw_rough_points(scene, sampling.points_per_m2, seed), paths)
