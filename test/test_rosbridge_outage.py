# SPDX-License-Identifier: BSD-3-Clause
"""What dies and comes back: publishers, subscribers, and the master, which stops, is killed, and starts again empty.

Clients stay connected, are told what is wrong and why, and never wait for ever.
"""

from __future__ import annotations

import itertools
import signal
import time
from contextlib import contextmanager
from typing import Any, Iterator

import pytest

from support.bridge import Bridge
from support.client import Client
from support.peer import Peer
from support.ros import RosMaster
from support.wait import wait_until

_numbers = itertools.count(1)
INT32, ADD = "std_msgs/Int32", "rosbridge_library/AddTwoInts"

pytestmark = pytest.mark.allow_log("master at http")


def fresh(name: str = "topic") -> str:
    return f"/{name}_{next(_numbers)}"


@pytest.fixture(scope="module")
def bridge(ros_master: RosMaster) -> Iterator[Bridge]:
    with Bridge(ros_master, {"unregister_timeout": 0.2}) as server:
        yield server


@pytest.fixture
def new_peer(ros_master: RosMaster, nodes) -> Any:
    def start(name: str = "peer") -> Peer:
        peer = Peer(ros_master, name)
        nodes(peer.node)
        return peer

    return start


@pytest.fixture
def client(bridge: Bridge, connect) -> Client:
    return connect(bridge)


def live(client: Client, topic: str, kind: Any = INT32, timeout: float = 10.0) -> str:
    client.set_level("info")
    number = client.subscribe(topic, kind)
    client.wait_for(op="status", level="info", id=number, timeout=timeout)
    return number


@contextmanager
def stopped(master: RosMaster) -> Iterator[None]:
    """The master hangs: it takes connections, and says nothing."""
    master.process.signal(signal.SIGSTOP)
    try:
        yield
    finally:
        master.process.signal(signal.SIGCONT)


@contextmanager
def away(master: RosMaster) -> Iterator[None]:
    """The master is killed; in the end an empty one takes its place."""
    master.kill()
    try:
        yield
    finally:
        master.restart()


# Nodes


def test_a_dead_publisher_is_told_until_it_is_back(bridge: Bridge, connect, client: Client, new_peer):
    topic, peer = fresh(), new_peer("mortal")
    peer.advertise(topic, INT32)
    peer.node.kill()
    begin = time.monotonic()
    number = client.subscribe(topic, INT32)
    status = client.wait_for(op="status", level="error", id=number)
    assert topic in status["msg"]
    assert time.monotonic() - begin < 6
    phoenix = new_peer("mortal")
    phoenix.advertise(topic, INT32, subscribers=1)
    phoenix.publish(topic, {"data": 1})
    for late in (client, connect(bridge)):
        if late is not client:
            live(late, topic)
            assert late.statuses("error") == []
            phoenix.publish(topic, {"data": 1})
        assert late.next_message(topic) == {"data": 1}


def test_a_publisher_that_dies_later_is_told_to_who_subscribes_then(bridge: Bridge, connect, client: Client, new_peer):
    topic, peer = fresh(), new_peer("doomed")
    peer.advertise(topic, INT32)
    live(client, topic)
    peer.node.kill()
    other = connect(bridge)
    number = other.subscribe(topic, INT32)
    other.wait_for(op="status", level="error", id=number)
    again = new_peer("doomed")
    again.advertise(topic, INT32, subscribers=1)
    again.publish(topic, {"data": 2})
    assert client.next_message(topic) == {"data": 2}
    assert other.next_message(topic) == {"data": 2}


def test_a_publisher_that_hangs_delays_nobody(bridge: Bridge, connect, client: Client, new_peer):
    topic, peer = fresh(), new_peer("hanging")
    peer.advertise(topic, INT32)
    peer.node.process.signal(signal.SIGSTOP)
    try:
        begin = time.monotonic()
        number = client.subscribe(topic, INT32)
        client.sync()
        assert time.monotonic() - begin < 1.0
        client.wait_for(op="status", level="error", id=number)
    finally:
        peer.node.process.signal(signal.SIGCONT)
    peer.wait_connected(topic)
    peer.publish(topic, {"data": 1})
    assert client.next_message(topic) == {"data": 1}


def test_a_dead_subscriber_delays_nobody(bridge: Bridge, connect, client: Client, new_peer):
    topic, peer, alive = fresh(), new_peer("dead_ear"), new_peer("ear")
    peer.subscribe(topic, INT32)
    alive.subscribe(topic, INT32)
    peer.node.kill()
    begin = time.monotonic()
    client.advertise(topic, INT32)
    client.publish(topic, {"data": 1})
    assert alive.received(topic, 1) == [{"data": 1}]
    assert time.monotonic() - begin < 2
    client.sync()
    assert client.statuses() == []


# The master


