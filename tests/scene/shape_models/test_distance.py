"""Signed distances: meshes of known shapes, the implicit relation, changes of topology."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
import trimesh
from torch import Tensor
from torch.autograd import forward_ad

from invertwin.errors import InputError
from invertwin.scene import (
    DistanceGrid,
    Mesh,
    NeuralDistance,
    RoughDielectric,
    Scene,
    iso_surface,
    sphere,
)
from invertwin.scene.shape_models.lattice import Lattice
from scenes import float64, thing

SCENE = Scene({"ball": thing(sphere(0.2, 1), (0.1, 0.2, 2.0), (0.3, 0.0, 0.5))})
LOW, HIGH = [-0.5, -0.4, -0.45], [0.5, 0.4, 0.45]


def ball(radius: float, center: tuple[float, float, float] = (0, 0, 0)) -> Callable:
    return lambda points: (points - float64(center)).norm(dim=1) - radius


def volume(mesh: Mesh) -> Tensor:
    a, b, c = mesh.vertices[mesh.faces].unbind(1)
    return (torch.linalg.cross(a, b) * c).sum() / 6


def bodies(mesh: Mesh) -> int:
    faces = mesh.faces.numpy()
    solid = trimesh.Trimesh(mesh.vertices.detach().numpy(), faces, process=False)
    assert solid.is_watertight
    return solid.body_count


def grid(radius: float = 0.3, counts: tuple[int, int, int] = (21, 17, 19)) -> DistanceGrid:
    return DistanceGrid.from_function("ball", LOW, HIGH, counts, ball(radius, (0.03, 0.01, -0.02)))


def net(counts: int = 17) -> NeuralDistance:
    """A network that has learned something: its last layer is not zero."""
    field = NeuralDistance("ball", LOW, HIGH, [counts] * 3, radius=0.25, width=8, seed=3)
    generator = torch.Generator().manual_seed(1)
    last = list(field.parameters())[-2]
    last.data = 0.04 * torch.randn(last.shape, generator=generator, dtype=torch.float64)
    return field


def test_mesh_of_a_ball_lies_on_it_and_faces_outwards():
    mesh = iso_surface(ball(0.3), Lattice.from_bounds(LOW, HIGH, (25, 21, 23)))
    assert torch.allclose(mesh.vertices.norm(dim=1), float64(0.3), atol=1e-9)
    assert float(volume(mesh)) == pytest.approx(4 / 3 * math.pi * 0.3**3, rel=0.01)
    assert bodies(mesh) == 1


def test_grid_interpolates_its_nodes_and_straight_lines_exactly():
    field = grid()
    nodes = field.lattice.nodes.reshape(-1, 3)
    assert torch.allclose(field.distance(nodes), field.value.flatten(), atol=1e-12)
    slope = float64([0.3, -1.0, 2.0])
    line = DistanceGrid.from_function("ball", LOW, HIGH, (4, 5, 6), lambda p: p @ slope)
    generator = torch.Generator().manual_seed(0)
    points = float64(LOW) + torch.rand(50, 3, generator=generator, dtype=torch.float64) * (
        float64(HIGH) - float64(LOW)
    )
    assert torch.allclose(line.distance(points), points @ slope, atol=1e-12)


def test_modules_replace_the_mesh_and_keep_pose_and_material():
    placed = Scene({"ball": thing(sphere(0.2, 1), (0, 0, 2), material=RoughDielectric(3.0))})
    for module, radius in (
        (grid(), 0.3),
        (NeuralDistance("ball", LOW, HIGH, [21] * 3, radius=0.25), 0.25),
    ):
        found = module(placed)["ball"]
        center = (found.mesh.vertices.amax(0) + found.mesh.vertices.amin(0)) / 2
        away = (found.mesh.vertices - center).norm(dim=1)
        assert torch.allclose(away, float64(radius), atol=2e-3)
        assert found.pose is placed["ball"].pose
        assert found.material is placed["ball"].material


@pytest.mark.parametrize("make", [grid, net], ids=["grid", "network"])
def test_normal_motion_is_that_of_the_surface(make):
    """n · dV against differences of where the line along n meets the changed surface."""
    module: Any = make()
    names = {n: p.detach() for n, p in module.named_parameters()}
    generator = torch.Generator().manual_seed(5)
    change = {
        n: torch.randn(p.shape, generator=generator, dtype=torch.float64) for n, p in names.items()
    }

    def field(theta: Tensor) -> Callable[[Tensor], Tensor]:
        values = {n: names[n] + theta * change[n] for n in names}
        wrapped = _Distance(module)
        return lambda points: torch.func.functional_call(
            wrapped, {f"module.{n}": v for n, v in values.items()}, (points,)
        )

    def mesh(theta: Tensor) -> Mesh:
        return iso_surface(field(theta), module.lattice)

    zero = torch.zeros((), dtype=torch.float64)
    start = mesh(zero).vertices.detach()
    place = start.clone().requires_grad_()
    (slope,) = torch.autograd.grad(field(zero)(place).sum(), place)
    normal = slope / slope.norm(dim=1, keepdim=True)
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(zero, torch.ones_like(zero))
        forward = forward_ad.unpack_dual(mesh(dual).vertices).tangent
    assert forward is not None
    # Reverse mode, with weights of its own for each vertex, is the same map.
    theta = zero.clone().requires_grad_()
    weights = torch.randn(start.shape, generator=generator, dtype=torch.float64)
    (reverse,) = torch.autograd.grad((weights * mesh(theta).vertices).sum(), theta)
    assert float(reverse) == pytest.approx(float((weights * forward).sum()), rel=1e-9)

    def height(epsilon: float) -> Tensor:
        """Where the line start + s n meets the surface of θ = ε, by bisection."""
        f = field(zero + epsilon)
        low, high = (torch.full((len(start), 1), s, dtype=torch.float64) for s in (-1e-3, 1e-3))
        with torch.no_grad():
            for _ in range(50):
                middle = (low + high) / 2
                outside = f(start + middle * normal)[:, None] > 0
                low, high = torch.where(outside, low, middle), torch.where(outside, middle, high)
        return low[:, 0]

    epsilon = 1e-5
    difference = (height(epsilon) - height(-epsilon)) / (2 * epsilon)
    along = (forward * normal).sum(1)
    assert float((along - difference).abs().sum() / difference.abs().sum()) < 1e-3
    assert torch.allclose(forward, along[:, None] * normal, atol=1e-9)


class _Distance(torch.nn.Module):
    """The field itself as what a module computes."""

    def __init__(self, module: Any) -> None:
        super().__init__()
        self.module = module

    def forward(self, points: Tensor) -> Tensor:
        module: Any = self.module
        return module.distance(points)


def test_derivative_of_the_volume_is_that_of_meshing_anew():
    field = grid(counts=(31, 25, 28))

    def size(offset: Tensor) -> Tensor:
        moved = torch.func.functional_call(field, {"value": field.value + offset}, (SCENE,))
        return volume(moved["ball"].mesh)

    offset = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(size(offset), offset)
    step = 2e-3
    ends = [float(size(offset.detach() + s).detach()) for s in (step, -step)]
    difference = (ends[0] - ends[1]) / (2 * step)
    assert difference == pytest.approx(-4 * math.pi * 0.3**2, rel=0.02)
    assert float(gradient) == pytest.approx(difference, rel=0.01)


def test_topology_changes_while_a_grid_is_fitted():
    """Two balls that touch lose volume by gradient steps on the nodes' values: they part."""
    near = [ball(0.2, (x, 0, 0)) for x in (0.19, -0.19)]
    field = DistanceGrid.from_function(
        "ball", LOW, HIGH, (21, 17, 19), lambda p: torch.minimum(near[0](p), near[1](p))
    )
    target = 2 * 4 / 3 * math.pi * 0.15**3
    counts, volumes = [], []
    for _ in range(12):
        mesh = field(SCENE)["ball"].mesh
        size = volume(mesh)
        (gradient,) = torch.autograd.grad(size, field.value)
        counts.append(bodies(mesh))
        volumes.append(float(size.detach()))
        field.value.data -= 0.4 * (volumes[-1] - target) * gradient / gradient.square().sum()
    assert counts[0] == 1
    assert counts[-1] == 2
    assert volumes[-1] == pytest.approx(target, rel=0.02)


