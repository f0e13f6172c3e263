"""Rows of two tables that belong together."""

import torch
from jaxtyping import Int64
from torch import Tensor


def joint(
    first: Int64[Tensor, " n"], second: Int64[Tensor, " m"], count: int
) -> tuple[Int64[Tensor, " pair"], Int64[Tensor, " pair"]]:
    """Rows of all pairs with the same number, in the order of the first table's rows.

    Args:
        first, second: the numbers, below ``count``.
        count: how many numbers there are.
    """
    order = second.argsort(stable=True)
    many = torch.bincount(second, minlength=count)
    begin = many.cumsum(0) - many
    times = many[first]
    row = torch.arange(len(first)).repeat_interleave(times)
    within = torch.arange(len(row)) - (times.cumsum(0) - times)[row]
    return row, order[begin[first[row]] + within]
