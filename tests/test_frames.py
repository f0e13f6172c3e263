"""One right-handed world, x forward, y left, z up, through every way in and out, by value.

An L on a wall, a ball on the left, a lamp above: nothing of it is its own mirror image.
"""

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

import invertwin as iw
from cli.small import call, read_metrics
from invertwin import plotting
from invertwin.capture import Capture, adc_counts, make_settings
from invertwin.capture.ti import write_cfg, write_samples
from invertwin.plotting.figures import png_bytes
from invertwin.radar import Chirps, board, detect_points
from invertwin.scene import (
    PerfectConductor,
    RoughDielectric,
    load_parts,
    plate,
    rigid,
    save_mesh,
    save_scene_xml,
    sphere,
    text,
)
from invertwin.viewer import build_display, page_html

BALL, LAMP, WALL = (2.5, 1.2, -0.3), (2.0, -0.3, 1.0), (4.0, 0.0, 0.0)
RADIUS = 0.15


def scene() -> iw.Scene:
    metal, paint = PerfectConductor(), RoughDielectric(4.0)
    return iw.Scene(
        {
            "ball": iw.Object(sphere(RADIUS, 6), metal, rigid(translation=BALL)),
            "lamp": iw.Object(sphere(RADIUS, 6), metal, rigid(translation=LAMP)),
            "letter": iw.Object(text("L", size=1.0), paint, rigid(translation=(3.9, -0.6, 0.0))),
            "wall": iw.Object(plate(4.0, 3.0), paint, rigid(translation=WALL)),
        }
    )


def radar() -> iw.Radar:
    """A row and a column of antennas, of a public board."""
    chirp = iw.FMCW(start_frequency=60e9, bandwidth=3e9, duration=40e-6, samples=128)
    arrays = board("IWR6843ISK").arrays(elevation=1)
    return iw.Radar(*arrays, chirp, torch.zeros(1, 3, dtype=torch.float64))


def nearest(place: tuple[float, float, float]) -> np.ndarray:
    """The point of a ball that is nearest to the radar, which shines."""
    away = np.array(place)
    return away * (1 - RADIUS / np.linalg.norm(away))


