# SPDX-License-Identifier: BSD-3-Clause
"""The bridge under Foxglove clients: server info, channels, subscriptions, time."""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from typing import Any, Callable, List

import pytest
from genpy import Time
from rosgraph_msgs.msg import Clock
from websockets.sync.client import connect as connect_websocket

from support.bridge import Bridge
from support.client import Client
from support.foxglove import Foxglove, decoded, serialized
from support.node import Node, publish, script
from support.peer import Peer
from support.ros import RosMaster, free_port
from support.wait import wait_until

CAPABILITIES = ["clientPublish", "parameters", "parametersSubscribe", "services", "connectionGraph", "assets"]
NESTED = (
    "geometry_msgs/Point[] points\nstring name\n"
    + "=" * 80
    + "\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
)
LARGE = """
from std_msgs.msg import UInt8MultiArray
publisher = rospy.Publisher({topic!r}, UInt8MultiArray, queue_size=1)
message = UInt8MultiArray(data=bytes(1000000))
rospy.Timer(rospy.Duration(0.01), lambda _: publisher.publish(message))
ready()
"""
WITHIN_S = 1.5  # a look at the graph every second, and what it takes to tell of it


def test_the_first_message_is_server_info_and_an_advertise_follows(foxglove: Foxglove) -> None:
    foxglove.wait(lambda: foxglove.told("advertise"), "an advertise")
    info = foxglove.messages[0]
    assert info["op"] == "serverInfo"
    assert info["capabilities"] == CAPABILITIES
    assert info["supportedEncodings"] == ["ros1", "json"]
    assert info["metadata"]["ROS_DISTRO"]
    assert isinstance(info["name"], str)
    assert info["sessionId"]


def test_the_session_is_the_run_of_the_master(
    ros_master: RosMaster, start_bridge: Callable[..., Bridge], connect_foxglove: Callable[..., Foxglove]
) -> None:
    ros_master.set_param("/run_id", "the run")
    try:
        server = start_bridge(name="with_run_id")
        for _ in range(2):
            found = connect_foxglove(server)
            found.wait(lambda found=found: found.messages, "serverInfo")
            assert found.messages[0]["sessionId"] == "the run"
    finally:
        ros_master.call("deleteParam", "/run_id")


@pytest.mark.parametrize(
    ("offered", "selected"),
    [
        (["foxglove.websocket.v1"], "foxglove.websocket.v1"),
        (["foxglove.sdk.v1"], "foxglove.sdk.v1"),
        (["foxglove.sdk.v1", "foxglove.websocket.v1"], "foxglove.sdk.v1"),
        (["something.else", "foxglove.websocket.v1"], "foxglove.websocket.v1"),
    ],
)
def test_the_subprotocol_is_the_first_one_offered_that_is_known(
    bridge: Bridge, connect_foxglove: Callable[..., Foxglove], offered: List[str], selected: str
) -> None:
    found = connect_foxglove(bridge, subprotocols=offered)
    assert found.subprotocol == selected
    found.wait(lambda: found.told("serverInfo"), "serverInfo")


def test_a_second_port(
    ros_master: RosMaster, start_bridge: Callable[..., Bridge], connect_foxglove: Callable[..., Foxglove]
) -> None:
    port = free_port()
    server = start_bridge({"foxglove_port": port}, name="with_two_ports")
    with Foxglove(f"ws://127.0.0.1:{port}") as on_second:
        on_second.wait(lambda: on_second.told("serverInfo"), "serverInfo")
    connect_foxglove(server).channel("/rosout")


def test_a_second_port_that_is_held_does_not_hold_up_the_first(
    start_bridge: Callable[..., Bridge], connect_foxglove: Callable[..., Foxglove]
) -> None:
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        port = holder.getsockname()[1]
        server = start_bridge({"foxglove_port": port, "retry_startup_delay": 0.1}, name="with_held_port")
        connect_foxglove(server).channel("/rosout")
        wait_until(lambda: "Unable to listen" in server.process.output, 5.0, "the warning")

    def connects() -> bool:
        try:
            with Foxglove(f"ws://127.0.0.1:{port}") as client:
                return client.channel("/rosout") is not None
        except OSError:
            return False

    wait_until(connects, 10.0, "the second port")


