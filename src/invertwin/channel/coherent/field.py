"""Fields: physical optics of conductors, fixed random-phase points and paths of rough surfaces."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.coherent import radar_equation
from invertwin.channel.coherent.multibounce_po import sample_surface_points, trace_multibounce_paths
from invertwin.channel.coherent.power_paths import ProjectedSilhouettes, trace_shadow_boundary_paths
from invertwin.channel.coherent.speckle import Speckle, draw_speckle
from invertwin.channel.em import antenna_fields as antennas
from invertwin.channel.em.depolarisation import random_scattering_matrix
from invertwin.channel.em.plane_waves import dot
from invertwin.channel.paths import Link, Paths, concatenate_paths
from invertwin.channel.rays import scene_tables
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.coplanar import refuse_coplanar_surfaces
from invertwin.channel.rays.ray_scene import RayScene, face_areas
from invertwin.channel.sampling import Sampling
from invertwin.errors import InputError
from invertwin.runtime.progress import track
from invertwin.scene.mesh_defects import require_single_surfaces
from invertwin.scene.polarisation import JonesTable, Polarisation
from invertwin.scene.scene import Scene

_ROWS_AT_ONCE = 1 << 18  # frames × paths


def trace_field(
    scene: Scene, link: Link, *, sampling: Sampling, seed: int, speckle: Speckle | None = None
) -> Paths:
    """Field paths: physical optics for conductors, fixed random-phase points for rough surfaces.

    Args:
        scene: Scene to trace.
        link: Antennas, per frame.
        sampling: Numbers of paths. From conductor to conductor they are mirrored, every
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
            ``boundary`` off to accept fixed visibility. A speckle of fewer bounces. Doubled
            surfaces.
    """
    depth = sampling.depth
    with tracing(sampling.backend):
        geometry = scene_tables.flatten(scene, link.wavelength, motion="fixed")
        moves = sampling.boundary and scene_tables.is_visibility_differentiated(geometry, link)
        require_single_surfaces(scene, allows_overlaps=True)
        rays = RayScene(geometry, link)
        viewers = torch.cat([link.tx, link.rx])
        refuse_coplanar_surfaces(rays, geometry.vertices, viewers, geometry.names)
        parts: list[Paths] = []
        if any(geometry.coherent):
            if sampling.boundary:
                scene_tables.require_silhouette_samples(geometry, link, sampling.boundary_samples)
            if moves and geometry.has_sheets:
                raise InputError(
                    "expected no sheets where a derivative of coherent fields moves silhouettes, "
                    "got some; use power paths, or boundary=False for fixed visibility"
                )
            parts += _trace_conductors(rays, sampling, seed)
        if moves and (depth > 1 or not all(geometry.coherent)):
            raise InputError(
                "expected no geometry derivative of rough field paths, got one: single points "
                "appear and vanish; use power paths, or boundary=False for fixed visibility"
            )
        if depth > 1:
            geometry.require_static(depth)
            parts += trace_multibounce_paths(rays, sampling, seed) if any(geometry.coherent) else []
        if all(geometry.coherent):
            return concatenate_paths(parts)
        fixed = speckle or draw_speckle(scene, link, sampling, seed)
        if len(fixed.paths) < depth - 1:
            raise InputError(
                f"expected speckle of paths of up to {depth} bounces, got "
                f"{len(fixed.paths) + 1}; draw it with this sampling"
            )
        smooth = torch.tensor(geometry.coherent)[geometry.face_object]
        for paths in (fixed.points, *fixed.paths[: depth - 1]):
            mixed = paths.select(~smooth[paths.face].all(1))
            parts += _trace_point_fields(rays, mixed, "rough", partial(_rough_field, link))
        return concatenate_paths(parts)


def _trace_point_fields(
    rays: RayScene,
    paths: radar_equation.SurfacePaths,
    kind: str,
    field: Callable[[radar_equation.SurfacePaths, radar_equation.PathTransfer], Tensor],
) -> list[Paths]:
    """The paths in every frame in which their field does not vanish."""
    found, count = [], len(paths.weight)
    frames = torch.arange(rays.link.frame_count)
    for some in track(frames.split(max(1, _ROWS_AT_ONCE // max(1, count))), f"{kind} paths"):
        frame, row = some.repeat_interleave(count), torch.arange(count).repeat(len(some))
        seen = radar_equation.find_unblocked(rays, frame, paths.select(row))
        kept = paths.select(row[seen])
        echo = radar_equation.evaluate_paths(rays, frame[seen], kept)
        velocity = kept.velocity(rays.geometry)
        coefficient, matrix = antennas.combine_elements(rays.link, field(kept, echo))
        rows = echo.to_paths(kind, coefficient=coefficient, matrix=matrix, velocity=velocity)
        face = kept.face[:, 0] if kept.face.shape[1] == 1 else torch.full_like(kept.face[:, 0], -1)
        share = torch.stack([kept.b1[:, 0], kept.b2[:, 0]], dim=1)
        rows = replace(rows, face=face, barycentric=share)
        found.append(rows.select(rows.has_field))
    return found


def _rough_field(
    link: Link, paths: radar_equation.SurfacePaths, echo: radar_equation.PathTransfer
) -> Tensor:
    """Amplitude sqrt(f · weight), with the phase of the path, from polarisation to polarisation."""
    # A root of zero has no derivative.
    lit = echo.power > 0
    root = (torch.where(lit, echo.power, 1.0) * paths.weight).sqrt()
    field = torch.polar(torch.where(lit, root, 0.0), paths.phase)
    return field[:, None, None] * rough_path_matrix(link, echo, paths.phase)


def _trace_conductors(rays: RayScene, sampling: Sampling, seed: int) -> list[Paths]:
    """Physical optics of the conductors, and its boundary paths."""
    coherent = torch.tensor(rays.geometry.coherent)[rays.geometry.face_object]

    def field(paths: radar_equation.SurfacePaths, echo: radar_equation.PathTransfer) -> Tensor:
        return conductor_matrix(rays.link, echo) * paths.weight[:, None, None]

    def boundary_paths(edge: ProjectedSilhouettes, echo: radar_equation.PathTransfer) -> Paths:
        speed = (edge.area_rate - edge.area_rate.detach()) * coherent[edge.face]
        fields = conductor_matrix(rays.link, echo).detach() * speed[:, None, None]
        coefficient, matrix = antennas.combine_elements(rays.link, fields)
        return echo.to_paths("coherent", coefficient=coefficient, matrix=matrix, boundary=True)

    areas = face_areas(rays.geometry) * coherent
    points = sample_surface_points(areas, sampling.count_conductor_samples(), seed)
    parts = _trace_point_fields(rays, points, "coherent", field)
    if sampling.boundary:
        parts += trace_shadow_boundary_paths(rays, sampling.boundary_samples, seed, boundary_paths)
    return parts


def conductor_matrix(
    link: Link, echo: radar_equation.PathTransfer
) -> Complex128[Tensor, "row r t"]:
    """Field coefficients per m² of a perfect conductor by physical optics; Jacobians included.

    ``a = (λ/4π) S / (R_t R_r)`` with ``S = −(jk/2π) ∫ p_r · [n × (d × p_t)] V dA`` (derivations §4
    and §13), the mean of both ways between separate antennas, which keeps reciprocity. Between
    antennas of one place that is ``(n·d) p_r · p_t``.
    Differs from the source: the paper gives no field of a surface.

    Args:
        link: Antennas.
        echo: The radar equation of single points.
    """
    (point,) = echo.points
    offsets = (point.position - antenna[echo.frame] for antenna in (link.tx, link.rx))
    ways = [normalize(offset, dim=1) for offset in offsets]
    normal = -dot(point.normal, ways[0]).sign()[:, None] * point.normal
    directional = any(isinstance(own.base, JonesTable) for own in (link.tx_jones, link.rx_jones))
    if torch.equal(link.tx, link.rx) and not directional:
        sent, received = link.tx_jones.evaluate(ways[0]), link.rx_jones.evaluate(ways[1])
        kernel = -0.5 * dot(normal, ways[0] + ways[1])[:, None, None] * (received @ sent.mT)
    else:
        rotation = link.rotations[echo.frame]
        sent = antennas.antenna_fields(link.tx_jones, rotation, ways[0])
        received = antennas.antenna_fields(link.rx_jones, rotation, ways[1])
        kernel = antennas.current_kernel(normal, ways[0], sent, ways[1], received)
    field = antennas.conductor_field(echo.spreading, kernel, -dot(normal, ways[1]))
    return field * point.jacobian[:, None, None]


def rough_path_matrix(
    link: Link, echo: radar_equation.PathTransfer, phase: Float64[Tensor, " row"]
) -> Complex128[Tensor, "#row r t"]:
    """Fields of rough paths between the vectors of both arrays, over those of V to V.

    Args:
        link: Antennas.
        echo: The radar equation of the paths.
        phase: phase of the paths.
    """
    rotation = link.rotations[echo.frame]

    def towards(jones: Polarisation, antenna: Tensor, position: Tensor) -> Tensor:
        if not isinstance(jones.base, JonesTable):
            return jones.base[None]
        way = normalize(position - antenna[echo.frame], dim=1)
        return jones.evaluate(torch.einsum("nij,ni->nj", rotation, way))

    sent = towards(link.tx_jones, link.tx, echo.points[0].position)
    received = towards(link.rx_jones, link.rx, echo.points[-1].position)
    return received @ random_scattering_matrix(echo.depolarisation, phase) @ sent.mT
