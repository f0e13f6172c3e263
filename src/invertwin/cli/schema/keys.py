"""Reference tables of run-file keys, made from the JSON Schema."""

import contextlib
import hashlib
import importlib.util
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from invertwin.cli.report import ReportTable
from invertwin.limits import MAX_NUMBER
from invertwin.refusals import refusal
from invertwin.registry.kinds import PLUGINS
from invertwin.registry.section import suggest_name
from invertwin.runtime.doctor import cache_folder
from invertwin.storage.folders import write_text_file

KEY_COLUMNS = ("key", "value", "default", "unit or meaning")
_TYPE_NAMES = {"boolean": "true or false", "string": "text"}  # others are called as they are
_LIMIT_SIGNS = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
JsonSchema = dict[str, Any]


def json_schema() -> JsonSchema:
    """The JSON Schema of run files, for editors; kinds and sections of plugins are in it.

    Making it imports all that run files may name, which takes seconds; so it is kept on disk until
    a file of the installed code changes.
    """
    file = cache_folder() / f"keys-{_code_digest()}.json"
    with contextlib.suppress(OSError, ValueError):
        return json.loads(file.read_text(encoding="utf-8"))
    from invertwin.cli.schema import RunFile

    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    schema |= RunFile.model_json_schema()
    # Without a writable folder the next call rebuilds it: slower, not wrong.
    with contextlib.suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        for old in file.parent.glob("keys-*.json"):
            old.unlink()
        write_text_file(file, json.dumps(schema))
    return schema


def _code_digest() -> str:
    """A digest of the code that says what run files may name, plugins with it."""
    found = hashlib.sha256(f"{sys.version} {metadata.version('pydantic')}".encode())
    for name in sorted({"invertwin", *(e.module for e in metadata.entry_points(group=PLUGINS))}):
        spec = importlib.util.find_spec(name.partition(".")[0])
        for place in (spec and (spec.submodule_search_locations or [spec.origin])) or ():
            root = Path(place or "")
            for file in sorted(root.rglob("*.py")) if root.is_dir() else [root]:
                status = file.stat()
                found.update(f"{file} {status.st_size} {status.st_mtime_ns}".encode())
    return found.hexdigest()[:16]


def key_index() -> ReportTable:
    """The sections of a run file, and what each is."""
    top = json_schema()
    tables = {n: v for n, v in top["properties"].items() if _nested_tables(v, top["$defs"])}
    rows = [[name, value.get("description", "")] for name, value in tables.items()]
    note = "invertwin keys SECTION prints the keys of one, such as radar or radar.waveform."
    return ReportTable("Sections of a run file", ("section", "what it is"), rows, note)


def key_tables(section: str) -> list[ReportTable]:
    """The tables of a section of a run file and of what is in it.

    Args:
        section: Such as ``radar`` or ``radar.waveform``.

    Raises:
        InputError: There is no such section.
    """
    found = dict(_iterate_sections(json_schema()))
    wanted = section.strip("[]")
    names = [name for name in found if f"{_plain_path(name)}.".startswith(f"{wanted}.")]
    if not names:
        known = [_plain_path(name) for name in found if name]
        choice = ", ".join(n for n in known if "." not in n)
        advice = suggest_name(wanted, known, "choose one", 0.6)
        raise refusal("keys.unknown_section", choice, section, advice)
    return [table for name in names for table in found[name]]


def _plain_path(name: str) -> str:
    return name.replace(".<name>", "").replace("[", "").replace("]", "")