def test_the_server_can_offer_less(
    start_bridge: Callable[..., Bridge], connect_foxglove: Callable[..., Foxglove]
) -> None:
    found = connect_foxglove(start_bridge({"capabilities": ["connectionGraph"]}, name="with_less"))
    found.channel("/rosout")
    info = found.messages[0]
    assert info["capabilities"] == ["connectionGraph"]
    assert "supportedEncodings" not in info
    for number, (op, fields) in enumerate(
        [("getParameters", {"parameterNames": []}), ("fetchAsset", {"uri": "package://a/b.dae", "requestId": 1})], 1
    ):
        found.send(op, **fields)
        found.wait(lambda number=number: len(found.statuses) == number, "an error")
        assert f"unknown operation '{op}'" in found.statuses[-1]["message"]
    found.send_raw(struct.pack("<BI", 1, 7) + b"data")
    found.wait(lambda: len(found.statuses) == 3, "an error")
    assert not found.told("advertiseServices")


def test_a_channel_tells_all_that_a_message_needs(foxglove: Foxglove, peer: Peer) -> None:
    topic = "/channels/odometry"
    peer.advertise(topic, "nav_msgs/Odometry")
    channel = foxglove.channel(topic, WITHIN_S)
    assert set(channel) == {"id", "topic", "encoding", "schemaName", "schema", "schemaEncoding"}
    assert (channel["encoding"], channel["schemaName"], channel["schemaEncoding"]) == (
        "ros1",
        "nav_msgs/Odometry",
        "ros1msg",
    )
    assert "MSG: geometry_msgs/PoseWithCovariance" in channel["schema"]
    subscription = foxglove.subscribe(topic)
    peer.wait_connected(topic)
    before = time.time_ns()
    peer.publish(topic, {"child_frame_id": "base", "pose": {"pose": {"position": {"x": 1.5}}}})
    (message,) = foxglove.wait_messages(subscription)
    odometry = decoded(channel, message.data)
    assert (odometry.child_frame_id, odometry.pose.pose.position.x) == ("base", 1.5)
    assert before <= message.time_ns <= time.time_ns()
    peer.unadvertise(topic)


def test_a_type_that_is_not_installed_is_learnt_from_the_publisher(foxglove: Foxglove, peer: Peer) -> None:
    topic = "/channels/not_installed"
    peer.advertise(topic, "not_installed/Outer", definition=NESTED, latch=True)
    channel = foxglove.channel(topic, WITHIN_S)
    assert channel["schemaName"] == "not_installed/Outer"
    peer.publish(topic, {"points": [{"x": 2.5}], "name": "it"})
    (message,) = foxglove.wait_messages(foxglove.subscribe(topic))
    assert decoded(channel, message.data).points[0].x == 2.5
    peer.unadvertise(topic)
    foxglove.wait(lambda: channel["id"] not in foxglove.channels, "its end")


def test_channels_come_and_go_within_a_second_and_keep_their_ids(foxglove: Foxglove, peer: Peer) -> None:
    topic = "/channels/coming"
    foxglove.channel("/rosout")
    ids = []
    for kind in ("std_msgs/String", "std_msgs/Int32", "std_msgs/String"):
        peer.advertise(topic, kind)
        channel = foxglove.channel(topic, WITHIN_S)
        assert channel["schemaName"] == kind
        ids.append(channel["id"])
        peer.unadvertise(topic)
        foxglove.wait(lambda number=channel["id"]: number not in foxglove.channels, "its end", WITHIN_S)
    assert ids[0] == ids[2] != ids[1]


def test_another_type_at_once_is_another_channel(foxglove: Foxglove, peer: Peer) -> None:
    topic = "/channels/changing"
    peer.advertise(topic, "std_msgs/String")
    first = foxglove.channel(topic)
    foxglove.subscribe(topic)
    peer.unadvertise(topic)
    peer.advertise(topic, "std_msgs/Int32", latch=True)
    foxglove.wait(lambda: foxglove.channel(topic)["schemaName"] == "std_msgs/Int32", "the other type", WITHIN_S)
    assert first["id"] not in foxglove.channels
    peer.publish(topic, {"data": 7})
    (message,) = foxglove.wait_messages(foxglove.subscribe(topic))
    assert message.data == struct.pack("<i", 7)
    peer.unadvertise(topic)


def test_another_version_of_an_installed_type_replaces_the_channel(foxglove: Foxglove, peer: Peer) -> None:
    topic = "/channels/version"
    peer.advertise(topic, "std_msgs/String", definition="string data\nint32 more\n", latch=True)
    peer.publish(topic, {"data": "it", "more": 3})
    installed = foxglove.channel(topic)
    foxglove.subscribe(topic)
    foxglove.wait(lambda: installed["id"] not in foxglove.channels, "the end of the installed version's channel")
    channel = foxglove.channel(topic)
    (message,) = foxglove.wait_messages(foxglove.subscribe(topic))
    assert decoded(channel, message.data).more == 3
    assert not foxglove.shown
    peer.unadvertise(topic)


