"""Forward models: what a sensor would show of a scene, and a recording in the same form.

A model is a frozen value. ``predict`` maps a scene and a sensor to a map, ``observe`` maps a
recording to a map of the same shape; a loss compares the two. A model of one's own derives from
:class:`ForwardModel` and has these two methods; ``reconstruct`` and ``gradcheck`` take it.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Literal

import torch
from annotated_types import Ge
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from invertwin.camera import Camera, ImageSampling, depths, silhouettes
from invertwin.capture.capture import Capture
from invertwin.capture.chirp_capture import ChirpCapture
from invertwin.channel import (
    Grid,
    Paths,
    Sampling,
    Speckle,
    draw_speckle,
    trace_chains,
    trace_field,
    trace_power,
    trace_target,
    without_echoes,
)
from invertwin.checks import ArrayLike, checked_number, checked_tensor
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel
from invertwin.limits import Positive
from invertwin.links.metasurface.panel import Metasurface, panel_response
from invertwin.links.places import Places
from invertwin.links.received import Received, Reception
from invertwin.links.transmitters import Transmitters
from invertwin.radar.doppler import range_doppler_angle, velocity_axis
from invertwin.radar.looks import Looks
from invertwin.radar.motion import Chirps
from invertwin.radar.moving_power import moving_power
from invertwin.radar.radar import Radar
from invertwin.radar.range_profile import beat_signal, range_profile
from invertwin.radar.spectrum import exact_spectrum
from invertwin.radar.surrogate import (
    Surrogate,
    chosen_surrogate,
    surrogate_spectra,
    surrogate_spectrum,
)
from invertwin.radar.waveform import SampledWaveform
from invertwin.scene.scene import Scene
from invertwin.seeds import derived_seed
from invertwin.signatures import Signature
from invertwin.simulation import simulate


@dataclass(frozen=True)
class SurrogateMap(ForwardModel):
    """Expected power over range and direction, smooth in the scene's parameters.

    Attributes:
        grid: Bins, see ``Radar.grid``.
        surrogate: Kernels and extra widths, or a name among ``SURROGATES``.
        sampling: How paths are sampled.
        coherent: Names of coherent targets: smooth conductors of at most 24 triangles each, such as
            corner reflectors, whose bounces add in field. A smooth conductor that is not named
            is a narrow lobe, whose bounces add in power: a corner is then some 10 dB too weak.
        stretch: Wavelength of the targets' phases at the start of a fit, in wavelengths of the
            radar. Lobes of plates and dihedrals are wider by it, with the same peaks.

    Raises:
        InputError: An unknown name, or "exact", which is ``ExactMap``; a stretch below 1, or one
            without targets.
    """

    grid: Grid
    surrogate: Surrogate | str = "response"
    sampling: Sampling = Sampling()
    coherent: Sequence[str] = ()
    stretch: Annotated[float, Ge(1)] = 1.0
    _reference: tuple[Scene, Radar, Literal["rays", "area"]] | None = field(
        default=None, repr=False
    )

    def __post_init__(self) -> None:
        chosen = chosen_surrogate(self.surrogate)
        if chosen is None:
            raise InputError(
                'expected a surrogate for a SurrogateMap, got "exact"; use ExactMap(grid)'
            )
        object.__setattr__(self, "surrogate", chosen)
        if isinstance(self.coherent, str):
            raise InputError(
                f"expected a list of names of coherent targets, got {self.coherent!r}; give "
                f"coherent=[{self.coherent!r}]"
            )
        object.__setattr__(self, "coherent", tuple(self.coherent))
        if not 1 <= self.stretch < math.inf or (self.stretch > 1 and not self.coherent):
            raise InputError(
                f"expected a stretch >= 1 of coherent targets, got {self.stretch} and "
                f"{len(self.coherent)} targets; give coherent=[...], or stretch=1"
            )

    @property
    def kernels(self) -> Surrogate:
        """The surrogate as a value."""
        assert isinstance(self.surrogate, Surrogate)
        return self.surrogate

    def predict(self, scene: Scene, sensor: Radar, seed: int) -> Float[Tensor, "frame range u v"]:
        """The expected power spectrum. See ``ForwardModel.predict``."""
        scheme: Literal["rays", "area"] = "rays"
        reference = None
        if self._reference is not None:
            fixed, device, scheme = self._reference
            reference = (fixed, device.link())
        return surrogate_spectrum(
            scene,
            sensor,
            self.grid,
            self.kernels,
            sampling=self.sampling,
            seed=seed,
            scheme=scheme,
            reference=reference,
            coherent=self.coherent,
            stretch=self.stretch,
        )

    def predict_batch(
        self, scenes: Sequence[Scene], sensor: Radar, seed: int
    ) -> Float[Tensor, "scene frame range u v"]:
        """``predict`` of many scenes at once, in one launch: fast where samples are few.

        Gradients flow to every scene, and to the sensor. Scenes have nothing in common but the
        sensor: they may share tensors, or have objects of their own. See ``deposit_batch``.

        Args:
            scenes: What is seen, such as the variants of one scene in a training step.
            sensor: What sees each of them, with its poses.
            seed: Same seed and scenes, same maps.

        Raises:
            InputError: No scenes, clouds, or a model made for differences.
        """
        if self._reference is not None:
            raise InputError(
                "expected a model for predictions, got one that was made for differences of one "
                "scene; use predict, or the model that for_differences was called of"
            )
        return surrogate_spectra(
            scenes,
            sensor,
            self.grid,
            self.kernels,
            sampling=self.sampling,
            seed=seed,
            coherent=self.coherent,
            stretch=self.stretch,
        )

    def observe(self, recording: Capture) -> Float[Tensor, "frame range u v"]:
        """The measured power spectrum of a capture."""
        return recording.spectrum(self.grid).to(torch.float32)

    def for_differences(
        self, scene: Scene, sensor: Radar, samples: int, scheme: Literal["rays", "area"]
    ) -> "SurrogateMap":
        """The model with sampling probabilities that belong to this scene."""
        sampling = replace(self.sampling, samples=samples, boundary_samples=0)
        return replace(self, sampling=sampling, _reference=(scene, sensor, scheme))

    def looks(
        self, scene: Scene, sensor: Radar, seed: int
    ) -> Callable[[int, float], Tensor] | None:
        """Spectra of one scene with other speckle, and another phase of every coherent target.

        None for clouds and for smooth conductors that are no targets.
        """
        rest = without_echoes(scene, self.coherent)
        if not isinstance(sensor.waveform, SampledWaveform) or any(
            item.cloud is not None or item.material.coherent for item in rest.objects.values()
        ):
            return None
        fields, link = replace(self.sampling, boundary=False), sensor.link()
        looks = Looks(trace_field(rest, link, sampling=fields, seed=seed), sensor)
        targets = [
            beat_signal(trace_target(scene, name, link, sampling=fields), sensor)
            for name in self.coherent
        ]

        def beat(number: int) -> Tensor:
            generator = torch.Generator().manual_seed(derived_seed(number, 2))
            turns = 2 * math.pi * torch.rand(len(targets), generator=generator)
            total = looks.beat(derived_seed(number, 0))
            for turn, target in zip(
                torch.polar(torch.ones_like(turns), turns), targets, strict=True
            ):
                total = total + turn * target.to(total)
            return total

        return _noisy(
            beat,
            lambda beat: exact_spectrum(beat, sensor, self.grid).to(torch.float32),
            sensor,
            seed,
        )

    @property
    def widened(self) -> bool:
        """Whether the surrogate has extra widths, or targets a longer wavelength."""
        return self.kernels.widened or self.stretch > 1

    def narrowed(self, share: float) -> "SurrogateMap":
        """The surrogate with this share of its extra widths and of its stretch beyond 1."""
        stretch = 1 + (self.stretch - 1) * share
        return replace(self, surrogate=self.kernels.narrowed(share), stretch=stretch)

    def blurred(self, observed: Tensor, sensor: Radar) -> Float[Tensor, "frame range u v"]:
        """A measured spectrum with the extra widths."""
        return self.kernels.blur(observed, sensor, self.grid)


def _noisy(
    beat_of: Callable[[int], Tensor],
    shown: Callable[[Tensor], Tensor],
    sensor: Radar,
    seed: int,
    *,
    fields: bool = False,
) -> Callable[[int, float], Tensor]:
    """Looks with noise: a function of their number gives beat signals, another shows them."""
    assert isinstance(sensor.waveform, SampledWaveform)
    shape = (*sensor.shape, sensor.waveform.samples)

    def white(key: int) -> Tensor:
        generator = torch.Generator().manual_seed(key)
        return torch.randn(shape, dtype=torch.complex64, generator=generator)

    whole = shown(white(seed))
    share = float((whole.square() if fields else whole).mean())

    def look(number: int, noise: float) -> Tensor:
        return shown(beat_of(number) + (noise / share) ** 0.5 * white(derived_seed(number, 1)))

    return look


@dataclass(frozen=True)
class ChainMap(ForwardModel):
    """The power spectrum of a few flat conductors that mirror one another: |sum of fields|².

    Chains of a corner reflector add in phase, as in a ``SurrogateMap`` that names it ``coherent``,
    which serves scenes with rough things, too. There are no samples and no speckle: the map is
    smooth in the pose, corners and beams' edges included, as long as one chain or one corner
    dominates each cell; echoes of several targets in one cell interfere, with a minimum every half
    wavelength.

    Attributes:
        grid: Bins, see ``Radar.grid``.
        surrogate: Extra widths, which are zero at the end of a fit; its kernels do not count.
        sampling: Most bounces; nothing else counts.
    """

    grid: Grid
    surrogate: Surrogate = field(default_factory=Surrogate)
    sampling: Sampling = Sampling()

    redraws: ClassVar[bool] = False

    def _beat(self, scene: Scene, sensor: Radar) -> Tensor:
        return beat_signal(trace_chains(scene, sensor.link(), self.sampling.depth), sensor)

    def _shown(self, beat: Tensor, sensor: Radar) -> Tensor:
        return exact_spectrum(beat, sensor, self.grid).to(torch.float32)

    def predict(self, scene: Scene, sensor: Radar, seed: int) -> Float[Tensor, "frame range u v"]:
        """The spectrum of the chains. See ``ForwardModel.predict`` and ``trace_chains``."""
        return self.blurred(self._shown(self._beat(scene, sensor), sensor), sensor)

    def observe(self, recording: Capture) -> Float[Tensor, "frame range u v"]:
        """The measured power spectrum of a capture."""
        return recording.spectrum(self.grid).to(torch.float32)

    def looks(
        self, scene: Scene, sensor: Radar, seed: int
    ) -> Callable[[int, float], Tensor] | None:
        """The map with other noise each time; None for waveforms without samples."""
        if not isinstance(sensor.waveform, SampledWaveform):
            return None
        beat = self._beat(scene, sensor)
        return _noisy(
            lambda _: beat,
            lambda signal: self._shown(signal, sensor),
            sensor,
            seed,
            fields=self.fields,
        )

    @property
    def widened(self) -> bool:
        """Whether there are extra widths."""
        return self.surrogate.widened

    def narrowed(self, share: float) -> "ChainMap":
        """The model with this share of its extra widths."""
        return replace(self, surrogate=self.surrogate.narrowed(share))

    def blurred(self, observed: Tensor, sensor: Radar) -> Float[Tensor, "frame range u v"]:
        """A map with the extra widths."""
        return self.surrogate.blur(observed, sensor, self.grid)


@dataclass(frozen=True)
class ChainField(ChainMap):
    """The complex range profiles of a few flat conductors that mirror one another.

    The phase tells the range to parts of a wavelength. So its loss has a minimum every half
    wavelength: it refines what a ``ChainMap`` has found to a tenth of a wavelength in range, in a
    later stage of a fit. Maps hold real and imaginary parts; compare them by a ``SpectrumLoss`` of
    kind ``mse`` with one level. The radar's phase is calibrated.
    """

    fields: ClassVar[bool] = True

    def _shown(self, beat: Tensor, sensor: Radar) -> Tensor:
        profile = range_profile(beat.to(torch.complex128), sensor, self.grid)
        return torch.view_as_real(profile.flatten(1, 2).mT).contiguous()

    def predict(
        self, scene: Scene, sensor: Radar, seed: int
    ) -> Float[Tensor, "frame range channel part"]:
        """The range profiles of the chains. See ``ForwardModel.predict`` and ``trace_chains``."""
        return super().predict(scene, sensor, seed)

    def observe(self, recording: Capture) -> Float[Tensor, "frame range channel part"]:
        """The measured range profiles of a capture."""
        return self._shown(recording.beat, recording.radar())

    @property
    def widened(self) -> bool:
        """Fields have no extra widths."""
        return False

    def blurred(self, observed: Tensor, sensor: Radar) -> Tensor:
        """A map as it is."""
        return observed


@dataclass(frozen=True)
class ExactMap(ForwardModel):
    """The power spectrum of one realisation, as the radar itself computes it.

    Its loss has a minimum every half wavelength, and rough surfaces need
    ``Sampling(boundary=False)``. It serves comparisons and data.

    Attributes:
        grid: Bins, see ``Radar.grid``.
        sampling: How paths are sampled.
        speckle: Rough points and paths with their phases, which are unknown for real data; None =
            drawn from the seed.
    """

    grid: Grid
    sampling: Sampling = Sampling()
    speckle: Speckle | None = None

    redraws: ClassVar[bool] = False
    smooth: ClassVar[bool] = False

    def predict(self, scene: Scene, sensor: Radar, seed: int) -> Float[Tensor, "frame range u v"]:
        """The spectrum of the exact beat signals. See ``ForwardModel.predict``."""
        found = simulate(
            scene, sensor, self.grid, seed=seed, sampling=self.sampling, speckle=self.speckle
        )
        return found.spectrum.to(torch.float32)

    def observe(self, recording: Capture) -> Float[Tensor, "frame range u v"]:
        """The measured power spectrum of a capture."""
        return recording.spectrum(self.grid).to(torch.float32)

    def prepared(self, scene: Scene, sensor: Radar, seed: int) -> "ExactMap":
        """The model with rough points that stay while the scene moves."""
        if self.speckle is not None:
            return self
        return replace(self, speckle=draw_speckle(scene, sensor.link(), self.sampling, seed))


@dataclass(frozen=True)
class BeatMap(ExactMap):
    """The exact beat signals themselves, before any spectrum. They are complex.

    Attributes:
        channels: Transmitters and receivers whose signals are shown.
    """

    channels: tuple[slice, slice] = (slice(None), slice(None))

    def predict(self, scene: Scene, sensor: Radar, seed: int) -> Tensor:
        """The beat signals [frame, tx, rx, sample]. See ``ForwardModel.predict``."""
        paths = trace_field(
            scene, sensor.link(), sampling=self.sampling, seed=seed, speckle=self.speckle
        )
        return beat_signal(paths, sensor, channels=self.channels)

    def observe(self, recording: Capture) -> Tensor:
        """The recorded beat signals of these channels."""
        return recording.beat[(slice(None), *self.channels)]


@dataclass(frozen=True, eq=False)
class MotionMap(ForwardModel):
    """Power over range rate, range and direction of what moves.

    What stands still is taken out of a recording as the mean over the chirps; so a prediction
    holds the objects with a velocity alone. Other objects hide them. A silhouette has no boundary
    term: a rough convex body goes dark towards its edge.

    Attributes:
        grid: Ranges and directions.
        chirps: Timing of the ramps.
        rates: Range rates to show, positive moves away [m/s]; some of those of ``bins``.
        bins: Bins of range rate over the whole unambiguous span.
        sampling: How paths are sampled; one bounce, fixed visibility.
    """

    grid: Grid
    chirps: Chirps
    rates: Float64[Tensor, " velocity"]
    bins: int
    sampling: Sampling = Sampling(depth=1, boundary=False)

    @classmethod
    def of(
        cls,
        radar: Radar,
        grid: Grid,
        chirps: Chirps,
        oversample: int = 2,
        sampling: Sampling | None = None,
    ) -> "MotionMap":
        """All range rates that the chirps tell apart.

        Args:
            radar: What records.
            grid: Ranges and directions.
            chirps: Timing of the ramps.
            oversample: Bins of range rate per cell.
            sampling: How paths are sampled.
        """
        bins = oversample * chirps.count
        rates = velocity_axis(radar, chirps, bins)
        return cls(grid, chirps, rates, bins, sampling or cls.sampling)

    def __post_init__(self) -> None:
        if self.sampling.depth != 1 or self.sampling.boundary:
            raise InputError(
                "expected Sampling(depth=1, boundary=False) for a MotionMap, got depth "
                f"{self.sampling.depth} and boundary {self.sampling.boundary}; moving paths have "
                "one bounce and fixed visibility"
            )

    def predict(
        self, scene: Scene, sensor: Radar, seed: int
    ) -> Float[Tensor, "frame velocity range u v"]:
        """The expected power of what moves. See ``ForwardModel.predict``.

        Raises:
            InputError: No object has a velocity.
        """
        if all(item.velocity is None for item in scene.objects.values()):
            raise InputError(
                "expected an object with a velocity for a MotionMap, got none; give one a "
                "velocity, or fit a MovingBody"
            )
        paths = trace_power(scene, sensor.link(), sampling=self.sampling, seed=seed)
        assert paths.velocity is not None
        moves = (paths.velocity.detach() != 0).any(1)
        return self.expected(paths.chosen(moves), sensor)

    def expected(self, paths: Paths, radar: Radar) -> Float[Tensor, "frame velocity range u v"]:
        """What moving paths look like in this map. See ``moving_power``.

        Args:
            paths: With velocities.
            radar: What records them.
        """
        assert paths.velocity is not None
        return moving_power(paths, paths.velocity, radar, self.grid, self.chirps, self.rates)

    def observe(self, recording: ChirpCapture) -> Float[Tensor, "frame velocity range u v"]:
        """The measured power of what moves.

        Raises:
            InputError: A recording of another number of chirps.
        """
        beat, radar = recording.beat, recording.radar()
        moving = (beat - beat.mean(1, keepdim=True)).to(torch.complex128)
        power = range_doppler_angle(moving, radar, self.grid, self.chirps, bins=self.bins)
        every = velocity_axis(radar, self.chirps, self.bins)
        rows = (every - self.rates[:, None]).abs().argmin(1)
        return power[:, rows]

    def around(self, range_: float, rate: float, cells: int, radar: Radar) -> "MotionMap":
        """The cells at most so many range and Doppler cells from an echo, in all directions.

        Args:
            range_: Of the echo [m].
            rate: Range rate of the echo [m/s].
            cells: To either side.
            radar: What records.
        """
        doppler = velocity_axis(radar, self.chirps).diff()[0] if self.chirps.count > 1 else math.inf
        near = (self.grid.ranges - range_).abs() / radar.waveform.range_resolution
        slow = (self.rates - rate).abs() / doppler
        ranges, rates = (torch.nonzero(d <= cells)[:, 0] for d in (near, slow))
        if not len(ranges) or not len(rates):
            raise InputError(
                f"expected an echo within the map, got one at {range_:.3g} m and {rate:.3g} m/s; "
                "widen the grid"
            )
        start, count = float(self.grid.ranges[ranges[0]]), len(ranges)
        grid = replace(self.grid, range_start=start, range_count=count)
        return replace(self, grid=grid, rates=self.rates[rates])


@dataclass(frozen=True)
class SignatureMap(ForwardModel):
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
    random: ClassVar[bool] = False

    def predict(
        self, scene: Scene, sensor: Any, seed: int
    ) -> Float64[Tensor, "frequency aspect 2 2"]:
        """σ [m²], receive × transmit. See ``ForwardModel.predict``."""
        return self.signature(scene, boundary=self.boundary).section

    def observe(self, recording: Signature) -> Float64[Tensor, "frequency aspect 2 2"]:
        """σ of a signature [m²]."""
        return recording.section

    def ablations(self) -> dict[str, ForwardModel]:
        """The model at fixed visibility. See ``ForwardModel.ablations``."""
        return {"boundary": replace(self, boundary=False)} if self.boundary else {}


@dataclass(frozen=True, eq=False)
class PanelMap(ForwardModel):
    """The path gain of receivers over a metasurface alone; the sensor is the metasurface.

    Attributes:
        tx: The transmitter [m].
        receivers: [rx, 3] [m].
        frequency: [Hz].
        boundary: False leaves out of derivatives that shadows move over the panel.
    """

    tx: Float64[Tensor, "3"]
    receivers: Float64[Tensor, "rx 3"]
    frequency: float
    boundary: bool = True

    redraws: ClassVar[bool] = False
    random: ClassVar[bool] = False

    def predict(self, scene: Scene, sensor: Metasurface, seed: int) -> Float64[Tensor, "1 rx"]:
        """|Σ|² of the elements. See ``panel_response``."""
        found = panel_response(
            scene, sensor, self.tx[None], self.receivers, self.frequency, boundary=self.boundary
        )
        return found.real.square() + found.imag.square()

    def observe(self, recording: Tensor) -> Float64[Tensor, "1 rx"]:
        """Measured path gains, over the panel alone."""
        return recording.reshape(1, -1)

    def ablations(self) -> dict[str, ForwardModel]:
        """The model at fixed shadows. See ``ForwardModel.ablations``."""
        return {"boundary": replace(self, boundary=False)} if self.boundary else {}


QUANTITIES = ("received_power", "path_gain", "gain", "sinr", "delay_spread")
"""What a ``RadioMap`` may show."""


@dataclass(frozen=True, eq=False)
class RadioMap(ForwardModel):
    """What receivers at known places get of transmitters: a map for each of these.

    Levels are in decibels; compare them by ``SpectrumLoss(levels=1, gain="one")``, with
    ``background="level"`` where the sent power is not known. A floor is added to every gain, so
    that levels and derivatives are finite where no path leads.

    Attributes:
        places: Where receivers are.
        reception: How paths are found, and how they add up.
        quantity: ``received_power`` [dBm], ``path_gain`` [dB], ``gain``: the same as a ratio
            without a floor, ``sinr`` [dB]: received power of a transmitter over that of all others
            and noise, or ``delay_spread`` [s].
        floor_db: Path gain that is added to every one [dB].
        noise_dbm: Of a receiver, for ``sinr`` [dBm].
        scatter: Standard deviation of data about the map, in its unit, where it is known. Error
            bars and verdicts draw from it; None = as large as what a fit leaves unexplained.
        without: Names of objects that the model leaves out. In a first, coarse stage of a fit, what
            hides a transmitter would keep it from where it belongs.

    Raises:
        InputError: An unknown quantity, or a number out of range.
    """

    places: Places
    reception: Reception
    quantity: Literal["received_power", "path_gain", "gain", "sinr", "delay_spread"] = (
        "received_power"
    )
    floor_db: float = -200.0
    noise_dbm: float = -100.0
    scatter: float | None = None
    without: Sequence[str] = ()

    redraws: ClassVar[bool] = False
    fields: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self.quantity not in QUANTITIES:
            raise InputError(
                f"expected a quantity among {', '.join(QUANTITIES)}, got {self.quantity!r}; "
                "choose one"
            )
        checked_number(self.floor_db, "floor [dB]", -math.inf)
        checked_number(self.noise_dbm, "noise [dBm]", -math.inf)
        if self.scatter is not None:
            checked_number(self.scatter, "scatter of data", 0.0)

    def received(self, scene: Scene, sensor: Transmitters, seed: int) -> Received:
        """Gain and delay spread, before any decibels.

        Args:
            scene: What is in the way.
            sensor: What sends.
            seed: Of the rays that find paths.

        Raises:
            InputError: No object of a name that is left out.
        """
        if self.without:
            unknown = sorted(set(self.without) - set(scene.names))
            if unknown:
                raise InputError(
                    f"expected names of objects in without ({', '.join(scene.names)}), got "
                    f"{unknown[0]}; correct it",
                    "without",
                )
            kept = {n: o for n, o in scene.objects.items() if n not in self.without}
            scene = replace(scene, objects=kept)
        return self.places.received(scene, sensor, self.reception, seed)

    def predict(self, scene: Scene, sensor: Transmitters, seed: int) -> Float64[Tensor, "tx *map"]:
        """The quantity of every transmitter. See ``ForwardModel.predict``."""
        found = self.received(scene, sensor, seed)
        if self.quantity == "delay_spread":
            return found.delay_spread
        if self.quantity == "gain":
            return found.gain
        gain = found.gain + 10 ** (self.floor_db / 10)
        if self.quantity == "path_gain":
            return 10 * gain.log10()
        power = gain * sensor.powers.reshape(-1, *[1] * (gain.ndim - 1))
        if self.quantity == "sinr":
            power = power / (power.sum(0) - power + 10 ** (self.noise_dbm / 10))
        return 10 * power.log10()

    def observe(self, recording: ArrayLike) -> Float64[Tensor, "tx *map"]:
        """Measured values [tx, …], or those of a single transmitter […].

        Raises:
            InputError: Another shape, or NaN.
        """
        shape, given = self.places.shape, torch.as_tensor(recording, dtype=torch.float64)
        given = given[None] if given.ndim == len(shape) else given
        what = f"measured {self.quantity.replace('_', ' ')}"
        return checked_tensor(given, (None, *shape), what, "give a map for each transmitter")

    def looks(
        self, scene: Scene, sensor: Transmitters, seed: int
    ) -> Callable[[int, float], Tensor]:
        """The map with other errors of measurement each time."""
        return self.looks_about(self.predict(scene, sensor, seed))

    def looks_about(self, mean: Float64[Tensor, "tx *map"]) -> Callable[[int, float], Tensor]:
        """A map with other errors of measurement each time, see ``ForwardModel.looks``.

        Args:
            mean: The map without errors.
        """
        return _scattered(mean, self.scatter)

    def best_server(self, scene: Scene, sensor: Transmitters, seed: int) -> Int64[Tensor, "*map"]:
        """Number of the transmitter of which most power arrives; −1 where none arrives.

        Args:
            scene: What is in the way.
            sensor: What sends.
            seed: As for ``predict``.
        """
        gain = self.received(scene, sensor, seed).gain
        most, number = (gain * sensor.powers.reshape(-1, *[1] * (gain.ndim - 1))).max(0)
        return torch.where(most > 0, number, -1)

    @property
    def random(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether points are drawn, as those of cells are, or scattered paths."""
        return self.places.random or self.reception.rough is not None

    def for_differences(
        self, scene: Scene, sensor: Transmitters, samples: int, scheme: Literal["rays", "area"]
    ) -> "RadioMap":
        """The model with so many points on the cells, and so many scattered paths."""
        reception, rough = self.reception, self.reception.rough
        if rough is not None:
            finer = replace(rough, samples=samples, boundary=False)
            reception = replace(reception, rough=finer)
        return replace(self, places=self.places.finer(samples), reception=reception)

    def ablations(self) -> dict[str, ForwardModel]:
        """The model at fixed visibility: without diffraction, or without boundary paths of cells.

        See ``ForwardModel.ablations``.
        """
        fixed = self.places.fixed_visibility()
        rough = self.reception.rough
        moves = rough is not None and rough.boundary
        if fixed is None and not self.reception.edges and not moves:
            return {}
        if rough is not None:
            rough = replace(rough, boundary=False)
        # In cells without diffraction, powers add.
        bandwidth = self.reception.bandwidth if fixed is None else None
        reception = replace(self.reception, edges=0, bandwidth=bandwidth, rough=rough)
        return {"boundary": replace(self, places=fixed or self.places, reception=reception)}


