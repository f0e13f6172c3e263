"""CFAR detection of targets in power maps, and export of the points. Not differentiable."""

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from scipy.ndimage import maximum_filter
from scipy.optimize import brentq
from scipy.special import gammaincc, gammaincinv
from scipy.stats import beta, f
from torch import Tensor

from invertwin.channel import Grid
from invertwin.checks import check_choice, check_shape, checked_number, refuse_derivatives
from invertwin.errors import InputError
from invertwin.radar.processing.doppler import interpolate_peak, velocity_axis, velocity_span
from invertwin.radar.radar import Radar
from invertwin.radar.signal.chirps import Chirps
from invertwin.storage.folders import replace_file

_Maps = Float[Tensor, "frame range u v"]
_QUADRATURE = 4096  # quadrature nodes over the distribution of an order statistic
_Values = Float64[Tensor, " point"]  # one at every point


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Detected points, one row each.

    Attributes:
        frame: index of the radar pose of each point.
        range: range R = L/2 [m].
        velocity: range rate, positive for receding points [m/s].
        u, v: Direction cosines in the radar frame; 0 along an axis that is not resolved.
        power: power in the strongest direction, received over transmitted.
        position: position in the world [m], seen from the midpoint of the phase centres.
    """

    frame: Int64[Tensor, " point"]
    range: _Values
    velocity: _Values
    u: _Values
    v: _Values
    power: _Values
    position: Float64[Tensor, "point 3"]

    def __len__(self) -> int:
        return self.range.shape[0]


def cell_averaging_cfar(
    power: Float[Tensor, "*batch first second"],
    *,
    guard: tuple[int, int] = (2, 2),
    training: tuple[int, int] = (4, 4),
    false_alarm: float = 1e-4,
    looks: int = 1,
) -> Bool[Tensor, "*batch first second"]:
    """Detect cells whose power exceeds a multiple of the mean of their training cells.

    The multiple makes the false-alarm rate exact for independent noise in all cells. Its power is
    exponentially distributed for one look, such as a channel or a beam, or the mean of several
    looks, such as the channels averaged by a grid without directions. Tapers correlate neighbours
    and raise the rate. Near the edges of the map the multiple accounts for the smaller number of
    training cells.

    Args:
        power: maps over the last two axes, such as range rate and range.
        guard: number of guard cells to either side along both axes, which the target itself fills.
        training: number of training cells beyond those to either side.
        false_alarm: false-alarm probability of a cell of noise.
        looks: number of independent looks averaged in a cell.

    Raises:
        InputError: Power with gradients (a detection has none), values that are negative or not
            finite, no training cells, or a number out of range.
    """
    _check_rates(false_alarm, looks)
    band, numbers, index = _training_cells(power, guard, training, "cell_averaging_cfar")
    mean = torch.where(torch.isfinite(band), band, 0.0).sum(-1) / numbers[index]
    factors = f.isf(false_alarm, 2 * looks, 2 * looks * numbers.cpu().numpy())
    return power > torch.from_numpy(factors).to(mean)[index] * mean


def ordered_statistics_cfar(
    power: Float[Tensor, "*batch first second"],
    *,
    guard: tuple[int, int] = (2, 2),
    training: tuple[int, int] = (4, 4),
    false_alarm: float = 1e-4,
    looks: int = 1,
    rank: float = 0.75,
) -> Bool[Tensor, "*batch first second"]:
    """Detect cells whose power exceeds a multiple of one ranked training cell.

    Unlike in the mean, other targets among the training cells hardly raise the threshold.

    Source: Rohling, Radar CFAR thresholding in clutter and multiple target situations, 1983.

    Args:
        power: maps over the last two axes, such as range rate and range.
        guard, training, false_alarm, looks: As in ``cell_averaging_cfar``.
        rank: rank of the selected cell in ascending order, relative to their number.

    Raises:
        InputError: As ``cell_averaging_cfar``, or a rank outside (0, 1].
    """
    _check_rates(false_alarm, looks)
    checked_number(rank, "rank", 0.0, 1.0, open_low=True)
    band, numbers, index = _training_cells(power, guard, training, "ordered_statistics_cfar")
    places = (rank * numbers - 1e-9).ceil().long()
    # Other cells are infinite, so last in order.
    level = band.sort(-1).values.take_along_dim((places - 1)[index][..., None], -1)[..., 0]
    pairs = zip(numbers.tolist(), places.tolist(), strict=True)
    factors = [_ordered_factor(n, place, false_alarm, looks) for n, place in pairs]
    return power > torch.tensor(factors).to(level)[index] * level


def point_cloud(
    power: Float[Tensor, "frame velocity range u v"],
    detections: Bool[Tensor, "frame velocity range"],
    radar: Radar,
    grid: Grid,
    chirps: Chirps,
    fold: Int64[Tensor, "frame velocity range"] | None = None,
) -> PointCloud:
    """Return a point for each detected cell that is a local maximum over range rate and range.

    A point has the strongest direction with u² + v² ≤ 1. Along each axis its position is refined by
    the parabola through the logarithms of the power at the peak and its two neighbours.

    Args:
        power: power from ``range_doppler_angle``.
        detections: mask of detected cells.
        radar: radar with the poses of the frames.
        grid: Bins of the power.
        chirps: timing that determines the range rates.
        fold: as passed to ``range_doppler_angle``.

    Raises:
        InputError: Power with gradients, or shapes that do not fit each other.
    """
    expected = (radar.frame_count, power.shape[1], *grid.shape)
    _check_map(power, detections, expected, "frame, velocity, range, u, v", "point_cloud")
    power, detections = power.to("cpu", torch.float64), detections.cpu()
    count = power.shape[1]
    seen = power.masked_fill(~grid.in_visible_region, 0.0).flatten(3)
    strongest = seen.amax(-1)
    # The axis of range rates is periodic.
    ends = ("nearest", "wrap", "nearest")
    around = maximum_filter(strongest.numpy(), (1, 3, 3), mode=ends)  # type: ignore[arg-type]
    highest = strongest == torch.from_numpy(around)
    frame, velocity, place = torch.nonzero(detections & highest & (strongest > 0), as_tuple=True)
    direction = seen.argmax(-1)[frame, velocity, place]
    u, v = direction // grid.v_count, direction % grid.v_count
    cell = [frame, velocity, place, u, v]
    span = velocity_span(radar, chirps)
    rates = velocity_axis(radar, chirps, count)[velocity]
    rates = rates + _refinement(power, cell, 1, wrap=True) * span / count
    if fold is not None:
        rates = rates + fold.cpu()[frame, velocity, place] * span
    return _refine_points(power, cell, rates, radar, grid)


def peaks(
    power: _Maps, detections: Bool[Tensor, "frame range u"], radar: Radar, grid: Grid
) -> PointCloud:
    """Return a point for each detected cell that is a local maximum over range and direction.

    Use it for frames without range rates, such as the maps of a fit. Unlike in ``point_cloud``, one
    range may have many points, since parts of a static body may differ in direction alone.
    Positions are refined as in ``point_cloud``; range rates are zero.

    Args:
        power: power from ``exact_spectrum`` or ``Capture.spectrum``.
        detections: mask of detected cells at the strongest elevation.
        radar: radar with the poses of the frames.
        grid: Bins of the power.

    Raises:
        InputError: Power with gradients, or shapes that do not fit each other.
    """
    _check_map(power, detections, (radar.frame_count, *grid.shape), "frame, range, u, v", "peaks")
    seen = power.to("cpu", torch.float64).masked_fill(~grid.in_visible_region, 0.0)
    highest = torch.from_numpy(maximum_filter(seen.numpy(), (1, 3, 3, 3), mode="nearest"))
    found = detections.cpu()[..., None] & (seen == highest) & (seen > 0)
    frame, place, u, v = torch.nonzero(found, as_tuple=True)
    rates = torch.zeros(len(frame), dtype=torch.float64)
    cell = [frame, torch.zeros_like(frame), place, u, v]
    return _refine_points(seen[:, None], cell, rates, radar, grid)


def _check_map(
    power: Tensor, found: Tensor, expected: tuple[int, ...], axes: str, name: str
) -> None:
    _refuse_gradients(power, name)
    do = f"its axes are {axes}: use the radar and grid that the map was made with"
    check_shape(power, expected, "power", do)
    check_shape(found, expected[:3], "detections beside power", do)


def _refine_points(
    power: Tensor, cell: list[Tensor], rates: Tensor, radar: Radar, grid: Grid
) -> PointCloud:
    """Return points at the cells with interpolated ranges, directions and positions."""
    moved = [_refinement(power, cell, axis, wrap=False) for axis in range(2, 5)]
    frame, _, place, u, v = cell
    ranges = grid.ranges[place] + moved[0] * grid.range_step
    us, vs = grid.u[u] + moved[1] * grid.u_step, grid.v[v] + moved[2] * grid.v_step
    position = world_positions(radar, frame, ranges, us, vs)
    return PointCloud(frame, ranges, rates, us, vs, power[tuple(cell)], position)


def world_positions(
    radar: Radar, frame: Int64[Tensor, " point"], ranges: _Values, u: _Values, v: _Values
) -> Float64[Tensor, "point 3"]:
    """Return world positions of points in front of the radar [m].

    Args:
        radar: radar with the poses of the frames.
        frame: index of the pose of each point.
        ranges: ranges from the midpoint of the phase centres [m].
        u: direction cosines along the radar's y.
        v: direction cosines along the radar's z.
    """
    ahead = (1 - u.square() - v.square()).clamp(min=0).sqrt()
    link = radar.link()
    origin = (0.5 * (link.tx + link.rx)).detach().cpu()
    length = ranges + radar.origins.cpu()[frame]
    local = length[:, None] * torch.stack([ahead, u, v], dim=1)
    return origin[frame] + (link.rotations.detach().cpu()[frame] @ local[..., None])[..., 0]


def _refuse_gradients(power: Tensor, name: str) -> None:
    do = "a detection is not differentiable: pass power.detach(), and fit with the power itself"
    refuse_derivatives(power, f"power in {name}", do)


def _check_rates(false_alarm: float, looks: int) -> None:
    if not (0 < false_alarm < 1 and looks >= 1):
        raise InputError(
            "expected a false-alarm probability in (0, 1) and at least one look, got "
            f"{false_alarm:g} and {looks}; 1e-4 and 1 are usual"
        )


def _training_cells(
    power: Tensor, guard: tuple[int, int], training: tuple[int, int], name: str
) -> tuple[Float64[Tensor, "*batch first second cell"], Tensor, Tensor]:
    """Return the power of each cell's training cells, infinite beyond the map, and their numbers:
    all that occur, and the index of each cell's.
    """
    _refuse_gradients(power, name)
    values = power.to(torch.float64)
    if not (torch.isfinite(values).all() and (values >= 0).all()):
        raise InputError(
            "expected finite powers of at least 0, got others; pass the power, not the signal or dB"
        )
    if min(*guard, *training) < 0:
        raise InputError(
            f"expected guard and training cells of at least 0, got {guard} and {training}; give "
            "numbers of cells"
        )
    reach = [g + t for g, t in zip(guard, training, strict=True)]
    sizes = [2 * r + 1 for r in reach]
    beside = (reach[1], reach[1], reach[0], reach[0])
    around = torch.nn.functional.pad(values, beside, value=math.inf)
    around = around.unfold(-2, sizes[0], 1).unfold(-2, sizes[1], 1)
    offsets = [(torch.arange(size) - r).abs() for size, r in zip(sizes, reach, strict=True)]
    cells = around[..., (offsets[0][:, None] > guard[0]) | (offsets[1] > guard[1])]
    count = torch.isfinite(cells).sum(-1)
    if int(count.min()) < 1:
        raise InputError(
            f"expected training cells around every cell, got none around some of a map of "
            f"{tuple(values.shape[-2:])}; use fewer guard cells or more training cells"
        )
    return cells, *count.unique(return_inverse=True)


@lru_cache(maxsize=1024)
def _ordered_factor(cells: int, rank: int, false_alarm: float, looks: int) -> float:
    """Return the multiple of the ranked cell that noise exceeds with the given probability."""
    nodes = (np.arange(_QUADRATURE) + 0.5) / _QUADRATURE
    weights = beta.pdf(nodes, rank, cells - rank + 1)
    levels, weights = gammaincinv(looks, nodes), weights / weights.sum()

    def excess(factor: float) -> float:
        return math.log(float(weights @ gammaincc(looks, factor * levels)) / false_alarm)

    high = 1.0
    while excess(high) > 0:
        high *= 2
    return float(brentq(excess, 0.0, high, xtol=1e-9 * high))  # type: ignore[arg-type]


def _refinement(power: Tensor, cell: list[Tensor], axis: int, wrap: bool) -> _Values:
    """Return the sub-bin peak offset along one axis, within half a bin, 0 at an edge."""
    size, here = power.shape[axis], cell[axis]

    def level(step: int) -> Tensor:
        place = (here + step) % size if wrap else (here + step).clamp(0, size - 1)
        return power[tuple(place if k == axis else cell[k] for k in range(5))]

    before, middle, after = level(-1), level(0), level(1)
    inside = (middle >= before) & (middle >= after)
    if not wrap:
        inside &= (here > 0) & (here < size - 1)
    return torch.where(inside, interpolate_peak(before, middle, after), 0.0)


def save_points(path: str | Path, points: PointCloud) -> None:
    """Write points as binary PLY or PCD, one record each, the strongest first.

    Fields are ``x``, ``y``, ``z`` in the world [m], ``range`` [m], ``velocity`` [m/s], ``u``,
    ``v``, ``power`` [dB] and ``frame``, all as float32, which all readers of either format support.

    Args:
        path: output file, ending in .ply or .pcd, in an existing folder.
        points: points to write.

    Raises:
        InputError: Another suffix, or no such folder.
    """
    file = Path(path)
    headers, ending = {".ply": _ply_header, ".pcd": _pcd_header}, file.suffix.lower()
    check_choice(ending, headers, f"{file.name} to end in", "rename the output")
    columns = dict(zip("xyz", points.position.detach().cpu().numpy().T, strict=True))
    for name in ("range", "velocity", "u", "v", "power", "frame"):
        columns[name] = getattr(points, name).detach().cpu().numpy()
    order = np.argsort(-columns["power"], kind="stable")
    columns["power"] = 10 * np.log10(columns["power"])
    table = np.stack([values[order] for values in columns.values()], axis=1).astype("<f4")
    with replace_file(file) as part:
        header = headers[ending](list(columns), len(table))
        part.write_bytes(header.encode("ascii") + table.tobytes())


def _ply_header(fields: list[str], count: int) -> str:
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    return "\n".join([*lines, *(f"property float {name}" for name in fields), "end_header\n"])


def _pcd_header(fields: list[str], count: int) -> str:
    lines = ["VERSION 0.7", " ".join(["FIELDS", *fields])]
    for word, value in (("SIZE", "4"), ("TYPE", "F"), ("COUNT", "1")):
        lines.append(" ".join([word, *[value] * len(fields)]))
    lines += [f"WIDTH {count}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {count}"]
    return "\n".join([*lines, "DATA binary\n"])
