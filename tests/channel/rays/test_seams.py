"""Meshes as files and programs have them: repeated corners, T-junctions, slivers, panels."""

import math
import warnings

import numpy as np
import pytest
import torch
from torch.autograd import forward_ad

from invertwin.channel.rays.rigid_groups import find_rigid_groups
from invertwin.channel.rays.topology import edge_tables, topology_of
from invertwin.scene import (
    Mesh,
    box,
    merge_meshes,
    mesh_topology,
    plate,
    rotation_from_vector,
    sphere,
)
from invertwin.scene.mesh import concatenate_meshes
from invertwin.scene.mesh_topology import (
    CRACK_TOLERANCE,
    WELD_TOLERANCE,
    close_cracks,
    find_vertices_on_edges,
    separate_groups,
    weld_vertices,
)

HALF = math.pi / 2
TURNS = ((0, 0, 0), (0, 0, 2 * HALF), (0, 0, HALF), (0, 0, -HALF), (0, HALF, 0), (0, -HALF, 0))


def float64(*values):
    return torch.tensor(values, dtype=torch.float64)


def plates_of_a_box(side=0.4):
    """Six plates about the origin whose corners agree to rounding only."""
    parts = []
    for turn in TURNS:
        part = plate(side, side)
        rotation = rotation_from_vector(float64(*turn))
        parts.append(Mesh((part.vertices - float64(side / 2, 0, 0)) @ rotation.T, part.faces))
    return parts


def table(mesh):
    """Number of edges by number of triangles."""
    _, _, faces = edge_tables(
        *close_cracks(mesh.vertices.detach().numpy(), mesh.faces.numpy())[1:3]
    )
    numbers, counts = (faces >= 0).sum(1).unique(return_counts=True)
    return dict(zip(numbers.tolist(), counts.tolist(), strict=True))


def soup(mesh, dtype=torch.float32):
    """Three vertices for each triangle, rounded as STL files round them."""
    corners = mesh.vertices[mesh.faces].reshape(-1, 3).to(dtype).double()
    return Mesh(corners, torch.arange(len(corners)).reshape(-1, 3))


def test_plates_that_agree_to_rounding_are_a_closed_box():
    whole = merge_meshes(plates_of_a_box())
    assert len(whole.vertices.unique(dim=0)) > 8  # not to the last bit
    assert table(whole) == {2: 18}
    assert not topology_of([whole]).open_objects


@pytest.mark.parametrize("shift", [0.0, 100.0])
def test_a_soup_of_single_precision_is_the_mesh(shift):
    ball = sphere(0.3, 3)
    moved = Mesh(ball.vertices + shift, ball.faces)
    assert table(soup(moved)) == table(ball)


def test_a_crack_wider_than_the_tolerance_stays_open():
    one, other = plates_of_a_box()[:2]
    size = float((merge_meshes([one, other]).summary().extent[0]) * math.sqrt(3))
    for share in (0.3, 3.0):
        for tolerance, closed in ((WELD_TOLERANCE, True), (CRACK_TOLERANCE, share < 1)):
            parts = plates_of_a_box()
            aside = share * tolerance * size * float64(1, 0, 0)
            parts[0] = Mesh(parts[0].vertices - aside, parts[0].faces)
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                shape = topology_of([merge_meshes(parts)])
            assert (shape.open_objects == set()) == closed
            named = [str(found.message) for found in caught]
            assert [text.startswith("8 edges of meshes") for text in named] == [True] * (not closed)


def jittered(mesh, width, seed):
    """Three vertices for each triangle, off by half a width."""
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    generator = torch.Generator().manual_seed(seed)
    off = torch.randn(corners.shape, generator=generator, dtype=torch.float64)
    corners = corners + 0.5 * width * torch.nn.functional.normalize(off, dim=1)
    return Mesh(corners, torch.arange(len(corners)).reshape(-1, 3))


