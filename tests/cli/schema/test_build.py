"""What the tables of a run file become."""

import math
import tomllib
from pathlib import Path

import pytest
import torch

from invertwin.cli.fits.problem import Problem, initial_scenes
from invertwin.cli.fits.radar_maps import RadarMaps
from invertwin.cli.run_file import to_toml, validate_run
from invertwin.cli.schema import build
from invertwin.errors import InputError
from invertwin.inversion import displace, pose_error
from invertwin.inversion.loss import SpectrumLoss
from invertwin.inversion.reconstruction import Optimizer
from invertwin.scene import (
    PerfectConductor,
    RoughDielectric,
    room,
    rotation_angle,
    rotation_from_vector,
)

ROUGH = {"kind": "rough_dielectric", "permittivity": 4.0, "lobe_width_deg": 30.0}
ELEMENT = {"kind": "positions", "positions": [[0, 0, 0]]}
RADAR = {
    "waveform": {
        "kind": "fmcw",
        "start_frequency": 76e9,
        "bandwidth": 2e9,
        "duration": 5e-5,
        "samples": 64,
    },
    "transmitters": ELEMENT,
    "receivers": {"kind": "linear", "count": 4, "spacing": 1.9e-3},
}


def read(**changes):
    raw = {"task": "reconstruct", "frame": 2, "scene": {"box": make_box()}} | changes
    return validate_run(raw, Path("run.toml"))


def make_box(**changes):
    return {"shape": "box", "size": [0.4, 0.2, 0.3], "material": ROUGH} | changes


def test_shapes_are_scaled_then_turned_then_moved():
    run = read(scene={"box": make_box(scale=2.0, rotation_deg=[0, 0, 90], position=[3, 1, 2])})
    box = build.scene(run)["box"]
    extent = box.vertices.amax(0) - box.vertices.amin(0)
    torch.testing.assert_close(extent, torch.tensor([0.4, 0.8, 0.6], dtype=torch.float64))
    torch.testing.assert_close(box.center, torch.tensor([3.0, 1.0, 2.0], dtype=torch.float64))
    assert isinstance(box.material, RoughDielectric)
    assert box.material.lobe_width == math.radians(30)


def test_truth_replaces_only_what_it_names():
    run = read(
        scene={"box": make_box(position=[2, 0, 0], rotation_deg=[0, 0, 10])},
        truth={"box": {"position": [2, 0.1, 0]}},
    )
    found = pose_error(build.scene(run)["box"], build.true_scene(run)["box"])
    assert found is not None
    torch.testing.assert_close(found.offset, torch.tensor([0, -0.1, 0], dtype=torch.float64))
    assert found.angle < 1e-7


def test_every_shape_and_parts_can_be_built(tmp_path):
    from invertwin.scene import plate
    from invertwin.scene.files import save_mesh

    save_mesh(tmp_path / "mesh.ply", plate(1.0, 1.0))
    shapes = {
        "plate": {"shape": "plate", "width": 1, "height": 2},
        "sphere": {"shape": "sphere", "radius": 0.1, "subdivisions": 1},
        "dihedral": {"shape": "dihedral", "edge": 0.1},
        "trihedral": {"shape": "trihedral", "edge": 0.1},
        "text": {"shape": "text", "text": "A"},
        "file": {"file": "mesh.ply"},
        "parts": {
            "parts": [
                {"shape": "plate", "width": 1, "height": 1, "position": [0, -1, 0]},
                {"shape": "plate", "width": 1, "height": 1, "position": [0, 1, 0], "scale": 0.5},
            ]
        },
    }
    raw = {
        "task": "simulate",
        "frame": 2,
        "scene": {k: v | {"material": ROUGH} for k, v in shapes.items()},
    }
    scene = build.scene(validate_run(raw, tmp_path / "run.toml"))
    assert set(scene.names) == set(shapes)
    slits = scene["parts"].vertices
    assert (slits[:, 1].min(), slits[:, 1].max()) == (-1.5, 1.25)


