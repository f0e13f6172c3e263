"""Training of a shape prior, and how far the packaged one reaches beyond what it was trained on."""

from importlib import resources

import numpy as np
import pytest
import torch
import trimesh

from invertwin.errors import InputError
from invertwin.inversion import LatentNorm, Training, compare_shapes, train_prior
from invertwin.inversion.prior import car_distances
from invertwin.scene import (
    Mesh,
    PriorShape,
    Scene,
    Translation,
    box,
    load_prior,
    load_vehicle_space,
)
from scenes import thing

SMALL = Training(cars=120, held_out=20, latent=6, width=16, features=8, epochs=6, batch=20)


def quiet(_: str) -> None:
    pass


@pytest.fixture(scope="module")
def trained():
    lines: list[str] = []
    return train_prior(SMALL, lines.append), lines


def test_latents_are_standard_and_stand_for_their_cars(trained):
    found, _ = trained
    latents = found.latents
    assert latents.shape == (120, 6)
    assert float(latents.mean(0).abs().max()) < 1e-6
    assert torch.allclose(torch.cov(latents.T), torch.eye(6, dtype=torch.float64), atol=1e-6)
    lattice = found.prior.lattice
    truth = car_distances(lattice, 5, SMALL.seed)
    decoded = found.prior.decoder(latents[:5])
    mean = found.prior.decoder(torch.zeros(5, 6, dtype=torch.float64))
    near = truth.abs() < 0.1
    gaps = [(field - truth)[near].square().mean().sqrt() for field in (decoded, mean)]
    assert float(gaps[0]) < 0.5 * float(gaps[1])


def test_coordinates_come_in_the_order_of_their_effect(trained):
    found, _ = trained
    effect = [
        float((found.prior.decoder(z) - found.prior.decoder(-z)).norm())
        for z in torch.eye(6, dtype=torch.float64)
    ]
    assert effect[0] > 1.5 * effect[2] > 1.5 * effect[5]


def test_learning_helps_on_cars_that_were_not_seen(trained):
    found, lines = trained
    errors = [row["error"] for row in found.history]
    assert len(errors) == SMALL.epochs
    assert errors[-1] < errors[0]
    assert found.held_out_error < 0.5 * found.mean_error
    assert lines[0].startswith("settings: cars 120, held_out 20, latent 6")
    assert lines[-1].startswith("held out: error")


def test_a_seed_is_a_prior(trained):
    found, _ = trained
    torch.manual_seed(99)
    before = torch.random.get_rng_state()
    again = train_prior(SMALL, quiet)
    assert torch.equal(before, torch.random.get_rng_state())
    for latent, other in zip(found.latents[:3], again.latents[:3], strict=True):
        gap = found.prior.decoder(latent) - again.prior.decoder(other)
        assert float(gap.abs().max()) < 1e-3


def test_the_packaged_log_is_that_of_the_defaults():
    """So that one command without options trains it again."""
    folder = resources.files("invertwin.scene.geometry")
    first = (folder / "vehicle_prior.log").read_text().splitlines()[0]
    lines: list[str] = []

    class StopError(Exception):
        pass

    def say(line: str) -> None:
        lines.append(line)
        raise StopError

    with pytest.raises(StopError):
        train_prior(None, say)
    assert first == lines[0]
    assert load_prior().latent_size == Training().latent


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"cars": 40}, "expected more cars"),
        ({"latent": 0}, "latent"),
        ({"epochs": 0}, "epochs"),
        ({"rate": float("nan")}, r"expected rate in \(0, inf\), got nan"),
        ({"rate": -1.0}, r"expected rate in \(0, inf\), got -1"),
        ({"regularizer": float("nan")}, r"expected regularizer in \[0, inf\), got nan"),
        ({"seed": -1}, "expected seed as an integer >= 0, got -1"),
    ],
)
def test_settings_that_cannot_be_trained_are_refused(wrong, said):
    with pytest.raises(InputError, match=said):
        Training(**wrong)


def test_the_regulariser_is_half_the_weighted_square():
    module = PriorShape("car", initial=[2.0] + [0.0] * (load_prior().latent_size - 1))
    scene = Scene({"car": thing(box(1.0), (0.0, 0.0, 9.0))})
    term = LatentNorm(module, 3.0)(scene)
    term.backward()
    assert float(term.detach()) == pytest.approx(6.0)
    assert module.latent.grad is not None
    assert torch.allclose(module.latent.grad, 3 * module.latent.detach())
    with pytest.raises(InputError, match="a module with a latent"):
        LatentNorm(Translation("car"), 1.0)


def nearest(mesh: Mesh) -> tuple[Mesh, Mesh]:
    """The prior's closest shape and its mean shape, both where they fit a mesh best."""
    prior = load_prior()
    body = trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)
    on, faces, *_ = trimesh.sample.sample_surface(body, 3000, seed=1)
    points = torch.from_numpy(np.asarray(on))
    shifted = points + 0.05 * torch.from_numpy(np.asarray(body.face_normals[faces]))

    def search(free: bool) -> Mesh:
        latent = torch.zeros(prior.latent_size, dtype=torch.float64, requires_grad=free)
        place = torch.zeros(3, dtype=torch.float64, requires_grad=True)
        sought = [latent, place] if free else [place]
        optimizer = torch.optim.LBFGS(sought, max_iter=40, line_search_fn="strong_wolfe")

        def loss() -> torch.Tensor:
            optimizer.zero_grad()
            gaps = prior.distance(torch.cat([points, shifted]) - place, latent)
            wanted = torch.cat([torch.zeros(3000), torch.full((3000,), 0.05)])
            value = (gaps - wanted).square().mean() * 1e3 + 1e-3 * latent.square().sum()
            value.backward()
            return value

        optimizer.step(loss)  # type: ignore[arg-type]
        found = prior.mesh(latent.detach())
        return Mesh(found.vertices + place.detach(), found.faces)

    return search(True), search(False)


@pytest.mark.slow
def test_cars_of_another_source_are_within_reach(data_folder):
    """The learned linear space of vehicles was used neither in training nor for the generator."""
    space = load_vehicle_space(data_folder / "vehicle_prior")
    generator = torch.Generator().manual_seed(2026)
    ratios = []
    for _ in range(5):
        truth = space.mesh(torch.randn(78, generator=generator, dtype=torch.float64))
        fitted, mean = nearest(truth)
        after, before = compare_shapes(fitted, truth), compare_shapes(mean, truth)
        ratios.append(after.chamfer / before.chamfer)
        assert after.iou is not None
        assert before.iou is not None
        print(
            f"Chamfer {before.chamfer:.3f} → {after.chamfer:.3f} m, "
            f"IoU {before.iou:.3f} → {after.iou:.3f}"
        )
        assert after.iou > before.iou + 0.08
    assert max(ratios) < 0.6
    assert float(np.median(ratios)) < 0.5
