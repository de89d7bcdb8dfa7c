# SPDX-License-Identifier: BSD-3-Clause
"""A Foxglove client for the suites: the protocol by the book, over the websockets library.

It keeps what the server told it (channels, services, statuses, the connection graph) as a program would, and every
message as it came. Nothing of the bridge is used: messages are decoded by genpy with the definition that the server
advertised.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import struct
import threading
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Sequence, Tuple

import genpy.dynamic
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from support.wait import wait_until

SUBPROTOCOL = "foxglove.websocket.v1"


class Received(NamedTuple):
    """One message of a topic: its receive time, and its bytes."""

    time_ns: int
    data: bytes


class Foxglove:
    """One connection. Its fields are what the server said so far; `messages` every text message of it."""

    def __init__(self, url: str, subprotocols: Sequence[str] = (SUBPROTOCOL,)) -> None:
        self.messages: List[Dict[str, Any]] = []
        self.channels: Dict[int, Dict[str, Any]] = {}
        self.services: Dict[int, Dict[str, Any]] = {}
        self.statuses: List[Dict[str, Any]] = []
        self.shown: Dict[str, str] = {}
        self.received: Dict[int, List[Received]] = {}
        self.times_ns: List[int] = []
        self.responses: Dict[int, Tuple[str, bytes]] = {}
        self.failures: Dict[int, str] = {}
        self.assets: Dict[int, Tuple[int, str, bytes]] = {}
        self.values: List[Dict[str, Any]] = []
        self.published: Dict[str, List[str]] = {}
        self.subscribed: Dict[str, List[str]] = {}
        self.provided: Dict[str, List[str]] = {}
        self.closed = False
        self._numbers = itertools.count(1)
        self._closing = contextlib.ExitStack()
        self._connection = self._closing.enter_context(
            connect(
                url, subprotocols=list(subprotocols), max_size=None, compression=None, ping_interval=None, proxy=None
            )
        )
        self.subprotocol = self._connection.subprotocol
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def __enter__(self) -> Foxglove:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._closing.close()
        self._reader.join(5)

    # Out

    def send(self, op: str, **fields: Any) -> None:
        self.send_raw(json.dumps({"op": op, **fields}))

    def send_raw(self, data: Any) -> None:
        self._connection.send(data)

    def number(self) -> int:
        """A number that was not used yet."""
        return next(self._numbers)

    def subscribe(self, topic: str, timeout: float = 10.0) -> int:
        """Subscribes to a topic once it is advertised; the subscription's id, by which `received` has its messages."""
        channel, number = self.channel(topic, timeout), self.number()
        self.received.setdefault(number, [])
        self.send("subscribe", subscriptions=[{"id": number, "channelId": channel["id"]}])
        return number

    def advertise(self, topic: str, kind: str, encoding: str = "ros1", **more: Any) -> int:
        """Advertises a channel; its id."""
        number = self.number()
        channel = {"id": number, "topic": topic, "encoding": encoding, "schemaName": kind, **more}
        self.send("advertise", channels=[channel])
        return number

    def publish(self, channel: int, data: bytes) -> None:
        self.send_raw(struct.pack("<BI", 1, channel) + data)

    def begin_call(self, service: int, data: bytes, encoding: str = "ros1") -> int:
        """Calls a service by its id; the call's id."""
        number, name = self.number(), encoding.encode()
        self.send_raw(struct.pack("<BIII", 2, service, number, len(name)) + name + data)
        return number

    def call(self, name: str, data: bytes, encoding: str = "ros1", timeout: float = 10.0) -> bytes:
        """The response of a service; AssertionError with the reason when it failed."""
        number = self.begin_call(self.service(name)["id"], data, encoding)
        self.wait(lambda: number in self.responses or number in self.failures, f"an answer of {name}", timeout)
        assert number not in self.failures, self.failures[number]
        answered, response = self.responses[number]
        assert answered == encoding
        return response

    def failure(self, number: int, timeout: float = 10.0) -> str:
        """Why a call failed."""
        self.wait(lambda: number in self.responses or number in self.failures, "the end of a call", timeout)
        assert number not in self.responses, self.responses[number]
        return self.failures[number]

    def fetch(self, uri: str, timeout: float = 10.0) -> Tuple[int, str, bytes]:
        """The status, the error and the content of an asset."""
        number = self.number()
        self.send("fetchAsset", uri=uri, requestId=number)
        self.wait(lambda: number in self.assets, f"an answer for {uri}", timeout)
        return self.assets[number]

    def get_parameters(self, *names: str) -> Dict[str, Dict[str, Any]]:
        """The entries that the server answers with, by name."""
        return self._parameters("getParameters", parameterNames=list(names))

    def set_parameters(self, *entries: Dict[str, Any]) -> Dict[str, Dict[str, Any]]:
        """The entries after setting these."""
        return self._parameters("setParameters", parameters=list(entries))

    def _parameters(self, op: str, **fields: Any) -> Dict[str, Dict[str, Any]]:
        request = f"request-{self.number()}"
        self.send(op, id=request, **fields)

        def answer() -> Optional[Dict[str, Any]]:
            return next((each for each in self.values if each.get("id") == request), None)

        found = wait_until(answer, 10.0, lambda: f"an answer to {op}; statuses: {self.statuses}")
        return {entry["name"]: entry for entry in found["parameters"]}

    # In

    def wait(self, condition: Callable[[], Any], what: str, timeout: float = 10.0) -> Any:
        """The first truthy value of `condition`."""
        return wait_until(condition, timeout, lambda: f"{what}; statuses: {self.statuses}")

    def channel(self, topic: str, timeout: float = 10.0) -> Dict[str, Any]:
        """The channel of a topic, once there is one."""
        return self.wait(lambda: _named(self.channels, "topic", topic), f"a channel of {topic}", timeout)  # type: ignore[no-any-return]

    def service(self, name: str, timeout: float = 10.0) -> Dict[str, Any]:
        """A service, once it is advertised."""
        return self.wait(lambda: _named(self.services, "name", name), f"the service {name}", timeout)  # type: ignore[no-any-return]

    def wait_messages(self, subscription: int, count: int = 1, timeout: float = 10.0) -> List[Received]:
        """What came for a subscription, once there are so many."""
        messages = self.received.setdefault(subscription, [])
        self.wait(lambda: len(messages) >= count, f"{count} messages, not {len(messages)}", timeout)
        return list(messages)

    def wait_status(self, text: str, timeout: float = 10.0) -> Dict[str, Any]:
        """The first status with this text in it."""
        return self.wait(  # type: ignore[no-any-return]
            lambda: next((status for status in list(self.statuses) if text in status["message"]), None),
            f"a status with '{text}'",
            timeout,
        )

    def told(self, op: str) -> List[Dict[str, Any]]:
        """All text messages of one kind."""
        return [message for message in list(self.messages) if message["op"] == op]

    def _read(self) -> None:
        with contextlib.suppress(ConnectionClosed):
            for message in self._connection:
                if isinstance(message, str):
                    operation = json.loads(message)
                    self.messages.append(operation)
                    getattr(self, "_on_" + operation["op"], lambda _: None)(operation)
                else:
                    self._on_binary(message)
        self.closed = True

    def _on_binary(self, data: bytes) -> None:
        opcode = data[0]
        if opcode == 1:
            subscription, time_ns = struct.unpack_from("<IQ", data, 1)
            self.received.setdefault(subscription, []).append(Received(time_ns, data[13:]))
        elif opcode == 2:
            self.times_ns.append(*struct.unpack_from("<Q", data, 1))
        elif opcode == 3:
            _, call, length = struct.unpack_from("<III", data, 1)
            self.responses[call] = (data[13 : 13 + length].decode(), data[13 + length :])
        elif opcode == 4:
            request, status, length = struct.unpack_from("<IBI", data, 1)
            self.assets[request] = (status, data[10 : 10 + length].decode(), data[10 + length :])
        else:
            raise AssertionError(f"unknown opcode {opcode}")

    def _on_advertise(self, message: Dict[str, Any]) -> None:
        for channel in message["channels"]:
            assert channel["id"] not in self.channels, f"advertised twice: {channel}"
        self.channels.update({channel["id"]: channel for channel in message["channels"]})

    def _on_unadvertise(self, message: Dict[str, Any]) -> None:
        for number in message["channelIds"]:
            del self.channels[number]

    def _on_advertiseServices(self, message: Dict[str, Any]) -> None:  # noqa: N802  # named for the operation
        self.services.update({service["id"]: service for service in message["services"]})

    def _on_unadvertiseServices(self, message: Dict[str, Any]) -> None:  # noqa: N802
        for number in message["serviceIds"]:
            del self.services[number]

    def _on_status(self, message: Dict[str, Any]) -> None:
        self.statuses.append(message)
        if "id" in message:
            self.shown[message["id"]] = message["message"]

    def _on_removeStatus(self, message: Dict[str, Any]) -> None:  # noqa: N802
        assert message["statusIds"]
        for status_id in message["statusIds"]:
            del self.shown[status_id]

    def _on_serviceCallFailure(self, message: Dict[str, Any]) -> None:  # noqa: N802
        self.failures[message["callId"]] = message["message"]

    def _on_parameterValues(self, message: Dict[str, Any]) -> None:  # noqa: N802
        self.values.append(message)

    def _on_connectionGraphUpdate(self, message: Dict[str, Any]) -> None:  # noqa: N802
        for kept, changed, ids in (
            (self.published, message["publishedTopics"], "publisherIds"),
            (self.subscribed, message["subscribedTopics"], "subscriberIds"),
            (self.provided, message["advertisedServices"], "providerIds"),
        ):
            kept.update({entry["name"]: entry[ids] for entry in changed})
        for topic in message["removedTopics"]:
            self.published.pop(topic, None)
            self.subscribed.pop(topic, None)
        for service in message["removedServices"]:
            del self.provided[service]


def _named(entries: Dict[int, Dict[str, Any]], field: str, name: str) -> Optional[Dict[str, Any]]:
    return next((entry for entry in list(entries.values()) if entry[field] == name), None)


def decoded(channel: Dict[str, Any], data: bytes) -> Any:
    """The message in `data`, by the definition that a channel was advertised with."""
    cls = genpy.dynamic.generate_dynamic(channel["schemaName"], channel["schema"])[channel["schemaName"]]
    return cls().deserialize(data)


def serialized(message: Any) -> bytes:
    """The bytes of a rospy message."""
    buffer = io.BytesIO()
    message.serialize(buffer)
    return buffer.getvalue()