def test_missing_mesh_names_the_object(tmp_path):
    raw = {"task": "simulate", "frame": 2, "scene": {"car": {"file": "car.obj", "material": ROUGH}}}
    with pytest.raises(InputError, match=r"scene\.car: .*car\.obj"):
        build.scene(validate_run(raw, tmp_path / "run.toml"))


@pytest.mark.parametrize(
    ("positions", "count"),
    [
        ({"kind": "line", "start": [0, -1, 0], "stop": [0, 1, 0], "count": 5}, 5),
        (
            {
                "kind": "arc",
                "center": [2.5, 0, 0],
                "radius": 2.5,
                "start_deg": -30,
                "stop_deg": 30,
                "count": 3,
            },
            3,
        ),
        ({"kind": "grid", "center": [0, 0, 0], "size": [1, 0.5], "count": [3, 2]}, 6),
        ([[0, 0, 0], [0, 0.1, 0]], 2),
    ],
)
def test_tracks_and_look_at(positions, count):
    table = RADAR | {"positions": positions, "orientation": {"look_at": [2.5, 0, 0.5]}}
    run = read(radar=table)
    assert run.radar is not None
    radar = build.radar(run.radar)
    assert radar.frame_count == count
    assert radar.rotations is not None
    ahead = torch.tensor([2.5, 0, 0.5], dtype=torch.float64) - radar.positions
    seen = (radar.rotations.mT @ ahead[..., None])[..., 0]
    torch.testing.assert_close(seen[:, 1:], torch.zeros(count, 2, dtype=torch.float64))
    assert bool((torch.linalg.det(radar.rotations) > 0.999).all())
    assert bool((radar.rotations[:, 2, 2] > 0.9).all())


def test_look_at_straight_up_is_an_input_error():
    run = read(radar=RADAR | {"orientation": {"look_at": [0, 0, 1]}})
    assert run.radar is not None
    with pytest.raises(InputError, match="look_at"):
        build.radar(run.radar)


def test_starts_are_as_far_off_as_asked_and_repeat():
    table = {"object": "box", "count": 5, "distance": [0.3, 0.4], "angle_deg": [15, 25], "seed": 3}
    run = read(truth={"box": {"position": [3, 1, 2]}}, starts=table)
    assert run.starts is not None
    scene, truth = build.scene(run), build.true_scene(run)
    problem = Problem(run, scene, truth, frozenset(), {}, None, RadarMaps())
    found, again = initial_scenes(problem), initial_scenes(problem)
    for start, same in zip(found, again, strict=True):
        rest = pose_error(start["box"], truth["box"])
        assert rest is not None
        assert 0.3 <= rest.distance <= 0.4
        assert math.radians(15) <= rest.angle <= math.radians(25)
        assert math.isclose(rest.scale, 1.0, rel_tol=1e-9)
        assert torch.equal(start["box"].vertices, same["box"].vertices)


def test_starts_in_a_plane_about_one_axis():
    table = {
        "object": "box",
        "count": 5,
        "distance": [0.3, 0.4],
        "angle_deg": [15, 25],
        "axes": ["x", "y"],
        "rotation_axis": [0, 0, 2],
    }
    run = read(starts=table, seed=7)
    assert run.starts is not None
    scene = build.scene(run)
    for start in initial_scenes(Problem(run, scene, scene, frozenset(), {}, None, RadarMaps())):
        assert abs(float(start["box"].center[2])) < 1e-12
        torch.testing.assert_close(start["box"].transform[2, :3], scene["box"].transform[2, :3])


def test_axes_that_are_not_fitted_stay():
    table = {"kind": "pose", "object": "box", "axes": ["y"], "rotation_axes": ["z"]}
    run = read(parameters=[table])
    scene = build.scene(run)
    (pose,) = build.parameters(run.parameters, scene)
    weights = torch.arange(24, dtype=torch.float64).reshape(8, 3)
    (pose(scene)["box"].vertices * weights).square().sum().backward()
    gradients = {name: p.grad for name, p in pose.named_parameters()}
    assert gradients["translation"] is not None
    assert gradients["rotation"] is not None
    assert (gradients["translation"] != 0).tolist() == [False, True, False]
    assert (gradients["rotation"][1:] != 0).tolist() == [False, False, True]


