"""Learned shape prior: a short latent decodes to a signed distance, which is meshed."""

from collections.abc import Iterator, Sequence
from functools import cache
from importlib import resources
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor, nn

from invertwin.checks import ArrayLike, checked_tensor
from invertwin.errors import InputError
from invertwin.scene.mesh import Mesh
from invertwin.scene.parameters import ObjectModule
from invertwin.scene.shape_models.iso_surface import Field, attach_shape_derivative, extract_surface
from invertwin.scene.shape_models.lattice import (
    Lattice,
    interpolate_cubic,
    interpolate_cubic_slices,
)
from invertwin.storage.untrusted import read_arrays, safe_reader

_Latent = Float64[Tensor, " k"]
_MODEL = "vehicle_prior.npz"
_FORMAT = "invertwin shape prior 1"
_SPACING = 0.1  # default node spacing of meshed shapes [m]


class Decoder(nn.Module):
    """Decoder of latents to signed distances [m] at the nodes of half a grid, y ≥ 0, mirrored.

    ``d = mean + basis · (straight · z + leave · tanh(enter · z))``: a network of the latent weights
    learned fields, so that decoding costs one matrix product.

    Args:
        latent: number of coordinates.
        width: size of the hidden layer.
        features: number of learned fields.
        nodes: number of nodes in half a grid.
    """

    def __init__(self, latent: int, width: int, features: int, nodes: int) -> None:
        super().__init__()
        self.enter = nn.Linear(latent, width)
        self.leave = nn.Linear(width, features)
        self.straight = nn.Linear(latent, features, bias=False)
        self.basis = nn.Linear(features, nodes)

    def forward(self, latent: Float[Tensor, "*any latent"]) -> Float[Tensor, "*any nodes"]:
        """Return distances at the nodes, x slowest."""
        return self.basis(self.straight(latent) + self.leave(torch.tanh(self.enter(latent))))


