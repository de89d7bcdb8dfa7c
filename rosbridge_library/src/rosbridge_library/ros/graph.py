# SPDX-License-Identifier: BSD-3-Clause
"""The ROS graph as the master knows it: who publishes, subscribes and provides what.

A `GraphWatch` asks the master for it at an interval and tells its listeners, as long as there are any. It serves all
clients with one question, and counts the loop's time, so it goes on while simulated time stands still.
"""

from __future__ import annotations

import asyncio
import logging
from typing import Awaitable, Callable, Dict, List, Mapping, NamedTuple, Optional, Tuple

from rosbridge_library.internal.exceptions import RosbridgeError
from rosbridge_library.ros.master import Master

logger = logging.getLogger("rosbridge.graph")

WATCH_INTERVAL_S = 1.0

Users = Mapping[str, List[str]]
"""Names of topics or services, each with the names of nodes."""


class TopicInfo(NamedTuple):
    """What the master knows of a topic: its type ("" when unknown), and the nodes that publish and subscribe."""

    type: str
    publishers: List[str]
    subscribers: List[str]


class Graph(NamedTuple):
    """One answer of the master."""

    publishers: Users
    subscribers: Users
    services: Users
    types: Mapping[str, str]
    """Of topics, also of those that are gone."""

    def topic(self, topic: str) -> TopicInfo:
        """What there is of `topic`. One that nobody publishes or subscribes has no type."""
        publishers, subscribers = self.publishers.get(topic, []), self.subscribers.get(topic, [])
        type_ = self.types.get(topic, "") if publishers or subscribers else ""
        return TopicInfo("" if type_ == "*" else type_, publishers, subscribers)


class GraphReader:
    """Asks the master for the graph, from any thread.

    As long as nothing has changed it returns the same Graph: with a thousand topics, reading the master's XML takes 20
    ms in which no other thread of the process gets on, the graph is looked at every second, and it hardly ever changes.
    """

    def __init__(self, master: Master) -> None:
        self._master = master
        self._last: Optional[Tuple[Tuple[bytes, bytes], Graph]] = None  # replaced as a whole: threads need no lock

    def ask(self) -> Graph:
        """Ask, blocking. Raises MasterUnreachable or MasterError."""
        answers = self._master.answer("getSystemState"), self._master.answer("getTopicTypes")
        last = self._last
        if last is not None and last[0] == answers:
            return last[1]
        publishers, subscribers, services = map(_users, self._master.value("getSystemState", answers[0]))
        graph = Graph(publishers, subscribers, services, dict(self._master.value("getTopicTypes", answers[1])))
        self._last = answers, graph
        return graph


def _users(entries: List[Tuple[str, List[str]]]) -> Dict[str, List[str]]:
    return {name: list(nodes) for name, nodes in entries}


Listener = Callable[[Optional[Graph]], None]


class GraphWatch:
    """Tells listeners the graph every `interval_s`. Belongs to the loop that it is used on.

    `ask` gets the graph. A listener gets None when the master did not answer.
    """

    def __init__(self, ask: Callable[[], Awaitable[Graph]], interval_s: float = WATCH_INTERVAL_S) -> None:
        self.interval_s = interval_s
        self.asked = 0
        """How often the master was asked."""
        self._ask = ask
        self._listeners: List[Listener] = []
        self._watching: Optional[asyncio.Task[None]] = None

    def add(self, listener: Listener) -> None:
        """Tell `listener` from now on; the first one is told as soon as the master has answered."""
        self._listeners.append(listener)
        if self._watching is None:
            self._watching = asyncio.get_running_loop().create_task(self._watch())

    def remove(self, listener: Listener) -> None:
        """Tell `listener` no more; without any, the master is asked no more."""
        self._listeners.remove(listener)
        if not self._listeners:
            self.close()

    def close(self) -> None:
        """Ask no more."""
        self._listeners.clear()
        if self._watching is not None:
            self._watching.cancel()
            self._watching = None

    async def _watch(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            began_s = loop.time()
            graph = await self._next()
            for listener in list(self._listeners):
                try:
                    listener(graph)
                except Exception:  # a bug; the others must hear of the graph all the same
                    logger.exception("a listener to the graph failed")
            await asyncio.sleep(max(0.0, began_s + self.interval_s - loop.time()))

    async def _next(self) -> Optional[Graph]:
        self.asked += 1
        try:
            return await self._ask()
        except RosbridgeError as error:
            logger.debug("the graph is not known now: %s", error)
        except Exception:  # an answer that is none of a master's; without this task nobody would ever ask again
            logger.exception("the graph is not known now")
        return None
