"""What stands in a room, from a recording alone: 40 rooms of one to six things.

    python benchmarks/rooms.py [-o DIR] [--rooms 40] [--walls]

A 77 GHz board (2 × 4 channels, 4 GHz) looks at a room from 8 to 40 places around it. Walls, boxes,
cylinders, balls and standing people of 1.55 to 1.95 m are drawn: how many, what, where, how large,
of what material. Every other room has a corner reflector beside them, which opens towards one of
the places. Recordings are those of the exact chain, two bounces, with noise of 0 to 20 dB. Corners
echo by all bounces and edges of smooth conductors (`invertwin.rcs`), unless something hides them;
what they hide from others, and what goes from them to others, is left out. `invertwin.twin` knows
where the radar was, and the square in which things stand; nothing else. A thing is found if its
middle is within 0.15 m. Prints a table and writes `metrics.json`:

- `recall`, `precision`: of all things of all rooms; found ones count with a confidence above 0.5.
- `position_error_m`, `yaw_error_deg`: medians of those found; the yaw of boxes and walls.
- `count_right`: share of the rooms in which as many things were found as there are.
- `kind_right`: share of the things found that are called what they are.
- `within_two_deviations`: share of the errors along one axis below twice what the twin states.
- `conventional.*`: the same of the usual chain, from the same maps: constant false alarm rate, then
  clusters by density, then the box around each.
- `seconds`: of a room, its recording not counted.

With `--walls` the first 20 rooms have four smooth walls, a floor and a ceiling of concrete, which
show things a second and third time (`mirrors` of `invertwin.simulate`).

Each room is kept in `rows.jsonl` as it ends; the same command goes on after an interruption.
"""

import argparse
import json
import math
import statistics
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from report import MetricTable, Required, write
from scipy.interpolate import make_interp_spline
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree
from torch import Tensor

import invertwin as iw
from invertwin.channel import ViewpointScene
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import PhysicsWarning
from invertwin.inversion.initialisation.detections import label_groups, principal_rectangle
from invertwin.radar import add_noise, ordered_statistics_cfar, peaks
from invertwin.scene import (
    Cosine,
    Dielectric,
    Mesh,
    PerfectConductor,
    RoughDielectric,
    box,
    cylinder,
    linear_array,
    person,
    plate,
    rigid,
    rotation_from_vector,
    sphere,
    trihedral,
)
from invertwin.scene.people.gait import hanging_arm_rotation

REQUIRED: Required = {
    "recall": (">=", 0.9),
    "precision": (">=", 0.9),
    "position_error_m": ("<=", 0.03),
    "yaw_error_deg": ("<=", 5.0),
    "count_right": (">=", 0.7),
    "seconds": ("<=", 180.0),
}
KINDS = ("wall", "box", "cylinder", "sphere", "person")  # and every other room has a corner
NEAR = 0.15  # of a thing that is found [m]
HALF = 2.4  # of the square in which things stand [m]
AWAY, HEIGHT = 3.2, 0.6  # of the radar from the middle, and above the floor [m]
GAP = 0.15  # between things [m]
BODY = person(spacing=0.05)
CHIRP = iw.FMCW(start_frequency=77e9, bandwidth=4e9, duration=50e-6, samples=256)
CHAIN = iw.Sampling(depth=2, points_per_m2=500.0, boundary=False)
CONCRETE = Dielectric(5.24, scattering=0.0)
SETTINGS = repr((NEAR, HALF, AWAY, HEIGHT, GAP, CHIRP, CHAIN))


