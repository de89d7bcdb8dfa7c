# SPDX-License-Identifier: BSD-3-Clause
"""A capability is one group of a protocol's operations, with the state that they share for one client.

It registers a handler per operation with its protocol. A handler is a plain function or a coroutine function on the
event loop; the protocol finishes one before the client's next operation begins. What a handler raises as a
RosbridgeError is what the client is told.
"""

from __future__ import annotations

import asyncio
import functools
from typing import (
    TYPE_CHECKING,
    Any,
    Awaitable,
    Callable,
    Dict,
    Iterable,
    Optional,
    Tuple,
    Type,
    TypeVar,
    Union,
)

from rosbridge_library.internal.exceptions import InvalidArgumentException, MissingArgumentException

if TYPE_CHECKING:
    from rosbridge_library.protocol import Protocol

__all__ = [
    "Capability",
    "InvalidArgumentException",
    "MissingArgumentException",
    "Operation",
    "OperationId",
    "checked_id",
    "on_loop",
]

Operation = Dict[str, Any]
"""One decoded message from a client: its `op` and the other fields."""

OperationId = Union[str, int, float, None]

FieldType = Union[Type[Any], Tuple[Type[Any], ...]]
C = TypeVar("C", bound="Capability")


def checked_id(message: Operation) -> OperationId:
    """The `id` of an operation, or None. Raises InvalidArgumentException for what can't be one, and can't come back."""
    value = message.get("id")
    if value is None or isinstance(value, (str, float)):
        return value
    if isinstance(value, int) and not isinstance(value, bool) and -(1 << 63) <= value < 1 << 64:
        return value
    raise InvalidArgumentException("the field 'id' must be a string or a number")


class Capability:
    """Base of all capabilities. `handle_message` exists for those with a single operation."""

    def __init__(self, protocol: Protocol) -> None:
        self.protocol = protocol

    def handle_message(self, message: Operation) -> Optional[Awaitable[None]]:
        """Handle one operation."""
        raise NotImplementedError

    def finish(self) -> None:
        """The client is gone: leave nothing behind."""

    def basic_type_check(self, msg: Operation, types_info: Iterable[Tuple[bool, str, FieldType]]) -> None:
        """Check fields of `msg` against (mandatory, name, type or tuple of types). null counts as left out.

        The `id`, which every operation may have, is checked too.
        Raises MissingArgumentException or InvalidArgumentException. True and False are no numbers here.
        """
        checked_id(msg)
        for mandatory, field, types in types_info:
            value = msg.get(field)
            if value is None:
                if mandatory:
                    raise MissingArgumentException(f"the field '{field}' is missing")
                continue
            allowed = types if isinstance(types, tuple) else (types,)
            if not isinstance(value, allowed) or (isinstance(value, bool) and bool not in allowed):
                names = " or ".join(each.__name__ for each in allowed)
                raise InvalidArgumentException(f"the field '{field}' must be {names}, not {type(value).__name__}")


def on_loop(
    handler: Callable[[C, Operation], Optional[Awaitable[None]]],
) -> Callable[[C, Operation], Optional[Awaitable[None]]]:
    """Lets a handler be called from any thread: off the loop, the caller waits until the loop has run it."""

    @functools.wraps(handler)
    def call(self: C, message: Operation) -> Optional[Awaitable[None]]:
        loop = self.protocol.loop
        if asyncio._get_running_loop() is loop:
            return handler(self, message)
        return asyncio.run_coroutine_threadsafe(_finished(handler, self, message), loop).result()

    return call


async def _finished(handler: Callable[[C, Operation], Optional[Awaitable[None]]], self: C, message: Operation) -> None:
    pending = handler(self, message)
    if pending is not None:
        await pending
