"""The scalar θ of a gradient check where it changes a shape, from the tables of a run file."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from invertwin.cli import schema
from invertwin.cli.bodies import template
from invertwin.errors import InputError
from invertwin.inversion.remeshing import signed_distance
from invertwin.inversion.shape_directions import (
    ShapeDirection,
    along,
    along_density,
    along_field,
)
from invertwin.scene import Cloud, Scene
from invertwin.scene.geometry import (
    DistanceGrid,
    Lattice,
    LinearShape,
    PriorShape,
    SkinnedBody,
    load_prior,
    load_vehicle_space,
)

SHAPES = {
    "joint": "1/rad",
    "latent": "per unit of the latent",
    "distance": "1/m",
    "density": "per relative density",
}
"""Units of the derivative of a power, by kind of shape."""


def shape_direction(
    table: schema.GradientParameter, run: schema.RunFile, scene: Scene
) -> tuple[Scene, ShapeDirection]:
    """The scene at θ = 0 with the object as this kind of shape describes it, and its θ.

    Raises:
        InputError: The object has no such joint, coordinate or shape.
    """
    name = table.object or ""
    item = run.scene.get(name)
    match table.kind:
        case "joint":
            return _at_start(scene, *_joint(table, item))
        case "latent":
            return _at_start(scene, *_latent(table, item, scene))
        case "distance":
            low, high, counts = _box(table)
            field = partial(signed_distance, scene[name].mesh)
            module = DistanceGrid.sampled(name, low, high, counts, field)
            # The surface moves outwards where the distance falls.
            change = -_bump(table, module.lattice)
            with torch.no_grad():
                begun = module(scene)
            return begun, along_field(module, scene, value=change)
    low, high, counts = _box(table)
    lattice = Lattice.between(low, high, counts)
    inside = -signed_distance(scene[name].mesh, lattice.nodes.reshape(-1, 3))
    share = torch.sigmoid(4 * inside / lattice.spacing.mean()).reshape(lattice.counts)
    cloud = Cloud(lattice.low, lattice.high, float(table.extinction or 0) * share)
    dense = scene.replace(name, cloud=cloud)
    return dense, along_density(name, _bump(table, lattice))


def _at_start(
    scene: Scene, module: SkinnedBody | LinearShape | PriorShape, changes: dict[str, Tensor]
) -> tuple[Scene, ShapeDirection]:
    with torch.no_grad():
        begun = module(scene)
    if isinstance(module, PriorShape):
        return begun, along_field(module, scene, **changes)
    return begun, along(module, **changes)


def _joint(table: schema.GradientParameter, item: Any) -> tuple[SkinnedBody, dict[str, Tensor]]:
    if item is None or _shape(item) != "body":
        raise InputError(f'expected an object with shape = "body", got {table.object}; choose one')
    body = template(item).scaled(item.scale)
    angles = {
        name: torch.tensor(turn, dtype=torch.float64).deg2rad()
        for name, turn in item.angles_deg.items()
    }
    change = torch.zeros(len(body.parents), 3, dtype=torch.float64)
    axis = torch.tensor(table.axis, dtype=torch.float64)
    change[body.joint(table.joint or "")] = axis / axis.norm()
    module = SkinnedBody(table.object or "", body, body.rotations(angles))
    return module, {"rotation": change}


def _latent(
    table: schema.GradientParameter, item: Any, scene: Scene
) -> tuple[LinearShape | PriorShape, dict[str, Tensor]]:
    index, name = table.index or 0, table.object or ""
    whole = item is not None and item.scale == 1
    if _shape(item) == "vehicle" and whole and item.max_edge is None:
        start = torch.zeros(max(index + 1, len(item.coefficients)), dtype=torch.float64)
        start[: len(item.coefficients)] = torch.tensor(item.coefficients, dtype=torch.float64)
        module = LinearShape(name, load_vehicle_space(item.folder, item.level), start)
    elif _shape(item) == "prior" and whole:
        prior = load_prior(item.prior)
        start = torch.zeros(prior.latent_size, dtype=torch.float64)
        if item.latent is not None:
            start = start.new_tensor(item.latent)
        module = PriorShape(name, prior, start)
    else:
        raise InputError(
            'expected an object with shape = "vehicle" without max_edge, or "prior", and scale 1, '
            f"got {name}; choose one"
        )
    if index >= len(module.latent):
        raise InputError(
            f"expected an index below {len(module.latent)} of a latent, got {index}; count from 0"
        )
    change = torch.zeros_like(module.latent.detach())
    change[index] = 1.0
    return module, {"latent": change}


def _box(table: schema.GradientParameter) -> tuple[list[float], list[float], Sequence[int]]:
    assert table.low is not None
    assert table.high is not None
    assert table.counts is not None
    return table.low, table.high, table.counts


def _bump(table: schema.GradientParameter, lattice: Lattice) -> Tensor:
    """A round bump with this centre and width at the nodes, 1 in the middle."""
    assert table.center is not None
    assert table.width is not None
    far = lattice.nodes - lattice.nodes.new_tensor(table.center)
    return torch.exp(-far.square().sum(-1) / (2 * table.width**2))


def _shape(item: Any) -> str | None:
    return getattr(item, "shape", None)
