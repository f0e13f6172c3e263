"""Derivatives where surfaces meet, against differences; what is refused."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from invertwin.channel import Grid, Link, Sampling, deposit_power, trace_power
from invertwin.errors import InputError
from invertwin.scene import Material, Mesh, Object, RoughDielectric, Scene, Slab, box, plate, sphere
from invertwin.scene.pose import compose, rigid
from scenes import float64, link, relative, shift_error, thing

RANGES = Grid(1.0, 0.08, 22)
DARK, PALE = RoughDielectric(2.0), RoughDielectric(4.0)
BLACK = RoughDielectric(1.0)
SAMPLING = Sampling(depth=1, samples=100_000, boundary_samples=50_000)


def moved(item: Object, by: Tensor) -> Object:
    return Object(item.mesh, item.material, compose(item.transform, rigid(translation=by)))


def crossed_plates(theta: Tensor, still: Material = DARK) -> Scene:
    """Two plates that cut through each other before a wall; one moves."""
    return Scene(
        {
            "moving": moved(
                thing(plate(0.6, 0.5), (1.5, 0, 0), (0.2, 0, 0.9)), theta * float64([0.4, 1, 0.2])
            ),
            "still": thing(plate(0.5, 0.7), (1.52, 0.03, 0.02), (0, 0.1, -0.6), still),
            "wall": thing(plate(3.0, 3.0), (2.2, 0, 0)),
        }
    )


def box_on_floor(theta: Tensor, sunk: float = 0.0, material: Material = DARK) -> Scene:
    """A box that slides on the floor."""
    item = thing(box([0.3, 0.5, 0.4]), (1.6, 0, -1.0 - sunk), (0, 0, 0.5), material)
    return Scene(
        {
            "box": moved(item, theta * float64([0.4, 1, 0])),
            "floor": thing(plate(4.0, 4.0), (1.6, 0, -1.2), (0, math.pi / 2, 0)),
        }
    )


def folded(theta: Tensor) -> Scene:
    """One mesh of two plates that cut through each other; its shape changes."""
    parts = list(crossed_plates(theta).objects.values())
    faces = [parts[0].mesh.faces, parts[1].mesh.faces + len(parts[0].vertices)]
    mesh = Mesh(torch.cat([parts[0].vertices, parts[1].vertices]), torch.cat(faces))
    return Scene({"folded": Object(mesh, PALE), "wall": parts[2]})


def slope(
    scene: Callable[[Tensor], Scene], antennas: Link, sampling: Sampling, grid: Grid = RANGES
) -> Tensor:
    """∂map/∂θ."""
    with forward_ad.dual_level():
        theta = forward_ad.make_dual(float64(0.0), float64(1.0))
        out = deposit_power(scene(theta), antennas, grid, sampling=sampling, seed=1)
        tangent = forward_ad.unpack_dual(out).tangent
    assert tangent is not None
    return tangent.double()


def difference(
    scene: Callable[[Tensor], Scene], antennas: Link, sampling: Sampling, grid: Grid = RANGES
) -> Tensor:
    """The same by central differences with common random numbers."""
    reference = scene(float64(0.0)), antennas
    drawn = replace(sampling, samples=20 * sampling.samples, boundary=False)

    def value(theta: float) -> Tensor:
        return deposit_power(
            scene(float64(theta)), antennas, grid, sampling=drawn, seed=2, reference=reference
        ).double()

    return (value(4e-3) - value(-4e-3)) / 8e-3


@pytest.mark.parametrize(
    ("scene", "antennas"),
    [
        (crossed_plates, link()),
        (crossed_plates, link(rx=((0.0, 0.15, 0.1),), shared=False)),
        (folded, link()),
        (lambda theta: crossed_plates(theta, Slab(2.7, 0.05, thickness=0.0125)), link()),
        (lambda theta: box_on_floor(theta, 0.1), link()),
        (box_on_floor, link()),
        (lambda theta: box_on_floor(theta, -1e-4), link()),
    ],
    ids=["plates", "two antennas", "one mesh", "a sheet", "sunk", "touching", "gap"],
)
def test_what_moves_where_surfaces_meet_is_in_the_derivative(scene, antennas):
    sampling = replace(SAMPLING, samples=200_000, boundary_samples=100_000)
    truth = difference(scene, antennas, sampling)
    assert relative(slope(scene, antennas, sampling), truth) < 0.04


def standing(theta: Tensor, way: tuple[float, float, float], side: float) -> Scene:
    """A wedge that stands with one edge on a plate, on one side of it."""
    points = float64([[x, y, z] for y in (-0.2, 0.2) for x, z in ((0, 0), (-0.1, 0.3), (0.2, 0.3))])
    sides = [[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5], [0, 2, 1], [3, 4, 5]]
    wedge = Mesh(points * float64([1, 1, side]), torch.tensor(sides))
    return Scene(
        {
            "wedge": moved(thing(wedge, (1.6, 0, -0.8), (0, 0, 0.5), DARK), theta * float64(way)),
            "floor": thing(plate(4.0, 4.0), (1.6, 0, -0.8), (0, math.pi / 2, 0)),
        }
    )


@pytest.mark.parametrize("way", [(0.0, 0.0, 1.0), (0.4, 1.0, 0.6)])
def test_motion_that_opens_or_closes_a_contact_has_the_mean_of_both_slopes(way):
    def scene(theta: Tensor) -> Scene:
        return standing(theta, way, 1.0)

    sampling = replace(SAMPLING, samples=200_000, boundary_samples=100_000)
    assert relative(slope(scene, link(), sampling), difference(scene, link(), sampling)) < 0.02


def test_what_slides_on_the_far_side_of_a_surface_changes_nothing():
    """Its edge is in the plane of the near side, too."""
    near = slope(lambda theta: standing(theta, (0.4, 1.0, 0.0), 1.0), link(), SAMPLING)
    far = slope(lambda theta: standing(theta, (0.4, 1.0, 0.0), -1.0), link(), SAMPLING)
    assert float(far.abs().sum()) < 1e-6 * float(near.abs().sum())


@pytest.mark.parametrize("size", [2.0**-10, 2.0**10])
@pytest.mark.parametrize("depth", [1, 2])
def test_maps_and_derivatives_are_those_of_a_scene_of_another_size(depth, size):
    """From millimetres to kilometres; a power of two leaves no rounding."""

    def found(size: float) -> tuple[Tensor, Tensor]:
        def scene(theta: Tensor) -> Scene:
            old = (crossed_plates if depth == 1 else away)(theta).objects
            return Scene(
                {
                    k: Object(Mesh(o.vertices * size, o.mesh.faces), o.material)
                    for k, o in old.items()
                }
            )

        sampling = Sampling(depth, 20_000, 20_000)
        grid, antennas = Grid(1.0 * size, 0.08 * size, 22), link(rx=((0, 0.15 * size, 0.1 * size),))
        here = scene(float64(0.0)), antennas, grid
        return deposit_power(*here, sampling=sampling, seed=1), slope(
            scene, antennas, sampling, grid
        )

    def away(theta: Tensor) -> Scene:
        return box_on_floor(theta, -0.3)

    for value, expected in zip(found(size), found(1.0), strict=True):
        assert relative(value.double() * size**2, expected) < 1e-4


@pytest.mark.parametrize("scene", [crossed_plates, folded, box_on_floor])
def test_without_contacts_it_is_not(scene):
    truth = difference(scene, link(), SAMPLING)
    assert relative(slope(scene, link(), replace(SAMPLING, contacts=False)), truth) > 0.12


def test_a_common_shift_of_scene_and_radar_changes_nothing():
    leaves = {
        name: item.vertices.detach().clone().requires_grad_()
        for name, item in crossed_plates(float64(0.0)).objects.items()
    }
    old = crossed_plates(float64(0.0)).objects
    scene = Scene({name: Object(Mesh(leaves[name], old[name].mesh.faces), PALE) for name in leaves})
    tx = float64([[0.0, 0.0, 0.0]]).requires_grad_()
    out = deposit_power(scene, replace(link(), tx=tx, rx=tx), RANGES, sampling=SAMPLING, seed=1)
    assert shift_error(torch.autograd.grad(out.sum() * 1e9, [*leaves.values(), tx])) < 1e-4


def test_nothing_changes_where_nothing_meets():
    def apart(theta: Tensor) -> Scene:
        ball = moved(thing(sphere(0.2, 3), (1.5, 0, 0)), theta * float64([0, 1, 0]))
        return Scene({"ball": ball, "wall": thing(plate(3.0, 3.0), (2.2, 0, 0))})

    with_, without = (
        slope(apart, link(), replace(SAMPLING, contacts=found)) for found in (True, False)
    )
    assert relative(with_, without) < 1e-5


@pytest.mark.parametrize("scene", [crossed_plates, box_on_floor])
def test_paths_between_surfaces_that_meet_are_refused_by_name(scene):
    sampling = replace(SAMPLING, depth=2, samples=10_000)
    names = " and ".join(list(scene(float64(0.0)).objects)[:2])
    with pytest.raises(InputError, match=f"got ({names}|floor and box|box and floor) at depth 2"):
        slope(scene, link(), sampling)
    assert bool(slope(scene, link(), replace(sampling, contacts=False)).isfinite().all())


def test_black_surfaces_meet_others_at_any_depth():
    sampling = replace(SAMPLING, depth=2, samples=10_000)
    found = slope(lambda theta: box_on_floor(theta, 0.1, BLACK), link(), sampling)
    assert float(found.abs().sum()) > 0


def test_explicit_paths_refuse_surfaces_that_meet():
    theta = torch.zeros((), dtype=torch.float64, requires_grad=True)
    with pytest.raises(InputError, match="expected surfaces that do not meet"):
        trace_power(crossed_plates(theta), link(), sampling=SAMPLING, seed=1)
