"""Rigid bodies that move along a straight line, as unknowns of a fit."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64
from torch import Tensor, nn

from invertwin.errors import InputError
from invertwin.radar.radar import Radar
from invertwin.scene import RoughDielectric
from invertwin.scene.mesh import Mesh
from invertwin.scene.pose import rigid
from invertwin.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class DetectedEcho:
    """A detected echo, its place refined between the bins.

    Attributes:
        range: [m].
        range_rate: Range rate, positive moves away [m/s].
        u, v: Direction cosines.
        position: In the world [m].
        coherence: 1 where the channels are a plane wave.
    """

    range: float
    range_rate: float
    u: float
    v: float
    position: Float64[Tensor, "3"]
    coherence: float


class MovingBody(nn.Module):
    """A rigid body in motion: place, size, velocity, turn, and how much of its echo is diffuse.

    Its axes are along the line of sight to the start, across this line, and up. The body moves in
    the plane of the first two axes. Its height is fitted if the antennas resolve it.
    Motion across the line of sight and a turn look much alike: hold the turn of a body that does
    not turn. The module puts the body into a scene: where it is in the middle of the frame, and
    with a velocity of each of its vertices.

    Attributes:
        echo: Where it started.
        place: parameter [2], of the body's nearest point from the start, along and across [m].
        height: parameter [], the same, up [m]; fitted if the radar has several rows of antennas.
        velocity: parameter [2], along and across [m/s].
        spin: parameter [], turn about the axis up [rad/s].
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
            scene: With the object.
            radar: In one pose.
            echo: Where to start.
            free: Names of the parameters that are fitted; the height goes with the place.
            center: Initial centre [3] in the world [m]; None = the front is at the echo.

        Raises:
            InputError: A material without a diffuse share between 0 and 1, or an unknown name.
        """
        super().__init__()
        self.object, self.echo = object, echo
        share = _require_rough_dielectric(scene, object).diffuse
        if not isinstance(share, float | int) or not 0 < share < 1:
            raise InputError(
                f"expected a number between 0 and 1 as the diffuse share of {object}, got {share}; "
                "0.5 is a start"
            )
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
        depth = 0.5 * self._extent[0]
        offset = torch.stack([self.place[0] + depth, self.place[1], self.height])
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
    raise InputError(
        f"expected a rough_dielectric for {name}, got {type(material).__name__}; its echo has the "
        "diffuse and the glossy part that the fit weighs"
    )
