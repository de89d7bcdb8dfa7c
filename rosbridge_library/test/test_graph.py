# SPDX-License-Identifier: BSD-3-Clause
"""The graph: read anew only when it has changed, watched by one question for all, and none without listeners."""

from __future__ import annotations

import asyncio
import gc
from typing import Any, Dict, List, Optional

import pytest

from rosbridge_library.internal.exceptions import RosbridgeError
from rosbridge_library.ros.graph import Graph, GraphReader, GraphWatch, TopicInfo
from rosbridge_library.ros.master import Master, MasterUnreachable
from rosbridge_library.ros.node import Node
from support.ros import RosMaster, free_port

GRAPH = Graph({"/a": ["/n"]}, {"/a": ["/m"], "/b": ["/m"]}, {}, {"/a": "std_msgs/String", "/b": "*", "/gone": "x/Y"})


def test_what_there_is_of_a_topic() -> None:
    assert GRAPH.topic("/a") == TopicInfo("std_msgs/String", ["/n"], ["/m"])
    assert GRAPH.topic("/b") == TopicInfo("", [], ["/m"])
    assert GRAPH.topic("/gone") == TopicInfo("", [], [])


def test_a_graph_that_has_not_changed_is_the_same(ros_master: RosMaster) -> None:
    master = Master("/reader", ros_master.uri)
    reader = GraphReader(master)
    empty = reader.ask()
    assert reader.ask() is empty
    assert empty.topic("/read") == TopicInfo("", [], [])
    uri = "http://127.0.0.1:1/"
    master.call("registerPublisher", "/read", "std_msgs/String", uri)
    published = reader.ask()
    assert published.topic("/read") == TopicInfo("std_msgs/String", ["/reader"], [])
    assert reader.ask() is published
    master.call("registerPublisher", "/read", "std_msgs/Int32", uri)  # the same node, with another type
    assert reader.ask().topic("/read").type == "std_msgs/Int32"
    master.call("unregisterPublisher", "/read", uri)
    assert reader.ask().topic("/read") == TopicInfo("", [], [])


def test_nothing_is_logged_of_a_failure_that_nobody_waits_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_MASTER_URI", f"http://127.0.0.1:{free_port()}/")
    told: List[Dict[str, Any]] = []

    async def run() -> None:
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(lambda _, context: told.append(context))
        node = Node(loop)
        askers = [loop.create_task(node.topic("/topic")) for _ in range(2)]
        await asyncio.sleep(0)
        askers[0].cancel()  # the client has left
        with pytest.raises(MasterUnreachable):
            await askers[1]
        asker = loop.create_task(node.topic("/topic"))
        await asyncio.sleep(0)
        asker.cancel()
        lookups = asyncio.all_tasks() - {asyncio.current_task()}
        await asyncio.wait(lookups)
        assert len(lookups) == 2  # the asker, and what it asked

    asyncio.run(run())
    gc.collect()
    assert told == []


def test_all_listeners_are_told_by_one_question_and_nothing_is_asked_without_any() -> None:
    async def run() -> None:
        asked: List[int] = []

        async def ask() -> Graph:
            asked.append(len(asked))
            return GRAPH

        watch = GraphWatch(ask, 0.01)
        told: List[List[Optional[Graph]]] = [[], []]
        listeners = [each.append for each in told]
        for listener in listeners:
            watch.add(listener)
        await _until(lambda: len(told[0]) >= 3)
        assert told[0] == told[1]
        assert len(asked) == len(told[0]) == watch.asked
        watch.remove(listeners[0])
        heard = len(told[0])
        await _until(lambda: len(told[1]) > heard)
        assert len(told[0]) == heard
        watch.remove(listeners[1])
        questions = len(asked)
        await asyncio.sleep(0.05)
        assert len(asked) == questions
        watch.add(listeners[0])
        await _until(lambda: len(told[0]) > heard)
        watch.close()

    asyncio.run(run())


@pytest.mark.parametrize("failure", [RosbridgeError("the master is away"), ValueError("nonsense")])
def test_without_an_answer_listeners_are_told_none_and_it_goes_on(failure: Exception) -> None:
    async def run() -> None:
        answers = [failure, GRAPH]

        async def ask() -> Graph:
            answer = answers.pop(0) if len(answers) > 1 else answers[0]
            if isinstance(answer, Exception):
                raise answer
            return answer

        watch = GraphWatch(ask, 0.01)
        told: List[Optional[Graph]] = []
        watch.add(told.append)
        await _until(lambda: len(told) >= 2)
        assert told[:2] == [None, GRAPH]
        watch.close()

    asyncio.run(run())


def test_a_listener_that_fails_hinders_no_other() -> None:
    async def run() -> None:
        async def ask() -> Graph:
            return GRAPH

        def fail(_: Optional[Graph]) -> None:
            raise RuntimeError("a bug")

        watch = GraphWatch(ask, 0.01)
        told: List[Optional[Graph]] = []
        watch.add(fail)
        watch.add(told.append)
        await _until(lambda: len(told) >= 2)
        watch.close()

    asyncio.run(run())


async def _until(condition: object) -> None:
    deadline = asyncio.get_running_loop().time() + 5
    while not condition():  # type: ignore[operator]
        assert asyncio.get_running_loop().time() < deadline
        await asyncio.sleep(0.005)
