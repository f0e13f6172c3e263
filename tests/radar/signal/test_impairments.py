"""Impairments against closed forms and statistics."""

import math
from dataclasses import replace

import pytest
import torch

from invertwin.constants import BOLTZMANN, SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.radar import (
    ADC,
    FMCW,
    OFDM,
    Chirps,
    Impairments,
    Impulse,
    Leakage,
    PhaseNoise,
    PhysicsWarning,
    Radar,
    SteppedFrequency,
    add_noise,
    beat_signal,
    channel_errors,
    leakage_signal,
    moving_beat,
    noisy_oscillator_beat,
    quantize,
    range_profile,
    residual_phase,
)
from invertwin.radar.waveform import unit_window
from invertwin.scene.antenna import linear_array

LEVEL = -85.0
DENSITY = 2 * 10 ** (LEVEL / 10)  # S_φ of a flat L(f) of that level
FLAT = PhaseNoise((1e4, 1e7), (LEVEL, LEVEL))


def recorder(frames: int = 1, transmitters: int = 1, receivers: int = 1, waveform=None) -> Radar:
    """Sampled at 6.4 MHz; 0.6 m cells, 77 m unambiguous."""
    waveform = waveform or FMCW(76.5e9, 0.25e9, 20e-6, 128)
    half = 0.5 * waveform.wavelength
    return Radar(
        linear_array(transmitters, half, "z"),
        linear_array(receivers, half),
        waveform,
        torch.zeros(frames, 3, dtype=torch.float64),
    )


def scatterers(radar: Radar, point_paths, count: int = 40, seed: int = 0):
    """Points 3 to 70 m ahead in the first frame."""
    generator = torch.Generator().manual_seed(seed)
    across, ahead = torch.rand(2, count, generator=generator, dtype=torch.float64)
    points = torch.stack([3 + 67 * ahead, across - 0.5, 0 * across], 1)
    return point_paths(
        radar, points, torch.randn(count, dtype=torch.complex128, generator=generator)
    )


def test_off_by_default(point_paths):
    radar = recorder(receivers=3)
    paths = scatterers(radar, point_paths)
    assert torch.equal(Impairments().record(paths, radar, seed=1), beat_signal(paths, radar))


# ---------------------------------------------------------------------------------- phase noise


def test_density_of_points_and_of_a_slope():
    offsets = torch.tensor([1e3, 1e4, 1e5, 10**5.5, 1e6, 1e8], dtype=torch.float64)
    points = PhaseNoise((1e4, 1e5, 1e6), (-70.0, -80.0, -110.0)).density(offsets)
    level = 10 * torch.log10(points / 2)
    assert level.tolist() == pytest.approx([-70, -70, -80, -95, -110, -110])
    sloped = PhaseNoise((1e5,), (-90.0,)).density(offsets)
    expected = [-50, -70, -90, -100, -110, -150]
    assert (10 * torch.log10(sloped / 2)).tolist() == pytest.approx(expected)


@pytest.mark.parametrize("delay", [1e-8, 1e-7, 4e-7, 6e-7])
def test_range_correlation(delay):
    """The spectrum of what is left is S_φ(f) · 4 sin²(πfτ), its zeros included."""
    radar = recorder(frames=3000)
    residual = residual_phase(FLAT, radar, delay, seed=3)[:, 0]
    samples, interval = 128, 20e-6 / 128
    window = torch.hann_window(samples, dtype=torch.float64)
    power = torch.fft.rfft(residual * window).abs().square().mean(0)
    density = 2 * interval * power / window.square().sum()
    offsets = torch.fft.rfftfreq(samples, interval, dtype=torch.float64)
    expected = DENSITY * 4 * torch.sin(math.pi * offsets * delay).square()
    inner = slice(3, -3)
    # The window leaks a little of the density's curvature, and 3000 draws scatter by 2 %.
    assert (density - expected)[inner].abs().max() < 0.06 * expected.max()
    assert density[inner].sum() == pytest.approx(float(expected[inner].sum()), rel=0.01)


