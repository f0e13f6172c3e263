"""Docstrings of the library name what a caller gives: arguments, and fields of values.

Public are functions, methods and classes without an underscore on the way. Commands (`cli/`) are no
library. A method that overrides one leaves its arguments to the method that it overrides.
"""

import dataclasses
import importlib
import inspect
import pkgutil
import re
import textwrap
from collections.abc import Callable, Iterator
from functools import cache
from types import ModuleType
from typing import Any

import pytest
from pydantic import BaseModel

import invertwin
import invertwin_studies


def described(*texts: str | None) -> set[str]:
    """Names in the sections `Args:` and `Attributes:` of docstrings."""
    found: set[str] = set()
    for text in map(inspect.cleandoc, filter(None, texts)):
        for part in re.findall(r"^(?:Args|Attributes):\n((?:(?: {4}.*)?\n?)+)", text, re.M):
            for names in re.findall(r"^ {4}(\w+(?:, \w+)*): ", part, re.M):
                found |= set(names.split(", "))
    return found


def commented(owner: type) -> set[str]:
    """Fields with a comment in their line. It may hold for fields without one that follow."""
    found, told = set(), False
    for line in textwrap.dedent(inspect.getsource(owner)).splitlines():
        field = re.match(r" {4}(\w+): .+?(  # .+)?$", line)
        if field is None:
            told = False
        elif told := told or bool(field[2]):
            found.add(field[1])
    return found


def arguments(function: Callable[..., Any]) -> list[str]:
    """Names of the parameters that a caller gives."""
    return [name for name in inspect.signature(function).parameters if name not in ("self", "cls")]


def untold(names: list[str], told: set[str]) -> list[str]:
    """What is missing, where there are two names or more."""
    return [name for name in names if name not in told and name[0] != "_"] if len(names) > 1 else []


def missing_of_class(owner: type) -> Iterator[tuple[str, list[str]]]:
    """Constructor and public methods with names that no docstring tells."""
    if dataclasses.is_dataclass(owner):
        fields = [field.name for field in dataclasses.fields(owner) if field.init]
        told = {name for base in owner.__mro__ for name in described(base.__doc__)}
        told |= {
            n for base in owner.__mro__ if dataclasses.is_dataclass(base) for n in commented(base)
        }
        yield "fields", untold(fields, told)
    elif "__init__" in vars(owner) and not getattr(owner, "_is_protocol", False):
        texts = [text for base in owner.__mro__ for text in (base.__doc__, base.__init__.__doc__)]
        yield "__init__", untold(arguments(owner.__init__), described(*texts))
    for name, value in vars(owner).items():
        function = inspect.unwrap(getattr(value, "__func__", value))
        overrides = any(name in vars(base) for base in owner.__mro__[1:])
        if inspect.isfunction(function) and not name.startswith("_") and not overrides:
            yield name, untold(arguments(function), described(function.__doc__))


def missing(module: ModuleType) -> list[str]:
    """All that a module's docstrings leave out, as `module.function: names`."""
    found: list[tuple[str, list[str]]] = []
    for name, value in vars(module).items():
        if name.startswith("_") or getattr(value, "__module__", "") != module.__name__:
            continue
        if isinstance(value, type) and not issubclass(value, BaseModel):
            found += [(f"{name}.{method}", names) for method, names in missing_of_class(value)]
        elif inspect.isfunction(inspect.unwrap(value)) and callable(value):
            found.append((name, untold(arguments(value), described(value.__doc__))))
    return [f"{module.__name__}.{name}: {', '.join(names)}" for name, names in found if names]


def stale_references(module: ModuleType) -> list[str]:
    """Members of the package's classes that docstrings of a module name and that do not exist."""
    found: list[str] = []
    for name, text in re.findall(
        r"``(?:\w+\.)*([A-Z]\w+\.\w+)(\(\))?``", inspect.getsource(module)
    ):
        owner, member = name.split(".")
        kinds = classes_by_name().get(owner, [])
        if kinds and not any(has_member(kind, member) for kind in kinds):
            found.append(f"{module.__name__}: {name}{text}")
    return found


def has_member(owner: type, name: str) -> bool:
    """Whether a class has an attribute, a field, or sets one in a method."""
    annotated = any(name in vars(base).get("__annotations__", ()) for base in owner.__mro__)
    own = [base for base in owner.__mro__ if base.__module__.startswith("invertwin")]
    return (
        hasattr(owner, name)
        or annotated
        or any(f"self.{name}" in inspect.getsource(base) for base in own)
    )


MODULES = [
    module.name
    for package in (invertwin, invertwin_studies)
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    if not re.search(r"\._|^invertwin\.cli\b|\.commands$", module.name)
]


@cache
def classes_by_name() -> dict[str, list[type]]:
    """Classes of all modules."""
    found: dict[str, list[type]] = {}
    for module in map(importlib.import_module, MODULES):
        for name, value in vars(module).items():
            if isinstance(value, type) and value.__module__ == module.__name__:
                found.setdefault(name, []).append(value)
    return found


@pytest.mark.parametrize("name", MODULES)
def test_docstrings_name_members_that_exist(name):
    assert stale_references(importlib.import_module(name)) == []


@pytest.mark.parametrize("name", MODULES)
def test_docstrings_name_every_argument(name):
    assert missing(importlib.import_module(name)) == []


def test_a_name_that_is_left_out_is_found():
    def told(first: int, second: int) -> None:
        """Text.

        Args:
            first: One thing.
        """

    assert untold(arguments(told), described(told.__doc__)) == ["second"]

    @dataclasses.dataclass
    class Value:
        """Text."""

        known: int  # a comment
        also: int
        text = "no field"
        other: int = 0

    assert list(missing_of_class(Value)) == [("fields", ["other"])]


def test_a_member_that_does_not_exist_is_found():
    module = ModuleType("somewhere")
    text = "Text of ``Chirps.interval``, ``iw.Chirps.max_speed()``, and ``Chirps.pace``."
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inspect, "getsource", lambda _: text)
        patch.setattr(f"{__name__}.has_member", lambda _, name: name in ("interval", "max_speed"))
        assert stale_references(module) == ["somewhere: Chirps.pace"]
