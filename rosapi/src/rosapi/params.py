# SPDX-License-Identifier: BSD-3-Clause
"""The parameter server for web clients: values as JSON text, names as global names, within `params_glob`.

A parameter that the globs close looks as if it didn't exist, and can't be set or deleted; nor can a namespace
that holds one, and reading a namespace leaves it out.
"""

from __future__ import annotations

import json
from typing import Any, Callable, Iterable, Iterator, List, Optional

from rosbridge_library.access import Access
from rosbridge_library.names import global_name
from rosbridge_library.parameter_values import ParameterError, check, jsonable, too_deep
from rosbridge_library.ros.master import MasterError
from rosbridge_library.xml_text import is_xml_text


def to_json(value: Any) -> str:
    """A value from the parameter server as JSON text; see `jsonable`."""
    return json.dumps(jsonable(value), allow_nan=False)


def from_json(text: str) -> Any:
    """The value that JSON `text` stands for, if the parameter server can hold it, else ParameterError.

    Text without quotes is no JSON string and refused: to guess at `1e3` or `true` would set another type than meant.
    """
    try:
        value = json.loads(text)
    except RecursionError:
        raise too_deep() from None
    except ValueError as error:
        raise ParameterError(
            f"the value must be JSON ({error}); a string takes quotes, as in {json.dumps(text[:40])}"
        ) from error
    check(value)
    return value


class Params:
    """Parameters as clients may use them. `call` calls the master; its MasterUnreachable passes through."""

    def __init__(self, call: Callable[..., Any], access: Access) -> None:
        self._call = call
        self._access = access

    def get(self, name: str, default: str = "") -> str:
        """The value as JSON text; or `default`: JSON, or else taken as a string; null if it is empty."""
        key = self._key(name)
        if key is None:
            return _default(default)
        try:
            value = self._call("getParam", key)
        except MasterError as error:
            if self.has(name):
                raise ParameterError(f"the master can't give {key}: {error}") from error
            return _default(default)
        return to_json(self._visible(key, value))

    def set(self, name: str, text: str) -> None:
        """Set the parameter to the value of JSON `text`. Raises ParameterError."""
        key = _checked_name(name)
        value = from_json(text)
        self._refuse_closed(key, _leaves(key, value))
        try:
            self._call("setParam", key, value)
        except MasterError as error:
            raise ParameterError(f"the master refuses to set {key}: {error}") from error

    def delete(self, name: str) -> None:
        """Delete the parameter or namespace; one that doesn't exist is no error. Raises ParameterError."""
        key = _checked_name(name)
        self._refuse_closed(key, ())
        try:
            self._call("deleteParam", key)
        except MasterError as error:
            if self.has(name):
                raise ParameterError(f"the master refuses to delete {key}: {error}") from error

    def has(self, name: str) -> bool:
        """Whether the parameter or namespace exists and may be used."""
        key = self._key(name)
        return key is not None and bool(self._call("hasParam", key))

    def search(self, name: str) -> str:
        """The global name found by ROS's search for `name`, from rosapi's namespace upward, or ""."""
        if not name.strip("/") or name.startswith("~") or not is_xml_text(name):
            return ""
        try:
            found = str(self._call("searchParam", name))
        except MasterError:
            return ""
        return found if self._access.may_use_param(found) else ""

    def names(self) -> List[str]:
        """The names of all parameters that may be used, sorted."""
        return sorted(name for name in self._call("getParamNames") if self._access.may_use_param(name))

    def _key(self, name: str) -> Optional[str]:
        """The global name, or None when no parameter can have it or the globs close it."""
        key = global_name(name)
        usable = name and is_xml_text(name) and self._access.may_use_param(key)
        return key if usable else None

    def _visible(self, key: str, value: Any) -> Any:
        """`value` without what the globs close below it."""
        if not isinstance(value, dict):
            return value
        return {
            part: self._visible(_join(key, part), each)
            for part, each in value.items()
            if any(self._access.may_use_param(leaf) for leaf in _leaves(_join(key, part), each))
        }

    def _refuse_closed(self, key: str, leaves: Iterable[str]) -> None:
        """ParameterError when writing `key`, with `leaves` in the new value, touches what the globs close.

        It replaces all that exists below `key`, and a value above it, which becomes a namespace.
        """
        touched = [key, *leaves]
        if self._access.globs[2] is not None:
            names = self._call("getParamNames")
            touched += [name for name in names if _within(name, key) or _within(key, name)]
        for name in touched:
            if not self._access.may_use_param(name):
                raise ParameterError(f"params_glob doesn't allow {name[:200]!a} to be changed")


def _default(text: str) -> str:
    if not text:
        return "null"
    try:
        return to_json(json.loads(text))
    except (ValueError, RecursionError):
        return json.dumps(text)


def _checked_name(name: str) -> str:
    if not name or not is_xml_text(name):
        raise ParameterError(f"{name[:200]!a} can't name a parameter")
    return global_name(name)


def _join(key: str, part: str) -> str:
    return global_name(f"{key}/{part}")


def _within(name: str, key: str) -> bool:
    return name == key or name.startswith(key.rstrip("/") + "/")


def _leaves(key: str, value: Any) -> Iterator[str]:
    """The names of the parameters that the master makes of `value`; an empty namespace counts as one."""
    if isinstance(value, dict) and value:
        for part, each in value.items():
            yield from _leaves(_join(key, part), each)
    else:
        yield key
