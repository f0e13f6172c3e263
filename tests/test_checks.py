"""Checks of values that enter the library: numbers end where physics does."""

import math
from functools import partial

import pytest
import torch

from invertwin.capture import ChirpData, ChirpSettings
from invertwin.channel import Grid
from invertwin.checks import checked_count, checked_number, checked_tensor
from invertwin.errors import InputError
from invertwin.limits import MAX_LENGTH, MAX_NUMBER
from invertwin.links import Transmitters
from invertwin.radar import FMCW, OFDM, Chirps, Impulse, Radar, SteppedFrequency
from invertwin.scene import (
    Object,
    PerfectConductor,
    Translation,
    box,
    linear_array,
    plate,
    rigid,
    sphere,
)

HOSTILE = (math.nan, math.inf, -math.inf, 1e300, -1e300, 1e31)
CHIRP = partial(FMCW, start_frequency=77e9, bandwidth=1e9, duration=5e-5, samples=64)
SETTINGS = partial(
    ChirpSettings,
    start_frequency=77e9,
    slope=60e12,
    sample_rate=5e6,
    samples=8,
    transmit_order=(1,),
    receivers=(1,),
    loops=1,
)


def row(x: float) -> torch.Tensor:
    """Return one place at a number along x."""
    return torch.tensor([[x, 0.0, 0.0]], dtype=torch.float64)


#: What is made of a number, and one with which it is made.
MADE = {
    "start frequency": (lambda x: CHIRP(start_frequency=x), 3e12),
    "bandwidth": (lambda x: CHIRP(bandwidth=x), 3e12),
    "duration": (lambda x: CHIRP(duration=x), 1e-9),
    "step": (lambda x: SteppedFrequency(3e9, step=x, samples=8, dwell=1e-4), 1e9),
    "dwell": (lambda x: SteppedFrequency(3e9, step=1e6, samples=8, dwell=x), 1e-9),
    "spacing": (lambda x: OFDM(77e9, spacing=x, subcarriers=8), 1e9),
    "centre": (lambda x: Impulse(x, bandwidth=1e9), 1e11),
    "interval": (lambda x: Chirps(count=4, interval=x), 1.0),
    "slope": (lambda x: SETTINGS(slope=x), 60e12),
    "frame period": (lambda x: SETTINGS(frame_period=x), 0.1),
    "translation": (lambda x: rigid(translation=[0.0, x, 0.0]), -MAX_LENGTH),
    "fitted translation": (lambda x: Translation("a", [x, 0.0, 0.0]), MAX_LENGTH),
    "radius": (lambda x: sphere(x, 1), 1e8),
    "width": (lambda x: plate(x, 1.0), 1e9),
    "size": (lambda x: box((1.0, x, 1.0)), 1e9),
    "elements": (lambda x: linear_array(4, x), 0.002),
    "velocity": (lambda x: Object(plate(1.0, 1.0), PerfectConductor(), None, row(x)[0]), 2e8),
    "position": (
        lambda x: Radar(linear_array(1, 1.0), linear_array(1, 1.0), CHIRP(), row(x)),
        1e9,
    ),
    "power": (lambda x: Transmitters(row(0.0), power_dbm=x), 300.0),
    "place": (lambda x: Transmitters(row(x)), 1e9),
    "bins": (lambda x: Grid(range_start=1.0, range_step=x, range_count=4), 1.0),
}


@pytest.mark.parametrize("name", MADE)
def test_numbers_that_nothing_can_have_are_refused_in_one_line(name):
    make, usual = MADE[name]
    make(usual)
    for number in HOSTILE:
        with pytest.raises(InputError, match=r"expected .*, got ") as caught:
            make(number)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "number"),
    [
        *[("start frequency", 3.1e14), ("bandwidth", 3.1e14), ("duration", 1e-13)],
        *[("velocity", 3e8), ("translation", 1.1e9), ("place", -1.1e9), ("power", 301.0)],
    ],
)
def test_limits_are_those_of_radio_light_and_phase(name, number):
    with pytest.raises(InputError, match="expected"):
        MADE[name][0](number)


def test_samples_end_where_their_power_is_no_number():
    ones = torch.ones(1, 1, 1, 1, 8, dtype=torch.complex128)
    ChirpData(ones * MAX_NUMBER / 2, SETTINGS())
    with pytest.raises(InputError, match="expected finite samples"):
        ChirpData(ones * 1e300, SETTINGS())


def test_a_tensor_keeps_its_gradient_and_its_limit():
    value = torch.tensor([1.0, -3.0], dtype=torch.float64, requires_grad=True)
    assert checked_tensor(value, (2,), "numbers", "lower them", 3.0).requires_grad
    with pytest.raises(InputError, match=r"got 1 NaN, infinite or above 2 of 2; lower them"):
        checked_tensor(value, (2,), "numbers", "lower them", 2.0)


@pytest.mark.parametrize("number", [10**400, -(10**5_000)], ids=["400", "5000"])
def test_integers_that_no_float_holds_are_one_line(number):
    with pytest.raises(InputError, match=r"in \[0, 1\], got -?inf"):
        checked_number(number, "a share", 0.0, 1.0)
    with pytest.raises(InputError, match=r"integer in \[1, 100000000\], got -?inf"):
        checked_count(number, "nodes", 1)
    with pytest.raises(InputError, match="expected places as numbers"):
        checked_tensor([10**400], (1,), "places", "give metres")
