"""Forward-mode derivatives of functions of a module's parameters."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor, nn

from invertwin.runtime.concurrency import tracer_lock


class Evaluation(nn.Module):
    """Module whose call evaluates a function of another module's parameters.

    Args:
        module: the other module; its parameters are named `module.…` here.
        function: function to evaluate.
    """

    def __init__(self, module: nn.Module, function: Callable[[], Any]) -> None:
        super().__init__()
        self.module, self._function = module, function

    def forward(self) -> Any:
        """Return the value of the function."""
        return self._function()


def map_tangents(
    module: nn.Module, maps: Callable[[], list[Tensor]], tangents: Mapping[str, Tensor]
) -> list[Tensor]:
    """Compute derivatives of maps along a tangent of a module's parameters.

    Args:
        module: module with the parameters.
        maps: returns maps [*] under the module's present parameters.
        tangents: rates of change of some of the parameters, by qualified name.

    Returns:
        The derivative of each map, of its shape.
    """
    with tracer_lock, torch.no_grad(), forward_ad.dual_level():
        duals = {}
        for name, tangent in tangents.items():
            value = module.get_parameter(name).detach()
            duals[f"module.{name}"] = forward_ad.make_dual(value, tangent.to(value))
        found = torch.func.functional_call(Evaluation(module, maps), duals, ())
        pairs = [forward_ad.unpack_dual(result) for result in found]
        return [torch.zeros_like(p) if t is None else t for p, t in pairs]
