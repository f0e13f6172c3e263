"""Signed distances on a grid and as a neural field: shapes of free topology."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Annotated

import igl
import numpy as np
import torch
from annotated_types import Ge, Le
from jaxtyping import Float64
from torch import Tensor, nn

from invertwin.checks import ArrayLike, Counts, Point, checked_count, checked_number, checked_tensor
from invertwin.limits import NonNegative, Positive
from invertwin.scene.mesh import Mesh
from invertwin.scene.parameters import ObjectModule
from invertwin.scene.shape_models.iso_surface import iso_surface
from invertwin.scene.shape_models.lattice import Lattice, interpolate_cubic

_Samples = Float64[Tensor, "x y z"]


def signed_distance(mesh: Mesh, points: Float64[Tensor, "p 3"]) -> Float64[Tensor, " p"]:
    """Compute the signed distance of points to a surface [m], negative inside (winding number).

    Overlapping parts of a closed mesh count as their union. At a hole in a mesh the sign changes
    where half of the solid angle meets the surface.

    Args:
        mesh: the surface.
        points: positions in the mesh's frame [p, 3] [m].
    """
    if not len(points):
        return torch.zeros(0, dtype=torch.float64)
    places = points.detach().numpy()
    surface = mesh.vertices.detach().numpy(), mesh.faces.numpy()
    square = igl.point_mesh_squared_distance(places, *surface)[0]
    inside = np.asarray(igl.winding_number(*surface, places)) > 0.5
    return torch.from_numpy(np.where(inside, -1.0, 1.0) * np.sqrt(square))


class _Distance(ObjectModule):
    """Base of distance fields whose zero is the object's surface.

    The material must not have values per triangle, nor the object velocities per vertex.
    """

    def __init__(self, object: str, low: ArrayLike, high: ArrayLike, counts: Sequence[int]) -> None:
        super().__init__(object)
        self.lattice = Lattice.from_bounds(low, high, counts)

    def distance(self, points: Float64[Tensor, "p 3"]) -> Float64[Tensor, " p"]:
        """Return the field at points in the object's frame [m]: negative inside."""
        raise NotImplementedError

    def update_mesh(self, mesh: Mesh) -> Mesh:
        """Return the present surface, remeshed.

        Raises:
            InputError: no surface in the box.
        """
        return iso_surface(self.distance, self.lattice)


class DistanceGrid(_Distance):
    """Surface as the zero of signed distances at the nodes of a grid.

    Between nodes the field is that of cubic convolution (Catmull–Rom): it has the nodes' values and
    a continuous gradient. With smoothing λ the distances are ``(I + λL)⁻¹ value``, L the graph
    Laplacian of the grid: rough components of a gradient are attenuated, as by ``SmoothVertices``.

    Args:
        object: name of the object.
        low, high: opposite corners of the grid in the object's frame [m].
        value: signed distances at the nodes [m], at least two along each axis.
        smoothing: λ; detail below about √λ spacings is attenuated.

    Attributes:
        value: parameter [x, y, z], metres; without smoothing the distances, negative inside.

    Raises:
        InputError: wrong shapes, NaN, a box without volume, or a negative λ.
    """

    def __init__(
        self, object: str, low: ArrayLike, high: ArrayLike, value: _Samples, smoothing: float = 0.0
    ) -> None:
        do = "give one for each node"
        given = checked_tensor(value, (None, None, None), "signed distances [m]", do)
        super().__init__(object, low, high, tuple(given.shape))
        self._smoother = GridSmoother(given.shape, checked_number(smoothing, "smoothing λ", 0))
        self.value = nn.Parameter(self._smoother.power(1, given.detach()).clone())

    @classmethod
    def from_function(
        cls,
        object: str,
        low: ArrayLike,
        high: ArrayLike,
        counts: Sequence[int],
        distance: Callable[[Tensor], Tensor],
        smoothing: float = 0.0,
    ) -> "DistanceGrid":
        """Build a grid from a function of signed distance.

        Args:
            object: name of the object.
            low, high: opposite corners of the box in the object's frame [m].
            counts: nodes along x, y and z.
            distance: signed distance [m] of points [p, 3], negative inside.
            smoothing: λ of the class.
        """
        lattice = Lattice.from_bounds(low, high, counts)
        with torch.no_grad():
            value = distance(lattice.nodes.reshape(-1, 3))
        return cls(object, low, high, value.reshape(lattice.counts), smoothing)

    @classmethod
    def from_mesh(
        cls,
        object: str,
        low: Point,
        high: Point,
        counts: Counts,
        mesh: Mesh,
        smooth: NonNegative = 0.0,
    ) -> "DistanceGrid":
        """Build a grid from the signed distance of a mesh.

        Args:
            object: name of the object.
            low, high: opposite corners of the box in the object's frame [m].
            counts: nodes along x, y and z.
            mesh: initial mesh in the object's frame.
            smooth: λ of steps preconditioned by (I + λL)⁻²; 0 = no preconditioning.

        Raises:
            InputError: as the class.
        """
        return cls.from_function(object, low, high, counts, partial(signed_distance, mesh), smooth)

    @property
    def distances(self) -> _Samples:
        """Return signed distances at the nodes [m]."""
        return self._smoother.power(-1, self.value)

    def distance(self, points: Float64[Tensor, "p 3"]) -> Float64[Tensor, " p"]:
        """Return the field at points in the object's frame [m]: negative inside."""
        return interpolate_cubic(self.distances, self.lattice, points)


