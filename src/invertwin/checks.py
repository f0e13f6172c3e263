"""Checks of values that enter the library, with errors that say what to do."""

import math
import operator
from collections.abc import Collection, Sequence, Sized
from functools import cache
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
import torch
import torch.autograd.forward_ad as forward_ad
from annotated_types import Ge, Gt, Le, Len, Lt
from torch import Tensor
from torch._C._functorch import get_unwrapped, is_batchedtensor, is_functorch_wrapped_tensor

from invertwin.errors import InputError
from invertwin.limits import MAX_LENGTH, MAX_NUMBER, AllowedValues, UsualValue, annotation_parts

ArrayLike = Tensor | np.ndarray | Sequence[Any]
Point = Annotated[ArrayLike, Len(3, 3)]
MAX_COUNTED = 10**8
"""Greatest count of what lies in memory, such as vertices and nodes."""
Counts = Annotated[Sequence[Annotated[int, Ge(2)]], Len(3, 3)]
_LIMITS: dict[type, tuple[str, str, Any]] = {
    Gt: ("gt", "above", operator.gt),
    Ge: ("ge", "of at least", operator.ge),
    Lt: ("lt", "below", operator.lt),
    Le: ("le", "of at most", operator.le),
}


def checked_tensor(
    value: object, shape: tuple[int | None, ...], what: str, do: str, most: float = MAX_NUMBER
) -> Tensor:
    """Convert a value to a finite float64 tensor of the given shape; gradients are kept.

    Args:
        value: tensor, array or nested sequence of numbers.
        shape: expected size of every dimension, None where any size will do.
        what: noun for the value, for the message.
        do: remedy, for the message.
        most: greatest magnitude.

    Raises:
        InputError: not numbers, wrong shape, NaN, infinite or too large.
    """
    tensor = to_tensor(value, f"{what} as numbers of shape {_format_shape(shape)}", do)
    check_shape(refuse_batch(tensor), shape, f"{what} as numbers", do)
    bad = int((~(tensor.detach().abs() <= most)).sum())
    if bad:
        raise InputError(
            f"expected finite {what}, got {bad} NaN, infinite or above {most:g} of "
            f"{tensor.numel()}; {do}"
        )
    return tensor


def to_tensor(
    value: object, what: str, do: str, dtype: torch.dtype | None = torch.float64
) -> Tensor:
    """Convert a value to a tensor of any shape; gradients are kept.

    Args:
        value: tensor, array or nested sequence of numbers.
        what: noun for the value, for the message.
        do: remedy, for the message.
        dtype: type of the numbers; None = that of the value.

    Raises:
        InputError: not numbers.
    """
    try:
        return torch.as_tensor(value, dtype=dtype)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise InputError(f"expected {what}, got {type(value).__name__}; {do}") from None


def checked_type(value: object, kind: type, what: str, do: str) -> None:
    """Raise unless a value is of a type.

    Args:
        value: the value.
        kind: the type.
        what: noun for the value, for the message.
        do: remedy, for the message.

    Raises:
        InputError: another type.
    """
    if not isinstance(value, kind):
        raise InputError(f"expected {what} ({kind.__name__}), got {value!r:.80}; {do}")


def check_choice(
    value: object, known: Collection[str | int], what: str, do: str = "choose one"
) -> None:
    """Raise unless a value is one of some words.

    Args:
        value: the value.
        known: the words.
        what: noun before the words in the message.
        do: remedy, for the message.

    Raises:
        InputError: another value.
    """
    if value not in known:
        raise InputError(f"expected {what} {', '.join(map(str, known))}, got {value!r}; {do}")


def check_some(values: Sized, what: str, do: str) -> None:
    """Raise unless there is one value or more.

    Args:
        values: the values.
        what: one of them, for the message.
        do: remedy, for the message.

    Raises:
        InputError: no value.
    """
    if not len(values):
        raise InputError(f"expected at least one {what}, got none; {do}")


def checked_point(
    value: object, what: str, do: str = "give x, y, z", most: float = MAX_NUMBER
) -> Tensor:
    """Convert a point or a direction to three finite numbers [3]; gradients are kept.

    Args:
        value: the numbers.
        what: noun for them, for the message.
        do: remedy, for the message.
        most: greatest magnitude.

    Raises:
        InputError: wrong shape, NaN, infinite or too large.
    """
    return checked_tensor(value, (3,), what, do, most)


