"""Reflectors of one frame, several per range, without their sidelobes."""

import math
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Complex, Complex128, Float, Float64, Int64
from scipy.ndimage import maximum_filter
from scipy.special import gammaincinv
from torch import Tensor

from invertwin.channel import Grid
from invertwin.radar.processing import detection, doppler
from invertwin.radar.processing.beamforming import beamform
from invertwin.radar.radar import Radar, require_sampled_waveform
from invertwin.radar.signal.chirps import Chirps
from invertwin.radar.signal.range_profile import range_profile
from invertwin.radar.waveform import unit_window
from invertwin.runtime.progress import track

# With fewer range rates the training cells lie along range alone, and half of them may contain
# other reflectors.
_MIN_RATES_2D = 13
_GUARD, _TRAINING, _RANK = (0, 4), (0, 16), 0.5
# Points below this factor of the sidelobe power of stronger reflectors are sidelobes.
_ABOVE_SIDELOBES = 4.0
# Minimum relative power of a further direction in one cell: gain and phase errors of a board's
# channels leave this residual.
_MIN_RELATIVE_POWER = 0.1
_BLOCK = 1024  # distances
_OUTSIDE_ECHOES = 32  # strongest echoes outside of the grid whose sidelobes count
_FALSE_DIRECTION_RATE = 1e-3
_Levels = Float64[Tensor, "velocity range"]  # mean over channels
_Beat = Complex[Tensor, "frame chirp tx rx sample"]  # of every ramp


def detect_points(
    beat: _Beat, radar: Radar, grid: Grid, chirps: Chirps | None, frame: int
) -> detection.PointCloud:
    """Detect the reflectors in one frame by CFAR.

    Detected cells of range and range rate are points, unless they are sidelobes of stronger points.
    Directions of a cell are extracted one by one, the strongest first, with a joint fit of all
    amplitudes, until the residual is noise or a tenth of the strongest (orthogonal matching
    pursuit); so one range may have several points.

    Args:
        beat: signals of all chirps of every transmitter, or of one chirp.
        radar: radar with one pose per frame.
        grid: ranges and directions of the search.
        chirps: chirp timing; None = one chirp, whose points have the range rate NaN.
        frame: index of the frame.
    """
    radar, signal = radar.frames([frame]), beat[frame : frame + 1]
    # What lies outside of the grid has sidelobes in it.
    period = math.floor(require_sampled_waveform(radar).max_range / grid.range_step + 1e-9)
    whole = replace(grid, range_count=max(grid.range_count, period))
    rates = torch.full((1, grid.range_count), math.nan, dtype=torch.float64)
    if chirps is None:
        cube = range_profile(signal[:, 0], radar, whole)[:, None]
    else:
        cube = doppler.range_doppler(signal, radar, whole, chirps)
    cube = cube.cpu()  # points are found one by one
    everywhere = cube[0].abs().square().double().mean((1, 2))
    flat, cube = everywhere[:, : grid.range_count], cube[..., : grid.range_count]
    if chirps is not None:
        offsets = doppler.interpolate_rates(flat)
        cube = doppler.compensate_tdm(cube, radar, chirps, offsets)
        span = doppler.velocity_span(radar, chirps)
        rates = doppler.velocity_axis(radar, chirps)[:, None] + offsets * span
    cube = cube[0].to(torch.complex128)
    looks = len(radar.virtual_positions)
    noise = noise_power(flat, looks)
    rows: list[list[float]] = []
    for v, r in track(_find_cells(everywhere, radar, grid, looks), "points"):
        near = [max(r - 1, 0), r, min(r + 1, grid.range_count - 1)]
        offset = float(doppler.interpolate_peak(*flat[v, near]))
        place = float(grid.ranges[r]) + offset * grid.range_step
        directions = _resolve_directions(cube[v, :, :, r], radar, grid, noise)
        rows += [[place, float(rates[v, r]), *direction] for direction in directions]
    table = torch.tensor(rows, dtype=torch.float64).reshape(-1, 5)
    ranges, found, u, v, power = table.T
    frames = torch.zeros(len(table), dtype=torch.int64)
    places = detection.world_positions(radar, frames, ranges, u, v)
    return detection.PointCloud(frames + frame, ranges, found, u, v, power, places)


