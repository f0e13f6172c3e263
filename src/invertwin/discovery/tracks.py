"""What moves, followed from frame to frame: place and velocity over time, with their errors."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float64
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from invertwin.capture import ChirpCapture
from invertwin.channel import Grid
from invertwin.discovery.imaging.point_detections import movers
from invertwin.discovery.outcome import Thing, Track
from invertwin.inversion.initialisation.detections import Ground

_GATE = 16.3  # squared distance in deviations of 0.1 % of three normal numbers
_AGILE = 1.0  # acceleration that a mover may have [m/s²]
_ACROSS = 3.0  # velocity across the sight that a mover may have [m/s]
_LEAST = 3  # frames of a track
_LOST = 3  # frames in which a mover may be missed
_FAINT = 0.1  # confidence of what may continue a track


@dataclass(frozen=True, eq=False)
class _Seen:
    """What one frame says of a mover: z = H x + noise of covariance R, x = (place, velocity)."""

    frame: int
    thing: Thing
    value: Float64[Tensor, "3"]
    matrix: Float64[Tensor, "3 4"]
    noise: Float64[Tensor, "3 3"]


@dataclass(eq=False)
class _Path:
    """A mover that is followed: states after every frame, and before it."""

    first: int
    seen: list[_Seen]
    states: list[tuple[Tensor, Tensor]]
    before: list[tuple[Tensor, Tensor]] = field(default_factory=list)
    missed: int = 0


def tracks(recording: ChirpCapture, grid: Grid, ground: Ground) -> list[Thing]:
    """What moves, followed through all frames, the surest first; things are where they were last.

    Movers of a frame continue the tracks that they fit best, all together. A mover keeps its
    velocity along the ground but for accelerations of about 1 m/s². States are smoothed: every
    frame's says what all frames know of it.

    Source: Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and
    Navigation", 2001, chapters 6 and 8 (constant velocity, white acceleration; smoothing).

    Args:
        recording: Trains of chirps with a known time from frame to frame.
        grid: Bins of range and direction.
        ground: The plane on which things move.
    """
    assert recording.frame_period is not None
    step, spread = _motion(recording.frame_period)
    live, ended = list[_Path](), list[_Path]()
    for frame in range(recording.frame_count):
        found = [one for one in movers(recording, grid, frame) if one.confidence > _FAINT]
        seen = [_measured(one, recording, ground, frame) for one in found]
        for path in live:
            state, error = path.states[-1]
            path.before.append((step @ state, step @ error @ step.T + spread))
        taken = _continued(live, seen)
        ended += [path for path in live if path.missed > _LOST]
        live = [path for path in live if path.missed <= _LOST]
        live += [_begun(one) for one in seen if one not in taken]
    paths = [path for path in (*ended, *live) if len(path.seen) >= _LEAST]
    things = [_thing(path, step, recording.frame_period, ground) for path in paths]
    things.sort(key=lambda one: -one.confidence)
    return [replace(one, name=f"mover_{k}") for k, one in enumerate(things, 1)]


def _motion(period: float) -> tuple[Tensor, Tensor]:
    """The step of a state from frame to frame, and what accelerations add to its covariance."""
    two = torch.eye(2, dtype=torch.float64)
    step = torch.eye(4, dtype=torch.float64)
    step[:2, 2:] = period * two
    gain = torch.cat([0.5 * period**2 * two, period * two])
    return step, _AGILE**2 * gain @ gain.T


def _measured(one: Thing, recording: ChirpCapture, ground: Ground, frame: int) -> _Seen:
    axes = list(ground.level)
    radar = recording.radar()
    sight = one.position - radar.positions[frame].detach()
    along = torch.nn.functional.normalize(sight[axes], dim=0)
    across = torch.stack([-along[1], along[0]])
    distance = float(sight.norm())
    assert one.velocity is not None
    rate = float(one.velocity @ sight) / distance
    noise = torch.zeros(3, 3, dtype=torch.float64)
    noise[:2, :2] = one.deviations["range"] ** 2 * torch.outer(along, along)
    noise[:2, :2] += one.deviations["across"] ** 2 * torch.outer(across, across)
    noise[2, 2] = one.deviations["range_rate"] ** 2
    matrix = torch.zeros(3, 4, dtype=torch.float64)
    matrix[:2, :2] = torch.eye(2, dtype=torch.float64)
    matrix[2, 2:] = along
    value = torch.cat([one.position[axes], torch.tensor([rate], dtype=torch.float64)])
    return _Seen(frame, one, value, matrix, noise)


def _begun(one: _Seen) -> _Path:
    along, rate = one.matrix[2, 2:], one.value[2]
    error = torch.zeros(4, 4, dtype=torch.float64)
    error[:2, :2] = one.noise[:2, :2]
    error[2:, 2:] = _ACROSS**2 * (torch.eye(2, dtype=torch.float64) - torch.outer(along, along))
    error[2:, 2:] += one.noise[2, 2] * torch.outer(along, along)
    return _Path(one.frame, [one], [(torch.cat([one.value[:2], rate * along]), error)])


def _continued(live: Sequence[_Path], seen: Sequence[_Seen]) -> list[_Seen]:
    """Update paths by what fits them best, all together; return what continues one."""
    away = torch.full((len(live), len(seen)), 2 * _GATE, dtype=torch.float64)
    for row, path in enumerate(live):
        state, error = path.before[-1]
        for column, one in enumerate(seen):
            off = one.value - one.matrix @ state
            spread = one.matrix @ error @ one.matrix.T + one.noise
            away[row, column] = off @ torch.linalg.solve(spread, off)
    rows, columns = linear_sum_assignment(away.clamp_max(2 * _GATE).numpy())
    pairs = {int(a): int(b) for a, b in zip(rows, columns, strict=True) if away[a, b] < _GATE}
    for row, path in enumerate(live):
        state, error = path.before[-1]
        if row not in pairs:
            path.states.append((state, error))
            path.missed += 1
            continue
        one = seen[pairs[row]]
        spread = one.matrix @ error @ one.matrix.T + one.noise
        gain = torch.linalg.solve(spread, one.matrix @ error).T
        path.states.append(
            (state + gain @ (one.value - one.matrix @ state), error - gain @ one.matrix @ error)
        )
        path.seen.append(one)
        path.missed = 0
    return [seen[column] for column in pairs.values()]


def _thing(path: _Path, step: Tensor, period: float, ground: Ground) -> Thing:
    """A smoothed path as a thing; the frames after it was last seen do not count."""
    count = path.seen[-1].frame - path.first + 1
    states = path.states[:count]
    for k in range(count - 2, -1, -1):
        (state, error), (ahead, wide) = states[k], path.before[k]
        gain = torch.linalg.solve(wide, step @ error).T
        later, surer = states[k + 1]
        states[k] = (state + gain @ (later - ahead), error + gain @ (surer - wide) @ gain.T)
    axes = list(ground.level)
    height = torch.stack([one.thing.position[ground.vertical] for one in path.seen]).mean()
    values = torch.stack([state for state, _ in states])
    spreads = torch.stack([error.diagonal().clamp_min(0.0).sqrt() for _, error in states])
    positions, velocities = (torch.zeros(count, 3, dtype=torch.float64) for _ in range(2))
    positions[:, axes], positions[:, ground.vertical] = values[:, :2], height
    velocities[:, axes] = values[:, 2:]
    names = ["xyz"[axis] for axis in axes]
    names += [f"velocity_{name}" for name in names]
    sure = sum(one.thing.confidence for one in path.seen) / count
    frames = torch.arange(path.first, path.first + count, dtype=torch.float64)
    track = Track(frames * period, positions, velocities, dict(zip(names, spreads.T, strict=True)))
    return Thing(
        "",
        "point",
        {"point": 1.0},
        positions[-1],
        None,
        {name: float(column[-1]) for name, column in track.deviations.items()},
        sure,
        velocities[-1],
        track,
    )
