"""Coherent far field of smooth scenes: physical optics of every bounce (SBR), and edges (PTD).

Each order is physical optics of its own incident field; all orders add coherently. Scenes of few
flat facets use beam tracing, others ray tubes (shooting and bouncing rays): the same integral over
the same illuminated surface.

Differs from the source: bistatic physical optics is not reciprocal. The result is averaged over
transmitter and receiver exchanged, which is reciprocal; in the monostatic case that averages both
cross-polar terms.
"""

import itertools
import math
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial

import torch
from jaxtyping import Complex128, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.beams import beam_tracing
from invertwin.channel.beams.beam_tracing import MAX_FACETS_BEAM_TRACING, IlluminatedPatches
from invertwin.channel.em import dielectric_solids, plane_waves
from invertwin.channel.em import wedges as wedge_geometry
from invertwin.channel.rays import edge_crossings
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.coplanar import refuse_coplanar_surfaces
from invertwin.channel.rays.ray_scene import Occluders, is_visible
from invertwin.channel.rays.scene_tables import connect_surfaces
from invertwin.channel.rays.topology import Topology
from invertwin.channel.rcs import rays_in_dielectrics
from invertwin.channel.rcs.dielectric_interfaces import incident_power, scatter_at_interfaces
from invertwin.channel.rcs.moments.efie_solver import EFIESolver
from invertwin.channel.rcs.moments.mfie import MFIESolver
from invertwin.channel.rcs.moments.solver import Refusal, warn_not_solved
from invertwin.channel.rcs.plate_diffraction import find_plates, trace_multiple_diffractions
from invertwin.channel.rcs.shooting_bouncing_rays import find_illuminated_triangles, trace_tubes
from invertwin.channel.rcs.surface_paths import face_path_lengths
from invertwin.checks import is_differentiated
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError, PhysicsWarning
from invertwin.runtime.concurrency import torch_threads
from invertwin.runtime.progress import track
from invertwin.scene.material.fresnel import refractive_index
from invertwin.scene.scene import Scene

_MAX_SAGITTA = 1 / 50  # wavelengths between a facet and the curved surface
_MIN_TURN_ANGLE = 1e-6  # rad between adjacent normals of a curved surface
_SEGMENTS_PER_WAVELENGTH = 2.0  # pieces of an edge, each visible or not
_MIN_EDGE_RUN = 2.0  # wavelengths: least length of an edge that ends in a smooth surface
_EDGE_OFFSET = 1e-5  # of the scene's size: distance of rays' ends from an edge
_MIN_GAP = 5e-3  # wavelengths: waves pass narrower gaps between surfaces as if they were closed
_FAR = 10.0  # of the scene's size: distance from where surfaces are seen
_ROWS_AT_ONCE = 1 << 18
_MAX_POWER_GAIN = 1.1  # of an order over the one before: power at a focus is approximate

_PatchOrders = tuple[
    Sequence[IlluminatedPatches], dielectric_solids.DielectricSolids | None, Sequence[int]
]
"""Patches of all orders, dielectric solids, and indices of the frequencies for which they hold."""


