"""The open body model Anny: its interface as documented, and itself where it is installed."""

import importlib.util
import sys
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from invertwin.errors import InputError
from invertwin.scene import load_anny, rotation_from_vector
from scenes import float64

TURN = float64([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])


class Stick:
    """Two bones and three vertices with Anny's names, shapes and axes, and no body behind them."""

    bone_labels = ("root", "head")
    bone_parents = (-1, 0)
    phenotype_labels = ("age", "height")
    vertex_bone_weights = torch.tensor([[1.0, 0.0], [0.75, 0.25], [1.0, 0.0]])
    vertex_bone_indices = torch.tensor([[0, 1], [1, 0], [1, 0]])

    def __init__(self, skinning_method: str) -> None:
        assert skinning_method == "lbs"

    def to(self, dtype: torch.dtype) -> "Stick":
        assert dtype == torch.float64
        return self

    def get_triangular_faces(self) -> Tensor:
        return torch.tensor([[0, 1, 2]])

    def __call__(self, pose_parameters: None, phenotype_kwargs: dict[str, Tensor]) -> Any:
        tall = 1.0 + phenotype_kwargs["height"][0] + phenotype_kwargs["age"][0].square()
        skin = float64([[0, 0, 0], [0.1, -0.2, 1], [0, 0, 2]]) * tall
        return {"rest_vertices": skin[None], "rest_bone_heads": skin[None, [0, 2]] / 2}


@pytest.fixture
def stick(monkeypatch):
    monkeypatch.setitem(sys.modules, "anny", SimpleNamespace(Anny=Stick))


@pytest.mark.usefixtures("stick")
def test_a_model_becomes_a_template_in_our_axes():
    template = load_anny({"age": 0.0}, ["height"])
    # Anny's people face −y, z up; ours face −x, z up.
    skin = 1.5 * float64([[0, 0, 0], [-0.2, -0.1, 1], [0, 0, 2]])
    assert torch.allclose(template.vertices, skin)
    assert torch.allclose(template.joints, float64([[0, 0, 0], [0, 0, 1.5]]))
    assert torch.allclose(template.weights, float64([[1, 0], [0.25, 0.75], [0, 1]]))
    assert template.names == ("root", "head")
    assert template.parents == (-1, 0)
    assert template.faces.tolist() == [[0, 1, 2]]
    assert template.shape_count == 1
    still = torch.eye(3, dtype=torch.float64).repeat(2, 1, 1)
    taller, joints = template.apply_pose(still, float64([0.3]))
    assert torch.allclose(taller, 1.8 * skin / 1.5)
    assert torch.allclose(joints[1], float64([0, 0, 1.8]))


@pytest.mark.usefixtures("stick")
def test_unknown_phenotypes_are_named():
    with pytest.raises(InputError, match="among age, height, got 'wings'; use Anny's names"):
        load_anny(coordinates=["wings"])
    with pytest.raises(InputError, match="got 'size'"):
        load_anny({"size": 0.5})


def test_without_anny_the_message_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "anny", None)
    with pytest.raises(InputError, match=r"type: pip install 'invertwin\[anny\]'"):
        load_anny()


@pytest.mark.claim
@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("anny") is None, reason="needs the extra anny")
def test_skinning_is_that_of_anny_itself():
    """All joints turned at random: the same skin as Anny's own, to rounding."""
    import anny  # type: ignore[import-not-found]

    given = {"age": 0.6, "gender": 0.3}
    template = load_anny(given, ["height"])
    draw = torch.Generator().manual_seed(0)
    turns = 0.3 * torch.randn(len(template.names), 3, generator=draw, dtype=torch.float64)
    rotations = torch.stack([rotation_from_vector(turn) for turn in turns])
    skin, joints = template.apply_pose(rotations, torch.zeros(1, dtype=torch.float64))
    whole = [rotations[0]]
    for joint, parent in enumerate(template.parents[1:], start=1):
        whole.append(whole[parent] @ rotations[joint])
    model = anny.Anny(skinning_method="lbs").to(dtype=torch.float64)
    values = {name: float64([given.get(name, 0.5)]) for name in model.phenotype_labels}
    rest = model(pose_parameters=None, phenotype_kwargs=values)["rest_bone_poses"][0]
    pose = rest.clone()
    pose[:, :3, :3] = TURN.T @ torch.stack(whole) @ TURN @ rest[:, :3, :3]
    pose[:, :3, 3] = joints @ TURN
    own = model(pose_parameters=pose[None], phenotype_kwargs=values, pose_parameterization="world")[
        "vertices"
    ][0]
    assert torch.allclose(own @ TURN.T, skin, atol=1e-9)
    higher = values | {"height": values["height"] + 0.03}
    taller = model(pose_parameters=None, phenotype_kwargs=higher)["rest_vertices"][0]
    still = torch.eye(3, dtype=torch.float64).repeat(len(template.names), 1, 1)
    found, _ = template.apply_pose(still, float64([0.03]))
    assert torch.allclose(taller @ TURN.T, found, atol=1e-6)
