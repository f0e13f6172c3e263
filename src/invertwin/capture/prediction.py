"""Linear prediction of samples from the samples before them: a break in a signal stands out.

Sums of few tones, as beat signals are, follow from their past but for noise:
``x[n] = Σ a_k x[n − k]``. Source: Makhoul, Linear prediction: a tutorial review, 1975.
"""

import torch
from jaxtyping import Bool, Complex128, Float64
from torch import Tensor

_DIAGONAL_LOADING = 1e-9  # of the mean power: exact tones have singular equations


def covariances(
    rows: Complex128[Tensor, "row sample"], order: int
) -> Complex128[Tensor, "place lag lag"]:
    """Mean products of each sample with the ones before it, at every place after the first ones.

    Args:
        rows: Signals that follow the same tones.
        order: Number of earlier samples.
    """
    past = rows.unfold(-1, order + 1, 1).flip(-1)  # [row, place, lag]
    return torch.einsum("rnk,rnl->nkl", past.conj(), past) / len(rows)


def prediction_coefficients(
    products: Complex128[Tensor, "place lag lag"], mask: Bool[Tensor, " place"]
) -> Complex128[Tensor, " lag"]:
    """Coefficients with the least mean residual at the places that are kept, the first one 1.

    Args:
        products: Result of ``covariances``.
        mask: Places that count.
    """
    mean = products[mask].sum(0)
    level = mean.diagonal().real.mean().clamp_min(torch.finfo(torch.float64).tiny)
    inner = mean[1:, 1:] + _DIAGONAL_LOADING * level * torch.eye(len(mean) - 1, dtype=mean.dtype)
    return torch.cat([torch.ones(1, dtype=mean.dtype), -torch.linalg.solve(inner, mean[1:, 0])])


def prediction_residuals(
    products: Complex128[Tensor, "place lag lag"], coefficients: Complex128[Tensor, " lag"]
) -> Float64[Tensor, " place"]:
    """Mean power of the prediction residual at each place, forwards and backwards in time.

    The same tones, read backwards, follow from the conjugate coefficients.

    Args:
        products: Result of ``covariances``.
        coefficients: Result of ``prediction_coefficients``.
    """
    both = torch.stack([coefficients, coefficients.conj().flip(0)])
    return 0.5 * torch.einsum("dk,nkl,dl->n", both.conj(), products, both).real.clamp_min(0.0)
