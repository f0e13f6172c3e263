"""Boards: virtual arrays that their sources print, signs, and what is refused."""

import math

import pytest
import torch

from invertwin.errors import InputError
from invertwin.radar.boards import BOARDS, Board, board
from invertwin.radar.processing.beamforming import exact_spectrum
from invertwin.radar.radar import Radar
from invertwin.radar.waveform import FMCW, PhysicsWarning

ISK_0 = [0, -1, -2, -3, -2, -3, -4, -5, -4, -5, -6, -7]
ISK_1 = [-1, -1, -1, -1, 0, 0, 0, 0, -1, -1, -1, -1]
AOP_0 = [-1, -1, 0, 0, -3, -3, -2, -2, -1, -1, 0, 0]
AOP_1 = [-1, 0, -1, 0, -3, -2, -3, -2, -3, -2, -3, -2]
AWR2944 = [(1, 0), (1, 1), (1, 2), (1, 3), (0, 2), (0, 3), (0, 4), (0, 5)]
AWR2944 += [(1, column) for column in range(4, 12)]


def virtual(name, elevation=1, azimuth=1):
    """TX-major virtual positions in half wavelengths."""
    preset = board(name)
    tx, rx = preset.arrays(elevation=elevation, azimuth=azimuth)
    unit = 299792458.0 / preset.design_frequency / 2
    return ((tx.positions[:, None] + rx.positions).reshape(-1, 3) / unit)[:, 1:]


def assert_same_layout(one, columns, rows):
    """Equal up to where the origin is."""
    other = torch.tensor([columns, rows], dtype=torch.float64).T
    torch.testing.assert_close(one - one[0], other - other[0], atol=1e-9, rtol=0)


@pytest.mark.parametrize(
    ("name", "tx", "rx"),
    [
        ("xWR1443", 3, 4),
        ("xWR1642", 2, 4),
        ("xWR1843", 3, 4),
        ("IWR6843ISK", 3, 4),
        ("IWR6843AOP", 3, 4),
        ("AWR2944", 4, 4),
        ("MMWCAS-RF", 12, 16),
    ],
)
def test_presets_have_their_elements(name, tx, rx):
    transmitters, receivers = board(name).arrays(elevation=1)
    assert (len(transmitters.positions), len(receivers.positions)) == (tx, rx)
    for array in (transmitters, receivers):
        torch.testing.assert_close(array.positions.mean(0), torch.zeros(3).double())
    assert board(name).source


def test_the_list_of_presets_is_complete():
    assert set(BOARDS) == {
        *("xWR1443", "xWR1642", "xWR1843", "IWR6843ISK", "IWR6843AOP", "AWR2944", "MMWCAS-RF")
    }


def test_virtual_arrays_are_those_of_the_sdk():
    assert_same_layout(virtual("IWR6843ISK"), [-c for c in ISK_0], ISK_1)
    assert_same_layout(virtual("IWR6843AOP"), [-c for c in AOP_0], AOP_1)
    # Rows of antGeometryCfg count downwards and are 0.8 λ apart, columns λ/2.
    columns, rows = [c for _, c in AWR2944], [-1.6 * r for r, _ in AWR2944]
    assert_same_layout(virtual("AWR2944"), columns, rows)


def test_azimuth_rows_are_filled():
    for name, count in (("xWR1642", 8), ("xWR1843", 8), ("xWR1443", 8), ("AWR2944", 12)):
        places = virtual(name)
        row = places[places[:, 1] == places[0, 1], 0].sort().values
        torch.testing.assert_close(row.diff(), torch.ones(count - 1).double())


def test_the_cascade_has_86_azimuth_places_and_minimum_redundancy_in_elevation():
    places = virtual("MMWCAS-RF").round(decimals=6)
    rows = places[:, 1].unique(return_counts=True)
    lowest = places[places[:, 1] == rows[0][0], 0]
    assert len(lowest.unique()) == 86
    assert (rows[0] - rows[0][0]).tolist() == [0, 1, 4, 6]


