# SPDX-License-Identifier: BSD-3-Clause
"""fragment and png from a client (specification 3.1.1, 3.1.2): put together, unpacked, and handled as what they hold.

What is incomplete is bounded: in how many messages may be incomplete at once, in bytes, and in time. A message whose
fragments stop coming is given up `fragment_timeout` seconds after the last one.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Awaitable, Callable, Dict, Hashable, Optional, Tuple

from rosbridge_library.capability import Capability, Operation, on_loop
from rosbridge_library.codec import decode_json
from rosbridge_library.encodings import from_png
from rosbridge_library.internal.exceptions import InvalidArgumentException, MissingArgumentException

if TYPE_CHECKING:
    from rosbridge_library.protocol import Protocol

MAX_INCOMPLETE_MESSAGES = 64
MAX_FRAGMENTS = 1_000_000
MAX_DEPTH = 3
FRAGMENT_OVERHEAD_BYTES = 128
"""What keeping a fragment takes beside its text."""

Unpack = Callable[[str], object]


class Defragment(Capability):
    """Collects a client's fragments."""

    fragment_msg_fields = (
        (True, "id", (str, int)),
        (True, "data", str),
        (True, "num", int),
        (True, "total", int),
    )
    png_msg_fields = ((True, "data", str), (False, "num", int), (False, "total", int))

    def __init__(self, protocol: Protocol) -> None:
        super().__init__(protocol)
        self._incomplete: Dict[Tuple[Unpack, Hashable], _Collection] = {}
        self._bytes = 0
        self._depth = 0
        protocol.register_operation("fragment", self.defragment)
        protocol.register_operation("png", self.png)

    @on_loop
    def defragment(self, message: Operation) -> Optional[Awaitable[None]]:
        """Take one fragment of an operation's JSON text; the last one to come completes it."""
        self.basic_type_check(message, self.fragment_msg_fields)
        return self._collect(message, decode_json)

    @on_loop
    def png(self, message: Operation) -> Optional[Awaitable[None]]:
        """Take an operation as a PNG image, whole or one fragment of it."""
        self.basic_type_check(message, self.png_msg_fields)
        if message.get("total") in (None, 1):
            return self._handle(_unpack_png, message["data"])
        if message.get("id") is None or message.get("num") is None:
            raise MissingArgumentException("a fragmented png needs the fields 'id', 'num' and 'total'")
        return self._collect(message, _unpack_png)

    def _collect(self, message: Operation, unpack: Unpack) -> Optional[Awaitable[None]]:
        key = (unpack, message["id"])
        total, num, data = message["total"], message["num"], message["data"]
        if not 0 <= num < total <= MAX_FRAGMENTS:
            raise InvalidArgumentException(f"fragment {num} of {total}: num must be from 0 to total - 1")
        collection = self._incomplete.get(key)
        if collection is not None and collection.total != total:
            self._give_up(key)
            raise InvalidArgumentException(f"the fragments of {message['id']} disagree about how many there are")
        limit = self.protocol.parameters.max_incoming_size
        if limit and self._bytes + len(data) > limit:
            self._give_up(key)
            raise InvalidArgumentException(
                f"incomplete messages of more than {limit} bytes; {message['id']} is dropped"
            )
        if collection is None:
            if len(self._incomplete) >= MAX_INCOMPLETE_MESSAGES:
                raise InvalidArgumentException(f"more than {MAX_INCOMPLETE_MESSAGES} messages are incomplete")
            collection = self._incomplete[key] = _Collection(total)
        elif collection.timer is not None:
            collection.timer.cancel()
        self._bytes += collection.add(num, data)
        if len(collection.parts) < total:
            timeout_s = self.protocol.parameters.fragment_timeout
            collection.timer = self.protocol.loop.call_later(timeout_s, self._time_out, key)
            return None
        text = "".join(collection.parts[index] for index in range(total))
        self._give_up(key)
        return self._handle(unpack, text)

    def _handle(self, unpack: Unpack, text: str) -> Optional[Awaitable[None]]:
        """Handle the operation in `text`, which may be packed in turn: a png in fragments, say, but no deeper."""
        if self._depth == MAX_DEPTH:
            raise InvalidArgumentException(f"an operation may be packed {MAX_DEPTH} times at most")
        self._depth += 1
        try:
            return self.protocol.handle(unpack(text))
        finally:
            self._depth -= 1

    def _time_out(self, key: Tuple[Unpack, Hashable]) -> None:
        collection = self._incomplete[key]
        self._give_up(key)
        self.protocol.log(
            "error",
            f"fragment: only {len(collection.parts)} of {collection.total} fragments came in time",
            key[1] if isinstance(key[1], (str, int)) else None,
        )

    def _give_up(self, key: Tuple[Unpack, Hashable]) -> None:
        collection = self._incomplete.pop(key, None)
        if collection is not None:
            self._bytes -= collection.bytes
            if collection.timer is not None:
                collection.timer.cancel()

    def finish(self) -> None:
        for key in list(self._incomplete):
            self._give_up(key)


class _Collection:
    """The fragments of one message that have come so far."""

    def __init__(self, total: int) -> None:
        self.total = total
        self.parts: Dict[int, str] = {}
        self.bytes = 0
        self.timer: Optional[asyncio.TimerHandle] = None

    def add(self, num: int, data: str) -> int:
        """Keep one fragment; by how many bytes the collection has grown. One that came before is replaced."""
        before = self.parts.get(num)
        growth = len(data) - len(before) if before is not None else len(data) + FRAGMENT_OVERHEAD_BYTES
        self.parts[num] = data
        self.bytes += growth
        return growth


def _unpack_png(data: str) -> object:
    return decode_json(from_png(data))
