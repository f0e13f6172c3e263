"""A run file small enough for seconds, and how tests call the command line."""

import json
import sys
from pathlib import Path

import pytest

from invertwin.cli import app

#: Head of run files of links in a room.
ROOM = """
task = "reconstruct"
frame = 2
seed = 4

[scene.room]
shape = "box"
size = [5.0, 4.0, 3.0]
material = { kind = "dielectric", permittivity = 4.0, conductivity = 0.05, scattering = 0.0 }
"""
RUN = """
task = "reconstruct"
frame = 2
seed = 3

[scene.plate]
shape = "plate"
width = 0.4
height = 0.3
divisions = 3
position = [1.2, 0.0, 0.0]
material = { kind = "rough_dielectric", permittivity = 4.0 }

[scene.wall]
shape = "plate"
width = 2.0
height = 2.0
position = [1.6, 0.0, 0.0]
material = { kind = "rough_dielectric", permittivity = 4.0 }

[truth.plate]
position = [1.2, 0.02, 0.01]

[radar]
waveform = { kind = "fmcw", start_frequency = 76e9, bandwidth = 2e9, duration = 5e-5, samples = 64 }
receivers = { kind = "planar", count = [6, 4], spacing = [1.9e-3, 1.9e-3] }
positions = [[0.0, 0.0, 0.0], [0.0, 0.1, 0.0]]

[radar.transmitters]
kind = "positions"
positions = [[0.0, 0.0, 0.0]]
pattern = { kind = "cosine", exponent = 1.0 }

[grid]
range_min = 0.8
range_max = 1.8
u_max = 0.6
v_max = 0.6

[data]
kind = "simulated"
depth = 1
points_per_m2 = 2e3
snr_db = 20.0

[[parameters]]
kind = "translation"
object = "plate"

[surrogate]
range_width = 2.0
angle_width = 1.0

[reconstruct]
depth = 1
steps = 8
samples = 20_000
boundary_samples = 4_000
checkpoint_every = 1
"""
STARTS = """
[starts]
object = "plate"
count = 2
distance = [0.05, 0.08]
"""
GRADCHECK = """
[gradcheck]
parameter = { kind = "translation", object = "plate" }
tangent = { translation = [0.0, 1.0, 0.0] }
depth = 2
step = 1e-2
samples = 50_000
boundary_samples = 20_000
repeats = 1
difference_samples = 50_000
max_pairs = 4
"""

BEHIND = RUN.replace("[1.2", "[-1.2").replace("[1.6", "[-1.6").replace("snr_db = 20.0", "")
MATERIAL = 'material = { kind = "perfect_conductor" }\n'


def call(monkeypatch, *arguments) -> int:
    monkeypatch.setattr(sys, "argv", ["invertwin", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        app.main()
    return ended.value.code if isinstance(ended.value.code, int) else 0


def read_metrics(folder: Path) -> dict:
    return json.loads((folder / "metrics.json").read_text())
