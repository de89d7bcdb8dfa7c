# SPDX-License-Identifier: BSD-3-Clause
"""The messages of the Foxglove protocol as they are on the wire: pure functions between them and Python values.

A text message is a JSON object with an `op`. A binary one begins with an opcode of one byte; its integers are
little-endian. What a client sends is decoded into the operations of `rosbridge_library.protocol`, binary messages too:
these get an `op` of their own and their fields by name.
"""

from __future__ import annotations

import struct
from typing import Any, Dict, Iterable, List, Mapping, Optional

from rosbridge_library.codec import MessageType, decode_json, encode_json
from rosbridge_library.internal.exceptions import DecodeError
from rosbridge_library.payload import Buffer, Payload

SUBPROTOCOLS = ("foxglove.websocket.v1", "foxglove.sdk.v1")
ENCODINGS = ("ros1", "json")
"""Of what clients publish, and of service calls."""
SCHEMA_ENCODING = "ros1msg"

INFO, WARNING, ERROR = 0, 1, 2
"""Levels of a status."""

MESSAGE_DATA, SERVICE_CALL = "messageData", "serviceCallRequest"
"""The `op` that decoded binary messages get."""

# Server to client, and client to server: the same number is another message there.
_MESSAGE_DATA, _TIME, _SERVICE_RESPONSE, _ASSET = 1, 2, 3, 4
_CLIENT_MESSAGE_DATA, _CLIENT_SERVICE_CALL = 1, 2

_MESSAGE_HEAD = struct.Struct("<BIQ")  # opcode, subscription id, time
_TIME_FRAME = struct.Struct("<BQ")
_SERVICE_HEAD = struct.Struct("<BIII")  # opcode, service id, call id, length of the encoding
_ASSET_HEAD = struct.Struct("<BIBI")  # opcode, request id, status, length of the error message
_CLIENT_MESSAGE_HEAD = struct.Struct("<BI")  # opcode, channel id


class IncompleteCall(DecodeError):
    """A service call that ends too soon, or whose encoding is no text, but which says what to answer to."""

    def __init__(self, reason: str, service_id: int, call_id: int) -> None:
        super().__init__(reason)
        self.service_id = service_id
        self.call_id = call_id


# From clients


def decode(data: bytes) -> Any:
    """The operation that a client's message is. Raises DecodeError.

    JSON text never begins with a control character but white space, so its first byte tells a binary message.
    """
    opcode = data[0] if data else 0
    if opcode == _CLIENT_MESSAGE_DATA:
        return _decode_message_data(data)
    if opcode == _CLIENT_SERVICE_CALL:
        return _decode_service_call(data)
    if opcode < 0x20 and data[:1] not in (b"\t", b"\n", b"\r"):
        raise DecodeError(f"unknown opcode {opcode} of a binary message" if data else "an empty message")
    return decode_json(data)


def _decode_message_data(data: bytes) -> Dict[str, Any]:
    if len(data) < _CLIENT_MESSAGE_HEAD.size:
        raise DecodeError(f"message data of {len(data)} bytes ends before its channel id does")
    _, channel_id = _CLIENT_MESSAGE_HEAD.unpack_from(data)
    return {"op": MESSAGE_DATA, "channelId": channel_id, "payload": data[_CLIENT_MESSAGE_HEAD.size :]}


def _decode_service_call(data: bytes) -> Dict[str, Any]:
    if len(data) < _SERVICE_HEAD.size:
        ids = data[1:9]
        if len(ids) == 8:
            raise IncompleteCall(f"a service call of {len(data)} bytes is too short", *struct.unpack("<II", ids))
        raise DecodeError(f"a service call of {len(data)} bytes ends before its ids do")
    _, service_id, call_id, length = _SERVICE_HEAD.unpack_from(data)
    end = _SERVICE_HEAD.size + length
    if end > len(data):
        reason = f"a service call of {len(data)} bytes ends before its encoding of {length} bytes does"
        raise IncompleteCall(reason, service_id, call_id)
    try:
        encoding = data[_SERVICE_HEAD.size : end].decode("utf-8")
    except UnicodeDecodeError as error:
        raise IncompleteCall("the encoding of a service call is not UTF-8", service_id, call_id) from error
    return {
        "op": SERVICE_CALL,
        "serviceId": service_id,
        "callId": call_id,
        "encoding": encoding,
        "payload": data[end:],
    }


