"""Maps of one frame of chirps over range, range rate and direction, and where they peak."""

import math
from dataclasses import dataclass
from operator import attrgetter

import numpy as np
import torch
from jaxtyping import Complex, Float, Float64
from torch import Tensor

from invertwin.channel import Grid
from invertwin.progress import told
from invertwin.radar.detection import PointCloud, cell_averaging_cfar, point_cloud
from invertwin.radar.direction import capon, music
from invertwin.radar.doppler import (
    compensate_tdm,
    range_doppler,
    range_doppler_angle,
    velocity_axis,
)
from invertwin.radar.motion import Chirps
from invertwin.radar.radar import Radar
from invertwin.radar.spectrum import beamform

# Bins of range rate on either side of zero that a window spreads what stands still over.
_STILL_BINS = 2
_BINS_AT_ONCE = 2e7  # of range rate, range, u, v
_MOST_BINS = 1e8  # of range rate, range, u, v that are searched for points


@dataclass(frozen=True)
class Peak:
    """The strongest cell of a map.

    Attributes:
        range: [m].
        velocity: Range rate, positive moves away [m/s].
        u, v: Direction cosines to the right and up; 0 where not resolved.
        power: Received over sent, or in squared counts.
    """

    range: float
    velocity: float
    u: float
    v: float
    power: float

    def metrics(self, name: str) -> dict[str, float]:
        """Numbers for `metrics.json` whose keys start with a name."""
        return {
            f"{name}_range_m": self.range,
            f"{name}_velocity_m_s": self.velocity,
            f"{name}_u": self.u,
            f"{name}_v": self.v,
            f"{name}_azimuth_deg": math.degrees(math.asin(max(-1.0, min(1.0, self.u)))),
            f"{name}_power_db": 10 * math.log10(self.power) if self.power > 0 else -math.inf,
        }


@dataclass(frozen=True, eq=False)
class DopplerMaps:
    """One frame of a chirp train.

    Attributes:
        grid: Ranges and directions.
        velocities: Range rates [m/s].
        range_doppler: Mean power of the channels [velocity, range].
        everything: Power over range and direction, all range rates summed [range, u, v].
        movers: Power over range and direction without what stands still [range, u, v]; None = too
            few chirps.
        strongest: The strongest cell of all.
        mover: The strongest cell that moves.
    """

    grid: Grid
    velocities: Float64[Tensor, " velocity"]
    range_doppler: Float[Tensor, "velocity range"]
    everything: Float64[Tensor, "range u v"]
    movers: Float64[Tensor, "range u v"] | None
    strongest: Peak
    mover: Peak | None


