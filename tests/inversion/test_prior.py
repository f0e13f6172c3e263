"""The regulariser of latents, and how far the packaged prior reaches beyond its training."""

import numpy as np
import pytest
import torch
import trimesh

from invertwin.errors import InputError
from invertwin.inversion import LatentNorm, compare_shapes
from invertwin.scene import (
    Mesh,
    PriorShape,
    Scene,
    Translation,
    box,
    load_prior,
)
from invertwin_studies.vehicle_space import load_vehicle_space
from scenes import thing


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
    on, faces, *_ = trimesh.sample.sample_surface(body, 1500, seed=1)
    points = torch.from_numpy(np.asarray(on))
    shifted = points + 0.05 * torch.from_numpy(np.asarray(body.face_normals[faces]))

    def search(free: bool) -> Mesh:
        latent = torch.zeros(prior.latent_size, dtype=torch.float64, requires_grad=free)
        place = torch.zeros(3, dtype=torch.float64, requires_grad=True)
        fitted = [latent, place] if free else [place]
        optimizer = torch.optim.LBFGS(fitted, max_iter=40, line_search_fn="strong_wolfe")

        def loss() -> torch.Tensor:
            optimizer.zero_grad()
            gaps = prior.distance(torch.cat([points, shifted]) - place, latent)
            wanted = torch.cat([torch.zeros(1500), torch.full((1500,), 0.05)])
            value = (gaps - wanted).square().mean() * 1e3 + 1e-3 * latent.square().sum()
            value.backward()
            return value

        optimizer.step(loss)  # type: ignore[arg-type]
        found = prior.mesh(latent.detach())
        return Mesh(found.vertices + place.detach(), found.faces)

    return search(True), search(False)


@pytest.mark.claim
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
