"""Samples of chirps in the order of axes of other programs, and back.

Only the order changes: signs, scales and what a sample means stay as they are.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Complex
from torch import Tensor

from invertwin.radar.signal.chirps import check_order
from invertwin.refusals import refusal

_Beat = Complex[Tensor, "frame chirp tx rx sample"]
_Order = Sequence[int] | None  # of the turns of transmitters
_Pulses = Complex[Tensor, "frame pulse rx sample"]  # cube of OpenRadar


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


def to_openradar(beat: _Beat, order: _Order = None) -> _Pulses:
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
    turns = range(beat.shape[2]) if order is None else order
    return beat[:, :, check_order(turns, beat.shape[2])].flatten(1, 2)


def from_openradar(adc_data: _Pulses, transmitters: int, order: _Order = None) -> _Beat:
    """Convert a cube of OpenRadar, organised there or made by ``to_openradar``.

    Args:
        adc_data: OpenRadar's [frames, chirps, receivers, samples].
        transmitters: Number of transmitters that take turns.
        order: As in ``to_openradar``.

    Raises:
        InputError: Chirps that are no number of loops, or an order that does not name every
            transmitter once.
    """
    _check_divides(adc_data.shape[1], transmitters, "chirps", "transmitters")
    turns = check_order(range(transmitters) if order is None else order, transmitters)
    return adc_data.unflatten(1, (-1, transmitters))[:, :, torch.tensor(turns).argsort()]


def _check_divides(size: int, parts: int, what: str, of: str) -> None:
    if parts < 1 or size % parts:
        raise refusal("cubes.multiple", parts, of, what, size)
