"""Waveforms, radar geometry, grids, and the errors and warnings at their edge."""

import math
from typing import Any

import pytest
import torch

from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.radar import FMCW, OFDM, Impulse, PhysicsWarning, Radar, SteppedFrequency
from invertwin.radar.waveform import taper
from invertwin.scene.antenna import AntennaArray, Isotropic, linear_array
from invertwin.scene.pose import rotation_from_vector

LAMBDA = SPEED_OF_LIGHT / 77e9


def test_fmcw_numbers():
    waveform = FMCW(77e9, 2e9, 40e-6, 128)
    assert waveform.center_frequency == 78e9
    assert waveform.slope == pytest.approx(5e13)
    assert waveform.range_resolution == pytest.approx(0.0749481, rel=1e-5)
    assert waveform.max_range == pytest.approx(128 * 0.0749481, rel=1e-5)
    assert waveform.sample_times[-1] == pytest.approx(40e-6 * 127 / 128)


@pytest.mark.parametrize(
    "waveform",
    [
        SteppedFrequency(3e9, 5e6, 200, 1e-4),
        OFDM(start_frequency=3e9, spacing=5e6, subcarriers=200),
    ],
)
def test_waveforms_of_single_frequencies(waveform):
    assert waveform.samples == 200
    assert waveform.bandwidth == 1e9
    assert waveform.range_resolution == pytest.approx(0.149896, rel=1e-5)
    assert waveform.max_range == pytest.approx(SPEED_OF_LIGHT / (2 * 5e6))
    assert waveform.frequencies[[0, -1]].tolist() == [3e9, 3e9 + 199 * 5e6]
    assert waveform.center_frequency == pytest.approx(float(waveform.frequencies.mean()))
    assert waveform.wavelength == pytest.approx(SPEED_OF_LIGHT / 3.4975e9)
    assert waveform.residual_slope == 0


def test_times_of_the_tones():
    times = SteppedFrequency(3e9, 5e6, 4, 1e-4).sample_times
    assert times.tolist() == pytest.approx([0, 1e-4, 2e-4, 3e-4])


@pytest.mark.parametrize(
    "waveform",
    [FMCW(77e9, 1e9, 4e-5, 200), SteppedFrequency(77e9, 5e6, 200, 1e-6), OFDM(77e9, 5e6, 200)],
)
def test_range_response_of_a_rectangular_window(waveform):
    """The Dirichlet kernel, which repeats after the unambiguous range."""
    cells = torch.tensor([0.0, 0.3, 1, 2.5, 7, 200, 202.5], dtype=torch.float64)
    found = waveform.range_response(cells * waveform.range_resolution, "rectangular")
    angle = math.pi * cells[1:5]
    expected = (torch.sin(angle) / (200 * torch.sin(angle / 200))).square()
    assert torch.allclose(found[1:5], expected, atol=1e-12)
    assert found[[0, 5]].tolist() == pytest.approx([1, 1])
    assert found[6] == pytest.approx(float(found[3]))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SteppedFrequency(3, 5e6, 200, 1e-4), "did you mean 3e9"),
        (lambda: SteppedFrequency(3e9, 5, 200, 1e-4), "did you mean 5e6"),
        (lambda: SteppedFrequency(3e9, -5e6, 200, 1e-4), "step above 0, got -5000000"),
        (lambda: SteppedFrequency(3e9, 5e6, 1, 1e-4), "samples of at least 2, got 1"),
        (lambda: SteppedFrequency(3e9, 5e6, 200, 100), "did you mean 100e-6"),
        (lambda: OFDM(77, 5e6, 200), "did you mean 77e9"),
        (lambda: OFDM(77e9, 0.0, 200), "spacing above 0, got 0.0"),
        (lambda: OFDM(77e9, 5e6, 1), "subcarriers of at least 2, got 1"),
        (lambda: FMCW(77, 2e9, 40e-6, 128), "did you mean 77e9"),
        (lambda: FMCW(77e3, 2e9, 40e-6, 128), "did you mean 77000e6"),
        (lambda: FMCW(77e9, 2, 40e-6, 128), "did you mean 2e9"),
        (lambda: FMCW(77e9, 2e9, 40, 128), "did you mean 40e-6"),
        (lambda: FMCW(77e9, -2e9, 40e-6, 128), "bandwidth above 0, got -2"),
        (lambda: FMCW(77e9, 2e9, 40e-6, 1), "samples of at least 2, got 1"),
        (lambda: FMCW(math.nan, 2e9, 40e-6, 128), "start_frequency above 0, got nan"),
        (lambda: Impulse(3.95, 1.7e9), "did you mean 3.95e9"),
    ],
)
def test_wrong_units(make, message):
    with pytest.raises(InputError, match=message):
        make()


