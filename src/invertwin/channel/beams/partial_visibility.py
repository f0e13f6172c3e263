"""How much of each cell of a flat panel a place sees: lit fractions, differentiable.

The shadow of a scene on the plane of a panel ends at the projections of silhouette edges. A cell
that such a line cuts is lit in part: ``clamp(s/w + 1/2, 0, 1)``, with s the distance of its centre
from the line, positive in the light, and w its width across the line. Rays say which side is lit,
and are detached; s carries the derivatives by the place, by the panel and by the vertices.

Source: derivations §12.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from invertwin.channel.em.plane_waves import cross, dot
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.ray_scene import Occluders, is_visible
from invertwin.channel.rays.topology import Topology, topology_of
from invertwin.checks import strip_derivatives
from invertwin.errors import InputError
from invertwin.scene import Scene

_PAIRS_AT_ONCE = 1 << 21  # of edges and places, or of edges and cells, at a time
_MAX_EDGE_LEVEL = 0.999  # of the way up to the place: edges above it cast no shadow onto the panel
_RAY_OFFSET = 1e-4  # of the way to an edge: how far aside rays pass it
_COPLANAR_TOLERANCE = 1e-9  # of lengths: an apex in the plane of a place and an edge


@dataclass(frozen=True)
class PanelCells:
    """Equal rectangular cells of a flat panel.

    Attributes:
        center: of the panel [m].
        axes: columns are the panel's x and y axes and its normal, in the world.
        offsets: centres of the cells along x and y [m].
        size: of a cell along x and y [m].
    """

    center: Float64[Tensor, "3"]
    axes: Float64[Tensor, "3 3"]
    offsets: Float64[Tensor, "cell 2"]
    size: tuple[float, float]

    @property
    def centers(self) -> Float64[Tensor, "cell 3"]:
        """Centres of the cells in the world [m]."""
        return self.center + self.offsets @ self.axes[:, :2].T

    @property
    def radius(self) -> float:
        """From the centre to the farthest corner [m]."""
        half = 0.5 * torch.tensor(self.size, dtype=torch.float64)
        return float((strip_derivatives(self.offsets).abs() + half).norm(dim=1).max())


@dataclass(frozen=True)
class _ShadowingEdges:
    """Edges that may end shadows, one row for each place that they may shade.

    Attributes:
        observer: number of the place.
        ends: numbers of the vertices.
        apex: a vertex of a triangle beside the edge, on the dark side.
        interval: part of the edge whose shadow is counted, from 0 to 1.
    """

    observer: Int64[Tensor, " row"]
    ends: Int64[Tensor, "row 2"]
    apex: Int64[Tensor, " row"]
    interval: Float64[Tensor, "row 2"]

    def select(self, index: Tensor) -> "_ShadowingEdges":
        """Some rows."""
        return _ShadowingEdges(*(column[index] for column in vars(self).values()))


def visible_fractions(
    scene: Scene,
    observers: Float64[Tensor, "place 3"],
    cells: PanelCells,
    *,
    blur: float = 0.0,
    boundary: bool = True,
) -> Float64[Tensor, "place cell"]:
    """The fraction of each cell that a place sees, in front of the panel.

    All surfaces of the scene block, sheets too. Fractions of cells that a single straight line cuts
    along the panel's axes are exact.

    Args:
        scene: what is in the way; the panel is no part of it.
        observers: [m].
        cells: of the panel.
        blur: added to the width over which shadows end [m]; 0 = that of a cell.
        boundary: False leaves out of derivatives that shadows move.

    Raises:
        InputError: a cloud among the objects.
    """
    clouds = [name for name, item in scene.objects.items() if item.cloud is not None]
    if clouds:
        raise InputError(
            f"expected objects with surfaces, got clouds for {', '.join(clouds)}; mesh them"
        )
    items = list(scene.objects.values())
    topology = topology_of([item.mesh for item in items])
    vertices = torch.cat([item.vertices for item in items])
    with tracing():
        rays = Occluders(strip_derivatives(vertices), topology, strip_derivatives(cells.center))
        still = PanelCells(
            strip_derivatives(cells.center),
            strip_derivatives(cells.axes),
            strip_derivatives(cells.offsets),
            cells.size,
        )
        spots = strip_derivatives(observers)
        edges = _find_silhouette_edges(
            strip_derivatives(vertices), topology, spots, still, still.radius + blur
        )
        edges = _select_visible_edges(rays, strip_derivatives(vertices), spots, still, edges)
        lit = _test_cell_centers(rays, spots, still, edges, strip_derivatives(vertices))
        row, cell = _match_cells_to_edges(
            edges, lit, (strip_derivatives(vertices), spots, still), blur
        )
    found = lit.to(torch.float64)
    if not len(row):
        return found
    moved = (
        (vertices, observers, cells) if boundary else (strip_derivatives(vertices), spots, still)
    )
    edges = edges.select(row)
    offsets = moved[2].offsets[cell]
    distance, across = _shadow_distances(_project_edges(edges, *moved), offsets)
    span = torch.tensor(cells.size, dtype=torch.float64)
    share = distance / ((across.abs() * span).sum(-1) + blur) + 0.5
    return found.index_put((edges.observer, cell), share.clamp(0.0, 1.0))


def _find_silhouette_edges(
    vertices: Tensor, topology: Topology, observers: Tensor, cells: PanelCells, reach: float
) -> _ShadowingEdges:
    """Silhouette edges whose shadows end within reach of the panel's centre."""
    normal = cells.axes[:, 2]
    found: list[_ShadowingEdges] = []
    count = len(topology.edges)
    for some in torch.arange(len(observers)).split(max(1, _PAIRS_AT_ONCE // max(1, count))):
        start, end = vertices[topology.edges].unbind(1)
        spot = observers[some, None]
        plane = cross(start - spot, (end - start).expand(len(some), -1, -1))
        sides = []
        for apex in topology.edge_apexes.T:
            offset = vertices[apex.clamp_min(0)] - start
            side = dot(plane, offset.expand_as(plane))
            near = side.abs() <= _COPLANAR_TOLERANCE * plane.norm(dim=-1) * offset.norm(dim=-1)
            side = torch.where(near | (apex < 0), 0.0, side.sign())
            sides.append(side)
        table = torch.stack(sides)
        silhouette = (table.sum(0).abs() == table.abs().sum(0)) & (table.abs().sum(0) > 0)
        # Which part of the edge lies between the panel's plane and the place.
        height = (spot - cells.center) @ normal
        rise = torch.stack([(end_ - cells.center) @ normal for end_ in (start, end)])
        level = rise[:, None] / torch.where(height > 0, height, torch.inf)[None]
        first, slope = level[0], level[1] - level[0]
        safe = torch.where(slope == 0, 1.0, slope)
        bounds = torch.stack([-first / safe, (_MAX_EDGE_LEVEL - first) / safe])
        inside = (first >= 0) & (first <= _MAX_EDGE_LEVEL)
        low = torch.where(slope == 0, torch.where(inside, 0.0, 1.0), bounds.amin(0)).clamp_min(0)
        high = torch.where(slope == 0, torch.where(inside, 1.0, 0.0), bounds.amax(0)).clamp_max(1)
        place, edge = torch.nonzero(silhouette & (height > 0) & (low < high)).T
        chosen = table.abs()[:, place, edge].argmax(0)
        share = torch.stack([low[place, edge], high[place, edge]], 1)
        apex = topology.edge_apexes[edge, chosen]
        found.append(_ShadowingEdges(some[place], topology.edges[edge], apex, share))
    edges = _ShadowingEdges(
        *(torch.cat(c) for c in zip(*(vars(f).values() for f in found), strict=True))
    )
    none = torch.zeros(len(edges.observer), 2, dtype=torch.float64)
    distance, _ = _shadow_distances(_project_edges(edges, vertices, observers, cells), none)
    return edges.select(torch.nonzero(distance.abs() <= reach)[:, 0])


def _project_edges(
    edges: _ShadowingEdges, vertices: Tensor, observers: Tensor, cells: PanelCells
) -> Float64[Tensor, "row 3 2"]:
    """Projections of both ends and of the apex's side onto the panel's plane, along its axes [m].

    The last one is a point beside the line on the dark side: the apex may have no projection.
    """
    spot = observers[edges.observer]
    ends = vertices[edges.ends]
    side = ends[:, 1] - ends[:, 0]
    points = ends[:, :1] + edges.interval[:, :, None] * side[:, None]
    way = _edge_ray_fractions(edges, vertices, observers, cells)
    cast = spot[:, None] + (points - spot[:, None]) / way[..., None]
    flat = (cast - cells.center) @ cells.axes[:, :2]
    # The plane of place and edge cuts the panel's plane in the line; its normal tells the side.
    plane = cross(points[:, 0] - spot, points[:, 1] - spot)
    dark = dot(plane, vertices[edges.apex] - ends[:, 0]).detach().sign()
    toward = dark[:, None] * (plane @ cells.axes[:, :2])
    return torch.cat([flat, (flat[:, 0] + toward)[:, None]], 1)


def _edge_ray_fractions(
    edges: _ShadowingEdges, vertices: Tensor, observers: Tensor, cells: PanelCells
) -> Float64[Tensor, "row 2"]:
    """Where ends of edges lie on the way from their places to the panel's plane: 0 to 1."""
    normal = cells.axes[:, 2]
    height = (observers[edges.observer] - cells.center) @ normal
    ends = ((vertices[edges.ends] - cells.center) @ normal) / height[:, None]
    return 1 - (ends[:, :1] + edges.interval * (ends[:, 1:] - ends[:, :1]))


def _shadow_distances(
    shadows: Float64[Tensor, "row 3 2"], points: Float64[Tensor, "row 2"]
) -> tuple[Float64[Tensor, " row"], Float64[Tensor, "row 2"]]:
    """How far points are from the ends of shadows, positive in the light, and unit normals.

    Args:
        shadows: from ``_project_edges``.
        points: a point each, in the panel's plane [m].
    """
    start, end, dark = shadows.unbind(1)
    side = end - start
    length = side.norm(dim=1).clamp_min(1e-300)
    across = torch.stack([side[:, 1], -side[:, 0]], 1) / length[:, None]
    across = across * -((dark - start) * across).sum(1).detach().sign()[:, None]
    offset = points - start
    aside = (offset * across).sum(1)
    along = (offset * side).sum(1) / length
    beyond = along - along.clamp_min(0).minimum(length)
    past = beyond.detach() != 0
    # Past the end of an edge its shadow is a corner.
    far = torch.where(past, aside.square() + beyond.square(), 1.0).sqrt()
    sign = torch.where(aside.detach() < 0, -1.0, 1.0)
    return torch.where(past, sign * far, aside), across


def _select_visible_edges(
    rays: Occluders, vertices: Tensor, observers: Tensor, cells: PanelCells, edges: _ShadowingEdges
) -> _ShadowingEdges:
    """Edges that nothing hides from their places, where their shadows are nearest to the panel.

    On the panel itself nothing else may shade the lit side of the line.
    """
    if not len(edges.observer):
        return edges
    shadows = _project_edges(edges, vertices, observers, cells)
    start, end, _ = shadows.unbind(1)
    side = end - start
    along = (-(start * side).sum(1) / side.square().sum(1).clamp_min(1e-300)).clamp(0, 1)
    nearest = start + along[:, None] * side
    _, across = _shadow_distances(shadows, nearest)
    spot = observers[edges.observer]
    foot = cells.center + nearest @ cells.axes[:, :2].T
    step = _RAY_OFFSET * (foot - spot).norm(dim=1, keepdim=True) * (across @ cells.axes[:, :2].T)
    # Where the edge lies on the way from the place to its shadow.
    first, last = _edge_ray_fractions(edges, vertices, observers, cells).unbind(1)
    until = 1 / ((1 - along) / first + along / last)
    until = torch.where(nearest.norm(dim=1) <= cells.radius, 1.0, until)
    free = is_visible(rays, spot, spot + until[:, None] * (foot + step - spot))
    return edges.select(torch.nonzero(free)[:, 0])


def _test_cell_centers(
    rays: Occluders, observers: Tensor, cells: PanelCells, edges: _ShadowingEdges, vertices: Tensor
) -> Bool[Tensor, "place cell"]:
    """Whether places see the centres of cells: all are tried where a shadow may end among them."""
    none = torch.zeros(len(edges.observer), 2, dtype=torch.float64)
    distance, _ = _shadow_distances(_project_edges(edges, vertices, observers, cells), none)
    mixed = torch.zeros(len(observers), dtype=torch.bool)
    mixed[edges.observer[distance.abs() <= cells.radius]] = True
    middle = is_visible(rays, observers, cells.center.expand_as(observers))
    found = middle[:, None].expand(-1, len(cells.offsets)).clone()
    rows = torch.nonzero(mixed)[:, 0]
    if len(rows):
        count = len(cells.offsets)
        start = observers[rows].repeat_interleave(count, 0)
        found[rows] = is_visible(rays, start, cells.centers.repeat(len(rows), 1)).view(-1, count)
    return found


def _match_cells_to_edges(
    edges: _ShadowingEdges,
    is_visible: Tensor,
    projection_args: tuple[Tensor, Tensor, PanelCells],
    blur: float,
) -> tuple[Int64[Tensor, " cut"], Int64[Tensor, " cut"]]:
    """Which cells the end of a shadow cuts: rows of edges, and cells.

    Of several lines the nearest counts that has the cell's centre on the side that rays find.
    """
    cells, count = projection_args[2], is_visible.shape[1]
    span = torch.tensor(cells.size, dtype=torch.float64)
    best = torch.full_like(is_visible, torch.inf, dtype=torch.float64).ravel()
    held: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
    for some in torch.arange(len(edges.observer)).split(max(1, _PAIRS_AT_ONCE // count)):
        own = edges.select(some)
        shadows = _project_edges(own, *projection_args).repeat_interleave(count, 0)
        distance, across = _shadow_distances(shadows, cells.offsets.repeat(len(some), 1))
        reach = 0.5 * ((across.abs() * span).sum(1) + blur)
        where = (own.observer[:, None] * count + torch.arange(count)).ravel()
        agrees = (distance >= 0) == is_visible.ravel()[where]
        near = torch.nonzero(agrees & (distance.abs() < reach))[:, 0]
        held.append((some[near // count], near % count, where[near], distance[near].abs()))
    if not held:
        return torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.int64)
    row, cell, where, far = (torch.cat(column) for column in zip(*held, strict=True))
    best = best.scatter_reduce(0, where, far, "amin")
    nearest = torch.nonzero(far <= best[where])[:, 0]
    # Of lines that are as near as each other, the first.
    order = nearest[where[nearest].argsort(stable=True)]
    first = torch.ones(len(order), dtype=torch.bool)
    first[1:] = where[order][1:] != where[order][:-1]
    return row[order[first]], cell[order[first]]
