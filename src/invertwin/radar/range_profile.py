"""Exact radar signal: paths to beat signal to range profile, as a real radar does it."""

import math
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import reduce
from typing import Any

import finufft
import numpy as np
import torch
from jaxtyping import Complex, Complex128, Float64
from torch import Tensor

from invertwin.channel import Grid, Paths
from invertwin.constants import BOLTZMANN, SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.radar.nonuniform import beat_of_delays, sums_on_gpu
from invertwin.radar.radar import Radar, sampled
from invertwin.radar.waveform import PhysicsWarning, SampledWaveform, sample_window

_STANDARD_TEMPERATURE = 290.0  # K, at which noise figures are defined


def beat_signal(
    paths: Paths, radar: Radar, *, tolerance: float = 1e-9
) -> Complex128[Tensor, "frame tx rx sample"]:
    """Beat (IF) signal of every TX and RX element: transmit × conj(receive).

        s[n] = Σ conj(a) exp(2πj (f_n τ − S τ²/2))

    with f_n the frequency of the sample (f0 + S t_n on an FMCW ramp), S the slope of the ramp
    (0 where the frequency stands: stepped frequency, OFDM, whose s is conj(H)), and τ the delay
    from the TX element over the path to the RX element: the path's own delay between the phase
    centres, corrected by the exact lengths from its first and last vertex, so the near field
    and multiple bounces are exact. The sum is a non-uniform FFT (type 1) in float64 on the CPU;
    its adjoint (type 2) gives gradients in the coefficient, delay, first and last vertex and
    the radar's poses.

    Source: eq:fmcw_if of the paper; derivations §1 and §6.
    Differs from the source: the coefficient is conj(a) and holds the path's phase φ (printed
    inside 2πj(…)).

    Args:
        paths: Field paths; their frames index the radar's poses.
        radar: One with samples: FMCW, stepped frequency, OFDM.
        tolerance: Relative error of the sum.

    Raises:
        InputError: The radar has no samples, the paths carry power only, or a frame is missing.
    """
    waveform = sampled(radar)
    check_paths(paths, radar, waveform)
    if sums_on_gpu(paths.delay):
        return tensor_beat(paths, radar, waveform, tolerance)
    device = paths.delay.device
    tx, rx = (places.cpu() for places in radar.elements())
    centers = tx.mean(1), rx.mean(1)
    order = torch.argsort(paths.frame, stable=True)
    counts = torch.bincount(paths.frame, minlength=radar.frame_count).tolist()
    signals = []
    for frame, rows in enumerate(torch.split(order, counts)):
        first, last = paths.first[rows].cpu(), paths.last[rows].cpu()
        # What remains of the delay when the legs to the antennas are taken off.
        legs = (first - centers[0][frame]).norm(dim=-1) + (last - centers[1][frame]).norm(dim=-1)
        inner = paths.delay[rows].cpu() - legs / SPEED_OF_LIGHT
        coefficient = paths.coefficient[rows].cpu()
        signals.append(
            _BeatSum.apply(
                coefficient, inner, first, last, tx[frame], rx[frame], waveform, tolerance
            )
        )
    return torch.stack(signals).to(device)


def tensor_beat(
    paths: Paths, radar: Radar, waveform: SampledWaveform, tolerance: float
) -> Complex128[Tensor, "frame tx rx sample"]:
    """The same in tensor operations, wherever the paths are; slower on a CPU."""
    device = paths.delay.device
    tx, rx = (places.to(device) for places in radar.elements())
    frames = []
    for frame in range(radar.frame_count):
        rows = torch.nonzero(paths.frame == frame)[:, 0]
        first, last, coefficient = paths.first[rows], paths.last[rows], paths.coefficient[rows]
        legs = (first - tx[frame].mean(0)).norm(dim=1) + (last - rx[frame].mean(0)).norm(dim=1)
        inner = paths.delay[rows] - legs / SPEED_OF_LIGHT
        forth = [(first - place).norm(dim=1) for place in tx[frame]]
        back = [(last - place).norm(dim=1) for place in rx[frame]]
        channels = [
            beat_of_delays(
                coefficient, (inner + (f + b) / SPEED_OF_LIGHT)[None], waveform, tolerance
            )
            for f in forth
            for b in back
        ]
        frames.append(torch.stack(channels).unflatten(0, (len(forth), len(back))))
    return torch.stack(frames)


