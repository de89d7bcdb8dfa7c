# SPDX-License-Identifier: BSD-3-Clause
"""The loads: one message of each kind, serialized once, into which the time of sending is patched each time.

That makes publishing nearly free, so that on a small machine the server under test is what is measured. Nearly every
message has a header, whose stamp is the time of sending; std_msgs/String has none and carries the time as text.
"""

from __future__ import annotations

import functools
import importlib
import io
import math
import random
import struct
from typing import Any, Callable, Dict, List, NamedTuple, Sequence

_SEQ_AND_STAMP = struct.Struct("<III")
_LENGTH = struct.Struct("<I")
TEXT_MARK = b"stamp "
"""What stands before the time in the text of a message without header: `stamp 1700000000.123456789`."""


class Load(NamedTuple):
    """Messages of one kind, at one rate."""

    name: str
    type: str
    rate_hz: float
    make: Callable[[], Any]
    """The message, of the generated class."""


class Template:
    """The bytes of a message as TCPROS sends it, length first, with a place for the time."""

    def __init__(self, load: Load) -> None:
        message = load.make()
        body = io.BytesIO()
        message.serialize(body)
        self.frame = bytearray(_LENGTH.pack(body.tell()) + body.getvalue())
        self.body = memoryview(self.frame)[_LENGTH.size :]
        self.in_text = TEXT_MARK in body.getvalue()
        self.stamp_offset = stamp_offset(load)
        """Where in the body the stamp (of a header: its secs) begins."""

    def stamp(self, seq: int, time_ns: int) -> None:
        """Writes the time into the frame."""
        secs, nsecs = divmod(time_ns, 10**9)
        at = _LENGTH.size + self.stamp_offset
        if self.in_text:
            self.frame[at : at + 20] = b"%010d.%09d" % (secs, nsecs)
        else:
            _SEQ_AND_STAMP.pack_into(self.frame, at - 4, seq & 0xFFFFFFFF, secs, nsecs)


def message_class(type_name: str) -> Any:
    """The generated class of `geometry_msgs/Twist`."""
    package, name = type_name.split("/")
    return getattr(importlib.import_module(package + ".msg"), name)


def stamp_offset(load: Load) -> int:
    """Where on the wire the first stamp of a load's messages begins."""
    if load.type == "std_msgs/String":
        return _LENGTH.size + len(TEXT_MARK)
    first = message_class(load.type)._slot_types[0]
    if first == "std_msgs/Header":
        return 4  # behind seq
    if first.endswith("[]"):  # of messages with a header: behind their number and seq
        return 8
    raise ValueError(f"{load.type} has no stamp near its begin")


def _new(type_name: str, **fields: Any) -> Any:
    return message_class(type_name)(**fields)


def _header(frame_id: str = "base_link") -> Any:
    return _new("std_msgs/Header", frame_id=frame_id)


def _numbers(count: int, low: float = -1.0, high: float = 1.0) -> List[float]:
    generator = random.Random(count)
    return [generator.uniform(low, high) for _ in range(count)]


def _bytes(count: int) -> bytes:
    return random.Random(count).getrandbits(8 * count).to_bytes(count, "little")


def _vector(values: Sequence[float]) -> Any:
    return _new("geometry_msgs/Vector3", x=values[0], y=values[1], z=values[2])


def _pose(values: Sequence[float]) -> Any:
    x, y, yaw = values[0], values[1], values[2] * math.pi
    return _new(
        "geometry_msgs/Pose",
        position=_new("geometry_msgs/Point", x=x, y=y, z=0.0),
        orientation=_new("geometry_msgs/Quaternion", x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2)),
    )


def _twist(values: Sequence[float]) -> Any:
    return _new("geometry_msgs/Twist", linear=_vector(values[:3]), angular=_vector(values[3:]))


def _twist_stamped() -> Any:
    return _new("geometry_msgs/TwistStamped", header=_header(), twist=_twist(_numbers(6)))


def _odometry() -> Any:
    covariance = _numbers(36)
    return _new(
        "nav_msgs/Odometry",
        header=_header("odom"),
        child_frame_id="base_link",
        pose=_new("geometry_msgs/PoseWithCovariance", pose=_pose(_numbers(3)), covariance=covariance),
        twist=_new("geometry_msgs/TwistWithCovariance", twist=_twist(_numbers(6)), covariance=covariance),
    )


