"""Range rates, TDM-MIMO and spectrograms of movers whose beat phase is written down directly."""

import math
from dataclasses import replace

import pytest
import torch

from invertwin.channel import Sampling
from invertwin.errors import InputError
from invertwin.radar import (
    FMCW,
    Chirps,
    Radar,
    beamform,
    compensate_tdm,
    interpolate_rates,
    micro_doppler,
    moving_beat,
    range_doppler,
    range_doppler_angle,
    range_profile,
    resolve_fold,
    velocity_axis,
    velocity_span,
)
from invertwin.radar.boards import BOARDS
from invertwin.radar.processing.doppler import frame_spectrogram
from invertwin.scene import (
    MovingScene,
    Object,
    RoughDielectric,
    Scene,
    Walking,
    person,
    rigid,
    sphere,
    standing_height,
)
from invertwin.scene.antenna import linear_array
from invertwin.scene.pose import rotation_from_vector
from invertwin.simulation import simulate_chirps
from oracles.moving_point import moving_point

WAVE = FMCW(76.5e9, 1e9, 40e-6, 64)
HALF = WAVE.wavelength / 2
CHIRPS = Chirps(count=32, interval=50e-6)
U = 0.2


def mimo(transmitters: int = 4, receivers: int = 4) -> Radar:
    """Transmitters and receivers in a row whose virtual array is uniform without gaps."""
    return Radar(
        linear_array(transmitters, receivers * HALF),
        linear_array(receivers, HALF),
        WAVE,
        torch.zeros(1, 3, dtype=torch.float64),
        window="hann",
        array_window="rectangular",
    )


def mover(radar: Radar, chirps: Chirps, rate: float) -> torch.Tensor:
    return moving_point(radar, chirps, 4.0, rate, U)


def direction(power, grid):
    """u of the peak, refined by a parabola."""
    line = power.amax((0, 1, 2))[:, 0]
    peak = int(line.argmax())
    a, b, c = line[peak - 1 : peak + 2].tolist()
    return float(grid.u[peak]) + 0.5 * (a - c) / (a - 2 * b + c) * grid.u_step


@pytest.mark.parametrize("tdm", [True, False])
@pytest.mark.parametrize("rate", [-0.31, 0.17])
def test_a_mover_is_found_at_its_range_and_rate(tdm, rate):
    """Positive moves away; the peak is 1."""
    radar, chirps = mimo(), replace(CHIRPS, tdm=tdm)
    rate = rate * velocity_span(radar, chirps)
    grid = radar.grid(2, 6, oversample=4)
    power = range_doppler(mover(radar, chirps, rate), radar, grid, chirps, bins=256).abs().square()
    assert power.shape == (1, 256, 4, 4, grid.range_count)
    velocity, place = divmod(int(power.mean((0, 2, 3)).argmax()), grid.range_count)
    axis = velocity_axis(radar, chirps, 256)
    assert axis[velocity] == pytest.approx(rate, abs=float(axis[1] - axis[0]))
    assert grid.ranges[place] == pytest.approx(4.0, abs=grid.range_step)
    assert power.max() == pytest.approx(1.0, rel=0.05)


def test_axis_of_range_rates():
    radar = mimo()
    axis = velocity_axis(radar, CHIRPS)
    assert axis.shape == (32,)
    assert axis[16] == 0
    assert velocity_span(radar, CHIRPS) == pytest.approx(WAVE.wavelength / 2 / 200e-6)
    assert -axis[0] == pytest.approx(CHIRPS.max_speed(WAVE.wavelength, 4))
    assert axis[1] - axis[0] == pytest.approx(velocity_span(radar, CHIRPS) / 32)


@pytest.mark.parametrize("transmitters", [2, 3, 4])
@pytest.mark.parametrize("part", [-0.45, 0.3])
def test_compensated_direction_within_the_axis(transmitters, part):
    radar = mimo(transmitters)
    rate = part * velocity_span(radar, CHIRPS)
    grid = radar.grid(3, 5, u_max=0.9, oversample=8)
    power = range_doppler_angle(mover(radar, CHIRPS, rate), radar, grid, CHIRPS, bins=128)
    assert power.shape == (1, 128, *grid.shape)
    assert power.max() == pytest.approx(1.0, rel=0.1)
    assert abs(direction(power, grid) - U) < 0.1 * radar.beamwidth[0]


