"""Slope diffraction: fields whose strength changes across the rays that meet an edge."""

import math
from dataclasses import replace

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from invertwin.channel import RayPaths, trace_paths
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.links import AntennaMount, frequency_response, path_amplitudes
from invertwin.scene import (
    AntennaArray,
    Cosine,
    Object,
    PerfectConductor,
    Scene,
    TabulatedPattern,
    linear_array,
    plate,
    rigid,
)
from invertwin.scene.antenna import Pattern
from scenes import float64, level_plate

FREQUENCY = 3.5e9
TX = (-0.9, 0.4, 1.1)
EDGE = Object(level_plate(20.0, 20.0), PerfectConductor(), rigid(translation=[10.0, 0.0, 0.0]))
"""In the plane z = 0, from x = 0 on; the other edges are far away."""
SCREEN = Scene({"screen": EDGE})


def upright(normal: float) -> Object:
    """A wall whose plane is x = ``normal``."""
    return Object(plate(8.0, 8.0), PerfectConductor(), rigid(translation=[normal, 0.0, 0.0]))


BEFORE_A_WALL = Scene({"screen": EDGE, "wall": upright(-2.0)})


def looking(way: list[float], array: AntennaArray) -> AntennaMount:
    """An array whose boresight is about along ``way``, its y axis about along the world's x."""
    x = torch.nn.functional.normalize(float64(way), dim=0)
    z = torch.nn.functional.normalize(torch.linalg.cross(x, float64([1.0, 0.2, 0.0])), dim=0)
    return AntennaMount(array, torch.stack([x, torch.linalg.cross(z, x), z], 1))


def beam() -> AntennaArray:
    """Narrow and slanted."""
    origin = torch.zeros(1, 3, dtype=torch.float64)
    return AntennaArray(origin, pattern=Cosine(40.0), polarisation=[[0.8, 0.6]])


def row() -> AntennaArray:
    """Of some wavelengths."""
    return linear_array(3, 2 * SPEED_OF_LIGHT / FREQUENCY)


def shadow(source: tuple[float, float, float]) -> Tensor:
    """A place where the shadow of the edge for ``source`` ends."""
    x, _, z = source
    return float64([-0.8 * x / z, -0.5, -0.8])


def step_of_slope(
    scene: Scene, tx: AntennaMount, rx: AntennaMount, sloped: bool, source=TX
) -> float:
    """How much the derivative of the received fields by the place steps at the shadow."""
    bound, way = shadow(source), float64([1.0, 0.0, 0.0])
    slopes = []
    for side in (-1e-6, 1e-6):
        place = (bound + side * way).requires_grad_()
        paths = trace_paths(scene, float64(TX), place, FREQUENCY, depth=1, edges=1, rays=5_000)
        paths = paths if sloped else replace(paths, slopes=None, axes=None)
        sent = frequency_response(paths, [FREQUENCY], tx=tx, rx=rx)
        parts = torch.view_as_real(sent).flatten()
        each = [torch.autograd.grad(part, place, retain_graph=True)[0] @ way for part in parts]
        slopes.append(torch.stack(each))
    return float((slopes[1] - slopes[0]).norm() / slopes[0].norm())


ONE = AntennaMount().array


@pytest.mark.parametrize("array", [beam(), row(), ONE], ids=["beam", "row", "single"])
@pytest.mark.parametrize("at_tx", [True, False], ids=["tx", "rx"])
def test_derivatives_do_not_step_at_the_shadow(array, at_tx):
    ends = (looking([0.5, -0.3, -1.0], array), AntennaMount())
    if not at_tx:
        ends = (AntennaMount(), looking([-0.4, 0.5, 1.0], array))
    plain = step_of_slope(SCREEN, *ends, sloped=False)
    assert plain > 0.01
    # The places are 2e-6 m apart.
    assert step_of_slope(SCREEN, *ends, sloped=True) < 2e-4


