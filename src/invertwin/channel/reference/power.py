"""Power paths as explicit rows in torch, float64: the reference of ``deposit_power``."""

from dataclasses import fields

import torch
from torch import Tensor

from invertwin.channel.paths import Link, Paths, joined, listed
from invertwin.channel.power.integrand import Inputs
from invertwin.channel.power.starts import RaySampler
from invertwin.channel.power.trace import Trace
from invertwin.channel.rays.arrays import to_torch
from invertwin.channel.rays.backend import dr, mi, use_backend
from invertwin.channel.rays.geometry import (
    Geometry,
    flatten,
    require_edges,
    silhouettes_move,
)
from invertwin.channel.rays.scene import RayScene, visible
from invertwin.channel.reference.radar_equation import (
    Echo,
    SurfacePaths,
    SurfacePoints,
    path_view,
    radar_equation,
)
from invertwin.channel.reference.shadows import ShadowEdge, boundary_rows
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
    with use_backend(sampling.backend):
        geometry = flatten(scene, link.wavelength, motion="free")
        if depth > 1:
            geometry.require_rest(depth)
        if boundary and silhouettes_move(geometry, link) and (depth > 1 or geometry.sheets):
            raise InputError(
                "expected explicit paths of one bounce without sheets for derivatives in which "
                "silhouettes move; use deposit_power, or boundary=False for fixed visibility"
            )
        if depth > 1 or geometry.sheets:
            return _walked(geometry, link, sampling, seed)
        if boundary:
            require_edges(geometry, link, edges)
        rays = RayScene(geometry, link)
        inner = _interior(rays, sampling.samples, seed)
        if not (boundary and edges):
            return inner
        return inner + boundary_rows(rays, edges, seed, lambda *found: _boundary_row(rays, *found))


def _interior(rays: RayScene, samples: int, seed: int) -> Paths:
    """Paths of one bounce, without sheets."""
    geometry, link = rays.geometry, rays.link
    sampler = RaySampler(rays, samples, seed)
    drawn = sampler.draw(dr.arange(mi.UInt32, sampler.size), Inputs.of(rays))
    columns = [to_torch(getattr(drawn, f.name)) for f in fields(SurfacePoints)]
    points = SurfacePoints(*(c.long() for c in columns[:2]), *(c.double() for c in columns[2:]))
    points = points.keep(points.weight > 0)
    if not link.shared_visibility:
        with torch.no_grad():
            position = points.place(geometry).position
        points = points.keep(visible(rays, position, link.rx[points.frame]))
    place = points.place(geometry)
    echo = radar_equation(geometry, link, points.frame, [place])
    return listed(
        points.frame,
        echo.length,
        place.position,
        "power",
        power=echo.power * points.weight,
        velocity=points.velocity(geometry),
    )


def _boundary_row(rays: RayScene, edge: ShadowEdge, echo: Echo) -> Paths:
    amount = echo.power * edge.speed
    velocity = rays.geometry.velocity(edge.face, edge.b1, edge.b2)
    return listed(
        edge.frame,
        echo.length,
        edge.place.position,
        "power",
        power=amount - amount.detach(),
        boundary=True,
        velocity=None if velocity is None else velocity.detach(),
    )


def _walked(geometry: Geometry, link: Link, sampling: Sampling, seed: int) -> Paths:
    """The paths that ``deposit_power`` walks, evaluated in torch."""
    trace, depth = Trace(geometry, link, sampling, seed), sampling.depth
    parts = []
    for records in trace.records():
        frame = to_torch(records.frame).long()
        columns = [
            to_torch(column).reshape(depth, -1).T
            for column in (records.face, records.b1, records.b2, records.throughput, records.seen)
        ]
        parts += [_recorded(trace, frame, columns, count) for count in range(1, depth + 1)]
    return joined(parts)


def _recorded(trace: Trace, frame: Tensor, columns: list[Tensor], count: int) -> Paths:
    """The paths of as many points; their values are the kernel's up to the last point."""
    seen = columns[4][:, count - 1].bool()
    face, b1, b2 = (column[seen, :count] for column in columns[:3])
    weight = columns[3][seen, count - 1].double()
    paths = SurfacePaths(face.long(), b1.double(), b2.double(), weight, torch.zeros_like(weight))
    found = path_view(trace.rays, frame[seen], paths)
    follows = found.power / found.power.detach().clamp_min(1e-300)
    return listed(
        frame[seen],
        found.length,
        found.last,
        "power",
        power=weight * found.ending * follows,
        first=found.first,
        velocity=trace.rays.geometry.velocity(paths.face[:, -1], paths.b1[:, -1], paths.b2[:, -1]),
    )
