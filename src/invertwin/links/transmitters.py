"""Transmitters with positions, antennas and powers, and modules that move them."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float64
from torch import Tensor, nn

from invertwin.checks import ArrayLike, checked_rows, checked_tensor, set_fields, to_tensor
from invertwin.errors import InputError
from invertwin.limits import Axes
from invertwin.links.responses import AntennaMount
from invertwin.scene.parameters import Coordinate, axes_mask, free_part, position_coordinates


@dataclass(frozen=True, eq=False)
class Transmitters:
    """Sensor of a ``RadioMap``: one or several transmitters with the same antenna.

    Attributes:
        positions: Positions [tx, 3], or [3] of a single one, in world axes [m]. Differentiable.
        mount: Antenna mount at each position; the power is the mean over its elements.
        power_dbm: Transmitted power [dBm], one value for all transmitters or one for each.

    Raises:
        InputError: Wrong shapes, NaN, or no transmitter.
    """

    positions: Float64[Tensor, "*tx 3"]
    mount: AntennaMount = field(default_factory=AntennaMount)
    power_dbm: float | Float64[Tensor, " tx"] = 0.0

    def __post_init__(self) -> None:
        do = "give x, y, z, or a row of them for each"
        places = checked_rows(self.positions, "positions of transmitters [m]", do)
        power = to_tensor(self.power_dbm, "powers of transmitters [dBm]", "give numbers")
        power = power.expand(len(places)) if power.ndim == 0 else power
        do = "give one for all, or one each"
        power = checked_tensor(power, (len(places),), "powers of transmitters [dBm]", do, 300.0)
        set_fields(self, positions=places, power_dbm=power)

    @property
    def powers(self) -> Float64[Tensor, " tx"]:
        """Transmitted power of each [mW]."""
        return 10.0 ** (torch.as_tensor(self.power_dbm) / 10)

    def frames(self, chosen: Sequence[int]) -> "Transmitters":
        """Select some of the transmitters.

        Args:
            chosen: Indices of the transmitters.
        """
        rows, terminals = torch.as_tensor(chosen), self.mount
        if terminals.rotations.ndim == 3:
            terminals = replace(terminals, rotations=terminals.rotations[rows])
        return Transmitters(self.positions[rows], terminals, torch.as_tensor(self.power_dbm)[rows])


class TransmitterPosition(nn.Module):
    """Module Transmitters → Transmitters with the position of one transmitter as parameter.

    With a box, such as a room, the position stays inside the box: a step that leaves it is clamped
    to its border.

    Args:
        initial: Initial position [3] [m].
        low: Corner of the box [3] [m]; None = no box.
        high: Opposite corner of the box [3] [m].
        axes: World axes along which the position is fitted; other coordinates are fixed.
        number: Index of the transmitter.

    Attributes:
        place: Parameter [3], position [m].

    Raises:
        InputError: A wrong shape, an unknown axis, only one corner, or an initial position outside
            the box.
    """

    def __init__(
        self,
        initial: ArrayLike,
        low: ArrayLike | None = None,
        high: ArrayLike | None = None,
        axes: Axes = "xyz",
        number: int = 0,
    ) -> None:
        super().__init__()
        do = "give x, y, z"
        begun = checked_tensor(initial, (3,), "initial place of a transmitter [m]", do)
        begun = begun.detach().clone()
        self._axes, self._number = axes_mask(axes), number
        if (low is None) != (high is None):
            raise InputError("expected both corners of the box, got one; give low and high")
        self._box = None
        if low is not None and high is not None:
            ends = (
                checked_tensor(corner, (3,), f"{name} corner of the box [m]", do)
                for name, corner in (("low", low), ("high", high))
            )
            self._box = torch.stack([*ends])
            if not bool(((begun > self._box[0]) & (begun < self._box[1])).all()):
                raise InputError(
                    "expected an initial place inside the box, got one outside or on its border; "
                    "choose another start or a larger box"
                )
        self.raw_position = nn.Parameter(begun)

    @property
    def position(self) -> Float64[Tensor, "3"]:
        """Position of the transmitter [m]."""
        if self._box is not None:
            with torch.no_grad():
                self.raw_position.data.clamp_(*self._box)
        return free_part(self.raw_position, self._axes)

    def forward(self, sensor: Transmitters) -> Transmitters:
        """Return the transmitters with the position of this one."""
        own = (torch.arange(len(sensor.positions)) == self._number)[:, None]
        return replace(sensor, positions=torch.where(own, self.position, sensor.positions))

    def values(self) -> dict[str, Tensor]:
        """Position [m] by name, for progress and reports."""
        return {"transmitter.position": self.position.detach().clone()}

    def coordinates(self) -> list[Coordinate]:
        """Free coordinates among x, y and z of the transmitter."""
        return position_coordinates("transmitter", "raw_position", self._axes)

    def at_bounds(self) -> list[str]:
        """Names of coordinates on the border of the box."""
        if self._box is None:
            return []
        place = self.raw_position.detach()
        near = ((place <= self._box[0]) | (place >= self._box[1])).tolist()
        return [f"transmitter.{axis}" for axis, at in zip("xyz", near, strict=True) if at]
