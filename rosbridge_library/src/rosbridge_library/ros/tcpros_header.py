# SPDX-License-Identifier: BSD-3-Clause
"""The connection header of TCPROS: what both ends tell each other before the first message.

On the wire it is the length of all fields, then for each field its length and `key=value`; lengths
are little-endian, 4 bytes. Decoding is strict, because the bytes come from whoever answers at an
address: anything malformed raises HeaderError. This module only turns bytes into fields and back.
"""

from __future__ import annotations

import struct
from typing import Dict, Mapping, Tuple

from rosbridge_library.internal.exceptions import RosbridgeError

LENGTH_BYTES = 4
# A header holds the definition text of a message with all that it contains: the longest are about 50 kB.
MAX_HEADER_BYTES = 1024 * 1024

_length = struct.Struct("<I")


class HeaderError(RosbridgeError):
    """Bytes that are no connection header, or fields that can't be put into one."""


def encode_header(fields: Mapping[str, str]) -> bytes:
    """Return `fields` as a connection header, the leading length included.

    Raises HeaderError for an empty key, a key with "=" in it, or text that has no UTF-8 form.
    """
    encoded = [_encode_field(key, value) for key, value in fields.items()]
    body = b"".join(_length.pack(len(field)) + field for field in encoded)
    if len(body) > MAX_HEADER_BYTES:
        raise HeaderError(f"a connection header of {len(body)} bytes is beyond {MAX_HEADER_BYTES}")
    return _length.pack(len(body)) + body


def decode_length(prefix: bytes) -> int:
    """Return how many bytes of fields follow the 4 bytes of `prefix`; raises HeaderError beyond the limit."""
    (length,) = _length.unpack(prefix)
    if length > MAX_HEADER_BYTES:
        raise HeaderError(f"a connection header of {length} bytes is beyond {MAX_HEADER_BYTES}")
    return int(length)


def decode_header(body: bytes) -> Dict[str, str]:
    """Return the fields in `body`, the bytes after the leading length.

    A key that comes twice keeps its last value, as in ROS. Raises HeaderError for anything malformed.
    """
    fields: Dict[str, str] = {}
    start = 0
    while start < len(body):
        if start + LENGTH_BYTES > len(body):
            raise HeaderError("a connection header ends within the length of a field")
        (length,) = _length.unpack_from(body, start)
        start += LENGTH_BYTES
        if start + length > len(body):
            raise HeaderError(f"a field of {length} bytes goes beyond the end of its connection header")
        key, value = _decode_field(body[start : start + length])
        fields[key] = value
        start += length
    return fields


def _encode_field(key: str, value: str) -> bytes:
    if not key or "=" in key:
        raise HeaderError(f"{key!r} is no key for a connection header")
    try:
        return f"{key}={value}".encode()
    except UnicodeEncodeError as error:
        raise HeaderError(f"the value of {key} is not valid text: {value!r}") from error


def _decode_field(field: bytes) -> Tuple[str, str]:
    key, equals, value = field.partition(b"=")
    if not equals or not key:
        raise HeaderError(f"{field[:80]!r} in a connection header is not of the form key=value")
    try:
        return key.decode("utf-8").strip(), value.decode("utf-8")
    except UnicodeDecodeError as error:
        raise HeaderError(f"a field of a connection header is not UTF-8: {field[:80]!r}") from error
