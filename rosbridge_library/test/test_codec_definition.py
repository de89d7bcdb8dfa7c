# SPDX-License-Identifier: BSD-3-Clause
"""Message definitions: what is read out of them, and which are refused."""

from __future__ import annotations

import gc
import linecache
import traceback
from typing import Any, List

import pytest
from geometry_msgs.msg import PoseStamped

from rosbridge_library.codec import DefinitionError, WireError, get_message_type, message_type_from_definition
from rosbridge_library.codec import message_type as message_types

LINE = "\n" + "=" * 80 + "\n"


def test_fields_and_constants_are_listed() -> None:
    message_type = message_type_from_definition(
        "my_msgs/Thing",
        "# a thing\n"
        "int8 LOW=-5   # not part of it\n"
        "string NOTE= a # b = c \n"
        "bool ON=True\n"
        "float32 HALF = 0.5\n"
        "Header header\n"
        "float64[36] covariance # 6x6\n"
        "Part[] parts\n"
        "std_msgs/Header[2] headers\n"
        "\n"
        "time stamp"
        + LINE
        + "MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id"
        + LINE
        + "MSG: my_msgs/Part\nchar c",
    )
    constants = [(constant.type, constant.name, constant.value, constant.text) for constant in message_type.constants]
    assert constants == [
        ("int8", "LOW", -5, "-5"),
        ("string", "NOTE", "a # b = c", "a # b = c"),
        ("bool", "ON", True, "True"),
        ("float32", "HALF", 0.5, "0.5"),
    ]
    fields = [(field.name, field.type, field.is_array, field.length) for field in message_type.fields]
    assert fields == [
        ("header", "std_msgs/Header", False, None),
        ("covariance", "float64", True, 36),
        ("parts", "my_msgs/Part", True, None),
        ("headers", "std_msgs/Header", True, 2),
        ("stamp", "time", False, None),
    ]
    assert [field.declared_type for field in message_type.fields][1:3] == ["float64[36]", "my_msgs/Part[]"]
    assert message_type.has_header
    part = message_type.fields[2].message
    assert part is not None
    assert (part.name, [field.name for field in part.fields]) == ("my_msgs/Part", ["c"])


def test_definitions_of_old_and_of_windows() -> None:
    text = PoseStamped._full_text
    same = [
        text.replace("\n", "\r\n"),
        text.replace("std_msgs/Header", "roslib/Header"),
        text + "\n\n",
        text.replace(" ", "\t"),
    ]
    for variant in same:
        variant = variant.replace("MSG:\t", "MSG: ")
        assert message_type_from_definition("geometry_msgs/PoseStamped", variant).md5sum == PoseStamped._md5sum


def test_a_type_is_made_once() -> None:
    first = message_type_from_definition("geometry_msgs/PoseStamped", PoseStamped._full_text)
    assert message_type_from_definition("geometry_msgs/PoseStamped", PoseStamped._full_text) is first
    assert message_type_from_definition("geometry_msgs/msg/PoseStamped", PoseStamped._full_text) is first
    assert get_message_type("geometry_msgs/PoseStamped") is get_message_type("geometry_msgs/PoseStamped")


def test_the_number_of_types_kept_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(message_types, "MAX_DEFINED_TYPES", 5)
    made = [message_type_from_definition("my_msgs/Many", f"int8 field_{number}") for number in range(20)]
    assert len(message_types._defined) == 5
    assert message_type_from_definition("my_msgs/Many", "int8 field_19") is made[19]
    assert message_type_from_definition("my_msgs/Many", "int8 field_0") is not made[0]


def test_the_md5sum_of_the_header_must_be_that_of_the_definition() -> None:
    for md5sum in (None, "*", PoseStamped._md5sum):
        message_type_from_definition("geometry_msgs/PoseStamped", PoseStamped._full_text, md5sum)
    with pytest.raises(DefinitionError, match="md5sum"):
        message_type_from_definition("geometry_msgs/PoseStamped", PoseStamped._full_text, "0" * 32)


def nested(levels: int, arity: str) -> str:
    """Each type holds two of the next: the fields double with each level."""
    sections = [f"MSG: my_msgs/N{level}\nN{level + 1}{arity} a\nN{level + 1}{arity} b" for level in range(1, levels)]
    sections.append(f"MSG: my_msgs/N{levels}\nint8 x")
    return LINE.join([f"N1{arity} a\nN1{arity} b", *sections])


@pytest.mark.parametrize(
    ("definition", "reason"),
    [
        ("Missing part", "my_msgs/Missing is missing"),
        ("int8", "not a field"),
        ("int8 a b", "not a field"),
        ("int8 1a", "not a field"),
        ("int8[x] a", "not a field"),
        ("int8[-1] a", "not a field"),
        ("int8[2][3] a", "not a field"),
        ("int8[99999999999] a", "too long"),
        ("int8 a\nint16 a", "two fields"),
        ("int8 A=200", "out of the range"),
        ("int8 A=x", "constant A"),
        ("time A=1", "not the type of a constant"),
        ("int8 a b=1", "not a constant"),
        ("T t", "contains itself"),
        ("my_msgs/A a" + LINE + "MSG: my_msgs/A\nB b" + LINE + "MSG: my_msgs/B\nA[] a", "contains itself"),
        ("int8 a" + LINE + "my_msgs/A\nint8 a", "expected a line MSG"),
        ("float64[99999999] a", "too big"),
        ("A[99999999] a" + LINE + "MSG: my_msgs/A\n", "too big"),
        (nested(12, "[4]"), "too big"),
        ("uint8[99999999] a", "too big"),
        ("string[9999999] a", "too big"),
        (nested(30, ""), "nested too deeply|too big"),
        (nested(15, ""), "too big"),
        (nested(15, "[]"), "too big"),
        ("<html>", "not a field"),
        ("\0", "not a field"),
    ],
)
def test_what_is_no_definition(definition: str, reason: str) -> None:
    with pytest.raises(DefinitionError, match=reason):
        message_type_from_definition("my_msgs/T", definition)


@pytest.mark.parametrize("field", ["A a", "A[] a", "A[2] a", "string[] a"])
def test_types_nest_as_deep_as_is_allowed(field: str) -> None:
    depth = 14
    sections = [f"MSG: my_msgs/A{level}\n{field.replace('A', f'A{level + 1}')}" for level in range(depth)]
    sections.append(f"MSG: my_msgs/A{depth}\nstring[] s")
    if "string" in field:
        sections = []
    message_type = message_type_from_definition("my_msgs/T", LINE.join([field.replace("A", "A0"), *sections]))
    values: Any = message_type.default_values()
    wire, missing = message_type.from_values(values, lambda: (0, 0))
    assert missing == []
    assert message_type.to_values(wire) == values
    assert message_type.to_json(wire)
    assert message_type.to_cbor(wire)


def test_tracebacks_show_the_generated_code() -> None:
    with pytest.raises(WireError) as raised:
        message_type_from_definition("my_msgs/Traced", "string a\nint8 b").to_values(b"\x01")
    cause = raised.value.__cause__
    assert cause is not None
    shown = "".join(traceback.format_exception(type(cause), cause, cause.__traceback__))
    assert "<codec my_msgs/Traced to_values" in shown
    assert "U1(wire)" in shown


def test_the_text_of_generated_code_goes_with_its_type() -> None:
    message_type_from_definition("my_msgs/Forgotten", "int8 b").to_values(b"\x01")

    def texts() -> List[str]:
        return [name for name in linecache.cache if name.startswith("<codec my_msgs/Forgotten ")]

    assert texts()
    message_types._defined.clear()
    gc.collect()
    assert not texts()
