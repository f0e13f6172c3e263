"""The paper's random-phase field: right on average, and blind to silhouettes on average."""

from dataclasses import replace

import pytest
import torch

from invertwin.channel import Paths, Sampling
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.radar import FMCW, Radar, Surrogate
from invertwin.scene import Translation, linear_array
from invertwin_studies.random_phase import RandomPhaseMap, random_phase_spectrum
from oracles.bspline import deposit
from scenes import occluder
from scenes import radar as small_radar

DRAWS = 400
POINTS, EDGE = 120, 30


@pytest.fixture(scope="module")
def view():
    """A radar of 16 receivers in a row, whose frames are draws of the phases, and a grid."""
    waveform = FMCW(76.5e9, 1e9, 40e-6, 64)
    half = 0.5 * waveform.wavelength
    places = torch.zeros(DRAWS, 3, dtype=torch.float64)
    radar = Radar(linear_array(1, half), linear_array(16, half), waveform, places)
    return radar, radar.grid(3.5, 5.5, 0.7)


def cloud():
    """Places, ranges and powers of an interior cloud, and of boundary points beside it."""
    generator = torch.Generator().manual_seed(3)
    u, r = torch.rand(2, POINTS + EDGE, generator=generator, dtype=torch.float64)
    u, r = 0.5 * u - 0.3, 4.2 + 0.5 * r
    points = r[:, None] * torch.stack([(1 - u**2).sqrt(), u, torch.zeros_like(u)], 1)
    return points, r, torch.arange(POINTS + EDGE) >= POINTS


def paths_of(points, delay, power, boundary, draws=DRAWS):
    """The same power paths in every frame; delay and power have a row a frame."""
    count = len(points)
    return Paths(
        frame=torch.arange(draws).repeat_interleave(count),
        delay=delay.expand(draws, count).reshape(-1),
        coefficient=torch.zeros(draws * count, dtype=torch.complex128),
        power=power.expand(draws, count).reshape(-1),
        first=points.repeat(draws, 1),
        last=points.repeat(draws, 1),
        kind="power",
        boundary=boundary.repeat(draws),
    )


def shaped(points, r, power, radar, grid):
    u, v = points[:, 1] / r, points[:, 2] / r
    return Surrogate("gaussian", "airy").shape(deposit(power, r, u, v, grid)[None], radar, grid)[0]


def test_the_mean_over_phases_is_the_power_surrogate(view):
    radar, grid = view
    points, r, boundary = cloud()
    power = (~boundary).double()
    paths = paths_of(points, 2 * r / SPEED_OF_LIGHT, power, boundary)
    draws = random_phase_spectrum(paths, radar, grid, seed=1)
    mean, smooth = draws.mean(0), shaped(points, r, power, radar, grid)
    assert float(mean.sum() / smooth.sum()) == pytest.approx(1, abs=0.05)
    assert (mean - smooth).norm() < 1.5 / DRAWS**0.5 * smooth.norm()
    # One draw is speckle: its standard deviation is its mean.
    bright = smooth > 0.3 * smooth.max()
    assert float((draws.std(0) / mean)[bright].mean()) == pytest.approx(1, abs=0.1)


def test_the_boundary_derivative_vanishes_on_average(view):
    """What sweeps into view adds power; over random phases the field's derivative is 0 ± noise."""
    radar, grid = view
    points, r, boundary = cloud()
    theta = torch.zeros(DRAWS, 1, dtype=torch.float64, requires_grad=True)
    power = torch.where(boundary, theta, 1.0)
    paths = paths_of(points, 2 * r / SPEED_OF_LIGHT, power, boundary)
    weight = torch.linspace(0.5, 1.5, grid.range_count, dtype=torch.float64)[:, None, None]
    draws = random_phase_spectrum(paths, radar, grid, seed=2)
    (slopes,) = torch.autograd.grad((weight * draws).sum(), theta)
    mean, error = float(slopes.mean()), float(slopes.std()) / DRAWS**0.5
    true = float((weight * shaped(points, r, boundary.double(), radar, grid)).sum())
    assert abs(mean) < 3 * error
    assert 3 * error < 0.5 * true, "the noise would hide a derivative"
    assert float(slopes.abs().mean()) > 10 * error, "single draws do have one, of random sign"


def test_the_interior_derivative_is_right_on_average(view):
    radar, grid = view
    points, r, boundary = cloud()
    points, r, boundary = points[:POINTS], r[:POINTS], boundary[:POINTS]
    power = torch.ones(POINTS, dtype=torch.float64)
    weight = (grid.ranges - 4.0).square()[:, None, None]

    shift = torch.zeros(DRAWS, 1, dtype=torch.float64, requires_grad=True)
    paths = paths_of(points, 2 * (r + shift) / SPEED_OF_LIGHT, power, boundary)
    draws = random_phase_spectrum(paths, radar, grid, seed=3)
    (slopes,) = torch.autograd.grad((weight * draws).sum(), shift)
    one = torch.zeros((), dtype=torch.float64, requires_grad=True)
    smooth = (weight * shaped(points, r + one, power, radar, grid)).sum()
    (true,) = torch.autograd.grad(smooth, one)
    error = float(slopes.std()) / DRAWS**0.5
    assert error < 0.2 * float(true.abs())
    assert float(slopes.mean()) == pytest.approx(float(true), abs=3 * error)


