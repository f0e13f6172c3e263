"""Simulated realisations of maps: receiver noise and scatter."""

from collections.abc import Callable

import torch
from torch import Tensor

from invertwin.forward_model import Realisations
from invertwin.seeds import derive_seed


def noisy_realisations(
    simulate_beat: Callable[[int], Tensor],
    to_map: Callable[[Tensor], Tensor],
    shape: tuple[int, ...],
    seed: int,
    holds_fields: bool = False,
    dtype: torch.dtype = torch.complex64,
) -> Realisations:
    """Return realisations of a map with receiver noise.

    Args:
        simulate_beat: function of a realisation's number that returns its beat signal.
        to_map: function that turns a beat signal into a map, as the model observes it.
        shape: shape of a beat signal.
        seed: seed of the noise that calibrates the level of a bin.
        holds_fields: whether maps hold parts of fields, not power.
        dtype: dtype of the noise.
    """

    def white_noise(key: int) -> Tensor:
        return torch.randn(shape, dtype=dtype, generator=torch.Generator().manual_seed(key))

    whole = to_map(white_noise(seed))
    share = float((whole.square() if holds_fields else whole).mean())

    def realise(number: int, noise: float) -> Tensor:
        noisy = (noise / share) ** 0.5 * white_noise(derive_seed(number, 1))
        return to_map(simulate_beat(number) + noisy)

    return realise


def add_white_errors(mean: Tensor, scatter: float | None) -> Realisations:
    """Return realisations of a map with white errors.

    Args:
        mean: map without errors.
        scatter: standard deviation of the errors; None = the square root of the mean square that
            each realisation is called with.
    """
    mean = mean.detach()

    def realise(number: int, noise: float) -> Tensor:
        generator = torch.Generator().manual_seed(number)
        errors = torch.randn(mean.shape, dtype=mean.dtype, generator=generator)
        return mean + (noise**0.5 if scatter is None else scatter) * errors

    return realise
