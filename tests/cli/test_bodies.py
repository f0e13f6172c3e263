"""Bodies in run files: their angles, their starts, their scores; gradient checks of shapes."""

from pathlib import Path
from typing import Any

import pytest
import torch

from invertwin.cli.fits.problem import Problem, initial_scenes
from invertwin.cli.fits.radar_maps import RadarMaps
from invertwin.cli.fits.scores import score_joints
from invertwin.cli.run_file import validate_run
from invertwin.cli.schema import RunFile, build
from invertwin.errors import InputError
from invertwin.inversion.gradcheck.lines import make_line
from invertwin.scene import Scene

STUFF = {"kind": "rough_dielectric", "permittivity": 4.0}
LEFT = {"left_elbow": ["z"], "left_hip": ["x", "y", "z"]}


def run_file(joints: Any = LEFT, scale: float = 1.0, **tables: Any) -> RunFile:
    person = {
        "shape": "body",
        "material": STUFF,
        "position": [2.0, 0.0, 0.0],
        "scale": scale,
        "angles_deg": {"left_elbow": [0.0, 0.0, -50.0], "left_knee": [0.0, -30.0, 0.0]},
    }
    run = {
        "task": "reconstruct",
        "frame": 2,
        "scene": {"person": person, "box": {"shape": "box", "size": [1.0] * 3, "material": STUFF}},
        "parameters": [{"kind": "body", "object": "person", "joints": joints}],
        "starts": {"object": "person", "count": 2, "distance": [0.0, 0.0], "joint_deg": 20.0},
        **tables,
    }
    return validate_run(run, Path("run.toml"))


def test_every_free_joint_starts_that_far_off_and_only_these():
    run = run_file(scale=1.2)
    assert run.starts is not None
    scene = build.scene(run)
    body = build.fitted_body(run, scene, "person")
    assert body is not None
    problem = Problem(run, scene, scene, frozenset(), {}, None, RadarMaps())
    starts, again = initial_scenes(problem), initial_scenes(problem)
    truth = scene["person"].mesh
    true = body.template.estimate_rotations(truth.vertices)
    for start, same in zip(starts, again, strict=True):
        mesh = start["person"].mesh
        assert torch.equal(mesh.vertices, same["person"].mesh.vertices)
        angles = score_joints(body, mesh, truth, truth)
        assert angles["joint_error_before_deg"] == pytest.approx(20.0, abs=1e-4)
        assert angles["joint_error_after_deg"] == pytest.approx(0.0, abs=1e-4)
        found = body.template.estimate_rotations(mesh.vertices)
        hinge = body.template.joint("left_elbow")
        assert torch.allclose(found[hinge, [0, 1]], torch.zeros(2).double(), atol=1e-6)
        moved = (found - true).abs().amax(1) > 1e-6
        assert {body.template.names[int(k)] for k in moved.nonzero()[:, 0]} == set(LEFT)
        (module,) = build.parameters(run.parameters, start, run.scene)
        assert torch.allclose(module(start)["person"].mesh.vertices, mesh.vertices, atol=1e-9)
    first, second = (start["person"].mesh.vertices for start in starts)
    assert not torch.allclose(first, second, atol=1e-3)


def test_a_truth_may_have_other_angles():
    run = run_file(truth={"person": {"angles_deg": {"neck": [0.0, 10.0, 0.0]}}})
    scene, truth = build.scene(run), build.true_scene(run)
    body, mesh = build.fitted_body(run, scene, "person"), scene["person"].mesh
    assert body is not None
    angles = score_joints(body, mesh, mesh, truth["person"].mesh)
    assert angles["joint_error_left_elbow_deg"] == pytest.approx(50.0, abs=1e-4)
    assert angles["joint_error_left_hip_deg"] == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joints": {"tail": ["x"]}}, r"parameters\[0\].*expected a joint among pelvis"),
        (
            {"parameters": [{"kind": "body", "object": "box", "joints": LEFT}], "starts": None},
            'shape = "body"',
        ),
    ],
)
def test_bad_bodies(changes, message):
    run = run_file(**changes)
    with pytest.raises(InputError, match=message):
        build.parameters(run.parameters, build.scene(run), run.scene)


