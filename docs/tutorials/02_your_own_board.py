# %% [markdown]
# # Your own board
#
# A recording of a board is an array of numbers. A short description states the board and its settings. Then invertwin
# reads it, draws it and lists its detections. Here the array is simulated, so that the truth is known.

# %%
# %matplotlib inline
import tempfile
from pathlib import Path

import numpy as np

import invertwin as iw
from invertwin.capture import ChirpCapture, read
from invertwin.radar import Chirps, board, detect_points, doppler_maps
from invertwin.scene import sphere

# %% [markdown]
# ## The scene before the board
# One ball rests, and one approaches at 2 m/s. The board is an xWR1642: two transmitters take turns, and with four
# receivers they are a row of eight virtual antennas.

# %%
foam = iw.RoughDielectric(permittivity=4.0)
still = iw.Object(sphere(0.15), foam, iw.rigid(translation=[2.5, 0.8, 0.0]))
comes = iw.Object(sphere(0.15), foam, iw.rigid(translation=[3.5, -0.4, 0.0]), [-2.0, 0.0, 0.0])
chirp = iw.FMCW(start_frequency=77e9, bandwidth=1.536e9, duration=25.6e-6, samples=128)
transmitters, receivers = board("xWR1642").arrays()
radar = iw.Radar(transmitters, receivers, chirp, positions=[[0.0, 0.0, 0.0]])
beat = iw.simulate_chirps(
    iw.Scene({"still": still, "comes": comes}),
    radar,
    Chirps(count=64, interval=50e-6),
    seed=1,
    sampling=iw.Sampling(depth=1, points_per_m2=4e3),
)
print(tuple(beat.shape), "frame, chirp, transmitter, receiver, sample")

# %% [markdown]
# ## The file and its description
# Your recording would be such an array already. Slope, sample rate and the other settings are those of the board.

# %%
DESCRIPTION = """
[data]
file = "adc.npy"
dimensions = ["frame", "chirp", "tx", "rx", "sample"]

[settings]
start_frequency = 77e9
slope = 60e12
sample_rate = 5e6
transmit_order = [1, 2]
idle_time = 20e-6
ramp_end_time = 30e-6

[radar]
board = "xWR1642"
"""
with tempfile.TemporaryDirectory() as folder:
    np.save(Path(folder, "adc.npy"), beat.numpy())
    Path(folder, "adc.toml").write_text(DESCRIPTION)
    recording = read(Path(folder, "adc.toml"))
assert isinstance(recording, ChirpCapture)

# %% [markdown]
# ## Range, range rate and direction
# Range against range rate, then range against direction of all echoes and of moving targets. An approaching target
# has a negative range rate.

# %%
seen = recording.radar()
grid = seen.grid(range_min=1.0, range_max=5.0)
maps = doppler_maps(recording.beat, seen, grid, recording.chirps)
iw.plotting.range_doppler(maps)

# %% [markdown]
# ## Detections
# A list of points: range, range rate, direction and position.

# %%
points = detect_points(recording.beat, seen, grid, recording.chirps, frame=0)
for number in points.power.argsort(descending=True)[:4].tolist():
    x, y, _ = points.position[number].tolist()
    print(f"{points.velocity[number]:+.1f} m/s at x = {x:.2f} m, y = {y:+.2f} m")

# %% [markdown]
# The nearest side of each ball is found. Both range rates are right to a tenth of a metre a second; that of the
# moving ball is 2 m/s times the cosine of its direction.

# %%
moving = points.velocity < -1.0
place = points.position[moving][points.power[moving].argmax()]
assert (points.velocity[moving] + 2.0).abs().max() < 0.15
assert (place - comes.center).norm() < 0.25
assert points.velocity[~moving].abs().max() < 0.15

# %% [markdown]
# The command line does the same, and warns of faults of the recording: `invertwin look adc.toml`. Raw files of a
# DCA1000 need no array: `invertwin look adc.bin --config bench.cfg --board xWR1642` ([measured
# data](../measured_data.md#a-board-of-your-own)).
