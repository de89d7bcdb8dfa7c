# SPDX-License-Identifier: BSD-3-Clause
"""A protocol by itself: decoding, operations that others register, errors, statuses, and the end."""

from __future__ import annotations

import asyncio
import json
from types import SimpleNamespace
from typing import Any, Awaitable, Callable, ClassVar, Dict, List, Optional, Union

import bson
import cbor2
import pytest

from rosbridge_library.capabilities.defragmentation import Defragment
from rosbridge_library.capabilities.fragmentation import Fragmentation
from rosbridge_library.capability import Capability
from rosbridge_library.internal.exceptions import InvalidArgumentException
from rosbridge_library.protocol import FINISH_TIMEOUT_S, Protocol


class Recorder(Protocol):
    """Keeps what goes out."""

    def __init__(self, node: Any, parameters: Optional[Dict[str, Any]] = None) -> None:
        super().__init__("client", parameters, node=node)
        self.frames: List[Union[str, bytes]] = []

    def outgoing(self, message: Union[str, bytes]) -> None:
        self.frames.append(message)

    async def until(self, condition: Callable[[], bool]) -> None:
        """Returns when something that goes out, or comes to an end, has made the condition true."""
        end = self.loop.time() + 5.0
        while not condition():  # the protocol under test tells nobody
            assert self.loop.time() < end, self.frames
            await asyncio.sleep(0.001)

    @property
    def sent(self) -> List[Any]:
        return [json.loads(frame) if isinstance(frame, str) else cbor2.loads(frame) for frame in self.frames]


def run(check: Callable[[Recorder], Optional[Awaitable[None]]], **parameters: Any) -> None:
    async def main() -> None:
        node: Any = SimpleNamespace(loop=asyncio.get_running_loop())
        protocol = Recorder(node, parameters)
        pending = check(protocol)
        if pending is not None:
            await asyncio.wait_for(pending, 10.0)
        protocol.finish()

    asyncio.run(main())


class Echo(Capability):
    """An operation of an external package."""

    finished: ClassVar[List[str]] = []

    def __init__(self, protocol: Protocol) -> None:
        Capability.__init__(self, protocol)
        protocol.register_operation("echo", self.echo)

    def echo(self, message: Dict[str, Any]) -> None:
        self.basic_type_check(message, [(True, "text", str), (False, "times", (int, float))])
        self.protocol.send({"op": "echoed", "text": message["text"]}, cid=message.get("id"))

    def finish(self) -> None:
        self.finished.append("echo")


def test_an_operation_of_an_external_capability() -> None:
    def check(protocol: Recorder) -> None:
        protocol.add_capability(Echo)
        protocol.incoming('{"op": "echo", "text": "ä", "id": 5}')
        assert protocol.sent == [{"op": "echoed", "text": "ä", "id": 5}]
        protocol.unregister_operation("echo")
        protocol.incoming('{"op": "echo", "text": "ä", "id": 6}')
        assert protocol.sent[-1]["level"] == "error"
        assert protocol.sent[-1]["id"] == 6

    run(check)


@pytest.mark.parametrize(
    "frame",
    [
        '{"op": "echo", "text": "x"}',
        b'{"op": "echo", "text": "x"}',
        bytearray(b'{"op": "echo", "text": "x"}'),
        cbor2.dumps({"op": "echo", "text": "x"}),
    ],
)
def test_what_a_message_may_be(frame: Any) -> None:
    def check(protocol: Recorder) -> None:
        protocol.add_capability(Echo)
        protocol.incoming(frame)
        assert protocol.sent == [{"op": "echoed", "text": "x"}]

    run(check)


@pytest.mark.parametrize(
    ("operation", "complaint"),
    [
        ({}, "text"),
        ({"text": None}, "text"),
        ({"text": 5}, "text"),
        ({"text": "x", "times": "5"}, "times"),
        ({"text": "x", "times": True}, "times"),
        ({"text": "x", "id": ["x"]}, "id"),
    ],
)
def test_a_field_that_does_not_fit_is_named(operation: Dict[str, Any], complaint: str) -> None:
    def check(protocol: Recorder) -> None:
        protocol.add_capability(Echo)
        protocol.incoming(json.dumps({"op": "echo", **operation}))
        (status,) = protocol.sent
        assert (status["op"], status["level"]) == ("status", "error")
        assert f"'{complaint}'" in status["msg"]

    run(check)