def test_network_starts_as_a_ball_and_learns_another_shape():
    field = NeuralDistance("ball", LOW, HIGH, [15] * 3, radius=0.3, width=16)
    optimizer = torch.optim.Adam(field.parameters(), lr=3e-3)
    size = float64([0.35, 0.2, 0.3])

    def miss() -> Tensor:
        places = field(SCENE)["ball"].mesh.vertices
        return ((places / size).norm(dim=1) - 1).square().mean()

    start = float(miss().detach())
    for _ in range(60):
        optimizer.zero_grad()
        loss = miss()
        loss.backward()
        optimizer.step()
    assert float(miss().detach()) < 0.05 * start


def test_same_seed_same_network():
    first, same, other = (
        NeuralDistance("b", LOW, HIGH, [9] * 3, radius=0.2, seed=k).state_dict()["layers.0.weight"]
        for k in (1, 1, 2)
    )
    assert torch.equal(first, same)
    assert not torch.equal(first, other)


def test_bad_input():
    with pytest.raises(InputError, match="expected a field with both signs in its box"):
        DistanceGrid("ball", LOW, HIGH, torch.ones(4, 4, 4, dtype=torch.float64))(SCENE)
    broken = grid(counts=(5, 5, 5))
    broken.value.data[2, 2, 2] = torch.nan
    with pytest.raises(InputError, match="expected a finite field"):
        broken(SCENE)
    with pytest.raises(InputError, match=r"integer in \[2, 100000000\], got 1"):
        DistanceGrid("ball", LOW, HIGH, torch.ones(4, 1, 4, dtype=torch.float64))
    with pytest.raises(InputError, match="radius"):
        NeuralDistance("ball", LOW, HIGH, [9] * 3, radius=0.0)
    with pytest.raises(InputError, match="layers of sines"):
        NeuralDistance("ball", LOW, HIGH, [9] * 3, radius=0.1, depth=0)