@pytest.mark.parametrize("loops", [8, 16])
@pytest.mark.parametrize("part", [0.0, 0.25, 0.49])
def test_the_rate_between_bins_turns_transmitters_too(loops, part):
    """The phase at the middle of the bin is off by up to π/loops from transmitter to the last."""
    radar, chirps = mimo(), Chirps(count=loops, interval=50e-6)
    rate = (2 + part) / loops * velocity_span(radar, chirps)
    grid = radar.grid(2, 6, oversample=4)
    spectrum = range_doppler(mover(radar, chirps, rate), radar, grid, chirps)
    power = spectrum.abs().square().mean((2, 3))[0]
    offsets = interpolate_rates(power)
    row, column = divmod(int(power.argmax()), grid.range_count)
    assert offsets[row, column] * loops == pytest.approx(part, abs=0.03)
    channels = compensate_tdm(spectrum, radar, chirps, offsets)[0, row, :, :, column]
    y = radar.virtual_positions[:, 1]
    plane = torch.exp(-2j * math.pi / WAVE.wavelength * U * y)
    turned = (channels.flatten() / plane).angle()
    assert (turned - turned[0]).abs().max() < 0.03
    middle = compensate_tdm(spectrum, radar, chirps)[0, row, :, :, column].flatten() / plane
    expected = 2 * math.pi * part / loops * 3 / 4  # of the last of four transmitters
    assert float((middle[-1] / middle[0]).angle().abs()) == pytest.approx(expected, abs=0.03)


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_fast_mover_needs_the_compensation_and_its_sign(sign):
    """1.25 spans beyond zero: without the phase, or with its opposite, over a beamwidth off."""
    radar = mimo()
    rate = sign * 1.25 * velocity_span(radar, CHIRPS)
    grid = radar.grid(3, 5, u_max=0.9, oversample=8)
    cube = range_doppler(mover(radar, CHIRPS, rate), radar, grid, CHIRPS, bins=128)
    right = compensate_tdm(cube, radar, CHIRPS, fold=sign)
    turn = compensate_tdm(torch.ones_like(cube), radar, CHIRPS, fold=sign)
    reversed_sign = cube * turn.conj()
    bins = radar.frames([0] * 128)

    def seen(spectrum):
        return direction(beamform(spectrum[0], bins, grid)[None], grid)

    assert abs(seen(right) - U) < 0.1 * radar.beamwidth[0]
    assert abs(seen(cube) - U) > radar.beamwidth[0]
    assert abs(seen(reversed_sign) - U) > radar.beamwidth[0]
    assert abs(seen(compensate_tdm(cube, radar, CHIRPS, fold=-sign)) - U) > radar.beamwidth[0]


@pytest.mark.parametrize("spans", [-1.25, -0.3, 0.0, 0.4, 1.25])
def test_the_fold_is_resolved(spans):
    radar = mimo()
    rate = spans * velocity_span(radar, CHIRPS)
    grid = radar.grid(3, 5, u_max=0.9, oversample=4)
    beat = mover(radar, CHIRPS, rate)
    cube = range_doppler(beat, radar, grid, CHIRPS)
    fold = resolve_fold(cube, radar, grid, CHIRPS)
    assert fold.shape == (1, 32, grid.range_count)
    power = range_doppler_angle(beat, radar, grid, CHIRPS, fold=fold)
    velocity, place = divmod(int(power[0].amax((-2, -1)).argmax()), grid.range_count)
    assert fold[0, velocity, place] == round(spans)
    found = velocity_axis(radar, CHIRPS)[velocity] + fold[0, velocity, place] * velocity_span(
        radar, CHIRPS
    )
    assert found == pytest.approx(rate, abs=velocity_span(radar, CHIRPS) / 32)
    assert abs(direction(power, grid) - U) < 0.1 * radar.beamwidth[0]


def test_transmitters_at_once_need_nothing():
    radar, chirps = mimo(), replace(CHIRPS, tdm=False)
    grid = radar.grid(3, 5)
    cube = range_doppler(mover(radar, chirps, 3.0), radar, grid, chirps)
    assert torch.equal(compensate_tdm(cube, radar, chirps), cube)


def test_moving_paths_have_the_same_signal(point_paths):
    """What ``moving_beat`` makes of a moving point is the closed form that these tests use."""
    radar, rate = mimo(), 9.0
    ray = torch.tensor([math.sqrt(1 - U**2), U, 0.0], dtype=torch.float64)
    start = (4.0 - rate * CHIRPS.times(4).mean()) * ray
    paths = point_paths(radar, start, torch.tensor([1.0]))
    beat = moving_beat(replace(paths, velocity=rate * ray[None]), radar, CHIRPS)
    assert (beat - mover(radar, CHIRPS, rate)).abs().max() < 1e-6


