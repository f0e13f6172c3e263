"""A frame of a person who walks in a furnished room: time, and the difference to tracing anew.

    python benchmarks/motion.py [-o DIR]

64 loops of 2 transmitters, 4 receivers and 256 samples at 77 GHz. Prints a table and writes
`metrics.json` into DIR (default `out/motion`):

- `frame_seconds`: `simulate_chirps` with rays traced once for the frame; median of three calls.
- `frame_seconds_ratio`: time with rays traced at every ramp, over that. It is measured in the same
  run, over SLOW loops of the 64 and carried on.
- `difference`: of the signals of these loops, relative to those of rays at every ramp.
- `map_difference_db`: the same of the range–Doppler map of the whole frame, its largest bin to the
  largest bin of the map; rays are traced at 16 loops' distance in place of 64.
"""

import argparse
import math
import statistics
from pathlib import Path
from time import perf_counter

import torch
from report import MetricTable, Required, write

import invertwin as iw
from invertwin.radar.signal.chirps import Chirps
from invertwin.scene import (
    MovingScene,
    RoughDielectric,
    Walking,
    linear_array,
    person,
    rigid,
    room,
    standing_height,
)

LOOPS, SLOW, INTERVAL = 64, 8, 50e-6
SPEED = 1.4  # m/s
SAMPLING = iw.Sampling(depth=1, points_per_m2=1_000.0)
REQUIRED: Required = {
    "frame_seconds": ("<=", 3.0),
    "frame_seconds_ratio": (">=", 10.0),
}
BODY = person()
SKIN = RoughDielectric(permittivity=4.0)
PLACE = [4.0, 0.2, standing_height(BODY)]
STANDING = iw.Object(BODY.mesh({}), SKIN, rigid(translation=PLACE))
walking = MovingScene(
    iw.Scene({**room(), "person": STANDING}), {"person": Walking(BODY, SPEED, phase=0.8)}
)


def sensor() -> iw.Radar:
    """Two transmitters and four receivers at the front wall."""
    chirp = iw.FMCW(start_frequency=77e9, bandwidth=1e9, duration=40e-6, samples=256)
    half = chirp.wavelength / 2
    place = torch.tensor([[0.1, 0.0, 1.0]], dtype=torch.float64)
    return iw.Radar(linear_array(2, 4 * half), linear_array(4, half), chirp, place)


def frame(loops: int, every: int) -> tuple[torch.Tensor, float]:
    """Signals of some loops, and the seconds that they took."""
    begin = perf_counter()
    found = iw.simulate_chirps(
        walking,
        sensor(),
        Chirps(loops, INTERVAL),
        seed=1,
        sampling=SAMPLING,
        visibility_every=every,
    )
    return found, perf_counter() - begin


def measured() -> dict[str, float]:
    """All metrics."""
    frame(LOOPS, LOOPS)  # compiled now
    runs = [frame(LOOPS, LOOPS) for _ in range(3)]
    fast, seconds = runs[0][0], statistics.median(time for _, time in runs)
    few, _ = frame(SLOW, SLOW)
    slow, slow_seconds = frame(SLOW, 1)
    often, _ = frame(LOOPS, 16)
    maps = [torch.fft.fft2(beat[0, :, 0, 0]).abs() for beat in (fast, often)]
    return {
        "frame_seconds": seconds,
        "frame_seconds_ratio": slow_seconds * LOOPS / SLOW / seconds,
        "difference": float((few - slow).norm() / slow.norm()),
        "map_difference_db": 20 * math.log10(float((maps[0] - maps[1]).max() / maps[1].max())),
    }


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("out/motion"))
    out = parser.parse_args().output
    metrics = measured()
    table = MetricTable("A walking person in a furnished room", REQUIRED)
    counted = {
        "frame_seconds": "s, a frame of 64 loops, rays traced once; median of three",
        "frame_seconds_ratio": "time with rays at every ramp, over that",
        "difference": "of signals of 8 loops, relative",
        "map_difference_db": "of range and Doppler, rays once against every 16 loops",
    }
    for key, text in counted.items():
        table.row(key, metrics[key], ".3g", text)
    write(metrics, table.grid, out)


if __name__ == "__main__":
    main()