def add_noise(
    beat: Complex128[Tensor, "*batch sample"],
    radar: Radar | None = None,
    *,
    seed: int,
    snr_db: float | None = None,
    noise_figure_db: float | None = None,
    transmit_power: float = 0.01,
) -> Complex128[Tensor, "*batch sample"]:
    """Beat signal, of frames or of trains of chirps, plus white complex Gaussian noise.

    Give either a signal-to-noise ratio or a noise figure. The power per sample is the mean
    signal power over ``snr_db``, or ``k T0 F b`` (T0 = 290 K, b the waveform's noise bandwidth,
    the sampling rate of an FMCW radar) relative to the transmit power, since |s|² is received
    over transmitted power.

    Args:
        beat: Signal without noise.
        radar: Needed with ``noise_figure_db`` for the noise bandwidth.
        seed: The same seed gives the same noise.
        snr_db: Mean signal over noise power in each sample [dB].
        noise_figure_db: Of the receiver [dB].
        transmit_power: Of one transmitter [W].

    Raises:
        InputError: Not exactly one of the two levels, or no radar for the noise figure.
    """
    if (snr_db is None) == (noise_figure_db is None):
        raise InputError(
            f"expected either snr_db or noise_figure_db, got {snr_db} and {noise_figure_db}; "
            "give exactly one"
        )
    if snr_db is not None:
        power = float(beat.detach().abs().square().mean()) * 10 ** (-snr_db / 10)
    elif noise_figure_db is not None and radar is not None:
        rate = sampled(radar).noise_bandwidth
        factor = 10 ** (noise_figure_db / 10)
        power = BOLTZMANN * _STANDARD_TEMPERATURE * factor * rate / transmit_power
    else:
        raise InputError(
            "expected a radar with noise_figure_db, got None; pass the radar of the beat signal"
        )
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(beat.shape, dtype=torch.complex128, generator=generator)
    return beat + math.sqrt(power) * noise.to(beat.device)


def range_profile(
    beat: Complex[Tensor, "frame tx rx sample"], radar: Radar, grid: Grid
) -> Complex[Tensor, "frame tx rx range"]:
    """Windowed range transform at the grid's ranges.

    Normalised by the window's sum: a path of coefficient a peaks at |a|. Ranges on the bins of
    a zero-padded FFT use it; others use the same sum as a matrix.

    Source: eq:fmcw_fft of the paper.

    Raises:
        InputError: The signal does not fit the radar.
    """
    waveform = sampled(radar)
    expected = (
        radar.frame_count,
        len(radar.transmitters.positions),
        len(radar.receivers.positions),
        waveform.samples,
    )
    if tuple(beat.shape) != expected:
        raise InputError(
            f"expected a beat signal of shape {expected} (frame, tx, rx, sample), got "
            f"{tuple(beat.shape)}; use the radar that recorded it"
        )
    window = sample_window(waveform, radar.window)
    tapered = beat * (window / window.sum()).to(beat.device, beat.real.dtype)
    bins = _fft_bins(waveform, grid)
    if bins is None:
        return tapered @ _range_matrix(waveform, grid).to(beat.device, beat.dtype)
    length, first = bins
    return torch.fft.fft(tapered, length)[..., first : first + grid.range_count]


def check_paths(paths: Paths, radar: Radar, waveform: SampledWaveform) -> None:
    """Raise where the paths cannot be summed, warn where they appear at wrong ranges."""
    if paths.kind == "power":
        raise InputError(
            "expected field paths, got power paths, which have no phase; use trace_field, or "
            "the surrogate for power"
        )
    if radar.biased:
        raise InputError(
            f"expected range_bias 0 for exact signals, got {radar.range_bias}; fit a range bias "
            "with a surrogate"
        )
    if len(paths) == 0:
        return
    if not 0 <= int(paths.frame.min()) <= int(paths.frame.max()) < radar.frame_count:
        raise InputError(
            f"expected path frames in 0..{radar.frame_count - 1}, got {int(paths.frame.min())}.."
            f"{int(paths.frame.max())}; trace with the link of the same radar"
        )
    beyond = int((paths.range > waveform.max_range).sum())
    if beyond:
        warnings.warn(
            f"{beyond} of {len(paths)} paths lie beyond the unambiguous range of "
            f"{waveform.max_range:.2f} m and appear at wrong ranges; use finer frequency steps, "
            "which are more samples on a ramp",
            PhysicsWarning,
            stacklevel=3,
        )


def _fft_bins(waveform: SampledWaveform, grid: Grid) -> tuple[int, int] | None:
    """FFT length and first bin when all ranges are FFT bins, else None."""
    length = waveform.max_range / grid.range_step
    first = grid.range_start / grid.range_step
    on_bins = max(abs(length - round(length)), abs(first - round(first))) < 1e-6
    inside = round(first) >= 0 and round(first) + grid.range_count <= round(length)
    if on_bins and inside and round(length) >= waveform.samples:
        return round(length), round(first)
    return None


