"""Rooms whose walls mirror, people in them, and what a radar records of them.

The radar is at zero and looks along x; y is left, z up. Recordings are those of what moves:
signals of the empty room are taken away.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

import invertwin as iw
from invertwin.channel import trace_point_targets
from invertwin.radar import beat_signal
from invertwin.radar.processing.beamforming import exact_spectrum
from invertwin.scene import (
    Cosine,
    Dielectric,
    PerfectConductor,
    Sitting,
    box,
    linear_array,
    person,
    plate,
    rigid,
)
from invertwin.scene.people.gait import hanging_arm_rotation
from invertwin.seeds import derive_seed

HEIGHT = 1.2  # of the radar above the floor [m]
CABINET = (0.5, 0.9, 2.0)  # along x, y, z [m]
POSTURES = ("stands", "sits", "holds arms out")
BODY = person(spacing=0.05)
SIZE = 0.05  # mean cross-section of a part of a person [m²]
NOISE = 3e-7  # standard deviation of a sample, √(received over sent)
MARGIN = 0.5  # of people from walls and the cabinet [m]
WIDEST = 0.85  # of the sine of their bearing


@dataclass(frozen=True)
class Room:
    """Where walls and cabinet are, and of what.

    Attributes:
        right, left: y of the side walls [m].
        back: x of the wall ahead [m].
        permittivity: Of right, left and back wall.
        cabinet: x and y of the middle of a metal cabinet [m].
    """

    right: Tensor
    left: Tensor
    back: Tensor
    permittivity: Float64[Tensor, "3"]
    cabinet: Float64[Tensor, "2"]


def random_room(seed: int, low: float, high: float) -> Room:
    """A room of random size.

    Args:
        seed: Of everything.
        low, high: Of the walls' permittivity.
    """
    random = torch.Generator().manual_seed(seed)

    def between(a: float, b: float, *shape: int) -> Tensor:
        return a + (b - a) * torch.rand(shape, generator=random, dtype=torch.float64)

    right, left, back = -between(1.6, 3.2), between(1.6, 3.2), between(4.8, 7.0)
    permittivity = low * (high / low) ** between(0.0, 1.0, 3)
    x, y = between(2.0, 3.6), between(0.2, 0.8)
    side = 1 - 2 * float(torch.rand((), generator=random) < 0.5)
    return Room(right, left, back, permittivity, torch.stack([x, side * y]))


def scene_of(room: Room) -> iw.Scene:
    """Walls and cabinet; all mirror.

    Args:
        room: Differentiable.
    """
    zero = torch.zeros((), dtype=torch.float64)
    wide, tall = plate(16.0, 4.0), 1.0
    across = torch.eye(3, dtype=torch.float64)  # faces −x
    along = torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]], dtype=torch.float64)  # faces ±y
    materials = [Dielectric(value, scattering=0.0) for value in room.permittivity]
    up = torch.full((), tall, dtype=torch.float64)
    places = {
        "right": (along, [zero + 4, room.right, up]),
        "left": (along, [zero + 4, room.left, up]),
        "back": (across, [room.back, zero, up]),
    }
    objects = {
        name: iw.Object(wide, material, rigid(turn, torch.stack(place)))
        for (name, (turn, place)), material in zip(places.items(), materials, strict=True)
    }
    middle = torch.stack([*room.cabinet, zero + CABINET[2] / 2 - HEIGHT])
    objects["cabinet"] = iw.Object(box(CABINET), PerfectConductor(), rigid(translation=middle))
    return iw.Scene(objects)


def radar() -> iw.Radar:
    """A board of 2 × 8 channels that looks ahead."""
    chirp = iw.FMCW(start_frequency=77e9, bandwidth=1e9, duration=40e-6, samples=160)
    half, patch = chirp.wavelength / 2, Cosine(1.0)
    return iw.Radar(
        linear_array(2, 8 * half, pattern=patch),
        linear_array(8, half, pattern=patch),
        chirp,
        torch.zeros(1, 3, dtype=torch.float64),
    )


RADAR = radar()
GRID = RADAR.grid(range_min=0.6, range_max=9.0, u_max=0.95)


def _shapes() -> list[Tensor]:
    """Parts of a person in each posture, on the floor, facing the radar [part, 3] [m]."""
    still = torch.eye(3, dtype=torch.float64).repeat(len(BODY.names), 1, 1)
    standing = still.clone()
    for side in ("left", "right"):
        standing[BODY.joint(f"{side}_shoulder")] = hanging_arm_rotation(side)
    sat, shift = Sitting(BODY, 0.45).posture(2.0)
    low = BODY.vertices[:, 2].min()
    found = []
    for turns, away in ((standing, 0 * shift), (sat, shift), (still, 0 * shift)):
        skin, joints = BODY.apply_pose(turns)
        tips = skin[[int(BODY.vertices[:, 1].argmin()), int(BODY.vertices[:, 1].argmax())]]
        x, y, z = (torch.cat([joints, tips]) + away).unbind(-1)
        found.append(torch.stack([x, y, z - low - HEIGHT], dim=-1))
    return found


SHAPES = _shapes()


@dataclass(frozen=True)
class Samples:
    """Recordings with what is true of them.

    Attributes:
        maps: Power [sample, range, u].
        places: x and y of the people [sample, 2] [m].
        postures: Numbers in ``POSTURES``.
    """

    maps: Float64[Tensor, "sample range u"]
    places: Float64[Tensor, "sample 2"]
    postures: Tensor


def inside(room: Room, places: Tensor) -> Tensor:
    """Whether people can be at some places and the radar looks there.

    Args:
        room: The room.
        places: [place, 2].
    """
    x, y = places.unbind(-1)
    off = (places - room.cabinet).abs() - torch.tensor(CABINET[:2]) / 2
    bearing = y.abs() / places.norm(dim=-1)
    free = (x > 1.2) & (x < room.back - MARGIN) & (bearing < WIDEST)
    free = free & (y > room.right + MARGIN) & (y < room.left - MARGIN)
    return free & (off > 0.3).any(-1)


@torch.no_grad()
def recorded(room: Room, count: int, seed: int) -> Samples:
    """Exact recordings of people in a room.

    Args:
        room: The room.
        count: How many.
        seed: Of all of them.
    """
    scene, maps, rows = scene_of(room), [], []
    for number in range(count):
        random = torch.Generator().manual_seed(derive_seed(seed, number))
        tried = torch.rand((400, 2), generator=random, dtype=torch.float64)
        corner = torch.stack([torch.zeros_like(room.right), room.right])
        far = torch.stack([room.back, room.left])
        tried = corner + tried * (far - corner)
        place = tried[int(inside(room, tried).nonzero()[0, 0])]
        posture = int(torch.randint(3, (), generator=random))
        angle = 2 * math.pi * float(torch.rand((), generator=random))
        c, s = math.cos(angle), math.sin(angle)
        turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
        points = SHAPES[posture] @ turn.T
        points[:, :2] += place
        drawn = torch.rand(len(points), generator=random, dtype=torch.float64)
        echoes = trace_point_targets(scene, RADAR.link(), points, -SIZE * drawn.log(), rays=None)
        beat = beat_signal(echoes, RADAR)
        noise = torch.randn((2, *beat.shape), generator=random, dtype=torch.float64)
        beat = beat + NOISE * torch.complex(noise[0], noise[1])
        maps.append(exact_spectrum(beat, RADAR, GRID)[0, :, :, 0])
        rows.append((place, posture))
    places = torch.stack([place for place, _ in rows])
    return Samples(torch.stack(maps), places, torch.tensor([posture for _, posture in rows]))
