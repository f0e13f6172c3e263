"""Echoes by mirrors: smooth flat surfaces that reflect before and after one scattering (ghosts).

A target beside a smooth wall is seen four times: directly, behind the wall by the two mixed paths
and by the wall on both legs. Paths by mirrors alone are added: the flash of the wall itself. The
legs are specular paths (``specular.trace_paths``), by the Fresnel coefficients of each
polarisation; array elements see a target behind a mirror at its image.

Source: the radar equation with the legs of derivations §10; boundary terms of derivations §3 and
§11.
"""

import math
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import torch
from jaxtyping import Complex128, Float, Float32, Float64, Int64
from torch import Tensor

from invertwin.channel.coherent.field import trace_field
from invertwin.channel.coherent.multibounce_po import sample_surface_points
from invertwin.channel.coherent.radar_equation import MaterialPoints, SurfacePaths
from invertwin.channel.coherent.speckle import Speckle, draw_speckle
from invertwin.channel.coverage import single_scattering
from invertwin.channel.coverage.single_scattering import ScatteredPairs
from invertwin.channel.em import antenna_fields
from invertwin.channel.em.depolarisation import random_scattering_matrix
from invertwin.channel.em.plane_waves import dot
from invertwin.channel.paths import Grid, Link, Paths, concatenate_paths
from invertwin.channel.power.bins import deposit_paths
from invertwin.channel.power.deposit import deposit_power
from invertwin.channel.rays import ray_scene, scene_tables
from invertwin.channel.rays.backend import tracing
from invertwin.channel.sampling import Sampling
from invertwin.channel.specular import point_targets, trace_paths
from invertwin.channel.specular.image_method import find_paths_from
from invertwin.channel.specular.ray_paths import RayPaths, join_ray_paths
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.models.radar import SurrogateMap
from invertwin.radar.radar import Radar
from invertwin.runtime.concurrency import torch_threads
from invertwin.scene import Scene
from invertwin.scene.material.fresnel import FieldCoefficients

#: Fields or powers of pairs of legs to points, as arguments of ``_to_paths``.
_Evaluation = Callable[[Link, ScatteredPairs, MaterialPoints, SurfacePaths], dict[str, Tensor]]

_SEARCH_RAYS = 100_000
_FEW_TRIANGLES = 48  # that reflect or transmit: every sequence of their planes is tested
_RAYS_PER_POINT = 64  # rays of power paths at the cost of one point


@dataclass(frozen=True)
class MirroredMap(SurrogateMap):
    """A map in which smooth flat objects show everything else a second time (ghosts).

    Attributes:
        mirrors: names of the smooth flat objects, such as a wall or a floor. Paths meet up to
            ``sampling.depth`` surfaces and scatter once.
    """

    mirrors: Sequence[str] = ()

    def predict(self, scene: Scene, sensor: Radar, seed: int) -> Float[Tensor, "frame range u v"]:
        """The expected power spectrum. See ``ForwardModel.predict``."""
        link = sensor.link()
        rest = single_scattering.without_specular(scene, self.mirrors)
        deposit = deposit_power(rest, link, self.grid, sampling=self.sampling, seed=seed)
        deposit = deposit + deposit_mirrored_power(
            scene, link, self.grid, self.mirrors, sampling=self.sampling, seed=seed
        )
        return self.kernels.shape(deposit, sensor, self.grid).clamp_min(0.0)


def deposit_mirrored_power(
    scene: Scene,
    link: Link,
    grid: Grid,
    mirrors: Collection[str],
    *,
    sampling: Sampling,
    seed: int,
) -> Float32[Tensor, "frame range u v"]:
    """Compute the expected power of echoes by mirrors in every bin of a map, per frame.

    Add the map of ``deposit_power`` of ``without_specular(scene, mirrors)``. Differentiable with
    respect to the scene, its materials and the antennas, moving boundaries of shadows and of
    mirrors included.

    Args:
        scene: scene with surfaces.
        link: antennas, per frame.
        grid: bins of one frame.
        mirrors: names of the smooth flat objects that reflect.
        sampling: numbers of points and of edge points; ``depth`` is the maximum number of surfaces
            on a path, the one that scatters included.
        seed: random seed of the points.

    Raises:
        InputError: mirrors that the scene lacks, or that reflect no coherent wave; objects in
            motion; derivatives where a moving surface touches one that scatters.
    """
    rest = single_scattering.without_specular(scene, mirrors)

    def deposit(pairs: ScatteredPairs) -> Tensor:
        paths = _to_paths(link, pairs.outbound, pairs.inbound, **_pair_powers(link, pairs))
        return deposit_paths(paths, link, grid)

    with tracing(sampling.backend), torch_threads(1):
        geometry = scene_tables.flatten(rest, link.wavelength)
        stage, tracer = _prepare(scene, link, mirrors, geometry, sampling, seed)
        scattered = tracer.sum_pairs(stage, geometry, deposit)
        maps = [deposit_paths(p, link, grid) for p in _specular_paths(link, stage, tracer)]
    maps += [] if scattered is None else [scattered]
    return torch.stack(maps).sum(0) if maps else torch.zeros(link.frame_count, *grid.shape)


