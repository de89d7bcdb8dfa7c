# SPDX-License-Identifier: BSD-3-Clause
"""ROS services that web clients provide.

rospy registers such a service, and accepts and negotiates its connections. Then it would give each
connection a thread; instead the socket is handed to the event loop, where requests and responses
pass as raw bytes. So a request that its client takes an hour to answer costs a socket and nothing
else, a ROS caller that goes away is noticed at once, and so is the client's leaving by the callers.

A name has one provider at a time. As in ROS the newest wins: another client, or the same one on a
new connection, takes a name over without the service being away for a moment.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import struct
from typing import Any, Awaitable, Callable, Coroutine, Dict, Mapping, Optional, Set, Tuple
from weakref import WeakValueDictionary

import rospy
from rospy.impl.registration import get_service_manager

from rosbridge_library.codec import MessageType, ServiceType, get_service_type
from rosbridge_library.internal.exceptions import RosbridgeError
from rosbridge_library.names import checked_global_name
from rosbridge_library.ros.accepting import relieve_accept_thread
from rosbridge_library.ros.master import Master, MasterError, MasterUnreachable
from rosbridge_library.ros.service_connection import ConnectionEnded, ServiceConnection

logger = logging.getLogger("rosbridge.providers")

MAX_REQUEST_BYTES = 256 * 1024 * 1024
CLOSING_S = 0.5

Handler = Callable[[MessageType, bytes], Coroutine[Any, Any, bytes]]

_length = struct.Struct("<I")
_answer_prefix = struct.Struct("<BI")


class AdvertiseError(RosbridgeError):
    """A service can't be advertised; the text says why."""


class RequestFailed(RosbridgeError):
    """A request got no response; the text is the reason that the ROS caller gets."""


class Provider:
    """One client's offer of a service, from `ServiceProviders.advertise` until it ends or is taken over."""

    def __init__(
        self,
        providers: ServiceProviders,
        name: str,
        type_: ServiceType,
        handler: Handler,
        timeout: Optional[float],
    ) -> None:
        self.name = name
        self.type = type_
        self.warning: Optional[str] = None
        """Something that the client should be told although the service is advertised."""
        self._providers = providers
        self._handler = handler
        self._timeout = timeout or None
        self._requests: Set[asyncio.Task[bytes]] = set()
        self._ended: Optional[str] = None

    @property
    def active(self) -> bool:
        """Whether requests still come here."""
        return self._ended is None

    def unadvertise(self, reason: str) -> asyncio.Future[None]:
        """Stop providing: pending requests fail with `reason` at once. Has no effect when taken over
        meanwhile.

        The future is done when rospy has unregistered the service; nobody needs to wait for it.
        """
        if not self.active:
            done: asyncio.Future[None] = asyncio.get_running_loop().create_future()
            done.set_result(None)
            return done
        self.end(reason)
        return self._providers.withdraw(self)

    def end(self, reason: str) -> None:
        """Take no more requests, and fail the pending ones with `reason`."""
        if self._ended is None:
            self._ended = reason
        for request in self._requests:
            request.cancel()

    async def answer(self, wire: bytes, connection: ServiceConnection) -> bytes:
        """Have the client answer the request `wire`, and return the response's wire bytes.

        Raises RequestFailed, or ConnectionEnded when the ROS caller closes `connection` meanwhile.
        """
        if self._ended is not None:
            raise RequestFailed(self._ended)
        request = asyncio.ensure_future(self._handler(self.type.request, wire))
        caller_gone = False

        def drop() -> None:
            nonlocal caller_gone
            caller_gone = True
            request.cancel()

        self._requests.add(request)
        try:
            with connection.watched(drop):
                await asyncio.wait({request}, timeout=self._timeout)
        finally:
            self._requests.discard(request)
            answered = request.done()
            request.cancel()
        if caller_gone:
            raise ConnectionEnded("the caller did not wait for the answer")
        if not answered:
            raise RequestFailed(f"the client that provides {self.name} did not answer within {self._timeout:g} s")
        return self._outcome(request)

    def _outcome(self, request: asyncio.Task[bytes]) -> bytes:
        if request.cancelled():
            raise RequestFailed(self._ended or f"the client that provides {self.name} dropped the request")
        error = request.exception()
        if isinstance(error, RosbridgeError):
            raise RequestFailed(str(error)) from error
        if error is not None:
            logger.error("a request to %s failed", self.name, exc_info=error)
            raise RequestFailed(f"error processing the request: {error}") from error
        return request.result()


