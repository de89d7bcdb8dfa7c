#!/usr/bin/env python3
# SPDX-License-Identifier: BSD-3-Clause
"""How fast the codecs are, against the straightforward way: genpy, recursive conversion, json or cbor2.

    benchmarks/codecs.py [--quick] [--json FILE] [NAME…]

For each message: microseconds of CPU time per conversion, and in brackets how many times faster that is than the
straightforward way of doing the same thing. NAMEs choose messages ("Path"). With --quick each conversion runs just a
few times: that shows that it works, not how fast it is. Nothing but the packages of the messages is needed: no ROS
master, no server.
"""

from __future__ import annotations

import argparse
import base64
import io
import json
import sys
import time
from typing import Any, Callable, Dict, Iterator, List, Optional, Sequence, Tuple

import cbor2
import numpy as np
from geometry_msgs.msg import Point, PoseStamped, TransformStamped, Twist, TwistStamped
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from sensor_msgs.msg import Image, JointState, LaserScan, PointCloud2, PointField
from std_msgs.msg import ColorRGBA, String
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker, MarkerArray

from rosbridge_library.codec import decode_json, get_message_type
from rosbridge_library.internal.ros_loader import get_message_class

COLUMNS = ("to_json", "to_cbor", "to_values", "from_json")


# The messages


def messages() -> Iterator[Tuple[str, Any]]:
    """Messages of realistic size and content, by name."""
    rng = np.random.default_rng(1)
    yield "String", String("The quick brown fox jumps over the lazy dog")
    yield "Twist", _randomized(Twist(), rng)
    yield "TwistStamped", _randomized(TwistStamped(), rng)
    odometry = _randomized(Odometry(), rng)
    odometry.pose.covariance = rng.normal(size=36).tolist()
    odometry.twist.covariance = rng.normal(size=36).tolist()
    yield "Odometry", odometry
    joints = _randomized(JointState(), rng)
    joints.name = [f"joint_{index}" for index in range(12)]
    joints.position, joints.velocity, joints.effort = rng.normal(size=(3, 12)).tolist()
    yield "JointState", joints
    yield "TFMessage 20", TFMessage([_randomized(TransformStamped(), rng) for _ in range(20)])
    yield "Path 500", Path(poses=[_randomized(PoseStamped(), rng) for _ in range(500)])
    markers = [_randomized(Marker(), rng) for _ in range(100)]
    for marker in markers:
        marker.points = [_randomized(Point(), rng) for _ in range(10)]
        marker.colors = [_randomized(ColorRGBA(), rng) for _ in range(10)]
    yield "MarkerArray 100", MarkerArray(markers)
    scan = _randomized(LaserScan(), rng)
    scan.ranges, scan.intensities = rng.uniform(0.1, 30, (2, 720)).astype("f4").tolist()
    yield "LaserScan 2x720", scan
    image = _randomized(Image(height=480, width=640, encoding="rgb8", step=1920), rng)
    image.data = rng.bytes(480 * 1920)
    yield "Image 640x480", image
    cloud = _randomized(PointCloud2(height=1, width=65536, point_step=16, row_step=1 << 20), rng)
    cloud.fields = [PointField(name, 4 * index, 7, 1) for index, name in enumerate("xyz")]
    cloud.data = rng.bytes(1 << 20)
    yield "PointCloud2 1 MiB", cloud
    grid = _randomized(OccupancyGrid(), rng)
    grid.data = rng.choice([-1, 0, 100, 50], 10**6).astype("i1").tolist()
    yield "OccupancyGrid 1M", grid


def _randomized(message: Any, rng: np.random.Generator) -> Any:
    """The message with numbers in its float fields, names in its strings, and the time in its stamps."""
    for name, declared in zip(message.__slots__, message._slot_types):
        value = getattr(message, name)
        if declared in ("float32", "float64"):
            number = rng.normal()
            setattr(message, name, float(np.float32(number)) if declared == "float32" else number)
        elif declared == "string" and not value:
            setattr(message, name, "base_footprint")
        elif declared == "time":
            value.secs, value.nsecs = 1700000000, 123456789
        elif "/" in declared and "[" not in declared:
            _randomized(value, rng)
    return message


# The straightforward way


def recursive_values(message: Any, binary: Callable[[bytes], Any]) -> Dict[str, Any]:
    """A message as nested dictionaries, by its slots."""
    values = {}
    for name, declared in zip(message.__slots__, message._slot_types):
        values[name] = _recursive_value(getattr(message, name), declared, binary)
    return values


