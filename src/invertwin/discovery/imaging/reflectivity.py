"""Maximum-likelihood reflectivity image of all maps."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy import sparse
from torch import Tensor

from invertwin.channel import Grid
from invertwin.discovery.imaging.likelihood import TAIL_DEGREES, MapAxis, map_axes
from invertwin.inversion import speckle_weight
from invertwin.radar import Radar
from invertwin.radar.aperture import aperture
from invertwin.runtime.memory import require_at_most
from invertwin.runtime.progress import track

_MIN_RELATIVE_RESPONSE = 1e-3  # relative to the peak of a response: smaller entries are dropped
_MIN_RESPONSE = 1e-30  # smaller responses are invisible points [1/m²]
_TABLE_STEPS_PER_BIN = 32  # entries of a kernel's table per bin
_TABLE_MIDDLE = 16 * _TABLE_STEPS_PER_BIN  # entry of lag 0
_STEPS = 40  # multiplicative updates
_MAX_MATRIX_ENTRIES = 8e7  # entries of the matrix, 8 bytes each
_Maps = Float64[Tensor, "frame range u v"]  # power of every frame


@dataclass(frozen=True, eq=False)
class ImageResponse:
    """Response of scatterers at image points in all bins of all maps.

    Attributes:
        matrix: power per radar cross-section [1/m²], bins × points, frames slowest.
        shape: shape of the maps.
    """

    matrix: sparse.csr_matrix
    shape: tuple[int, ...]

    def predict_maps(self, strength: Float64[Tensor, " point"]) -> _Maps:
        """Predict the maps of scatterers.

        Args:
            strength: radar cross-section of every point [m²].
        """
        return torch.from_numpy(self.matrix @ strength.numpy()).reshape(self.shape)

    def average_over_bins(self, values: _Maps) -> Float64[Tensor, "frame point"]:
        """Average values over the bins of every point, frame by frame.

        Args:
            values: values of all bins.
        """
        bins = int(np.prod(self.shape[1:]))
        found = []
        for frame, row in enumerate(values.numpy().reshape(len(values), -1)):
            part = sparse.csc_matrix(self.matrix[frame * bins : (frame + 1) * bins].T)
            found.append((part @ row) / np.maximum(part @ np.ones(bins), _MIN_RESPONSE))
        return torch.from_numpy(np.stack(found))


def thin_map(
    power: Float[Tensor, "frame range u v"], radar: Radar, grid: Grid
) -> tuple[Float64[Tensor, "frame some_range some_u some_v"], Grid]:
    """Select one bin of a map for each resolution cell of range and direction: nearly independent
    bins.

    Args:
        power: maps [frame, range, u, v].
        radar: radar whose bandwidth and array determine the cells.
        grid: bins of the maps.
    """
    array = aperture(radar)
    across, up = (direction_cell(places, radar) for places in (array.y, array.z))
    some, changes = power.detach().double(), dict[str, Any]()
    cells = {"range": radar.waveform.range_resolution, "u": across, "v": up}
    for dim, (name, cell) in enumerate(cells.items(), 1):
        step = getattr(grid, f"{name}_step")
        stride = max(1, round(cell / step)) if some.shape[dim] > 1 else 1
        some = some[(slice(None),) * dim + (slice(None, None, stride),)]
        changes |= {f"{name}_step": stride * step, f"{name}_count": some.shape[dim]}
    return some, replace(grid, **changes)


def direction_cell(positions: Float64[Tensor, " point"], radar: Radar) -> float:
    """Return the beamwidth of elements in direction cosines.

    Args:
        positions: positions of the elements along one axis [m].
        radar: radar with its wavelength.
    """
    if len(positions) == 1:
        return 2.0
    extent = float(positions.max() - positions.min()) * len(positions) / (len(positions) - 1)
    return radar.waveform.wavelength / extent


def compute_response(
    radar: Radar, grid: Grid, positions: Float64[Tensor, "point 3"]
) -> ImageResponse:
    """Compute the response of a radar to isotropic scatterers in free space.

    Args:
        radar: radar with its positions.
        grid: bins of the maps.
        positions: image points in world axes [point, 3] [m].

    Raises:
        InputError: More points than memory allows, or a pulsed radar.
    """
    link, shape = radar.link(), (radar.frame_count, *grid.shape)
    tables = [_AxisResponseTable.from_axis(axis) for axis in map_axes(radar, grid)]
    pairs = np.prod([len(table.offsets) for table in tables])
    estimate = float(len(positions) * radar.frame_count * pairs)
    do = "look at a smaller region, or with a coarser step"
    require_at_most(estimate, 4 * _MAX_MATRIX_ENTRIES, "pairs of points and bins", do)
    columns = np.arange(len(positions), dtype=np.int32)
    frames = []
    for frame in track(range(radar.frame_count), "responses of image points"):
        lengths, seen = [], []
        for ends in (link.tx, link.rx):
            direction = positions - ends[frame].detach()
            lengths.append(direction.norm(dim=1))
            seen.append(direction / lengths[-1][:, None] @ link.rotations[frame].detach())
        gain = link.tx_pattern.gain(seen[0]) * link.rx_pattern.gain(seen[1])
        gain = gain * radar.waveform.wavelength**2 / (4 * torch.pi) ** 3
        strength = (gain / (lengths[0] * lengths[1]) ** 2).numpy()
        where = (0.5 * (lengths[0] + lengths[1]), seen[1][:, 1], seen[1][:, 2])
        row, value = np.zeros((len(positions), 1), dtype=np.int64), np.ones((len(positions), 1))
        inside = np.ones((len(positions), 1), dtype=bool)
        for table, place in zip(tables, where, strict=True):
            bins, part = table.near_bins(place.numpy())
            valid = (bins >= 0) & (bins < table.count)
            row = (row[:, :, None] * table.count + bins[:, None]).reshape(len(positions), -1)
            value = (value[:, :, None] * part[:, None]).reshape(len(positions), -1)
            inside = (inside[:, :, None] & valid[:, None]).reshape(len(positions), -1)
        kept = inside & (value > _MIN_RELATIVE_RESPONSE) & (strength[:, None] > 0)
        index = np.broadcast_to(columns[:, None], kept.shape)[kept]
        entries = (value * strength[:, None])[kept].astype(np.float32)
        places = row[kept].astype(np.int32), index
        size = int(np.prod(grid.shape)), len(positions)
        frames.append(sparse.csr_matrix((entries, places), shape=size))
    return ImageResponse(sparse.csr_matrix(sparse.vstack(frames)), shape)


def reconstruct_reflectivity(
    response: ImageResponse, power: _Maps, known_power: _Maps
) -> Float64[Tensor, " point"]:
    """Compute the maximum-likelihood reflectivity by multiplicative updates.

    Each step multiplies the strength of a point by the square root of the ratio of observed to
    predicted power in its bins, so that it stays positive. Outlier bins have lower weights, as in
    ``HeavyTailedLoss``.

    Source: Févotte, Bertin and Durrieu, "Nonnegative matrix factorization with the Itakura–Saito
    divergence", Neural Computation 21, 2009.
    Differs from the source: the responses are known; speckle is heavy-tailed.

    Args:
        response: response of the points.
        power: measured maps.
        known_power: power of known objects and of the background.

    Returns:
        Radar cross-section of every point [m²].
    """
    matrix = response.matrix
    back = sparse.csc_matrix(matrix.T)
    data = power.numpy().astype(np.float32).reshape(-1)
    known = known_power.numpy().astype(np.float32).reshape(-1)
    total = np.asarray(matrix.sum(axis=0)).ravel()
    excess = np.maximum(data - known, 0.0)
    strength = np.full(len(total), excess.sum() / total.sum(), dtype=np.float32)
    strength[total <= 0] = 0.0
    for _ in track(range(_STEPS), "sharp image"):
        mean = matrix @ strength + known
        ratio = data / mean
        brighter = back @ (ratio * speckle_weight(ratio, TAIL_DEGREES) / mean)
        strength *= np.sqrt(brighter / np.maximum(back @ (1 / mean), 1e-30))
    return torch.from_numpy(strength.astype(np.float64))


@dataclass(frozen=True, eq=False)
class _AxisResponseTable:
    """Tabulated response along one axis of the map, in bins from its centre."""

    start: float
    step: float
    count: int
    offsets: np.ndarray  # bins within the response
    table: np.ndarray

    @classmethod
    def from_axis(cls, axis: MapAxis) -> "_AxisResponseTable":
        start, step, count = axis.start, axis.step, axis.count
        if count == 1:
            return cls(start, step, 1, np.zeros(1, dtype=np.int64), np.ones(1))
        lags = torch.arange(-_TABLE_MIDDLE, _TABLE_MIDDLE + 1, dtype=torch.float64)
        power = axis.response(lags / _TABLE_STEPS_PER_BIN)
        # Up to the first null: sidelobes are below the background of most recordings.
        middle = _TABLE_MIDDLE
        rising = (power[middle + 1 :] > power[middle:-1]).nonzero()
        reach = int(rising[0]) if len(rising) else middle
        power[: middle - reach] = 0.0
        power[middle + reach + 1 :] = 0.0
        half = reach // _TABLE_STEPS_PER_BIN + 1
        return cls(start, step, count, np.arange(-half, half + 1), power.numpy())

    def near_bins(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the bins near positions [point, n], and the response there."""
        if self.count == 1:
            return np.zeros((len(positions), 1), dtype=np.int64), np.ones((len(positions), 1))
        at = (positions - self.start) / self.step
        bins = np.round(at).astype(np.int64)[:, None] + self.offsets
        lag = np.round((bins - at[:, None]) * _TABLE_STEPS_PER_BIN).astype(np.int64)
        return bins, self.table[lag + _TABLE_MIDDLE]
