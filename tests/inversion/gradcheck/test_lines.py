"""Lines through the parameters of modules: both ends are what the number says."""

import pytest
import torch

from invertwin.channel import Sampling
from invertwin.errors import InputError
from invertwin.inversion import Observation
from invertwin.inversion.gradcheck.lines import DistanceFieldLine, evaluate_losses, make_line
from invertwin.inversion.gradcheck.tangents import GaussianBump, parameter_changes
from invertwin.inversion.loss import relative_error
from invertwin.models.radar import BeatMap, SurrogateMap
from invertwin.radar import Surrogate
from invertwin.scene import (
    DensityGrid,
    DistanceGrid,
    LatticeDeformation,
    Pose,
    Scene,
    Translation,
    rotation_from_vector,
    sphere,
)
from invertwin.scene.parameters import MaterialValues
from invertwin.simulation import simulate
from scenes import float64, radar, thing

SCENE = Scene({"ball": thing(sphere(0.2, 2), (1, 0, 0))})
AHEAD = float64([1.0, 0.0, 0.0])
THETA = torch.tensor(0.03, dtype=torch.float64)


def ball() -> DistanceGrid:
    low, high = [-0.4] * 3, [0.4] * 3
    return DistanceGrid.from_function(
        "ball", low, high, (17, 17, 17), lambda p: p.norm(dim=1) - 0.2
    )


def test_a_parameter_moves_by_theta_times_its_change():
    line = make_line(Translation("ball"), {"translation": float64([-2.0, 1.0, 0.0])}, SCENE)
    assert torch.allclose(line.evaluate(THETA)["ball"].center, float64([0.94, 0.03, 0.0]))
    assert torch.equal(line.evaluate_end(0.03)["ball"].center, line.evaluate(THETA)["ball"].center)


def test_a_field_keeps_its_triangles_and_its_points_are_on_the_new_zero():
    module = ball()
    line = make_line(module, -torch.ones_like(module.value), SCENE)
    assert isinstance(line, DistanceFieldLine)
    before, after = module(SCENE)["ball"].mesh, line.evaluate_end(0.03)["ball"].mesh
    assert torch.equal(before.faces, after.faces)
    # The field falls by θ everywhere: the ball's radius grows by as much.
    assert torch.allclose(after.vertices.norm(dim=1), before.vertices.norm(dim=1) + 0.03, atol=2e-3)
    with torch.no_grad():
        grown = DistanceGrid("ball", [-0.4] * 3, [0.4] * 3, module.value - THETA)
        assert float(grown.distance(after.vertices).abs().max()) < 1e-9
    with pytest.raises(InputError, match="take a smaller step"):
        line.evaluate_end(-0.3)


def test_derivatives_go_through_the_module_itself():
    module = ball()
    line = make_line(module, {"value": -torch.ones_like(module.value)}, SCENE)
    with torch.autograd.forward_ad.dual_level():
        theta = torch.autograd.forward_ad.make_dual(THETA * 0, torch.ones_like(THETA))
        moved = line.evaluate(theta)
        vertices, speed = torch.autograd.forward_ad.unpack_dual(moved["ball"].mesh.vertices)
    assert speed is not None
    outwards = vertices / vertices.norm(dim=1, keepdim=True)
    assert torch.allclose((speed * outwards).sum(1), float64(1.0), atol=0.02)


def test_a_density_changes_where_the_tangent_is():
    module = DensityGrid("ball", [-1] * 3, [1] * 3, torch.full((2, 2, 2), 3.0).double())
    change = torch.zeros(2, 2, 2, dtype=torch.float64)
    change[1] = 2.0
    found = make_line(module, change, SCENE).evaluate(THETA)["ball"].cloud
    assert found is not None
    assert torch.allclose(found.density[0], float64(3.0))
    # softplus' = 1 − exp(−σ h): the spacing of two nodes 2 m apart is 2 m.
    slope = (1 - torch.exp(-3.0 * module.lattice.spacing.mean())) / module.lattice.spacing.mean()
    assert torch.allclose(found.density[1], 3.0 + 0.06 * slope, atol=1e-4)


