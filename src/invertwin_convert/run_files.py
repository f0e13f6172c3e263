"""Run files of the first frame in that of today: `invertwin convert`.

Run files without the key `frame` have x to the right, y up and z ahead; today x is ahead, y to the
left and z up. What was read as *right* is *left* now, so that the vector (x, y, z) becomes
(z, x, y) and numbers of a run stay what they were. The schema tells which keys are vectors; this
module knows whose frame each is in.

Worlds with z up stay as they are: those of radio maps, radar signatures, cameras and scene files.
In these only antennas and built-in shapes turn. Meshes of files and learned shapes keep their own
coordinates in every world.
"""

import copy
import os
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from scipy.spatial.transform import Rotation
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT, InlineTable, Item, Table

from invertwin.cli.run_file import parse_toml, prefix_errors, read_text, validate_run
from invertwin.cli.schema.keys import JsonSchema, json_schema
from invertwin.cli.schema.variation import parse_key_path, set_values
from invertwin.constants import FRAME
from invertwin.errors import InputError
from invertwin.registry.section import KeyInputError
from invertwin.storage.folders import convert_os_errors, replace_file
from invertwin.storage.untrusted import read_npy

KeyPath = tuple[str | int, ...]
Frame = np.ndarray
"""Signed permutation of the components of a vector [3, 3]."""

_KEEP: Frame = np.eye(3, dtype=int)
_TURN: Frame = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
# SMPL's own axes, y up and facing z, against those of people, z up and facing −x.
_SMPL: Frame = np.array([[0, 0, -1], [-1, 0, 0], [0, 1, 0]])

_ROOT: KeyPath = ()
_AXES = "xyz"
_DIGITS = 12  # of angles in degrees, far below what any wave notices

_BUILT_IN = ("plate", "cylinder", "dihedral", "trihedral", "text", "body")
_WITHOUT_FRONT = ("box", "sphere")
"""Shapes that turn; all others, files and learned ones, keep their coordinates."""
_POSED = ("ObjectTable", "ShapePoseTable", "TruthTable")
"""Ends of the names of tables that place a shape."""
_WORLDS_WITH_Z_UP = ("scene_file", "map", "transmitter", "placement", "rcs")
_RECORDINGS_WITH_Z_UP = ("rail_sar",)
_VECTORS = (
    *("axis", "center", "high", "low", "places", "positions", "rotations_deg", "size", "start"),
    *("stop", "up", "angles_deg"),
)
"""Keys of lists of any length, which are vectors where they have three numbers."""
_OWN_FRAME = {
    "Body": ("angles_deg", "joints"),
    "Truth": ("angles_deg",),
    "Box": ("size",),
    "Turning": ("axis", "center"),
    "Prior": ("counts",),
    "Reconstruct": ("axis",),
    **dict.fromkeys(("Density", "Distance", "Neural", "Lattice"), ("low", "high", "counts")),
}
"""Keys in the frame of their object, by the first word of their table; others are in the world."""
_WORLD_TANGENTS = ("translation", "rotation", "raw_position")
_OTHER_SIDE = {"wall_left": "wall_right", "wall_right": "wall_left"}
_WALL = re.compile(r"\bwall_(?:left|right)\b")


def convert_file(path: Path) -> tuple[str, dict[Path, np.ndarray]]:
    """The text of a run file in the frame of today, and images that it needs, by their paths.

    Args:
        path: Of a run file of the first frame.

    Raises:
        InputError: It is no run file, is of today's frame, or holds what no run file of today can.
    """
    text = read_text(path)
    raw = parse_toml(path, text)
    if "task" not in raw:
        raise InputError(f"{path}: expected a run file, got TOML without `task`; give another file")
    if "frame" in raw:
        raise InputError(
            f"{path}: expected a run file of the first frame, which has no such key, got frame = "
            f"{raw['frame']}; leave it as it is"
        )
    if "room" in raw:
        # A room's left wall was the one at −x, which is at −y now: on the right.
        text = _WALL.sub(lambda found: _OTHER_SIDE[found[0]], text)
        raw = parse_toml(path, text)
    try:
        changes = _Conversion(raw, path)
        wanted = changes.apply()
    except KeyInputError as error:
        raise InputError(f"{path}: {error}") from None
    except (AttributeError, IndexError, KeyError, RecursionError, TypeError, ValueError):
        validate_run(raw | {"frame": FRAME}, path)  # says what is wrong in it
        raise
    validate_run(wanted, path)
    found = changes.rewrite(text)
    if tomllib.loads(found) != wanted:
        raise InputError(
            f"{path}: expected tables that stand together, got a run file whose lines cannot be "
            "kept; state each table once"
        )
    return found, changes.images


