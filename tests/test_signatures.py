"""The public way to radar signatures: polarisations, range profiles, images, errors."""

import math

import pytest
import torch
from torch import Tensor

import invertwin as iw
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.scene import (
    Mesh,
    PerfectConductor,
    Slab,
    box,
    dihedral,
    merge_meshes,
    plate,
    rigid,
    sphere,
    trihedral,
)
from invertwin.scene.mesh import concatenate_meshes
from invertwin.signatures import aspect_directions, to_dbsm
from scenes import float64

METAL = PerfectConductor()
AHEAD = [[-1.0, 0.0, 0.0]]
BAND = torch.linspace(28e9, 32e9, 65, dtype=torch.float64)


def target(mesh: Mesh, place: object = (0.0, 0.0, 0.0)) -> iw.Scene:
    return iw.Scene({"target": iw.Object(mesh, METAL, rigid(translation=float64(place)))})


def test_sigma_of_a_plate():
    found = iw.rcs(target(plate(0.1, 0.1)), AHEAD, 30e9)
    wavelength = SPEED_OF_LIGHT / 30e9
    expected = 10 * math.log10(4 * math.pi * 1e-4 / wavelength**2)
    assert found.dbsm.shape == (1, 1, 2, 2)
    assert float(found.dbsm[0, 0, 0, 0]) == pytest.approx(expected, abs=0.05)
    assert float(found.dbsm[0, 0, 1, 0]) < -200


def test_a_target_that_is_moved_returns_no_more_and_no_less():
    """Sides of its beams lie in the planes of its mirrors; rounding there has no derivative."""
    directions = aspect_directions(torch.deg2rad(float64([82.0, 90.0, 96.0])), math.pi)

    def power(place: Tensor) -> Tensor:
        moved = iw.Object(trihedral(0.05), METAL, rigid(translation=place))
        found = iw.rcs(iw.Scene({"target": moved}), directions, 77e9, edges=0)
        return found.matrix.abs().square().sum((0, 2, 3))

    place = float64([0.0, 0.0, 0.0])
    change = torch.autograd.functional.jacobian(power, place)
    wave_number = 2 * math.pi * 77e9 / SPEED_OF_LIGHT
    assert (change.abs() < 1e-12 * wave_number * power(place)[:, None]).all()  # it was 7e-5


@pytest.mark.parametrize(("mesh", "kept"), [(plate(0.1, 0.1), 1), (dihedral(0.1), 0)])
def test_one_bounce_turns_circular_polarisation_over_and_two_keep_it(mesh, kept):
    found = iw.rcs(target(mesh), AHEAD, 30e9, polarisation="circular", edges=0)
    received = found.matrix[0, 0, :, 0].abs()
    assert float(received[kept]) > 50 * float(received[1 - kept])


def test_polarisation_names_the_first_row():
    direction = aspect_directions(math.pi / 2 - 0.1, math.pi - 0.4)
    linear = iw.rcs(target(dihedral(0.05)), direction, 30e9, edges=0)
    turned = iw.rcs(target(dihedral(0.05)), direction, 30e9, edges=0, polarisation="H")
    slanted = iw.rcs(target(dihedral(0.05)), direction, 30e9, edges=0, polarisation=(1, 1))
    assert torch.allclose(turned.matrix[0, 0, 0, 0], linear.matrix[0, 0, 1, 1])
    assert torch.allclose(slanted.matrix[0, 0, 0, 0], linear.matrix[0, 0].sum() / 2)


def test_aspects_are_those_of_a_sphere():
    found = aspect_directions(
        float64([0.0, math.pi / 2, math.pi / 2]), float64([0.7, 0.0, math.pi / 2])
    )
    assert torch.allclose(found, float64([[0, 0, 1], [1, 0, 0], [0, 1, 0]]), atol=1e-12)


def test_range_profile_shows_what_is_where():
    both = iw.Scene(
        {
            "near": iw.Object(plate(0.05, 0.05), METAL, rigid(translation=float64([-0.3, 0, 0]))),
            "far": iw.Object(plate(0.1, 0.1), METAL, rigid(translation=float64([0.4, 0.2, 0]))),
        }
    )
    ranges, profile = iw.rcs(both, AHEAD, BAND, edges=0).range_profile()
    level = profile[:, 0, 0, 0].abs()
    wavelength = SPEED_OF_LIGHT / 30e9
    for place, area in ((-0.3, 0.05**2), (0.4, 0.1**2)):
        near = (ranges - place).abs() < 0.05
        peak = ranges[near][level[near].argmax()]
        assert abs(float(peak) - place) < 0.011  # a quarter of a cell
        assert float(level[near].max()) == pytest.approx(area / wavelength, rel=0.02)
    empty = (ranges > -0.1) & (ranges < 0.2)
    assert float(level[empty].max()) < 0.01 * float(level.max())


def test_an_image_is_sharp_where_the_target_is():
    place = (0.12, 0.05, 0.0)
    angles = torch.linspace(-0.1, 0.1, 41, dtype=torch.float64)
    found = iw.rcs(
        target(sphere(0.04, 5), place),
        aspect_directions(math.pi / 2, angles),
        BAND,
        edges=0,
        depth=1,
    )
    steps = torch.linspace(-0.2, 0.2, 81, dtype=torch.float64)
    x, y = torch.meshgrid(steps, steps, indexing="ij")
    image = found.image(torch.stack([x, y, torch.zeros_like(x)], -1))
    assert image.shape == (81, 81, 2, 2)
    peak = int(image[..., 0, 0].abs().argmax())
    assert float(x.flatten()[peak]) == pytest.approx(0.16, abs=0.006)  # the front of the ball
    assert float(y.flatten()[peak]) == pytest.approx(0.05, abs=0.006)


