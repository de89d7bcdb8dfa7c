# SPDX-License-Identifier: BSD-3-Clause
"""TCPROS connections on the loop, against raw sockets: no master, every way that bytes can arrive."""

from __future__ import annotations

import asyncio
import gc
import os
import resource
import socket
import struct
from pathlib import Path
from typing import Any, Awaitable, Callable, List, Optional

import pytest

from rosbridge_library.ros import tcpros
from rosbridge_library.ros.feeds import _any_type, _FeedSubscriber
from rosbridge_library.ros.publishers import _LoopPublisher
from rosbridge_library.ros.tcpros import InboundConnection, LoopTcprosHandler, OutboundConnection, Receiver
from rosbridge_library.ros.tcpros_header import encode_header

HEADER = {"type": "std_msgs/String", "md5sum": "*", "callerid": "/talker", "message_definition": "string data\n"}
TOPIC = "/tcpros_test"


class Record(Receiver):
    """Keeps what comes."""

    def __init__(self) -> None:
        self.messages: List[bytes] = []
        self.events: List[str] = []
        self.changed = asyncio.Event()

    def connected(self, connection: InboundConnection) -> None:
        self._note("connected")

    def received(self, connection: InboundConnection, wire: Any) -> None:
        self.messages.append(bytes(wire))
        self.changed.set()

    def disconnected(self, connection: InboundConnection) -> None:
        self._note("disconnected")

    def refused(self, connection: InboundConnection, reason: str) -> None:
        self._note(f"refused: {reason}")

    def given_up(self, topic: str) -> None:
        self._note(f"given up {topic}")

    def _note(self, event: str) -> None:
        self.events.append(event)
        self.changed.set()

    async def until(self, condition: Callable[[], bool]) -> None:
        async def wait() -> None:
            while not condition():
                self.changed.clear()
                await self.changed.wait()

        await asyncio.wait_for(wait(), 10.0)


def frame(body: bytes) -> bytes:
    return struct.pack("<I", len(body)) + body