def write_files(texts: Mapping[Path, str], images: Mapping[Path, np.ndarray]) -> None:
    """Write run files in place and their new images; a file is whole at any moment.

    Args:
        texts: By path.
        images: By path.

    Raises:
        InputError: The file system refuses one; those before it are written.
    """
    with convert_os_errors(""):
        for path, image in images.items():
            with replace_file(path) as part:
                np.save(part, image)
        for path, text in texts.items():
            file = path.resolve()  # a link stays one
            with replace_file(file) as part:
                part.write_bytes(text.encode("utf-8"))
                os.chmod(part, file.stat().st_mode)


@dataclass(frozen=True)
class _Vector:
    """A vector, a list of them, or one for each entry of a table."""

    frame: Frame

    def __call__(self, value: Any) -> Any:
        if isinstance(value, dict):
            return {name: self(item) for name, item in value.items()}
        if not value or isinstance(value[0], list):
            return [self(item) for item in value]
        given = [*value, *[0.0] * (3 - len(value))]  # tangents may leave out the last ones
        return [_with_sign(given[i], sign) for i, sign in map(_source, self.frame)]


@dataclass(frozen=True)
class _Axes:
    """Names of axes, or one name."""

    frame: Frame

    def __call__(self, value: Any) -> Any:
        if isinstance(value, dict):
            return {name: self(item) for name, item in value.items()}
        named = sorted(_AXES[self.target(_AXES.index(axis))] for axis in value)
        return named[0] if isinstance(value, str) else named

    def target(self, axis: int) -> int:
        """Number of the axis that an old one becomes."""
        return int(np.abs(self.frame[:, axis]).argmax())


@dataclass(frozen=True)
class _Turn:
    """A rotation vector [°], or a list of them: from the frame of what turns to an outer one."""

    outer: Frame
    own: Frame

    @property
    def composes(self) -> bool:
        """True where more than the axis of the rotation changes."""
        return self.outer is not self.own

    def __call__(self, value: Any) -> Any:
        if value and isinstance(value[0], list):
            return [self(item) for item in value]
        if not self.composes:
            return _Vector(self.own)(value)
        return _to_vector(self.outer @ _to_matrix(value) @ self.own.T)


@dataclass(frozen=True)
class _Nodes:
    """Values at the nodes of a grid, which are vectors where there is a fourth dimension."""

    frame: Frame

    def __call__(self, value: Any) -> Any:
        array = np.array(value)
        columns = [_source(row)[0] for row in self.frame]
        array = array.transpose(*columns, *range(3, array.ndim))
        return (array[..., columns] if array.ndim == 4 else array).tolist()


class _Pair:
    """Two numbers along the axes of the ground, which were x and z."""

    def __call__(self, value: Any) -> Any:
        return value[::-1]