def test_frames_have_their_own_poses():
    """Two frames with other places and attitudes of the radar see the same in their frames."""
    one = mimo(2, 2)
    turn = rotation_from_vector(torch.tensor([0.3, 0.2, -0.5], dtype=torch.float64))
    places = torch.tensor([[0.0, 0, 0], [0.5, 1.0, -2]], dtype=torch.float64)
    both = replace(one, positions=places, rotations=torch.stack([torch.eye(3).double(), turn]))
    beat = mover(both, CHIRPS, -2.0)
    grid = both.grid(3, 5)
    power = range_doppler_angle(beat, both, grid, CHIRPS)
    assert torch.allclose(power[0], power[1], atol=1e-6)
    alone = range_doppler_angle(beat[:1], one, grid, CHIRPS)
    assert torch.allclose(power[:1], alone)


def test_spectrogram_follows_a_swinging_point():
    """Range 3 m + 2 cm · sin(2π 5 t): the ridge is the derivative of the range."""
    radar = replace(mimo(1, 1), transmitters=linear_array(1, HALF))
    chirps = Chirps(count=2000, interval=1e-4)
    times = torch.arange(2000, dtype=torch.float64) * 1e-4
    distance = 3 + 0.02 * torch.sin(2 * math.pi * 5 * times)
    signal = 0.5 * torch.exp(4j * math.pi / WAVE.wavelength * distance)
    result = micro_doppler(signal[None], radar, chirps, length=100, step=50)
    assert result.power.shape == (1, 39, 100)
    assert result.times[1] == pytest.approx(99.5e-4)
    ridge = result.velocities[result.power[0].argmax(-1)]
    expected = 0.02 * 2 * math.pi * 5 * torch.cos(2 * math.pi * 5 * result.times)
    assert (ridge - expected).abs().max() < 1.5 * (result.velocities[1] - result.velocities[0])
    assert result.power.max() == pytest.approx(0.25, rel=0.1)


def test_the_spectrogram_of_a_frame_has_no_static_echoes():
    """A point that recedes with 4 m/s beside a static one of 900 times its power."""
    radar, chirps, rate = mimo(2, 2), Chirps(64, 50e-6), 4.0
    grid = radar.grid(3, 5)
    beat = mover(radar, chirps, rate) + 30 * mover(radar, chirps, 0.0)
    found = frame_spectrogram(beat, radar, grid, chirps)
    assert found.power.shape == (1, 25, 16)
    assert found.velocities[-1] - found.velocities[0] == pytest.approx(
        15 / 16 * velocity_span(radar, chirps)
    )
    ridge = found.velocities[found.power[0].argmax(-1)]
    assert (ridge - rate).abs().max() < found.velocities[1] - found.velocities[0]
    with pytest.raises(InputError, match=r"window of 2\.\.8 chirps"):
        frame_spectrogram(beat[:, :8], radar, grid, Chirps(8, 50e-6))


def slow_time(beat: torch.Tensor, radar: Radar, chirps: Chirps, far: float) -> torch.Tensor:
    """Range profile of every chirp of one channel [range, chirp]."""
    every = radar.frames([0] * chirps.count)
    return range_profile(beat[0], every, radar.grid(1.0, far))[:, 0, 0].T


def test_a_rotor_has_the_range_rates_of_its_path():
    """A ball on an arm of 0.1 m turns twice a second: range rates of d|p|/dt, up to 1.25 m/s.

    Of every fourth chirp they are the same modulo the span of 1.2 m/s.
    """
    radar = mimo(1, 1)
    arm, turns, middle = 0.1, 2 * math.pi * 2, 2.0
    ball = Object(sphere(0.04, 2), RoughDielectric(4.0))

    def rotor(time: float) -> Scene:
        x, y = arm * math.sin(turns * time), arm * math.cos(turns * time)
        return Scene({"ball": replace(ball, pose=rigid(translation=[middle + x, y, 0.0]))})

    chirps = Chirps(512, 0.4e-3)
    few = Sampling(depth=1, points_per_m2=1000.0)
    beat = simulate_chirps(rotor, radar, chirps, seed=1, sampling=few, visibility_every=128)
    for beats, train, length in (
        (beat, chirps, 32),
        (beat[:, ::4], Chirps(128, 1.6e-3), 8),
    ):
        found = micro_doppler(
            slow_time(beats, radar, train, 3.0), radar, train, length=length, step=length // 4
        )
        ridge = found.velocities[found.power.sum(0).argmax(-1)]
        x, y = (arm * f(turns * found.times) for f in (torch.sin, torch.cos))
        rate = (middle * turns * y) / torch.hypot(middle + x, y)
        span = velocity_span(radar, train)
        off = (ridge - rate + span / 2) % span - span / 2
        assert off.abs().max() < 1.5 * (found.velocities[1] - found.velocities[0])
    assert rate.abs().max() == pytest.approx(turns * arm, rel=0.01)
    assert span == pytest.approx(1.2, abs=0.02)