@pytest.mark.parametrize("share", [1e-7, 2e-6, 1e-5, 9e-5])
def test_cracks_are_closed_by_moving_their_vertices(share):
    clean = box((0.3, 0.4, 0.5))
    cracked = jittered(clean, share * math.sqrt(0.5), 0)
    shape = topology_of([cracked])
    assert len(shape.edges) == 18
    assert not shape.open_objects
    points = shape.join_vertices([cracked.vertices])
    corners = points[shape.faces]
    places = corners.reshape(-1, 3).unique(dim=0)
    assert len(places) == 8 or share == 1e-7  # below the offset of rays they stay
    distance = torch.cdist(clean.vertices, places).amin(0)
    assert float(distance.max()) <= 0.51 * share * math.sqrt(0.5)
    volume = float((corners[:, 0] * torch.linalg.cross(corners[:, 1], corners[:, 2])).sum() / 6)
    assert volume == pytest.approx(0.06, rel=6 * share)


@pytest.mark.parametrize("gap", [3e-7, 9e-7, 2e-6])
@pytest.mark.parametrize("sign", [-1, 1])
def test_vertices_beside_the_middle_of_an_edge_move_onto_it(gap, sign):
    """Within the weld tolerance they stayed aside, where diffraction saw a wall cross the floor."""
    floor = Mesh(float64([0, 0, 0], [1, 0, 0], [0, 1, 0]), torch.tensor([[0, 1, 2]]))
    low = sign * gap * 2**0.5  # of the diagonal
    wall = Mesh(float64([0.3, 0, low], [0.6, 0, low], [0.3, 0, 0.1]), torch.tensor([[0, 1, 2]]))
    whole = concatenate_meshes([floor, wall])
    shape = topology_of([whole])
    assert shape.join_vertices([whole.vertices])[3:5, 2].abs().max() < 1e-12
    ends = [[0, 3], [3, 4], [1, 4], [0, 2], [1, 2], [3, 5], [4, 5]]
    assert sorted(map(sorted, shape.edges.tolist())) == sorted(ends)
    assert (shape.edge_faces[(shape.edges == torch.tensor([3, 4])).all(1)] >= 0).all()


@pytest.mark.parametrize("gap", [5e-7, 3e-6, 3e-5])
def test_panels_that_divide_each_other_meet_on_one_line(gap):
    """Each shared corner of two panels lies beside the middle of an edge of the others."""

    def panel(left, right, up):
        corners = [[left, 0, 0], [right, 0, 0], [right, 0, 1], [left, 0, 1]]
        vertices = float64(*corners) * float64(1, 1, 1 if up else -1)
        return Mesh(vertices, torch.tensor([[0, 1, 2], [0, 2, 3]]))

    parts = [panel(*p) for p in ((0, 1, 1), (1, 2, 1), (0, 0.6, 0), (0.6, 1.5, 0), (1.5, 2, 0))]
    generator = torch.Generator().manual_seed(2)
    shaken = [
        Mesh(p.vertices + gap * torch.rand(3, generator=generator).double(), p.faces) for p in parts
    ]
    shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    points = [p.vertices + shift for p in shaken]
    shape = topology_of(shaken, points)
    met = ((shape.edge_faces >= 0).sum(1) == 2).sum()
    assert met == 5 + 4 + 3  # diagonals, pieces of the line, sides of neighbours
    moved = shape.join_vertices(points)
    seam = moved[moved[:, 2].abs() < 0.1]
    line = torch.lerp(seam[:1], seam[seam[:, 0].argmax()][None], seam[:, :1] / 2)
    # Copies of a vertex need not move within 1e-7 of the size, which is 2.8 m.
    assert float((seam - line).detach()[:, 1:].abs().max()) < 2.8e-7
    (slope,) = torch.autograd.grad(seam.sum(), shift)
    assert slope.tolist() == pytest.approx([len(seam)] * 3)


def test_derivatives_flow_to_the_vertices_onto_which_others_move():
    cracked = jittered(box(0.4), 1e-5, 1)
    vertices = cracked.vertices.clone().requires_grad_()
    topology_of([cracked]).join_vertices([vertices]).sum().backward()
    assert vertices.grad is not None
    assert float(vertices.grad.sum()) == pytest.approx(3 * 36)
    assert int((vertices.grad[:, 0] > 0).sum()) == 8


def test_a_crack_beside_a_t_junction_is_closed():
    """The lower triangles end 2e-5 of the size below the long side of the upper one."""
    low = -4e-5
    vertices = float64([0, 0, 0], [2, 0, 0], [1, 1, 0], [0.5, low, 0], [1, -1, 0])
    points = torch.cat([vertices, float64([0, low, 0], [2, low, 0])])
    mesh = Mesh(points, torch.tensor([[0, 1, 2], [5, 4, 3], [3, 4, 6]]))
    shape = topology_of([mesh])
    assert ((shape.edge_faces >= 0).sum(1) == 2).sum() == 3
    moved = shape.join_vertices([mesh.vertices])
    assert moved[3].tolist() == pytest.approx([0.5, 0.0, 0.0], abs=1e-12)
    assert moved[:3].equal(points[:3])


