# SPDX-License-Identifier: BSD-3-Clause
"""The executable rosbridge_websocket with a real master: start, parameters, who is connected, and the end."""

from __future__ import annotations

import contextlib
import random
import signal
import socket
import ssl
import struct
import subprocess
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any, Callable, Iterator, List

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect as websocket

from support.bridge import Bridge
from support.client import Client, defragment
from support.node import Node, echo, serve
from support.peer import Peer
from support.process import Process
from support.programs.websocket import connect as plain_websocket
from support.programs.websocket import text_frame
from support.ros import RosMaster, executable, free_port
from support.wait import wait_until

NAME = "rosbridge_websocket"
STRING = "std_msgs/String"

Connect = Callable[..., Client]
Start = Callable[..., Bridge]


@pytest.fixture
def run(ros_master: RosMaster) -> Iterator[Callable[..., Process]]:
    """`run("--flag", …)`: the executable with these arguments and nothing else; ended with the test."""
    processes: List[Process] = []

    def start(*arguments: str, **environment: str) -> Process:
        command = [str(executable("rosbridge_server", NAME)), *arguments]
        processes.append(ros_master.process_in(command, "server", environment))
        return processes[-1]

    yield start
    for process in processes:
        process.stop()


def own_topics(namespace: str) -> List[str]:
    """Arguments for a server beside another one, which tells of its clients too."""
    return [f"{topic}:={namespace}/{topic}" for topic in ("client_count", "connected_clients")]


# Start


def test_it_says_where_it_listens_and_tells_the_port(ros_master: RosMaster, run: Callable[..., Process]) -> None:
    begin = time.monotonic()
    server = run("--port", "0")
    port = int(server.wait_for_line(r"Rosbridge WebSocket server started at ws://0\.0\.0\.0:(\d+)").group(1))
    assert time.monotonic() - begin < 10.0
    assert ros_master.get_param(f"/{NAME}/actual_port") == port
    with Client(f"ws://127.0.0.1:{port}") as client:
        client.sync()


def test_flags_are_stronger_than_parameters_and_ros_arguments_are_ros(
    ros_master: RosMaster, run: Callable[..., Process]
) -> None:
    port, other = free_port(), free_port()
    ros_master.set_param("/robot/bridge/port", other)
    ros_master.set_param("/robot/bridge/address", "127.0.0.1")
    server = run(f"--port={port}", "__name:=bridge", "__ns:=/robot", "_use_compression:=true", "client_count:=/n")
    server.wait_for_line(rf"started at ws://127\.0\.0\.1:{port}")
    assert ros_master.get_param("/robot/bridge/actual_port") == port
    assert ros_master.publishers("/n") == ["/robot/bridge"]
    with websocket(f"ws://127.0.0.1:{port}", proxy=None) as client:
        assert "permessage-deflate" in client.response.headers["Sec-WebSocket-Extensions"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--colour", "blue"], "unknown flag --colour"),
        (["--port"], "flag --port needs a value: a port from 0 to 65535"),
        (["--port", "many"], "flag --port is 'many', but must be a port from 0 to 65535"),
        (["9090"], "unexpected argument '9090'"),
    ],
)
def test_a_wrong_command_line(run: Callable[..., Process], arguments: List[str], message: str) -> None:
    server = run(*arguments)
    assert server.wait() == 2
    assert server.output.splitlines()[0] == f"rosbridge_websocket: {message}"
    assert "usage: rosbridge_websocket [--name value]" in server.output


def test_help(run: Callable[..., Process]) -> None:
    server = run("--help")
    assert server.wait() == 0
    assert "--websocket_ping_interval" in server.output


@pytest.mark.parametrize(
    ("parameter", "value", "message"),
    [
        ("port", "many", "parameter ~port is 'many', but must be a port from 0 to 65535"),
        ("ssl", True, "ssl is on, but no certfile is given"),
        ("authenticate", True, "authenticate is true, but this server can't authenticate clients yet"),
        ("address", "192.0.2.77", "Unable to listen on 192.0.2.77, port 0"),
    ],
)
def test_a_parameter_that_is_no_good(
    ros_master: RosMaster, run: Callable[..., Process], parameter: str, value: Any, message: str
) -> None:
    ros_master.set_param("/wrong/port", 0)
    ros_master.set_param(f"/wrong/{parameter}", value)
    server = run("__name:=wrong")
    try:
        if parameter == "address":  # it may come, as the network of a robot may: it is waited for
            server.wait_for_line(message)
        else:
            assert server.wait() == 1
            assert message in server.output
            assert "Traceback" not in server.output
    finally:
        ros_master.call("deleteParam", "/wrong")