@pytest.mark.parametrize("shape", [{"shape": "plate", "width": 1, "height": 2}, make_box()])
def test_residual_of_a_known_similarity(shape):
    truth = build.scene(read(scene={"x": shape | {"material": ROUGH}}))
    vector = torch.tensor([0.4, 0.2, -0.7], dtype=torch.float64)
    offset = torch.tensor([0.3, 0.1, 0.2], dtype=torch.float64)
    moved = displace(truth["x"], offset, vector)
    found = pose_error(moved, truth["x"])
    assert found is not None
    torch.testing.assert_close(found.offset, offset)
    expected = float(rotation_angle(rotation_from_vector(vector)))
    assert math.isclose(found.angle, expected, rel_tol=1e-9)
    half = build.scene(read(scene={"x": shape | {"material": ROUGH, "scale": 0.5}}))
    smaller = pose_error(half["x"], truth["x"])
    assert smaller is not None
    assert math.isclose(smaller.scale, 0.5)


def test_objects_of_other_triangles_have_no_residual():
    one, other = (build.scene(read(scene={"x": make_box(divisions=n)})) for n in (1, 2))
    assert pose_error(one["x"], other["x"]) is None


def test_parameters_start_as_the_identity():
    tables = [
        {"kind": "pose", "object": "box"},
        {"kind": "translation", "object": "box"},
        {"kind": "scale", "object": "box"},
        {"kind": "vertices", "object": "box"},
        {"kind": "material", "object": "box", "values": ["permittivity"]},
        {"kind": "radar_pose"},
        {"kind": "radar_path", "steps": 1, "drift": 0.05},
    ]
    run = read(parameters=tables, radar=RADAR)
    scene = build.scene(run)
    modules = build.parameters(run.parameters, scene)
    assert len(modules) == len(tables)
    changed = scene
    for module in modules[:-2]:
        changed = module(changed)
    torch.testing.assert_close(changed["box"].vertices, scene["box"].vertices)
    material = changed["box"].material
    assert isinstance(material, RoughDielectric)
    assert isinstance(material.permittivity, torch.Tensor)
    assert math.isclose(float(material.permittivity.detach()), 4.0, rel_tol=1e-9)


def test_material_value_that_a_conductor_does_not_have():
    run = read(
        scene={"box": make_box(material={"kind": "perfect_conductor"})},
        parameters=[{"kind": "material", "object": "box", "values": ["permittivity"]}],
    )
    with pytest.raises(InputError, match=r"parameters\[0\]\.values"):
        build.parameters(run.parameters, build.scene(run))


ROOM = """<scene version="3.0.0">
  <shape type="rectangle" id="floor">
    <transform name="to_world"><translate value="0 0 4"/></transform>
    <ref id="mat-metal"/>
  </shape>
  <shape type="sphere" id="ball"><float name="radius" value="0.2"/></shape>
</scene>
"""


def read_room(tmp_path, **changes):
    (tmp_path / "room.xml").write_text(ROOM)
    raw = {"task": "reconstruct", "frame": 2, "scene_file": {"file": "room.xml"}} | changes
    return validate_run(raw, tmp_path / "run.toml")


def test_scene_file_beside_scene_tables(tmp_path):
    metal = {"kind": "perfect_conductor"}
    table = {"file": "room.xml", "materials": {"mat-metal": metal}, "material": ROUGH}
    run = read_room(tmp_path, scene_file=table, scene={"box": make_box()})
    assert validate_run(tomllib.loads(to_toml(run)), tmp_path / "run.toml") == run
    scene = build.scene(run)
    assert scene.names == ("floor", "ball", "box")
    assert isinstance(scene["floor"].material, PerfectConductor)
    ball = scene["ball"].material
    assert isinstance(ball, RoughDielectric)
    assert ball.permittivity == 4.0
    assert bool((scene["floor"].vertices[:, 2] == 4).all())


