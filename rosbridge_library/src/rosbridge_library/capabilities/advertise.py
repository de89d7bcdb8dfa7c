# SPDX-License-Identifier: BSD-3-Clause
"""advertise and unadvertise (specification 3.4.1, 3.4.2)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Awaitable, Optional

from rosbridge_library.capabilities.publication import publications
from rosbridge_library.capability import Capability, Operation, on_loop
from rosbridge_library.internal.exceptions import InvalidArgumentException

if TYPE_CHECKING:
    from rosbridge_library.protocol import Protocol


class Advertise(Capability):
    """Says what a client publishes."""

    advertise_msg_fields = (
        (True, "topic", str),
        (True, "type", str),
        (False, "latch", bool),
        (False, "queue_size", int),
    )
    unadvertise_msg_fields = ((True, "topic", str),)

    def __init__(self, protocol: Protocol) -> None:
        super().__init__(protocol)
        protocol.register_operation("advertise", self.advertise)
        protocol.register_operation("unadvertise", self.unadvertise)

    @on_loop
    def advertise(self, message: Operation) -> Optional[Awaitable[None]]:
        """Advertise a topic."""
        self.basic_type_check(message, self.advertise_msg_fields)
        if (message.get("queue_size") or 0) < 0:
            raise InvalidArgumentException("the field 'queue_size' must not be negative")
        return self._advertise(message)

    async def _advertise(self, message: Operation) -> None:
        topic, lid = message["topic"], message.get("id")
        publisher = await publications(self.protocol).advertise(
            topic, message["type"], lid, bool(message.get("latch")), message.get("queue_size")
        )
        if message.get("latch") and not publisher.latch:
            reason = f"{topic} does not latch: others advertised it without"
            self.protocol.log("warning", f"advertise: {reason}", lid)
        self.protocol.log("info", f"advertise: {topic} is advertised as {publisher.type.name}", lid)

    @on_loop
    def unadvertise(self, message: Operation) -> None:
        """Take back an advertisement, or all of a topic when no id is given."""
        self.basic_type_check(message, self.unadvertise_msg_fields)
        topic, lid = message["topic"], message.get("id")
        if publications(self.protocol).unadvertise(topic, lid):
            self.protocol.log("info", f"unadvertise: {topic} is no longer advertised", lid)
        else:
            self.protocol.log("warning", f"unadvertise: {topic} was not advertised by this client", lid)

    def finish(self) -> None:
        publications(self.protocol).unadvertise_all()
