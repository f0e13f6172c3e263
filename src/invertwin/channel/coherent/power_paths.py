"""Power paths as explicit rows in torch, float64: the reference of ``deposit_power``."""

from collections.abc import Iterator

import torch

from invertwin.channel.coherent.boundary_paths import ShadowEdge, boundary_rows
from invertwin.channel.coherent.radar_equation import Echo, SurfacePaths, path_view
from invertwin.channel.em.depolarisation import coupled_power
from invertwin.channel.paths import Link, Paths, joined
from invertwin.channel.power.random_walk import Records
from invertwin.channel.power.trace import Trace
from invertwin.channel.rays.arrays import to_torch
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.scene_tables import Geometry, flatten, require_edges, silhouettes_move
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
            geometry.require_rest(depth)
        simple = depth == 1 and not geometry.sheets
        if boundary and not simple and silhouettes_move(geometry, link):
            raise InputError(
                "expected explicit paths of one bounce without sheets for derivatives in which "
                f"silhouettes move, got {depth} bounces or sheets; use deposit_power, or "
                "boundary=False for fixed visibility"
            )
        if boundary and simple:
            require_edges(geometry, link, edges)
        trace = Trace(geometry, link, sampling, seed)
        if trace.contacts is not None and len(trace.contacts.first):
            raise InputError(
                "expected surfaces that do not meet for derivatives of explicit paths, got some "
                "that cross or touch; use deposit_power, or contacts=False to leave out what moves"
            )
        parts = [paths for records in trace.records() for paths in _walked(trace, records)]
        if boundary and simple and edges:
            parts += boundary_rows(
                trace.rays, edges, seed, lambda *found: _row(geometry, link, *found)
            )
        return joined(parts)


def _row(geometry: Geometry, link: Link, edge: ShadowEdge, echo: Echo) -> Paths:
    """Boundary paths: no power, but a derivative."""
    amount = echo.power * coupled_power(link, echo.depolarisation) * edge.speed
    velocity = geometry.velocity(edge.face, edge.b1, edge.b2)
    return echo.paths(
        "power",
        power=amount - amount.detach(),
        boundary=True,
        velocity=None if velocity is None else velocity.detach(),
    )


def _walked(trace: Trace, records: Records) -> Iterator[Paths]:
    """The paths of one point, of two and so on; the kernel says what arrives at the last point."""
    vertices = [records.at(number) for number in range(records.depth)]
    face, b1, b2, throughput, seen = (
        torch.stack([to_torch(getattr(vertex, name)) for vertex in vertices], dim=1)
        for name in ("face", "b1", "b2", "throughput", "seen")
    )
    for count in range(1, records.depth + 1):
        lit = seen[:, count - 1].bool()
        weight = throughput[lit, count - 1].double()
        places = face[lit, :count].long(), b1[lit, :count].double(), b2[lit, :count].double()
        paths = SurfacePaths(*places, weight, torch.zeros_like(weight))
        found = path_view(trace.rays, to_torch(records.frame).long()[lit], paths)
        power = weight * found.power / found.arriving.detach().clamp_min(1e-300)
        power = power * coupled_power(trace.rays.link, found.depolarisation)
        yield found.paths("power", power=power, velocity=paths.velocity(trace.rays.geometry))
