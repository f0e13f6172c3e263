"""Forward models: what they predict, observe, blur and prepare."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from invertwin.capture import Capture
from invertwin.capture.chirp_capture import ChirpCapture
from invertwin.channel import Sampling, trace_paths
from invertwin.errors import InputError
from invertwin.links import PropagationSettings, ReceiverPoints, Transmitters, frequency_response
from invertwin.models.doppler import RangeDopplerMap
from invertwin.models.facets import FacetField, FacetMap
from invertwin.models.radar import ExactMap, SurrogateMap, surrogate_correlation
from invertwin.models.radio import RadioMap, ResponseMap
from invertwin.radar import Chirps, Radar, Surrogate, velocity_axis
from invertwin.scene import (
    Dielectric,
    Object,
    PerfectConductor,
    Scene,
    box,
    plate,
    rigid,
    trihedral,
)
from invertwin.simulation import simulate, simulate_chirps
from scenes import float64, occluder, radar, relative, thing

FEW = Sampling(samples=2_000, points_per_m2=100.0)


def test_the_surrogate_correlates_with_the_mean_over_looks():
    """One look is mostly speckle; looks averaged over are the surrogate's map."""
    device = radar()
    grid = device.grid(0.7, 1.7, 0.7)
    scene = Scene({"plate": thing(plate(0.6, 0.4), (1.2, 0.1, 0.0), (0.0, 0.0, 0.5))})
    drawn = Sampling(depth=1, samples=100_000, points_per_m2=600.0)

    def found(surrogate: str = "response", looks: int = 24) -> float:
        model = SurrogateMap(grid, surrogate, drawn)
        return surrogate_correlation(scene, device, model, seed=0, realisations=looks)

    assert found() >= 0.9
    assert found(looks=1) < found()
    # Another place is another map.
    away = scene.replace("plate", pose=thing(plate(1, 1), (1.5, -0.4, 0.0)).pose)
    model = SurrogateMap(grid, sampling=Sampling(depth=1, points_per_m2=600.0))
    assert surrogate_correlation(away, device, model, seed=0) >= 0.9
    assert found("gaussian") < found()


def test_looks_of_conductors_are_all_the_same():
    device = radar()
    scene = Scene({"plate": thing(plate(0.2, 0.2), (1.2, 0, 0), material=PerfectConductor())})
    model = SurrogateMap(device.grid(0.7, 1.7, 0.7), sampling=Sampling(conductor_samples=5_000))
    few, many = (
        surrogate_correlation(scene, device, model, seed=0, realisations=looks) for looks in (1, 4)
    )
    assert few == pytest.approx(many, rel=1e-5)


def test_a_correlation_needs_looks():
    device = radar()
    model = SurrogateMap(device.grid(0.5, 2.5))
    with pytest.raises(InputError, match=r"realisations as an integer in \[1, 100000000\], got 0"):
        surrogate_correlation(occluder(), device, model, seed=0, realisations=0)


def test_a_surrogate_goes_by_its_name():
    device = radar()
    grid = device.grid(0.5, 2.5)
    named, smooth = (
        SurrogateMap(grid, surrogate, FEW).predict(occluder(), device, 0)
        for surrogate in ("response", Surrogate())
    )
    assert torch.allclose(named, smooth, rtol=1e-5)
    with pytest.raises(InputError, match="expected a Surrogate or one of exact"):
        SurrogateMap(grid, "sharp")
    with pytest.raises(InputError, match=r'got "exact"; use ExactMap\(grid\)'):
        SurrogateMap(grid, "exact")


def test_extra_widths_are_taken_away_by_shares():
    device = radar()
    model = SurrogateMap(device.grid(0.5, 2.5), Surrogate(range_width=3.0, angle_width=1.5))
    assert model.has_blur
    half = model.scale_blur(0.5).kernels
    assert (half.range_width, half.angle_width) == (1.5, 0.75)
    assert not model.scale_blur(0).has_blur
    assert not ExactMap(model.grid).has_blur
    observed = torch.rand(1, *model.grid.shape)
    blurred = model.kernels.blur(observed, device, model.grid)
    assert torch.equal(model.blur_observed(observed, device), blurred)
    assert torch.equal(ExactMap(model.grid).blur_observed(observed, device), observed)


