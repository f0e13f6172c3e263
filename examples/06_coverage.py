"""A coverage map of a furnished room, and its derivative when a cupboard moves.

Usage: .venv/bin/python examples/06_coverage.py [folder]     (default out/examples)
"""

import sys
from pathlib import Path

import torch
import torch.autograd.forward_ad as forward_ad

import invertwin as iw
from invertwin.links import CellSampling, MapPlane, Reception, Transmitters
from invertwin.scene import PerfectConductor, Slab, box, rigid, rotation_from_vector

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
folder.mkdir(parents=True, exist_ok=True)


def at(x: float, y: float, z: float, yaw: float = 0.0) -> torch.Tensor:
    return rigid(rotation_from_vector(torch.tensor([0.0, 0.0, yaw])), torch.tensor([x, y, z]))


concrete = Slab.itu("concrete", thickness=0.2)
board, metal = Slab.itu("chipboard", thickness=0.018), PerfectConductor()
scene = iw.Scene(
    {
        "room": iw.Object(box([8.0, 6.0, 2.7]), concrete, at(4.0, 3.0, 1.35)),
        "cupboard": iw.Object(box([1.2, 0.5, 1.9]), metal, at(3.2, 2.3, 0.96, yaw=0.3)),
        "shelf": iw.Object(box([0.4, 2.0, 2.0]), board, at(6.1, 4.4, 1.01)),
        "table": iw.Object(box([1.6, 0.8, 0.04]), board, at(1.6, 4.6, 0.75)),
    }
)
mast = Transmitters(torch.tensor([0.7, 0.6, 2.4]).double())
reception = Reception(3.5e9, depth=2)


def gain(shift: torch.Tensor, sampling: CellSampling) -> torch.Tensor:
    """Mean gain of cells of 20 cm at 1.2 m, with the cupboard moved to the right."""
    plane = MapPlane.horizontal([0.05, 0.05], [7.95, 5.95], 1.2, 0.2, sampling)
    pose = scene["cupboard"].pose.clone()
    pose[0, 3] = pose[0, 3] + shift
    moved = scene.replace("cupboard", pose=pose)
    return iw.RadioMap(plane, reception, "gain").predict(moved, mast, seed=0)[0]


def slope(sampling: CellSampling) -> tuple[torch.Tensor, torch.Tensor]:
    """The gain and its derivative by the shift."""
    with forward_ad.dual_level():
        shift = forward_ad.make_dual(torch.zeros(()).double(), torch.ones(()).double())
        value, rate = forward_ad.unpack_dual(gain(shift, sampling))
        assert rate is not None
        return value, rate


sampling = CellSampling(points=16, edge_points=100_000)
value, full = slope(sampling)
_, fixed = slope(CellSampling(points=16, boundary=False))
step, fine = torch.tensor(0.02).double(), CellSampling(points=100)
truth = (gain(step, fine) - gain(-step, fine)) / (2 * step)

lit = value.max() * 1e-6  # 60 dB below the brightest cell: the inside of the cupboard is dark
per_metre = {
    title: 10 / torch.log(torch.tensor(10.0)) * rate / (value + lit)
    for title, rate in {
        "derivative by differences": truth,
        "invertwin": full,
        "without boundary paths": fixed,
    }.items()
}
plane = MapPlane.horizontal([0.05, 0.05], [7.95, 5.95], 1.2, 0.2)
figure = iw.plotting.coverage(
    {"path gain at 1.2 m": 10 * torch.log10(value + lit)},
    plane,
    derivatives=per_metre,
    scene=scene,
    transmitters=mast,
    dynamic_range=40.0,
)
figure.savefig(folder / "coverage.png", dpi=100, metadata={"Software": None})
size = truth.abs().sum()
print(
    f"with boundary paths:    {float((full - truth).abs().sum() / size):.2f} from the differences"
)
print(f"without boundary paths: {float((fixed - truth).abs().sum() / size):.2f}")
