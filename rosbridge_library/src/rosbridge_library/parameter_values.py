# SPDX-License-Identifier: BSD-3-Clause
"""Values of the parameter server, between JSON and the XML-RPC that it speaks: pure functions.

XML-RPC carries neither null nor integers beyond 32 bits, and it can hold binary data and dates, which JSON can't. What
a client gives and can't be carried is refused, with the reason; what is read always becomes JSON.
"""

from __future__ import annotations

import base64
import datetime
import math
import xmlrpc.client
from typing import Any

from rosbridge_library.internal.exceptions import RosbridgeError
from rosbridge_library.xml_text import is_xml_text

MAX_DEPTH = 64
"""Deeper than any real parameter, and far below what makes the master fail when it writes the value out."""


class ParameterError(RosbridgeError):
    """A parameter is not read or changed as asked; the text says why."""


def jsonable(value: Any) -> Any:
    """A value of the parameter server as what every JSON writer takes.

    NaN and infinities are null, binary data (bytes) is base64, a date (datetime) is ISO 8601 text, keys are text, and
    integers beyond 64 bits are floats, or null beyond those.
    """
    if isinstance(value, dict):
        return {str(key): jsonable(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [jsonable(each) for each in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, bytes):
        return base64.b64encode(value).decode("ascii")
    if isinstance(value, datetime.datetime):
        return value.isoformat()
    if isinstance(value, int) and not -(1 << 63) <= value < 1 << 64:
        return float(value) if abs(value) < 1 << 1000 else None
    return value


def check(value: Any, where: str = "", depth: int = 0) -> None:
    """ParameterError when the parameter server can't hold `value`, which is at `where` in the whole."""
    if depth > MAX_DEPTH:
        raise too_deep()
    if isinstance(value, dict):
        for key, each in value.items():
            check(key, f"{where} (key)", depth)
            check(each, f"{where}.{key}" if where else key, depth + 1)
    elif isinstance(value, list):
        for index, each in enumerate(value):
            check(each, f"{where}[{index}]", depth + 1)
    elif value is None:
        raise ParameterError(f"the parameter server can't hold null{_at(where)}")
    elif isinstance(value, int) and not xmlrpc.client.MININT <= value <= xmlrpc.client.MAXINT:
        raise ParameterError(f"the parameter server holds integers of 32 bits only, not {_shown(value)}{_at(where)}")
    elif isinstance(value, str) and not is_xml_text(value):
        raise ParameterError(f"the parameter server can't hold control characters or half a surrogate pair{_at(where)}")


def too_deep() -> ParameterError:
    """The error about a value nested beyond MAX_DEPTH."""
    return ParameterError(f"the value is nested deeper than {MAX_DEPTH} levels")


def _shown(value: int) -> str:
    return str(value) if value.bit_length() <= 128 else f"one of {value.bit_length()} bits"


def _at(where: str) -> str:
    return f" at {where[:200]!a}" if where else ""
