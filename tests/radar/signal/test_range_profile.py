"""Beat signals against the plain sum, exact arithmetic and the radar equation."""

import math
from dataclasses import replace

import mpmath
import pytest
import torch
import torch.autograd.forward_ad as forward_ad

from invertwin.channel import Grid, Paths
from invertwin.constants import BOLTZMANN, SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.radar import (
    FMCW,
    OFDM,
    Impulse,
    PhysicsWarning,
    Radar,
    SteppedFrequency,
    add_noise,
    beat_signal,
    exact_spectrum,
    range_profile,
)
from invertwin.scene.antenna import linear_array
from invertwin.scene.pose import rotation_from_vector
from oracles.beat import beat as direct_beat


def cloud(count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    points = points * torch.tensor([3.0, 2.0, 1.0]) + torch.tensor([1.5, -1.0, -0.5])
    return points, torch.randn(count, generator=generator, dtype=torch.complex128)


def two_bounces(radar: Radar, count: int) -> Paths:
    """Paths over two points, spread over the radar's frames."""
    first, coefficient = cloud(count, 1)
    last, _ = cloud(count, 2)
    frame = torch.arange(count) % radar.frame_count
    link = radar.link()
    length = (first - link.tx[frame]).norm(dim=-1) + (last - link.rx[frame]).norm(dim=-1)
    length = length + (first - last).norm(dim=-1)
    zero = torch.zeros(count, dtype=torch.float64)
    return Paths(
        frame, length / SPEED_OF_LIGHT, coefficient, zero, first, last, "field", zero.bool()
    )


@pytest.fixture
def track(waveform: FMCW) -> Radar:
    """Two turned poses of a 2 × 3 MIMO radar, TX and RX beside each other."""
    half = 0.5 * waveform.wavelength
    rotations = torch.stack(
        [rotation_from_vector(torch.tensor(r).double()) for r in ([0.3, 0.1, 0.2], [0.1, 0, -0.4])]
    )
    receivers = linear_array(3, half)
    receivers = replace(receivers, positions=receivers.positions + torch.tensor([0, 0.05, 0.02]))
    positions = torch.tensor([[0, 0, 0], [-0.2, 0.3, 0.1]], dtype=torch.float64)
    return Radar(linear_array(2, half, "z"), receivers, waveform, positions, rotations)


@pytest.mark.parametrize(
    "changed", [None, SteppedFrequency(76e9, 16e6, 64, 1e-6), OFDM(76e9, 16e6, 64)]
)
def test_equals_the_plain_sum(changed, track):
    radar = replace(track, waveform=changed or track.waveform)
    paths = two_bounces(radar, 200)
    expected = direct_beat(paths, radar)
    found = beat_signal(paths, radar)
    assert found.shape == (2, 2, 3, 64)
    assert (found - expected).norm() < 1e-8 * expected.norm()


@pytest.mark.parametrize("samples", [63, 64])
def test_odd_and_even_sample_counts(point_paths, samples):
    half = SPEED_OF_LIGHT / 154e9
    radar = Radar(
        linear_array(1, half),
        linear_array(2, half),
        FMCW(77e9, 1e9, 4e-5, samples),
        torch.zeros(1, 3, dtype=torch.float64),
    )
    paths = point_paths(radar, *cloud(50))
    expected = direct_beat(paths, radar)
    assert (beat_signal(paths, radar) - expected).norm() < 1e-8 * expected.norm()


def test_threads_do_not_change_the_signal(track, point_paths):
    paths = point_paths(track, *cloud(100))
    before = torch.get_num_threads()
    signals = []
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            signals.append(beat_signal(paths, track))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(*signals)


def test_phase_at_200_m_in_exact_arithmetic(point_paths):
    """Two-way phase of 6e5 rad, to each element, against 40 digits."""
    waveform = FMCW(77e9, 0.3e9, 40e-6, 1024)
    half = 0.5 * waveform.wavelength
    radar = Radar(
        linear_array(2, half, "z"),
        linear_array(8, half),
        waveform,
        torch.tensor([[0.3, 0.1, 0.2]], dtype=torch.float64),
    )
    point = torch.tensor([[197.1, 31.7, -12.3]], dtype=torch.float64)
    paths = point_paths(radar, point, torch.tensor([1.0]))
    found = beat_signal(paths, radar)[0]
    tx, rx = radar.elements()
    mpmath.mp.dps = 40
    c = mpmath.mpf(SPEED_OF_LIGHT)
    slope = mpmath.mpf(waveform.bandwidth) / mpmath.mpf(waveform.duration)

    def distance(a, b):
        return mpmath.sqrt(sum((mpmath.mpf(a[i]) - mpmath.mpf(b[i])) ** 2 for i in range(3)))

    for t, r, n in ((0, 0, 0), (1, 7, 513), (0, 5, 1023)):
        target = point[0].tolist()
        length = distance(tx[0, t].tolist(), target) + distance(rx[0, r].tolist(), target)
        delay, time = length / c, mpmath.mpf(n) * mpmath.mpf(waveform.duration) / 1024
        cycles = waveform.start_frequency * delay + slope * delay * time - slope * delay**2 / 2
        angle = 2 * mpmath.pi * (cycles - mpmath.nint(cycles))
        expected = complex(mpmath.cos(angle), mpmath.sin(angle))
        assert abs(found[t, r, n].item() - expected) < 1e-5


# A low carrier, so that differences of the phase are accurate; the same code.
@pytest.mark.slow
@pytest.mark.parametrize(
    "waveform", [FMCW(1e9, 0.2e9, 1e-6, 12), SteppedFrequency(1e9, 16e6, 12, 1e-6)]
)
def test_gradients(waveform, track):
    paths = two_bounces(track, 4)
    radar = replace(track, waveform=waveform)

    def signal(coefficient, delay, first, last, positions):
        moved = replace(paths, coefficient=coefficient, delay=delay, first=first, last=last)
        return beat_signal(moved, replace(radar, positions=positions), tolerance=1e-13)

    # The delay in nanoseconds keeps all derivatives of one order.
    inputs = [paths.coefficient, paths.delay * 1e9, paths.first, paths.last, radar.positions]
    inputs = [value.clone().requires_grad_() for value in inputs]
    assert torch.autograd.gradcheck(
        lambda a, d, *rest: signal(a, d * 1e-9, *rest),
        inputs,
        eps=1e-6,
        atol=1e-4,
        rtol=1e-5,
        check_forward_ad=True,
    )


def test_gradient_at_77_ghz_equals_autodiff_of_the_plain_sum(track):
    paths = two_bounces(track, 60)
    grads = []
    for forward in (beat_signal, direct_beat):
        leaves = [
            value.clone().requires_grad_()
            for value in (paths.coefficient, paths.delay, paths.first, paths.last)
        ]
        named = dict(zip(("coefficient", "delay", "first", "last"), leaves, strict=True))
        signal = forward(replace(paths, **named), track)
        target = torch.linspace(0, 1, 64) * (1 + 0.5j)
        (signal - target).abs().square().sum().backward()
        grads.append([leaf.grad for leaf in leaves])
    for found, expected in zip(*grads, strict=True):
        assert (found - expected).norm() < 1e-7 * expected.norm()


@pytest.mark.parametrize("samples", [63, 64])
def test_values_and_gradients_in_both_modes_equal_the_plain_sum(samples, track):
    wave = FMCW(76.5e9, 1e9, 40e-6, samples)
    radar = replace(track, waveform=wave)
    paths = two_bounces(radar, 60)
    grads, signals = [], []
    for forward in (direct_beat, beat_signal):
        leaves = [
            value.clone().requires_grad_()
            for value in (paths.coefficient, paths.delay, paths.first, paths.last)
        ]
        named = dict(zip(("coefficient", "delay", "first", "last"), leaves, strict=True))
        signals.append(forward(replace(paths, **named), radar))
        (signals[-1] - (1 + 0.5j)).abs().square().sum().backward()
        grads.append([leaf.grad for leaf in leaves])
    assert (signals[1] - signals[0]).norm() < 1e-8 * signals[0].norm()
    for expected, found in zip(*grads, strict=True):
        assert (found - expected).norm() < 1e-7 * expected.norm()
    tangents = []
    for forward in (direct_beat, beat_signal):
        with forward_ad.dual_level():
            late = forward_ad.make_dual(paths.delay, 1e-12 * torch.ones_like(paths.delay))
            signal = forward(replace(paths, delay=late), radar)
            tangents.append(forward_ad.unpack_dual(signal).tangent)
    assert tangents[0] is not None
    assert (tangents[1] - tangents[0]).norm() < 1e-7 * tangents[0].norm()
    none = paths.select(torch.zeros(0, dtype=torch.int64))
    assert not beat_signal(none, radar).any()


@pytest.mark.gpu
def test_sums_on_a_gpu(track):
    pytest.importorskip("cufinufft")
    if not torch.cuda.is_available():
        pytest.skip("needs an NVIDIA GPU")
    paths = two_bounces(track, 200)
    columns = {n: v.cuda() for n, v in vars(paths).items() if isinstance(v, torch.Tensor)}
    found = beat_signal(replace(paths, **columns), track)
    expected = beat_signal(paths, track)
    assert found.is_cuda
    assert (found.cpu() - expected).norm() < 1e-8 * expected.norm()


def test_twelve_channels_of_256_samples(point_paths):
    """Against the float64 sum, by the peak; `benchmarks/signals.py` has a million paths."""
    half = SPEED_OF_LIGHT / 154e9
    radar = Radar(
        linear_array(3, 4 * half),
        linear_array(4, half),
        FMCW(76.5e9, 1e9, 51.2e-6, 256),
        torch.zeros(1, 3, dtype=torch.float64),
    )
    points, coefficient = cloud(3_000, 5)
    paths = point_paths(radar, 7 * points, coefficient)
    expected = direct_beat(paths, radar)
    error = (beat_signal(paths, radar) - expected).abs().max()
    assert error < 1e-8 * expected.abs().max()


def test_no_paths_and_empty_frames(track, point_paths):
    empty = point_paths(track, torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0))
    assert torch.equal(beat_signal(empty, track), torch.zeros(2, 2, 3, 64).to(torch.complex128))
    points, coefficient = cloud(5)
    frame = torch.ones(5, dtype=torch.int64)
    coefficient = coefficient.clone().requires_grad_()
    signal = beat_signal(point_paths(track, points, coefficient, frame), track)
    assert signal[0].abs().max() == 0
    assert signal[1].abs().min() > 0
    signal.abs().sum().backward()
    assert coefficient.grad is not None
    # |s| is homogeneous in the coefficients: Euler's theorem, Re Σ a* ∂L/∂a = L.
    slope = (coefficient.detach().conj() * coefficient.grad).real.sum()
    torch.testing.assert_close(slope, signal.detach().abs().sum())


