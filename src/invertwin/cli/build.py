"""From the tables of a run file to the library's values: scenes, parameters, starts."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import torch
from torch import Tensor, nn

from invertwin.cli import schema
from invertwin.cli.bodies import SoughtBody
from invertwin.cli.materials import fitted, material
from invertwin.cli.run_file import about as about
from invertwin.cli.run_file import unknown_object
from invertwin.cli.sensors import grid as grid
from invertwin.cli.sensors import radar as radar
from invertwin.cli.shape_tables import density_module, shape_mesh, shape_module, shape_terms
from invertwin.errors import InputError
from invertwin.inversion.loss import SpectrumLoss
from invertwin.inversion.reconstruction import Optimizer
from invertwin.inversion.regularization import Regularizer
from invertwin.radar.parameters import RadarPose
from invertwin.radar.surrogate import Surrogate
from invertwin.scene import (
    Mesh,
    Object,
    Scene,
    rigid,
    rotation_angle,
    rotation_from_vector,
    shapes,
)
from invertwin.scene.files import CONCRETE, load_mesh, load_scene_xml
from invertwin.scene.parameters import (
    Pose,
    Scale,
    Translation,
)


def scene(run: schema.RunFile) -> Scene:
    """The scene of the `[scene.<name>]` tables and of the `[scene_file]`.

    Raises:
        InputError: A file is missing or broken, a shape is impossible, or the run file names an
            object that is not there.
    """
    built: dict[str, Object] = {}
    if run.scene_file is not None:
        with about("scene_file"):
            built.update(_from_file(run.scene_file).objects)
    for name, table in run.scene.items():
        with about(f"scene.{name}"):
            if name in built:
                raise InputError(
                    "expected a name that the scene file does not use, got one of its objects; "
                    "choose another"
                )
            built[name] = _object(table)
    for path, name in run.references():
        if name not in built:
            raise InputError(unknown_object(path, name, list(built)))
    return Scene(built)


def true_scene(run: schema.RunFile) -> Scene:
    """The scene with the placements and materials of the `[truth.<name>]` tables."""
    found = scene(run)
    for name, truth in run.truth.items():
        changes = {key: value for key, value in truth if value is not None}
        parts = changes.pop("parts", None)
        with about(f"truth.{name}"):
            if name in run.scene:
                item = _object(run.scene[name].model_copy(update=changes), parts)
            else:
                # Objects of a file stand where it puts them: they are scaled and placed from there.
                made_of = changes.pop("material", None)
                item, place = found[name], schema.Placement(**changes)
                mesh = Mesh(item.mesh.vertices * place.scale, item.mesh.faces)
                if parts is not None:
                    mesh = _joined(parts)
                item = replace(item, mesh=mesh, pose=_pose(place))
                if made_of is not None:
                    item = replace(item, material=material(made_of, mesh))
        found = Scene({**found.objects, name: item})
    return found


def _from_file(table: schema.SceneFile) -> Scene:
    materials = {name: material(found, None) for name, found in table.materials.items()}
    others = CONCRETE if table.material is None else material(table.material, None)
    return load_scene_xml(table.file, materials, others)


def _object(table: schema.SceneObject, parts: Sequence[schema.Part] | None = None) -> Object:
    velocity = None if table.velocity is None else _float64(table.velocity)
    mesh = _mesh(table) if parts is None else _joined(parts)
    return Object(mesh, material(table.material, mesh), _pose(table), velocity)


def _pose(table: schema.Placement) -> Tensor:
    turn = rotation_from_vector(torch.deg2rad(_float64(table.rotation_deg)))
    return rigid(turn, _float64(table.position))


def _mesh(table: schema.Placement) -> Mesh:
    """The mesh in the object's frame, scaled but not placed."""
    match table:
        case schema.Plate():
            mesh = shapes.plate(table.width, table.height, table.divisions)
        case schema.Box():
            mesh = shapes.box(table.size, table.divisions)
        case schema.Sphere():
            mesh = shapes.sphere(table.radius, table.subdivisions)
        case schema.Dihedral():
            mesh = shapes.dihedral(table.edge)
        case schema.Trihedral():
            mesh = shapes.trihedral(table.edge)
        case schema.Text():
            mesh = shapes.text(table.text, table.size, table.depth, table.max_edge)
        case schema.File():
            mesh = load_mesh(table.file)
        case schema.Parts():
            mesh = _joined(table.parts)
        case _:
            mesh = shape_mesh(table)
    return Mesh(mesh.vertices * table.scale, mesh.faces)


