"""The benchmark of meshes in small: the meshes of a box are the box."""

import json

import pytest
import torch
from rich.console import Console

from invertwin.scene.mesh import concatenate_meshes


def test_all_meshes_have_the_area_and_the_extent_of_the_box(meshes):
    (clean,), *_ = meshes.meshes().values()
    for parts in meshes.meshes().values():
        whole = concatenate_meshes(parts)
        assert whole.area == pytest.approx(clean.area, rel=1e-6)
        assert whole.summary().extent == pytest.approx(clean.summary().extent, rel=1e-6)
    assert len(meshes.meshes()) == 11


def test_the_other_diagonals_are_others(meshes):
    def edges(mesh):
        pairs = torch.cat([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
        return {tuple(pair) for pair in pairs.sort(1).values.tolist()}

    (clean,), (other,) = (meshes.meshes()[name] for name in ("clean", "diagonals"))
    assert len(edges(clean) & edges(other)) == 12


def test_masks_and_metal_are_those_of_the_clean_mesh(meshes):
    chosen = {name: meshes.MECHANISMS[name] for name in ("rcs, diffraction", "coverage")}
    metrics = meshes.measure(chosen, subdivisions=20)
    assert metrics["worst_ratio"] < 0.01
    assert list(metrics["refused"]) == ["rcs, diffraction.finer"]
    assert set(metrics["derivative"]["coverage"]) == set(meshes.meshes()) - {"clean"}
    json.dumps(metrics)
    console = Console(width=160, record=True)
    console.print(meshes.table(metrics))
    assert "worst_ratio" in console.export_text()
