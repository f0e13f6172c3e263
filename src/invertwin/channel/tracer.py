"""Explicit paths in torch, float64: power paths, and the fields of coherent and rough surfaces.

The slow, readable twin of ``channel/kernel.py``, and the source of every exact signal: positions
and lengths come from float64 vertices, so that the phase is right at millimetre waves.
"""

import zlib
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Complex128, Float64, Int64
from torch import Tensor

from invertwin.channel.boundary import (
    Edge,
    edge_points,
    require_edges,
    shadow_speed,
    silhouettes_move,
)
from invertwin.channel.bridge import Geometry, flatten, to_torch, tracer, use_backend
from invertwin.channel.chains import (
    Chain,
    RoughPaths,
    chain_view,
    passed,
    rough_chains,
    tabulated,
)
from invertwin.channel.kernel import Inputs
from invertwin.channel.paths import Grid, Link, Paths
from invertwin.channel.rays import Shot, face_areas, visible
from invertwin.channel.sampling import Sampling
from invertwin.channel.starts import RaySampler
from invertwin.channel.trace import Settings, Trace
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.scene.scene import Scene

_NO_ROUGH_DERIVATIVE = (
    "expected no geometry derivative of rough field paths, got one: single points appear and "
    "vanish; use power paths, or boundary=False for fixed visibility"
)
_GOLDEN = (0.754_877_666_246_692_7, 0.569_840_290_998_053_2)  # the R2 low-discrepancy sequence


@dataclass(frozen=True)
class View:
    """How the two antennas see surface points, one row a point (bistatic radar equation)."""

    power: Float64[Tensor, " n"]  # received over transmitted power per m², by reflectance
    mirror: Complex128[Tensor, " n"]  # field coefficient per m² of a perfect conductor
    length: Float64[Tensor, " n"]  # TX to point to RX [m]


def view(
    geometry: Geometry,
    link: Link,
    frame: Int64[Tensor, " n"],
    face: Int64[Tensor, " n"],
    position: Float64[Tensor, "n 3"],
    normal: Float64[Tensor, "n 3"],
) -> View:
    """Evaluate the radar equation and physical optics at surface points.

    Physical optics of a perfect conductor: ``a = (λ/4π) S / (R_t R_r)`` with
    ``S = −(jk/2π) ∫ (n·d)₊ V dA`` (derivations §4); for separate antennas ``n·d`` is the mean of
    both cosines, which keeps reciprocity.
    Differs from the source: the paper gives no field of a surface.
    """
    to_tx, to_rx = link.tx[frame] - position, link.rx[frame] - position
    r_tx, r_rx = to_tx.norm(dim=1), to_rx.norm(dim=1)
    w_tx, w_rx = to_tx / r_tx[:, None], to_rx / r_rx[:, None]
    cos_tx, cos_rx = (normal * w_tx).sum(1), (normal * w_rx).sum(1)
    lit = (cos_tx * cos_rx > 0).to(position)
    rotation = link.rotations[frame]
    gain = link.tx_pattern.gain(torch.einsum("nij,ni->nj", rotation, -w_tx))
    gain = gain * link.rx_pattern.gain(torch.einsum("nij,ni->nj", rotation, -w_rx))
    row = geometry.face_surface[face]
    reflectance = tabulated(geometry.amplitude, row, cos_tx) * tabulated(
        geometry.amplitude, row, cos_rx
    )
    between = (w_tx * w_rx).sum(1)
    mirror, back = (0.5 * (1 + c) for c in (2 * cos_tx * cos_rx - between, between))
    shape = geometry.diffuse[row] / torch.pi
    for number, half in enumerate((mirror, mirror, back)):
        lobe = half.clamp_min(1e-7) ** geometry.exponents[row, number]
        shape = shape + geometry.lobes[row, number] * lobe
    spread = lit * gain / (r_tx * r_rx) ** 2
    power = (link.wavelength / (4 * torch.pi)) ** 2 * spread * reflectance * shape
    facing = 0.5 * (cos_tx + cos_rx).abs()
    field = -1j / (4 * torch.pi) * spread.sqrt() * facing
    return View(power * (cos_tx * cos_rx), field, r_tx + r_rx)


