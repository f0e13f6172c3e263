"""The rival of the paper's gradient figure: edge sampling of the strength of first echoes.

Image-space differentiation as renderers do it: rays from the antenna at fixed directions, and
for moving edges the jump of what is seen on their two sides (Li et al., Differentiable Monte
Carlo ray tracing through edge sampling, 2018). All triangle edges are sampled, creases and
silhouettes; no edge is left out. Of an echo only the strength is differentiated, since the paper
says of its rival that it is "focusing solely on the signal strength of the first-order
reflections": a moved surface keeps its delay.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.autograd.forward_ad as forward_ad
from jaxtyping import Float64, Int64
from torch import Tensor

from invertwin.channel import Grid, Link
from invertwin.channel.coherent.radar_equation import MaterialPoints, radar_equation
from invertwin.channel.rays.arrays import to_float, to_torch
from invertwin.channel.rays.backend import mi
from invertwin.channel.rays.ray_scene import RayScene, is_visible
from invertwin.channel.rays.scene_tables import Geometry, flatten
from invertwin.checks import is_differentiated
from invertwin.errors import InputError
from invertwin.radar.radar import Radar
from invertwin.radar.surrogate.surrogate import Surrogate
from invertwin.scene.scene import Scene
from invertwin_studies.peers.binning import binned

_CHUNK = 250_000  # samples at a time, which bounds the memory
_ASIDE = 2e-5  # rad, from an edge to the surfaces on its two sides; float32 tells no less


def edge_sampling_derivative(
    scene: Scene,
    radar: Radar,
    grid: Grid,
    direction: Callable[[Scene, Radar, Tensor], tuple[Scene, Radar]],
    *,
    surrogate: Surrogate,
    samples: int,
    edge_samples: int,
    seed: int,
) -> Float64[Tensor, "frame range u v"]:
    """Derivative of the strengths of echoes at fixed delays, edges included.

    Args:
        scene: The scene at θ = 0.
        radar: Its radar; one visibility for both antennas.
        grid: Bins of the map.
        direction: θ → scene and radar; it must not move the radar.
        surrogate: Point spread of the map.
        samples: Rays from the antenna.
        edge_samples: Points on edges that move.
        seed: Of both.

    Raises:
        InputError: Antennas that see separately, or a θ that moves the radar.
    """
    with torch.no_grad(), forward_ad.dual_level():
        theta = forward_ad.make_dual(
            torch.zeros((), dtype=torch.float64), torch.ones((), dtype=torch.float64)
        )
        moved, seen = direction(scene, radar, theta)
        link = seen.link()
        if is_differentiated(link.tx) or is_differentiated(link.rotations):
            raise InputError(
                "expected a parameter of an object for edge sampling, got one that moves the "
                "radar; leave edge_sampling out"
            )
        if not link.shared_visibility:
            raise InputError(
                "expected antennas that see the same for edge sampling, got separate visibility; "
                "leave edge_sampling out"
            )
        geometry = flatten(moved, link.wavelength)
        rays = RayScene(geometry, link)
        total = torch.zeros(link.frame_count, *grid.shape, dtype=torch.float64)
        generator = torch.Generator().manual_seed(seed)
        for count in _chunks(samples):
            total += _interior(geometry, link, rays, grid, count, samples, generator)
        for count in _chunks(edge_samples):
            total += _edges(geometry, link, rays, grid, count, edge_samples, generator)
    return surrogate.shape(total, radar, grid)


def _chunks(samples: int) -> list[int]:
    whole, rest = divmod(samples, _CHUNK)
    return [_CHUNK] * whole + ([rest] if rest else [])


@dataclass(frozen=True)
class _Echo:
    """What is seen along rays: power per steradian, and where it lies on the map."""

    strength: Float64[Tensor, " ray"]
    distance: Float64[Tensor, " ray"]
    u: Float64[Tensor, " ray"]
    v: Float64[Tensor, " ray"]


def _echo(
    geometry: Geometry,
    link: Link,
    frame: Int64[Tensor, " ray"],
    face: Int64[Tensor, " ray"],
    ray: Float64[Tensor, "ray 3"],
) -> _Echo:
    """The echo of a triangle's plane along unit rays from the antenna."""
    p0, p1, p2 = geometry.corners(face)
    normal = torch.linalg.cross(p1 - p0, p2 - p0)
    normal = normal / normal.norm(dim=1, keepdim=True)
    origin = link.tx[frame]
    slope = (normal * ray).sum(1)
    reach = (normal * (p0 - origin)).sum(1) / slope
    ones = torch.ones_like(reach)
    met = MaterialPoints(origin + ray * reach[:, None], normal, ones, geometry.face_surface[face])
    found = radar_equation(geometry, link, frame, [met])
    local = torch.einsum("nij,ni->nj", link.rotations[frame], ray)
    strength = found.power * reach.square() / slope.abs().clamp_min(1e-6)
    return _Echo(strength, 0.5 * found.length, local[:, 1], local[:, 2])