def checked_positions(value: object, what: str, one: str, do: str) -> Tensor:
    """Convert positions to finite rows [position, 3], at least one; gradients are kept.

    Args:
        value: numbers [position, 3] in metres.
        what: noun for the positions, for the message.
        one: what has a position each, for the message.
        do: remedy, for the message.

    Raises:
        InputError: wrong shape, NaN, infinite or too large, or no position.
    """
    rows = checked_tensor(value, (None, 3), what, do, MAX_LENGTH)
    check_some(rows, one, do)
    return rows


def checked_rows(value: object, what: str, do: str = "give x, y, z of each") -> Tensor:
    """Convert one point or several to finite rows [point, 3], at least one; gradients are kept.

    Args:
        value: numbers [3] or [point, 3].
        what: noun for the points, for the message.
        do: remedy, for the message.

    Raises:
        InputError: wrong shape, NaN or infinite, or no point.
    """
    rows = to_tensor(value, f"{what} as numbers", do)
    rows = rows[None] if rows.ndim == 1 else rows
    return checked_positions(rows, what, f"row of {what}", do)


def checked_ascending(value: object, what: str, do: str, least: int = 2) -> Tensor:
    """Convert a value to finite numbers that ascend; gradients are kept.

    Args:
        value: tensor, array or sequence of numbers.
        what: noun for the values, for the message.
        do: remedy, for the message.
        least: least number of values.

    Raises:
        InputError: not numbers, too few, or some that do not ascend.
    """
    found = checked_tensor(value, (None,), what, do)
    if len(found) < least or bool((found.diff() <= 0).any()):
        raise InputError(f"expected at least {least} ascending {what}, got {found.tolist()}; {do}")
    return found


def refuse_batch(value: Tensor) -> Tensor:
    """Return a tensor, unless it is a batch of `torch.func.vmap`.

    Args:
        value: any tensor.

    Raises:
        InputError: a batch: rays see one scene at a time.
    """
    if is_batchedtensor(value):
        raise InputError(
            "expected the tensors of one scene, got a batch of torch.func.vmap; give a list of "
            "scenes to SurrogateMap.predict_batch, or call for one scene after another and "
            "torch.stack the maps (torch.func.jacfwd and jacrev may batch them)"
        )
    return value


def strip_derivatives(value: Tensor) -> Tensor:
    """The numbers of a tensor, without derivatives and without the wrappers of `torch.func`.

    Args:
        value: a tensor that is no batch.
    """
    while is_functorch_wrapped_tensor(value):
        value = get_unwrapped(refuse_batch(value))
    return value.detach()


def check_shape(value: Tensor, shape: Sequence[int | None], what: str, do: str) -> None:
    """Raise unless a tensor has the given shape.

    Args:
        value: the tensor.
        shape: expected size of every dimension, None where any size will do.
        what: noun for the value, for the message.
        do: remedy, for the message.

    Raises:
        InputError: another shape.
    """
    pairs = zip(shape, value.shape, strict=False)
    if value.ndim != len(shape) or any(size not in (None, actual) for size, actual in pairs):
        raise InputError(
            f"expected {what} of shape {_format_shape(shape)}, got shape {list(value.shape)}; {do}"
        )


def _format_shape(shape: Sequence[int | None]) -> str:
    return f"[{', '.join('any' if size is None else str(size) for size in shape)}]"


def checked_number(
    value: object, what: str, low: float, high: float = math.inf, *, open_low: bool = False
) -> float:
    """Convert a value to a finite number in [low, high], or in (low, high] if `open_low`.

    Args:
        value: a number, or a tensor of dimension 0.
        what: its name and unit, for the error.
        low: least value.
        high: greatest value.
        open_low: whether the least value itself is excluded.

    Raises:
        InputError: not a number, NaN, infinite or out of range.
    """
    opening = "(" if open_low else "["
    closing = ")" if math.isinf(high) else "]"
    expected = f"expected {what} in {opening}{low:g}, {high:g}{closing}"
    bare = strip_derivatives(value) if isinstance(value, Tensor) else value
    if isinstance(bare, bool) or not (
        isinstance(bare, int | float | np.number)
        or (isinstance(bare, Tensor) and bare.ndim == 0 and not bare.is_complex())
    ):
        raise InputError(f"{expected}, got {type(value).__name__}; give one real number")
    number = float(_cut_integer(bare))
    inside = low < number <= high if open_low else low <= number <= high
    if not (math.isfinite(number) and inside):
        raise InputError(f"{expected}, got {number:g}; give a value in that range")
    return number


def checked_count(value: Any, what: str, low: int, high: int = MAX_COUNTED) -> int:
    """Convert a value to an integer in [low, high].

    Args:
        value: an integer.
        what: its name, for the error.
        low: least value.
        high: greatest value.

    Raises:
        InputError: not an integer, or out of range.
    """
    value = _cut_integer(value)
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not (whole and low <= value <= high):
        expected = f"expected {what} as an integer in [{low}, {high}]"
        raise InputError(f"{expected}, got {value!r}; give a count in that range")
    return int(value)


