"""Shapes of run files: objects and their parts, and what is fitted of them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal, get_args

import torch
from annotated_types import MinLen
from pydantic import BeforeValidator
from torch import Tensor, nn

from invertwin import scene as scenes
from invertwin.checks import ArrayLike, Point, check_choice
from invertwin.errors import InputError
from invertwin.inversion.regularization import Laplacian, LatentNorm, Regularizer
from invertwin.limits import Axes, Count, NonNegative, Positive
from invertwin.links.metasurface.wall_path import PanelPlacement
from invertwin.radar import RadarPose, RadarTrajectory
from invertwin.refusals import refusal
from invertwin.registry.kinds import ConstructorTable, KindGroup, OneOf, Registry
from invertwin.registry.section import Counts, InputPath, Vector, prefix_errors
from invertwin.scene.files import load_mesh
from invertwin.scene.parameters import MaterialValues, Pose, Scale, Translation, Vertices
from invertwin.scene.people.body import BodyTemplate
from invertwin.scene.people.body_models import body, body_template

# A table alone stands for a list of it.
_ONE_OR_MORE = BeforeValidator(lambda given: [given] if isinstance(given, dict) else given)
_MoverPart = Literal["place", "velocity", "spin", "size", "diffuse"]


class ShapePoseTable(ConstructorTable):
    """Pose of a shape: scaled, then rotated about its own origin, then moved.

    Attributes:
        position: m
        rotation_deg: rotation vector
        scale: factor
    """

    position: Vector = [0.0, 0.0, 0.0]
    rotation_deg: Vector = [0.0, 0.0, 0.0]
    scale: Positive = 1.0

    def build_mesh(self) -> scenes.Mesh:
        """Build the mesh in its own frame, scaled but not placed."""
        mesh = super().build()
        return scenes.Mesh(mesh.vertices * self.scale, mesh.faces)

    def build_pose(self) -> Tensor:
        """Build the pose matrix [4, 4]."""
        turn = torch.tensor(self.rotation_deg, dtype=torch.float64).deg2rad()
        place = torch.tensor(self.position, dtype=torch.float64)
        return scenes.rigid(scenes.rotation_from_vector(turn), place)

    def build(self, given: Any = None, /, **more: Any) -> Any:
        """The mesh as a part of an object, placed within it."""
        mesh, pose = self.build_mesh(), self.build_pose()
        return scenes.Mesh(mesh.vertices @ pose[:3, :3].T + pose[:3, 3], mesh.faces)


class _ObjectProperties(ConstructorTable):
    """Material and motion of an object.

    Attributes:
        material: what it is made of
        velocity: m/s
        motion: what it does from the start of the frame on, one after the other; needs [chirps]
    """

    material: Annotated[Any, OneOf("material")]
    velocity: Vector | None = None
    motion: Annotated[list[Annotated[Any, OneOf("motion")]], _ONE_OR_MORE] = []


class ObjectTable(ShapePoseTable, _ObjectProperties):
    """Object of the scene: a shape with its material and motion."""

    def build(self, given: Any = None, /, **more: Any) -> scenes.Object:
        """The object; `mesh` stands in for its shape."""
        mesh = more["mesh"] if more else self.build_mesh()
        with prefix_errors("material"):
            material = self.material.build({scenes.Mesh: mesh})
        still = self.velocity is None
        velocity = None if still else torch.tensor(self.velocity, dtype=torch.float64)
        return scenes.Object(mesh, material, self.build_pose(), velocity)


class RoomTable(ConstructorTable):
    """A furnished room, whose objects stand beside those of `[scene.<name>]`.

    Attributes:
        materials: materials by the room's objects, in place of their own
    """

    materials: dict[str, Annotated[Any, OneOf("material")]] = {}

    def build(self, given: Any = None, /, **more: Any) -> dict[str, scenes.Object]:
        """Its objects by name.

        Raises:
            InputError: A room that the library refuses, or materials of what is not in it.
        """
        found: dict[str, scenes.Object] = super().build(given, **more)
        for name, table in self.materials.items():
            with prefix_errors(f"materials.{name}"):
                check_choice(name, found, "an object of the room:", "correct it")
                own = table.build({scenes.Mesh: found[name].mesh})
                found[name] = replace(found[name], material=own)
        return found


class ParameterTable(ConstructorTable):
    """Keys common to all parameters.

    Attributes:
        name: by which stages and variants call it; without it its kind
        rate: its own learning rate; without it the optimizer's
    """

    name: str | None = None
    rate: Positive | None = None


class LatentTable(ConstructorTable):
    """Coordinates in standard deviations.

    Attributes:
        weight: weight of ½ Σ z²
    """

    weight: NonNegative = 0.0


class LearnedTable(LatentTable):
    """Coordinates of a learned shape, which has a size of its own."""


class MovingTargetParameter(ParameterTable):
    """Place, size, velocity, turn and diffuse share of a rough body in motion.

    Starts at the strongest echo that moves, with the object's size; the data must have chirps.

    Attributes:
        object: name in the scene
        cells: range and Doppler cells to either side of the echo that are fitted
        free: what is fitted; the rest keeps the scene's values, and a spin that is held is none
    """

    kind: Literal["mover"]
    object: str
    cells: Count = 6
    free: list[_MoverPart] = [*get_args(_MoverPart)]


class PanelPhases(ParameterTable):
    """Phases of the elements of the metasurface of `[placement]`."""

    kind: Literal["panel_phases"]


class PanelParameter(ParameterTable):
    """Position, yaw and beam of the metasurface of `[placement]`."""

    kind: Literal["panel"]

    def build(self, given: Mapping[type, object] | None = None, /, **more: Any) -> PanelPlacement:
        """The module of the section."""
        found = (given or {}).get(PanelPlacement)
        if not isinstance(found, PanelPlacement):
            raise refusal("shape_tables.no_placement")
        return found


def register(registry: Registry) -> None:
    """Add shapes, and the modules that fit them."""
    registry.groups["shape"] = KindGroup(tag="shape", base=ShapePoseTable, product=scenes.Mesh)
    registry.groups["object"] = KindGroup(tag="shape", base=ObjectTable, includes="shape")
    registry.groups["parameter"] = KindGroup(base=ParameterTable)
    registry.bases |= dict.fromkeys((scenes.PriorShape, scenes.LinearShape), LearnedTable)
    registry.bases[RadarTrajectory] = LatentTable
    bodies = {ObjectTable, BodyTemplate, scenes.Walking, scenes.Sitting}
    registry.given |= bodies | {scenes.Scene, scenes.Mesh, scenes.Object}
    registry.groups["motion"] = KindGroup()
    motions = {"walking": scenes.Walking, "sitting": scenes.Sitting, "waving": scenes.Waving}
    motions |= {"breathing": scenes.Breathing, "turning": scenes.AxisRotation}
    for name, motion in {**motions, "along": follow_spline}.items():
        registry.add("motion", name, motion, checked=False)
    for name in ("plate", "box", "sphere", "cylinder", "dihedral", "trihedral", "text"):
        registry.add("shape", name, getattr(scenes.shapes, name))
    registry.add("shape", "prior", learned_car)
    registry.add("shape", "body", body)
    registry.add("shape", "file", load_mesh, untagged=True)
    registry.add("object", "parts", scenes.merge_meshes, untagged=True)
    registry.add("parameter", "translation", Translation, without=("initial",))
    registry.add("parameter", "pose", Pose, without=("translation", "rotation"))
    registry.add("parameter", "scale", Scale, without=("initial",))
    registry.add("parameter", "vertices", free_vertices)
    registry.add("parameter", "lattice", scenes.LatticeDeformation)
    registry.add("parameter", "distance_grid", scenes.DistanceGrid.from_mesh)
    registry.add("parameter", "neural_distance", scenes.NeuralDistance, without=("seed",))
    registry.add("parameter", "density", scenes.DensityGrid.from_object)
    registry.add("parameter", "prior", prior_shape)
    registry.add("parameter", "body", body_joints)
    registry.add("parameter", "material", MaterialValues.from_object)
    registry.add("parameter", "radar_pose", RadarPose, without=("translation", "rotation"))
    registry.add("parameter", "radar_path", RadarTrajectory)
    registry.add("parameter", "mover", MovingTargetParameter)
    registry.add("parameter", "panel", PanelParameter)
    registry.add("parameter", "panel_phases", PanelPhases)


def follow_spline(
    times: ArrayLike, places: Sequence[Point], heading: bool = False
) -> scenes.TrajectoryMotion:
    """Carry the object along a natural cubic spline; its position counts from the spline's place.

    Args:
        times: when each place is reached, rising; the frame must end before the last [s].
        places: x, y and z of each [m].
        heading: turn it about the vertical, so that its front, −x, looks where it goes.
    """
    return scenes.TrajectoryMotion(scenes.SplineTrajectory(times, places), heading)


def learned_car(
    latent: Sequence[float] | None = None, prior: InputPath | None = None
) -> scenes.Mesh:
    """A car of the learned prior: x ahead, y to the left, z up, on the ground z = 0.

    Args:
        latent: coordinates; without them the mean car.
        prior: file that `invertwin train-prior` wrote; without it the prior of the package.
    """
    found = scenes.load_prior(prior)
    mean = torch.zeros(found.latent_size, dtype=torch.float64)
    return found.mesh(mean if latent is None else mean.new_tensor(latent))


def free_vertices(
    object: str, mesh: scenes.Mesh, laplacian: NonNegative = 0.0, smooth: NonNegative = 0.0
) -> nn.Module:
    """Free vertices, held together by a Laplacian term, or moved in smooth steps.

    Args:
        laplacian: weight of the term; 0 = none.
    """
    if smooth > 0:
        return scenes.SmoothVertices(object, mesh, smooth)
    return Vertices(object, len(mesh.vertices))


def prior_shape(
    object: str,
    table: ObjectTable | None = None,
    file: InputPath | None = None,
    counts: Counts | None = None,
) -> scenes.PriorShape:
    """Coordinates of the learned prior of vehicles, from those of its object, else the mean car.

    Args:
        table: of the object; its coordinates count where they are of the same prior.
        file: that `invertwin train-prior` wrote; without it the prior of the package.
        counts: nodes along x, y and z at which it is meshed; without it every 0.1 m or so.
    """
    own: Any = table
    same = getattr(own, "shape", None) == "prior" and own.prior == file
    return scenes.PriorShape(object, scenes.load_prior(file), own.latent if same else None, counts)


def body_joints(
    object: str,
    joints: Annotated[Mapping[str, Axes], MinLen(1)],
    mesh: scenes.Mesh,
    table: ObjectTable | None = None,
) -> scenes.SkinnedBody:
    """Joint angles of an object with shape = "body", from those it has.

    Args:
        joints: by name: the components of the rotation vector that are fitted, such as ["z"].

    Raises:
        InputError: The object is no body, or has no such joint.
    """
    body = require_body(table, f'{object}; give it this shape, or use kind = "pose"')
    return scenes.SkinnedBody.from_mesh(object, body, mesh, joints)


def shape_regularizers(table: Any, module: nn.Module, scene: object) -> list[Regularizer]:
    """Terms of the loss that keep a fitted shape, or a path, plausible."""
    if isinstance(scene, scenes.Scene) and table.kind == "vertices" and table.laplacian > 0:
        return [Laplacian(scene, table.object, table.laplacian)]
    if isinstance(table, LatentTable) and table.weight > 0:
        return [LatentNorm(module, table.weight)]
    return []


def module_values(name: str, scene: scenes.Scene, objects: Mapping[str, Any]) -> dict[type, object]:
    """Return the values that an object's module may require beside its keys, at the start."""
    item, table = scene[name], objects.get(name)
    found: dict[type, object] = {scenes.Scene: scene, scenes.Object: item, scenes.Mesh: item.mesh}
    return found if table is None else {**found, ObjectTable: table}


