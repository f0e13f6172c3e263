"""Moving scenes: rotation, trajectories and walking as functions of time."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin import checks
from invertwin.errors import InputError
from invertwin.scene.pose import compose, rigid, rotation_from_vector
from invertwin.scene.scene import Object, Scene

ObjectMotion = Callable[[Object, float], Object]
"""Function of the object in the scene and a time [s] that returns the moved object."""

_MIN_HEADING_SPEED = 1e-6  # minimum horizontal speed that defines a heading [m/s]


@dataclass(frozen=True, eq=False)
class MovingScene:
    """Scene with moving objects, a callable of time [s].

    ``simulate_chirps`` accepts it. Triangles are equal at all times.

    Attributes:
        scene: scene with every object at the start of its motion.
        motions: one motion or several by object name, applied from first to last.

    Raises:
        InputError: A name that the scene does not have, or an object that has a velocity, too.
    """

    scene: Scene
    motions: Mapping[str, ObjectMotion | Sequence[ObjectMotion]]

    def __post_init__(self) -> None:
        do = "build one with Scene({name: Object(...)})"
        checks.checked_type(self.scene, Scene, "a scene", do)
        for name in self.motions:
            if self.scene[name].velocity is not None:
                raise InputError(
                    f"expected no velocity of {name!r} beside its motion, got one; "
                    "scene.replace(name, velocity=None) removes it"
                )

    def __call__(self, time: float) -> Scene:
        """Return the scene at a time [s].

        Raises:
            InputError: A time outside a motion.
        """
        scene = self.scene.advance(time)
        for name, given in self.motions.items():
            steps = (given,) if callable(given) else tuple(given)
            moved = reduce(lambda item, mover: mover(item, time), steps, scene[name])
            scene = Scene({**scene.objects, name: moved})
        return scene


@dataclass(frozen=True, eq=False)
class AxisRotation:
    """Object that rotates about an axis: a wheel, a fan, the crank of a pedal.

    Attributes:
        axis: direction of the axis in the object's own frame; rotation is right-handed.
        rate: angular velocity [rad/s].
        center: point on the axis in that frame [m]; None = centre of the mesh.

    Raises:
        InputError: An axis without a direction, or numbers that are not finite.
    """

    axis: checks.Point
    rate: float
    center: checks.Point | None = None

    def __post_init__(self) -> None:
        axis = checks.checked_point(self.axis, "axis")
        if float(axis.norm()) == 0:
            raise InputError("expected an axis with a direction, got zeros; give x, y, z")
        checks.set_fields(self, axis=axis / axis.norm())
        checks.checked_number(self.rate, "rate [rad/s]", -math.inf)
        if self.center is not None:
            checks.set_fields(self, center=checks.checked_point(self.center, "center [m]"))

    def __call__(self, item: Object, time: float) -> Object:
        """Return the object rotated for a time [s].

        Args:
            item: object at time 0.
            time: time [s].
        """
        turn = rotation_from_vector(torch.as_tensor(self.axis) * (self.rate * time))
        center = item.mesh.center if self.center is None else torch.as_tensor(self.center)
        return replace(item, pose=compose(rigid(turn, center - turn @ center), item.transform))


@dataclass(frozen=True, eq=False)
class SplineTrajectory:
    """Trajectory through positions at given times: a cubic with continuous accelerations.

    Its ends have no acceleration (natural spline).

    Attributes:
        times: ascending times of the positions [s].
        positions: positions [time, 3] in the world [m].

    Raises:
        InputError: Fewer than two times, times that do not ascend, or another number of positions.
    """

    times: checks.ArrayLike
    positions: checks.ArrayLike

    def __post_init__(self) -> None:
        times = checks.checked_ascending(self.times, "times [s]", "sort the places by time")
        shape, do = (len(times), 3), "give x, y, z for each time"
        places = checks.checked_tensor(self.positions, shape, "places [m]", do)
        from scipy.interpolate import CubicSpline  # slow to import

        curve = CubicSpline(times.detach().numpy(), places.detach().numpy(), bc_type="natural")
        checks.set_fields(self, times=times.detach(), positions=places.detach(), _curve=curve)

    def position(self, time: float) -> Float64[Tensor, "3"]:
        """Return the position at a time [m].

        Args:
            time: time [s].

        Raises:
            InputError: A time before the first position or after the last.
        """
        return self._value(time, 0)

    def velocity(self, time: float) -> Float64[Tensor, "3"]:
        """Return the derivative of the position with respect to time [m/s].

        Args:
            time: time [s].

        Raises:
            InputError: A time before the first position or after the last.
        """
        return self._value(time, 1)

    def _value(self, time: float, order: int) -> Tensor:
        times = torch.as_tensor(self.times)
        if not float(times[0]) <= time <= float(times[-1]):
            raise InputError(
                f"expected a time in [{float(times[0]):g}, {float(times[-1]):g}] s, got {time:g}; "
                "give places for longer than the frame"
            )
        return torch.from_numpy(vars(self)["_curve"](time, order))


@dataclass(frozen=True, eq=False)
class TrajectoryMotion:
    """Object carried along a trajectory; its pose is relative to the trajectory's position.

    Attributes:
        trajectory: trajectory of the object.
        heading: whether to rotate the object about the vertical, so that its front, −x, faces the
            direction of motion.
    """

    trajectory: SplineTrajectory
    heading: bool = False

    def __call__(self, item: Object, time: float) -> Object:
        """Return the object at a position of the trajectory.

        Args:
            item: object with its pose relative to that position.
            time: time [s].

        Raises:
            InputError: A time outside the trajectory; a heading without horizontal motion.
        """
        turn = None
        if self.heading:
            ahead = self.trajectory.velocity(time)
            if math.hypot(float(ahead[0]), float(ahead[1])) < _MIN_HEADING_SPEED:
                raise InputError(
                    f"expected a level velocity for a heading, got {ahead.tolist()} m/s at "
                    f"{time:g} s; move its places, or leave out heading"
                )
            # −x rotated about z by θ is (−cos θ, −sin θ, 0).
            angle = torch.atan2(-ahead[1], -ahead[0])
            turn = rotation_from_vector(torch.stack([0 * angle, 0 * angle, angle]))
        motion = rigid(turn, self.trajectory.position(time))
        return replace(item, pose=compose(item.transform, motion))
