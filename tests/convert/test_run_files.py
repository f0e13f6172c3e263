"""`invertwin convert`: run files of the first frame, x right, y up, z ahead, in today's."""

import os
import tomllib
from pathlib import Path

import numpy as np
import pytest
import torch

from cli.small import RUN, call
from invertwin.cli.run_file import load_run, validate_run
from invertwin.cli.schema import build
from invertwin.errors import InputError
from invertwin.scene import Mesh, save_mesh
from invertwin_convert.run_files import convert_file

PAINT = 'material = { kind = "rough_dielectric", permittivity = 4.0 }'
OLD = f"""\
# A box before a wall.
task = "gradcheck"   # of its place
title = "Box"

[scene.box]
shape = "box"
size = [0.5, 0.40, 0.3]   # across, up, along
position = [0.1, -0.2, 3.0]
rotation_deg = [5.0, 28.6, 0.0]
{PAINT}

# What keeps its own axes.
[scene.car]
file = "car.ply"
position = [1.0, 2.0, 3.0]
{PAINT}

[scene.wall]
shape = "plate"
width = 3.0
height = 2.0
position = [0, 0, 5.5]
velocity = [0.0, 0.0, 0.1]
{PAINT}

[scene.slits]
parts = [
    {{ shape = "plate", width = 0.4, height = 0.8, position = [-0.4, 0.0, 0.0] }},  # left
    {{ file = "car.ply", rotation_deg = [0.0, 90.0, 0.0] }},
]
{PAINT}

[[scene.slits.motion]]
kind = "turning"
axis = [0.0, 1.0, 0.0]
rate = 2.0

[truth.car]
rotation_deg = [-90.0, 0.0, 0.0]

[radar]
waveform = {{ kind = "impulse", center_frequency = 77e9, bandwidth = 2e9 }}
transmitters = {{ kind = "linear", count = 2, spacing = 1.9e-3, axis = "y" }}
receivers = {{ kind = "linear", count = 4, spacing = 1.9e-3, center = [0.01, 0.02, 0.0] }}
positions = {{ kind = "grid", center = [0.0, 0.5, -1.0], size = [1.8, 1.0], count = [3, 2] }}
orientation = {{ look_at = [0.0, 0.0, 2.6] }}

[grid]
range_min = 1.0
range_max = 3.0

[[parameters]]
kind = "pose"
object = "box"
axes = ["x", "z"]
rotation_axes = ["y"]

[gradcheck]
parameter = {{ kind = "pose", object = "box" }}
tangent = {{ translation = [1.0, 0.0, 0.25], rotation = [0.0, 1.0] }}
step_deg = 0.1
"""
NEW = f"""\
# A box before a wall.
task = "gradcheck"   # of its place
title = "Box"
frame = 2

[scene.box]
shape = "box"
size = [0.3, 0.5, 0.40]   # across, up, along
position = [3.0, 0.1, -0.2]
rotation_deg = [0.0, 5.0, 28.6]
{PAINT}

# What keeps its own axes.
[scene.car]
file = "car.ply"
position = [3.0, 1.0, 2.0]
{PAINT}
rotation_deg = [69.282032302755, 69.282032302755, 69.282032302755]

[scene.wall]
shape = "plate"
width = 3.0
height = 2.0
position = [5.5, 0, 0]
velocity = [0.1, 0.0, 0.0]
{PAINT}

[scene.slits]
parts = [
    {{ shape = "plate", width = 0.4, height = 0.8, position = [0.0, -0.4, 0.0] }},  # left
    {{ file = "car.ply", rotation_deg = [0.0, 127.279220613579, 127.279220613579] }},
]
{PAINT}

[[scene.slits.motion]]
kind = "turning"
axis = [0.0, 0.0, 1.0]
rate = 2.0

[truth.car]
rotation_deg = [0.0, 0.0, 90.0]

[radar]
waveform = {{ kind = "impulse", center_frequency = 77e9, bandwidth = 2e9 }}
transmitters = {{ kind = "linear", count = 2, spacing = 1.9e-3, axis = "z" }}
receivers = {{ kind = "linear", count = 4, spacing = 1.9e-3, center = [0.0, 0.01, 0.02] }}
positions = {{ kind = "grid", center = [-1.0, 0.0, 0.5], size = [1.8, 1.0], count = [3, 2] }}
orientation = {{ look_at = [2.6, 0.0, 0.0] }}

[grid]
range_min = 1.0
range_max = 3.0

[[parameters]]
kind = "pose"
object = "box"
axes = ["x", "y"]
rotation_axes = ["z"]

[gradcheck]
parameter = {{ kind = "pose", object = "box" }}
tangent = {{ translation = [0.25, 1.0, 0.0], rotation = [0.0, 0.0, 1.0] }}
step_deg = 0.1
"""
RADIO = """\
task = "reconstruct"

[scene.floor]
shape = "plate"
width = 2.0
height = 1.0
position = [0.0, 0.0, 3.0]
material = { kind = "perfect_conductor" }

[scene.room]
shape = "box"
size = [5.0, 4.0, 3.0]
rotation_deg = [0.0, 0.0, 30.0]
material = { kind = "perfect_conductor" }

[transmitter]
positions = [[1.0, 0.8, 0.2]]
orientation = { rotation_deg = [0.0, 0.0, 0.0] }

[map]
places = { kind = "plane", low = [-2.0, -1.0], high = [2.0, 1.0], height = 0.5, cell = 1.0 }
frequency = 2.4e9

[[parameters]]
kind = "transmitter"
low = [-2.4, -1.9, -1.4]
high = [2.4, 1.9, 1.4]
axes = ["x", "z"]
"""
DATASET = """\
task = "dataset"

[scene.box]
shape = "box"
size = 0.2
position = [0.0, 0.0, 2.0]
material = { kind = "rough_dielectric", permittivity = 4.0 }

[dataset]
samples = 2

[[vary]]
key = ["scene.box.position[2]", "radar.positions[0][2]"]
kind = "uniform"
low = 1.0
high = 2.0

[[vary]]
key = "scene.box.rotation_deg"
kind = "uniform"
low = [0.0, 0.0, -5.0]
high = [0.0, 90.0, 5.0]

[[vary]]
key = "scene.box.material"
kind = "choice"
values = [{ kind = "perfect_conductor" }, { kind = "rough_conductor" }]
"""
RADAR = """
[radar]
waveform = { kind = "fmcw", start_frequency = 76e9, bandwidth = 2e9, duration = 5e-5, samples = 64 }
transmitters = { kind = "positions", positions = [[0.0, 0.0, 0.0]] }
receivers = { kind = "linear", count = 4, spacing = 1.9e-3 }
positions = [[0.5, 1.0, 0.0]]
"""
ARC = '{ kind = "arc", center = [0, 0, 0], radius = 1, start_deg = 0, stop_deg = 9, count = 2 }'
# Boresight, left and up of a radar along the old axes z, x, y.
AXES_OF_OLD = torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]], dtype=torch.float64)
EMPTY = f'task = "simulate"\n[scene.ball]\nshape = "sphere"\nradius = 0.1\n{PAINT}\n'


