"""The twin of a mover: its echo is found in range, range rate and direction, then fitted there."""

from dataclasses import dataclass
from typing import get_args

import torch
from torch import Tensor

from invertwin.capture.chirp_capture import ChirpCapture
from invertwin.channel import Grid, Paths
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.discovery.moving_body import DetectedEcho, MovingBody
from invertwin.errors import InputError
from invertwin.inversion.loss import CorrelationLoss, CorrelationScale
from invertwin.inversion.reconstruction import Reconstruction
from invertwin.models.doppler import RangeDopplerMap
from invertwin.radar.aperture import aperture
from invertwin.radar.processing.detection import ordered_statistics_cfar, point_cloud
from invertwin.radar.processing.doppler import (
    compensate_tdm,
    interpolate_rates,
    range_doppler,
    velocity_axis,
)
from invertwin.radar.radar import Radar
from invertwin.scene.scene import Scene

# Cells of a map that an echo and its neighbours fill; and those that the noise is taken from.
_GUARD_CELLS, _TRAINING_CELLS = 2, 2
_FALSE_ALARM_RATE = 1e-6
_RAY_COUNT = 10_000  # of a map that is compared or drawn


def point_response(
    model: RangeDopplerMap, radar: Radar, echo: DetectedEcho, time: float = 0.0
) -> Tensor:
    """Return the map of a point at an echo: the bare response of the radar.

    Args:
        model: The map.
        radar: In one pose.
        echo: Where, and how fast.
        time: After which it is seen, moving on along its line of sight [s].

    Returns:
        Power [frame, velocity, range, u, v].
    """
    link = radar.link()
    origin = 0.5 * (link.tx + link.rx)[0]
    distance = (echo.position - origin).norm()
    away = (echo.position - origin) / distance
    place = (origin + (distance + echo.range_rate * time) * away)[None]
    length = (place - link.tx).norm(dim=1) + (place - link.rx).norm(dim=1)
    point = Paths(
        frame=torch.zeros(1, dtype=torch.int64),
        delay=length / SPEED_OF_LIGHT,
        coefficient=torch.zeros(1, dtype=torch.complex128),
        power=torch.ones(1, dtype=torch.float64),
        first=place,
        last=place,
        kind="power",
        boundary=torch.zeros(1, dtype=torch.bool),
        velocity=echo.range_rate * away[None],
    )
    return model.predict_paths(point, radar)


def detect_strongest_target(
    recording: ChirpCapture, model: RangeDopplerMap, box: tuple[Tensor, Tensor] | None = None
) -> DetectedEcho:
    """The strongest detected echo of a recording: CFAR over range rate and range, then its peak.

    Args:
        recording: One frame of chirps.
        model: The map to look in, with all range rates.
        box: Two corners of the box of the world that is searched [m]; None = all of the map.

    Raises:
        InputError: Nothing stands out of the noise.
    """
    radar, chirps, grid = recording.radar(), model.chirps, model.grid
    bins = model.bins / chirps.count, radar.waveform.range_resolution / grid.range_step
    guard, training = (
        (max(1, round(n * bins[0])), max(1, round(n * bins[1])))
        for n in (_GUARD_CELLS, _TRAINING_CELLS)
    )
    power = model.observe(recording).detach()
    seen = ordered_statistics_cfar(
        power.amax((-2, -1)), guard=guard, training=training, false_alarm=_FALSE_ALARM_RATE
    )
    points = point_cloud(power, seen, radar, grid, chirps)
    strength = points.power
    if box is not None:
        outside = (points.position < box[0]) | (points.position > box[1])
        strength = strength.masked_fill(outside.any(1), 0.0)
    if not bool((strength > 0).any()):
        raise InputError(
            "expected something that moves, got no echo above the noise; widen the grid, or "
            "record again"
        )
    best = int(strength.argmax())
    range_, rate, u, v = (
        float(x[best]) for x in (points.range, points.velocity, points.u, points.v)
    )
    coherence = _channel_coherence(recording, grid, rate, range_)
    return DetectedEcho(range_, rate, u, v, points.position[best], coherence)


def _channel_coherence(
    recording: ChirpCapture, grid: Grid, range_rate: float, range_: float
) -> float:
    """|mean of the channels' phases| against the best plane wave, at the cell nearest a place."""
    radar, chirps = recording.radar(), recording.chirps
    row = int((velocity_axis(radar, chirps) - range_rate).abs().argmin())
    column = int((grid.ranges - range_).abs().argmin())
    moving = recording.beat - recording.beat.mean(1, keepdim=True)
    slow = range_doppler(moving.to(torch.complex128), radar, grid, chirps)
    rates = interpolate_rates(slow.abs().square().mean((2, 3))[0])
    channels = compensate_tdm(slow, radar, chirps, rates)[0, row, :, :, column].flatten()
    y, z = radar.virtual_positions[:, 1], radar.virtual_positions[:, 2]
    # Fine enough that the nearest direction costs less than a thousandth.
    cosines = [torch.linspace(-1, 1, 257 if len(p.unique()) > 1 else 1) for p in (y, z)]
    u, v = (torch.zeros(1).double() if len(c) == 1 else c.double() for c in cosines)
    steer = aperture(radar).beams(u, v, y, z)
    return float((steer @ (channels / channels.abs())).abs().max() / len(channels))


@dataclass(frozen=True, eq=False)
class MovingTargetMaps:
    """Maps about an echo that moves: of its twin, and of a bare point in its place.

    Attributes:
        model: What the maps show.
        twin_map: Power [velocity, range, u, v].
        point_map: The same of the point.
    """

    model: RangeDopplerMap
    twin_map: Tensor
    point_map: Tensor

    def correlations(self, recording: ChirpCapture) -> dict[str, dict[str, float]]:
        """Correlations of ``twin`` and ``bare_psf`` with a frame of chirps, by scale."""
        seen = self.model.observe(recording)[0]
        found = {}
        for scale in get_args(CorrelationScale):
            loss = CorrelationLoss(scale)
            pair = ("twin", self.twin_map), ("bare_psf", self.point_map)
            found[scale] = {name: 1 - float(loss(power, seen)) for name, power in pair}
        return found


@dataclass(frozen=True, eq=False)
class MovingTargetFit:
    """A body that was fitted to the strongest mover of a recording.

    Attributes:
        recording: One frame of chirps.
        model: Map of the whole recording.
        body: As fitted.
        reconstruction: Of the fit.
    """

    recording: ChirpCapture
    model: RangeDopplerMap
    body: MovingBody
    reconstruction: Reconstruction

    def predict_maps(
        self, scene: Scene, cells: int, *, time: float = 0.0, seed: int = 0
    ) -> MovingTargetMaps:
        """Maps about the place that the echo has moved to.

        Args:
            scene: With the body's object.
            cells: To either side of the echo.
            time: After the middle of the recording [s].
            seed: Of the rays.
        """
        radar, echo = self.recording.radar(), self.body.echo
        range_ = echo.range + echo.range_rate * time
        near = self.model.crop_around(range_, echo.range_rate, cells, radar)
        with torch.no_grad():
            model = near.with_sampling(samples=_RAY_COUNT)
            twin = model.predict(self.body(scene, time), radar, seed)[0]
        return MovingTargetMaps(near, twin, point_response(near, radar, echo, time)[0])