@dataclass(frozen=True, eq=False)
class ResponseMap(ForwardModel):
    """Complex responses H(f) between transmitters and receivers at known places.

    Their phase tells the length of paths to parts of a wavelength, so that the loss has a minimum
    every half wavelength of a place. Materials, which hardly turn phases, are found from anywhere.
    Maps hold real and imaginary parts; compare them by ``SpectrumLoss(levels=1, gain="one")``.

    Attributes:
        positions: Of the receivers, [place, 3] [m].
        frequencies: Of the responses [Hz].
        reception: How paths are found; its bandwidth does not count.
        scatter: Standard deviation of data about the map, of each part; None = as large as what a
            fit leaves unexplained.
    """

    positions: Float64[Tensor, "place 3"]
    frequencies: Float64[Tensor, " frequency"]
    reception: Reception
    scatter: float | None = None

    redraws: ClassVar[bool] = False
    random: ClassVar[bool] = False
    fields: ClassVar[bool] = True

    def __post_init__(self) -> None:
        do = "give a row of x, y, z for each"
        places = checked_tensor(self.positions, (None, 3), "positions of receivers [m]", do)
        swept = checked_tensor(
            torch.atleast_1d(torch.as_tensor(self.frequencies, dtype=torch.float64)),
            (None,),
            "frequencies [Hz]",
            "give one or several",
        )
        object.__setattr__(self, "positions", places)
        object.__setattr__(self, "frequencies", swept)

    def predict(
        self, scene: Scene, sensor: Transmitters, seed: int
    ) -> Float64[Tensor, "tx place frequency part"]:
        """The responses of the first elements. See ``ForwardModel.predict``."""
        found = self.reception.responses(scene, sensor, self.positions, self.frequencies, seed)
        return torch.view_as_real(found)

    def observe(self, recording: Tensor) -> Float64[Tensor, "tx place frequency part"]:
        """Measured complex responses [tx, place, frequency].

        Raises:
            InputError: Another shape, or NaN.
        """
        given = torch.as_tensor(recording, dtype=torch.complex128)
        shape = (None, len(self.positions), len(self.frequencies), 2)
        do = "give complex numbers [tx, place, frequency]"
        return checked_tensor(torch.view_as_real(given), shape, "measured responses", do)

    def looks(
        self, scene: Scene, sensor: Transmitters, seed: int
    ) -> Callable[[int, float], Tensor]:
        """The responses with other noise each time."""
        return _scattered(self.predict(scene, sensor, seed), self.scatter)


