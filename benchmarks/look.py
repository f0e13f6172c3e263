"""Does `look` tell faulty recordings from sound ones? 200 of either, simulated.

    python benchmarks/look.py [-o DIR] [--recordings 200] [--seed 1]

Prints a table and writes `metrics.json` into DIR (default `out/look`).

- `detected`: share of the faulty recordings whose fault is found. `detected_by.<fault>`: of each.
- `named`, `first`: share whose fault, or the right settings, is named, and named first.
  `named_settings`, `first_settings`: of wrong settings.
- `false_alarms`: share of the sound recordings of which anything is said.

Sound recordings: boards with 8 to 16 channels, 32 to 256 samples, 1 to 32 chirps of each
transmitter in turn, converters of 12 to 16 bits, I and Q or real samples, 0 to 40 dB of signal
over noise in each sample, errors of the channels, leakage weaker than the echoes that are shown.
Scenes: one strong echo, several, movers, pairs of reflectors that mirror each other in direction or
in direction and range, clutter of 300 reflectors, a box before a wall. One in three goes through a
raw file and its settings first.

Faulty ones are such recordings at 10 to 40 dB, with clutter 10 dB below the strongest echo or less,
and one fault of a random severity. The least that counts: Q holds less than 1 % of I's power;
copies by interleaving 30 dB above the noise of all samples together, and 20 dB above other echoes
there; phases that break by 45° within the middle half of a ramp, in all chirps or in a quarter; 1
to 3 samples that drop out there and turn the strongest echo by as much, or packets of 8 to 32;
leakage 3 dB above what else is shown; 1 % of the values 2 % beyond the converter's range; one or
two settings that are those of another recording: lanes, real samples, numbers of receivers,
transmitters, samples or loops. Settings with the right blocks and a larger size are those of a
recording that was stopped; none of them is drawn.
"""

import argparse
import math
import tempfile
import warnings
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from report import MetricTable, Required, write
from torch import Tensor

import invertwin as iw
from invertwin.capture import (
    Capture,
    ChirpCapture,
    ChirpData,
    ChirpSettings,
    adc_counts,
    find_faults,
)
from invertwin.capture.ti import change_settings, read_recording, write_samples
from invertwin.capture.ti.layouts import block_layout, frame_words, layout_error
from invertwin.channel import Paths, trace_field
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError, PhysicsWarning
from invertwin.radar import BOARDS, Impairments, Leakage, Radar
from invertwin.radar.boards import TxRxArrays
from invertwin.radar.radar import require_sampled_waveform
from invertwin.scene import RoughDielectric, box, plate, rigid

REQUIRED: Required = {"detected": (">=", 0.95), "false_alarms": ("<=", 0.02)}
RECORDINGS = 200
DEVICES = ("xWR1443", "xWR1642", "xWR1843", "IWR6843ISK", "IWR6843AOP", "AWR2944")
SCENES = ("one", "several", "movers", "pair", "mirrored", "clutter", "objects")
FAULTS = {
    "complex only by type": "Q is nothing, or a copy of I",
    "ghosts": "odd samples unlike even ones",
    "dropped samples": "samples or packets are missing",
    "phase break": "the phase jumps within ramps",
    "leakage": "the transmitters themselves are the strongest echo",
    "saturation": "the converter clips",
    "settings": "one or two settings are those of another recording",
}
PAINT = RoughDielectric(permittivity=4.0)
Chance = np.random.Generator
_LEAST_TURN = 45.0  # degrees


@dataclass
class Drawn:
    """A recording before its converter.

    Attributes:
        scene: One of `SCENES`.
        settings: Of the board.
        elements: TX in the order of sending, and RX.
        beat: Samples [frame, chirp, tx, rx, sample], noise included.
        snr: Mean signal over noise power in a sample.
        headroom: Full scale of the converter over the largest value.
    """

    scene: str
    settings: ChirpSettings
    elements: TxRxArrays
    beat: Tensor
    snr: float
    headroom: float


