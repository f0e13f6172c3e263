"""Mean loss over views, distributed over processes with ``torch.distributed``."""

from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor, distributed, nn

from invertwin.errors import InputError

_ViewItem = TypeVar("_ViewItem")


def mean_over_views(
    loss: Callable[[_ViewItem], Tensor], views: Sequence[_ViewItem], module: nn.Module
) -> float:
    """Compute the mean of a loss over views, and add its gradient to the parameters' ``grad``.

    Where ``torch.distributed`` is initialised, process r of n works on views r, r + n, …, and every
    process obtains the mean over all views and the same gradient in one all-reduce. It equals that
    of a single process up to the order of summation, if random numbers are seeded per view and not
    per process. An optimiser then takes the same step in every process.

    Args:
        loss: maps a view to a scalar that depends on the parameters of the module.
        views: all views, the same list in every process.
        module: module with the parameters to differentiate with respect to.

    Returns:
        The mean loss.

    Raises:
        InputError: No views, or no parameters.
    """
    free = [parameter for parameter in module.parameters() if parameter.requires_grad]
    if not views or not free:
        raise InputError(
            f"expected views and free parameters, got {len(views)} and {len(free)}; give both"
        )
    rank, count = 0, 1
    if distributed.is_available() and distributed.is_initialized():
        rank, count = distributed.get_rank(), distributed.get_world_size()
    sums = [torch.zeros_like(parameter) for parameter in free]
    total = torch.zeros((), dtype=torch.float64)
    for view in views[rank::count]:
        value = loss(view) / len(views)
        total += value.item()
        # One graph per view: its memory is freed before the next view.
        parts = torch.autograd.grad(value, free, allow_unused=True, materialize_grads=True)
        sums = [own + part for own, part in zip(sums, parts, strict=True)]
    if count > 1:
        flat = torch.cat([total.reshape(1), *(own.double().flatten() for own in sums)])
        distributed.all_reduce(flat)
        total, pieces = flat[0], flat[1:].split([own.numel() for own in sums])
        pairs = zip(pieces, sums, strict=True)
        sums = [piece.reshape(own.shape).to(own.dtype) for piece, own in pairs]
    torch.autograd.backward(free, sums)  # adds the sums to ``grad``
    return float(total)
