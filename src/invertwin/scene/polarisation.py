"""Polarisation: Jones vectors over V and H of waves and antennas.

V and H of a direction are unit vectors perpendicular to it. With respect to an axis, V lies in the
plane of the axis and the direction, H is perpendicular to that plane: V is the field of a short
dipole along the axis. A receiver measures p · E of a field E, without a conjugate, so that an
antenna has one vector for transmission and reception.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

from invertwin import checks
from invertwin.errors import InputError
from invertwin.scene.material.fresnel import safe_root

JONES: Mapping[str, tuple[complex, complex]] = MappingProxyType(
    {"V": (1.0, 0.0), "H": (0.0, 1.0), "circular": (0.5**0.5, 0.5**0.5 * 1j)}
)
"""Jones vectors (V, H) by name; circular is right-hand for exp(+jωt)."""

_LEVELS = "a polarisation as V, H, circular or two complex numbers (V, H)"
_DETACHED = "polarisations cannot be fitted: detach them"


def jones_basis(polarisation: str | checks.ArrayLike) -> Complex128[Tensor, "2 2"]:
    """Return a polarisation and the orthogonal one, of unit length, as columns over (V, H).

    Args:
        polarisation: a name of ``JONES``, or two complex numbers.

    Raises:
        InputError: an unknown name, or not two numbers of non-zero length.
    """
    polarisation = JONES.get(polarisation, ()) if isinstance(polarisation, str) else polarisation
    try:
        first = torch.as_tensor(polarisation, dtype=torch.complex128)
        length = float(first.detach().norm())
    except (TypeError, ValueError, RuntimeError):
        length, first = 0.0, torch.zeros(0)
    if first.shape != (2,) or not 0 < length < math.inf:
        raise InputError(f"expected {_LEVELS}, got {polarisation!r}; give two, not both zero")
    checks.refuse_derivatives(first, "a polarisation", _DETACHED)
    return torch.stack([first / length, orthogonal_vectors(first / length)], 1)


def checked_angles(
    theta: checks.ArrayLike, phi: checks.ArrayLike, of: str, do: str
) -> tuple[Float64[Tensor, " n"], Float64[Tensor, " m"]]:
    """Convert the angles of a table over direction to ascending tensors [rad].

    Args:
        theta: angles to boresight, from 0 to π at most.
        phi: angles around boresight, which span less than 2π.
        of: noun for the owner of the table, for the message.
        do: remedy for wrong shapes, for the message.

    Raises:
        InputError: angles that do not ascend or are out of range.
    """
    around = checks.checked_ascending(phi, f"angles phi of {of}", do, 1)
    away = checks.checked_ascending(theta, f"angles theta of {of}", do)
    if away[0] != 0 or away[-1] > math.pi + 1e-9:
        raise InputError(
            f"expected theta from 0 to at most pi rad, got {float(away[0]):g} to "
            f"{float(away[-1]):g}; convert degrees to rad and start at boresight"
        )
    if around[-1] - around[0] >= 2 * math.pi - 1e-9:
        raise InputError(
            f"expected phi spanning less than 2 pi rad, got {float(around[-1] - around[0]):g}; "
            "convert degrees to rad and leave out the repeated last angle"
        )
    return away, around


def orthogonal_vectors(vector: Complex128[Tensor, "*row 2"]) -> Complex128[Tensor, "*row 2"]:
    """Return the Jones vectors orthogonal to others, of equal length.

    Args:
        vector: Jones vectors over (V, H) [*, 2].
    """
    first, second = vector.unbind(-1)
    return torch.stack([-second.conj(), first.conj()], -1)


@dataclass(frozen=True, eq=False)
class JonesTable:
    """Measured or simulated polarisation over direction, bilinear between angles.

    Vectors are normalised: the magnitude is the gain of the pattern. Beyond the last θ its vector
    applies.

    Attributes:
        theta: n ≥ 2 ascending angles to boresight [rad], from 0.
        phi: m ascending angles around boresight, from y towards z [rad], spanning less than 2π;
            m = 1 for vectors that do not depend on it.
        vectors: Jones vectors (V, H) of each direction, about the radar's z axis [n, m, 2].

    Raises:
        InputError: wrong shapes, angles that do not ascend, a vector of length zero, derivatives.
    """

    theta: Float64[Tensor, " n"]
    phi: Float64[Tensor, " m"]
    vectors: Complex128[Tensor, "n m 2"]

    def __post_init__(self) -> None:
        do = "give theta [n], phi [m] in rad and complex vectors [n, m, 2]"
        theta, phi = checked_angles(self.theta, self.phi, "a polarisation", do)
        vectors = torch.as_tensor(self.vectors, dtype=torch.complex128)
        shape = (len(theta), len(phi), 2)
        parts = checks.checked_tensor(torch.view_as_real(vectors), (*shape, 2), "Jones vectors", do)
        for value in (theta, phi, parts):
            checks.refuse_derivatives(value, "a polarisation", _DETACHED)
        length = parts.flatten(-2).norm(dim=-1)
        if not bool((length > 0).all()):
            raise InputError(f"expected Jones vectors of some length, got zeros; {do}")
        found = torch.view_as_complex(parts) / length[..., None]
        checks.set_fields(self, theta=theta, phi=phi, vectors=found)

    def vector(self, direction: Float64[Tensor, "row 3"]) -> Complex128[Tensor, "row 2"]:
        """Return unit Jones vectors towards unit vectors in the radar frame.

        Args:
            direction: unit vectors pointing away from the antenna [*, 3].
        """
        x, y, z = direction.unbind(-1)
        theta, nodes, vectors = (t.to(x.device) for t in (self.theta, self.phi, self.vectors))
        # Neither the radius nor atan2 has a gradient on the axis; φ is arbitrary there.
        on_axis = (y == 0) & (z == 0)
        radius = safe_root(y**2 + z**2, 0.0)
        row, up = _locate_nodes(theta, torch.atan2(radius, x))
        phi = torch.atan2(z, torch.where(on_axis, 1.0, y))
        around = torch.cat([nodes, nodes[:1] + 2 * math.pi])
        phi = nodes[0] + (phi - nodes[0]) % (2 * math.pi)
        column, across = _locate_nodes(around, phi)
        after = (column + 1) % len(nodes)
        found = vectors.new_zeros(len(direction), 2)
        for line, share in ((row, 1 - up), (row + 1, up)):
            for place, part in ((column, 1 - across), (after, across)):
                found = found + (share * part)[:, None] * vectors[line, place]
        return found / torch.view_as_real(found).flatten(-2).norm(dim=-1).clamp_min(1e-9)[:, None]


def _locate_nodes(nodes: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
    """Return the node before each position, and the fraction of the step to the next one."""
    position = torch.minimum(position, nodes[-1])
    low = torch.searchsorted(nodes, position.detach(), right=True).clamp(1, len(nodes) - 1) - 1
    return low, (position - nodes[low]) / (nodes[low + 1] - nodes[low])


@dataclass(frozen=True, eq=False)
class Polarisation:
    """Polarisations of the elements of an array: mixtures of one or two Jones vectors.

    Attributes:
        base: vectors [k, 2] over (V, H), or a table of the first; the second is orthogonal.
        mixtures: coefficient of each vector in every element; k = 1 if all elements are equal.
    """

    base: Complex128[Tensor, "k 2"] | JonesTable
    mixtures: Complex128[Tensor, "element k"]

    @staticmethod
    def from_jones(
        polarisation: str | checks.ArrayLike | JonesTable,
        leakage: complex | checks.ArrayLike,
        elements: int,
    ) -> "Polarisation":
        """Build the polarisation of an array.

        Args:
            polarisation: a name of ``JONES``, a vector (V, H) for all elements or one for each, or
                a table.
            leakage: field of the orthogonal polarisation over that of the nominal one, of all
                elements or of each.
            elements: number of elements.

        Raises:
            InputError: an unknown name, vectors of length zero, or another number of them.
        """
        share = _leakage(leakage, elements)
        if isinstance(polarisation, JonesTable):
            if bool((share == share[0]).all()) and not share[0]:
                return Polarisation(polarisation, share.new_ones(elements, 1))
            return Polarisation(polarisation, _mixture_weights(share))
        vectors = _vectors(polarisation, elements)
        if vectors is None:
            basis = jones_basis(polarisation).T
            mixtures = _mixture_weights(share)
        else:
            basis = torch.eye(2, dtype=torch.complex128)
            mixtures = (vectors + share[:, None] * orthogonal_vectors(vectors)) / _length(share)
        if bool((mixtures == mixtures[0]).all()):
            return Polarisation(mixtures[:1] @ basis, share.new_ones(elements, 1))
        return Polarisation(basis, mixtures)

    @property
    def mean(self) -> Complex128[Tensor, " k"]:
        """Mixture of the mean element."""
        return self.mixtures.mean(0)

    @property
    def vectors(self) -> Complex128[Tensor, "element 2"]:
        """Return the vectors of all elements; not defined for a table, see ``evaluate``.

        Raises:
            InputError: they depend on the direction.
        """
        if isinstance(self.base, JonesTable):
            raise InputError(
                "expected antennas of one Jones vector in all directions, got a table; power paths "
                "and surrogates take a vector: give the one at boresight"
            )
        return self.mixtures @ self.base

    def evaluate(self, direction: Float64[Tensor, "row 3"]) -> Complex128[Tensor, "#row k 2"]:
        """Return the basis vectors, one row if they do not depend on direction.

        Args:
            direction: unit vectors in the radar frame, away from the antenna [*, 3].
        """
        if not isinstance(self.base, JonesTable):
            return self.base[None]
        first = self.base.vector(direction)
        return torch.stack([first, orthogonal_vectors(first)], 1)[:, : self.mixtures.shape[1]]

    def equals(self, other: "Polarisation") -> bool:
        """Return whether all elements of two arrays have one common polarisation.

        Args:
            other: polarisation of the other array.
        """
        if isinstance(self.base, JonesTable) or isinstance(other.base, JonesTable):
            same = self.base is other.base
        else:
            same = torch.equal(self.base, other.base)
        return same and self.mixtures.shape[1] == other.mixtures.shape[1] == 1


def _leakage(value: complex | checks.ArrayLike, elements: int) -> Tensor:
    do = "give the field of the other polarisation over the wanted one, of all elements or of each"
    try:
        found = torch.as_tensor(value, dtype=torch.complex128)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise InputError(f"expected leakage as numbers, got {value!r}; {do}") from None
    parts = torch.view_as_real(found)
    if found.shape not in ((), (elements,)) or not bool(torch.isfinite(parts).all()):
        raise InputError(
            f"expected one finite leakage or {elements}, got shape {list(found.shape)}; {do}"
        )
    checks.refuse_derivatives(found, "leakage", _DETACHED)
    return found.expand(elements)


def _vectors(polarisation: object, elements: int) -> Tensor | None:
    """Return unit vectors of the elements, if there is one for each."""
    if isinstance(polarisation, str):
        return None
    try:
        found = torch.as_tensor(polarisation, dtype=torch.complex128)
    except (TypeError, ValueError, RuntimeError):
        return None
    if found.ndim != 2:
        return None
    if len(found) != elements:
        raise InputError(
            f"expected one Jones vector or {elements}, got {len(found)}; give one per element"
        )
    return torch.stack([jones_basis(vector)[:, 0] for vector in found])


def _mixture_weights(share: Tensor) -> Tensor:
    return torch.stack([torch.ones_like(share), share], 1) / _length(share)


def _length(share: Tensor) -> Tensor:
    return (1 + share.abs() ** 2).sqrt()[:, None]


VERTICAL = Polarisation.from_jones("V", 0.0, 1)
"""Polarisation of one element with V."""
