# SPDX-License-Identifier: BSD-3-Clause
"""Parameters of the server that change the protocol, each with a server of its own: globs, BSON, sizes, times."""

from __future__ import annotations

import itertools
import json
import time
from typing import Any, Dict, Iterator

import bson
import pytest

from support.bridge import Bridge
from support.client import Client, defragment
from support.peer import Peer
from support.ros import RosMaster
from support.wait import wait_until

_numbers = itertools.count(1)
INT32, STRING, ADD = "std_msgs/Int32", "std_msgs/String", "rosbridge_library/AddTwoInts"


def fresh(name: str = "topic") -> str:
    return f"/{name}_{next(_numbers)}"


def live(client: Client, topic: str, kind: Any = None, **options: Any) -> str:
    client.set_level("info")
    number = client.subscribe(topic, kind, **options)
    client.wait_for(op="status", level="info", id=number)
    return number


# Globs


@pytest.fixture(scope="module")
def guarded(ros_master: RosMaster) -> Iterator[Bridge]:
    globs = {"topics_glob": "[/open/*, 'also_?']", "services_glob": '["/open/*"]', "params_glob": "[/nothing]"}
    with Bridge(ros_master, globs, name="guarded") as server:
        yield server
        assert server.unexpected() == []


@pytest.mark.parametrize("topic", ["/open/topic", "open/topic", "/open//topic", "/also_1", "also_1"])
def test_open_topics(guarded: Bridge, connect, topic: str):
    client = connect(guarded)
    live(client, topic, INT32)
    client.advertise(topic, INT32)
    client.publish(topic, {"data": 1})
    assert client.next_message(topic) == {"data": 1}
    assert client.statuses("error") == []


@pytest.mark.parametrize("topic", ["/closed", "closed", "/openly", "/open", "/x/open/topic", "/also_12", "//closed"])
def test_closed_topics(guarded: Bridge, connect, peer: Peer, ros_master: RosMaster, topic: str):
    client, name = connect(guarded), "/" + topic.strip("/")
    peer.advertise(name, INT32)
    for operation in (
        {"op": "advertise", "type": INT32},
        {"op": "publish", "msg": {"data": 1}},
        {"op": "subscribe", "type": INT32},
        {"op": "subscribe"},
    ):
        client.send({**operation, "topic": topic, "id": operation["op"]})
        status = client.wait_for(op="status", level="error", id=operation["op"])
        assert topic in status["msg"]
    for op in ("unsubscribe", "unadvertise"):
        client.send({"op": op, "topic": topic})
    client.sync()
    assert "/guarded" not in ros_master.publishers(name) + ros_master.subscribers(name)


def test_open_and_closed_services(guarded: Bridge, connect, peer: Peer, ros_master: RosMaster):
    client = connect(guarded)
    for service in ("/open/service", "/closed_service"):
        peer.serve(service, ADD)
    assert client.call_service("open/service", [1, 2])["values"] == {"sum": 3}
    for name in ("/closed_service", "closed_service", "/open/../closed_service", "/closed_service#id", "/open"):
        response = client.call_service(name, [1, 2])
        assert response["result"] is False
        assert isinstance(response["values"], str)
        client.wait_for(op="status", level="error", id=response["id"])
    client.sync()
    assert client.take(op="service_response") == []
    assert peer.requested("/closed_service") == []
    number = client.advertise_service("/closed_too", ADD)
    client.wait_for(op="status", level="error", id=number)
    client.advertise_service("/open/too", ADD)
    client.sync()
    assert ros_master.providers("/closed_too") == []
    assert ros_master.providers("/open/too") == ["/guarded"]


def test_services_of_rosapi_are_not_closed_to_calls_but_to_providing(guarded: Bridge, connect):
    client = connect(guarded)
    assert "does not let" not in client.call_service("/rosapi/topics", {})["values"]
    number = client.advertise_service("/rosapi/topics", ADD)
    client.wait_for(op="status", level="error", id=number)
    assert "does not let" in client.call_service("/rosapi_x/topics", {})["values"]


