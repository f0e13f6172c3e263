"""Distributions of the values of a run file."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from invertwin.checks import check_some
from invertwin.errors import InputError
from invertwin.limits import NonNegative, Positive, UnitFraction

NumberOrList = float | Sequence[float]
UNCHANGED: Final = object()
"""Drawn where a key stays as it is, with what others have drawn in it."""


class Distribution(ABC):
    """Draws values for a key. None takes the key away, and ``UNCHANGED`` leaves it as it is."""

    @abstractmethod
    def draw(self, generator: np.random.Generator) -> Any:
        """A value, ``UNCHANGED``, or None."""

    @abstractmethod
    def extreme_values(self) -> list[Any]:
        """Values that are as bad as any other: if these are right, all are."""


class _Between(Distribution):
    """Draw values between two limits."""

    low: Any
    high: Any

    def __post_init__(self) -> None:
        _check_order(self.low, self.high)

    def extreme_values(self) -> list[Any]:
        """Both limits."""
        return [_to_python(self.low), _to_python(self.high)]


@dataclass(frozen=True)
class Uniform(_Between):
    """Every number between two limits alike; lists entry by entry.

    Attributes:
        low: Smallest, one number or a list.
        high: Largest.

    Raises:
        InputError: Limits of different lengths, or in the wrong order.
    """

    low: NumberOrList
    high: NumberOrList

    def draw(self, generator: np.random.Generator) -> Any:
        """A number, or a list of independent ones."""
        return np.asarray(generator.uniform(self.low, self.high, _shape_of(self.low))).tolist()


@dataclass(frozen=True)
class LogUniform(_Between):
    """Numbers whose logarithms are uniform: every octave alike; lists entry by entry.

    Attributes:
        low: Smallest, > 0, one number or a list.
        high: Largest.

    Raises:
        InputError: Limits of different lengths, in the wrong order, or not positive.
    """

    low: Positive | Sequence[Positive]
    high: Positive | Sequence[Positive]

    def __post_init__(self) -> None:
        super().__post_init__()
        if np.min(self.low) <= 0:
            raise InputError(f"expected low > 0, got {self.low}; its logarithm is needed")

    def draw(self, generator: np.random.Generator) -> Any:
        """A number, or a list of independent ones."""
        share = generator.random(_shape_of(self.low))
        low, high = np.asarray(self.low, dtype=float), np.asarray(self.high, dtype=float)
        # The last bit of a power may lie beyond a limit.
        return np.clip(low * (high / low) ** share, low, high).tolist()


@dataclass(frozen=True)
class Normal(Distribution):
    """Gaussian numbers; lists entry by entry.

    Attributes:
        mean: One number or a list.
        deviation: Standard deviation, of all entries or of each.

    Raises:
        InputError: Lists of different lengths, or a negative deviation.
    """

    mean: NumberOrList
    deviation: NonNegative | Sequence[NonNegative]

    def __post_init__(self) -> None:
        if np.shape(self.deviation) not in ((), np.shape(self.mean)):
            raise InputError(
                f"expected one deviation or one for each of {np.size(self.mean)} means, got "
                f"{np.size(self.deviation)}; give as many"
            )
        if np.min(self.deviation) < 0:
            raise InputError(f"expected deviations >= 0, got {self.deviation}; correct them")

    def draw(self, generator: np.random.Generator) -> Any:
        """A number, or a list of independent ones."""
        drawn = generator.normal(self.mean, self.deviation, _shape_of(self.mean))
        return np.asarray(drawn).tolist()

    def extreme_values(self) -> list[Any]:
        """The mean: the numbers themselves have no limits."""
        return [_to_python(self.mean)]


@dataclass(frozen=True)
class Integer(_Between):
    """Every whole number between two limits alike; lists entry by entry.

    Attributes:
        low: Smallest, one number or a list.
        high: Largest, which is drawn, too.

    Raises:
        InputError: Limits of different lengths, or in the wrong order.
    """

    low: int | Sequence[int]
    high: int | Sequence[int]

    def draw(self, generator: np.random.Generator) -> Any:
        """A whole number, or a list of independent ones."""
        drawn = generator.integers(self.low, self.high, _shape_of(self.low), endpoint=True)
        return np.asarray(drawn).tolist()


@dataclass(frozen=True)
class Choice(Distribution):
    """One of several values: numbers, texts, lists or whole tables.

    Attributes:
        values: Those to choose from.
        weights: Relative frequency of each choice; None = equal.

    Raises:
        InputError: No values, or weights that are not one for each, negative, or all zero.
    """

    values: Sequence[Any]
    weights: Sequence[NonNegative] | None = None

    def __post_init__(self) -> None:
        check_some(self.values, "value to choose from", "give some")
        if self.weights is None:
            return
        if len(self.weights) != len(self.values):
            raise InputError(
                f"expected a weight for each of {len(self.values)} values, got "
                f"{len(self.weights)}; give as many"
            )
        if min(self.weights) < 0 or not sum(self.weights) > 0:
            raise InputError(f"expected weights >= 0, some > 0, got {self.weights}; correct them")

    def draw(self, generator: np.random.Generator) -> Any:
        """One of the values."""
        weights = None if self.weights is None else np.asarray(self.weights) / sum(self.weights)
        return self.values[int(generator.choice(len(self.values), p=weights))]

    def extreme_values(self) -> list[Any]:
        """All values."""
        return list(self.values)


@dataclass(frozen=True)
class Presence(Distribution):
    """The presence of a key or a table, such as an object, with a probability.

    Attributes:
        probability: Probability that it is.
    """

    probability: UnitFraction = 0.5

    def draw(self, generator: np.random.Generator) -> Any:
        """Kept, or None."""
        return UNCHANGED if generator.random() < self.probability else None

    def extreme_values(self) -> list[Any]:
        """None: what is stated has been checked."""
        return [None]


def _check_order(low: NumberOrList, high: NumberOrList) -> None:
    if np.shape(low) != np.shape(high):
        raise InputError(
            f"expected limits of one length, got {np.size(low)} and {np.size(high)} numbers; give "
            "as many"
        )
    if not np.all(np.asarray(low) <= np.asarray(high)):
        raise InputError(f"expected low <= high, got {low} and {high}; swap them")


def _shape_of(value: NumberOrList) -> tuple[int, ...] | None:
    return np.shape(value) or None


def _to_python(value: Any) -> Any:
    return list(value) if isinstance(value, Sequence) else value
