"""Means over cells of a surface: where a coverage map is asked for.

A cell holds the mean power of a receiver that may stand anywhere in it. Powers of paths add, as
they do in the mean over places some wavelengths apart. The mean is that over points spread over the
cell. Derivatives hold boundary paths, so that the edges of shadows and of mirrored beams, which
sweep over the cells, count (derivations §11).

Where edges diffract, fields add. They have no jump at shadows, so the mean over points has its
derivative without boundary paths.
"""

import math
from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from invertwin import checks
from invertwin.channel import PathMeasure, RayPaths, trace_coverage
from invertwin.deprecation import rename_members
from invertwin.errors import InputError
from invertwin.limits import Count
from invertwin.links.places import ReceiverLocations
from invertwin.links.received import LinkStatistics, PropagationSettings, delay_spread_from_moments
from invertwin.links.transmitters import Transmitters
from invertwin.scene import Mesh, Scene

_Points = Float64[Tensor, "row 3"]
_FaceNumbers = Int64[Tensor, " row"]


@dataclass(frozen=True)
class CellSampling(checks.CheckedFields):
    """Numbers of sample points in the cells of a map.

    Attributes:
        points: Minimum number of points in a cell; a cell has the next square number of points.
        edge_points: Number of points on edges of the scene, for each transmitter; used by
            derivatives only.
        boundary: False leaves boundary paths out: derivatives at fixed visibility, for ablation.

    Raises:
        InputError: A value out of range, or boundary paths without edge points.
    """

    points: Count = 16
    edge_points: Count = 20_000
    boundary: bool = True

    @property
    def points_per_side(self) -> int:
        """Number of points along each side of a cell."""
        return math.isqrt(self.points - 1) + 1