class _Conversion:
    """Conversion of one run file.

    Args:
        raw: The run file.
        path: Of the file.

    Attributes:
        changes: What becomes of a value, by its path.
        added: Keys that the run file left to defaults which have changed, by path.
        removed: Paths of keys that are gone.
        images: Mirrored images by path.
    """

    def __init__(self, raw: dict[str, Any], path: Path) -> None:
        self.raw, self.path, self.top = raw, path, json_schema()
        self.changes: dict[KeyPath, Any] = {}
        self.added: dict[KeyPath, Any] = {}
        self.removed: list[KeyPath] = []
        self.images: dict[Path, np.ndarray] = {}
        self.world = _KEEP if _has_z_up(raw) else _TURN
        self.frames = {
            name: self._shape_frame(table, self.world, name)
            for name, table in raw.get("scene", {}).items()
        }
        if "room" in raw and self.world is _KEEP:
            raise KeyInputError("room", "expected no room in a world with z up, got one; remove it")
        self._walk(_ROOT, self.top, raw, self.world, self.world)
        self._convert_defaults()
        for number, table in enumerate(raw.get("vary", [])):
            self._convert_distribution(number, table)

    def apply(self) -> dict[str, Any]:
        """The run file of today, as tables."""
        found = copy.deepcopy(self.raw)
        for path, new in (*self._new_values(), *self.added.items()):
            _holder(found, path)[path[-1]] = new
        for path in self.removed:
            del _holder(found, path)[path[-1]]
        return found | {"frame": FRAME}

    def rewrite(self, text: str) -> str:
        """The run file of today as text, with the comments and the lines of the old one.

        Args:
            text: Of the old one.
        """
        try:
            document = tomlkit.parse(text)
            for path, new in self._new_values():
                _replace_value(_holder(document, path), path[-1], new)
            for path in self.removed:
                del _holder(document, path)[path[-1]]
            for path, new in self.added.items():
                _add_key(_holder(document, path), str(path[-1]), new)
            last = document.item("title" if "title" in document else "task")
            assert isinstance(last, Item)
            _append_line(last, f"frame = {FRAME}")
            return document.as_string()
        except (TOMLKitError, TypeError, AttributeError) as error:
            reason = " ".join(str(error).split())
            raise InputError(
                f"{self.path}: expected a run file that can be rewritten, got {reason}; write its "
                "tables one after another"
            ) from None

    def _new_values(self) -> Iterator[tuple[KeyPath, Any]]:
        for path, change in self.changes.items():
            old = _value_at(self.raw, path)
            new = change(old)
            if new != old:
                yield path, new

    def _walk(self, path: KeyPath, node: JsonSchema, value: Any, own: Frame, outer: Frame) -> None:
        """Find what changes in a table or a list.

        Args:
            path: Of the value.
            node: Its schema.
            value: What it is.
            own: Frame of the object that it belongs to.
            outer: Frame in which the pose of this object is stated.
        """
        if isinstance(value, list):
            items = next((n["items"] for n in self._forms(node) if "items" in n), {})
            for number, item in enumerate(value):
                self._walk((*path, number), items, item, own, outer)
        if not isinstance(value, dict):
            return
        table = self._choose_table(node, value)
        if table is None:
            maps = (n.get("additionalProperties") for n in self._forms(node))
            items = next((found for found in maps if isinstance(found, dict)), {})
            for name, item in value.items():
                self._walk((*path, name), items, item, own, outer)
            return
        title = table.get("title", "")
        if title.endswith(_POSED):
            own, outer = self._place_shape(path, title, value, own, outer)
        elif isinstance(value.get("object"), str) and path != _ROOT:
            own = self._object_frame(value["object"])
        elif title.startswith("Reconstruct"):
            own = self._fitted_frame()
        if "orientation" in table["properties"]:
            self._convert_mount(path, title, value)
        if title == "TextureFile":
            self._mirror_image(path, value, own)
        for key, item in value.items():
            inner = table["properties"].get(key)
            if inner is None or (*path, key) in self.changes:
                continue
            if key == "tangent" and title.startswith("Gradcheck"):
                self._convert_tangents((*path, key), value["parameter"], item, own)
            elif self._is_override(inner, item):
                self._walk_override((*path, key), key, item, own, outer)
            elif not self._convert_leaf((*path, key), title, inner, item, own, outer):
                self._walk((*path, key), inner, item, own, outer)

    def _forms(self, node: JsonSchema) -> list[JsonSchema]:
        """The schemas that a value may have."""
        if "$ref" in node:
            return self._forms(self.top["$defs"][node["$ref"].rpartition("/")[2]])
        parts = [*node.get("anyOf", ()), *node.get("oneOf", ())]
        return [form for part in parts for form in self._forms(part)] if parts else [node]

    def _choose_table(self, node: JsonSchema, value: Mapping[str, Any]) -> JsonSchema | None:
        """The table of a kind that a value is of."""
        for form in self._forms(node):
            keys = form.get("properties", {})
            tags = {name: key for name, key in keys.items() if "const" in key and name != "frame"}
            stated = (value.get(n, key.get("default")) == key["const"] for n, key in tags.items())
            if keys and all(stated) and not set(form.get("required", ())) - {*value, "frame"}:
                return form
        return None

    def _is_override(self, node: JsonSchema, value: Any) -> bool:
        """Test if a table holds what differs from the section of its name."""
        free = any(form.get("additionalProperties") is True for form in self._forms(node))
        return free and isinstance(value, dict)

    def _walk_override(
        self, path: KeyPath, name: str, value: dict[str, Any], own: Frame, outer: Frame
    ) -> None:
        whole = self.raw.get(name)
        whole = whole if isinstance(whole, dict) else {}
        if value.get("kind", whole.get("kind")) == whole.get("kind"):
            value = whole | value
        known = set(self.changes)
        self._walk(path, self.top["properties"].get(name, {}), value, own, outer)
        # What the section states itself is changed there.
        for found in [at for at in self.changes if at not in known]:
            try:
                _value_at(self.raw, found)
            except (KeyError, IndexError):
                del self.changes[found]

    def _convert_leaf(
        self, path: KeyPath, title: str, node: JsonSchema, value: Any, own: Frame, outer: Frame
    ) -> bool:
        """Note what becomes of a value that no table holds; False where it is none of these."""
        key = str(path[-1])
        frame = self.world
        if any(title.startswith(name) and key in keys for name, keys in _OWN_FRAME.items()):
            frame = own
        elif title.endswith("ArrayTable"):
            frame = _TURN
        elif title.endswith(_POSED):
            frame = outer
        if (title.startswith("LinearArray") and key == "axis") or self._holds_axes(node, value):
            self.changes[path] = _Axes(frame)
        elif title == "TwinTable" and key in ("low", "high"):
            if self.world is _TURN:
                self.changes[path] = _Pair()
        elif title.startswith(("ArcTrack", "GridTrack", "Along")) and self.world is _KEEP:
            self._refuse_level_curves(path, title, value)
            return False
        elif self._holds_vectors(node, key, value):
            turned = key in ("rotation_deg", "rotations_deg")
            turn = title.endswith(_POSED) or "Search" in title
            self.changes[path] = _Turn(outer, own) if turned and turn else _Vector(frame)
        else:
            return False
        return True

    def _holds_axes(self, node: JsonSchema, value: Any) -> bool:
        if isinstance(value, dict):
            maps = [f["additionalProperties"] for f in self._forms(node) if _is_map(f)]
            return bool(maps) and all(self._holds_axes(maps[0], item) for item in value.values())
        letters = (form.get("items", {}).get("enum", [""]) for form in self._forms(node))
        return isinstance(value, list) and any(set(found) <= set(_AXES) for found in letters)

    def _holds_vectors(self, node: JsonSchema, key: str, value: Any) -> bool:
        """Test if a value is a vector, a list of vectors, or a table of vectors by name."""
        forms = self._forms(node)
        if isinstance(value, dict):
            maps = [form["additionalProperties"] for form in forms if _is_map(form)]
            return bool(maps) and all(
                self._holds_vectors(maps[0], key, item) for item in value.values()
            )
        if not isinstance(value, list):
            return False
        for form in forms:
            items = form.get("items", {})
            if items.get("type") == "array":
                return bool(value) and all(self._holds_vectors(items, key, i) for i in value)
            if items.get("type") in ("number", "integer"):
                sized = form.get("minItems") == form.get("maxItems") == 3
                free = "maxItems" not in form and key in _VECTORS
                return len(value) == 3 and (sized or free)
        return False

    def _shape_frame(self, table: Any, outer: Frame, name: str | None = None) -> Frame:
        """Change of a shape's own frame.

        Args:
            table: Of the shape.
            outer: The frame in which it is placed.
            name: Of the object.
        """
        shape = table.get("shape")
        if shape == "body" and table.get("file"):
            return _SMPL
        if shape in _WITHOUT_FRONT:
            return _TURN if self._has_numbered_parts(table, name) else outer
        return outer if "parts" in table else _TURN if shape in _BUILT_IN else _KEEP

    def _has_numbered_parts(self, table: Any, name: str | None) -> bool:
        """Test if vertices or triangles of a shape are named by number, or seen on it."""
        check = self.raw.get("gradcheck", {})
        free = check.get("parameter", {})
        numbered = free.get("kind") == "vertices" and free.get("object") == name
        return numbered or _has_lists(table.get("material", {}))

    def _object_frame(self, name: str) -> Frame:
        """Change of an object's own frame: those of the room turn, those of files stay."""
        return self.frames.get(name, _TURN if "room" in self.raw else _KEEP)

    def _fitted_frame(self) -> Frame:
        names = [table.get("object") for table in self.raw.get("parameters", [])]
        return self._object_frame(next(filter(None, names), ""))

    def _place_shape(
        self, path: KeyPath, title: str, value: Any, own: Frame, outer: Frame
    ) -> tuple[Frame, Frame]:
        """The own frame of a shape, and that in which it is placed; note its rotation."""
        truth = title.startswith("Truth")
        outer = self.world if path[0] in ("scene", "truth") and len(path) == 2 else own
        if len(path) == 2:
            own = self._object_frame(str(path[1]))
        else:
            own = self._shape_frame(value, outer)
        turn = _Turn(outer, own)
        if not truth and turn.composes and "rotation_deg" not in value:
            self.added[*path, "rotation_deg"] = turn([0.0, 0.0, 0.0])
        return own, outer

    def _convert_mount(self, path: KeyPath, title: str, value: Any) -> None:
        """Note what becomes of the axes of antennas in a world that stays."""
        if self.world is _TURN:
            return
        turn, at = _Turn(_KEEP, _TURN), (*path, "orientation")
        given = value.get("orientation")
        antenna = title.startswith(("Antenna", "Transmitter"))
        if given is None:
            # Antennas without one lie in the world's axes, now as before.
            if not antenna:
                self.added[at] = {"rotation_deg": turn([0.0, 0.0, 0.0])}
        elif "rotation_deg" in given:
            self.changes[*at, "rotation_deg"] = turn
        else:
            places = value.get("positions", [[0.0, 0.0, 0.0]] if not antenna else None)
            if not isinstance(places, list) or len(places) != 1:
                raise KeyInputError(
                    ".".join(map(str, at)),
                    "expected rotation_deg of antennas in a world with z up, got look_at, whose "
                    "level was y of that world; state rotation_deg",
                )
            axes = _old_look_at(places[0], given["look_at"])
            new = {"rotation_deg": _to_vector(axes @ _TURN.T)}
            self.changes[at] = lambda _: new

    def _refuse_level_curves(self, path: KeyPath, title: str, value: Any) -> None:
        if title.startswith("Along") and not (path[-1] == "heading" and value):
            return
        raise KeyInputError(
            ".".join(map(str, path[:-1])),
            "expected positions one by one in a world with z up, got what counts from its y axis; "
            "state a list",
        )

    def _mirror_image(self, path: KeyPath, value: Any, own: Frame) -> None:
        """Note a mirrored copy of an image: its columns ran to x, and now run to −y."""
        at = (*path, "image")
        if own is not _TURN:
            raise KeyInputError(
                ".".join(map(str, at)),
                "expected an image on a built-in shape, got one on a shape that keeps its "
                "coordinates, which is seen along another axis now; state one value per triangle",
            )
        name = value["image"]
        source = self.path.parent / name
        with prefix_errors(".".join(map(str, at))):
            image = read_npy(source)
        new = str(Path(name).with_suffix(".frame2.npy"))
        self.images[source.with_suffix(".frame2.npy")] = np.asarray(image)[:, ::-1]
        self.changes[at] = lambda _: new

    def _convert_tangents(self, path: KeyPath, parameter: Any, tangent: Any, own: Frame) -> None:
        kind = parameter.get("kind")
        own = self._object_frame(parameter["object"]) if "object" in parameter else own
        for name, value in tangent.items():
            at = (*path, name)
            if isinstance(value, dict):
                self.changes[*at, "center"] = _Vector(own)
                if isinstance(value.get("height"), list):
                    self.changes[*at, "height"] = _Vector(own)
            elif not isinstance(value, list):
                continue
            elif name in _WORLD_TANGENTS or kind == "radar_path":
                self.changes[at] = _Vector(self.world)
            elif kind in ("body", "vertices"):
                self.changes[at] = _Vector(own)
            elif np.ndim(value) >= 3:
                self.changes[at] = _Nodes(own)

    def _convert_defaults(self) -> None:
        """State defaults of the old file that are other ones now; drop keys that are gone."""
        for section in ("twin", "initial"):
            if "up" in self.raw.get(section, {}):
                self.removed.append((section, "up"))
        if "camera" in self.raw and self.world is _TURN and "up" not in self.raw["camera"]:
            self.added["camera", "up"] = _Vector(_TURN)([0.0, 0.0, 1.0])
        search = self.raw.get("search", {})
        if search.get("kind") == "grid" and self.world is _KEEP and "axis" not in search:
            self.added["search", "axis"] = [0.0, 1.0, 0.0]
        for path in self.removed:
            self.changes.pop(path, None)

    def _convert_distribution(self, number: int, table: Any) -> None:
        """Convert the keys and values of a [[vary]] table."""
        keys = [table["key"]] if isinstance(table["key"], str) else table["key"]
        names = [name for name in ("low", "high", "mean", "deviation", "values") if name in table]
        if not names:
            return
        first = table[names[0]][0] if names[0] == "values" else table[names[0]]
        new, changes = [], []
        with prefix_errors(f"vary[{number}].key"):
            for key in keys:
                path, change = self._convert_key(key, first)
                new.append(path)
                changes.append(change)
        at = ("vary", number)
        self.changes[*at, "key"] = lambda value: new[0] if isinstance(value, str) else new
        if any(repr(change) != repr(changes[0]) for change in changes):
            raise KeyInputError(f"vary[{number}].key", "expected keys in one frame, got several")
        if changes[0] is None:
            return
        for name in names:
            if name == "values":
                self.changes[*at, name] = lambda values: [changes[0](value) for value in values]
            elif isinstance(table[name], list):
                self.changes[*at, name] = changes[0]

    def _convert_key(self, key: str, value: Any) -> tuple[str, Any]:
        """The path of a varied key today, and what becomes of its values; None = they stay."""
        steps = parse_key_path(key)
        trial = copy.copy(self)
        trial.raw = set_values(self.raw, [(key, value)])
        trial.changes, trial.added, trial.removed, trial.images = {}, {}, [], {}
        trial._walk(_ROOT, self.top, trial.raw, self.world, self.world)
        found, holder = trial.changes.get(steps), steps[:-1]
        while holder and holder not in trial.changes and isinstance(holder[-1], int):
            holder = holder[:-1]  # a vector may be one of a list
        part = trial.changes.get(holder)
        if found is None and isinstance(value, list):
            found = part  # one of a list of vectors
        if found is not None:
            if isinstance(found, _Turn) and found.composes:
                raise InputError(
                    "expected no rotation of a shape that keeps its coordinates or its world, got "
                    f"{key}; state the rotations anew"
                )
            return key, found
        if part is not None and isinstance(steps[-1], int):
            frame = part.own if isinstance(part, _Turn) else getattr(part, "frame", None)
            if frame is None or (isinstance(part, _Turn) and part.composes) or (frame < 0).any():
                raise InputError(f"expected a vector as a whole, got {key}; state all of it")
            axis = int(frame[:, steps[-1]].argmax())
            return f"{key[: key.rindex('[')]}[{axis}]", None
        inner = {p: c for p, c in trial.changes.items() if p[: len(steps)] == steps}
        inner |= {p: None for p in trial.added if p[: len(steps)] == steps}
        return key, _Inside(self, key) if inner else None


