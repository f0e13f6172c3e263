"""Tangents of a module's parameters with respect to a scalar θ, from user input."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from invertwin.checks import ArrayLike, Point
from invertwin.errors import InputError
from invertwin.limits import Positive
from invertwin.scene.parameters import Entries
from invertwin.scene.shape_models.lattice import Lattice


@dataclass(frozen=True)
class GaussianBump:
    """Gaussian bump over the nodes of a grid: ``height · exp(−|x − center|² / (2 width²))``.

    Attributes:
        center: position in the object's frame [m].
        width: standard deviation [m].
        height: peak change; three numbers for vector-valued nodes.
    """

    center: Point
    width: Positive
    height: float | Sequence[float] = 1.0

    def evaluate(self, lattice: Lattice, shape: Sequence[int]) -> Tensor:
        """Return the change of every entry of a parameter.

        Args:
            lattice: nodes of the module.
            shape: shape of the parameter. It may have the same number of nodes beyond the lattice
                on every side.
        """
        beyond = (shape[0] - lattice.counts[0]) / 2 * lattice.spacing
        nodes = Lattice.from_bounds(lattice.low - beyond, lattice.high + beyond, shape[:3]).nodes
        far = (nodes - nodes.new_tensor(self.center)).square().sum(-1)
        bump = torch.exp(-far / (2 * self.width**2))
        height = bump.new_tensor(self.height)
        return bump[..., None] * height if height.ndim else bump * height


ParameterChange = float | ArrayLike | GaussianBump
ParameterChanges = Mapping[str, ParameterChange]
"""One number for all entries, an array of all entries, the leading entries of a row, or a bump."""


def parameter_changes(module: nn.Module, tangent: ParameterChanges) -> dict[str, Tensor]:
    """Return the changes of a module's parameters by name for θ = 1.

    A tangent names parameters, or named entries of them (see ``Entries``): the ``rotation`` [rad]
    of a ``Pose``, the joints of a ``SkinnedBody`` [rad], the ``log_density`` of a ``DensityGrid``,
    the values of ``MaterialValues``.

    Args:
        module: module to displace.
        tangent: rates of the named values with respect to θ. A list may be shorter than a row of
            entries; the remaining entries do not change.

    Raises:
        InputError: A name or a shape that the module does not have.
    """
    start = {name: value.detach() for name, value in module.named_parameters()}
    known = {name: Entries(name) for name in start}
    if hasattr(module, "entries"):
        known |= module.entries()  # type: ignore[operator]
    parts = {name: start[found.parameter][found.index] for name, found in known.items()}
    changes: dict[str, Tensor] = {}
    for name, change in tangent.items():
        rate = _entry_changes(change, parts.get(name), getattr(module, "lattice", None))
        if name not in parts or rate.shape != parts[name].shape:
            shapes = ", ".join(f"{other} {tuple(part.shape)}" for other, part in parts.items())
            raise InputError(
                f"expected changes of {type(module).__name__} ({shapes}), got {name} "
                f"{tuple(rate.shape)}; give one number, or as many"
            )
        found = known[name]
        whole = changes.setdefault(found.parameter, torch.zeros_like(start[found.parameter]))
        whole[found.index] = rate / found.slope
    return changes


def _entry_changes(change: ParameterChange, part: Tensor | None, lattice: Lattice | None) -> Tensor:
    """Return the rate of change of named entries; ``part`` is None for unknown names."""
    if isinstance(change, GaussianBump):
        if lattice is None or part is None or part.ndim < 3:
            raise InputError("expected numbers, got a bump; bumps are for the nodes of a grid")
        return change.evaluate(lattice, part.shape)
    try:
        rate = torch.as_tensor(change, dtype=torch.float64)
    except (TypeError, ValueError):
        raise InputError(f"expected numbers, got {change!r}; give rows of one length") from None
    if part is not None and rate.ndim == 0:
        return rate.expand_as(part)
    if part is not None and isinstance(change, list) and rate.ndim == part.ndim == 1:
        return torch.cat([rate, part.new_zeros(max(len(part) - len(rate), 0))])
    return rate
