"""Means over cells of planes and meshes, and their derivatives, shadow edges included."""

import math
import resource
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from scipy.integrate import dblquad
from torch import Tensor

from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.links import (
    AntennaMount,
    CellSampling,
    MapMesh,
    MapPlane,
    PropagationSettings,
    ReceiverPoints,
    Transmitters,
)
from invertwin.links.cells import Cells
from invertwin.models.radio import RadioMap
from invertwin.scene import (
    AntennaArray,
    Cosine,
    Material,
    Mesh,
    Object,
    PerfectConductor,
    Scene,
    Slab,
    box,
    plate,
    rigid,
    rotation_from_vector,
)
from scenes import float64, level_plate

FREQUENCY = 3.5e9
SCALE = (SPEED_OF_LIGHT / FREQUENCY / (4 * math.pi)) ** 2
METAL = PerfectConductor()
GLASS = Slab.itu("glass", thickness=0.01)
DIRECT = PropagationSettings(FREQUENCY, depth=0)
TX = float64([-2.0, 0.0, 3.0])


def thing(width: float, height: float, at: Tensor, turn: object, material: Material) -> Object:
    """A plate that would lie, turned and placed."""
    pose = rigid(rotation_from_vector(float64(turn)), at)
    return Object(level_plate(width, height), material, pose)


def upright(width: float, height: float, at: Tensor, material: Material = METAL) -> Object:
    """A plate that stands across the x axis: its width along y, its height along z."""
    return Object(plate(width, height), material, rigid(translation=at))


FAR = Scene({"far": upright(1.0, 1.0, float64([500.0, 0.0, 0.0]))})


def slope(gain: Callable[[Tensor], Tensor]) -> Tensor:
    """The derivative of a map by a number, at zero."""
    with forward_ad.dual_level():
        theta = forward_ad.make_dual(torch.zeros(()).double(), torch.ones(()).double())
        value, tangent = forward_ad.unpack_dual(gain(theta))
        return torch.zeros_like(value) if tangent is None else tangent


def gains(
    cells: Cells,
    scene: Callable[[Tensor], Scene],
    reception: PropagationSettings = DIRECT,
    seed: int = 1,
) -> Callable[[Tensor], Tensor]:
    """The gain of one transmitter as a function of what changes the scene."""
    return lambda theta: cells.link_statistics(
        scene(theta), Transmitters(TX), reception, seed
    ).gain[0]


def bare(cells: Cells) -> Cells:
    """The cells without boundary paths."""
    return cells.with_sampling(replace(cells.sampling, boundary=False))


def integral(f: Callable[[float, float], float], *bounds: float) -> float:
    """∫∫ f(y, x) dy dx over a rectangle."""
    return float(dblquad(f, *bounds)[0])


def error(found: Tensor, truth: Tensor) -> float:
    return float((found - truth).abs().sum() / truth.abs().sum())


def test_the_mean_over_cells_of_free_space():
    cells = MapPlane.horizontal([-1.0, -1.0], [2.0, 1.0], 0.5, 1.0, CellSampling(points=900))
    assert cells.shape == (3, 2)
    torch.testing.assert_close(cells.centres[2, 0], float64([1.5, -0.5, 0.5]))
    found = cells.link_statistics(FAR, Transmitters(TX), DIRECT, 0)
    assert found.gain.shape == (1, 3, 2)
    for i in range(3):
        for j in range(2):
            truth = integral(
                lambda y, x: SCALE / ((x + 2) ** 2 + y**2 + 2.5**2), i - 1, i, j - 1, j
            )
            assert float(found.gain[0, i, j]) == pytest.approx(truth, rel=1e-4)
    assert float(found.delay_spread.max()) < 1e-15


def test_a_pattern_and_the_power_of_several_transmitters():
    beam = AntennaMount(AntennaArray(torch.zeros(1, 3).double(), Cosine(2.0)))  # looks along x
    sides = float64([[0.0, 0.2, 0.0], [0.0, 0.0, 0.2]])
    cells = MapPlane(float64([1.0, -0.1, 2.9]), sides[0], sides[1], (1, 1))
    one = cells.link_statistics(FAR, Transmitters(TX, beam), DIRECT, 0).gain
    assert float(one) == pytest.approx(6 * SCALE / 9, rel=3e-3)
    places = torch.stack([TX, TX + float64([0.0, 3.0, 0.0])])
    two = Transmitters(places, power_dbm=float64([0.0, 30.0]))
    model = RadioMap(cells, DIRECT, "sinr", noise_dbm=-60.0)
    ratio = 10 ** (model.predict(FAR, two, 0)[:, 0, 0] / 10)
    first, second = SCALE / 9, 1000 * SCALE / 18
    expected = float64([first / (second + 1e-6), second / (first + 1e-6)])
    torch.testing.assert_close(ratio, expected, rtol=5e-3, atol=0)
    assert model.best_server(FAR, two, 0).tolist() == [[1]]
    wall = Scene({"wall": upright(99.0, 99.0, float64([0.0, 0.0, 0.0]))})
    assert model.best_server(wall, two, 0).tolist() == [[-1]]


