"""Directives of the site: run files with what they say of themselves, and menus of rooms."""

import importlib
import inspect
import os
import re
import tomllib
from functools import cache
from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx  # pyright: ignore[reportMissingImports]
from sphinx.util.docutils import SphinxDirective  # pyright: ignore[reportMissingImports]

import public_names

REPOSITORY = public_names.REPOSITORY
uses = cache(public_names.uses)


def told(run_file: Path) -> str:
    """What a run file says of itself: the comment at its top, else its title."""
    text = run_file.read_text()
    comment = re.match(r"(?:#[^\n]*\n)*", text)
    lines = [line.lstrip("# ") for line in comment[0].splitlines()] if comment else []
    return " ".join(filter(None, lines)) or tomllib.loads(text).get("title", "")


class RunFiles(SphinxDirective):  # pyright: ignore[reportUntypedBaseClass]
    """A table of the run files of a folder: the file, and what it does."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        rows = ["| run file | what it does |", "|---|---|"]
        for file in sorted((REPOSITORY / self.arguments[0]).glob("*.toml")):
            self.env.note_dependency(str(file))
            words = told(file).replace("|", r"\|")
            rows.append(f"| `{file.name}` | {words} |")
        return self.parse_text_to_nodes("\n".join(rows))


class Names(SphinxDirective):  # pyright: ignore[reportUntypedBaseClass]
    """The reference of a room: all its names, each with the pages whose code uses it."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        room = self.arguments[0]
        self.env.note_dependency(str(importlib.import_module(room).__file__))
        return [
            node
            for name in public_names.documented()[room]
            for node in self.parse_text_to_nodes(self.entry(room, name))
        ]

    def entry(self, room: str, name: str) -> str:
        thing = getattr(importlib.import_module(room), name)
        kind = (
            "class"
            if inspect.isclass(thing)
            else "function"
            if inspect.isroutine(thing)
            else "data"
        )
        here = Path(self.env.doc2path(self.env.docname))
        links = [
            f"[{page.stem}]({os.path.relpath(page, here.parent)})"
            for page in uses().get(name, [])
            if page != here
        ]
        entry = f".. auto{kind}:: {room}.{name}"
        if kind == "data":  # its docstring would be that of its type
            entry = f".. py:data:: {room}.{name}\n   :type: {type(thing).__name__}"
        text = f"```{{eval-rst}}\n{entry}\n```\n"
        return text + (f"\nUsed in: {', '.join(links)}.\n" if links else "")


def escape(
    app: Sphinx, what: str, name: str, thing: object, options: object, lines: list[str]
) -> None:
    """Bars and stars of formulas and shapes are no markup; in literals they stay as they are."""
    text = re.sub(
        r"(``.*?``|`[^`]*`)|([|*])",
        lambda m: m[1] or "\\" + m[2],
        "\n".join(lines),
        flags=re.DOTALL,
    )
    lines[:] = text.split("\n")


def shorten(
    app: Sphinx,
    what: str,
    name: str,
    thing: object,
    options: object,
    signature: str | None,
    returns: str | None,
) -> tuple[str | None, str | None]:
    """Hundreds of numbers of a default tell nobody anything."""
    return signature and re.sub(r"tensor\([^()]*\)", "tensor(...)", signature), returns


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("autodoc-process-docstring", escape, priority=100)
    app.connect("autodoc-process-signature", shorten)
    app.add_directive("run-files", RunFiles)
    app.add_directive("names", Names)
    return {"parallel_read_safe": True}
