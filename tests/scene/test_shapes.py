"""Built-in shapes: sizes, orientation, closedness."""

import math
from collections import Counter

import pytest
import torch

from invertwin.errors import InputError
from invertwin.scene import Mesh, box, cylinder, dihedral, plate, sphere, text, trihedral


def crosses(mesh: Mesh) -> torch.Tensor:
    """Normals times twice the areas."""
    a, b, c = mesh.vertices[mesh.faces].unbind(1)
    return torch.linalg.cross(b - a, c - a)


def area(mesh: Mesh) -> float:
    return float(torch.linalg.vector_norm(crosses(mesh), dim=1).sum() / 2)


def volume(mesh: Mesh) -> float:
    """Positive for closed meshes with outward normals (divergence theorem)."""
    return float((mesh.vertices[mesh.faces[:, 0]] * crosses(mesh)).sum() / 6)


def unmatched_edges(mesh: Mesh) -> int:
    """Directed edges without exactly one opposite: 0 for a closed, consistently turned mesh."""
    edges = Counter(
        (int(face[i]), int(face[(i + 1) % 3])) for face in mesh.faces.tolist() for i in range(3)
    )
    return sum(1 for (a, b), n in edges.items() if n != 1 or edges[b, a] != 1)


def extent(mesh: Mesh) -> list[float]:
    return (mesh.vertices.amax(0) - mesh.vertices.amin(0)).tolist()


def longest_edge(mesh: Mesh) -> float:
    corners = mesh.vertices[mesh.faces]
    return float(torch.linalg.vector_norm(corners - corners.roll(1, 1), dim=-1).max())


@pytest.mark.parametrize("divisions", [1, 4])
def test_plate_faces_the_radar(divisions):
    mesh = plate(2.0, 1.0, divisions)
    assert extent(mesh) == [0.0, 2.0, 1.0]
    assert torch.equal(mesh.center, torch.zeros(3, dtype=torch.float64))
    assert len(mesh.faces) == 2 * divisions**2
    assert area(mesh) == pytest.approx(2.0)
    assert (crosses(mesh)[:, 0] < 0).all()


@pytest.mark.parametrize("divisions", [1, 3])
def test_box_is_closed(divisions):
    mesh = box([1.0, 2.0, 3.0], divisions)
    assert extent(mesh) == [1.0, 2.0, 3.0]
    assert unmatched_edges(mesh) == 0
    assert len(mesh.faces) == 12 * divisions**2
    assert volume(mesh) == pytest.approx(6.0)
    assert volume(box(0.5)) == pytest.approx(0.125)


def test_sphere_converges():
    mesh = sphere(0.15)
    assert unmatched_edges(mesh) == 0
    assert len(mesh.faces) == 5120
    radii = torch.linalg.vector_norm(mesh.vertices, dim=1)
    assert torch.allclose(radii, torch.full_like(radii, 0.15), rtol=1e-14)
    errors = [4 / 3 * math.pi - volume(sphere(1.0, n)) for n in (2, 3)]
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.02)


def test_cylinder_stands_upright():
    mesh = cylinder(0.2, 0.9, 64)
    assert unmatched_edges(mesh) == 0
    assert extent(mesh)[2] == pytest.approx(0.9)
    # That of a prism of 64 sides.
    base = 32 * math.sin(2 * math.pi / 64) * 0.2**2
    assert volume(mesh) == pytest.approx(0.9 * base)
    assert torch.linalg.vector_norm(mesh.vertices[:, :2], dim=1).max() == pytest.approx(0.2)


def test_dihedral_is_a_right_angle_open_to_the_radar():
    mesh = dihedral(0.3)
    assert area(mesh) == pytest.approx(2 * 0.3**2)
    normals = torch.nn.functional.normalize(crosses(mesh), dim=1)
    right, left = normals[:2].mean(0), normals[2:].mean(0)
    assert float(left @ right) == pytest.approx(0.0, abs=1e-12)
    assert left[0] < 0
    assert left.tolist() == pytest.approx((right * torch.tensor([1, -1, 1])).tolist())
    # The fold is the z axis and lies farthest from the radar.
    fold = mesh.vertices[mesh.vertices[:, 1] == 0]
    assert fold[:, 0].tolist() == [0.0, 0.0]
    assert mesh.vertices[:, 0].max() == 0.0


