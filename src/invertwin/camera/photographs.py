"""Simulated photographs: an object label and one depth in every pixel, with errors.

These are data, not a fitted model: one ray through the centre of each pixel, as for labels and
depth cameras, while ``silhouettes`` and ``depths`` are means over the pixels' areas.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from invertwin.camera.camera import Camera, object_numbers
from invertwin.channel import ViewpointScene
from invertwin.checks import checked_number
from invertwin.scene.scene import Scene


@dataclass(frozen=True)
class Photograph:
    """Labels and depths of a camera's frames.

    Attributes:
        names: names of the objects.
        labels: index of the name in every pixel; −1 for background.
        depth: z in camera axes [m]; infinite for background.
    """

    names: tuple[str, ...]
    labels: Int64[Tensor, "frame row column"]
    depth: Float64[Tensor, "frame row column"]

    def mask(self, *objects: str) -> Float64[Tensor, "frame row column"]:
        """Return 1 in the pixels of some objects, 0 elsewhere.

        Args:
            objects: names of the objects.

        Raises:
            InputError: A name that is not in the scene.
        """
        return torch.isin(self.labels, object_numbers(self.names, objects)).double()


def photograph(
    scene: Scene, camera: Camera, *, seed: int, wrong_labels: float = 0.0, depth_noise: float = 0.0
) -> Photograph:
    """Simulate labelled pictures and depth images of a scene.

    Label errors occur at outlines, as in segmentations: a fraction of the pixels there has the
    label of a neighbour. Depth errors grow with the square of the depth, as for stereo and
    structured light.

    Args:
        scene: scene of surfaces only.
        camera: the camera.
        seed: seed of the errors.
        wrong_labels: fraction of wrong pixels at outlines, 0 to 1.
        depth_noise: standard deviation of depths at 1 m [m].

    Raises:
        InputError: A cloud in the scene, or fractions and deviations out of range.

    Source: K. Khoshelham, S. O. Elberink, "Accuracy and resolution of Kinect depth data", Sensors
    12 (2012), eq. 10: the error of a triangulated depth grows with its square.
    """
    share = checked_number(wrong_labels, "share of wrong labels", 0.0, 1.0)
    deviation = checked_number(depth_noise, "noise of depths at 1 m [m]", 0.0)
    random = torch.Generator().manual_seed(seed)
    fixed = camera.detach()
    frames = [_render_labels(scene, fixed, number) for number in range(len(fixed.positions))]
    labels, depth = (torch.stack(parts) for parts in zip(*frames, strict=True))
    labels = _corrupt_labels(labels, share, random)
    errors = torch.randn(depth.shape, generator=random, dtype=depth.dtype)
    errors = errors * torch.where(depth.isfinite(), depth**2 * deviation, 0.0)
    return Photograph(tuple(scene.objects), labels, depth + errors)


def _render_labels(scene: Scene, camera: Camera, number: int) -> tuple[Tensor, Tensor]:
    with torch.no_grad():
        sight = ViewpointScene(scene, camera.positions[number])
        sides = torch.arange(camera.height), torch.arange(camera.width)
        row, column = torch.meshgrid(*sides, indexing="ij")
        middles = torch.stack([column, row], 2).reshape(-1, 2).double() + 0.5
        directions = camera.directions(middles, number)
        face = sight.find_first_faces(directions)
        depth = sight.plane_distances(face, directions)
        label = torch.where(face >= 0, sight.face_object[face.clamp_min(0)], -1).long()
    return label.reshape(row.shape), depth.reshape(row.shape)


def _corrupt_labels(labels: Tensor, share: float, random: torch.Generator) -> Tensor:
    """Replace some labels at outlines by a neighbour's."""
    way = torch.randint(0, 4, labels.shape, generator=random)
    neighbour = torch.stack([labels.roll(by, axis) for axis in (1, 2) for by in (1, -1)])
    # Pixels at the border have no neighbours outside the image.
    for number, (axis, edge) in enumerate(((1, 0), (1, -1), (2, 0), (2, -1))):
        index = torch.tensor([edge % labels.shape[axis]])
        neighbour[number].index_copy_(axis, index, labels.index_select(axis, index))
    other = neighbour.gather(0, way[None])[0]
    wrong = torch.rand(labels.shape, generator=random) < share
    return torch.where(wrong & (neighbour != labels).any(0), other, labels)
