# SPDX-License-Identifier: BSD-3-Clause
"""The bridge under Foxglove clients: services."""

from __future__ import annotations

import json
import struct
import time
from typing import Any, Callable

import pytest

from support.bridge import Bridge
from support.client import Client
from support.foxglove import Foxglove
from support.node import Node, serve
from support.peer import Peer
from support.ros import RosMaster
from support.wait import wait_until

ADD = "rosbridge_library/AddTwoInts"


def pair(a: int, b: int) -> bytes:
    return struct.pack("<qq", a, b)


def test_a_service_tells_all_that_a_call_needs(foxglove: Foxglove, peer: Peer) -> None:
    peer.serve("/services/told", "std_srvs/SetBool", response={"success": True, "message": "done"})
    service = foxglove.service("/services/told")
    assert set(service) == {"id", "name", "type", "request", "response"}
    assert service["type"] == "std_srvs/SetBool"
    for half, fields in (("request", "bool data"), ("response", "bool success")):
        schema = service[half]
        assert (schema["encoding"], schema["schemaEncoding"]) == ("ros1", "ros1msg")
        assert schema["schemaName"] == f"std_srvs/SetBool_{half.capitalize()}"
        assert schema["schema"].startswith(fields)
    assert foxglove.call("/services/told", b"\x01") == b"\x01\x04\0\0\0done"
    assert json.loads(foxglove.call("/services/told", b'{"data": true}', "json")) == {
        "success": True,
        "message": "done",
    }
    peer.command("unserve", service="/services/told")


def test_services_come_and_go_and_keep_their_ids(foxglove: Foxglove, peer: Peer) -> None:
    name, ids = "/services/coming", []
    for kind in (ADD, "std_srvs/Empty", ADD):
        peer.serve(name, kind)
        ids.append(foxglove.service(name)["id"])
        assert foxglove.services[ids[-1]]["type"] == kind
        peer.command("unserve", service=name)
        foxglove.wait(lambda: ids[-1] not in foxglove.services, "its end")
    assert ids[0] == ids[2] != ids[1]
    number = foxglove.begin_call(ids[2], pair(1, 2))
    assert foxglove.failure(number) == f"there is no service {ids[2]}"


def test_a_client_of_rosbridge_provides_a_service_to_one_of_foxglove(
    foxglove: Foxglove, bridge: Bridge, connect: Callable[..., Client]
) -> None:
    name = "/services/by_client"
    provider = connect(bridge)
    provider.send({"op": "advertise_service", "service": name, "type": ADD})
    number = foxglove.begin_call(foxglove.service(name)["id"], pair(20, 3))
    call = provider.wait_for(op="call_service")
    answer = {"op": "service_response", "service": name, "id": call["id"], "result": True}
    provider.send({**answer, "values": {"sum": call["args"]["a"] + call["args"]["b"]}})
    foxglove.wait(lambda: number in foxglove.responses, "the response")
    assert foxglove.responses[number] == ("ros1", struct.pack("<q", 23))


@pytest.mark.parametrize(
    ("data", "encoding", "told"),
    [
        (b"", "ros1", "0 bytes are not a rosbridge_library/AddTwoIntsRequest message"),
        (b"\1" * 15, "ros1", "15 bytes are not a"),
        (b"\1" * 17, "ros1", "17 bytes are not a"),
        (b"", "json", "not JSON"),
        (b"{", "json", "not JSON"),
        (b"[1, 2]", "json", "must be an object"),
        (b'{"a": "one"}', "json", "for field 'a'"),
        (b'{"c": 1}', "json", "does not have a field c"),
        (b"\1" * 16, "cdr", "the encoding must be one of ros1, json, not 'cdr'"),
        (b"\1" * 16, "", "the encoding must be one of ros1, json, not ''"),
    ],
)
def test_a_request_that_is_none_fails_and_never_reaches_the_provider(
    foxglove: Foxglove, peer: Peer, data: bytes, encoding: str, told: str
) -> None:
    name = "/services/garbage"
    peer.serve(name)
    service = foxglove.service(name)["id"]
    reason = foxglove.failure(foxglove.begin_call(service, data, encoding))
    assert told.lower() in reason.lower()
    assert foxglove.told("serviceCallFailure")[0]["serviceId"] == service
    assert foxglove.call(name, pair(1, 2)) == struct.pack("<q", 3)
    assert peer.requested(name) == [{"a": 1, "b": 2}]
    peer.command("unserve", service=name)


@pytest.mark.parametrize(
    ("frame", "told"),
    [
        (struct.pack("<BIIH", 2, 5, 77, 1), "is too short"),
        (struct.pack("<BIII", 2, 5, 77, 100) + b"ros1", "ends before its encoding"),
        (struct.pack("<BIII", 2, 5, 77, 2**32 - 1) + b"ros1", "ends before its encoding"),
        (struct.pack("<BIII", 2, 5, 77, 2) + b"\xff\xff", "is not UTF-8"),
    ],
)
def test_a_frame_that_ends_too_soon_fails_the_call_that_it_names(foxglove: Foxglove, frame: bytes, told: str) -> None:
    foxglove.send_raw(frame)
    assert told in foxglove.failure(77)
    assert foxglove.told("serviceCallFailure")[0]["serviceId"] == 5
    assert not foxglove.statuses


