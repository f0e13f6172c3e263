"""Densities through the whole map: derivative against differences that have converged."""

import pytest
import torch
from torch import Tensor

from invertwin.inversion.gradcheck import gradcheck
from invertwin.radar import Radar, Surrogate
from invertwin.scene import DensityGrid, Scene, plate
from scenes import radar, thing

LOW, HIGH = [-0.35, -0.3, -0.3], [0.35, 0.3, 0.3]


@pytest.mark.slow
def test_gradient_by_densities_is_that_of_converged_differences():
    """A soft ball before a wall; its densities change at random."""
    start = thing(plate(0.1, 0.1), (0.05, 0.02, 1.1), (0.1, 0.2, 0.05))
    scene = Scene({"wall": thing(plate(2.4, 2.4, divisions=2), (0, 0, 2)), "object": start})
    module = DensityGrid.even("object", LOW, HIGH, (10, 9, 8))
    distance = module.lattice.nodes.norm(dim=-1)
    module = DensityGrid("object", LOW, HIGH, 15 * torch.sigmoid((0.22 - distance) / 0.03))
    value = module.value.detach()
    change = torch.randn(value.shape, generator=torch.Generator().manual_seed(2)).double()

    def direction(found: Scene, seen: Radar, theta: Tensor) -> tuple[Scene, Radar]:
        return torch.func.functional_call(module, {"value": value + theta * change}, (found,)), seen

    device = radar()
    report = gradcheck(
        module(scene),
        device,
        device.grid(0.4, 2.8, 0.6, oversample=1),
        direction,
        surrogate=Surrogate("gaussian", range_width=2.0, angle_width=1.0),
        depth=1,
        samples=300_000,
        boundary_samples=1000,
        repeats=2,
        step=0.02,
        difference_samples=300_000,
        noise=0.008,
        max_pairs=8,
        seed=1,
    )
    print(f"L1 {report.full.relative_l1:.4f}, noise {report.difference_noise:.4f}")
    assert report.difference_noise < 0.01
    assert report.full.relative_l1 < 0.03