def test_an_exact_map_is_the_spectrum_of_its_recording():
    device = radar()
    grid = device.grid(0.5, 2.5)
    model = ExactMap(grid, FEW)
    found = simulate(occluder(), device, grid, seed=3, sampling=FEW)
    seen = model.observe(Capture.from_beat(found.beat, device))
    assert relative(model.predict(occluder(), device, 3), seen) < 1e-5


def test_prepared_speckle_stays_while_the_scene_moves():
    """A step of a micrometre is a new look with new points, and the same one with prepared ones."""
    device = radar()
    model, scene = ExactMap(device.grid(0.5, 2.5), FEW), occluder()
    kept = model.prepare(scene, device, 7)
    assert kept.prepare(scene, device, 8) is kept
    first, other = (kept.predict(scene, device, seed) for seed in (1, 2))
    assert relative(other, first) < 1e-5
    assert relative(model.predict(scene, device, 2), model.predict(scene, device, 1)) > 0.1


def test_sampling_is_changed_by_name():
    model = SurrogateMap(radar().grid(0.5, 2.5), sampling=FEW)
    changed = model.with_sampling(depth=1, boundary=False).sampling
    assert changed == replace(FEW, depth=1, boundary=False)


CHIRPS = Chirps(16, 60e-6)
MOVES = Sampling(depth=1, boundary=False, samples=20_000)


def moving(speed: float = 8.0) -> Scene:
    """A small ball that moves away, beside a plate at rest."""
    ball = thing(plate(0.05, 0.05), (1.5, -0.3, 0.0))
    still = thing(plate(0.3, 0.3), (1.9, 0.4, 0.0))
    moves = Scene({"mover": ball, "still": still})
    return moves.replace("mover", velocity=float64([speed, 0.0, 0.0]))


def motion(device: Radar, **changes: Any) -> RangeDopplerMap:
    grid = device.grid(1.0, 2.4, 0.6)
    return replace(RangeDopplerMap.from_chirps(device, grid, CHIRPS, sampling=MOVES), **changes)


def recorded(scene: Scene, device: Radar, looks: int) -> torch.Tensor:
    """The mean map of recordings of other phases."""
    drawn = Sampling(depth=1, points_per_m2=4_000.0)
    model, maps = motion(device), []
    middle = 0.5 * float(CHIRPS.times(1)[-1, 0])
    # A recording begins half a frame before the middle, to which a prediction belongs.
    earlier = scene.replace("mover", pose=scene.advance(-middle)["mover"].pose)
    for seed in range(looks):
        beat = simulate_chirps(earlier, device, CHIRPS, seed=seed, sampling=drawn)
        maps.append(model.observe(ChirpCapture(beat, device, CHIRPS)))
    return torch.stack(maps).mean(0)


@pytest.mark.claim
@pytest.mark.slow
def test_power_in_motion_is_the_mean_of_recordings():
    """The plate at rest is in neither map, and the mover has one place, rate and power in both."""
    device = radar()
    model = motion(device)
    found = model.predict(moving(), device, 1)
    seen = recorded(moving(), device, 40)
    assert found.shape == seen.shape == (1, 32, *model.grid.shape)
    for axes in ((2, 3, 4), (1, 3, 4), (1, 2, 4)):
        truth = seen.sum(axes)
        assert relative(found.sum(axes) * truth.sum() / found.sum(), truth) < 0.08
    assert float(found.sum() / seen.sum()) == pytest.approx(1, abs=0.15)
    rate = float(model.rates[found.sum((0, 2, 3, 4)).argmax()])
    assert rate == pytest.approx(8.0 * 1.5 / (1.5**2 + 0.3**2) ** 0.5, abs=0.6)


