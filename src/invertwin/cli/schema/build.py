"""From the tables of a run file to the library's values: scenes, parameters."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from invertwin.cli.run_file import prefix_errors, require_section, unknown_object_message
from invertwin.cli.schema import RunFile, SceneFileTable
from invertwin.cli.schema.sensors import grid as grid
from invertwin.cli.schema.sensors import radar as radar
from invertwin.cli.schema.shape_tables import ObjectTable, ShapePoseTable, module_values
from invertwin.errors import InputError
from invertwin.inversion.gradcheck.tangents import ParameterChange, parameter_changes
from invertwin.inversion.loss import CorrelationLoss, RatioLoss, SpectrumLoss
from invertwin.links import PanelPlacement
from invertwin.refusals import refusal
from invertwin.registry.kinds import ConstructorTable
from invertwin.scene import Mesh, Object, Scene, SkinnedBody, merge_meshes
from invertwin.scene.files import CONCRETE, load_scene_xml


def scene(run: RunFile) -> Scene:
    """The scene of the `[scene.<name>]` tables, of the `[scene_file]` and of the `[room]`.

    Raises:
        InputError: A file is missing or broken, a shape is impossible, two objects have one name,
            or the run file names an object that is not there.
    """
    built: dict[str, Object] = {}
    if run.scene_file is not None:
        with prefix_errors("scene_file"):
            built.update(_load_scene_file(run.scene_file).objects)
    if run.room is not None:
        with prefix_errors("room"):
            for name, item in run.room.build().items():
                _require_new(name, built)
                built[name] = item
    for name, table in run.scene.items():
        with prefix_errors(f"scene.{name}"):
            _require_new(name, built)
            built[name] = table.build()
    for path, name in run.object_references():
        if name not in built:
            raise InputError(unknown_object_message(path, name, list(built)))
    return Scene(built)


def _require_new(name: str, built: Mapping[str, Object]) -> None:
    if name in built:
        raise refusal("build.taken_name", name)


def true_scene(run: RunFile) -> Scene:
    """The scene with the placements and materials of the `[truth.<name>]` tables."""
    found = scene(run)
    for name, truth in run.truth.items():
        changes = {key: value for key, value in truth if value is not None}
        parts = changes.pop("parts", None)
        with prefix_errors(f"truth.{name}"):
            shape = {} if parts is None else {"mesh": merge_meshes([p.build() for p in parts])}
            if name in run.scene:
                item = run.scene[name].model_copy(update=changes).build(**shape)
            else:
                # Objects of a file have no position of their own: they are scaled and placed from
                # where it puts them. Furniture has one, which stays where no other is stated.
                made_of, item = changes.pop("material", None), found[name]
                if "angles_deg" in changes:
                    raise refusal("build.angles_of_a_mesh", name)
                if (velocity := changes.pop("velocity", None)) is not None:
                    item = replace(item, velocity=torch.tensor(velocity, dtype=torch.float64))
                changes.setdefault("position", item.transform[:3, 3].tolist())
                place = ShapePoseTable(**changes)
                mesh = Mesh(item.mesh.vertices * place.scale, item.mesh.faces)
                item = replace(item, mesh=shape.get("mesh", mesh), pose=place.build_pose())
                if made_of is not None:
                    with prefix_errors("material"):
                        item = replace(item, material=made_of.build({Mesh: item.mesh}))
        found = Scene({**found.objects, name: item})
    return found


def _load_scene_file(table: SceneFileTable) -> Scene:
    materials = {}
    for name, found in table.materials.items():
        with prefix_errors(f"materials.{name}"):
            materials[name] = found.build()
    with prefix_errors("material"):
        others = CONCRETE if table.material is None else table.material.build()
    return load_scene_xml(table.file, materials, others)


def build_section(run: RunFile, section: str, given: Mapping[type, object] | None = None) -> Any:
    """Build the object of a run-file section with its constructor.

    Args:
        run: The run file.
        section: Such as "loss".
        given: Values that a constructor may ask for, by their type.
    """
    with prefix_errors(section):
        return getattr(run, section).build(given)


def build_loss(run: RunFile) -> Callable[[Tensor, Tensor], Tensor]:
    """The loss of `[loss]`; without it the one that suits the data.

    Levels in decibels are compared as they are: their gain means something. A placement has an aim
    in place of data.
    """
    if run.placement is not None:
        return RatioLoss()
    if run.aim is not None:
        return run.aim.loss
    if run.loss is not None:
        found = build_section(run, "loss")
        plain = run.map is not None and "kind" not in run.loss.model_fields_set
        return replace(found, kind="mse") if plain else found
    if run.map is not None:
        return SpectrumLoss("mse", levels=1, gain="one")
    moving = any(table.kind == "mover" for table in run.parameters)
    return CorrelationLoss() if moving else SpectrumLoss()


def module_builders(
    tables: Sequence[Any], objects: Mapping[str, ObjectTable] | None = None
) -> dict[str, Callable[[Scene], nn.Module]]:
    """Return the builders of the `[[parameters]]` modules for a scene, by name, in order.

    Bodies and learned shapes are those of their `[scene.<name>]` tables, the objects.
    """
    return {
        name: partial(_build_module, table, f"parameters[{i}]", objects or {})
        for i, (name, table) in enumerate(tables_by_name(tables).items())
    }


def tables_by_name(tables: Sequence[Any]) -> dict[str, Any]:
    """The `[[parameters]]` tables by what stages and variants call them."""
    names = [table.name or table.kind for table in tables]
    # Twice the same kind without names is fine where nothing calls them by name.
    names = [f"{n}_{i}" if n in names[:i] else n for i, n in enumerate(names)]
    return dict(zip(names, tables, strict=True))


def parameters(
    tables: Sequence[Any], scene: Scene, objects: Mapping[str, ObjectTable] | None = None
) -> list[nn.Module]:
    """The modules of the `[[parameters]]` tables; each starts as the object is, or as it says.

    Raises:
        InputError: A material value that the object's material does not have, or that starts at
            the end of its range; a box that does not hold the object.
    """
    return [make(scene) for make in module_builders(tables, objects).values()]


def fitted_body(run: RunFile, scene: Scene, name: str) -> SkinnedBody | None:
    """The body of an object whose joints are fitted; None for other objects.

    Args:
        run: Tells what is fitted.
        scene: Where the body is as it was built.
        name: Of the object.
    """
    fitted = [table for table in run.parameters if table.kind == "body" and table.object == name]
    found = parameters(fitted[:1], scene, run.scene)
    return found[0] if found else None  # type: ignore[return-value]


def tangent(run: RunFile, scene: Scene) -> tuple[nn.Module, dict[str, ParameterChange]]:
    """The module that a gradient check moves, and how its values change with θ.

    Args:
        run: With a `[gradcheck]` table.
        scene: At θ = 0.
    """
    table = require_section(run, "gradcheck", "a gradient check")
    if table.parameter.kind == "transmitter":
        sensor = require_section(run, "transmitter", "a transmitter that moves").build()
        module: nn.Module = table.parameter.build(None, initial=sensor.positions[0])
    else:
        panel: dict[type, object] = {}
        if (own := run.placement) is not None:
            coverage = own.coverage(scene, run.seed)
            panel = {PanelPlacement: own.place(coverage, own.initial, phases=True)}
        module = _build_module(table.parameter, "gradcheck.parameter", run.scene, scene, panel)
    rates = table.tangent.items()
    changes = {n: c.build() if isinstance(c, ConstructorTable) else c for n, c in rates}
    with prefix_errors("gradcheck.tangent"):
        parameter_changes(module, changes)
    return module, changes


def _build_module(
    table: Any,
    path: str,
    objects: Mapping[str, ObjectTable],
    scene: Any,  # a scene, or the sensor that a module of sensors starts from
    more: Mapping[type, object] | None = None,
) -> nn.Module:
    name = getattr(table, "object", None)
    given: dict[type, object] = {Scene: scene, **(more or {})}
    if name is not None:
        given = module_values(name, scene, objects)
    with prefix_errors(path):
        return table.build(given)