def _joined(parts: Sequence[schema.Part]) -> Mesh:
    vertices, faces, count = [], [], 0
    for part in parts:
        mesh, pose = _mesh(part), _pose(part)
        vertices.append(mesh.vertices @ pose[:3, :3].T + pose[:3, 3])
        faces.append(mesh.faces + count)
        count += len(mesh.vertices)
    return Mesh(torch.cat(vertices), torch.cat(faces))


def surrogate(table: schema.Surrogate) -> Surrogate:
    """The smooth model of the `[surrogate]` table, at its starting widths.

    Of the exact chain the response, its mean over phases.
    """
    return Surrogate(**table.model_dump(exclude={"exact"}))


def loss(table: schema.Loss) -> SpectrumLoss:
    """How maps are compared, from the `[loss]` table."""
    return SpectrumLoss(**table.model_dump(exclude_none=True))


def optimizer(table: schema.Optimizer) -> Optimizer:
    """The rates of the `[optimizer]` table."""
    return Optimizer(**table.model_dump(exclude_none=True))


@dataclass(frozen=True)
class Start:
    """Where a fit starts.

    Attributes:
        scene: Objects where they are thought to be.
        bodies: Whose joints are sought, by object.
    """

    scene: Scene
    bodies: Mapping[str, SoughtBody] = field(default_factory=dict)


def builders(
    tables: Sequence[schema.Parameter],
    start: Start,
    objects: Mapping[str, schema.SceneObject] | None = None,
) -> dict[str, Callable[[Scene], nn.Module]]:
    """What makes the modules of the `[[parameters]]` tables for a scene, by name, in order.

    Args:
        tables: What is sought.
        start: Where the fit starts.
        objects: The `[scene.<name>]` tables, whose coordinates learned shapes start from.
    """
    objects = objects or {}
    return {
        name: partial(_module, table, f"parameters[{i}]", start, objects)
        for i, (name, table) in enumerate(named(tables).items())
    }


def named(tables: Sequence[schema.Parameter]) -> dict[str, schema.Parameter]:
    """The `[[parameters]]` tables by what stages and variants call them."""
    names = [getattr(table, "name", None) or table.kind for table in tables]
    # Twice the same kind without names is fine where nothing calls them by name.
    names = [f"{n}_{i}" if n in names[:i] else n for i, n in enumerate(names)]
    return dict(zip(names, tables, strict=True))


def parameters(
    tables: Sequence[schema.Parameter],
    scene: Scene,
    bodies: Mapping[str, SoughtBody] | None = None,
    objects: Mapping[str, schema.SceneObject] | None = None,
) -> list[nn.Module]:
    """The modules of the `[[parameters]]` tables; each starts as the object is, or as it says.

    Raises:
        InputError: A material value that the object's material does not have, or that starts at
            the end of its range; a box that does not hold the object.
    """
    makers = builders(tables, Start(scene, bodies or {}), objects)
    return [make(scene) for make in makers.values()]


def _module(
    table: schema.Parameter,
    path: str,
    start: Start,
    objects: Mapping[str, schema.SceneObject],
    scene: Scene,
) -> nn.Module:
    match table:
        case schema.TranslationParameter():
            return Translation(table.object, axes="".join(table.axes))
        case schema.PoseParameter():
            axes, turns = "".join(table.axes), "".join(table.rotation_axes)
            return Pose(table.object, axes=axes, rotation_axes=turns)
        case schema.ScaleParameter():
            return Scale(table.object)
        case schema.MaterialParameter():
            with about(f"{path}.values, material of {table.object}"):
                return fitted(table, scene[table.object].material)
        case schema.RadarParameter():
            return RadarPose()
        case schema.DensityParameter():
            with about(path):
                return density_module(table, scene[table.object])
    with about(path):
        item = objects.get(table.object)
        return shape_module(table, scene[table.object].mesh, start.bodies, item)


