# SPDX-License-Identifier: BSD-3-Clause
"""Whole JSON and CBOR documents: what clients send, and the small control messages they are sent.

The messages of topics do not pass through the encoders here; compiled codecs make their bytes. The decoders take
anything a client may send, in linear time, and raise one error, DecodeError, for whatever is not a document.
"""

from __future__ import annotations

import io
import json
from typing import Any, Dict, Mapping, NoReturn, Union

import cbor2
import numpy as np
import orjson
import pybase64

from ..internal.exceptions import DecodeError

MAX_DEPTH = 400
_BARE_TOKENS = (b"NaN", b"Infinity")


def decode_json(data: Union[bytes, bytearray, memoryview, str]) -> Any:
    """The value of a JSON text; the bare tokens NaN, Infinity and -Infinity, which Python clients send, are taken.

    Raises DecodeError for anything that is not JSON, not UTF-8, or nested too deeply.
    """
    try:
        return orjson.loads(data)
    except ValueError as error:
        if not _may_have_bare_tokens(data):
            raise DecodeError(f"Not JSON: {error}") from error
    try:
        text = (data.encode() if isinstance(data, str) else bytes(data)).decode()  # checks surrogates and UTF-8
        value = json.loads(text, parse_int=_parse_int)
        if "\\ud" in text.lower():
            json.dumps(value, ensure_ascii=False).encode()  # fails for half a surrogate pair, as orjson does
        return value
    except (ValueError, RecursionError) as error:
        raise DecodeError(f"Not JSON: {error}") from error


def _may_have_bare_tokens(data: Union[bytes, bytearray, memoryview, str]) -> bool:
    if isinstance(data, str):
        return "NaN" in data or "Infinity" in data
    raw = bytes(data) if isinstance(data, memoryview) else data
    return any(token in raw for token in _BARE_TOKENS)


def _parse_int(digits: str) -> Union[int, float]:
    # As orjson does: what no 64-bit integer holds is a float. Parsing long integers takes quadratic time, too.
    return int(digits) if len(digits) <= 20 else float(digits)


def encode_json(value: Any) -> bytes:
    """The UTF-8 JSON text of a value; NaN and infinities become null, bytes base64, NumPy arrays lists.

    Raises TypeError for what JSON cannot hold: other objects, integers of more than 64 bits, nesting beyond 254.
    """
    return orjson.dumps(value, _json_default, orjson.OPT_SERIALIZE_NUMPY)


def _json_default(value: Any) -> Any:
    if isinstance(value, (bytes, bytearray, memoryview)):
        return pybase64.b64encode_as_string(value)
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not JSON serializable")


# RFC 8746: tag → type of the elements. 68 is uint8 "clamped", 76 is reserved; 128-bit floats are left out.
TYPED_ARRAYS: Mapping[int, np.dtype[Any]] = {
    tag: np.dtype(code)
    for tag, code in {
        64: "u1", 65: ">u2", 66: ">u4", 67: ">u8", 68: "u1", 69: "<u2", 70: "<u4", 71: "<u8",
        72: "i1", 73: ">i2", 74: ">i4", 75: ">i8", 77: "<i2", 78: "<i4", 79: "<i8",
        80: ">f2", 81: ">f4", 82: ">f8", 84: "<f2", 85: "<f4", 86: "<f8",
    }.items()
}  # fmt: skip
_ARRAY_TAGS: Mapping[str, int] = {
    "u2": 69,
    "u4": 70,
    "u8": 71,
    "i1": 72,
    "i2": 77,
    "i4": 78,
    "i8": 79,
    "f4": 85,
    "f8": 86,
}


def decode_cbor(data: bytes) -> Any:
    """The value of one CBOR item; typed arrays (RFC 8746) become NumPy arrays, byte strings bytes.

    Raises DecodeError for anything that is not exactly one CBOR item, for nesting deeper than 400, and for tags
    that have no place in a message (references, dates, regular expressions …).
    """
    stream = io.BytesIO(data)
    try:
        value = cbor2.CBORDecoder(stream, tag_hook=_decode_tag, **_LIMITS).decode()
    except (ValueError, TypeError, cbor2.CBORDecodeError, RecursionError) as error:
        cause = error.__cause__
        raise DecodeError(f"Not CBOR: {cause if isinstance(cause, DecodeError) else error}") from error
    if stream.tell() != len(data):
        raise DecodeError(f"Not CBOR: {len(data) - stream.tell()} bytes after the end")
    return value


def _decode_tag(*args: Any) -> Any:
    """The value of a tag that cbor2 does not know itself; the order of the arguments depends on its version."""
    tagged = next(arg for arg in args if isinstance(arg, cbor2.CBORTag))
    item_type = TYPED_ARRAYS.get(tagged.tag)
    if item_type is None:
        raise DecodeError(f"tag {tagged.tag} is not supported")
    raw = tagged.value
    if not isinstance(raw, bytes) or len(raw) % item_type.itemsize:
        raise DecodeError(f"tag {tagged.tag} needs a byte string of whole {item_type.name} items")
    return np.frombuffer(raw, item_type)


def _refuse_tag(*args: Any) -> NoReturn:
    raise DecodeError("a tag that has no place in a message")


def _limits() -> Dict[str, Any]:
    """Options for cbor2 from version 6 on; older ones, for older Pythons, lack them.

    What cbor2 would turn into dates, decimals, regular expressions, cyclic references, sets … is refused.
    """
    tags = (0, 1, 4, 5, 25, 28, 29, 30, 35, 36, 37, 52, 54, 100, 256, 258, 260, 261, 1004, 43000)
    limits: Dict[str, Any] = {"semantic_decoders": dict.fromkeys(tags, _refuse_tag), "max_depth": MAX_DEPTH}
    try:
        cbor2.CBORDecoder(io.BytesIO(), **limits)
    except TypeError:
        return {}
    return limits


_LIMITS = _limits()


def encode_cbor(value: Any) -> bytes:
    """The CBOR item of a value; NumPy arrays become typed arrays (RFC 8746), of uint8 a plain byte string.

    Binary data must be bytes or bytearray: cbor2 takes a memoryview for a list of numbers.
    Raises TypeError or ValueError for what CBOR cannot hold.
    """
    try:
        encoded: bytes = cbor2.dumps(value, default=_cbor_default)
    except cbor2.CBOREncodeError as error:
        raise TypeError(str(error)) from error
    return encoded


def _cbor_default(encoder: Any, value: Any) -> None:
    if isinstance(value, np.generic):
        encoder.encode(value.item())
    elif isinstance(value, np.ndarray) and value.ndim == 1 and value.dtype.kind in "iuf":
        kind = f"{value.dtype.kind}{value.dtype.itemsize}"
        raw = value.astype("<" + kind).tobytes()
        encoder.encode(raw if kind == "u1" else cbor2.CBORTag(_ARRAY_TAGS[kind], raw))
    elif isinstance(value, np.ndarray):
        encoder.encode(value.tolist())
    else:
        raise TypeError(f"{type(value).__name__} is not CBOR serializable")