def test_bad_grid_values(unchecked):
    with pytest.raises(InputError, match=r"expected signed distances \[m\] as numbers of shape"):
        DistanceGrid("ball", LOW, HIGH, torch.ones(4, 4))  # type: ignore[arg-type]


def test_smoothing_changes_steps_but_neither_shape_nor_reach():
    rough, smooth = (
        DistanceGrid.from_function("ball", LOW, HIGH, (9, 8, 7), ball(0.2), amount)
        for amount in (0.0, 5.0)
    )
    assert torch.allclose(smooth.distances, rough.distances, atol=1e-12)
    step = torch.zeros_like(smooth.value)
    step[4, 4, 3] = 1.0
    with torch.no_grad():
        smooth.value += step
    moved = (smooth.distances - rough.distances).detach()
    # (I + λL) of the move is the step: L by its definition, sums over neighbours.
    back = moved.clone()
    for axis in range(3):
        jump = 5.0 * moved.diff(dim=axis)
        count = moved.shape[axis]
        back.narrow(axis, 0, count - 1).sub_(jump)
        back.narrow(axis, 1, count - 1).add_(jump)
    assert torch.allclose(back, step, atol=1e-12)
    assert float(moved.max()) < 0.2
    weights = torch.linspace(-1, 1, moved.numel(), dtype=torch.float64).reshape(moved.shape)
    (gradient,) = torch.autograd.grad((smooth.distances * weights).sum(), smooth.value)
    assert float(gradient[4, 4, 3]) == pytest.approx(float((moved * weights).sum()), rel=1e-9)


def test_a_negative_smoothing():
    with pytest.raises(InputError, match="smoothing"):
        DistanceGrid.from_function("ball", LOW, HIGH, (9, 8, 7), ball(0.2), -1.0)
