"""Radio maps of run files: receiver positions, and measured levels."""

from collections.abc import Sequence
from io import StringIO
from typing import Annotated, Literal

import numpy as np
import torch
from annotated_types import Ge, Len, MinLen
from torch import Tensor

from invertwin import links
from invertwin.limits import Count, NonNegative, Positive
from invertwin.registry.kinds import KindGroup, Registry
from invertwin.registry.section import InputPath, Section, Seed, Vector, prefix_errors
from invertwin.scene import load_mesh
from invertwin.storage.untrusted import convert_read_errors, read_text


class ReceivedData(Section):
    """Simulated levels of receivers in the true scene, with errors; keys that differ from [map].

    Attributes:
        positions: m, where the transmitters really are; without it those of [transmitter]
        noise: standard deviation of the errors, in the unit of the map
        bandwidth: without it that of [map]
        depth: without it that of [map]
        edges: without it that of [map]
        rays: without it those of [map]
        seed: seed of errors and rays; without it the run's
    """

    kind: Literal["received"]
    positions: Annotated[list[Vector], MinLen(1)] | None = None
    noise: NonNegative = 0.0
    bandwidth: NonNegative | None = None
    depth: Annotated[int, Ge(0)] | None = None
    edges: Annotated[int, Ge(0)] | None = None
    rays: Count | None = None
    seed: Seed | None = None


class ReceivedFile(Section):
    """Measured levels: rows of x, y, z and one level for each transmitter, with one header line.

    The places of the rows stand in for those of [map].

    Attributes:
        file: CSV: x,y,z [m], then the levels
    """

    kind: Literal["received_file"]
    file: InputPath

    def read(self) -> tuple[links.ReceiverPoints, Tensor]:
        """Read receiver positions, and levels [tx, position].

        Raises:
            InputError: No such file, or no numbers.
        """
        with prefix_errors("file"):
            rows = _read_rows(self.file, 4)
        return links.ReceiverPoints(rows[:, :3]), rows[:, 3:].T


def register(registry: Registry) -> None:
    """Add receiver positions of radio maps, and data of received levels."""
    registry.groups["places"] = KindGroup(product=links.ReceiverLocations, default="points")
    registry.add("places", "points", links.ReceiverPoints)
    registry.add("places", "random", random_points)
    registry.add("places", "file", points_file, untagged=True)
    registry.add("places", "plane", plane_cells)
    registry.add("places", "mesh", mesh_cells)
    registry.add("data", "received", ReceivedData)
    registry.add("data", "received_file", ReceivedFile)
    registry.add("parameter", "reverberation", links.ReverberationParameters)
    given = ("initial", "number", "scene")
    registry.add("parameter", "transmitter", links.TransmitterPosition, without=given)


def random_points(
    low: Sequence[float], high: Sequence[float], count: Count, seed: Annotated[int, Ge(0)] = 0
) -> links.ReceiverPoints:
    """Random points in a box, evenly spread.

    Args:
        low: corner of the box [m].
        high: the opposite corner [m].
        count: number of points.
        seed: seed of the points.
    """
    generator = torch.Generator().manual_seed(seed)
    ends = [torch.tensor(corner, dtype=torch.float64) for corner in (low, high)]
    share = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    return links.ReceiverPoints(ends[0] + share * (ends[1] - ends[0]))


def points_file(file: InputPath) -> links.ReceiverPoints:
    """Points of a CSV file with one header line: x,y,z [m].

    Args:
        file: path, from the run file's folder.
    """
    with prefix_errors("file"):
        return links.ReceiverPoints(_read_rows(file, 3)[:, :3])


def plane_cells(
    low: Annotated[Sequence[float], Len(2, 2)],
    high: Annotated[Sequence[float], Len(2, 2)],
    height: float,
    cell: Positive,
    points: Count = 16,
    edge_points: Count = 20_000,
) -> links.MapPlane:
    """Means over the cells of a horizontal rectangle.

    Args:
        low: least x and y [m].
        high: greatest x and y [m].
        height: z [m].
        cell: length of a cell's sides; the nearest that divides the sides of the map [m].
        points: least number of points in a cell.
        edge_points: points on edges of the scene, for each transmitter; for derivatives only.
    """
    sampling = links.CellSampling(points, edge_points)
    return links.MapPlane.horizontal(low, high, height, cell, sampling)


def mesh_cells(file: InputPath, points: Count = 16, edge_points: Count = 20_000) -> links.MapMesh:
    """Means over the triangles of a mesh.

    Args:
        file: PLY, OBJ, STL or GLB, in metres; path, from the run file's folder.
        points: least number of points in a triangle.
        edge_points: points on edges of the scene, for each transmitter; for derivatives only.
    """
    with prefix_errors("file"):
        return links.MapMesh(load_mesh(file), links.CellSampling(points, edge_points))


def _read_rows(file: str, min_columns: int) -> Tensor:
    what = "rows of numbers apart by commas below a line of heads"
    with convert_read_errors(file, what, "see docs/run_files.md"):
        # As text: NumPy would expand archives, and fetch addresses.
        rows = np.loadtxt(StringIO(read_text(file, what)), delimiter=",", skiprows=1, ndmin=2)
        if rows.shape[1] < min_columns or not len(rows) or not np.isfinite(rows).all():
            raise ValueError(f"{rows.shape}, not rows of at least {min_columns} finite numbers")
    return torch.from_numpy(rows)