def trace_field_with_mirrors(
    scene: Scene,
    link: Link,
    mirrors: Collection[str],
    *,
    sampling: Sampling,
    seed: int,
    speckle: Speckle | None = None,
) -> Paths:
    """Trace field paths as ``trace_field``, and those by mirrors.

    Conductors scatter by physical optics, rough surfaces by their fixed points with the phases that
    they have in direct echoes.

    Args:
        scene: scene with surfaces.
        link: antennas, per frame.
        mirrors: names of the smooth flat objects that reflect; without any, ``trace_field``.
        sampling: numbers of points; ``depth`` is the maximum number of surfaces on a path.
        seed: random seed of the points.
        speckle: rough points; None draws them.

    Raises:
        InputError: mirrors that the scene lacks, or that reflect no coherent wave; objects in
            motion; derivatives with respect to geometry with ``boundary``, which single points
            lack; and errors of ``trace_field``.
    """
    rest = single_scattering.without_specular(scene, mirrors)
    direct = trace_field(rest, link, sampling=sampling, seed=seed, speckle=speckle)
    if not mirrors:
        return direct
    with tracing(sampling.backend), torch_threads(1):
        geometry = scene_tables.flatten(rest, link.wavelength)
        if sampling.boundary and scene_tables.is_visibility_differentiated(geometry, link):
            raise InputError(
                "expected no geometry derivative of fields by mirrors, got one: single points "
                "appear and vanish; use power paths, or boundary=False for fixed visibility"
            )
        stage, tracer = _prepare(scene, link, mirrors, geometry, sampling, seed)
        found = [direct, *_specular_paths(link, stage, tracer)]
        smooth = torch.tensor(geometry.coherent)[geometry.face_object]
        frames = range(link.frame_count)
        if bool(smooth.any()):
            areas, count = ray_scene.face_areas(geometry), sampling.count_conductor_samples()
            points = sample_surface_points(areas * smooth, count, seed)
            found += _trace_points(link, stage, tracer, geometry, points, frames, _conductor_fields)
        rough = tracer.is_scattering & ~smooth
        if bool(rough.any()):
            fixed = speckle or draw_speckle(rest, link, sampling, seed)
            points = fixed.points.select(rough[fixed.points.face[:, 0]])
            found += _trace_points(link, stage, tracer, geometry, points, frames, _rough_fields)
    return concatenate_paths(found)


