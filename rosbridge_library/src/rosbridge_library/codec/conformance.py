# SPDX-License-Identifier: BSD-3-Clause
"""What a client may give for a field: the rules, and the conversion of what is not already in the usual form.

Generated code tests for the usual form (a float for a float64, a dict for a message …) and calls these functions for
all else: they convert it, give the default of a field that was left out and note its path, or raise Misfit.

Paths are those of the type, with `[]` for each array that the field is in ("poses[].pose.position"): which element it
was, the generated function knows.
"""

from __future__ import annotations

import math
import struct
from typing import Any, Callable, Dict, FrozenSet, List, Mapping, NoReturn, Optional, Sequence, Tuple

import numpy as np
import pybase64

from ..internal.exceptions import FieldTypeMismatchException, NonexistentFieldException, ValuesError
from .definition import CODE_SIZES, INTEGER_RANGES, NUMBER_CODES, NUMPY_TYPES, TIME_CODES, Field, Plan

Now = Callable[[], Tuple[int, int]]
Missing = Dict[str, None]  # the paths of fields left out, in order
MAX_FLOAT32 = 3.4028235677973366e38  # from here on, a double rounds to infinity as a float32


class _LeftOut:
    """The value of a field that was not given."""

    def __repr__(self) -> str:
        return "nothing"


LEFT_OUT = _LeftOut()


class Misfit(Exception):
    """A value that does not conform; `expected` is None for a field that the type does not have."""

    def __init__(self, path: str, suffix: str, expected: Optional[str], found: str) -> None:
        super().__init__(path, suffix, expected, found)
        self.path = path
        self.suffix = suffix
        self.expected = expected
        self.found = found

    def error(self, root: str, indices: Sequence[int]) -> ValuesError:
        """The error for the caller, with the indices of the elements in the path."""
        first, *rest = self.path.split("[]")
        path = first + "".join([f"[{index}]{part}" for index, part in zip(indices, rest)]) + self.suffix
        if self.expected is None:
            return NonexistentFieldException(root, path.lstrip("."))
        return FieldTypeMismatchException(root, path, self.expected, self.found)


def misfit(path: str, expected: str, value: Any, suffix: str = "") -> NoReturn:
    raise Misfit(path, suffix, expected, describe(value))


def describe(value: Any) -> str:
    """A value as an error message shows it: short, whatever it is."""
    if value is None or isinstance(value, (bool, np.bool_)):
        return {"None": "null", "True": "true", "False": "false"}[str(value)]
    kind = type(value).__name__
    if isinstance(value, int) and value.bit_length() > 128:
        return f"int of {value.bit_length()} bits"
    if isinstance(value, (int, float, np.number)):
        return f"{kind} {value}"
    if isinstance(value, str):
        return "{} {!r}{}".format(kind, value[:40], "…" if len(value) > 40 else "")
    return kind


def left_out(path: str, missing: Missing) -> None:
    missing[path] = None


# Messages and times


def partial(values: Dict[str, Any], names: Sequence[str], path: str) -> List[Any]:
    """The values of all fields of a message that some were left out of."""
    unknown(values, names, path)
    return [values.get(name, LEFT_OUT) for name in names]


def unknown(values: Dict[str, Any], names: Sequence[str], path: str) -> None:
    """Raise Misfit when there is a value for a field that the message does not have."""
    for name in values:
        if name not in names:
            raise Misfit(path, f".{name}", None, "")


def mapping(value: Any, path: str, missing: Missing, plan: Plan) -> Dict[str, Any]:
    """The fields of a nested message."""
    if value is LEFT_OUT:
        left_out(path, missing)
        return default_values(plan)
    if isinstance(value, Mapping):
        return dict(value)
    misfit(path, f"a {plan.name} message", value)


def header(value: Any, path: str, missing: Missing, plan: Plan, now: Now) -> Dict[str, Any]:
    """The fields of a header; one that was left out is filled, with the current time."""
    if value is LEFT_OUT:
        return {"seq": 0, "stamp": _clock(now), "frame_id": ""}
    return mapping(value, path, missing, plan)


def time(value: Any, path: str, missing: Missing, now: Now) -> Dict[str, Any]:
    """The secs and nsecs of a time."""
    return _clock(now) if isinstance(value, str) and value == "now" else duration(value, path, missing, "a time")


