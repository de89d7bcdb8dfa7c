# SPDX-License-Identifier: BSD-3-Clause
"""The XML-RPC client against a real master, a real node, and servers that hang, trickle and talk nonsense."""

from __future__ import annotations

import contextlib
import signal
import socket
import threading
import time
import xmlrpc.client
from concurrent.futures import ThreadPoolExecutor
from typing import Callable, Iterator

import pytest

from rosbridge_library.ros.master import (
    Master,
    MasterError,
    MasterUnreachable,
    NodeApi,
    NodeUnreachable,
    UnsupportedValue,
)
from support import node as nodes
from support.ros import RosMaster


@contextlib.contextmanager
def server(answer: Callable[[socket.socket], None]) -> Iterator[str]:
    """The uri of a server that does `answer` with the connection, once a request is there, and closes it."""
    listener = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            with connection, contextlib.suppress(OSError):
                request = b""
                while b"</methodCall>" not in request:
                    request += connection.recv(65536)
                answer(connection)

    threading.Thread(target=serve, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{listener.getsockname()[1]}/"
    finally:
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()


def http(body: bytes, status: str = "200 OK") -> Callable[[socket.socket], None]:
    def answer(connection: socket.socket) -> None:
        head = f"HTTP/1.1 {status}\r\nContent-Type: text/xml\r\nContent-Length: {len(body)}\r\n\r\n"
        connection.sendall(head.encode() + body)

    return answer


def xml(*values: object) -> bytes:
    return xmlrpc.client.dumps((values,), methodresponse=True).encode()


def test_returns_the_value(ros_master: RosMaster) -> None:
    master = Master("/test", ros_master.uri)
    assert master.call("getPid") == ros_master.process.pid
    master.call("setParam", "/a", {"text": "Ünïcode <&>", "list": [1, 2.5, True], "bytes": b"\x00\xff"})
    assert master.call("getParam", "/a") == {
        "text": "Ünïcode <&>",
        "list": [1, 2.5, True],
        "bytes": b"\x00\xff",
    }


def test_takes_the_uri_of_the_environment(ros_master: RosMaster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_MASTER_URI", ros_master.uri)
    assert Master("/test").call("getUri").rstrip("/").endswith(str(ros_master.port))


def test_refusal_carries_the_masters_reason(ros_master: RosMaster) -> None:
    with pytest.raises(MasterError, match="no provider"):
        Master("/test", ros_master.uri).call("lookupService", "/nothing")


def test_unknown_method_is_an_error(ros_master: RosMaster) -> None:
    with pytest.raises(MasterError, match="noSuchMethod"):
        Master("/test", ros_master.uri).call("noSuchMethod")


@pytest.mark.parametrize("value", [None, 2**31, "\ud800", object()])
def test_arguments_that_xmlrpc_lacks(ros_master: RosMaster, value: object) -> None:
    with pytest.raises(UnsupportedValue, match="setParam"):
        Master("/test", ros_master.uri).call("setParam", "/a", value)


def test_nobody_listens() -> None:
    with socket.create_server(("127.0.0.1", 0)) as closed:
        uri = f"http://127.0.0.1:{closed.getsockname()[1]}/"
    with pytest.raises(MasterUnreachable, match=f"{uri}.*Connection refused"):
        Master("/test", uri).call("getPid")


@pytest.mark.parametrize(
    "uri", ["", "nonsense", "ftp://127.0.0.1:1/", "http://:11311", "http://127.0.0.1:port/", "http://[::1/"]
)
def test_malformed_uri(uri: str) -> None:
    with pytest.raises(MasterUnreachable):
        Master("/test", uri).call("getPid")


def test_unknown_host() -> None:
    with pytest.raises(MasterUnreachable, match=r"no-such-host\.invalid"):
        Master("/test", "http://no-such-host.invalid:11311/").call("getPid")


def trickle(connection: socket.socket) -> None:
    connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 100000\r\n\r\n")
    while True:
        connection.sendall(b" ")
        time.sleep(0.02)


def hang(connection: socket.socket) -> None:
    connection.recv(1)


@pytest.mark.parametrize("answer", [hang, trickle])
def test_deadline_covers_the_whole_call(answer: Callable[[socket.socket], None]) -> None:
    with server(answer) as uri:
        begin = time.monotonic()
        with pytest.raises(MasterUnreachable, match=r"no answer to getPid within 0\.3 s"):
            Master("/test", uri, timeout=0.3).call("getPid")
        assert time.monotonic() - begin < 1.0


def test_deadline_of_one_call() -> None:
    with server(hang) as uri, pytest.raises(MasterUnreachable, match=r"within 0\.2 s"):
        Master("/test", uri, timeout=60.0).call("getPid", timeout=0.2)


def test_deadline_at_a_full_listen_queue() -> None:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen(0)
        address = listener.getsockname()
        waiting = [socket.socket() for _ in range(4)]  # fill the queue: the kernel drops further connections
        for each in waiting:
            each.setblocking(False)
            each.connect_ex(address)
        begin = time.monotonic()
        with pytest.raises(NodeUnreachable, match="no answer"):
            NodeApi("/test", f"http://127.0.0.1:{address[1]}/", timeout=0.3).call("getPid")
        assert time.monotonic() - begin < 1.0
        for each in waiting:
            each.close()


def test_default_timeout_of_sockets_has_no_influence(ros_master: RosMaster) -> None:
    before = socket.getdefaulttimeout()
    socket.setdefaulttimeout(0.0001)
    try:
        assert Master("/test", ros_master.uri).call("getPid") == ros_master.process.pid
        assert socket.getdefaulttimeout() == 0.0001
    finally:
        socket.setdefaulttimeout(before)


@pytest.mark.parametrize(
    "answer",
    [
        http(b"<html>not found</html>", "404 Not Found"),
        http(b"this is not XML"),
        http(b"<methodResponse></methodResponse>"),
        http(xml(1, "two of three")),
        http(xmlrpc.client.dumps(("text",), methodresponse=True).encode()),
        http(b"<methodResponse><params></params></methodResponse>"),
        http(b"\xff\xfe\x00"),
        lambda connection: connection.sendall(b"garbage\r\n\r\n"),
        lambda connection: connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 1000\r\n\r\n<?xml"),
        lambda connection: connection.sendall(b"HTTP/1.1 200 OK\r\n" + b"x" * 100_000),
        lambda connection: None,
    ],
)
def test_answers_that_are_none(answer: Callable[[socket.socket], None]) -> None:
    with server(answer) as uri, pytest.raises(MasterUnreachable, match=uri):
        Master("/test", uri, timeout=5.0).call("getPid")


def test_calls_of_many_threads(ros_master: RosMaster) -> None:
    master = Master("/test", ros_master.uri)

    def set_and_get(number: int) -> bool:
        master.call("setParam", f"/threads/{number}", number)
        return bool(master.call("getParam", f"/threads/{number}") == number)

    with ThreadPoolExecutor(8) as threads:
        assert all(threads.map(set_and_get, range(40)))


def test_a_hanging_call_delays_no_other(ros_master: RosMaster) -> None:
    with server(hang) as uri, ThreadPoolExecutor(1) as threads:
        slow = threads.submit(lambda: Master("/test", uri, 1.0).call("getPid"))
        begin = time.monotonic()
        Master("/test", ros_master.uri).call("getPid")
        assert time.monotonic() - begin < 0.5
        assert not slow.done()
        with pytest.raises(MasterUnreachable):
            slow.result()


def test_the_api_of_a_node_which_then_stops(ros_master: RosMaster) -> None:
    with nodes.serve(ros_master, "/sum", name="adder") as adder:
        uri = Master("/test", ros_master.uri).call("lookupNode", "/adder")
        api = NodeApi("/test", uri, timeout=0.3)
        assert api.call("getPid", timeout=5.0) == adder.process.pid
        adder.process.signal(signal.SIGSTOP)
        try:
            with pytest.raises(NodeUnreachable, match=f"{uri}.*no answer to getPid"):
                api.call("getPid")
        finally:
            adder.process.signal(signal.SIGCONT)


def test_the_master_comes_back(ros_master: RosMaster) -> None:
    master = Master("/test", ros_master.uri)
    ros_master.kill()
    with pytest.raises(MasterUnreachable, match="Connection refused"):
        master.call("getPid")
    ros_master.restart()
    assert master.call("getPid") == ros_master.process.pid
