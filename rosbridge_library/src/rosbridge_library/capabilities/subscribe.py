# SPDX-License-Identifier: BSD-3-Clause
"""subscribe and unsubscribe (specification 3.4.4, 3.4.5).

A client may subscribe to a topic several times, each with an id and wishes of its own, and gets one stream: at the
lowest throttle_rate, with the lowest fragment_size and the highest queue_length of them, in the encoding that was
asked for last. Taking one back reckons the stream anew.
"""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING, Awaitable, Deque, Dict, Hashable, List, NamedTuple, Optional, Sequence

from rosbridge_library.capabilities.publication import AccessDenied, TopicConflict
from rosbridge_library.capability import Capability, Operation, on_loop
from rosbridge_library.codec import get_message_type
from rosbridge_library.encodings import TOPIC_ENCODINGS, EncodeError, in_fragments
from rosbridge_library.internal.exceptions import InvalidArgumentException, TypeLoadError, WireError
from rosbridge_library.internal.ros_loader import canonical_type_name
from rosbridge_library.names import checked_global_name
from rosbridge_library.payload import Payload
from rosbridge_library.ros.feeds import Feed, Sink
from rosbridge_library.ros.graph import TopicInfo
from rosbridge_library.ros.master import MasterError, MasterUnreachable
from rosbridge_library.ros.message import Message
from rosbridge_library.ros.node import RosTimeout

if TYPE_CHECKING:
    from rosbridge_library.protocol import Protocol

COMPRESSIONS = ("none", "png", "cbor", "cbor-raw")
MAX_THROTTLE_RATE_MS = 1e12
MAX_HELD_BYTES = 64 * 1024 * 1024
"""How much a throttle may hold back for one subscription."""


class Wishes(NamedTuple):
    """What one subscribe operation asks for."""

    throttle_rate_ms: float = 0
    queue_length: int = 0
    fragment_size: Optional[int] = None
    compression: str = "none"


