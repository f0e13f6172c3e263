"""Materials of run files: what the tables become, and what is wrong with them."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from invertwin.cli.run_file import load_run, to_toml, validate_run
from invertwin.cli.schema import build
from invertwin.cli.schema.keys import key_tables
from invertwin.errors import InputError
from invertwin.inversion.metrics import material_errors
from invertwin.scene import (
    Dielectric,
    Itu,
    Multilayer,
    PerfectConductor,
    RefractingBody,
    RoughConductor,
    RoughDielectric,
    Slab,
    Texture,
)

ROUGHNESS = {
    "scattering": 0.5,
    "rms_slope": 0.2,
    "lambertian": 0.4,
    "directive": 0.6,
    "directive_exponent": 3.0,
    "backscatter_exponent": 6.0,
}


def read(material: dict[str, Any], folder: Path = Path(), **changes):
    wall = {"shape": "plate", "width": 1.0, "height": 2.0, "material": material}
    raw = {"task": "reconstruct", "frame": 2, "scene": {"wall": wall}} | changes
    return validate_run(raw, folder / "run.toml")


def material_of(table: dict[str, Any], folder: Path = Path()) -> Any:
    return build.scene(read(table, folder))["wall"].material


@pytest.mark.parametrize(
    ("table", "kind"),
    [
        ({"kind": "rough_dielectric", "permittivity": 4.0, "diffuse": 0.5}, RoughDielectric),
        ({"kind": "perfect_conductor"}, PerfectConductor),
        ({"kind": "rough_conductor", **ROUGHNESS}, RoughConductor),
        ({"kind": "dielectric", "permittivity": 4.0, "loss_tangent": 0.1}, Dielectric),
        ({"kind": "refracting_body", "permittivity": 4.0, **ROUGHNESS}, RefractingBody),
        ({"kind": "slab", "permittivity": 2.0, "thickness": 0.01, **ROUGHNESS}, Slab),
        ({"kind": "dielectric", "permittivity": 4.0, "permeability": 2.0}, Dielectric),
    ],
)
def test_keys_are_the_names_of_the_library(table, kind):
    found = material_of(table)
    assert type(found) is kind
    for key, value in table.items():
        if key != "kind":
            assert getattr(found, key) == value


def test_names_of_the_itu_table():
    found = material_of({"kind": "slab", "itu": "plasterboard", "thickness": 0.0125})
    assert found == Slab.itu("plasterboard", thickness=0.0125)
    measured = material_of({"kind": "dielectric", "itu": "concrete", "permittivity": 6.0})
    assert measured == Dielectric(6.0, Itu("concrete"))


def test_layers():
    board, air = {"itu": "plasterboard", "thickness": 0.0125}, {"permittivity": 1.0}
    table = {"kind": "multilayer", "layers": [board, air | {"thickness": 0.05}, board]}
    found = material_of(table)
    assert isinstance(found, Multilayer)
    assert [layer.thickness for layer in found.layers] == [0.0125, 0.05, 0.0125]


def test_values_per_triangle_and_angles_in_degrees():
    table = {"kind": "rough_dielectric", "permittivity": [3.0, 4.0], "lobe_width_deg": [10.0, 20.0]}
    found = material_of(table)
    assert found.permittivity.tolist() == [3.0, 4.0]
    assert found.lobe_width.tolist() == pytest.approx([math.radians(10), math.radians(20)])


def test_textures_are_laid_over_the_object(tmp_path):
    np.save(tmp_path / "wall.npy", np.array([[2.0, 3.0], [4.0, 5.0]]))
    table = {"kind": "dielectric", "permittivity": {"image": "wall.npy"}}
    found = material_of(table, tmp_path)
    assert isinstance(found.permittivity, Texture)
    assert found.faces == 2
    assert found.scattering_law(77e9).amplitude.shape == (2, 256)


def test_run_files_with_materials_are_written_and_read_again(tmp_path):
    np.save(tmp_path / "wall.npy", np.ones((2, 2)))
    table = {
        "kind": "multilayer",
        "layers": [{"itu": "glass", "thickness": [0.004, 0.005]}],
        "scattering": {"image": "wall.npy"},
    }
    run = read(table, tmp_path)
    (tmp_path / "run.toml").write_text(to_toml(run))
    assert load_run(tmp_path / "run.toml") == run


@pytest.mark.parametrize(
    ("table", "parts"),
    [
        ({"kind": "dielectric"}, ["scene.wall.material: ", "`permittivity`, or `itu`"]),
        (
            {"kind": "dielectric", "itu": "concret"},
            ["scene.wall.material: ", "did you mean concrete?"],
        ),
        (
            {"kind": "slab", "permittivity": 2.0, "thickness": -0.01},
            ["scene.wall.material.thickness: ", "greater than or equal to 0", "got -0.01"],
        ),
        ({"kind": "slab", "permittivity": 2.0}, ["scene.wall.material.thickness: ", "add the key"]),
        (
            {"kind": "dielectric", "permittivity": 0.5},
            ["scene.wall.material.permittivity: ", "greater than or equal to 1", "got 0.5"],
        ),
        (
            {"kind": "dielectric", "permittivity": [2.0, 0.5]},
            ["scene.wall.material.permittivity[1]: ", "got 0.5"],
        ),
        (
            {"kind": "dielectric", "permittivity": [2.0, 2.0, 3.0]},
            ["scene.wall: ", "mesh's 2 triangles, got 3"],
        ),
        (
            {"kind": "dielectric", "permittivity": "much"},
            ["scene.wall.material.permittivity: ", "number", '"much"'],
        ),
        (
            {"kind": "dielectric", "permittivity": {"image": "none.npy"}},
            ["scene.wall.material.permittivity: ", "a NumPy file"],
        ),
        (
            {"kind": "dielectric", "permittivity": {"imgae": "none.npy"}},
            ["scene.wall.material.permittivity.imgae: ", "did you mean `image`?"],
        ),
        (
            {"kind": "rough_conductor", "scattering": 1.5},
            ["scene.wall.material.scattering: ", "less than or equal to 1"],
        ),
        ({"kind": "multilayer", "layers": []}, ["scene.wall.material.layers: ", "at least 1"]),
        (
            {"kind": "multilayer", "layers": [{"permittivity": 2.0, "thickness": -1.0}]},
            ["scene.wall.material.layers[0].thickness: ", "got -1.0"],
        ),
    ],
)
def test_errors_name_the_key(table, parts):
    with pytest.raises(InputError) as caught:
        build.scene(read(table))
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message


def parameters(table, *values, **more):
    tables = [{"kind": "material", "object": "wall", "values": list(values)} | more]
    run = read(table, parameters=tables)
    scene = build.scene(run)
    (module,) = build.parameters(run.parameters, scene)
    return module(scene)["wall"].material


def test_every_value_can_be_fitted():
    board = {"permittivity": 2.7, "conductivity": 0.1, "loss_tangent": 0.01, "thickness": 0.0125}
    slab = {"kind": "slab", **board, **ROUGHNESS}
    names = [name for name in slab if name != "kind"]
    found = parameters(slab, *names)
    for name in names:
        value = getattr(found, name)
        assert isinstance(value, torch.Tensor)
        assert value.requires_grad
        assert float(value.detach()) == pytest.approx(slab[name], rel=1e-9)


def test_rows_and_layers_can_be_fitted():
    rows = parameters({"kind": "dielectric", "permittivity": [3.0, 4.0]}, "permittivity")
    assert rows.permittivity.tolist() == pytest.approx([3.0, 4.0])
    layers = [{"itu": "wood", "thickness": 0.01}, {"permittivity": 2.0, "thickness": 0.02}]
    stack = parameters({"kind": "multilayer", "layers": layers}, "thickness", layer=1)
    assert float(stack.layers[1].thickness.detach()) == pytest.approx(0.02)


def test_truth_may_be_of_another_material_and_the_error_is_told():
    known = {"kind": "slab", "permittivity": 3.0, "conductivity": 0.1, "thickness": 0.01}
    real = {"kind": "slab", "itu": "plasterboard", "thickness": [0.0125, 0.0125]}
    tables = [{"kind": "material", "object": "wall", "values": ["permittivity", "thickness"]}]
    run = read(known, truth={"wall": {"material": real}}, parameters=tables)
    scene, truth = build.scene(run), build.true_scene(run)
    assert truth["wall"].material.faces == 2
    assert torch.equal(truth["wall"].vertices, scene["wall"].vertices)
    found, true = (whole["wall"].material for whole in (scene, truth))
    errors = material_errors(run.parameters[0].values, found, true, 77e9)
    assert errors == pytest.approx({"permittivity_error": 0.27 / 2.73, "thickness_error": 0.2})
    assert material_errors(["thickness"], true, true, 77e9) == {"thickness_error": 0}
    with pytest.raises(InputError, match=r"truth\.wall\.material: expected a material of ITU"):
        build.true_scene(read(known, truth={"wall": {"material": real | {"itu": "woood"}}}))


@pytest.mark.parametrize(
    ("table", "name", "more", "message"),
    [
        ({"kind": "dielectric", "itu": "wood"}, "permittivity", {}, "give `permittivity` beside"),
        ({"kind": "dielectric", "permittivity": 2.0}, "thickness", {}, "values of Dielectric, got"),
        (
            {"kind": "slab", "permittivity": 2.0, "thickness": 0.1},
            "thickness",
            {"layer": 0},
            "a layer below 0 of Slab, got 0",
        ),
    ],
)
def test_values_that_cannot_be_fitted(table, name, more, message):
    with pytest.raises(InputError, match=message) as caught:
        parameters(table, name, **more)
    assert str(caught.value).startswith("parameters[0].values, material of wall: ")


def test_materials_of_a_scene_file_take_no_images(tmp_path):
    (tmp_path / "room.xml").write_text("<scene version='3.0.0'/>")
    table = {
        "file": "room.xml",
        "material": {"kind": "dielectric", "permittivity": {"image": "x.npy"}},
    }
    run = validate_run({"task": "simulate", "frame": 2, "scene_file": table}, tmp_path / "run.toml")
    with pytest.raises(
        InputError, match=r"scene_file\.material\.permittivity: expected permittivity as a number"
    ):
        build.scene(run)


def test_every_kind_is_listed():
    titles = [table.title for table in key_tables("scene.material")]
    for kind in ("slab", "multilayer", "refracting_body", "dielectric", "rough_conductor"):
        assert any(f'kind = "{kind}"' in title for title in titles)
