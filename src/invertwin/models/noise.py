"""Simulated realisations of maps: receiver noise and scatter."""

from collections.abc import Callable

import torch
from torch import Tensor

from invertwin.radar.radar import Radar
from invertwin.radar.waveform import SampledWaveform
from invertwin.seeds import derive_seed


def noisy_realisations(
    simulate_beat: Callable[[int], Tensor],
    to_map: Callable[[Tensor], Tensor],
    sensor: Radar,
    seed: int,
    *,
    holds_fields: bool = False,
) -> Callable[[int, float], Tensor]:
    """Looks with noise: a function of their number gives beat signals, another shows them."""
    assert isinstance(sensor.waveform, SampledWaveform)
    shape = (*sensor.shape, sensor.waveform.samples)

    def white_noise(key: int) -> Tensor:
        generator = torch.Generator().manual_seed(key)
        return torch.randn(shape, dtype=torch.complex64, generator=generator)

    whole = to_map(white_noise(seed))
    share = float((whole.square() if holds_fields else whole).mean())

    def realise(number: int, noise: float) -> Tensor:
        return to_map(
            simulate_beat(number) + (noise / share) ** 0.5 * white_noise(derive_seed(number, 1))
        )

    return realise


def add_white_errors(mean: Tensor, scatter: float | None) -> Callable[[int, float], Tensor]:
    """Looks at a map with white errors: of a known deviation, or of the mean square asked for."""
    mean = mean.detach()

    def realise(number: int, noise: float) -> Tensor:
        generator = torch.Generator().manual_seed(number)
        errors = torch.randn(mean.shape, dtype=mean.dtype, generator=generator)
        return mean + (noise**0.5 if scatter is None else scatter) * errors

    return realise
