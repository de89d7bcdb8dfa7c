# SPDX-License-Identifier: BSD-3-Clause
"""Values of clients → wire bytes: what is taken, what is refused and why, what is filled in."""

from __future__ import annotations

import base64
import math
import struct
import time
from typing import Any, Dict, List, Tuple

import numpy as np
import pytest

from rosbridge_library.codec import (
    FieldTypeMismatchException,
    MessageType,
    NonexistentFieldException,
    ValuesError,
    get_message_type,
    message_type_from_definition,
)

LINE = "\n" + "=" * 80 + "\n"


def now() -> Tuple[int, int]:
    return 1700000000, 5


def one(field: str) -> MessageType:
    """A message type with one field `v`."""
    return message_type_from_definition("my_msgs/One", f"{field} v")


def refused(message_type: MessageType, values: Any) -> str:
    with pytest.raises(FieldTypeMismatchException) as raised:
        message_type.from_values(values, now)
    return str(raised.value)


INTEGERS = {
    "int8": (-128, 127), "byte": (-128, 127), "uint8": (0, 255), "char": (0, 255), "int16": (-32768, 32767),
    "uint16": (0, 65535), "int32": (-(2**31), 2**31 - 1), "uint32": (0, 2**32 - 1),
    "int64": (-(2**63), 2**63 - 1), "uint64": (0, 2**64 - 1),
}  # fmt: skip


@pytest.mark.parametrize("field", INTEGERS)
def test_integers_are_taken_within_their_range(field: str) -> None:
    low, high = INTEGERS[field]
    for suffix, wrap in (
        ("", lambda number: number),
        ("[]", lambda number: [0, number]),
        ("[1]", lambda number: [number]),
    ):
        message_type = one(field + suffix)
        for number in (low, high, 0, 7):
            wire, _ = message_type.from_values({"v": wrap(number)}, now)
            assert message_type.to_values(wire)["v"] in (
                wrap(number),
                bytes(wrap(number)) if suffix and low == 0 and high == 255 else None,
            )
        assert message_type.from_values({"v": wrap(5.0)}, now) == message_type.from_values({"v": wrap(5)}, now)
        assert message_type.from_values({"v": wrap(np.int16(5))}, now) == message_type.from_values({"v": wrap(5)}, now)
        assert message_type.from_values({"v": wrap(np.float32(5))}, now) == message_type.from_values(
            {"v": wrap(5)}, now
        )
        for wrong in (
            low - 1,
            high + 1,
            10**30,
            0.5,
            math.nan,
            math.inf,
            1e30,
            "1",
            True,
            None,
            [1],
            {},
            np.bool_(True),
        ):
            text = refused(message_type, {"v": wrap(wrong)})
            assert f"an integer from {low} to {high}" in text
            assert {"": "'v'", "[]": "'v[1]'", "[1]": "'v[0]'"}[suffix] in text


@pytest.mark.parametrize("field", ["float32", "float64"])
def test_floats(field: str) -> None:
    code = "<f" if field == "float32" else "<d"
    for number in (0, 1, -1.5, -0.0, math.inf, -math.inf, 2**40, np.float32(2.5), np.float64(2.5), np.int8(3)):
        assert one(field).from_values({"v": number}, now)[0] == struct.pack(code, number)
        assert one(field + "[2]").from_values({"v": [number, 1]}, now)[0] == struct.pack(code + code[1], number, 1)
    for nothing in (None, math.nan):
        assert math.isnan(struct.unpack(code, one(field).from_values({"v": nothing}, now)[0])[0])
        wire, _ = one(field + "[]").from_values({"v": [1, nothing, 2.5]}, now)
        first, middle, last = struct.unpack(code[0] + "3" + code[1], wire[4:])
        assert (first, last) == (1, 2.5)
        assert math.isnan(middle)
    for wrong in ("1", True, False, [1.0], {}, 10**400, b"x", np.bool_(False)):
        assert "a number" in refused(one(field), {"v": wrong})
        assert "'v[1]'" in refused(one(field + "[]"), {"v": [1.0, wrong]})


def test_what_overflows_a_float32_is_refused() -> None:
    largest = 3.4028234663852886e38
    for message_type, wrap in (
        (one("float32"), lambda x: x),
        (one("float32[]"), lambda x: [x]),
        (one("float32[]"), lambda x: np.array([x])),
    ):
        message_type.from_values({"v": wrap(largest)}, now)
        message_type.from_values({"v": wrap(math.inf)}, now)
        refused(message_type, {"v": wrap(1e39)})
        refused(message_type, {"v": wrap(-3.4028236e38)})


