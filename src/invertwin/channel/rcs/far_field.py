"""The far field that a smooth scene scatters: every bounce, edges, both polarisations, coherent.

Each order is physical optics of its own incident field; all add in one field. In scenes of few flat
facets light is clipped beams, in others ray tubes: the same integral over the same lit surface.

Differs from the source: physical optics of separate antennas is not reciprocal. The result is the
mean of both ways, which is. In one place it is the mean of both cross-polar terms.
"""

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.beams.beam_tracing import (
    MAX_FACETS_BEAM_TRACING,
    Facets,
    IlluminatedPatches,
    build_facets,
    trace_beams,
)
from invertwin.channel.em.dielectric_solids import DielectricSolids, group_solids, is_homogeneous
from invertwin.channel.em.plane_waves import (
    SmoothInterfaces,
    dot,
    parallelogram_integral,
    polarisations,
    radiate_field,
    reflect_field,
)
from invertwin.channel.em.wedges import (
    MIN_EDGE_ANGLE,
    Wedges,
    find_wedges,
    fringe_field,
    is_grazing_sheet,
    is_outside_wedge,
    select_body_edges,
)
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.ray_scene import Occluders, is_visible
from invertwin.channel.rays.topology import Topology, topology_of
from invertwin.channel.rcs.dielectric_interfaces import scatter_at_interfaces
from invertwin.channel.rcs.moments.efie_solver import EFIESolver
from invertwin.channel.rcs.moments.mfie import MFIESolver
from invertwin.channel.rcs.plate_diffraction import find_plates, trace_multiple_diffractions
from invertwin.channel.rcs.rays_in_dielectrics import (
    MAX_SMOOTH_ANGLE,
    SmoothFaces,
    group_smooth_faces,
    require_separate_conductors,
    trace_inner_tubes,
)
from invertwin.channel.rcs.shooting_bouncing_rays import find_illuminated_triangles, trace_tubes
from invertwin.checks import is_differentiated
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError, PhysicsWarning
from invertwin.runtime.progress import track
from invertwin.scene.material.fresnel import refractive_index
from invertwin.scene.scene import Scene

_MAX_SAGITTA = 1 / 50  # wavelengths that a facet may be off the curved surface
_MIN_TURN_ANGLE = 1e-6  # rad that normals turn from facet to facet where a surface is curved
_SEGMENTS_PER_WAVELENGTH = 2.0  # of an edge per wavelength; each is seen or not
_MIN_EDGE_RUN = 2.0  # wavelengths that an edge which ends in a smooth surface runs on at least
_EDGE_OFFSET = 1e-5  # of the scene's size: how far aside of an edge rays to it end
_ROWS_AT_ONCE = 1 << 18

_PatchOrders = tuple[Sequence[IlluminatedPatches], DielectricSolids | None, Sequence[int]]
"""Patches of all orders, what waves enter, and numbers of the frequencies of which that holds."""