@dataclass(frozen=True)
class _FarFieldTarget:
    """Scene as a target of plane waves.

    Attributes:
        facets: facets of all triangles.
        topology: faces and edges.
        vertices: vertex positions [m].
        occluders: ray scene of the triangles.
        interfaces: smooth interfaces of the triangles, per frequency.
        wave_numbers: wave number k per frequency [1/m].
        up: unit vector of the vertical axis, which defines V.
        interiors: dielectric solids, each with the indices of its frequencies.
    """

    facets: beam_tracing.Facets
    topology: Topology
    vertices: Float64[Tensor, "v 3"]
    occluders: Occluders
    interfaces: Sequence[plane_waves.SmoothInterfaces]
    wave_numbers: Sequence[float]
    up: Float64[Tensor, "3"]
    interiors: Sequence[tuple[dielectric_solids.DielectricSolids | None, Sequence[int]]]

    @property
    def wavelength(self) -> float:
        """Shortest wavelength [m]."""
        return 2 * math.pi / max(self.wave_numbers)

    @cached_property
    def smooth_faces(self) -> rays_in_dielectrics.SmoothFaces:
        """Smooth faces that the facets approximate."""
        return rays_in_dielectrics.group_smooth_faces(self.facets, self.topology.edge_faces)

    @cached_property
    def metal_faces(self) -> Int64[Tensor, " entry"]:
        """Number of the smooth face of conductors, or of the single facet of others; −1 at the end.

        Facets are numbered from 0, and −1 is none.
        """
        face = self.smooth_faces.face
        own = torch.where(self.interfaces[0].conducting, face, len(face) + torch.arange(len(face)))
        return torch.nn.functional.pad(own, (0, 1), value=-1)

    def max_refractive_index(self, number: int) -> float:
        """Return the largest refractive index inside an object; 1 for opaque ones."""
        inside = [solids.permittivity[number] for solids, _ in self.interiors if solids is not None]
        return max([1.0, *(float(refractive_index(e.detach())) for e in inside)])

    @cached_property
    def sharp_edges(self) -> wedge_geometry.Wedges:
        """Sharp edges of conductors."""
        ends = self.vertices[self.topology.edges]
        wedges = wedge_geometry.find_wedges(self.facets.corners, ends, self.topology.edge_faces)
        wedges = wedges.select(self.interfaces[0].conducting[wedges.faces[:, 0]])
        return wedges.select(
            wedge_geometry.select_body_edges(wedges, self.wavelength * _MIN_EDGE_RUN)
        )

    @cached_property
    def edge_pieces(
        self,
    ) -> tuple[wedge_geometry.Wedges, Float64[Tensor, "row 3"], Float64[Tensor, "row 2"]]:
        """Pieces of sharp edges, their middles, and the widths of both faces across each [m]."""
        # Edges end where they pass through surfaces.
        edges, facets = self.sharp_edges, self.facets
        met = edge_crossings.find_crossings(self.occluders, edges, _EDGE_OFFSET * facets.size)
        edges = edge_crossings.split_at_crossings(edges, met, facets.corners)
        pieces = _split_edges(edges, self.wavelength / _SEGMENTS_PER_WAVELENGTH)
        pieces = self.select_open_edges(pieces)
        middle, bodies = (pieces.start + pieces.end) / 2, (facets, self.occluders)
        sides = zip(pieces.faces.unbind(1), pieces.face_tangents.unbind(1), strict=True)
        widths = [face_path_lengths(*bodies, face, middle, inward) for face, inward in sides]
        return pieces, middle, torch.stack(widths, 1)

    def select_open_edges(self, edges: wedge_geometry.Wedges) -> wedge_geometry.Wedges:
        """Select edges with no other surface in their exterior, at their middle."""
        middle, rays = (edges.start + edges.end) / 2, partial(is_visible, self.occluders)
        offset = max(_EDGE_OFFSET * self.facets.size, _MIN_GAP * self.wavelength)
        return edges.select(wedge_geometry.has_open_exterior(edges, middle, offset, rays))

    @property
    def is_smooth_metal(self) -> bool:
        """True if all objects are smooth metal, with fields independent of frequency."""
        first = self.interfaces[0]
        return bool((first.conducting & (first.coherence == 1) & (first.rms_height == 0)).all())

    @property
    def is_closed(self) -> bool:
        """True if all bodies are closed and have too many facets for beam tracing."""
        return len(self.facets.normal) > MAX_FACETS_BEAM_TRACING and bool(self.facets.solid.all())

    def is_unoccluded(self, points: Tensor, directions: Tensor) -> Tensor:
        """Test if rays from points along directions are unobstructed."""
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
    """Trace the far field: scattering amplitudes S of its parts, σ = 4π|S|².

    Phases refer to the world's origin.

    Rows are the receiving, columns the transmitting polarisation, V and H of ``polarisations``. The
    parts are ``order 1``, ``order 2`` and so on, ``edges 1``, ``edges 2``, and for small conductors
    ``rest``, the residual of these parts from the method of moments.

    Args:
        scene: conductors and smooth dielectrics.
        transmitters: unit vectors from the scene to the transmitters.
        receivers: unit vectors from the scene to the receivers; None = monostatic.
        frequencies: frequencies [Hz].
        depth: maximum number of bounces.
        edges: maximum number of diffractions at sharp edges of conductors; 0 omits them and the
            residual.
        tubes_per_wavelength: density of ray tubes at the highest frequency, for scenes of many
            triangles.
        up: unit vector of the vertical axis, in one plane with V.
        boundary: False omits the derivatives due to moving edges of beams.

    Raises:
        InputError: a cloud, a rough surface, derivatives of a scene of many triangles, or of a
            small one with coincident vertices, a dielectric inside or in contact with another
            transmitting one, a conductor in contact with one of many triangles, surfaces of two
            objects in one place.
    """
    with tracing():
        target = _build_target(scene, frequencies, up)
        ends = [transmitters] if receivers is None else [transmitters, receivers]
        viewers = target.occluders.origin + _FAR * target.facets.size * torch.cat(ends)
        refuse_coplanar_surfaces(target.occluders, target.vertices, viewers, list(scene.objects))
        count = len(target.facets.normal)
        if count > MAX_FACETS_BEAM_TRACING and is_differentiated(target.vertices):
            raise InputError(
                f"expected at most {MAX_FACETS_BEAM_TRACING} triangles for derivatives of a "
                f"signature, got {count}: "
                "ray tubes jump at edges; detach the scene, or fit with power paths"
            )
        is_large = count > MAX_FACETS_BEAM_TRACING
        if is_large:
            _check_inner_tubes(target)
        spacing = target.wavelength / tubes_per_wavelength if is_large else None
        pairs = list(zip(ends, reversed(ends), strict=True))
        tracers = [_FarFieldTracer(target, *pair) for pair in pairs]
        with torch_threads(1):  # many small operations between rays
            found = [tracer.trace_parts(depth, edges, spacing, boundary) for tracer in tracers]
        # Reciprocity: mean over both directions, or over both cross-polar terms of one antenna.
        parts = {name: (found[0][name] + found[-1][name].mT) / 2 for name in found[0]}
        residual = None
        if edges > 0 and target.is_smooth_metal:
            residual = _residual_field(target, pairs, torch.stack([*parts.values()]).sum(0))
        _warn_validity(scene, target, tubes_per_wavelength, spacing, residual is not None)
        return parts if residual is None else parts | {"rest": residual}