def test_a_dihedral_opens():
    mesh = dihedral(0.3, math.radians(120))
    right, left = (mesh.vertices[i] - mesh.vertices[2] for i in (0, 4))
    assert float(left.norm()) == pytest.approx(0.3)
    assert float(left @ right) / 0.3**2 == pytest.approx(math.cos(math.radians(120)))
    assert left[0] == right[0] < 0


def test_trihedral_returns_to_where_it_came_from():
    mesh = trihedral(0.3)
    assert mesh.vertices[0].tolist() == [0.0, 0.0, 0.0]
    assert mesh.vertices[1:, 0].tolist() == pytest.approx([-0.3 / math.sqrt(3)] * 3)
    assert mesh.vertices[1:].sum(0)[1:].tolist() == pytest.approx([0.0, 0.0], abs=1e-15)
    assert torch.linalg.vector_norm(mesh.vertices[1:], dim=1).tolist() == pytest.approx([0.3] * 3)
    normals = torch.nn.functional.normalize(crosses(mesh), dim=1)
    identity = torch.eye(3, dtype=torch.float64)
    assert torch.allclose(normals @ normals.T, identity, atol=1e-14)
    # All three faces look at the radar, and three mirrors reverse any direction.
    assert normals[:, 0].tolist() == pytest.approx([-1 / math.sqrt(3)] * 3)
    mirrors = identity
    for normal in normals:
        mirrors = (identity - 2 * torch.outer(normal, normal)) @ mirrors
    assert torch.allclose(mirrors, -identity, atol=1e-14)


def test_letter_has_a_hole_and_no_crack():
    mesh = text("A")
    assert unmatched_edges(mesh) == 0
    assert extent(mesh)[::2] == pytest.approx([0.12, 0.6])
    assert mesh.center.tolist() == pytest.approx([0.0] * 3, abs=1e-12)
    assert longest_edge(mesh) <= 0.06 * (1 + 1e-9)
    # Euler characteristic of a closed surface: 2 − 2 × number of holes.
    edges = 3 * len(mesh.faces) // 2
    assert len(mesh.vertices) - edges + len(mesh.faces) == 0
    front = crosses(mesh)[:, 0] < -1e-12
    assert (mesh.vertices[mesh.faces[front]][..., 0] == -0.06).all()
    front_area = -float(crosses(mesh)[front, 0].sum() / 2)
    assert volume(mesh) == pytest.approx(front_area * 0.12)


def test_text_reads_from_the_radar():
    # Left is +y: the vertical bar of an L stands at large y, its foot at small z.
    vertices = text("L").vertices
    top = vertices[vertices[:, 2] > 0.1]
    foot = vertices[vertices[:, 2] < -0.25]
    assert top[:, 1].min() > 0.0 > foot[:, 1].min()


@pytest.mark.parametrize(("string", "characteristic"), [("L", 2), ("B", -2), ("Oi", 4), ("8%", 0)])
def test_any_text_is_closed(string, characteristic):
    mesh = text(string, size=0.3, depth=0.05, max_edge=0.05)
    assert unmatched_edges(mesh) == 0
    assert volume(mesh) > 0
    edges = 3 * len(mesh.faces) // 2
    assert len(mesh.vertices) - edges + len(mesh.faces) == characteristic
    assert longest_edge(mesh) <= 0.05 * (1 + 1e-9)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: plate(0.0, 1.0), r"plate width \[m\] in \(0, inf\), got 0"),
        (lambda: plate(1.0, math.nan), "plate height"),
        (lambda: plate(1.0, 1.0, 0), r"divisions as an integer in \[1, 100000000\], got 0"),
        (lambda: box(-1.0), "box size"),
        (lambda: box([1.0, 2.0]), r"box size as numbers of shape \[3\]"),
        (lambda: box([1.0, 2.0, 0.0]), "box size"),
        (lambda: sphere(math.inf), "sphere radius"),
        (lambda: sphere(1.0, -1), "subdivisions"),
        (lambda: dihedral(-0.1), "dihedral edge"),
        (lambda: dihedral(0.1, 4.0), "opening"),
        (lambda: trihedral(0.0), "trihedral edge"),
        (lambda: text("  "), "one line of visible text"),
        (lambda: text(""), "one line of visible text"),
        (lambda: text("a\nb"), "one line of visible text"),
        (lambda: text("A\u5b57"), "characters of the font DejaVu Sans, got .* with \u5b57"),
        (lambda: text("A", size=0.0), "text size"),
        (lambda: text("A", depth=0.0), "text depth"),
        (lambda: text("A", max_edge=0.0), "longest edge"),
    ],
)
def test_bad_sizes_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
