"""How a person walks: joint angles over the cycle of a gait, and the skin at any time.

Source: R. Boulic, N. Magnenat Thalmann, D. Thalmann, "A global human walking model with real-time
kinematic personification", The Visual Computer 6 (1990) 344–358: curves through control points
from biomechanical data; V. C. Chen, "The Micro-Doppler Effect in Radar", 2011, ch. 4.

Differs from the source: curves are the first 16 harmonics of those through the control points, so
that accelerations are continuous. The body has no ankles, and its pelvis does not lean.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from invertwin.errors import InputError
from invertwin.scene.checks import checked_number
from invertwin.scene.geometry.body import BodyTemplate
from invertwin.scene.geometry.person import person
from invertwin.scene.mesh import Mesh
from invertwin.scene.pose import rotation_from_vector

_HARMONICS = 16
_FASTEST = 3.0  # hip heights a second: beyond that people run
_HIPS = 0.895 / 1.75  # height of the hip joints above the sole, of a body 1 m tall
_SOLE = 0.955 / 1.75  # of the pelvis
Curve = NDArray[np.complex128]
"""Fourier coefficients of an angle [rad] or of a length over the cycle."""


@dataclass(frozen=True)
class Walk:
    """A person who walks straight on.

    At time 0 the person is above the origin, faces −z, and walks that way; y is up and the floor is
    y = 0. The right leg is in front then. Place and turn the object by its pose:
    ``lambda t: scene.replace("person", mesh=walk.mesh(t))`` is a motion for ``simulate_chirps``.

    Attributes:
        speed: [m/s].
        height: Of the person [m].
        spacing: Distance of neighbouring corners of the triangles [m].

    Raises:
        InputError: A speed beyond walking, or a size out of range.
    """

    speed: float = 1.4
    height: float = 1.75
    spacing: float = 0.03
    body: BodyTemplate = field(init=False, repr=False, compare=False)
    _curves: dict[str, Curve] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        checked_number(self.speed, "walking speed [m/s]", 0.0, open_low=True)
        object.__setattr__(self, "body", person(self.height, self.spacing))
        if self.relative_speed > _FASTEST:
            most = _FASTEST * _HIPS * self.height
            raise InputError(
                f"expected a walking speed up to {most:.1f} m/s for this height, got "
                f"{self.speed:g}; faster people run"
            )
        object.__setattr__(self, "_curves", _curves(self.relative_speed))

    @property
    def relative_speed(self) -> float:
        """Speed over the height of the hips [1/s], which decides on the gait."""
        return self.speed / (_HIPS * self.height)

    @property
    def cycle(self) -> float:
        """Duration of two steps [s]: 1.346/√(relative speed)."""
        return 1.346 / math.sqrt(self.relative_speed)

    def joints(self, time: float) -> dict[str, Tensor]:
        """Where the joints are [m], by name.

        Args:
            time: [s].
        """
        places = self._posed(time)[1] + self._root(time)
        return dict(zip(self.body.names, places, strict=True))

    def mesh(self, time: float) -> Mesh:
        """The skin; the same triangles at all times.

        Args:
            time: [s].
        """
        return Mesh(self._posed(time)[0] + self._root(time), self.body.faces)

    def _at(self, name: str, time: float, later: float = 0.0) -> float:
        """A curve at a time, some share of the cycle later."""
        coefficients = self._curves[name]
        turns = np.exp(2j * np.pi * (time / self.cycle + later) * np.arange(len(coefficients)))
        return float((coefficients * turns).real.sum())

    def _root(self, time: float) -> Tensor:
        """Where the pelvis is [m]."""
        size = _HIPS * self.height
        aside, up, ahead = (size * self._at(n, time) for n in ("aside", "up", "ahead"))
        place = [aside, _SOLE * self.height + up, -self.speed * time - ahead]
        return torch.tensor(place, dtype=torch.float64)

    def _posed(self, time: float) -> tuple[Tensor, Tensor]:
        turns = {
            "pelvis": [_about(1, self._at("pelvis", time))],
            "chest": [_about(1, self._at("chest", time)), _about(0, -self._at("bend", time))],
        }
        for side, sign, later in (("right", 1.0, 0.0), ("left", -1.0, 0.5)):
            hip, knee, shoulder, elbow = (
                self._at(name, time, later) for name in ("hip", "knee", "shoulder", "elbow")
            )
            turns[f"{side}_hip"] = [_about(0, hip)]
            turns[f"{side}_knee"] = [_about(0, -knee)]
            # Arms are held out at rest: down first, then forth and back.
            turns[f"{side}_shoulder"] = [_about(2, -sign * math.pi / 2), _about(0, shoulder)]
            turns[f"{side}_elbow"] = [_about(1, sign * elbow)]
        found = torch.eye(3, dtype=torch.float64).repeat(len(self.body.names), 1, 1)
        for name, parts in turns.items():
            for turn in parts:
                row = self.body.joint(name)
                found[row] = turn @ found[row]
        return self.body.posed(found)


def _about(axis: int, angle: float) -> Tensor:
    vector = torch.zeros(3, dtype=torch.float64)
    vector[axis] = angle
    return rotation_from_vector(vector)


def _curves(rate: float) -> dict[str, Curve]:
    """All curves of a relative speed, over the cycle of the right leg; angles in rad."""
    slow, fast = rate < 0.5, rate >= 1.3
    more = (rate - 1.3) / 1.7 if fast else 0.0
    share = np.arange(512) / 512
    hip = [(0.2 * more - 0.1, 25 + 5 * more), (0.5, -15.0), (0.9, 25 + 6 * more)]
    knee = [
        (0.17 - 0.05 * more, 3 + 22 * more),
        (0.4, 3.0),
        (0.75 - 0.05 * more, 70 - 5 * more),
        (1 - 0.03 * more, 3 + 3 * more),
    ]
    middle = (rate - 0.5) / 0.8
    elbow = [
        (0.05, 6 + 8 * middle),
        (0.5 + 0.01 * middle, 20 + 24 * middle),
        (0.9, 8 + 9 * middle),
    ]
    if slow:
        hip = [(-0.1, 50 * rate), (0.5, -30 * rate), (0.9, 50 * rate)]
        knee = [(0.17, 3.0), (0.4, 3.0), (0.75, 140 * rate), (1.0, 3.0)]
        elbow = [(0.05, 6 * rate + 3), (0.5, 34 * rate + 3), (0.9, 10 * rate + 3)]
    if fast:
        elbow = [
            (0.05, 14 - 6 * more),
            (0.51 + 0.04 * more, 44 + 26 * more),
            (0.9 - 0.1 * more, 17 - 6 * more),
        ]
    twist = [(0.1, 4 / 3), (0.4, -1.5), (0.6, -4 / 3), (0.9, 1.5)]
    swing, lean = 9.88 * rate, -8 * rate**2 + 8 * rate if slow else 2.0
    sway = -0.128 * rate**2 + 0.128 * rate if slow else 0.032
    surge = -0.084 * rate**2 + 0.084 * rate if slow else 0.021
    support = 0.752 - 0.143 * math.sqrt(rate) / 1.346  # share of the cycle on a foot

    def wave(turns: float, early: float) -> NDArray[np.float64]:
        return np.sin(2 * np.pi * (turns * share + early))

    degrees = {
        "hip": _through(hip, share),
        "knee": _through(knee, share),
        "elbow": _through(elbow, share),
        "shoulder": 3 - swing / 2 - swing * np.cos(2 * np.pi * share),
        "pelvis": -4 * rate * np.cos(2 * np.pi * share),
        "chest": _through([(at, rate * angle) for at, angle in twist], share),
        "bend": -lean + lean * wave(2, -0.1),
    }
    lengths = {
        "up": -0.015 * rate + 0.015 * rate * wave(2, -0.35),
        "aside": -sway * wave(1, -0.1),
        "ahead": -surge * wave(2, 2 * (0.625 - support)),
    }
    known = {name: np.radians(values) for name, values in degrees.items()} | lengths
    return {name: _harmonics(values) for name, values in known.items()}


def _through(points: list[tuple[float, float]], share: NDArray[np.float64]) -> Any:
    """A periodic curve through control points, without overshoot."""
    from scipy.interpolate import PchipInterpolator  # slow to import, and few people walk

    rounds = [(at + turn, value) for turn in (-1, 0, 1) for at, value in points]
    places = {round(at, 9): value for at, value in rounds}
    at = sorted(places)
    return PchipInterpolator(at, [places[x] for x in at])(share)


def _harmonics(values: NDArray[np.float64]) -> Curve:
    found = np.fft.rfft(values)[: _HARMONICS + 1] / len(values)
    found[1:] *= 2
    return found
