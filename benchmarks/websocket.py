# SPDX-License-Identifier: BSD-3-Clause
"""The client side of a websocket (RFC 6455) on a raw socket, as cheap as Python lets it be.

`Connection` is for setting up: whole messages, waiting. `MessageCounter` then takes the connection over: it only looks
at the first bytes of each message and counts, so that a client process keeps up with any server.
"""

from __future__ import annotations

import base64
import os
import socket
import struct
import urllib.parse
from time import time_ns
from typing import Optional, Tuple

from benchmarks.stamps import HEAD_BYTES, Finder
from benchmarks.tally import Tally

CONTINUATION, TEXT, BINARY, CLOSE, PING, PONG = 0x0, 0x1, 0x2, 0x8, 0x9, 0xA
FOXGLOVE_SUBPROTOCOLS = ("foxglove.websocket.v1", "foxglove.sdk.v1")

_FIN, _MASKED, _OPCODE, _LENGTH = 0x80, 0x80, 0x0F, 0x7F
_NO_MASK = bytes(4)  # masking with zeros is allowed, and costs neither side anything
_MESSAGE_TIMEOUT_S = 20.0
_READ_BYTES = 1 << 18
_buffer = bytearray(_READ_BYTES)
"""What all counters of the process read into, one at a time."""
_view = memoryview(_buffer)


class Refused(Exception):
    """The server doesn't speak websocket, or not the subprotocol."""


class Closed(Exception):
    """The server closed the connection."""


def frame(payload: bytes, opcode: int = TEXT) -> bytes:
    """A whole frame of a client."""
    size = len(payload)
    if size < 126:
        head = struct.pack("!BB", _FIN | opcode, _MASKED | size)
    elif size < 65536:
        head = struct.pack("!BBH", _FIN | opcode, _MASKED | 126, size)
    else:
        head = struct.pack("!BBQ", _FIN | opcode, _MASKED | 127, size)
    return head + _NO_MASK + payload


class Connection:
    """A websocket connection, after its handshake."""

    def __init__(self, url: str, foxglove: bool = False) -> None:
        """Connects to `ws://host:port/path`. Raises OSError, and Refused when the handshake fails."""
        parts = urllib.parse.urlsplit(url)
        host, port = parts.hostname or "127.0.0.1", parts.port or 80
        self.socket = socket.create_connection((host, port), _MESSAGE_TIMEOUT_S)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.rest = bytearray()
        """What was read and not yet used."""
        try:
            self._shake_hands(f"{host}:{port}", parts.path or "/", foxglove)
        except BaseException:
            self.socket.close()
            raise

    def send(self, payload: bytes, opcode: int = TEXT) -> None:
        self.socket.sendall(frame(payload, opcode))

    def receive(self) -> Tuple[int, bytes]:
        """The opcode and payload of the next whole message. Pings are answered. Raises Closed, and
        socket.timeout after 20 seconds."""
        first, parts = CONTINUATION, bytearray()
        while True:
            head, payload = self._frame()
            opcode = head & _OPCODE
            if opcode == PING:
                self.send(payload, PONG)
            elif opcode == CLOSE:
                raise Closed("the server closed the connection")
            elif opcode != PONG:
                first = opcode or first
                parts += payload
                if head & _FIN:
                    return first, bytes(parts)

    def close(self) -> None:
        self.socket.close()

    def _frame(self) -> Tuple[int, bytes]:
        head, length = self._take(2)
        length &= _LENGTH
        if length >= 126:
            length = int.from_bytes(self._take(2 if length == 126 else 8), "big")
        return head, self._take(length)

    def _take(self, size: int) -> bytes:
        while len(self.rest) < size:
            self._read()
        taken = bytes(self.rest[:size])
        del self.rest[:size]
        return taken

    def _read(self) -> None:
        data = self.socket.recv(65536)
        if not data:
            raise Closed("the server closed the connection")
        self.rest += data

    def _shake_hands(self, host: str, path: str, foxglove: bool) -> None:
        key = base64.b64encode(os.urandom(16)).decode()
        protocols = f"Sec-WebSocket-Protocol: {', '.join(FOXGLOVE_SUBPROTOCOLS)}\r\n" if foxglove else ""
        request = (
            f"GET {path} HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n{protocols}\r\n"
        )
        self.socket.sendall(request.encode())
        end = -1
        while end < 0:
            try:
                self._read()
            except Closed:
                raise Refused("the server closed the connection during the handshake") from None
            end = self.rest.find(b"\r\n\r\n")
        answer = self._take(end + 4).decode("latin-1")
        if " 101 " not in answer.split("\r\n", 1)[0]:
            raise Refused(answer.split("\r\n", 1)[0])
        if foxglove and "sec-websocket-protocol" not in answer.lower():
            raise Refused("the server doesn't speak the Foxglove protocol")


class MessageCounter:
    """Counts a connection's messages into a tally. Messages may be of any size; of each only the first `HEAD_BYTES`
    are looked at, and it counts when its last byte has come."""

    def __init__(self, connection: Connection, find: Finder, tally: Tally) -> None:
        self.connection = connection
        self.socket = connection.socket
        self.count = 0
        self._find = find
        self._tally = tally
        self._rest = bytes(connection.rest)
        self._stamp: Optional[int] = None  # of the message in progress; None: not one of the load
        self._size = 0  # of the message in progress, so far
        self._missing = 0  # bytes of the frame in progress
        self._final = True  # whether the frame in progress is the last of its message

    def read(self) -> None:
        """Takes what the socket holds, which must be readable. Raises Closed."""
        kept = len(self._rest)
        _buffer[:kept] = self._rest
        received = self.socket.recv_into(_view[kept:])
        if not received:
            raise Closed("the server closed the connection")
        used = self._parse(kept + received)
        self._rest = bytes(_view[used : kept + received])

    def _parse(self, end: int) -> int:
        """Looks at what the buffer holds up to `end`; returns how much of it is done with."""
        now_ns = time_ns()
        at = 0
        while True:
            if self._missing:
                step = min(self._missing, end - at)
                at += step
                self._missing -= step
                if self._missing:
                    return at
                self._frame_done(now_ns)
            if end - at < 2:
                return at
            head, length, body = _buffer[at], _buffer[at + 1] & _LENGTH, at + 2
            if length >= 126:
                body += 2 if length == 126 else 8
                if end < body:
                    return at
                length = int.from_bytes(_buffer[at + 2 : body], "big")
            looked_at = body + min(length, HEAD_BYTES)
            if end < looked_at:
                return at
            at = body
            opcode = head & _OPCODE
            if opcode >= CLOSE:
                self._control(opcode, bytes(_buffer[body:looked_at]))
                at += length
                continue
            if opcode != CONTINUATION:
                self._stamp = self._find(_buffer, body, looked_at)
                self._size = 0
            self._size += length
            self._final = bool(head & _FIN)
            self._missing = length
            if not length:
                self._frame_done(now_ns)

    def _frame_done(self, now_ns: int) -> None:
        if self._final and self._stamp is not None:
            self.count += 1
            self._tally.add(self._stamp, self._size, now_ns)

    def _control(self, opcode: int, payload: bytes) -> None:
        if opcode == PING:
            self.connection.send(payload, PONG)
        elif opcode == CLOSE:
            raise Closed("the server closed the connection")