def test_a_topic_whose_type_cannot_be_learnt_is_told_until_it_is_gone(
    foxglove: Foxglove, ros_master: RosMaster, bridge: Bridge
) -> None:
    topic, node = "/channels/unknown", "http://127.0.0.1:1/"
    ros_master.call("registerPublisher", topic, "not_installed/Nothing", node)
    status = foxglove.wait_status(topic)
    assert (status["level"], status["id"]) == (1, f"topic:{topic}")
    late = Foxglove(bridge.url)
    try:
        late.wait(lambda: f"topic:{topic}" in late.shown, "the status")
    finally:
        late.close()
    ros_master.call("unregisterPublisher", topic, node)
    foxglove.wait(lambda: not foxglove.shown, "its withdrawal")
    assert foxglove.told("removeStatus")[-1]["statusIds"] == [f"topic:{topic}"]


def test_latched_messages_of_every_publisher_reach_every_late_subscriber(
    foxglove: Foxglove,
    bridge: Bridge,
    ros_master: RosMaster,
    nodes: Callable[[Node], Node],
    connect: Callable[..., Client],
) -> None:
    topic = "/channels/latched"
    for name in ("first", "second"):
        nodes(
            publish(
                ros_master, topic, "std_msgs/String", {"data": name}, latch=True, count=1, rate=0, name=f"latch_{name}"
            )
        )
    expected = {serialized_string("first"), serialized_string("second")}

    def latched(subscription: int, of: Foxglove) -> bool:
        return {message.data for message in of.wait_messages(subscription, 2)} == expected

    assert latched(foxglove.subscribe(topic), foxglove)
    other = connect(bridge)  # one that speaks rosbridge, on the same feed
    other.send({"op": "subscribe", "topic": topic})
    assert {other.wait_for(op="publish")["msg"]["data"] for _ in range(2)} == {"first", "second"}
    for _ in range(3):
        with Foxglove(bridge.url) as late:
            number = late.subscribe(topic)
            assert latched(number, late)
            late.send("unsubscribe", subscriptionIds=[number])
            again = late.subscribe(topic)
            assert latched(again, late)
            assert len(late.received[number]) == 2
    assert all(len(messages) == 2 for messages in foxglove.received.values())


