"""Partial visibility: fractions of a flat panel's cells that observers see, differentiable.

The shadow of a scene on the plane of a panel ends at the projections of silhouette edges. A cell
that such a line crosses is partly illuminated: ``clamp(s/w + 1/2, 0, 1)``, with s the distance of
its centre from the line, positive on the illuminated side, and w its width across the line. Rays
determine the illuminated side, and are detached; s carries the derivatives with respect to the
observer, the panel and the vertices.

Source: derivations §12.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from invertwin.channel.em.plane_waves import cross, dot
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.ray_scene import Occluders, is_visible
from invertwin.channel.rays.scene_tables import connect_surfaces
from invertwin.channel.rays.topology import Topology
from invertwin.channel.rows import Rows, concatenate_rows
from invertwin.checks import strip_derivatives
from invertwin.scene import Scene

_PAIRS_AT_ONCE = 1 << 21  # edges × observers, or edges × cells, per chunk
_MAX_EDGE_LEVEL = 0.999  # of the observer's height; higher edges cast no shadow
_RAY_OFFSET = 1e-4  # of the distance: lateral offset of rays past an edge
_COPLANAR_TOLERANCE = 1e-9  # of lengths: an apex in the plane of observer and edge


@dataclass(frozen=True)
class PanelCells:
    """Equal rectangular cells of a flat panel.

    Attributes:
        center: centre of the panel in world axes [m].
        axes: normal and panel axes y, z as columns, in world axes.
        offsets: centres of the cells along y and z [m].
        size: size of a cell along y and z [m].
    """

    center: Float64[Tensor, "3"]
    axes: Float64[Tensor, "3 3"]
    offsets: Float64[Tensor, "cell 2"]
    size: tuple[float, float]

    @property
    def centers(self) -> Float64[Tensor, "cell 3"]:
        """Centres of the cells in world axes [m]."""
        return self.center + self.offsets @ self.axes[:, 1:].T

    @property
    def radius(self) -> float:
        """Distance from the centre to the farthest corner [m]."""
        half = 0.5 * torch.tensor(self.size, dtype=torch.float64)
        return float((strip_derivatives(self.offsets).abs() + half).norm(dim=1).max())


@dataclass(frozen=True)
class _ShadowingEdges(Rows):
    """Edges that may cast shadow boundaries, one row per edge and observer.

    Attributes:
        observer: number of the observer.
        ends: numbers of the end vertices.
        apex: vertex of an adjacent triangle, on the shadowed side.
        interval: part of the edge that casts the shadow, from 0 to 1.
    """

    observer: Int64[Tensor, " row"]
    ends: Int64[Tensor, "row 2"]
    apex: Int64[Tensor, " row"]
    interval: Float64[Tensor, "row 2"]


def visible_fractions(
    scene: Scene,
    observers: Float64[Tensor, "place 3"],
    cells: PanelCells,
    *,
    blur: float = 0.0,
    boundary: bool = True,
) -> Float64[Tensor, "place cell"]:
    """Compute the fraction of each cell that observers in front of the panel see.

    All surfaces of the scene are opaque, sheets included. Fractions of cells that a single straight
    line crosses along the panel's axes are exact.

    Args:
        scene: occluders, without the panel.
        observers: positions of the observers in world axes [m].
        cells: cells of the panel.
        blur: width added to that of shadow boundaries [m]; 0 = width of a cell.
        boundary: False omits the derivatives due to moving shadows.

    Raises:
        InputError: a cloud among the objects.
    """
    topology, vertices = connect_surfaces(scene)
    fixed, origins = strip_derivatives(vertices), strip_derivatives(observers)
    center, axes, offsets = map(strip_derivatives, (cells.center, cells.axes, cells.offsets))
    panel = PanelCells(center, axes, offsets, cells.size)
    with tracing():
        rays = Occluders(fixed, topology, panel.center)
        edges = _find_silhouette_edges(fixed, topology, origins, panel, panel.radius + blur)
        edges = _select_visible_edges(rays, fixed, origins, panel, edges)
        visible = _test_cell_centers(rays, origins, panel, edges, fixed)
        row, cell = _match_cells_to_edges(edges, visible, (fixed, origins, panel), blur)
    fractions = visible.to(torch.float64)
    if not len(row):
        return fractions
    geometry = (vertices, observers, cells) if boundary else (fixed, origins, panel)
    edges = edges.select(row)
    offsets = geometry[2].offsets[cell]
    distance, normal = _shadow_distances(_project_edges(edges, *geometry), offsets)
    cell_size = torch.tensor(cells.size, dtype=torch.float64)
    fraction = distance / ((normal.abs() * cell_size).sum(-1) + blur) + 0.5
    return fractions.index_put((edges.observer, cell), fraction.clamp(0.0, 1.0))


def _find_silhouette_edges(
    vertices: Tensor, topology: Topology, observers: Tensor, cells: PanelCells, reach: float
) -> _ShadowingEdges:
    """Find silhouette edges whose shadow boundaries lie within reach of the panel's centre."""
    normal = cells.axes[:, 0]
    found: list[_ShadowingEdges] = []
    count = len(topology.edges)
    for rows in torch.arange(len(observers)).split(max(1, _PAIRS_AT_ONCE // max(1, count))):
        start, end = vertices[topology.edges].unbind(1)
        observer = observers[rows, None]
        plane = cross(start - observer, (end - start).expand(len(rows), -1, -1))
        apexes = topology.edge_apexes.T[:, None]
        offset = vertices[apexes.clamp_min(0)] - start
        side = (plane * offset).sum(-1)
        coplanar = side.abs() <= _COPLANAR_TOLERANCE * plane.norm(dim=-1) * offset.norm(dim=-1)
        table = torch.where(coplanar | (apexes < 0), 0.0, side.sign())
        silhouette = (table.sum(0).abs() == table.abs().sum(0)) & (table.abs().sum(0) > 0)
        # Part of the edge between the panel's plane and the observer.
        height = (observer - cells.center) @ normal
        heights = torch.stack([(end_ - cells.center) @ normal for end_ in (start, end)])
        level = heights[:, None] / torch.where(height > 0, height, torch.inf)[None]
        first, slope = level[0], level[1] - level[0]
        safe = torch.where(slope == 0, 1.0, slope)
        bounds = torch.stack([-first / safe, (_MAX_EDGE_LEVEL - first) / safe])
        inside = (first >= 0) & (first <= _MAX_EDGE_LEVEL)
        low = torch.where(slope == 0, torch.where(inside, 0.0, 1.0), bounds.amin(0)).clamp_min(0)
        high = torch.where(slope == 0, torch.where(inside, 1.0, 0.0), bounds.amax(0)).clamp_max(1)
        observer_row, edge = torch.nonzero(silhouette & (height > 0) & (low < high)).T
        side_number = table.abs()[:, observer_row, edge].argmax(0)
        interval = torch.stack([low[observer_row, edge], high[observer_row, edge]], 1)
        apex = topology.edge_apexes[edge, side_number]
        found.append(_ShadowingEdges(rows[observer_row], topology.edges[edge], apex, interval))
    edges = concatenate_rows(found)
    none = torch.zeros(len(edges.observer), 2, dtype=torch.float64)
    distance, _ = _shadow_distances(_project_edges(edges, vertices, observers, cells), none)
    return edges.select(torch.nonzero(distance.abs() <= reach)[:, 0])


def _project_edges(
    edges: _ShadowingEdges, vertices: Tensor, observers: Tensor, cells: PanelCells
) -> Float64[Tensor, "row 3 2"]:
    """Project both ends of edges onto the panel's plane, with a point on the shadowed side [m].

    The third point lies beside the line on the shadowed side: the apex may have no projection.
    """
    observer = observers[edges.observer]
    ends = vertices[edges.ends]
    points = ends[:, :1] + edges.interval[:, :, None] * (ends[:, 1] - ends[:, 0])[:, None]
    fraction = _edge_ray_fractions(edges, vertices, observers, cells)
    projection = observer[:, None] + (points - observer[:, None]) / fraction[..., None]
    planar = (projection - cells.center) @ cells.axes[:, 1:]
    # The normal of the plane of observer and edge determines the shadowed side.
    plane = cross(points[:, 0] - observer, points[:, 1] - observer)
    sign = dot(plane, vertices[edges.apex] - ends[:, 0]).detach().sign()
    shadow_side = sign[:, None] * (plane @ cells.axes[:, 1:])
    return torch.cat([planar, (planar[:, 0] + shadow_side)[:, None]], 1)


def _edge_ray_fractions(
    edges: _ShadowingEdges, vertices: Tensor, observers: Tensor, cells: PanelCells
) -> Float64[Tensor, "row 2"]:
    """Positions of edge ends between observer and panel's plane, from 0 to 1."""
    normal = cells.axes[:, 0]
    height = (observers[edges.observer] - cells.center) @ normal
    ends = ((vertices[edges.ends] - cells.center) @ normal) / height[:, None]
    return 1 - (ends[:, :1] + edges.interval * (ends[:, 1:] - ends[:, :1]))


def _shadow_distances(
    shadows: Float64[Tensor, "row 3 2"], points: Float64[Tensor, "row 2"]
) -> tuple[Float64[Tensor, " row"], Float64[Tensor, "row 2"]]:
    """Distances of points from shadow boundaries, positive outside the shadow, and unit normals.

    Args:
        shadows: result of ``_project_edges``.
        points: one point a row, in the panel's plane [m].
    """
    start, end, dark = shadows.unbind(1)
    side = end - start
    length = side.norm(dim=1).clamp_min(1e-300)
    normal = torch.stack([side[:, 1], -side[:, 0]], 1) / length[:, None]
    normal = normal * -((dark - start) * normal).sum(1).detach().sign()[:, None]
    offset = points - start
    distance = (offset * normal).sum(1)
    projection = (offset * side).sum(1) / length
    beyond = projection - projection.clamp_min(0).minimum(length)
    is_beyond = beyond.detach() != 0
    # Beyond the end of an edge the shadow has a corner.
    corner_distance = torch.where(is_beyond, distance.square() + beyond.square(), 1.0).sqrt()
    sign = torch.where(distance.detach() < 0, -1.0, 1.0)
    return torch.where(is_beyond, sign * corner_distance, distance), normal


def _select_visible_edges(
    rays: Occluders, vertices: Tensor, observers: Tensor, cells: PanelCells, edges: _ShadowingEdges
) -> _ShadowingEdges:
    """Keep edges visible from their observers, at the point whose shadow is nearest to the panel.

    On the panel itself, no other surface may shadow the illuminated side of the line.
    """
    if not len(edges.observer):
        return edges
    shadows = _project_edges(edges, vertices, observers, cells)
    start, end, _ = shadows.unbind(1)
    side = end - start
    fraction = (-(start * side).sum(1) / side.square().sum(1).clamp_min(1e-300)).clamp(0, 1)
    nearest = start + fraction[:, None] * side
    _, n = _shadow_distances(shadows, nearest)
    observer = observers[edges.observer]
    foot = cells.center + nearest @ cells.axes[:, 1:].T
    step = _RAY_OFFSET * (foot - observer).norm(dim=1, keepdim=True) * (n @ cells.axes[:, 1:].T)
    # Position of the edge between the observer and its shadow.
    first, last = _edge_ray_fractions(edges, vertices, observers, cells).unbind(1)
    limit = 1 / ((1 - fraction) / first + fraction / last)
    limit = torch.where(nearest.norm(dim=1) <= cells.radius, 1.0, limit)
    visible = is_visible(rays, observer, observer + limit[:, None] * (foot + step - observer))
    return edges.select(torch.nonzero(visible)[:, 0])


def _test_cell_centers(
    rays: Occluders, observers: Tensor, cells: PanelCells, edges: _ShadowingEdges, vertices: Tensor
) -> Bool[Tensor, "place cell"]:
    """Test if observers see the centres of cells, all of them where a shadow boundary may cross."""
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
    """Match cells to the shadow boundaries that cross them: rows of edges, and cells.

    Of several lines, the nearest with the cell's centre on the side found by rays is chosen.
    """
    cells, count = projection_args[2], is_visible.shape[1]
    cell_size = torch.tensor(cells.size, dtype=torch.float64)
    parts: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
    for rows in torch.arange(len(edges.observer)).split(max(1, _PAIRS_AT_ONCE // count)):
        chunk = edges.select(rows)
        shadows = _project_edges(chunk, *projection_args).repeat_interleave(count, 0)
        distance, normal = _shadow_distances(shadows, cells.offsets.repeat(len(rows), 1))
        reach = 0.5 * ((normal.abs() * cell_size).sum(1) + blur)
        pixel = (chunk.observer[:, None] * count + torch.arange(count)).ravel()
        agrees = (distance >= 0) == is_visible.ravel()[pixel]
        near = torch.nonzero(agrees & (distance.abs() < reach))[:, 0]
        parts.append((rows[near // count], near % count, pixel[near], distance[near].abs()))
    row, cell, pixel, away = (torch.cat(column) for column in zip(*parts, strict=True))
    # Of each cell the nearest line; of equally near ones, the first.
    order = away.argsort(stable=True)
    order = order[pixel[order].argsort(stable=True)]
    first = torch.ones(len(order), dtype=torch.bool)
    first[1:] = pixel[order][1:] != pixel[order][:-1]
    return row[order[first]], cell[order[first]]