def _iterate_sections(top: JsonSchema) -> Iterator[tuple[str, list[ReportTable]]]:
    """Path and tables of every section, each right before those inside it.

    The top level comes first; its path is empty. A table that comes again is referred to.
    """
    defined: dict[str, JsonSchema] = top.get("$defs", {})
    seen: dict[frozenset[str], str] = {}

    def walk(path: str, models: Sequence[JsonSchema]) -> Iterator[tuple[str, list[ReportTable]]]:
        title = f"[{path}]" if path else "top of the file, and its sections"
        common = set.intersection(*map(_keys_without_tag, models)) if len(models) > 1 else set()
        first = models[0]
        shared = [k for k in first["properties"] if (k, _key_description(first, k)) in common]
        inner: list[tuple[str, list[JsonSchema]]] = []
        tables = []
        if shared:
            rows = [row(path, first, key, inner) for key in shared]
            tables.append(ReportTable(f"{title}, all kinds", KEY_COLUMNS, rows, ""))
        for model in models:
            keys = [key for key in model.get("properties", {}) if key not in shared]
            rows = [row(path, model, key, inner) for key in keys]
            tag = "".join(f" {key} = {value}" for key, value in _kind_tags(model).items())
            own = title if len(models) == 1 else f"{title}{tag or f' with {keys[0]}'}"
            document = " ".join(model.get("description", "").split())
            if rows or document:
                tables.append(ReportTable(own, KEY_COLUMNS, rows, document))
        yield path, tables
        for place, kinds in inner:
            yield from walk(place, kinds)

    def row(
        path: str, model: JsonSchema, key: str, inner: list[tuple[str, list[JsonSchema]]]
    ) -> list[Any]:
        value, note = model["properties"][key], _key_description(model, key)
        below = _nested_tables(value, defined)
        place = f"{path}.{key}" if path else key
        if "additionalProperties" in value and below and not path:
            place += ".<name>"
        elif value.get("type") == "array" and below and not path:
            place = f"[{key}]"
        identity = frozenset(str(_kind_tags(found) or found["title"]) for found in below)
        if below and identity in seen:
            note += f"; keys as in [{seen[identity]}]"
        elif below:
            inner.append((place, below))
            seen[identity] = place
        default = "required" if key in model.get("required", ()) else _format_default(value)
        return [key, _describe_value(value), default, note]

    yield from walk("", [top])


def _nested_tables(value: JsonSchema, defined: Mapping[str, JsonSchema]) -> list[JsonSchema]:
    """The tables that a value may be, or hold."""
    if "$ref" in value:
        model = defined[value["$ref"].rpartition("/")[2]]
        return [model] if "properties" in model else []
    held = [value[key] for key in ("items", "additionalProperties") if key in value]
    parts = [*value.get("anyOf", ()), *value.get("oneOf", ()), *held]
    tables = (part for part in parts if isinstance(part, dict))
    found = {id(model): model for part in tables for model in _nested_tables(part, defined)}
    return list(found.values())


def _describe_value(value: JsonSchema) -> str:
    parts = [*value.get("anyOf", ()), *value.get("oneOf", ())]
    if parts:
        words = [_describe_value(part) for part in parts if part.get("type") != "null"]
        return " or ".join(dict.fromkeys(words))
    if "const" in value or "enum" in value:
        return ", ".join(map(_format_value, value.get("enum", [value.get("const")])))
    if value.get("type") == "array":
        item, least = _describe_value(value.get("items", {})), value.get("minItems")
        exact = least is not None and least == value.get("maxItems")
        return f"{least} × {item}" if exact else f"list of {item}"
    if "$ref" in value or value.get("type", "object") == "object":
        return "table"
    # The limit of all numbers is not worth a word.
    own = {name: value[name] for name in _LIMIT_SIGNS if value.get(name, MAX_NUMBER) != MAX_NUMBER}
    signs = [f"{_LIMIT_SIGNS[name]} {limit:.10g}" for name, limit in own.items()]
    kind: str = value["type"]
    return " ".join([_TYPE_NAMES.get(kind, kind), ", ".join(signs)]).strip()


def _key_description(model: JsonSchema, key: str) -> str:
    return model["properties"][key].get("description", "")


def _kind_tags(model: JsonSchema) -> dict[str, str]:
    """The key that tells a kind from the others, with its one value."""
    values = model.get("properties", {}).items()
    return {key: _format_value(value["const"]) for key, value in values if "const" in value}


def _keys_without_tag(model: JsonSchema) -> set[tuple[str, str]]:
    """Keys and what they mean, without the one that names the kind."""
    own = model.get("properties", {}).keys() - _kind_tags(model).keys()
    return {(key, _key_description(model, key)) for key in own}


def _format_value(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


def _format_default(value: JsonSchema) -> str | None:
    default = value.get("default")
    if default is None or default in ({}, []):
        return None
    if not isinstance(default, dict):
        return _format_value(default)
    (name, item), *others = default.items()
    return None if others else f"{{{name} = {_format_value(item)}}}"
