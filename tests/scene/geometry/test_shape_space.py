"""Linear shape spaces, and the public one of vehicles."""

import shutil
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from torch.autograd import gradcheck

from invertwin.errors import InputError
from invertwin.scene import LinearShape, Scene, ShapeSpace, box, load_vehicle_space
from scenes import float64, thing

CUBE = box(1.0)
SCENE = Scene({"car": thing(CUBE, (0, 0, 3), (0.1, 0.2, 0.3))})


def space() -> ShapeSpace:
    """A cube that gets longer (σ 0.1 m) and higher (σ 0.05 m)."""
    longer, higher = (CUBE.vertices * float64(axis) for axis in ((1, 0, 0), (0, 1, 0)))
    components = torch.stack([longer, higher], dim=-1)
    return ShapeSpace(CUBE.vertices, components, float64([0.1, 0.05]), CUBE.faces)


def extent(mesh):
    return (mesh.vertices.amax(0) - mesh.vertices.amin(0)).detach()


def test_coordinates_are_in_standard_deviations():
    module = LinearShape("car", space(), [2.0, -1.0])
    found = module(SCENE)["car"]
    assert torch.allclose(extent(found.mesh), float64([1.2, 0.95, 1.0]))
    assert found.pose is SCENE["car"].pose
    assert torch.equal(module.values()["car.latent"], float64([2.0, -1.0]))
    assert torch.allclose(space().latent(found.mesh.vertices.detach()), float64([2.0, -1.0]))
    mean = LinearShape("car", space(), 1)
    assert torch.equal(mean(SCENE)["car"].mesh.vertices, CUBE.vertices)


def test_gradients_both_ways():
    module = LinearShape("car", space(), 2)

    def vertices(latent: torch.Tensor) -> torch.Tensor:
        moved = torch.func.functional_call(module, {"latent": latent}, (SCENE,))
        return moved["car"].vertices

    start = float64([0.4, -0.2]).requires_grad_()
    assert gradcheck(vertices, start, check_forward_ad=True)


def test_bad_input(unchecked):
    with pytest.raises(InputError, match="at most 2 coordinates of the shape space, got 3"):
        LinearShape("car", space(), 3)
    with pytest.raises(InputError, match="coordinates as an integer >= 1"):
        LinearShape("car", space(), 0)
    with pytest.raises(InputError, match="NaN"):
        LinearShape("car", space(), [float("nan")])
    with pytest.raises(InputError, match="expected deviations >= 0"):
        ShapeSpace(CUBE.vertices, space().components, float64([0.1, -1.0]), CUBE.faces)
    with pytest.raises(InputError, match="expected components as numbers of shape"):
        ShapeSpace(CUBE.vertices, space().components[1:], float64([0.1, 0.1]), CUBE.faces)


@pytest.mark.parametrize(("level", "vertices", "modes"), [("fine", 127, 78), ("coarse", 16, 14)])
def test_public_vehicles(data_folder, level, vertices, modes):
    vehicles = load_vehicle_space(data_folder / "vehicle_prior", level)
    assert vehicles.components.shape == (vertices, 3, modes)
    assert bool((vehicles.deviations.diff() <= 0).all())
    share = vehicles.deviations.square().cumsum(0) / vehicles.deviations.square().sum()
    assert float(share[4]) > 0.9
    car = vehicles.mesh(torch.zeros(1, dtype=torch.float64))
    length, width, height = extent(car).tolist()
    assert 4 < length < 5
    assert 1.6 < width < 1.9
    assert 1.1 < height < 1.4
    for latent in torch.randn(
        5, modes, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    ):
        mesh = vehicles.mesh(latent.clamp(-2, 2))
        solid = trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)
        assert solid.is_watertight
        assert solid.volume > 3


def test_mean_meshes_in_another_order_are_sorted(data_folder, tmp_path):
    source = data_folder / "vehicle_prior"
    shutil.copyfile(source / "vehicle3d_pca.npz", tmp_path / "vehicle3d_pca.npz")
    solid: Any = trimesh.load(source / "dodec_mean.obj", process=False)
    order = np.random.default_rng(0).permutation(16)
    trimesh.Trimesh(solid.vertices[order], np.argsort(order)[solid.faces], process=False).export(
        tmp_path / "dodec_mean.obj"
    )
    ours, theirs = (load_vehicle_space(folder, "coarse") for folder in (tmp_path, source))
    assert torch.equal(ours.faces, theirs.faces)


def test_missing_vehicles_say_where_they_are_from(tmp_path):
    with pytest.raises(InputError, match=r"INVERTWIN_DATA.*github\.com/mleotta/vehicle3d"):
        load_vehicle_space(tmp_path)
    np.savez(tmp_path / "vehicle3d_pca.npz", default1_mean=np.zeros(3))
    with pytest.raises(InputError, match="expected default1_pc in vehicle3d_pca"):
        load_vehicle_space(tmp_path)
    (tmp_path / "vehicle3d_pca.npz").write_bytes(b"")
    with pytest.raises(InputError, match=r"plain arrays in vehicle3d_pca.npz.*load the original"):
        load_vehicle_space(tmp_path)


def test_unknown_level(tmp_path, unchecked):
    with pytest.raises(InputError, match="expected level 'coarse' or 'fine'"):
        load_vehicle_space(tmp_path, "finest")  # type: ignore[arg-type]
