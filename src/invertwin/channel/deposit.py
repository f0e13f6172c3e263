"""Power paths straight into the bins of a map, and the hand-written adjoint of doing so.

A path falls on the grid with quadratic B-spline weights, three taps an axis (derivations §5);
the radar's point spread is a convolution of the grid afterwards. The B-spline is C¹, so the
map has continuous derivatives in range and direction. No path is ever stored for torch.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from jaxtyping import Float32
from torch import Tensor
from torch.autograd.function import once_differentiable

from invertwin.channel import bridge, kernel
from invertwin.channel.boundary import require_edges
from invertwin.channel.bridge import (
    Geometry,
    differentiated,
    flatten,
    one_torch_thread,
    opaque,
    to_float,
    to_torch,
    tracer,
    use_backend,
)
from invertwin.channel.kernel import DIFFERENTIABLE, Contribution, Inputs
from invertwin.channel.paths import Grid, Link
from invertwin.channel.sampling import AreaSampler, EdgeSampler, RaySampler, Samples, Shot
from invertwin.errors import InputError
from invertwin.scene.scene import Scene

_BYTES_PER_SAMPLE = 20  # one record: frame, triangle, two barycentrics, weight


def deposit_power(
    scene: Scene,
    link: Link,
    grid: Grid,
    *,
    samples: int,
    boundary_samples: int,
    seed: int,
    sampling: Literal["rays", "area"] = "rays",
    reference: tuple[Scene, Link] | None = None,
    boundary: bool = True,
    memory_budget: float = 0.5e9,
    backend: str | None = None,
) -> Float32[Tensor, "frame range u v"]:
    """Expected received over transmitted power in every bin of a map, per frame.

    One bounce: ``∫ f dA`` over what both antennas see, with ``f`` the bistatic radar equation
    times the reflectance distribution of the material (``channel.kernel.scattered``).
    Differentiable in both modes with respect to vertices, material values and radar poses;
    moving silhouettes included unless ``boundary`` is off.

    Args:
        scene: What is seen.
        link: Antennas, per frame.
        grid: Bins.
        samples: Interior samples over all frames.
        boundary_samples: Silhouette samples over all frames and antennas; used by derivatives
            only, since boundary paths are zero in value.
        seed: Same seed, same result (to 1e-6 relative: atomic additions reorder).
        sampling: ``rays`` from the antenna into the caps around the objects, or ``area``.
        reference: The scene and link that fix the density (caps around objects, enlarged by a
            tenth, or triangle areas), so that differences in θ have common random numbers.
        boundary: Off leaves the interior term alone, for ablation.
        memory_budget: Bytes of samples alive at a time; more samples go in chunks, and the
            derivative traces them again instead of keeping them.
        backend: ``cpu``, ``cuda``, ``auto``; by default the one in force.

    Source: Eq. 7–8 of the paper in material form, derivations §2–3 and §5.
    Differs from the source: the boundary term carries a plain line integral over silhouettes,
    not the divergence of Eq. 14.

    Raises:
        InputError: Fewer than one sample, no silhouette samples where a derivative needs them, an
            antenna pattern that carries derivatives, objects in motion, an unknown backend.
    """
    if samples < 1 or boundary_samples < 0:
        raise InputError(
            f"expected samples >= 1 and boundary_samples >= 0, got {samples} and "
            f"{boundary_samples}; give the number of rays over all frames"
        )
    if sampling not in ("rays", "area"):
        raise InputError(f"expected sampling 'rays' or 'area', got {sampling!r}; choose one")
    with use_backend(backend), one_torch_thread():
        geometry = flatten(scene, link.wavelength)
        settings = _Settings(
            geometry=geometry,
            link=link,
            grid=grid,
            samples=samples,
            boundary_samples=boundary_samples if boundary else 0,
            seed=seed,
            sampling=sampling,
            reference=(flatten(reference[0], link.wavelength), reference[1]) if reference else None,
            chunk=max(1, int(memory_budget) // _BYTES_PER_SAMPLE),
            backend=bridge.backend(),
        )
        if boundary:
            require_edges(geometry, link, boundary_samples)
        if any(differentiated(p.table()) for p in (link.tx_pattern, link.rx_pattern)):
            raise InputError(
                "expected an antenna pattern without derivatives, got one that carries them; "
                "power paths do not differentiate patterns: detach its values"
            )
        return _Deposit.apply(settings, *settings.tables)  # type: ignore[no-any-return]


@dataclass(frozen=True)
class _Settings:
    geometry: Geometry
    link: Link
    grid: Grid
    samples: int
    boundary_samples: int
    seed: int
    sampling: str
    reference: tuple[Geometry, Link] | None
    chunk: int
    backend: str

    @property
    def tables(self) -> list[Tensor]:
        """What the map can be differentiated by, in the kernel's order."""
        owners = (self.geometry, self.link)
        return [
            next(getattr(owner, name) for owner in owners if hasattr(owner, name))
            for name in DIFFERENTIABLE
        ]


