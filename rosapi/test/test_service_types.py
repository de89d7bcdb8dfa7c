# SPDX-License-Identifier: BSD-3-Clause
"""When a service is asked for its type, and when what it said before is good enough."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Dict, List, Mapping, Optional

import pytest

from rosapi import service_types
from rosapi.service_types import SILENT_FOR_S, ServiceTypes, Tell


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Nodes:
    """What the services would answer now, and which were asked, in batches."""

    def __init__(self, types: Mapping[str, Optional[str]]) -> None:
        self.types: Dict[str, Optional[str]] = dict(types)
        self.asked: List[List[str]] = []

    def probe(self, uris: Mapping[str, str], tell: Tell) -> None:
        self.asked.append(sorted(uris))
        for service in uris:
            tell(service, self.types[service])


A, B = {"/a": "rosrpc://h:1"}, {"/b": "rosrpc://h:2"}
BOTH = {**A, **B}


def test_an_answer_is_kept_until_the_uri_changes() -> None:
    clock, nodes = Clock(), Nodes({"/a": "p/A", "/b": "p/B"})
    types = ServiceTypes(nodes.probe, clock)
    assert types.types(A) == {"/a": "p/A"}
    clock.now += 1e6
    assert types.types(BOTH) == {"/a": "p/A", "/b": "p/B"}
    nodes.types["/a"] = "p/New"
    assert types.types({"/a": "rosrpc://h:9"}) == {"/a": "p/New"}
    assert types.types({"/a": "rosrpc://h:9"}) == {"/a": "p/New"}
    assert nodes.asked == [["/a"], ["/b"], ["/a"]]


def test_a_silent_service_is_left_alone_for_a_while() -> None:
    clock, nodes = Clock(), Nodes({"/a": None, "/b": "p/B"})
    types = ServiceTypes(nodes.probe, clock)
    assert types.types(BOTH) == {"/b": "p/B"}
    nodes.types["/a"] = "p/A"
    clock.now += SILENT_FOR_S - 0.01
    assert types.types(BOTH) == {"/b": "p/B"}
    clock.now += 0.01
    assert types.types(BOTH) == {"/a": "p/A", "/b": "p/B"}
    assert nodes.asked == [["/a", "/b"], ["/a"]]


def test_a_restarted_service_is_asked_at_once() -> None:
    nodes = Nodes({"/a": None})
    types = ServiceTypes(nodes.probe, Clock())
    assert types.types(A) == {}
    nodes.types["/a"] = "p/A"
    assert types.types({"/a": "rosrpc://h:2"}) == {"/a": "p/A"}


def test_concurrent_callers_share_a_probe_and_wait_for_their_own_services_only() -> None:
    begun, go = threading.Event(), threading.Event()
    asked: List[List[str]] = []

    def probe(uris: Mapping[str, str], tell: Tell) -> None:
        """/b answers at once, /a when it may."""
        asked.append(sorted(uris))
        tell("/b", "p/B")
        begun.set()
        assert go.wait(10.0)
        tell("/a", "p/A")

    types = ServiceTypes(probe, Clock())
    with ThreadPoolExecutor(4) as pool:
        first = pool.submit(types.types, BOTH)
        assert begun.wait(10.0)
        same = pool.submit(types.types, A)
        assert types.types(B) == {"/b": "p/B"}
        assert not first.done()
        assert not same.done()
        go.set()
        assert first.result(10.0) == {"/a": "p/A", "/b": "p/B"}
        assert same.result(10.0) == {"/a": "p/A"}
    assert asked == [["/a", "/b"]]


def test_a_probe_that_fails_is_told_and_not_kept() -> None:
    failures = [RuntimeError("no file descriptors left")]

    def probe(uris: Mapping[str, str], tell: Tell) -> None:
        if "/b" in uris:
            tell("/b", "p/B")
        if failures:
            raise failures.pop()
        tell("/a", "p/A")

    types = ServiceTypes(probe, Clock())
    with pytest.raises(RuntimeError, match="descriptors"):
        types.types(BOTH)
    assert types.types(B) == {"/b": "p/B"}
    assert types.types(A) == {"/a": "p/A"}


def test_the_oldest_answers_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service_types, "MAX_KNOWN", 3)
    uris = {f"/s{index}": f"rosrpc://h:{index}" for index in range(10)}
    nodes = Nodes(dict.fromkeys(uris, "p/T"))
    types = ServiceTypes(nodes.probe, Clock())
    for service, uri in uris.items():
        types.types({service: uri})
    assert len(types._known) == 3
    assert types.types(uris) == dict.fromkeys(uris, "p/T")  # more at once than are kept
    assert nodes.asked[-1] == sorted(f"/s{index}" for index in range(7))