# To clients


def text(message: Mapping[str, Any]) -> Payload:
    """A text message."""
    return Payload([encode_json(message)])


def server_info(
    name: str, capabilities: Iterable[str], metadata: Mapping[str, str], session_id: Optional[str]
) -> Dict[str, Any]:
    """What a client is told first."""
    offered = list(capabilities)
    info: Dict[str, Any] = {"op": "serverInfo", "name": name, "capabilities": offered, "metadata": dict(metadata)}
    if "clientPublish" in offered or "services" in offered:
        info["supportedEncodings"] = list(ENCODINGS)
    return info if session_id is None else {**info, "sessionId": session_id}


def status(level: int, message: str, status_id: Optional[str] = None) -> Dict[str, Any]:
    """Something for the user's eyes; a later status of the same id takes its place."""
    told: Dict[str, Any] = {"op": "status", "level": level, "message": message}
    return told if status_id is None else {**told, "id": status_id}


def remove_status(status_ids: List[str]) -> Dict[str, Any]:
    """What these statuses said is over."""
    return {"op": "removeStatus", "statusIds": status_ids}


def channel(channel_id: int, topic: str, type_: MessageType) -> Dict[str, Any]:
    """One entry of an advertise message."""
    return {
        "id": channel_id,
        "topic": topic,
        "encoding": "ros1",
        "schemaName": type_.name,
        "schema": type_.definition,
        "schemaEncoding": SCHEMA_ENCODING,
    }


def service(service_id: int, name: str, type_name: str, request: MessageType, response: MessageType) -> Dict[str, Any]:
    """One entry of an advertiseServices message."""

    def schema(half: str, type_: MessageType) -> Dict[str, str]:
        return {
            "encoding": "ros1",
            "schemaName": f"{type_name}_{half}",
            "schemaEncoding": SCHEMA_ENCODING,
            "schema": type_.definition,
        }

    return {
        "id": service_id,
        "name": name,
        "type": type_name,
        "request": schema("Request", request),
        "response": schema("Response", response),
    }


def parameter_values(parameters: List[Dict[str, Any]], request_id: Optional[str] = None) -> Dict[str, Any]:
    """Values of parameters; `request_id` is that of the operation that they answer."""
    message: Dict[str, Any] = {"op": "parameterValues", "parameters": parameters}
    return message if request_id is None else {**message, "id": request_id}


def service_call_failure(service_id: int, call_id: int, reason: str) -> Dict[str, Any]:
    """The answer to a call that came to nothing."""
    return {"op": "serviceCallFailure", "serviceId": service_id, "callId": call_id, "message": reason}


def message_data(subscription_id: int, time_ns: int, wire: Buffer) -> Payload:
    """One message of a topic. The message's bytes are shared by all clients, and not copied."""
    return Payload([_MESSAGE_HEAD.pack(_MESSAGE_DATA, subscription_id, time_ns), wire], binary=True)


def time_frame(time_ns: int) -> Payload:
    """The time of the server."""
    return Payload([_TIME_FRAME.pack(_TIME, time_ns)], binary=True)


def service_response(service_id: int, call_id: int, encoding: str, response: Buffer) -> Payload:
    """The answer to a service call, in the encoding of the call."""
    name = encoding.encode()
    head = _SERVICE_HEAD.pack(_SERVICE_RESPONSE, service_id, call_id, len(name))
    return Payload([head + name, response], binary=True)


def asset(request_id: int, content: Buffer) -> Payload:
    """A file that was asked for."""
    return Payload([_ASSET_HEAD.pack(_ASSET, request_id, 0, 0), content], binary=True)


def asset_error(request_id: int, reason: str) -> Payload:
    """Why a file that was asked for does not come."""
    message = reason.encode("utf-8", "replace")
    return Payload([_ASSET_HEAD.pack(_ASSET, request_id, 1, len(message)) + message], binary=True)
