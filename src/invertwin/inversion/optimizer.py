"""Optimisers of a fit and their learning rates."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from annotated_types import Ge, Lt
from torch import nn

from invertwin.checks import CheckedFields
from invertwin.inversion.gauss_newton import GaussNewton
from invertwin.inversion.loss import Objective
from invertwin.limits import Count, NonNegative, Positive

_ANGLES = ("rotation", "yaw", "spread")  # how parameters that are angles are named


@dataclass(frozen=True)
class Optimizer(CheckedFields):
    """Kind of optimiser and its learning rates.

    Attributes:
        kind: ``adam``, ``sgd`` with momentum, or ``gauss_newton`` for few parameters.
        rate: Learning rate at the first step; parameters are in metres and radians. For
            Gauss–Newton, a rate is the longest change of a parameter in a step; it does not fall.
        rotation_rate: Rate of angles: parameters named ``rotation``, ``yaw`` or ``spread``; None =
            ``rate``.
        final_rate: Rate at the last step, reached along a cosine; None = ``rate`` /
            20. The rates of all parameters fall alike.
        momentum: Momentum of SGD.
        curvature_every: For Gauss–Newton, steps from one curvature to the next. Derivatives of the
            map with respect to every parameter cost most of a step.
    """

    kind: Literal["adam", "sgd", "gauss_newton"] = "adam"
    rate: Positive = 0.03
    rotation_rate: Positive | None = None
    final_rate: NonNegative | None = None
    momentum: Annotated[float, Ge(0), Lt(1)] = 0.9
    curvature_every: Count = 1

    def build(
        self,
        modules: nn.Module,
        objective: Objective,
        rates: Mapping[nn.Parameter, float] | None = None,
    ) -> torch.optim.Optimizer | GaussNewton:
        """Build the optimiser of the modules' parameters that require a gradient.

        Args:
            modules: modules to fit.
            objective: loss of the maps.
            rates: rates of single parameters, in place of this optimiser's.

        Raises:
            InputError: Gauss–Newton without a ``SpectrumLoss``, or for many parameters.
        """
        found: dict[nn.Parameter, float] = {}
        for name, parameter in modules.named_parameters():
            if parameter.requires_grad:
                own = self.rotation_rate if name.endswith(_ANGLES) else None
                found[parameter] = (rates or {}).get(parameter, own or self.rate)
        if self.kind == "gauss_newton":
            every, radius = self.curvature_every, self.rate
            return GaussNewton(
                modules, objective, trust_radius=radius, trust_radii=found, curvature_every=every
            )
        groups: dict[float, list[nn.Parameter]] = {}
        for parameter, rate in found.items():
            groups.setdefault(rate / self.rate, []).append(parameter)
        listed = [{"params": group, "ratio": ratio} for ratio, group in groups.items()]
        if self.kind == "adam":
            return torch.optim.Adam(listed, lr=self.rate)
        return torch.optim.SGD(listed, lr=self.rate, momentum=self.momentum)

    def set_rates(self, optimizer: torch.optim.Optimizer | GaussNewton, progress: float) -> None:
        """Set the learning rates.

        Args:
            optimizer: optimiser from ``build``.
            progress: fraction of the steps that are done, in [0, 1].
        """
        if isinstance(optimizer, GaussNewton):
            return
        last = self.rate / 20 if self.final_rate is None else self.final_rate
        rate = last + 0.5 * (self.rate - last) * (1 + math.cos(math.pi * progress))
        for group in optimizer.param_groups:
            group["lr"] = rate * group["ratio"]
