"""The twin of something that moves: found in range, range rate and direction, then fitted there."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Complex, Float, Float64
from torch import Tensor, nn

from invertwin.channel import Grid, Paths, Sampling, trace_power
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.inversion.reconstruction import Optimizer
from invertwin.radar.detection import ordered_statistics_cfar, point_cloud
from invertwin.radar.doppler import (
    compensate_tdm,
    range_doppler,
    range_doppler_angle,
    velocity_axis,
    velocity_span,
)
from invertwin.radar.motion import Chirps
from invertwin.radar.moving_power import moving_power
from invertwin.radar.radar import Radar
from invertwin.scene.material import RoughDielectric
from invertwin.scene.mesh import Mesh
from invertwin.scene.pose import rigid
from invertwin.scene.scene import Scene

# Cells of a map that an echo and its neighbours fill; and those that the noise is taken from.
_GUARD, _TRAINING = 2, 2
_FALSE_ALARM = 1e-6
_FLOOR = 1e-4  # of the peak: below it levels are noise
_TINY = 1e-12  # of the peak: keeps the derivative of a magnitude finite


@dataclass(frozen=True, eq=False)
class Echo:
    """A detected echo, its place refined between the bins.

    Attributes:
        range: [m].
        rate: Range rate, positive moves away [m/s].
        u, v: Direction cosines.
        position: In the world [m].
        coherence: 1 where the channels are a plane wave.
    """

    range: float
    rate: float
    u: float
    v: float
    position: Float64[Tensor, "3"]
    coherence: float


@dataclass(frozen=True, eq=False)
class MotionMap:
    """Power of one frame of chirps over range rate, range and direction.

    Attributes:
        power: As recorded; what stands still has been taken out, as the mean over the chirps.
        rates: Range rates of the bins [m/s].
        grid: Ranges and directions.
        radar: What recorded it, in one pose.
        chirps: Timing.
    """

    power: Float[Tensor, "velocity range u v"]
    rates: Float64[Tensor, " velocity"]
    grid: Grid
    radar: Radar
    chirps: Chirps

    def around(self, echo: Echo, cells: int, time: float = 0.0) -> "MotionMap":
        """The cells at most so many range and Doppler cells from an echo, all directions.

        Args:
            echo: Where, and how fast.
            cells: To either side.
            time: After which it is there, moving on along its line of sight [s].
        """
        doppler = velocity_span(self.radar, self.chirps) / self.chirps.count
        place = echo.range + echo.rate * time
        near = (self.grid.ranges - place).abs() / self.radar.waveform.range_resolution
        slow = (self.rates - echo.rate).abs() / doppler
        ranges, rates = (torch.nonzero(d <= cells)[:, 0] for d in (near, slow))
        grid = replace(
            self.grid,
            range_start=float(self.grid.ranges[ranges[0]]),
            range_count=len(ranges),
        )
        return replace(self, power=self.power[rates][:, ranges], rates=self.rates[rates], grid=grid)

    def expected(
        self, paths: Paths, velocities: Float64[Tensor, "path 3"]
    ) -> Float64[Tensor, "velocity range u v"]:
        """What moving paths would look like in this map (see ``moving_power``)."""
        args = (self.radar, self.grid, self.chirps, self.rates)
        return moving_power(paths, velocities, *args)[0]

    def of_point(self, echo: Echo, time: float = 0.0) -> Float64[Tensor, "velocity range u v"]:
        """What a point at an echo would look like: the bare response of the radar.

        Args:
            echo: Where, and how fast.
            time: After which it is seen, moving on along its line of sight [s].
        """
        link = self.radar.link()
        origin = 0.5 * (link.tx + link.rx)[0]
        away = (echo.position - origin) / (echo.position - origin).norm()
        place = (origin + (echo.range + echo.rate * time) * away)[None]
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
        )
        return self.expected(point, echo.rate * away[None])


def motion_map(
    beat: Complex[Tensor, "chirp tx rx sample"],
    radar: Radar,
    grid: Grid,
    chirps: Chirps,
    oversample: int = 2,
) -> MotionMap:
    """The map of a frame of chirps without what stands still.

    Args:
        beat: Chirps of every transmitter.
        radar: With the pose of the frame.
        grid: Ranges and directions.
        chirps: Timing.
        oversample: Bins of range rate per cell.

    Raises:
        InputError: As ``range_doppler_angle``.
    """
    moving = _moving(beat)
    bins = oversample * chirps.count
    power = range_doppler_angle(moving, radar, grid, chirps, bins=bins)[0]
    return MotionMap(power, velocity_axis(radar, chirps, bins), grid, radar, chirps)


def strongest_mover(beat: Complex[Tensor, "chirp tx rx sample"], found: MotionMap) -> Echo:
    """The strongest detected echo of a map: CFAR over range rate and range, then its peak.

    Args:
        beat: The chirps that the map is of, for the coherence of the channels.
        found: The map, whole.

    Raises:
        InputError: Nothing stands out of the noise.
    """
    radar, chirps, grid = found.radar, found.chirps, found.grid
    bins = len(found.rates) / chirps.count, radar.waveform.range_resolution / grid.range_step
    guard, training = (
        (max(1, round(n * bins[0])), max(1, round(n * bins[1]))) for n in (_GUARD, _TRAINING)
    )
    power = found.power[None].detach()
    seen = ordered_statistics_cfar(
        power.amax((-2, -1)), guard=guard, training=training, false_alarm=_FALSE_ALARM
    )
    points = point_cloud(power, seen, radar, grid, chirps)
    if not len(points.power):
        raise InputError(
            "expected something that moves, got no echo above the noise; widen the grid, or "
            "record again"
        )
    best = int(points.power.argmax())
    range_, rate, u, v = (
        float(x[best]) for x in (points.range, points.velocity, points.u, points.v)
    )
    coherence = _coherence(beat, found, rate, range_)
    return Echo(range_, rate, u, v, points.position[best], coherence)


def _coherence(beat: Tensor, found: MotionMap, rate: float, range_: float) -> float:
    """|mean of the channels' phases| against the best plane wave, at the cell nearest a place."""
    radar, chirps, grid = found.radar, found.chirps, found.grid
    row = int((velocity_axis(radar, chirps) - rate).abs().argmin())
    column = int((grid.ranges - range_).abs().argmin())
    spectrum = compensate_tdm(range_doppler(_moving(beat), radar, grid, chirps), radar, chirps)
    channels = spectrum[0, row, :, :, column].flatten()
    x, y = radar.virtual_positions[:, 0], radar.virtual_positions[:, 1]
    # Fine enough that the nearest direction costs less than a thousandth.
    cosines = [torch.linspace(-1, 1, 257 if len(p.unique()) > 1 else 1) for p in (x, y)]
    u, v = (torch.zeros(1) if len(c) == 1 else c for c in cosines)
    beams = u[:, None, None].double() * x + v[:, None].double() * y
    steer = torch.polar(torch.ones_like(beams), 2 * math.pi / radar.waveform.wavelength * beams)
    return float((steer @ (channels / channels.abs())).abs().max() / len(channels))


