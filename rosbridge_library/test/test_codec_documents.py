# SPDX-License-Identifier: BSD-3-Clause
"""Whole JSON and CBOR documents: what clients may send, and what they are sent."""

from __future__ import annotations

import contextlib
import math
import time
from typing import Any, Callable, Tuple, Union

import cbor2
import numpy as np
import orjson
import pytest

from rosbridge_library.codec import DecodeError, decode_cbor, decode_json, encode_cbor, encode_json


@pytest.mark.parametrize("wrap", [bytes, bytearray, memoryview, lambda raw: raw.decode()])
def test_json_is_decoded_from_text_and_bytes(wrap: Callable[[bytes], Union[bytes, str]]) -> None:
    text = wrap('{"op": "publish", "msg": {"data": "grün", "n": [1, 2.5, null, true]}}'.encode())
    assert decode_json(text) == {"op": "publish", "msg": {"data": "grün", "n": [1, 2.5, None, True]}}


def test_bare_tokens_of_python_clients_are_taken() -> None:
    for text in ('{"a": NaN, "b": [Infinity, -Infinity, 1]}', b'{"a": NaN, "b": [Infinity, -Infinity, 1]}'):
        decoded = decode_json(text)
        assert math.isnan(decoded["a"])
        assert decoded["b"] == [math.inf, -math.inf, 1]
    assert decode_json(memoryview(b"[Infinity]")) == [math.inf]


def test_numbers_are_the_same_beside_bare_tokens() -> None:
    for number in ("1", "-7", "1.5", "1e3", "18446744073709551615", "-9223372036854775808", "123456789012345678901234"):
        plain, with_token = decode_json(f"[{number}]")[0], decode_json(f"[{number}, NaN]")[0]
        assert (plain, type(plain)) == (with_token, type(with_token))
    assert decode_json('["\\ud83e\\udd16", NaN]')[0] == "\U0001f916"


@pytest.mark.parametrize(
    "data",
    [
        "",
        b"",
        "{",
        "[1,]",
        "nul",
        "NaN and more",
        "{'op': 'x'}",
        "[NaN",
        b"\xff\xfe",
        b'"half a character \xc3"',
        b'["half a character \xc3", NaN]',
        '"\ud800"',
        '["\ud800", NaN]',
        b'["\\ud800"]',
        b'["\\uD800", NaN]',
        '{"a": 1} {"b": 2}',
        "\0",
        b"\x00" * 100,
    ],
)
def test_what_is_no_json(data: Union[bytes, str]) -> None:
    with pytest.raises(DecodeError, match="Not JSON"):
        decode_json(data)
    assert issubclass(DecodeError, ValueError)


def big_documents() -> Tuple[Any, ...]:
    million = 10**6
    return (
        "[" * million,
        "[" * million + "]" * million,
        '{"a":' * million,
        "[" * million + "NaN" + "]" * million,
        '{"a":' * million + "NaN",
        "[NaN," + "9" * million + "]",
        "[NaN,0." + "9" * million + "]",
        "[" + "9" * million,
        '"' + "\\" * million,
        "[" + "NaN," * million,
        '"' + "Infinity" * million,
    )


@pytest.mark.parametrize("text", big_documents(), ids=range(len(big_documents())))
def test_hostile_json_takes_no_long_time(text: str) -> None:
    begin = time.process_time()
    with contextlib.suppress(DecodeError):
        decode_json(text)
    assert time.process_time() - begin < 2  # quadratic time would be minutes


def test_json_control_messages_are_encoded() -> None:
    value = {
        "op": "service_response",
        "values": {"nan": math.nan, "inf": [-math.inf, 1.0], "raw": b"\x00\xff", "view": memoryview(b"abc")},
        "numpy": [
            np.float32(0.5),
            np.int64(-3),
            np.arange(3),
            np.arange(6)[::2],
            np.array([1.0, np.nan]),
            np.bool_(True),
        ],
        "big": 2**64 - 1,
    }
    assert orjson.loads(encode_json(value)) == {
        "op": "service_response",
        "values": {"nan": None, "inf": [None, 1.0], "raw": "AP8=", "view": "YWJj"},
        "numpy": [0.5, -3, [0, 1, 2], [0, 2, 4], [1.0, None], True],
        "big": 2**64 - 1,
    }
    assert encode_json({"b": 1, "a": "grün"}) == '{"b":1,"a":"grün"}'.encode()


