# SPDX-License-Identifier: BSD-3-Clause
"""Services that web clients provide, as ROS sees them: called by rosservice, rospy and bare sockets."""

from __future__ import annotations

import contextlib
import itertools
import json
import re
import shutil
import signal
import socket
import struct
import subprocess
import threading
import time
from pathlib import Path
from typing import Any, Dict, Iterator, List, Tuple

import pytest

from rosbridge_library.codec import get_service_type
from rosbridge_library.ros.tcpros_header import decode_header, encode_header
from support import node as nodes
from support.node import Node
from support.ros import RosMaster, python
from support.wait import wait_until

ADD = "rosbridge_library/AddTwoInts"
PROGRAM = Path(__file__).with_name("providing_node.py")
_numbers = itertools.count()


def fresh(name: str) -> str:
    """A service name that no other test uses."""
    return f"/{name}_{next(_numbers)}"


class Providing(Node):
    """The node under test."""

    def __init__(self, ros_master: RosMaster, directory: Path) -> None:
        self._socket = str(directory / "control")
        super().__init__(ros_master.process_in([python(), str(PROGRAM), self._socket], "providing"))
        self.process.wait_for_line('"ready"', 20.0)

    def tell(self, do: str, **command: Any) -> Dict[str, Any]:
        with socket.socket(socket.AF_UNIX) as control:
            control.settimeout(20.0)
            control.connect(self._socket)
            control.sendall(json.dumps({"do": do, **command}).encode() + b"\n")
            answer = control.makefile().readline()
        return dict(json.loads(answer))

    def advertise(self, client: str, service: str, kind: str = ADD, **options: Any) -> Dict[str, Any]:
        return self.tell("advertise", client=client, service=service, kind=kind, **options)

    def requests(self, client: str) -> List[Any]:
        return [record["request"] for record in self.records() if record.get("client") == client]

    def wait_requests(self, client: str, count: int = 1) -> None:
        wait_until(lambda: len(self.requests(client)) >= count, 10.0)

    def state(self) -> Dict[str, Any]:
        return self.tell("state")


@pytest.fixture(scope="module")
def node(ros_master: RosMaster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Providing]:
    providing = Providing(ros_master, tmp_path_factory.mktemp("providing"))
    with providing:
        yield providing


