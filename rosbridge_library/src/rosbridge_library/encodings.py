# SPDX-License-Identifier: BSD-3-Clause
"""How rosbridge messages look on the way to a client: JSON, PNG, CBOR, CBOR-raw or BSON, whole or in fragments.

Each encoding of a topic message is one function from (topic as the client wrote it, message) to a payload. They are
pure, so what they make can be shared by all clients that ask for the same.
"""

from __future__ import annotations

import base64
import functools
import io
import itertools
import math
import struct
import zlib
from typing import Any, Callable, Dict, Iterable, Iterator, List, Mapping, Optional, Sequence

import cbor2
import png

from rosbridge_library.codec import Field, MessageType, encode_cbor, encode_json
from rosbridge_library.internal.exceptions import DecodeError, RosbridgeError
from rosbridge_library.payload import Buffer, Payload
from rosbridge_library.ros.message import Message

MAX_FRAGMENTS = 10_000
MAX_PIECES = 16
MAX_PNG_BYTES = 256 * 1024 * 1024
"""What a client's PNG may decode to: a small image can hold a great many zeros."""

BSON_IF_BINARY = "bson-if-binary"
"""The encoding of `binary_encoder: bson`: messages whose type has byte arrays are BSON, all else is JSON."""

_UINT32 = struct.Struct(">I")
_fragment_ids: Iterator[int] = itertools.count()


class EncodeError(RosbridgeError):
    """An encoding has no form for a message."""


def encode_operation(operation: Mapping[str, Any], encoding: str = "none") -> Payload:
    """A whole operation (a status, a service call …) in an encoding that `OPERATION_ENCODINGS` names."""
    return OPERATION_ENCODINGS[encoding](operation)


def _json_operation(operation: Mapping[str, Any]) -> Payload:
    return Payload([encode_json(operation)])


def _cbor_operation(operation: Mapping[str, Any]) -> Payload:
    return Payload([encode_cbor(operation)], binary=True)


def _bson_operation(operation: Mapping[str, Any]) -> Payload:
    import bson  # optional: only BSON mode needs it

    try:
        return Payload([bson.encode(operation)], binary=True)
    except (OverflowError, bson.errors.BSONError) as error:
        raise EncodeError(f"BSON can't hold it: {error}") from error


def _png_operation(operation: Mapping[str, Any]) -> Payload:
    return in_png(_json_operation(operation))


OPERATION_ENCODINGS: Dict[str, Callable[[Mapping[str, Any]], Payload]] = {
    "none": _json_operation,
    "png": _png_operation,
    "cbor": _cbor_operation,
    "bson": _bson_operation,
    BSON_IF_BINARY: _json_operation,
}


def service_call(type_: MessageType, wire: bytes, envelope: Mapping[str, Any], encoding: str) -> Payload:
    """The call_service operation `envelope`, with the request's values as its args."""
    return _with_message(envelope, "args", type_, wire, encoding)


def service_response(type_: MessageType, wire: bytes, envelope: Mapping[str, Any], encoding: str) -> Payload:
    """The service_response operation `envelope`, with the response's values."""
    return _with_message(envelope, "values", type_, wire, encoding)


def _with_message(envelope: Mapping[str, Any], field: str, type_: MessageType, wire: bytes, encoding: str) -> Payload:
    """The operation `envelope` with one more field, a ROS message; the encodings are those of operations."""
    if encoding == "bson" or (encoding == BSON_IF_BINARY and _has_binary(type_)):
        return _bson_operation({**envelope, field: type_.to_values(wire)})
    if encoding == "cbor":
        head = encode_cbor(envelope)  # a map of fewer than 23 entries: its first byte is 0xa0 + their number
        return Payload([bytes([head[0] + 1]) + head[1:], encode_cbor(field), type_.to_cbor(wire)], binary=True)
    payload = Payload([encode_json(envelope)[:-1], b',"%b":' % field.encode(), type_.to_json(wire), b"}"])
    return in_png(payload) if encoding == "png" else payload


@functools.lru_cache(maxsize=4096)
def _json_head(topic: str) -> bytes:
    return b'{"op":"publish","topic":' + encode_json(topic) + b',"msg":'


@functools.lru_cache(maxsize=4096)
def _cbor_head(topic: str) -> bytes:
    """A publish operation's map of three, up to the value of its last entry, `msg`."""
    return b"\xa3" + b"".join(map(cbor2.dumps, ("op", "publish", "topic", topic, "msg")))


def _few(pieces: Sequence[Buffer]) -> Sequence[Buffer]:
    """Pieces of a message, where it pays to write them as they are: that keeps a large array uncopied."""
    return pieces if len(pieces) <= MAX_PIECES else (b"".join(pieces),)


def _publish_json(topic: str, message: Message) -> Payload:
    return Payload([_json_head(topic), *_few(message.type.json_pieces(message.wire)), b"}"])


def _publish_png(topic: str, message: Message) -> Payload:
    return in_png(_publish_json(topic, message))


def _publish_cbor(topic: str, message: Message) -> Payload:
    return Payload([_cbor_head(topic), *_few(message.type.cbor_pieces(message.wire))], binary=True)


