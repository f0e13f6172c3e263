"""The paper's own surrogate as a forward model: a field with a random phase per path."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from invertwin.capture import Capture
from invertwin.channel import Grid, Paths, Sampling, trace_power
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel
from invertwin.radar.radar import Radar
from invertwin.radar.surrogate.point_spread import airy_field, airy_radii, normalized_gaussian
from invertwin.radar.surrogate.surrogate import Surrogate
from invertwin.radar.waveform import SIGMA_PER_FWHM
from invertwin.scene import Scene

_CHUNK = 4096  # paths at a time: what is kept grows with paths × directions


@dataclass(frozen=True)
class RandomPhaseMap(ForwardModel):
    """One draw of the paper's field, with new phases for every seed: `random_phase_spectrum`.

    Attributes:
        grid: Bins.
        surrogate: Its kernels are "gaussian" and "airy"; its range width is the extra width.
        sampling: How paths of one bounce are sampled.

    Raises:
        InputError: Other kernels, an extra angular width, or paths of several bounces.
    """

    grid: Grid
    surrogate: Surrogate
    sampling: Sampling

    def __post_init__(self) -> None:
        kernels = self.surrogate
        if (kernels.range_kernel, kernels.angle_kernel) != ("gaussian", "airy"):
            raise InputError(
                "expected range_kernel 'gaussian' and angle_kernel 'airy' with random phases, got "
                f"{kernels.range_kernel!r} and {kernels.angle_kernel!r}; choose these"
            )
        if kernels.angle_width > 0 or self.sampling.depth != 1:
            raise InputError(
                "expected angle_width 0 and depth 1 with random phases, got "
                f"{kernels.angle_width} and {self.sampling.depth}; correct them"
            )

    def predict(self, scene: Scene, sensor: Radar, seed: int) -> Float[Tensor, "frame range u v"]:
        """A draw of the field's power. See `ForwardModel.predict`."""
        return random_phase_spectrum(
            trace_power(scene, sensor.link(), sampling=self.sampling, seed=seed),
            sensor,
            self.grid,
            seed=seed,
            range_width=self.surrogate.range_width,
            aperture_radius=self.surrogate.aperture_radius,
        )

    def observe(self, recording: Capture) -> Float[Tensor, "frame range u v"]:
        """The measured power spectrum of a capture."""
        return recording.spectrum(self.grid).to(torch.float32)

    @property
    def has_blur(self) -> bool:
        """Whether the kernels have an extra width."""
        return self.surrogate.range_width > 0

    def scale_blur(self, fraction: float) -> "RandomPhaseMap":
        """The model with this share of its extra width."""
        width = fraction * self.surrogate.range_width
        return replace(self, surrogate=replace(self.surrogate, range_width=width))

    def blur_observed(self, observed: Tensor, sensor: Radar) -> Tensor:
        """An observed map with the extra width."""
        return self.surrogate.blur(observed, sensor, self.grid)


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
        square = square + (radii[0] * (grid.u - ray[:, 1:2])).square()[:, :, None]
    if grid.v_count > 1:
        square = square + (radii[1] * (grid.v - ray[:, 2:])).square()[:, None]
    # An infinitesimal offset: the root has no derivative at 0.
    across = airy_field(wavenumber * (square + 1e-24).sqrt()).flatten(1)
    return (along.T * field) @ across.to(field)
