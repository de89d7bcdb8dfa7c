# SPDX-License-Identifier: BSD-3-Clause
"""Clients that come and go: storms of them leave nothing behind, and a page that is refreshed loses nothing."""

from __future__ import annotations

import json
import signal
import time
from pathlib import Path
from typing import Any, Callable, Dict, Iterator, List

import pytest
import rosbag

from support.bridge import Bridge
from support.effort import effort, figure
from support.node import _PROGRAMS, Node, serve
from support.peer import Peer
from support.process import Process
from support.ros import RosMaster, executable, python
from support.usage import Usage, usage
from support.wait import wait_until

INT32, ADD = "std_msgs/Int32", "rosbridge_library/AddTwoInts"
ALLOWED = "/allowed"
POOL_THREADS = 22
"""The threads for blocking calls are made as they are needed, and stay."""

Start = Callable[..., Bridge]


@pytest.fixture
def peer(ros_master: RosMaster) -> Iterator[Peer]:
    found = Peer(ros_master)
    yield found
    found.node.stop()


def storm(master: RosMaster, bridge: Bridge, processes: int, *, seconds: float = 0, count: int = 0) -> int:
    """So many processes of programs/storm.py at once; how many connections they made."""
    running: List[Process] = []
    for index in range(processes):
        operations: List[List[Dict[str, Any]]] = [
            [
                {"op": "subscribe", "topic": f"/storm/in_{number}", "type": INT32},
                {"op": "advertise", "topic": f"/storm/out_{index}_{number}", "type": INT32},
                {"op": "publish", "topic": f"/storm/out_{index}_{number}", "msg": {"data": 1}},
                {"op": "advertise_service", "service": f"/storm/service_{index}_{number}", "type": ADD},
                {"op": "call_service", "service": f"/storm/service_{index}_{number}", "args": [1, 2]},
                {"op": "fragment", "id": "never", "num": 0, "total": 2, "data": "x" * 1000},
            ]
            for number in range(3)
        ]
        operations.append([])  # one that only connects
        options = {"port": bridge.port, "seconds": seconds, "count": count, "operations": operations}
        environment = {"PYTHONPATH": f"{_PROGRAMS.parent}:{master.environment.get('PYTHONPATH', '')}"}
        command = [python(), str(_PROGRAMS / "storm.py"), json.dumps(options)]
        running.append(master.process_in(command, "storm", environment))
    for process in running:
        assert process.wait(60.0 + seconds + count / 20) == 0, process.output
    return sum(int(Node(process).records("visits")[0]) for process in running)


def settled(master: RosMaster, bridge: Bridge) -> Usage:
    """What the server takes when no trace of the storm is left at the master and it does nothing any more."""

    def registered() -> List[Any]:
        return [entry for kind in master.call("getSystemState") for entry in kind if entry[0].startswith("/storm")]

    wait_until(lambda: registered() == [], 20.0, lambda: f"no traces, but {registered()}")

    def idle() -> bool:
        before = usage(bridge.process.pid)
        time.sleep(0.3)  # over which it is looked whether it does anything
        after = usage(bridge.process.pid)
        return after.cpu_s - before.cpu_s <= 0.02 and after.open_files == before.open_files

    wait_until(idle, 20.0, "an idle server")
    return usage(bridge.process.pid)


def test_storms_of_clients_leave_nothing_behind(start_bridge: Start, ros_master: RosMaster) -> None:
    """The first storm is the measure: what the later ones leave on top of it would be a leak."""
    bridge = start_bridge({"unregister_timeout": 0.3})
    storm(ros_master, bridge, processes=effort(3, 8), seconds=effort(1.0, 10.0))
    before = settled(ros_master, bridge)
    begin = time.monotonic()
    visits = storm(ros_master, bridge, processes=effort(3, 8), seconds=effort(2.5, 20.0))
    after_storm = settled(ros_master, bridge)
    sequence = storm(ros_master, bridge, processes=1, count=effort(300, 10_000))
    after = settled(ros_master, bridge)
    figure("connections", in_the_storm=visits, in_sequence=sequence, seconds=time.monotonic() - begin)
    for when, found in (("before", before), ("after the storm", after_storm), ("after the sequence", after)):
        figure(f"server {when}", rss_mib=found.rss_mib, open_files=found.open_files, threads=found.threads)
    assert visits > effort(50, 1000)
    assert sequence == effort(300, 10_000)
    for found in (after_storm, after):
        assert found.open_files <= before.open_files + 2
        assert found.threads <= before.threads + POOL_THREADS
        assert found.rss_mib < before.rss_mib + effort(10, 15)
    wait_until(lambda: bridge.process.output.count("Client disconnected") >= visits + sequence, 5.0)


