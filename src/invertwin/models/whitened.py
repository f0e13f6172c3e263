"""Power maps relative to the mean power of noise and clutter."""

from dataclasses import dataclass, replace
from typing import Any

from jaxtyping import Float
from torch import Tensor

from invertwin.checks import check_shape
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel, Realisations
from invertwin.scene.scene import Scene
from invertwin.seeds import derive_seed

_NOISE_ALONE = 1e9  # of the background: no echo is seen beside it


@dataclass(frozen=True, eq=False)
class WhitenedMap(ForwardModel):
    """Maps of another model divided by a background, the mean power of unmodelled objects.

    Observed and predicted maps are divided by the background B of each bin, relative to its mean.
    The likelihood of power b then is that of the mean g a + n B, with one level n for all bins.

    Attributes:
        model: model of power maps.
        background: B, mean power of noise and clutter in every bin, in any unit, > 0.

    Raises:
        InputError: a model of fields.
    """

    model: ForwardModel
    background: Float[Tensor, "frame *map"]

    def __post_init__(self) -> None:
        if self.model.holds_fields or not self.model.redraws:
            raise InputError(
                "expected a model of mean power such as SurrogateMap, got a "
                f"{type(self.model).__name__}; only power has a background"
            )

    @property
    def sampling(self) -> Any:
        """Sampling of the model's paths."""
        return getattr(self.model, "sampling", None)

    def predict(self, scene: Scene, sensor: Any, seed: int) -> Float[Tensor, "frame *map"]:
        """Predict the whitened map. See ``ForwardModel.predict``."""
        return self._whiten(self.model.predict(scene, sensor, seed), sensor)

    def observe(self, recording: Any) -> Float[Tensor, "frame *map"]:
        """Return the measured map, whitened without blur."""
        observed = self.model.observe(recording)
        check_shape(self.background, observed.shape, "a background like the map", "use one grid")
        return observed / self._relative(self.background)

    def with_sampling(self, **changes: Any) -> "WhitenedMap":
        """Return the model with other fields of its ``sampling``."""
        return replace(self, model=self.model.with_sampling(**changes))

    def prepare(self, scene: Scene, sensor: Any, seed: int) -> "WhitenedMap":
        """Return the model with the random numbers that are fixed during a fit."""
        return replace(self, model=self.model.prepare(scene, sensor, seed))

    def realisations(self, scene: Scene, sensor: Any, seed: int) -> Realisations | None:
        """Return whitened recordings of the twin; clutter is noise of the same power."""
        inner = self.model.realisations(scene, sensor, seed)
        if inner is None:
            return None
        relative = self._relative(self.background)
        least = float(relative.min())

        def realise(number: int, noise: float) -> Tensor:
            # Echoes interfere with the least background; the rest adds power.
            seen = inner(number, least * noise) / relative
            strong = _NOISE_ALONE * float(seen.mean() + noise)
            alone = inner(derive_seed(number, 3), strong) / strong
            return seen + noise * (1 - least / relative) * alone

        return realise

    @property
    def has_blur(self) -> bool:
        """True if the model blurs its maps."""
        return self.model.has_blur

    def scale_blur(self, fraction: float) -> "WhitenedMap":
        """Scale the additional blur widths by a factor."""
        return replace(self, model=self.model.scale_blur(fraction))

    def blur_observed(self, observed: Tensor, sensor: Any) -> Float[Tensor, "frame *map"]:
        """Blur a whitened map by the model's widths, whitened by the blurred background."""
        power = observed * self._relative(self.background)
        return self._whiten(self.model.blur_observed(power, sensor), sensor)

    def _whiten(self, power: Tensor, sensor: Any) -> Tensor:
        """Divide a map by the background, with the same blur."""
        return power / self._relative(self.model.blur_observed(self.background, sensor)).to(power)

    def _relative(self, background: Tensor) -> Tensor:
        """Relate a background to its mean without blur."""
        return background / self.background.mean()
