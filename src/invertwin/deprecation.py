"""Old spellings of the API: they work for one version, with a warning that names the new one."""

import sys
import warnings
from collections.abc import Mapping
from functools import reduce
from typing import Any


def warn_renamed(old: str, new: str, stacklevel: int = 3) -> None:
    """Issue a DeprecationWarning of one line, "old → new".

    Args:
        old: the deprecated spelling.
        new: the spelling to use instead.
        stacklevel: frames from this function to the line that the warning points at.
    """
    warnings.warn(f"deprecated: {old} → {new}", DeprecationWarning, stacklevel=stacklevel)


def rename_attributes(module: str, names: Mapping[str, str]) -> None:
    """Let a module find attributes by their old names, with a warning.

    It sets the module's ``__getattr__``, so that type checkers know the new names alone.

    Args:
        module: dotted name of the module, ``__name__``.
        names: old names and the new ones: names of the module itself, or dotted paths from the
            package, such as ``discovery.MovingBody``.
    """
    package = module.partition(".")[0]
    found = vars(sys.modules[module])
    find_present = found.get("__getattr__")

    def find_attribute(name: str) -> Any:
        if name not in names:
            if find_present is not None:
                return find_present(name)
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        path = names[name]
        full = f"{package}.{path}" if "." in path else f"{module}.{path}"
        warn_renamed(f"{module}.{name}", full)
        return reduce(getattr, full.split(".")[1:], sys.modules[package])

    found["__getattr__"] = find_attribute
