# SPDX-License-Identifier: BSD-3-Clause
"""Conversions that walk the plan for each message: right, but slow. The compiled ones replace them."""

from __future__ import annotations

import struct
from typing import Any, Callable, Dict, List, Mapping, Tuple

import numpy as np
import pybase64

from ..internal.exceptions import FieldTypeMismatchException, NonexistentFieldException, WireError
from .definition import HEADER_TYPE, NUMBER_CODES, TIME_CODES, Field, Plan
from .documents import encode_cbor, encode_json


def to_values(plan: Plan, wire: Any) -> Dict[str, Any]:
    try:
        values, end = _read(plan, bytes(wire), 0)
    except struct.error as error:
        raise WireError("%s: truncated" % plan.name) from error
    if end != len(wire):
        raise WireError("%s: %d bytes too many" % (plan.name, len(wire) - end))
    return values


def to_json(plan: Plan, wire: Any) -> bytes:
    return encode_json(to_values(plan, wire))


def to_cbor(plan: Plan, wire: Any) -> bytes:
    return encode_cbor(_typed(plan, to_values(plan, wire)))


def _typed(plan: Plan, values: Dict[str, Any]) -> Dict[str, Any]:
    result = {}
    for field in plan.fields:
        value = values[field.name]
        if field.message is not None:
            message = field.message
            value = [_typed(message, v) for v in value] if field.is_array else _typed(message, value)
        elif field.is_array and not field.is_binary and field.type in NUMBER_CODES and field.type != "bool":
            value = np.array(value, "<" + NUMBER_CODES[field.type])
        result[field.name] = value
    return result


def _read(plan: Plan, wire: bytes, at: int) -> Tuple[Dict[str, Any], int]:
    values: Dict[str, Any] = {}
    for field in plan.fields:
        values[field.name], at = _read_field(field, wire, at)
    return values, at


def _read_field(field: Field, wire: bytes, at: int) -> Tuple[Any, int]:
    if not field.is_array:
        return _read_element(field, wire, at)
    count = field.length
    if count is None:
        (count,), at = struct.unpack_from("<I", wire, at), at + 4
    if count * max(field.min_element_size, 1) > len(wire) - at:
        raise WireError("truncated")
    if field.is_binary:
        return wire[at : at + count], at + count
    items = []
    for _ in range(count):
        item, at = _read_element(field, wire, at)
        items.append(item)
    return items, at


def _read_element(field: Field, wire: bytes, at: int) -> Tuple[Any, int]:
    if field.message is not None:
        return _read(field.message, wire, at)
    if field.type in TIME_CODES:
        secs, nsecs = struct.unpack_from("<2" + TIME_CODES[field.type], wire, at)
        return {"secs": secs, "nsecs": nsecs}, at + 8
    if field.type == "string":
        (length,) = struct.unpack_from("<I", wire, at)
        if length > len(wire) - at - 4:
            raise WireError("truncated")
        return str(wire[at + 4 : at + 4 + length], "utf-8", "replace"), at + 4 + length
    code = "<" + NUMBER_CODES[field.type]
    return struct.unpack_from(code, wire, at)[0], at + struct.calcsize(code)


def from_values(plan: Plan, values: Any, now: Callable[[], Tuple[int, int]]) -> Tuple[bytes, List[str]]:
    missing: List[str] = []
    return _write(plan, plan.name, values, now, "", missing), missing


def _write(plan: Plan, root: str, values: Any, now: Any, path: str, missing: List[str]) -> bytes:
    if not isinstance(values, Mapping):
        raise FieldTypeMismatchException(root, path, plan.name, type(values).__name__)
    names = [field.name for field in plan.fields]
    for name in values:
        if name not in names:
            raise NonexistentFieldException(root, path + "." + str(name) if path else str(name))
    out = []
    for field in plan.fields:
        where = path + "." + field.name if path else field.name
        if field.name in values:
            out.append(_write_field(field, root, values[field.name], now, where, missing))
        elif field.type == HEADER_TYPE and not field.is_array and field.message is not None:
            out.append(_write(field.message, root, {"frame_id": ""}, now, where, missing))
        elif plan.name == HEADER_TYPE and field.name == "stamp":
            out.append(struct.pack("<2I", *now()))
        else:
            if not (plan.name == HEADER_TYPE and field.name == "seq"):
                missing.append(where)
            out.append(_write_field(field, root, _default(field), now, where, []))
    return b"".join(out)


def _write_field(field: Field, root: str, value: Any, now: Any, path: str, missing: List[str]) -> bytes:
    if not field.is_array:
        return _write_element(field, root, value, now, path, missing)
    if field.is_binary and isinstance(value, str):
        value = pybase64.b64decode(value)
    if not isinstance(value, (list, tuple, bytes, bytearray, memoryview, np.ndarray)):
        raise FieldTypeMismatchException(root, path, field.declared_type, type(value).__name__)
    if field.length is not None and len(value) != field.length:
        raise FieldTypeMismatchException(root, path, field.declared_type, "%d elements" % len(value))
    items = [
        _write_element(field, root, item, now, "%s[%d]" % (path, index), missing) for index, item in enumerate(value)
    ]
    return (b"" if field.length is not None else struct.pack("<I", len(items))) + b"".join(items)


def _write_element(field: Field, root: str, value: Any, now: Any, path: str, missing: List[str]) -> bytes:
    if field.message is not None:
        return _write(field.message, root, value, now, path, missing)
    mismatch = FieldTypeMismatchException(root, path, field.type, type(value).__name__)
    if field.type in TIME_CODES:
        if value == "now" and field.type == "time":
            return struct.pack("<2I", *now())
        if not isinstance(value, Mapping):
            raise mismatch
        try:
            return struct.pack("<2" + TIME_CODES[field.type], value.get("secs", 0), value.get("nsecs", 0))
        except struct.error as error:
            raise mismatch from error
    if field.type == "string":
        if not isinstance(value, str):
            raise mismatch
        raw = value.encode()
        return struct.pack("<I", len(raw)) + raw
    code = NUMBER_CODES[field.type]
    if isinstance(value, bool) != (code == "?"):
        raise mismatch
    if code in "fd" and value is None:
        value = float("nan")
    if code not in "fd?" and isinstance(value, float) and value.is_integer():
        value = int(value)
    try:
        return struct.pack("<" + code, value)
    except (struct.error, OverflowError) as error:
        raise mismatch from error


def default_values(plan: Plan) -> Dict[str, Any]:
    return {field.name: _default(field) for field in plan.fields}


def _default(field: Field) -> Any:
    if not field.is_array:
        return _default_element(field)
    if field.is_binary:
        return bytes(field.length or 0)
    return [_default_element(field) for _ in range(field.length or 0)]


def _default_element(field: Field) -> Any:
    if field.message is not None:
        return default_values(field.message)
    if field.type in TIME_CODES:
        return {"secs": 0, "nsecs": 0}
    return {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}.get(field.type, 0)
