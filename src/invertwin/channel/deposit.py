"""Power paths straight into the bins of a map, with derivatives in both modes.

No path is ever stored for torch: chains are walked, deposited and forgotten, or kept as records
while these fit the memory budget, and replayed for the derivative.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from jaxtyping import Float32
from torch import Tensor
from torch.autograd.function import once_differentiable

from invertwin.channel import bins, bridge, kernel, replay, walk
from invertwin.channel.boundary import require_edges
from invertwin.channel.boundary_walk import BoundaryChains, boundary_chains
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
from invertwin.channel.kernel import DIFFERENTIABLE, Inputs, Place
from invertwin.channel.passage import Passage
from invertwin.channel.paths import Grid, Link
from invertwin.channel.rays import Shot
from invertwin.channel.sampling import AreaSampler, RaySampler
from invertwin.channel.walk import Records, State, Walk
from invertwin.errors import InputError
from invertwin.scene.scene import Scene

_BYTES_PER_VERTEX = 21  # one record: triangle, two barycentrics, throughput, length, seen
_DEEPEST = 16


def deposit_power(
    scene: Scene,
    link: Link,
    grid: Grid,
    *,
    samples: int,
    boundary_samples: int,
    seed: int,
    depth: int = 1,
    sampling: Literal["rays", "area"] = "rays",
    reference: tuple[Scene, Link] | None = None,
    boundary: bool = True,
    interior_edges: bool = True,
    memory_budget: float = 0.5e9,
    backend: str | None = None,
) -> Float32[Tensor, "frame range u v"]:
    """Expected received over transmitted power in every bin of a map, per frame.

    ``∫ f dA₁ … dAₙ`` over all chains of up to ``depth`` surface points that see each other in
    turn, with ``f`` the radar equation of the chain: 1/R² for every leg, the scattering
    distribution of the material and both cosines for every point.
    Differentiable in both modes with respect to vertices, material values and radar poses;
    moving silhouettes included unless ``boundary`` is off.

    Args:
        scene: What is seen.
        link: Antennas, per frame.
        grid: Bins.
        samples: Interior samples over all frames.
        boundary_samples: Silhouette samples over all frames and antennas; used by derivatives
            only, since boundary paths are zero in value.
        depth: Most bounces of a path.
        seed: Same seed, same result (to 1e-6 relative: atomic additions reorder).
        sampling: ``rays`` from the antenna into the caps around the objects, or ``area``.
        reference: The scene and link that fix the density (caps around objects, enlarged by a
            tenth, or triangle areas), so that differences in θ have common random numbers.
        boundary: Off leaves the interior term alone, for ablation.
        interior_edges: Off leaves out the shadows that surfaces cast on each other (family 2),
            for ablation.
        memory_budget: Bytes of samples alive at a time; more samples go in chunks, and the
            derivative traces them again instead of keeping them.
        backend: ``cpu``, ``cuda``, ``auto``; by default the one in force.

    Source: Eq. 7–8 of the paper in material form, derivations §2–3 and §5; interior segments
    §3.3.3.
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
    if not 1 <= depth <= _DEEPEST:
        raise InputError(
            f"expected a depth from 1 to {_DEEPEST}, got {depth}; give the most bounces of a path"
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
            depth=depth,
            interior_edges=interior_edges,
            chunk=max(1, int(memory_budget) // (_BYTES_PER_VERTEX * depth)),
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
    depth: int
    interior_edges: bool
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
    """The detached half of a call: chains, and their records while they fit the budget."""

    def __init__(self, settings: _Settings) -> None:
        self.settings = settings
        self.shot = Shot(settings.geometry, settings.link)
        sampler = RaySampler if settings.sampling == "rays" else AreaSampler
        self.sampler = sampler(self.shot, settings.samples, settings.seed, settings.reference)
        self.fixed = self.inputs()
        self._walk = Walk(self.shot, self.fixed, settings.seed)
        self._kept: Records | None = None

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

    def deposit(self, out: Any, *, record: bool) -> None:
        """Walk all chains into the bins; ``record`` keeps them if all fit in one chunk."""
        import drjit as dr

        record = record and self.sampler.size <= self.settings.chunk
        for index in _chunks(self.sampler.size, self.settings.chunk):
            records = self._walked(index, out, record=record)
            if record:
                self._kept = records
                dr.schedule(*records.columns)
            dr.eval(out)

    def records(self) -> Iterator[Records]:
        """The vertices of all chains, a chunk at a time."""
        if self._kept is not None:
            yield self._kept
            return
        for index in _chunks(self.sampler.size, self.settings.chunk):
            yield self._walked(index, None, record=True)

    def _walked(self, index: Any, out: Any, *, record: bool) -> Records:
        """Walk some chains into the bins, if given, and into records, if asked (else empty)."""
        import drjit as dr

        depth, shared = self.settings.depth, self.settings.link.shared_visibility
        one_place = depth == 1 and self.fixed.monostatic
        state = self._started(index)
        state["lane"] = dr.arange(tracer().UInt32, dr.width(index))
        looped = record and depth > 1
        records = Records.empty(state, depth if looped else 0, self.shot.sound_face)

        def visit(state: State, point: Place) -> None:
            nonlocal records
            found, exists = walk.connect(
                self.shot, self.fixed, state, point, True, shared=shared, one_place=one_place
            )
            if out is not None:
                bins.scatter(out, self.settings.grid, found, exists)
            if looped:
                records.write(state, exists)
            elif record:
                records = Records.single(state, exists)

        self._walk.run(state, depth, visit)
        return records

    def _started(self, index: Any) -> State:
        """Chains at their first vertex."""
        import drjit as dr

        drawn = self.sampler.draw(index, self.fixed)
        tx = self.fixed.antenna(drawn.frame, False)
        point = kernel.place(self.fixed, drawn.face, drawn.b1, drawn.b2)
        back, distance = kernel.leg(point.position, tx)
        gain = self.fixed.gain(drawn.frame, False, kernel.to_radar(self.fixed, drawn.frame, -back))
        weight = drawn.weight * drawn.share * self.fixed.scale * gain / dr.square(distance)
        return walk.start(
            index, drawn.frame, drawn.face, drawn.b1, drawn.b2, back,
            throughput=dr.select(drawn.weight > 0, weight, 0.0),
            length=distance + drawn.excess,
            passed=Passage(drawn.share, drawn.excess) if self.fixed.sheets else None,
        )  # fmt: skip

    def boundary(self, inputs: Inputs) -> Iterator[BoundaryChains]:
        """Boundary paths of all segments, a chunk at a time."""
        settings = self.settings
        if settings.boundary_samples:
            yield from boundary_chains(
                self.shot,
                inputs,
                self._walk,
                samples=settings.boundary_samples,
                depth=settings.depth,
                seed=settings.seed,
                interior=settings.interior_edges,
                chunks=lambda size: _chunks(size, settings.chunk),
            )


def _chunks(size: int, chunk: int) -> Iterator[Any]:
    """Index arrays that together count to ``size``; their offset is opaque (no recompilation)."""
    import drjit as dr

    mi = tracer()
    for start in range(0, size, chunk):
        yield dr.arange(mi.UInt32, min(chunk, size - start)) + opaque(start)


class _Deposit(torch.autograd.Function):
    """∂map/∂(vertices, poses, materials), forward and backward.

    The derivative of the deposit itself is written out, and that of a chain replayed from its
    records; Dr.Jit differentiates the smooth geometry at one vertex.
    """

    @staticmethod
    def forward(ctx: Any, settings: _Settings, *tables: Tensor) -> Tensor:
        import drjit as dr

        trace = _Trace(settings)
        out = dr.zeros(tracer().Float, trace.bins)
        trace.deposit(out, record=any(ctx.needs_input_grad))
        ctx.trace = trace
        return to_torch(out).reshape(settings.link.frame_count, *settings.grid.shape)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        import drjit as dr

        trace: _Trace = ctx.trace
        grid = trace.settings.grid
        with use_backend(trace.settings.backend), one_torch_thread():
            wanted = [n for n, w in zip(DIFFERENTIABLE, ctx.needs_input_grad[1:], strict=True) if w]
            tables = {name: type(trace.fixed.tx)(getattr(trace.fixed, name)) for name in wanted}
            dr.enable_grad(list(tables.values()))
            inputs = trace.inputs(tables, together=("tx" in tables) == ("rx" in tables))
            seed = to_float(grad)
            for records in trace.records():
                replay.pull(
                    trace.shot, inputs, records, lambda *path: bins.gather(seed, grid, *path)
                )
                dr.eval([dr.grad(table) for table in tables.values()])
            for chains in trace.boundary(inputs):
                total = chains.weighted(lambda *path: bins.gather(seed, grid, *path)[0])
                if dr.grad_enabled(chains.speed):
                    dr.backward_from(chains.speed * total)
                dr.eval([dr.grad(table) for table in tables.values()])
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

        trace: _Trace = ctx.trace
        grid = trace.settings.grid
        with use_backend(trace.settings.backend), one_torch_thread():
            given = {
                name: tangent
                for name, tangent in zip(DIFFERENTIABLE, tangents, strict=True)
                if tangent is not None
            }
            tables = {name: type(trace.fixed.tx)(getattr(trace.fixed, name)) for name in given}
            dr.enable_grad(list(tables.values()))
            inputs = trace.inputs(tables, together=_equal(given.get("tx"), given.get("rx")))
            out = dr.zeros(tracer().Float, trace.bins)

            def point_tangents() -> None:
                for name, table in tables.items():
                    dr.set_grad(table, to_float(given[name]))

            for records in trace.records():
                point_tangents()
                replay.push(
                    trace.shot,
                    inputs,
                    records,
                    lambda *path: bins.scatter_derivative(out, grid, *path),
                )
                dr.eval(out)
            for chains in trace.boundary(inputs):
                point_tangents()
                chains.deposit(
                    dr.forward_to(chains.speed), lambda *path: bins.scatter(out, grid, *path)
                )
                dr.eval(out)
            return to_torch(out).reshape(
                trace.settings.link.frame_count, *trace.settings.grid.shape
            )


def _equal(first: Tensor | None, second: Tensor | None) -> bool:
    if first is None or second is None:
        return first is second
    return torch.equal(first, second)
