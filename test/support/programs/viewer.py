# SPDX-License-Identifier: BSD-3-Clause
"""Clients that watch topics and tell what they see of them, and how late; see support.viewer.Viewer.

Some connections in one process, on raw sockets, so that it can be stopped and costs little. A record `seen` every 0.2 s
has, for each topic, the delay of every message since the last one, in seconds; a message in fragments counts when its
last one is there.
"""

from __future__ import annotations

import json
import re
import selectors
import struct
import time
from typing import Any, Dict, List, Tuple

import cbor2

from programs.program import options, ready, say
from programs.websocket import CLOSE, PING, PONG, TEXT, connect, frame

_TOPIC = re.compile(rb'\\?"topic\\?":\\?"([^"\\]+)')
_STAMP = re.compile(rb'\\?"secs\\?":(\d+),\\?"nsecs\\?":(\d+)')
_FRAGMENT = re.compile(rb'"num":(\d+),"total":(\d+)}$')
_FRAGMENT_ID = re.compile(rb'"id":"?(\w+)')
_HEAD_BYTES = 600
REPORT_INTERVAL_S = 0.2

Reading = Dict[str, List[float]]


class Connection:
    """One websocket client."""

    def __init__(self, port: int, receive_buffer: int) -> None:
        self.socket = connect(port, receive_buffer=receive_buffer)
        self.warnings: List[str] = []
        self._data = bytearray()
        self._begun: Dict[bytes, Tuple[str, float]] = {}  # fragment id: topic and stamp

    def send(self, opcode: int, body: bytes) -> None:
        self.socket.sendall(frame(opcode, body))

    def read(self, seen: Reading) -> bool:
        """Notes what has come; False when the server closed the connection."""
        try:
            received = self.socket.recv(1 << 18)
        except ConnectionError:
            return False
        now = time.time()
        data = self._data
        data += received
        at = 0
        while len(data) - at >= 2:
            length, body = data[at + 1] & 0x7F, at + 2
            if length == 126:
                length, body = int.from_bytes(data[at + 2 : at + 4], "big"), at + 4
            elif length == 127:
                length, body = int.from_bytes(data[at + 2 : at + 10], "big"), at + 10
            if body > len(data) or body + length > len(data):
                break
            opcode = data[at] & 0x0F
            frame = bytes(memoryview(data)[body : body + length])
            at = body + length
            if opcode == CLOSE:
                return False
            if opcode == PING:
                self.send(PONG, frame)
            elif opcode != PONG:
                self._note(frame, opcode == TEXT, now, seen)
        del data[:at]
        return bool(received)

    def _note(self, frame: bytes, text: bool, now: float, seen: Reading) -> None:
        if not text:
            message = cbor2.loads(frame)
            secs, nsecs = struct.unpack_from("<II", message["msg"]["bytes"], 4)
            seen.setdefault(message["topic"], []).append(now - secs - nsecs * 1e-9)
            return
        head = frame[:_HEAD_BYTES]
        fragment = _FRAGMENT.search(frame[-60:]) if head.startswith(b'{"op":"fragment"') else None
        if head.startswith(b'{"op":"status"'):
            self.warnings.append(json.loads(frame)["msg"])
            return
        number, total = (int(fragment.group(1)), int(fragment.group(2))) if fragment else (0, 1)
        key = _FRAGMENT_ID.search(head).group(1) if fragment else b""  # type: ignore[union-attr]
        if number == 0:
            topic, stamp = _TOPIC.search(head), _STAMP.search(head)
            assert topic, head
            assert stamp, head
            self._begun[key] = topic.group(1).decode(), int(stamp.group(1)) + int(stamp.group(2)) * 1e-9
        if number == total - 1:
            name, sent = self._begun.pop(key)
            seen.setdefault(name, []).append(now - sent)


def main() -> None:
    wanted = options()
    selector = selectors.DefaultSelector()
    connections = [Connection(wanted["port"], wanted["receive_buffer"]) for _ in range(wanted["connections"])]
    for connection in connections:
        connection.send(TEXT, b'{"op":"set_level","level":"warning"}')
        for subscription in wanted["subscriptions"]:
            connection.send(TEXT, json.dumps({"op": "subscribe", **subscription}).encode())
        selector.register(connection.socket, selectors.EVENT_READ, connection)
    ready()
    seen: Dict[str, List[float]] = {}
    report_at = time.monotonic() + REPORT_INTERVAL_S
    while True:
        for key, _ in selector.select(max(0.0, report_at - time.monotonic())):
            connection = key.data
            if not connection.read(seen):
                selector.unregister(connection.socket)
                say(closed=connections.index(connection))
        if time.monotonic() >= report_at:
            report_at = time.monotonic() + REPORT_INTERVAL_S
            warnings: List[Any] = []
            for connection in connections:
                warnings += connection.warnings
                connection.warnings = []
            delays = {topic: [round(delay, 4) for delay in each] for topic, each in seen.items()}
            say(seen={"at": time.time(), "delays": delays, "warnings": warnings})
            seen = {}


if __name__ == "__main__":
    main()