def serialized_string(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def test_one_feed_serves_all(foxglove: Foxglove, bridge: Bridge, peer: Peer, connect: Callable[..., Client]) -> None:
    topic = "/channels/shared"
    peer.advertise(topic, "std_msgs/Int32")
    others = [Foxglove(bridge.url) for _ in range(3)]
    try:
        subscriptions = [(each, each.subscribe(topic)) for each in (foxglove, *others)]
        plain = connect(bridge)
        plain.send({"op": "subscribe", "topic": topic})
        peer.wait_connected(topic)
        wait_until(lambda: peer.command("connections", topic=topic) == 1, 5.0, "one connection")
        plain.send({"op": "set_level", "level": "info"})
        plain.wait_for(op="status")
        peer.publish(topic, *({"data": number} for number in range(20)))
        for each, subscription in subscriptions:
            messages = each.wait_messages(subscription, 20)
            assert [struct.unpack("<i", message.data)[0] for message in messages] == list(range(20))
        assert [plain.wait_for(op="publish")["msg"]["data"] for _ in range(20)] == list(range(20))
        assert peer.command("connections", topic=topic) == 1
    finally:
        for other in others:
            other.close()
    peer.unadvertise(topic)


def test_mistakes_with_subscriptions_are_told_and_hinder_nothing_else(foxglove: Foxglove, peer: Peer) -> None:
    topic, other = "/channels/mistakes", "/channels/mistakes_too"
    peer.advertise(topic, "std_msgs/Int32")
    peer.advertise(other, "std_msgs/Int32")
    channel, second = foxglove.channel(topic)["id"], foxglove.channel(other)["id"]
    foxglove.send(
        "subscribe",
        subscriptions=[
            {"id": 900, "channelId": 123456},
            {"id": 901, "channelId": channel},
            {"id": 902, "channelId": channel},
            {"id": 901, "channelId": second},
            {"channelId": second},
            {"id": "five", "channelId": second},
            {"id": -1, "channelId": second},
            {"id": 903, "channelId": second},
        ],
    )
    foxglove.send("unsubscribe", subscriptionIds=[999])
    foxglove.wait(lambda: len(foxglove.statuses) >= 7, "seven statuses")
    texts = [status["message"] for status in foxglove.statuses]
    assert [status["level"] for status in foxglove.statuses] == [2, 2, 2, 2, 2, 2, 1]
    assert "there is no channel 123456" in texts[0]
    assert "is subscribed to already" in texts[1]
    assert "the subscription id 901 is in use" in texts[2]
    assert "'id' is missing" in texts[3]
    assert all("'id' must be a number" in text for text in texts[4:6])
    assert "there is no subscription 999" in texts[6]
    for each in (topic, other):
        peer.wait_connected(each)
        peer.publish(each, {"data": 1})
    foxglove.wait_messages(901)
    foxglove.wait_messages(903)
    foxglove.send("unsubscribe", subscriptionIds=[901])
    foxglove.send("subscribe", subscriptions=[{"id": 901, "channelId": channel}])  # the id is free again
    foxglove.wait(lambda: peer.command("connections", topic=topic) == 1, "the new subscription")
    assert len(foxglove.statuses) == 7
    for each in (topic, other):
        peer.unadvertise(each)


@pytest.mark.parametrize(
    ("message", "told"),
    [
        ("no JSON", "not JSON"),
        ("[1]", "must be an object"),
        ("{}", "'op' is missing"),
        ('{"op": 5}', "'op' must be"),
        ('{"op": "dance"}', "unknown operation 'dance'"),
        ('{"op": "subscribe"}', "'subscriptions' is missing"),
        ('{"op": "subscribe", "subscriptions": 1}', "'subscriptions' must be a list of objects"),
        ('{"op": "subscribe", "subscriptions": [1]}', "'subscriptions' must be a list of objects"),
        ('{"op": "unsubscribe", "subscriptionIds": ["a"]}', "'subscriptionIds' must be a list of numbers"),
        (b"\x05rest", "unknown opcode 5"),
        (b"\x00", "unknown opcode 0"),
        (b"", "empty message"),
        (b"\x01\x00", "ends before its channel id"),
        (b"\x02\x00\x00", "ends before its ids"),
    ],
)
def test_what_is_no_message_of_the_protocol_is_told(foxglove: Foxglove, message: Any, told: str) -> None:
    foxglove.send_raw(message)
    foxglove.wait(lambda: foxglove.statuses, "a status")
    assert foxglove.statuses[0]["level"] == 2
    assert told.lower() in foxglove.statuses[0]["message"].lower()
    foxglove.channel("/rosout")  # and the connection goes on


def test_whitelists_and_globs_close_topics(
    start_bridge: Callable[..., Bridge], connect_foxglove: Callable[..., Foxglove], peer: Peer
) -> None:
    for topic in ("/open/a", "/open/secret", "/closed/a", "/open/ab"):
        peer.advertise(topic, "std_msgs/Int32")
    server = start_bridge(
        {"topics_glob": "[/open/*]", "topic_whitelist": ["/open/.", "/open/secre", "/closed/a"]}, name="with_whitelist"
    )
    client = connect_foxglove(server)
    client.wait(lambda: client.told("advertise"), "an advertise")
    assert {channel["topic"] for channel in client.channels.values()} == {"/open/a"}
    client.send("subscribeConnectionGraph")
    client.wait(lambda: client.published, "the graph")
    assert set(client.published) == {"/open/a"}
    for topic in ("/open/a", "/open/secret", "/closed/a", "/open/ab"):
        peer.unadvertise(topic)


def test_a_slow_client_loses_old_messages_of_its_own_and_is_told(
    bridge: Bridge, foxglove: Foxglove, ros_master: RosMaster, nodes: Callable[[Node], Node]
) -> None:
    topic, small = "/channels/large", "/channels/small"
    nodes(script(ros_master, LARGE.format(topic=topic), name="large"))
    nodes(publish(ros_master, small, "std_msgs/Int32", rate=20, counter="data", name="small"))
    subscription = foxglove.subscribe(topic)
    state = foxglove.subscribe(small)
    with SlowFoxglove(bridge.port, [foxglove.channel(topic)["id"], foxglove.channel(small)["id"]]) as slow:
        foxglove.wait_messages(subscription, 150, 30)
        text, counts = slow.catch_up(f"dropped:{topic}")
        assert "dropped" in text
        assert counts[0] < len(foxglove.received[subscription])
    numbers = [struct.unpack("<i", message.data)[0] for message in foxglove.received[state]]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))


