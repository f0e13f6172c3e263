"""Shapes in the loop: what is fitted reaches the truth, interrupted or not, meshed anew or not."""

from typing import Any

import pytest
import torch
from torch import Tensor, nn

import fits
from invertwin.capture import Capture
from invertwin.channel import Sampling
from invertwin.inversion import Optimizer, compare_shapes
from invertwin.radar import Surrogate
from invertwin.scene import (
    DistanceGrid,
    LatticeDeformation,
    LinearShape,
    Mesh,
    NeuralDistance,
    Scene,
    ShapeSpace,
    SkinnedBody,
    SmoothVertices,
    articulated_template,
    box,
    plate,
    sphere,
)
from invertwin.simulation import simulate
from scenes import float64, radar, thing

LOW, HIGH = [-0.35, -0.4, -0.35], [0.35, 0.4, 0.35]
PLACES = float64([[0.0, y, z] for y in (-0.4, 0.0, 0.4) for z in (-0.2, 0.2)])


def space() -> ShapeSpace:
    """A box that gets wider on both sides."""
    mesh = box([0.2, 0.4, 0.3], divisions=2)
    wider = (mesh.vertices * float64([0, 1, 0]))[..., None]
    return ShapeSpace(mesh.vertices, wider, float64([0.25]), mesh.faces)


def placed(mesh: Mesh) -> Scene:
    return Scene(
        {
            "wall": thing(plate(2.0, 2.0, divisions=2), (2, 0, 0)),
            "object": thing(mesh, (1.1, 0.05, 0.0), (0.0, 0.0, 0.3)),
        }
    )


def settings(**changes: Any) -> dict[str, Any]:
    device = radar(PLACES)
    return {
        "grid": device.grid(0.6, 2.6, 0.6, oversample=1),
        "depth": 1,
        "steps": 3,
        "samples": 6_000,
        "boundary_samples": 2_000,
        "surrogate": Surrogate(range_width=1.0, angle_width=0.5),
        "optimizer": Optimizer(rate=0.01),
        "seed": 1,
        **changes,
    }


def recorded(scene: Scene) -> Capture:
    device = radar(PLACES)
    grid = settings()["grid"]
    data = simulate(scene, device, grid, seed=5, sampling=Sampling(depth=1, points_per_m2=5e3))
    return Capture.from_beat(data.beat, device)


@pytest.fixture(scope="module")
def wide() -> Capture:
    """Exact rough echoes of a box 1.5 times as wide as the mean one."""
    return recorded(placed(space().mesh(float64([2.0]))))


@pytest.mark.claim
@pytest.mark.slow
def test_a_wide_box_is_found_in_the_space(wide):
    start = placed(box(0.1))
    found = fits.fit(
        start,
        radar(PLACES),
        wide,
        LinearShape("object", space(), 1),
        **settings(steps=60, samples=20_000, boundary_samples=5_000, optimizer=Optimizer(rate=0.1)),
    )
    truth = space().mesh(float64([2.0]))
    before = compare_shapes(space().mesh(float64([0.0])), truth)
    after = compare_shapes(found.scene["object"].mesh, truth)
    (latent,) = found.history[-1]["values"]["object.latent"]
    assert latent == pytest.approx(2.0, abs=0.5)
    assert after.chamfer < 0.5 * before.chamfer
    assert after.iou is not None
    assert before.iou is not None
    assert after.iou > before.iou + 0.1


def ellipsoid(points: Tensor) -> Tensor:
    return 0.15 * ((points / float64([0.15, 0.25, 0.15])).norm(dim=1) - 1)


BALL = sphere(0.15, 2)
LEFT, RIGHT = (
    Mesh(box([0.1, 0.2, 0.1]).vertices + float64([0, y, 0]), box(1.0).faces) for y in (-0.15, 0.15)
)
SHAPES = {
    "grid": lambda: DistanceGrid.from_function("object", LOW, HIGH, (11, 13, 11), ellipsoid),
    "network": lambda: NeuralDistance("object", LOW, HIGH, (11, 13, 11), radius=0.15, width=8),
    "lattice": lambda: LatticeDeformation("object", LOW, HIGH),
    "smooth": lambda: SmoothVertices("object", BALL),
    "body": lambda: SkinnedBody(
        "object", articulated_template([LEFT, RIGHT], (-1, 0), [[0, -0.3, 0], [0, 0, 0]])
    ),
}


class InterruptError(Exception):
    """Stands for whatever ends a run."""


@pytest.mark.parametrize("name", SHAPES)
def test_every_shape_is_fitted_and_resumed(name, wide, tmp_path):
    """Parameters move, and an interrupted fit ends where a whole one does."""

    def fit(**changes: Any) -> tuple[nn.Module, Any]:
        module = SHAPES[name]()
        found = fits.fit(placed(BALL), radar(PLACES), wide, module, **settings(**changes))
        return module, found

    first = {key: value.clone() for key, value in SHAPES[name]().state_dict().items()}
    whole, found = fit(steps=4)
    assert all(torch.isfinite(torch.tensor(row["loss"])) for row in found.history)
    moved = whole.state_dict()
    assert any(not torch.equal(first[key], moved[key]) for key in first)

    def stop(row: dict[str, Any]) -> None:
        if row["step"] == 2:
            raise InterruptError

    kept = {"checkpoint": tmp_path / "fit.pt", "checkpoint_every": 1, "steps": 4}
    with pytest.raises(InterruptError):
        fit(progress=stop, **kept)
    resumed, _ = fit(resume=True, **kept)
    gap, way = (
        torch.cat([(moved[key] - other[key]).flatten() for key in moved]).norm()
        for other in (resumed.state_dict(), first)
    )
    # The first steps of Adam are as long for a rounding error as for a gradient.
    assert float(gap) < 0.03 * float(way)
