# SPDX-License-Identifier: BSD-3-Clause
"""Writes what an outbox gives to a Tornado stream, with as few copies and system calls as the connection
allows.

On plain TCP a batch of buffers goes to the kernel in one `sendmsg`, without joining or copying them; only
what the kernel does not take is left to the stream, which sends it when the socket has room and then lets the
outbox go on. Tornado's own frames (pings, pongs, close) go through the stream too, behind what it still
holds, so frames never interleave. Over TLS everything goes through the stream.

The kernel is told to hold little that it has not sent, where it can be told so (TCP_NOTSENT_LOWAT): its buffer grows
to megabytes on a slow link, and what is in there can't be dropped or overtaken any more.
"""

from __future__ import annotations

import logging
import socket
from typing import Callable, List, Optional, Tuple

from tornado.concurrent import Future
from tornado.iostream import IOStream, SSLIOStream, StreamClosedError

from rosbridge_library.payload import Buffer, Framer, Payload

logger = logging.getLogger("rosbridge.transport")

_UNSENT_BYTES = 16384
"""What the kernel may hold unsent, beside what is on its way: enough to keep a link busy until the loop comes round."""
_JOIN_BYTES = 65536
"""Buffers up to this size are joined for the stream, which would make a system call of each."""


_MAX_BUFFERS = 1024
"""IOV_MAX of Linux: `sendmsg` refuses more."""


class StreamTransport:
    """An `outbox.Transport` over ``stream``, with ``frame`` as its framing.

    ``drained()`` is called after a write that could not send everything, when all is sent;
    ``give_up(reason)`` when the outbox gives up on the client.
    """

    def __init__(
        self, stream: IOStream, frame: Framer, drained: Callable[[], None], give_up: Callable[[str], None]
    ) -> None:
        self.frame: Callable[[Payload], Tuple[Buffer, ...]] = frame
        self.give_up = give_up
        self._stream = stream
        self._drained = drained
        self._plain = not isinstance(stream, SSLIOStream)
        self._sent_at_once = 0
        if hasattr(socket, "TCP_NOTSENT_LOWAT") and not stream.closed():
            stream.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, _UNSENT_BYTES)

    @property
    def taken_bytes(self) -> int:
        """See `outbox.Transport.taken_bytes`. Tornado's own frames count too: they go the same way."""
        return self._sent_at_once + self._stream._total_write_done_index

    def write(self, buffers: List[Buffer]) -> bool:
        """See `outbox.Transport.write`. On a closed stream the bytes are lost, and the stream's owner knows
        why."""
        stream = self._stream
        if stream.closed():
            return True
        if self._plain and not stream.writing():
            try:
                sent = stream.socket.sendmsg(buffers[:_MAX_BUFFERS])
            except (BlockingIOError, InterruptedError):
                sent = 0
            except OSError as error:
                stream.close(error)
                return True
            self._sent_at_once += sent
            buffers = _rest(buffers, sent)
            if not buffers:
                return True
        return self._leave_to_stream(buffers)

    def _leave_to_stream(self, buffers: List[Buffer]) -> bool:
        last: Optional[Future[None]] = None
        try:
            for buffer in _joined(buffers):
                last = self._stream.write(buffer if isinstance(buffer, bytes) else memoryview(buffer))
        except StreamClosedError:
            return True
        if last is None or not self._stream.writing():
            return True
        last.add_done_callback(self._written)
        return False

    def _written(self, future: Future[None]) -> None:
        if future.exception() is None:
            self._drained()


def _rest(buffers: List[Buffer], sent: int) -> List[Buffer]:
    """What remains of ``buffers`` after their first ``sent`` bytes."""
    for index, buffer in enumerate(buffers):
        if sent < len(buffer):
            return [memoryview(buffer)[sent:], *buffers[index + 1 :]] if sent else buffers[index:]
        sent -= len(buffer)
    return []


def _joined(buffers: List[Buffer]) -> List[Buffer]:
    """The same bytes with small neighbours joined; large ones are left as they are."""
    joined: List[Buffer] = []
    small: List[Buffer] = []
    for buffer in buffers:
        if len(buffer) <= _JOIN_BYTES:
            small.append(buffer)
            continue
        if small:
            joined.append(b"".join(small))
            small = []
        joined.append(buffer)
    if small:
        joined.append(b"".join(small))
    return joined
