# SPDX-License-Identifier: BSD-3-Clause
"""The load: a node that publishes one pre-serialized message at a fixed rate and costs as little as it can.

Like roscpp it keeps a bounded queue per subscriber and drops the oldest when the subscriber doesn't read, and it turns
Nagle's algorithm off only for a subscriber that asks for that (`tcp_nodelay=1`).
"""

from __future__ import annotations

import select
import socket
import time
from collections import deque
from typing import Any, Callable, Deque, List

from benchmarks.messages import LOADS, Template, message_class
from benchmarks.rosnode import RosNode, receive_header, send_header
from benchmarks.tally import Window
from benchmarks.worker import Pipe, answer

QUEUE_MESSAGES = 100


class _Subscriber:
    """A connection, and what it has not taken yet."""

    def __init__(self, connection: socket.socket) -> None:
        self.socket = connection
        self.waiting: Deque[memoryview] = deque()
        self.dropped = 0

    def fileno(self) -> int:
        return self.socket.fileno()

    def send(self, frame: bytearray) -> None:
        """Sends the frame, or queues a copy of what the socket doesn't take now."""
        taken = 0 if self.waiting else self._send(memoryview(frame))
        if taken == len(frame):
            return
        self.waiting.append(memoryview(bytes(frame))[taken:])
        if len(self.waiting) > QUEUE_MESSAGES:
            del self.waiting[1]  # the first may be half sent
            self.dropped += 1

    def flush(self) -> None:
        """Sends what waits, as far as the socket takes it."""
        while self.waiting:
            data = self.waiting[0]
            taken = self._send(data)
            if taken < len(data):
                self.waiting[0] = data[taken:]
                return
            self.waiting.popleft()

    def _send(self, data: memoryview) -> int:
        try:
            return self.socket.send(data)
        except BlockingIOError:
            return 0


class Publisher:
    """Publishes a load on a topic to whoever subscribes."""

    def __init__(self, load_name: str, topic: str, node: RosNode) -> None:
        self.load = LOADS[load_name]
        self.topic = topic
        self.node = node
        self.template = Template(self.load)
        self.subscribers: List[_Subscriber] = []
        self.seq = 0
        self.sent = 0
        self.window = Window()
        node.register_publisher(topic, self.load.type)

    def accept(self) -> None:
        """Takes in a subscriber that has connected."""
        connection, _ = self.node.listener.accept()
        header = receive_header(connection)
        kind = message_class(self.load.type)
        if header.get("topic") != self.topic or header.get("md5sum") not in ("*", kind._md5sum):
            send_header(connection, {"error": f"only {self.topic} [{kind._type}/{kind._md5sum}] is published here"})
            connection.close()
            return
        if header.get("tcp_nodelay") == "1":
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        fields = {"callerid": self.node.name, "type": kind._type, "md5sum": kind._md5sum, "topic": self.topic}
        send_header(connection, {**fields, "message_definition": kind._full_text, "latching": "0"})
        connection.setblocking(False)
        self.subscribers.append(_Subscriber(connection))

    def publish(self) -> None:
        """Sends one message, stamped now, to every subscriber."""
        now_ns = time.time_ns()
        self.template.stamp(self.seq, now_ns)
        self.seq += 1
        if self.window.begin_ns <= now_ns < self.window.end_ns:
            self.sent += 1
        for subscriber in list(self.subscribers):
            self._try(subscriber, lambda to: to.send(self.template.frame))

    def flush(self, subscriber: _Subscriber) -> None:
        self._try(subscriber, _Subscriber.flush)

    def close(self) -> None:
        self.node.unregister_publisher(self.topic)
        for subscriber in self.subscribers:
            subscriber.socket.close()

    def _try(self, subscriber: _Subscriber, send: Callable[[_Subscriber], None]) -> None:
        try:
            send(subscriber)
        except (BrokenPipeError, ConnectionResetError):  # it unsubscribed
            subscriber.socket.close()
            self.subscribers.remove(subscriber)


def run(pipe: Pipe, load_name: str, rate_hz: float, topic: str, master_uri: str) -> None:
    """A worker. Replies when it is registered, and publishes at `rate_hz` from then on, by deadlines on the monotonic
    clock. Commands: a Window to count in; "stop", whose reply is how many were sent and dropped, then "end"."""
    node = RosNode("/benchmark_publisher", master_uri)
    publisher = Publisher(load_name, topic, node)
    answer(pipe)
    try:
        _publish(pipe, publisher, 1.0 / rate_hz)
        answer(pipe, {"sent": publisher.sent, "dropped": sum(each.dropped for each in publisher.subscribers)})
        pipe.recv()
    finally:
        publisher.close()


def _publish(pipe: Pipe, publisher: Publisher, period_s: float) -> None:
    listener = publisher.node.listener
    reading: List[Any] = [pipe, listener]
    due = time.monotonic()
    while True:
        behind = [each for each in publisher.subscribers if each.waiting]
        wait_s = max(0.0, due - time.monotonic())
        readable, writable, _ = select.select(reading, behind, [], wait_s)
        if pipe in readable:
            command = pipe.recv()
            if not isinstance(command, Window):
                return
            publisher.window = command
        if listener in readable:
            publisher.accept()
        for subscriber in writable:
            publisher.flush(subscriber)
        if time.monotonic() >= due:
            publisher.publish()
            due += period_s