@dataclass(frozen=True)
class SilhouetteMap(ForwardModel):
    """Masks of some objects as a camera sees them: 1 inside, 0 outside, between at their outlines.

    Compare them by ``SpectrumLoss(gain="one")``. Masks of several objects are several observations.

    Attributes:
        objects: Names of the objects that the mask shows; others may hide them.
        sampling: Of pixels and outlines.
        scatter: Standard deviation of measured masks about the map; None = as large as what a fit
            leaves unexplained.
    """

    objects: tuple[str, ...]
    sampling: ImageSampling = field(default_factory=ImageSampling)
    scatter: float | None = None

    fields: ClassVar[bool] = True

    def predict(
        self, scene: Scene, sensor: Camera, seed: int
    ) -> Float64[Tensor, "frame row column"]:
        """The masks. See ``ForwardModel.predict``."""
        return silhouettes(scene, sensor, self.objects, self.sampling, seed)

    def observe(self, recording: ArrayLike) -> Float64[Tensor, "frame row column"]:
        """Measured masks, [frame, row, column] or [row, column], from 0 to 1.

        Raises:
            InputError: Another shape, NaN, or values outside of 0 to 1.
        """
        found = _images(recording, "masks")
        if len(found.flatten()) and not 0 <= float(found.min()) <= float(found.max()) <= 1:
            raise InputError(
                f"expected masks from 0 to 1, got {float(found.min()):g} to "
                f"{float(found.max()):g}; divide bytes by 255"
            )
        return found

    def looks(self, scene: Scene, sensor: Camera, seed: int) -> Callable[[int, float], Tensor]:
        """The masks with other errors each time."""
        return _scattered(self.predict(scene, sensor, seed), self.scatter)

    def for_differences(
        self, scene: Scene, sensor: Camera, samples: int, scheme: Literal["rays", "area"]
    ) -> "SilhouetteMap":
        """More rays in every pixel. See ``ForwardModel.for_differences``."""
        return replace(self, sampling=_finer(self.sampling, sensor, samples))

    def ablations(self) -> dict[str, ForwardModel]:
        """The model with outlines at rest. See ``ForwardModel.ablations``."""
        return {"boundary": self.sampled_by(boundary=False)} if self.sampling.boundary else {}


