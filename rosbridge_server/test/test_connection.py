# SPDX-License-Identifier: BSD-3-Clause
"""The websocket server by itself, in this process and without ROS, with a protocol that echoes."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import socket
import ssl
import struct
import subprocess
import time
from pathlib import Path
from typing import Any, AsyncIterator, Awaitable, Callable, Dict, List, Mapping, Optional, Tuple

import pytest
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from rosbridge_library.payload import Outbox, Payload
from rosbridge_server.server import ListenError, ProtocolFactory, WebSocketServer
from rosbridge_server.settings import Settings

MIB = 1 << 20


class Echo:
    """Sends back each message as text; some words make it do other things."""

    def __init__(self, client_id: str, parameters: Mapping[str, Any], outbox: Outbox) -> None:
        self.client_id = client_id
        self.parameters = parameters
        self.outbox = outbox
        self.received: List[bytes] = []
        self.finished = 0
        self.wait: Optional[Awaitable[None]] = None

    def incoming(self, message: bytes) -> Optional[Awaitable[None]]:
        assert isinstance(message, bytes)
        self.received.append(message)
        if message == b"fail":
            raise RuntimeError("a bug in the protocol")
        if message == b"wait":
            return self.wait
        self.outbox.send(Payload([message], binary=message[:1] == b"\xa0"))
        return None

    def dropped(self, messages: Mapping[str, int]) -> None:
        """Nothing is dropped here that a test asks for."""

    def finish(self) -> None:
        self.finished += 1


class Connected(Dict[str, str]):
    """The clients that the server told of."""

    def add(self, client_id: str, ip_address: str) -> None:
        self[client_id] = ip_address

    def remove(self, client_id: str) -> None:
        del self[client_id]


class Running:
    """A server that listens, and the protocols that it made."""

    def __init__(self, settings: Settings, subprotocols: List[str]) -> None:
        self.made: List[Tuple[Optional[str], Echo]] = []
        self.clients = Connected()
        protocols: Dict[Optional[str], ProtocolFactory] = {name: self._factory(name) for name in [None, *subprotocols]}
        self.server = WebSocketServer(settings, protocols, self.clients)  # type: ignore[arg-type]

    def _factory(self, name: Optional[str]) -> ProtocolFactory:
        def make(client_id: str, parameters: Mapping[str, Any], outbox: Outbox) -> Echo:
            self.made.append((name, Echo(client_id, parameters, outbox)))
            return self.made[-1][1]

        return make

    @property
    def last(self) -> Echo:
        return self.made[-1][1]

    def connect(self, path: str = "/", **options: Any) -> Any:
        scheme = "wss" if self.server.settings.ssl else "ws"
        options = {"compression": None, "max_size": None, "proxy": None, "ping_interval": None, **options}
        return connect(f"{scheme}://127.0.0.1:{self.server.port}{path}", **options)

    async def raw(self, **headers: str) -> Tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """A connection after its handshake, for a client that breaks the rules."""
        return await self.raw_over(socket.create_connection(("127.0.0.1", self.server.port)), **headers)

    async def raw_over(
        self, connected: socket.socket, limit: int = 65536, **headers: str
    ) -> Tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """The same over a connected socket; `limit`: how much is read ahead, about."""
        reader, writer = await asyncio.open_connection(sock=connected, limit=limit)
        writer.write(handshake(**headers))
        assert b" 101 " in await reader.readline()
        while await reader.readline() != b"\r\n":
            pass
        return reader, writer


def small_window_socket(port: int) -> socket.socket:
    """A connection whose kernel takes little that nobody reads."""
    connected = socket.socket()
    connected.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8192)
    connected.connect(("127.0.0.1", port))
    return connected


def handshake(path: str = "/", **headers: str) -> bytes:
    lines = {
        "Host": "robot",
        "Upgrade": "websocket",
        "Connection": "Upgrade",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
        "Sec-WebSocket-Version": "13",
        **{name.replace("_", "-"): value for name, value in headers.items()},
    }
    text = "".join(f"{name}: {value}\r\n" for name, value in lines.items())
    return f"GET {path} HTTP/1.1\r\n{text}\r\n".encode("latin-1")


@contextlib.asynccontextmanager
async def serving(subprotocols: Optional[List[str]] = None, **settings: Any) -> AsyncIterator[Running]:
    running = Running(Settings(**{"port": 0, "address": "127.0.0.1", **settings}), subprotocols or [])
    await running.server.listen()
    try:
        yield running
    finally:
        running.server.close()
        await asyncio.wait_for(running.server.closed(), 10)


async def until(condition: Callable[[], Any], seconds: float = 10.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "the condition did not come true"
        await asyncio.sleep(0.005)


async def status_of(running: Running, request: bytes) -> Tuple[int, bytes]:
    """The status code and the whole answer to a request."""
    reader, writer = await asyncio.open_connection("127.0.0.1", running.server.port)
    writer.write(request)
    head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), 10)
    code = int(head.split()[1])
    body = b""
    for line in head.split(b"\r\n"):
        if line.lower().startswith(b"content-length:"):
            body = await reader.readexactly(int(line.split(b":")[1]))
    writer.close()
    return code, head + body


def masked(opcode: int, body: bytes, final: bool = True, length: Optional[int] = None) -> bytes:
    size = len(body) if length is None else length
    mask = b"\x01\x02\x03\x04"
    head = struct.pack("!BBQ", (0x80 if final else 0) | opcode, 0xFF, size)
    return head + mask + bytes(byte ^ key for byte, key in zip(body, itertools.cycle(mask)))


# The handshake


@pytest.mark.parametrize(
    "path", ["/", "/rosbridge?token=1&x", "//", "/a/b/c/", "/%00%ff", "/ü", "/?", "*", "http://robot/abs"]
)
def test_any_path(path: str) -> None:
    async def run() -> None:
        async with serving() as running:
            code, _ = await status_of(running, handshake(path))
            assert code == 101

    asyncio.run(run())


@pytest.mark.parametrize("host", ["robot", "robot_1.local:9090", "[fe80::1]:9090", "10.0.0.1:1", "x" * 200])
def test_any_host(host: str) -> None:
    async def run() -> None:
        async with serving() as running:
            code, _ = await status_of(running, handshake(Host=host))
            assert code == 101

    asyncio.run(run())


ORIGINS = [
    {},
    {"Origin": "null"},
    {"Origin": ""},
    {"Origin": "http://elsewhere.example"},
    {"Origin": "elsewhere.example"},
    {"Origin": "file://"},
    {"Origin": "http://[not an address"},
    {"Origin": "capacitor://localhost"},
    {"Sec_Fetch_Site": "cross-site"},
    {"Sec_Fetch_Site": "cross-site", "Origin": "null"},
]


@pytest.mark.parametrize("headers", ORIGINS, ids=str)
def test_any_origin(headers: Dict[str, str]) -> None:
    async def run() -> None:
        async with serving() as running:
            code, _ = await status_of(running, handshake(**headers))
            assert code == 101

    asyncio.run(run())


@pytest.mark.parametrize("headers", ORIGINS, ids=str)
def test_the_null_origin_alone_can_be_refused(headers: Dict[str, str]) -> None:
    async def run() -> None:
        async with serving(websocket_null_origin=False) as running:
            code, answer = await status_of(running, handshake(**headers))
            if headers.get("Origin") == "null":
                assert code == 403
                assert b"websocket_null_origin" in answer
            else:
                assert code == 101

    asyncio.run(run())


@pytest.mark.parametrize("offered", [["rosbridge_v2"], ["a", "b"], ["soap", "wamp"]])
def test_a_subprotocol_that_is_not_known_is_ignored(offered: List[str]) -> None:
    async def run() -> None:
        async with serving() as running, running.connect(subprotocols=offered) as client:
            assert client.subprotocol is None
            await client.send("hello")
            assert await client.recv() == "hello"
            assert [name for name, _ in running.made] == [None]

    asyncio.run(run())


def test_the_subprotocol_chooses_the_protocol() -> None:
    async def run() -> None:
        async with serving(["one", "two"]) as running:
            for offered, chosen in ((["two"], "two"), (["x", "two", "one"], "two"), (["one", "two"], "one")):
                async with running.connect(subprotocols=offered) as client:
                    assert client.subprotocol == chosen
                    assert running.made[-1][0] == chosen
            async with running.connect() as client:
                assert client.subprotocol is None
                assert running.made[-1][0] is None

    asyncio.run(run())


def test_a_browser_that_opens_the_address_is_told_what_this_is() -> None:
    async def run() -> None:
        async with serving(websocket_external_port=8443) as running:
            request = b"GET /index.html HTTP/1.1\r\nHost: robot.local:1234\r\n\r\n"
            code, answer = await status_of(running, request)
            assert code == 426
            assert b"rosbridge websocket server" in answer
            assert b"ws://robot.local:8443" in answer
        async with serving() as running:
            _, answer = await status_of(running, request)
            assert b"ws://robot.local:%d" % running.server.port in answer
            for request in (
                b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 2\r\n\r\n{}",
                b"BREW / HTTP/1.1\r\nHost: x\r\n\r\n",
            ):
                code, _ = await status_of(running, request)
                assert 400 <= code < 500
            code, _ = await status_of(running, handshake(Sec_WebSocket_Version="99"))
            assert code == 426
            code, _ = await status_of(running, handshake(Sec_WebSocket_Key=""))
            assert code == 400
            assert running.made == []

    asyncio.run(run())


# Messages


def test_text_and_binary_come_as_they_were_sent_and_large_ones_too() -> None:
    async def run() -> None:
        async with serving() as running, running.connect() as client:
            for message in ("", "{}", "äöü€😀", "x" * 125, "x" * 126, "x" * 65536, "y" * 5_000_000, b"\xa0" * 70000):
                await client.send(message)
                assert await client.recv() == message
            assert running.last.parameters["websocket_ping_interval"] == 20.0

    asyncio.run(run())


def test_a_message_of_50_mb_in_one_frame_and_in_many() -> None:
    async def run() -> None:
        big = "z" * 50_000_000
        async with serving() as running, running.connect() as client:
            await client.send(big)
            assert await client.recv() == big
            await client.send(big[i : i + 131072] for i in range(0, len(big), 131072))
            assert await client.recv() == big

    asyncio.run(run())


def test_text_that_is_not_utf8_keeps_the_connection() -> None:
    async def run() -> None:
        async with serving() as running:
            reader, writer = await running.raw()
            for body in (b"\xff\xfe", b'{"op": "\xc3"}', b"\xed\xa0\x80"):
                writer.write(masked(1, body))
            await until(lambda: len(running.last.received) == 3)
            assert running.last.received == [b"\xff\xfe", b'{"op": "\xc3"}', b"\xed\xa0\x80"]
            writer.write(masked(9, b"ping"))
            await reader.readuntil(b"\x8a\x04ping")
            writer.close()

    asyncio.run(run())


def test_a_client_that_pings_and_does_not_read_gets_the_newest_pong() -> None:
    async def run() -> None:
        async with serving() as running:
            reader, writer = await running.raw()
            running.last.outbox.send(Payload([bytes(20 * MIB)], binary=True))  # more than the kernel takes
            for number in range(1000):
                writer.write(masked(9, b"%03d" % number))
            writer.write(masked(1, b"the end of the pings"))
            await until(lambda: running.last.received)
            header_and_body = await reader.readexactly(10 + 20 * MIB)
            assert header_and_body[:2] == b"\x82\x7f"
            pongs = b""
            while b"the end of the pings" not in pongs or b"\x8a\x03999" not in pongs:
                piece = await asyncio.wait_for(reader.read(65536), 10)
                assert piece
                pongs += piece
            assert pongs.count(b"\x8a\x03") < 5
            writer.close()

    asyncio.run(run())


def test_a_close_is_answered_and_finishes_the_protocol_once() -> None:
    async def run() -> None:
        async with serving() as running:
            async with running.connect() as client:
                await client.close(4000, "enough")
                assert client.close_code == 4000
            reader, writer = await running.raw()
            writer.write(masked(8, b"\x03\xe8not utf8: \xff"))
            assert (await reader.read())[-4:] == b"\x88\x02\x03\xe8"
            await until(lambda: not running.clients)
            assert [echo.finished for _, echo in running.made] == [1, 1]

    asyncio.run(run())


def test_a_connection_that_breaks_off_finishes_the_protocol() -> None:
    async def run() -> None:
        async with serving() as running:
            for reset in (False, True):
                _, writer = await running.raw()
                writer.write(masked(1, b"half a message", length=1000))
                sock = writer.get_extra_info("socket")
                if reset:
                    sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                writer.close()
                await until(lambda: not running.clients and running.last.finished)
            assert [echo.finished for _, echo in running.made] == [1, 1]
            assert running.last.received == []

    asyncio.run(run())


def test_a_bug_in_the_protocol_closes_that_client_only(caplog: pytest.LogCaptureFixture) -> None:
    async def run() -> None:
        async with serving() as running, running.connect() as other, running.connect() as client:
            unlucky = running.last
            await client.send("fail")
            with pytest.raises(ConnectionClosed):
                await client.recv()
            await until(lambda: unlucky.finished)
            await other.send("still here")
            assert await other.recv() == "still here"
            assert unlucky.client_id in caplog.text
            assert "a bug in the protocol" in caplog.text

    asyncio.run(run())


@pytest.mark.parametrize(
    ("frames", "code"),
    [
        (b"\x81\x02{}", 1002),
        (masked(3, b""), 1002),
        (masked(0, b"x"), 1002),
        (masked(1, b"x", length=MIB + 1), 1009),
        (masked(1, b"x" * MIB, final=False) + masked(0, b"x"), 1009),
    ],
)
def test_a_client_that_breaks_the_rules_is_told_and_closed(frames: bytes, code: int) -> None:
    async def run() -> None:
        async with serving(max_incoming_size=MIB) as running:
            reader, writer = await running.raw()
            writer.write(frames)
            assert (await reader.readexactly(4))[2:] == struct.pack("!H", code)
            writer.write(bytes(10000))  # whatever it goes on to send is thrown away
            writer.close()
            await until(lambda: not running.clients)
            assert running.last.received == []

    asyncio.run(run())


def test_a_protocol_that_is_busy_is_given_nothing_more_and_its_client_is_not_taken_for_silent() -> None:
    async def run() -> None:
        options = {"websocket_ping_interval": 0.05, "websocket_ping_timeout": 0.1}
        async with serving(**options) as running, running.connect() as client:
            echo = running.last
            done = asyncio.get_running_loop().create_future()
            echo.wait = _completed(done)
            await client.send("wait")
            await client.send("after")
            await until(lambda: echo.received)
            await asyncio.sleep(0.5)  # several timeouts
            assert echo.received == [b"wait"]
            assert running.clients
            done.set_result(None)
            assert await asyncio.wait_for(client.recv(), 10) == "after"

    asyncio.run(run())


async def _completed(future: Awaitable[None]) -> None:
    await future


def test_one_client_that_floods_does_not_hold_up_another() -> None:
    async def run() -> None:
        async with serving() as running, running.connect() as calm:
            _, writer = await running.raw()
            flood = masked(1, b"") * 20000
            writer.write(flood)
            delays = []
            while len(running.last.received) < 20000:
                begin = time.monotonic()
                await calm.send("x")
                await calm.recv()
                delays.append(time.monotonic() - begin)
            assert len(delays) > 10, "the flood was handled in few long pieces"
            writer.close()

    asyncio.run(run())


# Compression and TLS


@pytest.mark.parametrize("server_side", [False, True])
@pytest.mark.parametrize("client_side", [None, "deflate"])
def test_compression_is_negotiated_only_when_both_want_it(server_side: bool, client_side: Optional[str]) -> None:
    async def run() -> None:
        server = serving(use_compression=server_side)
        async with server as running, running.connect(compression=client_side) as client:
            extensions = client.response.headers.get("Sec-WebSocket-Extensions", "")
            assert ("permessage-deflate" in extensions) == (server_side and client_side is not None)
            for message in ("hello" * 1000, "", "x", b"\xa0" * 100_000, "again" * 1000):
                await client.send(message)
                assert await client.recv() == message

    asyncio.run(run())


def test_compressed_messages_are_small_and_bounded_when_unpacked() -> None:
    async def run() -> None:
        async with serving(use_compression=True, max_incoming_size=MIB) as running:
            async with running.connect(compression="deflate") as client:
                await client.send("a" * MIB)
                assert await client.recv() == "a" * MIB
                await client.send("a" * (MIB + 1))
                with pytest.raises(ConnectionClosed) as closed:
                    await client.recv()
                assert closed.value.rcvd is not None
                assert closed.value.rcvd.code == 1009
            reader, writer = await running.raw(Sec_WebSocket_Extensions="permessage-deflate")
            writer.write(masked(0x41, b"this is not compressed"))
            assert (await reader.readexactly(4))[2:] == struct.pack("!H", 1007)
            writer.close()

    asyncio.run(run())


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Tuple[Path, Path]:
    directory = tmp_path_factory.mktemp("tls")
    key, certificate = directory / "key.pem", directory / "cert.pem"
    command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1", "-subj", "/CN=localhost"]
    files = ["-addext", "subjectAltName=IP:127.0.0.1", "-keyout", str(key), "-out", str(certificate)]
    subprocess.run([*command, *files], check=True, capture_output=True)
    return certificate, key


@pytest.mark.parametrize("compression", [None, "deflate"])
@pytest.mark.parametrize("one_file", [False, True])
def test_tls(certificate: Tuple[Path, Path], compression: Optional[str], one_file: bool, tmp_path: Path) -> None:
    async def run() -> None:
        cert, key = certificate
        files: Dict[str, Any] = {"certfile": str(cert), "keyfile": str(key)}
        if one_file:
            both = tmp_path / "both.pem"
            both.write_bytes(cert.read_bytes() + key.read_bytes())
            files = {"certfile": str(both)}
        trust = ssl.create_default_context(cafile=str(cert))
        async with serving(ssl=True, use_compression=compression is not None, **files) as running:
            assert running.server.url.startswith("wss://")
            async with running.connect(ssl=trust, compression=compression) as client:
                for message in ("secret", "s" * 10_000_000, "x"):
                    await client.send(message)
                    assert await client.recv() == message
            _, writer = await asyncio.open_connection("127.0.0.1", running.server.port)
            writer.write(handshake())  # plain text on a TLS port harms nobody
            async with running.connect(ssl=trust) as client:
                await client.send("still serving")
                assert await client.recv() == "still serving"
            writer.close()

    asyncio.run(run())


def test_tls_files_that_are_no_good_are_named(tmp_path: Path) -> None:
    wrong = tmp_path / "cert.pem"
    wrong.write_text("not a certificate")
    for options, message in (
        ({}, "no certfile is given"),
        ({"certfile": str(wrong)}, f"can't use {wrong} for ssl"),
        ({"certfile": "/no/such/file", "keyfile": "/none"}, "can't use /no/such/file and /none for ssl"),
    ):
        with pytest.raises(ListenError, match=message):
            Running(Settings(ssl=True, **options), [])


# Listening


def test_a_port_in_use_is_tried_again_until_it_is_free(caplog: pytest.LogCaptureFixture) -> None:
    async def run() -> None:
        with socket.create_server(("127.0.0.1", 0)) as holder:
            port = holder.getsockname()[1]
            running = Running(Settings(port=port, address="127.0.0.1", retry_startup_delay=0.05), [])
            listening = asyncio.ensure_future(running.server.listen())
            await until(lambda: caplog.text.count("Trying again in 0.05 seconds") >= 3)
            assert f"127.0.0.1, port {port}" in caplog.text
            assert not listening.done()
        await asyncio.wait_for(listening, 5)
        assert running.server.port == port
        async with running.connect() as client:
            await client.send("x")
            assert await client.recv() == "x"
        running.server.close()
        await running.server.closed()

    with caplog.at_level(logging.WARNING):
        asyncio.run(run())


def has_ipv6() -> bool:
    with contextlib.suppress(OSError), socket.create_server(("::1", 0), family=socket.AF_INET6):
        return True
    return False


def test_all_interfaces() -> None:
    async def run() -> None:
        async with serving(address="") as running:
            for host in ("127.0.0.1", "127.0.0.2", *(["::1"] if has_ipv6() else [])):
                _, writer = await asyncio.open_connection(host, running.server.port)
                writer.close()
        async with serving(address="127.0.0.1") as running:
            with pytest.raises(OSError, match="Connect call failed"):
                await asyncio.open_connection("127.0.0.2", running.server.port)

    asyncio.run(run())


# Slow, silent and many clients


def test_a_half_open_client_is_closed_after_the_ping_timeout(caplog: pytest.LogCaptureFixture) -> None:
    async def run() -> None:
        server = serving(websocket_ping_interval=0.1, websocket_ping_timeout=0.4)
        async with server as running, running.connect() as healthy:
            reader, writer = await running.raw()
            begin = time.monotonic()
            silent = running.last
            await until(lambda: silent.finished)
            assert 0.5 <= time.monotonic() - begin < 2.0
            assert len(running.clients) == 1
            assert f"Client {silent.client_id} is closed: nothing came from it for 0.4 s" in caplog.text
            assert (await reader.read()).startswith(b"\x89\x00\x89\x00")
            writer.close()
            await healthy.send("x")
            assert await healthy.recv() == "x"

    asyncio.run(run())


def test_a_slow_upload_is_no_silence() -> None:
    async def run() -> None:
        async with serving(websocket_ping_interval=0.05, websocket_ping_timeout=0.2) as running:
            _, writer = await running.raw()
            frame = masked(1, b"slow" * 10)
            for index in range(len(frame)):  # takes several timeouts, and no pong can go between
                writer.write(frame[index : index + 1])
                await asyncio.sleep(0.02)
            await until(lambda: running.last.received)
            assert running.last.received == [b"slow" * 10]
            writer.close()

    asyncio.run(run())


def test_a_client_that_does_not_read_costs_bounded_memory_and_gets_the_rest_when_it_reads() -> None:
    async def run() -> None:
        async with serving() as running:
            reader, writer = await running.raw()
            echo = running.last
            body = bytes(MIB)
            for number in range(30):
                echo.outbox.send(Payload([b"%08d" % number, body], binary=True))
            assert echo.outbox.waiting_bytes > 10 * MIB, "the kernel took it all"  # type: ignore[attr-defined]
            for number in range(30):
                header = await reader.readexactly(10)
                assert header == struct.pack("!BBQ", 0x82, 127, MIB + 8)
                assert await reader.readexactly(8) == b"%08d" % number
                assert await reader.readexactly(MIB) == body
            await until(lambda: echo.outbox.waiting_bytes == 0)  # type: ignore[attr-defined]
            writer.close()

    asyncio.run(run())


def test_a_client_that_never_reads_its_responses_is_closed(caplog: pytest.LogCaptureFixture) -> None:
    async def run() -> None:
        async with serving(max_client_bytes=MIB) as running:
            _, writer = await running.raw()
            echo = running.last
            for _ in range(40):
                echo.outbox.send(Payload([bytes(MIB)], binary=True))
            await until(lambda: echo.finished)
            assert "since it does not read" in caplog.text
            writer.close()

    asyncio.run(run())


def test_a_client_that_takes_nothing_is_closed_and_one_that_takes_little_is_not(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Both have a ping waiting behind a large message, which neither can answer."""

    async def run() -> None:
        timeouts = {"websocket_ping_interval": 0.1, "websocket_ping_timeout": 0.2, "stall_timeout": 1.0}
        async with serving(**timeouts) as running:
            slow_socket = small_window_socket(running.server.port)
            slow_reader, slow_writer = await running.raw_over(slow_socket, limit=4096)
            slow = running.last
            _, stopped_writer = await running.raw_over(small_window_socket(running.server.port), limit=4096)
            stopped = running.last
            for each in (slow, stopped):
                each.outbox.send(Payload([bytes(4 * MIB)], binary=True))
            begin = time.monotonic()
            while not stopped.finished:  # about 1 MB/s
                await slow_reader.readexactly(4096)
                await asyncio.sleep(0.004)
                assert time.monotonic() - begin < 10, "still there"
            assert 1.0 <= time.monotonic() - begin < 3.0
            assert slow.finished == 0
            assert (
                f"Client {stopped.client_id} is closed, since it does not read: it took nothing for 1 s" in caplog.text
            )
            slow_writer.close()
            stopped_writer.close()

    asyncio.run(run())


