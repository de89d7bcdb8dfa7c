# SPDX-License-Identifier: BSD-3-Clause
"""The encodings of operations and topic messages, and fragments, held against independent decoders."""

from __future__ import annotations

import base64
import io
import json
import struct
from typing import Any, Dict, List

import bson
import cbor2
import png
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosbridge_library.codec import encode_json, get_message_type, message_type_from_definition
from rosbridge_library.encodings import (
    BSON_IF_BINARY,
    TOPIC_ENCODINGS,
    EncodeError,
    encode_operation,
    from_png,
    in_fragments,
    in_png,
    service_call,
    service_response,
)
from rosbridge_library.internal.exceptions import DecodeError
from rosbridge_library.payload import Payload
from rosbridge_library.ros.message import Message

TOPIC = 't/ä"\\'
TEXT = st.text(max_size=200)


def message(kind: str, values: Dict[str, Any]) -> Message:
    type_ = get_message_type(kind)
    wire, _ = type_.from_values(values, lambda: (1, 2))
    return Message("/topic", type_, wire, (123, 456))


def decoded(payload: Payload) -> Any:
    """A payload as a client reads it."""
    if payload.binary:
        return cbor2.loads(payload.data)
    value = json.loads(payload.data)
    return json.loads(pixels(value["data"])) if value["op"] == "png" else value


def pixels(data: str) -> bytes:
    """What an image decoder of its own finds, after roslib's rule: text, padded with white space."""
    _, _, rows, info = png.Reader(bytes=base64.b64decode(data)).asRGB8()
    assert info["planes"] == 3
    return b"".join(bytes(row) for row in rows)


@given(TEXT)
@settings(max_examples=50, deadline=None)
@pytest.mark.parametrize("encoding", ["none", "png", "cbor"])
def test_a_topic_message_in_every_encoding(encoding: str, text: str) -> None:
    payload = TOPIC_ENCODINGS[encoding](TOPIC, message("std_msgs/String", {"data": text}))
    assert decoded(payload) == {"op": "publish", "topic": TOPIC, "msg": {"data": text}}
    assert payload.binary == (encoding == "cbor")
    assert payload.size == len(payload.data)


@pytest.mark.parametrize("size", [0, 1, 10, 23, 24, 255, 256, 65535, 65536])
def test_cbor_raw_holds_the_wire_bytes_uncopied(size: int) -> None:
    original = message("std_msgs/String", {"data": "x" * size})
    payload = TOPIC_ENCODINGS["cbor-raw"]("topic", original)
    assert decoded(payload) == {
        "op": "publish",
        "topic": "topic",
        "msg": {"bytes": struct.pack("<I", size) + b"x" * size, "secs": 123, "nsecs": 456},
    }
    assert any(part is original.wire for part in payload.parts)


@pytest.mark.parametrize("size", range(1, 40))
def test_a_picture_of_any_size(size: int) -> None:
    text = json.dumps({"op": "x" * size}).encode()
    image = json.loads(in_png(Payload([text])).data)["data"]
    assert pixels(image).rstrip(b"\n") == text
    assert from_png(image) == text


@given(st.binary(max_size=300))
@settings(max_examples=100, deadline=None)
def test_any_bytes_for_a_picture_are_taken_or_refused(data: bytes) -> None:
    with pytest.raises(DecodeError):
        from_png(base64.b64encode(data).decode())
    with pytest.raises(DecodeError):
        from_png(data.decode("latin-1") + "ä")


def test_a_picture_of_sixteen_bits_or_with_a_palette_is_refused() -> None:
    for options in ({"greyscale": True, "bitdepth": 16}, {"palette": [(1, 2, 3)], "bitdepth": 8}):
        stream = io.BytesIO()
        png.Writer(1, 1, **options).write(stream, [[0]])
        with pytest.raises(DecodeError, match="8 bits"):
            from_png(base64.b64encode(stream.getvalue()).decode())


@given(TEXT, st.integers(min_value=1, max_value=300))
@settings(max_examples=200, deadline=None)
def test_fragments_make_up_the_text_again(text: str, size: int) -> None:
    payload = Payload([json.dumps({"op": "x", "text": text}, ensure_ascii=False).encode()])
    whole = payload.data.decode()
    parts = in_fragments(payload, size)
    if len(whole) <= size:
        assert parts == [payload]
        return
    operations: List[Dict[str, Any]] = [json.loads(part.data) for part in parts]
    assert "".join(each["data"] for each in operations) == whole
    assert [each["num"] for each in operations] == list(range(len(operations)))
    assert {each["total"] for each in operations} == {len(operations)}
    assert {each["op"] for each in operations} == {"fragment"}
    assert len({each["id"] for each in operations}) == 1
    assert all(0 < len(each["data"]) <= size for each in operations)