def test_a_page_that_is_refreshed_loses_nothing(
    start_bridge: Start, ros_master: RosMaster, peer: Peer, tmp_path: Path
) -> None:
    """Publish, leave, come back, publish, before and after the bridge unregisters the publisher that nobody has any
    more; with a rospy and a roscpp subscriber (rosbag's recorder) that were there all the time."""
    topic = "/refreshed"
    bridge = start_bridge(effort({"unregister_timeout": 0.5}, {}))
    gaps = effort([0.1, 0.4, 0.5, 0.6, 1.2], [0.1, 1.0, 5.0, 9.5, 10.0, 10.5, 0.1, 12.0, 15.0])
    peer.subscribe(topic, INT32)
    bag = tmp_path / "refreshed.bag"
    expected = list(range(3 * (len(gaps) + 1)))
    ends_with_all = ["-l", str(len(expected))]
    command = [str(executable("rosbag", "record")), *ends_with_all, "-O", str(bag), topic, "__name:=recorder"]
    recorder = ros_master.process_in(command, "recorder")
    try:
        wait_until(lambda: "/recorder" in ros_master.subscribers(topic), 10.0, lambda: recorder.output)
        numbers = iter(expected)
        for gap in [*gaps, 0.0]:
            with bridge.connect() as page:
                page.advertise(topic, INT32)
                for _ in range(3):
                    page.publish(topic, {"data": next(numbers)})
            time.sleep(gap)
        assert [message["data"] for message in peer.received(topic, len(expected))] == expected
        recorder.wait(5.0)
    finally:
        recorder.stop()
    with rosbag.Bag(str(bag)) as recorded:
        assert [message.data for _, message, _ in recorded.read_messages()] == expected
    figure("page refreshes", pages=len(gaps) + 1, messages_published=len(expected), lost=0)


# Operations that fail half-way


BAD_TYPES = ("std_msgs/NoSuchType", "no_such_package/Type", "std_msgs", 7)


def failing(mark: str, hanging: str, dying: str) -> List[Dict[str, Any]]:
    """Operations that begin and fail; all of their names hold `mark`."""
    name = f"{ALLOWED}/{mark}"
    made: List[Dict[str, Any]] = []
    for number, kind in enumerate(BAD_TYPES):
        made += [
            {"op": "advertise", "topic": f"{name}_out{number}", "type": kind},
            {"op": "publish", "topic": f"{name}_unknown{number}", "msg": {"data": 1}},
            {"op": "publish", "topic": f"{name}_typed{number}", "type": kind, "msg": {"data": 1}},
            {"op": "subscribe", "topic": f"{name}_in{number}", "type": kind},
            {"op": "advertise_service", "service": f"{name}_service{number}", "type": kind},
        ]
    made += [
        {"op": "advertise", "topic": f"{name}_good", "type": INT32},
        {"op": "advertise", "topic": f"{name}_good", "type": "std_msgs/String"},
        {"op": "publish", "topic": f"{name}_good", "msg": {"data": "text"}},
        {"op": "subscribe", "topic": f"{name}_good", "type": "std_msgs/String"},
        {"op": "subscribe", "topic": f"{name}_good_in", "type": INT32, "throttle_rate": 1000},
        {"op": "subscribe", "topic": f"{name}_good_in", "type": INT32, "compression": "zip"},
        {"op": "unsubscribe", "topic": f"{name}_never"},
        {"op": "unadvertise", "topic": f"{name}_never"},
        {"op": "unadvertise_service", "service": f"{name}_never"},
        {"op": "advertise_service", "service": f"{name}_good", "type": ADD},
        {"op": "service_response", "service": f"{name}_good", "id": "nobody's", "result": True, "values": {}},
        {"op": "call_service", "service": f"{name}_nobody", "args": []},
        {"op": "call_service", "service": hanging, "args": [1, 2]},
        {"op": "call_service", "service": dying, "args": [1, 2]},
        {"op": "fragment", "id": mark, "num": 0, "total": 2, "data": "x" * 10_000},
        {"op": "png", "data": "QUJD"},
        {"op": "advertise", "topic": f"/forbidden/{mark}", "type": INT32},
        {"op": "publish", "topic": f"/forbidden/{mark}", "type": INT32, "msg": {"data": 1}},
        {"op": "subscribe", "topic": f"/forbidden/{mark}", "type": INT32},
        {"op": "advertise_service", "service": f"/forbidden/{mark}", "type": ADD},
        {"op": "call_service", "service": f"/forbidden/{mark}", "args": []},
    ]
    return made


