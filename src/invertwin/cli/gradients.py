"""The scalar θ of a gradient check: a module, and how its parameters change with θ."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import torch
from annotated_types import Ge
from torch import Tensor, nn

from invertwin.cli.bodies import Bodies, template
from invertwin.cli.materials import MaterialValue
from invertwin.cli.registry import Group, Registry
from invertwin.cli.section import Counts, Vector
from invertwin.cli.shape_tables import ObjectTable, given_for
from invertwin.errors import InputError
from invertwin.inversion.lines import Line
from invertwin.inversion.remeshing import signed_distance
from invertwin.limits import Positive
from invertwin.radar.parameters import RadarPose
from invertwin.radar.radar import Radar
from invertwin.scene import (
    DensityGrid,
    DistanceGrid,
    LinearShape,
    Mesh,
    PriorShape,
    Scene,
    SkinnedBody,
    load_prior,
    load_vehicle_space,
)
from invertwin.scene.geometry.lattice import Lattice
from invertwin.scene.parameters import MaterialValues, Pose, Scale


@dataclass(frozen=True)
class Theta:
    """What a gradient check moves."""

    module: nn.Module  # maps the scene, or the radar
    tangent: Mapping[str, Tensor]  # how its parameters change with θ, by name
    unit: str  # of the derivative of a power
    of_radar: bool = False
    shape: bool = False  # whether it changes a shape

    def direction(self) -> Callable[[Scene, Radar, Tensor], tuple[Scene, Radar]]:
        """A function that moves scene and radar by θ."""

        def moved(scene: Scene, radar: Radar, theta: Tensor) -> tuple[Scene, Radar]:
            if self.of_radar:
                return scene, Line(self.module, self.tangent, radar).at(theta)
            return Line(self.module, self.tangent, scene).at(theta), radar

        return moved


def register(registry: Registry) -> None:
    """Adds the kinds of θ."""
    registry.groups["theta"] = Group()
    for name, make in (
        ("translation", translation),
        ("rotation", rotation),
        ("radar_translation", radar_translation),
        ("radar_rotation", radar_rotation),
        ("scale", scale),
        ("material", material),
        ("joint", joint),
        ("latent", latent),
        ("distance", distance),
        ("density", density),
    ):
        registry.add("theta", name, make)


def theta_of(table: Any, run: Any, scene: Scene) -> Theta:
    """The θ of a `[gradcheck.parameter]` table, at the scene of the run file.

    Raises:
        InputError: The object has no such value, joint, coordinate or shape.
    """
    name = getattr(table, "object", None)
    return table.build({} if name is None else given_for(name, scene, Bodies(), run.scene))


def translation(object: str, axis: Vector) -> Theta:
    """Moves an object."""
    return Theta(Pose(object), {"translation": _unit(axis)}, "1/m")


def rotation(object: str, axis: Vector) -> Theta:
    """Turns an object about its centre."""
    return Theta(Pose(object), {"rotation": _turn(axis)}, "1/rad")


def radar_translation(axis: Vector) -> Theta:
    """Moves the radar."""
    return Theta(RadarPose(), {"translation": _unit(axis)}, "1/m", of_radar=True)


def radar_rotation(axis: Vector) -> Theta:
    """Turns the radar."""
    return Theta(RadarPose(), {"rotation": _turn(axis)}, "1/rad", of_radar=True)


def scale(object: str) -> Theta:
    """Makes an object larger."""
    change = torch.ones((), dtype=torch.float64)
    return Theta(Scale(object), {"log_scale": change}, "per relative size")


def material(object: str, value: MaterialValue, scene: Scene) -> Theta:
    """Changes a value of an object's material.

    Args:
        value: of the material.
    """
    found = scene[object].material
    if value not in vars(found):
        raise InputError(
            f"expected a value of {object}'s material ({', '.join(vars(found))}), "
            f"got {value!r}; choose one"
        )
    module = MaterialValues(object, **{value: getattr(found, value)})
    key = f"raw.{value}"
    raw = module.get_parameter(key).detach()

    def read(parameter: Tensor) -> Tensor:
        moved = torch.func.functional_call(module, {key: parameter}, (scene,))
        return getattr(moved[object].material, value)

    slope = torch.func.jvp(read, (raw,), (torch.ones_like(raw),))[1]
    return Theta(module, {key: torch.ones_like(slope) / slope}, f"per unit of {value}")


def joint(object: str, joint: str, axis: Vector, table: ObjectTable | None = None) -> Theta:
    """Turns a joint of a body.

    Args:
        joint: name.
    """
    item: Any = table
    if _shape(item) != "body":
        raise InputError(f'expected an object with shape = "body", got {object}; choose one')
    body = template(item).scaled(item.scale)
    angles = {
        name: torch.tensor(turn, dtype=torch.float64).deg2rad()
        for name, turn in item.angles_deg.items()
    }
    change = torch.zeros(len(body.parents), 3, dtype=torch.float64)
    change[body.joint(joint)] = _unit(axis)
    module = SkinnedBody(object, body, body.rotations(angles))
    return Theta(module, {"rotation": change}, "1/rad", shape=True)


def latent(object: str, index: Annotated[int, Ge(0)], table: ObjectTable | None = None) -> Theta:
    """Changes a coordinate of a vehicle or prior, in standard deviations.

    Args:
        index: from 0.
    """
    item: Any = table
    whole = getattr(item, "scale", None) == 1
    if _shape(item) == "vehicle" and whole and item.max_edge is None:
        start = torch.zeros(max(index + 1, len(item.coefficients)), dtype=torch.float64)
        start[: len(item.coefficients)] = torch.tensor(item.coefficients, dtype=torch.float64)
        module = LinearShape(object, load_vehicle_space(item.folder, item.level), start)
    elif _shape(item) == "prior" and whole:
        prior = load_prior(item.prior)
        start = torch.zeros(prior.latent_size, dtype=torch.float64)
        module = PriorShape(object, prior, start.new_tensor(item.latent) if item.latent else start)
    else:
        raise InputError(
            'expected an object with shape = "vehicle" without max_edge, or "prior", and scale 1, '
            f"got {object}; choose one"
        )
    if index >= len(module.latent):
        raise InputError(
            f"expected an index below {len(module.latent)} of a latent, got {index}; count from 0"
        )
    change = torch.zeros_like(module.latent.detach())
    change[index] = 1.0
    return Theta(module, {"latent": change}, "per unit of the latent", shape=True)


def distance(
    object: str,
    center: Vector,
    width: Positive,
    low: Vector,
    high: Vector,
    counts: Counts,
    mesh: Mesh,
) -> Theta:
    """Moves the surface of a signed distance outwards, in a round bump.

    Args:
        center: of the bump, in the object's frame [m].
        width: standard deviation of the bump [m].
    """
    inside = partial(signed_distance, mesh)
    module = DistanceGrid.sampled(object, low, high, counts, inside)
    # The surface moves outwards where the distance falls.
    bump = _bump(module.lattice, center, width)
    return Theta(module, {"value": -bump}, "1/m", shape=True)


def density(
    object: str,
    center: Vector,
    width: Positive,
    low: Vector,
    high: Vector,
    counts: Counts,
    extinction: Positive,
    mesh: Mesh,
) -> Theta:
    """Thickens a cloud in the object's place, in a round bump.

    Args:
        center: of the bump, in the object's frame [m].
        width: standard deviation of the bump [m].
        extinction: of the cloud [1/m].
    """
    lattice = Lattice.between(low, high, counts)
    inside = -signed_distance(mesh, lattice.nodes.reshape(-1, 3))
    share = torch.sigmoid(4 * inside / lattice.spacing.mean()).reshape(lattice.counts)
    cloud = DensityGrid(object, low, high, extinction * share)
    with torch.no_grad():
        # σ = softplus(value) / h: this change of the value changes σ by σ times the bump.
        slope = torch.sigmoid(cloud.value) / torch.nn.functional.softplus(cloud.value)
        change = _bump(lattice, center, width) / slope
    return Theta(cloud, {"value": change}, "per relative density", shape=True)


def _unit(axis: Vector) -> Tensor:
    found = torch.tensor(axis, dtype=torch.float64)
    return found / found.norm()


def _turn(axis: Vector) -> Tensor:
    """A small q = (1, r) turns by the rotation vector r."""
    return torch.cat([torch.zeros(1, dtype=torch.float64), _unit(axis)])


def _bump(lattice: Lattice, center: Vector, width: float) -> Tensor:
    """A round bump with this centre and width at the nodes, 1 in the middle."""
    far = lattice.nodes - lattice.nodes.new_tensor(center)
    return torch.exp(-far.square().sum(-1) / (2 * width**2))


def _shape(item: Any) -> str:
    return getattr(item, "shape", "")