def format_points_csv(points: detection.PointCloud) -> str:
    """Return one line per point, the strongest first."""
    lines = ["range_m,velocity_m_s,u,v,power_db,x_m,y_m,z_m"]
    levels = 10 * points.power.log10()
    columns = points.range, points.velocity, points.u, points.v, levels, *points.position.T
    table = torch.stack(columns, 1)[points.power.argsort(descending=True)]
    lines += [",".join(f"{value:.6g}" for value in row) for row in table.tolist()]
    return "\n".join(lines) + "\n"


def noise_power(power: Float[Tensor, "*cell"], looks: int, empty: float = 0.5) -> float:
    """Estimate the mean noise power from a quantile of cells: the median if half of them are empty.

    Args:
        power: power averaged over several looks.
        looks: number of independent looks.
        empty: fraction of cells without signal, the quantile.
    """
    level = float(power.double().flatten().kthvalue(math.ceil(empty * power.numel())).values)
    return level * looks / float(gammaincinv(looks, empty))


def _find_cells(everywhere: _Levels, radar: Radar, grid: Grid, looks: int) -> list[tuple[int, int]]:
    """Return the range-rate and range bins of reflectors, the strongest first.

    Args:
        everywhere: levels in the grid, then in the rest of the unambiguous range.
        radar: radar with its windows.
        grid: ranges of the search.
        looks: number of independent looks.
    """
    flat, rest = everywhere[:, : grid.range_count], everywhere[:, grid.range_count :]
    found = _threshold_cells(flat, looks) & _local_maxima(flat)
    places = torch.nonzero(found)
    places = places[flat[found].argsort(descending=True)]
    over_rates, over_ranges = _sidelobe_powers(len(flat), everywhere.shape[1], radar, grid)

    def sidelobes(offsets: Int64[Tensor, "cell 2"]) -> Float64[Tensor, " cell"]:
        return over_rates[offsets[:, 0] % len(flat)] * over_ranges[offsets[:, 1].abs()]

    reach, chosen = torch.zeros(len(places), dtype=torch.float64), []
    outside = torch.nonzero(_local_maxima(rest)) if rest.numel() else places[:0]
    outside = outside + torch.tensor([0, grid.range_count])
    levels = everywhere[*outside.T]
    for k in levels.argsort(descending=True)[:_OUTSIDE_ECHOES].tolist():
        reach += (levels[k] * sidelobes(places - outside[k])).sqrt()
    for i, (v, r) in enumerate(places.tolist()):
        if flat[v, r] <= _ABOVE_SIDELOBES * reach[i].square():
            continue
        chosen.append((v, r))
        reach += (flat[v, r] * sidelobes(places - places[i])).sqrt()
    return chosen


def _local_maxima(levels: _Levels) -> Bool[Tensor, "velocity range"]:
    around = maximum_filter(levels.numpy(), 3, mode=("wrap", "nearest"))  # type: ignore[arg-type]
    return (levels == torch.from_numpy(around)) & (levels > 0)


def _threshold_cells(flat: _Levels, looks: int) -> Bool[Tensor, "velocity range"]:
    if len(flat) >= _MIN_RATES_2D:
        return detection.cell_averaging_cfar(flat, looks=looks)
    how: Any = {"guard": _GUARD, "training": _TRAINING, "rank": _RANK, "looks": looks}
    return torch.cat([detection.ordered_statistics_cfar(row[None], **how) for row in flat])


