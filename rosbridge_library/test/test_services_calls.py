# SPDX-License-Identifier: BSD-3-Clause
"""Calling services of real rospy nodes, and of servers that break the protocol in every way."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import itertools
import os
import signal
import socket
import struct
import threading
import time
from pathlib import Path
from typing import Any, Awaitable, Callable, Dict, Iterator, List, Optional, Type, TypeVar

import pytest

from rosbridge_library.codec import get_service_type
from rosbridge_library.internal.exceptions import ValuesError
from rosbridge_library.ros.master import Master, MasterUnreachable
from rosbridge_library.ros.services import (
    BadServiceAnswer,
    InvalidServiceArguments,
    NoSuchService,
    ServiceCaller,
    ServiceDisconnected,
    ServiceFailed,
    ServiceRefused,
    ServiceReply,
    ServiceTimeout,
    ServiceTypeUnknown,
    ServiceUnreachable,
)
from rosbridge_library.ros.tcpros_header import decode_header, encode_header
from support import node as nodes
from support.ros import RosMaster
from support.wait import wait_until

ADD = "rosbridge_library/AddTwoInts"
T = TypeVar("T")

_numbers = itertools.count()


def fresh(name: str) -> str:
    """A service name that no other test uses."""
    return f"/{name}_{next(_numbers)}"


class Bench:
    """A caller on a master, which notes what it asks the master."""

    def __init__(self, ros_master: RosMaster, **options: Any) -> None:
        self.lookups: List[str] = []
        self.caller = ServiceCaller(self._call_blocking, Master("/bench", ros_master.uri), "/bench", **options)

    async def _call_blocking(self, function: Callable[..., T], *args: Any) -> T:
        if args[0] == "lookupService":
            self.lookups.append(args[1])
        return await asyncio.get_running_loop().run_in_executor(None, functools.partial(function, *args))

    async def call(self, service: str, arguments: Any = None, **options: Any) -> Dict[str, Any]:
        return values(await self.reply(service, arguments, **options))

    async def reply(self, service: str, arguments: Any = None, **options: Any) -> ServiceReply:
        return await self.caller.call(service, arguments, now=lambda: (12, 34), **options)


def values(reply: ServiceReply) -> Dict[str, Any]:
    return reply.type.to_values(reply.wire)


def run(ros_master: RosMaster, use: Callable[[Bench], Awaitable[T]], within: float = 30.0, **options: Any) -> T:
    """What `use` returns, given a bench of its own; nothing may be left open after it."""

    async def main() -> T:
        bench = Bench(ros_master, **options)
        before = set(os.listdir("/proc/self/fd"))
        try:
            return await use(bench)
        finally:
            await bench.caller.close()
            # The other ends of some connections are in this process too, and their threads need a moment.
            await until(lambda: not [fd for fd in set(os.listdir("/proc/self/fd")) - before if is_tcp(fd)])

    return asyncio.run(asyncio.wait_for(main(), within))


def is_tcp(descriptor: str) -> bool:
    try:
        with socket.socket(fileno=os.dup(int(descriptor))) as sock:
            return sock.family == socket.AF_INET
    except OSError:
        return False


class RawProvider:
    """A service at a plain socket: it exchanges headers, reads the request, and then does `answer` with the
    connection. Counts the requests, and the callers that left."""

    def __init__(
        self,
        ros_master: RosMaster,
        answer: Optional[Callable[[socket.socket], None]] = None,
        header: Optional[Dict[str, str]] = None,
        handshake: Optional[bytes] = None,
    ) -> None:
        self.name = fresh("raw")
        self.requests = 0
        self.left = 0
        self._answer = answer
        add = get_service_type(ADD)
        self._header = {"callerid": "/raw", "md5sum": add.md5sum, "type": ADD} if header is None else header
        self._handshake = handshake
        self._listener = socket.create_server(("127.0.0.1", 0), backlog=100)
        self.uri = f"rosrpc://127.0.0.1:{self._listener.getsockname()[1]}"
        ros_master.call("registerService", self.name, self.uri, "http://127.0.0.1:1/")
        threading.Thread(target=self._accept, daemon=True).start()

    def __enter__(self) -> RawProvider:
        return self

    def __exit__(self, *_: object) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        with connection, contextlib.suppress(OSError):
            fields = decode_header(exactly(connection, struct.unpack("<I", exactly(connection, 4))[0]))
            if self._handshake is not None:
                connection.sendall(self._handshake)
                return
            connection.sendall(encode_header(self._header))
            if fields.get("probe") == "1":
                return
            exactly(connection, struct.unpack("<I", exactly(connection, 4))[0])
            self.requests += 1
            if self._answer is not None:
                self._answer(connection)
                return
            if not connection.recv(1):
                self.left += 1


def exactly(connection: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        chunk = connection.recv(size - len(data))
        if not chunk:
            raise OSError("closed")
        data += chunk
    return data


def ok(body: bytes) -> bytes:
    return struct.pack("<BI", 1, len(body)) + body


@pytest.fixture(scope="module")
def adder(ros_master: RosMaster) -> Iterator[str]:
    with nodes.serve(ros_master, "/adder/sum", ADD, name="adder"):
        yield "/adder/sum"


@pytest.mark.parametrize(
    ("arguments", "total", "missing"),
    [
        ({"a": 2, "b": 3}, 5, []),
        ([2, 3], 5, []),
        ((2, 3), 5, []),
        ({"b": 3}, 3, ["a"]),
        ([2], 2, ["b"]),
        ([], 0, ["a", "b"]),
        ({}, 0, ["a", "b"]),
        (None, 0, ["a", "b"]),
    ],
)
def test_arguments(ros_master: RosMaster, adder: str, arguments: Any, total: int, missing: List[str]) -> None:
    reply = run(ros_master, lambda bench: bench.reply(adder, arguments))
    assert values(reply) == {"sum": total}
    assert reply.type.name == "rosbridge_library/AddTwoIntsResponse"
    assert reply.missing == missing


@pytest.mark.parametrize(
    ("arguments", "error", "text"),
    [
        ([1, 2, 3], InvalidServiceArguments, r"takes 2 arguments \(a, b\), not 3"),
        ("ab", InvalidServiceArguments, "str"),
        (7, InvalidServiceArguments, "int"),
        ({"a": "one"}, ValuesError, "a"),
        ({"c": 1}, ValuesError, "c"),
    ],
)
def test_arguments_that_do_not_fit(
    ros_master: RosMaster, adder: str, arguments: Any, error: Type[Exception], text: str
) -> None:
    async def use(bench: Bench) -> None:
        with pytest.raises(error, match=text):
            await bench.call(adder, arguments)
        assert await bench.call(adder, [1, 1]) == {"sum": 2}
        with pytest.raises(error, match=text):
            await bench.call(adder, arguments)

    run(ros_master, use)


def test_no_arguments_taken(ros_master: RosMaster) -> None:
    name = fresh("empty")
    with nodes.serve(ros_master, name, "std_srvs/Trigger", {"success": True, "message": "dône"}):

        async def use(bench: Bench) -> None:
            assert await bench.call(name) == {"success": True, "message": "dône"}
            with pytest.raises(InvalidServiceArguments, match="takes no arguments, not 1"):
                await bench.call(name, [1])

        run(ros_master, use)


def test_an_installed_header_is_stamped(ros_master: RosMaster) -> None:
    name = fresh("pose")
    with nodes.serve(ros_master, name, "rosbridge_library/TestNestedService", {"data": {"data": 1.5}}) as provider:
        reply = run(ros_master, lambda bench: bench.reply(name, {"pose": {"position": {"x": 4}}}))
        assert values(reply) == {"data": {"data": 1.5}}
        assert reply.missing == ["pose.position.y", "pose.position.z", "pose.orientation"]
        assert provider.wait_records("request")[0]["pose"]["position"]["x"] == 4.0


def test_large_answer(ros_master: RosMaster) -> None:
    name = fresh("bytes")
    source = (
        "from rosbridge_library.srv import SendBytes\n"
        f"rospy.Service({name!r}, SendBytes, lambda request: 'x' * request.count)\n"
        "ready()\nrospy.spin()\n"
    )
    with nodes.script(ros_master, source, name="send_bytes"):
        reply = run(ros_master, lambda bench: bench.reply(name, [50_000_000]))
        assert len(reply.wire) == 50_000_004
        assert len(values(reply)["data"]) == 50_000_000


def test_no_such_service(ros_master: RosMaster) -> None:
    async def use(bench: Bench) -> None:
        with pytest.raises(NoSuchService, match="/nothing does not exist"):
            await bench.call("/nothing")

    run(ros_master, use)


@pytest.mark.parametrize("name", ["", "/", "/with space", "/a:b"])
def test_illegal_names(ros_master: RosMaster, name: str) -> None:
    async def use(bench: Bench) -> None:
        with pytest.raises(NoSuchService):
            await bench.call(name)

    run(ros_master, use)


def test_the_provider_says_why_it_failed(ros_master: RosMaster) -> None:
    name = fresh("fails")
    with nodes.serve(ros_master, name, ADD, behaviour="fail"):

        async def use(bench: Bench) -> None:
            for _ in range(2):
                with pytest.raises(ServiceFailed, match=f"{name} failed: .*it failed, as asked"):
                    await bench.call(name, [1, 2])
            assert bench.lookups == [name]  # it is where it was

        run(ros_master, use)


def test_a_provider_that_hangs(ros_master: RosMaster) -> None:
    name = fresh("hangs")
    with nodes.serve(ros_master, name, ADD, behaviour="hang"):

        async def use(bench: Bench) -> None:
            begin = time.monotonic()
            with pytest.raises(ServiceTimeout, match=rf"{name} took longer than 0\.5 s.*waiting for the answer"):
                await bench.call(name, [1, 2], timeout=0.5)
            assert 0.45 < time.monotonic() - begin < 1.5

        run(ros_master, use)


def test_the_default_timeout(ros_master: RosMaster) -> None:
    with RawProvider(ros_master) as provider:

        async def use(bench: Bench) -> None:
            with pytest.raises(ServiceTimeout, match=r"0\.3 s"):
                await bench.call(provider.name, [1, 2])
            unlimited = asyncio.ensure_future(bench.call(provider.name, [1, 2], timeout=0))
            done, _ = await asyncio.wait({unlimited}, timeout=0.8)
            assert not done
            unlimited.cancel()
            await asyncio.wait({unlimited})

        run(ros_master, use, default_timeout=0.3)


def test_a_provider_that_never_says_a_word(ros_master: RosMaster) -> None:
    name = fresh("deaf")
    with nodes.serve(ros_master, name, ADD, behaviour="deaf"):

        async def use(bench: Bench) -> None:
            with pytest.raises(ServiceTimeout, match="looking it up"):
                await bench.call(name, [1, 2], timeout=0.5)

        run(ros_master, use)


def test_a_node_that_is_stopped_after_the_first_call(ros_master: RosMaster) -> None:
    name = fresh("stops")
    with nodes.serve(ros_master, name, ADD) as provider:

        async def use(bench: Bench) -> None:
            assert await bench.call(name, [1, 2]) == {"sum": 3}
            provider.process.signal(signal.SIGSTOP)
            try:
                with pytest.raises(ServiceTimeout, match="connecting to rosrpc://"):
                    await bench.call(name, [1, 2], timeout=0.5)
            finally:
                provider.process.signal(signal.SIGCONT)
            assert await bench.call(name, [1, 2]) == {"sum": 3}

        run(ros_master, use)


@pytest.mark.parametrize("end", ["die", "kill"])
def test_a_provider_that_dies_in_the_middle_of_a_call(ros_master: RosMaster, end: str) -> None:
    name = fresh("dies")
    with nodes.serve(ros_master, name, ADD, behaviour="die" if end == "die" else "hang") as provider:

        async def use(bench: Bench) -> None:
            call = asyncio.ensure_future(bench.call(name, [1, 2], timeout=20))
            if end == "kill":
                wait = functools.partial(provider.wait_records, "request")
                await asyncio.get_running_loop().run_in_executor(None, wait)
                provider.process.signal(signal.SIGKILL)
            begin = time.monotonic()
            with pytest.raises(ServiceDisconnected, match=f"{name} at rosrpc://"):
                await call
            assert time.monotonic() - begin < 5.0
            with nodes.serve(ros_master, name, ADD):
                assert await bench.call(name, [1, 2]) == {"sum": 3}

        run(ros_master, use)


def test_a_node_that_is_gone_and_still_registered(ros_master: RosMaster) -> None:
    name = fresh("gone")
    with nodes.serve(ros_master, name, ADD) as provider:
        provider.kill()

    async def use(bench: Bench) -> None:
        with pytest.raises(ServiceUnreachable, match=rf"{name} can't be reached at rosrpc://.*: Connection refused"):
            await bench.call(name, [1, 2])

    run(ros_master, use)


@pytest.mark.parametrize("uri", ["rosrpc://127.0.0.1", "rosrpc://127.0.0.1:99999", "rosrpc://:80", "rosrpc://x:²"])
def test_a_uri_that_is_none(ros_master: RosMaster, uri: str) -> None:
    name = fresh("lost")
    ros_master.call("registerService", name, uri, "http://127.0.0.1:1/")

    async def use(bench: Bench) -> None:
        with pytest.raises(ServiceUnreachable, match="rosrpc://host:port"):
            await bench.call(name)

    run(ros_master, use)


def test_a_host_that_is_unknown(ros_master: RosMaster) -> None:
    name = fresh("nowhere")
    ros_master.call("registerService", name, "rosrpc://no-such-host.invalid:80", "http://127.0.0.1:1/")

    async def use(bench: Bench) -> None:
        results = await asyncio.gather(*(bench.call(name) for _ in range(20)), return_exceptions=True)
        assert {type(result) for result in results} == {ServiceUnreachable}

    run(ros_master, use)


def test_looked_up_once(ros_master: RosMaster, adder: str) -> None:
    async def use(bench: Bench) -> None:
        results = await asyncio.gather(*(bench.call(adder, [number, 1]) for number in range(30)))
        assert results == [{"sum": number + 1} for number in range(30)]
        for number in range(30):
            await bench.call(adder, [number, 1])
        assert bench.lookups == [adder]

    run(ros_master, use)


def test_one_who_stops_waiting_does_not_end_the_lookup_for_others(ros_master: RosMaster, adder: str) -> None:
    async def use(bench: Bench) -> None:
        first = asyncio.ensure_future(bench.call(adder, [1, 2]))
        second = asyncio.ensure_future(bench.call(adder, [1, 2]))
        await asyncio.sleep(0)
        assert bench.lookups == [] or not first.done()
        first.cancel()
        assert await second == {"sum": 3}
        assert first.cancelled()
        assert bench.lookups == [adder]

    run(ros_master, use)


def test_a_provider_that_moved_is_found_without_an_error(ros_master: RosMaster) -> None:
    name = fresh("moves")

    async def use(bench: Bench) -> None:
        with nodes.serve(ros_master, name, ADD):
            assert await bench.call(name, [1, 2]) == {"sum": 3}
        with nodes.serve(ros_master, name, ADD) as second:
            assert await bench.call(name, [1, 2]) == {"sum": 3}
            assert second.records("request") == [{"a": 1, "b": 2}]
        assert bench.lookups == [name, name]

    run(ros_master, use)


def test_a_service_that_comes_back_with_another_type(ros_master: RosMaster) -> None:
    name = fresh("changes")
    source = (
        "from std_srvs.srv import SetBool\nfrom rosbridge_library.srv import AddTwoInts\nimport sys\n"
        f"service = rospy.Service({name!r}, AddTwoInts, lambda request: request.a + request.b)\n"
        "def change(_):\n"
        "    global service\n"
        "    service.shutdown()\n"
        f"    service = rospy.Service({name!r}, SetBool, lambda request: (request.data, 'text'))\n"
        "    return True, ''\n"
        f"rospy.Service({name!r} + '/change', SetBool, change)\n"
        "ready()\nrospy.spin()\n"
    )
    with nodes.script(ros_master, source, name="changing"):

        async def use(bench: Bench) -> None:
            assert await bench.call(name, [1, 2]) == {"sum": 3}
            await bench.call(name + "/change", [True])
            assert await bench.call(name, {"data": True}) == {"success": True, "message": "text"}

        run(ros_master, use)


def test_the_type_is_looked_up_anew_for_arguments_of_both(ros_master: RosMaster) -> None:
    """A positional argument fits the old type and the new one: the call must go to the new one."""
    with RawProvider(ros_master, lambda connection: connection.sendall(ok(b"\0" * 8))) as provider:

        async def use(bench: Bench) -> None:
            assert await bench.call(provider.name, [1]) == {"sum": 0}
            provider._header = {"error": "md5sums do not match"}
            with nodes.serve(ros_master, provider.name, "rosbridge_library/TestRequestAndResponse", {"data": 7}):
                assert await bench.call(provider.name, [1]) == {"data": 7}
            assert provider.requests == 1

        run(ros_master, use)


def test_a_request_is_never_sent_twice(ros_master: RosMaster) -> None:
    answers: List[bytes] = [ok(b"\x05" + b"\0" * 7), b""]
    with RawProvider(ros_master, lambda connection: connection.sendall(answers.pop(0))) as provider:

        async def use(bench: Bench) -> None:
            assert await bench.call(provider.name, [2, 3]) == {"sum": 5}
            with pytest.raises(ServiceDisconnected):
                await bench.call(provider.name, [2, 3])
            assert provider.requests == 2
            assert bench.lookups == [provider.name]

        run(ros_master, use)


@pytest.mark.parametrize(
    ("answer", "error"),
    [
        (b"", ServiceDisconnected),
        (b"\x01", ServiceDisconnected),
        (b"\x01\x08\0\0\0\x05\0\0", ServiceDisconnected),
        (b"\0\x08\0\0\0only", ServiceDisconnected),
        (b"HTTP/1.1 200 OK\r\n\r\n", BadServiceAnswer),
        (b"\x01\xff\xff\xff\xff", BadServiceAnswer),
        (b"\0\xff\xff\xff\x7f", BadServiceAnswer),
    ],
)
def test_answers_that_are_none(ros_master: RosMaster, answer: bytes, error: Type[Exception]) -> None:
    with RawProvider(ros_master, lambda connection: connection.sendall(answer)) as provider:

        async def use(bench: Bench) -> None:
            with pytest.raises(error, match=provider.name):
                await bench.call(provider.name, [2, 3], timeout=5)

        run(ros_master, use)


def test_an_error_text_that_is_not_utf8(ros_master: RosMaster) -> None:
    body = b"\xff\xfe"
    answer = struct.pack("<BI", 0, len(body)) + body
    with RawProvider(ros_master, lambda connection: connection.sendall(answer)) as provider:

        async def use(bench: Bench) -> None:
            with pytest.raises(ServiceFailed, match="\ufffd"):
                await bench.call(provider.name, [2, 3])

        run(ros_master, use)


def test_an_answer_over_the_limit_is_not_read(ros_master: RosMaster) -> None:
    answer = ok(b"\0" * 8)
    with RawProvider(ros_master, lambda connection: connection.sendall(answer)) as provider:

        async def use(bench: Bench) -> None:
            with pytest.raises(BadServiceAnswer, match="8 bytes, over 7"):
                await bench.call(provider.name, [2, 3])

        run(ros_master, use, max_answer_bytes=7)


def test_an_answer_that_comes_byte_by_byte(ros_master: RosMaster) -> None:
    def drip(connection: socket.socket) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for byte in ok(struct.pack("<q", 5)):
            connection.sendall(bytes([byte]))
            time.sleep(0.01)

    with RawProvider(ros_master, drip) as provider:
        assert run(ros_master, lambda bench: bench.call(provider.name, [2, 3])) == {"sum": 5}


@pytest.mark.parametrize(
    "handshake",
    [
        b"",
        b"\x05",
        b"HTTP/1.1 400 Bad Request\r\n\r\n",
        b"\x05\0\0\0\x01\0\0\0x",
        b"\x08\0\0\0\xff\xff\xff\xffabcd",
    ],
)
def test_headers_that_are_none(ros_master: RosMaster, handshake: bytes) -> None:
    with RawProvider(ros_master, handshake=handshake) as provider:

        async def use(bench: Bench) -> None:
            with pytest.raises(ServiceUnreachable, match=provider.uri):
                await bench.call(provider.name, [2, 3])

        run(ros_master, use)


def test_a_node_that_does_not_provide_it(ros_master: RosMaster, adder: str) -> None:
    name = fresh("elsewhere")
    uri = ros_master.call("lookupService", adder)
    ros_master.call("registerService", name, uri, "http://127.0.0.1:1/")

    async def use(bench: Bench) -> None:
        with pytest.raises(ServiceRefused, match=f"not a provider of.*{name}"):
            await bench.call(name)

    run(ros_master, use)


@pytest.mark.parametrize(
    ("header", "text"),
    [
        ({"type": "no_such_package/Type", "md5sum": "0" * 32}, "no_such_package"),
        ({"type": "rosbridge_library/NoSuchType", "md5sum": "0" * 32}, "NoSuchType"),
        ({"type": "nonsense", "md5sum": "0" * 32}, "nonsense"),
        ({"type": ADD, "md5sum": "0" * 32}, "another version of type rosbridge_library/AddTwoInts"),
        ({"md5sum": "0" * 32}, "does not say of what type it is"),
    ],
)
def test_types_that_are_unknown(ros_master: RosMaster, header: Dict[str, str], text: str) -> None:
    with RawProvider(ros_master, header=header) as provider:

        async def use(bench: Bench) -> None:
            with pytest.raises(ServiceTypeUnknown, match=text):
                await bench.call(provider.name)

        run(ros_master, use)


def test_the_clients_type_is_used_where_the_provider_names_none(ros_master: RosMaster, adder: str) -> None:
    answer = ok(struct.pack("<q", 5))
    with RawProvider(ros_master, lambda connection: connection.sendall(answer), header={}) as provider:
        assert run(ros_master, lambda bench: bench.call(provider.name, [2, 3], type_name=ADD)) == {"sum": 5}
    assert run(ros_master, lambda bench: bench.call(adder, [2, 3], type_name="wrong/Type")) == {"sum": 5}


def test_cancelling_closes_the_connection(ros_master: RosMaster) -> None:
    with RawProvider(ros_master) as provider:

        async def use(bench: Bench) -> None:
            calls = [asyncio.ensure_future(bench.call(provider.name, [1, 2])) for _ in range(10)]
            await until(lambda: provider.requests == 10)
            for call in calls:
                call.cancel()
            await until(lambda: provider.left == 10)
            assert all(call.cancelled() for call in calls)

        run(ros_master, use)


async def until(condition: Callable[[], bool]) -> None:
    """Waits for the condition with a deadline, while the loop goes on."""
    await asyncio.get_running_loop().run_in_executor(None, lambda: wait_until(condition, 10.0))


def test_slow_calls_delay_nothing_else(ros_master: RosMaster, adder: str) -> None:
    name = fresh("slow")
    with nodes.serve(ros_master, name, ADD, delay=2.0):

        async def use(bench: Bench) -> None:
            await bench.call(adder, [1, 2])
            begin = time.monotonic()
            slow = [asyncio.ensure_future(bench.call(name, [number, 1])) for number in range(60)]
            while not all(call.done() for call in slow):
                before = time.monotonic()
                assert await bench.call(adder, [1, 2]) == {"sum": 3}
                assert time.monotonic() - before < 1.0
                await asyncio.sleep(0.05)
            assert [call.result() for call in slow] == [{"sum": number + 1} for number in range(60)]
            assert time.monotonic() - begin < 8.0  # one after the other they take 120 s

        run(ros_master, use)


def test_a_large_answer_leaves_the_loop_its_turns(ros_master: RosMaster) -> None:
    """The answer is always there to be read: reading it must not keep others from running."""
    answer = ok(b"\0" * 200_000_000)
    with RawProvider(ros_master, lambda connection: connection.sendall(answer)) as provider:

        async def use(bench: Bench) -> None:
            call = asyncio.ensure_future(bench.reply(provider.name, [2, 3]))
            turns = 0
            while not call.done():
                await asyncio.sleep(0)
                turns += 1
            assert len(call.result().wire) == 200_000_000
            assert turns > 300

        run(ros_master, use)


def test_the_master_is_away(ros_master: RosMaster, adder: str) -> None:
    async def use(bench: Bench) -> None:
        assert await bench.call(adder, [1, 2]) == {"sum": 3}
        ros_master.process.signal(signal.SIGSTOP)
        try:
            assert await bench.call(adder, [1, 2]) == {"sum": 3}
            with pytest.raises(ServiceTimeout, match="looking it up"):
                await bench.call("/other", timeout=0.5)
        finally:
            ros_master.process.signal(signal.SIGCONT)

    run(ros_master, use)


def test_the_master_is_down(tmp_path: Path) -> None:
    with RosMaster(tmp_path) as master:
        pass

    async def use(bench: Bench) -> None:
        with pytest.raises(MasterUnreachable, match=master.uri):
            await bench.call("/anything")

    run(master, use)