def drawn_settings(chance: Chance) -> tuple[ChirpSettings, TxRxArrays]:
    """Settings of a random board, and its elements."""
    board = BOARDS[str(chance.choice(DEVICES))]
    order = chance.permutation(len(board.transmitters))[: chance.integers(2, 5)] + 1
    receivers = tuple(range(1, len(board.receivers) + 1))
    samples = int(chance.choice([32, 64, 128, 256]))
    bandwidth, rate = float(chance.uniform(0.4e9, 4e9)), float(chance.uniform(4e6, 10e6))
    idle, begin = (float(chance.uniform(3e-6, 8e-6)) for _ in range(2))
    settings = ChirpSettings(
        start_frequency=board.design_frequency,
        slope=bandwidth / (samples / rate),
        sample_rate=rate,
        samples=samples,
        transmit_order=tuple(int(number) for number in order),
        receivers=receivers,
        loops=int(chance.choice([1, 1, 4, 16, 32])),
        frames=int(chance.choice([1, 2])),
        frame_period=0.05,
        idle_time=idle,
        adc_start_time=begin,
        ramp_end_time=begin + samples / rate + float(chance.uniform(1e-6, 8e-6)),
        real=bool(chance.random() < 0.15),
        bits=int(chance.choice([12, 14, 16])),
        lanes=4 if board.name == "xWR1443" else 2,
    )
    return settings, board.arrays(elevation=1, transmitters=settings.transmit_order)


def reflectors(
    scene: str, radar: Radar, farthest: float, most_clutter_db: float, chance: Chance
) -> tuple[Tensor, Tensor, Tensor]:
    """Ranges and directions [point, (R, u, v)], amplitudes and range rates of a scene's points."""
    cell, unambiguous = radar.waveform.range_resolution, require_sampled_waveform(radar).max_range
    nearest = max(5 * cell, 0.5)
    count = {"one": 1, "pair": 2, "mirrored": 2, "clutter": 300}.get(scene) or chance.integers(2, 7)
    last = min(0.9 * farthest, farthest - 5 * cell)
    ranges = chance.uniform(nearest, max(last, 1.1 * nearest), count)
    angle, size = chance.uniform(0, 2 * math.pi, count), 0.7 * np.sqrt(chance.random(count))
    u, v = size * np.cos(angle), size * np.sin(angle) * (chance.random() < 0.5)
    levels = chance.uniform(-25, 0, count) * (scene not in ("pair", "mirrored"))
    if scene == "clutter":
        # All but the first together.
        together = 10 * math.log10(float((10 ** (levels[1:] / 10)).sum()))
        levels += float(chance.uniform(-20, most_clutter_db)) - together
    levels[0] = 0.0
    if scene in ("pair", "mirrored"):
        u[1], v[1], ranges[1] = -u[0], -v[0], ranges[0]
    if scene == "mirrored":
        last = max(unambiguous - nearest, 1.1 * nearest)
        ranges[0] = chance.uniform(nearest, last)
        ranges[1] = unambiguous - ranges[0]
    rates = chance.uniform(-4, 4, count) * (scene == "movers")
    phases = chance.uniform(0, 2 * math.pi, count)
    amplitudes = 10 ** (levels / 20) * np.exp(1j * phases)
    return (
        torch.from_numpy(np.stack([ranges, u, v], 1)),
        torch.from_numpy(1e-3 * amplitudes),
        torch.from_numpy(rates),
    )


def paths_of(radar: Radar, points: Tensor, amplitudes: Tensor, rates: Tensor) -> Paths:
    """Field paths of points, in every frame."""
    u, v = points[:, 1], points[:, 2]
    rays = torch.stack([(1 - u**2 - v**2).sqrt(), u, v], 1)
    places, velocity = points[:, :1] * rays, rates[:, None] * rays
    frames, count = radar.frame_count, len(points)
    link = radar.link()
    frame = torch.arange(frames).repeat_interleave(count)
    first = places.repeat(frames, 1)
    way = (first - link.tx[frame]).norm(dim=1) + (first - link.rx[frame]).norm(dim=1)
    return Paths(
        frame,
        way / SPEED_OF_LIGHT,
        amplitudes.repeat(frames),
        torch.zeros(len(frame), dtype=torch.float64),
        first,
        first,
        "field",
        torch.zeros(len(frame), dtype=torch.bool),
        velocity.repeat(frames, 1) if bool(rates.any()) else None,
    )


