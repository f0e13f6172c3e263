"""Where a path goes on from a surface: towards other objects, or along the lobes of the surface.

Directions come from both ways, with the probability density of their mixture, so that small bright
objects and narrow lobes are both found. Detached.
"""

from dataclasses import dataclass
from typing import Any

import torch

from invertwin.channel.power.integrand import Place
from invertwin.channel.power.surface import Surfaces, gaussian, single_row
from invertwin.channel.rays.arrays import to_float
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.bounding_spheres import in_cap
from invertwin.channel.rays.ray_scene import RayScene
from invertwin.scene import Surface

_TOWARDS = 0.5  # share of the directions that aim at other objects, where there are some


_TRIES = 4  # to find an object that the point is outside of
_ANY = 0xFFFFFFFF


@dataclass(frozen=True)
class Direction:
    """A unit direction, and what its probability depends on.

    Attributes:
        omega: The direction.
        scattered: Its probability per solid angle among those along the lobes; infinite where total
            reflection leaves no direction.
        group: The group of objects that it is for, if any: it is void where it ends elsewhere.
        aimed: The object of that group that it aims at, if any.
    """

    omega: Any
    scattered: Any
    group: Any
    aimed: Any


class Directions:
    """Draws directions on the side of a surface from which it is lit.

    Args:
        rays: Objects to aim at.
        surfaces: Their lobes.
    """

    def __init__(self, rays: RayScene, surfaces: Surfaces) -> None:
        self.rays, self.spheres = rays, rays.spheres
        self.surfaces = surfaces
        shares = _shares(rays.geometry.surfaces)
        self.shares = to_float(shares)
        self.width = shares.shape[1]
        self._only = single_row(shares) if len(shares) == 1 else None

    def draw(self, point: Place, back: Any, numbers: list[Any], scene: Any) -> Direction:
        """A direction from uniform numbers.

        Args:
            point: The vertex.
            back: Unit direction from where the path comes.
            numbers: Six uniform numbers; the second is left to others.
            scene: Whose objects are aimed at.
        """
        facing = mi.Normal3f(dr.mulsign(point.normal, dr.dot(point.normal, back)))
        omega = self._scattered(point, back, facing, numbers)
        group, aimed = mi.UInt32(_ANY), mi.UInt32(_ANY)
        spheres = self.spheres
        if spheres.most > 1:
            towards, rest = numbers[4] < _TOWARDS, numbers[5]
            first, groups = spheres.groups_of(scene)
            drawn = first + dr.minimum(mi.UInt32(numbers[4] / _TOWARDS * groups), groups - 1)
            members = spheres.members(drawn)
            axis, height = mi.Vector3f(0, 0, 1), mi.Float(2.0)
            # One of the group that the point is outside of, if a few tries find one.
            for _ in range(_TRIES):
                rest *= members
                number = dr.minimum(mi.UInt32(rest), members - 1)
                rest -= number
                place = drawn * spheres.size + number
                direction, cap, outside = spheres.cap(place, point.position)
                taken = towards & outside & (aimed == _ANY)
                axis, height = dr.select(taken, direction, axis), dr.select(taken, cap, height)
                aimed = dr.select(taken, place, aimed)
            omega = dr.select(aimed != _ANY, in_cap(axis, height, numbers[2:4]), omega)
            group = dr.select(towards, drawn, _ANY)
        density = self._density(point, back, facing, omega)
        if self.surfaces.bodies:
            lost = dr.squared_norm(omega) < 0.5
            omega = dr.select(lost, mi.Vector3f(facing), omega)
            density = dr.select(lost, dr.inf, density)
        return Direction(omega, density, group, aimed)

    def density(self, point: Place, drawn: Direction, face: Any, active: Any, scene: Any) -> Any:
        """Probability per solid angle of a direction that ends on a triangle; 0 if it is void.

        Args:
            point: The vertex.
            drawn: The direction.
            face: The triangle, in that scene.
            active: Lanes.
            scene: Whose objects were aimed at.
        """
        spheres = self.spheres
        if spheres.most == 1:
            return drawn.scattered
        group = spheres.group(face, active)
        found, around = spheres.density(
            self.rays, group, point.position, drawn.omega, active, drawn.aimed
        )
        members, (_, groups) = mi.Float(spheres.members(group)), spheres.groups_of(scene)
        # Tries fail with the share of spheres that the point is inside of.
        failing = around / members
        tries: Any = sum(failing**k for k in range(_TRIES))
        scattered = 1 - _TOWARDS + _TOWARDS / groups * failing**_TRIES
        density = scattered * drawn.scattered + _TOWARDS / groups * tries / members * found
        return dr.select((drawn.group == _ANY) | (drawn.group == group), density, 0.0)

    def _scattered(self, point: Place, back: Any, facing: Any, numbers: list[Any]) -> Any:
        omega = mi.Frame3f(facing).to_world(
            mi.warp.square_to_cosine_hemisphere(mi.Point2f(numbers[2], numbers[3]))
        )
        mirror = 2 * dr.dot(back, facing) * facing - back
        limit = self._share(point, 0)
        for number, present in enumerate(self.surfaces.lobed):
            if not present:
                continue
            axis = mi.Vector3f(back if number == 2 else mirror)
            exponent = self.surfaces.exponent(number, point.surface)
            # Height of the cap that a lobe ((1 + cosψ)/2)^p fills to the share of the number.
            fall = dr.log(dr.maximum(1 - numbers[2], 1e-9)) / (exponent + 1)
            series = -fall * (1 + fall * (1 / 2 + fall / 6))  # a narrow lobe keeps its digits
            height = 2 * dr.select(fall > -0.01, series, 1 - dr.exp(fall))
            lobe = in_cap(axis, height, [mi.Float(1.0), numbers[3]])
            share = self._share(point, number + 1)
            chosen = (numbers[0] >= limit) & (numbers[0] < limit + share)
            omega = dr.select(chosen, lobe, omega)
            limit += share
        if self.surfaces.bodies:
            omega = dr.select(numbers[0] >= limit, self._refracted(point, back, numbers), omega)
        return mi.Vector3f(omega)

    def _sides(self, point: Place, back: Any) -> tuple[Any, Any, Any]:
        """Refractive index here and beyond, and variance of the refracted lobe."""
        body = self.surfaces.value("index", point.surface)
        outside = dr.dot(point.normal, back) > 0
        variance = self.surfaces.refraction_variance(point.surface)
        return dr.select(outside, 1.0, body), dr.select(outside, body, 1.0), variance

    def _refracted(self, point: Place, back: Any, numbers: list[Any]) -> Any:
        """A direction beyond the surface about Snell's; zero if there is none."""
        here, beyond, variance = self._sides(point, back)
        spread = dr.sqrt(variance)
        gauss = mi.warp.square_to_std_normal(mi.Point2f(numbers[2], numbers[3])) * spread
        frame = mi.Frame3f(mi.Vector3f(point.normal))
        local = frame.to_local(mi.Vector3f(back))
        x, y = ((gauss[k] - here * local[k]) / beyond for k in range(2))
        rest = 1 - x * x - y * y
        z = -dr.mulsign(dr.sqrt(dr.maximum(rest, 0.0)), local.z)
        return dr.select(rest > 1e-6, frame.to_world(mi.Vector3f(x, y, z)), mi.Vector3f(0.0))

    def _refraction_density(self, point: Place, back: Any, omega: Any) -> Any:
        here, beyond, variance = self._sides(point, back)
        first, second = dr.dot(point.normal, back), dr.dot(point.normal, omega)
        mismatch = here * (back - point.normal * first) + beyond * (omega - point.normal * second)
        lobe = gaussian(mismatch, variance)
        return dr.select(first * second < 0, lobe * dr.square(beyond) * dr.abs(second), 0.0)

    def _density(self, point: Place, back: Any, facing: Any, omega: Any) -> Any:
        cosine = dr.dot(facing, omega)
        density = self._share(point, 0) * dr.maximum(cosine, 0.0) * dr.inv_pi
        for number, present in enumerate(self.surfaces.lobed):
            if present:
                lobe, exponent = self.surfaces.lobe(
                    number, point.surface, point.normal, back, omega
                )
                lobe = (exponent + 1) / (4 * dr.pi) * lobe
                density += self._share(point, number + 1) * lobe
        if self.surfaces.bodies:
            share = self._share(point, self.width - 1)
            density += share * self._refraction_density(point, back, omega)
        return density

    def _share(self, point: Place, number: int) -> Any:
        if self._only is not None:
            return mi.Float(self._only[number])  # a copy, which callers may add to
        return dr.gather(mi.Float, self.shares, point.surface * self.width + number)


def _shares(surfaces: Surface) -> torch.Tensor:
    """Share of each part of a surface in what it scatters; Lambertian if it scatters nothing."""
    exponents = surfaces.exponents.detach()
    wide = 4 * torch.pi * (exponents + torch.exp2(-(exponents + 1)))
    integrals = wide / ((exponents + 1) * (exponents + 2))
    lobes = surfaces.lobes.detach() * integrals
    diffuse = surfaces.diffuse.detach()[:, None]
    total = diffuse + lobes.sum(1, keepdim=True)
    # Something of the cosine stays in, so that the density never vanishes where f does not.
    parts = torch.cat([diffuse + 0.05 * (total + (total == 0)), lobes], dim=1)
    # What is reflected at normal incidence against what is refracted there.
    reflected = surfaces.amplitude.detach()[:, -1:].square()
    parts = parts * torch.where(surfaces.refraction.any(1, keepdim=True), reflected, 1.0)
    parts = torch.cat([parts, surfaces.refraction.detach()[:, -1:]], dim=1)
    return parts / parts.sum(1, keepdim=True)
