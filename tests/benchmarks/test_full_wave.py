"""The benchmark against a full-wave solver: its meshes, its errors, its stored truth."""

import json

import numpy as np
import pytest
import torch
import trimesh
from rich.console import Console

from invertwin.channel.rcs.moments import mfie as solved
from invertwin.channel.rcs.moments.solver import Refusal


@pytest.mark.parametrize(
    ("name", "closed"), [("cube", True), ("open_box", False), ("ogive", True), ("wing", True)]
)
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


def test_a_wing_is_even_and_plane(full_wave):
    coarse, fine = (trimesh.Trimesh(*full_wave.wing(step), process=False) for step in (5.0, 1 / 10))
    assert len(coarse.faces) == 20
    # The area of a section is 0.24 times its chord less 0.3.
    assert coarse.volume == pytest.approx(0.24 * 4 * (1.5 - 0.3), rel=1e-12)
    assert fine.volume == pytest.approx(coarse.volume, rel=1e-12)
    assert fine.area == pytest.approx(coarse.area, rel=1e-12)
    assert 0.04 < fine.edges_unique_length.min() < fine.edges_unique_length.max() < 0.17


def test_the_first_cells_of_a_slender_ogive_do_not_conserve_power(full_wave):
    body = full_wave.bodies()["slender_ogive"]
    vertices, faces = map(torch.from_numpy, body.shape(body.coarse))
    nose = body.directions("nose")[:1]
    refused = solved.MFIESolver(vertices[faces], full_wave.UP).solve_scattering(
        2 * np.pi, [(nose, nose)]
    )
    assert isinstance(refused, Refusal)
    assert not refused.by_size


@pytest.mark.slow
@pytest.mark.parametrize("name", ["slender_ogive", "wing"])
def test_slender_and_thin_bodies_are_solved_on_triangles(full_wave, name):
    metrics = full_wave.measure([name])
    assert max(metrics["phase_deg"].values()) < 20.0
    assert max(metrics["rms_db"].values()) < 2.0
    assert metrics["unsolved"] == []


def test_facets_about_a_tip_are_no_edges(full_wave, monkeypatch):
    """Without solved currents, as of larger bodies."""
    monkeypatch.setattr(solved, "MAX_CELLS", 0)
    metrics = full_wave.measure(["ogive"])
    assert max(metrics["phase_deg"].values()) < 20.0
