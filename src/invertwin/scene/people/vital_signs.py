"""Breathing and heartbeat: displacement of the skin of the chest.

Sources: T. Kondo, T. Uhlig, P. Pemberton, P. D. Sly, "Laser monitoring of chest wall displacement",
Eur. Respir. J. 10, 1997, 1865–1869: 4 to 12 mm by breathing. G. Ramachandran, M. Singh,
"Three-dimensional reconstruction of cardiac displacement patterns on the chest wall", Med. Biol.
Eng. Comput. 27, 1989, 525–530: up to 0.5 mm by the heart.
Differs from the source: both are sines, without a rest after breathing out and without the sharp
onset of a heartbeat, and the whole front of the chest moves in phase.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.checks import check_shape, checked_number
from invertwin.limits import Positive
from invertwin.scene.mesh import Mesh
from invertwin.scene.people import gait
from invertwin.scene.people.body import BodyTemplate
from invertwin.scene.scene import Object


@dataclass(frozen=True, eq=False)
class Breathing:
    """Person at rest who breathes, and whose heart beats.

    The front of the chest is displaced along its mean normal, fully in the middle and not at the
    sides. ``MovingScene`` applies it, last of several motions of a person.

    Attributes:
        body: body template with the joints of ``person``.
        rate: frequency of breathing [Hz].
        depth: peak-to-peak displacement by breathing [m]; a tensor for derivatives.
        heart_rate: frequency of the heart [Hz].
        heart_depth: peak-to-peak displacement by the heart [m]; a tensor for derivatives.

    Raises:
        InputError: A body without these joints, a frequency that is not positive, or a negative
            displacement.
    """

    body: BodyTemplate
    rate: Positive = 0.25
    depth: float | Tensor = 8e-3
    heart_rate: Positive = 1.2
    heart_depth: float | Tensor = 4e-4

    def __post_init__(self) -> None:
        gait.check_joints(self.body)
        for name in ("rate", "heart_rate"):
            checked_number(getattr(self, name), f"{name} [Hz]", 0.0, open_low=True)
        for name in ("depth", "heart_depth"):
            checked_number(getattr(self, name), f"{name} [m]", 0.0)

    def displacement(self, time: float) -> Float64[Tensor, ""]:
        """Return the displacement of the middle of the chest from breathing out [m].

        Args:
            time: time [s].
        """
        parts = (self.depth, self.rate), (self.heart_depth, self.heart_rate)
        rise = sum(0.5 * depth * (1 - math.cos(2 * math.pi * rate * time)) for depth, rate in parts)
        return torch.as_tensor(rise, dtype=torch.float64)

    def __call__(self, item: Object, time: float) -> Object:
        """Return the person at a time [s].

        Args:
            item: person in any posture, with the vertices of the body.
            time: time [s].

        Raises:
            InputError: A mesh with another number of vertices.
        """
        points, faces = item.mesh.vertices, item.mesh.faces
        expected = tuple(self.body.vertices.shape)
        check_shape(points, expected, "vertices of the person [m]", "use the mesh of the body")
        chest = self.body.joint("chest")
        ahead = (self.body.joints[chest, 0] - self.body.vertices[:, 0]).clamp_min(0.0)
        share = self.body.weights[:, chest] * ahead
        share = 1 - (1 - share / share.max()) ** 4
        a, b, c = points[faces].unbind(1)
        normal = (share[faces].mean(1, keepdim=True) * torch.linalg.cross(b - a, c - a)).sum(0)
        rise = share[:, None] * self.displacement(time) * normal / normal.norm()
        return replace(item, mesh=Mesh(points + rise, faces))
