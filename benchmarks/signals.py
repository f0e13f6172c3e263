"""Exact signals: moving points against an oracle for every sample, fast sums against direct ones.

    python benchmarks/signals.py [-o DIR]

Prints a table and writes `metrics.json` into DIR (default `out/signals`).

- `iq_error.<case>`: a 77 GHz TDM radar (3 × 4 elements) sees points through a frame of chirps. The
  oracle takes every ADC sample of every chirp by itself, in float64: it finds where each point was
  when it scattered what is received then, by its trajectory in closed form, and from that place the
  exact delay between the elements. The error is ‖signal − oracle‖/‖oracle‖ over all samples.
- `nufft`: paths to samples of all virtual channels by the library, and by summing every path's
  phase at every sample in float64. The error is the largest one over the signal's peak. The
  direct sum is done for two channels, the time of all taken as that many times theirs.
"""

import argparse
import math
import os
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from report import MetricTable, Required, write
from rich.table import Table
from torch import Tensor

from invertwin.channel import Paths
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.radar import FMCW, Chirps, Radar, beat_signal, moving_beat
from invertwin.scene.antenna import linear_array

PATHS, CHIRPS, POINTS = 1_000_000, 64, 24
REPEATS = 5
DIRECT = ((0, 0), (2, 3))  # (tx, rx) that are summed directly; all take the same time
WAVEFORM = FMCW(start_frequency=76.5e9, bandwidth=1e9, duration=51.2e-6, samples=256)
INTERVAL = 60e-6  # s, from ramp to ramp
GRAVITY = 9.81  # m/s²
REQUIRED: Required = {
    "iq_error.static": ("<=", 1e-3),
    "iq_error.accelerating": ("<=", 1e-3),
    "iq_error.rotating": ("<=", 1e-3),
    "nufft.error": ("<=", 1e-5),
    "nufft.seconds": ("<=", 3.0),
}
CASES = {
    "static": "at rest, 4–34 m away",
    "accelerating": "10–30 m/s and 3–5 g in all directions",
    "rotating": "rotor blades of 0.15 m at 6000 turns a minute (94 m/s at the tip), on a body at "
    "15 m/s",
}

Trajectory = Callable[[Tensor], Tensor]
"""Positions [*time, point, 3] at each point's own times [*time, point]."""


@dataclass(frozen=True)
class Case:
    """Points of given strengths on their ways in front of a radar."""

    radar: Radar
    chirps: Chirps
    place: Trajectory
    coefficient: Tensor

    def signal(self) -> Tensor:
        """What the library computes."""
        paths = point_paths(self.radar, self._at(0.0), self.coefficient)
        return moving_beat(paths, self.radar, self.chirps, trajectory=self._at)

    def oracle(self) -> Tensor:
        """Every sample by itself, [1, chirp, tx, rx, sample]."""
        tx, rx = (elements[0] for elements in self.radar.elements())
        starts = self.chirps.times(len(tx))
        beat = torch.empty((1, *starts.shape, len(rx), WAVEFORM.samples), dtype=torch.complex128)
        for chirp, sender in torch.cartesian_prod(*map(torch.arange, starts.shape)).tolist():
            received = starts[chirp, sender] + WAVEFORM.sample_times
            for receiver in range(len(rx)):
                delay = self._delay(received, tx[sender], rx[receiver])
                swept = WAVEFORM.slope * (WAVEFORM.sample_times[:, None] - 0.5 * delay)
                cycles = delay * (WAVEFORM.start_frequency + swept)
                phase = 2 * math.pi * (cycles - cycles.round())
                phasor = torch.polar(torch.ones_like(phase), phase)
                beat[0, chirp, sender, receiver] = phasor @ self.coefficient.conj()
        return beat

    def error(self) -> float:
        """Relative error of all samples."""
        expected = self.oracle()
        return float((self.signal() - expected).norm() / expected.norm())

    def _at(self, time: float) -> Tensor:
        return self.place(torch.full((len(self.coefficient),), time, dtype=torch.float64))

    def _delay(self, received: Tensor, tx: Tensor, rx: Tensor) -> Tensor:
        """[sample, point]; the way back is found by substitution, each time 1e7 times better."""
        points = self.place(received[:, None].expand(-1, len(self.coefficient)))
        for _ in range(2):
            back = (points - rx).norm(dim=-1)
            points = self.place(received[:, None] - back / SPEED_OF_LIGHT)
        return ((points - tx).norm(dim=-1) + (points - rx).norm(dim=-1)) / SPEED_OF_LIGHT