class ServiceProviders:
    """All services that clients provide. Belongs to one event loop; rospy.init_node comes first."""

    def __init__(
        self,
        call_blocking: Callable[..., Awaitable[Any]],
        master: Master,
        caller_id: str,
        max_request_bytes: int = MAX_REQUEST_BYTES,
    ) -> None:
        """Make the node's providers.

        `call_blocking(function, *args, timeout=…)` awaits a blocking function elsewhere than on the loop; a
        timeout of None is no limit. `caller_id` is this node's name. Longer requests than
        `max_request_bytes` are refused.
        """
        self.max_request_bytes = max_request_bytes
        self._call_blocking = call_blocking
        self._master = master
        self._caller_id = caller_id
        self._services: Dict[str, _RegisteredService] = {}
        self._locks: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()
        self._connections: Set[asyncio.Task[None]] = set()
        self._changes: Set[asyncio.Task[None]] = set()

    async def advertise(self, name: str, type_name: str, handler: Handler, timeout: Optional[float] = None) -> Provider:
        """Provide the service `name`, a global name, from now on; whoever provided it so far no longer does.

        `handler(request_type, request_wire)` is called on the loop for each request and returns the
        response's wire bytes; a RosbridgeError that it raises is told to the ROS caller. It is cancelled
        when its answer is no longer wanted: after `timeout` seconds (None or 0: no limit), when the caller
        leaves, when the provider ends.

        Raises InvalidArgumentException for an illegal name, AdvertiseError, and TypeLoadError for a type
        that is not installed. When cancelled, the service is not provided, or soon no longer.
        """
        name = checked_global_name(name, "service")
        type_: ServiceType = await self._call_blocking(get_service_type, type_name)
        provider = Provider(self, name, type_, handler, timeout)
        try:
            await asyncio.shield(self._change(self._install(provider)))
        except asyncio.CancelledError:
            provider.unadvertise(f"the client that wanted to provide {name} is gone")
            raise
        return provider

    def withdraw(self, provider: Provider) -> asyncio.Task[None]:
        """Unregister a provider that has ended, unless its name is taken over meanwhile."""
        return self._change(self._uninstall(provider))

    async def close(self, reason: str = "the bridge is shutting down") -> None:
        """End all providers, unregister them, and close their connections, all within a second."""
        for service in list(self._services.values()):
            service.provider.unadvertise(reason)
        if self._changes:
            await asyncio.wait(self._changes, timeout=CLOSING_S)
        if self._connections:
            await asyncio.wait(self._connections, timeout=CLOSING_S)  # callers are being told the reason
        for connection in self._connections:
            connection.cancel()
        await asyncio.gather(*self._connections, return_exceptions=True)

    def _change(self, change: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Carry out a change of what is registered, to the end, whether or not anybody waits for it."""
        task = asyncio.ensure_future(change)
        self._changes.add(task)
        task.add_done_callback(self._changed)
        return task

    def _changed(self, task: asyncio.Task[None]) -> None:
        self._changes.discard(task)
        if not task.cancelled() and task.exception() is not None:
            logger.debug("a service could not be advertised: %s", task.exception())

    def _lock(self, name: str) -> asyncio.Lock:
        """What puts the changes of one name in order; it lives while somebody is at it."""
        return self._locks.setdefault(name, asyncio.Lock())

    async def _install(self, provider: Provider) -> None:
        name, type_ = provider.name, provider.type
        async with self._lock(name):
            service = self._services.get(name)
            if service is not None and service.offers(type_):
                service.provider.end(f"{name} was advertised anew meanwhile")
                service.provider = provider
                return
            if service is not None:
                service.provider.end(f"{name} was advertised anew meanwhile, as {type_.name}")
                await self._unregister(service)
            service = _RegisteredService(provider, self._connections, self.max_request_bytes)
            # No deadline: what a thread has begun to register must not be lost sight of.
            provider.warning = await self._call_blocking(service.register, self._master, timeout=None)
            self._services[name] = service

    async def _uninstall(self, provider: Provider) -> None:
        async with self._lock(provider.name):
            service = self._services.get(provider.name)
            if service is not None and service.provider is provider:
                await self._unregister(service)

    async def _unregister(self, service: _RegisteredService) -> None:
        del self._services[service.provider.name]
        service.close_idle_connections()
        try:
            await self._call_blocking(service.unregister, timeout=None)
        except rospy.ServiceException as error:
            logger.warning("unregistering %s failed: %s", service.provider.name, error)


class _RegisteredService:
    """A service as ROS sees it, whoever its provider is at the time."""

    def __init__(self, provider: Provider, connections: Set[asyncio.Task[None]], max_request_bytes: int) -> None:
        """`connections` holds the task of every open connection, of all services."""
        self.provider = provider
        self._type = provider.type
        self._loop = asyncio.get_running_loop()
        self._connections = connections
        self._max_request_bytes = max_request_bytes
        self._idle: Set[asyncio.Task[None]] = set()
        self._ros_service: Optional[_HandingOverService] = None

    def offers(self, type_: ServiceType) -> bool:
        """Whether it is registered with exactly this type."""
        return self._type.name == type_.name and self._type.md5sum == type_.md5sum

    # On a thread of the pool.

    def register(self, master: Master) -> Optional[str]:
        """Register with rospy and the master; return what the client should be told about it, if anything."""
        name = rospy.resolve_name(self.provider.name)
        if get_service_manager().get_service(name) is not None:
            raise AdvertiseError(f"{name} is a service of the bridge itself")
        before, trouble = _present_provider(master, name)
        relieve_accept_thread()
        self._ros_service = _HandingOverService(name, self._type, self._hand_over)
        if before not in (None, self._ros_service.uri):
            return f"{name} was provided by the node at {before}; from now on it is provided by this client"
        return trouble

    def unregister(self) -> None:
        """Undo `register`."""
        if self._ros_service is not None:
            self._ros_service.shutdown("unadvertised")

    def _hand_over(self, sock: socket.socket, header: Mapping[str, str]) -> None:
        """Pass a connection on to the loop. Runs on a thread that rospy made for it."""
        persistent = header.get("persistent", "").lower() in ("1", "true")
        try:
            self._loop.call_soon_threadsafe(self._accept, sock, persistent)
        except RuntimeError:  # the loop is closed: the process is about to end
            sock.close()

    # On the loop.

    def close_idle_connections(self) -> None:
        """Close the connections that wait for a next request; the others end with their answer."""
        for task in self._idle:
            task.cancel()

    def _accept(self, sock: socket.socket, persistent: bool) -> None:
        task = asyncio.ensure_future(self._serve(ServiceConnection(sock), persistent))
        self._connections.add(task)
        task.add_done_callback(self._connections.discard)

    async def _serve(self, connection: ServiceConnection, persistent: bool) -> None:
        try:
            while await self._serve_request(connection) and persistent and self.provider.active:
                pass
        except ConnectionEnded as error:
            logger.debug("a connection to %s ended: %s", self.provider.name, error)
        finally:
            connection.close()

    async def _serve_request(self, connection: ServiceConnection) -> bool:
        """Serve one request; False when no other can be read after it."""
        task = asyncio.current_task()
        assert task is not None
        self._idle.add(task)
        try:
            (length,) = _length.unpack(await connection.read(_length.size))
            too_long = length > self._max_request_bytes
            wire = b"" if too_long else await connection.read(length)
        finally:
            self._idle.discard(task)
        try:
            if too_long:
                raise RequestFailed(f"a request of {length} bytes is over the limit of {self._max_request_bytes}")
            ok, body = 1, await self.provider.answer(wire, connection)
        except RequestFailed as error:
            ok, body = 0, str(error).encode("utf-8", "replace")
        await connection.send(_answer_prefix.pack(ok, len(body)) + body)
        return not too_long


class _HandingOverService(rospy.Service):  # type: ignore[misc]  # rospy has no types
    """A rospy service that hands its connections over instead of serving them."""

    def __init__(
        self, name: str, type_: ServiceType, hand_over: Callable[[socket.socket, Mapping[str, str]], None]
    ) -> None:
        """Register; `hand_over(socket, header)` is called, on a thread of its own, for each connection."""
        self._hand_over = hand_over
        # Of the type rospy only has to know name and md5sum, to negotiate connections.
        identity = {
            "_type": type_.name,
            "_md5sum": type_.md5sum,
            "_request_class": rospy.AnyMsg,
            "_response_class": rospy.AnyMsg,
        }
        super().__init__(name, type("Service", (), identity), handler=None)

    def handle(self, transport: Any, header: Mapping[str, str]) -> None:
        """Called by rospy once both headers have been exchanged."""
        sock, transport.socket = transport.socket, None
        transport.close()
        if header.get("probe") == "1":
            sock.close()
        else:
            self._hand_over(sock, header)


def _present_provider(master: Master, name: str) -> Tuple[Optional[str], Optional[str]]:
    """The uri of the node that provides a service now, if any; and why that can't be known, if so."""
    try:
        return str(master.call("lookupService", name)), None
    except MasterError:
        return None, None
    except MasterUnreachable as error:
        return None, f"{name} will be registered when the ROS master is back: {error}"
