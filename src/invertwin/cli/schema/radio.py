"""The tables of radio maps: transmitters, receivers, and where fits start."""

from typing import Annotated, Any, Literal

import torch
from annotated_types import MinLen
from pydantic import model_validator
from torch import Tensor

from invertwin.cli.schema.fits import SamplingBase
from invertwin.cli.schema.sensors import Orientation, PolarisationValue
from invertwin.limits import Count, NonNegative
from invertwin.links import AntennaMount, PropagationSettings, Reverberation, Transmitters
from invertwin.links.metasurface.coverage import soft_quantile
from invertwin.links.transmitters import FreeSpace
from invertwin.models.radio import RadioMap
from invertwin.refusals import refusal, refusal_text
from invertwin.registry.kinds import OneOf, TableOf, registry
from invertwin.registry.section import Section, Seed, Vector, prefix_errors, raise_key_error
from invertwin.scene import AntennaArray, Scene

_MAX_DRAWS = 10_000  # places that are drawn, before that is given up
_SOFTNESS = 2.0  # dB, width of the smooth tenth and of the level of coverage in a fit


class AntennaTable(Section):
    """An antenna of one element.

    Attributes:
        pattern: without it isotropic
        polarisation: "V", "H", "circular" (right-hand) or two numbers (V, H)
        orientation: look_at or rotation_deg of its axes (x ahead, y left, z up); without it they
            are the world's
    """

    pattern: Annotated[Any, OneOf("pattern")] | None = None
    polarisation: PolarisationValue = "V"
    orientation: Orientation | None = None

    def build_mount(self, positions: Tensor) -> AntennaMount:
        """The antenna at places.

        Args:
            positions: [place, 3] [m].
        """
        pattern = {} if self.pattern is None else {"pattern": self.pattern.build()}
        element = torch.zeros(1, 3, dtype=torch.float64)
        array = AntennaArray(element, polarisation=self.polarisation, **pattern)
        if self.orientation is None:
            return AntennaMount(array)
        return AntennaMount(array, self.orientation.rotations(positions))


class TransmitterTable(AntennaTable):
    """Transmitters: one or several, all with the same antenna.

    Attributes:
        positions: m, of each; where a fit of it starts, unless [transmitter_starts] has better
        power_dbm: sent by each [dBm]
        reverberation: tail of the room around them; without it none
    """

    positions: Annotated[list[Vector], MinLen(1)]
    power_dbm: float = 0.0
    reverberation: Annotated[Any, TableOf(Reverberation)] | None = None

    def build(self) -> Transmitters:
        """The transmitters."""
        places = torch.tensor(self.positions, dtype=torch.float64)
        tail = None if self.reverberation is None else self.reverberation.build()
        return Transmitters(places, self.build_mount(places), self.power_dbm, tail)


_GIVEN = ("receivers", "panels", "rough")
PropagationBase: Any = registry.constructor_table(PropagationSettings, "Reception", without=_GIVEN)


class RoughPathsTable(SamplingBase):
    """Sampling of paths that rough surfaces scatter."""


class MapTable(
    registry.constructor_table(RadioMap, "RadioMap", PropagationBase, without=("propagation",))
):
    """Gain from the transmitters to receivers at known positions.

    Attributes:
        antenna: antenna of every receiver
        rough: paths that rough surfaces scatter, whose power is added; without it left out
    """

    antenna: AntennaTable = AntennaTable()
    rough: RoughPathsTable | None = None

    def build(self, given: Any = None, /, **more: Any) -> RadioMap:
        """The forward model."""
        how = {name: getattr(self, name) for name in PropagationBase.made_from}
        with prefix_errors("places"):
            places = self.places.build()
        receivers = self.antenna.build_mount(getattr(places, "positions", torch.zeros(1, 3)))
        rough = None if self.rough is None else self.rough.build()
        reception = PropagationSettings(**how, receivers=receivers, rough=rough)
        return super().build(given, places=places, propagation=reception, **more)


class TransmitterStartsTable(Section):
    """Random places of the first transmitter in a box, outside of solid objects.

    Attributes:
        low: corner of the box [m]
        high: the opposite corner [m]
        count: fits
        clear: least distance to all surfaces [m]
        seed: without it the run's
    """

    low: Vector
    high: Vector
    count: Count = 10
    clear: NonNegative = 0.1
    seed: Seed | None = None

    def sample_positions(self, scene: Scene, seed: int) -> Tensor:
        """Sample start positions of fits [start, 3].

        Args:
            scene: As known.
            seed: Unless the table has one.

        Raises:
            InputError: No room in the box.
        """
        generator = torch.Generator().manual_seed(seed if self.seed is None else self.seed)
        box = torch.tensor([self.low, self.high], dtype=torch.float64)
        free, found = FreeSpace(scene, self.low, self.high, self.clear), list[Tensor]()
        for _ in range(_MAX_DRAWS):
            share = torch.rand(1, 3, generator=generator, dtype=torch.float64)
            place = box[0] + share * (box[1] - box[0])
            if bool(free.contains(place)):
                found.append(place)
            if len(found) == self.count:
                return torch.cat(found)
        raise refusal("radio.no_room", self.count, len(found))


class AimTable(Section):
    """Aim of the place of a transmitter, instead of data; a receiver has its strongest transmitter.

    Attributes:
        measure: mean level, worst_tenth (level below which a tenth of the receivers lies), or
            coverage (share of the receivers above a level)
        level: that counts as covered, in the unit of the map; with coverage only
    """

    measure: Literal["mean", "worst_tenth", "coverage"] = "worst_tenth"
    level: float | None = None

    @model_validator(mode="after")
    def _check_level(self) -> "AimTable":
        if self.measure == "coverage" and self.level is None:
            raise_key_error('expected a level with "coverage", got none; add it', "level")
        if self.measure != "coverage" and self.level is not None:
            raise_key_error(refusal_text("radio.unused_level", self.measure, self.level), "level")
        return self

    def label(self, unit: str) -> str:
        """Its name for people.

        Args:
            unit: Of the map.
        """
        if self.measure == "coverage":
            return f"share of receivers above {self.level:g} {unit}"
        return f"{self.measure.replace('_', ' ')} [{unit}]"

    def evaluate(self, levels: Tensor, softness: float = 0.0) -> Tensor:
        """The aim of a map.

        Args:
            levels: [tx, ...] in decibels.
            softness: Width of its steps [dB].
        """
        best = levels.amax(0).flatten()
        if self.measure == "mean":
            return best.mean()
        if self.measure == "worst_tenth":
            return soft_quantile(best, 0.1, softness)
        above = best - (self.level or 0.0)
        return ((above / softness).sigmoid() if softness else (above > 0).double()).mean()

    def loss(self, levels: Tensor, before: Tensor) -> Tensor:
        """Compute the loss of a fit: the share that is not covered, or a ratio of powers.

        Its steps are smooth where derivatives are recorded; ends of fits are compared as they are.

        Args:
            levels: [tx, ...] in decibels.
            before: The same at the start of the fit.
        """
        softness = _SOFTNESS if torch.is_grad_enabled() else 0.0
        value = self.evaluate(levels, softness)
        if self.measure == "coverage":
            return 1 - value
        return 10 ** ((self.evaluate(before, softness) - value) / 10)


AnyMap = Annotated[Any, TableOf(RadioMap, MapTable, ("propagation",), checked=False)]