def _range_matrix(waveform: SampledWaveform, grid: Grid) -> Complex128[Tensor, "sample range"]:
    cycles = torch.arange(waveform.samples)[:, None] * (grid.ranges / waveform.max_range)
    return torch.exp(-2j * math.pi * cycles)


@dataclass(frozen=True)
class _Signal:
    """One frame's paths in the form that the sums read: columns of numpy arrays.

    The samples are counted from the middle one, as finufft orders its modes: s[n] =
    Σ b exp(j (carrier phase + (n − N//2) x)) with x = 2π step τ.
    """

    coefficient: np.ndarray  # conj(a), [path]
    inner: np.ndarray  # s, [path]
    first: np.ndarray  # m, [3, path]
    last: np.ndarray
    tx: np.ndarray  # m, [tx, 3]
    rx: np.ndarray
    waveform: SampledWaveform
    tolerance: float

    @property
    def rate(self) -> float:
        """Phase per sample and delay [rad/s]."""
        return 2 * math.pi * self.waveform.step

    def shares(self) -> list[list[tuple[int, int]]]:
        """All (tx, rx) pairs, dealt out to the threads."""
        pairs = [(t, r) for t in range(len(self.tx)) for r in range(len(self.rx))]
        threads = min(torch.get_num_threads(), len(pairs))
        return [pairs[thread::threads] for thread in range(threads)]

    def delay(self, tx: int, rx: int) -> np.ndarray:
        """Delay of every path between two elements [s]."""
        length = _distance(self.first, self.tx[tx])
        length += _distance(self.last, self.rx[rx])
        length /= SPEED_OF_LIGHT
        length += self.inner
        return length

    def carrier(self, delay: np.ndarray) -> np.ndarray:
        """exp(j phase at the middle sample)."""
        waveform = self.waveform
        # In cycles, reduced in float64: at 77 GHz and 200 m the phase is 1e5 cycles.
        cycles = (-0.5 * waveform.residual_slope) * delay
        cycles += waveform.start_frequency + waveform.samples // 2 * waveform.step
        cycles *= delay
        cycles -= np.rint(cycles)
        cycles *= 2 * math.pi
        phasor = np.empty(len(delay), dtype=np.complex128)
        np.cos(cycles, out=phasor.real)
        np.sin(cycles, out=phasor.imag)
        return phasor

    def plan(self, kind: int, transforms: int) -> finufft.Plan:
        # One thread per transform: a channel is too small to share, so channels are shared out.
        return finufft.Plan(
            kind,
            (self.waveform.samples,),
            transforms,
            eps=self.tolerance,
            isign=1 if kind == 1 else -1,
            nthreads=1,
        )


class _BeatSum(torch.autograd.Function):
    """Sum over the paths of one frame for all channels, with a hand-written adjoint."""

    @staticmethod
    def forward(
        ctx: Any,
        coefficient: Complex128[Tensor, " path"],
        inner: Float64[Tensor, " path"],
        first: Float64[Tensor, "path 3"],
        last: Float64[Tensor, "path 3"],
        tx: Float64[Tensor, "tx 3"],
        rx: Float64[Tensor, "rx 3"],
        waveform: SampledWaveform,
        tolerance: float,
    ) -> Complex128[Tensor, "tx rx sample"]:
        signal = _Signal(
            coefficient.detach().conj().resolve_conj().numpy(),
            inner.detach().numpy(),
            np.ascontiguousarray(first.detach().numpy().T),
            np.ascontiguousarray(last.detach().numpy().T),
            tx.detach().numpy(),
            rx.detach().numpy(),
            waveform,
            tolerance,
        )
        ctx.signal = signal
        result = np.zeros((len(tx), len(rx), waveform.samples), dtype=np.complex128)

        def share(pairs: list[tuple[int, int]]) -> None:
            plan = signal.plan(1, 1)
            for t, r in pairs:
                delay = signal.delay(t, r)
                strengths = signal.carrier(delay)
                strengths *= signal.coefficient
                delay *= signal.rate
                plan.setpts(delay)
                result[t, r] = plan.execute(strengths)

        if len(inner):
            _in_threads(share, signal.shares())
        return torch.from_numpy(result)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        signal: _Signal = ctx.signal
        grad = grads[0].resolve_conj().numpy()
        count = len(signal.inner)
        if count == 0:
            zeros = [np.zeros(0), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3))]
            parts = [*zeros, np.zeros_like(signal.tx), np.zeros_like(signal.rx)]
        else:
            shares = _in_threads(lambda pairs: _adjoint_share(signal, grad, pairs), signal.shares())
            parts = [reduce(np.add, terms) for terms in zip(*shares, strict=True)]
        coefficient, inner, first, last, tx, rx = parts
        gradients = (np.conj(coefficient), inner, first.T, last.T, tx, rx)
        return *(torch.from_numpy(np.ascontiguousarray(g)) for g in gradients), None, None

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> Tensor:  # type: ignore[override]
        signal: _Signal = ctx.signal
        like = (signal.coefficient, signal.inner, signal.first.T, signal.last.T)
        columns = [
            np.zeros_like(value) if tangent is None else tangent.resolve_conj().numpy()
            for value, tangent in zip((*like, signal.tx, signal.rx), tangents[:6], strict=True)
        ]
        size = (len(signal.tx), len(signal.rx), signal.waveform.samples)
        result = np.zeros(size, dtype=np.complex128)

        def share(pairs: list[tuple[int, int]]) -> None:
            _forward_share(signal, columns, pairs, result)

        if len(signal.inner):
            _in_threads(share, signal.shares())
        return torch.from_numpy(result)


