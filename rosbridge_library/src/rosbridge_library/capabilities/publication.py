# SPDX-License-Identifier: BSD-3-Clause
"""Which topics one client advertises: what the advertise and publish operations share.

A topic can be advertised several times, each with an id of its own, and is advertised until all have been taken back.
Publishing on a topic that was not advertised advertises it, if its type is known.
"""

from __future__ import annotations

from typing import Dict, Hashable, List, Optional, Set

from rospy.impl.registration import Registration

from rosbridge_library.capability import OperationId
from rosbridge_library.codec import MessageType, get_message_type, message_type_from_definition
from rosbridge_library.internal.exceptions import RosbridgeError, TypeLoadError
from rosbridge_library.internal.ros_loader import canonical_type_name
from rosbridge_library.names import checked_global_name
from rosbridge_library.protocol import Protocol
from rosbridge_library.ros.graph import TopicInfo
from rosbridge_library.ros.master import MasterUnreachable
from rosbridge_library.ros.node import Node, RosTimeout
from rosbridge_library.ros.publishers import DEFAULT_QUEUE_SIZE, Publisher

MAX_QUEUE_SIZE = 2**31 - 1


class TopicConflict(RosbridgeError):
    """A topic has another type, or none that is known."""


class ClientGone(RosbridgeError):
    """The client has left before what it asked for could begin."""


class AccessDenied(RosbridgeError):
    """The server's globs close this name to clients."""


