# SPDX-License-Identifier: BSD-3-Clause
"""What the codecs are held against: genpy's own classes, plain recursive conversions of their instances, and a reader
of wire bytes that takes one item at a time.

Nothing here shares code with the codecs but the parsed definition (for the reader) and the text of types.
"""

from __future__ import annotations

import base64
import io
import math
import random
import string
import struct
from typing import Any, Callable, Dict, Iterator, List, Tuple

import cbor2
import genpy
import numpy as np
import orjson
import pytest

from rosbridge_library.codec import MessageType, WireError
from rosbridge_library.codec.wire_walk import max_empty_elements

INTEGERS = {
    "byte": (-128, 127),
    "char": (0, 255),
    "int8": (-128, 127),
    "uint8": (0, 255),
    "int16": (-(2**15), 2**15 - 1),
    "uint16": (0, 2**16 - 1),
    "int32": (-(2**31), 2**31 - 1),
    "uint32": (0, 2**32 - 1),
    "int64": (-(2**63), 2**63 - 1),
    "uint64": (0, 2**64 - 1),
}
# interfaces.md, "CBOR typed arrays": tag and NumPy type of the little-endian elements.
TYPED_ARRAYS = {
    "uint16": (69, "<u2"),
    "uint32": (70, "<u4"),
    "uint64": (71, "<u8"),
    "int8": (72, "i1"),
    "byte": (72, "i1"),
    "int16": (77, "<i2"),
    "int32": (78, "<i4"),
    "int64": (79, "<i8"),
    "float32": (85, "<f4"),
    "float64": (86, "<f8"),
}
FloatSource = Callable[[random.Random, str], float]


# Random instances


def any_float(rng: random.Random, type_name: str) -> float:
    """Any value of a float32 or float64, the odd ones often."""
    choices = [0.0, -0.0, 1.0, -1.5, 0.1, 1e-40, 3.4e38, math.nan, math.inf, -math.inf, rng.uniform(-1e4, 1e4)]
    value = rng.choice(choices)
    return float(np.float32(value)) if type_name == "float32" else value


def finite_float(rng: random.Random, type_name: str) -> float:
    value = rng.choice([0.0, -0.0, 1.0, 0.1, -2.5e-300, 3.4e38, rng.uniform(-1e4, 1e4), rng.gauss(0, 1)])
    return float(np.float32(value)) if type_name == "float32" else value


def random_string(rng: random.Random) -> str:
    alphabet = rng.choice([string.ascii_letters, 'äß…€\U0001f916"\\\n\x00 x'])
    return "".join(rng.choice(alphabet) for _ in range(rng.choice([0, 1, 5, 23, 24, 30, 300])))


def fill(message: Any, rng: random.Random, find_class: Callable[[str], Any], floats: FloatSource = any_float) -> Any:
    """Give all fields of a genpy message random values; returns it."""
    for name, declared in zip(message.__slots__, message._slot_types):
        setattr(message, name, random_value(declared, rng, find_class, floats))
    return message


def random_value(declared: str, rng: random.Random, find_class: Callable[[str], Any], floats: FloatSource) -> Any:
    base, _, length = declared.partition("[")
    if length:
        count = (
            int(length[:-1])
            if length != "]"
            else rng.choice([0, 1, 2, 3, 13, 40] if "/" not in base else [0, 1, 2, 14])
        )
        if base in ("uint8", "char"):
            return bytes(rng.randrange(256) for _ in range(count))
        return [random_value(base, rng, find_class, floats) for _ in range(count)]
    if base in INTEGERS:
        low, high = INTEGERS[base]
        return rng.choice([low, high, 0, 1, 23, 24, rng.randint(low, high)])
    if base == "bool":
        return rng.random() < 0.5
    if base in ("float32", "float64"):
        return floats(rng, base)
    if base == "string":
        return random_string(rng)
    if base == "time":
        return genpy.Time(rng.choice([0, 1, 2**32 - 1, rng.randrange(2**32)]), rng.randrange(10**9))
    if base == "duration":
        return genpy.Duration(rng.choice([0, 1, 2**31 - 2, rng.randint(-(2**31), 2**31 - 2)]), rng.randrange(10**9))
    return fill(find_class(base)(), rng, find_class, floats)


def serialize(message: Any) -> bytes:
    buffer = io.BytesIO()
    message.serialize(buffer)
    return buffer.getvalue()


# Recursive conversions of instances


def fields(message: Any) -> Iterator[Tuple[str, str, Any]]:
    for name, declared in zip(message.__slots__, message._slot_types):
        yield name, declared, getattr(message, name)


def values_of(message: Any, leaf: Callable[[str, Any], Any]) -> Dict[str, Any]:
    """The fields of an instance as a dictionary; `leaf` converts numbers, and arrays of numbers, by declared type."""

    def convert(declared: str, value: Any) -> Any:
        base, _, length = declared.partition("[")
        if base in ("time", "duration") and not length:
            return {"secs": value.secs, "nsecs": value.nsecs}
        if "/" in base and not length:
            return values_of(value, leaf)
        if length and (base in ("time", "duration", "string") or "/" in base):
            return [convert(base, item) for item in value]
        return leaf(declared, value)

    return {name: convert(declared, value) for name, declared, value in fields(message)}