def test_residual_of_a_short_delay():
    """S_φ = h/f² leaves 4π² τ² h up to half the sampling rate; twice the delay, twice the phase."""
    radar = recorder(frames=500)
    noise = PhaseNoise((1e5,), (-80.0,))
    delay, highest = 1e-9, 3.2e6
    residual = residual_phase(noise, radar, delay, seed=2)
    h = 2 * 1e-8 * 1e10
    expected = 4 * math.pi**2 * delay**2 * h * highest
    assert residual.square().mean() == pytest.approx(expected, rel=0.02)
    doubled = residual_phase(noise, radar, 2 * delay, seed=2)
    assert (doubled - 2 * residual).norm() < 0.02 * doubled.norm()
    assert not residual_phase(noise, radar, 0.0, seed=2).any()


def test_frames_and_transmitters_have_their_own_noise():
    residual = residual_phase(FLAT, recorder(2, 2), 1e-7, seed=5)
    assert residual.shape == (2, 2, 128)
    rows = residual.reshape(4, -1)
    correlation = torch.corrcoef(rows) - torch.eye(4, dtype=torch.float64)
    assert correlation.abs().max() < 0.4
    assert torch.equal(residual_phase(FLAT, recorder(2, 2), 1e-7, seed=5), residual)
    assert not torch.equal(residual_phase(FLAT, recorder(2, 2), 1e-7, seed=6), residual)


def test_skirt_of_a_target(point_paths):
    """Beside its peak a target has L(f) · 4 sin²(πfτ) of its power per noise bandwidth."""
    frames, distance, peak = 600, 48 * 0.599584916, 48
    radar = replace(recorder(frames), window="hann")
    point = torch.tensor([distance, 0.0, 0.0]).expand(frames, 3)
    paths = point_paths(radar, point, torch.ones(frames), torch.arange(frames))
    level = -100.0
    beat = noisy_oscillator_beat(paths, radar, PhaseNoise((1e5, 1e6), (level, level)), seed=7)
    grid = radar.grid(0, 76, oversample=1)
    power = range_profile(beat, radar, grid)[:, 0, 0].abs().square().mean(0)
    assert power[peak] == pytest.approx(1, abs=0.003)
    beside = torch.arange(5, 40)
    offsets = beside / 20e-6
    factor = 4 * torch.sin(math.pi * offsets * 2 * distance / SPEED_OF_LIGHT).square()
    weight = unit_window("hann", 128)
    bandwidth = 6.4e6 * weight.square().sum() / weight.sum().square()
    expected = 10 ** (level / 10) * factor * bandwidth
    for side in (1, -1):
        ratio = power[peak + side * beside] / expected
        assert ratio.mean() == pytest.approx(1, abs=0.03)
        assert (ratio - 1).abs().max() < 0.25


@pytest.mark.parametrize(
    "waveform", [FMCW(76.5e9, 0.25e9, 20e-6, 128), SteppedFrequency(76e9, 1.9e6, 128, 2e-7)]
)
def test_every_path_has_the_residual_of_its_delay(waveform, point_paths):
    radar = recorder(transmitters=2, receivers=2, waveform=waveform)
    paths = scatterers(radar, point_paths)
    clean = beat_signal(paths, radar)
    found = noisy_oscillator_beat(paths, radar, FLAT, seed=9)
    expected = torch.zeros_like(clean)
    for row in range(len(paths)):
        one = replace(
            paths,
            **{
                name: getattr(paths, name)[row : row + 1]
                for name in ("frame", "delay", "coefficient", "power", "first", "last", "boundary")
            },
        )
        residual = residual_phase(FLAT, radar, float(paths.delay[row]), seed=9)
        turn = torch.polar(torch.ones_like(residual), residual)
        expected = expected + beat_signal(one, radar) * turn[:, :, None]
    assert (expected - clean).norm() > 0.03 * clean.norm()
    assert (found - expected).norm() < 0.005 * (expected - clean).norm()


