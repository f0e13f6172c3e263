"""Run files in and out: TOML to the schema with errors that help, and back to TOML.

The schema, and torch with it, is imported once a file is TOML.
"""

import difflib
import json
import re
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from shlex import quote
from typing import Any

import tomli_w
from pydantic import ValidationError
from pydantic_core import ErrorDetails

from invertwin.cli.report import load_texts
from invertwin.constants import FRAME, read_table
from invertwin.errors import InputError
from invertwin.refusals import refusal, refusal_text
from invertwin.registry.section import TAG_MARK, suggest_name
from invertwin.registry.section import prefix_errors as prefix_errors
from invertwin.registry.section import require_section as require_section
from invertwin.storage.untrusted import convert_read_errors, existing_file

_MAX_ERRORS = 20  # in one line
_SENSORS = ("radar", "data", "observations")  # sections with boards
_MAX_BYTES = 4_000_000  # tens of thousands of objects or places
# Sections and kinds of the package in experiments/studies.
_STUDY_NAMES = ("methods", "loss_scan", "openradar", "rail_sar", "vehicle", "shape_space")
_INSTALL_STUDIES_ADVICE = "install the studies: pip install -e ./experiments/studies"


def load_run(path: Path) -> Any:
    """Read and validate a run file: a `RunFile` of the schema.

    Raises:
        InputError: The file is missing, is not TOML, or does not fit the schema; the message
            names the key's path, what is allowed there and the nearest match, in one line.
    """
    raw = parse_toml(path, read_text(path))
    _raise_errors(path, _unknown_boards(raw))
    return validate_run(raw, path)


def read_text(path: Path) -> str:
    """The text of a run file, its line ends as they are.

    Raises:
        InputError: The file is missing or is no text.
    """
    file = existing_file(path, "a run file")
    with convert_read_errors(file, "a readable run file", "give a TOML text file"):
        if file.stat().st_size > _MAX_BYTES:
            raise ValueError(f"more than {_MAX_BYTES / 1e6:.0f} MB")
        return file.read_bytes().decode("utf-8")


def parse_toml(path: Path, text: str) -> dict[str, Any]:
    """The tables of a run file.

    Args:
        path: Path of the file, for errors.
        text: Content of the file.

    Raises:
        InputError: It is not TOML.
    """
    with convert_read_errors(path, "a run file in TOML", "simplify it"):
        try:
            return tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise InputError(_syntax_error_message(path, text, str(error))) from None


def is_run_file(path: Path) -> bool:
    """Return whether a file is TOML with a task; descriptions of recordings have none."""
    if path.suffix.lower() != ".toml":
        return False
    try:
        return "task" in tomllib.loads(read_text(path))
    except (ValueError, RecursionError):  # of thousands of levels
        return False


def validate_run(raw: dict[str, Any], source: Path) -> Any:
    """The run file of parsed TOML; `source` names it in errors and anchors relative paths.

    Raises:
        InputError: It does not fit the schema, or states no frame.
    """
    if "task" in raw and "frame" not in raw:
        raise refusal("run_file.first_frame", source, FRAME, quote(str(source)))
    try:
        from invertwin.cli.schema import RunFile

        return RunFile.model_validate(raw, context={"folder": source.parent})
    except ValidationError as error:
        _raise_errors(source, error.errors(include_url=False))


def _unknown_boards(table: dict[str, Any], *place: str) -> Iterator[ErrorDetails]:
    """Errors of boards as those of the schema, which needs seconds for its imports."""
    boards = [*read_table("invertwin", "radar/boards.toml")]
    for name, value in table.items():
        at = (*place, name)
        # No deeper than observations.front.radar.board.name: a stranger's keys go on for ever.
        if isinstance(value, dict) and len(at) < 5:
            yield from _unknown_boards(value, *at)
        elif at[-2:] == ("board", "name") and at[0] in _SENSORS and value not in boards:
            known = {"expected": ", ".join(boards)}
            yield {"type": "literal_error", "loc": at, "msg": "", "input": value, "ctx": known}


def _raise_errors(source: Path, errors: Iterable[ErrorDetails]) -> None:
    if lines := [*dict.fromkeys(map(_explain_error, errors))]:
        raise InputError(f"{source}: {' — also '.join(lines[:_MAX_ERRORS])}") from None


def to_toml(run: Any) -> str:
    """The run file as used, defaults filled in; reading it back gives an equal run file."""
    return tomli_w.dumps(run.model_dump(exclude_none=True))


