# SPDX-License-Identifier: BSD-3-Clause
"""Services through a running bridge: calls by clients, and services that clients provide; sections 3.4.6 to 3.4.9."""

from __future__ import annotations

import base64
import itertools
import time
from typing import Any, Dict, List

import pytest

from support.bridge import Bridge
from support.client import Client, defragment
from support.node import serve
from support.peer import CommandFailed, Peer
from support.ros import RosMaster
from support.wait import wait_until

_numbers = itertools.count(1)
ADD, EMPTY = "rosbridge_library/AddTwoInts", "std_srvs/Empty"


def fresh(name: str = "service") -> str:
    return f"/{name}_{next(_numbers)}"


@pytest.fixture(scope="module")
def add(peer: Peer) -> str:
    service = fresh("add")
    peer.serve(service, ADD)
    return service


@pytest.fixture
def client(bridge: Bridge, connect) -> Client:
    return connect(bridge)


def responses(client: Client) -> List[Dict[str, Any]]:
    """All service responses that have come, once the client's other operations are answered."""
    client.sync()
    return client.take(op="service_response")


# Calls


def test_args_are_an_object_or_a_list(client: Client, add: str):
    for args in ({"a": 2, "b": 3}, [2, 3]):
        response = client.call_service(add, args)
        assert response == {
            "op": "service_response", "service": add, "id": response["id"], "values": {"sum": 5}, "result": True
        }  # fmt: skip
    assert responses(client) == []


def test_a_response_without_id_to_a_call_without_id(client: Client, add: str):
    client.send({"op": "call_service", "service": add, "args": [1, 2]})
    assert client.wait_for(op="service_response") == {
        "op": "service_response", "service": add, "values": {"sum": 3}, "result": True
    }  # fmt: skip


@pytest.mark.parametrize("identifier", ["text", "", 0, 7, -1, 1.5, "ä😀"])
def test_the_id_is_echoed(client: Client, add: str, identifier: Any):
    client.send({"op": "call_service", "service": add, "args": [1, 2], "id": identifier})
    assert client.wait_for(op="service_response")["id"] == identifier


def test_the_service_is_echoed_as_it_was_written(client: Client, add: str):
    for name in (add, add[1:], add + "/", "/" + add):
        assert client.call_service(name, [1, 2])["service"] == name


def test_the_old_suffix_is_an_id(client: Client, add: str):
    client.send({"op": "call_service", "service": add + "#old", "args": [1, 2]})
    response = client.wait_for(op="service_response")
    assert response == {
        "op": "service_response", "service": add + "#old", "id": "old", "values": {"sum": 3}, "result": True
    }  # fmt: skip
    client.send({"op": "call_service", "service": add + "#old", "args": [1, 2], "id": "new"})
    assert client.wait_for(op="service_response")["id"] == "new"
    client.send({"op": "call_service", "service": "/no/such#old"})
    assert client.wait_for(op="service_response")["id"] == "old"


@pytest.mark.parametrize("args", [None, [], {}])
def test_no_args(client: Client, peer: Peer, args: Any):
    service = fresh("empty")
    peer.serve(service, EMPTY)
    client.send({"op": "call_service", "service": service, "id": "x", **({} if args is None else {"args": args})})
    response = client.wait_for(op="service_response")
    assert (response["values"], response["result"]) == ({}, True)


def test_fields_left_out_are_filled_with_a_warning(client: Client, add: str):
    client.set_level("warning")
    for args in ({"a": 5}, [5]):
        number = client.request(add, args)
        assert "b" in client.wait_for(op="status", level="warning", id=number)["msg"]
        assert client.wait_for(op="service_response", id=number)["values"] == {"sum": 5}


@pytest.mark.parametrize(
    "args",
    [{"a": 1, "b": 2, "c": 3}, [1, 2, 3], {"a": "x"}, ["x", 1], [[1], 2], {"a": 1.5}, {"a": 2**64}, {"a": None}],
)
def test_args_that_do_not_conform(client: Client, add: str, peer: Peer, args: Any):
    before = len(peer.requested(add))
    number = client.request(add, args)
    response = client.wait_for(op="service_response", id=number)
    assert response["result"] is False
    assert isinstance(response["values"], str)
    client.wait_for(op="status", level="error", id=number)
    assert responses(client) == []
    assert len(peer.requested(add)) == before


