"""Pinhole cameras: poses and projection."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from invertwin import checks
from invertwin.errors import InputError
from invertwin.runtime.memory import require_at_most
from invertwin.scene.parameters import RigidMotion
from invertwin.scene.pose import rotate_about_mean

_MAX_PIXELS = 1 << 26


@dataclass(frozen=True, eq=False)
class Camera:
    """Pinhole camera without distortion, with one pose per frame.

    Camera axes are those of OpenCV: x to the right of the image, y down, z forward. The pixel [row,
    column] covers u from column to column + 1 and v from row to row + 1; a point (x, y, z) in
    camera axes projects to u = c_u + f x/z, v = c_v + f y/z. Rectify distorted images.

    Attributes:
        positions: positions of the pinhole, [frame, 3] or [3] in the world [m]. Differentiable.
        rotations: matrices whose columns are the camera's axes in the world, [frame, 3, 3] or [3,
            3].
        width, height: image size [pixel].
        focal: focal length f [pixel]. Differentiable.
        centre: principal point c_u, c_v [pixel]; None = the middle of the image. Differentiable.

    Raises:
        InputError: Wrong shapes or numbers, or rotations that are not orthonormal.
    """

    positions: Float64[Tensor, "*frame 3"]
    rotations: Float64[Tensor, "*turn 3 3"]
    width: int
    height: int
    focal: float | Float64[Tensor, ""]
    centre: Float64[Tensor, "2"] | None = None

    def __post_init__(self) -> None:
        do = "give x, y, z, or a row of them for each frame"
        places = checks.checked_rows(self.positions, "positions of a camera", do)
        axes = torch.as_tensor(self.rotations, dtype=torch.float64)
        axes = axes.expand(len(places), 3, 3) if axes.ndim == 2 else axes
        do = "give the camera's axes as columns, once or for each frame"
        axes = checks.checked_tensor(axes, (len(places), 3, 3), "rotations of a camera", do)
        checks.check_orthonormal(axes, "rotations of a camera", do)
        sides = (checks.checked_count(getattr(self, k), k, 1) for k in ("width", "height"))
        require_at_most(math.prod(sides), _MAX_PIXELS, "pixels", "bin them")
        focal = checks.checked_tensor(self.focal, (), "focal length [pixel]", "give one number")
        checks.checked_number(focal, "focal length [pixel]", 0.0, open_low=True)
        middle = torch.tensor([self.width / 2, self.height / 2], dtype=torch.float64)
        centre = middle if self.centre is None else self.centre
        centre = checks.checked_tensor(centre, (2,), "centre of an image [pixel]", "give u and v")
        checks.set_fields(self, positions=places, rotations=axes, focal=focal, centre=centre)

    @staticmethod
    def look_at(
        positions: checks.ArrayLike,
        target: checks.ArrayLike,
        *,
        width: int,
        height: int,
        field_of_view: float,
        up: checks.ArrayLike = (0.0, 0.0, 1.0),
    ) -> "Camera":
        """Return upright cameras that look at a point; +y is on the left of one that looks along x.

        Args:
            positions: positions [frame, 3] or [3] [m].
            target: point in the middle of the images [3] [m].
            width, height: image size [pixel].
            field_of_view: horizontal field of view [rad].
            up: upward direction in the world [3].

        Raises:
            InputError: Wrong numbers, or a camera that looks along ``up``.
        """
        do = "give x, y, z"
        places = checks.checked_rows(positions, "positions [m]", do)
        aim = checks.checked_tensor(target, (3,), "target of a camera [m]", do) - places
        above = checks.checked_tensor(up, (3,), "up of a camera", do).expand_as(aim)
        right = torch.linalg.cross(aim, above)
        if not bool((right.norm(dim=1) > 1e-9 * aim.norm(dim=1) * above.norm(dim=1)).all()):
            raise InputError("expected cameras that do not look along up, got one; give another up")
        unit = torch.nn.functional.normalize
        forward, right = unit(aim, dim=1), unit(right, dim=1)
        rotations = torch.stack([right, torch.linalg.cross(forward, right), forward], 2)
        angle = checks.checked_number(
            field_of_view, "field of view [rad]", 0.0, math.pi, open_low=True
        )
        return Camera(places, rotations, width, height, width / (2 * math.tan(angle / 2)))

    def frames(self, indices: Sequence[int]) -> "Camera":
        """Return the camera with selected frames.

        Args:
            indices: indices of the frames.
        """
        rows = torch.as_tensor(indices)
        return replace(self, positions=self.positions[rows], rotations=self.rotations[rows])

    def transform_rigidly(
        self, rotation: Float64[Tensor, "3 3"], translation: Float64[Tensor, "3"]
    ) -> "Camera":
        """Transform all poses rigidly: rotate about the mean position, then translate.

        Args:
            rotation: world rotation matrix [3, 3].
            translation: world translation [3] [m].
        """
        places = rotate_about_mean(self.positions, rotation) + translation
        return replace(self, positions=places, rotations=rotation @ self.rotations)

    def detach(self) -> "Camera":
        """Return the camera without derivatives."""
        names = ("positions", "rotations", "focal", "centre")
        fixed = {name: checks.strip_derivatives(getattr(self, name)) for name in names}
        return replace(self, **fixed)

    @property
    def principal_point(self) -> Float64[Tensor, "2"]:
        """Principal point c_u, c_v [pixel]."""
        return torch.as_tensor(self.centre)

    @property
    def is_differentiated(self) -> bool:
        """True if any of its values carries derivatives."""
        values = (self.positions, self.rotations, self.focal, self.centre)
        return any(checks.is_differentiated(torch.as_tensor(value)) for value in values)

    def directions(self, pixels: Float64[Tensor, "n 2"], frame: int) -> Float64[Tensor, "n 3"]:
        """Return viewing directions of pixels in world axes, one unit forward.

        Args:
            pixels: image coordinates u, v [*, 2].
            frame: index of the pose.
        """
        aside = (pixels - self.principal_point) / self.focal
        return torch.cat([aside, torch.ones_like(aside[:, :1])], 1) @ self.rotations[frame].mT

    def to_camera_axes(self, points: Float64[Tensor, "n 3"], frame: int) -> Float64[Tensor, "n 3"]:
        """Transform world points to camera axes [m].

        Args:
            points: positions [*, 3] [m].
            frame: index of the pose.
        """
        return (points - self.positions[frame]) @ self.rotations[frame]

    def project(self, points: Float64[Tensor, "n 3"], frame: int) -> Float64[Tensor, "n 2"]:
        """Project world points in front of the camera to u, v [pixel].

        Args:
            points: positions [*, 3] [m].
            frame: index of the pose.
        """
        local = self.to_camera_axes(points, frame)
        return self.principal_point + self.focal * local[:, :2] / local[:, 2:]


def object_numbers(names: Sequence[str], objects: Sequence[str]) -> Int64[Tensor, " object"]:
    """Numbers of the objects that a mask shows.

    Args:
        names: all objects, in order.
        objects: those of the mask.

    Raises:
        InputError: None, or an unknown one.
    """
    checks.check_some(objects, "object", "name those that the mask shows")
    for name in objects:
        checks.check_choice(name, names, "objects among", "name those that the mask shows")
    return torch.tensor([names.index(name) for name in objects])


class CameraPose(RigidMotion):
    """Rigid transform of all poses of a camera, see ``Camera.transform_rigidly``."""

    moved = "camera"

    def forward(self, camera: Camera) -> Camera:
        """Return the moved camera."""
        return camera.transform_rigidly(self.rotation_matrix, self.shift)