@pytest.mark.slow
def test_a_walker_has_the_range_rates_of_trunk_and_limbs():
    """The brightest range rate is that of the walk, the fastest that of the fastest point."""
    wave = FMCW(77e9, 0.5e9, 30e-6, 64)
    radar = replace(mimo(1, 1), waveform=wave, positions=torch.tensor([[0.0, 0.0, 1.0]]).double())
    body, speed = person(spacing=0.05), 1.0
    place = rigid(translation=[5.0, 0.0, standing_height(body)])
    scene = Scene({"person": Object(body.mesh({}), RoughDielectric(8.0), place)})
    walk = MovingScene(scene, {"person": Walking(body, speed=speed)})
    chirps = Chirps(2048, 0.25e-3)
    few = Sampling(depth=1, points_per_m2=300.0)
    beat = simulate_chirps(walk, radar, chirps, seed=1, sampling=few, visibility_every=128)
    slow = slow_time(beat, radar, chirps, 6.0)
    found = micro_doppler(slow, radar, chirps, length=256, step=64)
    power = found.power.sum(0)
    bin_width = float(found.velocities[1] - found.velocities[0])
    trunk = float(found.velocities[power.mean(0).argmax()])
    assert trunk == pytest.approx(-speed, abs=0.3)

    def ranges(time: float) -> torch.Tensor:
        return (walk(time)["person"].vertices - radar.positions).norm(dim=1)

    step = 1e-3
    rates = [(ranges(t + step) - ranges(t)) / step for t in found.times.tolist()]
    fastest = float(torch.stack(rates).min())
    levels = power.amax(0) / power.max()
    seen = float(found.velocities[levels > 1e-3].min())
    # A Hann window spreads a range rate over two bins on either side.
    assert fastest - 3 * bin_width < seen < 0.8 * fastest
    assert fastest < -2.0


def test_gradients():
    radar, chirps = mimo(2, 2), Chirps(3, 50e-6)
    grid = replace(radar.grid(3.9, 4.1), u_count=3)
    generator = torch.Generator().manual_seed(0)
    beat = torch.randn(1, 3, 2, 2, 64, dtype=torch.complex128, generator=generator)
    assert torch.autograd.gradcheck(
        lambda b: range_doppler_angle(b, radar, grid, chirps, bins=4),
        beat.requires_grad_(),
        fast_mode=True,
    )
    slow = beat.detach()[0, :, 0, 0, :4].T.requires_grad_()
    assert torch.autograd.gradcheck(
        lambda s: micro_doppler(s, radar, chirps, length=2).power, slow, fast_mode=True
    )


def test_wrong_input():
    radar = mimo()
    grid = radar.grid(3, 5)
    beat = mover(radar, CHIRPS, 0.0)
    with pytest.raises(InputError, match="32 chirps"):
        range_doppler(beat[:, :9], radar, grid, CHIRPS)
    with pytest.raises(InputError, match="at least 32 bins"):
        range_doppler(beat, radar, grid, CHIRPS, bins=16)
    with pytest.raises(InputError, match="'kaiser'"):
        range_doppler(beat, radar, grid, CHIRPS, window="kaiser")
    cube = range_doppler(beat, radar, grid, CHIRPS)
    with pytest.raises(InputError, match="4 transmitters"):
        compensate_tdm(cube[:, :, :2], radar, CHIRPS)
    with pytest.raises(InputError, match="candidate"):
        resolve_fold(cube, radar, grid, CHIRPS, candidates=())
    for length, step in ((33, 1), (1, 1), (8, 0)):
        with pytest.raises(InputError, match=r"window of 2\.\.32"):
            micro_doppler(cube[0, :, 0, 0, 0], radar, CHIRPS, length=length, step=step)