def test_gradients_of_one_draw(view):
    radar, _ = view
    radar = radar.frames([0])
    grid = radar.grid(4.0, 4.8, 0.3)
    points, r, boundary = (rows[POINTS - 4 : POINTS + 2] for rows in cloud())

    def spectrum(where, distance, power):
        power = torch.where(boundary, power - power.detach(), power)
        paths = paths_of(where, 2 * distance / SPEED_OF_LIGHT, power, boundary, draws=1)
        return random_phase_spectrum(paths, radar, grid, seed=5, range_width=0.4)

    power = torch.linspace(0.5, 1.5, 6, dtype=torch.float64)
    inner = ~boundary
    assert torch.autograd.gradcheck(
        lambda x, d, p: spectrum(
            torch.cat([x, points[boundary]]),
            torch.cat([d, r[boundary]]),
            torch.cat([p, power[boundary]]),
        ),
        tuple(rows[inner].clone().requires_grad_() for rows in (points, r, power)),
    )


def test_extra_width_and_offset(view):
    """Both as for powers; nothing outside of the grid is pulled in."""
    radar = replace(view[0].frames([0]), range_bias=torch.tensor(0.31, dtype=torch.float64))
    grid = radar.grid(2.5, 6.5, 0.7)
    points, r, boundary = (rows[:1] for rows in cloud())
    one = torch.ones(1, dtype=torch.float64)
    paths = paths_of(points, 2 * r / SPEED_OF_LIGHT, one, boundary, draws=1)
    wide = random_phase_spectrum(paths, radar, grid, seed=0, range_width=1.5)
    spread = deposit(one, r, points[:, 1] / r, points[:, 2] / r, grid)[None]
    smooth = Surrogate("gaussian", "airy", range_width=1.5).shape(spread, radar, grid)
    assert (wide - smooth).abs().max() < 0.02 * smooth.max()
    far = paths_of(points, 2 * (r + 9) / SPEED_OF_LIGHT, one, boundary, draws=1)
    assert not random_phase_spectrum(far, radar, grid, seed=0).any()


def test_of_a_scene():
    """The field as a model: one draw a seed, and silhouettes that move it."""
    radar = small_radar()
    grid = radar.grid(0.5, 2.5, 0.8)
    drawn = Sampling(depth=1, samples=1_500, boundary_samples=300)
    model = RandomPhaseMap(grid, Surrogate("gaussian", "airy"), drawn)
    move = Translation("occluder")
    first, again, other = (model.predict(move(occluder()), radar, seed) for seed in (2, 2, 1))
    assert first.shape == (1, *grid.shape)
    assert torch.allclose(first, again, rtol=1e-5)
    assert (first - other).norm() > 0.3 * first.norm()
    interior = model.with_sampling(boundary_samples=0, boundary=False)
    still = interior.predict(move(occluder()), radar, 2)
    assert torch.allclose(first, still, rtol=1e-5)
    slopes = [torch.autograd.grad(m.sum(), move.translation)[0] for m in (first, still)]
    assert (slopes[0] - slopes[1]).norm() > 0.1 * slopes[1].norm()


def test_its_width_is_taken_away(view):
    radar, grid = view
    model = RandomPhaseMap(grid, Surrogate("gaussian", "airy", range_width=2.0), Sampling(depth=1))
    assert model.has_blur
    assert model.scale_blur(0.5).surrogate.range_width == 1.0
    assert not model.scale_blur(0.0).has_blur
    one = torch.zeros(1, *grid.shape)
    one[:, grid.range_count // 2] = 1.0
    torch.testing.assert_close(
        model.blur_observed(one, radar), Surrogate(range_width=2.0).blur(one, radar, grid)
    )


@pytest.mark.parametrize(
    ("kernels", "depth", "message"),
    [
        (Surrogate(), 1, "got 'response' and 'response'"),
        (Surrogate("gaussian", "airy", angle_width=1.0), 1, "angle_width 0 and depth 1 .* 1.0 and"),
        (Surrogate("gaussian", "airy"), 2, "got 0.0 and 2"),
    ],
)
def test_what_it_cannot_do_is_refused(view, kernels, depth, message):
    with pytest.raises(InputError, match=message):
        RandomPhaseMap(view[1], kernels, Sampling(depth=depth))
