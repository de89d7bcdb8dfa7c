# SPDX-License-Identifier: BSD-3-Clause
"""Clients that come and go: storms of them leave nothing behind, and a page that is refreshed loses nothing."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any, Callable, Dict, Iterator, List

import pytest
import rosbag

from support.bridge import Bridge
from support.effort import effort, figure
from support.node import _PROGRAMS, Node
from support.peer import Peer
from support.process import Process
from support.ros import RosMaster, executable, python
from support.usage import Usage, usage
from support.wait import wait_until

INT32, ADD = "std_msgs/Int32", "rosbridge_library/AddTwoInts"

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
    storm(ros_master, bridge, processes=effort(3, 8), seconds=effort(1.5, 10.0))
    before = settled(ros_master, bridge)
    begin = time.monotonic()
    visits = storm(ros_master, bridge, processes=effort(3, 8), seconds=effort(4.0, 20.0))
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
        assert found.threads <= before.threads + 1
        assert found.rss_mib < before.rss_mib + effort(6, 15)
    wait_until(lambda: bridge.process.output.count("Client disconnected") >= visits + sequence, 5.0)


def test_a_page_that_is_refreshed_loses_nothing(
    start_bridge: Start, ros_master: RosMaster, peer: Peer, tmp_path: Path
) -> None:
    """Publish, leave, come back, publish, before and after the bridge unregisters the publisher that nobody has any
    more; with a rospy and a roscpp subscriber (rosbag's recorder) that were there all the time."""
    topic = "/refreshed"
    bridge = start_bridge(effort({"unregister_timeout": 0.5}, {}))
    gaps = effort([0.1, 0.4, 0.5, 0.6, 0.1, 1.2], [0.1, 1.0, 5.0, 9.5, 10.0, 10.5, 0.1, 12.0, 15.0])
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
