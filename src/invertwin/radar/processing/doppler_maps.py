"""Maps of one frame of chirps over range, range rate and direction, and where they peak."""

import math
from dataclasses import dataclass
from operator import attrgetter

import numpy as np
import torch
from jaxtyping import Bool, Complex, Float, Float64
from scipy.special import gammainccinv
from torch import Tensor

from invertwin.channel import Grid
from invertwin.radar.processing.beamforming import beamform
from invertwin.radar.processing.direction import capon, music
from invertwin.radar.processing.doppler import (
    compensate_tdm,
    range_doppler,
    velocity_axis,
)
from invertwin.radar.processing.reflectors import noise_power
from invertwin.radar.radar import Radar
from invertwin.radar.signal.chirps import Chirps
from invertwin.runtime.progress import track

# Bins of range rate on either side of zero where slow drift of what stands still is seen, and how
# far below the still echo of its range such drift stays.
_STATIC_BINS = 2
_DRIFT_LEVEL = 1e-3
# Bins of range rate of which one range alone tells its noise.
_OWN_NOISE = 16
# Probability that noise alone is taken for something that moves, and the rounding of samples.
_FALSE_ALARM_RATE = 1e-3
_ROUNDING = 1e-12
_BINS_AT_ONCE = 2e7  # of range rate, range, u, v


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
        total_power: Power over range and direction, all range rates summed [range, u, v].
        moving_power: Power over range and direction of the chirps without their mean, which is what
            stands still [range, u, v]; None = nothing moves.
        strongest_peak: The strongest cell of all.
        moving_peak: The strongest cell that moves; None = nothing is above the noise.
    """

    grid: Grid
    velocities: Float64[Tensor, " velocity"]
    range_doppler: Float[Tensor, "velocity range"]
    total_power: Float64[Tensor, "range u v"]
    moving_power: Float64[Tensor, "range u v"] | None
    strongest_peak: Peak
    moving_peak: Peak | None


def doppler_maps(
    beat: Complex[Tensor, "frame chirp tx rx sample"],
    radar: Radar,
    grid: Grid,
    chirps: Chirps,
    frame: int = 0,
) -> DopplerMaps:
    """Make range-Doppler and range-direction maps of one frame, with ``compensate_tdm``.

    Range rates are those of the unambiguous span. What moves is looked for in the chirps without
    their mean, so that slow movers are kept too. Something moves where a cell of range rate and
    range, its channels averaged, is above what noise reaches in any cell of the map with a
    probability of 0.001. Noise has the median power of the map, or of its own range if that is
    more, as phase noise makes it. Next to range rate zero, drift 30 dB below what stands still at
    that range is no motion.

    Args:
        beat: Chirps of every transmitter.
        radar: With one pose per frame.
        grid: Ranges and directions of the maps.
        chirps: Timing.
        frame: The frame that is shown.

    Raises:
        InputError: As ``range_doppler`` and ``beamform``.
    """
    radar, signal = radar.frames([frame]), beat[frame : frame + 1]
    cube = range_doppler(signal, radar, grid, chirps)
    flat = cube.abs().square().mean((2, 3))[0]
    everything, strongest = _sum_range_rates(cube, radar, grid, chirps, torch.ones_like(flat) > 0)
    moving = range_doppler(signal - signal.mean(1, keepdim=True), radar, grid, chirps)
    cells = _detect_moving_cells(
        moving.abs().square().mean((2, 3))[0], flat, len(radar.virtual_positions)
    )
    movers, mover = None, None
    if bool(cells.any()):
        movers, mover = _sum_range_rates(moving, radar, grid, chirps, cells)
    velocities = velocity_axis(radar, chirps)
    return DopplerMaps(grid, velocities, flat, everything, movers, strongest, mover)


def _sum_range_rates(
    cube: Complex[Tensor, "frame velocity tx rx range"],
    radar: Radar,
    grid: Grid,
    chirps: Chirps,
    candidates: Bool[Tensor, "velocity range"],
) -> tuple[Float64[Tensor, "range u v"], Peak]:
    """Power of all range rates over range and direction, and the strongest cell of some."""
    cube = compensate_tdm(cube, radar, chirps)[0]
    velocities = velocity_axis(radar, chirps)
    chunk = max(1, int(_BINS_AT_ONCE / math.prod(grid.shape)))
    total = torch.zeros(grid.shape, dtype=torch.float64)
    seen = (grid.u[:, None].square() + grid.v.square()) <= 1
    peaks: list[Peak] = []
    for rows in track(torch.arange(chirps.count).split(chunk), "range rates"):
        power = beamform(cube[rows], radar.frames([0] * len(rows)), grid).double() * seen
        total += power.sum(0)
        power = power * candidates[rows][:, :, None, None]
        peaks += [
            find_peak(part, grid, float(rate))
            for part, rate in zip(power, velocities[rows], strict=True)
        ]
    return total, max(peaks, key=attrgetter("power"))


def _detect_moving_cells(
    moving: Float[Tensor, "velocity range"], flat: Float[Tensor, "velocity range"], looks: int
) -> Bool[Tensor, "velocity range"]:
    """Cells above what noise and drift explain."""
    moving, middle = moving.double(), len(flat) // 2
    rows = [noise_power(row, looks) for row in moving.T] if len(flat) >= _OWN_NOISE else [0.0]
    level = torch.tensor(rows, dtype=torch.float64).clamp_min(noise_power(moving, looks))
    factor = float(gammainccinv(looks, _FALSE_ALARM_RATE / moving.numel())) / looks
    least = (factor * level).clamp_min(_ROUNDING * float(flat.max()))
    slow = (torch.arange(len(flat)) - middle).abs() <= _STATIC_BINS
    drift = torch.where(slow[:, None], _DRIFT_LEVEL * flat[middle].double(), 0.0)
    return (moving > least) & (moving > drift)


def high_resolution_map(
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


def doppler_snapshots(
    beat: Complex[Tensor, "frame chirp tx rx sample"],
    radar: Radar,
    grid: Grid,
    chirps: Chirps,
    frame: int,
) -> Complex[Tensor, "velocity tx rx range"]:
    """The bins of range rate of one frame as snapshots for `high_resolution_map`.

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


def find_peak(spectrum: Float[Tensor, "range u v"], grid: Grid, velocity: float = 0.0) -> Peak:
    """The strongest cell of a map of one range rate.

    Args:
        spectrum: Power.
        grid: Bins of the map.
        velocity: The range rate [m/s].
    """
    r, u, v = (int(index) for index in np.unravel_index(int(spectrum.argmax()), spectrum.shape))
    place = float(grid.ranges[r]), velocity, float(grid.u[u]), float(grid.v[v])
    return Peak(*place, float(spectrum[r, u, v]))
