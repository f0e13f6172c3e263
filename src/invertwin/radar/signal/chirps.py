"""Motion within a frame: beat signals of chirp trains."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel import Paths
from invertwin.checks import check_fields
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.limits import Count, Positive
from invertwin.radar.radar import Radar, require_sampled_waveform
from invertwin.radar.signal import nufft
from invertwin.radar.signal.range_profile import beat_signal, check_paths
from invertwin.radar.waveform import FMCW, SampledWaveform, SteppedFrequency
from invertwin.runtime.progress import track

# Maximum interpolation error of a path's phase factor between the instants of a ramp.
_INTERPOLATION_ERROR = 1e-6
_MAX_INSTANTS = 33

PointTrajectory = Callable[[float], Float64[Tensor, "path 3"]]
_Ramp = Complex128[Tensor, "frame sender rx sample"]  # signals of one ramp


@dataclass(frozen=True)
class Chirps:
    """Timing of the ramps of a frame.

    Attributes:
        count: number of chirps of each transmitter in a frame (loops).
        interval: time between the starts of consecutive ramps, idle time included [s].
        tdm: time-division MIMO; else transmitters are simultaneous, separated by ideal codes.
        order: transmitters, counted from 0, in the order of transmission; None = 0, 1, 2, …

    Raises:
        InputError: No chirps, an interval that is not positive, an order that does not name every
            transmitter once, or one for simultaneous transmitters.
    """

    count: Count
    interval: Positive
    tdm: bool = True
    order: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        if self.order is None:
            return
        object.__setattr__(self, "order", tuple(self.order))
        if not self.tdm:
            raise InputError(
                f"expected no order of transmitters that send at once, got {self.order}; "
                "leave it out, or set tdm=True"
            )
        check_order(self.order, len(self.order))

    def times(self, transmitters: int) -> Float64[Tensor, "chirp tx"]:
        """Return the first sample of every ramp [s], the first one at 0; columns are the radar's
        elements.

        Raises:
            InputError: An order of another number of transmitters.
        """
        slots = torch.arange(self.count * transmitters, dtype=torch.float64)
        if not self.tdm:
            return slots[: self.count, None].expand(-1, transmitters) * self.interval
        times = slots.reshape(self.count, transmitters) * self.interval
        if self.order is None:
            return times
        if len(self.order) != transmitters:
            raise InputError(
                f"expected an order of {transmitters} transmitters, got {self.order}; "
                "use the timing of this radar"
            )
        return times[:, torch.argsort(torch.tensor(self.order))]

    def max_speed(self, wavelength: float, transmitters: int) -> float:
        """Return the maximum unambiguous range rate, λ/(4 T) [m/s].

        Args:
            wavelength: wavelength [m].
            transmitters: number of time-multiplexed transmitters.
        """
        return wavelength / (4 * self.interval * (transmitters if self.tdm else 1))


def check_order(order: Sequence[int], transmitters: int) -> list[int]:
    """Return an order in which transmitters take turns, as a list.

    Args:
        order: numbers of the transmitters from 0.
        transmitters: number of transmitters.

    Raises:
        InputError: not every transmitter once.
    """
    if sorted(order) != list(range(transmitters)):
        raise InputError(
            f"expected an order that names each of {transmitters} transmitters once, from 0, got "
            f"{list(order)}; (0, 2, 1) is that of three whose last two are swapped"
        )
    return list(order)


def moving_beat(
    paths: Paths,
    radar: Radar,
    chirps: Chirps,
    *,
    trajectory: PointTrajectory | None = None,
    tolerance: float = 1e-9,
) -> Complex128[Tensor, "frame chirp tx rx sample"]:
    """Compute beat signals of a chirp train with moving scattering points.

    Every sample of every ramp has the delay at its own time, to each element, of the position of
    the point at the time of scattering. Delays are exact at three or more instants of a ramp, as
    many as limit the interpolation error to 1e-6. Range migration, acceleration and rotation are
    therefore exact within a ramp and between ramps. Amplitudes and visibility are those of the
    start of the frame. Approaching points have falling delays, so their beat phase falls from chirp
    to chirp by 4π v T/λ. Samples that are not taken in time (OFDM) have the points at the start of
    the symbol.

    Source: derivations §6.
    Differs from the source: the paper's scenes are static.

    Args:
        paths: paths from ``trace_field`` of a scene with velocities.
        radar: radar with samples, static within a frame.
        chirps: chirp timing.
        trajectory: world positions of the paths' points [m] at a time [s] after the start of the
            frame, for non-uniform motion; None = constant velocities.
        tolerance: relative error of the sums, see ``beat_signal``.

    Raises:
        InputError: As ``beat_signal``; moving paths of several bounces; points so fast that a
            ramp cannot follow them.
    """
    check_paths(paths, radar, require_sampled_waveform(radar))
    if trajectory is None and paths.velocity is None:
        beat = beat_signal(paths, radar, tolerance=tolerance)
        return beat[:, None].repeat(1, chirps.count, 1, 1, 1)
    if paths.first_velocity is None and not torch.equal(paths.first, paths.last):
        raise InputError(
            "expected paths of one bounce, got paths whose first and last points differ; "
            "simulate their motion chirp by chirp with simulate_chirps(retrace=True)"
        )
    train = ChirpTrain(paths, radar, trajectory or _uniform_trajectory(paths), tolerance)
    return simulate_chirp_train(chirps, radar.shape[1], train.simulate_ramp)


def simulate_chirp_train(
    chirps: Chirps, transmitters: int, ramp: Callable[[float, list[int]], _Ramp]
) -> Complex128[Tensor, "frame chirp tx rx sample"]:
    """Simulate the signals of all ramps of a train.

    Args:
        chirps: timing and transmission order.
        transmitters: Number of transmitters.
        ramp: function of the start [s] and the active transmitters that returns the signals of one
            ramp.
    """
    rows = []
    for starts in track(chirps.times(transmitters).tolist(), "chirps"):
        signals = {}
        for start in sorted(set(starts)):
            senders = [tx for tx, time in enumerate(starts) if time == start]
            signals |= dict(zip(senders, ramp(start, senders).unbind(1), strict=True))
        rows.append(torch.stack([signals[tx] for tx in range(transmitters)], dim=1))
    return torch.stack(rows, dim=1)


def range_rate(paths: Paths, radar: Radar) -> Float64[Tensor, " path"]:
    """Compute the derivative of the paths' range R = L/2 with respect to time [m/s].

    It is positive for receding points; the Doppler frequency is 2/λ times it.

    Args:
        paths: paths of one bounce, or by mirrors; the rate is zero for paths without velocity.
        radar: static radar.
    """
    if paths.velocity is None:
        return torch.zeros_like(paths.delay)
    link, velocity = radar.link(), paths.velocity
    first_velocity = velocity if paths.first_velocity is None else paths.first_velocity
    tx, rx = (centre.to(paths.first.device)[paths.frame] for centre in (link.tx, link.rx))
    away_tx, away_rx = normalize(paths.first - tx, dim=1), normalize(paths.last - rx, dim=1)
    return 0.5 * (first_velocity * away_tx + velocity * away_rx).sum(1)


def sample_interval(waveform: SampledWaveform) -> float:
    """Return the sampling interval [s]; 0 for simultaneous samples (OFDM)."""
    return float(waveform.sample_times[1]) if isinstance(waveform, FMCW | SteppedFrequency) else 0.0


@dataclass(frozen=True, eq=False)
class ChirpTrain:
    """Paths with moving points, and the radar of a chirp train.

    Attributes:
        paths: paths with frames, coefficients, and delays at their first points.
        radar: radar with samples.
        trajectory: positions of the first points at a time; the last ones move with them, but for
            the difference of both velocities that mirrors make.
        tolerance: relative error of the sums.
    """

    paths: Paths
    radar: Radar
    trajectory: PointTrajectory
    tolerance: float = 1e-9

    def simulate_ramp(self, start: float, active_transmitters: Sequence[int]) -> _Ramp:
        """Simulate one ramp with all receivers.

        Args:
            start: start of the ramp [s].
            active_transmitters: simultaneous transmitters.
        """
        paths, waveform = self.paths, require_sampled_waveform(self.radar)
        device = paths.delay.device
        centers = [centre.to(device) for centre in (self.radar.link().tx, self.radar.link().rx)]
        span = paths.last - paths.first
        ends = centers[0][paths.frame], centers[1][paths.frame]
        segments = _segment_length(paths.first, span, *ends)
        origins = self.radar.origin_delays.to(device)[paths.frame]
        inner = paths.delay - origins - segments / SPEED_OF_LIGHT
        placed, spans = self._points_at_instants(start, 1 if sample_interval(waveform) == 0 else 3)
        if len(placed) > 1 and len(paths):
            length = _segment_length(placed, spans, *ends)
            cycles = nufft.phase_cycles((length / SPEED_OF_LIGHT).detach(), waveform)
            bend = math.pi * float((cycles[0] - 2 * cycles[1] + cycles[2]).abs().max())
            count = _count_instants(bend)
            if count > 3:
                placed, spans = self._points_at_instants(start, count)
        transmitters, receivers = (places.to(device) for places in self.radar.elements())
        signals: list[list[Tensor]] = [[] for _ in active_transmitters]
        for frame in range(self.radar.frame_count):
            rows = torch.nonzero(paths.frame == frame)[:, 0]
            points = self._scattering_points(placed[:, rows], centers[1][frame])
            own, rest = paths.select(rows), inner[rows]
            last = points + spans[:, rows]
            back = [(last - place).norm(dim=-1) for place in receivers[frame]]
            for tx, found in zip(active_transmitters, signals, strict=True):
                forth = (points - transmitters[frame, tx]).norm(dim=-1)
                channels = []
                for rx, segment in enumerate(back):
                    field = self.radar.coefficient(own, tx, rx)
                    delay = (forth + segment) / SPEED_OF_LIGHT + rest
                    channels.append(nufft.beat_of_delays(field, delay, waveform, self.tolerance))
                found.append(torch.stack(channels))
        return torch.stack([torch.stack(found) for found in signals], dim=1)

    def _points_at_instants(self, start: float, count: int) -> tuple[Tensor, Tensor]:
        """Return the first points at the instants of a ramp, and the way on to the last ones."""
        paths, waveform = self.paths, require_sampled_waveform(self.radar)
        interval = sample_interval(waveform)
        instants = nufft.ramp_instants(waveform.samples, count) if interval else torch.zeros(1)
        times = start + interval * instants.double()
        span = (paths.last - paths.first).expand(len(times), -1, 3)
        if paths.first_velocity is not None and paths.velocity is not None:
            drift = paths.velocity - paths.first_velocity
            span = span + times.to(drift)[:, None, None] * drift
        return torch.stack([self.trajectory(time) for time in times.tolist()]), span

    def _scattering_points(self, points: Tensor, receiver: Tensor) -> Tensor:
        """Return the points at the scattering times of the signals received at the instants."""
        if len(points) == 1:
            return points
        waveform = require_sampled_waveform(self.radar)
        per_sample = nufft.instants_derivative(waveform.samples, len(points)).to(points.device)
        velocity = torch.einsum("kl,lpc->kpc", per_sample, points) / sample_interval(waveform)
        return points - (points - receiver).norm(dim=-1, keepdim=True) / SPEED_OF_LIGHT * velocity


def _uniform_trajectory(paths: Paths) -> PointTrajectory:
    velocity = paths.velocity if paths.first_velocity is None else paths.first_velocity
    assert velocity is not None
    return lambda time: paths.first + velocity * time


def _segment_length(first: Tensor, span: Tensor, tx: Tensor, rx: Tensor) -> Tensor:
    return (first - tx).norm(dim=-1) + (first + span - rx).norm(dim=-1)


def _count_instants(curvature: float) -> int:
    """Return the number of instants of a ramp for phases with this curvature at its ends [rad].

    Of exp(jψ) with ψ of second degree over [-1, 1], the power h = (count + 1)/2 is the first that a
    polynomial through the instants misses, by ψʰ/h! · 2^(1 − count).
    """
    for count in range(3, _MAX_INSTANTS + 1, 2):
        power = (count + 1) // 2
        if curvature**power / math.factorial(power) * 2.0 ** (1 - count) <= _INTERPOLATION_ERROR:
            return count
    raise InputError(
        f"expected points whose phase is near to a line over a ramp, got one that bends by "
        f"{curvature:.3g} rad; check velocities [m/s] and times [s], or shorten the ramp"
    )