@dataclass(frozen=True)
class _Points:
    """Detached samples in torch."""

    frame: Int64[Tensor, " n"]
    face: Int64[Tensor, " n"]
    b1: Float64[Tensor, " n"]
    b2: Float64[Tensor, " n"]
    weight: Float64[Tensor, " n"]

    def keep(self, mask: Bool[Tensor, " n"]) -> "_Points":
        return _Points(*(column[mask] for column in vars(self).values()))

    def velocity(self, geometry: Geometry) -> Tensor | None:
        """World velocity of the points [m/s]."""
        if geometry.velocities is None:
            return None
        v0, v1, v2 = (geometry.velocities[geometry.faces[self.face, k]] for k in range(3))
        b1, b2 = self.b1[:, None], self.b2[:, None]
        return v0 * (1 - b1 - b2) + v1 * b1 + v2 * b2

    def place(self, geometry: Geometry) -> tuple[Tensor, Tensor, Tensor]:
        """Attached position, unit normal, and Jacobian of the area."""
        p0, p1, p2 = geometry.corners(self.face)
        b1, b2 = self.b1[:, None], self.b2[:, None]
        normal = torch.linalg.cross(p1 - p0, p2 - p0)
        double_area = normal.norm(dim=1)
        jacobian = double_area / double_area.detach()
        return p0 * (1 - b1 - b2) + p1 * b1 + p2 * b2, normal / double_area[:, None], jacobian


def trace_power(
    scene: Scene,
    link: Link,
    *,
    sampling: Sampling,
    seed: int,
) -> Paths:
    """Power paths by rays from the antenna, as explicit rows; for inspection and as an oracle.

    The paths are those that :func:`invertwin.channel.deposit_power` sums.

    Args:
        scene: What is seen.
        link: Antennas, per frame.
        sampling: How many paths are drawn.
        seed: Same seed, same paths.

    Raises:
        InputError: See ``deposit_power``; boundary paths of more than one bounce or past sheets.
    """
    with use_backend(sampling.backend):
        geometry = flatten(scene, link.wavelength)
        boundary, edges = sampling.boundary, sampling.boundary_samples
        depth = sampling.depth
        if boundary and silhouettes_move(geometry, link) and (depth > 1 or geometry.sheets):
            raise InputError(
                "expected explicit paths of one bounce without sheets for derivatives in which "
                "silhouettes move; use deposit_power, or boundary=False for fixed visibility"
            )
        if depth > 1 or geometry.sheets:
            return _power_chains(geometry, link, sampling, seed)
        shot = Shot(geometry, link)
        if boundary:
            require_edges(geometry, link, edges)
        sampler = RaySampler(shot, sampling.samples, seed)
        points = _drawn(sampler)
        points = points.keep(points.weight > 0)
        if not link.shared_visibility:
            place, _, _ = points.place(geometry)
            points = points.keep(visible(shot, place, link.rx[points.frame]))
        position, normal, jacobian = points.place(geometry)
        seen = view(geometry, link, points.frame, points.face, position, normal)
        power = seen.power * jacobian * points.weight
        inner = _paths(points.frame, seen.length, position, "power", power=power)
        if not (boundary and edges):
            return inner

        def value(edge: Edge, found: View) -> Paths:
            amount = found.power.detach() * edge.speed
            return _paths(
                edge.frame,
                found.length,
                edge.shadow,
                "power",
                power=amount - amount.detach(),
                boundary=True,
            )

        return inner + _boundary_paths(geometry, link, shot, edges, seed, value)


