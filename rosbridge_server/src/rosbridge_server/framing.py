# SPDX-License-Identifier: BSD-3-Clause
"""WebSocket frames (RFC 6455, section 5), without any input or output.

Outgoing, a payload's frame is the same bytes for every client, since servers don't mask: it is made once and
shared (`websocket_frame`). Incoming, `FrameReader` takes the bytes of one client in whatever pieces they
arrive and gives whole messages. Text is not decoded: its consumers parse UTF-8 bytes, and text that is not
valid UTF-8 is theirs to report, not a reason to lose the connection.
"""

from __future__ import annotations

import struct
from typing import Iterator, NamedTuple, Optional, Tuple

from tornado.util import _websocket_mask  # in C, where tornado was built with its extension

from rosbridge_library.payload import Buffer, Payload

CONTINUATION, TEXT, BINARY, CLOSE, PING, PONG = 0x0, 0x1, 0x2, 0x8, 0x9, 0xA

_FIN, _RSV1, _RSV2_AND_3, _OPCODE, _CONTROL = 0x80, 0x40, 0x30, 0x0F, 0x08
_JOIN_BYTES = 16384
"""Payloads up to this size are copied behind their header: cheaper than a buffer more in every write."""

PROTOCOL_ERROR, MESSAGE_TOO_BIG = 1002, 1009


class FrameError(Exception):
    """The client broke the framing, or sent more than the limit; ``code`` is the close code that tells it
    so."""

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(reason)
        self.code = code
        self.reason = reason


class Message(NamedTuple):
    """A whole message, or a control frame (``opcode`` CLOSE, PING or PONG)."""

    opcode: int
    data: bytes
    compressed: bool


def frame_header(opcode: int, size: int, compressed: bool = False) -> bytes:
    """The header of an unmasked final frame with ``size`` bytes to follow."""
    first = _FIN | opcode | (_RSV1 if compressed else 0)
    if size < 126:
        return bytes((first, size))
    if size < 65536:
        return struct.pack("!BBH", first, 126, size)
    return struct.pack("!BBQ", first, 127, size)


def websocket_frame(payload: Payload) -> Tuple[Buffer, ...]:
    """The buffers of the frame that carries ``payload``; large parts are not copied."""
    header = frame_header(BINARY if payload.binary else TEXT, payload.size)
    if payload.size <= _JOIN_BYTES:
        return (b"".join((header, *payload.parts)),)
    return (header, *payload.parts)


class FrameReader:
    """Finds the messages in the bytes that one client sends.

    ``max_message_bytes`` bounds a whole message (None: no bound); ``extensions`` says whether
    permessage-deflate was negotiated, so that frames may be marked as compressed. `feed` costs linear time,
    however the bytes are cut.
    """

    def __init__(self, max_message_bytes: Optional[int] = None, extensions: bool = False) -> None:
        self._max_message_bytes = max_message_bytes
        self._extensions = extensions
        self._buffer = bytearray()
        # Where the body of the frame that the buffer begins with starts and ends; 0 until its header is
        # whole.
        self._start = self._end = 0
        # A message that comes in several frames:
        self._opcode = CONTINUATION
        self._compressed = False
        self._parts = bytearray()

    def feed(self, data: bytes) -> Iterator[Message]:
        """Takes the next bytes and gives the messages that they complete. Raises FrameError; nothing goes
        after it."""
        buffer = self._buffer
        buffer += data
        while len(buffer) >= 2:
            if self._end == 0 and not self._read_header():
                return
            if len(buffer) < self._end:
                return
            head, start, end = buffer[0], self._start, self._end
            with memoryview(buffer) as view:
                body = _websocket_mask(bytes(view[start - 4 : start]), bytes(view[start:end]))
            del buffer[:end]
            self._end = 0
            message = self._message(head, body)
            if message is not None:
                yield message

    def _read_header(self) -> bool:
        """Whether the header of the frame that the buffer begins with is whole; finds where its body is."""
        buffer = self._buffer
        if not buffer[1] & 0x80:
            raise FrameError(PROTOCOL_ERROR, "frames of a client must be masked")
        length = buffer[1] & 0x7F
        start = 6 if length < 126 else 8 if length == 126 else 14
        if len(buffer) < start:
            return False
        if length >= 126:
            length = int.from_bytes(buffer[2 : start - 4], "big")
        self._check(buffer[0], length)
        self._start, self._end = start, start + length
        return True

    def _check(self, head: int, length: int) -> None:
        """Raises FrameError for a frame that is not allowed here, as soon as its header is known."""
        opcode = head & _OPCODE
        if head & _RSV2_AND_3 or (head & _RSV1 and (not self._extensions or opcode not in (TEXT, BINARY))):
            raise FrameError(PROTOCOL_ERROR, "reserved bits set without an extension that uses them")
        if opcode & _CONTROL:
            if opcode > PONG:
                raise FrameError(PROTOCOL_ERROR, f"unknown opcode {opcode}")
            if length > 125 or not head & _FIN:
                raise FrameError(PROTOCOL_ERROR, "a control frame must be whole and at most 125 bytes long")
            return
        if opcode > BINARY:
            raise FrameError(PROTOCOL_ERROR, f"unknown opcode {opcode}")
        if (opcode == CONTINUATION) != (self._opcode != CONTINUATION):
            raise FrameError(
                PROTOCOL_ERROR,
                "a continuation frame with nothing to continue, or a new message inside another",
            )
        if self._max_message_bytes is not None and len(self._parts) + length > self._max_message_bytes:
            raise FrameError(MESSAGE_TOO_BIG, f"message of more than {self._max_message_bytes} bytes")

    def _message(self, head: int, body: bytes) -> Optional[Message]:
        opcode = head & _OPCODE
        if opcode & _CONTROL:
            return Message(opcode, body, False)
        if head & _FIN and opcode != CONTINUATION:
            return Message(opcode, body, bool(head & _RSV1))
        if opcode != CONTINUATION:
            self._opcode, self._compressed = opcode, bool(head & _RSV1)
        self._parts += body
        if not head & _FIN:
            return None
        message = Message(self._opcode, bytes(self._parts), self._compressed)
        self._opcode, self._compressed, self._parts = CONTINUATION, False, bytearray()
        return message
