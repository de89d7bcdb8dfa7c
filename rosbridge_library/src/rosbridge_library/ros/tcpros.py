# SPDX-License-Identifier: BSD-3-Clause
"""TCPROS topic connections, read and written on the event loop.

rospy gives each connection a thread that deserializes what it reads. Here rospy still registers and negotiates, but the
sockets belong to the loop: `LoopTcprosHandler` takes the place of rospy's TCPROS handler and makes these connections:

- `InboundConnection` connects to one publisher of a topic and hands on each message as the bytes on the wire. A message
  that doesn't fit what has been read is read straight into memory of its own size. Lost connections are made again for
  as long as the publisher says that it publishes the topic.
- `OutboundConnection` writes messages to one subscriber of a topic that the bridge publishes. What the socket doesn't
  take at once waits in a bounded queue, oldest dropped first.

Both are rospy transports too, so that `rosnode info`, `rostopic info` and the bus statistics stay right. rospy may
close them from any of its threads; the socket itself is only ever touched on the loop.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import struct
import threading
from collections import deque
from typing import Any, Callable, Deque, Dict, Iterator, List, Optional, Tuple

import genpy
import numpy as np
import rospy
from rosgraph.network import use_ipv6
from roslib.message import get_message_class
from rospy.impl.registration import get_topic_manager
from rospy.impl.tcpros_base import TCPROS, TCPROSTransport
from rospy.impl.tcpros_pubsub import TCPROSHandler, TCPROSPub, TCPROSSub
from rospy.impl.transport import Transport

from rosbridge_library.ros.master import NodeApi, NodeError, NodeUnreachable
from rosbridge_library.ros.message import Wire
from rosbridge_library.ros.sockets import keep_alive
from rosbridge_library.ros.tcpros_header import LENGTH_BYTES, HeaderError, decode_header, decode_length, encode_header

logger = logging.getLogger("rosbridge.tcpros")

READ_BYTES = 65536
MAX_MESSAGE_BYTES = 1 << 30
"""A length above this is taken for a corrupt stream, which closes the connection."""
CONNECT_TIMEOUT_S = 10.0
RETRY_FIRST_S, RETRY_MAX_S = 0.2, 10.0
MAX_WAITING_CALLS = 1000
MAX_QUEUED_BYTES = 64 * 1024 * 1024
"""How much may wait for one subscriber of a topic that the bridge publishes."""

_LENGTH = struct.Struct("<I")


class LoopTcprosHandler(TCPROSHandler):  # type: ignore[misc]  # rospy has no types
    """Makes topic connections that live on `loop`.

    What publishers of a topic send goes to the receiver in `inbound`; a subscriber of a topic goes to the function in
    `outbound`. `renew(topic)` is called when a connection to a publisher has been given up: the publisher may have come
    back meanwhile, and rospy did not connect to it since the connection was still there.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, renew: Callable[[str], None]) -> None:
        super().__init__()
        self.loop = loop
        self.renew = renew
        self.inbound: Dict[str, Receiver] = {}
        self.outbound: Dict[str, Callable[[OutboundConnection], None]] = {}

    def create_transport(self, resolved_name: str, pub_uri: str, protocol_params: List[Any]) -> Tuple[int, str, int]:
        """rospy's request, in a thread of its own, to connect to one publisher. The reply is code, message, port."""
        if len(protocol_params) != 3 or protocol_params[0] != TCPROS:
            return 0, f"not TCPROS parameters: {protocol_params}", 0
        _, host, port = protocol_params
        subscriber = get_topic_manager().get_subscriber_impl(resolved_name)
        if subscriber is None:
            return 0, f"no longer subscribed to {resolved_name}", 0
        with subscriber.c_lock:
            # rospy asks twice, at once, when the master names a publisher in two messages; rospy's own rule, that the
            # newer connection replaces the older, would lose what the older has read.
            if subscriber.has_connection(pub_uri):
                return 1, f"{resolved_name} is connected to {pub_uri} already", port
            connection = InboundConnection(self, subscriber, (host, port), pub_uri)
            if not subscriber.add_connection(connection):
                return 0, f"no longer subscribed to {resolved_name}", 0
        self.loop.call_soon_threadsafe(connection.start)
        return 1, f"connecting {resolved_name} to {host}:{port}", port

    def topic_connection_handler(
        self, sock: socket.socket, client_addr: Tuple[str, int], header: Dict[str, str]
    ) -> Optional[str]:
        """rospy's request, in its accept thread, to serve one subscriber. Returns why not, or None."""
        attach = self.outbound.get(header.get("topic", ""))
        if attach is None:
            error: Optional[str] = super().topic_connection_handler(sock, client_addr, header)
            return error
        publisher = get_topic_manager().get_publisher_impl(header["topic"])
        if publisher is None or publisher.closed:
            return f"[{rospy.get_name()}] does not publish [{header['topic']}]"
        wanted, offered = header.get("md5sum"), publisher.data_class._md5sum
        if wanted not in (offered, "*"):
            return (
                f"[{header.get('callerid')}] wants topic [{header['topic']}] as [{header.get('type')}/{wanted}], "
                f"but it is published as [{publisher.data_class._type}/{offered}]"
            )
        connection = OutboundConnection(self.loop, publisher, sock, client_addr, header)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        publisher.add_connection(connection)
        self.loop.call_soon_threadsafe(connection.start, attach)
        return None


