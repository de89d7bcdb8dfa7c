# SPDX-License-Identifier: BSD-3-Clause
"""A ROS node that a suite commands: one process for many tests, where a process for each would take too long.

    peer = Peer(master)
    peer.advertise("/topic", "std_msgs/String")
    peer.publish("/topic", {"data": "hello"})

Its commands are the methods of programs/peer.py.
"""

from __future__ import annotations

import json
import socket
import threading
from typing import Any, Dict, List, Optional, Sequence

from support.node import Node, _program
from support.ros import RosMaster
from support.wait import wait_until


class CommandFailed(Exception):
    """What the command raised in the node."""


class Peer:
    """The node; `name` must be another one than that of peers beside it."""

    def __init__(self, master: RosMaster, name: str = "peer", arguments: Sequence[str] = ()) -> None:
        self.master = master
        self.name = "/" + name
        self.node: Node = _program(master, "peer.py", {}, name, arguments)
        self._port = int(self.node.records("port")[0])

    def command(self, method: str, timeout: float = 15.0, **arguments: Any) -> Any:
        """Has the node execute a command; CommandFailed with what it raised."""
        with socket.create_connection(("127.0.0.1", self._port), timeout) as connection:
            connection.sendall(json.dumps({"method": method, "arguments": arguments}).encode() + b"\n")
            answer = json.loads(connection.makefile("rb").readline() or b'{"error": "the node is gone"}')
        if "error" in answer:
            raise CommandFailed(answer["error"])
        return answer["value"]

    def advertise(
        self, topic: str, kind: str, *, latch: bool = False, definition: Optional[str] = None, subscribers: int = 0
    ) -> None:
        """Returns when so many nodes have connected."""
        self.command("advertise", topic=topic, kind=kind, latch=latch, definition=definition)
        self.wait_connected(topic, subscribers)

    def wait_connected(self, topic: str, subscribers: int = 1) -> None:
        wait_until(lambda: self.command("connections", topic=topic) >= subscribers, 10.0, f"{subscribers} on {topic}")

    def publish(self, topic: str, *messages: Any) -> None:
        self.command("publish", topic=topic, messages=list(messages))

    def unadvertise(self, topic: str) -> None:
        self.command("unadvertise", topic=topic)

    def subscribe(self, topic: str, kind: str) -> None:
        self.command("subscribe", topic=topic, kind=kind)

    def wait_publishers(self, topic: str, count: int = 1) -> None:
        wait_until(lambda: self.command("publisher_count", topic=topic) >= count, 10.0, f"{count} on {topic}")

    def received(self, topic: str, count: int = 0, timeout: float = 10.0) -> List[Any]:
        """What came on a topic that it subscribed, once there are `count`."""
        found: List[Any] = []

        def enough() -> bool:
            found[:] = self.command("received", topic=topic)
            return len(found) >= count

        wait_until(enough, timeout, lambda: f"{count} messages on {topic}, but {found!r:.500}")
        return found

    def serve(self, service: str, kind: str = "rosbridge_library/AddTwoInts", **options: Any) -> None:
        self.command("serve", service=service, kind=kind, **options)

    def requested(self, service: str) -> List[Any]:
        return list(self.command("requested", service=service))

    def call(self, service: str, kind: str, args: Any, timeout: float = 15.0) -> Any:
        return self.command("call", timeout, service=service, kind=kind, args=args)

    def begin_call(self, service: str, kind: str, args: Any) -> PendingCall:
        """A call that goes on while the test does something else."""
        return PendingCall(self, service, kind, args)


class PendingCall:
    """A service call that a peer makes meanwhile."""

    def __init__(self, peer: Peer, service: str, kind: str, args: Any) -> None:
        self._outcome: Dict[str, Any] = {}
        self._thread = threading.Thread(target=self._run, args=(peer, service, kind, args), daemon=True)
        self._thread.start()

    def _run(self, peer: Peer, service: str, kind: str, args: Any) -> None:
        try:
            self._outcome["value"] = peer.call(service, kind, args)
        except Exception as error:  # noqa: BLE001  # raised by result()
            self._outcome["error"] = error

    def result(self, timeout: float = 10.0) -> Any:
        """The response's values, within `timeout` seconds; CommandFailed when the call failed."""
        self._thread.join(timeout)
        assert not self._thread.is_alive(), f"the call did not end within {timeout:g} s"
        if "error" in self._outcome:
            raise self._outcome["error"]
        return self._outcome["value"]
