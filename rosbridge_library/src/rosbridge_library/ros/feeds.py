# SPDX-License-Identifier: BSD-3-Clause
"""What the bridge receives: one feed per topic, shared by all clients of every protocol.

A `Feed` is one ROS subscriber. Its messages arrive as the bytes on the wire (see `tcpros`) and go, as `Message`s, to
every `Sink`: one per client and topic. What is made of a message for one client (JSON text, a CBOR frame) is kept with
the message, so that others who want the same get the same bytes. The topic's type comes with each publisher's
connection header, so types that are not installed here work, and so do several definitions at once.

A feed starts with its first sink and ends with its last. Its subscription is *live* when the master knows it and every
publisher that the master named answers, or failed to: from then on nothing that is published is missed.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Callable, Dict, Iterable, List, NamedTuple, Optional, Set, Tuple, Type

import genpy
from rospy.impl.registration import Registration, get_topic_manager
from rospy.impl.transport import Transport
from rospy.topics import _SubscriberImpl, _TopicImpl

from rosbridge_library.codec import MessageType, message_type_from_definition
from rosbridge_library.internal.exceptions import RosbridgeError
from rosbridge_library.ros.message import Message, Wire
from rosbridge_library.ros.outcome import know_outcome
from rosbridge_library.ros.tcpros import InboundConnection, LoopTcprosHandler, NoPoller, Receiver

if TYPE_CHECKING:
    from rosbridge_library.ros.registrar import Registrar

logger = logging.getLogger("rosbridge.feeds")

LIVE_TIMEOUT_S = 3.0
"""How long a publisher may take to answer before a subscription counts as live without it."""
ADDED_BY_PUBLISHER_S = 0.05
"""rospy and roscpp answer the handshake a moment before they add the subscriber to those that they send to."""


class Sink:
    """One client's interest in one topic."""

    def deliver(self, message: Message) -> None:
        """Take one message. Must not block, raise, or change the message."""
        raise NotImplementedError

    def deliver_latched(self, message: Message) -> None:
        """Take the last message of a latching publisher, which must not be dropped."""
        raise NotImplementedError


class Publication(NamedTuple):
    """One live publisher of a feed's topic: its node's name, its type, and whether it latches."""

    node: str
    type: MessageType
    latching: bool


class Feed(Receiver):
    """One topic that clients receive. Made by `Feeds.open`; ends when the last sink is removed."""

    def __init__(self, feeds: Feeds, topic: str) -> None:
        self.topic = topic
        self._feeds = feeds
        self._sinks: Tuple[Sink, ...] = ()  # replaced, never changed: a sink may leave while it is served
        self._publications: Dict[InboundConnection, Publication] = {}
        self._latched: Dict[InboundConnection, Message] = {}
        self._refused: Dict[str, str] = {}  # publisher uri: why
        self._uris: List[str] = []  # of the publishers that the master named
        self._changed = asyncio.Event()
        self._live: Optional[asyncio.Task[None]] = None
        self.received_messages = 0
        self.received_bytes = 0

    @property
    def publications(self) -> List[Publication]:
        """The publishers that are connected now."""
        return list(self._publications.values())

    @property
    def type(self) -> Optional[MessageType]:
        """The type of the newest publisher that is connected, if any."""
        return next((each.type for each in reversed(list(self._publications.values()))), None)

    def add(self, sink: Sink) -> None:
        """Give `sink` the latched messages, once each, and all that comes from now on."""
        self.replay(sink)
        self._sinks += (sink,)

    def replay(self, sink: Sink) -> None:
        """Give `sink` the latched messages, once each."""
        for message in list(self._latched.values()):
            sink.deliver_latched(message)

    def remove(self, sink: Sink) -> None:
        """Give `sink` nothing more; ends the feed when it was the last. A sink that isn't there is left alone."""
        self._sinks = tuple(each for each in self._sinks if each is not sink)
        if not self._sinks:
            self._feeds.close(self)

    async def live(self) -> None:
        """Wait until nothing that is published is missed, but by publishers that don't answer within LIVE_TIMEOUT_S.

        While the master is away this waits for it. Raises MasterError when the master refuses the subscription.
        """
        if self._live is None or self._live.cancelled() or (self._live.done() and self._live.exception()):
            self._live = self._feeds.loop.create_task(self._become_live())
            self._live.add_done_callback(know_outcome)
        await asyncio.shield(self._live)

    async def _become_live(self) -> None:
        uris = await asyncio.wrap_future(self._feeds.registrar.settled(Registration.SUB, self.topic))
        self._uris = uris
        publishers = set(uris)
        await self._wait_until(lambda: publishers <= self._connected() | set(self._refused), self._feeds.loop.time())
        if publishers:
            await asyncio.sleep(ADDED_BY_PUBLISHER_S)

    @property
    def complete(self) -> bool:
        """Whether every publisher that the master named is connected."""
        return set(self._uris) <= self._connected()

    async def unreachable(self, publishers: Iterable[str], since_s: float) -> Dict[str, str]:
        """Which of these nodes, publishers of the topic, are not connected, and why not.

        They have LIVE_TIMEOUT_S from `since_s`, a time of the loop.
        """

        def missing() -> Set[str]:
            return set(publishers) - {publication.node for publication in self._publications.values()}

        await self._wait_until(lambda: not missing(), since_s)
        reason = "; ".join(sorted(set(self._refused.values()))) or "it does not answer"
        return dict.fromkeys(sorted(missing()), reason)

    async def _wait_until(self, condition: Callable[[], bool], since_s: float) -> None:
        """Return when `condition` holds, which connections change, or LIVE_TIMEOUT_S are over."""
        deadline = since_s + LIVE_TIMEOUT_S
        while not condition():
            self._changed.clear()
            try:
                await asyncio.wait_for(self._changed.wait(), deadline - self._feeds.loop.time())
            except asyncio.TimeoutError:
                return

    def _connected(self) -> Set[str]:
        return {connection.endpoint_id for connection in self._publications}

    def end(self) -> None:
        """Stop waiting; called by `Feeds.close`."""
        if self._live is not None:
            self._live.cancel()

    # Receiver

    def connected(self, connection: InboundConnection) -> None:
        header = connection.header
        try:
            type_ = message_type_from_definition(
                header["type"], header.get("message_definition", ""), header.get("md5sum")
            )
        except RosbridgeError as error:
            logger.error("%s: %s publishes what can't be understood: %s", self.topic, connection.endpoint_id, error)
            self._refused[connection.endpoint_id] = str(error)
        else:
            self._refused.pop(connection.endpoint_id, None)
            self._publications[connection] = Publication(header.get("callerid", "unknown"), type_, connection.latching)
        self._changed.set()

    def received(self, connection: InboundConnection, wire: Wire) -> None:
        publication = self._publications.get(connection)
        if publication is None:
            return  # of a type that can't be understood
        self.received_messages += 1
        self.received_bytes += len(wire)
        replayed = publication.latching and connection not in self._latched
        message = Message(self.topic, publication.type, wire, self._feeds.now(), replayed)
        if publication.latching:
            self._latched[connection] = message
        for sink in self._sinks:
            sink.deliver(message)

    def disconnected(self, connection: InboundConnection) -> None:
        self._publications.pop(connection, None)
        self._latched.pop(connection, None)
        self._refused.pop(connection.endpoint_id, None)

    def refused(self, connection: InboundConnection, reason: str) -> None:
        self._refused[connection.endpoint_id] = reason
        self._changed.set()


