"""Forward model of radar cross-sections over aspect angles and frequencies."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from jaxtyping import Float64
from torch import Tensor

from invertwin.forward_model import ForwardModel
from invertwin.scene.scene import Scene
from invertwin.signatures import Signature


@dataclass(frozen=True)
class RcsMap(ForwardModel):
    """Radar cross-sections σ = 4π|S|² [m²] of a scene, over frequency, aspect and polarisations.

    No sensor is needed: give None.

    Attributes:
        signature: Takes a scene and ``boundary``: ``invertwin.rcs`` with everything else, such as
            ``partial(rcs, directions=…, frequencies=…)``.
        boundary: False leaves out of derivatives what moving edges of beams and shadows change,
            for ablation.
    """

    signature: Callable[..., Signature]
    boundary: bool = True

    redraws: ClassVar[bool] = False
    is_random: ClassVar[bool] = False

    def predict(
        self, scene: Scene, sensor: Any, seed: int
    ) -> Float64[Tensor, "frequency aspect 2 2"]:
        """σ [m²], receive × transmit. See ``ForwardModel.predict``."""
        return self.signature(scene, boundary=self.boundary).cross_section

    def observe(self, recording: Signature) -> Float64[Tensor, "frequency aspect 2 2"]:
        """σ of a signature [m²]."""
        return recording.cross_section

    def ablations(self) -> dict[str, ForwardModel]:
        """The model at fixed visibility. See ``ForwardModel.ablations``."""
        return {"boundary": replace(self, boundary=False)} if self.boundary else {}
