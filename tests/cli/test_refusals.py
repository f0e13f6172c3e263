"""Refusals of the command line and of recordings: every text is used, and filled completely."""

import ast
from pathlib import Path
from string import Formatter
from types import ModuleType

import pytest

import invertwin.capture
import invertwin.cli
from invertwin.cli.refusals import refusal, refusal_text
from invertwin.constants import read_table

_FUNCTIONS = (refusal.__name__, refusal_text.__name__)


def _count_places(text: str) -> int:
    """Number of values that a text leaves open."""
    fields = [field for _, field, _, _ in Formatter().parse(text) if field is not None]
    numbered = {field.split(".")[0] for field in fields if field}
    return len(numbered) if numbered else len(fields)


def _used_values(package: ModuleType) -> dict[str, int]:
    """Number of values with which the modules fill texts, by their names."""
    used: dict[str, int] = {}
    for file in Path(str(package.__file__)).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) in _FUNCTIONS:
                name, *values = node.args
                if isinstance(name, ast.Constant):
                    used[name.value] = len(values)
    return used


@pytest.mark.parametrize("package", [invertwin.cli, invertwin.capture])
def test_every_text_is_used_and_filled(package):
    table = read_table(package.__name__, "refusals.toml")
    texts = {f"{part}.{key}": text for part, rows in table.items() for key, text in rows.items()}
    assert _used_values(package) == {name: _count_places(text) for name, text in texts.items()}


def test_a_refusal_has_its_text_and_its_key():
    error = refusal("rcs.unknown_part", "body, wheels", "door", at="part")
    assert str(error) == "expected a part (body, wheels), got door; choose one"
    assert error.at == "part"
