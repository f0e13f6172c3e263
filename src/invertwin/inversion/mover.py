"""The twin of a mover: its echo is found in range, range rate and direction, then fitted there."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import get_args

import torch
from jaxtyping import Float64
from torch import Tensor, nn

from invertwin.capture.chirp_capture import ChirpCapture
from invertwin.channel import Grid, Paths
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.inversion.loss import CorrelationLoss, Scale
from invertwin.inversion.reconstruction import Reconstruction
from invertwin.models import MotionMap
from invertwin.radar.detection import ordered_statistics_cfar, point_cloud
from invertwin.radar.doppler import compensate_tdm, range_doppler, velocity_axis
from invertwin.radar.radar import Radar
from invertwin.radar.spectrum import aperture
from invertwin.scene import RoughDielectric
from invertwin.scene.mesh import Mesh
from invertwin.scene.pose import rigid
from invertwin.scene.scene import Scene

# Cells of a map that an echo and its neighbours fill; and those that the noise is taken from.
_GUARD, _TRAINING = 2, 2
_FALSE_ALARM = 1e-6
_RAYS = 10_000  # of a map that is compared or drawn


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


def of_point(model: MotionMap, radar: Radar, echo: Echo, time: float = 0.0) -> Tensor:
    """What a point at an echo looks like in a map: the bare response of the radar.

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
    place = (origin + (distance + echo.rate * time) * away)[None]
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
        velocity=echo.rate * away[None],
    )
    return model.expected(point, radar)


def strongest_mover(recording: ChirpCapture, model: MotionMap) -> Echo:
    """The strongest detected echo of a recording: CFAR over range rate and range, then its peak.

    Args:
        recording: One frame of chirps.
        model: The map to look in, with all range rates.

    Raises:
        InputError: Nothing stands out of the noise.
    """
    radar, chirps, grid = recording.radar(), model.chirps, model.grid
    bins = model.bins / chirps.count, radar.waveform.range_resolution / grid.range_step
    guard, training = (
        (max(1, round(n * bins[0])), max(1, round(n * bins[1]))) for n in (_GUARD, _TRAINING)
    )
    power = model.observe(recording).detach()
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
    coherence = _coherence(recording, grid, rate, range_)
    return Echo(range_, rate, u, v, points.position[best], coherence)


def _coherence(recording: ChirpCapture, grid: Grid, rate: float, range_: float) -> float:
    """|mean of the channels' phases| against the best plane wave, at the cell nearest a place."""
    radar, chirps = recording.radar(), recording.chirps
    row = int((velocity_axis(radar, chirps) - rate).abs().argmin())
    column = int((grid.ranges - range_).abs().argmin())
    moving = recording.beat - recording.beat.mean(1, keepdim=True)
    slow = range_doppler(moving.to(torch.complex128), radar, grid, chirps)
    channels = compensate_tdm(slow, radar, chirps)[0, row, :, :, column].flatten()
    x, y = radar.virtual_positions[:, 0], radar.virtual_positions[:, 1]
    # Fine enough that the nearest direction costs less than a thousandth.
    cosines = [torch.linspace(-1, 1, 257 if len(p.unique()) > 1 else 1) for p in (x, y)]
    u, v = (torch.zeros(1).double() if len(c) == 1 else c.double() for c in cosines)
    steer = aperture(radar).beams(u, v, x, y)
    return float((steer @ (channels / channels.abs())).abs().max() / len(channels))


