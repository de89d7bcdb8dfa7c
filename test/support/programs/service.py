# SPDX-License-Identifier: BSD-3-Clause
"""Provides a service that answers, or fails in one of several ways; see support.node.serve."""

from __future__ import annotations

import os
import socket
import time
from typing import Any

import rosgraph
import roslib.message
import rospy

from programs.program import fill, options, plain, ready, say, stay


def register_deaf(service: str) -> socket.socket:
    """Registers the service at a socket that takes connections and then says nothing; the socket."""
    deaf = socket.create_server(("127.0.0.1", 0))
    uri = f"rosrpc://127.0.0.1:{deaf.getsockname()[1]}"
    rosgraph.Master(rospy.get_name()).registerService(service, uri, rospy.get_node_uri())
    return deaf


def main() -> None:
    wanted = options()
    rospy.init_node("provider")
    service_class = roslib.message.get_service_class(wanted["kind"])

    def handle(request: Any) -> Any:
        say(request=plain(request))
        if wanted["behaviour"] == "die":
            os._exit(1)
        if wanted["behaviour"] == "fail":
            raise rospy.ServiceException("it failed, as asked")
        if wanted["behaviour"] == "hang":
            rospy.rostime.wallsleep(1e9)
        time.sleep(wanted["delay"])
        response = service_class._response_class()
        if wanted["response"] is None:
            response.sum = request.a + request.b
            return response
        return fill(response, wanted["response"])

    if wanted["behaviour"] == "deaf":
        service: Any = register_deaf(rospy.resolve_name(wanted["service"]))
    else:
        service = rospy.Service(wanted["service"], service_class, handle)
    ready()
    stay()
    del service


if __name__ == "__main__":
    main()