def case(name: str, chirps: int = CHIRPS, points: int = POINTS) -> Case:
    """One of ``CASES``; the same every time."""
    draw = torch.Generator().manual_seed(7)
    spread = torch.rand(points, 3, generator=draw, dtype=torch.float64)
    # Random numbers are drawn for y, z and x, in this order.
    start = torch.tensor([4.0, -4.0, -1.0]) + torch.tensor([30.0, 8.0, 2.0]) * spread.roll(1, 1)
    coefficient = torch.randn(points, generator=draw, dtype=torch.complex128)
    heading = torch.nn.functional.normalize(
        torch.randn(2, points, 3, generator=draw, dtype=torch.float64).roll(1, -1), dim=-1
    )
    amount = torch.rand(2, points, 1, generator=draw, dtype=torch.float64)
    speed = (10 + 20 * amount[0]) * heading[0]
    acceleration = (3 + 2 * amount[1]) * GRAVITY * heading[1]
    # Blades turn about the vertical axis of bodies that fly.
    radius, phase = 0.15 * spread[:, 0].sqrt(), 2 * math.pi * spread[:, 1]
    hub = torch.tensor([6.0, 1.0, 0.5]) + 10 * spread[:, 2:] * torch.tensor([1.0, 0.2, 0.0])
    body = torch.tensor([-12.0, 9.0, 0.0], dtype=torch.float64)

    def static(times: Tensor) -> Tensor:
        return start.expand(*times.shape, 3)

    def accelerating(times: Tensor) -> Tensor:
        t = times[..., None]
        return start + speed * t + 0.5 * acceleration * t**2

    def rotating(times: Tensor) -> Tensor:
        angle = phase + 2 * math.pi * 100 * times
        blade = torch.stack([angle.sin(), angle.cos(), torch.zeros_like(angle)], dim=-1)
        return hub + body * times[..., None] + radius[:, None] * blade

    ways: dict[str, Trajectory] = {
        "static": static,
        "accelerating": accelerating,
        "rotating": rotating,
    }
    return Case(board(), Chirps(chirps, INTERVAL), ways[name], coefficient)


def board() -> Radar:
    """Three transmitters and four receivers in a row: twelve virtual channels."""
    half = WAVEFORM.wavelength / 2
    origin = torch.zeros(1, 3, dtype=torch.float64)
    return Radar(linear_array(3, 4 * half), linear_array(4, half), WAVEFORM, origin)


def point_paths(radar: Radar, points: Tensor, coefficient: Tensor) -> Paths:
    """Field paths of points that everything sees."""
    link, frame = radar.link(), torch.zeros(len(points), dtype=torch.int64)
    length = (points - link.tx).norm(dim=1) + (points - link.rx).norm(dim=1)
    zero = torch.zeros(len(points), dtype=torch.float64)
    return Paths(
        frame, length / SPEED_OF_LIGHT, coefficient, zero, points, points, "rough", zero.bool()
    )


