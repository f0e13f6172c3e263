"""Images of points from the beat signal: near field, moving radars, signs, gradients."""

import math
from dataclasses import replace

import pytest
import torch

from invertwin.capture import Capture, backproject
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.radar import (
    FMCW,
    Impulse,
    Radar,
    SteppedFrequency,
    backproject_beat,
    beamform,
    beat_signal,
    range_profile,
)
from invertwin.radar.waveform import unit_window
from invertwin.scene.antenna import linear_array
from invertwin.scene.pose import rotation_from_vector


@pytest.fixture(scope="module")
def track(waveform) -> Radar:
    """2 × 4 elements along 0.3 m of a bent track, turning on the way."""
    half = 0.5 * waveform.wavelength
    along = torch.linspace(-0.15, 0.15, 41, dtype=torch.float64)
    places = torch.stack([0.02 * torch.sin(9 * along), along, 0.1 * along.square()], dim=1)
    turns = [rotation_from_vector(torch.tensor([0.1 * y, 0.0, -0.2 * y])) for y in along]
    return Radar(
        linear_array(2, 4 * half),
        linear_array(4, half),
        waveform,
        places,
        torch.stack(turns).to(torch.float64),
    )


def recorded(point_paths, radar, points, coefficients):
    count = len(points)
    frame = torch.arange(radar.frame_count).repeat_interleave(count)
    repeated = torch.as_tensor(coefficients).repeat(radar.frame_count)
    paths = point_paths(radar, points.repeat(radar.frame_count, 1), repeated, frame)
    return beat_signal(paths, radar)


def plain(beat, radar, points):
    """The sum as it is written, sample by sample."""
    waveform = radar.waveform
    window = unit_window(radar.window, waveform.samples)
    tx, rx = radar.elements()
    image = []
    for point in points:
        to_tx, to_rx = (point - tx).norm(dim=-1), (point - rx).norm(dim=-1)
        delay = ((to_tx[:, :, None] + to_rx[:, None]) / SPEED_OF_LIGHT)[..., None]
        swept = waveform.slope * (waveform.sample_times - 0.5 * delay)
        filtered = beat * torch.exp(-2j * math.pi * delay * (waveform.start_frequency + swept))
        image.append((filtered * window).sum(-1).mean() / window.sum())
    return torch.stack(image)


def test_points_along_a_track(track, point_paths):
    """conj(a) at each place, with a sharp peak; equal to the plain sum everywhere."""
    points = torch.tensor([[1.5, 0.1, 0.0], [2.1, -0.4, 0.05]], dtype=torch.float64)
    beat = recorded(point_paths, track, points, [1.0, 0.5j])
    image = backproject_beat(beat, track, points.reshape(2, 1, 3))
    assert image.shape == (2, 1)
    expected = torch.tensor([[1.0], [-0.5j]], dtype=torch.complex128)
    assert (image - expected).abs().max() < 0.05
    away = torch.tensor([[0, 0.02, 0], [0.25, 0, 0], [0.3, 0.3, 0]], dtype=torch.float64)
    assert backproject_beat(beat, track, points[0] + away).abs().max() < 0.15
    mixed = torch.cat([points, points[0] + 0.1 * away, points[1] + away])
    difference = backproject_beat(beat, track, mixed) - plain(beat, track, mixed)
    assert difference.abs().max() < 5e-3


def test_near_field_of_an_array(waveform, point_paths):
    """0.25 m in front of 0.25 m of elements: in focus here, blurred by plane-wave steering."""
    radar = Radar(
        linear_array(1, 1.0),
        linear_array(128, waveform.wavelength / 2),
        waveform,
        torch.zeros(1, 3, dtype=torch.float64),
    )
    point = torch.tensor([[0.25, 0.03, 0.0]], dtype=torch.float64)
    beat = recorded(point_paths, radar, point, [1.0])
    offset = torch.linspace(-0.02, 0.02, 81, dtype=torch.float64)
    line = point + torch.nn.functional.pad(offset[:, None], (1, 1))
    image = backproject_beat(beat, radar, line).abs()
    assert image.argmax() == 40
    assert image[40] == pytest.approx(1.0, abs=0.01)
    assert image[[30, 50]].max() < 0.3
    grid = radar.grid(0.1, 0.5)
    assert beamform(range_profile(beat, radar, grid), radar, grid).max().sqrt() < 0.4


def test_far_away_it_is_the_range_profile(linear, point_paths):
    """One frame of one channel: the same number as the windowed transform at that range."""
    radar = replace(linear, receivers=linear_array(1, 1.0))
    points = torch.tensor([[4.3, 0.0, 0.0]], dtype=torch.float64)
    beat = recorded(point_paths, radar, points, [1.0])
    grid = radar.grid(3, 6)
    places = torch.nn.functional.pad(grid.ranges[:, None], (0, 2))
    image = backproject_beat(beat, radar, places).abs()
    profile = range_profile(beat, radar, grid)[0, 0, 0].abs()
    assert torch.allclose(image, profile, atol=2e-3)


def test_captures_of_beat_samples(track, point_paths):
    points = torch.tensor([[1.5, 0.1, 0.0]], dtype=torch.float64)
    beat = recorded(point_paths, track, points, [1.0])
    image = backproject(Capture.from_beat(beat, track), points)
    assert torch.allclose(image, backproject_beat(beat, track, points))


