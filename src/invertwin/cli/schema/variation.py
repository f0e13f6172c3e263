"""Random variation of run files: key paths, drawn values, and the resulting run file."""

import copy
import re
from collections.abc import Iterable
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from invertwin.datasets import UNCHANGED
from invertwin.errors import InputError
from invertwin.refusals import refusal, refusal_text
from invertwin.registry.section import raise_key_error, suggest_name
from invertwin.seeds import derive_seed

KeyPath = tuple[str | int, ...]
_KEY_PATH_PATTERN = re.compile(r'(?:^|(?<=.)\.)(?:"([^"]+)"|([^.\[\]"\s]+))|\[(\d+)\]')
_MAX_LISTED_NAMES = 12  # names that an error lists


def parse_key_path(path: str) -> KeyPath:
    """Names and numbers of a path such as ``scene.box.position[0]``; none where it is no path.

    A name with dots stands in quotes.
    """
    found = list(_KEY_PATH_PATTERN.finditer(path))
    if "".join(step[0] for step in found) != path:
        return ()
    return tuple(int(step[3]) if step[3] else step[1] or step[2] for step in found)


def check_samples(run: Any, raw: dict[str, Any], info: Any) -> None:
    """Refuse a run file whose samples would be no run files; errors begin at the table.

    Every distribution is tried at its ends, the other keys as they are stated.

    Args:
        run: The run file.
        raw: The same as TOML, without its data-set sections.
        info: Validation info of pydantic.
    """
    kind = type(run)
    whole = TypeAdapter(dict[str, kind])  # type: ignore[valid-type]
    taken: set[KeyPath] = set()
    for number, table in enumerate(run.vary):
        at = f"vary[{number}]"
        for path in table.paths:
            if parse_key_path(path) in taken:
                raise_key_error(refusal_text("variation.key_twice", path), f"{at}.key")
            taken.add(parse_key_path(path))
        for value in table.build().extreme_values():
            try:
                changed = set_values(raw, ((path, value) for path in table.paths))
            except InputError as error:
                raise_key_error(str(error), f"{at}.key")
            whole.validate_python({at: changed}, context=info.context)


def draw_sample(run: Any, raw: dict[str, Any], index: int) -> dict[str, Any]:
    """The run file of a sample as TOML; it depends on the run file, its seed and the index only.

    Args:
        run: The run file of the data set.
        raw: The same as TOML, without its data-set sections.
        index: Index of the sample.

    Raises:
        InputError: A key that is not there, since another drawn value has replaced its table.
    """
    drawn = []
    for number, table in enumerate(run.vary, 1):
        words = np.random.SeedSequence(run.seed, spawn_key=(index, number))
        value = table.build().draw(np.random.default_rng(words))
        if value is not UNCHANGED:
            drawn += [(path, value) for path in table.paths]
    return set_values(raw, drawn) | {"task": "simulate", "seed": derive_seed(run.seed, index, 0)}


def set_values(raw: dict[str, Any], values: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """A run file as TOML with other values; None takes a key away, after all else is done.

    Args:
        raw: The run file.
        values: Path and value of each.

    Raises:
        InputError: A path that leads nowhere. Only its last name may be new.
    """
    changed, removed = copy.deepcopy(raw), []
    for path, value in values:
        holder, last = _find_holder(changed, path)
        if value is None:
            removed.append((holder, last))
        else:
            holder[last] = copy.deepcopy(value)
    # Of a list the last ones first: the others keep their numbers until then.
    removed.sort(key=lambda row: row[1] if isinstance(row[1], int) else -1, reverse=True)
    for holder, last in removed:
        if isinstance(last, int) or last in holder:
            del holder[last]
    return changed


def _find_holder(raw: dict[str, Any], path: str) -> tuple[Any, Any]:
    """The table or list that holds a key, and the key."""
    *way, last = parse_key_path(path)
    holder: Any = raw
    for step in way:
        holder = _get_entry(holder, step, path)
    if isinstance(last, int):
        _get_entry(holder, last, path)
    elif not isinstance(holder, dict):
        raise InputError(f'{path}: expected a table before "{last}", got {holder}; correct the key')
    return holder, last


def _get_entry(holder: Any, step: str | int, path: str) -> Any:
    if isinstance(step, int):
        if isinstance(holder, list) and step < len(holder):
            return holder[step]
        got = f"a list of {len(holder)}" if isinstance(holder, list) else "none"
        raise refusal("variation.no_entry", path, step, got)
    known = list(holder) if isinstance(holder, dict) else []
    if step in known:
        return holder[step]
    choice = ", ".join(known[:_MAX_LISTED_NAMES]) or "none"
    raise refusal("variation.key", path, choice, step, suggest_name(step, known, "add it", 0.6))
