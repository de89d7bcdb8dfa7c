# SPDX-License-Identifier: BSD-3-Clause
"""Keep-alive: pings, and when a silent client is given up."""

from __future__ import annotations

from typing import Callable, List

import pytest

from rosbridge_server.keepalive import KeepAlive


class _Timer:
    def __init__(self, when: float) -> None:
        self.when = when
        self.cancelled = False

    def cancel(self) -> None:
        self.cancelled = True


class _Loop:
    """The part of an event loop that timers are, with a clock of the test's own."""

    def __init__(self) -> None:
        self.now = 0.0
        self.timers: List[tuple] = []

    def call_later(self, seconds, function):  # type: ignore[no-untyped-def]
        timer = _Timer(self.now + seconds)
        self.timers.append((timer, function))
        return timer

    def advance_to(self, end: float) -> None:
        while True:
            due = [(t.when, i) for i, (t, _) in enumerate(self.timers) if t.when <= end and not t.cancelled]
            if not due:
                self.now = end
                return
            self.now, index = min(due)
            _, function = self.timers.pop(index)
            function()

    @property
    def pending(self) -> int:
        return sum(not timer.cancelled for timer, _ in self.timers)


class _Case:
    def __init__(self, interval: float, timeout: float, sent_after: float = 0.0) -> None:
        self.loop = _Loop()
        self.sent_after = sent_after
        self.pings: List[float] = []
        self.lost: List[float] = []
        self.keepalive = KeepAlive(
            self.loop,  # type: ignore[arg-type]
            interval,
            timeout,
            self.ping,
            lambda: self.lost.append(self.loop.now),
        )

    def ping(self, sent: Callable[[], None]) -> None:
        self.pings.append(self.loop.now)
        self.loop.call_later(self.sent_after, sent)


@pytest.mark.parametrize(("interval", "timeout"), [(20, 30), (20, 5), (20, 20)])
def test_silence_ends_the_client_the_timeout_after_the_first_unanswered_ping(interval: float, timeout: float) -> None:
    case = _Case(interval, timeout)
    case.loop.advance_to(1000)
    assert case.lost == [interval + timeout]
    assert case.pings == [at for at in (20, 40, 60) if at <= interval + timeout][: len(case.pings)]
    assert case.loop.pending == 0


def test_whatever_is_received_keeps_the_client() -> None:
    case = _Case(20, 30)
    for now in range(0, 500, 10):
        case.loop.advance_to(now)
        case.keepalive.heard()
    assert case.lost == []
    assert case.pings == list(range(20, 500, 20))
    case.loop.advance_to(1000)  # silent from 490 on: the ping at 500 is not answered
    assert case.lost == [530]


def test_an_answer_just_before_the_timeout_counts() -> None:
    case = _Case(20, 30)
    case.loop.advance_to(49.9)
    case.keepalive.heard()
    case.loop.advance_to(89.9)
    assert case.lost == []
    case.loop.advance_to(90)  # the ping at 60 was not answered
    assert case.lost == [90]


def test_off() -> None:
    assert _Case(0, 30).loop.pending == 0
    case = _Case(20, 0)
    case.loop.advance_to(200)
    assert case.pings == list(range(20, 201, 20))
    assert case.lost == []


def test_the_timeout_begins_when_the_ping_has_gone_out_and_there_is_one_ping_at_a_time() -> None:
    """Behind a large message on a slow link it takes its time."""
    case = _Case(20, 30, sent_after=70)
    case.loop.advance_to(1000)
    assert case.pings == [20, 100]
    assert case.lost == [120]


def test_a_ping_that_goes_out_after_the_end_starts_nothing() -> None:
    case = _Case(20, 30, sent_after=70)
    case.loop.advance_to(30)
    case.keepalive.stop()
    case.loop.advance_to(1000)
    assert case.lost == []
    assert case.loop.pending == 0


def test_stop_leaves_no_timer() -> None:
    case = _Case(20, 30)
    case.loop.advance_to(25)
    case.keepalive.stop()
    assert case.loop.pending == 0
