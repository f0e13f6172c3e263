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

from invertwin.channel.beams.beam_tracing import FEW, Bounce, Facets, beams, facets_of
from invertwin.channel.em.dielectric_solids import Solids, homogeneous, interiors
from invertwin.channel.em.plane_waves import (
    Skins,
    dot,
    parallelogram_integral,
    polarisations,
    radiated,
    reflected,
)
from invertwin.channel.em.wedges import (
    LEAST_ANGLE,
    Wedges,
    find_wedges,
    fringe_field,
    grazes,
    outside,
    run_on,
)
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.ray_scene import Occluders, visible
from invertwin.channel.rays.topology import Topology, topology_of
from invertwin.channel.rcs.dielectric_interfaces import at_surface
from invertwin.channel.rcs.moments.efie_solver import SolvedMeshes
from invertwin.channel.rcs.moments.mfie import SolvedBodies
from invertwin.channel.rcs.plate_diffraction import plates_of, several_diffractions
from invertwin.channel.rcs.rays_in_dielectrics import (
    SMOOTH,
    Curved,
    curved,
    require_apart,
    with_inner,
)
from invertwin.channel.rcs.shooting_bouncing_rays import lit_triangles, tubes
from invertwin.checks import differentiated
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError, PhysicsWarning
from invertwin.runtime.progress import told
from invertwin.scene.material.fresnel import refractive_index
from invertwin.scene.scene import Scene

_SAGITTA = 1 / 50  # wavelengths that a facet may be off the curved surface
_FLAT = 1e-6  # rad that normals turn from facet to facet where a surface is curved
_SEGMENTS = 2.0  # of an edge per wavelength; each is seen or not
_LEAST_LINE = 2.0  # wavelengths that an edge which ends in a smooth surface runs on at least
_OFF = 1e-5  # of the scene's size: how far aside of an edge rays to it end
_ROWS_AT_ONCE = 1 << 18

_Chain = tuple[Sequence[Bounce], Solids | None, Sequence[int]]
"""Patches of all orders, what waves enter, and numbers of the frequencies of which that holds."""


@dataclass(frozen=True)
class _Body:
    """A scene as the laws of waves see it.

    Attributes:
        facets: its triangles.
        topology: its edges.
        vertices: [m].
        occluders: what rays meet.
        skins: of the triangles, for each frequency.
        wave_numbers: k of the frequencies [1/m].
        up: direction of V.
        interiors: groups of frequencies, and what waves enter there.
    """

    facets: Facets
    topology: Topology
    vertices: Float64[Tensor, "v 3"]
    occluders: Occluders
    skins: Sequence[Skins]
    wave_numbers: Sequence[float]
    up: Float64[Tensor, "3"]
    interiors: Sequence[tuple[Solids | None, Sequence[int]]]

    @property
    def wavelength(self) -> float:
        """The shortest [m]."""
        return 2 * math.pi / max(self.wave_numbers)

    @cached_property
    def curved(self) -> Curved:
        """The facets as pieces of smooth faces."""
        return curved(self.facets, self.topology.beside)

    def index(self, number: int) -> float:
        """The largest refractive index of waves inside an object; 1 where none enter."""
        inside = [solids.permittivity[number] for solids, _ in self.interiors if solids is not None]
        return max([1.0, *(float(refractive_index(e.detach())) for e in inside)])

    @property
    def plain(self) -> bool:
        """Whether all is smooth metal, of which fields do not depend on the frequency."""
        first = self.skins[0]
        smooth = (first.coherent == 1) & (first.rms_height == 0)
        return bool((first.conducting & smooth).all())

    @property
    def closed(self) -> bool:
        """Whether all is closed bodies, which have too many facets for beams."""
        return len(self.facets.normal) > FEW and bool(self.facets.solid.all())

    def clear(self, points: Tensor, directions: Tensor) -> Tensor:
        """Whether nothing lies between points and the far end of directions."""
        return visible(self.occluders, points, points + 3 * self.facets.size * directions)


