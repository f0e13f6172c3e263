"""The learned prior: loaded from the package, decoded, meshed, followed by derivatives."""

import subprocess
import sys
import timeit
from importlib import resources
from typing import Any

import numpy as np
import pytest
import torch
import torch.autograd.forward_ad as forward_ad
import trimesh
from torch import Tensor

from invertwin.errors import InputError
from invertwin.scene import Mesh, PriorShape, Scene, ShapePrior, box, load_prior
from invertwin.scene.shape_models.lattice import Lattice
from invertwin.scene.shape_models.prior import Decoder
from scenes import float64, thing

PRIOR = load_prior()
ALONE = """
import resource, socket

def closed(*_, **__):
    raise OSError("no network")

socket.socket.connect = socket.create_connection = socket.getaddrinfo = closed
import torch
from invertwin.scene import load_prior

def used():  # [MB]
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

prior = load_prior()
z = torch.zeros(prior.latent_size, dtype=torch.float64)
before, inside = used(), 0
for plane in prior.slices(z, (512, 512, 512)):
    inside += int((plane < 0).sum())
print(inside, used() - before)
"""


def latent(seed: int, size: float = 1.0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return size * torch.randn(PRIOR.latent_size, generator=generator, dtype=torch.float64)


def volume(mesh: Mesh) -> Tensor:
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return (a * torch.linalg.cross(b, c)).sum() / 6


def test_the_packaged_model_is_small():
    file = resources.files("invertwin.scene.geometry") / "vehicle_prior.npz"
    with resources.as_file(file) as path:
        assert path.stat().st_size < 5e6
    assert 16 <= PRIOR.latent_size <= 32


@pytest.mark.slow
def test_loads_without_network_and_decodes_in_slices():
    """512³ numbers would take 1 GB; a plane and its parts take some 10 MB."""
    ended = subprocess.run(
        [sys.executable, "-c", ALONE], capture_output=True, text=True, check=True
    )
    inside, grown = (float(word) for word in ended.stdout.split())
    cell = float(((PRIOR.high - PRIOR.low) / 511).prod())
    assert inside * cell == pytest.approx(float(volume(PRIOR.mean_mesh())), rel=0.02)
    assert grown < 150


def test_a_field_of_64_nodes_a_side_decodes_within_a_second():
    PRIOR.decode(latent(0), (8, 8, 8))
    seconds = timeit.repeat(lambda: PRIOR.decode(latent(0), (64, 64, 64)), number=1, repeat=5)
    assert min(seconds) < 1  # a busy machine delays some of them
    assert PRIOR.decode(latent(0), (64, 64, 64)).shape == (64, 64, 64)


def test_the_whole_field_its_slices_and_its_points_are_one():
    z, counts = latent(1), (9, 8, 7)
    points = Lattice.from_bounds(PRIOR.low, PRIOR.high, counts).nodes.reshape(-1, 3)
    whole = PRIOR.decode(z, counts)
    assert torch.allclose(whole.reshape(-1), PRIOR.distance(points, z), atol=1e-12)
    mirrored = PRIOR.distance(points * float64([1, -1, 1]), z)
    assert torch.allclose(mirrored, whole.reshape(-1), atol=1e-12)


def test_the_mean_shape_is_a_car():
    mesh = PRIOR.mean_mesh()
    body = trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)
    assert body.is_watertight
    size = (mesh.vertices.amax(0) - mesh.vertices.amin(0)).tolist()
    for found, low, high in zip(size, (4.2, 1.6, 1.1), (5.0, 1.95, 1.5), strict=True):
        assert low < found < high
    assert body.volume == pytest.approx(float(volume(mesh)))


@pytest.mark.parametrize("seed", range(3))
def test_random_latents_are_whole_cars(seed):
    mesh = PRIOR.mesh(latent(seed))
    body = trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)
    assert body.is_watertight
    parts = sorted(part.volume for part in body.split(only_watertight=False))
    assert parts[-1] > 0.99 * body.volume
    assert 3.0 < body.volume < 16.0
    assert float(PRIOR.distance(mesh.vertices, latent(seed)).abs().max()) < 2e-3


def test_the_derivative_of_the_volume_is_that_of_differences():
    start, way = latent(2, 0.5), latent(3)
    moving = start.clone().requires_grad_()
    volume(PRIOR.mesh(moving, (80, 31, 30))).backward()
    assert moving.grad is not None
    step = 0.02
    ends = [float(volume(PRIOR.mesh(start + s * way, (80, 31, 30)))) for s in (-step, step)]
    assert float(moving.grad @ way) == pytest.approx((ends[1] - ends[0]) / (2 * step), rel=0.02)


