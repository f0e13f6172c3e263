"""Maps of every sensor at every step, for pages that cannot trace, and what links them."""

import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from invertwin.errors import InputError, PhysicsWarning
from invertwin.viewer.display import Display
from invertwin.viewer.layers import to_float32
from invertwin.viewer.link import InteractiveSensor
from invertwin.viewer.panels import MEASURED

_MAX_MAPS = 144  # simulated ones of a page, over sensors, steps and positions
_MAX_FRAMES = 8  # positions of a sensor
_MAX_BINS = 96  # of a map along range, and across


@dataclass(frozen=True, eq=False)
class SensorMaps:
    """Maps of one sensor on a page.

    Attributes:
        frames: Numbers of its positions.
        grid: Middle of the first bin and distance of the bins, of range [m] and of u.
        positions: positions of the radar [frame, 3], m; none where nothing links maps to them.
        rotations: Columns are the radar's axes, [frame, 3, 3].
        origins: Range from which each position counts its own [m].
        measured: Power [frame, range, u], if there is any.
        simulated: Power [step, frame, range, u], if there is any; without steps one of the scene.
    """

    frames: list[int]
    grid: tuple[float, float, float, float]
    positions: NDArray[np.float32]
    rotations: NDArray[np.float32]
    origins: NDArray[np.float32]
    measured: NDArray[np.float32] | None
    simulated: NDArray[np.float32] | None


def collect_sensor_maps(
    display: Display, sensors: Mapping[str, InteractiveSensor]
) -> dict[str, SensorMaps]:
    """Maps of all sensors at some of their positions, by the name of the sensor.

    The links are left with the bodies of the last step.

    Args:
        display: With its steps and with what was measured.
        sensors: The forward model of each sensor.
    """
    names = list(dict.fromkeys([*display.maps, *sensors]))
    count = _MAX_MAPS // (max(1, len(display.steps)) * max(1, len(names)))
    found = {
        name: _collect_maps(display, name, sensors.get(name), min(max(1, count), _MAX_FRAMES))
        for name in names
    }
    return {
        name: own
        for name, own in found.items()
        if own.measured is not None or own.simulated is not None
    }


def _collect_maps(
    display: Display, name: str, sensor: InteractiveSensor | None, count: int
) -> SensorMaps:
    known = display.maps.get(name)
    if known is None:
        assert sensor is not None
        frames = list(range(sensor.radar.frame_count))
        ranges, across = sensor.grid.ranges.tolist(), sensor.grid.u.tolist()
    else:
        frames, ranges, across = known.frames, known.ranges, known.across
    chosen = np.unique(np.linspace(0, len(frames) - 1, count).astype(int)).tolist()
    frames = [frames[k] for k in chosen]
    blocks = [-(-len(axis) // _MAX_BINS) for axis in (ranges, across)]

    def max_pool(power: Tensor) -> NDArray[np.float32]:
        """The strongest of each block of bins."""
        flat = power.reshape(-1, 1, *power.shape[-2:])
        pooled = torch.nn.functional.max_pool2d(flat, blocks, ceil_mode=True)
        return to_float32(pooled.reshape(*power.shape[:-2], *pooled.shape[-2:]))

    measured = None
    if known is not None and MEASURED in known.power:
        measured = max_pool(torch.from_numpy(known.power[MEASURED][chosen]))
    simulated = None if sensor is None else _simulate_maps(display, sensor, frames)
    places, rotations, origins = np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0)
    if sensor is not None:
        radar = sensor.radar.frames(frames)
        places, rotations, origins = radar.positions, radar.link().rotations, radar.origins
    rows, columns = _block_axis(ranges, blocks[0]), _block_axis(across, blocks[1])
    place, turn, origin = (to_float32(values) for values in (places, rotations, origins))
    pooled = None if simulated is None else max_pool(simulated)
    return SensorMaps(frames, (*rows, *columns), place, turn, origin, measured, pooled)


def _simulate_maps(display: Display, sensor: InteractiveSensor, frames: list[int]) -> Tensor | None:
    """Power [step, frame, range, u]; None for scenes that have no smooth map."""
    found = []
    with warnings.catch_warnings(), suppress(InputError):
        warnings.simplefilter("ignore", PhysicsWarning)  # of bins that are coarse for a fit
        for step in display.steps or [None]:
            if step is not None:
                sensor.replace_meshes(step.bodies)
            maps = [sensor.predict_map(sensor.scene, frame).float() for frame in frames]
            found.append(torch.stack(maps))
    if len(found) < max(1, len(display.steps)):
        return None
    return torch.stack(found)


def _block_axis(centers: list[float], block: int) -> tuple[float, float]:
    """Middle of the first block of bins, and the distance of blocks."""
    step = centers[1] - centers[0] if len(centers) > 1 else 1.0
    return centers[0] + (block - 1) / 2 * step, block * step
