"""Meshes: what a plane wave lights first, triangle by triangle.

A triangle that is seen whole counts exactly. One that is seen in part is split in four until its
pieces are as small as ray tubes.
"""

from collections.abc import Callable, Iterator

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.channel.field.beams import Bounce, Facets
from invertwin.channel.field.waves import dot

_LARGE = 8.0  # times the smallest piece: larger triangles are split before they are looked at
_INSET = 0.1  # from a corner to the middle, where a corner is looked at
_ROWS_AT_ONCE = 1 << 18
_ASIDE = 2e-6  # of the scene's size: from how far above a surface rays start


def lit_triangles(
    facets: Facets,
    clear: Callable[[Tensor, Tensor], Tensor],
    incident: Float64[Tensor, "aspect 3"],
    smallest: float,
) -> Iterator[Bounce]:
    """Lit pieces of triangles, in parts of as many waves as memory holds.

    Args:
        facets: the triangles.
        clear: points and unit vectors → whether nothing is in the way.
        incident: d of each wave.
        smallest: side of a piece that is not split [m].
    """
    number = torch.arange(len(facets.normal))
    corners = facets.corners.detach()
    while bool((large := _longest(corners) > _LARGE * smallest).any()):
        corners = torch.cat([corners[~large], _quarters(corners[large])])
        number = torch.cat([number[~large], number[large].repeat_interleave(4)])
    for some in torch.arange(len(incident)).split(max(1, _ROWS_AT_ONCE // len(number))):
        aspect = some.repeat_interleave(len(number))
        row = torch.arange(len(number)).repeat(len(some))
        facing = dot(facets.normal[number[row]].detach(), incident[aspect])
        turned = (facing < 0) | ~facets.solid[number[row]]
        keep = turned & (facing.abs() > 1e-9)
        yield _lit(
            facets, clear, incident, smallest, aspect[keep], number[row[keep]], corners[row[keep]]
        )


def _lit(
    facets: Facets,
    clear: Callable[[Tensor, Tensor], Tensor],
    incident: Tensor,
    smallest: float,
    aspect: Tensor,
    number: Tensor,
    corners: Tensor,
) -> Bounce:
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    while len(aspect):
        d = incident[aspect]
        normal = _towards(facets.normal[number].detach(), d)
        middle = corners.mean(1, keepdim=True)
        points = torch.cat([middle, corners + _INSET * (middle - corners)], 1)
        points = points + _ASIDE * facets.size * normal[:, None]
        back = -d[:, None].expand_as(points)
        seen = clear(points.flatten(0, 1), back.flatten(0, 1)).view(-1, 4)
        small = _longest(corners) <= smallest
        lit = seen.all(1) | (small & seen[:, 0])
        split = seen.any(1) & ~lit & ~small
        found.append((aspect[lit], number[lit], corners[lit]))
        aspect = aspect[split].repeat_interleave(4)
        number = number[split].repeat_interleave(4)
        corners = _quarters(corners[split])
    aspect, number, corners = (
        map(torch.cat, zip(*found, strict=True)) if found else (aspect, number, corners)
    )
    d = incident[aspect]
    normal = _towards(facets.normal[number], d)
    before = torch.full_like(aspect, -1)
    return Bounce(aspect, number, normal, d, torch.zeros_like(d[:, 0]), corners, before)


def _towards(normal: Tensor, direction: Tensor) -> Tensor:
    """Normals on the side that the wave comes from."""
    return -dot(normal, direction).sign()[:, None] * normal


def _longest(corners: Tensor) -> Tensor:
    return (corners.roll(-1, 1) - corners).norm(dim=2).amax(1)


def _quarters(corners: Tensor) -> Tensor:
    """Each triangle in four alike."""
    a, b, c = corners.unbind(1)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return torch.stack([torch.stack(part, 1) for part in parts], 1).flatten(0, 1)