@pytest.mark.parametrize(
    "change",
    [
        {"service": None},
        {"service": 5},
        {"service": ""},
        {"service": "/no spaces"},
        {"service": ["x"]},
        {"args": "text"},
        {"args": 5},
        {"args": True},
        {"type": 5},
        {"timeout": "5"},
        {"timeout": -1},
        {"timeout": True},
        {"fragment_size": 0},
        {"fragment_size": "x"},
        {"compression": "zip"},
        {"compression": 5},
    ],
)
def test_a_malformed_call_gets_its_one_response(client: Client, add: str, change: Dict[str, Any]):
    client.send({"op": "call_service", "id": "bad", "service": add, "args": [1, 2], **change})
    response = client.wait_for(op="service_response", id="bad")
    assert response["result"] is False
    assert isinstance(response["values"], str)
    client.wait_for(op="status", level="error", id="bad")
    assert responses(client) == []


def test_a_service_that_does_not_exist(client: Client):
    service = fresh()
    response = client.call_service(service, {})
    assert response["result"] is False
    assert service in response["values"]
    client.wait_for(op="status", level="error", id=response["id"])
    assert responses(client) == []


def test_a_service_that_comes_after_a_failed_call(client: Client, peer: Peer):
    service = fresh()
    assert client.call_service(service, [1, 2])["result"] is False
    peer.serve(service, ADD)
    assert client.call_service(service, [1, 2])["values"] == {"sum": 3}


def test_a_service_that_moves_to_another_node_and_type(client: Client, peer: Peer, ros_master: RosMaster, nodes):
    service = fresh()
    peer.serve(service, ADD)
    assert client.call_service(service, [1, 2])["values"] == {"sum": 3}
    peer.command("unserve", service=service)
    nodes(serve(ros_master, service, "std_srvs/SetBool", {"success": True, "message": "moved"}, name="mover"))
    response = client.call_service(service, {"data": True})
    assert response["values"] == {"success": True, "message": "moved"}


def test_a_service_that_fails_says_why(client: Client, peer: Peer):
    service = fresh()
    peer.serve(service, ADD, behaviour="fail")
    response = client.call_service(service, [1, 2])
    assert response["result"] is False
    assert "it failed, as asked" in response["values"]
    client.wait_for(op="status", level="error", id=response["id"])
    assert responses(client) == []


def test_a_provider_that_dies_in_the_middle(client: Client, ros_master: RosMaster, nodes):
    service = fresh()
    node = nodes(serve(ros_master, service, behaviour="die", name="mortal"))
    response = client.call_service(service, [1, 2], wait=5)
    assert response["result"] is False
    assert service in response["values"]
    node.process.wait()
    dead = client.call_service(service, [1, 2], wait=5)  # still registered at the master
    assert dead["result"] is False
    assert service in dead["values"]


def test_a_timeout_of_the_call(client: Client, peer: Peer):
    service = fresh()
    peer.serve(service, ADD, delay=2.0)
    begin = time.monotonic()
    response = client.call_service(service, [1, 2], timeout=0.3)
    assert response["result"] is False
    assert "0.3 s" in response["values"]
    assert 0.25 < time.monotonic() - begin < 1.0
    assert client.collect(0.1)[0]["op"] == "status"


def test_the_default_timeout(start_bridge, connect, peer: Peer):
    bridge = start_bridge({"default_call_service_timeout": 0.3}, name="impatient")
    client, service = connect(bridge), fresh()
    peer.serve(service, ADD, delay=0.6)
    assert client.call_service(service, [1, 2])["result"] is False
    assert client.call_service(service, [1, 2], timeout=5)["values"] == {"sum": 3}
    assert client.call_service(service, [1, 2], timeout=0)["values"] == {"sum": 3}
    provided = fresh("thoughtful")  # a client may think for longer than the server's own calls may take
    client.advertise_service(provided, ADD)
    client.sync()
    call = peer.begin_call(provided, ADD, {"a": 1, "b": 2})
    request = client.wait_for(op="call_service")
    client.collect(0.5)
    client.send({"op": "service_response", "id": request["id"], "values": {"sum": 3}, "result": True})
    assert call.result() == {"sum": 3}