def test_two_rays_over_a_ground():
    ground = Scene({"ground": Object(level_plate(400.0, 400.0), METAL)})
    cells = MapPlane.horizontal([3.0, -1.0], [5.0, 1.0], 1.0, 2.0, CellSampling(points=900))
    found = cells.link_statistics(ground, Transmitters(TX), replace(DIRECT, depth=1), 0)

    def rays(y: float, x: float) -> float:
        flat = (x + 2) ** 2 + y**2
        return SCALE / (flat + 4) + SCALE / (flat + 16)

    truth = integral(rays, 3, 5, -1, 1)
    assert float(found.gain) == pytest.approx(truth / 4, rel=1e-4)
    middle = ReceiverPoints(float64([[4.0, 0.0, 1.0]]))
    point = middle.link_statistics(ground, Transmitters(TX), replace(DIRECT, depth=1), 0)
    small = MapPlane.horizontal([3.99, -0.01], [4.01, 0.01], 1.0, 0.02)
    cell = small.link_statistics(ground, Transmitters(TX), replace(DIRECT, depth=1), 0)
    assert float(cell.gain) == pytest.approx(float(point.gain), rel=1e-4)
    assert float(cell.delay_spread) == pytest.approx(float(point.delay_spread), rel=1e-3)


def line(x: float, z: float = 1.0, half: float = 1.0) -> float:
    """∫ of free-space gain along y at a place of the map, for the transmitter at TX."""
    away = math.hypot(x + 2, 3 - z)
    return SCALE * 2 / away * math.atan(half / away)


@pytest.mark.parametrize(
    ("foot", "rim", "speed"),
    [
        # Over the map: light that passes below the wall ends at 2 m, twice as fast as the wall.
        (2.0, 2.0, 2.0),
        # Through the map: light ends where the wall cuts the map.
        (-9.0, 0.0, 1.0),
    ],
)
def test_a_wall_that_moves_takes_its_shadow_along(foot: float, rim: float, speed: float):
    cells = MapPlane.horizontal([-1.03, -1.0], [6.97, 1.0], 1.0, 4.0, CellSampling(points=64))

    def scene(theta: Tensor) -> Scene:
        at = torch.stack([theta, 0 * theta, 0 * theta + (19.0 + foot) / 2])
        return Scene({"wall": upright(8.0, 19.0 - foot, at)})

    found = slope(gains(cells, scene))
    truth = float64([[speed * line(rim) / 8], [0.0]])
    torch.testing.assert_close(found.view(2, 1), truth, rtol=3e-3, atol=1e-12)
    assert not bool(slope(gains(bare(cells), scene)).any())


def test_a_transmitter_that_moves_takes_shadows_along():
    wall = Scene({"wall": upright(8.0, 17.0, float64([0.0, 0.0, 10.5]))})
    cells = MapPlane.horizontal([-1.03, -1.0], [6.97, 1.0], 1.0, 4.0, CellSampling(points=400))
    place = TX.clone().requires_grad_()
    gain = cells.link_statistics(wall, Transmitters(place), DIRECT, 1).gain.sum()
    found = torch.autograd.grad(gain, place)[0]
    # Higher, the rim is at 2·(z − 1)/(z − 2) − 2: it comes closer by 2 m a metre.
    inside = integral(lambda y, x: SCALE * -4 / ((x + 2) ** 2 + y**2 + 4) ** 2, -1.03, 2, -1, 1)
    assert float(found[2]) == pytest.approx((inside - 2 * line(2.0)) / 8, rel=3e-3)


def panel_scene(material: Material, blocker: bool) -> Callable[[Tensor], Scene]:
    """An upright panel at x = 3 that moves askew, with a turned wall before it or not."""

    def scene(theta: Tensor) -> Scene:
        at = float64([3.0, 0.2, 1.6]) + theta * float64([0.3, 1.0, 0.2])
        turn = [0.1, math.pi / 2, 0.1]
        items = {"panel": thing(1.2, 1.4, at, turn, material)}
        if blocker:
            items["blocker"] = thing(0.5, 0.5, float64([1.0, 0.1, 2.3]), [0.4, 1.2, 0.3], METAL)
        return Scene(items)

    return scene


