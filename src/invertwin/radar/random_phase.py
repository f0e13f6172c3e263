"""The paper's own surrogate: a field with a random phase per path, not mean power."""

import math

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.channel import Grid, Paths
from invertwin.radar.point_spread import airy_field, airy_radii, normalized_gaussian
from invertwin.radar.radar import Radar
from invertwin.radar.waveform import SIGMA_PER_FWHM

_CHUNK = 4096  # paths at a time: what is kept grows with paths × directions


def random_phase_spectrum(
    paths: Paths,
    radar: Radar,
    grid: Grid,
    *,
    seed: int,
    range_width: float = 0.0,
    aperture_radius: float | None = None,
) -> Float64[Tensor, "frame range u v"]:
    """|Σ α e^{jφ} G(R) E(u, v)|² with Gaussian G, Airy E and independent uniform phases φ.

    Its mean over phases is the map of ``Surrogate("gaussian", "airy")``; one draw is speckled as
    an exact spectrum is, with other speckle. Its limits, which tests show:

    - A boundary path b has α_b = 0, so that the derivative of |S|² with respect to it is
      ``2 Re(conj(S) e^{jφ_b}) ∂α_b``. φ_b is independent of S, and the mean of e^{jφ_b} is 0: on
      average the derivative knows nothing of silhouettes, however many samples there are.
    - Where the interior alone counts the derivative is right on average, under the noise of the
      speckle of one draw.
    - Time and memory grow with paths × bins, those of a deposit with paths + bins.

    Source: §3.4 of the paper, with α_b of a boundary path as in derivations §3–§4.
    Differs from the source: kernels are square roots of the power kernels, so that the mean is
    that of power; paths whose range the grid does not hold are left out, where the normalisation
    over bins would put all of them into the last bin; the Airy argument is k r |Δ(u, v)|.

    Args:
        paths: Power paths, from ``trace_power``. A boundary path's α is its power over the
            square root of the mean power of the frame's other paths.
        radar: Its arrays, waveform, poses and range bias.
        grid: Bins.
        seed: Seed of the phases.
        range_width: Standard deviation added to the Gaussian of one range cell [range cells].
        aperture_radius: Radius of the aperture [m], see ``Surrogate.aperture_radius``.
    """
    inside = (paths.range > grid.ranges[0]) & (paths.range < grid.ranges[-1])
    generator = torch.Generator().manual_seed(seed)
    phase = 2 * math.pi * torch.rand(len(paths), generator=generator, dtype=torch.float64)
    maps = []
    for frame in range(radar.frame_count):
        rows = ((paths.frame == frame) & inside).nonzero()[:, 0]
        total = torch.zeros(grid.range_count, grid.u_count * grid.v_count, dtype=torch.complex128)
        amplitude = _amplitudes(paths.power[rows], paths.boundary[rows])
        field = amplitude * torch.polar(torch.ones_like(amplitude.detach()), phase[rows])
        for some, part in zip(rows.split(_CHUNK), field.split(_CHUNK), strict=True):
            total = total + _spread(paths, some, part, radar, grid, range_width, aperture_radius)
        maps.append(total.abs().square())
    return torch.stack(maps).unflatten(2, (grid.u_count, grid.v_count))


def _amplitudes(power: Tensor, boundary: Tensor) -> Tensor:
    """α: the square root of power; on the boundary zero, with the derivative of an amplitude."""
    typical = power.detach()[~boundary].mean().sqrt() if (~boundary).any() else power.new_ones(())
    lit = torch.where(boundary, torch.ones_like(power), power.clamp_min(1e-300)).sqrt()
    return torch.where(boundary, power / typical, lit)


def _spread(
    paths: Paths,
    rows: Tensor,
    field: Tensor,
    radar: Radar,
    grid: Grid,
    range_width: float,
    aperture_radius: float | None,
) -> Tensor:
    cell = radar.waveform.range_resolution
    sigma = math.hypot(SIGMA_PER_FWHM, range_width) * cell
    place = paths.range[rows] + radar.range_bias
    # The square of a field's Gaussian of √2 σ is a power's of σ; peak 1 with no extra width.
    scale = (SIGMA_PER_FWHM * cell / sigma) ** 0.5 * 2 * math.pi**0.5 * sigma / grid.range_step
    along = scale * normalized_gaussian(place, grid.ranges, math.sqrt(2) * sigma)
    link = radar.link()
    ray = paths.last[rows] - link.rx[paths.frame[rows]]
    ray = torch.einsum("nij,ni->nj", link.rotations[paths.frame[rows]], ray)
    ray = ray / ray.norm(dim=1, keepdim=True)
    radii = airy_radii(radar, aperture_radius)
    wavenumber = 2 * math.pi / radar.waveform.wavelength
    square = field.real.new_zeros(len(rows), grid.u_count, grid.v_count)
    if grid.u_count > 1:
        square = square + (radii[0] * (grid.u - ray[:, :1])).square()[:, :, None]
    if grid.v_count > 1:
        square = square + (radii[1] * (grid.v - ray[:, 1:2])).square()[:, None]
    # An infinitesimal offset: the root has no derivative at 0.
    across = airy_field(wavenumber * (square + 1e-24).sqrt()).flatten(1)
    return (along.T * field) @ across.to(field)
