"""A network that finds people by radar meets rooms whose walls mirror, and learns from a twin.

It was trained in generic rooms with weak walls. In an unseen room with strong ones, 30 recordings
without labels tell a twin of the room; recordings simulated in the twin train the network further.
Beside it: nothing, statistics of batch normalisation, TENT, and training in the true room, which is
the bound.

    .venv/bin/python experiments/cases/adaptation/run.py [--quick] [-o out/adaptation]

Writes `metrics.json` and `adaptation.png`. An interrupted run goes on with the next step.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import network
import rooms
import torch
import twin
from rooms import Room, Samples

from invertwin.folders import replacing
from invertwin.seeds import derived_seed

WEAK, STRONG = (1.5, 4.0), (60.0, 200.0)  # permittivity of walls: generic and unseen rooms
GENERIC, UNSEEN, TRUE, SITE, SEEN, TESTED = range(1, 7)  # keys of seeds
METHODS = ("before", "statistics", "tent", "adapted", "bound")


@dataclass(frozen=True)
class Plan:
    """How much is done.

    Attributes:
        rooms: Unseen rooms.
        generic: Generic rooms, and samples in each.
        seen: Unlabelled recordings of a room.
        site: Samples from the twin, and as many from the true room for the bound.
        tested: Recordings of a room that errors are of.
        rounds: Of training: generic, in a room.
    """

    rooms: int = 5
    generic: tuple[int, int] = (100, 20)
    seen: int = 30
    site: int = 600
    tested: int = 150
    rounds: tuple[int, int] = (40, 30)


QUICK = Plan(1, (6, 8), 8, 32, 16, (3, 3))


def kept(file: Path, make: Callable[[], Any]) -> Any:
    """What a file holds, or what is made and written.

    Args:
        file: Where.
        make: Makes it.
    """
    if not file.exists():
        with replacing(file) as part:
            torch.save(make(), part)
    return torch.load(file)


def recordings(file: Path, room: Room, count: int, seed: int) -> Samples:
    """Recordings of a room, kept in a file.

    Args:
        file: Where.
        room: The room.
        count: How many.
        seed: Of them.
    """
    return Samples(**kept(file, lambda: vars(rooms.recorded(room, count, seed))))


def generic_network(plan: Plan, folder: Path) -> network.Finder:
    """The network before it meets any unseen room.

    Args:
        plan: How much.
        folder: Of the output.
    """
    count, each = plan.generic

    def samples() -> Samples:
        parts = []
        for number in range(count):
            seed = derived_seed(GENERIC, number)
            room = rooms.random_room(seed, *WEAK)
            parts.append(
                recordings(folder / f"generic_{number}.pt", room, each, derived_seed(seed, 1))
            )
            print(f"generic rooms: {number + 1} of {count}", flush=True)
        return network.joined(parts)

    net = network.Finder()
    net.load_state_dict(
        kept(
            folder / "generic.pt",
            lambda: network.trained(samples(), 0, plan.rounds[0]).state_dict(),
        )
    )
    return net.eval()


def in_room(number: int, net: network.Finder, plan: Plan, folder: Path) -> dict[str, Any]:
    """Errors of all methods in an unseen room, and of its twin.

    Args:
        number: Of the room.
        net: The generic network.
        plan: How much.
        folder: Of the output.
    """
    true = rooms.random_room(derived_seed(UNSEEN, number), *STRONG)

    def of(name: str, room: Room, count: int, key: int) -> Samples:
        file = folder / f"room_{number}_{name}.pt"
        return recordings(file, room, count, derived_seed(key, number))

    tested = of("tested", true, plan.tested, TESTED)
    maps = of("seen", true, plan.seen, SEEN).maps  # without labels
    found = kept(folder / f"room_{number}_twin.pt", lambda: vars(twin.fitted(maps)))
    room = Room(**found["room"]) if isinstance(found["room"], dict) else found["room"]
    site, bound = of("site", room, plan.site, SITE), of("true", true, plan.site, TRUE)
    nets = {
        "before": net,
        "statistics": network.with_statistics(net, maps),
        "tent": network.least_entropy(net, maps),
        "adapted": network.trained(site, number, plan.rounds[1], net),
        "bound": network.trained(bound, number, plan.rounds[1], net),
    }
    rows = {name: network.errors(nets[name], tested) for name in METHODS}
    gap = rows["before"][0] - rows["bound"][0]
    return {
        "position_error_m": {name: row[0] for name, row in rows.items()},
        "right_postures": {name: row[1] for name, row in rows.items()},
        "gap_recovered": (rows["before"][0] - rows["adapted"][0]) / gap,
        "gap_recovered_tent": (rows["before"][0] - rows["tent"][0]) / gap,
        "twin": _listed(room),
        "true": _listed(true),
        "wall_errors_m": {
            name: abs(float(getattr(room, name) - getattr(true, name)))
            for name in ("left", "right", "back")
        },
        "cabinet_error_m": float((room.cabinet - true.cabinet).norm()),
    }


def _listed(room: Room) -> dict[str, Any]:
    return {item.name: getattr(room, item.name).tolist() for item in fields(Room)}
