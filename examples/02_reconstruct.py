"""Find where a letter stands and how it is turned, from radar signals alone.

The unknown is a torch module of your own: here the letter slides and turns on the floor.
Usage: .venv/bin/python examples/02_reconstruct.py [folder]     (default out/examples)
"""

import math
import sys
from pathlib import Path

import torch

import invertwin as iw
from invertwin.scene import compose, rotation_from_vector

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
folder.mkdir(parents=True, exist_ok=True)


class OnTheFloor(torch.nn.Module):
    """θ = (x, y, yaw) of the letter: any module Scene → Scene can be fitted."""

    def __init__(self, x: float, y: float, yaw: float) -> None:
        super().__init__()
        self.theta = torch.nn.Parameter(torch.tensor([x, y, yaw], dtype=torch.float64))

    def forward(self, scene: iw.Scene) -> iw.Scene:
        x, y, yaw = self.theta
        zero = torch.zeros_like(x)
        turn = rotation_from_vector(torch.stack([zero, zero, yaw]))
        pose = compose(iw.rigid(turn, torch.stack([x, y, zero])), scene["letter"].transform)
        return scene.replace("letter", pose=pose)


paint = iw.RoughDielectric(permittivity=4.0)
letter = iw.Object(iw.text("A"), paint, iw.rigid(translation=[2.5, 0.0, 0.0]))
wall = iw.Object(iw.plate(3.0, 2.4), paint, iw.rigid(translation=[3.3, 0.0, 0.0]))
start = iw.Scene({"letter": letter, "wall": wall})
hidden = OnTheFloor(x=-0.15, y=0.25, yaw=0.3)

chirp = iw.FMCW(start_frequency=77e9, bandwidth=3.6e9, duration=50e-6, samples=128)
row, half = iw.linear_array, chirp.wavelength / 2
looks = [[0.0, y, z] for y in (-0.6, -0.2, 0.2, 0.6) for z in (-0.4, 0.4)]
radar = iw.Radar(row(2, 16 * half), row(16, half), chirp, looks)  # 2 × 16 at eight places
grid = radar.grid(range_min=2.0, range_max=3.8, u_max=0.6)
with torch.no_grad():
    sparse = iw.Sampling(depth=1, points_per_m2=3e3)
    recorded = iw.simulate(hidden(start), radar, grid, seed=1, sampling=sparse, snr_db=20.0)

unknown = OnTheFloor(0.0, 0.0, 0.0)
kernels = iw.Surrogate(range_width=3.0, angle_width=1.5)  # extra widths, annealed to zero
model = iw.SurrogateMap(grid, kernels, iw.Sampling(depth=1, samples=100_000))
seen = iw.Observation(model, recorded.capture)
fit = iw.reconstruct(start, seen, [unknown], schedule=iw.Schedule(steps=60), seed=1)

for name, theta in ("start", torch.zeros(3)), ("found", unknown.theta.detach()):
    x, y, yaw = (theta - hidden.theta.detach()).tolist()
    print(f"{name}: {100 * math.hypot(x, y):.1f} cm and {math.degrees(abs(yaw)):.1f}° off")
iw.scene.save_mesh(folder / "twin.ply", fit.scene)
print(f"the scene as found: {folder / 'twin.ply'}")
