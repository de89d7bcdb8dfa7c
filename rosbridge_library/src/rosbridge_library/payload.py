# SPDX-License-Identifier: BSD-3-Clause
"""What travels between a protocol and a client's connection.

A protocol hands encoded messages (:class:`Payload`) to an :class:`Outbox`, which owns everything that waits
for one client: it decides what goes out next and what is dropped when the client is slow. Topic messages are
offered unencoded with their :class:`Source`, so that a message which is dropped is never encoded. A payload
may be shared by all the clients that want it: its transport framing is made once too.
"""

from __future__ import annotations

from typing import Callable, Dict, Mapping, Optional, Protocol, Sequence, Tuple, Union

Buffer = Union[bytes, bytearray, memoryview]
"""Bytes that are not changed any more once they are in a payload (a memoryview must be of bytes, ``itemsize``
1)."""

Framer = Callable[["Payload"], Tuple[Buffer, ...]]
"""Puts a transport's framing around a payload: the buffers to write, one after the other."""


class Payload:
    """One encoded message, immutable, shared between clients.

    ``parts`` are the buffers that follow each other (kept apart so that a large one is never copied),
    ``binary`` says whether they go in a binary frame or are UTF-8 text, ``size`` is their length in bytes.
    """

    __slots__ = ("parts", "binary", "size", "_data", "_frames")

    def __init__(self, parts: Sequence[Buffer], binary: bool = False) -> None:
        self.parts: Tuple[Buffer, ...] = tuple(parts)
        self.binary = binary
        self.size = sum(map(len, self.parts))
        self._data: Optional[bytes] = None
        self._frames: Optional[Dict[Framer, Tuple[Buffer, ...]]] = None

    @property
    def data(self) -> bytes:
        """The whole message; joined once."""
        data = self._data
        if data is None:
            first = self.parts[0] if len(self.parts) == 1 else None
            data = self._data = first if isinstance(first, bytes) else b"".join(self.parts)
        return data

    def framed(self, framer: Framer) -> Tuple[Buffer, ...]:
        """The buffers that ``framer`` makes of this payload, made once per framer however many clients get
        them."""
        frames = self._frames
        if frames is None:
            frames = self._frames = {}
        buffers = frames.get(framer)
        if buffers is None:
            buffers = frames[framer] = framer(self)
        return buffers

    def __repr__(self) -> str:
        return "Payload(%s, %d bytes)" % ("binary" if self.binary else "text", self.size)


class Source(Protocol):
    """Where topic messages for one client come from: one subscription of that client.

    Sources are compared by identity.
    """

    topic: str
    """The topic's name, for counters and logs."""
    keep: int
    """How many of the newest messages are kept while the client is slow: ``max(queue_length, 1)``."""

    def encode(self, message: object) -> Sequence[Payload]:
        """The payloads to send for an offered message: one, or several fragments of it, or none.

        Called on the loop when the message's turn comes. It must not raise; a message that can't be encoded
        is reported by the source and gives none.
        """
        ...


class Outbox(Protocol):
    """Everything that waits to be sent to one client. All methods are called on the loop and return at
    once."""

    @property
    def dropped(self) -> Mapping[str, int]:
        """How many messages of each topic were dropped so far."""
        ...

    @property
    def waiting_bytes(self) -> int:
        """How much waits."""
        ...

    def send(self, payload: Payload) -> None:
        """Sends on the control lane: in order, never dropped, before any topic message that waits."""
        ...

    def offer(self, source: Source, message: object, size: int) -> None:
        """Sends a message of ``source`` when its turn comes; ``size`` is its length in bytes, about.

        While the client is slow, older messages of the source are dropped for it.
        """
        ...

    def forget(self, source: Source) -> None:
        """Drops all that waits for ``source``; its messages that have begun to go out are finished."""
        ...
