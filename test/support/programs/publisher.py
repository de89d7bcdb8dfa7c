# SPDX-License-Identifier: BSD-3-Clause
"""Publishes one message again and again; see support.node.publish."""

from __future__ import annotations

import itertools
import time

import roslib.message
import rospy

from programs.program import fill, options, ready, say, stay


def main() -> None:
    wanted = options()
    rospy.init_node("publisher")
    message_class = roslib.message.get_message_class(wanted["kind"])
    publisher = rospy.Publisher(wanted["topic"], message_class, latch=wanted["latch"], queue_size=0)  # 0: no bound
    ready()
    while publisher.get_num_connections() < wanted["subscribers"] and not rospy.is_shutdown():
        time.sleep(0.01)
    message = fill(message_class(), wanted["message"])
    begin = time.monotonic()
    for number in itertools.count() if not wanted["count"] else range(wanted["count"]):
        if wanted["counter"]:
            is_text = isinstance(getattr(message, wanted["counter"]), str)
            setattr(message, wanted["counter"], str(number) if is_text else number)
        if rospy.is_shutdown():
            return
        publisher.publish(message)
        if wanted["rate"]:
            time.sleep(max(0.0, begin + (number + 1) / wanted["rate"] - time.monotonic()))
    say(done=wanted["count"])
    stay()


if __name__ == "__main__":
    main()
