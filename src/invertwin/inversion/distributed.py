"""Losses of many views, shared among processes: each works on some, and all get the mean."""

from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor, distributed, nn

from invertwin.errors import InputError

_ViewItem = TypeVar("_View")


def mean_over_views(
    loss: Callable[[_ViewItem], Tensor], views: Sequence[_ViewItem], module: nn.Module
) -> float:
    """The mean of a loss over views; its derivative is added to the parameters' ``grad``.

    Where ``torch.distributed`` is initialised, process r of n works on views r, r + n, …, and
    every process gets the mean of all and the same derivative, in one exchange. It is that of one
    process but for the order of sums, if what is random in a view goes by the view and not by the
    process. An optimiser then takes the same step in every process.

    Args:
        loss: Of a view, a number. It depends on the parameters of the module.
        views: All of them, the same in every process.
        module: Its parameters that require a derivative.

    Returns:
        The mean.

    Raises:
        InputError: No views, or no parameters.
    """
    free = [parameter for parameter in module.parameters() if parameter.requires_grad]
    if not views or not free:
        raise InputError(
            f"expected views and parameters to differentiate by, got {len(views)} and {len(free)}; "
            "give both"
        )
    rank, count = 0, 1
    if distributed.is_available() and distributed.is_initialized():
        rank, count = distributed.get_rank(), distributed.get_world_size()
    sums = [torch.zeros_like(parameter) for parameter in free]
    total = torch.zeros((), dtype=torch.float64)
    for view in views[rank::count]:
        value = loss(view) / len(views)
        total += value.detach()
        # Each view by itself: what its derivative needs is free before the next one begins.
        parts = torch.autograd.grad(value, free, allow_unused=True, materialize_grads=True)
        for own, part in zip(sums, parts, strict=True):
            own += part
    if count > 1:
        sums, total = _sum_over_processes(sums, total)
    torch.autograd.backward(free, sums)  # of parameters themselves: adds the sums
    return float(total)


def _sum_over_processes(parts: list[Tensor], total: Tensor) -> tuple[list[Tensor], Tensor]:
    """Both, summed over all processes."""
    flat = torch.cat([total.reshape(1), *(part.double().flatten() for part in parts)])
    distributed.all_reduce(flat)
    pieces = flat[1:].split([part.numel() for part in parts])
    shaped = [
        piece.reshape(part.shape).to(part.dtype) for piece, part in zip(pieces, parts, strict=True)
    ]
    return shaped, flat[0]