def test_dozens_of_slow_calls_delay_nothing(client: Client, connect, bridge: Bridge, peer: Peer, add: str):
    service = fresh("slow")
    peer.serve(service, ADD, delay=1.0)
    begin = time.monotonic()
    numbers = [client.request(service, [number, 0]) for number in range(50)]
    assert client.call_service(add, [1, 2])["values"] == {"sum": 3}
    other = connect(bridge)
    assert other.call_service(add, [1, 2])["values"] == {"sum": 3}
    client.set_level("info")
    subscription = client.subscribe(fresh("topic"), "std_msgs/String")
    client.wait_for(op="status", level="info", id=subscription)
    assert time.monotonic() - begin < 0.9
    for number, identifier in enumerate(numbers):
        assert client.wait_for(op="service_response", id=identifier)["values"] == {"sum": number}
    assert time.monotonic() - begin < 6


def test_png_and_fragments_and_cbor(client: Client, peer: Peer):
    service = fresh()
    peer.serve(service, "rosbridge_library/SendBytes", response={"data": "y" * 500})
    assert client.call_service(service, [1], compression="png")["values"] == {"data": "y" * 500}
    assert isinstance(client.frames[-1], str)
    assert client.call_service(service, [1], compression="cbor")["values"] == {"data": "y" * 500}
    assert isinstance(client.frames[-1], bytes)
    client.request(service, [1], fragment_size=100)
    first = client.wait_for(op="fragment")
    parts = [first] + [client.wait_for(op="fragment") for _ in range(first["total"] - 1)]
    assert max(len(part["data"]) for part in parts) == 100
    assert defragment(parts)["values"] == {"data": "y" * 500}


def test_a_call_that_is_pending_when_the_client_goes_leaves_nothing_behind(bridge: Bridge, connect, peer: Peer):
    service = fresh()
    peer.serve(service, ADD, delay=0.3)
    for _ in range(5):
        gone = bridge.connect()
        gone.request(service, [1, 2])
        gone.drop()
    other = connect(bridge)
    assert other.call_service(service, [1, 2])["values"] == {"sum": 3}


def test_arguments_with_times_and_bytes(client: Client, peer: Peer):
    service = fresh()
    peer.serve(service, "rosbridge_library/TestNestedService", response={"data": {"data": 2.5}})
    values = {"pose": {"position": {"x": 1, "y": 2, "z": 3}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}}
    assert client.call_service(service, values)["values"] == {"data": {"data": 2.5}}
    assert peer.requested(service)[0]["pose"]["position"] == {"x": 1.0, "y": 2.0, "z": 3.0}


# Services that clients provide


def test_a_node_calls_a_client(client: Client, peer: Peer):
    service = fresh("provided")
    client.set_level("info")
    number = client.advertise_service(service, ADD)
    client.wait_for(op="status", level="info", id=number)
    for a in range(3):
        call = peer.begin_call(service, ADD, {"a": a, "b": 1})
        request = client.wait_for(op="call_service")
        assert request == {
            "op": "call_service", "id": request["id"], "service": service, "args": {"a": a, "b": 1}
        }  # fmt: skip
        response = {"op": "service_response", "id": request["id"], "service": service, "values": {"sum": a + 1}}
        client.send({**response, "result": True}, cbor=a == 2)
        assert call.result() == {"sum": a + 1}


def test_a_client_calls_another_client_and_itself(bridge: Bridge, connect, client: Client):
    service, other = fresh("provided"), connect(bridge)
    client.advertise_service(service, ADD)
    client.sync()
    for caller in (other, client):
        number = caller.request(service, [2, 3])
        client.serve(service, lambda args: (True, {"sum": args["a"] + args["b"]}))
        assert caller.wait_for(op="service_response", id=number)["values"] == {"sum": 5}


def test_answers_in_any_order(client: Client, peer: Peer):
    service = fresh("provided")
    client.advertise_service(service, ADD)
    client.sync()
    calls = {a: peer.begin_call(service, ADD, {"a": a, "b": 0}) for a in range(10)}
    requests = [client.wait_for(op="call_service") for _ in calls]
    assert len({request["id"] for request in requests}) == 10
    for request in sorted(requests, key=lambda request: -request["args"]["a"]):
        values = {"sum": request["args"]["a"] * 2}
        client.send(
            {"op": "service_response", "id": request["id"], "service": service, "values": values, "result": True}
        )
    assert [call.result() for call in calls.values()] == [{"sum": a * 2} for a in calls]