@dataclass(frozen=True)
class Thing:
    """One thing of a room.

    Attributes:
        kind: Among ``KINDS``, or corner.
        place: x and y of its middle [m].
        yaw: About the vertical [rad].
        size: Along its own x, y and z [m]; the inner edges of a corner.
        lift: Of its middle above the floor [m]; of the apex of a corner.
        permittivity: Of its material.
    """

    kind: str
    place: tuple[float, float]
    yaw: float
    size: tuple[float, float, float]
    lift: float
    permittivity: float

    @property
    def reach(self) -> float:
        """Radius of a circle around it [m]."""
        round_ = self.kind in ("cylinder", "sphere")
        return 0.5 * (self.size[0] if round_ else math.hypot(self.size[0], self.size[1]))

    def item(self) -> iw.Object:
        """The thing as an object."""
        if self.kind in ("wall", "box"):
            mesh = box(self.size)
        elif self.kind == "cylinder":
            mesh = cylinder(0.5 * self.size[0], self.size[2])
        elif self.kind == "sphere":
            mesh = sphere(0.5 * self.size[0], 3)
        else:
            body = _standing()
            tall = self.size[2] / float(body.vertices[:, 2].max() - body.vertices[:, 2].min())
            mesh = Mesh(tall * body.vertices, body.faces)
        pose = rigid(self.turn, self.middle)
        return iw.Object(mesh, RoughDielectric(permittivity=self.permittivity), pose)

    @property
    def turn(self) -> Tensor:
        """How it stands [3, 3]."""
        return rotation_from_vector(torch.tensor([0.0, 0.0, self.yaw], dtype=torch.float64))

    @property
    def middle(self) -> Tensor:
        """Its middle [m]."""
        return torch.tensor([*self.place, self.lift], dtype=torch.float64)

    def echo(self, radar: iw.Radar, scene: iw.Scene) -> Tensor:
        """The beat signal of a corner reflector: the amplitude of its field, as from its apex.

        Args:
            radar: At all its places.
            scene: What may hide it.
        """
        corner = iw.Scene({"corner": iw.Object(trihedral(self.size[0]), PerfectConductor())})
        link, count = radar.link(), 33
        away = radar.positions - self.middle
        band = CHIRP.start_frequency + torch.linspace(0, CHIRP.bandwidth, count).double()
        with warnings.catch_warnings():
            # Edges seen at grazing are left out: they are 40 dB below what matters.
            warnings.simplefilter("ignore", PhysicsWarning)
            found = iw.rcs(corner, away @ self.turn, band, up=(0.0, 0.0, 1.0), edges=1)
        frequency = CHIRP.start_frequency + CHIRP.step * torch.arange(CHIRP.samples).double()
        # Smooth over frequency, with the apex for its origin.
        spline = make_interp_spline(band.numpy(), found.matrix[:, :, 0, 0].numpy())
        amplitude = torch.from_numpy(spline(frequency.numpy())).T
        beat = torch.zeros(*radar.shape, CHIRP.samples, dtype=torch.complex128)
        tx, rx = radar.elements()
        for frame, place in enumerate(radar.positions):
            sight, way = ViewpointScene(scene, place), -away[frame : frame + 1]
            face = sight.find_first_faces(way)
            length = way.norm(dim=1)
            if int(face) >= 0 and float(sight.plane_distances(face, way / length)) < float(length):
                continue
            local = way / length @ link.rotations[frame]
            gain = (link.tx_pattern.gain(local) * link.rx_pattern.gain(local)).sqrt()
            spread = gain * CHIRP.wavelength / (4 * math.pi * length**2)
            ways = [(self.middle - ends[frame]).norm(dim=1) for ends in (tx, rx)]
            delay = (ways[0][:, None, None] + ways[1][None, :, None]) / SPEED_OF_LIGHT
            cycles = (frequency - 0.5 * CHIRP.residual_slope * delay) * delay
            beat[frame] = spread * amplitude[frame].conj() * torch.exp(2j * math.pi * cycles)
        return beat


def _place(uniform: Callable[[float, float], float]) -> tuple[float, float]:
    """A place in the room, x and y [m]."""
    y, x = uniform(-1.8, 1.8), uniform(-1.8, 1.8)
    return x, y


def _standing() -> Mesh:
    """A person with hanging arms, about the middle of its box."""
    turns = torch.eye(3, dtype=torch.float64).repeat(len(BODY.names), 1, 1)
    for side in ("left", "right"):
        turns[BODY.joint(f"{side}_shoulder")] = hanging_arm_rotation(side)
    skin, _ = BODY.apply_pose(turns)
    return Mesh(skin - 0.5 * (skin.amax(0) + skin.amin(0)), BODY.faces)


