"""Samples as the DCA1000 records them: little-endian 16-bit words in the order of the LVDS lanes.

Devices with 4 lanes (xWR12xx, xWR14xx) send all receivers side by side, RX1 to RX4, enabled or
not: the four I of one sample, then its four Q. Devices with 2 lanes (xWR16xx, 18xx, 68xx) send the
enabled receivers one after the other in every chirp, two samples at a time: I, I, Q, Q. Real
samples have no Q. (TI, SWRA581, "Mmwave Radar Device ADC Raw Data Capture".)
"""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from invertwin.capture.chirps import ChirpData, ChirpSettings
from invertwin.capture.ti.mmwave_studio import read_studio, setup_files
from invertwin.capture.ti.sdk_cfg import read_cfg
from invertwin.errors import InputError
from invertwin.folders import replacing
from invertwin.radar.waveform import PhysicsWarning
from invertwin.untrusted import existing_file, reader

_WORD = np.dtype("<i2")
_LANE_COUNT = 4


@reader("samples as their settings say")
def read_recording(
    path: str | Path, settings: str | Path | ChirpSettings | None = None, lanes: int | None = None
) -> ChirpData:
    """Read every chirp of a recording, with its settings.

    Args:
        path: `.bin` file, or a `.setup.json` that names the files.
        settings: the settings or their file; None = those that the `.setup.json` names.
        lanes: lanes of the LVDS link, where the settings do not say.

    Raises:
        InputError: other lanes than the settings say, or what `read_settings` and `read_samples`
            raise.
    """
    known = settings if isinstance(settings, ChirpSettings) else read_settings(settings or path)
    if lanes is not None:
        if known.lanes not in (None, lanes):
            raise InputError(
                f"expected the {known.lanes} LVDS lanes of the device in the settings, got "
                f"lanes={lanes}; leave lanes out"
            )
        known = replace(known, lanes=lanes)
    return read_samples(recorded_files(path), known)


def read_settings(path: str | Path) -> ChirpSettings:
    """Read the settings of a `.cfg`, `.mmwave.json` or `.setup.json` file.

    Raises:
        InputError: another ending, or what the reader of that file raises.
    """
    endings = {".cfg": read_cfg, ".json": read_studio}
    ending = Path(path).suffix.lower()
    if ending not in endings:
        raise InputError(
            f"expected settings in a .cfg or .json file, got {path}; "
            "name the file the recording was set up with"
        )
    return endings[ending](path)


def recorded_files(path: str | Path) -> list[Path]:
    """The `.bin` files of a recording: the file itself, or those that a `.setup.json` names."""
    return setup_files(path) if Path(path).suffix.lower() == ".json" else [Path(path)]


def read_samples(path: str | Path | Sequence[str | Path], settings: ChirpSettings) -> ChirpData:
    """Read every chirp of a recording, in ADC counts.

    Warns (`PhysicsWarning`) of an incomplete last frame, which is dropped, of frames that are
    missing, and of saturated samples.

    Args:
        path: `.bin` file, or the files of one recording in their order.
        settings: what it was set up with; `lanes` must be known.

    Raises:
        InputError: no file, an odd number of bytes, less than one frame, or a size that the
            settings contradict; the message says which settings fit.
    """
    paths = [Path(path)] if isinstance(path, str | Path) else [Path(part) for part in path]
    _check_layout(settings)
    for part in paths:
        existing_file(part, "a recording")
    # Files are split anywhere, so only their sum counts.
    size = sum(part.stat().st_size for part in paths)
    name = paths[0].name if paths else "nothing"
    if size % _WORD.itemsize:
        raise InputError(
            f"expected 16-bit samples in {name}, got an odd number of bytes ({size}); "
            "the file is damaged or no raw recording, copy it again"
        )
    frames = _whole_frames(size, settings, name)
    stream = b"".join(part.read_bytes() for part in paths)
    words = np.frombuffer(stream, _WORD, frames * _frame_words(settings)).astype(np.float32)
    if settings.bits < 16:
        # Negative numbers may come without their sign bits.
        words[words > 2 ** (settings.bits - 1) - 1] -= 2**settings.bits
    parts = words.reshape(frames, -1).take(_places(settings), axis=1)
    samples = parts.astype(np.complex64) if settings.real else parts.view(np.complex64)
    data = ChirpData(torch.from_numpy(samples[..., 0]), replace(settings, frames=frames))
    data.warn_if_saturated()
    return data