def test_two_messages_in_fragments_have_two_ids() -> None:
    ids = {json.loads(in_fragments(Payload([b'{"op":"x"}']), 3)[0].data)["id"] for _ in range(10)}
    assert len(ids) == 10


def test_what_is_not_fragmented() -> None:
    text, binary = Payload([b'{"op":"x"}']), Payload([b"\xa0"] * 50, binary=True)
    assert in_fragments(text, None) == [text]
    assert in_fragments(text, 10) == [text]
    assert in_fragments(binary, 3) == [binary]


@pytest.mark.parametrize("encoding", ["none", "png", "cbor"])
def test_a_service_response_and_a_call(encoding: str) -> None:
    type_ = get_message_type("std_msgs/String")
    wire, _ = type_.from_values({"data": 'ä"'}, lambda: (0, 0))
    envelope = {"op": "service_response", "service": "/ä", "id": 5, "result": True}
    assert decoded(service_response(type_, wire, envelope, encoding)) == {**envelope, "values": {"data": 'ä"'}}
    assert decoded(service_call(type_, wire, envelope, encoding)) == {**envelope, "args": {"data": 'ä"'}}


def test_an_operation_in_every_encoding() -> None:
    operation = {"op": "status", "level": "error", "msg": "ä", "id": 7}
    for encoding in ("none", "png", "cbor", BSON_IF_BINARY):
        assert decoded(encode_operation(operation, encoding)) == operation
    assert bson.decode(encode_operation(operation, "bson").data) == operation


def test_bson() -> None:
    payload = TOPIC_ENCODINGS["bson"]("t", message("rosbridge_library/TestUInt8", {"data": [0, 255]}))
    assert bson.decode(payload.data) == {"op": "publish", "topic": "t", "msg": {"data": b"\x00\xff"}}
    assert payload.binary
    for kind in ("std_msgs/Float32MultiArray", "sensor_msgs/LaserScan", "nav_msgs/Odometry", "std_msgs/Empty"):
        each = TOPIC_ENCODINGS["bson"]("t", message(kind, {}))
        assert bson.decode(each.data)["msg"].keys() == {field.name for field in get_message_type(kind).fields}
    with pytest.raises(EncodeError):
        TOPIC_ENCODINGS["bson"]("t", message("std_msgs/UInt64", {"data": 2**63}))


def test_bson_if_binary() -> None:
    nested = message_type_from_definition("x/Outer", "x/Inner[] inner\n" + "=" * 80 + "\nMSG: x/Inner\nuint8[4] data\n")
    wire, _ = nested.from_values({"inner": [{"data": [1, 2, 3, 4]}]}, lambda: (0, 0))
    binary = TOPIC_ENCODINGS[BSON_IF_BINARY]("t", Message("/t", nested, wire, (0, 0)))
    assert bson.decode(binary.data)["msg"] == {"inner": [{"data": b"\x01\x02\x03\x04"}]}
    text = TOPIC_ENCODINGS[BSON_IF_BINARY]("t", message("std_msgs/Int8MultiArray", {"data": [1]}))
    assert json.loads(text.data)["msg"]["data"] == [1]


def test_a_message_is_encoded_once_for_all_who_ask_for_the_same() -> None:
    made: List[str] = []
    one = message("std_msgs/String", {"data": "x"})

    def encode(each: Message) -> List[Payload]:
        made.append("once")
        return [TOPIC_ENCODINGS["none"]("t", each)]

    assert one.encoded(("none", "t"), encode) is one.encoded(("none", "t"), encode)
    assert made == ["once"]


def test_a_tiny_fragment_size_makes_a_bounded_number_of_fragments() -> None:
    text = encode_json({"op": "status", "msg": "x" * 1_000_000})
    parts = [json.loads(part.data) for part in in_fragments(Payload([text]), 1)]
    assert 9_000 < len(parts) <= 10_000
    assert "".join(part["data"] for part in parts) == text.decode()
