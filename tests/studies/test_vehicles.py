"""Cars of the generator: whole, of the measures asked for, the same for the same seed."""

import numpy as np
import pytest
import torch
import trimesh

from invertwin.errors import InputError
from invertwin.scene import Mesh
from invertwin_studies.vehicles import KINDS, Car, car_distance, car_mesh, sample_car


def solid(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_a_closed_body_of_its_measures(kind):
    for seed in range(4):
        car = sample_car(seed, kind)
        mesh = car_mesh(car, 0.08, wheels=False)
        body = solid(mesh)
        assert body.is_watertight
        assert body.is_winding_consistent
        size = mesh.vertices.amax(0) - mesh.vertices.amin(0)
        # Rounded and curved ends take off a little; nothing sticks out.
        for found, wanted in zip(
            size.tolist(), (car.length, car.width, car.height - car.clearance), strict=True
        ):
            assert wanted - 0.22 < found < wanted + 1e-3
        assert 0.45 < body.volume / float(size.prod()) < 0.9
        front = car.wheelbase / 2 + car.front_overhang
        assert float(mesh.vertices[:, 0].amax()) == pytest.approx(front, abs=0.15)


def test_wheels_stand_on_the_ground_below_the_axles():
    car = Car()
    mesh = car_mesh(car, 0.04)
    assert solid(mesh).is_watertight
    assert float(mesh.vertices[:, 2].amin()) == pytest.approx(0.0, abs=0.01)
    low = mesh.vertices[mesh.vertices[:, 2] < 0.02]
    assert sorted({round(x, 0) for x in low[:, 0].tolist()}) == [-1.0, 1.0]
    assert float((low[:, 0].abs() - car.wheelbase / 2).abs().max()) < 0.15
    assert float(car_mesh(car, 0.08, wheels=False).vertices[:, 2].amin()) > 0.15


def test_the_field_is_close_to_a_distance():
    car = sample_car(3)
    mesh = car_mesh(car, 0.05, wheels=False)
    points, faces, *_ = trimesh.sample.sample_surface(solid(mesh), 3000, seed=1)
    normals = solid(mesh).face_normals[faces]
    for away in (-0.05, 0.05):
        field = car_distance(car, torch.from_numpy(np.asarray(points + away * normals)))
        assert float((field - away).abs().mean()) < 0.01
    mirrored = torch.from_numpy(np.asarray(points)) * torch.tensor([1.0, -1.0, 1.0])
    assert torch.equal(
        car_distance(car, mirrored), car_distance(car, torch.from_numpy(np.asarray(points)))
    )


def test_a_seed_is_a_car():
    assert sample_car(5) == sample_car(5)
    assert sample_car(5) != sample_car(6)
    lengths = [sample_car(seed).length for seed in range(300)]
    heights = [sample_car(seed).height for seed in range(300)]
    decks = [sample_car(seed).deck_length for seed in range(300)]
    assert min(lengths) < 3.7
    assert max(lengths) > 5.4
    assert min(heights) < 1.3
    assert max(heights) > 1.9
    assert max(decks) > 1.5


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda: Car(length=-1.0), "a car's length"),
        (lambda: Car(roof_crown=float("nan")), "a car's roof_crown"),
        (lambda: sample_car(-1), "seed"),
        (lambda: sample_car(1, "lorry"), "expected a kind of car"),
        (lambda: car_mesh(Car(), 0.0), r"spacing \[m\]"),
    ],
)
def test_wrong_measures_are_refused(wrong, said):
    with pytest.raises(InputError, match=said):
        wrong()
