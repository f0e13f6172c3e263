"""Simulate a radar: what one recording shows, and what it shows on average.

Usage: .venv/bin/python examples/01_simulate.py [folder]     (default out/examples)
"""

import sys
from pathlib import Path

import torch

import invertwin as iw
from invertwin.scene import rotation_from_vector

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
folder.mkdir(parents=True, exist_ok=True)


def at(x: float, y: float, z: float, yaw: float = 0.0) -> torch.Tensor:
    """A pose: position [m] and turn about the vertical [rad]."""
    return iw.rigid(rotation_from_vector(torch.tensor([0.0, 0.0, yaw])), torch.tensor([x, y, z]))


# The radar sits at the origin and looks along x; y is left, z is up.
paint = iw.RoughDielectric(permittivity=4.0)
scene = iw.Scene(
    {
        "letter": iw.Object(iw.text("A", size=0.6), paint, at(2.5, 0.3, 0.0, yaw=0.3)),
        "wall": iw.Object(iw.plate(3.0, 2.4), paint, at(3.3, 0.0, 0.0)),
    }
)
chirp = iw.FMCW(start_frequency=77e9, bandwidth=3.6e9, duration=50e-6, samples=128)
half = chirp.wavelength / 2
radar = iw.Radar(iw.linear_array(2, 16 * half), iw.linear_array(16, half), chirp, [[0.0, 0.0, 0.0]])
grid = radar.grid(range_min=2.0, range_max=3.8, u_max=0.6)

# Exact signals: fields of fixed scatterers, beat signals, window, FFT, beamforming. The
# speckle is that of one rough surface; another seed is another surface.
once = iw.Sampling(depth=1)  # paths of one bounce
recorded = iw.simulate(scene, radar, grid, seed=1, sampling=once, snr_db=20.0)
# The surrogate: the mean over all such surfaces, smooth in everything that may move.
expected = iw.SurrogateMap(grid, sampling=once).predict(scene, radar, seed=1)

maps = {"one recording (exact)": recorded.spectrum, "on average (surrogate)": expected}
figure = iw.plotting.spectrum(maps, grid, relative=False)  # one scale for both
figure.savefig(folder / "simulate.png", dpi=100)

print(f"beat signal {tuple(recorded.beat.shape)} (frame, tx, rx, sample)")
print(f"picture: {folder / 'simulate.png'}")