class NoPoller:
    """Takes the place of a topic's poller, in which rospy looks for lost connections: ours notice that themselves.

    rospy's is an open file that refers to itself, so each topic would leave one behind until the garbage is collected.
    """

    def add_fd(self, fd: int) -> None:
        """A connection has come; ours have no file for rospy."""

    def remove_fd(self, fd: int) -> None:
        """A connection has gone."""

    def error_iter(self) -> Iterator[int]:
        """The files with errors."""
        return iter(())

    @classmethod
    def replace(cls, topic: Any) -> None:
        """Have `topic`, rospy's publisher or subscriber, poll no more."""
        poller: Any = topic.connection_poll.poller
        topic.connection_poll = cls()
        if hasattr(poller, "close"):
            poller.close()


class _LoopTransport(TCPROSTransport):  # type: ignore[misc]
    """What both directions share: a socket of the loop's behind rospy's bookkeeping."""

    def __init__(self, loop: asyncio.AbstractEventLoop, protocol: Any, topic: str) -> None:
        super().__init__(protocol, topic)
        self.done: bool = False
        self.socket: Any = None
        self.loop = loop
        self.topic = topic
        self.on_close: Optional[Callable[[], None]] = None
        """Called once, on the loop, when the connection has ended for good."""

    def fileno(self) -> None:
        """None: rospy must not poll a socket that the loop watches."""

    def close(self) -> None:
        """End the connection, from any thread."""
        if self.done:
            return
        self.done = True
        if threading.get_ident() == getattr(self.loop, "_thread_id", None):
            self._close_on_loop()
        elif not self.loop.is_closed():
            self.loop.call_soon_threadsafe(self._close_on_loop)

    def _close_on_loop(self) -> None:
        self._drop_socket()
        Transport.close(self)  # tells rospy's topic
        if self.on_close is not None:
            self.on_close()
            self.on_close = None

    def _drop_socket(self) -> None:
        if self.socket is not None:
            self.loop.remove_reader(self.socket)
            self.loop.remove_writer(self.socket)
            self.socket.close()
            self.socket = None

    def _use_socket(self, sock: socket.socket) -> None:
        self.socket = sock
        self._fileno = sock.fileno()  # only for get_transport_info
        self.local_endpoint = sock.getsockname()[:2]


class Receiver:
    """Takes what the publishers of one topic send; all calls come on the loop."""

    def connected(self, connection: InboundConnection) -> None:
        """The publisher answered; `connection.header` tells type, md5sum, definition, latching and callerid."""

    def received(self, connection: InboundConnection, wire: Wire) -> None:
        """One message."""

    def disconnected(self, connection: InboundConnection) -> None:
        """The connection was lost or closed, after `connected`."""

    def refused(self, connection: InboundConnection, reason: str) -> None:
        """No connection could be made, now; it is tried again while the publisher exists."""


