"""What receivers get: closed forms, band means, shadows, many receivers."""

import math
import resource
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from invertwin.channel import trace_paths
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.links import (
    AntennaMount,
    PropagationSettings,
    ReceiverPoints,
    Transmitters,
    frequency_response,
    received_gain,
)
from invertwin.links import received as received_module
from invertwin.scene import (
    AntennaArray,
    Cosine,
    Dielectric,
    Object,
    PerfectConductor,
    Scene,
    box,
    plate,
    rigid,
)
from scenes import float64, level_plate

FREQUENCY = 2.4e9
WAVELENGTH = SPEED_OF_LIGHT / FREQUENCY
METAL = PerfectConductor()
GROUND = Scene({"ground": Object(level_plate(200.0, 200.0), METAL)})
ROOM = Scene({"room": Object(box((6.0, 5.0, 3.0)), Dielectric(5.0, 0.1, scattering=0.0))})
SCREEN = Scene({"screen": Object(plate(2.0, 3.0), METAL, rigid(translation=[0.0, 1.0, 0.0]))})


def received(scene: Scene, tx: object, rx: Tensor, **how: object) -> Tensor:
    reception = PropagationSettings(FREQUENCY, **how)  # type: ignore[arg-type]
    return ReceiverPoints(rx).link_statistics(scene, Transmitters(float64(tx)), reception, 0).gain


def test_fields_or_powers_of_two_rays_add():
    tx, rx = [-25.0, 0.0, 2.0], float64([[25.0, 0.0, 1.5]])
    ways = [math.hypot(50, 0.5), math.hypot(50, 3.5)]
    parts = [WAVELENGTH / (4 * math.pi * way) for way in ways]
    powers = received(GROUND, tx, rx, depth=1)
    assert float(powers) == pytest.approx(sum(part**2 for part in parts), rel=1e-12)
    turn = 2 * math.pi * (ways[1] - ways[0]) / WAVELENGTH
    mixed = 2 * parts[0] * parts[1] * math.cos(turn)
    fields = received(GROUND, tx, rx, depth=1, bandwidth=0.0)
    assert float(fields) == pytest.approx(sum(part**2 for part in parts) + mixed, rel=1e-9)
    apart = 300e6 * (ways[1] - ways[0]) / SPEED_OF_LIGHT
    share = math.sin(math.pi * apart) / (math.pi * apart)
    mean = received(GROUND, tx, rx, depth=1, bandwidth=300e6)
    expected = sum(part**2 for part in parts) + mixed * share
    assert float(mean) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("bandwidth", [20e6, 500e6])
def test_the_mean_over_a_band_is_that_of_the_response(bandwidth):
    paths = trace_paths(ROOM, [-1.0, 1.0, 0.3], [[2.0, -1.3, -0.4]], FREQUENCY, depth=3, rays=None)
    count = 4001
    steps = (torch.arange(count).double() + 0.5) / count - 0.5
    response = frequency_response(paths, FREQUENCY + bandwidth * steps)
    expected = response.abs().square().mean()
    torch.testing.assert_close(received_gain(paths, bandwidth)[0, 0], expected, rtol=1e-4, atol=0)


def test_wide_bands_add_powers_and_narrow_ones_fields():
    paths = trace_paths(ROOM, [-1.0, 1.0, 0.3], [[2.0, -1.3, -0.4]], FREQUENCY, depth=2, rays=None)
    powers, fields = received_gain(paths), received_gain(paths, 0.0)
    torch.testing.assert_close(received_gain(paths, 1e14), powers, rtol=1e-4, atol=0)
    torch.testing.assert_close(received_gain(paths, 1.0), fields, rtol=1e-6, atol=0)
    assert float(fields / powers - 1) != pytest.approx(0, abs=0.01)