def small(**changes) -> Radar:
    one = linear_array(1, LAMBDA / 2)
    arguments: dict[str, Any] = {
        "transmitters": one,
        "receivers": one,
        "waveform": FMCW(77e9, 1e9, 40e-6, 64),
        "positions": torch.zeros(2, 3, dtype=torch.float64),
    }
    return Radar(**(arguments | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"positions": torch.zeros(3)}, "radar positions"),
        ({"positions": torch.zeros(0, 3, dtype=torch.float64)}, "at least one radar pose"),
        ({"positions": torch.full((2, 3), math.nan)}, "finite radar positions"),
        ({"rotations": torch.eye(3).expand(3, 3, 3)}, "radar rotations"),
        ({"rotations": 2 * torch.eye(3).expand(2, 3, 3)}, "orthonormal"),
        ({"rotations": torch.diag(torch.tensor([1.0, 1, -1])).expand(2, 3, 3)}, "orthonormal"),
        ({"window": "kaiser"}, "expected window"),
        ({"array_window": "none"}, "expected array_window"),
        (
            {"transmitters": linear_array(2, LAMBDA / 2), "shared_visibility": False},
            "one transmitter",
        ),
    ],
)
def test_wrong_radar(unchecked, changes, message):
    with pytest.raises(InputError, match=message):
        small(**changes)


def test_positions_from_lists_are_float64(unchecked):
    radar = small(positions=[[0, 0, 1], [0, 0, 2]])
    expected = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 2.0]], dtype=torch.float64)
    torch.testing.assert_close(radar.positions, expected, rtol=0, atol=0)


def test_shared_visibility_follows_the_distance():
    def at(y: float) -> AntennaArray:
        return AntennaArray(torch.tensor([[0.0, y, 0.0]], dtype=torch.float64), Isotropic())

    assert small(receivers=at(0.09)).link().shared_visibility
    assert not small(receivers=at(0.2)).link().shared_visibility
    assert small(receivers=at(0.2), shared_visibility=True).link().shared_visibility


def test_world_geometry():
    """The second pose looks along world +y: radar x → y, radar y → −x, radar z stays."""
    turn = rotation_from_vector(torch.tensor([0, 0, math.pi / 2], dtype=torch.float64))
    rotations = torch.stack([torch.eye(3, dtype=torch.float64), turn])
    receivers = AntennaArray(
        torch.tensor([[0, 0, 0], [0, 0.001, 0], [0, 0, 0.0015]], dtype=torch.float64)
    )
    radar = small(
        receivers=receivers,
        positions=torch.tensor([[1, 2, 3], [1, 2, 3]], dtype=torch.float64),
        rotations=rotations,
    )
    tx, rx = radar.elements()
    offsets = rx - torch.tensor([1.0, 2, 3], dtype=torch.float64)
    assert torch.allclose(tx[1, 0], torch.tensor([1.0, 2, 3], dtype=torch.float64))
    assert offsets[0, 1].tolist() == pytest.approx([0, 0.001, 0], abs=1e-9)
    assert offsets[1, 1].tolist() == pytest.approx([-0.001, 0, 0], abs=1e-9)
    assert offsets[1, 2].tolist() == pytest.approx([0, 0, 0.0015], abs=1e-9)
    assert torch.allclose(radar.link().rx, rx.mean(1))
    boresight = radar.link().rotations[1] @ torch.tensor([1.0, 0, 0], dtype=torch.float64)
    assert torch.allclose(boresight, torch.tensor([0.0, 1, 0], dtype=torch.float64))