class Caller:
    """A bare TCPROS client of a service, which says exactly what a test wants."""

    def __init__(self, ros_master: RosMaster, service: str, kind: str = ADD, **fields: str) -> None:
        host, port = re.match(r"rosrpc://(.*):(\d+)", ros_master.call("lookupService", service)).groups()
        self.socket = socket.create_connection((host, int(port)), timeout=20.0)
        md5sum = get_service_type(kind).md5sum
        self.socket.sendall(encode_header({"callerid": "/caller", "service": service, "md5sum": md5sum, **fields}))
        (length,) = struct.unpack("<I", self.read(4))
        self.header = decode_header(self.read(length))

    def __enter__(self) -> Caller:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def read(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            chunk = self.socket.recv(size - len(data))
            if not chunk:
                raise EOFError
            data += chunk
        return data

    def send(self, a: int, b: int) -> None:
        self.socket.sendall(struct.pack("<Iqq", 16, a, b))

    def answer(self) -> Tuple[bool, bytes]:
        ok, length = struct.unpack("<?I", self.read(5))
        return ok, self.read(length)

    def sum(self) -> int:
        ok, body = self.answer()
        assert ok, body
        return int(struct.unpack("<q", body)[0])

    def failure(self) -> str:
        ok, body = self.answer()
        assert not ok, body
        return body.decode()

    def is_closed(self) -> bool:
        with contextlib.suppress(ConnectionResetError):
            return self.socket.recv(1) == b""
        return True


def rosservice(ros_master: RosMaster, *words: str) -> subprocess.CompletedProcess[str]:
    command = shutil.which("rosservice", path=ros_master.environment["PATH"])
    assert command is not None
    return subprocess.run(
        [command, *words],
        env=ros_master.environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=20.0,
        check=False,
    )


def test_ros_tools_see_and_call_it(ros_master: RosMaster, node: Providing) -> None:
    name = fresh("tools")
    assert node.advertise("tools", name, values={"sum": 5}) == {"warning": None}
    assert name in rosservice(ros_master, "list").stdout.split()
    assert rosservice(ros_master, "type", name).stdout.strip() == ADD
    info = rosservice(ros_master, "info", name).stdout
    assert "Node: /providing" in info
    assert f"Type: {ADD}" in info
    assert "Args: a b" in info
    assert rosservice(ros_master, "call", name, "2", "3").stdout.strip() == "sum: 5"
    assert node.requests("tools") == [{"a": 2, "b": 3}]


def test_rospy_calls_it_once_and_again(ros_master: RosMaster, node: Providing) -> None:
    name = fresh("rospy")
    node.advertise("rospy", name, values={"sum": 5})
    source = (
        "from rosbridge_library.srv import AddTwoInts\n"
        "for persistent in (False, True):\n"
        f"    proxy = rospy.ServiceProxy({name!r}, AddTwoInts, persistent=persistent)\n"
        "    say(sums=[proxy(number, 1).sum for number in range(20)])\n"
        "ready()\n"
    )
    with nodes.script(ros_master, source, name="calling") as calling:
        assert calling.records("sums") == [[5] * 20, [5] * 20]
    assert [request["a"] for request in node.requests("rospy")] == list(range(20)) * 2


def test_wait_for_service(ros_master: RosMaster, node: Providing) -> None:
    name = fresh("waited")
    source = f"ready()\nrospy.wait_for_service({name!r}, 15)\nsay(there=True)\nrospy.spin()\n"
    with nodes.script(ros_master, source, name="waiting") as waiting:
        node.advertise("waited", name, values={"sum": 5})
        waiting.wait_records("there")


def test_empty_request_and_response(ros_master: RosMaster, node: Providing) -> None:
    name = fresh("empty")
    node.advertise("empty", name, "std_srvs/Empty", values={})
    assert rosservice(ros_master, "call", name).returncode == 0
    assert node.requests("empty") == [{}]


def test_a_caller_with_another_type(ros_master: RosMaster, node: Providing) -> None:
    name = fresh("md5")
    node.advertise("md5", name, values={"sum": 5})
    with Caller(ros_master, name, "std_srvs/SetBool") as caller:
        assert "md5sums do not match" in caller.header["error"]


@pytest.mark.parametrize(
    ("behaviour", "text"),
    [
        ({"error": "the client says nö"}, "the client says nö"),
        ({"bug": "name"}, "error processing the request: 'name'"),
        ({"hang": True, "timeout": 0.3}, "did not answer within 0.3 s"),
    ],
)
def test_failures_are_told_to_the_caller(
    ros_master: RosMaster, node: Providing, behaviour: Dict[str, Any], text: str
) -> None:
    name = fresh("fails")
    node.advertise(name, name, **behaviour)
    with Caller(ros_master, name, persistent="1") as caller:
        for _ in range(2):
            caller.send(1, 2)
            assert text in caller.failure()
    shown = rosservice(ros_master, "call", name, "2", "3")
    assert shown.returncode != 0
    assert text.split("ö")[0] in shown.stdout


def test_unadvertise_fails_pending_calls_at_once(ros_master: RosMaster, node: Providing) -> None:
    name = fresh("leaves")
    node.advertise("leaves", name, hang=True)
    with Caller(ros_master, name) as pending, Caller(ros_master, name, persistent="1") as other, Caller(
        ros_master, name, persistent="1"
    ) as idle:
        pending.send(1, 2)
        other.send(1, 2)
        node.wait_requests("leaves", 2)
        begin = time.monotonic()
        assert node.tell("unadvertise", client="leaves")["blocked"] < 0.1
        for caller in (pending, other):
            assert caller.failure() == "leaves is gone"
            assert caller.is_closed()
        assert idle.is_closed()
        assert time.monotonic() - begin < 2.0
    assert ros_master.providers(name) == []
    node.tell("unadvertise", client="leaves")  # once more does nothing


def test_advertised_again_after_unadvertise(ros_master: RosMaster, node: Providing) -> None:
    name = fresh("again")
    for total in range(3):
        assert node.advertise("again", name, values={"sum": total}) == {"warning": None}
        with Caller(ros_master, name) as caller:
            caller.send(1, 2)
            assert caller.sum() == total
        node.tell("unadvertise", client="again")
        assert ros_master.providers(name) == []


def test_a_newer_client_takes_over(ros_master: RosMaster, node: Providing) -> None:
    name = fresh("taken")
    node.advertise("older", name, hang=True)
    with Caller(ros_master, name, persistent="1") as caller:
        caller.send(1, 2)
        node.wait_requests("older")
        assert node.advertise("newer", name, values={"sum": 7}) == {"warning": None}
        assert caller.failure() == f"{name} was advertised anew meanwhile"
        caller.send(1, 2)  # on the same connection
        assert caller.sum() == 7
    assert "older" not in node.state()["active"]
    node.tell("unadvertise", client="older")  # its late goodbye changes nothing
    assert ros_master.providers(name) == ["/providing"]
    with Caller(ros_master, name) as caller:
        caller.send(1, 2)
        assert caller.sum() == 7


def test_a_newer_client_takes_over_without_a_gap(ros_master: RosMaster, node: Providing) -> None:
    name = fresh("gapless")
    node.advertise("client 0", name, values={"sum": 0})
    failures: List[str] = []
    sums: List[int] = []
    stop = threading.Event()

    def call() -> None:
        while not stop.is_set():
            with Caller(ros_master, name) as caller:
                caller.send(1, 2)
                ok, body = caller.answer()
                if ok:
                    sums.append(struct.unpack("<q", body)[0])
                else:
                    failures.append(body.decode())

    thread = threading.Thread(target=call)
    thread.start()
    try:
        for number in range(1, 30):
            node.advertise(f"client {number}", name, values={"sum": number})
            node.tell("unadvertise", client=f"client {number - 1}")
            seen = len(sums)
            wait_until(lambda: len(sums) > seen + 2)  # noqa: B023
    finally:
        stop.set()
        thread.join()
    assert sums == sorted(sums)
    assert sums[-1] == 29
    # A request that the older one was about to answer is told so; nothing else may fail.
    assert set(failures) <= {f"{name} was advertised anew meanwhile"}


def test_a_newer_client_takes_over_with_another_type(ros_master: RosMaster, node: Providing) -> None:
    name = fresh("retyped")
    node.advertise("older type", name, hang=True)
    with Caller(ros_master, name) as pending, Caller(ros_master, name, persistent="1") as idle:
        pending.send(1, 2)
        node.wait_requests("older type")
        node.advertise("newer type", name, "std_srvs/Trigger", values={"success": True})
        assert pending.failure() == f"{name} was advertised anew meanwhile, as std_srvs/Trigger"
        assert idle.is_closed()
    assert rosservice(ros_master, "type", name).stdout.strip() == "std_srvs/Trigger"
    assert ros_master.providers(name) == ["/providing"]


def test_a_service_of_another_node_is_taken_over_with_a_warning(ros_master: RosMaster, node: Providing) -> None:
    name = fresh("foreign")
    with nodes.serve(ros_master, name, ADD, name="foreign"):
        uri = ros_master.call("lookupService", name)
        warning = node.advertise("foreign", name, values={"sum": 7})["warning"]
        assert warning == (f"{name} was provided by the node at {uri}; from now on it is provided by this client")
        assert ros_master.providers(name) == ["/providing"]
        with Caller(ros_master, name) as caller:
            caller.send(1, 2)
            assert caller.sum() == 7


@pytest.mark.parametrize(
    ("service", "kind", "error"),
    [
        ("/types/a", "no_such_package/Type", "InvalidPackageException"),
        ("/types/a", "rosbridge_library/NoSuchType", "InvalidClassException"),
        ("/types/a", "nonsense", "InvalidTypeStringException"),
        ("/with space", ADD, "InvalidArgumentException"),
        ("/", ADD, "InvalidArgumentException"),
        ("", ADD, "InvalidArgumentException"),
        ("/providing/get_loggers", ADD, "AdvertiseError: /providing/get_loggers is a service of the bridge itself"),
    ],
)
def test_what_can_not_be_advertised(
    ros_master: RosMaster, node: Providing, service: str, kind: str, error: str
) -> None:
    before = ros_master.call("getSystemState")[2]
    assert error in node.advertise("none", service, kind)["error"]
    assert ros_master.call("getSystemState")[2] == before


def test_a_caller_that_goes_away_is_noticed(ros_master: RosMaster, node: Providing) -> None:
    name = fresh("impatient")
    node.advertise("impatient", name, hang=True)
    before = node.state()
    for number in range(5):
        with Caller(ros_master, name) as caller:
            caller.send(1, 2)
            node.wait_requests("impatient", number + 1)
    wait_until(lambda: node.state()["cancelled"] == before["cancelled"] + 5)
    wait_until(lambda: node.state()["files"] <= before["files"])
    wait_until(lambda: node.state()["tasks"] <= before["tasks"])


def test_pending_calls_take_no_threads_and_no_cpu(ros_master: RosMaster, node: Providing) -> None:
    name = fresh("many")
    node.advertise("many", name, hang=True)
    before = node.state()
    with contextlib.ExitStack() as stack:
        callers = [stack.enter_context(Caller(ros_master, name)) for _ in range(100)]
        for caller in callers:
            caller.send(1, 2)
        node.wait_requests("many", 100)
        wait_until(lambda: node.state()["threads"] <= before["threads"] + 1)
        cpu_s, begin = node.state()["cpu_s"], time.monotonic()
        threading.Event().wait(1.0)  # the time over which the CPU is measured
        assert node.state()["cpu_s"] - cpu_s < 0.1 * (time.monotonic() - begin)
        node.tell("unadvertise", client="many")
        assert {caller.failure() for caller in callers} == {"many is gone"}
    wait_until(lambda: node.state()["files"] <= before["files"])


def test_a_burst_of_callers(ros_master: RosMaster, node: Providing) -> None:
    """rospy's queue for new connections is five long; beyond it the kernel would make callers wait for seconds."""
    name = fresh("burst")
    node.advertise("burst", name, values={"sum": 5})
    address = re.match(r"rosrpc://(.*):(\d+)", ros_master.call("lookupService", name)).groups()
    begin = time.monotonic()
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(100)]
        for each in sockets:
            each.setblocking(False)
            each.connect_ex((address[0], int(address[1])))
        md5sum = get_service_type(ADD).md5sum
        header = encode_header({"callerid": "/caller", "service": name, "md5sum": md5sum})
        for each in sockets:
            each.settimeout(20.0)
            wait_until(lambda: connected(each), 20.0)  # noqa: B023
            each.sendall(header)
        for each in sockets:
            assert each.recv(4096)
        assert time.monotonic() - begin < 2.5