def test_raw_files_are_looked_at_as_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Two balls in ADC counts of a board, found on the left below, and above on the right."""
    monkeypatch.chdir(tmp_path)
    sensor, chirps = radar(), Chirps(2, 200e-6)
    balls = iw.Scene({name: scene()[name] for name in ("ball", "lamp")})
    few = iw.Sampling(depth=1, conductor_samples=200_000)
    beat = iw.simulate_chirps(balls, sensor, chirps, seed=1, sampling=few)
    settings = make_settings(
        sensor.waveform,
        (1, 2, 3),
        (1, 2, 3, 4),
        loops=2,
        frames=1,
        frame_period=0.1,
        idle_time=100e-6,
        lanes=2,
    )
    write_samples("adc.bin", adc_counts(beat, settings, 1.5 * float(beat.abs().max())))
    write_cfg("adc.cfg", settings)
    options = ("-c", "adc.cfg", "--board", "IWR6843ISK", "--elevation", "1", "-o", "seen")
    assert call(monkeypatch, "look", "adc.bin", *options) == 0
    assert read_metrics(tmp_path / "seen")["frames"] == 1
    capture = Capture.load("seen/capture.nc")
    grid = capture.radar().grid(1.0, 4.0, 0.9, 0.9)
    points = detect_points(capture.beat[:, None], capture.radar(), grid, None, 0)
    order = points.power.argsort(descending=True)
    found = points.position[order].numpy()
    for name in (BALL, LAMP):
        off = np.linalg.norm(found[:6] - nearest(name), axis=1)
        assert off.min() < 0.35, (name, found[:6])
    assert math.copysign(1, found[np.linalg.norm(found - nearest(BALL), axis=1).argmin(), 1]) == 1


def test_a_glb_stands_upright_elsewhere(tmp_path: Path):
    save_mesh(tmp_path / "twin.glb", scene())
    read = trimesh.load(tmp_path / "twin.glb")
    corners = {
        name.split(",")[0]: np.asarray(part.vertices) for name, part in read.geometry.items()
    }
    for name, place in (("ball", BALL), ("lamp", LAMP)):
        x, y, z = corners[name].mean(0)  # of glTF: y up
        assert (x, -z, y) == pytest.approx(place, abs=1e-3)  # as Blender imports it: z up
    x, y, z = corners["letter"].T
    stem = -z[y == y.max()]  # our y: the part with the largest height
    assert stem.min() > -0.6  # of an L that the radar reads, the stem is on the left
    again = {name.split(",")[0]: mesh for name, mesh in load_parts(tmp_path / "twin.glb").items()}
    assert again["ball"].center.tolist() == pytest.approx(BALL, abs=1e-3)


def test_paths_leave_to_where_things_are():
    """Azimuth from x towards y, elevation towards z, and u, v of the same signs."""
    empty = iw.Scene({"wall": scene()["wall"]})
    (way,) = iw.trace_paths(empty, [0.0, 0.0, 0.0], [BALL], 3.5e9, depth=0, rays=None).departure
    azimuth, elevation = math.atan2(way[1], way[0]), math.asin(way[2])
    assert azimuth == pytest.approx(math.atan2(1.2, 2.5))
    assert elevation == pytest.approx(math.atan2(-0.3, math.hypot(2.5, 1.2)))
    sensor = radar()
    rays = iw.Sampling(depth=1, samples=20_000)
    alone = iw.Scene(
        {"ball": iw.Object(sphere(RADIUS, 4), RoughDielectric(4.0), scene()["ball"].pose)}
    )
    grid = sensor.grid(2.0, 3.5, 0.9, 0.9)
    power = iw.SurrogateMap(grid, sampling=rays).predict(alone, sensor, seed=1)[0]
    _, u, v = np.unravel_index(int(power.argmax()), power.shape)
    distance = np.linalg.norm(BALL)
    assert float(grid.u[u]) == pytest.approx(1.2 / distance, abs=2 * grid.u_step)
    assert float(grid.v[v]) == pytest.approx(-0.3 / distance, abs=2 * grid.v_step)


def test_sionna_rt_sees_the_same_angles(tmp_path: Path):
    rt = pytest.importorskip("sionna.rt", reason="needs: pip install sionna-rt")
    concrete = iw.scene.Slab.itu("concrete", thickness=0.2)
    room = iw.Scene({"wall": scene()["wall"]}).replace("wall", material=concrete)
    save_scene_xml(tmp_path / "room.xml", room)
    world = rt.load_scene(str(tmp_path / "room.xml"))
    world.frequency = 3.5e9
    world.tx_array = world.rx_array = rt.PlanarArray(
        num_rows=1, num_cols=1, pattern="iso", polarization="V"
    )
    world.add(rt.Transmitter("tx", [0.0, 0.0, 0.0]))
    world.add(rt.Receiver("rx", list(BALL)))
    theirs = rt.PathSolver()(world, max_depth=1, diffuse_reflection=False, refraction=False)
    ours = iw.trace_paths(room, [0.0, 0.0, 0.0], [BALL], 3.5e9, depth=1, rays=None)
    assert len(ours.delay) == 2
    azimuths = torch.atan2(ours.departure[:, 1], ours.departure[:, 0])
    for k, delay in enumerate(ours.delay.tolist()):
        found = int(np.abs(np.array(theirs.tau).ravel() - delay).argmin())
        assert float(np.array(theirs.phi_t).ravel()[found]) == pytest.approx(
            float(azimuths[k]), abs=1e-4
        )
        assert float(np.array(theirs.theta_t).ravel()[found]) == pytest.approx(
            math.acos(float(ours.departure[k, 2])), abs=1e-4
        )


def test_bags_of_ros_need_no_conversion(tmp_path: Path):
    rosbag1 = pytest.importorskip("rosbags.rosbag1", reason='needs: pip install "invertwin[ros]"')
    from rosbags.typesys import Stores, get_typestore

    from invertwin.capture import read_clouds, read_track

    store = get_typestore(Stores.ROS1_NOETIC)

    def make(name: str, *values: Any, **named: Any) -> Any:
        return store.types[name](*values, **named)

    def header(number: int) -> Any:
        stamp = make("builtin_interfaces/msg/Time", sec=number, nanosec=0)
        return make("std_msgs/msg/Header", seq=number, stamp=stamp, frame_id="radar")

    names = {"/track": "geometry_msgs/msg/PointStamped", "/points": "sensor_msgs/msg/PointCloud2"}
    with rosbag1.Writer(tmp_path / "drive.bag") as bag:
        for topic, name in names.items():
            connection = bag.add_connection(topic, name, typestore=store)
            for number in (1, 2):
                if topic == "/track":
                    message = make(name, header(number), make("geometry_msgs/msg/Point", *BALL))
                else:
                    fields = [
                        make("sensor_msgs/msg/PointField", axis, 4 * k, 7, 1)
                        for k, axis in enumerate("xyz")
                    ]
                    data = np.array(BALL, "<f4").view(np.uint8)
                    message = make(name, header(number), 1, 1, fields, False, 12, 12, data, True)
                bag.write(connection, number * 10**9, store.serialize_ros1(message, name))
    track = read_track(tmp_path / "drive.bag", "/track")
    assert track.positions[0].tolist() == pytest.approx(BALL)
    cloud = read_clouds(tmp_path / "drive.bag", "/points")[0]
    assert [float(cloud[axis][0]) for axis in "xyz"] == pytest.approx(BALL)


def blue_share(png: bytes, low: float = 0.0, high: float = 1.0) -> float:
    """Where the blue of a twin is in a part of a picture: 0 is left, 1 right."""
    shown = np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), float)
    shown = shown[:, int(low * shown.shape[1]) : int(high * shown.shape[1])]
    mask = (shown[..., 2] - shown[..., 0] > 40) & (shown[..., 2] - shown[..., 1] > 15)
    return float(np.median(np.nonzero(mask)[1])) / shown.shape[1]


def test_pictures_have_the_ball_on_the_left():
    figure = plotting.scene(scene(), radar(), highlight=["ball"])
    png = png_bytes(figure)
    front, above, _ = figure.axes
    for axes in (front, above):
        frame = axes.get_position()
        assert blue_share(png, frame.x0, frame.x1) < 0.45
        assert axes.get_xlabel() == "y [m], to the left"
    grid = radar().grid(2.0, 3.5, 0.9)
    spectrum = torch.zeros(1, *grid.shape)
    spectrum[0, 3, -1] = 1.0  # the largest u
    (axes, *_) = plotting.spectrum(spectrum, grid).axes
    left, right = axes.get_xlim()
    assert left > 0 > right


def test_the_viewer_has_the_ball_on_the_left(request: pytest.FixtureRequest, tmp_path: Path):
    """As in the PNG: a page of the viewer, on the screen."""
    page = request.getfixturevalue("watched").page
    parts = iw.Scene({name: scene()[name] for name in ("ball", "wall")})
    sensor = radar()
    display = build_display(
        parts, {"": (sensor, sensor.grid(1.0, 4.5, 0.9))}, "frames", fitted=["ball"]
    )
    file = tmp_path / "page.html"
    file.write_text(f"<!doctype html><meta charset=utf-8>{page_html(display, {})}")
    page.goto(file.as_uri())
    page.wait_for_timeout(1000)
    shown = page.locator("#view canvas").first.screenshot()
    assert blue_share(shown) < 0.5 - 0.05
