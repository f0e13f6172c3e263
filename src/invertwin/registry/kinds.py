"""Registry of run files: constructors by group and kind, sections, commands; also of plugins.

A constructor is a class or a function. Its signature, its annotations and its docstring become a
table of the run file: keys, defaults, limits and their meaning are stated there and nowhere else.
Other packages add theirs by an entry point of the group ``invertwin.plugins``, a function that
takes the `Registry` (docs/extending.md). Nothing here imports torch by itself.
"""

import inspect
import math
import pkgutil
import re
import typing
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, get_args, get_origin

from annotated_types import Len, MinLen
from pydantic import Discriminator, Field, GetCoreSchemaHandler, Tag, create_model, model_validator

from invertwin.constants import read_table
from invertwin.errors import InputError
from invertwin.limits import RADIANS, AllowedLetters
from invertwin.registry import section

PLUGINS = "invertwin.plugins"
_ARGUMENT_DOCS = read_table("invertwin.registry", "arguments.toml")
"""Meaning of keys of many tables, where a constructor says nothing."""
_TASKS = ("simulate", "reconstruct", "gradcheck", "rcs", "dataset", "twin", "loss-scan", "demo")
_PLAIN_TYPES = (bool, int, float, str, list, tuple, dict)


class ConstructorTable(section.Section):
    """A table that a constructor of the library makes something of."""

    made_by: ClassVar[Callable[..., Any]]
    optional: ClassVar[tuple[str, ...]] = ()  # arguments that other keys may stand in for
    made_from: ClassVar[Mapping[str, tuple[str | None, Any]]] = {}  # name → key, annotation

    def build(self, given: Mapping[type, object] | None = None, /, **more: Any) -> Any:
        """Build the value of a table by its constructor.

        Args:
            given: Values of its arguments that no run file can hold, by their type.
            more: Further arguments.

        Raises:
            InputError: What the constructor refuses; the path begins at this table.
        """
        return type(self).made_by(**self.library_values(given or {}) | more)

    def library_values(self, given: Mapping[type, object]) -> dict[str, Any]:
        """The arguments of the constructor; what the table does not state keeps its default."""
        found: dict[str, Any] = {}
        for name, (place, hint) in self.made_from.items():
            if place is None:
                kind = next((kind for kind in _union_members(hint) if kind in given), None)
                if kind is not None:
                    found[name] = given[kind]
            elif getattr(self, place) is not None:
                with section.prefix_errors(place):
                    found[name] = registry.convert_value(getattr(self, place), hint, name, given)
        return found


class _CheckedTable(ConstructorTable):
    """A table whose constructor costs nothing, so that its own checks are made at once."""

    @model_validator(mode="after")
    def _check_constructor(self) -> "_CheckedTable":
        try:
            self.build()
        except section.KeyInputError as error:
            section.raise_key_error(error.text, error.path)
        except InputError as error:
            section.raise_key_error(str(error))
        return self


class _EmptyGroupTable(section.Section):
    """No kind is known; plugins may add some."""


class ValueFormat(NamedTuple):
    """Notation of a library type in a run file.

    Attributes:
        table: Name of an argument, whether it is an angle → what pydantic checks.
        value: What was read, the name, whether it is an angle, given values → the library's value.
    """

    table: Callable[[str, bool], Any]
    value: Callable[[Any, str, bool, Mapping[type, object]], Any]


@dataclass(frozen=True)
class _RegisteredKind:
    make: Any
    without: tuple[str, ...]
    untagged: bool
    checked: bool | None


@dataclass
class KindGroup:
    """The kinds of one thing, such as materials.

    Attributes:
        tag: The key that names the kind.
        base: Keys that all of its tables have.
        product: The type that its constructors make; annotations with it mean the group.
        default: The kind of a table without `tag`.
        points: The type of a list that may stand in place of a table.
        includes: Another group, whose kinds it has, too.
        kinds: Kinds by name.
    """

    tag: str = "kind"
    base: type[ConstructorTable] = ConstructorTable
    product: Any = None
    default: str | None = None
    points: Any = None
    includes: str | None = None
    kinds: dict[str, _RegisteredKind] = field(default_factory=dict)


