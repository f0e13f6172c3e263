"""Errors whose texts take more than a line: those of refusals.toml."""

from typing import Any

from invertwin.constants import read_table
from invertwin.errors import InputError


def refusal(name: str, *values: Any, at: str = "") -> InputError:
    """Make the error of bad input.

    Args:
        name: Section and key of refusals.toml, such as ``rcs.part``.
        values: What its text leaves open.
        at: The key of a run file that it is about.
    """
    return InputError(refusal_text(name, *values), at)


def refusal_text(name: str, *values: Any) -> str:
    """Make the text of an error or a warning; the file is read only where there is one.

    Args:
        name: Section and key of refusals.toml, such as ``rcs.part``.
        values: What the text leaves open.
    """
    section, key = name.split(".")
    return read_table("invertwin", "refusals.toml")[section][key].format(*values)
