# SPDX-License-Identifier: BSD-3-Clause
"""The graph watch: one question for all, and none without listeners."""

from __future__ import annotations

import asyncio
from typing import List, Optional

import pytest

from rosbridge_library.internal.exceptions import RosbridgeError
from rosbridge_library.ros.graph import Graph, GraphWatch, TopicInfo

GRAPH = Graph({"/a": ["/n"]}, {"/a": ["/m"], "/b": ["/m"]}, {}, {"/a": "std_msgs/String", "/b": "*", "/gone": "x/Y"})


def test_what_there_is_of_a_topic() -> None:
    assert GRAPH.topic("/a") == TopicInfo("std_msgs/String", ["/n"], ["/m"])
    assert GRAPH.topic("/b") == TopicInfo("", [], ["/m"])
    assert GRAPH.topic("/gone") == TopicInfo("", [], [])


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
