"""The scalar θ of a gradient check, from the tables of a run file: a module and a tangent."""

from collections.abc import Callable, Mapping
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
    """What a gradient check moves."""

    module: nn.Module  # maps the scene, or the radar
    tangent: Mapping[str, Tensor]  # how its parameters change with θ, by name
    of_radar: bool = False
    shape: bool = False  # whether it changes a shape

    def direction(self) -> Callable[[Scene, Radar, Tensor], tuple[Scene, Radar]]:
        """A function that moves scene and radar by θ."""

        def moved(scene: Scene, radar: Radar, theta: Tensor) -> tuple[Scene, Radar]:
            if self.of_radar:
                return scene, Line(self.module, self.tangent, radar).at(theta)
            return Line(self.module, self.tangent, scene).at(theta), radar

        return moved


def theta_of(table: schema.GradientParameter, run: schema.RunFile, scene: Scene) -> Theta:
    """The θ of a `[gradcheck.parameter]` table, at the scene of the run file.

    Raises:
        InputError: The object has no such value, joint, coordinate or shape.
    """
    name: str = table.object or ""
    item: Any = run.scene.get(name)
    match table.kind:
        case "translation" | "radar_translation" | "rotation" | "radar_rotation":
            radar = table.kind.startswith("radar")
            axis, key = _axis(table), table.kind.removeprefix("radar_")
            # A small q = (1, r) turns by the rotation vector r.
            change = axis if key == "translation" else torch.cat([axis.new_zeros(1), axis])
            return Theta(RadarPose() if radar else Pose(name), {key: change}, radar)
        case "scale":
            return Theta(Scale(name), {"log_scale": torch.ones((), dtype=torch.float64)})
        case "material":
            return _material(name, table.value or "", scene)
        case "joint":
            return _joint(name, table, item)
        case "latent":
            return _latent(name, table.index or 0, item)
    return _bump(name, table, partial(signed_distance, scene[name].mesh))


def _axis(table: schema.GradientParameter) -> Tensor:
    axis = torch.tensor(table.axis, dtype=torch.float64)
    return axis / axis.norm()


def _material(name: str, value: str, scene: Scene) -> Theta:
    material = scene[name].material
    if value not in vars(material):
        raise InputError(
            f"expected a value of {name}'s material ({', '.join(vars(material))}), "
            f"got {value!r}; choose one"
        )
    module = MaterialValues(name, **{value: getattr(material, value)})
    key = f"raw.{value}"
    raw = module.get_parameter(key).detach()

    def found(parameter: Tensor) -> Tensor:
        moved = torch.func.functional_call(module, {key: parameter}, (scene,))
        return getattr(moved[name].material, value)

    slope = torch.func.jvp(found, (raw,), (torch.ones_like(raw),))[1]
    return Theta(module, {key: torch.ones_like(slope) / slope})


def _joint(name: str, table: schema.GradientParameter, item: Any) -> Theta:
    if _shape(item) != "body":
        raise InputError(f'expected an object with shape = "body", got {name}; choose one')
    body = template(item).scaled(item.scale)
    angles = {
        joint: torch.tensor(turn, dtype=torch.float64).deg2rad()
        for joint, turn in item.angles_deg.items()
    }
    change = torch.zeros(len(body.parents), 3, dtype=torch.float64)
    change[body.joint(table.joint or "")] = _axis(table)
    module = SkinnedBody(name, body, body.rotations(angles))
    return Theta(module, {"rotation": change}, shape=True)


def _latent(name: str, index: int, item: Any) -> Theta:
    whole = getattr(item, "scale", None) == 1
    if _shape(item) == "vehicle" and whole and item.max_edge is None:
        start = torch.zeros(max(index + 1, len(item.coefficients)), dtype=torch.float64)
        start[: len(item.coefficients)] = torch.tensor(item.coefficients, dtype=torch.float64)
        module = LinearShape(name, load_vehicle_space(item.folder, item.level), start)
    elif _shape(item) == "prior" and whole:
        prior = load_prior(item.prior)
        start = torch.zeros(prior.latent_size, dtype=torch.float64)
        module = PriorShape(name, prior, start.new_tensor(item.latent) if item.latent else start)
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
    return Theta(module, {"latent": change}, shape=True)


def _bump(name: str, table: Any, distance: Callable[[Tensor], Tensor]) -> Theta:
    """A signed distance or a density that changes in a round bump, 1 in the middle."""
    box = table.low, table.high, table.counts
    lattice = Lattice.between(*box)
    far = lattice.nodes - lattice.nodes.new_tensor(table.center)
    bump = torch.exp(-far.square().sum(-1) / (2 * table.width**2))
    if table.kind == "distance":
        # The surface moves outwards where the distance falls.
        return Theta(DistanceGrid.sampled(name, *box, distance), {"value": -bump}, shape=True)
    inside = -distance(lattice.nodes.reshape(-1, 3))
    share = torch.sigmoid(4 * inside / lattice.spacing.mean()).reshape(lattice.counts)
    cloud = DensityGrid(name, table.low, table.high, table.extinction * share)
    with torch.no_grad():
        # σ = softplus(value) / h: this change of the value changes σ by σ times the bump.
        slope = torch.sigmoid(cloud.value) / torch.nn.functional.softplus(cloud.value)
        return Theta(cloud, {"value": bump / slope}, shape=True)


def _shape(item: Any) -> str:
    return getattr(item, "shape", "")