def test_over_a_wall_the_antenna_turns_as_its_image():
    image = (-4.0 - TX[0], TX[1], TX[2])
    ends = (looking([-1.0, -0.3, 0.2], beam()), AntennaMount())
    plain = step_of_slope(BEFORE_A_WALL, *ends, sloped=False, source=image)
    assert plain > 0.01
    assert step_of_slope(BEFORE_A_WALL, *ends, sloped=True, source=image) < 0.05 * plain


def one_link(place: Tensor, source: Tensor) -> RayPaths:
    return trace_paths(BEFORE_A_WALL, source, place, FREQUENCY, depth=1, edges=1, rays=5_000)


def test_the_way_back_is_the_same():
    paths = one_link(float64([0.7, -0.3, -0.8]), float64(TX))
    ends = looking([0.5, -0.3, -1.0], beam()), looking([-0.4, 0.5, 1.0], row())
    there, delay = path_amplitudes(paths, *ends)
    back, late = path_amplitudes(paths.reverse(), *ends[::-1])

    # Rows are in the order of delays, of which some are equal.
    def turned(amplitude: Tensor, delay: Tensor) -> Tensor:
        return (amplitude * torch.polar(torch.ones_like(delay), -1e10 * delay)).sum(0)

    torch.testing.assert_close(turned(back, late), turned(there, delay).mT)
    assert paths.slopes is not None
    assert paths.slopes.abs().amax() > 0


def table_beam() -> AntennaArray:
    theta = torch.linspace(0, math.pi, 181, dtype=torch.float64)
    gain = (6 * theta.cos() - 4).exp()[:, None]
    origin = torch.zeros(1, 3, dtype=torch.float64)
    return AntennaArray(origin, pattern=TabulatedPattern(theta, float64([0.0]), gain))


@pytest.mark.parametrize("array", [beam(), row(), table_beam()], ids=["beam", "row", "table"])
def test_gradients_of_the_power(array):
    ends = (looking([0.5, -0.3, -1.0], array), looking([-0.4, 0.5, 1.0], beam()))

    def power(source: Tensor) -> Tensor:
        sent = frequency_response(
            one_link(float64([0.9, -0.3, -0.8]), source), [FREQUENCY], tx=ends[0], rx=ends[1]
        )
        return sent.abs().square().sum()

    source = float64(TX).requires_grad_()
    power(source).backward()
    assert source.grad is not None
    with torch.no_grad():
        for axis in range(3):
            step = torch.zeros(3, dtype=torch.float64)
            step[axis] = 1e-6
            truth = (power(source + step) - power(source - step)) / 2e-6
            torch.testing.assert_close(source.grad[axis], truth, rtol=1e-5, atol=0)
    way = float64([0.3, -0.8, 0.5])
    with forward_ad.dual_level():
        dual = power(forward_ad.make_dual(source.detach(), way))
        forward = forward_ad.unpack_dual(dual).tangent
    torch.testing.assert_close(forward, source.grad @ way)


