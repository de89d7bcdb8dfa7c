# SPDX-License-Identifier: BSD-3-Clause
"""subscribeConnectionGraph, unsubscribeConnectionGraph and connectionGraphUpdate: which node uses what.

A client is told the whole graph when it subscribes, and then what differs from what it was told last.
"""

from __future__ import annotations

from typing import Any, Callable, Dict, List, Mapping, NamedTuple, Optional, Tuple

from rosbridge_library.capability import Capability, Operation
from rosbridge_library.foxglove import messages
from rosbridge_library.foxglove.protocol import FoxgloveProtocol
from rosbridge_library.payload import Payload
from rosbridge_library.ros.graph import Graph, Users


class Connections(NamedTuple):
    """The nodes, in order, that publish, subscribe and provide what clients may see."""

    publishers: Mapping[str, Tuple[str, ...]] = {}
    subscribers: Mapping[str, Tuple[str, ...]] = {}
    providers: Mapping[str, Tuple[str, ...]] = {}

    @classmethod
    def of(cls, graph: Graph, sees_topic: Callable[[str], bool], sees_service: Callable[[str], bool]) -> Connections:
        """The part of the graph that clients may see."""
        return cls(
            _visible(graph.publishers, sees_topic),
            _visible(graph.subscribers, sees_topic),
            _visible(graph.services, sees_service),
        )

    def update_from(self, before: Connections) -> Dict[str, Any]:
        """The message that makes these of those before."""
        topics = self.publishers.keys() | self.subscribers.keys()
        topics_before = before.publishers.keys() | before.subscribers.keys()
        return {
            "op": "connectionGraphUpdate",
            "publishedTopics": _changed(self.publishers, before.publishers, topics, "publisherIds"),
            "subscribedTopics": _changed(self.subscribers, before.subscribers, topics, "subscriberIds"),
            "advertisedServices": _changed(self.providers, before.providers, self.providers.keys(), "providerIds"),
            "removedTopics": sorted(topics_before - topics),
            "removedServices": sorted(before.providers.keys() - self.providers.keys()),
        }


def _visible(users: Users, sees: Callable[[str], bool]) -> Dict[str, Tuple[str, ...]]:
    return {name: tuple(sorted(nodes)) for name, nodes in users.items() if nodes and sees(name)}


def _changed(
    now: Mapping[str, Tuple[str, ...]], before: Mapping[str, Tuple[str, ...]], present: Any, ids: str
) -> List[Dict[str, Any]]:
    """Names that are still there in some way, and whose nodes are others than before."""
    return [
        {"name": name, ids: list(now.get(name, ()))}
        for name in sorted(present)
        if now.get(name, ()) != before.get(name, ())
    ]


NOTHING = Connections()


class ConnectionGraph:
    """The graph as this server's clients see it, and those who follow it."""

    def __init__(self, sees_topic: Callable[[str], bool], sees_service: Callable[[str], bool]) -> None:
        self._sees_topic = sees_topic
        self._sees_service = sees_service
        self._graph: Optional[Graph] = None
        self._connections: Optional[Connections] = None
        self._told: Dict[ConnectionGraphUpdates, Optional[Connections]] = {}

    def __contains__(self, follower: ConnectionGraphUpdates) -> bool:
        return follower in self._told

    def add(self, follower: ConnectionGraphUpdates) -> None:
        """Tell `follower` the graph, as soon as it is known, and every change."""
        self._told[follower] = None
        self._tell()

    def remove(self, follower: ConnectionGraphUpdates) -> None:
        """Tell it no more."""
        self._told.pop(follower, None)

    def follow(self, graph: Optional[Graph]) -> None:
        """Tell all what has changed; without a graph, what there is stays."""
        if graph is not None and graph is not self._graph:
            self._graph = graph
            self._connections = Connections.of(graph, self._sees_topic, self._sees_service)
            self._tell()

    def forget(self) -> None:
        """Nobody follows the graph any more."""
        self._graph = self._connections = None

    def _tell(self) -> None:
        now = self._connections
        if now is None:
            return
        updates: Dict[int, Optional[Payload]] = {}  # by what was told before: most were told the same
        for follower, before in self._told.items():
            if before is now:
                continue
            if id(before) not in updates:
                changed = before is None or before != now
                updates[id(before)] = messages.text(now.update_from(before or NOTHING)) if changed else None
            payload = updates[id(before)]
            self._told[follower] = now
            if payload is not None:
                follower.protocol.send_payload(payload)


class ConnectionGraphUpdates(Capability):
    """One client's subscription to the graph."""

    protocol: FoxgloveProtocol

    def __init__(self, protocol: FoxgloveProtocol) -> None:
        super().__init__(protocol)
        self._graph = protocol.server.connection_graph
        protocol.register_operation("subscribeConnectionGraph", self.subscribe)
        protocol.register_operation("unsubscribeConnectionGraph", self.unsubscribe)

    def subscribe(self, _: Operation) -> None:
        """The whole graph, then what changes."""
        if self in self._graph:
            self.protocol.log("warning", "subscribeConnectionGraph: the connection graph is subscribed to already")
        else:
            self._graph.add(self)

    def unsubscribe(self, _: Operation) -> None:
        """No more changes."""
        if self not in self._graph:
            self.protocol.log("warning", "unsubscribeConnectionGraph: the connection graph was not subscribed to")
        self._graph.remove(self)

    def finish(self) -> None:
        self._graph.remove(self)
