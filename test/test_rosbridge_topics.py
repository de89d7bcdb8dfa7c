# SPDX-License-Identifier: BSD-3-Clause
"""Topics through a running bridge: advertise, publish, subscribe and their wishes, section 3.4.1 to 3.4.5."""

from __future__ import annotations

import base64
import itertools
import math
import struct
import time
from typing import Any, Iterator, List

import cbor2
import pytest

from support.bridge import Bridge
from support.client import Client, defragment
from support.peer import Peer
from support.ros import RosMaster
from support.wait import wait_until

_numbers = itertools.count(1)
STRING, INT32 = "std_msgs/String", "std_msgs/Int32"


def fresh(name: str = "topic") -> str:
    return f"/{name}_{next(_numbers)}"


@pytest.fixture(scope="module")
def peers(ros_master: RosMaster) -> Iterator[List[Peer]]:
    found = [Peer(ros_master, f"peer{number}") for number in range(3)]
    yield found
    for peer in found:
        peer.node.interrupt()
    for peer in found:
        peer.node.stop()


@pytest.fixture(scope="module")
def peer(peers: List[Peer]) -> Peer:
    return peers[0]


def live(client: Client, topic: str, kind: Any = None, **options: Any) -> str:
    """Subscribe, and wait for the info status after which nothing is missed."""
    client.set_level("info")
    number = client.subscribe(topic, kind, **options)
    client.wait_for(op="status", level="info", id=number)
    return number


def published(client: Client, topic: str, seconds: float) -> List[Any]:
    return [each["msg"] for each in client.collect(seconds) if each.get("topic") == topic and each["op"] == "publish"]


# Subscribing


def test_nothing_is_missed_after_the_info_status(bridge: Bridge, connect, peer: Peer):
    client = connect(bridge)
    for _ in range(10):
        topic = fresh()
        peer.advertise(topic, INT32)
        live(client, topic, INT32)
        peer.publish(topic, *({"data": number} for number in range(5)))
        assert client.messages(topic, 5) == [{"data": number} for number in range(5)]