@dataclass(frozen=True)
class _Inside:
    """Conversion of a drawn table, which holds vectors."""

    run: _Conversion
    key: str

    def __call__(self, value: Any) -> Any:
        steps = parse_key_path(self.key)
        raw = set_values(self.run.raw, [(self.key, value)])
        raw.pop("vary", None)
        found = _Conversion(raw, self.run.path)
        self.run.images.update(found.images)
        return _value_at(found.apply(), steps)


def _has_z_up(raw: Mapping[str, Any]) -> bool:
    """Test if z is up in the world of an old run file."""
    if any(raw.get(section, {}).get("up") == "z" for section in ("twin", "initial")):
        return True
    if raw.get("data", {}).get("kind") in _RECORDINGS_WITH_Z_UP:
        return True
    sees = "camera" in raw and "radar" not in raw and "observations" not in raw
    return sees or any(section in raw for section in _WORLDS_WITH_Z_UP)


def _has_lists(value: Any) -> bool:
    """Test if a material has values by triangle, or an image."""
    if isinstance(value, dict):
        return "image" in value or any(map(_has_lists, value.values()))
    return isinstance(value, list) and any(not isinstance(i, dict) or _has_lists(i) for i in value)


def _is_map(node: JsonSchema) -> bool:
    return isinstance(node.get("additionalProperties"), dict)


