"""Gauss–Newton with forward-mode derivatives of the map with respect to each parameter."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float64
from torch import Tensor, nn
from torch.autograd import grad

from invertwin.checks import checked_count, checked_number
from invertwin.errors import InputError
from invertwin.inversion.forward_mode import map_tangents
from invertwin.inversion.loss import CURVED, MapPairs, Objective

_MAX_PARAMETERS = 64  # each parameter costs a derivative of the map per step
_MAX_DAMPING_TRIALS = 4  # trials of one step with increasing damping
_DAMPING_DECREASE, _DAMPING_INCREASE = 0.3, 4.0  # after an accepted and after a rejected step
_MIN_DAMPING, _MAX_DAMPING = 1e-3, 1e3
_LOSS_TOLERANCE = 1e-3  # relative noise of two evaluations on equal samples
_Penalty = Callable[[], Tensor] | None  # terms of the loss beside the maps


class GaussNewton:
    """Levenberg–Marquardt steps on the loss of power maps.

    The step d solves ``(H + μ D) d = −g`` within the trust region ``trust_radius``: g the gradient
    of the loss with all its terms, in reverse mode; H the loss's Gauss–Newton matrix from
    derivatives of the map with respect to every parameter, in forward mode with silhouettes; D the
    diagonal of H, at least its mean. A step that raises the loss, on the same samples, is rejected
    and retried with more damping μ.

    Source: the Levenberg–Marquardt method.
    Differs from the source: g and H are estimates from samples. D keeps weakly determined
    parameters from drifting with the noise. H may serve several steps.

    Args:
        modules: modules to fit.
        objective: loss of the maps, of `SpectrumLoss` only.
        trust_radius: largest change of one parameter in a step, in its unit.
        trust_radii: trust radii of single parameters, in place of `trust_radius`.
        damping: μ of the first step.
        curvature_every: number of steps that reuse one H.

    Attributes:
        damping: present μ.

    Raises:
        InputError: no parameters, more than 64, another loss, or a trust radius, damping or number
            of steps that is not positive.
    """

    def __init__(
        self,
        modules: nn.Module,
        objective: Objective,
        *,
        trust_radius: float = 0.3,
        trust_radii: Mapping[nn.Parameter, float] | None = None,
        damping: float = 0.01,
        curvature_every: int = 1,
    ) -> None:
        self._modules = modules
        self._parameters = {n: p for n, p in modules.named_parameters() if p.requires_grad}
        for loss in objective.losses:
            if not isinstance(loss, CURVED):
                raise InputError(
                    f"expected a SpectrumLoss for Gauss–Newton, got {type(loss).__name__}; "
                    "give one, or another kind of optimiser"
                )
        if not self._parameters:
            raise InputError("expected parameters to fit, got 0, none of them free; free some")
        checked_number(trust_radius, "trust_radius", 0.0, open_low=True)
        self.objective = objective
        self.damping = checked_number(damping, "damping", 0.0, open_low=True)
        own = dict(trust_radii or {})
        radii = [
            torch.full((p.numel(),), own.get(p, trust_radius), dtype=torch.float64)
            for p in self._parameters.values()
        ]
        self.reach = torch.cat(radii)
        self.every = checked_count(curvature_every, "steps from one curvature to the next", 1)
        self._known: tuple[Tensor, Tensor] | None = None  # H, and the mask of its parameters
        self._age = 0  # number of steps with the present H

    def step(self, maps: Callable[[], MapPairs], penalty: _Penalty = None) -> float:
        """Take one step, and return the loss before it.

        Args:
            maps: returns the predicted and the observed map of every observation under the present
                parameters, with equal samples in every call within one step.
            penalty: returns a differentiable term of the loss, such as regularisers. It enters g,
                and through its own second derivatives H.

        Raises:
            InputError: a parameter without effect on the loss, or more than 64 that matter.
        """
        parameters = list(self._parameters.values())
        pairs = maps()
        value = self.objective(pairs)
        if penalty is not None:
            value = value + penalty()
        none = [None] * len(parameters)
        found = grad(value, parameters, allow_unused=True) if value.requires_grad else none
        for path, slopes in zip(self._parameters, found, strict=True):
            if slopes is None:
                owner, _, name = path.rpartition(".")
                raise no_effect_error(self._modules.get_submodule(owner), name)
        slope = _flatten([part for part in found if part is not None])
        before = float(value.detach())
        if not bool(torch.isfinite(slope).all()) or before != before:
            return float("nan")
        # The derivative with respect to a fixed coordinate is exactly zero.
        free = slope != 0
        if int(free.sum()) > _MAX_PARAMETERS:
            raise InputError(
                f"expected at most {_MAX_PARAMETERS} parameters for Gauss–Newton, got "
                f"{int(free.sum())}; use adam for many"
            )
        if not bool(free.any()):
            return before
        if self._known is None or self._age >= self.every or not torch.equal(free, self._known[1]):
            fixed = [(predicted.detach(), observed) for predicted, observed in pairs]
            columns = [
                map_tangents(self._modules, lambda: [found for found, _ in maps()], tangents)
                for tangents in map(self._unit_tangents, free.nonzero()[:, 0].tolist())
            ]
            rows = [torch.stack(column) for column in zip(*columns, strict=True)]
            self._known = self.objective.curvature(fixed, rows), free
            self._age = 0
        self._age += 1
        curvature = self._known[0]
        if penalty is not None:
            curvature = curvature + penalty_curvature(penalty, parameters, free)
        start = [parameter.detach().clone() for parameter in parameters]
        given = self.damping
        for _ in range(_MAX_DAMPING_TRIALS):
            change = self._solve_step(curvature, slope[free], self.reach[free])
            self._set_parameters(start, change, free)
            after = _evaluate_loss(self.objective, maps, penalty)
            if after < before + _LOSS_TOLERANCE * abs(before):
                self.damping = max(self.damping * _DAMPING_DECREASE, _MIN_DAMPING)
                return before
            self.damping *= _DAMPING_INCREASE
        # The next step draws other samples, on which a new curvature may succeed.
        self._known = None
        self.damping = min(given * _DAMPING_INCREASE, _MAX_DAMPING)
        self._set_parameters(start, torch.zeros(int(free.sum()), dtype=torch.float64), free)
        return before

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a checkpoint, besides the parameters."""
        kept: dict[str, Any] = {"damping": self.damping, "age": self._age}
        if self._known is not None:
            kept["curvature"], kept["free"] = self._known
        return kept

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state from `state_dict`."""
        self.damping = float(state["damping"])
        self._age = int(state.get("age", 0))
        self._known = None
        if "curvature" in state:
            curvature, free = state["curvature"], state["free"]
            if curvature.shape != (int(free.sum()),) * 2 or free.shape != self.reach.shape:
                raise ValueError("a curvature of other parameters")
            self._known = curvature, free

    def zero_grad(self) -> None:
        """Do nothing: gradients are not stored in the parameters."""

    def _solve_step(self, curvature: Tensor, gradient: Tensor, trust_radius: Tensor) -> Tensor:
        """Minimise the damped quadratic model within the trust radius of every parameter."""
        own = curvature.diagonal()
        # Weakly determined parameters get the mean damping; noise would move them otherwise.
        model = curvature + torch.diag(self.damping * own.clamp_min(float(own.mean())))
        change, free = torch.zeros_like(gradient), torch.ones_like(gradient, dtype=torch.bool)
        while bool(free.any()):
            # Fix parameters at their limit, and minimise over the others.
            rest = gradient[free] + model[free][:, ~free] @ change[~free]
            change[free] = -torch.linalg.solve(model[free][:, free], rest)
            beyond = free & (change.abs() > trust_radius)
            if not bool(beyond.any()):
                break
            change = change.clamp(-trust_radius, trust_radius)
            free = free & ~beyond
        return change

    def _set_parameters(self, start: list[Tensor], change: Tensor, free: Tensor) -> None:
        """Set the parameters to ``start`` plus a change of the free ones."""
        whole = torch.zeros(free.shape, dtype=torch.float64)
        whole[free] = change
        with torch.no_grad():
            parts = whole.split([value.numel() for value in start])
            for parameter, value, part in zip(self._parameters.values(), start, parts, strict=True):
                parameter.copy_(value + part.reshape(value.shape).to(value))

    def _unit_tangents(self, index: int) -> dict[str, Tensor]:
        """Return the unit tangent along one of the entries of all parameters."""
        unit = torch.zeros(len(self.reach), dtype=torch.float64)
        unit[index] = 1.0
        parts = unit.split([parameter.numel() for parameter in self._parameters.values()])
        named = zip(self._parameters.items(), parts, strict=True)
        return {n: part.reshape(p.shape) for (n, p), part in named if part.any()}


def _evaluate_loss(objective: Objective, maps: Callable[[], MapPairs], penalty: _Penalty) -> float:
    """Evaluate the loss with its penalty; infinite for parameters outside their bounds."""
    with torch.no_grad():
        try:
            return float(objective(maps())) + (0.0 if penalty is None else float(penalty()))
        except InputError:
            return math.inf


def no_effect_error(module: nn.Module, name: str) -> InputError:
    """Build the error for a parameter without effect on the loss.

    Args:
        module: module that owns the parameter.
        name: name of the parameter.
    """
    return InputError(
        f"expected parameters that change the map, got {name} of {type(module).__name__}, which "
        "has no gradient; probably a later module overwrites this mesh: give one shape of each "
        "object, or another order"
    )


def _flatten(parts: Sequence[Tensor]) -> Float64[Tensor, " q"]:
    """Concatenate the entries of tensors."""
    return torch.cat([part.flatten().double() for part in parts])


def penalty_curvature(
    penalty: Callable[[], Tensor], parameters: list[nn.Parameter], free: Bool[Tensor, " q"]
) -> Float64[Tensor, "p p"]:
    """Compute the positive part of the Hessian of a penalty.

    Args:
        penalty: returns the term of the loss.
        parameters: parameters to differentiate with respect to.
        free: mask of the free entries of all parameters [q].
    """
    count, value = int(free.sum()), penalty()
    total = torch.zeros(count, count, dtype=torch.float64)
    if value.requires_grad:
        slopes = _flatten(grad(value, parameters, create_graph=True, materialize_grads=True))[free]
        for row, slope in zip(total, slopes, strict=True):
            if slope.requires_grad:
                second = grad(slope, parameters, retain_graph=True, materialize_grads=True)
                row.copy_(_flatten(second)[free])
    values, vectors = torch.linalg.eigh((total + total.T) / 2)
    return vectors @ torch.diag(values.clamp_min(0.0)) @ vectors.T
