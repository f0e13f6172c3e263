"""Search settings of `invertwin twin`."""

from typing import Annotated

from annotated_types import Ge, Len

from invertwin.limits import NonNegative, Positive
from invertwin.registry.section import Section

GroundCorner = Annotated[list[float], Len(2, 2)]


class TwinTable(Section):
    """The part of the ground that `invertwin twin` searches, and how.

    Attributes:
        low: m, x and y of a corner of the ground; else all seen
        high: m, the opposite corner
        range_max: m; without it the last range with echoes
        level: m, of the ground; without it 0.6 below the radars
        height: m above the ground, where echoes are looked for; without it that of the radars
        rays: rays of every frame in fits
    """

    low: GroundCorner | None = None
    high: GroundCorner | None = None
    range_max: Positive | None = None
    level: float | None = None
    height: NonNegative | None = None
    rays: Annotated[int, Ge(100)] = 2000
