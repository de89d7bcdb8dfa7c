# SPDX-License-Identifier: BSD-3-Clause
"""The codecs of every message and service type that is installed, with random values, against the generated classes."""

from __future__ import annotations

import importlib
import pkgutil
import random
import sys
import zlib
from pathlib import Path
from typing import Any, Iterator, List, Tuple

import cbor2
import orjson
import pytest

from rosbridge_library.codec import (
    WireError,
    decode_cbor,
    get_message_type,
    get_service_type,
    message_type_from_definition,
)
from rosbridge_library.internal.ros_loader import get_message_class

sys.path.insert(0, str(Path(__file__).parent))
import codec_oracle as oracle

VALUES_PER_TYPE = 3
MAX_CUTS = 250


def installed(kind: str, marker: str) -> Iterator[Any]:
    """The generated classes of all installed packages, `kind` being msg or srv."""
    for package in sorted({module.name for module in pkgutil.iter_modules() if module.ispkg}):
        # Only packages of messages are imported: those with a msg or srv directory.
        spec = importlib.util.find_spec(package)
        places = spec.submodule_search_locations or [] if spec else []
        if any((Path(place) / kind / "__init__.py").is_file() for place in places):
            module = importlib.import_module(f"{package}.{kind}")
            yield from (cls for _, cls in sorted(vars(module).items()) if hasattr(cls, marker))


MESSAGES = list(installed("msg", "_slot_types"))
SERVICES = list(installed("srv", "_request_class"))


def cases() -> List[Any]:
    found: List[Tuple[str, Any]] = [(cls._type, cls) for cls in MESSAGES]
    for service in SERVICES:
        found += [(service._request_class._type, service._request_class)]
        found += [(service._response_class._type, service._response_class)]
    return [pytest.param(cls, id=name) for name, cls in found]


def test_the_corpus_is_there() -> None:
    assert len(MESSAGES) > 100
    assert len(SERVICES) > 10
    packages = {cls._type.split("/")[0] for cls in MESSAGES}
    assert {"std_msgs", "geometry_msgs", "sensor_msgs", "nav_msgs", "tf2_msgs", "visualization_msgs"} <= packages


@pytest.mark.parametrize("service", SERVICES, ids=lambda service: service._type)
def test_services_have_the_md5sums_of_their_classes(service: Any) -> None:
    service_type = get_service_type(service._type)
    assert service_type.md5sum == service._md5sum
    assert service_type.request.md5sum == service._request_class._md5sum
    assert service_type.response.md5sum == service._response_class._md5sum


@pytest.mark.parametrize("cls", MESSAGES, ids=lambda cls: cls._type)
def test_messages_have_the_md5sums_of_their_classes(cls: Any) -> None:
    message_type = get_message_type(cls._type)
    assert message_type.md5sum == cls._md5sum
    assert message_type.has_header == cls._has_header
    assert message_type_from_definition(cls._type, cls._full_text, cls._md5sum).md5sum == cls._md5sum


def never() -> Tuple[int, int]:
    raise AssertionError("nothing was left out")


@pytest.mark.parametrize("cls", cases())
def test_conversions_agree_with_the_generated_class(cls: Any) -> None:
    message_type = message_type_from_definition(cls._type, cls._full_text)
    rng = random.Random(zlib.crc32(cls._type.encode()))
    for _ in range(VALUES_PER_TYPE):
        wire = oracle.serialize(oracle.fill(cls(), rng, get_message_class))
        message = cls().deserialize(wire)
        cbor = message_type.to_cbor(wire)
        assert oracle.same(message_type.to_values(wire), oracle.python_values(message))
        assert oracle.same(orjson.loads(message_type.to_json(wire)), oracle.json_values(message))
        assert oracle.same(cbor2.loads(cbor), oracle.cbor_values(message))
        assert message_type.from_values(message_type.to_values(wire), never) == (wire, [])
        assert message_type.from_values(decode_cbor(cbor), never) == (wire, [])

        wire = oracle.serialize(oracle.fill(cls(), rng, get_message_class, oracle.finite_float))
        assert message_type.from_values(orjson.loads(message_type.to_json(wire)), never) == (wire, [])
    wire = oracle.serialize(cls())
    assert message_type.from_values(message_type.default_values(), never) == (wire, [])


@pytest.mark.parametrize("cls", cases())
def test_cut_and_lengthened_messages_are_refused(cls: Any) -> None:
    message_type = message_type_from_definition(cls._type, cls._full_text)
    rng = random.Random(zlib.crc32(cls._type.encode()))
    wire = oracle.serialize(oracle.fill(cls(), rng, get_message_class))
    cuts = range(len(wire)) if len(wire) <= MAX_CUTS else sorted(rng.sample(range(len(wire)), MAX_CUTS))
    for broken in [wire[:cut] for cut in cuts] + [wire + b"\0", wire + b"\xff" * 9]:
        for convert in (message_type.to_values, message_type.to_json, message_type.to_cbor):
            with pytest.raises(WireError, match=message_type.name):
                convert(broken)


@pytest.mark.parametrize("cls", cases())
def test_corrupt_messages_are_refused_or_read_for_what_they_are(cls: Any) -> None:
    message_type = message_type_from_definition(cls._type, cls._full_text)
    rng = random.Random(zlib.crc32(cls._type.encode()))
    wire = oracle.serialize(oracle.fill(cls(), rng, get_message_class))
    for broken in oracle.corruptions(wire, rng, 15):
        oracle.check_broken(message_type, broken)
