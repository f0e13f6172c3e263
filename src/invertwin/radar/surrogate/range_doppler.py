"""Smooth surrogate of range-Doppler-angle processing."""

import math
from dataclasses import replace
from itertools import combinations

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.channel import Grid, Paths
from invertwin.checks import check_shape
from invertwin.radar.aperture import aperture
from invertwin.radar.processing.doppler import velocity_span
from invertwin.radar.radar import Radar
from invertwin.radar.signal.chirps import Chirps, range_rate
from invertwin.radar.surrogate.point_spread import interpolate_response
from invertwin.radar.waveform import FMCW, SteppedFrequency, Waveform, unit_window


def range_doppler_power(
    paths: Paths,
    velocities: Float64[Tensor, "path 3"],
    radar: Radar,
    grid: Grid,
    chirps: Chirps,
    rates: Float64[Tensor, " velocity"],
    *,
    window: str = "hamming",
) -> Float64[Tensor, "frame velocity range u v"]:
    """Compute expected power over range rate, range and direction, as of ``range_doppler_angle``.

    Every path is spread as exact signals spread a moving point: by the power response of the
    samples' window over range, by that of the chirps' window over range rate, and by Bartlett
    beamforming of its plane wave. Time-multiplexed transmitters are compensated for the rate of the
    bin, not for that of the point. Range-Doppler coupling shifts the range of a ramp. For
    independent random phases, the mean of the exact power therefore equals this power. It is
    differentiable with respect to paths and velocities. A range rate is that of half the length of
    the path.

    Source: derivations §5 and §6.

    Args:
        paths: power paths of one bounce, or by mirrors, with the points at the middle of the
            frame's chirps.
        velocities: velocities of their last points in the world [m/s].
        radar: radar that records.
        grid: ranges and directions.
        chirps: chirp timing.
        rates: range rates, positive for receding targets [m/s]; not restricted to bins.
        window: taper over the chirps, one of ``WINDOWS``.

    Raises:
        InputError: Velocities that do not fit the paths, an unknown window, or a grid that the
            array does not resolve.
    """
    do = "evaluate them at the paths' points"
    check_shape(velocities, paths.first.shape, "velocities, one per path,", do)
    own_rates = range_rate(replace(paths, velocity=velocities), radar)
    off = own_rates - rates[:, None]
    doppler = _doppler_response(off / velocity_span(radar, chirps), chirps, window)
    coupled = own_rates * _range_doppler_coupling(radar.waveform)
    shown = paths.range - radar.origins[paths.frame] + coupled
    spread = interpolate_response(
        grid.ranges[:, None] - shown,
        radar.waveform.range_resolution,
        lambda places: radar.waveform.range_response(places, radar.window),
    )
    steered = _beam_weights(_local_directions(paths, radar), radar, grid)
    starts = 4 * math.pi / radar.waveform.wavelength * chirps.times(len(steered))[0]
    frames = []
    for index in range(radar.frame_count):
        of = paths.frame == index
        lit = (doppler * paths.power)[:, None, of] * spread[None, :, of]
        power = lit @ steered[:, of].abs().square().sum(0)
        for late, early in combinations(range(len(steered)), 2):
            cross = 2 * steered[late][of] * steered[early][of].conj()
            turn = off[:, None, of] * (starts[late] - starts[early])
            power = power + (lit * turn.cos()) @ cross.real - (lit * turn.sin()) @ cross.imag
        frames.append(power.unflatten(-1, grid.shape[1:]))
    return torch.stack(frames)


def _local_directions(paths: Paths, radar: Radar) -> Tensor:
    """Return unit directions in the radar frame."""
    link = radar.link()
    center = 0.5 * (link.tx + link.rx)[paths.frame]
    direction = torch.nn.functional.normalize(paths.last - center, dim=1)
    return torch.einsum("pji,pj->pi", link.rotations[paths.frame], direction)


def _range_doppler_coupling(waveform: Waveform) -> float:
    """Return the range shift per range rate of a ramp: f/S [s]."""
    if isinstance(waveform, FMCW):
        return waveform.center_frequency / waveform.slope
    if isinstance(waveform, SteppedFrequency):
        return waveform.center_frequency * waveform.dwell / waveform.step
    return 0.0


def _doppler_response(cycles: Tensor, chirps: Chirps, window: str) -> Tensor:
    """Return the power response |Σ w_n exp(2πj n x)|² of the chirps' window, x in cycles/loop."""
    weight = unit_window(window, chirps.count).to(cycles.device, torch.complex128)

    def response(places: Tensor) -> Tensor:
        turns = 2j * math.pi * places[:, None] * torch.arange(chirps.count).to(places)
        return (turns.exp() @ weight).abs().square()

    return interpolate_response(cycles, 1 / chirps.count, response)


def _beam_weights(direction: Tensor, radar: Radar, grid: Grid) -> Tensor:
    """Return the contributions of each transmitter's elements to the beams for a unit field."""
    array = aperture(radar)
    array.check_directions(grid)
    y, z = radar.virtual_positions[:, 1], radar.virtual_positions[:, 2]
    toward = array.beams(grid.u, grid.v, y, z) * array.weight
    waves = -2 * math.pi / radar.waveform.wavelength * direction[:, 1:] @ torch.stack([y, z])
    arriving = torch.polar(torch.ones_like(waves), waves)
    receivers = radar.shape[2]
    pairs = zip(arriving.split(receivers, 1), toward.split(receivers, 1), strict=True)
    return torch.stack([wave @ beam.T for wave, beam in pairs])
