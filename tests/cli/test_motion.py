"""Run files whose objects turn, follow paths and walk."""

import json
import tomllib
from pathlib import Path

import pytest
import torch

from cli.small import call, read_metrics
from invertwin.cli.commands.dataset import make_sample
from invertwin.cli.run_file import validate_run
from invertwin.cli.schema import build
from invertwin.cli.schema.motion_tables import (
    build_moving_scene,
    joint_positions_at_start,
    scene_at_start,
)
from invertwin.errors import InputError
from invertwin.scene import MovingScene, Scene, Waving

RUN = """
task = "simulate"
frame = 2
seed = 1

[scene.person]
shape = "body"
spacing = 0.05
position = [3.0, 0.0, 0.95]
material = { kind = "rough_dielectric", permittivity = 4.0 }
motion = [{ kind = "walking", speed = 1.4 }]

[scene.fan]
shape = "plate"
width = 0.4
height = 0.1
position = [0.0, 0.0, 1.5]
material = { kind = "rough_dielectric", permittivity = 4.0 }

[[scene.fan.motion]]
kind = "turning"
axis = [1.0, 0.0, 0.0]
rate = 20.0

[[scene.fan.motion]]
kind = "along"
times = [0.0, 1.0]
places = [[2.0, 0.5, 0.0], [3.0, 0.5, 0.0]]

[scene.wall]
shape = "plate"
width = 2.0
height = 2.0
position = [5.0, 0.0, 1.0]
material = { kind = "rough_dielectric", permittivity = 4.0 }

[radar]
waveform = { kind = "fmcw", start_frequency = 77e9, bandwidth = 1e9, duration = 5e-5, samples = 64 }
transmitters = { kind = "positions", positions = [[0.0, 0.0, 0.0]] }
receivers = { kind = "linear", count = 2, spacing = 1.935e-3 }
positions = [[0.0, 0.0, 1.0]]

[grid]
range_min = 0.5
range_max = 4.5
u_max = 0.5

[chirps]
count = 16
interval = 4e-4
visibility_every = 16

[data]
kind = "simulated"
points_per_m2 = 300.0
snr_db = 30.0
"""
DURATION = 15 * 4e-4


def read(text: str = RUN, **scene: dict):
    raw = tomllib.loads(text)
    for name, changes in scene.items():
        raw["scene"][name] |= changes
    return validate_run(raw, Path("run.toml"))


def test_objects_do_what_their_tables_say():
    run = read()
    scene = build.true_scene(run)
    motion = build_moving_scene(run, scene)
    assert isinstance(motion, MovingScene)
    ahead = motion(1.0)["person"].center - motion(0.0)["person"].center
    assert float(ahead[0]) == pytest.approx(-1.4, abs=0.1)
    fan = motion(0.05)["fan"]
    corner = scene["fan"].mesh.vertices[0]
    turn = torch.tensor(20.0 * 0.05)
    turned = torch.stack(
        [
            corner[0],
            turn.cos() * corner[1] - turn.sin() * corner[2],
            turn.sin() * corner[1] + turn.cos() * corner[2],
        ]
    )
    place = turned + torch.tensor([2.05, 0.5, 1.5])
    assert torch.allclose(fan.vertices[0], place.double(), atol=1e-6)
    assert torch.equal(motion(0.05)["wall"].vertices, scene["wall"].vertices)


def test_simulate_shows_who_comes_nearer(tmp_path, monkeypatch):
    file = tmp_path / "walk.toml"
    file.write_text(RUN)
    assert call(monkeypatch, "simulate", file, "-o", tmp_path / "out") == 0
    metrics = read_metrics(tmp_path / "out")
    assert metrics["mover_range_m"] == pytest.approx(3.0, abs=0.3)
    assert -2.5 < metrics["mover_velocity_m_s"] < -0.5


def test_a_single_motion_needs_no_list():
    single = {"kind": "walking", "speed": 1.2}
    one, listed = (read(person={"motion": given}) for given in (single, [single]))
    assert one.scene["person"].motion == listed.scene["person"].motion


def test_walking_needs_no_speed():
    usual, said = (
        read(person={"motion": [{"kind": "walking"} | more]}) for more in ({}, {"speed": 1.4})
    )
    assert usual.scene["person"].motion == said.scene["person"].motion


