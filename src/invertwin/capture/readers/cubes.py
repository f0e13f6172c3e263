"""Samples of chirps in the order of axes of other programs, and back.

Only the order changes: signs, scales and what a sample means stay as they are.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Complex
from torch import Tensor

from invertwin.errors import InputError

_Beat = Complex[Tensor, "frame chirp tx rx sample"]


def to_radarsimpy(beat: _Beat) -> Complex[Tensor, "channel chirp sample"]:
    """Samples as RadarSimPy's ``baseband``: [channels/frames, pulses, samples].

    Frames are outermost in the first axis, then transmitters, then receivers.

    Args:
        beat: Samples of every chirp, as a ``ChirpCapture`` has them.
    """
    return beat.transpose(1, 2).transpose(2, 3).flatten(0, 2)


def from_radarsimpy(
    baseband: Complex[Tensor, "channel chirp sample"], transmitters: int, receivers: int
) -> _Beat:
    """Convert a cube of RadarSimPy, simulated or made by ``to_radarsimpy``.

    Args:
        baseband: RadarSimPy's [channels/frames, pulses, samples].
        transmitters: Their number.
        receivers: Their number.

    Raises:
        InputError: A first axis that is no number of frames of so many channels.
    """
    _check_divides(len(baseband), transmitters * receivers, "channels/frames", "channels")
    return baseband.unflatten(0, (-1, transmitters, receivers)).transpose(2, 3).transpose(1, 2)


def to_openradar(
    beat: _Beat, order: Sequence[int] | None = None
) -> Complex[Tensor, "frame pulse rx sample"]:
    """Samples as OpenRadar's ``adc_data``: [frames, chirps, receivers, samples].

    Transmitters take turns within a loop, so its chirps are loops × transmitters;
    ``separate_tx(adc_data[0], num_tx)`` takes them apart again.

    Args:
        beat: Samples of every loop, as a ``ChirpCapture`` has them.
        order: Transmitters, counted from 0, in the order of their turns (``Chirps.order``); None =
            0, 1, 2, …

    Raises:
        InputError: An order that does not name every transmitter once.
    """
    return beat[:, :, _check_transmit_order(order, beat.shape[2])].flatten(1, 2)


def from_openradar(
    adc_data: Complex[Tensor, "frame pulse rx sample"],
    transmitters: int,
    order: Sequence[int] | None = None,
) -> _Beat:
    """Convert a cube of OpenRadar, organised there or made by ``to_openradar``.

    Args:
        adc_data: OpenRadar's [frames, chirps, receivers, samples].
        transmitters: How many take turns.
        order: As in ``to_openradar``.

    Raises:
        InputError: Chirps that are no number of loops, or an order that does not name every
            transmitter once.
    """
    _check_divides(adc_data.shape[1], transmitters, "chirps", "transmitters")
    places = _check_transmit_order(order, transmitters).argsort()
    return adc_data.unflatten(1, (-1, transmitters))[:, :, places]


def _check_transmit_order(order: Sequence[int] | None, transmitters: int) -> Tensor:
    turns = list(range(transmitters)) if order is None else list(order)
    if sorted(turns) != list(range(transmitters)):
        raise InputError(
            f"expected an order that names each of {transmitters} transmitters once, from 0, got "
            f"{turns}; take Chirps.order"
        )
    return torch.tensor(turns)


def _check_divides(size: int, parts: int, what: str, of: str) -> None:
    if parts < 1 or size % parts:
        raise InputError(
            f"expected a multiple of {parts} {of} along {what}, got {size}; give the numbers of "
            "antennas that recorded"
        )
