"""Derivatives of received power where shadows move: by diffraction right, by optics alone not.

Truth are differences of the power with diffraction. Optics alone has no shadow edges.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

from invertwin.channel import trace_paths
from invertwin.scene import (
    Mesh,
    Object,
    PerfectConductor,
    Scene,
    Slab,
    box,
    plate,
    rigid,
    rotation_from_vector,
)
from scenes import float64, level_plate

FREQUENCY = 5e9
METAL = PerfectConductor()
RIGHT, WRONG = 0.015, 0.1
ACROSS = rotation_from_vector(float64([0.0, 0.0, -math.pi / 2]))
TX = float64([0.3, -3.0, 1.4])
FLOOR = Object(level_plate(40.0, 40.0), Slab.itu("concrete", thickness=0.2))


@dataclass(frozen=True)
class Case:
    """What moves, and who listens.

    Attributes:
        scene: Of the unknown [m].
        rx: Receivers.
        moved: Whether the unknown moves the receivers along x instead.
        edges, depth: Of ``trace_paths``.
    """

    scene: Callable[[Tensor], Scene]
    rx: Tensor
    moved: bool = False
    edges: int = 1
    depth: int = 1

    def power(self, value: Tensor, edges: int) -> Tensor:
        """Received over sent power of V, by receiver."""
        along = float64([1.0, 0.0, 0.0]) * value
        rx = self.rx + along if self.moved else self.rx
        around = self.scene(0 * value if self.moved else value)
        options: dict[str, Any] = {"depth": self.depth, "edges": edges, "rays": 20_000}
        paths = trace_paths(around, TX, rx, FREQUENCY, **options)
        turn = torch.polar(torch.ones_like(paths.delay), -2 * math.pi * FREQUENCY * paths.delay)
        field = torch.zeros(len(rx), 2, dtype=torch.complex128)
        sent = paths.coefficient[:, :, 0] * turn[:, None]
        return field.index_add(0, paths.rx, sent).abs().square().sum(1)

    def errors(self) -> tuple[float, float]:
        """Relative L1 of the derivative with diffraction, and without."""
        zero, step = torch.zeros((), dtype=torch.float64), 1e-5
        ends = [self.power(zero + sign * step, self.edges) for sign in (1, -1)]
        truth = (ends[0] - ends[1]) / (2 * step)
        assert float(truth.abs().max()) > 0
        found = []
        for edges in (self.edges, 0):
            slopes: Any = torch.autograd.functional.jacobian(
                lambda value, number=edges: self.power(value, number), zero
            )
            found.append(float((slopes - truth).abs().sum() / truth.abs().sum()))
        return found[0], found[1]


def across(y: float, z: float = 1.2, count: int = 33) -> Tensor:
    """Receivers in a row from x = −1 to 1.6 m."""
    x = torch.linspace(-1.0, 1.6, count, dtype=torch.float64)
    return torch.stack([x, torch.full_like(x, y), torch.full_like(x, z)], 1)


def standing(width: float, height: float, at: Tensor) -> Object:
    return Object(plate(width, height), METAL, rigid(ACROSS, at))


def half_plane(value: Tensor) -> Scene:
    """A wide plate that slides to the side."""
    moved = float64([-10.0, 0.0, 1.0]) + value * float64([1.0, 0.0, 0.0])
    return Scene({"screen": standing(20.0, 30.0, moved)})


def wedge(value: Tensor) -> Scene:
    """A large block whose corner stands in the way."""
    moved = float64([-9.5, 10.0, 0.0]) + value * float64([1.0, 0.0, 0.0])
    return Scene({"block": Object(box((20.0, 20.0, 30.0)), METAL, rigid(translation=moved))})


def size(value: Tensor) -> Scene:
    """A plate that grows, before the receivers."""
    base = plate(1.0, 0.8)
    mesh = Mesh(base.vertices * (1 + value), base.faces)
    return Scene({"plate": Object(mesh, METAL, rigid(ACROSS, float64([0.2, 0.0, 1.3])))})


def blocker(value: Tensor) -> Scene:
    """A box that slides over a floor."""
    moved = float64([0.1, 0.0, 1.0]) + value * float64([1.0, 0.0, 0.0])
    return Scene({"floor": FLOOR, "box": Object(box((0.6, 0.5, 1.6)), METAL, rigid(None, moved))})


BESIDE = float64([1.6, 0.0, 0.0])
CASES = {
    "half_plane": Case(half_plane, across(3.0)),
    # Beside the block, across its shadow and the end of what its front mirrors.
    "wedge": Case(wedge, torch.cat([across(3.0) + BESIDE, across(-1.0)])),
    "plate_size": Case(size, across(3.0)),
    "receiver": Case(half_plane, across(3.0), moved=True),
    "blocker": Case(blocker, across(3.0, count=17), edges=2, depth=2),
}


@pytest.mark.parametrize("name", CASES)
def test_derivatives_across_shadows(name):
    right, wrong = CASES[name].errors()
    assert right <= RIGHT
    assert wrong >= WRONG
