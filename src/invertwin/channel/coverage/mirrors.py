"""Echoes by mirrors: smooth flat surfaces that reflect before and after one scattering (ghosts).

A target beside a smooth wall is seen four times: directly, behind the wall by the two mixed paths
and by the wall on both legs. Paths by mirrors alone are added: the flash of the wall itself. The
legs are specular paths (``specular.trace_paths``), by the Fresnel coefficients of each
polarisation; array elements see a target behind a mirror at its image.

Source: the radar equation with the legs of derivations §10; boundary terms of derivations §3 and
§11.
"""

import math
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import torch
from jaxtyping import Float32, Float64, Int64
from torch import Tensor

from invertwin.channel.coherent import radar_equation
from invertwin.channel.coherent.field import trace_field
from invertwin.channel.coherent.multibounce_po import sample_surface_points
from invertwin.channel.coherent.speckle import Speckle, draw_speckle
from invertwin.channel.coverage import single_scattering
from invertwin.channel.em import antenna_fields
from invertwin.channel.em.depolarisation import random_scattering_matrix
from invertwin.channel.em.plane_waves import dot, reflect_vectors, triangle_normals
from invertwin.channel.paths import Grid, Link, Paths, concatenate_paths
from invertwin.channel.power.bins import deposit_paths
from invertwin.channel.rays import ray_scene, scene_tables
from invertwin.channel.rays.backend import tracing
from invertwin.channel.sampling import Sampling
from invertwin.channel.specular import image_method, point_targets, trace_paths
from invertwin.channel.specular.ray_paths import REFLECTION, RayPaths, join_ray_paths
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.runtime.concurrency import torch_threads
from invertwin.scene import Scene
from invertwin.scene.material.fresnel import FieldCoefficients, safe_root

_Pairs = single_scattering.ScatteredPairs
_Maps = Float32[Tensor, "frame range u v"]
_Places = radar_equation.MaterialPoints
_Points = radar_equation.SurfacePaths

_SEARCH_RAYS = 100_000
_FEW_TRIANGLES = 48  # that reflect or transmit: every sequence of their planes is tested
_RAYS_PER_POINT = 64  # rays of power paths at the cost of one point
_SAMPLES_PER_EDGE_POINT = 8  # silhouette samples of power paths at the cost of one edge point