@pytest.mark.parametrize("waits", [False, True])
def test_a_handler_that_fails(waits: bool, caplog: pytest.LogCaptureFixture) -> None:
    """What it says is for the client when it is meant to be; a bug is logged whole, and told without details."""

    async def check(protocol: Recorder) -> None:
        def fail(error: Exception) -> Any:
            async def later(_: Any) -> None:
                await asyncio.sleep(0)
                raise error

            def now(_: Any) -> None:
                raise error

            return later if waits else now

        protocol.register_operation("meant", fail(InvalidArgumentException("the reason")))
        protocol.register_operation("bug", fail(ZeroDivisionError("a secret")))
        for op in ("meant", "bug"):
            protocol.incoming(json.dumps({"op": op, "id": op}))
        await protocol.until(lambda: len(protocol.frames) == 2)
        meant, bug = protocol.sent
        assert (meant["msg"], meant["id"]) == ("meant: the reason", "meant")
        assert bug["id"] == "bug"
        assert "secret" not in bug["msg"]
        assert "a secret" in caplog.text

    run(check)


def test_levels_of_log() -> None:
    def check(protocol: Recorder) -> None:
        for level in ("info", "warning", "error", "none"):
            protocol.incoming(json.dumps({"op": "set_level", "level": level}))
            protocol.frames.clear()
            for each in ("info", "warning", "error"):
                protocol.log(each, "text", "an id")
            expected = {"info": 3, "warning": 2, "error": 1, "none": 0}[level]
            assert [status["level"] for status in protocol.sent] == ["info", "warning", "error"][3 - expected :]
            assert all(status["id"] == "an id" for status in protocol.sent)

    run(check)


def test_a_long_status_is_cut() -> None:
    def check(protocol: Recorder) -> None:
        protocol.log("error", "x" * 10_000_000)
        assert len(protocol.sent[0]["msg"]) < 2000

    run(check)


@pytest.mark.parametrize("compression", ["none", "png", "cbor"])
def test_send_in_every_compression(compression: str) -> None:
    def check(protocol: Recorder) -> None:
        protocol.send({"op": "x", "text": "ä"}, cid="id", compression=compression)
        (sent,) = protocol.sent
        if compression == "png":
            assert sent["op"] == "png"
            Defragment(protocol)
            found: List[Any] = []
            protocol.register_operation("x", found.append)
            protocol.incoming(protocol.frames[0])
            (sent,) = found
        assert sent == {"op": "x", "text": "ä", "id": "id"}

    run(check)


def test_send_keeps_an_id_that_is_there() -> None:
    def check(protocol: Recorder) -> None:
        protocol.send({"op": "x", "id": "own"}, cid="other")
        assert protocol.sent[0]["id"] == "own"

    run(check)


def test_fragments_go_out_and_come_in() -> None:
    def check(protocol: Recorder) -> None:
        found: List[Any] = []
        Defragment(protocol)
        protocol.register_operation("x", found.append)
        protocol.send({"op": "x", "text": "ä" * 1000})
        assert len(protocol.frames) > 10
        for frame in list(protocol.frames):
            protocol.incoming(frame)
        parts = Fragmentation(protocol).fragment({"op": "x", "text": "y" * 50}, 20, "mid")
        assert all(part["id"] == "mid" for part in parts)
        for part in parts:
            protocol.incoming(json.dumps(part))
        assert found == [{"op": "x", "text": "ä" * 1000}, {"op": "x", "text": "y" * 50}]
        assert Fragmentation(protocol).fragment({"op": "x"}, 1000) == [{"op": "x"}]

    run(check, max_message_size=100)


def test_a_fragmented_operation_that_waits_keeps_its_place() -> None:
    async def check(protocol: Recorder) -> None:
        handled: List[str] = []
        done = asyncio.Event()

        async def slow(message: Dict[str, Any]) -> None:
            await asyncio.sleep(0.01)
            handled.append("slow")

        def quick(message: Dict[str, Any]) -> None:
            handled.append("quick")
            done.set()

        Defragment(protocol)
        protocol.register_operation("slow", slow)
        protocol.register_operation("quick", quick)
        for part in Fragmentation(protocol).fragment({"op": "slow", "padding": "x" * 50}, 20, 1):
            protocol.incoming(json.dumps(part))
        protocol.incoming('{"op": "quick"}')
        await done.wait()
        assert handled == ["slow", "quick"]

    run(check)


