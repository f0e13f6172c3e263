"""Scattered power at receivers: closed forms, shadows that move, what is refused."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.func import jvp

from invertwin.channel import Sampling
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel
from invertwin.links import (
    AntennaMount,
    CellSampling,
    MapPlane,
    PropagationSettings,
    ReceiverPoints,
    Transmitters,
)
from invertwin.links import scattered as scattered_module
from invertwin.models.radio import RadioMap, ResponseMap
from invertwin.scene import (
    AntennaArray,
    Cosine,
    Object,
    PerfectConductor,
    RoughConductor,
    Scene,
    box,
    plate,
    rigid,
    rotation_from_vector,
)
from scenes import float64, level_plate

FREQUENCY = 3.5e9
WAVELENGTH = SPEED_OF_LIGHT / FREQUENCY
CHALK = RoughConductor(scattering=1.0)
WALL = Scene({"wall": Object(level_plate(4.0, 4.0), CHALK)})
MAST = Transmitters(float64([0.5, 0.3, 2.0]))
SPOTS = float64([[1.0, -0.5, 1.5], [-2.0, 0.0, 3.0]])
CRATE = box(0.5)
ONE_BOUNCE = Sampling(depth=1, samples=400_000)


def lit(tx: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
    """Power and length of the paths by way of the wall's points."""
    axis = (torch.arange(600, dtype=torch.float64) + 0.5) / 150 - 2
    points = torch.cartesian_prod(axis, axis, torch.zeros(1, dtype=torch.float64))
    ways = [(points - end).norm(dim=1) for end in (tx, place)]
    part = (WAVELENGTH / (4 * math.pi)) ** 2 / math.pi / 150**2
    return part * float(tx[2] * place[2]) / (ways[0] * ways[1]) ** 3, ways[0] + ways[1]


def summed(
    place: Tensor, gain: Callable[[Tensor, Tensor], Tensor] | None = None
) -> tuple[float, float]:
    """Power that the wall scatters to a place and the spread of all delays, by quadrature."""
    axis = (torch.arange(600, dtype=torch.float64) + 0.5) / 150 - 2
    points = torch.cartesian_prod(axis, axis, torch.zeros(1, dtype=torch.float64))
    tx = MAST.positions[0]
    ways = [(points - end).norm(dim=1) for end in (tx, place)]
    part = (WAVELENGTH / (4 * math.pi)) ** 2 / math.pi / 150**2
    part = part * float(tx[2] * place[2]) / (ways[0] * ways[1]) ** 3
    if gain is not None:
        part = part * gain(points, ways[1])
    straight = float((tx - place).norm())
    power = torch.cat([part, float64([(WAVELENGTH / (4 * math.pi * straight)) ** 2])])
    delay = torch.cat([ways[0] + ways[1], float64([straight])]) / SPEED_OF_LIGHT
    mean = (power * delay).sum() / power.sum()
    return float(part.sum()), float(((power * (delay - mean) ** 2).sum() / power.sum()).sqrt())


def test_power_and_delays_are_those_of_the_integral():
    mirrored = ReceiverPoints(SPOTS).link_statistics(WALL, MAST, PropagationSettings(FREQUENCY), 0)
    reception = PropagationSettings(FREQUENCY, rough=ONE_BOUNCE)
    found = ReceiverPoints(SPOTS).link_statistics(WALL, MAST, reception, 0)
    for number, place in enumerate(SPOTS):
        power, spread = summed(place)
        more = float(found.gain[0, number] - mirrored.gain[0, number])
        assert more == pytest.approx(power, rel=2e-3)
        assert float(found.delay_spread[0, number]) == pytest.approx(spread, rel=2e-3)


def test_pattern_of_receivers_has_axes_of_its_own():
    turn = rotation_from_vector(float64([0.1, 1.3, 0.3]))  # looks at the wall, aslant
    horn = AntennaMount(AntennaArray(float64([[0.0, 0.0, 0.0]]), Cosine(2.0)), turn)
    place = SPOTS[:1]

    def gain(points: Tensor, way: Tensor) -> Tensor:
        cosine = ((points - place[0]) @ turn[:, 0]) / way
        return torch.where(cosine > 0, 6 * cosine.clamp_min(0) ** 2, 0.0)

    reception = PropagationSettings(FREQUENCY, receivers=horn, rough=ONE_BOUNCE)
    isotropic = replace(horn, array=AntennaArray(float64([[0.0, 0.0, 0.0]])))
    plain = PropagationSettings(FREQUENCY, receivers=isotropic, rough=ONE_BOUNCE)
    powers = [
        float(how.diffuse_moments(WALL, MAST, place, 0)[0, 0, 0]) for how in (plain, reception)
    ]
    whole, seen = summed(place[0])[0], summed(place[0], gain)[0]
    # The polarisation is the same for both, so the ratio is that of the pattern alone.
    assert powers[1] / powers[0] == pytest.approx(seen / whole, rel=5e-3)
    assert abs(seen / whole - 1) > 0.2


