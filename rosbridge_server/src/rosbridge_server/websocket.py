# SPDX-License-Identifier: BSD-3-Clause
"""The executable ``rosbridge_websocket``: starts the node and the server, and ends them within three seconds.

It ends on SIGINT, on SIGTERM, and when ROS tells the node to (``rosnode kill``). Whatever hangs then (a
client that does not read, a master that does not answer, a service call in a thread) is not waited for. The
exit code is 0 when it was told to end, 1 when it can't serve, 2 for a command line that makes no sense.
"""

from __future__ import annotations

import asyncio
import dataclasses
import gc
import logging
import os
import resource
import signal
import sys
import threading
from typing import TYPE_CHECKING, Any, Dict, List, Mapping, Optional, Set

from rosbridge_server.settings import Settings, SettingsError, help_text, load, read_flags, usage

if TYPE_CHECKING:
    from rosbridge_library.payload import Outbox
    from rosbridge_library.ros.node import Node
    from rosbridge_server.server import WebSocketServer

logger = logging.getLogger("rosbridge.websocket")

_NAME = "rosbridge_websocket"

# How long each step of the end may take, in seconds; all together at most the last one.
_CLIENTS_S, _ROS_S, _ALL_S = 0.5, 1.5, 2.5

_GC_THRESHOLD = 20_000

_ROS_MODULES = ("genpy", "rosgraph", "rosgraph_msgs", "roslib", "rospkg", "rospy", "std_msgs")
_OWN_MODULES = ("rosbridge_library", "rosbridge_msgs", "rosbridge_server")
_PIP_NAMES = {"png": "pypng", "bson": "pymongo"}


def main(argv: Optional[List[str]] = None) -> int:
    """Runs the server until it is told to end. ``argv`` are the arguments after the program's name."""
    arguments = sys.argv[1:] if argv is None else argv
    if "--help" in arguments or "-h" in arguments:
        print(help_text(Settings, _NAME))
        return 0
    try:
        flags = read_flags(Settings, arguments)
    except SettingsError as error:
        print(f"{_NAME}: {error}\n{usage(_NAME)}", file=sys.stderr)
        return 2
    # Until the loop takes the signals over, both end a start that may wait for a master for ever.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    try:
        return _run(flags)
    except ModuleNotFoundError as error:
        print(f"{_NAME}: {_remedy(error)}", file=sys.stderr)
        return _leave(1)
    except KeyboardInterrupt:
        sys.stdout.flush()
        os._exit(0)  # rospy's threads would go on waiting for the master


def _run(flags: Mapping[str, Any]) -> int:
    import rosgraph
    import rospy

    # All that is needed, so that a package which is missing is told at once, and not when a master has come.
    import rosbridge_library.foxglove.server
    import rosbridge_library.rosbridge_protocol  # noqa: F401
    import rosbridge_server.clients
    import rosbridge_server.server  # noqa: F401
    from rosbridge_server.logs import route_to_ros

    if not rosgraph.is_master_online():
        print(f"{_NAME}: waiting for the ROS master at {rosgraph.get_master_uri()}", file=sys.stderr, flush=True)
    try:
        rospy.init_node(_NAME, disable_signals=True)
    except rospy.ROSException as error:
        print(f"{_NAME}: {error}", file=sys.stderr)
        return _leave(1)
    _raise_file_limit()
    stop_logging = route_to_ros()
    try:
        settings = load(Settings, rospy.get_param(rospy.get_name(), {}), flags)
        if settings.authenticate:
            raise SettingsError(
                "authenticate is true, but this server can't authenticate clients yet: not serving open"
            )
        loop = asyncio.new_event_loop()
        asyncio.set_event_loop(loop)
        code = loop.run_until_complete(_serve(settings))
    except SettingsError as error:
        logger.critical("%s", error)
        code = 1
    except Exception:
        logger.exception("The server ends because of an internal error")
        code = 1
    finally:
        stop_logging()
    return _leave(code)


