"""Motion within a frame: the beat signal of a train of chirps."""

import warnings
from dataclasses import dataclass, replace

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

from invertwin.channel.paths import Paths
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.radar.radar import Radar
from invertwin.radar.range_profile import beat_signal
from invertwin.radar.waveform import PhysicsWarning


@dataclass(frozen=True)
class Chirps:
    """When the ramps of a frame start.

    Attributes:
        count: Chirps of each transmitter in a frame (loops).
        interval: From one ramp's start to the next, idle time included [s].
        tdm: Transmitters take turns (time-division MIMO); else they send at once, told apart
            by an ideal code.

    Raises:
        InputError: No chirps, or an interval that is not positive.
    """

    count: int
    interval: float
    tdm: bool = True

    def __post_init__(self) -> None:
        if self.count < 1 or not self.interval > 0:
            raise InputError(
                f"expected at least one chirp and an interval > 0, got {self.count} and "
                f"{self.interval}; the interval is idle time + ramp time in seconds"
            )

    def times(self, transmitters: int) -> Float64[Tensor, "chirp tx"]:
        """Start of every ramp [s], the first one at 0."""
        slots = torch.arange(self.count * transmitters, dtype=torch.float64)
        if self.tdm:
            return slots.reshape(self.count, transmitters) * self.interval
        return slots[: self.count, None].expand(-1, transmitters) * self.interval

    def max_speed(self, wavelength: float, transmitters: int) -> float:
        """Range rate beyond which Doppler is ambiguous, λ/(4 T) [m/s]."""
        turns = transmitters if self.tdm else 1
        return wavelength / (4 * self.interval * turns)


def moving_beat(
    paths: Paths, radar: Radar, chirps: Chirps
) -> Complex128[Tensor, "frame chirp tx rx sample"]:
    """Beat signals of a train of chirps, stop and go: each ramp sees the points where it starts.

    Scattering points move with their velocities; lengths to every element are exact at each
    chirp, amplitudes and visibility stay those of the start of the frame. Approaching points
    have falling delays, so their beat phase falls from chirp to chirp by 4π v T/λ.

    Source: derivations §1.
    Differs from the source: the paper's scenes stand still.

    Args:
        paths: From ``trace_field`` of a scene with velocities.
        radar: An FMCW radar, at rest within a frame.
        chirps: Timing.

    Raises:
        InputError: As ``beat_signal``; paths of several bounces.
    """
    if not torch.equal(paths.first, paths.last):
        raise InputError(
            "expected paths of one bounce, got paths whose first and last points differ; "
            "simulate their motion chirp by chirp with simulate_chirps(retrace=True)"
        )
    rows = []
    for instants in chirps.times(len(radar.transmitters.positions)).tolist():
        if chirps.tdm:
            slots = [
                _one_transmitter(_advanced(paths, radar, time), radar, tx)
                for tx, time in enumerate(instants)
            ]
            rows.append(torch.stack(slots, dim=1))
        else:
            rows.append(beat_signal(_advanced(paths, radar, instants[0]), radar))
    return torch.stack(rows, dim=1)


def _advanced(paths: Paths, radar: Radar, time: float) -> Paths:
    """The paths after their points moved for ``time``."""
    if paths.velocity is None or time == 0.0:
        return paths
    link = radar.link()
    places = paths.last + paths.velocity * time
    tx, rx = link.tx[paths.frame], link.rx[paths.frame]
    grown = (places - tx).norm(dim=1) - (paths.first - tx).norm(dim=1)
    grown = grown + (places - rx).norm(dim=1) - (paths.last - rx).norm(dim=1)
    return replace(paths, delay=paths.delay + grown / SPEED_OF_LIGHT, first=places, last=places)


def _one_transmitter(paths: Paths, radar: Radar, tx: int) -> Tensor:
    """The beat signal [frame, rx, sample] while one transmitter sends."""
    array = radar.transmitters
    with warnings.catch_warnings():
        # The spacing of all elements together has been judged; that of a part means nothing.
        warnings.simplefilter("ignore", PhysicsWarning)
        alone = replace(radar, transmitters=replace(array, positions=array.positions[tx : tx + 1]))
    # Delays refer to the phase centre, which is now the element itself.
    before, after = radar.link().tx[paths.frame], alone.link().tx[paths.frame]
    nearer = (paths.first - after).norm(dim=1) - (paths.first - before).norm(dim=1)
    delay = paths.delay + nearer / SPEED_OF_LIGHT
    return beat_signal(replace(paths, delay=delay), alone)[:, 0]