class InboundConnection(_LoopTransport):
    """One publisher's messages. Belongs to the loop from `start` on."""

    def __init__(
        self, handler: LoopTcprosHandler, subscriber: Any, address: Tuple[str, int], publisher_uri: str
    ) -> None:
        protocol = TCPROSSub(subscriber.resolved_name, subscriber.data_class, tcp_nodelay=True)
        super().__init__(handler.loop, protocol, subscriber.resolved_name)
        self._handler = handler
        self._subscriber = subscriber
        self._address = address
        self.set_endpoint_id(publisher_uri)
        self.header: Dict[str, str] = {}
        self.latching = False
        self._task: Optional[asyncio.Task[None]] = None
        self._lost: Optional[asyncio.Future[str]] = None
        # What has been read but not handed on: either a part of small messages at the front of _buffer, or
        # _large, a message that is being read into its own memory.
        self._buffer = memoryview(bytearray(READ_BYTES))
        self._buffered = 0
        self._large: Optional[memoryview] = None
        self._large_read = 0
        self._calls: Optional[_RospyCalls] = None

    def start(self) -> None:
        """Begin to connect and read."""
        if not self.done:
            self._task = self.loop.create_task(self._run())

    def _close_on_loop(self) -> None:
        if self._task is not None and self._task is not asyncio.current_task(self.loop):
            self._task.cancel()
        if self._calls is not None:
            self._calls.close()
        self._large = None
        super()._close_on_loop()

    async def _run(self) -> None:
        """Connect and read, again and again, for as long as the publisher says it publishes the topic."""
        delay_s = RETRY_FIRST_S
        try:
            while not self.done:
                try:
                    await asyncio.wait_for(self._connect(), CONNECT_TIMEOUT_S)
                except (OSError, HeaderError, asyncio.TimeoutError) as error:
                    reason = str(error) or f"no answer within {CONNECT_TIMEOUT_S:g} s"
                    logger.debug("%s: no connection to %s: %s", self.topic, self.endpoint_id, reason)
                    self._tell("refused", reason)
                else:
                    if self.done:  # before Python 3.12 wait_for may swallow a cancellation that comes at its end
                        break
                    delay_s = RETRY_FIRST_S
                    reason = await self._receive()
                    logger.debug("%s: connection to %s ended: %s", self.topic, self.endpoint_id, reason)
                    self._tell("disconnected")
                self._drop_socket()
                await asyncio.sleep(delay_s)
                delay_s = min(delay_s * 2, RETRY_MAX_S)
                if not await self.loop.run_in_executor(None, self._renegotiate):
                    self.close()
                    self._handler.renew(self.topic)
        except asyncio.CancelledError:
            if self._lost is not None:
                self._tell("disconnected")
            raise
        finally:
            self.close()

    def _tell(self, event: str, *details: str) -> None:
        receiver = self._handler.inbound.get(self.topic)
        if event == "disconnected":
            self._lost = None
        if receiver is not None:
            getattr(receiver, event)(self, *details)

    def _renegotiate(self) -> bool:
        """Ask the publisher's node, blocking, where to connect now. False when it no longer publishes the topic."""
        node = NodeApi(rospy.get_name(), self.endpoint_id, timeout=CONNECT_TIMEOUT_S)
        try:
            _, host, port = node.call("requestTopic", self.topic, [[TCPROS]])
        except NodeError:
            return False
        except NodeUnreachable as error:
            # Refused: its process is gone. Anything else may be a network that comes back.
            return not isinstance(error.__cause__, ConnectionRefusedError)
        self._address = (host, port)
        return True

    async def _connect(self) -> None:
        """Raises OSError or HeaderError. On return the loop reads the socket."""
        sock = socket.socket(socket.AF_INET6 if use_ipv6() else socket.AF_INET, socket.SOCK_STREAM)
        sock.setblocking(False)
        keep_alive(sock)
        try:
            await self._sock_connect(sock)
            await self.loop.sock_sendall(sock, encode_header(self.protocol.get_header_fields()))
            header_bytes, rest = await self._read_header(sock)
            self.header = decode_header(header_bytes)
            if "error" in self.header:
                raise HeaderError(f"the publisher refuses: {self.header['error']}")
            self._validate_header(self.header)
        except rospy.exceptions.TransportInitError as error:
            sock.close()
            raise HeaderError(str(error)) from error
        except BaseException:
            sock.close()
            raise
        self._use_socket(sock)
        self.remote_endpoint = self._address
        self.latching = self.header.get("latching") == "1"
        self._buffer[: len(rest)] = rest
        self._buffered, self._large = len(rest), None
        self._lost = self.loop.create_future()
        self._tell("connected")
        self._hand_on()
        if self.socket is not None:
            self.loop.add_reader(sock, self._readable)

    async def _sock_connect(self, sock: socket.socket) -> None:
        infos = await self.loop.getaddrinfo(*self._address, family=sock.family, type=socket.SOCK_STREAM)
        await self.loop.sock_connect(sock, infos[0][4])

    async def _read_header(self, sock: socket.socket) -> Tuple[bytes, bytes]:
        """The connection header, and what came behind it: at most READ_BYTES."""
        read, end = bytearray(), LENGTH_BYTES
        while len(read) < end:
            chunk = await self.loop.sock_recv(sock, 4096)
            if not chunk:
                raise HeaderError("the publisher closed the connection before its header")
            read += chunk
            if end == LENGTH_BYTES and len(read) >= LENGTH_BYTES:
                end += decode_length(bytes(read[:LENGTH_BYTES]))
        return bytes(read[LENGTH_BYTES:end]), bytes(read[end:])

    async def _receive(self) -> str:
        """Wait until the connection ends; why it did."""
        assert self._lost is not None
        return await self._lost

    def _lose(self, reason: str) -> None:
        self._large = None
        if self.socket is not None:
            self.loop.remove_reader(self.socket)
        if self._lost is not None and not self._lost.done():
            self._lost.set_result(reason)

    def _readable(self) -> None:
        large = self._large
        target = self._buffer[self._buffered :] if large is None else large[self._large_read :]
        try:
            count = self.socket.recv_into(target)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._lose(str(error))
            return
        if count == 0:
            self._lose("closed by the publisher")
            return
        self.stat_bytes += count
        if large is None:
            self._buffered += count
            self._hand_on()
        else:
            self._large_read += count
            if self._large_read == len(large):
                self._large = None
                self._received(large.toreadonly())

    def _hand_on(self) -> None:
        """Hand on every whole message in the buffer, and move the rest to its front or to memory of its own."""
        buffer, end, at = self._buffer, self._buffered, 0
        while end - at >= 4:
            (length,) = _LENGTH.unpack_from(buffer, at)
            if at + 4 + length > end:
                if length > MAX_MESSAGE_BYTES:
                    self._buffered = 0
                    self._lose(f"corrupt: a message of {length} bytes")
                    return
                if 4 + length > len(buffer):
                    try:
                        # Its pages are taken as it is filled: a length alone, which may be a lie, costs nothing.
                        self._large = np.empty(length, np.uint8).data
                    except MemoryError:
                        self._buffered = 0
                        self._lose(f"there is no memory for a message of {length} bytes")
                        return
                    self._large_read = end - at - 4
                    self._large[: self._large_read] = buffer[at + 4 : end]
                    at = end
                break
            self._received(bytes(buffer[at + 4 : at + 4 + length]))
            at += 4 + length
        rest = end - at
        if at and rest:
            buffer[:rest] = bytes(buffer[at:end])
        self._buffered = rest

    def _received(self, wire: Wire) -> None:
        if self.done:
            return
        self.stat_num_msg += 1
        receiver = self._handler.inbound.get(self.topic)
        if receiver is not None:
            receiver.received(self, wire)
        if self._subscriber.callbacks:
            if self._calls is None:
                self._calls = _RospyCalls(self, self._subscriber)
            self._calls.put(wire)


