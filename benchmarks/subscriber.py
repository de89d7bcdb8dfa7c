# SPDX-License-Identifier: BSD-3-Clause
"""A raw TCPROS subscriber that counts what a bridge publishes for its clients."""

from __future__ import annotations

import socket
import struct
import time
import urllib.parse
import xmlrpc.client
from multiprocessing.connection import wait
from typing import Any, List

from benchmarks.messages import LOADS, message_class, stamp_offset
from benchmarks.rosnode import RosNode, receive_header, send_header
from benchmarks.tally import Tally, Window
from benchmarks.worker import Pipe, answer

_LENGTH = struct.Struct("<I")
_STAMP = struct.Struct("<II")
_PUBLISHER_TIMEOUT_S = 20.0
_DRAIN_S = 0.5


def run(pipe: Pipe, load_name: str, topic: str, master_uri: str) -> None:
    """A worker. Commands: "start", whose reply says that somebody publishes the topic and a message has come; a Window
    to count in; "finish", whose reply is the tally."""
    load = LOADS[load_name]
    pipe.recv()
    node = RosNode("/benchmark_subscriber", master_uri)
    connection = _connect(node, topic, load.type)
    stream = _Stream(connection, stamp_offset(load))
    stream.read()
    answer(pipe)
    while True:
        readable = wait([pipe, connection])
        if connection in readable:
            stream.read()
        if pipe in readable:
            command = pipe.recv()
            if not isinstance(command, Window):
                break
            stream.tally.window = command
    while wait([connection], _DRAIN_S):
        stream.read()
    answer(pipe, stream.tally.summary())


class _Stream:
    """Counts the messages of a connection; they are small."""

    def __init__(self, connection: socket.socket, offset: int) -> None:
        self.connection = connection
        self.tally = Tally()
        self._offset = _LENGTH.size + offset
        self._data = b""

    def read(self) -> None:
        received = self.connection.recv(1 << 18)
        if not received:
            raise ConnectionResetError("the bridge stopped to publish")
        now_ns = time.time_ns()
        data, at = self._data + received, 0
        while len(data) - at >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(data, at)
            if len(data) - at < _LENGTH.size + length:
                break
            secs, nsecs = _STAMP.unpack_from(data, at + self._offset)
            self.tally.add(secs * 10**9 + nsecs, length, now_ns)
            at += _LENGTH.size + length
        self._data = data[at:]


def _connect(node: RosNode, topic: str, type_name: str) -> socket.socket:
    """A connection to the topic's publisher, once there is one."""
    uri = _publisher_uri(node, topic)
    publisher: Any = xmlrpc.client.ServerProxy(uri)
    code, reason, value = publisher.requestTopic(node.name, topic, [["TCPROS"]])
    if code != 1:
        raise RuntimeError(f"requestTopic {topic} at {uri}: {reason}")
    _, _host, port = value
    connection = socket.create_connection((urllib.parse.urlsplit(uri).hostname or "127.0.0.1", int(port)))
    kind = message_class(type_name)
    fields = {"callerid": node.name, "topic": topic, "type": type_name, "md5sum": kind._md5sum, "tcp_nodelay": "1"}
    send_header(connection, {**fields, "message_definition": kind._full_text})
    header = receive_header(connection)
    if "error" in header:
        raise RuntimeError(f"{topic}: {header['error']}")
    return connection


def _publisher_uri(node: RosNode, topic: str) -> str:
    deadline = time.monotonic() + _PUBLISHER_TIMEOUT_S
    while True:
        publishers: List[str] = []
        for name, names in node.master("getSystemState")[0]:
            if name == topic:
                publishers = names
        if publishers:
            return str(node.master("lookupNode", publishers[0]))
        if time.monotonic() > deadline:
            raise TimeoutError(f"nobody publishes {topic}")
        time.sleep(0.05)