def objects(radar: Radar, farthest: float, chance: Chance) -> Paths:
    """A box before a wall, of rough points whose echoes are as strong as those of `reflectors`."""
    cell = radar.waveform.range_resolution
    nearest = max(5 * cell, 0.5)
    near = float(chance.uniform(nearest, max(0.4 * farthest, 1.1 * nearest)))
    size = min(0.3 * farthest, 0.5)
    thing = iw.Object(box([size] * 3), PAINT, rigid(translation=[near + size, 0.2 * near, 0.0]))
    wall = iw.Object(plate(2.0, 1.5), PAINT, rigid(translation=[0.8 * farthest, 0.0, 0.0]))
    scene = iw.Scene({"box": thing, "wall": wall})
    sampling = iw.Sampling(depth=1, points_per_m2=400)
    paths = trace_field(scene, radar.link(), sampling=sampling, seed=int(chance.integers(2**31)))
    strength = float(paths.coefficient.abs().square().sum().sqrt()) / radar.frame_count**0.5
    return paths.scale_fields(1e-3 / strength)


def drawn(scene: str, chance: Chance, *, sound: bool, leak: bool = False) -> Drawn:
    """A recording of a scene.

    Args:
        scene: One of `SCENES`.
        chance: Draws everything.
        sound: Whether it stays as it is: then with less signal, or more clutter.
        leak: Whether leakage is stronger than what else is shown.
    """
    settings, elements = drawn_settings(chance)
    if scene == "mirrored":
        settings = replace(settings, real=False)
    place = torch.zeros(settings.frames or 1, 3, dtype=torch.float64)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PhysicsWarning)
        radar = Radar(*elements, settings.waveform, place)
        farthest = settings.waveform.max_range / (2 if settings.real else 1)
        clutter = 10.0 if sound else -10.0
        if scene == "objects":
            paths = objects(radar, farthest, chance)
        else:
            paths = paths_of(radar, *reflectors(scene, radar, farthest, clutter, chance))
        snr_db = float(chance.uniform(0 if sound else 10, 40))
        front = Impairments(
            leakage=leakage(settings, leak, chance),
            gain_std_db=float(chance.uniform(0, 1.5)),
            phase_std=float(chance.uniform(0, 0.4)),
        )
        seed = int(chance.integers(2**31))
        beat = front.record(paths, radar, seed=seed, chirps=settings.chirps)
        # Noise is that beside the echoes, whatever the leakage is.
        level = float(paths.coefficient.abs().square().sum()) / radar.frame_count
        noise = torch.from_numpy(chance.normal(size=(*beat.shape, 2)))
        beat += math.sqrt(level / 2 * 10 ** (-snr_db / 10)) * torch.view_as_complex(noise)
    headroom = float(10 ** chance.uniform(0.01, 1.0))
    return Drawn(scene, settings, elements, beat, 10 ** (snr_db / 10), headroom)


def leakage(settings: ChirpSettings, strong: bool, chance: Chance) -> Leakage | None:
    """Leakage at 0.1 to 2 ns. The strongest echo has −60 dB.

    Weak leakage is 20 dB and more below the echoes, or up to 20 dB above where it falls into the
    cells that are not shown. Strong leakage is 3 to 40 dB above where it is shown, else 55 to
    70 dB: its sidelobes are shown.
    """
    delay = float(chance.uniform(0.1e-9, 2e-9))
    # The main lobe of the window is 2 cells wide to either side.
    shown = 0.5 * SPEED_OF_LIGHT * delay / settings.waveform.range_resolution > 3
    hidden = 0.5 * SPEED_OF_LIGHT * delay / settings.waveform.range_resolution < 1
    if strong:
        while not (shown or hidden):
            delay = float(chance.uniform(0.1e-9, 2e-9))
            cells = 0.5 * SPEED_OF_LIGHT * delay / settings.waveform.range_resolution
            shown, hidden = cells > 3, cells < 1
        return Leakage(
            delay, -60 + float(chance.uniform(3, 40) if shown else chance.uniform(55, 59.9))
        )
    if chance.random() < 0.3:
        return None
    return Leakage(delay, -60 + float(chance.uniform(-40, 20 if hidden else -20)))