def test_truth_of_a_scene_file_places_from_where_the_file_does(tmp_path):
    run = read_room(tmp_path, truth={"floor": {"position": [0.5, 0, 0]}, "ball": {"scale": 2.0}})
    scene, truth = build.scene(run), build.true_scene(run)
    found = pose_error(scene["floor"], truth["floor"])
    assert found is not None
    torch.testing.assert_close(found.offset, torch.tensor([-0.5, 0, 0], dtype=torch.float64))
    larger = pose_error(scene["ball"], truth["ball"])
    assert larger is not None
    assert math.isclose(larger.scale, 0.5)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"parameters": [{"kind": "scale", "object": "bal"}]}, r"parameters\[0\].*mean `ball`"),
        ({"scene": {"ball": make_box()}}, r"scene\.ball: .*choose another"),
        ({"scene_file": {"file": "hall.xml"}}, r"scene_file: .*hall\.xml"),
        (
            {"scene_file": {"file": "room.xml", "materials": {"mat-wood": ROUGH}}},
            r"scene_file: .*mat-wood",
        ),
    ],
)
def test_scene_file_errors_name_the_key(tmp_path, changes, said):
    with pytest.raises(InputError, match=said):
        build.scene(read_room(tmp_path, **changes))


def test_a_room_stands_before_the_other_objects():
    table = {"width": 4.5, "furniture": ["sofa", "table"], "materials": {"floor": ROUGH}}
    run = read(room=table, truth={"sofa": {"material": ROUGH}, "table": {"position": [2, 1, 0]}})
    assert validate_run(tomllib.loads(to_toml(run)), Path("run.toml")) == run
    scene, truth, made = build.scene(run), build.true_scene(run), room(4.5, furniture=["sofa"])
    assert scene.names == (*made, "table", "box")
    for name in made:
        assert torch.equal(scene[name].vertices, made[name].vertices)
        assert torch.equal(truth[name].vertices, made[name].vertices)
        same = scene[name].material == made[name].material
        assert same == (name != "floor"), name
    floor, sofa = scene["floor"].material, truth["sofa"].material
    assert isinstance(floor, RoughDielectric)
    assert isinstance(sofa, RoughDielectric)
    assert (floor.permittivity, sofa.permittivity) == (4.0, 4.0)
    assert truth["table"].transform[:3, 3].tolist() == [2, 1, 0]


def test_furniture_may_really_move_but_has_no_joints():
    run = read(room={"furniture": ["sofa"]}, truth={"sofa": {"velocity": [0.5, 0.0, 0.0]}})
    velocity = build.true_scene(run)["sofa"].velocity
    assert velocity is not None
    assert velocity.tolist() == [0.5, 0.0, 0.0]
    bent = read(room={"furniture": ["sofa"]}, truth={"sofa": {"angles_deg": {"hip": [1, 0, 0]}}})
    with pytest.raises(InputError, match=r"truth\.sofa: expected angles_deg of a body of \[scene"):
        build.true_scene(bent)


def test_a_room_may_be_all_that_there_is():
    assert build.scene(read(scene={}, room={})).names == tuple(room())


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"room": {"width": 3.0}}, r"run\.toml: room: expected width"),
        ({"room": {"furniture": ["piano"]}}, r"room: expected furniture among table"),
        (
            {"room": {"furniture": [], "materials": {"sofa": ROUGH}}},
            r"room\.materials\.sofa: expected an object of the room: floor, ",
        ),
        ({"room": {}, "truth": {"sofia": {}}}, r"truth\.sofia: .*mean `sofa`"),
        ({"room": {}, "scene": {"sofa": make_box()}}, r"scene\.sofa: .*choose another"),
    ],
)
def test_errors_of_a_room_name_the_key(changes, said):
    with pytest.raises(InputError, match=said):
        build.scene(read(**changes))


