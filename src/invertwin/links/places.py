"""Receiver locations of a radio map, as one value: points."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Float64
from torch import Tensor

from invertwin.checks import checked_positions, set_fields
from invertwin.links.received import LinkStatistics, PropagationSettings
from invertwin.links.transmitters import Transmitters
from invertwin.scene.scene import Scene


class ReceiverLocations(ABC):
    """Receiver locations of a ``RadioMap``.

    Attributes:
        is_random: True if points are drawn at random.
    """

    is_random: ClassVar[bool] = False

    @property
    @abstractmethod
    def shape(self) -> tuple[int, ...]:
        """Shape of the map of one transmitter."""

    @abstractmethod
    def link_statistics(
        self, scene: Scene, sensor: Transmitters, propagation: PropagationSettings, seed: int
    ) -> LinkStatistics:
        """Compute gain and delay spread at the locations.

        Args:
            scene: Propagation environment.
            sensor: Transmitters.
            propagation: Settings of the path search and of the sum over paths.
            seed: Seed of all random numbers.
        """

    def with_sample_count(self, samples: int) -> "ReceiverLocations":
        """Return the same locations with another total number of random points.

        Args:
            samples: Total number of points.
        """
        return self

    def fixed_visibility(self) -> "ReceiverLocations | None":
        """Locations without boundary paths, for ablation; None if there are no boundary paths."""
        return None


@dataclass(frozen=True, eq=False)
class ReceiverPoints(ReceiverLocations):
    """Receiver locations at single points.

    Attributes:
        positions: Positions [receiver, 3] in world axes [m]. Differentiable.

    Raises:
        InputError: Wrong shapes, NaN, or no point.
    """

    positions: Float64[Tensor, "place 3"]

    def __post_init__(self) -> None:
        do = "give a row of x, y, z for each"
        places = checked_positions(self.positions, "receiver positions", "point of a map", do)
        set_fields(self, positions=places)

    @property
    def shape(self) -> tuple[int, ...]:
        """(number of points,)."""
        return (len(self.positions),)

    def link_statistics(
        self, scene: Scene, sensor: Transmitters, propagation: PropagationSettings, seed: int
    ) -> LinkStatistics:
        """Compute gain and delay spread at the points."""
        return propagation.link_statistics(scene, sensor, self.positions, seed)
