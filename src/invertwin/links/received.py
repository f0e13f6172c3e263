"""Path gain and delay spread of many links at once.

Either the powers or the fields of paths are added. The mean over a band lies between these: fields
are added for paths whose delays differ by less than 1/B, otherwise powers,

    ⟨|H|²⟩ = Σᵢ Σⱼ aᵢ aⱼ* exp(−j2πf₀(τᵢ − τⱼ)) sinc(B(τᵢ − τⱼ)).

At the shadow boundary of an edge, the lost path and the diffracted path have the same delay: their
fields are added in every band, and the mean has no jump. A sum of powers would jump by up to 7 dB.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache

import torch
from jaxtyping import Complex128, Float64
from numpy.polynomial.legendre import leggauss
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from invertwin.channel import RayPaths, Sampling, trace_paths
from invertwin.checks import checked_number
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.links import responses
from invertwin.links.metasurface.panel import Metasurface, panel_paths
from invertwin.links.responses import AntennaMount, path_amplitudes, phasor, sum_over_paths
from invertwin.links.scattered import scattered_moments
from invertwin.links.spreads import path_powers
from invertwin.links.transmitters import Transmitters
from invertwin.scene.material.fresnel import safe_root
from invertwin.scene.scene import Scene

_Receivers = Float64[Tensor, "rx 3"]
_Senders = Float64[Tensor, "tx 3"]
_RECEIVERS_PER_BATCH = 512
_VALUES_PER_CHUNK = 1 << 21
_MAX_NODES = 1000  # Gauss's rule of more takes long to find
_gauss_nodes = cache(leggauss)


@dataclass(frozen=True, eq=False)
class LinkStatistics:
    """Path gain and delay spread at receiver locations, for every transmitter.

    Attributes:
        gain: Ratio of received to transmitted power, [tx, …].
        delay_spread: Root-mean-square delay spread, weighted by the powers of paths [s].
    """

    gain: Float64[Tensor, "tx *place"]
    delay_spread: Float64[Tensor, "tx *place"]


@dataclass(frozen=True, eq=False)
class PropagationSettings:
    """Settings of the search for propagation paths and of the sum over them.

    Attributes:
        frequency: Carrier frequency [Hz].
        bandwidth: Bandwidth of the receivers [Hz]: powers are means over this band. 0 = fields are
            added at the carrier; None = powers of paths are added.
        depth: Maximum number of reflections per path, see ``trace_paths``.
        edges: Maximum number of edge diffractions per path.
        rays: Number of rays that search for sequences of surfaces; None = all sequences are tested.
        receivers: Antenna mount of every receiver; the power is the mean over its elements.
        panels: Metasurfaces whose paths are added, see ``panel_paths``.
        rough: Sampling of paths scattered by rough surfaces, over all receivers; their power is
            added. None = left out.

    Raises:
        InputError: A value out of range, or edges without a bandwidth.
    """

    frequency: float
    bandwidth: float | None = None
    depth: int = 3
    edges: int = 0
    rays: int | None = 100_000
    receivers: AntennaMount = field(default_factory=AntennaMount)
    panels: Sequence[Metasurface] = ()
    rough: Sampling | None = None

    def __post_init__(self) -> None:
        checked_number(self.frequency, "frequency [Hz]", 0.0, open_low=True)
        if self.bandwidth is not None:
            checked_number(self.bandwidth, "bandwidth [Hz]", 0.0)
        elif self.edges:
            raise InputError(
                "expected a bandwidth with edges, got none: at a shadow a path and what the edge "
                "diffracts have one delay, and their powers do not add; give a bandwidth, 0 for "
                "the carrier alone"
            )

    def trace_links(
        self, scene: Scene, sensor: Transmitters, positions: Float64[Tensor, "place 3"], seed: int
    ) -> RayPaths:
        """Trace the paths from all transmitters to some receivers.

        Args:
            scene: Propagation environment.
            sensor: Transmitters.
            positions: Positions of the receivers [m].
            seed: Seed of the rays that find them.
        """
        link, rays = (sensor.positions, positions, self.frequency), self.rays
        found = trace_paths(scene, *link, depth=self.depth, edges=self.edges, rays=rays, seed=seed)
        return found + panel_paths(scene, self.panels, *link) if self.panels else found

    def link_statistics(
        self, scene: Scene, sensor: Transmitters, positions: Float64[Tensor, "place 3"], seed: int
    ) -> LinkStatistics:
        """Compute gain and delay spread at points, in memory independent of their number.

        Args:
            scene: Propagation environment.
            sensor: Transmitters.
            positions: Positions of the receivers [m].
            seed: Seed of the rays that find paths.
        """
        gain, moments = self.gains_and_moments(scene, sensor, positions, seed)
        return LinkStatistics(gain, delay_spread_from_moments(moments))

    def gains_and_moments(
        self, scene: Scene, sensor: Transmitters, positions: Float64[Tensor, "place 3"], seed: int
    ) -> tuple[Float64[Tensor, "tx place"], Float64[Tensor, "tx place 3"]]:
        """Gains at points by the chosen sum over paths, and sums of ``moments``.

        Args:
            scene: Propagation environment.
            sensor: Transmitters.
            positions: Positions of the receivers [m].
            seed: Seed of the rays that find paths.
        """

        def evaluate_batch(batch: Tensor) -> tuple[Tensor, Tensor]:
            paths = self.trace_links(scene, sensor, batch, seed)
            gain = received_gain(paths, self.bandwidth, sensor.mount, self.receivers)
            return gain.T, self.sum_moments(paths, sensor, batch)

        gain, moments = evaluate_in_batches(evaluate_batch, positions)
        more = self.diffuse_moments(scene, sensor, positions, seed)
        return gain + more[..., 0], moments + more

    def path_moments(
        self, paths: RayPaths, tx: _Senders, rx: _Receivers, tx_mount: AntennaMount
    ) -> Float64[Tensor, "path 3"]:
        """Power of each path, and its products with the excess delay [s] and with its square [s²].

        The excess delay is that over the straight line.

        Args:
            paths: Paths from ``trace_paths``.
            tx: Positions of the transmitters [m].
            rx: Positions of the receivers [m].
            tx_mount: Antenna mount of the transmitters.
        """
        power = path_powers(paths, tx_mount, self.receivers)
        tx, rx = (places.to(paths.delay.device) for places in (tx, rx))
        excess = paths.delay - (rx[paths.rx] - tx[paths.tx]).norm(dim=1) / SPEED_OF_LIGHT
        return torch.stack([power, power * excess, power * excess**2], 1)

    def sum_moments(
        self, paths: RayPaths, sensor: Transmitters, positions: Float64[Tensor, "place 3"]
    ) -> Float64[Tensor, "tx place 3"]:
        """Sums of ``moments`` over the paths of each link.

        Args:
            paths: Paths from the transmitters to the receivers.
            sensor: Transmitters.
            positions: Positions of the receivers [m].
        """
        each = self.path_moments(paths, sensor.positions, positions, sensor.mount)
        return sum_over_paths(paths, each)

    def panel_and_diffuse_moments(
        self, scene: Scene, sensor: Transmitters, positions: Float64[Tensor, "place 3"], seed: int
    ) -> Float64[Tensor, "tx place 3"]:
        """Sums of ``moments`` of what ``trace_coverage`` lacks: panels, rough surfaces, tails.

        Args:
            scene: Propagation environment.
            sensor: Transmitters.
            positions: Positions of the receivers [m].
            seed: Seed of the paths that are drawn.
        """

        def evaluate_batch(batch: Tensor) -> tuple[Tensor]:
            over = panel_paths(scene, self.panels, sensor.positions, batch, self.frequency)
            return (self.sum_moments(over, sensor, batch),)

        total = self.diffuse_moments(scene, sensor, positions, seed)
        return total + evaluate_in_batches(evaluate_batch, positions)[0] if self.panels else total

    def diffuse_moments(
        self, scene: Scene, sensor: Transmitters, positions: Float64[Tensor, "place 3"], seed: int
    ) -> Float64[Tensor, "tx place 3"]:
        """Sums of ``moments`` over paths scattered by rough surfaces, and of the reverberant tail.

        Args:
            scene: Scene with rough surfaces.
            sensor: Transmitters.
            positions: Positions of the receivers [m].
            seed: Seed of the paths that are drawn.
        """
        found = positions.new_zeros(len(sensor.positions), len(positions), 3)
        if self.rough is not None:
            link = scene, sensor, self.receivers, positions, self.frequency
            found = scattered_moments(*link, self.rough, seed, depth=self.depth, rays=self.rays)
        tail = sensor.reverberation
        return found if tail is None else found + tail.link_moments(sensor.positions, positions)

    def frequency_responses(
        self,
        scene: Scene,
        sensor: Transmitters,
        positions: Float64[Tensor, "place 3"],
        frequencies: Float64[Tensor, " frequency"],
        seed: int,
    ) -> Complex128[Tensor, "tx place frequency"]:
        """Compute H(f) of the first elements at points. See ``frequency_response``.

        Args:
            scene: Propagation environment.
            sensor: Transmitters.
            positions: Positions of the receivers [m].
            frequencies: [Hz].
            seed: Seed of the rays that find paths.

        Raises:
            InputError: With scattered power, which has no phase.
        """
        if self.rough is not None:
            raise InputError(
                "expected a reception without scattered power for responses, got "
                f"{self.rough}; scattered power has no phase: leave it out"
            )

        def evaluate_batch(batch: Tensor) -> tuple[Tensor]:
            paths = self.trace_links(scene, sensor, batch, seed)
            ends = {"tx": sensor.mount, "rx": self.receivers}
            response = responses.frequency_response(paths, frequencies, **ends)[:, 0, :, 0]
            return (response.transpose(0, 1),)

        return evaluate_in_batches(evaluate_batch, positions)[0]


def delay_spread_from_moments(moments: Float64[Tensor, "*link 3"]) -> Float64[Tensor, "*link"]:
    """Root mean square spread of delays [s], of sums of ``PropagationSettings.path_moments``.

    Args:
        moments: Power, and its first and second moment over excess delay.
    """
    power, first, second = moments.unbind(-1)
    safe = torch.where(power > 0, power, 1.0)
    return safe_root(second / safe - (first / safe) ** 2, 0.0)


def evaluate_in_batches(
    evaluate: Callable[[Tensor], tuple[Tensor, ...]], positions: Float64[Tensor, "place 3"]
) -> list[Tensor]:
    """Tables [tx, place, …] of many places, some at a time.

    What derivatives need is not kept, but computed again for each batch.

    Args:
        evaluate: Tables of some places; the same each time it is called.
        positions: All of them.
    """
    parts = positions.split(_RECEIVERS_PER_BATCH)
    again = len(parts) > 1 and torch.is_grad_enabled()
    tables = [
        checkpoint(evaluate, some, use_reentrant=False) if again else evaluate(some)
        for some in parts
    ]
    return [torch.cat(column, 1) for column in zip(*tables, strict=True)]


def received_gain(
    paths: RayPaths,
    bandwidth: float | None = None,
    tx: AntennaMount = responses.DEFAULT_MOUNT,
    rx: AntennaMount = responses.DEFAULT_MOUNT,
) -> Float64[Tensor, "rx tx"]:
    """Ratio of received to transmitted power of every link; 0 without a path.

    Args:
        paths: Paths from ``trace_paths``.
        bandwidth: Bandwidth of the mean, about the carrier [Hz]; 0 = the carrier alone,
            None = powers of paths add.
        tx: Antenna mount of the transmitters; the gain is the mean over all pairs of elements.
        rx: Antenna mount of the receivers.
    """
    amplitude, delay = path_amplitudes(paths, tx, rx)
    if bandwidth is None:
        total = sum_over_paths(paths, torch.view_as_real(amplitude).square().sum(-1))
    elif not bandwidth:
        field = sum_over_paths(paths, amplitude * phasor(-paths.frequency * delay))
        total = torch.view_as_real(field).square().sum(-1)
    else:
        total = _band_mean(paths, amplitude * phasor(-paths.frequency * delay), delay, bandwidth)
    return total.mean((-2, -1)).view(paths.counts).T


def _band_mean(paths: RayPaths, field: Tensor, delay: Tensor, bandwidth: float) -> Tensor:
    """⟨|H|²⟩ over the band, of each link: by pairs of few paths, over frequencies of many."""
    row, there = (table.flatten(0, 1) for table in paths.pad_links())
    if not row.shape[1]:
        return delay.new_zeros(len(row), *delay.shape[1:])
    filled = there[..., None, None]
    with torch.no_grad():
        ends = [
            torch.where(filled, sign * delay[row], -torch.inf).amax((1, 2, 3)) for sign in (1, -1)
        ]
        middle = torch.where(there.any(1), 0.5 * (ends[0] - ends[1]), 0.0)
        widest = float((ends[0] + ends[1]).clamp_min(0.0).max())
    # Nodes of Gauss's rule by which the mean of cos(phase·x), |x| < 1, is right to 1e-13.
    phase = math.pi * bandwidth * widest
    nodes = math.ceil(0.5 * phase + 4.5 * phase ** (1 / 3) + 5)
    pairs = nodes > min(row.shape[1], _MAX_NODES)
    cost = row.shape[1] * (row.shape[1] if pairs else nodes) * field.shape[1] * field.shape[2]
    found = []
    for some in torch.arange(len(row), device=row.device).split(max(1, _VALUES_PER_CHUNK // cost)):
        parts = torch.where(filled[some], field[row[some]], 0.0)
        late = torch.where(filled[some], delay[row[some]] - middle[some, None, None, None], 0.0)
        late = bandwidth * late
        found.append(
            _sum_over_pairs(parts, late) if pairs else _mean_over_nodes(parts, late, nodes)
        )
    return torch.cat(found)


def _sum_over_pairs(field: Tensor, delay_cycles: Tensor) -> Tensor:
    """Σᵢ Σⱼ fᵢ fⱼ* sinc(B(τᵢ − τⱼ)) of each link."""
    parts = torch.view_as_real(field)
    apart = delay_cycles[:, :, None] - delay_cycles[:, None]
    found = torch.einsum("lirtc,lijrt,ljrtc->lrt", parts, torch.sinc(apart), parts)
    return found.clamp_min(0.0)  # rounding may leave a little less than nothing


def _mean_over_nodes(field: Tensor, delay_cycles: Tensor, count: int) -> Tensor:
    """The same as a mean of |H|² over frequencies in the band, those of Gauss's rule."""
    places, weights = (torch.from_numpy(part).to(field.device) for part in _gauss_nodes(count))
    total = torch.einsum("lirt,lirtn->lrtn", field, phasor(-0.5 * delay_cycles[..., None] * places))
    return 0.5 * torch.view_as_real(total).square().sum(-1) @ weights
