"""A coverage map of a furnished room, and its derivative when a cupboard moves.

Usage: .venv/bin/python examples/06_coverage.py [folder]     (default out/examples)
"""

import sys
from pathlib import Path

import torch
from torch.func import jvp

import invertwin as iw
from invertwin.links import CellSampling, MapPlane, PropagationSettings, Transmitters
from invertwin.scene import Slab, rotation_from_vector

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
folder.mkdir(parents=True, exist_ok=True)


def at(x: float, y: float, z: float, yaw: float = 0.0) -> torch.Tensor:
    return iw.rigid(rotation_from_vector(torch.tensor([0.0, 0.0, yaw])), torch.tensor([x, y, z]))


concrete, board = Slab.itu("concrete", thickness=0.2), Slab.itu("chipboard", thickness=0.018)
cupboard = at(3.2, 2.3, 0.96, yaw=0.3)
scene = iw.Scene(
    {
        "room": iw.Object(iw.box([8.0, 6.0, 2.7]), concrete, at(4.0, 3.0, 1.35)),
        "cupboard": iw.Object(iw.box([1.2, 0.5, 1.9]), iw.PerfectConductor(), cupboard),
        "shelf": iw.Object(iw.box([0.4, 2.0, 2.0]), board, at(6.1, 4.4, 1.01)),
        "table": iw.Object(iw.box([1.6, 0.8, 0.04]), board, at(1.6, 4.6, 0.75)),
    }
)
mast = Transmitters(torch.tensor([[0.7, 0.6, 2.4]]).double())
reception = PropagationSettings(3.5e9, depth=2)
zero, one, step = torch.tensor([0.0, 1.0, 0.02]).double()


def gain(shift: torch.Tensor, sampling: CellSampling) -> torch.Tensor:
    """Mean gain of cells of 25 cm at 1.2 m, with the cupboard moved along x."""
    plane = MapPlane.horizontal([0.05, 0.05], [7.8, 5.8], 1.2, 0.25, sampling)
    moved = scene.replace("cupboard", pose=cupboard + shift * at(1, 0, 0).triu(1))
    return iw.RadioMap(plane, reception, "gain").predict(moved, mast, seed=0)[0]


best, fine = CellSampling(), CellSampling(points=100)
value, full = jvp(lambda shift: gain(shift, best), (zero,), (one,))[:2]
_, fixed = jvp(lambda shift: gain(shift, CellSampling(boundary=False)), (zero,), (one,))[:2]
truth = (gain(step, fine) - gain(-step, fine)) / (2 * step)
lit = value + value.max() * 1e-6  # 60 dB below the brightest: inside the cupboard it is dark
slopes = {"by differences": truth, "by invertwin": full, "without boundary paths": fixed}
iw.plotting.coverage(
    {"path gain at 1.2 m": 10 * torch.log10(lit)},
    MapPlane.horizontal([0.05, 0.05], [7.8, 5.8], 1.2, 0.25),
    derivatives={f"derivative, {how}": 4.343 * slope / lit for how, slope in slopes.items()},
    scene=scene,
    transmitters=mast,
).savefig(folder / "coverage.png", dpi=100, metadata={"Software": None})
for how, slope in slopes.items():
    print(f"{how}: {float((slope - truth).abs().sum() / truth.abs().sum()):.2f} off")