def test_signs_mirror():
    up, down = virtual("xWR1843"), virtual("xWR1843", elevation=-1)
    torch.testing.assert_close(up * torch.tensor([1.0, -1.0]), down)
    left = virtual("xWR1843", azimuth=-1)
    torch.testing.assert_close(up * torch.tensor([-1.0, 1.0]), left)


def test_elements_can_be_chosen():
    tx, rx = board("xWR1843").arrays(elevation=1, transmitters=[1, 3], receivers=[2])
    every = board("xWR1843").arrays(elevation=1)
    assert torch.equal(tx.positions, every[0].positions[[0, 2]])
    assert torch.equal(rx.positions, every[1].positions[[1]])


def test_the_unit_follows_the_design_frequency():
    tx, _ = board("xWR1642", 60e9).arrays()
    assert float(tx.positions[:, 1].diff()) == pytest.approx(2 * 299792458.0 / 60e9)


def test_a_target_above_and_left_of_the_board_is_at_positive_u_and_v():
    tx, rx = board("xWR1843").arrays(elevation=1)
    chirp = FMCW(78e9, 2e9, 50e-6, 64)
    radar = Radar(tx, rx, chirp, torch.zeros(1, 3, dtype=torch.float64))
    place = 3 * torch.tensor([math.sqrt(1 - 0.13), 0.2, 0.3], dtype=torch.float64)
    ends = [(element - place).norm(dim=-1) for element in radar.elements()]
    delay = (ends[0][:, :, None] + ends[1][:, None])[..., None] / 299792458.0
    cycles = chirp.start_frequency * delay + chirp.slope * delay * chirp.sample_times
    beat = torch.exp(2j * torch.pi * (cycles - 0.5 * chirp.slope * delay**2))
    grid = radar.grid(2.9, 3.1, u_max=0.6, v_max=0.6)
    spectrum = exact_spectrum(beat, radar, grid)[0].amax(0)
    peak = int(spectrum.argmax())
    assert grid.u[peak // len(grid.v)] == pytest.approx(0.2, abs=0.07)
    assert grid.v[peak % len(grid.v)] > 0.1


def test_rows_that_are_far_apart_are_warned_of():
    tx, rx = board("AWR2944").arrays(elevation=1)
    with pytest.warns(PhysicsWarning, match="0.80 wavelengths apart along z"):
        Radar(tx, rx, FMCW(76.5e9, 1e9, 50e-6, 64), torch.zeros(1, 3, dtype=torch.float64))


def test_a_table_of_ones_own():
    mine = Board("mine", ((0.0, 0.0),), ((0.0, 0.0), (1.0, 0.0)), 24e9)
    _, rx = mine.arrays()
    assert float(rx.positions[:, 1].diff()) == pytest.approx(299792458.0 / 48e9)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: board("xWR1843").arrays(), r"elevation=\+1 or -1 for xWR1843"),
        (lambda: board("xWR1843").arrays(elevation=2), "elevation to be"),
        (lambda: board("xWR1642").arrays(azimuth=0), "azimuth to be"),
        (lambda: board("xWR1642").arrays(transmitters=[3]), "TX numbers of xWR1642 from 1 to 2"),
        (lambda: board("xWR1642").arrays(receivers=[1, 1]), "different RX numbers"),
        (lambda: board("xWR1642", 79.0), "design_frequency in Hz, got 79"),
        (lambda: board("xWR1234"), "expected a board of xWR1443"),
        (lambda: Board("mine", (), ((0.0, 0.0),), 77e9), "transmitters of mine as pairs"),
        (
            lambda: Board("mine", ((0.0, 0.0),), ((0.0, 0.0),), 77.0),
            "design_frequency in Hz, got 77",
        ),
    ],
)
def test_what_no_board_has_is_refused(call, message, unchecked):
    with pytest.raises(InputError, match=message):
        call()