class SlowFoxglove:
    """A client that subscribes to channels, and reads nothing until it is asked to."""

    def __init__(self, port: int, channels: List[int]) -> None:
        sock = socket.socket()
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
        sock.connect(("127.0.0.1", port))
        self._closing = contextlib.ExitStack()
        self._connection = self._closing.enter_context(
            connect_websocket(
                f"ws://127.0.0.1:{port}",
                sock=sock,
                subprotocols=["foxglove.websocket.v1"],
                max_size=None,
                max_queue=1,
                compression=None,
                ping_interval=None,
                proxy=None,
            )
        )
        entries = ", ".join(f'{{"id": {number}, "channelId": {channel}}}' for number, channel in enumerate(channels))
        while '"channels"' not in str(self._connection.recv(10)):
            pass
        self._connection.send(f'{{"op": "subscribe", "subscriptions": [{entries}]}}')

    def __enter__(self) -> SlowFoxglove:
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.close()

    def catch_up(self, status_id: str) -> Any:
        """Read on until the status with an id and messages of both subscriptions have come: its text, and how many."""
        counts, text = {0: 0, 1: 0}, ""
        while not (text and all(counts.values())):
            message = self._connection.recv(10)
            if isinstance(message, bytes):
                counts[struct.unpack_from("<I", message, 1)[0]] += 1
            elif status_id in message:
                text = message
        return text, counts


def test_nothing_is_watched_and_nothing_left_behind_without_clients(
    ros_master: RosMaster, bridge: Bridge, foxglove: Foxglove, peer: Peer
) -> None:
    topic = "/channels/left"
    peer.advertise(topic, "std_msgs/Int32")
    foxglove.subscribe(topic)
    peer.wait_connected(topic)
    foxglove.close()
    wait_until(lambda: peer.command("connections", topic=topic) == 0, 5.0, "the end of the subscription")
    wait_until(lambda: not ros_master.subscribers(topic), 5.0, "the end of the registration")
    peer.unadvertise(topic)


def test_time_is_that_of_the_clock_and_channels_come_while_it_stands_still(
    ros_master: RosMaster, start_bridge: Callable[..., Bridge], connect_foxglove: Callable[..., Foxglove], peer: Peer
) -> None:
    ros_master.set_param("/use_sim_time", True)
    try:
        peer.advertise("/clock", "rosgraph_msgs/Clock")
        server = start_bridge(name="with_sim_time")
        client = connect_foxglove(server)
        client.wait(lambda: client.messages, "serverInfo")
        assert client.messages[0]["capabilities"] == [*CAPABILITIES, "time"]
        peer.wait_connected("/clock")
        peer.publish("/clock", {"clock": {"secs": 12, "nsecs": 500}})
        client.wait(lambda: client.times_ns == [12_000_000_500], f"the time, not {client.times_ns}")
        topic = "/channels/simulated"
        peer.advertise(topic, "std_msgs/Int32")
        subscription = client.subscribe(topic, WITHIN_S)
        peer.wait_connected(topic)
        peer.publish(topic, {"data": 1})
        assert client.wait_messages(subscription)[0].time_ns == 12_000_000_500
        clock = client.subscribe("/clock")
        peer.publish("/clock", {"clock": {"secs": 13, "nsecs": 0}})
        assert client.wait_messages(clock)[0].data == serialized(Clock(clock=Time(13)))
        client.wait(lambda: client.times_ns[-1] == 13_000_000_000, "the new time")
        peer.unadvertise(topic)
        peer.unadvertise("/clock")
    finally:
        ros_master.call("deleteParam", "/use_sim_time")


@pytest.mark.allow_log("the ROS master at")
def test_a_master_that_restarts_is_followed(
    ros_master: RosMaster, start_bridge: Callable[..., Bridge], connect_foxglove: Callable[..., Foxglove], nodes: Any
) -> None:
    server = start_bridge(name="with_restart")
    client = connect_foxglove(server)
    client.channel("/rosout")
    ros_master.restart()
    node = nodes(
        script(
            ros_master,
            "pub = rospy.Publisher('/channels/new', __import__('std_msgs.msg').msg.Int32, queue_size=1)\nready()",
            name="after_restart",
        )
    )
    client.channel("/channels/new", 15)
    assert node.process.alive
