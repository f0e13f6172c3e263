"""Search settings of `invertwin twin`."""

from typing import Annotated

from annotated_types import Ge, Len

from invertwin.limits import NonNegative, Positive
from invertwin.registry.section import Section, key

GroundCorner = Annotated[list[float], Len(2, 2)]


class TwinTable(Section):
    """The part of the ground that `invertwin twin` searches, and how."""

    low: GroundCorner | None = key("m, x and y of a corner of the ground; else all seen", None)
    high: GroundCorner | None = key("m, the opposite corner", None)
    range_max: Positive | None = key("m; without it the last range with echoes", None)
    level: float | None = key("m, of the ground; without it 0.6 below the radars", None)
    height: NonNegative | None = key(
        "m above the ground, where echoes are looked for; without it that of the radars", None
    )
    rays: Annotated[int, Ge(100)] = key("rays of every frame in fits", 2000)
