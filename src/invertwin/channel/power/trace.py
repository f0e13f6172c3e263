"""One tracing of a scene: paths walked into bins or records, and the boundary paths."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

from torch import Tensor

from invertwin.channel.paths import Link
from invertwin.channel.power import integrand
from invertwin.channel.power import random_walk as walk
from invertwin.channel.power.bins import Bins
from invertwin.channel.power.boundary import BoundaryPaths, BoundaryPoints, boundary_paths
from invertwin.channel.power.integrand import DIFFERENTIABLE, Inputs, Place
from invertwin.channel.power.intersection_curves import require_unlit
from invertwin.channel.power.random_walk import Records, State, Walk
from invertwin.channel.power.start_points import AreaSampler, RaySampler
from invertwin.channel.power.surface import SURFACE
from invertwin.channel.power.transmission import Passage
from invertwin.channel.rays.arrays import opaque
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.coplanar import warn_of_coplanar
from invertwin.channel.rays.intersections import contacts_of
from invertwin.channel.rays.ray_scene import RayScene
from invertwin.channel.rays.scene_tables import Geometry
from invertwin.channel.sampling import Sampling
from invertwin.checks import plain

_BYTES_PER_VERTEX = 20  # one record: triangle, two barycentrics, throughput, length


def tables_of(geometry: Geometry, link: Link) -> list[Tensor]:
    """What a map can be differentiated with respect to, in the kernel's order.

    Args:
        geometry: The scene.
        link: Antennas.
    """
    owners = {"vertices": geometry, **dict.fromkeys(SURFACE, geometry.surfaces)}
    return [getattr(owners.get(name, link), name) for name in DIFFERENTIABLE]


def without_derivatives(geometry: Geometry, link: Link) -> tuple[Geometry, Link]:
    """Plain numbers, also within the transforms of ``torch.func``.

    Args:
        geometry: The scene.
        link: Antennas.
    """
    tables = dict(zip(DIFFERENTIABLE, map(plain, tables_of(geometry, link)), strict=True))
    rows = {name: tables.pop(name) for name in SURFACE}
    rows["depolarisation"] = plain(geometry.surfaces.depolarisation)
    rows = replace(geometry.surfaces, **rows)
    return replace(geometry, vertices=tables.pop("vertices"), surfaces=rows), replace(
        link, **tables
    )


class Trace:
    """The detached half of a call: which paths there are. Every call gives the same ones."""

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
        antennas_move: bool = True,
    ) -> None:
        """Upload a scene and prepare the samplers.

        Args:
            geometry: The scene.
            link: Antennas.
            sampling: How many paths are drawn.
            seed: Of all random numbers.
            scheme: Where paths start, see ``deposit_power``.
            reference: What fixes how starts are drawn, see ``deposit_power``.
            coupling: Factors of paths with an odd and an even number of bounces.
            antennas_move: Whether derivatives may flow through the places of antennas.
        """
        self.sampling, self.seed = sampling, seed
        self.recorded: Records | None = None  # the last paths, where they fit
        self.rays = RayScene(geometry, link, antennas_move=antennas_move)
        sampler = RaySampler if scheme == "rays" else AreaSampler
        self.sampler = sampler(self.rays, sampling.samples * self.rays.scenes, seed, reference)
        one_place = bool((link.tx == link.rx).all())
        self.fixed = replace(Inputs.of(self.rays, monostatic=one_place), coupling=coupling)
        self._walk = Walk(self.rays, self.fixed, seed)
        warn_of_coplanar(self.rays)
        edges = sampling.boundary and sampling.contacts and sampling.boundary_samples
        self.contacts = contacts_of(self.rays) if edges else None
        if self.contacts is not None and len(self.contacts.first) and sampling.depth > 1:
            require_unlit(self.rays, self.fixed, self._walk, self.contacts, sampling.depth, seed)
        per_lane = _BYTES_PER_VERTEX * sampling.depth
        self.chunk = max(1, int(sampling.memory_budget) // per_lane)

    def inputs(self, tables: dict[str, Any] | None = None, *, together: bool = True) -> Inputs:
        """The kernel's inputs, with some arrays replaced by ones that carry derivatives.

        Args:
            tables: By name.
            together: Whether antennas at one place also move as one.
        """
        attached = self.fixed.replaced(tables or {})
        return replace(attached, monostatic=together and self.fixed.monostatic)

    def deposit(self, out: Bins, *, record: bool) -> Records | None:
        """Walk all paths into the bins.

        Args:
            out: The bins.
            record: Whether to record the paths, which is done if all fit in one chunk.
        """
        record = record and self.sampler.size <= self.chunk
        records = None
        for index in chunks(self.sampler.size, self.chunk):
            found = self._walked(index, out, record=record)
            if record:
                records = found
                dr.schedule(*records.columns)
            dr.eval(out.values)
        return records

    def records(self) -> Iterator[Records]:
        """The vertices of all paths, a chunk at a time."""
        for index in chunks(self.sampler.size, self.chunk):
            yield self._walked(index, None, record=True)

    def _walked(self, index: Any, out: Bins | None, *, record: bool) -> Records:
        """Walk some paths into the bins, if given, and into records, if asked (else empty)."""
        depth, shared = self.sampling.depth, self.rays.link.shared_visibility
        one_place = depth == 1 and self.fixed.monostatic
        state = self._started(index)
        state["lane"] = dr.arange(mi.UInt32, dr.width(index))
        looped = record and depth > 1
        records = Records.empty(state, depth if looped else 0)
        receiver = integrand.End.of(self.fixed, state["frame"], True)

        def visit(state: State, point: Place) -> None:
            nonlocal records
            found, exists = walk.connect(
                self.rays, self.fixed, state, point, True,
                shared=shared, one_place=one_place, end=receiver,
            )  # fmt: skip
            if out is not None:
                out.add(found, exists)
            if looped:
                records.write(state, exists)
            elif record:
                records = Records.single(state, exists)

        if looped:
            state["count"] = records.count
        done = self._walk.run(state, depth, visit)
        return replace(records, count=done["count"]) if looped else records

    def _started(self, index: Any) -> State:
        """Paths at their first vertex."""
        drawn = self.sampler.draw(index, self.fixed)
        tx = self.fixed.antenna(drawn.frame, False)
        point = integrand.place(self.fixed, drawn.face, drawn.b1, drawn.b2)
        back, distance = integrand.segment(point.position, tx)
        gain = self.fixed.gain(
            drawn.frame, False, integrand.to_radar(self.fixed, drawn.frame, -back)
        )
        weight = drawn.weight * drawn.transmittance * self.fixed.scale * gain / dr.square(distance)
        passed = Passage(drawn.transmittance, drawn.extra)
        return walk.start(
            index, drawn.frame, drawn.face, drawn.b1, drawn.b2, back,
            throughput=dr.select(drawn.weight > 0, weight, 0.0),
            length=distance + drawn.extra,
            passed=passed if self.fixed.surfaces.sheets else None,
        )  # fmt: skip

    @cached_property
    def boundary_points(self) -> BoundaryPoints | None:
        """The edge points of the boundary paths; the first are being drawn when this returns."""
        sampling = self.sampling
        if not (sampling.boundary and sampling.boundary_samples):
            return None
        # Nothing that refers to this object: records would stay until garbage is collected.
        return BoundaryPoints(
            self.rays, self.fixed, sampling, self.seed, self.contacts,
            chunks=partial(chunks, chunk=self.chunk),
        )  # fmt: skip

    def boundary(self, inputs: Inputs) -> Iterator[BoundaryPaths]:
        """Boundary paths of all segments, a chunk at a time."""
        if self.boundary_points is None:
            return iter(())
        return boundary_paths(self.rays, inputs, self._walk, self.boundary_points)


def chunks(size: int, chunk: int) -> Iterator[Any]:
    """Index arrays that together count to ``size``; their offset is opaque (no recompilation).

    Args:
        size: How many there are in all.
        chunk: Most of them at a time.
    """
    # Of one size but for the last, so that a chunk takes the memory of the one before.
    chunk = max(1, -(-size // max(1, -(-size // chunk))))
    for start in range(0, size, chunk):
        yield dr.arange(mi.UInt32, min(chunk, size - start)) + opaque(start)
