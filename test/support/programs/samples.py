# SPDX-License-Identifier: BSD-3-Clause
"""One message of each kind that encodings treat differently: the robot publishes them, the tests expect them.

`seq` is 1 throughout, since each is published once. Values are exact in the type that carries them.
"""

from __future__ import annotations

from typing import Any, Dict

import genpy
from geometry_msgs.msg import Point, Quaternion, Transform, TransformStamped, Vector3
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Image, JointState, LaserScan, PointCloud2, PointField
from std_msgs.msg import (
    Duration,
    Header,
    Int64,
    Int64MultiArray,
    MultiArrayDimension,
    MultiArrayLayout,
    String,
    UInt16MultiArray,
)
from tf2_msgs.msg import TFMessage

LARGEST_EXACT = 2**53 - 1
"""The largest integer that every integer below is exact beside, in JavaScript."""

TEXT = 'Grüße, 世界 🤖 "quoted" \\ \n\t\x01'


def samples() -> Dict[str, Any]:
    """The messages, by a name for each."""
    header = Header(seq=1, stamp=genpy.Time(1700000000, 123456789), frame_id="base")
    pose = {"position": Point(1.5, -2.25, 1e-300), "orientation": Quaternion(0.0, 0.0, 0.6, -0.8)}
    odometry = Odometry(header=header, child_frame_id="wheels")
    odometry.pose.pose.position, odometry.pose.pose.orientation = pose["position"], pose["orientation"]
    odometry.pose.covariance = [index / 4 for index in range(36)]
    odometry.twist.twist.linear.x = float("-inf")
    return {
        "text": String(TEXT),
        "int64": Int64(-LARGEST_EXACT),
        "int64s": Int64MultiArray(
            MultiArrayLayout([MultiArrayDimension("rows", 2, 4)], 0), [LARGEST_EXACT, -LARGEST_EXACT, 0, -1]
        ),
        "uint16s": UInt16MultiArray(data=[0, 1, 65535]),
        "duration": Duration(genpy.Duration(-2, 999999999)),
        "scan": LaserScan(
            header=header, range_max=8.5, ranges=[0.5, float("nan"), float("inf"), 2.0**-20], intensities=[]
        ),
        "odometry": odometry,
        "joints": JointState(header=header, name=["left", "right"], position=[0.1, float("nan")]),
        "image": Image(
            header=header, height=2, width=3, encoding="mono8", step=3, data=bytes([0, 1, 127, 128, 254, 255])
        ),
        "cloud": PointCloud2(
            header=header,
            height=1,
            width=1024,
            fields=[PointField("x", 0, PointField.FLOAT32, 1), PointField("y", 4, PointField.FLOAT32, 1)],
            point_step=8,
            row_step=8192,
            data=bytes(index % 251 for index in range(8192)),
            is_dense=True,
        ),
        "transforms": TFMessage(
            [
                TransformStamped(header, f"child{number}", Transform(Vector3(number, 0, 0), Quaternion(0, 0, 0, 1)))
                for number in range(3)
            ]
        ),
    }
