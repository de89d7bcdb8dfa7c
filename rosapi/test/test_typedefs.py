# SPDX-License-Identifier: BSD-3-Clause
"""Types described field by field: a few by hand, every installed one against what genmsg reads from it."""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path
from typing import Any, Dict, Iterator, List

import genmsg
import genpy
import pytest
import std_msgs

from rosapi.typedefs import (
    PRIMITIVES,
    TypeDef,
    definition_text,
    message_typedefs,
    request_typedefs,
    response_typedefs,
)
from rosbridge_library.internal.exceptions import TypeLoadError

TIME = TypeDef("time", ["secs", "nsecs"], ["int32", "int32"], [-1, -1], ["0", "0"], [], [])
HEADER = TypeDef(
    "std_msgs/Header",
    ["seq", "stamp", "frame_id"],
    ["uint32", "time", "string"],
    [-1, -1, -1],
    ["0", "{}", ""],
    [],
    [],
)


def _installed(kind: str) -> Iterator[str]:
    """All message ("msg") or service ("srv") types of Debian's packages, which lie beside std_msgs."""
    for module in pkgutil.iter_modules([str(Path(std_msgs.__file__).parents[1])]):
        if not module.name.endswith(("_msgs", "_srvs")) and module.name != "roscpp":
            continue
        try:
            types = importlib.import_module(f"{module.name}.{kind}")
        except ModuleNotFoundError:
            continue
        for name, value in vars(types).items():
            is_part = kind == "srv" and name.endswith(("Request", "Response"))
            if isinstance(value, type) and not is_part and getattr(value, "_type", "") == f"{module.name}/{name}":
                yield value._type


INSTALLED_MESSAGES = sorted(_installed("msg"))
INSTALLED_SERVICES = sorted(_installed("srv"))


def test_a_type_comes_first_then_what_it_contains_once_each() -> None:
    typedefs = message_typedefs("geometry_msgs/TwistStamped")

    assert [typedef.type for typedef in typedefs] == [
        "geometry_msgs/TwistStamped",
        "std_msgs/Header",
        "time",
        "geometry_msgs/Twist",
        "geometry_msgs/Vector3",
    ]
    assert typedefs[1:3] == [HEADER, TIME]
    assert typedefs[3] == TypeDef(
        "geometry_msgs/Twist",
        ["linear", "angular"],
        ["geometry_msgs/Vector3", "geometry_msgs/Vector3"],
        [-1, -1],
        ["{}", "{}"],
        [],
        [],
    )
    assert typedefs[4].examples == ["0.0", "0.0", "0.0"]


def test_arrays_tell_their_element_type_and_length() -> None:
    odometry = {typedef.type: typedef for typedef in message_typedefs("nav_msgs/Odometry")}
    covariance = odometry["geometry_msgs/PoseWithCovariance"]
    assert (covariance.fieldtypes, covariance.fieldarraylen, covariance.examples) == (
        ["geometry_msgs/Pose", "float64"],
        [-1, 36],
        ["{}", "[]"],
    )

    image = message_typedefs("sensor_msgs/Image")[0]
    assert image.fieldtypes == ["std_msgs/Header", "uint32", "uint32", "string", "uint8", "uint32", "uint8"]
    assert image.fieldarraylen == [-1, -1, -1, -1, -1, -1, 0]
    assert image.examples == ["{}", "0", "0", "", "0", "0", "[]"]

    tf = message_typedefs("tf2_msgs/TFMessage")
    assert (tf[0].fieldtypes, tf[0].fieldarraylen) == (["geometry_msgs/TransformStamped"], [0])
    assert len(tf) == 7  # the elements' types too


def test_booleans_and_durations() -> None:
    assert message_typedefs("std_msgs/Bool") == [TypeDef("std_msgs/Bool", ["data"], ["bool"], [-1], ["False"], [], [])]
    assert message_typedefs("std_msgs/Duration") == [
        TypeDef("std_msgs/Duration", ["data"], ["duration"], [-1], ["{}"], [], []),
        TIME._replace(type="duration"),
    ]


def test_a_type_without_fields() -> None:
    assert message_typedefs("std_msgs/Empty") == [TypeDef("std_msgs/Empty", [], [], [], [], [], [])]


