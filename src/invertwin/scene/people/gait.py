"""Walking people: joint angles as functions of the walking speed, from a published gait model.

Source: R. Boulic, N. Magnenat-Thalmann, D. Thalmann, "A global human walking model with real-time
kinematic personification", The Visual Computer 6, 1990, 344–358, as V. C. Chen's "The Micro-Doppler
Effect in Radar" (2011) uses it for radar. All curves depend on the relative speed v, in leg lengths
per second, and the phase of the cycle, which begins as the right foot lands.
Differs from the source: curves through its control points are monotone cubics of which the first
seven harmonics are kept. Beyond these gait has 0.3 % of its power (D. A. Winter, H. G. Sidwall, D.
A. Hobson, "Measurement and reduction of noise in kinematics of locomotion", J. Biomechanics 7,
1974, 157–159), and with them accelerations are continuous. The forward and sideways shifts of fast
walks continue those of slow ones, positive at v = 0.5; transcriptions of the source have a minus
there, which would be discontinuous. Bodies have no ankles, so feet do not rotate.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.checks import checked_number, checked_type
from invertwin.errors import InputError
from invertwin.limits import Positive
from invertwin.scene.mesh import Mesh
from invertwin.scene.people.body import BodyTemplate
from invertwin.scene.pose import compose, rigid, rotation_from_vector
from invertwin.scene.scene import Object

_HARMONICS = 7
_SAMPLES = 512  # samples of a cycle for its harmonics
_MAX_RELATIVE_SPEED = 3.0  # maximum relative speed
_HANGING = math.radians(80.0)  # shoulder angle from the rest pose, in which arms are held out
# Leg length of ``person`` of 1.75 m [m]; the source states shifts for adults in metres.
_ADULT_LEG = 0.84
JOINTS = (
    *("pelvis", "chest", "left_shoulder", "left_elbow", "right_shoulder", "right_elbow"),
    *("left_hip", "left_knee", "right_hip", "right_knee"),
)
Posture = tuple[Float64[Tensor, "j 3 3"], Float64[Tensor, "3"]]
"""Rotation of every joint in the frame of its parent, and the shift of the pelvis [m]."""


class PersonMotion:
    """Motion of a person, which is its posture over time."""

    body: BodyTemplate

    def posture(self, time: float) -> Posture:
        """Return joint rotations in the frames of their parents, and the shift of the pelvis [m].

        Args:
            time: time [s].
        """
        raise NotImplementedError

    def __call__(self, item: Object, time: float) -> Object:
        """Return the object at a time [s], with the posed skin, moved in its own frame.

        Args:
            item: object at the position of the person at time 0.
            time: time [s].
        """
        rotations, shift = self.posture(time)
        mesh = Mesh(self.body.apply_pose(rotations)[0], self.body.faces)
        return replace(item, mesh=mesh, pose=compose(rigid(translation=shift), item.transform))


@dataclass(frozen=True, eq=False)
class Walking(PersonMotion):
    """Person who walks straight ahead along −x of the object's frame, or on the spot.

    The object's pose is that of the pelvis of a standing person, see ``standing_height``.
    ``MovingScene`` applies the motion.

    Attributes:
        body: body template with the joints of ``person``.
        speed: mean speed [m/s]; 1.4 is usual.
        phase: phase of the cycle at time 0, in cycles; 0: the right foot lands.
        on_spot: whether to stay in place, for example on a ``TrajectoryMotion`` of that speed.

    Raises:
        InputError: A body without these joints, or a speed of more than three leg lengths per
            second.
    """

    body: BodyTemplate
    speed: Positive = 1.4
    phase: float = 0.0
    on_spot: bool = False

    def __post_init__(self) -> None:
        check_joints(self.body)
        checked_number(self.phase, "phase [cycles]", -math.inf)
        fastest = _MAX_RELATIVE_SPEED * leg_length(self.body)
        checked_number(self.speed, "walking speed [m/s]", 0.0, fastest, open_low=True)

    @property
    def relative_speed(self) -> float:
        """Speed in leg lengths per second."""
        return self.speed / leg_length(self.body)

    @property
    def period(self) -> float:
        """Period of a cycle, two steps [s]: 1.346 / √v."""
        return 1.346 / math.sqrt(self.relative_speed)

    def rotations(self, phase: float) -> Float64[Tensor, "j 3 3"]:
        """Return the rotation of every joint in the frame of its parent.

        Args:
            phase: phase in cycles.
        """
        v, curves = self.relative_speed, _curves(self.relative_speed)
        cycle = math.cos(2 * math.pi * phase)
        yaw, roll = math.radians(4.0 * v) * cycle, -_evaluate_series(curves["tilt"], phase)
        pelvis = rotation_about_axis("z", yaw) @ rotation_about_axis("x", roll)
        lean = math.radians(_swing(v, 8.0)) * (math.sin(2 * math.pi * (2 * phase - 0.1)) - 1)
        twist = rotation_about_axis("z", -_evaluate_series(curves["thorax"], phase))
        turns = {"pelvis": pelvis, "chest": pelvis.T @ (twist @ rotation_about_axis("y", lean))}
        for side, later in (("right", 0.0), ("left", 0.5)):
            own = phase + later
            swing = 9.88 * v
            arm = math.radians(3.0 - swing / 2 - swing * math.cos(2 * math.pi * own))
            turns |= {
                f"{side}_hip": rotation_about_axis("y", _evaluate_series(curves["hip"], own)),
                f"{side}_knee": rotation_about_axis("y", -_evaluate_series(curves["knee"], own)),
                f"{side}_shoulder": rotation_about_axis("y", arm) @ hanging_arm_rotation(side),
                f"{side}_elbow": elbow_rotation(side, _evaluate_series(curves["elbow"], own)),
            }
        return joint_rotations(self.body, turns)

    def pelvis_offset(self, phase: float) -> Float64[Tensor, "3"]:
        """Return the offset of the pelvis from uniform motion, x, y and z [m].

        Args:
            phase: phase in cycles.
        """
        v, scale = self.relative_speed, leg_length(self.body) / _ADULT_LEG
        support = 0.752 - 0.143 / self.period
        turn = 2 * math.pi
        side = _swing(v, 0.128) * math.sin(turn * (phase - 0.1))
        rise = 0.015 * v * (math.sin(turn * (2 * phase - 0.35)) - 1)
        ahead = _swing(v, 0.084) * math.sin(turn * 2 * (phase + 0.625 - support))
        return scale * torch.tensor([-ahead, side, rise], dtype=torch.float64)

    def posture(self, time: float) -> Posture:
        """Return joint rotations in the frames of their parents, and the shift of the pelvis [m].

        Args:
            time: time [s].
        """
        phase = self.phase + time / self.period
        way = 0.0 if self.on_spot else self.speed * time
        shift = self.pelvis_offset(phase) + torch.tensor([-way, 0.0, 0.0], dtype=torch.float64)
        return self.rotations(phase), shift


def standing_height(body: BodyTemplate) -> float:
    """Return the height of a body's origin above the soles of its rest pose [m]."""
    return -float(body.vertices[:, 2].min())