@pytest.mark.parametrize("globs", ["", "[]"])
def test_globs_that_allow_everything(start_bridge, connect, globs: str):
    bridge = start_bridge({"topics_glob": globs, "services_glob": globs}, name="wide_open")
    client, topic = connect(bridge), fresh()
    live(client, topic, INT32)
    client.advertise(topic, INT32)
    client.publish(topic, {"data": 1})
    assert client.next_message(topic) == {"data": 1}


# BSON


class BsonClient:
    """Every frame in both directions is one BSON document."""

    def __init__(self, client: Client) -> None:
        self.connection = client.connection

    def send(self, operation: Dict[str, Any]) -> None:
        self.connection.send(bson.encode(operation))

    def wait_for(self, **fields: Any) -> Dict[str, Any]:
        end = time.monotonic() + 5
        while True:
            frame = self.connection.recv(max(0.0, end - time.monotonic()))
            assert isinstance(frame, bytes)
            message: Dict[str, Any] = bson.decode(frame)
            if all(message.get(name) == value for name, value in fields.items()):
                return message


@pytest.fixture(scope="module")
def bson_bridge(ros_master: RosMaster) -> Iterator[Bridge]:
    with Bridge(ros_master, {"bson_only_mode": True}, name="bson_bridge") as server:
        yield server
        assert server.unexpected() == []


def test_bson_both_ways(bson_bridge: Bridge, connect, peer: Peer):
    client, topic = BsonClient(connect(bson_bridge)), fresh("bson")
    client.send({"op": "set_level", "level": "info"})
    for kind, name in (("rosbridge_library/TestUInt8", "_bytes"), ("std_msgs/Float32MultiArray", "_floats")):
        client.send({"op": "subscribe", "topic": topic + name, "type": kind, "id": "s" + name, "compression": "cbor"})
        client.wait_for(op="status", id="s" + name)
        client.send({"op": "advertise", "topic": topic + name, "type": kind})
    client.send({"op": "publish", "topic": topic + "_bytes", "msg": {"data": b"\x00\xff"}})
    assert client.wait_for(op="publish") == {"op": "publish", "topic": topic + "_bytes", "msg": {"data": b"\x00\xff"}}
    client.send({"op": "publish", "topic": topic + "_floats", "msg": {"data": [1.5, float("inf")]}})
    assert client.wait_for(op="publish")["msg"]["data"] == [1.5, float("inf")]
    peer.serve(topic + "_add", ADD)
    client.send({"op": "call_service", "service": topic + "_add", "args": [1, 2], "id": 5})
    assert client.wait_for(op="service_response")["values"] == {"sum": 3}
    client.send({"op": "call_service", "service": topic + "_none", "id": "x"})
    assert client.wait_for(op="service_response", id="x")["result"] is False
    client.send({"op": "advertise_service", "service": topic + "_provided", "type": ADD, "id": "a"})
    client.wait_for(op="status", id="a")
    call = peer.begin_call(topic + "_provided", ADD, {"a": 1, "b": 2})
    request = client.wait_for(op="call_service")
    client.send({"op": "service_response", "id": request["id"], "values": {"sum": 3}, "result": True})
    assert call.result() == {"sum": 3}


def test_bson_of_numbers_it_can_not_hold_is_an_error_and_no_more(bson_bridge: Bridge, connect, peer: Peer):
    client, topic = BsonClient(connect(bson_bridge)), fresh("bson")
    peer.advertise(topic, "std_msgs/UInt64", latch=True)
    peer.publish(topic, {"data": 2**64 - 1})
    client.send({"op": "subscribe", "topic": topic, "id": "s"})
    status = client.wait_for(op="status", level="error")
    assert topic in status["msg"]
    peer.publish(topic, {"data": 2**63 - 1})
    assert client.wait_for(op="publish")["msg"] == {"data": 2**63 - 1}
    peer.publish(topic, {"data": 2**64 - 1}, {"data": 1})
    assert client.wait_for(op="publish")["msg"] == {"data": 1}