class Stream(Sink):
    """What one client gets of one topic. `topic` is the name as the client wrote it, which it reads in each message."""

    def __init__(self, protocol: Protocol, topic: str, feed: Feed, type_name: Optional[str]) -> None:
        self.topic = topic
        self.keep = 1
        self.type_name = type_name
        self.feed = feed
        self.wishes: Dict[Hashable, Wishes] = {}
        self.throttled = 0
        """How many messages the throttle dropped."""
        self._protocol = protocol
        self._compression = "none"
        self._fragment_size: Optional[int] = None
        self._interval_s = 0.0
        self._held: Deque[Message] = deque()
        self._held_bytes = 0
        self._timer: Optional[asyncio.TimerHandle] = None  # while it runs, messages are held back
        self._sent_at_s = 0.0  # on the loop's clock, which is monotonic
        self._told: Optional[str] = None  # the last trouble that the client was told of

    def ask(self, subscription_id: Hashable, wishes: Wishes) -> bool:
        """Add a subscription, or change the wishes of one; whether it is a new one."""
        before = self.wishes.pop(subscription_id, None)  # what was asked last comes last
        self.wishes[subscription_id] = wishes
        self._reckon()
        return before is None

    def take_back(self, subscription_id: Hashable) -> bool:
        """Remove a subscription; False when there is none of this id."""
        if self.wishes.pop(subscription_id, None) is None:
            return False
        if self.wishes:
            self._reckon()
        return True

    def _reckon(self) -> None:
        every = list(self.wishes.values())
        sizes = [each.fragment_size for each in every if each.fragment_size is not None]
        queue_length = max(each.queue_length for each in every)
        self.keep = max(queue_length, 1)
        self._interval_s = min(each.throttle_rate_ms for each in every) / 1000.0
        self._fragment_size = self._protocol.fragment_size(min(sizes) if sizes else None)
        asked = [each.compression for each in every if each.compression != "none"]
        self._compression = self._protocol.encoding(asked[-1] if asked else "none")
        self._drop_oldest()
        if not self._interval_s:
            self._release()
        elif self._timer is not None:
            self._wait()  # the interval may end sooner, or later

    def close(self) -> None:
        """No more messages go to the client."""
        self.feed.remove(self)
        self._held.clear()
        self._held_bytes = 0
        if self._timer is not None:
            self._timer.cancel()
        self._protocol.outbox.forget(self)

    # Sink

    def deliver(self, message: Message) -> None:
        if not self._is_expected(message):
            return
        if message.replayed:
            self._send(message)
        elif not self._interval_s:
            self._protocol.outbox.offer(self, message, len(message.wire))
        elif self._timer is None:
            self._offer_and_wait(message)
        else:
            self._held.append(message)
            self._held_bytes += len(message.wire)
            self._drop_oldest()

    def deliver_latched(self, message: Message) -> None:
        if self._is_expected(message):
            self._send(message)

    def _send(self, message: Message) -> None:
        """Past throttle and queue, so that the last message of every latching publisher gets there."""
        for payload in self.encode(message):
            self._protocol.outbox.send(payload)

    def _offer_and_wait(self, message: Message) -> None:
        self._protocol.outbox.offer(self, message, len(message.wire))
        self._sent_at_s = self._protocol.loop.time()
        self._wait()

    def _wait(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._protocol.loop.call_at(self._sent_at_s + self._interval_s, self._interval_over)

    def _interval_over(self) -> None:
        """The head of what was held back goes out when the interval ends, so that a topic never goes stale."""
        self._timer = None
        if self._held:
            self._offer_and_wait(self._next_held())

    def _release(self) -> None:
        """The throttle is gone: so is its reason to hold anything back."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        while self._held:
            message = self._next_held()
            self._protocol.outbox.offer(self, message, len(message.wire))

    def _next_held(self) -> Message:
        message = self._held.popleft()
        self._held_bytes -= len(message.wire)
        return message

    def _drop_oldest(self) -> None:
        """Hold back no more than was asked for, nor than is good for the server; the newest message stays."""
        while len(self._held) > 1 and (len(self._held) > self.keep or self._held_bytes > MAX_HELD_BYTES):
            self._next_held()
            self.throttled += 1

    def _is_expected(self, message: Message) -> bool:
        if self.type_name is None or message.type.name == self.type_name:
            return True
        self._tell_once(f"subscribe: {self.topic} is published as {message.type.name}, not {self.type_name}")
        return False

    def _tell_once(self, trouble: str) -> None:
        if self._told != trouble:
            self._told = trouble
            self._protocol.log("error", trouble, next(reversed(list(self.wishes)), None))  # type: ignore[arg-type]

    # Source

    def encode(self, message: object) -> Sequence[Payload]:
        """The payloads of a message of this stream; none of one that can't be read, of which the client is told."""
        assert isinstance(message, Message)
        try:
            return message.encoded((self._compression, self.topic, self._fragment_size), self._encode)
        except WireError as error:
            self._tell_once(f"subscribe: a message on {self.topic} is no {message.type.name}: {error}")
        except EncodeError as error:
            self._tell_once(f"subscribe: a message on {self.topic} is dropped: {error}")
        return ()

    def _encode(self, message: Message) -> List[Payload]:
        payload = TOPIC_ENCODINGS[self._compression](self.topic, message)
        return in_fragments(payload, self._fragment_size)


class Subscribe(Capability):
    """Sends a client the messages of topics."""

    subscribe_msg_fields = (
        (True, "topic", str),
        (False, "type", str),
        (False, "throttle_rate", (int, float)),
        (False, "queue_length", int),
        (False, "fragment_size", int),
        (False, "compression", str),
    )
    unsubscribe_msg_fields = ((True, "topic", str),)

    def __init__(self, protocol: Protocol) -> None:
        super().__init__(protocol)
        self._streams: Dict[str, Stream] = {}
        protocol.register_operation("subscribe", self.subscribe)
        protocol.register_operation("unsubscribe", self.unsubscribe)

    @on_loop
    def subscribe(self, message: Operation) -> Optional[Awaitable[None]]:
        """Subscribe to a topic. The info status that answers comes when nothing published is missed any more."""
        self.basic_type_check(message, self.subscribe_msg_fields)
        topic = message["topic"]
        name = checked_global_name(topic, "topic")
        if not self.protocol.node.access.may_subscribe(name):
            raise AccessDenied(f"the server does not let clients subscribe to {topic}")
        wishes = _wishes(message)
        type_name = canonical_type_name(message["type"], "msg") if message.get("type") not in (None, "*") else None
        stream = self._streams.get(topic)
        if stream is None:
            return self._open(self.protocol.node.resolve(name), type_name, wishes, message)
        if type_name is not None and stream.type_name not in (None, type_name):
            raise TopicConflict(f"{topic} is already subscribed to as {stream.type_name}, not {type_name}")
        if stream.ask(message.get("id"), wishes):
            stream.feed.replay(stream)  # the part of a page that came later waits for the map, too
        self.protocol.spawn(self._confirm(stream, message), message)
        return None

    async def _open(self, name: str, type_name: Optional[str], wishes: Wishes, message: Operation) -> None:
        present = await self._present_type(name, type_name, message)
        if type_name is not None and present not in ("", type_name):
            raise TopicConflict(f"{name} has type {present}, not {type_name}")
        if not present:
            await self._tell_what_is_awaited(name, type_name, message)
        if self.protocol.finished:
            return
        topic = message["topic"]
        feed = self.protocol.node.feeds.open(name, present or type_name)
        stream = self._streams[topic] = Stream(self.protocol, topic, feed, type_name)
        stream.ask(message.get("id"), wishes)
        feed.add(stream)
        self.protocol.spawn(self._confirm(stream, message), message)

    async def _present_type(self, name: str, type_name: Optional[str], message: Operation) -> str:
        """The type that the topic has now; "" when it has none, or, with the client told, the master is away."""
        feed = self.protocol.node.feeds.get(name)
        if feed is not None and feed.type is not None:
            return feed.type.name
        try:
            # A page subscribes to many topics at once: what the master said just now will do, unless it is bad news.
            info: TopicInfo = await self.protocol.node.topic(name, max_age_s=1.0)
            if not info.type or type_name not in (None, info.type):
                info = await self.protocol.node.topic(name)
        except (MasterUnreachable, MasterError, RosTimeout) as error:
            self.protocol.log("error", f"subscribe: {error}; {name} follows when it is back", message.get("id"))
            return ""
        return info.type

    async def _tell_what_is_awaited(self, name: str, type_name: Optional[str], message: Operation) -> None:
        """A topic that nobody publishes yet is subscribed to all the same; say what may be wrong with it."""
        if type_name is None:
            reason = f"{name} does not exist yet and no type was given; its messages follow when it is published"
            self.protocol.log("error", f"subscribe: {reason}", message.get("id"))
            return
        try:
            await self.protocol.node.call(get_message_type, type_name)
        except TypeLoadError as error:
            reason = f"{name} does not exist yet, and its type {type_name} is not installed here: {error}"
            self.protocol.log("error", f"subscribe: {reason}", message.get("id"))

    async def _confirm(self, stream: Stream, message: Operation) -> None:
        begin_s = self.protocol.loop.time()
        await stream.feed.live()
        unreachable = await self._unreachable_publishers(stream.feed, begin_s)
        lid = message.get("id")
        if self._streams.get(stream.topic) is not stream or lid not in stream.wishes:
            return
        for node, reason in unreachable.items():
            trouble = f"{node}, which publishes {stream.topic}, can't be reached: {reason}"
            self.protocol.log("error", f"subscribe: {trouble}", lid)
        self.protocol.log("info", f"subscribe: {stream.topic} is subscribed to", lid)

    async def _unreachable_publishers(self, feed: Feed, since_s: float) -> Dict[str, str]:
        """By name: the master also lists the old address of a node that died and was started again."""
        if feed.complete:
            return {}
        try:
            info = await self.protocol.node.topic(feed.topic)
        except (MasterUnreachable, MasterError, RosTimeout):
            return {}  # nobody knows, and what is connected goes on
        return await feed.unreachable(info.publishers, since_s)

    @on_loop
    def unsubscribe(self, message: Operation) -> None:
        """Take back one subscription, or all to a topic when no id is given."""
        self.basic_type_check(message, self.unsubscribe_msg_fields)
        topic, lid = message["topic"], message.get("id")
        stream = self._streams.get(topic)
        if stream is None or (lid is not None and not stream.take_back(lid)):
            self.protocol.log("warning", f"unsubscribe: {topic} was not subscribed to by this client", lid)
            return
        if lid is None or not stream.wishes:
            del self._streams[topic]
            stream.close()
        self.protocol.log("info", f"unsubscribe: {topic} is no longer subscribed to", lid)

    def finish(self) -> None:
        for stream in self._streams.values():
            stream.close()
        self._streams.clear()


def _wishes(message: Operation) -> Wishes:
    throttle_rate = message.get("throttle_rate") or 0
    queue_length = message.get("queue_length") or 0
    fragment_size = message.get("fragment_size")
    compression = message.get("compression") or "none"
    if not 0 <= throttle_rate < float("inf") or queue_length < 0:
        raise InvalidArgumentException("the fields 'throttle_rate' and 'queue_length' must not be negative")
    if fragment_size is not None and fragment_size < 1:
        raise InvalidArgumentException("the field 'fragment_size' must be 1 or more")
    if compression not in COMPRESSIONS:
        raise InvalidArgumentException(f"the field 'compression' must be one of {', '.join(COMPRESSIONS)}")
    return Wishes(min(throttle_rate, MAX_THROTTLE_RATE_MS), queue_length, fragment_size, compression)
