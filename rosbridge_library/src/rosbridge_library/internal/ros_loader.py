# SPDX-License-Identifier: BSD-3-Clause
"""Message and service classes by type name, from the installed packages.

Importing `package.msg` is all it takes: the manifest of a package (its package.xml) need not be installed, since
distributions ship the two apart. The names `package/msg/Type` and `package/srv/Type` are taken as well.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from importlib.machinery import PathFinder
from types import ModuleType
from typing import Any, Dict, Tuple

from .exceptions import (
    InvalidClassException,
    InvalidModuleException,
    InvalidPackageException,
    InvalidTypeStringException,
    TypeLoadError,
)

__all__ = [
    "InvalidClassException",
    "InvalidModuleException",
    "InvalidPackageException",
    "InvalidTypeStringException",
    "TypeLoadError",
    "canonical_type_name",
    "get_message_class",
    "get_message_instance",
    "get_service_class",
    "get_service_instance",
    "get_service_request_instance",
    "get_service_response_instance",
]

# Classes by (kind, type name), kind being "msg" or "srv". Entries are only ever added, and equal when added
# twice, so that threads need no lock.
_classes: Dict[Tuple[str, str], Any] = {}


def get_message_class(typestring: str) -> Any:
    """The generated class of a message type; raises a TypeLoadError that says what is missing."""
    return _get_class(typestring, "msg")


def get_service_class(typestring: str) -> Any:
    """The generated class of a service type; raises a TypeLoadError that says what is missing."""
    return _get_class(typestring, "srv")


def get_message_instance(typestring: str) -> Any:
    """A new message of a type, all fields at their defaults; raises as get_message_class does."""
    if typestring == "time":  # as old callers expect: the two builtin types that have classes
        return importlib.import_module("genpy").Time()
    if typestring == "duration":
        return importlib.import_module("genpy").Duration()
    return get_message_class(typestring)()


def get_service_instance(typestring: str) -> Any:
    """A new instance of a service class; raises as get_service_class does."""
    return get_service_class(typestring)()


def get_service_request_instance(typestring: str) -> Any:
    """A new request of a service type; raises as get_service_class does."""
    return get_service_class(typestring)._request_class()


def get_service_response_instance(typestring: str) -> Any:
    """A new response of a service type; raises as get_service_class does."""
    return get_service_class(typestring)._response_class()


def canonical_type_name(typestring: str, kind: str) -> str:
    """`package/Type` for `package/Type`, `package/kind/Type` or `/package/Type`.

    Raises InvalidTypeStringException when it is none of these.
    """
    if not isinstance(typestring, str):
        raise InvalidTypeStringException(typestring)
    parts = typestring.strip("/").split("/")
    if len(parts) == 3 and parts[1] == kind:
        del parts[1]
    if len(parts) != 2 or not all(part.isidentifier() for part in parts):
        raise InvalidTypeStringException(typestring)
    return "/".join(parts)


def _get_class(typestring: str, kind: str) -> Any:
    name = canonical_type_name(typestring, kind)
    cls = _classes.get((kind, name))
    if cls is None:
        package, type_name = name.split("/")
        cls = getattr(_load_module(package, kind), type_name, None)
        marker = "_request_class" if kind == "srv" else "_slot_types"
        if not isinstance(cls, type) or not hasattr(cls, marker):
            raise InvalidClassException(package, kind, type_name)
        _classes[(kind, name)] = cls
    return cls


def _load_module(package: str, kind: str) -> ModuleType:
    """The module `package.kind`; packages installed since the last look are found.

    Type names come from clients, so nothing is imported before it is known to be a package of messages: to import a
    package is to run its code.
    """
    name = f"{package}.{kind}"
    if name in sys.modules:
        return importlib.import_module(name)  # waits for a thread that is importing it
    importlib.invalidate_caches()
    try:
        spec = importlib.util.find_spec(package)
    except ValueError as error:  # a module that was not imported in the usual way, such as __main__
        raise InvalidPackageException(package, error) from error
    if spec is None:
        raise InvalidPackageException(package)
    if PathFinder.find_spec(name, spec.submodule_search_locations or []) is None:
        raise InvalidModuleException(package, kind)
    try:
        return importlib.import_module(name)
    except Exception as error:  # whatever the package's own code raises
        raise InvalidModuleException(package, kind, error) from error
