# SPDX-License-Identifier: BSD-3-Clause
"""The channels that this server offers: one per topic that somebody publishes, the same for all clients.

The master names a topic's type. Its definition is that of the installed package, or else what a publisher tells in
its connection header. A channel's id belongs to its topic, type and definition: it comes back when they do.
"""

from __future__ import annotations

import asyncio
import logging
from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Set

from rosbridge_library.codec import MessageType, get_message_type
from rosbridge_library.foxglove import messages
from rosbridge_library.foxglove.latest import Latest
from rosbridge_library.foxglove.offer import Change, Ids
from rosbridge_library.foxglove.options import Options, matches
from rosbridge_library.internal.exceptions import RosbridgeError
from rosbridge_library.ros.feeds import Feed
from rosbridge_library.ros.graph import Graph
from rosbridge_library.ros.node import Node
from rosbridge_library.ros.topic_probe import probe_topic

logger = logging.getLogger("rosbridge.foxglove")

PROBE_TIMEOUT_S = 2.0
PROBES_AT_ONCE = 4
RETRY_S = 5.0

ANY_TYPE = "*"


class Channel(NamedTuple):
    """One topic as clients see it."""

    id: int
    topic: str
    type: MessageType

    def advertisement(self) -> Dict[str, Any]:
        """Its entry in an advertise message."""
        return messages.channel(self.id, self.topic, self.type)


class Audience:
    """Who is told of channels: each client."""

    def channels_changed(self, change: Change) -> None:
        """Take a change of the channels."""
        raise NotImplementedError

    def trouble_changed(self, topic: str, trouble: Optional[str]) -> None:
        """Why a topic has no channel; None when that is over."""
        raise NotImplementedError


