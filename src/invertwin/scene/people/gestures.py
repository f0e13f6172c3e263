"""Gestures: people who sit down, stand up and wave.

Sources: A. Kralj, R. J. Jaeger, M. Munih, "Analysis of standing up and sitting down in humans:
definitions and normative data presentation", J. Biomechanics 23, 1990, 1123–1138, for the sequence:
the trunk leans until the seat carries the person, and is upright at the end. T. Flash, N. Hogan,
"The coordination of arm movements", J. Neuroscience 5, 1985, 1688–1703: people move from rest to
rest with minimum jerk, along 10 u³ − 15 u⁴ + 6 u⁵. N. Hogan, D. Sternad, "On rhythmic and discrete
movements", Exp. Brain Research 181, 2007, 13–30: rhythmic motion is a sine.
Differs from the source: angles between start and end follow these curves, not measured ones. Bodies
have no ankles: shanks stay upright, and feet stay where they are.
"""

import math
from dataclasses import dataclass

import torch
from scipy.spatial.transform import Rotation

from invertwin.checks import check_choice, checked_number
from invertwin.errors import InputError
from invertwin.limits import Positive
from invertwin.scene.people import gait
from invertwin.scene.people.body import BodyTemplate

_LEAN = math.radians(40.0)  # lean of the trunk at seat contact
_SEAT_CONTACT_SHARE = 0.6  # fraction of the duration at seat contact
_LAP = (math.radians(25.0), math.radians(60.0))  # shoulders and elbows with hands above the lap
_THIGH = 0.088 / 0.42  # radius of a thigh over its length
_MAX_THIGH_ANGLE = math.radians(105.0)  # maximum thigh angle, which limits the seat height
_RAISE_DURATION = 0.8  # duration of raising or lowering an arm [s]
_WAVE = math.radians(30.0)  # swing of the forearm to either side


@dataclass(frozen=True, eq=False)
class Sitting(gait.PersonMotion):
    """Person who sits down, or stands up: the reverse motion.

    Feet are fixed; the seat is behind the person, who faces −x of the object's frame. The object's
    pose is that of the pelvis of a standing person, see ``standing_height``. ``MovingScene``
    applies the motion.

    Attributes:
        body: body template with the joints of ``person``.
        seat: height of the seat above the floor [m].
        start: start time [s].
        duration: duration [s].
        rising: whether to stand up instead.

    Raises:
        InputError: A body without these joints, a seat that is as high as the person's legs or too
            low to sit on, or a time out of range.
    """

    body: BodyTemplate
    seat: Positive = 0.45
    start: float = 0.0
    duration: Positive = 2.0
    rising: bool = False

    def __post_init__(self) -> None:
        gait.check_joints(self.body)
        checked_number(self.start, "start [s]", -math.inf)
        checked_number(self.duration, "duration [s]", 0.0, open_low=True)
        knee, thigh = self._leg()
        low = knee + thigh * (math.cos(_MAX_THIGH_ANGLE) - _THIGH)
        checked_number(self.seat, "height of the seat [m]", low, knee + thigh * (1 - _THIGH))

    def posture(self, time: float) -> gait.Posture:
        """Return joint rotations in the frames of their parents, and the shift of the pelvis [m].

        Args:
            time: time [s].
        """
        share = (time - self.start) / self.duration
        u = 1 - share if self.rising else share
        knee, thigh = self._leg()
        lowered = _minimum_jerk(u / _SEAT_CONTACT_SHARE)
        bent = math.acos((self.seat - knee) / thigh + _THIGH) * lowered
        upright = _minimum_jerk((u - _SEAT_CONTACT_SHARE) / (1 - _SEAT_CONTACT_SHARE))
        lean = _LEAN * (lowered - upright)
        shoulder, elbow = (angle * _minimum_jerk(u) for angle in _LAP)
        pelvis = gait.rotation_about_axis("y", -lean / 2)
        raised = gait.rotation_about_axis("y", lean + shoulder)
        turns = {"pelvis": pelvis, "chest": pelvis}
        for side in ("left", "right"):
            turns |= {
                f"{side}_hip": pelvis.T @ gait.rotation_about_axis("y", bent),
                f"{side}_knee": gait.rotation_about_axis("y", -bent),
                f"{side}_shoulder": raised @ gait.hanging_arm_rotation(side),
                f"{side}_elbow": gait.elbow_rotation(side, elbow),
            }
        hip = self.body.joints[self.body.joint("left_hip")] * torch.tensor([1.0, 0.0, 1.0])
        away = [thigh * math.sin(bent), 0.0, thigh * (math.cos(bent) - 1)]
        shift = hip - pelvis @ hip + torch.tensor(away, dtype=torch.float64)
        return gait.joint_rotations(self.body, turns), shift

    def _leg(self) -> tuple[float, float]:
        """Return the height of the knee above the sole, and the length of the thigh [m]."""
        hip, knee = (self.body.joints[self.body.joint(f"left_{name}")] for name in ("hip", "knee"))
        return float(knee[2]) + gait.standing_height(self.body), float((hip - knee).norm())


