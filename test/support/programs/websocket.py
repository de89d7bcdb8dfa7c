# SPDX-License-Identifier: BSD-3-Clause
"""Websocket clients without a library: what a test does not read is not read, and no ping is answered."""

from __future__ import annotations

import json
import socket
import struct
from typing import Any, Dict

TEXT, CLOSE, PING, PONG = 1, 8, 9, 10

_HANDSHAKE = (
    b"GET / HTTP/1.1\r\nHost: robot\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


def connect(port: int, *, receive_buffer: int = 0, timeout: float = 20.0) -> socket.socket:
    """A connection after the handshake. `receive_buffer` is what its kernel takes in bytes; 0 is the system's choice.

    Raises ConnectionError when the server closes it before.
    """
    connection = socket.socket()
    if receive_buffer:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
    connection.settimeout(timeout)
    connection.connect(("127.0.0.1", port))
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.sendall(_HANDSHAKE)
    answer = b""
    while not answer.endswith(b"\r\n\r\n"):
        received = connection.recv(1)
        if not received:
            raise ConnectionError(f"closed in the handshake, after {answer!r}")
        answer += received
    if b" 101 " not in answer:
        raise ConnectionError(f"refused: {answer!r}")
    return connection


def frame(opcode: int, body: bytes) -> bytes:
    """One whole message of a client, masked with zeros."""
    length = len(body)
    if length < 126:
        head = struct.pack("!BB", 0x80 | opcode, 0x80 | length)
    elif length < 1 << 16:
        head = struct.pack("!BBH", 0x80 | opcode, 0xFE, length)
    else:
        head = struct.pack("!BBQ", 0x80 | opcode, 0xFF, length)
    return head + bytes(4) + body


def text_frame(operation: Dict[str, Any]) -> bytes:
    """The message of an operation."""
    return frame(TEXT, json.dumps(operation).encode())
