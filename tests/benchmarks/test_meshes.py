"""The benchmark of meshes in small: the meshes of a box are the box, those of bodies the bodies."""

import json

import pytest
import torch
from rich.console import Console

from invertwin.scene.mesh import concatenate_meshes
from invertwin.scene.mesh_defects import find_defects


def test_all_meshes_have_the_area_and_the_extent_of_the_box(meshes):
    (clean,), *_ = meshes.meshes().values()
    for name, parts in meshes.meshes().items():
        whole = concatenate_meshes(parts)
        off = 3e-5 if name in ("jittered", "shaken panels") else 1e-6
        if name not in ("raw", "doubled"):  # which have surfaces twice
            assert whole.area == pytest.approx(clean.area, rel=off)
        assert whole.summary().extent == pytest.approx(clean.summary().extent, rel=off)
    assert len(meshes.meshes()) == 15


def test_the_other_diagonals_are_others(meshes):
    def edges(mesh):
        pairs = torch.cat([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
        return {tuple(pair) for pair in pairs.sort(1).values.tolist()}

    (clean,), (other,) = (meshes.meshes()[name] for name in ("clean", "diagonals"))
    assert len(edges(clean) & edges(other)) == 12


@pytest.mark.parametrize(("body", "parts", "triangles"), [("chair", 12, 144), ("room", 30, 60)])
def test_bodies_are_their_parts(meshes, body, parts, triangles):
    """The clean surface is built from squares, without the union that reads the file."""
    columns = meshes.body_meshes(body)
    (clean,), (read,), (raw,) = (columns[name] for name in ("clean", "file", "raw"))
    assert len(columns["objects"]) == parts
    assert len(raw.faces) == triangles
    assert read.area == pytest.approx(clean.area, rel=1e-6)
    assert read.summary().extent == pytest.approx(clean.summary().extent, rel=1e-6)
    assert bool(clean.summary().open_edges) == (body == "room")
    assert find_defects(raw).has_overlapping_parts == (body == "chair")


def test_the_file_of_the_car_has_triangles_enough_and_is_closed(meshes):
    columns = meshes.body_meshes("car")
    (clean,), (read,), (raw,) = (columns[name] for name in ("clean", "file", "raw"))
    assert len(raw.faces) > len(read.faces) > 25_000
    assert read.summary().open_edges == 0
    assert read.area == pytest.approx(clean.area, rel=1e-6)
    assert clean.area < raw.area


def test_masks_and_metal_are_those_of_the_clean_mesh(meshes):
    chosen = {name: meshes.MECHANISMS[name] for name in ("rcs, diffraction", "coverage")}
    metrics = meshes.measure(chosen, (), subdivisions=20)
    assert metrics["worst_ratio"] < 0.01
    assert list(metrics["refused"]) == [
        f"rcs, diffraction.{name}" for name in ("finer", "raw", "doubled")
    ]
    assert set(metrics["derivative"]["coverage"]) == set(meshes.meshes()) - {"clean"}
    json.dumps(metrics)
    console = Console(width=160, record=True)
    console.print(meshes.table(metrics))
    assert "worst_ratio" in console.export_text()


def test_a_room_of_panels_is_the_clean_room(meshes, monkeypatch):
    """Panels that stand within others cast no shadow through them."""
    chosen = {name: meshes.BODIES["room"][name] for name in ("power", "masks")}
    monkeypatch.setitem(meshes.BODIES, "room", chosen)
    monkeypatch.setattr(meshes, "SAMPLES", 200_000)
    metrics = meshes.measure({}, ("room",), subdivisions=20)
    assert metrics["worst_ratio"] < 0.01
    assert not metrics["refused"]
    assert set(metrics["derivative"]["power"]) == {f"room {k}" for k in ("file", "raw", "objects")}


@pytest.mark.parametrize(
    ("mechanism", "off"),
    [("coverage", 0.005), ("masks", 0.001), ("depths", 0.001), ("links, diffraction", 1e-6)],
)
def test_a_wall_on_part_of_an_edge_is_the_clean_corner(meshes, mechanism, off):
    """A T-junction that rounding moves by a nanometre, in each value and not only in their sum."""
    columns = meshes.corner_meshes()
    compute = meshes.MECHANISMS[mechanism]
    if mechanism == "coverage":
        compute = meshes.coverage(meshes.METAL, 0, 100, 20_000)
    clean = meshes.evaluate(compute, columns["clean"])
    assert float(clean[1].norm()) > 0
    for name in ("raw", "raw sunk", "objects sunk"):
        for found, exact in zip(meshes.evaluate(compute, columns[name]), clean, strict=True):
            assert float((found - exact).norm() / exact.norm()) < off, name
