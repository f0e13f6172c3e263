"""Calibration of the channels: estimate their gains from a reflector, save them, apply them."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

from invertwin.capture.capture import BEAT_DIMS, Capture
from invertwin.capture.chirp_capture import ChirpCapture
from invertwin.capture.readers.radar_fields import to_data_array
from invertwin.checks import check_shape, checked_tensor
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.limits import MAX_NUMBER
from invertwin.radar.radar import require_sampled_waveform
from invertwin.radar.waveform import unit_window
from invertwin.refusals import refusal
from invertwin.storage.folders import write_text_file
from invertwin.storage.untrusted import convert_read_errors, read_text

RecordingT = TypeVar("RecordingT", bound=Capture | ChirpCapture)
_MIN_RELATIVE_GAIN = 1e-3


@dataclass(frozen=True, eq=False)
class ChannelCalibration:
    """The complex gain of every virtual channel.

    Attributes:
        gains: measured over ideal signal, [tx, rx]; the mean of their squares is 1 and the sum is
            real and positive, since neither common power nor common phase can be told from the
            reflector's.

    Raises:
        InputError: another shape, NaN, or a channel without signal.
    """

    gains: Complex128[Tensor, "tx rx"]

    def __post_init__(self) -> None:
        gains = self.gains
        finite = bool(gains.numel()) and bool((gains.abs() <= MAX_NUMBER).all())
        if gains.ndim != 2 or not finite:
            raise refusal("channel_calibration.gains", tuple(gains.shape))
        weak = gains.abs() < _MIN_RELATIVE_GAIN * gains.abs().max()
        if bool(weak.any()):
            tx, rx = (int(index) for index in weak.nonzero()[0])
            raise refusal("channel_calibration.weak_channel", _MIN_RELATIVE_GAIN, tx, rx)
        gains = gains / gains.abs().square().mean().sqrt()
        total = gains.sum()
        # Phases that cancel have no common one.
        if total.abs() > 1e-9 * gains.numel():
            gains = gains * (total.conj() / total.abs())
        object.__setattr__(self, "gains", gains)

    @classmethod
    def load(cls, path: str | Path) -> "ChannelCalibration":
        """Read what `save` wrote.

        Raises:
            InputError: no such file, or one that holds no calibration.
        """
        with convert_read_errors(path, "a calibration, gains [tx][rx][real, imaginary]"):
            content = json.loads(read_text(path, "a calibration"))
            parts = torch.tensor(content["gains"], dtype=torch.float64)
            if parts.ndim != 3 or parts.shape[2] != 2:
                raise ValueError(f"shape {tuple(parts.shape)}")
        calibration = cls(torch.view_as_complex(parts))
        # As written: normalising again would change the last bit.
        object.__setattr__(calibration, "gains", torch.view_as_complex(parts))
        return calibration

    def save(self, path: str | Path) -> None:
        """Write JSON, every bit kept; an interrupted write leaves an old file as it was.

        Raises:
            InputError: the folder does not exist.
        """
        content = {"gains": torch.view_as_real(self.gains).tolist()}
        write_text_file(path, json.dumps(content) + "\n")

    def apply(self, capture: RecordingT) -> RecordingT:
        """The recording with every channel divided by its gain.

        Raises:
            InputError: range profiles, or another number of channels.
        """
        beat = capture.beat
        expected = (*[None] * (beat.ndim - 3), *self.gains.shape, None)
        what = "data (frame, …, tx, rx, sample) of the elements that were calibrated"
        check_shape(beat, expected, what, "calibrate with the same elements")
        beat = (beat / self.gains[:, :, None]).to(beat.dtype)
        if isinstance(capture, ChirpCapture):
            return replace(capture, beat=beat)
        return type(capture)(capture.dataset.assign(beat=to_data_array(BEAT_DIMS, beat, "1")))


def estimate_channels(
    capture: Capture, reflector: Float64[Tensor, "3"] | list[float]
) -> ChannelCalibration:
    """Estimate the gains of the channels from a reflector at a known place.

    Each channel is compared with the beat signal of an ideal point at that place:
    ``c = Σ w_n s[n] conj(ideal[n])``. The delays of the ideal point are exact to every element, so
    the reflector may be close. The sum suppresses echoes from other ranges. Over several frames
    ``c ≈ amplitude(frame) · gain(channel)``. The gains are the leading singular vector, whatever
    phase the reflector has in each frame. Errors of the elements' positions end up in the phases;
    the phases are then right in the direction of this reflector only.

    Args:
        capture: samples with the reflector as the strongest echo at its range.
        reflector: its position in the world [m].

    Raises:
        InputError: range profiles, a place that is no position or beyond the unambiguous range,
            or a channel without signal.
    """
    do = "give the world position of the reflector in metres"
    place = checked_tensor(reflector, (3,), "reflector", do)
    radar = capture.radar()
    waveform = require_sampled_waveform(radar)
    tx, rx = radar.elements()
    to_tx, to_rx = (tx - place).norm(dim=-1), (rx - place).norm(dim=-1)
    delay = (to_tx[:, :, None] + to_rx[:, None]) / SPEED_OF_LIGHT
    delay = delay - radar.origin_delays[:, None, None]
    farthest = float(delay.max()) * SPEED_OF_LIGHT / 2
    if farthest >= radar.range_limits[1]:
        raise refusal("channel_calibration.reflector", radar.range_limits[1], farthest, do)
    cycles = waveform.frequencies * delay[..., None]
    cycles = cycles - 0.5 * waveform.residual_slope * delay.square()[..., None]
    ideal = torch.exp(2j * torch.pi * cycles)
    window = unit_window(radar.window, waveform.samples)
    matched = (capture.beat.to(torch.complex128) * ideal.conj() * window).sum(dim=-1)
    # Rows are frames, columns channels.
    _, strength, channels = torch.linalg.svd(matched.flatten(1), full_matrices=False)
    if float(strength[0]) == 0:
        raise InputError("expected an echo of the reflector, got samples of zero; record again")
    return ChannelCalibration(channels[0].reshape(matched.shape[1:]))
