"""Simulated realisations of maps: receiver noise and scatter."""

from collections.abc import Callable

import torch
from torch import Tensor

from invertwin.radar.radar import Radar
from invertwin.radar.waveform import SampledWaveform
from invertwin.seeds import derived_seed


def _noisy(
    beat_of: Callable[[int], Tensor],
    shown: Callable[[Tensor], Tensor],
    sensor: Radar,
    seed: int,
    *,
    fields: bool = False,
) -> Callable[[int, float], Tensor]:
    """Looks with noise: a function of their number gives beat signals, another shows them."""
    assert isinstance(sensor.waveform, SampledWaveform)
    shape = (*sensor.shape, sensor.waveform.samples)

    def white(key: int) -> Tensor:
        generator = torch.Generator().manual_seed(key)
        return torch.randn(shape, dtype=torch.complex64, generator=generator)

    whole = shown(white(seed))
    share = float((whole.square() if fields else whole).mean())

    def look(number: int, noise: float) -> Tensor:
        return shown(beat_of(number) + (noise / share) ** 0.5 * white(derived_seed(number, 1)))

    return look


def _scattered(mean: Tensor, scatter: float | None) -> Callable[[int, float], Tensor]:
    """Looks at a map with white errors: of a known deviation, or of the mean square asked for."""
    mean = mean.detach()

    def look(number: int, noise: float) -> Tensor:
        generator = torch.Generator().manual_seed(number)
        errors = torch.randn(mean.shape, dtype=mean.dtype, generator=generator)
        return mean + (noise**0.5 if scatter is None else scatter) * errors

    return look