class _Trace:
    """The detached half of a call: samplers, and the samples while they fit the budget."""

    def __init__(self, settings: _Settings) -> None:
        self.settings = settings
        self.shot = Shot(settings.geometry, settings.link)
        if settings.sampling == "rays":
            self.sampler = RaySampler(
                self.shot, settings.samples, settings.seed, settings.reference
            )
        else:
            self.sampler = AreaSampler(
                self.shot, settings.samples, settings.seed, settings.reference
            )
        self._kept: Samples | None = None

    @property
    def bins(self) -> int:
        """Number of bins over all frames."""
        shape = self.settings.grid.shape
        return self.shot.link.frame_count * shape[0] * shape[1] * shape[2]

    def inputs(self, tables: dict[str, Any] | None = None, *, together: bool = True) -> Inputs:
        """The kernel's inputs, with some arrays replaced by ones that carry derivatives.

        ``together`` says that antennas at one place also move as one.
        """
        link = self.settings.link
        monostatic = together and bool((link.tx == link.rx).all())
        made = Inputs.of(self.settings.geometry, link, self.shot, monostatic)
        return replace(made, **(tables or {}))

    def interior(self, keep: bool) -> Iterator[Samples]:
        """Chunks of interior samples; ``keep`` stores them if all fit in one chunk."""
        if self._kept is not None:
            yield self._kept
            return
        for index in _chunks(self.sampler.size, self.settings.chunk):
            drawn = self.sampler.draw(index)
            if keep and self.sampler.size <= self.settings.chunk:
                self._kept = drawn
                self._schedule(drawn)
            yield drawn

    def boundary(self, inputs: Inputs) -> Iterator[Contribution]:
        """Boundary paths of each antenna segment."""
        import drjit as dr

        link, settings = self.settings.link, self.settings
        centres = ("tx",) if link.shared_visibility else ("tx", "rx")
        for stream, centre in enumerate(centres):
            sampler = EdgeSampler(
                self.shot,
                getattr(self.shot, centre),
                settings.boundary_samples // len(centres),
                settings.seed + stream,
            )
            for index in _chunks(sampler.size, settings.chunk):
                drawn = sampler.draw(index)
                if dr.width(drawn.face):
                    yield kernel.boundary(inputs, drawn, centre, self.shot)

    @staticmethod
    def _schedule(samples: Samples) -> None:
        import drjit as dr

        dr.schedule(*vars(samples).values())


def _chunks(size: int, chunk: int) -> Iterator[Any]:
    """Index arrays that together count to ``size``; their offset is opaque (no recompilation)."""
    import drjit as dr

    mi = tracer()
    for start in range(0, size, chunk):
        yield dr.arange(mi.UInt32, min(chunk, size - start)) + opaque(start)