def transforms(paths: int, repeats: int) -> dict[str, float]:
    """Error and time of the library's sums; the direct ones are done once, for some channels."""
    radar, draw = board(), torch.Generator().manual_seed(3)
    spread = torch.rand(paths, 3, generator=draw, dtype=torch.float64)
    points = torch.tensor([3.0, -4.0, -1.0]) + torch.tensor([30.0, 8.0, 2.0]) * spread.roll(1, 1)
    listed = point_paths(radar, points, torch.randn(paths, generator=draw, dtype=torch.complex128))
    found = beat_signal(listed, radar)
    times = []
    for _ in range(repeats):
        begin = perf_counter()
        found = beat_signal(listed, radar)
        times.append(perf_counter() - begin)
    begin = perf_counter()
    expected = direct_sum(listed, radar, DIRECT)
    slow = (perf_counter() - begin) * len(radar.virtual_positions) / len(DIRECT)
    found = torch.stack([found[0, t, r] for t, r in DIRECT])
    seconds = statistics.median(times)
    return {
        "paths": paths,
        "channels": len(radar.virtual_positions),
        "samples": WAVEFORM.samples,
        "error": float((found - expected).abs().max() / expected.abs().max()),
        "seconds": seconds,
        "direct_seconds": slow,
        "time_ratio": slow / seconds,
    }


def direct_sum(
    paths: Paths, radar: Radar, channels: Sequence[tuple[int, int]], chunk: int = 1_000
) -> Tensor:
    """The phase of every path at every sample of some (tx, rx), [channel, sample]."""
    tx, rx = (elements[0] for elements in radar.elements())
    beat = torch.zeros(len(channels), WAVEFORM.samples, dtype=torch.complex128)
    for first in range(0, len(paths), chunk):
        points = paths.last[first : first + chunk]
        strength = paths.coefficient[first : first + chunk].conj()
        for row, (t, r) in enumerate(channels):
            length = (points - tx[t]).norm(dim=1) + (points - rx[r]).norm(dim=1)
            delay = (length / SPEED_OF_LIGHT)[:, None]
            cycles = delay * (WAVEFORM.frequencies - 0.5 * WAVEFORM.slope * delay)
            phase = (cycles - cycles.round()).mul_(2 * math.pi)
            beat[row] += strength @ torch.polar(torch.ones_like(phase), phase)
    return beat


def measure(
    paths: int = PATHS, chirps: int = CHIRPS, points: int = POINTS, repeats: int = REPEATS
) -> dict[str, Any]:
    """All metrics; the sizes are smaller in tests only."""
    with torch.no_grad():
        return {
            "chirps": chirps,
            "points": points,
            "cpu_count": os.cpu_count(),
            "threads": torch.get_num_threads(),
            "load_average": os.getloadavg()[0],
            "nufft": transforms(paths, repeats),
            "iq_error": {name: case(name, chirps, points).error() for name in CASES},
        }


def table(metrics: dict[str, Any]) -> Table:
    """What was compared, and what must hold."""
    page = MetricTable(
        f"Signals: {metrics['points']} points over {metrics['chirps']} chirps of "
        f"{WAVEFORM.samples} samples and 12 virtual channels; {metrics['cpu_count']} CPU cores, "
        f"{metrics['threads']} threads, load average {metrics['load_average']:.1f} at the start",
        REQUIRED,
    )

    def row(group: str, key: str, text: str) -> None:
        page.row(f"{group}.{key}", metrics[group][key], ".3g", text)

    for name, text in CASES.items():
        row("iq_error", name, text)
    sums = metrics["nufft"]
    size = f"{sums['paths']} paths, {sums['channels']} channels, {sums['samples']} samples"
    row(
        "nufft",
        "error",
        f"largest difference from the direct sum over the peak, {len(DIRECT)} channels; {size}",
    )
    row("nufft", "seconds", "median time of the sums, delays and phases to each element included")
    row(
        "nufft",
        "direct_seconds",
        f"the direct sum of {len(DIRECT)} channels, times channels over {len(DIRECT)}",
    )
    row("nufft", "time_ratio", "direct over fast")
    return page.grid


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/signals"))
    arguments = parser.parse_args()
    metrics = measure()
    write(metrics, table(metrics), arguments.out)


if __name__ == "__main__":
    main()
