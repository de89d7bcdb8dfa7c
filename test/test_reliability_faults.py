# SPDX-License-Identifier: BSD-3-Clause
"""What fails around the bridge while it is at work: the master, publishers, services, and clients that provide some;
and its own end in the middle of it all.
"""

from __future__ import annotations

import contextlib
import itertools
import signal
import socket
import threading
import time
from typing import Any, Callable, Dict, List

import pytest

from support.bridge import Bridge
from support.client import Client
from support.effort import effort, figure
from support.link import Link
from support.node import Node, serve
from support.peer import CommandFailed, Peer
from support.ros import RosMaster
from support.usage import cpu_share, usage
from support.viewer import Viewer, sensors, subscription
from support.wait import wait_until

INT32, ADD = "std_msgs/Int32", "rosbridge_library/AddTwoInts"
IMAGE, STATE, MAP = subscription("/image", "cbor-raw"), subscription("/state"), subscription("/map", "cbor-raw")

Nodes = Callable[[Node], Node]
Start = Callable[..., Bridge]

_numbers = itertools.count(1)


def fresh(name: str) -> str:
    return f"/{name}_{next(_numbers)}"


# Services


@pytest.mark.parametrize("behaviour", ["hang", "deaf", "die", "fail"])
def test_a_service_that_fails_is_answered_and_costs_nothing_meanwhile(
    bridge: Bridge, connect: Callable[..., Client], ros_master: RosMaster, nodes: Nodes, behaviour: str
) -> None:
    service = fresh(behaviour)
    provider = nodes(serve(ros_master, service, behaviour=behaviour, name=behaviour))
    client = connect(bridge)
    timeout_s = 1.5
    begin = time.monotonic()
    call = client.request(service, {"a": 1, "b": 2}, timeout=timeout_s)
    if behaviour in ("hang", "deaf"):
        share = cpu_share(bridge.process.pid, 1.0)
        figure(f"a call pending at a service that is {behaviour}", cpu_percent=100 * share)
        assert share < 0.05
    response = client.wait_for(op="service_response", id=call)
    assert response["result"] is False
    assert response["values"]
    assert time.monotonic() - begin < timeout_s + 1.0
    assert [each for each in client.collect(0.2) if each["op"] == "service_response"] == [], "answered twice"
    provider.kill()


@pytest.mark.parametrize("end", ["drop", "close", "unadvertise"])
def test_a_client_that_leaves_in_the_middle_of_a_call_fails_it_at_once(
    bridge: Bridge, connect: Callable[..., Client], peer: Peer, ros_master: RosMaster, end: str
) -> None:
    service, provider = fresh("left"), connect(bridge)
    provider.advertise_service(service, ADD)
    wait_until(lambda: ros_master.providers(service))
    call = peer.begin_call(service, ADD, {"a": 1, "b": 2})
    provider.wait_for(op="call_service")
    begin = time.monotonic()
    if end == "unadvertise":
        provider.send({"op": "unadvertise_service", "service": service})
    else:
        getattr(provider, end)()
    with pytest.raises(CommandFailed, match=r"disconnected|taken it back"):
        call.result()
    assert time.monotonic() - begin < 1.0
    wait_until(lambda: ros_master.providers(service) == [], 5.0, "the end of the service")


def test_wrong_answers_of_a_client_end_the_call_they_are_for_and_no_other(
    bridge: Bridge, connect: Callable[..., Client], peer: Peer, ros_master: RosMaster
) -> None:
    """False, without values, twice, with values that don't fit, with somebody else's id, and then a right one."""
    service, provider, other = fresh("answers"), connect(bridge), connect(bridge)
    provider.advertise_service(service, ADD)
    wait_until(lambda: ros_master.providers(service))

    def answer(call: Dict[str, Any], **fields: Any) -> None:
        provider.send({"op": "service_response", "service": service, "id": call["id"], **fields})

    right = peer.begin_call(service, ADD, {"a": 1, "b": 2})
    wanted = provider.wait_for(op="call_service")
    other.send({"op": "service_response", "service": service, "id": wanted["id"], "result": True, "values": {"sum": 9}})
    other.wait_for(op="status", level="error")
    answer({"id": "of nobody"}, result=True, values={"sum": 9})
    provider.wait_for(op="status", level="error")
    for fields in (
        {"result": False, "values": "no"},
        {"result": False},
        {"result": True, "values": {"sum": "text"}},
        {"result": True, "values": {"nothing": 1}},
    ):
        wrong = peer.begin_call(service, ADD, {"a": 3, "b": 4})
        answer(provider.wait_for(op="call_service"), **fields)
        with pytest.raises(CommandFailed):
            wrong.result()
    answer(wanted, result=True, values={"sum": 3})
    assert right.result() == {"sum": 3}
    answer(wanted, result=True, values={"sum": 3})
    provider.wait_for(op="status", level="error", id=wanted["id"])


def test_a_client_that_stops_and_provides_a_service_costs_nothing(
    bridge: Bridge, connect: Callable[..., Client], peer: Peer, ros_master: RosMaster
) -> None:
    """It is there and says nothing. Its caller waits, as ROS has it; nobody else does."""
    service, provider = fresh("stopped"), connect(bridge)
    provider.advertise_service(service, ADD)
    wait_until(lambda: ros_master.providers(service))
    threads = usage(bridge.process.pid).threads
    calls = [peer.begin_call(service, ADD, {"a": 1, "b": number}) for number in range(10)]
    wanted = [provider.wait_for(op="call_service") for _ in calls]
    share = cpu_share(bridge.process.pid, 1.0)
    figure(
        "ten calls pending at a client",
        cpu_percent=100 * share,
        more_threads=usage(bridge.process.pid).threads - threads,
    )
    assert share < 0.05
    assert usage(bridge.process.pid).threads <= threads + 1
    quick = fresh("quick")
    peer.serve(quick)
    other = connect(bridge)
    assert other.call_service(quick, [1, 2])["values"] == {"sum": 3}
    for call in wanted:
        provider.send(
            {
                "op": "service_response",
                "service": service,
                "id": call["id"],
                "result": True,
                "values": {"sum": call["args"]["b"]},
            }
        )
    assert [call.result() for call in calls] == [{"sum": number} for number in range(10)]


