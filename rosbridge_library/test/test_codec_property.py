# SPDX-License-Identifier: BSD-3-Clause
"""Codecs of random message types, with random values, against the classes that genpy generates for those types."""

from __future__ import annotations

import random
import sys
from pathlib import Path
from typing import Any, Dict, List, NamedTuple, Tuple

import cbor2
import orjson
from genpy.dynamic import generate_dynamic
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rosbridge_library.codec import MessageType, decode_cbor, message_type_from_definition

sys.path.insert(0, str(Path(__file__).parent))
import codec_oracle as oracle

PROFILE = settings(
    max_examples=120, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck), print_blob=True
)
SEPARATOR = "\n" + "=" * 80 + "\n"
HEADER = "# A standard header\nuint32 seq\ntime stamp\nstring frame_id\n"
BUILTINS = [*oracle.INTEGERS, "bool", "float32", "float64", "string", "time", "duration"]
CONSTANTS = [
    "int32 LIMIT=-7",
    "uint8 FLAG = 255 # a comment",
    "string HASH=a # b = c ",
    "string EMPTY=",
    "float64 PI=3.14",
    "bool YES=True",
    "char LETTER=65",
]


class Definition(NamedTuple):
    name: str
    text: str


@st.composite
def definitions(draw: st.DrawFn) -> Definition:
    """Full definition texts of a type and the types that it contains."""
    sections: List[Tuple[str, str]] = []
    uses_header = False
    for number in range(draw(st.integers(1, 5))):
        lines = ["# message %d = a comment" % number, ""]
        for index in range(draw(st.integers(0, 6))):
            kinds = [*BUILTINS, "Header", "std_msgs/Header", *[name for name, _ in sections] * 4]
            base = draw(st.sampled_from(kinds))
            if index == 0 and base == "Header":
                lines.append("Header header")
                uses_header = True
                continue
            arity = draw(st.sampled_from(["", "", "", "[]", "[]", "[1]", "[3]", "[30]"]))
            if base == "Header" and arity:
                base = "std_msgs/Header"  # genmsg takes a bare Header[] for one of the same package
            uses_header = uses_header or base in ("Header", "std_msgs/Header")
            if base.startswith("made_msgs/") and draw(st.booleans()):
                base = base.split("/")[1]
            lines.append("%s%s   field_%d # field" % (base, arity, index))
        lines += draw(st.lists(st.sampled_from(CONSTANTS), max_size=2, unique=True))
        sections.append(("made_msgs/Made%d" % number, "\n".join(lines)))
    name, text = sections.pop()
    if uses_header:
        sections.append(("std_msgs/Header", HEADER))
    return Definition(name, SEPARATOR.join([text, *["MSG: %s\n%s" % section for section in sections]]))


_generated: Dict[Definition, Dict[str, Any]] = {}


def classes_of(definition: Definition) -> Dict[str, Any]:
    """genpy's classes for a definition; making them takes time, so each is made once."""
    if definition not in _generated:
        path = list(sys.path)
        _generated[definition] = generate_dynamic(definition.name, definition.text)
        sys.path[:] = path
    return _generated[definition]


def made(definition: Definition) -> Tuple[Any, Dict[str, Any], MessageType]:
    classes = classes_of(definition)
    return classes[definition.name], classes, message_type_from_definition(*definition)


def never() -> Tuple[int, int]:
    raise AssertionError("nothing was left out")


@PROFILE
@given(definitions(), st.integers(0, 2**32))
def test_every_conversion_agrees_with_genpy(definition: Definition, seed: int) -> None:
    cls, classes, message_type = made(definition)
    assert message_type.md5sum == cls._md5sum
    assert message_type.has_header == cls._has_header
    for part in range(3):
        rng = random.Random(seed + part)
        message = oracle.fill(cls(), rng, classes.__getitem__)
        wire = oracle.serialize(message)
        message = cls().deserialize(wire)

        values = message_type.to_values(wire)
        assert oracle.same(values, oracle.python_values(message))
        text = message_type.to_json(wire)
        assert oracle.same(orjson.loads(text), oracle.json_values(message))
        cbor = message_type.to_cbor(wire)
        assert oracle.same(cbor2.loads(cbor), oracle.cbor_values(message))

        assert message_type.from_values(values, never) == (wire, [])
        assert message_type.from_values(decode_cbor(cbor), never) == (wire, [])

        assert b"".join(message_type.json_pieces(wire)) == text
        assert b"".join(message_type.cbor_pieces(wire)) == cbor
        for other in (memoryview(wire), bytearray(wire), memoryview(b"x" + wire)[1:]):
            assert message_type.to_json(other) == text
            assert message_type.to_cbor(other) == cbor
            assert oracle.same(message_type.to_values(other), values)

    # JSON has no infinities; all else comes back from it.
    finite = oracle.serialize(oracle.fill(cls(), random.Random(seed), classes.__getitem__, oracle.finite_float))
    assert message_type.from_values(orjson.loads(message_type.to_json(finite)), never) == (finite, [])

    defaults = oracle.serialize(cls())
    assert message_type.from_values(message_type.default_values(), never) == (defaults, [])
    assert oracle.same(message_type.to_values(defaults), message_type.default_values())


@PROFILE
@given(definitions(), st.integers(0, 2**32))
def test_broken_bytes_are_refused_or_read_for_what_they_are(definition: Definition, seed: int) -> None:
    cls, classes, message_type = made(definition)
    rng = random.Random(seed)
    wire = oracle.serialize(oracle.fill(cls(), rng, classes.__getitem__))
    cuts = range(len(wire)) if len(wire) < 100 else [rng.randrange(len(wire)) for _ in range(100)]
    broken = [wire[:cut] for cut in cuts] + [wire + b"\0", wire + wire] + oracle.corruptions(wire, rng, 25)
    for variant in broken:
        oracle.check_broken(message_type, variant)
