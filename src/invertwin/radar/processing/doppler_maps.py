"""Maps of one frame of chirps over range, range rate and direction, and their peaks."""

import math
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np
import torch
from jaxtyping import Bool, Complex, Float, Float64
from scipy.special import gammainccinv
from torch import Tensor

from invertwin.channel import Grid
from invertwin.radar.processing import doppler
from invertwin.radar.processing.beamforming import beamform
from invertwin.radar.processing.direction import capon, music
from invertwin.radar.processing.reflectors import noise_power
from invertwin.radar.radar import Radar
from invertwin.radar.signal.chirps import Chirps
from invertwin.runtime.progress import track

_RangeDoppler = Float[Tensor, "velocity range"]
# Range-rate bins on either side of zero with slow drift of static echoes, and the maximum level
# of drift relative to the static echo at its range.
_STATIC_BINS = 2
_DRIFT_LEVEL = 1e-3
# Minimum number of range-rate bins for a noise estimate per range.
_OWN_NOISE = 16
# False-alarm probability of moving targets, and the rounding of samples.
_FALSE_ALARM_RATE = 1e-3
_ROUNDING = 1e-12
_MIN_SPECTROGRAM_CHIRPS = 32
_WEAKEST_PART = 1e-3  # of a moving target, relative to the strongest: above sidelobes
_BINS_AT_ONCE = 2e7  # bins of range rate, range, u, v per chunk
_Cells = Bool[Tensor, "velocity range"]  # marked ones
_Beat = Complex[Tensor, "frame chirp tx rx sample"]  # of every ramp
_Cube = Complex[Tensor, "frame velocity tx rx range"]  # over range rate and range


@dataclass(frozen=True)
class Peak:
    """Strongest cell of a map.

    Attributes:
        range: range [m].
        velocity: range rate, positive for receding targets [m/s].
        u, v: Direction cosines to the left and up; 0 where not resolved.
        power: received over transmitted power, or squared counts.
    """

    range: float
    velocity: float
    u: float
    v: float
    power: float

    def metrics(self, name: str) -> dict[str, float]:
        """Return numbers for `metrics.json` with keys that start with a name."""
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
    """Maps of one frame of a chirp train.

    Attributes:
        grid: ranges and directions.
        velocities: range rates [m/s].
        range_doppler: mean power of the channels [velocity, range].
        total_power: power over range and direction, summed over range rates [range, u, v].
        moving_power: power over range and direction after static clutter removal (mean over chirps)
            [range, u, v]; None = no moving target.
        strongest_peak: strongest cell.
        moving_peak: strongest moving cell; None = no cell above the noise.
        moving_rates: lowest and highest range rate of moving cells within 30 dB of the strongest
            [m/s].
        spectrogram: micro-Doppler of the ranges with moving cells [time, velocity]; None = no
            moving cell, or fewer than 32 chirps.
    """

    grid: Grid
    velocities: Float64[Tensor, " velocity"]
    range_doppler: _RangeDoppler
    total_power: Float64[Tensor, "range u v"]
    moving_power: Float64[Tensor, "range u v"] | None
    strongest_peak: Peak
    moving_peak: Peak | None
    moving_rates: tuple[float, float] | None = None
    spectrogram: doppler.Spectrogram | None = None

    @property
    def is_aliased(self) -> bool:
        """True if moving cells reach the largest unambiguous range rate."""
        ends = float(self.velocities[0]), float(self.velocities[-1])
        return any(rate in ends for rate in self.moving_rates or ())


def doppler_maps(
    beat: _Beat, radar: Radar, grid: Grid, chirps: Chirps, frame: int = 0
) -> DopplerMaps:
    """Compute range-Doppler and range-direction maps of one frame, with ``compensate_tdm``.

    Range rates are those of the unambiguous span. Moving targets are detected in the chirps without
    their mean, which preserves slow ones. A cell of range rate and range, averaged over channels,
    is moving if it exceeds the level that noise reaches in any cell of the map with a probability
    of 0.001. The noise has the median power of the map, or of its range if that is larger, as for
    phase noise. Near range rate zero, drift 30 dB below the static echo at that range is ignored.

    Args:
        beat: signals of all chirps of every transmitter.
        radar: radar with one pose per frame.
        grid: ranges and directions of the maps.
        chirps: chirp timing.
        frame: index of the frame.

    Raises:
        InputError: As ``range_doppler`` and ``beamform``.
    """
    radar, signal = radar.frames([frame]), beat[frame : frame + 1]
    cube = doppler.range_doppler(signal, radar, grid, chirps)
    flat = cube.abs().square().mean((2, 3))[0]
    anywhere = torch.ones_like(flat) > 0
    everything, strongest = _sum_range_rates(cube, flat, radar, grid, chirps, anywhere)
    moving = doppler.range_doppler(signal - signal.mean(1, keepdim=True), radar, grid, chirps)
    power = moving.abs().square().mean((2, 3))[0]
    cells = _detect_moving_cells(power, flat, len(radar.virtual_positions))
    velocities = doppler.velocity_axis(radar, chirps).to(flat.device)
    maps = DopplerMaps(grid, velocities, flat, everything, None, strongest, None)
    if not bool(cells.any()):
        return maps
    movers, mover = _sum_range_rates(moving, power, radar, grid, chirps, cells)
    cells = cells & (power > _WEAKEST_PART * power[cells].max())
    rates, rows = velocities[cells.any(1)], cells.any(0).nonzero()[:, 0]
    maps = replace(maps, moving_power=movers, moving_peak=mover)
    maps = replace(maps, moving_rates=(float(rates[0]), float(rates[-1])))
    if chirps.count < _MIN_SPECTROGRAM_CHIRPS:
        return maps
    count, start = int(rows[-1] - rows[0]) + 1, float(grid.ranges[rows[0]])
    near = replace(grid, range_start=start, range_count=count)
    found = doppler.frame_spectrogram(signal, radar, near, chirps)
    return replace(maps, spectrogram=replace(found, power=found.power[0]))


