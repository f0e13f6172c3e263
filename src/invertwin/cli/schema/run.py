"""A whole run file."""

import json
import re
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, create_model, model_validator
from pydantic_core import PydanticCustomError

from invertwin.cli.registry import load_plugins
from invertwin.cli.schema.initial import Initial
from invertwin.cli.schema.inversion import (
    Calibration,
    Data,
    Gradcheck,
    Landscape,
    Loss,
    Optimizer,
    Reconstruct,
    Starts,
    Surrogate,
)
from invertwin.cli.schema.objects import SceneFile, SceneObject, Truth
from invertwin.cli.schema.parameters import (
    Parameter,
    PriorParameter,
    RadarParameter,
    ShapeSpaceParameter,
)
from invertwin.cli.schema.recording import Chirps, Impairments, Raw
from invertwin.cli.schema.section import Positive, Section, Seed, fail
from invertwin.cli.schema.sensor import Grid, Radar
from invertwin.cli.schema.stages import Measures, Stage, Variant

# How a run calls its own fits, and how names of its metrics end.
_TAKEN = ("full", "interior_only", "whole", "seen", "count", "m", "number", "consistency")


class Observed(Section):
    """What one of several sensors recorded; without a key as at the top of the file."""

    radar: Radar | None = None
    """what measures"""
    grid: Grid | None = None
    """the map that is compared"""
    chirps: Chirps | None = None
    """several ramps a frame"""
    data: Data | None = None
    """what is fitted"""
    surrogate: Surrogate | None = None
    """kernels of the smooth model"""
    weight: Positive = 1.0
    """share in the loss"""