def stamp(value: Any, path: str, missing: Missing, now: Now) -> Dict[str, Any]:
    """The secs and nsecs of the stamp of a header, which is the current time when it was left out."""
    return _clock(now) if value is LEFT_OUT else time(value, path, missing, now)


def duration(value: Any, path: str, missing: Missing, kind: str = "a duration") -> Dict[str, Any]:
    """The secs and nsecs of a duration."""
    if value is LEFT_OUT:
        left_out(path, missing)
        return {"secs": 0, "nsecs": 0}
    if isinstance(value, Mapping):
        return dict(value)
    misfit(path, kind, value)


def _clock(now: Now) -> Dict[str, Any]:
    secs, nsecs = now()
    return {"secs": secs, "nsecs": nsecs}


# Single values


def real(value: Any, path: str, missing: Missing, code: str, suffix: str = "") -> float:
    """A float32 or float64, by its struct code; null is NaN."""
    if value is LEFT_OUT:
        left_out(path, missing)
        return 0.0
    if value is None:
        return math.nan
    if isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool):
        try:
            number = float(value)
        except OverflowError:
            misfit(path, _EXPECTED[code], value, suffix)
        if code == "d" or not math.isfinite(number) or abs(number) < MAX_FLOAT32:
            return number
    misfit(path, _EXPECTED[code], value, suffix)


def integer(value: Any, path: str, missing: Missing, code: str, suffix: str = "") -> int:
    """An integer, by its struct code; a float without fraction is one, since JavaScript has no other numbers."""
    if value is LEFT_OUT:
        left_out(path, missing)
        return 0
    low, high = INTEGER_RANGES[code]
    if isinstance(value, (int, np.integer)) and not isinstance(value, bool):
        number = int(value)
        if low <= number <= high:
            return number
    elif isinstance(value, (float, np.floating)) and float(value).is_integer() and low <= value <= high:
        return int(value)
    misfit(path, _EXPECTED[code], value, suffix)


def boolean(value: Any, path: str, missing: Missing, code: str = "?", suffix: str = "") -> bool:
    if value is LEFT_OUT:
        left_out(path, missing)
        return False
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    misfit(path, _EXPECTED["?"], value, suffix)


def text(value: Any, path: str, missing: Missing, suffix: str = "") -> str:
    if value is LEFT_OUT:
        left_out(path, missing)
        return ""
    if isinstance(value, str):
        return value
    misfit(path, "a string", value, suffix)


def texts(value: Any, path: str, missing: Missing, field: Field) -> List[bytes]:
    """The wire bytes of the strings of a list, each with its length."""
    values = sequence(value, path, missing, field)
    if not set(map(type, values)) <= {str}:
        values = [text(item, path, missing, f"[{index}]") for index, item in enumerate(values)]
    try:
        raw = [item.encode() for item in values]
    except UnicodeEncodeError:
        raw = [encoded(item, path, f"[{index}]") for index, item in enumerate(values)]
    return [_LENGTH(len(item)) + item for item in raw]


_LENGTH = struct.Struct("<I").pack


def encoded(value: str, path: str, suffix: str = "") -> bytes:
    """The UTF-8 of a string; half a surrogate pair has none."""
    try:
        return value.encode()
    except UnicodeEncodeError:
        misfit(path, "a string of Unicode characters", value, suffix)


# Arrays


def sequence(value: Any, path: str, missing: Missing, field: Field) -> Sequence[Any]:
    """The elements of an array of messages, strings, times or durations, as many as its type has."""
    if value is LEFT_OUT:
        left_out(path, missing)
        return default_elements(field)
    if not isinstance(value, (list, tuple)):
        misfit(path, _array_of(field), value)
    _check_length(len(value), path, field)
    return value


def binary(value: Any, path: str, missing: Missing, field: Field) -> bytes:
    """The bytes of a uint8[] or char[]: base64, bytes, or numbers."""
    if isinstance(value, str):
        try:
            raw = _base64(value)
        except ValueError as error:
            raise Misfit(path, "", _array_of(field), f"a string that is not base64: {error}") from error
    elif isinstance(value, (bytes, bytearray, memoryview)):
        raw = bytes(value)
    else:
        return numbers(value, path, missing, field)
    _check_length(len(raw), path, field)
    return raw