@dataclass(frozen=True)
class DepthMap(ForwardModel):
    """Depth images of a camera: the mean over each pixel of z in camera axes [m].

    Compare them by ``SpectrumLoss(gain="one")``.

    Attributes:
        far: Depth where nothing is seen, or what is further away [m].
        sampling: Of pixels and outlines.
        scatter: Standard deviation of measured depths about the map [m]; None = as large as what a
            fit leaves unexplained.
    """

    far: Positive
    sampling: ImageSampling = field(default_factory=ImageSampling)
    scatter: float | None = None

    fields: ClassVar[bool] = True

    def predict(
        self, scene: Scene, sensor: Camera, seed: int
    ) -> Float64[Tensor, "frame row column"]:
        """The depths. See ``ForwardModel.predict``."""
        return depths(scene, sensor, self.far, self.sampling, seed)

    def observe(self, recording: ArrayLike) -> Float64[Tensor, "frame row column"]:
        """Measured depths, [frame, row, column] or [row, column] [m], at most ``far``.

        Raises:
            InputError: Another shape, or NaN.
        """
        given = torch.as_tensor(recording, dtype=torch.float64)
        return _images(given.clamp_max(self.far), "depths [m]")

    def looks(self, scene: Scene, sensor: Camera, seed: int) -> Callable[[int, float], Tensor]:
        """The depths with other errors each time."""
        return _scattered(self.predict(scene, sensor, seed), self.scatter)

    def for_differences(
        self, scene: Scene, sensor: Camera, samples: int, scheme: Literal["rays", "area"]
    ) -> "DepthMap":
        """More rays in every pixel. See ``ForwardModel.for_differences``."""
        return replace(self, sampling=_finer(self.sampling, sensor, samples))

    def ablations(self) -> dict[str, ForwardModel]:
        """The model with outlines at rest. See ``ForwardModel.ablations``."""
        return {"boundary": self.sampled_by(boundary=False)} if self.sampling.boundary else {}