@pytest.mark.parametrize(
    "frame",
    [
        b"",
        b"nonsense",
        b"\x05\x00\x00\x00",
        b"\x05\x00\x00\x00\x01",
        b"\xff\xff\xff\x7f\x00",
        b"\x05\x00\x00\x00\x00rest",
        bson.encode({"op": "x"})[:-3],
        bson.encode({"op": 5}),
        bson.encode({"x": 5}),
        b"\x0e\x00\x00\x00\x02op\x00\x02\x00\x00\x00\xff\x00\x00",
        json.dumps({"op": "subscribe", "topic": "/x"}),
    ],
)
def test_frames_that_are_no_bson(bson_bridge: Bridge, connect, frame: Any):
    client = BsonClient(connect(bson_bridge))
    client.connection.send(frame)
    assert client.wait_for(op="status")["level"] == "error"
    client.send({"op": "nonsense", "id": "still there"})
    client.wait_for(op="status", id="still there")


def test_deep_bson(bson_bridge: Bridge, connect):
    client = BsonClient(connect(bson_bridge))
    document = b"\x05\x00\x00\x00\x00"
    for _ in range(50_000):
        body = b"\x03a\x00" + document[-200_000:] if len(document) < 200_000 else b"\x03a\x00" + document
        document = (len(body) + 5).to_bytes(4, "little") + body + b"\x00"
        if len(document) > 100_000:
            break
    client.connection.send(document)
    assert client.wait_for(op="status")["level"] == "error"


@pytest.mark.parametrize("encoder", ["bson", "b64"])
def test_binary_encoder(start_bridge, connect, peer: Peer, encoder: str):
    """With bson, what holds binary data is a BSON document in a binary frame, and all else is JSON."""
    bridge = start_bridge({"binary_encoder": encoder}, name="encoding")
    client, topic = connect(bridge), fresh("binary")
    peer.advertise(topic, "rosbridge_library/TestUInt8")
    peer.advertise(topic + "_text", STRING)
    live(client, topic)
    live(client, topic + "_text")
    peer.publish(topic + "_text", {"data": "text"})
    assert client.next_message(topic + "_text") == {"data": "text"}
    peer.publish(topic, {"data": [0, 255]})
    frame = client.connection.recv(5)
    if encoder == "bson":
        assert isinstance(frame, bytes)
        assert bson.decode(frame) == {"op": "publish", "topic": topic, "msg": {"data": b"\x00\xff"}}
    else:
        assert json.loads(frame) == {"op": "publish", "topic": topic, "msg": {"data": "AP8="}}
    client.advertise(topic + "_in", "rosbridge_library/TestUInt8")
    peer.subscribe(topic + "_in", "rosbridge_library/TestUInt8")
    peer.wait_publishers(topic + "_in")
    client.publish(topic + "_in", {"data": "AP8="})
    assert peer.received(topic + "_in", 1) == [{"data": [0, 255]}]


# Sizes


def test_max_message_size(start_bridge, connect, peer: Peer):
    bridge = start_bridge({"max_message_size": 200}, name="small")
    client, topic = connect(bridge), fresh("sized")
    peer.advertise(topic, STRING)
    live(client, topic, STRING)
    for options, largest in (({}, 200), ({"fragment_size": 1000}, 200), ({"fragment_size": 50}, 50)):
        if options:
            live(client, topic, STRING, **options)
        peer.publish(topic, {"data": "x" * 1000})
        first = client.wait_for(op="fragment")
        parts = [first] + [client.wait_for(op="fragment", id=first["id"]) for _ in range(first["total"] - 1)]
        assert max(len(part["data"]) for part in parts) == largest
        assert defragment(parts)["msg"] == {"data": "x" * 1000}
    service = fresh("sized")
    peer.serve(service, "rosbridge_library/SendBytes", response={"data": "y" * 500})
    number = client.request(service, [1])
    first = client.wait_for(op="fragment")
    parts = [first] + [client.wait_for(op="fragment") for _ in range(first["total"] - 1)]
    assert defragment(parts)["id"] == number


def test_max_incoming_size_bounds_fragments(start_bridge, connect):
    bridge = start_bridge({"max_incoming_size": 100_000}, name="bounded")
    client = connect(bridge)
    for number in range(5):
        client.send({"op": "fragment", "id": "big", "num": number, "total": 6, "data": "x" * 30_000})
    client.wait_for(op="status", level="error", id="big")
    client.sync()


# Times


