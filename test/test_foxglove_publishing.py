# SPDX-License-Identifier: BSD-3-Clause
"""The bridge under Foxglove clients: what they publish."""

from __future__ import annotations

import json
import struct
from typing import Any, Callable, Dict

import pytest
from geometry_msgs.msg import Twist
from std_msgs.msg import String

from support.bridge import Bridge
from support.client import Client
from support.foxglove import Foxglove, serialized
from support.peer import Peer
from support.ros import RosMaster
from support.wait import wait_until

UNADVERTISED_AT_ONCE = 20
CUSTOM = "int32 a\nstring b\n"


def test_messages_in_ros1_and_json(foxglove: Foxglove, peer: Peer) -> None:
    for encoding, data in (("ros1", serialized(Twist())), ("json", b"{}")):
        topic = f"/published/{encoding}"
        peer.subscribe(topic, "geometry_msgs/Twist")
        channel = foxglove.advertise(topic, "geometry_msgs/Twist", encoding)
        twist = Twist()
        for number in range(20):
            twist.linear.x = number + 0.5
            fields = {"linear": {"x": number + 0.5, "y": 0, "z": 0}, "angular": {"x": 0, "y": 0, "z": 0}}
            foxglove.publish(channel, serialized(twist) if encoding == "ros1" else json.dumps(fields).encode())
        foxglove.publish(channel, data)
        received = peer.received(topic, 21)
        assert [message["linear"]["x"] for message in received] == [*(number + 0.5 for number in range(20)), 0.0]
        foxglove.send("unadvertise", channelIds=[channel])


def test_fields_left_out_in_json_are_told_once_until_the_channel_is_gone(foxglove: Foxglove, peer: Peer) -> None:
    topic = "/published/partly"
    peer.subscribe(topic, "geometry_msgs/Twist")
    channel = foxglove.advertise(topic, "geometry_msgs/Twist", "json")
    for _ in range(5):
        foxglove.publish(channel, b'{"linear": {"x": 3}}')
    assert peer.received(topic, 5)[-1]["linear"]["x"] == 3.0
    foxglove.get_parameters("/rosdistro")  # all that was said before is there by now
    assert len(foxglove.statuses) == 1
    assert "angular" in foxglove.statuses[0]["message"]
    foxglove.send("unadvertise", channelIds=[channel])
    foxglove.wait(lambda: not foxglove.shown, "the withdrawal of the warning")


def test_unadvertise_right_after_a_publish_loses_nothing(bridge: Bridge, peer: Peer) -> None:
    for number in range(UNADVERTISED_AT_ONCE):
        topic = f"/published/briefly_{number}"
        peer.subscribe(topic, "std_msgs/String")
        with Foxglove(bridge.url) as client:
            channel = client.advertise(topic, "std_msgs/String")
            client.publish(channel, serialized(String("the only one")))
            client.send("unadvertise", channelIds=[channel])
        assert peer.received(topic, 1) == [{"data": "the only one"}]


def test_a_channel_can_be_advertised_again_under_its_id(foxglove: Foxglove, peer: Peer) -> None:
    topic = "/published/again"
    peer.subscribe(topic, "std_msgs/String")
    for text in ("first", "second"):
        entry = {"id": 70, "topic": topic, "encoding": "ros1", "schemaName": "std_msgs/String"}
        foxglove.send("advertise", channels=[entry])
        foxglove.publish(70, serialized(String(text)))
        foxglove.send("unadvertise", channelIds=[70])
    assert [message["data"] for message in peer.received(topic, 2)] == ["first", "second"]
    assert not foxglove.statuses


def test_what_a_client_publishes_is_a_channel_for_others(foxglove: Foxglove, bridge: Bridge) -> None:
    topic = "/published/between"
    with Foxglove(bridge.url) as sender:
        channel = sender.advertise(topic, "not_installed/Custom", schema=CUSTOM, schemaEncoding="ros1msg")
        subscription = foxglove.subscribe(topic)
        assert foxglove.channel(topic)["schema"] == CUSTOM
        data = struct.pack("<iI", 5, 2) + b"hi"
        wait_until(lambda: sender.publish(channel, data) or foxglove.received[subscription], 5.0, "a message")
        assert foxglove.received[subscription][0].data == data


