# SPDX-License-Identifier: BSD-3-Clause
"""The ROS graph at one moment: which node publishes, subscribes to and provides what.

A `Graph` is what the master said in two calls, indexed; it never changes. All questions about topics,
services and nodes are answered from it, so a question costs the same on a robot with 1500 topics.
"""

from __future__ import annotations

from typing import Any, Callable, Dict, Iterable, List, Mapping, NamedTuple, Sequence, Set, Tuple

# The topics of an action server (actionlib). A name is one when it has them all.
ACTION_TOPICS = ("goal", "cancel", "status", "feedback", "result")

# What rospy registers a subscriber with that takes any type; to a client it means that the type isn't known.
ANY_TYPE = "*"

Names = Mapping[str, Sequence[str]]


class Graph(NamedTuple):
    """Nodes by topic and service, and the types of topics ("" where the master knows none)."""

    publishers: Names
    subscribers: Names
    providers: Names
    types: Mapping[str, str]

    def topics(self) -> List[str]:
        """All topics that some node publishes or subscribes to, sorted."""
        return sorted(set(self.publishers) | set(self.subscribers))

    def services(self) -> List[str]:
        """All services, sorted."""
        return sorted(self.providers)

    def nodes(self) -> List[str]:
        """All nodes that publish, subscribe or provide something, sorted."""
        found: Set[str] = set()
        for roles in (self.publishers, self.subscribers, self.providers):
            found.update(*roles.values())
        return sorted(found)

    def topic_type(self, topic: str) -> str:
        """The type of a topic that is in the graph, or ""."""
        known = topic in self.publishers or topic in self.subscribers
        return self.types.get(topic, "") if known else ""


def fetch_graph(call: Callable[..., Any]) -> Graph:
    """Ask the master, by `call(method)`, for the graph of this moment. Raises what `call` raises."""
    publishers, subscribers, providers = call("getSystemState")
    types = {topic: "" if kind == ANY_TYPE else kind for topic, kind in call("getTopicTypes")}
    return Graph(_by_name(publishers), _by_name(subscribers), _by_name(providers), types)


def _by_name(state: Iterable[Tuple[str, List[str]]]) -> Dict[str, List[str]]:
    return {name: sorted(nodes) for name, nodes in state}


def names_with(roles: Names, node: str) -> List[str]:
    """The topics or services of `roles` in which `node` takes part, sorted."""
    return sorted(name for name, nodes in roles.items() if node in nodes)


def action_servers(topics: Iterable[str]) -> List[str]:
    """The names under which all topics of an action server are among `topics`, sorted."""
    known = set(topics)
    suffix = "/" + ACTION_TOPICS[0]
    names = (topic[: -len(suffix)] for topic in known if topic.endswith(suffix))
    return sorted(name for name in names if all(f"{name}/{part}" in known for part in ACTION_TOPICS))