@dataclass(frozen=True, eq=False)
class Waving(gait.PersonMotion):
    """Person who raises an arm, waves, and lowers it again.

    ``MovingScene`` applies it; the object's pose is that of a standing person.

    Attributes:
        body: body template with the joints of ``person``.
        side: side of the arm, left or right.
        rate: frequency of the forearm [Hz].
        start: time at which the arm begins to rise [s].
        duration: duration until it hangs again [s], including 0.8 s each to raise and to lower it.
        during: simultaneous motion of the rest of the body; None = standing.

    Raises:
        InputError: A body without these joints or another body than that of ``during``, an unknown
            side, or a time out of range.
    """

    body: BodyTemplate
    side: str = "right"
    rate: Positive = 1.5
    start: float = 0.0
    duration: float = 4.0
    during: gait.Walking | Sitting | None = None

    def __post_init__(self) -> None:
        gait.check_joints(self.body)
        check_choice(self.side, ("left", "right"), "the side")
        checked_number(self.rate, "rate [1/s]", 0.0, open_low=True)
        checked_number(self.start, "start [s]", -math.inf)
        checked_number(self.duration, "duration [s]", 2 * _RAISE_DURATION)
        if self.during is not None and self.during.body is not self.body:
            raise InputError(
                "expected one body for waving and for what it does meanwhile, got two; give the "
                "same one to both"
            )

    def posture(self, time: float) -> gait.Posture:
        """Return joint rotations in the frames of their parents, and the shift of the pelvis [m].

        Args:
            time: time [s].
        """
        hanging = {
            f"{side}_shoulder": gait.hanging_arm_rotation(side) for side in ("left", "right")
        }
        found = gait.joint_rotations(self.body, hanging)
        shift = torch.zeros(3, dtype=torch.float64)
        if self.during is not None:
            found, shift = self.during.posture(time)
        since = time - self.start
        down = _minimum_jerk(1 - (self.duration - since) / _RAISE_DURATION)
        up = _minimum_jerk(since / _RAISE_DURATION) - down
        swing = _WAVE * math.sin(2 * math.pi * self.rate * since)
        sign = 1.0 if self.side == "right" else -1.0
        # Held out to the side, forearm upwards: the arm of the rest pose with a bent elbow.
        angles = {"shoulder": 0.0, "elbow": sign * (math.pi / 2 + swing)}
        for name, angle in angles.items():
            turn = gait.rotation_about_axis("x", angle)
            row = self.body.joint(f"{self.side}_{name}")
            way = Rotation.from_matrix((found[row].T @ turn).numpy()).as_rotvec()
            found[row] @= torch.from_numpy(Rotation.from_rotvec(up * way).as_matrix())
        return found, shift


def _minimum_jerk(share: float) -> float:
    """Minimum-jerk curve from 0 to 1 for fractions of the time from 0 to 1."""
    u = min(max(share, 0.0), 1.0)
    return u**3 * (10 - 15 * u + 6 * u**2)
