"""Jones vectors of arrays: names, elements, leakage, tables, and what is refused."""

import math

import pytest
import torch

from invertwin.errors import InputError
from invertwin.radar.boards import Mounting, board
from invertwin.scene import JonesTable, linear_array
from invertwin.scene.polarisation import Polarisation, jones_basis, orthogonal_vectors
from scenes import float64

RIGHT = torch.tensor([1, 1j], dtype=torch.complex128) / math.sqrt(2)


def test_names():
    assert torch.allclose(linear_array(2, 1.0).jones.vectors, jones_basis("V")[:, 0])
    circular = linear_array(2, 1.0, polarisation="circular").jones
    assert torch.allclose(circular.vectors, RIGHT.expand(2, 2))
    assert circular.mixtures.shape == (2, 1)


def test_the_second_vector_is_orthogonal():
    for polarisation in ("V", "circular", [0.3, -2.0], [1, 2j]):
        basis = jones_basis(polarisation)
        assert torch.allclose(basis.mH @ basis, torch.eye(2, dtype=torch.complex128))


def test_leakage_mixes_and_keeps_the_gain():
    jones = linear_array(3, 1.0, polarisation="H", leakage=[0.0, 0.1, -0.2]).jones
    wanted, other = jones_basis("H").T
    for vector, leak in zip(jones.vectors, (0.0, 0.1, -0.2), strict=True):
        assert float(vector.norm()) == pytest.approx(1)
        assert complex((other.conj() * vector).sum() / (wanted.conj() * vector).sum()) == (
            pytest.approx(leak)
        )
    alike = linear_array(3, 1.0, leakage=0.1).jones
    assert alike.mixtures.shape == (3, 1)
    assert torch.allclose(alike.vectors[2], torch.tensor([1, 0.1]).to(alike.vectors) / 1.01**0.5)


def test_elements_of_their_own():
    jones = linear_array(2, 1.0, polarisation=[[2.0, 0.0], [0.0, 1.0]]).jones
    assert torch.equal(jones.vectors, torch.eye(2, dtype=torch.complex128))
    assert torch.equal(jones.mean, torch.tensor([0.5, 0.5], dtype=torch.complex128))


def test_a_table_is_bilinear_and_periodic():
    vectors = torch.zeros(2, 2, 2, dtype=torch.complex128)
    vectors[:, 0, 0] = vectors[:, 1, 1] = 3.0
    table = JonesTable(float64([0.0, math.pi]), float64([0.0, math.pi]), vectors)
    directions = float64([[0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    half = math.sqrt(0.5)
    expected = torch.tensor([[1, 0], [0, 1], [half, half], [half, half]])
    assert torch.allclose(table.vector(directions).real, expected.double())
    both = Polarisation.from_jones(table, 0.5, 1).evaluate(directions)
    assert torch.allclose(both[:, 1], orthogonal_vectors(both[:, 0]))
    ahead = float64([[1.0, 0.0, 0.0], [0.9, 0.1, 0.2]]).requires_grad_()
    (slope,) = torch.autograd.grad(table.vector(ahead).real.sum(), ahead)
    assert bool(torch.isfinite(slope).all())


def test_boards_have_one():
    assert torch.equal(board("xWR1642").arrays()[0].jones.vectors[0], jones_basis("V")[:, 0])
    mounted = Mounting("xWR1642", polarisation="circular", leakage=0.1).arrays()
    alone = linear_array(1, 1.0, polarisation="circular", leakage=0.1).jones
    assert all(array.jones.equals(alone) for array in mounted)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"polarisation": "X"}, "expected a polarisation as V, H, circular or two"),
        ({"polarisation": [0.0, 0.0]}, "give two, not both zero"),
        ({"polarisation": [[1.0, 0.0]] * 3}, "expected one Jones vector or 2, got 3"),
        ({"leakage": [0.1, 0.2, 0.3]}, "expected one finite leakage or 2"),
        ({"leakage": math.nan}, "expected one finite leakage or 2"),
        ({"leakage": "much"}, "expected leakage as numbers"),
    ],
)
def test_refused(values, said):
    with pytest.raises(InputError, match=said):
        linear_array(2, 1.0, **values)


@pytest.mark.parametrize(
    ("theta", "phi", "length", "said"),
    [
        ([0.1, 1.0], [0.0], 1.0, "theta from 0"),
        ([0.0, 1.0], [0.0, 7.0], 1.0, "less than 2 pi"),
        ([0.0, 1.0], [0.0], 0.0, "Jones vectors of some length"),
    ],
)
def test_refused_tables(theta, phi, length, said):
    vectors = length * torch.ones(2, len(phi), 2, dtype=torch.complex128)
    with pytest.raises(InputError, match=said):
        JonesTable(float64(theta), float64(phi), vectors)