def _laser_scan() -> Any:
    return _new(
        "sensor_msgs/LaserScan",
        header=_header("laser"),
        angle_min=-math.pi,
        angle_max=math.pi,
        angle_increment=math.pi / 360,
        range_max=30.0,
        ranges=_numbers(720, 0.1, 30.0),
        intensities=_numbers(720, 0.0, 255.0),
    )


def _image() -> Any:
    return _new(
        "sensor_msgs/Image",
        header=_header("camera"),
        height=480,
        width=640,
        encoding="rgb8",
        step=3 * 640,
        data=_bytes(3 * 640 * 480),
    )


def _compressed_image() -> Any:
    return _new("sensor_msgs/CompressedImage", header=_header("camera"), format="jpeg", data=_bytes(50_000))


def _point_cloud() -> Any:
    points, step = 65536, 16
    fields = [
        _new("sensor_msgs/PointField", name=name, offset=4 * index, datatype=7, count=1)
        for index, name in enumerate(("x", "y", "z", "intensity"))
    ]
    return _new(
        "sensor_msgs/PointCloud2",
        header=_header("lidar"),
        height=1,
        width=points,
        fields=fields,
        point_step=step,
        row_step=step * points,
        data=_bytes(step * points),
        is_dense=True,
    )


def _tf() -> Any:
    transforms = []
    for index in range(20):
        pose = _pose(_numbers(3 + index))
        transform = _new("geometry_msgs/Transform", rotation=pose.orientation)
        transform.translation.x, transform.translation.y = pose.position.x, pose.position.y
        transforms.append(
            _new(
                "geometry_msgs/TransformStamped",
                header=_header(f"link_{index}"),
                child_frame_id=f"link_{index + 1}",
                transform=transform,
            )
        )
    return _new("tf2_msgs/TFMessage", transforms=transforms)


def _joint_state() -> Any:
    values = _numbers(30)
    names = [f"joint_{index}" for index in range(30)]
    return _new("sensor_msgs/JointState", header=_header(), name=names, position=values, velocity=values, effort=values)


def _path() -> Any:
    poses = [_new("geometry_msgs/PoseStamped", header=_header("map"), pose=_pose(_numbers(3 + i))) for i in range(500)]
    return _new("nav_msgs/Path", header=_header("map"), poses=poses)


def _marker_array() -> Any:
    markers = []
    for index in range(100):
        marker = _new("visualization_msgs/Marker", header=_header("map"), ns="obstacles", id=index, type=2)
        marker.pose = _pose(_numbers(3 + index))
        marker.scale = _vector(_numbers(3, 0.1, 1.0))
        marker.color.r = marker.color.a = 1.0
        markers.append(marker)
    return _new("visualization_msgs/MarkerArray", markers=markers)


def _occupancy_grid() -> Any:
    generator = random.Random(1)
    cells = [generator.choice((-1, 0, 0, 0, 100)) for _ in range(1000 * 1000)]
    grid = _new("nav_msgs/OccupancyGrid", header=_header("map"), data=cells)
    grid.info.width = grid.info.height = 1000
    grid.info.resolution = 0.05
    return grid


def _string() -> Any:
    return _new("std_msgs/String", data=TEXT_MARK.decode() + 20 * "0" + " The quick brown fox jumps over the lazy dog.")


LOADS: Dict[str, Load] = {
    load.name: load
    for load in (
        Load("twist2000", "geometry_msgs/TwistStamped", 2000.0, _twist_stamped),
        Load("twist6000", "geometry_msgs/TwistStamped", 6000.0, _twist_stamped),
        Load("odometry", "nav_msgs/Odometry", 1000.0, _odometry),
        Load("scan", "sensor_msgs/LaserScan", 300.0, _laser_scan),
        Load("image", "sensor_msgs/Image", 30.0, _image),
        Load("cloud", "sensor_msgs/PointCloud2", 30.0, _point_cloud),
        Load("tf", "tf2_msgs/TFMessage", 200.0, _tf),
        Load("joints", "sensor_msgs/JointState", 500.0, _joint_state),
        Load("path", "nav_msgs/Path", 20.0, _path),
        Load("markers", "visualization_msgs/MarkerArray", 20.0, _marker_array),
        Load("map", "nav_msgs/OccupancyGrid", 5.0, _occupancy_grid),
        Load("jpeg", "sensor_msgs/CompressedImage", 30.0, _compressed_image),
        Load("string", "std_msgs/String", 1000.0, _string),
    )
}


@functools.lru_cache(maxsize=None)
def message_bytes(load_name: str) -> int:
    """The size of a load's message on the ROS wire, without its length."""
    return len(Template(LOADS[load_name]).body)
