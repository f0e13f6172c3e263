"""Meshes: every bounce by shooting and bouncing tubes of light.

A tube begins as a triangle of a lit facet; its outline and phase are exact for as long as it meets
single facets, since these are flat. Where it meets several it is split in four until its pieces are
as narrow as asked for; these are cut between the facets.
"""

from collections.abc import Iterator

from torch import Tensor

from invertwin.channel.beams.beam_tracing import Bounce, Facets, in_air
from invertwin.channel.em.plane_waves import dot, mirrored
from invertwin.channel.field.patches import above, divided
from invertwin.channel.rays.ray_scene import Occluders, next_surface


def tubes(
    facets: Facets, occluders: Occluders, lit: Bounce, narrowest: float, depth: int
) -> Iterator[Bounce]:
    """Lit patches of the second order, of the third, and so on.

    Args:
        facets: The triangles.
        occluders: The same as rays see them.
        lit: Triangles that waves light first.
        narrowest: Width of a tube that is not split [m].
        depth: Most bounces.

    Source: derivations §13.

    Differs from the source: tubes begin as lit triangles and are cut between facets. On a square
    grid they count whole or not at all.
    """
    last = lit
    for _ in range(1, depth):
        last = _next(facets, occluders, last, narrowest)
        if not len(last.aspect):
            return
        yield last


def _next(facets: Facets, occluders: Occluders, last: Bounce, narrowest: float) -> Bounce:
    """What the tubes of one order meet next."""
    ways = mirrored(last.direction, last.normal)

    def met(row: Tensor, points: Tensor) -> Tensor:
        starts = points + above(facets, last.normal[row])[:, None]
        ends = starts + 3 * facets.size * ways[row][:, None]
        found, _ = next_surface(occluders, starts.flatten(0, 1), ends.flatten(0, 1))
        return found.view(starts.shape[:2])

    def narrow(row: Tensor, pieces: Tensor) -> Tensor:
        d = ways[row][:, None]
        across = pieces - dot(pieces, d)[..., None] * d
        return (across.roll(-1, 1) - across).norm(dim=2).amax(1) <= narrowest

    before, corners, facet = divided(last.polygon, met, narrow)
    before, corners, facet = (x[facet >= 0] for x in (before, corners, facet))
    normal, d = facets.normal[facet], ways[before]
    facing = dot(normal, d)
    keep = (facing.abs() > 1e-9) & ~(facets.solid[facet] & (facing > 0))
    before, facet, corners, normal, d, facing = (
        x[keep] for x in (before, facet, corners, normal, d, facing)
    )
    # The ray tracer says which triangle; where on its plane is found in float64.
    away = dot(normal[:, None], facets.corners[facet, :1] - corners) / facing[:, None]
    polygon = corners + away[..., None] * d[:, None]
    # Equal phases on the mirror.
    offset = last.offset[before] + dot(last.direction[before] - d, corners[:, 0])
    normal = -facing.sign()[:, None] * normal
    return in_air(last.aspect[before], facet, normal, d, offset, polygon, before)