def _moving(beat: Tensor) -> Tensor:
    return (beat - beat.mean(0, keepdim=True)).to(torch.complex128)[None]


def pattern_correlation(
    simulated: Float[Tensor, "*map"], recorded: Float[Tensor, "*map"], scale: str = "magnitude"
) -> Float64[Tensor, ""]:
    """Pearson's correlation of two power maps; no gain or offset changes it.

    Args:
        simulated: Power.
        recorded: Power.
        scale: Of ``magnitude`` (square root of power), ``power``, or ``level`` (dB, no lower than
            40 dB below the map's own peak).

    Raises:
        InputError: Maps of different shapes, or an unknown scale.
    """
    scales: dict[str, Callable[[Tensor], Tensor]] = {
        "magnitude": lambda share: (share + _TINY).sqrt(),
        "power": lambda share: share,
        "level": lambda share: share.clamp(min=_FLOOR).log(),
    }
    if scale not in scales or simulated.shape != recorded.shape:
        raise InputError(
            f"expected maps of one shape and a scale of {', '.join(scales)}, got "
            f"{tuple(simulated.shape)}, {tuple(recorded.shape)} and {scale!r}"
        )
    rows = []
    for power in (simulated, recorded):
        row = scales[scale](power.to(torch.float64) / power.detach().max()).flatten()
        row = row - row.mean()
        rows.append(row / row.norm())
    return rows[0] @ rows[1]