def test_thin_bodies_and_sheets_side_by_side_stay_as_they_are():
    thin = box((1.0, 0.8, 2e-5))
    assert dict(table(thin)) == {2: 18}
    sheet = plate(1.0, 0.8)
    pair = concatenate_meshes([sheet, Mesh(sheet.vertices + float64(2e-5, 0, 0), sheet.faces)])
    for mesh in (thin, pair):
        assert topology_of([mesh]).join_vertices([mesh.vertices]).equal(mesh.vertices)
    assert table(pair)[1] == 2 * table(sheet)[1]


def test_an_edge_ends_where_vertices_lie_on_it():
    """A long side of one triangle against two short ones of others: a T-junction."""
    vertices = float64([0, 0, 0], [2, 0, 0], [1, 1, 0], [0.5, 0, 0], [1, -1, 0])
    mesh = Mesh(vertices, torch.tensor([[0, 1, 2], [0, 4, 3], [3, 4, 1]]))
    edges, apexes, faces = edge_tables(*close_cracks(vertices.numpy(), mesh.faces.numpy())[1:3])
    rows = {tuple(edge): k for k, edge in enumerate(edges.tolist())}
    assert (0, 1) not in rows
    for pair, below in (((0, 3), 1), ((1, 3), 2)):
        assert sorted(faces[rows[pair]].tolist()) == [0, below]
        assert 2 in apexes[rows[pair]].tolist()
    assert table(mesh) == {1: 4, 2: 3}


def test_a_divided_edge_has_no_single_neighbour():
    vertices = float64([0, 0, 0], [2, 0, 0], [1, 1, 0], [0.5, 0, 0], [1, -1, 0])
    shape = topology_of([Mesh(vertices, torch.tensor([[0, 1, 2], [0, 4, 3], [3, 4, 1]]))])
    assert shape.face_edges[0].tolist().count(-1) == 1
    assert (shape.face_edges[1:] >= 0).all()
    assert shape.welded_faces.tolist() == [[0, 1, 2], [0, 4, 3], [3, 4, 1]]


def test_slivers_and_repeated_triangles_have_no_sides():
    vertices = float64([0, 0, 0], [2, 0, 0], [1, 1, 0], [1, 1e-9, 0])
    faces = torch.tensor([[0, 1, 2], [0, 1, 3], [2, 0, 1], [1, 0, 2]])
    assert table(Mesh(vertices, faces)) == {1: 3}


def test_boxes_that_touch_along_part_of_an_edge_share_it():
    """A leg at the corner of a seat: the leg's top lies in the seat's lower face."""
    seat = box((0.4, 0.6, 0.05))
    leg = box((0.05, 0.05, 0.4))
    place = float64(0.175, 0.275, -0.225)
    chair = concatenate_meshes([seat, Mesh(leg.vertices + place, leg.faces)])
    numbers = table(chair)
    assert 1 not in numbers
    assert numbers[3] == 2  # the two sides of the corner that both have, and the contact once


def test_doubled_faces_count_once_at_their_edges():
    """Two triangles of a face of a box again, split along the other diagonal."""
    whole = box((0.4, 0.5, 0.3))
    first = next(k for k in range(3) if int(whole.faces[0, k]) not in whole.faces[1])
    ring = [int(whole.faces[0, (first + k) % 3]) for k in range(3)]
    ring.insert(2, next(int(v) for v in whole.faces[1] if int(v) not in ring))
    again = torch.tensor([[ring[0], ring[1], ring[2]], [ring[0], ring[2], ring[3]]])
    doubled = Mesh(whole.vertices, torch.cat([whole.faces, again]))
    assert table(doubled) == {2: 19}  # and the other diagonal
    two = torch.cat([torch.zeros(12), torch.ones(2)]).long()  # of an object of its own
    _, _, faces = edge_tables(
        *close_cracks(doubled.vertices.numpy(), doubled.faces.numpy())[1:3], two.numpy()
    )
    assert ((faces >= 0).sum(1) == 3).sum() == 4