def converted(folder: Path, text: str) -> str:
    file = folder / "run.toml"
    file.write_text(text, encoding="utf-8")
    return convert_file(file)[0]


def as_run(folder: Path, text: str):
    return validate_run(tomllib.loads(text), folder / "run.toml")


def box_of(vertices: torch.Tensor) -> list[list[float]]:
    return [vertices.amin(0).tolist(), vertices.amax(0).tolist()]


@pytest.fixture
def car(tmp_path):
    corners = torch.tensor([[1.0, 0, 0], [0, 2, 0], [0, 0, 3]], dtype=torch.float64)
    save_mesh(tmp_path / "car.ply", Mesh(corners, torch.tensor([[0, 1, 2]])))
    return tmp_path


def test_a_run_file_is_turned_with_its_comments_and_lines(car, monkeypatch, capsys):
    file = car / "old.toml"
    file.write_text(OLD)
    assert call(monkeypatch, "convert", file) == 0
    assert file.read_text() == NEW
    assert f"{file}: written" in capsys.readouterr().out.replace("\n", "")
    assert load_run(file).frame == 2


def test_things_are_where_they_were(car):
    """Old places and sizes by hand, turned: (x, y, z) is (z, x, y) today."""
    run = as_run(car, converted(car, OLD))
    scene, truth = build.scene(run), build.true_scene(run)
    # The corners of the file stay its own: old places are (2, 2, 3), (1, 4, 3), (1, 2, 6).
    expected = torch.tensor([[3.0, 2, 2], [3, 1, 4], [6, 1, 2]], dtype=torch.float64)
    torch.testing.assert_close(scene["car"].vertices, expected, atol=1e-9, rtol=0)
    # Really turned by -90° about x, y to −z and z to y: (2, 2, 3), (1, 2, 1), (1, 5, 3).
    expected = torch.tensor([[3.0, 2, 2], [1, 1, 2], [3, 1, 5]], dtype=torch.float64)
    torch.testing.assert_close(truth["car"].vertices, expected, atol=1e-9, rtol=0)
    wall = [[5.5, -1.5, -1.0], [5.5, 1.5, 1.0]]
    assert box_of(scene["wall"].vertices) == wall
    # The second part, turned by 90° about y: (0, 0, -1), (0, 2, 0), (3, 0, 0).
    expected = torch.tensor([[-1.0, 0, 0], [0, 0, 2], [0, 3, 0]], dtype=torch.float64)
    torch.testing.assert_close(scene["slits"].vertices[-3:], expected, atol=1e-9, rtol=0)
    radar = build.radar(run.radar)
    assert radar.positions[0].tolist() == [-1.0, -0.9, 0.0]
    assert radar.positions[-1].tolist() == [-1.0, 0.9, 1.0]
    ahead = torch.tensor([2.6, 0.0, 0.0], dtype=torch.float64) - radar.positions[0]
    assert radar.rotations is not None
    torch.testing.assert_close(radar.rotations[0, :, 0], ahead / ahead.norm())