@pytest.mark.parametrize(
    ("answer", "expected"),
    [
        ({"values": {"sum": 5}, "result": True}, {"sum": 5}),
        ({"values": {"sum": 5}, "result": False}, {"sum": 5}),  # as roslibpy does
        ({"values": {"sum": 5}}, {"sum": 5}),
        ({"values": [5], "result": True}, {"sum": 5}),
        ({"values": {}, "result": True}, {"sum": 0}),
        ({"result": True}, {"sum": 0}),
        ({"values": None, "result": True}, {"sum": 0}),
        ({"result": False}, "says it failed"),
        ({"values": None, "result": False}, "says it failed"),
        ({"values": "the arm is stuck", "result": False}, "the arm is stuck"),
        ({"values": {"sum": "text"}, "result": True}, "sum"),
        ({"values": {"other": 1}, "result": True}, "other"),
        ({"values": [1, 2], "result": True}, "fields"),
        ({"values": 7, "result": True}, "no valid response"),
        ({"values": {"sum": 1}, "result": "yes"}, {"sum": 1}),
        ({"values": True, "result": False}, "no valid response"),
    ],
)
def test_what_a_client_may_answer(client: Client, peer: Peer, answer: Dict[str, Any], expected: Any):
    """Whatever it is, the ROS caller gets an answer at once."""
    service = fresh("provided")
    client.advertise_service(service, ADD)
    client.sync()
    call = peer.begin_call(service, ADD, {"a": 1, "b": 2})
    request = client.wait_for(op="call_service")
    client.send({"op": "service_response", "id": request["id"], "service": service, **answer})
    if isinstance(expected, dict):
        assert call.result(5) == expected
    else:
        with pytest.raises(CommandFailed, match=expected):
            call.result(5)


def test_fields_left_out_of_a_response_are_filled_with_a_warning(client: Client, peer: Peer):
    service = fresh("provided")
    client.set_level("warning")
    client.advertise_service(service, "std_srvs/SetBool")
    client.sync()
    call = peer.begin_call(service, "std_srvs/SetBool", {"data": True})
    request = client.wait_for(op="call_service")
    client.send({"op": "service_response", "id": request["id"], "service": service, "values": {"success": True}})
    assert call.result() == {"success": True, "message": ""}
    assert "message" in client.wait_for(op="status", level="warning")["msg"]


@pytest.mark.parametrize(
    "answer",
    [{"id": "never asked"}, {"id": 5}, {}, {"id": None}, {"id": ["x"]}, {"id": {}}, {"id": "x", "service": 7}],
)
def test_an_answer_to_nothing_is_an_error(client: Client, answer: Dict[str, Any]):
    client.send({"op": "service_response", "service": "/x", "values": {}, "result": True, **answer})
    client.wait_for(op="status", level="error")


def test_a_second_answer_is_an_error(client: Client, peer: Peer):
    service = fresh("provided")
    client.advertise_service(service, ADD)
    client.sync()
    call = peer.begin_call(service, ADD, {"a": 1, "b": 2})
    request = client.wait_for(op="call_service")
    for _ in range(2):
        client.send(
            {"op": "service_response", "id": request["id"], "service": service, "values": {"sum": 3}, "result": True}
        )
    assert call.result() == {"sum": 3}
    client.wait_for(op="status", level="error", id=request["id"])


def test_another_client_can_not_answer(bridge: Bridge, connect, client: Client, peer: Peer):
    service, other = fresh("provided"), connect(bridge)
    client.advertise_service(service, ADD)
    client.sync()
    call = peer.begin_call(service, ADD, {"a": 1, "b": 2})
    request = client.wait_for(op="call_service")
    answer = {"op": "service_response", "id": request["id"], "service": service, "result": True}
    other.send({**answer, "values": {"sum": 666}})
    other.wait_for(op="status", level="error")
    client.send({**answer, "values": {"sum": 3}})
    assert call.result() == {"sum": 3}


@pytest.mark.parametrize("leave", ["drop", "close"])
def test_a_provider_that_disconnects_in_the_middle_of_a_call(
    bridge: Bridge, connect, peer: Peer, ros_master: RosMaster, leave: str
):
    service, client, caller = fresh("provided"), bridge.connect(), connect(bridge)
    client.advertise_service(service, ADD)
    client.sync()
    call = peer.begin_call(service, ADD, {"a": 1, "b": 2})
    number = caller.request(service, [1, 2])
    for _ in range(2):
        client.wait_for(op="call_service")
    getattr(client, leave)()
    with pytest.raises(CommandFailed, match="disconnected"):
        call.result(3)
    response = caller.wait_for(op="service_response", id=number, timeout=3)
    assert response["result"] is False
    assert "disconnected" in response["values"]
    wait_until(lambda: ros_master.providers(service) == [])


