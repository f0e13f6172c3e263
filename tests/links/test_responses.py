"""Responses: closed forms, arrays, Doppler and OFDM against moved geometry."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from invertwin.channel import RayPaths, trace_paths
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.links import (
    AntennaMount,
    frequency_response,
    impulse_response,
    ofdm_channel,
    path_amplitudes,
)
from invertwin.scene import (
    AntennaArray,
    Cosine,
    Dielectric,
    Object,
    PerfectConductor,
    Scene,
    box,
    linear_array,
    plate,
    rigid,
    rotation_from_vector,
)
from scenes import float64, level_plate

FREQUENCY = 3.5e9
WAVELENGTH = SPEED_OF_LIGHT / FREQUENCY
METAL = PerfectConductor()
ROOM = Scene({"room": Object(box((5.0, 4.0, 3.0)), Dielectric(5.0, 0.1))})
TX, RX = [1.3, -1.1, 0.7], [[-1.4, 0.9, -0.6], [0.4, 1.2, -1.0]]


def trace(scene: Scene, tx: object, rx: object, **options: object) -> RayPaths:
    given = {"rays": 20_000, "depth": 2} | options
    return trace_paths(scene, tx, rx, FREQUENCY, **given)  # type: ignore[arg-type]


def test_one_path_is_one_phasor():
    ground = Scene({"far": Object(plate(1.0, 1.0), METAL, rigid(translation=[0.0, 0.0, -50.0]))})
    paths = trace(ground, [0, 0, 0], [3.0, 4.0, 0], depth=0)
    frequencies = float64([3.4e9, 3.5e9, 5.0e9])
    found = frequency_response(paths, frequencies)
    assert found.shape == (1, 1, 1, 1, 3)
    strength = WAVELENGTH / (4 * math.pi * 5)
    phase = -2 * math.pi * frequencies * 5 / SPEED_OF_LIGHT
    expected = torch.polar(torch.full_like(phase, strength), phase)
    torch.testing.assert_close(found.flatten(), expected)


def test_links_are_summed_apart():
    paths = trace(ROOM, [TX, [0.1, 0.2, 0.3]], RX)
    both = frequency_response(paths, [FREQUENCY])
    assert both.shape == (2, 1, 2, 1, 1)
    for tx in range(2):
        for rx in range(2):
            some = paths.select_link(tx, rx)
            one = some.coefficient[:, 0, 0] * torch.polar(
                torch.ones(len(some)).double(), -2 * math.pi * FREQUENCY * some.delay
            )
            torch.testing.assert_close(both[rx, 0, tx, 0, 0], one.sum())


def test_a_lost_link_is_zero():
    wall = Scene({"wall": Object(plate(50.0, 50.0), METAL)})
    paths = trace(wall, [2.0, 0, 0], [[-1.0, 0, 1], [1.0, 0, 1]])
    found = ofdm_channel(paths, subcarriers=4, spacing=30e3, symbols=2)
    assert found.shape == (2, 1, 1, 1, 2, 4)
    assert not found[0].any()
    assert found[1].all()


def test_elements_are_antennas_of_their_own():
    """Steering is that of plane waves: right where arrays are small against the path."""
    array = linear_array(3, WAVELENGTH / 2)
    turn = rotation_from_vector(float64([0.3, 0.5, -0.2]))
    ground = Scene({"ground": Object(level_plate(9e3, 9e3), METAL)})
    tx, rx = float64([0.0, 0.0, 900.0]), float64([1200.0, 500.0, 700.0])
    terminals = AntennaMount(array, turn)
    paths = trace(ground, tx, rx)
    together = frequency_response(paths, [FREQUENCY, 1.01 * FREQUENCY], tx=terminals, rx=terminals)
    places = array.positions @ turn.T
    apart = trace(ground, tx + places, rx + places)
    # Each path of an element with its own vertical: the same element, turned.
    single = AntennaMount(AntennaArray(torch.zeros(1, 3, dtype=torch.float64)), turn)
    each = frequency_response(apart, [FREQUENCY, 1.01 * FREQUENCY], tx=single, rx=single)
    expected = each.permute(1, 0, 3, 2, 4)
    error = float((together - expected).abs().max() / expected.abs().max())
    assert error < 1e-2  # 3 elements of λ/2 at a kilometre: k p²/R


def test_dipoles_that_are_crossed_do_not_talk():
    ground = Scene({"far": Object(plate(1.0, 1.0), METAL, rigid(translation=[0.0, 0.0, -50.0]))})
    paths = trace(ground, [0, 0, 0], [5.0, 0, 0], depth=0)
    upright = AntennaMount()
    axes = upright.rotations
    lying = AntennaMount(rotations=torch.stack([axes[:, 0], -axes[:, 2], axes[:, 1]], 1))
    amplitude = [
        path_amplitudes(paths, tx, rx)[0].abs().max().item()
        for tx, rx in ((upright, upright), (lying, lying), (upright, lying))
    ]
    assert amplitude[0] == pytest.approx(WAVELENGTH / (20 * math.pi))
    assert amplitude[1] == pytest.approx(amplitude[0])
    assert amplitude[2] < 1e-15


def test_polarisations_of_elements_count():
    """Circular antennas: of one hand they hear each other, and a mirror turns the hand."""
    paths = trace(
        Scene({"wall": Object(plate(9.0, 9.0), METAL, rigid(translation=[-1.0, 0.0, 0.0]))}),
        [0, 0, 0],
        [3.0, 0.01, 0],
    )
    one = torch.zeros(1, 3, dtype=torch.float64)
    right, left = (
        AntennaMount(AntennaArray(one, polarisation=jones)) for jones in ("circular", [1, -1j])
    )
    same, other = (path_amplitudes(paths, right, rx)[0].abs().flatten() for rx in (right, left))
    ratio = (same / other).log10()
    assert ratio[0].item() > 2
    assert ratio[1].item() < -2
    both = AntennaMount(AntennaArray(float64([[0, 0, 0]] * 2), polarisation=[[1, 0], [0, 1]]))
    assert path_amplitudes(paths, both, both)[0].shape == (2, 2, 2)


def test_patterns_weigh_directions():
    ground = Scene({"far": Object(plate(1.0, 1.0), METAL, rigid(translation=[0.0, 0.0, -50.0]))})
    paths = trace(ground, [0, 0, 0], [[5.0, 0, 0], [-5.0, 0, 0], [3.0, 4.0, 0]], depth=0)
    ahead = AntennaMount(AntennaArray(torch.zeros(1, 3, dtype=torch.float64), Cosine(2.0)))
    gains = path_amplitudes(paths, tx=ahead)[0].abs()[:, 0, 0]
    free = path_amplitudes(paths)[0].abs()[:, 0, 0]
    torch.testing.assert_close(gains / free, float64([6.0, 0.0, 6 * 0.36]).sqrt())


def test_impulse_and_frequency_responses_are_transforms_of_each_other():
    paths = trace(ROOM, TX, RX)
    band, count = 400e6, 512
    taps = impulse_response(paths, bandwidth=band, taps=count, start=-128 / band)
    # The sum over all taps of a band-limited response is that over frequencies in the band.
    offsets = (torch.arange(count).double() - count // 2) * band / count
    inside = offsets.abs() < 0.3 * band
    times = (torch.arange(count).double() - 128) / band
    turn = -2 * math.pi * offsets[:, None] * times
    transform = torch.polar(torch.ones_like(turn), turn)
    found = torch.einsum("rstun,fn->rstuf", taps, transform)[..., inside]
    expected = frequency_response(paths, FREQUENCY + offsets[inside])
    assert float((found - expected).abs().max() / expected.abs().max()) < 2e-2


def test_ofdm_is_the_response_of_moved_geometry():
    velocity = float64([0.0, 0.0, -30.0])
    board = Object(level_plate(9.0, 9.0), METAL, rigid(translation=[0.0, 0.0, 4.0]), velocity)
    ends = float64([0.1, 0.2, 0.0]), float64([-3.4, 2.1, 0.2])
    moves = float64([20.0, 0.0, 0.0]), float64([0.0, -15.0, 5.0])
    spacing, prefix, count = 60e3, 1.2e-6, 9
    scene = Scene({"board": board})
    paths = trace(scene, *ends, tx_velocity=moves[0], rx_velocity=moves[1])
    assert len(paths) == 2
    channel = ofdm_channel(
        paths, subcarriers=count, spacing=spacing, symbols=4, cyclic_prefix=prefix
    )
    grid = FREQUENCY + (torch.arange(count).double() - count // 2) * spacing
    for symbol in range(4):
        time = symbol * (1 / spacing + prefix)
        later = trace(
            scene.advance(time), *(e + v * time for e, v in zip(ends, moves, strict=True))
        )
        expected = frequency_response(later, grid)
        found = channel[:, :, :, :, symbol]
        assert float((found - expected).abs().max() / expected.abs().max()) < 1e-3
    still = channel[..., 3, 0] / channel[..., 0, 0]
    assert float((still - 1).abs().min()) > 0.01


def test_many_frequencies_come_in_pieces(monkeypatch):
    paths = trace(ROOM, TX, RX)
    grid = torch.linspace(3.4e9, 3.6e9, 50, dtype=torch.float64)
    whole = frequency_response(paths, grid)
    monkeypatch.setattr("invertwin.links.responses._VALUES_PER_CHUNK", 300)
    torch.testing.assert_close(frequency_response(paths, grid), whole)


def test_gradients_are_differences():
    array = linear_array(2, WAVELENGTH / 2, pattern=Cosine(1.0))

    def value(change: Tensor) -> Tensor:
        paths = trace(ROOM, float64(TX) + change[:3], float64(RX[0]) + change[3:6])
        turn = rotation_from_vector(float64([0.3, 0.5, -0.2]) + change[6:])
        found = ofdm_channel(
            paths, subcarriers=3, spacing=1e6, tx=AntennaMount(array, turn), rx=AntennaMount()
        )
        return torch.view_as_real(found).flatten()

    zero = torch.zeros(9, dtype=torch.float64)
    jacobian: Any = torch.autograd.functional.jacobian(value, zero)
    for column in range(9):
        step = 1e-7 * torch.eye(9, dtype=torch.float64)[column]
        truth = (value(step) - value(-step)) / 2e-7
        assert float((jacobian[:, column] - truth).norm() / truth.norm()) < 1e-5


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"subcarriers": 0, "spacing": 1e3}, "subcarriers"),
        ({"subcarriers": 4, "spacing": 0.0}, "subcarrier spacing"),
        ({"subcarriers": 4, "spacing": 1e3, "symbols": 0}, "symbols"),
        ({"subcarriers": 4, "spacing": 1e3, "cyclic_prefix": -1.0}, "cyclic prefix"),
        ({"subcarriers": 10**9, "spacing": 1e3}, "integer in .1, 100000000."),
        ({"subcarriers": 10**8, "spacing": 1e3, "symbols": 10**6}, "a channel within"),
    ],
)
def test_bad_ofdm_is_told(options, message):
    with pytest.raises(InputError, match=message):
        ofdm_channel(trace(ROOM, TX, RX, depth=0), **options)


def test_bad_terminals_are_told():
    paths = trace(ROOM, [TX, TX, TX], RX, depth=0)
    with pytest.raises(InputError, match="orthonormal"):
        AntennaMount(rotations=2 * torch.eye(3, dtype=torch.float64))
    two = AntennaMount(rotations=torch.eye(3, dtype=torch.float64).expand(2, 3, 3))
    with pytest.raises(InputError, match="a rotation for each of 3 places"):
        frequency_response(paths, [1e9], tx=two)
    with pytest.raises(InputError, match="at least one frequency"):
        frequency_response(paths, [])