@dataclass(frozen=True)
class OneOf:
    """Annotates a key whose value is a table of a group."""

    group: str  # its name
    base: type[ConstructorTable] | None = None  # of these tables; None = the group's

    def __get_pydantic_core_schema__(self, _: Any, handler: GetCoreSchemaHandler) -> Any:
        return handler.generate_schema(registry.union(self.group, self.base))


@dataclass(frozen=True)
class TableOf:
    """Annotates a key whose value is the table of one constructor."""

    make: Any  # the constructor
    base: type[ConstructorTable] = ConstructorTable  # with keys beside its arguments
    without: tuple[str, ...] = ()  # arguments that are no keys
    checked: bool | None = None  # as in ``Registry.add``

    def __get_pydantic_core_schema__(self, _: Any, handler: GetCoreSchemaHandler) -> Any:
        found = _class_table(self.make, self.base, self.without, self.checked)
        return handler.generate_schema(found)


@dataclass(frozen=True)
class FormOf:
    """Annotates a key whose value is of one of several types, as its form tells."""

    kinds: tuple[Any, ...]  # as `number_or_list` takes them

    def __get_pydantic_core_schema__(self, _: Any, handler: GetCoreSchemaHandler) -> Any:
        return handler.generate_schema(number_or_list(*self.kinds))


@dataclass(frozen=True)
class NameOf:
    """Annotates a key whose value is the name of a kind of a group, or of a task."""

    group: str

    def __get_pydantic_core_schema__(self, _: Any, handler: GetCoreSchemaHandler) -> Any:
        return handler.generate_schema(Literal[tuple(registry.names(self.group))])


