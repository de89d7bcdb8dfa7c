# SPDX-License-Identifier: BSD-3-Clause
"""Messages byte by byte: what stands on the wire, in JSON and in CBOR, written by hand."""

from __future__ import annotations

import time
from typing import Any, Dict

import numpy as np
import pytest

from rosbridge_library.codec import (
    WireError,
    decode_cbor,
    decode_json,
    get_message_type,
    message_type_from_definition,
)

LINE = "\n" + "=" * 80 + "\n"


def wire(*parts: str) -> bytes:
    return bytes.fromhex("".join(parts))


SCALARS = (
    "bool on\nbyte b\nchar c\nint8 i8\nuint8 u8\nint16 i16\nuint16 u16\nint32 i32\nuint32 u32\nint64 i64\nuint64 u64"
)


def test_integers() -> None:
    message_type = message_type_from_definition("my_msgs/Integers", SCALARS)
    raw = wire(
        "01",  # on = true
        "ff",  # b = -1
        "ff",  # c = 255
        "80",  # i8 = -128
        "80",  # u8 = 128
        "feff",  # i16 = -2
        "feff",  # u16 = 65534
        "00000080",  # i32 = -2147483648
        "00000080",  # u32 = 2147483648
        "ffffffffffffffff",  # i64 = -1
        "ffffffffffffffff",  # u64 = 18446744073709551615
    )
    assert message_type.to_json(raw) == (
        b'{"on":true,"b":-1,"c":255,"i8":-128,"u8":128,"i16":-2,"u16":65534,"i32":-2147483648,"u32":2147483648,'
        b'"i64":-1,"u64":18446744073709551615}'
    )
    assert message_type.to_cbor(raw) == wire(
        "ab",  # a map of 11
        "626f6e f5",  # "on": true
        "6162 38 00",  # "b": -1 - 0
        "6163 18 ff",
        "626938 38 7f",  # -1 - 127
        "627538 18 80",
        "63693136 39 0001",
        "63753136 19 fffe",
        "63693332 3a 7fffffff",
        "63753332 1a 80000000",
        "63693634 3b 0000000000000000",
        "63753634 1b ffffffffffffffff",
    )


def test_any_byte_but_zero_is_true() -> None:
    message_type = message_type_from_definition("my_msgs/Bools", "bool one\nbool[] many\nbool[2] two")
    raw = wire("02", "03000000 00 ff 01", "00 80")
    assert message_type.to_json(raw) == b'{"one":true,"many":[false,true,true],"two":[false,true]}'
    assert message_type.to_cbor(raw) == wire("a3", "636f6e65 f5", "646d616e79 83 f4 f5 f5", "6374776f 82 f4 f5")
    assert message_type.to_values(raw) == {"one": True, "many": [False, True, True], "two": [False, True]}


def test_floats() -> None:
    message_type = message_type_from_definition("my_msgs/Floats", "float32 f\nfloat64 d\nfloat32[] fs\nfloat64[1] ds")
    raw = wire(
        "cdcccc3d",  # f = 0.1, nearly
        "000000000000f03f",  # d = 1.0
        "04000000 cdcccc3d 0000c07f 0000807f 0100a07f",  # fs = 0.1, NaN, infinity, a signalling NaN
        "000000000000f0ff",  # ds = -infinity
    )
    assert message_type.to_json(raw) == (
        b'{"f":0.10000000149011612,"d":1.0,"fs":[0.10000000149011612,null,null,null],"ds":[null]}'
    )
    assert message_type.to_cbor(raw) == wire(
        "a4",
        "6166 fa 3dcccccd",
        "6164 fb 3ff0000000000000",
        "626673 d855 50 cdcccc3d 0000c07f 0000807f 0100a07f",  # tag 85, 16 bytes
        "626473 d856 48 000000000000f0ff",  # tag 86, 8 bytes
    )


