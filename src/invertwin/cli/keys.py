"""What may be written in a run file, as tables made from the schema itself."""

import difflib
import types
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from invertwin.cli.report import Table
from invertwin.cli.run_file import inline
from invertwin.cli.schema import RunFile, Section
from invertwin.errors import InputError

COLUMNS = ("key", "value", "default", "unit or meaning")
_NAMED = {
    **{name: f"{name}.<name>" for name in ("scene", "truth", "variants", "observations")},
    **{name: f"[{name}]" for name in ("parameters", "stages")},
}
_WORDS = {float: "number", int: "integer", bool: "true or false", str: "text"}
_SIGNS = {Gt: ("gt", ">"), Ge: ("ge", "≥"), Lt: ("lt", "<"), Le: ("le", "≤")}


def key_tables(section: str | None = None) -> list[Table]:
    """One table for every section of a run file, or for one section and what is in it.

    Args:
        section: Such as ``radar`` or ``radar.waveform``; None = all.

    Raises:
        InputError: There is no such section.
    """
    found = dict(_tables())
    if section is None:
        return [table for tables in found.values() for table in tables]
    wanted = section.strip("[]")
    names = [name for name in found if _under(_plain(name), wanted)]
    if not names:
        known = [_plain(name) for name in found if name]
        close = difflib.get_close_matches(wanted, known, n=1)
        advice = f"did you mean `{close[0]}`?" if close else "choose one"
        raise InputError(
            f"expected a section ({', '.join(n for n in known if '.' not in n)}), "
            f"got {section}; {advice}"
        )
    return [table for name in names for table in found[name]]


def _plain(name: str) -> str:
    return name.replace(".<name>", "").replace("[", "").replace("]", "")


def _under(name: str, wanted: str) -> bool:
    return name == wanted or name.startswith(wanted + ".")


def _tables() -> Iterator[tuple[str, list[Table]]]:
    """Path and tables of every section, the top level first (its path is empty)."""
    seen: dict[type[Section], str] = {}
    waiting: list[tuple[str, list[type[Section]]]] = [("", [RunFile])]
    while waiting:
        path, models = waiting.pop(0)
        tables, inner = _section(path, models, seen)
        yield path, tables
        # A section comes right before those inside it.
        waiting = inner + waiting


def _section(
    path: str, models: Sequence[type[Section]], seen: dict[type[Section], str]
) -> tuple[list[Table], list[tuple[str, list[type[Section]]]]]:
    for model in models:
        seen |= {base: path for base in model.__mro__ if issubclass(base, Section)}
    common = {key for key, _ in set.intersection(*map(_untagged, models))}
    groups = [(model, [k for k in model.model_fields if k not in common]) for model in models]
    inner: list[tuple[str, list[type[Section]]]] = []
    tables = []
    if len(models) > 1 and common:
        first = models[0]
        keys = [key for key in first.model_fields if key in common]
        groups = [(first, keys), *groups]
    elif len(models) == 1:
        groups = [(models[0], list(models[0].model_fields))]
    for i, (model, keys) in enumerate(groups):
        shared = len(models) > 1 and bool(common) and i == 0
        rows = []
        for key in keys:
            field = model.model_fields[key]
            below = _sections(field.annotation)
            place = ".".join(filter(None, [path, _NAMED.get(key, key) if not path else key]))
            note = field.description or ""
            if below and below[0] in seen:
                note += f"; keys as in [{seen[below[0]]}]"
            elif below:
                inner.append((place, below))
                seen |= dict.fromkeys(below, place)
            rows.append([key, _values(field), _default(field), note])
        title = f"[{path}]" if path else "top of the file, and its sections"
        if shared:
            title += ", all kinds"
        elif len(models) > 1:
            tag = "".join(f" {key} = {value}" for key, value in _tags(model).items())
            title += f"{tag or ' with ' + _first_key(model, common)}"
        document = "" if shared or model.__doc__ == Section.__doc__ else model.__doc__ or ""
        if rows or document:
            tables.append(Table(title, COLUMNS, rows, " ".join(document.split())))
    return tables, inner


def _untagged(model: type[Section]) -> set[tuple[str, str | None]]:
    """Keys and what they mean, without the one that names the kind."""
    tags = _tags(model)
    return {(k, field.description) for k, field in model.model_fields.items() if k not in tags}


def _tags(model: type[Section]) -> dict[str, str]:
    """The key that tells a kind from the others, with its one value."""
    return {
        key: inline(get_args(field.annotation)[0])
        for key, field in model.model_fields.items()
        if get_origin(field.annotation) is Literal and len(get_args(field.annotation)) == 1
    }


def _first_key(model: type[Section], common: set[str]) -> str:
    return next(key for key in model.model_fields if key not in common)


def _sections(kind: Any) -> list[type[Section]]:
    """The sections that a value may be."""
    if isinstance(kind, type) and issubclass(kind, Section):
        return [kind]
    arguments = get_args(kind)
    if get_origin(kind) is Annotated:
        arguments = arguments[:1]
    return list(dict.fromkeys(s for a in arguments for s in _sections(a)))


def _values(field: FieldInfo) -> str:
    return _described(field.annotation, field.metadata)


def _described(kind: Any, limits: Sequence[Any] = ()) -> str:
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return _described(arguments[0], [*_flat(arguments[1:]), *limits])
    if origin is Literal:
        return ", ".join(map(inline, arguments))
    if origin in (Union, types.UnionType):
        words = [_described(a) for a in arguments if a is not type(None)]
        return " or ".join(dict.fromkeys(words))
    if origin is list:
        return _listed(_described(arguments[0]), limits)
    if origin is dict or (isinstance(kind, type) and issubclass(kind, Section)):
        return "table"
    signs = [
        f"{sign} {getattr(limit, name):.10g}"
        for limit in limits
        for mark, (name, sign) in _SIGNS.items()
        if isinstance(limit, mark)
    ]
    return " ".join([_WORDS[kind], ", ".join(signs)]).strip()


def _listed(item: str, limits: Sequence[Any]) -> str:
    least = next((limit.min_length for limit in limits if isinstance(limit, MinLen)), 0)
    most = next((limit.max_length for limit in limits if isinstance(limit, MaxLen)), None)
    return f"{most} × {item}" if least == most else f"list of {item}"


def _flat(metadata: Sequence[Any]) -> list[Any]:
    found: list[Any] = []
    for item in metadata:
        found += item.metadata if isinstance(item, FieldInfo) else [item]
    return found


def _default(field: FieldInfo) -> str | None:
    if field.default is PydanticUndefined:
        return "required"
    if field.default is None or field.default in ({}, []):
        return None
    if isinstance(field.default, Section):
        values = field.default.model_dump(exclude_none=True)
        return None if len(values) > 1 else inline(values)
    return inline(field.default)
