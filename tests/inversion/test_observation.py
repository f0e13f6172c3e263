"""Observations: several sensors in one fit, what each may compare, and models of one's own."""

from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from invertwin.capture import Capture
from invertwin.channel import Sampling
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel
from invertwin.inversion import (
    Observation,
    Optimizer,
    Schedule,
    SpectrumLoss,
    Stage,
    reconstruct,
)
from invertwin.inversion.gradcheck.gradcheck import GradcheckSettings, gradcheck
from invertwin.models.radar import SurrogateMap
from invertwin.radar import Radar, RadarPose, RangeBias, Surrogate
from invertwin.scene import Scene, Translation, look_at, sphere
from invertwin.simulation import simulate
from scenes import float64, occluder, radar, relative, thing

BALL = (-0.08, 0.1, 0.0)  # off its start
PLACES = {"ahead": [-1.5, 0.0, 0.0], "beside": [0.0, -1.5, 0.0]}
SAMPLING = Sampling(depth=1, samples=8_000, boundary_samples=2_000)


def of_ranges(place: list[float]) -> Radar:
    """One antenna that sees ranges only, and looks at the origin."""
    device = radar([place], receivers=1)
    return replace(device, rotations=look_at(float64([place]), [0.0, 0.0, 0.0]))


def scene() -> Scene:
    return Scene({"ball": thing(sphere(0.15, 3))})


@pytest.fixture(scope="module")
def seen() -> dict[str, Observation]:
    """What two radars at right angles have recorded of a ball: its range alone."""
    found = {}
    with torch.no_grad():
        true = Translation("ball", BALL)(scene())
        for name, place in PLACES.items():
            device = of_ranges(place)
            grid = device.grid(0.9, 2.0, oversample=2)
            assert device.rotations is not None
            # Looks from places a wavelength apart: the mean over speckle.
            looks = replace(
                device,
                positions=device.positions + 0.02 * float64([[0, 0, k] for k in range(-8, 8)]),
                rotations=device.rotations.expand(16, 3, 3),
            )
            drawn = Sampling(depth=1, points_per_m2=5_000.0)
            beat = simulate(true, looks, grid, sampling=drawn, seed=3).beat
            model = SurrogateMap(grid, Surrogate(range_width=2.0), SAMPLING)
            found[name] = Observation(model, Capture.from_beat(beat, looks))
    return found


def place_of(
    observations: Any, kind: Any = "adam", steps: int = 40, seed: int = 1, **changes: Any
) -> Tensor:
    fit = reconstruct(
        scene(),
        observations,
        Translation("ball", axes="xy"),
        loss=SpectrumLoss(),
        optimizer=Optimizer(kind, rate=0.01 if kind == "adam" else 0.08),
        schedule=Schedule(steps),
        seed=seed,
        **changes,
    )
    return fit.scene["ball"].center.detach()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "steps"), [("adam", 50), pytest.param("gauss_newton", 8, marks=pytest.mark.claim)]
)
def test_two_ranges_find_what_each_alone_cannot(seen, kind, steps):
    """A range pins one coordinate to 0.4 cells; two at right angles pin both.

    What a range does not see wanders with the random numbers, and may end anywhere.
    """
    truth = float64(BALL)
    for name, pinned, wandering in (("ahead", 0, 1), ("beside", 1, 0)):
        off = torch.stack([place_of(seen[name], kind, steps, seed) - truth for seed in (1, 2, 3)])
        assert float(off[:, pinned].abs().max()) < 0.03
        assert float(off[:, wandering].abs().max()) > 0.05
    both = place_of(list(seen.values()), kind, steps)
    assert float((both - truth).norm()) < 0.03


@dataclass(frozen=True, eq=False)
class Level(ForwardModel):
    """A model of one's own: the height of an object, seen by a number."""

    sampling: Sampling = Sampling(depth=1, boundary=False)

    def predict(self, scene: Scene, sensor: Tensor, seed: int) -> Tensor:
        x, y, z = scene["ball"].center
        return torch.stack([sensor * x, y**2, z + 0 * x])[None]

    def observe(self, recording: Any) -> Tensor:
        return torch.as_tensor(recording, dtype=torch.float64)[None]