def test_without_a_master_it_waits_and_says_so_and_can_be_stopped(run: Callable[..., Process]) -> None:
    port = free_port()
    for number in (signal.SIGINT, signal.SIGTERM):
        server = run("--port", "0", ROS_MASTER_URI=f"http://127.0.0.1:{port}")
        server.wait_for_line(rf"waiting for the ROS master at http://127\.0\.0\.1:{port}")
        begin = time.monotonic()
        server.signal(number)
        assert server.wait(3.0) == 0
        assert time.monotonic() - begin < 1.0


@pytest.mark.parametrize("module", ["tornado", "orjson", "cbor2", "numpy", "png", "pybase64"])
def test_a_missing_python_package_is_named(run: Callable[..., Process], tmp_path: Path, module: str) -> None:
    absent = f'raise ModuleNotFoundError("No module named {module}", name="{module}")'
    (tmp_path / f"{module}.py").write_text(absent)
    path = f"{tmp_path}:{_python_path()}"
    server = run("--port", "0", "__name:=incomplete", PYTHONPATH=path)
    assert server.wait() == 1
    package = {"png": "pypng"}.get(module, module)
    assert f"the Python package {package} is missing: pip install -r requirements.txt" in server.output
    assert "Traceback" not in server.output


def _python_path() -> str:
    from support.ros import _workspace_environment

    return _workspace_environment()["PYTHONPATH"]


def test_a_held_port_is_taken_when_it_is_freed(run: Callable[..., Process]) -> None:
    port = free_port()
    with socket.create_server(("127.0.0.1", port)):
        server = run("--port", str(port), "--retry_startup_delay", "0.2", "__name:=patient", "--address", "127.0.0.1")
        server.wait_for_line(rf"Unable to listen on 127\.0\.0\.1, port {port}: .*Trying again in 0\.2 seconds")
    server.wait_for_line(rf"started at ws://127\.0\.0\.1:{port}", 3.0)


def test_it_can_be_stopped_while_the_port_is_held(run: Callable[..., Process]) -> None:
    port = free_port()
    with socket.create_server(("127.0.0.1", port)):
        server = run("--port", str(port), "__name:=patient", "--address", "127.0.0.1")
        server.wait_for_line("Trying again in 5 seconds")
        server.signal(signal.SIGTERM)
        assert server.wait(3.0) == 0


# Parameters take effect (those of the connection are tested in test_connection.py)


def test_origin_compression_and_external_port(start_bridge: Start) -> None:
    bridge = start_bridge(
        {"websocket_null_origin": False, "use_compression": "true", "websocket_external_port": "8443"}, name="proxied"
    )
    with pytest.raises(InvalidStatus) as refused:
        bridge.connect(origin="null")
    assert refused.value.response.status_code == 403
    with bridge.connect(origin="http://elsewhere", compression="deflate") as client:
        assert "permessage-deflate" in client.connection.response.headers["Sec-WebSocket-Extensions"]
        client.sync()
    with pytest.raises(urllib.error.HTTPError) as answer:
        urllib.request.urlopen(f"http://127.0.0.1:{bridge.port}/", timeout=5)
    assert b"ws://127.0.0.1:8443" in answer.value.read()


def test_tls(start_bridge: Start, tmp_path: Path, ros_master: RosMaster) -> None:
    key, certificate = tmp_path / "key.pem", tmp_path / "cert.pem"
    command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1", "-subj", "/CN=localhost"]
    files = ["-addext", "subjectAltName=IP:127.0.0.1", "-keyout", str(key), "-out", str(certificate)]
    subprocess.run([*command, *files], check=True, capture_output=True)
    bridge = start_bridge({"ssl": True, "certfile": str(certificate), "keyfile": str(key)}, name="secure")
    with Client(f"wss://127.0.0.1:{bridge.port}", ssl=ssl.create_default_context(cafile=str(certificate))) as client:
        client.sync()
    assert f"started at wss://127.0.0.1:{bridge.port}" in bridge.process.output