def test_a_list_may_leave_out_the_end_of_a_row():
    found = parameter_changes(Translation("ball"), {"translation": [2.0]})
    assert found["translation"].tolist() == [2.0, 0.0, 0.0]


def test_rotations_are_vectors():
    turn = [0.0, 3e-6, 4e-6]
    found = (
        make_line(Pose("ball"), {"rotation": turn}, SCENE)
        .evaluate_end(1.0)["ball"]
        .transform[:3, :3]
    )
    assert torch.allclose(found, rotation_from_vector(float64(turn)), rtol=0, atol=1e-10)


@pytest.mark.parametrize(("name", "start"), [("permittivity", 3.0), ("diffuse", 0.2)])
def test_material_values_change_in_their_own_units(name, start):
    line = make_line(MaterialValues("ball", **{name: start}), {name: 2.0}, SCENE)
    ends = [getattr(line.evaluate_end(theta)["ball"].material, name) for theta in (-1e-6, 1e-6)]
    assert float(ends[1] - ends[0]) / 2e-6 == pytest.approx(2.0, abs=1e-6)


def test_a_bump_covers_control_points_beyond_the_box():
    module = LatticeDeformation("ball", [-0.3] * 3, [0.3] * 3, (4, 4, 4))
    wide = GaussianBump([0.0, 0.0, 0.0], width=100.0, height=[0.0, 1.0, 0.0])
    found = make_line(module, {"offsets": wide}, SCENE).evaluate_end(0.1)["ball"].vertices
    assert torch.allclose(found, SCENE["ball"].vertices + float64([0.0, 0.1, 0.0]), atol=1e-5)
    narrow = GaussianBump([0.5, 0.3, -0.3], width=0.02, height=[1.0, 1.0, 1.0])
    change = parameter_changes(module, {"offsets": narrow})["offsets"]
    # Nodes are 0.2 m apart; the last but one along x and y, and the first but one along z.
    assert torch.equal(change[5, 4, 1], float64([1.0, 1.0, 1.0]))
    assert float(change.sum()) == pytest.approx(3.0, abs=1e-9)


def test_losses_along_a_line_are_least_at_the_truth():
    """Losses of the smooth map, and of exact signals, which have the points of the data."""
    device = radar(receivers=4)
    grid = device.grid(0.5, 1.5, 0.6, oversample=1)
    line, offsets = make_line(Translation("ball"), AHEAD, SCENE), [-0.2, -0.1, 0.0, 0.1, 0.2]
    drawn = Sampling(depth=1, samples=20_000, points_per_m2=2e3, boundary=False)
    model = SurrogateMap(grid, Surrogate("gaussian", range_width=3.0, angle_width=2.0), drawn)
    sharp = model.scale_blur(0.0).predict(SCENE, device, 1)
    losses = evaluate_losses(line, offsets, Observation(model, sharp, sensor=device), seed=2)
    assert (losses.diff() > 0).tolist() == [False, False, True, True]
    assert float(losses[2]) < 0.02 * float(losses.max())
    data = simulate(SCENE, device, grid, seed=3, sampling=drawn)
    for channels in ((slice(None), slice(None)), (slice(1), slice(1, 3))):
        exact, beat = BeatMap(grid, drawn, channels=channels), data.beat[:, *channels]
        assert beat.shape[2] == (2 if channels[1].start else 4)
        seen = Observation(exact, beat, sensor=device, loss=relative_error)
        losses = evaluate_losses(line, offsets, seen, seed=3)
        assert float(losses[2]) < 1e-20
        assert float(losses[[0, 1, 3, 4]].min()) > 0.5
    capture = data.capture
    assert torch.allclose(exact.observe(capture), beat)


def test_a_line_leaves_its_module_alone():
    module = Translation("ball", [0.0, 0.1, 0.0])
    line = make_line(module, float64([0.0, 1.0, 0.0]), SCENE)
    assert float(line.evaluate_end(0.5)["ball"].center[1]) == pytest.approx(0.6)
    assert module.translation.tolist() == [0.0, 0.1, 0.0]