def check_fields(holder: object) -> None:
    """Raise unless the fields of a dataclass keep to the limits in their annotations.

    A field that is None, where it may be, has no limits. In a tuple every item is checked.

    Raises:
        InputError: a word that is not one of those allowed; a number that is beyond a limit, not
            finite, not whole where a count is expected, or evidently in another unit.
    """
    for name, found in _field_limits(type(holder)).items():
        value = getattr(holder, name)
        if value is None and type(None) in found:
            continue
        allowed = [word for mark in found for word in _describe_limit(mark)]
        if not allowed:
            for number in value if isinstance(value, tuple) else (value,):
                _check_number(holder, name, number, found)
        else:
            check_choice(value, allowed, f"{name} to be one of", "choose one of them")


class CheckedFields:
    """Base class of dataclasses whose fields keep to the limits in their annotations.

    Raises:
        InputError: a value beyond its limits, see ``check_fields``.
    """

    def __post_init__(self) -> None:
        check_fields(self)


@cache
def _field_limits(kind: type) -> dict[str, tuple[Any, ...]]:
    found = {
        n: tuple(annotation_parts(h)) for n, h in get_type_hints(kind, include_extras=True).items()
    }
    return {
        name: of
        for name, of in found.items()
        if any(type(mark) in _LIMITS or _describe_limit(mark) for mark in of)
    }


def _describe_limit(mark: Any) -> tuple[str | int, ...]:
    if isinstance(mark, AllowedValues):
        return mark.values
    return get_args(mark) if get_origin(mark) is Literal else ()


def _check_number(holder: object, name: str, number: Any, found: tuple[Any, ...]) -> None:
    usual = next((mark for mark in found if isinstance(mark, UsualValue)), None)
    do = f"correct {type(holder).__name__}({name}=...)"
    if usual is not None:
        do = f"give it in {usual.unit}, such as {usual.value:g}"
    number = _cut_integer(number)
    if int in found and not isinstance(number, int | np.integer):
        raise InputError(f"expected {name} as an integer, got {number!r}; give a count")
    if isinstance(number, bool) or not isinstance(number, int | float | np.integer | np.floating):
        raise InputError(f"expected {name} as a number, got {number!r}; {do}")
    for mark in found:
        if type(mark) in _LIMITS:
            field, words, holds = _LIMITS[type(mark)]
            limit = getattr(mark, field)
            if not (math.isfinite(number) and holds(number, limit)):
                raise InputError(f"expected {name} {words} {limit:g}, got {number}; {do}")
    if usual and not usual.low <= number <= usual.high:
        meant = usual.suggest_value(float(number))
        raise InputError(f"expected {name} in {usual.unit}, got {number:g}; did you mean {meant}?")


def _cut_integer(value: Any) -> Any:
    """Return ±∞ for an integer of hundreds of digits, which no float holds and no text shows."""
    if isinstance(value, int) and abs(value) > 1e300:
        return math.inf if value > 0 else -math.inf
    return value


def check_orthonormal(axes: Tensor, what: str, do: str) -> None:
    """Raise unless the columns of matrices are orthonormal, to 1e-5.

    Args:
        axes: [*, 3, 3].
        what: noun for the values, for the message.
        do: remedy, for the message.

    Raises:
        InputError: other columns.
    """
    still = axes.detach()
    if float((still.mT @ still - torch.eye(3, dtype=torch.float64)).abs().max()) > 1e-5:
        raise InputError(f"expected {what} with orthonormal columns; {do}")


def set_fields(holder: object, **values: object) -> None:
    """Set fields of a frozen dataclass, while it is made.

    Args:
        holder: the dataclass.
        values: values by the names of the fields.
    """
    for name, value in values.items():
        object.__setattr__(holder, name, value)


def refuse_derivatives(value: Tensor | None, what: str, do: str) -> None:
    """Raise if derivatives flow through a tensor.

    Args:
        value: the tensor.
        what: noun for the value, for the message.
        do: remedy, for the message.

    Raises:
        InputError: a tensor with derivatives.
    """
    if is_differentiated(value):
        raise InputError(f"expected {what} without derivatives, got some; {do}")


def is_differentiated(value: Tensor | None) -> bool:
    """Return True if derivatives flow through a tensor, in reverse or in forward mode."""
    if value is None:
        return False
    return value.requires_grad or forward_ad.unpack_dual(value).tangent is not None