class Cells(ReceiverLocations):
    """Cells of a surface, which hides nothing and is at rest.

    Attributes:
        sampling: Numbers of points.
    """

    sampling: CellSampling
    is_random: ClassVar[bool] = True

    def with_sampling(self, sampling: CellSampling) -> "Cells":
        """The same cells with other numbers of points.

        Args:
            sampling: Numbers of points.
        """
        return replace(self, sampling=sampling)  # type: ignore[type-var]

    def with_sample_count(self, samples: int) -> "Cells":
        """The same cells with so many points in all. See ``ReceiverLocations``."""
        return self.with_sampling(replace(self.sampling, points=max(1, samples // len(self.areas))))

    def fixed_visibility(self) -> "Cells | None":
        """The same cells without boundary paths. See ``ReceiverLocations``."""
        if not self.sampling.boundary:
            return None
        return self.with_sampling(replace(self.sampling, boundary=False))

    @abstractmethod
    def surface(self) -> Mesh:
        """The surface, in the world [m]."""

    @abstractmethod
    def sample_points(self, rng: np.random.Generator) -> Float64[Tensor, "cell point 3"]:
        """Points spread evenly over every cell [m].

        Args:
            rng: Random number generator.
        """

    @abstractmethod
    def find_cells(self, points: _Points, faces: _FaceNumbers) -> _FaceNumbers:
        """Cells that hold points of the surface.

        Args:
            points: The points [m].
            faces: Their triangles.
        """

    @property
    @abstractmethod
    def areas(self) -> Float64[Tensor, " cell"]:
        """Areas of the cells [m²]."""

    def link_statistics(
        self, scene: Scene, sensor: Transmitters, propagation: PropagationSettings, seed: int
    ) -> LinkStatistics:
        """Means over the cells. See ``ReceiverLocations``.

        The delay spread of a cell is that of the powers over excess delays: those of paths less
        that of the straight line to the same point.

        Raises:
            InputError: A reception whose fields add and jump at shadows, since no edge diffracts.
        """
        if propagation.bandwidth is not None and not propagation.edges:
            raise InputError(
                "expected a reception for cells with bandwidth None, or with edges, got bandwidth "
                f"{propagation.bandwidth} and edges 0; such fields jump at shadows: give edges=1, "
                "or leave out the bandwidth"
            )
        points = self.sample_points(np.random.default_rng(np.random.SeedSequence([seed, 1])))
        if propagation.edges:
            both = propagation.gains_and_moments(scene, sensor, points.flatten(0, 1), seed)
            gain, mean = (part.unflatten(1, points.shape[:2]).mean(2) for part in both)
            shape, spread = (len(gain), *self.shape), delay_spread_from_moments(mean)
            return LinkStatistics(gain.reshape(shape), spread.reshape(shape))

        def measure(paths: RayPaths, tx: Tensor, rx: Tensor) -> Tensor:
            return propagation.path_moments(paths, tx, rx, sensor.mount)

        places = sensor.positions, self.surface(), points.flatten(0, 1), propagation.frequency
        edges = self.sampling.edge_points if self.sampling.boundary else 0
        how: Any = {"depth": propagation.depth, "rays": propagation.rays, "seed": seed}
        lit = trace_coverage(scene, *places, PathMeasure(measure, 3), boundary_samples=edges, **how)
        mean = lit.amount.unflatten(1, points.shape[:2]).mean(2)
        for part in lit.boundary_paths:
            cell = self.find_cells(part.point, part.face)
            row = part.tx * mean.shape[1] + cell
            density = part.amount / self.areas[cell, None]
            mean = mean.flatten(0, 1).index_add(0, row, density).view(mean.shape)
        aside = propagation.panel_and_diffuse_moments(scene, sensor, points.flatten(0, 1), seed)
        mean = mean + aside.unflatten(1, points.shape[:2]).mean(2)
        shape, spread = (len(mean), *self.shape), delay_spread_from_moments(mean)
        return LinkStatistics(mean[..., 0].reshape(shape), spread.reshape(shape))


@dataclass(frozen=True, eq=False)
class MapPlane(Cells):
    """Cells of a radio map: equal parallelograms in a plane.

    Attributes:
        corner: Position of a corner of the map [3] [m].
        first, second: Side vectors of the map, from the corner [3] [m].
        count: Numbers of cells along both sides.
        sampling: Numbers of points.

    Raises:
        InputError: Wrong shapes, NaN, parallel sides, or no cell.
    """

    corner: Float64[Tensor, "3"]
    first: Float64[Tensor, "3"]
    second: Float64[Tensor, "3"]
    count: tuple[int, int]
    sampling: CellSampling = CellSampling()

    def __post_init__(self) -> None:
        for name in ("corner", "first", "second"):
            value = checks.checked_point(getattr(self, name), f"{name} of a map [m]")
            checks.set_fields(self, **{name: checks.strip_derivatives(value)})
        if not float(self._normal.norm()) > 0:
            raise InputError(
                "expected sides of a map that span an area, got parallel ones or none; give two "
                "directions"
            )
        if len(self.count) != 2 or any(not isinstance(n, int) or n < 1 for n in self.count):
            raise InputError(
                f"expected two counts of cells >= 1, got {self.count!r}; give one for each side"
            )

    @classmethod
    def horizontal(
        cls,
        low: checks.ArrayLike,
        high: checks.ArrayLike,
        height: float,
        cell_size: float,
        sampling: CellSampling = CellSampling(),
    ) -> "MapPlane":
        """Create a horizontal map of cells at height z.

        Args:
            low: Minimum x and y [2] [m].
            high: Maximum x and y [2] [m].
            height: Height z of the map [m].
            cell_size: Side length of a cell [m]; the nearest length that divides the sides of the
                map is used.
            sampling: Numbers of points.

        Raises:
            InputError: Wrong shapes or values, or a map without an area.
        """
        do = "give x and y"
        start = checks.checked_tensor(low, (2,), "low of a map [m]", do)
        end = checks.checked_tensor(high, (2,), "high of a map [m]", do)
        z = checks.checked_number(height, "height of a map [m]", -math.inf)
        size = checks.checked_number(cell_size, "size of cells [m]", 0.0, open_low=True)
        x, y = (end - start).tolist()
        if not (x > 0 and y > 0):
            raise InputError("expected high beyond low in x and y; exchange them")
        count = max(1, round(x / size)), max(1, round(y / size))
        corner = torch.cat([start, torch.tensor([z], dtype=torch.float64)])
        sides = torch.tensor([[x, 0.0, 0.0], [0.0, y, 0.0]], dtype=torch.float64)
        return cls(corner, sides[0], sides[1], count, sampling)

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of cells along the first and the second side."""
        return self.count

    @property
    def centres(self) -> Float64[Tensor, "first second 3"]:
        """Centres of the cells [m]."""
        at = [(torch.arange(n, dtype=torch.float64) + 0.5) / n for n in self.count]
        return self._point_at(at[0][:, None], at[1][None])

    @property
    def areas(self) -> Float64[Tensor, " cell"]:
        """Areas of the cells [m²]."""
        cells = self.count[0] * self.count[1]
        return (self._normal.norm() / cells).expand(cells)

    def surface(self) -> Mesh:
        """Two triangles. See ``Cells.surface``."""
        a, u, v = self.corner, self.first, self.second
        return Mesh(torch.stack([a, a + u, a + u + v, a + v]), _TRIANGLES)

    def sample_points(self, rng: np.random.Generator) -> Float64[Tensor, "cell point 3"]:
        """Sample one random point in each square of a finer grid. See ``Cells.sample_points``."""
        side = self.sampling.points_per_side
        lattice = [side * n for n in self.count]
        jitter = torch.from_numpy(rng.random((2, *lattice)))
        s = (torch.arange(lattice[0])[:, None] + jitter[0]) / lattice[0]
        t = (torch.arange(lattice[1]) + jitter[1]) / lattice[1]
        points = self._point_at(s, t).view(self.count[0], side, self.count[1], side, 3)
        return points.transpose(1, 2).reshape(-1, side * side, 3)

    def find_cells(self, points: _Points, faces: _FaceNumbers) -> _FaceNumbers:
        """Find the cells that contain points of the plane. See ``Cells.find_cells``."""
        offset, n = points - self.corner, self._normal
        n = n / n.square().sum()
        i = (torch.linalg.cross(offset, self.second.expand_as(offset)) @ n * self.count[0]).floor()
        j = (torch.linalg.cross(self.first.expand_as(offset), offset) @ n * self.count[1]).floor()
        i = i.long().clamp(0, self.count[0] - 1)
        return i * self.count[1] + j.long().clamp(0, self.count[1] - 1)

    @property
    def _normal(self) -> Tensor:
        return torch.linalg.cross(self.first, self.second)

    def _point_at(self, s: Tensor, t: Tensor) -> Tensor:
        return self.corner + s[..., None] * self.first + t[..., None] * self.second


_TRIANGLES = torch.tensor([[0, 1, 2], [0, 2, 3]])


@dataclass(frozen=True, eq=False)
class MapMesh(Cells):
    """Cells of a radio map: the triangles of a mesh.

    Attributes:
        mesh: Mesh in world axes [m]; at a surface of the scene, keep it some millimetres away from
            the surface.
        sampling: Numbers of points.

    Raises:
        InputError: A triangle without area.
    """

    mesh: Mesh
    sampling: CellSampling = CellSampling()

    def __post_init__(self) -> None:
        vertices = checks.strip_derivatives(self.mesh.vertices)
        checks.set_fields(self, mesh=replace(self.mesh, vertices=vertices))
        if not bool((self.areas > 0).all()):
            raise InputError(
                "expected triangles with an area for the cells of a map, got one without; remove it"
            )

    @property
    def shape(self) -> tuple[int]:
        """(number of triangles,)."""
        return (len(self.mesh.faces),)

    @property
    def areas(self) -> Float64[Tensor, " cell"]:
        """Areas of the cells [m²]."""
        return self.mesh.triangle_areas

    def surface(self) -> Mesh:
        """The mesh. See ``Cells.surface``."""
        return self.mesh

    def sample_points(self, rng: np.random.Generator) -> Float64[Tensor, "cell point 3"]:
        """Sample a random point in each equal part of a triangle. See ``Cells.sample_points``."""
        side, cells = self.sampling.points_per_side, len(self.mesh.faces)
        jitter = torch.from_numpy(rng.random((2, cells, side, side)))
        steps = torch.arange(side, dtype=torch.float64)
        # A square, of which the root of one side makes a triangle of even density.
        far = ((steps[:, None] + jitter[0]) / side).sqrt().flatten(1)[..., None]
        across = ((steps + jitter[1]) / side).flatten(1)[..., None]
        a, b, c = (corner[:, None] for corner in self.mesh.vertices[self.mesh.faces].unbind(1))
        return a + far * (b - a + across * (c - b))

    def find_cells(self, points: _Points, faces: _FaceNumbers) -> _FaceNumbers:
        """The triangles. See ``Cells.find_cells``."""
        return faces


rename_members(Cells, cell_of="find_cells", drawn="sample_points", sampled="with_sampling")