def checked(
    parameter: dict[str, Any], tangent: dict[str, Any], name: str = "person"
) -> tuple[Scene, Scene]:
    """The scene at θ = 0 and at 0.01."""
    given = {"object": name, **parameter}
    key = "step_deg" if given["kind"] == "body" else "step"
    run = run_file(gradcheck={"parameter": given, "tangent": tangent, key: 0.1})
    scene = build.scene(run)
    line = make_line(*build.tangent(run, scene), scene)
    return line.evaluate(torch.zeros((), dtype=torch.float64)), line.evaluate_end(0.01)


BUMP = {"center": [0.5, 0.0, 0.0], "width": 0.1}
BOX = {"low": [-0.8] * 3, "high": [0.8] * 3, "counts": [17] * 3}
ELBOW = {"kind": "body", "joints": {"left_elbow": ["z"]}}


def test_theta_turns_a_joint():
    start, moved = checked(ELBOW, {"left_elbow": [0.0, 0.0, 1.0]})
    run = run_file()
    found = build.fitted_body(run, build.scene(run), "person")
    assert found is not None
    body = found.template
    before, after = (body.estimate_rotations(s["person"].mesh.vertices) for s in (start, moved))
    assert float((after - before)[body.joint("left_elbow"), 2]) == pytest.approx(0.01, abs=1e-9)
    assert float((after - before).abs().sum()) == pytest.approx(0.01, abs=1e-7)


def test_theta_moves_a_surface_outwards_in_a_bump():
    falls = {"value": {**BUMP, "height": -1.0}}
    start, moved = checked({"kind": "distance_grid", **BOX}, falls, "box")
    way = (moved["box"].mesh.vertices - start["box"].mesh.vertices)[:, 0]
    assert float(way.max()) == pytest.approx(0.01, rel=0.15)
    far = start["box"].mesh.vertices[:, 0] < 0
    assert float(way[far].abs().max()) < 1e-4


def test_theta_thickens_a_cloud():
    cloud = {"kind": "density", "extinction": 5.0, **BOX}
    start, moved = checked(cloud, {"log_density": BUMP}, "box")
    clouds = start["box"].cloud, moved["box"].cloud
    assert clouds[0] is not None
    assert clouds[1] is not None
    assert float(clouds[0].density.max()) == pytest.approx(5.0, rel=1e-3)
    ratio = clouds[1].density / clouds[0].density
    assert float(ratio.max()) == pytest.approx(1.01, abs=1e-4)
    assert float(ratio.min()) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize(
    ("parameter", "tangent", "message"),
    [
        ({"kind": "body"}, {"left_elbow": 1.0}, "parameter.joints: expected a value, got"),
        (
            {"kind": "distance_grid", **BOX},
            {"value": {"center": [0.0] * 3}},
            "tangent.value.width: expected a value, got",
        ),
        (
            {"kind": "prior"},
            {"latent": [1.0] * 25},
            r"gradcheck.tangent: .* \(latent \(24,\)\), got latent \(25,\)",
        ),
        (
            {"kind": "pose"},
            {"translation": BUMP},
            "gradcheck.tangent: expected numbers, got a bump",
        ),
        (ELBOW, {"neck": 1.0}, r"gradcheck.tangent: .*left_elbow \(3,\)\), got neck"),
        (ELBOW, {"left_elbow": [[1.0], [1.0, 0.0]]}, "gradcheck.tangent: .* rows of one length"),
        (
            {"kind": "body", "joints": {"wing": ["x"]}},
            {"wing": 1.0},
            "gradcheck.parameter: .* got 'wing'; choose one",
        ),
    ],
)
def test_bad_tangents(parameter, tangent, message):
    with pytest.raises(InputError, match=message):
        checked(parameter, tangent)


def test_joints_that_are_not_fitted_are_not_turned():
    pose = [{"kind": "pose", "object": "person"}]
    with pytest.raises(InputError, match=r'starts.joint_deg: expected .* kind = "body" of person'):
        run_file(parameters=pose)