def test_a_peer_that_connects_and_says_nothing_blocks_nobody(ros_master: RosMaster, node: Providing) -> None:
    name = fresh("silent")
    node.advertise("silent", name, values={"sum": 5})
    host, port = re.match(r"rosrpc://(.*):(\d+)", ros_master.call("lookupService", name)).groups()
    with socket.create_connection((host, int(port))), socket.create_connection((host, int(port))) as half:
        half.sendall(b"\xff")
        begin = time.monotonic()
        with Caller(ros_master, name) as caller:
            caller.send(1, 2)
            assert caller.sum() == 5
        assert time.monotonic() - begin < 2.0


def connected(sock: socket.socket) -> bool:
    try:
        sock.getpeername()
    except OSError:
        return False
    return True


def test_requests_sent_ahead_are_answered_in_order(ros_master: RosMaster, node: Providing) -> None:
    name = fresh("ahead")
    node.advertise("ahead", name, values={"sum": 5}, delay=0.05)
    with Caller(ros_master, name, persistent="true") as caller:
        for number in range(10):
            caller.send(number, 1)
        assert [caller.sum() for _ in range(10)] == [5] * 10
    assert [request["a"] for request in node.requests("ahead")] == list(range(10))


def test_one_request_where_the_connection_is_not_persistent(ros_master: RosMaster, node: Providing) -> None:
    name = fresh("single")
    node.advertise("single", name, values={"sum": 5})
    with Caller(ros_master, name) as caller:
        caller.send(1, 2)
        assert caller.sum() == 5
        assert caller.is_closed()


