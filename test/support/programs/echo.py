# SPDX-License-Identifier: BSD-3-Clause
"""Subscribes and writes each message; see support.node.echo."""

from __future__ import annotations

import roslib.message
import rospy

from programs.program import options, plain, ready, say, stay


def main() -> None:
    wanted = options()
    rospy.init_node("echo")
    message_class = roslib.message.get_message_class(wanted["kind"])
    rospy.Subscriber(wanted["topic"], message_class, lambda message: say(message=plain(message)))
    ready()
    stay()


if __name__ == "__main__":
    main()