def test_smooth_share_mirrors_and_the_rest_scatters():
    half = Scene(
        {"wall": Object(level_plate(4.0, 4.0), RoughConductor(scattering=0.6, rms_slope=0.2))}
    )
    metal = Scene({"wall": Object(level_plate(4.0, 4.0), PerfectConductor())})
    reception = PropagationSettings(FREQUENCY, rough=ONE_BOUNCE)
    gains = {
        name: float(reception.diffuse_moments(scene, MAST, SPOTS, 0)[0, 0, 0])
        for name, scene in {"all": WALL, "half": half, "none": metal}.items()
    }
    assert gains["half"] == pytest.approx(0.36 * gains["all"], rel=1e-5)
    assert gains["none"] == 0


def shaded(offset: Tensor) -> Scene:
    """A box that hides a part of the wall from transmitter and receivers."""
    pose = rigid(translation=torch.stack([offset, *float64([0.2, 0.8])]))
    wall = WALL.objects["wall"]
    return Scene({"wall": wall, "box": Object(CRATE, PerfectConductor(), pose)})


@pytest.mark.parametrize("places", ["points", "cells"])
def test_derivative_holds_shadows_that_move(places):
    sampling = Sampling(depth=1, samples=1_000_000, boundary_samples=100_000)
    where = ReceiverPoints(float64([[-1.0, 0.3, 1.8]]))
    if places == "cells":
        where = MapPlane.horizontal([-1.2, 0.1], [-0.8, 0.5], 1.8, 0.4, CellSampling(points=9))
    reception = PropagationSettings(FREQUENCY, depth=0, rough=sampling)
    model = RadioMap(where, reception, "gain")
    at = float64(0.1)

    def rate(model: ForwardModel) -> float:
        def total(x: Tensor) -> Tensor:
            return model.predict(shaded(x), MAST, 0).sum()

        return float(jvp(total, (at,), (torch.ones_like(at),))[1])

    many = replace(sampling, samples=8_000_000, boundary=False)
    fine = replace(model, propagation=replace(reception, rough=many))
    ends = [fine.predict(shaded(at + way), MAST, 0).sum() for way in (-0.02, 0.02)]
    truth = float(ends[1] - ends[0]) / 0.04
    fixed = model.ablations()["boundary"]
    assert rate(model) == pytest.approx(truth, rel=0.03)
    assert abs(rate(fixed) / truth - 1) > 0.3


def test_a_map_with_scattered_power_is_random():
    model = RadioMap(ReceiverPoints(SPOTS), PropagationSettings(FREQUENCY, rough=ONE_BOUNCE))
    assert model.is_random
    assert not RadioMap(ReceiverPoints(SPOTS), PropagationSettings(FREQUENCY)).is_random


def test_batches_of_places_add_up_to_the_same(monkeypatch):
    reception = PropagationSettings(FREQUENCY, rough=ONE_BOUNCE)
    whole = reception.diffuse_moments(WALL, MAST, SPOTS, 0)
    monkeypatch.setattr(scattered_module, "_POSITIONS_PER_BATCH", 1)
    torch.testing.assert_close(
        reception.diffuse_moments(WALL, MAST, SPOTS, 0), whole, rtol=5e-3, atol=0
    )


def test_refusals_name_what_is_wrong():
    reception = PropagationSettings(FREQUENCY, rough=ONE_BOUNCE)
    with pytest.raises(InputError, match=r"got Sampling.*no phase"):
        ResponseMap(SPOTS, float64([FREQUENCY]), reception).predict(WALL, MAST, 0)
    horn = AntennaArray(float64([[0.0, 0.0, 0.0]]), Cosine(2.0))
    turns = torch.eye(3, dtype=torch.float64).expand(2, 3, 3)
    with pytest.raises(InputError, match="one orientation of all receivers"):
        replace(reception, receivers=AntennaMount(horn, turns)).link_statistics(
            WALL, MAST, SPOTS, 0
        )
    turned = replace(MAST, mount=AntennaMount(rotations=turns[0].clone().requires_grad_()))
    with pytest.raises(InputError, match="detach them"):
        reception.link_statistics(WALL, turned, SPOTS, 0)