def _interior(
    geometry: Geometry,
    link: Link,
    rays: RayScene,
    grid: Grid,
    count: int,
    samples: int,
    generator: torch.Generator,
) -> Tensor:
    """Change of strength along fixed rays, at the delay of θ = 0.

    Rays are even in u and v over the grid: what lies beyond it is on no map.
    """
    widths = [
        step * (bins + 2) if bins > 1 else 2.0
        for step, bins in ((grid.u_step, grid.u_count), (grid.v_step, grid.v_count))
    ]
    frame = torch.randint(link.frame_count, (count,), generator=generator)
    place = torch.rand(count, 2, generator=generator, dtype=torch.float64) - 0.5
    u, v = place[:, 0] * widths[0], place[:, 1] * widths[1]
    forward = (1 - u.square() - v.square()).clamp_min(0).sqrt()
    local = torch.stack([forward, u, v], dim=1)
    ray = torch.einsum("nij,nj->ni", link.rotations[frame], local)
    face = _hit(rays, link.tx[frame], ray)
    lit = (face >= 0) & (forward > 1e-3)
    frame, face, ray = frame[lit], face[lit], ray[lit]
    # Solid angle of a piece of (u, v), over the density of samples.
    angle = widths[0] * widths[1] * link.frame_count / (samples * forward[lit])
    echo = _echo(geometry, link, frame, face, ray)
    change = _tangent(echo.strength) * angle
    return binned(frame, change, _value(echo.distance), echo.u, echo.v, grid, link.frame_count)


def _edges(
    geometry: Geometry,
    link: Link,
    rays: RayScene,
    grid: Grid,
    count: int,
    samples: int,
    generator: torch.Generator,
) -> Tensor:
    """Jump of strength across the edges that move, times the solid angle they sweep."""
    total = torch.zeros(link.frame_count, *grid.shape, dtype=torch.float64)
    edges = geometry.topology.edges
    moving = _tangent(geometry.vertices)[edges].abs().sum((1, 2)) > 0
    edges = edges[moving]
    if not len(edges):
        return total
    ends = geometry.vertices[edges]
    length = (_value(ends[:, 1]) - _value(ends[:, 0])).norm(dim=1)
    chosen = torch.multinomial(length, count, replacement=True, generator=generator)
    along = torch.rand(count, 1, generator=generator, dtype=torch.float64)
    frame = torch.randint(link.frame_count, (count,), generator=generator)
    y0, y1 = ends[chosen, 0], ends[chosen, 1]
    point = y0 + (y1 - y0) * along
    seen = is_visible(rays, link.tx[frame], _value(point))
    frame, chosen, point = frame[seen], chosen[seen], point[seen]
    origin = link.tx[frame]
    away = point - origin
    ray = away / away.norm(dim=1, keepdim=True)
    still = _value(ray)
    edge = _value(y1[seen] - y0[seen])
    # Across the edge as seen from the antenna, and the edge's length in radians per metre of it.
    across = torch.linalg.cross(still, edge)
    radians = across.norm(dim=1) / (edge.norm(dim=1) * _value(away).norm(dim=1))
    across = torch.nn.functional.normalize(across, dim=1)
    swept = (across * _tangent(ray)).sum(1) * radians
    # One over the density of samples per metre of edge and frame.
    weight = swept * length.sum() * link.frame_count / samples
    for side in (-1.0, 1.0):
        probe = torch.nn.functional.normalize(still + side * _ASIDE * across, dim=1)
        face = _hit(rays, origin, probe)
        hit = face >= 0
        echo = _echo(geometry, link, frame[hit], face[hit], still[hit])
        # The side that the edge leaves behind grows.
        change = -side * weight[hit] * _value(echo.strength)
        total += binned(
            frame[hit], change, _value(echo.distance), echo.u, echo.v, grid, link.frame_count
        )
    return total


def _hit(rays: RayScene, origin: Tensor, ray: Tensor) -> Tensor:
    """The triangle that each ray meets first; −1 = none."""
    aim = mi.Vector3f(*(to_float(ray[:, k]) for k in range(3)))
    found = rays.scene.ray_intersect_preliminary(
        mi.Ray3f(rays.to_local_points(origin), aim), coherent=True
    )
    face = to_torch(found.prim_index).long()
    return torch.where(to_torch(found.is_valid()).bool(), face, -1)


def _value(dual: Tensor) -> Tensor:
    return forward_ad.unpack_dual(dual).primal.detach()


def _tangent(dual: Tensor) -> Tensor:
    tangent = forward_ad.unpack_dual(dual).tangent
    return torch.zeros_like(_value(dual)) if tangent is None else tangent
