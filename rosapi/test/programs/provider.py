# SPDX-License-Identifier: BSD-3-Clause
"""A ROS node with /live/empty, and /live/trigger_0 … of std_srvs/Trigger, as many as its argument says.

It also subscribes to /live/any with no type of its own, as recording tools do.
"""

from __future__ import annotations

import sys

import rospy
from std_srvs.srv import Empty, EmptyResponse, Trigger, TriggerResponse


def main() -> None:
    rospy.init_node("live")
    rospy.Subscriber("/live/any", rospy.AnyMsg, lambda message: None)
    for index in range(int(rospy.myargv(sys.argv)[1])):
        rospy.Service(f"/live/trigger_{index}", Trigger, lambda request: TriggerResponse(True, ""))
    rospy.Service("/live/empty", Empty, lambda request: EmptyResponse())
    print("all services are up", flush=True)
    rospy.spin()


main()
