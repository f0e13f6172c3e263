"""Field paths: physical optics of conductors, fixed points of rough surfaces, phase, laws."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from invertwin.channel import Grid, Link, Paths, Sampling, deposit_power, trace_field, trace_power
from invertwin.channel.coherent.speckle import draw_rough_points
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.scene import (
    Cosine,
    PerfectConductor,
    RoughDielectric,
    Scene,
    box,
    plate,
    sphere,
)
from invertwin.scene.mesh import concatenate_meshes
from scenes import WAVELENGTH, float64, link, occluder, thing

METAL = PerfectConductor()
ONE_BIN = Grid(0.0, 100.0, 1)


def response(paths: Paths, antennas: Link) -> Tensor:
    """Σ a exp(−jkL) per frame at the carrier."""
    phase = 2 * math.pi / antennas.wavelength * SPEED_OF_LIGHT * paths.delay
    field = paths.coefficient * torch.polar(torch.ones_like(phase), -phase)
    total = torch.zeros(antennas.frame_count, dtype=torch.complex128)
    return total.index_add(0, paths.frame, field)


def cross_section(scene: Scene, distance: float, wavelength: float, samples: int) -> float:
    """σ [m²] of a target at the origin, seen from −x."""
    antennas = link(((-distance, 0.0, 0.0),), wavelength=wavelength)
    paths = trace_field(
        scene,
        antennas,
        sampling=Sampling(depth=1, conductor_samples=samples, boundary_samples=0),
        seed=1,
    )
    power = response(paths, antennas).abs().square()
    return float(power * (4 * math.pi) ** 3 * distance**4 / wavelength**2)


def decibels(found: float, truth: float) -> float:
    return abs(10 * math.log10(found / truth))


def test_plate_broadside():
    truth = 4 * math.pi * 0.2**4 / WAVELENGTH**2
    scene = Scene({"plate": thing(plate(0.2, 0.2), material=METAL)})
    assert decibels(cross_section(scene, 2e3, WAVELENGTH, 10_000), truth) < 0.1


def test_plate_twelve_degrees_off():
    angle, wavelength = math.radians(12), SPEED_OF_LIGHT / 77e9
    x = 2 * math.pi / wavelength * 0.2 * math.sin(angle)
    truth = 4 * math.pi * 0.2**4 / wavelength**2 * (math.cos(angle) * math.sin(x) / x) ** 2
    scene = Scene({"plate": thing(plate(0.2, 0.2), turn=(0.0, 0.0, angle), material=METAL)})
    assert decibels(cross_section(scene, 2e3, wavelength, 1_000_000), truth) < 0.5


def test_sphere():
    scene = Scene({"ball": thing(sphere(0.15, subdivisions=6), material=METAL)})
    found = cross_section(scene, 100.0, SPEED_OF_LIGHT / 10e9, 1_000_000)
    assert decibels(found, math.pi * 0.15**2) < 0.3


def test_a_large_plate_reflects_with_minus_one():
    """The image of the antenna, seen through a beam narrow enough to spare the plate's edge."""
    distance, wavelength = 5.0, 0.1
    antennas = link(wavelength=wavelength, pattern=Cosine(20.0))
    scene = Scene({"mirror": thing(plate(8.0, 8.0), (distance, 0, 0), material=METAL)})
    found = response(
        trace_field(
            scene,
            antennas,
            sampling=Sampling(depth=1, conductor_samples=300_000, boundary_samples=0),
            seed=0,
        ),
        antennas,
    )
    phase = -4 * math.pi / wavelength * distance
    image = 42 * wavelength / (4 * math.pi * 2 * distance) * np.exp(1j * phase)
    assert abs(complex(found) / image + 1) < 0.1


def test_phase_holds_at_long_range():
    """Below 1e-3 rad at 77 GHz and 200 m, from float64 vertices."""
    scene = Scene({"plate": thing(plate(0.3, 0.2), (193.6, 40.0, -30.0), (0.2, 0.1, 0.4), METAL)})
    antennas = link(((0.03, 0.01, 0.02),), ((0.0, -0.2, 0.1),), shared=True)
    paths = trace_field(
        scene,
        antennas,
        sampling=Sampling(depth=1, conductor_samples=500, boundary_samples=0),
        seed=0,
    )
    points = paths.first.numpy().astype(np.longdouble)
    corners = scene["plate"].vertices.numpy().astype(np.longdouble)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    off_plane = (points - corners[0]) @ normal / np.sqrt((normal**2).sum())
    tx, rx = (place.numpy().astype(np.longdouble) for place in (antennas.tx, antennas.rx))
    length = sum(np.sqrt(((points - place) ** 2).sum(1)) for place in (tx, rx))
    wavenumber = 2 * math.pi * 77e9 / SPEED_OF_LIGHT
    error = paths.delay.numpy().astype(np.longdouble) * SPEED_OF_LIGHT - length
    assert len(paths) == 500
    assert np.abs(error).max() * wavenumber < 1e-3
    assert 2 * np.abs(off_plane).max() * wavenumber < 1e-3


