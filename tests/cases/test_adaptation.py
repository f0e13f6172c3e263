"""The case of adaptation: recordings, the twin's maps, the network and what adapts it."""

from dataclasses import replace
from types import ModuleType

import pytest
import torch

from cases.loading import loaded


@pytest.fixture(scope="module")
def rooms() -> ModuleType:
    return loaded("adaptation", "rooms")


@pytest.fixture(scope="module")
def network(rooms: ModuleType) -> ModuleType:
    return loaded("adaptation", "network")


@pytest.fixture(scope="module")
def twin(rooms: ModuleType) -> ModuleType:
    return loaded("adaptation", "twin")


@pytest.fixture(scope="module")
def strong(rooms: ModuleType):
    return rooms.random_room(4, 60.0, 200.0)


def test_recordings_depend_on_their_number_alone(rooms: ModuleType, strong):
    few, more = rooms.recorded(strong, 2, 7), rooms.recorded(strong, 3, 7)
    assert torch.equal(few.maps, more.maps[:2])
    assert not torch.equal(more.maps[1], more.maps[2])
    assert bool(rooms.inside(strong, more.places).all())


def test_walls_that_mirror_show_people_again_further_away(rooms: ModuleType, strong):
    weak = replace(strong, permittivity=torch.full((3,), 1.0001, dtype=torch.float64))
    loud, quiet = (rooms.recorded(room, 6, 3) for room in (strong, weak))
    assert torch.equal(loud.places, quiet.places)
    ranges = rooms.GRID.ranges[None, :, None]
    beyond = ranges > loud.places.norm(dim=1)[:, None, None] + 1.0
    ghosts, none = ((s.maps * ranges**4 * beyond).sum((1, 2)) for s in (loud, quiet))
    assert float((ghosts / none).min()) > 1.5
    assert float((ghosts / none).median()) > 3


def test_the_twins_map_of_a_place_is_the_mean_of_exact_ones(
    rooms: ModuleType, twin: ModuleType, strong
):
    """In the true room, recordings are alike the maps of their own places, not of others."""
    taken = rooms.recorded(strong, 8, 11)
    seen = twin.observed(taken.maps).flatten(1).sqrt()
    with torch.no_grad():
        maps = twin.predicted(strong, taken.places).flatten(1).sqrt()
    alike = (seen / seen.norm(dim=1, keepdim=True)) @ (maps / maps.norm(dim=1, keepdim=True)).T
    best = taken.places[alike.argmax(1)]
    assert float((best - taken.places).norm(dim=1).max()) < 0.5
    assert float(alike.diagonal().mean()) > 0.75


def test_score_prefers_the_true_room_and_is_differentiable(
    rooms: ModuleType, twin: ModuleType, strong
):
    seen = twin.observed(rooms.recorded(strong, 12, 5).maps)
    with torch.no_grad():
        best = float(twin.score(strong, seen))
        for change in ({"back": strong.back + 0.3}, {"back": strong.back - 0.3}):
            assert float(twin.score(replace(strong, **change), seen)) < best - 0.01
        dull = torch.full((3,), 1.5, dtype=torch.float64)
        assert float(twin.score(replace(strong, permittivity=dull), seen)) < best - 0.01
    back = (strong.back + 0.1).requires_grad_()
    # The grid of places, and so the score, jumps where a place enters the room.
    (slope,) = torch.autograd.grad(twin.score(replace(strong, back=back), seen), back)
    with torch.no_grad():
        ends = [
            float(twin.score(replace(strong, back=back + side * 1e-3), seen)) for side in (1, -1)
        ]
    assert float(slope) == pytest.approx((ends[0] - ends[1]) / 2e-3, rel=0.02)
    assert float(slope) < 0


def test_adaptation_without_labels_changes_what_it_says(rooms: ModuleType, network: ModuleType):
    room = rooms.random_room(2, 1.5, 4.0)
    taken = rooms.recorded(room, 32, 1)
    net = network.trained(taken, 0, 40)
    first = network.trained(taken, 0, 1)
    assert network.errors(net, taken)[0] < 0.5 * network.errors(first, taken)[0]
    maps = taken.maps[:10] * 5.0

    def entropy(other: torch.nn.Module) -> float:
        chance = other.train()(network.shown(maps))[1].softmax(-1)
        return float(-(chance * chance.log()).sum(-1).mean())

    least, plain = network.least_entropy(net, maps), network.with_statistics(net, maps)
    with torch.no_grad():
        assert entropy(least) < entropy(plain)
    before = {name: value for name, value in net.named_parameters() if "head" in name}
    for name, value in least.named_parameters():
        if name in before:
            assert torch.equal(value, before[name])


def test_summary_counts_rooms(rooms: ModuleType, network: ModuleType, twin: ModuleType):
    run = loaded("adaptation", "run")
    errors = {"before": 0.5, "statistics": 0.4, "tent": 0.4, "adapted": 0.2, "bound": 0.1}
    row = {
        "position_error_m": errors,
        "right_postures": dict.fromkeys(errors, 0.5),
        "gap_recovered": 0.75,
        "gap_recovered_tent": 0.25,
        "wall_errors_m": {"left": 0.1, "right": 0.2, "back": 0.0},
        "cabinet_error_m": 0.3,
    }
    worse = row | {"gap_recovered": 0.2}
    found = run.summary([row, worse])
    assert found["gap_recovered"] == pytest.approx(0.475)
    assert found["gap_recovered_least"] == 0.2
    assert found["above_tent"] == 1
    assert found["wall_error_median_m"] == pytest.approx(0.1)
    assert found["wall_error_most_m"] == 0.2
