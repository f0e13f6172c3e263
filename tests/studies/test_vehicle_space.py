"""The public space of vehicles: its files, and what run files make of them."""

import shutil
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from cli.test_shapes import check, learned
from invertwin.cli.schema import build
from invertwin.errors import InputError
from invertwin.scene import LinearShape, box
from invertwin_studies.vehicle_space import load_vehicle_space


def extent(mesh):
    return (mesh.vertices.amax(0) - mesh.vertices.amin(0)).detach()


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
    with pytest.raises(InputError, match=r"plain arrays.*vehicle3d_pca\.npz.*load the original"):
        load_vehicle_space(tmp_path)


def test_unknown_level(tmp_path, unchecked):
    with pytest.raises(InputError, match="expected level 'coarse' or 'fine'"):
        load_vehicle_space(tmp_path, "finest")  # type: ignore[arg-type]


def save_vehicles(folder):
    """A space of boxes, in the files of the public one."""
    mean, modes = box([1.0, 2.0, 3.0]), np.random.default_rng(0).normal(size=(24, 4))
    folder.mkdir()
    (folder / "dodec_mean.obj").write_text(
        "\n".join(
            [f"v {x} {y} {z}" for x, y, z in mean.vertices.tolist()]
            + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in mean.faces.tolist()]
        )
    )
    names = ("default_dodec_mean", "default_dodec_pc", "default_dodec_sv")
    parts = (mean.vertices.numpy().ravel(), modes, np.ones(4))
    np.savez(folder / "vehicle3d_pca.npz", **dict(zip(names, parts, strict=True)))


def test_vehicles_of_run_files_start_as_their_object(tmp_path):
    save_vehicles(tmp_path / "vehicles")
    space = f'folder = "{tmp_path}/vehicles"\nlevel = "coarse"'
    text = learned(f'shape = "vehicle"\n{space}\ncoefficients = [0.5, -2.0]')
    text = text.replace('kind = "prior"', f'kind = "shape_space"\n{space}\nmodes = 3')
    run = check(text, tmp_path)
    scene = build.scene(run)
    first, *_ = build.parameters(run.parameters, scene, objects=run.scene)
    assert isinstance(first, LinearShape)
    assert first.latent.tolist() == [0.5, -2.0, 0.0]
    torch.testing.assert_close(first(scene)["plate"].mesh.vertices, scene["plate"].mesh.vertices)
    run = check(text.replace("modes = 3", "modes = 1"), tmp_path)
    with pytest.raises(InputError, match=r"parameters\[0\]: expected at least as many modes as"):
        build.parameters(run.parameters, scene, objects=run.scene)
