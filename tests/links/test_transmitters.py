"""Transmitters, and modules that place them."""

import pytest
import torch

from invertwin.errors import InputError
from invertwin.links import AntennaMount, TransmitterPosition, Transmitters
from scenes import float64

TWO = Transmitters(float64([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]), power_dbm=float64([0.0, 10.0]))


def test_one_place_is_one_transmitter():
    assert Transmitters(float64([1.0, 2.0, 3.0])).positions.shape == (1, 3)
    torch.testing.assert_close(TWO.powers, float64([1.0, 10.0]))


def test_frames_are_transmitters():
    some = TWO.frames([1])
    assert some.positions.tolist() == [[1.0, 2.0, 3.0]]
    assert some.powers.tolist() == [10.0]
    turns = AntennaMount().rotations.expand(2, 3, 3) * float64([1.0, 1.0])[:, None, None]
    turned = Transmitters(TWO.positions, AntennaMount(rotations=turns))
    assert turned.frames([0]).mount.rotations.shape == (1, 3, 3)


@pytest.mark.parametrize(
    ("positions", "power", "text"),
    [
        ([[1.0, 2.0]], 0.0, "positions of transmitters"),
        (torch.zeros(0, 3), 0.0, "at least one row of positions of transmitters .*, got none"),
        ([1.0, 2.0, 3.0], float64([1.0, 2.0]), "powers of transmitters"),
        ([1.0, float("nan"), 3.0], 0.0, "finite positions"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_wrong_transmitters_are_refused(positions, power, text):
    with pytest.raises(InputError, match=text):
        Transmitters(positions, power_dbm=power)


def test_a_module_places_one_of_them():
    module = TransmitterPosition([5.0, 6.0, 7.0], axes="xy", number=1)
    found = module(TWO)
    assert found.positions.tolist() == [[0.0, 0.0, 0.0], [5.0, 6.0, 7.0]]
    found.positions.sum().backward()
    assert module.raw_position.grad is not None
    assert module.raw_position.grad.tolist() == [1.0, 1.0, 0.0]
    assert [c.name for c in module.coordinates()] == ["transmitter.x", "transmitter.y"]
    assert module.at_bounds() == []


def test_a_box_holds_it():
    low, high = [0.0, 0.0, 0.0], [4.0, 2.0, 3.0]
    module = TransmitterPosition([1.0, 1.0, 1.0], low, high)
    torch.testing.assert_close(module.position.detach(), float64([1.0, 1.0, 1.0]))
    with torch.no_grad():
        module.raw_position[1] = 40.0
    torch.testing.assert_close(module.position.detach(), float64([1.0, 2.0, 1.0]))
    (slope,) = torch.autograd.grad(module.position[1], module.raw_position)
    assert slope.tolist() == [0.0, 1.0, 0.0]  # it may come back
    assert module.at_bounds() == ["transmitter.y"]


@pytest.mark.parametrize(
    ("box", "text"),
    [
        (([0.0, 0.0, 0.0], None), "both corners"),
        (([2.0, 0.0, 0.0], [4.0, 2.0, 3.0]), "inside the box"),
    ],
)
def test_a_wrong_box_is_refused(box, text):
    with pytest.raises(InputError, match=text):
        TransmitterPosition([1.0, 1.0, 1.0], *box)