def test_one_delay_and_no_paths(point_paths):
    radar = recorder()
    one = point_paths(radar, torch.tensor([20.0, 0, 0]), torch.ones(1))
    residual = residual_phase(FLAT, radar, float(one.delay[0]), seed=1)
    expected = (
        beat_signal(one, radar) * torch.polar(torch.ones_like(residual), residual)[:, :, None]
    )
    assert torch.allclose(noisy_oscillator_beat(one, radar, FLAT, seed=1), expected)
    none = point_paths(radar, torch.zeros(0, 3), torch.zeros(0))
    assert not noisy_oscillator_beat(none, radar, FLAT, seed=1).any()


def test_gradient_through_phase_noise(point_paths):
    """In coefficients and delays, against central differences."""
    radar = recorder()
    paths = scatterers(radar, point_paths, 10)
    generator = torch.Generator().manual_seed(4)
    coefficient_step = torch.randn(10, generator=generator, dtype=torch.complex128)
    delay_step = 1e-13 * torch.randn(10, generator=generator, dtype=torch.float64)
    weight = torch.randn(1, 1, 1, 128, generator=generator, dtype=torch.complex128)
    amount = torch.zeros((), dtype=torch.float64, requires_grad=True)

    def loss(t: torch.Tensor) -> torch.Tensor:
        moved = replace(
            paths,
            coefficient=paths.coefficient + t * coefficient_step,
            delay=paths.delay + t * delay_step,
        )
        beat = noisy_oscillator_beat(moved, radar, PhaseNoise((1e5,), (-60.0,)), seed=1)
        return (weight * beat).sum().abs().square()

    (gradient,) = torch.autograd.grad(loss(amount), amount)
    with torch.no_grad():
        ends = [loss(torch.tensor(t, dtype=torch.float64)) for t in (1e-4, -1e-4)]
    assert float(gradient) == pytest.approx(float(ends[0] - ends[1]) / 2e-4, rel=1e-4)


def test_range_warning_counts_all_paths_once(point_paths):
    radar = recorder()
    paths = point_paths(radar, torch.tensor([[20.0, 0, 0], [90, 0, 0]]), torch.ones(2))
    with pytest.warns(PhysicsWarning, match="1 of 2 paths") as caught:
        noisy_oscillator_beat(paths, radar, FLAT, seed=1)
    assert len(caught) == 1


# --------------------------------------------------------------------------- trains of chirps

TRAIN = Chirps(count=6, interval=30e-6)


def test_an_oscillator_runs_through_a_train():
    """Ramps without pauses are one record, whose spectrum is right far below 1 / ramp."""
    radar = recorder(frames=400)
    steep = PhaseNoise((1e3, 1e6, 1e7), (-30.0, -150.0, -150.0))
    count, samples, interval = 16, 128, 20e-6 / 128
    train = Chirps(count, 20e-6)
    delay = 4e-7
    residual = residual_phase(steep, radar, delay, seed=3, chirps=train)
    assert residual.shape == (400, count, 1, samples)
    whole = residual[:, :, 0].flatten(1)
    window = torch.hann_window(count * samples, dtype=torch.float64)
    power = torch.fft.rfft(whole * window).abs().square().mean(0)
    density = 2 * interval * power / window.square().sum()
    offsets = torch.fft.rfftfreq(count * samples, interval, dtype=torch.float64)
    # The lowest of them is a fifth of what a single ramp of 20 µs resolves.
    rows = torch.arange(3, 400)
    expected = steep.density(offsets[rows]) * 4 * torch.sin(math.pi * offsets[rows] * delay) ** 2
    ratio = density[rows] / expected
    assert ratio.mean() == pytest.approx(1, abs=0.02)
    assert (ratio - 1).abs().max() < 0.3  # 400 draws scatter by 5 %
    # So neighbouring ramps have nearly the same mean phase, ramps of frames by themselves none.
    means = residual[:, :, 0].mean(-1)
    assert torch.corrcoef(means[:, :2].T)[0, 1] > 0.5
    alone = residual_phase(steep, recorder(2, 400), delay, seed=3).mean(-1)
    assert torch.corrcoef(alone)[0, 1].abs() < 0.2


