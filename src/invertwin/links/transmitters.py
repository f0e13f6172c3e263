"""Transmitters with positions, antennas and powers, and modules with their parameters."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float64
from torch import Tensor, nn

from invertwin.checks import ArrayLike, checked_rows, checked_tensor, set_fields, to_tensor
from invertwin.errors import InputError
from invertwin.limits import Axes, NonNegative
from invertwin.links.responses import AntennaMount
from invertwin.links.reverberation import NEPERS_PER_DB, Reverberation
from invertwin.scene import Scene, signed_distance
from invertwin.scene.parameters import Coordinate, axes_mask, free_part, position_coordinates


@dataclass(frozen=True, eq=False)
class Transmitters:
    """Sensor of a ``RadioMap``: one or several transmitters with the same antenna.

    Attributes:
        positions: Positions [tx, 3], or [3] of a single one, in world axes [m]. Differentiable.
        mount: Antenna mount at each position; the power is the mean over its elements.
        power_dbm: Transmitted power [dBm], one value for all transmitters or one for each.
        reverberation: Reverberant tail of the room around them; None = without.

    Raises:
        InputError: Wrong shapes, NaN, or no transmitter.
    """

    positions: Float64[Tensor, "*tx 3"]
    mount: AntennaMount = field(default_factory=AntennaMount)
    power_dbm: float | Float64[Tensor, " tx"] = 0.0
    reverberation: Reverberation | None = None

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
        powers = torch.as_tensor(self.power_dbm)[rows]
        return replace(self, positions=self.positions[rows], mount=terminals, power_dbm=powers)


class FreeSpace:
    """Places that keep a distance from all surfaces of a scene, outside of solid objects.

    Args:
        scene: Objects, as they are now. One that holds the whole box is a room, not a solid object.
        low, high: Opposite corners of the box [3] [m].
        clear: Least distance [m].
    """

    def __init__(self, scene: Scene, low: ArrayLike, high: ArrayLike, clear: float) -> None:
        box = torch.stack([torch.as_tensor(end, dtype=torch.float64) for end in (low, high)])
        items = scene.objects.values()
        self._meshes = [item.world_mesh for item in items]
        self._signs = [
            -1.0 if bool((signed_distance(mesh, box) < 0).all()) else 1.0 for mesh in self._meshes
        ]
        self._clear = clear

    def contains(self, places: Float64[Tensor, "place 3"]) -> Bool[Tensor, " place"]:
        """Return for each place whether it is free.

        Args:
            places: Places [m].
        """
        pairs = zip(self._signs, self._meshes, strict=True)
        return torch.stack([s * signed_distance(m, places) >= self._clear for s, m in pairs]).all(0)

    def shorten_step(
        self, begin: Float64[Tensor, "3"], end: Float64[Tensor, "3"]
    ) -> Float64[Tensor, "3"]:
        """Return the end of a step; one that is not free loses the axes that lead there.

        Args:
            begin: A free place [m].
            end: The place to go to [m].
        """
        kept = torch.cartesian_prod(*[torch.tensor([1.0, 0.0], dtype=begin.dtype)] * 3)
        steps = kept * (end - begin)
        steps = steps[self.contains(begin + steps)]
        return begin + steps[steps.norm(dim=1).argmax()] if len(steps) else begin


class TransmitterPosition(nn.Module):
    """Module Transmitters → Transmitters with the position of one transmitter as parameter.

    With a box, such as a room, the position stays inside the box: a step that leaves it is clamped
    to its border. With ``clear`` it also keeps a distance from the surfaces of a scene: a step that
    comes nearer loses the axes that lead there, so the position slides along furniture.

    Args:
        initial: Initial position [3] [m].
        low: Corner of the box [3] [m]; None = no box.
        high: Opposite corner of the box [3] [m].
        axes: World axes along which the position is fitted; other coordinates are fixed.
        number: Index of the transmitter.
        clear: Least distance to all surfaces, outside of solid objects [m]; needs the box. None =
            anywhere in the box.
        scene: Scene whose surfaces are meant.

    Attributes:
        place: Parameter [3], position [m].

    Raises:
        InputError: A wrong shape, an unknown axis, only one corner, ``clear`` without a box or a
            scene, or an initial position outside the box or too near to a surface.
    """

    def __init__(
        self,
        initial: ArrayLike,
        low: ArrayLike | None = None,
        high: ArrayLike | None = None,
        axes: Axes = "xyz",
        number: int = 0,
        clear: NonNegative | None = None,
        scene: Scene | None = None,
    ) -> None:
        super().__init__()
        what, do = "initial place of a transmitter [m]", "give x, y, z"
        begun = checked_tensor(initial, (3,), what, do).detach().clone()
        self._axes, self._number = axes_mask(axes), number
        if (low is None) != (high is None):
            raise InputError("expected both corners of the box, got one; give low and high")
        self._box = None
        if low is not None and high is not None:
            named = (("low", low), ("high", high))
            ends = [
                checked_tensor(at, (3,), f"{name} corner of the box [m]", do) for name, at in named
            ]
            self._box = torch.stack(ends)
            if not bool(((begun > self._box[0]) & (begun < self._box[1])).all()):
                raise InputError(
                    "expected an initial place inside the box, got one outside or on its border; "
                    "choose another start or a larger box"
                )
        self._free = None
        if clear is not None:
            if scene is None or low is None or high is None:
                raise InputError("expected a scene, low and high with clear, got less; give all")
            self._free = FreeSpace(scene, low, high, clear)
            if not bool(self._free.contains(begun[None])):
                raise InputError(
                    f"expected an initial place at least {clear:g} m off all surfaces, got one "
                    "that is nearer or inside of an object; choose another start or lower clear"
                )
            # A buffer: a checkpoint keeps where the last step was free.
            self.free_position: Tensor
            self.register_buffer("free_position", begun.clone())
        self.raw_position = nn.Parameter(begun)

    @property
    def position(self) -> Float64[Tensor, "3"]:
        """Position of the transmitter [m]."""
        if self._box is not None:
            with torch.no_grad():
                self.raw_position.data.clamp_(*self._box)
                if self._free is not None:
                    found = self._free.shorten_step(self.free_position, self.raw_position.data)
                    self.raw_position.data.copy_(found)
                    self.free_position.copy_(found)
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


class ReverberationParameters(nn.Module):
    """Module Transmitters → Transmitters with gain and decay of a reverberant tail as parameters.

    Args:
        gain_db: Initial path gain of the tail at distance 0 [dB].
        decay: Initial time constant [s].

    Attributes:
        log_gain: Parameter, natural logarithm of the gain.
        log_decay: Parameter, natural logarithm of the time constant in seconds.

    Raises:
        InputError: A decay that is not positive.
    """

    def __init__(self, gain_db: float = -60.0, decay: float = 20e-9) -> None:
        super().__init__()
        tail = Reverberation(gain_db, decay)
        self.log_gain = nn.Parameter(NEPERS_PER_DB * torch.as_tensor(tail.gain_db))
        self.log_decay = nn.Parameter(torch.as_tensor(tail.decay).log())

    @property
    def reverberation(self) -> Reverberation:
        """Reverberant tail."""
        return Reverberation(self.log_gain / NEPERS_PER_DB, self.log_decay.exp())

    def forward(self, sensor: Transmitters) -> Transmitters:
        """Return the transmitters with the tail."""
        return replace(sensor, reverberation=self.reverberation)

    def values(self) -> dict[str, Tensor]:
        """Gain [dB] and decay [s] by name, for progress and reports."""
        values = (torch.as_tensor(value).detach() for value in vars(self.reverberation).values())
        return dict(zip(("reverberation.gain", "reverberation.decay"), values, strict=True))

    def coordinates(self) -> list[Coordinate]:
        """Gain [dB] and decay [s]."""
        decay, rate = self.log_decay.detach().exp(), torch.tensor(NEPERS_PER_DB)
        level = Coordinate("reverberation.gain", "dB", {"log_gain": rate}, 3.0)
        late = Coordinate("reverberation.decay", "s", {"log_decay": 1 / decay}, 0.3 * float(decay))
        return [level, late]
