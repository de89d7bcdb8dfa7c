# SPDX-License-Identifier: BSD-3-Clause
"""Time frames: the simulated time of /clock, for clients to go by."""

from __future__ import annotations

import struct
from typing import List, Sequence

from rosbridge_library.capability import Capability
from rosbridge_library.foxglove import messages
from rosbridge_library.foxglove.protocol import FoxgloveProtocol
from rosbridge_library.payload import Payload
from rosbridge_library.ros.feeds import Sink
from rosbridge_library.ros.message import Message

TOPIC, TYPE = "/clock", "rosgraph_msgs/Clock"

_CLOCK = struct.Struct("<II")


class Clock(Capability, Sink):
    """Sends one client the time as it is, and every time that /clock tells, or to a slow one the newest."""

    topic = "/clock (time)"
    keep = 1

    def __init__(self, protocol: FoxgloveProtocol) -> None:
        super().__init__(protocol)
        secs, nsecs = protocol.node.now()
        if (secs, nsecs) != (0, 0):  # before the first message of /clock there is no time
            protocol.send_payload(_time_frame(secs, nsecs))
        self._feed = protocol.node.feeds.open(TOPIC, TYPE)
        self._feed.add(self)

    # Sink

    def deliver(self, message: Message) -> None:
        if message.type.name == TYPE:
            self.protocol.outbox.offer(self, message, len(message.wire))

    def deliver_latched(self, message: Message) -> None:
        self.deliver(message)

    # Source

    def encode(self, message: object) -> Sequence[Payload]:
        assert isinstance(message, Message)
        return message.encoded("foxglove-time", _encode)

    def finish(self) -> None:
        self._feed.remove(self)
        self.protocol.outbox.forget(self)


def _encode(message: Message) -> List[Payload]:
    if len(message.wire) != _CLOCK.size:
        return []
    return [_time_frame(*_CLOCK.unpack(message.wire))]


def _time_frame(secs: int, nsecs: int) -> Payload:
    return messages.time_frame(secs * 1_000_000_000 + nsecs)