class Publications:
    """The topics that one client publishes, by the name that it wrote."""

    def __init__(self, protocol: Protocol) -> None:
        self._protocol = protocol
        self._publishers: Dict[str, Publisher] = {}
        self._ids: Dict[str, Set[Hashable]] = {}

    @property
    def node(self) -> Node:
        """The shared ROS side."""
        return self._protocol.node

    def get(self, topic: str) -> Optional[Publisher]:
        """The publisher of `topic`, as the client wrote it, if the client advertises it."""
        return self._publishers.get(topic)

    async def advertise(
        self,
        topic: str,
        type_name: Optional[str],
        advertise_id: OperationId,
        latch: bool,
        queue_size: Optional[int],
        definition: Optional[str] = None,
    ) -> Publisher:
        """Advertise `topic`, of the type that it has when none is given.

        `definition` is the full text of the type, for one that is not installed here.

        Raises InvalidArgumentException for an illegal name, AccessDenied, TypeLoadError, DefinitionError,
        TopicConflict, MasterError.
        """
        name = checked_global_name(topic, "topic")
        if not self.node.access.may_publish(name):
            raise AccessDenied(f"the server does not let clients publish {topic}")
        name = self.node.resolve(name)
        info: Optional[TopicInfo] = None
        type_ = self._type_of_ours(name, type_name, latch) if definition is None else None
        if type_ is None:
            info = await self._look_up(name, type_name, advertise_id)
            type_ = await self._type(name, type_name, info, definition)
            self._may_still_open(name, type_)
        publisher = self.node.publishers.open(
            name,
            type_,
            self._protocol,
            latch,
            DEFAULT_QUEUE_SIZE if queue_size is None else min(queue_size, MAX_QUEUE_SIZE),
            self._subscribers(name, info),
        )
        self._publishers[topic] = publisher
        self._ids.setdefault(topic, set()).add(advertise_id)
        if info is not None:
            await self._register(name, advertise_id)
        return publisher

    async def _register(self, name: str, lid: OperationId) -> None:
        try:
            await self.node.registered(Registration.PUB, name)
        except MasterUnreachable as error:
            self._protocol.log("error", f"{error}; {name} will be advertised when it is back", lid)

    def _subscribers(self, name: str, info: Optional[TopicInfo]) -> List[str]:
        """The nodes that subscribe to a topic: this one too, from before the master knows of it."""
        ours = [] if self.node.feeds.get(name) is None else [self.node.caller_id]
        return ours if info is None else info.subscribers + ours

    def _type_of_ours(self, name: str, type_name: Optional[str], latch: bool) -> Optional[MessageType]:
        """The type of a publisher that is there and fits: a page that comes back waits for nobody."""
        ours = self.node.publishers.get(name)
        if ours is None or not (ours.users or ours.latch == latch):
            return None
        return ours.type if type_name is None or canonical_type_name(type_name, "msg") == ours.type.name else None

    def _may_still_open(self, name: str, type_: MessageType) -> None:
        """Raise for what has changed while the master was asked."""
        if self._protocol.ended:
            raise ClientGone(f"the client is gone; {name} is not advertised for it")
        ours = self.node.publishers.get(name)
        if ours is not None and ours.users and ours.type.name != type_.name:
            raise TopicConflict(f"{name} is already advertised by clients as {ours.type.name}, not {type_.name}")

    async def _look_up(self, name: str, type_name: Optional[str], lid: OperationId) -> Optional[TopicInfo]:
        """What the master says, or None, with the client told, while it is away and the type is known without it."""
        try:
            return await self.node.topic(name)
        except (MasterUnreachable, RosTimeout) as error:
            if type_name is None and self.node.publishers.get(name) is None:
                raise
            self._protocol.log("error", f"{error}; {name} will be advertised when it is back", lid)
            return None

    async def _type(
        self, name: str, type_name: Optional[str], info: Optional[TopicInfo], definition: Optional[str]
    ) -> MessageType:
        ours = self.node.publishers.get(name)
        if ours is not None and (ours.users or type_name is None):
            given = ours.type if type_name is None else await self._given(type_name, definition)
            if ours.type.name != given.name:
                raise TopicConflict(f"{name} is already advertised by clients as {ours.type.name}, not {type_name}")
            if ours.type.md5sum != given.md5sum:
                raise TopicConflict(f"{name} is already advertised by clients with another version of {type_name}")
            return ours.type
        present = self.node.publishers.type_in_rospy(name) or ""
        if info is not None and self._used_by_others(info):
            present = info.type
        if type_name is None:
            if info is not None:
                present = present or info.type  # of a client that waits for it
            if not present:
                raise TopicConflict(f"{name} does not exist, so it has no type: advertise it with one first")
            return await self._installed(present)
        type_ = await self._given(type_name, definition)
        if present not in ("", type_.name):
            users = ", ".join(info.publishers or info.subscribers) if info is not None else ""
            raise TopicConflict(f"{name} already has type {present}, not {type_.name}; it is used by {users}")
        return type_

    async def _given(self, type_name: str, definition: Optional[str]) -> MessageType:
        """The type that the client names, which must be the one that it defines, if it does."""
        if definition is None:
            return await self._installed(type_name)
        defined = message_type_from_definition(type_name, definition)
        try:
            installed = await self._installed(type_name)
        except TypeLoadError:
            return defined
        if defined.md5sum != installed.md5sum:
            raise TopicConflict(f"{type_name} is defined here in another way than the client defines it")
        return installed

    async def _installed(self, type_name: str) -> MessageType:
        return await self.node.call(get_message_type, type_name)

    def _used_by_others(self, info: TopicInfo) -> bool:
        return any(node != self.node.caller_id for node in info.publishers + info.subscribers)

    def unadvertise(self, topic: str, advertise_id: Optional[Hashable]) -> bool:
        """Take back one advertisement of `topic`, or all of them when no id is given. False: there was none."""
        ids = self._ids.get(topic)
        if ids is None or (advertise_id is not None and advertise_id not in ids):
            return False
        ids.discard(advertise_id)
        if advertise_id is None or not ids:
            del self._ids[topic]
            self._leave(self._publishers.pop(topic))
        return True

    def _leave(self, publisher: Publisher) -> None:
        # A client may have written one topic in two ways.
        if publisher not in self._publishers.values():
            self.node.publishers.leave(publisher, self._protocol)

    def unadvertise_all(self) -> None:
        """Take everything back: the client is gone."""
        for topic in list(self._ids):
            self.unadvertise(topic, None)


def publications(protocol: Protocol) -> Publications:
    """The publications of `protocol`, made when first asked for."""
    found = protocol.shared.get("publications")
    if found is None:
        found = protocol.shared["publications"] = Publications(protocol)
    assert isinstance(found, Publications)
    return found
