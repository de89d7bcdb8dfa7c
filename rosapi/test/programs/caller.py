# SPDX-License-Identifier: BSD-3-Clause
"""A ROS node that calls services through rospy as told by its standard input, a thread for each call.

A line in is a JSON object with id, service, type, fields (of the request) and persistent (whether the
connection is kept, so that it lasts while the master is away). The line out is a JSON object with that id,
the seconds that the call took, and either `response`, or `error` when the service failed with a reason. A
line in with a `clock` of seconds and nanoseconds publishes them as simulated time instead.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from typing import Any, Dict, List

import genpy
import rospy
from rosgraph_msgs.msg import Clock

from rosbridge_library.internal.ros_loader import get_service_class

_writing = threading.Lock()


def _plain(value: Any) -> Any:
    if isinstance(value, genpy.TVal):
        return {"secs": value.secs, "nsecs": value.nsecs}
    if isinstance(value, genpy.Message):
        return {name: _plain(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    return value


def _call(proxy: rospy.ServiceProxy, call_id: int, fields: List[Any]) -> None:
    begin = time.monotonic()
    answer: Dict[str, Any] = {"id": call_id}
    try:
        answer["response"] = _plain(proxy(*fields))
    except rospy.ServiceException as error:
        answer["error"] = str(error)
    answer["took"] = time.monotonic() - begin
    with _writing:
        print(json.dumps(answer), flush=True)


def main() -> None:
    rospy.init_node("caller", disable_signals=True)
    clock = rospy.Publisher("/clock", Clock, queue_size=1)
    kept: Dict[str, rospy.ServiceProxy] = {}
    for line in sys.stdin:
        asked = json.loads(line)
        if "clock" in asked:
            clock.publish(Clock(genpy.Time(*asked["clock"])))
            continue
        service = asked["service"]
        proxy = kept.get(service)
        if proxy is None:
            proxy = rospy.ServiceProxy(service, get_service_class(asked["type"]), asked["persistent"])
        if asked["persistent"]:
            kept[service] = proxy
        threading.Thread(target=_call, args=(proxy, asked["id"], asked["fields"]), daemon=True).start()


main()