def _images(recording: ArrayLike, what: str) -> Tensor:
    given = torch.as_tensor(recording, dtype=torch.float64)
    given = given[None] if given.ndim == 2 else given
    return checked_tensor(given, (None, None, None), what, "give [frame, row, column]")


def _finer(sampling: ImageSampling, camera: Camera, samples: int) -> ImageSampling:
    pixels = len(camera.positions) * camera.width * camera.height
    return replace(sampling, samples=max(sampling.samples, samples // pixels))


def _scattered(mean: Tensor, scatter: float | None) -> Callable[[int, float], Tensor]:
    """Looks at a map with white errors: of a known deviation, or of the mean square asked for."""
    mean = mean.detach()

    def look(number: int, noise: float) -> Tensor:
        generator = torch.Generator().manual_seed(number)
        errors = torch.randn(mean.shape, dtype=mean.dtype, generator=generator)
        return mean + (noise**0.5 if scatter is None else scatter) * errors

    return look


def surrogate_correlation(
    scene: Scene, radar: Radar, model: SurrogateMap, *, seed: int, looks: int = 16
) -> float:
    """Correlation of a surrogate's map with the mean exact spectrum over several looks.

    A look has its own phases of the rough surfaces. One look has speckle as strong as the map
    itself. A scene of conductors has no speckle: all its looks are equal.

    Args:
        scene: What is seen.
        radar: Arrays, waveform and poses.
        model: The surrogate; its ``sampling`` serves the exact spectra too.
        seed: Of the first look, and of the surrogate's samples.
        looks: Exact spectra that are averaged.

    Returns:
        Pearson's correlation over all bins and frames; 0 where a map is constant.

    Raises:
        InputError: No looks.
    """
    if looks < 1:
        raise InputError(
            f"expected looks >= 1, got {looks}; 16 looks leave a quarter of the speckle"
        )
    if all(item.material.coherent for item in scene.objects.values()):
        looks = 1
    exact = ExactMap(model.grid, model.sampling)
    with torch.no_grad():
        mean = torch.zeros(radar.frame_count, *model.grid.shape, dtype=torch.float64)
        for look in range(looks):
            mean += exact.predict(scene, radar, seed + look) / looks
        a, b = (p.double() - p.double().mean() for p in (mean, model.predict(scene, radar, seed)))
        norms = a.norm() * b.norm()
    return float((a * b).sum() / norms) if norms > 0 else 0.0
