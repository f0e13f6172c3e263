"""One tracing of a scene: chains walked into bins or records, and the boundary chains."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from invertwin.channel import kernel, walk
from invertwin.channel.bins import Bins
from invertwin.channel.boundary_walk import BoundaryChains, BoundaryPoints, boundary_chains
from invertwin.channel.bridge import Geometry, opaque, tracer
from invertwin.channel.kernel import DIFFERENTIABLE, Inputs, Place
from invertwin.channel.passage import Passage
from invertwin.channel.paths import Grid, Link
from invertwin.channel.rays import Shot
from invertwin.channel.sampling import Sampling
from invertwin.channel.starts import AreaSampler, RaySampler
from invertwin.channel.walk import Records, State, Walk

_BYTES_PER_VERTEX = 21  # one record: triangle, two barycentrics, throughput, length, seen


@dataclass(frozen=True)
class Settings:
    """What one call of ``deposit_power`` is asked for."""

    geometry: Geometry
    link: Link
    grid: Grid
    sampling: Sampling
    seed: int
    scheme: str
    reference: tuple[Geometry, Link] | None
    backend: str

    @property
    def chunk(self) -> int:
        """Lanes that fit the memory budget."""
        per_lane = _BYTES_PER_VERTEX * self.sampling.depth
        return max(1, int(self.sampling.memory_budget) // per_lane)

    @property
    def tables(self) -> list[Tensor]:
        """What the map can be differentiated by, in the kernel's order."""
        owners = (self.geometry, self.link)
        return [
            next(getattr(owner, name) for owner in owners if hasattr(owner, name))
            for name in DIFFERENTIABLE
        ]


class Trace:
    """The detached half of a call: chains, and their records while they fit the budget."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.shot = Shot(settings.geometry, settings.link)
        sampler = RaySampler if settings.scheme == "rays" else AreaSampler
        self.sampler = sampler(
            self.shot, settings.sampling.samples, settings.seed, settings.reference
        )
        one_place = bool((settings.link.tx == settings.link.rx).all())
        self.fixed = Inputs.of(settings.geometry, settings.link, self.shot, one_place)
        self._walk = Walk(self.shot, self.fixed, settings.seed)
        self._kept: Records | None = None
        self._points: BoundaryPoints | None = None

    def bins(self) -> Bins:
        """An empty map."""
        return Bins(self.settings.grid, self.shot.link.frame_count)

    def inputs(self, tables: dict[str, Any] | None = None, *, together: bool = True) -> Inputs:
        """The kernel's inputs, with some arrays replaced by ones that carry derivatives.

        ``together`` says that antennas at one place also move as one.
        """
        return replace(self.fixed, monostatic=together and self.fixed.monostatic, **(tables or {}))

    def deposit(self, out: Bins, *, record: bool) -> None:
        """Walk all chains into the bins; ``record`` keeps them if all fit in one chunk."""
        import drjit as dr

        record = record and self.sampler.size <= self.settings.chunk
        for index in chunks(self.sampler.size, self.settings.chunk):
            records = self._walked(index, out, record=record)
            if record:
                self._kept = records
                dr.schedule(*records.columns)
            dr.eval(out.values)

    def records(self) -> Iterator[Records]:
        """The vertices of all chains, a chunk at a time."""
        if self._kept is not None:
            yield self._kept
            return
        for index in chunks(self.sampler.size, self.settings.chunk):
            yield self._walked(index, None, record=True)

    def _walked(self, index: Any, out: Bins | None, *, record: bool) -> Records:
        """Walk some chains into the bins, if given, and into records, if asked (else empty)."""
        import drjit as dr

        depth, shared = self.settings.sampling.depth, self.settings.link.shared_visibility
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
                out.add(found, exists)
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

    def draw_boundary(self) -> None:
        """Draw the first edge points, for the derivative to come, without waiting for them."""
        settings, sampling = self.settings, self.settings.sampling
        if sampling.boundary and sampling.boundary_samples:
            self._points = BoundaryPoints(
                self.shot,
                self.fixed,
                samples=sampling.boundary_samples,
                depth=sampling.depth,
                seed=settings.seed,
                interior=sampling.interior_edges,
                chunks=lambda size: chunks(size, settings.chunk),
            )

    def boundary(self, inputs: Inputs) -> Iterator[BoundaryChains]:
        """Boundary paths of all segments, a chunk at a time."""
        if self._points is None:
            self.draw_boundary()
        points, self._points = self._points, None
        if points is None:
            return iter(())
        return boundary_chains(self.shot, inputs, self._walk, points)


def chunks(size: int, chunk: int) -> Iterator[Any]:
    """Index arrays that together count to ``size``; their offset is opaque (no recompilation)."""
    import drjit as dr

    mi = tracer()
    # Of one size but for the last, so that a chunk takes the memory of the one before.
    chunk = max(1, -(-size // max(1, -(-size // chunk))))
    for start in range(0, size, chunk):
        yield dr.arange(mi.UInt32, min(chunk, size - start)) + opaque(start)
