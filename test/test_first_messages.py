# SPDX-License-Identifier: BSD-3-Clause
"""The first message right after advertise, when the subscriber is a client of the same bridge."""

from __future__ import annotations

from typing import Callable

from support.bridge import Bridge
from support.client import Client


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
