"""Scattered power at receivers: closed forms, shadows that move, what is refused."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.func import jvp

from invertwin.channel import Sampling
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.links import CellSampling, MapPlane, Points, Reception, Terminals, Transmitters
from invertwin.links import scattered as scattered_module
from invertwin.models import ForwardModel, RadioMap, ResponseMap
from invertwin.scene import (
    AntennaArray,
    Cosine,
    Object,
    PerfectConductor,
    RoughConductor,
    Scene,
    box,
    plate,
    rigid,
    rotation_from_vector,
)
from scenes import float64

FREQUENCY = 3.5e9
WAVELENGTH = SPEED_OF_LIGHT / FREQUENCY
CHALK = RoughConductor(scattering=1.0)
WALL = Scene({"wall": Object(plate(4.0, 4.0), CHALK)})
MAST = Transmitters(float64([0.5, 0.3, 2.0]))
SPOTS = float64([[1.0, -0.5, 1.5], [-2.0, 0.0, 3.0]])
CRATE = box(0.5)
ONE_BOUNCE = Sampling(depth=1, samples=400_000)


def summed(
    place: Tensor, gain: Callable[[Tensor, Tensor], Tensor] | None = None
) -> tuple[float, float]:
    """Power that the wall scatters to a place and the spread of all delays, by quadrature."""
    axis = (torch.arange(600, dtype=torch.float64) + 0.5) / 150 - 2
    points = torch.cartesian_prod(axis, axis, torch.zeros(1, dtype=torch.float64))
    tx = MAST.positions[0]
    ways = [(points - end).norm(dim=1) for end in (tx, place)]
    part = (WAVELENGTH / (4 * math.pi)) ** 2 / math.pi / 150**2
    part = part * float(tx[2] * place[2]) / (ways[0] * ways[1]) ** 3
    if gain is not None:
        part = part * gain(points, ways[1])
    straight = float((tx - place).norm())
    power = torch.cat([part, float64([(WAVELENGTH / (4 * math.pi * straight)) ** 2])])
    delay = torch.cat([ways[0] + ways[1], float64([straight])]) / SPEED_OF_LIGHT
    mean = (power * delay).sum() / power.sum()
    return float(part.sum()), float(((power * (delay - mean) ** 2).sum() / power.sum()).sqrt())


def test_power_and_delays_are_those_of_the_integral():
    mirrored = Points(SPOTS).received(WALL, MAST, Reception(FREQUENCY), 0)
    reception = Reception(FREQUENCY, rough=ONE_BOUNCE)
    found = Points(SPOTS).received(WALL, MAST, reception, 0)
    for number, place in enumerate(SPOTS):
        power, spread = summed(place)
        more = float(found.gain[0, number] - mirrored.gain[0, number])
        assert more == pytest.approx(power, rel=2e-3)
        assert float(found.delay_spread[0, number]) == pytest.approx(spread, rel=2e-3)


def test_pattern_of_receivers_has_axes_of_its_own():
    turn = rotation_from_vector(float64([0.3, 2.8, 0.1]))  # looks at the wall, aslant
    horn = Terminals(AntennaArray(float64([[0.0, 0.0, 0.0]]), Cosine(2.0)), turn)
    place = SPOTS[:1]

    def gain(points: Tensor, way: Tensor) -> Tensor:
        cosine = ((points - place[0]) @ turn[:, 2]) / way
        return torch.where(cosine > 0, 6 * cosine.clamp_min(0) ** 2, 0.0)

    reception = Reception(FREQUENCY, receivers=horn, rough=ONE_BOUNCE)
    isotropic = replace(horn, array=AntennaArray(float64([[0.0, 0.0, 0.0]])))
    plain = Reception(FREQUENCY, receivers=isotropic, rough=ONE_BOUNCE)
    powers = [float(how.scattered(WALL, MAST, place, 0)[0, 0, 0]) for how in (plain, reception)]
    whole, seen = summed(place[0])[0], summed(place[0], gain)[0]
    # The polarisation is the same for both, so the ratio is that of the pattern alone.
    assert powers[1] / powers[0] == pytest.approx(seen / whole, rel=5e-3)
    assert abs(seen / whole - 1) > 0.2


def test_smooth_share_mirrors_and_the_rest_scatters():
    half = Scene({"wall": Object(plate(4.0, 4.0), RoughConductor(scattering=0.6, rms_slope=0.2))})
    metal = Scene({"wall": Object(plate(4.0, 4.0), PerfectConductor())})
    reception = Reception(FREQUENCY, rough=ONE_BOUNCE)
    gains = {
        name: float(reception.scattered(scene, MAST, SPOTS, 0)[0, 0, 0])
        for name, scene in {"all": WALL, "half": half, "none": metal}.items()
    }
    assert gains["half"] == pytest.approx(0.36 * gains["all"], rel=1e-5)
    assert gains["none"] == 0


def shaded(offset: Tensor) -> Scene:
    """A box that hides a part of the wall from transmitter and receivers."""
    pose = rigid(translation=torch.stack([offset, *float64([0.2, 0.8])]))
    wall = WALL.objects["wall"]
    return Scene({"wall": wall, "box": Object(CRATE, PerfectConductor(), pose)})


@pytest.mark.parametrize("places", ["points", "cells"])
def test_derivative_holds_shadows_that_move(places):
    sampling = Sampling(depth=1, samples=1_000_000, boundary_samples=100_000)
    where = Points(float64([[-1.0, 0.3, 1.8]]))
    if places == "cells":
        where = MapPlane.horizontal([-1.2, 0.1], [-0.8, 0.5], 1.8, 0.4, CellSampling(points=9))
    reception = Reception(FREQUENCY, depth=0, rough=sampling)
    model = RadioMap(where, reception, "gain")
    at = float64(0.1)

    def rate(model: ForwardModel) -> float:
        def total(x: Tensor) -> Tensor:
            return model.predict(shaded(x), MAST, 0).sum()

        return float(jvp(total, (at,), (torch.ones_like(at),))[1])

    many = replace(sampling, samples=8_000_000, boundary=False)
    fine = replace(model, reception=replace(reception, rough=many))
    ends = [fine.predict(shaded(at + way), MAST, 0).sum() for way in (-0.02, 0.02)]
    truth = float(ends[1] - ends[0]) / 0.04
    fixed = model.ablations()["boundary"]
    assert rate(model) == pytest.approx(truth, rel=0.03)
    assert abs(rate(fixed) / truth - 1) > 0.3


def test_a_map_with_scattered_power_is_random():
    model = RadioMap(Points(SPOTS), Reception(FREQUENCY, rough=ONE_BOUNCE))
    assert model.random
    assert not RadioMap(Points(SPOTS), Reception(FREQUENCY)).random


def test_batches_of_places_add_up_to_the_same(monkeypatch):
    reception = Reception(FREQUENCY, rough=ONE_BOUNCE)
    whole = reception.scattered(WALL, MAST, SPOTS, 0)
    monkeypatch.setattr(scattered_module, "_PLACES_AT_ONCE", 1)
    torch.testing.assert_close(reception.scattered(WALL, MAST, SPOTS, 0), whole, rtol=5e-3, atol=0)


def test_refusals_name_what_is_wrong():
    reception = Reception(FREQUENCY, rough=ONE_BOUNCE)
    with pytest.raises(InputError, match=r"got Sampling.*no phase"):
        ResponseMap(SPOTS, float64([FREQUENCY]), reception).predict(WALL, MAST, 0)
    horn = AntennaArray(float64([[0.0, 0.0, 0.0]]), Cosine(2.0))
    turns = torch.eye(3, dtype=torch.float64).expand(2, 3, 3)
    with pytest.raises(InputError, match="one orientation of all receivers"):
        replace(reception, receivers=Terminals(horn, turns)).at(WALL, MAST, SPOTS, 0)
    turned = replace(MAST, terminals=Terminals(rotations=turns[0].clone().requires_grad_()))
    with pytest.raises(InputError, match="detach them"):
        reception.at(WALL, turned, SPOTS, 0)
