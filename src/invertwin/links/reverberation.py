"""Reverberant tail of a room: power of all paths that are too many, or unknown, to be traced."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.checks import checked_number, set_fields, to_tensor
from invertwin.constants import SPEED_OF_LIGHT

NEPERS_PER_DB = math.log(10) / 10
"""Natural logarithm of a power ratio of 1 dB."""


@dataclass(frozen=True, eq=False)
class Reverberation:
    """Reverberant tail of a room: power of all paths that are too many, or unknown, to be traced.

    The mean power delay profile of a link of length d begins with the straight path and decays
    exponentially, (G/T) e^(−τ/T) for τ ≥ d/c. It adds G e^(−d/cT) to the path gain, with a mean
    excess delay of T. Antennas count with their mean gain over all directions, 1.

    Attributes:
        gain_db: Path gain G of the tail at distance 0 [dB]. Differentiable.
        decay: Time constant T [s]. Differentiable.

    Raises:
        InputError: No single numbers, or a decay that is not positive.

    Source: Andersen and others, "Room electromagnetics", IEEE Antennas and Propagation Magazine
    49(2), 2007; Steinböck and others, "Distance dependent model for the delay power spectrum of
    in-room radio channels", IEEE Transactions on Antennas and Propagation 61(8), 2013.
    """

    gain_db: float | Float64[Tensor, ""]
    decay: float | Float64[Tensor, ""]

    def __post_init__(self) -> None:
        checked_number(self.gain_db, "gain of the tail [dB]", -300.0, 300.0)
        checked_number(self.decay, "decay of the tail [s]", 0.0, 1.0, open_low=True)
        given = vars(self).items()
        set_fields(self, **{name: to_tensor(v, "a tail", "give numbers") for name, v in given})

    def link_moments(
        self, tx: Float64[Tensor, "tx 3"], rx: Float64[Tensor, "place 3"]
    ) -> Float64[Tensor, "tx place 3"]:
        """Compute power of each link, and its first two moments over excess delay.

        Args:
            tx: Positions of the transmitters [m].
            rx: Positions of the receivers [m].
        """
        gain, decay = torch.as_tensor(self.gain_db), torch.as_tensor(self.decay)
        power = torch.exp(NEPERS_PER_DB * gain - torch.cdist(tx, rx) / (SPEED_OF_LIGHT * decay))
        return torch.stack([power, power * decay, 2 * power * decay**2], -1)