class MovingBody(nn.Module):
    """A rigid body in motion: place, size, velocity and turn, in the plane that a row of antennas
    sees, and how much of its echo is diffuse.

    Its axes are across the line of sight to the start, up, and along that line. It moves at the
    height of the start. Maps a scene to the scene with the body where it is in the middle of the
    frame.

    Attributes:
        place: parameter [2], of the body's nearest point from the start, across and along [m].
        velocity: parameter [2], across and along [m/s].
        spin: parameter [], turn about the axis up [rad/s].
        size: parameter [3], logarithms of factors on the object's size across, up and along.
        diffuse: parameter [], logit of the diffuse share of the reflected power.
    """

    def __init__(self, object: str, scene: Scene, radar: Radar, echo: Echo) -> None:
        """Start at an echo with the object's own size.

        Args:
            object: Name of the object; where the scene has it does not matter.
            scene: With the object.
            radar: In one pose.
            echo: Where to start.

        Raises:
            InputError: A material without a diffuse share between 0 and 1.
        """
        super().__init__()
        self.object = object
        material = _rough(scene, object)
        share = material.diffuse
        if not isinstance(share, float | int) or not 0 < share < 1:
            raise InputError(
                f"expected a number between 0 and 1 as the diffuse share of {object}, got {share}; "
                "0.5 is a start"
            )
        link = radar.link()
        along = echo.position - 0.5 * (link.tx + link.rx)[0]
        along = along / along.norm()
        across = torch.linalg.cross(link.rotations[0, :, 1], along)
        across = across / across.norm()
        self._axes = torch.stack([across, torch.linalg.cross(along, across), along], dim=1)
        self._start = echo.position
        zeros = torch.zeros(2, dtype=torch.float64)
        self.place = nn.Parameter(zeros.clone())
        self.velocity = nn.Parameter(torch.tensor([0.0, echo.rate], dtype=torch.float64))
        self.spin = nn.Parameter(zeros[0].clone())
        self.size = nn.Parameter(torch.zeros(3, dtype=torch.float64))
        self.diffuse = nn.Parameter(torch.tensor(share, dtype=torch.float64).logit())

    def forward(self, scene: Scene, time: float = 0.0) -> Scene:
        """The scene with the body at rest where it is at a time after the middle of the frame."""
        item = scene[self.object]
        vertices = (item.mesh.vertices - item.mesh.center) * self.size.exp()
        center = self.center(scene, time)
        return scene.replace(
            self.object,
            mesh=Mesh(vertices, item.mesh.faces),
            pose=rigid(self._axes, center),
            material=replace(_rough(scene, self.object), diffuse=self.diffuse.sigmoid()),
            velocity=None,
        )

    def moving(self, scene: Scene) -> Scene:
        """The twin: the scene with the body and the velocity of each of its vertices, detached."""
        with torch.no_grad():
            placed = self(scene)
            velocity = self.velocity_at(placed[self.object].vertices, scene)
            material = replace(_rough(scene, self.object), diffuse=self.diffuse.sigmoid().item())
            return placed.replace(self.object, material=material, velocity=velocity)

    def center(self, scene: Scene, time: float = 0.0) -> Float64[Tensor, "3"]:
        """Of the body, in the world [m]."""
        depth = 0.5 * self._extent(scene)[2]
        offset = torch.stack([self.place[0], torch.zeros_like(depth), self.place[1] + depth])
        return self._start + self._axes @ (offset + self._translation * time)

    def velocity_at(
        self, points: Float64[Tensor, "point 3"], scene: Scene, time: float = 0.0
    ) -> Float64[Tensor, "point 3"]:
        """World velocity of points of the body [m/s]."""
        lever = points - self.center(scene, time)
        turn = torch.linalg.cross((self.spin * self._axes[:, 1]).expand_as(lever), lever)
        return self._axes @ self._translation + turn

    def values(self, scene: Scene) -> dict[str, Any]:
        """What was found, by name, in SI units; velocity and position in the world."""
        with torch.no_grad():
            return {
                "position_m": self.center(scene).tolist(),
                "velocity_m_s": (self._axes @ self._translation).tolist(),
                "spin_rad_s": float(self.spin.detach()),
                "extent_m": self._extent(scene).tolist(),
                "diffuse": self.diffuse.sigmoid().item(),
            }

    @property
    def _translation(self) -> Tensor:
        return torch.stack([self.velocity[0], torch.zeros_like(self.spin), self.velocity[1]])

    def _extent(self, scene: Scene) -> Tensor:
        """Full size across, up and along [m]."""
        vertices = scene[self.object].mesh.vertices
        return (vertices.amax(0) - vertices.amin(0)) * self.size.exp()