@pytest.mark.parametrize("outage", [stopped, away])
def test_every_operation_is_answered_while_the_master_is_away(
    bridge: Bridge, connect, ros_master: RosMaster, new_peer, outage: Any
):
    topic = fresh("outage")
    known = connect(bridge)
    known.advertise(topic + "_known", INT32)
    live(known, topic + "_known")
    with outage(ros_master):
        operations = (
            {"op": "advertise", "topic": topic + "_out", "type": INT32},
            {"op": "publish", "topic": topic + "_unknown", "msg": {"data": 1}},
            {"op": "subscribe", "topic": topic + "_in", "type": INT32},
            {"op": "call_service", "service": topic + "_called", "args": []},
            {"op": "advertise_service", "service": topic + "_service", "type": ADD},
        )
        clients = [connect(bridge) for _ in operations]
        begin = time.monotonic()
        for each, operation in zip(clients, operations):
            each.send({"id": "x", **operation})
        known.publish(topic + "_known", {"data": 5})
        assert known.next_message(topic + "_known", timeout=0.5) == {"data": 5}
        for each in clients:
            status = each.wait_for(op="status", id="x", timeout=14)
            assert status["level"] == "error"
            assert "master" in status["msg"]
        response = clients[3].wait_for(op="service_response", id="x")
        assert response["result"] is False
        assert "master" in response["values"]
        assert time.monotonic() - begin < 13
        late = connect(bridge)
        late.subscribe(topic + "_known", INT32)
        known.publish(topic + "_known", {"data": 6})
        assert late.next_message(topic + "_known") == {"data": 6}
    wait_until(lambda: ros_master.publishers(topic + "_out") == ["/rosbridge_websocket"], 10.0, "the publisher")
    wait_until(lambda: ros_master.subscribers(topic + "_in") == ["/rosbridge_websocket"], 10.0, "the subscriber")
    wait_until(lambda: ros_master.providers(topic + "_service") == ["/rosbridge_websocket"], 10.0, "the service")
    peer = new_peer()
    peer.subscribe(topic + "_out", INT32)
    peer.wait_publishers(topic + "_out")
    clients[0].publish(topic + "_out", {"data": 1})
    assert peer.received(topic + "_out", 1) == [{"data": 1}]
    peer.advertise(topic + "_in", INT32, subscribers=1)
    peer.publish(topic + "_in", {"data": 2})
    assert clients[2].next_message(topic + "_in") == {"data": 2}
    call = peer.begin_call(topic + "_service", ADD, {"a": 1, "b": 2})
    clients[4].serve(topic + "_service", lambda args: (True, {"sum": 3}))
    assert call.result() == {"sum": 3}


def test_everything_is_registered_again_with_a_new_master(bridge: Bridge, connect, ros_master: RosMaster, new_peer):
    topic = fresh("again")
    client, listener, gone = connect(bridge), connect(bridge), bridge.connect()
    client.advertise(topic + "_out", INT32)
    client.advertise(topic + "_latched", INT32, latch=True)
    client.publish(topic + "_latched", {"data": 7})
    live(client, topic + "_in")
    live(listener, topic + "_out")
    client.advertise_service(topic + "_service", ADD)
    gone.advertise(topic + "_gone", INT32)
    gone.subscribe(topic + "_gone_in", INT32)
    gone.advertise_service(topic + "_gone_service", ADD)
    client.sync()
    gone.sync()
    with away(ros_master):
        gone.drop()
        client.publish(topic + "_out", {"data": 0})
        assert listener.next_message(topic + "_out") == {"data": 0}
    begin = time.monotonic()

    def registered() -> bool:
        return all(
            (
                ros_master.publishers(topic + "_out"),
                ros_master.publishers(topic + "_latched"),
                ros_master.subscribers(topic + "_in"),
                ros_master.subscribers(topic + "_out"),
                ros_master.providers(topic + "_service"),
                "/rosbridge_websocket" in ros_master.publishers("/rosout"),
                ros_master.publishers("/client_count"),
            )
        )

    wait_until(registered, 6.0, lambda: f"registrations, but {ros_master.call('getSystemState')}")
    assert time.monotonic() - begin < 6
    assert ["/rosbridge_websocket"] not in [ros_master.publishers(topic + "_gone")]
    assert [topic + "_out", INT32] in ros_master.call("getTopicTypes")
    peer = new_peer("newcomer")
    peer.subscribe(topic + "_out", INT32)
    peer.subscribe(topic + "_latched", INT32)
    assert peer.received(topic + "_latched", 1) == [{"data": 7}]
    peer.wait_publishers(topic + "_out")
    client.publish(topic + "_out", {"data": 1})
    assert peer.received(topic + "_out", 1) == [{"data": 1}]
    assert listener.messages(topic + "_out", 1) == [{"data": 1}]
    assert [each for each in listener.collect(0.2) if each["op"] == "publish"] == []  # it is not connected twice
    peer.advertise(topic + "_in", INT32, subscribers=1)
    peer.publish(topic + "_in", {"data": 2})
    assert client.next_message(topic + "_in") == {"data": 2}
    call = peer.begin_call(topic + "_service", ADD, {"a": 1, "b": 2})
    client.serve(topic + "_service", lambda args: (True, {"sum": 3}))
    assert call.result() == {"sum": 3}
    state = ros_master.call("getSystemState")
    assert [entry for kind in state for entry in kind if topic + "_gone" in entry[0]] == []
    client.sync()
    assert client.statuses("error") == []


def test_data_flows_on_without_a_master(bridge: Bridge, connect, client: Client, ros_master: RosMaster, new_peer):
    topic, peer = fresh("without"), new_peer("steadfast")
    peer.advertise(topic, INT32)
    peer.serve(topic + "_service", ADD)
    peer.subscribe(topic + "_out", INT32)
    live(client, topic)
    client.advertise(topic + "_out", INT32)
    client.sync()
    peer.wait_publishers(topic + "_out")
    assert client.call_service(topic + "_service", [1, 2])["values"] == {"sum": 3}
    with away(ros_master):
        peer.publish(topic, {"data": 1})
        assert client.next_message(topic) == {"data": 1}
        client.publish(topic + "_out", {"data": 2})
        assert peer.received(topic + "_out", 1) == [{"data": 2}]
        assert client.call_service(topic + "_service", [1, 2])["values"] == {"sum": 3}
