"""Deposit of power paths into the bins of a map, with derivatives in both modes.

Paths are not stored for torch: they are sampled, deposited and discarded, or kept as records if
these fit the memory budget, and replayed for the derivative.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, Literal

import torch
from jaxtyping import Float32
from torch import Tensor
from torch._C import _DisableFuncTorch

from invertwin.channel.em.depolarisation import polarisation_shares
from invertwin.channel.paths import Grid, Link
from invertwin.channel.power import bins, replay
from invertwin.channel.power import trace as power_trace
from invertwin.channel.power.clouds import deposit_density
from invertwin.channel.power.integrand import DIFFERENTIABLE, from_table, to_table
from invertwin.channel.rays.backend import backend, dr, mi, mit, tracing
from invertwin.channel.rays.batching import arrange_scenes
from invertwin.channel.rays.scene_tables import Geometry, flatten, require_silhouette_samples
from invertwin.channel.sampling import Sampling
from invertwin.checks import is_differentiated, strip_derivatives
from invertwin.errors import InputError
from invertwin.limits import MAX_COUNT
from invertwin.runtime.concurrency import torch_threads
from invertwin.scene.mesh_defects import require_single_surfaces
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
    """Compute the expected received over transmitted power in every bin of a map, per frame.

    ``∫ f dA₁ … dAₙ`` over all paths of up to ``depth`` mutually visible surface points, with ``f``
    the radar equation of the path: 1/R² for every segment, the scattering distribution of the
    material and both cosines for every point.
    Differentiable in both modes with respect to vertices, material values and radar poses;
    moving silhouettes included unless ``boundary`` is off. Clouds add the power of
    ``deposit_density``, each with all ``samples``. The power is that which remains after the
    antennas' polarisations and the surfaces' depolarisation (``channel.coupling``).

    Args:
        scene: scene with surfaces, clouds, or both.
        link: antennas, per frame.
        grid: bins of one frame.
        sampling: number of paths, their depth, and backend.
        seed: seed; the same seed yields the same result to 1e-6 (atomic additions reorder).
        scheme: ``rays`` from the antenna into the caps around the objects, or ``area``.
        reference: scene and link that define the sampling densities (caps around objects, a tenth
            larger, or triangle areas), so that differences in θ have common random numbers.

    Source: Eq. 7–8 of the paper in material form, derivations §2–3 and §5; interior segments
    §3.3.3.
    Differs from the source: the boundary term carries a plain line integral over silhouettes,
    not the divergence of Eq. 14.

    Raises:
        InputError: No silhouette samples for a derivative that needs them, an antenna pattern that
            carries derivatives, objects in motion, an unknown backend, a polarisation that depends
            on direction, sheets whose closed parts overlap, a derivative with doubled ones.
    """
    if scheme not in ("rays", "area"):
        raise InputError(f"expected scheme 'rays' or 'area', got {scheme!r}; choose one")
    surfaces, clouds = _split_clouds(scene)
    soft = [deposit_density(item, link, grid, sampling=sampling, seed=seed) for item in clouds]
    if surfaces is None:
        return torch.stack(soft).sum(0)
    with tracing(sampling.backend), torch_threads(1):
        geometry = _flatten_surfaces(surfaces, link)
        fixed = None
        if reference is not None and (hard := _split_clouds(reference[0])[0]) is not None:
            fixed = flatten(hard, link.wavelength), reference[1]
        shares = _deposit_surfaces(
            geometry, link, grid, sampling, seed, scheme=scheme, reference=fixed
        )
    return _sum_maps([*soft, *shares])


def deposit_batch(
    scenes: Sequence[Scene], link: Link, grid: Grid, *, sampling: Sampling, seed: int
) -> Float32[Tensor, "scene frame range u v"]:
    """Compute ``deposit_power`` of many scenes with one launch of the kernels.

    For small numbers of samples a call is dominated by launches, so that many scenes cost little
    more than one. All scenes share one BVH, each in a box of its own with its own antennas. No
    segment within a scene leaves its box, and intersections in other boxes are discarded: paths,
    boundary paths and derivatives (in both modes) are exactly those of ``deposit_power``, with
    other random numbers. Float32 coordinates are relative to the middle of all boxes, so that
    rounding errors are those of a scene as large as the batch.

    Args:
        scenes: scenes of surfaces. Every object of the batch gets the same number of samples:
            scenes with as many objects are sampled alike.
        link: antennas, per frame: the same for all scenes.
        grid: bins of one frame.
        sampling: number of paths of each scene, on average.
        seed: seed; the same seed and scenes yield the same result, independent between scenes.

    Source: as ``deposit_power``; ``rays.batching`` states why boxes separate scenes.

    Raises:
        InputError: No scenes, clouds, more samples than numbers, or as of ``deposit_power``.
    """
    objects, owners = {}, []
    for number, scene in enumerate(scenes):
        clouds = [name for name, item in scene.objects.items() if item.cloud is not None]
        if clouds:
            raise InputError(
                f"expected scenes of surfaces in a batch, got the cloud {clouds[0]!r} in scene "
                f"{number}; call deposit_power for one scene after another"
            )
        objects |= {f"{name} of scene {number}": item for name, item in scene.objects.items()}
        owners += [number] * len(scene.objects)
    if not objects:
        raise InputError("expected at least one scene, got none; give a list of scenes")
    drawn = len(scenes) * max(sampling.samples, sampling.boundary_samples)
    if drawn > MAX_COUNT:
        raise InputError(
            f"expected at most {MAX_COUNT} samples of all scenes, got {drawn}; give fewer scenes "
            "or samples at a time"
        )
    with tracing(sampling.backend), torch_threads(1):
        geometry = _flatten_surfaces(Scene(objects), link, owners)
        geometry, links = arrange_scenes(geometry, link, torch.tensor(owners))
        total = _sum_maps(_deposit_surfaces(geometry, links, grid, sampling, seed))
    return total.unflatten(0, (len(scenes), link.frame_count))


def _flatten_surfaces(scene: Scene, link: Link, scenes: Sequence[int] | None = None) -> Geometry:
    """Flatten a scene; refuse sheets within others, and doubled ones where derivatives count."""
    geometry = flatten(scene, link.wavelength, scenes=scenes)
    if geometry.has_sheets:
        sheets = geometry.surfaces.transmittance.any(1)[geometry.face_surface]
        names = [geometry.names[k] for k in geometry.face_object[sheets].unique().tolist()]
        require_single_surfaces(scene, names, allows_doubled=not any(geometry.differentiated))
    return geometry


def _deposit_surfaces(
    geometry: Geometry,
    link: Link,
    grid: Grid,
    sampling: Sampling,
    seed: int,
    *,
    scheme: str = "rays",
    reference: tuple[Geometry, Link] | None = None,
) -> list[Tensor]:
    """Compute the maps of the surfaces, one for every share of polarised power; they add up."""
    if sampling.boundary:
        require_silhouette_samples(geometry, link, sampling.boundary_samples)
    if any(is_differentiated(p.table()) for p in (link.tx_pattern, link.rx_pattern)):
        raise InputError(
            "expected an antenna pattern without derivatives, got one that carries them; "
            "power paths do not differentiate patterns: detach its values"
        )
    depolarisation = geometry.surfaces.depolarisation
    depolarised = is_differentiated(depolarisation) or bool(depolarisation.any())
    antennas_move = is_differentiated(link.tx) or is_differentiated(link.rx)
    maps = []
    for share in polarisation_shares(link, depolarising=depolarised):
        lossy = geometry
        if share.loss:
            surfaces = geometry.surfaces.scale(1 - share.loss * depolarisation)
            lossy = replace(geometry, surfaces=surfaces)
        with _DisableFuncTorch():
            bare = power_trace.strip_scene_derivatives(lossy, link)
            tracer = power_trace.PowerTracer(
                *bare, sampling, seed, scheme=scheme, reference=reference,
                coupling=(share.odd, share.even), differentiate_antennas=antennas_move,
            )  # fmt: skip
        tables = power_trace.differentiable_tables(lossy, link)
        layout = bins.BinLayout.from_link(grid, link)
        maps.append(_Deposit.apply(tracer, layout, any(map(is_differentiated, tables)), *tables))
    return maps


def _sum_maps(maps: list[Tensor]) -> Tensor:
    return torch.stack(maps).sum(0) if len(maps) > 1 else maps[0]


def _split_clouds(scene: Scene) -> tuple[Scene | None, list[Object]]:
    """Split a scene into its surfaces, if any, and its clouds."""
    clouds = [item for item in scene.objects.values() if item.cloud is not None]
    surfaces = {name: item for name, item in scene.objects.items() if item.cloud is None}
    return (Scene(surfaces) if surfaces else None), clouds


class _Deposit(torch.autograd.Function):
    """Map of a scene, with ∂map/∂(vertices, poses, materials) in both modes.

    The derivative of the deposit itself is written out, and that of a path is replayed from its
    records; Dr.Jit differentiates the smooth geometry at one vertex.
    """

    @staticmethod
    def forward(
        tracer: power_trace.PowerTracer, layout: bins.BinLayout, derivative: bool, *tables: Tensor
    ) -> Tensor:
        out = bins.BinAccumulator(layout)
        tracer.last_records = tracer.deposit(out, record=derivative)
        if derivative:
            _ = tracer.boundary_samples  # prepared while the paths are traced
        return out.to_map()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:  # type: ignore[override]
        ctx.tracer, ctx.layout, _, *tables = inputs
        ctx.table_templates, ctx.backend = [strip_derivatives(table) for table in tables], backend()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        pairs = zip(DIFFERENTIABLE, ctx.needs_input_grad[3:], strict=True)
        wanted = tuple(name for name, needed in pairs if needed)
        found = _Linear.apply(lambda grad: _pull_gradients(ctx, wanted, grad), grad)
        results = dict(zip(wanted, found, strict=True))
        return None, None, None, *(results.get(name) for name in DIFFERENTIABLE)

    @staticmethod
    def jvp(ctx: Any, _: None, __: None, ___: None, *tangents: Tensor | None) -> Tensor:  # type: ignore[override]
        given = {n: t for n, t in zip(DIFFERENTIABLE, tangents, strict=True) if t is not None}
        return _Linear.apply(
            lambda *tangents: _push_tangents(ctx, tuple(given), *tangents), *given.values()
        )

    @staticmethod
    def vmap(_: Any, __: Any, *inputs: Any) -> tuple[Tensor, None]:  # type: ignore[override]
        return _Deposit.apply(*inputs), None  # batches of scenes were refused before


class _Linear(torch.autograd.Function):
    """Linear function of tensors; ``vmap`` calls it once for each entry of a batch."""

    @staticmethod
    def forward(act: Callable[..., Any], *values: Tensor) -> Any:
        return act(*values)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:  # type: ignore[override]
        pass

    @staticmethod
    def backward(ctx: Any, *_: Any) -> None:  # type: ignore[override]
        raise InputError(
            "expected first derivatives of a map, got a request for second ones, which paths do "
            "not have; use differences of gradients"
        )

    @staticmethod
    def vmap(info: Any, dims: tuple[Any, ...], act: Callable[..., Any], *values: Tensor) -> Any:  # type: ignore[override]
        rows: list[Any] = []
        for k in range(info.batch_size):
            pairs = zip(values, dims[1:], strict=True)
            row = (v if dim is None else v.select(dim, k) for v, dim in pairs)
            rows.append(_Linear.apply(act, *row))
        if isinstance(rows[0], Tensor):
            return torch.stack(rows), 0
        stacked = tuple(torch.stack(column) for column in zip(*rows, strict=True))
        return stacked, (0,) * len(stacked)


def _pull_gradients(ctx: Any, names: tuple[str, ...], grad: Tensor) -> tuple[Tensor, ...]:
    """Pull the gradient of the map back to some tables (vector–Jacobian product)."""
    tracer: power_trace.PowerTracer = ctx.tracer
    with tracing(ctx.backend), torch_threads(1):
        tables = _attach_tables(tracer, names)
        inputs = tracer.inputs(tables, joint_antennas=("tx" in tables) == ("rx" in tables))
        strip_gradient = ctx.layout.expand_to_strips(grad)

        def gather(*path: Any) -> bins.FourFloats:
            return bins.gather_adjoint(strip_gradient, ctx.layout, *path)

        boundary = tracer.trace_boundary(inputs)
        for records in [tracer.last_records] if tracer.last_records else tracer.iterate_records():
            replay.pull(inputs, records, gather)
            dr.eval([dr.grad(table) for table in tables.values()])
            del records  # before the next ones are allocated
        for paths in boundary:
            total = paths.sum_weighted(lambda *path: gather(*path)[0])
            if dr.grad_enabled(paths.speed):
                dr.backward_from(paths.speed * total)
            dr.eval([dr.grad(table) for table in tables.values()])
        templates = dict(zip(DIFFERENTIABLE, ctx.table_templates, strict=True))
        return tuple(from_table(name, dr.grad(tables[name]), templates[name]) for name in names)


def _push_tangents(ctx: Any, names: tuple[str, ...], *tangents: Tensor) -> Tensor:
    """Push tangents of some tables forward to the map (Jacobian–vector product)."""
    tracer: power_trace.PowerTracer = ctx.tracer
    with tracing(ctx.backend), torch_threads(1):
        given = dict(zip(names, tangents, strict=True))
        tables = _attach_tables(tracer, names)
        inputs = tracer.inputs(tables, joint_antennas=_are_equal(given.get("tx"), given.get("rx")))
        out = bins.BinAccumulator(ctx.layout)

        def set_tangents() -> None:
            for name, table in tables.items():
                dr.set_grad(table, to_table(name, given[name]))

        boundary = tracer.trace_boundary(inputs)
        for records in [tracer.last_records] if tracer.last_records else tracer.iterate_records():
            set_tangents()
            replay.push(inputs, records, out.add_tangent)
            dr.eval(out.values)
            del records
        for paths in boundary:
            set_tangents()
            paths.deposit(dr.forward_to(paths.speed), out.add)
            dr.eval(out.values)
        return out.to_map()


def _attach_tables(tracer: power_trace.PowerTracer, names: Iterable[str]) -> dict[str, mit.Float]:
    """Copy some of the kernel's tables and enable their derivatives."""
    tables = {name: mi.Float(tracer.fixed.table(name)) for name in names}
    dr.enable_grad(list(tables.values()))
    return tables


def _are_equal(first: Tensor | None, second: Tensor | None) -> bool:
    return first is second if first is None or second is None else torch.equal(first, second)