def test_bools() -> None:
    for right in (True, False, np.bool_(True)):
        assert one("bool").from_values({"v": right}, now)[0] == bytes([bool(right)])
        assert one("bool[]").from_values({"v": [right]}, now)[0] == bytes([1, 0, 0, 0, bool(right)])
    assert one("bool[]").from_values({"v": np.array([True, False])}, now)[0] == b"\2\0\0\0\1\0"
    for wrong in (1, 0, 1.0, "true", None, []):
        assert "a bool" in refused(one("bool"), {"v": wrong})
        assert "'v[0]'" in refused(one("bool[]"), {"v": [wrong]})
    refused(one("bool[]"), {"v": np.array([1, 0])})


def test_strings() -> None:
    assert one("string").from_values({"v": "grün"}, now)[0] == b"\x05\0\0\0gr\xc3\xbcn"
    assert one("string[]").from_values({"v": ["", "a"]}, now)[0] == b"\2\0\0\0\0\0\0\0\1\0\0\0a"
    for wrong in (1, None, b"bytes", ["a"], {}, True, "\ud800"):
        assert "a string" in refused(one("string"), {"v": wrong})
        assert "'v[1]'" in refused(one("string[]"), {"v": ["a", wrong]})
    refused(one("string[]"), {"v": "ab"})


@pytest.mark.parametrize("field", ["uint8", "char"])
def test_binary_data(field: str) -> None:
    raw = bytes(range(256))
    text = base64.b64encode(raw).decode()
    lines = "\n".join(text[start : start + 76] for start in range(0, len(text), 76))
    for values in (raw, bytearray(raw), memoryview(raw), list(raw), tuple(raw), text, lines, np.frombuffer(raw, "u1")):
        assert one(field + "[]").from_values({"v": values}, now)[0] == b"\0\1\0\0" + raw
        assert one(field + "[256]").from_values({"v": values}, now)[0] == raw
        assert "256 elements" in refused(one(field + "[255]"), {"v": values})
    for wrong in ("a", "ab=c", "ä", "====", [256], [-1], [1.5], ["a"], [True], 5, None, {}, np.array([300])):
        refused(one(field + "[]"), {"v": wrong})


@pytest.mark.parametrize(
    ("field", "dtype"),
    [
        ("int8", "i1"), ("byte", "i1"), ("int16", "<i2"), ("int32", "<i4"), ("int64", "<i8"), ("uint8", "u1"),
        ("uint16", "<u2"), ("uint32", "<u4"), ("uint64", "<u8"), ("float32", "<f4"), ("float64", "<f8"),
    ],
)  # fmt: skip
def test_typed_arrays_are_cast_when_they_fit(field: str, dtype: str) -> None:
    for given in ("i1", "u1", ">i2", "<u4", ">i8", "<u8", "<f4", ">f8", "<f2"):
        wire, _ = one(field + "[]").from_values({"v": np.array([0, 1, 100], given)}, now)
        assert wire[4:] == np.array([0, 1, 100], dtype).tobytes()
        assert "2 elements" in refused(one(field + "[3]"), {"v": np.array([0, 1], given)})
    if "float" not in field:
        low, high = INTEGERS[field]
        for values in (
            np.array([0.5]),
            np.array([math.nan]),
            np.array([math.inf]),
            np.array([1e30]),
            np.array([float(high) * 2 + 2]),
        ):
            assert "'v[0]'" in refused(one(field + "[]"), {"v": values})
        if low == 0:
            refused(one(field + "[]"), {"v": np.array([-1])})
    for wrong in (np.array([True]), np.array(["a"]), np.zeros((2, 2)), np.array(1), np.array([1j])):
        refused(one(field + "[]"), {"v": wrong})


def test_the_edges_of_64_bit_integers_as_floats() -> None:
    refused(one("int64[]"), {"v": np.array([2.0**63])})
    refused(one("uint64[]"), {"v": np.array([2.0**64])})
    refused(one("int64"), {"v": 2.0**63})
    refused(one("uint64"), {"v": 2.0**64})
    assert one("int64[]").from_values({"v": np.array([-(2.0**63)])}, now)[0][4:] == struct.pack("<q", -(2**63))
    assert one("uint64").from_values({"v": 2.0**63}, now)[0] == struct.pack("<Q", 2**63)
    refused(one("int64[]"), {"v": np.array([2**63], "u8")})
    refused(one("uint64[]"), {"v": np.array([-1], "i8")})


