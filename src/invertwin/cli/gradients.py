"""The scalar θ of a gradient check, from the tables of a run file: a module and a tangent."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from invertwin.cli import schema
from invertwin.cli.bodies import template
from invertwin.errors import InputError
from invertwin.inversion.lines import Line
from invertwin.inversion.remeshing import signed_distance
from invertwin.radar.parameters import RadarPose
from invertwin.radar.radar import Radar
from invertwin.scene import Scene
from invertwin.scene.geometry import (
    DensityGrid,
    DistanceGrid,
    Lattice,
    LinearShape,
    PriorShape,
    SkinnedBody,
    load_prior,
    load_vehicle_space,
)
from invertwin.scene.parameters import MaterialValues, Pose, Scale

UNITS = {
    "translation": "1/m",
    "rotation": "1/rad",
    "scale": "per relative size",
    "radar_translation": "1/m",
    "radar_rotation": "1/rad",
    "joint": "1/rad",
    "latent": "per unit of the latent",
    "distance": "1/m",
    "density": "per relative density",
}
"""Units of the derivative of a power, by kind of θ."""


@dataclass(frozen=True)
class Theta:
    """What a gradient check moves.

    Attributes:
        module: Maps the scene, or the radar.
        tangent: How its parameters change with θ, by name.
        of_radar: Whether it maps the radar.
        shape: Whether it changes a shape.
    """

    module: nn.Module
    tangent: Mapping[str, Tensor]
    of_radar: bool = False
    shape: bool = False

    def direction(self) -> Callable[[Scene, Radar, Tensor], tuple[Scene, Radar]]:
        """A function that moves scene and radar by θ."""

        def moved(scene: Scene, radar: Radar, theta: Tensor) -> tuple[Scene, Radar]:
            if self.of_radar:
                return scene, Line(self.module, self.tangent, radar).at(theta)
            return Line(self.module, self.tangent, scene).at(theta), radar

        return moved


def theta_of(table: schema.GradientParameter, run: schema.RunFile, scene: Scene) -> Theta:
    """The θ of a `[gradcheck.parameter]` table.

    Args:
        table: Kind and values.
        run: Its scene tables.
        scene: The scene of the run file.

    Raises:
        InputError: The object has no such value, joint, coordinate or shape.
    """
    name = table.object or ""
    item = run.scene.get(name)
    match table.kind:
        case "translation" | "radar_translation" | "rotation" | "radar_rotation":
            radar = table.kind.startswith("radar")
            axis = torch.tensor(table.axis, dtype=torch.float64)
            axis = axis / axis.norm()
            key = table.kind.removeprefix("radar_")
            # A small q = (1, r) turns by the rotation vector r.
            change = axis if key == "translation" else torch.cat([axis.new_zeros(1), axis])
            return Theta(RadarPose() if radar else Pose(name), {key: change}, radar)
        case "scale":
            return Theta(Scale(name), {"log_scale": torch.ones((), dtype=torch.float64)})
        case "material":
            return _material(table, scene)
        case "joint":
            return Theta(*_joint(table, item), shape=True)
        case "latent":
            return Theta(*_latent(table, item), shape=True)
    low, high, counts = _box(table)
    distance = partial(signed_distance, scene[name].mesh)
    if table.kind == "distance":
        module = DistanceGrid.sampled(name, low, high, counts, distance)
        # The surface moves outwards where the distance falls.
        return Theta(module, {"value": -_bump(table, module.lattice)}, shape=True)
    lattice = Lattice.between(low, high, counts)
    inside = -distance(lattice.nodes.reshape(-1, 3))
    share = torch.sigmoid(4 * inside / lattice.spacing.mean()).reshape(lattice.counts)
    cloud = DensityGrid(name, low, high, float(table.extinction or 0) * share)
    with torch.no_grad():
        # σ = softplus(value) / h: this change of the value changes σ by σ times the bump.
        slope = torch.sigmoid(cloud.value) / torch.nn.functional.softplus(cloud.value)
        return Theta(cloud, {"value": _bump(table, lattice) / slope}, shape=True)


def _material(table: schema.GradientParameter, scene: Scene) -> Theta:
    material, value = scene[table.object or ""].material, table.value or ""
    if value not in vars(material):
        raise InputError(
            f"expected a value of {table.object}'s material ({', '.join(vars(material))}), "
            f"got {value!r}; choose one"
        )
    module = MaterialValues(table.object or "", **{value: getattr(material, value)})
    key = f"raw.{value}"
    raw = module.get_parameter(key).detach()
    found, slope = torch.func.jvp(  # type: ignore[misc]
        lambda parameter: _value(module, key, parameter, scene, value),
        (raw,),
        (torch.ones_like(raw),),
    )
    return Theta(module, {key: torch.ones_like(found) / slope})


def _value(module: nn.Module, key: str, parameter: Tensor, scene: Scene, value: str) -> Tensor:
    moved = torch.func.functional_call(module, {key: parameter}, (scene,))
    return getattr(moved[module.object].material, value)  # type: ignore[attr-defined]


def _joint(table: schema.GradientParameter, item: Any) -> tuple[SkinnedBody, dict[str, Tensor]]:
    if _shape(item) != "body":
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
    table: schema.GradientParameter, item: Any
) -> tuple[LinearShape | PriorShape, dict[str, Tensor]]:
    index, name = table.index or 0, table.object or ""
    whole = getattr(item, "scale", None) == 1
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


def _shape(item: Any) -> str:
    return getattr(item, "shape", "")
