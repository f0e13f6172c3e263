"""Fits beside things that the scene lacks."""

import math
from typing import Any

import pytest
import torch

import invertwin as iw
from invertwin.discovery import (
    estimate_clutter,
    finds_lobes,
    reconstruct_among_clutter,
    reconstruct_with_permittivities,
)
from invertwin.errors import InputError
from invertwin.inversion import Optimizer, SpectrumLoss
from invertwin.models import ExactMap, SurrogateMap
from invertwin.scene import (
    AntennaArray,
    Dielectric,
    MaterialValues,
    Pose,
    RoughDielectric,
    box,
    linear_array,
    plate,
    rigid,
    rotation_from_vector,
    text,
)
from scenes import float64

CHIRP = iw.FMCW(77e9, 3.6e9, 50e-6, 128)
PAINT = RoughDielectric(4.0)
FIT: dict[str, Any] = {
    "loss": SpectrumLoss(floor=0.02),
    "optimizer": Optimizer("gauss_newton", rate=0.3),
    "schedule": iw.Schedule(10, annealing=0.6),
}


def rail() -> iw.Radar:
    places = torch.zeros(8, 3, dtype=torch.float64)
    places[:, 1] = torch.linspace(-1.1, 1.1, 8)
    transmitter = AntennaArray(torch.zeros(1, 3, dtype=torch.float64))
    return iw.Radar(transmitter, linear_array(8, CHIRP.wavelength / 2), CHIRP, places)


def letter(shift: tuple[float, float], turn: float) -> iw.Object:
    mesh = text("L", size=0.6, depth=0.12)
    rotation = rotation_from_vector(float64([0, 0, turn]))
    return iw.Object(
        mesh,
        PAINT,
        rigid(rotation, float64([2.1 + shift[0], shift[1], 0]) - rotation @ mesh.center),
    )


@pytest.fixture(scope="module")
def recording():
    """A letter before a wall, and a box beside it that the model lacks."""
    wall = iw.Object(plate(3.6, 1.6), PAINT, rigid(translation=float64([3.9, 0, 0])))
    stranger = iw.Object(box((0.25, 0.25, 0.4)), PAINT, rigid(translation=float64([2.2, 0.65, 0])))
    truth = iw.Scene({"letter": letter((0, 0), 0.2), "wall": wall})
    sensor = rail()
    grid = sensor.grid(range_min=0.8, range_max=4.6, u_max=0.75)
    scene = iw.Scene({**truth.objects, "stranger": stranger})
    points = iw.Sampling(depth=1, points_per_m2=4e3)
    data = iw.simulate(scene, sensor, grid, seed=5, sampling=points, snr_db=20.0)
    sampling = iw.Sampling(depth=1, samples=30_000, boundary_samples=6_000)
    model = SurrogateMap(grid, iw.Surrogate(range_width=8.0, angle_width=1.0), sampling)
    observation = iw.Observation(model, iw.Capture.from_beat(data.beat, sensor))
    return truth, scene, observation


def test_clutter_is_the_echo_of_what_the_scene_lacks(recording):
    truth, scene, observation = recording
    model = observation.model.scale_blur(0.0)
    found = estimate_clutter(truth, observation, ["letter"]).background
    sensor = observation.initial_sensor()
    with torch.no_grad():
        whole, known = (model.predict(s, sensor, 0).double() for s in (scene, truth))
    missing = (whole - known).clamp_min(0)
    excess = found - found.min()
    assert float(torch.corrcoef(torch.stack([missing.flatten(), excess.flatten()]))[0, 1]) > 0.8
    gain = SpectrumLoss().fitted_gain(whole, observation.observed_map())
    assert float(excess.sum()) == pytest.approx(gain * float(missing.sum()), rel=0.35)


def test_a_stranger_beside_the_object_does_not_pull_it(recording):
    truth, _, observation = recording
    start = iw.Scene({"letter": letter((0.06, -0.05), 0.3), "wall": truth["wall"]})
    ends = {}
    for name, fit in (("plain", iw.reconstruct), ("clutter", reconstruct_among_clutter)):
        found = fit(start, observation, Pose("letter", axes="xy", rotation_axes="z"), seed=1, **FIT)
        ends[name] = found
    off = {k: (v.scene["letter"].center - truth["letter"].center) for k, v in ends.items()}
    assert float(off["plain"].norm()) > 0.1
    assert float(off["clutter"].norm()) < 0.035
    rotation = (
        ends["clutter"].scene["letter"].transform[:3, :3] @ truth["letter"].transform[:3, :3].T
    )
    assert math.degrees(math.acos(min(1.0, float((rotation.trace() - 1) / 2)))) < 4
    bars = ends["clutter"].uncertainty.deviations
    assert abs(float(off["clutter"][0])) < 4 * bars["letter.x"]
    assert abs(float(off["clutter"][1])) < 4 * bars["letter.y"]
    assert ends["plain"].verdict.word != "consistent"
    # Clutter could be parts of a letter that stands elsewhere.
    assert ends["clutter"].verdict.word != "consistent"
    assert "they may be parts of these" in ends["clutter"].verdict.reasons[-1]