def to_minimal_toml(run: Any) -> str:
    """The run file without what it leaves to defaults, some of which depend on other sections."""
    return tomli_w.dumps(run.model_dump(exclude_unset=True, exclude_none=True))


def unknown_object_message(path: str, name: str, known: Sequence[str]) -> str:
    """Return the message for a key that names an object which the scene does not have."""
    advice = suggest_name(name, known, "add it to the scene")
    return refusal_text("run_file.object", path, ", ".join(known), _format_value(name), advice)


def _syntax_error_message(path: Path, text: str, message: str) -> str:
    place = re.search(r" \(at line (\d+), column \d+\)$", message)
    lines = text.splitlines() or [""]
    number = int(place[1]) if place else len(lines)
    reason = message[: place.start()] if place else message
    line = lines[min(number, len(lines)) - 1].strip()
    reason = " ".join(reason.split())
    return refusal_text("run_file.syntax", path, number, _format_value(line), reason)


def _explain_error(error: ErrorDetails) -> str:
    """One pydantic error as `path: expected ..., got ...; do ...`."""
    path = ""
    for item in error["loc"]:
        if isinstance(item, int):
            path += f"[{item}]"
        elif not item.startswith(TAG_MARK):
            path += f".{item}" if path else item
    got = _format_value(error["input"])
    context = error.get("ctx", {})
    match error["type"]:
        case "unknown_key":
            key, allowed = context["key"], context["allowed"]
            said = f"expected one of the keys {', '.join(allowed)}, got {_format_value(key)}; "
            at = f"{path}.{key}".lstrip(".")
            advice = load_texts("moved_keys").get(at) or load_texts("moved_keys").get(key)
            if at in _STUDY_NAMES:
                advice = _INSTALL_STUDIES_ADVICE
            return f"{at}: {said}{advice or suggest_name(key, allowed, 'remove the key')}"
        case "unknown_object":
            at = ".".join(filter(None, (path, context["path"])))
            return unknown_object_message(at, context["name"], context["known"])
        case "union_tag_not_found":
            keys = context["discriminator"].removesuffix("()").split(",")
            present = [*error["input"]][:_MAX_ERRORS] if isinstance(error["input"], dict) else []
            guesses = [k for p in present for k in difflib.get_close_matches(p, keys, n=1)]
            advice = f"did you mean `{guesses[0]}`?" if guesses else f"add `{keys[0]}`"
            return f"{path}: expected a table with the key {' or '.join(keys)}, got {got}; {advice}"
        case "union_tag_invalid":
            key, *others = context["discriminator"].removesuffix("()").split(",")
            tags = [t.strip(f" '{TAG_MARK}") for t in context["expected_tags"].split(",")]
            allowed = [tag for tag in tags if tag not in (*others, "points")]
            tag = context["tag"].strip(TAG_MARK)
            advice = suggest_name(tag, allowed, "choose one")
            advice = _INSTALL_STUDIES_ADVICE if tag in _STUDY_NAMES else advice
            said = f"expected one of {', '.join(allowed)}, got {_format_value(tag)}"
            return f"{path}.{key}: {said}; {advice}"
        case "literal_error":
            allowed = [t.strip(" '") for t in context["expected"].replace(" or ", ", ").split(",")]
            advice = suggest_name(str(error["input"]), allowed, "choose one")
            if len(allowed) == 1:
                return f"{path}: expected {allowed[0]}, got {got}; correct the value"
            return f"{path}: expected one of {', '.join(allowed)}, got {got}; {advice}"
        case "missing":
            return f"{path}: expected a value, got nothing; add the key `{error['loc'][-1]}`"
        case "too_short" | "too_long":
            least = error["type"] == "too_short"
            size = (
                f"at least {context['min_length']}" if least else f"at most {context['max_length']}"
            )
            return f"{path}: expected {size} items, got {got}; correct the list"
        case "section":
            return ".".join(filter(None, (path, context["path"]))) + f": {error['msg']}"
    # Pydantic says "..., got a number with a fractional part": the value itself says it, too.
    expected = error["msg"].removeprefix("Input should be ").split(", got ")[0]
    for words, ours in load_texts("phrases").items():
        expected = re.sub(words, ours, expected)
    return f"{path}: expected {expected}, got {got}; correct the value"


def _format_value(value: Any) -> str:
    try:
        text = json.dumps(value, ensure_ascii=False)
    except TypeError:
        text = " ".join(str(value).split())
    except (ValueError, RecursionError):  # of thousands of digits or levels
        text = "a value too long to show"
    return text if len(text) <= 60 else text[:57] + "..."
