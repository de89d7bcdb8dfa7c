# SPDX-License-Identifier: BSD-3-Clause
"""Dictionaries ↔ instances of generated message classes, for code that imports these functions.

The bridge itself converts wire bytes and never makes instances. The old functions go through the wire format too,
so that both take and refuse the same values.
"""

from __future__ import annotations

import io
import time
from typing import Any, Dict, Mapping, Tuple

from ..codec.definition import Plan, is_header_plan
from ..codec.message_type import MessageType, message_type_from_definition
from .exceptions import (
    FieldTypeMismatchException,
    InvalidMessageException,
    NonexistentFieldException,
)

__all__ = [
    "FieldTypeMismatchException",
    "InvalidMessageException",
    "NonexistentFieldException",
    "extract_values",
    "populate_instance",
]


def extract_values(inst: Any) -> Dict[str, Any]:
    """The fields of a message instance as a dictionary, nested messages as dictionaries in it.

    Raises InvalidMessageException when `inst` is not a message.
    """
    message_type = _message_type(inst)
    buffer = io.BytesIO()
    inst.serialize(buffer)
    return message_type.to_values(buffer.getvalue())


def populate_instance(msg: Mapping[str, Any], inst: Any) -> Any:
    """Set the fields of a message instance that a dictionary has, and return the instance.

    Fields that are not in the dictionary stay as they are, but the stamp of a header that is becomes the current time.
    Raises FieldTypeMismatchException, NonexistentFieldException, or InvalidMessageException when `inst` is not a
    message.
    """
    message_type = _message_type(inst)
    values = _merged(message_type.plan, extract_values(inst), msg)
    wire, _ = message_type.from_values(values, _ros_now)
    return inst.deserialize(wire)


def _merged(plan: Plan, current: Dict[str, Any], given: Any) -> Any:
    """The current values of a message, with those given in their place."""
    if not isinstance(given, Mapping):
        return given  # from_values says what is wrong with it
    merged: Dict[str, Any] = {**current, **given}
    if is_header_plan(plan) and "stamp" not in given:
        del merged["stamp"]
    for field in plan.fields:
        if field.name in given and field.message is not None and not field.is_array:
            merged[field.name] = _merged(field.message, current[field.name], given[field.name])
    return merged


def _message_type(inst: Any) -> MessageType:
    definition = getattr(inst, "_full_text", None)
    if not isinstance(definition, str):
        raise InvalidMessageException(inst)
    return message_type_from_definition(inst._type, definition)


def _ros_now() -> Tuple[int, int]:
    """ROS time as (secs, nsecs); the wall clock outside a node."""
    import rospy  # here, because the codecs work without ROS

    if rospy.core.is_initialized():
        stamp = rospy.get_rostime()
        return stamp.secs, stamp.nsecs
    now_ns = time.time_ns()
    return now_ns // 10**9, now_ns % 10**9
