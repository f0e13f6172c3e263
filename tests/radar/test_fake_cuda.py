"""Signals on a GPU: every public function of the radar on tensors that claim to be there."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from torch import Tensor

import invertwin.radar as rd
from claimed_tensors import Case, DeviceTests, Move
from invertwin.channel import Paths
from invertwin.channel.paths import make_paths
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.scene import linear_array
from scenes import float64

pytestmark = pytest.mark.fake_cuda
HALF = 0.5 * SPEED_OF_LIGHT / 77e9
CHIRP = rd.FMCW(76.5e9, 1e9, 40e-6, 32)
RADAR = rd.Radar(
    linear_array(2, 4 * HALF),
    linear_array(4, HALF),
    CHIRP,
    float64([[0.0, 0.0, 0.0], [0.0, 0.1, 0.0]]),
)
TRAIN, SHORT = rd.Chirps(8, 60e-6), rd.Chirps(2, 60e-6)
GRID = RADAR.grid(1.0, 3.5)
ONE, ONE_FRAME = RADAR.frames([0]), torch.arange(2)
SYMBOLS = rd.OFDM(77e9, spacing=4e6, subcarriers=32)


def draw(*shape: int, dtype: torch.dtype = torch.complex128) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(1), dtype=dtype)


def points(radar: rd.Radar = RADAR, speed: float = 2.0) -> Paths:
    """Three points that two frames see."""
    places = float64([[2.0, 0.3, 0.0], [2.5, -0.4, 0.0], [1.5, 0.1, 0.0]]).repeat(2, 1)
    frame = torch.tensor([0, 0, 0, 1, 1, 1])
    link = radar.link()
    length = (places - link.tx[frame]).norm(dim=1) + (places - link.rx[frame]).norm(dim=1)
    found = make_paths(
        frame,
        length / SPEED_OF_LIGHT,
        places,
        places,
        "rough",
        coefficient=draw(6),
        velocity=speed * torch.ones_like(places),
    )
    return found if speed else replace(found, velocity=None)


@cache
def power() -> Tensor:
    return draw(2, *GRID.shape, dtype=torch.float64).square()


@cache
def train() -> Tensor:
    return rd.moving_beat(points(), RADAR, TRAIN)


@cache
def cube() -> Tensor:
    return rd.range_doppler(train(), RADAR, GRID, TRAIN)


@cache
def ramp() -> Tensor:
    return rd.beat_signal(points(speed=0.0), RADAR)


@cache
def profile() -> Tensor:
    """Profiles of sixteen snapshots."""
    noisy = ramp()[:1, None] + draw(1, 16, *RADAR.shape[1:], CHIRP.samples)
    parts = [rd.range_profile(one, ONE, GRID) for one in noisy.unbind(1)]
    return torch.stack(parts, 1)


@cache
def cloud() -> rd.PointCloud:
    return rd.detect_points(train(), RADAR, GRID, TRAIN, 0)


def noise() -> rd.PhaseNoise:
    return rd.PhaseNoise((1e5, 1e6), (-90.0, -100.0))


def impair(move: Move, name: str) -> Tensor:
    everything = rd.Impairments(
        leakage=rd.Leakage(1e-9, -40.0),
        gain_std_db=1.0,
        phase_std=0.1,
        snr_db=20.0,
        adc=rd.ADC(12, 10.0),
    )
    if name == "apply":
        return everything.apply(move(ramp()), RADAR, seed=1)
    return replace(everything, phase_noise=noise()).record(move(points(speed=0)), RADAR, seed=1)


def shift_by(module: torch.nn.Module, move: Move, radar: rd.Radar = RADAR) -> Tensor:
    """The signal of a radar that a module changes."""
    return rd.beat_signal(move(points(speed=0.0)), module(radar))


def gradient(move: Move, function: Case) -> list[Tensor]:
    """A value, and its gradient by the numbers that were moved."""
    given = move(draw(6)).requires_grad_()
    loss = function(given).abs().square().sum()
    loss.backward()
    assert given.grad is not None
    return [loss.detach(), given.grad]


def signal_gradient(move: Move) -> list[Tensor]:
    paths = move(points(speed=0.0))
    return gradient(move, lambda given: rd.beat_signal(replace(paths, coefficient=given), RADAR))


SURROGATE = rd.Surrogate(range_width=3.0, angle_width=1.5)
AIRY = rd.Surrogate(angle_kernel="airy")
BIASED = replace(RADAR, range_bias=float64(0.03))


def vital_signs(move: Move) -> list[Tensor]:
    chest = torch.polar(torch.ones(400), torch.linspace(0, 60, 400).sin()).to(torch.complex128)
    profiles = torch.outer(chest, torch.arange(GRID.range_count) == 2)
    found = rd.estimate_vital_signs(move(profiles), RADAR, GRID, interval=0.1)
    return [found.times, found.displacement]


CASES: dict[str, Case] = {
    "Impairments.apply": lambda move: impair(move, "apply"),
    "Impairments.record": lambda move: impair(move, "record"),
    "Impulse.range_response": lambda move: rd.Impulse(7.3e9, bandwidth=1.5e9).range_response(
        move(torch.linspace(-1, 1, 5).double()), "hamming"
    ),
    "SampledWaveform.range_response": lambda move: CHIRP.range_response(
        move(torch.linspace(-1, 1, 5).double()), "hamming"
    ),
    "OFDM.beat": lambda move: SYMBOLS.beat(move(draw(2, 32)), move(draw(32))),
    "OFDM.receive_symbols": lambda move: SYMBOLS.receive_symbols(move(draw(2, 32)), move(draw(32))),
    "PhaseNoise.density": lambda move: noise().density(move(float64([2e5, 5e5]))),
    "Radar.coefficient": lambda move: RADAR.coefficient(move(points()), 0, 1),
    "Surrogate.blur": lambda move: SURROGATE.blur(move(power()), RADAR, GRID),
    "Surrogate.shape": lambda move: [
        SURROGATE.shape(move(power()), BIASED, GRID),
        AIRY.shape(move(power()).float(), RADAR, GRID),
    ],
    "Surrogate.spread": lambda move: [
        one.spread(RADAR, GRID, *(move(torch.linspace(0, 0.1, 4).double()) for _ in range(3)))
        for one in (SURROGATE, AIRY)
    ],
    "add_noise": lambda move: rd.add_noise(move(ramp()), RADAR, seed=1, noise_figure_db=10.0),
    "airy": lambda move: rd.airy(move(torch.linspace(0, 5, 6).double())),
    "backproject_beat": lambda move: rd.backproject_beat(
        move(ramp()), RADAR, move(points().first[:3])
    ),
    "beamform": lambda move: rd.beamform(move(profile()[:, 0]), ONE, GRID),
    "beat_signal": lambda move: [
        rd.beat_signal(move(points(speed=0.0)), RADAR),
        *signal_gradient(move),
    ],
    "capon": lambda move: rd.capon(move(profile()), ONE, GRID, smoothing=(6, 1)),
    "cell_averaging_cfar": lambda move: rd.cell_averaging_cfar(move(power()[..., 0])),
    "compensate_tdm": lambda move: [
        rd.compensate_tdm(move(cube()), RADAR, TRAIN, 1.0),
        rd.compensate_tdm(move(cube()), RADAR, TRAIN, move(draw(8, GRID.range_count).real)),
    ],
    "detect_points": lambda move: [
        rd.detect_points(move(train()), RADAR, GRID, TRAIN, 0),
        rd.detect_points(move(train()[:, :1]), RADAR, GRID, None, 1),
    ],
    "dirichlet": lambda move: rd.dirichlet(CHIRP, move(torch.linspace(-1, 1, 5).double())),
    "doppler_maps": lambda move: rd.doppler_maps(move(train()), RADAR, GRID, TRAIN),
    "doppler_snapshots": lambda move: rd.doppler_snapshots(move(train()), RADAR, GRID, TRAIN, 0),
    "estimate_displacement": lambda move: list(
        rd.estimate_displacement(move(profile()[0, :, 0, 0]), RADAR)
    ),
    "estimate_vital_signs": vital_signs,
    "exact_spectrum": lambda move: rd.exact_spectrum(move(ramp()), RADAR, GRID),
    "find_peak": lambda move: float64(list(vars(rd.find_peak(move(power()[0]), GRID)).values())),
    "format_points_csv": lambda move: torch.tensor(
        list(rd.format_points_csv(move(cloud())).encode())
    ),
    "high_resolution_map": lambda move: [
        rd.high_resolution_map(move(profile()[0]), ONE, GRID, method, None)
        for method in ("capon", "music")
    ],
    "interpolate_rates": lambda move: rd.interpolate_rates(move(power()[0, ..., 0])),
    "micro_doppler": lambda move: rd.micro_doppler(
        move(train()[0, :, 0, 0, 0]), RADAR, TRAIN, length=4
    ),
    "moving_beat": lambda move: rd.moving_beat(move(points().select(ONE_FRAME)), ONE, SHORT),
    "music": lambda move: rd.music(move(profile()), ONE, GRID, sources=2),
    "noise_power": lambda move: float64([rd.noise_power(move(power()), 4)]),
    "noisy_oscillator_beat": lambda move: rd.noisy_oscillator_beat(
        move(points().select(ONE_FRAME)), ONE, noise(), seed=1, chirps=SHORT
    ),
    "normalized_gaussian": lambda move: rd.normalized_gaussian(
        move(float64([1.5, 2.0])), move(GRID.ranges), 0.1
    ),
    "ordered_statistics_cfar": lambda move: rd.ordered_statistics_cfar(move(power()[..., 0])),
    "peaks": lambda move: rd.peaks(move(power()), move(power().amax(-1) > 0.5), RADAR, GRID),
    "point_cloud": lambda move: rd.point_cloud(
        move(power()[:, None].repeat(1, 8, 1, 1, 1)),
        move(power()[:, None, :, :, 0].repeat(1, 8, 1, 1).amax(-1) > 0.5),
        RADAR,
        GRID,
        TRAIN,
        move(torch.ones(2, 8, GRID.range_count, dtype=torch.int64)),
    ),
    "quantize": lambda move: rd.quantize(move(ramp()), RADAR, rd.ADC(8, 10.0)),
    "range_doppler": lambda move: rd.range_doppler(move(train()), RADAR, GRID, TRAIN),
    "range_doppler_angle": lambda move: rd.range_doppler_angle(
        move(train()), RADAR, GRID, TRAIN, fold=move(torch.zeros(2, 8, GRID.range_count).long())
    ),
    "range_profile": lambda move: [
        rd.range_profile(move(ramp()), RADAR, GRID),
        rd.range_profile(move(ramp()), RADAR, replace(GRID, range_step=0.07)),
    ],
    "range_rate": lambda move: rd.range_rate(move(points()), RADAR),
    "resolve_fold": lambda move: rd.resolve_fold(move(cube()), RADAR, GRID, TRAIN),
    "source_count": lambda move: rd.source_count(move(draw(3, 4).abs()), 16),
}
# Parameters of a radar and its poses are a few numbers on the CPU, and signals of paths on a GPU
# follow the paths.
CASES |= {
    f"{name}.forward": lambda move, module=module: shift_by(module, move)
    for name, module in {
        "RadarPose": rd.RadarPose(),
        "RadarTrajectory": rd.RadarTrajectory(1, 0.1),
        "ClockOffset": rd.ClockOffset(lambda shift: RADAR.positions + shift),
    }.items()
}
CASES["RangeBias.forward"] = lambda move: SURROGATE.shape(
    move(power()), rd.RangeBias(0.02)(RADAR), GRID
)

ON_CPU = {
    "detect_points": "a list of points, one by one",
    "peaks": "a list of points; SciPy's filter of maxima",
    "point_cloud": "a list of points; SciPy's filter of maxima",
    "find_peak": "numbers",
    "format_points_csv": "text",
    "noise_power": "a number",
}
DESCRIBES = "describes the radar by a few numbers, which are on the CPU"
NO_CASE = {
    **dict.fromkeys(
        (
            *("Board.arrays", "Chirps.max_speed", "Chirps.times", "Radar.center_on"),
            *("Radar.elements", "Radar.frames", "Radar.grid", "Radar.link"),
            *("Radar.transform_rigidly", "board", "velocity_axis", "velocity_span"),
            *("Surrogate.for_start_error", "Surrogate.scale_blur", "resolve_surrogate"),
            *("RadarTrajectory.displacements", "RadarTrajectory.values"),
            *("RadarTrajectory.coordinates", "RangeBias.values", "RangeBias.coordinates"),
            *("ClockOffset.values", "ClockOffset.coordinates", "Impairments.check_applicable"),
        ),
        DESCRIBES,
    ),
    **dict.fromkeys(
        ("channel_errors", "leakage_signal", "residual_phase"),
        "draws or computes from the radar alone; Impairments adds it to signals on their device",
    ),
    "Peak.metrics": "numbers of Python",
    "Waveform.range_response": "abstract",
    "save_points": "writes a file",
    "surrogate_spectrum": "traces rays: its map is where Dr.Jit has it, see tests/channel/rays",
}


class TestDevices(DeviceTests):
    room, cases, no_case, on_cpu = "invertwin.radar", CASES, NO_CASE, ON_CPU
