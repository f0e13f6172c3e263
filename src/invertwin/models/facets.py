"""Forward models of a few flat conductors: coherent beam tracing."""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from invertwin.capture.capture import Capture
from invertwin.channel import Grid, Sampling, trace_facet_paths
from invertwin.forward_model import ForwardModel, Realisations
from invertwin.models.noise import noisy_realisations
from invertwin.radar.processing.beamforming import exact_spectrum
from invertwin.radar.radar import Radar
from invertwin.radar.signal.range_profile import beat_signal, range_profile
from invertwin.radar.surrogate.surrogate import Surrogate
from invertwin.radar.waveform import SampledWaveform
from invertwin.scene.scene import Scene


@dataclass(frozen=True)
class FacetMap(ForwardModel):
    """Power spectrum of a few flat conductors that reflect one another: |sum of fields|².

    Fields of the facet paths of a corner reflector are added, as in a ``SurrogateMap`` that names
    it ``coherent``, which also supports scenes with rough objects. The map uses no samples and has
    no speckle. It is smooth in the pose, at corners and edges of beams too, if one path or one
    corner reflector dominates each cell; echoes of several targets in one cell interfere, with a
    minimum every half wavelength.

    Attributes:
        grid: Bins, see ``Radar.grid``.
        surrogate: Additional blur widths, which are zero at the end of a fit; its kernels are not
            used.
        sampling: Maximum number of bounces; other values are not used.
    """

    grid: Grid
    surrogate: Surrogate = field(default_factory=Surrogate)
    sampling: Sampling = Sampling()

    redraws: ClassVar[bool] = False

    def _beat(self, scene: Scene, sensor: Radar) -> Tensor:
        return beat_signal(trace_facet_paths(scene, sensor.link(), self.sampling.depth), sensor)

    def _to_map(self, beat: Tensor, sensor: Radar) -> Tensor:
        return exact_spectrum(beat, sensor, self.grid).to(torch.float32)

    def predict(self, scene: Scene, sensor: Radar, seed: int) -> Float[Tensor, "frame range u v"]:
        """Predict the spectrum of facet paths. See ``trace_facet_paths``."""
        return self.blur_observed(self._to_map(self._beat(scene, sensor), sensor), sensor)

    def observe(self, recording: Capture) -> Float[Tensor, "frame range u v"]:
        """The measured power spectrum of a capture."""
        return recording.spectrum(self.grid).to(torch.float32)

    def realisations(self, scene: Scene, sensor: Radar, seed: int) -> Realisations | None:
        """Return maps with independent noise; None for waveforms without samples."""
        if not isinstance(sensor.waveform, SampledWaveform):
            return None
        beat, to_map = self._beat(scene, sensor), partial(self._to_map, sensor=sensor)
        return noisy_realisations(lambda _: beat, to_map, beat.shape, seed, self.holds_fields)

    @property
    def has_blur(self) -> bool:
        """True if the surrogate blurs maps."""
        return self.surrogate.has_blur

    def scale_blur(self, fraction: float) -> "FacetMap":
        """Scale the additional blur widths by a factor."""
        return replace(self, surrogate=self.surrogate.scale_blur(fraction))

    def blur_observed(self, observed: Tensor, sensor: Radar) -> Float[Tensor, "frame range u v"]:
        """Blur a map by the additional widths."""
        return self.surrogate.blur(observed, sensor, self.grid)


@dataclass(frozen=True)
class FacetField(FacetMap):
    """Complex range profiles of a few flat conductors that reflect one another.

    The phase determines the range to a fraction of a wavelength, and the loss has a minimum every
    half wavelength. In a later stage of a fit, this model refines the result of a ``FacetMap``,
    which is accurate to a tenth of a wavelength in range. Maps hold real and imaginary parts;
    compare them by a ``SpectrumLoss`` of kind ``mse`` with one level. The radar's phase is
    calibrated.
    """

    holds_fields: ClassVar[bool] = True

    def _to_map(self, beat: Tensor, sensor: Radar) -> Tensor:
        profile = range_profile(beat.to(torch.complex128), sensor, self.grid)
        return torch.view_as_real(profile.flatten(1, 2).mT).contiguous()

    def predict(
        self, scene: Scene, sensor: Radar, seed: int
    ) -> Float[Tensor, "frame range channel part"]:
        """The range profiles of the chains. See ``ForwardModel.predict`` and
        ``trace_facet_paths``.
        """
        return super().predict(scene, sensor, seed)

    def observe(self, recording: Capture) -> Float[Tensor, "frame range channel part"]:
        """Return the measured range profiles of a capture."""
        return self._to_map(recording.beat, recording.radar())

    @property
    def has_blur(self) -> bool:
        """False: fields have no additional blur."""
        return False

    def blur_observed(self, observed: Tensor, sensor: Radar) -> Tensor:
        """Return the map unchanged."""
        return observed