def _recursive_value(value: Any, declared: str, binary: Callable[[bytes], Any]) -> Any:
    base = declared.split("[")[0]
    if declared in ("time", "duration"):
        return {"secs": value.secs, "nsecs": value.nsecs}
    if "[" in declared:
        if base in ("uint8", "char"):
            return binary(bytes(value))
        return [_recursive_value(item, base, binary) for item in value]
    return recursive_values(value, binary) if "/" in declared else value


def populate(message: Any, values: Dict[str, Any]) -> Any:
    """Fill a message from nested dictionaries, by its slots."""
    for name, declared in zip(message.__slots__, message._slot_types):
        setattr(message, name, _populated(declared, getattr(message, name), values[name]))
    return message


def _populated(declared: str, current: Any, value: Any) -> Any:
    base, _, array = declared.partition("[")
    if array and base in ("uint8", "char"):
        return base64.b64decode(value)
    if array and "/" in base:
        return [populate(get_message_class(base)(), item) for item in value]
    if declared in ("time", "duration"):
        current.secs, current.nsecs = value["secs"], value["nsecs"]
        return current
    return populate(current, value) if "/" in declared else value


def straightforward(cls: Any) -> Dict[str, Callable[[Any], Any]]:
    def base64_text(raw: bytes) -> str:
        return base64.b64encode(raw).decode()

    def from_json(text: bytes) -> bytes:
        buffer = io.BytesIO()
        populate(cls(), json.loads(text)).serialize(buffer)
        return buffer.getvalue()

    return {
        "to_json": lambda wire: json.dumps(recursive_values(cls().deserialize(wire), base64_text)),
        "to_cbor": lambda wire: cbor2.dumps(recursive_values(cls().deserialize(wire), bytes)),
        "to_values": lambda wire: recursive_values(cls().deserialize(wire), bytes),
        "from_json": from_json,
    }


def compiled(name: str) -> Dict[str, Callable[[Any], Any]]:
    message_type = get_message_type(name)

    def from_json(text: bytes) -> bytes:
        return message_type.from_values(decode_json(text), lambda: (0, 0))[0]

    return {
        "to_json": message_type.to_json,
        "to_cbor": message_type.to_cbor,
        "to_values": message_type.to_values,
        "from_json": from_json,
    }


# Measuring


def best_us(function: Callable[[Any], Any], argument: Any, seconds: float) -> float:
    """Microseconds of CPU time per call: the best of several rounds, so that other load counts little."""
    function(argument)
    begin = time.process_time()
    function(argument)
    once = max(time.process_time() - begin, 1e-7)
    rounds = 5 if seconds else 1
    calls = max(1, int(seconds / rounds / once))
    best = float("inf")
    for _ in range(rounds):
        begin = time.process_time()
        for _ in range(calls):
            function(argument)
        best = min(best, (time.process_time() - begin) / calls)
    return best * 1e6


def measure(name: str, message: Any, seconds: float) -> Dict[str, Any]:
    buffer = io.BytesIO()
    message.serialize(buffer)
    wire = buffer.getvalue()
    ours, theirs = compiled(message._type), straightforward(type(message))
    text = ours["to_json"](wire)
    if ours["from_json"](text) != wire:
        raise AssertionError(f"{name} does not come back from JSON")
    row: Dict[str, Any] = {"message": name, "bytes": len(wire)}
    for column in COLUMNS:
        argument = text if column == "from_json" else wire
        us = best_us(ours[column], argument, seconds)
        row[column] = {"us": us, "times_faster": best_us(theirs[column], argument, seconds) / us}
    return row


def main(arguments: Optional[Sequence[str]] = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="measure only messages whose name contains this")
    parser.add_argument("--quick", action="store_true", help="a few calls of each: a test that it works")
    parser.add_argument("--json", metavar="FILE", help="write the figures to this file, too")
    options = parser.parse_args(arguments)
    rows: List[Dict[str, Any]] = []
    print("%-18s %9s" % ("message", "bytes") + "".join([f"{column:>19}" for column in COLUMNS]))
    for name, message in messages():
        if options.names and not any(part.lower() in name.lower() for part in options.names):
            continue
        row = measure(name, message, 0.0 if options.quick else 0.3)
        rows.append(row)
        cells = ["{us:10.1f} ({times_faster:5.1f}x)".format(**row[column]) for column in COLUMNS]
        print(f"{name:18} {row['bytes']:9}" + "".join([f"{cell:>19}" for cell in cells]), flush=True)
    if options.json:
        with open(options.json, "w") as file:
            json.dump(rows, file, indent=1)
    return 0


if __name__ == "__main__":
    sys.exit(main())
