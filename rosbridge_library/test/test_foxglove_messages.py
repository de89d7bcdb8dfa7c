# SPDX-License-Identifier: BSD-3-Clause
"""Every message of the Foxglove protocol as bytes, held against its specification."""

from __future__ import annotations

import json
import struct
from typing import Any, Dict

import pytest

from rosbridge_library.codec import get_message_type, get_service_type
from rosbridge_library.foxglove import messages
from rosbridge_library.foxglove.messages import IncompleteCall, decode
from rosbridge_library.internal.exceptions import DecodeError


def test_server_info() -> None:
    assert messages.server_info("name", ["clientPublish", "time"], {"key": "value"}, "id") == {
        "op": "serverInfo",
        "name": "name",
        "capabilities": ["clientPublish", "time"],
        "supportedEncodings": ["ros1", "json"],
        "metadata": {"key": "value"},
        "sessionId": "id",
    }
    less = messages.server_info("name", ["parameters"], {}, None)
    assert not {"supportedEncodings", "sessionId"} & set(less)
    assert "supportedEncodings" in messages.server_info("name", ["services"], {}, None)


def test_status_and_its_end() -> None:
    assert messages.status(messages.WARNING, "text") == {"op": "status", "level": 1, "message": "text"}
    assert messages.status(messages.ERROR, "text", "id") == {"op": "status", "level": 2, "message": "text", "id": "id"}
    assert messages.remove_status(["a", "b"]) == {"op": "removeStatus", "statusIds": ["a", "b"]}
    assert (messages.INFO, messages.WARNING, messages.ERROR) == (0, 1, 2)


def test_a_channel() -> None:
    channel = messages.channel(7, "/chatter", get_message_type("std_msgs/Header"))
    assert channel == {
        "id": 7,
        "topic": "/chatter",
        "encoding": "ros1",
        "schemaName": "std_msgs/Header",
        "schema": get_message_type("std_msgs/Header").definition,
        "schemaEncoding": "ros1msg",
    }


def test_a_service() -> None:
    type_ = get_service_type("rosbridge_library/AddTwoInts")
    service = messages.service(3, "/add", type_.name, type_.request, type_.response)
    assert (service["id"], service["name"], service["type"]) == (3, "/add", "rosbridge_library/AddTwoInts")
    assert service["request"] == {
        "encoding": "ros1",
        "schemaName": "rosbridge_library/AddTwoInts_Request",
        "schemaEncoding": "ros1msg",
        "schema": "int64 a\nint64 b\n",
    }
    assert service["response"]["schemaName"] == "rosbridge_library/AddTwoInts_Response"
    assert not {"requestSchema", "responseSchema"} & set(service)


def test_parameter_values() -> None:
    entries = [{"name": "/a", "value": 1}]
    assert messages.parameter_values(entries) == {"op": "parameterValues", "parameters": entries}
    assert messages.parameter_values(entries, "id")["id"] == "id"


def test_text_is_json_in_a_text_frame() -> None:
    payload = messages.text({"op": "unadvertise", "channelIds": [1]})
    assert not payload.binary
    assert json.loads(payload.data) == {"op": "unadvertise", "channelIds": [1]}


def test_message_data_shares_the_message() -> None:
    wire = memoryview(b"x" * 100_000)
    payload = messages.message_data(5, 0x0102030405060708, wire)
    assert payload.binary
    assert bytes(payload.parts[0]) == b"\x01\x05\0\0\0\x08\x07\x06\x05\x04\x03\x02\x01"
    assert payload.parts[1] is wire


def test_time() -> None:
    assert messages.time_frame(0x0102).data == b"\x02\x02\x01\0\0\0\0\0\0"


def test_service_response_and_failure() -> None:
    payload = messages.service_response(1, 2, "ros1", b"data")
    assert payload.binary
    assert payload.data == b"\x03" + struct.pack("<III", 1, 2, 4) + b"ros1data"
    assert messages.service_call_failure(1, 2, "why") == {
        "op": "serviceCallFailure",
        "serviceId": 1,
        "callId": 2,
        "message": "why",
    }


def test_asset() -> None:
    assert messages.asset(9, b"content").data == b"\x04\x09\0\0\0\0\0\0\0\0content"
    assert messages.asset_error(9, "no ✓").data == b"\x04\x09\0\0\0\x01\x06\0\0\0no \xe2\x9c\x93"
    assert messages.asset_error(9, "half \udc80").data.endswith(b"half ?")


@pytest.mark.parametrize(
    ("data", "operation"),
    [
        (b'{"op": "subscribe"}', {"op": "subscribe"}),
        (b' \n\r\t{"op": "x"}', {"op": "x"}),
        (b"\n{}", {}),
        (b"\x01\x05\0\0\0", {"op": "messageData", "channelId": 5, "payload": b""}),
        (b"\x01\xff\xff\xff\xff{}", {"op": "messageData", "channelId": 2**32 - 1, "payload": b"{}"}),
        (
            b"\x02" + struct.pack("<III", 1, 2, 4) + b"jsondata",
            {"op": "serviceCallRequest", "serviceId": 1, "callId": 2, "encoding": "json", "payload": b"data"},
        ),
        (
            b"\x02" + struct.pack("<III", 1, 2, 0),
            {"op": "serviceCallRequest", "serviceId": 1, "callId": 2, "encoding": "", "payload": b""},
        ),
    ],
)
def test_what_clients_send(data: bytes, operation: Dict[str, Any]) -> None:
    assert decode(data) == operation


@pytest.mark.parametrize(
    "data", [b"", b"\0", b"\x03", b"\x1f", b"{", b"\xff", b"\x01", b"\x01\0\0\0", b"\x02" + bytes(7)]
)
def test_what_is_none(data: bytes) -> None:
    with pytest.raises(DecodeError):
        decode(data)


@pytest.mark.parametrize(
    "rest",
    [b"", b"\0\0\0", struct.pack("<I", 5) + b"ros1", struct.pack("<I", 2**32 - 1), struct.pack("<I", 1) + b"\xff"],
)
def test_a_call_that_ends_too_soon_says_what_to_answer_to(rest: bytes) -> None:
    with pytest.raises(IncompleteCall) as error:
        decode(b"\x02" + struct.pack("<II", 11, 12) + rest)
    assert (error.value.service_id, error.value.call_id) == (11, 12)