@dataclass(frozen=True)
class _FarFieldTracer:
    """Traces waves from one set of directions, received in another."""

    target: _FarFieldTarget
    transmitters: Tensor
    receivers: Tensor

    def trace_parts(
        self, depth: int, edges: int, tube_width: float | None, boundary: bool
    ) -> dict[str, Tensor]:
        """Trace all parts of the field."""
        found = self._trace_bounces(depth, tube_width, boundary)
        return found | self._trace_edges(edges) if edges else found

    @property
    def _incident_fields(self) -> Tensor:
        """Incident fields of 1 V/m, V and H, per aspect."""
        return plane_waves.polarisations(self.transmitters, self.target.up)

    def _zero_amplitudes(self) -> Tensor:
        shape = (len(self.target.wave_numbers), len(self.transmitters), 2, 2)
        return torch.zeros(shape, dtype=torch.complex128)

    def _add_received(self, total: Tensor, aspect: Tensor, radiated: Tensor) -> Tensor:
        """Add the components of F along the receiving polarisations to a total."""
        received = plane_waves.polarisations(self.receivers, self.target.up)[aspect]
        return total.index_add(0, aspect, plane_waves.dot(received[:, :, None], radiated[:, None]))

    def _trace_bounces(
        self, depth: int, tube_width: float | None, boundary: bool
    ) -> dict[str, Tensor]:
        """Physical optics of every order, by beams or, with a tube width, by ray tubes."""
        orders = [list(self._zero_amplitudes()) for _ in range(depth)]
        batches = self._trace_beam_orders(depth, boundary)
        if tube_width is not None:
            batches = self._trace_tube_orders(depth, tube_width)
        if tube_width is None or not self.target.is_smooth_metal:
            # Derivatives have a state for each thread.
            for batch in batches:
                self._add_patches(orders, batch)
        else:
            with ThreadPoolExecutor(1) as second:  # adds patches while the next tubes are traced
                last = second.submit(tuple)
                for batch in batches:
                    last.result()
                    last = second.submit(self._add_patches, orders, batch)
                last.result()
        return {f"order {n}": torch.stack(order) for n, order in enumerate(orders, start=1)}

    def _add_patches(self, orders: Sequence[list[Tensor]], batch: _PatchOrders) -> None:
        """Add the fields of patches to the amplitudes of each order and frequency."""
        patch_orders, solids, members = batch
        target = self.target
        currents: list[Tensor] = []
        integrals = [found.phase_integral(self.receivers[found.aspect]) for found in patch_orders]
        for f in members:
            k = target.wave_numbers[f]
            if not (target.is_smooth_metal and currents):
                currents = self._patch_amplitudes(patch_orders, solids, target.interfaces[f], k)
            rows = zip(orders, patch_orders, integrals, currents, strict=False)
            for order, patches, integral, current in rows:
                strength = integral(k) * (-0.5j * k / math.pi if target.is_smooth_metal else 1.0)
                fields = current * strength[:, None, None]
                order[f] = order[f].index_add(0, patches.aspect, fields)

    def _trace_beam_orders(self, depth: int, boundary: bool) -> Iterator[_PatchOrders]:
        """Trace few facets by clipped beams."""
        waves = self.target.facets, -self.transmitters, depth
        for solids, members in self.target.interiors:
            found = beam_tracing.trace_beams(*waves, boundary=boundary, solids=solids)
            yield list(found), solids, members

    def _trace_tube_orders(self, depth: int, tube_width: float) -> Iterator[_PatchOrders]:
        """Trace many facets by ray tubes that start as illuminated triangles."""
        target = self.target
        for first in find_illuminated_triangles(
            target.facets, target.is_unoccluded, -self.transmitters, tube_width
        ):
            bodies = target.facets, target.occluders, target.metal_faces
            outside = [first, *trace_tubes(*bodies, first, tube_width, depth)]
            for solids, members in target.interiors:
                patch_orders = outside
                if solids is not None:
                    bodies = target.smooth_faces, target.occluders, solids
                    patch_orders = rays_in_dielectrics.trace_inner_tubes(
                        *bodies, outside, tube_width, depth
                    )
                yield patch_orders, solids, members

    def _patch_amplitudes(
        self,
        patch_orders: Sequence[IlluminatedPatches],
        solids: dielectric_solids.DielectricSolids | None,
        interfaces: plane_waves.SmoothInterfaces,
        k: float,
    ) -> list[Tensor]:
        """Amplitudes S per m² of all patches, order by order: [row, receive, transmit] each.

        Those of smooth metal are over −jk/2π.
        """
        found: list[Tensor] = []
        powers: list[float] = []
        reflected = transmitted = torch.zeros(0)
        polarisations = plane_waves.polarisations(self.receivers, self.target.up)
        # Fields of smooth metal are real.
        kind = torch.float64 if self.target.is_smooth_metal else torch.complex128
        for patches in patch_orders:
            received = polarisations[patches.aspect]
            if not found:
                field = self._incident_fields.to(kind)[patches.aspect]
            elif solids is None:
                field = reflected[patches.parent]
            else:
                through = patches.transmitted[:, None, None]
                field = torch.where(through, transmitted[patches.parent], reflected[patches.parent])
                field = field * patches.spreading[:, None, None]
            wave = patches.normal, patches.direction, field
            if self.target.is_smooth_metal:
                echo, reflected = plane_waves.scatter_from_metal(*wave, received)
                found.append(echo)
                continue
            receiver, surface_rows = self.receivers[patches.aspect], interfaces.rows(patches.facet)
            if solids is None:
                surface = (surface_rows, k, *wave)
                radiated = plane_waves.radiate_field(*surface, receiver)
                reflected = plane_waves.reflect_field(*surface)
            else:
                powers.append(incident_power(solids, patches, field))
                radiated, reflected, transmitted = scatter_at_interfaces(
                    solids, surface_rows, k, patches, field, receiver
                )
            found.append(plane_waves.dot(received[:, :, None], radiated[:, None]))
        _warn_power_gain(powers)
        return found

    def _trace_edges(self, max_diffractions: int) -> dict[str, Tensor]:
        """Contributions of sharp edges of conductors (PTD)."""
        target = self.target
        found = {"edges 1": self._fringe_amplitudes()}
        several = max_diffractions > 1
        plates = find_plates(target.select_open_edges(target.sharp_edges)) if several else []
        totals = [list(self._zero_amplitudes()) for _ in range(2, max_diffractions + 1)]
        every = torch.arange(len(self.transmitters))
        for f, k in enumerate(target.wave_numbers if plates else ()):
            waves = -self.transmitters, self._incident_fields, self.receivers
            several = trace_multiple_diffractions(
                plates, k, *waves, max_diffractions, target.is_unoccluded
            )
            for total, radiated in zip(totals, several, strict=True):
                total[f] = self._add_received(total[f], every, radiated)
        return found | {f"edges {n}": torch.stack(t) for n, t in enumerate(totals, start=2)}

    def _fringe_amplitudes(self) -> Tensor:
        """First-order fringe currents of the edge pieces that both antennas see."""
        target, total = self.target, list(self._zero_amplitudes())
        wedges, middle, strip_widths = target.edge_pieces
        count, left_out = len(wedges.start), 0
        some = torch.arange(len(self.transmitters))
        for aspects in some.split(max(1, _ROWS_AT_ONCE // max(1, count))) if count else ():
            aspect = aspects.repeat_interleave(count)
            row = torch.arange(count).repeat(len(aspects))
            for antennas in (self.transmitters, self.receivers):
                direction = antennas[aspect]
                pieces = wedges.select(row)
                keep = wedge_geometry.is_outside_wedge(pieces, direction)
                grazing = keep & wedge_geometry.is_grazing_sheet(pieces, direction)
                left_out += int(grazing.sum())
                aspect, row = aspect[keep & ~grazing], row[keep & ~grazing]
            for antennas in (self.transmitters, self.receivers):
                pieces = wedges.select(row)
                outward = (pieces.normals - pieces.face_tangents).sum(1)
                offset = _EDGE_OFFSET * target.facets.size * normalize(outward, dim=1)
                visible = target.is_unoccluded(middle[row] + offset, antennas[aspect])
                aspect, row = aspect[visible], row[visible]
                if antennas is self.receivers:
                    break
            pieces = wedges.select(row)
            d, s = -self.transmitters[aspect], self.receivers[aspect]
            centre, side = middle[row], pieces.end - pieces.start
            field, widths = self._incident_fields[aspect], strip_widths[row]
            for f, k in enumerate(target.wave_numbers):
                radiated = wedge_geometry.fringe_field(pieces, k, d, field, s, widths)
                wave = k * (s - d)
                width = plane_waves.parallelogram_integral(wave, side, torch.zeros_like(side))
                scale = plane_waves.phasor(plane_waves.dot(wave, centre)) * width * side.norm(dim=1)
                total[f] = self._add_received(total[f], aspect, radiated * scale[:, None, None])
        if left_out:
            warnings.warn(
                f"edges of sheets within {math.degrees(wedge_geometry.MIN_EDGE_ANGLE):.0f}° of "
                "grazing are left out: their fringe currents are not valid there, and physical "
                "optics is not either",
                PhysicsWarning,
                stacklevel=2,
            )
        return torch.stack(total)


def _check_inner_tubes(target: _FarFieldTarget) -> None:
    """Raise an error for scenes that ray tubes inside solids do not support."""
    for solids, _ in target.interiors:
        if solids is None:
            continue
        if is_differentiated(solids.permittivity):
            names = [solids.names[int(n)] for n in solids.owner[solids.transparent].unique()]
            raise InputError(
                f"expected permittivities of {', '.join(names)} without derivatives in a scene of "
                f"more than {MAX_FACETS_BEAM_TRACING} triangles, got some that require grad: ray "
                "tubes inside are discontinuous at edges; detach them, use fewer triangles, or an "
                "open mesh, of which only the front face reflects"
            )
        rays_in_dielectrics.require_separate_conductors(target.facets, solids)


def _residual_field(
    target: _FarFieldTarget, antenna_pairs: Sequence[tuple[Tensor, Tensor]], modelled: Tensor
) -> Tensor | None:
    """Residual of rays and edges from the method of moments; zero where currents are not solved."""
    efie = EFIESolver(target.vertices, target.topology.faces, target.facets.solid, target.up)
    corners = target.facets.corners.detach()
    # Triangles resolve tips and slender parts better than finer cells do.
    cells, finer_cells = MFIESolver(corners, target.up), MFIESolver(corners, target.up, range(1, 5))
    solvers = [cells, efie, finer_cells] if target.is_closed else [efie]
    rest: dict[int, Tensor] = {}
    order = sorted(range(len(modelled)), key=lambda f: -target.wave_numbers[f])
    for f in track(order, "frequencies"):
        refusals: list[Refusal] = []
        for solver in solvers:
            found = solver.solve_scattering(target.wave_numbers[f], antenna_pairs)
            if not isinstance(found, Refusal):
                rest[f] = (found[0] + found[-1].mT) / 2 - modelled[f]
                break
            refusals.append(found)
        else:
            warn_not_solved(target.wave_numbers[f], refusals)
    if not rest:
        return None
    return torch.stack([rest.get(f, torch.zeros_like(modelled[f])) for f in range(len(modelled))])


def _split_edges(wedges: wedge_geometry.Wedges, max_length: float) -> wedge_geometry.Wedges:
    """Split edges into equal pieces no longer than a length."""
    side = wedges.end - wedges.start
    pieces = (side.detach().norm(dim=1) / max_length).ceil().long().clamp_min(1)
    row = torch.repeat_interleave(pieces)
    number = torch.arange(len(row)) - (pieces.cumsum(0) - pieces)[row]
    rows = wedges.select(row)
    low, high = (number / pieces[row])[:, None], ((number + 1) / pieces[row])[:, None]
    ends = rows.start + low * side[row], rows.start + high * side[row]
    return replace(rows, start=ends[0], end=ends[1])


def _build_target(scene: Scene, frequencies: Tensor, up: Tensor) -> _FarFieldTarget:
    topology, vertices = connect_surfaces(scene)
    facets = beam_tracing.build_facets(vertices, topology)
    occluders = Occluders(vertices, topology, vertices.detach().mean(0))
    tables = [_smooth_interfaces(scene, frequency) for frequency in frequencies.tolist()]
    wave_numbers = [2 * math.pi * f / SPEED_OF_LIGHT for f in frequencies.tolist()]
    owner, names = topology.face_object, list(scene.objects)
    dielectric_solids.require_whole_solids(tables[0], topology.panels, owner, names)
    bodies = facets.corners, facets.solid, owner, names
    solids = dielectric_solids.group_solids(tables, wave_numbers, *bodies)
    return _FarFieldTarget(facets, topology, vertices, occluders, tables, wave_numbers, up, solids)


def _smooth_interfaces(scene: Scene, frequency: float) -> plane_waves.SmoothInterfaces:
    """Smooth interfaces of all triangles."""
    rows = list[list[Tensor]]()
    for name, item in scene.objects.items():
        interface = item.material.smooth_interface(frequency)
        if interface is None:
            raise InputError(
                f"expected smooth surfaces in a signature, got {type(item.material).__name__} for "
                f"{name}; give a PerfectConductor, RoughConductor, Dielectric, RefractingBody or "
                "Slab"
            )
        conducting = torch.tensor(interface.permittivity is None)
        epsilon = torch.ones(()) if interface.permittivity is None else interface.permittivity
        values = (conducting, epsilon.to(torch.complex128), *interface[1:4])
        rows.append([value.expand(len(item.mesh.faces)) for value in values])
    return plane_waves.SmoothInterfaces(*map(torch.cat, zip(*rows, strict=True)))


def _warn_power_gain(powers: Sequence[float]) -> None:
    """Warn about orders of dielectric solids with more incident power than the order before."""
    for n, (before, after) in enumerate(itertools.pairwise(powers), start=2):
        if after > _MAX_POWER_GAIN * before:
            gain = f"{after / before:.3g} times the incident power of order {n - 1}"
            text = f"order {n} has {gain}: tubes in a dielectric solid gain energy; mesh it finer"
            warnings.warn(text, PhysicsWarning, stacklevel=2)


def _warn_validity(
    scene: Scene, target: _FarFieldTarget, density: float, spacing: float | None, has_residual: bool
) -> None:
    """Issue warnings where the model is outside its range of validity."""
    found: list[str] = []
    if spacing is not None and density < 1:
        found.append(f"{density:g} tubes per wavelength are too few: use 1 or more, better 4")
    faces = target.topology.face_object
    neighbours = target.topology.edge_faces[:, :2]
    # An open edge has one normal.
    neighbours = torch.where(neighbours >= 0, neighbours, neighbours[:, :1])
    normal = target.facets.normal.detach()
    half_chord = 0.5 * (normal[neighbours[:, 0]] - normal[neighbours[:, 1]]).norm(dim=1)
    angle = 2 * torch.asin(half_chord.clamp_max(1))
    ends = target.vertices.detach()[target.topology.edges]
    # A triangle of side ℓ with angles α to its neighbours is ℓα/√12 off the curved surface.
    sagittas = (ends[:, 1] - ends[:, 0]).norm(dim=1) * angle / math.sqrt(12)
    smooth = (angle > _MIN_TURN_ANGLE) & (angle < rays_in_dielectrics.MAX_SMOOTH_ANGLE)
    for number, name in enumerate(scene.objects):
        own = faces == number
        points = target.facets.corners.detach()[own].reshape(-1, 3)
        size = float((points.amax(0) - points.amin(0)).norm())
        if size < target.wavelength and not has_residual:
            found.append(
                f"{name} is {size / target.wavelength:.2g} wavelengths large: physical optics is "
                "for objects of several"
            )
        mine = smooth & own[neighbours[:, 0]]
        # Wavelengths inside are shorter.
        index = target.max_refractive_index(number)
        sagitta = float(sagittas[mine].median()) / target.wavelength if bool(mine.any()) else 0.0
        if sagitta * index > _MAX_SAGITTA:
            found.append(
                f"the facets of {name} are {sagitta * index:.2g} wavelengths off the curved "
                "surface, more than 1/50: use a finer mesh"
            )
        is_mixed = not dielectric_solids.is_homogeneous(target.interfaces[0].rows(own))
        if bool(target.facets.solid[own].all()) and is_mixed:
            found.append(
                f"{name} is closed and its permittivity differs between triangles: only "
                "its front face reflects"
            )
    for text in found:
        warnings.warn(text, PhysicsWarning, stacklevel=3)
