"""Detection and fit of a moving target in range, range rate and direction.

The unknowns are those of a rigid body that moves along a straight line.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import get_args

import torch
from jaxtyping import Float64
from torch import Tensor, nn

from invertwin.capture.chirp_capture import ChirpCapture
from invertwin.channel import Grid, Paths
from invertwin.checks import check_choice
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.inversion.loss import CorrelationLoss, CorrelationScale
from invertwin.inversion.reconstruction import Reconstruction
from invertwin.models.doppler import RangeDopplerMap
from invertwin.radar import Radar, ordered_statistics_cfar, point_cloud
from invertwin.radar.aperture import aperture
from invertwin.radar.processing import doppler
from invertwin.scene import Mesh, RoughDielectric, Scene, rigid


@dataclass(frozen=True, eq=False)
class DetectedEcho:
    """Detected echo with a position refined between bins.

    Attributes:
        range: Range [m].
        range_rate: Range rate, positive away from the radar [m/s].
        u, v: Direction cosines.
        position: Position in the world [m].
        coherence: Phase coherence of the channels, 1 for a plane wave.
    """

    range: float
    range_rate: float
    u: float
    v: float
    position: Float64[Tensor, "3"]
    coherence: float


class MovingBody(nn.Module):
    """Moving rigid body: position, size, velocity, rotation, and diffuse share of its echo.

    Its axes are along the line of sight to the start, across this line, and up. The body moves in
    the plane of the first two axes. Its height is fitted if the antennas resolve it. Cross-range
    motion and rotation have similar echoes: fix the rotation of a body that does not rotate. The
    module places the body in a scene, at its position in the middle of the frame and with a
    velocity of each of its vertices.

    Attributes:
        echo: Echo at which the fit starts.
        place: parameter [2], displacement of the body's nearest point from the start, along and
            across the line of sight [m].
        height: parameter [], vertical displacement [m]; fitted if the radar has several rows of
            antennas.
        velocity: parameter [2], along and across the line of sight [m/s].
        spin: parameter [], rotation rate about the vertical axis [rad/s].
        size: parameter [3], logarithms of factors on the object's size along, across and up.
        diffuse: parameter [], logit of the diffuse share of the reflected power.
    """

    def __init__(
        self,
        object: str,
        scene: Scene,
        radar: Radar,
        echo: DetectedEcho,
        free: Sequence[str] = ("place", "velocity", "spin", "size", "diffuse"),
        center: Float64[Tensor, "3"] | None = None,
    ) -> None:
        """Start at an echo with the object's own size.

        Args:
            object: Name of the object; where the scene has it does not matter.
            scene: Scene with the object.
            radar: Radar with one pose.
            echo: Echo from which to start.
            free: Names of the parameters that are fitted; the height goes with the place.
            center: Initial centre [3] in the world [m]; None = the front is at the echo.

        Raises:
            InputError: A material without a diffuse share between 0 and 1, or an unknown name.
        """
        super().__init__()
        self.object, self.echo = object, echo
        share = _require_rough_dielectric(scene, object).diffuse
        if not isinstance(share, float | int) or not 0 < share < 1:
            problem = f"expected a diffuse share between 0 and 1 of {object}"
            raise InputError(f"{problem}, got {share}; 0.5 is a start")
        link = radar.link()
        along = echo.position - 0.5 * (link.tx + link.rx)[0]
        along = along / along.norm()
        across = torch.linalg.cross(link.rotations[0, :, 2], along)
        across = across / across.norm()
        self._axes = torch.stack([along, across, torch.linalg.cross(along, across)], dim=1)
        self._start = echo.position
        vertices = scene[object].mesh.vertices.detach()
        self._first_extent = vertices.amax(0) - vertices.amin(0)
        zeros = torch.zeros(2, dtype=torch.float64)
        self.place = nn.Parameter(zeros.clone())
        self.height = nn.Parameter(zeros[0].clone())
        self.velocity = nn.Parameter(torch.tensor([echo.range_rate, 0.0], dtype=torch.float64))
        self.spin = nn.Parameter(zeros[0].clone())
        self.size = nn.Parameter(torch.zeros(3, dtype=torch.float64))
        self.diffuse = nn.Parameter(torch.tensor(share, dtype=torch.float64).logit())
        if center is not None:
            offset = (center - self._center_at()).detach() @ self._axes
            self.place.data.copy_(offset[:2])
            self.height.data.copy_(offset[2])
        held = dict(self.named_parameters())
        rows = len(radar.virtual_positions[:, 2].unique())
        for name in free:
            check_choice(name, set(held) - {"height"}, "names among", "name what is fitted")
        for name, parameter in held.items():
            of = "place" if name == "height" else name
            parameter.requires_grad_(of in free and (name != "height" or rows > 1))

    def forward(self, scene: Scene, time: float = 0.0) -> Scene:
        """Return the scene with the moving body at its position at a time.

        Args:
            scene: Scene with the object.
            time: Time after the middle of the frame [s].
        """
        item = scene[self.object]
        mesh = Mesh((item.mesh.vertices - item.mesh.center) * self.size.exp(), item.mesh.faces)
        center = self._center_at(time)
        material = _require_rough_dielectric(scene, self.object)
        material = replace(material, diffuse=self.diffuse.sigmoid())
        pose = rigid(self._axes, center)
        placed = scene.replace(self.object, mesh=mesh, pose=pose, material=material)
        lever = placed[self.object].vertices - center
        turn = torch.linalg.cross((self.spin * self._axes[:, 2]).expand_as(lever), lever)
        return placed.replace(self.object, velocity=self._axes @ self._velocity_vector + turn)

    def values(self) -> dict[str, Tensor]:
        """Return the fitted values by name, in SI units; velocity and position in the world."""
        with torch.no_grad():
            return {
                "position_m": self._center_at(),
                "velocity_m_s": self._axes @ self._velocity_vector,
                "spin_rad_s": self.spin.clone(),
                "extent_m": self._extent,
                "diffuse": self.diffuse.sigmoid(),
            }

    def _center_at(self, time: float = 0.0) -> Float64[Tensor, "3"]:
        offset = torch.stack([self.place[0] + 0.5 * self._extent[0], self.place[1], self.height])
        return self._start + self._axes @ (offset + self._velocity_vector * time)

    @property
    def _velocity_vector(self) -> Tensor:
        return torch.stack([*self.velocity, torch.zeros_like(self.spin)])

    @property
    def _extent(self) -> Tensor:
        """Full size along, across and up [m]."""
        return self._first_extent * self.size.exp()


def _require_rough_dielectric(scene: Scene, name: str) -> RoughDielectric:
    material = scene[name].material
    if isinstance(material, RoughDielectric):
        return material
    problem = f"expected a rough_dielectric for {name}, got {type(material).__name__}"
    raise InputError(f"{problem}; its echo has the diffuse and the glossy part that the fit weighs")


# Cells of a map that an echo and its neighbours fill, and as many that the noise is taken from.
_CFAR_CELLS = 2
_FALSE_ALARM_RATE = 1e-6
_RAY_COUNT = 10_000  # of a map that is compared or drawn


def point_response(
    model: RangeDopplerMap, radar: Radar, echo: DetectedEcho, time: float = 0.0
) -> Tensor:
    """Return the map of a point target at an echo, that is, the point response of the radar.

    Args:
        model: The map.
        radar: Radar with one pose.
        echo: Position and velocity of the echo.
        time: Time after which the target is observed, moving along its line of sight [s].

    Returns:
        Power [frame, velocity, range, u, v].
    """
    link = radar.link()
    origin = 0.5 * (link.tx + link.rx)[0]
    distance = (echo.position - origin).norm()
    away = (echo.position - origin) / distance
    place = (origin + (distance + echo.range_rate * time) * away)[None]
    length = (place - link.tx).norm(dim=1) + (place - link.rx).norm(dim=1)
    zero, one, velocity = torch.zeros(1), torch.ones_like(length), echo.range_rate * away[None]
    columns = zero.long(), length / SPEED_OF_LIGHT, zero.cdouble(), one, place, place
    return model.predict_paths(Paths(*columns, "power", zero.bool(), velocity), radar)


def detect_strongest_target(
    recording: ChirpCapture, model: RangeDopplerMap, box: tuple[Tensor, Tensor] | None = None
) -> DetectedEcho:
    """Detect the strongest moving echo of a recording by CFAR over range rate and range.

    Args:
        recording: One frame of chirps.
        model: Map that is searched, with all range rates.
        box: Two corners of the searched box in world axes [m]; None = the whole map.

    Raises:
        InputError: No echo above the noise.
    """
    radar, chirps, grid = recording.radar(), model.chirps, model.grid
    bins = model.bins / chirps.count, radar.waveform.range_resolution / grid.range_step
    near = max(1, round(_CFAR_CELLS * bins[0])), max(1, round(_CFAR_CELLS * bins[1]))
    power = model.observe(recording).detach()
    cells = power.amax((-2, -1))
    seen = ordered_statistics_cfar(cells, guard=near, training=near, false_alarm=_FALSE_ALARM_RATE)
    points = point_cloud(power, seen, radar, grid, chirps)
    strength = points.power
    if box is not None:
        outside = (points.position < box[0]) | (points.position > box[1])
        strength = strength.masked_fill(outside.any(1), 0.0)
    if not bool((strength > 0).any()):
        raise InputError("expected a moving target, got no echo above the noise; widen the grid")
    best = int(strength.argmax())
    columns = points.range, points.velocity, points.u, points.v
    range_, rate, u, v = (float(column[best]) for column in columns)
    coherence = _channel_coherence(recording, grid, rate, range_)
    return DetectedEcho(range_, rate, u, v, points.position[best], coherence)


def _channel_coherence(
    recording: ChirpCapture, grid: Grid, range_rate: float, range_: float
) -> float:
    """|mean of the channels' phases| against the best plane wave, at the cell nearest a place."""
    radar, chirps = recording.radar(), recording.chirps
    row = int((doppler.velocity_axis(radar, chirps) - range_rate).abs().argmin())
    column = int((grid.ranges - range_).abs().argmin())
    moving = recording.beat - recording.beat.mean(1, keepdim=True)
    slow = doppler.range_doppler(moving.to(torch.complex128), radar, grid, chirps)
    rates = doppler.interpolate_rates(slow.abs().square().mean((2, 3))[0])
    channels = doppler.compensate_tdm(slow, radar, chirps, rates)[0, row, :, :, column].flatten()
    y, z = radar.virtual_positions[:, 1], radar.virtual_positions[:, 2]
    # Fine enough that the nearest direction costs less than a thousandth.
    cosines = [torch.linspace(-1, 1, 257 if len(p.unique()) > 1 else 1) for p in (y, z)]
    u, v = (torch.zeros(1).double() if len(c) == 1 else c.double() for c in cosines)
    steer = aperture(radar).beams(u, v, y, z)
    return float((steer @ (channels / channels.abs())).abs().max() / len(channels))