def test_arrays_have_the_length_of_their_type() -> None:
    definition = (
        "Part[2] parts\nstring[2] names\ntime[2] times\nfloat64[2] numbers" + LINE + "MSG: my_msgs/Part\nint8 n"
    )
    message_type = message_type_from_definition("my_msgs/Fixed", definition)
    right: Dict[str, List[Any]] = {
        "parts": [{"n": 1}] * 2,
        "names": ["a"] * 2,
        "times": ["now"] * 2,
        "numbers": [1.5] * 2,
    }
    message_type.from_values(right, now)
    for name, values in right.items():
        for wrong in (values[:1], values * 2, [], "ab", {"0": 1}, None, 2):
            assert f"'{name}'" in refused(message_type, {**right, name: wrong})
    message_type.from_values({name: tuple(values) for name, values in right.items()}, now)


# Times


def test_times() -> None:
    message_type = one("time")
    assert message_type.from_values({"v": {"secs": 1, "nsecs": 2}}, now)[0] == struct.pack("<II", 1, 2)
    assert message_type.from_values({"v": "now"}, now)[0] == struct.pack("<II", *now())
    assert message_type.from_values({"v": {"secs": 1.0}}, now) == (struct.pack("<II", 1, 0), ["v.nsecs"])
    assert one("duration").from_values({"v": {"secs": -1, "nsecs": 2}}, now)[0] == struct.pack("<ii", -1, 2)
    assert one("time[]").from_values({"v": ["now", {"secs": 1, "nsecs": 0}]}, now)[0][4:] == struct.pack(
        "<4I", *now(), 1, 0
    )
    for wrong in ("later", 1, 1.5, None, [], True):
        assert "a time" in refused(message_type, {"v": wrong})
        assert "a duration" in refused(one("duration"), {"v": wrong})
    refused(one("duration"), {"v": "now"})
    assert "'v.secs'" in refused(message_type, {"v": {"secs": -1, "nsecs": 0}})
    assert "'v[1].nsecs'" in refused(one("time[]"), {"v": ["now", {"secs": 0, "nsecs": "0"}]})
    with pytest.raises(NonexistentFieldException, match=r"v\.sec$"):
        message_type.from_values({"v": {"sec": 1, "nanosec": 2}}, now)


# Headers, and what is left out


def test_an_omitted_header_is_filled_and_not_reported() -> None:
    stamped = get_message_type("geometry_msgs/PointStamped")
    point = {"x": 0, "y": 0, "z": 0}
    header = {"seq": 0, "stamp": {"secs": 1700000000, "nsecs": 5}, "frame_id": ""}
    wire, missing = stamped.from_values({"point": point}, now)
    assert (stamped.to_values(wire)["header"], missing) == (header, [])
    wire, missing = stamped.from_values({"point": point, "header": {"frame_id": "map"}}, now)
    assert (stamped.to_values(wire)["header"], missing) == ({**header, "frame_id": "map"}, [])
    wire, missing = stamped.from_values({"point": point, "header": {}}, now)
    assert (stamped.to_values(wire)["header"], missing) == (header, ["header.frame_id"])
    given = {"seq": 9, "stamp": {"secs": 3, "nsecs": 4}, "frame_id": "odom"}
    wire, missing = stamped.from_values({"point": point, "header": given}, now)
    assert (stamped.to_values(wire)["header"], missing) == (given, [])


def test_null_in_a_header_is_a_field_left_out() -> None:
    """roslibpy sends it for what its program did not give."""
    stamped = get_message_type("geometry_msgs/PointStamped")
    header = {"seq": None, "stamp": None, "frame_id": None}
    wire, missing = stamped.from_values({"point": {"x": 0, "y": 0, "z": 0}, "header": header}, now)
    filled = {"seq": 0, "stamp": {"secs": 1700000000, "nsecs": 5}, "frame_id": ""}
    assert (stamped.to_values(wire)["header"], missing) == (filled, ["header.frame_id"])


def test_headers_of_elements_are_filled_too() -> None:
    path = get_message_type("nav_msgs/Path")
    wire, missing = path.from_values({"poses": [{}, {"header": {"frame_id": "a"}}]}, now)
    headers = [pose["header"] for pose in path.to_values(wire)["poses"]]
    assert [header["stamp"] for header in headers] == [{"secs": 1700000000, "nsecs": 5}] * 2
    assert [header["frame_id"] for header in headers] == ["", "a"]
    assert missing == ["poses[].pose"]


def test_a_message_that_is_a_header() -> None:
    header = get_message_type("std_msgs/Header")
    wire, missing = header.from_values({}, now)
    assert (header.to_values(wire)["stamp"], missing) == ({"secs": 1700000000, "nsecs": 5}, ["frame_id"])


