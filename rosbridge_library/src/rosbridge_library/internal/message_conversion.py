# SPDX-License-Identifier: BSD-3-Clause
"""Dictionaries ↔ instances of generated message classes, for code that imports these functions.

The bridge itself converts wire bytes and never makes instances. The old functions go through the wire format too,
so that both take and refuse the same values.
"""

from __future__ import annotations

import io
import time
from typing import Any, Dict, Mapping, Tuple

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
    """Fill a message instance from a dictionary, and return it; fields left out get their defaults.

    Raises FieldTypeMismatchException, NonexistentFieldException, or InvalidMessageException when `inst` is not a
    message.
    """
    message_type = _message_type(inst)
    wire, _ = message_type.from_values(msg, _ros_now)
    return inst.deserialize(wire)


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
