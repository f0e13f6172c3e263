"""Maps as pictures that stand beside the scene: measured, simulated, and what is left."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from invertwin.viewer.display import Display

MEASURED, SIMULATED, RESIDUAL = "measured", "simulated", "residual"
POWER_COLORMAP, RESIDUAL_COLORMAP = "viridis", "RdBu_r"  # colour maps
MIN_LEVEL_DB = -40.0  # dB below the peak
MAX_RESIDUAL_DB = 15.0  # dB of a residual
_MIN_PIXELS = 200  # along the shorter side of a picture, at least


class MapPanels:
    """Pictures in a row above the scene, each bin of which can be clicked.

    Args:
        server: Of viser.
        display: Tells where the scene is.
        shown: Names of the pictures.

    Attributes:
        left: The direction in which u grows.
        offset: From the middle of the scene to that of the pictures.
    """

    def __init__(self, server: Any, display: Display, shown: Sequence[str]) -> None:
        low, high = display.box
        up, ahead = np.array(display.up), np.array(display.ahead)
        self.left, self.offset = np.cross(up, ahead), np.zeros(3)
        self._shape = (1, 1)
        self._nodes: dict[str, Any] = {}
        self._places: dict[str, Any] = {}
        if not shown:
            return
        self._size = 0.5 * (float(np.linalg.norm(high - low)) or 1.0)
        self._axes = self.left, up
        self.offset = up * (float((high - low) @ np.abs(up)) / 2 + 0.65 * self._size)
        self._known: dict[str, tuple[Any, Any]] = {}
        # The image's first axis, which is that of u, its foot, and what is behind it.
        turn = _quaternion(np.stack([self.left, -up, -ahead], axis=1))
        empty = np.zeros((8, 8, 3), np.uint8)
        unlit = {"cast_shadow": False, "receive_shadow": False}
        for number, name in enumerate(shown):
            # The first one stands on the left of who looks along the radar.
            across = 1.1 * self._size * ((len(shown) - 1) / 2 - number)
            place = (low + high) / 2 + self.offset + across * self.left
            self._places[name] = place
            sides, pose = (self._size, self._size), {"wxyz": turn, "position": place}
            self._nodes[name] = server.scene.add_image(
                f"/maps/{name}", empty, *sides, format="png", **pose, **unlit
            )
            server.scene.add_label(
                f"/maps/{name}/label", name, position=(0.0, -0.55 * self._size, 0.0)
            )

    def on_click(self, choose: Callable[[tuple[int, int]], None]) -> None:
        """Say which bin was clicked.

        Args:
            choose: Takes the numbers of its range and its u.
        """
        for name, node in self._nodes.items():
            node.on_click(partial(self._choose_bin, name, choose))

    def _choose_bin(self, name: str, choose: Callable[[tuple[int, int]], None], event: Any) -> None:
        origin, toward = np.array(event.ray_origin), np.array(event.ray_direction)
        left, up = self._axes
        normal = np.cross(left, up)
        distance = (self._places[name] - origin) @ normal / (toward @ normal)
        away = origin + distance * toward - self._places[name]
        shares = 0.5 + away @ np.stack([up, left], axis=1) / self._size
        found = np.floor(shares * self._shape).astype(int).clip(0, np.array(self._shape) - 1)
        choose((int(found[0]), int(found[1])))

    def show(self, maps: Mapping[str, NDArray[np.float32]], chosen: tuple[int, int] | None) -> None:
        """Draw maps, each below its own peak; the residual where both are known.

        Args:
            maps: Power [range, u], by the name of the picture.
            chosen: A bin that is framed.
        """
        from matplotlib import colormaps

        self._shape = next(iter(maps.values())).shape if maps else (1, 1)
        levels = {name: relative_decibels(power) for name, power in maps.items()}
        pictures = {
            name: colormaps[POWER_COLORMAP](1 - level / MIN_LEVEL_DB)
            for name, level in levels.items()
        }
        if MEASURED in levels and SIMULATED in levels:
            apart = levels[MEASURED] - levels[SIMULATED]
            pictures[RESIDUAL] = colormaps[RESIDUAL_COLORMAP](0.5 + apart / (2 * MAX_RESIDUAL_DB))
        for name, node in self._nodes.items():
            node.visible = name in pictures
        for name, colors in pictures.items():
            if name in self._nodes and not (
                name in maps and self._is_current(name, maps[name], chosen)
            ):
                self._nodes[name].image = _draw_picture(np.uint8(255 * colors[..., :3]), chosen)

    def _is_current(self, name: str, power: NDArray[np.float32], chosen: Any) -> bool:
        """Return True if a picture is up to date, and mark it so."""
        before, frame = self._known.get(name, (None, None))
        self._known[name] = power, chosen
        return before is not None and frame == chosen and np.array_equal(before, power)


def relative_decibels(power: NDArray[np.float32]) -> NDArray[Any]:
    """A map below its own peak [dB], none below the darkest.

    Args:
        power: The map, or several of them [..., range, u].
    """
    peak = power.max((-2, -1), keepdims=True)
    level = 10 * np.log10(np.maximum(power / np.where(peak > 0, peak, 1.0), 1e-30))
    return level.clip(MIN_LEVEL_DB, 0.0)


def _draw_picture(colors: Any, chosen: tuple[int, int] | None) -> NDArray[np.uint8]:
    """A picture with the farthest range on top, each bin some pixels large."""
    times = [max(1, -(-_MIN_PIXELS // count)) for count in colors.shape[:2]]
    large = colors.repeat(times[0], axis=0).repeat(times[1], axis=1)
    if chosen is not None:
        rows, columns = (
            np.arange(k * size - 2, (k + 1) * size + 2).clip(0, end - 1)
            for k, size, end in zip(chosen, times, large.shape, strict=False)
        )
        large[rows[:, None], columns[[0, 1, -2, -1]]] = (255, 60, 60)
        large[rows[[0, 1, -2, -1]][:, None], columns] = (255, 60, 60)
    return np.ascontiguousarray(large[::-1])


def _quaternion(axes: NDArray[np.float64]) -> tuple[float, ...]:
    """The rotation whose columns these are, w first."""
    from scipy.spatial.transform import Rotation

    return tuple(Rotation.from_matrix(axes).as_quat()[[3, 0, 1, 2]].tolist())