def test_zero_amplitude_boundary_paths_carry_gradient(track, point_paths):
    points, coefficient = cloud(6)
    extra = torch.zeros(1, dtype=torch.complex128, requires_grad=True)
    all_points = torch.cat([points, points[:1] + 0.01])
    paths = point_paths(track, all_points, torch.cat([coefficient, extra]))
    signal = beat_signal(paths, track)
    signal.abs().square().sum().backward()
    # A beat signal is linear in the conjugate of the coefficients: of Σ |s + a* b|² at a = 0, b the
    # signal of the path alone, 2 Σ s* b.
    alone = beat_signal(point_paths(track, all_points[-1:], torch.ones(1)), track)
    assert extra.grad is not None
    torch.testing.assert_close(extra.grad[0], 2 * (signal.detach().conj() * alone).sum())


@pytest.mark.parametrize("fractional", [False, True])
def test_radar_equation(point_paths, linear, fractional):
    """Point target of 1 m² at 4 m: peak within 0.1 bin and 0.2 dB of P_t G² λ² σ/((4π)³R⁴)."""
    waveform = linear.waveform
    distance = 4.0 + (0.37 * waveform.range_resolution if fractional else 0.0)
    gain, area = 10.0, 1.0
    expected = gain**2 * waveform.wavelength**2 * area / ((4 * math.pi) ** 3 * distance**4)
    direction = torch.tensor([math.sqrt(1 - 0.09), 0.3, 0.0], dtype=torch.float64)
    coefficient = torch.tensor([math.sqrt(expected) * complex(math.cos(1), math.sin(1))])
    paths = point_paths(linear, direction * distance, coefficient)
    grid = linear.grid(3, 5, oversample=16)
    power = exact_spectrum(beat_signal(paths, linear), linear, grid)[0, :, :, 0]
    peak = int(power.argmax())
    row, column = divmod(peak, grid.u_count)
    assert abs(grid.ranges[row] - distance) < 0.1 * waveform.range_resolution
    assert abs(grid.u[column] - 0.3) < 0.1 * linear.beamwidth[0]
    assert abs(10 * math.log10(power.max() / expected)) < 0.2