def test_transmitters_of_a_train_share_the_oscillator():
    """In turn they read it one after the other, at once they read the same."""
    radar = recorder(2, 3)
    turns = residual_phase(FLAT, radar, 1e-7, seed=5, chirps=TRAIN)
    assert turns.shape == (2, 6, 3, 128)
    order = residual_phase(FLAT, radar, 1e-7, seed=5, chirps=replace(TRAIN, order=(2, 0, 1)))
    assert torch.equal(order, turns[:, :, [1, 2, 0]])
    slots = residual_phase(FLAT, recorder(2), 1e-7, seed=5, chirps=replace(TRAIN, count=18))
    assert torch.equal(turns.flatten(1, 2), slots[:, :, 0])
    once = residual_phase(FLAT, radar, 1e-7, seed=5, chirps=replace(TRAIN, tdm=False))
    assert torch.equal(once[:, :, 0], once[:, :, 2])
    assert not torch.equal(turns[0], turns[1])


def test_phase_noise_of_a_train(point_paths):
    """Every path of a moving scene has the residual of its delay, in every ramp."""
    radar = recorder(transmitters=2, receivers=2)
    paths = scatterers(radar, point_paths, 12)
    paths = replace(paths, velocity=torch.tensor([[-20.0, 0.0, 1.0]]).double().expand(12, 3))
    clean = moving_beat(paths, radar, TRAIN)
    found = noisy_oscillator_beat(paths, radar, FLAT, seed=9, chirps=TRAIN)
    assert found.shape == (1, 6, 2, 2, 128)
    expected = torch.zeros_like(clean)
    columns = [n for n, v in vars(paths).items() if isinstance(v, torch.Tensor)]
    for row in range(len(paths)):
        one = replace(paths, **{name: getattr(paths, name)[row : row + 1] for name in columns})
        residual = residual_phase(FLAT, radar, float(paths.delay[row]), seed=9, chirps=TRAIN)
        turn = torch.polar(torch.ones_like(residual), residual)
        expected = expected + moving_beat(one, radar, TRAIN) * turn[..., None, :]
    assert (found - expected).norm() < 0.005 * (expected - clean).norm()


def test_a_train_with_everything(point_paths):
    radar = recorder(2, 2, 3)
    paths = point_paths(radar, torch.tensor([[20.0, 0, 0.5], [23, 1, 0]]), torch.tensor([3.0, 2j]))
    paths = replace(paths, velocity=torch.tensor([[-20.0, 0.0, 1.0]]).double().expand(2, 3))
    adc, leakage = ADC(10, 30.0), Leakage(2e-9, -3.0)
    everything = Impairments(FLAT, leakage, 0.5, 0.1, snr_db=20, adc=adc)
    found = everything.record(paths, radar, seed=11, chirps=TRAIN)
    assert found.shape == (2, 6, 2, 3, 128)
    analog = replace(everything, adc=None).record(paths, radar, seed=11, chirps=TRAIN)
    assert torch.equal(quantize(analog, radar, adc), found)
    quiet = replace(everything, adc=None, snr_db=None).record(paths, radar, seed=11, chirps=TRAIN)
    noise = analog - quiet
    assert noise.abs().square().mean() == pytest.approx(
        float(0.01 * quiet.abs().square().mean()), rel=0.05
    )
    # New in every chirp.
    pair = torch.view_as_real(noise[:, :2]).movedim(1, 0).flatten(1)
    assert torch.corrcoef(pair)[0, 1].abs() < 0.1
    # The same in every chirp: factors of the channels, here of leakage alone.
    none = point_paths(radar, torch.zeros(0, 3), torch.zeros(0))
    still = Impairments(leakage=leakage, gain_std_db=0.5, phase_std=0.1)
    direct = still.record(none, radar, seed=11, chirps=TRAIN)
    errors = replace(still, leakage=None)
    expected = errors.apply(leakage_signal(leakage, radar).expand_as(direct), radar, seed=11)
    assert torch.allclose(direct, expected)
    assert not torch.allclose(direct, leakage_signal(leakage, radar).expand_as(direct), rtol=0.01)


