"""Tracing of a scene: random walks into bins or records, and boundary paths."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property, partial

from torch import Tensor

from invertwin.channel.paths import Link
from invertwin.channel.power import integrand
from invertwin.channel.power import random_walk as walk
from invertwin.channel.power.bins import BinAccumulator
from invertwin.channel.power.boundary import BoundaryPaths, BoundarySamples
from invertwin.channel.power.integrand import DIFFERENTIABLE, Inputs, SurfaceInteraction
from invertwin.channel.power.intersection_curves import require_no_interreflection
from invertwin.channel.power.random_walk import PathRecords, PathState, RandomWalk
from invertwin.channel.power.start_points import AreaSampler, RaySampler
from invertwin.channel.power.surface import SCATTERING_TABLES
from invertwin.channel.rays.arrays import opaque
from invertwin.channel.rays.backend import dr, mi, mit
from invertwin.channel.rays.coplanar import warn_coplanar_surfaces
from invertwin.channel.rays.intersections import find_intersection_curves
from invertwin.channel.rays.ray_scene import RayScene
from invertwin.channel.rays.scene_tables import Geometry
from invertwin.channel.sampling import Sampling
from invertwin.checks import strip_derivatives

_BYTES_PER_VERTEX = 20  # triangle, two barycentric coordinates, throughput, length


def differentiable_tables(geometry: Geometry, link: Link) -> list[Tensor]:
    """List the tables with respect to which a map is differentiable, in the kernel's order.

    Args:
        geometry: scene as flat tables.
        link: antennas.
    """
    owners = {"vertices": geometry, **dict.fromkeys(SCATTERING_TABLES, geometry.surfaces)}
    return [getattr(owners.get(name, link), name) for name in DIFFERENTIABLE]


def strip_scene_derivatives(geometry: Geometry, link: Link) -> tuple[Geometry, Link]:
    """Strip all derivatives, also within the transforms of ``torch.func``.

    Args:
        geometry: scene as flat tables.
        link: antennas.
    """
    values = map(strip_derivatives, differentiable_tables(geometry, link))
    tables = dict(zip(DIFFERENTIABLE, values, strict=True))
    rows = {name: tables.pop(name) for name in SCATTERING_TABLES}
    rows["depolarisation"] = strip_derivatives(geometry.surfaces.depolarisation)
    rows = replace(geometry.surfaces, **rows)
    bare = replace(geometry, vertices=tables.pop("vertices"), surfaces=rows)
    return bare, replace(link, **tables)


class PowerTracer:
    """Paths of one map, detached; all its methods trace the same ones.

    Args:
        geometry: scene as flat tables.
        link: antennas.
        sampling: numbers of paths.
        seed: seed of all random numbers.
        scheme: sampling of the start points, see ``deposit_power``.
        reference: reference scene of the start points, see ``deposit_power``.
        coupling: polarisation factors of paths with an odd and an even number of bounces.
        differentiate_antennas: True if derivatives may flow through the antennas' positions.
    """

    def __init__(
        self,
        geometry: Geometry,
        link: Link,
        sampling: Sampling,
        seed: int,
        *,
        scheme: str = "rays",
        reference: tuple[Geometry, Link] | None = None,
        coupling: tuple[float, float] = (1.0, 1.0),
        differentiate_antennas: bool = True,
    ) -> None:
        self.sampling, self.seed = sampling, seed
        self.last_records: PathRecords | None = None  # those of the last map, if they fit
        self.rays = RayScene(geometry, link, differentiate_antennas=differentiate_antennas)
        sampler = RaySampler if scheme == "rays" else AreaSampler
        self.sampler = sampler(self.rays, sampling.samples * self.rays.scene_count, seed, reference)
        monostatic = bool((link.tx == link.rx).all())
        self.fixed = replace(Inputs.from_rays(self.rays, monostatic=monostatic), coupling=coupling)
        self._walk = RandomWalk(self.fixed, seed)
        warn_coplanar_surfaces(self.rays)
        edges = sampling.boundary and sampling.contacts and sampling.boundary_samples
        self.curves = find_intersection_curves(self.rays) if edges else None
        if self.curves is not None and len(self.curves.first) and sampling.depth > 1:
            require_no_interreflection(self._walk, self.curves, sampling.depth, seed)
        self.chunk = max(1, int(sampling.memory_budget) // (_BYTES_PER_VERTEX * sampling.depth))

    def inputs(
        self, tables: dict[str, mit.Float] | None = None, *, joint_antennas: bool = True
    ) -> Inputs:
        """Build the kernel's inputs, with some tables replaced by ones that carry derivatives.

        Args:
            tables: replaced tables by name.
            joint_antennas: True if antennas at one position also move as one.
        """
        attached = self.fixed.with_tables(tables or {})
        return replace(attached, monostatic=joint_antennas and self.fixed.monostatic)

    def deposit(self, out: BinAccumulator, *, record: bool) -> PathRecords | None:
        """Walk all paths into the bins.

        Args:
            out: accumulator of the map.
            record: True to record the paths, provided that all fit in one chunk.
        """
        record = record and self.sampler.size <= self.chunk
        records = None
        for index in index_chunks(self.sampler.size, self.chunk):
            found = self._walk_paths(index, out, record=record)
            if record:
                records = found
                dr.schedule(records)
            dr.eval(out.values)
        return records

    def iterate_records(self) -> Iterator[PathRecords]:
        """Iterate over the vertices of all paths, a chunk at a time."""
        for index in index_chunks(self.sampler.size, self.chunk):
            yield self._walk_paths(index, None, record=True)

    def _walk_paths(
        self, index: mit.UInt32, out: BinAccumulator | None, *, record: bool
    ) -> PathRecords:
        """Walk some paths into the bins, if given, and into records, if requested (else empty)."""
        depth, shared = self.sampling.depth, self.rays.link.shared_visibility
        monostatic = depth == 1 and self.fixed.monostatic
        state = self._start_paths(index)
        state["lane"] = dr.arange(mi.UInt32, dr.width(index))
        looped = record and depth > 1
        records = PathRecords.allocate(state, depth if looped else 0)
        receiver = integrand.AntennaPose.look_up(self.fixed, state["frame"], True)

        def visit(state: PathState, point: SurfaceInteraction) -> None:
            nonlocal records
            found, exists = walk.connect_path(
                self.fixed, state, point, True,
                shared_visibility=shared, monostatic=monostatic, antenna=receiver,
            )  # fmt: skip
            if out is not None:
                out.add(found, exists)
            if looped:
                records.write(state, exists)
            elif record:
                records = PathRecords.from_single_vertex(state, exists)

        if looped:
            state["count"] = records.count
        done = self._walk.run(state, depth, visit)
        return replace(records, count=done["count"]) if looped else records

    def _start_paths(self, index: mit.UInt32) -> PathState:
        """Create the state of paths at their first vertex."""
        start = self.sampler.draw(index, self.fixed)
        tx, passed = self.fixed.antenna_position(start.frame, False), start.transmission
        point = integrand.compute_interaction(self.fixed, start.point)
        incident, distance = integrand.direction_and_distance(point.position, tx)
        departure = integrand.to_radar_frame(self.fixed, start.frame, -incident)
        gain = self.fixed.gain(start.frame, False, departure)
        weight = start.weight * passed.transmittance * self.fixed.scale * gain / dr.square(distance)
        throughput = dr.select(start.weight > 0, weight, 0.0)
        length = distance + passed.extra_length
        sheets = passed if self.fixed.surfaces.has_sheets else None
        return walk.initial_state(
            index, start.frame, start.point, incident, throughput, length, sheets
        )

    @cached_property
    def boundary_samples(self) -> BoundarySamples | None:
        """Points of the boundary paths; the first chunks are launched when this returns."""
        sampling = self.sampling
        if not (sampling.boundary and sampling.boundary_samples):
            return None
        # No reference to this object: records would stay until garbage is collected.
        return BoundarySamples(
            self.fixed, sampling, self.seed, self.curves,
            chunks=partial(index_chunks, chunk=self.chunk),
        )  # fmt: skip

    def trace_boundary(self, inputs: Inputs) -> Iterator[BoundaryPaths]:
        """Trace the boundary paths of all families, a chunk at a time.

        Args:
            inputs: attached inputs.
        """
        if self.boundary_samples is None:
            return iter(())
        return self.boundary_samples.trace_paths(inputs, self._walk)


def index_chunks(size: int, chunk: int) -> Iterator[mit.UInt32]:
    """Split indices into chunks; their offset is opaque (no recompilation).

    Args:
        size: number of indices.
        chunk: most indices at a time.
    """
    # Equal sizes but for the last, so that a chunk reuses the memory of the one before.
    chunk = max(1, -(-size // max(1, -(-size // chunk))))
    for start in range(0, size, chunk):
        yield dr.arange(mi.UInt32, min(chunk, size - start)) + opaque(start)
