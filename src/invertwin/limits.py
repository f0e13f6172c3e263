"""What a value may be, as annotations: the library's signatures state it, run files check it."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

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


@dataclass(frozen=True)
class Among:
    """Marks a text that is one of these names."""

    names: tuple[str, ...]

    def __get_pydantic_core_schema__(self, _: Any, handler: Any) -> Any:
        return handler.generate_schema(Literal[self.names])


Axes = Annotated[str, Letters("xyz")]
