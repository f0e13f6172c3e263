"""Gauss–Newton for few parameters, each with a forward-mode derivative of the map."""

import math
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import torch
import torch.autograd.forward_ad as forward_ad
from jaxtyping import Bool, Float64
from torch import Tensor, nn
from torch.autograd import grad

from invertwin.channel import tracer_lock
from invertwin.checks import checked_count
from invertwin.errors import InputError
from invertwin.inversion.loss import MapPairs, Objective, SpectrumLoss

_MAX_PARAMETERS = 64  # parameters; each costs a derivative of the map per step
_MAX_DAMPING_TRIALS = 4  # dampings of one step
_DAMPING_DECREASE, _DAMPING_INCREASE = (
    0.3,
    4.0,
)  # of the damping after a step that helped, and after one that did not
_MIN_DAMPING, _MAX_DAMPING = 1e-3, 1e3  # of the damping
_LOSS_TOLERANCE = 1e-3  # of the loss: the noise of two evaluations on the same samples


class GaussNewton:
    """Levenberg–Marquardt steps on the loss of power maps.

    The step d solves ``(H + μ D) d = −g`` with no number beyond ``reach``: g the gradient of the
    loss with all its terms, in reverse mode; H the loss's Gauss–Newton matrix from derivatives of
    the map with respect to every parameter, in forward mode with silhouettes; D the diagonal of H,
    at least its mean. A step that raises the loss, on the same samples, is taken back and tried
    again with more damping μ.

    Source: the Levenberg–Marquardt method.
    Differs from the source: g and H are estimates from samples. D keeps parameters that the data
    hardly determine from drifting with the noise. H may serve several steps.

    Args:
        modules: what is fitted.
        objective: how maps are compared, of `SpectrumLoss` only.
        reach: the longest change of one parameter in a step, in its unit.
        trust_radii: the reach of single parameters, in place of `reach`.
        damping: μ at the first step.
        every: steps from one H to the next; those between take the last one.

    Attributes:
        damping: present μ.

    Raises:
        InputError: no parameters, more than 64, another loss, or a reach, damping or number
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
        self._slots = [
            (module, name, parameter)
            for module in modules.modules()
            for name, parameter in module.named_parameters(recurse=False)
            if parameter.requires_grad
        ]
        for loss in objective.losses:
            if not isinstance(loss, SpectrumLoss):
                raise InputError(
                    f"expected a SpectrumLoss for Gauss–Newton, got {type(loss).__name__}; "
                    "give one, or another kind of optimiser"
                )
        if not self._slots or not (trust_radius > 0 and damping > 0):
            raise InputError(
                f"expected parameters to fit, reach > 0 and damping > 0, got {len(self._slots)}, "
                f"{trust_radius} and {damping}; a reach of 0.3 suits metres and radians"
            )
        self.objective, self.damping = objective, damping
        own = dict(trust_radii or {})
        self.reach = torch.cat(
            [
                torch.full((p.numel(),), own.get(p, trust_radius), dtype=torch.float64)
                for _, _, p in self._slots
            ]
        )
        self.every = checked_count(curvature_every, "steps from one curvature to the next", 1)
        self._known: tuple[Tensor, Tensor] | None = None  # H, and of which parameters
        self._age = 0  # steps that H has served

    def step(
        self, maps: Callable[[], MapPairs], penalty: Callable[[], Tensor] | None = None
    ) -> float:
        """Do one step, and return the loss before it.

        Args:
            maps: gives the predicted and the observed map of every observation under the present
                parameters; the same samples each time it is called within one step.
            penalty: gives a differentiable term added to the loss, as a regulariser does. It
                takes part in g, and by its own second derivatives in H.

        Raises:
            InputError: a parameter without effect on the loss, or more than 64 that matter.
        """
        parameters = [parameter for _, _, parameter in self._slots]
        pairs = maps()
        value = self.objective(pairs)
        if penalty is not None:
            value = value + penalty()
        found: Sequence[Tensor | None] = [None] * len(parameters)
        if value.requires_grad:
            found = grad(value, parameters, allow_unused=True)
        for (module, name, _), slopes in zip(self._slots, found, strict=True):
            if slopes is None:
                raise no_effect_error(module, name)
        slope = _flatten([part for part in found if part is not None])
        before = float(value.detach())
        if not bool(torch.isfinite(slope).all()) or before != before:
            return float("nan")
        # Along a parameter that the module holds fixed, the derivative is zero to the last bit.
        free = slope != 0
        if int(free.sum()) > _MAX_PARAMETERS:
            raise InputError(
                f"expected at most {_MAX_PARAMETERS} parameters for Gauss–Newton, got "
                f"{int(free.sum())}; "
                "use adam for many"
            )
        if not bool(free.any()):
            return before
        if self._known is None or self._age >= self.every or not torch.equal(free, self._known[1]):
            self._known = self._compute_curvature(maps, pairs, free), free
            self._age = 0
        self._age += 1
        curvature = self._known[0]
        if penalty is not None:
            curvature = curvature + penalty_curvature(penalty, parameters, free)
        start = [parameter.detach().clone() for parameter in parameters]
        given = self.damping
        for _ in range(_MAX_DAMPING_TRIALS):
            self._set_parameters(
                start, self._solve_step(curvature, slope[free], self.reach[free]), free
            )
            after = _evaluate_loss(self.objective, maps, penalty)
            if after < before + _LOSS_TOLERANCE * abs(before):
                self.damping = max(self.damping * _DAMPING_DECREASE, _MIN_DAMPING)
                return before
            self.damping *= _DAMPING_INCREASE
        # Samples are others in the next step: what failed on these may be right on those, with a
        # curvature of theirs.
        self._known = None
        self.damping = min(given * _DAMPING_INCREASE, _MAX_DAMPING)
        self._set_parameters(start, torch.zeros(int(free.sum()), dtype=torch.float64), free)
        return before

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint needs besides the parameters."""
        kept: dict[str, Any] = {"damping": self.damping, "age": self._age}
        if self._known is not None:
            kept["curvature"], kept["free"] = self._known
        return kept

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` gave."""
        self.damping = float(state["damping"])
        self._age = int(state.get("age", 0))
        self._known = None
        if "curvature" in state:
            curvature, free = state["curvature"], state["free"]
            if curvature.shape != (int(free.sum()),) * 2 or free.shape != self.reach.shape:
                raise ValueError("a curvature of other parameters")
            self._known = curvature, free

    def zero_grad(self) -> None:
        """Do nothing: gradients are not kept in the parameters."""

    def _solve_step(
        self, curvature: Tensor, gradient: Tensor, trust_radius: Tensor
    ) -> Float64[Tensor, " p"]:
        """The minimum of the damped quadratic model within the reach of every parameter."""
        own = curvature.diagonal()
        # What the data hardly tell is damped as much as what they tell on average: noise would
        # carry it away otherwise.
        scale = own.clamp_min(float(own.mean()))
        model = curvature + torch.diag(self.damping * scale)
        change, free = torch.zeros_like(gradient), torch.ones_like(gradient, dtype=torch.bool)
        while bool(free.any()):
            # What is at its limit stays there, the others make the best of it.
            rest = gradient[free] + model[free][:, ~free] @ change[~free]
            change[free] = -torch.linalg.solve(model[free][:, free], rest)
            beyond = free & (change.abs() > trust_radius)
            if not bool(beyond.any()):
                break
            change = change.clamp(-trust_radius, trust_radius)
            free = free & ~beyond
        return change

    def _set_parameters(self, start: list[Tensor], change: Tensor, free: Tensor) -> None:
        """Set the parameters to where they were, plus a change of the free ones."""
        whole = torch.zeros(free.shape, dtype=torch.float64)
        whole[free] = change
        with torch.no_grad():
            parts = whole.split([value.numel() for value in start])
            for (_, _, parameter), value, part in zip(self._slots, start, parts, strict=True):
                parameter.copy_(value + part.reshape(value.shape).to(value))

    def _compute_curvature(
        self, maps: Callable[[], MapPairs], pairs: MapPairs, free: Bool[Tensor, " q"]
    ) -> Float64[Tensor, "p p"]:
        fixed = [(predicted.detach(), observed) for predicted, observed in pairs]
        tangents: list[list[Tensor]] = [[] for _ in fixed]
        for index in free.nonzero()[:, 0].tolist():
            with tracer_lock, forward_ad.dual_level(), self._dual_coordinate(index):
                found = [forward_ad.unpack_dual(predicted).tangent for predicted, _ in maps()]
            for rows, tangent, (predicted, _) in zip(tangents, found, fixed, strict=True):
                rows.append(torch.zeros_like(predicted) if tangent is None else tangent)
        return self.objective.curvature(fixed, [torch.stack(rows) for rows in tangents])

    def _dual_coordinate(self, index: int) -> AbstractContextManager[None]:
        """Parameters as dual numbers whose tangent is one along a single coordinate."""
        sizes = [parameter.numel() for _, _, parameter in self._slots]
        slot = next(k for k in range(len(sizes)) if index < sum(sizes[: k + 1]))
        module, name, parameter = self._slots[slot]
        tangent = torch.zeros_like(parameter.detach())
        tangent.view(-1)[index - sum(sizes[:slot])] = 1.0
        return dual_parameters(module, {name: tangent})


@contextmanager
def dual_parameters(
    module: nn.Module, tangents: Mapping[str, Tensor]
) -> Generator[None, None, None]:
    """Parameters of a module as dual numbers, with these tangents by name.

    Args:
        module: What is moved, within a ``dual_level``.
        tangents: Of some of its parameters; names may have dots.
    """
    held = []
    for path, tangent in tangents.items():
        owner, _, name = path.rpartition(".")
        part = module.get_submodule(owner)
        held.append((part, list(part.named_parameters(recurse=False))))
        value = getattr(part, name).detach()
        delattr(part, name)
        setattr(part, name, forward_ad.make_dual(value, tangent.to(value)))
    try:
        with torch.no_grad():
            yield
    finally:
        # All of them, in their order, which is that of checkpoints.
        for part, own in reversed(held):
            for key, parameter in own:
                if hasattr(part, key):
                    delattr(part, key)
                setattr(part, key, parameter)


def _evaluate_loss(
    objective: Objective, maps: Callable[[], MapPairs], penalty: Callable[[], Tensor] | None
) -> float:
    """The loss with its term; infinite for parameters that the scene refuses."""
    with torch.no_grad():
        try:
            return float(objective(maps())) + (0.0 if penalty is None else float(penalty()))
        except InputError:
            return math.inf


def no_effect_error(module: nn.Module, name: str) -> InputError:
    """Make the error for a parameter that the loss does not depend on.

    Args:
        module: It has the parameter.
        name: Of the parameter.
    """
    return InputError(
        f"expected parameters that change the map, got {name} of {type(module).__name__}, which "
        "has no gradient; probably a later module overwrites this mesh: give one shape of each "
        "object, or another order"
    )


def _flatten(parts: Sequence[Tensor]) -> Float64[Tensor, " q"]:
    """All numbers of some tensors one after the other."""
    return torch.cat([part.flatten().double() for part in parts])


def penalty_curvature(
    penalty: Callable[[], Tensor], parameters: list[nn.Parameter], free: Bool[Tensor, " q"]
) -> Float64[Tensor, "p p"]:
    """Second derivatives of a term of the loss, as far as they are positive.

    Args:
        penalty: The term.
        parameters: By what it is differentiated.
        free: Which of their numbers count.
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