def test_fragments_wait_no_longer_than_the_timeout() -> None:
    async def check(protocol: Recorder) -> None:
        Defragment(protocol)
        protocol.incoming('{"op": "fragment", "id": 1, "num": 0, "total": 2, "data": "x"}')
        await protocol.until(lambda: bool(protocol.frames))
        assert "1 of 2" in protocol.sent[0]["msg"]

    run(check, fragment_timeout=0.02)


def test_bson_only() -> None:
    def check(protocol: Recorder) -> None:
        protocol.add_capability(Echo)
        protocol.incoming(bson.encode({"op": "echo", "text": "x"}))
        protocol.incoming(b"nonsense")
        assert bson.decode(protocol.frames[0]) == {"op": "echoed", "text": "x"}
        assert bson.decode(protocol.frames[1])["level"] == "error"

    run(check, bson_only_mode=True)


def test_finish_ends_what_waits_and_tells_the_capabilities_once() -> None:
    async def check(protocol: Recorder) -> None:
        Echo.finished.clear()
        protocol.add_capability(Echo)
        cancelled = asyncio.Event()

        async def never(message: Dict[str, Any]) -> None:
            try:
                await asyncio.Event().wait()
            finally:
                cancelled.set()

        protocol.register_operation("never", never)
        protocol.incoming('{"op": "never"}')
        await asyncio.sleep(0)
        protocol.finish()
        protocol.finish()
        await cancelled.wait()
        assert Echo.finished == ["echo"]
        protocol.incoming('{"op": "echo", "text": "too late"}')
        protocol.send({"op": "x"})
        protocol.log("error", "text")
        assert protocol.frames == []

    run(check)


def test_what_was_to_be_published_is_published_before_the_end() -> None:
    """In its order, behind an operation that isn't finished; what only the client would care for is left out."""

    async def check(protocol: Recorder) -> None:
        handled: List[str] = []
        Echo.finished.clear()
        protocol.add_capability(Echo)

        async def advertise(message: Dict[str, Any]) -> None:
            await asyncio.sleep(0.02)
            handled.append("advertise")

        protocol.register_operation("advertise", advertise)
        protocol.register_operation("publish", lambda message: handled.append("publish"))
        protocol.register_operation("subscribe", lambda message: handled.append("subscribe"))
        for op in ("advertise", "publish", "subscribe", "nonsense", "advertise", "publish"):
            protocol.incoming(json.dumps({"op": op}))
        protocol.finish()
        assert Echo.finished == []
        await protocol.until(lambda: protocol.ended)
        assert handled == ["advertise", "publish", "advertise", "publish"]
        assert Echo.finished == ["echo"]
        assert protocol.frames == []

    run(check)


def test_publishing_before_the_end_takes_no_longer_than_its_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rosbridge_library.protocol.FINISH_TIMEOUT_S", 0.05)
    assert FINISH_TIMEOUT_S > 0.05

    async def check(protocol: Recorder) -> None:
        cancelled = asyncio.Event()

        async def advertise(message: Dict[str, Any]) -> None:
            try:
                await asyncio.Event().wait()
            finally:
                cancelled.set()

        protocol.register_operation("advertise", advertise)
        protocol.incoming('{"op": "advertise"}')
        await asyncio.sleep(0)
        protocol.finish()
        await cancelled.wait()
        assert protocol.ended

    run(check)


def test_a_capability_that_fails_to_finish_does_not_keep_others_from_it(caplog: pytest.LogCaptureFixture) -> None:
    class Bad(Capability):
        def finish(self) -> None:
            raise ZeroDivisionError("in finish")

    def check(protocol: Recorder) -> None:
        Echo.finished.clear()
        protocol.add_capability(Bad)
        protocol.add_capability(Echo)
        protocol.finish()
        assert Echo.finished == ["echo"]
        assert "in finish" in caplog.text

    run(check)


def test_a_long_id_comes_back_whole_but_does_not_fill_the_log(caplog: pytest.LogCaptureFixture) -> None:
    def check(protocol: Recorder) -> None:
        protocol.incoming(json.dumps({"op": "set_level", "level": 7, "id": "x" * 100_000}))
        assert protocol.sent[0]["id"] == "x" * 100_000

    run(check)
    assert "set_level" in caplog.text
    assert len(caplog.text) < 2000