def test_bistatic_directions_are_apart():
    sent, received = [[-1.0, 0.0, 0.3]], [[-1.0, 0.0, -0.3]]  # mirror directions of the plate
    found = iw.rcs(target(plate(0.1, 0.1)), sent, 30e9, receivers=received, edges=0)
    again = iw.rcs(target(plate(0.1, 0.1)), received, 30e9, receivers=sent, edges=0)
    assert torch.allclose(found.matrix, again.matrix.mT)
    cosine = 1 / math.hypot(1, 0.3)
    expected = 0.1**2 * cosine * 30e9 / SPEED_OF_LIGHT
    assert float(found.matrix[0, 0, 1, 1].abs()) == pytest.approx(expected, rel=1e-3)


def test_decibels_of_nothing_are_finite():
    assert torch.isfinite(to_dbsm(torch.zeros(2, dtype=torch.complex128))).all()


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"directions": [[0.0, 0.0, 0.0]]}, "directions of some length"),
        ({"directions": [[0.0, 1.0]]}, "directions as numbers"),
        ({"receivers": [[0.0, 0.0, 1.0]] * 2}, "expected 1 receivers"),
        ({"frequencies": [-1e9]}, "frequency"),
        ({"polarisation": "diagonal"}, "polarisation as V, H, circular"),
        ({"polarisation": (0.0, 0.0)}, "not both zero"),
        ({"depth": 0}, "depth"),
        ({"edges": -1}, "edges"),
        ({"tubes_per_wavelength": 0.0}, "tubes per wavelength"),
    ],
)
def test_bad_arguments_are_named(change, text):
    given = {"directions": AHEAD, "frequencies": 30e9} | change
    with pytest.raises(InputError, match=text):
        iw.rcs(target(plate(0.1, 0.1)), **given)


@pytest.mark.parametrize(
    ("parts", "named"),
    [
        ([plate(0.1, 0.1), plate(0.05, 0.05, 2)], "10 triangles on others"),
        ([sphere(0.1, 2), sphere(0.08, 2)], "closed parts that overlap or touch"),
    ],
)
def test_what_a_ray_meets_twice_is_named(parts, named):
    with pytest.raises(InputError, match=f"place of target, got {named}"):
        iw.rcs(target(concatenate_meshes(parts)), AHEAD, 30e9)


def test_magnetic_materials_are_refused():
    tile = iw.Object(plate(0.1, 0.1), Slab(4.0, permeability=2.0, thickness=0.002))
    with pytest.raises(InputError, match="permeability of 1 of tile"):
        iw.rcs(iw.Scene({"tile": tile}), AHEAD, 30e9)


def test_uneven_frequencies_have_no_range_profile():
    found = iw.rcs(target(merge_meshes([plate(0.1, 0.1)])), AHEAD, [28e9, 29e9, 31e9])
    with pytest.raises(InputError, match="evenly spaced"):
        found.range_profile()


def test_directions_and_frequencies_have_no_derivatives():
    for change in (
        {"directions": float64(AHEAD).requires_grad_()},
        {"frequencies": float64([30e9]).requires_grad_()},
    ):
        given = {"directions": AHEAD, "frequencies": 30e9} | change
        with pytest.raises(InputError, match="without derivatives"):
            iw.rcs(target(plate(0.1, 0.1)), **given)


def test_materials_have_derivatives():
    def power(values: Tensor) -> Tensor:
        board = Slab(values[0], thickness=values[1] * 1e-3, rms_height=values[2] * 1e-3)
        scene = iw.Scene({"board": iw.Object(plate(0.1, 0.1), board)})
        return iw.rcs(scene, [[-1.0, 0.1, 0.0]], 30e9, edges=0).matrix[0, 0, 0, 0].abs().square()

    start = float64([3.0, 2.3, 0.1]).requires_grad_()
    (gradient,) = torch.autograd.grad(power(start), start)
    for i in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[i] = 1e-6
        difference = float(power(start.detach() + step) - power(start.detach() - step)) / 2e-6
        assert float(gradient[i]) == pytest.approx(difference, rel=1e-5)


@pytest.mark.parametrize("divisions", [1, 3])  # by beams and by tubes
def test_what_two_objects_have_in_one_place_is_refused_from_where_it_is_seen(divisions):
    """A plate on the front of a box, in it or over its edge; the floor below it from below."""
    body, metal = iw.Object(box(0.2), PerfectConductor()), PerfectConductor()

    def found(height: float, side: float, x: float, way: float) -> Tensor:
        pose = rigid(translation=float64([x, 0.0, height]))
        patch = iw.Object(plate(side, side, divisions=divisions), metal, pose)
        scene = iw.Scene({"body": body, "patch": patch})
        return iw.rcs(scene, [[-way, 0.2, 0.1], [-way, -0.1, 0.3]], 10e9, edges=1).cross_section

    for height, side in ((0.0, 0.2), (0.02, 0.1), (0.1, 0.2)):
        with pytest.raises(InputError, match="got body and patch in one plane, in a place that is"):
            found(height, side, -0.1, 1.0)
        assert found(height, side, -0.101, 1.0).isfinite().all()
    with pytest.raises(InputError, match="got body and patch in one plane"):
        found(0.0, 0.5, 0.1, -1.0)
    torch.testing.assert_close(
        found(0.0, 0.5, 0.1, 1.0), found(0.0, 0.5, 0.1001, 1.0), rtol=0.05, atol=0.0
    )
