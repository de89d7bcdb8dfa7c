# SPDX-License-Identifier: BSD-3-Clause
"""A websocket client that publishes: the load of client → ROS measurements, as rosbridge JSON or Foxglove binary."""

from __future__ import annotations

import select
import struct
import time
from typing import Any, Callable, List, Tuple

from benchmarks.clients import connect, send_json
from benchmarks.messages import LOADS, Template
from benchmarks.tally import Tally, Window
from benchmarks.websocket import BINARY, TEXT, MessageCounter, frame
from benchmarks.worker import Pipe, answer

LOAD = "twist2000"
_CHANNEL = 7
_CLIENT_MESSAGE_DATA = 1
# Numbers of constant width: leading spaces are allowed in JSON, leading zeros are not.
_JSON = (
    b'{"op":"publish","topic":"%b","msg":{"header":{"stamp":{"secs":%10d,"nsecs":%9d},"frame_id":"base_link"},'
    b'"twist":{"linear":{"x":0.25,"y":-0.5,"z":0.125},"angular":{"x":0.1,"y":0.2,"z":0.3}}}}'
)


def run(pipe: Pipe, url: str, encoding: str, topic: str, rate_hz: float) -> None:
    """A worker: a client that advertises the topic, replies, and publishes TwistStamped at `rate_hz` by deadlines on
    the monotonic clock. Commands: a Window to count in; "stop", whose reply is how many were sent in it."""
    connection = connect(url, encoding)
    opcode, payload = _advertise_and_payload(encoding, topic, lambda operation: send_json(connection, operation))
    incoming = MessageCounter(connection, lambda *_: None, Tally())  # answers pings
    answer(pipe)
    window, sent = Window(), 0
    reading: List[Any] = [pipe, connection.socket]
    due = time.monotonic()
    while True:
        readable, _, _ = select.select(reading, [], [], max(0.0, due - time.monotonic()))
        if pipe in readable:
            command = pipe.recv()
            if not isinstance(command, Window):
                break
            window = command
        if connection.socket in readable:
            incoming.read()
        if time.monotonic() >= due:
            now_ns = time.time_ns()
            connection.socket.sendall(frame(payload(now_ns), opcode))
            sent += window.begin_ns <= now_ns < window.end_ns
            due += 1.0 / rate_hz
    answer(pipe, {"sent": sent, "dropped": 0})
    pipe.recv()


def _advertise_and_payload(
    encoding: str, topic: str, send: Callable[[object], None]
) -> Tuple[int, Callable[[int], bytes]]:
    """Advertises the topic; returns the opcode of its messages, and what makes one with a stamp."""
    load = LOADS[LOAD]
    if encoding == "json":
        send({"op": "advertise", "topic": topic, "type": load.type})
        return TEXT, lambda now_ns: _JSON % (topic.encode(), now_ns // 10**9, now_ns % 10**9)
    if encoding != "foxglove":
        raise ValueError(f"clients publish as json or foxglove, not {encoding}")
    template = Template(load)
    head = struct.pack("<BI", _CLIENT_MESSAGE_DATA, _CHANNEL)
    channel = {"id": _CHANNEL, "topic": topic, "encoding": "ros1", "schemaName": load.type}
    send({"op": "advertise", "channels": [channel]})

    def payload(now_ns: int) -> bytes:
        template.stamp(0, now_ns)
        return head + template.body

    return BINARY, payload
