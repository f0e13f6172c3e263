"""The public menu, and which code of the documentation uses its names.

The site and the tests read it; neither needs what the other stands on.

Usage: python docs/public_names.py docs/api/scene.md …     (checks the examples of pages)
"""

import ast
import doctest
import importlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import invertwin

REPOSITORY = Path(__file__).resolve().parents[1]
# Rooms that have a page of the reference beside the package itself.
ROOMS = (
    *("scene", "channel", "radar", "links", "camera", "simulation", "signatures", "capture"),
    *("datasets", "models", "inversion", "discovery", "plotting", "viewer"),
)
CELL = re.compile(r"^# %%(.*)\n", re.MULTILINE)
FENCE = re.compile(r"^```(python|pycon)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def menu(room: str) -> set[str]:
    """What a room shows: what its `__init__` imports under its own name, and what it defines.

    Args:
        room: `invertwin` or a module below it, dotted.
    """
    if room == "invertwin":
        return {name for name in invertwin.__all__ if name not in ROOMS} - {"__version__"}
    shown: set[str] = set()
    source = Path(importlib.import_module(room).__file__ or "").read_text()
    for node in ast.parse(source).body:
        if isinstance(node, ast.ImportFrom):
            shown |= {alias.name for alias in node.names if alias.asname == alias.name}
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            shown.add(node.name)
        elif isinstance(node, ast.AnnAssign | ast.Assign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            shown |= {target.id for target in targets if isinstance(target, ast.Name)}
    return {name for name in shown if not name.startswith("_")}


def documented() -> dict[str, list[str]]:
    """Every public name once, by where the reference has it: the package first, then its rooms."""
    top = menu("invertwin")
    pages = {"invertwin": sorted(top)}
    for room in ROOMS:
        pages[f"invertwin.{room}"] = sorted(menu(f"invertwin.{room}") - top)
    return pages


def examples(page: Path) -> list[doctest.Example]:
    """The examples `>>>` of a page, in order."""
    if page.suffix != ".md":
        return []
    parser, text = doctest.DocTestParser(), page.read_text()
    found: list[doctest.Example] = []
    for block in FENCE.finditer(text):
        for example in parser.get_examples(block[2]) if block[1] == "pycon" else ():
            example.lineno += text.count("\n", 0, block.start(2))
            found.append(example)
    return found


def cells(page: Path) -> list[str]:
    """The pieces of code of a page, in order.

    Args:
        page: A Markdown page, or a tutorial in jupytext's percent form.
    """
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".md":
        return [code for kind, code in FENCE.findall(text) if kind == "python"]
    _, *parts = CELL.split(text)
    return [code for kind, code in zip(parts[::2], parts[1::2], strict=True) if not kind.strip()]


def code(page: Path) -> str:
    """All code of a page or a tutorial."""
    return "\n".join([*cells(page), *(example.source for example in examples(page))])


def sources() -> Iterator[Path]:
    """Files with code that the tests or the site run, the most readable first."""
    yield from sorted((REPOSITORY / "docs" / "tutorials").glob("*.py"))
    yield from sorted((REPOSITORY / "docs").glob("*.md"))
    yield from sorted((REPOSITORY / "docs" / "api").glob("*.md"))


def used(text: str) -> set[str]:
    """All names and attributes that a piece of code uses."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Name):
            found.add(node.id)
        elif isinstance(node, ast.Attribute):
            found.add(node.attr)
    return found


def shown(page: Path) -> set[str]:
    """Dotted names of the package that the examples of a page use, not merely import.

    Args:
        page: A Markdown page with examples `>>>`.
    """
    origin: dict[str, str] = {}
    found: set[str] = set()
    for node in ast.walk(ast.parse("\n".join(example.source for example in examples(page)))):
        if isinstance(node, ast.Import):
            origin |= {alias.asname or alias.name: alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            origin |= {
                alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names
            }
        elif isinstance(node, ast.Name | ast.Attribute):
            first, *rest = ast.unparse(node).split(".")
            found.add(".".join([origin.get(first, first), *rest]))
    return found


def uses() -> dict[str, list[Path]]:
    """Name → files whose code uses it."""
    found: dict[str, list[Path]] = {}
    for page in sources():
        for name in used(code(page)):
            found.setdefault(name, []).append(page)
    return found


def failures(page: Path) -> int:
    """How many examples of a page, run in one session, do not give what it says; prints each."""
    session = doctest.DocTest(
        examples(page), {"__name__": "__main__"}, page.name, str(page), 0, None
    )
    return doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(session).failed


if __name__ == "__main__":
    sys.exit(sum(failures(Path(page)) for page in sys.argv[1:]))
