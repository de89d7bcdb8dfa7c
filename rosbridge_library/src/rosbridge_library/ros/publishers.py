# SPDX-License-Identifier: BSD-3-Clause
"""What the bridge publishes for its clients: one publisher per topic, shared by all who advertise it.

A publisher outlives the last client that advertised it by `unregister_timeout_s`, so that a page that is refreshed
finds it registered and connected, and loses nothing; and for as long as it keeps messages for others, see below.

ROS connects publishers and subscribers behind the back of both: a subscriber that was there before is told by the
master, asks where to connect, and connects, all after `advertise` has returned. So a new publisher notes which
subscribers the master knows (`expect`) and keeps what is published until each of them has connected, and got it, or
`WARM_UP_S` has passed. Nobody else waits for that.
"""

from __future__ import annotations

import asyncio
import logging
import struct
from collections import deque
from typing import Deque, Dict, Hashable, Iterable, List, Optional, Set, Type

import genpy
from rospy.impl.registration import Registration, get_topic_manager
from rospy.topics import _PublisherImpl

from rosbridge_library.codec import MessageType
from rosbridge_library.ros.tcpros import LoopTcprosHandler, NoPoller, OutboundConnection

logger = logging.getLogger("rosbridge.publishers")

WARM_UP_S = 5.0
DEFAULT_QUEUE_SIZE = 100
KEEPING_INTERVAL_S = 0.1
"""How often at the most it is looked whether a publisher without clients still keeps messages."""

_UINT32 = struct.Struct("<I")


class Publisher:
    """One topic that clients publish. Made by `Publishers.open`."""

    def __init__(
        self, topic: str, type_: MessageType, latch: bool, queue_size: int, rospy_publisher: _PublisherImpl
    ) -> None:
        self.topic = topic
        self.type = type_
        self.latch = latch
        self.queue_size = queue_size
        self.users: Set[Hashable] = set()
        self.lingering: Optional[asyncio.TimerHandle] = None
        self.published_messages = 0
        self.published_bytes = 0
        self._rospy = rospy_publisher
        self._seq = 0
        self._connections: List[OutboundConnection] = []
        self._latched: Optional[bytes] = None
        self._expected: Set[str] = set()  # node names of subscribers that will connect
        self._missed: Deque[bytes] = deque(maxlen=max(queue_size, 1))  # frames, while anybody is expected

    @property
    def subscribers(self) -> List[str]:
        """The names of the nodes that are connected now."""
        return [connection.subscriber for connection in self._connections]

    def publish(self, wire: bytes) -> None:
        """Send one message to every subscriber. `header.seq` counts up per publisher, as rospy does."""
        self._seq = (self._seq + 1) & 0xFFFFFFFF
        if self.type.has_header:
            wire = _UINT32.pack(self._seq) + wire[4:]
        frame = _UINT32.pack(len(wire)) + wire
        self.published_messages += 1
        self.published_bytes += len(wire)
        if self.latch:
            self._latched = frame
        if self._expected:
            self._missed.append(frame)
        for connection in list(self._connections):
            connection.send(frame)
        for connection in self._rospy.connections:
            if not isinstance(connection, OutboundConnection):  # this process publishes the topic itself: /rosout
                connection.write_data(frame)

    def expect(self, subscribers: Iterable[str]) -> None:
        """Keep what is published for these nodes until they connect; `stop_expecting` ends it."""
        self._expected = set(subscribers) - set(self.subscribers)

    def stop_expecting(self) -> None:
        """Nobody else will connect that was there before this publisher."""
        self._expected.clear()
        self._missed.clear()

    @property
    def keeps_messages(self) -> bool:
        """Whether there are messages for nodes that have not connected yet."""
        return bool(self._missed)

    def attach(self, connection: OutboundConnection) -> None:
        """A subscriber has connected: it gets what it has missed or, of a latched topic, the last message."""
        connection.queue_size = self.queue_size
        connection.on_close = lambda: self._connections.remove(connection)
        self._connections.append(connection)
        if connection.subscriber in self._expected:
            self._expected.discard(connection.subscriber)
            for frame in self._missed:
                connection.send(frame)
            if not self._expected:
                self._missed.clear()
        elif self._latched is not None:
            connection.send(self._latched)