def test_groups_of_vertices_stay_apart():
    points = np.repeat(np.arange(6.0).reshape(2, 3), 2, 0)[[0, 2, 1, 3]]
    faces = np.array([[0, 1, 0], [2, 3, 2]])
    places = separate_groups(points, np.array([0, 0, 1, 1]), faces)
    assert weld_vertices(places).tolist() == [0, 1, 2, 3]
    assert np.linalg.norm(places[1] - places[0]) == pytest.approx(1.0)


@pytest.mark.parametrize("stray", [[], [[8, 8, 8]], [[8, 9, 10]]])
def test_stray_vertices_and_points_do_not_widen_the_tolerance(stray):
    clean = box((0.3, 0.4, 0.5))
    vertices = torch.cat([clean.vertices, torch.full((3, 3), 1e6).double()])
    mesh = Mesh(vertices, torch.cat([clean.faces, torch.tensor(stray).long().reshape(-1, 3)]))
    assert table(mesh) == {2: 18}
    assert mesh.summary().open_edges == 0


def test_meshes_that_share_their_faces_have_vertices_of_their_own():
    clean = box((0.3, 0.4, 0.5))
    more = Mesh(torch.cat([clean.vertices, torch.full((1, 3), 1e6).double()]), clean.faces)
    for mesh in (clean, more):
        places = topology_of([mesh]).join_vertices([mesh.vertices])
        assert len(places) == len(mesh.vertices)
        assert float(places.abs().max()) == pytest.approx(0.25)


def test_mesh_of_points_has_no_edges():
    point = Mesh(torch.rand(3, 3).double(), torch.tensor([[1, 1, 1]]))
    assert table(point) == {}


def panels(pose=None):
    """The faces of a box as six objects."""
    whole = box((0.4, 0.5, 0.3))
    parts = [
        Mesh(whole.vertices[f.unique()], torch.searchsorted(f.unique(), f))
        for f in whole.faces.split(2)
    ]
    points = [part.vertices if pose is None else pose(part.vertices) for part in parts]
    return [part.faces for part in parts], points, parts


def test_panels_at_rest_are_one_surface():
    faces, points, parts = panels()
    assert find_rigid_groups(faces, points).tolist() == [0] * 6
    shape = topology_of(parts, points)
    assert (shape.edge_faces >= 0).all()
    assert shape.edge_faces.shape == (18, 2)
    assert shape.open_objects == set(range(6))  # each by itself is a sheet
    assert topology_of(parts, points) is shape
    apart = topology_of(parts)
    assert ((apart.edge_faces >= 0).sum(1) == 1).sum() == 24


def test_blocks_that_touch_in_a_face_stay_closed():
    one, other = box(0.2), box(0.2)
    points = [one.vertices, other.vertices + float64(0.2, 0, 0)]
    assert find_rigid_groups([one.faces, other.faces], points).tolist() == [0, 0]
    assert topology_of([one, other], points).open_objects == set()


def test_panels_of_several_scenes_are_apart():
    faces, points, _ = panels()
    groups = find_rigid_groups(faces, points, scenes=[0, 0, 0, 1, 1, 1])
    assert groups[0] == 0
    assert set(groups[:3].tolist()).isdisjoint(groups[3:].tolist())


def test_panels_that_move_apart_are_not_one_surface():
    """With respect to one parameter, by either mode; or at rest beside what moves."""
    step = float64(0.1, 0.2, 0.3)
    for mode in ("reverse", "forward"):
        with forward_ad.dual_level():
            shift = torch.zeros((), dtype=torch.float64, requires_grad=mode == "reverse")
            if mode == "forward":
                shift = forward_ad.make_dual(shift, torch.ones_like(shift))
            faces, points, _ = panels()
            together = [own + shift * step for own in points]
            assert find_rigid_groups(faces, together).tolist() == [0] * 6
            halves = [own + shift * step * (1 + (k == 2)) for k, own in enumerate(points)]
            groups = find_rigid_groups(faces, halves).tolist()
            assert [k for k in range(6) if groups.count(groups[k]) == 1] == [2]
            rest = [own if k == 2 else own + shift * step for k, own in enumerate(points)]
            assert find_rigid_groups(faces, rest).tolist() == groups


