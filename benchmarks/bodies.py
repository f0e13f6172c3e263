"""A car, a chair and a room: as the parts that people draw, and as one clean surface each.

The parts touch, overlap and share planes. The clean chair and the clean room are built without
any union of triangles: space is divided at all planes of the parts, so that neighbours share whole
edges and what lies inside is no face at all.
"""

from itertools import product

import numpy as np
import torch
from torch import Tensor

import invertwin as iw
from invertwin.scene import Mesh, cylinder, sphere

UNIT = 0.005  # m, of the numbers below
#: Lower and upper corner.
Block = tuple[tuple[float, float, float], tuple[float, float, float]]

CHAIR: list[Block] = [
    *(((x, y, 0.0), (x + 4, y + 4, 44.0)) for x in (0.0, 40.0) for y in (0.0, 38.0)),  # legs
    ((0.0, 0.0, 44.0), (44.0, 42.0, 48.0)),  # seat
    *(((40.0, y, 48.0), (44.0, y + 4, 96.0)) for y in (0.0, 38.0)),  # posts, flush with the legs
    *(((41.0, 4.0, z), (43.0, 38.0, z + 6)) for z in (58.0, 72.0, 86.0)),  # slats between posts
    *(((6.0, y, 64.0), (40.0, y + 4, 67.0)) for y in (0.0, 38.0)),  # arms, on the posts
]
"""Twelve boxes that touch."""

ROOM: list[Block] = [
    *(((x, y, 0.0), (x + 24, y + 30, 0.0)) for x in (0.0, 24.0) for y in (0.0, 30.0)),  # floor
    *(((0.0, y, 40.0), (48.0, y + 20, 40.0)) for y in (0.0, 20.0, 40.0)),  # ceiling
    *(((48.0, y, z), (48.0, y + 30, z + 20)) for y in (0.0, 30.0) for z in (0.0, 20.0)),  # back
    ((0.0, 0.0, 0.0), (16.0, 0.0, 40.0)),  # right wall around a window
    ((32.0, 0.0, 0.0), (48.0, 0.0, 40.0)),
    ((16.0, 0.0, 0.0), (32.0, 0.0, 12.0)),
    ((16.0, 0.0, 28.0), (32.0, 0.0, 40.0)),
    *(((x, 60.0, 0.0), (x + 16, 60.0, 40.0)) for x in (0.0, 16.0, 32.0)),  # left wall
    ((36.0, 0.0, 0.0), (36.0, 12.0, 40.0)),  # partition with a door
    ((36.0, 12.0, 30.0), (36.0, 22.0, 40.0)),
    ((36.0, 22.0, 0.0), (36.0, 36.0, 40.0)),
    ((6.0, 40.0, 14.0), (20.0, 56.0, 14.0)),  # table top and its four legs
    *(((6.0, y, 0.0), (9.0, y, 14.0)) for y in (40.0, 56.0)),
    *(((20.0, y, 0.0), (20.0, y + 3, 14.0)) for y in (40.0, 53.0)),
    *(((40.0, 46.0, z), (48.0, 60.0, z)) for z in (12.0, 24.0)),  # shelves in a corner
    ((40.0, 46.0, 0.0), (48.0, 46.0, 24.0)),  # their side, and the front of the lower one
    ((40.0, 46.0, 0.0), (40.0, 60.0, 12.0)),
]
"""Thirty panels of a room that is open in front, some in T-junctions."""

#: Planes of all parts along each axis, in their order.
Planes = list[np.ndarray]


def chair() -> list[Mesh]:
    """Boxes of the chair."""
    sizes = [[UNIT * (b - a) for a, b in zip(*block, strict=True)] for block in CHAIR]
    return [
        Mesh(iw.box(size).vertices + _middle([block]) - _middle(CHAIR), iw.box(size).faces)
        for size, block in zip(sizes, CHAIR, strict=True)
    ]


