# SPDX-License-Identifier: BSD-3-Clause
"""Codecs: message types, and the functions compiled from them that convert between ROS's wire format, JSON, CBOR
and Python values.

Everything here is pure: no ROS node, no master, no sockets. A type comes from an installed package or from the
definition in a publisher's connection header:

    twist = get_message_type("geometry_msgs/Twist")
    text = twist.to_json(wire)
    wire, left_out = twist.from_values({"linear": {"x": 1.0}}, now)
"""

from __future__ import annotations

from ..internal.exceptions import (
    DecodeError,
    DefinitionError,
    FieldTypeMismatchException,
    NonexistentFieldException,
    ValuesError,
    WireError,
)
from .definition import Constant, Field, Plan
from .documents import decode_cbor, decode_json, encode_cbor, encode_json
from .message_type import (
    MessageType,
    ServiceType,
    get_message_type,
    get_service_type,
    message_type_from_definition,
)

__all__ = [
    "Constant",
    "DecodeError",
    "DefinitionError",
    "Field",
    "FieldTypeMismatchException",
    "MessageType",
    "NonexistentFieldException",
    "Plan",
    "ServiceType",
    "ValuesError",
    "WireError",
    "decode_cbor",
    "decode_json",
    "encode_cbor",
    "encode_json",
    "get_message_type",
    "get_service_type",
    "message_type_from_definition",
]