class Topics:
    """The channels, by topic. Belongs to the node's loop."""

    def __init__(self, node: Node, options: Options) -> None:
        self.channels: Dict[str, Channel] = {}
        self.troubles: Dict[str, str] = {}
        self.known = False
        """Whether the master has been asked: before, nobody knows what there is."""
        self._node = node
        self._options = options
        self._audiences: List[Audience] = []
        self._ids = Ids()
        self._whole: Optional[Change] = None  # what a new client is told, if that is made already
        self._installed: Dict[str, Optional[MessageType]] = {}
        self._learnt: Dict[str, MessageType] = {}  # by topic, from publishers
        self._probes: Dict[str, asyncio.Task[None]] = {}
        self._probe_slots = asyncio.Semaphore(PROBES_AT_ONCE)
        self._retry_at_s: Dict[str, float] = {}
        self._settled: Optional[Graph] = None  # the graph of which every topic has its channel
        self._following: Latest[Graph] = Latest(self._follow)

    def may_see(self, topic: str) -> bool:
        """Whether clients may know of `topic`."""
        return self._node.access.may_subscribe(topic) and matches(self._options.topic_whitelist, topic)

    def add(self, audience: Audience) -> None:
        """Tell `audience` of all that is there, if that is known yet, and of every change."""
        self._audiences.append(audience)
        if self.known:
            if self._whole is None:
                self._whole = _change(list(self.channels.values()), ())
            audience.channels_changed(self._whole)
        for topic, trouble in self.troubles.items():
            audience.trouble_changed(topic, trouble)

    def remove(self, audience: Audience) -> None:
        """Tell it no more."""
        self._audiences.remove(audience)

    def follow(self, graph: Optional[Graph]) -> None:
        """Bring the channels in line with the graph; without one, what there is stays."""
        if graph is not None:
            self._following.take(graph)
        elif not self.known:
            self._tell((), ())  # clients are promised one message in any case

    def forget(self) -> None:
        """Nobody follows the graph any more: what there is will be found anew. Ids stay."""
        self._following.cancel()
        for probe in self._probes.values():
            probe.cancel()
        self.channels.clear()
        self._whole = None
        self.troubles.clear()
        self._retry_at_s.clear()
        self._learnt.clear()
        self._settled = None
        self.known = False

    def correct(self, channel: Channel, feed: Feed, found: MessageType) -> bool:
        """A message of `channel` is of another definition: if all its publishers' are, the channel is replaced."""
        expected = channel.type
        others = {publication.type.md5sum for publication in feed.publications}
        if found.name != expected.name or expected.md5sum in others or self.channels.get(channel.topic) != channel:
            return False
        self._learnt[channel.topic] = found
        self._replace({channel.topic: found})
        return True

    async def _follow(self, graph: Graph) -> None:
        if graph is self._settled:
            return
        published = {
            topic: graph.types.get(topic, ANY_TYPE)
            for topic, nodes in graph.publishers.items()
            if nodes and self.may_see(topic)
        }
        await self._load({name for name in published.values() if name != ANY_TYPE and name not in self._installed})
        self._forget_all_but(published)
        types: Dict[str, MessageType] = {}
        for topic, name in published.items():
            type_ = self._type(topic, name)
            if type_ is not None:
                types[topic] = type_
            else:
                self._learn(topic, graph.publishers[topic])
        gone = [channel for topic, channel in self.channels.items() if topic not in types]
        self._replace(types, gone)
        self._settled = graph if len(types) == len(published) else None

    def _forget_all_but(self, published: Dict[str, str]) -> None:
        for topic in [topic for topic in self._learnt if topic not in published]:
            del self._learnt[topic]
        for topic in [topic for topic in self._retry_at_s if topic not in published]:
            del self._retry_at_s[topic]
            self._trouble(topic, None)

    def _type(self, topic: str, name: str) -> Optional[MessageType]:
        learnt = self._learnt.get(topic)
        if learnt is not None and name in (learnt.name, ANY_TYPE):
            return learnt
        installed = self._installed.get(name)
        if installed is not None:
            return installed
        feed = self._node.feeds.get(topic)
        received = None if feed is None else feed.type
        return received if received is not None and name in (received.name, ANY_TYPE) else None

    async def _load(self, names: Set[str]) -> None:
        if names:
            self._installed.update(await self._node.call(_load_installed, sorted(names)))

    def _learn(self, topic: str, publishers: List[str]) -> None:
        loop = self._node.loop
        if topic not in self._probes and self._retry_at_s.get(topic, 0.0) <= loop.time():
            self._probes[topic] = loop.create_task(self._probe(topic, publishers))

    async def _probe(self, topic: str, publishers: List[str]) -> None:
        try:
            async with self._probe_slots:
                type_ = await self._node.call(probe_topic, self._node.master, topic, publishers, PROBE_TIMEOUT_S)
        except RosbridgeError as error:
            self._retry_at_s[topic] = self._node.loop.time() + RETRY_S
            self._trouble(topic, f"{topic} is not available: {error}")
        except Exception:  # a bug; the topic stays without a channel, and this is its only trace
            logger.exception("asking for the type of %s failed", topic)
        else:
            self._retry_at_s.pop(topic, None)
            self._learnt[topic] = type_
            self._trouble(topic, None)
            self._replace({topic: type_})
        finally:
            del self._probes[topic]

    def _trouble(self, topic: str, trouble: Optional[str]) -> None:
        if self.troubles.get(topic) == trouble:
            return
        if trouble is None:
            del self.troubles[topic]
        else:
            logger.warning("%s", trouble)
            self.troubles[topic] = trouble
        for audience in list(self._audiences):
            audience.trouble_changed(topic, trouble)

    def _replace(self, types: Dict[str, MessageType], gone: Sequence[Channel] = ()) -> None:
        """Have the channels of these topics be of these types, without those that are `gone`."""
        removed: List[Channel] = list(gone)
        added: List[Channel] = []
        for topic, type_ in types.items():
            channel = Channel(self._ids.of((topic, type_.name, type_.definition)), topic, type_)
            present = self.channels.get(topic)
            if present is not None and present.id == channel.id:
                continue
            if present is not None:
                removed.append(present)
            added.append(channel)
        for channel in removed:
            del self.channels[channel.topic]
        self.channels.update({channel.topic: channel for channel in added})
        if added or removed or not self.known:
            self._tell(added, removed)

    def _tell(self, added: Sequence[Channel], removed: Sequence[Channel]) -> None:
        self.known = True
        self._whole = None
        change = _change(added, removed)
        for audience in list(self._audiences):
            audience.channels_changed(change)


def _change(added: Sequence[Channel], removed: Sequence[Channel]) -> Change:
    payloads = []
    if removed:
        payloads.append(messages.text({"op": "unadvertise", "channelIds": [channel.id for channel in removed]}))
    if added or not removed:
        payloads.append(messages.text({"op": "advertise", "channels": [each.advertisement() for each in added]}))
    return Change(added, removed, payloads)


def _load_installed(names: Sequence[str]) -> Dict[str, Optional[MessageType]]:
    """The installed types of these names, None for those that are not; blocking."""
    return {name: _installed_type(name) for name in names}


def _installed_type(name: str) -> Optional[MessageType]:
    try:
        return get_message_type(name)
    except RosbridgeError as error:
        logger.debug("%s is learnt from its publishers: %s", name, error)
        return None
