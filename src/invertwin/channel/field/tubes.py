"""Meshes: every bounce by shooting and bouncing rays, each the middle of a tube of light.

Rays start on a square grid across the wave. A tube keeps its cross section, since facets are flat;
where it meets a facet it lights a parallelogram, over which the phase is linear.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Complex128, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.field.waves import cross, dot, mirrored, parallelogram_integral
from invertwin.channel.rays.scene import Occluders, next_surface

_RAYS_AT_ONCE = 1 << 20
_SIDES = 8  # pairs of parallel lines about a scene's outline, outside of which no tube starts


@dataclass(frozen=True)
class TubeBounce:
    """Lit parallelograms of one order, one row a tube.

    Attributes:
        aspect: number of the incident wave.
        facet: triangle that is lit.
        normal: of the triangle, towards the source.
        direction: d of the tube.
        position: middle of the parallelogram [m].
        length: of the way from the plane through the origin across the wave [m].
        sides: of the parallelogram [m].
        before: the row of the previous order; −1 at the first.
    """

    aspect: Int64[Tensor, " row"]
    facet: Int64[Tensor, " row"]
    normal: Float64[Tensor, "row 3"]
    direction: Float64[Tensor, "row 3"]
    position: Float64[Tensor, "row 3"]
    length: Float64[Tensor, " row"]
    sides: Float64[Tensor, "row 2 3"]
    before: Int64[Tensor, " row"]

    def integral(
        self, towards: Float64[Tensor, "row 3"]
    ) -> Callable[[float], Complex128[Tensor, " row"]]:
        """∫ exp(−jk(path − s·x)) dA over each patch, by wave number k [1/m].

        The phase is linear about the middle of a patch.

        Args:
            towards: s, to the receiver.
        """
        first, second = self.sides.unbind(1)
        way = towards - self.direction
        area = cross(first, second).norm(dim=1)
        path = self.length - dot(towards, self.position)
        return lambda k: torch.polar(
            area * parallelogram_integral(k * way, first, second), -k * path
        )


def tubes(
    occluders: Occluders,
    corners: Float64[Tensor, "facet 3 3"],
    incident: Float64[Tensor, "aspect 3"],
    spacing: float,
    depth: int,
) -> Iterator[list[TubeBounce]]:
    """Lit patches of all orders, in parts of as many waves as memory holds.

    Args:
        occluders: the triangles as rays see them.
        corners: of the triangles [m].
        incident: d of each wave.
        spacing: of the tubes [m].
        depth: most bounces.
    """
    points = corners.reshape(-1, 3)
    middle = (points.amin(0) + points.amax(0)) / 2
    radius = float((points - middle).norm(dim=1).max()) + spacing
    count = int(2 * radius / spacing) + 1
    steps = (torch.arange(count, dtype=torch.float64) - (count - 1) / 2) * spacing
    grid = torch.cartesian_prod(steps, steps)
    grid = grid[grid.norm(dim=1) <= radius]
    normals = normalize(
        torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), dim=1
    )
    for some in torch.arange(len(incident)).split(max(1, _RAYS_AT_ONCE // len(grid))):
        across, starts = _across(incident[some]), []
        for row, pair in zip(some, across, strict=True):
            at = grid[_before(grid, (points - middle) @ pair.T)]
            starts.append((row.expand(len(at)), at @ pair))
        aspect, aside = map(torch.cat, zip(*starts, strict=True))
        d = incident[aspect]
        start = middle + aside - 2 * radius * d
        axes = spacing * across[aspect - some[0]]
        yield _walk(occluders, corners, normals, (aspect, start, d, axes), 4 * radius, depth)


def _across(direction: Float64[Tensor, "row 3"]) -> Float64[Tensor, "row 2 3"]:
    """Unit vectors across waves, along no edge of what engineers build: few tubes begin on one."""
    aside = direction.new_tensor([0.31, 0.42, 0.85]).expand_as(direction)
    first = normalize(cross(direction, aside), dim=1)
    return torch.stack([first, cross(direction, first)], 1)


def _before(grid: Float64[Tensor, "cell 2"], points: Float64[Tensor, "v 2"]) -> Tensor:
    """Which places lie before a scene: within all of ``_SIDES`` lines about its points."""
    angle = math.pi / _SIDES * torch.arange(_SIDES, dtype=torch.float64)
    ways = torch.stack([angle.cos(), angle.sin()])
    low, high = (points @ ways).aminmax(dim=0)
    at = grid @ ways
    return ((at >= low) & (at <= high)).all(1)


def _walk(
    occluders: Occluders,
    corners: Tensor,
    normals: Tensor,
    rays: tuple[Tensor, Tensor, Tensor, Tensor],
    reach: float,
    depth: int,
) -> list[TubeBounce]:
    aspect, start, d, axes = rays
    length, before = dot(start, d), torch.full_like(aspect, -1)
    found: list[TubeBounce] = []
    for _ in range(depth):
        facet, _ = next_surface(occluders, start, start + reach * d)
        normal = normals[facet]
        facing = dot(normal, d)
        lit = (facet >= 0) & (facing.abs() > 1e-9)
        if not bool(lit.any()):
            break
        facet, normal, facing, aspect, start, d, axes, length, before = (
            x[lit] for x in (facet, normal, facing, aspect, start, d, axes, length, before)
        )
        # The ray tracer says which triangle; where on its plane is found in float64.
        way = dot(normal, corners[facet, 0] - start) / facing
        position, length = start + way[:, None] * d, length + way
        normal = -facing.sign()[:, None] * normal
        share = (axes @ normal[..., None])[..., 0] / facing.abs()[:, None]
        sides = axes + share[..., None] * d[:, None]
        found.append(TubeBounce(aspect, facet, normal, d, position, length, sides, before))
        d, axes, start = mirrored(d, normal), mirrored(axes, normal[:, None]), position
        before = torch.arange(len(aspect))
    return found
