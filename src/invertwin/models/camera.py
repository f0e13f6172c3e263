"""Forward models of cameras: silhouettes and depth."""

from dataclasses import dataclass, field
from typing import ClassVar, Literal

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.camera import Camera, ImageSampling, depths, silhouettes
from invertwin.checks import ArrayLike, checked_tensor
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel, Realisations
from invertwin.limits import Positive
from invertwin.models.noise import add_white_errors
from invertwin.scene.scene import Scene

_Images = Float64[Tensor, "frame row column"]  # of every frame


class _ImageMap(ForwardModel):
    """Base of the models of a camera's images."""

    sampling: ImageSampling
    scatter: float | None

    holds_fields: ClassVar[bool] = True

    def realisations(self, scene: Scene, sensor: Camera, seed: int) -> Realisations:
        """Return images with independent errors."""
        return add_white_errors(self.predict(scene, sensor, seed), self.scatter)

    def for_differences(
        self, scene: Scene, sensor: Camera, samples: int, scheme: Literal["rays", "area"]
    ) -> ForwardModel:
        """Return the model with more rays per pixel. See ``ForwardModel.for_differences``."""
        pixels = len(sensor.positions) * sensor.width * sensor.height
        return self.with_sampling(samples=max(self.sampling.samples, samples // pixels))

    def ablations(self) -> dict[str, ForwardModel]:
        """Return the model with fixed outlines. See ``ForwardModel.ablations``."""
        return {"boundary": self.with_sampling(boundary=False)} if self.sampling.boundary else {}


@dataclass(frozen=True)
class SilhouetteMap(_ImageMap):
    """Camera masks of objects: 1 inside, 0 outside, values between these at outlines.

    Compare them by ``SpectrumLoss(gain="one")``. Masks of several objects are several observations.

    Attributes:
        objects: Names of the objects of the mask; other objects may occlude them.
        sampling: Sampling of pixels and outlines.
        scatter: Standard deviation of measured masks about the map; None = estimated from the
            residual of a fit.
    """

    objects: tuple[str, ...]
    sampling: ImageSampling = field(default_factory=ImageSampling)
    scatter: float | None = None

    def predict(self, scene: Scene, sensor: Camera, seed: int) -> _Images:
        """Predict the masks. See ``ForwardModel.predict``."""
        return silhouettes(scene, sensor, self.objects, self.sampling, seed)

    def observe(self, recording: ArrayLike) -> _Images:
        """Return measured masks, [frame, row, column] or [row, column], from 0 to 1.

        Raises:
            InputError: Another shape, NaN, or values outside of 0 to 1.
        """
        found = _check_images(recording, "masks")
        if len(found.flatten()) and not 0 <= float(found.min()) <= float(found.max()) <= 1:
            raise InputError(
                f"expected masks from 0 to 1, got {float(found.min()):g} to "
                f"{float(found.max()):g}; divide bytes by 255"
            )
        return found


@dataclass(frozen=True)
class DepthMap(_ImageMap):
    """Depth images of a camera: the mean over each pixel of z in camera axes [m].

    Compare them by ``SpectrumLoss(gain="one")``.

    Attributes:
        far: Depth of empty pixels, and maximum depth [m].
        sampling: Sampling of pixels and outlines.
        scatter: Standard deviation of measured depths about the map [m]; None = estimated from the
            residual of a fit.
    """

    far: Positive
    sampling: ImageSampling = field(default_factory=ImageSampling)
    scatter: float | None = None

    def predict(self, scene: Scene, sensor: Camera, seed: int) -> _Images:
        """Predict the depths. See ``ForwardModel.predict``."""
        return depths(scene, sensor, self.far, self.sampling, seed)

    def observe(self, recording: ArrayLike) -> _Images:
        """Clamp measured depths [frame, row, column] or [row, column] to ``far`` [m].

        Raises:
            InputError: Another shape, or NaN.
        """
        given = torch.as_tensor(recording, dtype=torch.float64)
        return _check_images(given.clamp_max(self.far), "depths [m]")


def _check_images(recording: ArrayLike, what: str) -> Tensor:
    given = torch.as_tensor(recording, dtype=torch.float64)
    given = given[None] if given.ndim == 2 else given
    return checked_tensor(given, (None, None, None), what, "give [frame, row, column]")