def test_times_and_strings() -> None:
    message_type = message_type_from_definition("my_msgs/Times", "time t\nduration d\nstring s\ntime[] ts\nstring[] ss")
    raw = wire(
        "ffffffff 02000000",
        "ffffffff feffffff",
        "03000000 61c3a4",  # "aä"
        "01000000 03000000 04000000",
        "02000000 00000000 01000000 22",  # "", '"'
    )
    assert message_type.to_json(raw).decode() == (
        '{"t":{"secs":4294967295,"nsecs":2},"d":{"secs":-1,"nsecs":-2},"s":"aä","ts":[{"secs":3,"nsecs":4}],"ss":["","\\""]}'
    )
    assert message_type.to_cbor(raw) == wire(
        "a5",
        "6174 a2 6473656373 1a ffffffff 656e73656373 1a 00000002",
        "6164 a2 6473656373 3a 00000000 656e73656373 3a 00000001",
        "6173 63 61c3a4",
        "627473 81 a2 6473656373 1a 00000003 656e73656373 1a 00000004",
        "627373 82 60 61 22",
    )


@pytest.mark.parametrize("field", ["uint8[]", "char[]"])
def test_binary_data(field: str) -> None:
    message_type = message_type_from_definition("my_msgs/Binary", f"{field} data\nuint8[2] two\nint8[] signed")
    raw = wire("03000000 00 ff 10", "fb f0", "02000000 ff 00")
    assert message_type.to_json(raw) == b'{"data":"AP8Q","two":"+/A=","signed":[-1,0]}'
    assert message_type.to_cbor(raw) == wire(
        "a3", "6464617461 43 00ff10", "6374776f 42 fbf0", "667369676e6564 d848 42 ff00"
    )
    assert message_type.to_values(raw) == {"data": b"\x00\xff\x10", "two": b"\xfb\xf0", "signed": [-1, 0]}


@pytest.mark.parametrize(
    ("field", "tag", "size"),
    [
        ("uint16", "d845", 2), ("uint32", "d846", 4), ("uint64", "d847", 8), ("byte", "d848", 1), ("int8", "d848", 1),
        ("int16", "d84d", 2), ("int32", "d84e", 4), ("int64", "d84f", 8), ("float32", "d855", 4),
        ("float64", "d856", 8),
    ],
)  # fmt: skip
def test_numeric_arrays_are_the_wire_under_their_tag(field: str, tag: str, size: int) -> None:
    elements = bytes(range(1, 1 + 3 * size))
    variable = message_type_from_definition("my_msgs/Array", f"{field}[] a")
    fixed = message_type_from_definition("my_msgs/Array", f"{field}[3] a")
    expected = wire("a1 6161", tag, (b"\x58" if 3 * size > 23 else b"").hex())
    length = bytes([3 * size if 3 * size > 23 else 0x40 + 3 * size])
    assert variable.to_cbor(b"\x03\0\0\0" + elements) == expected + length + elements
    assert fixed.to_cbor(elements) == expected + length + elements


def test_messages_in_messages() -> None:
    definition = "Empty none\nPoint[] points\nEmpty[] nones\nNamed[1] named" + LINE
    definition += "MSG: my_msgs/Empty\n" + LINE + "MSG: my_msgs/Point\nuint8 x\nint16 y" + LINE
    definition += "MSG: my_msgs/Named\nstring name\nPoint at"
    message_type = message_type_from_definition("my_msgs/Outer", definition)
    raw = wire("02000000 01 0200 03 fcff", "02000000", "01000000 6e 05 0600")
    assert message_type.to_json(raw) == (
        b'{"none":{},"points":[{"x":1,"y":2},{"x":3,"y":-4}],"nones":[{},{}],"named":[{"name":"n","at":{"x":5,"y":6}}]}'
    )
    assert message_type.to_cbor(raw) == wire(
        "a4",
        "646e6f6e65 a0",
        "66706f696e7473 82 a2 6178 1801 6179 19 0002 a2 6178 1803 6179 39 0003",
        "656e6f6e6573 82 a0 a0",
        "656e616d6564 81 a2 646e616d65 61 6e 626174 a2 6178 1805 6179 19 0006",
    )


def test_strings_that_are_not_utf8_are_repaired() -> None:
    string = get_message_type("std_msgs/String")
    raw = wire("04000000 61 ff c3 62")
    assert string.to_values(raw) == {"data": "a��b"}
    assert string.to_json(raw).decode() == '{"data":"a��b"}'
    assert string.to_cbor(raw) == wire("a1 6464617461 68 61 efbfbd efbfbd 62")


@pytest.mark.parametrize("length", [0, 23, 24, 255, 256, 65535, 65536])
def test_heads_of_every_size(length: int) -> None:
    heads = {0: "60", 23: "77", 24: "7818", 255: "78ff", 256: "790100", 65535: "79ffff", 65536: "7a00010000"}
    text = length.to_bytes(4, "little") + b"x" * length
    assert get_message_type("std_msgs/String").to_cbor(text) == wire("a1 6464617461", heads[length]) + b"x" * length