def _rough(scene: Scene, name: str) -> RoughDielectric:
    material = scene[name].material
    if isinstance(material, RoughDielectric):
        return material
    raise InputError(
        f"expected a rough_dielectric for {name}, got {type(material).__name__}; its echo has the "
        "diffuse and the glossy part that the fit weighs"
    )


def body_power(
    body: MovingBody,
    scene: Scene,
    found: MotionMap,
    *,
    samples: int,
    seed: int,
    time: float = 0.0,
) -> Float64[Tensor, "velocity range u v"]:
    """What the body would look like in a map: traced, set in motion, shaped by the radar.

    Its silhouette has no boundary term: a rough convex body goes dark towards its edge.

    Args:
        body: The body.
        scene: All there is; only the body moves, and only what moves is in a map.
        found: The map.
        samples: Rays.
        seed: Same seed, same map.
        time: After the middle of the frame that the body was fitted to [s].
    """
    alone = Scene({body.object: body(scene, time)[body.object]})
    paths = trace_power(
        alone,
        found.radar.link(),
        sampling=Sampling(depth=1, samples=samples, boundary=False),
        seed=seed,
    )
    return found.expected(paths, body.velocity_at(paths.first, scene, time))


def fit_mover(
    body: MovingBody,
    scene: Scene,
    found: MotionMap,
    *,
    steps: int,
    samples: int,
    seed: int,
    optimizer: Optimizer,
    progress: Callable[[dict[str, Any]], None] | None = None,
) -> list[float]:
    """Fit a body to the map about an echo: 1 − correlation of the magnitudes, step by step.

    Args:
        body: Starting values; fitted in place.
        scene: With the object.
        found: Cells that are compared, as of ``MotionMap.around``.
        steps: Steps.
        samples: Rays a step.
        seed: Of the rays; every step draws new ones.
        optimizer: Adam or SGD, and its rate.
        progress: Called with ``step``, ``loss`` and ``values`` after every step.

    Returns:
        The loss of every step.

    Raises:
        InputError: A loss that is not finite: the body has left what the radar sees.
    """
    stepper = optimizer.build(nn.ModuleList([body]))
    assert isinstance(stepper, torch.optim.Optimizer)  # Gauss–Newton is refused without its loss
    losses: list[float] = []
    for step in range(steps):
        optimizer.apply(stepper, step / steps)
        stepper.zero_grad()
        power = body_power(body, scene, found, samples=samples, seed=seed + step)
        loss = 1 - pattern_correlation(power, found.power)
        losses.append(float(loss.detach()))
        if not math.isfinite(losses[-1]):
            raise InputError(
                f"expected a body within the radar's view, got a loss of {losses[-1]} at step "
                f"{step}; lower the rate"
            )
        loss.backward()
        stepper.step()
        if progress is not None:
            progress({"step": step, "loss": losses[-1], "values": body.values(scene)})
    return losses
