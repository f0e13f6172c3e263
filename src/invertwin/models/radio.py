"""Forward models of links: received power, frequency responses, power of panels."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, get_args

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from invertwin.checks import ArrayLike, check_fields, checked_number, checked_tensor, set_fields
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel, Realisations
from invertwin.limits import NonNegative
from invertwin.links.metasurface.coverage import Coverage
from invertwin.links.metasurface.panel import Metasurface, panel_response
from invertwin.links.places import ReceiverLocations
from invertwin.links.received import LinkStatistics, PropagationSettings
from invertwin.links.responses import checked_frequencies
from invertwin.links.transmitters import Transmitters
from invertwin.models.noise import add_white_errors
from invertwin.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class PanelMap(ForwardModel):
    """Path gain of receivers over a metasurface alone; the sensor is the metasurface.

    Attributes:
        tx: Position of the transmitter [3] [m].
        receivers: Positions of the receivers [rx, 3] [m].
        frequency: Carrier frequency [Hz].
        boundary: False leaves out of derivatives that shadows move over the panel.
    """

    tx: Float64[Tensor, "3"]
    receivers: Float64[Tensor, "rx 3"]
    frequency: float
    boundary: bool = True

    redraws: ClassVar[bool] = False
    is_random: ClassVar[bool] = False

    def predict(self, scene: Scene, sensor: Metasurface, seed: int) -> Float64[Tensor, "1 rx"]:
        """Predict |Σ|² of the elements. See ``panel_response``."""
        found = panel_response(
            scene, sensor, self.tx[None], self.receivers, self.frequency, boundary=self.boundary
        )
        return found.real.square() + found.imag.square()

    def observe(self, recording: Tensor) -> Float64[Tensor, "1 rx"]:
        """Return measured path gains over the panel alone."""
        return recording.reshape(1, -1)

    def ablations(self) -> dict[str, ForwardModel]:
        """Return the model at fixed shadows. See ``ForwardModel.ablations``."""
        return {"boundary": replace(self, boundary=False)} if self.boundary else {}


@dataclass(frozen=True, eq=False)
class CoverageMap(ForwardModel):
    """Path loss that the worst share of receivers exceeds [dB]; the sensor is the metasurface.

    The map is one value, an objective that is minimised by ``RatioLoss``.

    Attributes:
        coverage: Receivers with their path gains without a panel.
        batch: Number of receivers per prediction, drawn by the seed.
        blur: Additional width of penumbras on the panel [m]; removed during a fit.
        softness: Width of the quantile, see ``soft_quantile`` [dB]; a tenth remains at the end.
        boundary: False leaves out of derivatives that shadows move over the panel.
    """

    coverage: Coverage
    batch: int
    blur: float = 0.0
    softness: float = 3.0
    boundary: bool = True

    def predict(self, scene: Scene, sensor: Metasurface, seed: int) -> Float64[Tensor, "1 1"]:
        """Predict the path loss; objects that occlude paths are those of ``coverage``."""
        generator = torch.Generator().manual_seed(seed)
        chosen = torch.randperm(len(self.coverage.receivers), generator=generator)[: self.batch]
        some = self.coverage.part(chosen)
        return -some.aim(sensor, self.blur, self.boundary, self.softness).reshape(1, 1)

    def observe(self, recording: ArrayLike) -> Float64[Tensor, "1 1"]:
        """Return a reference path loss [dB]."""
        return torch.as_tensor(recording, dtype=torch.float64).reshape(1, 1)

    @property
    def has_blur(self) -> bool:
        """Return whether shadows or the quantile are blurred."""
        return self.blur > 0 or self.softness > 0

    def scale_blur(self, fraction: float) -> "CoverageMap":
        """Scale the blur by a factor."""
        soft = self.softness * 0.1 ** (1 - fraction)
        return replace(self, blur=fraction * self.blur, softness=soft)


Quantity = Literal["received_power", "path_gain", "gain", "sinr", "delay_spread"]
QUANTITIES: tuple[str, ...] = get_args(Quantity)
"""Quantities of a ``RadioMap``."""


@dataclass(frozen=True, eq=False)
class RadioMap(ForwardModel):
    """Levels or gains at known receiver locations, one map per transmitter.

    Levels are in decibels; compare them by ``SpectrumLoss(levels=1, gain="one")``, with
    ``background="level"`` if the transmitted power is unknown. A floor is added to every gain, so
    levels and derivatives are finite without a path.

    Attributes:
        places: Positions of the receivers.
        propagation: Settings of the path search and of the sum over paths.
        quantity: ``received_power`` [dBm], ``path_gain`` [dB], ``gain`` (path gain as a ratio,
            without a floor), ``sinr`` [dB] (received power of a transmitter over that of all others
            and noise), or ``delay_spread`` [s].
        floor_db: Path gain that is added to every gain [dB].
        noise_dbm: Noise power of a receiver, for ``sinr`` [dBm].
        scatter: Standard deviation of data about the map, in the unit of the map, used by error
            bars and verdicts; None = estimated from the residual of a fit.
        without: Names of objects that the model leaves out. In a first, coarse stage of a fit, an
            object that hides the transmitter would keep it from its true position.

    Raises:
        InputError: An unknown quantity, or a value out of range.
    """

    places: ReceiverLocations
    propagation: PropagationSettings
    quantity: Quantity = "received_power"
    floor_db: float = -200.0
    noise_dbm: float = -100.0
    scatter: NonNegative | None = None
    without: Sequence[str] = ()

    redraws: ClassVar[bool] = False
    holds_fields: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_fields(self)
        checked_number(self.floor_db, "floor [dB]", -math.inf)
        checked_number(self.noise_dbm, "noise [dBm]", -math.inf)

    @property
    def unit(self) -> str:
        """Unit of the quantity."""
        return {"received_power": "dBm", "delay_spread": "s", "gain": "1"}.get(self.quantity, "dB")

    def link_statistics(self, scene: Scene, sensor: Transmitters, seed: int) -> LinkStatistics:
        """Gain and delay spread in linear units.

        Args:
            scene: Propagation environment.
            sensor: Transmitters.
            seed: Seed of the rays that find paths.

        Raises:
            InputError: An unknown name in ``without``.
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
        return self.places.link_statistics(scene, sensor, self.propagation, seed)

    def predict(self, scene: Scene, sensor: Transmitters, seed: int) -> Float64[Tensor, "tx *map"]:
        """Predict the quantity of every transmitter. See ``ForwardModel.predict``."""
        found = self.link_statistics(scene, sensor, seed)
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
        """Return measured values [tx, …], or those of a single transmitter […].

        Raises:
            InputError: Another shape, or NaN.
        """
        shape, given = self.places.shape, torch.as_tensor(recording, dtype=torch.float64)
        given = given[None] if given.ndim == len(shape) else given
        what = f"measured {self.quantity.replace('_', ' ')}"
        return checked_tensor(given, (None, *shape), what, "give a map for each transmitter")

    def realisations(self, scene: Scene, sensor: Transmitters, seed: int) -> Realisations:
        """Return maps with independent measurement errors."""
        return self.realisations_about(self.predict(scene, sensor, seed))

    def realisations_about(self, mean: Float64[Tensor, "tx *map"]) -> Realisations:
        """Return maps with independent measurement errors, see ``ForwardModel.realisations``.

        Args:
            mean: The map without errors.
        """
        return add_white_errors(mean, self.scatter)

    def best_server(self, scene: Scene, sensor: Transmitters, seed: int) -> Int64[Tensor, "*map"]:
        """Index of the transmitter with the highest received power; −1 if no power arrives.

        Args:
            scene: Propagation environment.
            sensor: Transmitters.
            seed: As for ``predict``.
        """
        gain = self.link_statistics(scene, sensor, seed).gain
        most, number = (gain * sensor.powers.reshape(-1, *[1] * (gain.ndim - 1))).max(0)
        return torch.where(most > 0, number, -1)

    @property
    def is_random(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """True if points of cells or scattered paths are drawn at random."""
        return self.places.is_random or self.propagation.rough is not None

    def for_differences(
        self, scene: Scene, sensor: Transmitters, samples: int, scheme: Literal["rays", "area"]
    ) -> "RadioMap":
        """Return the model with other numbers of points on cells and of scattered paths."""
        reception, rough = self.propagation, self.propagation.rough
        if rough is not None:
            reception = replace(reception, rough=replace(rough, samples=samples, boundary=False))
        return replace(self, places=self.places.with_sample_count(samples), propagation=reception)

    def ablations(self) -> dict[str, ForwardModel]:
        """Return the model at fixed visibility: without diffraction or boundary paths of cells.

        See ``ForwardModel.ablations``.
        """
        fixed = self.places.fixed_visibility()
        rough = self.propagation.rough
        moves = rough is not None and rough.boundary
        if fixed is None and not self.propagation.edges and not moves:
            return {}
        if rough is not None:
            rough = replace(rough, boundary=False)
        # In cells without diffraction, powers add.
        bandwidth = self.propagation.bandwidth if fixed is None else None
        reception = replace(self.propagation, edges=0, bandwidth=bandwidth, rough=rough)
        return {"boundary": replace(self, places=fixed or self.places, propagation=reception)}


@dataclass(frozen=True, eq=False)
class ResponseMap(ForwardModel):
    """Complex responses H(f) between transmitters and receivers at known positions.

    Phases determine path lengths to a fraction of a wavelength, so the loss has a minimum every
    half wavelength of position. Materials hardly change phases and are found from any initial
    value. Maps hold real and imaginary parts; compare them by
    ``SpectrumLoss(levels=1, gain="one")``.

    Attributes:
        positions: Positions of the receivers [receiver, 3] [m].
        frequencies: Frequencies of the responses [Hz].
        propagation: Settings of the path search; its bandwidth is ignored.
        scatter: Standard deviation of the real and imaginary parts of data about the map; None =
            estimated from the residual of a fit.
    """

    positions: Float64[Tensor, "place 3"]
    frequencies: Float64[Tensor, " frequency"]
    propagation: PropagationSettings
    scatter: float | None = None

    redraws: ClassVar[bool] = False
    is_random: ClassVar[bool] = False
    holds_fields: ClassVar[bool] = True

    def __post_init__(self) -> None:
        do = "give a row of x, y, z for each"
        places = checked_tensor(self.positions, (None, 3), "positions of receivers [m]", do)
        set_fields(self, positions=places, frequencies=checked_frequencies(self.frequencies))

    def predict(
        self, scene: Scene, sensor: Transmitters, seed: int
    ) -> Float64[Tensor, "tx place frequency part"]:
        """Predict the responses of the first elements. See ``ForwardModel.predict``."""
        found = self.propagation.frequency_responses(
            scene, sensor, self.positions, self.frequencies, seed
        )
        return torch.view_as_real(found)

    def observe(self, recording: Tensor) -> Float64[Tensor, "tx place frequency part"]:
        """Return measured complex responses [tx, receiver, frequency].

        Raises:
            InputError: Another shape, or NaN.
        """
        given = torch.as_tensor(recording, dtype=torch.complex128)
        shape = (None, len(self.positions), len(self.frequencies), 2)
        do = "give complex numbers [tx, place, frequency]"
        return checked_tensor(torch.view_as_real(given), shape, "measured responses", do)

    def realisations(self, scene: Scene, sensor: Transmitters, seed: int) -> Realisations:
        """Return responses with independent noise."""
        return add_white_errors(self.predict(scene, sensor, seed), self.scatter)