MIRROR = Object(plate(40.0, 40.0), PerfectConductor(), rigid(translation=[3.0, 0.0, 0.0]))
BESIDE_MIRROR = Scene({"wall": WALL.objects["wall"], "mirror": MIRROR})


def imaged(place: Tensor) -> Tensor:
    """In the mirror."""
    return float64([6.0, 0.0, 0.0]) - place * float64([1.0, -1.0, -1.0])


def mixed(
    scene: Scene, tx: Tensor, places: Tensor, depth: int, seed: int = 0, **how: int
) -> Tensor:
    """Power of paths that scatter once and are mirrored too, and its moments over excess delay."""
    sampling = replace(ONE_BOUNCE, **how)
    found = [
        PropagationSettings(FREQUENCY, depth=d, rays=None, rough=sampling).diffuse_moments(
            scene, Transmitters(tx), places, seed
        )[0]
        for d in (depth, 1)
    ]
    return found[0] - found[1]


@pytest.mark.parametrize("depth", [2, 3])
def test_a_mirror_shows_the_wall_and_the_antennas_at_their_images(depth):
    tx, place = MAST.positions[0], SPOTS[0]
    ways = [(imaged(tx), place), (tx, imaged(place)), (imaged(tx), imaged(place))]
    power, length = (torch.cat(c) for c in zip(*(lit(*w) for w in ways[:depth]), strict=True))
    excess = (length - (tx - place).norm()) / SPEED_OF_LIGHT
    expected = torch.stack([(power * excess**n).sum() for n in range(3)])
    found = mixed(BESIDE_MIRROR, tx, place[None], depth)[0]
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=0)


def test_energy_that_meets_a_rough_plate_leaves_it_again():
    """Over all ways: what the plate gets directly and by the mirror crosses a far sphere."""
    small = Object(
        level_plate(0.5, 0.5), CHALK, rigid(rotation_from_vector(float64([0.3, 0.2, 0.0])))
    )
    scene = Scene({"wall": small, "mirror": MIRROR})
    tx = MAST.positions[0]
    normal = torch.linalg.cross(*(small.vertices[[1, 2]] - small.vertices[0]).unbind(0))
    normal = normal / normal.norm()
    axis = (torch.arange(40, dtype=torch.float64) + 0.5) / 40
    corner, first, second = small.vertices[0], *(small.vertices[[1, 2]] - small.vertices[0])
    points = corner + axis[:, None, None] * first + axis[:, None] * second
    arrived = 0.0
    for source in (tx, imaged(tx)):
        way = source - points
        arrived += (
            float(((way @ normal).abs() / way.norm(dim=-1) ** 3).mean()) * 0.25 / (4 * math.pi)
        )
    radius, count = 1000.0, 4000
    z = 1 - (2 * torch.arange(count, dtype=torch.float64) + 1) / count
    turn = math.pi * (1 + math.sqrt(5)) * torch.arange(count, dtype=torch.float64)
    ring = (1 - z**2).sqrt()
    sphere = radius * torch.stack([ring * turn.cos(), ring * turn.sin(), z], 1)
    reception = PropagationSettings(
        FREQUENCY, depth=3, rays=None, rough=replace(ONE_BOUNCE, samples=1_600_000)
    )
    gain = reception.diffuse_moments(scene, Transmitters(tx), sphere, 0)[0, :, 0]
    left = float(gain.mean()) * 4 * math.pi / WAVELENGTH**2 * 4 * math.pi * radius**2
    assert left == pytest.approx(arrived, rel=0.01)


def test_both_ways_are_alike():
    scene = shaded(float64(0.1))
    scene = Scene({**scene.objects, "mirror": MIRROR})
    ends = MAST.positions[0], SPOTS[0]
    there, back = (
        mixed(scene, tx, rx[None], 3, samples=1_600_000) for tx, rx in (ends, ends[::-1])
    )
    torch.testing.assert_close(there, back, rtol=5e-3, atol=0)