def test_worlds_with_z_up_stay(tmp_path):
    text = converted(tmp_path, RADIO)
    run = as_run(tmp_path, text)
    scene = build.scene(run)
    floor = [[-1.0, -0.5, 3.0], [1.0, 0.5, 3.0]]
    assert np.allclose(box_of(scene["floor"].vertices), floor, atol=1e-12)
    # It faced −z.
    corners = scene["floor"].vertices[scene["floor"].mesh.faces[0]]
    normal = torch.linalg.cross(corners[1] - corners[0], corners[2] - corners[0])
    assert normal[2] < 0
    assert "size = [5.0, 4.0, 3.0]\nrotation_deg = [0.0, 0.0, 30.0]\n" in text
    # It looked along z; what was its right is its left.
    axes = run.transmitter.build().mount.rotations
    torch.testing.assert_close(axes, AXES_OF_OLD, atol=1e-12, rtol=0)
    assert 'axes = ["x", "z"]' in text
    assert "low = [-2.4, -1.9, -1.4]" in text
    assert "low = [-2.0, -1.0], high = [2.0, 1.0], height = 0.5" in text


def test_an_antenna_that_looks_at_a_point_keeps_its_axes(tmp_path):
    """Its level was that of the old frame: the right is y × boresight."""
    turned = RADIO.replace("rotation_deg = [0.0, 0.0, 0.0]", "look_at = [0.0, 0.8, 0.2]", 1)
    run = as_run(tmp_path, converted(tmp_path, turned))
    axes = run.transmitter.build().mount.rotations
    assert axes[:, 0].tolist() == pytest.approx([-1.0, 0.0, 0.0])
    assert axes[:, 1].tolist() == pytest.approx([0.0, 0.0, 1.0])
    assert axes[:, 2].tolist() == pytest.approx([0.0, 1.0, 0.0])


def test_a_signature_is_seen_from_where_it_was(tmp_path):
    text = 'task = "rcs"\n[scene.p]\nshape = "plate"\nwidth = 2.0\nheight = 1.0\n'
    text += 'material = { kind = "perfect_conductor" }\n[rcs]\nfrequencies = 1e9\n'
    run = as_run(tmp_path, converted(tmp_path, text + "theta_deg = 180.0\n"))
    corners = box_of(build.scene(run)["p"].vertices)
    assert np.allclose(corners, [[-1.0, -0.5, 0.0], [1.0, 0.5, 0.0]], atol=1e-12)
    assert run.rcs.theta_deg == 180.0


