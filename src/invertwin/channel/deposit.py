"""Power paths straight into the bins of a map, with derivatives in both modes.

No path is ever stored for torch: chains are walked, deposited and forgotten, or kept as records
while these fit the memory budget, and replayed for the derivative.
"""

from typing import Any, Literal

import torch
from jaxtyping import Float32
from torch import Tensor
from torch.autograd.function import once_differentiable

from invertwin.channel import bins, bridge, replay
from invertwin.channel.boundary import require_edges
from invertwin.channel.bridge import (
    differentiated,
    flatten,
    one_torch_thread,
    to_float,
    use_backend,
)
from invertwin.channel.density import deposit_density
from invertwin.channel.kernel import DIFFERENTIABLE, from_table, to_table
from invertwin.channel.paths import Grid, Link
from invertwin.channel.sampling import Sampling
from invertwin.channel.trace import Settings, Trace
from invertwin.errors import InputError
from invertwin.scene.scene import Object, Scene


def deposit_power(
    scene: Scene,
    link: Link,
    grid: Grid,
    *,
    sampling: Sampling,
    seed: int,
    scheme: Literal["rays", "area"] = "rays",
    reference: tuple[Scene, Link] | None = None,
) -> Float32[Tensor, "frame range u v"]:
    """Expected received over transmitted power in every bin of a map, per frame.

    ``∫ f dA₁ … dAₙ`` over all chains of up to ``depth`` surface points that see each other in
    turn, with ``f`` the radar equation of the chain: 1/R² for every leg, the scattering
    distribution of the material and both cosines for every point.
    Differentiable in both modes with respect to vertices, material values and radar poses;
    moving silhouettes included unless ``boundary`` is off. Objects that are clouds add the power
    of ``deposit_density``, each with all ``samples``.

    Args:
        scene: What is seen.
        link: Antennas, per frame.
        grid: Bins.
        sampling: How many paths are drawn.
        seed: Same seed, same result (to 1e-6 relative: atomic additions reorder).
        scheme: ``rays`` from the antenna into the caps around the objects, or ``area``.
        reference: The scene and link that fix the density (caps around objects, enlarged by a
            tenth, or triangle areas), so that differences in θ have common random numbers.

    Source: Eq. 7–8 of the paper in material form, derivations §2–3 and §5; interior segments
    §3.3.3.
    Differs from the source: the boundary term carries a plain line integral over silhouettes,
    not the divergence of Eq. 14.

    Raises:
        InputError: No silhouette samples where a derivative needs them, an
            antenna pattern that carries derivatives, objects in motion, an unknown backend.
    """
    if scheme not in ("rays", "area"):
        raise InputError(f"expected scheme 'rays' or 'area', got {scheme!r}; choose one")
    surfaces, clouds = _sorted(scene)
    soft = [deposit_density(item, link, grid, sampling=sampling, seed=seed) for item in clouds]
    if surfaces is None:
        return torch.stack(soft).sum(0)
    with use_backend(sampling.backend), one_torch_thread():
        geometry = flatten(surfaces, link.wavelength)
        fixed = None if reference is None else _sorted(reference[0])[0]
        settings = Settings(
            geometry=geometry,
            link=link,
            grid=grid,
            sampling=sampling,
            seed=seed,
            scheme=scheme,
            reference=(flatten(fixed, link.wavelength), reference[1])
            if reference and fixed
            else None,
            backend=bridge.backend(),
        )
        if sampling.boundary:
            require_edges(geometry, link, sampling.boundary_samples)
        if any(differentiated(p.table()) for p in (link.tx_pattern, link.rx_pattern)):
            raise InputError(
                "expected an antenna pattern without derivatives, got one that carries them; "
                "power paths do not differentiate patterns: detach its values"
            )
        hard = _Deposit.apply(settings, *settings.tables)
    return hard + torch.stack(soft).sum(0) if soft else hard  # type: ignore[no-any-return]


def _sorted(scene: Scene) -> tuple[Scene | None, list[Object]]:
    """The surfaces of a scene, if any, and its clouds."""
    clouds = [item for item in scene.objects.values() if item.cloud is not None]
    surfaces = {name: item for name, item in scene.objects.items() if item.cloud is None}
    return (Scene(surfaces) if surfaces else None), clouds


class _Deposit(torch.autograd.Function):
    """∂map/∂(vertices, poses, materials), forward and backward.

    The derivative of the deposit itself is written out, and that of a chain replayed from its
    records; Dr.Jit differentiates the smooth geometry at one vertex.
    """

    @staticmethod
    def forward(ctx: Any, settings: Settings, *tables: Tensor) -> Tensor:
        trace = Trace(settings)
        out = trace.bins()
        derivative = any(ctx.needs_input_grad)
        trace.deposit(out, record=derivative)
        if derivative:
            trace.draw_boundary()  # prepared while the paths are walked
        ctx.trace = trace
        return out.map()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        import drjit as dr

        trace: Trace = ctx.trace
        grid = trace.settings.grid
        with use_backend(trace.settings.backend), one_torch_thread():
            wanted = [n for n, w in zip(DIFFERENTIABLE, ctx.needs_input_grad[1:], strict=True) if w]
            tables = {name: type(trace.fixed.tx)(getattr(trace.fixed, name)) for name in wanted}
            dr.enable_grad(list(tables.values()))
            inputs = trace.inputs(tables, together=("tx" in tables) == ("rx" in tables))
            seed = to_float(grad)
            boundary = trace.boundary(inputs)
            for records in trace.records():
                replay.pull(
                    trace.shot, inputs, records, lambda *path: bins.gather(seed, grid, *path)
                )
                dr.eval([dr.grad(table) for table in tables.values()])
                del records  # before the next ones are made
            for chains in boundary:
                total = chains.weighted(lambda *path: bins.gather(seed, grid, *path)[0])
                if dr.grad_enabled(chains.speed):
                    dr.backward_from(chains.speed * total)
                dr.eval([dr.grad(table) for table in tables.values()])
            results: list[Tensor | None] = [None]
            for name, source in zip(DIFFERENTIABLE, trace.settings.tables, strict=True):
                results.append(
                    from_table(name, dr.grad(tables[name]), source) if name in tables else None
                )
            return tuple(results)

    @staticmethod
    def jvp(ctx: Any, _: None, *tangents: Tensor | None) -> Tensor:  # type: ignore[override]
        import drjit as dr

        trace: Trace = ctx.trace
        with use_backend(trace.settings.backend), one_torch_thread():
            given = {
                name: tangent
                for name, tangent in zip(DIFFERENTIABLE, tangents, strict=True)
                if tangent is not None
            }
            tables = {name: type(trace.fixed.tx)(getattr(trace.fixed, name)) for name in given}
            dr.enable_grad(list(tables.values()))
            inputs = trace.inputs(tables, together=_equal(given.get("tx"), given.get("rx")))
            out = trace.bins()

            def point_tangents() -> None:
                for name, table in tables.items():
                    dr.set_grad(table, to_table(name, given[name]))

            boundary = trace.boundary(inputs)
            for records in trace.records():
                point_tangents()
                replay.push(trace.shot, inputs, records, out.add_derivative)
                dr.eval(out.values)
                del records
            for chains in boundary:
                point_tangents()
                chains.deposit(dr.forward_to(chains.speed), out.add)
                dr.eval(out.values)
            return out.map()


def _equal(first: Tensor | None, second: Tensor | None) -> bool:
    if first is None or second is None:
        return first is second
    return torch.equal(first, second)
