# SPDX-License-Identifier: BSD-3-Clause
"""Message and service types described field by field, as clients need to build forms and default messages.

A type becomes a list of `TypeDef`: the type asked for first, then every type it contains, depth first, each
once. `time` and `duration` have definitions of their own. The source is the Python class that genpy generated
for the type.
"""

from __future__ import annotations

from typing import Any, Dict, Iterator, List, NamedTuple, Tuple

from rosbridge_library.internal import ros_loader

SCALAR = -1
VARIABLE = 0

PRIMITIVES = {
    *("bool", "byte", "char", "string"),
    *("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64"),
}


class TypeDef(NamedTuple):
    """One type, in the fields and order of rosapi/TypeDef.msg.

    `fieldtypes` are the types of elements, with their package; `fieldarraylen` is -1 for a scalar, 0 for an
    array of variable length, else the length; `examples` are default values as text, "{}" for a message and
    "[]" for an array.
    """

    type: str
    fieldnames: List[str]
    fieldtypes: List[str]
    fieldarraylen: List[int]
    examples: List[str]
    constnames: List[str]
    constvalues: List[str]


def _time_typedef(name: str) -> TypeDef:
    return TypeDef(name, ["secs", "nsecs"], ["int32", "int32"], [SCALAR, SCALAR], ["0", "0"], [], [])


BUILTIN_STRUCTURES = {name: _time_typedef(name) for name in ("time", "duration")}


def message_typedefs(name: str) -> List[TypeDef]:
    """The message type `name` and all it contains. Raises TypeLoadError, which tells why it isn't known."""
    return _typedefs(ros_loader.get_message_class(name))


def request_typedefs(name: str) -> List[TypeDef]:
    """The request of the service type `name`, likewise."""
    return _typedefs(ros_loader.get_service_class(name)._request_class)


def response_typedefs(name: str) -> List[TypeDef]:
    """The response of the service type `name`, likewise."""
    return _typedefs(ros_loader.get_service_class(name)._response_class)


def definition_text(name: str) -> str:
    """The full text of the message type `name`, as `gendeps --cat` writes it. Raises TypeLoadError."""
    return str(ros_loader.get_message_class(name)._full_text)


def _typedefs(message_class: Any) -> List[TypeDef]:
    found: Dict[str, TypeDef] = {}
    _collect(message_class, found)
    return list(found.values())


def _collect(message_class: Any, found: Dict[str, TypeDef]) -> None:
    typedef = _typedef(message_class)
    found[typedef.type] = typedef
    for field_type in typedef.fieldtypes:
        if field_type in found or field_type in PRIMITIVES:
            continue
        if field_type in BUILTIN_STRUCTURES:
            found[field_type] = BUILTIN_STRUCTURES[field_type]
        else:
            _collect(ros_loader.get_message_class(field_type), found)


def _typedef(message_class: Any) -> TypeDef:
    defaults = message_class()
    fieldnames = list(message_class.__slots__)
    elements = [_element(slot_type) for slot_type in message_class._slot_types]
    examples = [
        _example(element, length, getattr(defaults, fieldname))
        for fieldname, (element, length) in zip(fieldnames, elements)
    ]
    constants = list(_constants(message_class))
    return TypeDef(
        message_class._type,
        fieldnames,
        [element for element, _ in elements],
        [length for _, length in elements],
        examples,
        [name for name, _ in constants],
        [str(value) for _, value in constants],
    )


def _element(slot_type: str) -> Tuple[str, int]:
    """Element type and array length of a field type such as ``float64[36]``."""
    element, bracket, length = slot_type.partition("[")
    if not bracket:
        return element, SCALAR
    return element, int(length[:-1] or VARIABLE)


def _example(element: str, length: int, default: Any) -> str:
    if length != SCALAR:
        return "[]"
    return str(default) if element in PRIMITIVES else "{}"


def _constants(message_class: Any) -> Iterator[Tuple[str, Any]]:
    """The constants in the order of the definition: genpy writes them as plain attributes of the class.

    Its own attributes begin with an underscore, which a ROS name can't; its methods are functions, and the
    fields are slots.
    """
    for name, value in vars(message_class).items():
        if not name.startswith("_") and isinstance(value, (bool, int, float, str)):
            yield name, value