def test_near_field_lengths_are_exact(point_paths, waveform):
    """At half the aperture's length from the array, phases follow spheres, not planes."""
    radar = Radar(
        linear_array(1, 1.0),
        linear_array(64, waveform.wavelength / 2),
        waveform,
        torch.zeros(1, 3, dtype=torch.float64),
    )
    point = torch.tensor([0.06, 0.02, 0.01], dtype=torch.float64)
    signal = beat_signal(point_paths(radar, point, torch.tensor([1.0])), radar)
    tx, rx = radar.elements()
    length = (point - tx[0, 0]).norm() + (point - rx[0]).norm(dim=-1)
    delay = length / SPEED_OF_LIGHT
    cycles = waveform.start_frequency * delay - 0.5 * waveform.slope * delay.square()
    expected = torch.polar(torch.ones_like(cycles), 2 * math.pi * cycles)
    assert (signal[0, 0, :, 0] - expected).abs().max() < 1e-8
    plane = length.mean() - radar.virtual_positions[:, 1] * point[1] / point.norm()
    assert (plane - length).abs().max() > waveform.wavelength


def test_phase_falls_as_the_element_moves_towards_the_target(point_paths, linear):
    """Beat coefficient conj(a), phase +2π f0 τ: shorter delay, lower phase."""
    signal = beat_signal(
        point_paths(linear, torch.tensor([3.0, 3.0, 0]), torch.tensor([1j])), linear
    )
    step = (signal[0, 0, 1:, 0] * signal[0, 0, :-1, 0].conj()).angle().mean()
    assert step == pytest.approx(-math.pi * math.sqrt(0.5), rel=0.05)
    one = linear.frames([0])
    plain = beat_signal(point_paths(one, torch.tensor([3.0, 3.0, 0]), torch.tensor([1.0])), one)
    assert torch.allclose(signal, -1j * plain)