def test_fields_left_out_are_reported_once_each() -> None:
    twist = get_message_type("geometry_msgs/Twist")
    assert twist.from_values({}, now) == (bytes(48), ["linear", "angular"])
    wire, missing = twist.from_values({"angular": {"z": 1}}, now)
    assert wire == struct.pack("<6d", 0, 0, 0, 0, 0, 1)
    assert missing == ["linear", "angular.x", "angular.y"]
    markers = get_message_type("visualization_msgs/MarkerArray")
    wire, missing = markers.from_values({"markers": [{"points": [{"x": 1}] * 3}] * 3}, now)
    assert "markers[].points[].y" in missing
    assert len(set(missing)) == len(missing) < 30


def test_defaults_of_every_kind() -> None:
    definition = "bool b\nint8 i\nfloat32 f\nstring s\ntime t\nduration d\nuint8[] u\nint16[2] a\nstring[2] ss\n"
    definition += "Part p\nPart[2] ps"
    message_type = message_type_from_definition("my_msgs/All", definition + LINE + "MSG: my_msgs/Part\nint8 n")
    wire, missing = message_type.from_values({}, now)
    assert missing == ["b", "i", "f", "s", "t", "d", "u", "a", "ss", "p", "ps"]
    assert message_type.to_values(wire) == message_type.default_values()
    assert message_type.default_values() == {
        "b": False, "i": 0, "f": 0.0, "s": "", "t": {"secs": 0, "nsecs": 0}, "d": {"secs": 0, "nsecs": 0}, "u": b"",
        "a": [0, 0], "ss": ["", ""], "p": {"n": 0}, "ps": [{"n": 0}, {"n": 0}],
    }  # fmt: skip


# Errors


def path_of(message_type: str, values: Any) -> str:
    with pytest.raises(ValuesError) as raised:
        get_message_type(message_type).from_values(values, now)
    error = raised.value
    assert message_type in str(error)
    assert error.path in str(error)
    return error.path


def test_errors_name_the_path() -> None:
    assert path_of("geometry_msgs/Twist", {"linear": {"x": "1"}}) == "linear.x"
    assert path_of("geometry_msgs/Twist", {"linear": {"q": 1}}) == "linear.q"
    assert path_of("geometry_msgs/Twist", {"linear": {"x": 1, "y": 1, "q": 1}}) == "linear.q"
    assert path_of("geometry_msgs/Twist", {"lin": {}}) == "lin"
    assert path_of("geometry_msgs/Twist", {1: {}}) == "1"
    assert path_of("std_msgs/Empty", {"a": 1}) == "a"
    assert path_of("geometry_msgs/Twist", {"linear": [1, 2, 3]}) == "linear"
    assert (
        path_of("nav_msgs/Path", {"poses": [{}, {}, {"pose": {"position": {"z": []}}}]}) == "poses[2].pose.position.z"
    )
    assert path_of("nav_msgs/Path", {"poses": [{}, None]}) == "poses[1]"
    points = [{"x": 0, "y": 0, "z": 0}] * 3
    markers = [{"points": points}, {"points": [*points, {"x": "[]"}]}]
    assert path_of("visualization_msgs/MarkerArray", {"markers": markers}) == "markers[1].points[3].x"
    assert path_of("visualization_msgs/MarkerArray", {"markers": [{"points": points}, {"[]": 1}]}) == "markers[1].[]"
    assert (
        path_of("visualization_msgs/MarkerArray", {"markers": [{"points": points}, {"color": {"r": ""}}]})
        == "markers[1].color.r"
    )
    assert path_of("sensor_msgs/LaserScan", {"ranges": [1, 2, "x"]}) == "ranges[2]"


@pytest.mark.parametrize("values", [None, 3, "text", [], True, b""])
def test_what_is_no_message_at_all(values: Any) -> None:
    assert path_of("geometry_msgs/Twist", values) == ""


def test_errors_say_what_was_expected_and_found() -> None:
    text = refused(get_message_type("geometry_msgs/Twist"), {"linear": {"x": "fast"}})
    assert text == "geometry_msgs/Twist message requires a number (float64) for field 'linear.x', but got str 'fast'"


def test_errors_stay_short_and_quick() -> None:
    begin = time.process_time()
    for wrong in ("x" * 10**7, 10**100000, [[]] * 10**6, {"a": "b" * 10**7}):
        assert len(refused(get_message_type("std_msgs/Int32"), {"data": wrong})) < 300
    assert time.process_time() - begin < 1


def test_mappings_of_other_kinds_are_taken() -> None:
    class Document(Dict[str, Any]):
        """As BSON decoders return them."""

    twist = get_message_type("geometry_msgs/Twist")
    vector = Document(x=1.0, y=2.0, z=3.0)
    assert twist.from_values(Document(linear=vector, angular=vector), now)[0] == struct.pack("<6d", 1, 2, 3, 1, 2, 3)
