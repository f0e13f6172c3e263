"""The benchmark scripts as modules."""

import importlib
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest


def script(name: str) -> Any:
    """A fixture: `benchmarks/<name>.py`."""

    @pytest.fixture(name=name)
    def loaded(repository: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
        monkeypatch.syspath_prepend(repository / "benchmarks")
        return importlib.import_module(name)

    return loaded


basin = script("basin")
batch = script("batch")
channels = script("channels")
city = script("city")
crash_safety = script("crash_safety")
dataset = script("dataset")
diffraction = script("diffraction")
edges = script("edges")
fine_meshes = script("fine_meshes")
first_hour = script("first_hour")
full_wave = script("full_wave")
gpu = script("gpu")
growth = script("growth")
house = script("house")
look = script("look")
many_objects = script("many_objects")
many_starts = script("many_starts")
measured_rooms = script("measured_rooms")
meshes = script("meshes")
motion = script("motion")
multibounce = script("multibounce")
newcomer = script("newcomer")
panel_annealing = script("panel_annealing")
rcs_speed = script("rcs_speed")
report = script("report")
results = script("results")
rooms = script("rooms")
shapes = script("shapes")
siege = script("siege")
signals = script("signals")
signatures = script("signatures")
solids = script("solids")
starting = script("starting")
steps = script("steps")
test_time = script("test_time")
threads = script("threads")
throughput = script("throughput")
twin_cost = script("twin_cost")
verdicts = script("verdicts")