def test_fft_equals_matrix(point_paths, linear):
    signal = beat_signal(point_paths(linear, *cloud(30)), linear)
    grid = linear.grid(1, 4)
    nudged = replace(grid, range_start=grid.range_start + 1e-6)
    by_fft, by_matrix = (range_profile(signal, linear, g) for g in (grid, nudged))
    assert by_fft.shape == (1, 1, 16, grid.range_count)
    assert (by_fft - by_matrix).norm() < 1e-3 * by_fft.norm()
    assert not torch.equal(by_fft, by_matrix)


def test_ofdm_in_the_time_domain(point_paths):
    """Symbols, inverse FFT, cyclic prefix, two echoes, FFT, division: the beat signal of paths."""
    waveform, prefix = OFDM(76e9, 2e6, 64), 24
    one = linear_array(1, 1.0)
    radar = Radar(one, one, waveform, torch.zeros(1, 3, dtype=torch.float64), window="rectangular")
    generator = torch.Generator().manual_seed(1)
    levels = torch.randint(0, 4, (2, 64), generator=generator).double() * 2 - 3
    symbols = torch.complex(*levels) / math.sqrt(10)
    sent = torch.fft.ifft(symbols)
    sent = torch.cat([sent[-prefix:], sent])
    coefficient = torch.tensor([0.7 - 0.2j, 0.3j], dtype=torch.complex128)
    shifts = torch.tensor([5, 19])
    delays = shifts.double() / waveform.bandwidth
    echoes = torch.zeros_like(sent)
    for shift, delay, a in zip(shifts.tolist(), delays, coefficient, strict=True):
        carrier = torch.exp(-2j * math.pi * (waveform.start_frequency * delay % 1))
        echoes[shift:] += a * carrier * sent[: len(sent) - shift]
    received = torch.fft.fft(echoes[prefix:])
    found = waveform.beat(received, symbols)
    points = torch.zeros(2, 3, dtype=torch.float64)
    points[:, 0] = shifts.double() * waveform.range_resolution
    expected = beat_signal(point_paths(radar, points, coefficient), radar)
    assert (found - expected).norm() < 1e-6 * expected.norm()
    assert torch.allclose(waveform.receive_symbols(expected[0, 0, 0], symbols), received, atol=1e-6)
    # The range profile is the inverse FFT of Y/X.
    grid = radar.grid(0, 63 * waveform.range_resolution, oversample=1)
    profile = range_profile(found.expand(1, 1, 1, -1), radar, grid)[0, 0, 0]
    assert torch.allclose(profile, torch.fft.ifft(received / symbols).conj())
    assert profile.abs().topk(2).indices.tolist() == [5, 19]
    assert profile.abs()[[5, 19]].tolist() == pytest.approx(coefficient.abs().tolist())


