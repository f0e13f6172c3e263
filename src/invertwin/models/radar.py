"""Forward models of radar spectra: the smooth surrogate and the exact signal."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Literal

import torch
from annotated_types import Ge
from jaxtyping import Float
from torch import Tensor

from invertwin import channel
from invertwin.capture.capture import Capture
from invertwin.checks import checked_count, set_fields
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel, Realisations
from invertwin.models.noise import noisy_realisations
from invertwin.radar import Radar, SampledWaveform, beat_signal, exact_spectrum
from invertwin.radar.signal.realisations import SpeckleRealisations
from invertwin.radar.surrogate import surrogate as surrogates
from invertwin.scene.scene import Scene
from invertwin.seeds import derive_seed
from invertwin.simulation import simulate

_Reference = tuple[Scene, channel.Link, Literal["rays", "area"]]  # of `for_differences`


@dataclass(frozen=True)
class SurrogateMap(ForwardModel):
    """Expected power over range and direction, smooth in the scene's parameters.

    Attributes:
        grid: Bins, see ``Radar.grid``.
        surrogate: Kernels and additional blur widths, or a name among ``SURROGATES``.
        sampling: Sampling of paths.
        coherent: Names of coherent targets: smooth conductors of at most 24 triangles each, such as
            corner reflectors, whose bounces add in field. Other smooth conductors are narrow lobes
            whose bounces add in power: a corner reflector is then some 10 dB too weak.
        stretch: Initial wavelength of the targets' phases in a fit, in wavelengths of the radar. It
            widens the lobes of plates and dihedrals by this factor and keeps their peaks.
        mirrors: Names of smooth flat objects, such as a wall or a floor, that form mirror images
            (ghosts) of everything except the coherent targets: paths of up to ``sampling.depth``
            surfaces that scatter once. Other smooth surfaces are lobes.

    Raises:
        InputError: An unknown name, or "exact", which is ``ExactMap``; a stretch below 1, or a
            stretch without targets.
    """

    grid: channel.Grid
    surrogate: surrogates.Surrogate | str = "response"
    sampling: channel.Sampling = channel.Sampling()
    coherent: Sequence[str] = ()
    stretch: Annotated[float, Ge(1)] = 1.0
    mirrors: Sequence[str] = ()
    _reference: _Reference | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        chosen = surrogates.resolve_surrogate(self.surrogate)
        if chosen is None:
            raise InputError(
                'expected a surrogate for a SurrogateMap, got "exact"; use ExactMap(grid)'
            )
        for name in ("coherent", "mirrors"):
            if isinstance(names := getattr(self, name), str):
                raise InputError(
                    f"expected a list of names of objects, got {names!r}; give {name}=[{names!r}]"
                )
            set_fields(self, **{name: tuple(names)})
        set_fields(self, surrogate=chosen)
        if not 1 <= self.stretch < math.inf or (self.stretch > 1 and not self.coherent):
            raise InputError(
                f"expected a stretch >= 1 of coherent targets, got {self.stretch} and "
                f"{len(self.coherent)} targets; give coherent=[...], or stretch=1"
            )

    @property
    def kernels(self) -> surrogates.Surrogate:
        """Kernels of the surrogate."""
        assert isinstance(self.surrogate, surrogates.Surrogate)
        return self.surrogate

    def predict(self, scene: Scene, sensor: Radar, seed: int) -> Float[Tensor, "frame range u v"]:
        """Predict the expected power spectrum. See ``ForwardModel.predict``."""
        how: dict[str, Any] = {n: getattr(self, n) for n in ("coherent", "stretch", "mirrors")}
        how |= {"sampling": self.sampling, "seed": seed, "reference": self._reference}
        return surrogates.surrogate_spectrum(scene, sensor, self.grid, self.kernels, **how)

    def predict_batch(
        self, scenes: Sequence[Scene], sensor: Radar, seed: int
    ) -> Float[Tensor, "scene frame range u v"]:
        """Predict maps of many scenes in one kernel launch, which is fast for few samples.

        Maps are differentiable with respect to every scene and to the sensor. Scenes have only the
        sensor in common: they may share tensors, or have different objects. See ``deposit_batch``.

        Args:
            scenes: Scenes to predict, such as the variants of one scene in a training step.
            sensor: Radar that sees each of them, with its poses.
            seed: Same seed and scenes, same maps.

        Raises:
            InputError: No scenes, clouds, or a model for finite differences.
        """
        if self._reference is not None:
            raise InputError(
                "expected a model for predictions, got one that was made for differences of one "
                "scene; use predict, or the model that for_differences was called of"
            )
        rest = [channel.as_absorbers(scene, self.coherent) for scene in scenes]
        place, drawn = (sensor.link(), self.grid), dict[str, Any](sampling=self.sampling, seed=seed)
        bare = [channel.without_specular(scene, self.mirrors) for scene in rest]
        deposit = channel.deposit_batch(bare, *place, **drawn)
        if self.mirrors:
            ghosts = *place, self.mirrors
            images = [channel.deposit_mirrored_power(scene, *ghosts, **drawn) for scene in rest]
            deposit = deposit + torch.stack(images)
        if self.coherent:
            how = sensor, self.grid, self.kernels, self.sampling, self.coherent, self.stretch
            targets = [
                torch.stack(surrogates.deposit_targets(scene, *how)).sum(0) for scene in scenes
            ]
            deposit = deposit + torch.stack(targets)
        spectra = self.kernels.shape(deposit.flatten(0, 1), sensor, self.grid)
        return spectra.clamp_min(0.0).reshape(deposit.shape)

    def observe(self, recording: Capture) -> Float[Tensor, "frame range u v"]:
        """The measured power spectrum of a capture."""
        return recording.spectrum(self.grid).to(torch.float32)

    def for_differences(
        self, scene: Scene, sensor: Radar, samples: int, scheme: Literal["rays", "area"]
    ) -> "SurrogateMap":
        """Return the model with sampling probabilities of this scene."""
        sampling = replace(self.sampling, samples=samples, boundary_samples=0)
        return replace(self, sampling=sampling, _reference=(scene, sensor.link(), scheme))

    def realisations(self, scene: Scene, sensor: Radar, seed: int) -> Realisations | None:
        """Return spectra of one scene with other speckle and other phases of coherent targets.

        None for clouds and for smooth conductors that are not coherent targets.
        """
        whole = channel.as_absorbers(scene, self.coherent)
        rest = channel.without_specular(whole, self.mirrors)
        if not isinstance(sensor.waveform, SampledWaveform) or any(
            item.cloud is not None or item.material.coherent for item in rest.objects.values()
        ):
            return None
        fields, link = replace(self.sampling, boundary=False), sensor.link()
        how = link, self.mirrors
        paths = channel.trace_field_with_mirrors(whole, *how, sampling=fields, seed=seed)
        looks = SpeckleRealisations(paths, sensor)
        targets = [
            beat_signal(channel.trace_target(scene, name, link, sampling=fields), sensor)
            for name in self.coherent
        ]

        def simulate_beat(number: int) -> Tensor:
            generator = torch.Generator().manual_seed(derive_seed(number, 2))
            turns = 2 * math.pi * torch.rand(len(targets), generator=generator)
            total = looks.beat(derive_seed(number, 0))
            phasors = torch.polar(torch.ones_like(turns), turns)
            for phasor, target in zip(phasors, targets, strict=True):
                total = total + phasor * target.to(total)
            return total

        def to_map(beat: Tensor) -> Tensor:
            return exact_spectrum(beat, sensor, self.grid).to(torch.float32)

        shape = (*sensor.shape, sensor.waveform.samples)
        return noisy_realisations(simulate_beat, to_map, shape, seed)

    @property
    def has_blur(self) -> bool:
        """True if the surrogate blurs maps, or the phases of targets are stretched."""
        return self.kernels.has_blur or self.stretch > 1

    def scale_blur(self, fraction: float) -> "SurrogateMap":
        """Scale the additional blur widths, and the stretch beyond 1, by a factor."""
        stretch = 1 + (self.stretch - 1) * fraction
        return replace(self, surrogate=self.kernels.scale_blur(fraction), stretch=stretch)

    def blur_observed(self, observed: Tensor, sensor: Radar) -> Float[Tensor, "frame range u v"]:
        """Blur a measured spectrum by the additional widths."""
        return self.kernels.blur(observed, sensor, self.grid)


@dataclass(frozen=True)
class ExactMap(ForwardModel):
    """Power spectrum of one realisation, by the radar's own processing.

    Its loss has a minimum every half wavelength, and rough surfaces need
    ``Sampling(boundary=False)``. Use it for comparisons and data.

    Attributes:
        grid: Bins, see ``Radar.grid``.
        sampling: Sampling of paths.
        speckle: Points of rough surfaces and paths with their phases, which are unknown for
            measured data; None = drawn from the seed.
    """

    grid: channel.Grid
    sampling: channel.Sampling = channel.Sampling()
    speckle: channel.Speckle | None = None

    redraws: ClassVar[bool] = False
    is_smooth: ClassVar[bool] = False

    def predict(self, scene: Scene, sensor: Radar, seed: int) -> Float[Tensor, "frame range u v"]:
        """Predict the spectrum of the exact beat signals. See ``ForwardModel.predict``."""
        found = simulate(
            scene, sensor, self.grid, seed=seed, sampling=self.sampling, speckle=self.speckle
        )
        return found.spectrum.to(torch.float32)

    def observe(self, recording: Capture) -> Float[Tensor, "frame range u v"]:
        """The measured power spectrum of a capture."""
        return recording.spectrum(self.grid).to(torch.float32)

    def with_sampling(self, **changes: Any) -> "ForwardModel":
        """Return the model with other fields of its ``sampling``.

        ``samples`` is the number of samples of conductors here.
        """
        if "samples" in changes:
            changes["conductor_samples"] = changes.pop("samples")
        return super().with_sampling(**changes)

    def prepare(self, scene: Scene, sensor: Radar, seed: int) -> "ExactMap":
        """Return the model with fixed points of rough surfaces."""
        if self.speckle is not None:
            return self
        speckle = channel.draw_speckle(scene, sensor.link(), self.sampling, seed)
        return replace(self, speckle=speckle)


@dataclass(frozen=True)
class BeatMap(ExactMap):
    """Exact complex beat signals, before any spectrum.

    Attributes:
        channels: Slices of transmitters and receivers of the map.
    """

    channels: tuple[slice, slice] = (slice(None), slice(None))

    def predict(self, scene: Scene, sensor: Radar, seed: int) -> Tensor:
        """Predict beat signals [frame, tx, rx, sample]. See ``ForwardModel.predict``."""
        paths = channel.trace_field(
            scene, sensor.link(), sampling=self.sampling, seed=seed, speckle=self.speckle
        )
        return beat_signal(paths, sensor, channels=self.channels)

    def observe(self, recording: Capture) -> Tensor:
        """Return the recorded beat signals of these channels."""
        return recording.beat[(slice(None), *self.channels)]


def surrogate_correlation(
    scene: Scene, radar: Radar, model: SurrogateMap, *, seed: int, realisations: int = 16
) -> float:
    """Correlation of a surrogate's map with the mean exact spectrum over several realisations.

    Each realisation has its own phases of the rough surfaces. One realisation has speckle as strong
    as the map itself. A scene of conductors has no speckle: all its realisations are equal.

    Args:
        scene: Scene to trace.
        radar: Arrays, waveform and poses.
        model: Surrogate model; its ``sampling`` is also used for the exact spectra.
        seed: Seed of the first realisation, and of the surrogate's samples.
        realisations: Number of averaged exact spectra.

    Returns:
        Pearson correlation over all bins and frames; 0 if a map is constant.

    Raises:
        InputError: No realisations.
    """
    checked_count(realisations, "realisations", 1)
    if all(item.material.coherent for item in scene.objects.values()):
        realisations = 1
    exact = ExactMap(model.grid, model.sampling)
    with torch.no_grad():
        mean = torch.zeros(radar.frame_count, *model.grid.shape, dtype=torch.float64)
        for look in range(realisations):
            mean += exact.predict(scene, radar, seed + look) / realisations
        a, b = (p.double() - p.double().mean() for p in (mean, model.predict(scene, radar, seed)))
        norms = a.norm() * b.norm()
    return float((a * b).sum() / norms) if norms > 0 else 0.0
