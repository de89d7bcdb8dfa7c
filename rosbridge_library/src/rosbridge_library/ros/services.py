# SPDX-License-Identifier: BSD-3-Clause
"""Calling ROS services, as coroutines.

Where a service is and of what type is looked up once and kept until a call fails. Then a call is a
connection of its own: header, request, answer. Connections are not kept for the next call: from a
connection that breaks one can't tell whether the request had been executed, and no request may ever
be executed twice. For the same reason a call is begun anew, with a new look-up, only as long as
nothing of the request was sent: when what was kept turns out to be outdated.

Every failure is an exception whose text is a sentence for the client.
"""

from __future__ import annotations

import asyncio
import struct
from dataclasses import dataclass
from typing import Any, Awaitable, Callable, Dict, List, Mapping, NamedTuple, Optional, Sequence, Tuple, Union
from weakref import WeakValueDictionary

from rosbridge_library.codec import MessageType, ServiceType, get_service_type
from rosbridge_library.internal.exceptions import RosbridgeError, ValuesError, WireError
from rosbridge_library.ros.master import Master, MasterError
from rosbridge_library.ros.service_connection import (
    ConnectionEnded,
    ServiceConnection,
    ServiceError,
    ServiceRefused,
    ServiceUnreachable,
    open_connection,
)
from rosbridge_library.ros.service_probe import probe_service

__all__ = [
    "BadServiceAnswer",
    "InvalidServiceArguments",
    "NoSuchService",
    "ServiceCaller",
    "ServiceDisconnected",
    "ServiceError",
    "ServiceFailed",
    "ServiceRefused",
    "ServiceReply",
    "ServiceTimeout",
    "ServiceTypeUnknown",
    "ServiceUnreachable",
]

DEFAULT_TIMEOUT_S = 30.0
LOOKUP_TIMEOUT_S = 10.0
MAX_ANSWER_BYTES = 256 * 1024 * 1024
MAX_ERROR_BYTES = 1024 * 1024
# A rospy node has a queue of five for connections to come; beyond it the kernel drops them, and tries again
# after 1, 3, 7, 15 seconds. So of a burst of calls to one node only this many connect at a time.
CONNECTING_PER_NODE = 4

Arguments = Union[Mapping[str, Any], Sequence[Any], bytes, None]
Clock = Callable[[], Tuple[int, int]]

_answer_prefix = struct.Struct("<BI")
_length = struct.Struct("<I")


class NoSuchService(ServiceError):
    """No node provides the service."""


class ServiceTypeUnknown(ServiceError):
    """The type of the service is not installed here, or is another version of it."""


class InvalidServiceArguments(ServiceError):
    """The arguments are neither a list nor an object, or more than the request has fields."""


class ServiceFailed(ServiceError):
    """The provider answered that the call failed; the text includes its reason."""


class ServiceTimeout(ServiceError):
    """The call did not end in time."""


class ServiceDisconnected(ServiceError):
    """The provider closed the connection in the middle of a call. It may have executed the request."""


class BadServiceAnswer(ServiceError):
    """The provider's answer is not of the service protocol, or is longer than the limit."""


class ServiceReply(NamedTuple):
    """The response to a call."""

    type: MessageType
    wire: bytes
    """The serialized response, as it came: `type`'s codecs raise WireError when it is not of that type."""
    missing: List[str]
    """Dotted paths of the request's fields that the arguments left out, and which were sent as defaults."""


@dataclass(frozen=True)
class _Service:
    name: str
    uri: str
    type: ServiceType


@dataclass
class _Progress:
    """What a call is waiting for, to tell when it took too long."""

    stage: str = "looking it up"