def _power_chains(geometry: Geometry, link: Link, sampling: Sampling, seed: int) -> Paths:
    """The chains that ``deposit_power`` walks, evaluated in torch."""
    nowhere = Grid(0.0, 1.0, 1)
    trace = Trace(Settings(geometry, link, nowhere, sampling, seed, "rays", None, ""))
    parts, depth = [], sampling.depth
    for records in trace.records():
        frame = to_torch(records.frame).long()
        columns = [
            to_torch(column).reshape(depth, -1).T
            for column in (records.face, records.b1, records.b2, records.throughput, records.seen)
        ]
        for count in range(1, depth + 1):
            seen = columns[4][:, count - 1].bool()
            face, b1, b2 = (column[seen, :count] for column in columns[:3])
            weight = columns[3][seen, count - 1].double()
            chain = Chain(face.long(), b1.double(), b2.double(), weight, torch.zeros_like(weight))
            found = chain_view(geometry, link, trace.shot, frame[seen], chain)
            follows = found.power / found.power.detach().clamp_min(1e-300)
            power = weight * found.ending * follows
            parts.append(
                _paths(
                    frame[seen], found.length, found.last, "power", power=power, first=found.first
                )
            )
    return _joined(parts)


def _joined(parts: list[Paths]) -> Paths:
    """All in order; in pairs, so that no row is copied once for every part."""
    while len(parts) > 1:
        pairs = zip(parts[::2], parts[1::2], strict=False)
        odd = parts[-1:] if len(parts) % 2 else []
        parts = [first + second for first, second in pairs] + odd
    return parts[0]


@dataclass(frozen=True)
class RoughPoints:
    """The fixed material points of rough surfaces, with their phases.

    They belong to the surfaces: never drawn again between chirps, poses, looks or iterations.

    Attributes:
        face, b1, b2: Place on the surface.
        phase: Uniform in [0, 2π), a hash of object, triangle, number of the point and seed.
        density: Points per m² of the scene they were drawn on.
    """

    face: Int64[Tensor, " n"]
    b1: Float64[Tensor, " n"]
    b2: Float64[Tensor, " n"]
    phase: Float64[Tensor, " n"]
    density: float


def rough_points(scene: Scene, density: float, seed: int) -> RoughPoints:
    """Draw the material points of all rough objects.

    Args:
        scene: Surfaces to cover.
        density: Points per m².
        seed: Hash key.
    """
    columns: list[list[np.ndarray]] = [[], [], [], []]
    offset = 0
    for name, item in scene.objects.items():
        triangles = item.vertices.detach()[item.mesh.faces]
        edges = triangles[:, 1:] - triangles[:, :1]
        area = 0.5 * torch.linalg.cross(edges[:, 0], edges[:, 1]).norm(dim=1).numpy()
        if not item.material.coherent:
            key = np.uint64(zlib.crc32(name.encode()) ^ (seed * 0x9E3779B97F4A7C15 & (2**64 - 1)))
            face = np.arange(len(area), dtype=np.uint64)
            expected = area * density
            count = np.floor(expected + _hash(key, face, face * 0, 0)).astype(np.int64)
            face = np.repeat(face, count)
            number = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
            draws = [_hash(key, face, number.astype(np.uint64), stream) for stream in (1, 2, 3)]
            fold = draws[0] + draws[1] > 1
            columns[0].append(face.astype(np.int64) + offset)
            columns[1].append(np.where(fold, 1 - draws[0], draws[0]))
            columns[2].append(np.where(fold, 1 - draws[1], draws[1]))
            columns[3].append(2 * np.pi * draws[2])
        offset += len(area)
    joined = [
        torch.from_numpy(np.concatenate(c)) if c else torch.zeros(0, dtype=torch.float64)
        for c in columns
    ]
    return RoughPoints(joined[0].long(), joined[1], joined[2], joined[3], density)


