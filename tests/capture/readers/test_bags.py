"""Bags of ROS 1 and ROS 2, as the package rosbags writes them."""

import builtins
import os

import numpy as np
import pytest
import torch

from invertwin.capture import (
    Capture,
    ChirpData,
    ChirpSettings,
    bag_topics,
    read_clouds,
    read_topic,
    read_track,
)
from invertwin.errors import InputError
from invertwin.radar import FMCW, Chirps, Radar
from invertwin.scene import linear_array, planar_array
from oracles.moving_point import moving_beat

pytest.importorskip("rosbags", reason="pip install -e '.[ros]'")
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

SAMPLES = np.arange(3 * 4 * 2 * 8, dtype=np.int16).reshape(3, 4 * 2 * 8)
STARTED = 1_700_000_000


def typestore(version: int):
    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    text = "std_msgs/Header header\nint16[] samples\nstring note\n"
    store.register(get_types_from_msg(text, "radar_msgs/msg/Cube"))
    return store


def header(store, version: int, number: int):
    kinds = store.types
    stamp = kinds["builtin_interfaces/msg/Time"](sec=STARTED + number, nanosec=500_000_000)
    more = {"seq": number} if version == 1 else {}
    return kinds["std_msgs/msg/Header"](stamp=stamp, frame_id="radar", **more)


def cloud(store, version: int, number: int):
    """Two points in two rows, each row with a byte to spare, the velocity as a double."""
    kinds = store.types
    field = kinds["sensor_msgs/msg/PointField"]
    fields = [field(name=n, offset=4 * k, datatype=7, count=1) for k, n in enumerate("xyz")]
    fields.append(field(name="doppler", offset=12, datatype=8, count=1))
    data = b""
    for row in range(2):
        data += np.array([number, row, 2.0], "<f4").tobytes() + np.array([-0.5], "<f8").tobytes()
        data += b"\0"
    return kinds["sensor_msgs/msg/PointCloud2"](
        header=header(store, version, number), height=2, width=1, fields=fields, is_bigendian=False,
        point_step=20, row_step=21, data=np.frombuffer(data, np.uint8), is_dense=True,
    )  # fmt: skip