@pytest.mark.parametrize("bandwidth", [0.0, 1e9])
def test_edges_leave_no_jump_at_a_shadow(bandwidth):
    tx = [3.0, 0.2, 0.1]
    # The screen's edge at y = 0 throws a shadow to y = −0.2 at x = −3.
    offsets = float64([-1e-6, 1e-6])
    rx = torch.stack([-3.0 + 0 * offsets, -0.2 + offsets, 0.1 + 0 * offsets], 1)
    with_edges = received(SCREEN, tx, rx, bandwidth=bandwidth, edges=1, depth=1)[0]
    without = received(SCREEN, tx, rx, bandwidth=bandwidth, depth=1)[0]
    assert abs(float(10 * (with_edges[0] / with_edges[1]).log10())) < 1e-3
    assert float(without.min()) == 0.0 < float(without.max())


def test_edges_need_a_bandwidth():
    with pytest.raises(InputError, match="expected a bandwidth with edges, got none"):
        PropagationSettings(FREQUENCY, edges=1)


@pytest.mark.parametrize("bandwidth", [None, 0.0, 1e8])
def test_where_no_path_leads_there_is_no_power(bandwidth):
    sealed = ROOM.replace("room", material=METAL)
    tx = torch.tensor([9.0, 0.0, 0.0], dtype=torch.float64, requires_grad=True)
    reception = PropagationSettings(FREQUENCY, bandwidth)
    found = ReceiverPoints(float64([[0.0, 0.0, 0.0]])).link_statistics(
        sealed, Transmitters(tx), reception, 0
    )
    assert found.gain.tolist() == [[0.0]]
    assert found.delay_spread.tolist() == [[0.0]]


def test_batches_change_nothing(monkeypatch):
    rx = torch.rand(23, 3, generator=torch.Generator().manual_seed(1)).double() * 2 - 1
    tx = torch.tensor([[0.3, -1.5, 0.9], [-1.3, 1.5, 0.2]], dtype=torch.float64, requires_grad=True)
    reception = PropagationSettings(FREQUENCY, 1e8, edges=1, depth=2)

    def gains() -> tuple[Tensor, Tensor]:
        found = ReceiverPoints(rx).link_statistics(ROOM, Transmitters(tx), reception, 0).gain
        return found.detach(), torch.autograd.grad(found.log().sum(), tx)[0]

    whole = gains()
    monkeypatch.setattr(received_module, "_RECEIVERS_PER_BATCH", 5)
    for one, other in zip(whole, gains(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_ten_thousand_receivers_in_bounded_memory():
    rx = torch.rand(10_000, 3, generator=torch.Generator().manual_seed(1)).double()
    rx = rx * float64([5.8, 4.8, 2.8]) - float64([2.9, 2.4, 1.4])
    tx = torch.tensor([0.3, -1.5, 0.9], dtype=torch.float64, requires_grad=True)
    reception = PropagationSettings(FREQUENCY, 1e8, depth=2)

    def slope(count: int) -> Tensor:
        gain = ReceiverPoints(rx[:count]).link_statistics(ROOM, Transmitters(tx), reception, 0).gain
        return torch.autograd.grad(gain.sum(), tx)[0]

    slope(1_000)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert bool(torch.isfinite(slope(10_000)).all())
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300_000  # kB


def test_terminals_weigh_paths():
    beam = AntennaMount(AntennaArray(torch.zeros(1, 3).double(), Cosine(2.0)))  # looks along x
    tx = Transmitters(float64([0.0, 0.0, 1.0]), beam, 20.0)
    rx = ReceiverPoints(float64([[3.0, 0.0, 1.0], [-3.0, 0.0, 1.0]]))
    found = rx.link_statistics(GROUND, tx, PropagationSettings(FREQUENCY, depth=0), 0).gain[0]
    free = (WAVELENGTH / (4 * math.pi * 3)) ** 2
    torch.testing.assert_close(found, float64([6 * free, 0.0]))
    assert replace(tx, power_dbm=30.0).powers.tolist() == [1000.0]
