"""Objects and scenes: placement, motion, frozenness."""

import copy
import dataclasses
import math
import pickle

import pytest
import torch

from invertwin.errors import InputError, PhysicsWarning
from invertwin.scene import (
    Mesh,
    Object,
    PerfectConductor,
    RoughDielectric,
    Scene,
    plate,
    rigid,
    rotation_from_vector,
)

METAL = PerfectConductor()
PLATE = plate(1.0, 2.0)


def vector(*numbers: float) -> torch.Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


def placed() -> torch.Tensor:
    return rigid(rotation_from_vector(vector(0.0, 0.0, math.pi / 2)), vector(3.0, 0.0, 0.0))


def test_object_without_pose_stays_where_its_mesh_is():
    assert torch.equal(Object(PLATE, METAL).vertices, PLATE.vertices)
    assert torch.equal(Object(PLATE, METAL).transform, torch.eye(4, dtype=torch.float64))


def test_pose_places_the_vertices():
    item = Object(PLATE, METAL, pose=placed())
    # A quarter turn about z sends y to −x.
    assert item.vertices[:, 0].amin() == pytest.approx(2.5)
    assert item.vertices[:, 1].abs().max() < 1e-15
    assert item.center.tolist() == pytest.approx([3.0, 0.0, 0.0])


def test_vertices_are_differentiable_in_mesh_and_pose():
    def vertices(corners, turn, shift):
        mesh = Mesh(corners, PLATE.faces)
        return Object(mesh, METAL, pose=rigid(rotation_from_vector(turn), shift)).vertices

    inputs = (
        PLATE.vertices.clone().requires_grad_(),
        vector(0.1, 0.2, 0.3).requires_grad_(),
        vector(1.0, 2.0, 3.0).requires_grad_(),
    )
    assert torch.autograd.gradcheck(vertices, inputs)


def test_rigid_motion_is_in_world_axes():
    item = Object(PLATE, METAL, pose=placed(), velocity=vector(-10.0, 0.0, 0.0))
    moved = item.advance(0.1)
    assert torch.allclose(moved.vertices, item.vertices + vector(-1.0, 0.0, 0.0))
    assert torch.equal(moved.mesh.vertices, PLATE.vertices)
    assert torch.equal(item.advance(0.0).vertices, item.vertices)


def test_vertex_motion_is_in_world_axes():
    velocity = torch.arange(12, dtype=torch.float64).reshape(4, 3)
    item = Object(PLATE, METAL, pose=placed(), velocity=velocity)
    assert torch.allclose(item.advance(0.5).vertices, item.vertices + 0.5 * velocity)
    assert item.advance(0.5).velocity is None


def test_motion_is_differentiable():
    velocity = vector(1.0, 0.0, 0.0).requires_grad_()
    Object(PLATE, METAL, velocity=velocity).advance(2.0).vertices.sum().backward()
    assert velocity.grad is not None
    assert velocity.grad.tolist() == [8.0, 8.0, 8.0]


def test_resting_object_stays_itself():
    item = Object(PLATE, METAL)
    assert item.advance(7.0) is item


def scene() -> Scene:
    return Scene(
        {
            "wall": Object(PLATE, RoughDielectric(4.0)),
            "door": Object(PLATE, METAL, velocity=vector(1.0, 0.0, 0.0)),
        }
    )


def test_scene_keeps_names_in_order():
    assert scene().names == ("wall", "door")
    assert scene()["door"].material is METAL


def test_scene_moves_what_moves():
    before, after = scene(), scene().advance(1.5)
    assert torch.equal(after["wall"].vertices, before["wall"].vertices)
    assert torch.allclose(after["door"].vertices, before["door"].vertices + vector(1.5, 0.0, 0.0))


def test_replace_leaves_the_original_alone():
    before = scene()
    after = before.replace("wall", material=METAL, pose=placed())
    assert isinstance(before["wall"].material, RoughDielectric)
    assert before["wall"].pose is None
    assert after["wall"].material is METAL
    assert after.names == before.names
    assert after["door"] is before["door"]


def test_values_are_frozen():
    value = scene()
    with pytest.raises(TypeError):
        value.objects["new"] = value["wall"]  # pyright: ignore[reportIndexIssue]
    for target, name in ((value, "objects"), (value["wall"], "pose"), (PLATE, "faces")):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(target, name, None)


def test_scene_does_not_follow_the_dict_it_came_from():
    objects = {"wall": Object(PLATE, METAL)}
    value = Scene(objects)
    objects["door"] = objects["wall"]
    assert value.names == ("wall",)