class MovingBody(nn.Module):
    """A rigid body in motion: place, size, velocity, turn, and how much of its echo is diffuse.

    Its axes are across the line of sight to the start, up, and along this line. The body moves in
    the plane of the first and the last axis. Its height is fitted if the antennas resolve it.
    Motion across the line of sight and a turn look much alike: hold the turn of a body that does
    not turn. The module puts the body into a scene: where it is in the middle of the frame, and
    with a velocity of each of its vertices.

    Attributes:
        echo: Where it started.
        place: parameter [2], of the body's nearest point from the start, across and along [m].
        height: parameter [], the same, up [m]; fitted if the radar has several rows of antennas.
        velocity: parameter [2], across and along [m/s].
        spin: parameter [], turn about the axis up [rad/s].
        size: parameter [3], logarithms of factors on the object's size across, up and along.
        diffuse: parameter [], logit of the diffuse share of the reflected power.
    """

    def __init__(
        self,
        object: str,
        scene: Scene,
        radar: Radar,
        echo: Echo,
        free: Sequence[str] = ("place", "velocity", "spin", "size", "diffuse"),
    ) -> None:
        """Start at an echo with the object's own size.

        Args:
            object: Name of the object; where the scene has it does not matter.
            scene: With the object.
            radar: In one pose.
            echo: Where to start.
            free: Names of the parameters that are fitted; the height goes with the place.

        Raises:
            InputError: A material without a diffuse share between 0 and 1, or an unknown name.
        """
        super().__init__()
        self.object, self.echo = object, echo
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
        vertices = scene[object].mesh.vertices.detach()
        self._first_extent = vertices.amax(0) - vertices.amin(0)
        zeros = torch.zeros(2, dtype=torch.float64)
        self.place = nn.Parameter(zeros.clone())
        self.height = nn.Parameter(zeros[0].clone())
        self.velocity = nn.Parameter(torch.tensor([0.0, echo.rate], dtype=torch.float64))
        self.spin = nn.Parameter(zeros[0].clone())
        self.size = nn.Parameter(torch.zeros(3, dtype=torch.float64))
        self.diffuse = nn.Parameter(torch.tensor(share, dtype=torch.float64).logit())
        held = dict(self.named_parameters())
        rows = len(radar.virtual_positions[:, 1].unique())
        if set(free) - (set(held) - {"height"}):
            raise InputError(
                f"expected names among {', '.join(n for n in held if n != 'height')}, got "
                f"{', '.join(free)}; name what is fitted"
            )
        for name, parameter in held.items():
            of = "place" if name == "height" else name
            parameter.requires_grad_(of in free and (name != "height" or rows > 1))

    def forward(self, scene: Scene, time: float = 0.0) -> Scene:
        """The scene with the body in motion, where it is at a time.

        Args:
            scene: With the object.
            time: After the middle of the frame [s].
        """
        item = scene[self.object]
        mesh = Mesh((item.mesh.vertices - item.mesh.center) * self.size.exp(), item.mesh.faces)
        center = self._center(time)
        placed = scene.replace(
            self.object,
            mesh=mesh,
            pose=rigid(self._axes, center),
            material=replace(_rough(scene, self.object), diffuse=self.diffuse.sigmoid()),
        )
        lever = placed[self.object].vertices - center
        turn = torch.linalg.cross((self.spin * self._axes[:, 1]).expand_as(lever), lever)
        return placed.replace(self.object, velocity=self._axes @ self._translation + turn)

    def values(self) -> dict[str, Tensor]:
        """What was found, by name, in SI units; velocity and position in the world."""
        with torch.no_grad():
            return {
                "position_m": self._center(),
                "velocity_m_s": self._axes @ self._translation,
                "spin_rad_s": self.spin.clone(),
                "extent_m": self._extent,
                "diffuse": self.diffuse.sigmoid(),
            }

    def _center(self, time: float = 0.0) -> Float64[Tensor, "3"]:
        depth = 0.5 * self._extent[2]
        offset = torch.stack([self.place[0], self.height, self.place[1] + depth])
        return self._start + self._axes @ (offset + self._translation * time)

    @property
    def _translation(self) -> Tensor:
        return torch.stack([self.velocity[0], torch.zeros_like(self.spin), self.velocity[1]])

    @property
    def _extent(self) -> Tensor:
        """Full size across, up and along [m]."""
        return self._first_extent * self.size.exp()


@dataclass(frozen=True, eq=False)
class MoverMaps:
    """Maps about an echo that moves: of its twin, and of a bare point in its place.

    Attributes:
        model: What the maps show.
        twin: Power [velocity, range, u, v].
        point: The same of the point.
    """

    model: MotionMap
    twin: Tensor
    point: Tensor

    def correlations(self, recording: ChirpCapture) -> dict[str, dict[str, float]]:
        """Correlations of ``twin`` and ``bare_psf`` with a frame of chirps, by scale."""
        seen = self.model.observe(recording)[0]
        found = {}
        for scale in get_args(Scale):
            loss = CorrelationLoss(scale)
            pair = ("twin", self.twin), ("bare_psf", self.point)
            found[scale] = {name: 1 - float(loss(power, seen)) for name, power in pair}
        return found


@dataclass(frozen=True, eq=False)
class MoverTwin:
    """A body that was fitted to the strongest mover of a recording.

    Attributes:
        recording: One frame of chirps.
        model: Map of the whole recording.
        body: As fitted.
        outcome: Of the fit.
    """

    recording: ChirpCapture
    model: MotionMap
    body: MovingBody
    outcome: Reconstruction

    def maps(self, scene: Scene, cells: int, *, time: float = 0.0, seed: int = 0) -> MoverMaps:
        """Maps about the place that the echo has moved to.

        Args:
            scene: With the body's object.
            cells: To either side of the echo.
            time: After the middle of the recording [s].
            seed: Of the rays.
        """
        radar, echo = self.recording.radar(), self.body.echo
        near = self.model.around(echo.range + echo.rate * time, echo.rate, cells, radar)
        with torch.no_grad():
            twin = near.sampled_by(samples=_RAYS).predict(self.body(scene, time), radar, seed)[0]
        return MoverMaps(near, twin, of_point(near, radar, echo, time)[0])


def _rough(scene: Scene, name: str) -> RoughDielectric:
    material = scene[name].material
    if isinstance(material, RoughDielectric):
        return material
    raise InputError(
        f"expected a rough_dielectric for {name}, got {type(material).__name__}; its echo has the "
        "diffuse and the glossy part that the fit weighs"
    )