def test_requests_that_are_none(ros_master: RosMaster, node: Providing) -> None:
    name = fresh("broken")
    node.advertise("broken", name, values={"sum": 5})
    before = node.state()
    with Caller(ros_master, name) as caller:
        caller.socket.sendall(b"\x10\0\0\0half")
    with Caller(ros_master, name) as caller:
        caller.socket.sendall(b"\xff\xff\xff\xff")
        assert "4294967295 bytes is over the limit" in caller.failure()
        assert caller.is_closed()
    with Caller(ros_master, name):
        pass
    with Caller(ros_master, name) as caller:
        caller.send(1, 2)
        assert caller.sum() == 5
    assert len(node.requests("broken")) == 1
    wait_until(lambda: node.state()["files"] <= before["files"])


def test_a_large_request(ros_master: RosMaster, node: Providing) -> None:
    name = fresh("large")
    node.advertise("large", name, "rosbridge_library/TestArrayRequest", values={})
    with Caller(ros_master, name, "rosbridge_library/TestArrayRequest") as caller:
        caller.socket.sendall(struct.pack("<II", 4_000_004, 1_000_000) + bytes(4_000_000))
        assert caller.answer() == (True, b"")
    assert node.requests("large") == [4_000_004]


def test_a_client_that_goes_while_it_advertises(ros_master: RosMaster, node: Providing) -> None:
    name = fresh("halfway")
    advertising = threading.Thread(target=node.advertise, args=("halfway", name))
    ros_master.process.signal(signal.SIGSTOP)
    try:
        advertising.start()
        wait_until(lambda: node.tell("cancel", client="halfway")["cancelled"])
    finally:
        ros_master.process.signal(signal.SIGCONT)
    advertising.join(20.0)
    wait_until(lambda: ros_master.providers(name) == [])
    assert "halfway" not in node.state()["active"]
    # The next one gets the name, whatever is still going on about the first.
    node.advertise("next", name, values={"sum": 5})
    with Caller(ros_master, name) as caller:
        caller.send(1, 2)
        assert caller.sum() == 5


def test_two_advertise_and_leave_at_the_same_time(ros_master: RosMaster, node: Providing) -> None:
    name = fresh("race")
    for _ in range(5):
        threads = [
            threading.Thread(target=node.advertise, args=(client, name), kwargs={"values": {"sum": 5}})
            for client in ("left", "right")
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(20.0)
        assert len({"left", "right"} & set(node.state()["active"])) == 1
        assert ros_master.providers(name) == ["/providing"]
        node.tell("unadvertise", client="left")
        node.tell("unadvertise", client="right")
        assert ros_master.providers(name) == []


def test_close(ros_master: RosMaster, tmp_path: Path) -> None:
    name = fresh("closing")
    node = Providing(ros_master, tmp_path)
    with node:
        node.advertise("closing", name, hang=True)
        with Caller(ros_master, name) as pending, Caller(ros_master, name, persistent="1") as idle:
            pending.send(1, 2)
            node.wait_requests("closing")
            assert node.tell("close")["took"] < 2.0
            assert pending.failure() == "the bridge is shutting down"
            assert idle.is_closed()
        assert ros_master.providers(name) == []