def test_impairments_of_a_finished_signal(point_paths):
    """Finished signals get what paths get; phase noise needs the paths and is refused."""
    radar = recorder(2, 2, 3)
    paths = scatterers(radar, point_paths, 10)
    some = Impairments(leakage=Leakage(2e-9, -3.0), phase_std=0.1, snr_db=20, adc=ADC(10, 40.0))
    for chirps in (None, TRAIN):
        beat = beat_signal(paths, radar) if chirps is None else moving_beat(paths, radar, chirps)
        expected = some.record(paths, radar, seed=4, chirps=chirps)
        assert torch.equal(some.apply(beat, radar, seed=4), expected)
    with pytest.raises(InputError, match="phase noise, which depends on the delay"):
        Impairments(FLAT).apply(beat_signal(paths, radar), radar, seed=4)


def test_saturation_of_a_train_is_warned_of(point_paths):
    radar = recorder()
    paths = scatterers(radar, point_paths, 10)
    with pytest.warns(PhysicsWarning, match=r"of 768 samples exceed"):
        Impairments(adc=ADC(10, 0.1)).record(paths, radar, seed=1, chirps=TRAIN)


# -------------------------------------------------------------------------------------- leakage


@pytest.mark.parametrize(
    "waveform",
    [
        FMCW(76.5e9, 0.25e9, 20e-6, 128),
        SteppedFrequency(76e9, 1.9e6, 128, 2e-7),
        OFDM(76e9, 1.9e6, 128),
    ],
)
def test_leakage_is_a_path_of_that_delay(waveform, point_paths):
    radar = recorder(waveform=waveform)
    distance = 0.9
    leakage = Leakage(2 * distance / SPEED_OF_LIGHT, -34.0)
    path = point_paths(
        radar,
        torch.tensor([distance, 0, 0], dtype=torch.float64),
        torch.full((1,), 10**-1.7, dtype=torch.float64),
    )
    expected = beat_signal(path, radar)
    assert (leakage_signal(leakage, radar) - expected).norm() < 1e-6 * expected.norm()
    none = point_paths(radar, torch.zeros(0, 3), torch.zeros(0))
    found = Impairments(leakage=leakage).record(none, radar, seed=0)
    assert (found - expected).norm() < 1e-6 * expected.norm()


def test_leakage_has_little_phase_noise(point_paths):
    """Range correlation: its short delay keeps its skirt below that of an echo as strong."""
    radar = recorder()
    none = point_paths(radar, torch.zeros(0, 3), torch.zeros(0))
    left = []
    for delay in (1e-9, 4e-8):
        leakage = Leakage(delay, -20.0)
        noisy = Impairments(phase_noise=FLAT, leakage=leakage).record(none, radar, seed=0)
        left.append((noisy - leakage_signal(leakage, radar)).norm())
    assert left[1] / left[0] == pytest.approx(40, rel=0.05)


# ------------------------------------------------------------------------------------- channels