@dataclass(frozen=True, eq=False)
class MovingTargetMaps:
    """Maps around a moving echo, of its twin and of a point target at its position.

    Attributes:
        model: Model of the maps.
        twin_map: Power [velocity, range, u, v].
        point_map: Power of the point target [velocity, range, u, v].
    """

    model: RangeDopplerMap
    twin_map: Tensor
    point_map: Tensor

    def correlations(self, recording: ChirpCapture) -> dict[str, dict[str, float]]:
        """Correlate both maps with a frame of chirps, by scale."""
        seen = self.model.observe(recording)[0]
        pair = ("twin", self.twin_map), ("bare_psf", self.point_map)
        return {
            scale: {name: 1 - float(CorrelationLoss(scale)(power, seen)) for name, power in pair}
            for scale in get_args(CorrelationScale)
        }


@dataclass(frozen=True, eq=False)
class MovingTargetFit:
    """Fit of a body to the strongest moving target of a recording.

    Attributes:
        recording: One frame of chirps.
        model: Map of the whole recording.
        body: Fitted body.
        reconstruction: Result of the fit.
    """

    recording: ChirpCapture
    model: RangeDopplerMap
    body: MovingBody
    reconstruction: Reconstruction

    def predict_maps(
        self, scene: Scene, cells: int, *, time: float = 0.0, seed: int = 0
    ) -> MovingTargetMaps:
        """Predict maps around the position of the echo at a time.

        Args:
            scene: Scene with the body's object.
            cells: Number of cells to either side of the echo.
            time: Time after the middle of the recording [s].
            seed: Seed of the rays.
        """
        radar, echo = self.recording.radar(), self.body.echo
        range_ = echo.range + echo.range_rate * time
        near = self.model.crop_around(range_, echo.range_rate, cells, radar)
        with torch.no_grad():
            model = near.with_sampling(samples=_RAY_COUNT)
            twin = model.predict(self.body(scene, time), radar, seed)[0]
        return MovingTargetMaps(near, twin, point_response(near, radar, echo, time)[0])
