"""Power paths as explicit rows in torch, float64: the reference of ``deposit_power``."""

from collections.abc import Iterator

import torch

from invertwin.channel.coherent.boundary_paths import (
    ProjectedSilhouettes,
    trace_shadow_boundary_paths,
)
from invertwin.channel.coherent.radar_equation import PathTransfer, SurfacePaths, evaluate_paths
from invertwin.channel.em.depolarisation import received_power_fraction
from invertwin.channel.paths import Link, Paths, concatenate_paths
from invertwin.channel.power.random_walk import PathRecords
from invertwin.channel.power.trace import PowerTracer
from invertwin.channel.rays.arrays import to_torch
from invertwin.channel.rays.backend import mi, tracing
from invertwin.channel.rays.scene_tables import (
    Geometry,
    flatten,
    is_visibility_differentiated,
    require_silhouette_samples,
)
from invertwin.channel.sampling import Sampling
from invertwin.errors import InputError
from invertwin.scene.scene import Scene


def trace_power(scene: Scene, link: Link, *, sampling: Sampling, seed: int) -> Paths:
    """Power paths by rays from the antenna, as explicit rows; for inspection and as a reference.

    The paths are those that :func:`invertwin.channel.deposit_power` sums. Objects may move: then
    every path of one bounce has the velocity of its point, differentiable with respect to the
    velocities of the objects.

    Args:
        scene: What is seen.
        link: Antennas, per frame.
        sampling: How many paths are drawn.
        seed: Same seed, same paths.

    Raises:
        InputError: See ``deposit_power``; boundary paths of more than one bounce or past sheets;
            several bounces of objects in motion.
    """
    boundary, edges, depth = sampling.boundary, sampling.boundary_samples, sampling.depth
    with tracing(sampling.backend):
        geometry = flatten(scene, link.wavelength, motion="free")
        if depth > 1:
            geometry.require_static(depth)
        simple = depth == 1 and not geometry.has_sheets
        if boundary and not simple and is_visibility_differentiated(geometry, link):
            raise InputError(
                "expected explicit paths of one bounce without sheets for derivatives in which "
                f"silhouettes move, got {depth} bounces or sheets; use deposit_power, or "
                "boundary=False for fixed visibility"
            )
        if boundary and simple:
            require_silhouette_samples(geometry, link, edges)
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
    geometry: Geometry, link: Link, shadow: ProjectedSilhouettes, echo: PathTransfer
) -> Paths:
    """Boundary paths: no power, but a derivative."""
    amount = echo.power * received_power_fraction(link, echo.depolarisation) * shadow.area_rate
    velocity = geometry.velocity(shadow.face, shadow.b1, shadow.b2)
    velocity = None if velocity is None else velocity.detach()
    power = amount - amount.detach()
    return echo.to_paths("power", power=power, boundary=True, velocity=velocity)


def _read_random_walk(trace: PowerTracer, records: PathRecords) -> Iterator[Paths]:
    """The paths of one point, of two and so on; the kernel says what arrives at the last point."""
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