class ServiceCaller:
    """Calls services for all clients. Belongs to one event loop."""

    def __init__(
        self,
        call_blocking: Callable[..., Awaitable[Any]],
        master: Master,
        caller_id: str,
        default_timeout: float = DEFAULT_TIMEOUT_S,
        max_answer_bytes: int = MAX_ANSWER_BYTES,
    ) -> None:
        """Make a caller.

        `call_blocking(function, *args)` awaits a blocking function elsewhere than on the loop. `caller_id`
        is this node's name. `default_timeout` in seconds, 0 for none, is for calls that name none. Longer
        answers than `max_answer_bytes` are refused.
        """
        self.default_timeout = default_timeout
        self.max_answer_bytes = max_answer_bytes
        self._call_blocking = call_blocking
        self._master = master
        self._caller_id = caller_id
        self._known: Dict[str, _Service] = {}
        self._lookups: Dict[str, asyncio.Task[_Service]] = {}
        self._connecting: WeakValueDictionary[str, asyncio.Semaphore] = WeakValueDictionary()

    async def call(
        self,
        service: str,
        arguments: Arguments = None,
        type_name: Optional[str] = None,
        timeout: Optional[float] = None,
        *,
        now: Clock,
    ) -> ServiceReply:
        """Call `service`, a global name, and return its response.

        `arguments` are the request's values: by name, or a list of them in the order of the fields. Bytes are the
        serialized request itself.
        `type_name` is used for a provider that does not say its type, and else ignored. The call takes no
        longer than `timeout` seconds, look-up included; 0 is no limit, None the default. `now` gives the
        ROS time for stamps. Cancelling closes the connection.

        Raises a ServiceError, MasterUnreachable, or the ValuesError or WireError of arguments that don't conform
        to the type.
        """
        seconds = self.default_timeout if timeout is None else timeout
        progress = _Progress()
        try:
            return await asyncio.wait_for(
                self._call(service, arguments, type_name, now, progress), seconds if seconds > 0 else None
            )
        except asyncio.TimeoutError:
            message = f"the call of service {service} took longer than {seconds:g} s: it was {progress.stage}"
            raise ServiceTimeout(message) from None

    async def close(self) -> None:
        """Forget all that is known, and end look-ups that are under way."""
        self._known.clear()
        lookups = list(self._lookups.values())
        for lookup in lookups:
            lookup.cancel()
        await asyncio.gather(*lookups, return_exceptions=True)

    async def _call(
        self, name: str, arguments: Arguments, type_name: Optional[str], now: Clock, progress: _Progress
    ) -> ServiceReply:
        kept = self._known.get(name)
        if kept is not None:
            try:
                return await self._call_known(kept, arguments, now, progress)
            except (ServiceUnreachable, InvalidServiceArguments, ValuesError, WireError):
                # Nothing was sent: the service has moved, or has another type now.
                progress.stage = "looking it up again"
        found = await self._find(name, type_name)
        return await self._call_known(found, arguments, now, progress)

    async def _call_known(
        self, service: _Service, arguments: Arguments, now: Clock, progress: _Progress
    ) -> ServiceReply:
        sound = False
        try:
            wire, missing = _encode_request(service, arguments, now)
            progress.stage = f"connecting to {service.uri}"
            connection = await self._connect(service)
            try:
                progress.stage = f"waiting for the answer of {service.uri}"
                answer = await self._exchange(service, connection, wire)
            finally:
                connection.close()
            sound = True
        except ServiceFailed:
            sound = True
            raise
        finally:
            if not sound and self._known.get(service.name) is service:
                del self._known[service.name]
        return ServiceReply(service.type.response, answer, missing)

    async def _connect(self, service: _Service) -> ServiceConnection:
        fields = {"callerid": self._caller_id, "md5sum": service.type.md5sum}
        async with self._gate(service.uri):
            connection, header = await open_connection(service.name, service.uri, fields)
        if header.get("md5sum", service.type.md5sum) not in (service.type.md5sum, "*"):
            connection.close()
            raise ServiceRefused(service.name, service.uri, f"it is of type {header.get('type')} now")
        return connection

    async def _exchange(self, service: _Service, connection: ServiceConnection, wire: bytes) -> bytes:
        """Send the request and return the response, both as wire bytes."""
        try:
            await connection.send(_length.pack(len(wire)) + wire)
            ok, length = _answer_prefix.unpack(await connection.read(_answer_prefix.size))
            limit = self.max_answer_bytes if ok else MAX_ERROR_BYTES
            if ok > 1 or length > limit:
                what = f"byte {ok} where 0 or 1 is due" if ok > 1 else f"{length} bytes, over {limit}"
                raise BadServiceAnswer(f"service {service.name} at {service.uri} sent a bad answer: {what}")
            body = await connection.read(length)
        except ConnectionEnded as error:
            message = f"service {service.name} at {service.uri} ended the call without a complete answer: {error}"
            raise ServiceDisconnected(message) from error
        if not ok:
            raise ServiceFailed(f"service {service.name} failed: {body.decode('utf-8', 'replace')}")
        return body

    def _gate(self, uri: str) -> asyncio.Semaphore:
        """What lets few at a time connect to a node; it lives while somebody is at it."""
        return self._connecting.setdefault(uri, asyncio.Semaphore(CONNECTING_PER_NODE))

    async def _find(self, name: str, type_name: Optional[str]) -> _Service:
        """Look a service up, once for all who ask meanwhile."""
        lookup = self._lookups.get(name)
        if lookup is None:
            lookup = asyncio.ensure_future(self._look_up(name, type_name))
            self._lookups[name] = lookup
            lookup.add_done_callback(lambda done: self._found(name, done))
        return await asyncio.shield(lookup)

    def _found(self, name: str, lookup: asyncio.Task[_Service]) -> None:
        del self._lookups[name]
        # exception() also tells asyncio that a failure is known, when nobody waits for it any more.
        if not lookup.cancelled() and lookup.exception() is None:
            self._known[name] = lookup.result()

    async def _look_up(self, name: str, type_name: Optional[str]) -> _Service:
        try:
            uri = str(await self._call_blocking(self._master.call, "lookupService", name))
        except MasterError as error:
            raise NoSuchService(f"service {name} does not exist: {error}") from error
        async with self._gate(uri):
            header = await probe_service(uri, name, self._caller_id, LOOKUP_TIMEOUT_S)
        provided = header.get("type") or type_name
        if not provided:
            raise ServiceTypeUnknown(f"service {name} at {uri} does not say of what type it is")
        try:
            service_type: ServiceType = await self._call_blocking(get_service_type, provided)
        except RosbridgeError as error:
            raise ServiceTypeUnknown(f"service {name} is of type {provided}, unknown here: {error}") from error
        if header.get("md5sum", service_type.md5sum) not in (service_type.md5sum, "*"):
            raise ServiceTypeUnknown(
                f"service {name} is of another version of type {provided}: its md5sum is {header['md5sum']}, "
                f"here it is {service_type.md5sum}"
            )
        return _Service(name, uri, service_type)


def _encode_request(service: _Service, arguments: Arguments, now: Clock) -> Tuple[bytes, List[str]]:
    request = service.type.request
    if isinstance(arguments, bytes):
        request.check(arguments)
        return arguments, []
    if arguments is None:
        values: Mapping[str, Any] = {}
    elif isinstance(arguments, Mapping):
        values = arguments
    elif isinstance(arguments, (list, tuple)):
        names = [each.name for each in request.fields]
        if len(arguments) > len(names):
            takes = f"{len(names)} arguments ({', '.join(names)})" if names else "no arguments"
            raise InvalidServiceArguments(f"service {service.name} takes {takes}, not {len(arguments)}")
        values = dict(zip(names, arguments))
    else:
        kind = type(arguments).__name__
        raise InvalidServiceArguments(f"the arguments of service {service.name} are a {kind}, not a list or an object")
    return request.from_values(values, now)