def clean_chair() -> Mesh:
    """Squares between cells of space within and without the boxes."""
    planes = _planes(CHAIR)
    inside = np.zeros([len(own) + 1 for own in planes], dtype=bool)  # a cell more on each side
    for low, high in CHAIR:
        cells = [
            slice(np.searchsorted(own, a) + 1, np.searchsorted(own, b) + 1)
            for own, a, b in zip(planes, low, high, strict=True)
        ]
        inside[tuple(cells)] = True
    squares = []
    for axis in range(3):
        within = tuple(slice(None) if k == axis else slice(1, -1) for k in range(3))
        squares.append(np.argwhere(np.diff(inside, axis=axis)[within]))
    return _join_squares(planes, squares, _middle(CHAIR))


def room() -> list[Mesh]:
    """Panels of the room, two triangles each."""
    parts = []
    for low, high in ROOM:
        axis = next(k for k in range(3) if low[k] == high[k])
        corners = UNIT * _corners(np.array([low]), np.array([high]), axis)[0]
        faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
        parts.append(Mesh(torch.from_numpy(corners) - _middle(ROOM), faces))
    return parts


def clean_room() -> Mesh:
    """The panels, divided at the planes of all, by shared vertices."""
    planes = _planes(ROOM)
    squares: list[list[tuple[int, ...]]] = [[], [], []]
    for low, high in ROOM:
        axis = next(k for k in range(3) if low[k] == high[k])
        first, last = (
            [int(np.searchsorted(own, a)) for own, a in zip(planes, end, strict=True)]
            for end in (low, high)
        )
        last[axis] += 1
        squares[axis] += product(*(range(a, b) for a, b in zip(first, last, strict=True)))
    return _join_squares(planes, [np.array(found) for found in squares], _middle(ROOM))


def car() -> list[Mesh]:
    """Hull, cabin and four wheels that overlap, and hubs that touch these: 42 496 triangles."""
    parts = [_rounded_block((0.3, 0.13, 0.06), 5), _rounded_block((0.16, 0.11, 0.05), 5)]
    parts[1] = Mesh(parts[1].vertices + torch.tensor([0.02, 0.0, 0.07]).double(), parts[1].faces)
    for side in (-1.0, 1.0):
        for x in (-0.18, 0.18):
            for radius, width, y in ((0.05, 0.04, 0.115), (0.02, 0.01, 0.14)):
                wheel = cylinder(radius, width, 48)
                place = torch.tensor([x, side * y, -0.05]).double()
                turned = wheel.vertices[:, [0, 2, 1]] * torch.tensor([1.0, -1.0, 1.0]).double()
                parts.append(Mesh(turned + place, wheel.faces))
    return parts


def _rounded_block(half: tuple[float, float, float], subdivisions: int) -> Mesh:
    """The surface |x/a|⁵ + |y/b|⁵ + |z/c|⁵ = 1."""
    ball = sphere(1.0, subdivisions)
    radius = ball.vertices.abs().pow(5).sum(1, keepdim=True).pow(-0.2)
    return Mesh(ball.vertices * radius * torch.tensor(half).double(), ball.faces)


def _planes(blocks: list[Block]) -> Planes:
    return list(map(np.unique, np.array(blocks).reshape(-1, 3).T))


def _middle(blocks: list[Block]) -> Tensor:
    """The middle of the box around all [m]."""
    points = np.array(blocks).reshape(-1, 3)
    return torch.from_numpy(UNIT * (points.min(0) + points.max(0)) / 2)


def _corners(low: np.ndarray, high: np.ndarray, axis: int) -> np.ndarray:
    """Corners of rectangles across an axis, around each [n, 4, 3]."""
    found = np.repeat(low[:, None], 4, axis=1)
    u, v = (axis + 1) % 3, (axis + 2) % 3
    found[:, 1:3, u], found[:, 2:, v] = high[:, None, u], high[:, None, v]
    return found


def _join_squares(planes: Planes, squares: list[np.ndarray], middle: Tensor) -> Mesh:
    """A mesh of squares across each axis, by the numbers of their lower planes [n, 3]."""
    corners = np.concatenate([_corners(own, own + 1, axis) for axis, own in enumerate(squares)])
    used, quads = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    places = np.stack([own[row] for own, row in zip(planes, used.T, strict=True)], 1)
    quads = quads.reshape(-1, 4)
    faces = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])
    return Mesh(torch.from_numpy(UNIT * places) - middle, torch.from_numpy(faces))
