"""Faults of a recording that its samples show: each with its evidence and a stated threshold.

Sound samples rarely look faulty: every threshold is that of a false-alarm probability in noise, and
every fault has a shape of its own that echoes would have by a rare coincidence only.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Complex, Complex128, Float64, Int64
from scipy.signal.windows import blackmanharris
from scipy.special import gammainccinv, gammaincinv
from torch import Tensor

from invertwin.capture.capture import Capture
from invertwin.capture.chirp_capture import ChirpCapture
from invertwin.capture.prediction import covariances, prediction_coefficients, prediction_residuals
from invertwin.constants import read_table
from invertwin.radar.processing.reflectors import noise_power
from invertwin.radar.radar import require_sampled_waveform
from invertwin.radar.waveform import SampledWaveform, unit_window

_LEAKAGE_CELLS = 3  # from range zero, in which leakage outshines everything
_MAX_SAMPLES, _MAX_CHANNELS = 2**20, 64  # that are looked at
_STRONGEST_RATES = 3  # strongest range rates of a frame in which a pattern is looked for

_TEXTS: dict[str, str] = read_table("invertwin.capture", "faults.toml")

_Beat = Complex[Tensor, "frame chirp tx rx sample"]
_LimitedBeat = Complex128[Tensor, "frame chirp tx rx sample"]  # not more than is looked at
_Rates = Complex128[Tensor, "rate channel sample"]


@dataclass(frozen=True)
class Fault:
    """A fault of a recording.

    Attributes:
        name: ``complex only by type``, ``ghosts``, ``dropped samples``, ``silent channels``,
            ``phase break``, ``leakage`` or ``saturation``.
        evidence: Evidence in the samples, and the remedy.
    """

    name: str
    evidence: str

    def __str__(self) -> str:
        return f"{self.name}: {self.evidence}"


def _fault(name: str, *values: float | str) -> Fault:
    """A fault with its evidence, whose text is that of `faults.toml`."""
    return Fault(name, _TEXTS[name].format(*values))


def find_faults(
    recording: Capture | ChirpCapture,
    range_min: float | None = None,
    range_max: float | None = None,
) -> list[Fault]:
    """Find the faults of a recording, the ones that explain others first.

    Args:
        recording: Samples as they were recorded, before a calibration.
        range_min: Least range of the strongest echo [m]; None = as ``search_ranges``.
        range_max: Up to where.
    """
    if isinstance(recording, Capture):
        if "beat" not in recording.dataset:
            return []
        beat = recording.beat[:, None]
        real = _is_analytic(beat)
    else:
        beat, real = recording.beat, recording.real
    radar = recording.radar()
    waveform = require_sampled_waveform(radar)
    found = [detect_saturation(beat, real=real), detect_lost_samples(beat, real=real)]
    found.append(detect_silent_channels(beat))
    beat = _limit_samples(beat)
    if not any(found):
        # Both of them break phases and make ghosts, too.
        found.append(detect_phase_break(beat, real=real))
        rates, opposite = _strongest_range_rates(beat), _strongest_range_rates(beat, -1)
        found.append(detect_ghosts(rates, opposite, waveform, real=real))
    found.append(detect_iq_images(beat))
    shown = search_ranges(recording, range_min, range_max)
    found.append(detect_leakage(beat, waveform, radar.window, shown, real=real))
    return [fault for fault in found if fault is not None]


def search_ranges(
    recording: Capture | ChirpCapture, range_min: float | None, range_max: float | None
) -> tuple[float, float]:
    """Ranges in which echoes are looked for [m].

    Leakage outshines what is within 3 cells of range zero. The unambiguous range ends there too:
    its last 3 cells are those before zero, and those of real samples are mirrored ones.

    Args:
        recording: Recording with samples.
        range_min: Nearest range that the user has chosen [m].
        range_max: Farthest range that the user has chosen [m].
    """
    radar = recording.radar()
    leaking = _LEAKAGE_CELLS * require_sampled_waveform(radar).range_resolution
    # Ranges that count from a scene begin before it.
    near = max(leaking - float(radar.origins.min()), radar.range_limits[0])
    real = isinstance(recording, ChirpCapture) and recording.real
    far = radar.range_limits[1] * (0.5 if real else 1.0)
    if not bool(radar.origins.any()):
        far -= leaking
    return near if range_min is None else range_min, far if range_max is None else range_max


# Shares of the range between the ends of the values. Where values are smooth, the outermost code
# holds few of those in the band beside it; clipped ones pile up in it.
_BAND = 0.1
_MIN_END_FRACTION = 0.5
_MIN_CLIPPED_FRACTION = 1e-3
_MIN_CLIPPED_COUNT = 8
_MIN_CODES = 200  # of the largest value, below which a pure tone piles up too


def detect_saturation(beat: _Beat, *, real: bool) -> Fault | None:
    """Values that pile up at the ends of their range, whatever the converter's full scale is.

    A tone of amplitude A that is clipped at A/s has ``acos(1/s)/π`` of its values at either end
    and ``(acos((1 − b)/s) − acos(1/s))/π`` in the band b = 0.1 beside it. From s = 1.02 on (12 %
    of the values of I and of Q) the first is more than half of the second. Smooth values, rounded
    to a step q, have at most ``√(q/bA)`` of them there; the limit is three times as much or more.

    Args:
        beat: Samples.
        real: Whether they were real.
    """
    picked = beat[:4, :: max(1, beat.shape[1] // 2)][:, :2]
    values = picked.real if real else torch.view_as_real(picked.resolve_conj())
    codes = values.unique()
    if len(codes) < 4 * _MIN_CLIPPED_COUNT:
        return None
    for end in (values, -values):
        top, size = end.max(), float(values.abs().max())
        step = float(codes.diff().min().clamp_min(1e-9 * size))
        hits = int((end >= top - 1e-6 * size).sum())
        beside = int((end >= top - _BAND * size).sum()) - hits
        least = 3 * math.sqrt(step / (_BAND * size))
        many = hits >= max(_MIN_CLIPPED_COUNT, _MIN_CLIPPED_FRACTION * values.numel())
        if step * _MIN_CODES <= size and many and hits > max(_MIN_END_FRACTION, least) * beside:
            return _fault("saturation", hits / values.numel(), beside / values.numel())
    return None


_FALSE_ALARM_PROBABILITY = 1e-4  # probability that a sound recording in noise is called faulty
_MIN_RUN_LENGTH = 8
_MAX_NAMED = 4  # channels


def detect_lost_samples(beat: _Beat, *, real: bool) -> Fault | None:
    """Runs of zeros within chirps that are too long to be rounded noise.

    With a share z of zeros elsewhere, one of n samples begins L zeros with a probability below
    ``n z^L``, which must be 1e-4 or less; at least 8 zeros. Channels of zeros only are left out.

    Args:
        beat: Samples.
        real: Whether they were real.
    """
    rows = (beat.real if real else beat).flatten(0, 1).flatten(1, 2)
    rows = rows[:, (rows != 0).flatten(2).any(2).any(0)]
    zero = rows.flatten(0, 1) == 0
    if not zero.numel() or not bool(zero.any()):
        return None
    # Of the run that each sample is in: how far it has come, and how far it goes.
    before, after = _zero_run_lengths(zero), _zero_run_lengths(zero.flip(1)).flip(1)
    length = torch.where(zero, before + after - 1, 0)
    longest, long = int(length.max()), length >= _MIN_RUN_LENGTH
    share = max(int((zero & ~long).sum()), 1) / max(int((~long).sum()), 1)
    if longest < _MIN_RUN_LENGTH or zero.numel() * share**longest > _FALSE_ALARM_PROBABILITY:
        return None
    return _fault("dropped samples", int(long.sum()), zero.numel(), longest)


def detect_silent_channels(beat: _Beat) -> Fault | None:
    """Channels with zeros only, beside others with signals.

    Args:
        beat: Samples.
    """
    sound = (beat != 0).any(4).any(0).any(0)
    named = [f"TX {tx + 1} with RX {rx + 1}" for tx, rx in torch.nonzero(~sound).tolist()]
    if not named or not bool(sound.any()):
        return None
    shown = ", ".join(named[:_MAX_NAMED]) + ", …" * (len(named) > _MAX_NAMED)
    return _fault("silent channels", len(named), sound.numel(), shown)


def _zero_run_lengths(zero: Bool[Tensor, "row sample"]) -> Int64[Tensor, "row sample"]:
    """Lengths of the runs of zeros that end at each sample."""
    place = torch.arange(1, zero.shape[1] + 1)
    return place - torch.where(zero, 0, place).cummax(1).values


# Bins beside range zero, and beside half of the unambiguous range, where a tone is its own image.
_SELF_IMAGE_BINS = 6
_MIN_TOTAL_COHERENCE = 0.97
_MIN_BIN_COHERENCE = 0.5


def detect_iq_images(beat: _LimitedBeat) -> Fault | None:
    """Complex by type only: every frequency has its mirror image at the negative one.

    ``X(−f) = e^{2jα} conj X(f)`` where I and Q lie on one line. Coherence
    ``|Σ X(f) X(−f)| / Σ (|X(f)|² + |X(−f)|²)/2`` is 1 then. Together all frequencies must have
    0.97, below which Q has 1.5 % of I's power; each alone must have 0.5, also where noise is all
    there is. A pair of reflectors whose echoes mirror each other has the first, but its noise has
    not the second.

    Args:
        beat: Samples.
    """
    tx, rx, count = beat.shape[2:]
    edge = min(_SELF_IMAGE_BINS, count // 8)
    if edge < 2:
        return None
    chosen = beat[:, :64].permute(2, 3, 0, 1, 4).reshape(tx * rx, -1, count)
    spectrum = torch.fft.fft(chosen * _blackman_harris_window(count))
    near = torch.arange(edge, count // 2)
    one, other = spectrum[..., near], spectrum[..., -near]
    level = 0.5 * (one.abs().square() + other.abs().square()).sum(1)
    own = near > count // 2 - edge
    if float(level[:, ~own].sum()) <= 1e-9 * float(spectrum.abs().square().sum()):
        return None
    products = (one * other).sum(1)
    # The line may lie differently in each channel, as after a calibration.
    total = products[:, ~own].sum(1, keepdim=True)
    turned = (products * torch.polar(torch.ones_like(total.real), -total.angle())).real
    weighted = float(turned[:, ~own].sum() / level[:, ~own].sum())
    least = float((turned.sum(0) / level.sum(0).clamp_min(torch.finfo(torch.float64).tiny)).min())
    if weighted < _MIN_TOTAL_COHERENCE or least < _MIN_BIN_COHERENCE:
        return None
    return _fault("complex only by type", weighted)


# The ghost's energy over the power of noise in one cell: below, a ghost is none that counts. What
# else may differ from the echo: noise, and a part of the ghost.
_MIN_GHOST_TO_NOISE = 100.0
_MAX_RESIDUAL_FRACTION = 0.03
_MIN_PEAK_TO_SURROUNDINGS = 10.0
# Share of a spectrum without echoes; what its window leaves.
_NOISE_ONLY_FRACTION, _WINDOW_FLOOR = 0.2, 1e-10
_MAX_IQ_IMAGE = 0.7  # of the echo's amplitude
_MIN_RELATIVE_ECHO = 1e-4  # of the strongest one's power, that is searched for ghosts


def detect_ghosts(
    rates: _Rates, opposite: _Rates, waveform: SampledWaveform, *, real: bool
) -> Fault | None:
    """Echoes with copies: odd samples unlike even ones, or I unlike Q.

    Factors that alternate from sample to sample move a part of every echo by half the sampling
    rate. The copy has the echo's line shape, channels and range rates, times one factor g; of real
    samples, and where I and Q alternate, also the conjugate at ``½ − f``. Where I and Q differ in
    gain, or by another phase than 90°, the conjugate is at ``−f``, with the opposite direction and
    range rate, and weaker than the echo (else it is a pair). Such a copy is distinguished from
    an echo of its own by what is left once ``g`` times the echo is taken away: noise, and at most
    3 % of the copy. The copy's energy is at least 100 times what noise and other echoes have beside
    it, below which chance agreement is frequent.

    Args:
        rates: Result of ``_strongest_range_rates``.
        opposite: The opposite range rates, where conjugates are.
        waveform: Its unambiguous range.
        real: Whether the samples were real.
    """
    count = rates.shape[-1]
    tapered, mirrored = (part * _blackman_harris_window(count) for part in (rates, opposite))
    spectra = (torch.fft.fft(part, 4 * count).flatten(0, 1) for part in (tapered, mirrored))
    power, power_of_mirrored = (spectrum.abs().square().mean(0) for spectrum in spectra)
    looks, top = rates.shape[0] * rates.shape[1], float(power.max())
    own_half = power[: 2 * count] if real else power
    noise = max(noise_power(own_half, looks, _NOISE_ONLY_FRACTION), _WINDOW_FLOOR * top)
    highest = (power >= power.roll(1)) & (power > power.roll(-1))
    strong = highest & (power > _MIN_RELATIVE_ECHO * top) & (power > _MIN_GHOST_TO_NOISE * noise)
    # Of real samples only the last is a copy.
    kinds = [(0.0, -1.0, True), (0.5, 1.0, False), (0.5, -1.0, True)][2 if real else 0 :]
    for place in torch.nonzero(strong)[:, 0].tolist():
        echo = place / (4 * count)
        own = _adjacent_lines(tapered, echo)
        for offset, sign, conjugate in kinds:
            at = (offset + sign * echo) % 1
            if abs((at - echo + 0.5) % 1 - 0.5) * count < _SELF_IMAGE_BINS:
                continue
            searched, powers = (mirrored, power_of_mirrored) if conjugate else (tapered, power)
            around = max(noise, _power_beside(powers, at))
            if _power_at(powers, at) < _MIN_PEAK_TO_SURROUNDINGS * around:
                continue
            copy = _adjacent_lines(searched, at)
            like = own.flip(-1).conj() if conjugate else own
            factor = torch.vdot(like.flatten(), copy.flatten()) / like.abs().square().sum()
            explained = float(factor.abs().square() * like.abs().square().sum())
            left = float((copy - factor * like).abs().square().sum())
            chance = around * copy.numel() * (1 + 4 / math.sqrt(looks))
            if (
                explained > _MIN_GHOST_TO_NOISE * around
                and left < chance + _MAX_RESIDUAL_FRACTION * explained
                and float(factor.abs()) < (1.05 if offset else _MAX_IQ_IMAGE)
            ):
                level = -20 * math.log10(float(factor.abs()))
                places = echo * waveform.max_range, at * waveform.max_range
                cause = _TEXTS["odd_samples" if offset else "unlike_iq"]
                return _fault("ghosts", *places, level, cause)
    return None


_PREDICTION_ORDER = 8  # of the prediction
_SETTLING_PART = 8  # part of a ramp
_MIN_RESIDUAL_RATIO = 4.0
_MIN_CHIRPS = 4


def detect_phase_break(beat: _LimitedBeat, *, real: bool) -> Fault | None:
    """A sample that does not follow from the ones before it, in all chirps or in one.

    Tones are predicted from the samples before, and after. Where the phase jumps or samples are
    missing, the residual of all windows that hold the place stands out. Residuals elsewhere tell
    how much they scatter, as a gamma distribution of the shape that their quartiles have. The limit
    is exceeded by chance with a probability of 1e-4, and is at least 4 times the median. The first
    eighth of a ramp, in which synthesiser and converter settle, is left out.

    Args:
        beat: Samples.
        real: Whether they were real: the ends of an analytic signal follow from nothing.
    """
    count = beat.shape[-1]
    order = min(_PREDICTION_ORDER, count // 6)
    if order < 2:
        return None
    if real:
        beat = beat.real.to(beat.dtype)
    rates = _strongest_range_rates(beat)
    settled = count // _SETTLING_PART
    first, rows = settled + order, rates.flatten(0, 1)[:, settled:]
    products = covariances(rows, order)
    kept = torch.ones(len(products), dtype=torch.bool)
    left, place = torch.zeros(0), 0
    for _ in range(3):
        residuals = prediction_residuals(products, prediction_coefficients(products, kept))
        left = _window_means(residuals, order)
        place = int(left.argmax())
        kept[:] = True
        kept[place : place + order] = False
    away = torch.ones(len(left), dtype=torch.bool)
    away[max(place - order + 1, 0) : place + order] = False
    found = _outlier_ratio(left, left[away], len(rows)) if bool(away.any()) else None
    if found is not None:
        return _fault("phase break", place + first, "chirps", found)
    chirps = beat.flatten(0, 1).flatten(1, 2)[..., settled:]
    if len(chirps) < _MIN_CHIRPS:
        return None
    products = covariances(chirps.flatten(0, 1), order)
    coefficients = prediction_coefficients(products, torch.ones_like(kept))
    past = chirps.unfold(-1, order + 1, 1).flip(-1)
    both = [(past @ part).abs().square() for part in (coefficients, coefficients.conj().flip(0))]
    each = _window_means(0.5 * (both[0] + both[1]).mean(1), order)
    found = _outlier_ratio(each, each.flatten(), chirps.shape[1])
    if found is None:
        return None
    chirp, place = divmod(int(each.argmax()), each.shape[1])
    return _fault("phase break", place + first, f"chirp {chirp % beat.shape[1]}", found)


def _power_at(power: Float64[Tensor, " bin"], frequency: float) -> float:
    return float(power[round(frequency * len(power)) % len(power)])


def _power_beside(power: Float64[Tensor, " bin"], frequency: float) -> float:
    """Power on the quieter side of a line: as much as on it where a break has spread an echo."""
    count = len(power) // 4
    reach = min(_SELF_IMAGE_BINS, count // 6) / count
    return min(_power_at(power, frequency - reach), _power_at(power, frequency + reach))


def _window_means(values: Tensor, count: int) -> Tensor:
    """Means over the windows of prediction that a break at each place cuts."""
    return values.unfold(-1, count, 1).mean(-1)


def _outlier_ratio(values: Tensor, reference: Tensor, averages: int) -> float | None:
    """The largest over the median, if chance does not explain it."""
    low, middle, high = (float(reference.quantile(q)) for q in (0.25, 0.5, 0.75))
    if middle <= 0:
        return None
    shape = _gamma_shape(high / max(low, 1e-300), averages)
    rare = _FALSE_ALARM_PROBABILITY / values.numel()
    limit = float(gammainccinv(shape, rare) / gammaincinv(shape, 0.5))
    ratio = float(values.max()) / middle
    return ratio if ratio > max(limit, _MIN_RESIDUAL_RATIO) else None


def _gamma_shape(quartile_ratio: float, maximum: float) -> float:
    """Shape of the gamma distribution whose upper quartile is so many times the lower one."""
    low, high = 0.2, float(maximum)
    for _ in range(40):
        shape = math.sqrt(low * high)
        if float(gammaincinv(shape, 0.75) / gammaincinv(shape, 0.25)) > quartile_ratio:
            low = shape
        else:
            high = shape
    return low


# m, half the length of ways from transmitters to receivers over a board and its cover.
_BOARD_RANGE = 0.3
# Over the window's sidelobes; ends of a chirp, which do not meet, raise those of analytic signals.
_SIDELOBE_FACTOR, _REAL_SIDELOBE_FACTOR = 4.0, 16.0


def detect_leakage(
    beat: _LimitedBeat,
    waveform: SampledWaveform,
    window: str,
    search_range: tuple[float, float],
    *,
    real: bool,
) -> Fault | None:
    """The strongest echo is the transmitters heard over the board, or the skirt of that.

    Ways over a board and its cover are shorter than 0.6 m, 2 ns. Beside its range, leakage has
    the window's sidelobes, also at the far end of the unambiguous range. What is not four times
    as strong as these, of real samples 16 times, is taken for them, and so is what only falls from
    there: no peak.

    Args:
        beat: Samples.
        waveform: Its ranges.
        window: Window over the samples.
        search_range: First and last range where echoes are looked for [m].
        real: Whether the samples were real.
    """
    cell, farthest, count = waveform.range_resolution, waveform.max_range, waveform.samples
    finer = 4
    spectrum = torch.fft.fft(beat * unit_window(window, count), finer * count)
    power = spectrum.abs().square().flatten(0, 3).mean(0)
    ranges = torch.arange(finer * count) * (cell / finer)
    near = ranges if real else torch.minimum(ranges, farthest - ranges)
    around = _LEAKAGE_CELLS * cell
    seen = (ranges >= search_range[0]) & (ranges <= search_range[1])
    zone = (ranges <= max(_BOARD_RANGE, around)) | (near <= around)
    highest = (power >= power.roll(1)) & (power >= power.roll(-1))
    source = int(torch.where(zone & highest, power, 0.0).argmax())
    strongest = int(torch.where(seen, power, 0.0).argmax())
    apart = (ranges - ranges[source])[:, None] + cell * torch.tensor([-0.5, 0.0, 0.5])
    response = waveform.range_response(apart.flatten().double(), window).reshape(apart.shape)
    skirt = (_REAL_SIDELOBE_FACTOR if real else _SIDELOBE_FACTOR) * power[source] * response.amax(1)
    over_board = float(ranges[strongest]) <= _BOARD_RANGE
    # At the first range that is shown, falling from one that is not.
    first = float(ranges[strongest]) < search_range[0] + cell and not bool(highest[strongest])
    flank = first and bool(power[source] > power[strongest])
    above = bool(power[strongest] > skirt[strongest])
    if not over_board and not flank and above:
        return None
    free = seen & ~zone & (power > skirt)
    advice = "nothing else is above its sidelobes"
    if bool(free.any()):
        best = int(torch.where(free, power, 0.0).argmax())
        level = 10 * math.log10(float(power[strongest] / power[best]))
        between = 0.5 * (float(ranges[best]) + max(_BOARD_RANGE, search_range[0]))
        advice = _TEXTS["beyond_leakage"].format(float(ranges[best]), level, between)
    return _fault("leakage", float(ranges[strongest]), float(near[source]), advice)


def _limit_samples(beat: _Beat) -> _LimitedBeat:
    """As many transmitters, chirps and frames, the latter in equal steps, as are looked at."""
    _, chirps, tx, rx, count = beat.shape
    senders = max(1, min(tx, _MAX_CHANNELS // rx))
    loops = max(1, min(chirps, _MAX_SAMPLES // (senders * rx * count)))
    frames = max(1, min(len(beat), _MAX_SAMPLES // (loops * senders * rx * count)))
    chosen = torch.linspace(0, len(beat) - 1, frames).long()
    return beat[chosen][:, :loops, :senders].to(torch.complex128)


def _is_analytic(beat: _Beat) -> bool:
    """Return True for real samples: no power in the farther half of the unambiguous range."""
    count = beat.shape[-1]
    power = torch.fft.fft(beat[:1]).abs().square().flatten(0, 3).sum(0)
    return bool(power[count // 2 + 1 :].sum() < _WINDOW_FLOOR * power.sum())


def _strongest_range_rates(beat: _LimitedBeat, sign: int = 1) -> _Rates:
    """The strongest range rates of every frame, in which noise of many chirps is averaged.

    Args:
        beat: samples.
        sign: -1 = the opposite ones of these.
    """
    rates = torch.fft.fft(beat.flatten(2, 3), dim=1) / math.sqrt(beat.shape[1])
    energy = rates.abs().square().sum((2, 3))
    best = energy.topk(min(_STRONGEST_RATES, beat.shape[1]), dim=1).indices
    pairs = zip(rates, sign * best % beat.shape[1], strict=True)
    return torch.cat([frame[chosen] for frame, chosen in pairs])


def _blackman_harris_window(count: int) -> Float64[Tensor, " sample"]:
    """The four-term window of Blackman and Harris: sidelobes of −92 dB."""
    return torch.from_numpy(blackmanharris(count, sym=False)) / count


def _adjacent_lines(tapered: _Rates, frequency: float) -> Complex128[Tensor, "rate channel line"]:
    """Spectra a bin below, at, and a bin above a frequency in cycles per sample."""
    count = tapered.shape[-1]
    lines = frequency + torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64) / count
    turns = torch.arange(count, dtype=torch.float64)[:, None] * lines
    return tapered @ torch.exp(-2j * math.pi * turns)