class _RospyCalls(threading.Thread):
    """Serves rospy's own subscribers of a topic, in a program that has such, on a thread of theirs: they may block.

    What follows /clock is called at once instead: no message may be older than the time that it is received at.
    """

    def __init__(self, connection: InboundConnection, subscriber: Any) -> None:
        super().__init__(name=f"rospy-calls{connection.topic}", daemon=True)
        self._connection = connection
        self._subscriber = subscriber
        self._waiting: Deque[Wire] = deque(maxlen=subscriber.queue_size or MAX_WAITING_CALLS)
        self._changed = threading.Condition()
        self._closed = False

    def put(self, wire: Wire) -> None:
        """Have the subscribers called with this message; the oldest ones that wait give way."""
        if all(
            str(getattr(callback, "__module__", "")).startswith("rospy.")
            for callback, _ in self._subscriber.callbacks or ()
        ):
            self._call(wire)
            return
        with self._changed:
            self._waiting.append(wire)
            self._changed.notify()
        if self.ident is None:
            self.start()

    def close(self) -> None:
        """End the thread, once a call that it is in returns."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def run(self) -> None:
        while True:
            with self._changed:
                while not self._waiting and not self._closed:
                    self._changed.wait()
                if self._closed:
                    return
                wire = self._waiting.popleft()
            self._call(wire)

    def _call(self, wire: Wire) -> None:
        header = self._connection.header
        # A feed's subscriber, which rospy's joined, has a class without fields.
        cls = self._subscriber.data_class if self._subscriber.data_class.__slots__ else None
        try:
            message = (cls or get_message_class(header["type"]) or rospy.AnyMsg)()
            message.deserialize(bytes(wire))
        except genpy.DeserializationError as error:
            logger.error("%s: a message is no %s: %s", self._connection.topic, header["type"], error)
            return
        message._connection_header = header
        self._subscriber.receive_callback([message], self._connection)


class OutboundConnection(_LoopTransport):
    """One subscriber of a topic that the bridge publishes. Belongs to the loop from `start` on."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        publisher: Any,
        sock: socket.socket,
        address: Tuple[str, int],
        header: Dict[str, str],
    ) -> None:
        protocol = TCPROSPub(publisher.resolved_name, publisher.data_class, is_latch=publisher.is_latch)
        super().__init__(loop, protocol, publisher.resolved_name)
        self.subscriber = header.get("callerid", "unknown")
        self.set_endpoint_id(self.subscriber)
        self.remote_endpoint = address[:2]
        self._use_socket(sock)
        self.queue_size = 0  # set by the publisher; 0 is unbounded by count
        self._queue: Deque[memoryview] = deque()
        self._queued_bytes = 0
        self._head_begun = False
        self.dropped = 0

    def start(self, attach: Callable[[OutboundConnection], None]) -> None:
        """Answer the handshake and watch the socket; `attach` gives the connection to its publisher.

        All in one turn of the loop: what is published once the subscriber knows that it is connected, it gets.
        """
        if self.done:
            self._drop_socket()
            return
        self.socket.setblocking(False)
        self.loop.add_reader(self.socket, self._readable)
        self._transmit(encode_header(self.protocol.get_header_fields()))
        attach(self)

    def write_data(self, data: bytes) -> bool:
        """Send a frame of rospy's, from any thread: a program that embeds the library publishes the topic too."""
        self.loop.call_soon_threadsafe(self.send, data)
        return True

    def send(self, frame: bytes) -> None:
        """Send one message with its length in front, or queue it."""
        if self.socket is not None:
            self.stat_num_msg += 1
            self._transmit(frame)

    def _transmit(self, frame: bytes) -> None:
        if self._queue:
            self._enqueue(memoryview(frame))
            return
        sent = self._write(memoryview(frame))
        if self.socket is not None and sent < len(frame):
            self._head_begun = sent > 0
            self._enqueue(memoryview(frame)[sent:])
            self.loop.add_writer(self.socket, self._writable)

    def _enqueue(self, frame: memoryview) -> None:
        self._queue.append(frame)
        self._queued_bytes += len(frame)
        first = 1 if self._head_begun else 0
        while len(self._queue) > first + 1 and (
            (self.queue_size and len(self._queue) - first > self.queue_size) or self._queued_bytes > MAX_QUEUED_BYTES
        ):
            self._queued_bytes -= len(self._queue[first])
            del self._queue[first]
            self.dropped += 1

    def _write(self, data: memoryview) -> int:
        try:
            count: int = self.socket.send(data)
        except (BlockingIOError, InterruptedError):
            return 0
        except OSError as error:
            logger.debug("%s: subscriber %s is gone: %s", self.topic, self.subscriber, error)
            self.close()
            return 0
        self.stat_bytes += count
        return count

    def _writable(self) -> None:
        while self._queue:
            head = self._queue[0]
            sent = self._write(head)
            if self.socket is None:
                return
            self._queued_bytes -= sent
            if sent < len(head):
                self._queue[0] = head[sent:]
                self._head_begun = self._head_begun or sent > 0
                return
            self._queue.popleft()
            self._head_begun = False
        self.loop.remove_writer(self.socket)

    def _readable(self) -> None:
        """A subscriber sends nothing after its header: this is its end."""
        try:
            if self.socket.recv(4096):
                return
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            logger.debug("%s: subscriber %s is gone: %s", self.topic, self.subscriber, error)
        self.close()
