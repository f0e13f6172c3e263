"""Every parameterisation of shape through the whole map: derivative against differences."""

import copy
import math

import pytest
import torch
from torch import Tensor, nn

from invertwin.channel import Sampling
from invertwin.inversion.gradcheck.gradcheck import GradcheckSettings, gradcheck
from invertwin.models.radar import SurrogateMap
from invertwin.radar import Surrogate
from invertwin.scene import (
    BodyTemplate,
    DistanceGrid,
    LatticeDeformation,
    LinearShape,
    Mesh,
    NeuralDistance,
    PriorShape,
    Scene,
    ShapePrior,
    ShapeSpace,
    SkinnedBody,
    SmoothVertices,
    articulated_template,
    box,
    load_prior,
    plate,
    rigid,
    rotation_from_vector,
    sphere,
)
from invertwin.scene.shape_models.lattice import Lattice
from scenes import float64, radar, thing

Line = tuple[Scene, nn.Module, dict[str, Tensor]]
LOW, HIGH = [-0.35, -0.45, -0.4], [0.35, 0.45, 0.4]


def before_a_wall(mesh: Mesh) -> Scene:
    """An object 1 m away, turned a little, in front of a wall 2 m away."""
    return Scene(
        {
            "wall": thing(plate(2.4, 2.4, divisions=2), (2, 0, 0)),
            "object": thing(mesh, (1.1, 0.05, 0.02), (0.05, 0.1, 0.2)),
        }
    )


def noise(shape: torch.Size, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def arm() -> BodyTemplate:
    """Two bars with a gap at the elbow: parts that cut through each other have no derivative."""
    upper, lower = box([0.1, 0.24, 0.1]), box([0.08, 0.3, 0.08])
    parts = [
        Mesh(upper.vertices - float64([0, 0.2, 0]), upper.faces),
        Mesh(lower.vertices + float64([0, 0.21, 0]), lower.faces),
    ]
    return articulated_template(parts, (-1, 0), [[0, -0.3, 0], [0, 0, 0]])


def skin() -> BodyTemplate:
    """A tall rounded body whose weights change smoothly from one joint to the next."""
    ball = sphere(0.1, 3)
    vertices = ball.vertices * float64([1.0, 1.0, 3.0])
    share = torch.sigmoid(vertices[:, 2] / 0.05)
    weights = torch.stack([1 - share, share], dim=1)
    return BodyTemplate(vertices, ball.faces, weights, (-1, 0), float64([[0, 0, -0.3], [0, 0, 0]]))


def space() -> ShapeSpace:
    """A box that gets wider, and higher on one side."""
    mesh = box([0.2, 0.5, 0.3], divisions=2)
    wider = mesh.vertices * float64([0, 1, 0])
    higher = mesh.vertices * float64([0, 0, 1]) * (mesh.vertices[:, 1:2] > 0)
    return ShapeSpace(
        mesh.vertices, torch.stack([wider, higher], dim=-1), float64([0.5, 0.5]), mesh.faces
    )


def distance_grid() -> Line:
    def ellipsoid(points: Tensor) -> Tensor:
        return 0.2 * ((points / float64([0.2, 0.3, 0.2])).norm(dim=1) - 1)

    module = DistanceGrid.from_function("object", LOW, HIGH, (11, 13, 12), ellipsoid)
    scene = before_a_wall(sphere(0.2, 1))
    # Values on one side fall: the surface moves outwards there.
    change = -(module.lattice.nodes[..., 1] > 0.1).double()
    return scene, module, {"value": change}


def neural_distance() -> Line:
    module = NeuralDistance(
        "object", LOW, HIGH, (11, 13, 12), radius=0.22, width=8, frequency=3.0, seed=1
    )
    weights = dict(module.named_parameters())
    name = "layers.2.weight"
    weights[name].data = 0.03 * noise(weights[name].shape)
    scene = before_a_wall(sphere(0.2, 1))
    change = noise(weights[name].shape, 4)
    return scene, module, {name: change}


def small_prior(size: float = 0.13) -> ShapePrior:
    """The packaged cars as toys."""
    cars = load_prior()
    decoder = copy.deepcopy(cars.decoder)
    decoder.basis.weight.data *= size
    decoder.basis.bias.data *= size
    lattice = Lattice.from_bounds(size * cars.low, size * cars.high, cars.lattice.counts)
    return ShapePrior(decoder, lattice)


def prior_latent() -> Line:
    prior = small_prior()
    module = PriorShape(
        "object", prior, 0.5 * noise(torch.Size([prior.latent_size]), 5), (56, 21, 20)
    )
    # Seen from its side and a little from its front.
    start = before_a_wall(box(0.1))
    turned = rigid(
        rotation_from_vector(float64([0.0, 0.0, 0.6 + math.pi / 2])), float64([1.1, 0.0, -0.1])
    )
    scene = start.replace("object", pose=turned)
    change = 8.0 * noise(torch.Size([prior.latent_size]), 6)
    return scene, module, {"latent": change}


def latent() -> Line:
    module = LinearShape("object", space(), [0.1, 0.2])
    return before_a_wall(box(0.1)), module, {"latent": float64([5.0, -10.0])}


def joint_angle() -> Line:
    module = SkinnedBody("object", arm(), [[0.1, 0, 0], [0.5, 0.0, 0.2]])
    turn = float64([[0, 0, 0], [3.0, 0, 0.5]])
    return before_a_wall(box(0.1)), module, {"rotation": turn}


def skinning() -> Line:
    module = SkinnedBody("object", skin(), [[0.1, 0, 0], [0.5, 0.0, 0.2]])
    turn = float64([[2.0, 0, 0], [4.0, 0, 1.0]])
    return before_a_wall(box(0.1)), module, {"rotation": turn}


def lattice() -> Line:
    scene = before_a_wall(sphere(0.2, 3))
    module = LatticeDeformation("object", LOW, HIGH, (3, 3, 3))
    return scene, module, {"offsets": noise(module.offsets.shape, 2)}


def smooth_vertices() -> Line:
    ball = sphere(0.2, 3)
    module = SmoothVertices("object", ball, 10.0)
    return before_a_wall(ball), module, {"latent": 6.0 * noise(module.latent.shape, 3)}


CASES = [
    distance_grid, neural_distance, prior_latent, latent, joint_angle, skinning, lattice,
    smooth_vertices,
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [pytest.param(case, marks=pytest.mark.claim if case is latent else ()) for case in CASES],
    ids=[case.__name__ for case in CASES],
)
def test_gradient_is_that_of_converged_differences(case):
    scene, module, tangent = case()
    device = radar()
    model = SurrogateMap(
        device.grid(0.4, 2.8, 0.6, oversample=1),
        Surrogate("gaussian", range_width=2.0, angle_width=1.0),
        Sampling(depth=1, samples=400_000, boundary_samples=200_000),
    )
    check = GradcheckSettings(
        repeats=3,
        step=2e-3 if "distance" in case.__name__ else 6e-3,
        difference_samples=1_000_000,
        noise=0.008,
        max_pairs=24,
    )
    report = gradcheck(model, module, tangent, scene=scene, sensor=device, settings=check, seed=1)
    print(
        f"L1 {report.full.relative_l1:.4f}, interior {report.interior.relative_l1:.3f}, "
        f"noise {report.difference_noise:.4f}, {report.pairs} pairs"
    )
    assert report.difference_noise < 0.01
    assert report.full.relative_l1 < 0.03
    assert report.interior.relative_l1 > 3 * report.full.relative_l1