def test_fragment_timeout(start_bridge, connect):
    bridge = start_bridge({"fragment_timeout": 0.3}, name="hurried")
    client = connect(bridge)
    begin = time.monotonic()
    client.send({"op": "fragment", "id": "late", "num": 0, "total": 2, "data": "{}"})
    status = client.wait_for(op="status", level="error", id="late")
    assert "1 of 2" in status["msg"]
    assert 0.25 < time.monotonic() - begin < 1.0
    client.send({"op": "fragment", "id": "late", "num": 1, "total": 2, "data": "{}"})  # begins anew
    client.sync()
    assert client.statuses() == []
    client.wait_for(op="status", level="error", id="late")


def test_unregister_timeout(start_bridge, connect, ros_master: RosMaster, peer: Peer):
    """A page that is refreshed within it loses nothing, and is connected all the time; after it, the publisher goes."""
    bridge = start_bridge({"unregister_timeout": 0.8}, name="lingering")
    topic = fresh("lingering")
    peer.subscribe(topic, INT32)
    for number in range(3):
        with bridge.connect() as client:
            client.advertise(topic, INT32)
            client.publish(topic, {"data": number})
            client.sync()
        assert ros_master.publishers(topic) == ["/lingering"]
    left = time.monotonic()
    assert peer.received(topic, 3) == [{"data": 0}, {"data": 1}, {"data": 2}]
    wait_until(lambda: ros_master.publishers(topic) == [], 3.0)
    assert time.monotonic() - left > 0.6


def test_unregister_timeout_of_zero(start_bridge, connect, ros_master: RosMaster):
    bridge = start_bridge({"unregister_timeout": 0}, name="brief")
    for leaves in (False, True):
        topic, client = fresh("brief"), connect(bridge)
        client.advertise(topic, INT32)
        client.sync()
        assert ros_master.publishers(topic) == ["/brief"]
        if leaves:
            client.close()
        else:
            client.send({"op": "unadvertise", "topic": topic})
        wait_until(lambda name=topic: ros_master.publishers(name) == [], 2.0)


def test_simulated_time(start_bridge, connect, peer: Peer, ros_master: RosMaster):
    ros_master.set_param("/use_sim_time", True)
    try:
        bridge = start_bridge(name="simulated")
        client, topic = connect(bridge), fresh("sim")
        peer.advertise("/clock", "rosgraph_msgs/Clock", subscribers=1)
        live(client, topic, "geometry_msgs/PointStamped", compression="cbor-raw")
        live(client, topic + "_plain", "geometry_msgs/PointStamped")
        other = connect(bridge)
        live(other, "/clock")
        for name in (topic, topic + "_plain"):
            client.advertise(name, "geometry_msgs/PointStamped")
        point = {"x": 1, "y": 2, "z": 3}
        for secs, nsecs in ((100, 5), (200, 500_000_000), (150, 0)):
            peer.publish("/clock", {"clock": {"secs": secs, "nsecs": nsecs}})
            assert other.next_message("/clock") == {"clock": {"secs": secs, "nsecs": nsecs}}
            client.publish(topic, {"point": point})
            raw = client.next_message(topic)
            assert (raw["secs"], raw["nsecs"]) == (secs, nsecs)
            client.publish(topic + "_plain", {"point": point})
            assert client.next_message(topic + "_plain")["header"]["stamp"] == {"secs": secs, "nsecs": nsecs}
            client.publish(topic + "_plain", {"header": {"stamp": "now", "frame_id": "f"}, "point": point})
            assert client.next_message(topic + "_plain")["header"]["stamp"] == {"secs": secs, "nsecs": nsecs}
        other.send({"op": "unsubscribe", "topic": "/clock"})
        other.sync()
        peer.publish("/clock", {"clock": {"secs": 300, "nsecs": 1}})

        def follows() -> bool:
            client.publish(topic + "_plain", {"point": point})
            return bool(client.next_message(topic + "_plain")["header"]["stamp"] == {"secs": 300, "nsecs": 1})

        wait_until(follows, 3.0, "the clock to go on without clients that subscribe to it")
        # A throttle's interval goes by while simulated time stands still.
        peer.advertise(topic + "_throttled", INT32)
        live(client, topic + "_throttled", INT32, throttle_rate=100)
        peer.publish(topic + "_throttled", {"data": 1}, {"data": 2}, {"data": 3})
        assert [each["data"] for each in client.messages(topic + "_throttled", 2)] == [1, 3]
    finally:
        ros_master.call("deleteParam", "/use_sim_time")