@dataclass(frozen=True)
class Room:
    """A room, and how it was recorded.

    Attributes:
        number: Of the room, which seeds everything.
        things: What stands in it.
        turns: Directions from the middle to the places of the radar, from y towards x [rad].
        snr_db: Of samples.
        span: Of the walls along x and y, and height of the ceiling [m]; None = things in the open.
    """

    number: int
    things: tuple[Thing, ...]
    turns: tuple[float, ...]
    snr_db: float
    span: tuple[float, float, float] | None = None

    @staticmethod
    def draw(number: int, has_walls: bool = False) -> "Room":
        """A room.

        Args:
            number: Of the room.
            has_walls: False = things in the open.
        """
        random = torch.Generator().manual_seed(1000 + number)
        stature = torch.Generator().manual_seed(2000 + number)

        def uniform(low: float, high: float) -> float:
            return low + (high - low) * float(torch.rand((), generator=random))

        things: list[Thing] = []
        while len(things) < 1 + number % 6:
            kind = KINDS[int(uniform(0, len(KINDS)))]
            lift = None
            if kind == "wall":
                wide, tall = uniform(0.8, 2.0), uniform(0.6, 1.5)
                size = 0.02, wide, tall
            elif kind == "box":
                wide, tall, deep = uniform(0.25, 0.9), uniform(0.4, 1.2), uniform(0.25, 0.7)
                size = deep, wide, tall
            elif kind == "cylinder":
                across = uniform(0.16, 0.6)
                size = across, across, uniform(0.4, 1.5)
            elif kind == "sphere":
                across = uniform(0.2, 0.6)
                size = across, across, across
                lift = uniform(0.5 * size[2], 1.0)
            else:
                span = _standing().vertices
                deep, wide, tall = (span.amax(0) - span.amin(0)).tolist()
                part = 0.88 + 0.24 * float(torch.rand((), generator=stature))
                size = part * float(deep), part * float(wide), part * float(tall)
            thing = Thing(
                kind,
                _place(uniform),
                uniform(-math.pi, math.pi),
                size,
                0.5 * size[2] if lift is None else lift,
                uniform(2.5, 8.0),
            )
            free = (math.dist(thing.place, o.place) - thing.reach - o.reach > GAP for o in things)
            if all(free):
                things.append(thing)
        count = int(uniform(8, 41))
        span, first = uniform(math.radians(240), 2 * math.pi * (1 - 1 / count)), uniform(0, 6.3)
        turns = tuple(first + span * k / (count - 1) for k in range(count))
        snr_db = uniform(0.0, 20.0)
        while number % 2 == 1:
            edge, towards = uniform(0.03, 0.06), turns[int(uniform(0, count))]
            place = _place(uniform)
            out = AWAY * math.sin(towards) - place[0], AWAY * math.cos(towards) - place[1]
            # Its boresight is −x; a yaw takes x towards y.
            yaw = math.atan2(-out[1], -out[0])
            thing = Thing("corner", place, yaw, (edge, edge, edge), uniform(0.3, 1.0), 1.0)
            free = (math.dist(thing.place, o.place) - thing.reach - o.reach > GAP for o in things)
            if all(free):
                things.append(thing)
                break
        walls = torch.rand(3, generator=torch.Generator().manual_seed(3000 + number)).tolist()
        span = 6.8 + 1.6 * walls[0], 6.8 + 1.6 * walls[1], 2.4 + 0.8 * walls[2]
        return Room(number, tuple(things), turns, snr_db, span if has_walls else None)

    def radar(self) -> iw.Radar:
        """The board at all its places, looking at the middle."""
        turns = torch.tensor(self.turns, dtype=torch.float64)
        zero = torch.zeros_like(turns)
        out = torch.stack([turns.sin(), turns.cos(), zero], dim=-1)
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(out)
        axes = torch.stack([-out, torch.linalg.cross(up, -out), up], dim=-1)
        half, patch = CHIRP.wavelength / 2, Cosine(1.0)
        return iw.Radar(
            linear_array(2, 4 * half, pattern=patch),
            linear_array(4, half, pattern=patch),
            CHIRP,
            AWAY * out + HEIGHT * up,
            axes,
        )

    def walls(self) -> dict[str, iw.Object]:
        """Smooth walls, floor and ceiling."""
        if self.span is None:
            return {}
        length, width, height = self.span
        found: dict[str, iw.Object] = {}

        def add(name: str, mesh: Mesh, turn: Sequence[float], middle: Sequence[float]) -> None:
            axes = rotation_from_vector(torch.tensor(turn, dtype=torch.float64))
            pose = rigid(axes, torch.tensor(middle, dtype=torch.float64))
            found[name] = iw.Object(mesh, CONCRETE, pose)

        for side, name in ((1.0, "far"), (-1.0, "near")):
            add(f"{name}_x", plate(width, height), (0, 0, 0), (side * length / 2, 0, height / 2))
            turn = 0, 0, math.pi / 2
            add(f"{name}_y", plate(length, height), turn, (0, side * width / 2, height / 2))
        for name, at in (("floor", 0.0), ("ceiling", height)):
            add(name, plate(width, length), (0, math.pi / 2, 0), (0, 0, at))
        return found

    def capture(self) -> iw.Capture:
        """What the board records."""
        corners = [one for one in self.things if one.kind == "corner"]
        rest = [one for one in self.things if one.kind != "corner"]
        scene = iw.Scene({f"thing_{k}": one.item() for k, one in enumerate(rest)})
        radar = self.radar()
        grid, walls = radar.grid(0.5, 6.0), self.walls()
        plan = replace(CHAIN, depth=3) if walls else CHAIN
        room = iw.Scene({**scene.objects, **walls})
        signals = iw.simulate(room, radar, grid, seed=self.number, sampling=plan, mirrors=[*walls])
        beat = signals.beat
        for corner in corners:
            beat = beat + corner.echo(radar, scene)
        beat = add_noise(beat, radar, snr_db=self.snr_db, seed=self.number)
        return iw.Capture.from_beat(beat, radar)

    def row(self) -> dict[str, Any]:
        """The room's metrics."""
        capture = self.capture()
        begin = perf_counter()
        twin = iw.twin(capture, low=(-HALF, -HALF), high=(HALF, HALF), level=0.0, seed=self.number)
        seconds = perf_counter() - begin
        sure = [thing for thing in twin.objects if thing.existence_probability > 0.5]
        places = [(float(t.position[0]), float(t.position[1])) for t in sure]
        pairs = matched([thing.place for thing in self.things], places)
        rows = [
            self._judged(self.things[a], sure[b], math.dist(self.things[a].place, places[b]))
            for a, b in pairs
        ]
        usual = conventional(capture)
        near = matched([thing.place for thing in self.things], usual)
        return {
            "number": self.number,
            "kinds": [thing.kind for thing in self.things],
            "frames": len(self.turns),
            "found": len(sure),
            "unsure": len(twin.objects) - len(sure),
            "matched": rows,
            "missed": [
                thing.kind for k, thing in enumerate(self.things) if k not in [a for a, _ in pairs]
            ],
            "conventional": {
                "found": len(usual),
                "errors": [math.dist(self.things[a].place, usual[b]) for a, b in near],
            },
            "seconds": seconds,
        }

    def _judged(self, true: Thing, found: Any, error: float) -> dict[str, Any]:
        figure = found.shape
        row: dict[str, Any] = {"kind": true.kind, "called": found.kind, "error": error}
        row["scores"] = [
            abs(float(found.position[axis]) - at) / found.deviations[name]
            for axis, name, at in ((0, "x", true.place[0]), (1, "y", true.place[1]))
        ]
        if true.kind in ("wall", "box") and figure.is_rectangular:
            row["yaw_error"] = yaw_error(true, figure)
        return row