def test_channel_errors():
    factors = channel_errors(recorder(1, 60, 60), 1.5, 0.2, seed=3)
    assert factors.shape == (60, 60)
    gain, phase = 20 * factors.abs().log10(), factors.angle()
    assert gain.std() == pytest.approx(1.5, rel=0.04)
    assert phase.std() == pytest.approx(0.2, rel=0.04)
    assert gain.mean().abs() < 0.08
    assert phase.mean().abs() < 0.011
    assert torch.corrcoef(torch.stack([gain.flatten(), phase.flatten()]))[0, 1].abs() < 0.06
    assert torch.equal(channel_errors(recorder(1, 2, 2), seed=3).real, torch.ones(2, 2).double())


# ------------------------------------------------------------------------------------ converter


@pytest.mark.parametrize("bits", [6, 10, 14])
def test_quantisation_noise_of_a_full_tone(bits):
    """6.02 dB per bit + 1.76 dB."""
    radar = recorder(waveform=FMCW(76.5e9, 0.25e9, 20e-6, 4096))
    phase = 2 * math.pi * 0.1234567 * torch.arange(4096, dtype=torch.float64)
    adc = ADC(bits, 0.5)
    beat = torch.polar(torch.full_like(phase, 0.5 - adc.step), phase)
    error = quantize(beat, radar, adc) - beat
    ratio = 10 * math.log10(float(beat.abs().square().sum() / error.abs().square().sum()))
    assert ratio == pytest.approx(6.02 * bits + 1.76, abs=0.4)
    assert torch.view_as_real(error).abs().max() <= adc.step / 2 * (1 + 1e-9)


def test_codes_and_saturation():
    radar, adc = recorder(), ADC(3, 1.0)
    ramp = torch.linspace(-0.95, 0.7, 128, dtype=torch.float64)
    codes = torch.view_as_real(quantize(torch.complex(ramp, 0 * ramp), radar, adc))[:, 0] / 0.25
    assert torch.equal(codes.unique(), torch.arange(-4.0, 4).double())
    again = quantize(torch.complex(codes * 0.25, 0 * codes), radar, adc)
    assert torch.equal(again.real, codes * 0.25)
    loud = torch.zeros(2, 2, 128, dtype=torch.complex64)
    loud[0, 0, :3] = torch.tensor([5 + 5j, -5j, 0.9])
    with pytest.warns(PhysicsWarning, match="3 of 512 samples exceed"):
        found = quantize(loud, radar, adc)
    assert found.dtype == torch.complex64
    assert found[0, 0, :4].tolist() == [0.75 + 0.75j, -1j, 0.75, 0]


def test_codes_have_no_derivative():
    beat = torch.zeros(1, 1, 1, 128, dtype=torch.complex128, requires_grad=True)
    with pytest.raises(InputError, match="quantise data only"):
        quantize(beat, recorder(), ADC(12, 1.0))


# --------------------------------------------------------------------------------------- record


def test_all_together_in_order(point_paths):
    radar = recorder(2, 2, 3)
    paths = scatterers(radar, point_paths)
    adc, leakage = ADC(12, 40.0), Leakage(2e-9, -3.0)
    everything = Impairments(FLAT, leakage, 0.5, 0.1, snr_db=20, adc=adc)
    found = everything.record(paths, radar, seed=11)
    assert torch.equal(everything.record(paths, radar, seed=11), found)
    assert not torch.equal(everything.record(paths, radar, seed=12), found)
    analog = replace(everything, adc=None).record(paths, radar, seed=11)
    assert torch.equal(quantize(analog, radar, adc), found)
    # Streams of their own: the phase noise and the channels are the same without the rest.
    quiet = replace(everything, adc=None, snr_db=None).record(paths, radar, seed=11)
    noise = analog - quiet
    assert noise.abs().square().mean() == pytest.approx(
        float(0.01 * quiet.abs().square().mean()), rel=0.1
    )
    plain = Impairments(FLAT, leakage).record(paths, radar, seed=11)
    factors = (quiet / plain)[:, :, :, :1]
    assert torch.allclose(plain * factors, quiet)
    assert torch.allclose(factors[0], factors[1])
    assert factors[0].flatten().angle().std() > 0.01