@pytest.mark.parametrize("material", [METAL, RoughDielectric(4.0)], ids=["coherent", "rough"])
def test_fields_are_reciprocal(material):
    scene = occluder(wall=material, occluder=material)
    there = link(((0.0, -0.3, 0.1),), ((0.1, 0.3, 0.0),))
    back = replace(there, tx=there.rx, rx=there.tx)
    found = [
        response(
            trace_field(
                scene,
                a,
                sampling=Sampling(depth=1, conductor_samples=20_000, boundary_samples=0),
                seed=4,
            ),
            a,
        )
        for a in (there, back)
    ]
    assert float((found[0] - found[1]).abs() / found[0].abs()) < 1e-6


def test_power_is_reciprocal():
    there = link(((0.0, -0.3, 0.1),), ((0.1, 0.3, 0.0),))
    back = replace(there, tx=there.rx, rx=there.tx)
    found = [
        deposit_power(
            occluder(),
            a,
            ONE_BIN,
            sampling=Sampling(depth=1, samples=200_000, boundary_samples=0),
            seed=4,
        ).sum()
        for a in (there, back)
    ]
    assert float(found[0] / found[1]) == pytest.approx(1, abs=5e-3)


@pytest.mark.parametrize("distance", [2.0, 8.0])
def test_radar_equation_of_a_small_rough_plate(distance):
    """P = (λ/4π)² R(0)/π A / r⁴, hence r⁻⁴; R = 1/9 for ε = 4."""
    scene = Scene({"plate": thing(plate(0.05, 0.05), (distance, 0, 0))})
    found = deposit_power(
        scene,
        link(),
        ONE_BIN,
        sampling=Sampling(depth=1, samples=4_000, boundary_samples=0),
        seed=0,
    )
    truth = (WAVELENGTH / (4 * math.pi)) ** 2 / 9 / math.pi * 0.05**2 / distance**4
    assert float(found.sum()) == pytest.approx(truth, rel=5e-3)


@pytest.mark.parametrize("tilt", [0.0, 0.7])
def test_what_leaves_is_at_most_what_arrived(tilt):
    """Receivers all around collect what a plate of no absorption scatters into its half space."""
    cosines = (torch.arange(64).double() + 0.5) / 64
    angles = 2 * math.pi * (torch.arange(24).double() + 0.5) / 24
    mu, phi = torch.meshgrid(cosines, angles, indexing="ij")
    sine = (1 - mu**2).sqrt()
    around = torch.stack([-mu, sine * phi.cos(), sine * phi.sin()], dim=-1).reshape(-1, 3)
    count, distance = len(around), 10.0
    tx = distance * float64([[-math.cos(tilt), math.sin(tilt), 0.0]]).expand(count, 3)
    scene = Scene({"plate": thing(plate(0.05, 0.05), material=PerfectConductor(0.6))})
    power = deposit_power(
        scene,
        link(tx, distance * around),
        ONE_BIN,
        sampling=Sampling(depth=1, samples=200 * count, boundary_samples=0),
        seed=0,
    ).sum(dim=(1, 2, 3))
    # Over what a receiver at 10 m takes in per steradian, and over what the plate receives.
    leaving = (power * 4 * math.pi / WAVELENGTH**2 * distance**2).sum()
    leaving = float(leaving) * 2 * math.pi / count
    arriving = 0.05**2 * math.cos(tilt) / (4 * math.pi * distance**2)
    share = leaving / arriving
    assert share < 1.01
    if tilt == 0:
        assert share == pytest.approx(1, abs=0.02)


