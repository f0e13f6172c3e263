"""Fields: physical optics of conductors, fixed random-phase points and paths of rough surfaces."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from invertwin.channel.coherent.boundary_paths import ShadowEdge, boundary_rows
from invertwin.channel.coherent.multibounce_po import mirrored_paths, spread_points
from invertwin.channel.coherent.polarised_scattering import mirror_matrix, rough_matrix
from invertwin.channel.coherent.radar_equation import (
    Echo,
    SurfacePaths,
    path_view,
    unblocked,
)
from invertwin.channel.coherent.speckle import Speckle, draw_speckle
from invertwin.channel.em.antenna_fields import combined
from invertwin.channel.paths import Link, Paths, joined
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.ray_scene import RayScene, face_areas
from invertwin.channel.rays.scene_tables import flatten, require_edges, silhouettes_move
from invertwin.channel.sampling import Sampling
from invertwin.errors import InputError
from invertwin.runtime.progress import told
from invertwin.scene.scene import Scene

_ROWS_AT_ONCE = 1 << 18  # frames × paths


def trace_field(
    scene: Scene, link: Link, *, sampling: Sampling, seed: int, speckle: Speckle | None = None
) -> Paths:
    """Field paths: physical optics for conductors, fixed random-phase points for rough surfaces.

    Args:
        scene: What is seen.
        link: Antennas, per frame.
        sampling: How many paths are drawn. From conductor to conductor they are mirrored, every
            bounce in phase; between other surfaces every ordered path has a fixed phase, and
            conductors scatter by their lobe.
        seed: Places and phases.
        speckle: The rough points and paths to use, so that they stay while the scene moves; None
            draws them from the seed.

    Source: derivations §4.
    Differs from the source: rough fields have fixed points, not new phases every evaluation.

    Raises:
        InputError: A derivative of rough field paths with ``boundary`` on: single points appear
            and vanish, so a realisation has no boundary term. Use power paths, or switch
            ``boundary`` off to accept fixed visibility. A speckle of fewer bounces.
    """
    depth = sampling.depth
    with tracing(sampling.backend):
        geometry = flatten(scene, link.wavelength, motion="fixed")
        moves = sampling.boundary and silhouettes_move(geometry, link)
        rays = RayScene(geometry, link)
        parts: list[Paths] = []
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
            raise InputError(
                "expected no geometry derivative of rough field paths, got one: single points "
                "appear and vanish; use power paths, or boundary=False for fixed visibility"
            )
        if depth > 1:
            geometry.require_rest(depth)
            parts += mirrored_paths(rays, sampling, seed) if any(geometry.coherent) else []
        if all(geometry.coherent):
            return joined(parts)
        fixed = speckle or draw_speckle(scene, link, sampling, seed)
        if len(fixed.paths) < depth - 1:
            raise InputError(
                f"expected speckle of paths of up to {depth} bounces, got "
                f"{len(fixed.paths) + 1}; draw it with this sampling"
            )
        smooth = torch.tensor(geometry.coherent)[geometry.face_object]
        for paths in (fixed.points, *fixed.paths[: depth - 1]):
            mixed = paths.keep(~smooth[paths.face].all(1))
            parts += _fields(rays, mixed, "rough", partial(_rough_field, link))
        return joined(parts)


def _fields(
    rays: RayScene, paths: SurfacePaths, kind: str, field: Callable[[SurfacePaths, Echo], Tensor]
) -> list[Paths]:
    """The paths in every frame in which their field does not vanish."""
    found, count = [], len(paths.weight)
    frames = torch.arange(rays.link.frame_count)
    for some in told(frames.split(max(1, _ROWS_AT_ONCE // max(1, count))), f"{kind} paths"):
        frame, row = some.repeat_interleave(count), torch.arange(count).repeat(len(some))
        seen = unblocked(rays, frame, paths.keep(row))
        kept = paths.keep(row[seen])
        echo = path_view(rays, frame[seen], kept)
        velocity = kept.velocity(rays.geometry)
        coefficient, matrix = combined(rays.link, field(kept, echo))
        rows = echo.paths(kind, coefficient=coefficient, matrix=matrix, velocity=velocity)
        single = kept.face.shape[1] == 1
        face = kept.face[:, 0] if single else torch.full_like(kept.face[:, 0], -1)
        share = torch.stack([kept.b1[:, 0], kept.b2[:, 0]], dim=1)
        rows = replace(rows, face=face, share=share)
        found.append(rows.chosen(rows.carries))
    return found


def _rough_field(link: Link, paths: SurfacePaths, echo: Echo) -> Tensor:
    """Amplitude sqrt(f · weight), with the phase of the path, from polarisation to polarisation."""
    # A root of zero has no derivative.
    lit = echo.power > 0
    root = (torch.where(lit, echo.power, 1.0) * paths.weight).sqrt()
    field = torch.polar(torch.where(lit, root, 0.0), paths.phase)
    return field[:, None, None] * rough_matrix(link, echo, paths.phase)


def _conductors(rays: RayScene, sampling: Sampling, seed: int) -> list[Paths]:
    """Physical optics of the conductors, and its boundary paths."""
    coherent = torch.tensor(rays.geometry.coherent)[rays.geometry.face_object]

    def field(paths: SurfacePaths, echo: Echo) -> Tensor:
        return mirror_matrix(rays.link, echo) * paths.weight[:, None, None]

    def row(edge: ShadowEdge, echo: Echo) -> Paths:
        speed = (edge.speed - edge.speed.detach()) * coherent[edge.face]
        fields = mirror_matrix(rays.link, echo).detach() * speed[:, None, None]
        coefficient, matrix = combined(rays.link, fields)
        return echo.paths("coherent", coefficient=coefficient, matrix=matrix, boundary=True)

    points = spread_points(face_areas(rays.geometry) * coherent, sampling.samples, seed)
    parts = _fields(rays, points, "coherent", field)
    if sampling.boundary:
        parts += boundary_rows(rays, sampling.boundary_samples, seed, row)
    return parts
