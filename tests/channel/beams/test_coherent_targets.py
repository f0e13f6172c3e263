"""Coherent targets: interference as pairs of powers, shadows of the rest, refusals."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from invertwin.channel import (
    Link,
    Paths,
    Sampling,
    as_absorbers,
    combine_coherently,
    trace_facet_paths,
    trace_target,
)
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.scene import (
    PerfectConductor,
    Scene,
    Slab,
    box,
    dihedral,
    plate,
    rotation_from_vector,
    trihedral,
)
from scenes import float64, link, thing

WAVELENGTH = SPEED_OF_LIGHT / 77e9
METAL = PerfectConductor()
DRAWN = Sampling(depth=3)


def beside(y: float, x: float = 1.0) -> Scene:
    """A trihedral 1.5 m away, and a rough box before or beside it."""
    return Scene(
        {
            "corner": thing(trihedral(0.05), (1.5, 0.02, 0.0), (0.0, 0.05, 0.1), METAL),
            "box": thing(box((0.1, 0.3, 0.3)), (x, y, 0.0)),
        }
    )


def total(paths: Paths, stretch: float = 1.0) -> Tensor:
    """|Σ fields|² of the first frame, of phases at the stretched wavelength."""
    phase = -2 * math.pi * SPEED_OF_LIGHT / (stretch * WAVELENGTH) * paths.delay
    return (paths.coefficient * torch.polar(torch.ones_like(phase), phase)).sum().abs().square()


def always(ranges: Tensor, u: Tensor, v: Tensor) -> Tensor:
    return torch.ones_like(ranges)


def never(ranges: Tensor, u: Tensor, v: Tensor) -> Tensor:
    return torch.zeros_like(ranges)


@pytest.mark.parametrize("stretch", [1.0, 3.0])
def test_pairs_sum_to_the_square_of_the_field(stretch):
    """And to the sum of powers, where nothing overlaps."""
    antennas = link(wavelength=WAVELENGTH)
    scene = Scene({"corner": beside(1.0)["corner"]})
    paths = trace_target(scene, "corner", antennas, sampling=DRAWN, stretch=stretch)
    both = combine_coherently(paths, antennas, always, stretch=stretch).power.sum()
    assert float(both) == pytest.approx(float(total(paths, stretch)), rel=1e-9)
    apart = combine_coherently(paths, antennas, never, stretch=stretch).power.sum()
    assert float(apart) == pytest.approx(float(paths.coefficient.abs().square().sum()), rel=1e-9)


@pytest.mark.parametrize(("mesh", "depth", "low"), [(dihedral(0.05), 2, 3.01), (None, 3, 7.78)])
def test_powers_alone_are_low_by_the_number_of_chains(mesh, depth, low):
    """Of 2 ways in phase 3.01 dB, of 6 chains 7.78 dB."""
    antennas = link(((-20.0, 0.0, 0.0),), wavelength=WAVELENGTH)
    target = Scene({"target": thing(mesh or trihedral(0.05), material=METAL)})
    paths = trace_target(target, "target", antennas, sampling=Sampling(depth=depth))
    last = trace_target(target, "target", antennas, sampling=Sampling(depth=depth - 1))
    chains = paths.select(torch.arange(len(paths)) >= len(last))
    assert (chains.delay - chains.delay[0]).abs().max() * SPEED_OF_LIGHT < 1e-4
    # Plates of the dihedral are two triangles each: a way ends on the left one or on the right one.
    ways = (
        [chains.last[:, 1] < 0, chains.last[:, 1] > 0] if mesh else torch.eye(6, dtype=torch.bool)
    )
    powers = [combine_coherently(chains.select(way), antennas, always).power.sum() for way in ways]
    ratio = combine_coherently(chains, antennas, always).power.sum() / torch.stack(powers).sum()
    assert 10 * math.log10(float(ratio)) == pytest.approx(low, abs=0.02)


def test_a_stretched_wavelength_keeps_the_peak_and_widens_the_lobe():
    """Of a plate: straight on as ever, at 3° as a plate at 1° is."""
    antennas = link(((-4.0, 0.0, 0.0),), wavelength=WAVELENGTH)

    def power(turn: float, stretch: float) -> float:
        scene = Scene({"plate": thing(plate(0.05, 0.05), turn=(0.0, 0.0, turn), material=METAL)})
        paths = trace_target(scene, "plate", antennas, sampling=Sampling(1), stretch=stretch)
        return float(combine_coherently(paths, antennas, always, stretch=stretch).power.sum())

    peak = power(0.0, 1.0)
    assert power(0.0, 3.0) == pytest.approx(peak, rel=1e-6)
    small = math.radians(0.5)
    assert power(3 * small, 3.0) == pytest.approx(power(small, 1.0), rel=0.01)
    assert power(3 * small, 1.0) < 0.2 * power(3 * small, 3.0)


def test_what_stands_before_a_target_hides_it_smoothly():
    """A straight edge that passes a target takes its light off in proportion."""
    antennas = link(wavelength=WAVELENGTH)

    def strength(y: float) -> float:
        paths = trace_target(beside(y), "corner", antennas, sampling=DRAWN)
        return float(paths.coefficient.abs().sum())

    whole = strength(0.3)
    assert strength(-0.05) == 0.0
    assert strength(0.3) == pytest.approx(strength(2.0), rel=1e-12)
    shares = [strength(float(y)) / whole for y in torch.linspace(0.145, 0.185, 9)]
    steps = torch.tensor(shares).diff()
    assert shares[0] < 0.3
    assert shares[-1] > 0.7
    assert float(steps.min()) > 0.5 * float(steps.mean())  # no jumps, no flat parts
    assert float(steps.max()) < 1.5 * float(steps.mean())


def test_what_stands_behind_or_is_black_hides_nothing():
    antennas = link(wavelength=WAVELENGTH)
    alone = trace_facet_paths(Scene({"corner": beside(0.0)["corner"]}), antennas, 3)
    behind = trace_target(beside(0.0, 1.7), "corner", antennas, sampling=DRAWN)
    assert torch.allclose(behind.coefficient, alone.coefficient)


def test_separate_antennas_each_need_sight():
    """A box before the receiver alone hides the target, too."""
    antennas = link(((0.0, -1.0, 0.0),), ((0.0, 0.0, 0.0),), wavelength=WAVELENGTH)
    paths = trace_target(beside(0.0), "corner", antennas, sampling=DRAWN)
    assert not paths.has_field.any()


def test_no_echoes_but_the_same_shadows():
    dark = as_absorbers(beside(0.0), ["corner"])
    assert not dark["corner"].material.scattering_law(77e9).amplitude.any()
    assert torch.equal(dark["corner"].vertices, beside(0.0)["corner"].vertices)
    assert dark["box"].material.scattering_law(77e9).amplitude.any()


def test_refusals_name_what_they_refuse():
    antennas = link(wavelength=WAVELENGTH)
    with pytest.raises(InputError, match="expected opaque objects beside the coherent target"):
        trace_target(
            beside(0.0).replace("box", material=Slab(2.7, thickness=3e-3)),
            "corner",
            antennas,
            sampling=DRAWN,
        )
    with pytest.raises(InputError, match="expected smooth conductors alone"):
        trace_target(beside(0.0), "box", antennas, sampling=DRAWN)
    with pytest.raises(InputError, match="nothing"):
        trace_target(beside(0.0), "nothing", antennas, sampling=DRAWN)


def test_derivatives_are_differences_past_a_box():
    """Of power and range by the pose of a target, half hidden; fixed edges fail."""
    antennas = link(wavelength=WAVELENGTH)

    def power(theta: Tensor, *, boundary: bool = True) -> Tensor:
        scene, own = beside(0.165), beside(0.165)["corner"]
        move = torch.eye(4, dtype=torch.float64)
        pose = own.transform @ _posed(theta, move)
        moved = scene.replace("corner", pose=pose)
        drawn = replace(DRAWN, boundary=boundary)
        paths = trace_target(moved, "corner", antennas, sampling=drawn)
        found = combine_coherently(paths, antennas, always)
        # Moments of the map: power, and where it is.
        return torch.stack([found.power.sum(), (found.power * found.range).sum()]) * 1e9

    at = torch.zeros(6, dtype=torch.float64)
    found = torch.autograd.functional.jacobian(power, at)
    inside = torch.autograd.functional.jacobian(lambda t: power(t, boundary=False), at)
    steps = 1e-6 * torch.eye(6, dtype=torch.float64)
    truth = torch.stack([(power(at + s) - power(at - s)) / 2e-6 for s in steps], 1)
    error = float((found - truth).abs().sum() / truth.abs().sum())
    assert error < 1e-3
    assert float((inside - truth).abs().sum() / truth.abs().sum()) > max(3 * error, 0.1)


def _posed(theta: Tensor, eye: Tensor) -> Tensor:
    turn = rotation_from_vector(theta[3:])
    return torch.cat([torch.cat([turn, theta[:3, None]], 1), eye[3:]])


def test_a_link_of_many_frames_keeps_them_apart():
    places = float64([[0.0, 0.0, 0.0], [0.0, 0.2, 0.0], [-0.2, 0.0, 0.1]])
    antennas = link(places, wavelength=WAVELENGTH)
    scene = Scene({"corner": beside(1.0)["corner"]})
    whole = combine_coherently(
        trace_target(scene, "corner", antennas, sampling=DRAWN), antennas, always
    )
    for number, place in enumerate(places):
        single: Link = link(place[None], wavelength=WAVELENGTH)
        own = combine_coherently(
            trace_target(scene, "corner", single, sampling=DRAWN), single, always
        )
        found = whole.power[whole.frame == number].sum()
        assert float(found) == pytest.approx(float(own.power.sum()), rel=1e-9)
