# SPDX-License-Identifier: BSD-3-Clause
"""The old functions between dictionaries and message instances."""

from __future__ import annotations

import time
from typing import Any, Dict

import genpy
import pytest
from geometry_msgs.msg import PoseStamped, Twist
from sensor_msgs.msg import Image, LaserScan
from std_msgs.msg import Empty, Header, Int32, String
from std_srvs.srv import SetBoolRequest, SetBoolResponse

from rosbridge_library.internal.exceptions import RosbridgeError
from rosbridge_library.internal.message_conversion import (
    FieldTypeMismatchException,
    InvalidMessageException,
    NonexistentFieldException,
    extract_values,
    populate_instance,
)


def test_values_are_extracted_from_nested_messages() -> None:
    stamped = PoseStamped(header=Header(3, genpy.Time(1, 2), "map"))
    stamped.pose.position.x = 1.5
    point = {"x": 1.5, "y": 0.0, "z": 0.0}
    rotation = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 0.0}
    assert extract_values(stamped) == {
        "header": {"seq": 3, "stamp": {"secs": 1, "nsecs": 2}, "frame_id": "map"},
        "pose": {"position": point, "orientation": rotation},
    }


def test_binary_data_is_extracted_as_bytes_and_numbers_as_lists() -> None:
    assert extract_values(Image(data=b"\x00\xff"))["data"] == b"\x00\xff"
    assert extract_values(LaserScan(ranges=[0.5, 2.0]))["ranges"] == [0.5, 2.0]


@pytest.mark.parametrize(
    ("instance", "values"),
    [
        (Int32(), {"data": -4}),
        (String(), {"data": "grün"}),
        (Empty(), {}),
        (SetBoolRequest(), {"data": True}),
        (SetBoolResponse(), {"success": True, "message": "done"}),
        (Twist(), {"linear": {"x": 1.0, "y": 2.0, "z": 3.0}, "angular": {"x": 4.0, "y": 5.0, "z": 6.0}}),
    ],
    ids=lambda part: type(part).__name__,
)
def test_values_come_back(instance: Any, values: Dict[str, Any]) -> None:
    populated = populate_instance(values, instance)
    assert populated is instance
    assert extract_values(populated) == values


def test_fields_that_are_not_given_stay() -> None:
    twist = Twist()
    twist.linear.y = 2.0
    twist.angular.z = 3.0
    populate_instance({"linear": {"x": 1}}, twist)
    assert (twist.linear.x, twist.linear.y, twist.angular.z) == (1.0, 2.0, 3.0)


def test_a_header_without_stamp_gets_the_time() -> None:
    before = time.time()
    stamped = populate_instance({"header": {"frame_id": "odom"}}, PoseStamped())
    assert before - 1 < stamped.header.stamp.to_sec() <= time.time()
    assert stamped.header.frame_id == "odom"
    now = populate_instance({"header": {"stamp": "now"}}, PoseStamped())
    assert before - 1 < now.header.stamp.to_sec() <= time.time()
    given = populate_instance({"header": {"stamp": {"secs": 5, "nsecs": 6}}}, PoseStamped())
    assert given.header.stamp == genpy.Time(5, 6)


def test_binary_data_is_taken_as_base64_numbers_and_bytes() -> None:
    for data in ("AP8=", [0, 255], b"\x00\xff"):
        assert populate_instance({"data": data}, Image()).data == b"\x00\xff"


def test_errors_name_the_field() -> None:
    with pytest.raises(FieldTypeMismatchException, match=r"pose\.position\.x.*'far'"):
        populate_instance({"pose": {"position": {"x": "far"}}}, PoseStamped())
    with pytest.raises(FieldTypeMismatchException, match="pose"):
        populate_instance({"pose": 3}, PoseStamped())
    with pytest.raises(NonexistentFieldException, match=r"pose\.place"):
        populate_instance({"pose": {"place": {}}}, PoseStamped())


@pytest.mark.parametrize("thing", [3, None, {"data": 1}, genpy.Time(1, 2)])
def test_what_is_no_message_is_refused(thing: Any) -> None:
    with pytest.raises(InvalidMessageException):
        extract_values(thing)
    with pytest.raises(InvalidMessageException):
        populate_instance({}, thing)
    assert issubclass(InvalidMessageException, RosbridgeError)
