# SPDX-License-Identifier: BSD-3-Clause
"""The bridge under Foxglove clients: the connection graph and assets."""

from __future__ import annotations

import socket
import struct
from pathlib import Path
from typing import Any, Callable, Iterator

import pytest
from websockets.sync.client import connect as connect_websocket

from support.bridge import Bridge
from support.foxglove import SUBPROTOCOL, Foxglove
from support.node import Node, script
from support.peer import Peer
from support.ros import RosMaster
from support.wait import wait_until

LARGE_BYTES = 40_000_000


def test_the_whole_graph_and_then_what_changes(
    foxglove: Foxglove, peer: Peer, ros_master: RosMaster, nodes: Callable[[Node], Node]
) -> None:
    peer.subscribe("/graph/b", "std_msgs/String")
    peer.serve("/graph/service")
    peer.advertise("/graph/a", "std_msgs/String")
    foxglove.channel("/graph/a")  # the latest of them: the bridge has asked the master since
    foxglove.send("subscribeConnectionGraph")
    foxglove.wait(lambda: foxglove.told("connectionGraphUpdate"), "the graph")
    whole = foxglove.told("connectionGraphUpdate")[0]
    assert whole["removedTopics"] == whole["removedServices"] == []
    assert {"name": "/graph/a", "publisherIds": ["/peer"]} in whole["publishedTopics"]
    assert {"name": "/graph/b", "subscriberIds": ["/peer"]} in whole["subscribedTopics"]
    assert {"name": "/graph/service", "providerIds": ["/peer"]} in whole["advertisedServices"]
    assert is_the_graph(foxglove, ros_master)

    other = nodes(
        script(
            ros_master,
            "from std_msgs.msg import String\n"
            "publisher = rospy.Publisher('/graph/a', String, queue_size=1)\n"
            "subscriber = rospy.Subscriber('/graph/c', String, print)\nready()",
            name="other",
        )
    )
    foxglove.wait(lambda: foxglove.published.get("/graph/a") == ["/other", "/peer"], "the other node")
    both = {"name": "/graph/a", "publisherIds": ["/other", "/peer"]}
    update = next(each for each in foxglove.told("connectionGraphUpdate") if both in each["publishedTopics"])
    assert "/graph/b" not in {entry["name"] for entry in update["subscribedTopics"]}
    foxglove.wait(lambda: is_the_graph(foxglove, ros_master), "the graph of the master")

    other.stop()
    peer.unadvertise("/graph/a")
    peer.command("unserve", service="/graph/service")
    peer.command("unsubscribe", topic="/graph/b")
    foxglove.wait(lambda: is_the_graph(foxglove, ros_master), "the graph of the master")
    assert "/graph/a" not in foxglove.published
    removed = {name for update in foxglove.told("connectionGraphUpdate") for name in update["removedTopics"]}
    assert {"/graph/a", "/graph/b", "/graph/c"} <= removed
    removed = {name for update in foxglove.told("connectionGraphUpdate") for name in update["removedServices"]}
    assert "/graph/service" in removed


def is_the_graph(client: Foxglove, master: RosMaster) -> bool:
    """Whether what a client was told makes up the master's state."""
    publishers, subscribers, services = master.call("getSystemState")
    state = [{name: sorted(nodes) for name, nodes in part} for part in (publishers, subscribers, services)]
    told = [{name: ids for name, ids in part.items() if ids} for part in (client.published, client.subscribed)]
    return [*told, client.provided] == state


def test_every_subscribed_client_is_told_and_no_other(
    bridge: Bridge, connect_foxglove: Callable[..., Foxglove], peer: Peer, ros_master: RosMaster
) -> None:
    clients = [connect_foxglove(bridge) for _ in range(4)]
    for client in clients[:3]:
        client.send("subscribeConnectionGraph")
        client.wait(lambda client=client: client.published, "the graph")
    clients[2].send("unsubscribeConnectionGraph")
    clients[2].get_parameters("/rosdistro")
    before = len(clients[2].told("connectionGraphUpdate"))
    peer.advertise("/graph/new", "std_msgs/String")
    for client in clients[:2]:
        client.wait(lambda client=client: client.published.get("/graph/new") == ["/peer"], "the new topic")
    clients[2].channel("/graph/new")
    clients[3].channel("/graph/new")
    assert len(clients[2].told("connectionGraphUpdate")) == before
    assert not clients[3].told("connectionGraphUpdate")
    clients[2].send("subscribeConnectionGraph")  # again: the whole graph, again
    clients[2].wait(lambda: clients[2].published.get("/graph/new") == ["/peer"], "the new topic")
    assert is_the_graph(clients[2], ros_master)
    peer.unadvertise("/graph/new")
    for client in clients[:3]:
        client.wait(lambda client=client: "/graph/new" not in client.published, "its end")


