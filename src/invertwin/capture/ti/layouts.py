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
from invertwin.capture.prediction import covariances, predictor
from invertwin.errors import InputError

LANE_COUNT = 4
_MOST_WORDS = 2**17  # that are looked at
_ORDER = 6  # of the prediction of complex samples
_FEWEST_SAMPLES = 8  # of a block
_FEWEST = 256  # samples that tell something
_MOST_NAMED = 6
_MOST_ELEMENTS = 4
# Failure of prediction at borders over that within, and nats a word that other blocks cost more:
# from these on, the samples tell.
CLEAR = 2.0
CHEAPER = 0.03
# Coherence of blocks of one channel over the highest of other candidates.
_ALIKE = 0.98
_COUNTS = {"receivers": "receivers", "transmitters": "transmit_order"}
_SIZES = ("samples", "loops", "frames")
NAMES = ("lanes", "real", *_COUNTS, *_SIZES)
"""Names of settings that can be changed by ``changed``."""


def changed(settings: ChirpSettings, changes: Mapping[str, Any]) -> ChirpSettings:
    """Settings with some numbers replaced.

    Args:
        settings: What the file says.
        changes: By the names in ``NAMES``; numbers of receivers and transmitters mean the first
            ones.

    Raises:
        InputError: Another name, or values that settings cannot have.
    """
    unknown = set(changes) - set(NAMES)
    if unknown:
        raise InputError(
            f"expected changes of {', '.join(NAMES)}, got {sorted(unknown)}; correct other numbers "
            "in the settings file"
        )
    values = {
        _COUNTS.get(name, name): tuple(range(1, value + 1)) if name in _COUNTS else value
        for name, value in changes.items()
    }
    return replace(settings, **values)


@dataclass(frozen=True)
class Evidence:
    """What samples say of the blocks into which settings cut them.

    Attributes:
        breaks: Failure of prediction at the quietest borders over the largest anywhere within:
            above 1 for the right blocks where there is an echo; below for others.
        cost: Length of a code of the samples by their predictions, but for a constant [nats a
            word]. Wrong blocks, and samples in a wrong order, are predicted worse.
    """

    breaks: float
    cost: float


NOTHING = Evidence(0.0, math.inf)


@dataclass(frozen=True)
class Candidate:
    """Settings with which the size of a file is exact.

    Attributes:
        changes: What is changed.
        settings: With the changes.
        evidence: Of the samples.
        repeats: Coherence of blocks that the settings give to one channel; None = the file is too
            short.
    """

    changes: dict[str, Any]
    settings: ChirpSettings
    evidence: Evidence
    repeats: float | None

    def __str__(self) -> str:
        return ", ".join(f"{name}={value}" for name, value in self.changes.items())


def layout(settings: ChirpSettings) -> tuple[int, ...]:
    """What of the settings says where blocks begin and end."""
    return settings.lanes or 0, int(settings.real), settings.samples


def channels(settings: ChirpSettings) -> int:
    """Receivers whose words are in the file: with 4 lanes all of the device."""
    return LANE_COUNT if settings.lanes == LANE_COUNT else len(settings.receivers)


def frame_words(settings: ChirpSettings) -> int:
    """16-bit words of a frame."""
    chirps = settings.loops * len(settings.transmit_order)
    return chirps * channels(settings) * settings.samples * (1 if settings.real else 2)


def fits_layout(settings: ChirpSettings) -> str | None:
    """Why no DCA1000 records a file with these settings; None = it does."""
    if settings.lanes == LANE_COUNT and max(settings.receivers) > LANE_COUNT:
        return (
            f"receivers 1 to {LANE_COUNT}, one per lane, got {settings.receivers}; the DCA1000 "
            "records one device"
        )
    count = settings.samples * len(settings.receivers)
    if settings.lanes == 2 and not settings.real and count % 2:
        return (
            f"an even number of samples per chirp through 2 lanes, got {count}; they come in "
            "pairs, the settings are those of another recording"
        )
    return None