def test_a_provider_that_fails_says_why(foxglove: Foxglove, peer: Peer) -> None:
    name = "/services/failing"
    peer.serve(name, behaviour="fail")
    for data, encoding in ((pair(1, 2), "ros1"), (b"{}", "json")):
        number = foxglove.begin_call(foxglove.service(name)["id"], data, encoding)
        assert "it failed, as asked" in foxglove.failure(number)
    peer.command("unserve", service=name)


def test_a_provider_that_dies_fails_the_call(
    foxglove: Foxglove, ros_master: RosMaster, nodes: Callable[[Node], Node]
) -> None:
    nodes(serve(ros_master, "/services/dying", ADD, behaviour="die", name="dying"))
    number = foxglove.begin_call(foxglove.service("/services/dying")["id"], pair(1, 2))
    assert "/services/dying" in foxglove.failure(number)
    ros_master.call("unregisterService", "/services/dying", ros_master.call("lookupService", "/services/dying"))


def test_a_slow_call_delays_nobody(foxglove: Foxglove, bridge: Bridge, peer: Peer) -> None:
    peer.serve("/services/slow", delay=2.0)
    peer.serve("/services/quick")
    other = Foxglove(bridge.url)
    try:
        other.service("/services/quick")
        number = foxglove.begin_call(foxglove.service("/services/slow")["id"], pair(1, 2))
        wait_until(lambda: peer.requested("/services/slow"), 5.0, "the slow call")
        foxglove.service("/services/quick")
        for client in (foxglove, other, foxglove):
            began = time.monotonic()
            assert client.call("/services/quick", pair(3, 4)) == struct.pack("<q", 7)
            client.get_parameters("/rosdistro")
            assert time.monotonic() - began < 1.0
        assert number not in foxglove.responses
        foxglove.wait(lambda: number in foxglove.responses, "the slow answer")
        assert foxglove.responses[number] == ("ros1", struct.pack("<q", 3))
    finally:
        other.close()


def test_many_calls_at_once_each_get_their_answer(foxglove: Foxglove, peer: Peer) -> None:
    peer.serve("/services/many", delay=0.01)
    service = foxglove.service("/services/many")["id"]
    numbers = [foxglove.begin_call(service, pair(number, 1000)) for number in range(50)]
    foxglove.wait(lambda: all(number in foxglove.responses for number in numbers), "the answers", 20)
    assert [struct.unpack("<q", foxglove.responses[number][1])[0] for number in numbers] == list(range(1000, 1050))


@pytest.mark.parametrize("behaviour", ["deaf"])
def test_an_unreachable_service_is_left_out_and_delays_no_other(
    ros_master: RosMaster,
    bridge: Bridge,
    connect_foxglove: Callable[..., Foxglove],
    nodes: Callable[[Node], Node],
    peer: Peer,
    behaviour: str,
) -> None:
    nodes(serve(ros_master, "/services/deaf", ADD, behaviour=behaviour, name="deaf"))
    ros_master.call("registerService", "/services/gone", "rosrpc://127.0.0.1:1", "http://127.0.0.1:1/")
    peer.serve("/services/beside")
    client = connect_foxglove(bridge)
    client.service("/services/beside", 3.0)
    assert not {"/services/deaf", "/services/gone"} & {service["name"] for service in client.services.values()}
    # Once there, it is found: providers that did not answer are asked again.
    peer.serve("/services/gone")
    client.service("/services/gone", 10.0)


def test_closed_services(
    start_bridge: Callable[..., Bridge], connect_foxglove: Callable[..., Foxglove], peer: Peer
) -> None:
    for name in ("/open/one", "/open/secret", "/closed/one"):
        peer.serve(name)
    server = start_bridge(
        {"service_whitelist": ["/open/...", "/closed/one"], "services_glob": "[/open/*]"}, name="with_service_whitelist"
    )
    client = connect_foxglove(server)
    client.service("/open/one")
    assert {service["name"] for service in client.services.values()} == {"/open/one"}
    client.send("subscribeConnectionGraph")
    client.wait(lambda: client.provided, "the graph")
    assert set(client.provided) == {"/open/one"}


def test_calls_end_with_their_client(bridge: Bridge, peer: Peer, nodes: Any) -> None:
    peer.serve("/services/left", delay=0.5)
    for _ in range(5):
        with Foxglove(bridge.url) as client:
            client.begin_call(client.service("/services/left")["id"], pair(1, 2))
    assert bridge.process.alive