@pytest.mark.parametrize("share", [1e-7, 1e-5, 4e-5])
@pytest.mark.parametrize("mode", ["reverse", "forward"])
def test_panels_across_cracks_are_one_surface_while_they_turn_together(share, mode):
    """Both sides of a crack turn at different radii; an exact comparison counted both twice."""
    faces, points, parts = panels()
    generator = torch.Generator().manual_seed(5)
    size = float(float64(0.4, 0.5, 0.3).norm())
    points = [
        own + 0.5 * share * size * torch.randn(own.shape, generator=generator).double().sign()
        for own in points
    ]
    with forward_ad.dual_level():
        angle = torch.zeros((), dtype=torch.float64, requires_grad=mode == "reverse")
        if mode == "forward":
            angle = forward_ad.make_dual(angle, torch.ones_like(angle))
        turned = [own @ rotation_from_vector(angle * float64(1, 2, 3)).T for own in points]
        assert find_rigid_groups(faces, turned).tolist() == [0] * 6
        assert (topology_of(parts, turned).edge_faces >= 0).all()
        lid = [own + (k == 2) * angle * float64(0, 0, 0.02) for k, own in enumerate(turned)]
        groups = find_rigid_groups(faces, lid).tolist()
        assert [k for k in range(6) if groups.count(groups[k]) == 1] == [2]


def test_poses_of_their_own_are_several_parameters():
    """One tensor holds all of them, so that the leaves of the graph are the same."""
    shifts = torch.zeros(6, 3, dtype=torch.float64, requires_grad=True)
    faces, points, _ = panels()
    moved = [own + shift for own, shift in zip(points, shifts, strict=True)]
    assert find_rigid_groups(faces, moved).tolist() == list(range(6))


def test_contacts_of_copies_of_a_mesh_are_found_once(monkeypatch):
    """Four bricks in a row share their triangles; they are searched again where one slides."""
    brick, searches = box(0.2), []

    def find(*arguments):
        searches.append(arguments)
        return find_vertices_on_edges(*arguments)

    monkeypatch.setattr(mesh_topology, "find_vertices_on_edges", find)
    points = [brick.vertices + k * float64(0.2, 0, 0) for k in range(4)]
    faces = [brick.faces] * 4
    turn = rotation_from_vector(float64(0.3, 0.2, 0.1))
    slid = [own + (k == 3) * float64(0, 0.5, 0) for k, own in enumerate(points)]
    apart = [own + (k == 3) * float64(0.5, 0, 0) for k, own in enumerate(points)]
    for places, groups, count in (
        (points, [0, 0, 0, 0], 6),  # both ways of three pairs
        (points, [0, 0, 0, 0], 0),
        ([own @ turn.T + 2.0 for own in points], [0, 0, 0, 0], 0),
        (slid, [0, 0, 0, 1], 0),
        (apart, [0, 0, 0, 1], 0),
        ([own + (k > 1) * float64(0, 0.1, 0) for k, own in enumerate(points)], [0, 0, 0, 0], 2),
    ):
        searches.clear()
        assert find_rigid_groups(faces, places).tolist() == groups
        assert len(searches) == count


def test_a_seam_is_found_again_where_objects_slide():
    """The group stays, while its seam is another one."""
    _, points, parts = panels()
    shape = topology_of(parts, points)
    turned = [own @ rotation_from_vector(float64(0.1, 0.2, 0.3)).T + 1.0 for own in points]
    assert topology_of(parts, turned) is shape
    slid = [own + (0.1 if k == 5 else 0.0) * float64(0, 1, 0) for k, own in enumerate(points)]
    other = topology_of(parts, slid)
    assert other is not shape
    assert int((other.edge_faces >= 0).sum()) != int((shape.edge_faces >= 0).sum())


def test_soups_that_share_their_faces_have_seams_of_their_own():
    """The topology of one is kept for another one only while its seams are closed."""
    closed = soup(box(0.4), torch.float64)
    apart = closed.vertices.reshape(-1, 3, 3)
    apart = (apart + 0.05 * apart.mean(1, keepdim=True)).reshape(-1, 3)
    first = topology_of([closed])
    assert not first.open_objects
    assert topology_of([Mesh(2 * closed.vertices, closed.faces)]) is first
    second = topology_of([Mesh(apart, closed.faces)])
    assert second.open_objects == {0}
