"""Winding of closed bodies: outwards, whatever a file says."""

import numpy as np
import pytest
import torch

from invertwin.channel.rays.topology import topology_of
from invertwin.scene import Mesh, box, merge_meshes, sphere
from invertwin.scene.mesh_topology import (
    WELD_TOLERANCE,
    find_inward_faces,
    sort_rows,
    weld_vertices,
)


def volume(mesh):
    """Signed volume of the mesh as rays meet it."""
    a, b, c = mesh.vertices[topology_of([mesh]).faces].unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum() / 6)


def scrambled(mesh, seed):
    """Each triangle wound one way or the other."""
    generator = torch.Generator().manual_seed(seed)
    flipped = torch.rand(len(mesh.faces), generator=generator) < 0.5
    return Mesh(mesh.vertices, torch.where(flipped[:, None], mesh.faces.flip(1), mesh.faces))


def hollow(turn):
    inner = sphere(0.1, 2)
    faces = inner.faces.flip(1) if turn else inner.faces
    return merge_meshes([sphere(0.3, 2), Mesh(inner.vertices, faces)])


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_closed_bodies_have_their_volume(seed):
    for mesh in (box((0.4, 0.5, 0.3)), sphere(0.2, 2)):
        inside_out = Mesh(mesh.vertices + 1.0, mesh.faces.flip(1))
        for other in (mesh, inside_out, scrambled(mesh, seed), scrambled(inside_out, seed)):
            assert volume(other) == pytest.approx(volume(mesh))


def test_a_cavity_keeps_its_normals_and_gets_them_where_windings_are_mixed():
    shell = hollow(turn=True)
    expected = volume(sphere(0.3, 2)) - volume(sphere(0.1, 2))
    assert volume(shell) == pytest.approx(expected)
    assert volume(Mesh(shell.vertices, shell.faces.flip(1))) == pytest.approx(expected)
    assert volume(scrambled(shell, 4)) == pytest.approx(expected)
    # Wound outwards by its author, the inner ball is a body in a body.
    assert volume(hollow(turn=False)) > expected


def test_what_is_right_stays():
    mesh = sphere(0.2, 2)
    assert not find_inward_faces(mesh.faces.numpy(), mesh.vertices.numpy()).any()
    assert topology_of([mesh]).faces.equal(mesh.faces)


def test_an_open_mesh_stays():
    mesh = box(0.3)
    lid = Mesh(mesh.vertices, mesh.faces[2:].flip(1))
    assert topology_of([lid]).faces.equal(lid.faces)
    assert np.isfinite(volume(lid))


@pytest.mark.parametrize("count", [40, 100_000], ids=["counted", "compared"])
def test_rows_are_sorted_stably(count):
    columns = np.random.default_rng(1).integers(40, size=(3, 500))
    columns[:, 250:] = columns[:, :250]
    order, start = sort_rows(*columns, count=count)
    assert order.tolist() == np.lexsort(columns[::-1]).tolist()
    kinds, first = np.unique(columns, axis=1, return_index=True)
    assert order[start].tolist() == first.tolist()
    assert columns[:, order[start]].tolist() == kinds.tolist()


def test_vertices_are_welded_to_the_first_of_their_chain():
    """Copies on a lattice, equal or off by up to half the tolerance, and a chain of four."""
    generator = np.random.default_rng(2)
    axis = np.linspace(0.0, 1.0, 8)
    sites = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)
    number = generator.permutation(np.repeat(np.arange(len(sites)), 3))
    away = generator.normal(size=(len(number), 3))
    away *= 0.5 * WELD_TOLERANCE / np.linalg.norm(away, axis=1)[:, None]
    places = sites[number] + away * generator.integers(2, size=(len(number), 1))
    chain = np.array([[0.05 + 0.9 * k * WELD_TOLERANCE, 0.05, 0.05] for k in (2, 0, 3, 1)])
    _, first = np.unique(number, return_index=True)
    welded = weld_vertices(np.concatenate([places, chain]))
    assert welded[:-4].tolist() == first[number].tolist()
    assert welded[-4:].tolist() == [len(number)] * 4