def test_max_message_size_and_delay_between_messages(start_bridge: Start, peer: Peer) -> None:
    bridge = start_bridge({"max_message_size": "200", "delay_between_messages": 0.05}, name="pacing")
    with bridge.connect() as client:
        peer.advertise("/long", STRING, latch=True)
        peer.publish("/long", {"data": "x" * 1000})
        client.subscribe("/long", STRING)
        fragments = [client.wait_for(op="fragment")]
        begin = time.monotonic()
        while len(fragments) < fragments[0]["total"]:
            fragments.append(client.wait_for(op="fragment"))
        took = time.monotonic() - begin
        assert defragment(fragments)["msg"] == {"data": "x" * 1000}
        assert len(fragments) > 5
        assert 0.8 < took / (0.05 * (len(fragments) - 1)) < 3.0


def test_globs(start_bridge: Start, nodes: Callable[[Node], Node], ros_master: RosMaster) -> None:
    nodes(serve(ros_master, "/closed/add"))
    bridge = start_bridge({"topics_glob": "[/open/*]", "services_glob": "['/open/*']"}, name="closed")
    with bridge.connect() as client:
        client.advertise("/closed/topic", STRING)
        assert client.wait_for(op="status", level="error")["id"].startswith("advertise:")
        assert client.call_service("/closed/add", {"a": 1, "b": 2})["result"] is False
        client.set_level("info")
        number = client.advertise("/open/topic", STRING)
        client.wait_for(op="status", level="info", id=number)


def test_unregister_timeout(start_bridge: Start, ros_master: RosMaster) -> None:
    bridge = start_bridge({"unregister_timeout": "0.5"}, name="forgetful")
    with bridge.connect() as client:
        client.advertise("/briefly", STRING)
        wait_until(lambda: ros_master.publishers("/briefly") == ["/forgetful"])
    begin = time.monotonic()
    wait_until(lambda: ros_master.publishers("/briefly") == [], 5.0)
    assert 0.4 < time.monotonic() - begin < 3.0


def test_default_call_service_timeout(
    start_bridge: Start, nodes: Callable[[Node], Node], ros_master: RosMaster
) -> None:
    nodes(serve(ros_master, "/hangs", behaviour="hang"))
    bridge = start_bridge(name="impatient", arguments=["--default_call_service_timeout", "0.4"])
    with bridge.connect() as client:
        begin = time.monotonic()
        response = client.call_service("/hangs", {"a": 1, "b": 2})
        assert response["result"] is False
        assert 0.4 <= time.monotonic() - begin < 3.0


def test_max_incoming_size(start_bridge: Start) -> None:
    bridge = start_bridge({"max_incoming_size": 100000}, name="small")
    with bridge.connect() as client:
        client.send({"op": "publish", "topic": "/x", "msg": {"data": "x" * 90000}})
        client.sync()
        client.send({"op": "publish", "topic": "/x", "msg": {"data": "x" * 110000}})
        with pytest.raises(ConnectionClosed) as closed:
            client.sync()
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1009


@pytest.mark.allow_log("nothing came from it")
def test_ping_parameters_close_a_half_open_client_and_count_it_no_more(
    start_bridge: Start, nodes: Callable[[Node], Node], ros_master: RosMaster
) -> None:
    bridge = start_bridge(
        {"websocket_ping_interval": "0.2", "websocket_ping_timeout": "0.5"},
        name="pinging",
        arguments=own_topics("/pinging"),
    )
    counts = nodes(echo(ros_master, "/pinging/client_count", "std_msgs/Int32"))
    half_open = plain_websocket(bridge.port)
    half_open.sendall(text_frame({"op": "advertise", "topic": "/half_open", "type": STRING}))
    wait_until(lambda: {"data": 1} in counts.records("message"))
    bridge.process.wait_for_line("is closed: nothing came from it for 0.5 s after a ping", 5.0)
    wait_until(lambda: counts.records("message")[-1] == {"data": 0})
    half_open.close()


