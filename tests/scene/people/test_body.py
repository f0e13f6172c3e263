"""Skinned bodies: rigid parts, blending, the SMPL layout, gradients."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from invertwin.errors import InputError
from invertwin.scene import (
    BodyTemplate,
    Mesh,
    Scene,
    SkinnedBody,
    articulated_template,
    box,
    load_smpl,
    rotation_from_vector,
)
from scenes import float64, thing

SCENE = Scene({"arm": thing(box(0.1), (0, 0, 2), (0.1, 0.2, 0.3))})


def bar(start: float, end: float) -> Mesh:
    """A bar along x between two places."""
    shape = box([end - start, 0.1, 0.1])
    return Mesh(shape.vertices + float64([(start + end) / 2, 0, 0]), shape.faces)


def arm() -> BodyTemplate:
    """Upper arm, lower arm, hand along x, joints at 0, 1 and 2 m."""
    parts = [bar(0, 1), bar(1, 2), bar(2, 2.4)]
    return articulated_template(parts, (-1, 0, 1), [[0, 0, 0], [1, 0, 0], [2, 0, 0]])


def smpl(count: int = 20, joints: int = 4, seed: int = 0) -> dict[str, Any]:
    """Arrays of SMPL's names and shapes, with no body behind them."""
    draw = np.random.default_rng(seed)
    weights = draw.uniform(size=(count, joints))
    regressor = draw.uniform(size=(joints, count))
    return {
        "v_template": draw.normal(size=(count, 3)),
        "f": draw.integers(0, count, size=(30, 3)).astype(np.uint32),
        "weights": weights / weights.sum(1, keepdims=True),
        "kintree_table": np.array([[2**32 - 1, 0, 1, 0], [0, 1, 2, 3]], dtype=np.uint32),
        "J_regressor": regressor / regressor.sum(1, keepdims=True),
        "shapedirs": 0.1 * draw.normal(size=(count, 3, 12)),
        "posedirs": 0.1 * draw.normal(size=(count, 3, 9 * (joints - 1))),
    }


# SMPL's bodies face z, y up; ours face −x, z up.
TURN = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def reference(model: dict[str, Any], rotations: np.ndarray, betas: np.ndarray) -> np.ndarray:
    """SMPL's own recipe, with 4 × 4 matrices, vertex by vertex."""
    shaped = model["v_template"] + model["shapedirs"][..., : len(betas)] @ betas
    joints = model["J_regressor"] @ shaped
    posed = shaped + model["posedirs"] @ (rotations[1:] - np.eye(3)).ravel()
    parents = [-1, *model["kintree_table"][0, 1:].astype(int)]
    frames: list[np.ndarray] = []
    for k, parent in enumerate(parents):
        local = np.eye(4)
        local[:3, :3] = rotations[k]
        local[:3, 3] = joints[k] - (joints[parent] if k else 0)
        frames.append(frames[parent] @ local if k else local)
    out = []
    for row, vertex in enumerate(posed):
        total = np.zeros(3)
        for k, matrix in enumerate(frames):
            back = np.eye(4)
            back[:3, 3] = -joints[k]
            total += model["weights"][row, k] * (matrix @ back @ [*vertex, 1.0])[:3]
        out.append(total)
    return np.array(out)


def test_rest_pose_is_the_template_and_parts_turn_rigidly():
    body = SkinnedBody("arm", arm())
    assert torch.allclose(body(SCENE)["arm"].mesh.vertices, arm().vertices, atol=1e-15)
    # The elbow by 90° about z: the lower arm points along y, the hand goes along.
    body = SkinnedBody("arm", arm(), [[0, 0, 0], [0, 0, math.pi / 2], [0, 0, 0]])
    assert torch.allclose(body.joints(), float64([[0, 0, 0], [1, 0, 0], [1, 1, 0]]), atol=1e-12)
    found = body(SCENE)["arm"]
    count = len(box(1.0).vertices)
    assert torch.allclose(found.mesh.vertices[:count], arm().vertices[:count], atol=1e-12)
    hand = found.mesh.vertices[2 * count :]
    assert torch.allclose(hand.amin(0), float64([0.95, 1.0, -0.05]), atol=1e-12)
    assert torch.allclose(hand.amax(0), float64([1.05, 1.4, 0.05]), atol=1e-12)
    assert found.pose is SCENE["arm"].pose


def test_rotations_of_joints_in_a_row_add_up():
    turns = float64([[0.1, 0.2, -0.3], [0.4, 0.0, 0.5], [0.0, -0.6, 0.2]])
    body = SkinnedBody("arm", arm(), turns)
    tip = float64([2.4, 0.05, 0.05])
    row = int((arm().vertices - tip).norm(dim=1).argmin())
    first, second, third = (rotation_from_vector(v) for v in turns)
    ahead = float64([1.0, 0, 0])
    truth = first @ (ahead + second @ (ahead + third @ (tip - 2 * ahead)))
    assert torch.allclose(body(SCENE)["arm"].mesh.vertices[row], truth, atol=1e-12)