@dataclass(frozen=True)
class Speckle:
    """The fixed random parts of fields: they stay while radar and scene move.

    Attributes:
        points: Points of rough surfaces, for paths of one bounce; None is drawn where needed.
        paths: Rough paths of several bounces; None is drawn where needed.
    """

    points: RoughPoints | None = None
    paths: RoughPaths | None = None


def draw_speckle(scene: Scene, link: Link, sampling: Sampling, seed: int) -> Speckle:
    """Draw the fixed points and paths that give rough surfaces their speckle.

    Args:
        scene: Surfaces.
        link: Antennas, which suggest what rough paths are worth drawing.
        sampling: Points per m², number and depth of rough paths.
        seed: Of places and phases.
    """
    paths = None
    if sampling.depth > 1:
        with use_backend(sampling.backend):
            paths = rough_chains(
                scene, link, count=sampling.rough_paths, depth=sampling.depth, seed=seed
            )
    return Speckle(rough_points(scene, sampling.points_per_m2, seed), paths)


def _hash(key: np.uint64, first: np.ndarray, second: np.ndarray, stream: int) -> np.ndarray:
    """Uniform numbers in [0, 1): SplitMix64 over the words of the key."""
    with np.errstate(over="ignore"):
        state = np.full(first.shape, key, dtype=np.uint64)
        for word in (first, second, np.full(first.shape, stream, dtype=np.uint64)):
            state = state + np.uint64(0x9E3779B97F4A7C15) + word
            state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            state = state ^ (state >> np.uint64(31))
    return (state >> np.uint64(11)).astype(np.float64) * 2.0**-53


def trace_field(
    scene: Scene,
    link: Link,
    *,
    sampling: Sampling,
    seed: int,
    speckle: Speckle | None = None,
) -> Paths:
    """Field paths: physical optics for conductors, fixed random-phase points for rough surfaces.

    Args:
        scene: What is seen.
        link: Antennas, per frame.
        sampling: How many paths are drawn. From the second bounce on, every surface scatters as a
            rough one does: a fixed phase for every ordered path, conductors by their lobe.
        seed: Places and phases.
        speckle: The rough points and paths to use, so that they stay while the scene moves. What
            is None in it is drawn from the seed.

    Source: derivations §4.
    Differs from the source: rough fields have fixed points, not new phases every evaluation.

    Raises:
        InputError: A derivative of rough field paths with ``boundary`` on: single points appear
            and vanish, so a realisation has no boundary term. Use power paths, or switch
            ``boundary`` off to accept fixed visibility.
    """
    boundary, boundary_samples, depth = sampling.boundary, sampling.boundary_samples, sampling.depth
    fixed = speckle or Speckle()
    with use_backend(sampling.backend):
        geometry = flatten(scene, link.wavelength, in_motion=True)
        shot = Shot(geometry, link)
        parts = []
        if any(geometry.coherent):
            if boundary:
                require_edges(geometry, link, boundary_samples)
                if geometry.sheets and silhouettes_move(geometry, link):
                    raise InputError(
                        "expected no sheets where a derivative of coherent fields moves "
                        "silhouettes, got some; use power paths, or boundary=False for fixed "
                        "visibility"
                    )
            parts.append(_coherent(geometry, link, shot, sampling.samples, seed))
            if boundary and boundary_samples:

                def value(edge: Edge, found: View) -> Paths:
                    amount = found.mirror.detach() * edge.speed
                    on = torch.tensor(geometry.coherent)[geometry.face_object[edge.face]]
                    return _paths(
                        edge.frame,
                        found.length,
                        edge.shadow,
                        "coherent",
                        coefficient=(amount - amount.detach()) * on,
                        boundary=True,
                    )

                parts.append(_boundary_paths(geometry, link, shot, boundary_samples, seed, value))
        if not all(geometry.coherent):
            if boundary and silhouettes_move(geometry, link):
                raise InputError(_NO_ROUGH_DERIVATIVE)
            points = fixed.points or rough_points(scene, sampling.points_per_m2, seed)
            parts.append(_rough(geometry, link, shot, points))
        if depth > 1:
            if geometry.velocities is not None:
                raise InputError(
                    f"expected depth 1 for objects in motion, got {depth}; the range rate of "
                    "longer paths is not modelled"
                )
            if boundary and silhouettes_move(geometry, link):
                raise InputError(_NO_ROUGH_DERIVATIVE)
            drawn = fixed.paths or rough_chains(
                scene, link, count=sampling.rough_paths, depth=depth, seed=seed
            )
            parts += _rough_chains(geometry, link, shot, drawn, depth)
        return _joined(parts)


