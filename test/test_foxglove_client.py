# SPDX-License-Identifier: BSD-3-Clause
"""The bridge under @foxglove/ws-protocol, the client that Foxglove itself uses, as published on npm.

Messages are decoded by @foxglove/rosmsg-serialization with the definitions that the bridge advertises, and written by
it again. Each test runs one scenario of clients/foxglove.mjs.
"""

from __future__ import annotations

import base64
import json
import math
import shutil
from pathlib import Path
from typing import Any, Callable, Iterator

import genpy
import pytest

from support.bridge import Bridge
from support.node import Node
from support.peer import Peer
from support.robot import SAMPLES, heard
from support.ros import RosMaster

PROGRAM = Path(__file__).resolve().parent / "clients" / "foxglove.mjs"
TOPICS = [f"/robot/sample/{name}" for name in SAMPLES]


@pytest.fixture(params=["foxglove.websocket.v1", "foxglove.sdk.v1"])
def run(request: pytest.FixtureRequest, bridge: Bridge, robot: Node) -> Iterator[Callable[..., Any]]:
    """`run(scenario, …)`: what comes of it."""
    programs = []

    def start(scenario: str, server: Bridge = bridge, **options: Any) -> Any:
        node = shutil.which("node")
        assert node is not None, "no node on the PATH (scripts/test installs it)"
        command = [node, str(PROGRAM), server.url, request.param, scenario, json.dumps(options)]
        program = Node(server.master.process_in(command, f"foxglove-{scenario}"))
        programs.append(program)
        (done,) = program.wait_records("done", timeout=20.0)
        assert program.process.wait() == 0
        return done

    yield start
    for program in programs:
        program.stop()


def as_rosmsg(value: Any) -> Any:
    """A message, or part of one, as the program writes what @foxglove/rosmsg-serialization reads."""
    if isinstance(value, genpy.TVal):
        return {"sec": value.secs, "nsec": value.nsecs}
    if isinstance(value, genpy.Message):
        return {name: as_rosmsg(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, bytes):
        return {"$": "bytes", "base64": base64.b64encode(value).decode()}
    if isinstance(value, (list, tuple)):
        return [as_rosmsg(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return {"$": "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"}
    return value


def without_seq(value: Any) -> Any:
    """Without `seq`, which publishers count up by themselves."""
    if isinstance(value, dict):
        return {name: without_seq(item) for name, item in value.items() if name != "seq"}
    return [without_seq(item) for item in value] if isinstance(value, list) else value


def test_server_info(run: Callable[..., Any]) -> None:
    info = run("info")
    assert info["op"] == "serverInfo"
    assert info["supportedEncodings"] == ["ros1", "json"]


def test_every_kind_of_message_there_and_back(run: Callable[..., Any], robot: Node) -> None:
    outcome = run("topics", topics=TOPICS, prefix="/from_foxglove/")
    for name, message in SAMPLES.items():
        assert without_seq(outcome["decoded"][f"/robot/sample/{name}"]) == without_seq(as_rosmsg(message)), name
    assert outcome["statuses"] == []
    back = heard(robot, [f"/from_foxglove/{name}" for name in SAMPLES])
    assert back["/from_foxglove/text"] == {"data": SAMPLES["text"].data}
    assert back["/from_foxglove/image"]["data"] == list(SAMPLES["image"].data)
    assert back["/from_foxglove/int64s"]["data"] == SAMPLES["int64s"].data
    assert back["/from_foxglove/duration"]["data"] == {"secs": -2, "nsecs": 999999999}
    assert back["/from_foxglove/odometry"]["header"]["stamp"] == {"secs": 1700000000, "nsecs": 123456789}


def test_services(run: Callable[..., Any]) -> None:
    outcome = run("services", add="/robot/add", fail="/robot/fail")
    assert outcome["ros1"] == {"sum": 42}
    assert outcome["json"] == {"sum": 3}
    assert "/robot/fail" in outcome["failure"]["failed"]


def test_parameters(run: Callable[..., Any], ros_master: RosMaster) -> None:
    outcome = run("parameters", name="/foxglove/it")
    assert outcome == {
        "set": [{"name": "/foxglove/it", "value": [1, 2.5], "type": "float64_array"}],
        "updated": [{"name": "/foxglove/it", "value": "new"}],
        "removed": [{"name": "/foxglove/it"}],
        "all": sorted(ros_master.call("getParamNames"), key=outcome["all"].index),
    }


def test_the_connection_graph(run: Callable[..., Any]) -> None:
    graph = run("graph")
    assert {"name": "/robot/count", "publisherIds": ["/robot"]} in graph["publishedTopics"]
    assert {"name": "/robot/add", "providerIds": ["/robot"]} in graph["advertisedServices"]
    assert graph["removedTopics"] == graph["removedServices"] == []


def test_assets(run: Callable[..., Any], start_bridge: Callable[..., Bridge], tmp_path: Path) -> None:
    (tmp_path / "some_robot").mkdir()
    (tmp_path / "some_robot" / "robot.urdf").write_text("<robot/>")
    server = start_bridge(name="with_assets", environment={"ROS_PACKAGE_PATH": str(tmp_path)})
    found, missing = run("assets", server, uris=["package://some_robot/robot.urdf", "package://some_robot/no.urdf"])
    assert found == {"status": 0, "text": "<robot/>"}
    assert missing["status"] == 1
    assert "No such file" in missing["error"]


def test_time(run: Callable[..., Any], start_bridge: Callable[..., Bridge], ros_master: RosMaster, peer: Peer) -> None:
    ros_master.set_param("/use_sim_time", True)
    try:
        server = start_bridge(name="with_sim_time")
        peer.advertise("/clock", "rosgraph_msgs/Clock", latch=True, subscribers=1)
        peer.publish("/clock", {"clock": {"secs": 5, "nsecs": 6}})
        assert run("time", server)["timestamp"] == 5_000_000_006
    finally:
        ros_master.call("deleteParam", "/use_sim_time")
        peer.unadvertise("/clock")


def test_a_mistake_is_a_status(run: Callable[..., Any]) -> None:
    status = run("mistakes")
    assert status["level"] == 2
    assert "there is no channel 4294967295" in status["message"]