def body_template_of(table: Any) -> BodyTemplate | None:
    """The body of an object's table in its rest pose; None of other shapes.

    Args:
        table: Table of the object.
    """
    if getattr(table, "shape", None) != "body":
        return None
    return body_template(table.model, table.file, table.height, table.spacing).scale(table.scale)


def require_body(table: Any, got: str) -> BodyTemplate:
    """Return the body of an object's table in its rest pose.

    Args:
        table: table of the object.
        got: what is given instead, and what to do, for the message.

    Raises:
        InputError: another shape.
    """
    found = body_template_of(table)
    if found is None:
        raise InputError(f'expected an object with shape = "body", got {got}')
    return found


def joint_positions(
    table: Any, item: scenes.Object, rotations: Tensor | None = None
) -> dict[str, Tensor]:
    """Return joint positions of a body in the world [m], by name; empty for other objects.

    Args:
        table: Table of the object.
        item: Object built from the table.
        rotations: Joint rotations in the parents' frames; by default those of the table.
    """
    template = body_template_of(table)
    if template is None:
        return {}
    if rotations is None:
        turns = {name: torch.tensor(turn).deg2rad() for name, turn in table.angles_deg.items()}
        rotations = scenes.rotation_from_vector(template.rotations(turns))
    world = template.apply_pose(rotations)[1] @ item.transform[:3, :3].T + item.transform[:3, 3]
    return dict(zip(template.names, world, strict=True))