class Registry:
    """All that a run file may name. `register` functions get it and add to it.

    Attributes:
        built_in: Modules whose ``register`` adds the library's own kinds.
        sections: Sections of run files: dataclasses or pydantic models, by name.
        commands: Commands, as functions that typer takes, by name; each is a task, too.
        recordings: What `invertwin look` knows by the name of a file: the kind of its data, whose
            constructor gets the folder, and the preset that recorded, unless the user names
            another: the constructor then gets a `board`, too.
        groups: Groups of kinds, by name.
        forms: Written forms of values of the library's types.
        bases: A base of the tables of all constructors of a type or of its subclasses.
        given: Arguments of these types are no keys: they are handed over when a table is built.
    """

    def __init__(self) -> None:
        self.built_in: tuple[str, ...] = ()
        self.sections: dict[str, Any] = {}
        self.commands: dict[str, Callable[..., Any]] = {}
        self.recordings: dict[str, tuple[str, str | None]] = {}
        self.groups: dict[str, KindGroup] = {}
        self.forms: dict[Any, ValueFormat] = {}
        self.bases: dict[type, type[ConstructorTable]] = {}
        self.given: set[Any] = set()
        self._waiting: list[tuple[str, str, _RegisteredKind]] | None = []

    def add(
        self,
        group: str,
        kind: str,
        make: Any,
        *,
        without: Sequence[str] = (),
        untagged: bool = False,
        checked: bool | None = None,
    ) -> None:
        """Add a kind.

        Args:
            group: Such as "material", "shape", "waveform", "pattern", "array", "board", "track",
                "data", "parameter", "loss", "optimizer" or "model".
            kind: Its name in run files.
            make: Its class or function, or "module:name" of it, which is imported when needed.
            without: Arguments that are no keys.
            untagged: The key of this name chooses the kind, in place of `kind = "..."`.
            checked: Whether a table is tried at once; by default if `make` is a plain dataclass.

        Raises:
            InputError: The group is not known, or has this kind already.
        """
        entry = _RegisteredKind(make, tuple(without), untagged, checked)
        if self._waiting is not None:
            self._waiting.append((group, kind, entry))
        else:
            self._add_kind(group, kind, entry)

    def names(self, group: str) -> list[str]:
        """The kinds of a group, or of "task"."""
        if group == "task":
            return list(dict.fromkeys([*_TASKS, *self.commands]))
        return list(self._kinds(group))

    @cache  # noqa: B019 - the only registry lives as long as the program
    def union(self, group: str, base: type[ConstructorTable] | None = None) -> Any:
        """The type of a value that is a table of a group.

        Args:
            group: Its name.
            base: Base of its tables; None = the group's.
        """
        found, kinds = self._load_kinds()[group], self._kinds(group)
        if not kinds:
            return _EmptyGroupTable
        keys = (found.tag, *(name for name, kind in kinds.items() if kind.untagged))
        tables = {name: self.kind_table(group, name, base) for name in kinds}
        members = [Annotated[table, Tag(section.TAG_MARK + name)] for name, table in tables.items()]
        if found.points is not None:
            members.append(Annotated[found.points, Tag(f"{section.TAG_MARK}points")])
        if all(kind.untagged for kind in kinds.values()):
            keys = keys[1:]
        return Annotated[_union_type(members), section.tag_by(keys, found.default)]

    @cache  # noqa: B019 - as above
    def kind_table(self, group: str, name: str, base: type[ConstructorTable] | None = None) -> Any:
        """The table of a kind.

        Args:
            group, name: Group and name of the kind.
            base: Base of the table; None = the group's.
        """
        found = self._load_kinds()[group]
        kind, base = self._kinds(group)[name], base or found.base
        fields: dict[str, Any] = {}
        if not kind.untagged:
            default = name if name == found.default else ...
            fields[found.tag] = Literal[name], Field(default, description="")
        title = f"{name}_{base.__name__ if base is not ConstructorTable else group}"
        given = _camel_case(title), base, fields, kind.without
        return self.constructor_table(kind.make, *given, checked=kind.checked)

    def constructor_table(
        self,
        make: Any,
        title: str,
        base: type[ConstructorTable] = ConstructorTable,
        fields: Mapping[str, Any] | None = None,
        without: Sequence[str] = (),
        *,
        checked: bool | None = False,
    ) -> Any:
        """The table of a constructor, made from its signature and docstring.

        Args:
            make: The constructor, or "module:name" of it. A pydantic model is taken as it is.
            title: Title of the table.
            base: Its keys stand beside those of the arguments.
            fields: Further keys.
            without, checked: As in `add`.
        """
        self._load_kinds()
        make = pkgutil.resolve_name(make) if isinstance(make, str) else make
        if isinstance(make, type) and issubclass(make, section.Section):
            return make
        plain = isinstance(make, type) and not is_dataclass(make)
        hints = typing.get_type_hints(make.__init__ if plain else make, include_extras=True)
        documents = {**_ARGUMENT_DOCS, **section.argument_docs(make)}
        made: dict[str, Any] = dict(fields or {})
        arguments: dict[str, tuple[str | None, Any]] = {}
        product = make if isinstance(make, type) else hints.get("return")
        if isinstance(product, type):
            own = next((b for kind, b in self.bases.items() if issubclass(product, kind)), base)
            base = base if issubclass(base, own) else _combine_tables(own, base)
        for name, parameter in inspect.signature(make).parameters.items():
            is_variadic = parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
            if is_variadic or name in without:
                continue
            hint = hints[name]
            if self.given & set(_union_members(hint)):
                arguments[name] = (None, hint)
                continue
            place = f"{name}_deg" if _is_angle(hint) else name
            arguments[name] = (place, hint)
            if place not in base.model_fields and place not in made:
                default = None if name in base.optional else parameter.default
                made[place] = self._field(hint, name, default, documents.get(name, ""))
        checked = is_dataclass(make) if checked is None else checked
        members = {member for hint in hints.values() for member in _union_members(hint)}
        if checked and not self.forms.keys() & members:
            base = _combine_tables(_CheckedTable, base)
        words = (inspect.getdoc(make) or "").split("\n\n")[0]
        # Fields of the constructor come first, those of the base after them, but for the tag.
        model = create_model(title, __base__=base, __doc__=words, **made)
        model.made_by = staticmethod(make) if inspect.isfunction(make) else make
        model.made_from = arguments
        return model

    def _field(self, hint: Any, name: str, default: Any, words: str) -> Any:
        kind = self.run_file_type(hint, name)
        words = words.replace("[rad]", "[°]") if _is_angle(hint) else words
        if default is inspect.Parameter.empty:
            return kind, Field(description=words)
        if not isinstance(default, _PLAIN_TYPES):
            return _union_type([kind, None]), Field(None, description=words)
        if isinstance(default, float) and _is_angle(hint):
            default = round(math.degrees(default), 9)
        if isinstance(default, tuple) or _allowed_letters(hint):
            default = [*default]  # type: ignore[misc]
        return kind, Field(default, description=words, validate_default=isinstance(default, str))

    def run_file_type(self, hint: Any, name: str) -> Any:
        """Return the type of an argument in run files.

        Args:
            hint: Annotation of the argument.
            name: Name of the argument.
        """
        origin, arguments, members = get_origin(hint), get_args(hint), _union_members(hint)
        form = next((self.forms[member] for member in members if member in self.forms), None)
        products = {found.product: name for name, found in self.groups.items() if found.product}
        group = next((products[member] for member in members if member in products), None)
        if form is not None:
            return form.table(name, _is_angle(hint))
        if group is not None:
            return Annotated[Any, OneOf(group)]
        if origin is Annotated:
            letters = _allowed_letters(hint)
            if letters:
                return Annotated[list[Literal[tuple(letters)]], MinLen(1)]  # type: ignore[valid-type]
            limits = [item for item in arguments[1:] if item != RADIANS]
            if float in members and any(_is_array(member) for member in members):
                number = Annotated[(float, *limits)] if limits else float
                return number_or_list(number, list[number])  # type: ignore[valid-type]
            kind = self.run_file_type(arguments[0], name)
            return Annotated[(kind, *limits)] if limits else kind  # type: ignore[return-value]
        if Path in members:
            return section.InputPath
        if hasattr(hint, "dim_str"):
            return _nested_list_type(hint.dim_str.split())
        if origin in (typing.Union, UnionType):
            allowed = [part for part in arguments if part is not NoneType]
            kinds = [self.run_file_type(part, name) for part in allowed if not _is_array(part)]
            lists = [list[float]] if any(_is_array(member) for member in members) else []
            return number_or_list(*kinds, *lists) if len(kinds + lists) > 1 else (kinds + lists)[0]
        if origin is tuple and arguments[-1] is not Ellipsis:
            item = self.run_file_type(arguments[0], name)
            return Annotated[list[item], Len(len(arguments), len(arguments))]
        if isinstance(origin, type) and issubclass(origin, Sequence):
            return list[self.run_file_type(arguments[0], name)]  # type: ignore[misc]
        if isinstance(origin, type) and issubclass(origin, Mapping):
            return dict[str, self.run_file_type(arguments[1], name)]  # type: ignore[misc]
        return _class_table(hint) if is_dataclass(hint) and isinstance(hint, type) else hint

    def convert_value(self, value: Any, hint: Any, name: str, given: Mapping[type, object]) -> Any:
        """Convert a value of the run file to the argument of the constructor.

        Args:
            value: Value that was read.
            hint: Annotation of the argument.
            name: Name of the argument.
            given: Values that no run file can hold, by their type.
        """
        if isinstance(value, ConstructorTable):
            return value.build(given)
        form = next((self.forms[m] for m in _union_members(hint) if m in self.forms), None)
        if form is not None:
            return form.value(value, name, _is_angle(hint), given)
        if _allowed_letters(hint):
            return "".join(value)
        if _is_angle(hint):
            value = _to_radians(value)
        members = [member for member in _union_members(hint) if member is not NoneType]
        hint = members[0] if len(members) == 1 else hint
        arguments = get_args(hint)
        if hasattr(hint, "dim_str"):
            import torch  # what reads a run file up to here must not wait for it

            return torch.tensor(value, dtype=torch.float64)
        if isinstance(value, list) and arguments:
            items = [self.convert_value(item, arguments[0], name, given) for item in value]
            return tuple(items) if get_origin(hint) is tuple else items
        if isinstance(value, dict) and len(arguments) == 2:
            return {k: self.convert_value(v, arguments[1], name, given) for k, v in value.items()}
        return value

    def _kinds(self, group: str) -> dict[str, _RegisteredKind]:
        """The kinds of a group, its own first where they are chosen by a key."""
        groups = self._load_kinds()
        own = groups[group].kinds
        if groups[group].includes is None:
            return own
        included = groups[groups[group].includes or ""].kinds
        return {name: kind for name, kind in included.items() if not kind.untagged} | own | included

    def _add_kind(self, group: str, kind: str, entry: _RegisteredKind) -> None:
        if group not in self.groups:
            known = ", ".join(self.groups)
            raise InputError(f"expected a group among {known}, got {group}; choose one")
        if kind in self.groups[group].kinds:
            raise InputError(f"expected a new name of a {group}, got {kind}; choose another")
        self.groups[group].kinds[kind] = entry

    def _load_kinds(self) -> dict[str, KindGroup]:
        """The groups, the library's own kinds before those of plugins."""
        modules = () if self._waiting is None else self.built_in
        made = [pkgutil.resolve_name(f"{module}:register") for module in modules]
        if self._waiting is not None:  # the modules build tables, which may have loaded the kinds
            waiting, self._waiting = self._waiting, None
            for register in made:
                register(self)
            for entry in waiting:
                self._add_kind(*entry)
        return self.groups