class ShapePrior:
    """Family of shapes with mirror symmetry in y, decoded from latents of unit variance.

    Latents of the training shapes have zero mean and unit variance along each coordinate, so ½ |z|²
    is their negative log prior probability, and z = 0 is the mean shape. Coordinates are ordered by
    explained variation.

    Args:
        decoder: decoder network.
        lattice: nodes of both halves.

    Attributes:
        decoder: the network, float64, without gradients.
        lattice: the decoder's nodes, both halves.
        latent_size: number of coordinates of a shape.
        low, high: corners of the box that holds all shapes [m].

    Raises:
        InputError: a network for another number of nodes, or nodes not symmetric in y.
    """

    limit = 6.0
    """Standard deviations within which a latent decodes to something like its kind."""

    def __init__(self, decoder: Decoder, lattice: Lattice) -> None:
        x, y, z = lattice.counts
        mirrors = y % 2 == 1 and bool(torch.isclose(lattice.low[1], -lattice.high[1]))
        if not mirrors or decoder.basis.out_features != x * (y + 1) // 2 * z:
            raise InputError(
                "expected a decoder of half the nodes of a lattice that mirrors in y, got "
                f"{decoder.basis.out_features} for {lattice.counts}; give those of one prior"
            )
        self.decoder = decoder.double().requires_grad_(False)
        self.lattice = lattice
        self.latent_size = decoder.enter.in_features
        self.low, self.high = lattice.low, lattice.high
        self._last: tuple[tuple[int, ...], Tensor, tuple[Tensor, Tensor, Tensor]] | None = None

    def nodes(self, counts: Sequence[int] | None = None, *, sliced: bool = False) -> Lattice:
        """Return nodes in the box; by default about 0.1 m apart.

        Args:
            counts: number of nodes along x, y and z.
            sliced: see `Lattice.from_bounds`.

        Raises:
            InputError: fewer than two nodes along an axis.
        """
        if counts is None:
            counts = (((self.high - self.low) / _SPACING - 1e-9).ceil().int() + 1).tolist()
        return Lattice.from_bounds(self.low, self.high, counts, sliced=sliced)

    def values(self, latent: _Latent) -> Float64[Tensor, "x y z"]:
        """Return signed distances at the decoder's nodes [m], negative inside.

        Raises:
            InputError: a latent of another size, not finite, or out of range.
        """
        x, y, z = self.lattice.counts
        half = self.decoder(self._check_latent(latent)).reshape(x, (y + 1) // 2, z)
        return torch.cat([half[:, 1:].flip(1), half], dim=1)

    def distance(self, points: Float64[Tensor, "p 3"], latent: _Latent) -> Float64[Tensor, " p"]:
        """Return the field at points in the shape's frame [m], negative inside.

        Args:
            points: positions [p, 3] [m].
            latent: latent coordinates in standard deviations.
        """
        return interpolate_cubic(self.values(latent), self.lattice, points)

    def slices(self, latent: _Latent, counts: Sequence[int]) -> Iterator[Float64[Tensor, "y z"]]:
        """Yield the field at the nodes of a lattice in the box, plane by plane along x [m].

        Only one plane is in memory.

        Args:
            latent: latent coordinates in standard deviations.
            counts: number of nodes along x, y and z.

        Raises:
            InputError: as `values`, or fewer than two nodes along an axis.
        """
        values, target = self.values(latent), self.nodes(counts, sliced=True)
        return interpolate_cubic_slices(values, self.lattice, target)

    def decode(self, latent: _Latent, counts: Sequence[int]) -> Float64[Tensor, "x y z"]:
        """Return the whole field at the nodes of a lattice in the box [m].

        Args:
            latent: latent coordinates in standard deviations.
            counts: number of nodes along x, y and z.
        """
        return torch.stack(list(self.slices(latent, counts)))

    def mesh(self, latent: _Latent, counts: Sequence[int] | None = None) -> Mesh:
        """Return the surface of a latent, whose vertices follow it (see :func:`iso_surface`).

        Args:
            latent: latent coordinates in standard deviations.
            counts: number of nodes along x, y and z, see `nodes`.
        """
        values = self.values(latent)
        points, faces, slope = self._surface(values.detach(), self.nodes(counts))
        return Mesh(attach_shape_derivative(self._field(values), points, slope), faces)

    def mean_mesh(self, counts: Sequence[int] | None = None) -> Mesh:
        """Return the surface of z = 0."""
        return self.mesh(torch.zeros(self.latent_size, dtype=torch.float64), counts)

    def save(self, file: str | Path) -> None:
        """Write the prior as ``.npz``, with the network in half precision."""
        state = self.decoder.state_dict()
        weights = {name: w.numpy().astype(np.float16) for name, w in state.items()}
        box = {name: np.asarray(value) for name, value in vars(self.lattice).items()}
        np.savez_compressed(file, format=_FORMAT, **box, **weights)

    def _surface(self, values: Tensor, target: Lattice) -> tuple[Tensor, Tensor, Tensor]:
        """Return vertices, triangles and the field's gradient, cached for derivatives."""
        last = self._last
        if last is None or last[0] != target.counts or not torch.equal(last[1], values):
            known = torch.stack(list(interpolate_cubic_slices(values, self.lattice, target)))
            found = extract_surface(self._field(values), target, known)
            last = self._last = target.counts, values, found
        return last[2]

    def _field(self, values: Tensor) -> Field:
        return lambda at: interpolate_cubic(values, self.lattice, at)

    def _check_latent(self, latent: Tensor) -> Tensor:
        """Validate a latent."""
        do = f"give {self.latent_size} numbers in standard deviations"
        given = checked_tensor(latent, (self.latent_size,), "latent", do)
        most = float(given.detach().abs().max())
        if most > self.limit:
            raise InputError(
                f"expected a latent within ±{self.limit:g} standard deviations, got {most:.3g}; "
                "raise the weight of its regulariser or lower the learning rate"
            )
        return given


class PriorShape(ObjectModule):
    """Replace an object's mesh by a shape decoded from a prior, remeshed at every step.

    The material must not have values per triangle, nor the object velocities per vertex.

    Args:
        object: name of the object; its pose is kept.
        prior: shape prior; None = the packaged one of vehicles.
        initial: initial coordinates in standard deviations; None = mean shape.
        counts: number of nodes along x, y and z of the meshing; None = the prior's.

    Attributes:
        latent: parameter [k], in standard deviations.

    Raises:
        InputError: coordinates of another number, not finite, or out of range.
    """

    reported = ("latent",)

    def __init__(
        self,
        object: str,
        prior: ShapePrior | None = None,
        initial: ArrayLike | None = None,
        counts: Sequence[int] | None = None,
    ) -> None:
        super().__init__(object)
        self.prior = load_prior() if prior is None else prior
        self.lattice = self.prior.nodes(counts)
        start = torch.zeros(self.prior.latent_size) if initial is None else initial
        start = checked_tensor(start, (None,), "latent", "give numbers in standard deviations")
        self.prior.values(start.detach())
        self.latent = nn.Parameter(start.detach().clone())

    def distance(self, points: Float64[Tensor, "p 3"]) -> Float64[Tensor, " p"]:
        """Return the present field at points in the object's frame [m]: negative inside."""
        return self.prior.distance(points, self.latent)

    def update_mesh(self, mesh: Mesh) -> Mesh:
        """Return the decoded mesh.

        Raises:
            InputError: a latent out of range.
        """
        return self.prior.mesh(self.latent, self.lattice.counts)


def load_prior(file: str | Path | None = None) -> ShapePrior:
    """Load a prior of `ShapePrior.save` or ``invertwin train-prior``.

    Args:
        file: path; None = the packaged prior of vehicles. It decodes bodies without wheels: x
            ahead, y to the left, z up, the origin on the ground below the middle of the wheelbase,
            metres.

    Raises:
        InputError: no such file, or not a prior.
    """
    return _load_default_prior() if file is None else _read(Path(file))


@cache
def _load_default_prior() -> ShapePrior:
    with resources.as_file(resources.files("invertwin.scene.geometry") / _MODEL) as file:
        return _read(file)


@safe_reader("a shape prior")
def _read(path: Path) -> ShapePrior:
    do = "give a file of invertwin train-prior"
    found = read_arrays(path, do)
    try:
        if str(found.pop("format")) != _FORMAT:
            raise ValueError("another format")
        low, high, counts = (found.pop(name) for name in ("low", "high", "counts"))
        weights = {name: torch.from_numpy(w.astype(np.float64)) for name, w in found.items()}
        width, latent = weights["enter.weight"].shape
        nodes, features = weights["basis.weight"].shape
        decoder = Decoder(latent, width, features, nodes).double()
        decoder.load_state_dict(weights)
    except (KeyError, ValueError, TypeError, RuntimeError):
        raise InputError(f"expected a shape prior in {path.name}, got another file; {do}") from None
    if not all(bool(torch.isfinite(w).all()) for w in weights.values()):
        raise InputError(f"expected finite numbers in {path.name}, got NaN or infinity; {do}")
    return ShapePrior(decoder, Lattice.from_bounds(low, high, [int(n) for n in counts]))
