# SPDX-License-Identifier: BSD-3-Clause
"""Message and service types by name or by definition, each compiled once and shared.

A type comes from the installed packages, or from the definition text that a publisher sends in its connection
header. The functions that convert it are compiled when first used.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import Any, Callable, Dict, List, Mapping, Optional, Sequence, Tuple, Union

from ..internal import ros_loader
from ..internal.exceptions import DefinitionError
from .cbor_writer import compile_cbor_pieces, compile_cbor_writer
from .conformance import Now, default_values
from .definition import Constant, Field, Plan, parse_definition, service_md5sum
from .reader import compile_json_pieces, compile_json_reader, compile_values_reader
from .wire_writer import compile_wire_writer

Wire = Union[bytes, bytearray, memoryview]

Piece = Union[bytes, bytearray, memoryview]
Converter = Callable[[Mapping[str, Any], Now], Tuple[bytes, List[str]]]

# Types known from connection headers. A robot has some hundred; publishers that come up with ever new ones must
# not fill the memory.
MAX_DEFINED_TYPES = 1000


class MessageType:
    """A message type with its compiled conversions; immutable, and shared by everybody who uses the type.

    Wire bytes are bytes, or a memoryview or bytearray, which costs a little more.
    """

    def __init__(self, plan: Plan, definition: str) -> None:
        self.name = plan.name
        self.definition = definition
        self.md5sum = plan.md5sum
        self.has_header = plan.has_header
        self.fields: Sequence[Field] = plan.fields
        self.constants: Sequence[Constant] = plan.constants
        self.plan = plan

    def __repr__(self) -> str:
        return f"MessageType({self.name!r}, md5sum={self.md5sum!r})"

    # Each conversion is compiled by its first call, and then takes the place of its method in the instance. That two
    # threads may both do so does no harm.

    def to_json(self, wire: Wire) -> bytes:
        """The UTF-8 JSON text of a serialized message; raises WireError."""
        convert: Callable[[Wire], bytes] = self._compiled("to_json", compile_json_reader)
        return convert(wire)

    def to_cbor(self, wire: Wire) -> bytes:
        """The CBOR item (a map) of a serialized message; raises WireError."""
        convert: Callable[[Wire], bytes] = self._compiled("to_cbor", compile_cbor_writer)
        return convert(wire)

    def json_pieces(self, wire: Wire) -> Tuple[bytes, ...]:
        """The same text as to_json, in pieces: large binary data has not been copied into place yet."""
        convert: Callable[[Wire], Tuple[bytes, ...]] = self._compiled("json_pieces", compile_json_pieces)
        return convert(wire)

    def cbor_pieces(self, wire: Wire) -> Tuple[Piece, ...]:
        """The same bytes as to_cbor, in pieces; large arrays are views on the wire bytes."""
        convert: Callable[[Wire], Tuple[Piece, ...]] = self._compiled("cbor_pieces", compile_cbor_pieces)
        return convert(wire)

    def check(self, wire: Wire) -> None:
        """Raise WireError for bytes that are no message of this type."""
        self.cbor_pieces(wire)  # walks through all of it, and copies no large array

    def to_values(self, wire: Wire) -> Dict[str, Any]:
        """The fields of a serialized message as Python values; raises WireError.

        Arrays are lists, but those of uint8 and char are bytes; time and duration are {"secs": …, "nsecs": …}.
        """
        convert: Callable[[Wire], Dict[str, Any]] = self._compiled("to_values", compile_values_reader)
        return convert(wire)

    def from_values(self, values: Mapping[str, Any], now: Now) -> Tuple[bytes, List[str]]:
        """Serialize a message from values as they come out of JSON, CBOR or BSON.

        `now` gives ROS time as (secs, nsecs); it is asked for "now", and for a header's stamp that was left out.
        Returns the wire bytes, and the dotted paths of the fields that were left out and got defaults ("poses[].header"
        for any element of poses); a header, its stamp and seq are not among them, since the specification, 3.4.3, has
        them filled. Headers in a message that was left out as a whole get defaults like everything in it.
        Raises FieldTypeMismatchException and NonexistentFieldException.
        """
        convert: Converter = self._compiled("from_values", compile_wire_writer)
        return convert(values, now)

    def _compiled(self, name: str, compile_plan: Callable[[Plan], Any]) -> Any:
        convert = vars(self).get(name)
        if convert is None:
            convert = vars(self)[name] = compile_plan(self.plan)
        return convert

    def default_values(self) -> Dict[str, Any]:
        """The values of a message whose every field has its default."""
        return default_values(self.plan)


class ServiceType:
    """A service type: its request and its response."""

    def __init__(self, name: str, md5sum: str, request: MessageType, response: MessageType) -> None:
        self.name = name
        self.md5sum = md5sum
        self.request = request
        self.response = response

    def __repr__(self) -> str:
        return f"ServiceType({self.name!r}, md5sum={self.md5sum!r})"


_lock = threading.Lock()
_installed_messages: Dict[str, MessageType] = {}
_installed_services: Dict[str, ServiceType] = {}
_defined: OrderedDict[Tuple[str, str], MessageType] = OrderedDict()


def get_message_type(name: str) -> MessageType:
    """The message type `name` of an installed package; raises the TypeLoadErrors of ros_loader."""
    name = ros_loader.canonical_type_name(name, "msg")
    known = _installed_messages.get(name)
    if known is not None:
        return known
    made = _from_class(ros_loader.get_message_class(name))
    with _lock:
        return _installed_messages.setdefault(name, made)


def get_service_type(name: str) -> ServiceType:
    """The service type `name` of an installed package; raises the TypeLoadErrors of ros_loader."""
    name = ros_loader.canonical_type_name(name, "srv")
    known = _installed_services.get(name)
    if known is not None:
        return known
    cls = ros_loader.get_service_class(name)
    request = _from_class(cls._request_class)
    response = _from_class(cls._response_class)
    made = ServiceType(name, service_md5sum(request.plan, response.plan), request, response)
    with _lock:
        return _installed_services.setdefault(name, made)


def message_type_from_definition(name: str, definition: str, md5sum: Optional[str] = None) -> MessageType:
    """The message type that a full definition text describes, as it stands in a connection header.

    Raises DefinitionError when the text is malformed or incomplete, or its hash is not `md5sum` ("*" is any).
    """
    name = ros_loader.canonical_type_name(name, "msg")
    key = (name, definition)
    with _lock:
        known = _defined.get(key)
        if known is not None:
            _defined.move_to_end(key)
    if known is None:
        known = MessageType(parse_definition(name, definition), definition)
        with _lock:
            known = _defined.setdefault(key, known)
            while len(_defined) > MAX_DEFINED_TYPES:
                _defined.popitem(last=False)
    if md5sum not in (None, "*", known.md5sum):
        raise DefinitionError(f"The definition of {name} has the md5sum {known.md5sum}, not {md5sum}")
    return known


def _from_class(cls: Any) -> MessageType:
    name: str = cls._type
    definition: str = cls._full_text
    return MessageType(parse_definition(name, definition), definition)
