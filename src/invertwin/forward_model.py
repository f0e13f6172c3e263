"""The contract of forward models: ``predict`` a map of a scene, ``observe`` a recording.

A model is a frozen value. ``predict`` maps a scene and a sensor to a map; ``observe`` maps a
recording to a map of the same shape; a loss compares the two. A model of one's own derives from
:class:`ForwardModel` and has these two methods; ``reconstruct`` and ``gradcheck`` take it.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from types import FunctionType
from typing import Any, ClassVar, Literal

from jaxtyping import Float
from torch import Tensor

from invertwin.deprecation import read_renamed_attributes, rename_attributes, warn_renamed
from invertwin.scene.scene import Scene

Realisations = Callable[[int, float], Tensor]
"""Function (seed, mean noise power per bin) → map of one simulated recording."""


class ForwardModel(ABC):
    """Model of the map that a sensor measures of a scene.

    Attributes:
        redraws: Whether a fit gives the model another seed at every step. False for a model
            whose random numbers belong to the scene.
        is_smooth: Whether the derivative of the mean is the mean of derivatives, visibility
            included. Gauss–Newton and gradient checks need that.
        is_random: Whether maps depend on the seed. If they do not, gradient checks take one
            derivative and one pair of differences.
        holds_fields: True if maps hold parts of fields or levels, of either sign, not power.
            They are compared by squares, not by the likelihood of speckle.
        needs_sensor: False for a model that predicts without a sensor.
        realisation_count: Number of realisations for error bars and verdicts; 64 determine a
            standard deviation to 9 %.
    """

    redraws: ClassVar[bool] = True
    is_smooth: ClassVar[bool] = True
    is_random: ClassVar[bool] = True
    holds_fields: ClassVar[bool] = False
    needs_sensor: ClassVar[bool] = True
    realisation_count: ClassVar[int] = 64

    def __init_subclass__(cls, **options: Any) -> None:
        """Adopt methods and flags that a subclass defines by their names of version 0.3."""
        super().__init_subclass__(**options)
        own = dict(vars(cls))
        for old, new in read_renamed_attributes()[f"{__name__}.ForwardModel"].items():
            if new not in own and isinstance(own.get(old), FunctionType | property | bool):
                warn_renamed(f"{cls.__qualname__}.{old}", f"{cls.__qualname__}.{new}")
                setattr(cls, new, own[old])

    @abstractmethod
    def predict(self, scene: Scene, sensor: Any, seed: int) -> Float[Tensor, "frame *map"]:
        """The map that the sensor would show.

        Args:
            scene: Scene to predict.
            sensor: Radar, camera or transmitters, with their poses.
            seed: Seed of the random numbers; equal seeds give equal maps.
        """

    @abstractmethod
    def observe(self, recording: Any) -> Float[Tensor, "frame *map"]:
        """A recording as a map of the same form."""

    def prepare(self, scene: Scene, sensor: Any, seed: int) -> "ForwardModel":
        """The model with the random numbers drawn that stay the same during a fit.

        Args:
            scene: The scene at the start of the fit.
            sensor: The sensor of the observation.
            seed: Seed of these random numbers.
        """
        return self

    def for_differences(
        self, scene: Scene, sensor: Any, samples: int, scheme: Literal["rays", "area"]
    ) -> "ForwardModel":
        """The model with common random numbers for scenes that differ a little.

        Args:
            scene: The scene at the middle of the difference.
            sensor: The sensor there.
            samples: Samples of one map.
            scheme: "rays" or "area": how surfaces are sampled.
        """
        return self

    def realisations(self, scene: Scene, sensor: Any, seed: int) -> Realisations | None:
        """Return a source of simulated recordings, each with its own speckle and noise.

        The error bars of a fit and the test of its goodness draw from it.

        Args:
            scene: Scene to record.
            sensor: The sensor of the observation.
            seed: Seed of the points on rough surfaces.

        Returns:
            A function (seed, mean noise power per bin) → map of the form of ``observe``; None if
            the model cannot simulate recordings. With ``holds_fields``, the noise is the mean
            square of a bin.
        """
        return None

    def with_sampling(self, **changes: Any) -> "ForwardModel":
        """The model with other fields of its ``sampling``, where it has one."""
        return replace(self, sampling=replace(self.sampling, **changes))  # type: ignore

    def ablations(self) -> "dict[str, ForwardModel]":
        """Models whose derivatives leave out one term, by the field of ``sampling`` that omits it.

        Gradient checks compare with them: ``boundary``, ``interior_edges``, ``contacts``.
        """
        sampling = getattr(self, "sampling", None)
        if sampling is None or not sampling.boundary:
            return {}
        fields = ["boundary"]
        fields += ["interior_edges"] if sampling.depth > 1 else []
        fields += ["contacts"] if sampling.contacts else []
        return {name: self.with_sampling(**{name: False}) for name in fields}

    @property
    def has_blur(self) -> bool:
        """True if the model blurs its maps."""
        return False

    def scale_blur(self, fraction: float) -> "ForwardModel":
        """The model with its added blur widths times this fraction; 0 removes the blur."""
        return self

    def blur_observed(self, observed: Tensor, sensor: Any) -> Tensor:
        """An observed map with the model's added blur. It must not trace rays.

        A fit calls it in a thread of its own, while it predicts.

        Args:
            observed: Map from ``observe``.
            sensor: The sensor that recorded it.
        """
        return observed


rename_attributes(__name__)