# The master


@pytest.mark.allow_log("master at http")
def test_a_master_that_is_killed_and_restarted_three_times_under_load(
    start_bridge: Start, connect: Callable[..., Client], ros_master: RosMaster, nodes: Nodes, peer: Peer
) -> None:
    """What is connected flows on; what is registered is there again seconds after the master is."""
    nodes(sensors(ros_master, image_bytes=100_000))
    bridge = start_bridge(name="enduring")
    topic = fresh("enduring")
    with Viewer(ros_master, bridge.port, [IMAGE, STATE], connections=2) as viewer, bridge.connect() as client:
        viewer.sees("/image", "/state")
        client.advertise(topic, INT32)
        client.advertise_service(topic + "_service", ADD)
        client.subscribe(topic + "_in", INT32)
        client.sync()
        for round_ in range(3):
            ros_master.kill()
            view = viewer.watch(effort(0.8, 5.0))
            assert view.rate("/state") > 40
            assert view.rate("/image") > 20
            client.publish(topic, {"data": round_})
            client.sync()
            ros_master.restart()
            begin = time.monotonic()
            for found in (
                lambda: ros_master.publishers(topic),
                lambda: ros_master.providers(topic + "_service"),
                lambda: ros_master.subscribers(topic + "_in"),
                lambda: ros_master.subscribers("/state"),
            ):
                wait_until(
                    lambda found=found: "/enduring" in found(), 8.0, lambda: str(ros_master.call("getSystemState"))
                )
            figure(f"master restart {round_ + 1}", registered_again_after_s=time.monotonic() - begin)
        newcomer = Peer(ros_master, "newcomer")
        nodes(newcomer.node)
        newcomer.subscribe(topic, INT32)
        newcomer.wait_publishers(topic)
        client.publish(topic, {"data": 10})
        assert newcomer.received(topic, 1) == [{"data": 10}]
        newcomer.advertise(topic + "_in", INT32, subscribers=1)
        newcomer.publish(topic + "_in", {"data": 11})
        assert client.next_message(topic + "_in") == {"data": 11}
        assert viewer.closed == []


def test_a_publisher_that_is_killed_and_comes_back_with_another_type(
    bridge: Bridge, connect: Callable[..., Client], ros_master: RosMaster, nodes: Nodes
) -> None:
    topic, client = fresh("changing"), connect(bridge)
    client.subscribe(topic)
    for kind, message in ((INT32, {"data": 1}), ("std_msgs/String", {"data": "two"}), (INT32, {"data": 3})):
        mortal = Peer(ros_master, "mortal")
        nodes(mortal.node)
        mortal.advertise(topic, kind, subscribers=1)
        mortal.publish(topic, message)
        assert client.next_message(topic) == message
        mortal.node.kill()


def test_three_latched_publishers_and_a_late_client(
    bridge: Bridge, connect: Callable[..., Client], ros_master: RosMaster, nodes: Nodes
) -> None:
    topic, early = fresh("latched"), connect(bridge)
    early.subscribe(topic, INT32)
    for number in range(3):
        each = Peer(ros_master, f"latching{number}")
        nodes(each.node)
        each.advertise(topic, INT32, latch=True)
        each.publish(topic, {"data": number})
        assert early.next_message(topic) == {"data": number}
    late = connect(bridge)
    late.subscribe(topic, INT32)
    assert sorted(message["data"] for message in late.messages(topic, 3)) == [0, 1, 2]
    assert [each for each in late.collect(0.3) if each["op"] == "publish"] == []
    assert [each for each in early.collect(0.1) if each["op"] == "publish"] == []


# The end


def test_sigterm_under_load_with_stalled_clients(start_bridge: Start, ros_master: RosMaster, nodes: Nodes) -> None:
    nodes(sensors(ros_master, image_bytes=230_400, map_bytes=4_000_000))
    bridge = start_bridge(name="terminated")
    everything = [IMAGE, STATE, MAP]
    with contextlib.ExitStack() as stack:
        link = stack.enter_context(Link(bridge.port))
        well, sleeping = (stack.enter_context(Viewer(ros_master, bridge.port, everything, 3)) for _ in range(2))
        vanished = stack.enter_context(Viewer(ros_master, link.port, everything))
        for viewer in (well, sleeping, vanished):
            viewer.sees("/image", "/state", "/map")
        sleeping.stop()
        link.rate = 0
        calling = stack.enter_context(bridge.connect())
        nodes(serve(ros_master, "/hanging", behaviour="hang", name="hanging"))
        calling.request("/hanging", {"a": 1, "b": 2})
        calling.advertise_service("/terminated_service", ADD)
        calling.sync()
        well.watch(1.0)
        begin = time.monotonic()
        bridge.process.signal(signal.SIGTERM)
        assert bridge.process.wait(5.0) == 0
        took = time.monotonic() - begin
        figure("SIGTERM under load", gone_after_s=took)
        assert took < 3.0
    with socket.create_server(("127.0.0.1", bridge.port)):
        pass  # the port is free
    left: List[Any] = [
        entry for kind in ros_master.call("getSystemState") for entry in kind if "/terminated" in entry[1]
    ]
    assert left == []
    assert threading.active_count() < 50
