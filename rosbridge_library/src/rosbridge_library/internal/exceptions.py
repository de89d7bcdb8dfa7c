# SPDX-License-Identifier: BSD-3-Clause
"""Every exception that this library raises for a reason its caller can act on.

They form one small tree, so that a protocol handler can tell a client about any of them with a single
`except RosbridgeError`. Those which tell about data also are ValueErrors.
"""

from __future__ import annotations

from typing import Optional


class RosbridgeError(Exception):
    """What a client did, or asked for, could not be done; the text says why."""


class MissingArgumentException(RosbridgeError):
    """An operation lacks a mandatory field."""


class InvalidArgumentException(RosbridgeError):
    """A field of an operation has the wrong type or value."""


class DecodeError(RosbridgeError, ValueError):
    """Text or bytes from a client are not JSON, or not CBOR."""


class WireError(RosbridgeError, ValueError):
    """Serialized message bytes are truncated, over-long or corrupt."""


class DefinitionError(RosbridgeError, ValueError):
    """The text of a message definition is malformed, incomplete or too big."""


class TypeLoadError(RosbridgeError):
    """A message or service type could not be loaded from the installed packages."""


class InvalidTypeStringException(TypeLoadError):
    """A type name is not of the form `package/Type`."""

    def __init__(self, type_string: object) -> None:
        super().__init__(f"{type_string!r} is not a valid type string: expected package/Type")


class InvalidPackageException(TypeLoadError):
    """The package of a type is not installed, or fails to import."""

    def __init__(self, package: str, original: Optional[BaseException] = None) -> None:
        reason = "" if original is None else f": {original}"
        super().__init__(f"Unable to import package {package}{reason}")


class InvalidModuleException(TypeLoadError):
    """A package has no `msg` (or `srv`) module, or that module fails to import."""

    def __init__(self, package: str, module: str, original: Optional[BaseException] = None) -> None:
        reason = "" if original is None else f": {original}"
        super().__init__(f"Unable to import {package}.{module} from package {package}{reason}")


class InvalidClassException(TypeLoadError):
    """A package's `msg` (or `srv`) module has no such type."""

    def __init__(self, package: str, module: str, name: str) -> None:
        super().__init__(f"Unable to find {module} class {name} in package {package}")


class InvalidMessageException(RosbridgeError):
    """An object is not a ROS message."""

    def __init__(self, inst: object) -> None:
        super().__init__(f"Unable to extract message values from {type(inst).__name__} instance")


class ValuesError(RosbridgeError, ValueError):
    """Values given for a message do not conform to its type.

    `path` is the dotted path of the offending field, such as `poses[3].header.stamp`; "" is the message itself.
    """

    def __init__(self, message: str, path: str) -> None:
        super().__init__(message)
        self.path = path


class FieldTypeMismatchException(ValuesError):
    """A field was given a value that its type does not take."""

    def __init__(self, roottype: str, path: str, expected: str, found: str) -> None:
        where = f"{roottype} message requires {expected} for field '{path}'"
        if not path:
            where = f"{roottype} message requires {expected}"
        super().__init__(f"{where}, but got {found}", path)
        self.roottype = roottype
        self.expected = expected
        self.found = found


class NonexistentFieldException(ValuesError):
    """Values name a field that the message type does not have."""

    def __init__(self, roottype: str, path: str) -> None:
        super().__init__(f"Message type {roottype} does not have a field {path}", path)
        self.roottype = roottype