def _sum_range_rates(
    cube: _Cube, level: _RangeDoppler, radar: Radar, grid: Grid, chirps: Chirps, candidates: _Cells
) -> tuple[Float64[Tensor, "range u v"], Peak]:
    """Sum power over all range rates, and return the strongest of the candidate cells.

    Args:
        cube: spectrum of one frame.
        level: its mean power over channels.
        radar: radar that recorded it.
        grid: ranges and directions.
        chirps: chirp timing.
        candidates: cells of which the strongest is returned.
    """
    cube = doppler.compensate_tdm(cube, radar, chirps, doppler.interpolate_rates(level))[0]
    velocities = doppler.velocity_axis(radar, chirps)
    chunk = max(1, int(_BINS_AT_ONCE / math.prod(grid.shape)))
    total = level.new_zeros(grid.shape, dtype=torch.float64)
    seen = grid.in_visible_region.to(level.device)
    peaks: list[Peak] = []
    for rows in track(torch.arange(chirps.count).split(chunk), "range rates"):
        power = beamform(cube[rows], radar.frames([0] * len(rows)), grid).double() * seen
        total += power.sum(0)
        power = power * candidates[rows][:, :, None, None]
        pairs = zip(power, velocities[rows], strict=True)
        peaks += [find_peak(part, grid, float(rate)) for part, rate in pairs]
    return total, max(peaks, key=attrgetter("power"))


def _detect_moving_cells(moving: _RangeDoppler, flat: _RangeDoppler, looks: int) -> _Cells:
    """Detect cells above noise and drift."""
    moving, middle = moving.double(), len(flat) // 2
    rows = [noise_power(row, looks) for row in moving.T] if len(flat) >= _OWN_NOISE else [0.0]
    level = moving.new_tensor(rows).clamp_min(noise_power(moving, looks))
    factor = float(gammainccinv(looks, _FALSE_ALARM_RATE / moving.numel())) / looks
    least = (factor * level).clamp_min(_ROUNDING * float(flat.max()))
    slow = (torch.arange(len(flat), device=flat.device) - middle).abs() <= _STATIC_BINS
    drift = torch.where(slow[:, None], _DRIFT_LEVEL * flat[middle].double(), 0.0)
    return (moving > least) & (moving > drift)


def high_resolution_map(
    profile: Complex[Tensor, "snapshot tx rx range"],
    radar: Radar,
    grid: Grid,
    method: str,
    sources: int | None,
) -> Float[Tensor, "range u v"]:
    """Compute a Capon or MUSIC map over range and direction [range, u, v].

    Args:
        profile: range profiles of one frame; range-rate bins after ``compensate_tdm`` are snapshots
            too.
        radar: radar with its array.
        grid: grid with its directions.
        method: capon or music.
        sources: number of sources for music; None = estimated in each range.

    Raises:
        InputError: As ``capon`` and ``music``.
    """
    snapshots = profile[None].to(torch.complex128)
    if method == "capon":
        power = capon(snapshots, radar, grid)[0]
    else:
        power = music(snapshots, radar, grid, sources="mdl" if sources is None else sources)[0]
    return power * grid.in_visible_region.to(power.device)


def doppler_snapshots(
    beat: _Beat, radar: Radar, grid: Grid, chirps: Chirps, frame: int
) -> Complex[Tensor, "velocity tx rx range"]:
    """Return the range-rate bins of one frame as snapshots for `high_resolution_map`.

    Args:
        beat: signals of all chirps of every transmitter.
        radar: radar with one pose per frame.
        grid: grid with its ranges.
        chirps: chirp timing.
        frame: index of the frame.
    """
    radar = radar.frames([frame])
    cube = doppler.range_doppler(beat[frame : frame + 1], radar, grid, chirps, window="rectangular")
    rates = doppler.interpolate_rates(cube.abs().square().mean((2, 3))[0])
    return doppler.compensate_tdm(cube, radar, chirps, rates)[0]


def find_peak(spectrum: Float[Tensor, "range u v"], grid: Grid, velocity: float = 0.0) -> Peak:
    """Return the strongest cell of a map of one range rate.

    Args:
        spectrum: power [range, u, v].
        grid: Bins of the map.
        velocity: range rate [m/s].
    """
    r, u, v = (int(index) for index in np.unravel_index(int(spectrum.argmax()), spectrum.shape))
    place = float(grid.ranges[r]), velocity, float(grid.u[u]), float(grid.v[v])
    return Peak(*place, float(spectrum[r, u, v]))
