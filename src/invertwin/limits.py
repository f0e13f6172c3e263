"""Limits of values as annotations.

The signatures of the library state them; `scene.checks.check_fields` and run files apply them.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args, get_origin

from annotated_types import Ge, Gt, Le

UnitFraction = Annotated[float, Ge(0), Le(1)]
MAX_NUMBER = 1e30
"""In SI units; larger numbers are a mistake, and their products are none any more."""
Positive = Annotated[float, Gt(0), Le(MAX_NUMBER)]
NonNegative = Annotated[float, Ge(0), Le(MAX_NUMBER)]
MAX_COUNT = 2**31 - 1
"""Larger counts are a mistake; the ray tracer numbers its rays by 32 bits."""
Count = Annotated[int, Ge(1), Le(MAX_COUNT)]
CountOfTwo = Annotated[int, Ge(2), Le(MAX_COUNT)]
MAX_LENGTH = 1e9
"""[m], beyond the Moon; farther away, a double does not tell the phase of a millimetre wave."""

Decibels = Annotated[float, Ge(-300), Le(300)]
"""A ratio of powers whose square is a number."""
RADIANS = "rad"
"""Marks a value in radians. Its key in a run file ends in `_deg` and is in degrees."""
Angle = Annotated[float, RADIANS]


@dataclass(frozen=True)
class AllowedLetters:
    """Marks a text that is made of some letters. In a run file it is a list of them."""

    letters: str


@dataclass(frozen=True)
class AllowedValues:
    """Marks a text or a number that is one of these."""

    values: tuple[str | int, ...]

    def __get_pydantic_core_schema__(self, _: Any, handler: Any) -> Any:
        return handler.generate_schema(Literal[self.values])


Axes = Annotated[str, AllowedLetters("xyz")]


@dataclass(frozen=True)
class UsualValue:
    """Marks a number with its SI unit and a usual value, so that another unit is noticed.

    Attributes:
        unit: Such as "Hz".
        value: A usual number in this unit.
        low: Smaller numbers are taken to be in another unit.
        high: Larger numbers are taken to be in another unit.
    """

    unit: str
    value: float
    low: float = 0.0
    high: float = math.inf

    def suggest_value(self, number: float) -> str:
        """The number times the power of ten that brings it nearest to the usual value."""
        decades = math.log10(self.value / number)
        shift = min((9, 6, 3, -3, -6, -9, -12), key=lambda e: abs(e - decades))
        text = f"{number:g}"
        return f"{number * 10.0**shift:g}" if "e" in text else f"{text}e{shift}"


_MAX_RADIO = 3e14  # Hz: light; models of a thousandth of the size have 77e12 Hz
Frequency = Annotated[Positive, UsualValue("Hz", 77e9, 1e6, _MAX_RADIO)]
# Analysers start at 9 kHz.
SweptFrequency = Annotated[Positive, UsualValue("Hz", 77e9, 1e3, _MAX_RADIO)]
Bandwidth = Annotated[Positive, UsualValue("Hz", 1e9, 1e6, _MAX_RADIO)]
FrequencyStep = Annotated[Positive, UsualValue("Hz", 1e6, 1e3, _MAX_RADIO)]
Duration = Annotated[Positive, UsualValue("seconds", 4e-5, 1e-12, 1.0)]


def annotation_parts(hint: Any) -> Iterator[Any]:
    """The types and the marks that an annotation is made of, also of its items and members."""
    yield from getattr(hint, "__metadata__", ())
    parts = get_args(hint)[:1] if get_origin(hint) is Annotated else get_args(hint)
    if not parts or get_origin(hint) is Literal:
        yield hint
        return
    for part in parts:
        yield from annotation_parts(part)