def test_unadvertise_in_the_middle_of_a_call(client: Client, peer: Peer, ros_master: RosMaster):
    service = fresh("provided")
    client.set_level("info")
    client.advertise_service(service, ADD)
    client.sync()
    call = peer.begin_call(service, ADD, {"a": 1, "b": 2})
    client.wait_for(op="call_service")
    client.send({"op": "unadvertise_service", "service": service, "id": "u"})
    client.wait_for(op="status", level="info", id="u")
    with pytest.raises(CommandFailed, match="taken it back"):
        call.result(3)
    wait_until(lambda: ros_master.providers(service) == [])


def test_unadvertise_of_what_was_not_advertised_warns(client: Client, add: str, peer: Peer):
    client.set_level("warning")
    for service in (fresh(), add):
        client.send({"op": "unadvertise_service", "service": service, "id": service})
        client.wait_for(op="status", level="warning", id=service)
    assert client.call_service(add, [1, 2])["result"] is True


def test_a_client_that_reconnects_takes_its_service_over(bridge: Bridge, connect, peer: Peer):
    """Before the old connection is known to be dead; its late end changes nothing."""
    service, old = fresh("provided"), bridge.connect()
    old.advertise_service(service, ADD)
    old.sync()
    pending = peer.begin_call(service, ADD, {"a": 9, "b": 9})
    old.wait_for(op="call_service")
    new = connect(bridge)
    new.advertise_service(service, ADD)
    new.sync()
    with pytest.raises(CommandFailed):
        pending.result(3)
    for end in (False, True):
        if end:
            old.drop()
            new.sync()
        call = peer.begin_call(service, ADD, {"a": 1, "b": 2})
        new.serve(service, lambda args: (True, {"sum": args["a"] + args["b"]}))
        assert call.result() == {"sum": 3}


def test_a_service_taken_over_with_another_type(bridge: Bridge, connect, client: Client, peer: Peer):
    service, other = fresh("provided"), connect(bridge)
    client.advertise_service(service, ADD)
    client.sync()
    other.advertise_service(service, "std_srvs/SetBool")
    other.sync()
    call = peer.begin_call(service, "std_srvs/SetBool", {"data": True})
    other.serve(service, lambda args: (True, {"success": args["data"], "message": "new"}))
    assert call.result() == {"success": True, "message": "new"}


def test_the_same_client_advertises_twice(client: Client, peer: Peer, ros_master: RosMaster):
    service = fresh("provided")
    client.advertise_service(service, ADD)
    client.advertise_service(service, ADD)
    client.sync()
    assert client.statuses() == []
    call = peer.begin_call(service, ADD, {"a": 1, "b": 2})
    client.serve(service, lambda args: (True, {"sum": 3}))
    assert call.result() == {"sum": 3}
    client.send({"op": "unadvertise_service", "service": service})
    wait_until(lambda: ros_master.providers(service) == [])


@pytest.mark.parametrize("kind", ["nonsense", "no_package/Type", "std_srvs/NoType", "", "std_msgs/String", 5, None])
def test_a_service_type_that_does_not_resolve(client: Client, ros_master: RosMaster, kind: Any):
    service = fresh("provided")
    client.send({"op": "advertise_service", "service": service, "type": kind, "id": "x"})
    client.wait_for(op="status", level="error", id="x")
    assert ros_master.providers(service) == []


@pytest.mark.parametrize("service", ["", "/", "/no spaces", 5, None, "/rosbridge_websocket/get_loggers"])
def test_a_service_name_that_is_no_good(client: Client, service: Any):
    client.send({"op": "advertise_service", "service": service, "type": ADD, "id": "x"})
    client.wait_for(op="status", level="error", id="x")


def test_bytes_go_to_a_providing_client_as_base64(client: Client, peer: Peer):
    service = fresh("provided")
    client.advertise_service(service, "rosbridge_library/SendBytes")
    client.sync()
    call = peer.begin_call(service, "rosbridge_library/SendBytes", {"count": 3})
    client.serve(service, lambda args: (True, {"data": base64.b64encode(bytes(args["count"])).decode()}))
    assert call.result() == {"data": "AAAA"}
