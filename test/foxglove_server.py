# SPDX-License-Identifier: BSD-3-Clause
"""A little Foxglove server on rospy and the websockets library, for the test of the benchmark's Foxglove clients.

What is published and provided when a client connects is advertised to it once; that is all these clients need.
"""

from __future__ import annotations

import io
import itertools
import json
import struct
import sys
import time
from typing import Any, Dict

import roslib.message
import rospy
import rosservice
from websockets.sync.server import ServerConnection, serve

MESSAGE_DATA, SERVICE_CALL = 1, 2
CHANNEL, SERVICE, CLIENT_DATA, CALL = struct.Struct("<BIQ"), struct.Struct("<BIII"), struct.Struct("<BI"), 2
numbers = itertools.count(1)


def serialized(message: Any) -> bytes:
    buffer = io.BytesIO()
    message.serialize(buffer)
    return buffer.getvalue()


class Client:
    """One client's channels, services and publishers."""

    def __init__(self, connection: ServerConnection) -> None:
        self.connection = connection
        self.topics = {next(numbers): (topic, kind) for topic, kind in rospy.get_published_topics("/benchmark")}
        self.services = {next(numbers): name for name in rosservice.get_service_list(namespace="/benchmark")}
        self.publishers: Dict[int, Any] = {}
        self.send(op="serverInfo", name="test", capabilities=["clientPublish", "services"], supportedEncodings=["ros1"])
        self.send(op="advertise", channels=[self.channel(number) for number in self.topics])
        services = [
            {"id": number, "name": name, "type": rosservice.get_service_type(name)}
            for number, name in self.services.items()
        ]
        self.send(op="advertiseServices", services=services)

    def channel(self, number: int) -> Dict[str, Any]:
        topic, kind = self.topics[number]
        definition = roslib.message.get_message_class(kind)._full_text
        return {"id": number, "topic": topic, "encoding": "ros1", "schemaName": kind, "schema": definition}

    def send(self, **operation: Any) -> None:
        self.connection.send(json.dumps(operation))

    def receive(self, message: Any) -> None:
        if isinstance(message, bytes):
            {MESSAGE_DATA: self.publish, SERVICE_CALL: self.call}[message[0]](message)
            return
        operation = json.loads(message)
        if operation["op"] == "subscribe":
            for entry in operation["subscriptions"]:
                self.subscribe(entry["id"], self.topics[entry["channelId"]][0])
        if operation["op"] == "advertise":
            for channel in operation["channels"]:
                kind = roslib.message.get_message_class(channel["schemaName"])
                self.publishers[channel["id"]] = rospy.Publisher(channel["topic"], kind, queue_size=100)

    def subscribe(self, number: int, topic: str) -> None:
        def forward(message: Any) -> None:
            if subscriber is not None and self.connection.close_code is not None:
                subscriber.unregister()
                return
            self.connection.send(CHANNEL.pack(MESSAGE_DATA, number, time.time_ns()) + message._buff)

        subscriber = rospy.Subscriber(topic, rospy.AnyMsg, forward, tcp_nodelay=True)

    def publish(self, data: bytes) -> None:
        _, number = CLIENT_DATA.unpack_from(data)
        publisher = self.publishers[number]
        publisher.publish(publisher.data_class().deserialize(data[CLIENT_DATA.size :]))

    def call(self, data: bytes) -> None:
        _, service, call, length = SERVICE.unpack_from(data)
        kind = rosservice.get_service_class_by_name(self.services[service])
        request = kind._request_class().deserialize(data[SERVICE.size + length :])
        response = serialized(rospy.ServiceProxy(self.services[service], kind)(request))
        self.connection.send(SERVICE.pack(3, service, call, length) + data[SERVICE.size :][:length] + response)


def handle(connection: ServerConnection) -> None:
    client = Client(connection)
    for message in connection:
        client.receive(message)


rospy.init_node("foxglove_test_server", anonymous=True, disable_signals=True)
with serve(handle, "127.0.0.1", int(sys.argv[1]), subprotocols=["foxglove.websocket.v1"], compression=None) as server:
    server.serve_forever()