def test_scene_can_be_copied_and_pickled():
    for copied in (copy.deepcopy(scene()), pickle.loads(pickle.dumps(scene()))):
        assert copied.names == scene().names
        assert torch.equal(copied["wall"].vertices, PLATE.vertices)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Object("plate.obj", METAL), "expected a Mesh, got str"),  # pyright: ignore[reportArgumentType]
        (lambda: Object(PLATE, "metal"), "expected a Material, got str"),  # pyright: ignore[reportArgumentType]
        (lambda: Object(PLATE, METAL, pose=torch.eye(3)), r"pose as numbers of shape \[4, 4\]"),
        (lambda: Object(PLATE, METAL, pose=2 * torch.eye(4)), "expected a rigid pose"),
        (lambda: Object(PLATE, METAL, pose=torch.diag(vector(-1, 1, 1, 1))), "a rigid pose"),
        (lambda: Object(PLATE, METAL, pose=torch.eye(4) * math.nan), "finite pose"),
        (lambda: Object(PLATE, METAL, pose=placed().T), "expected a rigid pose"),
        (lambda: Object(PLATE, METAL, velocity=vector(1, 2)), r"velocity \[m/s\] as numbers"),
        (lambda: Object(PLATE, METAL, velocity=torch.zeros(3, 3)), r"shape \[4, 3\], got shape"),
        (lambda: Object(PLATE, METAL, velocity="fast"), "velocity"),  # pyright: ignore[reportArgumentType]
        (lambda: Object(PLATE, METAL).advance(math.nan), "time"),
        (lambda: Scene({}), "at least one named object, got none"),
        (lambda: Scene([Object(PLATE, METAL)]), "at least one named object, got list"),  # pyright: ignore[reportArgumentType]
        (lambda: Scene({"": Object(PLATE, METAL)}), "names that are not empty.*, got ''"),
        (lambda: Scene({3: Object(PLATE, METAL)}), "names that are not empty.*, got 3"),  # pyright: ignore[reportArgumentType]
        (lambda: Scene({"wall": PLATE}), "an Object for 'wall', got Mesh"),  # pyright: ignore[reportArgumentType]
        (lambda: scene()["floor"], "wall, door, got 'floor'"),
        (lambda: scene().replace("floor", pose=None), "wall, door, got 'floor'"),
        (lambda: scene().replace("wall", color=1), "changes of mesh, material, .* got 'color'"),
    ],
)
def test_bad_scenes_are_refused_in_one_line(make, message):
    with pytest.raises(InputError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_many_objects_are_placed_as_each_by_itself():
    from invertwin.scene.scene import transform_vertices

    turn = rotation_from_vector(vector(0.1, 0.2, 0.3)).requires_grad_()
    poses = [rigid(turn, vector(k, 1.0, 2.0)) for k in range(3)]
    bent = Mesh(PLATE.vertices + 0.1, PLATE.faces)
    objects = [
        Object(PLATE, METAL, poses[0]),
        Object(PLATE, METAL),
        Object(plate(1.0, 1.0, divisions=3), METAL, poses[1]),
        Object(bent, METAL, poses[2]),
    ]
    found = transform_vertices(objects)
    slopes = []
    for vertices in (found, [item.vertices for item in objects]):
        total = sum((k + 1) * v.square().sum() for k, v in enumerate(vertices))
        assert isinstance(total, torch.Tensor)
        slopes.append(torch.autograd.grad(total, turn, retain_graph=True)[0])
    torch.testing.assert_close(found, [item.vertices for item in objects])
    torch.testing.assert_close(*slopes)


def test_scenes_of_mirrors_get_a_warning():
    from invertwin.scene import Dielectric, RoughConductor, Slab
    from invertwin.scene.scene import warn_if_purely_specular

    wall = plate(1.0, 1.0)
    for material in (
        RoughConductor(scattering=0.0),
        RoughDielectric(4.0, diffuse=0.0, lobe_width=0.1),
    ):
        with pytest.warns(PhysicsWarning, match="no surface scatters"):
            warn_if_purely_specular(Scene({"wall": Object(wall, material)}), 77e9)
    for material in (RoughConductor(), Dielectric(4.0), RoughDielectric(4.0), PerfectConductor()):
        warn_if_purely_specular(Scene({"wall": Object(wall, material)}), 77e9)
    pair = {
        "glass": Object(wall, Slab(6.0, thickness=0.01)),
        "wall": Object(wall, RoughConductor()),
    }
    warn_if_purely_specular(Scene(pair), 77e9)
