"""Linear prediction: exact tones leave nothing, noise leaves itself, breaks stand out."""

import math

import pytest
import torch

from invertwin.capture.prediction import covariances, prediction_coefficients, prediction_residuals

PLACES = torch.arange(200, dtype=torch.float64)
TONES = torch.exp(2j * math.pi * 0.11 * PLACES) + 0.5 * torch.exp(-2j * math.pi * 0.23 * PLACES)


def left(rows: torch.Tensor, order: int) -> torch.Tensor:
    products = covariances(rows, order)
    return prediction_residuals(
        products, prediction_coefficients(products, torch.ones(len(products)) > 0)
    )


def test_tones_follow_from_as_many_samples():
    assert float(left(TONES[None], 2).max()) < 1e-12
    assert float(left(TONES[None], 1).min()) > 0.01


def test_white_noise_does_not_follow():
    noise = torch.randn(50, 200, generator=torch.Generator().manual_seed(1), dtype=TONES.dtype)
    assert float(left(noise, 4).mean()) == pytest.approx(1.0, rel=0.02)


def test_a_break_stands_out_where_it_is():
    """With the power |1 − e^{jφ}|² of the tone, in the windows that hold it."""
    broken = torch.exp(2j * math.pi * 0.11 * PLACES)
    broken[120:] *= 1j
    products = covariances(broken[None], 1)
    kept = torch.arange(199) != 119
    found = prediction_residuals(products, prediction_coefficients(products, kept))
    assert float(found[119]) == pytest.approx(2.0)
    assert float(found[kept].max()) < 1e-12
