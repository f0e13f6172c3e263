"""A whole run file."""

import json
import re
from functools import cache, partial
from typing import TYPE_CHECKING, Annotated, Any, Literal

from annotated_types import MinLen
from pydantic import Field, create_model, model_validator
from pydantic_core import PydanticCustomError

from invertwin.channel.sampling import ALL_OTHERS
from invertwin.cli.schema import fits
from invertwin.cli.schema.camera_tables import AnyCamera, AnyImage
from invertwin.cli.schema.dataset import DatasetTable
from invertwin.cli.schema.fit_tables import SurrogateTable
from invertwin.cli.schema.gradcheck import GradcheckTable
from invertwin.cli.schema.placement import Placement
from invertwin.cli.schema.radio import AimTable, AnyMap, TransmitterStartsTable, TransmitterTable
from invertwin.cli.schema.recordings import SimulatedData
from invertwin.cli.schema.sensors import AnyChirps, AnyGrid, AnyImpairments, AnyRadar
from invertwin.cli.schema.shape_tables import LearnedTable, RoomTable
from invertwin.cli.schema.signature import RcsTable
from invertwin.cli.schema.twin import TwinTable
from invertwin.cli.schema.variation import check_samples
from invertwin.errors import InputError
from invertwin.inversion.gradcheck.gradcheck import GradcheckSettings
from invertwin.limits import NonNegative, Positive
from invertwin.radar.surrogate.surrogate import Surrogate
from invertwin.refusals import refusal_text
from invertwin.registry import section
from invertwin.registry.kinds import NameOf, OneOf, TableOf, load_plugins, registry
from invertwin.registry.section import Section, Vector, raise_key_error
from invertwin.scene.rooms import room
from invertwin.signatures import rcs

# How a run calls its own fits, and how names of its metrics end.
_RESERVED_NAMES = ("full", "whole", "seen", "count", "m", "number", "consistency")

# Keys of a gradient check that say how paths are drawn.
_SAMPLING_KEYS = ("depth", "samples", "boundary_samples", "repeats", "difference_samples", "noise")
_SAMPLING_KEYS += ("max_pairs", "scheme")

_DUMP_GIVEN: dict[str, Any] = {"exclude_unset": True, "exclude_none": True}

AnyMaterial = Annotated[Any, OneOf("material")]
AnyModel = Annotated[Any, OneOf("model")]
AnyData = Annotated[Any, OneOf("data")]
AnyRoom = Annotated[Any, TableOf(room, RoomTable, checked=True)]
AnySurrogate = Annotated[Any, TableOf(Surrogate, SurrogateTable)]
AnyGradcheck = Annotated[Any, TableOf(GradcheckSettings, GradcheckTable)]
_RCS_GIVEN = ("directions", "frequencies", "receivers", "polarisation", "boundary")
AnyRcs = Annotated[Any, TableOf(rcs, RcsTable, _RCS_GIVEN, checked=False)]


class SceneFileTable(Section):
    """Objects from the geometry of a Mitsuba or Sionna scene file (XML), named as in the file.

    Attributes:
        file: path, from the run file's folder
        materials: materials by the file's material ids
        material: material of all other objects; without it concrete
    """

    file: section.InputPath
    materials: dict[str, AnyMaterial] = {}
    material: AnyMaterial | None = None


class TruthTable(Section):
    """True values of an object: they replace those of its scene table, key by key.

    Attributes:
        position: m
        rotation_deg: rotation vector
        scale: factor
        material: what it is really made of
        velocity: m/s
        angles_deg: joint angles of a body: all that are not at rest
        parts: its real shape, in place of the scene's and in the same frame
    """

    position: Vector | None = None
    rotation_deg: Vector | None = None
    scale: Positive | None = None
    material: AnyMaterial | None = None
    velocity: Vector | None = None
    angles_deg: dict[str, Vector] | None = None
    parts: Annotated[list[Annotated[Any, OneOf("shape")]], MinLen(1)] | None = None


