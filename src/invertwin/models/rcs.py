"""Forward model of radar cross-sections over aspect angles and frequencies."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar

from jaxtyping import Float64
from torch import Tensor

from invertwin.checks import ArrayLike, set_fields
from invertwin.deprecation import warn_renamed
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel
from invertwin.limits import Count, Positive
from invertwin.scene.scene import Scene
from invertwin.signatures import Signature, rcs


@dataclass(frozen=True, eq=False)
class RcsMap(ForwardModel):
    """Radar cross-sections σ = 4π|S|² [m²] of a scene, over frequency, aspect and polarisations.

    No sensor is needed. The attributes are the arguments of ``invertwin.rcs``.

    Attributes:
        directions: Unit vectors from the target to the transmitter, [aspect, 3].
        frequencies: Frequencies [Hz].
        receivers: Unit vectors to the receiver, [aspect, 3]; None = monostatic.
        polarisation: "V", "H", or a Jones vector.
        depth: Maximum number of bounces.
        edges: Maximum number of successive edge diffractions.
        tubes_per_wavelength: Ray tubes per wavelength.
        up: Direction of vertical polarisation.
        boundary: False = derivatives without moving edges of beams and shadows, for ablation.
        compute: Function (scene, boundary) → ``Signature`` in place of ``invertwin.rcs``.

    Raises:
        InputError: No directions or frequencies.
    """

    directions: ArrayLike = ()
    frequencies: float | Sequence[float] | Tensor = ()
    receivers: ArrayLike | None = None
    polarisation: str | Sequence[complex] = "V"
    depth: Count = 5
    edges: int = 2
    tubes_per_wavelength: Positive = 8.0
    up: Sequence[float] = (0.0, 0.0, 1.0)
    boundary: bool = True
    compute: Callable[..., Signature] | None = field(default=None, kw_only=True)

    redraws: ClassVar[bool] = False
    is_random: ClassVar[bool] = False
    needs_sensor: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if callable(self.directions):
            warn_renamed("RcsMap(partial(rcs, ...))", "RcsMap(directions=..., frequencies=...)", 5)
            if isinstance(self.frequencies, bool):  # RcsMap(signature, boundary)
                set_fields(self, boundary=self.frequencies)
            set_fields(self, compute=self.directions, directions=(), frequencies=())
        if self.compute is None and not all(map(_has_values, (self.directions, self.frequencies))):
            raise InputError(
                "expected directions and frequencies for an RcsMap, got none; give "
                "RcsMap(directions=..., frequencies=...) as for invertwin.rcs"
            )

    def predict(
        self, scene: Scene, sensor: Any, seed: int
    ) -> Float64[Tensor, "frequency aspect 2 2"]:
        """Compute σ [m²], receive × transmit. See ``ForwardModel.predict``."""
        if self.compute is not None:
            return self.compute(scene, boundary=self.boundary).cross_section
        options = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "compute"}
        return rcs(scene, **options).cross_section

    def observe(self, recording: Signature) -> Float64[Tensor, "frequency aspect 2 2"]:
        """Return σ of a signature [m²]."""
        return recording.cross_section

    def ablations(self) -> dict[str, ForwardModel]:
        """Return the model at fixed visibility. See ``ForwardModel.ablations``."""
        return {"boundary": replace(self, boundary=False)} if self.boundary else {}


def _has_values(values: Any) -> bool:
    """Return False for an empty sequence or tensor."""
    return not hasattr(values, "__len__") or getattr(values, "ndim", 1) == 0 or len(values) > 0