REACH = 10.0
"""Distance from the screen to an antenna below it, and to one above it [m]."""
UPWARDS = float64([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
DOWNWARDS = float64([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])


def past_the_edge(beyond: float, source: Tensor, place: Tensor) -> RayPaths:
    """Paths along about the world's z axis past an edge along y, ``beyond`` the axis."""
    shift = rigid(translation=[200.0 - beyond, 0.0, 0.0])
    scene = Scene({"screen": Object(level_plate(400.0, 400.0), PerfectConductor(), shift)})
    return trace_paths(scene, source, place, 1e9, depth=0, edges=1, rays=None)


def vertical_response(paths: RayPaths, tx: AntennaMount, rx: AntennaMount) -> Tensor:
    """Response over that of free space between isotropic antennas."""
    free = SPEED_OF_LIGHT / 1e9 / (4 * math.pi * 2 * REACH)
    return frequency_response(paths, [1e9], tx=tx, rx=rx).flatten()[0] / free


def element(pattern: Pattern, polarisation: str = "V") -> AntennaArray:
    return AntennaArray(torch.zeros(1, 3, dtype=torch.float64), pattern, polarisation)


@pytest.mark.parametrize("offset", [0.0, 0.01, 0.05, 0.2])
def test_isotropic_elements_do_not_amplify_about_their_pole(offset):
    for beyond in (1e-5, 0.003, 0.03):
        paths = past_the_edge(beyond, float64([0, 0, -REACH]), float64([0, offset, REACH]))
        # On the boundary of the shadow, half of the field arrives, if polarisations agree.
        found = vertical_response(paths, AntennaMount(), AntennaMount())
        assert float(found.abs()) < 0.55


def test_slopes_about_the_pole_of_an_isotropic_element():
    zone, angle = 0.1, float64([1e-7, 0.01, 0.05, 0.2, 1.0])
    way = torch.stack([angle.sin(), 0 * angle, angle.cos()], 1)
    # Along H, at 1 rad/rad: V turns about the ray by the cotangent of its angle to the axis.
    turn = torch.linalg.cross(way, float64([0.0, 1.0, 0.0]).expand_as(way))
    index, zones = torch.zeros(5, dtype=torch.int64), torch.full((5,), zone).double()
    found = AntennaMount().element_slopes(way, index, turn, 20.0, zones)[:, 0]
    assert float(found[:, 0].abs().max()) < 1e-7
    speed = 1 / angle.tan()
    expected = speed / (zone * speed).square().clamp_min(1)
    # Closer than the step of the difference, slopes are smaller still.
    torch.testing.assert_close(found[1:, 1].abs(), expected[1:], rtol=1e-4, atol=0)
    assert float(found[0].abs().max()) < 0.02


class Dipole(Pattern):
    """Short dipole along z."""

    def gain(self, direction):
        return 1.5 * direction[..., :2].square().sum(-1)

    def table(self):
        cosine = torch.linspace(-1, 1, 101, dtype=torch.float64)[:, None]
        phi = 2 * math.pi * torch.arange(100, dtype=torch.float64) / 100 - math.pi
        return 1.5 * (1 - (1 - cosine**2) * phi.sin() ** 2)


@pytest.mark.parametrize("beyond", [0.0, 1e-4, 0.003])
def test_field_of_a_dipole_past_an_edge_in_its_null(beyond):
    """The edge cuts the odd field about the null: Kirchhoff's integral of x/s over x > 0."""
    paths = past_the_edge(beyond, float64([0, 0, -REACH]), float64([0, 0, REACH]))
    ends = AntennaMount(element(Dipole())), AntennaMount(ONE, DOWNWARDS)
    found = vertical_response(paths, *ends)
    wave_number = 2 * math.pi * 1e9 / SPEED_OF_LIGHT
    truth = math.sqrt(1.5) / REACH * math.sqrt(REACH / 2 / (2 * math.pi * wave_number))
    assert float(found.abs()) == pytest.approx(truth, rel=0.01)
    plain = vertical_response(replace(paths, slopes=None, axes=None), *ends)
    assert float(plain.abs()) < 0.1 * truth


@pytest.mark.parametrize("beyond", [0.003, -0.3], ids=["shadow", "light"])
def test_gradients_on_the_vertical(beyond):
    source, place = float64([0, 0, -REACH]).requires_grad_(), float64([0, 0, REACH])
    ends = AntennaMount(beam(), UPWARDS), AntennaMount(element(Cosine(2.0)), DOWNWARDS)

    def power(source: Tensor, *ends: AntennaMount) -> Tensor:
        response = vertical_response(past_the_edge(beyond, source, place), *ends)
        return torch.view_as_real(response).square().sum()

    (found,) = torch.autograd.grad(power(source, *ends), source)
    with torch.no_grad():
        steps = 1e-5 * torch.eye(3, dtype=torch.float64)
        sides = [[power(source + sign * by, *ends) for by in steps] for sign in (1, -1)]
    truth = (torch.stack(sides[0]) - torch.stack(sides[1])) / 2e-5
    torch.testing.assert_close(found, truth, rtol=1e-4, atol=1e-6 * float(truth.abs().max()))
    # Fields of isotropic elements have no derivative on their axis, but nothing infinite comes out.
    for mount in (AntennaMount(), AntennaMount(element(Dipole()))):
        (own,) = torch.autograd.grad(power(source, mount, mount), source)
        assert bool(torch.isfinite(own).all())