def yaw_error(true: Thing, found: Any) -> float:
    """The turn between a box and the one found [rad]: of their longer sides, if they differ.

    Args:
        true: The thing.
        found: Its figure.
    """

    def longer(yaw: float, length: float, width: float) -> float:
        return yaw if length >= width else yaw + math.pi / 2

    sides = sorted(true.size[:2])
    period = math.pi / 2 if sides[1] < 1.15 * sides[0] else math.pi
    off = longer(true.yaw, *true.size[:2])
    off = (longer(found.yaw, found.length, found.width) - off) % period
    return min(off, period - off)


def matched(
    true: Sequence[tuple[float, float]], found: Sequence[tuple[float, float]]
) -> list[tuple[int, int]]:
    """Pairs of a thing and what was found within ``NEAR``, one to one.

    Args:
        true: Places of things [m].
        found: Places of what was found [m].
    """
    if not true or not found:
        return []
    away = torch.cdist(torch.tensor(true).double(), torch.tensor(found).double())
    rows, columns = linear_sum_assignment((away + 10.0 * (away > NEAR)).numpy())
    return [(int(a), int(b)) for a, b in zip(rows, columns, strict=True) if away[a, b] <= NEAR]


def conventional(
    capture: iw.Capture, gap: float = 0.2, least: int = 4
) -> list[tuple[float, float]]:
    """Middles of boxes around clusters of detections [m].

    Source of clusters: Ester et al., "A density-based algorithm for discovering clusters", 1996.

    Args:
        capture: The recording.
        gap: Between neighbours in a cluster [m].
        least: Neighbours of a detection that lies within a cluster.
    """
    radar = capture.radar()
    grid = radar.grid(0.5, 6.0)
    power = capture.spectrum(grid).detach().double()
    seen = torch.stack(
        [ordered_statistics_cfar(frame, false_alarm=1e-6, rank=0.25) for frame in power.amax(3)]
    )
    points = peaks(power, seen, radar, grid).position.double()
    points = points[(points[:, :2].abs() < HALF).all(1)]
    if len(points) < least:
        return []
    points[:, 2] = 0.0
    tree = KDTree(points.numpy())
    counts = torch.tensor([len(near) for near in tree.query_ball_point(points.numpy(), gap)])
    core = points[counts >= least]
    if not len(core):
        return []
    labels = label_groups(core, gap)
    found: list[tuple[float, float]] = []
    for number in range(int(labels.max()) + 1):
        own: Tensor = core[labels == number]
        middle = principal_rectangle(own).center if len(own) > 2 else own.mean(0)
        found.append((float(middle[0]), float(middle[1])))
    return found


