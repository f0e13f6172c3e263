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
from invertwin.capture.ti import layouts
from invertwin.capture.ti.mmwave_studio import read_studio, setup_files
from invertwin.capture.ti.sdk_cfg import read_cfg
from invertwin.checks import check_choice
from invertwin.errors import InputError
from invertwin.radar.waveform import PhysicsWarning
from invertwin.refusals import refusal, refusal_text
from invertwin.runtime.memory import require_memory
from invertwin.storage.folders import replace_file
from invertwin.storage.untrusted import existing_file, safe_reader

_WORD = np.dtype("<i2")


@safe_reader("samples as their settings say")
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
            raise refusal("dca1000.lanes", known.lanes, lanes)
        known = replace(known, lanes=lanes)
    return read_samples(recorded_files(path), known)


def read_settings(path: str | Path) -> ChirpSettings:
    """Read the settings of a `.cfg`, `.mmwave.json` or `.setup.json` file.

    Raises:
        InputError: another ending, or what the reader of that file raises.
    """
    endings = {".cfg": read_cfg, ".json": read_studio}
    ending = Path(path).suffix.lower()
    do = "name the file the recording was set up with"
    check_choice(ending, endings, f"{path} to end in", do)
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
        settings: settings of the recording; `lanes` must be known.

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
        raise refusal("dca1000.odd_bytes", name, size)
    require_memory(10.0 * size, f"the samples of {name}", "split the recording")
    words = np.frombuffer(b"".join(part.read_bytes() for part in paths), _WORD)
    if settings.bits < 16:
        # Negative numbers may come without their sign bits.
        lost = words > 2 ** (settings.bits - 1) - 1
        words = np.where(lost, words - 2**settings.bits, words).astype(_WORD)
    frames = _count_whole_frames(words, settings, name)
    words = words[: frames * layouts.frame_words(settings)].astype(np.float32)
    parts = words.reshape(frames, -1).take(_word_indices(settings), axis=1)
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
        raise refusal("dca1000.counts", -top - 1, top)
    if settings.real and parts[..., 1].any():
        raise refusal("dca1000.imaginary")
    words = np.zeros((len(parts), layouts.frame_words(settings)), _WORD)
    words[:, _word_indices(settings)] = parts[..., :1] if settings.real else parts
    with replace_file(path) as part:
        words.tofile(part)


def _check_layout(settings: ChirpSettings) -> None:
    if settings.lanes is None:
        raise refusal("dca1000.no_lanes")
    why = layouts.layout_error(settings)
    if why is not None:
        raise InputError(f"expected {why}")


def _count_whole_frames(words: np.ndarray, settings: ChirpSettings, name: str) -> int:
    """Count the frames to read, and warn of what is missing.

    Settings whose size is not the file's are refused, unless the recording was cut off and its
    samples do not speak for others; and so are settings that the samples contradict.
    """
    size, frame = words.nbytes, layouts.frame_words(settings) * _WORD.itemsize
    frames, rest = divmod(size, frame)
    expected = settings.frames
    exact = not rest and frames == (expected or frames) and frames > 0
    cut = frames > 0 and (expected is None or frames < expected)
    others = _find_alternatives(words, settings, exact=exact, truncated=cut)
    if others:
        wanted = f"{expected} frames of {frame}" if expected else f"whole frames of {frame}"
        advice = layouts.format_advice(others)
        where = " whose chirps break elsewhere" if exact else ""
        raise refusal("dca1000.contradiction", name, wanted, size, where, advice)
    if not exact and expected is not None and not cut:
        raise refusal("dca1000.size", expected * frame, name, expected, frame, size)
    if not frames:
        raise refusal("dca1000.no_frame", frame, name, size)
    missing = ""
    if rest:
        missing = refusal_text("dca1000.incomplete_frame", name, frames, rest, frame)
    elif expected is not None and frames < expected:
        missing = refusal_text("dca1000.missing_frames", name, frames, expected)
    if missing:
        warnings.warn(missing, PhysicsWarning, stacklevel=4)
    return frames


def _find_alternatives(
    words: np.ndarray, settings: ChirpSettings, *, exact: bool, truncated: bool
) -> list[layouts.LayoutCandidate]:
    """Other settings that the file speaks for, best first; none = it may be as stated.

    Args:
        words: Words of the file.
        settings: As stated.
        exact: Whether the size is that of the settings.
        truncated: Whether it is that of a recording that was stopped.
    """
    sound = exact and layouts.measure_evidence(words, settings).breaks_at_borders
    if not words.size or (sound and not layouts.silent_lanes_contradict(words, settings)):
        return []
    found = layouts.find_candidates(words, settings)
    if not exact and not truncated:
        return found
    if layouts.silent_lanes_contradict(words, settings):
        return [one for one in found if not layouts.silent_lanes_contradict(words, one.settings)]
    stated = layouts.measure_evidence(words, settings)
    others = layouts.better_candidates(found, stated)
    if exact or others:
        return others
    # The same blocks in other numbers: no sample tells a stopped recording from another one.
    alike = [one for one in found if len(one.changes) == 1 and "frames" not in one.changes]
    if stated.breaks_at_borders:
        own = layouts.block_layout(settings)
        alike = [one for one in alike if layouts.block_layout(one.settings) == own]
    return [*(one for one in found if alike and set(one.changes) == {"frames"}), *alike]


def _word_indices(settings: ChirpSettings) -> np.ndarray:
    """Indices of the I and Q words of a frame, from 0 [chirp, tx, rx, sample, I and Q]."""
    s, parts = settings, 1 if settings.real else 2
    chirps = s.loops, len(s.transmit_order)
    words = np.arange(layouts.frame_words(s))
    if s.lanes == layouts.LANE_COUNT:
        sides = words.reshape(*chirps, s.samples, parts, layouts.LANE_COUNT)
        sides = sides[..., [number - 1 for number in s.receivers]]
        sides = np.moveaxis(sides, (-1, -2), (-3, -1))
    else:
        pairs = words.reshape(-1, parts, 2).swapaxes(1, 2) if parts == 2 else words
        sides = pairs.reshape(*chirps, len(s.receivers), s.samples, parts)
    return sides[..., ::-1] if s.swap_iq else sides
