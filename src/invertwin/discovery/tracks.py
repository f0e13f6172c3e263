"""Multi-target tracking: positions and velocities of moving targets, with uncertainties."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float64
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from invertwin.capture import ChirpCapture
from invertwin.channel import Grid
from invertwin.discovery.imaging.point_detections import detect_moving_targets
from invertwin.discovery.outcome import DetectedObject, ObjectTrack

_MAX_SQUARED_DISTANCE = 16.3  # gate: 0.1 % quantile of χ² with three degrees of freedom
_ACCELERATION_DEVIATION = 1.0  # standard deviation of the acceleration of a target [m/s²]
_CROSS_RANGE_SPEED = 3.0  # standard deviation of the cross-range velocity [m/s]
_MIN_TRACK_FRAMES = 3  # minimum number of frames of a track
_MAX_MISSED_FRAMES = 3  # maximum number of missed frames


@dataclass(frozen=True, eq=False)
class _TrackMeasurement:
    """Measurement of a target in one frame: z = H x + noise of covariance R, x = (position,
    velocity).
    """

    frame: int
    detection: DetectedObject
    value: Float64[Tensor, "3"]
    matrix: Float64[Tensor, "3 4"]
    noise: Float64[Tensor, "3 3"]


@dataclass(eq=False)
class _KalmanTrack:
    """Track of a target: Kalman states after and before every frame."""

    first_frame: int
    measurements: list[_TrackMeasurement]
    states: list[tuple[Tensor, Tensor]]
    predictions: list[tuple[Tensor, Tensor]] = field(default_factory=list)
    missed_frames: int = 0


def track_moving_targets(recording: ChirpCapture, grid: Grid) -> list[DetectedObject]:
    """Track moving targets through all frames, the most probable first, at their last positions.

    Detections of a frame are assigned to tracks jointly (global nearest neighbour). A target keeps
    its velocity along the ground up to accelerations of about 1 m/s². States are smoothed over all
    frames.

    Source: Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and
    Navigation", 2001, chapters 6 and 8 (constant velocity, white acceleration; smoothing).

    Args:
        recording: chirp trains with a known frame period.
        grid: bins of range and direction.
    """
    assert recording.frame_period is not None
    step, spread = _motion_model(recording.frame_period)
    live, ended = list[_KalmanTrack](), list[_KalmanTrack]()
    for frame in range(recording.frame_count):
        found = detect_moving_targets(recording, grid, frame)
        seen = [_make_measurement(one, recording, frame) for one in found]
        for path in live:
            state, error = path.states[-1]
            path.predictions.append((step @ state, step @ error @ step.T + spread))
        taken = _update_tracks(live, seen)
        ended += [path for path in live if path.missed_frames > _MAX_MISSED_FRAMES]
        live = [path for path in live if path.missed_frames <= _MAX_MISSED_FRAMES]
        live += [_start_track(one) for one in seen if one not in taken]
    paths = [path for path in (*ended, *live) if len(path.measurements) >= _MIN_TRACK_FRAMES]
    objects = [_to_detected_object(path, step, recording.frame_period) for path in paths]
    objects.sort(key=lambda one: -one.existence_probability)
    return [replace(one, name=f"mover_{k}") for k, one in enumerate(objects, 1)]


def _motion_model(period: float) -> tuple[Tensor, Tensor]:
    """Return the transition matrix between frames, and the process noise covariance."""
    two = torch.eye(2, dtype=torch.float64)
    step = torch.eye(4, dtype=torch.float64) + period * torch.diag(torch.ones(2).double(), 2)
    gain = torch.cat([0.5 * period**2 * two, period * two])
    return step, _ACCELERATION_DEVIATION**2 * gain @ gain.T


def _make_measurement(
    detection: DetectedObject, recording: ChirpCapture, frame: int
) -> _TrackMeasurement:
    sight = detection.position - recording.radar().positions[frame].detach()
    along = torch.nn.functional.normalize(sight[:2], dim=0)
    across = torch.stack([-along[1], along[0]])
    distance = float(sight.norm())
    assert detection.velocity is not None
    rate = float(detection.velocity @ sight) / distance
    noise = torch.zeros(3, 3, dtype=torch.float64)
    noise[:2, :2] = detection.deviations["range"] ** 2 * torch.outer(along, along)
    noise[:2, :2] += detection.deviations["across"] ** 2 * torch.outer(across, across)
    noise[2, 2] = detection.deviations["range_rate"] ** 2
    matrix = torch.zeros(3, 4, dtype=torch.float64)
    matrix[:2, :2] = torch.eye(2, dtype=torch.float64)
    matrix[2, 2:] = along
    value = torch.cat([detection.position[:2], torch.tensor([rate], dtype=torch.float64)])
    return _TrackMeasurement(frame, detection, value, matrix, noise)


def _start_track(measurement: _TrackMeasurement) -> _KalmanTrack:
    along, rate = measurement.matrix[2, 2:], measurement.value[2]
    error = torch.zeros(4, 4, dtype=torch.float64)
    error[:2, :2] = measurement.noise[:2, :2]
    radial = torch.outer(along, along)
    error[2:, 2:] = _CROSS_RANGE_SPEED**2 * (torch.eye(2, dtype=torch.float64) - radial)
    error[2:, 2:] += measurement.noise[2, 2] * radial
    state = torch.cat([measurement.value[:2], rate * along])
    return _KalmanTrack(measurement.frame, [measurement], [(state, error)])


def _update_tracks(
    active_tracks: Sequence[_KalmanTrack], measurements: Sequence[_TrackMeasurement]
) -> list[_TrackMeasurement]:
    """Update tracks by jointly assigned measurements; return the assigned ones."""
    shape = len(active_tracks), len(measurements)
    away = torch.full(shape, 2 * _MAX_SQUARED_DISTANCE, dtype=torch.float64)
    for row, path in enumerate(active_tracks):
        state, error = path.predictions[-1]
        for column, one in enumerate(measurements):
            off = one.value - one.matrix @ state
            spread = one.matrix @ error @ one.matrix.T + one.noise
            away[row, column] = off @ torch.linalg.solve(spread, off)
    rows, columns = linear_sum_assignment(away.clamp_max(2 * _MAX_SQUARED_DISTANCE).numpy())
    near = away.numpy()[rows, columns] < _MAX_SQUARED_DISTANCE
    pairs = dict(zip(rows[near].tolist(), columns[near].tolist(), strict=True))
    for row, path in enumerate(active_tracks):
        state, error = path.predictions[-1]
        if row not in pairs:
            path.states.append((state, error))
            path.missed_frames += 1
            continue
        one = measurements[pairs[row]]
        spread = one.matrix @ error @ one.matrix.T + one.noise
        gain = torch.linalg.solve(spread, one.matrix @ error).T
        moved = state + gain @ (one.value - one.matrix @ state)
        path.states.append((moved, error - gain @ one.matrix @ error))
        path.measurements.append(one)
        path.missed_frames = 0
    return [measurements[column] for column in pairs.values()]


def _to_detected_object(path: _KalmanTrack, transition: Tensor, period: float) -> DetectedObject:
    """Convert a smoothed track to an object; frames after its last detection are dropped."""
    count = path.measurements[-1].frame - path.first_frame + 1
    states = path.states[:count]
    for k in range(count - 2, -1, -1):
        (state, error), (ahead, wide) = states[k], path.predictions[k]
        gain = torch.linalg.solve(wide, transition @ error).T
        later, surer = states[k + 1]
        states[k] = (state + gain @ (later - ahead), error + gain @ (surer - wide) @ gain.T)
    heights = [one.detection.position[2] for one in path.measurements]
    values = torch.stack([state for state, _ in states])
    spreads = torch.stack([error.diagonal().clamp_min(0.0).sqrt() for _, error in states])
    positions, velocities = (torch.zeros(count, 3, dtype=torch.float64) for _ in range(2))
    positions[:, :2], positions[:, 2] = values[:, :2], torch.stack(heights).mean()
    velocities[:, :2] = values[:, 2:]
    names = ["x", "y", "velocity_x", "velocity_y"]
    sure = sum(one.detection.existence_probability for one in path.measurements) / count
    frames = torch.arange(path.first_frame, path.first_frame + count, dtype=torch.float64)
    deviations = dict(zip(names, spreads.T, strict=True))
    track = ObjectTrack(frames * period, positions, velocities, deviations)
    last = {name: float(column[-1]) for name, column in deviations.items()}
    return DetectedObject.point("", positions[-1], last, sure, velocities[-1], track)
