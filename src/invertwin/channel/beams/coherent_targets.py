"""Coherent targets: few flat conductors whose bounces add coherently, among rough objects.

A target is one object, such as a corner reflector. The fields of its reflected paths add
coherently, and a map shows their power. Two targets, or a target and a rough surface, add in power:
their relative phases change within half a wavelength, which a power map should not resolve.
"""

import math
from collections.abc import Callable, Collection

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.channel.beams.facet_paths import trace_facet_paths
from invertwin.channel.beams.partial_visibility import PanelCells, visible_fractions
from invertwin.channel.em.plane_waves import cross, orthogonal_unit_vectors
from invertwin.channel.paths import Link, Paths, concatenate_paths, make_paths
from invertwin.channel.sampling import Sampling
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.scene.material.fresnel import safe_root
from invertwin.scene.material.materials import RoughDielectric
from invertwin.scene.scene import Scene

_Points = Float64[Tensor, "v 3"]
CoherenceFunction = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Interference of two echoes, from 0 to 1, by their differences in range [m], u and v."""

_ABSORBER = RoughDielectric(1.0)
_CELLS_PER_SIDE = 12  # cells along each side of the outline's rectangle


def as_absorbers(scene: Scene, names: Collection[str]) -> Scene:
    """Replace objects by absorbers, which occlude and do not scatter.

    Args:
        scene: scene with the objects.
        names: names of the objects to replace.
    """
    for name in names:
        scene = scene.replace(name, material=_ABSORBER)
    return scene


def trace_target(
    scene: Scene, name: str, link: Link, *, sampling: Sampling, stretch: float = 1.0
) -> Paths:
    """Trace field paths of one target, weighted by its visibility past the rest of the scene.

    Where another object occludes a target, its fields are weighted by the illuminated fraction of
    its outline's rectangle, the geometric mean over transmitter and receiver. Clouds occlude
    nothing. There are no paths between a target and other objects.

    Args:
        scene: scene with the target and its occluders.
        name: name of the target, a smooth conductor of at most 24 triangles.
        link: antennas, per frame.
        sampling: sampling options, of which ``depth`` and ``boundary`` are used.
        stretch: factor of the wavelength, see ``trace_facet_paths``.

    Raises:
        InputError: a target that ``trace_facet_paths`` refuses, or sheets and refracting bodies
            elsewhere in the scene, since these occlude a target only in part.
    """
    boundary = sampling.boundary
    alone = Scene({name: scene[name]})
    paths = trace_facet_paths(alone, link, sampling.depth, stretch=stretch, boundary=boundary)
    others = {n: o for n, o in scene.objects.items() if n != name and o.cloud is None}
    if not others:
        return paths
    other_scene = Scene(others)
    _require_opaque(other_scene, name, link)
    points = scene[name].vertices
    fraction = _visible_shares(other_scene, points, link.tx, boundary=boundary)
    if not link.shared_visibility:
        both = fraction * _visible_shares(other_scene, points, link.rx, boundary=boundary)
        fraction = safe_root(both, 0.0)
    return paths.scale_fields(fraction[paths.frame])


def _require_opaque(others: Scene, target: str, link: Link) -> None:
    for name, item in others.objects.items():
        surface = item.material.scattering_law(SPEED_OF_LIGHT / link.wavelength)
        if bool(surface.transmittance.any()) or bool(surface.refraction.any()):
            raise InputError(
                f"expected opaque objects beside the coherent target {target!r}, got {name!r}, "
                "which transmits waves; leave it out, or fit the target without it"
            )


def _visible_shares(
    others: Scene, points: _Points, antennas: Float64[Tensor, "place 3"], *, boundary: bool
) -> Float64[Tensor, " place"]:
    """Fraction of a target's outline visible from each antenna past other objects."""
    found = []
    for place in antennas:
        cells = _outline_cells(points, place)
        found.append(visible_fractions(others, place[None], cells, boundary=boundary).mean())
    return torch.stack(found)


def _outline_cells(points: _Points, antenna: Float64[Tensor, "3"]) -> PanelCells:
    """Cells of the bounding rectangle of points seen from an antenna, at their nearest depth."""
    centre = points.mean(0)
    normal = torch.nn.functional.normalize(antenna - centre, dim=0)
    aside = orthogonal_unit_vectors(normal)
    axes = torch.stack([normal, aside, cross(normal, aside)], 1)
    local = (points - centre) @ axes
    low, high = local.amin(0), local.amax(0)
    center = centre + axes @ torch.cat([high[:1], 0.5 * (low + high)[1:]])
    size = (high - low).detach()[1:] / _CELLS_PER_SIDE
    steps = torch.arange(_CELLS_PER_SIDE, dtype=torch.float64) - 0.5 * (_CELLS_PER_SIDE - 1)
    offsets = torch.cartesian_prod(steps, steps) * size
    return PanelCells(center, axes, offsets, (float(size[0]), float(size[1])))


def combine_coherently(
    paths: Paths, link: Link, coherence: CoherenceFunction, *, stretch: float = 1.0
) -> Paths:
    """Convert coherent field paths to power paths: power of each, and interference of each two.

    ``|Σ aᵢ exp(−jkLᵢ)|² = Σᵢ |aᵢ|² + Σ_{i<j} 2 Re(aᵢ aⱼ* exp(−jk(Lᵢ − Lⱼ)))``. Interference lies
    midway between the two echoes. Two echoes h(R − Rᵢ) and h(R − Rⱼ) with a point spread h² overlap
    there by h²((Rᵢ − Rⱼ)/2), likewise over u and v: exactly for Gaussians, at the midpoint for any.
    Echoes in one cell therefore add in field, and those of different cells in power.

    Args:
        paths: field paths of one target.
        link: antennas of the paths.
        coherence: overlap as a function of differences in range [m], u and v.
        stretch: wavelength of phases over that of the antennas, see ``trace_facet_paths``.

    Source: derivations §13.
    Differs from the source: phases between paths are kept, so that orders add constructively only
    where they are in phase.
    """
    phase = -2j * math.pi * SPEED_OF_LIGHT / (stretch * link.wavelength) * paths.delay
    field = paths.coefficient * torch.exp(phase)
    frames = [torch.nonzero(paths.frame == frame)[:, 0] for frame in range(link.frame_count)]
    pairs = [rows[torch.triu_indices(len(rows), len(rows), 1)] for rows in frames]
    one, other = torch.cat(pairs, 1)
    coordinates = torch.cat([paths.range[:, None], paths.direction_cosines(link)], 1)
    overlap = coherence(*(coordinates[one] - coordinates[other]).unbind(1))
    cross_power = 2 * (field[one] * field[other].conj()).real * overlap
    rows = torch.arange(len(field))
    incoherent = _midway_power_paths(paths, rows, rows, field.abs().square())
    return concatenate_paths([incoherent, _midway_power_paths(paths, one, other, cross_power)])


def _midway_power_paths(paths: Paths, one: Tensor, other: Tensor, power: Tensor) -> Paths:
    """Power paths midway between two field paths."""

    def midpoint(values: Tensor) -> Tensor:
        return 0.5 * (values[one] + values[other])

    middle = (midpoint(column) for column in (paths.delay, paths.first, paths.last))
    return make_paths(paths.frame[one], *middle, kind="power", power=power)