def leg_length(body: BodyTemplate) -> float:
    """Return the leg length [m]: twice the thigh, since the shank is as long within 1 %."""
    hip, knee = (body.joints[body.joint(f"right_{name}")] for name in ("hip", "knee"))
    return 2 * float((knee - hip).norm())


def check_joints(body: BodyTemplate) -> None:
    """Raise unless a body has the joints of ``person``.

    Raises:
        InputError: Other joints, or unnamed ones.
    """
    checked_type(body, BodyTemplate, "a body", "make one with person()")
    missing = [name for name in JOINTS if name not in body.names]
    if missing:
        raise InputError(
            f"expected a body with the joints of person(), got none named {', '.join(missing)}; "
            "name the joints so"
        )


def joint_rotations(
    body: BodyTemplate, turns: Mapping[str, Float64[Tensor, "3 3"]]
) -> Float64[Tensor, "j 3 3"]:
    """Return the rotations of all joints in the frames of their parents.

    Args:
        body: body template.
        turns: rotations by the joint's name; the others have none.
    """
    found = torch.eye(3, dtype=torch.float64).repeat(len(body.parents), 1, 1)
    for name, turn in turns.items():
        found[body.joint(name)] = turn
    return found


def rotation_about_axis(axis: str, angle: float) -> Float64[Tensor, "3 3"]:
    """Return the rotation about a coordinate axis.

    Args:
        axis: axis x, y or z.
        angle: rotation angle [rad].
    """
    return rotation_from_vector(torch.tensor([angle * (axis == name) for name in "xyz"]).double())


