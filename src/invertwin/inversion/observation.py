"""The two inputs of a fit: what was observed, and what is unknown."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn

from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel
from invertwin.inversion.regularization import Regularizer

Loss = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Unknown:
    """A module that is fitted, with settings of its own.

    Attributes:
        module: The module, or a function that makes it for the scene (or sensor) as it stands
            when the module is applied.
        rate: Learning rate in place of the optimizer's.
        regularize: Given the module and the scene (or sensor) that it was made for, terms of the
            loss, which are functions of the scene.
    """

    module: nn.Module | Callable[[Any], nn.Module]
    rate: float | None = None
    regularize: Callable[[nn.Module, Any], Sequence[Regularizer]] | None = None

    @property
    def depends_on_target(self) -> bool:
        """Whether it must know what the unknowns before it make of the scene (or sensor)."""
        return not isinstance(self.module, nn.Module) or self.regularize is not None

    def build_module(self, target: Any) -> nn.Module:
        """The module, for a scene or a sensor."""
        return self.module if isinstance(self.module, nn.Module) else self.module(target)


Unknowns = nn.Module | Unknown | Sequence[nn.Module | Unknown] | Mapping[str, nn.Module | Unknown]


def name_unknowns(unknowns: Unknowns, prefix: str = "") -> dict[str, Unknown]:
    """All unknowns by name, in order.

    Args:
        unknowns: One, several, or several by name; those without a name are called by their
            number.
        prefix: Put before numbers.
    """
    if isinstance(unknowns, nn.Module | Unknown):
        unknowns = [unknowns]
    if not isinstance(unknowns, Mapping):
        unknowns = {f"{prefix}{number}": item for number, item in enumerate(unknowns)}
    return {
        name: item if isinstance(item, Unknown) else Unknown(item)
        for name, item in unknowns.items()
    }


@dataclass(frozen=True, eq=False)
class Observation:
    """What one sensor has observed, and the model that explains it.

    Attributes:
        model: Forward model, such as ``SurrogateMap``, or one's own that derives from
            ``ForwardModel``.
        sensor: What recorded the data, such as a ``Radar``.
        data: A recording that ``model.observe`` understands, or its map.
        weight: Weight of its loss in the mean over all observations.
        parameters: Unknowns of the sensor: modules sensor → sensor, such as ``RangeBias``.
        loss: How maps are compared, in place of the loss of the fit.

    Raises:
        InputError: A weight that is not positive, or a model that is no ``ForwardModel``.
    """

    model: ForwardModel
    sensor: Any
    data: Any
    weight: float = 1.0
    parameters: Unknowns = ()
    loss: Loss | None = None

    def __post_init__(self) -> None:
        if not self.weight > 0:
            raise InputError(f"expected a weight > 0, got {self.weight}; leave the observation out")
        if not isinstance(self.model, ForwardModel):
            raise InputError(
                f"expected a forward model, got {type(self.model).__name__}; give one such as "
                "SurrogateMap(grid), or derive a class from ForwardModel"
            )

    def observed_map(self) -> Tensor:
        """The data in the form of the model's maps."""
        return self.data if isinstance(self.data, Tensor) else self.model.observe(self.data)