def test_derivatives_of_motion_are_those_of_differences():
    device = radar()
    model, step = motion(device), 1e-3
    weights = torch.rand(
        1, 32, *model.grid.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )

    def value(speed: torch.Tensor) -> torch.Tensor:
        velocity = torch.stack([speed, 0 * speed, 0 * speed])
        scene = moving().replace("mover", velocity=velocity)
        return (weights * model.predict(scene, device, 1)).sum()

    speed = torch.tensor(8.0, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(value(speed), speed)
    with torch.no_grad():
        truth = float(value(speed + step) - value(speed - step)) / (2 * step)
    assert float(slope) == pytest.approx(truth, rel=1e-3)


def test_what_stands_still_has_no_map_of_motion():
    device = radar()
    still = moving().replace("mover", velocity=None)
    with pytest.raises(InputError, match="expected an object with a velocity for a MotionMap"):
        motion(device).predict(still, device, 0)
    with pytest.raises(InputError, match=r"expected Sampling\(depth=1, boundary=False\)"):
        motion(device, sampling=Sampling())


def test_a_part_of_a_map_is_cut_around_an_echo():
    device = radar()
    model = motion(device)
    part = model.crop_around(1.6, 1.2, 3, device)
    cell, doppler = device.waveform.range_resolution, float(velocity_axis(device, CHIRPS).diff()[0])
    assert float((part.grid.ranges - 1.6).abs().max()) <= 3 * cell
    assert float((part.rates - 1.2).abs().max()) <= 3 * doppler
    whole, cut = (m.predict(moving(), device, 1) for m in (model, part))
    rows = [int((model.rates - rate).abs().argmin()) for rate in part.rates]
    columns = [int((model.grid.ranges - r).abs().argmin()) for r in part.grid.ranges]
    assert torch.allclose(cut, whole[:, rows][:, :, columns], rtol=1e-6, atol=1e-12)
    with pytest.raises(InputError, match="expected an echo within the map"):
        model.crop_around(9.0, 1.2, 3, device)


def corner() -> Scene:
    item = thing(trihedral(0.05), (1.0, 0.02, 0.0), material=PerfectConductor())
    return Scene({"corner": item})


def test_chains_have_the_strength_of_a_corner_reflector():
    """All chains of three bounces add in phase; the power model adds their powers."""
    device = radar()
    grid = device.grid(0.7, 1.3)
    drawn = Sampling(depth=3, conductor_samples=60_000, boundary=False)
    truth = simulate(corner(), device, grid, seed=1, sampling=drawn).spectrum
    found = FacetMap(grid, sampling=Sampling(depth=3)).predict(corner(), device, 0)
    assert float(found.max()) == pytest.approx(float(truth.max()), rel=0.15)
    assert relative(found, truth.float()) < 0.1


def test_chains_blur_both_maps_alike_and_have_looks():
    device = radar()
    grid = device.grid(0.7, 1.3)
    model = FacetMap(grid, Surrogate(range_width=2.0), Sampling(depth=3))
    sharp = model.scale_blur(0.0)
    assert model.has_blur
    assert not sharp.has_blur
    flat = sharp.predict(corner(), device, 0)
    assert torch.allclose(model.predict(corner(), device, 0), model.blur_observed(flat, device))
    look = sharp.realisations(corner(), device, 0)
    assert look is not None
    assert torch.allclose(look(0, 0.0), flat, rtol=1e-3, atol=float(flat.max()) * 1e-5)
    noise = 1e-3 * float(flat.max())
    assert not torch.equal(look(0, noise), look(1, noise))


def test_chain_fields_are_the_range_profiles_of_a_recording():
    device = radar()
    grid = device.grid(0.7, 1.3)
    drawn = Sampling(depth=3, conductor_samples=60_000, boundary=False)
    beat = simulate(corner(), device, grid, seed=1, sampling=drawn).beat
    model = FacetField(grid, sampling=Sampling(depth=3))
    truth = model.observe(Capture.from_beat(beat, device))
    found = model.predict(corner(), device, 0)
    assert found.shape == truth.shape == (*found.shape[:3], 2)
    assert relative(found, truth) < 0.2
    away = corner().replace("corner", pose=thing(plate(1, 1), (1.001, 0.02, 0.0)).pose)
    assert relative(model.predict(away, device, 0), truth) > 1.0


def test_looks_at_chain_fields_have_the_noise_that_is_asked_for():
    device = radar()
    model = FacetField(device.grid(0.7, 1.3), sampling=Sampling(depth=3))
    flat = model.predict(corner(), device, 0)
    look = model.realisations(corner(), device, 0)
    assert look is not None
    assert torch.allclose(look(0, 0.0), flat)
    noise = 0.01 * float(flat.square().max())
    found = torch.stack([look(number, noise) - flat for number in range(20)])
    # How strong noise is in a map is known from one draw of it.
    assert float(found.square().mean()) == pytest.approx(noise, rel=0.3)
    assert abs(float(found.mean())) < 0.1 * noise**0.5


HALL = Scene({"hall": Object(box((6.0, 5.0, 3.0)), Dielectric(5.0, 0.1, scattering=0.0))})
SPOTS = ReceiverPoints(float64([[2.0, 1.0, 0.3], [-1.0, 1.5, -0.4], [0.3, -2.0, 0.8]]))
MAST = Transmitters(float64([[-2.0, -1.0, 0.5], [1.5, 2.0, 0.2]]), power_dbm=float64([10.0, 13.0]))


def test_levels_of_a_radio_map():
    reception = PropagationSettings(2.4e9, 1e8, depth=2)
    shown = {
        name: RadioMap(SPOTS, reception, name).predict(HALL, MAST, 0)  # type: ignore[arg-type]
        for name in ("path_gain", "received_power", "sinr", "delay_spread")
    }
    assert all(power.shape == (2, 3) for power in shown.values())
    found = RadioMap(SPOTS, reception).link_statistics(HALL, MAST, 0)
    torch.testing.assert_close(shown["path_gain"], 10 * found.gain.log10(), rtol=1e-9, atol=0)
    torch.testing.assert_close(
        shown["received_power"] - shown["path_gain"], float64([[10.0] * 3, [13.0] * 3])
    )
    power = 10 ** (shown["received_power"] / 10)
    ratio = power / (power.flip(0) + 1e-10)
    torch.testing.assert_close(shown["sinr"], 10 * ratio.log10())
    assert torch.equal(shown["delay_spread"], found.delay_spread)


def test_derivatives_of_a_radio_map_are_differences():
    model = RadioMap(SPOTS, PropagationSettings(2.4e9, 1e8, depth=2, edges=1))
    scene = Scene(
        {**HALL.objects, "cup": Object(box((0.5, 0.9, 1.7)), Dielectric(3.0, 0.02), rigid())}
    )
    place = float64([-2.0, -1.0, 0.5])

    def shown(x: Tensor) -> Tensor:
        return model.predict(scene, Transmitters(place + float64([x, 0.7 * x, -0.4 * x])), 0)

    # From 1e-6 to 1e-5 a path ends that is mirrored and diffracted: 1e-6 of the field are lost.
    step = 1e-6
    expected = (shown(float64(step)) - shown(float64(-step))) / (2 * step)
    x = torch.zeros((), dtype=torch.float64)
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(x, torch.ones_like(x))
        way = float64([1.0, 0.7, -0.4])
        found = model.predict(scene, Transmitters(place + dual * way), 0)
        forward = torch.autograd.forward_ad.unpack_dual(found).tangent
    torch.testing.assert_close(forward, expected, rtol=1e-5, atol=1e-5)
    back = torch.autograd.functional.jacobian(
        lambda x: model.predict(scene, Transmitters(place + x * way), 0), x
    )
    torch.testing.assert_close(back, expected, rtol=1e-5, atol=1e-5)


def test_unreached_points_have_finite_levels_and_derivatives():
    sealed = HALL.replace("hall", material=PerfectConductor())
    place = torch.tensor([9.0, 0.0, 0.0], dtype=torch.float64, requires_grad=True)
    model = RadioMap(SPOTS, PropagationSettings(2.4e9, 0.0), floor_db=-150.0)
    level = model.predict(sealed, Transmitters(place), 0)
    torch.testing.assert_close(level.detach(), torch.full((1, 3), -150.0).double())
    mixed = (level + place.sum()).sum()
    assert bool(torch.isfinite(torch.autograd.grad(mixed, place)[0]).all())


@pytest.mark.usefixtures("unchecked")
def test_measured_levels_have_the_shape_of_the_map():
    model = RadioMap(SPOTS, PropagationSettings(2.4e9))
    assert model.observe([-50.0, -60.0, -70.0]).shape == (1, 3)
    assert model.observe([[-50.0, -60.0, -70.0]] * 2).shape == (2, 3)
    with pytest.raises(InputError, match="measured received power"):
        model.observe([-50.0, -60.0])
    with pytest.raises(InputError, match="quantity to be one of received_power"):
        RadioMap(SPOTS, PropagationSettings(2.4e9), "rssi")  # type: ignore[arg-type]


def test_looks_of_a_radio_map_scatter_as_told():
    known = RadioMap(SPOTS, PropagationSettings(2.4e9), scatter=2.0)
    open_ = replace(known, scatter=None)
    mean = known.predict(HALL, MAST, 0)
    for model, deviation in ((known, 2.0), (open_, 0.5)):
        look = model.realisations(HALL, MAST, 0)
        drawn = torch.stack([look(number, 0.25) for number in range(200)]) - mean
        assert float(drawn.std()) == pytest.approx(deviation, rel=0.1)
        assert torch.equal(look(3, 0.25), look(3, 0.25))


def test_responses_are_those_of_the_paths():
    swept = float64([2.39e9, 2.4e9, 2.41e9])
    model = ResponseMap(SPOTS.positions, swept, PropagationSettings(2.4e9, depth=2))
    found = model.predict(HALL, MAST, 0)
    assert found.shape == (2, 3, 3, 2)
    paths = trace_paths(HALL, MAST.positions, SPOTS.positions, 2.4e9, depth=2, rays=100_000)
    expected = frequency_response(paths, swept)[:, 0, :, 0].transpose(0, 1)
    torch.testing.assert_close(torch.view_as_complex(found.contiguous()), expected)
    assert torch.equal(model.observe(expected), torch.view_as_real(expected))
    with pytest.raises(InputError, match="measured responses"):
        model.observe(expected[:, :2])


def test_a_batch_of_scenes_is_predicted_as_each_alone():
    device = radar(((0.0, 0.0, 0.0), (0.0, 0.2, 0.0)))
    grid = device.grid(0.7, 2.3, 0.5)
    drawn = Sampling(depth=2, samples=100_000, boundary_samples=20_000)
    model = SurrogateMap(grid, Surrogate(range_width=1.0), drawn)
    scenes = [
        occluder(),
        occluder().replace("occluder", pose=thing(plate(1, 1), (1.3, 0.2, 0)).pose),
    ]
    batch = model.predict_batch(scenes, device, 1)
    assert batch.shape == (2, 2, *grid.shape)
    for scene, found in zip(scenes, batch, strict=True):
        assert relative(found, model.predict(scene, device, 2)) < 0.03
    assert relative(batch[0], batch[1]) > 0.1
    fixed = model.for_differences(scenes[0], device, 1_000, "rays")
    with pytest.raises(InputError, match="made for differences"):
        fixed.predict_batch(scenes, device, 1)