class RawTable(Section):
    """Raw files as other tools read them: DCA1000 samples, SDK and mmWave Studio settings.

    Attributes:
        lanes: LVDS lanes: 4 for xWR12xx and xWR14xx, 2 for later ones
        real: real samples instead of I and Q
        bits: bits of the ADC
        full_scale: √(received over sent power) of the largest count; without it 1.25 times the
            largest sample
        adc_start_time: s, from the start of the ramp to the first sample; the waveform is what is
            sampled; 0 = up to 6 µs of the idle time
        frame_period: s, from frame to frame; without it the shortest that holds the chirps
    """

    lanes: Literal[2, 4] = 2
    real: bool = False
    bits: Literal[12, 14, 16] = 16
    full_scale: Positive | None = None
    adc_start_time: NonNegative = 0.0
    frame_period: Positive | None = None


class ObservationTable(Section):
    """Data of one of several sensors; a missing key falls back to the section of its name.

    Attributes:
        radar: what measures; not with a capture
        grid: the map that is compared
        data: what is fitted
        surrogate: kernels of the smooth model
        chirps: several ramps a frame
        model: a forward model in place of the surrogate's
        weight: weight of its loss in the mean
    """

    radar: AnyRadar | None = None
    grid: AnyGrid | None = None
    data: AnyData | None = None
    surrogate: AnySurrogate | None = None
    chirps: AnyChirps | None = None
    model: AnyModel | None = None
    weight: Positive = 1.0


