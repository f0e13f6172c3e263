"""Several bounces between conductors: mirrored paths, all in phase.

A ray from the antenna is mirrored by conductor after conductor. Wherever it ends, the current that
its field induces there sends to the other antenna: physical optics of every order, as in
``signature``, for antennas near by. The way unfolds to a straight line from an image of the
antenna, so that delays are exact for every element of an array.
"""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.channel.coherent.radar_equation import SurfacePaths, trace_transmittance
from invertwin.channel.em import antenna_fields as antennas
from invertwin.channel.em.plane_waves import dot, reflect_vectors, triangle_normals
from invertwin.channel.paths import Paths
from invertwin.channel.rays.ray_scene import RAY_EPSILON, RayScene, face_areas, find_next_surface
from invertwin.channel.rays.scene_tables import is_visibility_differentiated
from invertwin.channel.sampling import Sampling
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.runtime.progress import track

_R2_STEPS = (0.754_877_666_246_692_7, 0.569_840_290_998_053_2)  # the R2 low-discrepancy sequence
_ROWS_AT_ONCE = 1 << 18  # frames × rays


def trace_multibounce_paths(rays: RayScene, sampling: Sampling, seed: int) -> list[Paths]:
    """Field paths of two bounces and more that only conductors mirror; detached.

    ``a = −(j/4π) √(G_t G_r)/(R r) p_r · [n × (d × E)] dA`` after m bounces, R the unfolded way to
    the last one, E ← 2(n·E)n − E at the others. The bracket is the mean of both ways, as in
    ``conductor_matrix``. Rays begin at both antennas, each way with half of the field, which keeps
    reciprocity.

    Args:
        rays: The scene and its antennas.
        sampling: Number of rays per frame, most bounces.
        seed: Seed of the points where rays meet the first conductor.

    Source: derivations §13.

    Raises:
        InputError: There are some, and a derivative flows through the scene or the antennas.
    """
    geometry = rays.geometry
    smooth = torch.tensor(geometry.coherent)[geometry.face_object]
    areas = face_areas(geometry) * smooth
    points = sample_surface_points(areas, sampling.count_conductor_samples(), seed)
    link = rays.link
    same = torch.equal(link.tx, link.rx) and link.tx_jones.equals(link.rx_jones)
    found: list[Paths] = []
    frames = torch.arange(rays.link.frame_count)
    with torch.no_grad():
        for some in track(frames.split(max(1, _ROWS_AT_ONCE // len(points.weight))), "mirrors"):
            row = torch.arange(len(points.weight)).repeat(len(some))
            frame = some.repeat_interleave(len(points.weight))
            for from_receiver in (False,) if same else (False, True):
                share = 1.0 if same else 0.5
                own = points.select(row)
                chain = _follow_rays(rays, sampling.depth, smooth, frame, own, from_receiver)
                lit = [paths.select(paths.has_field).scale_fields(share) for paths in chain]
                found += [paths for paths in lit if len(paths)]
    if found and is_visibility_differentiated(geometry, rays.link):
        raise InputError(
            "expected depth 1 for derivatives of fields between conductors, got "
            f"{sampling.depth}: mirrored paths have none; use depth=1, power paths, or rcs"
        )
    return found


def _follow_rays(
    rays: RayScene,
    depth: int,
    is_conductor: Tensor,
    frame: Tensor,
    points: SurfacePaths,
    from_receiver: bool,
) -> Iterator[Paths]:
    """Follow rays from one antenna by way of their first points."""
    link, geometry = rays.link, rays.geometry
    tx, rx = (link.tx, link.tx_pattern, link.tx_jones), (link.rx, link.rx_pattern, link.rx_jones)
    here, own, own_jones = rx if from_receiver else tx
    there, other, other_jones = tx if from_receiver else rx
    (place,) = points.material_points(geometry)
    antenna, position = here[frame], place.position
    seen, extra = trace_transmittance(rays, antenna, position)
    keep = torch.nonzero(seen > 0)[:, 0]
    frame, position, antenna = frame[keep], position[keep], antenna[keep]
    normal, through, extra = place.normal[keep], seen[keep], extra[keep]
    length = (position - antenna).norm(dim=1)
    start = (position - antenna) / length[:, None]
    gain = own.gain(torch.einsum("nij,ni->nj", link.rotations[frame], start)) * through
    # The solid angle of a ray, from the area that its first point stands for.
    angle = points.weight[keep] * dot(normal, start).abs() / length**2
    direction = start
    sent = antennas.antenna_fields(own_jones, link.rotations[frame], start)
    extent = geometry.vertices.detach()
    reach = float((extent.amax(0) - extent.amin(0)).norm()) * 1.01
    for _ in range(2, depth + 1):
        # Rays begin a little above the mirror: the ray tracer rounds places far from the antennas.
        above = -dot(normal, direction).sign() * RAY_EPSILON * (position - rays.origin).norm(dim=1)
        direction = reflect_vectors(direction, normal)
        sent = -reflect_vectors(sent, normal[:, None])
        begin = position + above[:, None] * normal
        face, _ = find_next_surface(rays, begin, begin + reach * direction)
        hit = (face >= 0) & is_conductor[face.clamp_min(0)]
        columns = (face, frame, position, length, start, gain, angle, direction, sent, extra)
        face, frame, position, length, start, gain, angle, direction, sent, extra = (
            column[hit] for column in columns
        )
        corners = geometry.vertices.detach()[geometry.faces[face]]
        normal, p0 = triangle_normals(corners), corners[:, 0]
        facing = dot(normal, direction)
        way = dot(normal, p0 - position) / torch.where(facing == 0, torch.ones_like(facing), facing)
        position, length = position + way[:, None] * direction, length + way
        offset = there[frame] - position
        distance = offset.norm(dim=1)
        onwards = offset / distance[:, None]
        leaving = torch.einsum("nij,ni->nj", link.rotations[frame], -onwards)
        open_, more = trace_transmittance(rays, position, there[frame])
        spread = gain * other.gain(leaving) * open_ / (length * distance) ** 2
        area = angle * length**2 / facing.abs().clamp_min(1e-9)
        lit_normal = -facing.sign()[:, None] * normal
        received = antennas.antenna_fields(other_jones, link.rotations[frame], -onwards)
        kernel = antennas.current_kernel(lit_normal, direction, sent, -onwards, received)
        fields = (
            antennas.conductor_field(spread, kernel, dot(lit_normal, onwards)) * area[:, None, None]
        )
        fields = fields.mT if from_receiver else fields
        delay = (length + distance + extra + more) / SPEED_OF_LIGHT
        image = here[frame] + length[:, None] * start  # the last point, unfolded
        ends = (position, image) if from_receiver else (image, position)
        yield antennas.coherent_paths(link, frame, delay, fields, *ends)


def sample_surface_points(areas: Float64[Tensor, " f"], count: int, seed: int) -> SurfacePaths:
    """Low-discrepancy points over triangles (error of an integral: 1/count).

    Args:
        areas: areas of the triangles; those of none get no point.
        count: number of points.
        seed: seed of their positions.
    """
    rng = np.random.default_rng(seed)
    shift = rng.random(2)
    index = np.arange(count)
    edges = np.cumsum(areas.numpy())
    # Jittered, not evenly spaced: even steps would beat with the order of a subdivided mesh.
    place = (index + rng.random(count)) / count * edges[-1]
    face = np.minimum(np.searchsorted(edges, place, side="right"), len(edges) - 1)
    b = (shift[:, None] + index * np.array(_R2_STEPS)[:, None]) % 1.0
    b = np.where(b.sum(0) > 1, 1 - b, b)
    b1, b2 = torch.from_numpy(b)[..., None]
    weight = torch.full((count,), float(edges[-1]) / count, dtype=torch.float64)
    return SurfacePaths(torch.from_numpy(face)[:, None], b1, b2, weight, torch.zeros_like(weight))
