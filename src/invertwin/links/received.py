"""What receivers get of transmitters: path gain and delay spread of many links at once.

Powers of paths may add, or their fields. The mean over a band stands between: fields of paths add
whose delays differ by less than 1/B, powers of the others,

    ⟨|H|²⟩ = Σᵢ Σⱼ aᵢ aⱼ* exp(−j2πf₀(τᵢ − τⱼ)) sinc(B(τᵢ − τⱼ)).

At the shadow of an edge the lost path and what the edge diffracts have one delay: their fields add
in every band, and the mean has no jump. Powers that add would jump by up to 7 dB.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from invertwin.channel import RayPaths, trace_paths
from invertwin.errors import InputError
from invertwin.links.metasurface import Metasurface, panel_paths
from invertwin.links.responses import Terminals, frequency_response, path_amplitudes, phasors
from invertwin.links.spreads import delay_spread
from invertwin.links.transmitters import Transmitters
from invertwin.scene.checks import checked_number
from invertwin.scene.scene import Scene

_RECEIVERS_AT_ONCE = 512
_PAIRS_AT_ONCE = 1 << 21
_DEFAULT = Terminals()


@dataclass(frozen=True, eq=False)
class Received:
    """What arrives at places, for every transmitter.

    Attributes:
        gain: Received over sent power.
        delay_spread: Root mean square, by the powers of paths [s].
    """

    gain: Float64[Tensor, "tx *place"]
    delay_spread: Float64[Tensor, "tx *place"]


@dataclass(frozen=True, eq=False)
class Reception:
    """How paths between transmitters and receivers are found, and how they add up.

    Attributes:
        frequency: The carrier [Hz].
        bandwidth: Of the receivers [Hz]: powers are means over this band. 0 = fields add at the
            carrier alone, None = powers of paths add.
        depth: Most surfaces that a path meets, see ``trace_paths``.
        edges: Most edges that a path goes round.
        rays: Shot to find sequences of surfaces; None tries all.
        receivers: Antenna and axes of every receiver; of several elements the mean power counts.
        panels: Metasurfaces, whose paths are added, see ``panel_paths``.

    Raises:
        InputError: A number out of range, or edges without a bandwidth.
    """

    frequency: float
    bandwidth: float | None = None
    depth: int = 3
    edges: int = 0
    rays: int | None = 100_000
    receivers: Terminals = field(default_factory=Terminals)
    panels: Sequence[Metasurface] = ()

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

    def paths(
        self, scene: Scene, sensor: Transmitters, places: Float64[Tensor, "place 3"], seed: int
    ) -> RayPaths:
        """The paths from all transmitters to some receivers.

        Args:
            scene: What is in the way.
            sensor: What sends.
            places: Of the receivers [m].
            seed: Of the rays that find them.
        """
        found = trace_paths(
            scene,
            sensor.positions,
            places,
            self.frequency,
            depth=self.depth,
            edges=self.edges,
            rays=self.rays,
            seed=seed,
        )
        if not self.panels:
            return found
        over = panel_paths(scene, self.panels, sensor.positions, places, self.frequency)
        return found + over

    def at(
        self, scene: Scene, sensor: Transmitters, places: Float64[Tensor, "place 3"], seed: int
    ) -> Received:
        """What receivers get at points. Memory does not grow with their number, but for results.

        Args:
            scene: What is in the way.
            sensor: What sends.
            places: Of the receivers [m].
            seed: Of the rays that find paths.
        """

        def found(some: Tensor) -> tuple[Tensor, Tensor]:
            paths = self.paths(scene, sensor, some, seed)
            ends = (sensor.terminals, self.receivers)
            return received_gain(paths, self.bandwidth, *ends).T, delay_spread(paths, *ends).T

        gain, spread = in_batches(found, places)
        return Received(gain, spread)

    def responses(
        self,
        scene: Scene,
        sensor: Transmitters,
        places: Float64[Tensor, "place 3"],
        frequencies: Float64[Tensor, " frequency"],
        seed: int,
    ) -> Complex128[Tensor, "tx place frequency"]:
        """H(f) of the first elements, at points. See ``frequency_response``.

        Args:
            scene: What is in the way.
            sensor: What sends.
            places: Of the receivers [m].
            frequencies: [Hz].
            seed: Of the rays that find paths.
        """

        def found(some: Tensor) -> tuple[Tensor]:
            paths = self.paths(scene, sensor, some, seed)
            ends = {"tx": sensor.terminals, "rx": self.receivers}
            return (frequency_response(paths, frequencies, **ends)[:, 0, :, 0].transpose(0, 1),)

        return in_batches(found, places)[0]


def in_batches(
    found: Callable[[Tensor], tuple[Tensor, ...]], places: Float64[Tensor, "place 3"]
) -> list[Tensor]:
    """Tables [tx, place, …] of many places, some at a time.

    What derivatives need is not kept, but computed again for each batch.

    Args:
        found: Tables of some places; the same each time it is called.
        places: All of them.
    """
    parts = places.split(_RECEIVERS_AT_ONCE)
    again = len(parts) > 1 and torch.is_grad_enabled()
    tables = [
        checkpoint(found, some, use_reentrant=False) if again else found(some) for some in parts
    ]
    return [torch.cat(column, 1) for column in zip(*tables, strict=True)]


def received_gain(
    paths: RayPaths,
    bandwidth: float | None = None,
    tx: Terminals = _DEFAULT,
    rx: Terminals = _DEFAULT,
) -> Float64[Tensor, "rx tx"]:
    """Received over sent power of every link; 0 where no path leads.

    Args:
        paths: From ``trace_paths``.
        bandwidth: Over which the mean is taken, about the carrier [Hz]; 0 = the carrier alone,
            None = powers of paths add.
        tx: At the transmitters; of several elements the mean over all pairs counts.
        rx: At the receivers.
    """
    amplitude, delay = path_amplitudes(paths, tx, rx)
    if bandwidth is None:
        total = _added(paths, torch.view_as_real(amplitude).square().sum(-1))
    elif not bandwidth:
        field = _added(paths, amplitude * phasors(-paths.frequency * delay))
        total = torch.view_as_real(field).square().sum(-1)
    else:
        total = _band_mean(paths, amplitude * phasors(-paths.frequency * delay), delay, bandwidth)
    return total.mean((1, 2)).view(paths.counts).T


def _added(paths: RayPaths, values: Tensor) -> Tensor:
    """Sums over the paths of each link, [link, …]."""
    total = values.new_zeros(paths.counts[0] * paths.counts[1], *values.shape[1:])
    return total.index_add(0, paths.link, values)


def _band_mean(paths: RayPaths, field: Tensor, delay: Tensor, bandwidth: float) -> Tensor:
    """Σᵢ Σⱼ fᵢ fⱼ* sinc(B(τᵢ − τⱼ)) of each link."""
    row, there = (table.flatten(0, 1) for table in paths.padded())
    if not row.shape[1]:
        return delay.new_zeros(len(row), *delay.shape[1:])
    elements = field.shape[1] * field.shape[2]
    found = []
    step = max(1, _PAIRS_AT_ONCE // (row.shape[1] ** 2 * elements))
    for some, filled in zip(row.split(step), there.split(step), strict=True):
        parts = torch.view_as_real(torch.where(filled[..., None, None], field[some], 0.0))
        apart = bandwidth * (delay[some][:, :, None] - delay[some][:, None])
        found.append(torch.einsum("lirtc,lijrt,ljrtc->lrt", parts, torch.sinc(apart), parts))
    # Rounding may leave a little less than nothing.
    return torch.cat(found).clamp_min(0.0)
