"""The check of gradients, checked: it passes right ones and fails wrong ones."""

import re

import pytest
import torch

from invertwin.channel import Grid, Sampling
from invertwin.errors import InputError
from invertwin.inversion.gradcheck.gradcheck import GradcheckSettings, gradcheck
from invertwin.inversion.gradcheck.lines import make_line
from invertwin.models.radar import ExactMap, SurrogateMap
from invertwin.radar import Radar, Surrogate
from invertwin.radar.parameters import RadarPose
from invertwin.scene import Scene
from invertwin.scene.parameters import MaterialValues, Pose, Scale, Translation
from scenes import float64, occluder, radar

CHEAP = GradcheckSettings(repeats=2, difference_samples=200_000, noise=0.02, max_pairs=6)
KERNELS = Surrogate("gaussian", range_width=2.0, angle_width=1.0)
DRAWN = Sampling(depth=1, samples=100_000, boundary_samples=50_000)
SLIDE = {"translation": float64([0.0, 1.0, 0.0])}


def model_of(grid: Grid) -> SurrogateMap:
    return SurrogateMap(grid, KERNELS, DRAWN)


def test_a_right_gradient_passes_and_reports():
    device = radar()
    lines: list[str] = []
    grid = device.grid(0.4, 2.8, 0.6, oversample=1)
    report = gradcheck(
        model_of(grid),
        Translation("occluder"),
        SLIDE,
        scene=occluder(),
        sensor=device,
        settings=CHEAP,
        progress=lines.append,
    )
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
    assert re.search(r"difference noise 0\.\d+, about 0 s left", lines[-1])


def test_a_wrong_gradient_fails():
    """All of the value, half of the derivative."""
    device = radar()

    class Halved(torch.autograd.Function):
        @staticmethod
        def forward(ctx, theta):
            return theta.clone()

        @staticmethod
        def jvp(ctx, *tangents):
            return 0.5 * tangents[0]

    class Wrong(Translation):
        def forward(self, scene):
            (x, y, z) = self.translation
            moved = {"translation": torch.stack([x, Halved.apply(y), z])}
            return torch.func.functional_call(Translation("occluder"), moved, (scene,))

    report = gradcheck(
        model_of(device.grid(0.4, 2.8, 0.6, oversample=1)),
        Wrong("occluder"),
        SLIDE["translation"],
        scene=occluder(),
        sensor=device,
        settings=CHEAP,
    )
    assert report.full.relative_l1 == pytest.approx(0.5, abs=0.05)
    assert abs(report.full.order) < 0.5


def test_nothing_that_moves_is_refused():
    device = radar()
    with pytest.raises(InputError, match="expected a map that depends on θ"):
        gradcheck(
            model_of(device.grid(2.7, 3.0)),
            Translation("occluder"),
            SLIDE,
            scene=occluder(),
            sensor=device,
            settings=CHEAP,
        )


@pytest.mark.parametrize(
    ("module", "tangent", "message"),
    [
        (
            Translation("occluder"),
            {"shear": float64(1.0)},
            r"Translation \(translation \(3,\)\), got",
        ),
        (Translation("occluder"), float64([1.0, 0.0]), r"got translation \(2,\)"),
        (Pose("occluder"), float64([1.0, 0.0, 0.0]), r"by name for Pose \(translation, rotation\)"),
        (Scale("door"), float64(1.0), "got 'door'"),
    ],
    ids=["name", "shape", "several", "object"],
)
def test_bad_tangents_are_named(module, tangent, message):
    device = radar()
    model = model_of(device.grid(0.4, 2.8))
    with pytest.raises(InputError, match=message):
        gradcheck(model, module, tangent, scene=occluder(), sensor=device, settings=CHEAP)


def test_models_without_a_mean_derivative_are_refused():
    device = radar()
    model = ExactMap(device.grid(0.4, 2.8))
    with pytest.raises(InputError, match="expected a smooth model, got ExactMap"):
        gradcheck(model, Translation("occluder"), SLIDE, scene=occluder(), sensor=device)


@pytest.mark.parametrize(
    ("module", "tangent"),
    [
        (Translation("occluder"), SLIDE),
        (Pose("occluder"), {"rotation": float64([0.0, 0.0, 2.0])}),
        (Scale("occluder"), {"log_scale": float64(1.0)}),
        (MaterialValues("wall", permittivity=4.0), {"raw.permittivity": float64(1.0)}),
        (RadarPose(), SLIDE),
        (RadarPose(), {"rotation": float64([0.0, 0.0, 1.0])}),
    ],
    ids=["translation", "rotation", "scale", "material", "radar translation", "radar rotation"],
)
def test_lines_start_at_the_scene(module, tangent):
    scene, device = occluder(), radar()
    of_radar = isinstance(module, RadarPose)
    line = make_line(module, tangent, device if of_radar else scene)

    def at(theta: float) -> tuple[Scene, Radar]:
        found = line.evaluate_end(theta)
        return (scene, found) if of_radar else (found, device)

    moved, seen = at(0.0)
    for name in scene.names:
        assert torch.allclose(moved[name].vertices, scene[name].vertices, atol=1e-12)
    assert torch.allclose(seen.positions, device.positions)
    turned, other = at(0.1)
    changed = [
        not torch.equal(turned["occluder"].vertices, scene["occluder"].vertices),
        abs(float(turned["wall"].material.permittivity) - 4.0) > 1e-3,
        not torch.equal(other.link().rotations, device.link().rotations),
        not torch.equal(other.positions, device.positions),
    ]
    assert sum(changed) == 1
