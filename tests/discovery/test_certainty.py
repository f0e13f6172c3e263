"""Error bars and kinds."""

import math
from dataclasses import replace

import pytest
import torch

import invertwin as iw
from discovery.test_recordings import CHIRP, HEIGHT, PAINT, around, thing
from discovery.test_search import search_of
from invertwin.discovery.assembly import ShapeLikelihood, make_sampling
from invertwin.discovery.certainty import (
    ShapeHypothesis,
    existence_probabilities,
    find_hypotheses,
    kind_probabilities,
    preference,
    rotate_to_lobe,
    widen_deviations,
)
from invertwin.discovery.imaging.likelihood import (
    HeavyTailedLoss,
    count_bins_per_draw,
    estimate_background,
    map_axes,
)
from invertwin.discovery.shapes.primitives import ShapeParameters
from invertwin.models.radar import SurrogateMap
from invertwin.radar import add_noise
from invertwin.scene import Cosine, Scene, box, linear_array, sphere


def test_a_rival_widens_the_place_and_shares_the_kinds():
    """Half a chance to be 6 cm away is a deviation of 6 cm times the root of a half."""
    search = search_of(Scene({"box": thing(box((0.3, 0.3, 0.5)), (0.0, 0.0), 0.25)}), around(4))
    one = search.fitted_frames
    figure = ShapeParameters("person", (0.1, 0.2), 0.0, 0.32, 0.66, 1.7)
    turned = ShapeParameters("person", (0.16, 0.2), math.pi, 0.32, 0.66, 1.7)
    among = [ShapeHypothesis(figure, 0.5), ShapeHypothesis(turned, 0.5)]
    own = {"x": 0.004, "y": 0.003, "height": 0.3}
    found = widen_deviations(one, own, among)
    assert found["x"] == pytest.approx(math.hypot(0.004, 0.06 * math.sqrt(0.5)))
    assert found["y"] == pytest.approx(0.003)
    assert kind_probabilities(among) == {"person": 1.0}
    box_too = [*among, ShapeHypothesis(ShapeParameters("box", (0.1, 0.2)), 0.25)]
    assert kind_probabilities(box_too) == {"person": 1.0, "box": 0.25}
    # What hangs at the radar's height has its range to first order at any height.
    ball = ShapeParameters("sphere", (0.0, 0.0), 0.0, 0.3, 0.3, 0.6)
    hung = widen_deviations(one, own, [ShapeHypothesis(ball, 1.0)])
    assert hung["y"] == pytest.approx(math.hypot(0.003, 0.3**2 / (2 * 1.8)))


@pytest.mark.claim
@pytest.mark.slow
def test_a_box_is_surely_a_box():
    search = search_of(Scene({"box": thing(box((0.3, 0.5, 0.8)), (0.1, 0.0), 0.4, 0.4)}))
    shapes = search.refine([ShapeParameters("box", (0.1, 0.0), 0.4, 0.3, 0.5, 0.8, 0.1)])
    (among,) = find_hypotheses(search.fitted_frames, shapes)
    assert among[0].shape is shapes[0]
    assert sum(rival.probability for rival in among) == pytest.approx(1.0)
    assert among[0].probability > 0.9
    assert {rival.shape.kind for rival in among} == {"box", "cylinder", "sphere", "person"}
    assert torch.tensor([rival.probability for rival in among]).min() > 0


def likelihood_of_two_receivers(places: tuple[float, ...] = (0.0,)) -> ShapeLikelihood:
    """A ball at 1.5 m and 20 degrees, seen by two receivers a wavelength apart."""
    pattern = Cosine(1.0)
    at = torch.tensor([(0.0, y, HEIGHT) for y in places], dtype=torch.float64)
    row = linear_array(2, CHIRP.wavelength, pattern=pattern)
    radar = iw.Radar(
        linear_array(1, 1.0, pattern=pattern), row, CHIRP, at, array_window="rectangular"
    )
    ball = iw.Object(sphere(0.1, 3), PAINT, iw.scene.rigid(translation=[*BALL.position, HEIGHT]))
    grid = radar.grid(0.5, 2.5)
    sampling = iw.Sampling(depth=1, points_per_m2=3000.0, boundary=False)
    beat = iw.simulate(Scene({"ball": ball}), radar, grid, seed=3, sampling=sampling).beat
    power = iw.Capture.from_beat(add_noise(beat, snr_db=20.0, seed=4), radar).spectrum(grid).float()
    draw = count_bins_per_draw(map_axes(radar, grid))
    loss = HeavyTailedLoss(estimate_background(power, 4.0))
    model = SurrogateMap(grid, sampling=make_sampling(len(places), 2000))
    return ShapeLikelihood(model, radar, power, loss, draw, 0.0, 0)


_TURN = math.radians(20.0)
BALL = ShapeParameters(
    "sphere", (1.5 * math.cos(_TURN), 1.5 * math.sin(_TURN)), 0.0, 0.2, 0.2, HEIGHT, 0.15
)


@pytest.mark.filterwarnings("ignore::invertwin.errors.PhysicsWarning")
def test_a_place_in_the_grating_lobe_is_as_likely_until_the_radar_moves():
    """u = sin 20° − 1 has the same phases; another position has another range to it."""
    one = likelihood_of_two_receivers()
    (ball,) = one.refine([BALL], 20)
    other = rotate_to_lobe(one, ball, -1.0)
    assert other is not None
    u = ball.position[1] / math.hypot(*ball.position)
    assert other.position[1] / math.hypot(*other.position) == pytest.approx(u - 1, abs=1e-3)
    assert math.hypot(*other.position) == pytest.approx(math.hypot(*ball.position))
    assert rotate_to_lobe(one, ball, 1.0) is None  # behind the horizon
    assert 0.1 < preference(one, [ball], [other]) < 0.9
    two = likelihood_of_two_receivers((-0.3, 0.0, 0.3))
    assert preference(two, [ball], [other]) > 0.98


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::invertwin.errors.PhysicsWarning")
def test_the_error_bars_of_two_receivers_hold_both_places():
    one = likelihood_of_two_receivers()
    (ball,) = one.refine([BALL], 20)
    (among,) = find_hypotheses(one, [ball])
    far = [other for other in among if math.dist(other.shape.position, ball.position) > 0.5]
    share = sum(other.probability for other in far)
    assert 0.1 < share < 0.9
    own = {"x": 0.1, "y": 0.1, "height": 0.1}
    away = rotate_to_lobe(one, ball, -1.0)
    assert away is not None
    off = abs(away.position[1] - ball.position[1])
    assert widen_deviations(one, own, among)["y"] == pytest.approx(math.sqrt(share) * off, rel=0.2)
    # The kinds are as likely there as here.
    near = kind_probabilities([other for other in among if other not in far])
    there = kind_probabilities(far)
    for kind, value in near.items():
        assert there[kind] / share == pytest.approx(value / (1 - share), rel=1e-6)


@pytest.mark.filterwarnings("ignore::invertwin.errors.PhysicsWarning")
def test_a_faint_shape_in_the_other_lobe_is_doubtful():
    one = likelihood_of_two_receivers()
    (ball,) = one.refine([BALL], 20)
    other = rotate_to_lobe(one, ball, -1.0)
    assert other is not None
    faint = replace(other, brightness=0.01 * other.brightness)
    first, second = existence_probabilities(one, [ball, faint])
    assert first > 0.999
    assert second < 0.05
