"""A network that finds people by radar meets rooms whose walls mirror, and learns from a twin.

It was trained in generic rooms with weak walls. In an unseen room with strong ones, 30 recordings
without labels tell a twin of the room; recordings simulated in the twin train the network further.
Beside it: nothing, statistics of batch normalisation, TENT, and training in the true room, which is
the bound.

    .venv/bin/python experiments/cases/adaptation/run.py [--quick] [-o out/adaptation]

Writes `metrics.json` and `adaptation.png`. An interrupted run goes on with the next step.
"""

import argparse
import json
import statistics
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import network
import rooms
import torch
import twin
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rooms import Room, Samples

from invertwin.plotting import PALETTE
from invertwin.seeds import derive_seed
from invertwin.storage.folders import replace_file

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
        with replace_file(file) as part:
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
            seed = derive_seed(GENERIC, number)
            room = rooms.random_room(seed, *WEAK)
            parts.append(
                recordings(folder / f"generic_{number}.pt", room, each, derive_seed(seed, 1))
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
    true = rooms.random_room(derive_seed(UNSEEN, number), *STRONG)

    def of(name: str, room: Room, count: int, key: int) -> Samples:
        file = folder / f"room_{number}_{name}.pt"
        return recordings(file, room, count, derive_seed(key, number))

    tested = of("tested", true, plan.tested, TESTED)
    maps = of("seen", true, plan.seen, SEEN).maps  # without labels
    room = Room(**kept(folder / f"room_{number}_twin.pt", lambda: vars(twin.fitted(maps))))
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
            for name in ("right", "left", "back")
        },
        "cabinet_error_m": float((room.cabinet - true.cabinet).norm()),
    }


def _listed(room: Room) -> dict[str, Any]:
    return {item.name: getattr(room, item.name).tolist() for item in fields(Room)}


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """All metrics.

    Args:
        rows: Of the rooms.
    """
    walls = [error for row in rows for error in row["wall_errors_m"].values()]
    return {
        "seeds": list(range(len(rows))),
        "gap_recovered": statistics.fmean(row["gap_recovered"] for row in rows),
        "gap_recovered_least": min(row["gap_recovered"] for row in rows),
        "above_tent": sum(row["gap_recovered"] > row["gap_recovered_tent"] for row in rows),
        "position_error_m": _means(rows, "position_error_m"),
        "right_postures": _means(rows, "right_postures"),
        "wall_error_median_m": statistics.median(walls),
        "wall_error_most_m": max(walls),
        "cabinet_error_median_m": statistics.median(row["cabinet_error_m"] for row in rows),
        "rooms": rows,
    }


def _means(rows: list[dict[str, Any]], key: str) -> dict[str, float]:
    return {name: statistics.fmean(row[key][name] for row in rows) for name in METHODS}


def figure(rows: list[dict[str, Any]]) -> Figure:
    """Rooms with their twins, and the errors in each.

    Args:
        rows: Of the rooms.
    """
    drawn = Figure(figsize=(11, 4.2), layout="constrained")
    parts: Any = drawn.subfigures(2, 1, height_ratios=[1.2, 1])
    above, below = parts
    plans: Any = above.subplots(1, len(rows), squeeze=False)[0]
    for number, (axes, row) in enumerate(zip(plans, rows, strict=True)):
        _plan(axes, row["true"], "0.6", "room")
        _plan(axes, row["twin"], PALETTE[1], "twin")
        axes.set(aspect="equal", xlim=(3.6, -3.6), ylim=(-0.4, 7.4), xticks=[], yticks=[])
        axes.set_title(f"room {number}", fontsize=8)
    plans[0].legend(fontsize=7, loc="lower left")
    axes = below.subplots()
    width = 0.8 / len(METHODS)
    for place, name in enumerate(METHODS):
        values = [row["position_error_m"][name] for row in rows]
        at = [number + (place - 2) * width for number in range(len(rows))]
        axes.bar(at, values, width, color=PALETTE[place], label=name)
    axes.set_xticks(range(len(rows)), [f"room {n}" for n in range(len(rows))], fontsize=8)
    axes.set_ylabel("median error [m]", fontsize=8)
    axes.legend(fontsize=7, ncols=len(METHODS), loc="upper center")
    axes.set_ylim(0, 1.35 * max(max(row["position_error_m"].values()) for row in rows))
    axes.tick_params(labelsize=7)
    return drawn


def _plan(axes: Axes, room: dict[str, Any], color: str, name: str) -> None:
    """Walls and cabinet from above, the radar below: ahead is up, the left is left."""
    left, right, back = room["left"], room["right"], room["back"]
    axes.plot([left, left, right, right], [0, back, back, 0], color=color, label=name)
    x, y = room["cabinet"]
    deep, wide = (size / 2 for size in rooms.CABINET[:2])
    corners = [(y - wide, x - deep), (y + wide, x - deep), (y + wide, x + deep)]
    corners += [(y - wide, x + deep), (y - wide, x - deep)]
    axes.plot(*zip(*corners, strict=True), color=color)
    axes.plot([0], [0], "k^", markersize=4)


def main() -> None:
    """Run the case."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="a small version, under a minute")
    parser.add_argument("-o", "--output", type=Path, default=None)
    given = parser.parse_args()
    plan = QUICK if given.quick else Plan()
    folder = given.output or Path("out/adaptation_quick" if given.quick else "out/adaptation")
    folder.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)  # all of it is small work
    net, rows = generic_network(plan, folder), list[dict[str, Any]]()
    for number in range(plan.rooms):
        rows.append(in_room(number, net, plan, folder))
        errors = rows[-1]["position_error_m"]
        told = ", ".join(f"{name} {errors[name]:.2f} m" for name in METHODS)
        print(f"room {number}: {told}; gap recovered {rows[-1]['gap_recovered']:.2f}", flush=True)
    figure(rows).savefig(folder / "adaptation.png", dpi=110)
    metrics = summary(rows)
    with replace_file(folder / "metrics.json") as part:
        part.write_text(json.dumps(metrics, indent=2) + "\n", encoding="utf-8")
    print(json.dumps({key: value for key, value in metrics.items() if key != "rooms"}, indent=2))


if __name__ == "__main__":
    main()