def python_values(message: Any) -> Dict[str, Any]:
    def leaf(declared: str, value: Any) -> Any:
        if declared.startswith(("uint8[", "char[")):
            return bytes(value)
        return list(value) if "[" in declared else value

    return values_of(message, leaf)


def json_values(message: Any) -> Dict[str, Any]:
    """What a JSON client is to see after parsing."""

    def leaf(declared: str, value: Any) -> Any:
        if declared.startswith(("uint8[", "char[")):
            return base64.b64encode(bytes(value)).decode()
        if declared.startswith("float"):
            number = lambda item: item if math.isfinite(item) else None  # noqa: E731
            return [number(item) for item in value] if "[" in declared else number(value)
        return list(value) if "[" in declared else value

    return values_of(message, leaf)


def cbor_values(message: Any) -> Dict[str, Any]:
    """What a CBOR client is to see after decoding, typed arrays still as tags."""

    def leaf(declared: str, value: Any) -> Any:
        base, _, length = declared.partition("[")
        if not length:
            return value
        if base in ("uint8", "char"):
            return bytes(value)
        if base == "bool":
            return list(value)
        tag, dtype = TYPED_ARRAYS[base]
        return cbor2.CBORTag(tag, np.array(value, dtype).tobytes())

    return values_of(message, leaf)


def same(left: Any, right: Any) -> bool:
    """Equality of values in which NaN is NaN, -0.0 is not 0.0, 1 is not 1.0 or True, and the order of keys counts."""
    if type(left) is not type(right):
        return False
    if isinstance(left, dict):
        return list(left) == list(right) and all(same(left[key], right[key]) for key in left)
    if isinstance(left, list):
        return len(left) == len(right) and all(map(same, left, right))
    if isinstance(left, float):
        return struct.pack("d", left) == struct.pack("d", right) or (math.isnan(left) and math.isnan(right))
    return bool(left == right)


# Reading wire bytes one item at a time


class Unreadable(Exception):
    """The bytes are no message of the type."""


CODES = {"bool": "B", "byte": "b", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H"}
CODES.update({"int32": "i", "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d"})


class WireReader:
    """Reads what any bytes, valid or not, hold of a message type."""

    def __init__(self, wire: bytes) -> None:
        self._wire = wire
        self._at = 0

    def message(self, plan: Any) -> Dict[str, Any]:
        values = self._fields(plan)
        if self._at != len(self._wire):
            raise Unreadable("over-long")
        return values

    def _fields(self, plan: Any) -> Dict[str, Any]:
        return {field.name: self._field(field) for field in plan.fields}

    def _field(self, field: Any) -> Any:
        if not field.is_array:
            return self._element(field)
        count = self._number("I") if field.length is None else field.length
        if count * field.min_element_size > len(self._wire) - self._at:
            raise Unreadable("truncated")
        if field.length is None and not field.min_element_size and count > max_empty_elements(field):
            raise Unreadable("more than the codecs make of no bytes")
        if field.type in ("uint8", "char"):
            return self._bytes(count)
        return [self._element(field) for _ in range(count)]

    def _element(self, field: Any) -> Any:
        if field.message is not None:
            return self._fields(field.message)
        if field.type == "string":
            return self._bytes(self._number("I")).decode("utf-8", "replace")
        if field.type in ("time", "duration"):
            code = "I" if field.type == "time" else "i"
            return {"secs": self._number(code), "nsecs": self._number(code)}
        value = self._number(CODES[field.type])
        return value != 0 if field.type == "bool" else value

    def _number(self, code: str) -> Any:
        raw = self._bytes(struct.calcsize("<" + code))
        return struct.unpack("<" + code, raw)[0]

    def _bytes(self, count: int) -> bytes:
        raw = self._wire[self._at : self._at + count]
        if len(raw) != count:
            raise Unreadable("truncated")
        self._at += count
        return raw


def corruptions(wire: bytes, rng: random.Random, count: int) -> List[bytes]:
    """Variants of wire bytes with wrong bytes, wrong lengths, and parts left out or repeated."""
    variants = []
    for _ in range(count):
        broken = bytearray(wire)
        for _ in range(rng.choice([1, 1, 1, 4])):
            if not broken:
                break
            at = rng.randrange(len(broken))
            kind = rng.randrange(4)
            if kind == 0:
                broken[at] = rng.choice([0, 1, 2, 0x7F, 0x80, 0xFF, rng.randrange(256)])
            elif kind == 1:
                broken[at : at + 4] = struct.pack("<I", rng.choice([0, 1, 2**31, 2**32 - 1, 2**16, len(wire)]))
            elif kind == 2:
                del broken[at : at + rng.choice([1, 4, 8])]
            else:
                broken[at:at] = broken[at : at + rng.choice([1, 4, 8])]
        variants.append(bytes(broken))
    return variants


def check_broken(message_type: MessageType, wire: bytes) -> None:
    """The conversions of any bytes: right when they hold a message of the type, WireError when not."""
    try:
        expected = WireReader(wire).message(message_type.plan)
    except Unreadable:
        for convert in (message_type.to_values, message_type.to_json, message_type.to_cbor):
            with pytest.raises(WireError):
                convert(wire)
        return
    assert same(message_type.to_values(wire), expected)
    orjson.loads(message_type.to_json(wire))
    cbor2.loads(message_type.to_cbor(wire))
