# SPDX-License-Identifier: BSD-3-Clause
"""publish (specification 3.4.3)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Awaitable, Optional

from rosbridge_library.capabilities.publication import publications
from rosbridge_library.capability import Capability, Operation, on_loop
from rosbridge_library.ros.publishers import Publisher

if TYPE_CHECKING:
    from rosbridge_library.protocol import Protocol


class Publish(Capability):
    """Publishes a client's messages on ROS topics."""

    publish_msg_fields = (
        (True, "topic", str),
        (False, "msg", dict),
        (False, "latch", bool),
        (False, "queue_size", int),
    )

    def __init__(self, protocol: Protocol) -> None:
        super().__init__(protocol)
        protocol.register_operation("publish", self.publish)
        self._publications = publications(protocol)

    @on_loop
    def publish(self, message: Operation) -> Optional[Awaitable[None]]:
        """Publish one message; a topic that the client has not advertised is advertised first."""
        self.basic_type_check(message, self.publish_msg_fields)
        publisher = self._publications.get(message["topic"])
        if publisher is None:
            return self._advertise_and_publish(message)
        self._publish(publisher, message)
        return None

    async def _advertise_and_publish(self, message: Operation) -> None:
        publisher = await self._publications.advertise(
            message["topic"], None, None, bool(message.get("latch")), message.get("queue_size")
        )
        self._publish(publisher, message)

    def _publish(self, publisher: Publisher, message: Operation) -> None:
        wire, missing = publisher.type.from_values(message.get("msg") or {}, self.protocol.node.now)
        publisher.publish(wire)
        if missing:
            self.protocol.log(
                "warning",
                f"publish: fields of {publisher.type.name} left out on {message['topic']} were filled with defaults: "
                + ", ".join(missing),
                message.get("id"),
            )

    def finish(self) -> None:
        self._publications.unadvertise_all()