# Messages that hurt


def test_bytes_that_are_no_http_and_no_websocket_harm_nobody(bridge: Bridge, connect: Connect) -> None:
    client = connect(bridge)
    noise = random.Random(1)
    for size in (1, 10, 1000, 100_000):
        with socket.create_connection(("127.0.0.1", bridge.port), 10) as connection:
            with contextlib.suppress(ConnectionError):
                connection.sendall(bytes(noise.choices(range(256), k=size)) + b"\r\n\r\n")
            connection.shutdown(socket.SHUT_WR)
            with contextlib.suppress(ConnectionError):
                while connection.recv(65536):
                    pass
        with plain_websocket(bridge.port) as connection, contextlib.suppress(ConnectionError):
            connection.sendall(bytes(noise.choices(range(256), k=size)))
    client.sync()


def test_more_clients_than_the_soft_limit_on_open_files(ros_master: RosMaster) -> None:
    command = f"ulimit -Sn 64 && exec {executable('rosbridge_server', NAME)} --port 0 __name:=crowded"
    server = ros_master.process_in(["bash", "-c", command], "crowded")
    with server, contextlib.ExitStack() as stack:
        port = int(server.wait_for_line(r"started at ws://0\.0\.0\.0:(\d+)").group(1))
        for _ in range(100):
            connection = stack.enter_context(websocket(f"ws://127.0.0.1:{port}", proxy=None))
        connection.send("{")
        assert "status" in str(connection.recv(10))


def test_invalid_utf8_is_an_error_status_and_the_connection_goes_on(bridge: Bridge, connect: Connect) -> None:
    client = connect(bridge)
    half_open = plain_websocket(bridge.port)
    half_open.sendall(struct.pack("!BB", 0x81, 0x83) + bytes(4) + b'{"\xff'[:3])
    half_open.sendall(text_frame({"op": "nonsense", "id": "after"}))
    half_open.settimeout(10)
    received = b""
    while b'"after"' not in received:
        received += half_open.recv(65536)
    assert received.count(b'"status"') == 2
    half_open.close()
    client.sync()


def test_a_message_of_50_mb_from_a_client(bridge: Bridge, connect: Connect, peer: Peer) -> None:
    client = connect(bridge, timeout=60.0)
    client.advertise("/big", STRING)
    client.publish("/big", {"data": "x" * 50_000_000})
    client.sync()
    assert client.statuses("error") == []


# Who is connected


def test_clients_are_counted_and_listed(
    start_bridge: Start, nodes: Callable[[Node], Node], ros_master: RosMaster
) -> None:
    bridge = start_bridge(name="counting", arguments=own_topics("/counting"))
    with bridge.connect(), bridge.connect():
        counts = nodes(echo(ros_master, "/counting/client_count", "std_msgs/Int32", name="counts"))
        lists = nodes(echo(ros_master, "/counting/connected_clients", "rosbridge_msgs/ConnectedClients", name="lists"))
        assert counts.wait_records("message")[0] == {"data": 2}, "latched"
        listed = lists.wait_records("message")[0]["clients"]
        assert [client["ip_address"] for client in listed] == ["127.0.0.1"] * 2
        assert all(abs(client["connection_time"]["secs"] - time.time()) < 60 for client in listed)
    wait_until(lambda: counts.records("message")[-1] == {"data": 0})
    wait_until(lambda: lists.records("message")[-1] == {"clients": []})
    bridge.process.wait_for_line(r" 0 clients total\.")
    assert bridge.process.output.count("Client connected: 127.0.0.1:") == 2


