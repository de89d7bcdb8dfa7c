# SPDX-License-Identifier: BSD-3-Clause
"""The time of sending, read from a client's raw frame without decoding it.

A finder looks at the first bytes of a message from the server and returns the stamp in nanoseconds, `NO_STAMP` for a
message of the load whose stamp can't be seen (PNG), or None for anything else, such as a status.
"""

from __future__ import annotations

import re
import struct
from typing import Callable, Optional

from benchmarks.messages import LOADS, TEXT_MARK, stamp_offset

Finder = Callable[[bytearray, int, int], Optional[int]]
"""(buffer, begin, end): the message is there, or its first `HEAD_BYTES` if it is longer."""

HEAD_BYTES = 4096
NO_STAMP = -1

_STAMP = struct.Struct("<II")
_JSON_STAMP = re.compile(rb'"secs":\s*(\d+),\s*"nsecs":\s*(\d+)')
_JSON_STAMP_REVERSED = re.compile(rb'"nsecs":\s*(\d+),\s*"secs":\s*(\d+)')
_CBOR_SECS, _CBOR_NSECS, _CBOR_BYTES = b"\x64secs", b"\x65nsecs", b"\x65bytes"
_CBOR_ARGUMENT_BYTES = {24: 1, 25: 2, 26: 4, 27: 8}
_FOXGLOVE_MESSAGE_DATA = 1
_FOXGLOVE_HEAD_BYTES = 13  # opcode, subscription id, receive time


def finder(load_name: str, encoding: str) -> Finder:
    """The finder for a load in an encoding: json, png, cbor, cbor-raw or foxglove."""
    load = LOADS[load_name]
    if encoding == "png":
        return find_png
    if load.type == "std_msgs/String":
        return find_text
    if encoding == "json":
        return find_json
    if encoding == "cbor":
        return find_cbor
    if encoding == "cbor-raw":
        return _in_cbor_raw(stamp_offset(load))
    if encoding == "foxglove":
        return _in_foxglove(stamp_offset(load))
    raise ValueError(f"no encoding {encoding!r}")


def find_json(buffer: bytearray, begin: int, end: int) -> Optional[int]:
    """The first time in JSON text."""
    match = _JSON_STAMP.search(buffer, begin, end)
    if match is not None:
        return int(match.group(1)) * 10**9 + int(match.group(2))
    match = _JSON_STAMP_REVERSED.search(buffer, begin, end)
    return None if match is None else int(match.group(2)) * 10**9 + int(match.group(1))


def find_cbor(buffer: bytearray, begin: int, end: int) -> Optional[int]:
    """The first time in a CBOR message."""
    secs = buffer.find(_CBOR_SECS, begin, end)
    nsecs = buffer.find(_CBOR_NSECS, begin, end)
    if secs < 0 or nsecs < 0:
        return None
    return _unsigned(buffer, secs + len(_CBOR_SECS)) * 10**9 + _unsigned(buffer, nsecs + len(_CBOR_NSECS))


def find_text(buffer: bytearray, begin: int, end: int) -> Optional[int]:
    """The time in the text of a message without header; the same in every encoding that doesn't compress."""
    at = buffer.find(TEXT_MARK, begin, end)
    if at < 0:
        return None
    at += len(TEXT_MARK)
    return int(buffer[at : at + 10]) * 10**9 + int(buffer[at + 11 : at + 20])


def find_png(buffer: bytearray, begin: int, end: int) -> Optional[int]:
    """Whether it is a PNG operation; its text is compressed."""
    return None if buffer.find(b'"png"', begin, end) < 0 else NO_STAMP


def _in_cbor_raw(offset: int) -> Finder:
    def find_cbor_raw(buffer: bytearray, begin: int, end: int) -> Optional[int]:
        at = buffer.find(_CBOR_BYTES, begin, end)
        if at < 0:
            return None
        at += len(_CBOR_BYTES)
        wire = at + 1 + _CBOR_ARGUMENT_BYTES.get(buffer[at] & 0x1F, 0)
        secs, nsecs = _STAMP.unpack_from(buffer, wire + offset)
        return int(secs * 10**9 + nsecs)

    return find_cbor_raw


def _in_foxglove(offset: int) -> Finder:
    def find_foxglove(buffer: bytearray, begin: int, end: int) -> Optional[int]:
        if end - begin < _FOXGLOVE_HEAD_BYTES or buffer[begin] != _FOXGLOVE_MESSAGE_DATA:
            return None
        secs, nsecs = _STAMP.unpack_from(buffer, begin + _FOXGLOVE_HEAD_BYTES + offset)
        return int(secs * 10**9 + nsecs)

    return find_foxglove


def _unsigned(buffer: bytearray, at: int) -> int:
    """The CBOR unsigned integer that begins there."""
    size = _CBOR_ARGUMENT_BYTES.get(buffer[at], 0)
    return int.from_bytes(buffer[at + 1 : at + 1 + size], "big") if size else buffer[at]
