# SPDX-License-Identifier: BSD-3-Clause
"""The harness itself: that its processes start, say what they should, fail loudly and end."""

from __future__ import annotations

import os
import sys

import pytest

from support.bridge import errors_in
from support.client import decode, defragment
from support.node import echo, publish, script, serve
from support.process import Process
from support.ros import RosMaster
from support.wait import wait_until


def test_wait_until_gives_up_with_the_message():
    with pytest.raises(AssertionError, match="a thing that never comes"):
        wait_until(lambda: False, 0.05, "a thing that never comes")


def test_a_process_is_ended_with_its_group(tmp_path):
    source = "import subprocess, time\nprint(subprocess.Popen(['sleep', '1000']).pid, flush=True)\ntime.sleep(1000)\n"
    command = [sys.executable, "-c", source]
    with Process(command, name="parent", directory=tmp_path, environment=dict(os.environ)) as process:
        child = int(process.wait_for_line(r"^(\d+)$").group(1))
        process.stop()
    wait_until(lambda: not _runs(child), 5.0, "end of the grandchild")


def test_a_process_that_ends_early_is_told_with_its_output(tmp_path):
    command = [sys.executable, "-c", "raise SystemExit('out of luck')"]
    with Process(command, name="unlucky", directory=tmp_path, environment=dict(os.environ)) as process:
        with pytest.raises(AssertionError, match="out of luck"):
            process.wait_for_line("never")
        assert process.wait() == 1


def test_messages_reach_the_echo(ros_master: RosMaster, nodes):
    listener = nodes(echo(ros_master, "/numbers", "std_msgs/Int32"))
    nodes(publish(ros_master, "/numbers", "std_msgs/Int32", rate=0, count=100, counter="data", subscribers=1))
    assert listener.wait_records("message", 100) == [{"data": number} for number in range(100)]


def test_a_latched_message_with_bytes(ros_master: RosMaster, nodes):
    nodes(publish(ros_master, "/bytes", "rosbridge_library/TestUInt8", {"data": [1, 2, 255]}, count=1, latch=True))
    listener = nodes(echo(ros_master, "/bytes", "rosbridge_library/TestUInt8"))
    assert listener.wait_records("message") == [{"data": [1, 2, 255]}]


def test_services(ros_master: RosMaster, nodes):
    provider = nodes(serve(ros_master, "/add"))
    nodes(serve(ros_master, "/deaf", behaviour="deaf", name="deaf_provider"))
    assert ros_master.providers("/add") == ["/provider"]
    assert ros_master.providers("/deaf") == ["/deaf_provider"]
    caller = nodes(
        script(
            ros_master,
            "from rosbridge_library.srv import AddTwoInts\n"
            "rospy.wait_for_service('/add', 10)\n"
            "ready()\n"
            "say(sum=rospy.ServiceProxy('/add', AddTwoInts)(2, 3).sum)\n",
        )
    )
    assert caller.wait_records("sum") == [5]
    assert provider.records("request") == [{"a": 2, "b": 3}]


def test_a_restarted_master_is_empty_and_at_the_same_address(ros_master: RosMaster):
    ros_master.set_param("/left/over", 1)
    uri = ros_master.uri
    ros_master.kill()
    with pytest.raises(OSError):  # noqa: PT011, whatever kind: nobody is there
        ros_master.call("getPid")
    ros_master.restart()
    assert ros_master.uri == uri
    assert ros_master.get_param("/left/over", "gone") == "gone"


def test_fragments_are_joined_in_order_and_nan_is_refused():
    fragments = [
        {"op": "fragment", "id": "1", "num": 1, "total": 2, "data": '"x"}'},
        {"op": "fragment", "id": "1", "num": 0, "total": 2, "data": '{"op":'},
    ]
    assert defragment(fragments) == {"op": "x"}
    with pytest.raises(AssertionError, match="NaN"):
        decode('{"value": NaN}')


def test_errors_and_tracebacks_in_a_log_are_found_whole():
    log = (
        "[INFO] [1.0]: fine, no ERROR here\n"
        "[WARN] [2.0]: it broke\n"
        "Traceback (most recent call last):\n"
        '  File "x.py", line 1, in y\n'
        "ValueError: a\n"
        "[INFO] [3.0]: fine\n"
        "[ERROR] [4.0]: b\n"
    )
    first, second = errors_in(log)
    assert first.startswith("[WARN] [2.0]: it broke\nTraceback")
    assert first.endswith("ValueError: a")
    assert second == "[ERROR] [4.0]: b"
    assert errors_in(log, ["ValueError"]) == [second]


def _runs(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as stat:
            return stat.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False
