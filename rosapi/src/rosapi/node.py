# SPDX-License-Identifier: BSD-3-Clause
"""The node `rosapi`: serves what `rosapi.api` answers as ROS services, until it is told to leave.

Its services are private names, so that they are /rosapi/topics and so on for the node's usual name, and each
robot's own when it runs in a namespace. rospy runs each request in a thread.
"""

from __future__ import annotations

import logging
import os
import signal
import threading
from functools import partial
from typing import Any, Callable, Dict, Optional, TypeVar

import rospy
from rospy.impl.tcpros_base import init_tcpros_server

from rosapi import msg, srv
from rosapi.api import Api, Response
from rosapi.service_types import probe_types
from rosapi.service_uris import look_up_services
from rosbridge_library.access import Access
from rosbridge_library.internal.exceptions import RosbridgeError
from rosbridge_library.ros.master import Master, MasterUnreachable
from rosbridge_library.ros.registrar import Registrar

logger = logging.getLogger("rosbridge.rosapi")

SERVICES: Dict[str, Any] = {
    "action_servers": srv.GetActionServers,
    "delete_param": srv.DeleteParam,
    "get_param": srv.GetParam,
    "get_param_names": srv.GetParamNames,
    "get_time": srv.GetTime,
    "has_param": srv.HasParam,
    "message_details": srv.MessageDetails,
    "node_details": srv.NodeDetails,
    "nodes": srv.Nodes,
    "publishers": srv.Publishers,
    "search_param": srv.SearchParam,
    "service_host": srv.ServiceHost,
    "service_node": srv.ServiceNode,
    "service_providers": srv.ServiceProviders,
    "service_request_details": srv.ServiceRequestDetails,
    "service_response_details": srv.ServiceResponseDetails,
    "service_type": srv.ServiceType,
    "services": srv.Services,
    "services_for_type": srv.ServicesForType,
    "set_param": srv.SetParam,
    "subscribers": srv.Subscribers,
    "topic_type": srv.TopicType,
    "topics": srv.Topics,
    "topics_and_raw_types": srv.TopicsAndRawTypes,
    "topics_for_type": srv.TopicsForType,
}

GLOB_KINDS = ("topics", "services", "params")

# A leaving node tells the master. One that hangs is waited for no longer than this.
LEAVE_WITHIN_S = 2.0

MASTER_RETRY_S = 1.0

# Each request of each web client is a connection; all pages that show a robot may load at once.
WAITING_CONNECTIONS = 512

T = TypeVar("T")


def main() -> int:
    """Run the node until SIGINT or SIGTERM. Returns the exit code of the process."""
    _log_to_stderr()
    leaving = threading.Event()
    rospy.on_shutdown(_leave_soon)
    rospy.on_shutdown(leaving.set)

    def leave(number: int, frame: Any) -> None:
        _leave_soon()
        leaving.set()
        if not rospy.core.is_initialized():
            rospy.signal_shutdown(f"signal {number}")  # or else init_node goes on waiting for the master

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, leave)
    try:
        _start(leaving)
    except (_ToldToLeave, rospy.ROSInitException) as error:
        if not leaving.is_set():
            logger.error("can't start: %s", error)
            return 1
    leaving.wait()
    rospy.signal_shutdown("told to leave")
    while not rospy.is_shutdown():  # another thread is about it, because a node of the same name has started
        rospy.rostime.wallsleep(0.05)
    return 0


def _start(leaving: threading.Event) -> None:
    """Wait for the master, and offer all services. Raises ROSInitException, and _ToldToLeave when that comes first."""
    _patiently(lambda: Master("/rosapi").call("getPid"), leaving)
    rospy.init_node("rosapi", disable_signals=True)
    master = Master(rospy.get_name())
    access = _patiently(lambda: read_access(master), leaving)
    look_up = partial(look_up_services, master)
    probe = partial(probe_types, master.caller_id)
    api = Api(master.call, look_up, probe, rospy.Time.now, access)
    for name, service_type in SERVICES.items():
        if leaving.is_set():
            raise _ToldToLeave
        rospy.Service("~" + name, service_type, handler(getattr(api, name), service_type))
    _accept_bursts()
    registrar = Registrar(master)  # last: what it finds registered, it registers again when the master has lost it
    registrar.install()
    rospy.on_shutdown(registrar.close)
    logger.info("serving at %s", master.caller_id)


def handler(answer: Callable[..., Response], service_type: Any) -> Callable[[Any], Any]:
    """A rospy service handler: the request's fields to `answer`, what it returns to the response's fields."""

    def handle(request: Any) -> Any:
        try:
            fields = answer(*(getattr(request, field) for field in request.__slots__))
        except RosbridgeError as error:
            raise rospy.ServiceException(str(error)) from error
        if "typedefs" in fields:
            fields["typedefs"] = [msg.TypeDef(*typedef) for typedef in fields["typedefs"]]
        return service_type._response_class(**fields)

    return handle


def read_access(master: Master) -> Access:
    """What the private parameters topics_glob … params_glob allow. Raises MasterUnreachable."""
    return Access.from_parameters(*(_read_glob(master, f"{master.caller_id}/{kind}_glob") for kind in GLOB_KINDS))


def _read_glob(master: Master, name: str) -> Optional[str]:
    if not master.call("hasParam", name):
        return None
    value = master.call("getParam", name)
    # `_topics_glob:="[/a, /b]"` on the command line is YAML, and so a list by the time it is a parameter.
    return ",".join(str(each) for each in value) if isinstance(value, list) else str(value)


def _patiently(ask: Callable[[], T], leaving: threading.Event) -> T:
    """What `ask` gives once the master answers. Raises _ToldToLeave."""
    told = False
    while not leaving.is_set():
        try:
            return ask()
        except MasterUnreachable as error:
            if not told:
                logger.warning("%s; waiting for it", error)
            told = True
            leaving.wait(MASTER_RETRY_S)
    raise _ToldToLeave


class _ToldToLeave(Exception):
    """A signal came before the node was up."""


def _accept_bursts() -> None:
    """Let many connections wait to be accepted: beyond rospy's five, the kernel drops one, and TCP takes a second."""
    init_tcpros_server().tcp_ros_server.server_sock.listen(WAITING_CONNECTIONS)


def _leave_soon() -> None:
    """End the process, whatever still waits for a peer that hangs."""
    watchdog = threading.Timer(LEAVE_WITHIN_S, os._exit, [0])
    watchdog.daemon = True
    watchdog.start()


def _log_to_stderr() -> None:
    """rospy sets up its own loggers only. Not /rosout: for that, rospy asks the master, maybe for ever."""
    stream = logging.StreamHandler()
    stream.setFormatter(logging.Formatter("[%(levelname)s] [%(created).3f] %(name)s: %(message)s"))
    logging.getLogger("rosbridge").addHandler(stream)
    logging.getLogger("rosbridge").setLevel(logging.INFO)
