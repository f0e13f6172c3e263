"""Directives of the site: run files with what they say of themselves, and menus of rooms."""

import html
import importlib
import inspect
import os
import re
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

from bs4 import BeautifulSoup  # pyright: ignore[reportMissingImports]
from docutils import nodes
from sphinx.application import Sphinx  # pyright: ignore[reportMissingImports]
from sphinx.util.docutils import SphinxDirective  # pyright: ignore[reportMissingImports]

import public_names

REPOSITORY = public_names.REPOSITORY
LONG = 30_000  # characters of a page whose inner sections are folded
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


def fold(app: Sphinx, page: str, template: str, context: dict[str, Any], tree: object) -> None:
    """Fold the entries of the reference and the inner sections of long pages.

    Links to what is folded open it, and so does the browser's search in the page.
    """
    body = BeautifulSoup(context.get("body", ""), "html.parser")
    for entry in body.select("dl.py"):
        if entry.find_parent("dl", class_="py") is None and page.startswith("api/"):
            first = entry.select_one("dd > p")
            said = "" if first is None else first.get_text().split(". ")[0].rstrip(".")
            name = str(entry.select("dt")[0]["id"]).rsplit(".", 1)[-1]
            text = BeautifulSoup(f"<code>{name}</code> {html.escape(said)}", "html.parser")
            after = entry.find_next_sibling()
            used = after is not None and after.get_text().startswith("Used in:")
            _fold(body, text, [entry, after] if used else [entry])
    if len(body.get_text()) > LONG and not page.startswith("api/"):
        for heading in body.find_all("h3") or body.find_all("h2"):
            section, *_ = heading.parents
            rest = [part for part in section.contents if part is not heading]
            inner = _fold(body, heading, rest)
            inner["id"] = section.attrs.pop("id")  # so that links open it
    context["body"] = str(body)


def _fold(body: Any, summary: Any, parts: list[Any]) -> Any:
    """Put parts under a summary that opens them; return what holds them."""
    details, inner = body.new_tag("details", **{"class": "folded"}), body.new_tag("div")
    line = body.new_tag("summary")
    (summary if summary.parent is not None else parts[0]).insert_before(details)
    line.append(summary)
    details.extend([line, inner])
    inner.extend(parts)
    return inner


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("autodoc-process-docstring", escape, priority=100)
    app.connect("autodoc-process-signature", shorten)
    app.connect("html-page-context", fold)
    app.add_directive("run-files", RunFiles)
    app.add_directive("names", Names)
    return {"parallel_read_safe": True}