registry = Registry()


@cache
def load_plugins() -> Registry:
    """The registry with what installed packages add; one that fails is a warning, no more."""
    for entry in entry_points(group=PLUGINS):
        try:
            entry.load()(registry)
        except Exception as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            warnings.warn(f"plugin {entry.name} is left out: {reason}", stacklevel=2)
    return registry


def number_or_list(*kinds: Any) -> Any:
    """A type that is known by its form, a list, a table or else, so that errors name no member."""

    def tag(kind: Any) -> str:
        bare = get_args(kind)[0] if get_origin(kind) is Annotated else kind
        if get_origin(bare) is list:
            return "list"
        is_section = isinstance(bare, type) and issubclass(bare, section.Section)
        return "table" if is_section or get_origin(bare) is dict else "number"

    tags = [tag(kind) for kind in kinds]

    def form(value: Any) -> str:
        kind = "table" if isinstance(value, dict | section.Section) else "number"
        kind = "list" if isinstance(value, list) else kind
        return section.TAG_MARK + (kind if kind in tags else tags[0])

    named = zip(kinds, tags, strict=True)
    members = [Annotated[kind, Tag(section.TAG_MARK + name)] for kind, name in named]
    return Annotated[_union_type(members), Discriminator(form)]


def _union_type(kinds: Sequence[Any]) -> Any:
    return typing.Union[tuple(kinds)]  # noqa: UP007 - of kinds that are known at run time


