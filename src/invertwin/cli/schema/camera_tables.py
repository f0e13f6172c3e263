"""Cameras of run files, and the images that are made of a scene."""

from collections.abc import Sequence
from typing import Annotated, Any

from annotated_types import Len, MinLen

from invertwin.camera import Camera, CameraPose, ImageSampling
from invertwin.forward_model import ForwardModel
from invertwin.limits import RADIANS, Count, Positive
from invertwin.models.camera import DepthMap, SilhouetteMap
from invertwin.registry.kinds import KindGroup, OneOf, Registry, TableOf

PointValues = Annotated[Sequence[float], Len(3, 3)]


def look_at_camera(
    positions: Annotated[Sequence[PointValues], MinLen(1)],
    look_at: PointValues,
    width: Count,
    height: Count,
    field_of_view: Annotated[float, RADIANS],
    up: PointValues = (0.0, 0.0, 1.0),
) -> Camera:
    """Pinhole cameras that look at a point, upright.

    Args:
        positions: m, one for each frame.
        look_at: m, the point in the middle of the images.
        width: pixels of a row.
        height: rows of pixels.
        field_of_view: across the width.
        up: in the world; the upper side of the images points there.
    """
    return Camera.look_at(
        positions, look_at, width=width, height=height, field_of_view=field_of_view, up=up
    )


def silhouette(
    objects: Annotated[Sequence[str], MinLen(1)], samples: Count = 16, outline_samples: Count = 64
) -> SilhouetteMap:
    """Mask of some objects: of every pixel the share in which one of them is seen first.

    Args:
        objects: their names in the scene.
        samples: rays of a pixel.
        outline_samples: points of outlines for each pixel of their length; derivatives need them.
    """
    return SilhouetteMap(tuple(objects), ImageSampling(samples, outline_samples))


def depth(far: Positive, samples: Count = 16, outline_samples: Count = 64) -> DepthMap:
    """Depth along the camera's axis: the mean over every pixel.

    Args:
        far: depth where nothing is seen, or what is further away [m].
        samples: rays of a pixel.
        outline_samples: points of outlines for each pixel of their length; derivatives need them.
    """
    return DepthMap(far, ImageSampling(samples, outline_samples))


AnyCamera = Annotated[Any, TableOf(look_at_camera, checked=True)]
AnyImage = Annotated[Any, OneOf("image")]


def register(registry: Registry) -> None:
    """Add images, and the pose of a camera."""
    registry.groups["image"] = KindGroup(product=ForwardModel)
    registry.add("image", "silhouette", silhouette)
    registry.add("image", "depth", depth)
    registry.add("parameter", "camera_pose", CameraPose, without=("translation", "rotation"))