def _source(row: np.ndarray) -> tuple[int, int]:
    """Number of the old component that a new one is, and its sign."""
    place = int(np.abs(row).argmax())
    return place, int(row[place])


def _with_sign(number: Any, sign: int) -> Any:
    return number if sign > 0 or number == 0 else -number


def _to_matrix(vector: Sequence[float]) -> np.ndarray:
    return Rotation.from_rotvec(vector, degrees=True).as_matrix()


def _to_vector(matrix: np.ndarray) -> list[float]:
    vector = Rotation.from_matrix(matrix).as_rotvec(degrees=True)
    return [round(float(angle), _DIGITS) + 0.0 for angle in vector]


def _old_look_at(place: Sequence[float], target: Sequence[float]) -> np.ndarray:
    """Old axes of a radar that looks at a target, x level and y upwards."""
    boresight = np.subtract(target, place)
    right = np.cross([0.0, 1.0, 0.0], boresight)
    columns = [right, np.cross(boresight, right), boresight]
    return np.column_stack([column / np.linalg.norm(column) for column in columns])


def _holder(tables: Any, path: KeyPath) -> Any:
    return _value_at(tables, path[:-1])


def _value_at(tables: Any, path: KeyPath) -> Any:
    for step in path:
        tables = tables[step]
    return tables