def _forward_share(
    signal: _Signal, change: list[np.ndarray], pairs: list[tuple[int, int]], result: np.ndarray
) -> None:
    """Derivative of some channels when the inputs of the sum change.

    Of s_n = Σ b E_n: Σ (ḃ − 2πj S τ τ̇ b) E_n + f_n Σ 2πj τ̇ b E_n.
    """
    coefficient, inner, first, last, tx, rx = change
    waveform = signal.waveform
    frequency = waveform.frequencies.numpy()
    plan = signal.plan(1, 2)
    for t, r in pairs:
        delay = signal.delay(t, r)
        speed = np.zeros(len(delay))
        for vertex, element, vertex_change, element_change in (
            (signal.first, signal.tx[t], first, tx[t]),
            (signal.last, signal.rx[r], last, rx[r]),
        ):
            away = (vertex - element[:, None]) / _distance(vertex, element)
            speed += np.sum(away * (vertex_change - element_change).T, axis=0)
        speed = inner + speed / SPEED_OF_LIGHT
        turning = 2j * math.pi * speed * signal.coefficient
        strengths = np.stack(
            [coefficient.conj() - waveform.residual_slope * delay * turning, turning]
        )
        plan.setpts(signal.rate * delay)
        sums = plan.execute(strengths * signal.carrier(delay))
        result[t, r] = sums[0] + frequency * sums[1]


def _adjoint_share(
    signal: _Signal, grad: np.ndarray, pairs: list[tuple[int, int]]
) -> list[np.ndarray]:
    """Gradients of the loss from some channels: dL = Re Σ conj(grad_n) ds_n.

    With s_n = Σ b E_n: Σ grad_n conj(E_n) for b, and 2π Im(conj(b) Σ grad_n conj(E_n) (f_n − S τ))
    for the delay.
    """
    waveform, count = signal.waveform, len(signal.inner)
    frequency = waveform.frequencies.numpy()
    plan = signal.plan(2, 2)
    of_b = np.zeros(count, dtype=np.complex128)
    of_delay = np.zeros(count)
    of_first, of_last = np.zeros((3, count)), np.zeros((3, count))
    of_tx, of_rx = np.zeros_like(signal.tx), np.zeros_like(signal.rx)
    for t, r in pairs:
        delay = signal.delay(t, r)
        plan.setpts(signal.rate * delay)
        sums = plan.execute(np.stack([grad[t, r], grad[t, r] * frequency]))
        sums *= signal.carrier(delay).conj()
        sums[1] -= waveform.residual_slope * delay * sums[0]
        of_b += sums[0]
        of_channel = 2 * math.pi * (signal.coefficient.conj() * sums[1]).imag
        of_delay += of_channel
        of_channel /= SPEED_OF_LIGHT
        for of_vertex, of_element, vertex, element in (
            (of_first, of_tx[t], signal.first, signal.tx[t]),
            (of_last, of_rx[r], signal.last, signal.rx[r]),
        ):
            pull = (vertex - element[:, None]) * (of_channel / _distance(vertex, element))
            of_vertex += pull
            of_element -= pull.sum(1)
    return [of_b, of_delay, of_first, of_last, of_tx, of_rx]


def _distance(points: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Distances of points [3, path] from one place [path]."""
    square = np.square(points[0] - place[0])
    for axis in (1, 2):
        square += np.square(points[axis] - place[axis])
    return np.sqrt(square, out=square)


def _in_threads(share: Callable[[list], Any], shares: list[list]) -> list[Any]:
    if len(shares) == 1:
        return [share(shares[0])]
    with ThreadPoolExecutor(len(shares)) as pool:
        return list(pool.map(share, shares))
