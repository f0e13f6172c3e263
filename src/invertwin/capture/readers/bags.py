"""Recordings of the Robot Operating System, read without it: bags of ROS 1 and of ROS 2.

The package rosbags reads them, which is plain Python; the extra ``ros`` installs it.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from numpy.typing import NDArray
from torch import Tensor

from invertwin.capture.track import Track
from invertwin.checks import check_choice
from invertwin.errors import InputError
from invertwin.refusals import refusal
from invertwin.storage.untrusted import existing_file, safe_reader

# Where messages with poses keep the place, by the names of their fields.
_POSITION_FIELDS = ("pose.pose.position", "pose.position", "transform.translation")
_POSITION_FIELDS += ("point", "position")
# Numbers of `sensor_msgs/PointField`, and what they are to NumPy.
_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_ENDINGS = ("db3", "mcap", "yaml", "zstd")  # of the files of a bag of ROS 2


@dataclass(frozen=True, eq=False)
class BagMessages:
    """A field of all messages of a topic.

    Attributes:
        times: When each was stamped, or else recorded, since 1970 [s].
        values: Values of the field, one array per message.
    """

    times: Float64[Tensor, " message"]
    values: list[NDArray[Any]]

    def stack(self) -> Tensor:
        """All values as one tensor, messages first.

        Raises:
            InputError: Messages of different sizes.
        """
        shapes = {value.shape for value in self.values}
        if len(shapes) != 1:
            raise refusal("bags.sizes", len(shapes), sorted(shapes)[:2])
        return torch.from_numpy(np.stack(self.values))


@safe_reader("a bag of ROS 1 or ROS 2")
def bag_topics(path: str | Path) -> dict[str, str]:
    """Return the type of the messages of every topic in a bag.

    Args:
        path: A ``.bag`` file of ROS 1, or the folder of a bag of ROS 2.

    Raises:
        InputError: No bag, or the package rosbags is missing.
    """
    with _open_bag(path) as bag:
        return dict(sorted((one.topic, one.msgtype) for one in bag.connections))


@safe_reader("a bag of ROS 1 or ROS 2")
def read_topic(path: str | Path, topic: str, field: str) -> BagMessages:
    """Read one field of all messages of a topic, such as the samples of a radar.

    Radars have no common message, so name the field that holds the samples, and arrange them:
    ``ChirpData(messages.stacked().view(…), settings)``. What a DCA1000 sent as bytes goes into a
    ``.bin`` file, which ``read`` reads.

    Args:
        path: A ``.bag`` file of ROS 1, or the folder of a bag of ROS 2.
        topic: Its name.
        field: Its name; dots lead into messages within messages, such as ``"pose.position.x"``.

    Raises:
        InputError: No bag, no such topic or field, a field that is no array of numbers, or the
            package rosbags is missing.
    """
    found = list(_read_messages(path, topic, lambda message: _field_array(message, field)))
    times = torch.tensor([time for time, _ in found], dtype=torch.float64)
    return BagMessages(times, [value for _, value in found])


@safe_reader("a bag of ROS 1 or ROS 2")
def read_track(path: str | Path, topic: str) -> Track:
    """Read where something was over time, such as the radar, from messages that hold its pose.

    These are ``Odometry``, ``PoseStamped``, ``PoseWithCovarianceStamped``, ``TransformStamped`` and
    ``PointStamped``. Repeated times count once. Positions are as in the messages: bodies have x
    forward, y left, z up in ROS (REP 103), as radars have here.

    Args:
        path: A ``.bag`` file of ROS 1, or the folder of a bag of ROS 2.
        topic: Its name.

    Raises:
        InputError: No bag, no such topic, messages without a pose, or the package rosbags is
            missing.
    """

    def read_position(message: Any) -> list[float]:
        for name in _POSITION_FIELDS:
            with suppress(AttributeError):
                place = attrgetter(name)(message)
                return [place.x, place.y, place.z]
        raise refusal("bags.poses", topic, message.__msgtype__)

    found = dict(_read_messages(path, topic, read_position))
    times = sorted(found)
    places = torch.tensor([found[time] for time in times], dtype=torch.float64).reshape(-1, 3)
    return Track(torch.tensor(times, dtype=torch.float64), places)


@safe_reader("a bag of ROS 1 or ROS 2")
def read_clouds(path: str | Path, topic: str) -> list[dict[str, Float64[Tensor, " point"]]]:
    """Read all point clouds of a topic of ``sensor_msgs/PointCloud2``, along the axes of ROS, which
    are those of our radars.

    Args:
        path: A ``.bag`` file of ROS 1, or the folder of a bag of ROS 2.
        topic: Its name.

    Returns:
        For every message the values of each field by name, such as ``x``, ``y``, ``z`` and
        ``doppler``, one per point.

    Raises:
        InputError: No bag, no such topic, other messages, or the package rosbags is missing.
    """

    def parse_cloud(message: Any) -> dict[str, Tensor]:
        if not hasattr(message, "point_step"):
            raise refusal("bags.clouds", topic, message.__msgtype__)
        order = ">" if message.is_bigendian else "<"
        layout: Any = {
            "names": [one.name for one in message.fields],
            "formats": [order + _FIELD_TYPES[one.datatype] for one in message.fields],
            "offsets": [one.offset for one in message.fields],
            "itemsize": message.point_step,
        }
        rows = np.asarray(message.data, np.uint8).reshape(message.height, message.row_step)
        rows = np.ascontiguousarray(rows[:, : message.width * message.point_step])
        points = rows.reshape(-1).view(np.dtype(layout))
        names: list[str] = layout["names"]
        return {name: torch.from_numpy(points[name].astype(np.float64)) for name in names}

    return [one for _, one in _read_messages(path, topic, parse_cloud)]


@contextmanager
def _open_bag(path: str | Path) -> Iterator[Any]:
    """A bag that can be read."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise refusal("bags.package") from None
    stored = [file for end in _ENDINGS for file in Path(path).glob(f"*.{end}")]
    for file in stored or [path]:
        existing_file(file, "a bag of ROS")
    # Bags of ROS 2 need not say what their messages are made of.
    usual = get_typestore(Stores.LATEST)
    with AnyReader([Path(path)], default_typestore=usual) as bag:
        yield bag


def _read_messages(
    path: str | Path, topic: str, parse: Callable[[Any], Any]
) -> Iterator[tuple[float, Any]]:
    """Time of every message of a topic [s], and what a function makes of it."""
    with _open_bag(path) as bag:
        chosen = [one for one in bag.connections if one.topic == topic]
        if not chosen:
            known = ", ".join(sorted({one.topic for one in bag.connections})) or "none"
            raise InputError(f"expected a topic of the bag, got {topic!r}; it has {known}")
        for connection, recorded, raw in bag.messages(connections=chosen):
            message = bag.deserialize(raw, connection.msgtype)
            stamp = getattr(getattr(message, "header", None), "stamp", None)
            time = recorded * 1e-9 if stamp is None else stamp.sec + stamp.nanosec * 1e-9
            yield time, parse(message)


def _field_array(message: Any, field: str) -> NDArray[Any]:
    held = message
    for part in field.split("."):
        known = [name for name in getattr(held, "__dataclass_fields__", {}) if name[0] != "_"]
        check_choice(part, known, f"{field!r} to name fields among")
        held = getattr(held, part)
    value = np.asarray(held)
    if value.dtype.kind not in "iufb":
        raise refusal("bags.numbers", field, type(held).__name__)
    return value
