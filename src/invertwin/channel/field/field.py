"""Fields: physical optics of conductors, fixed random-phase points and paths of rough surfaces."""

import numpy as np
import torch
from torch import Tensor

from invertwin.channel.field.rough_paths import RoughPaths, draw_rough_paths
from invertwin.channel.field.rough_points import RoughPoints, draw_rough_points
from invertwin.channel.field.speckle import Speckle
from invertwin.channel.paths import Link, Paths, joined, listed
from invertwin.channel.rays.backend import use_backend
from invertwin.channel.rays.geometry import flatten, require_edges, silhouettes_move
from invertwin.channel.rays.scene import RayScene, face_areas, visible
from invertwin.channel.reference.radar_equation import (
    Echo,
    Place,
    SurfacePoints,
    mirror_field,
    passed,
    path_view,
    radar_equation,
)
from invertwin.channel.reference.shadows import ShadowEdge, boundary_rows
from invertwin.channel.sampling import Sampling
from invertwin.errors import InputError
from invertwin.scene.scene import Scene

_NO_ROUGH_DERIVATIVE = (
    "expected no geometry derivative of rough field paths, got one: single points appear and "
    "vanish; use power paths, or boundary=False for fixed visibility"
)
_GOLDEN = (0.754_877_666_246_692_7, 0.569_840_290_998_053_2)  # the R2 low-discrepancy sequence


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
    fixed, depth = speckle or Speckle(), sampling.depth
    with use_backend(sampling.backend):
        geometry = flatten(scene, link.wavelength, motion="fixed")
        moves = sampling.boundary and silhouettes_move(geometry, link)
        rays = RayScene(geometry, link)
        parts = []
        if any(geometry.coherent):
            if sampling.boundary:
                require_edges(geometry, link, sampling.boundary_samples)
            if moves and geometry.sheets:
                raise InputError(
                    "expected no sheets where a derivative of coherent fields moves silhouettes, "
                    "got some; use power paths, or boundary=False for fixed visibility"
                )
            parts += _conductors(rays, sampling, seed)
        if moves and (depth > 1 or not all(geometry.coherent)):
            raise InputError(_NO_ROUGH_DERIVATIVE)
        if not all(geometry.coherent):
            points = fixed.points or draw_rough_points(scene, sampling.points_per_m2, seed)
            parts.append(_rough(rays, points))
        if depth > 1:
            geometry.require_rest(depth)
            paths = fixed.paths or draw_rough_paths(
                scene, link, count=sampling.rough_paths, depth=depth, seed=seed
            )
            parts += _several_bounces(rays, paths, depth)
        return joined(parts)


def _conductors(rays: RayScene, sampling: Sampling, seed: int) -> list[Paths]:
    """Physical optics of the conductors, and its boundary paths."""
    coherent = torch.tensor(rays.geometry.coherent)[rays.geometry.face_object]
    parts = [_coherent(rays, coherent, sampling.samples, seed)]

    def row(edge: ShadowEdge, echo: Echo) -> Paths:
        field = mirror_field(rays.link, edge.frame, edge.place, echo).detach()
        amount = field * edge.speed
        return listed(
            edge.frame,
            echo.length,
            edge.place.position,
            "coherent",
            coefficient=(amount - amount.detach()) * coherent[edge.face],
            boundary=True,
        )

    if sampling.boundary and sampling.boundary_samples:
        parts.append(boundary_rows(rays, sampling.boundary_samples, seed, row))
    return parts