def test_a_type_is_inferred(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    peer.advertise(topic, INT32)
    live(client, topic)
    peer.publish(topic, {"data": 7})
    assert client.next_message(topic) == {"data": 7}


def test_the_topic_comes_back_as_the_client_wrote_it(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    peer.advertise(topic, INT32)
    live(client, topic[1:], INT32)
    peer.publish(topic, {"data": 7})
    assert client.wait_for(op="publish") == {"op": "publish", "topic": topic[1:], "msg": {"data": 7}}


def test_type_names_with_msg_in_them(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    peer.advertise(topic, INT32)
    live(client, topic, "std_msgs/msg/Int32")


def test_a_topic_that_does_not_exist_yet_follows(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    number = client.subscribe(topic)
    status = client.wait_for(op="status", id=number, level="error")
    assert topic in status["msg"]
    peer.advertise(topic, INT32, subscribers=1)
    peer.publish(topic, {"data": 1})
    assert client.next_message(topic) == {"data": 1}


def test_a_topic_that_does_not_exist_yet_but_whose_type_is_given_is_no_error(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    live(client, topic, INT32)
    assert client.statuses("error") == []
    peer.advertise(topic, INT32, subscribers=1)
    peer.publish(topic, {"data": 1})
    assert client.next_message(topic) == {"data": 1}


def test_a_given_type_that_does_not_resolve_is_an_error(bridge: Bridge, connect):
    client, topic = connect(bridge), fresh()
    for kind in ("nonsense", "no_package/Type", "std_msgs/NoType", "std_msgs/", "", "/"):
        number = client.subscribe(topic, kind)
        status = client.wait_for(op="status", id=number, level="error")
        assert kind in status["msg"]


def test_a_topic_of_another_type_is_an_error_that_names_both(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    peer.advertise(topic, INT32)
    number = client.subscribe(topic, STRING)
    status = client.wait_for(op="status", id=number, level="error")
    assert INT32 in status["msg"]
    assert STRING in status["msg"]
    assert topic in status["msg"]


def test_a_topic_that_comes_with_another_type_is_an_error(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    number = live(client, topic, STRING)
    peer.advertise(topic, INT32, subscribers=1)
    peer.publish(topic, {"data": 1}, {"data": 2})
    status = client.wait_for(op="status", level="error")
    assert status.get("id") == number
    assert INT32 in status["msg"]
    client.sync()
    assert client.take(op="publish") == []


def test_one_stream_for_several_subscriptions(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    peer.advertise(topic, INT32)
    first, second = live(client, topic, INT32), live(client, topic, INT32)
    peer.publish(topic, {"data": 1}, {"data": 2})
    assert published(client, topic, 0.3) == [{"data": 1}, {"data": 2}]
    client.send({"op": "unsubscribe", "topic": topic, "id": first})
    client.sync()
    peer.publish(topic, {"data": 3})
    assert client.next_message(topic) == {"data": 3}
    client.send({"op": "unsubscribe", "topic": topic, "id": second})
    client.sync()
    peer.publish(topic, {"data": 4})
    assert published(client, topic, 0.2) == []


def test_unsubscribe_without_id_takes_all_back(bridge: Bridge, connect, peer: Peer, ros_master: RosMaster):
    client, topic = connect(bridge), fresh()
    peer.advertise(topic, INT32)
    live(client, topic, INT32)
    live(client, topic, INT32)
    client.send({"op": "unsubscribe", "topic": topic})
    client.sync()
    peer.publish(topic, {"data": 4})
    assert published(client, topic, 0.2) == []
    wait_until(lambda: not ros_master.subscribers(topic))


def test_unsubscribe_by_an_unknown_id_changes_nothing(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    peer.advertise(topic, INT32)
    live(client, topic, INT32)
    client.send({"op": "unsubscribe", "topic": topic, "id": "another"})
    client.wait_for(op="status", level="warning", id="another")
    peer.publish(topic, {"data": 4})
    assert client.next_message(topic) == {"data": 4}


def test_unsubscribe_from_what_was_not_subscribed_warns(bridge: Bridge, connect):
    client = connect(bridge)
    client.set_level("warning")
    client.send({"op": "unsubscribe", "topic": "/never", "id": "x"})
    client.wait_for(op="status", level="warning", id="x")


def test_lowest_fragment_size_counts_and_unsubscribe_recalculates(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    peer.advertise(topic, STRING)
    live(client, topic, STRING, fragment_size=1000)
    small = live(client, topic, STRING, fragment_size=50)
    text = "ä" * 100
    peer.publish(topic, {"data": text})
    first = client.wait_for(op="fragment")
    parts = [first] + [client.wait_for(op="fragment", id=first["id"]) for _ in range(first["total"] - 1)]
    assert [part["num"] for part in parts] == list(range(first["total"]))
    assert max(len(part["data"]) for part in parts) == 50
    assert {type(part["id"]) for part in parts} == {str}
    assert defragment(parts) == {"op": "publish", "topic": topic, "msg": {"data": text}}
    client.send({"op": "unsubscribe", "topic": topic, "id": small})
    client.sync()
    peer.publish(topic, {"data": text})
    assert client.next_message(topic) == {"data": text}


def test_nothing_is_fragmented_that_nobody_asked_for(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    peer.advertise(topic, STRING)
    live(client, topic, STRING)
    peer.publish(topic, {"data": "x" * 5_000_000})
    assert client.next_message(topic) == {"data": "x" * 5_000_000}
    assert isinstance(client.frames[-1], str)


def test_throttle_sends_the_newest_when_the_interval_ends(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    peer.advertise(topic, INT32)
    live(client, topic, INT32, throttle_rate=400)
    begin = time.monotonic()
    peer.publish(topic, *({"data": number} for number in range(20)))
    assert client.next_message(topic) == {"data": 0}
    assert client.next_message(topic) == {"data": 19}
    assert 0.35 <= time.monotonic() - begin < 0.9
    assert published(client, topic, 0.5) == []


def test_throttle_with_a_queue_sends_in_order_and_drops_the_oldest(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    peer.advertise(topic, INT32)
    live(client, topic, INT32, throttle_rate=60, queue_length=5)
    peer.publish(topic, *({"data": number} for number in range(20)))
    arrived, times = [], []
    for _ in range(6):
        arrived.append(client.next_message(topic)["data"])
        times.append(time.monotonic())
    assert arrived == [0, 15, 16, 17, 18, 19]
    assert min(later - earlier for earlier, later in zip(times, times[1:])) > 0.03
    assert published(client, topic, 0.2) == []


def test_the_highest_queue_length_and_the_lowest_throttle_count(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    peer.advertise(topic, INT32)
    live(client, topic, INT32, throttle_rate=50, queue_length=1)
    live(client, topic, INT32, throttle_rate=10000, queue_length=4)
    peer.publish(topic, *({"data": number} for number in range(10)))
    assert [each["data"] for each in client.messages(topic, 5)] == [0, 6, 7, 8, 9]


def test_a_new_lower_throttle_counts_at_once(bridge: Bridge, connect, peer: Peer):
    """A message held back for a long interval goes when the new, short one ends."""
    client, topic = connect(bridge), fresh()
    peer.advertise(topic, INT32)
    live(client, topic, INT32, throttle_rate=60000)
    peer.publish(topic, {"data": 1}, {"data": 2})
    assert client.next_message(topic) == {"data": 1}
    live(client, topic, INT32, throttle_rate=100)
    assert client.next_message(topic, timeout=2.0) == {"data": 2}


def test_unsubscribe_by_id_raises_the_throttle_again(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    peer.advertise(topic, INT32)
    live(client, topic, INT32, throttle_rate=60000)
    fast = live(client, topic, INT32)
    peer.publish(topic, {"data": 1}, {"data": 2})
    assert [each["data"] for each in client.messages(topic, 2)] == [1, 2]
    client.send({"op": "unsubscribe", "topic": topic, "id": fast})
    client.sync()
    peer.publish(topic, {"data": 3}, {"data": 4}, {"data": 5})
    assert len(published(client, topic, 0.4)) <= 1


def test_a_subscription_without_throttle_releases_what_is_held(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    peer.advertise(topic, INT32)
    live(client, topic, INT32, throttle_rate=60000, queue_length=10)
    peer.publish(topic, {"data": 1}, {"data": 2}, {"data": 3})
    assert client.next_message(topic) == {"data": 1}
    live(client, topic, INT32)
    assert [each["data"] for each in client.messages(topic, 2)] == [2, 3]


def test_subscribing_again_with_the_same_id_changes_the_wishes(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    peer.advertise(topic, INT32)
    for options in ({"throttle_rate": 60000}, {"throttle_rate": 0}):
        client.send({"op": "subscribe", "id": "same", "topic": topic, "type": INT32, **options})
    client.sync()
    peer.wait_connected(topic)
    peer.publish(topic, {"data": 1}, {"data": 2}, {"data": 3})
    assert [each["data"] for each in client.messages(topic, 3)] == [1, 2, 3]
    client.send({"op": "unsubscribe", "id": "same", "topic": topic})
    client.sync()
    peer.publish(topic, {"data": 4})
    assert published(client, topic, 0.2) == []


# Encodings


def test_every_encoding_of_one_topic_at_once(bridge: Bridge, connect, peer: Peer):
    topic = fresh()
    peer.advertise(topic, INT32)
    clients = {name: connect(bridge) for name in ("none", "png", "cbor", "cbor-raw")}
    for name, client in clients.items():
        live(client, topic, INT32, compression=name)
    before = time.time()
    peer.publish(topic, {"data": -5})
    for name in ("none", "png", "cbor"):
        assert clients[name].wait_for(op="publish") == {"op": "publish", "topic": topic, "msg": {"data": -5}}
    raw = clients["cbor-raw"].wait_for(op="publish", topic=topic)["msg"]
    assert set(raw) == {"secs", "nsecs", "bytes"}
    assert raw["bytes"] == struct.pack("<i", -5)
    assert abs(raw["secs"] + raw["nsecs"] / 1e9 - before) < 5
    frames = {name: client.frames[-1] for name, client in clients.items()}
    assert {name: type(frame) for name, frame in frames.items()} == {
        "none": str, "png": str, "cbor": bytes, "cbor-raw": bytes
    }  # fmt: skip
    assert '"op":"png"' in frames["png"].replace(" ", "")


def test_png_in_fragments(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    peer.advertise(topic, STRING)
    live(client, topic, STRING, compression="png", fragment_size=64)
    text = "".join(str(number) for number in range(500))
    peer.publish(topic, {"data": text})
    first = client.wait_for(op="fragment")
    parts = [first] + [client.wait_for(op="fragment") for _ in range(first["total"] - 1)]
    assert defragment(parts)["msg"] == {"data": text}


def test_cbor_typed_arrays(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    peer.advertise(topic, "std_msgs/Float32MultiArray")
    live(client, topic, compression="cbor")
    peer.publish(topic, {"data": [1.5, -2.5]})
    tagged = client.next_message(topic)["data"]
    assert isinstance(tagged, cbor2.CBORTag)
    assert (tagged.tag, tagged.value) == (85, struct.pack("<2f", 1.5, -2.5))


def test_bytes_are_base64_in_json_and_bytes_in_cbor(bridge: Bridge, connect, peer: Peer):
    topic = fresh()
    peer.advertise(topic, "rosbridge_library/TestUInt8")
    text, binary = connect(bridge), connect(bridge)
    live(text, topic)
    live(binary, topic, compression="cbor")
    peer.publish(topic, {"data": [0, 1, 255]})
    assert text.next_message(topic) == {"data": base64.b64encode(b"\x00\x01\xff").decode()}
    assert binary.next_message(topic) == {"data": b"\x00\x01\xff"}


def test_nan_and_infinity_are_null(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    peer.subscribe(topic, "std_msgs/Float64")
    client.subscribe(topic, "std_msgs/Float64")
    client.advertise(topic, "std_msgs/Float64")
    for value in ("NaN", "Infinity", "-Infinity", "null", "1.5"):
        client.send_frame('{"op":"publish","topic":"%s","msg":{"data":%s}}' % (topic, value))
    values = [each["data"] for each in peer.received(topic, 5)]
    assert math.isnan(values[0])
    assert values[1:3] == [math.inf, -math.inf]
    assert math.isnan(values[3])
    assert [each["data"] for each in client.messages(topic, 5)] == [None, None, None, None, 1.5]


def test_a_wish_that_makes_no_sense_is_an_error(bridge: Bridge, connect):
    client, topic = connect(bridge), fresh()
    for wish in (
        {"compression": "zip"},
        {"compression": 5},
        {"compression": ["png"]},
        {"throttle_rate": -1},
        {"throttle_rate": "5"},
        {"throttle_rate": True},
        {"queue_length": -1},
        {"queue_length": 1.5},
        {"fragment_size": 0},
        {"fragment_size": -3},
        {"fragment_size": "x"},
        {"type": 7},
        {"topic": 7},
        {"topic": None},
        {"topic": ""},
        {"topic": "/"},
        {"topic": "/no spaces"},
        {"topic": "/ünicode"},
        {"topic": ["/x"]},
    ):
        number = client.subscribe(**{"topic": topic, "kind": INT32, **{k: v for k, v in wish.items() if k != "type"}})
        if "type" in wish:
            number = "typed"
            client.send({"op": "subscribe", "topic": topic, "id": number, **wish})
        client.wait_for(op="status", level="error", id=number)


def test_extreme_wishes_are_taken_or_refused_but_break_nothing(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    client.set_level("info")
    peer.advertise(topic, INT32)
    for wish in (
        {"queue_length": 2**63},
        {"queue_length": 2**64 - 1},
        {"throttle_rate": 1e300, "queue_length": 3},
        {"throttle_rate": 2**64 - 1},
        {"fragment_size": 2**64 - 1},
    ):
        live(client, topic, INT32, **wish)
    client.send_frame('{"op":"subscribe","id":"inf","topic":"%s","throttle_rate":Infinity}' % topic)
    client.wait_for(op="status", level="error", id="inf")
    client.send_frame('{"op":"subscribe","id":"nan","topic":"%s","throttle_rate":NaN}' % topic)
    client.wait_for(op="status", level="error", id="nan")
    live(client, topic, INT32)
    peer.publish(topic, {"data": 1})
    assert client.next_message(topic) == {"data": 1}


# Latched topics


def test_a_late_client_gets_each_latching_publishers_message_once(bridge: Bridge, connect, peers: List[Peer]):
    topic = fresh("latched")
    early = connect(bridge)
    live(early, topic, INT32)
    for number, each in enumerate(peers):
        each.advertise(topic, INT32, latch=True, subscribers=1)
        each.publish(topic, {"data": number})
    assert sorted(each["data"] for each in early.messages(topic, 3)) == [0, 1, 2]
    late = connect(bridge)
    live(late, topic, INT32)
    assert sorted(each["data"] for each in published(late, topic, 0.3)) == [0, 1, 2]
    assert published(early, topic, 0.1) == []
    peers[0].publish(topic, {"data": 10})
    assert late.next_message(topic) == {"data": 10}
    assert early.next_message(topic) == {"data": 10}
    latest = connect(bridge)
    live(latest, topic, INT32, throttle_rate=60000)  # a throttle may hold back no latched message
    assert sorted(each["data"] for each in published(latest, topic, 0.3)) == [1, 2, 10]


def test_a_first_client_gets_latched_messages_in_spite_of_a_throttle(bridge: Bridge, connect, peers: List[Peer]):
    topic = fresh("latched")
    for number, each in enumerate(peers):
        each.advertise(topic, INT32, latch=True)
        each.publish(topic, {"data": number})
    client = connect(bridge)
    live(client, topic, INT32, throttle_rate=60000)
    assert sorted(each["data"] for each in client.messages(topic, 3)) == [0, 1, 2]


def test_a_latching_publisher_that_has_gone_is_forgotten(bridge: Bridge, connect, peers: List[Peer]):
    topic = fresh("latched")
    early = connect(bridge)
    for number, each in enumerate(peers[:2]):
        each.advertise(topic, INT32, latch=True)
        each.publish(topic, {"data": number})
    live(early, topic, INT32)
    early.messages(topic, 2)
    peers[0].unadvertise(topic)

    def only_one() -> bool:
        with bridge.connect() as late:
            live(late, topic, INT32)
            return published(late, topic, 0.1) == [{"data": 1}]

    wait_until(only_one)


def test_a_second_subscription_of_a_client_gets_the_latched_message_too(bridge: Bridge, connect, peer: Peer):
    """A part of a page that comes later subscribes with an id of its own, and waits for the map."""
    topic = fresh("latched")
    client, other = connect(bridge), connect(bridge)
    peer.advertise(topic, INT32, latch=True)
    peer.publish(topic, {"data": 5})
    for each in (client, other):
        live(each, topic, INT32)
        assert each.next_message(topic) == {"data": 5}
    live(client, topic, INT32)
    assert published(client, topic, 0.3) == [{"data": 5}]
    assert published(other, topic, 0.1) == []


def test_clients_latch_too(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh("latched")
    client.advertise(topic, INT32, latch=True)
    client.publish(topic, {"data": 1})
    client.publish(topic, {"data": 2})
    client.sync()
    peer.subscribe(topic, INT32)
    assert peer.received(topic, 1) == [{"data": 2}]
    late = connect(bridge)
    live(late, topic, INT32)
    assert published(late, topic, 0.3) == [{"data": 2}]


# Types that aren't installed here, and types that change

DEFINITION = (
    "Part part\nuint8 LIMIT=3\nfloat32[] ranges\nstring name\n" + "=" * 80 + "\nMSG: {0}/Part\nint32 x\ntime at\n"
)


@pytest.mark.parametrize("compression", ["none", "cbor", "png", "cbor-raw"])
def test_a_type_that_is_not_installed(bridge: Bridge, connect, peer: Peer, compression: str):
    client, topic = connect(bridge), fresh()
    peer.advertise(topic, "nowhere_msgs/Whole", definition=DEFINITION.format("nowhere_msgs"))
    live(client, topic, compression=compression)
    assert client.statuses("error") == []
    peer.publish(topic, {"part": {"x": 3, "at": {"secs": 4, "nsecs": 5}}, "ranges": [1.5], "name": "n"})
    message = client.next_message(topic)
    if compression == "cbor-raw":
        assert message["bytes"] == struct.pack("<iIIIfI1s", 3, 4, 5, 1, 1.5, 1, b"n")
        return
    assert message["part"] == {"x": 3, "at": {"secs": 4, "nsecs": 5}}
    assert message["name"] == "n"
    if compression != "cbor":
        assert message["ranges"] == [1.5]


def test_a_type_that_is_not_installed_may_be_named(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    peer.advertise(topic, "nowhere_msgs/Whole", definition=DEFINITION.format("nowhere_msgs"))
    live(client, topic, "nowhere_msgs/Whole")
    assert client.statuses("error") == []
    peer.publish(topic, {"name": "n"})
    assert client.next_message(topic)["name"] == "n"


@pytest.mark.parametrize("kind", [STRING, "changed_msgs/Thing"])
def test_a_publisher_that_comes_back_with_another_type_or_definition(bridge: Bridge, connect, peers, kind: str):
    client, topic = connect(bridge), fresh()
    first, second = peers[:2]
    first.advertise(topic, "changed_msgs/Thing", definition="int32 data\n")
    live(client, topic)
    first.publish(topic, {"data": 1})
    assert client.next_message(topic) == {"data": 1}
    first.unadvertise(topic)
    second.advertise(topic, kind, definition=None if kind == STRING else "string data\n", subscribers=1)
    second.publish(topic, {"data": "two"})
    assert client.next_message(topic) == {"data": "two"}
    late = connect(bridge)
    live(late, topic)
    second.publish(topic, {"data": "three"})
    assert late.next_message(topic) == {"data": "three"}


# Advertising and publishing


def test_the_first_message_after_advertise_reaches_who_was_there_before(bridge: Bridge, connect, peer: Peer):
    topics = [fresh("first") for _ in range(20)]
    for topic in topics:
        peer.subscribe(topic, INT32)
    client = connect(bridge)
    for topic in topics:
        client.advertise(topic, INT32)
        client.publish(topic, {"data": 1})
        client.publish(topic, {"data": 2})
    for topic in topics:
        assert peer.received(topic, 2) == [{"data": 1}, {"data": 2}]
    assert client.statuses() == []


def test_the_first_message_reaches_another_client_that_was_there_before(bridge: Bridge, connect):
    client, listener = connect(bridge), connect(bridge)
    for _ in range(20):
        topic = fresh("first")
        live(listener, topic, INT32)
        client.advertise(topic, INT32)
        client.publish(topic, {"data": 1})
        assert listener.next_message(topic) == {"data": 1}


def test_the_first_message_of_a_publish_without_advertise_gets_there_too(bridge: Bridge, connect, peer: Peer):
    client = connect(bridge)
    for _ in range(5):
        topic = fresh("first")
        peer.subscribe(topic, INT32)
        client.publish(topic, {"data": 1})
        assert peer.received(topic, 1) == [{"data": 1}]
    assert client.statuses() == []


def test_publish_without_advertise_on_a_topic_that_only_a_client_subscribed(bridge: Bridge, connect):
    client, listener, topic = connect(bridge), connect(bridge), fresh()
    live(listener, topic, INT32)
    client.publish(topic, {"data": 1})
    assert listener.next_message(topic) == {"data": 1}
    client.sync()
    assert client.statuses() == []


def test_a_page_that_is_refreshed_loses_nothing(bridge: Bridge, connect, peer: Peer):
    topic = fresh("refreshed")
    peer.subscribe(topic, INT32)
    for number in range(5):
        with bridge.connect() as client:
            client.advertise(topic, INT32)
            client.publish(topic, {"data": number})
            if number % 2:
                client.sync()
            else:
                peer.received(topic, number + 1)
    assert peer.received(topic, 5) == [{"data": number} for number in range(5)]


def test_what_was_published_right_before_the_end_of_the_connection_is_not_lost(bridge: Bridge, connect, peer: Peer):
    topic = fresh("hasty")
    peer.subscribe(topic, INT32)
    for number in range(5):
        client = bridge.connect()
        client.advertise(topic, INT32)
        client.publish(topic, {"data": number})
        client.close()
    assert sorted(each["data"] for each in peer.received(topic, 5)) == list(range(5))


def test_header_seq_counts_up_whatever_the_client_sends(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh("seq")
    peer.subscribe(topic, "std_msgs/Header")
    peer.subscribe(topic + "_nested", "geometry_msgs/PoseStamped")
    client.set_level("warning")
    client.advertise(topic + "_nested", "geometry_msgs/PoseStamped")
    pose = {"position": {"x": 1, "y": 2, "z": 3}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
    before = time.time()
    client.publish(topic + "_nested", {"pose": pose})
    client.publish(topic + "_nested", {"header": {"seq": 99, "frame_id": "map"}, "pose": pose})
    client.publish(topic + "_nested", {"header": {"stamp": {"secs": 5, "nsecs": 6}}, "pose": pose})
    client.publish(topic + "_nested", {"header": {"stamp": "now", "frame_id": "map", "seq": 1}, "pose": pose})
    headers = [each["header"] for each in peer.received(topic + "_nested", 4)]
    first = headers[0]["seq"]
    assert [each["seq"] for each in headers] == [first, first + 1, first + 2, first + 3]
    assert [each["frame_id"] for each in headers] == ["", "map", "", "map"]
    assert headers[2]["stamp"] == {"secs": 5, "nsecs": 6}
    for number in (0, 1, 3):
        assert abs(headers[number]["stamp"]["secs"] - before) < 5


def test_an_omitted_header_is_no_reason_for_a_warning(bridge: Bridge, connect):
    client, topic = connect(bridge), fresh()
    client.set_level("warning")
    client.advertise(topic, "geometry_msgs/PointStamped")
    for header in ({}, {"header": {"frame_id": "map"}}, {"header": {"frame_id": "map", "stamp": "now"}}):
        client.publish(topic, {"point": {"x": 1, "y": 2, "z": 3}, **header})
    client.sync()
    assert client.statuses() == []


def test_fields_left_out_are_filled_with_a_warning(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    peer.subscribe(topic, "geometry_msgs/Twist")
    client.set_level("warning")
    client.advertise(topic, "geometry_msgs/Twist")
    number = client.publish(topic, {"linear": {"x": 1}})
    status = client.wait_for(op="status", level="warning", id=number)
    assert "linear.y" in status["msg"]
    assert "angular" in status["msg"]
    zero = {"x": 0.0, "y": 0.0, "z": 0.0}
    assert peer.received(topic, 1) == [{"linear": {"x": 1.0, "y": 0.0, "z": 0.0}, "angular": zero}]


@pytest.mark.parametrize(
    "message",
    [
        {"data": "text"},
        {"data": 1.5},
        {"data": True},
        {"data": 2**31},
        {"data": None},
        {"data": [1]},
        {"data": {}},
        {"data": 1, "extra": 2},
        {"other": 1},
        [1],
        "text",
        5,
    ],
)
def test_a_message_that_does_not_conform_is_dropped_with_an_error(bridge: Bridge, connect, peer: Peer, message: Any):
    client, topic = connect(bridge), fresh()
    peer.subscribe(topic, INT32)
    client.advertise(topic, INT32)
    number = client.publish(topic, message)
    client.wait_for(op="status", level="error", id=number)
    client.publish(topic, {"data": 42})
    assert peer.received(topic, 1) == [{"data": 42}]


def test_a_topic_that_the_bridge_itself_publishes_is_there_at_once(start_bridge, connect, peer: Peer):
    speaking = start_bridge(name="speaking")
    client = connect(speaking)
    peer.subscribe("/rosout", "rosgraph_msgs/Log")

    def is_heard() -> bool:
        connect(speaking).close()  # which it logs
        return any(log["name"] == "/speaking" for log in peer.received("/rosout"))

    wait_until(is_heard)
    begin = time.monotonic()
    client.publish("/rosout", {"level": 2, "name": "/page", "msg": "from a client"})
    client.sync()
    assert time.monotonic() - begin < 2.0
    wait_until(lambda: any(log["msg"] == "from a client" for log in peer.received("/rosout")))
    assert client.statuses("error") == []


def test_publishing_on_a_topic_that_does_not_exist_is_an_error(bridge: Bridge, connect, ros_master: RosMaster):
    client, topic = connect(bridge), fresh()
    number = client.publish(topic, {"data": 1})
    status = client.wait_for(op="status", level="error", id=number)
    assert topic in status["msg"]
    assert ros_master.publishers(topic) == []


def test_advertise_with_a_type_that_does_not_resolve_is_an_error(bridge: Bridge, connect, ros_master: RosMaster):
    client, topic = connect(bridge), fresh()
    for kind in ("nonsense", "no_package/Type", "std_msgs/NoType", "", "a/b/c", "../x", "std_msgs/String\n"):
        number = client.advertise(topic, kind)
        client.wait_for(op="status", level="error", id=number)
    assert ros_master.publishers(topic) == []


def test_advertise_of_a_topic_with_another_type_is_an_error(bridge: Bridge, connect, peer: Peer, ros_master):
    client, topic = connect(bridge), fresh()
    peer.advertise(topic, INT32)
    number = client.advertise(topic, STRING)
    status = client.wait_for(op="status", level="error", id=number)
    assert all(word in status["msg"] for word in (topic, INT32, STRING))
    assert ros_master.publishers(topic) == ["/peer0"]
    other = connect(bridge)
    other.advertise(topic + "_own", INT32)
    other.sync()
    number = client.advertise(topic + "_own", STRING)
    client.wait_for(op="status", level="error", id=number)


def test_of_two_clients_that_advertise_two_types_at_once_one_is_refused(bridge: Bridge, connect):
    one, two = connect(bridge), connect(bridge)
    for _ in range(20):
        topic = fresh("race")
        first, second = one.advertise(topic, INT32), two.advertise(topic, STRING)
        one.sync()
        two.sync()
        errors = one.take(op="status", id=first) + two.take(op="status", id=second)
        assert len(errors) == 1


def test_a_topic_can_be_advertised_as_another_type_when_nobody_uses_it_any_more(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    client.advertise(topic, INT32)
    client.publish(topic, {"data": 1})
    client.send({"op": "unadvertise", "topic": topic})
    client.advertise(topic, STRING)
    client.sync()
    assert client.statuses() == []
    peer.subscribe(topic, STRING)
    peer.wait_publishers(topic)
    client.publish(topic, {"data": "text"})
    assert peer.received(topic, 1) == [{"data": "text"}]


def test_unadvertise_of_what_was_not_advertised_warns(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    client.set_level("warning")
    client.send({"op": "unadvertise", "topic": topic, "id": "none"})
    client.wait_for(op="status", level="warning", id="none")
    peer.advertise(topic, INT32)
    client.send({"op": "unadvertise", "topic": topic, "id": "not ours"})
    client.wait_for(op="status", level="warning", id="not ours")


def test_successes_are_told_at_level_info_with_their_id(bridge: Bridge, connect):
    client, topic = connect(bridge), fresh()
    client.set_level("info")
    for op in ("advertise", "subscribe", "unsubscribe", "unadvertise"):
        client.send({"op": op, "topic": topic, "type": INT32, "id": "one"})
        status = client.wait_for(op="status", level="info", id="one")
        assert status["msg"].startswith(op)


def test_two_ids_keep_a_topic_advertised_until_both_are_gone(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    client.set_level("warning")
    first, second = client.advertise(topic, INT32), client.advertise(topic, INT32)
    for number in (first, first, second, second):
        client.send({"op": "unadvertise", "topic": topic, "id": number})
    client.sync()
    assert len(client.statuses("warning")) == 2


def test_a_topic_stays_advertised_while_another_client_does(start_bridge, connect, ros_master: RosMaster, peer: Peer):
    bridge = start_bridge({"unregister_timeout": 0.3}, name="short_lived")
    topic = fresh()
    one, two = connect(bridge), connect(bridge)
    one.advertise(topic, INT32)
    two.advertise(topic, INT32)
    one.sync()
    two.sync()
    one.close()
    peer.subscribe(topic, INT32)
    peer.wait_publishers(topic)
    end = time.monotonic() + 0.6
    number = 0
    while time.monotonic() < end:
        two.publish(topic, {"data": number})
        number += 1
        two.sync()
    assert peer.received(topic, number) == [{"data": each} for each in range(number)]
    two.close()
    wait_until(lambda: ros_master.publishers(topic) == [], 3.0, "the end of the publisher")


def test_publish_fields_latch_and_queue_size(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    live(client, topic, INT32)
    client.publish(topic, {"data": 3}, latch=True, queue_size=5)
    assert client.next_message(topic) == {"data": 3}
    peer.subscribe(topic, INT32)
    assert peer.received(topic, 1) == [{"data": 3}]


def test_a_latch_that_comes_too_late_warns(bridge: Bridge, connect):
    """The publisher is shared: it latches as the first client said."""
    one, two, topic = connect(bridge), connect(bridge), fresh()
    one.advertise(topic, INT32)
    one.sync()
    two.set_level("warning")
    number = two.advertise(topic, INT32, latch=True)
    two.wait_for(op="status", level="warning", id=number)


@pytest.mark.parametrize(
    "wish", [{"latch": 1}, {"latch": "yes"}, {"queue_size": "5"}, {"queue_size": -1}, {"queue_size": 1.5}, {"type": 5}]
)
def test_advertise_fields_of_the_wrong_type_are_errors(bridge: Bridge, connect, wish):
    client, topic = connect(bridge), fresh()
    client.send({"op": "advertise", "topic": topic, "type": INT32, "id": "x", **wish})
    client.wait_for(op="status", level="error", id="x")


@pytest.mark.parametrize("size", [0, 1, 2**31, 2**64 - 1])
def test_any_queue_size(bridge: Bridge, connect, peer: Peer, size: int):
    client, topic = connect(bridge), fresh()
    peer.subscribe(topic, INT32)
    client.advertise(topic, INT32, queue_size=size)
    client.publish(topic, {"data": 3})
    assert peer.received(topic, 1) == [{"data": 3}]
    client.sync()
    assert client.statuses() == []


def test_unknown_fields_of_operations_are_tolerated(bridge: Bridge, connect, peer: Peer):
    client, topic = connect(bridge), fresh()
    peer.subscribe(topic, INT32)
    client.advertise(topic, INT32, colour="red", latch=None, queue_size=None)
    client.publish(topic, {"data": 3}, colour=["red"])
    assert peer.received(topic, 1) == [{"data": 3}]
    live(client, topic, INT32, colour={}, throttle_rate=None, queue_length=None, fragment_size=None, compression=None)


def test_finish_leaves_nothing_behind(start_bridge, connect, ros_master: RosMaster):
    bridge = start_bridge({"unregister_timeout": 0.1}, name="clean")
    topic = fresh("left")

    def traces() -> List[Any]:
        state = ros_master.call("getSystemState")
        return [entry for kind in state for entry in kind if topic in entry[0] and "/clean" in entry[1]]

    client = connect(bridge)
    client.advertise(topic, INT32)
    live(client, topic + "_in", INT32)
    client.advertise_service(topic + "_service", "std_srvs/Empty")
    client.sync()
    wait_until(lambda: len(traces()) == 3)
    client.drop()
    wait_until(lambda: traces() == [], 5.0, lambda: f"no traces but {traces()}")


def test_clients_that_leave_in_the_middle_of_an_operation_leave_nothing_behind(start_bridge, ros_master: RosMaster):
    bridge = start_bridge({"unregister_timeout": 0.1}, name="stormy")
    prefix = fresh("storm")
    for number in range(40):
        client = bridge.connect()
        client.advertise(f"{prefix}_out_{number}", INT32)
        client.subscribe(f"{prefix}_in_{number}", INT32)
        client.advertise_service(f"{prefix}_service_{number}", "std_srvs/Empty")
        end = time.monotonic() + number * 0.0005
        while time.monotonic() < end:
            pass
        client.drop()

    def traces() -> List[Any]:
        state = ros_master.call("getSystemState")
        return [entry for kind in state for entry in kind if prefix in entry[0]]

    with bridge.connect() as client:
        client.sync()
    wait_until(lambda: traces() == [], 5.0, lambda: f"no traces but {traces()}")


def test_the_bus_info_of_the_bridge_is_right(bridge: Bridge, connect, peer: Peer, ros_master: RosMaster):
    import xmlrpc.client

    client, topic = connect(bridge), fresh("bus")
    peer.advertise(topic + "_in", INT32)
    live(client, topic + "_in", INT32)
    peer.subscribe(topic + "_out", INT32)
    client.advertise(topic + "_out", INT32)
    peer.wait_publishers(topic + "_out")
    node = xmlrpc.client.ServerProxy(ros_master.call("lookupNode", "/rosbridge_websocket"))

    def connections() -> Any:
        info = node.getBusInfo("/test")[2]
        return sorted([entry[2], entry[3], entry[4], entry[5]] for entry in info if topic in entry[4])

    wait_until(lambda: len(connections()) == 2)
    (inbound, outbound) = connections()
    assert inbound == ["i", "TCPROS", topic + "_in", True]
    assert outbound == ["o", "TCPROS", topic + "_out", True]
    assert [topic + "_in", INT32] in node.getSubscriptions("/test")[2]
    assert [topic + "_out", INT32] in node.getPublications("/test")[2]


def test_a_large_message_gets_through_both_ways(bridge: Bridge, connect, peer: Peer):
    client, listener, topic = connect(bridge), connect(bridge), fresh("large")
    live(listener, topic, "rosbridge_library/TestUInt8", compression="cbor")
    data = bytes(range(256)) * 40_000
    client.send({"op": "publish", "topic": topic, "msg": {"data": data}}, cbor=True)
    assert listener.next_message(topic, timeout=20)["data"] == data