class _RunFile(Section):
    """A whole run file; which sections a command needs is checked by the command.

    Attributes:
        task: what the file is for
        frame: axes: 2 = x ahead, y to the left, z up
        title: heading of the report
        note: shown in the report
        seed: seed of all random numbers
        scene: [scene.<name>]: an object each
        scene_file: objects from a file
        room: a furnished room: floor, ceiling, walls, furniture
        truth: [truth.<name>]: where an object really is
        radar: what measures; not with a capture
        grid: the map that is compared
        chirps: several ramps a frame
        impairments: what the front end of simulated data adds
        raw: raw files that simulate writes beside the capture
        data: what is fitted
        transmitter: what sends, with [map]
        map: what receivers at known places get of [transmitter]
        camera: what sees [image]
        image: what [camera] shows; with [gradcheck] it is differentiated
        transmitter_starts: where fits of the first transmitter start; without it where
            [transmitter] says
        aim: what [transmitter] is placed for, in place of [data]
        observations: [observations.<name>]: several sensors, each with its own data
        parameters: [[parameters]]: what is unknown
        starts: where fits start; without it where the scene says
        search: several poses to begin from at every start; the best end counts
        plan: what `invertwin plan` compares and tries
        twin: the ground that `invertwin twin` searches
        initial: where the fit starts by conventional processing, not with [starts]
        surrogate: kernels of the smooth model
        model: a forward model in place of the surrogate's
        loss: how maps are compared; without it likelihood; of received levels mse as they are, of
            movers correlation
        optimizer: how a gradient becomes a step
        reconstruct: the fit
        stages: [[stages]]: parts of the fit, one after another; without them one
        variants: [variants.<name>]: other ways to fit, to compare
        measures: scores of the found shape
        calibration: calibration before the fit
        landscape: losses along a line
        gradcheck: the gradient check
        placement: a metasurface that is placed; with [gradcheck] what is differentiated
        rcs: the radar signature; with [gradcheck] what is differentiated
        dataset: many samples of the run file
        vary: [[vary]]: what is drawn anew for every sample of [dataset]
    """

    task: Annotated[str, NameOf("task")]
    frame: Literal[2]
    title: section.PrintableText = ""
    note: str = ""
    seed: section.Seed = 0
    scene: dict[str, Annotated[Any, OneOf("object")]] = {}
    scene_file: SceneFileTable | None = None
    room: AnyRoom | None = None
    truth: dict[str, TruthTable] = {}
    radar: AnyRadar | None = None
    grid: AnyGrid | None = None
    chirps: AnyChirps | None = None
    impairments: AnyImpairments | None = None
    raw: RawTable | None = None
    data: AnyData | None = None
    transmitter: TransmitterTable | None = None
    map: AnyMap | None = None
    camera: AnyCamera | None = None
    image: AnyImage | None = None
    transmitter_starts: TransmitterStartsTable | None = None
    aim: AimTable | None = None
    observations: dict[str, ObservationTable] = {}
    parameters: list[Annotated[Any, OneOf("parameter")]] = []
    starts: fits.AnyStarts | None = None
    search: Annotated[Any, OneOf("search")] | None = None
    plan: fits.PlanTable | None = None
    twin: TwinTable | None = None
    initial: fits.AnyInitial | None = None
    surrogate: AnySurrogate = Field({}, validate_default=True)
    model: AnyModel | None = None
    loss: Annotated[Any, OneOf("loss")] | None = None
    optimizer: Annotated[Any, OneOf("optimizer")] = Field({}, validate_default=True)
    reconstruct: fits.ReconstructTable | None = None
    stages: list[fits.StageTable] = []
    variants: dict[str, fits.VariantTable] = {}
    measures: fits.MeasuresTable | None = None
    calibration: fits.CalibrationTable | None = None
    landscape: fits.LandscapeTable | None = None
    gradcheck: AnyGradcheck | None = None
    placement: Placement | None = None
    rcs: AnyRcs | None = None
    dataset: DatasetTable | None = None
    vary: list[Annotated[Any, OneOf("distribution")]] = []

    @model_validator(mode="after")
    def _check_sections(self, info: Any) -> "_RunFile":
        self._check_object_names()
        self._check_gradcheck_sections()
        self._check_variant_names()
        self._check_parameter_names()
        self._check_joint_starts()
        self._check_learned_shapes()
        self._check_overrides(info.context)
        if self.vary and self.dataset is None:
            raise_key_error("expected a section [dataset] with it, got none; add it", "vary")
        if self.dataset is not None:
            self._require_simulated_data()
        # Its errors begin at the table that draws what is wrong.
        check_samples(self, self.dump_without_dataset(), info)
        return self

    def _check_object_names(self) -> None:
        if self.scene_file is None:
            known = [*self.scene, *({} if self.room is None else self.room.build())]
            if not known:
                raise_key_error("expected at least 1 object, got none; add [scene.<name>]", "scene")
            # The names of a scene file are known once it is read.
            for path, name in self.object_references():
                if name not in known:
                    context = {"path": path, "name": name, "known": known}
                    raise PydanticCustomError("unknown_object", "unknown object", context)

    def _check_gradcheck_sections(self) -> None:
        seen = next((n for n in ("image", "map") if getattr(self, n) is not None), None)
        if self.gradcheck is None or (self.rcs is None and seen is None):
            return
        if seen is not None:
            own = ("depth", "samples", "boundary_samples", "scheme")
            given = [f"gradcheck.{n}" for n in own if n in self.gradcheck.model_fields_set]
            others = {"radar", "grid", "rcs", "map"} - {seen}
            for path in [*given, *(n for n in sorted(others) if getattr(self, n))]:
                raise_key_error(refusal_text("run.sections_of_others", seen), path)
            return
        if self.gradcheck.acts_on == "sensor":
            raise_key_error(refusal_text("run.pose_with_rcs"), "gradcheck.parameter.kind")
        given = [name for name in ("radar", "grid") if getattr(self, name) is not None]
        given += [f"gradcheck.{n}" for n in _SAMPLING_KEYS if n in self.gradcheck.model_fields_set]
        for path in given:
            raise_key_error(refusal_text("run.sampling_with_rcs"), path)

    def _check_variant_names(self) -> None:
        for name in self.variants:
            if name in _RESERVED_NAMES or not re.fullmatch("[A-Za-z][A-Za-z0-9_]*", name):
                text = refusal_text("run.variants", ", ".join(_RESERVED_NAMES), json.dumps(name))
                raise_key_error(text, "variants")

    def _check_parameter_names(self) -> None:
        names = [table.name or table.kind for table in self.parameters]
        free = {n for n, t in zip(names, self.parameters, strict=True) if t.kind == "vertices"}
        doubled = next((name for name in names if names.count(name) > 1), None)
        if doubled and (self.stages or self.variants):
            raise_key_error(refusal_text("run.equal_names", doubled))
        own = set(names)
        if self.reconstruct is not None:
            for what, known in (("parameters", names), ("observations", [*self.observations])):
                used = getattr(self.reconstruct, what)
                _require_known_names(what, used, known, f"reconstruct.{what}")
            own = set(self.reconstruct.parameters) or own
        for i, stage in enumerate(self.stages):
            _require_known_names("parameters", stage.parameters, names, f"stages[{i}].parameters")
            fitted = own & set(stage.parameters or names)
            if stage.remesh and fitted and not fitted & free:
                raise_key_error(refusal_text("run.remesh_without_vertices"), f"stages[{i}].remesh")

    def _check_joint_starts(self) -> None:
        if self.starts is not None and self.starts.joint_deg > 0:
            name = self.starts.object
            if not any(p.kind == "body" and p.object == name for p in self.parameters):
                raise_key_error(refusal_text("run.joints_without_body", name), "starts.joint_deg")

    def _check_learned_shapes(self) -> None:
        unknowns = self.parameter_tables.values()
        learned: list[Any] = [table for table in unknowns if isinstance(table, LearnedTable)]
        for parameter in learned:
            name, why = parameter.object, f'with kind = "{parameter.kind}", which has its own size'
            scale = self.scene[name].scale if name in self.scene else 1.0
            if scale != 1:
                got = f"expected 1 {why}, got {scale:g}; remove it"
                raise_key_error(got, f"scene.{name}.scale")
            if self.initial is not None and self.initial.object == name and self.initial.scale:
                raise_key_error(f"expected false {why}, got true; remove it", "initial.scale")

    def _check_overrides(self, context: Any) -> None:
        """Every stage and variant makes a run that is right; errors begin at its own path."""
        check = partial(_overrides_model(type(self)).model_validate, context=context)
        check({"stages": [self._dump_with_overrides(stage) for stage in self.stages]})
        variants = {name: self._dump_with_overrides(own) for name, own in self.variants.items()}
        for name, run in check({"variants": variants}).variants.items():
            self.variants[name] = self.variants[name].with_resolved_paths(run)
        if self.calibration is not None:
            check({"calibration": self._dump_with_overrides(self.calibration)})

    def _require_simulated_data(self) -> None:
        """Refuse data that a data set cannot be made of."""
        if self.dataset is not None and self.dataset.paths and self.chirps is not None:
            raise_key_error("expected false with [chirps], got true; remove it", "dataset.paths")
        if self.dataset and self.chirps is None and "micro_doppler" in self.dataset.signals:
            raise_key_error("expected [chirps] with micro_doppler; add it", "dataset.signals")
        if self.observations:
            raise_key_error(refusal_text("run.observations_with_dataset"), "observations")
        if self.data is not None and not isinstance(self.data, SimulatedData):
            raise_key_error(refusal_text("run.measured_data", self.data.kind), "data.kind")

    def dump_without_dataset(self) -> dict[str, Any]:
        """As TOML, without what makes it a data set."""
        return self.model_dump(**_DUMP_GIVEN, exclude={"dataset", "vary"})

    def apply_overrides(self, part: fits.RunOverrides) -> "_RunFile":
        """The run file with a stage, a variant or the calibration merged over it."""
        return type(self).model_validate(self._dump_with_overrides(part))

    def _dump_with_overrides(self, part: fits.RunOverrides) -> dict[str, Any]:
        """The run file as TOML, with a part: keys of tables replace keys, all else is replaced."""
        found = self.model_dump(**_DUMP_GIVEN, exclude={"variants", "calibration"})
        for name, change in part.overrides().items():
            found[name] = _merge_table(getattr(self, name), change)
            for sensor, table in self.observations.items():
                if getattr(table, name, None) is not None:
                    found["observations"][sensor][name] = _merge_table(getattr(table, name), change)
        return found

    @property
    def fit_settings(self) -> fits.ReconstructTable:
        """The `[reconstruct]` table, which every fit needs."""
        return section.require_section(self, "reconstruct", "reconstruct")

    @property
    def fitted_objects(self) -> list[str]:
        """Objects that have parameters."""
        return [p.object for p in self.parameters if getattr(p, "object", None)]

    @property
    def parameter_tables(self) -> dict[str, Any]:
        """The tables of what is unknown, and of what a gradient check moves, by path."""
        found = {f"parameters[{i}]": table for i, table in enumerate(self.parameters)}
        own = {} if self.gradcheck is None else {"gradcheck.parameter": self.gradcheck.parameter}
        return found | own

    def object_references(self) -> list[tuple[str, str]]:
        """Yield every reference to an object of the scene: path and name."""
        used = [(f"truth.{name}", name) for name in self.truth]
        if self.dataset is not None:
            used += [(f"dataset.classes.{name}", name) for name in self.dataset.classes]
        sections = {name: getattr(self, name) for name in type(self).model_fields}
        for path, table in (self.parameter_tables | sections).items():
            if getattr(table, "object", None) is not None:
                used.append((f"{path}.object", table.object))
        used += [("image.objects", name) for name in getattr(self.image, "objects", [])]
        data = {"data": self.data}
        data |= {f"observations.{name}.data": t.data for name, t in self.observations.items()}
        for path, table in data.items():
            found = getattr(table, "points_per_m2", None)
            if isinstance(found, dict):
                used += [(f"{path}.points_per_m2.{n}", n) for n in found if n != ALL_OTHERS]
        return used