class _Deposit(torch.autograd.Function):
    """∂map/∂(vertices, poses, materials), forward and backward.

    The derivative of the deposit itself is written out; Dr.Jit differentiates the smooth
    geometry in front of it. Both end in one fused kernel that stores no path.
    """

    @staticmethod
    def forward(ctx: Any, settings: _Settings, *tables: Tensor) -> Tensor:
        import drjit as dr

        mi = tracer()
        trace = _Trace(settings)
        inputs = trace.inputs()
        out = dr.zeros(mi.Float, trace.bins)
        keep = any(ctx.needs_input_grad)
        for samples in trace.interior(keep):
            _scatter(out, trace, kernel.interior(inputs, samples))
            dr.eval(out)
        ctx.trace = trace
        return to_torch(out).reshape(settings.link.frame_count, *settings.grid.shape)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        import drjit as dr

        trace: _Trace = ctx.trace
        with use_backend(trace.settings.backend), one_torch_thread():
            wanted = [n for n, w in zip(DIFFERENTIABLE, ctx.needs_input_grad[1:], strict=True) if w]
            plain = trace.inputs()
            tables = {name: type(plain.tx)(getattr(plain, name)) for name in wanted}
            dr.enable_grad(list(tables.values()))
            inputs = trace.inputs(tables, together=("tx" in tables) == ("rx" in tables))
            seed = to_float(grad)

            def pull(found: Contribution) -> None:
                bars = _gather(seed, trace, found)
                for value, bar in zip(found.attached, bars, strict=True):
                    if dr.grad_enabled(value):
                        dr.set_grad(value, bar)
                        dr.enqueue(dr.ADMode.Backward, value)
                dr.traverse(dr.ADMode.Backward)
                dr.eval([dr.grad(t) for t in tables.values()])

            _over_paths(trace, inputs, pull)
            results: list[Tensor | None] = [None]
            for name, source in zip(DIFFERENTIABLE, trace.settings.tables, strict=True):
                results.append(
                    to_torch(dr.grad(tables[name])).reshape(source.shape).to(source)
                    if name in tables
                    else None
                )
            return tuple(results)

    @staticmethod
    def jvp(ctx: Any, _: None, *tangents: Tensor | None) -> Tensor:  # type: ignore[override]
        import drjit as dr

        mi = tracer()
        trace: _Trace = ctx.trace
        with use_backend(trace.settings.backend), one_torch_thread():
            plain = trace.inputs()
            given = {
                name: tangent
                for name, tangent in zip(DIFFERENTIABLE, tangents, strict=True)
                if tangent is not None
            }
            tables = {name: type(plain.tx)(getattr(plain, name)) for name in given}
            dr.enable_grad(list(tables.values()))
            inputs = trace.inputs(tables, together=_equal(given.get("tx"), given.get("rx")))
            out = dr.zeros(mi.Float, trace.bins)

            def push(found: Contribution) -> None:
                for name, table in tables.items():
                    dr.set_grad(table, to_float(given[name]))
                # u and v also feed the pattern, so that by default their derivatives would be
                # cleared once passed on.
                dots = dr.forward_to(*found.attached, flags=dr.ADFlag.ClearEdges)
                _scatter_derivative(out, trace, found, dots)
                dr.eval(out)

            _over_paths(trace, inputs, push)
            return to_torch(out).reshape(
                trace.settings.link.frame_count, *trace.settings.grid.shape
            )


def _equal(first: Tensor | None, second: Tensor | None) -> bool:
    if first is None or second is None:
        return first is second
    return torch.equal(first, second)


def _over_paths(trace: _Trace, inputs: Inputs, act: Callable[[Contribution], None]) -> None:
    for samples in trace.interior(keep=False):
        act(kernel.interior(inputs, samples))
    if trace.settings.boundary_samples:
        for found in trace.boundary(inputs):
            act(found)


def _axis(position: Any, start: float, step: float, count: int) -> tuple[Any, list, list]:
    """First bin, weights and weights' derivatives of the quadratic B-spline along one axis."""
    import drjit as dr

    mi = tracer()
    if count == 1:
        return mi.Int32(0), [mi.Float(1.0)], [mi.Float(0.0)]
    t = (position - start) * (1 / step)
    nearest = dr.round(t)
    d = t - nearest
    weights = [0.5 * dr.square(0.5 - d), 0.75 - dr.square(d), 0.5 * dr.square(0.5 + d)]
    slopes = [(d - 0.5) / step, -2 * d / step, (d + 0.5) / step]
    return mi.Int32(nearest) - 1, weights, slopes