def test_ofdm_symbols_must_fit():
    waveform = OFDM(76e9, 2e6, 16)
    samples = torch.ones(2, 16, dtype=torch.complex128)
    with pytest.raises(InputError, match="expected 16 symbols, got 15"):
        waveform.receive_symbols(samples[:, :15], samples[0, :15])
    with pytest.raises(InputError, match="got 1 zeros of 16"):
        waveform.beat(samples, torch.arange(16.0).to(torch.complex128))


def test_profile_of_a_target_on_a_bin_is_its_coefficient(point_paths, linear):
    radar = replace(linear, receivers=linear_array(1, 1.0))
    grid = radar.grid(1, 4)
    distance = float(grid.ranges[11])
    paths = point_paths(radar, torch.tensor([distance, 0, 0]), torch.tensor([2.5e-3]))
    profile = range_profile(beat_signal(paths, radar), radar, grid)[0, 0, 0].abs()
    assert profile.argmax() == 11
    assert profile[11] == pytest.approx(2.5e-3, rel=1e-6)


def test_single_precision_profile(point_paths, linear):
    signal = beat_signal(point_paths(linear, *cloud(30)), linear)
    grid = linear.grid(1, 4)
    double, single = (exact_spectrum(s, linear, grid) for s in (signal, signal.to(torch.complex64)))
    assert single.dtype == torch.float32
    assert (single - double).abs().max() < 1e-5 * double.max()


def test_noise_levels(linear):
    ones = torch.full((1, 1, 16, 64), 3.0, dtype=torch.complex128).expand(40, -1, -1, -1)
    noise = add_noise(ones, snr_db=10, seed=3) - ones
    assert noise.abs().square().mean() == pytest.approx(0.9, rel=0.03)
    assert noise.real.square().mean() == pytest.approx(0.45, rel=0.03)
    assert noise.mean().abs() < 0.02
    assert torch.equal(add_noise(ones, snr_db=10, seed=3) - ones, noise)
    assert not torch.equal(add_noise(ones, snr_db=10, seed=4) - ones, noise)
    zeros = 0 * ones
    thermal = add_noise(zeros, linear, noise_figure_db=12, transmit_power=0.02, seed=3)
    rate = 64 / 40e-6
    expected = BOLTZMANN * 290 * 10**1.2 * rate / 0.02
    assert thermal.abs().square().mean() == pytest.approx(expected, rel=0.03)
    assert torch.equal(add_noise(zeros, snr_db=10, seed=3), zeros)


def test_noise_needs_one_level(linear):
    beat = torch.zeros(1, 1, 16, 64, dtype=torch.complex128)
    for levels in ({}, {"snr_db": 3.0, "noise_figure_db": 3.0}):
        with pytest.raises(InputError, match="exactly one"):
            add_noise(beat, linear, seed=0, **levels)
    with pytest.raises(InputError, match="expected a radar"):
        add_noise(beat, noise_figure_db=3.0, seed=0)


def test_beyond_the_unambiguous_range_warns(point_paths, linear):
    paths = point_paths(linear, torch.tensor([10.0, 0, 0]), torch.tensor([1.0]))
    with pytest.warns(PhysicsWarning, match=r"1 of 1 paths .* 9\.59 m"):
        beat_signal(paths, linear)


def test_wrong_input(point_paths, linear):
    paths = point_paths(linear, *cloud(3))
    with pytest.raises(InputError, match="field paths"):
        beat_signal(replace(paths, kind="power"), linear)
    with pytest.raises(InputError, match=r"path frames in 0\.\.0"):
        beat_signal(replace(paths, frame=paths.frame + 1), linear)
    with pytest.raises(InputError, match="no beat signal"):
        beat_signal(paths, replace(linear, waveform=Impulse(77e9, 1e9)))
    with pytest.raises(InputError, match=r"beat signal \(frame, tx, rx, sample\) of shape"):
        range_profile(torch.zeros(1, 1, 16, 65, dtype=torch.complex128), linear, Grid(1, 0.1, 9))


def test_a_range_bias_is_refused(linear, point_paths):
    paths = point_paths(linear, *cloud(3))
    zero = torch.zeros((), dtype=torch.float64, requires_grad=True)
    for bias in (0.1, zero):
        with pytest.raises(InputError, match="expected range_bias 0 for exact signals"):
            beat_signal(paths, replace(linear, range_bias=bias))