def _require_known_names(what: str, used: list[str], known: list[str], path: str) -> None:
    for name in used:
        if name not in known:
            raise_key_error(refusal_text("run.unknown_names", what, ", ".join(known), name), path)


def _merge_table(table: Any, change: Any) -> Any:
    """A table with other keys, or what replaces it: a list, a name, a table of another kind."""
    kind = getattr(table, "kind", None)
    if table is None or not isinstance(change, dict) or change.get("kind", kind) != kind:
        return change
    return table.model_dump(**_DUMP_GIVEN) | change


@cache
def _overrides_model(run: type[_RunFile]) -> Any:
    """Runs where the run file has its parts."""
    listed, named = (list[run], []), (dict[str, run], {})  # type: ignore[valid-type]
    return create_model("Parts", stages=listed, variants=named, calibration=(run, None))


def _add_plugin_sections() -> type[_RunFile]:
    """The run file with the sections of installed plugins."""
    tables = {
        name: registry.constructor_table(model, name.title().replace("_", ""), checked=None)
        for name, model in load_plugins().sections.items()
    }
    taken = sorted(set(tables) & set(_RunFile.model_fields))
    if taken:
        raise InputError(f"expected new names of sections, got {taken[0]}; rename that plugin's")
    fields: dict[str, Any] = {
        name: (table | None, Field(None, description=(table.__doc__ or "").split(".")[0]))
        for name, table in tables.items()
    }
    return create_model("RunFile", __base__=_RunFile, __doc__=_RunFile.__doc__, **fields)


if TYPE_CHECKING:
    RunFile = _RunFile
else:
    RunFile = _add_plugin_sections()