@pytest.mark.parametrize(
    ("material", "blocker", "depth"), [(METAL, True, 1), (GLASS, False, 1), (GLASS, True, 2)]
)
def test_beams_of_mirrors_and_sheets_against_differences(
    material: Material, blocker: bool, depth: int
):
    cells = MapPlane.horizontal([-1.1, -2.3], [4.9, 1.7], 0.4, 2.0, CellSampling(points=900))
    reception = PropagationSettings(FREQUENCY, depth=depth, rays=None)
    scene = panel_scene(material, blocker)
    found = slope(gains(cells, scene, reception))
    fine = gains(cells.with_sample_count(6 * 120**2), scene, reception)
    step = 0.03
    truth = (fine(torch.tensor(step).double()) - fine(torch.tensor(-step).double())) / (2 * step)
    fixed = slope(gains(bare(cells), scene, reception))
    assert error(found, truth) < 0.02
    assert error(fixed, truth) > 0.3


def test_a_mesh_of_cells_is_a_plane_of_cells():
    corners = float64([[-1.1, -2.3, 0.4], [0.9, -2.3, 0.4], [0.9, -0.3, 0.4], [-1.1, -0.3, 0.4]])
    halves = MapMesh(Mesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]])), CellSampling(400))
    whole = MapPlane.horizontal([-1.1, -2.3], [0.9, -0.3], 0.4, 2.0, CellSampling(800))
    assert halves.shape == (2,)
    reception = PropagationSettings(FREQUENCY, depth=1, rays=None)
    scene = panel_scene(METAL, True)
    ways = [gains(cells, scene, reception) for cells in (halves, whole)]
    values = [float(way(torch.zeros(()).double()).mean()) for way in ways]
    assert values[0] == pytest.approx(values[1], rel=0.01)
    slopes = [float(slope(way).mean()) for way in ways]
    assert slopes[0] == pytest.approx(slopes[1], rel=0.02)


def test_a_box_that_stands_through_the_map_moves():
    # Closed, with floor and ceiling: nothing arrives inside of it.
    cells = MapPlane.horizontal([-0.7, -1.15], [2.3, 1.85], 1.0, 1.0, CellSampling(points=1600))

    def scene(theta: Tensor) -> Scene:
        turn = rotation_from_vector(float64([0.0, 0.0, 0.4]))
        at = float64([1.0, 0.2, 1.0]) + theta * float64([1.0, 0.4, 0.0])
        return Scene({"box": Object(box([0.8, 0.5, 1.9]), METAL, rigid(turn, at))})

    reception = PropagationSettings(FREQUENCY, depth=1, rays=None)
    found = slope(gains(cells, scene, reception))
    step, parts = torch.tensor(0.04).double(), []
    for seed in range(3):
        fine = gains(cells.with_sample_count(9 * 120**2), scene, reception, seed)
        parts.append((fine(step) - fine(-step)) / (2 * step))
    assert error(found, torch.stack(parts).mean(0)) < 0.02


def test_rims_on_the_border_of_a_map_count_in_its_cells():
    # The wall's foot throws its rim exactly on the border between both cells, and the map ends
    # where the wall's sides do.
    cells = MapPlane.horizontal([-2.0, -1.0], [6.0, 1.0], 1.0, 4.0, CellSampling(points=64))

    def scene(theta: Tensor) -> Scene:
        at = torch.stack([theta, 0 * theta, 0 * theta + 10.5])
        return Scene({"wall": upright(8.0, 17.0, at)})

    found = slope(gains(cells, scene))
    assert float(found.sum()) == pytest.approx(2 * line(2.0) / 8, rel=3e-3)
    corner = cells.find_cells(float64([[-2.0, -1.0, 1.0], [6.0, 1.0, 1.0]]), torch.tensor([0, 0]))
    assert corner.tolist() == [0, 1]


def test_where_no_path_has_so_many_steps():
    cells = MapPlane.horizontal([-1.1, -2.3], [4.9, 1.7], 0.4, 2.0, CellSampling(points=10))
    scene = panel_scene(METAL, False)
    found = [
        slope(gains(cells, scene, PropagationSettings(FREQUENCY, depth=depth, rays=1000)))
        for depth in (1, 3)
    ]
    torch.testing.assert_close(found[0], found[1])


