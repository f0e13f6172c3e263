"""Power paths as explicit rows in torch, float64: the reference of ``deposit_power``.

Boundary paths of one bounce tell how fast a shadow's edge moves over a surface.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.coherent import radar_equation
from invertwin.channel.coherent.radar_equation import PathTransfer, SurfacePaths, evaluate_paths
from invertwin.channel.em.depolarisation import received_power_fraction
from invertwin.channel.em.plane_waves import barycentric_coordinates, dot
from invertwin.channel.paths import Link, Paths, concatenate_paths
from invertwin.channel.power.integrand import Inputs
from invertwin.channel.power.random_walk import PathRecords
from invertwin.channel.power.silhouettes import SilhouetteSample, SilhouetteSampler
from invertwin.channel.power.trace import PowerTracer
from invertwin.channel.rays import scene_tables
from invertwin.channel.rays.arrays import to_torch
from invertwin.channel.rays.backend import dr, mi, tracing
from invertwin.channel.rays.ray_scene import RayScene, is_visible
from invertwin.channel.sampling import Sampling
from invertwin.errors import InputError
from invertwin.scene.scene import Scene


@dataclass(frozen=True)
class ProjectedSilhouettes:
    """Points on the edge of a shadow.

    Attributes:
        frame, face: Radar pose, and the triangle the shadow falls on.
        b1, b2: Barycentric coordinates on the triangle.
        point: Place where the shadow falls, detached.
        area_rate: Area newly lit per unit of θ, over the probability of the sample: attached, and
            zero in derivative where the other antenna does not see the point.
    """

    frame: Int64[Tensor, " n"]
    face: Int64[Tensor, " n"]
    b1: Float64[Tensor, " n"]
    b2: Float64[Tensor, " n"]
    point: radar_equation.MaterialPoints
    area_rate: Float64[Tensor, " n"]


def project_silhouettes(rays: RayScene, points: SilhouetteSample) -> ProjectedSilhouettes:
    """Turn edge points into shadow points with the attached speed of the shadow's edge.

    ``T · (x_c − x_m)``: x_c is where the attached ray meets the attached plane behind the edge,
    x_m the material point under it; T is the edge's image turned to the shadowed side.
    Source: derivations §3.

    Args:
        rays: The scene and its antennas.
        points: Points on silhouettes.
    """
    geometry, link = rays.geometry, rays.link
    indices = points.frame, points.edge, points.face
    frame, edges, face = (to_torch(column).long() for column in indices)
    numbers = points.side, points.edge_parameter, points.weight
    side, share, weight = (to_torch(column).double() for column in numbers)
    receiver = points.is_receiver
    receiver = torch.tensor(receiver) if isinstance(receiver, bool) else to_torch(receiver).bool()
    tx, rx, from_receiver = link.tx[frame], link.rx[frame], receiver.reshape(-1, 1)
    c, other = torch.where(from_receiver, rx, tx), torch.where(from_receiver, tx, rx)
    y0, y1 = geometry.vertices[rays.topology.edges[edges]].unbind(1)
    y = y0 + (y1 - y0) * share[:, None]
    p0, p1, p2 = geometry.corners(face)
    plane = torch.linalg.cross(p1 - p0, p2 - p0)
    moving = c + (y - c) * (dot(plane, p0 - c) / dot(plane, y - c))[:, None]

    shadow, normal = moving.detach(), normalize(plane.detach(), dim=1)
    b1, b2 = barycentric_coordinates(torch.stack([p0, p1, p2], 1).detach(), shadow)[:, 1:].unbind(1)
    material = scene_tables.interpolate_values((p0, p1, p2), b1, b2)

    ray, edge = (y - c).detach(), (y1 - y0).detach()
    stretch = (shadow - c.detach()).norm(dim=1) / ray.norm(dim=1)

    def project(vector: Tensor) -> Tensor:
        return stretch[:, None] * (vector - ray * (dot(normal, vector) / dot(normal, ray))[:, None])

    tangent = torch.linalg.cross(normal, project(edge)) * (side * dot(normal, ray).sign())[:, None]
    if not link.shared_visibility:
        weight = weight * is_visible(rays, shadow, other)
    speed = dot(tangent, moving - material) * weight
    place = shadow, normal, torch.ones_like(b1), geometry.face_surface[face]
    point = radar_equation.MaterialPoints(*place)
    return ProjectedSilhouettes(frame, face, b1, b2, point, speed)


def trace_shadow_boundary_paths(
    rays: RayScene,
    samples: int,
    seed: int,
    make_paths: Callable[[ProjectedSilhouettes, PathTransfer], Paths],
) -> list[Paths]:
    """Boundary paths of one bounce, of the segments at all antennas; none without silhouettes.

    Args:
        rays: The scene and its antennas.
        samples: Silhouette points over all antennas and frames.
        seed: Seed of the points.
        make_paths: Makes paths of shadow points and of the radar equation there.
    """
    centres = ("tx",) if rays.link.shared_visibility else ("tx", "rx")
    count = samples // len(centres) * len(centres)
    resting = dr.zeros(mi.UInt32, len(rays.topology.edges))
    inputs = Inputs.from_rays(rays)
    sampler = SilhouetteSampler(inputs, centres, count, seed, resting=resting)
    if not sampler.size:
        return []
    edge = project_silhouettes(rays, sampler.draw(dr.arange(mi.UInt32, sampler.size)).compress())
    with torch.no_grad():
        echo = radar_equation.radar_equation(rays.geometry, rays.link, edge.frame, [edge.point])
    return [make_paths(edge, echo)]


def trace_power(scene: Scene, link: Link, *, sampling: Sampling, seed: int) -> Paths:
    """Power paths by rays from the antenna, as explicit rows; for inspection and as a reference.

    The paths are those that :func:`invertwin.channel.deposit_power` sums. Objects may move: then
    every path of one bounce has the velocity of its point, differentiable with respect to the
    velocities of the objects.

    Args:
        scene: Scene to trace.
        link: Antennas, per frame.
        sampling: Numbers of paths.
        seed: Same seed, same paths.

    Raises:
        InputError: See ``deposit_power``; boundary paths of more than one bounce or past sheets;
            several bounces of objects in motion.
    """
    boundary, edges, depth = sampling.boundary, sampling.boundary_samples, sampling.depth
    with tracing(sampling.backend):
        geometry = scene_tables.flatten(scene, link.wavelength, motion="free")
        if depth > 1:
            geometry.require_static(depth)
        simple = depth == 1 and not geometry.has_sheets
        if boundary and not simple and scene_tables.is_visibility_differentiated(geometry, link):
            raise InputError(
                "expected explicit paths of one bounce without sheets for derivatives in which "
                f"silhouettes move, got {depth} bounces or sheets; use deposit_power, or "
                "boundary=False for fixed visibility"
            )
        if boundary and simple:
            scene_tables.require_silhouette_samples(geometry, link, edges)
        trace = PowerTracer(geometry, link, sampling, seed)
        if trace.curves is not None and len(trace.curves.first):
            raise InputError(
                "expected surfaces that do not meet for derivatives of explicit paths, got some "
                "that cross or touch; use deposit_power, or contacts=False to leave out what moves"
            )
        walks = trace.iterate_records()
        parts = [paths for records in walks for paths in _read_random_walk(trace, records)]
        if boundary and simple and edges:
            parts += trace_shadow_boundary_paths(
                trace.rays, edges, seed, lambda *found: _boundary_paths(geometry, link, *found)
            )
        return concatenate_paths(parts)


def _boundary_paths(
    geometry: scene_tables.Geometry, link: Link, shadow: ProjectedSilhouettes, echo: PathTransfer
) -> Paths:
    """Boundary paths: no power, but a derivative."""
    amount = echo.power * received_power_fraction(link, echo.depolarisation) * shadow.area_rate
    velocity = geometry.velocity(shadow.face, shadow.b1, shadow.b2)
    velocity = None if velocity is None else velocity.detach()
    return echo.to_paths("power", power=amount - amount.detach(), boundary=True, velocity=velocity)


def _read_random_walk(trace: PowerTracer, records: PathRecords) -> Iterator[Paths]:
    """The paths of one point, of two and so on, with the kernel's throughput at the last point."""
    vertices = [records.read_vertex(mi.UInt32(number)) for number in range(records.depth)]
    names = ("face", "b1", "b2", "throughput", "is_visible")
    columns = [[to_torch(getattr(vertex, name)) for vertex in vertices] for name in names]
    face, b1, b2, throughput, seen = (torch.stack(column, dim=1) for column in columns)
    for count in range(1, records.depth + 1):
        lit = seen[:, count - 1].bool()
        weight = throughput[lit, count - 1].double()
        places = face[lit, :count].long(), b1[lit, :count].double(), b2[lit, :count].double()
        paths = SurfacePaths(*places, weight, torch.zeros_like(weight))
        found = evaluate_paths(trace.rays, to_torch(records.frame).long()[lit], paths)
        power = weight * found.power / found.incident_power.detach().clamp_min(1e-300)
        power = power * received_power_fraction(trace.rays.link, found.depolarisation)
        yield found.to_paths("power", power=power, velocity=paths.velocity(trace.rays.geometry))