def run(serve: Callable[[asyncio.StreamWriter], Awaitable[None]], check: Callable[[Record], Awaitable[None]]) -> None:
    """Connect to a publisher that answers the handshake by `serve`, and `check` what arrives."""

    async def main() -> None:
        loop = asyncio.get_running_loop()
        done = asyncio.Event()

        async def publisher(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            (length,) = struct.unpack("<I", await reader.readexactly(4))
            await reader.readexactly(length)
            await serve(writer)
            await done.wait()
            writer.close()

        server = await asyncio.start_server(publisher, "127.0.0.1", 0)
        address = server.sockets[0].getsockname()
        record = Record()
        handler = LoopTcprosHandler(loop, record.given_up)
        handler.inbound[TOPIC] = record
        subscriber = _FeedSubscriber(TOPIC, _any_type("*"))
        connection = InboundConnection(handler, subscriber, address, "http://127.0.0.1:1/")
        connection.start()
        try:
            await check(record)
        finally:
            connection.close()
            done.set()
            server.close()
        assert connection.socket is None

    asyncio.run(main())


SIZES = [0, 1, 3, 4, 5, 100, 65531, 65532, 65533, 65536, 70000, 200000, 3, 0, 131072, 7]


@pytest.mark.parametrize("chunk", [1 << 20, 65536, 4096, 1000])
def test_messages_arrive_whole_however_they_are_cut(chunk: int) -> None:
    bodies = [bytes([n % 251]) * size for n, size in enumerate(SIZES)]
    stream = encode_header(HEADER) + b"".join(map(frame, bodies))

    async def serve(writer: asyncio.StreamWriter) -> None:
        for start in range(0, len(stream), chunk):
            writer.write(stream[start : start + chunk])
            await writer.drain()

    async def check(record: Record) -> None:
        await record.until(lambda: len(record.messages) == len(bodies))
        assert record.messages == bodies

    run(serve, check)


def test_messages_arrive_whole_byte_by_byte() -> None:
    bodies = [b"", b"a", b"four", b"longer than that"]
    stream = encode_header(HEADER) + b"".join(map(frame, bodies))

    async def serve(writer: asyncio.StreamWriter) -> None:
        writer.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for start in range(len(stream)):
            writer.write(stream[start : start + 1])
            await asyncio.sleep(0)

    async def check(record: Record) -> None:
        await record.until(lambda: len(record.messages) == len(bodies))
        assert record.messages == bodies

    run(serve, check)


def test_a_large_message_takes_linear_time() -> None:
    body = bytes(100 * 1024 * 1024)

    async def serve(writer: asyncio.StreamWriter) -> None:
        writer.write(encode_header(HEADER) + struct.pack("<I", len(body)))
        for start in range(0, len(body), 1 << 20):
            writer.write(body[start : start + (1 << 20)])
            await writer.drain()

    async def check(record: Record) -> None:
        await record.until(lambda: bool(record.messages))
        assert len(record.messages[0]) == len(body)

    run(serve, check)


def test_a_corrupt_length_ends_the_connection_only() -> None:
    async def serve(writer: asyncio.StreamWriter) -> None:
        writer.write(encode_header(HEADER) + frame(b"good") + struct.pack("<I", 0xFFFFFFF0) + b"garbage")

    async def check(record: Record) -> None:
        await record.until(lambda: "disconnected" in record.events)
        assert record.messages == [b"good"]

    run(serve, check)


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (encode_header({"error": "not for you"}), "not for you"),
        (encode_header({"callerid": "/talker"}), "md5sum"),
        (struct.pack("<I", 0xFFFFFFFF), "a connection header of 4294967295 bytes"),
        (struct.pack("<I", 200 * 1024 * 1024) + bytes(1000), "a connection header of 209715200 bytes"),
        (struct.pack("<I", 6) + struct.pack("<I", 99) + b"ab", ""),
    ],
)
def test_a_bad_answer_is_refused_with_its_reason(answer: bytes, reason: str) -> None:
    async def serve(writer: asyncio.StreamWriter) -> None:
        writer.write(answer)

    async def check(record: Record) -> None:
        await record.until(lambda: bool(record.events))
        assert record.events[0].startswith("refused")
        assert reason in record.events[0]

    run(serve, check)


def test_a_length_that_nothing_follows_costs_no_memory() -> None:
    def resident_mib() -> float:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / (1 << 20)

    async def serve(writer: asyncio.StreamWriter) -> None:
        writer.write(encode_header(HEADER) + frame(b"good") + struct.pack("<I", 1 << 30) + b"a little of it")

    async def check(record: Record) -> None:
        await record.until(lambda: bool(record.messages))
        assert resident_mib() < before + 50

    before = resident_mib()
    run(serve, check)


def test_a_length_that_there_is_no_memory_for_ends_the_connection_only() -> None:
    async def serve(writer: asyncio.StreamWriter) -> None:
        writer.write(encode_header(HEADER) + frame(b"good") + struct.pack("<I", 1 << 30) + b"a little of it")

    async def check(record: Record) -> None:
        await record.until(lambda: "disconnected" in record.events)
        assert record.messages == [b"good"]

    before = resource.getrlimit(resource.RLIMIT_AS)
    virtual_bytes = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (virtual_bytes + (1 << 28), before[1]))
    try:
        run(serve, check)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.mark.parametrize("of", ["feeds", "publishers"])
def test_a_topic_that_ends_leaves_no_file_open_until_the_garbage_is_collected(of: str) -> None:
    """rospy's topics hold a poller that holds itself."""
    gc.collect()
    gc.disable()
    try:
        before = len(os.listdir("/proc/self/fd"))
        for number in range(50):
            if of == "feeds":
                topic: Any = _FeedSubscriber(f"/t{number}", _any_type("*"))
            else:
                topic = _LoopPublisher(f"/t{number}", _any_type("*"))
            topic.close()
            del topic
        assert len(os.listdir("/proc/self/fd")) <= before + 1
    finally:
        gc.enable()