class Feeds:
    """The feeds of this node, by topic."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        handler: LoopTcprosHandler,
        registrar: Registrar,
        now: Callable[[], Tuple[int, int]],
    ) -> None:
        self.loop = loop
        self.registrar = registrar
        self.now = now
        self._handler = handler
        self._feeds: Dict[str, Feed] = {}

    def __len__(self) -> int:
        return len(self._feeds)

    def get(self, topic: str) -> Optional[Feed]:
        """The feed of `topic` (a global name), if a client receives it."""
        return self._feeds.get(topic)

    def open(self, topic: str, type_name: Optional[str]) -> Feed:
        """The feed of `topic`, made if there is none. `type_name` is what the master is told, when it is known."""
        feed = self._feeds.get(topic)
        if feed is None:
            feed = self._feeds[topic] = Feed(self, topic)
            self._handler.inbound[topic] = feed
            for connection in _subscribe(topic, _any_type(type_name or "*")):
                if isinstance(connection, InboundConnection) and connection.socket is not None:
                    feed.connected(connection)
        return feed

    def close(self, feed: Feed) -> None:
        """End `feed`: the ROS subscriber goes."""
        if self._feeds.get(feed.topic) is not feed:
            return
        del self._feeds[feed.topic]
        feed.end()
        get_topic_manager().release_impl(Registration.SUB, feed.topic)
        del self._handler.inbound[feed.topic]

    def close_all(self) -> None:
        """End every feed."""
        for feed in list(self._feeds.values()):
            self.close(feed)


class _FeedSubscriber(_SubscriberImpl):  # type: ignore[misc]  # rospy has no types
    """rospy's side of a feed: what rospy registers and shows. It never deserializes.

    rospy's own constructor asks the parameter server, blocking, whether topic statistics are wanted; this one doesn't.
    """

    def __init__(self, topic: str, data_class: Type[genpy.Message]) -> None:
        _TopicImpl.__init__(self, topic, data_class)
        NoPoller.replace(self)
        self.callbacks: List[object] = []
        self.queue_size = None
        self.buff_size = 65536
        self.tcp_nodelay = True
        self.statistics_logger = None


def _any_type(type_name: str) -> Type[genpy.Message]:
    """A message class that takes whatever is published; `type_name` is for the master's and the tools' eyes."""

    class AnyMessage(genpy.Message):  # type: ignore[misc]
        _md5sum = "*"
        _type = type_name
        _has_header = False
        _full_text = ""
        __slots__ = ()
        _slot_types = ()

    return AnyMessage


def _subscribe(topic: str, data_class: Type[genpy.Message]) -> List[Transport]:
    """What rospy.Subscriber does, without waiting for the master.

    Another subscriber in this process (rospy's own, of /clock) is joined: then there may be connections already.
    """
    topics = get_topic_manager()
    with topics.lock:
        subscriber = topics.subs.get(topic)
        if subscriber is None:
            subscriber = _FeedSubscriber(topic, data_class)
            topics._add(subscriber, topics.subs, Registration.SUB)
        subscriber.ref_count += 1
        return list(subscriber.connections)