def test_two_clients_with_two_definitions_of_a_type_are_not_mixed(foxglove: Foxglove, bridge: Bridge) -> None:
    topic = "/published/two_definitions"
    foxglove.advertise(topic, "not_installed/Custom", schema=CUSTOM)
    foxglove.channel(topic)
    with Foxglove(bridge.url) as other:
        other.advertise(topic, "not_installed/Custom", schema="int32 other\n")
        other.wait_status("another version of not_installed/Custom")
        other.advertise(topic, "not_installed/Custom", schema=CUSTOM)
        other.get_parameters("/rosdistro")
        assert len(other.statuses) == 1


def test_several_channels_of_a_topic(foxglove: Foxglove, peer: Peer) -> None:
    topic = "/published/twice"
    peer.subscribe(topic, "std_msgs/String")
    binary, text = foxglove.advertise(topic, "std_msgs/String"), foxglove.advertise(topic, "std_msgs/String", "json")
    foxglove.publish(binary, serialized(String("binary")))
    foxglove.publish(text, b'{"data": "text"}')
    foxglove.send("unadvertise", channelIds=[binary])
    foxglove.publish(text, b'{"data": "still"}')
    assert [message["data"] for message in peer.received(topic, 3)] == ["binary", "text", "still"]


@pytest.mark.parametrize(
    ("encoding", "data", "told"),
    [
        ("ros1", b"", "0 bytes are not a std_msgs/String message"),
        ("ros1", b"\x05\0\0\0abc", "7 bytes are not a std_msgs/String message"),
        ("ros1", b"\x01\0\0\0abc", "7 bytes are not a std_msgs/String message"),
        ("ros1", b"\xff\xff\xff\xff", "4 bytes are not a std_msgs/String message"),
        ("json", b"{", "Not JSON"),
        ("json", b"[]", "must be an object"),
        ("json", b'{"data": 5}', "requires a string for field 'data'"),
        ("json", b'{"date": ""}', "does not have a field date"),
    ],
)
def test_what_is_no_message_is_not_published_and_told_once(
    foxglove: Foxglove, peer: Peer, encoding: str, data: bytes, told: str
) -> None:
    topic = "/published/garbage"
    peer.subscribe(topic, "std_msgs/String")
    channel = foxglove.advertise(topic, "std_msgs/String", encoding)
    peer.wait_publishers(topic)
    for _ in range(3):
        foxglove.publish(channel, data)
    foxglove.publish(channel, serialized(String("sound")) if encoding == "ros1" else b'{"data": "sound"}')
    assert [message["data"] for message in peer.received(topic, 1)] == ["sound"]
    foxglove.get_parameters("/rosdistro")  # all that was said before is there by now
    assert [status["id"] for status in foxglove.statuses] == [f"publish:{channel}"]
    assert told.lower() in foxglove.statuses[0]["message"].lower()
    peer.command("unsubscribe", topic=topic)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"encoding": "cdr"}, "'encoding' must be one of ros1, json"),
        ({"encoding": None}, "'encoding' is missing"),
        ({"topic": None}, "'topic' is missing"),
        ({"topic": 5}, "'topic' must be a string"),
        ({"topic": "/not legal"}, "not a legal name"),
        ({"schemaName": None}, "'schemaName' is missing"),
        ({"schemaName": "nonsense"}, "'nonsense' is not a valid type"),
        ({"schemaName": "not_installed/Type"}, "Unable to import package not_installed"),
        ({"schemaName": "not_installed/Type", "schema": "int32 a\nwhat is this", "schemaEncoding": "ros1msg"}, "what"),
        ({"schema": "int32 data\n"}, "is defined here in another way"),
        ({"id": None}, "'id' is missing"),
        ({"id": 2**32}, "'id' must be a number"),
        ({"id": 50}, "the channel id 50 is in use for /published/good"),
        ({"topic": "/rosout"}, "already has type rosgraph_msgs/Log"),
    ],
)
def test_a_channel_that_cannot_be_advertised_hinders_none_of_the_others(
    foxglove: Foxglove, change: Dict[str, Any], told: str
) -> None:
    good = {"id": 50, "topic": "/published/good", "encoding": "ros1", "schemaName": "std_msgs/String"}
    entry = {**good, "id": 51, "topic": "/published/bad", **change}
    bad = {name: value for name, value in entry.items() if value is not None}
    foxglove.send("advertise", channels=[good, bad, {**good, "id": 52, "topic": "/published/also"}])
    foxglove.channel("/published/also")
    foxglove.wait(lambda: foxglove.statuses, "an error")
    assert len(foxglove.statuses) == 1, foxglove.statuses
    assert foxglove.statuses[0]["level"] == 2
    assert told in foxglove.statuses[0]["message"]


