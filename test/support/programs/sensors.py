# SPDX-License-Identifier: BSD-3-Clause
"""A robot's sensors: an image topic, a state topic, and a latched map; see support.viewer.sensors."""

from __future__ import annotations

import threading
import time
from typing import Any, Callable

import rospy
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import OccupancyGrid
from sensor_msgs.msg import Image

from programs.program import options, ready, stay


def repeat(rate: float, publish: Callable[[], None]) -> None:
    """Calls `publish` so many times a second, in a thread of its own."""

    def run() -> None:
        due = time.monotonic()
        while not rospy.is_shutdown():
            publish()
            due = max(due + 1 / rate, time.monotonic() - 1 / rate)
            time.sleep(max(0.0, due - time.monotonic()))

    threading.Thread(target=run, daemon=True).start()


def stamped(publisher: rospy.Publisher, message: Any) -> Callable[[], None]:
    def publish() -> None:
        message.header.stamp = rospy.Time.from_sec(time.time())
        publisher.publish(message)

    return publish


def main() -> None:
    wanted = options()
    rospy.init_node("sensors")
    if wanted["image_bytes"]:
        image = Image(height=1, width=wanted["image_bytes"], encoding="mono8", step=wanted["image_bytes"])
        image.data = bytes(range(256)) * (wanted["image_bytes"] // 256 + 1)
        image.data = image.data[: wanted["image_bytes"]]
        images = rospy.Publisher("/image", Image, queue_size=5, tcp_nodelay=True)
        repeat(wanted["image_rate"], stamped(images, image))
    states = rospy.Publisher("/state", TwistStamped, queue_size=50, tcp_nodelay=True)
    repeat(wanted["state_rate"], stamped(states, TwistStamped()))
    if wanted["map_bytes"]:
        grid = OccupancyGrid(data=[0] * wanted["map_bytes"])
        maps = rospy.Publisher("/map", OccupancyGrid, queue_size=1, latch=True)
        maps.publish(grid)
    ready()
    stay()


if __name__ == "__main__":
    main()