def _coherent(geometry: Geometry, link: Link, shot: Shot, samples: int, seed: int) -> Paths:
    """Physical optics of the coherent objects by low-discrepancy area samples (1/N)."""
    areas = face_areas(geometry)
    areas = areas * torch.tensor(geometry.coherent)[geometry.face_object]
    rng = np.random.default_rng(seed)
    shift = rng.random(2)
    index = np.arange(samples)
    edges = np.cumsum(areas.numpy())
    # Jittered, not evenly spaced: even steps would beat with the order of a subdivided mesh.
    place = (index + rng.random(samples)) / samples * edges[-1]
    face = np.minimum(np.searchsorted(edges, place, side="right"), len(edges) - 1)
    b1, b2 = ((shift[k] + index * _GOLDEN[k]) % 1.0 for k in range(2))
    fold = b1 + b2 > 1
    frames = link.frame_count
    points = _Points(
        frame=torch.arange(frames).repeat_interleave(samples),
        face=torch.from_numpy(face).repeat(frames),
        b1=torch.from_numpy(np.where(fold, 1 - b1, b1)).repeat(frames),
        b2=torch.from_numpy(np.where(fold, 1 - b2, b2)).repeat(frames),
        weight=torch.full((frames * samples,), float(edges[-1]) / samples, dtype=torch.float64),
    )
    points, position, normal, jacobian = _seen(geometry, link, shot, points)
    found = view(geometry, link, points.frame, points.face, position, normal)
    share, excess = _through_sheets(geometry, link, shot, points.frame, position)
    coefficient = found.mirror * (jacobian * points.weight * share.sqrt())
    return _paths(
        points.frame,
        found.length + excess,
        position,
        "coherent",
        coefficient=coefficient,
        velocity=points.velocity(geometry),
    )


def _rough(geometry: Geometry, link: Link, shot: Shot, fixed: RoughPoints) -> Paths:
    """Fields of the rough points: amplitude sqrt(f/ρ), phase of the material point."""
    frames, count = link.frame_count, len(fixed.face)
    points = _Points(
        frame=torch.arange(frames).repeat_interleave(count),
        face=fixed.face.repeat(frames),
        b1=fixed.b1.repeat(frames),
        b2=fixed.b2.repeat(frames),
        weight=fixed.phase.repeat(frames),
    )
    points, position, normal, jacobian = _seen(geometry, link, shot, points)
    found = view(geometry, link, points.frame, points.face, position, normal)
    share, excess = _through_sheets(geometry, link, shot, points.frame, position)
    amplitude = (found.power * share * jacobian / fixed.density).sqrt()
    coefficient = torch.polar(amplitude, points.weight)
    return _paths(
        points.frame,
        found.length + excess,
        position,
        "rough",
        coefficient=coefficient,
        velocity=points.velocity(geometry),
    )


def _rough_chains(
    geometry: Geometry, link: Link, shot: Shot, drawn: RoughPaths, depth: int
) -> list[Paths]:
    """Fields of the rough chains: amplitude sqrt(f · weight), phase of the chain."""
    parts = []
    for chain in drawn.chains[: depth - 1]:
        for number in range(link.frame_count):
            frame = torch.full((len(chain.weight),), number)
            with torch.no_grad():
                lit = chain_view(geometry, link, shot, frame, chain).power > 0
            kept, frame = chain.keep(lit), frame[lit]
            found = chain_view(geometry, link, shot, frame, kept)
            coefficient = torch.polar((found.power * kept.weight).sqrt(), kept.phase)
            parts.append(
                _paths(
                    frame,
                    found.length,
                    found.last,
                    "rough",
                    coefficient=coefficient,
                    first=found.first,
                )
            )
    return parts


