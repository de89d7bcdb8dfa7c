# SPDX-License-Identifier: BSD-3-Clause
"""advertise, unadvertise, subscribe, unsubscribe and message data: what a client gets of topics."""

from __future__ import annotations

from collections import deque
from typing import Deque, Dict, Optional, Sequence

from rosbridge_library.capability import Capability, Operation
from rosbridge_library.foxglove import messages
from rosbridge_library.foxglove.fields import entries, number
from rosbridge_library.foxglove.offer import Change
from rosbridge_library.foxglove.protocol import FoxgloveProtocol
from rosbridge_library.foxglove.topics import Audience, Channel
from rosbridge_library.internal.exceptions import RosbridgeError
from rosbridge_library.payload import Payload
from rosbridge_library.ros.feeds import Sink
from rosbridge_library.ros.message import Message

NANOSECONDS = 1_000_000_000
DROPPED_SHOWN_S = 10.0
"""How long after the last message that was dropped the client is told that some are."""
MAX_ENDED = 10_000


class SubscriptionError(RosbridgeError):
    """A subscription that can't be made or taken back."""


class Stream(Sink):
    """One client's subscription of one channel."""

    keep = 1

    def __init__(self, protocol: FoxgloveProtocol, subscription_id: int, channel: Channel) -> None:
        self.id = subscription_id
        self.channel = channel
        self.topic = channel.topic
        self.feed = protocol.node.feeds.open(channel.topic, channel.type.name)
        self._protocol = protocol
        self._told = False
        self._closed = False

    def start(self) -> None:
        """Begin: latched messages first."""
        self.feed.add(self)

    def close(self) -> None:
        """No more messages go to the client."""
        self._closed = True
        self.feed.remove(self)
        self._protocol.outbox.forget(self)
        self._protocol.withdraw([self._mismatch_id])

    @property
    def _mismatch_id(self) -> str:
        return f"type:{self.topic}:{self.id}"

    # Sink

    def deliver(self, message: Message) -> None:
        if self._closed or not self._is_expected(message):
            return
        if message.replayed:
            self._send(message)
        else:
            self._protocol.outbox.offer(self, message, len(message.wire))

    def deliver_latched(self, message: Message) -> None:
        if not self._closed and self._is_expected(message):
            self._send(message)

    def _send(self, message: Message) -> None:
        """Past the queue, so that the last message of every latching publisher gets there."""
        for payload in self.encode(message):
            self._protocol.outbox.send(payload)

    def _is_expected(self, message: Message) -> bool:
        """The client decodes by the channel's definition: what has another would be garbage to it."""
        found, expected = message.type, self.channel.type
        if found is expected or (found.name == expected.name and found.md5sum == expected.md5sum):
            return True
        if not self._protocol.server.topics.correct(self.channel, self.feed, found) and not self._told:
            self._told = True
            reason = "another version of it" if found.name == expected.name else found.name
            self._protocol.show(
                self._mismatch_id, f"{self.topic} is {expected.name}, but a publisher sends {reason}: left out"
            )
        return False

    # Source

    def encode(self, message: object) -> Sequence[Payload]:
        assert isinstance(message, Message)
        secs, nsecs = message.received
        return (messages.message_data(self.id, secs * NANOSECONDS + nsecs, message.wire),)


class Channels(Capability, Audience):
    """What one client is offered, and what it subscribes."""

    protocol: FoxgloveProtocol

    def __init__(self, protocol: FoxgloveProtocol) -> None:
        super().__init__(protocol)
        self._offered: Dict[int, Channel] = {}
        self._streams: Dict[int, Stream] = {}  # by subscription id
        self._subscribed: Dict[int, Stream] = {}  # by channel id
        # Subscriptions that ended with their channel: to unsubscribe them is no mistake.
        self._ended: Deque[int] = deque(maxlen=MAX_ENDED)
        self._dropped: Dict[str, int] = {}
        self._dropped_at_s: Dict[str, float] = {}
        protocol.register_operation("subscribe", self.subscribe)
        protocol.register_operation("unsubscribe", self.unsubscribe)
        protocol.server.topics.add(self)
        protocol.server.ticks.append(self.tick)

    def subscribe(self, message: Operation) -> None:
        """Each entry by itself: one that can't be made hinders none of the others."""
        for entry in entries(message, "subscriptions", dict):
            try:
                self._subscribe(number(entry, "id"), number(entry, "channelId"))
            except RosbridgeError as error:
                self.protocol.log("error", f"subscribe: {error}")

    def _subscribe(self, subscription_id: int, channel_id: int) -> None:
        channel = self._offered.get(channel_id)
        if channel is None:
            raise SubscriptionError(f"there is no channel {channel_id}")
        if subscription_id in self._streams:
            topic = self._streams[subscription_id].topic
            raise SubscriptionError(f"the subscription id {subscription_id} is in use for {topic}")
        if channel_id in self._subscribed:
            raise SubscriptionError(f"the channel {channel_id}, {channel.topic}, is subscribed to already")
        stream = Stream(self.protocol, subscription_id, channel)
        self._streams[subscription_id] = self._subscribed[channel_id] = stream
        stream.start()

    def unsubscribe(self, message: Operation) -> None:
        """Take subscriptions back."""
        for subscription_id in entries(message, "subscriptionIds", int):
            stream = self._streams.get(subscription_id)
            if stream is not None:
                self._end(stream)
            elif subscription_id in self._ended:
                self._ended.remove(subscription_id)
            else:
                self.protocol.log("warning", f"unsubscribe: there is no subscription {subscription_id}")

    def _end(self, stream: Stream) -> None:
        del self._streams[stream.id]
        del self._subscribed[stream.channel.id]
        stream.close()

    # Audience

    def channels_changed(self, change: Change) -> None:
        for channel in change.removed:
            self._offered.pop(channel.id, None)
            stream = self._subscribed.get(channel.id)
            if stream is not None:
                self._end(stream)
                self._ended.append(stream.id)
        for payload in change.payloads:
            self.protocol.send_payload(payload)
        self._offered.update({channel.id: channel for channel in change.added})

    def trouble_changed(self, topic: str, trouble: Optional[str]) -> None:
        if trouble is None:
            self.protocol.withdraw([f"topic:{topic}"])
        else:
            self.protocol.show(f"topic:{topic}", trouble)

    def tick(self) -> None:
        """Tell of messages that were dropped for this client, at most once per tick and topic."""
        now_s = self.protocol.loop.time()
        for topic, count in self.protocol.outbox.dropped.items():
            if count > self._dropped.get(topic, 0):
                self._dropped[topic] = count
                self._dropped_at_s[topic] = now_s
                self.protocol.show(
                    f"dropped:{topic}", f"{count} messages of {topic} were dropped: the connection is too slow for them"
                )
        over = [topic for topic, at_s in self._dropped_at_s.items() if now_s - at_s > DROPPED_SHOWN_S]
        for topic in over:
            del self._dropped_at_s[topic]
        self.protocol.withdraw([f"dropped:{topic}" for topic in over])

    def finish(self) -> None:
        self.protocol.server.topics.remove(self)
        self.protocol.server.ticks.remove(self.tick)
        for stream in list(self._streams.values()):
            self._end(stream)