@pytest.mark.parametrize(
    ("message", "told"),
    [
        ('{"op": "advertise"}', "'channels' is missing"),
        ('{"op": "advertise", "channels": {}}', "'channels' must be a list of objects"),
        ('{"op": "unadvertise", "channelIds": [4711]}', "no channel 4711"),
        ('{"op": "unadvertise", "channelIds": null}', "'channelIds' is missing"),
        (struct.pack("<BI", 1, 4711) + b"data", "no channel 4711"),
    ],
)
def test_mistakes_are_told(foxglove: Foxglove, message: Any, told: str) -> None:
    foxglove.send_raw(message)
    foxglove.wait_status(told)


def test_a_definition_in_another_language_is_no_hindrance(foxglove: Foxglove, peer: Peer) -> None:
    topic = "/published/json_schema"
    peer.subscribe(topic, "std_msgs/String")
    channel = foxglove.advertise(
        topic, "std_msgs/String", "json", schema='{"type": "object"}', schemaEncoding="jsonschema"
    )
    foxglove.publish(channel, b'{"data": "it"}')
    assert peer.received(topic, 1) == [{"data": "it"}]


def test_closed_topics(start_bridge: Callable[..., Bridge], connect_foxglove: Callable[..., Foxglove]) -> None:
    server = start_bridge(
        {"client_topic_whitelist": ["/cmd/.*", "/closed"], "topics_glob": "[/cmd/*, /open]"},
        name="with_client_whitelist",
    )
    client = connect_foxglove(server)
    for topic in ("/closed", "/open", "/cmd"):
        client.advertise(topic, "std_msgs/String")
        client.wait_status(f"does not let clients publish {topic}")
    client.advertise("cmd/vel", "geometry_msgs/Twist")
    client.channel("/cmd/vel")
    assert len(client.statuses) == 3


def test_a_client_that_leaves_leaves_nothing_behind(
    ros_master: RosMaster, start_bridge: Callable[..., Bridge], connect_foxglove: Callable[..., Foxglove]
) -> None:
    server = start_bridge({"unregister_timeout": 0.2}, name="quick_to_forget")
    client = connect_foxglove(server)
    client.advertise("/published/left", "std_msgs/String")
    wait_until(lambda: ros_master.publishers("/published/left"), 5.0, "the publisher")
    client.close()
    wait_until(lambda: not ros_master.publishers("/published/left"), 5.0, "its end")


def test_foxglove_and_rosbridge_clients_share_publishers(
    foxglove: Foxglove, bridge: Bridge, connect: Callable[..., Client], peer: Peer
) -> None:
    topic = "/published/shared"
    peer.subscribe(topic, "std_msgs/String")
    other = connect(bridge)
    other.send({"op": "advertise", "topic": topic, "type": "std_msgs/String"})
    other.send({"op": "publish", "topic": topic, "msg": {"data": "rosbridge"}})
    peer.received(topic, 1)
    channel = foxglove.advertise(topic, "std_msgs/String")
    foxglove.publish(channel, serialized(String("foxglove")))
    assert [message["data"] for message in peer.received(topic, 2)] == ["rosbridge", "foxglove"]
    assert peer.command("publisher_count", topic=topic) == 1
