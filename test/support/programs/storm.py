# SPDX-License-Identifier: BSD-3-Clause
"""Clients that connect, begin all sorts of things and leave at once, as fast as they can: for so many seconds, or so
often. Each third leaves without a word, each third with a close frame, each third resets the connection.
"""

from __future__ import annotations

import json
import socket
import struct
import time
from typing import Any, Dict

from programs.program import options, say

TEXT, CLOSE = 1, 8
_HANDSHAKE = (
    b"GET / HTTP/1.1\r\nHost: robot\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


def frame(opcode: int, body: bytes) -> bytes:
    return struct.pack("!BBH", 0x80 | opcode, 0xFE, len(body)) + bytes(4) + body


def visit(port: int, operations: bytes, number: int) -> None:
    """One connection, from its beginning to its end."""
    with socket.create_connection(("127.0.0.1", port), 20.0) as connection:
        connection.sendall(_HANDSHAKE)
        answer = b""
        while not answer.endswith(b"\r\n\r\n"):
            received = connection.recv(1024)
            if not received:
                raise ConnectionError("closed in the handshake")
            answer += received
        connection.sendall(operations)
        if number % 3 == 0:
            connection.sendall(frame(CLOSE, b"\x03\xe8"))
        elif number % 3 == 1:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # closing resets


def main() -> None:
    wanted: Dict[str, Any] = options()
    end = time.monotonic() + wanted["seconds"] if wanted["seconds"] else float("inf")
    operations = [b"".join(frame(TEXT, json.dumps(each).encode()) for each in set_) for set_ in wanted["operations"]]
    number = 0
    while time.monotonic() < end and (not wanted["count"] or number < wanted["count"]):
        visit(wanted["port"], operations[number % len(operations)], number)
        number += 1
    say(visits=number)


if __name__ == "__main__":
    main()
