"""Reverberant tails: their law, what maps make of it, and fits of gain and decay."""

import math

import pytest
import torch

import invertwin as iw
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.inversion import Optimizer
from invertwin.links import (
    MapPlane,
    PropagationSettings,
    ReceiverPoints,
    Reverberation,
    ReverberationParameters,
    Transmitters,
)
from invertwin.scene import Dielectric, Scene, box
from scenes import float64

HALL = Scene({"hall": iw.Object(box([9.0, 6.0, 3.0]), Dielectric(5.0, 0.1, scattering=0.0))})
TX = float64([[-3.0, 1.0, 0.5], [2.5, -1.5, 0.8]])
SPOTS = float64([[3.1, 2.0, 0.2], [-1.0, -2.2, -0.6], [0.4, 0.3, 0.1], [-4.0, 2.4, -1.0]])
HOW = PropagationSettings(3.5e9, depth=1, rays=None)
TAIL = Reverberation(-52.0, 18e-9)


def test_moments_are_those_of_the_power_delay_profile():
    # By sums over the profile (G/T) exp(−τ/T) from the straight path on.
    found = TAIL.link_moments(TX, SPOTS)
    straight = torch.cdist(TX, SPOTS) / SPEED_OF_LIGHT
    excess = torch.linspace(0, 800e-9, 400_001, dtype=torch.float64)
    profile = 10**-5.2 / 18e-9 * torch.exp(-(straight[..., None] + excess) / 18e-9)
    for power in range(3):
        expected = torch.trapezoid(profile * excess**power, excess)
        torch.testing.assert_close(found[..., power], expected, rtol=1e-6, atol=0)


def test_tails_are_reciprocal():
    there, back = TAIL.link_moments(TX, SPOTS), TAIL.link_moments(SPOTS, TX)
    torch.testing.assert_close(there, back.transpose(0, 1), rtol=1e-14, atol=0)


def test_a_map_holds_paths_and_tail():
    points, dry = ReceiverPoints(SPOTS), Transmitters(TX)
    gains = iw.RadioMap(points, HOW, "gain")
    more = gains.predict(HALL, Transmitters(TX, reverberation=TAIL), 0) - gains.predict(
        HALL, dry, 0
    )
    torch.testing.assert_close(more, TAIL.link_moments(TX, SPOTS)[..., 0], rtol=1e-9, atol=0)


def test_a_link_without_paths_has_the_spread_of_its_tail():
    screen = iw.Object(box([0.1, 40.0, 40.0]), iw.PerfectConductor())
    blocked = PropagationSettings(3.5e9, depth=0, rays=None)
    found = blocked.link_statistics(
        Scene({"screen": screen}), Transmitters(TX[:1], reverberation=TAIL), SPOTS[:1], 0
    )
    assert float(found.delay_spread) == pytest.approx(18e-9, rel=1e-9)
    distance = float((TX[0] - SPOTS[0]).norm())
    expected = 10**-5.2 * math.exp(-distance / (SPEED_OF_LIGHT * 18e-9))
    assert float(found.gain) == pytest.approx(expected, rel=1e-9)


def test_cells_hold_the_tail_too():
    cells = MapPlane(float64([1.0, 1.0, 0.0]), float64([0.1, 0, 0]), float64([0, 0.1, 0]), (1, 1))
    pair = [
        cells.link_statistics(HALL, Transmitters(TX, reverberation=tail), HOW, 0).gain.flatten()
        for tail in (TAIL, None)
    ]
    expected = TAIL.link_moments(TX, float64([[1.05, 1.05, 0.0]]))[:, 0, 0]
    torch.testing.assert_close(pair[0] - pair[1], expected, rtol=1e-3, atol=0)


def test_some_transmitters_keep_the_tail():
    assert Transmitters(TX, reverberation=TAIL).frames([1]).reverberation is TAIL


def test_derivatives_agree_with_differences():
    gains = iw.RadioMap(ReceiverPoints(SPOTS), HOW, "path_gain")
    spreads = iw.RadioMap(ReceiverPoints(SPOTS), HOW, "delay_spread")

    def value(theta: torch.Tensor) -> torch.Tensor:
        tail = Reverberation(-52.0 + theta[0], 18e-9 * theta[1].exp())
        mast = Transmitters(TX + theta[2] * float64([0.3, 0.2, -0.1]), reverberation=tail)
        both = gains.predict(HALL, mast, 0).sum(), 1e9 * spreads.predict(HALL, mast, 0).sum()
        return torch.stack(both)

    slopes = torch.autograd.functional.jacobian(value, torch.zeros(3).double())
    for number in range(3):
        step = 1e-4 * torch.eye(3, dtype=torch.float64)[number]
        difference = (value(step) - value(-step)) / 2e-4
        torch.testing.assert_close(slopes[:, number], difference, rtol=1e-5, atol=1e-8)


def test_a_fit_finds_gain_and_decay():
    points = ReceiverPoints(
        torch.rand(20, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        * float64([8.0, 5.0, 2.0])
        - float64([4.0, 2.5, 1.0])
    )
    model = iw.RadioMap(points, HOW, scatter=0.2)
    real = Transmitters(TX, reverberation=TAIL)
    data = model.realisations(HALL, real, 0)(3, 0.0)
    found = iw.reconstruct(
        HALL,
        iw.Observation(
            model, data, sensor=Transmitters(TX), parameters=ReverberationParameters(-65.0, 40e-9)
        ),
        [],
        loss=iw.SpectrumLoss("mse", levels=1, gain="one"),
        optimizer=Optimizer("gauss_newton", rate=0.5),
        schedule=iw.Schedule(8),
    )
    tail = found.sensors[0].reverberation
    bars = found.uncertainty.deviations
    assert abs(float(tail.gain_db) + 52.0) < 3 * bars["reverberation.gain"]
    assert abs(float(tail.decay) - 18e-9) < 3 * bars["reverberation.decay"]
    assert bars["reverberation.gain"] < 0.5
    assert bars["reverberation.decay"] < 2e-9


def test_values_carry_their_names():
    module = ReverberationParameters(-60.0, 25e-9)
    values = module.values()
    assert float(values["reverberation.gain"]) == pytest.approx(-60.0)
    assert float(values["reverberation.decay"]) == pytest.approx(25e-9)


@pytest.mark.parametrize(
    ("gain", "decay", "text"),
    [
        (math.nan, 20e-9, "gain of the tail"),
        (-60.0, 0.0, "decay of the tail"),
        (-60.0, 20.0, "decay of the tail"),
        (400.0, 20e-9, "gain of the tail"),
    ],
)
def test_impossible_tails_are_refused(gain, decay, text):
    with pytest.raises(InputError, match=text):
        Reverberation(gain, decay)