def _union_members(hint: Any) -> tuple[Any, ...]:
    """The types that an annotation allows, without its limits."""
    if get_origin(hint) is Annotated:
        return _union_members(get_args(hint)[0])
    if get_origin(hint) in (typing.Union, UnionType):
        return tuple(member for part in get_args(hint) for member in _union_members(part))
    return (hint,)


def _annotation_marks(hint: Any) -> tuple[Any, ...]:
    found = hint.__metadata__ if get_origin(hint) is Annotated else ()
    if get_origin(hint) in (typing.Union, UnionType, Annotated):
        found += tuple(mark for part in get_args(hint) for mark in _annotation_marks(part))
    return found


def _is_angle(hint: Any) -> bool:
    return RADIANS in [mark for mark in _annotation_marks(hint) if isinstance(mark, str)]


def _allowed_letters(hint: Any) -> str:
    found = [mark for mark in _annotation_marks(hint) if isinstance(mark, AllowedLetters)]
    return found[0].letters if found else ""


def _is_array(kind: Any) -> bool:
    """Return True for rows of numbers, as `ArrayLike` has them."""
    return kind is Sequence or getattr(kind, "__name__", "") in ("Tensor", "ndarray")


def _nested_list_type(sizes: Sequence[str]) -> Any:
    if not sizes:
        return float
    kind = list[_nested_list_type(sizes[1:])]  # type: ignore[misc]
    return Annotated[kind, Len(int(sizes[0]), int(sizes[0]))] if sizes[0].isdigit() else kind


def _to_radians(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _to_radians(item) for name, item in value.items()}
    return [_to_radians(item) for item in value] if isinstance(value, list) else math.radians(value)


def _camel_case(name: str) -> str:
    return "".join(part[:1].upper() + part[1:] for part in re.split(r"\W|_", name))


@cache
def _combine_tables(
    first: type[ConstructorTable], second: type[ConstructorTable]
) -> type[ConstructorTable]:
    if issubclass(first, second):
        return first
    return type(f"{first.__name__}{second.__name__}", (first, second), {"__module__": __name__})


@cache
def _class_table(
    kind: Any,
    base: type[ConstructorTable] = ConstructorTable,
    without: tuple[str, ...] = (),
    checked: bool | None = None,
) -> Any:
    title = _camel_case(kind.__name__)
    return registry.constructor_table(kind, title, base, without=without, checked=checked)