def test_table_pattern_in_degrees_and_decibels():
    gain = [[6.0], [0.0], [-20.0]]
    pattern = {"kind": "table", "theta_deg": [0, 60, 180], "gain_db": gain}
    run = read(radar=RADAR | {"receivers": ELEMENT | {"pattern": pattern}})
    assert run.radar is not None
    found = build.radar(run.radar).receivers.pattern
    tilt = math.radians(60)
    ahead = torch.tensor([[1, 0, 0], [math.cos(tilt), math.sin(tilt), 0]], dtype=torch.float64)
    expected = torch.tensor([10**0.6, 1.0], dtype=torch.float64)
    torch.testing.assert_close(found.gain(ahead), expected, rtol=1e-3, atol=0)


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ({}, [1, 0]),
        ({"polarisation": "H"}, [0, 1]),
        ({"polarisation": "circular"}, [0.5**0.5, 0.5**0.5 * 1j]),
        ({"polarisation": [3, 4.0]}, [0.6, 0.8]),
        ({"polarisation": [[3, 4.0]], "leakage": [0.5]}, [0.2 * 0.8**0.5, 1.1 * 0.8**0.5]),
        ({"leakage": 0.75}, [0.8, 0.6]),
    ],
)
def test_polarisation_of_elements(said, expected):
    found = build.radar(read(radar=RADAR | {"receivers": ELEMENT | said}).radar).receivers.jones
    torch.testing.assert_close(found.vectors[0], torch.tensor(expected, dtype=torch.complex128))


@pytest.mark.parametrize("wrong", ["X", [1.0, "a"], [0.0, 0.0], {"V": 1.0}])
def test_polarisation_errors_name_the_key(wrong):
    with pytest.raises(InputError, match=r"radar\.receivers(\.polarisation)?"):
        build.radar(read(radar=RADAR | {"receivers": ELEMENT | {"polarisation": wrong}}).radar)


def test_polarisation_of_a_board():
    bare = {
        name: value for name, value in RADAR.items() if name not in ("transmitters", "receivers")
    }
    board = {"name": "xWR1642", "polarisation": "H"}
    found = build.radar(read(radar=bare | {"board": board}).radar)
    for array in (found.transmitters, found.receivers):
        assert torch.equal(array.jones.vectors[0], torch.tensor([0, 1], dtype=torch.complex128))


def test_table_pattern_of_the_wrong_shape_names_the_key():
    pattern = {"kind": "table", "theta_deg": [0, 60], "gain_db": [[6.0, 1.0], [0.0]]}
    with pytest.raises(InputError, match=r"receivers\.pattern: .*2 rows of 1, .*1 or 2"):
        read(radar=RADAR | {"receivers": ELEMENT | {"pattern": pattern}})


def test_loss_and_optimizer_pass_on_what_is_given():
    run = read(
        loss={"kind": "likelihood", "floor": 0.05, "levels": 2},
        optimizer={"rate": 0.02, "rotation_rate": 0.2},
    )
    loss, optimizer = build.build_section(run, "loss"), build.build_section(run, "optimizer")
    assert (loss.kind, loss.floor, loss.levels) == ("likelihood", 0.05, 2)
    assert (optimizer.rate, optimizer.rotation_rate) == (0.02, 0.2)
    assert build.build_loss(read()) == SpectrumLoss()
    assert build.build_section(read(), "optimizer") == Optimizer()


@pytest.mark.parametrize(
    ("grid", "said"),
    [
        ({"range_min": 1, "range_max": 200}, r"grid\.range_max: .*4\.797 m, got 200"),
        ({"range_min": 1, "range_max": 4, "oversample": 1e9}, r"grid\.range_max: .*bins"),
    ],
)
def test_grid_that_only_a_wrong_unit_explains(grid, said):
    run = read(radar=RADAR, grid=grid)
    assert run.radar is not None
    assert run.grid is not None
    with pytest.raises(InputError, match=said):
        build.grid(run.grid, build.radar(run.radar))
