# SPDX-License-Identifier: BSD-3-Clause
"""Parameter values between the protocol's JSON and the parameter server's XML-RPC: pure functions.

JSON has one kind of number and no binary data, so the protocol has a `type` beside the value: float64, float64_array
or byte_array (base64). It has no value for "not set": that is an entry without one.
"""

from __future__ import annotations

import base64
import binascii
import math
from typing import Any, Callable, Dict, Iterator, List, Mapping, Optional, Tuple

from rosbridge_library.internal.exceptions import InvalidArgumentException
from rosbridge_library.parameter_values import check, jsonable

ABSENT: Any = object()
"""The value of a parameter that is not set."""


def entry(name: str, value: Any) -> Dict[str, Any]:
    """The entry of a parameterValues message for a value of the parameter server, or for ABSENT."""
    if value is ABSENT:
        return {"name": name}
    told = {"name": name, "value": jsonable(value)}
    type_ = _type(value)
    return told if type_ is None else {**told, "type": type_}


def _type(value: Any) -> Optional[str]:
    if isinstance(value, bytes):
        return "byte_array"
    if isinstance(value, float) and math.isfinite(value):
        return "float64"
    # A list that has integers too keeps its kinds as plain numbers.
    if isinstance(value, list) and value and all(isinstance(each, float) and math.isfinite(each) for each in value):
        return "float64_array"
    return None


def from_entry(parameter: Mapping[str, Any]) -> Any:
    """The value for the parameter server of an entry of setParameters, or ABSENT to unset it.

    Raises InvalidArgumentException and ParameterError.
    """
    value, type_ = parameter.get("value"), parameter.get("type")
    if value is None:
        return ABSENT
    if type_ is None:
        check(value)
        _check_keys(value)
        return value
    convert = _TYPES.get(type_) if isinstance(type_, str) else None
    if convert is None:
        raise InvalidArgumentException(f"the field 'type' must be one of {', '.join(_TYPES)}")
    return convert(value)


def _bytes(value: Any) -> bytes:
    try:
        return base64.b64decode(value, validate=True)
    except (TypeError, ValueError, binascii.Error) as error:
        raise InvalidArgumentException(f"the value of a byte_array must be base64: {error}") from error


def _float(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InvalidArgumentException(f"a float64 must be a number, not {type(value).__name__}")
    try:
        return float(value)
    except OverflowError as error:
        raise InvalidArgumentException("a float64 can't be so large") from error


def _floats(value: Any) -> List[float]:
    if not isinstance(value, list):
        raise InvalidArgumentException(f"a float64_array must be a list, not {type(value).__name__}")
    return [_float(each) for each in value]


_TYPES: Dict[str, Callable[[Any], Any]] = {"byte_array": _bytes, "float64": _float, "float64_array": _floats}


def _check_keys(value: Any) -> None:
    if isinstance(value, dict):
        if not all(value) or any("/" in key for key in value):
            raise InvalidArgumentException("a map's keys are names of parameters: not empty, and without slashes")
        for each in value.values():
            _check_keys(each)
    elif isinstance(value, list):
        for each in value:
            _check_keys(each)


def leaves(name: str, value: Any) -> Iterator[Tuple[str, Any]]:
    """The parameters in a value, as (name, value): itself, or all in it when it is a namespace."""
    if not isinstance(value, dict):
        yield name, value
        return
    for key, each in value.items():
        yield from leaves(f"{name.rstrip('/')}/{key}", each)


def visible(name: str, value: Any, sees: Callable[[str], bool]) -> Any:
    """What may be seen of a value: without the parameters in it that may not, or ABSENT when nothing is left."""
    if not isinstance(value, dict):
        return value if sees(name) else ABSENT
    seen = {key: visible(f"{name.rstrip('/')}/{key}", each, sees) for key, each in value.items()}
    left = {key: each for key, each in seen.items() if each is not ABSENT}
    return left if left or (not value and sees(name)) else ABSENT