class GridSmoother:
    """Matrix I + λL of a grid, L its graph Laplacian, diagonalised by cosine transforms.

    Args:
        shape: number of nodes along each axis.
        amount: λ.
    """

    def __init__(self, shape: Sequence[int], amount: float) -> None:
        self.amount = amount
        modes = [torch.arange(count, dtype=torch.float64) for count in shape]
        waves = [torch.cos(torch.pi * k * (k[:, None] + 0.5) / len(k)) for k in modes]
        self._waves = [wave / wave.norm(dim=0) for wave in waves]
        # L is the sum of second differences along the axes, and so are its eigenvalues.
        x, y, z = (2 - 2 * torch.cos(torch.pi * k / len(k)) for k in modes)
        self._factors = 1 + amount * (x[:, None, None] + y[:, None] + z)

    def power(self, exponent: int, values: Tensor) -> Tensor:
        """Return (I + λL)ⁿ times values at the nodes.

        Args:
            exponent: exponent n.
            values: values [x, y, z].
        """
        if self.amount == 0:
            return values
        x, y, z = self._waves
        spectrum = torch.einsum("xyz,xa,yb,zc->abc", values, x, y, z) * self._factors**exponent
        return torch.einsum("abc,xa,yb,zc->xyz", spectrum, x, y, z)


class NeuralDistance(_Distance):
    """Surface as the zero of a small sine network, initially a sphere.

    ``f(x) = |x − c| − r + h · net((x − c)/h)``, c and h the centre and the half diagonal of the
    box; the last layer is initially zero.

    Args:
        object: name of the object.
        low, high: opposite corners of the box in the object's frame [m].
        counts: nodes along x, y and z at which the field is meshed.
        radius: initial radius of the sphere [m].
        width: number of sines per layer.
        depth: number of layers of sines.
        frequency: frequency of the first layer, in radians over the box's half diagonal: higher for
            finer detail.
        seed: seed of the initial weights.

    Attributes:
        layers: linear layers of the network, sin(frequency · layer) after the first, sin(layer)
            after the others.

    Raises:
        InputError: a box without volume, or a number that is not positive.
    """

    def __init__(
        self,
        object: str,
        low: Point,
        high: Point,
        counts: Counts,
        *,
        radius: Positive,
        width: Annotated[int, Ge(1), Le(4096)] = 32,
        depth: Annotated[int, Ge(1), Le(64)] = 2,
        frequency: Positive = 8.0,
        seed: int = 0,
    ) -> None:
        super().__init__(object, low, high, counts)
        self.radius = checked_number(radius, "radius [m]", 0.0, open_low=True)
        self.frequency = checked_number(frequency, "frequency", 0.0, open_low=True)
        size = checked_count(width, "width of a layer", 1)
        widths = [3, *[size] * checked_count(depth, "layers of sines", 1), 1]
        generator = torch.Generator().manual_seed(seed)
        self.layers = nn.ModuleList()
        for k, (fan_in, fan_out) in enumerate(pairwise(widths)):
            layer = nn.Linear(fan_in, fan_out, dtype=torch.float64)
            # Sitzmann et al. 2020: the sines' arguments have a spread of one in every layer.
            bound = 1 / fan_in if k == 0 else math.sqrt(6 / fan_in)
            bound = 0.0 if k == len(widths) - 2 else bound
            for values in (layer.weight, layer.bias):
                start = torch.rand(values.shape, generator=generator, dtype=torch.float64)
                values.data = bound * (2 * start - 1)
            self.layers.append(layer)

    def distance(self, points: Float64[Tensor, "p 3"]) -> Float64[Tensor, " p"]:
        """Return the field at points in the object's frame [m]: negative inside."""
        center = (self.lattice.low + self.lattice.high) / 2
        half = float((self.lattice.high - self.lattice.low).norm()) / 2
        away = points - center
        hidden, scale = away / half, self.frequency
        for layer in list(self.layers)[:-1]:
            hidden, scale = torch.sin(scale * layer(hidden)), 1.0
        return away.norm(dim=1) - self.radius + half * self.layers[-1](hidden)[:, 0]
