# SPDX-License-Identifier: BSD-3-Clause
"""A node that publishes, subscribes, serves and calls as it is told; see support.peer."""

from __future__ import annotations

import json
import os
import socketserver
import threading
import time
from typing import Any, Dict, List, Optional

import genpy.dynamic
import roslib.message
import rospy

from programs.program import fill, plain, ready, say, stay


class Peer:
    """Each public method is a command; arguments and results are what JSON holds."""

    def __init__(self) -> None:
        self.publishers: Dict[str, rospy.Publisher] = {}
        self.subscribers: Dict[str, rospy.Subscriber] = {}
        self.services: Dict[str, rospy.Service] = {}
        self.messages: Dict[str, List[Any]] = {}
        self.requests: Dict[str, List[Any]] = {}

    def advertise(self, topic: str, kind: str, latch: bool = False, definition: Optional[str] = None) -> None:
        """`definition`: publish a type of that text, which need not be installed."""
        if definition is None:
            cls = roslib.message.get_message_class(kind)
        else:
            cls = genpy.dynamic.generate_dynamic(kind, definition)[kind]
        self.publishers[topic] = rospy.Publisher(topic, cls, latch=latch, queue_size=1000)

    def publish(self, topic: str, messages: List[Any]) -> None:
        publisher = self.publishers[topic]
        for message in messages:
            publisher.publish(fill(publisher.data_class(), message))

    def connections(self, topic: str) -> int:
        return int(self.publishers[topic].get_num_connections())

    def unadvertise(self, topic: str) -> None:
        self.publishers.pop(topic).unregister()

    def subscribe(self, topic: str, kind: str) -> None:
        messages: List[Any] = []
        self.messages[topic] = messages
        cls = roslib.message.get_message_class(kind)
        self.subscribers[topic] = rospy.Subscriber(topic, cls, lambda message: messages.append(plain(message)))

    def publisher_count(self, topic: str) -> int:
        """How many have answered the handshake: rospy counts a connection from before it is made."""
        return sum(connection.md5sum is not None for connection in self.subscribers[topic].impl.connections)

    def received(self, topic: str) -> List[Any]:
        return list(self.messages[topic])

    def unsubscribe(self, topic: str) -> None:
        self.subscribers.pop(topic).unregister()

    def serve(
        self, service: str, kind: str, response: Any = None, delay: float = 0.0, behaviour: str = "answer"
    ) -> None:
        """Without `response`, the sum of a and b; `behaviour`: answer, fail or die."""
        cls = roslib.message.get_service_class(kind)
        requests: List[Any] = []
        self.requests[service] = requests

        def handle(request: Any) -> Any:
            requests.append(plain(request))
            if behaviour == "fail":
                raise rospy.ServiceException("it failed, as asked")
            time.sleep(delay)
            if behaviour == "die":
                os._exit(1)
            reply = cls._response_class()
            if response is not None:
                return fill(reply, response)
            if hasattr(reply, "sum"):
                reply.sum = request.a + request.b
            return reply

        self.services[service] = rospy.Service(service, cls, handle)

    def requested(self, service: str) -> List[Any]:
        return list(self.requests[service])

    def unserve(self, service: str) -> None:
        self.services.pop(service).shutdown()

    def call(self, service: str, kind: str, args: Any) -> Any:
        """The response's values."""
        proxy = rospy.ServiceProxy(service, roslib.message.get_service_class(kind))
        return plain(proxy(fill(proxy.request_class(), args)))


class Handler(socketserver.StreamRequestHandler):
    def handle(self) -> None:
        command = json.loads(self.rfile.readline())
        try:
            answer = {"value": getattr(peer, command["method"])(**command["arguments"])}
        except Exception as error:  # noqa: BLE001  # told to the test
            answer = {"error": f"{type(error).__name__}: {error}"}
        self.wfile.write(json.dumps(answer).encode() + b"\n")


class Server(socketserver.ThreadingTCPServer):
    daemon_threads = True
    request_queue_size = 128


peer = Peer()


def main() -> None:
    rospy.init_node("peer")
    server = Server(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    say(port=server.server_address[1])
    ready()
    stay()


if __name__ == "__main__":
    main()