def doppler_maps(
    beat: Complex[Tensor, "frame chirp tx rx sample"],
    radar: Radar,
    grid: Grid,
    chirps: Chirps,
    frame: int = 0,
) -> DopplerMaps:
    """Make range-Doppler and range-direction maps of one frame, with ``compensate_tdm``.

    Range rates are those of the unambiguous span.

    Args:
        beat: Chirps of every transmitter.
        radar: With one pose per frame.
        grid: Ranges and directions of the maps.
        chirps: Timing.
        frame: The frame that is shown.

    Raises:
        InputError: As ``range_doppler`` and ``beamform``.
    """
    radar = radar.frames([frame])
    cube = range_doppler(beat[frame : frame + 1], radar, grid, chirps)
    flat = cube.abs().square().mean((2, 3))[0]
    cube = compensate_tdm(cube, radar, chirps)[0]
    velocities = velocity_axis(radar, chirps)
    moving = (torch.arange(chirps.count) - chirps.count // 2).abs() > _STILL_BINS
    chunk = max(1, int(_BINS_AT_ONCE / math.prod(grid.shape)))
    everything, movers = torch.zeros(2, *grid.shape, dtype=torch.float64)
    peaks = []
    seen = (grid.u[:, None].square() + grid.v.square()) <= 1
    for rows in told(torch.arange(chirps.count).split(chunk), "range rates"):
        power = beamform(cube[rows], radar.frames([0] * len(rows)), grid).double() * seen
        everything += power.sum(0)
        movers += power[moving[rows]].sum(0)
        peaks += [
            peak_of(part, grid, float(rate))
            for part, rate in zip(power, velocities[rows], strict=True)
        ]
    fast = [peak for peak, moves in zip(peaks, moving, strict=True) if moves]
    strongest = max(peaks, key=attrgetter("power"))
    mover = max(fast, key=attrgetter("power"), default=None)
    shown = movers if fast else None
    return DopplerMaps(grid, velocities, flat, everything, shown, strongest, mover)


def sharp_map(
    profile: Complex[Tensor, "snapshot tx rx range"],
    radar: Radar,
    grid: Grid,
    method: str,
    sources: int | None,
) -> Float[Tensor, "range u v"]:
    """Capon or MUSIC over range and direction [range, u, v].

    Args:
        profile: Range profiles of one frame; bins of range rate whose transmitters' turns are
            compensated serve as snapshots, too.
        radar: Its array.
        grid: Directions.
        method: capon or music.
        sources: Number of sources for music; None = they are counted in each range.

    Raises:
        InputError: As ``capon`` and ``music``.
    """
    snapshots = profile[None].to(torch.complex128)
    if method == "capon":
        power = capon(snapshots, radar, grid)[0]
    else:
        power = music(snapshots, radar, grid, sources="mdl" if sources is None else sources)[0]
    return power * (grid.u[:, None].square() + grid.v.square() <= 1)


def snapshots_of(
    beat: Complex[Tensor, "frame chirp tx rx sample"],
    radar: Radar,
    grid: Grid,
    chirps: Chirps,
    frame: int,
) -> Complex[Tensor, "velocity tx rx range"]:
    """The bins of range rate of one frame as snapshots for `sharp_map`.

    Args:
        beat: Chirps of every transmitter.
        radar: With one pose per frame.
        grid: Its ranges are used.
        chirps: Timing.
        frame: The frame that is used.
    """
    radar = radar.frames([frame])
    cube = range_doppler(beat[frame : frame + 1], radar, grid, chirps, window="rectangular")
    return compensate_tdm(cube, radar, chirps)[0]


def points_of(
    beat: Complex[Tensor, "frame chirp tx rx sample"],
    radar: Radar,
    grid: Grid,
    chirps: Chirps,
    frame: int,
) -> PointCloud | None:
    """Detect points in one frame by a cell-averaging CFAR; None where the map is too large.

    Args:
        beat: Chirps of every transmitter.
        radar: With one pose per frame.
        grid: Ranges and directions that are searched.
        chirps: Timing.
        frame: The frame that is searched.
    """
    if chirps.count * math.prod(grid.shape) > _MOST_BINS:
        return None
    radar, signal = radar.frames([frame]), beat[frame : frame + 1]
    flat = range_doppler(signal, radar, grid, chirps).abs().square().mean((2, 3))
    detected = cell_averaging_cfar(flat, looks=len(radar.virtual_positions))
    power = range_doppler_angle(signal, radar, grid, chirps)
    return point_cloud(power, detected, radar, grid, chirps)


def points_csv(points: PointCloud) -> str:
    """One line per point, the strongest first."""
    lines = ["range_m,velocity_m_s,u,v,power_db,x_m,y_m,z_m"]
    for i in points.power.argsort(descending=True).tolist():
        level = 10 * math.log10(float(points.power[i]))
        values = [points.range[i], points.velocity[i], points.u[i], points.v[i], level]
        lines.append(",".join(f"{float(value):.6g}" for value in (*values, *points.position[i])))
    return "\n".join(lines) + "\n"


def peak_of(spectrum: Float[Tensor, "range u v"], grid: Grid, velocity: float = 0.0) -> Peak:
    """The strongest cell of a map of one range rate.

    Args:
        spectrum: Power.
        grid: Bins of the map.
        velocity: The range rate [m/s].
    """
    r, u, v = (int(index) for index in np.unravel_index(int(spectrum.argmax()), spectrum.shape))
    place = float(grid.ranges[r]), velocity, float(grid.u[u]), float(grid.v[v])
    return Peak(*place, float(spectrum[r, u, v]))