def test_smpl_layout_against_its_own_recipe(tmp_path):
    model = smpl()
    np.savez(tmp_path / "body.npz", **model)
    template = load_smpl(tmp_path / "body.npz", shapes=10)
    assert template.shape_count == 10
    assert template.parents == (-1, 0, 1, 0)
    draw = np.random.default_rng(1)
    turns, betas = 0.7 * draw.normal(size=(4, 3)), draw.normal(size=10)
    body = SkinnedBody("arm", template, turns @ TURN.T, betas)
    rotations = np.stack([rotation_from_vector(float64(v)).numpy() for v in turns])
    found = body(SCENE)["arm"].mesh.vertices.detach().numpy()
    np.testing.assert_allclose(found, reference(model, rotations, betas) @ TURN.T, atol=1e-12)
    assert set(body.values()) == {"arm.joint_rotation", "arm.shape"}


@pytest.mark.parametrize("at", [0.0, 0.4], ids=["rest", "posed"])
def test_gradients_both_ways(tmp_path, at):
    np.savez(tmp_path / "body.npz", **smpl(count=6))
    body = SkinnedBody("arm", load_smpl(tmp_path / "body.npz", shapes=2))
    draw = torch.Generator().manual_seed(2)
    turns = at * torch.randn(4, 3, generator=draw, dtype=torch.float64)
    betas = torch.randn(2, generator=draw, dtype=torch.float64)

    def vertices(rotation: Tensor, shape: Tensor) -> Tensor:
        values = {"rotation": rotation, "shape": shape}
        return torch.func.functional_call(body, values, (SCENE,))["arm"].vertices

    inputs = (turns.requires_grad_(), betas.requires_grad_())
    assert gradcheck(vertices, inputs, check_forward_ad=True)


def test_only_the_free_joints_have_a_derivative():
    body = SkinnedBody("arm", arm(), 0.1 * torch.ones(3, 3), joints=[1])
    body(SCENE)["arm"].vertices.square().sum().backward()
    assert body.rotation.grad is not None
    assert torch.equal(body.rotation.grad.abs().sum(1) > 0, torch.tensor([False, True, False]))
    assert not body.shape.requires_grad


def bent(**changes: Any) -> BodyTemplate:
    given = arm()
    fields = {name: getattr(given, name) for name in given.__dataclass_fields__} | changes
    return BodyTemplate(**fields)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: bent(parents=(-1, 2, 0)), "an earlier joint for each other"),
        (lambda: bent(parents=(0, 0, 1)), "parents −1 for the first joint"),
        (lambda: bent(weights=0.5 * arm().weights), "that add up to 1 at each vertex"),
        (lambda: bent(weights=arm().weights[1:]), "expected skinning weights as numbers of shape"),
        (lambda: bent(joints=arm().joints[1:]), r"expected joints \[m\]"),
        (lambda: bent(shape_directions=torch.zeros(24, 3, 2).double()), "give both"),
        (lambda: SkinnedBody("arm", arm(), torch.zeros(2, 3)), "give one per joint"),
        (lambda: SkinnedBody("arm", arm(), shape=[1.0]), "give the template's"),
        (lambda: SkinnedBody("arm", arm(), joints=[3]), r"expected joints in \[0, 2\], got 3"),
        (lambda: articulated_template([bar(0, 1)], (-1, 0), [[0, 0, 0]]), "got 1; give one each"),
    ],
)
def test_bad_input(unchecked, make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_bad_files(tmp_path):
    with pytest.raises(InputError, match="got no file"):
        load_smpl(tmp_path / "nothing.npz")
    model = smpl()
    np.savez(tmp_path / "less.npz", **{k: v for k, v in model.items() if k != "weights"})
    with pytest.raises(InputError, match="got no weights"):
        load_smpl(tmp_path / "less.npz")
    pickled: dict[str, Any] = {"J_regressor": np.array([{"sparse": 1}], dtype=object)}
    np.savez(tmp_path / "pickled.npz", **(model | pickled))
    with pytest.raises(InputError, match="save sparse matrices and pickled objects as arrays"):
        load_smpl(tmp_path / "pickled.npz")
    np.savez(tmp_path / "more.npz", **(model | {"names": pickled["J_regressor"]}))
    assert len(load_smpl(tmp_path / "more.npz").parents) == 4
    np.save(tmp_path / "array.npy", np.zeros(3))
    with pytest.raises(InputError, match=r"expected plain arrays.*array\.npy"):
        load_smpl(tmp_path / "array.npy")
    (tmp_path / "text.npz").write_text("no archive")
    with pytest.raises(InputError, match=r"expected plain arrays.*text\.npz"):
        load_smpl(tmp_path / "text.npz")
    model["kintree_table"] = np.zeros(4)
    np.savez(tmp_path / "flat.npz", **model)
    with pytest.raises(InputError, match="expected kintree_table of shape"):
        load_smpl(tmp_path / "flat.npz")
