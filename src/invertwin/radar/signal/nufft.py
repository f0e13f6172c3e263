"""Beat signal of a channel: one non-uniform FFT, on the CPU or with CUDA."""

import math
from functools import cache, lru_cache
from importlib import import_module
from types import ModuleType
from typing import Any, TypeAlias

import finufft
import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

from invertwin.radar.waveform import SampledWaveform

_Delays: TypeAlias = Float64[Tensor, "instant path"]
_SHARED_PATHS = 20_000  # minimum number of paths for several threads


@cache
def _cufinufft() -> ModuleType | None:
    try:
        return import_module("cufinufft")
    except (ImportError, OSError):  # OSError: missing CUDA libraries
        return None


def ramp_instants(samples: int, count: int) -> Float64[Tensor, " instant"]:
    """Return the instants of a ramp for delays, in samples: its middle, or Chebyshev–Lobatto
    points.

    Args:
        samples: number of samples in a ramp.
        count: 1, or odd and at least 3; then the first, middle and last ones are those of the ramp.
    """
    if count == 1:
        return torch.tensor([float(samples // 2)], dtype=torch.float64)
    angle = torch.arange(count, dtype=torch.float64) * (math.pi / (count - 1))
    return 0.5 * (samples - 1) * (1 - torch.cos(angle))


@lru_cache(maxsize=32)
def _interpolation(samples: int, count: int) -> Float64[Tensor, "instant sample"]:
    """Return Lagrange polynomials through the instants, at the samples (barycentric form)."""
    apart = torch.arange(samples, dtype=torch.float64) - ramp_instants(samples, count)[:, None]
    there = apart.abs() < 1e-9
    terms = barycentric_weights(count)[:, None] / torch.where(there, 1.0, apart)
    return torch.where(there.any(0), there.to(apart), terms / terms.sum(0))


def instants_derivative(samples: int, count: int) -> Float64[Tensor, "instant instant"]:
    """Return the matrix of derivatives per sample at the instants, from values there.

    Args:
        samples: number of samples in a ramp.
        count: number of instants, as in ``ramp_instants``.
    """
    places, weight = ramp_instants(samples, count), barycentric_weights(count)
    apart = places[:, None] - places
    matrix = (weight / weight[:, None]) / (apart + torch.eye(count, dtype=torch.float64))
    matrix.fill_diagonal_(0.0)
    return matrix - torch.diag(matrix.sum(1))


def barycentric_weights(count: int) -> Float64[Tensor, " instant"]:
    """Return the weights of barycentric interpolation between instants of ``ramp_instants``."""
    weight = 1.0 - 2.0 * (torch.arange(count, dtype=torch.float64) % 2)
    weight[[0, -1]] *= 0.5
    return weight


def beat_of_delays(
    coefficient: Complex128[Tensor, " path"],
    delay: _Delays,
    waveform: SampledWaveform,
    tolerance: float,
) -> Complex128[Tensor, " sample"]:
    """Compute the beat signal of one channel from the paths' delays at some instants of the ramp.

    With one instant delays are constant, and the phase is linear over the samples. With more, a
    path has its exact phase at every instant. The nonlinear part of the phase is a factor of each
    path: known at the instants, a polynomial between them. The sum is then one non-uniform FFT per
    instant, over the same rates.

    Args:
        coefficient: a of the paths; the signal has its conjugate.
        delay: delays at ``ramp_instants`` [s].
        waveform: waveform with the frequencies of the samples.
        tolerance: relative error of the sums.
    """
    count, samples = len(delay), waveform.samples
    instants = ramp_instants(samples, count).to(delay.device)
    cycles = phase_cycles(delay, waveform)
    place = (instants - samples // 2)[:, None]
    if count == 1:
        turns = waveform.step * delay[0]
    else:
        # The line is arbitrary, since the rest compensates it; so it needs no gradient.
        turns = ((cycles[-1] - cycles[0]) / (instants[-1] - instants[0])).detach()
    sums = NonUniformSum.apply(coefficient, cycles - place * turns, turns, samples, tolerance)
    return sums[0] if count == 1 else (sums * _interpolation(samples, count).to(sums)).sum(0)


def phase_cycles(delay: _Delays, waveform: SampledWaveform) -> _Delays:
    """Return the phase of paths at ``ramp_instants``, ``f τ − S τ²/2`` [cycles].

    Args:
        delay: delays at the instants [s].
        waveform: waveform with the frequencies of the samples.
    """
    instants = ramp_instants(waveform.samples, len(delay)).to(delay.device)
    frequency = waveform.start_frequency + waveform.step * instants
    return (frequency[:, None] - (0.5 * waveform.residual_slope) * delay) * delay


class NonUniformSum(torch.autograd.Function):
    """Sum Σ_i conj(a_i) exp(2πj (rest_ki + (n − N//2) turns_i)), with derivatives in both modes.

    Only the real inputs are saved: the phasors of many channels would fill the memory.
    """

    @staticmethod
    def forward(
        ctx: Any,
        coefficient: Complex128[Tensor, " path"],
        offset_cycles: Float64[Tensor, "sum path"],
        step_cycles: Float64[Tensor, " path"],
        samples: int,
        tolerance: float,
    ) -> Complex128[Tensor, "sum sample"]:
        ctx.save_for_backward(coefficient, offset_cycles, step_cycles)
        ctx.save_for_forward(coefficient, offset_cycles, step_cycles)
        ctx.samples, ctx.tolerance = samples, tolerance
        strengths = coefficient.conj() * _phasor(offset_cycles)
        return _transform(1, step_cycles, strengths, samples, tolerance)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        coefficient, rest, turns = ctx.saved_tensors
        grad, phasor = grad_outputs[0], _phasor(rest)
        with_turns = ctx.needs_input_grad[2]
        if with_turns:
            grad = torch.cat([grad, grad * _centred_indices(ctx.samples, turns)])
        # Gradients with respect to conj(a), with the conjugate phasors.
        sums = _transform(2, turns, grad, ctx.samples, ctx.tolerance).unflatten(0, (-1, len(rest)))
        sums = sums * phasor.conj()
        of_phase = (2 * math.pi) * (coefficient * sums).imag
        of_turns = of_phase[1].sum(0) if with_turns else None
        return sums[0].sum(0).conj(), of_phase[0], of_turns, None, None

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> Tensor:  # type: ignore[override]
        coefficient, rest, turns = ctx.saved_tensors
        samples, phasor = ctx.samples, _phasor(rest)
        strengths, change = coefficient.conj() * phasor, torch.zeros_like(phasor)
        if tangents[0] is not None:
            change = tangents[0].conj() * phasor
        if tangents[1] is not None:
            change = change + 2j * math.pi * tangents[1] * strengths
        sums = _transform(1, turns, change, samples, ctx.tolerance)
        if tangents[2] is not None:
            turned = _transform(1, turns, strengths * tangents[2], samples, ctx.tolerance)
            sums = sums + 2j * math.pi * _centred_indices(samples, turns) * turned
        return sums


def _phasor(cycles: Tensor) -> Tensor:
    # Reduce cycles before the conversion to radians: 1e5 at 77 GHz and 200 m.
    phase = (2 * math.pi) * (cycles - cycles.round())
    return torch.polar(torch.ones_like(phase), phase)


def _centred_indices(samples: int, like: Tensor) -> Tensor:
    return torch.arange(samples, dtype=like.dtype, device=like.device) - samples // 2


def _transform(
    kind: int, step_cycles: Tensor, values: Tensor, samples: int, tolerance: float
) -> Tensor:
    """Run type 1 (paths to samples) with exp(+j…), or type 2 (samples to paths) with exp(−j…)."""
    if len(step_cycles) == 0:
        return values.new_zeros(len(values), samples if kind == 1 else 0)
    rate = (2 * math.pi) * (step_cycles - step_cycles.round()).detach().contiguous()
    values = values.detach().resolve_conj().contiguous()
    task = (kind, (samples,), len(values), tolerance, 1 if kind == 1 else -1)
    library = _cufinufft() if values.is_cuda else None
    if library is not None:
        out = values.new_empty(len(values), samples if kind == 1 else len(rate))
        plan = library.Plan(*task, dtype="complex128", gpu_device_id=values.device.index)
        plan.setpts(rate)
        return plan.execute(values, out=out)
    threads = torch.get_num_threads() if len(rate) > _SHARED_PATHS else 1
    plan = finufft.Plan(*task, nthreads=threads)
    plan.setpts(rate.cpu().numpy())
    found = torch.from_numpy(plan.execute(values.cpu().numpy())).to(values.device)
    return found.reshape(len(values), -1)