class _RunFile(Section):
    """A whole run file; which sections a command needs is checked by the command."""

    task: Literal["simulate", "reconstruct", "gradcheck", "loss-scan", "demo"]
    """what the file is for"""
    title: str = ""
    """heading of the report"""
    note: str = ""
    """shown in the report"""
    seed: Seed = 0
    """of everything random"""
    scene: dict[str, SceneObject] = {}
    """[scene.<name>]: an object each"""
    scene_file: SceneFile | None = None
    """objects from a file"""
    truth: dict[str, Truth] = {}
    """[truth.<name>]: where an object really is"""
    radar: Radar | None = None
    """what measures; not with a capture"""
    grid: Grid | None = None
    """the map that is compared"""
    chirps: Chirps | None = None
    """several ramps a frame, for simulate"""
    impairments: Impairments | None = None
    """what the front end of simulated data adds"""
    raw: Raw | None = None
    """raw files that simulate writes beside the capture"""
    data: Data | None = None
    """what is fitted"""
    observations: dict[str, Observed] = {}
    """[observations.<name>]: what each of several sensors recorded"""
    parameters: list[Parameter] = []
    """[[parameters]]: what is sought"""
    starts: Starts | None = None
    """where fits start; without it where the scene says"""
    initial: Initial | None = None
    """where the fit starts by conventional processing, not with [starts]"""
    surrogate: Surrogate = Surrogate()
    """kernels of the smooth model"""
    loss: Loss = Loss()
    """how maps are compared"""
    optimizer: Optimizer = Optimizer()
    """how a gradient becomes a step"""
    reconstruct: Reconstruct | None = None
    """the fit"""
    stages: list[Stage] = []
    """[[stages]]: parts of the fit, one after another; without them one"""
    variants: dict[str, Variant] = {}
    """[variants.<name>]: other ways to fit, to compare"""
    measures: Measures | None = None
    """of the found shape"""
    calibration: Calibration | None = None
    """before the fit"""
    landscape: Landscape | None = None
    """losses along a line"""
    gradcheck: Gradcheck | None = None
    """the gradient check"""

    @model_validator(mode="after")
    def _names_exist(self) -> "_RunFile":
        if self.scene_file is None:
            if not self.scene:
                fail("expected at least 1 object, got none; add [scene.<name>]", "scene")
            # The names of a scene file are known once it is read.
            for path, name in self.references():
                if name not in self.scene:
                    raise PydanticCustomError(
                        "unknown_object", "unknown object", {"path": path, "name": name}
                    )
        return self

    @model_validator(mode="after")
    def _variants_are_named(self) -> "_RunFile":
        for name in self.variants:
            if name in _TAKEN or not re.fullmatch("[A-Za-z][A-Za-z0-9_]*", name):
                fail(
                    "expected names of letters, digits and _ that begin with a letter, other than "
                    f"{', '.join(_TAKEN)}, got {json.dumps(name)}; choose another",
                    "variants",
                )
        return self

    @model_validator(mode="after")
    def _parameters_are_named(self) -> "_RunFile":
        known = self.parameter_names
        doubled = next((name for name in known if known.count(name) > 1), None)
        staged = [("stages", self.stages)]
        for name, variant in self.variants.items():
            staged.append((f"variants.{name}.stages", variant.stages or []))
            _named(variant.parameters or [], known, f"variants.{name}.parameters")
        if self.reconstruct is not None:
            _named(self.reconstruct.parameters, known, "reconstruct.parameters")
        for path, stages in staged:
            for i, stage in enumerate(stages):
                _named(stage.parameters, known, f"{path}[{i}].parameters")
        if doubled and (self.stages or self.variants):
            fail(f'expected parameters of different names, got "{doubled}" twice; add `name`')
        return self

    @model_validator(mode="after")
    def _turned_joints_are_sought(self) -> "_RunFile":
        if self.starts is not None and self.starts.joint_deg > 0:
            name = self.starts.object
            if not any(p.kind == "body" and p.object == name for p in self.parameters):
                fail(
                    f'expected a parameter with kind = "body" of {name}, whose joints it turns, '
                    "got none; add one, or remove `joint_deg`",
                    "starts.joint_deg",
                )
        return self

    @model_validator(mode="after")
    def _stages_remesh_what_they_seek(self) -> "_RunFile":
        names = self.parameter_names
        free = {n for n, p in zip(names, self.parameters, strict=True) if p.kind == "vertices"}
        own = set(self.reconstruct.parameters if self.reconstruct else []) or set(names)
        staged = [("stages", self.stages, set(own))]
        for name, variant in self.variants.items():
            sought = set(variant.parameters or own)
            if variant.stages is None:
                staged[0][2].update(sought)
            else:
                staged.append((f"variants.{name}.stages", variant.stages, sought))
        for path, stages, sought in staged:
            for i, stage in enumerate(stages):
                if stage.remesh is not None and not free & sought & set(stage.parameters or names):
                    fail(
                        'expected a parameter with kind = "vertices" among those of the stage, got '
                        "none; add one, or remove `remesh`",
                        f"{path}[{i}].remesh",
                    )
        return self

    @model_validator(mode="after")
    def _learned_shapes_have_their_own_size(self) -> "_RunFile":
        for parameter in self.parameters:
            if not isinstance(parameter, ShapeSpaceParameter | PriorParameter):
                continue
            name, why = parameter.object, f'an object sought with kind = "{parameter.kind}"'
            scale = self.scene[name].scale if name in self.scene else 1.0
            if scale != 1:
                fail(f"expected 1 of {why}, got {scale:g}; remove it", f"scene.{name}.scale")
            if self.initial is not None and self.initial.object == name and self.initial.scale:
                fail(f"expected false with {why}, got true; remove it", "initial.scale")
        return self

    @property
    def parameter_names(self) -> list[str]:
        """What stages and variants call the parameters."""
        return [getattr(p, "name", None) or p.kind for p in self.parameters]

    def references(self) -> list[tuple[str, str]]:
        """Where the run file names an object of the scene: path and name."""
        used = [(f"truth.{name}", name) for name in self.truth]
        for i, parameter in enumerate(self.parameters):
            if not isinstance(parameter, RadarParameter):
                used.append((f"parameters[{i}].object", parameter.object))
        for section in type(self).model_fields:
            name = getattr(getattr(self, section), "object", None)
            if name is not None:
                used.append((f"{section}.object", name))
        if self.gradcheck is not None and self.gradcheck.parameter.object is not None:
            used.append(("gradcheck.parameter.object", self.gradcheck.parameter.object))
        return used


def _named(used: list[str], known: list[str], path: str) -> None:
    for name in used:
        if name not in known:
            got = f'expected names of parameters ({", ".join(known)}), got "{name}"; correct it'
            fail(got, path)


def _with_plugins() -> type[_RunFile]:
    """The run file with the sections of installed plugins."""
    added: Any = {
        name: (model | None, Field(None, description=(model.__doc__ or "").split(".")[0]))
        for name, model in load_plugins().sections.items()
    }
    return create_model("RunFile", __base__=_RunFile, __doc__=_RunFile.__doc__, **added)


if TYPE_CHECKING:
    RunFile = _RunFile
else:
    RunFile = _with_plugins()