def test_the_module_replaces_the_mesh_and_keeps_the_pose():
    scene = Scene({"car": thing(box(1.0), (0.0, 0.0, 9.0))})
    module = PriorShape("car", initial=latent(4).tolist(), counts=(34, 13, 12))
    found = module(scene)["car"]
    assert torch.equal(found.transform, scene["car"].transform)
    assert len(found.mesh.faces) > 1000
    assert list(module.state_dict()) == ["latent"]
    assert torch.equal(module.values()["car.latent"], latent(4))
    found.vertices.square().sum().backward()
    assert module.latent.grad is not None
    assert float(module.latent.grad.abs().min()) > 0
    points = float64([[0.1, 0.2, 0.3]])
    assert torch.equal(module.distance(points), PRIOR.distance(points, latent(4)))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ([0.0, 0.0], "expected latent as numbers of shape"),
        ([float("nan")] * PRIOR.latent_size, "expected finite latent"),
        ([7.0] * PRIOR.latent_size, "expected a latent within ±6 standard deviations, got 7"),
        ("car", "expected latent as numbers"),
    ],
)
def test_a_latent_that_does_not_decode_is_refused(unchecked, wrong, said):
    with pytest.raises(InputError, match=said):
        PriorShape("car", initial=wrong)


def test_a_latent_that_runs_away_says_what_to_do():
    module = PriorShape("car")
    module.latent.data[2] = -6.5
    with pytest.raises(InputError, match=r"got 6\.5; raise the weight of its regulariser"):
        module(Scene({"car": thing(box(1.0), (0.0, 0.0, 9.0))}))


def test_a_saved_prior_is_loaded(tmp_path):
    PRIOR.save(tmp_path / "again.npz")
    again = load_prior(tmp_path / "again.npz")
    assert again.lattice.counts == PRIOR.lattice.counts
    assert torch.equal(again.values(latent(5)), PRIOR.values(latent(5)))


def test_what_is_no_prior_is_refused(tmp_path):
    with pytest.raises(InputError, match="got no such file"):
        load_prior(tmp_path / "none.npz")
    good = tmp_path / "good.npz"
    PRIOR.save(good)
    with np.load(good) as arrays:
        parts = {name: arrays[name] for name in arrays.files}
    spoilt = np.full_like(parts["enter.bias"], np.nan)
    wrong: dict[str, dict[str, Any]] = {
        "other": {"values": np.zeros(3)},
        "old": {**parts, "format": "another"},
        "shape": {**parts, "leave.weight": parts["leave.weight"][:-1]},
        "nan": {**parts, "enter.bias": spoilt},
    }
    for name, arrays in wrong.items():
        np.savez(tmp_path / f"{name}.npz", **arrays)
    (tmp_path / "cut.npz").write_bytes(good.read_bytes()[:100_000])
    (tmp_path / "text.npz").write_text("no numbers")
    (tmp_path / "empty.npz").write_bytes(b"")
    for name in [*wrong, "cut", "text", "empty"]:
        with pytest.raises(InputError, match=rf"{name}\.npz"):
            load_prior(tmp_path / f"{name}.npz")


def test_a_decoder_of_other_nodes_is_refused():
    decoder = Decoder(2, 4, 3, 5)
    with pytest.raises(InputError, match="half the nodes"):
        ShapePrior(decoder, Lattice.from_bounds([-1, -1, -1], [1, 1, 1], (5, 5, 5)))


def test_derivatives_are_the_same_on_a_surface_that_is_known():
    """A mesh of the same latent is kept; both ways of differentiation see their own latent."""
    prior = load_prior()
    latent = 0.3 * torch.ones(prior.latent_size, dtype=torch.float64)
    tangent = torch.linspace(-1, 1, prior.latent_size, dtype=torch.float64)
    first, other = prior.mesh(latent), prior.mesh(-latent)
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(latent, tangent)
        found = forward_ad.unpack_dual(prior.mesh(dual).vertices)
    again = latent.clone().requires_grad_()
    mesh = prior.mesh(again)
    assert torch.equal(mesh.vertices.detach(), first.vertices)
    assert torch.equal(found.primal, first.vertices)
    assert not torch.equal(other.vertices[:9], first.vertices[:9])
    weight = torch.sin(torch.arange(mesh.vertices.numel())).reshape(mesh.vertices.shape).double()
    (slope,) = torch.autograd.grad((mesh.vertices * weight).sum(), again)
    assert found.tangent is not None
    forward = float((found.tangent * weight).sum())
    assert forward == pytest.approx(float(slope @ tangent), rel=1e-9)
    coarse = prior.mesh(latent, (20, 12, 12))
    assert len(coarse.vertices) < len(first.vertices) / 2
