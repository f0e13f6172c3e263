"""Densities through the whole map: derivative against differences that have converged."""

import pytest
import torch

from invertwin.channel import Sampling
from invertwin.inversion.gradcheck.gradcheck import GradcheckSettings, gradcheck
from invertwin.models.radar import SurrogateMap
from invertwin.radar import Surrogate
from invertwin.scene import DensityGrid, Scene, plate
from scenes import radar, thing

LOW, HIGH = [-0.3, -0.35, -0.3], [0.3, 0.35, 0.3]


@pytest.mark.claim
@pytest.mark.slow
def test_gradient_by_densities_is_that_of_converged_differences():
    """A soft ball in front of a wall; its densities change at random."""
    start = thing(plate(0.1, 0.1), (1.1, 0.05, 0.02), (0.05, 0.1, 0.2))
    scene = Scene({"wall": thing(plate(2.4, 2.4, divisions=2), (2, 0, 0)), "object": start})
    module = DensityGrid.from_optical_depth("object", LOW, HIGH, (8, 10, 9))
    distance = module.lattice.nodes.norm(dim=-1)
    module = DensityGrid("object", LOW, HIGH, 15 * torch.sigmoid((0.22 - distance) / 0.03))
    change = torch.randn(module.value.shape, generator=torch.Generator().manual_seed(2)).double()
    device = radar()
    model = SurrogateMap(
        device.grid(0.4, 2.8, 0.6, oversample=1),
        Surrogate("gaussian", range_width=2.0, angle_width=1.0),
        Sampling(depth=1, samples=300_000, boundary_samples=1000),
    )
    report = gradcheck(
        model,
        module,
        change,
        scene=scene,
        sensor=device,
        settings=GradcheckSettings(
            repeats=2, step=0.02, difference_samples=300_000, noise=0.008, max_pairs=8
        ),
        seed=1,
    )
    print(f"L1 {report.full.relative_l1:.4f}, noise {report.difference_noise:.4f}")
    assert report.difference_noise < 0.01
    assert report.full.relative_l1 < 0.03
