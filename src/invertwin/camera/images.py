"""Images of a pinhole camera, with derivatives of moving outlines.

A pixel is the mean over its area of an indicator of the visible object, or of depth. Rays have
fixed image positions. Their derivative at fixed visibility is attached; moving outlines add ``ΔI =
(f₋ − f₊) n·(x − x_m)``, with x the projected point of the outline, n its normal in the image, and f
the values on both of its sides.

Source: derivations §3, on the image plane instead of a surface.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.camera.camera import Camera, object_numbers
from invertwin.channel import DiscontinuityCurves, ViewpointScene
from invertwin.checks import strip_derivatives
from invertwin.limits import Count
from invertwin.scene.scene import Scene

_OUTLINE_OFFSET = 5e-6  # angle between an outline and rays on its sides, in float32 [rad]
_NEAR_PLANE = 1e-3  # near clipping distance of outlines [m]
_ROWS_AT_ONCE = 1 << 20
_R2_STEPS = torch.tensor([0.7548776662466927, 0.5698402909980532], dtype=torch.float64)
"""Steps of the low-discrepancy sequence R2: powers of the root of x³ = x + 1."""

RayValue = Callable[[ViewpointScene, Tensor, Tensor], Tensor]
"""Values of single rays from the scene, the first triangles hit (−1: none), and depths."""


@dataclass(frozen=True)
class ImageSampling:
    """Sampling of images and their derivatives.

    Attributes:
        samples: number of rays per pixel.
        outline_samples: number of outline points per pixel of their length.
        boundary: whether derivatives include moving outlines.
    """

    samples: Count = 16
    outline_samples: Count = 64
    boundary: bool = True


def silhouettes(
    scene: Scene, camera: Camera, objects: Sequence[str], sampling: ImageSampling, seed: int
) -> Float64[Tensor, "frame row column"]:
    """Render the fraction of every pixel in which one of the objects is visible.

    Args:
        scene: scene to render.
        camera: the camera.
        objects: names of the objects.
        sampling: sampling of pixels and outlines.
        seed: seed of the ray positions in their pixels.

    Raises:
        InputError: A name that is not in the scene, or a cloud.
    """
    numbers = object_numbers(scene.names, objects)

    def evaluate_mask(sight: ViewpointScene, face: Tensor, depth: Tensor) -> Tensor:
        owner = torch.where(face >= 0, sight.face_object[face.clamp_min(0)], -1)
        return torch.isin(owner, numbers).double()

    return _render_images(scene, camera, evaluate_mask, sampling, seed, crossings=True)


def depths(
    scene: Scene, camera: Camera, far: float, sampling: ImageSampling, seed: int
) -> Float64[Tensor, "frame row column"]:
    """Render the mean depth over every pixel: z in camera axes [m].

    Args:
        scene: scene to render.
        camera: the camera.
        far: depth of the background and of more distant points [m].
        sampling: sampling of pixels and outlines.
        seed: seed of the ray positions in their pixels.

    Raises:
        InputError: A cloud in the scene.
    """

    def evaluate_depth(sight: ViewpointScene, face: Tensor, depth: Tensor) -> Tensor:
        return depth.clamp_max(far)

    # Depth is continuous at intersection curves.
    return _render_images(scene, camera, evaluate_depth, sampling, seed, crossings=False)


def _render_images(
    scene: Scene,
    camera: Camera,
    ray_value: RayValue,
    sampling: ImageSampling,
    seed: int,
    *,
    crossings: bool,
) -> Tensor:
    images, fixed = [], camera.detach()
    for number, position in enumerate(camera.positions):
        random = np.random.default_rng(np.random.SeedSequence([seed, number]))
        sight = ViewpointScene(scene, position)
        one = _ImageRenderer(camera, fixed, number, sight, ray_value, sampling, random)
        images.append(one.render(crossings))
    return torch.stack(images)


@dataclass(eq=False)
class _ImageRenderer:
    """Renderer of one image."""

    camera: Camera
    fixed: Camera  # without derivatives
    number: int
    sight: ViewpointScene
    ray_value: RayValue
    sampling: ImageSampling
    random: np.random.Generator

    def render(self, crossings: bool) -> Float64[Tensor, "row column"]:
        """Return the mean over each pixel, with the derivative of outlines."""
        camera, count = self.camera, self.sampling.samples
        pixels = camera.width * camera.height
        total = torch.zeros(pixels, dtype=torch.float64)
        shift = torch.from_numpy(self.random.random((pixels, 2)))
        for some in torch.arange(pixels * count).split(_ROWS_AT_ONCE):
            pixel = some // count
            corner = torch.stack([pixel % camera.width, pixel // camera.width], 1)
            # Uniform over the pixel, with a random shift.
            inside = (shift[pixel] + (some % count)[:, None] * _R2_STEPS) % 1.0
            total = total.index_add(0, pixel, self.sample_image(corner + inside, camera) / count)
        if self.sampling.boundary and (self.sight.is_differentiated or camera.is_differentiated):
            total = total + self._outline_derivative(self.sight.find_silhouettes())
            if crossings:
                total = total + self._outline_derivative(self.sight.find_intersections())
        return total.unflatten(0, (camera.height, camera.width))

    def sample_image(
        self, positions: Float64[Tensor, "n 2"], camera: Camera
    ) -> Float64[Tensor, " n"]:
        """Evaluate the image at single points.

        Args:
            positions: image coordinates u, v [*, 2].
            camera: camera with derivatives, or without.
        """
        face = self.sight.find_first_faces(self.fixed.directions(positions, self.number))
        depth = self.sight.plane_distances(face, camera.directions(positions, self.number))
        return self.ray_value(self.sight, face, depth)

    def _outline_derivative(self, curves: DiscontinuityCurves) -> Float64[Tensor, " pixel"]:
        """Return the contribution of outlines to derivatives; zero in value."""
        camera, fixed, number = self.camera, self.fixed, self.number
        size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
        ends = torch.stack([fixed.to_camera_axes(v, number) for v in (curves.start, curves.end)])
        low, high = _clip_segments(ends, fixed, size)
        piece = torch.nonzero(high > low)[:, 0]
        ends = ends[:, piece]
        cut = [torch.lerp(ends[0], ends[1], share[piece, None]) for share in (low, high)]
        slopes = torch.stack([point[:, :2] / point[:, 2:] for point in cut])
        marks = fixed.principal_point + fixed.focal * slopes
        length = (marks[1] - marks[0]).norm(dim=1)
        count = int(np.ceil(float(length.sum()) * self.sampling.outline_samples))
        if not count:
            return torch.zeros(1, dtype=torch.float64)
        spot = (torch.arange(count) + torch.from_numpy(self.random.random(count))) / count
        until = length.cumsum(0)
        row = torch.searchsorted(until, spot * until[-1], right=True).clamp_max(len(length) - 1)
        share = (1 - (until[row] - spot * until[-1]) / length[row]).clamp(0.0, 1.0)
        # Uniform image positions are not uniform along the segment: 1/z is linear in the image.
        depth = [point[row, 2] for point in cut]
        share = share * depth[0] / torch.lerp(depth[1], depth[0], share)
        share = torch.lerp(low[piece][row], high[piece][row], share)

        place = camera.project(self.sight.points_on_curves(curves, piece[row], share), number)
        here = strip_derivatives(place)
        along = (marks[1] - marks[0])[row] / length[row, None]
        across = torch.stack([-along[:, 1], along[:, 0]], 1)
        aside = _OUTLINE_OFFSET * fixed.focal
        sides = [self.sample_image(here + sign * aside * across, fixed) for sign in (-1.0, 1.0)]
        low_side, high_side = map(strip_derivatives, sides)
        sweep = ((place - here) * across).sum(1) * (float(until[-1]) / count)
        rows = torch.nonzero(((here >= 0) & (here < size)).all(1) & (low_side != high_side))[:, 0]
        column, line = here[rows].long().unbind(1)
        added = (low_side - high_side)[rows] * sweep[rows]
        flat = torch.zeros(camera.width * camera.height, dtype=torch.float64)
        return flat.index_add(0, line * camera.width + column, added)


def _clip_segments(ends: Tensor, camera: Camera, size: Tensor) -> tuple[Tensor, Tensor]:
    """Return the interval of each segment in front of the camera and inside its image, 0 to 1."""
    x, y, z = ends.unbind(2)
    u, v = camera.principal_point
    planes = [
        z - _NEAR_PLANE,
        camera.focal * x + u * z,
        camera.focal * y + v * z,
        (size[0] - u) * z - camera.focal * x,
        (size[1] - v) * z - camera.focal * y,
    ]
    low, high = torch.zeros_like(x[0]), torch.ones_like(x[0])
    for begin, end in planes:
        turn = begin / torch.where(begin == end, 1.0, begin - end)
        low = torch.where((begin < 0) & (end > 0), torch.maximum(low, turn), low)
        high = torch.where((begin > 0) & (end < 0), torch.minimum(high, turn), high)
        high = torch.where((begin <= 0) & (end <= 0), -1.0, high)
    return low, high
