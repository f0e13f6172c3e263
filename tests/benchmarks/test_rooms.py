"""The benchmark of rooms in small: what counts as found, and rooms that are drawn."""

import math

import pytest
import torch

import invertwin as iw
from invertwin.discovery import ShapeParameters


def test_rooms_hold_one_to_six_things_that_do_not_touch(rooms):
    drawn = [rooms.Room.draw(number) for number in range(12)]
    corners = [[one for one in room.things if one.kind == "corner"] for room in drawn]
    assert [len(found) for found in corners] == [0, 1] * 6
    assert [len(room.things) for room in drawn] == [1, 3, 3, 5, 5, 7] * 2
    assert {one.kind for room in drawn for one in room.things} == {*rooms.KINDS, "corner"}
    for room in drawn:
        assert 8 <= len(room.turns) <= 40
        for k, one in enumerate(room.things):
            if one.kind == "corner":
                continue
            low = float(one.item().vertices[:, 2].min())
            assert low == pytest.approx(0.0, abs=1e-9) or one.kind == "sphere"
            for other in room.things[k + 1 :]:
                assert math.dist(one.place, other.place) > one.reach + other.reach
    assert rooms.Room.draw(3) == drawn[3]


def test_a_corner_echoes_where_it_opens_unless_something_hides_it(rooms):
    """Its peak is that of the closed form; the range that of its apex."""
    corner = rooms.Thing("corner", (-0.3, 0.4), -math.pi / 2, (0.05, 0.05, 0.05), 0.6, 1.0)
    # The middle of the room lies off; the first place is straight ahead, the second behind.
    room = rooms.Room(0, (corner,), (0.0, math.pi), 20.0)
    radar = room.radar()
    away = iw.Scene({"away": rooms.Thing("box", (2, 0), 0.0, (0.3, 0.3, 0.3), 0.15, 4.0).item()})
    beat = corner.echo(radar, away)
    power = beat.abs().square().mean((1, 2, 3))
    assert power[1] < 1e-4 * power[0]
    peak = 4 * math.pi * 0.05**4 / 3 / rooms.CHIRP.wavelength**2
    way = radar.positions[0] - corner.middle
    tilt = way / way.norm() @ radar.link().rotations[0]
    gain = float(radar.link().tx_pattern.gain(-tilt[None])) ** 2
    expected = gain * rooms.CHIRP.wavelength**2 * peak / (4 * math.pi) ** 3 / float(way.norm()) ** 4
    assert float(power[0]) == pytest.approx(expected, rel=0.15)
    hidden = iw.Scene(
        {"box": rooms.Thing("box", (-0.3, 1.0), 0.0, (0.9, 0.3, 1.2), 0.6, 4.0).item()}
    )
    assert float(corner.echo(radar, hidden)[0].abs().max()) == 0.0


def test_pairs_are_one_to_one_and_near(rooms):
    true = [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0)]
    found = [(1.1, 0.0), (0.95, 0.0), (0.0, 0.14), (5.0, 5.0)]
    assert rooms.matched(true, found) == [(0, 2), (1, 1)]
    assert rooms.matched(true, []) == []


@pytest.mark.parametrize(
    ("length", "width", "yaw", "off"),
    [(0.8, 0.3, 0.5, 0.0), (0.3, 0.8, 0.5 - math.pi / 2, 0.0), (0.8, 0.3, 0.7, 0.2)],
)
def test_yaw_is_that_of_the_longer_side(rooms, length, width, yaw, off):
    true = rooms.Thing("box", (0.0, 0.0), 0.5, (0.8, 0.3, 1.0), 0.5, 4.0)
    found = ShapeParameters("box", (0.0, 0.0), yaw, length, width, 1.0)
    assert rooms.yaw_error(true, found) == pytest.approx(off, abs=1e-9)


def test_shares_count_all_rooms(rooms):
    def row(kinds, found, pairs):
        return {
            "kinds": kinds,
            "found": found,
            "matched": [
                {"kind": k, "called": k, "error": 0.01, "scores": [1.0, 3.0], "yaw_error": 0.02}
                for k in pairs
            ],
            "conventional": {"found": 2, "errors": [0.1]},
            "seconds": 10.0,
        }

    found = rooms.measure([row(["box", "box"], 2, ["box"]), row(["wall"], 1, ["wall"])])
    assert found["recall"] == pytest.approx(2 / 3)
    assert found["precision"] == pytest.approx(2 / 3)
    assert found["count_right"] == 1.0
    assert found["within_two_deviations"] == 0.5
    assert found["yaw_error_deg"] == pytest.approx(math.degrees(0.02))
    assert found["conventional"]["recall"] == pytest.approx(2 / 3)
    assert found["conventional"]["precision"] == 0.5


def test_the_usual_chain_finds_a_ball(rooms):
    ball = rooms.Thing("sphere", (0.4, -0.3), 0.0, (0.3, 0.3, 0.3), 0.6, 5.0)
    room = rooms.Room(0, (ball,), tuple(torch.arange(8).double().tolist()), 20.0)
    (found,) = rooms.conventional(room.capture())
    assert math.dist(found, (0.4, -0.3)) < 0.15


@pytest.mark.slow
def test_a_corner_beside_a_box_is_a_corner(rooms):
    corner = rooms.Thing("corner", (0.9, -0.4), -math.pi / 2, (0.05, 0.05, 0.05), 0.5, 1.0)
    beside = rooms.Thing("box", (-0.5, 0.3), 0.4, (0.5, 0.8, 0.3), 0.4, 5.0)
    turns = tuple((torch.arange(16).double() * (2 * math.pi / 16)).tolist())
    row = rooms.Room(0, (beside, corner), turns, 10.0).row()
    assert row["found"] == 2
    assert [(pair["kind"], pair["called"]) for pair in row["matched"]] == [
        ("box", "box"),
        ("corner", "corner"),
    ]
    assert max(pair["error"] for pair in row["matched"]) < 0.05


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*unambiguous range:invertwin.errors.PhysicsWarning")
def test_walls_enclose_the_radar_and_show_things_again(rooms):
    drawn = rooms.Room.draw(2, has_walls=True)
    assert drawn.things == rooms.Room.draw(2).things
    assert min(drawn.span[:2]) / 2 > rooms.AWAY
    ball = rooms.Thing("sphere", (0.0, 0.0), 0.0, (0.4, 0.4, 0.4), 0.6, 5.0)
    span = 7.0, 7.0, 2.6
    room, free = (rooms.Room(0, (ball,), (0.0,), 60.0, walls) for walls in (span, None))
    ends = {name: item.vertices.abs().amax(0).tolist() for name, item in room.walls().items()}
    assert ends["far_x"] == pytest.approx([3.5, 3.5, 2.6])
    assert ends["near_y"] == pytest.approx([3.5, 3.5, 2.6])
    assert ends["ceiling"] == pytest.approx([3.5, 3.5, 2.6])
    assert ends["floor"] == pytest.approx([3.5, 3.5, 0.0])
    grid = room.radar().grid(0.5, 6.0)
    closed, alone = (one.capture().spectrum(grid).sum((0, 2, 3)) for one in (room, free))
    # The floor lies 0.6 m below the radar and the ball: √(3.2² + 1.2²) m by it, on one leg or both.
    ghosts = (grid.ranges > 3.25) & (grid.ranges < 3.5)
    before = (grid.ranges > 2.9) & (grid.ranges < 3.1)
    assert float(closed[ghosts].sum()) > 10 * float(alone[ghosts].sum())
    assert float(closed[before].sum()) == pytest.approx(float(alone[before].sum()), rel=0.3)
