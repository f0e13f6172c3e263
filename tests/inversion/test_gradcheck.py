"""The check of gradients, checked: it passes right ones and fails wrong ones."""

from typing import Any

import pytest
import torch

from invertwin.errors import InputError
from invertwin.inversion.gradcheck import Direction, gradcheck
from invertwin.radar import Surrogate
from scenes import occluder, radar

CHEAP: dict[str, Any] = {
    "depth": 1,
    "surrogate": Surrogate("gaussian", range_width=2.0, angle_width=1.0),
    "samples": 100_000,
    "boundary_samples": 50_000,
    "repeats": 2,
    "difference_samples": 200_000,
    "noise": 0.02,
    "max_pairs": 6,
}
SLIDE = Direction("translation", "occluder", (1.0, 0.0, 0.0))


def test_a_right_gradient_passes_and_reports():
    device = radar()
    lines: list[str] = []
    grid = device.grid(0.4, 2.8, 0.6, oversample=1)
    report = gradcheck(occluder(), device, grid, SLIDE, progress=lines.append, **CHEAP)
    assert report.full.relative_l1 < 0.03
    assert report.full.relative_l2 < 0.03
    assert report.full.correlation > 0.999
    assert report.full.order > 1
    assert report.interior.relative_l1 > 0.1
    assert report.no_interior_edges is None
    assert report.difference_noise <= 0.02
    assert report.step_agreement < 0.1
    assert 4 <= report.pairs <= 6
    assert report.gradient.shape == report.value.shape == (1, *grid.shape)
    assert lines
    assert "difference noise" in lines[-1]


def test_a_wrong_gradient_fails():
    """All of the value, half of the derivative."""
    device = radar()

    class Halved(torch.autograd.Function):
        @staticmethod
        def forward(ctx, theta):
            return theta.clone()

        @staticmethod
        def jvp(ctx, tangent):
            return 0.5 * tangent

    def wrong(scene, seen, theta):
        return SLIDE(scene, seen, Halved.apply(theta))

    report = gradcheck(occluder(), device, device.grid(0.4, 2.8, 0.6, oversample=1), wrong, **CHEAP)
    assert report.full.relative_l1 == pytest.approx(0.5, abs=0.05)
    assert abs(report.full.order) < 0.5


def test_nothing_that_moves_is_refused():
    device = radar()
    with pytest.raises(InputError, match="expected a map that depends on θ"):
        gradcheck(occluder(), device, device.grid(2.7, 3.0), SLIDE, **CHEAP)


@pytest.mark.parametrize(
    ("direction", "message"),
    [
        (lambda: Direction("shear"), "expected a parameter kind among translation, rotation"),
        (
            lambda: Direction("material", "wall", value="colour")(
                occluder(), radar(), torch.zeros((), dtype=torch.float64)
            ),
            "expected a value of wall's material",
        ),
        (
            lambda: Direction("scale", "door")(
                occluder(), radar(), torch.zeros((), dtype=torch.float64)
            ),
            "got 'door'",
        ),
    ],
)
def test_bad_directions_are_named(direction, message):
    with pytest.raises(InputError, match=message):
        direction()


@pytest.mark.parametrize(
    "direction",
    [
        SLIDE,
        Direction("rotation", "occluder", (0.0, 2.0, 0.0)),
        Direction("scale", "occluder"),
        Direction("material", "wall", value="permittivity"),
        Direction("radar_translation"),
        Direction("radar_rotation"),
    ],
    ids=lambda d: d.kind,
)
def test_directions_start_at_the_scene(direction):
    scene, device = occluder(), radar()
    moved, seen = direction(scene, device, torch.zeros((), dtype=torch.float64))
    for name in scene.names:
        assert torch.allclose(moved[name].vertices, scene[name].vertices, atol=1e-12)
    assert torch.allclose(seen.positions, device.positions)
    turned, other = direction(scene, device, torch.tensor(0.1, dtype=torch.float64))
    changed = [
        not torch.equal(turned["occluder"].vertices, scene["occluder"].vertices),
        vars(turned["wall"].material) != vars(scene["wall"].material),
        not torch.equal(other.link().rotations, device.link().rotations),
        not torch.equal(other.positions, device.positions),
    ]
    assert sum(changed) == 1
