"""Your own mesh and your own board: simulate a capture, save it, load it, look at it.

The board is like a TI AWR1843BOOST: two of its transmitters 2λ apart and four receivers λ/2 apart
make a row of eight virtual antennas.
Usage: .venv/bin/python examples/04_own_mesh_and_board.py [folder [mesh.obj]]  (out/examples)
"""

import sys
from pathlib import Path

import torch

import invertwin as iw
from invertwin.scene import Cosine, save_mesh, sphere

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
folder.mkdir(parents=True, exist_ok=True)
if len(sys.argv) > 2:
    file = Path(sys.argv[2])
else:  # no mesh given: make one, as another program would
    file = folder / "ball.ply"
    save_mesh(file, sphere(0.1, subdivisions=5))

# OBJ, PLY, STL or glTF; metres. The file's origin goes to (2, 0.4, 0) m.
ball = iw.Object(iw.load_mesh(file), iw.PerfectConductor(), iw.rigid(translation=[2.0, 0.4, 0.0]))
scene = iw.Scene({"ball": ball})

chirp = iw.FMCW(start_frequency=77e9, bandwidth=3.6e9, duration=60e-6, samples=256)
wavelength = chirp.wavelength
patch = Cosine(exponent=3.0)  # power pattern of one antenna; ~75° between half-power points
transmitters = iw.linear_array(2, 2 * wavelength, pattern=patch)
receivers = iw.linear_array(4, wavelength / 2, pattern=patch)
# Arrays are given about their own centre; on the board they lie side by side.
receivers = iw.scene.AntennaArray(receivers.positions - torch.tensor([0.0, 0.0, 0.01]), patch)
radar = iw.Radar(transmitters, receivers, chirp, positions=[[0.0, 0.0, 0.0]])
grid = radar.grid(range_min=0.5, range_max=4.0)

sampling = iw.Sampling(depth=1)
simulated = iw.simulate(scene, radar, grid, seed=1, sampling=sampling, noise_figure_db=15.0)
# ADC samples of a real board go the same way: complex [frame, tx, rx, sample].
capture = simulated.capture
capture.save(folder / "ball.nc")

loaded = iw.Capture.load(folder / "ball.nc")
assert torch.equal(loaded.beat, capture.beat)
spectrum = loaded.spectrum(grid)
row, column = divmod(int(spectrum.argmax()), grid.u_count)
nearest = min(ball.vertices, key=torch.linalg.norm)  # a smooth ball shines there

figure = iw.plotting.spectrum(spectrum, grid, relative=False, dynamic_range=60.0)
figure.savefig(folder / "ball.png", dpi=100)
print(f"strongest echo: R = {grid.ranges[row]:.2f} m, u = {grid.u[column]:+.2f}")
print(f"nearest point:  R = {nearest.norm():.2f} m, u = {nearest[1] / nearest.norm():+.2f}")
print(f"picture: {folder / 'ball.png'}")
