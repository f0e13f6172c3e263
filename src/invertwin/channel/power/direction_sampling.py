"""Sampling of directions from a surface: towards other objects, or along the surface's lobes.

Directions are drawn from both, with the probability density of their mixture, so that small bright
objects and narrow lobes are both sampled. Detached.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from invertwin.channel.power.integrand import SurfaceInteraction
from invertwin.channel.power.surface import ScatteringLawTables, gaussian, opaque_row
from invertwin.channel.rays.arrays import tangent_frame, to_float
from invertwin.channel.rays.backend import dr, mi, mit
from invertwin.channel.rays.bounding_spheres import sample_cap
from invertwin.channel.rays.ray_scene import NO_TARGET, RayScene
from invertwin.scene import ScatteringLaw

_AIMED_FRACTION = 0.5  # share of the directions that aim at other objects, if there are any

_MAX_TRIES = 4  # random choices of an object whose bounding sphere excludes the point


@dataclass(frozen=True)
class DirectionSample:
    """Sampled unit directions.

    Attributes:
        omega: directions.
        lobe_density: probability density per solid angle of the lobes alone; infinite if total
            reflection leaves no direction.
        group: group of objects at which it aims, if any: it is void if it ends elsewhere.
        target: object of that group at which it aims, if any.
    """

    omega: mit.Vector3f
    lobe_density: mit.Float
    group: mit.UInt32
    target: mit.UInt32


class DirectionSampler:
    """Sampler of directions on the illuminated side of a surface.

    Args:
        rays: ray scene with the objects to aim at.
        surfaces: scattering laws of the surfaces.
    """

    def __init__(self, rays: RayScene, surfaces: ScatteringLawTables) -> None:
        self.rays, self.spheres = rays, rays.spheres
        self.surfaces = surfaces
        shares = _lobe_fractions(rays.geometry.surfaces)
        self.lobe_fractions = to_float(shares)
        self.column_count = shares.shape[1]
        self._single_row = opaque_row(shares) if len(shares) == 1 else None

    def draw(
        self,
        point: SurfaceInteraction,
        incident: mit.Vector3f,
        numbers: list[mit.Float],
        scene: mit.UInt32,
    ) -> DirectionSample:
        """Sample a direction.

        Args:
            point: latest vertex.
            incident: unit directions to the vertex before.
            numbers: six uniform numbers; the second is reserved for Russian roulette.
            scene: scenes whose objects are aimed at.
        """
        facing = mi.Normal3f(dr.mulsign(point.normal, dr.dot(point.normal, incident)))
        omega = self._sample_lobes(point, incident, facing, numbers)
        group, aimed = mi.UInt32(NO_TARGET), mi.UInt32(NO_TARGET)
        spheres = self.spheres
        if spheres.max_objects > 1:
            towards, rest = numbers[4] < _AIMED_FRACTION, numbers[5]
            first, groups = spheres.scene_groups(scene)
            scaled: mit.Float = numbers[4] / _AIMED_FRACTION * groups  # type: ignore[operator]
            drawn = first + dr.minimum(mi.UInt32(scaled), groups - 1)
            members = spheres.member_count(drawn)
            axis, height = mi.Vector3f(0, 0, 1), mi.Float(2.0)
            # An object of the group whose sphere excludes the point, if a few tries find one.
            for _ in range(_MAX_TRIES):
                rest *= members  # type: ignore[operator]
                number = dr.minimum(mi.UInt32(rest), members - 1)
                rest -= number
                index = drawn * spheres.group_size + number
                direction, cap, outside = spheres.cap(index, point.position)
                taken = towards & outside & (aimed == NO_TARGET)
                axis, height = dr.select(taken, direction, axis), dr.select(taken, cap, height)
                aimed = dr.select(taken, index, aimed)
            omega = dr.select(aimed != NO_TARGET, sample_cap(axis, height, numbers[2:4]), omega)
            group = dr.select(towards, drawn, NO_TARGET)
        density = self._lobe_density(point, incident, facing, omega)
        if self.surfaces.has_refracting_bodies:
            invalid = dr.squared_norm(omega) < 0.5
            omega = dr.select(invalid, mi.Vector3f(facing), omega)
            density = dr.select(invalid, dr.inf, density)
        return DirectionSample(omega, density, group, aimed)

    def density(
        self,
        point: SurfaceInteraction,
        sample: DirectionSample,
        face: mit.UInt32,
        active: mit.Bool,
        scene: mit.UInt32,
    ) -> mit.Float:
        """Evaluate the probability density per solid angle of a direction that ends on a triangle.

        Args:
            point: vertex at which the direction was sampled.
            sample: sampled direction.
            face: triangle on which it ends.
            active: mask of active lanes.
            scene: scenes whose objects were aimed at.

        Returns:
            The density, 0 for directions that are void.
        """
        spheres = self.spheres
        if spheres.max_objects == 1:
            return sample.lobe_density
        group = spheres.face_group(face, active)
        line = point.position, sample.omega
        found, around = spheres.group_density(self.rays, group, *line, active, sample.target)
        members, (_, groups) = mi.Float(spheres.member_count(group)), spheres.scene_groups(scene)
        # A try fails with the share of spheres that contain the point.
        failing = around / members
        tries: Any = sum(failing**k for k in range(_MAX_TRIES))
        share: mit.Float = _AIMED_FRACTION / groups  # type: ignore[operator]
        scattered = 1 - _AIMED_FRACTION + share * failing**_MAX_TRIES
        density = scattered * sample.lobe_density + share * tries / members * found
        return dr.select((sample.group == NO_TARGET) | (sample.group == group), density, 0.0)

    def _sample_lobes(
        self,
        point: SurfaceInteraction,
        incident: mit.Vector3f,
        facing: mit.Vector3f,
        numbers: list[mit.Float],
    ) -> mit.Vector3f:
        local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(numbers[2], numbers[3]))
        omega = tangent_frame(facing).to_world(local)
        specular = 2 * dr.dot(incident, facing) * facing - incident
        limit = self._lobe_fraction(point, 0)
        for number, present in enumerate(self.surfaces.has_lobe):
            if not present:
                continue
            axis = mi.Vector3f(incident if number == 2 else specular)
            exponent = self.surfaces.exponent(number, point.surface_row)
            # Height of the cap with that share of a lobe ((1 + cosψ)/2)^p.
            fall = dr.log(dr.maximum(1 - numbers[2], 1e-9)) / (exponent + 1)
            series = -fall * (1 + fall * (1 / 2 + fall / 6))  # a narrow lobe keeps its digits
            height = 2 * dr.select(fall > -0.01, series, 1 - dr.exp(fall))
            lobe = sample_cap(axis, height, [mi.Float(1.0), numbers[3]])
            share = self._lobe_fraction(point, number + 1)
            omega = dr.select((numbers[0] >= limit) & (numbers[0] < limit + share), lobe, omega)
            limit += share
        if self.surfaces.has_refracting_bodies:
            refracted = self._sample_refraction(point, incident, numbers)
            omega = dr.select(numbers[0] >= limit, refracted, omega)
        return mi.Vector3f(omega)

    def _refractive_indices(
        self, point: SurfaceInteraction, incident: mit.Vector3f
    ) -> tuple[mit.Float, mit.Float, mit.Float]:
        """Look up the refractive index here and beyond, and the variance of the refracted lobe."""
        body = self.surfaces.value("index", point.surface_row)
        outside = dr.dot(point.normal, incident) > 0
        variance = self.surfaces.refraction_variance(point.surface_row)
        return dr.select(outside, 1.0, body), dr.select(outside, body, 1.0), variance

    def _sample_refraction(
        self, point: SurfaceInteraction, incident: mit.Vector3f, numbers: list[mit.Float]
    ) -> mit.Vector3f:
        """Sample a direction beyond the surface about Snell's; zero if there is none."""
        here, beyond, variance = self._refractive_indices(point, incident)
        gauss = mi.warp.square_to_std_normal(mi.Point2f(numbers[2], numbers[3])) * dr.sqrt(variance)
        frame = tangent_frame(point.normal)
        local = frame.to_local(mi.Vector3f(incident))
        x, y = ((gauss[k] - here * local[k]) / beyond for k in range(2))
        rest = 1 - x * x - y * y
        z = -dr.mulsign(dr.sqrt(dr.maximum(rest, 0.0)), local.z)
        return dr.select(rest > 1e-6, frame.to_world(mi.Vector3f(x, y, z)), mi.Vector3f(0.0))

    def _refraction_density(
        self, point: SurfaceInteraction, incident: mit.Vector3f, omega: mit.Vector3f
    ) -> mit.Float:
        here, beyond, variance = self._refractive_indices(point, incident)
        first, second = dr.dot(point.normal, incident), dr.dot(point.normal, omega)
        mismatch = here * (incident - point.normal * first)
        mismatch = mismatch + beyond * (omega - point.normal * second)
        lobe = gaussian(mismatch, variance)
        return dr.select(first * second < 0, lobe * dr.square(beyond) * dr.abs(second), 0.0)

    def _lobe_density(
        self,
        point: SurfaceInteraction,
        incident: mit.Vector3f,
        facing: mit.Vector3f,
        omega: mit.Vector3f,
    ) -> mit.Float:
        density = self._lobe_fraction(point, 0) * dr.maximum(dr.dot(facing, omega), 0.0) * dr.inv_pi
        for number, present in enumerate(self.surfaces.has_lobe):
            if present:
                lobe, exponent = self.surfaces.evaluate_lobe(
                    number, point.surface_row, point.normal, incident, omega
                )
                lobe = (exponent + 1) / (4 * dr.pi) * lobe
                density += self._lobe_fraction(point, number + 1) * lobe
        if self.surfaces.has_refracting_bodies:
            share = self._lobe_fraction(point, self.column_count - 1)
            density += share * self._refraction_density(point, incident, omega)
        return density

    def _lobe_fraction(self, point: SurfaceInteraction, number: int) -> mit.Float:
        if self._single_row is not None:
            return mi.Float(self._single_row[number])  # a copy, which callers may add to
        entry = point.surface_row * self.column_count + number
        return dr.gather(mi.Float, self.lobe_fractions, entry)


def _lobe_fractions(surfaces: ScatteringLaw) -> torch.Tensor:
    """Compute the share of each part of a scattering law; Lambertian if it scatters nothing."""
    exponents = surfaces.exponents.detach()
    wide = 4 * torch.pi * (exponents + torch.exp2(-(exponents + 1)))
    lobes = surfaces.lobes.detach() * (wide / ((exponents + 1) * (exponents + 2)))
    diffuse = surfaces.diffuse.detach()[:, None]
    total = diffuse + lobes.sum(1, keepdim=True)
    # A part of the cosine is kept, so that the density never vanishes where f does not.
    parts = torch.cat([diffuse + 0.05 * (total + (total == 0)), lobes], dim=1)
    # Reflected power at normal incidence against refracted power.
    reflected = surfaces.amplitude.detach()[:, -1:].square()
    parts = parts * torch.where(surfaces.refraction.any(1, keepdim=True), reflected, 1.0)
    parts = torch.cat([parts, surfaces.refraction.detach()[:, -1:]], dim=1)
    return parts / parts.sum(1, keepdim=True)
