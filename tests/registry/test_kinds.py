"""What becomes of a constructor: keys, defaults, limits, meanings, and the way back."""

import math
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import pytest
import torch
from annotated_types import Le
from jaxtyping import Float64
from torch import Tensor

from invertwin.cli.run_file import require_section, to_toml, validate_run
from invertwin.cli.schema.keys import json_schema
from invertwin.cli.schema.recordings import build_chirp_capture
from invertwin.errors import InputError
from invertwin.limits import Angle, Axes, Positive
from invertwin.registry.kinds import registry
from invertwin.scene import Mesh, box

REPOSITORY = Path(__file__).parents[2]


@dataclass(frozen=True)
class Lens:
    """Bends waves.

    Attributes:
        radius: m.
    """

    radius: Positive


def made(
    mesh: Mesh,
    size: tuple[Positive, Positive],
    tilt: Angle = math.pi / 2,
    places: Float64[Tensor, "n 3"] | None = None,
    axes: Axes = "xz",
    kind_of: Literal["a", "b"] = "a",
    lens: Lens | None = None,
    share: Annotated[float, Le(0.5)] = 0.25,
) -> dict:
    """Something made of everything.

    Args:
        size: m, along
            x, y.
        tilt: of its axis.
    """
    return dict(locals())


TABLE = registry.constructor_table(made, "Made")


def test_keys_defaults_and_meanings_come_from_the_signature_and_the_docstring():
    fields = TABLE.model_fields
    assert list(fields) == ["size", "tilt_deg", "places", "axes", "kind_of", "lens", "share"]
    assert fields["size"].description == "m, along x, y"
    assert fields["size"].is_required()
    assert [fields[k].default for k in ("tilt_deg", "axes", "share")] == [90.0, ["x", "z"], 0.25]


def test_the_constructor_gets_the_librarys_values():
    table = TABLE.model_validate(
        {"size": [1.0, 2.0], "tilt_deg": 180, "places": [[0, 1, 2]], "lens": {"radius": 0.5}}
    )
    mesh = box(1.0)
    found = table.build({Mesh: mesh})
    assert found["mesh"] is mesh
    assert found["size"] == (1.0, 2.0)
    assert found["tilt"] == math.pi
    assert found["axes"] == "xz"
    assert found["lens"] == Lens(0.5)
    assert torch.equal(found["places"], torch.tensor([[0.0, 1.0, 2.0]], dtype=torch.float64))


@pytest.mark.parametrize(
    "change",
    [
        {"size": [1.0]},
        {"size": [1.0, -1.0]},
        {"places": [[0.0, 1.0]]},
        {"axes": ["w"]},
        {"kind_of": "c"},
        {"lens": {"radius": 0.0}},
        {"share": 0.6},
        {"mesh": 1},
    ],
)
def test_limits_are_those_of_the_annotations(change):
    with pytest.raises(ValueError):
        TABLE.model_validate({"size": [1.0, 2.0], **change})


def test_names_are_taken_once_and_groups_are_known():
    with pytest.raises(InputError, match="new name of a material, got slab"):
        registry.add("material", "slab", Lens)
    with pytest.raises(InputError, match="expected a group among"):
        registry.add("spice", "salt", Lens)


def test_the_schema_is_as_strict_as_the_reader():
    schema = json_schema()
    assert schema["properties"]["seed"]["exclusiveMaximum"] == 2**31
    assert {"simulate", "reconstruct"} <= set(schema["properties"]["task"]["enum"])
    tables = [found for found in schema["$defs"].values() if found["type"] == "object"]
    assert all(found["additionalProperties"] is False for found in [schema, *tables])


@pytest.mark.parametrize(
    "arguments", [["--help"], ["--version"], ["doctor", "--help"], ["simulate", "bad.toml"]]
)
def test_what_needs_no_torch_does_not_wait_for_it(tmp_path, arguments):
    (tmp_path / "bad.toml").write_text("a = = 3\n")
    code = (
        "import atexit, sys; from invertwin.cli.app import main; "
        "atexit.register(lambda: print({'torch', 'mitsuba'} & set(sys.modules))); main()"
    )
    line = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.rstrip().endswith("set()"), done.stderr


def test_observations_have_sections_of_their_own_and_survive_the_way_to_toml(tmp_path):
    text = (REPOSITORY / "experiments" / "demo.toml").read_text()
    raw = tomllib.loads(text)
    sensor = {name: raw.pop(name) for name in ("radar", "grid", "data")}
    raw["observations"] = {"door": sensor, "corner": {**sensor, "weight": 2.0}}
    run = validate_run(raw, tmp_path / "run.toml")
    assert [table.weight for table in run.observations.values()] == [1.0, 2.0]
    assert run.observations["door"].surrogate is None
    assert require_section(run, "grid", "reconstruct") is None
    assert validate_run(tomllib.loads(to_toml(run)), tmp_path / "run.toml") == run
    del raw["observations"]["corner"]["grid"]
    with pytest.raises(InputError, match=r"expected a section \[grid\]"):
        require_section(validate_run(raw, tmp_path / "run.toml"), "grid", "reconstruct")


def test_data_without_chirps_are_none_for_movers(tmp_path):
    raw: dict = {
        "task": "reconstruct",
        "frame": 2,
        "data": {"kind": "simulated", "points_per_m2": 1.0},
    }
    raw["scene"] = {"box": {"shape": "box", "size": 1.0, "material": {"kind": "rough_conductor"}}}
    with pytest.raises(InputError, match=r"data\.kind: expected data with chirps, got \"simulated"):
        build_chirp_capture(validate_run(raw, tmp_path / "run.toml").data)


def test_a_table_may_be_asked_for_before_anything_else():
    """Modules of kinds build tables of kinds when they are imported, in any order."""
    program = (
        "import invertwin.cli.commands.look; from invertwin.registry.kinds import registry; "
        "print(registry.kind_table('data', 'simulated'))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-500:]
    assert "simulated" in done.stdout.lower()