def write_samples(path: str | Path, data: ChirpData) -> None:
    """Write what `read_samples` reads, word for word.

    Args:
        path: `.bin` file.
        data: ADC counts; make them from simulated samples with `adc_counts`.

    Raises:
        InputError: samples that are no counts of the ADC, real samples with an imaginary part,
            or settings without lanes.
    """
    settings = data.settings
    _check_layout(settings)
    samples = data.samples.detach().cpu().resolve_conj().numpy().astype(np.complex128)
    parts = np.stack([samples.real, samples.imag], axis=-1)
    top = 2 ** (settings.bits - 1) - 1
    if (parts != parts.round()).any() or parts.max() > top or parts.min() < -top - 1:
        raise InputError(
            f"expected whole counts from {-top - 1} to {top}, got others; "
            "scale and round the samples with adc_counts(beat, settings, full_scale)"
        )
    if settings.real and parts[..., 1].any():
        raise InputError(
            "expected samples without imaginary part from a real ADC, got some with; "
            "take their real part or set real=False"
        )
    words = np.zeros((len(parts), _frame_words(settings)), _WORD)
    words[:, _places(settings)] = parts[..., :1] if settings.real else parts
    with replacing(path) as part:
        words.tofile(part)


def _check_layout(settings: ChirpSettings) -> None:
    if settings.lanes is None:
        raise InputError(
            "expected settings with 2 or 4 LVDS lanes, got none; set lanes: 4 for xWR12xx and "
            "xWR14xx, 2 for xWR16xx, xWR18xx and xWR68xx"
        )
    if settings.lanes == _LANE_COUNT and max(settings.receivers) > _LANE_COUNT:
        raise InputError(
            f"expected receivers 1 to {_LANE_COUNT}, one per lane, got {settings.receivers}; "
            "the DCA1000 records one device"
        )
    count = settings.samples * len(settings.receivers)
    if settings.lanes == 2 and not settings.real and count % 2:
        raise InputError(
            f"expected an even number of samples per chirp through 2 lanes, got {count}; "
            "they come in pairs, the settings are those of another recording"
        )


def _frame_words(settings: ChirpSettings) -> int:
    receivers = _LANE_COUNT if settings.lanes == _LANE_COUNT else len(settings.receivers)
    parts = 1 if settings.real else 2
    chirps = settings.loops * len(settings.transmit_order)
    return chirps * receivers * settings.samples * parts


def _whole_frames(size: int, settings: ChirpSettings, name: str) -> int:
    """Count the frames to read, and warn of what is missing."""
    frame = _frame_words(settings) * _WORD.itemsize
    frames, rest = divmod(size, frame)
    expected = settings.frames
    if expected is not None and size != expected * frame:
        fitting = _fitting(size, settings, expected)
        if size > expected * frame or fitting or not frames:
            if frames and not rest:
                fitting = [f"frames={frames}", *fitting]
            found = " or ".join(fitting) or (
                "no single change of the settings, find those of this recording"
            )
            raise InputError(
                f"expected {expected * frame} bytes in {name} ({expected} frames of {frame}), got "
                f"{size}; what fits: {found}"
            )
    if not frames:
        raise InputError(
            f"expected at least one frame of {frame} bytes in {name}, got {size} bytes; "
            "nothing was recorded, or the settings are those of another recording"
        )
    missing = ""
    if rest:
        missing = (
            f"{name} ends within a frame: {frames} whole frames are read, 1 incomplete frame "
            f"({rest} of {frame} bytes) is dropped; unless it was stopped there, the settings are "
            "those of another recording"
        )
    elif expected is not None and frames < expected:
        missing = (
            f"{name} holds {frames} of the {expected} frames in its settings: "
            "the recording was stopped early"
        )
    if missing:
        warnings.warn(missing, PhysicsWarning, stacklevel=4)
    return frames


def _fitting(size: int, settings: ChirpSettings, frames: int) -> list[str]:
    """Single changes of the settings with which the size is exact."""
    other = 6 - (settings.lanes or 2)
    changes = {
        f"lanes={other}": replace(settings, lanes=other),
        f"real={not settings.real}": replace(settings, real=not settings.real),
    }
    for key, name in (("receivers", "receivers"), ("transmit_order", "transmitters")):
        for count in range(1, 5):
            chosen = {key: tuple(range(1, count + 1))}
            changes[f"{count} {name}"] = replace(settings, **chosen)
    unit = _WORD.itemsize * frames
    found = [text for text, changed in changes.items() if _frame_words(changed) * unit == size]
    for field in ("samples", "loops"):
        # A frame grows in proportion to either.
        whole, rest = divmod(size * getattr(settings, field), _frame_words(settings) * unit)
        if rest == 0 and whole > 1:
            found.append(f"{field}={whole}")
    return found


def _places(settings: ChirpSettings) -> np.ndarray:
    """Which words of a frame are I and Q: numbers from 0 [chirp, tx, rx, sample, I and Q]."""
    s, parts = settings, 1 if settings.real else 2
    chirps = s.loops, len(s.transmit_order)
    words = np.arange(_frame_words(s))
    if s.lanes == _LANE_COUNT:
        sides = words.reshape(*chirps, s.samples, parts, _LANE_COUNT)
        sides = sides[..., [number - 1 for number in s.receivers]]
        sides = np.moveaxis(sides, (-1, -2), (-3, -1))
    else:
        pairs = words.reshape(-1, parts, 2).swapaxes(1, 2) if parts == 2 else words
        sides = pairs.reshape(*chirps, len(s.receivers), s.samples, parts)
    return sides[..., ::-1] if s.swap_iq else sides