def _replace_value(holder: Any, key: str | int, new: Any) -> None:
    """Put a value in place of another; numbers that stay keep their digits, lists their lines."""
    old = holder[key]
    if isinstance(new, dict) and isinstance(old, dict) and old.keys() == new.keys():
        for name, item in new.items():
            if item != old[name]:
                _replace_value(old, name, item)
    elif isinstance(new, list) and isinstance(old, list) and len(new) == len(old):
        left = list(old)
        for number, item in enumerate(new):
            if isinstance(item, list | dict):
                _replace_value(old, number, item)
            else:
                same = (o for o in left if o == item and isinstance(o, type(item)))
                old[number] = copy.copy(next(same, item))
    else:
        holder[key] = new


def _add_key(table: Any, key: str, new: Any) -> None:
    """Add a key behind the last one of a table, before its tables and its last comments."""
    if isinstance(table, InlineTable) or not isinstance(table, Table):
        table[key] = new
        return
    rows = [i for k, i in table.value.body if k is not None and not isinstance(i, Table | AoT)]
    _append_line(rows[-1], f"{key} = {_inline(new)}")


def _inline(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{name} = {_inline(item)}" for name, item in value.items()) + " }"
    return tomlkit.item(value).as_string()


def _append_line(row: Item, line: str) -> None:
    """Add a line behind that of a key."""
    end = row.trivia.trail or "\n"
    row.trivia.trail = f"{end}{line}{end if row.trivia.trail else ''}"