def test_when_a_publisher_is_given_up_the_master_is_asked_again() -> None:
    """It may be back, and rospy have thought that it was connected still."""

    async def serve(writer: asyncio.StreamWriter) -> None:
        writer.write(encode_header(HEADER) + frame(b"last"))
        writer.close()

    async def check(record: Record) -> None:
        await record.until(lambda: f"given up {TOPIC}" in record.events)
        assert record.events == ["connected", "disconnected", f"given up {TOPIC}"]

    run(serve, check)


def test_a_publisher_that_never_answers_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcpros, "CONNECT_TIMEOUT_S", 0.2)

    async def serve(writer: asyncio.StreamWriter) -> None:
        """Say nothing."""

    async def check(record: Record) -> None:
        await record.until(lambda: bool(record.events))
        assert "no answer" in record.events[0]

    run(serve, check)


class _Publisher:
    """What an OutboundConnection needs of rospy's publisher."""

    resolved_name = TOPIC
    data_class = _any_type("std_msgs/String")
    is_latch = False


def outbound(check: Callable[[OutboundConnection, socket.socket], Awaitable[None]]) -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        listener = socket.create_server(("127.0.0.1", 0))
        subscriber = socket.create_connection(listener.getsockname())
        sock, address = listener.accept()
        listener.close()
        subscriber.setblocking(False)
        connection = OutboundConnection(loop, _Publisher(), sock, address, {"callerid": "/listener"})
        connection.start(lambda _: None)
        try:
            await _read_frame(subscriber)  # the header
            await asyncio.wait_for(check(connection, subscriber), 20.0)
        finally:
            connection.close()
            subscriber.close()

    asyncio.run(main())


async def _read(sock: socket.socket, count: int) -> bytes:
    read = b""
    while len(read) < count:
        read += await asyncio.get_running_loop().sock_recv(sock, count - len(read))
    return read


async def _read_frame(sock: socket.socket) -> bytes:
    (length,) = struct.unpack("<I", await _read(sock, 4))
    return await _read(sock, length)


def test_a_subscriber_that_reads_gets_everything_in_order() -> None:
    async def check(connection: OutboundConnection, subscriber: socket.socket) -> None:
        connection.queue_size = 100
        for number in range(100):
            connection.send(frame(b"%03d" % number + bytes(200_000)))
        for number in range(100):
            assert (await _read_frame(subscriber))[:3] == b"%03d" % number
        assert connection.dropped == 0

    outbound(check)


def test_a_subscriber_that_does_not_read_loses_the_oldest_whole_messages() -> None:
    async def check(connection: OutboundConnection, subscriber: socket.socket) -> None:
        connection.queue_size = 5
        for number in range(200):
            connection.send(frame(b"%03d" % number + bytes(300_000)))
        assert connection.dropped > 100
        numbers: List[int] = []
        while not numbers or numbers[-1] != 199:
            numbers.append(int((await _read_frame(subscriber))[:3]))
        assert numbers == sorted(numbers)
        assert numbers[-5:] == [195, 196, 197, 198, 199]
        assert len(numbers) == 200 - connection.dropped

    outbound(check)


def test_a_subscriber_that_leaves_is_noticed() -> None:
    async def check(connection: OutboundConnection, subscriber: socket.socket) -> None:
        gone: asyncio.Future[Optional[bool]] = asyncio.get_running_loop().create_future()
        connection.on_close = lambda: gone.set_result(True)
        subscriber.close()
        assert await gone
        connection.send(frame(b"into the void"))
        assert connection.done

    outbound(check)


def test_rospy_may_publish_from_a_thread_of_its_own() -> None:
    async def check(connection: OutboundConnection, subscriber: socket.socket) -> None:
        await asyncio.get_running_loop().run_in_executor(None, connection.write_data, frame(b"from a thread"))
        assert await _read_frame(subscriber) == b"from a thread"

    outbound(check)
