"""Refusals: every text is used, and filled completely."""

import ast
from pathlib import Path
from string import Formatter

import invertwin
from invertwin.constants import read_table
from invertwin.refusals import refusal, refusal_text

_FUNCTIONS = (refusal.__name__, refusal_text.__name__)


def _count_places(text: str) -> int:
    """Number of values that a text leaves open."""
    fields = [field for _, field, _, _ in Formatter().parse(text) if field is not None]
    numbered = {field.split(".")[0] for field in fields if field}
    return len(numbered) if numbered else len(fields)


def _used_values() -> dict[str, int]:
    """Number of values with which the modules fill texts, by their names."""
    used: dict[str, int] = {}
    for file in Path(invertwin.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) in _FUNCTIONS:
                name, *values = node.args
                if isinstance(name, ast.Constant):
                    used[name.value] = len(values)
    return used


def test_every_text_is_used_and_filled():
    table = read_table("invertwin", "refusals.toml")
    texts = {f"{part}.{key}": text for part, rows in table.items() for key, text in rows.items()}
    assert _used_values() == {name: _count_places(text) for name, text in texts.items()}


def test_a_refusal_has_its_text_and_its_key():
    error = refusal("rcs.unknown_part", "body, wheels", "door", at="part")
    assert str(error) == "expected a part (body, wheels), got door; choose one"
    assert error.at == "part"