@dataclass(frozen=True)
class _Taps:
    """Where a path falls: first bins, weights and slopes of the three axes (all detached)."""

    base: Any
    axes: tuple[tuple[Any, list, list], ...]
    counts: tuple[int, int, int]

    @staticmethod
    def of(trace: _Trace, found: Contribution) -> "_Taps":
        import drjit as dr

        mi = tracer()
        g = trace.settings.grid
        axes = (
            _axis(dr.detach(found.range), g.range_start, g.range_step, g.range_count),
            _axis(dr.detach(found.u), g.u_start, g.u_step, g.u_count),
            _axis(dr.detach(found.v), g.v_start, g.v_step, g.v_count),
        )
        base = mi.Int32(found.frame) * (g.range_count * g.u_count * g.v_count)
        return _Taps(base, axes, g.shape)

    def __iter__(self) -> Iterator[tuple[Any, Any, tuple[int, int, int]]]:
        """Bin index, whether it is on the grid, and the tap along each axis."""
        (r0, rw, _), (u0, uw, _), (v0, vw, _) = self.axes
        nr, nu, nv = self.counts
        for i in range(len(rw)):
            ok_r = (r0 + i >= 0) & (r0 + i < nr)
            for j in range(len(uw)):
                ok_u = ok_r & (u0 + j >= 0) & (u0 + j < nu)
                line = self.base + ((r0 + i) * nu + (u0 + j)) * nv + v0
                for k in range(len(vw)):
                    yield line + k, ok_u & (v0 + k >= 0) & (v0 + k < nv), (i, j, k)


def _scatter(out: Any, trace: _Trace, found: Contribution) -> None:
    """Add the paths to the bins."""
    import drjit as dr

    taps = _Taps.of(trace, found)
    (_, rw, _), (_, uw, _), (_, vw, _) = taps.axes
    for index, ok, (i, j, k) in taps:
        weight = found.power * rw[i] * uw[j] * vw[k]
        dr.scatter_add(out, weight, tracer().UInt32(index), ok)


def _scatter_derivative(out: Any, trace: _Trace, found: Contribution, dots: tuple) -> None:
    """Add the derivative of the paths' deposit, given those of power, range, u and v."""
    import drjit as dr

    taps = _Taps.of(trace, found)
    (_, rw, rs), (_, uw, us), (_, vw, vs) = taps.axes
    power = dr.detach(found.power)
    dot_a, dot_r, dot_u, dot_v = dots
    for index, ok, (i, j, k) in taps:
        value = (
            dot_a * rw[i] * uw[j] * vw[k]
            + power * dot_r * rs[i] * uw[j] * vw[k]
            + power * dot_u * rw[i] * us[j] * vw[k]
            + power * dot_v * rw[i] * uw[j] * vs[k]
        )
        dr.scatter_add(out, value, tracer().UInt32(index), ok)


def _gather(seed: Any, trace: _Trace, found: Contribution) -> tuple[Any, Any, Any, Any]:
    """The adjoint of the deposit: ∂loss/∂(power, range, u, v) of every path."""
    import drjit as dr

    mi = tracer()
    taps = _Taps.of(trace, found)
    (_, rw, rs), (_, uw, us), (_, vw, vs) = taps.axes
    bars = [mi.Float(0.0) for _ in range(4)]
    for index, ok, (i, j, k) in taps:
        g = dr.gather(mi.Float, seed, mi.UInt32(index), ok)
        bars[0] += g * (rw[i] * uw[j] * vw[k])
        bars[1] += g * (rs[i] * uw[j] * vw[k])
        bars[2] += g * (rw[i] * us[j] * vw[k])
        bars[3] += g * (rw[i] * uw[j] * vs[k])
    power = dr.detach(found.power)
    return bars[0], bars[1] * power, bars[2] * power, bars[3] * power
