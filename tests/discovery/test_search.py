"""Which shapes there are: halves of a shape, other kinds, and the moves that change them."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest
import torch
from scipy import sparse

import invertwin as iw
from discovery.test_recordings import CHAIN, HEIGHT, around, thing
from invertwin.discovery.assembly import ShapeLikelihood, make_sampling
from invertwin.discovery.imaging.likelihood import (
    HeavyTailedLoss,
    count_bins_per_draw,
    estimate_background,
    map_axes,
)
from invertwin.discovery.imaging.reflectivity import ImageResponse
from invertwin.discovery.proposals import propose_people_and_vehicles
from invertwin.discovery.search import (
    ImageGrid,
    ShapeSearch,
    mean_rcs,
    outline_corners,
    propose_kinds,
    propose_splits,
    rotate_headed_shapes,
)
from invertwin.discovery.shapes.primitives import ShapeParameters
from invertwin.models.radar import SurrogateMap
from invertwin.scene import Mesh, box, cylinder, person, standing_height
from invertwin_studies.vehicles import car_mesh, sample_car

BOX = ShapeParameters("box", (-0.4, 0.3), 0.3, 0.2, 0.8, 1.1, 0.05)


def search_of(
    scene: iw.Scene, radar: iw.Radar | None = None, density: float = 500.0
) -> ShapeSearch:
    """A search of a simulated scene; it has no image."""
    board: iw.Radar = around(12) if radar is None else radar
    count, farthest = board.frame_count, 1.7 * float(board.positions[0].norm())
    grid = board.grid(0.5, farthest)
    sampling = replace(CHAIN, points_per_m2=density)
    beat = iw.simulate(scene, board, grid, seed=3, sampling=sampling, snr_db=10.0).beat
    power = iw.Capture.from_beat(beat, board).spectrum(grid).float()
    one = ShapeLikelihood(
        SurrogateMap(grid, sampling=make_sampling(count, 1500)),
        board,
        power,
        HeavyTailedLoss(estimate_background(power)),
        count_bins_per_draw(map_axes(board, grid)),
        0.0,
        0,
    )
    nowhere = torch.zeros(1, 2, dtype=torch.float64)
    empty = ImageResponse(sparse.csr_matrix((power.numel(), 1)), tuple(power.shape))
    held = list(range(3, count, 4))
    fitted = one.select_frames([frame for frame in range(count) if frame not in held])
    return ShapeSearch(fitted, one.select_frames(held), ImageGrid(nowhere, 0.04, empty, 0.6))


def test_halves_fill_the_whole():
    pairs = propose_splits(BOX)
    assert len(pairs) == 42
    middle = torch.tensor(BOX.position, dtype=torch.float64)
    whole = outline_corners(BOX)
    for number, pair in enumerate(pairs):
        area = sum(one.length * one.width for one in pair) / (0.8 * 0.2)
        parts = torch.cat([outline_corners(one) for one in pair])
        # No part reaches beyond the whole.
        assert float((parts - middle).norm(dim=1).max()) < 0.5 * math.hypot(0.8, 0.2) + 1e-9
        if number % 7:
            assert area < 0.9
        else:
            assert area == pytest.approx(1.0)
            assert float(torch.cdist(whole, parts).amin(1).max()) < 1e-9
    post = ShapeParameters("cylinder", (0.0, 0.0), 0.0, 0.4, 0.4, 1.0)
    assert {one.kind for pair in propose_splits(post) for one in pair} == {"box"}


def test_only_what_is_as_large_as_a_person_or_a_vehicle_may_be_one():
    def kinds(length: float, width: float) -> set[str]:
        return {
            one.kind
            for one in propose_people_and_vehicles(
                ShapeParameters("box", (0.0, 0.0), 0.0, length, width, 1.0)
            )
        }

    assert kinds(0.5, 0.3) == {"person"}
    assert kinds(1.8, 0.1) == set()
    assert kinds(4.0, 1.7) == {"vehicle"}
    assert kinds(0.05, 0.05) == set()


def test_a_section_grows_with_the_surface():
    assert mean_rcs(ShapeParameters("box", (0.0, 0.0), 0.0, 1.0, 1.0, 2.0)) == pytest.approx(
        2 * math.pi
    )
    ball = ShapeParameters("sphere", (0.0, 0.0), 0.0, 0.5, 0.5, 1.0)
    assert mean_rcs(ball) == pytest.approx(math.pi / 8)


@pytest.mark.slow
def test_one_shape_about_two_things_is_split():
    scene = iw.Scene(
        {
            "wall": thing(box((0.1, 0.7, 0.9)), (0.1, -0.25), 0.45),
            "post": thing(cylinder(0.2, 0.9), (0.1, 0.3), 0.45),
        }
    )
    search = search_of(scene)
    whole = search.refine([ShapeParameters("box", (0.1, -0.05), 0.0, 0.4, 1.1, 0.9, 0.1)])
    found = search.prune(search.select_kinds(search.split_shapes(whole)))
    assert len(found) == 2
    assert search.evidence(found) > search.evidence(whole)
    away = torch.cdist(
        torch.tensor([[0.1, -0.25], [0.1, 0.3]], dtype=torch.float64),
        torch.tensor([one.position for one in found], dtype=torch.float64),
    )
    assert float(away.amin(1).max()) < 0.1
    # One thing stays one.
    alone = search_of(iw.Scene({"wall": thing(box((0.1, 0.7, 0.9)), (0.1, -0.25), 0.45)}))
    assert (
        len(
            alone.split_shapes(
                alone.refine([ShapeParameters("box", (0.1, -0.25), 0.0, 0.1, 0.7, 0.9)])
            )
        )
        == 1
    )


@pytest.mark.slow
def test_a_person_is_no_box():
    body = person(height=1.65, spacing=0.05)
    scene = iw.Scene({"person": thing(body.mesh({}), (-0.2, 0.1), standing_height(body), 0.6)})
    search = search_of(scene)
    start = ShapeParameters("box", (-0.18, 0.12), 0.7, 0.25, 0.5, 1.2, 0.1)
    before = search.refine([start])
    (found,) = search.select_headings(search.select_kinds(before))
    assert found.kind == "person"
    assert math.dist(found.position, (-0.2, 0.1)) < 0.06
    lists = propose_kinds(search.fitted_frames, before)
    assert {rows[0].kind for rows in lists} == {"cylinder", "sphere", "person"}
    assert rotate_headed_shapes(before, math.pi) == []


@pytest.mark.claim
@pytest.mark.slow
def test_a_car_is_a_vehicle():
    """Its form is that of another generator of cars, and unknown to the search."""
    mesh = car_mesh(sample_car(1), 0.1)
    low, high = mesh.vertices.amin(0), mesh.vertices.amax(0)
    long, wide, tall = (high - low).tolist()
    shape = Mesh(mesh.vertices - 0.5 * (low + high), mesh.faces)
    scene = iw.Scene({"car": thing(shape, (0.3, -0.5), 0.5 * tall, 0.6)})
    near = around(12)
    chirp = iw.FMCW(start_frequency=77e9, bandwidth=1e9, duration=50e-6, samples=128)
    up = torch.tensor([0.0, 0.0, HEIGHT], dtype=torch.float64)
    places = (near.positions - up) * 4 + up
    radar = iw.Radar(near.transmitters, near.receivers, chirp, places, near.rotations)
    search = search_of(scene, radar, 50.0)
    start = ShapeParameters("box", (0.2, -0.4), 0.6, 3.8, 1.7, 1.5, 0.1)
    (found,) = search.select_headings(search.select_kinds(search.refine([start])))
    assert found.kind == "vehicle"
    assert math.dist(found.position, (0.3, -0.5)) < 0.15
    assert found.length == pytest.approx(long, abs=0.3)
    assert found.width == pytest.approx(wide, abs=0.2)
    assert abs(math.remainder(found.yaw - 0.6, 2 * math.pi)) < math.radians(4)


class Frames(ShapeLikelihood):
    """Frames whose likelihood of one or two shapes is known."""

    gains: tuple[float, float]

    def __init__(self, gains: tuple[float, float]) -> None:
        object.__setattr__(self, "gains", gains)

    def total_gain(self, shapes: Sequence[ShapeParameters]) -> float:
        """Of one shape the first number, of two the second."""
        return self.gains[len(shapes) - 1]

    evidence = total_gain


@pytest.mark.parametrize(
    ("evidence", "held", "better"),
    [(50.0, -12.0, True), (10.0, -12.0, False), (-1.0, 12.0, False), (1.0, 1.0, True)],
)
def test_held_out_frames_add_to_the_evidence(evidence: float, held: float, better: bool):
    """A corner reflector that no held-out frame sees within its pattern gains 47 and loses 12."""
    fitted, others = Frames((0.0, evidence)), Frames((0.0, held))
    grid = object.__new__(ImageGrid)  # no image is looked at
    assert ShapeSearch(fitted, others, grid).is_better([BOX, BOX], [BOX]) == better
    # Without held-out frames, or with fewer shapes, the evidence alone decides.
    assert ShapeSearch(fitted, None, grid).is_better([BOX, BOX], [BOX]) == (evidence > 0)
    assert ShapeSearch(fitted, others, grid).is_better([BOX], [BOX, BOX]) == (evidence < 0)


class Judged(ShapeLikelihood):
    """Frames whose evidence is a function of the shapes, and that no fit changes."""

    judge: Callable[[Sequence[ShapeParameters]], float]

    def __init__(self, judge: Callable[[Sequence[ShapeParameters]], float]) -> None:
        object.__setattr__(self, "judge", judge)

    def evidence(self, shapes: Sequence[ShapeParameters]) -> float:
        """As judged."""
        return self.judge(shapes)

    def refine(self, shapes: Sequence[ShapeParameters], steps: int) -> list[ShapeParameters]:
        """As given."""
        return list(shapes)


def search_judged(judge: Callable[[Sequence[ShapeParameters]], float]) -> ShapeSearch:
    """A search without an image."""
    return ShapeSearch(Judged(judge), None, object.__new__(ImageGrid))


def test_two_plates_of_one_wall_are_one_at_their_own_yaw():
    """A box of another yaw would be far wider than the wall."""
    wall = replace(BOX, width=0.02, length=1.8)
    c, s = math.cos(BOX.yaw), math.sin(BOX.yaw)
    ends = [replace(wall, length=0.9, position=(-0.4 + k * c, 0.3 + k * s)) for k in (-0.45, 0.45)]

    def judge(shapes: Sequence[ShapeParameters]) -> float:
        if len(shapes) == 2:
            return 100.0
        return 200.0 * (shapes[0].length > 1.0) - 5000.0 * (shapes[0].width - 0.02)

    (found,) = search_judged(judge).merge_shapes(ends)
    assert found.position == pytest.approx(wall.position)
    assert (found.length, found.width) == pytest.approx((1.8, 0.02))


@pytest.mark.parametrize(("alone", "merges"), [(30.0, False), (5.0, True)])
def test_a_false_neighbour_does_not_widen_a_wall(alone: float, merges: bool):
    """The wide box is likelier than the two, but not than the wall alone."""
    wall = replace(BOX, length=1.8, width=0.02)
    ball = ShapeParameters("sphere", (-0.4, 0.6), 0.0, 0.3, 0.3, 0.6)

    def judge(shapes: Sequence[ShapeParameters]) -> float:
        if len(shapes) == 2:
            return 10.0
        return alone if shapes[0] == wall else 12.0 * (shapes[0] != ball)

    assert len(search_judged(judge).merge_shapes([wall, ball])) == 2 - merges


def test_a_wall_is_proposed_at_the_bright_part_of_a_wide_group():
    """Echoes by way of the floor lie behind it, and are weaker."""
    line = torch.arange(-1.5, 1.51, 0.05, dtype=torch.float64)
    places, c, s = torch.cartesian_prod(line, line), math.cos(0.4), math.sin(0.4)
    along, behind = places @ places.new_tensor([c, s]), places @ places.new_tensor([-s, c])
    seen = (along.abs() < 0.8) & (behind > -0.03) & (behind < 0.4)
    group = torch.where(seen, (-behind.clamp_min(0.0) / 0.1).exp(), 0.0)
    nothing = ImageResponse(sparse.csr_matrix((1, len(places))), (1, 1, 1, 1))
    search = ShapeSearch(Frames((0.0, 0.0)), None, ImageGrid(places, 0.05, nothing, 0.6))
    walls = [one for one in search.propose_for_group(group) if one.effective_kind == "wall"]
    assert any(
        abs(one.yaw - 0.4) < 0.06
        and one.length == pytest.approx(1.6, abs=0.2)
        and math.hypot(*one.position) < 0.06
        for one in walls
    )


class Births(ShapeSearch):
    """A search that proposes given shapes, one a round, and changes no kinds and no heights."""

    def propose_births(self, shapes: Sequence[ShapeParameters]) -> list[ShapeParameters]:
        """The next that there is not yet."""
        return [one for one in (BOX, BALL) if one not in shapes][:1] if len(shapes) < 2 else []

    def _keep(self, shapes: Sequence[ShapeParameters]) -> list[ShapeParameters]:
        return list(shapes)

    select_kinds = select_headings = split_shapes = select_heights = _keep


BALL = ShapeParameters("sphere", (0.9, 0.6), 0.0, 0.3, 0.3, 0.6)


@pytest.mark.parametrize(("together", "count"), [(5.0, 1), (15.0, 2)])
def test_a_newcomer_that_costs_evidence_is_refused(together: float, count: int):
    """A fit of both moves the box towards the echo of the ball, where each alone is worse."""

    class Moved(Judged):
        def refine(self, shapes: Sequence[ShapeParameters], steps: int) -> list[ShapeParameters]:
            """Both, the box moved."""
            return [replace(BOX, position=(0.0, 0.3)), BALL] if len(shapes) == 2 else list(shapes)

    def judge(shapes: Sequence[ShapeParameters]) -> float:
        return together if len(shapes) == 2 else 10.0 * (list(shapes) == [BOX])

    search = Births(Moved(judge), None, object.__new__(ImageGrid))
    assert len(search.run()) == count
    assert (search.run() == [BOX]) == (count == 1)