def test_a_person_can_wave_while_walking():
    both = [{"kind": "walking", "speed": 1.2}, {"kind": "waving", "side": "left"}]
    run = read(person={"motion": both})
    motion = build_moving_scene(run, build.true_scene(run))
    assert isinstance(motion, MovingScene)
    found = motion.motions["person"]
    assert isinstance(found, list)
    (mover,) = found
    assert isinstance(mover, Waving)
    assert mover.during is not None
    way = motion(1.0)["person"].center - motion(0.0)["person"].center
    assert float(way[0]) == pytest.approx(-1.2, abs=0.1)


def test_labels_are_those_of_the_start_with_the_mean_velocity():
    run = read()
    begun = scene_at_start(run, build.true_scene(run), DURATION)
    velocity = begun["fan"].velocity
    assert velocity is not None
    assert torch.allclose(
        velocity.reshape(-1, 3).mean(0), torch.tensor([1.0, 0.0, 0.0]).double(), atol=1e-6
    )
    joints = joint_positions_at_start(run, begun)["person"]
    assert set(joints) > {"left_knee", "right_elbow"}
    # The right foot lands: that leg is ahead.
    assert float(joints["right_knee"][0]) < float(joints["left_knee"][0]) - 0.2
    middle = begun["person"].vertices.mean(0)
    assert float((joints["pelvis"] - middle).norm()) < 0.2


def test_a_data_set_has_these_labels():
    text = RUN.replace('task = "simulate"', 'task = "dataset"') + (
        '[dataset]\nsamples = 1\nshard = 1\nsignals = ["raw"]\n'
    )
    files = make_sample(read(text), 0)
    labels = {row["name"]: row for row in json.loads(files["labels.json"])["objects"]}
    assert labels["fan"]["velocity"] == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)
    assert labels["person"]["velocity"][0] < -0.5
    assert labels["wall"]["velocity"] == [0.0, 0.0, 0.0]
    assert "left_knee" in labels["person"]["joints"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fan": {"motion": [{"kind": "walking", "speed": 1.0}]}}, r"fan.*shape = \"body\""),
        (
            {"person": {"motion": [{"kind": "walking", "speed": 1.0}, {"kind": "sitting"}]}},
            r"person.*motion\[1\].*one motion of a person",
        ),
        ({"person": {"motion": [{"kind": "walking", "speed": 9.0}]}}, r"motion\[0\].*speed"),
        ({"fan": {"velocity": [1.0, 0.0, 0.0]}}, r"scene\.fan.*no velocity"),
    ],
)
def test_what_cannot_move_so_is_refused(changes, message):
    run = read(**changes)
    with pytest.raises(InputError, match=message):
        build_moving_scene(run, build.true_scene(run))


def test_motion_needs_chirps(tmp_path, monkeypatch, capsys):
    text = RUN[: RUN.index("[chirps]")] + RUN[RUN.index("[data]") :]
    file = tmp_path / "walk.toml"
    file.write_text(text)
    assert call(monkeypatch, "simulate", file, "-o", tmp_path / "out") == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "scene.person.motion: expected a section [chirps]" in said


def test_without_motion_the_scene_is_left_alone():
    run = read(person={"motion": []}, fan={"motion": []})
    scene = build.true_scene(run)
    assert build_moving_scene(run, scene) is scene
    assert isinstance(scene, Scene)


def test_breathing_adds_to_another_posture() -> None:
    """After sitting, and before waving, the chest of a run file's person breathes."""
    seated = RUN.replace(
        '{ kind = "walking", speed = 1.4 }',
        '{ kind = "sitting", duration = 1.0 }, { kind = "breathing", rate = 0.25, depth = 0.01 }',
    )
    run = validate_run(tomllib.loads(seated), Path("run.toml"))
    motion = build_moving_scene(run, build.true_scene(run))
    assert isinstance(motion, MovingScene)
    movers, person = motion.motions["person"], motion.scene["person"]
    assert not callable(movers)
    sitting, breathing = movers
    still = sitting(person, 2.0)
    shift = breathing(still, 2.0).vertices - still.vertices
    assert float(shift.norm(dim=1).max()) > 0.0099