def test_rough_points_stay_on_their_surface():
    scene = occluder()
    fixed = draw_rough_points(scene, 500.0, seed=2)
    moved = scene.replace("occluder", pose=scene["occluder"].transform + 0.0)
    assert all(
        torch.equal(getattr(fixed, name), getattr(draw_rough_points(moved, 500.0, seed=2), name))
        for name in ("face", "b1", "b2", "phase")
    )
    antennas = link(((0.0, 0.0, 0.0), (0.0, 0.4, 0.1)))
    paths = trace_field(
        Scene({"wall": scene["wall"]}),
        antennas,
        sampling=Sampling(
            depth=1, conductor_samples=100_000, boundary_samples=0, points_per_m2=500.0
        ),
        seed=2,
    )
    first, second = (paths.first[paths.frame == frame] for frame in range(2))
    phases = [paths.coefficient[paths.frame == frame].angle() for frame in range(2)]
    assert torch.equal(first, second)
    assert torch.allclose(phases[0], phases[1], atol=1e-9)
    other = draw_rough_points(scene, 500.0, seed=3)
    assert not torch.equal(fixed.phase[:100], other.phase[:100])


@pytest.mark.parametrize("density", [400.0, 4_000.0])
def test_mean_power_of_rough_fields_is_the_power_map(density):
    """E|Σ a exp(−jkL)|² over phases, frames as independent looks, within 2 %."""
    scene = Scene({"plate": thing(plate(0.3, 0.3), (1.0, 0.0, 0.0), (0.0, 0.0, 0.5))})
    y, z = torch.meshgrid(torch.arange(16.0) * 0.1, torch.arange(8.0) * 0.1, indexing="ij")
    places = torch.stack([0 * y, y, z], dim=-1).reshape(-1, 3).double() - 0.4
    antennas = link(places)
    truth = deposit_power(
        scene,
        antennas,
        ONE_BIN,
        sampling=Sampling(depth=1, samples=64_000, boundary_samples=0),
        seed=0,
    )
    seeds = 100 if density < 1_000 else 60
    looks = [
        response(
            trace_field(
                scene,
                antennas,
                sampling=Sampling(
                    depth=1, conductor_samples=100_000, boundary_samples=0, points_per_m2=density
                ),
                seed=seed,
            ),
            antennas,
        )
        for seed in range(seeds)
    ]
    ratio = torch.stack(looks).abs().square().mean(0) / truth.flatten()
    assert float(ratio.mean()) == pytest.approx(1, abs=0.02)


def two_plates() -> Scene:
    right = thing(plate(0.3, 0.3), (1.0, -0.2, 0.0), (0.0, 0.0, 0.5))
    return Scene({"right": right, "left": thing(plate(0.2, 0.2), (0.9, 0.2, 0.0))})


def test_a_density_for_each_object_keeps_the_mean_power():
    """Two densities, one, and the power map; the standard errors of the 40 seeds are 1.5 %."""
    scene = two_plates()
    y, z = torch.meshgrid(torch.arange(16.0) * 0.1, torch.arange(8.0) * 0.1, indexing="ij")
    antennas = link(torch.stack([0 * y, y, z], dim=-1).reshape(-1, 3).double() - 0.4)
    exact = Sampling(depth=1, samples=64_000, boundary_samples=0)
    truth = float(deposit_power(scene, antennas, ONE_BIN, sampling=exact, seed=0).sum())

    def mean(densities: float | dict[str, float]) -> float:
        drawn = Sampling(depth=1, boundary_samples=0, points_per_m2=densities)
        looks = [
            response(trace_field(scene, antennas, sampling=drawn, seed=seed), antennas)
            for seed in range(40)
        ]
        return float(torch.stack(looks).abs().square().mean(0).sum()) / truth

    assert mean({"right": 400.0, "*": 4_000.0}) == pytest.approx(1, abs=0.04)
    assert mean({"right": 4_000.0, "left": 400.0}) == pytest.approx(1, abs=0.04)
    assert mean(1_000.0) == pytest.approx(1, abs=0.04)


