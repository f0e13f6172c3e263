"""Sections and commands that other packages add to the command line, by entry points.

An entry point of the group `invertwin.plugins` is a function that is given the registry.
"""

from collections.abc import Callable
from functools import cache
from importlib.metadata import entry_points
from typing import Any

from pydantic import BaseModel


class Registry:
    """What plugins have added.

    Attributes:
        sections: Tables of run files, by name.
        commands: Functions with typer annotations, by name.
    """

    def __init__(self) -> None:
        self.sections: dict[str, type[BaseModel]] = {}
        self.commands: dict[str, Callable[..., Any]] = {}

    def section(self, name: str, model: type[BaseModel]) -> None:
        """Adds the table `[name]` to run files.

        Args:
            name: Its key.
            model: What it may hold.
        """
        self.sections[name] = model

    def command(self, name: str, function: Callable[..., Any]) -> None:
        """Adds a command.

        Args:
            name: What users type.
            function: What it does; its arguments have typer annotations.
        """
        self.commands[name] = function


@cache
def load_plugins() -> Registry:
    """The registry, after all plugins have seen it."""
    found = Registry()
    for entry in entry_points(group="invertwin.plugins"):
        entry.load()(found)
    return found