def squared(one: Tensor, other: Tensor) -> Tensor:
    return (one - other).square().sum()


def absolute(one: Tensor, other: Tensor) -> Tensor:
    return (one - other).abs().sum()


def test_the_loss_is_the_weighted_mean_of_the_losses():
    """Each in its own way, on numbers that can be checked by hand."""
    observations = [
        Observation(Level(), [1.0, 0.0, 2.0], sensor=float64(1.0), weight=3.0),
        Observation(Level(), [1.0, 0.0, -1.0], sensor=float64(2.0), weight=1.0, loss=absolute),
    ]
    fit = reconstruct(
        scene(), observations, Translation("ball"), loss=squared, schedule=Schedule(1)
    )
    assert fit.history[0]["loss"] == pytest.approx((3 * 5.0 + 1 * 2.0) / 4)


class FixedLevel(Level):
    """The same, with random numbers that belong to the scene."""

    redraws = False


@pytest.mark.parametrize(("model", "lowest"), [(FixedLevel(), True), (Level(), False)])
def test_a_fit_ends_at_its_lowest_loss_if_every_step_sees_the_same_numbers(model, lowest):
    """Adam overshoots; the square that cannot be met keeps its last loss near the first."""
    observation = Observation(model, [0.0, -1.0, 0.05], sensor=float64(1.0))
    found = reconstruct(
        scene(),
        observation,
        Translation("ball", axes="z"),
        loss=squared,
        optimizer=Optimizer("adam", rate=0.1, final_rate=0.1),
        schedule=Schedule(10),
    )
    losses = [row["loss"] for row in found.history]
    end = 1.0 + (float(found.scene["ball"].center[2]) - 0.05) ** 2
    assert found.status == "budget"
    assert losses[-1] > min(losses)
    assert (end == pytest.approx(min(losses), rel=1e-6)) == lowest
    assert found.loss == pytest.approx(min(losses) if lowest else losses[-1])


def test_weights_say_whom_to_believe():
    """Two that contradict each other: the mean of both, by weight."""

    def found(weight: float) -> float:
        observations = [
            Observation(Level(), [1.0, 0.0, 0.0], sensor=float64(1.0), weight=weight),
            Observation(Level(), [0.0, 0.0, 0.0], sensor=float64(1.0)),
        ]
        fit = reconstruct(
            scene(),
            observations,
            Translation("ball"),
            loss=squared,
            optimizer=Optimizer(rate=0.1, final_rate=1e-4),
            schedule=Schedule(150),
        )
        return float(fit.scene["ball"].center[0].detach())

    assert found(1.0) == pytest.approx(0.5, abs=0.01)
    assert found(3.0) == pytest.approx(0.75, abs=0.01)


class Gain(nn.Module):
    """An unknown of that sensor."""

    def __init__(self) -> None:
        super().__init__()
        self.gain = nn.Parameter(float64(1.0))

    def forward(self, sensor: Tensor) -> Tensor:
        return sensor * self.gain


def test_an_unknown_of_a_sensor_changes_that_sensor_alone():
    observations = [
        Observation(Level(), [1.0, 0.0, 0.0], sensor=float64(1.0)),
        Observation(Level(), [3.0, 0.0, 0.0], sensor=float64(1.0), parameters={"gain": Gain()}),
    ]
    fit = reconstruct(
        scene(),
        observations,
        {"place": Translation("ball")},
        loss=squared,
        optimizer=Optimizer(rate=0.1, final_rate=1e-3),
        schedule=[
            Stage(150, unknowns=("place",)),
            Stage(300, unknowns=("gain",)),
        ],
    )
    # The place alone is the mean of both; then the second sensor explains what is left.
    assert float(fit.scene["ball"].center[0].detach()) == pytest.approx(2.0, abs=0.02)
    assert [float(sensor) for sensor in fit.sensors] == pytest.approx([1.0, 1.5], abs=0.02)


def test_a_model_of_ones_own_derives_from_forward_model(unchecked):
    class Looks:
        def predict(self, scene: Scene, sensor: Any, seed: int) -> Tensor:
            return torch.zeros(1)

        def observe(self, recording: Any) -> Tensor:
            return torch.zeros(1)

    with pytest.raises(InputError, match=r"got <.*; give one .*derive a class from ForwardModel"):
        Observation(Looks(), None)  # type: ignore[arg-type]


