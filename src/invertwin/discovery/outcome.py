"""Results of automatic reconstruction: objects with uncertainties, and unobserved regions."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from jaxtyping import Float, Float64, Int64
from torch import Tensor

from invertwin.capture import ChannelCalibration
from invertwin.channel import Grid
from invertwin.discovery.shapes.primitives import ShapeParameters
from invertwin.discovery.shapes.prisms import make_shape_model
from invertwin.scene import Object, Scene


@dataclass(frozen=True, eq=False)
class ObjectTrack:
    """Positions of a moving object, frame by frame.

    Attributes:
        times: times after the start of the recording [s].
        positions: positions in world axes [time, 3] [m].
        velocities: velocities along the ground [m/s].
        deviations: standard deviation of every number at every time, by name, in SI units.
    """

    times: Float64[Tensor, " time"]
    positions: Float64[Tensor, "time 3"]
    velocities: Float64[Tensor, "time 3"]
    deviations: Mapping[str, Float64[Tensor, " time"]]

    def to_metrics(self) -> dict[str, Any]:
        """Return the track as plain numbers."""
        return {
            "times_s": self.times.tolist(),
            "positions_m": self.positions.tolist(),
            "velocities_m_s": self.velocities.tolist(),
            "deviations": {name: values.tolist() for name, values in self.deviations.items()},
        }


@dataclass(frozen=True, eq=False)
class DetectedObject:
    """Object of a twin.

    Attributes:
        name: name in the twin's scene.
        kind: kind of its shape, among ``discovery.KINDS``.
        probabilities: probability of every tested kind.
        position: centre [m].
        shape: all shape parameters; None = only the position is known.
        deviations: standard deviation of every number, by name, in SI units. For a moving target
            without a track: ``range``, ``across`` the line of sight, and ``range_rate``.
        existence_probability: probability that the object exists.
        velocity: velocity along the line of sight, or along the ground with a track [m/s]; None =
            static.
        track: previous positions; None = not tracked.
    """

    name: str
    kind: str
    probabilities: Mapping[str, float]
    position: Float64[Tensor, "3"]
    shape: ShapeParameters | None
    deviations: Mapping[str, float]
    existence_probability: float
    velocity: Float64[Tensor, "3"] | None = None
    track: ObjectTrack | None = None

    @classmethod
    def point(
        cls, name: str, position: Tensor, deviations: Mapping[str, float], sure: float, *motion: Any
    ) -> "DetectedObject":
        """Create an object without a shape.

        Args:
            name: name of the object.
            position: position [m].
            deviations: standard deviations of its coordinates.
            sure: existence probability.
            motion: velocity [m/s] and track of the object.
        """
        return cls(name, "point", {"point": 1.0}, position, None, deviations, sure, *motion)

    def to_metrics(self) -> dict[str, Any]:
        """Return the object as plain numbers."""
        found: dict[str, Any] = {
            "name": self.name,
            "kind": self.kind,
            "probabilities": dict(self.probabilities),
            "position_m": self.position.tolist(),
            "confidence": self.existence_probability,
            "deviations": dict(self.deviations),
        }
        if self.shape is not None:
            sides = ("length", "width", "height")
            found |= {f"{side}_m": getattr(self.shape, side) for side in sides}
            found |= {"yaw_rad": self.shape.yaw, "brightness": self.shape.brightness}
        if self.velocity is not None:
            found["velocity_m_s"] = self.velocity.tolist()
        if self.track is not None:
            found["track"] = self.track.to_metrics()
        return found


@dataclass(frozen=True, eq=False)
class GroundImage:
    """Image of the ground.

    Attributes:
        positions: x and y of every point [m].
        strength: radar cross-section at every position, or brightness of a backprojected image.
        view_counts: number of radar positions that see each position; zero = unobserved.
    """

    positions: Float64[Tensor, "point 2"]
    strength: Float64[Tensor, " point"]
    view_counts: Int64[Tensor, " point"]


@dataclass(frozen=True, eq=False)
class Twin:
    """Digital twin of a recording.

    Attributes:
        objects: objects in order of existence probability; moving ones last.
        level: height of the ground [m].
        image: image of the echoes and of unobserved regions.
        predicted: predicted maps of the objects with the background; None if only positions were
            found.
        observed: maps of the recording.
        grid: bins of the maps.
        notes: remarks on the search.
        calibration: channel calibration estimated from the scene itself, applied to the maps.
        stopped: whether Ctrl-C ended the search: the likeliest objects so far, without error bars.
    """

    objects: tuple[DetectedObject, ...]
    level: float
    image: GroundImage | None = None
    predicted: Float[Tensor, "frame range u v"] | None = None
    observed: Float[Tensor, "frame range u v"] | None = field(default=None, repr=False)
    grid: Grid | None = None
    notes: tuple[str, ...] = ()
    calibration: ChannelCalibration | None = None
    stopped: bool = False

    @property
    def scene(self) -> Scene | None:
        """Scene of the objects with a shape, with the nearest library materials; None if there are
        none.
        """
        objects: dict[str, Object] = {}
        for thing in self.objects:
            if thing.shape is not None:
                item = make_shape_model(thing.name, thing.shape, self.level).item
                objects[thing.name] = Object(item.world_mesh, thing.shape.material)
        return Scene(objects) if objects else None
