"""The fused deposit, differentiated by Dr.Jit from end to end: no hand-written adjoint."""

from dataclasses import replace
from typing import Any

import drjit as dr
from torch import Tensor

from invertwin.channel import Grid, Link, Sampling
from invertwin.channel.power import replay
from invertwin.channel.power.bins import PathContribution
from invertwin.channel.power.integrand import DIFFERENTIABLE, from_table
from invertwin.channel.power.trace import PowerTracer, differentiable_tables
from invertwin.channel.rays.arrays import to_float
from invertwin.channel.rays.backend import mi
from invertwin.channel.rays.scene_tables import flatten
from invertwin.scene import Scene


def gradients(
    scene: Scene, link: Link, grid: Grid, weights: Tensor, *, samples: int, edges: int, seed: int
) -> dict[str, Tensor]:
    """∂ Σ weights · map / ∂ every table of the kernel."""
    sampling = Sampling(depth=1, samples=samples, boundary_samples=edges, memory_budget=1e12)
    trace = PowerTracer(flatten(scene, link.wavelength), link, sampling, seed)
    tables = {name: mi.Float(trace.fixed.table(name)) for name in DIFFERENTIABLE}
    dr.enable_grad(list(tables.values()))
    inputs, out = trace.inputs(tables), mi.Float(0)
    for records in trace.iterate_records():
        number, antennas = mi.UInt32(0), replay._locate_antennas(inputs, records.frame)
        near = replay._VertexNeighbours.read(inputs, records, number, records.depth)
        vertex = replay._evaluate_vertex(inputs, records, antennas, number, near)
        path, arriving = vertex.path, vertex.incident_factor
        power = dr.select(vertex.is_visible, path.power * (arriving / dr.detach(arriving)), 0)
        length = 0.5 * (vertex.optical_length + vertex.distance)
        out += _weighted(grid, weights, replace(path, power=power, range=length))
    for paths in trace.trace_boundary(inputs):

        def visit(_: Any, path: PathContribution, exists: Any, speed: Any = paths.speed) -> None:
            nonlocal out
            amount = dr.select(exists, path.power, 0) * speed
            zero = dr.zeros(mi.Float, dr.width(amount))
            boundary = replace(path, power=dr.replace_grad(zero, amount))
            out += _weighted(grid, weights, boundary)

        paths.run(dict(paths.state), visit)
    dr.backward(out)
    likes = differentiable_tables(trace.rays.geometry, trace.rays.link)
    by_name: dict[str, Tensor] = dict(zip(DIFFERENTIABLE, likes, strict=True))
    return {name: from_table(name, dr.grad(tables[name]), by_name[name]) for name in tables}


def _weighted(grid: Grid, weights: Tensor, found: PathContribution) -> Any:
    """Σ weights · map of these paths, with B-spline weights that carry derivatives."""
    flat, total = to_float(weights), mi.Float(0)
    axes = [
        _taps(position, *ends)
        for position, ends in zip(
            (found.range, found.u, found.v),
            (
                (grid.range_start, grid.range_step, grid.range_count),
                (grid.u_start, grid.u_step, grid.u_count),
                (grid.v_start, grid.v_step, grid.v_count),
            ),
            strict=True,
        )
    ]
    for i, wi in axes[0]:
        for j, wj in axes[1]:
            for k, wk in axes[2]:
                inside = (i >= 0) & (i < grid.range_count) & (j >= 0) & (j < grid.u_count)
                inside &= (k >= 0) & (k < grid.v_count)
                place = ((mi.Int32(found.frame) * grid.range_count + i) * grid.u_count + j) * (
                    grid.v_count
                ) + k
                weight = dr.gather(mi.Float, flat, mi.UInt32(place), inside)
                total += dr.sum(weight * found.power * wi * wj * wk)
    return total


def _taps(position: Any, start: float, step: float, count: int) -> list[tuple[Any, Any]]:
    if count == 1:
        return [(mi.Int32(0), mi.Float(1))]
    t = (position - start) / step
    nearest = dr.round(dr.detach(t))
    taps = []
    for offset in (-1, 0, 1):
        away = dr.abs(t - (nearest + offset))
        weight = dr.select(away < 0.5, 0.75 - away * away, 0.5 * (1.5 - away) * (1.5 - away))
        taps.append((mi.Int32(nearest) + offset, dr.select(away < 1.5, weight, 0)))
    return taps