def place(store, version: int, number: int):
    kinds = store.types
    pose = kinds["geometry_msgs/msg/Pose"](
        position=kinds["geometry_msgs/msg/Point"](x=0.1 * number, y=1.0, z=-2.0),
        orientation=kinds["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
    )
    return kinds["geometry_msgs/msg/PoseStamped"](header=header(store, version, number), pose=pose)


def cube(store, version: int, number: int):
    return store.types["radar_msgs/msg/Cube"](
        header=header(store, version, number), samples=SAMPLES[number], note="bench"
    )


@pytest.fixture(params=["ros1", "sqlite", "mcap"])
def bag(request, tmp_path):
    """Three messages of each of three topics."""
    version = 1 if request.param == "ros1" else 2
    store = typestore(version)
    if version == 1:
        path = tmp_path / "drive.bag"
        writer = Writer1(path)
    else:
        path = tmp_path / "drive"
        plugin = StoragePlugin.MCAP if request.param == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
    topics = {
        "/adc": ("radar_msgs/msg/Cube", cube),
        "/cloud": ("sensor_msgs/msg/PointCloud2", cloud),
    }
    topics["/pose"] = ("geometry_msgs/msg/PoseStamped", place)
    with writer as out:
        for topic, (kind, make) in topics.items():
            connection = out.add_connection(topic, kind, typestore=store)
            for number in range(3):
                message = make(store, version, number)
                raw = (
                    store.serialize_ros1(message, kind)
                    if version == 1
                    else store.serialize_cdr(message, kind)
                )
                out.write(connection, (STARTED + number) * 10**9, raw)
    return path


def test_topics_have_their_types(bag):
    assert bag_topics(bag) == {
        "/adc": "radar_msgs/msg/Cube",
        "/cloud": "sensor_msgs/msg/PointCloud2",
        "/pose": "geometry_msgs/msg/PoseStamped",
    }


def test_samples_of_a_message_of_ones_own_become_chirps(bag):
    found = read_topic(bag, "/adc", "samples")
    assert (found.times - STARTED).tolist() == [0.5, 1.5, 2.5]
    samples = found.stack().view(3, 4, 1, 2, 8)
    assert samples.dtype == torch.int16
    settings = ChirpSettings(
        start_frequency=77e9, slope=60e12, sample_rate=5e6, samples=8, loops=4, frames=3, real=True,
        transmit_order=(1,), receivers=(1, 2),
    )  # fmt: skip
    data = ChirpData(samples.to(torch.complex64), settings)
    assert data.samples[2, 3, 0, 1, 7].real == SAMPLES[2, -1]


def test_a_number_within_messages_is_an_array(bag):
    found = read_topic(bag, "/pose", "pose.position.x")
    torch.testing.assert_close(found.stack(), torch.tensor([0.0, 0.1, 0.2]).double())


def test_poses_are_a_track(bag):
    track = read_track(bag, "/pose")
    assert (track.times - STARTED).tolist() == [0.5, 1.5, 2.5]
    assert track.positions[:, 1:].tolist() == [[1.0, -2.0]] * 3
    middle = track.interpolate(torch.tensor([STARTED + 1.0], dtype=torch.float64))
    assert float(middle[0, 0]) == pytest.approx(0.05)


def test_clouds_have_their_fields(bag):
    clouds = read_clouds(bag, "/cloud")
    assert [one["x"].tolist() for one in clouds] == [[n, n] for n in (0.0, 1.0, 2.0)]
    assert clouds[0]["y"].tolist() == [0.0, 1.0]
    assert clouds[0]["doppler"].tolist() == [-0.5, -0.5]


def test_places_of_ros_are_places_of_ours(bag):
    """x forward, y left, z up: a point to the left of a radar and above it is at u > 0, v > 0."""
    assert read_track(bag, "/pose").positions.tolist() == [[0.1 * n, 1.0, -2.0] for n in range(3)]
    cloud = read_clouds(bag, "/cloud")[2]
    point = torch.stack([cloud[name] for name in "xyz"], dim=1)[1]
    assert point.tolist() == [2.0, 1.0, 2.0]
    waveform = FMCW(77e9, 1e9, 50e-6, 64)
    half = waveform.wavelength / 2
    arrays = linear_array(1, half), planar_array((8, 8), (half, half))
    radar = Radar(*arrays, waveform, torch.zeros(1, 3, dtype=torch.float64))
    beat = moving_beat(radar, Chirps(1, 60e-6), lambda times: point.expand(*times.shape, 3))
    grid = radar.grid(2.0, 4.0)
    power = Capture.from_beat(beat[:, 0], radar).spectrum(grid)[0]
    at = np.unravel_index(int(power.argmax()), power.shape)
    found = (float(axis[k]) for axis, k in zip((grid.ranges, grid.u, grid.v), at, strict=True))
    assert tuple(found) == pytest.approx((3.0, 1 / 3, 2 / 3), abs=0.1)


def test_what_is_not_there_is_named(bag):
    with pytest.raises(InputError, match="it has /adc, /cloud, /pose"):
        read_topic(bag, "/radar", "samples")
    with pytest.raises(InputError, match="fields among header, samples, note"):
        read_topic(bag, "/adc", "data")
    with pytest.raises(InputError, match="expected numbers in the field 'note'"):
        read_topic(bag, "/adc", "note")
    with pytest.raises(InputError, match="with a pose on /adc, got radar_msgs/msg/Cube"):
        read_track(bag, "/adc")
    with pytest.raises(InputError, match="point clouds on /pose"):
        read_clouds(bag, "/pose")


def test_no_bag_is_one_line(tmp_path):
    with pytest.raises(InputError, match="expected a bag of ROS, got no file"):
        bag_topics(tmp_path / "none.bag")
    broken = tmp_path / "broken.bag"
    broken.write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    with pytest.raises(InputError, match="expected a bag of ROS 1 or ROS 2") as caught:
        bag_topics(broken)
    assert "\n" not in str(caught.value)


def test_pipes_are_no_bags(tmp_path):
    (tmp_path / "ros2").mkdir()
    for pipe, path in ((tmp_path / "a.bag",) * 2, (tmp_path / "ros2/a.db3", tmp_path / "ros2")):
        os.mkfifo(pipe)
        with pytest.raises(InputError, match="expected a bag of ROS, got a pipe or a device"):
            bag_topics(path)


def test_messages_of_different_sizes_do_not_stack():
    from invertwin.capture.readers.bags import BagMessages

    with pytest.raises(InputError, match="got 2 sizes"):
        BagMessages(torch.zeros(2).double(), [np.zeros(3), np.zeros(4)]).stack()


def test_without_the_package_the_extra_is_named(tmp_path, monkeypatch):
    whole = builtins.__import__

    def missing(name, *args, **kwargs):
        if name.startswith("rosbags"):
            raise ImportError(name)
        return whole(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(InputError, match=r"invertwin\[ros\]"):
        bag_topics(tmp_path)
