"""The shape of the code stays: every limit of `benchmarks/house.py` holds. Part of `make check`."""

import importlib
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def house():
    """The benchmark as a module, with its measured metrics."""
    folder = str(ROOT / "benchmarks")
    sys.path.insert(0, folder)
    try:
        module = importlib.import_module("house")
        return module, module.measure()
    finally:
        sys.path.remove(folder)


def test_every_limit_of_the_house_holds(house):
    module, metrics = house
    broken = {}
    for key, (sign, limit) in module.REQUIRED.items():
        first, _, last = key.partition(".")
        value = metrics[first][last] if last else metrics[first]
        assert sign == "<="
        if value > module.REACHED.get(key, limit):
            broken[key] = (value, limit, metrics["counted"].get(key, [])[:20])
    assert broken == {}


def test_a_requirement_that_holds_is_not_listed_as_open(house):
    module, metrics = house
    assert [key for key in module.REACHED if metrics[key] <= module.REQUIRED[key][1]] == []