def test_virtual_positions_are_tx_major():
    tx, rx = linear_array(2, 0.4 * LAMBDA, "z"), linear_array(3, 0.5 * LAMBDA)
    virtual = small(transmitters=tx, receivers=rx).virtual_positions / LAMBDA
    assert torch.allclose(virtual[:, 1], torch.tensor([-0.5, 0, 0.5] * 2).double())
    assert torch.allclose(virtual[:, 2], torch.tensor([-0.2] * 3 + [0.2] * 3).double())


def test_moved_turns_about_the_mean_position():
    radar = small(positions=torch.tensor([[0, 0, 0], [2, 0, 0]], dtype=torch.float64))
    turn = rotation_from_vector(torch.tensor([0, 0, math.pi / 2], dtype=torch.float64))
    shift = torch.tensor([0.0, 0, 5], dtype=torch.float64, requires_grad=True)
    moved = radar.transform_rigidly(turn, shift)
    expected = torch.tensor([[1.0, -1, 5], [1, 1, 5]], dtype=torch.float64)
    assert torch.allclose(moved.positions, expected)
    assert torch.allclose(moved.link().rotations, turn.expand(2, 3, 3))
    moved.link().tx.sum().backward()
    assert shift.grad is not None
    assert torch.equal(shift.grad, torch.full((3,), 2.0, dtype=torch.float64))


def test_frames_choose_poses():
    radar = small(
        positions=torch.tensor([[0, 0, 0], [1, 0, 0], [2, 0, 0]], dtype=torch.float64)
    ).frames([2, 0])
    assert radar.positions[:, 0].tolist() == [2, 0]
    assert radar.frame_count == 2


def test_grid_spacing():
    radar = small(receivers=linear_array(16, LAMBDA / 2))
    grid = radar.grid(2.03, 3.01, u_max=0.5)
    cell = radar.waveform.range_resolution
    assert grid.range_step == pytest.approx(cell / 2)
    assert grid.range_start / grid.range_step == pytest.approx(round(2.03 // (cell / 2)))
    assert grid.ranges[0] <= 2.03
    assert grid.ranges[-1] >= 3.01
    assert grid.u_step == pytest.approx(1 / 32, rel=0.01)
    assert grid.u_count % 2 == 1
    assert grid.u[0] == pytest.approx(-grid.u[-1])
    assert grid.u[-1] >= 0.5
    assert grid.v_count == 1
    assert radar.grid(2, 3, oversample=4).range_step == pytest.approx(cell / 4)


def test_impulse_grid():
    radar = small(waveform=Impulse(3.95e9, 1.7e9))
    assert radar.grid(0, 5).shape[1:] == (1, 1)


@pytest.mark.parametrize("limits", [(3, 2), (-1, 2), (0, 2, 1.5), (0, 2, 1, 0), (0, 2, 1, 1, 0.5)])
def test_wrong_grid(limits):
    with pytest.raises(InputError):
        small().grid(*limits)


def test_wide_spacing_warns():
    with pytest.warns(PhysicsWarning, match="grating lobes"):
        small(receivers=linear_array(4, LAMBDA))


@pytest.mark.parametrize("name", ["hamming", "hann", "blackman", "rectangular"])
def test_tapers(name):
    position = torch.linspace(0, 1, 9, dtype=torch.float64)
    weight = taper(name, position, 9)
    assert torch.allclose(weight, weight.flip(0))
    assert weight[4] == pytest.approx(1)
    assert (weight > 0).all()
    if name == "hamming":
        assert torch.allclose(weight, torch.hamming_window(9, periodic=False).double(), atol=1e-6)
    if name == "hann":
        inner = torch.hann_window(11, periodic=False, dtype=torch.float64)[1:-1]
        assert torch.allclose(weight, inner)


def test_a_grid_beyond_the_unambiguous_range_is_refused(planar):
    with pytest.raises(InputError, match="unambiguous"):
        planar.grid(1.0, 1.01 * planar.waveform.max_range)
    assert planar.grid(1.0, planar.waveform.max_range).range_count > 1
