# SPDX-License-Identifier: BSD-3-Clause
"""Connection headers, held against ROS's own codec, and with everything wrong that can be wrong."""

from __future__ import annotations

import struct
from typing import Dict

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosgraph.network import decode_ros_handshake_header, encode_ros_handshake_header

from rosbridge_library.ros.tcpros_header import (
    MAX_HEADER_BYTES,
    HeaderError,
    decode_header,
    decode_length,
    encode_header,
)

keys = st.text("abcdefghijklmnopqrstuvwxyz0123456789_", min_size=1)
fields = st.dictionaries(keys, st.text(st.characters(exclude_categories=("Cs",))))


@given(fields)
def test_ros_reads_what_is_encoded(header: Dict[str, str]) -> None:
    assert decode_ros_handshake_header(encode_header(header)) == header


@given(fields)
def test_reads_what_ros_encodes(header: Dict[str, str]) -> None:
    encoded = encode_ros_handshake_header(header)
    assert decode_length(encoded[:4]) == len(encoded) - 4
    assert decode_header(encoded[4:]) == header


@given(st.binary(max_size=200))
def test_any_bytes_are_fields_or_an_error(body: bytes) -> None:
    try:
        header = decode_header(body)
    except HeaderError:
        return
    assert all("=" not in key for key in header)


@given(fields.filter(bool), st.data())
def test_cut_off(header: Dict[str, str], data: st.DataObject) -> None:
    body = encode_header(header)[4:]
    ends = {0}
    for key, value in header.items():
        ends.add(max(ends) + 4 + len(f"{key}={value}".encode()))
    at = data.draw(st.integers(1, len(body) - 1).filter(lambda cut: cut not in ends))
    with pytest.raises(HeaderError):
        decode_header(body[:at])


def field(content: bytes) -> bytes:
    return struct.pack("<I", len(content)) + content


def test_value_with_equals_signs() -> None:
    assert decode_header(field(b"message_definition=uint8 A=1\nuint8 B=2")) == {
        "message_definition": "uint8 A=1\nuint8 B=2"
    }


@pytest.mark.parametrize(
    "body",
    [
        field(b""),
        field(b"no equals sign"),
        field(b"=value"),
        field(b"key=\xff\xfe"),
        field(b"\xff=value"),
        struct.pack("<I", 0xFFFFFFFF) + b"key=value",
    ],
)
def test_malformed(body: bytes) -> None:
    with pytest.raises(HeaderError):
        decode_header(body)


def test_limit() -> None:
    assert decode_length(struct.pack("<I", MAX_HEADER_BYTES)) == MAX_HEADER_BYTES
    with pytest.raises(HeaderError, match="beyond"):
        decode_length(b"HTTP")
    with pytest.raises(HeaderError, match="beyond"):
        encode_header({"key": "x" * MAX_HEADER_BYTES})


@pytest.mark.parametrize("header", [{"": "value"}, {"a=b": "value"}, {"key": "\ud800"}])
def test_what_can_not_be_encoded(header: Dict[str, str]) -> None:
    with pytest.raises(HeaderError):
        encode_header(header)