def regularizers(
    tables: Mapping[str, schema.Parameter],
    modules: Mapping[str, nn.Module],
    scenes: Mapping[str, Scene],
) -> list[Regularizer]:
    """The terms that shapes add to the loss.

    Args:
        tables: All parameters, by name.
        modules: Those of a fit, by name.
        scenes: By name, where they start.
    """
    terms: list[Regularizer] = []
    for name, module in modules.items():
        terms += shape_terms(tables[name], module, scenes[name])
    return terms


def starts(
    table: schema.Starts,
    scene: Scene,
    truth: Scene,
    seed: int,
    bodies: Mapping[str, SoughtBody] | None = None,
) -> list[Start]:
    """From where the fits of the `[starts]` table start.

    Args:
        table: How many, how far from the truth.
        scene: The scene as known; only the pose of the object is replaced.
        truth: The true scene.
        seed: Used where the table has none; the same seed gives the same starts.
        bodies: Whose joints are sought, by object.
    """
    generator = torch.Generator().manual_seed(seed if table.seed is None else table.seed)

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))

    def direction(axes: Sequence[str]) -> Tensor:
        vector = torch.randn(3, generator=generator, dtype=torch.float64)
        vector = vector * _float64([axis in axes for axis in "xyz"])
        return vector / vector.norm()

    found = []
    for _ in range(table.count):
        offset = uniform(*table.distance) * direction(table.axes)
        axis = direction("xyz")
        if table.rotation_axis is not None:
            fixed = _float64(table.rotation_axis)
            axis = fixed / fixed.norm() * (1 if uniform(0, 1) < 0.5 else -1)
        rotation = math.radians(uniform(*table.angle_deg)) * axis
        moved = displaced(truth, table.object, offset, rotation)[table.object]
        turn = moved.transform[:3, :3]
        # The object as known may have another size: it is its centre that is placed.
        place = moved.center - turn @ scene[table.object].mesh.center
        begun = scene.replace(table.object, pose=rigid(turn, place))
        body = (bodies or {}).get(table.object)
        if body is not None and table.joint_deg > 0:
            angle = math.radians(table.joint_deg)
            mesh = body.turned(truth[table.object].mesh, angle, generator)
            begun = begun.replace(table.object, mesh=mesh, pose=moved.transform)
        found.append(Start(begun, bodies or {}))
    return found


def displaced(scene: Scene, name: str, offset: Tensor, rotation: Tensor) -> Scene:
    """The scene with one object turned about its centre and moved.

    Args:
        scene: Where everything is.
        name: The object.
        offset: [3], m.
        rotation: Rotation vector [3], rad.
    """
    item = scene[name]
    turn = rotation_from_vector(rotation)
    motion = rigid(turn, offset + item.center - turn @ item.center)
    return scene.replace(name, pose=motion @ item.transform)


@dataclass(frozen=True)
class Residual:
    """How one object differs from where it really is."""

    offset: Tensor  # [3], m, of its centre
    angle: float  # rad
    scale: float

    @property
    def distance(self) -> float:
        """Length of the offset [m]."""
        return float(self.offset.norm())


def residual(found: Object, truth: Object) -> Residual | None:
    """The similarity transform that remains between two copies of an object.

    Least squares over the vertices (Umeyama), so it does not depend on how the pose is
    parameterised. None for other triangles: no vertex is another one's copy.
    """
    same = found.vertices.shape == truth.vertices.shape
    if not same or not torch.equal(found.mesh.faces, truth.mesh.faces):
        return None
    a, b = found.vertices.detach(), truth.vertices.detach()
    a0, b0 = a - a.mean(0), b - b.mean(0)
    u, values, vt = torch.linalg.svd(b0.T @ a0)
    sign = torch.ones(3, dtype=torch.float64)
    sign[2] = torch.det(u @ vt).sign()
    turn = u @ torch.diag(sign) @ vt
    scale = float(b0.square().sum() / (values * sign).sum())
    offset = found.center.detach() - truth.center.detach()
    return Residual(offset, float(rotation_angle(turn)), 1 / scale if scale else math.nan)


def _float64(values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)