def test_what_has_no_clutter_is_named(recording):
    truth, _, observation = recording
    pose = Pose("letter", axes="xy")
    plan = iw.Schedule(4, frames_per_step=2)
    with pytest.raises(InputError, match="expected all frames and the same"):
        reconstruct_among_clutter(truth, observation, pose, schedule=plan)
    with pytest.raises(InputError, match="expected a parameter that moves an object"):
        reconstruct_among_clutter(truth, observation, MaterialValues("letter", permittivity=3.0))
    exact = iw.Observation(ExactMap(observation.model.grid), observation.data)
    with pytest.raises(InputError, match="expected a SurrogateMap for clutter"):
        estimate_clutter(truth, exact, ["letter"])


@pytest.fixture(scope="module")
def lobed(recording):
    """A letter with a lobe of 25°, and a start that takes it for matt."""
    truth, _, observation = recording
    shiny = RoughDielectric(4.0, diffuse=0.3, lobe_width=math.radians(25))
    sensor, grid = observation.initial_sensor(), observation.model.grid
    points = iw.Sampling(depth=1, points_per_m2=4e3)
    scene = truth.replace("letter", material=shiny)
    data = iw.simulate(scene, sensor, grid, seed=7, sampling=points, snr_db=20.0)
    start = iw.Scene({"letter": letter((0.06, -0.05), 0.3), "wall": truth["wall"]})
    capture = iw.Capture.from_beat(data.beat, sensor)
    return truth, start, iw.Observation(observation.model, capture)


@pytest.mark.slow
def test_a_lobe_that_the_model_lacks_is_found(lobed):
    truth, start, observation = lobed
    pose = Pose("letter", axes="xy", rotation_axes="z")
    found = reconstruct_among_clutter(start, observation, pose, seed=1, always=False, **FIT)
    assert found.verdict.word == "consistent"
    assert finds_lobes(found, start)
    material, bars = vars(found.scene["letter"].material), found.uncertainty.deviations
    for name, value in (("diffuse", 0.3), ("lobe_width", math.radians(25))):
        assert abs(float(material[name]) - value) < 3 * bars[f"letter.{name}"] < 0.6
    off = (found.scene["letter"].center - truth["letter"].center).abs()
    assert float(off.norm()) < 0.02
    assert float(off[0]) < 3 * bars["letter.x"]
    assert float(off[1]) < 3 * bars["letter.y"]


def test_lobes_that_the_data_do_not_need_are_none(recording):
    """A matt letter has a diffuse share near 1, and lobes as wide as one likes."""
    truth, _, observation = recording
    points = iw.Sampling(depth=1, points_per_m2=4e3)
    sensor, grid = observation.initial_sensor(), observation.model.grid
    data = iw.simulate(truth, sensor, grid, seed=8, sampling=points, snr_db=20.0)
    given = [iw.Observation(observation.model, iw.Capture.from_beat(data.beat, sensor))]
    start = iw.Scene({"letter": letter((0.03, -0.02), 0.25), "wall": truth["wall"]})
    pose = Pose("letter", axes="xy", rotation_axes="z")
    found = reconstruct_with_permittivities(start, given, pose, lobes=True, seed=1, **FIT)
    assert found.verdict.word == "consistent"
    assert not finds_lobes(found, start)


def test_lobes_are_those_of_rough_dielectrics(lobed):
    _, start, observation = lobed
    wooden = start.replace("letter", material=Dielectric(4.0, scattering=1.0))
    with pytest.raises(InputError, match=r"known permittivity and lobe beside .* got none"):
        reconstruct_with_permittivities(
            wooden, [observation], Pose("letter", axes="xy"), lobes=True, seed=1, **FIT
        )


def test_permittivities_start_where_the_first_maps_are_most_likely(recording):
    """From 8 instead of 2, the fit ended 0.17 m away: dimmer poses came before a dimmer surface."""
    truth, _, observation = recording
    dim = truth.replace("letter", material=RoughDielectric(2.0))
    points = iw.Sampling(depth=1, points_per_m2=4e3)
    sensor, grid = observation.initial_sensor(), observation.model.grid
    data = iw.simulate(dim, sensor, grid, seed=6, sampling=points, snr_db=20.0)
    capture = iw.Capture.from_beat(data.beat, sensor)
    start = iw.Scene({"letter": letter((0.06, -0.05), 0.3), "wall": truth["wall"]})
    start = start.replace("letter", material=RoughDielectric(8.0))
    pose = Pose("letter", axes="xy", rotation_axes="z")
    given = [iw.Observation(observation.model, capture)]
    found = reconstruct_with_permittivities(start, given, pose, seed=1, **FIT)
    first = found.result.fit.progress.history[0]["values"]["letter.permittivity"]
    assert first == pytest.approx(2.0, rel=0.2)
    assert float((found.scene["letter"].center - truth["letter"].center).norm()) < 0.01
