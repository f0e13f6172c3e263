"""The benchmark scripts as modules."""

import importlib
from types import ModuleType

import pytest


@pytest.fixture
def basin(repository, monkeypatch) -> ModuleType:
    """`benchmarks/basin.py`."""
    monkeypatch.syspath_prepend(repository / "benchmarks")
    return importlib.import_module("basin")


@pytest.fixture
def throughput(repository, monkeypatch) -> ModuleType:
    """`benchmarks/throughput.py`."""
    monkeypatch.syspath_prepend(repository / "benchmarks")
    return importlib.import_module("throughput")


@pytest.fixture
def signals(repository, monkeypatch) -> ModuleType:
    """`benchmarks/signals.py`."""
    monkeypatch.syspath_prepend(repository / "benchmarks")
    return importlib.import_module("signals")


@pytest.fixture
def edges(repository, monkeypatch) -> ModuleType:
    """`benchmarks/edges.py`."""
    monkeypatch.syspath_prepend(repository / "benchmarks")
    return importlib.import_module("edges")


@pytest.fixture
def multibounce(repository, monkeypatch) -> ModuleType:
    """`benchmarks/multibounce.py`."""
    monkeypatch.syspath_prepend(repository / "benchmarks")
    return importlib.import_module("multibounce")


@pytest.fixture
def shapes(repository, monkeypatch) -> ModuleType:
    """`benchmarks/shapes.py`."""
    monkeypatch.syspath_prepend(repository / "benchmarks")
    return importlib.import_module("shapes")