@pytest.mark.parametrize(
    ("waveform", "bandwidth"),
    [
        (FMCW(76.5e9, 0.25e9, 20e-6, 128), 128 / 20e-6),
        (SteppedFrequency(76e9, 1.9e6, 128, 2e-7), 1 / 2e-7),
        (OFDM(76e9, 1.9e6, 128), 128 * 1.9e6),
    ],
)
def test_thermal_noise_of_each_waveform(waveform, bandwidth, point_paths):
    radar = recorder(40, waveform=waveform)
    none = point_paths(radar, torch.zeros(0, 3), torch.zeros(0))
    noise = Impairments(noise_figure_db=10, transmit_power=0.1).record(none, radar, seed=1)
    expected = BOLTZMANN * 290 * 10 * bandwidth / 0.1
    assert noise.abs().square().mean() == pytest.approx(expected, rel=0.05)


def test_ofdm_noise_is_that_of_its_subcarriers(point_paths):
    """Noise on Y of kT0F·spacing at a power P/N per subcarrier is what add_noise gives."""
    waveform = OFDM(76e9, 1.9e6, 128)
    per_subcarrier = BOLTZMANN * 290 * waveform.spacing / (0.1 / 128)
    zeros = torch.zeros(60, 1, 1, 128, dtype=torch.complex128)
    radar = recorder(60, waveform=waveform)
    noise = add_noise(zeros, radar, seed=2, noise_figure_db=0, transmit_power=0.1)
    assert noise.abs().square().mean() == pytest.approx(per_subcarrier, rel=0.05)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PhaseNoise((), ()), "ascending offsets"),
        (lambda: PhaseNoise((0.0,), (-90.0,)), "offsets above 0, got 0.0"),
        (lambda: PhaseNoise((1e6, 1e5), (-90.0, -80.0)), "ascending offsets"),
        (lambda: PhaseNoise((1e5, 1e6), (-90.0,)), "expected 2 levels, got 1"),
        (lambda: PhaseNoise((1e5,), (90.0,)), "levels below 0, got 90"),
        (lambda: PhaseNoise((1e5,), (math.nan,)), "levels above -400, got nan"),
        (lambda: Leakage(1.0, -30.0), "did you mean 1e-9"),
        (lambda: Leakage(-1e-9, -30.0), "delay of at least 0, got -1e-09"),
        (lambda: Leakage(1e-9, 30.0), "level_db below 0, got 30"),
        (lambda: ADC(1, 1.0), "bits of at least 2, got 1"),
        (lambda: ADC(12, 0.0), "full_scale above 0, got 0"),
        (lambda: ADC(12, math.nan), "full_scale above 0, got nan"),
        (lambda: Impairments(gain_std_db=-1.0), "gain_std_db of at least 0, got -1"),
        (lambda: Impairments(snr_db=3.0, noise_figure_db=3.0), "got both"),
        (lambda: Impairments(noise_figure_db=-1.0), "noise_figure_db of at least 0, got -1"),
        (lambda: Impairments(transmit_power=0.0), "transmit_power above 0, got 0"),
        (lambda: channel_errors(recorder(), phase_std=-0.1, seed=0), "phase_std .rad. in"),
        (
            lambda: residual_phase(FLAT, recorder(waveform=OFDM(76e9, 2e6, 16)), 1e-8, seed=0),
            "one after the other in time, got OFDM",
        ),
        (
            lambda: quantize(
                torch.zeros(16, dtype=torch.complex128),
                recorder(waveform=OFDM(76e9, 2e6, 16)),
                ADC(12, 1.0),
            ),
            "one after the other in time, got OFDM",
        ),
        (
            lambda: leakage_signal(Leakage(1e-9, -30.0), recorder(waveform=Impulse(4e9, 1e9))),
            "no beat signal",
        ),
    ],
)
def test_impossible_values(make, message):
    with pytest.raises(InputError, match=message):
        make()