def test_mistakes_with_the_graph_are_told(foxglove: Foxglove) -> None:
    foxglove.send("unsubscribeConnectionGraph")
    foxglove.wait_status("was not subscribed to")
    foxglove.send("subscribeConnectionGraph")
    foxglove.send("subscribeConnectionGraph")
    foxglove.wait_status("is subscribed to already")
    foxglove.wait(lambda: foxglove.published, "the graph")


@pytest.fixture
def share(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "prefix" / "share"
    (folder / "some_robot").mkdir(parents=True)
    (folder / "some_robot" / "arm.stl").write_bytes(b"\0mesh")
    (tmp_path / "secret.stl").write_text("secret")
    (folder / "some_robot" / "out.stl").symlink_to(tmp_path / "secret.stl")
    return folder


def test_assets(start_bridge: Callable[..., Bridge], connect_foxglove: Callable[..., Foxglove], share: Path) -> None:
    server = start_bridge(name="with_assets", environment={"ROS_PACKAGE_PATH": str(share)})
    client = connect_foxglove(server)
    assert client.fetch("package://some_robot/arm.stl") == (0, "", b"\0mesh")
    for uri, reason in (
        ("package://some_robot/../secret.stl", "does not let clients fetch"),
        ("package://some_robot/%2e%2e/secret.stl", "'..'"),
        ("package://some_robot/out.stl", "link out of the package"),
        ("package://some_robot/leg.stl", "No such file"),
        ("file:///etc/hostname", "does not let clients fetch"),
    ):
        status, error, content = client.fetch(uri)
        assert (status, content) == (1, b"")
        assert reason in error
    assert not client.statuses


def test_an_allow_list_of_its_own(
    start_bridge: Callable[..., Bridge], connect_foxglove: Callable[..., Foxglove], share: Path
) -> None:
    server = start_bridge({"asset_uri_allowlist": [f"file://{share}/.*"]}, name="with_allow_list")
    client = connect_foxglove(server)
    assert client.fetch(f"file://{share}/some_robot/arm.stl") == (0, "", b"\0mesh")
    assert "does not let clients fetch" in client.fetch("package://some_robot/arm.stl")[1]
    assert "is a link to what" in client.fetch(f"file://{share}/some_robot/out.stl")[1]


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"uri": "package://a/b.stl"}, "'requestId' is missing"),
        ({"uri": "package://a/b.stl", "requestId": "one"}, "'requestId' must be a number"),
    ],
)
def test_a_request_without_an_id_is_told(foxglove: Foxglove, fields: Any, told: str) -> None:
    foxglove.send("fetchAsset", **fields)
    foxglove.wait_status(told)


def test_a_request_without_a_uri_fails(foxglove: Foxglove) -> None:
    foxglove.send("fetchAsset", requestId=5)
    foxglove.wait(lambda: 5 in foxglove.assets, "an answer")
    assert foxglove.assets[5] == (1, "the field 'uri' is missing", b"")


def test_a_slow_client_gets_more_assets_than_may_wait_for_it(start_bridge: Callable[..., Bridge], share: Path) -> None:
    (share / "some_robot" / "large.stl").write_bytes(bytes(LARGE_BYTES))
    server = start_bridge(name="with_large_assets", environment={"ROS_PACKAGE_PATH": str(share)})
    sock = socket.create_connection(("127.0.0.1", server.port))
    with connect_websocket(
        server.url, sock=sock, subprotocols=[SUBPROTOCOL], max_size=None, max_queue=1, ping_interval=None, proxy=None
    ) as connection:
        for number in range(4):
            connection.send(f'{{"op": "fetchAsset", "uri": "package://some_robot/large.stl", "requestId": {number}}}')
        answered = []
        while len(answered) < 4:
            message = connection.recv(20)
            if isinstance(message, bytes):
                answered.append(struct.unpack_from("<I", message, 1)[0])
                assert len(message) == 10 + LARGE_BYTES
        assert answered == [0, 1, 2, 3]
    wait_until(lambda: server.process.alive, 1.0, "the server")