def deposit_mirrored_power(
    scene: Scene, link: Link, grid: Grid, mirrors: Collection[str], *, sampling: Sampling, seed: int
) -> _Maps:
    """Compute the expected power of echoes by mirrors in every bin of a map, per frame.

    Add the map of ``deposit_power`` of ``without_specular(scene, mirrors)``. Differentiable with
    respect to the scene, its materials and the antennas, moving boundaries of shadows and of
    mirrors included.

    Args:
        scene: scene with surfaces.
        link: antennas, per frame.
        grid: bins of one frame.
        mirrors: names of the smooth flat objects that reflect.
        sampling: numbers of samples, of which a point counts as 64 and a point on an edge as 8,
            since their paths are dearer; ``depth`` is the maximum number of surfaces on a path, the
            one that scatters included.
        seed: random seed of the points.

    Raises:
        InputError: mirrors that the scene lacks, or that reflect no coherent wave; objects in
            motion; derivatives where a moving surface touches one that scatters.
    """
    with tracing(sampling.backend), torch_threads(1):
        search = _MirrorSearch(scene, link, mirrors, sampling, seed, "refused")

        def deposit(pairs: _Pairs) -> Tensor:
            return deposit_paths(search.pair_powers(pairs), link, grid)

        scattered = search.tracer.sum_pairs(search.stage, search.geometry, deposit)
        maps = [deposit_paths(paths, link, grid) for paths in search.trace_flash()]
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
    they have in direct echoes. A path by mirrors has the velocity of its point, mirrored where an
    antenna sees the image.

    Args:
        scene: scene with surfaces.
        link: antennas, per frame.
        mirrors: names of the smooth flat objects that reflect; without any, ``trace_field``.
        sampling: numbers of points; ``depth`` is the maximum number of surfaces on a path. Where
            objects move, other paths than those by mirrors have one bounce.
        seed: random seed of the points.
        speckle: rough points; None draws them.

    Raises:
        InputError: mirrors that the scene lacks, that reflect no coherent wave, or that move;
            derivatives with respect to geometry with ``boundary``, which single points lack; and
            errors of ``trace_field``.
    """
    if not mirrors:
        return trace_field(scene, link, sampling=sampling, seed=seed, speckle=speckle)
    rest = single_scattering.without_specular(scene, mirrors)
    moves = any(item.velocity is not None for item in scene.objects.values())
    own = replace(sampling, depth=1) if moves else sampling
    fixed = speckle or draw_speckle(rest, link, own, seed)
    direct = trace_field(rest, link, sampling=own, seed=seed, speckle=fixed)
    with tracing(sampling.backend), torch_threads(1):
        search = _MirrorSearch(scene, link, mirrors, sampling, seed, "fixed")
        geometry, frames = search.geometry, range(link.frame_count)
        if sampling.boundary and scene_tables.is_visibility_differentiated(geometry, link):
            raise InputError(
                "expected no geometry derivative of fields by mirrors, got one: single points "
                "appear and vanish; use power paths, or boundary=False for fixed visibility"
            )
        found = [direct, *search.trace_flash()]
        smooth = torch.tensor(geometry.coherent)[geometry.face_object]
        if bool(smooth.any()):
            areas, count = ray_scene.face_areas(geometry), sampling.count_conductor_samples()
            points = sample_surface_points(areas * smooth, count, seed)
            found += search.trace_points(points, frames, search.conductor_fields)
        rough = search.tracer.is_scattering & ~smooth
        if bool(rough.any()):
            points = fixed.points.select(rough[fixed.points.face[:, 0]])
            found += search.trace_points(points, frames, search.rough_fields)
    return concatenate_paths(found)


def trace_mirrored_power(
    scene: Scene, link: Link, mirrors: Collection[str], *, sampling: Sampling, seed: int
) -> Paths:
    """Trace the power paths that ``deposit_mirrored_power`` sums, as explicit rows.

    Visibility is fixed. Objects may move: a path has the velocity of its point, mirrored where an
    antenna sees the image.

    Args:
        scene, link, mirrors, seed: as of ``deposit_mirrored_power``.
        sampling: number of points, and ``depth``.

    Raises:
        InputError: see ``deposit_mirrored_power``; mirrors that move.
    """
    with tracing(sampling.backend), torch_threads(1):
        search = _MirrorSearch(scene, link, mirrors, sampling, seed, "free")
        points, found = search.tracer.sample_points(search.geometry), search.trace_flash()
        for frame in range(link.frame_count):
            own = points.points.select(points.antenna == frame)
            found += search.trace_points(own, [frame], search.pair_powers)
    return concatenate_paths(found)


class _MirrorSearch:
    """Search for legs between the antennas of each frame and surfaces, by the mirrors alone."""

    def __init__(
        self,
        scene: Scene,
        link: Link,
        mirrors: Collection[str],
        sampling: Sampling,
        seed: int,
        motion: Literal["refused", "fixed", "free"],
    ) -> None:
        frequency = SPEED_OF_LIGHT / link.wavelength
        for name in mirrors:
            skin = scene[name].material.smooth_interface(frequency)
            if skin is None or not bool((skin.coherence > 0).any()):
                raise InputError(
                    f"expected mirrors that reflect a coherent wave, got {name!r}, all of whose "
                    "power is scattered; give it a Slab, a PerfectConductor, or "
                    "Dielectric(scattering=0)"
                )
            if scene[name].velocity is not None:
                raise InputError(
                    f"expected mirrors at rest, got a velocity on {name!r}; remove one of them"
                )
        rest = single_scattering.without_specular(scene, mirrors)
        self.link = link
        self.geometry = scene_tables.flatten(rest, link.wavelength, motion=motion)
        flat = scene
        for name in set(scene.names) - set(mirrors):
            flat = flat.replace(name, material=_NonReflecting(scene[name].material))
        stage = trace_paths.prepare_path_scene(flat, link.tx, link.rx, frequency)
        self.stage = replace(stage, velocities=None)
        active = trace_paths.face_interactions(self.stage)
        few = int((active.reflect | active.transmit).sum()) <= _FEW_TRIANGLES
        drawn = replace(
            sampling,
            samples=max(1, sampling.samples // _RAYS_PER_POINT),
            boundary_samples=-(-sampling.boundary_samples // _SAMPLES_PER_EDGE_POINT),
        )
        pairing: single_scattering.Pairing = "monostatic" if link.shared_visibility else "frames"
        how = None if few else _SEARCH_RAYS, drawn, seed, pairing
        self.tracer = single_scattering.SingleScatteringTracer(self.stage, self.geometry, *how)

    def trace_flash(self) -> list[Paths]:
        """Paths by mirrors alone, with field and power; none without any."""
        tracer, (ends, others) = self.tracer, self.tracer.antennas
        found, number = list[RayPaths](), torch.arange(len(ends))
        for steps in tracer.sequences[0]:
            parts = image_method.find_paths_from(tracer.surfaces, steps, ends, number, others)
            found += [p for some in parts for p in trace_paths.evaluate_paths(self.stage, some)]
        if not found:
            return []
        out = join_ray_paths(found)
        back = replace(out, departure=out.arrival, arrival=out.departure)
        sent, received = _amplitudes(self.link, out, back)
        fields = torch.einsum("nri,nij,ntj->nrt", received, out.coefficient, sent)
        flash = point_targets.join_legs(self.link, out, back, fields)
        power = flash.coefficient.abs().square()
        return [replace(flash, delay=out.delay, power=power)]

    def trace_points(
        self,
        points: _Points,
        frames: Iterable[int],
        evaluate: Callable[[_Pairs, _Places, _Points], Paths],
    ) -> list[Paths]:
        """Paths by mirrors over single points in some frames, with their fields or powers."""
        found: list[Paths] = []
        rows = torch.arange(len(points.weight)).split(single_scattering.POINTS_AT_ONCE)
        for frame, row in product(frames, rows):
            some = points.select(row)
            sample = single_scattering.ScatteringPoints(torch.full_like(row, frame), some)
            place = some.material_points(self.geometry)[0]
            legs, area = self.tracer.find_legs(sample, self.geometry), some.weight * place.jacobian
            how = self.stage, self.geometry, legs, place, area
            pairs, index = self.tracer.evaluate_pairs(*how)
            paths = evaluate(pairs, place.select(index), some.select(index))
            moves = some.select(index).velocity(self.geometry)
            if moves is not None:
                legs = pairs.outbound, pairs.inbound
                first, last = (self._image_velocity(leg, moves) for leg in legs)
                paths = replace(paths, velocity=last, first_velocity=first)
            found.append(paths.select(paths.has_field | (paths.power > 0)))
        return found

    def _image_velocity(self, legs: RayPaths, velocity: Tensor) -> Tensor:
        """Velocities of the images of moving points, as the antenna of each leg sees them."""
        stage = self.stage
        normal = triangle_normals(stage.vertices.detach()[stage.topology.faces[legs.faces]])
        for step in reversed(range(legs.faces.shape[1])):
            mirrored = reflect_vectors(velocity, normal[:, step])
            velocity = torch.where(legs.kinds[:, step, None] == REFLECTION, mirrored, velocity)
        return velocity

    def pair_powers(self, pairs: _Pairs, *_: _Places | _Points) -> Paths:
        """Paths with the powers of pairs of legs, of the mean elements of both antennas."""
        legs = pairs.outbound, pairs.inbound
        sent, received = _amplitudes(self.link, *legs)
        sent = torch.einsum("k,nki->ni", self.link.tx_jones.mean, sent)[:, None]
        received = torch.einsum("k,nki->ni", self.link.rx_jones.mean, received)[:, None]
        unit = single_scattering.scattered_power(*legs, sent, received, pairs.depolarisation)
        none = torch.zeros(len(unit), 1, 1, dtype=torch.complex128)
        paths = point_targets.join_legs(self.link, *legs, none)
        return replace(paths, power=unit * pairs.weight, kind="power")

    def rough_fields(self, pairs: _Pairs, _: _Places, points: _Points) -> Paths:
        """Paths with fields of rough points: the root of their power, with the points' phases."""
        phasor = torch.polar(safe_root(pairs.weight, 0.0), points.phase)[:, None, None]
        scattering = phasor * random_scattering_matrix([pairs.depolarisation], points.phase)
        out, back = pairs.outbound, pairs.inbound
        sent, received = _amplitudes(self.link, out, back)
        fields = received @ back.coefficient.mT @ scattering @ out.coefficient @ sent.mT
        return point_targets.join_legs(self.link, out, back, fields)

    def conductor_fields(self, pairs: _Pairs, place: _Places, points: _Points) -> Paths:
        """Paths with fields of conductors by physical optics."""
        out, back = pairs.outbound, pairs.inbound
        normal = dot(place.normal, out.arrival).sign()[:, None] * place.normal
        sent = point_targets.fields_at_target(self.link, out, transmits=True)
        received = point_targets.fields_at_target(self.link, back, transmits=False)
        waves = -out.arrival, sent, -back.arrival, received
        area = points.weight * place.jacobian
        spread = area**2 * (4 * math.pi / self.link.wavelength) ** 4
        kernel = antenna_fields.current_kernel(normal, *waves)
        fields = antenna_fields.conductor_field(spread, kernel, dot(normal, back.arrival))
        return point_targets.join_legs(self.link, out, back, fields)


def _amplitudes(link: Link, outbound: RayPaths, inbound: RayPaths) -> tuple[Tensor, Tensor]:
    """Amplitudes of the elements of both antennas along legs, [row, element, 2]."""
    sent = point_targets.antenna_amplitudes(link, outbound, transmits=True)
    return sent, point_targets.antenna_amplitudes(link, inbound, transmits=False)


@dataclass(frozen=True)
class _NonReflecting(single_scattering.IncoherentMaterial):
    """A material whose coherent wave passes as it is, but is not reflected."""

    def coefficients(
        self, frequency: float, cosine: Float64[Tensor, " n"], triangle: Int64[Tensor, " n"]
    ) -> FieldCoefficients:
        """Return coefficients without reflection. See ``Material.coefficients``."""
        found = self.base.coefficients(frequency, cosine, triangle)
        return found.scale_reflection(torch.zeros_like(cosine))
