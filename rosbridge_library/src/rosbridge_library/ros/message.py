# SPDX-License-Identifier: BSD-3-Clause
"""One message as it came from ROS, shared by all clients that receive its topic."""

from __future__ import annotations

from typing import Callable, Dict, Hashable, List, Optional, Tuple, Union

from rosbridge_library.codec import MessageType
from rosbridge_library.payload import Payload

Wire = Union[bytes, memoryview]
"""A message's bytes, as on the wire, without the length in front."""


class Message:
    """One message of a topic: `wire` bytes of `type`, `received` at (secs, nsecs) of ROS time; immutable and shared.

    `replayed` is set for the first message of a latching publisher's connection, which every client must get.
    """

    __slots__ = ("_encoded", "received", "replayed", "topic", "type", "wire")

    def __init__(
        self, topic: str, type_: MessageType, wire: Wire, received: Tuple[int, int], replayed: bool = False
    ) -> None:
        self.topic = topic
        self.type = type_
        self.wire = wire
        self.received = received
        self.replayed = replayed
        self._encoded: Optional[Dict[Hashable, List[Payload]]] = None

    def encoded(self, key: Hashable, encode: Callable[[Message], List[Payload]]) -> List[Payload]:
        """What `encode` makes of this message, made once for all who ask with the same `key`."""
        if self._encoded is None:
            self._encoded = {}
        payloads = self._encoded.get(key)
        if payloads is None:
            payloads = self._encoded[key] = encode(self)
        return payloads