def by_type(case: Drawn, chance: Chance) -> bool:
    """I alone, as complex numbers; or Q a copy of I, or with up to 1 % of its power."""
    case.settings = replace(case.settings, real=False)
    part = case.beat.real
    copy = float(chance.choice([0.0, 0.0, 1.0]))
    rest = case.beat.imag * (part.square().mean() / case.beat.imag.square().mean()).sqrt()
    rest *= math.sqrt(float(chance.choice([0.0, chance.uniform(0, 0.01)]))) * (1 - copy)
    case.beat = torch.complex(part, copy * part + rest)
    return True


def interleaved(case: Drawn, chance: Chance) -> bool:
    """Odd samples with another gain or another time, or lost and replaced by the one before.

    It counts where the strongest echo's copy is 30 dB above the noise of all samples together, and
    20 dB above what else is at its place, where a single echo can be told at all.
    """
    beat, count = case.beat, case.settings.samples
    spectrum = torch.fft.fft(beat)
    window = torch.from_numpy(np.blackman(count))
    power = torch.fft.fft(beat * window).abs().square().flatten(0, 3).mean(0)
    strongest = int(power[: count // 2].argmax() if case.settings.real else power.argmax())
    copy = (count // 2 - strongest if case.settings.real else strongest + count // 2) % count
    there = float(torch.stack([power.roll(-copy)[k] for k in (-3, -2, -1, 0, 1, 2, 3)]).max())
    lost = (copy - strongest + count // 2) % count - count // 2
    weakest = max(
        10 ** (30 / 20) / math.sqrt(case.snr * beat[:1].numel()),
        10 * math.sqrt(there / float(power[strongest])),
    )
    if weakest > 1 or abs(lost) < 8 or (case.settings.real and count < 64):
        return False
    share = float(10 ** chance.uniform(math.log10(weakest), 0))
    odd = torch.arange(count) % 2 == 1
    kind = chance.choice(["gain", "time", "doubled", "zeros"])
    if kind == "gain":
        beat = beat * torch.where(odd, 1 - share, 1 + share)
    elif kind == "time":
        # The copy's share is the tangent of half the turn.
        cycles = torch.fft.fftfreq(count, dtype=torch.float64)
        lag = math.atan(share) / math.pi / float(cycles[strongest].abs())
        late = torch.fft.ifft(spectrum * torch.exp(2j * math.pi * cycles * lag))
        beat = torch.where(odd, late, beat)
    elif kind == "doubled":
        beat = beat[..., torch.arange(count) // 2 * 2]
    else:
        beat = beat * ~odd
    case.beat = beat
    return True


def dropped(case: Drawn, chance: Chance) -> bool:
    """Packets of 8 to 32 zeros in a tenth of the chirps, or 1 to 3 samples that slip.

    A slip counts where it turns the strongest echo by 45° or more.
    """
    beat, count = case.beat.clone(), case.settings.samples
    rows = beat.flatten(0, 1)
    if chance.random() < 0.5:
        for row in chance.permutation(len(rows))[: max(1, len(rows) // 10)]:
            length = int(chance.integers(8, min(32, count // 2) + 1))
            begin = int(chance.integers(0, count - length + 1))
            rows[row, ..., begin : begin + length] = 0
    else:
        slip, at = int(chance.integers(1, 4)), int(chance.integers(count // 4, 3 * count // 4))
        power = torch.fft.fft(rows).abs().square().flatten(0, -2).mean(0)
        strongest = int(power[: count // 2].argmax() if case.settings.real else power.argmax())
        turned = (strongest * slip / count + 0.5) % 1 - 0.5
        if abs(turned) < _LEAST_TURN / 360:
            return False
        rows[..., at : count - slip] = rows[..., at + slip :].clone()
        # The next chirp's samples come after the last ones.
        rows[..., count - slip :] = rows.roll(-1, 0)[..., :slip].clone()
    case.beat = rows.reshape(beat.shape)
    return True


def broken(case: Drawn, chance: Chance) -> bool:
    """The phase jumps by 45 to 180°."""
    beat, count = case.beat.clone(), case.settings.samples
    rows = beat.flatten(0, 1)
    share = float(chance.choice([1.0, 1.0, 0.25]))
    chosen = chance.permutation(len(rows))[: math.ceil(share * len(rows))]
    turn = math.radians(float(chance.uniform(_LEAST_TURN, 180))) * chance.choice([-1, 1])
    at = int(chance.integers(count // 4, 3 * count // 4))
    rows[chosen, ..., at:] *= np.exp(1j * turn)
    case.beat = rows.reshape(beat.shape)
    return True


def clipped(case: Drawn, chance: Chance) -> bool:
    """1 to 40 % of the values are 2 % and more beyond the full scale."""
    levels = parts_of(case).abs().flatten().sort().values
    clipped = int((1 - chance.uniform(0.01, 0.4)) * len(levels))
    case.headroom = float(levels[clipped] / levels[-1]) / 1.02
    return True


def parts_of(case: Drawn) -> Tensor:
    """What the converter sees."""
    return case.beat.real if case.settings.real else torch.view_as_real(case.beat)


def digitised(case: Drawn) -> ChirpData:
    """Counts of the converter."""
    full_scale = case.headroom * float(parts_of(case).abs().max())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PhysicsWarning)
        return adc_counts(case.beat, case.settings, full_scale)


def seen(case: Drawn, chance: Chance) -> Capture | ChirpCapture:
    """What the samples are to a user: counts or scaled, all chirps or the only one."""
    data = digitised(case)
    scaled = ChirpData(data.samples * float(10 ** chance.uniform(-6, 0)), data.settings)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PhysicsWarning)
        recording = scaled.to_chirp_capture(case.elements)
        alone = case.settings.loops == 1 and not case.settings.real
        return recording.to_capture() if alone else recording


def stated(case: Drawn, chance: Chance) -> tuple[ChirpSettings, dict[str, Any]] | None:
    """Settings of another recording that a device could have, and the changes to the right ones.

    None where they describe the same blocks and the same size, or one that was stopped: then no
    sample tells.
    """
    right = case.settings
    numbers = {
        "lanes": right.lanes,
        "real": right.real,
        "receivers": len(right.receivers),
        "transmitters": len(right.transmit_order),
        "samples": right.samples,
        "loops": right.loops,
        "frames": right.frames,
    }
    choices: dict[str, list[Any]] = {
        "lanes": [2, 4],
        "real": [False, True],
        "receivers": [1, 2, 3, 4],
        "transmitters": [1, 2, 3],
        "samples": [n * right.samples // 4 for n in (1, 2, 3, 5, 6, 8, 16)] + [100, 200, 240],
        "loops": [n * max(right.loops, 4) // 4 for n in (1, 2, 3, 6, 8, 16)],
    }
    names = chance.permutation(list(choices))[: chance.integers(1, 3)]
    wrong = {str(name): choices[name][int(chance.integers(len(choices[name])))] for name in names}
    wrong = {name: value for name, value in wrong.items() if value != numbers[name]}
    try:
        other = change_settings(replace(right, ramp_end_time=2 * right.ramp_time), wrong)
        other = replace(other, ramp_end_time=right.ramp_time)
    except InputError:
        return None
    same = block_layout(other) == block_layout(right)
    sizes = [frame_words(one) * (one.frames or 1) for one in (other, right)]
    if not wrong or layout_error(other) is not None or (same and sizes[0] >= sizes[1]):
        return None
    return other, {name: numbers[name] for name in numbers if name in wrong}


def refusal(case: Drawn, settings: ChirpSettings) -> str | None:
    """What reading the recording's raw file with such settings says; None = it is read."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", PhysicsWarning)
        path = Path(folder) / "adc.bin"
        write_samples(path, digitised(case))
        try:
            read_recording(path, settings)
        except InputError as error:
            return str(error)
    return None


APPLIED = {
    "complex only by type": by_type,
    "ghosts": interleaved,
    "dropped samples": dropped,
    "phase break": broken,
    "saturation": clipped,
}
# Samples that slip break the phase.
ALSO = {"dropped samples": {"dropped samples", "phase break"}}


def judged_sound(number: int, seed: int) -> dict[str, Any]:
    """What is said of a sound recording."""
    chance = np.random.default_rng((seed, 0, number))
    scene = SCENES[number % len(SCENES)]
    case = drawn(scene, chance, sound=True)
    refused = refusal(case, case.settings) if number % 3 == 0 else None
    said = [fault.name for fault in find_faults(seen(case, chance))]
    return {"scene": scene, "said": said + (["settings"] if refused else [])}


def judged_faulty(number: int, seed: int) -> dict[str, Any]:
    """What is said of a recording with a fault."""
    chance = np.random.default_rng((seed, 1, number))
    fault = list(FAULTS)[number % len(FAULTS)]
    while True:
        scene = str(chance.choice(SCENES))
        case = drawn(scene, chance, sound=False, leak=fault == "leakage")
        if fault == "settings":
            other = stated(case, chance)
            if other is None:
                continue
            said = refusal(case, other[0])
            right = ", ".join(f"{name}={value}" for name, value in other[1].items())
            named = said is not None and any(f" {right}{end}" in said for end in (" (", " or "))
            first = said is not None and f"what fits: {right} " in said
            return {"fault": fault, "found": said is not None, "named": named, "first": first}
        if fault == "leakage" or APPLIED[fault](case, chance):
            names = [found.name for found in find_faults(seen(case, chance))]
            right = ALSO.get(fault, {fault})
            found, first = bool(right & set(names)), bool(right & set(names[:1]))
            return {"fault": fault, "found": found, "named": found, "first": first}


def measure(recordings: int, seed: int) -> dict[str, Any]:
    """All metrics.

    Args:
        recordings: Of either kind.
        seed: Of all random numbers.
    """
    begin = perf_counter()
    sound = [judged_sound(number, seed) for number in range(recordings)]
    faulty = [judged_faulty(number, seed) for number in range(recordings)]

    def share(key: str, of: str | None = None) -> float:
        rows = [row[key] for row in faulty if of in (None, row["fault"])]
        return sum(rows) / len(rows)

    return {
        "detected": share("found"),
        "false_alarms": sum(bool(row["said"]) for row in sound) / len(sound),
        "named": share("named"),
        "first": share("first"),
        "detected_by": {fault: share("found", fault) for fault in FAULTS},
        "named_settings": share("named", "settings"),
        "first_settings": share("first", "settings"),
        "false_alarms_by": dict(Counter(name for row in sound for name in row["said"])),
        "recordings": recordings,
        "seed": seed,
        "seconds": perf_counter() - begin,
    }


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/look"))
    parser.add_argument("--recordings", type=int, default=RECORDINGS)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    metrics = measure(given.recordings, given.seed)
    table = MetricTable("Faulty recordings", REQUIRED)
    table.row("detected", metrics["detected"], ".3f", f"of {given.recordings} faulty recordings")
    by = ", ".join(metrics["false_alarms_by"]) or "nothing"
    alarms = f"of {given.recordings} sound ones; said of them: {by}"
    table.row("false_alarms", metrics["false_alarms"], ".3f", alarms)
    table.row("named", metrics["named"], ".3f", "the fault or the right settings are named")
    table.row("first", metrics["first"], ".3f", "they are named first")
    for fault, value in metrics["detected_by"].items():
        table.row(f"detected_by.{fault}", value, ".3f", FAULTS[fault])
    table.row("named_settings", metrics["named_settings"], ".3f", "the right ones are named")
    table.row("first_settings", metrics["first_settings"], ".3f", "they are named first")
    write(metrics, table.grid, given.out)


if __name__ == "__main__":
    main()
