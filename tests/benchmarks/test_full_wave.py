"""The benchmark against a full-wave solver: its meshes, its errors, its stored truth."""

import json

import numpy as np
import pytest
import trimesh
from rich.console import Console

from invertwin.channel.rcs.moments import mfie as solved


@pytest.mark.parametrize(("name", "closed"), [("cube", True), ("open_box", False), ("ogive", True)])
def test_meshes_have_no_seams(full_wave, name, closed):
    vertices, faces = full_wave.bodies()[name].shape(0.4)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight == closed
    assert mesh.is_winding_consistent
    assert mesh.volume > 0


def test_errors_count_where_the_truth_is_bright(full_wave):
    truth = np.array([1.0, 0.5, 0.2, 0.01])
    found = truth * np.array([1.0, 10 ** (2 / 20) * np.exp(0.1j), 1j, 9.0])
    errors = full_wave.compare(found, truth)
    assert errors["rms_db"] == pytest.approx(2 / np.sqrt(3))
    assert errors["worst_db"] == pytest.approx(2.0)
    assert errors["phase_deg"] == pytest.approx(np.degrees(0.1))


@pytest.mark.slow
def test_a_dihedral_across_its_crease(full_wave):
    metrics = full_wave.measure(["dihedral"])
    for polarisation in "VH":
        assert metrics["rms_db"][f"dihedral_across_{polarisation}"] < 2.0
        assert metrics["phase_deg"][f"dihedral_across_{polarisation}"] < 20.0
    assert metrics["unsolved"] == []
    json.dumps(metrics)
    console = Console(width=160, record=True)
    console.print(full_wave.table(metrics))
    assert "yes" in console.export_text()


@pytest.mark.slow
def test_a_cube_whose_faces_are_grazed_exactly(full_wave):
    metrics = full_wave.measure(["cube"])
    assert max(metrics["phase_deg"].values()) < 5.0
    for polarisation in "VH":
        assert metrics["rms_db"][f"cube_face_{polarisation}"] < 2.0
        assert metrics["rms_db"][f"cube_oblique_{polarisation}"] < 2.0


def test_an_ogive_whose_currents_are_solved(full_wave):
    metrics = full_wave.measure(["ogive"])
    assert max(metrics["phase_deg"].values()) < 5.0
    assert max(metrics["rms_db"].values()) < 1.0


def test_facets_about_a_tip_are_no_edges(full_wave, monkeypatch):
    """Without solved currents, as of larger bodies."""
    monkeypatch.setattr(solved, "MAX_CELLS", 0)
    metrics = full_wave.measure(["ogive"])
    assert max(metrics["phase_deg"].values()) < 20.0
