"""Capon and MUSIC on plane waves: closed forms, resolution, counting, gradients, refusals."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from invertwin.channel import Grid
from invertwin.errors import InputError
from invertwin.radar import (
    Chirps,
    Radar,
    beamform,
    capon,
    compensate_tdm,
    music,
    range_doppler,
    source_count,
)
from invertwin.radar.processing.direction import _SignalProjector
from invertwin.scene.antenna import AntennaArray, linear_array
from oracles.moving_point import moving_point

MUSIC = _SignalProjector.apply


def waves(radar: Radar, directions, snapshots: int, seed: int, noise: float = 0.0, coherent=False):
    """[1, snapshot, tx, rx, 1] of unit plane waves with random phases, and white noise."""
    generator = torch.Generator().manual_seed(seed)
    directions = torch.tensor(directions, dtype=torch.float64).reshape(-1, 2)
    k = 2 * math.pi / radar.waveform.wavelength
    phase = -k * (directions @ radar.virtual_positions[:, 1:].T)
    sources = 1 if coherent else len(directions)
    turn = 2 * math.pi * torch.rand(snapshots, sources, dtype=torch.float64, generator=generator)
    signal = torch.exp(1j * turn).expand(-1, len(directions)) @ torch.exp(1j * phase)
    noises = torch.randn(signal.shape, dtype=torch.complex128, generator=generator)
    signal = signal + math.sqrt(noise) * noises
    tx, rx = len(radar.transmitters.positions), len(radar.receivers.positions)
    return signal.reshape(1, snapshots, tx, rx, 1)


def line(u_max=0.9, count=361) -> Grid:
    return Grid(5.0, 0.1, 1, u_start=-u_max, u_step=2 * u_max / (count - 1), u_count=count)


def peaks(power, grid, count=2):
    """u of the highest local maxima of a line, sorted."""
    values = power.reshape(-1)
    inner = values[1:-1]
    places = torch.nonzero((inner > values[:-2]) & (inner >= values[2:])).ravel() + 1
    best = places[values[places].argsort(descending=True)][:count]
    return sorted(grid.u[best].tolist())


def test_capon_of_one_source_is_its_closed_form(linear):
    """1 / aᴴ (b bᴴ + δ I)⁻¹ a with |b|² = M: δ / (M (1 − |aᴴb|²/(M (M + δ))))."""
    grid, loading, elements = line(), 0.1, 16
    power = capon(waves(linear, [[0.2, 0]], 1, 0), linear, grid, loading=loading)
    assert power.shape == (1, 1, 361, 1)
    k = 2 * math.pi / linear.waveform.wavelength
    phase = k * (grid.u[:, None] - 0.2) * linear.virtual_positions[:, 1]
    overlap = torch.exp(1j * phase).sum(1).abs().square()
    expected = loading / (elements - overlap / (elements + loading))
    assert torch.allclose(power[0, 0, :, 0], expected, rtol=1e-9)
    assert power.max() == pytest.approx(1 + loading / elements, rel=1e-6)


@pytest.mark.parametrize("method", [capon, music])
def test_source_off_both_axes(method, planar, mimo):
    """At u = 0.3, v = −0.2 and at no mirror image, for one and for several transmitters."""
    for radar in (planar, mimo):
        grid = replace(radar.grid(5, 5.1), range_count=1)
        profile = waves(radar, [[0.3, -0.2]], 8, 1, noise=1e-3)
        options = {"sources": 1} if method is music else {}
        power = method(profile, radar, grid, **options)[0, 0]
        i, j = divmod(int(power.argmax()), grid.v_count)
        assert grid.u[i] == pytest.approx(0.3, abs=0.51 * grid.u_step)
        assert grid.v[j] == pytest.approx(-0.2, abs=0.51 * grid.v_step)


def test_two_sources_within_a_beam(linear):
    """0.4 of a beamwidth apart: Bartlett sees one, Capon and MUSIC two at their places."""
    apart = 0.4 * linear.beamwidth[0]
    truth = [0.1 - apart / 2, 0.1 + apart / 2]
    profile = waves(linear, [[u, 0.0] for u in truth], 200, 2, noise=1e-3)
    grid = line(count=1801)
    plain = replace(linear, array_window="rectangular")
    many = beamform(profile[0], plain.frames([0] * 200), grid).mean(0)
    around = (grid.u - 0.1).abs() < apart
    assert len(peaks(many[0, around], grid)) == 1
    for power in (
        capon(profile, linear, grid, loading=1e-4),
        music(profile, linear, grid, sources=2),
        music(profile, linear, grid),
    ):
        assert peaks(power, grid) == pytest.approx(truth, abs=0.03 * linear.beamwidth[0])


def test_coherent_sources_need_smoothing(linear):
    """One snapshot of two sources: subarrays of 10 of 16 elements, read both ways, part them."""
    truth = [0.0, 1.2 * linear.beamwidth[0]]
    profile = waves(linear, [[u, 0.0] for u in truth], 1, 3, noise=1e-4, coherent=True)
    grid = line(count=1801)
    options: dict[str, Any] = {"smoothing": (10, 1), "forward_backward": True}
    for power in (
        music(profile, linear, grid, sources=2, **options),
        music(profile, linear, grid, **options),
        capon(profile, linear, grid, loading=1e-4, **options),
    ):
        assert peaks(power, grid) == pytest.approx(truth, abs=0.05 * linear.beamwidth[0])
    with pytest.raises(InputError, match="at most 1 sources"):
        music(profile, linear, grid, sources=2)


def test_smoothing_of_a_plane(planar):
    """Two coherent sources that differ in v only."""
    truth = [[0.2, -0.15], [0.2, 0.25]]
    profile = waves(planar, truth, 1, 4, noise=1e-4, coherent=True)
    grid = replace(planar.grid(5, 5.1, oversample=4), range_count=1)
    power = music(profile, planar, grid, sources=2, smoothing=(8, 5), forward_backward=True)
    column = power[0, 0, int((grid.u - 0.2).abs().argmin())]
    found = grid.v[column[1:-1].gt(column[:-2]).logical_and(column[1:-1] >= column[2:]).nonzero()]
    values = column[1:-1][column[1:-1].gt(column[:-2]).logical_and(column[1:-1] >= column[2:])]
    best = sorted((found.ravel() + grid.v_step)[values.argsort(descending=True)[:2]].tolist())
    assert best == pytest.approx([-0.15, 0.25], abs=grid.v_step)


@pytest.mark.parametrize("method", [capon, music])
def test_movers_of_one_range_and_rate(method, waveform):
    """Doppler bins as frames, transmitters in turn compensated: two movers within 1.2 beams."""
    half, chirps = 0.5 * waveform.wavelength, Chirps(32, 50e-6)
    radar = Radar(
        linear_array(4, 4 * half),
        linear_array(4, half),
        waveform,
        torch.zeros(1, 3, dtype=torch.float64),
    )
    truth = [0.1, 0.1 + 1.2 * radar.beamwidth[0]]
    beat = torch.stack([moving_point(radar, chirps, 4.0, 3.0, u) for u in truth]).sum(0)
    cube = range_doppler(beat, radar, radar.grid(3, 5), chirps)
    cube = compensate_tdm(cube, radar, chirps)
    strongest = cube.abs().square().sum((0, 2, 3))
    rate, place = divmod(int(strongest.argmax()), cube.shape[-1])
    grid = line(count=1801)
    bins = cube.flatten(0, 1)[rate : rate + 1, None, :, :, place : place + 1]
    options = {"sources": 2} if method is music else {"loading": 1e-5}
    power = method(bins, radar, grid, smoothing=(10, 1), forward_backward=True, **options)
    assert peaks(power, grid) == pytest.approx(truth, abs=0.1 * radar.beamwidth[0])


def test_forward_backward_of_a_uniform_array_keeps_the_directions(linear):
    profile = waves(linear, [[0.3, 0.0], [-0.2, 0.0]], 50, 5, noise=1e-2)
    grid = line()
    power = music(profile, linear, grid, sources=2, forward_backward=True)
    assert peaks(power, grid) == pytest.approx([-0.2, 0.3], abs=grid.u_step)


def test_arrays_with_gaps_and_shared_places(waveform):
    """2 × 3 elements with a shared place and a gap: MUSIC works, smoothing is refused."""
    half = 0.5 * waveform.wavelength
    places = torch.tensor([[0.0, 0, 0], [0, 1, 0], [0, 3, 0]], dtype=torch.float64) * half
    radar = Radar(linear_array(2, half), AntennaArray(places), waveform, torch.zeros(1, 3).double())
    assert len(torch.unique(radar.virtual_positions[:, 1].mul(1e6).round())) == 5
    profile = waves(radar, [[0.3, 0.0]], 20, 6, noise=1e-3)
    grid = line()
    for power in (music(profile, radar, grid, sources=1), capon(profile, radar, grid)):
        assert peaks(power, grid, 1) == pytest.approx([0.3], abs=grid.u_step)
    # Places 0, 1, 2, 3, 4 in units of half a wavelength are uniform; without one they are not.
    gap = replace(radar, transmitters=linear_array(1, half))
    with pytest.raises(InputError, match="uniform rectangle"):
        music(profile[:, :, :1], gap, grid, sources=1, smoothing=(2, 1))
    with pytest.raises(InputError, match="uniform rectangle"):
        music(profile[:, :, :1], gap, grid, sources=1, forward_backward=True)


def test_empty_bins_have_no_power(linear):
    profile = torch.zeros(1, 4, 1, 16, 2, dtype=torch.complex128)
    profile[..., 1] = waves(linear, [[0.2, 0.0]], 4, 7)[..., 0]
    profile.requires_grad_()
    grid = replace(line(), range_count=2)
    power = capon(profile, linear, grid)
    assert power[0, 0].abs().max() == 0
    assert power[0, 1].max().item() == pytest.approx(1, rel=1e-2)
    pseudo = music(profile, linear, grid, sources=1)
    assert torch.isfinite(pseudo).all()
    (power.sum() + pseudo.log().sum()).backward()
    assert profile.grad is not None
    assert torch.isfinite(profile.grad).all()


@pytest.mark.parametrize("sources", [0, 1, 3])
def test_counting_sources(sources, linear):
    directions = [[-0.4, 0.0], [0.1, 0.0], [0.5, 0.0]][:sources]
    counts = []
    for seed in range(10):
        profile = waves(linear, directions, 400, seed, noise=0.1)[0, :, 0, :, 0]
        values = torch.linalg.eigvalsh(profile.T @ profile.conj() / 400)
        counts.append(int(source_count(values, 400)))
        assert int(source_count(values, 400, "aic")) >= counts[-1]
    assert counts.count(sources) >= 9


def test_counts_of_many_bins_at_once():
    values = torch.tensor([[1.0, 1.01, 0.99, 50.0], [1.0, 1.02, 30.0, 50.0], [0.0, 0, 0, 0]])
    assert source_count(values, 100).tolist() == [1, 2, 0]


def matrix_of(eigenvalues, seed=0):
    """Hermitian with these eigenvalues and random eigenvectors."""
    size = len(eigenvalues)
    generator = torch.Generator().manual_seed(seed)
    basis = torch.randn(size, size, dtype=torch.complex128, generator=generator)
    basis = torch.linalg.qr(basis).Q
    return basis @ torch.diag(torch.tensor(eigenvalues, dtype=torch.complex128)) @ basis.mH


SIGNAL = torch.tensor([False, False, True, True])


@pytest.mark.parametrize(
    "eigenvalues",
    [
        [0.1, 0.4, 2.0, 3.0],  # all apart
        [0.1, 0.1, 2.0, 3.0],  # equal noise
        [0.1, 0.4, 2.0, 2.0],  # equal signal
        [0.1, 0.1 + 1e-12, 2.0, 2.0 + 1e-12],  # close both
    ],
)
def test_gradient_of_the_projector(eigenvalues):
    """Right for equal eigenvalues too, as long as signal and noise are apart."""
    factor = torch.linalg.cholesky(matrix_of(eigenvalues)).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda root: MUSIC(root @ root.mH, SIGNAL),
        factor,
        eps=1e-6,
        atol=1e-6,
        check_forward_ad=True,
    )


@pytest.mark.parametrize("gap", [1e-3, 1e-6, 1e-10, 1e-15, 0.0])
def test_gradient_stays_finite_where_signal_meets_noise(gap):
    matrix = matrix_of([0.1, 1.0, 1.0 + gap, 3.0]).requires_grad_()
    weight = matrix_of([1.0, -2.0, 0.5, 0.3], seed=1)
    (MUSIC(matrix, SIGNAL) * weight).sum().real.backward()
    assert matrix.grad is not None
    assert torch.isfinite(matrix.grad).all()
    if gap == 1e-3:  # far outside the damping: the size of the true derivative
        assert 1e1 < matrix.grad.norm() < 1e4


@pytest.mark.parametrize("method", [capon, music])
def test_gradients(method, linear):
    grid = line(count=7)
    profile = waves(linear, [[0.2, 0.0], [-0.4, 0.0]], 6, 8, noise=0.05)
    options = {"sources": 2} if method is music else {}
    assert torch.autograd.gradcheck(
        lambda x: method(x, linear, grid, smoothing=(6, 1), forward_backward=True, **options),
        profile.requires_grad_(),
        fast_mode=True,
        atol=1e-5,
        check_forward_ad=True,
    )


def test_wrong_input(linear, planar, unchecked):
    grid = line()
    profile = waves(linear, [[0.2, 0.0]], 4, 9)
    for sources in (16, 40, -1):
        with pytest.raises(InputError, match="0 to 15 sources"):
            music(profile, linear, grid, sources=sources)
    with pytest.raises(InputError, match="0 to 3 sources"):
        music(profile, linear, grid, sources=4, smoothing=(4, 1))
    with pytest.raises(InputError, match="at most 4 sources"):
        music(profile, linear, grid, sources=5)
    with pytest.raises(InputError, match="16 snapshots"):
        music(profile, linear, grid)
    with pytest.raises(InputError, match="'guess'"):
        music(profile, linear, grid, sources="guess")
    for loading in (0.0, math.nan):
        with pytest.raises(InputError, match=r"loading \[mean power\] in \(0, inf\), got"):
            capon(profile, linear, grid, loading=loading)
    for smoothing in ((17, 1), (4, 2), (0, 1)):
        with pytest.raises(InputError, match="subarrays"):
            capon(profile, linear, grid, smoothing=smoothing)
    for wrong in (profile[0], profile[:, :0], profile[..., :9, :]):
        with pytest.raises(InputError, match=r"profile \(frame, snapshot, tx, rx, range\)"):
            capon(wrong, linear, grid)
    with pytest.raises(InputError, match="resolves v"):
        music(waves(planar, [[0.2, 0.0]], 4, 9), planar, grid)