def test_the_same_seed_gives_the_same_map():
    cells = MapPlane.horizontal([-1.1, -2.3], [4.9, 1.7], 0.4, 2.0, CellSampling(points=10))
    scene = panel_scene(METAL, True)(torch.zeros(()).double())
    first, again, other = (
        cells.link_statistics(scene, Transmitters(TX), DIRECT, seed).gain for seed in (1, 1, 2)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


@pytest.mark.slow
def test_ten_thousand_cells_take_bounded_memory():
    room = {"room": Object(box([20.0, 20.0, 3.0]), Slab.itu("concrete", thickness=0.2))}
    scene = Scene(room | {"cart": Object(box(0.8), METAL, rigid(translation=[1.0, 2.0, 0.0]))})

    def pulled(size: float) -> Tensor:
        place = float64([-2.0, 0.3, 1.0]).requires_grad_()
        cells = MapPlane.horizontal([-9.0, -9.0], [9.0, 9.0], 0.2, size, CellSampling(1, 2000))
        gain = cells.link_statistics(scene, Transmitters(place), replace(DIRECT, depth=1), 0).gain
        return torch.autograd.grad(gain.sum(), place)[0]

    pulled(1.8)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert bool(torch.isfinite(pulled(0.18)).all())
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300_000  # kB


def test_what_is_no_map_is_refused():
    side = float64([1.0, 0.0, 0.0])
    with pytest.raises(InputError, match="span an area"):
        MapPlane(side, side, 2 * side, (1, 1))
    with pytest.raises(InputError, match="two counts"):
        MapPlane(side, side, side.roll(1), (1, 0))
    with pytest.raises(InputError, match="high beyond low"):
        MapPlane.horizontal([0.0, 0.0], [1.0, -1.0], 1.0, 0.5)
    flat = Mesh(torch.stack([side, side, side.roll(1)]), torch.tensor([[0, 1, 2]]))
    with pytest.raises(InputError, match="triangles with an area"):
        MapMesh(flat)
    with pytest.raises(InputError, match="points"):
        CellSampling(points=0)
    cells = MapPlane.horizontal([0.0, 0.0], [1.0, 1.0], 1.0, 0.5)
    with pytest.raises(InputError, match="with bandwidth None, or with edges, got bandwidth"):
        cells.link_statistics(FAR, Transmitters(TX), PropagationSettings(FREQUENCY, 1e8), 0)


def walled(shift: Tensor) -> Scene:
    """A wall before the cells, moved sideways."""
    place = float64([0.0, 0.0, 1.0]) + shift * float64([0.0, 1.0, 0.0])
    return Scene({"wall": upright(1.0, 6.0, place)})


def test_cells_in_a_shadow_hold_what_the_edges_of_it_diffract():
    """The mean over a finer lattice of points, one by one; behind the wall nothing else arrives."""
    cells = MapPlane.horizontal([0.8, -0.2], [1.6, 0.6], 0.6, 0.4, CellSampling(points=100))
    round_edges = replace(DIRECT, bandwidth=1e8, edges=1)
    still = walled(torch.zeros(()).double())
    found = cells.link_statistics(still, Transmitters(TX), round_edges, 3)
    line = float64([(k + 0.5) / 14 * 0.4 for k in range(14)])
    for i in range(2):
        for j in range(2):
            x, y = torch.meshgrid(0.8 + 0.4 * i + line, -0.2 + 0.4 * j + line, indexing="ij")
            flat = torch.stack([x.flatten(), y.flatten(), torch.full((196,), 0.6).double()], 1)
            points = ReceiverPoints(flat).link_statistics(still, Transmitters(TX), round_edges, 3)
            assert float(found.gain[0, i, j]) == pytest.approx(float(points.gain.mean()), rel=0.03)
    dark = cells.link_statistics(still, Transmitters(TX), DIRECT, 3).gain
    assert float(dark.min()) == 0.0
    assert float(found.gain.min()) > 1e-4 * SCALE / 9
    assert float(found.delay_spread.max()) < 5e-9


def test_a_shadow_with_diffraction_sweeps_over_cells_as_differences_do():
    cells = MapPlane.horizontal([0.8, -0.6], [2.0, 0.9], 0.6, 0.3, CellSampling(points=9))
    gain = gains(cells, walled, replace(DIRECT, bandwidth=1e8, edges=1))
    step = 1e-4
    with torch.no_grad():
        ends = [gain(torch.tensor(side * step).double()) for side in (1.0, -1.0)]
    truth = (ends[0] - ends[1]) / (2 * step)
    assert error(slope(gain), truth) < 0.01
    model = RadioMap(cells, replace(DIRECT, bandwidth=1e8, edges=1), "gain")
    fixed = model.ablations()["boundary"]
    assert isinstance(fixed, RadioMap)
    assert fixed.propagation.bandwidth is None
    still = slope(lambda shift: fixed.predict(walled(shift), Transmitters(TX), 1)[0])
    assert error(still, truth) > 0.5
