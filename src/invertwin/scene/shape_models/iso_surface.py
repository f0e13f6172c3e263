"""Mesh a field by marching cubes, with derivatives by the implicit function theorem."""

from collections.abc import Callable

import torch
from jaxtyping import Float64, Int64
from skimage.measure import marching_cubes
from torch import Tensor

from invertwin.errors import InputError
from invertwin.scene.mesh import Mesh
from invertwin.scene.shape_models.lattice import Lattice

Field = Callable[[Float64[Tensor, "p 3"]], Float64[Tensor, " p"]]

# Newton steps from marching cubes, whose error is of second order, to the field's zero.
_NEWTON_STEPS = 4
_CHUNK = 65_536  # points of the field per chunk
_MIN_GRADIENT = 1e-6  # minimum gradient of a distance field, nominally 1


def iso_surface(field: Field, lattice: Lattice) -> Mesh:
    """Mesh the zero surface of a field; the vertices follow the field.

    Values and topology are those of marching cubes, moved onto the field's zero; the derivative of
    a vertex V with unit normal n = ∇f/|∇f| is ``dV = −n df/|∇f|``, in reverse and in forward mode.
    Only the normal part of a vertex's motion is determined, and only this part moves the surface. A
    surface that leaves the box is open there.

    Source: f(V(θ), θ) = 0, differentiated along the normal; derivations §8.

    Args:
        field: field, negative inside, positive outside; its parameters may carry gradients. Points
            are in the object's frame [m].
        lattice: nodes at which the field is sampled; thinner parts are missed.

    Raises:
        InputError: a field that is not finite, or has one sign at all nodes.
    """
    with torch.no_grad():
        parts = [field(part).detach() for part in lattice.nodes.reshape(-1, 3).split(_CHUNK)]
    points, faces, slope = extract_surface(field, lattice, torch.cat(parts).reshape(lattice.counts))
    return Mesh(attach_shape_derivative(field, points, slope), faces)


def extract_surface(
    field: Field, lattice: Lattice, values: Float64[Tensor, "x y z"]
) -> tuple[Float64[Tensor, "p 3"], Int64[Tensor, "t 3"], Float64[Tensor, "p 3"]]:
    """Return vertex positions, triangles, and the field's gradient there, all without derivatives.

    Args:
        field: signed distance at points in the box.
        lattice: nodes of the values.
        values: the field at the nodes.
    """
    if not bool(torch.isfinite(values).all()):
        raise InputError("expected a finite field, got NaN or infinity; lower the learning rate")
    if not bool(values.min() < 0 < values.max()):
        raise InputError(
            "expected a field with both signs in its box, got values in "
            f"[{float(values.min()):.3g}, {float(values.max()):.3g}]; "
            "start with a surface inside of the box"
        )
    corners, faces = march_cubes(values.detach(), 0.0, "descent")
    points, reach = lattice.low + corners * lattice.spacing, 0.5 * float(lattice.spacing.min())
    for _ in range(_NEWTON_STEPS):
        value, slope = _value_and_gradient(field, points)
        step = slope * (value / slope.square().sum(1).clamp_min(_MIN_GRADIENT**2))[:, None]
        points = points - step * (reach / step.norm(dim=1, keepdim=True).clamp_min(reach))
        points = points.clamp(lattice.low, lattice.high)
    return points, faces, _value_and_gradient(field, points)[1]


def march_cubes(
    values: Float64[Tensor, "x y z"], level: float, gradient: str
) -> tuple[Float64[Tensor, "p 3"], Int64[Tensor, "t 3"]]:
    """Corners, in steps between the nodes, and triangles where values on nodes are at a level.

    Args:
        values: values on the nodes.
        level: level of the surface.
        gradient: "ascent" towards the inside, or "descent".
    """
    corners, faces, _, _ = marching_cubes(
        values.numpy(), level, gradient_direction=gradient, allow_degenerate=False
    )
    return torch.from_numpy(corners).double(), torch.from_numpy(faces.astype("int64"))


def attach_shape_derivative(
    field: Field, points: Float64[Tensor, "p 3"], slope: Float64[Tensor, "p 3"]
) -> Float64[Tensor, "p 3"]:
    """Attach the derivative dV = −n df/|∇f| to points of the surface.

    Args:
        field: field whose zero contains the points.
        points: points of the surface [m].
        slope: the field's gradient there.
    """
    fixed = points.detach()
    direction = slope / slope.square().sum(1, keepdim=True).clamp_min(_MIN_GRADIENT**2)
    value = field(fixed)
    return fixed - direction * (value - value.detach())[:, None]


def _value_and_gradient(field: Field, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return the field and its spatial gradient, both without derivatives."""
    values, slopes = [], []
    for part in points.split(_CHUNK):
        place = part.detach().requires_grad_()
        with torch.enable_grad():
            value = field(place)
            (slope,) = torch.autograd.grad(value.sum(), place)
        values.append(value.detach())
        slopes.append(slope.detach())
    return torch.cat(values), torch.cat(slopes)
