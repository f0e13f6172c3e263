"""The surrogate against the exact simulation, and the shape of each kernel."""

import math
from dataclasses import dataclass, replace

import pytest
import torch

from invertwin.channel import Grid, Sampling, deposit_power, trace_field
from invertwin.errors import InputError
from invertwin.radar import (
    FMCW,
    OFDM,
    SURROGATES,
    Impulse,
    Radar,
    SampledWaveform,
    SteppedFrequency,
    Surrogate,
    Waveform,
    airy,
    beat_signal,
    exact_spectrum,
    normalized_gaussian,
    resolve_surrogate,
    surrogate_spectrum,
)
from invertwin.radar.surrogate.point_spread import range_point_spread
from invertwin.scene import Object, RoughDielectric, Scene, plate, rigid, rotation_from_vector
from invertwin.scene.antenna import AntennaArray, linear_array
from oracles.bspline import deposit


def cloud(count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Points 4–5 m away within 0.3 in u and v, and their powers."""
    generator = torch.Generator().manual_seed(seed)
    u, v, r = torch.rand(3, count, generator=generator, dtype=torch.float64)
    u, v, r = 0.6 * u - 0.3, 0.6 * v - 0.3, 4 + r
    points = r[:, None] * torch.stack([(1 - u**2 - v**2).sqrt(), u, v], 1)
    return points, 0.2 + torch.rand(count, generator=generator, dtype=torch.float64)


def deposited(points: torch.Tensor, power: torch.Tensor, grid: Grid) -> torch.Tensor:
    r = points.norm(dim=-1)
    return deposit(power, r, points[:, 1] / r, points[:, 2] / r, grid)[None]


def expected_exact(radar: Radar, points, power, grid, point_paths) -> torch.Tensor:
    """E|spectrum|² over independent uniform phases is the sum over the points, one by one."""
    count = len(points)
    copies = replace(radar, positions=radar.positions.expand(count, 3))
    paths = point_paths(copies, points, power.sqrt(), torch.arange(count))
    return exact_spectrum(beat_signal(paths, copies), copies, grid).sum(0, keepdim=True)


def hexagon(radar: Radar) -> Radar:
    places = radar.receivers.positions
    inside = (places / places.amax(0).clamp(min=1e-9))[:, 1:].norm(dim=-1) < 1.1
    return replace(radar, receivers=AntennaArray(places[inside]))


@pytest.mark.parametrize("array", ["planar", "mimo", "hexagon", "linear"])
def test_mean_exact_spectrum_is_the_surrogate(array, planar, mimo, linear, point_paths):
    radar = {"planar": planar, "mimo": mimo, "hexagon": hexagon(planar), "linear": linear}[array]
    points, power = cloud(60)
    grid = radar.grid(3.5, 5.5, 0.7, 0.7)
    exact = expected_exact(radar, points, power, grid, point_paths)
    smooth = Surrogate().shape(deposited(points, power, grid), radar, grid)
    assert (exact - smooth).norm() < 0.02 * exact.norm()
    assert (exact - smooth).abs().max() < 0.02 * exact.max()
    assert smooth.sum() == pytest.approx(float(exact.sum()), rel=0.005)


# A rectangular window fills the whole band of the power profile: it asks for finer bins.
@pytest.mark.parametrize(("window", "oversample"), [("hamming", 2), ("rectangular", 3)])
@pytest.mark.parametrize(
    "chosen",
    [FMCW(77e9, 1e9, 20e-6, 48), SteppedFrequency(76.5e9, 20e6, 50, 1e-6), OFDM(76.5e9, 16e6, 61)],
)
def test_the_surrogate_follows_every_waveform(chosen, window, oversample, linear, point_paths):
    radar = replace(linear, waveform=chosen, window=window)
    points, power = cloud(40)
    grid = radar.grid(3, 6, 0.7, oversample=oversample)
    exact = expected_exact(radar, points, power, grid, point_paths)
    smooth = Surrogate().shape(deposited(points, power, grid), radar, grid)
    assert (exact - smooth).norm() < 0.02 * exact.norm()
    assert (exact - smooth).abs().max() < 0.02 * exact.max()


def test_the_surrogate_follows_a_waveform_of_ones_own(linear, point_paths):
    """Frequencies are all it takes: the exact simulation and the kernel come with them."""

    @dataclass(frozen=True)
    class Falling(SampledWaveform):
        start_frequency: float = 76.5e9
        samples: int = 40
        step: float = 25e6
        bandwidth: float = 1e9
        center_frequency: float = 77e9
        noise_bandwidth: float = 1e6
        residual_slope: float = -1e13  # pyright: ignore[reportIncompatibleMethodOverride]

    radar = replace(linear, waveform=Falling())
    points, power = cloud(40)
    grid = radar.grid(3, 5.9, 0.7)
    exact = expected_exact(radar, points, power, grid, point_paths)
    smooth = Surrogate().shape(deposited(points, power, grid), radar, grid)
    assert (exact - smooth).norm() < 0.02 * exact.norm()


def test_a_pulse_of_ones_own(linear):
    @dataclass(frozen=True)
    class Triangle(Waveform):
        center_frequency: float = 4e9
        bandwidth: float = 1e9

        def range_response(self, distance, window):
            return (1 - distance.abs() / 0.6).clamp_min(0)

    radar = replace(linear, waveform=Triangle(), receivers=linear_array(1, 1.0))
    grid = radar.grid(3, 6, oversample=4)
    place = grid.ranges[20:21]
    zero = torch.zeros(1, dtype=torch.float64)
    spread = deposit(torch.ones(1, dtype=torch.float64), place, zero, zero, grid)
    shaped = Surrogate().shape(spread[None], radar, grid)[0, :, 0, 0]
    expected = (1 - (grid.ranges - place).abs() / 0.6).clamp_min(0)
    assert (shaped - expected).abs().max() < 0.02


@pytest.mark.claim
@pytest.mark.slow
def test_mean_over_phase_seeds(linear, point_paths):
    """The mean by brute force: 400 draws of the phases of one cloud, one per frame."""
    seeds = 400
    points, power = cloud(300, 1)
    copies = replace(linear, positions=linear.positions.expand(seeds, 3))
    generator = torch.Generator().manual_seed(5)
    angle = 2 * math.pi * torch.rand(seeds * 300, generator=generator, dtype=torch.float64)
    coefficient = torch.polar(power.sqrt().repeat(seeds), angle)
    frame = torch.arange(seeds).repeat_interleave(300)
    paths = point_paths(copies, points.repeat(seeds, 1), coefficient, frame)
    grid = linear.grid(3.5, 5.5, 0.7)
    mean = exact_spectrum(beat_signal(paths, copies), copies, grid).mean(0)
    smooth = Surrogate().shape(deposited(points, power, grid), linear, grid)[0]
    assert mean.sum() == pytest.approx(float(smooth.sum()), rel=0.02)
    assert (mean - smooth).mean().abs() < 0.02 * smooth.max()
    # What is left is speckle: 1/√seeds per bin.
    assert (mean - smooth).norm() < 1.3 / math.sqrt(seeds) * smooth.norm()


def test_the_windows_are_part_of_the_kernel(planar, point_paths):
    radar = replace(planar, window="hann", array_window="rectangular")
    points, power = cloud(30)
    grid = radar.grid(3.5, 5.5, 0.7, 0.7)
    exact = expected_exact(radar, points, power, grid, point_paths)
    for used, limit in ((radar, 0.02), (planar, None)):
        smooth = Surrogate().shape(deposited(points, power, grid), used, grid)
        error = (exact - smooth).norm() / exact.norm()
        assert error < limit if limit else error > 0.1


def test_dirichlet_is_the_response_without_a_window(linear, point_paths):
    """Whatever the radar's window is: the exact simulation of the same paths, untapered."""
    points, power = cloud(40)
    bare = replace(linear, window="rectangular")
    grid = linear.grid(3, 6, 0.7, oversample=3)
    exact = expected_exact(bare, points, power, grid, point_paths)
    spread = deposited(points, power, grid)
    smooth = Surrogate(range_kernel="dirichlet").shape(spread, linear, grid)
    assert (exact - smooth).norm() < 0.02 * exact.norm()
    assert (exact - Surrogate().shape(spread, linear, grid)).norm() > 0.1 * exact.norm()


def test_gaussian_kernel_is_the_papers_normalised_one(linear):
    """Inside of a grid the sum over bins is a constant, so the derivative is the same too."""
    radar = replace(linear, receivers=linear_array(1, 1.0))
    grid = radar.grid(3, 6, oversample=6)
    sigma = radar.waveform.range_resolution / math.sqrt(8 * math.log(2))
    place = torch.tensor([4.5 + 0.3 * grid.range_step], dtype=torch.float64, requires_grad=True)
    zero = torch.zeros(1, dtype=torch.float64)

    def shaped(where):
        spread = deposit(torch.ones(1, dtype=torch.float64), where, zero, zero, grid)[None]
        return Surrogate(range_kernel="gaussian").shape(spread, radar, grid)[0, :, 0, 0]

    peak = sigma * math.sqrt(2 * math.pi) / grid.range_step
    printed = peak * normalized_gaussian(place, grid.ranges, sigma)[0]
    assert (shaped(place) - printed).abs().max() < 2e-3
    weight = torch.linspace(-1, 1, grid.range_count, dtype=torch.float64).square()
    slopes = [
        torch.autograd.grad((weight * kernel).sum(), place)[0]
        for kernel in (shaped(place), printed)
    ]
    assert torch.allclose(*slopes, rtol=2e-3)


def half_width(profile: torch.Tensor, step: float) -> float:
    """Full width at half maximum by linear interpolation."""
    peak = int(profile.argmax())
    right = peak + int((profile[peak:] < profile[peak] / 2).nonzero()[0])
    fraction = (profile[right - 1] - profile[peak] / 2) / (profile[right - 1] - profile[right])
    return 2 * step * (right - 1 + float(fraction) - peak)


@pytest.mark.parametrize("kernel", ["gaussian", "response", "dirichlet"])
def test_range_kernel_width_and_peak(kernel, linear):
    radar = replace(linear, receivers=linear_array(1, 1.0))
    grid = radar.grid(3, 6, oversample=16)
    power = torch.zeros(1, *grid.shape, dtype=torch.float64)
    power[0, 170] = 2.0
    profile = Surrogate(range_kernel=kernel).shape(power, radar, grid)[0, :, 0, 0]
    cell = radar.waveform.range_resolution
    # −3 dB width of the Hamming window: 1.30 cells of its transform; of no window 0.886.
    width = {"gaussian": 1.0, "response": 1.30, "dirichlet": 0.886}[kernel]
    assert profile.argmax() == 170
    assert profile.max() == pytest.approx(2, rel=0.01)
    assert half_width(profile, grid.range_step) == pytest.approx(width * cell, rel=0.02)


def test_bspline_adds_no_blur(linear):
    """Wherever the point falls between the bins, the shaped deposit is the point spread."""
    radar = replace(linear, receivers=linear_array(1, 1.0))
    grid = radar.grid(3, 6)
    zero = torch.zeros(1, dtype=torch.float64)
    for distance in (4.5, 4.5 + 0.3 * grid.range_step, 4.5 + 0.5 * grid.range_step):
        place = torch.tensor([distance], dtype=torch.float64)
        spread = deposit(torch.ones(1, dtype=torch.float64), place, zero, zero, grid)
        shaped = Surrogate().shape(spread[None], radar, grid)[0, :, 0, 0]
        expected = range_point_spread(radar.waveform, grid.ranges - distance)
        assert (shaped - expected).abs().max() < 0.02


def test_airy_kernel(planar):
    """A point between the bins comes out as (2 J1(z)/z)² of an ellipse that fills the array."""
    grid = planar.grid(3.8, 4.2, 0.9, 0.9)
    distance = grid.ranges[2:3]
    u, v = torch.tensor([0.111], dtype=torch.float64), torch.tensor([-0.2], dtype=torch.float64)
    spread = deposit(torch.ones(1, dtype=torch.float64), distance, u, v, grid)[None]
    k = 2 * math.pi / planar.waveform.wavelength
    for radius in (None, 0.008):
        surrogate = Surrogate(angle_kernel="airy", aperture_radius=radius)
        shaped = surrogate.shape(spread, planar, grid)[0, 2]
        along, across = (0.5 * size if radius is None else radius for size in planar.aperture)
        z = k * torch.hypot(along * (grid.u - u)[:, None], across * (grid.v - v)[None])
        assert (shaped / shaped.max() - airy(z) / airy(z).max()).abs().max() < 0.02


def test_airy_along_one_axis(linear):
    grid = linear.grid(4, 4.2, 0.9, oversample=8)
    power = torch.zeros(1, *grid.shape, dtype=torch.float64)
    power[0, 4, grid.u_count // 2, 0] = 1
    shaped = Surrogate(angle_kernel="airy").shape(power, linear, grid)[0, 4, :, 0]
    # Half-power width of (2 J1(z)/z)²: z = ±1.6163, with r half the aperture D.
    width = 2 * 1.6163 / math.pi * linear.beamwidth[0]
    assert half_width(shaped, grid.u_step) == pytest.approx(width, rel=0.01)


@pytest.mark.parametrize("angle_kernel", ["response", "airy"])
def test_nothing_wraps(angle_kernel, planar):
    grid = planar.grid(4, 5, 0.6, 0.6)
    for corner in ((0, 0, 0), (-1, -1, -1)):
        power = torch.zeros(1, *grid.shape)
        power[(0, *corner)] = 1
        shaped = Surrogate(angle_kernel=angle_kernel, range_width=1.0, angle_width=0.5).shape(
            power, planar, grid
        )[0]
        opposite = shaped.flip(0, 1, 2)[corner]
        assert opposite.abs() < 1e-3 * shaped.max()
        assert shaped.argmax() == power[0].argmax()


def test_extra_widths(linear):
    """Blurring the exact map equals shaping with the wider kernel; variances add."""
    grid = linear.grid(2, 8, oversample=4)
    power = torch.zeros(1, *grid.shape, dtype=torch.float64)
    power[0, 80, grid.u_count // 2, 0] = 1
    wide = Surrogate(range_width=3.0, angle_width=1.5)
    sharp = Surrogate().shape(power, linear, grid)
    found = wide.shape(power, linear, grid)
    # The window's sidelobes at the rim lose power only once they are cut off.
    assert (wide.blur(sharp, linear, grid) - found).abs().max() < 0.01 * found.max()
    assert torch.equal(Surrogate().blur(sharp, linear, grid), sharp)
    pure = wide.blur(power, linear, grid)[0, :, :, 0]
    for profile, centers, sigma in (
        (pure.sum(1), grid.ranges, 3 * linear.waveform.range_resolution),
        (pure.sum(0), grid.u, 1.5 * linear.beamwidth[0]),
    ):
        assert profile.sum() == pytest.approx(1, rel=1e-3)
        mean = (profile * centers).sum()
        spread = (profile * (centers - mean).square()).sum().sqrt()
        assert spread == pytest.approx(sigma, rel=0.01)


def test_range_offset_moves_and_differentiates(linear):
    grid = linear.grid(3, 6)
    points, power = cloud(20)
    spread = deposited(points, power, grid)
    offset = torch.tensor(3 * grid.range_step, dtype=torch.float64)
    moved = Surrogate().shape(spread, replace(linear, range_bias=offset), grid)
    assert torch.allclose(moved[:, 3:], Surrogate().shape(spread, linear, grid)[:, :-3], atol=1e-9)
    small = replace(grid, u_count=3)
    # Above zero everywhere, where power has its bound.
    spread = (spread[:, :, 20:23] + spread.max()).requires_grad_()
    offset = torch.tensor(0.021, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda p, d: Surrogate(range_width=0.5).shape(p, replace(linear, range_bias=d), small),
        (spread, offset),
        fast_mode=True,
    )


# Torch's forward mode compiles its own helpers in a way that it has deprecated.
@pytest.mark.parametrize("angle_kernel", ["response", "airy"])
def test_gradient_of_the_map(angle_kernel, planar):
    grid = planar.grid(4, 4.4, 0.3, 0.3)
    # Above zero everywhere, where power has its bound.
    power = 3 + torch.rand(
        2, *grid.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    surrogate = Surrogate("gaussian", angle_kernel, range_width=0.3, angle_width=0.2)
    assert torch.autograd.gradcheck(
        lambda p: surrogate.shape(p, planar, grid), power.requires_grad_(), fast_mode=True
    )
    tangent = torch.rand_like(power)
    forward = torch.func.jvp(
        lambda p: surrogate.shape(p, planar, grid), (power.detach(),), (tangent,)
    )[1]
    assert torch.allclose(forward, surrogate.shape(tangent, planar, grid))


def test_frames_and_precision(planar):
    grid = planar.grid(4, 5, 0.5, 0.5)
    power = torch.rand(3, *grid.shape, generator=torch.Generator().manual_seed(0))
    found = Surrogate().shape(power, planar, grid)
    assert found.dtype == torch.float32
    assert torch.allclose(found[1:2], Surrogate().shape(power[1:2], planar, grid), rtol=1e-5)
    double = Surrogate().shape(power.double(), planar, grid)
    assert (found - double).abs().max() < 1e-5 * double.max()


def test_impulse_is_a_gaussian_pulse():
    one = linear_array(1, 1.0)
    radar = Radar(one, one, Impulse(3.95e9, 1.7e9), torch.zeros(1, 3, dtype=torch.float64))
    grid = radar.grid(0, 5, oversample=8)
    power = torch.zeros(1, *grid.shape, dtype=torch.float64)
    power[0, 200] = 1
    maps = [Surrogate(range_kernel=k).shape(power, radar, grid) for k in ("response", "gaussian")]
    assert torch.equal(*maps)
    cell = radar.waveform.range_resolution
    assert half_width(maps[0][0, :, 0, 0], grid.range_step) == pytest.approx(cell, rel=0.02)


@pytest.mark.claim
@pytest.mark.slow
def test_exact_signals_of_a_scene_agree_with_the_surrogate(mimo):
    """Ray-traced: the rough points' exact spectra, summed in power, are the surrogate's map."""
    pose = rigid(
        rotation_from_vector(torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)),
        torch.tensor([3.0, 0.5, -0.4], dtype=torch.float64),
    )
    scene = Scene({"plate": Object(plate(0.5, 0.3), RoughDielectric(5.0), pose)})
    grid = mimo.grid(2.6, 3.6, 0.5, 0.5)
    smooth = surrogate_spectrum(
        scene,
        mimo,
        grid,
        Surrogate(),
        sampling=Sampling(samples=50_000, boundary_samples=0),
        seed=1,
    )
    paths = trace_field(
        scene,
        mimo.link(),
        sampling=Sampling(depth=1, samples=1, boundary_samples=0, points_per_m2=2000.0),
        seed=2,
    )
    count = len(paths)
    copies = replace(mimo, positions=mimo.positions.expand(count, 3))
    alone = replace(paths, frame=torch.arange(count))
    exact = exact_spectrum(beat_signal(alone, copies), copies, grid).sum(0, keepdim=True)
    assert exact.argmax() == smooth.argmax()
    assert exact.sum() == pytest.approx(float(smooth.sum()), rel=0.02)
    assert (exact - smooth).norm() < 0.02 * exact.norm()


def test_annealing_ends_at_the_exact_response(linear, point_paths):
    """The last stage of a fit: no extra width, and the mean of the exact simulation."""
    radar = linear
    points, power = cloud(40)
    grid = radar.grid(3, 6, 0.7)
    exact = expected_exact(radar, points, power, grid, point_paths)
    spread = deposited(points, power, grid)
    wide = SURROGATES["annealed"]
    assert wide is not None
    last = replace(wide, range_width=0.0, angle_width=0.0)
    assert last == SURROGATES["response"]
    assert torch.equal(last.blur(exact, radar, grid), exact)
    misses = []
    for left in (1.0, 0.5, 0.1, 0.0):
        stage = replace(wide, range_width=3.0 * left, angle_width=1.5 * left)
        misses.append(float((stage.shape(spread, radar, grid) - exact).norm() / exact.norm()))
    assert misses == sorted(misses, reverse=True)
    assert misses[-1] < 0.02


def test_one_switch_for_all(linear):
    assert resolve_surrogate(None) is None
    assert resolve_surrogate("exact") is None
    assert resolve_surrogate("gaussian") == Surrogate("gaussian", "airy")
    mine = Surrogate(range_width=1.0)
    assert resolve_surrogate(mine) is mine
    with pytest.raises(InputError, match=r"one of exact, response, .* got 'bessel'"):
        resolve_surrogate("bessel")


@pytest.mark.usefixtures("unchecked")
def test_wrong_input(planar):
    grid = planar.grid(4, 5)
    with pytest.raises(InputError, match="expected a map of shape"):
        Surrogate().shape(torch.zeros(1, 2, 3, 4), planar, grid)
    with pytest.raises(InputError, match="range_kernel"):
        Surrogate(range_kernel="sinc")  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="angle_kernel"):
        Surrogate(angle_kernel="gaussian")  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="range_width of at least 0"):
        Surrogate(range_width=-1.0)
    with pytest.raises(InputError, match="aperture_radius above 0"):
        Surrogate(aperture_radius=0.0)
    pulse = replace(planar, waveform=Impulse(77e9, 1e9))
    with pytest.raises(InputError, match="sampled waveform for the Dirichlet kernel, got Impulse"):
        Surrogate(range_kernel="dirichlet").shape(torch.zeros(1, *grid.shape), pulse, grid)


@pytest.mark.parametrize(("oversample", "below"), [(1.0, 0.15), (1.5, 0.02), (2.0, 3e-3)])
def test_power_is_never_negative(oversample, below, planar):
    grid = planar.grid(3.5, 4.5, 0.4, 0.4, oversample=oversample)
    plates = {
        str(k): Object(plate(0.05, 0.05), RoughDielectric(4.0), rigid(translation=[4.0, y, 0.1]))
        for k, y in enumerate((-0.5, 0.2))
    }
    scene, drawn = Scene(plates), Sampling(depth=1, samples=20_000)
    deposit = deposit_power(scene, planar.link(), grid, sampling=drawn, seed=1)
    for surrogate in (Surrogate(), Surrogate("gaussian", "airy")):
        shaped = surrogate.shape(deposit, planar, grid)
        assert -below * shaped.max() < shaped.min() < 0
        power = surrogate_spectrum(scene, planar, grid, surrogate, sampling=drawn, seed=1)
        assert power.min() == 0
        assert torch.allclose(
            power, shaped.clamp_min(0.0), rtol=1e-4, atol=1e-5 * float(power.max())
        )
