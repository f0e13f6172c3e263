"""One number that changes a shape: what `gradcheck` moves for every kind of shape."""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float64
from torch import Tensor, nn
from torch.autograd import forward_ad

from invertwin.errors import InputError
from invertwin.radar.radar import Radar
from invertwin.scene.mesh import Mesh
from invertwin.scene.scene import Scene

ShapeDirection = Callable[[Scene, Radar, Tensor], tuple[Scene, Radar]]

_NEWTON = 8  # steps along a normal, onto the zero of the changed field
_ON = 1e-9  # m, how near a point is to that zero


def along(module: nn.Module, **changes: Tensor) -> ShapeDirection:
    """The module's parameters, moved by θ times these changes.

    Args:
        module: Scene → Scene.
        changes: by the parameters' names, of their shapes.
    """
    start = {name: value.detach() for name, value in module.named_parameters()}

    def direction(scene: Scene, radar: Radar, theta: Tensor) -> tuple[Scene, Radar]:
        moved = {name: start[name] + theta * change for name, change in changes.items()}
        return torch.func.functional_call(module, moved, (scene,)), radar

    return direction


def along_field(module: nn.Module, scene: Scene, **changes: Tensor) -> ShapeDirection:
    """The same for a signed distance, with the triangles of θ = 0 at both ends of a difference.

    Differences with common random numbers need triangles that stay the same ones, so ends are not
    meshed anew: the points of the first mesh follow the changed field's zero along their normals.
    Derivatives go through the module as it is, its marching cubes included.

    Args:
        module: with an ``object`` and its ``distance`` at points, such as ``DistanceGrid``.
        scene: that the module is for.
        changes: by the parameters' names, of their shapes.
    """
    inner = along(module, **changes)
    name: str = module.object  # type: ignore[assignment]
    with torch.no_grad():
        mesh = module(scene)[name].mesh
    points = mesh.vertices.detach()
    start = {key: value.detach() for key, value in module.named_parameters()}
    field = _Field(module)

    def slopes(theta: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
        at = places.detach().requires_grad_()
        moved = {f"shape.{key}": start[key] + theta * change for key, change in changes.items()}
        with torch.enable_grad():
            found = torch.func.functional_call(field, moved, (at,))
            (slope,) = torch.autograd.grad(found.sum(), at)
        return found.detach(), slope

    _, slope = slopes(torch.zeros((), dtype=torch.float64), points)
    normals = slope / slope.norm(dim=1, keepdim=True)

    def direction(scene: Scene, radar: Radar, theta: Tensor) -> tuple[Scene, Radar]:
        if forward_ad.unpack_dual(theta).tangent is not None:
            return inner(scene, radar, theta)
        places = points
        for _ in range(_NEWTON):
            found, slope = slopes(theta, places)
            places = places - normals * (found / (slope * normals).sum(1))[:, None]
        found, _ = slopes(theta, places)
        if not bool(found.abs().max() < _ON):
            raise InputError(
                "expected a surface that follows θ along its normals, got points that do not meet "
                f"it at θ = {float(theta):.3g}; take a smaller step"
            )
        return scene.replace(name, mesh=Mesh(places, mesh.faces)), radar

    return direction


def along_density(name: str, change: Float64[Tensor, "x y z"]) -> ShapeDirection:
    """The density of an object's cloud, times 1 + θ times this change at the nodes."""

    def direction(scene: Scene, radar: Radar, theta: Tensor) -> tuple[Scene, Radar]:
        cloud = scene[name].cloud
        if cloud is None:
            raise InputError(f"expected a cloud on {name}, got none; give it a density")
        dense = replace(cloud, density=cloud.density * (1 + theta * change))
        return scene.replace(name, cloud=dense), radar

    return direction


class _Field(nn.Module):
    """The distance of a shape as a module's own call."""

    def __init__(self, shape: nn.Module) -> None:
        super().__init__()
        self.shape = shape

    def forward(self, places: Tensor) -> Tensor:
        return self.shape.distance(places)  # type: ignore[operator]
