"""Coherent targets: few flat conductors whose bounces add in field, among things that are rough.

A target is one object, such as a corner reflector. Its chains of mirrors add in field, and their
power is what a map shows. Two targets, or a target and a rough surface, add in power: their phases
change with every half wavelength, and no map of powers should.
"""

import math
from collections.abc import Callable, Collection

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.channel.beams.facet_paths import trace_facet_paths
from invertwin.channel.beams.partial_visibility import PanelCells, visible_fractions
from invertwin.channel.em.plane_waves import cross, orthogonal_unit_vectors
from invertwin.channel.paths import Link, Paths, concatenate_paths
from invertwin.channel.sampling import Sampling
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.scene.material.materials import RoughDielectric
from invertwin.scene.scene import Scene

CoherenceFunction = Callable[[Tensor, Tensor, Tensor], Tensor]
"""How much two echoes interfere whose ranges [m], u and v differ so much; 1 where they do not."""

_ABSORBER = RoughDielectric(1.0)
_CELLS_PER_SIDE = 12  # along each side of what is tried for shadows


def as_absorbers(scene: Scene, names: Collection[str]) -> Scene:
    """The scene with some objects that hide what is behind them and send nothing back.

    Args:
        scene: Its objects.
        names: Of those without an echo.
    """
    for name in names:
        scene = scene.replace(name, material=_ABSORBER)
    return scene


def trace_target(
    scene: Scene, name: str, link: Link, *, sampling: Sampling, stretch: float = 1.0
) -> Paths:
    """Field paths of one target alone, as far as the rest of the scene lets antennas see it.

    Where something else stands before a target, its fields are weighted by the share of its
    outline's rectangle that is lit, the geometric mean of both ways. Clouds hide nothing. There
    are no chains between a target and other objects.

    Args:
        scene: The target, and what may hide it.
        name: Of the target, of at most 24 triangles of a smooth conductor.
        link: Antennas, per frame.
        sampling: Its ``depth`` and ``boundary`` count.
        stretch: See ``trace_facet_paths``.

    Raises:
        InputError: A target that ``trace_facet_paths`` refuses, or sheets and refracting bodies
            elsewhere in the scene, since these hide a target in part only.
    """
    boundary = sampling.boundary
    paths = trace_facet_paths(
        Scene({name: scene[name]}), link, sampling.depth, stretch=stretch, boundary=boundary
    )
    others = {n: o for n, o in scene.objects.items() if n != name and o.cloud is None}
    if not others:
        return paths
    rest = Scene(others)
    _require_opaque(rest, name, link)
    points = scene[name].vertices
    lit = _visible_shares(rest, points, link.tx, boundary=boundary)
    if not link.shared_visibility:
        both = lit * _visible_shares(rest, points, link.rx, boundary=boundary)
        # A root of zero has no derivative.
        seen = both > 0
        lit = torch.where(seen, torch.where(seen, both, 1.0).sqrt(), 0.0)
    return paths.scale_fields(lit[paths.frame])


def _require_opaque(others: Scene, target: str, link: Link) -> None:
    for name, item in others.objects.items():
        surface = item.material.scattering_law(SPEED_OF_LIGHT / link.wavelength)
        if bool(surface.transmittance.any()) or bool(surface.refraction.any()):
            raise InputError(
                f"expected opaque objects beside the coherent target {target!r}, got {name!r}, "
                "which lets waves through; leave it out, or fit the target without it"
            )


def _visible_shares(
    others: Scene,
    points: Float64[Tensor, "v 3"],
    antennas: Float64[Tensor, "place 3"],
    *,
    boundary: bool,
) -> Float64[Tensor, " place"]:
    """The share of a target's outline that each place sees past other objects."""
    return torch.stack(
        [
            visible_fractions(
                others, place[None], _outline_cells(points, place), boundary=boundary
            ).mean()
            for place in antennas
        ]
    )


def _outline_cells(points: Float64[Tensor, "v 3"], antenna: Float64[Tensor, "3"]) -> PanelCells:
    """Cells of the rectangle about points as a place sees them, where the foremost of them is."""
    middle = points.mean(0)
    normal = torch.nn.functional.normalize(antenna - middle, dim=0)
    right = orthogonal_unit_vectors(normal)
    axes = torch.stack([right, cross(normal, right), normal], 1)
    local = (points - middle) @ axes
    low, high = local.amin(0), local.amax(0)
    center = middle + axes @ torch.cat([0.5 * (low + high)[:2], high[2:]])
    size = (high - low).detach()[:2] / _CELLS_PER_SIDE
    steps = torch.arange(_CELLS_PER_SIDE, dtype=torch.float64) - 0.5 * (_CELLS_PER_SIDE - 1)
    offsets = torch.cartesian_prod(steps, steps) * size
    return PanelCells(center, axes, offsets, (float(size[0]), float(size[1])))


def combine_coherently(
    paths: Paths, link: Link, coherence: CoherenceFunction, *, stretch: float = 1.0
) -> Paths:
    """The power of paths that add in field: of each, and of the interference of each two.

    ``|Σ aᵢ exp(−jkLᵢ)|² = Σᵢ |aᵢ|² + Σ_{i<j} 2 Re(aᵢ aⱼ* exp(−jk(Lᵢ − Lⱼ)))``. Interference lies
    midway between the two echoes. Two echoes h(R − Rᵢ) and h(R − Rⱼ) with a point spread h² overlap
    there by h²((Rᵢ − Rⱼ)/2), likewise over u and v: exactly for Gaussians, at the middle for any.
    So echoes in one cell add in field, and those of different cells in power.

    Args:
        paths: Of one target.
        link: The antennas that they belong to.
        coherence: The overlap, of differences in range [m], u and v.
        stretch: The wavelength of phases in wavelengths of the antennas, see ``trace_facet_paths``.

    Source: derivations §13.
    Differs from the source: phases between chains are kept, so that orders add in phase only where
    they are in phase.
    """
    field = paths.coefficient * torch.exp(
        -2j * math.pi * SPEED_OF_LIGHT / (stretch * link.wavelength) * paths.delay
    )
    frames = [torch.nonzero(paths.frame == frame)[:, 0] for frame in range(link.frame_count)]
    pairs = [own[torch.triu_indices(len(own), len(own), 1)] for own in frames]
    one, other = torch.cat(pairs, 1)
    places = torch.cat([paths.range[:, None], paths.direction_cosines(link)], 1)
    overlap = coherence(*(places[one] - places[other]).unbind(1))
    cross_power = 2 * (field[one] * field[other].conj()).real * overlap
    own = torch.arange(len(field))
    alone = _midway_power_paths(paths, own, own, field.abs().square())
    return concatenate_paths([alone, _midway_power_paths(paths, one, other, cross_power)])


def _midway_power_paths(paths: Paths, one: Tensor, other: Tensor, power: Tensor) -> Paths:
    """Power paths midway between others."""

    def midpoint(values: Tensor) -> Tensor:
        return 0.5 * (values[one] + values[other])

    return Paths(
        frame=paths.frame[one],
        delay=midpoint(paths.delay),
        coefficient=torch.zeros_like(paths.coefficient[one]),
        power=power,
        first=midpoint(paths.first),
        last=midpoint(paths.last),
        kind="power",
        boundary=torch.zeros(len(one), dtype=torch.bool),
    )