def _publish_cbor_raw(topic: str, message: Message) -> Payload:
    secs, nsecs = message.received
    # {"secs": uint32, "nsecs": uint32, "bytes": the wire bytes, uncopied}
    raw = b"\xa3\x64secs\x1a%b\x65nsecs\x1a%b\x65bytes" % (_UINT32.pack(secs), _UINT32.pack(nsecs))
    return Payload([_cbor_head(topic) + raw + _cbor_bytes_head(len(message.wire)), message.wire], binary=True)


def _cbor_bytes_head(length: int) -> bytes:
    """The head of a CBOR byte string (RFC 8949, section 3): the bytes themselves follow uncopied."""
    if length < 24:
        return bytes([0x40 + length])
    for code, size in ((0x58, 1), (0x59, 2), (0x5A, 4), (0x5B, 8)):
        if length < 1 << (8 * size):
            return bytes([code]) + length.to_bytes(size, "big")
    raise ValueError(f"a byte string of {length} bytes")


def _publish_bson(topic: str, message: Message) -> Payload:
    return _bson_operation({"op": "publish", "topic": topic, "msg": message.type.to_values(message.wire)})


def _publish_bson_if_binary(topic: str, message: Message) -> Payload:
    return (_publish_bson if _has_binary(message.type) else _publish_json)(topic, message)


@functools.lru_cache(maxsize=1024)
def _has_binary(type_: MessageType) -> bool:
    """Whether a message of this type has byte arrays anywhere in it."""

    def any_binary(fields: Iterable[Field]) -> bool:
        return any(
            field.is_binary or (field.message is not None and any_binary(field.message.fields)) for field in fields
        )

    return any_binary(type_.fields)


TOPIC_ENCODINGS: Dict[str, Callable[[str, Message], Payload]] = {
    "none": _publish_json,
    "png": _publish_png,
    "cbor": _publish_cbor,
    "cbor-raw": _publish_cbor_raw,
    "bson": _publish_bson,
    BSON_IF_BINARY: _publish_bson_if_binary,
}


def in_png(payload: Payload) -> Payload:
    """The png operation (specification 3.1.2) that holds the JSON text of `payload` as the pixels of an RGB image."""
    return Payload([b'{"op":"png","data":"', base64.b64encode(_to_png(payload.data)), b'"}'])


def _to_png(text: bytes) -> bytes:
    pixels = max(1, math.ceil(len(text) / 3))
    width = max(1, math.isqrt(pixels))
    height = math.ceil(pixels / width)
    stride = 3 * width
    padded = text.ljust(stride * height, b"\n")  # white space: JSON text stays JSON text
    image = io.BytesIO()
    rows = (padded[start : start + stride] for start in range(0, len(padded), stride))
    png.Writer(width, height, greyscale=False, bitdepth=8, compression=1).write_packed(image, rows)
    return image.getvalue()


def from_png(data: str) -> bytes:
    """The text in the pixels of a base64 PNG image. Raises DecodeError."""
    try:
        image = base64.b64decode(data, validate=True)
        _check_png(image)
        _, _, rows, _ = png.Reader(bytes=image).read()
        return b"".join(map(bytes, rows)).rstrip(b"\n\0")
    except (ValueError, EOFError, png.Error, zlib.error) as error:
        raise DecodeError(f"not a base64 PNG image: {error}") from error


def _check_png(image: bytes) -> None:
    """Raise for an image that can't hold text, or that would unpack to more than it says, or than is good."""
    reader = png.Reader(bytes=image)
    reader.preamble()
    if getattr(reader, "bitdepth", None) != 8 or reader.colormap:
        raise DecodeError("a PNG image must have 8 bits a channel and no palette")
    size = reader.width * reader.height * reader.planes
    if size > MAX_PNG_BYTES:
        raise DecodeError(f"a PNG image of {reader.width} x {reader.height} is too large")
    left = size + 2 * reader.height + 64  # each row of each pass has a byte in front
    inflater = zlib.decompressobj()
    for kind, data in png.Reader(bytes=image).chunks():
        if kind == b"IDAT":
            left -= len(inflater.decompress(data, left))
            if left <= 0:
                raise DecodeError("a PNG image has more pixels than it says")


def in_fragments(payload: Payload, fragment_size: Optional[int]) -> List[Payload]:
    """The payload itself or, when its text is longer than `fragment_size` characters, fragment operations of it.

    Binary payloads can't be fragmented: a fragment holds text. A message makes at most `MAX_FRAGMENTS` of them, larger
    ones than asked if need be: a great many would hold up everybody.
    """
    if fragment_size is None or payload.binary or payload.size <= fragment_size:
        return [payload]
    text = payload.data.decode("utf-8")
    if len(text) <= fragment_size:
        return [payload]
    fragment_size = max(fragment_size, math.ceil(len(text) / MAX_FRAGMENTS))
    return [_json_operation(part) for part in fragments(text, fragment_size, str(next(_fragment_ids)))]


def fragments(text: str, fragment_size: int, fragment_id: object) -> Iterator[Dict[str, Any]]:
    """The fragment operations (specification 3.1.1) that hold `text`, at most `fragment_size` characters each."""
    total = math.ceil(len(text) / fragment_size)
    for num in range(total):
        data = text[num * fragment_size : (num + 1) * fragment_size]
        yield {"op": "fragment", "id": fragment_id, "data": data, "num": num, "total": total}