def test_a_radar_in_a_world_with_z_up_keeps_it(tmp_path):
    text = EMPTY + RADAR + '[twin]\nup = "z"\nlow = [-1.0, -2.0]\n'
    found = tomllib.loads(converted(tmp_path, text))
    assert found["radar"]["positions"] == [[0.5, 1.0, 0.0]]
    assert found["twin"] == {"low": [-1.0, -2.0]}
    radar = build.radar(as_run(tmp_path, converted(tmp_path, text)).radar)
    assert radar.rotations is not None
    torch.testing.assert_close(radar.rotations[0], AXES_OF_OLD, atol=1e-12, rtol=0)
    # With y up, the plane of the ground was x and z.
    turned = tomllib.loads(converted(tmp_path, text.replace('up = "z"', 'up = "y"')))
    assert turned["twin"] == {"low": [-2.0, -1.0]}
    assert turned["radar"]["positions"] == [[0.0, 0.5, 1.0]]


def test_paths_and_values_that_are_varied(tmp_path):
    old = tomllib.loads(DATASET + RADAR)
    found = tomllib.loads(converted(tmp_path, DATASET + RADAR))
    first, second, third = found["vary"]
    assert first["key"] == ["scene.box.position[0]", "radar.positions[0][0]"]
    assert (first["low"], first["high"]) == (1.0, 2.0)
    assert (second["low"], second["high"]) == ([-5.0, 0.0, 0.0], [5.0, 0.0, 90.0])
    assert third == old["vary"][2]


def test_people_and_shapes_in_their_own_frames(tmp_path):
    text = f"""\
task = "gradcheck"
[scene.anna]
shape = "body"
angles_deg = {{ left_elbow = [0.0, -40.0, 10.0] }}
{PAINT}
[scene.ball]
shape = "sphere"
radius = 0.1
{PAINT}
[[parameters]]
kind = "body"
object = "anna"
joints = {{ left_elbow = ["x", "y"], neck = ["z"] }}
[[parameters]]
kind = "density"
object = "ball"
low = [-0.3, -0.2, -0.1]
high = [0.3, 0.2, 0.1]
counts = [7, 5, 3]
[gradcheck]
parameter = {{ kind = "vertices", object = "ball" }}
tangent = {{ offsets = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]] }}
step = 1e-3
[variants.other]
parameters = [{{ kind = "translation", object = "ball", axes = ["y"] }}]
"""
    found = tomllib.loads(converted(tmp_path, text + RADAR))
    assert found["scene"]["anna"]["angles_deg"]["left_elbow"] == [10.0, 0.0, -40.0]
    body, grid = found["parameters"]
    assert body["joints"] == {"left_elbow": ["y", "z"], "neck": ["x"]}
    assert (grid["low"], grid["counts"]) == ([-0.1, -0.3, -0.2], [3, 7, 5])
    assert found["gradcheck"]["tangent"]["offsets"] == [[3.0, 1.0, 2.0], [6.0, 4.0, 5.0]]
    assert found["variants"]["other"]["parameters"][0]["axes"] == ["z"]


def test_parts_of_a_variant_go_along(tmp_path):
    text = RUN.replace("frame = 2\n", "") + (
        '[variants.wide]\nsearch = { kind = "grid", object = "plate", low = [0.0, 1.0, 2.0], '
        "high = [1.0, 2.0, 3.0], step = 1.0 }\n"
    )
    found = tomllib.loads(converted(tmp_path, text))
    assert found["variants"]["wide"]["search"]["low"] == [2.0, 0.0, 1.0]


def test_walls_of_a_room_change_sides(tmp_path):
    text = 'task = "simulate"\n[room]\nmaterials = { wall_left = { kind = "rough_conductor" } }\n'
    found = tomllib.loads(converted(tmp_path, text))
    assert list(found["room"]["materials"]) == ["wall_right"]


