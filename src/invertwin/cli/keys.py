"""What may be written in a run file, as tables made from its JSON Schema."""

import difflib
import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from invertwin.cli.report import Table
from invertwin.cli.schema import RunFile
from invertwin.errors import InputError

COLUMNS = ("key", "value", "default", "unit or meaning")
_WORDS = {"number": "number", "integer": "integer", "boolean": "true or false", "string": "text"}
_SIGNS = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
Schema = dict[str, Any]


def json_schema() -> Schema:
    """The JSON Schema of run files, for editors; kinds and sections of plugins are in it."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **RunFile.model_json_schema(),
    }


def key_tables(section: str | None = None) -> list[Table]:
    """One table for every section of a run file, or for one section and what is in it.

    Args:
        section: Such as ``radar`` or ``radar.waveform``; None = all.

    Raises:
        InputError: There is no such section.
    """
    found = dict(_sections(json_schema()))
    if section is None:
        return [table for tables in found.values() for table in tables]
    wanted = section.strip("[]")
    names = [name for name in found if f"{_plain(name)}.".startswith(f"{wanted}.")]
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


def _sections(top: Schema) -> Iterator[tuple[str, list[Table]]]:
    """Path and tables of every section, each right before those inside it.

    The top level comes first; its path is empty. A table that comes again is referred to.
    """
    defined: dict[str, Schema] = top.get("$defs", {})
    seen: dict[frozenset[str], str] = {}

    def walk(path: str, models: Sequence[Schema]) -> Iterator[tuple[str, list[Table]]]:
        title = f"[{path}]" if path else "top of the file, and its sections"
        common = set.intersection(*map(_untagged, models)) if len(models) > 1 else set()
        shared = [key for key in models[0]["properties"] if (key, _note(models[0], key)) in common]
        inner: list[tuple[str, list[Schema]]] = []
        tables = []
        if shared:
            rows = [row(path, models[0], key, inner) for key in shared]
            tables.append(Table(f"{title}, all kinds", COLUMNS, rows, ""))
        for model in models:
            keys = [key for key in model.get("properties", {}) if key not in shared]
            rows = [row(path, model, key, inner) for key in keys]
            tag = "".join(f" {key} = {value}" for key, value in _tags(model).items())
            own = title if len(models) == 1 else f"{title}{tag or f' with {keys[0]}'}"
            document = " ".join(model.get("description", "").split())
            if rows or document:
                tables.append(Table(own, COLUMNS, rows, document))
        yield path, tables
        for place, kinds in inner:
            yield from walk(place, kinds)

    def row(path: str, model: Schema, key: str, inner: list[tuple[str, list[Schema]]]) -> list[Any]:
        value, note = model["properties"][key], _note(model, key)
        below = _below(value, defined)
        place = f"{path}.{key}" if path else key
        if "additionalProperties" in value and below and not path:
            place += ".<name>"
        elif value.get("type") == "array" and below and not path:
            place = f"[{key}]"
        identity = frozenset(str(_tags(found) or found["title"]) for found in below)
        if below and identity in seen:
            note += f"; keys as in [{seen[identity]}]"
        elif below:
            inner.append((place, below))
            seen[identity] = place
        required = key in model.get("required", ())
        return [key, _described(value), "required" if required else _default(value), note]

    yield from walk("", [top])


def _below(value: Schema, defined: Mapping[str, Schema]) -> list[Schema]:
    """The tables that a value may be, or hold."""
    if "$ref" in value:
        model = defined[value["$ref"].rpartition("/")[2]]
        return [model] if "properties" in model else []
    held = [value[key] for key in ("items", "additionalProperties") if key in value]
    parts = [*value.get("anyOf", ()), *value.get("oneOf", ()), *held]
    tables = (part for part in parts if isinstance(part, dict))
    return list({id(model): model for part in tables for model in _below(part, defined)}.values())


def _described(value: Schema) -> str:
    parts = [*value.get("anyOf", ()), *value.get("oneOf", ())]
    if parts:
        words = [_described(part) for part in parts if part.get("type") != "null"]
        return " or ".join(dict.fromkeys(words))
    if "const" in value or "enum" in value:
        return ", ".join(map(_shown, value.get("enum", [value.get("const")])))
    if value.get("type") == "array":
        item, least = _described(value.get("items", {})), value.get("minItems")
        exact = least is not None and least == value.get("maxItems")
        return f"{least} × {item}" if exact else f"list of {item}"
    if "$ref" in value or value.get("type", "object") == "object":
        return "table"
    signs = [f"{sign} {value[name]:.10g}" for name, sign in _SIGNS.items() if name in value]
    return " ".join([_WORDS[value["type"]], ", ".join(signs)]).strip()


def _note(model: Schema, key: str) -> str:
    return model["properties"][key].get("description", "")


def _tags(model: Schema) -> dict[str, str]:
    """The key that tells a kind from the others, with its one value."""
    values = model.get("properties", {}).items()
    return {key: _shown(value["const"]) for key, value in values if "const" in value}


def _untagged(model: Schema) -> set[tuple[str, str]]:
    """Keys and what they mean, without the one that names the kind."""
    tags = _tags(model)
    return {(key, _note(model, key)) for key in model.get("properties", {}) if key not in tags}


def _shown(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


def _default(value: Schema) -> str | None:
    default = value.get("default")
    if default is None or default in ({}, []):
        return None
    if not isinstance(default, dict):
        return _shown(default)
    (name, item), *others = default.items()
    return None if others else f"{{{name} = {_shown(item)}}}"
