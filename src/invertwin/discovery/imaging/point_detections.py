"""Point detections without a shape: moving targets, and coherent points along a dense track."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.capture import Capture, ChirpCapture, backproject
from invertwin.channel import Grid
from invertwin.discovery.imaging.reflectivity import direction_cell
from invertwin.discovery.outcome import DetectedObject
from invertwin.inversion.initialisation.detections import label_groups
from invertwin.radar import detect_points, noise_power
from invertwin.radar.aperture import aperture
from invertwin.radar.processing import doppler
from invertwin.radar.processing.backprojection import pairwise_distances

_MAX_GROUP_CELLS = 3.0  # cells of range and rate between echoes of one target
_MIN_RELATIVE_PEAK = 0.1  # relative to the strongest: weaker peaks may be sidelobes
_TARGET_SIDELOBE_LEVEL = 3e-3  # relative to the strongest target: weaker ones may be its sidelobes
_NO_SIDELOBE_LEVEL = 0.5  # relative to the strongest: stronger peaks are no sidelobes
_DIRECTION_ERROR_BEAMS = 0.3  # standard deviation of a direction in beamwidths
_MIN_EXISTENCE_PROBABILITY = 0.1  # less probable moving targets are dropped
_FALSE_ALARM = 0.01  # chance that noise alone shows a moving target in a frame
_MAX_POINTS = 50  # strongest of one frame
_MIN_COHERENCE = 0.2  # 0.4 at the measured peak of a corner, below 0.1 between echoes
_MAX_STEPS = 100  # nodes of an image on either side of its middle
_POINTS_PER_CHUNK = 20_000  # points of an image per chunk


def detect_moving_targets(
    recording: ChirpCapture, grid: Grid, frame: int = 0
) -> list[DetectedObject]:
    """Detect moving targets in one frame, the strongest first, after static clutter removal.

    Echoes close in range and range rate form one target at the position of its strongest echo.
    Echoes whose range rate equals that of static objects under the radar's own motion are excluded.

    Args:
        recording: chirp train.
        grid: bins of range and direction.
        frame: index of the frame.
    """
    if recording.chirps.count < 4:
        return []
    beat = recording.beat - recording.beat.mean(1, keepdim=True)
    radar, chirps = recording.radar(), recording.chirps
    points = detect_points(beat, radar, grid, chirps, frame)
    cell = 2 * doppler.velocity_span(radar, chirps) / chirps.count
    origin, own_velocity = radar.positions[frame].detach(), platform_velocities(recording)[frame]
    aways = torch.nn.functional.normalize(points.position.detach().double() - origin, dim=1)
    rates = points.velocity + aways @ own_velocity
    # Clutter removal subtracts the mean only; a direction is known to a fraction of a beam.
    beam = direction_cell(aperture(radar).y, radar)
    moves = rates.abs() > cell + float(own_velocity.norm()) * beam * _DIRECTION_ERROR_BEAMS
    cells = torch.tensor([radar.waveform.range_resolution, cell], dtype=torch.float64)
    scales = cells * _MAX_GROUP_CELLS
    rows = moves.nonzero()[:, 0]
    if not len(rows):
        return []
    places = torch.stack([points.range, rates], dim=1)
    labels = label_groups(places[rows] / scales, 1.0)
    flat = doppler.range_doppler(beat[frame : frame + 1], radar.frames([frame]), grid, chirps)
    # With the mean, the noise of range rates near 0 is removed too.
    noisy = flat[:, doppler.velocity_axis(radar, chirps).abs() > 0.75 * cell]
    # Noise reduction of beams over all channels relative to one channel.
    noise = noise_power(noisy.abs().square(), 1) / len(radar.virtual_positions)
    array, top = aperture(radar), float(points.power[rows].max())
    array_axes = sum(len(places) > 1 for places in (array.y, array.z))
    found: list[tuple[float, DetectedObject]] = []
    for number in range(int(labels.max()) + 1):
        own = rows[labels == number]
        best = own[points.power[own].argmax()]
        power = float(points.power[best])
        # The extent of a group bounds the accuracy of its position.
        weight = points.power[own] / points.power[own].sum()
        spread = (weight @ (places[own] - places[best]).square()).sqrt().tolist()
        position = points.position[best].detach().double()
        across = beam * float((position - origin).norm())
        deviations = {
            "range": max(spread[0], 0.3 * radar.waveform.range_resolution),
            "across": _DIRECTION_ERROR_BEAMS * across,
            "range_rate": max(spread[1], 0.3 * cell),
        }
        # Upcrossings of the level by noise, over directions between the elements' beams too.
        level = min(power / noise, 700.0)
        chance = flat.numel() * (math.pi * level / 3) ** (0.5 * array_axes) * math.exp(-level)
        sure = (1 - chance) * min(1.0, power / (_TARGET_SIDELOBE_LEVEL * top))
        if chance < _FALSE_ALARM and sure > _MIN_EXISTENCE_PROBABILITY:
            velocity = float(rates[best]) * aways[best]
            target = DetectedObject.point("mover", position, deviations, sure, velocity)
            found.append((power, target))
    found.sort(key=lambda one: -one[0])
    return [replace(target, name=f"mover_{k}") for k, (_, target) in enumerate(found, 1)]


def detect_static_points(capture: Capture, grid: Grid) -> list[DetectedObject]:
    """Detect the reflectors in the first frame, the strongest first.

    Args:
        capture: recording with samples.
        grid: bins of range and direction.
    """
    if "beat" not in capture.dataset:
        return []
    radar = capture.radar()
    points = detect_points(capture.beat[:, None], radar, grid, None, 0)
    beam, cell = direction_cell(aperture(radar).y, radar), radar.waveform.range_resolution
    found = []
    for number, k in enumerate(points.power.argsort(descending=True)[:_MAX_POINTS].tolist(), 1):
        position = points.position[k].detach().double()
        across = beam * float((position - radar.positions[0].detach()).norm())
        deviations = {"range": 0.3 * cell, "across": _DIRECTION_ERROR_BEAMS * across}
        found.append(DetectedObject.point(f"point_{number}", position, deviations, 1.0))
    return found


def platform_velocities(recording: ChirpCapture) -> Float64[Tensor, "frame 3"]:
    """Estimate the radar velocity of every frame from the positions before and after [m/s].

    Args:
        recording: without a known frame period, the radar counts as static.
    """
    positions = recording.radar().positions.detach()
    if recording.frame_period is None or len(positions) < 2:
        return torch.zeros_like(positions)
    (along,) = torch.gradient(positions, spacing=recording.frame_period, dim=0)
    return along


def is_dense_track(capture: Capture) -> bool:
    """Return whether frames are dense enough for echoes to add coherently along the track.

    Args:
        capture: the recording.
    """
    radar = capture.radar()
    if len(radar.virtual_positions) > 1 or radar.frame_count < 8:
        return False
    steps = radar.positions.detach().diff(dim=0).norm(dim=1)
    return float(steps.median()) < 0.5 * radar.waveform.wavelength


def coherent_image(
    capture: Capture, positions: Float64[Tensor, "point 3"]
) -> tuple[Float64[Tensor, " point"], Float64[Tensor, " point"]]:
    """Compute the backprojected image along a track, and the coherence over frames.

    Args:
        capture: the recording.
        positions: image points in world axes [point, 3] [m].

    Returns:
        Power with the spreading loss removed, and the coherent fraction of the total power: 1 for a
            single point, about 1 over the number of frames for noise.
    """
    parts = [
        (backproject(capture, part), _single_frame_power(capture, part))
        for part in positions.split(_POINTS_PER_CHUNK)
    ]
    field, power = (torch.cat(column) for column in zip(*parts, strict=True))
    image = field.abs().square().double()
    return image, image / power.clamp_min(1e-300)


def find_image_peak(
    capture: Capture, center: Float64[Tensor, "3"], radius: float
) -> tuple[Float64[Tensor, "3"], float] | None:
    """Find the brightest point of the coherent image in a horizontal disc, and its power.

    Args:
        capture: recording of a radar.
        center: middle of the disc, at the height of the target [m].
        radius: radius of the disc [m].

    Returns:
        None without a coherent echo in the disc, or without a dense track.
    """
    if not is_dense_track(capture):
        return None
    radar = capture.radar()
    waveform, places = radar.waveform, radar.positions.detach()
    length = float(pairwise_distances(places, places).max())
    across = waveform.wavelength * float((places - center).norm(dim=1).max()) / (2 * length)
    step = max(min(waveform.range_resolution, across) / 4, radius / _MAX_STEPS)
    line = torch.arange(-radius, radius + step, step, dtype=torch.float64)
    offsets = torch.nn.functional.pad(torch.cartesian_prod(line, line), (0, 1))
    points = center + offsets[offsets.norm(dim=1) <= radius]
    low, high = radar.range_limits if "beat" in capture.dataset else capture.ranges[[0, -1]]
    ranges = pairwise_distances(points, places) - radar.origins
    points = points[((ranges > low + across) & (ranges < high - across)).all(1)]
    if not len(points):
        return None
    image, coherent = coherent_image(capture, points)
    image = torch.where(coherent > _MIN_COHERENCE, image, 0.0)
    peak = int(image.argmax())
    return (points[peak], float(image[peak])) if image[peak] > 0 else None


def _single_frame_power(capture: Capture, positions: Tensor) -> Tensor:
    total = torch.zeros(len(positions), dtype=torch.float64)
    for frame in range(capture.frame_count):
        total += backproject(capture.frames([frame]), positions).abs().square().double()
    return total / capture.frame_count


def locate_coherent_points(
    capture: Capture, positions: Float64[Tensor, "point 3"], min_separation: float
) -> tuple[list[DetectedObject], Float64[Tensor, " point"]]:
    """Detect points with coherent echoes over many frames, the strongest first; also return the
    image.

    Args:
        capture: recording along a dense track.
        positions: image points in world axes [point, 3] [m].
        min_separation: minimum distance of peaks; a peak closer to a stronger one is its sidelobe
            [m].
    """
    image, agree = coherent_image(capture, positions)
    count = capture.radar().frame_count
    noise = noise_power(image, 1)
    left, found = image.clone(), list[DetectedObject]()
    cell = capture.radar().waveform.range_resolution
    top = float(image.max())
    while True:
        peak = int(left.argmax())
        value = float(left[peak])
        if value < _MIN_RELATIVE_PEAK * top or value < noise * (math.log(len(positions)) + 3):
            break
        near = (positions - positions[peak]).norm(dim=1)
        left[near < min_separation] = 0.0
        blob = (near < min_separation) & (image > 0.5 * value)
        weight = image[blob] / image[blob].sum()
        middle = (weight[:, None] * positions[blob]).sum(0)
        spread = (weight[:, None] * (positions[blob] - middle).square()).sum(0).sqrt()
        chance = len(positions) * math.exp(-min(count * float(agree[peak]), 700.0))
        deviations = dict(zip("xyz", spread.clamp_min(0.3 * cell).tolist(), strict=True))
        sure = max(0.0, 1 - chance) * min(1.0, value / (_NO_SIDELOBE_LEVEL * top))
        finer = find_image_peak(capture, positions[peak].double(), cell)
        place = positions[peak].double() if finer is None else finer[0]
        found.append(DetectedObject.point(f"point_{len(found) + 1}", place, deviations, sure))
    return found, image