def _sidelobe_powers(
    rate_count: int, range_count: int, radar: Radar, grid: Grid
) -> tuple[Float64[Tensor, " rate"], Float64[Tensor, " range"]]:
    """Return the highest sidelobe power of a point 0, 1, … range-rate and range bins away.

    A point is up to half a bin from the centre of its cell, where sidelobes are non-zero.
    """
    rates = torch.fft.fft(unit_window("hamming", rate_count), 2 * rate_count).abs().square()
    distance = (0.5 * grid.range_step * torch.arange(2 * range_count).double()).split(_BLOCK)
    response = [radar.waveform.range_response(part, radar.window) for part in distance]
    half_bins = rates.double(), torch.cat(response)
    found = [torch.stack([x[::2], x[1::2], x.roll(1)[::2]]).amax(0) for x in half_bins]
    return found[0], found[1]


def _resolve_directions(cell: Tensor, radar: Radar, grid: Grid, noise: float) -> list[list[float]]:
    """Return directions u, v and powers in one cell, the strongest first."""
    channels, left = cell.flatten(), cell
    one = replace(grid, range_start=0.0, range_count=1)
    seen = grid.in_visible_region
    least = -math.log(_FALSE_DIRECTION_RATE / float(seen.sum())) * noise / len(channels)
    places: list[tuple[float, float]] = []
    powers: list[float] = []
    for _ in range(max(1, len(channels) // 2)):
        power = beamform(left[None, :, :, None], radar, one)[0, 0].double() * seen
        at = int(power.argmax())
        u, v = float(grid.u[at // grid.v_count]), float(grid.v[at % grid.v_count])
        u, v = _refine_direction(left.flatten(), radar, grid, u, v)
        models = torch.stack([_plane_wave(radar, grid, *place) for place in [*places, (u, v)]], 1)
        amplitudes = torch.linalg.lstsq(models, channels[:, None]).solution
        found = amplitudes.abs().square()[:, 0].tolist()
        if powers and found[-1] < max(_MIN_RELATIVE_POWER * powers[0], least):
            break
        if any(_share_beam(radar, (u, v), place) for place in places):
            break
        places, powers = [*places, (u, v)], found
        left = (channels[:, None] - models @ amplitudes).reshape(cell.shape)
        if grid.u_count == grid.v_count == 1:
            break
    return [[*place, power] for place, power in zip(places, powers, strict=True)]


def _share_beam(radar: Radar, one: tuple[float, float], other: tuple[float, float]) -> bool:
    """Return whether two directions are less than a beamwidth apart."""
    du, dv = (abs(a - b) / w for a, b, w in zip(one, other, radar.beamwidth, strict=True))
    return math.hypot(du, dv) < 1


def _plane_wave(radar: Radar, grid: Grid, u: float, v: float) -> Complex128[Tensor, " channel"]:
    """Return the channels of a plane wave; an unresolved axis has no phase."""
    _, y, z = radar.virtual_positions.T
    path = u * y * (grid.u_count > 1) + v * z * (grid.v_count > 1)
    phase = -2 * math.pi / radar.waveform.wavelength * path.double()
    return torch.polar(torch.ones_like(phase), phase)


def _refine_direction(
    channels: Complex128[Tensor, " channel"], radar: Radar, grid: Grid, u: float, v: float
) -> tuple[float, float]:
    """Return the direction near one of the grid that maximises the coherent sum of the channels."""
    place = [u, v]
    for shrink in (1.0, 4.0):
        axes = ((grid.u_count, grid.u_step), (grid.v_count, grid.v_step))
        for axis, (count, width) in enumerate(axes):
            if count == 1:
                continue
            levels = []
            for step in (-1, 0, 1):
                moved = list(place)
                moved[axis] += step * width / shrink
                wave = _plane_wave(radar, grid, moved[0], moved[1])
                levels.append(torch.vdot(wave, channels).abs().square())
            place[axis] += float(doppler.interpolate_peak(*levels)) * width / shrink
    return max(-1.0, min(1.0, place[0])), max(-1.0, min(1.0, place[1]))