def rows(out: Path, count: int, has_walls: bool) -> Iterator[dict[str, Any]]:
    """The rows of all rooms; those that are in the folder are not done again."""
    settings = SETTINGS + " walls" * has_walls
    out.mkdir(parents=True, exist_ok=True)
    file, kept = out / "rows.jsonl", dict[int, dict[str, Any]]()
    if file.exists():
        lines = [json.loads(line) for line in file.read_text().splitlines() if line.endswith("}")]
        kept = {row["number"]: row for row in lines if row["settings"] == settings}
    for number in range(count):
        if number not in kept:
            row: dict[str, Any] = {**Room.draw(number, has_walls).row(), "settings": settings}
            with file.open("a") as rest:
                rest.write(json.dumps(row) + "\n")
            kept[number] = row
            print(
                f"{number + 1} of {count}: {len(row['matched'])} of {len(row['kinds'])} things, "
                f"{row['found'] - len(row['matched'])} invented, missed {row['missed']}, "
                f"{row['seconds']:.0f} s",
                flush=True,
            )
        yield kept[number]


def measure(found: list[dict[str, Any]]) -> dict[str, Any]:
    """All metrics of the rows.

    Args:
        found: Of all rooms.
    """
    things = sum(len(row["kinds"]) for row in found)
    pairs = [pair for row in found for pair in row["matched"]]
    yaws = [math.degrees(pair["yaw_error"]) for pair in pairs if "yaw_error" in pair]
    scores = [score for pair in pairs for score in pair["scores"]]
    called = [pair["kind"] == pair["called"] for pair in pairs]
    usual = [error for row in found for error in row["conventional"]["errors"]]
    middle = lambda values: statistics.median(values) if values else None  # noqa: E731

    def share(part: float, of: float) -> float | None:
        return part / of if of else None

    return {
        "recall": share(len(pairs), things),
        "precision": share(len(pairs), sum(row["found"] for row in found)),
        "position_error_m": middle([pair["error"] for pair in pairs]),
        "yaw_error_deg": middle(yaws),
        "count_right": share(sum(row["found"] == len(row["kinds"]) for row in found), len(found)),
        "kind_right": share(sum(called), len(called)),
        "within_two_deviations": share(sum(score < 2 for score in scores), len(scores)),
        "seconds": middle([row["seconds"] for row in found]),
        "seconds_longest": max(row["seconds"] for row in found),
        "conventional": {
            "recall": share(len(usual), things),
            "precision": share(len(usual), sum(row["conventional"]["found"] for row in found)),
            "position_error_m": middle(usual),
            "count_right": share(
                sum(row["conventional"]["found"] == len(row["kinds"]) for row in found), len(found)
            ),
        },
        "rooms": len(found),
        "things": things,
    }


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/rooms"))
    parser.add_argument("--rooms", type=int, help="default 40, with walls 20")
    parser.add_argument("--walls", action="store_true", help="smooth walls, floor and ceiling")
    given = parser.parse_args()
    count = given.rooms or (20 if given.walls else 40)
    metrics = measure(list(rows(given.out, count, given.walls)))
    required = REQUIRED
    if given.walls:
        required = {"recall": (">=", 0.9), "precision": (">=", 0.95)}
    table = MetricTable("Rooms", required)
    text = {
        "recall": f"of {metrics['things']} things",
        "count_right": f"of {metrics['rooms']} rooms",
    }
    for key in (*required, "kind_right", "within_two_deviations"):
        table.row(key, metrics[key], ".3f", text.get(key, ""))
    for key, value in metrics["conventional"].items():
        table.row(f"conventional.{key}", value, ".3f", "CFAR, clusters, boxes")
    write(metrics, table.grid, given.out)


if __name__ == "__main__":
    main()