class Publishers:
    """The publishers of this node, by topic."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        handler: LoopTcprosHandler,
        unregister_timeout_s: float,
    ) -> None:
        self._loop = loop
        self._handler = handler
        self._unregister_timeout_s = unregister_timeout_s
        self._publishers: Dict[str, Publisher] = {}

    def __len__(self) -> int:
        return len(self._publishers)

    def get(self, topic: str) -> Optional[Publisher]:
        """The publisher of `topic` (a global name), also while it outlives its last client."""
        return self._publishers.get(topic)

    def type_in_rospy(self, topic: str) -> Optional[str]:
        """The type of a topic that rospy itself publishes in this process (/rosout, client_count), or None."""
        publisher = None if topic in self._publishers else get_topic_manager().get_publisher_impl(topic)
        return None if publisher is None else str(publisher.data_class._type)

    def open(
        self,
        topic: str,
        type_: MessageType,
        user: Hashable,
        latch: bool,
        queue_size: int,
        subscribers: Iterable[str],
    ) -> Publisher:
        """The publisher of `topic` for `user`, made if there is none; `subscribers` are the topic's at the master.

        A publisher that nobody uses any more, but of another type or latching otherwise, gives way to a new one.
        """
        publisher = self._publishers.get(topic)
        if publisher is not None and not publisher.users and (publisher.type, publisher.latch) != (type_, latch):
            self._close(publisher)
            publisher = None
        if publisher is None:
            rospy_publisher = _advertise(topic, _raw_class(type_), latch)
            publisher = self._publishers[topic] = Publisher(topic, type_, latch, queue_size, rospy_publisher)
            publisher.expect(subscribers)
            self._loop.call_later(WARM_UP_S, publisher.stop_expecting)
            self._handler.outbound[topic] = publisher.attach
        if publisher.lingering is not None:
            publisher.lingering.cancel()
            publisher.lingering = None
        publisher.users.add(user)
        publisher.queue_size = max(publisher.queue_size, queue_size)
        return publisher

    def leave(self, publisher: Publisher, user: Hashable) -> None:
        """`user` publishes no more. After the last one the publisher lingers for `unregister_timeout_s`."""
        publisher.users.discard(user)
        if not publisher.users and publisher.lingering is None and self._publishers.get(publisher.topic) is publisher:
            publisher.lingering = self._loop.call_later(self._unregister_timeout_s, self._expire, publisher)

    def _expire(self, publisher: Publisher) -> None:
        if publisher.keeps_messages:
            wait_s = max(self._unregister_timeout_s, KEEPING_INTERVAL_S)
            publisher.lingering = self._loop.call_later(wait_s, self._expire, publisher)
        else:
            self._close(publisher)

    def _close(self, publisher: Publisher) -> None:
        if publisher.lingering is not None:
            publisher.lingering.cancel()
        del self._publishers[publisher.topic]
        del self._handler.outbound[publisher.topic]
        get_topic_manager().release_impl(Registration.PUB, publisher.topic)

    def close_all(self) -> None:
        """End every publisher now."""
        for publisher in list(self._publishers.values()):
            self._close(publisher)


class _LoopPublisher(_PublisherImpl):  # type: ignore[misc]  # rospy has no types
    """rospy's side of a publisher: what rospy registers and shows."""

    def __init__(self, topic: str, data_class: Type[genpy.Message]) -> None:
        super().__init__(topic, data_class)
        NoPoller.replace(self)


def _raw_class(type_: MessageType) -> Type[genpy.Message]:
    """A message class for rospy to register and to show in connection headers; it is never serialized."""

    class RawMessage(genpy.Message):  # type: ignore[misc]  # genpy has no types
        _md5sum = type_.md5sum
        _type = type_.name
        _has_header = False
        _full_text = type_.definition
        __slots__ = ()
        _slot_types = ()

    return RawMessage


def _advertise(topic: str, data_class: Type[genpy.Message], latch: bool) -> _PublisherImpl:
    """What rospy.Publisher does, without waiting for the master. Another publisher in this process is joined."""
    topics = get_topic_manager()
    with topics.lock:
        publisher = topics.pubs.get(topic)
        if publisher is None:
            publisher = _LoopPublisher(topic, data_class)
            publisher.is_latch = latch
            topics._add(publisher, topics.pubs, Registration.PUB)
        publisher.ref_count += 1
        return publisher