def hanging_arm_rotation(side: str) -> Float64[Tensor, "3 3"]:
    """Return the shoulder rotation of a hanging arm.

    Args:
        side: side, left or right.
    """
    return rotation_about_axis("x", _HANGING if side == "left" else -_HANGING)


def elbow_rotation(side: str, angle: float) -> Float64[Tensor, "3 3"]:
    """Return the rotation of an elbow.

    Args:
        side: side, left or right.
        angle: flexion [rad].
    """
    return rotation_about_axis("z", -angle if side == "left" else angle)


def _swing(v: float, slope: float) -> float:
    """Evaluate the parabola of slow walks, constant above half a leg length per second."""
    slow = min(v, 0.5)
    return slope * slow * (1 - slow)


def _evaluate_series(harmonics: np.ndarray, phase: float) -> float:
    """Evaluate a Fourier series [rad]."""
    turns = np.exp(2j * math.pi * phase * np.arange(len(harmonics)))
    return float(np.real(harmonics * turns).sum())


@lru_cache(maxsize=32)
def _curves(v: float) -> dict[str, np.ndarray]:
    """Return the harmonics of the angles by name [rad]."""
    slow, brisk = min(v, 0.5), min(max(v - 0.5, 0.0) / 0.8, 1.0)
    fast = max(v - 1.3, 0.0) / 1.7
    hip = [(0.9, 50 * slow + 6 * fast), (0.5, -30 * slow)]
    if fast > 0:
        hip.append((0.9 + 0.2 * fast, 50 * slow + 5 * fast))
    knee = [(0.17 - 0.05 * fast, 3 + 22 * fast), (0.4, 3.0)]
    knee += [(0.75 - 0.05 * fast, 140 * slow - 5 * fast), (1 - 0.03 * fast, 3 + 3 * fast)]
    elbow = [
        (0.05, 3 + 6 * slow + 8 * brisk - 6 * fast),
        (0.5 + 0.01 * brisk + 0.04 * fast, 3 + 34 * slow + 24 * brisk + 26 * fast),
        (0.9 - 0.1 * fast, 3 + 10 * slow + 9 * brisk - 6 * fast),
    ]
    thorax = [(0.1, 4 / 3 * v), (0.4, -1.5 * v), (0.6, -4 / 3 * v), (0.9, 1.5 * v)]
    points = {"hip": hip, "knee": knee, "elbow": elbow, "thorax": thorax}
    found = {name: _harmonics(_interpolate_cycle(own)) for name, own in points.items()}
    return found | {"tilt": _harmonics(lambda phase: 1.66 * v * _tilt(phase))}


def _interpolate_cycle(points: list[tuple[float, float]]) -> Callable[[np.ndarray], np.ndarray]:
    """Interpolate control points of a cycle periodically by monotone cubics [deg]."""
    from scipy.interpolate import PchipInterpolator  # slow to import, rarely used

    phases, values = np.array(sorted((phase % 1.0, value) for phase, value in points)).T
    more = np.concatenate([phases + turn for turn in (-1, 0, 1)])
    return PchipInterpolator(more, np.tile(values, 3))


def _tilt(phase: np.ndarray) -> np.ndarray:
    """Return the drop of the pelvis towards the swinging leg, of amplitude 1."""
    half = phase % 0.5
    fall = np.where(half < 0.15, np.cos(2 * np.pi * half / 0.3), 0.0)
    rise = np.where(half >= 0.15, -np.cos(2 * np.pi * (half - 0.15) / 0.7), 0.0)
    return np.where(phase < 0.5, 1.0, -1.0) * (fall + rise - 1)


def _harmonics(curve: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Return the first harmonics of a curve in degrees [rad]."""
    values = np.radians(curve(np.arange(_SAMPLES) / _SAMPLES))
    found = np.fft.rfft(values)[: _HARMONICS + 1] / _SAMPLES
    found[1:] *= 2
    return found
