# SPDX-License-Identifier: BSD-3-Clause
"""The snapshot of the graph, and how long and with whom it is shared."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from rosapi.graph import Graph, action_servers, fetch_graph, names_with
from rosapi.recent import Recent

STATE = [
    [["/scan", ["/lidar"]], ["/cmd_vel", ["/teleop", "/nav"]]],
    [["/cmd_vel", ["/base"]], ["/map", ["/nav"]]],
    [["/base/reset", ["/base"]]],
]
TYPES = [["/scan", "sensor_msgs/LaserScan"], ["/map", "*"], ["/gone", "std_msgs/Bool"]]


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def graph() -> Graph:
    answers = {"getSystemState": STATE, "getTopicTypes": TYPES}
    return fetch_graph(lambda method: answers[method])


class TestGraph:
    def test_topics_are_those_published_or_subscribed_to(self, graph: Graph) -> None:
        assert graph.topics() == ["/cmd_vel", "/map", "/scan"]

    def test_types(self, graph: Graph) -> None:
        assert graph.topic_type("/scan") == "sensor_msgs/LaserScan"
        assert graph.topic_type("/map") == ""  # subscribed to with any type
        assert graph.topic_type("/cmd_vel") == ""  # the master has no type
        assert graph.topic_type("/gone") == ""  # the master never forgets types
        assert graph.topic_type("/never") == ""

    def test_nodes_are_those_in_any_role(self, graph: Graph) -> None:
        assert graph.nodes() == ["/base", "/lidar", "/nav", "/teleop"]

    def test_services(self, graph: Graph) -> None:
        assert graph.services() == ["/base/reset"]

    def test_names_with(self, graph: Graph) -> None:
        assert names_with(graph.publishers, "/nav") == ["/cmd_vel"]
        assert names_with(graph.subscribers, "/nav") == ["/map"]
        assert names_with(graph.providers, "/nav") == []

    def test_an_empty_graph(self) -> None:
        empty = fetch_graph(lambda method: {"getSystemState": [[], [], []], "getTopicTypes": []}[method])
        assert (empty.topics(), empty.services(), empty.nodes()) == ([], [], [])


def test_an_action_server_has_all_five_topics() -> None:
    parts = ["goal", "cancel", "status", "feedback", "result"]
    whole = [f"/{name}/{part}" for name in ("move", "arm/grasp") for part in parts]
    assert action_servers([*whole, "/goal", "/status", "/half/goal", "/half/result"]) == [
        "/arm/grasp",
        "/move",
    ]
    for missing in whole[:5]:
        assert action_servers(set(whole) - {missing}) == ["/arm/grasp"]


class TestRecent:
    def test_one_fetch_serves_for_a_while(self) -> None:
        clock, fetched = Clock(), []  # type: Any, List[int]

        def fetch() -> int:
            fetched.append(len(fetched))
            return len(fetched)

        recent = Recent(fetch, 1.0, clock)
        assert [recent.get(), recent.get()] == [1, 1]
        clock.now += 0.99
        assert recent.get() == 1
        clock.now += 0.01
        assert [recent.get(), recent.get()] == [2, 2]

    def test_the_age_counts_from_the_beginning_of_the_fetch(self) -> None:
        clock, values = Clock(), iter("ab")

        def slow() -> str:
            clock.now += 0.8
            return next(values)

        recent = Recent(slow, 1.0, clock)
        assert recent.get() == "a"
        clock.now += 0.3
        assert recent.get() == "b"

    def test_concurrent_callers_share_one_fetch(self) -> None:
        begun, go, fetches = threading.Event(), threading.Event(), []  # type: Any, Any, List[int]

        def fetch() -> object:
            fetches.append(1)
            begun.set()
            assert go.wait(10.0)
            return object()

        recent = Recent(fetch, 1.0, Clock())
        with ThreadPoolExecutor(20) as pool:
            first = pool.submit(recent.get)
            assert begun.wait(10.0)
            others = [pool.submit(recent.get) for _ in range(19)]
            go.set()
            assert {id(each.result(10.0)) for each in others} == {id(first.result(10.0))}
        assert len(fetches) == 1

    def test_a_failure_is_told_and_not_kept(self) -> None:
        outcomes = iter([OSError("away"), "back"])

        def fetch() -> str:
            outcome = next(outcomes)
            if isinstance(outcome, OSError):
                raise outcome
            return str(outcome)

        recent = Recent(fetch, 1.0, Clock())
        with pytest.raises(OSError, match="away"):
            recent.get()
        assert recent.get() == "back"