def _coherent(rays: RayScene, coherent: Tensor, samples: int, seed: int) -> Paths:
    """Physical optics by low-discrepancy area samples of the conductors (error 1/N)."""
    rng = np.random.default_rng(seed)
    shift = rng.random(2)
    index = np.arange(samples)
    edges = np.cumsum((face_areas(rays.geometry) * coherent).numpy())
    # Jittered, not evenly spaced: even steps would beat with the order of a subdivided mesh.
    place = (index + rng.random(samples)) / samples * edges[-1]
    face = np.minimum(np.searchsorted(edges, place, side="right"), len(edges) - 1)
    b1, b2 = ((shift[k] + index * _GOLDEN[k]) % 1.0 for k in range(2))
    fold = b1 + b2 > 1
    b1, b2 = np.where(fold, 1 - b1, b1), np.where(fold, 1 - b2, b2)
    weight = np.full(samples, float(edges[-1]) / samples)
    points, point, echo, transmittance, extra = _seen(
        rays, *map(torch.from_numpy, (face, b1, b2, weight))
    )
    coefficient = mirror_field(rays.link, points.frame, point, echo)
    coefficient = coefficient * (points.weight * transmittance.sqrt())
    return listed(
        points.frame,
        echo.length + extra,
        point.position,
        "coherent",
        coefficient=coefficient,
        velocity=points.velocity(rays.geometry),
    )


def _rough(rays: RayScene, fixed: RoughPoints) -> Paths:
    """Fields of the rough points: amplitude sqrt(f/ρ), phase of the material point."""
    points, point, echo, transmittance, extra = _seen(
        rays, fixed.face, fixed.b1, fixed.b2, fixed.phase
    )
    amplitude = (echo.power * transmittance / fixed.density).sqrt()
    return listed(
        points.frame,
        echo.length + extra,
        point.position,
        "rough",
        coefficient=torch.polar(amplitude, points.weight),
        velocity=points.velocity(rays.geometry),
    )


def _several_bounces(rays: RayScene, drawn: RoughPaths, depth: int) -> list[Paths]:
    """Fields of the rough paths: amplitude sqrt(f · weight), phase of the path."""
    parts = []
    for paths in drawn.by_length[: depth - 1]:
        for number in range(rays.link.frame_count):
            frame = torch.full((len(paths.weight),), number)
            with torch.no_grad():
                lit = path_view(rays, frame, paths).power > 0
            kept, frame = paths.keep(lit), frame[lit]
            found = path_view(rays, frame, kept)
            coefficient = torch.polar((found.power * kept.weight).sqrt(), kept.phase)
            parts.append(
                listed(
                    frame,
                    found.length,
                    found.last,
                    "rough",
                    coefficient=coefficient,
                    first=found.first,
                )
            )
    return parts


def _seen(rays: RayScene, *columns: Tensor) -> tuple[SurfacePoints, Place, Echo, Tensor, Tensor]:
    """Points in every frame whose antennas both see them from the same side, and their echoes.

    Also what sheets let through on both segments, and the length that they add.
    """
    geometry, link = rays.geometry, rays.link
    frame = torch.arange(link.frame_count).repeat_interleave(len(columns[0]))
    points = SurfacePoints(frame, *(column.repeat(link.frame_count) for column in columns))
    with torch.no_grad():
        point = points.place(geometry)
        position, normal = point.position, point.normal
        to_tx, to_rx = link.tx[points.frame] - position, link.rx[points.frame] - position
        keep = (normal * to_tx).sum(1) * (normal * to_rx).sum(1) > 0
        if geometry.sheets:
            keep &= _through_sheets(rays, points.frame, position)[0] > 0
        else:
            keep &= visible(rays, link.tx[points.frame], position)
            if not link.shared_visibility:
                keep &= visible(rays, link.rx[points.frame], position)
    points = points.keep(keep)
    point = points.place(geometry)
    echo = radar_equation(geometry, link, points.frame, [point])
    return points, point, echo, *_through_sheets(rays, points.frame, point.position)


def _through_sheets(rays: RayScene, frame: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
    """Transmittance of sheets on both segments (1 without any), and the length added."""
    link = rays.link
    if not rays.geometry.sheets:
        return torch.ones_like(position[:, 0]), torch.zeros_like(position[:, 0])
    transmittance, extra = passed(rays, link.tx[frame], position)
    if link.shared_visibility and torch.equal(link.tx, link.rx):
        return transmittance * transmittance, extra + extra
    other, more = passed(rays, link.rx[frame], position)
    return transmittance * other, extra + more
