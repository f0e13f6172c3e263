"""Initial estimates of pose, size and density from detections and backprojection.

Detections or backprojected power give the position of an object, a rectangle in the ground plane
its heading. The fit refines them. Not differentiable.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from scipy.ndimage import map_coordinates
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor

from invertwin.capture import Capture, backproject
from invertwin.channel import Grid, Sampling
from invertwin.checks import ArrayLike, checked_number
from invertwin.errors import InputError
from invertwin.radar import Radar, Surrogate, ordered_statistics_cfar, peaks, surrogate_spectrum
from invertwin.runtime.memory import require_at_most
from invertwin.scene import DensityGrid, Object, Scene, rigid, rotation_from_vector
from invertwin.scene.shape_models.lattice import Lattice

_YAW_COUNT = 91  # candidate yaws of a rectangle over a quarter turn
_TRIMMED_FRACTION = 0.02  # fraction of the points beyond a side of a rectangle
_MAX_NODES_PER_SIDE = 1e6  # nodes along a side of an image; the lattice has its own limits
_CFAR_RANK = 0.25  # rank among the training cells, most of which may contain the target
_POINTS_PER_CHUNK = 20_000  # points of an image per chunk


@dataclass(frozen=True, eq=False)
class GroundRectangle:
    """Rectangle of an object on the ground, the plane of x and y.

    Attributes:
        center: middle of the points' extents in world axes [m].
        yaw: rotation of its sides about z [rad], in [0, π/2) from a fit.
        size: side lengths at yaw 0 along x and along y [m].
    """

    center: Float64[Tensor, "3"]
    yaw: float
    size: tuple[float, float]


def detect_echoes(
    capture: Capture, grid: Grid, low: ArrayLike, high: ArrayLike, *, false_alarm: float = 1e-6
) -> Float64[Tensor, "point 3"]:
    """Find echoes within a box of the world by ordered-statistics CFAR and its local maxima.

    Along an axis that the grid does not resolve, points lie in the radar's middle plane.

    Args:
        capture: recorded data.
        grid: bins of its maps.
        low, high: opposite corners of the box [m].
        false_alarm: probability that a cell of noise is detected.

    Raises:
        InputError: nothing is detected within the box, or it has no volume.
    """
    box = Lattice.from_bounds(low, high, (2, 2, 2))
    power = capture.spectrum(grid).detach().double()
    # A frame at a time: the training cells of all take much memory.
    detections = [
        ordered_statistics_cfar(frame, false_alarm=false_alarm, rank=_CFAR_RANK)
        for frame in power.amax(3)
    ]
    found = peaks(power, torch.stack(detections), capture.radar(), grid).position
    inside = (found >= box.low) & (found <= box.high)
    if (height := _unresolved_height(capture.radar(), grid)) is not None:
        inside[:, height] = True
    kept = found[inside.all(1)]
    if not len(kept):
        raise InputError(
            f"expected echoes within the box from {box.low.tolist()} to {box.high.tolist()}, got "
            f"none of {len(found)} detections there; enlarge the box or raise false_alarm"
        )
    return kept


def backproject_power(
    capture: Capture, grid: Grid, points: Float64[Tensor, "*point 3"]
) -> Float64[Tensor, "*point"]:
    """Backproject power to points of the world, with the spreading loss removed.

    The mean over frames of the maps at the point's range and direction, times the fourth power of
    its distance; without resolved directions, the coherent sum over frames (``backproject``).

    Args:
        capture: recorded data.
        grid: bins of its maps.
        points: positions in world axes [*point, 3] [m].
    """
    maps = None
    if grid.u_count > 1 or grid.v_count > 1:
        maps = capture.spectrum(grid).detach().double()
    parts = [
        backproject(capture, part).abs().square()
        if maps is None
        else _incoherent_power(maps, capture.radar(), grid, part)
        for part in points.reshape(-1, 3).split(_POINTS_PER_CHUNK)
    ]
    return torch.cat(parts).reshape(points.shape[:-1])


def find_bright_nodes(
    capture: Capture,
    grid: Grid,
    low: ArrayLike,
    high: ArrayLike,
    *,
    step: float,
    fraction: float = 0.3,
) -> Float64[Tensor, "point 3"]:
    """Find the nodes of a backprojected image above a fraction of its maximum.

    Args:
        capture: recorded data.
        grid: bins of its maps.
        low, high: opposite corners of the image in the world [m].
        step: approximate distance of neighbouring nodes [m].
        fraction: minimum brightness of a node relative to the maximum.

    Raises:
        InputError: a box without volume or echoes, or a step that is not positive.
    """
    size = torch.as_tensor(high, dtype=torch.float64) - torch.as_tensor(low, dtype=torch.float64)
    width = checked_number(step, "step of the image [m]", 0.0, open_low=True)
    most = float(size.max()) / width
    do = "give metres, or a larger step"
    require_at_most(most, _MAX_NODES_PER_SIDE, "nodes along a side", do, "step")
    counts = [max(2, round(float(side) / width) + 1) for side in size]
    nodes = Lattice.from_bounds(low, high, counts).nodes
    if (height := _unresolved_height(capture.radar(), grid)) is not None:
        # Heights are not resolved: use the plane in the middle.
        nodes = nodes.mean(height, keepdim=True)
    image = _require_echoes(backproject_power(capture, grid, nodes))
    return nodes[image >= fraction * image.max()]


def label_groups(points: Float64[Tensor, "point axis"], gap: float) -> Int64[Tensor, " point"]:
    """Label the groups of points linked by steps of at most a gap.

    Args:
        points: positions [point, axis] [m], or in units of the gap.
        gap: longest step between linked points.
    """
    tree = KDTree(points.numpy())
    # Distances of zero are no entries of the sparse matrix; each point is a node anyway.
    _, label = connected_components(tree.sparse_distance_matrix(tree, gap), directed=False)
    return torch.from_numpy(label.astype("int64"))


def find_largest_group(points: Float64[Tensor, "point 3"], gap: float) -> Float64[Tensor, "part 3"]:
    """Find the largest set of points linked by steps of at most a gap [m].

    Args:
        points: positions [point, 3] [m].
        gap: longest step between linked points [m].
    """
    labels = label_groups(points, gap)
    return points[labels == torch.bincount(labels).argmax()]


def yaw_rotation(yaw: float) -> Float64[Tensor, "3 3"]:
    """Return the rotation by a yaw [rad] about z.

    Args:
        yaw: angle, positive from x towards y [rad].
    """
    return rotation_from_vector(torch.tensor([0.0, 0.0, yaw], dtype=torch.float64))


def fit_rectangle(
    points: Float64[Tensor, "point 3"], radar: Radar, *, resolution: float = 0.1
) -> GroundRectangle:
    """Fit a rectangle in the ground plane to points on its near sides, an L shape.

    A search over the yaws of a quarter turn maximises the closeness of the points to the two sides
    that face the radar, Σ 1/max(distance, resolution).

    Source: Zhang et al., Efficient L-shape fitting for vehicle detection using laser scanners,
    2017, the closeness criterion.
    Differs from the source: only the sides that face the radar count, and they exclude a fiftieth
    of the points, since radar detections scatter.

    Args:
        points: positions in world axes [point, 3] [m].
        radar: radar whose positions determine the near sides.
        resolution: distance below which points count as on a side [m].

    Raises:
        InputError: fewer than three points.
    """
    if len(points) < 3:
        raise InputError(f"expected at least 3 points, got {len(points)}; use pose = 'position'")

    def score(found: GroundRectangle) -> float:
        axes = yaw_rotation(found.yaw)[:, :2]
        offsets = (points - found.center) @ axes
        away = (radar.positions.detach().mean(0) - found.center) @ axes
        half = torch.tensor(found.size).double() / 2
        # The side that faces the radar, or the nearer one for a radar in line with both.
        near = half - offsets * torch.where(away < 0, -1.0, 1.0)
        nearest = torch.minimum(half - offsets, half + offsets)
        sides = torch.where(away.abs() > half, near, nearest).abs().amin(1)
        return float((1 / sides.clamp_min(resolution)).sum())

    yaws = torch.linspace(0, math.pi / 2, _YAW_COUNT, dtype=torch.float64)[:-1].tolist()
    return max((_bounding_rectangle(points, yaw) for yaw in yaws), key=score)


def principal_rectangle(points: Float64[Tensor, "point 3"]) -> GroundRectangle:
    """Fit a rectangle along the points' principal axes in the ground plane.

    Args:
        points: positions [point, 3] [m].
    """
    _, axes = torch.linalg.eigh(torch.cov(points[:, :2].T))
    x, y = axes[:, 1].tolist()
    return _bounding_rectangle(points, math.atan2(y, x))


def estimate_position(points: Float64[Tensor, "point 3"]) -> Float64[Tensor, "3"]:
    """Estimate a position [m]: the median of the points along each axis."""
    return points.median(0).values


def candidate_poses(
    item: Object, rectangle: GroundRectangle, radar: Radar
) -> list[Float64[Tensor, "4 4"]]:
    """Return the four poses of an object of known size in a rectangle.

    Its upright attitude and its height are kept. Sides that face the radar are aligned with the
    rectangle, so that the hidden part of the object lies behind; along an axis without such a side
    the middles agree. A rectangle does not distinguish front from back, nor always length from
    width: ``select_pose`` selects.

    Args:
        item: object whose present pose gives attitude and height.
        rectangle: rectangle around its points.
        radar: radar with its positions.
    """
    center, start = item.center.detach(), item.transform.detach()
    level, where = item.vertices.detach() - center, radar.positions.detach().mean(0)
    axes = yaw_rotation(rectangle.yaw)[:, :2]
    half = torch.tensor(rectangle.size).double() / 2
    away = (where - rectangle.center) @ axes
    poses = []
    for quarter in range(4):
        rotation = yaw_rotation(rectangle.yaw + quarter * math.pi / 2)
        own = (level @ rotation.T) @ axes
        # Middle of the object whose near side is that of the rectangle.
        near = torch.where(away > 0, half - own.amax(0), -half - own.amin(0))
        middle = -0.5 * (own.amax(0) + own.amin(0))
        position = rectangle.center + axes @ torch.where(away.abs() > half, near, middle)
        position[2] = center[2]
        poses.append(rigid(rotation, position - rotation @ center) @ start)
    return poses


def select_pose(
    scene: Scene,
    name: str,
    poses: Sequence[Float64[Tensor, "4 4"]],
    radar: Radar,
    capture: Capture,
    grid: Grid,
    *,
    loss: Callable[[Tensor, Tensor], Tensor],
    surrogate: Surrogate,
    samples: int = 100_000,
    seed: int = 0,
) -> tuple[Scene, list[float]]:
    """Select the pose whose simulated map is nearest to the data; also return all losses.

    Args:
        scene: scene with the object at any pose.
        name: name of the object.
        poses: candidate poses.
        radar: radar of the capture.
        capture: recorded data.
        grid: bins to compare.
        loss: (simulated, measured) → number.
        surrogate: kernels; added widths make the selection robust.
        samples: number of rays of one simulation.
        seed: seed of the samples.

    Raises:
        InputError: no poses.
    """
    if not poses:
        raise InputError("expected at least one pose, got none; use candidate_poses")
    measured = surrogate.blur(capture.spectrum(grid).float(), radar, grid)
    scenes = [scene.replace(name, pose=pose) for pose in poses]
    losses, sampling = [], Sampling(depth=1, samples=samples, boundary_samples=0)
    with torch.no_grad():
        for moved in scenes:
            found = surrogate_spectrum(moved, radar, grid, surrogate, sampling=sampling, seed=seed)
            losses.append(float(loss(found, measured)) if bool(found.any()) else math.inf)
    return scenes[losses.index(min(losses))], losses


def estimate_scale(item: Object, rectangle: GroundRectangle) -> float:
    """Estimate a scale: the longer side of a rectangle over that of an object.

    The longer side is visible from most positions; the far end of the other is often hidden.

    Args:
        item: object of known shape.
        rectangle: rectangle around its points.
    """
    extent = item.vertices.detach()[:, :2]
    return max(rectangle.size) / float((extent.amax(0) - extent.amin(0)).max())


def estimate_density(
    capture: Capture,
    grid: Grid,
    item: Object,
    name: str,
    low: ArrayLike,
    high: ArrayLike,
    counts: Sequence[int],
) -> DensityGrid:
    """Estimate a density proportional to the backprojected power.

    At the strongest echo, the optical depth of one node spacing is one.

    Args:
        capture: recorded data.
        grid: bins of its maps.
        item: object whose pose carries the box.
        name: name of the object.
        low, high: opposite corners of the box in the object's frame [m].
        counts: number of nodes along x, y and z.

    Raises:
        InputError: no echoes in the box.
    """
    lattice = Lattice.from_bounds(low, high, counts)
    pose = item.transform.detach()
    places = lattice.nodes @ pose[:3, :3].T + pose[:3, 3]
    image = _require_echoes(backproject_power(capture, grid, places))
    return DensityGrid(name, low, high, 1 / float(lattice.spacing.mean()) * image / image.max())


def _bounding_rectangle(points: Tensor, yaw: float) -> GroundRectangle:
    """Return the rectangle at a yaw around all but the outermost points."""
    axes = yaw_rotation(yaw)[:, :2]
    middle = points.median(0).values
    places = (points - middle) @ axes
    ends = (_TRIMMED_FRACTION, 1 - _TRIMMED_FRACTION)
    low, high = (torch.quantile(places, end, dim=0) for end in ends)
    center = middle + axes @ ((low + high) / 2)
    first, second = (high - low).tolist()
    return GroundRectangle(center, yaw, (first, second))


def _incoherent_power(maps: Tensor, radar: Radar, grid: Grid, points: Tensor) -> Tensor:
    """Return the mean over frames of the maps at the points, times R⁴."""
    link, origins = radar.link(), radar.origins
    total = torch.zeros(len(points), dtype=torch.float64)
    for frame in range(radar.frame_count):
        to_tx, to_rx = (points - place[frame].detach() for place in (link.tx, link.rx))
        ranges = 0.5 * (to_tx.norm(dim=1) + to_rx.norm(dim=1))
        seen = (to_rx / to_rx.norm(dim=1, keepdim=True)) @ link.rotations[frame].detach()
        places = (
            (ranges - origins[frame] - grid.range_start) / grid.range_step,
            (seen[:, 1] - grid.u_start) / grid.u_step * (grid.u_count > 1),
            (seen[:, 2] - grid.v_start) / grid.v_step * (grid.v_count > 1),
        )
        # Beyond the outer bins the map falls to zero within one bin.
        table, nodes = maps[frame].numpy(), torch.stack(places).numpy()
        sampled = map_coordinates(table, nodes, order=1, mode="grid-constant")
        total += torch.from_numpy(sampled) * ranges**4 * (seen[:, 0] > 0)
    return total / radar.frame_count


def _unresolved_height(radar: Radar, grid: Grid) -> int | None:
    """Return the world axis nearest to the radar's z axis, if directions have at most one axis."""
    if grid.u_count > 1 and grid.v_count > 1:
        return None
    return int(radar.link().rotations.detach()[0, :, 2].abs().argmax())


def _require_echoes(image: Tensor) -> Tensor:
    """Return an image, or raise an error if it is zero."""
    if not float(image.max()) > 0:
        raise InputError("expected echoes in the box, got none; move the box into the grid")
    return image