# A count or length prefix that is far beyond the bytes there are.
HUGE: Dict[str, str] = {
    "strings": "string s",
    "lists of strings": "string[] s",
    "bytes": "uint8[] s",
    "bools": "bool[] s",
    "numbers": "float64[] s",
    "times": "time[] s",
    "fixed-size messages": "Point[] s",
    "messages": "Named[] s",
    "empty messages": "Empty[] s",
    "messages of many empty ones": "Thousands[] s",
}


@pytest.mark.parametrize("field", HUGE.values(), ids=HUGE)
@pytest.mark.parametrize("count", [2**32 - 1, 2**31, 10**6, 4096])
def test_huge_counts_cost_nothing(field: str, count: int) -> None:
    parts = ["MSG: my_msgs/Point\nint8 x", "MSG: my_msgs/Named\nstring s", "MSG: my_msgs/Empty\n"]
    parts += ["MSG: my_msgs/Tens\nEmpty[30] s", "MSG: my_msgs/Thousands\nTens[100] s"]
    message_type = message_type_from_definition("my_msgs/Huge", LINE.join([field, *parts]))
    raw = count.to_bytes(4, "little") + b"\0" * 40
    for convert in (message_type.to_values, message_type.to_json, message_type.to_cbor):
        with pytest.raises(WireError):
            convert(raw)  # compiles
        begin = time.process_time()
        with pytest.raises(WireError):
            convert(raw)
        assert time.process_time() - begin < 0.2


def test_long_arrays_of_small_messages_are_like_short_ones() -> None:
    definition = (
        "Small[] a"
        + LINE
        + "MSG: my_msgs/Small\nbool b\nint8 i\nint64 l\nuint16 u\nfloat32 f\nfloat64[2] d\nduration t"
    )
    message_type = message_type_from_definition("my_msgs/Long", definition)
    rng = np.random.default_rng(3)
    elements = [rng.bytes(1 + 1 + 8 + 2 + 4 + 16 + 8) for _ in range(50)]
    singles = [message_type.to_cbor(b"\1\0\0\0" + element)[len(b"\xa1\x61a\x81") :] for element in elements]
    assert message_type.to_cbor(b"\x32\0\0\0" + b"".join(elements)) == wire("a1 6161 98 32") + b"".join(singles)


def test_an_array_like_the_last_one_is_read_the_same() -> None:
    """Arrays of names are remembered from message to message: whatever comes in between, they must be right."""
    definition = "string[] names\nPart[] parts\nint8 last" + LINE + "MSG: my_msgs/Part\nstring name\nuint8 kind"
    message_type = message_type_from_definition("my_msgs/Named", definition)
    lists = ([], ["a"], ["a", "bc"], ["a", "b"], ["a", "bc", "d"], ["", ""], [], ["x" * 5000], ["a", "bc"])
    right: Any = [
        {"names": names, "parts": [{"name": name, "kind": index} for index, name in enumerate(names)], "last": last}
        for last in (1, 2)
        for names in lists
    ]
    wires = [message_type.from_values(values, lambda: (0, 0))[0] for values in right]
    # A corrupt one, whose last string ends behind the bytes, must leave nothing behind.
    cut = wire("02000000 01000000 61 ff000000 6263")
    for values, raw in zip(right * 2, wires * 2):
        for _ in range(2):
            assert decode_json(message_type.to_json(raw)) == values
            assert decode_cbor(message_type.to_cbor(raw)) == values
            for broken in (raw[:-1], raw[:-3], cut, b"\xff\xff\xff\xff" + raw[4:]):
                for convert in (message_type.to_json, message_type.to_cbor):
                    with pytest.raises(WireError):
                        convert(broken)


def test_views_are_read_like_bytes() -> None:
    image: Any = get_message_type("sensor_msgs/Image")
    raw, _ = image.from_values({"data": bytes(range(256)) * 100, "encoding": "mono8"}, lambda: (1, 2))
    for view in (memoryview(raw), bytearray(raw), memoryview(bytearray(b"x" + raw))[1:]):
        assert image.to_cbor(view) == image.to_cbor(raw) == b"".join(image.cbor_pieces(view))
        assert image.to_json(view) == image.to_json(raw) == b"".join(image.json_pieces(view))
