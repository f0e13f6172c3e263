"""Meshes accept what rays can hit and refuse what they cannot."""

import numpy as np
import pytest
import torch

from invertwin.errors import InputError
from invertwin.scene import Mesh, plate

TRIANGLE = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]], dtype=torch.float64)
FACE = torch.tensor([[0, 1, 2]])


@pytest.mark.usefixtures("unchecked")
def test_converts_arrays_and_keeps_gradients():
    vertices = TRIANGLE.to(torch.float32).requires_grad_()
    mesh = Mesh(vertices, np.array([[0, 1, 2]], dtype=np.uint32))  # pyright: ignore[reportArgumentType]
    torch.testing.assert_close(mesh.vertices.detach(), TRIANGLE, rtol=0, atol=0)
    torch.testing.assert_close(mesh.faces, FACE, rtol=0, atol=0)
    weights = torch.arange(9.0).reshape(3, 3)
    (weights * mesh.vertices).sum().backward()
    assert vertices.grad is not None
    assert torch.equal(vertices.grad, weights)


def test_center_is_the_middle_of_the_bounding_box():
    assert torch.equal(
        Mesh(TRIANGLE, FACE).center, torch.tensor([0.5, 1.0, 0.0], dtype=torch.float64)
    )


def test_area_is_that_of_all_triangles():
    assert plate(2.0, 3.0).area == pytest.approx(6.0)
    bent = Mesh(torch.eye(3, dtype=torch.float64, requires_grad=True), torch.tensor([[0, 1, 2]]))
    assert bent.area == pytest.approx(3**0.5 / 2)


@pytest.mark.parametrize(
    "faces",
    [
        pytest.param([[0, 1, 1]], id="zero area"),
        pytest.param([[0, 1, 2], [1, 0, 3], [0, 1, 4]], id="three faces at one edge"),
        pytest.param([[0, 1, 2], [0, 1, 2]], id="the same face twice"),
    ],
)
def test_degenerate_meshes_are_accepted(faces):
    vertices = torch.cat([TRIANGLE, TRIANGLE[:2] + 1.0])
    mesh = Mesh(vertices, torch.tensor(faces))
    assert torch.equal(mesh.vertices, vertices)
    assert mesh.faces.tolist() == faces


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (TRIANGLE[:, :2], FACE, r"shape \[any, 3\], got shape \[3, 2\]"),
        (TRIANGLE * torch.nan, FACE, "got 9 NaN, infinite or above 1e.09 of 9"),
        (TRIANGLE / 0, FACE, "got 9 NaN, infinite or above 1e.09 of 9"),
        ("abc", FACE, "expected mesh vertices as numbers"),
        (torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int64), "mesh with triangles"),
        (TRIANGLE, torch.zeros(0, 3, dtype=torch.int64), "mesh with triangles"),
        (TRIANGLE, [], "mesh with triangles"),
        (TRIANGLE, [[0, 1]], r"faces of shape \[any, 3\], got \[1, 2\]"),
        (TRIANGLE, [[0.0, 1.0, 2.0]], "integers .* got torch.float32"),
        (TRIANGLE, [[0, 1, 3]], r"face indices in \[0, 2\], got \[0, 3\]"),
        (TRIANGLE, [[-1, 1, 2]], r"face indices in \[0, 2\], got \[-1, 2\]"),
        (TRIANGLE, "abc", "expected mesh faces as integers"),
    ],
)
def test_bad_meshes_are_refused_in_one_line(vertices, faces, message):
    with pytest.raises(InputError, match=message) as caught:
        Mesh(vertices, faces)
    assert "\n" not in str(caught.value)
    assert "; " in str(caught.value)


def test_nan_times_zero_is_counted_per_number():
    vertices = TRIANGLE.clone()
    vertices[1, 2] = torch.nan
    with pytest.raises(InputError, match=r"got 1 NaN, infinite or above 1e.09 of 9"):
        Mesh(vertices, FACE)