def test_images_are_mirrored_beside_the_old_ones(tmp_path, monkeypatch):
    """Their columns ran along x, which is to the left now."""
    np.save(tmp_path / "wall.npy", np.array([[2.0, 3.0, 4.0], [5.0, 6.0, 7.0]]))
    wall = 'shape = "plate"\nwidth = 3.0\nheight = 2.0\n'
    paint = 'material = { kind = "dielectric", permittivity = { image = "wall.npy" } }\n'
    file = tmp_path / "run.toml"
    file.write_text(f'task = "simulate"\n[scene.wall]\n{wall}{paint}')
    assert call(monkeypatch, "convert", file) == 0
    mirrored = np.load(tmp_path / "wall.frame2.npy")
    assert mirrored.tolist() == [[4.0, 3.0, 2.0], [7.0, 6.0, 5.0]]
    assert 'image = "wall.frame2.npy"' in file.read_text()
    assert np.load(tmp_path / "wall.npy").tolist() == [[2.0, 3.0, 4.0], [5.0, 6.0, 7.0]]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a = 1\n", "expected a run file, got TOML without `task`"),
        ("a = [1,\n", "line 1: expected TOML"),
        ('task = "simulate"\nscene = 3\n', "scene: expected a table, got 3"),
        (EMPTY + "[[vary]]\n", "vary[0]: expected"),
        (EMPTY.replace("0.1", "0.1\nposition = 1.0"), "scene.ball.position: expected"),
        (RUN, "expected a run file of the first frame, which has no such key, got frame = 2"),
        (RUN.replace("frame = 2", "sede = 3"), "sede: expected one of the keys"),
        (
            RADIO.replace("orientation = {", "orientation_ = {"),
            "transmitter.orientation_: expected one of the keys",
        ),
        (
            RADIO.replace("frequency = 2.4e9", "frequency = 2.4e9\nantenna = {}").replace(
                "antenna = {}", "antenna = { orientation = { look_at = [0.0, 0.0, 0.0] } }"
            ),
            "map.antenna.orientation: expected rotation_deg of antennas in a world with z up",
        ),
        (
            EMPTY + RADAR.replace("[[0.5, 1.0, 0.0]]", ARC) + '[twin]\nup = "z"\n',
            "radar.positions: expected positions one by one in a world with z up",
        ),
        (
            DATASET.replace('shape = "box"\nsize = 0.2', 'shape = "prior"') + RADAR,
            "vary[1].key: expected no rotation of a shape that keeps its coordinates",
        ),
    ],
)
def test_what_cannot_be_converted_is_one_line(tmp_path, monkeypatch, capfd, text, said):
    file, other = tmp_path / "run.toml", tmp_path / "other.toml"
    file.write_text(text)
    other.write_text(EMPTY)
    assert call(monkeypatch, "convert", other, file) == 2
    error = capfd.readouterr().err
    assert f"{file}: {said}" in error
    assert error.count("\n") == 1
    assert (file.read_text(), other.read_text()) == (text, EMPTY)  # none is written


@pytest.mark.parametrize(
    ("frame", "said"),
    [
        ("", "expected frame = 2 (x ahead, y to the left, z up), got one of the first frame"),
        ("frame = 1\n", "frame: expected 2, got 1"),
        ("frame = 3\n", "frame: expected 2, got 3"),
        ('frame = "z up"\n', 'frame: expected 2, got "z up"'),
    ],
)
def test_run_files_of_another_frame_are_refused(run_file, monkeypatch, capfd, frame, said):
    run_file.write_text(RUN.replace("frame = 2\n", frame))
    assert call(monkeypatch, "check", run_file) == 2
    error = capfd.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert (f"invertwin convert {run_file}" in error) == (frame == "")


def test_a_file_is_whole_at_any_moment(tmp_path, monkeypatch, capfd):
    file = tmp_path / "run.toml"
    file.write_text(EMPTY)
    file.chmod(0o640)

    def fail(*_: object) -> None:
        raise OSError("no room")

    with monkeypatch.context() as broken:
        broken.setattr(os, "replace", fail)
        assert call(monkeypatch, "convert", file) == 2
    assert "got no room; make room" in capfd.readouterr().err
    assert file.read_text() == EMPTY
    assert list(tmp_path.iterdir()) == [file]
    link = tmp_path / "link.toml"
    link.symlink_to(file)
    assert call(monkeypatch, "convert", link) == 0
    assert link.is_symlink()
    assert file.read_text().startswith('task = "simulate"\nframe = 2\n')
    assert file.stat().st_mode & 0o777 == 0o640


def test_line_ends_are_kept(tmp_path, monkeypatch):
    file = tmp_path / "run.toml"
    file.write_bytes(EMPTY.replace("\n", "\r\n").encode())
    assert call(monkeypatch, "convert", file) == 0
    lines = file.read_bytes().split(b"\r\n")
    assert lines[:2] == [b'task = "simulate"', b"frame = 2"]
    assert all(b"\n" not in line for line in lines)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match="expected a run file, got no file"):
        convert_file(tmp_path / "none.toml")