def test_what_heights_take_off_the_mirror_is_scattered():
    """A height makes a lobe, by quadrature; its derivative is that of differences."""
    height = float64(0.01)
    place = float64([[0.9, 0.2, 1.8]])

    def scene(height: Tensor) -> Scene:
        gritty = RoughConductor(scattering=0.0, rms_slope=0.3, rms_height=height)
        return Scene({**BESIDE_MIRROR.objects, "wall": Object(level_plate(4.0, 4.0), gritty)})

    def total(height: Tensor, depth: int) -> Tensor:
        how = PropagationSettings(FREQUENCY, depth=depth, rays=None, rough=ONE_BOUNCE)
        return how.diffuse_moments(scene(height), MAST, place, 0).sum((0, 1))[0]

    surface = RoughConductor(scattering=0.0, rms_slope=0.3).scattering_law(FREQUENCY)

    def fall(cosine: Tensor) -> Tensor:
        """What the lobe sends back over what it does straight back."""
        gauss = torch.distributions.Normal(float64(0.0), (2 / surface.exponents[0]).sqrt())

        def above(c: Tensor) -> Tensor:
            return c * gauss.cdf(c) + gauss.variance * gauss.log_prob(c).exp()

        return above(cosine) / above(float64(1.0))

    def expected(tx: Tensor, rx: Tensor) -> float:
        axis = (torch.arange(600, dtype=torch.float64) + 0.5) / 150 - 2
        points = torch.cartesian_prod(axis, axis, torch.zeros(1, dtype=torch.float64))
        ways = [(points - end).norm(dim=1) for end in (tx, rx)]
        cosine = [float(end[2]) / way for end, way in zip((tx, rx), ways, strict=True)]
        k = 4 * math.pi * height / WAVELENGTH
        kept = [((1 - torch.exp(-((k * c) ** 2))) / fall(c)).sqrt() for c in cosine]
        between = ((tx - points) * (rx - points)).sum(1) / (ways[0] * ways[1])
        lobe = (0.5 * (1 + 2 * cosine[0] * cosine[1] - between)) ** surface.exponents[0]
        law = surface.lobes[0] * lobe * kept[0] * kept[1] * cosine[0] * cosine[1]
        part = (WAVELENGTH / (4 * math.pi)) ** 2 / 150**2 * law / (ways[0] * ways[1]) ** 2
        return float(part.sum())

    tx, rx = MAST.positions[0], place[0]
    assert float(total(height, 1)) == pytest.approx(expected(tx, rx), rel=5e-3)
    both = expected(imaged(tx), rx) + expected(tx, imaged(rx))
    assert float(total(height, 2) - total(height, 1)) == pytest.approx(both, rel=5e-3)
    assert float(total(float64(0.0), 2)) == 0
    rate = jvp(lambda x: total(x, 2), (height,), (torch.ones_like(height),))[1]
    ends = [total(height + way, 2) for way in (1e-5, -1e-5)]
    assert float(rate) == pytest.approx(float(ends[0] - ends[1]) / 2e-5, rel=2e-3)


def test_derivative_by_the_size_of_a_mirror():
    """At fixed visibility it is zero: only the rims of the mirrored beams move."""
    sampling = replace(ONE_BOUNCE, boundary_samples=40_000)
    at = float64(1.0)

    def total(size: Tensor, sampling: Sampling) -> Tensor:
        glass = plate(2.0, 2.0)
        glass = replace(glass, vertices=glass.vertices * size)
        mirror = Object(glass, PerfectConductor(), rigid(translation=[3.0, 0.0, 1.2]))
        scene = Scene({"wall": WALL.objects["wall"], "mirror": mirror})
        reception = PropagationSettings(FREQUENCY, depth=3, rays=None, rough=sampling)
        return reception.diffuse_moments(scene, MAST, float64([[-1.0, -0.5, 1.5]]), 0)[0, 0, 0]

    def rate(sampling: Sampling) -> float:
        return float(jvp(lambda x: total(x, sampling), (at,), (torch.ones_like(at),))[1])

    many = replace(sampling, samples=3_200_000)
    ends = [total(at + way, many) for way in (0.05, -0.05)]
    truth = float(ends[0] - ends[1]) / 0.1
    assert rate(sampling) == pytest.approx(truth, rel=0.03)
    assert abs(rate(replace(sampling, boundary=False))) < 1e-6 * abs(truth)


def test_surfaces_that_meet_and_move_are_refused_by_name():
    at = float64(0.25).requires_grad_()
    pose = rigid(translation=torch.stack([*float64([0.1, 0.2]), at]))
    scene = Scene({**BESIDE_MIRROR.objects, "box": Object(CRATE, PerfectConductor(), pose)})
    sampling = Sampling(depth=1, samples=1000, boundary_samples=1000)
    reception = PropagationSettings(FREQUENCY, depth=2, rays=None, rough=sampling)
    with pytest.raises(InputError, match="box and wall in contact; leave a gap"):
        reception.diffuse_moments(scene, MAST, SPOTS, 0)
    reception = replace(reception, rough=replace(sampling, contacts=False))
    reception.diffuse_moments(scene, MAST, SPOTS, 0).sum().backward()
    assert at.grad is not None
    assert bool(at.grad.isfinite())