@pytest.mark.parametrize("value", [object(), {1, 2}, 2**64, {"a": {1: 2}}])
def test_what_json_cannot_hold(value: Any) -> None:
    with pytest.raises(TypeError):
        encode_json(value)


def test_cbor_is_decoded() -> None:
    value = {"op": "publish", "msg": {"data": b"\x00\xff", "list": [1, -2, 2.5, None, True, "grün", 2**64]}}
    assert decode_cbor(cbor2.dumps(value)) == value
    assert decode_cbor(b"\xbf\x61a\x9f\x01\x02\xff\xff") == {"a": [1, 2]}  # indefinite lengths
    assert decode_cbor(b"\xd9\xd9\xf7\x01") == 1  # self-described CBOR


# RFC 8746, section 2.1: tag, the type of its elements in NumPy's notation
@pytest.mark.parametrize(
    ("tag", "dtype"),
    [
        (64, "u1"), (65, ">u2"), (66, ">u4"), (67, ">u8"), (68, "u1"), (69, "<u2"), (70, "<u4"), (71, "<u8"),
        (72, "i1"), (73, ">i2"), (74, ">i4"), (75, ">i8"), (77, "<i2"), (78, "<i4"), (79, "<i8"),
        (80, ">f2"), (81, ">f4"), (82, ">f8"), (84, "<f2"), (85, "<f4"), (86, "<f8"),
    ],
)  # fmt: skip
def test_typed_arrays_are_decoded(tag: int, dtype: str) -> None:
    numbers = np.array([0, 1, 100], dtype)
    decoded = decode_cbor(cbor2.dumps({"data": cbor2.CBORTag(tag, numbers.tobytes())}))["data"]
    assert decoded.dtype == np.dtype(dtype)
    assert decoded.tolist() == [0, 1, 100]


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x01\x02",  # one item and more
        b"\xa1\x61a",  # a map without the value
        b"\x61\xff",  # not UTF-8
        b"\x5b\x7f\xff\xff\xff\xff\xff\xff\xff",  # a byte string of 2**63 - 1 bytes
        b"\x9b\x7f\xff\xff\xff\xff\xff\xff\xff",
        b"\xba\xff\xff\xff\xff\x01",
        b"\x81" * 10**6,
        b"\xc6" * 10**6,
        b"\x9f" * 10**6,
        b"\xff",
        b"\x1c",  # reserved
        b"\xd8\x56\x47" + b"\0" * 7,  # float64 elements in 7 bytes
        b"\xd8\x56\x01",
        b"\xd8\x4c\x41\x00",  # tag 76 is reserved
        b"\xd8\x53\x50" + b"\0" * 16,  # 128-bit floats
        b"\xd9\x30\x39\x01",  # a tag of nobody
        b"\xd8\x1c\x81\xd8\x1d\x00",  # a list that holds itself
        b"\xd8\x23\x63(((",  # a regular expression
        b"\xc4\x82\x1b\x00\x00\x00\xff\xff\xff\xff\xff\x01",  # a decimal with an enormous exponent
        b"\xc0\x61x",  # a date
    ],
)
def test_what_is_no_cbor(data: bytes) -> None:
    begin = time.process_time()
    with pytest.raises(DecodeError, match="Not CBOR"):
        decode_cbor(data)
    assert time.process_time() - begin < 2


def test_cbor_control_messages_are_encoded() -> None:
    value = {"op": "status", "raw": b"\x00", "x": [1, 2.5, None, True], "nan": math.nan, "scalar": np.float32(0.5)}
    decoded = cbor2.loads(encode_cbor(value))
    assert math.isnan(decoded.pop("nan"))
    assert decoded == {"op": "status", "raw": b"\x00", "x": [1, 2.5, None, True], "scalar": 0.5}
    arrays = {
        "u1": np.arange(3, dtype="u1"),
        "f4": np.array([1.5], ">f4"),
        "i8": np.arange(4)[::2],
        "b": np.array([True]),
    }
    assert cbor2.loads(encode_cbor(arrays)) == {
        "u1": b"\x00\x01\x02",
        "f4": cbor2.CBORTag(85, b"\x00\x00\xc0\x3f"),
        "i8": cbor2.CBORTag(79, b"\0" * 8 + b"\x02" + b"\0" * 7),
        "b": [True],
    }
    with pytest.raises(TypeError):
        encode_cbor({"a": object()})
