# SPDX-License-Identifier: BSD-3-Clause
"""advertise, unadvertise and message data from a client: what it publishes.

A client's channels are advertisements of its own beside those of other clients: see
`rosbridge_library.capabilities.publication`. What it publishes is checked against the type, so that no node is sent
bytes which it can't read.
"""

from __future__ import annotations

from typing import Dict, NamedTuple, Optional

from rosbridge_library.capabilities.publication import AccessDenied, publications
from rosbridge_library.capability import Capability, Operation
from rosbridge_library.codec import decode_json
from rosbridge_library.foxglove import messages
from rosbridge_library.foxglove.fields import entries, number, optional_text, text
from rosbridge_library.foxglove.options import matches
from rosbridge_library.foxglove.protocol import FoxgloveProtocol
from rosbridge_library.internal.exceptions import InvalidArgumentException, RosbridgeError
from rosbridge_library.names import global_name
from rosbridge_library.ros.publishers import Publisher


class ClientChannel(NamedTuple):
    """What one client publishes; `topic` is the name as it wrote it."""

    id: int
    topic: str
    encoding: str
    publisher: Publisher

    def wire(self, payload: bytes, protocol: FoxgloveProtocol) -> bytes:
        """The message in `payload`, serialized. Raises DecodeError, ValuesError or WireError."""
        if self.encoding == "ros1":
            self.publisher.type.check(payload)
            return payload
        values = decode_json(payload)
        if not isinstance(values, dict):
            raise InvalidArgumentException(f"a message in JSON must be an object, not {type(values).__name__}")
        wire, left_out = self.publisher.type.from_values(values, protocol.node.now)
        if left_out:
            what = f"left-out fields of {self.publisher.type.name} were filled with defaults: {', '.join(left_out)}"
            protocol.show(self.status_id, f"{self.topic}: {what}")
        return wire

    @property
    def status_id(self) -> str:
        """Of what is wrong with its messages."""
        return f"publish:{self.id}"


class Publishing(Capability):
    """The channels of one client."""

    protocol: FoxgloveProtocol

    def __init__(self, protocol: FoxgloveProtocol) -> None:
        super().__init__(protocol)
        self._channels: Dict[int, ClientChannel] = {}
        self._publications = publications(protocol)
        protocol.register_operation("advertise", self.advertise)
        protocol.register_operation("unadvertise", self.unadvertise)
        protocol.register_operation(messages.MESSAGE_DATA, self.publish)

    async def advertise(self, message: Operation) -> None:
        """Each channel by itself: one that can't be advertised hinders none of the others."""
        for entry in entries(message, "channels", dict):
            try:
                await self._advertise(entry)
            except RosbridgeError as error:
                self.protocol.log("error", f"advertise: {error}")

    async def _advertise(self, entry: Operation) -> None:
        channel_id, topic = number(entry, "id"), text(entry, "topic")
        encoding, type_name = text(entry, "encoding"), text(entry, "schemaName")
        if channel_id in self._channels:
            raise InvalidArgumentException(
                f"the channel id {channel_id} is in use for {self._channels[channel_id].topic}"
            )
        if encoding not in messages.ENCODINGS:
            raise InvalidArgumentException(f"the field 'encoding' must be one of {', '.join(messages.ENCODINGS)}")
        if not matches(self.protocol.server.options.client_topic_whitelist, global_name(topic)):
            raise AccessDenied(f"the server does not let clients publish {topic}")
        publisher = await self._publications.advertise(
            topic, type_name, channel_id, False, None, _definition(entry, encoding)
        )
        self._channels[channel_id] = ClientChannel(channel_id, topic, encoding, publisher)

    def unadvertise(self, message: Operation) -> None:
        """Take channels back. What was published on them before still reaches every subscriber."""
        for channel_id in entries(message, "channelIds", int):
            channel = self._channels.pop(channel_id, None)
            if channel is None:
                self.protocol.log("warning", f"unadvertise: there is no channel {channel_id} of this client")
                continue
            self._publications.unadvertise(channel.topic, channel_id)
            self.protocol.withdraw([channel.status_id])

    def publish(self, message: Operation) -> None:
        """Publish one message. What is wrong with it is shown once, however many are wrong in the same way."""
        channel = self._channels.get(message["channelId"])
        if channel is None:
            raise InvalidArgumentException(f"there is no channel {message['channelId']} of this client")
        try:
            wire = channel.wire(message["payload"], self.protocol)
        except RosbridgeError as error:
            self.protocol.show(channel.status_id, f"{channel.topic}: a message is not published: {error}")
            return
        channel.publisher.publish(wire)

    def finish(self) -> None:
        self._publications.unadvertise_all()


def _definition(entry: Operation, encoding: str) -> Optional[str]:
    """The definition of the type that a client gives, unless it is a schema of another kind, or empty."""
    schema, schema_encoding = optional_text(entry, "schema"), optional_text(entry, "schemaEncoding")
    is_ros = schema_encoding == messages.SCHEMA_ENCODING or (not schema_encoding and encoding == "ros1")
    return schema if schema and is_ros else None
