"""The two inputs of a fit: observations and unknowns."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn

from invertwin.checks import checked_type, set_fields
from invertwin.deprecation import warn_renamed
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel
from invertwin.inversion.regularization import Regularizer

Loss = Callable[[Tensor, Tensor], Tensor]
_FROM_DATA: Any = object()  # a sensor that is not given


@dataclass(frozen=True)
class Unknown:
    """A fitted module with settings of its own.

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
        """True if the module depends on the scene (or sensor) that earlier unknowns return."""
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


@dataclass(frozen=True, eq=False, init=False)
class Observation:
    """Data of one sensor, and the model that predicts them.

    Attributes:
        model: Forward model, such as ``SurrogateMap``, or one's own that derives from
            ``ForwardModel``.
        data: A recording that ``model.observe`` takes, or a map of it.
        sensor: The sensor that recorded the data, such as a ``Radar`` or a ``Camera``. It may be
            left out where the recording has a radar, as a ``Capture`` does.
        weight: Weight of the loss in the mean over all observations, > 0.
        parameters: Unknowns of the sensor: modules sensor → sensor, such as ``RangeBias``.
        loss: Loss (predicted, observed) → a number, in place of the loss of the fit.

    Raises:
        InputError: No sensor, a weight that is not positive, or a model that is no
            ``ForwardModel``.
    """

    model: ForwardModel
    data: Any
    sensor: Any
    weight: float
    parameters: Unknowns
    loss: Loss | None

    def __init__(
        self,
        model: ForwardModel,
        data: Any,
        *deprecated: Any,
        sensor: Any = _FROM_DATA,
        weight: float = 1.0,
        parameters: Unknowns = (),
        loss: Loss | None = None,
    ) -> None:
        """Combine a model with data; see the class for the arguments."""
        if deprecated:
            warn_renamed("Observation(model, sensor, data)", "Observation(model, data, sensor=...)")
            sensor = data
            given: list[Any] = [*deprecated, *(weight, parameters, loss)[len(deprecated) - 1 :]]
            data, weight, parameters, loss = given
        do = "give one such as SurrogateMap(grid), or derive a class from ForwardModel"
        checked_type(model, ForwardModel, "a forward model", do)
        if sensor is _FROM_DATA:
            sensor = _sensor_of_recording(data, model)
        if not weight > 0:
            raise InputError(f"expected a weight > 0, got {weight}; leave the observation out")
        values = (model, data, sensor, weight, parameters, loss)
        set_fields(self, **dict(zip(self.__dataclass_fields__, values, strict=True)))

    def observed_map(self) -> Tensor:
        """Return the data in the form of the model's maps."""
        return self.data if isinstance(self.data, Tensor) else self.model.observe(self.data)

    def initial_sensor(self) -> Any:
        """Return the sensor with its unknowns at their initial values."""
        sensor = self.sensor
        for unknown in name_unknowns(self.parameters).values():
            sensor = unknown.build_module(sensor)(sensor)
        return sensor


def _sensor_of_recording(data: Any, model: ForwardModel) -> Any:
    """Return the radar of a recording; None for models without a sensor."""
    radar = getattr(data, "radar", None)
    if radar is not None:
        return radar() if callable(radar) else radar
    if model.needs_sensor:
        raise InputError(
            f"expected a recording that has its radar, got {type(data).__name__}; give "
            "Observation(model, data, sensor=...)"
        )
    return None