def test_the_count_is_right_after_a_connect_storm(
    start_bridge: Start, nodes: Callable[[Node], Node], ros_master: RosMaster
) -> None:
    bridge = start_bridge(name="storm", arguments=own_topics("/storm"))
    counts = nodes(echo(ros_master, "/storm/client_count", "std_msgs/Int32"))
    stay: List[socket.socket] = []

    def storm() -> None:
        for number in range(100):
            connection = plain_websocket(bridge.port)
            if number % 10 == 0:
                stay.append(connection)
            else:
                connection.close()

    threads = [threading.Thread(target=storm) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(stay) == 40
    wait_until(lambda: counts.records("message")[-1] == {"data": 40}, 10.0, lambda: str(counts.records("message")))
    assert max(record["data"] for record in counts.records("message")) >= 40
    for connection in stay:
        connection.close()
    wait_until(lambda: counts.records("message")[-1] == {"data": 0})
    wait_until(lambda: bridge.process.output.count("Client disconnected") == 400)
    assert bridge.process.output.count("Client connected") == 400


# The end


def registered(master: RosMaster, node: str) -> List[str]:
    """The topics and services that the master knows the node for."""
    return [name for kind in master.call("getSystemState") for name, nodes in kind if node in nodes]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_within_three_seconds_whatever_clients_do(
    start_bridge: Start, peer: Peer, ros_master: RosMaster, number: int
) -> None:
    bridge = start_bridge(name=f"ending_{int(number)}")
    peer.advertise("/flood", STRING)
    with contextlib.ExitStack() as stack:
        well = stack.enter_context(bridge.connect())
        well.subscribe("/flood", STRING)
        for _ in range(5):  # these subscribe and then read nothing
            stalled = stack.enter_context(contextlib.closing(plain_websocket(bridge.port)))
            stalled.sendall(text_frame({"op": "subscribe", "topic": "/flood", "type": STRING, "queue_length": 100}))
        hanging = stack.enter_context(contextlib.closing(socket.create_connection(("127.0.0.1", bridge.port))))
        hanging.sendall(b"GET / HTTP/1.1\r\nHost: never finishes its header")
        peer.wait_connected("/flood")
        peer.publish("/flood", *[{"data": "x" * 1_000_000}] * 20)
        well.next_message("/flood")
        begin = time.monotonic()
        bridge.process.signal(number)
        assert bridge.process.wait(5.0) == 0
        assert time.monotonic() - begin < 3.0
        with contextlib.suppress(ConnectionClosed):
            while True:
                well.receive()
        assert well.connection.close_code == 1001
    with socket.create_server(("127.0.0.1", bridge.port)):
        pass  # the port is free
    assert registered(ros_master, f"/{bridge.name}") == []


def test_what_clients_had_begun_is_unregistered_at_the_end(start_bridge: Start, ros_master: RosMaster) -> None:
    bridge = start_bridge(name="registering")
    with bridge.connect() as client:
        for number in range(20):
            client.advertise(f"/left/out_{number}", STRING)
            client.subscribe(f"/left/in_{number}", STRING)
            client.advertise_service(f"/left/service_{number}", "std_srvs/Empty")
        wait_until(lambda: len([n for n in registered(ros_master, "/registering") if n.startswith("/left")]) == 60)
        bridge.stop()
    assert registered(ros_master, "/registering") == []


def test_rosnode_kill_ends_it(start_bridge: Start, ros_master: RosMaster) -> None:
    bridge = start_bridge(name="killed")
    with bridge.connect() as client:
        begin = time.monotonic()
        subprocess.run(
            ["rosnode", "kill", "/killed"], env=ros_master.environment, check=True, capture_output=True, timeout=20
        )
        assert bridge.process.wait(5.0) == 0
        assert time.monotonic() - begin < 5.0
        with pytest.raises(ConnectionClosed) as closed:
            client.sync()
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1001
    assert registered(ros_master, "/killed") == []


def test_a_master_that_is_gone_does_not_delay_the_end(tmp_path: Path) -> None:
    with RosMaster(tmp_path) as master, Bridge(master) as bridge, bridge.connect() as client:
        client.advertise("/x", STRING)
        wait_until(lambda: master.publishers("/x"))
        with _silent(master):
            begin = time.monotonic()
            bridge.process.signal(signal.SIGTERM)
            assert bridge.process.wait(5.0) == 0
            assert time.monotonic() - begin < 3.0


@contextlib.contextmanager
def _silent(master: RosMaster) -> Iterator[None]:
    """The master takes connections and answers nothing."""
    master.process.signal(signal.SIGSTOP)
    try:
        yield
    finally:
        master.process.signal(signal.SIGCONT)
