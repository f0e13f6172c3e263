"""Clouds of soft point scatterers in a box, for objects whose surface is not known."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.errors import InputError
from invertwin.scene.checks import checked_number, checked_tensor

_CORNER = "give x, y, z of the box's corners"


@dataclass(frozen=True, eq=False)
class Cloud:
    """Point scatterers in a box. They dim the power that passes and scatter some of it back.

    The density is the extinction σ: what passes a way s of it is exp(−∫σ ds) of the power. Each
    volume dV scatters alike in all directions, with a radar cross section of albedo · σ dV.
    Between the nodes the density is trilinear; outside of the box there is nothing.

    A half space of constant density returns albedo/(4π) · cosθ cosθ′/(cosθ + cosθ′) of what meets
    it (Lommel–Seeliger): face on that is a diffuse surface of reflectance albedo/8, and thin
    clouds, ∫σ ds ≪ 1, are linear in their density.

    Attributes:
        low, high: corners of the box in the object's frame [m]; the outer nodes lie on its faces.
        density: extinction at the nodes [1/m], at least two along each axis; may carry gradients.
        albedo: fraction of the extinction that is scattered, times a gain where it is above one; a
            number, or a tensor without dimensions.

    Raises:
        InputError: wrong shapes, NaN, a negative value, or a box without volume.
    """

    low: Float64[Tensor, "3"]
    high: Float64[Tensor, "3"]
    density: Float64[Tensor, "x y z"]
    albedo: float | Float64[Tensor, ""] = 1.0

    def __post_init__(self) -> None:
        for name in ("low", "high"):
            corner = checked_tensor(
                getattr(self, name), (3,), f"{name} corner of the box [m]", _CORNER
            )
            object.__setattr__(self, name, corner.detach())
        if not bool((self.high > self.low).all()):
            raise InputError(
                "expected a box with low < high, "
                f"got {self.low.tolist()} and {self.high.tolist()}; {_CORNER}"
            )
        density = checked_tensor(
            self.density, (None, None, None), "densities [1/m]", "give one for each node"
        )
        if min(density.shape) < 2 or float(density.detach().min()) < 0:
            raise InputError(
                "expected densities of at least 0 at two or more nodes along each axis, got a "
                f"least of {float(density.detach().min()) if density.numel() else 0:.3g} and shape "
                f"{list(density.shape)}; the density is an extinction [1/m]"
            )
        object.__setattr__(self, "density", density)
        checked_number(self.albedo, "albedo", 0.0)

    @property
    def spacing(self) -> Float64[Tensor, "3"]:
        """Distance of neighbouring nodes [m] along each axis."""
        return (self.high - self.low) / (torch.tensor(self.density.shape).double() - 1)
