"""Channel calibration on an unknown scene by its own image."""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

from invertwin.capture import Capture, ChannelCalibration
from invertwin.channel import Grid
from invertwin.discovery.imaging import reflectivity
from invertwin.discovery.imaging.likelihood import TAIL_DEGREES, estimate_background
from invertwin.inversion import speckle_weight
from invertwin.radar import Radar, range_profile
from invertwin.radar.radar import require_sampled_waveform

_CALIBRATION_ROUNDS = 2  # alternations of imaging and calibration
_MAX_SWEEPS = 100  # maximum number of sweeps over the channels
_MIN_PHASE_SPREAD = 10.0  # root mean square phase [°]: smaller errors are not corrected
# Minimum number of positions a range cell apart, which resolve directions by ranges.
_MIN_POSITIONS = 8


def calibrate_on_scene(
    capture: Capture, grid: Grid, positions: Float64[Tensor, "point 3"]
) -> ChannelCalibration | None:
    """Estimate the channel gains under which a recording fits its own image best.

    The first image uses ranges alone, which do not depend on channel phases: many positions of the
    radar locate the echoes. It predicts the covariance of the channels in every range bin, which
    determines their gains by maximum likelihood; the next image uses directions too.

    Args:
        capture: recording from several positions.
        grid: bins of the maps.
        positions: image points [point, 3] [m].

    Returns:
        Calibration; None if the channels agree, or if too few positions distinguish a phase error
        from another direction.
    """
    radar = capture.radar()
    cells = (radar.positions.detach() / radar.waveform.range_resolution).round().unique(dim=0)
    if len(radar.virtual_positions) == 1 or len(cells) < _MIN_POSITIONS:
        return None
    flat = replace(grid, u_start=0.0, u_step=1.0, u_count=1, v_start=0.0, v_step=1.0, v_count=1)
    found = ChannelCalibration(torch.ones(tuple(capture.beat.shape[1:3]), dtype=torch.complex128))
    for number in range(_CALIBRATION_ROUNDS):
        now = found.apply(capture)
        bins = flat if number == 0 else grid
        power = now.spectrum(bins).detach().double()
        power, coarse = reflectivity.thin_map(power, radar, bins)
        level = estimate_background(power)[:, None, None].expand_as(power)
        response = reflectivity.compute_response(radar, coarse, positions)
        image = reflectivity.reconstruct_reflectivity(response, power, level)
        found = _estimate_gains(capture, flat, positions, image)
        if number == 0 and phase_spread(found, radar) < _MIN_PHASE_SPREAD:
            return None
    return found


def phase_spread(calibration: ChannelCalibration, radar: Radar) -> float:
    """Compute the root mean square phase difference of channels [°], up to a ramp.

    A ramp along the array corresponds to a rotation of the radar, which a slightly displaced image
    may cause.

    Args:
        calibration: calibration of the channels.
        radar: radar with its array and wavelength.
    """
    elements = radar.virtual_positions[:, 1:] / require_sampled_waveform(radar).wavelength
    extent = elements.amax(0) - elements.amin(0)
    steps = [
        torch.arange(-1.0, 1.0, 1 / (16 * float(e)) if e > 0 else 2.0).double() for e in extent
    ]
    axes = [axis if len(axis) > 1 else 0 * axis for axis in steps]
    turns = elements @ torch.cartesian_prod(*axes).T
    phasors = torch.polar(torch.ones_like(turns), 2 * math.pi * turns)
    left = calibration.gains.flatten()[:, None] * phasors
    best = left[:, int(left.sum(0).abs().argmax())]
    best = best * best.sum().conj()
    return math.degrees(float(best.angle().square().mean().sqrt()))


def _estimate_gains(
    capture: Capture, range_grid: Grid, positions: Float64[Tensor, "point 3"], image: Tensor
) -> ChannelCalibration:
    """Estimate channel gains, given an image.

    With h = 1/g and D = diag(x), a range bin of channels x has the covariance R that the image
    predicts, once D h replaces x. Minus the logarithm of its likelihood, summed over bins, is hᴴ Q
    h − 2 N Σ log|h|, Q = Σ Dᴴ R⁻¹ D; one channel after the other minimises it in closed form. Bins
    that the image does not explain have lower weights, as for heavy-tailed speckle.

    Args:
        capture: signals.
        range_grid: bins of range.
        positions: image points [point, 3] [m].
        image: radar cross-section of every point [m²].
    """
    radar = capture.radar()
    profile = range_profile(capture.beat.to(torch.complex128), radar, range_grid)
    power = profile.abs().square().mean((1, 2))
    power, coarse = reflectivity.thin_map(power[:, :, None, None], radar, range_grid)
    stride = round(coarse.range_step / range_grid.range_step)
    cells = profile[..., ::stride].flatten(1, 2).movedim(1, -1)  # frame, range, channel
    level = estimate_background(power)
    predicted = reflectivity.compute_response(radar, coarse, positions).matrix
    count, ranges = cells.shape[-1], cells.shape[1]
    eye = torch.eye(count, dtype=torch.complex128)
    total, draws = torch.zeros(count, count, dtype=torch.complex128), 0.0
    wave_number = 2 * math.pi / require_sampled_waveform(radar).wavelength
    rotations = radar.link().rotations.detach()
    for frame, origin in enumerate(radar.positions.detach()):
        seen = torch.nn.functional.normalize(positions - origin, dim=1) @ rotations[frame]
        phase = -wave_number * (seen[:, 1:] @ radar.virtual_positions[:, 1:].T)
        waves = torch.polar(torch.ones_like(phase), phase)  # of the channels, for echoes at points
        model = level[:, None, None] * eye
        for k in range(ranges):
            row = predicted[frame * ranges + k]
            near = torch.from_numpy(row.indices.astype(np.int64))
            seen = waves[near]
            power = image[near] * torch.from_numpy(row.data)
            model[k] += (seen * power[:, None]).T @ seen.conj()
        inverse = torch.linalg.inv(model)
        x = cells[frame]
        misfit = torch.einsum("ri,rij,rj->r", x.conj(), inverse, x).real / count
        weight = speckle_weight(misfit, TAIL_DEGREES)
        total += torch.einsum("r,ri,rij,rj->ij", weight.to(x), x.conj(), inverse, x)
        draws += float(weight.sum())
    return ChannelCalibration((1 / _minimise_gains(total, draws)).reshape(capture.beat.shape[1:3]))


def _minimise_gains(matrix: Complex128[Tensor, "c c"], draws: float) -> Complex128[Tensor, " c"]:
    """Minimise hᴴ Q h − 2 N Σ log|h| over h.

    Args:
        matrix: Q, Hermitian [channel, channel].
        draws: N, number of draws.
    """
    vectors = torch.linalg.eigh(matrix).eigenvectors
    h = vectors[:, 0] / vectors[:, 0].abs().clamp_min(1e-3)
    for _ in range(_MAX_SWEEPS):
        before = h.clone()
        for c in range(len(h)):
            own = float(matrix[c, c].real)
            rest = (matrix[c] * h).sum() - matrix[c, c] * h[c]
            size = float(rest.abs())
            length = (size + math.sqrt(size**2 + 4 * own * draws)) / (2 * own)
            h[c] = -length * rest / max(size, 1e-300)
        if float((h - before).abs().max()) < 1e-6 * float(h.abs().max()):
            break
    return h
