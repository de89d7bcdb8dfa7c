# SPDX-License-Identifier: BSD-3-Clause
"""Whatever comes in, the server goes on: nearly right operations, websocket bytes and TCPROS bytes, against the running
server; after each round it must answer, have logged no error, and take no more memory, files or threads.

A seed makes a round; a failure names it. scripts/fuzz MINUTES goes on for longer, with seeds of its own each time.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
import urllib.parse
import xmlrpc.client
from random import Random, SystemRandom
from socketserver import ThreadingMixIn
from typing import Any, Callable, Iterator, List
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

import pytest
from geometry_msgs.msg import TwistStamped
from sensor_msgs.msg import Image

from support import fuzzing
from support.bridge import Bridge
from support.client import Client
from support.effort import figure
from support.ros import RosMaster
from support.usage import usage
from support.wait import wait_until

SECONDS = float(os.environ.get("ROSBRIDGE_FUZZ_SECONDS", "2"))
FIRST_SEED = int(os.environ.get("ROSBRIDGE_FUZZ_SEED", "0")) or (1 if SECONDS <= 3 else SystemRandom().randrange(2**40))
ADD = "rosbridge_library/AddTwoInts"


@pytest.fixture(scope="module")
def bridge(ros_master: RosMaster) -> Iterator[Bridge]:
    with Bridge(ros_master, {"unregister_timeout": 0.2, "fragment_timeout": 1.0}) as server:
        yield server


def rounds(bridge: Bridge, name: str, play: Callable[[Random], int]) -> None:
    """Plays rounds for a while, from one seed after the other, and looks after each whether all is well."""
    play(Random(0))  # what is loaded and made the first time
    before = usage(bridge.process.pid)
    end, seed, inputs = time.monotonic() + SECONDS, FIRST_SEED, 0
    while time.monotonic() < end:
        inputs += play(Random(seed))
        with bridge.connect(timeout=20.0) as client:
            client.sync()
        assert bridge.process.alive, f"ended by seed {seed}:\n{bridge.process.output[-5000:]}"
        errors = bridge.unexpected(ALLOWED)
        assert errors == [], f"seed {seed}"
        seed += 1
    wait_until(lambda: usage(bridge.process.pid).open_files <= before.open_files + 3, 15.0, "files closed")
    after = usage(bridge.process.pid)
    figure(f"fuzz {name}", inputs=inputs, seeds=seed - FIRST_SEED, rss_mib_before=before.rss_mib, rss_mib=after.rss_mib)
    assert after.rss_mib < before.rss_mib + 60 + SECONDS / 10, f"seeds {FIRST_SEED} to {seed}"
    wait_until(lambda: usage(bridge.process.pid).threads <= before.threads + 22, 15.0, "threads ended")


ALLOWED = ["publishes what can't be understood"]
pytestmark = pytest.mark.allow_log(*ALLOWED)


def test_operations(bridge: Bridge) -> None:
    def play(random: Random) -> int:
        count = 300
        with bridge.connect(timeout=30.0) as client:
            client.set_level(random.choice(["error", "warning", "info"]))
            for _ in range(count):
                data, binary = fuzzing.frame(random)
                client.connection.send(data, text=not binary)
            client.send({"op": "set_level", "level": "error"})
            client.sync()
            internal = [each for each in client.statuses() if "internal error" in each["msg"]]
            assert internal == []
        return count

    rounds(bridge, "operations", play)


def feed(port: int, stream: bytes, random: Random) -> None:
    """Sends bytes, in pieces or at once, reads a little of what comes, and leaves."""
    with contextlib.suppress(ConnectionError, socket.timeout), socket.create_connection(
        ("127.0.0.1", port), 2.0
    ) as peer:
        half = random.randrange(len(stream) + 1)
        for part in (stream[:half], stream[half:]) if random.random() < 0.3 else (stream,):
            peer.sendall(part)
        if random.random() < 0.5:
            peer.settimeout(0.01)
            peer.recv(4096)


def test_websocket_bytes(bridge: Bridge) -> None:
    def play(random: Random) -> int:
        for _ in range(60):
            feed(bridge.port, fuzzing.websocket_bytes(random), random)
        return 60

    rounds(bridge, "websocket bytes", play)


def test_bytes_of_subscribers_and_service_callers(bridge: Bridge, ros_master: RosMaster) -> None:
    with bridge.connect() as client:
        client.advertise("/fuzz_tcpros/topic", "std_msgs/Int32", latch=True)
        client.publish("/fuzz_tcpros/topic", {"data": 1})
        client.advertise_service("/fuzz_tcpros/service", ADD)
        wait_until(lambda: ros_master.providers("/fuzz_tcpros/service"))
        port = urllib.parse.urlsplit(ros_master.call("lookupService", "/fuzz_tcpros/service")).port
        assert port

        def play(random: Random) -> int:
            for _ in range(40):
                common = {"callerid": "/fuzzer", "md5sum": "*", "tcp_nodelay": "1"}
                if random.random() < 0.5:
                    header = fuzzing.connection_header(
                        random, topic="/fuzz_tcpros/topic", type="std_msgs/Int32", **common
                    )
                else:
                    header = fuzzing.connection_header(
                        random, service="/fuzz_tcpros/service", type=ADD, persistent="1", **common
                    )
                feed(port, header + fuzzing.wire_frames(random, bytes(16)), random)
            return 40

        rounds(bridge, "subscribers and service callers", play)


class _Publisher:
    """A node that publishes a topic and sends what the fuzzer makes."""

    def __init__(self, master: RosMaster, topic: str, kind: Any, body: bytes) -> None:
        self.random = Random(0)
        self.served = 0
        self._kind, self._body, self._topic, self._master = kind, body, topic, master
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._api = _Api(("127.0.0.1", 0), requestHandler=_AnyPath, logRequests=False)
        self._api.register_function(
            lambda *_: [1, "", ["TCPROS", "127.0.0.1", self._listener.getsockname()[1]]], "requestTopic"
        )
        self._api.register_function(lambda *_: [1, "", 0], "publisherUpdate")
        self.uri = f"http://127.0.0.1:{self._api.server_address[1]}/"
        for work in (self._api.serve_forever, self._serve):
            threading.Thread(target=work, daemon=True).start()
        with xmlrpc.client.ServerProxy(master.uri) as proxy:
            proxy.registerPublisher("/fuzz_publisher", topic, kind._type, self.uri)

    def close(self) -> None:
        with xmlrpc.client.ServerProxy(self._master.uri) as proxy:
            proxy.unregisterPublisher("/fuzz_publisher", self._topic, self.uri)
        self._api.shutdown()
        self._api.server_close()
        self._listener.close()

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return  # closed
            with contextlib.suppress(ConnectionError, socket.timeout), connection:
                connection.settimeout(2.0)
                connection.recv(65536)
                kind, random = self._kind, self.random
                connection.sendall(
                    fuzzing.connection_header(
                        random,
                        callerid="/fuzz_publisher",
                        type=kind._type,
                        md5sum=kind._md5sum,
                        message_definition=kind._full_text,
                        latching=random.choice("01"),
                        topic=self._topic,
                    )
                    + fuzzing.wire_frames(random, self._body)
                )
                self.served += 1


class _Api(ThreadingMixIn, SimpleXMLRPCServer):
    daemon_threads = True


class _AnyPath(SimpleXMLRPCRequestHandler):
    rpc_paths = ()


def test_bytes_of_publishers(bridge: Bridge, ros_master: RosMaster) -> None:
    from io import BytesIO

    image, twist = BytesIO(), BytesIO()
    Image(height=2, width=3, encoding="mono8", step=3, data=b"\x01" * 6).serialize(image)
    TwistStamped().serialize(twist)
    publishers: List[_Publisher] = [
        _Publisher(ros_master, f"/fuzz_in/{number}", kind, body.getvalue())
        for number, (kind, body) in enumerate([(Image, image), (TwistStamped, twist)] * 2)
    ]
    encodings = ("none", "png", "cbor", "cbor-raw")
    try:

        def play(random: Random) -> int:
            served = sum(each.served for each in publishers)
            for each in publishers:
                each.random = Random(random.random())
            clients: List[Client] = [bridge.connect() for _ in encodings]
            for client, encoding in zip(clients, encodings):
                for number in range(len(publishers)):
                    client.subscribe(f"/fuzz_in/{number}", compression=encoding)
                client.sync()
            wait_until(lambda: sum(each.served for each in publishers) >= served + len(publishers), 10.0, "connections")
            for client in clients:
                client.sync()
                client.close()
            return len(publishers)

        rounds(bridge, "publishers", play)
    finally:
        for each in publishers:
            each.close()
