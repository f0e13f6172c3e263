"""New triangles: even, on the same surface, closed where it was; distances with the right sign."""

import pytest
import torch

from invertwin.errors import InputError
from invertwin.inversion import compare_shapes
from invertwin.inversion.metrics import is_watertight
from invertwin.scene import Mesh, box, plate, signed_distance, sphere, text
from invertwin.scene.remeshing import closest_points, remesh
from scenes import float64


def lengths(mesh: Mesh) -> torch.Tensor:
    corners = mesh.vertices[mesh.faces]
    return (corners - corners.roll(1, dims=1)).norm(dim=2).flatten()


def euler(mesh: Mesh) -> int:
    """Euler number of a closed mesh: 2 for a ball, 0 with one hole through it."""
    return len(mesh.vertices) - len(mesh.faces) // 2


def volume(mesh: Mesh) -> float:
    return float(torch.linalg.det(mesh.vertices[mesh.faces]).sum()) / 6


def area(mesh: Mesh) -> float:
    a, b, c = mesh.vertices[mesh.faces].unbind(1)
    return 0.5 * float(torch.linalg.cross(b - a, c - a).norm(dim=1).sum())


@pytest.mark.parametrize(
    ("mesh", "edge"),
    [
        (sphere(0.2, 3), 0.02),
        (sphere(0.2, 3), 0.05),
        (text("T", 0.5), 0.03),
        (text("A", 0.6), 0.03),
        (box([0.4, 0.3, 0.2]), 0.04),
    ],
    ids=["finer", "coarser", "letter", "letter with a hole", "box"],
)
def test_edges_are_even_and_the_surface_stays(mesh, edge):
    found = remesh(mesh, edge)
    assert is_watertight(found)
    assert euler(found) == euler(mesh)
    assert float(lengths(found).mean()) == pytest.approx(edge, rel=0.1)
    assert float(lengths(found).max()) < 1.6 * edge
    assert float(lengths(found).min()) > 0.4 * edge
    assert volume(found) == pytest.approx(volume(mesh), rel=0.05)
    assert compare_shapes(found, mesh, count=3000, thresholds=[0.02]).fscore[0.02] > 0.99


def test_a_stretched_mesh_gets_even_again():
    ball = sphere(0.2, 3)
    long = Mesh(ball.vertices * float64([3.0, 1.0, 0.5]), ball.faces)
    found = remesh(long, 0.03)
    assert float(lengths(long).max() / lengths(long).min()) > 4
    assert float(lengths(found).std() / lengths(found).mean()) < 0.2
    assert volume(found) == pytest.approx(volume(long), rel=0.02)


def test_borders_stay():
    found = remesh(plate(0.5, 0.4, divisions=2), 0.04)
    assert area(found) == pytest.approx(0.2, rel=1e-9)
    assert float(lengths(found).max()) < 0.07
    assert float(found.vertices[:, 0].abs().max()) < 1e-12


def test_derivatives_end_and_the_mesh_given_is_not_touched():
    ball = sphere(0.2, 2)
    places = ball.vertices.clone().requires_grad_()
    found = remesh(Mesh(places, ball.faces), 0.05)
    assert not found.vertices.requires_grad
    assert torch.equal(places.detach(), ball.vertices)


@pytest.mark.parametrize("edge", [0.0, -1.0, float("nan")])
def test_a_length_that_is_none(edge):
    with pytest.raises(InputError, match="edge length"):
        remesh(sphere(0.2, 1), edge)


@pytest.mark.parametrize("face", [[0, 0, 1], [0, 1, 2]])
def test_a_surface_without_area(face):
    line = Mesh(float64([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]]), torch.tensor([face]))
    with pytest.raises(InputError, match="expected a surface with area"):
        remesh(line, 0.05)


def test_no_points_have_no_distances():
    assert signed_distance(sphere(0.2, 1), float64([]).reshape(0, 3)).shape == (0,)


def some_points() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return 0.8 * torch.rand(3000, 3, generator=generator, dtype=torch.float64) - 0.4


def test_distance_to_a_box():
    points, half = some_points(), float64([0.2, 0.15, 0.1])
    beyond = points.abs() - half
    truth = beyond.clamp_min(0).norm(dim=1) + beyond.amax(1).clamp_max(0)
    found = signed_distance(box([0.4, 0.3, 0.2]), points)
    assert float((found - truth).abs().max()) < 1e-5


def test_overlapping_parts_are_their_union():
    """Two balls in each other, one mesh: what is in both is no hole."""
    ball, shift = sphere(0.15, 3), float64([0.1, 0.0, 0.0])
    both = Mesh(
        torch.cat([ball.vertices - shift, ball.vertices + shift]),
        torch.cat([ball.faces, ball.faces + len(ball.vertices)]),
    )
    points = some_points()
    nearest = torch.stack([(points - shift).norm(dim=1), (points + shift).norm(dim=1)]).amin(0)
    clear = (nearest - 0.15).abs() > 0.005  # a ball of triangles is a little smaller
    found = signed_distance(both, points)
    assert torch.equal(found[clear] < 0, nearest[clear] < 0.15)


def test_the_hole_of_a_letter_is_outside():
    letter = text("A", 0.6)
    share = float((signed_distance(letter, some_points()) < 0).double().mean())
    assert share * 0.8**3 == pytest.approx(volume(letter), rel=0.15)


def test_closest_points_are_on_the_surface():
    points = some_points().numpy()
    found = torch.from_numpy(closest_points(sphere(0.2, 4), points))
    assert float((found.norm(dim=1) - 0.2).abs().max()) < 1e-3
    cosine = (found * torch.from_numpy(points)).sum(1) / (
        found.norm(dim=1) * torch.from_numpy(points).norm(dim=1)
    )
    assert float(cosine[torch.from_numpy(points).norm(dim=1) > 0.05].min()) > 0.99