def traces(master: RosMaster, mark: str) -> List[Any]:
    return [entry for kind in master.call("getSystemState") for entry in kind if mark in entry[0]]


@pytest.mark.allow_log("master at http", "the master refuses")
@pytest.mark.parametrize("trouble", ["none", "master hangs", "master gone"])
def test_operations_that_fail_half_way_leave_nothing_behind_after_a_disconnect(
    start_bridge: Start, ros_master: RosMaster, peer: Peer, nodes: Callable[[Node], Node], trouble: str
) -> None:
    """Bad types, a service that hangs or dies, what the globs refuse, and a master that hangs or is gone: clients leave
    while it goes wrong, and after it has."""
    globs = {"topics_glob": f"[{ALLOWED}/*]", "services_glob": f"[{ALLOWED}/*]"}
    bridge = start_bridge({**globs, "unregister_timeout": 0.2}, name=f"failing_{trouble.replace(' ', '_')}")
    mark = f"half_{trouble.replace(' ', '_')}"
    hanging, dying = f"{ALLOWED}/hanging_{mark[5:]}", f"{ALLOWED}/dying_{mark[5:]}"
    nodes(serve(ros_master, hanging, behaviour="hang", name="hanging"))

    def play(round_: int, wait: bool) -> None:
        operations = failing(f"{mark}_{round_}", hanging, dying)
        clients = [bridge.connect(timeout=30.0) for _ in range(3)]
        for client, part in zip(clients, (operations, operations[::-1], operations[::2])):
            for operation in part:
                client.send({"id": 1, **operation})
        for client in clients:
            if wait:
                client.sync()
            client.drop()

    def idle() -> Usage:
        wait_until(lambda: traces(ros_master, mark) == [], 20.0, lambda: f"no traces, but {traces(ros_master, mark)}")
        return settled(ros_master, bridge)

    dies = serve(ros_master, dying, behaviour="die", name="dying")
    play(0, wait=True)  # what is loaded and made the first time
    dies.kill()
    before = idle()
    for round_ in range(1, effort(2, 10)):
        if trouble == "master hangs":
            ros_master.process.signal(signal.SIGSTOP)
        elif trouble == "master gone":
            ros_master.kill()
        play(round_, wait=trouble == "none")
        if trouble == "master hangs":
            time.sleep(0.5)  # in the middle of what now waits for the master
            ros_master.process.signal(signal.SIGCONT)
        elif trouble == "master gone":
            time.sleep(0.5)
            ros_master.restart()
            wait_until(lambda: ros_master.publishers("/client_count"), 10.0, "the bridge at the new master")
    after = idle()
    figure(
        f"operations that fail, {trouble}",
        rss_mib_before=before.rss_mib,
        rss_mib=after.rss_mib,
        open_files_before=before.open_files,
        open_files=after.open_files,
        threads_before=before.threads,
        threads=after.threads,
    )
    assert after.open_files <= before.open_files + 2
    assert after.threads <= before.threads + POOL_THREADS
    assert after.rss_mib < before.rss_mib + 8


def test_topics_that_come_and_go_leave_no_files_open(start_bridge: Start, ros_master: RosMaster) -> None:
    bridge = start_bridge({"unregister_timeout": 0.1}, name="going")
    counts = []
    for round_ in range(effort(2, 10)):
        with bridge.connect() as client:
            client.set_level("info")
            for number in range(50):
                client.subscribe(f"/storm/going_{round_}_{number}", INT32)
                client.advertise(f"/storm/going_{round_}_{number}", INT32)
            client.sync()
        counts.append(settled(ros_master, bridge).open_files)
    figure("open files after 100 topics each", **{f"round_{n}": count for n, count in enumerate(counts)})
    assert max(counts) <= counts[0] + 2
    assert counts[0] < 40
