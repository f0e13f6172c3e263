"""A person made of formulas: one closed skin, joints where they belong, parts that follow them."""

import math

import pytest
import torch

from invertwin.errors import InputError
from invertwin.scene import BodyTemplate, Scene, SkinnedBody, box, person, rotation_from_vector
from scenes import float64, thing

TEMPLATE = person()
SCENE = Scene({"person": thing(box(0.1), (2, 0, 0))})


def volume(vertices: torch.Tensor) -> float:
    a, b, c = (vertices[TEMPLATE.faces[:, k]] for k in range(3))
    return float((a * torch.linalg.cross(b, c)).sum() / 6)


def test_a_person_has_one_closed_skin_and_human_measures():
    edges = torch.cat([TEMPLATE.faces[:, [k, (k + 1) % 3]] for k in range(3)])
    there, back = ({(int(a), int(b)) for a, b in part} for part in (edges, edges.flip(1)))
    assert there == back  # every edge has a triangle on either side
    tall = TEMPLATE.vertices[:, 2].amax() - TEMPLATE.vertices[:, 2].amin()
    assert float(tall) == pytest.approx(1.75, abs=0.05)
    assert 0.05 < volume(TEMPLATE.vertices) < 0.1  # m³, that is 50 to 100 kg
    assert len(TEMPLATE.vertices) < 4000
    half = person(height=0.9, spacing=0.03)
    assert float(half.vertices[:, 2].amax() / TEMPLATE.vertices[:, 2].amax()) == pytest.approx(
        0.9 / 1.75, abs=0.01
    )


def test_left_is_the_mirror_image_of_right():
    flip = float64([1.0, -1.0, 1.0])
    for name in ("shoulder", "elbow", "hip", "knee"):
        left, right = (
            TEMPLATE.joints[TEMPLATE.joint(f"{side}_{name}")] for side in ("left", "right")
        )
        assert torch.equal(left, flip * right)
        assert float(left[1]) < 0
    gaps = torch.cdist(TEMPLATE.vertices * flip, TEMPLATE.vertices).amin(1)
    assert float(gaps.max()) < 0.02


def test_an_elbow_carries_the_hand_and_nothing_else():
    turns = TEMPLATE.rotations({"left_elbow": [0.0, 0.0, -math.pi / 2]})
    body = SkinnedBody("person", TEMPLATE, turns)
    moved = body(SCENE)["person"].mesh.vertices.detach()
    hand = int(TEMPLATE.vertices[:, 1].argmin())
    elbow = TEMPLATE.joints[TEMPLATE.joint("left_elbow")]
    turn = rotation_from_vector(turns[TEMPLATE.joint("left_elbow")])
    assert torch.allclose(moved[hand], elbow + turn @ (TEMPLATE.vertices[hand] - elbow), atol=1e-6)
    assert float(moved[hand, 0]) < -0.3  # ahead of the person
    rest = TEMPLATE.vertices[:, 1] > -0.35
    assert torch.allclose(moved[rest], TEMPLATE.vertices[rest], atol=2e-3)
    assert volume(moved) == pytest.approx(volume(TEMPLATE.vertices), rel=0.02)


def test_only_the_free_axes_have_a_derivative():
    body = SkinnedBody("person", TEMPLATE, joints={"left_elbow": "z", "left_hip": "xy"})
    body(SCENE)["person"].vertices.square().sum().backward()
    assert body.rotation.grad is not None
    free = {(TEMPLATE.names[int(j)], "xyz"[int(k)]) for j, k in body.rotation.grad.nonzero()}
    assert free == {("left_elbow", "z"), ("left_hip", "x"), ("left_hip", "y")}
    assert set(body.values()) == {"person.left_elbow", "person.left_hip"}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: person(height=17.5), "expected height"),
        (lambda: person(spacing=0.2), "expected spacing"),
        (lambda: TEMPLATE.joint("elbow"), "expected a joint among pelvis, .* got 'elbow'"),
        (lambda: TEMPLATE.rotations({"neck": [1.0]}), "expected rotation of neck"),
        (lambda: SkinnedBody("person", TEMPLATE, joints=["tail"]), "got 'tail'; choose one"),
        (
            lambda: SkinnedBody("person", TEMPLATE, joints={"left_elbow": "w"}),
            "expected axes among x, y and z, got 'w'",
        ),
        (lambda: SkinnedBody("person", TEMPLATE, joints={"neck": ""}), "expected axes among"),
    ],
)
def test_bad_input(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_names_are_one_for_each_joint():
    mesh = box(0.1)
    one = torch.ones(len(mesh.vertices), 1, dtype=torch.float64)
    with pytest.raises(InputError, match="expected a name of its own for each of 1 joints"):
        BodyTemplate(
            mesh.vertices, mesh.faces, one, (-1,), torch.zeros(1, 3).double(), names=("a", "b")
        )


def test_a_posed_skin_tells_its_joint_angles():
    draw = torch.Generator().manual_seed(3)
    turns = 0.5 * torch.randn(len(TEMPLATE.names), 3, generator=draw, dtype=torch.float64)
    body = TEMPLATE.scale(1.3)
    skin = SkinnedBody("person", body, turns)(SCENE)["person"].mesh.vertices
    assert torch.allclose(body.estimate_rotations(skin), turns, atol=1e-9)
    rest = SkinnedBody("person", body)(SCENE)["person"].mesh.vertices
    assert torch.allclose(body.estimate_rotations(rest), torch.zeros_like(turns), atol=1e-9)
