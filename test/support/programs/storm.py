# SPDX-License-Identifier: BSD-3-Clause
"""Clients that connect, begin all sorts of things and leave at once, as fast as they can: for so many seconds, or so
often. Each third leaves without a word, each third with a close frame, each third resets the connection.
"""

from __future__ import annotations

import socket
import struct
import time
from typing import Any, Dict

from programs.program import options, say
from programs.websocket import CLOSE, connect, frame, text_frame


def visit(port: int, operations: bytes, number: int) -> None:
    """One connection, from its beginning to its end."""
    with connect(port) as connection:
        connection.sendall(operations)
        if number % 3 == 0:
            connection.sendall(frame(CLOSE, b"\x03\xe8"))
        elif number % 3 == 1:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # closing resets


def main() -> None:
    wanted: Dict[str, Any] = options()
    end = time.monotonic() + wanted["seconds"] if wanted["seconds"] else float("inf")
    operations = [b"".join(map(text_frame, set_)) for set_ in wanted["operations"]]
    number = 0
    while time.monotonic() < end and (not wanted["count"] or number < wanted["count"]):
        visit(wanted["port"], operations[number % len(operations)], number)
        number += 1
    say(visits=number)


if __name__ == "__main__":
    main()
