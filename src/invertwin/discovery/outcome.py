"""What was found in a recording: things with their errors, and what nothing is known of."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from jaxtyping import Float, Float64, Int64
from torch import Tensor

from invertwin.capture import ChannelCalibration
from invertwin.channel import Grid
from invertwin.discovery.shapes.primitives import ShapeParameters
from invertwin.discovery.shapes.prisms import make_shape_model
from invertwin.inversion.initialisation.detections import Ground
from invertwin.scene import Object, Scene


@dataclass(frozen=True, eq=False)
class ObjectTrack:
    """Where a thing was, frame by frame.

    Attributes:
        times: After the start of the recording [s].
        positions: [m].
        velocities: Along the ground [m/s].
        deviations: Standard deviation of every number at every time, by name, in SI units.
    """

    times: Float64[Tensor, " time"]
    positions: Float64[Tensor, "time 3"]
    velocities: Float64[Tensor, "time 3"]
    deviations: Mapping[str, Float64[Tensor, " time"]]

    def to_metrics(self) -> dict[str, Any]:
        """The track as plain numbers."""
        return {
            "times_s": self.times.tolist(),
            "positions_m": self.positions.tolist(),
            "velocities_m_s": self.velocities.tolist(),
            "deviations": {name: values.tolist() for name, values in self.deviations.items()},
        }


@dataclass(frozen=True, eq=False)
class DetectedObject:
    """One object of a twin.

    Attributes:
        name: In the twin's scene.
        kind: That of its figure, among ``discovery.KINDS``.
        probabilities: Of every kind that was tried.
        position: Its middle [m].
        shape: All numbers of its shape; None = only a place is known.
        deviations: Standard deviation of every number, by name, in SI units. Of a mover that was
            not followed: ``range``, ``across`` the sight, and ``range_rate``.
        existence_probability: Probability that it is there.
        velocity: Along the line of sight, or along the ground if there is a track [m/s]; None =
            it was found in what stands still.
        track: Where it was before; None = it was not followed.
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

    def to_metrics(self) -> dict[str, Any]:
        """The thing as plain numbers."""
        found: dict[str, Any] = {
            "name": self.name,
            "kind": self.kind,
            "probabilities": dict(self.probabilities),
            "position_m": self.position.tolist(),
            "confidence": self.existence_probability,
            "deviations": dict(self.deviations),
        }
        if self.shape is not None:
            found |= {
                "yaw_rad": self.shape.yaw,
                "length_m": self.shape.length,
                "width_m": self.shape.width,
                "height_m": self.shape.height,
                "brightness": self.shape.brightness,
            }
        if self.velocity is not None:
            found["velocity_m_s"] = self.velocity.tolist()
        if self.track is not None:
            found["track"] = self.track.to_metrics()
        return found


@dataclass(frozen=True, eq=False)
class GroundImage:
    """An image of the ground.

    Attributes:
        places: Along the two axes of the ground [m].
        strength: Radar cross-section at every place, or brightness of a backprojected image.
        view_counts: How many radar positions see each place; zero is "never seen".
    """

    places: Float64[Tensor, "place 2"]
    strength: Float64[Tensor, " place"]
    view_counts: Int64[Tensor, " place"]


@dataclass(frozen=True, eq=False)
class Twin:
    """What a recording shows.

    Attributes:
        objects: The surest first; things that move stand last.
        ground: The plane of the picture.
        level: Height of the ground [m].
        image: Where echoes come from, and what was never seen.
        predicted: Maps of the things with the background; None where only places were found.
        observed: Maps of the recording.
        grid: Their bins.
        notes: What to know of it, in sentences.
        calibration: Of the channels, where the scene itself has told it; the maps have it applied.
    """

    objects: tuple[DetectedObject, ...]
    ground: Ground
    level: float
    image: GroundImage | None = None
    predicted: Float[Tensor, "frame range u v"] | None = None
    observed: Float[Tensor, "frame range u v"] | None = field(default=None, repr=False)
    grid: Grid | None = None
    notes: tuple[str, ...] = ()
    calibration: ChannelCalibration | None = None

    @property
    def scene(self) -> Scene | None:
        """The things that have a shape, of the nearest materials of the library; None = none."""
        objects: dict[str, Object] = {}
        for thing in self.objects:
            if thing.shape is not None:
                item = make_shape_model(thing.name, thing.shape, self.ground, self.level).item
                mesh = type(item.mesh)(item.mesh.vertices.detach(), item.mesh.faces)
                objects[thing.name] = Object(mesh, thing.shape.material)
        return Scene(objects) if objects else None
