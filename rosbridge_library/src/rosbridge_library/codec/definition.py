# SPDX-License-Identifier: BSD-3-Clause
"""Message definition text → the plan of a message type.

The text is the full one, as it stands in a connection header or in `_full_text` of a generated class: the
definition itself, then those of all the types it contains, each after a line of 80 `=` and a line
`MSG: package/Type`. The plan is what every compiled codec function is derived from. Only text is needed here: a
type whose package is not installed works like any other.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from typing import Any, Dict, List, Mapping, Optional, Sequence, Set, Tuple

from ..internal.exceptions import DefinitionError

SEPARATOR = "=" * 80
HEADER_TYPE = "std_msgs/Header"

# Builtin element types of fixed size: their code in the struct module.
NUMBER_CODES: Mapping[str, str] = {
    "bool": "?",
    "byte": "b",
    "char": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
# time and duration are two integers each; their struct codes.
TIME_CODES: Mapping[str, str] = {"time": "I", "duration": "i"}
BUILTIN_TYPES = frozenset(NUMBER_CODES) | frozenset(TIME_CODES) | {"string"}
# Arrays of these are binary data: base64 in JSON, byte strings in CBOR, bytes in Python.
BINARY_TYPES = frozenset({"uint8", "char"})
CODE_SIZES: Mapping[str, int] = {"?": 1, "b": 1, "B": 1, "h": 2, "H": 2, "i": 4, "I": 4, "q": 8, "Q": 8, "f": 4, "d": 8}
# Struct code → NumPy type of the same bytes; bool as the byte it is, since any value but 0 is true.
NUMPY_TYPES: Mapping[str, str] = {
    "?": "u1", "b": "i1", "B": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4", "q": "<i8", "Q": "<u8",
    "f": "<f4", "d": "<f8",
}  # fmt: skip
INTEGER_RANGES: Mapping[str, Tuple[int, int]] = {
    "b": (-(2**7), 2**7 - 1),
    "B": (0, 2**8 - 1),
    "h": (-(2**15), 2**15 - 1),
    "H": (0, 2**16 - 1),
    "i": (-(2**31), 2**31 - 1),
    "I": (0, 2**32 - 1),
    "q": (-(2**63), 2**63 - 1),
    "Q": (0, 2**64 - 1),
}

# Bounds on hostile definitions: a few lines of text can nest to billions of fields. Real types stay far below.
MAX_LEAVES = 20_000
MAX_FIXED_BYTES = 2**26
MAX_FIXED_VALUES = 2**20
MAX_NESTING = 16

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*\Z")
_TYPE = re.compile(r"([A-Za-z][\w/]*)(\[(\d*)\])?\Z", re.ASCII)


@dataclass(frozen=True)
class Constant:
    """A constant of a message type; `text` is its value as the definition writes it."""

    type: str
    name: str
    text: str
    value: Any


@dataclass(frozen=True)
class Field:
    """A field of a message type.

    `type` is the element type, fully qualified ("float64", "std_msgs/Header"). `length` is None for an array of
    variable length and for a scalar. `message` is the plan of a nested message type.
    """

    name: str
    type: str
    is_array: bool = False
    length: Optional[int] = None
    message: Optional[Plan] = None

    @property
    def is_binary(self) -> bool:
        """Whether this is an array of uint8 or char, which is binary data."""
        return self.is_array and self.type in BINARY_TYPES

    @property
    def declared_type(self) -> str:
        """The type as a definition writes it: "float64[36]"."""
        if not self.is_array:
            return self.type
        return "{}[{}]".format(self.type, "" if self.length is None else self.length)

    @property
    def element_size(self) -> Optional[int]:
        """Size of an element on the wire in bytes; None when it varies."""
        if self.message is not None:
            return self.message.size
        if self.type in TIME_CODES:
            return 8
        return None if self.type == "string" else CODE_SIZES[NUMBER_CODES[self.type]]

    @property
    def min_element_size(self) -> int:
        """The fewest bytes that an element takes on the wire."""
        if self.message is not None:
            return self.message.min_size
        return 4 if self.type == "string" else self.element_size or 0

    @property
    def size(self) -> Optional[int]:
        """Size on the wire in bytes; None when it varies."""
        size = self.element_size
        if not self.is_array:
            return size
        if self.length == 0:
            return 0
        return None if self.length is None or size is None else self.length * size

    @property
    def min_size(self) -> int:
        """The fewest bytes that the field takes on the wire."""
        if not self.is_array:
            return self.min_element_size
        return 4 if self.length is None else self.length * self.min_element_size


@dataclass(frozen=True)
class Plan:
    """The parsed definition of a message type, nested types included."""

    name: str
    fields: Tuple[Field, ...]
    constants: Tuple[Constant, ...]
    md5text: str
    md5sum: str
    size: Optional[int]
    min_size: int
    leaves: int  # fields of nested messages included, arrays counted once
    values: int  # in a message whose arrays of variable length are empty
    nesting: int

    @property
    def has_header(self) -> bool:
        """Whether the first field is `std_msgs/Header header`."""
        return bool(self.fields) and is_header_field(self.fields[0]) and self.fields[0].name == "header"


def is_header_plan(plan: Plan) -> bool:
    """Whether a message type is std_msgs/Header, of the well-known layout."""
    layout = [(field.name, field.declared_type) for field in plan.fields]
    return plan.name == HEADER_TYPE and layout == [("seq", "uint32"), ("stamp", "time"), ("frame_id", "string")]


def is_header_field(field: Field) -> bool:
    """Whether a field is one std_msgs/Header."""
    return not field.is_array and field.message is not None and is_header_plan(field.message)


def parse_definition(name: str, definition: str) -> Plan:
    """Parse the full definition text of message type `name` ("package/Type").

    Raises DefinitionError when the text is malformed, lacks a nested type, nests a type in itself, or is bigger
    than any real one.
    """
    sections = _split(name, definition)
    return _Parser(sections).plan(name)


def _split(name: str, definition: str) -> Dict[str, str]:
    """The text of each type in a full definition, by type name."""
    sections: Dict[str, str] = {}
    current, lines = name, []  # type: Tuple[str, List[str]]
    expect_name = False
    for line in definition.replace("\r\n", "\n").split("\n"):
        if expect_name:
            if not line.startswith("MSG: "):
                raise DefinitionError(f"Definition of {name}: expected a line MSG: package/Type, not {line[:80]!r}")
            current, lines = _canonical(line[5:].strip()), []
            expect_name = False
        elif line.startswith(SEPARATOR) and not line.strip("= "):
            sections.setdefault(current, "\n".join(lines))
            expect_name = True
        else:
            lines.append(line)
    if not expect_name:
        sections.setdefault(current, "\n".join(lines))
    return sections


def _canonical(type_name: str) -> str:
    # REP 100: Header lived in roslib once.
    return HEADER_TYPE if type_name == "roslib/Header" else type_name


class _Parser:
    """Parses the sections of one definition, each type once."""

    def __init__(self, sections: Mapping[str, str]) -> None:
        self._sections = sections
        self._plans: Dict[str, Plan] = {}
        self._open: Set[str] = set()

    def plan(self, name: str) -> Plan:
        known = self._plans.get(name)
        if known is not None:
            return known
        if name in self._open:
            raise DefinitionError(f"Message type {name} contains itself")
        if name not in self._sections:
            raise DefinitionError(f"The definition of message type {name} is missing")
        if len(self._open) > MAX_NESTING:
            raise DefinitionError(f"Message type {name} is nested too deeply")
        self._open.add(name)
        fields: List[Field] = []
        constants: List[Constant] = []
        for line in self._sections[name].split("\n"):
            code = line.split("#", 1)[0].strip()
            if not code:
                continue
            if "=" in code:
                constants.append(_parse_constant(name, line, code))
            else:
                fields.append(self._field(name, code))
        self._open.remove(name)
        plan = _make_plan(name, fields, constants)
        self._plans[name] = plan
        return plan

    def _field(self, owner: str, code: str) -> Field:
        words = code.split()
        match = _TYPE.match(words[0])
        if len(words) != 2 or match is None or _NAME.match(words[1]) is None:
            raise DefinitionError(f"Message type {owner}: not a field: {code[:80]!r}")
        base, brackets, digits = match.groups()
        is_array = brackets is not None
        length = int(digits) if digits and len(digits) < 10 else None
        if digits and length is None:
            raise DefinitionError(f"Message type {owner}: array too long: {code[:80]!r}")
        if base in BUILTIN_TYPES:
            return Field(words[1], base, is_array, length)
        message = self.plan(self._resolve(owner, base))
        return Field(words[1], message.name, is_array, length, message)

    def _resolve(self, owner: str, base: str) -> str:
        if "/" in base:
            return _canonical(base)
        local = "{}/{}".format(owner.split("/", 1)[0], base)
        if base == "Header" and (local == HEADER_TYPE or local not in self._sections):
            return HEADER_TYPE
        return local


def _parse_constant(owner: str, line: str, code: str) -> Constant:
    type_name = code.split()[0].split("=")[0]
    # A string constant is everything right of the "=", "#" included: it can have no comment.
    left, text = (line if type_name == "string" else code).split("=", 1)
    words = left.split()
    text = text.strip()
    if len(words) != 2 or _NAME.match(words[1]) is None:
        raise DefinitionError(f"Message type {owner}: not a constant: {code[:80]!r}")
    try:
        value = _constant_value(type_name, text)
    except ValueError as error:
        raise DefinitionError(f"Message type {owner}: constant {words[1]}: {error}") from error
    return Constant(type_name, words[1], text, value)


def _constant_value(type_name: str, text: str) -> Any:
    if type_name == "string":
        return text
    if type_name in ("float32", "float64"):
        return float(text)
    if type_name == "bool":
        return text.lower() == "true" if text.lower() in ("true", "false") else bool(int(text))
    code = NUMBER_CODES.get(type_name)
    if code is None:
        raise ValueError(f"{type_name} is not the type of a constant")
    value = int(text)
    low, high = INTEGER_RANGES[code]
    if not low <= value <= high:
        raise ValueError(f"{value} is out of the range of {type_name}")
    return value


def _make_plan(name: str, fields: Sequence[Field], constants: Sequence[Constant]) -> Plan:
    names = [field.name for field in fields]
    if len(set(names)) != len(names):
        raise DefinitionError(f"Message type {name}: two fields of one name")
    sizes = [field.size for field in fields]
    size: Optional[int] = 0
    for part in sizes:
        size = None if size is None or part is None else size + part
    leaves = sum(1 if field.message is None else field.message.leaves for field in fields)
    nesting = 1 + max((field.message.nesting for field in fields if field.message is not None), default=0)
    min_size = sum(field.min_size for field in fields)
    values = sum(_values(field) for field in fields)
    if leaves > MAX_LEAVES or nesting > MAX_NESTING or min_size > MAX_FIXED_BYTES or values > MAX_FIXED_VALUES:
        raise DefinitionError(f"Message type {name} is too big")
    text = md5_text(fields, constants)
    md5sum = hashlib.md5(text.encode("utf-8", "surrogateescape")).hexdigest()
    return Plan(name, tuple(fields), tuple(constants), text, md5sum, size, min_size, leaves, values, nesting)


def _values(field: Field) -> int:
    if field.is_binary or (field.is_array and field.length is None):
        return 1
    each = 1 if field.message is None else 1 + field.message.values
    return each if field.length is None else 1 + field.length * each


def md5_text(fields: Sequence[Field], constants: Sequence[Constant]) -> str:
    """The text that ROS hashes to identify a message type: constants first, nested types as their own hash."""
    lines = [f"{constant.type} {constant.name}={constant.text}" for constant in constants]
    for field in fields:
        lines.append(f"{field.message.md5sum if field.message else field.declared_type} {field.name}")
    return "\n".join(lines).strip()


def service_md5sum(request: Plan, response: Plan) -> str:
    """The hash that ROS identifies a service type by."""
    return hashlib.md5((request.md5text + response.md5text).encode("utf-8", "surrogateescape")).hexdigest()