def _base64(value: str) -> bytes:
    try:
        return pybase64.b64decode(value, validate=True)
    except ValueError:
        # Some encoders break lines.
        return pybase64.b64decode("".join(value.split()), validate=True)


def numbers(value: Any, path: str, missing: Missing, field: Field) -> bytes:
    """The wire bytes of an array of numbers or bools, without a length prefix."""
    code = NUMBER_CODES[field.type]
    if isinstance(value, (list, tuple)):
        _check_length(len(value), path, field)
        return _pack_numbers(value, path, code)
    if isinstance(value, np.ndarray) and value.ndim == 1:
        _check_length(len(value), path, field)
        return _cast_numbers(value, path, code)
    if value is LEFT_OUT:
        left_out(path, missing)
        return bytes((field.length or 0) * CODE_SIZES[code])
    misfit(path, _array_of(field), value)


# What a list may hold for it to be packed without looking at each element.
_PLAIN_TYPES: Mapping[str, FrozenSet[type]] = {
    "?": frozenset({bool}),
    "f": frozenset({float, int}),
    "d": frozenset({float, int}),
}
_INTEGER = frozenset({int})


def _pack_numbers(values: Sequence[Any], path: str, code: str) -> bytes:
    if set(map(type, values)) <= _PLAIN_TYPES.get(code, _INTEGER):
        try:
            return struct.pack(f"<{len(values)}{code}", *values)
        except (struct.error, OverflowError):
            pass  # one is out of range: found below
    convert: Callable[..., Any] = {"?": boolean, "f": real, "d": real}.get(code, integer)
    converted = [convert(value, path, {}, code, f"[{index}]") for index, value in enumerate(values)]
    return struct.pack(f"<{len(values)}{code}", *converted)


@np.errstate(invalid="ignore")
def _cast_numbers(values: Any, path: str, code: str) -> bytes:
    """The same for a NumPy array, such as a CBOR typed array makes."""
    kind = values.dtype.kind
    target = np.dtype("?" if code == "?" else NUMPY_TYPES[code])
    if code == "?":
        fits = np.full(len(values), kind == "b")
    elif code in "fd":
        fits = np.full(len(values), kind in "iuf")
        if code == "f" and values.dtype == np.float64:
            fits &= ~(np.isfinite(values) & (np.abs(values) >= MAX_FLOAT32))
    elif kind in "iuf":
        low, high = INTEGER_RANGES[code]
        values = values.astype(np.float64) if kind == "f" else values
        # Compared as floats, 2**63 and 2**64 are exact, one less is not.
        fits = (values >= low) & (values < float(high + 1) if kind == "f" else values <= high)
        if kind == "f":
            fits &= np.floor(values) == values
    else:
        fits = np.full(len(values), False)
    if not fits.all():
        first = int(np.argmin(fits))
        misfit(path, _EXPECTED[code], values[first], f"[{first}]")
    raw: bytes = values.astype(target).tobytes()
    return raw


def _check_length(length: int, path: str, field: Field) -> None:
    if field.length is not None and length != field.length:
        raise Misfit(path, "", _array_of(field), f"{length} elements")


def _array_of(field: Field) -> str:
    kind = "binary data (base64 or a list of integers)" if field.is_binary else "a list"
    return f"{kind} for {field.declared_type}"


_EXPECTED: Mapping[str, str] = {
    "?": "a bool",
    "f": "a number (float32)",
    "d": "a number (float64)",
    **{code: "an integer from {} to {}".format(*limits) for code, limits in INTEGER_RANGES.items()},
}


# Defaults


def default_values(plan: Plan) -> Dict[str, Any]:
    """The values of a message whose every field has its default."""
    return {field.name: default_value(field) for field in plan.fields}


def default_value(field: Field) -> Any:
    if field.is_binary:
        return bytes(field.length or 0)
    return default_elements(field) if field.is_array else default_element(field)


def default_elements(field: Field) -> List[Any]:
    return [default_element(field) for _ in range(field.length or 0)]


def default_element(field: Field) -> Any:
    if field.message is not None:
        return default_values(field.message)
    if field.type in TIME_CODES:
        return {"secs": 0, "nsecs": 0}
    return {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}.get(field.type, 0)