@dataclass(frozen=True)
class _FarFieldTarget:
    """A scene as the laws of waves see it.

    Attributes:
        facets: its triangles.
        topology: its edges.
        vertices: [m].
        occluders: what rays meet.
        interfaces: of the triangles, for each frequency.
        wave_numbers: k of the frequencies [1/m].
        up: direction of V.
        interiors: groups of frequencies, and what waves enter there.
    """

    facets: Facets
    topology: Topology
    vertices: Float64[Tensor, "v 3"]
    occluders: Occluders
    interfaces: Sequence[SmoothInterfaces]
    wave_numbers: Sequence[float]
    up: Float64[Tensor, "3"]
    interiors: Sequence[tuple[DielectricSolids | None, Sequence[int]]]

    @property
    def wavelength(self) -> float:
        """The shortest [m]."""
        return 2 * math.pi / max(self.wave_numbers)

    @cached_property
    def smooth_faces(self) -> SmoothFaces:
        """The facets as pieces of smooth faces."""
        return group_smooth_faces(self.facets, self.topology.edge_faces)

    def max_refractive_index(self, number: int) -> float:
        """The largest refractive index of waves inside an object; 1 where none enter."""
        inside = [solids.permittivity[number] for solids, _ in self.interiors if solids is not None]
        return max([1.0, *(float(refractive_index(e.detach())) for e in inside)])

    @property
    def is_smooth_metal(self) -> bool:
        """Whether all is smooth metal, of which fields do not depend on the frequency."""
        first = self.interfaces[0]
        smooth = (first.coherence == 1) & (first.rms_height == 0)
        return bool((first.conducting & smooth).all())

    @property
    def is_closed(self) -> bool:
        """Whether all is closed bodies, which have too many facets for beams."""
        return len(self.facets.normal) > MAX_FACETS_BEAM_TRACING and bool(self.facets.solid.all())

    def is_unoccluded(self, points: Tensor, directions: Tensor) -> Tensor:
        """Whether nothing lies between points and the far end of directions."""
        return is_visible(self.occluders, points, points + 3 * self.facets.size * directions)


def trace_far_field(
    scene: Scene,
    transmitters: Float64[Tensor, "aspect 3"],
    receivers: Float64[Tensor, "aspect 3"] | None,
    frequencies: Float64[Tensor, " frequency"],
    *,
    depth: int,
    edges: int,
    tubes_per_wavelength: float,
    up: Float64[Tensor, "3"],
    boundary: bool = True,
) -> dict[str, Complex128[Tensor, "frequency aspect 2 2"]]:
    """Scattering amplitudes S of every part of the field, about the world's origin; σ = 4π|S|².

    Rows are the receiving, columns the transmitting polarisation, V and H of ``polarisations``. The
    parts are ``order 1``, ``order 2`` and so on, ``edges 1``, ``edges 2``, and of small
    conductors ``rest``, which is what these leave out of the solved field.

    Args:
        scene: conductors and smooth dielectrics.
        transmitters: unit vectors from the scene to the antenna.
        receivers: the same; None = the transmitter receives.
        frequencies: [Hz].
        depth: most bounces.
        edges: most diffractions of a wave by sharp edges of conductors; 0 leaves them out, and the
            rest.
        tubes_per_wavelength: at the highest frequency, where the scene has many triangles.
        up: V lies in a plane with this unit vector.
        boundary: False leaves out of derivatives what moving edges of beams change.

    Raises:
        InputError: a cloud, a rough surface, derivatives of a scene of many triangles, or of a
            small one of which vertices lie at one place, a dielectric inside or in touch with
            another one that waves enter, a conductor in touch with one of many triangles.
    """
    with tracing():
        body = _build_target(scene, frequencies, up)
        count = len(body.facets.normal)
        if count > MAX_FACETS_BEAM_TRACING and is_differentiated(body.vertices):
            raise InputError(
                f"expected at most {MAX_FACETS_BEAM_TRACING} triangles for derivatives of a "
                f"signature, got {count}: "
                "ray tubes jump at edges; detach the scene, or fit with power paths"
            )
        if count > MAX_FACETS_BEAM_TRACING:
            _check_inner_tubes(body)
        spacing = (
            None if count <= MAX_FACETS_BEAM_TRACING else body.wavelength / tubes_per_wavelength
        )
        ways = [(transmitters, transmitters if receivers is None else receivers)]
        if receivers is not None:
            ways.append((receivers, transmitters))
        found = [
            _FarFieldTracer(body, *way).trace_parts(depth, edges, spacing, boundary) for way in ways
        ]
        # The mean of both ways between two antennas, or between polarisations of one.
        parts = {name: (found[0][name] + found[-1][name].mT) / 2 for name in found[0]}
        solved = edges > 0 and body.is_smooth_metal
        rest = (
            _residual_field(body, ways, torch.stack([*parts.values()]).sum(0)) if solved else None
        )
        _warn_validity(scene, body, tubes_per_wavelength, spacing, rest is not None)
        return parts if rest is None else parts | {"rest": rest}


