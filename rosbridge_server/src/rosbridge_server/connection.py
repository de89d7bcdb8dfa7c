# SPDX-License-Identifier: BSD-3-Clause
"""One websocket connection: Tornado does the HTTP handshake, this does what comes after it.

Differences to Tornado's `WebSocketProtocol13`, each for a reason: text reaches the protocol as the bytes that
came, so that text which is not valid UTF-8 gets an error status and not a closed connection; bytes are read
in whatever pieces they come, so that a long upload counts as a sign of life (`keepalive`); a small message
costs one read; and messages go out through an outbox and not through `write_message`, which starts a task for
each.
"""

from __future__ import annotations

import asyncio
import logging
import struct
import sys
import zlib
from typing import Callable, Optional, Tuple

from tornado import websocket
from tornado.concurrent import Future
from tornado.iostream import StreamClosedError

from rosbridge_library.payload import Buffer, Payload
from rosbridge_server import framing
from rosbridge_server.framing import FrameError, FrameReader
from rosbridge_server.keepalive import KeepAlive

logger = logging.getLogger("rosbridge.connection")

_READ_BYTES = 65536
_YIELD_BYTES = 262144
"""After this many bytes (a message counts at least `_MESSAGE_COST`) read without a pause, other clients have
their turn."""
_MESSAGE_COST = 1024

_INVALID_DATA = 1007
_LAST_SILENCE_S = 0.5


class WebSocketConnection(websocket.WebSocketProtocol13):
    """A server's side of one websocket connection.

    ``handler`` is Tornado's: its ``ping_interval`` and ``ping_timeout`` are in seconds, 0 for off, and its
    ``on_message`` gets the bytes of each message. ``max_message_bytes`` None is no limit. ``lost`` is called
    when the connection is given up since nothing comes from the client any more.
    """

    def __init__(
        self,
        handler: websocket.WebSocketHandler,
        max_message_bytes: Optional[int],
        use_compression: bool,
        lost: Callable[[], None],
    ) -> None:
        params = websocket._WebSocketParams(
            max_message_size=sys.maxsize if max_message_bytes is None else max_message_bytes,
            compression_options={} if use_compression else None,
        )
        super().__init__(handler, False, params)
        self._ping_interval: float = handler.ping_interval or 0
        self._ping_timeout: float = handler.ping_timeout or 0
        self._lost = lost
        self._keepalive: Optional[KeepAlive] = None
        self._pong: Optional[Future[None]] = None
        self._late_ping: Optional[bytes] = None

    def start_pinging(self) -> None:
        """Overrides Tornado's, which can't have a timeout longer than the interval."""
        loop = asyncio.get_event_loop()
        self._keepalive = KeepAlive(loop, self._ping_interval, self._ping_timeout, self._send_ping, self._give_up)

    def frame(self, payload: Payload) -> Tuple[Buffer, ...]:
        """The frame for ``payload``; shared between clients unless this one wants it compressed.

        A compressed frame can't be shared: the compressor's window holds what this client was sent before.
        """
        if self._compressor is None:
            return payload.framed(framing.websocket_frame)
        body = self._compressor.compress(payload.data)
        opcode = framing.BINARY if payload.binary else framing.TEXT
        return framing.frame_header(opcode, len(body), compressed=True), body

    def abort(self) -> None:
        """Closes the socket at once; the handler's on_connection_close follows."""
        self._abort()

    def close(self, code: Optional[int] = None, reason: Optional[str] = None) -> None:
        """Sends a close frame, and closes the socket when the client has answered it or 5 s have passed."""
        if self._keepalive is not None:
            self._keepalive.stop()
        super().close(code, reason)

    def _send_ping(self, sent: Callable[[], None]) -> None:
        if not self.is_closing():
            ping = self.stream.write(framing.frame_header(framing.PING, 0))
            ping.add_done_callback(lambda done: sent() if done.exception() is None else None)

    def _give_up(self) -> None:
        self._lost()
        self._abort()

    async def _receive_frame_loop(self) -> None:
        try:
            await self._receive_messages()
            if not self.client_terminated:
                await self._discard()
        except StreamClosedError:
            self._abort()
        finally:
            self.handler.on_ws_connection_close(self.close_code, self.close_reason)

    async def _discard(self) -> None:
        """Gives a client that broke a rule the time to read why; what it sends meanwhile is thrown away.

        Closing a socket with unread data resets the connection, and the close frame would be lost.
        """
        while True:
            read = asyncio.ensure_future(self.stream.read_bytes(_READ_BYTES, partial=True))
            await asyncio.wait({read}, timeout=_LAST_SILENCE_S)
            if not read.done():
                self._abort()
            await read

    async def _receive_messages(self) -> None:
        reader = FrameReader(self.params.max_message_size, extensions=self._decompressor is not None)
        keepalive = self._keepalive
        assert keepalive is not None
        unpaused = 0
        try:
            while not self.client_terminated:
                data = await self.stream.read_bytes(_READ_BYTES, partial=True)
                keepalive.heard()
                unpaused += len(data)
                for message in reader.feed(data):
                    busy = self._receive(message)
                    if busy is not None:
                        keepalive.pause()
                        await busy
                        keepalive.resume()
                    unpaused += _MESSAGE_COST
                    if unpaused >= _YIELD_BYTES:
                        unpaused = 0
                        await asyncio.sleep(0)
                    if self.client_terminated:
                        return
                if unpaused >= _YIELD_BYTES:
                    unpaused = 0
                    await asyncio.sleep(0)
        except FrameError as error:
            self.close_code, self.close_reason = error.code, error.reason
            self.close(error.code, error.reason)

    def _receive(self, message: framing.Message) -> Optional[asyncio.Future[None]]:
        """Handle one message; what to wait for before the next, if anything."""
        opcode, data = message.opcode, message.data
        if opcode == framing.PING:
            self._answer_ping(data)
        elif opcode == framing.CLOSE:
            self.client_terminated = True
            self.close_code = struct.unpack("!H", data[:2])[0] if len(data) >= 2 else None
            self.close_reason = data[2:].decode("utf-8", "replace")
            self.close(self.close_code)
        elif opcode != framing.PONG:
            if message.compressed:
                data = self._inflate(data)
            return self._run_callback(self.handler.on_message, data)
        return None

    def _answer_ping(self, data: bytes) -> None:
        """Sends a pong. While one waits to be sent, only the newest ping is remembered: a client that pings and
        does not read must not fill the memory (RFC 6455, section 5.5.3)."""
        if self._pong is not None and not self._pong.done():
            self._late_ping = data
        elif not self.is_closing():
            self._late_ping = None
            self._pong = self.stream.write(framing.frame_header(framing.PONG, len(data)) + data)
            self._pong.add_done_callback(self._pong_sent)

    def _pong_sent(self, pong: Future[None]) -> None:
        if pong.exception() is None and self._late_ping is not None:
            self._answer_ping(self._late_ping)

    def _inflate(self, data: bytes) -> bytes:
        assert self._decompressor is not None
        try:
            return self._decompressor.decompress(data)
        except websocket._DecompressTooLargeError as error:
            limit = self.params.max_message_size
            raise FrameError(framing.MESSAGE_TOO_BIG, f"message of more than {limit} bytes") from error
        except zlib.error as error:
            raise FrameError(_INVALID_DATA, f"compressed data is corrupt: {error}") from error