async def _serve(settings: Settings) -> int:
    import rospy

    from rosbridge_library.access import Access
    from rosbridge_library.ros.node import Node
    from rosbridge_server.server import ListenError

    loop = asyncio.get_event_loop()
    told_to_end: asyncio.Future[str] = loop.create_future()

    def end(reason: str) -> None:
        if not told_to_end.done():
            told_to_end.set_result(reason)
            _exit_in(_ALL_S, 0)

    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, end, number.name)
    rospy.on_shutdown(lambda: loop.call_soon_threadsafe(end, "shut down through ROS"))
    ros_ended = threading.Event()
    rospy.core.add_shutdown_hook(lambda reason: ros_ended.set())  # the last one: rospy's own go before it

    access = Access.from_parameters(settings.topics_glob, settings.services_glob, settings.params_glob)
    node = Node(loop, access, settings.unregister_timeout)
    starting = loop.create_task(_start(settings, node))
    either: Set[asyncio.Future[Any]] = {starting, told_to_end}
    await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
    code = 0
    server: Optional[WebSocketServer] = None
    if starting.done():
        try:
            server = starting.result()
        except ListenError as error:
            logger.critical("%s", error)
            code = 1
        except Exception:
            if not rospy.is_shutdown():  # told to end while it started: no wonder then, whatever went wrong
                logger.exception("The server could not be started")
                code = 1
        else:
            logger.info("Shutting down: %s", await told_to_end)
    else:
        starting.cancel()
    await _end(server, node, ros_ended)
    return code


async def _start(settings: Settings, node: Node) -> WebSocketServer:
    import rospy

    from rosbridge_library.foxglove.messages import SUBPROTOCOLS
    from rosbridge_library.foxglove.options import Options
    from rosbridge_library.foxglove.server import FoxgloveServer
    from rosbridge_library.rosbridge_protocol import RosbridgeProtocol
    from rosbridge_server.clients import Clients
    from rosbridge_server.server import ProtocolFactory, WebSocketServer

    await node.start()
    # What is loaded by now stays, and JSON of large arrays of messages makes thousands of objects that die together:
    # the collector would look for cycles among them all the time, and find none.
    gc.freeze()
    gc.set_threshold(_GC_THRESHOLD)
    clients = await node.call(Clients, node.now)
    foxglove = FoxgloveServer(node, Options.from_mapping(dataclasses.asdict(settings)))
    await foxglove.start()

    def rosbridge(client_id: str, parameters: Mapping[str, Any], outbox: Outbox) -> RosbridgeProtocol:
        return RosbridgeProtocol(client_id, parameters=parameters, node=node, outbox=outbox)

    protocols: Dict[Optional[str], ProtocolFactory] = dict.fromkeys(SUBPROTOCOLS, foxglove.protocol)
    server = WebSocketServer(settings, {None: rosbridge, **protocols}, clients)
    await server.listen()
    await node.call(rospy.set_param, "~actual_port", server.port)
    logger.info("Rosbridge WebSocket server started at %s", server.url)
    return server


async def _end(server: Optional[WebSocketServer], node: Node, ros_ended: threading.Event) -> None:
    import rospy

    done = threading.Event()

    def end_ros() -> None:
        rospy.signal_shutdown("rosbridge_websocket ends")
        ros_ended.wait(_ROS_S)  # when ROS ended the node, another thread is at it
        done.set()

    if server is not None:
        server.close()
        await asyncio.wait([asyncio.ensure_future(server.closed())], timeout=_CLIENTS_S)
    await node.stop()
    # A thread that is a daemon, since a master that does not answer may hold it for as long as it likes.
    threading.Thread(target=end_ros, daemon=True).start()
    await asyncio.get_event_loop().run_in_executor(None, done.wait, _ROS_S)


def _leave(code: int) -> int:
    """The exit code; threads that don't end are not waited for."""
    _exit_in(_ALL_S, code)
    return code


def _exit_in(seconds: float, code: int) -> None:
    timer = threading.Timer(seconds, os._exit, (code,))
    timer.daemon = True
    timer.start()


def _raise_file_limit() -> None:
    """Each client takes a file descriptor, and many systems give a process 1024 of them unless it asks for more."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


def _remedy(error: ModuleNotFoundError) -> str:
    name = (error.name or str(error)).partition(".")[0]
    if name in _ROS_MODULES:
        return f"the ROS package {name} is missing: install ROS's Python packages, or source its setup.bash"
    if name in _OWN_MODULES:
        return f"{error.name} is missing: build this workspace, and source its setup.bash"
    return f"the Python package {_PIP_NAMES.get(name, name)} is missing: pip install -r requirements.txt"
