"""What a value may be, as annotations: the library's signatures state it, run files check it."""

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Gt, Le

Positive = Annotated[float, Gt(0)]
NonNegative = Annotated[float, Ge(0)]
Share = Annotated[float, Ge(0), Le(1)]
Count = Annotated[int, Ge(1)]

RADIANS = "rad"
"""Marks a value in radians. Its key in a run file ends in `_deg` and is in degrees."""
Angle = Annotated[float, RADIANS]


@dataclass(frozen=True)
class Letters:
    """Marks a text that is made of some letters. In a run file it is a list of them."""

    allowed: str


Axes = Annotated[str, Letters("xyz")]
