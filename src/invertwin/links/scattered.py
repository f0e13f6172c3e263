"""Incoherent scattering by rough surfaces from transmitters to receivers.

Specular paths carry the coherent power (``trace_paths``). The power that roughness takes from them
is scattered by ``Material.incoherent_law``: the lobes of ``EffectiveRoughness``, of which the one
about the specular direction has the power lost to variations of height.

Two kinds of paths add up: those that scatter at each of their bounces (``deposit_power``), and
those that scatter once, with specular reflections before or after (``trace_single_scattering``).
Paths that scatter twice and are reflected as well are left out.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin import channel
from invertwin.checks import refuse_derivatives
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.links.responses import AntennaMount
from invertwin.links.transmitters import Transmitters
from invertwin.scene import Isotropic, Pattern, Scene
from invertwin.scene.antenna import COSINE_COUNT

_POSITIONS_PER_BATCH = 8192
_BINS = 64  # of length; moments are exact whatever their number
_ANGLES = 360  # of a turned pattern about its axis
_Legs = channel.RayPaths


def scattered_moments(
    scene: Scene,
    sensor: Transmitters,
    receivers: AntennaMount,
    positions: Float64[Tensor, "place 3"],
    frequency: float,
    sampling: channel.Sampling,
    seed: int,
    *,
    depth: int = 1,
    rays: int | None = None,
) -> Float64[Tensor, "tx place 3"]:
    """Scattered over sent power, and that times the excess delay [s] and its square [s²].

    The excess delay is that over the straight line. Differentiable with respect to the scene and
    to places, what moving shadows change included.

    Args:
        scene: Scene of surfaces, without clouds.
        sensor: Transmitters.
        receivers: Antenna and axes of every receiver.
        positions: Positions of the receivers [m].
        frequency: [Hz].
        sampling: Numbers of paths, over all receivers; most bounces of a path that
            scatters at each.
        seed: Same seed, same paths.
        depth: Maximum number of reflections of a path, the scattering included.
        rays: Shot to find these mirrors; None tries every sequence.

    Raises:
        InputError: Axes of antennas that carry derivatives, or axes of its own for each receiver
            with a pattern.
    """
    rough = _incoherent_scene(scene, frequency)
    if rough is None:
        return positions.new_zeros(len(sensor.positions), len(positions), 3)
    for axes in (sensor.mount.rotations, receivers.rotations):
        do = "scattered power has none by axes: detach them"
        refuse_derivatives(axes, "axes of antennas where rough surfaces scatter", do)
    grid = _length_grid(rough, (sensor.positions.detach(), positions.detach()), sampling.depth)
    parts = positions.split(_POSITIONS_PER_BATCH)
    rows: list[Tensor] = []
    for number in range(len(sensor.positions)):
        one = sensor.frames([number])
        found: list[Tensor] = []
        for batch, some in enumerate(parts):
            link = _build_link(one, receivers, some, frequency)
            counts = (sampling.samples, sampling.boundary_samples)
            samples, edges = (math.ceil(n * (len(some) / len(positions))) for n in counts)
            drawn = replace(sampling, samples=samples, boundary_samples=edges)
            power = channel.deposit_power(rough, link, grid, sampling=drawn, seed=seed + batch)
            found.append(_delay_moments(power[..., 0, 0].double(), grid, link))
        rows.append(torch.cat(found))
    total = torch.stack(rows)
    if depth < 2:
        return total

    def measure(out: _Legs, back: _Legs, cross_polar: Tensor, tx: Tensor, rx: Tensor) -> Tensor:
        ends = (sensor.mount, out), (receivers, back)
        sent, taken = (end.element_weights(p.departure, p.tx) for end, p in ends)
        power = channel.scattered_power(out, back, sent, taken, cross_polar)
        straight = (rx[back.tx] - tx[out.tx]).norm(dim=1)
        excess = out.delay + back.delay - straight / SPEED_OF_LIGHT
        return torch.stack([power, power * excess, power * excess**2], 1)

    return total + channel.trace_single_scattering(
        *(scene, rough, sensor.positions, positions, frequency, measure, 3),
        rays=rays,
        sampling=replace(sampling, depth=depth),
        seed=seed,
    )


def _build_link(
    sensor: Transmitters, receivers: AntennaMount, positions: Tensor, frequency: float
) -> channel.Link:
    """From one transmitter to receivers, in its axes."""
    count, turn = len(positions), sensor.mount.rotations.reshape(3, 3)
    poses = sensor.positions.expand(count, 3), positions, turn.expand(count, 3, 3)
    patterns = sensor.mount.array.pattern, _rotate_pattern(receivers, turn)
    polarisations = sensor.mount.array.jones, receivers.array.jones
    return channel.Link(*poses, *patterns, SPEED_OF_LIGHT / frequency, False, *polarisations)


def _delay_moments(power: Tensor, grid: channel.Grid, link: channel.Link) -> Tensor:
    """Sums of power, of power × excess delay and of power × its square."""
    excess = (2 * grid.ranges - (link.rx - link.tx).norm(dim=1, keepdim=True)) / SPEED_OF_LIGHT
    # A path lies in three bins, with weights whose second moment is a quarter of a squared step.
    parts = power, power * excess, power * (excess**2 - (grid.range_step / SPEED_OF_LIGHT) ** 2)
    return torch.stack([part.sum(1) for part in parts], -1)


def _incoherent_scene(scene: Scene, frequency: float) -> Scene | None:
    """The scene as it scatters; None if it does not."""
    rest = channel.without_specular(scene, scene.names)
    with torch.no_grad():
        surfaces = [item.material.scattering_law(frequency) for item in rest.objects.values()]
        rough = any(bool((s.diffuse > 0).any() or (s.lobes > 0).any()) for s in surfaces)
    return rest if rough else None


def _length_grid(scene: Scene, ends: Sequence[Tensor], depth: int) -> channel.Grid:
    """Bins that hold every path of so many bounces, with room for the extra lengths of sheets."""
    points = torch.cat([item.vertices.detach() for item in scene.objects.values()] + [*ends])
    step = (0.6 * (depth + 1) * float((points.amax(0) - points.amin(0)).norm()) + 1.0) / (_BINS - 3)
    return channel.Grid(range_start=-step, range_step=step, range_count=_BINS)


def _rotate_pattern(receivers: AntennaMount, rotation: Float64[Tensor, "3 3"]) -> Pattern:
    """The receivers' pattern about the axes of the transmitter."""
    pattern = receivers.array.pattern
    if isinstance(pattern, Isotropic):
        return pattern
    if receivers.rotations.ndim == 3:
        raise InputError(
            "expected one orientation of all receivers with a pattern where rough surfaces "
            f"scatter, got {len(receivers.rotations)}; give one, or isotropic receivers"
        )
    between = receivers.rotations.mT @ rotation
    if torch.equal(between, torch.eye(3, dtype=torch.float64)):
        return pattern
    return _RotatedPattern(pattern, between)


@dataclass(frozen=True, eq=False)
class _RotatedPattern(Pattern):
    """A pattern about other axes."""

    base: Pattern
    rotation: Float64[Tensor, "3 3"]  # from these axes into those of the pattern

    def gain(self, direction: Tensor) -> Tensor:
        return self.base.gain(direction @ self.rotation.to(direction).mT)

    def table(self) -> Float64[Tensor, "n_cos n_phi"]:
        cosine = torch.linspace(-1, 1, COSINE_COUNT, dtype=torch.float64)[:, None]
        phi = 2 * torch.pi * torch.arange(_ANGLES, dtype=torch.float64) / _ANGLES - torch.pi
        sine = (1 - cosine**2).clamp_min(0).sqrt()
        parts = cosine.expand(-1, _ANGLES), sine * phi.cos(), sine * phi.sin()
        return self.gain(torch.stack(parts, -1))
