"""Straight paths along faces of solids, from an edge to the end of the face."""

import math

import torch
from jaxtyping import Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.beams.beam_tracing import Facets
from invertwin.channel.em.plane_waves import cross, dot
from invertwin.channel.rays.ray_scene import Occluders, find_next_surface
from invertwin.channel.rcs.rays_in_dielectrics import MAX_SMOOTH_ANGLE

_STEP = 1e-4  # of the scene's size, beyond a triangle's side, where the next one is looked for
_HEIGHT = 0.3 * _STEP  # above and below it: less than a face falls away behind a sharp edge


def face_path_lengths(
    facets: Facets,
    occluders: Occluders,
    face: Int64[Tensor, " row"],
    point: Float64[Tensor, "row 3"],
    direction: Float64[Tensor, "row 3"],
) -> Float64[Tensor, " row"]:
    """Length of straight paths over smooth faces, to a sharp edge or a turn of the normal [m].

    The next triangle is found by a ray from above, so that paths cross T-junctions, seams, and the
    joints of objects. Paths over curved faces are followed in steps of triangles.

    Args:
        facets: facets of all triangles.
        occluders: ray scene of the triangles.
        face: triangles in which the paths start.
        point: points of these [m].
        direction: unit directions along these.
    """
    size, first = facets.size, facets.normal[face]
    length, row = torch.zeros(len(face), dtype=torch.float64), torch.arange(len(face))
    for _ in range(len(facets.normal)):  # no path crosses more triangles
        if not len(row):
            break
        corners, normal = facets.corners[face], facets.normal[face]
        inward = cross(normal[:, None], corners.roll(-1, 1) - corners)
        height = dot(point[:, None] - corners, inward).clamp_min(0)
        rate = -dot(direction[:, None], inward)
        leaves = rate > 0
        step = torch.where(leaves, height / torch.where(leaves, rate, 1.0), math.inf).amin(1)
        length = length.index_add(0, row, step)
        point = point + step[:, None] * direction
        beside, above = point + _STEP * size * direction, _HEIGHT * size * normal
        found, _ = find_next_surface(
            occluders, (beside + above).detach(), (beside - above).detach()
        )
        is_smooth = dot(facets.normal[found], first[row]) > math.cos(MAX_SMOOTH_ANGLE)
        on = torch.nonzero((found >= 0) & (found != face) & is_smooth)[:, 0]
        row, face, point, normal = row[on], found[on], point[on], facets.normal[found[on]]
        direction = direction[on] - dot(direction[on], normal)[:, None] * normal
        direction = normalize(direction, dim=1)
    return length