def _prepare(
    scene: Scene,
    link: Link,
    mirrors: Collection[str],
    geometry: scene_tables.Geometry,
    sampling: Sampling,
    seed: int,
) -> tuple[trace_paths.PathScene, single_scattering.SingleScatteringTracer]:
    """Prepare the search for legs between the antennas of each frame by the mirrors alone."""
    frequency = SPEED_OF_LIGHT / link.wavelength
    for name in mirrors:
        skin = scene[name].material.smooth_interface(frequency)
        if skin is None or not bool((skin.coherence > 0).any()):
            raise InputError(
                f"expected mirrors that reflect a coherent wave, got {name!r}, all of whose power "
                "is scattered; give it a Slab, a PerfectConductor, or Dielectric(scattering=0)"
            )
    flat = scene
    for name in set(scene.names) - set(mirrors):
        flat = flat.replace(name, material=_NonReflecting(scene[name].material))
    stage = trace_paths.prepare_path_scene(flat, link.tx, link.rx, frequency)
    pairing: single_scattering.Pairing = "monostatic" if link.shared_visibility else "frames"
    active = trace_paths.face_interactions(stage)
    few = int((active.reflect | active.transmit).sum()) <= _FEW_TRIANGLES
    rays = None if few else _SEARCH_RAYS
    drawn = replace(sampling, samples=max(1, sampling.samples // _RAYS_PER_POINT))
    how = rays, drawn, seed, pairing
    return stage, single_scattering.SingleScatteringTracer(stage, geometry, *how)


def _specular_paths(
    link: Link,
    stage: trace_paths.PathScene,
    tracer: single_scattering.SingleScatteringTracer,
) -> list[Paths]:
    """Paths by mirrors alone, with field and power."""
    number = torch.arange(link.frame_count)
    found = [
        part
        for steps in tracer.sequences[0]
        for part in find_paths_from(
            tracer.surfaces, steps, tracer.antennas[0], number, tracer.antennas[1]
        )
    ]
    parts = [p for some in found for p in trace_paths.evaluate_paths(stage, some)]
    if not parts:
        return []
    out = join_ray_paths(parts)
    back = replace(out, departure=out.arrival, arrival=out.departure)
    sent, received = _amplitudes(link, out, True), _amplitudes(link, back, False)
    fields = torch.einsum("nri,nij,ntj->nrt", received, out.coefficient, sent)
    power = antenna_fields.combine_elements(link, fields)[0].abs().square()
    flash = _to_paths(link, out, back, power=power, fields=fields)
    return [replace(flash, delay=out.delay, kind="coherent")]


def _trace_points(
    link: Link,
    stage: trace_paths.PathScene,
    tracer: single_scattering.SingleScatteringTracer,
    geometry: scene_tables.Geometry,
    points: SurfacePaths,
    frames: Iterable[int],
    evaluate: _Evaluation,
) -> list[Paths]:
    """Paths by mirrors over single points in some frames, with their fields or powers."""
    found: list[Paths] = []
    rows = torch.arange(len(points.weight)).split(single_scattering.POINTS_AT_ONCE)
    for frame, row in product(frames, rows):
        some = points.select(row)
        sample = single_scattering.ScatteringPoints(torch.full_like(row, frame), some)
        place = some.material_points(geometry)[0]
        area = some.weight * place.jacobian
        legs = tracer.find_legs(sample, geometry)
        pairs, index = tracer.evaluate_pairs(stage, geometry, legs, place, area)
        chosen = some.select(index)
        values = evaluate(link, pairs, place.select(index), chosen)
        paths = _to_paths(link, pairs.outbound, pairs.inbound, **values)
        found.append(paths.select(paths.has_field))
    return found


def _pair_powers(
    link: Link, pairs: ScatteredPairs, *_: MaterialPoints | SurfacePaths
) -> dict[str, Tensor]:
    """Powers of pairs of legs, of the mean elements of both antennas."""
    legs = pairs.outbound, pairs.inbound
    sent, received = (
        torch.einsum("k,nki->ni", jones.mean, _amplitudes(link, leg, transmits))[:, None]
        for leg, transmits, jones in zip(
            legs, (True, False), (link.tx_jones, link.rx_jones), strict=True
        )
    )
    unit = single_scattering.scattered_power(*legs, sent, received, pairs.depolarisation)
    return {"power": unit * pairs.weight}


def _rough_fields(
    link: Link, pairs: ScatteredPairs, _: MaterialPoints, chosen: SurfacePaths
) -> dict[str, Tensor]:
    """Fields of rough points: the root of their power, with the phases of the points."""
    positive = pairs.weight > 0  # a root of zero has no derivative
    root = torch.where(positive, torch.where(positive, pairs.weight, 1.0).sqrt(), 0.0)
    scattering = random_scattering_matrix([pairs.depolarisation], chosen.phase)
    sent, received = (
        torch.einsum("nij,nkj->nki", leg.coefficient, _amplitudes(link, leg, transmits))
        for leg, transmits in ((pairs.outbound, True), (pairs.inbound, False))
    )
    phasor = torch.polar(root, chosen.phase)[:, None, None]
    return {"fields": phasor * (received @ scattering @ sent.mT)}


def _conductor_fields(
    link: Link, pairs: ScatteredPairs, point: MaterialPoints, chosen: SurfacePaths
) -> dict[str, Tensor]:
    """Fields of conductors by physical optics."""
    outbound, inbound = pairs.outbound, pairs.inbound
    normal = dot(point.normal, outbound.arrival).sign()[:, None] * point.normal
    sent, received = (
        point_targets.fields_at_target(link, leg.tx, leg, transmits=transmits)
        for leg, transmits in ((outbound, True), (inbound, False))
    )
    kernel = antenna_fields.current_kernel(
        normal, -outbound.arrival, sent, -inbound.arrival, received
    )
    area = chosen.weight * point.jacobian
    spread = torch.full_like(area, (4 * math.pi / link.wavelength) ** 4)
    field = antenna_fields.conductor_field(spread, kernel, dot(normal, inbound.arrival))
    return {"fields": field * area[:, None, None]}


def _amplitudes(link: Link, legs: RayPaths, transmits: bool) -> Complex128[Tensor, "row k 2"]:
    return point_targets.antenna_amplitudes(link, legs.tx, legs, transmits=transmits)


def _to_paths(
    link: Link,
    outbound: RayPaths,
    inbound: RayPaths,
    *,
    power: Float64[Tensor, " row"] | None = None,
    fields: Complex128[Tensor, "row r t"] | None = None,
) -> Paths:
    """Paths over pairs of legs; the antennas see their points at the images."""
    frame = outbound.tx
    first = link.tx[frame] + outbound.length[:, None] * outbound.departure
    last = link.rx[frame] + inbound.length[:, None] * inbound.departure
    delay = outbound.delay + inbound.delay
    if fields is None:
        fields = torch.zeros(len(frame), 1, 1, dtype=torch.complex128)
    found = antenna_fields.coherent_paths(link, frame, delay, fields, first, last)
    return found if power is None else replace(found, power=power, kind="power")


@dataclass(frozen=True)
class _NonReflecting(single_scattering.IncoherentMaterial):
    """A material whose coherent wave passes as it is, but is not reflected."""

    def coefficients(
        self, frequency: float, cosine: Float64[Tensor, " n"], triangle: Int64[Tensor, " n"]
    ) -> FieldCoefficients:
        """Return coefficients without reflection. See ``Material.coefficients``."""
        found = self.base.coefficients(frequency, cosine, triangle)
        return found.scale_reflection(torch.zeros_like(cosine))
