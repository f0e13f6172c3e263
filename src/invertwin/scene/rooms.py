"""Furnished room of named objects, for indoor radars."""

from collections.abc import Sequence

import torch

from invertwin.checks import checked_number
from invertwin.errors import InputError
from invertwin.limits import Positive
from invertwin.scene.material.materials import RoughDielectric
from invertwin.scene.mesh import Mesh, concatenate_meshes
from invertwin.scene.pose import rigid
from invertwin.scene.scene import Object
from invertwin.scene.shapes import box

_TOP = 0.03  # thickness of boards [m]
_LEG = 0.05  # width of legs [m]
_SHELF_BOARDS = 5
_FURNITURE = ("table", "chair_1", "chair_2", "shelf", "sofa")

# All of them are in ITU-R P.2040 up to 100 GHz. Upholstery is not; the board of suspended
# ceilings, of ε' 1.5, is closest to foam and cloth.
_ITU = {
    "floor": "concrete",
    "ceiling": "ceiling_board",
    "wall": "plasterboard",
    "table": "wood",
    "chair_1": "wood",
    "chair_2": "wood",
    "shelf": "chipboard",
    "sofa": "ceiling_board",
}


def room(
    width: Positive = 5.0,
    depth: Positive = 6.0,
    height: Positive = 2.6,
    *,
    furniture: Sequence[str] = _FURNITURE,
) -> dict[str, Object]:
    """Build a closed room with furniture: objects by name, for ``Scene({**room(), …})``.

    The floor is the plane y = 0, with y up. The room reaches from −width/2 to width/2 along x and
    from 0 to depth along z; a radar at (0, 1, 0.1) facing z observes all of it. The middle is free,
    at least 0.5 m to either side of x = 0. The room is deterministic.

    Walls, ceiling and floor are sheets of plasterboard, ceiling board and concrete; the table
    and the chairs are of wood, the shelf of chipboard (ITU-R P.2040-3). All have rough surfaces.

    Args:
        width: size along x, at least 4 [m].
        depth: size along z, at least 4 [m].
        height: size along y, at least 2.1 [m].
        furniture: names among table, chair_1, chair_2, shelf and sofa.

    Raises:
        InputError: A room that is too small for its furniture, or other furniture.
    """
    w = checked_number(width, "width of the room [m]", 4)
    d = checked_number(depth, "depth of the room [m]", 4)
    h = checked_number(height, "height of the room [m]", 2.1)
    unknown = [name for name in furniture if name not in _FURNITURE]
    if isinstance(furniture, str) or unknown:
        raise InputError(
            f"expected furniture among {', '.join(_FURNITURE)}, got {furniture!r}; give a list"
        )
    sides = {
        "floor": _panel([0, 0, d / 2], [0, 0, d / 2], [w / 2, 0, 0]),
        "ceiling": _panel([0, h, d / 2], [w / 2, 0, 0], [0, 0, d / 2]),
        "wall_front": _panel([0, h / 2, 0], [w / 2, 0, 0], [0, h / 2, 0]),
        "wall_back": _panel([0, h / 2, d], [0, h / 2, 0], [w / 2, 0, 0]),
        "wall_left": _panel([-w / 2, h / 2, d / 2], [0, h / 2, 0], [0, 0, d / 2]),
        "wall_right": _panel([w / 2, h / 2, d / 2], [0, 0, d / 2], [0, h / 2, 0]),
    }
    # Keep a small gap between furniture and walls.
    placed = {
        "table": (_table(0.8, 0.74, 1.4), [w / 2 - 0.85, d / 2]),
        "chair_1": (_chair(), [w / 2 - 0.85, d / 2 - 1.0]),
        "chair_2": (_chair(is_reversed=True), [w / 2 - 0.85, d / 2 + 1.0]),
        "shelf": (_shelf(0.9, 1.9, 0.35), [w / 2 - 0.6, d - 0.2]),
        "sofa": (_sofa(), [-w / 2 + 0.5, d / 2]),
    }
    found = {name: Object(mesh, _material(name)) for name, mesh in sides.items()}
    for name in furniture:
        mesh, (x, z) = placed[name]
        found[name] = Object(mesh, _material(name), rigid(translation=[x, 0.0, z]))
    return found


def _material(name: str) -> RoughDielectric:
    return RoughDielectric.itu(_ITU["wall" if name.startswith("wall") else name])


def _panel(middle: Sequence[float], first: Sequence[float], second: Sequence[float]) -> Mesh:
    """Return a rectangle with two half sides that faces along first × second."""
    m, a, b = (torch.tensor(value, dtype=torch.float64) for value in (middle, first, second))
    corners = torch.stack([m - a - b, m + a - b, m + a + b, m - a + b])
    return Mesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]))


def _boxes(*parts: tuple[tuple[float, float, float], tuple[float, float, float]]) -> Mesh:
    """Return boxes by size and centre."""
    meshes = [(box(size), torch.tensor(middle, dtype=torch.float64)) for size, middle in parts]
    return concatenate_meshes([Mesh(mesh.vertices + middle, mesh.faces) for mesh, middle in meshes])


def _legs(
    x: float, z: float, top: float
) -> list[tuple[tuple[float, float, float], tuple[float, float, float]]]:
    """Return four legs that end just below the top."""
    high = top - 1e-3
    places = [(sx * x, sz * z) for sx in (-1, 1) for sz in (-1, 1)]
    return [((_LEG, high, _LEG), (px, 1e-3 + high / 2, pz)) for px, pz in places]


def _table(x: float, y: float, z: float) -> Mesh:
    legs = _legs(x / 2 - _LEG, z / 2 - _LEG, y - _TOP - 1e-3)
    return _boxes(((x, _TOP, z), (0, y - _TOP / 2, 0)), *legs)


def _chair(*, is_reversed: bool = False) -> Mesh:
    """Return a chair whose back is at −z, or at z."""
    back = 0.19 if is_reversed else -0.19
    return _boxes(
        ((0.42, _TOP, 0.42), (0, 0.45, 0)),
        ((0.42, 0.45, _TOP), (0, 0.70, back)),
        *_legs(0.18, 0.18, 0.43),
    )


def _shelf(x: float, y: float, z: float) -> Mesh:
    """Return a back, two sides and boards between them, open to −z."""
    inner = x - 2 * _TOP - 2e-3
    step = (y - _TOP - 2e-3) / (_SHELF_BOARDS - 1)
    levels = [2e-3 + _TOP / 2 + step * number for number in range(_SHELF_BOARDS)]
    sides = [((_TOP, y, z), (sign * (x - _TOP) / 2, y / 2 + 1e-3, 0.0)) for sign in (-1, 1)]
    boards = [((inner, _TOP, z - 0.02), (0.0, level, -0.01)) for level in levels]
    return _boxes(*sides, *boards, ((inner, y, 0.01), (0.0, y / 2 + 1e-3, z / 2 - 5e-3 + 1e-3)))


def _sofa() -> Mesh:
    """Return a seat, a back at −x and two arms, 1.9 m along z."""
    return _boxes(
        ((0.66, 0.42, 1.58), (0.09, 0.212, 0.0)),
        ((0.18, 0.82, 1.9), (-0.34, 0.412, 0.0)),
        ((0.66, 0.6, 0.15), (0.09, 0.302, -0.87)),
        ((0.66, 0.6, 0.15), (0.09, 0.302, 0.87)),
    )
