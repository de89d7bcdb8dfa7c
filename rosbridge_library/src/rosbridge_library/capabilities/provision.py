# SPDX-License-Identifier: BSD-3-Clause
"""Which services one client provides: what advertise_service, unadvertise_service and service_response share.

A ROS call becomes a call_service operation to the client with an id of our own, which its service_response carries.
"""

from __future__ import annotations

import asyncio
import itertools
from typing import Any, Dict, NamedTuple, Optional, Tuple

from rospy.impl.registration import Registration

from rosbridge_library.capabilities.publication import AccessDenied, ClientGone
from rosbridge_library.capability import Operation, OperationId
from rosbridge_library.codec import MessageType
from rosbridge_library.encodings import service_call
from rosbridge_library.internal.exceptions import InvalidArgumentException, RosbridgeError, ValuesError
from rosbridge_library.names import checked_global_name
from rosbridge_library.protocol import Protocol
from rosbridge_library.ros.master import MasterUnreachable
from rosbridge_library.ros.providers import Provider


class ClientFailed(RosbridgeError):
    """The client answered that a call of its service failed."""


class _Request(NamedTuple):
    service: str
    response: MessageType
    answered: asyncio.Future[bytes]


class Provisions:
    """The services of one client, by the name that it wrote, and the requests that it has not answered yet."""

    def __init__(self, protocol: Protocol) -> None:
        self._protocol = protocol
        self._providers: Dict[str, Provider] = {}
        self._requests: Dict[str, _Request] = {}
        self._numbers = itertools.count(1)

    async def advertise(self, service: str, type_name: str, lid: OperationId = None) -> Provider:
        """Provide `service`; what is already provided under this name by this client is replaced.

        Raises InvalidArgumentException, AccessDenied, TypeLoadError, AdvertiseError.
        """
        name = checked_global_name(service, "service")
        node = self._protocol.node
        if not node.access.may_provide(name):
            raise AccessDenied(f"the server does not let clients provide {service}")

        async def call_client(type_: MessageType, wire: bytes) -> bytes:
            return await self._call_client(service, type_, provider.type.response, wire)

        provider = await node.providers.advertise(node.resolve(name), type_name, call_client)
        if self._protocol.finished:
            provider.unadvertise(f"the client that provides {service} has disconnected")
            raise ClientGone(f"the client is gone; {service} is not provided by it")
        self._providers[service] = provider
        try:
            await node.registered(Registration.SRV, node.resolve(name))
        except MasterUnreachable as error:
            self._protocol.log("error", f"{error}; {service} will be advertised when it is back", lid)
        return provider

    def unadvertise(self, service: str) -> bool:
        """Stop providing `service`: its pending calls fail. False: this client does not provide it."""
        provider = self._providers.pop(service, None)
        if provider is None or not provider.active:
            return False
        provider.unadvertise(f"the client that provides {service} has taken it back")
        return True

    def close(self) -> None:
        """The client is gone: its services go, and their pending calls fail at once."""
        for service, provider in self._providers.items():
            provider.unadvertise(f"the client that provides {service} has disconnected")
        self._providers.clear()

    async def _call_client(
        self, service: str, request_type: MessageType, response_type: MessageType, wire: bytes
    ) -> bytes:
        request_id = f"service_request:{service}:{next(self._numbers)}"
        envelope = {"op": "call_service", "id": request_id, "service": service}
        request = _Request(service, response_type, self._protocol.loop.create_future())
        self._requests[request_id] = request
        try:
            payload = service_call(request_type, wire, envelope, self._protocol.encoding("none"))
            self._protocol.send_payload(payload)
            return await request.answered
        finally:
            del self._requests[request_id]

    def answer(self, message: Operation) -> None:
        """Take a client's service_response. When `values` is there it is the response, whatever `result` says.

        Raises InvalidArgumentException for what answers no open request, and ValuesError for values that are no
        response of the service; then the ROS call has failed too.
        """
        request = self._requests.get(str(message.get("id")))
        if request is None or request.answered.done():
            raise InvalidArgumentException(f"no call of {message.get('service')} waits for the id {message.get('id')}")
        values, result = message.get("values"), message.get("result")
        # roslib 2 answers with neither when the callback returned nothing.
        if (values is None and result is not True) or (isinstance(values, str) and result is False):
            reason = f"the client that provides {request.service} says it failed" + (f": {values}" if values else "")
            request.answered.set_exception(ClientFailed(reason))
            return
        try:
            wire, missing = self._response(request, values)
        except ValuesError as error:
            request.answered.set_exception(
                ClientFailed(f"the client that provides {request.service} gave no valid response: {error}")
            )
            raise
        request.answered.set_result(wire)
        if missing:
            left_out = ", ".join(missing)
            self._protocol.log(
                "warning",
                f"service_response: fields left out were filled with defaults: {left_out}",
                message.get("id"),
            )

    def _response(self, request: _Request, values: Any) -> Tuple[bytes, Any]:
        if values is None:
            values = {}
        elif isinstance(values, list):
            names = [field.name for field in request.response.fields]
            if len(values) > len(names):
                raise ValuesError(f"{request.response.name} has {len(names)} fields, not {len(values)}", "")
            values = dict(zip(names, values))
        return request.response.from_values(values, self._protocol.node.now)


def provisions(protocol: Protocol) -> Provisions:
    """The provisions of `protocol`, made when first asked for."""
    found: Optional[object] = protocol.shared.get("provisions")
    if found is None:
        found = protocol.shared["provisions"] = Provisions(protocol)
    assert isinstance(found, Provisions)
    return found