@pytest.mark.parametrize("weight", [0.0, -1.0, float("nan")])
def test_weights_are_positive(weight):
    with pytest.raises(InputError, match="expected a weight > 0"):
        Observation(Level(), [0.0, 0.0, 0.0], sensor=float64(1.0), weight=weight)


def test_no_observation_is_refused():
    with pytest.raises(InputError, match="expected at least one observation"):
        reconstruct(scene(), [], Translation("ball"))


class Bend(nn.Module):
    """An unknown of one's own: the ball slides along a parabola."""

    def __init__(self) -> None:
        super().__init__()
        self.way = nn.Parameter(float64(0.3))

    def forward(self, scene: Scene) -> Scene:
        offset = torch.stack([self.way, 0 * self.way, self.way**2])
        return torch.func.functional_call(Translation("ball"), {"translation": offset}, (scene,))


def test_gradients_of_a_module_and_a_model_of_ones_own_are_checked():
    """x = 2 w and z = w²: their derivatives at w = 0.3 are 2 and 0.6."""
    report = gradcheck(
        Level(),
        Bend(),
        float64(1.0),
        scene=scene(),
        sensor=float64(2.0),
        settings=GradcheckSettings(repeats=1, max_pairs=4),
    )
    assert report.gradient[0].tolist() == pytest.approx([2.0, 0.0, 0.6])
    assert report.difference[0].tolist() == pytest.approx([2.0, 0.0, 0.6], abs=1e-9)
    assert report.full.relative_l1 < 1e-9
    assert report.no_interior_edges is None


@pytest.mark.parametrize(
    ("module", "tangent"),
    [
        (RadarPose(), {"translation": float64([0.1, 0.9, 0.3])}),
        (RangeBias(0.02), {"bias": float64(1.0)}),
    ],
    ids=["pose", "bias"],
)
def test_gradients_of_sensor_unknowns_are_checked(module, tangent):
    device = radar()
    model = SurrogateMap(
        device.grid(0.4, 2.8, 0.6, oversample=1),
        Surrogate("gaussian", range_width=2.0, angle_width=1.0),
        Sampling(depth=1, samples=200_000, boundary_samples=50_000),
    )
    report = gradcheck(
        model,
        module,
        tangent,
        scene=occluder(),
        sensor=device,
        acts_on="sensor",
        settings=GradcheckSettings(repeats=2, difference_samples=300_000, noise=0.01, max_pairs=8),
    )
    assert report.full.relative_l1 < 0.03


def frames(case: Any, count: int) -> tuple[list[list[float]], Any]:
    """Where the radar was in every step of a fit, and the fit."""
    looked: list[list[float]] = []

    @dataclass(frozen=True)
    class Spy(SurrogateMap):
        def predict(self, scene: Scene, sensor: Radar, seed: int) -> Tensor:
            looked.append(sensor.positions[:, 1].tolist())
            return super().predict(scene, sensor, seed)

    few = Sampling(depth=1, samples=1_000, boundary_samples=100)
    one = Observation(Spy(case.grid, sampling=few), case.capture, sensor=case.radar)
    fit = reconstruct(
        case.scene,
        [one, one],
        case.parameters(),
        schedule=Schedule(6, frames_per_step=count),
        seed=1,
    )
    return looked[:12], fit


def test_every_observation_has_frames_of_its_own_in_a_step(case):
    looked, _ = frames(case, 2)
    assert all(len(places) == 2 for places in looked)
    assert looked[::2] != looked[1::2]
    assert looked == frames(case, 2)[0]


def test_an_observed_map_is_compared_as_it_is(case):
    """A recording and its map are the same data."""
    few = Sampling(depth=1, samples=1_000, boundary_samples=100)
    model = SurrogateMap(case.grid, sampling=few)
    first, second = (
        Observation(model, data, sensor=case.radar).observed_map()
        for data in (case.capture, model.observe(case.capture))
    )
    assert relative(second, first) == 0