def test_constants_in_the_order_of_the_definition() -> None:
    (marker, *_) = message_typedefs("visualization_msgs/Marker")
    assert marker.constnames[:4] == ["ARROW", "CUBE", "SPHERE", "CYLINDER"]
    assert marker.constvalues[:4] == ["0", "1", "2", "3"]
    (log, *_) = message_typedefs("rosgraph_msgs/Log")
    assert dict(zip(log.constnames, log.constvalues)) == {
        "DEBUG": "1",
        "INFO": "2",
        "WARN": "4",
        "ERROR": "8",
        "FATAL": "16",
    }


def test_requests_and_responses_of_services() -> None:
    assert [typedef.type for typedef in request_typedefs("nav_msgs/GetMap")] == ["nav_msgs/GetMapRequest"]
    assert [typedef.type for typedef in response_typedefs("nav_msgs/GetMap")] == [
        "nav_msgs/GetMapResponse",
        "nav_msgs/OccupancyGrid",
        "std_msgs/Header",
        "time",
        "nav_msgs/MapMetaData",
        "geometry_msgs/Pose",
        "geometry_msgs/Point",
        "geometry_msgs/Quaternion",
    ]
    assert request_typedefs("std_srvs/SetBool")[0].fieldtypes == ["bool"]
    assert response_typedefs("std_srvs/SetBool")[0].fieldnames == ["success", "message"]


@pytest.mark.parametrize("describe", [message_typedefs, request_typedefs, response_typedefs, definition_text])
@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("not_installed_msgs/Thing", "not_installed_msgs"),
        ("std_msgs/NoSuchType", "NoSuchType|std_msgs.srv"),
        ("", "package/Type"),
        ("std_msgs", "package/Type"),
        ("../../etc/passwd", "package/Type"),
        ("os/path", "os"),
    ],
)
def test_what_is_not_installed_fails_with_the_reason(describe: Any, name: str, reason: str) -> None:
    with pytest.raises(TypeLoadError, match=reason):
        describe(name)


def _definition_of(message_class: Any) -> genmsg.MsgSpec:
    """What genmsg reads from the text of the definition, above those of what it contains."""
    own, *_ = message_class._full_text.split("=" * 80)
    return genmsg.msg_loader.load_msg_from_string(genmsg.MsgContext.create_default(), own, message_class._type)


@pytest.mark.parametrize("name", INSTALLED_MESSAGES)
def test_every_installed_message_type_agrees_with_its_definition(name: str) -> None:
    message_class = genpy.message.get_message_class(name)
    typedefs = message_typedefs(name)
    first = typedefs[0]
    spec = _definition_of(message_class)

    parsed = [genmsg.msgs.parse_type(field.type) for field in spec.parsed_fields()]
    assert first.type == name
    assert first.fieldnames == list(spec.names)
    assert first.fieldtypes == [element for element, _, _ in parsed]
    assert first.fieldarraylen == [(length or 0) if is_array else -1 for _, is_array, length in parsed]
    assert first.constnames == [constant.name for constant in spec.constants]
    assert first.constvalues == [str(constant.val) for constant in spec.constants]
    for element, length, example in zip(first.fieldtypes, first.fieldarraylen, first.examples):
        assert example == _expected_example(element, length)

    assert len({typedef.type for typedef in typedefs}) == len(typedefs)
    described = {typedef.type for typedef in typedefs}
    mentioned = {name} | {kind for typedef in typedefs for kind in typedef.fieldtypes} - set(PRIMITIVES)
    assert described == mentioned
    assert definition_text(name) == message_class._full_text


def _expected_example(element: str, length: int) -> str:
    if length != -1:
        return "[]"
    examples: Dict[str, str] = {"string": "", "bool": "False", "float32": "0.0", "float64": "0.0"}
    if element in PRIMITIVES and element not in examples:
        return "0"
    return examples.get(element, "{}")


@pytest.mark.parametrize("name", INSTALLED_SERVICES)
def test_every_installed_service_type_is_described(name: str) -> None:
    service_class = genpy.message.get_service_class(name)
    for describe, part in ((request_typedefs, "_request_class"), (response_typedefs, "_response_class")):
        first = describe(name)[0]
        message_class = getattr(service_class, part)
        assert first.type == message_class._type
        assert first.fieldnames == message_class.__slots__


def test_enough_types_are_installed_for_these_tests_to_mean_something() -> None:
    names: List[str] = INSTALLED_MESSAGES
    assert len(names) > 80
    assert len(INSTALLED_SERVICES) >= 5