@dataclass(frozen=True)
class _FarFieldTracer:
    """Waves from one set of directions, received in another."""

    target: _FarFieldTarget
    transmitters: Tensor
    receivers: Tensor

    def trace_parts(
        self, depth: int, edges: int, tube_width: float | None, boundary: bool
    ) -> dict[str, Tensor]:
        """All parts of the field."""
        found = self._trace_bounces(depth, tube_width, boundary)
        return found | self._trace_edges(edges) if edges else found

    @property
    def _incident_fields(self) -> Tensor:
        """Incident fields of 1 V/m, V and H, of every aspect."""
        return polarisations(self.transmitters, self.target.up)

    def _zero_amplitudes(self) -> Tensor:
        shape = (len(self.target.wave_numbers), len(self.transmitters), 2, 2)
        return torch.zeros(shape, dtype=torch.complex128)

    def _add_received(self, total: Tensor, aspect: Tensor, radiated: Tensor) -> Tensor:
        """A total with the parts of F that the receiving polarisations see added."""
        seen = polarisations(self.receivers, self.target.up)[aspect]
        return total.index_add(0, aspect, dot(seen[:, :, None], radiated[:, None]))

    def _trace_bounces(
        self, depth: int, tube_width: float | None, boundary: bool
    ) -> dict[str, Tensor]:
        """Physical optics of every order: of beams, or of tubes where a spacing is given."""
        orders = [list(self._zero_amplitudes()) for _ in range(depth)]
        chains = (
            self._trace_beam_orders(depth, boundary)
            if tube_width is None
            else self._trace_tube_orders(depth, tube_width)
        )
        for chain, solids, members in chains:
            self._add_orders(orders, chain, solids, members)
        return {f"order {n}": torch.stack(order) for n, order in enumerate(orders, start=1)}

    def _add_orders(
        self,
        orders: list[list[Tensor]],
        patch_orders: Sequence[IlluminatedPatches],
        solids: DielectricSolids | None,
        frequency_indices: Sequence[int],
    ) -> None:
        """Add what all patches send to the fields of their orders, at some frequencies."""
        body = self.target
        currents: list[Tensor] = []
        integrals = [
            bounce.phase_integral(self.receivers[bounce.aspect]) for bounce in patch_orders
        ]
        for f in frequency_indices:
            k = body.wave_numbers[f]
            if not (body.is_smooth_metal and currents):
                currents = self._patch_amplitudes(
                    patch_orders, solids, body.interfaces[f], 1.0 if body.is_smooth_metal else k
                )
            rows = zip(orders, patch_orders, integrals, currents, strict=False)
            for order, bounce, integral, current in rows:
                strength = integral(k) * (k if body.is_smooth_metal else 1.0)
                sent = current * strength[:, None, None]
                order[f] = order[f].index_add(0, bounce.aspect, sent)

    def _trace_beam_orders(self, depth: int, boundary: bool) -> Iterator[_PatchOrders]:
        """Few facets: clipped beams."""
        facets, incident = self.target.facets, -self.transmitters
        for solids, members in self.target.interiors:
            found = trace_beams(facets, incident, depth, boundary=boundary, solids=solids)
            yield list(found), solids, members

    def _trace_tube_orders(self, depth: int, tube_width: float) -> Iterator[_PatchOrders]:
        """Many facets: tubes that begin as lit triangles."""
        body = self.target
        for lit in find_illuminated_triangles(
            body.facets, body.is_unoccluded, -self.transmitters, tube_width
        ):
            outside = [lit, *trace_tubes(body.facets, body.occluders, lit, tube_width, depth)]
            for solids, members in body.interiors:
                chain = outside
                if solids is not None:
                    chain = trace_inner_tubes(
                        body.smooth_faces, body.occluders, solids, outside, tube_width, depth
                    )
                yield chain, solids, members

    def _patch_amplitudes(
        self,
        patch_orders: Sequence[IlluminatedPatches],
        solids: DielectricSolids | None,
        interfaces: SmoothInterfaces,
        k: float,
    ) -> list[Tensor]:
        """S per m² of all patches, order by order: [row, receive, transmit] each."""
        found: list[Tensor] = []
        again = passed = torch.zeros(0)
        for bounce in patch_orders:
            if not found:
                field = self._incident_fields.to(torch.complex128)[bounce.aspect]
            elif solids is None:
                field = again[bounce.parent]
            else:
                through = bounce.transmitted[:, None, None]
                field = torch.where(through, passed[bounce.parent], again[bounce.parent])
                field = field * bounce.spreading[:, None, None]
            towards, own = self.receivers[bounce.aspect], interfaces.rows(bounce.facet)
            if solids is None:
                surface = (own, k, bounce.normal, bounce.direction, field)
                sent, again = radiate_field(*surface, towards), reflect_field(*surface)
            else:
                sent, again, passed = scatter_at_interfaces(solids, own, k, bounce, field, towards)
            seen = polarisations(self.receivers, self.target.up)[bounce.aspect]
            found.append(dot(seen[:, :, None], sent[:, None]))
        return found

    def _trace_edges(self, max_diffractions: int) -> dict[str, Tensor]:
        """What sharp edges of conductors add to physical optics."""
        body = self.target
        topology = body.topology
        ends = body.vertices[topology.edges]
        wedges = find_wedges(body.facets.corners, ends, topology.edge_faces)
        wedges = wedges.rows(body.interfaces[0].conducting[wedges.faces[:, 0]])
        wedges = wedges.rows(select_body_edges(wedges, body.wavelength * _MIN_EDGE_RUN))
        found = {"edges 1": self._fringe_amplitudes(wedges)}
        plates = find_plates(wedges) if max_diffractions > 1 else []
        totals = [list(self._zero_amplitudes()) for _ in range(2, max_diffractions + 1)]
        every = torch.arange(len(self.transmitters))
        for f, k in enumerate(body.wave_numbers if plates else ()):
            several = trace_multiple_diffractions(
                plates,
                k,
                -self.transmitters,
                self._incident_fields,
                self.receivers,
                max_diffractions,
                body.is_unoccluded,
            )
            for total, sent in zip(totals, several, strict=True):
                total[f] = self._add_received(total[f], every, sent)
        return found | {f"edges {n}": torch.stack(t) for n, t in enumerate(totals, start=2)}

    def _fringe_amplitudes(self, wedges: Wedges) -> Tensor:
        """First-order fringe currents of the parts of edges that both antennas see."""
        body, total = self.target, list(self._zero_amplitudes())
        wedges = _split_edges(wedges, body.wavelength / _SEGMENTS_PER_WAVELENGTH)
        count = len(wedges.start)
        left_out = 0
        some = torch.arange(len(self.transmitters))
        for aspects in some.split(max(1, _ROWS_AT_ONCE // max(1, count))) if count else ():
            aspect = aspects.repeat_interleave(count)
            row = torch.arange(count).repeat(len(aspects))
            for way in (self.transmitters, self.receivers):
                direction = way[aspect]
                at = wedges.rows(row)
                keep = is_outside_wedge(at, direction)
                flat = keep & is_grazing_sheet(at, direction)
                left_out += int(flat.sum())
                aspect, row = aspect[keep & ~flat], row[keep & ~flat]
            for way in (self.transmitters, self.receivers):
                at = wedges.rows(row)
                aside = (at.normals - at.face_tangents).sum(1)
                middle = (at.start + at.end) / 2
                middle = middle + _EDGE_OFFSET * body.facets.size * normalize(aside, dim=1)
                seen = body.is_unoccluded(middle, way[aspect])
                aspect, row = aspect[seen], row[seen]
                if way is self.receivers:
                    break
            at = wedges.rows(row)
            d, s = -self.transmitters[aspect], self.receivers[aspect]
            middle, side = (at.start + at.end) / 2, at.end - at.start
            for f, k in enumerate(body.wave_numbers):
                sent = fringe_field(at, k, d, self._incident_fields[aspect], s)
                wave = k * (s - d)
                width = parallelogram_integral(wave, side, torch.zeros_like(side))
                turn = dot(wave, middle)
                scale = torch.polar(torch.ones_like(turn), turn) * width * side.norm(dim=1)
                total[f] = self._add_received(total[f], aspect, sent * scale[:, None, None])
        if left_out:
            warnings.warn(
                f"edges of sheets within {math.degrees(MIN_EDGE_ANGLE):.0f}° of grazing are left "
                f"out: "
                "their fringe currents are not valid there, and physical optics is not either",
                PhysicsWarning,
                stacklevel=2,
            )
        return torch.stack(total)


def _check_inner_tubes(target: _FarFieldTarget) -> None:
    """Refuse what tubes inside of solids cannot do."""
    for solids, _ in target.interiors:
        if solids is None:
            continue
        if is_differentiated(solids.permittivity):
            names = [solids.names[int(n)] for n in solids.owner[solids.transparent].unique()]
            raise InputError(
                f"expected permittivities of {', '.join(names)} without derivatives in a scene of "
                f"more than {MAX_FACETS_BEAM_TRACING} triangles, got some that require grad: ray "
                f"tubes inside jump at "
                "edges; detach them, use fewer triangles, or an open mesh, which shows its front "
                "alone"
            )
        require_separate_conductors(target.facets, solids)


def _residual_field(
    target: _FarFieldTarget, antenna_pairs: Sequence[tuple[Tensor, Tensor]], modelled: Tensor
) -> Tensor | None:
    """What bounces and edges leave out of the fields of small targets; of larger ones zero."""
    meshes = EFIESolver(target.vertices, target.topology.faces, target.facets.solid, target.up)
    cells = MFIESolver(target.facets.corners.detach(), target.up) if target.is_closed else None
    rest: dict[int, Tensor] = {}
    downwards = sorted(range(len(modelled)), key=lambda f: -target.wave_numbers[f])
    for f in track(downwards, "frequencies"):
        k = target.wave_numbers[f]
        solver = cells if cells is not None and cells.supports(k) else meshes
        found = solver.solve_scattering(k, antenna_pairs)
        if found is not None:
            rest[f] = (found[0] + found[-1].mT) / 2 - modelled[f]
    if not rest:
        return None
    return torch.stack([rest.get(f, torch.zeros_like(modelled[f])) for f in range(len(modelled))])


def _split_edges(wedges: Wedges, max_length: float) -> Wedges:
    """Edges in equal pieces no longer than a length."""
    side = wedges.end - wedges.start
    pieces = (side.detach().norm(dim=1) / max_length).ceil().long().clamp_min(1)
    row = torch.repeat_interleave(pieces)
    number = torch.arange(len(row)) - (pieces.cumsum(0) - pieces)[row]
    cut = wedges.rows(row)
    low, high = (number / pieces[row])[:, None], ((number + 1) / pieces[row])[:, None]
    columns = vars(cut) | {
        "start": cut.start + low * side[row],
        "end": cut.start + high * side[row],
    }
    return Wedges(**columns)


def _build_target(scene: Scene, frequencies: Tensor, up: Tensor) -> _FarFieldTarget:
    objects = scene.objects
    clouds = [name for name, item in objects.items() if item.cloud is not None]
    if clouds:
        raise InputError(
            f"expected objects with surfaces, got clouds for {', '.join(clouds)}; mesh them"
        )
    vertices = torch.cat([item.vertices for item in objects.values()])
    topology = topology_of([item.mesh for item in objects.values()])
    facets = build_facets(vertices, topology)
    occluders = Occluders(vertices, topology, vertices.detach().mean(0))
    skins = [_smooth_interfaces(scene, topology, frequency) for frequency in frequencies.tolist()]
    wave_numbers = [2 * math.pi * f / SPEED_OF_LIGHT for f in frequencies.tolist()]
    owner, names = topology.face_object, list(objects)
    entered = group_solids(skins, wave_numbers, facets.corners, facets.solid, owner, names)
    return _FarFieldTarget(facets, topology, vertices, occluders, skins, wave_numbers, up, entered)


def _smooth_interfaces(scene: Scene, topology: Topology, frequency: float) -> SmoothInterfaces:
    """The skins of all triangles."""
    columns: list[list[Tensor]] = [[] for _ in SmoothInterfaces._fields]
    for name, item in scene.objects.items():
        skin = item.material.smooth_interface(frequency)
        if skin is None:
            raise InputError(
                f"expected smooth surfaces in a signature, got {type(item.material).__name__} for "
                f"{name}; give a PerfectConductor, RoughConductor, Dielectric, RefractingBody or "
                "Slab"
            )
        metal = torch.tensor(skin.permittivity is None)
        epsilon = torch.ones(()) if skin.permittivity is None else skin.permittivity
        values = (metal, epsilon.to(torch.complex128), *skin[1:])
        for column, value in zip(columns, values, strict=True):
            column.append(value.expand(len(item.mesh.faces)))
    return SmoothInterfaces(*map(torch.cat, columns))


def _warn_validity(
    scene: Scene,
    target: _FarFieldTarget,
    density: float,
    tube_width: float | None,
    has_residual: bool,
) -> None:
    """Say where the physics ends."""
    found: list[str] = []
    if tube_width is not None and density < 1:
        found.append(f"{density:g} tubes per wavelength are too few: use 1 or more, better 4")
    faces = target.topology.face_object
    both = torch.nn.functional.pad(target.topology.edge_faces, (0, 1), value=-1)[:, :2]
    both = torch.where(both >= 0, both, both[:, :1])  # an open edge does not turn
    normal = target.facets.normal.detach()
    turn = 2 * torch.asin(
        (0.5 * (normal[both[:, 0]] - normal[both[:, 1]]).norm(dim=1)).clamp_max(1)
    )
    ends = target.vertices.detach()[target.topology.edges]
    # A triangle of side ℓ whose neighbours turn by α is ℓα/√12 off the curved surface.
    off = (ends[:, 1] - ends[:, 0]).norm(dim=1) * turn / math.sqrt(12)
    smooth = (turn > _MIN_TURN_ANGLE) & (turn < MAX_SMOOTH_ANGLE)
    for number, name in enumerate(scene.objects):
        own = faces == number
        points = target.facets.corners.detach()[own].reshape(-1, 3)
        size = float((points.amax(0) - points.amin(0)).norm())
        if size < target.wavelength and not has_residual:
            found.append(
                f"{name} is {size / target.wavelength:.2g} wavelengths large: physical optics is "
                f"for "
                "objects of several"
            )
        mine = smooth & own[both[:, 0]]
        # Inside, waves are shorter.
        shorter = target.max_refractive_index(number)
        sagitta = float(off[mine].median()) / target.wavelength if bool(mine.any()) else 0.0
        if sagitta * shorter > _MAX_SAGITTA:
            found.append(
                f"the facets of {name} are {sagitta * shorter:.2g} wavelengths off the curved "
                "surface, more than 1/50: use a finer mesh"
            )
        mixed = target.facets.solid[own].all() and not is_homogeneous(
            target.interfaces[0].rows(own)
        )
        if bool(mixed):
            found.append(
                f"{name} is closed and its permittivity differs between triangles: it shows its "
                "front alone"
            )
    for text in found:
        warnings.warn(text, PhysicsWarning, stacklevel=3)
