"""Twins of recordings: what is there is found, and nothing where there is nothing."""

import math
from dataclasses import replace

import pytest
import torch

import invertwin as iw
from invertwin.capture import Capture, ChirpCapture
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.discovery import Twin, average_chirps, twin
from invertwin.discovery.imaging.point_detections import is_dense_track
from invertwin.discovery.search import ShapeSearch
from invertwin.discovery.shapes.primitives import ShapeParameters
from invertwin.errors import InputError
from invertwin.radar import Chirps, add_noise
from invertwin.scene import (
    AntennaArray,
    Cosine,
    RoughDielectric,
    box,
    cylinder,
    linear_array,
    rigid,
    rotation_from_vector,
    sphere,
)
from oracles.moving_point import moving_point

CHIRP = iw.FMCW(start_frequency=77e9, bandwidth=4e9, duration=50e-6, samples=128)
HALF = CHIRP.wavelength / 2
PAINT = RoughDielectric(permittivity=5.0)
CHAIN = iw.Sampling(depth=1, points_per_m2=500.0, boundary=False)
HEIGHT = 0.6


def around(count: int) -> iw.Radar:
    """A board at places about the middle, looking at it."""
    turns = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    out = torch.stack([turns.sin(), turns.cos(), 0 * turns], dim=1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(out)
    axes = torch.stack([-out, torch.linalg.cross(up, -out), up], dim=-1)
    patch = Cosine(1.0)
    return iw.Radar(
        linear_array(2, 4 * HALF, pattern=patch),
        linear_array(4, HALF, pattern=patch),
        CHIRP,
        1.8 * out + HEIGHT * up,
        axes,
    )


def thing(mesh, place: tuple[float, float], height: float, yaw: float = 0.0) -> iw.Object:
    turn = rotation_from_vector(torch.tensor([0.0, 0.0, yaw], dtype=torch.float64))
    where = torch.tensor([*place, height], dtype=torch.float64)
    return iw.Object(mesh, PAINT, rigid(turn, where))


@pytest.fixture(scope="module")
def room() -> Twin:
    """A box and a cylinder from twelve places."""
    radar = around(12)
    scene = iw.Scene(
        {
            "box": thing(box((0.3, 0.5, 0.9)), (0.2, -0.35), 0.45, 0.5),
            "post": thing(cylinder(0.12, 1.0), (-0.3, 0.5), 0.5),
        }
    )
    grid = radar.grid(0.5, 3.5)
    found = iw.simulate(scene, radar, grid, seed=3, sampling=CHAIN, snr_db=10.0)
    capture = Capture.from_beat(found.beat, radar)
    return twin(capture, low=(-1.2, -1.2), high=(1.2, 1.2), level=0.0)


@pytest.mark.slow
def test_what_stands_in_a_room_is_found(room: Twin):
    assert len(room.objects) == 2
    by_kind = {one.kind: one for one in room.objects}
    assert set(by_kind) == {"box", "cylinder"}
    for kind, place in (("box", (0.2, -0.35)), ("cylinder", (-0.3, 0.5))):
        one = by_kind[kind]
        assert math.dist(one.position[:2].tolist(), place) < 0.03
        assert one.existence_probability > 0.95
        for axis, value in enumerate(place):
            assert abs(float(one.position[axis]) - value) < 4 * one.deviations["xy"[axis]]
        assert sum(one.probabilities.values()) == pytest.approx(1.0)
    figure = by_kind["box"].shape
    assert figure is not None
    sides = sorted((figure.length, figure.width))
    assert sides == pytest.approx([0.3, 0.5], abs=0.05)
    long_way = figure.yaw if figure.width > figure.length else figure.yaw + math.pi / 2
    assert abs(math.remainder(long_way - 0.5, math.pi)) < math.radians(4)


@pytest.mark.slow
def test_what_is_likelier_something_else_becomes_that(monkeypatch):
    """The search ends with a box where a post stands."""
    monkeypatch.setattr(
        ShapeSearch,
        "run",
        lambda _: [ShapeParameters("box", (0.2, 0.1), 0.3, 0.25, 0.3, 1.0, 0.05)],
    )
    radar = around(8)
    scene = iw.Scene({"post": thing(cylinder(0.2, 1.0), (0.2, 0.1), 0.5)})
    grid = radar.grid(0.5, 3.5)
    beat = iw.simulate(scene, radar, grid, seed=3, sampling=CHAIN, snr_db=10.0).beat
    (one,) = twin(
        Capture.from_beat(beat, radar), low=(-0.6, -0.6), high=(0.6, 0.6), level=0.0
    ).objects
    assert one.shape is not None
    assert (one.kind, one.shape.kind) == ("cylinder", "cylinder")
    assert one.probabilities["cylinder"] > 0.5
    assert one.shape.length == pytest.approx(0.4, abs=0.04)
    assert {"x", "y", "length", "height", "brightness"} == set(one.deviations)


@pytest.mark.slow
def test_the_inside_of_a_box_is_never_seen(room: Twin):
    assert room.image is not None
    inside = (room.image.positions - torch.tensor([0.2, -0.35])).norm(dim=1) < 0.1
    assert int(inside.sum()) > 5
    assert int(room.image.view_counts[inside].max()) == 0
    assert int(room.image.view_counts.max()) > 4


@pytest.mark.slow
def test_maps_of_the_twin_explain_the_recording(room: Twin):
    """Speckle of one look is an exponential draw: its logarithm has a deviation of π/√6."""
    assert room.observed is not None
    assert room.predicted is not None
    spread = (room.observed.double() / room.predicted.double()).log().std()
    assert float(spread) == pytest.approx(math.pi / math.sqrt(6), rel=0.06)
    assert room.scene is not None
    assert room.scene.names == tuple(one.name for one in room.objects)


def test_noise_is_nothing():
    radar = around(4)
    noise = torch.randn(4, 2, 4, 128, dtype=torch.complex128, generator=torch.manual_seed(0))
    found = twin(Capture.from_beat(1e-6 * noise, radar))
    assert found.objects == ()
    (note,) = found.notes
    assert note.startswith("nothing is above the noise from ")
    assert "the brightest bin, at " in note
    assert found.scene is None


@pytest.mark.slow
def test_echoes_that_no_shape_explains_are_listed_as_points(monkeypatch):
    radar = around(1)
    noise = torch.randn(1, 2, 4, 128, dtype=torch.complex128, generator=torch.manual_seed(0))
    echo = moving_point(radar, Chirps(1, 1e-4), 1.5, 0.0, 0.2)[:, 0]
    monkeypatch.setattr(ShapeSearch, "run", lambda self: [])
    monkeypatch.setattr(ShapeSearch, "fit_spheres", lambda self, places: [])
    found = twin(Capture.from_beat(echo + 1e-2 * noise, radar))
    assert found.scene is None
    assert found.notes[0].startswith("no shape fits the maps")
    assert [one.kind for one in found.objects] == ["point"]
    off = found.objects[0].position - radar.positions[0]
    assert float(off.norm()) == pytest.approx(1.5, abs=0.03)
    assert found.objects[0].deviations["across"] > 0


def test_one_small_ball_is_one_thing():
    radar = around(8)
    scene = iw.Scene({"ball": thing(sphere(0.02, 3), (0.1, 0.3), HEIGHT)})
    sampling = iw.Sampling(depth=1, points_per_m2=2e4, boundary=False)
    found = iw.simulate(scene, radar, radar.grid(0.5, 3.0), seed=1, sampling=sampling, snr_db=10.0)
    seen = twin(Capture.from_beat(found.beat, radar), low=(-1.0, -1.0), high=(1.0, 1.0), level=0.0)
    (one,) = seen.objects
    assert math.dist(one.position[:2].tolist(), (0.1, 0.3)) < 0.03


@pytest.mark.slow
def test_two_in_one_cell_are_not_more_than_two():
    radar = around(8)
    scene = iw.Scene(
        {
            "one": thing(sphere(0.02, 3), (0.1, 0.3), HEIGHT),
            "other": thing(sphere(0.02, 3), (0.125, 0.3), HEIGHT),
        }
    )
    sampling = iw.Sampling(depth=1, points_per_m2=2e4, boundary=False)
    found = iw.simulate(scene, radar, radar.grid(0.5, 3.0), seed=1, sampling=sampling, snr_db=10.0)
    seen = twin(Capture.from_beat(found.beat, radar), low=(-1.0, -1.0), high=(1.0, 1.0), level=0.0)
    assert 1 <= len(seen.objects) <= 2
    for one in seen.objects:
        assert math.dist(one.position[:2].tolist(), (0.1125, 0.3)) < 0.04


@pytest.mark.slow
def test_what_moves_and_what_stands_at_one_range_are_two():
    half = HALF
    still = torch.zeros(1, 3, dtype=torch.float64)
    radar = iw.Radar(AntennaArray(still), linear_array(8, half), CHIRP, still)
    moving = iw.Object(
        sphere(0.1, 3),
        PAINT,
        rigid(translation=[1.6, 0.8, 0.0]),
        velocity=torch.tensor([1.5, 0.0, 0.0], dtype=torch.float64),
    )
    resting = iw.Object(sphere(0.1, 3), PAINT, rigid(translation=[1.6, -0.8, 0.0]))
    chirps = Chirps(64, 60e-6)
    sampling = iw.Sampling(depth=1, points_per_m2=3000.0, boundary=False)
    scene = iw.Scene({"moving": moving, "resting": resting})
    beat = iw.simulate_chirps(scene, radar, chirps, seed=0, sampling=sampling)
    beat = add_noise(beat, snr_db=20.0, seed=1)
    recording = ChirpCapture(beat, radar, chirps)
    found = twin(recording, level=-0.6, rays=1000)
    movers = [one for one in found.objects if one.velocity is not None]
    (mover,) = [one for one in movers if one.existence_probability > 0.5]
    assert mover.velocity is not None
    way = math.hypot(0.8, 1.6)
    assert float(mover.position.norm()) == pytest.approx(way - 0.08, abs=0.1)
    assert float(mover.velocity.norm()) == pytest.approx(1.5 * 1.6 / way, abs=0.3)
    assert float(mover.position[1]) > 0.3
    assert (
        min(one.existence_probability for one in movers) > 0.05
    )  # no line for what is not believed
    # The echo comes from the front of the ball, three quarters of its radius before the middle.
    truth = (1 - 0.075 / way) * torch.tensor([1.6, 0.8, 0.0], dtype=torch.float64)
    sight = torch.nn.functional.normalize(truth, dim=0)
    along = float((mover.position - truth) @ sight)
    across = float((mover.position - truth - along * sight).norm())
    assert abs(along) < 3 * mover.deviations["range"] < 0.15
    assert across < 3 * mover.deviations["across"] < 0.6
    (rest,) = [
        one for one in found.objects if one.velocity is None and one.existence_probability > 0.5
    ]
    assert math.dist(rest.position[:2].tolist(), (1.6, -0.8)) < 0.2


@pytest.mark.data
def test_both_reflectors_on_the_rail_are_found(data_folder):
    from invertwin_studies.recordings import rail_sar

    capture = rail_sar.read(data_folder / "rail_sar")
    assert is_dense_track(capture)
    found = twin(capture, level=0.0, height=0.0)
    survey = torch.tensor([[2.203936, -3.873749], [2.32899, 1.037974]], dtype=torch.float64)
    sure = [one.position[:2] for one in found.objects if one.existence_probability > 0.5]
    assert len(sure) == 2
    away = torch.cdist(survey, torch.stack(sure)).amin(1)
    assert float(away.max()) < 0.2


@pytest.mark.data
def test_the_strongest_mover_of_the_board_is_found(data_folder):
    from invertwin.radar.boards import Mounting
    from invertwin.registry.kinds import load_plugins, registry

    load_plugins()
    table = registry.kind_table("data", "openradar")
    recording = table.made_by(str(data_folder / "openradar"), board=Mounting("xWR1642", None, 1))
    found = twin(recording)
    strongest = max(found.objects, key=lambda one: one.name == "mover_1")
    assert strongest.velocity is not None
    assert float(strongest.position.norm()) == pytest.approx(2.93, abs=0.05)
    assert strongest.existence_probability > 0.9
    assert float(strongest.velocity.norm()) > 0.2


def test_what_rests_keeps_its_signal_and_what_moves_fades():
    radar, chirps = around(1), Chirps(32, 100e-6)
    turns = 2.5 * torch.arange(32, dtype=torch.float64) / 32  # two and a half bins of range rate
    mover = torch.exp(2j * torch.pi * turns)[:, None, None, None]
    for signal, least, most in ((torch.ones_like(mover), 1 - 1e-12, 1 + 1e-12), (mover, 0, 6e-4)):
        beat = signal.expand(1, 32, 2, 4, 128).contiguous()
        power = average_chirps(ChirpCapture(beat, radar, chirps)).beat.abs().square()
        assert least <= float(power.min()) <= float(power.max()) <= most


def test_a_region_that_nothing_sees_is_refused():
    radar = around(4)
    beat = torch.randn(4, 2, 4, 128, dtype=torch.complex128, generator=torch.manual_seed(0))
    beat[..., :] += 50 * torch.exp(2j * torch.pi * 0.3 * torch.arange(128))
    capture = Capture.from_beat(beat, radar)
    assert average_chirps(capture) is capture
    with pytest.raises(InputError, match="some radar sees"):
        twin(capture, low=(50.0, 50.0), high=(51.0, 51.0))
    with pytest.raises(InputError, match="low below high"):
        twin(capture, low=(1.0, 1.0), high=(-1.0, 1.0))
    with pytest.raises(InputError, match="range_max"):
        twin(capture, range_max=0.01)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::invertwin.errors.PhysicsWarning")
@pytest.mark.parametrize("seed", [0, 1])
def test_two_receivers_a_wavelength_apart_leave_two_places(seed):
    """The echo is found in one of two lobes; its error bars reach the other, which a note names."""
    ramp = iw.FMCW(77e9, 1e9, 50e-6, 128)
    row = linear_array(2, ramp.wavelength, pattern=Cosine(1.0))
    still = torch.zeros(1, 3, dtype=torch.float64)
    radar = iw.Radar(linear_array(1, 1.0, pattern=Cosine(1.0)), row, ramp, still)
    truth = 3 * math.cos(0.4), 3 * math.sin(0.4)
    scene = iw.Scene({"ball": thing(sphere(0.1, 3), truth, 0.0)})
    sampling, chirps = replace(CHAIN, points_per_m2=3000.0), Chirps(16, 60e-6)
    beat = iw.simulate_chirps(scene, radar, chirps, seed=seed, sampling=sampling)
    recording = ChirpCapture(add_noise(beat, snr_db=40.0, seed=seed), radar, chirps)
    found = twin(recording, range_max=6.0, level=-0.6, rays=1000, seed=seed)
    (one,) = found.objects
    assert one.existence_probability > 0.95
    assert 0.5 < one.deviations["y"] < 3.0
    for axis, value in enumerate(truth):
        assert abs(float(one.position[axis]) - value) < 2.5 * one.deviations["xy"[axis]]
    (note,) = found.notes
    assert note.startswith("object_1 may be elsewhere with probability ")


@pytest.mark.slow
@pytest.mark.parametrize("receivers", [2, 4])
def test_echoes_of_few_receivers_are_where_a_detector_finds_them(receivers):
    ramp = iw.FMCW(77e9, 1e9, 50e-6, 128)
    row = linear_array(receivers, ramp.wavelength / 2)
    radar = iw.Radar(linear_array(1, 1.0), row, ramp, torch.zeros(1, 3, dtype=torch.float64))
    beat = torch.zeros(1, 1, receivers, 128, dtype=torch.complex128)
    truth = {}
    for distance, sine, amplitude in ((2.0, -0.3, 1.0), (3.7, 0.3, 0.3)):
        cosine = math.sqrt(1 - sine * sine)
        place = distance * torch.tensor([cosine, sine, 0.0], dtype=torch.float64)
        truth[distance] = place[:2]
        ways = place.norm() + (place - row.positions).norm(dim=1)
        delays = ways[:, None] / SPEED_OF_LIGHT
        cycles = 77e9 * delays + 1e9 / 50e-6 * delays * ramp.sample_times
        beat[0, 0] += amplitude * torch.exp(2j * math.pi * cycles)
    capture = iw.Capture.from_beat(add_noise(beat, snr_db=40.0, seed=0), radar)
    found = [one.position[:2] for one in twin(capture, range_max=6.0, rays=1000).objects]
    assert len(found) == 2
    for place in truth.values():
        assert min(float((place - one).norm()) for one in found) < 0.2


def test_echoes_later_than_the_region_are_left_out(monkeypatch):
    """A post outside the region, 2.5 m behind it, as what stands in a mirror would be."""
    monkeypatch.setattr(ShapeSearch, "run", lambda _: [])
    radar = around(8)
    scene = iw.Scene({"post": thing(cylinder(0.2, 1.0), (0.0, -2.5), 0.5)})
    grid = radar.grid(0.5, 4.6)
    beat = iw.simulate(scene, radar, grid, seed=3, sampling=CHAIN, snr_db=10.0).beat
    capture = Capture.from_beat(beat, radar)
    ends = []
    for half in (0.5, 3.0):
        found = twin(capture, low=(-half, -half), high=(half, half), level=0.0)
        assert found.grid is not None
        ends.append(float(found.grid.ranges[-1]))
    cell = CHIRP.range_resolution
    farthest = 1.8 + 0.5 * math.sqrt(2)
    assert farthest < ends[0] < math.hypot(farthest, HEIGHT) + 12 * cell
    assert ends[1] > 4.0