def of_board(name: str) -> Radar:
    board = BOARDS[name]
    tx, rx = board.arrays(elevation=1 if board.has_rows else None)
    wave = replace(WAVE, start_frequency=board.design_frequency - 0.5e9)
    return Radar(tx, rx, wave, torch.zeros(1, 3, dtype=torch.float64), array_window="rectangular")


class Boards:
    """A mover before a board, and where the board sees it.

    Attributes:
        truth: u, v of the mover.
        cells: λ/D along u and v.
        whole: Grid of all directions.
        near: Fine grid about the truth.
    """

    def __init__(self, name: str, u: float):
        self.radar = radar = of_board(name)
        rows = BOARDS[name].has_rows
        self.whole = radar.grid(4.0, 4.05)
        self.truth = torch.tensor([u, 0.1 if rows else 0.0], dtype=torch.float64)
        self.cells = torch.tensor(radar.beamwidth, dtype=torch.float64)
        start, step = self.truth - 0.3 * self.cells, 0.05 * self.cells
        near = replace(self.whole, u_start=float(start[0]), u_step=float(step[0]), u_count=13)
        if rows:
            near = replace(near, v_start=float(start[1]), v_step=float(step[1]), v_count=13)
        self.near = near

    def spectra(self, spans: float):
        """With the compensation, without, and with its sign reversed, at the mover's rate."""
        radar = self.radar
        rate = spans * velocity_span(radar, CHIRPS)
        beat = moving_point(radar, CHIRPS, 4.0, rate, *self.truth.tolist())
        cube = range_doppler(beat, radar, self.whole, CHIRPS)
        turn = compensate_tdm(torch.ones_like(cube), radar, CHIRPS, fold=round(spans))
        peak = int(cube.abs().amax((0, 2, 3, 4)).argmax())
        return [part[:, peak] for part in (cube * turn, cube, cube * turn.conj())]

    def seen(self, spectrum, grid):
        """Power and u, v of the peak within the sphere of directions."""
        power = beamform(spectrum, self.radar, grid).amax((0, 1))
        power = power * (grid.u[:, None].square() + grid.v.square() <= 1)
        i, j = divmod(int(power.argmax()), grid.v_count)
        return float(power.max()), torch.stack([grid.u[i], grid.v[j]])

    def degrees_off(self, spectrum, grid) -> float:
        ends = [
            torch.cat([(1 - place.square().sum()).clamp(min=0).sqrt()[None], place])
            for place in (self.seen(spectrum, grid)[1], self.truth)
        ]
        return math.degrees(math.acos(min(1.0, float(ends[0] @ ends[1]))))


TWO_COLUMNS = ("xWR1642", "IWR6843AOP")
LARGE = pytest.param("MMWCAS-RF", marks=pytest.mark.slow)


@pytest.mark.filterwarnings("ignore:virtual elements are 0.80 wavelengths:UserWarning")
@pytest.mark.parametrize("u", [U, 0.7])
@pytest.mark.parametrize("name", [LARGE if name == LARGE.values[0] else name for name in BOARDS])
def test_every_board_needs_the_compensation_and_its_sign(name, u):
    """In degrees, against the beamwidth λ/D that a board has at boresight.

    With the compensation the direction is right within 0.1 of it; without it, and with its sign
    reversed, there are speeds at which it is over one off. Transmitters in two columns can move
    the direction cosine by 0.75 of it at most: where their phases are opposite, and two peaks of
    equal height stand as far apart as the columns allow. That is over one in degrees 44° to the
    side, but not near boresight.
    """
    case = Boards(name, u)
    beamwidth = math.degrees(case.radar.beamwidth[0])
    omitted, reversed_sign = [], []
    for spans in (-0.9, -0.45, 0.45, 0.9, 1.2):
        right, without, wrong = case.spectra(spans)
        assert case.degrees_off(right, case.near) < 0.1 * beamwidth
        assert case.seen(right, case.near)[0] >= case.seen(right, case.whole)[0]
        omitted.append(case.degrees_off(without, case.whole) / beamwidth)
        reversed_sign.append(case.degrees_off(wrong, case.whole) / beamwidth)
    least = 0.6 if name in TWO_COLUMNS and u == U else 1
    assert max(omitted) > least
    assert max(reversed_sign) > least
