"""Settings that contradict a raw file: which others fit its size, and what its samples say.

Samples follow from the ones before them within the block of one receiver in one chirp, and break
at its ends. Under the right settings prediction fails at every border of a block and nowhere else.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any

import numpy as np
import torch
from jaxtyping import Complex128
from torch import Tensor

from invertwin.capture.chirps import ChirpSettings
from invertwin.capture.prediction import covariances, prediction_coefficients
from invertwin.capture.ti.device_limits import frame_duration
from invertwin.checks import check_choice, checked_count
from invertwin.errors import InputError
from invertwin.refusals import refusal_text

LANE_COUNT = 4
_MAX_WORDS = 2**17  # that are looked at
_PREDICTION_ORDER = 6  # of the prediction of complex samples
_MIN_BLOCK_SAMPLES = 8  # of a block
_MIN_SAMPLES = 256  # samples that tell something
_MAX_LISTED = 6
_MAX_ELEMENTS = 4
# Failure of prediction at borders over that within, and nats a word that other blocks cost more:
# from these on, the samples tell.
MIN_BORDER_RATIO = 2.0
MIN_CODE_SAVING = 0.03
# Coherence of blocks of one channel over the highest of other candidates.
_MIN_RELATIVE_COHERENCE = 0.98
_COUNTS = {"receivers": "receivers", "transmitters": "transmit_order"}
_SIZES = ("samples", "loops", "frames")
CHANGEABLE_SETTINGS = ("lanes", "real", *_COUNTS, *_SIZES)
"""Names of settings that can be changed by ``change_settings``."""


def change_settings(settings: ChirpSettings, changes: Mapping[str, Any]) -> ChirpSettings:
    """Settings with some numbers replaced.

    Args:
        settings: Settings as the file states them.
        changes: Values by the names in ``CHANGEABLE_SETTINGS``; numbers of receivers and
            transmitters mean the first ones.

    Raises:
        InputError: Another name, or values that settings cannot have.
    """
    values = dict(changes)
    for name in changes:
        do = "correct other numbers in the settings file"
        check_choice(name, CHANGEABLE_SETTINGS, "changes of", do)
        if name in _COUNTS:
            count = checked_count(values.pop(name), name, 1)
            values[_COUNTS[name]] = tuple(range(1, count + 1))
    return replace(settings, **values)


@dataclass(frozen=True)
class LayoutEvidence:
    """Evidence of samples for the blocks into which settings cut them.

    Attributes:
        border_ratio: Failure of prediction at the quietest borders over the largest anywhere
            within:
            above 1 for the right blocks where there is an echo; below for others.
        code_length: Length of a code of the samples by their predictions, up to a constant
            [nats per word]. Wrong blocks, and samples in a wrong order, are predicted worse.
    """

    border_ratio: float
    code_length: float

    @property
    def breaks_at_borders(self) -> bool:
        """True if prediction fails at the borders of blocks, which speaks for them."""
        return self.border_ratio >= MIN_BORDER_RATIO


NO_EVIDENCE = LayoutEvidence(0.0, math.inf)


@dataclass(frozen=True)
class LayoutCandidate:
    """Settings with which the size of a file is exact.

    Attributes:
        changes: Changed settings.
        settings: Settings with the changes.
        evidence: Evidence of the samples.
        coherence: Coherence of blocks that the settings give to one channel; None = the file is too
            short.
    """

    changes: dict[str, Any]
    settings: ChirpSettings
    evidence: LayoutEvidence
    coherence: float | None

    def __str__(self) -> str:
        return ", ".join(f"{name}={value}" for name, value in self.changes.items())


def block_layout(settings: ChirpSettings) -> tuple[int, ...]:
    """Return the settings that determine the blocks."""
    return settings.lanes or 0, int(settings.real), settings.samples


def count_channels(settings: ChirpSettings) -> int:
    """Receivers whose words are in the file: with 4 lanes all of the device."""
    return LANE_COUNT if settings.lanes == LANE_COUNT else len(settings.receivers)


def frame_words(settings: ChirpSettings) -> int:
    """16-bit words of a frame."""
    chirps = settings.loops * len(settings.transmit_order)
    return chirps * count_channels(settings) * settings.samples * (1 if settings.real else 2)


def layout_error(settings: ChirpSettings) -> str | None:
    """Return the reason why no DCA1000 records a file with these settings; None = it does."""
    if settings.lanes == LANE_COUNT and max(settings.receivers) > LANE_COUNT:
        return refusal_text("layouts.receivers", LANE_COUNT, settings.receivers)
    count = settings.samples * len(settings.receivers)
    if settings.lanes == 2 and not settings.real and count % 2:
        return refusal_text("layouts.odd_samples", count)
    return None


def find_candidates(words: np.ndarray, settings: ChirpSettings) -> list[LayoutCandidate]:
    """Settings with one change or two with which a file's size is exact.

    A ramp holds the samples, the period of frames holds the ramps.

    Args:
        words: Words of the file.
        settings: Settings that contradict it. Without a number of frames, any number of whole ones
            fits.

    Returns:
        Those whose blocks break at their borders first, the cheapest before others; with the same
        blocks, those with fewer changes.
    """
    active = _active_lanes(words)
    own = {name: len(getattr(settings, key)) for name, key in _COUNTS.items()}
    choices = {
        "lanes": [6 - (settings.lanes or 2)],
        "real": [not settings.real],
        **{name: [n for n in range(1, _MAX_ELEMENTS + 1) if n != own[name]] for name in own},
    }
    found: list[LayoutCandidate] = []
    known: dict[tuple[int, ...], LayoutEvidence] = {}
    alike: dict[tuple[int, ...], float | None] = {}
    for count in (1, 2):
        for names in combinations(CHANGEABLE_SETTINGS, count):
            fixed = [name for name in names if name in choices]
            free = [name for name in names if name in _SIZES]
            for values in product(*(choices[name] for name in fixed)):
                chosen = dict(zip(fixed, values, strict=True))
                for solved in _solve_sizes(free, chosen, len(words), settings):
                    made = _apply_changes(chosen | solved, settings)
                    if made is None or (made.lanes == LANE_COUNT and made.receivers != active):
                        continue
                    key = block_layout(made)
                    period = (*key, _block_period(made))
                    if key not in known:
                        known[key] = measure_evidence(words, made)
                    if period not in alike:
                        alike[period] = block_coherence(words, made)
                    found.append(LayoutCandidate(chosen | solved, made, known[key], alike[period]))

    breaking = [one for one in found if one.evidence.breaks_at_borders]
    breaking.sort(key=lambda one: (one.evidence.code_length, len(one.changes)))
    others = [one for one in found if not one.evidence.breaks_at_borders]
    return breaking + sorted(others, key=lambda one: len(one.changes))


def _active_lanes(words: np.ndarray) -> tuple[int, ...]:
    """Numbers of the 4 lanes that are not silent."""
    lanes = words[: len(words) // LANE_COUNT * LANE_COUNT].reshape(-1, LANE_COUNT)
    return tuple(int(lane) + 1 for lane in np.flatnonzero(lanes.any(0)))


def _block_period(settings: ChirpSettings) -> int:
    """Blocks in the stream until the same transmitter and receiver come again."""
    side_by_side = settings.lanes == LANE_COUNT
    return len(settings.transmit_order) * (1 if side_by_side else len(settings.receivers))


def _solve_sizes(
    free: list[str], known: dict[str, Any], size: int, settings: ChirpSettings
) -> Iterator[dict[str, int]]:
    """Values of the free sizes with which the rest makes the size exact."""
    try:
        twos = dict.fromkeys((name for name in free if name != "frames"), 2)
        base = change_settings(settings, known | twos)
    except InputError:
        return
    unit = frame_words(base) // 2 ** sum(name != "frames" for name in free)
    repeats = 1 if "frames" in free else settings.frames
    if repeats is None:
        # Any number of whole frames fits, so only what is stated of them counts.
        if not free and size % unit == 0:
            yield {}
        return
    whole, rest = divmod(size, unit * repeats)
    if rest or not whole:
        return
    if not free and whole == 1:
        yield {}
    elif len(free) == 1:
        yield {free[0]: whole}
    elif len(free) == 2:
        low = [n for n in range(1, math.isqrt(whole) + 1) if whole % n == 0]
        for value in sorted({*low, *(whole // n for n in low)}):
            yield {free[0]: value, free[1]: whole // value}


def _apply_changes(changes: dict[str, Any], settings: ChirpSettings) -> ChirpSettings | None:
    """The settings with changes, if a device could have recorded them."""
    short = changes.get("samples", _MIN_BLOCK_SAMPLES) < _MIN_BLOCK_SAMPLES
    if short or any(getattr(settings, name, None) == value for name, value in changes.items()):
        return None
    try:
        made = change_settings(settings, changes)
    except InputError:  # the ramp does not hold the samples
        return None
    period = made.frame_period
    late = period is not None and frame_duration(made) > period * (1 + 1e-9)
    return None if late or layout_error(made) is not None else made


def measure_evidence(words: np.ndarray, settings: ChirpSettings) -> LayoutEvidence:
    """Measure discontinuities of the samples at the ends of blocks.

    Borders are taken in classes, every second and every third or fourth, and the quietest class
    counts: blocks that are cut in two have borders without a break.

    Args:
        words: Words of the file.
        settings: Settings whose layout counts.
    """
    rows = sample_rows(words, settings)
    count = settings.samples
    # A real tone is two complex ones.
    order = min(_PREDICTION_ORDER * (2 if settings.real else 1), count // 4)
    blocks = rows.shape[1] // count
    if count < _MIN_BLOCK_SAMPLES or blocks < 3 or rows.numel() < _MIN_SAMPLES:
        return NO_EVIDENCE
    # Blocks, each with the end of the one before.
    cut = rows[:, count - order : blocks * count].unfold(1, count + order, count)
    products = covariances(cut.flatten(0, 1), order)
    coefficients = prediction_coefficients(products, torch.arange(count) >= order)
    past = cut.unfold(2, order + 1, 1).flip(-1)
    left = (past @ coefficients).abs().square()  # [row, block, place]
    # As many places as a break reaches.
    within = left[..., order:].unfold(2, order, 1).mean((0, 1, 3)).max()
    border = left[..., :order].mean((0, 2))
    classes = [border[k::n] for n in (3, 4) for k in range(n) if len(border) >= n]
    quietest = min((part.mean() for part in classes), default=border.mean())
    parts = 1 if settings.real else 2
    power = rows.abs().square().mean()
    rounding = parts / 12
    first = torch.minimum(left[..., :order].mean((0, 1)), power) + rounding
    rest = left[..., order:].mean() + rounding
    nats = (first.log().sum() + (count - order) * rest.log()) / count
    nats = 0.5 * (nats - math.log(parts))
    return LayoutEvidence(float(quietest) / max(float(within), rounding), float(nats))


def block_coherence(words: np.ndarray, settings: ChirpSettings) -> float | None:
    """Coherence of blocks after as many as there are channels, which is that of one channel's.

    Args:
        words: Words of the file.
        settings: Settings with the numbers of channels.
    """
    rows = sample_rows(words, settings)
    count, turns = settings.samples, _block_period(settings)
    blocks = rows[:, : rows.shape[1] // count * count].unflatten(1, (-1, count))
    if blocks.shape[1] <= turns:
        return None
    one, other = blocks[:, turns:], blocks[:, :-turns]
    level = (one.abs().square().sum() * other.abs().square().sum()).sqrt()
    return float((one * other.conj()).sum().abs() / level.clamp_min(1e-300))


def sample_rows(words: np.ndarray, settings: ChirpSettings) -> Complex128[Tensor, "row sample"]:
    """Samples in the order of the stream: one row, or one a lane where receivers are side by side.

    Args:
        words: Words from the start of a file.
        settings: Their lanes, and whether samples are real.
    """
    s, parts = settings, 1 if settings.real else 2
    chirp = count_channels(s) * s.samples * parts
    whole = words[: min(len(words), _MAX_WORDS) // chirp * chirp].astype(np.float64)
    if s.lanes == LANE_COUNT:
        sides = whole.reshape(-1, parts, LANE_COUNT)
        rows = sides[..., [number - 1 for number in s.receivers]].transpose(2, 0, 1)
    else:
        rows = whole.reshape(1, -1, parts, 2).swapaxes(2, 3) if parts == 2 else whole
        rows = rows.reshape(1, -1, parts)
    values = rows[..., 0] + (1j * rows[..., 1] if parts == 2 else 0j)
    return torch.from_numpy(np.ascontiguousarray(values))


def better_candidates(
    found: list[LayoutCandidate], stated_evidence: LayoutEvidence
) -> list[LayoutCandidate]:
    """Candidates of whose blocks the samples speak, against those that are stated.

    Args:
        found: Result of ``candidates``.
        stated_evidence: Evidence of the settings as they are stated.
    """
    if stated_evidence.breaks_at_borders:
        return []
    most = stated_evidence.code_length - MIN_CODE_SAVING
    breaking = [one for one in found if one.evidence.breaks_at_borders]
    return [one for one in breaking if one.evidence.code_length < most]


def silent_lanes_contradict(words: np.ndarray, settings: ChirpSettings) -> bool:
    """Return True if lanes of receivers that are not stated hold samples.

    Args:
        words: Words of the file.
        settings: As stated.
    """
    return settings.lanes == LANE_COUNT and not set(_active_lanes(words)) <= set(settings.receivers)


def format_advice(found: list[LayoutCandidate]) -> str:
    """List the layouts that fit, best first, and say if the samples decide between them.

    Args:
        found: Result of ``candidates``.
    """
    best, own = found[0].evidence, block_layout(found[0].settings)
    rivals = [one.evidence for one in found if block_layout(one.settings) != own]
    costs = [one.code_length - best.code_length for one in rivals if one.breaks_at_borders]
    dearer = min(costs, default=math.inf)
    cheapest = min((one.code_length for one in rivals), default=math.inf)
    cheap = cheapest > best.code_length - MIN_CODE_SAVING
    clear = best.breaks_at_borders and dearer >= MIN_CODE_SAVING and cheap
    near = [
        one
        for one in found
        if block_layout(one.settings) == own
        or not (clear or one.evidence.code_length - best.code_length >= MIN_CODE_SAVING)
        or not best.breaks_at_borders
    ]
    groups: dict[int, list[LayoutCandidate]] = {}
    for one in _most_coherent(near) if clear else near:
        groups.setdefault(_block_period(one.settings) if clear else 0, []).append(one)
    fewest = (one for group in groups.values() for one in _fewest_changes(group))
    near = sorted(fewest, key=lambda one: len(one.changes))
    shown = " or ".join(map(str, near[:_MAX_LISTED]))
    said = "its samples do not tell where blocks end"
    if clear:
        said = refusal_text("layouts.border_ratio", best.border_ratio)
        if dearer < math.inf:
            said += f"; other blocks that do so cost {dearer / math.log(2):.2g} bits a word more"
    do = "correct the settings"
    if len(near) > 1:
        do = "the samples do not tell these apart: find out which, and correct the settings"
    options = " --set ".join(f"{name}={value}" for name, value in near[0].changes.items())
    return f"what fits: {shown} ({said}); {do}, or look with --set {options}"


def _fewest_changes(group: list[LayoutCandidate]) -> list[LayoutCandidate]:
    """Those with the fewest changes."""
    fewest = min(len(one.changes) for one in group)
    return [one for one in group if len(one.changes) == fewest]


def _most_coherent(near: list[LayoutCandidate]) -> list[LayoutCandidate]:
    """Those whose blocks of one channel are most alike."""
    highest = max((one.coherence for one in near if one.coherence is not None), default=0.0)
    least = _MIN_RELATIVE_COHERENCE * highest
    return [one for one in near if one.coherence is None or one.coherence >= least]
