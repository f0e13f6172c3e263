"""Echoes by mirrors (ghosts): image antennas, the flash of a wall, derivatives and refusals."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from invertwin.channel import Grid, Link, Sampling, deposit_power, draw_speckle, trace_field
from invertwin.channel.coverage import shadow_boundaries
from invertwin.channel.coverage.mirrors import (
    deposit_mirrored_power,
    trace_field_with_mirrors,
    trace_mirrored_power,
)
from invertwin.channel.coverage.single_scattering import without_specular
from invertwin.errors import InputError
from invertwin.models import RangeDopplerMap, SurrogateMap
from invertwin.radar import FMCW, Chirps, Radar, range_doppler_angle, velocity_axis
from invertwin.radar.signal.chirps import range_rate
from invertwin.scene import (
    Dielectric,
    Isotropic,
    Material,
    Object,
    PerfectConductor,
    RoughDielectric,
    Scene,
    box,
    plate,
    rigid,
    rotation_from_vector,
    sphere,
)
from invertwin.scene.antenna import linear_array
from invertwin.simulation import simulate, simulate_chirps
from scenes import float64

WAVELENGTH = 0.004
GRID = Grid(0.4, 0.05, 120)
ORIGIN = float64([[0.0, 0.0, 0.0]])
IMAGE = float64([[0.0, -1.0, 0.0]])  # of the origin in the wall
SAMPLING = Sampling(3, 400_000, boundary_samples=160_000, conductor_samples=20_000)
PAINT = RoughDielectric(5.0)


def link(tx: Tensor = ORIGIN, rx: Tensor = ORIGIN, *, shared: bool = True) -> Link:
    turn = torch.eye(3, dtype=torch.float64)[None]
    return Link(tx, rx, turn, Isotropic(), Isotropic(), WAVELENGTH, shared)


def wall(material: Material, size: float = 8.0, shift: Tensor | float = 0.0) -> Object:
    along = rotation_from_vector(float64([0.0, 0.0, math.pi / 2]))
    across = float64([0.0, 1.0, 0.0]) * shift
    return Object(plate(size, size), material, rigid(along, float64([1.5, -0.5, 0.0]) + across))


def ball(material: Material = PAINT) -> Object:
    return Object(sphere(0.1, 3), material, rigid(translation=float64([3.0, 0.4, 0.0])))


def powers(scene: Scene, of: Link | None = None, **how: int) -> Tensor:
    sampling = replace(SAMPLING, **how)
    how_drawn = {"sampling": sampling, "seed": 1}
    return deposit_mirrored_power(scene, of or link(), GRID, ["wall"], **how_drawn)[0, :, 0, 0]


def seen_by_images(target: Object) -> Tensor:
    """The two mixed paths and that by the wall on both legs, with image antennas and no wall."""
    free, how = Scene({"ball": target}), {"sampling": replace(SAMPLING, depth=1), "seed": 1}
    mixed = deposit_power(free, link(IMAGE, shared=False), GRID, **how)
    return (2 * mixed + deposit_power(free, link(IMAGE, IMAGE), GRID, **how))[0, :, 0, 0]


@pytest.mark.parametrize("shared", [True, False])
def test_ghosts_are_those_of_image_antennas(shared):
    target = ball()
    mirrored = powers(
        Scene({"ball": target, "wall": wall(PerfectConductor())}), link(shared=shared)
    )
    expected = seen_by_images(target)
    far = GRID.ranges > 2
    assert float(mirrored[far].sum() / expected[far].sum()) == pytest.approx(1, abs=0.01)
    loud = far & (expected > 0.1 * expected[far].max())
    torch.testing.assert_close(mirrored[loud], expected[loud], rtol=0.02, atol=0)


def test_the_flash_of_the_wall_is_the_image_of_the_radar():
    index = math.sqrt(5.0)
    reflectance = ((index - 1) / (index + 1)) ** 2
    material = Dielectric(5.0, scattering=0.0)
    flash = powers(Scene({"ball": ball(), "wall": wall(material)}))[GRID.ranges < 1]
    friis = (WAVELENGTH / (4 * math.pi * 1.0)) ** 2  # at twice the distance of 0.5 m
    assert float(flash.sum()) == pytest.approx(reflectance * friis, rel=1e-4)
    assert float((flash * GRID.ranges[GRID.ranges < 1]).sum() / flash.sum()) == pytest.approx(0.5)


def test_without_bounces_to_spare_there_is_no_ghost():
    scene = Scene({"ball": ball(), "wall": wall(PerfectConductor())})
    assert not powers(scene, depth=1).any()
    far = GRID.ranges > 2
    one, two = (powers(scene, depth=depth)[far].sum() for depth in (2, 3))
    assert float(one) < 0.8 * float(two)  # the path by the wall on both legs is left out


def test_fields_of_rough_points_have_the_power_of_the_map():
    scene = Scene({"ball": ball(), "wall": wall(Dielectric(5.0, scattering=0.0))})
    sampling = replace(SAMPLING, points_per_m2={"ball": 40_000.0, "*": 1.0})
    rest, how = without_specular(scene, ["wall"]), {"sampling": sampling, "seed": 2}
    speckle = draw_speckle(rest, link(), **how)
    paths = trace_field_with_mirrors(scene, link(), ["wall"], speckle=speckle, **how)
    direct = trace_field(rest, link(), speckle=speckle, **how)
    ghosts = paths.coefficient.abs().square()[len(direct) :]
    total = ghosts[paths.range[len(direct) :] > 2].sum()
    expected = powers(scene)[GRID.ranges > 2].sum()
    assert float(total / expected) == pytest.approx(1, abs=0.04)


def test_a_conductor_in_the_mirror_has_the_field_of_the_image_antenna():
    target = Object(
        plate(0.2, 0.2), PerfectConductor(), rigid(translation=float64([3.0, 0.4, 0.0]))
    )
    scene = Scene({"target": target, "wall": wall(PerfectConductor())})
    paths = trace_field_with_mirrors(scene, link(), ["wall"], sampling=SAMPLING, seed=2)
    turns = torch.polar(torch.ones_like(paths.delay), -2 * math.pi * 3e8 / WAVELENGTH * paths.delay)
    once = (paths.range - 3.17).abs() < 0.07  # 3.03 m directly, 3.31 m by the wall on both legs
    found = (paths.coefficient * turns)[once].sum().abs()
    sampling = replace(SAMPLING, depth=1)
    free = trace_field(
        Scene({"target": target}), link(IMAGE, shared=False), sampling=sampling, seed=2
    )
    turns = torch.polar(torch.ones_like(free.delay), -2 * math.pi * 3e8 / WAVELENGTH * free.delay)
    expected = 2 * (free.coefficient * turns).sum().abs()  # both orders, in phase
    assert float(found / expected) == pytest.approx(1, abs=0.02)


def crate(shift: Tensor, aside: Tensor, permittivity: Tensor) -> Scene:
    """A crate behind a post, beside a wall that ends."""
    turned = rotation_from_vector(float64([0.0, 0.0, 0.4]))
    place = float64([3.0, 0.41, 0.0]) + float64([0.0, 1.0, 0.0]) * shift
    return Scene(
        {
            "crate": Object(box(0.3), PAINT, rigid(turned, place)),
            "wall": wall(Dielectric(permittivity, scattering=0.0), 1.5, aside),
            "post": Object(
                box((0.1, 0.1, 1.0)),
                RoughDielectric(1.0),
                rigid(translation=float64([2.2, 0.05, 0.0])),
            ),
        }
    )


@pytest.mark.slow
@pytest.mark.parametrize(("name", "step"), [("crate", 0.01), ("wall", 0.01), ("epsilon", 0.2)])
def test_derivatives_are_those_of_differences(name, step):
    weights = torch.linspace(1.0, 3.0, GRID.range_count)
    start = {"crate": 0.0, "wall": 0.0, "epsilon": 5.0}

    def loss(value: Tensor, **how: int) -> Tensor:
        given = {key: float64(number) for key, number in start.items()} | {name: value}
        return 1e12 * (powers(crate(*given.values()), **how) * weights)[GRID.ranges > 2].sum()

    slopes = []
    for boundary in (160_000, 0):
        value = float64(start[name]).requires_grad_()
        how = {"samples": 3_200_000, "boundary_samples": boundary}
        slopes.append(torch.autograd.grad(loss(value, **how), value)[0].item())
    with torch.no_grad():
        ends = [loss(float64(start[name] + s * step), samples=9_600_000) for s in (1, -1)]
    difference = float(ends[0] - ends[1]) / (2 * step)
    assert slopes[0] == pytest.approx(difference, rel=0.03)
    if name == "crate":
        assert slopes[1] != pytest.approx(difference, rel=0.2)  # what becomes hidden counts


def test_edges_left_out_cast_no_boundary(monkeypatch):
    def slope() -> float:
        value = float64(0.0).requires_grad_()
        scene = crate(value, float64(0.0), float64(5.0))
        power = powers(scene, samples=64, boundary_samples=16_000).sum()
        return 1e12 * torch.autograd.grad(power, value)[0].item()

    some, tested = slope(), []

    def keep_all(_: object, edges: Tensor, *__: Tensor, **___: bool) -> Tensor:
        tested.append(len(edges))
        return torch.ones(len(edges), dtype=torch.bool)

    monkeypatch.setattr(shadow_boundaries, "_cast_boundaries", keep_all)
    assert slope() == pytest.approx(some, rel=1e-9)
    assert sum(tested) > 1000
    assert abs(some) > 1.0


def test_what_is_no_mirror_is_named():
    scene = Scene({"ball": ball(), "wall": wall(PAINT)})
    with pytest.raises(InputError, match=r"expected mirrors that reflect a coherent wave"):
        powers(scene)
    how = {"sampling": SAMPLING, "seed": 1}
    with pytest.raises(InputError, match=r"in the scene: ball, wall, got 'floor'"):
        deposit_mirrored_power(scene, link(), GRID, ["floor"], **how)
    smooth = Scene(
        {
            "ball": replace(ball(), velocity=float64([1.0, 0.0, 0.0])),
            "wall": wall(PerfectConductor()),
        }
    )
    with pytest.raises(InputError, match=r"expected objects at rest, got velocities on ball"):
        powers(smooth)


def moving(shift: Tensor | float = 0.0) -> Scene:
    """A ball that moves beside a metal wall."""
    target = replace(ball(), velocity=float64([1.0, 2.0, 0.0]))
    return Scene({"ball": target, "wall": wall(PerfectConductor(), shift=shift)})


def image_rates() -> tuple[float, float]:
    """Range rates of the target, and of its image in the wall [m/s]."""
    place, velocity = float64([3.0, 0.4, 0.0]), float64([1.0, 2.0, 0.0])
    turned = float64([1.0, -1.0, 1.0])
    image = place * turned - float64([0.0, 1.0, 0.0])
    return float(place @ velocity / place.norm()), float(image @ (turned * velocity) / image.norm())


@pytest.mark.parametrize("power", [True, False])
def test_a_moving_ghost_has_the_velocity_of_the_image(power):
    how = {"sampling": replace(SAMPLING, points_per_m2=20_000.0, boundary=False), "seed": 1}
    trace = trace_mirrored_power if power else trace_field_with_mirrors
    paths = trace(moving(), link(), ["wall"], **how)
    rates = range_rate(paths, chirp_radar())  # at the antennas' place
    weights = paths.power + paths.coefficient.abs().square()
    own, image = image_rates()
    seen_last = paths.direction_cosines(link())[:, 0] < -0.2  # the receiver sees the image
    velocity = paths.velocity
    assert velocity is not None
    by_both = seen_last & (paths.first[:, 1] < -0.5) & (velocity.abs().sum(1) > 0)
    by_one = seen_last & (paths.first[:, 1] > 0)
    for rows, expected in ((by_both, image), (by_one, 0.5 * (own + image))):
        mean = (rates * weights)[rows].sum() / weights[rows].sum()
        assert float(mean) == pytest.approx(expected, abs=0.04)  # over the ball


def chirp_radar() -> Radar:
    wave = FMCW(start_frequency=76.5e9, bandwidth=1e9, duration=40e-6, samples=96)
    row = linear_array(16, wave.wavelength / 2)
    return Radar(linear_array(1, 1.0), row, wave, positions=torch.zeros(1, 3).double())


@pytest.mark.slow
def test_ghosts_in_chirp_trains_have_the_mirrored_rate():
    radar, train = chirp_radar(), Chirps(32, 250e-6)
    sampling = Sampling(3, points_per_m2={"ball": 4_000.0, "*": 1.0}, boundary=False)
    how = {"sampling": sampling, "seed": 3}
    beat = simulate_chirps(moving(), radar, train, mirrors=["wall"], **how)
    own, image = image_rates()
    grid = Grid(3.31, 0.05, 1, u_start=-1.3 / 3.31, u_step=0.05, u_count=2)
    power = range_doppler_angle(beat, radar, grid, train, bins=128)[0, :, 0, 0, 0]
    rates = velocity_axis(radar, train, 128)
    near = (rates - image).abs() < 0.3
    mean = (power * rates)[near].sum() / power[near].sum()
    assert float(mean) == pytest.approx(image, abs=0.06)  # a third of a cell of 0.24 m/s
    assert abs(own - image) > 0.4
    maps = RangeDopplerMap.from_chirps(radar, grid, train, mirrors=["wall"], sampling=MAPPED)
    shown = maps.predict(moving(), radar, 1)[0, :, 0, 0, 0]
    strongest = maps.rates[shown.argmax()]
    assert float(strongest) == pytest.approx(image, abs=0.12)


MAPPED = Sampling(1, 200_000, boundary=False)


def test_a_mirror_that_moves_is_named():
    scene = moving()
    away = replace(scene["wall"], velocity=float64([0.0, 0.1, 0.0]))
    scene = Scene({"ball": scene["ball"], "wall": away})
    with pytest.raises(InputError, match=r"expected mirrors at rest, got a velocity on 'wall'"):
        trace_mirrored_power(scene, link(), ["wall"], sampling=SAMPLING, seed=1)


@pytest.mark.slow
def test_ghosts_are_in_simulated_signals_and_in_the_map_alike():
    radar = chirp_radar()
    # A wall that ends before its flash, whose sidelobes would be in the signals alone.
    scene = Scene({"ball": ball(), "wall": wall(PerfectConductor(), 1.5)})
    grid = radar.grid(range_min=2.5, range_max=4.0)
    sampling = Sampling(3, points_per_m2={"ball": 4_000.0, "*": 1.0})
    found = torch.zeros(grid.shape).double()
    for seed in range(16):
        how = {"sampling": sampling, "seed": seed, "mirrors": ["wall"]}
        found += simulate(scene, radar, grid, **how).spectrum[0] / 16
    sampled = Sampling(3, 400_000, boundary=False)
    expected = SurrogateMap(grid, sampling=sampled, mirrors=["wall"]).predict(scene, radar, 1)[0]
    image = grid.u < -0.25
    levels = [power[:, image].sum() for power in (found, expected)]
    assert float(10 * torch.log10(levels[0] / levels[1])) == pytest.approx(0, abs=0.8)
    alone = SurrogateMap(grid, sampling=sampled).predict(Scene({"ball": ball()}), radar, 1)[0]
    assert float(alone[:, image].sum()) < 0.05 * float(levels[1])


def test_mirrors_of_chirps_need_uniform_velocities():
    with pytest.raises(
        InputError, match=r"expected uniform velocities with mirrors, got 1 mirrors"
    ):
        simulate_chirps(
            moving(), chirp_radar(), Chirps(4, 1e-4), seed=1, retrace=True, mirrors=["wall"]
        )
