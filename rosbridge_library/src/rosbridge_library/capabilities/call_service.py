# SPDX-License-Identifier: BSD-3-Clause
"""call_service (specification 3.4.6): a client calls a ROS service.

Calls run beside each other and beside the client's other operations. Each gets exactly one service_response; when it
fails, `result` is false and `values` the reason.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Optional, Tuple

from rosbridge_library.capabilities.publication import AccessDenied
from rosbridge_library.capability import Capability, Operation, OperationId, checked_id, on_loop
from rosbridge_library.encodings import service_response
from rosbridge_library.internal.exceptions import InvalidArgumentException, RosbridgeError
from rosbridge_library.names import checked_global_name

if TYPE_CHECKING:
    from rosbridge_library.protocol import Protocol

COMPRESSIONS = ("none", "png", "cbor")
MAX_TIMEOUT_S = 1e9


class CallService(Capability):
    """Calls ROS services for a client."""

    call_service_msg_fields = (
        (True, "service", str),
        (False, "type", str),
        (False, "args", (list, dict)),
        (False, "timeout", (int, float)),
        (False, "fragment_size", int),
        (False, "compression", str),
    )

    def __init__(self, protocol: Protocol) -> None:
        super().__init__(protocol)
        protocol.register_operation("call_service", self.call_service)

    @on_loop
    def call_service(self, message: Operation) -> None:
        """Begin a call."""
        self.protocol.spawn(self._call(message), message)

    async def _call(self, message: Operation) -> None:
        try:
            await self._call_and_respond(message)
        except RosbridgeError as error:
            self._respond_failure(message, str(error))
            raise
        except Exception as error:  # a bug here must not leave the client waiting; it is reported whole by the caller
            self._respond_failure(message, f"internal error ({type(error).__name__})")
            raise

    async def _call_and_respond(self, message: Operation) -> None:
        self.basic_type_check(message, self.call_service_msg_fields)
        compression, fragment_size, timeout_s = _wishes(message)
        name = checked_global_name(message["service"].split("#", 1)[0], "service")
        if not self.protocol.node.access.may_call(name):
            raise AccessDenied(f"the server does not let clients call {name}")
        node = self.protocol.node
        if timeout_s is None:
            timeout_s = self.protocol.parameters.default_call_service_timeout
        reply = await node.services.call(
            node.resolve(name), message.get("args"), message.get("type"), timeout_s, now=node.now
        )
        if reply.missing:
            left_out = ", ".join(reply.missing)
            self.protocol.log(
                "warning",
                f"call_service: fields left out were filled with defaults: {left_out}",
                _call_id(message),
            )
        envelope = {**_envelope(message), "result": True}
        payload = service_response(reply.type, reply.wire, envelope, self.protocol.encoding(compression))
        self.protocol.send_payload(payload, fragment_size)

    def _respond_failure(self, message: Operation, reason: str) -> None:
        self.protocol.send({**_envelope(message), "values": reason, "result": False})


def _envelope(message: Operation) -> Operation:
    """`service` and `id` as the client wrote them, whatever they are, as far as a reply can hold them."""
    service = message.get("service")
    envelope: Operation = {"op": "service_response", "service": service if isinstance(service, str) else ""}
    lid = _call_id(message)
    return envelope if lid is None else {**envelope, "id": lid}


def _call_id(message: Operation) -> OperationId:
    """The id of a call; in the old form "/service#id" it is what follows the #."""
    try:
        lid = checked_id(message)
    except InvalidArgumentException:
        return None
    service = message.get("service")
    return service.partition("#")[2] or None if lid is None and isinstance(service, str) else lid


def _wishes(message: Operation) -> Tuple[str, Optional[int], Optional[float]]:
    compression = message.get("compression") or "none"
    if compression not in COMPRESSIONS:
        raise InvalidArgumentException(f"the field 'compression' must be one of {', '.join(COMPRESSIONS)}")
    fragment_size = message.get("fragment_size")
    if fragment_size is not None and fragment_size < 1:
        raise InvalidArgumentException("the field 'fragment_size' must be 1 or more")
    timeout_s = message.get("timeout")
    if timeout_s is not None and not 0 <= timeout_s < float("inf"):
        raise InvalidArgumentException("the field 'timeout' must be a number of seconds, or 0 for none")
    if timeout_s is not None:
        timeout_s = min(timeout_s, MAX_TIMEOUT_S)
    return compression, fragment_size, timeout_s
