"""The derivative of a radar map when an object moves: with and without visibility.

Usage: .venv/bin/python examples/03_gradient.py [folder]     (default out/examples)
"""

import sys
from pathlib import Path

import torch

import invertwin as iw
from invertwin.inversion import GradcheckSettings
from invertwin.scene import rotation_from_vector

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
folder.mkdir(parents=True, exist_ok=True)


def at(x: float, y: float, z: float, yaw: float = 0.0) -> torch.Tensor:
    return iw.rigid(rotation_from_vector(torch.tensor([0.0, 0.0, yaw])), torch.tensor([x, y, z]))


paint = iw.RoughDielectric(permittivity=4.0)
letter = iw.Object(iw.text("A"), paint, at(2.5, 0.1, 0.0, yaw=0.2))
scene = iw.Scene({"letter": letter, "wall": iw.Object(iw.plate(3, 2.4), paint, at(3.3, 0, 0))})
chirp = iw.FMCW(start_frequency=76e9, bandwidth=2e9, duration=50e-6, samples=128)
row = iw.linear_array(16, chirp.wavelength / 2)
radar = iw.Radar(iw.linear_array(1, 1.0), row, chirp, positions=[[0.0, 0.0, 0.0]])
grid = radar.grid(range_min=2.0, range_max=3.8, u_max=0.5)

sampling = iw.Sampling(depth=1, samples=1_000_000, boundary_samples=250_000)
model = iw.SurrogateMap(grid, sampling=sampling)
# θ moves the letter to the left. The differences are the truth: two maps, 8 mm apart.
report = iw.gradcheck(
    model, iw.Translation("letter"), {"translation": [0.0, 1.0, 0.0]}, scene=scene, sensor=radar,
    settings=GradcheckSettings(repeats=2, difference_samples=2_000_000, max_pairs=4),
)  # fmt: skip

peak = report.value.max()
derivatives = {
    "derivative by differences": report.difference,
    f"invertwin: {report.full.relative_l1:.1%} off": report.gradient,
    f"without boundary paths: {report.interior.relative_l1:.0%} off": report.interior_gradient,
}
shares = {title: values / peak for title, values in derivatives.items()}
label = "peaks per metre moved"
figure = iw.plotting.gradient(shares, grid, label=label, power=report.value)
figure.savefig(folder / "gradient.png", dpi=100, metadata={"Software": None})
print(f"with boundary paths:    L1 error {report.full.relative_l1:.4f}")
print(f"without boundary paths: L1 error {report.interior.relative_l1:.4f}")
print(f"noise of the differences:        {report.difference_noise:.4f}")