def test_a_frame_is_one_write_for_each_client_and_made_once() -> None:
    class Tap:
        topic = "/scan"
        keep = 1
        encoded = 0

        def encode(self, message: object) -> List[Payload]:
            return [shared]

    async def run() -> None:
        async with serving() as running, contextlib.AsyncExitStack() as stack:
            clients: List[ClientConnection] = [await stack.enter_async_context(running.connect()) for _ in range(5)]
            for _, echo in running.made:
                echo.outbox.offer(Tap(), None, shared.size)
            assert [await client.recv() for client in clients] == ["shared"] * 5
            assert len(shared._frames or {}) == 1

    shared = Payload([b"shared"])
    asyncio.run(run())


def test_ids_are_unique_and_tell_the_address() -> None:
    async def run() -> None:
        async with serving() as running:
            for _ in range(20):
                async with running.connect():
                    assert list(running.clients.values()) == ["127.0.0.1"]
                await until(lambda: not running.clients)
            ids = [echo.client_id for _, echo in running.made]
            assert len(set(ids)) == 20
            assert all(client_id.startswith("127.0.0.1:") for client_id in ids)

    asyncio.run(run())


def test_closing_ends_every_client_with_a_close_frame() -> None:
    async def run() -> None:
        async with serving() as running, running.connect() as client:
            _, stalled = await running.raw()
            running.server.close()
            assert [echo.finished for _, echo in running.made] == [1, 1]
            with pytest.raises(ConnectionClosed) as closed:
                await client.recv()
            assert closed.value.rcvd is not None
            assert closed.value.rcvd.code == 1001
            with pytest.raises((OSError, InvalidStatus)):
                await running.connect()
            stalled.close()

    asyncio.run(run())


def test_small_messages_are_not_delayed() -> None:
    """TCP_NODELAY: two writes in a row do not wait for the acknowledgement of the first (40 ms)."""

    async def run() -> None:
        async with serving() as running, running.connect() as client:
            times = []
            for _ in range(20):
                begin = time.monotonic()
                for _ in range(3):
                    running.last.outbox.send(Payload([b"x"]))
                for _ in range(3):
                    await client.recv()
                times.append(time.monotonic() - begin)
            assert sorted(times)[10] < 0.02

    asyncio.run(run())