def candidates(words: np.ndarray, settings: ChirpSettings) -> list[Candidate]:
    """Settings with one change or two with which a file's size is exact.

    A ramp holds the samples, the period of frames holds the ramps.

    Args:
        words: Of the file.
        settings: That contradict it. Without a number of frames, any number of whole ones fits.

    Returns:
        Those whose blocks break at their borders first, the cheapest before others; with the same
        blocks, those with fewer changes.
    """
    active = _active(words)
    own = {name: len(getattr(settings, key)) for name, key in _COUNTS.items()}
    choices = {
        "lanes": [6 - (settings.lanes or 2)],
        "real": [not settings.real],
        **{name: [n for n in range(1, _MOST_ELEMENTS + 1) if n != own[name]] for name in own},
    }
    found: list[Candidate] = []
    known: dict[tuple[int, ...], Evidence] = {}
    alike: dict[tuple[int, ...], float | None] = {}
    for count in (1, 2):
        for names in combinations(NAMES, count):
            fixed = [name for name in names if name in choices]
            free = [name for name in names if name in _SIZES]
            for values in product(*(choices[name] for name in fixed)):
                chosen = dict(zip(fixed, values, strict=True))
                for solved in _solved(free, chosen, len(words), settings):
                    made = _possible(chosen | solved, settings)
                    if made is None or (made.lanes == LANE_COUNT and made.receivers != active):
                        continue
                    key = layout(made)
                    period = (*key, _blocks(made))
                    if key not in known:
                        known[key] = evidence(words, made)
                    if period not in alike:
                        alike[period] = repeats(words, made)
                    found.append(Candidate(chosen | solved, made, known[key], alike[period]))

    def order(one: Candidate) -> tuple[Any, ...]:
        breaks = one.evidence.breaks >= CLEAR
        return (not breaks, one.evidence.cost if breaks else 0.0, len(one.changes))

    return sorted(found, key=order)


