"""Furnished room of named objects, for indoor radars."""

from collections.abc import Sequence

import torch

from invertwin.checks import check_choice, checked_number
from invertwin.constants import read_table
from invertwin.limits import Positive
from invertwin.scene.material.materials import RoughDielectric
from invertwin.scene.mesh import Mesh, concatenate_meshes
from invertwin.scene.pose import rigid
from invertwin.scene.scene import Object
from invertwin.scene.shapes import box

_TOP = 0.03  # thickness of boards [m]
_LEG = 0.05  # width of legs [m]
_SHELF_BOARDS = 5
_Box = tuple[tuple[float, float, float], tuple[float, float, float]]  # sides and middle [m]
_FURNITURE = ("table", "chair_1", "chair_2", "shelf", "sofa")

_ITU = read_table("invertwin.scene", "rooms.toml")["itu"]


def room(
    width: Positive = 5.0,
    depth: Positive = 6.0,
    height: Positive = 2.6,
    *,
    furniture: Sequence[str] = _FURNITURE,
) -> dict[str, Object]:
    """Build a closed room with furniture: objects by name, for ``Scene({**room(), …})``.

    The floor is the plane z = 0, with z up. The room reaches from 0 to depth along x and from
    −width/2 to width/2 along y; a radar at (0.1, 0, 1) facing x observes all of it. The middle is
    free, at least 0.5 m to either side of y = 0. The room is deterministic.

    Walls, ceiling and floor are sheets of plasterboard, ceiling board and concrete; the table
    and the chairs are of wood, the shelf of chipboard (ITU-R P.2040-3). All have rough surfaces.

    Args:
        width: size along y, at least 4 [m].
        depth: size along x, at least 4 [m].
        height: size along z, at least 2.1 [m].
        furniture: names among table, chair_1, chair_2, shelf and sofa.

    Raises:
        InputError: A room that is too small for its furniture, or other furniture.
    """
    w = checked_number(width, "width of the room [m]", 4)
    d = checked_number(depth, "depth of the room [m]", 4)
    h = checked_number(height, "height of the room [m]", 2.1)
    for name in furniture:
        check_choice(name, _FURNITURE, "furniture among", "give a list")
    sides = {
        "floor": _panel([d / 2, 0, 0], [d / 2, 0, 0], [0, w / 2, 0]),
        "ceiling": _panel([d / 2, 0, h], [0, w / 2, 0], [d / 2, 0, 0]),
        "wall_front": _panel([0, 0, h / 2], [0, w / 2, 0], [0, 0, h / 2]),
        "wall_back": _panel([d, 0, h / 2], [0, 0, h / 2], [0, w / 2, 0]),
        "wall_right": _panel([d / 2, -w / 2, h / 2], [0, 0, h / 2], [d / 2, 0, 0]),
        "wall_left": _panel([d / 2, w / 2, h / 2], [d / 2, 0, 0], [0, 0, h / 2]),
    }
    # Keep a small gap between furniture and walls.
    placed = {
        "table": (_table(1.4, 0.8, 0.74), [d / 2, w / 2 - 0.85]),
        "chair_1": (_chair(), [d / 2 - 1.0, w / 2 - 0.85]),
        "chair_2": (_chair(is_reversed=True), [d / 2 + 1.0, w / 2 - 0.85]),
        "shelf": (_shelf(0.35, 0.9, 1.9), [d - 0.2, w / 2 - 0.6]),
        "sofa": (_sofa(), [d / 2, -w / 2 + 0.5]),
    }
    found = {name: Object(mesh, _material(name)) for name, mesh in sides.items()}
    for name in furniture:
        mesh, (x, y) = placed[name]
        found[name] = Object(mesh, _material(name), rigid(translation=[x, y, 0.0]))
    return found


def _material(name: str) -> RoughDielectric:
    return RoughDielectric.itu(_ITU["wall" if name.startswith("wall") else name])


def _panel(middle: Sequence[float], first: Sequence[float], second: Sequence[float]) -> Mesh:
    """Return a rectangle with two half sides that faces along first × second."""
    m, a, b = (torch.tensor(value, dtype=torch.float64) for value in (middle, first, second))
    corners = torch.stack([m - a - b, m + a - b, m + a + b, m - a + b])
    return Mesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]))


def _boxes(*parts: _Box) -> Mesh:
    """Return boxes by size and centre."""
    meshes = [(box(size), torch.tensor(middle, dtype=torch.float64)) for size, middle in parts]
    return concatenate_meshes([Mesh(mesh.vertices + middle, mesh.faces) for mesh, middle in meshes])


def _legs(x: float, y: float, top: float) -> list[_Box]:
    """Return four legs that end just below the top."""
    high = top - 1e-3
    places = [(sx * x, sy * y) for sy in (-1, 1) for sx in (-1, 1)]
    return [((_LEG, _LEG, high), (px, py, 1e-3 + high / 2)) for px, py in places]


def _table(x: float, y: float, z: float) -> Mesh:
    legs = _legs(x / 2 - _LEG, y / 2 - _LEG, z - _TOP - 1e-3)
    return _boxes(((x, y, _TOP), (0, 0, z - _TOP / 2)), *legs)


def _chair(*, is_reversed: bool = False) -> Mesh:
    """Return a chair whose back is at −x, or at x."""
    back = 0.19 if is_reversed else -0.19
    return _boxes(
        ((0.42, 0.42, _TOP), (0, 0, 0.45)),
        ((_TOP, 0.42, 0.45), (back, 0, 0.70)),
        *_legs(0.18, 0.18, 0.43),
    )


def _shelf(x: float, y: float, z: float) -> Mesh:
    """Return a back, two sides and boards between them, open to −x."""
    inner = y - 2 * _TOP - 2e-3
    step = (z - _TOP - 2e-3) / (_SHELF_BOARDS - 1)
    levels = [2e-3 + _TOP / 2 + step * number for number in range(_SHELF_BOARDS)]
    sides = [((x, _TOP, z), (0.0, sign * (y - _TOP) / 2, z / 2 + 1e-3)) for sign in (-1, 1)]
    boards = [((x - 0.02, inner, _TOP), (-0.01, 0.0, level)) for level in levels]
    return _boxes(*sides, *boards, ((0.01, inner, z), (x / 2 - 5e-3 + 1e-3, 0.0, z / 2 + 1e-3)))


def _sofa() -> Mesh:
    """Return a seat, a back at −y and two arms, 1.9 m along x."""
    return _boxes(
        ((1.58, 0.66, 0.42), (0.0, 0.09, 0.212)),
        ((1.9, 0.18, 0.82), (0.0, -0.34, 0.412)),
        ((0.15, 0.66, 0.6), (-0.87, 0.09, 0.302)),
        ((0.15, 0.66, 0.6), (0.87, 0.09, 0.302)),
    )
