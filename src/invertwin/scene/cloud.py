"""Clouds of point scatterers in a box, for objects with an unknown surface."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.checks import checked_number, checked_tensor, set_fields
from invertwin.errors import InputError
from invertwin.scene.pose import Basis
from invertwin.scene.shape_models.lattice import Lattice


@dataclass(frozen=True, eq=False)
class Cloud:
    """Volume of point scatterers in a box, which attenuate and scatter power.

    The density is the extinction σ: the transmittance of a path of length s is exp(−∫σ ds). Each
    volume dV scatters isotropically, with a radar cross section of albedo · σ dV. The density is
    trilinear between the nodes and zero outside the box.

    A half space of constant density scatters albedo/(4π) · cosθ cosθ′/(cosθ + cosθ′) of the
    incident power (Lommel–Seeliger): at normal incidence a diffuse surface of reflectance albedo/8.
    Thin clouds, ∫σ ds ≪ 1, are linear in their density.

    Attributes:
        low, high: corners of the box in the object's frame [m]; the outer nodes lie on its faces.
        density: extinction at the nodes [1/m], at least two along each axis; may carry gradients.
        albedo: scattered fraction of the extinction, times a gain where it exceeds one; a number,
            or a tensor without dimensions.

    Raises:
        InputError: wrong shapes, NaN, a negative value, or a box without volume.
    """

    low: Float64[Tensor, "3"]
    high: Float64[Tensor, "3"]
    density: Float64[Tensor, "x y z"]
    albedo: float | Float64[Tensor, ""] = 1.0

    def __post_init__(self) -> None:
        do = "give one for each node"
        density = checked_tensor(self.density, (None, None, None), "densities [1/m]", do)
        lattice = Lattice.from_bounds(self.low, self.high, density.shape)
        least = float(density.detach().min())
        if least < 0:
            raise InputError(
                f"expected densities of at least 0, got a least of {least:.3g}; "
                "the density is an extinction [1/m]"
            )
        checked_number(self.albedo, "albedo", 0.0)
        set_fields(self, low=lattice.low, high=lattice.high, density=density)

    @property
    def spacing(self) -> Float64[Tensor, "3"]:
        """Distance of neighbouring nodes [m] along each axis."""
        return (self.high - self.low) / (self.low.new_tensor(self.density.shape) - 1)

    def change_basis(self, basis: Basis) -> "Cloud":
        """Return the cloud along other axes."""
        ends = torch.stack([basis.vectors(self.low), basis.vectors(self.high)])
        density = self.density.permute(basis.order)
        density = density.flip([axis for axis, sign in enumerate(basis.signs) if sign < 0])
        return replace(self, low=ends.amin(0), high=ends.amax(0), density=density)