def test_points_of_an_object_depend_on_its_own_density_only():
    scene = two_plates()
    many, mixed, few = (
        draw_rough_points(scene, densities, seed=2)
        for densities in (4_000.0, {"right": 500.0, "*": 4_000.0}, 500.0)
    )
    left = len(scene["right"].mesh.faces)
    for alone, side in ((few, mixed.face[:, 0] < left), (many, mixed.face[:, 0] >= left)):
        same = alone.face[:, 0] < left if alone is few else alone.face[:, 0] >= left
        for name in ("face", "b1", "b2", "weight", "phase"):
            assert torch.equal(getattr(mixed, name)[side], getattr(alone, name)[same])
    assert set(mixed.weight.tolist()) == {1 / 500, 1 / 4_000}
    named = draw_rough_points(scene, {"right": 500.0, "left": 500.0}, seed=2)
    pairs = zip(vars(named).values(), vars(few).values(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)


@pytest.mark.parametrize(
    ("densities", "said"),
    [
        ({"righ": 500.0, "*": 200.0}, r"objects of the scene \(right, left\), .*got 'righ'"),
        ({"right": 500.0}, r"every rough object, got none of left; .*\"\*\""),
        ({"right": 500.0, "left": 0.0}, r"points_per_m2 in \(0, inf\), got 0"),
    ],
)
def test_densities_of_what_is_not_there_are_refused(densities, said):
    with pytest.raises(InputError, match=said):
        draw_rough_points(two_plates(), Sampling(points_per_m2=densities).points_per_m2, 0)


def test_a_mixed_scene_holds_both_kinds():
    scene = occluder(wall=METAL)
    paths = trace_field(
        scene,
        link(),
        sampling=Sampling(
            depth=1, conductor_samples=1_000, boundary_samples=0, points_per_m2=500.0
        ),
        seed=0,
    )
    assert paths.kind == "field"
    alone = trace_field(
        Scene({"wall": scene["wall"]}),
        link(),
        sampling=Sampling(depth=1, conductor_samples=1_000, boundary_samples=0),
        seed=0,
    )
    assert alone.kind == "coherent"
    rough = trace_field(
        Scene({"occluder": scene["occluder"]}),
        link(),
        sampling=Sampling(
            depth=1, conductor_samples=100_000, boundary_samples=0, points_per_m2=500.0
        ),
        seed=0,
    )
    assert rough.kind == "rough"
    assert 0.5 * len(alone) < len(paths) - len(rough) < len(alone)


def test_rough_derivatives_with_boundary_are_refused():
    shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    for antennas, scene in (
        (link(shift[None]), occluder()),
        (link(((0.0, 0.0, 0.0),), shift[None] + 0.3), occluder()),
    ):
        with pytest.raises(InputError, match="no geometry derivative of rough field paths"):
            trace_field(
                scene,
                antennas,
                sampling=Sampling(
                    depth=1, conductor_samples=100_000, boundary_samples=0, points_per_m2=100.0
                ),
                seed=0,
            )
        paths = trace_field(
            scene,
            antennas,
            sampling=Sampling(
                depth=1,
                conductor_samples=100_000,
                boundary_samples=0,
                boundary=False,
                points_per_m2=100.0,
            ),
            seed=0,
        )
        assert paths.delay.requires_grad


def test_silhouettes_without_samples_are_refused():
    shift = torch.zeros(1, 3, dtype=torch.float64, requires_grad=True)
    metal = occluder(wall=METAL, occluder=METAL)
    for call in (
        lambda: trace_field(
            metal,
            link(shift),
            sampling=Sampling(depth=1, conductor_samples=100, boundary_samples=0),
            seed=0,
        ),
        lambda: trace_power(
            occluder(),
            link(shift),
            sampling=Sampling(depth=1, samples=100, boundary_samples=0),
            seed=0,
        ),
        lambda: deposit_power(
            occluder(),
            link(shift),
            ONE_BIN,
            sampling=Sampling(depth=1, samples=100, boundary_samples=0),
            seed=0,
        ),
    ):
        with pytest.raises(InputError, match="expected boundary_samples >= 1"):
            call()


def test_doubled_conductors_are_refused():
    """Points on both of two surfaces in one place would radiate: twice the field."""
    double = concatenate_meshes([plate(0.1, 0.1), plate(0.1, 0.1, 2)])
    scene, antennas = Scene({"a": thing(double, material=METAL)}), link(((-2.0, 0.0, 0.0),))
    with pytest.raises(InputError, match="got 10 triangles on others; merge_meshes"):
        trace_field(scene, antennas, sampling=Sampling(depth=1), seed=1)


def test_plates_of_two_objects_in_one_plane_are_refused_where_both_would_count():
    """Rough and smooth; a box on the floor hides what it stands on."""
    sampling = Sampling(depth=1, conductor_samples=1_000, points_per_m2=500.0, boundary=False)
    for material in (METAL, RoughDielectric(4.0)):
        tile, patch = (thing(plate(w, w), (1.0, 0.0, 0.0), material=material) for w in (0.4, 0.2))
        with pytest.raises(InputError, match="got tile and patch in one plane, in a place that is"):
            trace_field(Scene({"tile": tile, "patch": patch}), link(), sampling=sampling, seed=1)
        chest = thing(box(0.2), (0.9, 0.0, 0.0), material=material)
        trace_field(Scene({"tile": tile, "chest": chest}), link(), sampling=sampling, seed=1)
