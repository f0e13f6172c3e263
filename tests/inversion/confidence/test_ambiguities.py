"""Rivals: which turns are tried of which object, and where the turned fit begins."""

import math

import pytest
import torch

from blobs import LAW, Blob, Needle
from invertwin.inversion import Observation, Optimizer, Schedule, displace, reconstruct
from invertwin.inversion.confidence.ambiguities import (
    Ambiguity,
    are_same_poses,
    candidate_rotations,
    find_ambiguities,
)
from invertwin.scene import Mesh, Pose, Scene, Translation, box, sphere, text
from scenes import float64, thing


def angles(mesh: Mesh, module: torch.nn.Module) -> list[float]:
    """Turns about the vertical that are tried [°]."""
    found = candidate_rotations(module, Scene({"it": thing(mesh, (2.0, 0.1, 0.0))}))
    return [round(math.degrees(float(turn[2])), 6) for turn in found]


YAW = {"axes": "xy", "rotation_axes": "z"}


@pytest.mark.parametrize(
    ("mesh", "tried"),
    [
        (text("L", size=0.6), [180.0]),
        (text("A", size=0.6), []),  # from behind an A is an A
        (box([0.4, 0.5, 0.3]), [90.0]),  # nearly square; half a turn brings it back
        (box([0.2, 0.6, 0.3]), []),
        (sphere(0.2, 3), []),
    ],
)
def test_turns_that_bring_an_object_back_are_left_out(mesh, tried):
    assert sorted(angles(mesh, Pose("it", **YAW))) == sorted(tried)


def test_what_cannot_turn_has_no_rivals():
    assert angles(text("L", size=0.6), Translation("it")) == []
    held = Pose("it", **YAW)
    held.rotation.requires_grad_(False)
    assert angles(text("L", size=0.6), held) == []


def test_poses_that_look_alike_are_the_same():
    scene = Scene({"it": thing(box([0.2, 0.6, 0.3]), (2.0, 0.1, 0.0))})
    none = torch.zeros(3, dtype=torch.float64)

    def turned(degrees: float) -> Scene:
        return scene.replace(
            "it", pose=displace(scene["it"], none, math.radians(degrees) * float64([0, 0, 1])).pose
        )

    assert are_same_poses(scene, turned(180.0), ["it"])
    assert are_same_poses(scene, turned(4.0), ["it"])
    assert not are_same_poses(scene, turned(90.0), ["it"])
    assert not are_same_poses(scene, turned(30.0), ["it"])
    moved = displace(scene["it"], float64([0.0, 0.05, 0.0])).pose
    assert not are_same_poses(scene, scene.replace("it", pose=moved), ["it"])


def test_a_body_that_is_nearly_its_own_half_turn_is_not_the_same():
    mesh = box([0.35, 0.9, 0.25])
    vertices = mesh.vertices.clone()
    vertices[vertices[:, 1] > 0, 2] *= 0.6  # its back is lower than its front
    body = thing(Mesh(vertices, mesh.faces), (2.0, 0.1, 0.0))
    half = displace(body, torch.zeros(3, dtype=torch.float64), math.pi * float64([0, 0, 1]))
    assert not are_same_poses(Scene({"it": body}), Scene({"it": half}), ["it"])
    assert angles(body.mesh, Pose("it", **YAW)) == [180.0]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("score", "better", "rejected"), [(3.0, False, True), (3.0, True, False)])
def test_a_rival_that_explains_the_data_better_is_never_rejected(score, better, rejected):
    assert Ambiguity(None, score, better, "turned").is_rejected is rejected  # pyright: ignore[reportArgumentType]


def wedge() -> Scene:
    mesh = box([0.2, 0.4, 0.1])
    vertices = mesh.vertices.clone()
    vertices[vertices[:, 1] > 0] *= 0.5
    return Scene({"ball": thing(Mesh(vertices, mesh.faces), (1.0, 0.0, 0.0), (0.0, 0.0, 0.3))})


def test_a_turn_that_explains_the_data_as_well_makes_the_verdict_ambiguous():
    scene, model = wedge(), Needle()
    look = model.realisations(scene, None, 0)
    assert look is not None
    found = reconstruct(
        scene,
        Observation(model, look(0, 0.0), sensor=None),
        Pose("ball", axes="", rotation_axes="z"),
        loss=LAW,
        optimizer=Optimizer("gauss_newton", rate=0.1),
        schedule=Schedule(5),
    )
    before = found.scene["ball"].transform
    assert found.verdict.word == "ambiguous"
    (rival,) = found.verdict.ambiguities
    assert rival.description.startswith(("ball turned by 180.0° about z", "ball turned by 179."))
    assert rival.score is not None
    assert rival.score < 2.33
    assert found.verdict.reasons == (
        f"{rival.description} fits the data equally well: z = {rival.score:.1f}",
    )
    # The fit itself is left as it was.
    assert torch.equal(found.result.fit.twin()["ball"].transform, before)


def test_a_position_alone_has_no_rivals():
    scene, model = wedge(), Blob()
    look = model.realisations(scene, None, 0)
    assert look is not None
    found = reconstruct(
        scene,
        Observation(model, look(0, 0.0), sensor=None),
        Translation("ball", axes="y"),
        loss=LAW,
        optimizer=Optimizer("gauss_newton", rate=0.1),
        schedule=Schedule(5),
    )
    assert list(find_ambiguities(found.result)) == []