def _active(words: np.ndarray) -> tuple[int, ...]:
    """Numbers of the 4 lanes that are not silent."""
    lanes = words[: len(words) // LANE_COUNT * LANE_COUNT].reshape(-1, LANE_COUNT)
    return tuple(int(lane) + 1 for lane in np.flatnonzero(lanes.any(0)))


def _blocks(settings: ChirpSettings) -> int:
    """Blocks in the stream until the same transmitter and receiver come again."""
    side_by_side = settings.lanes == LANE_COUNT
    return len(settings.transmit_order) * (1 if side_by_side else len(settings.receivers))


def _solved(
    free: list[str], known: dict[str, Any], size: int, settings: ChirpSettings
) -> Iterator[dict[str, int]]:
    """Values of the free sizes with which the rest makes the size exact."""
    try:
        base = changed(settings, known | dict.fromkeys((n for n in free if n != "frames"), 2))
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
        for value in _divisors(whole):
            yield {free[0]: value, free[1]: whole // value}


def _divisors(number: int) -> list[int]:
    low = [n for n in range(1, math.isqrt(number) + 1) if number % n == 0]
    return sorted({*low, *(number // n for n in low)})


def _possible(changes: dict[str, Any], settings: ChirpSettings) -> ChirpSettings | None:
    """The settings with changes, if a device could have recorded them."""
    if changes.get("samples", _FEWEST_SAMPLES) < _FEWEST_SAMPLES:
        return None
    if any(getattr(settings, name, None) == value for name, value in changes.items()):
        return None
    try:
        made = changed(settings, changes)
    except InputError:  # the ramp does not hold the samples
        return None
    if fits_layout(made) is not None:
        return None
    ramps = made.loops * len(made.transmit_order) * (made.idle_time + made.ramp_time)
    if made.frame_period is not None and ramps > made.frame_period * (1 + 1e-9):
        return None
    return made


def evidence(words: np.ndarray, settings: ChirpSettings) -> Evidence:
    """How well the samples break where the settings say that blocks end.

    Borders are taken in classes, every second and every third or fourth, and the quietest class
    counts: blocks that are cut in two have borders without a break.

    Args:
        words: Of the file.
        settings: Of which the layout counts.
    """
    rows = sequences(words, settings)
    count = settings.samples
    # A real tone is two complex ones.
    order = min(_ORDER * (2 if settings.real else 1), count // 4)
    blocks = rows.shape[1] // count
    if count < _FEWEST_SAMPLES or blocks < 3 or rows.numel() < _FEWEST:
        return NOTHING
    # Blocks, each with the end of the one before.
    cut = rows[:, count - order : blocks * count].unfold(1, count + order, count)
    coefficients = predictor(covariances(cut.flatten(0, 1), order), torch.arange(count) >= order)
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
    return Evidence(float(quietest) / max(float(within), rounding), float(nats))


def repeats(words: np.ndarray, settings: ChirpSettings) -> float | None:
    """Coherence of blocks after as many as there are channels, which is that of one channel's.

    Args:
        words: Of the file.
        settings: How many channels take turns.
    """
    rows = sequences(words, settings)
    count, turns = settings.samples, _blocks(settings)
    blocks = rows[:, : rows.shape[1] // count * count].unflatten(1, (-1, count))
    if blocks.shape[1] <= turns:
        return None
    one, other = blocks[:, turns:], blocks[:, :-turns]
    level = (one.abs().square().sum() * other.abs().square().sum()).sqrt()
    return float((one * other.conj()).sum().abs() / level.clamp_min(1e-300))


def sequences(words: np.ndarray, settings: ChirpSettings) -> Complex128[Tensor, "row sample"]:
    """Samples in the order of the stream: one row, or one a lane where receivers are side by side.

    Args:
        words: From the start of a file.
        settings: Their lanes, and whether samples are real.
    """
    s, parts = settings, 1 if settings.real else 2
    chirp = channels(s) * s.samples * parts
    whole = words[: min(len(words), _MOST_WORDS) // chirp * chirp].astype(np.float64)
    if s.lanes == LANE_COUNT:
        sides = whole.reshape(-1, parts, LANE_COUNT)
        rows = sides[..., [number - 1 for number in s.receivers]].transpose(2, 0, 1)
    else:
        rows = whole.reshape(1, -1, parts, 2).swapaxes(2, 3) if parts == 2 else whole
        rows = rows.reshape(1, -1, parts)
    values = rows[..., 0] + (1j * rows[..., 1] if parts == 2 else 0j)
    return torch.from_numpy(np.ascontiguousarray(values))


def better(found: list[Candidate], stated: Evidence) -> list[Candidate]:
    """Candidates of whose blocks the samples speak, against those that are stated.

    Args:
        found: Of ``candidates``.
        stated: Of the settings as they are.
    """
    if stated.breaks >= CLEAR:
        return []
    return [
        one
        for one in found
        if one.evidence.breaks >= CLEAR and one.evidence.cost < stated.cost - CHEAPER
    ]


def silent_lanes_contradict(words: np.ndarray, settings: ChirpSettings) -> bool:
    """Whether lanes of receivers that are not stated hold samples.

    Args:
        words: Of the file.
        settings: As stated.
    """
    return settings.lanes == LANE_COUNT and not set(_active(words)) <= set(settings.receivers)


def advice(found: list[Candidate]) -> str:
    """What fits, best first, and whether the samples tell.

    Args:
        found: Of ``candidates``.
    """
    first = found[0]
    own = layout(first.settings)
    rivals = [one.evidence for one in found if layout(one.settings) != own]
    dearer = min(
        (one.cost - first.evidence.cost for one in rivals if one.breaks >= CLEAR), default=math.inf
    )
    cheapest = min((one.cost for one in rivals), default=math.inf)
    clear = (
        first.evidence.breaks >= CLEAR
        and dearer >= CHEAPER
        and cheapest > first.evidence.cost - CHEAPER
    )
    near = [
        one
        for one in found
        if layout(one.settings) == own
        or not (clear or one.evidence.cost - first.evidence.cost >= CHEAPER)
        or first.evidence.breaks < CLEAR
    ]
    groups: dict[int, list[Candidate]] = {}
    for one in _repeating(near) if clear else near:
        groups.setdefault(_blocks(one.settings) if clear else 0, []).append(one)
    near = sorted((one for group in groups.values() for one in _simplest(group)), key=_size)
    shown = " or ".join(map(str, near[:_MOST_NAMED]))
    said = "its samples do not tell where blocks end"
    if clear:
        said = (
            f"prediction fails {first.evidence.breaks:.3g} times more at the ends of its blocks "
            "than anywhere within"
        )
        if dearer < math.inf:
            said += f"; other blocks that do so cost {dearer / math.log(2):.2g} bits a word more"
    do = "correct the settings"
    if len(near) > 1:
        do = "the samples do not tell these apart: find out which, and correct the settings"
    return f"what fits: {shown} ({said}); {do}, or look with --set {_option(near[0])}"


def _size(candidate: Candidate) -> int:
    return len(candidate.changes)


def _simplest(group: list[Candidate]) -> list[Candidate]:
    """Those with the fewest changes."""
    fewest = min(map(_size, group))
    return [one for one in group if _size(one) == fewest]


def _repeating(near: list[Candidate]) -> list[Candidate]:
    """Those whose blocks of one channel are most alike."""
    highest = max((one.repeats for one in near if one.repeats is not None), default=0.0)
    return [one for one in near if one.repeats is None or one.repeats >= _ALIKE * highest]


def _option(candidate: Candidate) -> str:
    return " --set ".join(f"{name}={value}" for name, value in candidate.changes.items())
