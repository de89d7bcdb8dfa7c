# SPDX-License-Identifier: BSD-3-Clause
"""One TCPROS connection between a service and its caller, on the event loop.

rospy gives every service connection a thread and waits without a limit. Here both ends, the bridge
calling a service and a web client providing one, are coroutines on plain non-blocking sockets: a slow
peer costs a socket, deadlines are the caller's to set by cancelling, and cancelling closes at once.
"""

from __future__ import annotations

import asyncio
import socket
import threading
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from typing import Any, Callable, Dict, Iterator, List, Mapping, Tuple

import rosgraph.network

from rosbridge_library.internal.exceptions import RosbridgeError
from rosbridge_library.ros.network_errors import describe
from rosbridge_library.ros.sockets import keep_alive
from rosbridge_library.ros.tcpros_header import (
    LENGTH_BYTES,
    HeaderError,
    decode_header,
    decode_length,
    encode_header,
)

URI_SCHEME = "rosrpc://"
_CHUNK_BYTES = 256 * 1024


class ServiceError(RosbridgeError):
    """Why a service could not be called; the root of all such errors."""


class ServiceUnreachable(ServiceError):
    """The node that provides a service can't be talked to. Nothing of a request has been sent."""

    def __init__(self, service: str, uri: str, reason: str) -> None:
        super().__init__(f"service {service} can't be reached at {uri}: {reason}")
        self.service = service
        self.uri = uri
        self.reason = reason


class ServiceRefused(ServiceUnreachable):
    """The node answers, but refuses to connect to this service: it does not provide it, or not of that
    type.
    """


class ConnectionEnded(Exception):
    """The peer closed the connection, or the network did; the text is the reason."""


class ServiceConnection:
    """A connected socket that is read in exact amounts. One coroutine reads or writes at a time."""

    def __init__(self, sock: socket.socket) -> None:
        """Own `sock` from now on, and set it up: non-blocking, TCP_NODELAY, keep-alive."""
        self._socket = sock
        self._buffer = bytearray()
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        keep_alive(sock)

    async def read(self, size: int) -> bytes:
        """Return the next `size` bytes. Memory grows with what came, not with `size`. Raises
        ConnectionEnded.
        """
        loop = asyncio.get_running_loop()
        while len(self._buffer) < size:
            try:
                chunk = await loop.sock_recv(self._socket, _CHUNK_BYTES)
            except OSError as error:
                raise ConnectionEnded(describe(error)) from error
            if not chunk:
                raise ConnectionEnded("the connection was closed")
            self._buffer += chunk
            if len(self._buffer) < size:
                await asyncio.sleep(0)  # while bytes are there sock_recv does not wait: let others have their turn
        data = bytes(memoryview(self._buffer)[:size])
        del self._buffer[:size]
        return data

    async def send(self, data: bytes) -> None:
        """Send all of `data`. Raises ConnectionEnded."""
        try:
            await asyncio.get_running_loop().sock_sendall(self._socket, data)
        except OSError as error:
            raise ConnectionEnded(describe(error)) from error

    @contextmanager
    def watched(self, gone: Callable[[], Any]) -> Iterator[None]:
        """Call `gone` when the peer closes the connection while nothing is read or written inside the
        block.
        """
        loop = asyncio.get_running_loop()
        descriptor = self._socket.fileno()

        def readable() -> None:
            try:
                ended = not self._socket.recv(1, socket.MSG_PEEK)
            except BlockingIOError:
                return
            except OSError:
                ended = True
            loop.remove_reader(descriptor)  # at the end, or the next request came early: it stays where it is
            if ended:
                gone()

        loop.add_reader(descriptor, readable)
        try:
            yield
        finally:
            loop.remove_reader(descriptor)

    def close(self) -> None:
        """Close the socket. No coroutine may be reading or writing."""
        self._socket.close()


async def open_connection(
    service: str, uri: str, fields: Mapping[str, str]
) -> Tuple[ServiceConnection, Dict[str, str]]:
    """Connect to `service` at `uri` (rosrpc://host:port) and exchange headers; return the provider's header
    too.

    Sends `fields` and the service's name. Waits as long as it takes: set a deadline around it.
    Raises ServiceUnreachable, ServiceRefused, and HeaderError for fields that can't be sent.
    """
    request = encode_header({"service": service, **fields})
    try:
        connection = ServiceConnection(await _connect(*_host_and_port(uri)))
    except (OSError, ValueError) as error:
        raise ServiceUnreachable(service, uri, describe(error)) from error
    try:
        await connection.send(request)
        length = decode_length(await connection.read(LENGTH_BYTES))
        header = decode_header(await connection.read(length))
        if "error" in header:
            raise ServiceRefused(service, uri, header["error"])
    except (ConnectionEnded, HeaderError) as error:
        connection.close()
        raise ServiceUnreachable(service, uri, str(error)) from error
    except BaseException:
        connection.close()
        raise
    return connection, header


def _host_and_port(uri: str) -> Tuple[str, int]:
    """Raises ValueError for anything but rosrpc://host:port."""
    address = uri[len(URI_SCHEME) :].split("/")[0] if uri.startswith(URI_SCHEME) else ""
    host, _, port = address.rpartition(":")
    if not host or not (port.isascii() and port.isdigit()) or int(port) > 65535:
        raise ValueError("its address is not of the form rosrpc://host:port")
    return host.strip("[]"), int(port)


async def _connect(host: str, port: int) -> socket.socket:
    loop = asyncio.get_running_loop()
    failure = OSError(f"the host {host} has no address")
    for family, address in await _addresses(host):
        sock = socket.socket(family, socket.SOCK_STREAM)
        try:
            sock.setblocking(False)
            await loop.sock_connect(sock, (address, port))
        except OSError as error:
            sock.close()
            failure = error
        except BaseException:
            sock.close()
            raise
        else:
            return sock
    raise failure


_resolving: Dict[str, Future[List[Tuple[int, str]]]] = {}
_resolving_lock = threading.Lock()


async def _addresses(host: str) -> List[Tuple[int, str]]:
    """The (family, address) pairs of a host. As in ROS only IPv4, unless ROS_IPV6 is on.

    A name server that does not answer blocks its thread for long: so there is one per host, joined by all
    who ask meanwhile, and a daemon, since the threads of an executor would hold up the end of the process.
    """
    with suppress(socket.gaierror, UnicodeError):
        return _look_up(host, socket.AI_NUMERICHOST)  # an address needs no name server
    with _resolving_lock:
        future = _resolving.get(host)
        if future is None:
            future = _resolving[host] = Future()
            future.set_running_or_notify_cancel()  # now those who stop waiting don't cancel it for others
            threading.Thread(target=_resolve, args=(host, future), daemon=True).start()
    return await asyncio.wrap_future(future)


def _look_up(host: str, flags: int = 0) -> List[Tuple[int, str]]:
    family = socket.AF_UNSPEC if rosgraph.network.use_ipv6() else socket.AF_INET
    found = socket.getaddrinfo(host, None, family, socket.SOCK_STREAM, 0, flags)
    return [(entry[0], str(entry[4][0])) for entry in found]


def _resolve(host: str, future: Future[List[Tuple[int, str]]]) -> None:
    try:
        outcome: Any = _look_up(host)
    except (OSError, UnicodeError) as error:
        outcome = error
    with _resolving_lock:
        del _resolving[host]
    if isinstance(outcome, Exception):
        future.set_exception(outcome)
    else:
        future.set_result(outcome)