def test_gradients():
    """In the signal, the points and the poses; a low carrier keeps differences accurate."""
    waveform = FMCW(1e9, 0.2e9, 1e-6, 12)
    still = torch.zeros(2, 3, dtype=torch.float64)
    radar = Radar(linear_array(2, 0.1, "z"), linear_array(2, 0.1), waveform, still)
    generator = torch.Generator().manual_seed(0)
    beat = torch.randn(2, 2, 2, 12, dtype=torch.complex128, generator=generator)
    points = torch.tensor([[2.0, 0.3, 0.2], [3.3, -0.5, 0.1]], dtype=torch.float64)
    positions = 0.1 * torch.randn(2, 3, dtype=torch.float64, generator=generator)
    assert torch.autograd.gradcheck(
        lambda b, x, p: backproject_beat(b, replace(radar, positions=p), x),
        [value.requires_grad_() for value in (beat, points, positions)],
    )


def test_gradient_at_77_ghz_is_that_of_the_plain_sum(track, point_paths):
    points = torch.tensor([[1.5, 0.1, 0.0]], dtype=torch.float64)
    beat = recorded(point_paths, track, points, [1.0])
    near = (points + 4e-4).requires_grad_()
    grads = [
        torch.autograd.grad(image(beat, track, near).abs().square().sum(), near)[0]
        for image in (backproject_beat, plain)
    ]
    assert (grads[0] - grads[1]).norm() < 0.02 * grads[1].norm()


def test_wrong_input(linear):
    beat = torch.zeros(1, 1, 16, 64, dtype=torch.complex128)
    far = torch.tensor([[9.7, 0.0, 0.0]], dtype=torch.float64)
    with pytest.raises(InputError, match="unambiguous range"):
        backproject_beat(beat, linear, far)
    with pytest.raises(InputError, match=r"beat signal \(frame, tx, rx, sample\) of shape"):
        backproject_beat(beat[:, :, :3], linear, far)
    with pytest.raises(InputError, match="no beat signal"):
        backproject_beat(beat, replace(linear, waveform=Impulse(77e9, 1e9)), far)
    assert backproject_beat(beat, linear, torch.zeros(0, 3, dtype=torch.float64)).shape == (0,)


# Spotlight: 200 pulses over 10° towards one scene, 600 MHz at 10 GHz, 100 m unambiguous.
PULSES = SteppedFrequency(9.7e9, 1.5e6, 400, 1e-6)
SPREAD = math.radians(10)
POINTS = torch.tensor([[0, 0, 0], [12.3, -7.1, 0], [-20.4, 15.2, 0.5]], dtype=torch.float64)


def spotlight(distance: float, straight: bool) -> Radar:
    """A pass at a height, over x, y with z up; straight, or on a circle about the centre."""
    turn = torch.linspace(-SPREAD / 2, SPREAD / 2, 200, dtype=torch.float64)
    level, height = distance * math.cos(0.5), distance * math.sin(0.5)
    along = level * (turn.tan() if straight else turn.sin())
    away = level * (torch.ones_like(turn) if straight else turn.cos())
    places = torch.stack([along, -away, height * torch.ones_like(turn)], dim=1)
    one = linear_array(1, 1.0)
    return Radar(one, one, PULSES, places).center_on([0.0, 0.0, 0.0])


@pytest.mark.parametrize("straight", [False, True], ids=["circle", "line"])
@pytest.mark.parametrize("distance", [100.0, 1e3, 1e4])
def test_spotlight_images(distance, straight, point_paths):
    """Points are within a tenth of a cell of their places, also 10 km away."""
    radar = spotlight(distance, straight)
    beat = recorded(point_paths, radar, POINTS, [1.0, 1.0, 1.0])
    # On the ground, c/2B over the cosine of the elevation away and λ/2Δθ across.
    cells = (
        PULSES.wavelength / (2 * SPREAD * math.cos(0.5)),
        PULSES.range_resolution / math.cos(0.5),
    )
    x, y = (torch.linspace(-1, 1, 21, dtype=torch.float64) * cell for cell in cells)
    around = torch.nn.functional.pad(torch.cartesian_prod(x, y), (0, 1))
    for point in POINTS:
        image = backproject_beat(beat, radar, point + around).abs()
        found = around[image.argmax()]
        assert (found[:2].abs() <= 0.1 * torch.tensor(cells) + 1e-9).all()
        assert float(image.max()) == pytest.approx(1.0, abs=0.05)
        assert float(image[0]) < 0.4  # a cell away along both axes


def test_phases_are_right_from_10_km():
    """Against the sum as it is written, from the same distances: to 1e-6 of a point's echo."""
    radar = spotlight(1e4, straight=False)
    generator = torch.Generator().manual_seed(1)
    points = 10 * torch.rand(5, 3, dtype=torch.float64, generator=generator)
    shown = (points[:, None] - radar.positions).norm(dim=-1) - radar.origins
    ideal = torch.exp(4j * math.pi * shown[..., None] * PULSES.frequencies / SPEED_OF_LIGHT)
    for point, beat in zip(points, ideal, strict=True):
        image = backproject_beat(beat[:, None, None], radar, point[None])
        assert abs(image[0] - 1) < 5e-3  # of the interpolation between samples
        assert abs(image[0].angle()) < 1e-4


def test_without_its_origin_a_far_scene_is_refused(point_paths):
    radar = spotlight(1e3, straight=False)
    beat = torch.zeros(200, 1, 1, 400, dtype=torch.complex128)
    with pytest.raises(InputError, match=r"from 0 to 99\.9308 m, got one at 1000 m; .* origin"):
        backproject_beat(beat, replace(radar, range_origin=None), POINTS[:1])
    with pytest.raises(InputError, match=r"from -49\.9654 to 49\.9654 m, got one at -6"):
        backproject_beat(beat, radar, torch.tensor([[0.0, -70.0, 0.0]], dtype=torch.float64))
