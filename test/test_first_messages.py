# SPDX-License-Identifier: BSD-3-Clause
"""The first messages right after advertise: to clients of the same bridge, and to a node that is slow to connect."""

from __future__ import annotations

import signal
from typing import Callable

import pytest

from support.bridge import Bridge
from support.client import Client
from support.peer import Peer
from support.wait import wait_until


def test_a_client_that_subscribes_advertises_and_publishes_at_once_gets_its_message(
    bridge: Bridge, connect: Callable[..., Client]
) -> None:
    client = connect(bridge)
    # The subscription may or may not have reached the master when the topic is advertised: both happen in 20 tries.
    for number in range(20):
        topic = f"/first_messages_{number}"
        client.subscribe(topic, "std_msgs/Int32")
        client.advertise(topic, "std_msgs/Int32")
        client.publish(topic, {"data": number})
        assert client.next_message(topic) == {"data": number}


def test_the_same_between_two_clients(bridge: Bridge, connect: Callable[..., Client]) -> None:
    subscriber = connect(bridge)
    publisher = connect(bridge)
    for number in range(20):
        topic = f"/first_messages_of_another_{number}"
        subscriber.subscribe(topic, "std_msgs/Int32")
        subscriber.sync()
        publisher.advertise(topic, "std_msgs/Int32")
        for value in range(5):
            publisher.publish(topic, {"data": value})
        assert [message["data"] for message in subscriber.messages(topic, 5)] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("timeout_s", [0.0, 0.2])
def test_a_publisher_stays_until_the_subscribers_that_were_there_have_connected(
    start_bridge: Callable[..., Bridge], peer: Peer, timeout_s: float
) -> None:
    topic = f"/first_messages_after_{10 * timeout_s:.0f}"
    peer.subscribe(topic, "std_msgs/Int32")
    bridge = start_bridge({"unregister_timeout": timeout_s}, name="hasty")
    peer.node.process.signal(signal.SIGSTOP)
    try:
        with bridge.connect() as page:
            page.advertise(topic, "std_msgs/Int32")
            for number in range(3):
                page.publish(topic, {"data": number})
            page.sync()
        wait_until(lambda: "0 clients total" in bridge.process.output, 5.0, "the page left")
        with bridge.connect() as witness:  # longer than the publisher outlives its last client
            witness.collect(3 * timeout_s + 0.3)
    finally:
        peer.node.process.signal(signal.SIGCONT)
    assert [message["data"] for message in peer.received(topic, 3)] == [0, 1, 2]
    wait_until(lambda: f"/{bridge.name}" not in bridge.master.publishers(topic), 7.0, "unregistered")