def _seen(
    geometry: Geometry, link: Link, shot: Shot, points: _Points
) -> tuple[_Points, Tensor, Tensor, Tensor]:
    """The points that both antennas see from the same side, and their places."""
    with torch.no_grad():
        position, normal, _ = points.place(geometry)
        to_tx, to_rx = link.tx[points.frame] - position, link.rx[points.frame] - position
        keep = (normal * to_tx).sum(1) * (normal * to_rx).sum(1) > 0
        if geometry.sheets:
            share, _ = _through_sheets(geometry, link, shot, points.frame, position)
            keep &= share > 0
        else:
            keep &= visible(shot, link.tx[points.frame], position)
            if not link.shared_visibility:
                keep &= visible(shot, link.rx[points.frame], position)
    points = points.keep(keep)
    return points, *points.place(geometry)


def _through_sheets(
    geometry: Geometry, link: Link, shot: Shot, frame: Tensor, position: Tensor
) -> tuple[Tensor, Tensor]:
    """Share of the power that passes sheets on both legs (1 without any), and the length added."""
    if not geometry.sheets:
        return torch.ones_like(position[:, 0]), torch.zeros_like(position[:, 0])
    share, excess = passed(geometry, shot, link.tx[frame], position)
    if link.shared_visibility and torch.equal(link.tx, link.rx):
        return share * share, excess + excess
    other, more = passed(geometry, shot, link.rx[frame], position)
    return share * other, excess + more


def _boundary_paths(
    geometry: Geometry,
    link: Link,
    shot: Shot,
    samples: int,
    seed: int,
    value: Callable[[Edge, View], Paths],
) -> Paths:
    """Boundary rows of all antenna segments; ``value`` turns an edge point into a path."""
    centres = ("tx",) if link.shared_visibility else ("tx", "rx")
    parts = []
    for centre, found in edge_points(shot, centres, samples // len(centres) * len(centres), seed):
        edge = shadow_speed(geometry, link, shot, found, centre)
        seen = view(geometry, link, edge.frame, edge.face, edge.shadow, edge.normal)
        seen = View(seen.power.detach(), seen.mirror.detach(), seen.length.detach())
        parts.append(value(edge, seen))
    return _joined(parts)


def _drawn(sampler: Any) -> _Points:
    import drjit as dr

    inputs = Inputs.of(sampler.shot.geometry, sampler.shot.link, sampler.shot, monostatic=False)
    drawn = sampler.draw(dr.arange(tracer().UInt32, sampler.size), inputs)
    names = [field.name for field in fields(_Points)]
    frame, face, b1, b2, weight = (to_torch(getattr(drawn, name)) for name in names)
    return _Points(frame.long(), face.long(), b1.double(), b2.double(), weight.double())


def _paths(
    frame: Tensor,
    length: Tensor,
    position: Tensor,
    kind: str,
    *,
    first: Tensor | None = None,
    power: Tensor | None = None,
    coefficient: Tensor | None = None,
    boundary: bool = False,
    velocity: Tensor | None = None,
) -> Paths:
    count = len(frame)
    return Paths(
        frame=frame,
        delay=length / SPEED_OF_LIGHT,
        coefficient=torch.zeros(count, dtype=torch.complex128)
        if coefficient is None
        else coefficient,
        power=torch.zeros(count, dtype=torch.float64) if power is None else power,
        first=position if first is None else first,
        last=position,
        kind=kind,
        boundary=torch.full((count,), boundary),
        velocity=velocity,
    )
