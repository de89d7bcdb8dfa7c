# SPDX-License-Identifier: BSD-3-Clause
"""Reading the fields of operations. Raises MissingArgumentException or InvalidArgumentException, naming the field."""

from __future__ import annotations

from typing import Any, List, Optional

from rosbridge_library.capability import Operation
from rosbridge_library.internal.exceptions import InvalidArgumentException, MissingArgumentException

_KINDS = {dict: "objects", int: "numbers", str: "strings"}


def entries(message: Operation, field: str, kind: type) -> List[Any]:
    """A field that is a list of things of one kind."""
    value = message.get(field)
    if value is None:
        raise MissingArgumentException(f"the field '{field}' is missing")
    if not isinstance(value, list) or not all(isinstance(each, kind) and not isinstance(each, bool) for each in value):
        raise InvalidArgumentException(f"the field '{field}' must be a list of {_KINDS[kind]}")
    return value


def number(entry: Operation, field: str) -> int:
    """A field that is an id: 0 to 2^32 - 1, since binary messages have 4 bytes for it."""
    value = entry.get(field)
    if value is None:
        raise MissingArgumentException(f"the field '{field}' is missing")
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 1 << 32:
        raise InvalidArgumentException(f"the field '{field}' must be a number from 0 to 4294967295")
    return value


def text(entry: Operation, field: str) -> str:
    """A field that is a string."""
    value = optional_text(entry, field)
    if value is None:
        raise MissingArgumentException(f"the field '{field}' is missing")
    return value


def optional_text(entry: Operation, field: str) -> Optional[str]:
    """A field that is a string, if it is there."""
    value = entry.get(field)
    if value is not None and not isinstance(value, str):
        raise InvalidArgumentException(f"the field '{field}' must be a string")
    return value