def trace_signature(
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
        body = _body(scene, frequencies, up)
        count = len(body.facets.normal)
        if count > FEW and differentiated(body.vertices):
            raise InputError(
                f"expected at most {FEW} triangles for derivatives of a signature, got {count}: "
                "ray tubes jump at edges; detach the scene, or fit with power paths"
            )
        if count > FEW:
            _check_inner(body)
        spacing = None if count <= FEW else body.wavelength / tubes_per_wavelength
        ways = [(transmitters, transmitters if receivers is None else receivers)]
        if receivers is not None:
            ways.append((receivers, transmitters))
        found = [_View(body, *way).parts(depth, edges, spacing, boundary) for way in ways]
        # The mean of both ways between two antennas, or between polarisations of one.
        parts = {name: (found[0][name] + found[-1][name].mT) / 2 for name in found[0]}
        solved = edges > 0 and body.plain
        rest = _rest(body, ways, torch.stack([*parts.values()]).sum(0)) if solved else None
        _warn(scene, body, tubes_per_wavelength, spacing, rest is not None)
        return parts if rest is None else parts | {"rest": rest}


@dataclass(frozen=True)
class _View:
    """Waves from one set of directions, received in another."""

    body: _Body
    transmitters: Tensor
    receivers: Tensor

    def parts(
        self, depth: int, edges: int, spacing: float | None, boundary: bool
    ) -> dict[str, Tensor]:
        """All parts of the field."""
        found = self._bounces(depth, spacing, boundary)
        return found | self._diffracted(edges) if edges else found

    @property
    def _sent(self) -> Tensor:
        """Incident fields of 1 V/m, V and H, of every aspect."""
        return polarisations(self.transmitters, self.body.up)

    def _none(self) -> Tensor:
        shape = (len(self.body.wave_numbers), len(self.transmitters), 2, 2)
        return torch.zeros(shape, dtype=torch.complex128)

    def _received(self, total: Tensor, aspect: Tensor, sent: Tensor) -> Tensor:
        """A total with the parts of F that the receiving polarisations see added."""
        seen = polarisations(self.receivers, self.body.up)[aspect]
        return total.index_add(0, aspect, dot(seen[:, :, None], sent[:, None]))

    def _bounces(self, depth: int, spacing: float | None, boundary: bool) -> dict[str, Tensor]:
        """Physical optics of every order: of beams, or of tubes where a spacing is given."""
        orders = [list(self._none()) for _ in range(depth)]
        chains = self._beams(depth, boundary) if spacing is None else self._tubes(depth, spacing)
        for chain, solids, members in chains:
            self._add(orders, chain, solids, members)
        return {f"order {n}": torch.stack(order) for n, order in enumerate(orders, start=1)}

    def _add(
        self,
        orders: list[list[Tensor]],
        chain: Sequence[Bounce],
        solids: Solids | None,
        members: Sequence[int],
    ) -> None:
        """Add what all patches send to the fields of their orders, at some frequencies."""
        body = self.body
        currents: list[Tensor] = []
        integrals = [bounce.integral(self.receivers[bounce.aspect]) for bounce in chain]
        for f in members:
            k = body.wave_numbers[f]
            if not (body.plain and currents):
                currents = self._currents(chain, solids, body.skins[f], 1.0 if body.plain else k)
            rows = zip(orders, chain, integrals, currents, strict=False)
            for order, bounce, integral, current in rows:
                strength = integral(k) * (k if body.plain else 1.0)
                sent = current * strength[:, None, None]
                order[f] = order[f].index_add(0, bounce.aspect, sent)

    def _beams(self, depth: int, boundary: bool) -> Iterator[_Chain]:
        """Few facets: clipped beams."""
        facets, incident = self.body.facets, -self.transmitters
        for solids, members in self.body.interiors:
            found = beams(facets, incident, depth, boundary=boundary, solids=solids)
            yield list(found), solids, members

    def _tubes(self, depth: int, spacing: float) -> Iterator[_Chain]:
        """Many facets: tubes that begin as lit triangles."""
        body = self.body
        for lit in lit_triangles(body.facets, body.clear, -self.transmitters, spacing):
            outside = [lit, *tubes(body.facets, body.occluders, lit, spacing, depth)]
            for solids, members in body.interiors:
                chain = outside
                if solids is not None:
                    chain = with_inner(body.curved, body.occluders, solids, outside, spacing, depth)
                yield chain, solids, members

    def _currents(
        self, chain: Sequence[Bounce], solids: Solids | None, skins: Skins, k: float
    ) -> list[Tensor]:
        """S per m² of all patches, order by order: [row, receive, transmit] each."""
        found: list[Tensor] = []
        again = passed = torch.zeros(0)
        for bounce in chain:
            if not found:
                field = self._sent.to(torch.complex128)[bounce.aspect]
            elif solids is None:
                field = again[bounce.before]
            else:
                through = bounce.passed[:, None, None]
                field = torch.where(through, passed[bounce.before], again[bounce.before])
                field = field * bounce.spread[:, None, None]
            towards, own = self.receivers[bounce.aspect], skins.rows(bounce.facet)
            if solids is None:
                surface = (own, k, bounce.normal, bounce.direction, field)
                sent, again = radiated(*surface, towards), reflected(*surface)
            else:
                sent, again, passed = at_surface(solids, own, k, bounce, field, towards)
            seen = polarisations(self.receivers, self.body.up)[bounce.aspect]
            found.append(dot(seen[:, :, None], sent[:, None]))
        return found

    def _diffracted(self, most: int) -> dict[str, Tensor]:
        """What sharp edges of conductors add to physical optics."""
        body = self.body
        topology = body.topology
        ends = body.vertices[topology.edges]
        wedges = find_wedges(body.facets.corners, ends, topology.beside)
        wedges = wedges.rows(body.skins[0].conducting[wedges.faces[:, 0]])
        wedges = wedges.rows(run_on(wedges, body.wavelength * _LEAST_LINE))
        found = {"edges 1": self._once(wedges)}
        plates = plates_of(wedges) if most > 1 else []
        totals = [list(self._none()) for _ in range(2, most + 1)]
        every = torch.arange(len(self.transmitters))
        for f, k in enumerate(body.wave_numbers if plates else ()):
            several = several_diffractions(
                plates, k, -self.transmitters, self._sent, self.receivers, most, body.clear
            )
            for total, sent in zip(totals, several, strict=True):
                total[f] = self._received(total[f], every, sent)
        return found | {f"edges {n}": torch.stack(t) for n, t in enumerate(totals, start=2)}

    def _once(self, wedges: Wedges) -> Tensor:
        """First-order fringe currents of the parts of edges that both antennas see."""
        body, total = self.body, list(self._none())
        wedges = _segments(wedges, body.wavelength / _SEGMENTS)
        count = len(wedges.start)
        left_out = 0
        some = torch.arange(len(self.transmitters))
        for aspects in some.split(max(1, _ROWS_AT_ONCE // max(1, count))) if count else ():
            aspect = aspects.repeat_interleave(count)
            row = torch.arange(count).repeat(len(aspects))
            for way in (self.transmitters, self.receivers):
                direction = way[aspect]
                at = wedges.rows(row)
                keep = outside(at, direction)
                flat = keep & grazes(at, direction)
                left_out += int(flat.sum())
                aspect, row = aspect[keep & ~flat], row[keep & ~flat]
            for way in (self.transmitters, self.receivers):
                at = wedges.rows(row)
                aside = (at.normals - at.inwards).sum(1)
                middle = (at.start + at.end) / 2
                middle = middle + _OFF * body.facets.size * normalize(aside, dim=1)
                seen = body.clear(middle, way[aspect])
                aspect, row = aspect[seen], row[seen]
                if way is self.receivers:
                    break
            at = wedges.rows(row)
            d, s = -self.transmitters[aspect], self.receivers[aspect]
            middle, side = (at.start + at.end) / 2, at.end - at.start
            for f, k in enumerate(body.wave_numbers):
                sent = fringe_field(at, k, d, self._sent[aspect], s)
                wave = k * (s - d)
                width = parallelogram_integral(wave, side, torch.zeros_like(side))
                turn = dot(wave, middle)
                scale = torch.polar(torch.ones_like(turn), turn) * width * side.norm(dim=1)
                total[f] = self._received(total[f], aspect, sent * scale[:, None, None])
        if left_out:
            warnings.warn(
                f"edges of sheets within {math.degrees(LEAST_ANGLE):.0f}° of grazing are left out: "
                "their fringe currents are not valid there, and physical optics is not either",
                PhysicsWarning,
                stacklevel=2,
            )
        return torch.stack(total)


def _check_inner(body: _Body) -> None:
    """Refuse what tubes inside of solids cannot do."""
    for solids, _ in body.interiors:
        if solids is None:
            continue
        if differentiated(solids.permittivity):
            names = [solids.names[int(n)] for n in solids.owner[solids.clear].unique()]
            raise InputError(
                f"expected permittivities of {', '.join(names)} without derivatives in a scene of "
                f"more than {FEW} triangles, got some that require grad: ray tubes inside jump at "
                "edges; detach them, use fewer triangles, or an open mesh, which shows its front "
                "alone"
            )
        require_apart(body.facets, solids)


def _rest(body: _Body, ways: Sequence[tuple[Tensor, Tensor]], known: Tensor) -> Tensor | None:
    """What bounces and edges leave out of the fields of small targets; of larger ones zero."""
    meshes = SolvedMeshes(body.vertices, body.topology.faces, body.facets.solid, body.up)
    cells = SolvedBodies(body.facets.corners.detach(), body.up) if body.closed else None
    rest: dict[int, Tensor] = {}
    downwards = sorted(range(len(known)), key=lambda f: -body.wave_numbers[f])
    for f in told(downwards, "frequencies"):
        k = body.wave_numbers[f]
        solver = cells if cells is not None and cells.serves(k) else meshes
        found = solver.scattered(k, ways)
        if found is not None:
            rest[f] = (found[0] + found[-1].mT) / 2 - known[f]
    if not rest:
        return None
    return torch.stack([rest.get(f, torch.zeros_like(known[f])) for f in range(len(known))])


def _segments(wedges: Wedges, longest: float) -> Wedges:
    """Edges in equal pieces no longer than a length."""
    side = wedges.end - wedges.start
    pieces = (side.detach().norm(dim=1) / longest).ceil().long().clamp_min(1)
    row = torch.repeat_interleave(pieces)
    number = torch.arange(len(row)) - (pieces.cumsum(0) - pieces)[row]
    cut = wedges.rows(row)
    low, high = (number / pieces[row])[:, None], ((number + 1) / pieces[row])[:, None]
    columns = vars(cut) | {
        "start": cut.start + low * side[row],
        "end": cut.start + high * side[row],
    }
    return Wedges(**columns)


def _body(scene: Scene, frequencies: Tensor, up: Tensor) -> _Body:
    objects = scene.objects
    clouds = [name for name, item in objects.items() if item.cloud is not None]
    if clouds:
        raise InputError(
            f"expected objects with surfaces, got clouds for {', '.join(clouds)}; mesh them"
        )
    vertices = torch.cat([item.vertices for item in objects.values()])
    topology = topology_of([item.mesh for item in objects.values()])
    facets = facets_of(vertices, topology)
    occluders = Occluders(vertices, topology, vertices.detach().mean(0))
    skins = [_skins(scene, topology, frequency) for frequency in frequencies.tolist()]
    wave_numbers = [2 * math.pi * f / SPEED_OF_LIGHT for f in frequencies.tolist()]
    owner, names = topology.face_object, list(objects)
    entered = interiors(skins, wave_numbers, facets.corners, facets.solid, owner, names)
    return _Body(facets, topology, vertices, occluders, skins, wave_numbers, up, entered)


def _skins(scene: Scene, topology: Topology, frequency: float) -> Skins:
    """The skins of all triangles."""
    columns: list[list[Tensor]] = [[] for _ in Skins._fields]
    for name, item in scene.objects.items():
        skin = item.material.skin(frequency)
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
    return Skins(*map(torch.cat, columns))


def _warn(scene: Scene, body: _Body, density: float, spacing: float | None, solved: bool) -> None:
    """Say where the physics ends."""
    found: list[str] = []
    if spacing is not None and density < 1:
        found.append(f"{density:g} tubes per wavelength are too few: use 1 or more, better 4")
    faces = body.topology.face_object
    both = torch.nn.functional.pad(body.topology.beside, (0, 1), value=-1)[:, :2]
    both = torch.where(both >= 0, both, both[:, :1])  # an open edge does not turn
    normal = body.facets.normal.detach()
    turn = 2 * torch.asin(
        (0.5 * (normal[both[:, 0]] - normal[both[:, 1]]).norm(dim=1)).clamp_max(1)
    )
    ends = body.vertices.detach()[body.topology.edges]
    # A triangle of side ℓ whose neighbours turn by α is ℓα/√12 off the curved surface.
    off = (ends[:, 1] - ends[:, 0]).norm(dim=1) * turn / math.sqrt(12)
    smooth = (turn > _FLAT) & (turn < SMOOTH)
    for number, name in enumerate(scene.objects):
        own = faces == number
        points = body.facets.corners.detach()[own].reshape(-1, 3)
        size = float((points.amax(0) - points.amin(0)).norm())
        if size < body.wavelength and not solved:
            found.append(
                f"{name} is {size / body.wavelength:.2g} wavelengths large: physical optics is for "
                "objects of several"
            )
        mine = smooth & own[both[:, 0]]
        # Inside, waves are shorter.
        shorter = body.index(number)
        sagitta = float(off[mine].median()) / body.wavelength if bool(mine.any()) else 0.0
        if sagitta * shorter > _SAGITTA:
            found.append(
                f"the facets of {name} are {sagitta * shorter:.2g} wavelengths off the curved "
                "surface, more than 1/50: use a finer mesh"
            )
        mixed = body.facets.solid[own].all() and not homogeneous(body.skins[0].rows(own))
        if bool(mixed):
            found.append(
                f"{name} is closed and its permittivity differs between triangles: it shows its "
                "front alone"
            )
    for text in found:
        warnings.warn(text, PhysicsWarning, stacklevel=3)
